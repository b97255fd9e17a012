"""Dual-energy images and the networks that look at them: generated, trained on, tried."""

import dataclasses
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from ..errors import FileFormatError, InputError, check_whole
from ..files import check_new_folder, check_not_read, given_path
from ..results import Result, Table, axes_or_new, counted, frame, percent_text, plain
from ._given import PathLike, as_twin, dataset_of, twin_sha256, whole_seed
from ._progress import Progress, Telling

if TYPE_CHECKING:
    import numpy as np
    import pandas
    from numpy.typing import NDArray

    from ..acquisition import Dataset, Setting
    from ..acquisition.acquisition_io import AcquisitionFile
    from ..acquisition.dataset_io import DatasetRow
    from ..generator.datasets.generate import GenerationSummary
    from ..generator.line.twin import Twin
    from ..generator.scenes.describe import Description
    from ..segmentation import Detection, EpochResult, NetworkResult, Rate, Recipe, Segmenter

    Pairs: TypeAlias = "Dataset | PathLike | GeneratedPairs"

_RATES = {
    "recall": "recall of the objects' pixels",
    "hit_rate": "objects detected",
    "false_alarm_rate": "false alarms",
}
SPLITS = ("train", "val", "test", "all")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class GeneratedPairs(Result):
    """Image pairs that were generated, in memory or in a file.

    Fields: summary; path (of the dataset file, None in memory); rows (one a pair); images (n, 2, row, column), -log(I / I0),
    low kV first; counts (the same in DN, None where left out); foreign_object_masks, product_masks (n, row, column); these
    are None where a file was asked for; attributes (provenance); tiff (folder and trees written, None: none); warnings.
    """

    summary: "GenerationSummary"
    path: Path | None
    rows: "tuple[DatasetRow, ...]"
    images: "NDArray[np.float32] | None" = None
    counts: "NDArray[np.float32] | None" = None
    foreign_object_masks: "NDArray[np.bool_] | None" = None
    product_masks: "NDArray[np.bool_] | None" = None
    attributes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    tiff: Mapping[str, Any] | None = None
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        return self.summary.images

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin generate --json` prints."""
        answer = {**self.summary.as_dict(), "warnings": self.warnings}
        found: dict[str, Any] = plain(answer if self.tiff is None else {**answer, "tiff": self.tiff})
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a pair: image, product, foreign_object, size_mm, contrast, split, setting."""
        return frame([dataclasses.asdict(row) for row in self.rows])

    def save(self, path: PathLike) -> Path:
        """Write the pairs to a dataset file; returns its path.

        Raises:
            InputError: they lie in a file already, or a place where nothing can be written.
        """
        from ..acquisition.dataset_io import write_dataset

        if self.images is None or self.foreign_object_masks is None or self.product_masks is None:
            raise InputError(
                "pairs", received=f"pairs in {self.path}", expected="pairs in memory", remedy="copy the file"
            )
        with write_dataset(path, shape=self.images.shape[2:], provenance=self.attributes) as writer:
            for number, row in enumerate(self.rows):
                writer.append(
                    image=self.images[number],
                    foreign_object_mask=self.foreign_object_masks[number],
                    product_mask=self.product_masks[number],
                    row=row,
                    counts=None if self.counts is None else self.counts[number],
                )
        return Path(path)

    def plot(self, ax: Any = None, *, number: int = 0, beam: str = "low") -> Any:
        """One image of a pair, -log(I / I0), the foreign object outlined; returns the axes.

        Raises:
            InputError: no such pair or beam.
        """
        if beam not in ("low", "high") or not 0 <= number < len(self):
            raise InputError(
                "number, beam", received=f"{number}, {beam}", expected=f"0 to {len(self) - 1}, low or high"
            )
        if self.images is None or self.foreign_object_masks is None:
            with dataset_of(str(self.path)) as dataset:
                pair, mask = dataset.images(number), dataset.foreign_object_masks(number)
        else:
            pair, mask = self.images[number], self.foreign_object_masks[number]
        axes = axes_or_new(ax)
        image = axes.imshow(pair[0 if beam == "low" else 1], cmap="gray_r")
        axes.figure.colorbar(image, ax=axes, label="-log(I / I0)")
        if mask.any():
            axes.contour(mask, levels=[0.5], colors="tab:orange", linewidths=1)
        axes.set(title=f"{self.rows[number].image}, {beam} kV", xlabel="column", ylabel="row")
        return axes

    def _table(self) -> Table:
        found = self.summary
        rows = (
            ("with a foreign object", str(found.with_foreign_object)),
            ("references", str(found.references)),
            ("setting", found.setting),
            ("seed, recipe", f"{found.seed}, {found.recipe}"),
            ("where", "in memory" if self.path is None else str(self.path)),
        )
        notes = tuple(f"warning: {text}" for text in self.warnings)
        return Table(title=f"{found.images} image pairs", rows=rows, notes=notes)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class TrainedNetworks(Result):
    """Networks of a folder.

    Fields: path (the folder); recipe (how they are built and trained); device (that trained them); networks (a record of each, with
    the losses of its epochs); warnings.
    """

    path: Path
    recipe: "Recipe"
    device: str
    networks: "tuple[NetworkResult, ...]"
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin train --json` prints."""
        found: dict[str, Any] = plain(
            {
                "runs": str(self.path),
                "recipe": dataclasses.asdict(self.recipe),
                "device": self.device,
                "networks": [_network_answer(item) for item in self.networks],
                "warnings": self.warnings,
            }
        )
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row an epoch: network, epoch, losses and rates of the validation images."""
        return frame(
            [{"network": item.network, **dataclasses.asdict(epoch)} for item in self.networks for epoch in item.history]
        )

    def plot(self, ax: Any = None) -> Any:
        """Training (thin) and validation losses of every network against the epoch; returns the axes."""
        axes = axes_or_new(ax)
        for item in self.networks:
            (line,) = axes.plot([one.epoch for one in item.history], [one.loss for one in item.history], lw=0.8)
            validated = [one for one in item.history if one.validation_loss is not None]
            places, losses = [one.epoch for one in validated], [one.validation_loss for one in validated]
            axes.plot(places, losses, "o-", ms=3, color=line.get_color(), label=f"network {item.network}")
        axes.set(xlabel="epoch", ylabel="loss")
        axes.legend(frameon=False)
        return axes

    def _table(self) -> Table:
        rows = tuple(
            (
                str(item.network),
                f"{item.best_epoch} of {len(item.history)}",
                f"{item.best_validation_loss:.3f}",
                percent_text(item.best.validation_hit_rate),
                percent_text(item.best.validation_false_alarm_rate),
            )
            for item in self.networks
        )
        header = ("network", "best epoch", "validation loss", "objects detected", "false alarms")
        notes = tuple(f"note: {text}" for text in self.warnings)
        return Table(title=f"{counted(len(rows), 'network')} in {self.path}", header=header, rows=rows, notes=notes)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Detections(Result):
    """Hit or miss of every network on every image.

    Fields: rows; path (of the table, None: not written); networks (their numbers); threshold; rates (`recall`, `hit_rate`,
    `false_alarm_rate`); warnings.
    """

    rows: "tuple[Detection, ...]"
    path: Path | None
    networks: tuple[int, ...]
    threshold: float
    rates: "Mapping[str, Rate]"
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin detect --json` prints."""
        found: dict[str, Any] = plain(
            {
                "table": self.path,
                "networks": self.networks,
                "images": len({row.image for row in self.rows}),
                "threshold": self.threshold,
                **{name: dataclasses.asdict(rate) for name, rate in self.rates.items()},
                "warnings": self.warnings,
            }
        )
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a network and image, the columns of HITS.csv; `fit_pod` takes it, and the result itself, as a table."""
        import pandas

        names = [field.name for field in dataclasses.fields(self.rows[0])] if self.rows else []
        table = pandas.DataFrame({name: [getattr(row, name) for row in self.rows] for name in names})
        if names:
            table["hit"] = table["hit"].astype(int)
            table["false_alarm"] = table["false_alarm"].map({True: 1.0, False: 0.0})
        return table

    def plot(self, ax: Any = None, *, size: str = "contrast") -> Any:
        """Recall of each foreign object's pixels against its `contrast` or `size_mm`; returns the axes.

        Raises:
            InputError: another size.
        """
        if size not in ("contrast", "size_mm"):
            raise InputError("size", received=repr(size), expected="contrast or size_mm")
        axes = axes_or_new(ax)
        known = [row for row in self.rows if row.recall is not None and getattr(row, size) is not None]
        axes.plot([getattr(row, size) for row in known], [row.recall for row in known], "o", ms=4, alpha=0.6)
        axes.set(xlabel=size, ylabel="share of the object's pixels marked")
        return axes

    def _table(self) -> Table:
        rows = tuple((label, *_rate_cells(self.rates[name])) for name, label in _RATES.items())
        title = f"{counted(len(self.networks), 'network')} on {counted(len({row.image for row in self.rows}), 'image')}"
        notes = tuple(f"note: {text}" for text in self.warnings)
        return Table(title=title, header=("", "value", "95 % interval", "trials"), rows=rows, notes=notes)


def _rate_cells(rate: "Rate") -> tuple[str, str, str]:
    if rate.value is None or rate.low is None or rate.high is None:
        return "no trials", "", "0"
    return f"{100 * rate.value:.1f} %", f"{100 * rate.low:.1f} to {100 * rate.high:.1f} %", str(rate.n)


def _network_answer(result: "NetworkResult") -> dict[str, Any]:
    validated = [epoch for epoch in result.history if epoch.validation_loss is not None]
    return {
        "network": result.network,
        "best_epoch": result.best_epoch,
        "best_validation_loss": result.best_validation_loss,
        "validation_recall": result.best.validation_recall,
        "validation_hit_rate": result.best.validation_hit_rate,
        "validation_false_alarm_rate": result.best.validation_false_alarm_rate,
        "epochs": len(result.history),
        "losses": [epoch.loss for epoch in result.history],
        "validation_epochs": [epoch.epoch for epoch in validated],
        "validation_losses": [epoch.validation_loss for epoch in validated],
        "weights_sha256": result.weights_sha256,
    }


def read_dataset(path: PathLike) -> "Dataset":
    """A dataset file, open for reading; use it in a `with` block. Images stay in the file until they are read.

    Args:
        path: of the file.

    Returns:
        Rows (one a pair), and methods that read images (n, 2, row, column), -log(I / I0) with the low kV first, and masks
        (n, row, column) by their numbers.

    Raises:
        FileFormatError: no such file, not a dataset, damaged; the message says where.

    Example:
        >>> with rt.read_dataset("references.h5") as dataset:
        ...     first = dataset.images(0)
        >>> first.shape
        (2, 64, 64)
    """
    from ..acquisition.dataset_io import read_dataset as open_file

    return open_file(path)


def generate(
    twin: "Twin | PathLike",
    reference: "Dataset | AcquisitionFile | Description | PathLike",
    *,
    low: "Setting | str",
    high: "Setting | str",
    n: int,
    seed: "int | np.random.Generator",
    output: PathLike | None = None,
    recipe: str = "raytwin",
    split: str | None = None,
    product_material: str | None = None,
    foreign_material: str | None = None,
    bad_pixels: str = "repaired",
    registration_px: tuple[float, float] | str | None = None,
    reference_low: "Setting | str | None" = None,
    reference_high: "Setting | str | None" = None,
    counts: bool = True,
    tiff: PathLike | None = None,
    progress: Progress | bool | None = None,
) -> GeneratedPairs:
    """Dual-energy image pairs at a setting, from low-noise references or from a description of products.

    At the kV and filter of the references only the noise they lack is added; at another kV or filter every pixel is solved
    for two materials and projected through the target's spectrum.

    Args:
        twin: a twin, its file, or a shipped calibration's name.
        reference: a dataset or an acquisition whose object series pair up by scene (file or open), or a description (.toml).
        low, high: the settings aimed at.
        n: how many pairs.
        seed: a whole number or a generator; the same number gives the same bytes.
        output: dataset file to write; None: arrays in memory.
        recipe: of the noise, `raytwin` or `as_published`.
        split: only references of this split.
        product_material, foreign_material: what product and object of references are made of; None: as their file states it, else
            chicken_breast and rib_bone.
        bad_pixels: `repaired`, or `measured`: the counts hold the twin's bad pixels.
        registration_px: shift (rows, columns) of the references' high image, taken off; `estimate` finds it.
        reference_low, reference_high: settings of references that do not say.
        counts: also the images in DN.
        tiff: folder to write the images to as TIFF, in the paper's layout.
        progress: True for a bar, or a function of (stage, done, total).

    Returns:
        The pairs, or where they were written.

    Raises:
        InputError, FileFormatError: references or settings that cannot be used; the message says why.

    Example:
        >>> low, high = "kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05", "kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05"
        >>> pairs = rt.generate("twin.h5", "references.h5", low=low, high=high, n=2, seed=1)
        >>> pairs.images.shape
        (2, 2, 64, 64)
    """
    from ..generator.datasets.belt_motion import twin_on_belt
    from ..generator.predictions.predict_settings import as_setting
    from ..materials import material_from_name

    check_whole("number of images", n, least=1)
    check_not_read(output, read=(twin, reference))
    if tiff is not None:
        check_new_folder(tiff)
    targets = as_setting(low), as_setting(high)
    known, told = twin_on_belt(as_twin(twin), targets)
    for name in (product_material, foreign_material):
        if name is not None:
            material_from_name(name)
    if (reference_low is None) != (reference_high is None):
        raise InputError("reference_low and reference_high", received="one of the two", expected="both or neither")
    common: dict[str, Any] = {
        "low": targets[0],
        "high": targets[1],
        "images": n,
        "seed": whole_seed(seed),
        "with_counts": counts,
        "twin_sha256": twin_sha256(twin),
    }
    with tempfile.TemporaryDirectory() as scratch, Telling(progress, unit="pair") as telling:
        scratch_path = Path(scratch) / "pairs.h5"
        path = scratch_path if output is None else given_path(output, expected="a dataset file", argument="output")
        telling.begin("generating", n)
        description = _description_of(reference)
        if description is not None:
            from ..generator.datasets.generate_described import generate_from_description

            _check_no_word_of_references(
                recipe=recipe != "raytwin",
                split=split is not None,
                registration=registration_px is not None,
                reference_low=reference_low is not None,
            )
            summary = generate_from_description(
                known, description, path, bad_pixels=bad_pixels, progress=telling.reach, **common
            )
        else:
            from ..generator.datasets.generate import generate_dataset
            from ..generator.datasets.reference_materials import materials_of_references

            fallback = None
            if reference_low is not None and reference_high is not None:
                fallback = (as_setting(reference_low), as_setting(reference_high))
            with _references(reference, known, Path(scratch)) as references:
                product, foreign = materials_of_references(
                    references, product_material=product_material, foreign_material=foreign_material
                )
                summary = generate_dataset(
                    known,
                    references,
                    path,
                    recipe=recipe,
                    product_material=product,
                    foreign_material=foreign,
                    bad_pixels=bad_pixels,
                    registration_px=registration_px,
                    split=split,
                    reference_setting=fallback,
                    progress=telling.reach,
                    **common,
                )
        found = _pairs_of_file(path, summary, in_memory=output is None, tiff=tiff)
        return dataclasses.replace(found, warnings=(*told, *found.warnings))


def _check_no_word_of_references(**words: bool) -> None:
    for name, given in words.items():
        if given:
            raise InputError(
                name, received="a description as REFERENCE", expected="reference images: the option is about those"
            )


def _pairs_of_file(
    path: Path, summary: "GenerationSummary", *, in_memory: bool, tiff: PathLike | None
) -> GeneratedPairs:
    """The pairs that were written to a file, as arrays where the file does not stay; also as TIFF in a folder."""
    from ..acquisition.dataset_io import read_dataset as open_dataset
    from ..acquisition.tiff_folder import write_tiff_folder

    with open_dataset(path) as dataset:
        warnings, written = summary.warnings, None
        if tiff is not None:
            folder = write_tiff_folder(dataset, tiff)
            written = {"folder": folder.folder, "trees": list(folder.trees)}
            warnings = (*warnings, *folder.notes)
        arrays: dict[str, Any] = {}
        if in_memory:
            every = slice(None)
            arrays = {
                "images": dataset.images(every),
                "counts": dataset.counts(every),
                "foreign_object_masks": dataset.foreign_object_masks(every),
                "product_masks": dataset.product_masks(every),
                "attributes": dict(dataset.attributes),
            }
        return GeneratedPairs(
            summary=summary,
            path=None if in_memory else path,
            rows=dataset.rows,
            tiff=written,
            warnings=tuple(warnings),
            **arrays,
        )


def _description_of(reference: Any) -> "Description | None":
    from ..generator.scenes.describe import Description, read_description

    if isinstance(reference, Description):
        return reference
    if isinstance(reference, str | Path) and Path(reference).suffix.lower() == ".toml":
        return read_description(reference)
    return None


@contextmanager
def _references(reference: Any, twin: "Twin", scratch: Path) -> "Iterator[Dataset]":
    """Reference pairs as a dataset, of a dataset or of an acquisition's longest exposed pairs."""
    from ..acquisition.acquisition_io import AcquisitionFile, open_acquisition
    from ..acquisition.dataset_io import Dataset
    from ..acquisition.dataset_io import read_dataset as open_dataset

    if isinstance(reference, Dataset):
        yield reference
        return
    if isinstance(reference, AcquisitionFile):
        path = _longest_pairs(reference, twin, scratch)
    else:
        path = given_path(reference, expected="reference pairs, or a description", argument="reference")
        try:
            open_dataset(path).close()
        except FileFormatError:
            try:
                acquisition = open_acquisition(path)
            except FileFormatError as error:
                raise FileFormatError(
                    str(path),
                    received=error.received,
                    expected="a raytwin-dataset or raytwin-acquisition file, or a description (.toml)",
                ) from None
            with acquisition:
                path = _longest_pairs(acquisition, twin, scratch)
    with open_dataset(path) as dataset:
        yield dataset


def _longest_pairs(acquisition: "AcquisitionFile", twin: "Twin", scratch: Path) -> Path:
    from ..acquisition.pairs import dataset_from_acquisition, object_pairs

    pairs = object_pairs(acquisition)
    if not pairs:
        raise InputError(
            acquisition.path, received="no object series that pair up by scene", expected="scenes measured at two kV"
        )
    best = max(pairs, key=lambda pair: pair.seconds)
    low, high = best.settings
    bad, path = twin.maps.bad_pixels > 0, scratch / "reference.h5"
    dataset_from_acquisition(
        acquisition,
        path,
        low=low,
        high=high,
        with_counts=False,
        bad_pixels=bad if bad.shape == best.low.shape else None,
    )
    return path


@contextmanager
def _as_dataset(given: "Pairs") -> "Iterator[Dataset]":
    """An open dataset; pairs in memory are written to a file for as long as they are needed."""
    if not isinstance(given, GeneratedPairs):
        with dataset_of(given) as dataset:
            yield dataset
        return
    with tempfile.TemporaryDirectory() as scratch:
        path = given.path if given.path is not None else given.save(Path(scratch) / "pairs.h5")
        with dataset_of(path) as dataset:
            yield dataset


def train(
    dataset: "Pairs",
    output: PathLike,
    *,
    networks: int = 1,
    recipe: "Recipe | str | None" = None,
    epochs: int | None = None,
    steps: int | None = None,
    batch: int | None = None,
    learning_rate: float | None = None,
    crop_px: int | None = None,
    scaling: str | None = None,
    encoder_weights: str | None = None,
    architecture: str | None = None,
    encoder: str | None = None,
    network: Any = None,
    start_from: PathLike | None = None,
    fresh_noise: "Twin | PathLike | None" = None,
    low: "Setting | str | None" = None,
    high: "Setting | str | None" = None,
    device: str = "auto",
    threads: int | None = None,
    workers: int = 1,
    seed: "int | np.random.Generator" = 0,
    progress: Progress | bool | None = None,
) -> TrainedNetworks:
    """Segmentation networks trained on image pairs; a run that was stopped goes on with the same call.

    Args:
        dataset: a dataset file, an open one, or what `generate` returned.
        output: folder of networks of one dataset, recipe, seed and start, new or to go on with.
        networks: how many the folder holds at the end.
        recipe: `raytwin`, `as_published`, or a `Recipe`; the arguments up to encoder change it. None: `raytwin`, or that of
            the starter where networks start from it. Where they start from other networks, these say what network it is
            (architecture, encoder and its depth, classes, scaling), and all of the recipe where they were fine-tuned themselves.
        epochs, steps: passes over the training images, or training steps.
        batch, learning_rate, crop_px: of a step.
        scaling: what networks see. `matched`: both images combined so that the foreign objects of the training images stand out
            most (the recipe of the answer says along which direction); `matched:DEGREES`, a direction of your own; `residual`, what
            the low image holds beyond the product; `min_max`. None: the recipe's.
        encoder_weights: `imagenet` (downloaded once).
        architecture, encoder: names of segmentation-models-pytorch, such as `FPN` and `resnet18`.
        network: in their place a torch module of your own, or a function without arguments that makes one: scaled log images
            (image, 2, row, column) -> logits (image, class, row, column), the foreign object last. Networks from a function
            start from different random weights, copies of a module all from its own. Weights are written as
            `weights.safetensors`, and `detect` takes the same `network`.
        start_from: `starter` (comes with raytwin), a folder of networks, a weights.pt or a .safetensors file; steps
            and learning rate are then smaller.
        fresh_noise: a twin that draws other noise for every epoch, at the settings `low` and `high`; `dataset` holds references.
        device: `auto`, `cpu`, `cuda` or `mps`.
        threads: processor threads; None: all, of several workers one each.
        workers: processes that share the networks; a core each is the fastest. The weights depend on threads, not on workers.
        seed: a whole number or a generator.
        progress: True for a bar, or a function of (stage, done, total).

    Returns:
        Records of the networks.

    Raises:
        InputError: a folder of something else, images that cannot be used.
        MissingDependencyError: the extra `segmentation` is not installed.

    Example:
        >>> runs = rt.train("references.h5", "networks", networks=1, steps=2, batch=2, crop_px=32, seed=1)
        >>> len(runs.networks)
        1

        A module of your own:

        >>> import torch
        >>> def make():
        ...     return torch.nn.Sequential(torch.nn.Conv2d(2, 8, 5, padding=2), torch.nn.ReLU(), torch.nn.Conv2d(8, 1, 1))
        >>> own = rt.train("references.h5", "own_networks", network=make, networks=1, steps=2, batch=2, crop_px=32, seed=1)
        >>> len(rt.detect(own, "references.h5", split="all", network=make).networks)
        1
    """
    from ..campaign.ensemble import train_together
    from ..segmentation import choose_device, open_runs, say_who_is_blind, train_networks

    folder = given_path(output, expected="a folder for the networks", argument="output")
    chosen = _recipe(
        recipe,
        start_from=start_from,
        length={"epochs": epochs, "steps": steps},
        changes={
            "batch": batch,
            "learning_rate": learning_rate,
            "crop_px": crop_px,
            "scaling": scaling,
            "encoder_weights": encoder_weights,
            "architecture": architecture,
            "encoder": encoder,
        },
    )
    if (fresh_noise is None, low is None, high is None) not in ((True,) * 3, (False,) * 3):
        raise InputError(
            "fresh_noise",
            received="only a part of fresh_noise, low and high",
            expected="all three: a twin and the two settings to train for",
        )
    for word, value in (("networks", networks), ("workers", workers)):
        check_whole(word, value, least=1)
    if workers != 1 and fresh_noise is not None:
        raise InputError(
            "workers", received=f"{workers} with fresh_noise", expected="1: fresh noise is drawn in one process"
        )
    if network is not None:
        chosen = _own_recipe(chosen, architecture=architecture, encoder=encoder, workers=workers)
    number = whole_seed(seed)
    warnings: list[str] = []
    with _as_dataset(dataset) as images, Telling(progress, unit="epoch") as telling:
        fresh, decided_by = None, None
        if fresh_noise is not None and low is not None and high is not None:
            fresh, decided_by = _fresh(images, fresh_noise, low, high, seed=number, warnings=warnings)
        if workers == 1:
            _use_threads(threads)
        where = choose_device(device)

        def told(network: int, done: int, wanted: int, result: "EpochResult | None") -> None:
            telling.begin(f"network {network + 1}/{networks}", wanted, done=done)

        words: dict[str, Any] = {
            "recipe": chosen,
            "networks": networks,
            "seed": number,
            "device": where,
            "start_from": start_from,
            "progress": told,
            "warn": warnings.append,
        }
        if workers == 1:
            found = train_networks(images, folder, **words, fresh=fresh, fresh_noise=decided_by, network=network)
        else:
            found = train_together(images, folder, **words, workers=workers, threads=1 if threads is None else threads)
    blind = say_who_is_blind(found)
    warnings += [blind] if blind else []
    return TrainedNetworks(
        path=folder, recipe=open_runs(folder).recipe, device=where, networks=tuple(found), warnings=tuple(warnings)
    )


def _own_recipe(recipe: "Recipe", *, architecture: str | None, encoder: str | None, workers: int) -> "Recipe":
    """The recipe of a module of the user's own."""
    from ..segmentation import recipe_for_module

    for name, value in (("architecture", architecture), ("encoder", encoder)):
        if value is not None:
            raise InputError(name, received=f"{value} with a network of your own", expected="one of the two")
    if workers != 1:
        raise InputError(
            "workers", received=f"{workers} with a network of your own", expected="1: it lives in this process"
        )
    return recipe_for_module(recipe)


def _recipe(
    recipe: "Recipe | str | None", *, start_from: Any, length: Mapping[str, Any], changes: Mapping[str, Any]
) -> "Recipe":
    from ..segmentation import RECIPES, recipe_for_fine_tuning, recipe_of_start, starter_recipe

    if recipe is None and str(start_from) == "starter":
        recipe = starter_recipe()
        start_from = None  # its steps and rate are those of fine-tuning already
    elif recipe is None and start_from is not None:
        recipe, tuned = recipe_of_start(start_from, otherwise=RECIPES["raytwin"])
        if tuned:
            start_from = None
    recipe = "raytwin" if recipe is None else recipe
    if isinstance(recipe, str):
        if recipe not in RECIPES:
            raise InputError("recipe", received=recipe, expected="one of " + ", ".join(RECIPES))
        recipe = RECIPES[recipe]
    if start_from is not None:
        recipe = recipe_for_fine_tuning(recipe)
    given = {name: value for name, value in changes.items() if value is not None}
    if any(value is not None for value in length.values()):
        given |= length
    return dataclasses.replace(recipe, **given)


def _fresh(
    references: "Dataset",
    twin: "Twin | PathLike",
    low: "Setting | str",
    high: "Setting | str",
    *,
    seed: int,
    warnings: list[str],
) -> "tuple[Callable[[int, int], NDArray[np.float32]], dict[str, Any]]":
    """What makes the images of an epoch, and what decides them."""
    from ..generator.datasets.belt_motion import twin_on_belt
    from ..generator.datasets.fresh import FreshReferences
    from ..generator.predictions.predict_settings import as_setting

    pair = (as_setting(low), as_setting(high))
    moving, told = twin_on_belt(as_twin(twin), pair)
    warnings += told
    source = FreshReferences(moving, references.path, low=pair[0], high=pair[1], seed=seed)
    warnings += source.warnings

    def images(number: int, epoch: int) -> "NDArray[np.float32]":
        return source.log_images(number, epoch=epoch)

    return images, {"twin_sha256": twin_sha256(twin), "low": str(pair[0]), "high": str(pair[1])}


def _use_threads(threads: int | None) -> None:
    """Let torch use that many processor threads; None leaves all."""
    if threads is None:
        return
    if threads < 1:
        raise InputError("threads", received=threads, expected="a whole number, 1 or more")
    from ..segmentation._torch import load_torch

    load_torch().set_num_threads(threads)


def detect(
    runs: "TrainedNetworks | PathLike | Segmenter | Sequence[Segmenter | PathLike]",
    dataset: "Pairs",
    *,
    output: PathLike | None = None,
    split: str | None = None,
    setting: str | None = None,
    threshold: float = 0.5,
    scaling: str | None = None,
    probabilities: bool = False,
    classes: str | None = None,
    network: Any = None,
    device: str = "auto",
    threads: int | None = None,
    progress: Progress | bool | None = None,
) -> Detections:
    """Every network tried on every image: hit or miss, false alarm or not.

    A pixel is marked where the network's probability is above the threshold. An object is detected when more than a tenth of
    its pixels are marked; an image without one is a false alarm when any pixel is.

    Args:
        runs: what `train` returned, or its folder; or networks made elsewhere, one or several: a torch module, an ONNX file
            (`.onnx`), or a function of log images (image, 2, row, column) that gives probabilities (image, row, column).
        dataset: a dataset file, an open one, or what `generate` returned.
        output: the hit/miss table to write (CSV); None: none.
        split: `train`, `val`, `test` or `all`; None: `test`, and all where the file has none and is not the one trained on.
        setting: only images of this setting, as the file names it.
        threshold: probability above which a pixel is marked, 0 or more and below 1.
        scaling: of the images that a torch module or an ONNX file was trained on, `min_max`, `residual` or `matched:DEGREES`;
            None: log images.
        probabilities: whether a torch module or an ONNX file gives these; False: logits.
        classes: of a torch module or an ONNX file with several, the last of them the foreign object: `exclusive` (a softmax) or
            `independent` (a sigmoid of the last); None: exclusive, with a line in `warnings`.
        network: the module, or the function that makes it, that the folder's networks were trained with.
        device, threads: as for `train`.
        progress: True for a bar, or a function of (stage, done, total).

    Returns:
        The table; `fit_pod` takes it.

    Raises:
        InputError: no finished network, no such images, a threshold out of range, an answer that is no probability.
        MissingDependencyError: the extra `segmentation` (of ONNX files `onnx`) is not installed.

    Example:
        >>> runs = rt.train("references.h5", "networks", networks=1, steps=2, batch=2, crop_px=32, seed=1)
        >>> found = rt.detect(runs, "references.h5", split="all")
        >>> set(found.to_dataframe()["hit"]) <= {0, 1}
        True
        >>> import numpy as np
        >>> blind = rt.detect(lambda images: np.zeros_like(images[:, 0]), "references.h5", split="all")
        >>> int(blind.to_dataframe()["hit"].sum())
        0
    """
    from ..segmentation import summarise_detections, write_detections

    if split is not None and split not in SPLITS:
        raise InputError("split", received=repr(split), expected="one of " + ", ".join(SPLITS))
    check_not_read(output, read=(runs, dataset))
    warnings: list[str] = []
    meant: dict[str, Any] = {"scaling": scaling, "probabilities": probabilities, "classes": classes}
    if network is not None and not isinstance(runs, TrainedNetworks | str | os.PathLike):
        raise InputError(
            "network", received="given beside networks made elsewhere", expected="a folder of networks with it"
        )
    foreign = _segmenters(runs, meant, device=device, threads=threads, warn=warnings.append)
    with _as_dataset(dataset) as images, Telling(progress, unit="image") as telling:
        words: dict[str, Any] = {"threshold": threshold, "progress": telling.advance, "warn": warnings.append}
        if foreign is not None:
            from ..segmentation import detect_with_segmenters

            networks = list(foreign)
            numbers = _numbers(images, split=split, setting=setting, trained_on=False, warnings=warnings)
            telling.begin("detecting", len(numbers) * len(networks))
            rows = tuple(detect_with_segmenters(foreign, images, numbers, **words))
        else:
            from ..files import sha256_of_file
            from ..segmentation import choose_device, detect_with_networks, finished_networks, open_runs

            folder = open_runs(runs.path if isinstance(runs, TrainedNetworks) else runs)  # type: ignore[arg-type]
            _use_threads(threads)
            where = choose_device(device)
            trained_on = sha256_of_file(images.path) == folder.configuration["dataset_sha256"]
            numbers = _numbers(images, split=split, setting=setting, trained_on=trained_on, warnings=warnings)
            networks = finished_networks(folder)
            unfinished = len(list(folder.path.glob("network_*/state.pt")))
            if unfinished:
                warnings.append(f"{unfinished} networks of {folder.path} are not finished and are left out")
            telling.begin("detecting", len(numbers) * len(networks))
            rows = tuple(detect_with_networks(folder, images, numbers, device=where, network=network, **words))
    unknown = sum(row.recall is not None and row.contrast is None and row.size_mm is None for row in rows)
    if unknown:
        warnings.append(
            f"{unknown} lines have a foreign object of unknown contrast and size: no POD curve can be fitted to them"
        )
    if output is not None:
        write_detections(output, rows)
    return Detections(
        rows=rows,
        path=None if output is None else Path(output),
        networks=tuple(networks),
        threshold=threshold,
        rates=summarise_detections(rows),
        warnings=tuple(warnings),
    )


def _segmenters(
    given: Any, meant: Mapping[str, Any], *, device: str, threads: int | None, warn: Callable[[str], None]
) -> "dict[int, Segmenter] | None":
    """Networks made elsewhere, by number; None where a folder of raytwin's own was given.

    meant: scaling, probabilities and classes, what images and answers of a torch module or an ONNX file mean.
    """
    several = list(given) if isinstance(given, list | tuple) else [given]
    one_file = isinstance(given, str | os.PathLike) and Path(given).suffix.lower() != ".onnx"
    if isinstance(given, TrainedNetworks) or one_file:
        if any(meant.values()):
            raise InputError(
                "scaling, probabilities and classes",
                received="given with networks that raytwin trained",
                expected="none: their recipe says all three",
            )
        return None
    if not several:
        raise InputError("runs", received="an empty list", expected="one network or more")
    found: dict[int, Segmenter] = {}
    for number, one in enumerate(several):
        if isinstance(one, str | os.PathLike):
            from ..segmentation import segmenter_from_onnx

            found[number] = segmenter_from_onnx(one, warn=warn, **meant)
        elif hasattr(one, "state_dict") and hasattr(one, "eval"):
            from ..segmentation import choose_device, segmenter_from_module

            _use_threads(threads)
            where = choose_device(device)
            found[number] = segmenter_from_module(one, device=where, warn=warn, **meant)
        elif callable(one):
            found[number] = one
        else:
            raise InputError(
                "runs",
                received=type(one).__name__,
                expected="a folder of networks, a torch module, an ONNX file or a function of images",
            )
    return found


def _numbers(
    dataset: "Dataset", *, split: str | None, setting: str | None, trained_on: bool, warnings: list[str]
) -> "NDArray[np.intp] | Sequence[int]":
    chosen = split or "test"
    numbers = dataset.indices(split=None if chosen == "all" else chosen, setting=setting)
    if not len(numbers) and split is None and not trained_on:
        numbers = dataset.indices(setting=setting)
        warnings.append(f"{dataset.path} has no images of split test: all {len(numbers)} are tried")
    if not len(numbers):
        settings = sorted({row.setting for row in dataset.rows})
        raise InputError(
            dataset.path,
            received=f"no images of split {chosen}" + (f" at {setting}" if setting else ""),
            expected="at least one; its settings are " + " | ".join(settings),
            remedy="choose with split and setting",
        )
    if trained_on and chosen in ("train", "all"):
        warnings.append("these networks were trained on some of these images: the rates are too good")
    return numbers
