"""Measurements in other layouts, turned into the files that all else takes."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, check_number
from ..files import check_not_read, given_path
from ..results import Result, Table, counted, frame, plain
from ._given import PathLike, as_twin, generator_of
from ._progress import Progress, Telling

if TYPE_CHECKING:
    import numpy as np
    import pandas

    from ..acquisition.import_report import ImportReport, Skipped
    from ..checks.findings import Finding
    from ..generator.line.twin import Twin

# layout -> what it is; each has its module in `raytwin.acquisition`
LAYOUTS = {
    "images": "a folder of TIFF, PNG, FITS, DICOM, HIS, EDF or raw images with a sidecar",
    "dicom": "DICOM or DICONDE images: a folder, or one file",
    "xtekct": "a Nikon .xtekct file with its projections",
    "nxtomo": "a NeXus NXtomo file",
    "emva1288": "a folder with EMVA1288_Data.txt",
    "zenodo": "the paper's data: processed images, a raw session or calibration flats",
    "reference": "dual-energy images with masks: a folder with a sidecar, or an acquisition file",
}
# layout -> its own words
WORDS = {
    "images": ("sidecar",),
    "nxtomo": ("detector",),
    "xtekct": ("exposure_ms",),
    "zenodo": ("select", "kV", "exposure_ms"),
    "reference": ("sidecar", "low", "high", "each_frame", "ring_px", "validation", "test"),
}
_ABOVE_ZERO = {"exposure_ms": "ms", "kV": "kV"}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Imported(Result):
    """What an import read and wrote.

    Fields: written (the new file); format (`acquisition` or `dataset`); layout; source; read (a mapping a series or setting: name
    and what is known of it); frames; skipped (`what` and `reason`); notes (assumptions that were made); findings (of
    `rt.check`, those that matter; none of a dataset).
    """

    written: Path
    format: str
    layout: str
    source: str
    read: tuple[Mapping[str, Any], ...]
    frames: int
    skipped: tuple["Skipped", ...]
    notes: tuple[str, ...]
    findings: tuple["Finding", ...]

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin import --json` prints."""
        told: dict[str, Any] = {
            "layout": self.layout,
            "source": self.source,
            "written": self.written,
            "format": self.format,
            "read": self.read,
            "frames": self.frames,
            "skipped": [asdict(item) for item in self.skipped],
            "notes": self.notes,
        }
        if self.format == "acquisition":
            told["findings"] = [item.to_dict() for item in self.findings]
        found: dict[str, Any] = plain(told)
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a series or setting."""
        return frame([dict(item) for item in self.read])

    def _table(self) -> Table:
        rows = tuple(
            (str(item.get("name", "")), ", ".join(f"{key} {value}" for key, value in item.items() if _says(key, value)))
            for item in self.read
        )
        notes = [f"{item.severity}: {item.series + ': ' if item.series else ''}{item.text}" for item in self.findings]
        notes += [f"skipped {item.what}: {item.reason}" for item in self.skipped]
        notes += [f"note: {text}" for text in self.notes]
        title = f"{self.written}: {self.format} file, {counted(self.frames, 'frame')} from {self.source}"
        return Table(title=title, rows=rows, notes=tuple(notes))


def import_data(
    source: PathLike,
    output: PathLike,
    *,
    layout: str = "images",
    twin: "Twin | PathLike | None" = None,
    seed: "int | np.random.Generator" = 0,
    progress: Progress | bool | None = None,
    **words: Any,
) -> Imported:
    """Turn measurements in another layout into an acquisition file, or into a dataset of reference images.

    Args:
        source: folder or file.
        output: file to write (HDF5), whole or not at all.
        layout: `images` (a folder with a sidecar `raytwin.toml`), `dicom`, `xtekct`, `nxtomo`, `emva1288`, `zenodo`, `reference`.
        twin: of `reference`: replaces the bad pixels that this twin knows.
        seed: of `reference`: a whole number or a generator, for the split of the products.
        progress: True for a bar, or a function of (stage, done, total).
        **words: of the layout. `images`: sidecar; `nxtomo`: detector; `xtekct`: exposure_ms; `zenodo`: select, kV, exposure_ms;
            `reference`: sidecar, low and high (settings), each_frame, ring_px, validation and test (shares of the products).

    Returns:
        What was read, what was skipped and why, and what of it is suspicious.

    Raises:
        InputError: an unknown layout or word, nothing to read, a sidecar that does not fit the images.
        FileFormatError: a file that is none of the layout.

    Example:
        >>> found = rt.import_data("frames", "frames.h5")
        >>> found.format, found.frames
        ('acquisition', 4)
    """
    if not isinstance(layout, str) or layout not in LAYOUTS:
        raise InputError("layout", received=repr(layout), expected="one of " + ", ".join(LAYOUTS))
    given_path(source, expected="a folder or file to import", argument="source")
    given_path(output, expected="a file to write", argument="output")
    check_not_read(output, read=(source, twin))
    work = getattr(import_module(f"..acquisition.{layout}", __package__), f"import_{layout}")
    given = _words(layout, words)
    if layout == "reference":
        known = None if twin is None else as_twin(twin).maps.bad_pixels > 0
        work = partial(work, rng=generator_of(seed), bad_pixels=known)
    elif twin is not None:
        raise InputError("twin", received=f"one for layout {layout}", expected="one for layout reference alone")
    with Telling(progress, unit="image") as telling:

        def step(done: int, total: int) -> None:
            telling.begin(layout, total, done=done)

        report: ImportReport = work(source, output, progress=step, **given)
    notes = report.notes
    findings: tuple[Finding, ...] = ()
    if report.format == "acquisition":
        from ..acquisition import open_acquisition
        from ..checks.check import check_acquisition

        findings = tuple(item for item in check_acquisition(report.written).findings if item.severity != "note")
        with open_acquisition(report.written) as acquisition:
            notes = (*notes, *(line for line in acquisition.missing if line not in notes))
    return Imported(
        written=Path(report.written),
        format=report.format,
        layout=report.layout,
        source=report.source,
        read=report.read,
        frames=report.frames,
        skipped=report.skipped,
        notes=notes,
        findings=findings,
    )


def _words(layout: str, words: Mapping[str, Any]) -> dict[str, Any]:
    """A layout's own words as its function calls them, settings read and numbers checked."""
    names = WORDS.get(layout, ())
    given: dict[str, Any] = {}
    for name, value in words.items():
        if name not in names:
            known = "one of " + ", ".join(names) if names else "no further words"
            raise InputError(name, received=f"a word of layout {layout}", expected=known)
        if name == "sidecar" and value is not None:
            given_path(value, expected="a sidecar", argument=name)
        if name in ("ring_px", "validation", "test") and value is not None:
            check_number(name, value)
        if name in _ABOVE_ZERO and value is not None:
            unit = _ABOVE_ZERO[name]
            check_number(name, value, unit=unit)
            if not 0 < value < float("inf"):
                raise InputError(name, received=f"{value} {unit}", expected=f"a finite value above 0 {unit}")
        given["dilations" if name == "ring_px" else name] = _setting(value) if name in ("low", "high") else value
    return given


def _setting(value: Any) -> Any:
    from ..generator.predictions.predict_settings import as_setting

    return None if value is None else as_setting(value)


def _says(key: str, value: Any) -> bool:
    return key != "name" and value not in (None, "", ())
