"""A pair of images of the slabs: a disc of foreign object in the product, beside it the open field, with the line's noise."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..acquisition.pairs import flat_corrected_log
from ..acquisition.setting import Filter, Setting
from ..errors import InputError
from ..generator.datasets.render import Geometry, images_of_moments, moments_behind, sample_expected
from ..generator.line.twin import Twin
from ..generator.line.twin_spectrum import secondary_gain_DN, slope_share
from ..generator.predictions.contrast import disc_and_ring
from ..generator.predictions.predict import Prediction
from ..generator.references.transfer import Channel, DetectorNoise
from ..generator.spread.psf import Spread

SMALLEST_PX, LARGEST_PX = 64, 128
_FINE = 3  # sub-pixels a pixel along each axis
_OPEN_SHARE = 0.12  # of the picture's width that shows the open field
_ROOM = 2.2  # picture over object


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagePair:
    """Images of the slabs as a window of good pixels takes them.

    Fields: log_low, log_high (row, column), -ln(I / I0) with noise; ratio (row, column), log_low over log_high, NaN in the open
    field; pixels: of the object that fit in the picture; whole: whether all of it does.
    """

    log_low: NDArray[np.float32] = field(repr=False)
    log_high: NDArray[np.float32] = field(repr=False)
    ratio: NDArray[np.float32] = field(repr=False)
    pixels: int
    whole: bool


def draw_pair(
    twin: Twin,
    predictions: tuple[Prediction, Prediction],
    *,
    product: Filter,
    foreign_object: Filter,
    object_pixels: int,
    displaces: bool,
    rng: np.random.Generator,
) -> ImagePair:
    """Images (low, high) of a disc of foreign object in the product, with blur and noise of the line.

    Each pixel has the detector's median response. Effects beyond beam and noise, scatter and bad pixels are left out.

    Args:
        twin: with a spectral part.
        predictions: of the two settings, single frames or means.
        product, foreign_object: slabs.
        object_pixels: area of the disc.
        displaces: the object takes the product's place.
        rng: source of the noise.

    Raises:
        InputError: an object that displaces more product than there is.

    Checked against: mean and noise of `predict_contrast` behind both slabs (tests/test_explore.py).
    """
    if displaces and foreign_object.thickness_mm > product.thickness_mm:
        raise InputError(
            "foreign_object",
            received=f"{foreign_object.thickness_mm:g} mm",
            expected=f"at most the product's {product.thickness_mm:g} mm",
        )
    diameter_px = 2.0 * math.sqrt(object_pixels / math.pi)
    side = int(np.clip(math.ceil(_ROOM * diameter_px), SMALLEST_PX, LARGEST_PX))
    disc, cover = _cover(object_pixels, side)
    kinds = cover.repeat(_FINE, axis=0).repeat(_FINE, axis=1)
    around = product.thickness_mm - (foreign_object.thickness_mm if displaces else 0.0)
    names = tuple(dict.fromkeys((product.material, foreign_object.material)))
    lengths = np.zeros((len(names), 1, 3), dtype=np.float32)  # open field, product, product with the object
    lengths[names.index(product.material), 0, 1:] += (product.thickness_mm, around)
    lengths[names.index(foreign_object.material), 0, 2] += foreign_object.thickness_mm
    channels = tuple(_channel(twin, one, side) for one in predictions)
    moments = [
        (signal[0][kinds], variance[0][kinds])
        for signal, variance in moments_behind(lengths, names, twin=twin, channels=channels)
    ]
    images = images_of_moments(
        moments,
        twin=twin,
        channels=channels,
        geometry=_geometry(twin, predictions[0].setting, side),
        supersampling=_FINE,
    )
    detector = _detector(twin, side)
    logs = []
    for image, channel in zip(images, channels, strict=True):
        counts = sample_expected(image, channel=channel, detector=detector, rng=rng)
        logs.append(
            flat_corrected_log(counts, dark_DN=channel.dark_DN, flat_DN=channel.open_signal_DN + channel.dark_DN)
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where((cover > 0) & (logs[1] > 0), logs[0] / logs[1], np.nan).astype(np.float32)
    return ImagePair(
        log_low=logs[0], log_high=logs[1], ratio=ratio, pixels=int(np.count_nonzero(disc)), whole=diameter_px < side
    )


def _cover(object_pixels: int, side: int) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """The disc in the picture, and what each pixel shows: 0 open field, 1 product, 2 product with the object."""
    mask, _ = disc_and_ring(min(object_pixels, side * side), 1)
    disc = np.zeros((side, side), dtype=bool)
    centre, half = mask.shape[0] // 2, side // 2
    reach = min(centre, half - 1)
    disc[half - reach : half + reach + 1, half - reach : half + reach + 1] = mask[
        centre - reach : centre + reach + 1, centre - reach : centre + reach + 1
    ]
    cover = np.ones((side, side), dtype=np.intp)
    cover[disc] = 2
    cover[:, : round(_OPEN_SHARE * side)] = 0
    return disc & (cover == 2), cover


def _geometry(twin: Twin, setting: Setting, side: int) -> Geometry:
    """The line's geometry; where distances are not known, the object lies on the detector and no focal spot blurs it."""
    instrument = twin.instrument
    distance = setting.source_detector_mm or instrument.source_detector_mm or 1000.0
    return Geometry(
        rows=side,
        columns=side,
        pixel_mm=instrument.pixel_mm or 1.0,
        source_object_mm=min(instrument.source_object_mm or distance, distance),
        source_detector_mm=distance,
        focal_spot_mm=(instrument.focal_spot_mm or 0.0) if instrument.pixel_mm else 0.0,
    )


def _channel(twin: Twin, predicted: Prediction, side: int) -> Channel:
    setting = predicted.setting
    secondary = secondary_gain_DN(twin, setting)
    white = twin.noise.white_fraction
    return Channel(
        setting=setting,
        open_signal_DN=np.full((side, side), predicted.mean_DN.value),
        gain_DN=predicted.gain_DN.value,
        dark_DN=np.full((side, side), twin.dark_DN.value, dtype=np.float32),
        secondary_DN=predicted.gain_DN.value * white / (1.0 + white) if secondary is None else secondary,
    )


def _detector(twin: Twin, side: int) -> DetectorNoise:
    spread: Spread = twin.noise.spread.value
    return DetectorNoise(
        spread=spread,
        white_fraction=twin.noise.white_fraction,
        slope_share=slope_share(twin),
        gain_relative=np.ones((side, side), dtype=np.float32),
        read_variance_DN2=np.full((side, side), twin.noise.read_variance_DN2, dtype=np.float32),
        bits=twin.instrument.bits,
        quantised=twin.noise.quantised,
    )
