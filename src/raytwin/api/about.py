"""What is installed, what a twin is, and the twin in the form that other simulators read."""

import importlib.metadata
import importlib.util
import os
import platform
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import FileFormatError, InputError
from ..files import given_path
from ..results import Result, Table, plain
from ._folder import written_folder
from ._given import PathLike, as_any_twin, as_twin, twin_path
from ._progress import Progress, Telling

if TYPE_CHECKING:
    from ..acquisition.acquisition_io import AcquisitionFile
    from ..acquisition.dataset_io import Dataset
    from ..acquisition.setting import Setting
    from ..generator.line.twin import Twin
    from ..generator.predictions.tube_twin import TubeTwin

_EXTRAS = {
    "explore": ("bokeh",),
    "segmentation": ("torch", "segmentation_models_pytorch"),
    "onnx": ("onnxruntime",),
    "cluster": ("dask", "distributed"),
    "fits": ("astropy",),
    "dicom": ("pydicom",),
    "fabio": ("fabio",),
    "meshes": ("trimesh",),
    "zarr": ("zarr",),
}
# forms that no twin is written in, and what is
_NOT_OF_TWINS = {
    "coco": "dataset",
    "yolo": "dataset",
    "tiff": "dataset or acquisition",
    "zarr": "dataset or acquisition",
    "nxtomo": "acquisition",
    "dicom": "acquisition",
}
_LIBRARIES = (
    "numpy",
    "scipy",
    "h5py",
    "numba",
    "spekpy",
    "xraylib",
    "xraydb",
    "statsmodels",
    "pandas",
    "torch",
    "dask",
)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Info(Result):
    """The installation.

    Fields: version (of raytwin); python (its version); extras (name -> installed); libraries (name -> version, None: absent);
    cache (folder of spectra), cache_bytes (its size); devices (that networks can train on); processors (number of cores);
    calibrations (names of shipped twins).
    """

    version: str
    python: str
    extras: Mapping[str, bool]
    libraries: Mapping[str, str | None]
    cache: str
    cache_bytes: int
    devices: tuple[str, ...]
    processors: int
    calibrations: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin info --json` prints."""
        found: dict[str, Any] = plain({name: getattr(self, name) for name in self.__slots__})
        return found

    def _table(self) -> Table:
        rows = [
            ("Python", self.python),
            *(
                (f"extra {name}", "installed" if there else f"absent: pip install 'raytwin[{name}]'")
                for name, there in self.extras.items()
            ),
            ("devices", ", ".join(self.devices)),
            ("processors", str(self.processors)),
            ("cache of spectra", f"{self.cache} ({self.cache_bytes / 2**20:.1f} MB)"),
            ("shipped twins", ", ".join(self.calibrations) or "none"),
            ("libraries", ", ".join(f"{name} {version}" for name, version in self.libraries.items() if version)),
        ]
        return Table(title=f"raytwin {self.version}", rows=tuple(rows))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Exported(Result):
    """Files that were written for another program.

    Fields: to (the form, such as `coco`); folder; files (name -> what it holds); warnings.
    """

    to: str
    folder: Path
    files: Mapping[str, str]
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin export --json` prints."""
        found: dict[str, Any] = plain(
            {"to": self.to, "folder": self.folder, "files": self.files, "warnings": self.warnings}
        )
        return found

    def _table(self) -> Table:
        return replace(self.table(), notes=tuple(f"warning: {text}" for text in self.warnings))

    def table(self) -> Table:
        """The files, each with what it holds."""
        return Table(title=f"{self.folder}, for {self.to}", rows=tuple(self.files.items()))


def info(twin: "Twin | TubeTwin | PathLike | None" = None) -> "Info | Twin | TubeTwin":
    """The installation: version, extras, libraries, cache, devices; or a twin, whose `repr` is its table.

    Args:
        twin: a twin, its file, or a shipped calibration's name; None: the installation.

    Raises:
        FileFormatError: a file that is no twin.

    Example:
        >>> rt.info().version == rt.__version__
        True
        >>> rt.info("twin.h5").instrument.pixel_mm
        0.45
    """
    if twin is not None:
        return as_any_twin(twin)
    from .. import __version__
    from ..generator.twins.shipped import shipped_calibrations
    from ..spectra._cache import cache_folder

    folder = cache_folder()
    size = 0
    if folder is not None and folder.is_dir():
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return Info(
        version=__version__,
        python=f"{platform.python_version()} on {platform.system()} {platform.machine()}",
        extras={name: all(map(_there, modules)) for name, modules in _EXTRAS.items()},
        libraries={name: _version(name) for name in _LIBRARIES},
        cache="none" if folder is None else str(folder),
        cache_bytes=size,
        devices=_devices(),
        processors=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        calibrations=tuple(name for name, path in shipped_calibrations().items() if path.suffix == ".h5"),
    )


def _there(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _devices() -> tuple[str, ...]:
    if not _there("torch"):
        return ("cpu (torch is not installed)",)
    import torch

    found = ["cpu"]
    if torch.cuda.is_available():
        found += [f"cuda: {torch.cuda.get_device_name(number)}" for number in range(torch.cuda.device_count())]
    if torch.backends.mps.is_available():
        found.append("mps")
    return tuple(found)


def export(
    source: "Twin | Dataset | AcquisitionFile | PathLike",
    output: PathLike,
    *,
    to: str,
    settings: "Setting | str | Sequence[Setting | str] | None" = None,
    labels: str = "polygons",
    bits: int | None = None,
    pixel_mm: float | None = None,
    progress: Progress | bool | None = None,
) -> Exported:
    """A twin for other simulators, a dataset for other trainers, an acquisition for other viewers.

    Args:
        source: a twin with a spectral part, its file, or a shipped calibration's name; or a dataset or an acquisition,
            open or its file.
        output: folder to write; of a dataset or an acquisition, a new or empty one.
        to: of a twin `csv`, `gvxr` (gVirtualXray's JSON), `xcist` (gecatsim's spectrum and configuration files) or `leap`; of a
            dataset `coco`, `yolo`, `tiff` or `zarr`; of an acquisition `tiff`, `nxtomo`, `dicom` or `zarr`.
        settings: of a twin, that the spectra are written for; None: the measured kV and filters, at 1 mAs.
        labels: of YOLO: `polygons` or `boxes`.
        bits: of a grey value for trainers, 8 or 16; None: 8 for YOLO, 16 for COCO.
        pixel_mm: pitch (mm) for the tags of a dataset's TIFF; None: the dataset's own, where it states one.
        progress: True for a bar, or a function of (stage, done, total).

    Returns:
        What was written.

    Raises:
        InputError: another form, a twin without spectral part, a setting that the twin cannot have, a folder with something
            in it.

    Example:
        >>> written = rt.export("twin.h5", "for_others", to="csv")
        >>> sorted(written.files)[:2]
        ['levels.csv', 'noise.json']
    """
    from ..acquisition import acquisition_io, dataset_io
    from ..acquisition._acquisition_words import FORMAT as ACQUISITION_FORMAT
    from ..acquisition._hdf5 import format_of_file

    folder = given_path(output, expected="a folder", argument="output")
    with ExitStack() as stack:
        opened: Any = source
        if isinstance(source, str | os.PathLike):
            kind = format_of_file(source)
            if kind == dataset_io.FORMAT:
                opened = stack.enter_context(dataset_io.read_dataset(source))
            elif kind == ACQUISITION_FORMAT:
                opened = stack.enter_context(acquisition_io.open_acquisition(source))
            elif kind is None and to in _NOT_OF_TWINS and not twin_path(source).exists():
                raise FileFormatError("source", received=source, expected=f"an existing {_NOT_OF_TWINS[to]} file")
        is_dataset = isinstance(opened, dataset_io.Dataset)
        is_acquisition = isinstance(opened, acquisition_io.AcquisitionFile)
        if (is_dataset or is_acquisition) and settings is not None:
            raise InputError("settings", received=str(settings), expected="none: only a twin is exported for settings")
        if (is_dataset or is_acquisition) and to == "zarr":
            from ..acquisition.export_zarr import export_zarr

            telling = stack.enter_context(Telling(progress, unit="image"))
            files, warnings = export_zarr(
                opened.path, folder, progress=lambda done, total: telling.begin("images", total, done=done)
            )
            return Exported(to=to, folder=folder, files=files, warnings=warnings)
        if is_dataset:
            from ..acquisition.export_dataset import export_dataset

            telling = stack.enter_context(Telling(progress, unit="pair"))
            telling.begin("images", len(opened))
            images = export_dataset(
                opened,
                folder,
                to=to,
                labels=labels,
                bits=bits,
                pixel_mm=pixel_mm,
                progress=lambda done, _: telling.reach(done),
            )
            return Exported(to=to, folder=folder, files=images.files, warnings=images.warnings)
        if is_acquisition:
            from ..acquisition.export_acquisition import export_acquisition

            telling = stack.enter_context(Telling(progress, unit="frame"))
            telling.begin("frames", sum(series.n_frames for series in opened.series))
            files, warnings = export_acquisition(opened, folder, to=to, progress=lambda done, _: telling.reach(done))
            return Exported(to=to, folder=folder, files=files, warnings=warnings)
    from ..generator.twins.export import export_twin

    with written_folder(folder):
        files, warnings = export_twin(as_twin(opened), folder, to=to, settings=settings)
    return Exported(to=to, folder=folder, files=files, warnings=warnings)
