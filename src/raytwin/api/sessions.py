"""Sessions: measured in the virtual lab, checked, and diagnosed."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..files import given_path, write_json
from ..results import Result, Table, axes_or_new, frame, plain
from ._folder import check_effects, written_folder
from ._given import (
    PathLike,
    as_twin,
    distinct_sha256,
    generator_of,
    opened,
    seed_number,
    twin_sha256,
    whole_seed,
)
from ._progress import Progress, Telling

if TYPE_CHECKING:
    import numpy as np
    import pandas

    from ..acquisition.acquisition_io import AcquisitionFile
    from ..campaign.task_plan import TaskInput, TaskPlan
    from ..checks.check_result import CheckResult
    from ..diagnosis.advice.plan_session import SessionPlan
    from ..diagnosis.judgement.answer import Diagnosis
    from ..generator.line.twin import Twin


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class LabSession(Result):
    """A session measured in the virtual lab.

    Fields: path (of the acquisition file); truth_path (of the truth, JSON beside it); shape (rows, columns) of the detector;
    truth (the system, its effects, and what is expected of each series).
    """

    path: Path
    truth_path: Path
    shape: tuple[int, int]
    truth: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """The truth, which `raytwin lab --json` prints."""
        found: dict[str, Any] = plain(self.truth)
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a series: its name and what the lab expects of it."""
        return frame([{"series": name, **dict(series)} for name, series in self.truth["series"].items()])

    def plot(self, ax: Any = None, *, series: str | None = None) -> Any:
        """Mean frame of a series, DN; series: its name (None: the first flat, else the first series); returns the axes.

        Raises:
            InputError: no such series.
        """
        from ..acquisition.acquisition_io import open_acquisition

        axes = axes_or_new(ax)
        with open_acquisition(self.path) as session:
            known = {item.name: item for item in session.series}
            usual = next((item.name for item in session.series if item.kind == "flat"), session.series[0].name)
            name = usual if series is None else series
            if name not in known:
                raise InputError("series", received=repr(name), expected="one of " + ", ".join(known))
            image = axes.imshow(known[name].read_frames().mean(axis=0), cmap="gray")
        axes.figure.colorbar(image, ax=axes, label="DN")
        axes.set(title=name, xlabel="column", ylabel="row")
        return axes

    def _table(self) -> Table:
        effects = self.truth.get("effects") or {}
        rows = (
            ("protocol", str(self.truth.get("protocol", ""))),
            ("series", str(len(self.truth["series"]))),
            ("pixels", f"{self.shape[0]} x {self.shape[1]}"),
            ("effects planted", ", ".join(effects) or "none"),
            ("seed, session", f"{self.truth.get('seed')}, {self.truth.get('session')}"),
            ("truth", str(self.truth_path)),
        )
        return Table(title=f"Lab session {self.path}", rows=rows)


def lab_session(
    output: PathLike,
    *,
    protocol: str,
    seed: "int | np.random.Generator" = 0,
    size: int | tuple[int, int] | None = None,
    effects: Mapping[str, float | str] | Sequence[str] = (),
    progress: Progress | bool | None = None,
    **words: Any,
) -> LabSession:
    """A session measured in the virtual lab, a real line whose truth is known; it shares no physics with the twin.

    Args:
        output: acquisition file to write; its truth goes beside it (`.truth.json`).
        protocol: `calibration`, `set1` or `set2`; for a diagnosis `full`, `short` or `products`.
        seed: a whole number or a generator: draws system, products and noise; the same number is the same system everywhere.
        size: (rows, columns), or N for N x N pixels; None: 128 x 160, long sessions 128 x 128.
        effects: to plant in a long session, id -> strength, or texts `ID=STRENGTH[@always|@calibration]`.
        progress: True for a bar, or a function of (stage, done, total).
        **words: more of `raytwin.lab.protocols.run_protocol`: frames, products, product_mm, bones_mm, bones_across_mm,
            exposures_ms, boneless, pixel_mm, source_detector_mm, session, geometry, leave_out, only.

    Returns:
        Where the session lies, and its truth.

    Raises:
        InputError: an unknown protocol, effect or word, sizes that cannot be.

    Example:
        >>> session = rt.lab_session("lab.h5", protocol="calibration", seed=1, size=16, frames=2)
        >>> session.shape
        (16, 16)
    """
    from inspect import signature

    import numpy as np

    from ..acquisition.acquisition_io import open_acquisition
    from ..lab.effects import request_from_text
    from ..lab.protocols import run_protocol, truth_path

    known = [
        name
        for name in signature(run_protocol).parameters
        if name not in ("path", "rows", "columns", "begin", "advance")
    ]
    unknown = [name for name in words if name not in known]
    if unknown:
        raise InputError(unknown[0], received="a word of the session", expected="one of " + ", ".join(known))
    texts = effects
    if isinstance(effects, Mapping):
        texts = [f"{name}={strength}" for name, strength in effects.items()]
    requests = [request_from_text(text) for text in texts]
    if size is not None:
        sides = np.atleast_1d(np.asarray(size))
        if sides.dtype.kind not in "iu" or sides.shape not in ((1,), (2,)) or sides.min() < 8 or sides.max() > 8192:
            raise InputError("size", received=repr(size), expected="N or (rows, columns) from 8 to 8192 pixels")
        rows, columns = (int(side) for side in np.broadcast_to(sides, 2))
        words |= {"rows": rows, "columns": columns}
    with Telling(progress, unit="frame") as telling:
        truth = run_protocol(
            output,
            protocol=protocol,
            seed=whole_seed(seed),
            effects=requests,
            begin=lambda frames: telling.begin(protocol, frames),
            advance=telling.advance,
            **words,
        )
    with open_acquisition(output) as session:
        shape = session.series[0].shape
    beside = words.get("truth_file")
    return LabSession(
        path=Path(output), truth_path=truth_path(output) if beside is None else Path(beside), shape=shape, truth=truth
    )


def check(source: "AcquisitionFile | PathLike", *, progress: Progress | bool | None = None) -> "CheckResult":
    """What an acquisition, a folder of measurements or a twin allows, and what is suspicious, before anything is computed.

    Args:
        source: an acquisition file (path or open), a folder in a layout that can be imported, or a twin file.
        progress: True for a line that changes, or a function of (stage, done, total).

    Returns:
        Series and what each serves for, findings, what is possible, what to measure next. Damage is a finding.

    Raises:
        InputError: no such file or folder.

    Example:
        >>> found = rt.check("session.h5")
        >>> found.counts["error"]
        0
    """
    from ..acquisition.acquisition_io import AcquisitionFile
    from ..checks.check import check_acquisition
    from ..checks.check_series import check_series

    with Telling(progress) as telling:
        if isinstance(source, AcquisitionFile):
            return check_series(source, progress=telling.stage)
        return check_acquisition(source, progress=telling.stage)


def diagnose(
    acquisition: "AcquisitionFile | PathLike",
    *,
    twin: "Twin | PathLike | None" = None,
    also: "Sequence[AcquisitionFile | PathLike]" = (),
    layer: str | None = None,
    without: Sequence[str] = (),
    plan_only: bool = False,
    output: PathLike | None = None,
    task: "Mapping[str, Any] | None" = None,
    device: str = "auto",
    seed: "int | np.random.Generator" = 0,
    progress: Progress | bool | None = None,
) -> "Diagnosis | SessionPlan":
    """Where the gap between measured and simulated lies, which effect causes it, and how far it shrinks with that effect added.

    Args:
        acquisition: a file or an open one, anything from darks and two flats to the full protocol.
        twin: calibrated before, whose effects are part of what is expected; None: from this session's own series.
        also: what was measured later on the same line; calibrates nothing.
        layer: `front` or `back` of a dual-layer panel; None: the twin's, front without one.
        without: effects to leave out of the catalogue.
        plan_only: say which effects these series could distinguish, whatever the frames show.
        output: folder for diagnosis.json, report.html and twin.h5; None: nothing is written.
        task: POD before and after, which needs `output`: `measured` (images of the line as it is), `products`, `low`, `high`, and
            fields of `raytwin.campaign.task_plan.TaskPlan` (networks, steps, images, ...).
        device: of the task's networks.
        seed: a whole number or a generator.
        progress: True for a line that changes, or a function of (stage, done, total).

    Returns:
        The diagnosis: `verdict`, `causes`, `twin` (with what was found added), `plot_gap`; a `SessionPlan` with `plan_only`.

    Raises:
        InputError, FileFormatError: nothing can be judged, or a file that is no acquisition.

    Example:
        >>> found = rt.diagnose("session.h5", seed=0)
        >>> found.verdict in ("no_gap", "explained", "explained_in_part", "ambiguous", "unknown_effect")
        True
        >>> found.gap.before > 0
        True
    """
    from .. import __version__
    from ..acquisition.sessions import continued_session, layer_for
    from ..diagnosis.advice.plan_session import plan_session
    from ..diagnosis.diagnose_session import diagnose as diagnose_session
    from ..generator.effects import EFFECTS

    check_effects("without", without, tuple(EFFECTS))
    number = seed_number(seed)
    rng = generator_of(seed)
    known = None if twin is None else as_twin(twin)
    if task is not None and (output is None or plan_only):
        raise InputError(
            "task", received="no folder for it", expected="an output folder, which keeps images and networks"
        )
    folder = None if output is None else given_path(output, expected="a folder", argument="output")
    place: AbstractContextManager[Any] = nullcontext() if folder is None else written_folder(folder)
    with place, Telling(progress) as telling:
        asked = (
            None if task is None else _task(task, seed=whole_seed(seed) if number is None else number, device=device)
        )
        with opened([acquisition, *also]) as files:
            hashes = distinct_sha256(files)
            session = continued_session(files, layer=layer_for(None if known is None else known.layer, layer))
            if plan_only:
                plan = plan_session(session, twin=known, rng=rng, without=without, progress=telling.stage)
                if folder is not None:
                    write_json(folder / "plan.json", plan.to_dict())
                return plan
            found = diagnose_session(session, twin=known, rng=rng, without=without, progress=telling.stage)
        later = {"also_sha256": hashes[1:]} if also else {}
        inputs = {
            "acquisition_sha256": hashes[0],
            **later,
            "twin_sha256": None if twin is None else twin_sha256(twin),
            "raytwin_version": __version__,
            "seed": number,
        }
        found = replace(found, inputs=inputs)
        if folder is not None:
            found.twin.save(folder / "twin.h5")
            _write(found, folder)
            if asked is not None:
                found = replace(
                    found, task=_run_task(found, known, *asked, folder=folder / "task", device=device, telling=telling)
                )
                _write(found, folder)
    return found


def _write(found: "Diagnosis", folder: Path) -> None:
    from .. import __version__
    from ..campaign.task_page import detection_of
    from ..diagnosis.report.report import write_report

    answer = found.to_dict()
    write_report(found, answer, folder / "report.html", version=__version__, detection=detection_of(found.task))
    write_json(folder / "diagnosis.json", answer)


def _task(task: Mapping[str, Any], *, seed: int, device: str) -> "tuple[TaskInput, TaskPlan]":
    """What a task asks for, checked before the diagnosis begins."""
    from ..campaign.task import check_task
    from ..campaign.task_plan import TaskInput, TaskPlan
    from ..generator.predictions.predict_settings import as_setting
    from ..segmentation import choose_device

    words = {name: value for name, value in task.items() if value is not None}
    names = [field.name for field in fields(TaskPlan) if field.name != "seed"]
    unknown = [name for name in words if name not in ("measured", "products", "low", "high", *names)]
    if unknown or "measured" not in words:
        raise InputError(
            "task",
            received=unknown[0] if unknown else "no measured images",
            expected="measured, and of " + ", ".join(("products", "low", "high", *names)),
        )
    settings = {side: as_setting(words.pop(side)) for side in ("low", "high") if side in words}
    products = words.pop("products", None)
    brought = TaskInput(
        measured=given_path(words.pop("measured"), expected="measured images", argument="measured"),
        products=None if products is None else given_path(products, expected="products", argument="products"),
        **settings,
    )
    plan = TaskPlan(**words, seed=seed)
    check_task(brought)
    choose_device(device)  # says at once how to install torch where it is missing
    return brought, plan


def _run_task(
    found: "Diagnosis",
    known: "Twin | None",
    brought: "TaskInput",
    plan: "TaskPlan",
    *,
    folder: Path,
    device: str,
    telling: Telling,
) -> dict[str, Any]:
    from ..campaign.task import run_task
    from ..segmentation import choose_device

    before = replace(found.twin, effects=() if known is None else known.effects)
    return run_task(before, found.twin, brought, folder, plan=plan, device=choose_device(device), tell=telling.stage)
