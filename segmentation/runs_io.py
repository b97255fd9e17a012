"""The RUNS folder: networks trained on one dataset with one recipe and seed, each written whole or not at all.

    run.json                     what all networks share: recipe, seed, dataset hash, starting weights
    network_000/state.pt         while it trains: enough to go on from the last finished epoch
    network_000/weights.pt       when it is finished: weights of the lowest validation loss, with the recipe
    network_000/weights.safetensors  the same of a module of the user's own
    network_000/network.json     when it is finished: best epoch, losses, where the weights came from

Weights and states are read as plain tensors and numbers (`torch.load(weights_only=True)`): such a file runs no code.
"""

import dataclasses
import hashlib
import json
import os
import pickle
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import FileFormatError, InputError
from ..files import sha256_of_file, whole_file
from ._torch import load_torch
from .recipe import OWN_MODULE, STARTER, Recipe, recipe_from_mapping
from .training import EpochResult, TrainingState
from .weights_io import STARTER_PATH, read_safetensors, write_safetensors

FORMAT = "raytwin-runs"
WEIGHTS_FORMAT = "raytwin-weights"
STATE_FORMAT = "raytwin-training-state"
VERSION = 1
_RECIPE_DEFAULTS = {
    item.name: item.default for item in dataclasses.fields(Recipe) if item.default is not dataclasses.MISSING
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Runs:
    """An open RUNS folder: its path, and what all of its networks share (the contents of run.json)."""

    path: Path
    configuration: Mapping[str, Any]

    @property
    def recipe(self) -> Recipe:
        """The recipe of its networks."""
        return recipe_from_mapping(dict(self.configuration["recipe"]))

    @property
    def sha256(self) -> str:
        """Hash of what decides the weights: recipe, seed, dataset and starting weights."""
        return configuration_sha256(self.configuration)


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkResult:
    """A finished network: number, best epoch, its validation loss, history of all epochs, hash of the weights."""

    network: int
    best_epoch: int
    best_validation_loss: float
    history: tuple[EpochResult, ...]
    weights_sha256: str

    @property
    def best(self) -> EpochResult:
        """The epoch whose weights were kept."""
        return self.history[self.best_epoch - 1]


def make_configuration(
    recipe: Recipe,
    *,
    seed: int,
    dataset_sha256: str,
    started_from: Mapping[int, str] | None = None,
    fresh_noise: Mapping[str, Any] | None = None,
    network: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """What decides the weights of the networks of a folder.

    Args:
        recipe: how.
        seed: of the randomness.
        dataset_sha256: what on.
        started_from: hash of the weights that networks start from; key -1 stands for one shared by all.
        fresh_noise: where the noise of the images comes from, where it is drawn anew for every epoch.
        network: what tells a module of the user's own from others.
    """
    return {
        "format": FORMAT,
        "version": VERSION,
        "recipe": dataclasses.asdict(recipe),
        "seed": seed,
        "dataset_sha256": dataset_sha256,
        "started_from": {str(number): digest for number, digest in (started_from or {}).items()},
        **({} if fresh_noise is None else {"fresh_noise": dict(fresh_noise)}),
        **({} if network is None else {"network": dict(network)}),
    }


def configuration_sha256(configuration: Mapping[str, Any]) -> str:
    """SHA-256 of a configuration as canonical JSON."""
    return hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()


def open_runs(path: str | os.PathLike[str]) -> Runs:
    """Open a RUNS folder.

    Raises:
        FileFormatError: no run.json in it, or one that cannot be understood.
    """
    folder = Path(path)
    described = folder / "run.json"
    if not described.is_file():
        raise FileFormatError(
            str(path),
            received="no run.json in it" if folder.is_dir() else "no such folder",
            expected="a folder written by `raytwin train`",
        )
    configuration = _read_json(described)
    if configuration.get("format") != FORMAT or configuration.get("version") != VERSION:
        raise FileFormatError(
            str(described),
            received=f"format {configuration.get('format')!r}, version {configuration.get('version')!r}",
            expected=f"format {FORMAT!r}, version {VERSION}",
        )
    runs = Runs(path=folder, configuration=json.loads(json.dumps(configuration)))
    try:
        _ = runs.recipe
    except (InputError, KeyError, TypeError) as error:
        raise FileFormatError(
            str(described), received=f"a recipe that cannot be used ({error})", expected="a recipe of this version"
        ) from None
    return runs


def create_or_resume_runs(path: str | os.PathLike[str], configuration: Mapping[str, Any]) -> Runs:
    """Start a RUNS folder, or go on in one that holds the same configuration.

    Raises:
        InputError: the folder holds networks of another dataset, recipe, seed or start; what differs is named.
    """
    folder = Path(path)
    wanted = json.loads(json.dumps(configuration))
    if (folder / "run.json").exists():
        runs = open_runs(folder)
        different = _differences(runs.configuration, wanted)
        if different:
            raise InputError(
                str(path),
                received="a folder of networks that differ in " + "; ".join(different),
                expected="the same dataset, recipe, seed, noise and starting weights for all networks of a folder",
                remedy="give another folder with -o, or the same options as before",
            )
        return runs
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            str(path),
            received="a folder with other files in it" if folder.is_dir() else "a file",
            expected="a new or empty folder, or one written by `raytwin train`",
        )
    _write_json(folder / "run.json", wanted)
    return Runs(path=folder, configuration=wanted)


@contextmanager
def gone_unless_begun(path: str | os.PathLike[str]) -> Iterator[None]:
    """Take a new RUNS folder away again where the block fails before any network is begun: nobody goes on with what was wrong."""
    folder = Path(path)
    older, made = (folder / "run.json").exists(), not folder.exists()
    try:
        yield
    except BaseException:
        if not older and folder.is_dir() and {item.name for item in folder.iterdir()} <= {"run.json", ".lock"}:
            for item in folder.iterdir():
                item.unlink()
            if made:
                folder.rmdir()
        raise


def network_folder(runs: Runs, network: int) -> Path:
    """Folder of one network."""
    return runs.path / f"network_{network:03d}"


def finished_networks(runs: Runs) -> list[int]:
    """Numbers of the networks that are trained to the end, in order."""
    return sorted(
        int(found.parent.name.removeprefix("network_"))
        for found in runs.path.glob("network_*/network.json")
        if found.parent.name.removeprefix("network_").isdigit() and (found.parent / "weights.pt").is_file()
    )


def write_state(runs: Runs, network: int, state: TrainingState) -> None:
    """Keep the state after an epoch, replacing that of the epoch before in one step."""
    _save(
        network_folder(runs, network) / "state.pt",
        {
            "format": STATE_FORMAT,
            "configuration_sha256": runs.sha256,
            "epochs_done": state.epochs_done,
            "epochs_wanted": state.epochs_wanted,
            "history": [dataclasses.asdict(result) for result in state.history],
            "weights": dict(state.weights),
            "optimizer": dict(state.optimizer),
            "best_weights": dict(state.best_weights),
            "best_epoch": state.best_epoch,
            "best_loss": state.best_loss,
        },
    )


def read_state(runs: Runs, network: int) -> TrainingState | None:
    """The state to go on from, or None where there is none.

    Raises:
        FileFormatError: a state that cannot be read or belongs to another configuration.
    """
    path = network_folder(runs, network) / "state.pt"
    if not path.is_file():
        return None
    held = _load(path, format_name=STATE_FORMAT)
    if held.get("configuration_sha256") != runs.sha256:
        raise FileFormatError(
            str(path), received="the state of another configuration", expected="one of this folder's run.json"
        )
    return TrainingState(
        epochs_done=held["epochs_done"],
        epochs_wanted=held["epochs_wanted"],
        history=tuple(EpochResult(**result) for result in held["history"]),
        weights=held["weights"],
        optimizer=held["optimizer"],
        best_weights=held["best_weights"],
        best_epoch=held["best_epoch"],
        best_loss=held["best_loss"],
    )


def write_finished(runs: Runs, network: int, state: TrainingState, *, notes: Mapping[str, Any]) -> NetworkResult:
    """Write the weights and the record of a finished network, then drop its state."""
    folder = network_folder(runs, network)
    _save(
        folder / "weights.pt",
        {
            "format": WEIGHTS_FORMAT,
            "version": VERSION,
            "recipe": json.dumps(dataclasses.asdict(runs.recipe)),
            "weights": dict(state.best_weights),
        },
    )
    if runs.recipe.architecture == OWN_MODULE:
        write_safetensors(folder / "weights.safetensors", runs.recipe, state.best_weights, half=False)
    result = NetworkResult(
        network=network,
        best_epoch=state.best_epoch,
        best_validation_loss=state.best_loss,
        history=state.history,
        weights_sha256=sha256_of_file(folder / "weights.pt"),
    )
    record = dataclasses.asdict(result) | {"configuration_sha256": runs.sha256, **notes}
    _write_json(folder / "network.json", record)
    for leftover in (folder / "state.pt", *folder.glob(".*.part")):
        leftover.unlink(missing_ok=True)
    return result


def read_result(runs: Runs, network: int) -> NetworkResult:
    """The record of a finished network."""
    path = network_folder(runs, network) / "network.json"
    record = _read_json(path)
    try:
        if record["configuration_sha256"] != runs.sha256:
            raise FileFormatError(
                str(path), received="a network of another configuration", expected="one of this folder's run.json"
            )
        return NetworkResult(
            network=record["network"],
            best_epoch=record["best_epoch"],
            best_validation_loss=record["best_validation_loss"],
            history=tuple(EpochResult(**result) for result in record["history"]),
            weights_sha256=record["weights_sha256"],
        )
    except (KeyError, TypeError) as error:
        raise FileFormatError(
            str(path), received=f"a record without {error}", expected="a record written by `raytwin train`"
        ) from None


def read_weights(path: str | os.PathLike[str]) -> tuple[Recipe, dict[str, Any]]:
    """Recipe and weights of a finished network, from its weights.pt or a safetensors file.

    Raises:
        FileFormatError: not there, truncated, or another kind of file.
    """
    if Path(path).suffix == ".safetensors":
        return read_safetensors(path)
    held = _load(Path(path), format_name=WEIGHTS_FORMAT)
    try:
        recipe = recipe_from_mapping(json.loads(held["recipe"]))
    except (InputError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(
            str(path), received=f"a recipe that cannot be used ({error})", expected="weights of this version"
        ) from None
    return recipe, dict(held["weights"])


def starting_weights_files(path: str | os.PathLike[str], networks: Iterable[int]) -> dict[int, Path]:
    """Which weights file each network starts from; key -1 stands for one shared by all.

    Args:
        path: `starter` (the network that comes with raytwin), a weights.pt or .safetensors file, or a RUNS folder: its only
            network for all, else the network of the same number.
        networks: numbers of the networks to be trained.

    Raises:
        InputError: the folder has no finished network, or none of a number.
    """
    source = STARTER_PATH if str(path) == STARTER else Path(path)
    if not source.is_dir():
        return {-1: source}
    runs = open_runs(source)
    available = finished_networks(runs)
    if len(available) == 1:
        return {-1: network_folder(runs, available[0]) / "weights.pt"}
    missing = sorted(set(networks) - set(available))
    if not available or missing:
        raise InputError(
            "start from",
            received=f"{path} with the finished networks {available or 'none'}",
            expected="one network to start all from, or networks of the same numbers",
            remedy=f"train network {missing[0]} there first, or name one weights.pt" if available else "",
        )
    return {number: network_folder(runs, number) / "weights.pt" for number in networks}


OF_NETWORK = ("scaling", "classes", "architecture", "encoder", "encoder_depth")


def recipe_of_start(path: str | os.PathLike[str], *, otherwise: Recipe) -> tuple[Recipe, bool]:
    """The recipe of networks that start from trained ones, and whether its length and rate are those of fine-tuning already.

    Networks that were fine-tuned themselves give the whole recipe; others say what network it is, and `otherwise` the rest.

    Args:
        path: a RUNS folder, a weights.pt of one, or a .safetensors file.
        otherwise: how a network is trained, as far as the start does not say it.

    Raises:
        FileFormatError: not there, or another kind of file.
    """
    source = Path(path)
    folder = source if source.is_dir() else source.parent.parent
    runs = open_runs(folder) if source.is_dir() or (folder / "run.json").is_file() else None
    held = runs.recipe if runs is not None else read_weights(source)[0]
    if runs is not None and runs.configuration.get("started_from"):
        return held, True
    return dataclasses.replace(otherwise, **{name: getattr(held, name) for name in OF_NETWORK}), False


def _differences(held: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    different = []
    for key in ("dataset_sha256", "seed", "started_from", "fresh_noise", "network"):
        if held.get(key) != wanted.get(key):
            different.append(f"{key} ({_short(held.get(key))} there, {_short(wanted.get(key))} now)")
    # a folder of an earlier version lacks fields that did not exist then: they had their defaults
    old, new = ({**_RECIPE_DEFAULTS, **one["recipe"]} for one in (held, wanted))
    different += [
        f"{key} ({_short(old.get(key))} there, {_short(new.get(key))} now)"
        for key in sorted(set(old) | set(new))
        if old.get(key) != new.get(key)
    ]
    return different


def _short(value: object) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, Mapping):
        return " ".join(_short(item) for item in value.values()) or "nothing"
    text = str(value)
    return text[:8] if len(text) == 64 else text


def _save(path: Path, content: dict[str, Any]) -> None:
    torch = load_torch()
    # Through a stream: torch writes a path's name into the file, and a temporary name would change its hash.
    with whole_file(path) as temporary, open(temporary, "wb") as stream:
        torch.save(content, stream)


def _load(path: Path, *, format_name: str) -> dict[str, Any]:
    torch = load_torch()
    held: object = None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            held = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        received = "no such file"
    except (OSError, RuntimeError, EOFError, ValueError, KeyError, pickle.UnpicklingError, zipfile.BadZipFile) as error:
        received = f"a file that cannot be read ({' '.join(str(error).split())[:60]})"
    else:
        received = "a file of another format"
    if not isinstance(held, dict) or held.get("format") != format_name:
        raise FileFormatError(str(path), received=received, expected=f"a {format_name} file written by `raytwin train`")
    return held


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileFormatError(
            str(path), received=f"a file that cannot be read ({error})", expected="JSON written by `raytwin train`"
        ) from None
    if not isinstance(content, dict):
        raise FileFormatError(str(path), received="no JSON object", expected="JSON written by `raytwin train`")
    return content


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
