"""What a detector shows of a scene on average: transmission and the variance of its quanta, projected with all energies.

Rays are traced to sub-pixels; their signals, not their path lengths, are averaged over a pixel. The focal spot blurs signal
and variance of a scene by its image on the detector; the detector's own spread blurs the signal alone, its quanta being
drawn before that spread.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import Setting
from ...errors import InputError
from ..kernels.kernels import draw_key, sample_frames
from ..kernels.projection import project_polychromatic
from ..line.spectral_signal import OpenBeam
from ..line.twin import Twin
from ..line.twin_spectrum import spectral_model_of
from ..references.transfer import Channel, DetectorNoise
from ..scenes.describe import Scene
from ..scenes.shapes import Rays
from ..spread.noise import digitise, sample_frame_noise
from ..spread.psf import Spread, sampled_gaussian_1d
from ..spread.spot import spot_image_px

Array = NDArray[np.float64]

SUPERSAMPLING = 3
_TILE_PX = 16


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
        return spot_image_px(self.focal_spot_mm, magnification=self.magnification, pixel_mm=self.pixel_mm)

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
    stack = np.stack([np.asarray(one, dtype=np.float32) for one in lengths_mm.values()])
    moments = moments_behind(stack, tuple(lengths_mm), twin=twin, channels=channels)
    return images_of_moments(moments, twin=twin, channels=channels, geometry=geometry, supersampling=supersampling)


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderedScene:
    """A scene as a detector shows it on average: images (a channel each); foreign_cover and cover (row, column): share of a
    pixel's rays that cross a foreign object, or anything."""

    images: tuple[ExpectedImage, ...]
    foreign_cover: Array = field(repr=False)
    cover: Array = field(repr=False)


def render_scene(
    scene: Scene,
    *,
    twin: Twin,
    channels: Sequence[Channel],
    geometry: Geometry,
    supersampling: int = SUPERSAMPLING,
) -> RenderedScene:
    """`render_expected` of a scene, with sub-pixels where there are edges and one ray a pixel elsewhere.

    Tiles of 16 x 16 pixels that hold an outline of the product, or that a foreign object can reach, are traced with all their
    sub-pixels; in the others the path length is that of the pixel's middle (off by its curvature times pitch^2 / 24).

    Raises:
        InputError: a twin without spectral part.
    """
    traced = trace_scene(scene, twin=twin, channels=channels, geometry=geometry, supersampling=supersampling)
    images = images_of_moments(
        traced.moments, twin=twin, channels=channels, geometry=geometry, supersampling=supersampling
    )
    return RenderedScene(images=images, foreign_cover=traced.foreign_cover, cover=traced.cover)


@dataclass(frozen=True, slots=True, kw_only=True)
class TracedScene:
    """A scene before any blur.

    Fields: moments: signal and quantum variance (row x supersampling, column x supersampling) over those of the open beam, a
    channel each; lengths_mm: material -> (row, column) through the middle of each pixel; foreign_cover, cover: see
    `RenderedScene`.
    """

    moments: "Moments" = field(repr=False)
    lengths_mm: Mapping[str, Array] = field(repr=False)
    foreign_cover: Array = field(repr=False)
    cover: Array = field(repr=False)


def trace_scene(
    scene: Scene,
    *,
    twin: Twin,
    channels: Sequence[Channel],
    geometry: Geometry,
    supersampling: int = SUPERSAMPLING,
    attenuation_scale: Callable[[Sequence[str]], Mapping[str, float]] | None = None,
) -> TracedScene:
    """What stands in the beam, projected: `render_scene` without blur.

    Args: as there, and
        attenuation_scale: names of the scene's materials -> factors on their attenuation.
    """
    rays, fine_rays = geometry.rays(), geometry.rays(supersampling)
    lengths, foreign = scene.lengths_mm(rays)
    names = tuple(lengths)
    inside = np.sum(list(lengths.values()), axis=0) > 0
    cover, foreign_cover = inside.astype(np.float64), (foreign > 0).astype(np.float64)
    tiles = _tiles_with_edges(scene, rays, inside)
    pieces, shapes = [], []
    for rows, columns in tiles:
        part = fine_rays.part(*(slice(one.start * supersampling, one.stop * supersampling) for one in (rows, columns)))
        piece, foreign_piece = scene.lengths_mm(part)
        stack = np.stack([piece[name] for name in names]).astype(np.float32)
        cover[rows, columns] = _pixel_means(stack.sum(axis=0) > 0, supersampling)
        foreign_cover[rows, columns] = _pixel_means(foreign_piece > 0, supersampling)
        pieces.append(stack.reshape(len(names), -1))
        shapes.append(part.shape)
    coarse = np.stack([lengths[name] for name in names]).astype(np.float32).reshape(len(names), -1)
    every = np.concatenate([coarse, *pieces], axis=1)[:, None]
    moments = []
    scale = {} if attenuation_scale is None else attenuation_scale(names)
    for signal, variance in moments_behind(every, names, twin=twin, channels=channels, scale=scale):
        planes = []
        for values in (signal[0], variance[0]):
            plane = values[: coarse.shape[1]].reshape(geometry.rows, geometry.columns)
            fine = plane.repeat(supersampling, axis=0).repeat(supersampling, axis=1)
            start = coarse.shape[1]
            for (rows, columns), shape in zip(tiles, shapes, strict=True):
                stop = start + shape[0] * shape[1]
                fine[
                    rows.start * supersampling : rows.stop * supersampling,
                    columns.start * supersampling : columns.stop * supersampling,
                ] = values[start:stop].reshape(shape)
                start = stop
            planes.append(fine)
        moments.append((planes[0], planes[1]))
    return TracedScene(moments=moments, lengths_mm=lengths, foreign_cover=foreign_cover, cover=cover)


def _tiles_with_edges(scene: Scene, rays: Rays, inside: NDArray[np.bool_]) -> list[tuple[slice, slice]]:
    """Tiles (rows, columns) with an outline of the product, or within reach of a foreign object."""
    busy = np.zeros(inside.shape, dtype=bool)
    for axis in (0, 1):
        first, last = ((slice(None),) * axis + (part,) for part in (slice(1, None), slice(None, -1)))
        change = inside[first] != inside[last]
        busy[first] |= change
        busy[last] |= change
    # a ray beside an outline may cross it within its pixel
    busy |= np.roll(busy, 1, axis=0) | np.roll(busy, -1, axis=0)
    busy |= np.roll(busy, 1, axis=1) | np.roll(busy, -1, axis=1)
    for placed in scene.foreign_objects:
        rows, columns = rays.window(np.array([*placed.place_mm, 0.0]), placed.radius_mm)
        busy[max(rows.start - 1, 0) : rows.stop + 1, max(columns.start - 1, 0) : columns.stop + 1] = True
    tiles = []
    for row in range(0, inside.shape[0], _TILE_PX):
        for column in range(0, inside.shape[1], _TILE_PX):
            tile = (
                slice(row, min(row + _TILE_PX, inside.shape[0])),
                slice(column, min(column + _TILE_PX, inside.shape[1])),
            )
            if busy[tile].any():
                tiles.append(tile)
    return tiles


Moments = Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]]


def refuse_without_spectrum(twin: Twin) -> None:
    """Raise InputError where the twin cannot project materials."""
    if twin.spectral is None:
        raise InputError(
            "twin",
            received="a twin without spectral part",
            expected="one that knows its spectrum, to project materials through",
            remedy="calibrate from flats that state kV and tube load, or generate from reference images",
        )


def moments_behind(
    stack: NDArray[np.float32],
    names: Sequence[str],
    *,
    twin: Twin,
    channels: Sequence[Channel],
    scale: Mapping[str, float] | None = None,
) -> Moments:
    """Signal and quantum variance behind path lengths (material, row, column), each over that of the open beam."""
    model = spectral_model_of(twin, highest_kV=max(one.setting.kV for one in channels))
    best = twin.spectral.best if twin.spectral is not None else model.default_parameters()
    found = []
    for channel in channels:
        setting = channel.setting
        weights = model.moment_weights(best, OpenBeam(kV=setting.kV, filters=setting.filters))[:2]
        mu = np.stack([model.mu(name)[: weights.shape[1]] for name in names])
        if scale:
            mu = mu * np.array([scale.get(name, 1.0) for name in names])[:, None]
        signal, variance = project_polychromatic(stack, mu, weights / weights.sum(axis=1, keepdims=True))
        found.append((signal, variance))
    return found


def images_of_moments(
    moments: Moments, *, twin: Twin, channels: Sequence[Channel], geometry: Geometry, supersampling: int
) -> tuple[ExpectedImage, ...]:
    """Transmission (no unit) and gain (DN) after all blur, a channel each.

    Args:
        moments: signal and quantum variance (row x supersampling, column x supersampling) over those of the open beam.
        twin, channels, geometry, supersampling: as in `render_expected`.
    """
    focal = geometry.focal_blur_px * supersampling
    spread = twin.noise.spread.value
    images = []
    for channel, (signal, variance) in zip(channels, moments, strict=True):
        if spread.separable:
            blurred = _blurred_pixel_means(signal, math.hypot(focal, spread.sigma_px * supersampling), supersampling)
        else:
            blurred = _blurred_pixel_means(_spread_out(signal, spread, supersampling), focal, supersampling)
        quanta = _blurred_pixel_means(variance, focal, supersampling)
        images.append(
            ExpectedImage(
                transmission=blurred,
                # behind what nothing crosses there are no quanta, whatever each of them would be worth
                gain_DN=channel.gain_DN * np.clip(quanta / np.maximum(blurred, 1e-12), 1e-3, 1e3),
            )
        )
    return tuple(images)


def _blurred_pixel_means(fine: NDArray[np.float32], sigma: float, supersampling: int) -> Array:
    """Pixel means (row, column) of sub-pixels blurred by a Gaussian of `sigma` sub-pixels; one axis after the other."""
    from scipy.ndimage import correlate1d

    kernel = sampled_gaussian_1d(sigma, math.ceil(4.5 * sigma) + 1) if sigma >= 0.05 else None
    image = fine
    for axis in (0, 1):
        if kernel is not None:
            image = correlate1d(image, kernel, axis=axis, mode="nearest")
        parts = [image[(slice(None),) * axis + (slice(k, None, supersampling),)] for k in range(supersampling)]
        image = np.asarray(np.sum(parts, axis=0, dtype=np.float32) / np.float32(supersampling))
    return image.astype(np.float64)


def _spread_out(fine: NDArray[np.float32], spread: Spread, supersampling: int) -> NDArray[np.float32]:
    """Sub-pixels (row, column) after a spread of any shape; borders mirror."""
    from scipy.fft import dctn, idctn

    f_row, f_column = (supersampling * np.arange(length) / (2.0 * length) for length in fine.shape)
    transfer = spread.transfer(f_row[:, None], f_column[None, :])
    return np.asarray(idctn(dctn(fine, type=2) * transfer, type=2), dtype=np.float32)


def _pixel_means(fine: NDArray[np.generic], supersampling: int) -> Array:
    rows, columns = (length // supersampling for length in fine.shape)
    blocks = fine.reshape(rows, supersampling, columns, supersampling)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64))


def sample_expected(
    image: ExpectedImage, *, channel: Channel, detector: DetectorNoise, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Counts with dark (row, column) of one frame, or of the mean of the setting's averaged frames, DN."""
    # rounding comes with digitising
    rounding = 1.0 / 12.0 if detector.quantised else 0.0
    read_DN2 = np.asarray(detector.read_variance_DN2, dtype=np.float64) - rounding
    signal = channel.open_signal_DN * image.transmission
    gain, white = image.gain_DN, detector.white_fraction
    if channel.secondary_DN is not None:
        # what secondary quanta add follows the signal but not the spectrum: it goes with the electronic noise
        secondary = np.minimum(channel.secondary_DN, 0.9 * gain)
        gain, white = gain - secondary, 0.0
        read_DN2 = np.maximum(read_DN2, 0.0) + secondary * np.maximum(signal, 0.0) * detector.gain_relative
    read_noise_DN = np.sqrt(np.maximum(read_DN2, 0.0))
    averaged = channel.setting.averaged
    if not detector.spread.separable:
        noise = sample_frame_noise(
            signal,
            gain_DN=gain,
            gain_relative=detector.gain_relative,
            white_fraction=white,
            read_variance_DN2=read_noise_DN**2,
            spread=detector.spread,
            rng=rng,
            quantum_share=1.0 / averaged,
            third_cumulant_share=1.0 / averaged**2,
            read_share=1.0 / averaged,
        )
        return digitise(
            signal + noise + channel.dark_DN, bits=detector.bits, quantised=detector.quantised, averaged=averaged
        )
    frame = sample_frames(
        signal,
        gain_DN=gain,
        key=draw_key(rng),
        gain_relative=detector.gain_relative,
        white_fraction=white,
        kernel_1d=detector.spread.noise_kernel,
        read_noise_DN=read_noise_DN,
        dark_DN=channel.dark_DN,
        bits=detector.bits,
        quantised=detector.quantised,
        averaged=averaged,
    )
    return np.asarray(frame, dtype=np.float32)
