"""Scenes whose thickness maps do not fit the shadow in their frames: empty, another's, turned, or of another scale.

Judged by how well the picture's shadow fits its map, against the same map turned and other scenes' maps.
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..calibration.frames.robust import robust_sd
from ..errors import FileFormatError, InputError
from ..materials.library import material_from_name
from .findings import Finding, FindingCode
from .label_model import DEEPEST, INHERENT, INHERENT_TRIED_MM_AL, LabelModel, measured_depth
from .readings import FloatArray, Reading

_FITS, _FITS_NOT = 0.995, 0.5  # correlations of shadow and map
_FITS_BETTER = 0.3  # share of what is missing from 1 that another map may leave
_SCALE_OFF = 0.22  # logarithm of a map's scale that no composition explains
_SCALE_AGREES = 0.07  # scatter takes more from thick parts, and not the same at every voltage
_LOG_FACTORS = tuple(round(0.02 * step, 2) for step in range(-40, 41))
_SHIFTS_PX = (-4, -2, 0, 2, 4)
_TURNS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "turned by 180 degrees": np.flip,
    "mirrored top to bottom": np.flipud,
    "mirrored left to right": np.fliplr,
    "transposed": np.transpose,
    "turned by 90 degrees": np.rot90,
    "turned by 270 degrees": lambda image: np.flip(np.rot90(image)),
}


def wrong_maps(judged: Sequence[Reading], maps: LabelModel) -> list[Finding]:
    """Scenes whose thickness maps do not fit the shadow in the frames: empty, another's, turned, or of another scale."""
    placements: dict[str, list[Reading]] = {}
    for item in judged:
        if item.series.kind == "object" and item.series.scene in maps.scenes:
            placements.setdefault(item.series.scene, []).append(item)
    found: list[Finding] = []
    for scene in list(placements):
        if text := _faulty(scene, maps):
            found.append(_finding(placements.pop(scene), text))
        elif not maps.thickness(scene):
            del placements[scene]
    scales: dict[str, list[list[float]]] = {}
    inherent_mm_Al = _inherent_mm_Al([item for item in judged if item.series.kind == "flat"], maps)
    for scene, members in placements.items():
        text = _unlike(scene, members, maps, list(placements))
        if text:
            found.append(_finding(members, text))
            continue
        scales[scene] = [
            [value for item in members for value in _scales_of_map(item, maps, mm_Al)] for mm_Al in inherent_mm_Al
        ]
    return found + _scaled(scales, placements)


def _faulty(scene: str, maps: LabelModel) -> str:
    """What of a scene's maps is no path length through a known material; empty where all is."""
    thickness_mm = maps.scenes[scene].thickness_mm
    for material in thickness_mm:
        try:
            thickness_mm[material]
        except FileFormatError as error:
            return f"the thickness map of {material} in {scene} has {error.received}; expected {error.expected}"
        try:
            material_from_name(material)
        except InputError:
            return f"the thickness maps of {scene} are of {material!r}, which is no material of the library"
    return ""


def _finding(members: Sequence[Reading], what: str) -> Finding:
    """Of all series of a scene."""
    first, *others = (item.name for item in members)
    return Finding(code=FindingCode.MAPS, series=first, others=tuple(others), values={"what": what})


def _inherent_mm_Al(flats: Sequence[Reading], maps: LabelModel) -> tuple[float, ...]:
    """Inherent filtration as flats behind two filters at one voltage have it; where there are none what is usual, and its extremes.

    The median over all such flats: one of them may be mislabelled.
    """
    levels = {
        item.name: np.array([maps.log_level(item.label, mm_Al) for mm_Al in INHERENT_TRIED_MM_AL])
        for item in flats
        if item.label.load is not None and item.level_DN > 0 and maps.weights(item.label) is not None
    }
    known = [item for item in flats if item.name in levels]
    seen = []
    for number, one in enumerate(known):
        for other in known[:number]:
            if one.label.kV == other.label.kV and one.label.filters != other.label.filters:
                measured = math.log(one.level_DN / other.level_DN)
                off = np.abs(levels[one.name] - levels[other.name] - measured)
                seen.append(INHERENT_TRIED_MM_AL[int(np.argmin(off))])
    if seen:
        return (float(np.median(seen)),)
    return (INHERENT.centre, INHERENT.low, INHERENT.centre + 2.0 * INHERENT.sd)


def _unlike(scene: str, members: Sequence[Reading], maps: LabelModel, others: Sequence[str]) -> str:
    """What the shadow of a scene looks like instead of its own map; empty where it fits or nothing can be said."""
    item = max(members, key=lambda one: one.series.n_frames)
    depth = maps.depth(scene, item.label)
    if depth is None or item.picture is None:
        return ""
    bright = float(np.quantile(item.picture[maps.good], 0.95))
    if not bright > 0:
        return ""
    picture = np.asarray(-np.log(np.maximum(item.picture / bright, 1e-6)), dtype=np.float64)
    photons_known = item.gain_DN > 0  # not of single frames
    noise = math.sqrt(item.gain_DN / bright / item.series.n_frames) if photons_known else _of_neighbours(picture)
    covered = float(np.mean(depth > 0.05))
    ends = [0.05, 1.0 - max(min(covered, 0.15), 0.003) / 3.0]
    shadow = float(np.ptp(np.quantile(picture[maps.good], ends)))
    shows = shadow > 0.05 + 6.0 * noise
    if float(np.max(depth)) < 0.02:
        return f"the thickness maps of {scene} are empty, but its frames show a shadow" if shows else ""
    if not _varies(depth):
        return ""
    if not shows:
        # a thin object's shadow is no deeper than noise may be, and there all the same
        none = shadow < 0.5 * float(np.ptp(np.quantile(depth[maps.good], ends)))
        return f"the thickness maps of {scene} hold an object, but its frames show no shadow" if none else ""
    stride = maps.stride
    own = _correlation(picture, depth, stride)
    if not own < _FITS:
        return ""
    candidates = {f"the same maps {turn}": change(depth) for turn, change in _TURNS.items()}
    for other in others:
        theirs = maps.depth(other, item.label) if other != scene else None
        if theirs is not None and _varies(theirs):
            candidates[f"the maps of {other}"] = theirs
    best, name = own, ""
    for words, candidate in candidates.items():
        value = _correlation(picture, candidate, stride) if candidate.shape == depth.shape else -1.0
        if value > best:
            best, name = value, words
    if name and 1.0 - best < _FITS_BETTER * (1.0 - own) and best > 0.9:
        return f"the thickness maps of {scene} do not fit its frames (correlation {own:.3f}); {name} would ({best:.3f})"
    if own < _FITS_NOT:
        return f"the thickness maps of {scene} do not fit the shadow in its frames (correlation {own:.2f})"
    return ""


def _varies(depth: FloatArray) -> bool:
    """Whether a map's -log T has anything that a shadow could be compared with."""
    return float(np.std(np.clip(depth, 0.0, DEEPEST))) >= 0.03


def _correlation(picture: FloatArray, depth: FloatArray, stride: int) -> float:
    """Largest correlation of a picture's and a map's -log T, smoothed, over displacements of some pixels."""
    from scipy.ndimage import gaussian_filter, median_filter

    measured = gaussian_filter(np.clip(median_filter(picture, 3), -0.2, DEEPEST), 1.5)
    expected = gaussian_filter(np.clip(depth, 0.0, DEEPEST), 1.5)
    margin = max(1, max(_SHIFTS_PX) // stride)
    if min(measured.shape) < 4 * margin:
        return math.nan
    inner = (slice(margin, -margin), slice(margin, -margin))
    still = measured[inner] - measured[inner].mean()
    scale = math.sqrt(float(np.vdot(still, still)))
    best = -1.0
    if scale < 1e-9 * math.sqrt(still.size):
        return best
    shifts = sorted({round(shift / stride) for shift in _SHIFTS_PX})
    for down in shifts:
        for right in shifts:
            moved = np.roll(expected, (down, right), axis=(0, 1))[inner]
            moved = moved - moved.mean()
            own = math.sqrt(float(np.vdot(moved, moved)))
            if own >= 1e-9 * math.sqrt(still.size):
                best = max(best, float(np.vdot(still, moved)) / (scale * own))
    return best


def _of_neighbours(picture: FloatArray) -> float:
    """Standard deviation of a picture's noise (row, column), as most neighbours along rows differ."""
    return robust_sd(np.diff(picture, axis=1), about=0.0) / math.sqrt(2.0)


def _scales_of_map(item: Reading, maps: LabelModel, inherent_mm_Al: float) -> list[float]:
    """Logarithm of the factor on a scene's path lengths with which its shadow fits, in its thinner and its thicker half."""
    depth = maps.depth(item.series.scene, item.label, inherent_mm_Al=inherent_mm_Al)
    if depth is None:
        return []
    measured = measured_depth(item, depth)
    covered = (depth > 0.05) & (depth < 2.5) & maps.good
    if measured is None or covered.sum() < 100:
        return []
    middle = float(np.median(depth[covered]))
    halves = [covered & (depth <= middle), covered & (depth > middle)]
    found = []
    for half in halves:
        if half.sum() < 30:
            continue

        def left(log_factor: float, half: NDArray[np.bool_] = half) -> float:
            other = maps.depth(item.series.scene, item.label, math.exp(log_factor), inherent_mm_Al)
            # edges lie where they lie: the median of the differences
            return math.nan if other is None else float(np.median(measured[half] - other[half]))

        # longer paths leave less in every pixel: the factor that leaves nothing is found by halving
        first = bisect_left(_LOG_FACTORS, True, key=lambda log_factor: not left(log_factor) > 0)
        found.append(min(_LOG_FACTORS[max(first - 1, 0) : first + 1], key=lambda log_factor: abs(left(log_factor))))
    return found


def _scaled(
    scales: Mapping[str, Sequence[Sequence[float]]], placements: Mapping[str, Sequence[Reading]]
) -> list[Finding]:
    """Scenes whose path lengths want one and the same factor at every voltage, far from 1.

    Where all scenes at one distance want such a factor and none at another one does, it is no fault of their maps: scatter
    falls with the gap. Nor where none fits and another inherent filtration that may be would do instead.

    Args:
        scales: logarithms of the factors by scene, with the inherent filtration that is taken, and with others that may be.
        placements: series of each scene.
    """
    wanted: dict[float | None, list[float]] = {}
    for scene, (values, *_) in scales.items():
        if values:
            wanted.setdefault(placements[scene][0].series.source_object_mm, []).append(float(np.median(values)))
    one_fits = any(abs(value) < 0.5 * _SCALE_OFF for group in wanted.values() for value in group)
    found = []
    for scene, (values, *others) in scales.items():
        members = placements[scene]
        voltages = {item.label.kV for item in members}
        if len(values) < 4 or len(voltages) < 2 or max(values) - min(values) > _SCALE_AGREES:
            continue
        middle = float(np.median(values))
        here = members[0].series.source_object_mm
        like_it = {at: [value / middle > 0.5 for value in group] for at, group in wanted.items()} if middle else {}
        of_the_gap = (
            len(like_it.get(here, [])) > 1
            and all(like_it[here])
            and len(like_it) > 1
            and not any(any(group) for at, group in like_it.items() if at != here)
        )
        # a soft beam takes a harder one for shorter paths
        of_the_beam = not one_fits and any(
            math.copysign(1.0, middle) * float(np.median(other)) < _SCALE_OFF for other in others if other
        )
        if abs(middle) > _SCALE_OFF and not (of_the_gap or of_the_beam):
            what = f"the thickness maps of {scene} fit its frames only if all path lengths are {math.exp(middle):.2f} times as long"
            found.append(_finding(members, what))
    return found
