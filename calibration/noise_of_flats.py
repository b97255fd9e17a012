"""Noise of a session's darks and flats: noise power of each series, and one spread and gain through all of them."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..acquisition.instrument import Instrument
from ..errors import FitError, InputError
from ..generator.line.twin import Z95
from ..materials import material_from_name
from ._kept_sums import KeptSums
from .dark_frames import DarkFrames
from .frame_memory import frame_memory
from .frame_sums import PIECE_BYTES, effective_frames
from .noise_power import NoisePower, compute_difference_power, compute_noise_power
from .repeated_frames import Beam, RepeatedFrames, beam_of, most_read_variance, widened
from .spread_families import spread_axes
from .spread_fit import SpreadFit, fit_spread

# Elements of converters that free charge instead of light (Kasap et al., Sensors 11 (2011) 5112): nothing spreads as in a screen.
_PHOTOCONDUCTORS = tuple(
    frozenset(elements.split())
    for elements in ("Se", "Si", "Ge", "Ga As", "Cd Te", "Cd Zn Te", "Hg I", "Pb I", "Pb O", "C")
)
POWER_FRAMES = 400
_POWER_SAMPLES = 3e7  # pixels x frames a series; the gain is then known to about 0.1 %


@dataclass(frozen=True, slots=True, kw_only=True)
class FlatPair:
    """Two single (averaged) flats of one beam, in different series, whose normalised difference holds noise.

    Fields: beam; first, second: series with their sums; share: of an independent difference that it counts as, less than 1
    where a flat stands in two of them.
    """

    beam: Beam
    first: tuple[Series, KeptSums]
    second: tuple[Series, KeptSums]
    share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseSource:
    """Noise power of one source, the beam's place in the fit's groups (-1: darks), and whether it is in use."""

    power: NoisePower
    group: int
    in_fit: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class FlatNoise:
    """Spread and gain of the beams, and what they were fitted to.

    Fields: fit, its groups the beams in use in their order; beams, in order of voltage; flats, with their sums: those that
    calibrate; group_of_flat, their beams' places in `beams`; flat_in_fit: whether each is in use; stacks: those of them with
    noise of their own; of_stacks, of_pairs, of_others, of_darks: sources of noise, in the order of stacks, pairs of single
    flats, other series and repeated darks; bent: series left out because their variance bends away from the line; warnings.
    """

    fit: SpreadFit
    beams: tuple[Beam, ...]
    flats: tuple[tuple[Series, KeptSums], ...]
    group_of_flat: tuple[int, ...]
    flat_in_fit: tuple[bool, ...]
    stacks: tuple[tuple[Series, KeptSums], ...]
    of_stacks: tuple[NoiseSource, ...]
    of_pairs: tuple[NoiseSource, ...]
    of_others: tuple[NoiseSource, ...]
    of_darks: tuple[NoiseSource, ...]
    bent: frozenset[str]
    warnings: tuple[str, ...]

    @property
    def place_in_fit(self) -> dict[int, int]:
        """Where the fit has a group that is in use, by group."""
        lit = (*self.of_stacks, *self.of_pairs, *self.of_others)
        return {group: place for place, group in enumerate(sorted({item.group for item in lit if item.in_fit}))}

    @property
    def flats_in_fit(self) -> list[tuple[Series, KeptSums, int]]:
        """Flats in use, their sums, and the place of their beam in the fit."""
        places = self.place_in_fit
        every = zip(self.flats, self.group_of_flat, self.flat_in_fit, strict=True)
        return [(item, total, places[group]) for (item, total), group, keep in every if keep]

    def slope_of_single(self, beam: Beam) -> tuple[float, float] | None:
        """Photon-transfer slope (DN) and common factor's variance of a beam without repeated flats; None where it has none."""
        group = self.beams.index(beam)
        mine = [item for item in (*self.of_pairs, *self.of_others) if item.group == group and item.in_fit]
        if not mine or group not in self.place_in_fit:
            return None
        common = float(np.average([item.power.common_mode for item in mine], weights=[i.power.samples for i in mine]))
        return float(self.fit.slope_DN[self.place_in_fit[group]]), common


def fit_flat_noise(
    acquisition: AcquisitionFile,
    flats: Sequence[tuple[Series, KeptSums]],
    pairs: Sequence[FlatPair],
    others: Sequence[RepeatedFrames],
    darks: DarkFrames,
    good: NDArray[np.bool_],
    *,
    estimator: str,
    tell: Callable[[str], None],
) -> FlatNoise:
    """Spread and gain through flats, darks, and what stands for the noise of single-frame flats.

    Args:
        acquisition: of the series, for messages.
        flats: with their sums: those that calibrate.
        pairs: of single flats of one beam.
        others: what was repeated at the beams of single-frame flats.
        darks: dark frames.
        good: pixels in use (row, column).
        estimator: as in `compute_photon_transfer`.
        tell: called with the name of the stage.

    Raises:
        InputError: no flat has signal above dark, or none has noise.
        FitError: the noise tells no gain.
    """
    tell("noise power")
    beams = sorted({beam_of(item) for item, _ in flats}, key=lambda key: (key[0] is None, key[0] or 0.0, str(key[1])))
    group_of = {beam: index for index, beam in enumerate(beams)}
    stacks = [(item, total) for item, total in flats if total.pairs > 0]

    def of_series(item: Series, total: KeptSums, mask: NDArray[np.bool_]) -> NoisePower:
        return _power(item, total, total.mean_DN - darks.of(item), good=mask, estimator=estimator)

    found = [(of_series(item, total, good), group_of[beam_of(item)]) for item, total in stacks]
    shapes = _shapes_of_beams(pairs, darks, good)
    found += [(_pair_power(pair, darks, good, shapes[pair.beam]), group_of[pair.beam]) for pair in pairs]
    found += [(other.power(of_series), group_of[other.beam]) for other in others]
    dark_signal = np.zeros(good.shape)
    found += [(_power(item, total, dark_signal, good=good, estimator=estimator), -1) for item, total in darks.repeated]
    powers = [power for power, _ in found]
    groups = [group for _, group in found]
    counting = bool(acquisition.instrument.counting)
    # darks of a counter without any count say what its declaration does: there is no electronic noise
    in_fit = [
        item.signal_DN > 0 if group >= 0 else not counting or float(np.nanmax(item.power_DN2)) > 0
        for item, group in found
    ]
    silent = not any(keep for keep, group in zip(in_fit, groups, strict=True) if group < 0)
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
    if not any(np.any(power.power_DN2 > 0) for power, group in found if group >= 0):
        raise InputError(
            f"acquisition {acquisition.path}",
            received="flats whose frames do not differ in any pixel",
            expected="frames with noise of their own, from which the gain comes",
            remedy="take them again: these are copies of one frame, or images without noise",
        )
    tell("spread and gain")
    # darks that are single means bound the read noise by their difference
    means = [(total.mean_DN, total.frames * item.averaged) for item, total in darks.sums]
    most_read = most_read_variance(means, good) if darks.effective == 0 else None
    if counting and silent:
        most_read = 0.0  # a counter has no electronic noise
    instrument = acquisition.instrument
    lit = [power for power, group, keep in zip(powers, groups, in_fit, strict=True) if keep and group >= 0]
    axes, other_axes = spread_axes(instrument, lit)
    warnings += [] if other_axes is None else [other_axes]
    fit_spread_to = partial(_fit, powers, groups, most_read_DN2=most_read, screen=_has_screen(instrument), axes=axes)
    fit = fit_spread_to(in_fit)
    # a flat above full well or bent by nonlinearity lies below the line: drop the brightest while it does
    bent: list[str] = []
    while True:
        expected = iter(fit.expected_DN2)
        variances = [
            item.variance_DN2(next(expected)) if keep else 0.0 for item, keep in zip(powers, in_fit, strict=True)
        ]
        worst = _bent(powers, variances, groups, [keep and i < len(stacks) for i, keep in enumerate(in_fit)], fit)
        if worst is None:
            break
        in_fit[worst] = False
        bent.append(stacks[worst][0].name)
        fit = fit_spread_to(in_fit)
    memory = frame_memory(stacks, darks, good)
    if memory is not None:
        # the quanta's share lies between what pairs show and what many frames do, and so does that of the electronics
        off = abs(memory.ratio - 1.0) / Z95
        fit = replace(
            fit,
            gain_sd_DN=np.hypot(fit.gain_sd_DN, off * fit.gain_DN),
            shared_gain_sd=math.hypot(fit.shared_gain_sd, off),
            read_sd_DN2=math.hypot(fit.read_sd_DN2, off * fit.read_variance_DN2),
        )
        warnings.append(
            f"noise of a frame is correlated with that of the next one by {100.0 * memory.next_frame:.2g} %: an image lag or a"
            f" recursive filter; noise of many frames is {memory.ratio:.3g} times that of pairs, and the gains' intervals hold both"
        )
    half = Z95 * fit.gain_sd_DN
    if np.all(fit.gain_DN < half):
        best = int(np.argmax(fit.gain_DN / half))
        why = (
            "the spread is too wide for frames of this size, or what changes between the frames hides the quanta: take larger frames,"
            " in a row"
            if memory is None or memory.ratio < 2.0
            else f"{warnings[-1]}: switch filters off, or take single frames with pauses"
        )
        raise FitError(f"the noise tells no gain: {fit.gain_DN[best]:.3g} +- {half[best]:.2g} DN at best; {why}")
    warnings += [
        f"left out of the fit: {name} (its variance bends away from the photon-transfer line)" for name in bent
    ]
    if others:
        present = sorted({group for group, keep in zip(groups, in_fit, strict=True) if keep and group >= 0})
        wheres = {group_of[item.beam]: item.where for item in others}
        fit = widened(fit, {present.index(group): where for group, where in wheres.items() if group in present})
    left_out = {item.name for (item, _), keep in zip(stacks, in_fit, strict=False) if not keep}
    fitted = {group for group, keep in zip(groups, in_fit, strict=True) if keep}
    sources = [
        NoiseSource(power=power, group=group, in_fit=keep)
        for power, group, keep in zip(powers, groups, in_fit, strict=True)
    ]
    ends = np.cumsum([0, len(stacks), len(pairs), len(others), len(darks.repeated)])
    parts = [tuple(sources[start:end]) for start, end in pairwise(ends)]
    return FlatNoise(
        fit=fit,
        beams=tuple(beams),
        flats=tuple(flats),
        group_of_flat=tuple(group_of[beam_of(item)] for item, _ in flats),
        flat_in_fit=tuple(item.name not in left_out and group_of[beam_of(item)] in fitted for item, _ in flats),
        stacks=tuple(stacks),
        of_stacks=parts[0],
        of_pairs=parts[1],
        of_others=parts[2],
        of_darks=parts[3],
        bent=frozenset(bent),
        warnings=tuple(warnings),
    )


def pairs_of_singles(flats: Sequence[tuple[Series, KeptSums]]) -> tuple[FlatPair, ...]:
    """Successive single flats of each beam as pairs, in the order in which they were taken."""
    by_beam: dict[Beam, list[tuple[Series, KeptSums]]] = {}
    for item, total in sorted(flats, key=lambda flat: (flat[0].session, flat[0].index)):
        by_beam.setdefault(beam_of(item), []).append((item, total))
    return tuple(
        FlatPair(beam=beam, first=first, second=second, share=effective_frames(len(members)) / (len(members) - 1))
        for beam, members in by_beam.items()
        for first, second in pairwise(members)
    )


def _has_screen(instrument: Instrument) -> bool:
    """Whether a screen that gives light is declared."""
    layers = instrument.scintillator or ()
    elements = [frozenset(material_from_name(layer.material).mass_fractions) for layer in layers]
    return bool(elements) and not instrument.counting and not set(elements) <= set(_PHOTOCONDUCTORS)


def _shapes_of_beams(
    pairs: Sequence[FlatPair], darks: DarkFrames, good: NDArray[np.bool_]
) -> dict[Beam, NDArray[np.float64]]:
    """Shape of each beam over its mean (row, column), from all of its single flats, the bright ones above all.

    A dim flat's own noise may be as large as its signal.
    """
    shapes: dict[Beam, NDArray[np.float64]] = {}
    for beam in {pair.beam for pair in pairs}:
        members = {item.name: (item, total) for pair in pairs if pair.beam == beam for item, total in _both(pair)}
        total_DN = np.zeros(good.shape)
        for item, total in members.values():
            total_DN += total.frames * item.averaged * (total.mean_DN - darks.of(item))
        mean_DN = float(np.mean(total_DN[good]))
        shapes[beam] = total_DN / mean_DN if mean_DN > 0 else np.ones(good.shape)
    return shapes


def _both(pair: FlatPair) -> tuple[tuple[Series, KeptSums], tuple[Series, KeptSums]]:
    return pair.first, pair.second


def _pair_power(pair: FlatPair, darks: DarkFrames, good: NDArray[np.bool_], shape: NDArray[np.float64]) -> NoisePower:
    """Noise power of one exposure from a pair of single flats of a beam of this shape (row, column), DN^2."""
    (first, first_sum), (second, second_sum) = pair.first, pair.second
    counts = (darks.exposures_of(first), darks.exposures_of(second))
    found = compute_difference_power(
        first_sum.mean_DN - darks.of(first),
        second_sum.mean_DN - darks.of(second),
        exposures=(first_sum.frames * first.averaged, second_sum.frames * second.averaged),
        dark_exposures=counts,
        same_dark=darks.key_of(first) == darks.key_of(second),
        good=good,
        shape=shape,
    )
    averaged = min(first.averaged, second.averaged)
    stored = replace(found, modes=pair.share * found.modes).times(1.0 / averaged)
    return stored.as_exposure(averaged, whole=first_sum.integer and second_sum.integer)


def _power(
    item: Series,
    total: KeptSums,
    signal: NDArray[np.float64],
    *,
    good: NDArray[np.bool_],
    estimator: str,
) -> NoisePower:
    """Noise power of a series in one exposure, DN^2."""
    most = int(min(total.frames, POWER_FRAMES, max(2, _POWER_SAMPLES // good.size)))

    def pieces() -> Iterator[NDArray[np.generic]]:
        left = most
        for piece in item.iter_frames(maximum_bytes=PIECE_BYTES):
            yield piece[:left]
            left -= piece.shape[0]
            if left <= 0:
                return

    about = (total.mean_DN, total.frames) if estimator == "stack" else None
    found = compute_noise_power(pieces(), signal_DN=signal, good=good, about=about)
    return found.as_exposure(item.averaged, whole=total.integer)


def _fit(
    powers: Sequence[NoisePower],
    groups: Sequence[int],
    usable: Sequence[bool],
    *,
    most_read_DN2: float | None,
    screen: bool,
    axes: str,
) -> SpreadFit:
    """The fit to the usable powers; groups of them numbered anew."""
    kept = [index for index, keep in enumerate(usable) if keep]
    present = sorted({groups[index] for index in kept if groups[index] >= 0})
    renumbered = {old: new for new, old in enumerate(present)} | {-1: -1}
    return fit_spread(
        [powers[index] for index in kept],
        group=[renumbered[groups[index]] for index in kept],
        most_read_DN2=most_read_DN2,
        screen=screen,
        axes=axes,
    )


def _bent(
    powers: Sequence[NoisePower],
    variances_DN2: Sequence[float],
    groups: Sequence[int],
    usable: Sequence[bool],
    fit: SpreadFit,
) -> int | None:
    """Index of the brightest flat of a group if its variance lies 6 sigma and 5 % below the line through the others."""
    present = sorted({group for group, keep in zip(groups, usable, strict=True) if keep and group >= 0})
    # the bent flat is in the fit and moves its read variance, so that of the darks is taken where there are any
    darks = [i for i, group in enumerate(groups) if group < 0]
    read = (
        float(np.average([variances_DN2[i] for i in darks], weights=[powers[i].samples for i in darks]))
        if darks
        else fit.read_variance_DN2
    )
    for group in present:
        members = [i for i, g in enumerate(groups) if g == group and usable[i]]
        if len(members) < 3:
            continue
        brightest = max(members, key=lambda i: powers[i].signal_DN)
        others = [i for i in members if i != brightest]
        signal = np.array([powers[i].signal_DN for i in others])
        variance = np.array([variances_DN2[i] - read for i in others])
        sd = np.array([math.sqrt(2.0 / powers[i].samples) * variances_DN2[i] for i in others])
        weight = signal**2 / sd**2
        ratio = variance / signal
        slope = float(np.sum(weight * ratio) / np.sum(weight))
        scatter = float(np.sum(weight * (ratio - slope) ** 2)) / max(len(others) - 1, 1)
        slope_sd = math.sqrt(max(scatter, 1.0) / float(np.sum(weight)))
        item = powers[brightest]
        measured = (variances_DN2[brightest] - read) / item.signal_DN
        measured_sd = math.sqrt(2.0 / item.samples) * variances_DN2[brightest] / item.signal_DN
        if measured - slope < -6.0 * math.hypot(slope_sd, measured_sd) and measured < 0.95 * slope:
            return brightest
    return None
