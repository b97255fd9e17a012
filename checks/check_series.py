"""What the series of an acquisition show by themselves, against each other and against their labels."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..acquisition.series_roles import calibrating_names, commonest_shape
from ..calibration.frames.bad_pixels import is_noisy
from ..calibration.frames.code_steps import code_step
from ..calibration.frames.frame_checks import LEVEL_CHANGE, SceneChange
from ..calibration.frames.robust import robust_sd
from ..calibration.spread.noise_power import SMALLEST_SQUARE_PX
from ..errors import FileFormatError, InputError
from . import frame_signs
from .allowances import NO_PATTERN, UNFIT, allowed_by, next_measurements, series_row
from .check_result import CheckResult
from .declared import unknown_words
from .findings import Finding, FindingCode, Severity
from .labels import check_labels
from .loads_and_clocks import clock_findings, load_findings
from .readings import DARK_SD_DN
from .series_scan import SeriesScan, scan_series

_AS_BRIGHT = 0.9  # of the highest value, median of the neighbours of a pixel that light has saturated; assumed
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
_DARK_FRAMES = 8  # that tell which pixels are far noisier than others

Progress = Callable[[str], None]


def one_line(error: Exception, place: Path | None = None, told: str = "") -> str:
    """The error's line; the file's own name is left out where it only says which part of the file is meant."""
    line = " ".join(str(error).split())
    return line if place is None else line.replace(f"{place}, ", "").replace(str(place), told)


def in_order(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings, those that matter most first."""
    order = list(Severity)
    return tuple(sorted(findings, key=lambda item: order.index(item.severity)))


def check_series(acquisition: AcquisitionFile, *, progress: Progress | None = None) -> CheckResult:
    """Check the series of an open acquisition; see `check_acquisition`."""
    acquisition.check_open()
    findings: list[Finding] = []
    scans: dict[str, _Kept] = {}
    patterns: dict[str, list[_Pattern]] = {}
    digests: dict[bytes, str] = {}
    dark_DN, unlit = _without_light(acquisition)
    for item in acquisition.series:
        if progress is not None:
            progress(item.name)
        try:
            dark = unlit.get(item.shape)
            scan = scan_series(item, unsteady=None if dark is None else dark.unsteady)
        except FileFormatError as error:
            # the series is named beside the sentence
            what = one_line(error, Path(acquisition.path), acquisition.path).removeprefix(f"series {item.name}/")
            findings.append(Finding(code=FindingCode.DAMAGED, series=item.name, values={"what": what}))
            continue
        found = _series_findings(scan, acquisition, dark_DN, dark)
        found += _copies_of_others(scan, digests)
        if not any(entry.code in NO_PATTERN for entry in found):
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
    rows = tuple(
        series_row(
            item,
            findings,
            scene=acquisition.scenes.get(item.scene),
            level_DN=scans[item.name].level_DN if item.name in scans else None,
            noise_DN=scans[item.name].noise_DN if item.name in scans and scans[item.name].noise_DN >= 0 else None,
        )
        for item in acquisition.series
    )
    allows = allowed_by(acquisition, rows)
    return CheckResult(
        path=acquisition.path,
        what="acquisition",
        series=rows,
        findings=in_order(findings),
        allows=allows,
        next_measurements=next_measurements(acquisition, rows, allows),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kept:
    """Of a series that has been read: level, temporal noise (NaN: unknown) and the codes of what was found."""

    level_DN: float
    noise_DN: float
    codes: set[FindingCode]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Unlit:
    """What darks of one shape show: first_DN (row, column), a frame; unsteady (row, column): pixels of far more noise than others."""

    first_DN: NDArray[Any]
    unsteady: NDArray[np.bool_]


def _without_light(acquisition: AcquisitionFile) -> tuple[float, dict[tuple[int, int], _Unlit]]:
    """Level without light (DN; 0 where there are no darks), and what the first raw dark of each shape shows."""
    levels: list[float] = []
    shown: dict[tuple[int, int], _Unlit] = {}
    for item in acquisition.of_kind("dark"):
        try:
            frames = item.read_frames(0, 1 if item.shape in shown else min(item.n_frames, _DARK_FRAMES))
        except FileFormatError:
            continue
        levels.append(float(np.median(frames[0])))
        if not item.corrected and item.shape not in shown:
            unsteady = np.zeros(item.shape, dtype=bool)
            if len(frames) > 2:
                unsteady = is_noisy(frames.var(axis=0, ddof=1, dtype=np.float64), len(frames) - 1.0)
            shown[item.shape] = _Unlit(first_DN=frames[0], unsteady=unsteady)
    return min(levels, default=0.0), shown


def _series_findings(
    scan: SeriesScan, acquisition: AcquisitionFile, dark_DN: float, unlit: _Unlit | None
) -> list[Finding]:
    """What the frames of one series show by themselves; unlit: what darks of its shape do."""
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
    if min(item.shape) < SMALLEST_SQUARE_PX:
        add(FindingCode.SMALL, shape=" x ".join(map(str, item.shape)))
    copies = scan.copies.copies()
    if copies:
        first = min(copies)
        add(FindingCode.COPIES, count=len(copies), frames=item.n_frames, first=first, origin=copies[first])
    lifted = _lifted_by_light(scan.values, None if unlit is None else unlit.first_DN)
    top = frame_signs.pile_up_at_top(lifted)
    bits = acquisition.instrument.bits
    if top is not None and lit and not counting:
        add(FindingCode.SATURATED, percent=100.0 * top[1], top=top[0])
    elif bits and lit and float(np.mean(lifted >= 2**bits - 1)) > 1e-3:
        add(FindingCode.SATURATED, percent=100.0 * float(np.mean(lifted >= 2**bits - 1)), top=2.0**bits - 1)
    zeros = None if counting or item.corrected & {"log", "gain"} else frame_signs.share_at_zero(scan.values)
    if zeros is not None:
        add(FindingCode.CLIPPED, percent=100.0 * zeros)
    if item.kind == "dark" and "offset" not in item.corrected and low < 0:
        noise = math.sqrt(scan.variance_DN2) if scan.variance_DN2 > 0 else math.inf
        if abs(scan.level_DN) < noise:
            add(FindingCode.OFFSET_CORRECTED, level=scan.level_DN)
    step = code_step(scan.values)
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


def _lifted_by_light(values: NDArray[Any], unlit: NDArray[Any] | None) -> NDArray[Any]:
    """Values (frame, pixel) without pixels that are stuck at the highest value: without light too, or among dimmer neighbours.

    Light spreads and fills areas: what it saturates has neighbours that are nearly as bright.
    """
    from scipy.ndimage import median_filter

    flat = values.reshape(len(values), -1)
    top = flat.max(initial=0)
    picture = values.mean(axis=0)
    stuck = (picture >= top) & (median_filter(picture, size=3, mode="nearest") < _AS_BRIGHT * top)
    if unlit is not None:
        stuck |= unlit >= top
    return flat if stuck.all() else flat[:, ~stuck.ravel()]


def _level_jump(scan: SeriesScan, offset_DN: float) -> tuple[int, float] | None:
    """Frame and relative size of the largest change of level between successive frames that is no flicker."""
    signal = scan.frame_mean_DN - offset_DN
    typical = float(np.median(signal))
    if not typical > 0:
        return None
    steps = np.diff(signal) / typical
    at = int(np.argmax(np.abs(steps)))
    usual = robust_sd(steps, about=0.0)
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
    unknown, nameless = unknown_words(acquisition)
    found += unknown
    without_kV = [
        item for item in read if item.kind == "flat" and item.kV is None and (item.current_mA or item.power_W)
    ]
    if without_kV:
        found.append(Finding(code=FindingCode.NO_KV, values={"count": len(without_kV)}))
        nameless |= {item.name for item in without_kV}
    if "flat" not in kinds:
        found.append(Finding(code=FindingCode.NO_FLAT))
    elif all(item.corrected & {"gain", "log"} for item in acquisition.of_kind("flat")):
        found.append(Finding(code=FindingCode.CORRECTED_FLATS))
    elif "dark" not in kinds and not acquisition.instrument.counting and not corrected:
        found.append(Finding(code=FindingCode.NO_DARK))
    imaged = [item for item in read if item.kind in ("dark", "flat")]
    shape = commonest_shape(imaged)
    for item in imaged:
        if item.shape != shape:
            reference = next(other for other in imaged if other.shape == shape)
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
    labels = _label_findings(
        acquisition,
        [
            item
            for item in read
            if item.name not in nameless and not scans[item.name].codes & (UNFIT | {FindingCode.AVERAGED})
        ],
    )
    found += labels
    unfit = {name for entry in found for name in entry.names}
    # without a dark nobody knows what is signal
    known = any(item.kind == "dark" for item in read) or bool(acquisition.instrument.counting)
    flats = [
        item
        for item in read
        if item.kind == "flat"
        and (known or "offset" in item.corrected)
        and not item.corrected & {"gain", "log"}
        and item.name not in unfit
        and not scans[item.name].codes & UNFIT
    ]
    signals = _signals([item for item in read if item.name not in unfit], flats, levels, dark_DN)
    stated = [item for item in flats if item.name not in nameless]
    found += load_findings(stated, signals, dark_sd_DN=_dark_sd_DN(read, levels))
    found += clock_findings(read)
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


def _label_findings(acquisition: AcquisitionFile, readable: Sequence[Series]) -> list[Finding]:
    """Labels that the frames contradict, layer by layer and visit by visit: other layers and days have other levels."""
    found: list[Finding] = []
    groups: dict[tuple[Any, ...], list[Series]] = {}
    for item in readable:
        groups.setdefault((item.layer, item.session, item.shape), []).append(item)
    for members in groups.values():
        part = replace(acquisition, series=tuple(members))
        try:
            checked = check_labels(part, calibrating=calibrating_names(part.series))
        except InputError:
            continue  # maps that cannot be read, or no detector numbers: told where they belong
        found += [*checked.findings, *checked.stops]
    return found


def _dark_sd_DN(series: Sequence[Series], levels: Mapping[str, float]) -> float:
    """Standard deviation of a dark's level, by what darks of one exposure differ and by what those of a line without fault may."""
    alike: dict[float | None, list[float]] = {}
    for item in series:
        if item.kind == "dark":
            alike.setdefault(item.exposure_ms, []).append(levels[item.name])
    squares = [(level - sum(group) / len(group)) ** 2 for group in alike.values() for level in group]
    freedom = len(squares) - len(alike)
    return math.hypot(DARK_SD_DN, math.sqrt(sum(squares) / freedom) if freedom else 0.0)


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
