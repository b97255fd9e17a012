"""What a detector shows of a scene on average: transmission and the variance of its quanta, projected with all energies.

Rays are traced to sub-pixels; their signals, not their path lengths, are averaged over a pixel. The focal spot blurs signal
and variance of a scene by its image on the detector; the detector's own spread blurs the signal alone, its quanta being
drawn before that spread.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Setting
from ..errors import InputError
from .noise import digitise, sample_frame_noise
from .predict import spectral_model_of
from .projection import project_polychromatic
from .psf import convolve_separable, sampled_gaussian_1d
from .shapes import Rays
from .spectral_signal import OpenBeam
from .transfer import Channel, DetectorNoise
from .twin import Twin

Array = NDArray[np.float64]

SUPERSAMPLING = 3
_FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Geometry:
    """Source, object and detector of a rendering: distances and sizes in mm, rows and columns of the detector."""

    rows: int
    columns: int
    pixel_mm: float
    source_object_mm: float
    source_detector_mm: float
    focal_spot_mm: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.source_object_mm <= self.source_detector_mm:
            raise InputError(
                "source_object_mm",
                received=f"{self.source_object_mm:g} mm with a source-detector distance of {self.source_detector_mm:g} mm",
                expected="a distance above 0 mm, at most that of the detector",
            )

    @property
    def magnification(self) -> float:
        """Source-detector over source-object distance."""
        return self.source_detector_mm / self.source_object_mm

    @property
    def focal_blur_px(self) -> float:
        """Standard deviation of the focal spot's image on the detector, pixels (the spot taken as a Gaussian of its FWHM)."""
        return self.focal_spot_mm * (self.magnification - 1.0) / _FWHM / self.pixel_mm

    def rays(self, supersampling: int = 1) -> Rays:
        """Rays to the middles of pixels, or of sub-pixels."""
        step = self.pixel_mm / self.magnification / supersampling

        def line(count: int) -> Array:
            return np.asarray((np.arange(count * supersampling) - (count * supersampling - 1) / 2.0) * step)

        return Rays(source_mm=self.source_object_mm, y_mm=line(self.rows)[:, None], x_mm=line(self.columns)[None, :])


def geometry_of(twin: Twin, *, settings: Sequence[Setting], line: Mapping[str, float] | None = None) -> Geometry:
    """The geometry of a twin's line at some settings, with what a description states instead.

    Raises:
        InputError: something that neither says, or settings at several distances.
    """
    stated = dict(line or {})
    instrument = twin.instrument
    distances = {one.source_detector_mm or instrument.source_detector_mm for one in settings}
    if len(distances) != 1:
        raise InputError(
            "source_detector_mm",
            received="another distance at low and at high kV",
            expected="the same in both settings",
        )
    known = {
        "pixel_mm": instrument.pixel_mm,
        "source_object_mm": instrument.source_object_mm,
        "source_detector_mm": distances.pop(),
        "focal_spot_mm": instrument.focal_spot_mm or 0.0,
    }
    values = {name: stated.get(name, value) for name, value in known.items()}
    for name, value in values.items():
        if value is None:
            raise InputError(
                "twin", received=f"no {name}", expected="the geometry of the line", remedy=f"state {name} under [line]"
            )
    rows, columns = twin.maps.shape
    return Geometry(rows=rows, columns=columns, **{name: float(value or 0.0) for name, value in values.items()})


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedImage:
    """One channel of a scene without noise.

    Fields (row, column): transmission, I / I0 after all blur; gain_DN, variance of the quanta before the spread of the
    detector over the signal.
    """

    transmission: Array = field(repr=False)
    gain_DN: Array = field(repr=False)

    @property
    def log_image(self) -> Array:
        """-ln(I / I0)."""
        return np.asarray(-np.log(np.maximum(self.transmission, 1e-30)))


def render_expected(
    lengths_mm: Mapping[str, NDArray[np.floating]],
    *,
    twin: Twin,
    channels: Sequence[Channel],
    geometry: Geometry,
    supersampling: int = SUPERSAMPLING,
) -> tuple[ExpectedImage, ...]:
    """Transmission (no unit) and gain (DN) of path lengths, a channel each.

    Args:
        lengths_mm: material -> (row x supersampling, column x supersampling), mm.
        twin: for spectrum and spread.
        channels: settings with their open signal and gain.
        geometry: of the line.
        supersampling: sub-pixels a pixel along each axis.

    Raises:
        InputError: maps of another shape, a twin without spectral part.
    """
    shape = (geometry.rows * supersampling, geometry.columns * supersampling)
    wrong = {name: one.shape for name, one in lengths_mm.items() if one.shape != shape}
    if wrong or not lengths_mm:
        raise InputError("path lengths", received=wrong or "none", expected=f"maps of {shape} (rows, columns)")
    model = spectral_model_of(twin, highest_kV=max(one.setting.kV for one in channels))
    best = twin.spectral.best if twin.spectral is not None else model.default_parameters()
    moments = [
        model.moment_weights(best, OpenBeam(kV=one.setting.kV, filters=one.setting.filters))[:2] for one in channels
    ]
    focal = geometry.focal_blur_px * supersampling
    spread = twin.noise.psf_sigma_px.value * supersampling
    stack = np.stack([np.asarray(one, dtype=np.float32) for one in lengths_mm.values()])
    images = []
    for channel, weights in zip(channels, moments, strict=True):
        used = weights / weights.sum(axis=1, keepdims=True)
        mu = np.stack([model.mu(name)[: used.shape[1]] for name in lengths_mm])
        signal, variance = project_polychromatic(stack, mu, used)
        blurred = _pixel_means(_blur(signal, math.hypot(focal, spread)), supersampling)
        quanta = _pixel_means(_blur(variance, focal), supersampling)
        images.append(
            ExpectedImage(
                transmission=blurred, gain_DN=channel.gain_DN * quanta / np.maximum(blurred, np.finfo(np.float32).tiny)
            )
        )
    return tuple(images)


def _blur(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    if sigma < 0.05:
        return image
    return convolve_separable(image, sampled_gaussian_1d(sigma, math.ceil(4.5 * sigma) + 1))


def _pixel_means(fine: NDArray[np.float32], supersampling: int) -> Array:
    rows, columns = (length // supersampling for length in fine.shape)
    blocks = fine.reshape(rows, supersampling, columns, supersampling)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64))


def sample_expected(
    image: ExpectedImage, *, channel: Channel, detector: DetectorNoise, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Counts with dark (row, column) of one frame, or of the mean of the setting's averaged frames, DN."""
    frames = channel.setting.averaged
    signal = channel.open_signal_DN * image.transmission
    # rounding comes with digitising
    rounding = 1.0 / 12.0 if detector.quantised else 0.0
    noise = sample_frame_noise(
        signal,
        gain_DN=image.gain_DN,
        gain_relative=detector.gain_relative,
        white_fraction=detector.white_fraction,
        read_variance_DN2=np.maximum(np.asarray(detector.read_variance_DN2, dtype=np.float64) - rounding, 0.0),
        psf_model=detector.psf_model,
        psf_sigma_px=detector.psf_sigma_px,
        rng=rng,
        quantum_share=1.0 / frames,
        third_cumulant_share=1.0 / frames**2,
        read_share=1.0 / frames,
    )
    return digitise(signal + noise + channel.dark_DN, bits=detector.bits, quantised=detector.quantised, averaged=frames)
