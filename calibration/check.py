"""What an acquisition, a folder of measurements or a twin allows, what is suspicious, and what to measure next.

Nothing is fitted: each series is read once, in pieces, and compared with its labels and with the others.
"""

import math
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile, Series, open_acquisition
from ..acquisition.import_any import draft_sidecar, import_folder, layout_of
from ..acquisition.pairs import object_pairs
from ..acquisition.setting import text_from_filters
from ..errors import FileFormatError, InputError
from ..files import given_path
from ..generator.predictions.tube_twin import NO_DETECTOR, NO_OUTPUT, TubeTwin
from ..generator.twins.twin_io import FORMAT as TWIN_FORMAT
from ..generator.twins.twin_io import read_any_twin
from ..results import Result, Table, counted, frame, plain
from . import frame_signs
from .findings import Finding, FindingCode, Severity
from .frame_checks import LEVEL_CHANGE, SceneChange
from .label_checks import beam_findings, clock_findings, kind_findings, load_findings
from .series_scan import SeriesScan, scan_series

if TYPE_CHECKING:
    import pandas

_JUMP = 0.03  # of the signal from one frame to the next: the largest plausible rms of a tube's output
_EVEN = 3e-3  # pixels of raw flats respond less alike than this (rms): panels by 0.5 % and more, a CCD under even light by 0.43 %
_HOW = {
    SceneChange.STRUCTURE: "edges have moved in {share:.0f} % of the field",
    SceneChange.SHAPE: "the shape of the field changes by {shape:.0f} %",
    SceneChange.LINES: "whole rows or columns change, as behind a shutter",
    SceneChange.LEVEL: "the level changes by {level:+.0f} %",
}
_LIT = ("flat", "object")
_PATTERN_BYTES = 2**28

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesRow:
    """One series in the table of a check.

    Fields: name; kind; setting (in words; empty: nothing is known); frames; averaged; shape (row, column); level_DN (median
    of its mean frame; None: not read); noise_DN (temporal, of one frame as stored; None: not known); serves_for (what it is
    good for).
    """

    name: str
    kind: str
    setting: str
    frames: int
    averaged: int
    shape: tuple[int, int]
    level_DN: float | None
    noise_DN: float | None
    serves_for: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {name: getattr(self, name) for name in self.__slots__} | {
            "shape": list(self.shape),
            "serves_for": list(self.serves_for),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Allowed:
    """One thing that can be learnt or done, or cannot: what; possible; why (from which series, or what is missing)."""

    what: str
    possible: bool
    why: str

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"what": self.what, "possible": self.possible, "why": self.why}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class CheckResult(Result):
    """The answer of a check.

    Fields: path; what (`acquisition`, `twin`, or the layout of a folder); series; findings (errors first); allows;
    next_measurements (most useful first); draft (a sidecar to start from, of a folder that has none; else empty).
    """

    path: str
    what: str
    series: tuple[SeriesRow, ...]
    findings: tuple[Finding, ...]
    allows: tuple[Allowed, ...]
    next_measurements: tuple[str, ...]
    draft: str = ""

    @property
    def counts(self) -> dict[str, int]:
        """Findings by severity."""
        return {str(one): sum(item.severity is one for item in self.findings) for one in Severity}

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a finding: code, series, text, severity."""
        return frame(self.to_dict()["findings"], columns=("code", "series", "text", "severity"))

    def _table(self) -> Table:
        counts = self.counts
        told = ", ".join(f"{count} {name}{'s' * (count != 1)}" for name, count in counts.items())
        able = [item for item in self.allows if item.possible]
        rows = tuple((str(item.severity), item.series, item.text) for item in self.findings)
        title = f"{self.path}: {self.what}, {len(self.series)} series; {told}"
        notes = [
            f"{len(able)} of {len(self.allows)} things are possible",
            *(f"next: {text}" for text in self.next_measurements[:2]),
        ]
        return Table(
            title=title, header=("severity", "series", "finding") if rows else (), rows=rows, notes=tuple(notes)
        )

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin check --json` prints."""
        found: dict[str, Any] = plain(self._answer())
        return found

    def _answer(self) -> dict[str, Any]:
        return {
            "path": self.path,
            "what": self.what,
            "series": [row.to_dict() for row in self.series],
            "findings": [item.to_dict() for item in self.findings],
            "allows": [item.to_dict() for item in self.allows],
            "next_measurements": list(self.next_measurements),
            "draft": self.draft or None,
        }


def check_acquisition(path: str | os.PathLike[str], *, progress: Progress | None = None) -> CheckResult:
    """Check an acquisition file, a folder of measurements in a layout that can be imported, or a twin file.

    Args:
        path: the file or folder.
        progress: called with the name of each series.

    Returns:
        Series, findings, what is possible, what to measure next. Damage is a finding.

    Raises:
        InputError: no such file or folder.

    Example:
        >>> check_acquisition("session.h5").counts  # doctest: +SKIP
        {'error': 0, 'warning': 1, 'note': 2}
    """
    place = given_path(path, expected="an acquisition file, a folder of measurements or a twin")
    if not place.exists():
        raise InputError(
            str(path),
            received="no such file or folder",
            expected="an acquisition file, a folder of measurements or a twin",
        )
    if place.is_dir():
        return _checked_folder(place, progress)
    layout = layout_of(place)
    if layout is not None:
        return _checked_import(place, layout, progress)
    if _is_twin(place):
        return _checked_twin(place)
    return _checked_file(place, str(path), "acquisition", progress)


def _is_twin(path: Path) -> bool:
    from ..acquisition._hdf5 import open_hdf5, reading, text_attribute

    try:
        with open_hdf5(path, what="an acquisition file or a twin") as file, reading(str(path)):
            return text_attribute(file, "format", where=str(path)) == TWIN_FORMAT
    except FileFormatError:
        return False


def _broken(path: str, what: str, error: InputError, *, draft: str = "", place: Path | None = None) -> CheckResult:
    """Of what cannot be read at all."""
    code = FindingCode.NO_SIDECAR if draft else FindingCode.DAMAGED
    return CheckResult(
        path=path,
        what=what,
        series=(),
        findings=(Finding(code=code, values={"what": _one_line(error, place, path)}),),
        allows=(),
        next_measurements=(),
        draft=draft,
    )


def _one_line(error: Exception, place: Path | None = None, told: str = "") -> str:
    """The error's line; the file's own name is left out where it only says which part of the file is meant."""
    line = " ".join(str(error).split())
    return line if place is None else line.replace(f"{place}, ", "").replace(str(place), told)


def _checked_folder(place: Path, progress: Progress | None) -> CheckResult:
    layout = layout_of(place)
    if layout is None:
        draft = draft_sidecar(place)
        error = InputError(
            str(place),
            received="a folder that is in no layout known here",
            expected="images with a raytwin.toml, an EMVA 1288 set, a NeXus file, or the layout of the paper's data",
        )
        return _broken(str(place), "folder", error, draft=draft)
    return _checked_import(place, layout, progress)


def _checked_import(place: Path, layout: str, progress: Progress | None) -> CheckResult:
    """Import into a file that is thrown away, and check that."""
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "imported.h5"
        try:
            report = import_folder(place, written, layout=layout)
        except InputError as error:
            return _broken(str(place), layout, error)
        if report.format != "acquisition":
            return CheckResult(
                path=str(place),
                what=f"{layout} ({report.format})",
                series=(),
                findings=(),
                allows=(Allowed(what="networks and detection", possible=True, why=f"{report.frames} images"),),
                next_measurements=(),
            )
        return _checked_file(written, str(place), layout, progress)


def _checked_twin(place: Path) -> CheckResult:
    try:
        twin = read_any_twin(place)
    except InputError as error:
        return _broken(str(place), "twin", error)
    if isinstance(twin, TubeTwin):
        return _checked_tube(place, twin)
    rows = tuple(
        SeriesRow(
            name=", ".join(level.series),
            kind="level",
            setting=level.name,
            frames=0,
            averaged=1,
            shape=twin.maps.shape,
            level_DN=None,
            noise_DN=None,
            serves_for=("gain and noise at this beam",),
        )
        for level in twin.levels
    )
    spectral = twin.spectral
    voltages = sorted({level.kV for level in twin.levels if level.kV is not None})
    allows = [
        Allowed(
            what="noise and level at the calibrated beams",
            possible=bool(twin.levels),
            why=", ".join(level.name for level in twin.levels) or "no level",
        ),
        Allowed(
            what="other kV and filters",
            possible=spectral is not None,
            why="no spectral part: flats with kV, current and distance would give one"
            if spectral is None
            else f"calibrated at {', '.join(f'{kV:g}' for kV in voltages)} kV",
        ),
    ]
    suggested = twin.evidence.get("next_measurement")
    text = suggested.get("text") if isinstance(suggested, dict) else None
    return CheckResult(
        path=str(place),
        what="twin",
        series=rows,
        findings=tuple(Finding(code=FindingCode.TWIN_WARNING, values={"what": line}) for line in twin.warnings),
        allows=tuple(allows),
        next_measurements=(text,) if text else (),
    )


def _checked_tube(place: Path, twin: TubeTwin) -> CheckResult:
    low, high = twin.spectral.calibrated_kV
    return CheckResult(
        path=str(place),
        what="twin of a tube",
        series=(),
        findings=tuple(Finding(code=FindingCode.TWIN_WARNING, values={"what": line}) for line in twin.warnings),
        allows=(
            Allowed(
                what="spectrum, attenuation and contrast at any kV and filter",
                possible=True,
                why=f"calibrated at {low:g} to {high:g} kV",
            ),
            Allowed(
                what="air kerma",
                possible=twin.output_known,
                why="a dosimeter read it" if twin.output_known else NO_OUTPUT,
            ),
            Allowed(what="noise and level", possible=False, why=NO_DETECTOR),
        ),
        next_measurements=("flats and darks of the detector",),
    )


def _checked_file(place: Path, told: str, what: str, progress: Progress | None) -> CheckResult:
    damage: list[FileFormatError] = []
    try:
        acquisition = open_acquisition(place, damage=damage)
    except InputError as error:
        return _broken(told, what, error, place=place)
    with acquisition:
        checked = check_series(acquisition, progress=progress)
    damaged = [Finding(code=FindingCode.DAMAGED, values={"what": _one_line(error, place, told)}) for error in damage]
    return CheckResult(
        path=told,
        what=what,
        series=checked.series,
        findings=_ordered([*damaged, *checked.findings]),
        allows=checked.allows,
        next_measurements=checked.next_measurements,
    )


def _ordered(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    order = list(Severity)
    return tuple(sorted(findings, key=lambda item: order.index(item.severity)))


def check_series(acquisition: AcquisitionFile, *, progress: Progress | None = None) -> CheckResult:
    """Check the series of an open acquisition; see `check_acquisition`."""
    acquisition.check_open()
    findings: list[Finding] = []
    scans: dict[str, _Kept] = {}
    patterns: dict[str, list[_Pattern]] = {}
    digests: dict[bytes, str] = {}
    dark_DN = _dark_level(acquisition)
    for item in acquisition.series:
        if progress is not None:
            progress(item.name)
        try:
            scan = scan_series(item)
        except FileFormatError as error:
            # the series is named beside the sentence
            what = _one_line(error, Path(acquisition.path), acquisition.path).removeprefix(f"series {item.name}/")
            findings.append(Finding(code=FindingCode.DAMAGED, series=item.name, values={"what": what}))
            continue
        found = _series_findings(scan, acquisition, dark_DN)
        found += _copies_of_others(scan, digests)
        if not any(entry.code in _NO_PATTERN for entry in found):
            _keep_pattern(scan, dark_DN, patterns)
        findings += found
        codes = {entry.code for entry in found}
        scans[item.name] = _Kept(
            level_DN=scan.level_DN,
            noise_DN=math.sqrt(scan.variance_DN2) if scan.variance_DN2 >= 0 else math.nan,
            codes=codes,
        )
    for group in patterns.values():
        for finding in _pattern_findings(group):
            findings.append(finding)
            scans[finding.series].codes.add(finding.code)
    read = [item for item in acquisition.series if item.name in scans]
    findings += _session_findings(acquisition, read, scans, dark_DN)
    rows = tuple(_row(item, scans.get(item.name), findings) for item in acquisition.series)
    allows = _allows(acquisition, rows, findings)
    return CheckResult(
        path=acquisition.path,
        what="acquisition",
        series=rows,
        findings=_ordered(findings),
        allows=allows,
        next_measurements=_next(acquisition, rows, allows),
    )


# Frames of one value, and frames that are no detector numbers, have no pattern to compare.
_NO_PATTERN = frozenset({FindingCode.CONSTANT, FindingCode.LOGARITHMS, FindingCode.SATURATED})
_UNFIT = _NO_PATTERN | {
    FindingCode.SCENE_CHANGES,
    FindingCode.NO_LIGHT,
    FindingCode.DARK_WITH_LIGHT,
    FindingCode.DAMAGED,
    FindingCode.COMPRESSED,
    FindingCode.SAME_AS,
    FindingCode.SHAPES,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kept:
    """Of a series that has been read: level, temporal noise (NaN: unknown) and the codes of what was found."""

    level_DN: float
    noise_DN: float
    codes: set[FindingCode]


def _dark_level(acquisition: AcquisitionFile) -> float:
    """Level without light (DN), from the first frames of the darks; 0 where there are none."""
    levels = []
    for item in acquisition.of_kind("dark"):
        try:
            levels.append(float(np.median(item.read_frames(0, 1))))
        except FileFormatError:
            continue
    return min(levels) if levels else 0.0


def _series_findings(scan: SeriesScan, acquisition: AcquisitionFile, dark_DN: float) -> list[Finding]:
    """What the frames of one series show by themselves."""
    item = scan.series
    name = item.name
    counting = bool(acquisition.instrument.counting)
    lit = item.kind in _LIT
    offset_DN = 0.0 if item.corrected & {"offset", "log"} else dark_DN
    found: list[Finding] = []

    def add(code: FindingCode, **values: Any) -> None:
        found.append(Finding(code=code, series=name, values=values))

    if scan.constant:
        bits = acquisition.instrument.bits
        if lit and scan.level_DN in ({2.0**bits - 1} if bits else {2.0**one - 1 for one in (8, 10, 12, 14, 16)}):
            add(FindingCode.SATURATED, percent=100.0, top=scan.level_DN)
        elif not (counting and not lit and scan.level_DN == 0):
            add(FindingCode.CONSTANT, value=scan.level_DN)
        return found
    low, high = float(scan.values.min()), float(scan.values.max())
    if lit and scan.values.dtype.kind == "f" and high <= 20.0 and not item.corrected & {"gain", "log"} and not counting:
        add(FindingCode.LOGARITHMS, low=low, high=high)
        return found
    copies = scan.copies.copies()
    if copies:
        first = min(copies)
        add(FindingCode.COPIES, count=len(copies), frames=item.n_frames, first=first, origin=copies[first])
    top = frame_signs.pile_up_at_top(scan.values)
    bits = acquisition.instrument.bits
    if top is not None and lit and not counting:
        add(FindingCode.SATURATED, percent=100.0 * top[1], top=top[0])
    elif bits and lit and high >= 2**bits - 1 and float(np.mean(scan.values >= 2**bits - 1)) > 1e-3:
        add(FindingCode.SATURATED, percent=100.0 * float(np.mean(scan.values >= 2**bits - 1)), top=2.0**bits - 1)
    zeros = None if counting or item.corrected & {"log", "gain"} else frame_signs.share_at_zero(scan.values)
    if zeros is not None:
        add(FindingCode.CLIPPED, percent=100.0 * zeros)
    if item.kind == "dark" and "offset" not in item.corrected and low < 0:
        noise = math.sqrt(scan.variance_DN2) if scan.variance_DN2 > 0 else math.inf
        if abs(scan.level_DN) < noise:
            add(FindingCode.OFFSET_CORRECTED, level=scan.level_DN)
    step = frame_signs.code_step(scan.values)
    if step is not None:
        add(FindingCode.CODE_STEP, step=step)
    count = frame_signs.averaged_by_codes(scan.values) if not item.corrected else None
    if count is not None and count > item.averaged:
        add(FindingCode.AVERAGED, count=count, how=f"its numbers are multiples of 1/{count}", declared=item.averaged)
    if item.n_frames > 1 and not item.corrected and frame_signs.block_grid(scan.differences):
        add(FindingCode.COMPRESSED)
    scene = scan.scene.result(offset_DN=offset_DN, lit=lit)
    told = acquisition.scenes.get(item.scene)
    turning = told is not None and bool(told.attributes.get("turning"))
    if lit and scene.same is False and scene.change is not None and not turning:
        how = _HOW[scene.change].format(
            share=100.0 * scene.changed_share, shape=100.0 * scene.shape_change, level=100.0 * scene.level_change
        )
        add(FindingCode.SCENE_CHANGES, frame=scene.frame, how=how)
    elif lit and item.n_frames > 2 and not turning:
        jump = _level_jump(scan, offset_DN)
        if jump is not None:
            add(FindingCode.LEVEL_JUMP, frame=jump[0], percent=100.0 * jump[1])
    raw = not item.corrected & {"gain", "log"} and not any(one.code is FindingCode.SATURATED for one in found)
    if item.kind == "flat" and raw and item.n_frames > 1:
        uneven = frame_signs.most_uneven(scan.mean_DN - offset_DN, scan.differences, item.n_frames)
        if uneven < _EVEN:
            add(FindingCode.FLAT_CORRECTED, percent=100.0 * uneven)
    return found


def _level_jump(scan: SeriesScan, offset_DN: float) -> tuple[int, float] | None:
    """Frame and relative size of the largest change of level between successive frames that is no flicker."""
    signal = scan.frame_mean_DN - offset_DN
    typical = float(np.median(signal))
    if not typical > 0:
        return None
    steps = np.diff(signal) / typical
    at = int(np.argmax(np.abs(steps)))
    usual = 1.4826 * float(np.median(np.abs(steps)))
    # a jump lasts: flicker comes back
    lasting = float(np.mean(signal[at + 1 :]) - np.mean(signal[: at + 1])) / typical
    large = abs(steps[at]) > max(_JUMP, 6.0 * usual) and abs(lasting) > 0.5 * _JUMP
    return (at + 1, float(steps[at])) if large and abs(steps[at]) < LEVEL_CHANGE else None


def _copies_of_others(scan: SeriesScan, digests: dict[bytes, str]) -> list[Finding]:
    """Frames that an earlier series holds too; remembers this one's."""
    name = scan.series.name
    if scan.constant:
        return []
    shared: dict[str, int] = {}
    for digest in set(scan.copies.digests):
        other = digests.setdefault(digest, name)
        if other != name:
            shared[other] = shared.get(other, 0) + 1
    # frames of next to no noise are equal by chance
    quiet = not scan.variance_DN2 > 0.05 and scan.series.n_frames > 1
    if not shared or quiet:
        return []
    other = max(shared, key=lambda one: shared[one])
    # one mean dark kept for each of several exposure times is no mistake of the user's
    if scan.series.kind == "dark" and scan.series.n_frames == 1:
        return []
    return [Finding(code=FindingCode.SAME_AS, series=name, values={"count": shared[other], "other": other})]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pattern:
    """Fixed pattern of a series' mean frame (row, column), and its signal over its noise."""

    name: str
    values: NDArray[np.float16]
    quality: float


def _keep_pattern(scan: SeriesScan, dark_DN: float, patterns: dict[str, list[_Pattern]]) -> None:
    """Remember the pattern of a flat or dark, while they fit into `_PATTERN_BYTES`."""
    item = scan.series
    if item.kind not in ("flat", "dark") or item.panel_rotation_deg or item.corrected & {"gain", "log"}:
        return
    if 2 * scan.mean_DN.size * (1 + sum(len(group) for group in patterns.values())) > _PATTERN_BYTES:
        return
    noise = math.sqrt(scan.variance_DN2 / item.n_frames) if scan.variance_DN2 > 0 else 1.0
    signal = scan.level_DN - dark_DN if item.kind == "flat" and "offset" not in item.corrected else 1.0
    patterns.setdefault(f"{item.kind} {item.layer or ''} {item.session}", []).append(
        _Pattern(
            name=item.name,
            values=frame_signs.pattern_of(scan.mean_DN).astype(np.float16),
            quality=signal / noise,
        )
    )


def _pattern_findings(patterns: Sequence[_Pattern]) -> list[Finding]:
    """Whether the pixels' pattern lies alike in series of one kind: not turned, moved, nor with rows swapped.

    The clearest is the reference, unless most of the others contradict it: then it is the one at fault.
    """
    ranked = sorted(patterns, key=lambda one: -one.quality)
    for number, reference in enumerate(ranked[:2]):
        found = []
        others = [one for one in ranked if one is not reference]
        for one in others:
            finding = _against(one, reference)
            if finding is not None:
                found.append(finding)
        if number or len(found) <= 0.5 * len(others) or len(others) < 2:
            return found
    return []


def _against(one: _Pattern, reference: _Pattern) -> Finding | None:
    """How a pattern lies otherwise than the reference; None: as far as can be seen, it does not."""
    own, there = one.values.astype(np.float32), reference.values.astype(np.float32)
    values: dict[str, Any] = {"other": reference.name}
    turned = frame_signs.turned_pattern(own, there)
    if turned is not None:
        return Finding(code=FindingCode.TURNED, series=one.name, values=values | {"how": turned})
    moved = frame_signs.shifted_pattern(own, there)
    if moved is not None:
        values |= {"rows": moved[0], "columns": moved[1]}
        return Finding(code=FindingCode.SHIFTED, series=one.name, values=values)
    rows = frame_signs.swapped_rows(own, there)
    if rows is not None:
        values |= {"first": rows[0], "second": rows[1]}
        return Finding(code=FindingCode.ROWS_SWAPPED, series=one.name, values=values)
    return None


def _session_findings(
    acquisition: AcquisitionFile, read: Sequence[Series], scans: dict[str, _Kept], dark_DN: float
) -> list[Finding]:
    """What the series say of each other and of their labels."""
    found: list[Finding] = []
    kinds = {item.kind for item in acquisition.series}
    corrected = [item for item in acquisition.of_kind("flat") if "offset" in item.corrected]
    if "flat" not in kinds:
        found.append(Finding(code=FindingCode.NO_FLAT))
    elif "dark" not in kinds and not acquisition.instrument.counting and not corrected:
        found.append(Finding(code=FindingCode.NO_DARK))
    imaged = [item for item in read if item.kind in ("dark", "flat")]
    for item in imaged[1:]:
        reference = imaged[0]
        if item.shape != reference.shape:
            found.append(
                Finding(
                    code=FindingCode.SHAPES,
                    series=item.name,
                    values={
                        "shape": " x ".join(map(str, item.shape)),
                        "other": reference.name,
                        "other_shape": " x ".join(map(str, reference.shape)),
                    },
                )
            )
    levels = {name: kept.level_DN for name, kept in scans.items()}
    noise = {name: kept.noise_DN for name, kept in scans.items()}
    found += kind_findings([item for item in read if not scans[item.name].codes & _NO_PATTERN], levels, noise)
    unfit = {entry.series for entry in found}
    # without a dark nobody knows what is signal
    known = any(item.kind == "dark" for item in read) or bool(acquisition.instrument.counting)
    flats = [
        item
        for item in read
        if item.kind == "flat"
        and (known or "offset" in item.corrected)
        and not item.corrected & {"gain", "log"}
        and item.name not in unfit
        and not scans[item.name].codes & _UNFIT
    ]
    signals = _signals([item for item in read if item.name not in unfit], flats, levels, dark_DN)
    wrong = load_findings(flats, signals)
    found += wrong
    fitting = [item for item in flats if item.name not in {entry.series for entry in wrong}]
    found += beam_findings(fitting, signals)
    found += clock_findings(read)
    found += _averaged_findings(fitting, signals, scans, acquisition)
    found += [
        Finding(code=FindingCode.SINGLE_FRAME, series=item.name)
        for item in read
        if item.kind == "flat" and item.n_frames == 1 and item.averaged == 1
    ]
    spoken = {"no dark", "no flat"}
    found += [
        Finding(code=FindingCode.MISSING, values={"what": line})
        for line in acquisition.missing
        if not any(line.startswith(words) for words in spoken)
    ]
    return found


def _signals(
    usable: Sequence[Series], flats: Sequence[Series], levels: dict[str, float], dark_DN: float
) -> dict[str, float]:
    """Level above the dark of the same exposure, or of the nearest, DN."""
    darks = [item for item in usable if item.kind == "dark" and not item.corrected]

    def dark_of(item: Series) -> float:
        if "offset" in item.corrected:
            return 0.0
        if not darks:
            return dark_DN
        wanted = item.exposure_ms or 0.0
        nearest = min(darks, key=lambda one: (abs((one.exposure_ms or 0.0) - wanted), abs(one.index - item.index)))
        return levels[nearest.name]

    return {item.name: levels[item.name] - dark_of(item) for item in flats}


def _averaged_findings(
    flats: Sequence[Series], signals: dict[str, float], scans: dict[str, _Kept], acquisition: AcquisitionFile
) -> list[Finding]:
    """Flats whose noise is that of a mean of more frames than declared, by the other flats of their beam.

    Variance over signal, averaging undone, is one number for a beam. It is nearer to that of a mean of two than of a single
    frame below the geometric mean of both.
    """
    darks = [
        scans[item.name].noise_DN ** 2 * item.averaged
        for item in acquisition.of_kind("dark")
        if item.name in scans and math.isfinite(scans[item.name].noise_DN)
    ]
    read_DN2 = float(np.median(darks)) if darks else 0.0
    groups: dict[Any, list[Series]] = {}
    for item in flats:
        if signals[item.name] > 0 and scans[item.name].noise_DN > 0:
            groups.setdefault((item.kV, text_from_filters(item.filters), item.layer), []).append(item)
    found = []
    for members in groups.values():
        if len(members) < 2:
            continue
        variances = [scans[item.name].noise_DN ** 2 * item.averaged for item in members]
        ratios = [max(v - read_DN2, 0.0) / signals[item.name] for v, item in zip(variances, members, strict=True)]
        # of two, the noisier one is the one that is not averaged
        typical = float(np.median(ratios)) if len(members) > 2 else max(ratios)
        for item, variance in zip(members, variances, strict=True):
            single = read_DN2 + typical * signals[item.name]
            if variance < single / math.sqrt(2.0) and single > 2.0 * read_DN2:
                values = {
                    "count": max(2, round(single / variance)) * item.averaged,
                    "how": f"its noise is {math.sqrt(single / variance):.2g} times less than that of the other flats",
                    "declared": item.averaged,
                }
                found.append(Finding(code=FindingCode.AVERAGED, series=item.name, values=values))
    return found


def _setting_text(item: Series) -> str:
    words = []
    if item.kV is not None:
        words.append(f"{item.kV:g} kV")
    if item.power_W is not None:
        words.append(f"{item.power_W:g} W")
    elif item.current_mA is not None:
        words.append(f"{item.current_mA:g} mA")
    if item.exposure_ms is not None:
        words.append(f"{item.exposure_ms:g} ms")
    if item.filters:
        words.append(text_from_filters(item.filters))
    if item.averaged != 1:
        words.append(f"mean of {item.averaged}")
    if item.photons_per_pixel is not None:
        words.append(f"{item.photons_per_pixel:.4g} photons")
    if item.scene:
        words.append(f"scene {item.scene}")
    return ", ".join(words)


def _row(item: Series, kept: _Kept | None, findings: Sequence[Finding]) -> SeriesRow:
    codes = {entry.code for entry in findings if entry.series == item.name}
    return SeriesRow(
        name=item.name,
        kind=item.kind,
        setting=_setting_text(item),
        frames=item.n_frames,
        averaged=item.averaged,
        shape=item.shape,
        level_DN=None if kept is None else kept.level_DN,
        noise_DN=None if kept is None or not math.isfinite(kept.noise_DN) else kept.noise_DN,
        serves_for=_serves(item, codes) if kept is not None else (),
    )


DARK_LEVEL, READ_NOISE, LEVEL, NOISE, SPECTRUM = "dark level", "read noise", "level", "gain and blur", "spectrum"
LAG, IMAGES, WEDGE, VALIDATION = "lag", "reference images", "attenuation", "validation"


def _serves(item: Series, codes: set[FindingCode]) -> tuple[str, ...]:
    """What a series is good for, as it stands."""
    if codes & (_UNFIT - {FindingCode.SCENE_CHANGES}):
        return ()
    serves = []
    repeats = item.n_frames > 1 and FindingCode.SCENE_CHANGES not in codes
    if item.kind == "dark" and "offset" not in item.corrected:
        serves.append(DARK_LEVEL)
        if repeats and FindingCode.CLIPPED not in codes:
            serves.append(READ_NOISE)
    elif item.kind == "flat":
        if "log" not in item.corrected and FindingCode.SCENE_CHANGES not in codes:
            serves.append(LEVEL)
            if repeats and "gain" not in item.corrected:
                serves.append(NOISE)
            loaded = item.current_mA is not None or item.power_W is not None
            if item.kV is not None and loaded and item.exposure_ms and not codes & _LABELS:
                serves.append(SPECTRUM)
        if item.role == "evaluation":
            serves = [VALIDATION] if serves else []
    elif item.kind == "object":
        serves.append(IMAGES)
    elif item.kind == "afterglow":
        serves.append(LAG)
    return tuple(serves)


_LABELS = frozenset({FindingCode.LOAD_LABEL, FindingCode.KV_LABEL, FindingCode.FILTER_LABEL})


def _allows(
    acquisition: AcquisitionFile, rows: Sequence[SeriesRow], findings: Sequence[Finding]
) -> tuple[Allowed, ...]:
    """What can be learnt from the series as they stand."""
    by_name = {item.name: item for item in acquisition.series}
    instrument = acquisition.instrument

    def serving(purpose: str) -> list[SeriesRow]:
        return [row for row in rows if purpose in row.serves_for]

    def names(found: Sequence[SeriesRow]) -> str:
        told = ", ".join(row.name for row in found[:3])
        return told + (f" and {len(found) - 3} more" if len(found) > 3 else "")

    result = []

    def add(what: str, possible: bool, why: str) -> None:
        result.append(Allowed(what=what, possible=possible, why=why))

    darks, quiet = serving(DARK_LEVEL), serving(READ_NOISE)
    offset_done = any("offset" in item.corrected for item in acquisition.of_kind("flat"))
    if darks:
        add("dark level", True, names(darks))
    elif instrument.counting:
        add("dark level", True, "0, of a detector that counts photons")
    else:
        add("dark level", offset_done, "the frames are offset-corrected" if offset_done else "no dark series")
    add("read noise", bool(quiet), names(quiet) or "no dark series of two or more raw frames")
    noisy, lit = serving(NOISE), serving(LEVEL)
    pairs = _averaged_pairs([by_name[row.name] for row in lit if row.frames == 1])
    add(
        "gain, blur and photons a pixel",
        bool(noisy) or bool(pairs),
        names(noisy)
        or (
            f"the difference of {pairs[0]} and {pairs[1]}"
            if pairs
            else "no flat series of two or more raw frames of one scene"
        ),
    )
    spectral = [by_name[row.name] for row in serving(SPECTRUM)]
    beams = {(item.kV, text_from_filters(item.filters)) for item in spectral}
    loads = max(
        (
            len({(item.current_mA, item.power_W, item.exposure_ms, item.photons_per_pixel) for item in group})
            for group in _grouped([by_name[row.name] for row in lit])
        ),
        default=0,
    )
    add(
        "linearity",
        loads > 2,
        f"{loads} loads at one beam" if loads > 2 else "three or more loads at one beam are needed",
    )
    add(
        "spectrum: other kV and filters",
        bool(spectral),
        f"{len(beams)} beam{'s' * (len(beams) != 1)}: "
        + "; ".join(f"{kV:g} kV {layers}".strip() for kV, layers in sorted(beams)[:4])
        if spectral
        else "flats need kV, current or power, and an exposure time",
    )
    distance = instrument.source_detector_mm is not None or any(item.source_detector_mm for item in spectral)
    absolute = bool(spectral) and distance and instrument.pixel_mm is not None
    add(
        "output of the tube, dose",
        absolute,
        "kV, load, pixel size and distance are known"
        if absolute
        else "needs kV, load, pixel size and source-detector distance",
    )
    evaluated = serving(VALIDATION)
    add(
        "validation on flats that calibration has not seen",
        bool(evaluated),
        names(evaluated) or 'no flat with role = "evaluation"',
    )
    known = [item for item in acquisition.of_kind("object") if _has_thickness(acquisition, item)]
    add(
        "attenuation and scatter",
        bool(known),
        names([row for row in rows if row.name in {item.name for item in known}]) or "no object of known thickness",
    )
    try:
        images = object_pairs(acquisition)
    except InputError:
        images = ()
    add(
        "reference images for two energies",
        bool(images),
        counted(len(images), "pair") if images else "no object measured at two tube voltages with a `scene`",
    )
    afterglow = serving(LAG)
    add("lag", bool(afterglow), names(afterglow) or "no afterglow series (beam off straight after exposure)")
    return tuple(result)


def _has_thickness(acquisition: AcquisitionFile, item: Series) -> bool:
    scene = acquisition.scenes.get(item.scene)
    return scene is not None and len(scene.thickness_mm) > 0


def _grouped(flats: Sequence[Series]) -> list[list[Series]]:
    groups: dict[Any, list[Series]] = {}
    for item in flats:
        groups.setdefault((item.kV, text_from_filters(item.filters)), []).append(item)
    return list(groups.values())


def _averaged_pairs(flats: Sequence[Series]) -> tuple[str, str] | None:
    """Two single flats of one beam and load: their difference holds noise."""
    seen: dict[Any, str] = {}
    for item in flats:
        if item.corrected & {"gain", "log"}:
            continue
        key = (item.kV, text_from_filters(item.filters), item.current_mA, item.power_W, item.exposure_ms)
        if key in seen:
            return seen[key], item.name
        seen[key] = item.name
    return None


def _next(acquisition: AcquisitionFile, rows: Sequence[SeriesRow], allows: Sequence[Allowed]) -> tuple[str, ...]:
    """What would be worth measuring or writing down next, most useful first."""
    possible = {item.what: item.possible for item in allows}
    told = []
    if not possible["dark level"]:
        told.append("20 darks at each exposure time (beam off)")
    elif not possible["read noise"] and not acquisition.instrument.counting:
        told.append("20 raw darks at one exposure time, each kept by itself")
    if not possible["gain, blur and photons a pixel"]:
        told.append("20 raw flats at each of five currents or exposures, each frame kept by itself")
    elif not possible["linearity"]:
        told.append("flats at five exposures of one beam, from a tenth to nine tenths of full scale")
    if not possible["spectrum: other kV and filters"]:
        told.append("write down kV, mA (or W) and exposure of every flat")
    else:
        spectral = [row for row in rows if SPECTRUM in row.serves_for]
        voltages = {item.kV for item in acquisition.series for row in spectral if row.name == item.name}
        filters = {
            text_from_filters(item.filters) for item in acquisition.series for row in spectral if row.name == item.name
        }
        if len(voltages) < 2:
            told.append("flats at a second tube voltage, as far from the first as the line goes")
        if len(filters) < 2:
            told.append("the same flats behind a known filter (0.1 mm Cu or 2 mm Al)")
        if len(voltages) == 2:
            told.append("flats at a third tube voltage: two do not tell what lies beyond them")
        if not possible["output of the tube, dose"]:
            told.append("write down pixel size and source-detector distance")
    if not possible["validation on flats that calibration has not seen"] and possible["gain, blur and photons a pixel"]:
        told.append('a flat at another setting with role = "evaluation", to test the twin on')
    return tuple(told)
