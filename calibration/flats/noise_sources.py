"""Sources of noise in a session: stacks of raw flats, pairs of single ones, other repeated series, darks."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import Series
from ..frames._kept_sums import KeptSums
from ..frames.dark_frames import DarkFrames
from ..frames.frame_sums import PIECE_BYTES, effective_frames
from ..spread.noise_power import NoisePower, compute_difference_power, compute_noise_power
from .repeated_frames import Beam, RepeatedFrames, beam_of

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

    @property
    def is_lit(self) -> bool:
        """Whether it is no dark."""
        return self.group >= 0


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


def noise_sources(
    stacks: Sequence[tuple[Series, KeptSums]],
    pairs: Sequence[FlatPair],
    others: Sequence[RepeatedFrames],
    darks: DarkFrames,
    good: NDArray[np.bool_],
    group_of: Mapping[Beam, int],
    *,
    counting: bool,
    estimator: str,
) -> list[NoiseSource]:
    """Noise power of stacks, pairs, other series and repeated darks, in this order.

    Args:
        stacks: series of raw frames, with their sums.
        pairs: of single flats of one beam.
        others: what was repeated at the beams of single-frame flats.
        darks: dark frames.
        good: pixels in use (row, column).
        group_of: place of each beam.
        counting: whether the detector counts.
        estimator: as in `compute_photon_transfer`.
    """

    def of_series(item: Series, total: KeptSums, mask: NDArray[np.bool_]) -> NoisePower:
        return _power(item, total, total.mean_DN - darks.of(item), good=mask, estimator=estimator)

    found = [(of_series(item, total, good), group_of[beam_of(item)]) for item, total in stacks]
    shapes = _shapes_of_beams(pairs, darks, good)
    found += [(_pair_power(pair, darks, good, shapes[pair.beam]), group_of[pair.beam]) for pair in pairs]
    found += [(other.power(of_series), group_of[other.beam]) for other in others]
    none = np.zeros(good.shape)
    found += [(_power(item, total, none, good=good, estimator=estimator), -1) for item, total in darks.repeated]
    return [
        NoiseSource(power=power, group=group, in_fit=_tells(power, group, counting=counting)) for power, group in found
    ]


def _tells(power: NoisePower, group: int, *, counting: bool) -> bool:
    """Whether a source tells something: a flat with signal, a dark.

    Darks of a counter without any count say what its declaration does: there is no electronic noise.
    """
    if group >= 0:
        return power.signal_DN > 0
    return not counting or float(np.nanmax(power.power_DN2)) > 0


def _shapes_of_beams(
    pairs: Sequence[FlatPair], darks: DarkFrames, good: NDArray[np.bool_]
) -> dict[Beam, NDArray[np.float64]]:
    """Shape of each beam over its mean (row, column), from all of its single flats, the bright ones above all.

    A dim flat's own noise may be as large as its signal.
    """
    shapes: dict[Beam, NDArray[np.float64]] = {}
    for beam in {pair.beam for pair in pairs}:
        members = {
            item.name: (item, total) for pair in pairs if pair.beam == beam for item, total in (pair.first, pair.second)
        }
        total_DN = np.zeros(good.shape)
        for item, total in members.values():
            total_DN += total.frames * item.averaged * (total.mean_DN - darks.of(item))
        mean_DN = float(np.mean(total_DN[good]))
        shapes[beam] = total_DN / mean_DN if mean_DN > 0 else np.ones(good.shape)
    return shapes


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
