"""Noise of a session's darks and flats: one spread and gain through all of its sources, and the flats that it leaves out."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import AcquisitionFile, Series
from ...acquisition.instrument import Instrument
from ...errors import FitError, InputError
from ...generator.line.twin import Z95
from ...materials import material_from_name
from ..frames._kept_sums import KeptSums
from ..frames.dark_frames import DarkFrames
from ..frames.frame_memory import FrameMemory, frame_memory
from ..spread.spread_families import spread_axes
from ..spread.spread_fit import SpreadFit, fit_spread
from .noise_sources import FlatPair, NoiseSource, noise_sources
from .repeated_frames import Beam, RepeatedFrames, beam_of, most_read_variance, widened

# Elements of converters that free charge instead of light (Kasap et al., Sensors 11 (2011) 5112): nothing spreads as in a screen.
_PHOTOCONDUCTORS = tuple(
    frozenset(elements.split())
    for elements in ("Se", "Si", "Ge", "Ga As", "Cd Te", "Cd Zn Te", "Hg I", "Pb I", "Pb O", "C")
)


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
        return _places_in_fit((*self.of_stacks, *self.of_pairs, *self.of_others))

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
    counting = bool(acquisition.instrument.counting)
    sources = noise_sources(stacks, pairs, others, darks, good, group_of, counting=counting, estimator=estimator)
    warnings = [f"left out of the fit: {name} (no signal above dark)" for name in _left_out(stacks, sources)]
    _check_noise(acquisition, sources)
    tell("spread and gain")
    axes, other_axes = spread_axes(
        acquisition.instrument, [item.power for item in sources if item.in_fit and item.is_lit]
    )
    warnings += [] if other_axes is None else [other_axes]
    fit, sources, places_bent = _fit_without_bent(
        sources,
        len(stacks),
        most_read_DN2=_most_read(darks, good, sources, counting=counting),
        screen=_has_screen(acquisition.instrument),
        axes=axes,
    )
    memory = frame_memory(stacks, darks, good)
    if memory is not None:
        fit = _widened_by_memory(fit, memory)
        warnings.append(_warning_of_memory(memory))
    _check_gain(fit, memory)
    bent = [stacks[place][0].name for place in places_bent]
    warnings += [
        f"left out of the fit: {name} (its variance bends away from the photon-transfer line)" for name in bent
    ]
    if others:
        places = _places_in_fit(sources)
        wheres = {group_of[item.beam]: item.where for item in others}
        fit = widened(fit, {places[group]: where for group, where in wheres.items() if group in places})
    left_out = _left_out(stacks, sources)
    fitted = {item.group for item in sources if item.in_fit}
    ends = np.cumsum([0, len(stacks), len(pairs), len(others), len(darks.repeated)])
    of_stacks, of_pairs, of_others, of_darks = (tuple(sources[start:end]) for start, end in pairwise(ends))
    return FlatNoise(
        fit=fit,
        beams=tuple(beams),
        flats=tuple(flats),
        group_of_flat=tuple(group_of[beam_of(item)] for item, _ in flats),
        flat_in_fit=tuple(item.name not in left_out and group_of[beam_of(item)] in fitted for item, _ in flats),
        stacks=tuple(stacks),
        of_stacks=of_stacks,
        of_pairs=of_pairs,
        of_others=of_others,
        of_darks=of_darks,
        bent=frozenset(bent),
        warnings=tuple(warnings),
    )


def _has_screen(instrument: Instrument) -> bool:
    """Whether a screen that gives light is declared."""
    layers = instrument.scintillator or ()
    elements = [frozenset(material_from_name(layer.material).mass_fractions) for layer in layers]
    return bool(elements) and not instrument.counting and not set(elements) <= set(_PHOTOCONDUCTORS)


def _left_out(stacks: Sequence[tuple[Series, KeptSums]], sources: Sequence[NoiseSource]) -> list[str]:
    """Names of stacks that are not in use; the sources begin with those of the stacks."""
    return [item.name for (item, _), source in zip(stacks, sources, strict=False) if not source.in_fit]


def _places_in_fit(sources: Sequence[NoiseSource]) -> dict[int, int]:
    """Where the fit has a group that is in use, by group."""
    return {group: place for place, group in enumerate(sorted({i.group for i in sources if i.in_fit and i.is_lit}))}


def _check_noise(acquisition: AcquisitionFile, sources: Sequence[NoiseSource]) -> None:
    """Raise InputError where no flat has signal, or none has noise."""
    if not any(item.in_fit and item.is_lit for item in sources):
        raise InputError(
            f"acquisition {acquisition.path}",
            received="flats no brighter than the darks",
            expected="flats with signal above dark",
            remedy="check that the series' kinds are not swapped",
        )
    if not any(np.any(item.power.power_DN2 > 0) for item in sources if item.is_lit):
        raise InputError(
            f"acquisition {acquisition.path}",
            received="flats whose frames do not differ in any pixel",
            expected="frames with noise of their own, from which the gain comes",
            remedy="take them again: these are copies of one frame, or images without noise",
        )


def _most_read(
    darks: DarkFrames, good: NDArray[np.bool_], sources: Sequence[NoiseSource], *, counting: bool
) -> float | None:
    """Read variance that darks allow at most, DN^2: a counter has none, and darks that are single means bound it by their
    difference; None where it is measured, or nothing bounds it."""
    if counting and not any(item.in_fit for item in sources if not item.is_lit):
        return 0.0
    if darks.effective != 0:
        return None
    return most_read_variance([(total.mean_DN, total.frames * item.averaged) for item, total in darks.sums], good)


def _fit_without_bent(
    sources: Sequence[NoiseSource], stacks: int, *, most_read_DN2: float | None, screen: bool, axes: str
) -> tuple[SpreadFit, list[NoiseSource], list[int]]:
    """The fit to the sources in use, less bright flats whose variance bends away from the line; so many first ones are stacks.

    A flat above full well or bent by nonlinearity lies below the line: the brightest is dropped while it does.

    Returns:
        fit, all sources, and the places of those that were dropped.
    """
    kept = list(sources)
    bent: list[int] = []
    while True:
        fit = _fit(kept, most_read_DN2=most_read_DN2, screen=screen, axes=axes)
        worst = _bent(kept, stacks, fit)
        if worst is None:
            return fit, kept, bent
        kept[worst] = replace(kept[worst], in_fit=False)
        bent.append(worst)


def _widened_by_memory(fit: SpreadFit, memory: FrameMemory) -> SpreadFit:
    """The quanta's share lies between what pairs show and what many frames do, and so does that of the electronics."""
    off = abs(memory.ratio - 1.0) / Z95
    return replace(
        fit,
        gain_sd_DN=np.hypot(fit.gain_sd_DN, off * fit.gain_DN),
        shared_gain_sd=math.hypot(fit.shared_gain_sd, off),
        read_sd_DN2=math.hypot(fit.read_sd_DN2, off * fit.read_variance_DN2),
    )


def _warning_of_memory(memory: FrameMemory) -> str:
    return (
        f"noise of a frame is correlated with that of the next one by {100.0 * memory.next_frame:.2g} %: an image lag or a"
        f" recursive filter; noise of many frames is {memory.ratio:.3g} times that of pairs, and the gains' intervals hold both"
    )


def _check_gain(fit: SpreadFit, memory: FrameMemory | None) -> None:
    """Raise FitError where no gain's interval leaves 0 out."""
    half = Z95 * fit.gain_sd_DN
    if not np.all(fit.gain_DN < half):
        return
    best = int(np.argmax(fit.gain_DN / half))
    why = (
        "the spread is too wide for frames of this size, or what changes between the frames hides the quanta: take larger frames,"
        " in a row"
        if memory is None or memory.ratio < 2.0
        else f"{_warning_of_memory(memory)}: switch filters off, or take single frames with pauses"
    )
    raise FitError(f"the noise tells no gain: {fit.gain_DN[best]:.3g} +- {half[best]:.2g} DN at best; {why}")


def _fit(sources: Sequence[NoiseSource], *, most_read_DN2: float | None, screen: bool, axes: str) -> SpreadFit:
    """The fit to the sources in use; groups of them numbered anew."""
    kept = [item for item in sources if item.in_fit]
    places = _places_in_fit(kept)
    return fit_spread(
        [item.power for item in kept],
        group=[places[item.group] if item.is_lit else -1 for item in kept],
        most_read_DN2=most_read_DN2,
        screen=screen,
        axes=axes,
    )


def _bent(sources: Sequence[NoiseSource], stacks: int, fit: SpreadFit) -> int | None:
    """Place of the brightest flat of a beam if its variance lies 6 sigma and 5 % below the line through the others; so many first
    sources are stacks."""
    expected = iter(fit.expected_DN2)
    variances_DN2 = [item.power.variance_DN2(next(expected)) if item.in_fit else 0.0 for item in sources]
    # the bent flat is in the fit and moves its read variance, so that of the darks is taken where there are any
    darks = [place for place, item in enumerate(sources) if not item.is_lit]
    read = (
        float(np.average([variances_DN2[i] for i in darks], weights=[sources[i].power.samples for i in darks]))
        if darks
        else fit.read_variance_DN2
    )
    own = [place for place, item in enumerate(sources[:stacks]) if item.in_fit]
    for group in sorted({sources[place].group for place in own}):
        members = [place for place in own if sources[place].group == group]
        if len(members) < 3:
            continue
        brightest = max(members, key=lambda place: sources[place].power.signal_DN)
        signal = np.array([sources[place].power.signal_DN for place in members])
        variance = np.array([variances_DN2[place] - read for place in members])
        sd = np.array([math.sqrt(2.0 / sources[place].power.samples) * variances_DN2[place] for place in members])
        if _is_below_line(signal, variance, sd, members.index(brightest)):
            return brightest
    return None


def _is_below_line(
    signal: NDArray[np.float64], variance: NDArray[np.float64], sd: NDArray[np.float64], place: int
) -> bool:
    """Whether the variance at a place lies 6 sigma and 5 % below the line through 0 and the others; sd: of the variances."""
    others = np.arange(len(signal)) != place
    weight = signal[others] ** 2 / sd[others] ** 2
    ratio = variance[others] / signal[others]
    slope = float(np.sum(weight * ratio) / np.sum(weight))
    scatter = float(np.sum(weight * (ratio - slope) ** 2)) / max(len(ratio) - 1, 1)
    slope_sd = math.sqrt(max(scatter, 1.0) / float(np.sum(weight)))
    measured, measured_sd = float(variance[place] / signal[place]), float(sd[place] / signal[place])
    return measured - slope < -6.0 * math.hypot(slope_sd, measured_sd) and measured < 0.95 * slope
