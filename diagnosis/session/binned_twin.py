"""A panel's twin with binned pixels: what it expects of frames that were averaged over square bins.

Means of bins have a pixel's level, more quanta and less electronic noise; light that spreads over pixels spreads over less of a bin.
Numbers are not whole any more.
"""

import math
from dataclasses import replace

import numpy as np

from ...acquisition.binned_frames import means_of_bins
from ...generator.effects import EFFECTS, AppliedEffect
from ...generator.line.twin import DetectorMaps, Estimate, Level, NoiseModel, SpectralPosterior, Twin, gaussian_spread
from ...generator.spread.psf import Spread, blur_variance_share
from ..arrays import FloatArray

_MODEL = "sampled"
_WIDEST = 8.0  # bins that light may spread over


def binned_twin(twin: Twin, factor: int) -> Twin:
    """The twin of means over factor x factor pixels; rows and columns that fill no square are left out as of frames.

    With n = factor: gain, photon-transfer slope and DN a keV are 1 / n^2 of a pixel's, the electronic variance too; the spread leaves
    the same share of the quantum variance in a square, quanta counted per square, which is how averaged frames calibrate where light
    spreads over less than a square. Squares with a bad pixel are bad. `evidence` stays that of the pixels.

    Checked against: twins calibrated from averaged frames (tests/test_diagnosis_binned_twin.py).
    """
    if factor == 1:
        return twin
    pitch = twin.instrument.pixel_mm
    noise = _noise(twin.noise, factor)
    return replace(
        twin,
        instrument=replace(twin.instrument, pixel_mm=None if pitch is None else pitch * factor),
        maps=_maps(twin.maps, factor),
        noise=noise,
        levels=tuple(_level(level, noise, factor) for level in twin.levels),
        spectral=None if twin.spectral is None else _spectral(twin.spectral, factor, pitch_known=pitch is not None),
        effects=tuple(effect_in_squares(item, factor) for item in twin.effects),
    )


def _maps(maps: DetectorMaps, factor: int) -> DetectorMaps:
    """Maps of the squares; one with bad pixels has the largest of their codes."""
    bad = maps.bad_pixels
    top, left = ((side % factor) // 2 for side in bad.shape)
    rows, columns = (side // factor for side in bad.shape)
    squares = bad[top : top + rows * factor, left : left + columns * factor].reshape(rows, factor, columns, factor)
    return replace(
        maps,
        dark_DN=means_of_bins(maps.dark_DN, factor),
        dark_DN_per_ms=means_of_bins(maps.dark_DN_per_ms, factor),
        gain_relative=means_of_bins(maps.gain_relative, factor),
        read_variance_DN2=means_of_bins(maps.read_variance_DN2, factor) / np.float32(factor**2),
        bad_pixels=squares.max(axis=(1, 3)),
    )


def _noise(noise: NoiseModel, factor: int) -> NoiseModel:
    """Noise of the squares, whose rounding is part of the electronic one."""
    read_DN = noise.read_noise_DN.value
    rounded = math.sqrt(noise.read_variance_DN2) / read_DN if read_DN > 0.0 else 1.0
    axes = noise.spread.value.axes

    def width_of(spread: Spread) -> float:
        """Of a Gaussian along both axes, which leaves the square of what it leaves along one."""
        share = spread.binned_variance_share(factor)
        return _width_that_leaves(share if axes == "both" else share**2)

    width = width_of(noise.spread.value)
    ends = sorted(width_of(spread) for spread in noise.spread.ends())
    sigma = Estimate(value=width, low=min(ends[0], width), high=max(ends[1], width))
    read = noise.read_noise_DN.times(rounded / factor)
    if read_DN == 0.0 and noise.quantised:
        alone = math.sqrt(noise.read_variance_DN2) / factor
        read = Estimate(value=alone, low=alone, high=alone)
    return replace(noise, spread=gaussian_spread(_MODEL, sigma, axes=axes), read_noise_DN=read, quantised=False)


def _width_that_leaves(share: float) -> float:
    """Spread, in squares, of quanta counted per square that leaves this share of their variance there."""
    from scipy.optimize import brentq

    def too_much(width: float) -> float:
        return blur_variance_share(_MODEL, width) - share

    if too_much(_WIDEST) >= 0.0:
        return _WIDEST
    return float(brentq(too_much, 0.0, _WIDEST, xtol=1e-12))


def _level(level: Level, noise: NoiseModel, factor: int) -> Level:
    """A measured beam; the slope is what the spread leaves of its quanta in one square, and the white part."""
    gain = level.gain_DN.times(1.0 / factor**2)
    white = noise.white_fraction / (1.0 + noise.white_fraction)
    left = (1.0 - white) * noise.spread.value.variance_share + white
    return replace(
        level,
        gain_DN=gain,
        photon_transfer_slope_DN=gain.times(left),
        flat_shape=means_of_bins(level.flat_shape, factor),
    )


def _spectral(spectral: SpectralPosterior, factor: int, *, pitch_known: bool) -> SpectralPosterior:
    """As many DN fewer a keV as a square has pixels, and so many more photons, or output where there is no pitch."""
    more = 2.0 * math.log(factor)
    moved = {"log_DN_per_keV": -more} | ({} if pitch_known else {"log_output": more})

    def per_bin(values: FloatArray) -> FloatArray:
        return np.asarray(values + np.array([moved.get(name, 0.0) for name in spectral.names]))

    return replace(spectral, samples=per_bin(spectral.samples), best=per_bin(spectral.best))


def effect_in_squares(item: AppliedEffect, factor: int) -> AppliedEffect:
    """An effect in terms of pixels, with lengths in squares; what it does not state has its default, in pixels."""
    if item.id not in EFFECTS:
        return item
    effect = EFFECTS[item.id]
    values = effect.values(item.parameters)
    found = dict(item.parameters)
    for parameter in effect.parameters:
        share = parameter.pixels_per_bin(factor)
        if share != 1.0:
            found[parameter.name] = min(values[parameter.name] / share, parameter.most)
    return replace(item, parameters=found)
