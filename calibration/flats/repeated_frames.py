"""Noise of beams whose flats are single averaged frames: from the repeated frames of other series at the same beam.

Level, dark and gain map need one good frame, noise needs two. Any two frames of the same scene have the noise of their
beam: other flats over the whole field, objects beside the object or, where too little is open there, behind it, away from
steps. Behind an object the beam is harder and the gain a few percent higher, which the gain's interval then carries.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import AcquisitionFile, Series
from ...acquisition.setting import text_from_filters
from ..frames._kept_sums import KeptSums
from ..frames.frame_sums import effective_frames
from ..frames.robust import robust_sd
from ..spread.noise_power import NoisePower, holds_squares
from ..spread.spread_fit import SpreadFit

OPEN, BEHIND = "beside objects", "behind objects"
LATER_SD = 0.01  # relative, of a gain: what has set in since the flats may have changed the noise
BEHIND_SD = 0.03  # relative, of a gain whose beam an object has hardened
_BESIDE_PX = 5  # from a shadow's edge: blur, and a thickness map that lies a little off
_ENOUGH_SAMPLES = 2e4  # frames x pixels: a variance is then known to 1 %
_FLAT_ENOUGH = 0.03  # of the signal, over `_STEP_PX` pixels
_STEP_PX = 5
_MARGIN = 1.2  # of a variance that the darks' difference shows: it is itself noisy
_MOST_SAMPLES = 6e7  # frames x pixels of one beam and exposure: more tells nothing more

Beam = tuple[float | None, tuple[str, ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class RepeatedFrames:
    """Series of one beam and exposure that its noise is read from.

    Fields: beam; where (`OPEN` or `BEHIND`); members: series, its sums, pixels to use (row, column).
    """

    beam: Beam
    where: str
    members: tuple[tuple[Series, KeptSums, NDArray[np.bool_]], ...]

    @property
    def samples(self) -> float:
        """Independent frames x pixels."""
        return sum(effective_frames(total.frames) * int(mask.sum()) for _, total, mask in self.members)

    def power(self, of_series: Callable[[Series, KeptSums, NDArray[np.bool_]], NoisePower]) -> NoisePower:
        """The members' noise power as one: the law is linear in signal and power, so both are averaged."""
        found = [of_series(*member) for member in self.members]
        weights = np.array([item.samples for item in found])
        shares = weights / weights.sum()

        def mean(values: Sequence[Any]) -> Any:
            return sum(share * value for share, value in zip(shares, values, strict=True))

        return replace(
            found[0],
            power_DN2=mean([item.power_DN2 for item in found]),
            modes=np.sum([item.modes for item in found], axis=0),
            signal_DN=float(mean([item.signal_DN for item in found])),
            common_mode=float(mean([item.common_mode for item in found])),
        )


def beam_of(item: Series) -> Beam:
    """kV and filters: what fixes the noise of a signal."""
    return (item.kV, tuple(sorted(str(layer) for layer in item.filters)))


def series_of_beams(candidates: Sequence[Series], beams: Sequence[Beam], shape: tuple[int, int]) -> list[Series]:
    """Flats and objects of two or more raw frames at these beams; those held back for evaluation only where a beam has no
    others."""
    usable = [
        item
        for item in candidates
        if item.kind in ("flat", "object")
        and item.n_frames > 1
        and item.shape == shape
        and not item.corrected & {"log", "gain"}
        and (item.setting is None or item.setting.binning == 1)
        and beam_of(item) in beams
    ]
    free = {beam_of(item) for item in usable if item.role != "evaluation"}
    return [item for item in usable if item.role != "evaluation" or beam_of(item) not in free]


def find_repeated_frames(
    acquisition: AcquisitionFile,
    series: Sequence[Series],
    *,
    sums_of: Callable[[Series], KeptSums],
    dark_of: Callable[[Series], NDArray[np.float64]],
    usable: Callable[[KeptSums, NDArray[np.bool_]], bool],
    good: NDArray[np.bool_],
) -> tuple[RepeatedFrames, ...]:
    """The repeated frames of each beam and exposure, with the pixels that show the beam as it is.

    Args:
        acquisition: its scenes tell where objects are.
        series: of `series_of_beams`.
        sums_of: sums over a series' frames.
        dark_of: dark of a series (row, column), DN.
        usable: whether a series' frames can be used in these pixels (not saturated).
        good: pixels that are not bad (row, column).
    """
    result: list[RepeatedFrames] = []
    for beam in dict.fromkeys(map(beam_of, series)):
        open_groups: dict[Any, list[Any]] = {}
        behind_groups: dict[Any, list[Any]] = {}
        taken: dict[Any, float] = {}
        for item in series:
            if beam_of(item) != beam:
                continue
            key = (item.exposure_ms, item.current_mA, item.power_W, item.averaged)
            if taken.get(key, 0.0) > _MOST_SAMPLES:
                continue
            total = sums_of(item)
            signal = total.mean_DN - dark_of(item)
            beside = good & _beside(acquisition, item)
            behind = good & _even(signal)
            for groups, mask in ((open_groups, beside), (behind_groups, behind)):
                if holds_squares(mask) and float(signal[mask].mean()) > 0 and usable(total, mask):
                    groups.setdefault(key, []).append((item, total, mask))
            taken[key] = taken.get(key, 0.0) + total.frames * good.size
        for where, groups in ((OPEN, open_groups), (BEHIND, behind_groups)):
            found = [RepeatedFrames(beam=beam, where=where, members=tuple(rows)) for rows in groups.values()]
            if sum(item.samples for item in found) >= _ENOUGH_SAMPLES or (where == BEHIND and found):
                result += found
                break
    return tuple(result)


def _beside(acquisition: AcquisitionFile, item: Series) -> NDArray[np.bool_]:
    """Pixels that nothing stands before, away from shadows; none where nobody says where the object is."""
    from scipy.ndimage import binary_dilation

    if item.kind == "flat":
        return np.ones(item.shape, dtype=bool)
    scene = acquisition.scenes.get(item.scene) if item.scene else None
    if scene is None or not len(scene.thickness_mm):
        return np.zeros(item.shape, dtype=bool)
    shadow = np.zeros(item.shape, dtype=bool)
    for material in scene.thickness_mm:
        plane = np.asarray(scene.thickness_mm[material])
        if plane.shape != item.shape:
            return np.zeros(item.shape, dtype=bool)
        shadow |= ~(plane <= 0)
    if not shadow.any():
        return ~shadow
    return np.asarray(~binary_dilation(shadow, np.ones((3, 3)), iterations=_BESIDE_PX))


def _even(signal: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Pixels with light and without a step nearby."""
    from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

    smooth = gaussian_filter(signal, 2.0)
    step = maximum_filter(smooth, _STEP_PX) - minimum_filter(smooth, _STEP_PX)
    return np.asarray((smooth > 0) & (step < _FLAT_ENOUGH * np.maximum(smooth, 1e-9)))


def widened(fit: SpreadFit, wheres: Mapping[int, str]) -> SpreadFit:
    """The fit with what gains of repeated frames (group -> where they were read) leave open in their intervals."""
    gain_sd, slope_sd = fit.gain_sd_DN.copy(), fit.slope_sd_DN.copy()
    for group, where in wheres.items():
        share = np.hypot(LATER_SD, BEHIND_SD if where == BEHIND else 0.0)
        gain_sd[group] = np.hypot(gain_sd[group], share * abs(fit.gain_DN[group]))
        slope_sd[group] = np.hypot(slope_sd[group], share * abs(fit.slope_DN[group]))
    return replace(fit, gain_sd_DN=gain_sd, slope_sd_DN=slope_sd)


def most_read_variance(darks: Sequence[tuple[NDArray[np.float64], int]], good: NDArray[np.bool_]) -> float | None:
    """Largest read variance of one exposure (DN^2) that the difference of two mean darks leaves; None without two.

    Neighbours' differences of the difference: half their mean square is the noise of both, and whatever differs between
    the darks' patterns.

    Args:
        darks: mean dark frame (row, column) and how many exposures it is the mean of.
        good: pixels that are not bad.
    """
    pair = good[:, 1:] & good[:, :-1]
    found = []
    for number, (first, first_count) in enumerate(darks):
        for second, second_count in darks[number + 1 :]:
            difference = first - second
            steps = (difference[:, 1:] - difference[:, :-1])[pair]
            if steps.size:
                # pixels whose dark grows unlike their neighbours' are cut off
                spread = robust_sd(steps) ** 2
                found.append(0.5 * spread / (1.0 / first_count + 1.0 / second_count))
    return _MARGIN * min(found) if found else None


def evidence_of(repeated: Sequence[RepeatedFrames], good: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """Plain rows, one a beam: which series, which pixels, and how many of them."""
    rows = []
    for beam in dict.fromkeys(item.beam for item in repeated):
        groups = [item for item in repeated if item.beam == beam]
        members = [member for item in groups for member in item.members]
        rows.append(
            {
                "kV": beam[0],
                "filter": text_from_filters(members[0][0].filters),
                "series": [item.name for item, *_ in members],
                "where": groups[0].where,
                "share_percent": 100.0 * float(np.mean([mask.sum() for *_, mask in members])) / max(int(good.sum()), 1),
                "samples": sum(item.samples for item in groups),
            }
        )
    return rows


def warning_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """One line: where the noise comes from, and what it can then not tell."""
    beams = ", ".join(
        ("unknown kV" if row["kV"] is None else f"{row['kV']:g} kV") + f" {row['filter']}".rstrip() for row in rows
    )
    places = " and ".join(dict.fromkeys(str(row["where"]) for row in rows))
    number = sum(len(row["series"]) for row in rows)
    return (
        f"flats of {beams} are single frames: gain, optical spread and read noise come from the repeated frames of"
        f" {number} other series ({places}); noise that has changed since the flats cannot be seen"
    )
