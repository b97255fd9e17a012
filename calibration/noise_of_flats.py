"""Noise of a session's darks and flats: covariances of neighbours, and one spread and gain through all of them."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..errors import InputError
from ._kept_sums import KeptSums
from .dark_frames import DarkFrames
from .noise_covariance import NoiseCovariance, SpreadFit, compute_noise_covariance, fit_spread
from .repeated_frames import Beam, RepeatedFrames, beam_of, bounded_read_variance, most_read_variance, widened

COVARIANCE_FRAMES = 400
PIECE_BYTES = 8 * 2**20
_COVARIANCE_SAMPLES = 6e7  # pixels x frames a series; the gain is then known to about 0.05 %


@dataclass(frozen=True, slots=True, kw_only=True)
class FlatNoise:
    """Spread and gain of the beams, and what they were fitted to.

    Fields: fit, its groups the beams in use in their order; beams, in order of voltage; flats, with their sums: those that calibrate;
    group_of_flat, their beams' places in `beams`; flat_in_fit: whether each is in use; stacks: those of them with noise of their own;
    covariances of stacks, other series and darks, one after the other; groups of these, -1 for darks; in_fit: which of them are in
    use; bent: series left out because their variance bends away from the line; warnings.
    """

    fit: SpreadFit
    beams: tuple[Beam, ...]
    flats: tuple[tuple[Series, KeptSums], ...]
    group_of_flat: tuple[int, ...]
    flat_in_fit: tuple[bool, ...]
    stacks: tuple[tuple[Series, KeptSums], ...]
    covariances: tuple[NoiseCovariance, ...]
    groups: tuple[int, ...]
    in_fit: tuple[bool, ...]
    bent: frozenset[str]
    warnings: tuple[str, ...]

    @property
    def place_in_fit(self) -> dict[int, int]:
        """Where the fit has a group that is in use, by group."""
        present = sorted({group for group, keep in zip(self.groups, self.in_fit, strict=True) if keep and group >= 0})
        return {group: place for place, group in enumerate(present)}

    @property
    def flats_in_fit(self) -> list[tuple[Series, KeptSums, int]]:
        """Flats in use, their sums, and the place of their beam in the fit."""
        places = self.place_in_fit
        every = zip(self.flats, self.group_of_flat, self.flat_in_fit, strict=True)
        return [(item, total, places[group]) for (item, total), group, keep in every if keep]

    @property
    def covariances_of_others(self) -> tuple[NoiseCovariance, ...]:
        """Of series that are no flats in use, in their order."""
        return self.covariances[len(self.stacks) : sum(group >= 0 for group in self.groups)]


def fit_flat_noise(
    acquisition: AcquisitionFile,
    flats: Sequence[tuple[Series, KeptSums]],
    others: Sequence[RepeatedFrames],
    darks: DarkFrames,
    good: NDArray[np.bool_],
    *,
    radius: int,
    estimator: str,
    tell: Callable[[str], None],
) -> FlatNoise:
    """Spread and gain through flats, darks, and other series that stand for single-frame flats.

    Args:
        acquisition: of the series, for messages.
        flats: with their sums: those that calibrate.
        others: what was repeated at the beams of single-frame flats.
        darks: dark frames.
        good: pixels in use (row, column).
        radius: largest lag, px; a wider spread takes more.
        estimator: as in `compute_photon_transfer`.
        tell: called with the name of the stage.

    Raises:
        InputError: no flat has signal above dark.
    """
    tell("noise covariances")
    beams = sorted({beam_of(item) for item, _ in flats}, key=lambda key: (key[0] is None, key[0] or 0.0, str(key[1])))
    group_of = {beam: index for index, beam in enumerate(beams)}
    stacks = [(item, total) for item, total in flats if total.pairs > 0]
    groups = [
        *(group_of[beam_of(item)] for item, _ in stacks),
        *(group_of[other.beam] for other in others),
        *(-1 for _ in darks.repeated),
    ]

    def collect(reach: int) -> list[NoiseCovariance]:
        def of_series(item: Series, total: KeptSums, mask: NDArray[np.bool_]) -> NoiseCovariance:
            signal = total.mean_DN - darks.of(item)
            return _covariance(item, total, signal, good=mask, radius=reach, estimator=estimator)

        def of_dark(item: Series, total: KeptSums) -> NoiseCovariance:
            return _covariance(item, total, np.zeros(good.shape), good=good, radius=reach, estimator=estimator)

        return [
            *(of_series(item, total, good) for item, total in stacks),
            *(other.covariance(of_series) for other in others),
            *(of_dark(item, total) for item, total in darks.repeated),
        ]

    covariances = collect(radius)
    in_fit = [item.signal_DN > 0 or group < 0 for item, group in zip(covariances, groups, strict=True)]
    warnings = [
        f"left out of the fit: {item.name} (no signal above dark)"
        for (item, _), keep in zip(stacks, in_fit, strict=False)
        if not keep
    ]
    if not any(keep for keep, group in zip(in_fit, groups, strict=True) if group >= 0):
        raise InputError(
            f"acquisition {acquisition.path}",
            received="flats no brighter than the darks",
            expected="flats with signal above dark",
            remedy="check that the series' kinds are not swapped",
        )
    tell("spread and gain")
    fit = _fit(covariances, groups, in_fit, radius)
    most = (min(good.shape) - 1) // 4
    wider = min(math.ceil(4 * math.sqrt(2) * fit.sigma_px), most, *(item.reach for item in others))
    if wider > radius:
        radius = wider
        covariances = collect(radius)
        fit = _fit(covariances, groups, in_fit, radius)
    # a flat above full well or bent by nonlinearity lies below the line: drop the brightest while it does
    bent: list[str] = []
    of_others = range(len(stacks), len(stacks) + len(others))
    while True:
        worst = _bent(covariances, groups, [keep and i not in of_others for i, keep in enumerate(in_fit)], fit)
        if worst is None:
            break
        in_fit[worst] = False
        bent.append(stacks[worst][0].name)
        fit = _fit(covariances, groups, in_fit, radius)
    warnings += [
        f"left out of the fit: {name} (its variance bends away from the photon-transfer line)" for name in bent
    ]
    if others:
        fit = _with_others(fit, groups, in_fit, {group_of[item.beam]: item.where for item in others}, darks, good)
    left_out = {item.name for (item, _), keep in zip(stacks, in_fit, strict=False) if not keep}
    fitted = {group for group, keep in zip(groups, in_fit, strict=True) if keep}
    return FlatNoise(
        fit=fit,
        beams=tuple(beams),
        flats=tuple(flats),
        group_of_flat=tuple(group_of[beam_of(item)] for item, _ in flats),
        flat_in_fit=tuple(item.name not in left_out and group_of[beam_of(item)] in fitted for item, _ in flats),
        stacks=tuple(stacks),
        covariances=tuple(covariances),
        groups=tuple(groups),
        in_fit=tuple(in_fit),
        bent=frozenset(bent),
        warnings=tuple(warnings),
    )


def _covariance(
    item: Series,
    total: KeptSums,
    signal: NDArray[np.float64],
    *,
    good: NDArray[np.bool_],
    radius: int,
    estimator: str,
) -> NoiseCovariance:
    """Neighbour covariances of a series in one exposure, DN^2."""
    most = int(min(total.frames, COVARIANCE_FRAMES, max(2, _COVARIANCE_SAMPLES // good.size)))

    def pieces() -> Iterator[NDArray[np.generic]]:
        left = most
        for piece in item.iter_frames(maximum_bytes=PIECE_BYTES):
            yield piece[:left]
            left -= piece.shape[0]
            if left <= 0:
                return

    result = compute_noise_covariance(
        pieces(),
        signal_DN=signal,
        good=good,
        radius=radius,
        about=(total.mean_DN, total.frames) if estimator == "stack" else None,
    )
    return replace(result, covariance_DN2=result.covariance_DN2 * item.averaged)


def _fit(
    covariances: Sequence[NoiseCovariance], groups: Sequence[int], usable: Sequence[bool], radius: int
) -> SpreadFit:
    """The fit to the usable covariances; groups of them numbered anew."""
    kept = [index for index, keep in enumerate(usable) if keep]
    present = sorted({groups[index] for index in kept if groups[index] >= 0})
    renumbered = {old: new for new, old in enumerate(present)} | {-1: -1}
    return fit_spread(
        [covariances[index] for index in kept], group=[renumbered[groups[index]] for index in kept], radius=radius
    )


def _bent(
    covariances: Sequence[NoiseCovariance], groups: Sequence[int], usable: Sequence[bool], fit: SpreadFit
) -> int | None:
    """Index of the brightest flat of a group if its variance lies 6 sigma and 5 % below the line through the others."""
    present = sorted({group for group, keep in zip(groups, usable, strict=True) if keep and group >= 0})
    # the bent flat is in the fit and moves its read variance, so that of the darks is taken where there are any
    darks = [c for c, group in zip(covariances, groups, strict=True) if group < 0]
    read = (
        float(np.average([c.covariance_DN2[c.radius, c.radius] for c in darks], weights=[c.samples for c in darks]))
        if darks
        else fit.read_variance_DN2
    )
    for group in present:
        members = [i for i, g in enumerate(groups) if g == group and usable[i]]
        if len(members) < 3:
            continue
        brightest = max(members, key=lambda i: covariances[i].signal_DN)
        others = [i for i in members if i != brightest]

        def zero_lag(i: int) -> float:
            centre = covariances[i].radius
            return float(covariances[i].covariance_DN2[centre, centre]) - read

        signal = np.array([covariances[i].signal_DN for i in others])
        variance = np.array([zero_lag(i) for i in others])
        sd = np.array([math.sqrt(2.0 / covariances[i].samples) * (zero_lag(i) + read) for i in others])
        weight = signal**2 / sd**2
        ratio = variance / signal
        slope = float(np.sum(weight * ratio) / np.sum(weight))
        scatter = float(np.sum(weight * (ratio - slope) ** 2)) / max(len(others) - 1, 1)
        slope_sd = math.sqrt(max(scatter, 1.0) / float(np.sum(weight)))
        item = covariances[brightest]
        measured = zero_lag(brightest) / item.signal_DN
        measured_sd = math.sqrt(2.0 / item.samples) * (measured + read / item.signal_DN)
        if measured - slope < -6.0 * math.hypot(slope_sd, measured_sd) and measured < 0.95 * slope:
            return brightest
    return None


def _with_others(
    fit: SpreadFit,
    groups: Sequence[int],
    usable: Sequence[bool],
    wheres: Mapping[int, str],
    darks: DarkFrames,
    good: NDArray[np.bool_],
) -> SpreadFit:
    """The fit with what the noise of other series leaves open; a read variance without darks' noise is kept between 0 and
    what the darks' difference leaves."""
    present = sorted({group for group, keep in zip(groups, usable, strict=True) if keep and group >= 0})
    fit = widened(fit, {present.index(group): where for group, where in wheres.items() if group in present})
    if darks.effective > 0:
        return fit
    most = most_read_variance([(total.mean_DN, total.frames * item.averaged) for item, total in darks.sums], good)
    if most is None:
        return fit
    value, sd = bounded_read_variance(fit.read_variance_DN2, fit.read_sd_DN2, most)
    return replace(fit, read_variance_DN2=value, read_sd_DN2=sd)
