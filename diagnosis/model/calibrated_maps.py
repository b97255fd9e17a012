"""What the calibrating series make of dark and gain map: how each adds to them, and the noise that they leave there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...errors import InputError
from ...generator.line.twin import LEAST_PIXELS, Twin
from ..arrays import BoolArray, FloatArray
from ..probes.fixed_pattern import smooth_part
from ..session.even_maps import full_size, mean_over
from ..session.session import SessionSeries
from ..session.usable import SeenSeries

LEAST_GAIN = 0.05  # of a pixel in use


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibratedDarks:
    """Darks as the calibrating series show them; the twin's where there are none."""

    twin: Twin
    weights: dict[float, dict[str, float]]  # of each calibrating dark, by name, in the dark of an exposure, ms
    means_DN: Mapping[str, FloatArray]  # (row, column), by name
    white_DN2: Mapping[str, FloatArray]  # (row, column or 1, 1), of one frame, by name
    frames: Mapping[str, int]  # of the calibrating series, copies left out, by name

    def under(self, item: SessionSeries) -> FloatArray:
        """Dark (row, column), DN, that is subtracted from a series; 0 where the series had it subtracted before."""
        if "offset" in item.series.corrected:
            return np.zeros(self.twin.maps.shape)
        weights = self.weights[exposure_of(item)]
        if not weights:
            return np.asarray(self.twin.maps.dark_at(item.series.exposure_ms), dtype=np.float64)
        result = np.zeros(self.twin.maps.shape)
        for name, weight in weights.items():
            result += weight * self.means_DN[name]
        return result

    def weights_under(self, item: SessionSeries) -> Mapping[str, float]:
        """Weight of each calibrating dark, by name, in the dark that is subtracted from a series."""
        return {} if "offset" in item.series.corrected else self.weights[exposure_of(item)]


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibratedMaps:
    """Dark and gain map."""

    darks: CalibratedDarks
    gain: FloatArray  # (row, column): what the calibrating flats show over what the smooth model expects
    shares: dict[str, float]  # of each calibrating flat in it, by name; none: the twin's gain map
    # (row, column): twin's flats of a series' beam over that map, smooth, by name, where it stands in
    beams: Mapping[str, FloatArray]
    gain_quantum: float  # relative variance of one pixel's gain, correlated as quanta are
    gain_white: float  # the same, white
    # change of the gain, 1/DN, when a calibrating dark, subtracted from the flats, is brighter, by name
    gain_darks: Mapping[str, float]
    good: BoolArray  # (row, column): pixels in use

    @property
    def read_DN2(self) -> float | None:
        """Variance of a pixel of the calibrating darks' frames, DN^2; None: there are none."""
        known = [mean_over(white_DN2, self.good) for white_DN2 in self.darks.white_DN2.values()]
        return sum(known) / len(known) if known else None

    def dark_noise(self, item: SessionSeries, signal_DN: FloatArray) -> FloatArray:
        """Variance, DN^2, that noise of darks gives a pixel of a corrected mean frame; of calibrating ones through the gain map too.

        signal_DN: of the series, of any shape, which the result has.
        """
        under = self.darks.weights_under(item)
        twin = self.darks.twin
        if not under and "offset" not in item.series.corrected:
            share = twin.maps.dark_noise_at(item.series.exposure_ms)
            return np.full(np.shape(signal_DN), share * twin.noise.read_noise_DN.value**2)
        divided = item.request.beam_on and "gain" not in item.series.corrected
        total = np.zeros(np.shape(signal_DN))
        for name, white_DN2 in self.darks.white_DN2.items():
            variance = mean_over(white_DN2, self.good) / self.darks.frames[name]
            own, divisor = under.get(name, 0.0), self.gain_darks[name] if divided else 0.0
            if own or divisor:
                total += (own + divisor * signal_DN) ** 2 * variance
        return total

    def corrected(self, item: SessionSeries, mean_DN: FloatArray) -> FloatArray:
        """A series' mean frame (row, column) less the dark and over the gain map, DN."""
        measured = mean_DN - self.darks.under(item)
        if item.request.beam_on and "gain" not in item.series.corrected:
            measured = measured / np.where(self.good, self.gain, 1.0)
            if item.name in self.beams:
                measured = measured / self.beams[item.name]
        return measured


def exposure_of(item: SessionSeries) -> float:
    """Exposure in ms by which a series' dark is known; 0 where it is not stated."""
    return item.series.exposure_ms or 0.0


def calibrated_maps(seen: Sequence[SeenSeries], *, twin: Twin, good: BoolArray) -> CalibratedMaps:
    """Dark and gain map from the calibrating series among those seen, the twin's own where none calibrates; good (row, column).

    Raises:
        InputError: next to no pixel sees light.
    """
    darks, flats = (
        [one for one in seen if one.session.calibrates and one.session.series.kind == kind] for kind in ("dark", "flat")
    )
    kept = [one.session for one in seen]
    under = CalibratedDarks(
        twin=twin,
        weights={exposure: _dark_weights(darks, exposure) for exposure in dict.fromkeys(map(exposure_of, kept))},
        means_DN={one.name: one.look.mean_DN for one in darks},
        white_DN2={one.name: one.expected.white_variance_DN2 for one in darks},
        frames={one.name: one.look.frames for one in (*darks, *flats)},
    )
    shares = _flat_shares(flats, good)
    gain = np.zeros(good.shape) if flats else _gain_of_twin(twin)
    quantum = white = 0.0
    if not flats:
        quantum, white = _gain_noise_of_twin(twin)
    gain_darks = dict.fromkeys(under.white_DN2, 0.0)
    for one in flats:
        model = one.expected
        share = shares[one.name] / mean_over(model.signal_DN, good)
        weight = share**2 / one.look.frames
        quantum += weight * mean_over(model.quantum_variance_DN2, good)
        white += weight * mean_over(model.white_variance_DN2, good)
        for name, part in under.weights_under(one.session).items():
            gain_darks[name] -= share * part
        signal = np.maximum(full_size(model.signal_DN, good.shape), 1e-9)
        gain += shares[one.name] * (one.look.mean_DN - under.under(one.session)) / signal
    lit = good & (gain > LEAST_GAIN)
    if np.count_nonzero(lit) < LEAST_PIXELS:
        raise InputError(
            "gain map of the calibrating flats",
            received=f"{np.count_nonzero(lit)} pixels that see light",
            expected=f"at least {LEAST_PIXELS}",
        )
    return CalibratedMaps(
        darks=under,
        gain=gain,
        shares=shares,
        beams={} if flats else _beams_of_twin(twin, kept, gain, good),
        gain_quantum=quantum,
        gain_white=white,
        gain_darks=gain_darks,
        good=lit,
    )


def _flat_shares(flats: Sequence[SeenSeries], good: BoolArray) -> dict[str, float]:
    """Share of each calibrating flat in the gain map: as its signal-to-noise ratio squared."""
    weights = {}
    for one in flats:
        variance = mean_over(one.expected.quantum_variance_DN2 + one.expected.white_variance_DN2, good)
        weights[one.name] = mean_over(one.expected.signal_DN, good) ** 2 / max(variance, 1e-12) * one.look.frames
    total = sum(weights.values())
    return {name: value / total for name, value in weights.items()}


def _dark_weights(darks: Sequence[SeenSeries], exposure_ms: float) -> dict[str, float]:
    """Weights with which calibrating darks add up to the dark of an exposure; empty without darks."""
    if not darks:
        return {}
    same = [one for one in darks if abs(exposure_of(one.session) - exposure_ms) <= 1e-6 * max(exposure_ms, 1)]
    used = same or darks
    names = [one.name for one in used]
    x = np.array([exposure_of(one.session) for one in used])
    n = np.array([one.look.frames for one in used], dtype=float)
    if same or np.ptp(x) <= 0:
        return dict(zip(names, (n / n.sum()).tolist(), strict=True))
    # a straight line through the darks, evaluated at the exposure: linear in the darks
    design = np.stack([np.ones_like(x), x], axis=1)
    solved = np.linalg.solve(design.T @ (n[:, None] * design), design.T * n)
    weights = np.array([1.0, exposure_ms]) @ solved
    return dict(zip(names, weights.tolist(), strict=True))


def _gain_of_twin(twin: Twin) -> FloatArray:
    shapes = [level.flat_shape for level in twin.levels]
    return np.asarray(np.mean(np.stack(shapes), axis=0) if shapes else twin.maps.gain_relative, dtype=np.float64)


def _gain_noise_of_twin(twin: Twin) -> tuple[float, float]:
    """Relative variance of one pixel of `_gain_of_twin` by noise: of quanta, and white; raises where a flat does not tell it."""
    quantum = white = 0.0
    for level in twin.levels:
        if not level.signal_DN or not level.exposures:
            raise InputError(
                f"twin: flat {level.name}",
                received="no signal or number of exposures",
                expected="both, which the noise of its gain map follows from",
                remedy="calibrate the twin again; earlier versions did not keep them",
            )
        quantum += level.photon_transfer_slope_DN.value / (level.signal_DN * level.exposures)
        white += (1.0 / level.exposures + (level.dark_noise or 0.0)) * (
            twin.noise.read_noise_DN.value / level.signal_DN
        ) ** 2
    count = max(len(twin.levels), 1)
    return quantum / count**2, white / count**2


def _beams_of_twin(
    twin: Twin, kept: Sequence[SessionSeries], gain: FloatArray, good: BoolArray
) -> dict[str, FloatArray]:
    """Smooth shape (row, column) of the twin's flats of each lit series' beam over its gain map: a heel differs from beam to beam."""
    if len(twin.levels) < 2:
        return {}
    in_use = good & (gain > LEAST_GAIN)
    shapes: dict[str, FloatArray] = {}
    beams = {}
    for item in kept:
        level = twin.level_nearest(item.request.setting) if item.request.beam_on else None
        if level is not None:
            if level.name not in shapes:
                over = np.where(in_use, level.flat_shape / np.where(in_use, gain, 1.0), 1.0) - 1.0
                shapes[level.name] = 1.0 + smooth_part(over, in_use)
            beams[item.name] = shapes[level.name]
    return beams
