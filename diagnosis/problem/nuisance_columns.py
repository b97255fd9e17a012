"""What is no effect and may differ all the same: nuisances of one series, and what effects do by chance there.

A nuisance is a response (probe,) of one prior standard deviation; equal names in several series are one nuisance.
"""

import math
from collections.abc import Iterable, Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...calibration.flats.setting_errors import EXPOSURE_SD_MS
from ...generator.frames.declared_spot import declared_spot_px
from ...generator.line.line_state import FixedPattern, TilePattern
from ..arrays import FloatArray, RealArray
from ..model import changes as scales
from ..model.point_maps import blurred_between_points, sampled_at_points
from ..model.responses import Moved, SessionModel
from ..probes.noise_correlation import correlation_sum
from ..probes.probes import OUTLIERS, OUTLIERS_ANYWHERE, Scalar, root_of_count
from ..probes.registration import CELL_SD_PX, RENDER_SHARE, gradient
from ..session.even_maps import Map
from ..session.session import SessionSeries
from ..session.summaries import BLOCK_PX, LAGS, LEAST_NOISE_DN2
from .other_scenes import Redrawn
from .series_probes import SeriesProbes

Columns = dict[str, FloatArray]
_Images = dict[str, RealArray]
_UNKNOWN_GAIN_SD = 0.5  # relative, of the gain of a beam of unknown voltage


def nuisances_of_series(session: SessionModel, probes: SeriesProbes, signal: FloatArray, redrawn: Redrawn) -> Columns:
    """Nuisances of one series by name, shrunk; signal: expected (row, column), DN; redrawn: what other scenes would show."""
    item, model, beams_differ = probes.series.session, session.model, session.model.beams_differ
    columns: Columns = {
        "shape of the noise": probes.of_scalars(lambda probe: scales.KURTOSIS_SD if probe.name == "kurtosis" else 0.0)
    }
    columns |= {f"read noise {lag}": _read_texture(probes, lag) for lag in LAGS}
    images: _Images = {}  # of nuisances that change the mean frame alone
    if item.request.beam_on:
        columns |= _of_beam(probes, beams_differ)
        images |= _of_field(item, signal, beams_differ)
    if item.series.kind != "flat":  # against a flat's light it is nothing
        images[f"dark of {item.name}"] = np.full(signal.shape, scales.DARK_SD_DN)
    if not item.calibrates:
        # half of the few pixels that may turn bad without that being an effect, as counts of outliers show them
        few = 0.5 * max(scales.FEW_BAD_PIXELS, scales.FEW_BAD_SHARE * probes.series.context.areas.order.size)
        more = root_of_count(few) - root_of_count(0)
        counts = (OUTLIERS, OUTLIERS_ANYWHERE)
        columns["few new bad pixels"] = probes.of_scalars(lambda probe: more if probe.name in counts else 0.0)
    if item.series.kind == "object":
        columns |= _of_thickness(probes, signal, redrawn.thicker, beams_differ)
        images |= _of_scene(item, signal, sharp=model.sharp, rough=probes.rendered / RENDER_SHARE)
        images |= _of_spot(declared_spot_px(model.base, item.request), signal)
        if model.sharp:
            images |= _between_points(item, signal)
        if redrawn.covered is not None:
            images[f"border of {_place(item)}"] = redrawn.covered
    columns |= zip(images, probes.of_maps(np.stack(list(images.values())).astype(np.float32)), strict=True)
    columns |= _gain_map_noise(session, probes, signal)
    return {name: column * probes.shrink for name, column in columns.items()}


def _voltage(item: SessionSeries) -> str:
    series = item.series
    return f"unknown kV ({series.current_mA}, {series.power_W})" if series.kV is None else f"{series.kV:g} kV"


def _beam(item: SessionSeries) -> str:
    return f"{_voltage(item)} " + "+".join(str(layer) for layer in item.series.filters)


def _place(item: SessionSeries) -> str:
    return f"{item.series.scene} at {item.series.source_object_mm or 0:g}"


def _of_beam(probes: SeriesProbes, beams_differ: float) -> Columns:
    """Gain of a beam, noise of pixels that are brighter than others, and correlation of neighbours."""
    item, context = probes.series.session, probes.series.context
    brighter = dict(zip(context.label_names, context.label_gain, strict=True))
    # without a voltage, or a calibrating flat of two frames, the noise of a beam is known only from its own series
    unknown = item.series.kV is None or item.own_noise
    gain_sd = _UNKNOWN_GAIN_SD if unknown else beams_differ * scales.GAIN_OF_BEAM_SD
    columns: Columns = {
        f"gain of {_beam(item)}": probes.of_scalars(
            lambda probe: gain_sd if probe.label and probe.lag is None else 0.0
        ),
        "output from frame to frame": probes.of_scalars(
            lambda probe: _of_steps(probes, probe.name) if probe.name == "frame_factor" else 0.0
        ),
        # by their electronics (noise as the gain's square) or by the light that they catch (as the gain)
        "noise of bright pixels": probes.of_scalars(
            lambda probe: (
                0.5 * scales.GAIN_EXPONENT_SD * math.log(brighter[probe.label])
                if probe.label and probe.lag is None
                else 0.0
            )
        ),
    }
    for lag in LAGS:
        # the calibrated spread is one number; what it leaves open is the same in all series, or in those of a kV
        texture = _texture(probes, lag)
        columns[f"texture {lag}"] = columns[f"texture {lag} at {_voltage(item)}"] = texture
    return columns


def _texture(probes: SeriesProbes, lag: tuple[int, int]) -> FloatArray:
    return probes.of_scalars(lambda probe: scales.TEXTURE_SD if probe.lag == lag else 0.0)


def _read_texture(probes: SeriesProbes, lag: tuple[int, int]) -> FloatArray:
    """READ_TEXTURE_SD of correlation in the read noise at a lag: of neighbours, and of means over lines and blocks.

    The variance of a mean of n pixels in line is 1 + 2 sum_d (1 - d / n) rho_d times that of independent ones.
    """
    context = probes.series.context
    down, across = lag[0], abs(lag[1])
    rows, columns = context.good.shape
    share, shares = _white_shares(probes)
    within = {
        "row_ratio": (down == 0) * (1.0 - across / columns),
        "column_ratio": (across == 0) * (1.0 - down / rows),
        "block_ratio": (1.0 - down / BLOCK_PX) * (1.0 - across / BLOCK_PX),
    }

    def of(probe: Scalar) -> float:
        if probe.name in within:
            return float(2.0 * share * within[probe.name] / math.exp(probes.series.scalars[probe.name]))
        return float(shares[probe.label]) if probe.lag == lag else 0.0

    return scales.READ_TEXTURE_SD * probes.of_scalars(of)


def _white_shares(probes: SeriesProbes) -> tuple[float, dict[str, float]]:
    """White noise's share of the variance of frames: in all pixels, and by label of the noise probes."""
    expected, context = probes.series.expected, probes.series.context
    (of_quanta, of_labels), (white, whites) = map(
        context.areas.means, (expected.quantum_variance_DN2, expected.white_variance_DN2)
    )
    shares = whites / np.maximum(of_labels + whites, LEAST_NOISE_DN2)
    return white / max(of_quanta + white, LEAST_NOISE_DN2), dict(zip(context.label_names, shares, strict=True))


def brighter(probes: SeriesProbes, signal: FloatArray) -> FloatArray:
    """What 1 % more light does to a series (probe,), not shrunk: to its mean frame, and to the noise of its quanta.

    signal: expected (row, column), DN.
    """
    _, shares = _white_shares(probes)

    def noisier(probe: Scalar) -> float:
        return 0.01 * (1.0 - shares[probe.label]) if probe.label and probe.lag is None else 0.0

    level = probes.of_maps(0.01 * signal[None])[0]
    return np.asarray(level + probes.of_scalars(noisier))


def _of_field(item: SessionSeries, signal: FloatArray, beams_differ: float) -> _Images:
    """Level of beam and series, and gradient of the field."""
    images: _Images = {
        f"level of {_beam(item)}": beams_differ * scales.LEVEL_OF_BEAM_SD * signal,
        f"level of {item.name}": scales.LEVEL_OF_SERIES_SD * signal,
    }
    if item.request.exposure_ms > 0:
        images["length of exposures"] = EXPOSURE_SD_MS / item.request.exposure_ms * signal
    for number, shape in enumerate(_shapes(signal.shape)):
        changed = shape * signal
        images[f"shape {number} of {item.name}"] = changed
        if not item.calibrates:
            # what changes slowly is much the same in series that follow each other
            images[f"shape {number} since the calibration"] = changed
    if item.divided:
        images[f"open field of {item.name}"] = scales.DIVIDED_LEVEL_SD * signal
        y, x = (np.linspace(-1.0, 1.0, length) for length in signal.shape)
        images[f"open field of {item.name}, x"] = scales.DIVIDED_TILT_SD * x * signal
        images[f"open field of {item.name}, y"] = scales.DIVIDED_TILT_SD * y[:, None] * signal
    return images


@lru_cache(maxsize=2)
def _shapes(size: tuple[int, ...]) -> tuple[FloatArray, ...]:
    """Smooth changes (row, column) of the open field, relative: SHAPE_SD rms in all."""
    found = _smooth(size, scales.SHAPE_ORDER)
    total = math.sqrt(sum(1.0 / order**2 for order, _ in found))
    return tuple(scales.SHAPE_SD / order / total / float(np.sqrt(np.mean(shape**2))) * shape for order, shape in found)


def _smooth(size: tuple[int, ...], highest: int) -> list[tuple[int, FloatArray]]:
    """Products (row, column) of Legendre polynomials, each after its order, 1 to the highest: the higher, the less likely."""
    from numpy.polynomial.legendre import legvander

    down, across = (legvander(np.linspace(-1.0, 1.0, length), highest) for length in size)
    numbers = [(i, k) for i in range(highest + 1) for k in range(highest + 1 - i) if i or k]
    return [(i + k, np.outer(down[:, i], across[:, k])) for i, k in numbers]


def _of_steps(probes: SeriesProbes, name: str) -> float:
    """What the largest output noise that is no effect adds to the logarithm of the variance of steps from frame to frame."""
    own = math.exp(probes.series.scalars[name])
    jitter = (scales.OUTPUT_STEP_LIMIT * probes.series.context.reference_signal_DN) ** 2
    return math.log1p(jitter / own)


def _of_scene(item: SessionSeries, signal: FloatArray, *, sharp: bool, rough: float) -> _Images:
    """Where a scene lies and how its outline is drawn; rough: how far outlines depart from their maps, over what is assumed."""
    place = _place(item)
    dy, dx = gradient(signal)
    rows, columns = signal.shape
    registered_px = CELL_SD_PX if sharp else scales.REGISTERED_SD_PX
    row = np.linspace(-0.5, 0.5, rows)[:, None] * rows
    across = np.linspace(-0.5, 0.5, columns)[None, :] * columns
    slope = np.hypot(dy, dx)
    images: _Images = {
        "edges, columns": _blurred_more(signal, scales.EDGE_SD_PX2, axis=1),
        "edges, rows": _blurred_more(signal, scales.EDGE_SD_PX2, axis=0),
        f"column of {place}": registered_px * dx,
        f"row of {place}": registered_px * dy,
        f"outline of {place}": scales.OUTLINE_SD_PX * np.asarray(slope),
        f"magnification of {place}": scales.MAGNIFICATION_SD * (row * dy + across * dx),
        f"rotation of {place}": scales.MAGNIFICATION_SD * (across * dy - row * dx),
    }
    for number, field in enumerate(_rough_fields(dy.shape, place)):
        images[f"rough edge {number} of {place}"] = rough * slope * field
    return images


def _of_spot(sigma_px: float, signal: FloatArray) -> _Images:
    """What another size of the focal spot, sigma_px of its image here, does: blur that grows with the magnification."""
    if sigma_px == 0.0:
        return {}
    more_px2 = 2.0 * scales.SPOT_SD * sigma_px**2
    return {
        "size of the focal spot, columns": _blurred_more(signal, more_px2, axis=1),
        "size of the focal spot, rows": _blurred_more(signal, more_px2, axis=0),
    }


def _blurred_more(signal: FloatArray, variance_px2: float, *, axis: int) -> FloatArray:
    """What a Gaussian blur of this variance along an axis adds to a picture (row, column), which mirrors at its borders."""
    from scipy.fft import dct, idct

    frequency = np.arange(signal.shape[axis]) / (2.0 * signal.shape[axis])  # cycles a pixel
    loss = np.expm1(-2.0 * math.pi**2 * variance_px2 * frequency**2)
    return np.asarray(idct(dct(signal, axis=axis) * (loss if axis == 1 else loss[:, None]), axis=axis))


def _between_points(item: SessionSeries, signal: FloatArray) -> _Images:
    """Where pixels jump as maps of points do, what a blur shows of how borders run between them."""
    maps = item.request.thickness_mm
    if maps is None or not sampled_at_points(maps):
        return {}
    place = _place(item)
    return {
        f"outline of {place} between points, {number}": image
        for number, image in enumerate(blurred_between_points(maps, signal))
    }


@lru_cache(maxsize=2)
def _rough_fields(shape: tuple[int, ...], place: str) -> NDArray[np.float32]:
    """Fields (number, row, column) over the local slope, the same for every series of a place: rendering from pixel to pixel."""
    from zlib import crc32

    from scipy.ndimage import gaussian_filter

    # fixed fields, not draws: the same scene always has the same ones
    rng = np.random.default_rng(crc32(place.encode()))
    result = np.empty((scales.ROUGH_FIELDS, *shape), np.float32)
    for number in range(scales.ROUGH_FIELDS):
        field = gaussian_filter(rng.standard_normal(shape), (0.7, 2.0, 5.0)[number % 3])
        result[number] = scales.ROUGH_SHARE / math.sqrt(scales.ROUGH_FIELDS) / float(np.std(field)) * field
    return result


def _of_thickness(
    probes: SeriesProbes, signal: FloatArray, thicker: Mapping[str, Moved], beams_differ: float
) -> Columns:
    """Thickness and attenuation of the scene's materials; where beams differ, how attenuation changes with the depth as well."""
    item, expected = probes.series.session, probes.series.scalars
    columns: Columns = {}
    of_beam = beams_differ * scales.ATTENUATION_OF_BEAM_SD / scales.THICKNESS_SD
    for material, (moved, values) in thicker.items():
        # less light is less noise, too
        quieter = [
            (values.get(probe.name, expected[probe.name]) - expected[probe.name]) / probe.sd for probe in probes.scalars
        ]
        response = np.concatenate([probes.projection.apply(moved), quieter])
        columns[f"thickness of {material} in {item.series.scene}"] = response
        columns[f"attenuation of {material}"] = response * (scales.ATTENUATION_SD / scales.THICKNESS_SD)
        columns[f"attenuation of {material} at {_voltage(item)}"] = response * of_beam
        if beams_differ > 1.0:
            # another spectrum hardens in another way
            depth = np.log(np.max(signal) / np.maximum(signal, 1e-9 * np.max(signal)))
            harder = probes.of_maps((moved * depth)[None])[0]
            columns[f"hardness at {_voltage(item)} behind {material}"] = of_beam * harder
    return columns


def _gain_map_noise(session: SessionModel, probes: SeriesProbes, signal: FloatArray) -> Columns:
    """Smooth noise of the gain map by shape, as few calibrating frames leave it in every series that it divides."""
    item, maps = probes.series.session, session.maps
    if not item.request.beam_on or item.calibrates or "gain" in item.series.corrected:
        return {}
    # relative, of one pixel's gain in sums over many pixels
    lasting = maps.gain_white + maps.gain_quantum * correlation_sum(probes.series.expected, BLOCK_PX, BLOCK_PX)
    if lasting <= 0.0:
        return {}
    pixel_sd = math.sqrt(lasting)
    waves = _waves(signal.shape, scales.PATTERN_WAVES + 1)  # as of a changed map; the level has nuisances of its own
    amounts = [pixel_sd / math.sqrt(float(np.sum(wave**2))) * wave for wave in waves.values()]
    found = probes.of_maps(np.stack(amounts) * signal)
    return {f"gain map {i},{j}": column for (i, j), column in zip(waves, found, strict=True)}


def offset_of_later(probes: SeriesProbes) -> FloatArray:
    """What one DN more in every pixel of a later series does (probe,)."""
    if probes.series.session.calibrates:
        return np.zeros(len(probes))
    previous_DN = probes.series.context.previous_signal_DN
    scalars = [
        1.0 / previous_DN / probe.sd if previous_DN and probe.name.startswith("afterglow") else 0.0
        for probe in probes.scalars
    ]
    return np.concatenate([probes.projection.of_level, scalars])


def changed_gain_pattern(
    probes: SeriesProbes, signal: FloatArray, patterns: Iterable[FixedPattern]
) -> tuple[FloatArray, dict[FixedPattern, FloatArray]]:
    """What 1 % of a changed gain map does by chance: responses (probe, wave) of its smooth part, variance (probe,) of the rest.

    signal: expected (row, column), DN; patterns: what the rest may be, by which it is given.
    """
    waves, item, maps = _pattern_waves(signal.shape), probes.series.session, len(probes.projection)
    smooth, rest = np.zeros((len(probes), len(waves))), {pattern: np.zeros(len(probes)) for pattern in patterns}
    if item.calibrates or not item.request.beam_on:
        return smooth, rest
    smooth[:maps] = probes.projection.apply(waves * signal.astype(np.float32)).T
    own = 0.01 * scales.PATTERN_FINE * signal
    for pattern, variance in rest.items():
        if pattern.of_columns:
            variance[:maps] = probes.projection.column_noise(own)
        else:
            # the area under exp(-d^2 / (2 length^2))
            side_px = max(math.sqrt(2.0 * math.pi) * pattern.correlation_px, 1.0)
            variance[:maps] = probes.projection.field_noise(own, side_px)
    return smooth, rest


def changed_tiles(probes: SeriesProbes, signal: FloatArray, tiles: TilePattern) -> FloatArray:
    """What gains of tiles of 1 % rms do by chance: responses (probe, tile); signal: (row, column), DN."""
    item, maps = probes.series.session, len(probes.projection)
    rows, columns = tiles.rows.tile_of(signal.shape[0]), tiles.columns.tile_of(signal.shape[1])
    number = rows[:, None] * (columns[-1] + 1) + columns
    found = np.zeros((len(probes), int(number[-1, -1]) + 1))
    if item.request.beam_on and not item.calibrates:
        images = (np.where(number == tile, 0.01, 0.0) * signal for tile in range(found.shape[1]))
        found[:maps] = probes.projection.apply(np.stack(list(images)).astype(np.float32)).T
    return found


def noise_of_lines(probes: SeriesProbes) -> FloatArray:
    """Variance (2, probe) that noise of 1 DN, new in every exposure and common to rows (to columns), leaves in a mean frame."""
    request = probes.series.session.request
    variance = probes.projection.line_noise() / (request.frames * request.exposures_per_frame)
    return probes.without_scalars(variance)


@lru_cache(maxsize=1)
def _pattern_waves(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The smooth part of 1 % of a changed gain map: waves (wave, row, column) that it holds by chance."""
    # pixels that change their gain change that of the panel: the even field as much as the longest wave
    waves = {(0, 0): np.ones(shape), **_waves(shape, scales.PATTERN_WAVES + 1)}
    weights = [1.0 / max(math.hypot(*numbers), 1.0) for numbers in waves]
    result = np.empty((len(waves), *shape), np.float32)
    for image, weight, wave in zip(result, weights, waves.values(), strict=True):
        share = weight / sum(weights)
        image[...] = 0.01 * scales.PATTERN_SMOOTH * math.sqrt(share / float(np.mean(wave**2))) * wave
    return result


@lru_cache(maxsize=8)
def _waves(shape: tuple[int, ...], count: int) -> dict[tuple[int, int], FloatArray]:
    """Products of `count` cosines along each side (row, column), by their numbers; the even field is left out."""
    y, x = (np.cos(np.pi * np.outer(np.arange(count), (np.arange(length) + 0.5) / length)) for length in shape)
    return {(i, k): np.outer(y[i], x[k]) for i in range(count) for k in range(count) if i or k}


def uneven(
    probes: SeriesProbes, images: Mapping[int, Map], shape: tuple[int, ...], *, order: int
) -> dict[int, FloatArray]:
    """Responses (smooth shape, probe), not shrunk, to more of a change in one part of the panel than in another, by key.

    A panel seldom warms evenly, and no anode's heel is a straight line. images: what changes do to the mean frame (row, column
    or 1, 1), DN; shape: of the panel, rows and columns; order: the highest of the shapes, 1 for slopes from side to side.
    """
    if not images:
        return {}
    shapes = np.stack([one / number for number, one in _smooth(shape, order)]).astype(np.float32)
    uneven_ones = [key for key, image in images.items() if image.size > 1]
    # all at once: the projection is larger than a processor's cache
    under = [shapes, *(images[key] * shapes for key in uneven_ones)]
    alike, *found = probes.projection.apply(np.stack(under))
    result = {key: float(image.flat[0]) * alike for key, image in images.items()} | dict(
        zip(uneven_ones, found, strict=True)
    )
    return {key: probes.without_scalars(columns) for key, columns in result.items()}
