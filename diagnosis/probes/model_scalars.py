"""Scalar probes by the forward model."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ...generator.frames.line_model import ExpectedSeries
from ..arrays import FloatArray, RealArray
from ..session.summaries import BLOCK_PX, LAGS, LEAST_NOISE_DN2
from .fixed_pattern import Pattern, shares_of_pixels, shares_of_tiles
from .lasting import BY_CHANCE, chance_in_flat, chances
from .line_scalars import LineNoise, line_pattern
from .moving_picture import MovingPicture, lag_loss
from .noise_correlation import autocovariance, correlation_sum
from .noise_tails import tails_of_quanta
from .probes import (
    FIXED,
    FIXED_BLOCKS,
    FIXED_COLUMNS,
    FIXED_ROWS,
    LASTING,
    OUTLIERS,
    OUTLIERS_ANYWHERE,
    PATTERN_PIXEL_SHARE,
    REPEATED_FRAMES,
    noise_name,
    root_of_count,
)
from .scalar_context import ScalarContext, afterglow_bins, frame_profile, time_templates

_LEAST_PATTERN = 1e-3  # of the variance of noise: less noise than expected leaves at least this


def expected_scalars(
    expected: ExpectedSeries, context: ScalarContext, *, dark_change_DN: RealArray | float = 0.0
) -> dict[str, float]:
    """The scalar probes' values by the forward model, by name; only those that this kind of series has.

    dark_change_DN: what the effects changed in the dark that is subtracted (an afterglow is judged against it).
    """
    values: dict[str, float] = {}
    areas = context.areas
    profile = frame_profile(expected, areas)
    if context.frames > 2:
        values |= _noise_scalars(expected, context, profile)
    profiles = time_templates(context.frames)
    if profiles and context.kind != "afterglow":
        scale = 1.0 if context.kind == "dark" else 1.0 / context.reference_signal_DN
        for name, template in profiles:
            values[f"trend {name}"] = float(profile @ template) * scale / math.sqrt(context.frames)
    if context.kind == "afterglow" and context.previous_signal_DN:
        profile = profile + float(areas.mean(expected.mean_DN) + areas.mean(dark_change_DN) - context.dark_DN)
        for start, stop in afterglow_bins(context.frames):
            values[f"afterglow frames {start}-{stop - 1}"] = (
                float(profile[start:stop].mean()) / context.previous_signal_DN
            )
    if context.codes_usable:
        values["codes"] = max(expected.quantisation_step_DN, 1.0)
    if not context.calibrates and context.kind in ("flat", "dark"):
        values |= _pattern_scalars(expected, context)
    if context.repeatable:
        values[REPEATED_FRAMES] = root_of_count(expected.repeated_share * context.repeatable)
    if context.counts_all_outliers:
        lasting, _, out = _jumping(expected, context)
        values[LASTING] = root_of_count((lasting + BY_CHANCE) * areas.order.size)
        values[OUTLIERS_ANYWHERE] = root_of_count((expected.bad_pixel_share + out) * areas.order.size)
    return values


def _noise_scalars(expected: ExpectedSeries, context: ScalarContext, profile: FloatArray) -> dict[str, float]:
    """Variance, correlation, lines, blocks, times and tails of the noise; profile (n,): course of the mean, DN."""
    values: dict[str, float] = {}
    areas = context.areas
    rows, columns = context.good.shape
    keep = lag_loss(expected)
    lines = LineNoise.of(expected, context)
    mean_q, label_q = areas.means(expected.quantum_variance_DN2)
    mean_w, label_w = areas.means(expected.white_variance_DN2)
    moving = MovingPicture.of(expected, context)
    moved = moving.pixels()
    total = max(mean_q * keep + mean_w + lines.pixel() + moved, LEAST_NOISE_DN2)
    correlations = [autocovariance(expected, dr, dc) for dr, dc in LAGS]
    for label, name in enumerate(context.label_names):
        # an area whose pixels are brighter than others by their gain is noisier by its square
        q, w = float(label_q[label] * context.label_gain[label]) * keep, float(label_w[label])
        shared = moving.pixels(label)
        here = max(q + w + lines.pixel(label) + shared, LEAST_NOISE_DN2)
        variance_name, correlation_names = _noise_names(name)
        values[variance_name] = math.log(here)
        for known, correlation, lag in zip(correlation_names, correlations, LAGS, strict=True):
            values[known] = (q * correlation + shared + lines.together(*lag, label)) / here

    def over_total(variance_DN2: float) -> float:
        return math.log(max(variance_DN2, 1e-12) / total)

    line_q = mean_q * keep
    if context.whole_lines:
        row, column = lines.rows(), lines.columns()
        of_row = (row + moving.rows()) * columns + column + line_q * correlation_sum(expected, 1, columns) + mean_w
        of_column = (column + moving.columns()) * rows + row + line_q * correlation_sum(expected, rows, 1) + mean_w
        values["row_ratio"], values["column_ratio"] = over_total(of_row), over_total(of_column)
    of_block = line_q * correlation_sum(expected, BLOCK_PX, BLOCK_PX) + mean_w
    values["block_ratio"] = over_total(of_block + BLOCK_PX**2 * (lines.frame(BLOCK_PX, BLOCK_PX) + moved))
    temporal = np.atleast_1d(np.asarray(expected.temporal_correlation, dtype=np.float64))
    full = max(mean_q + mean_w + lines.pixel() + moved, LEAST_NOISE_DN2)
    for step in (1, 2):
        correlation = float(temporal[step - 1]) if temporal.size >= step else 0.0
        values[f"temporal_correlation {step}"] = (correlation * mean_q + moving.lasting(step)) / full
    values["kurtosis"] = moving.kurtosis(expected) + tails_of_quanta(expected, areas)
    if context.kind in ("flat", "object"):
        quantum = (mean_q * keep * correlation_sum(expected, rows, columns) + mean_w) / areas.order.size
        quantum += lines.frame(rows, columns)
        # seen in steps from frame to frame
        steps = 1.0 - float(expected.frame_factor_correlation[1])
        wandering = steps * (expected.frame_factor_rms * context.reference_signal_DN) ** 2
        # what is left in the traps fades in steps as well
        fading = 0.5 * float(np.mean(np.diff(profile) ** 2))
        values["frame_factor"] = math.log(quantum + wandering + fading)
    return values


def _pattern_scalars(expected: ExpectedSeries, context: ScalarContext) -> dict[str, float]:
    """What stands in the mean frame of a flat or dark that does not calibrate: pattern, its blocks and lines, outliers."""
    shape = context.good.shape
    signal2 = context.reference_signal_DN**2 if context.kind == "flat" else 0.0
    # lines that change leave their mean
    standing = line_pattern(expected, signal2) / context.frames
    if expected.gain_pattern is not None:
        own = expected.gain_pattern
        pixels = shares_of_pixels(shape, replace(own, rms=1.0, seed=0))
        standing += PATTERN_PIXEL_SHARE * own.rms**2 * signal2 * pixels
    if expected.tile_pattern is not None:
        standing += expected.tile_pattern.rms**2 * signal2 * shares_of_tiles(shape, expected.tile_pattern)
    # more quanta's noise in the frames is more of it in their mean
    mean_q, _ = context.areas.means(expected.quantum_variance_DN2)
    added = (mean_q - context.quantum_DN2) / context.frames
    of_blocks = correlation_sum(expected, BLOCK_PX, BLOCK_PX) / BLOCK_PX**2
    standing += added * np.array([1.0 - autocovariance(expected, 0, 1), of_blocks, 1.0 / shape[1], 1.0 / shape[0]])
    values = with_pattern({}, standing, context.pattern_noise)
    # about half of the hot ones are lost in a flat's light
    hot, bad = expected.hot_pixel_share, expected.bad_pixel_share
    seen = _jumping(expected, context)[1] + (hot if context.kind == "dark" else bad - 0.5 * hot)
    values[OUTLIERS] = root_of_count(seen * context.areas.order.size)
    # what bad pixels add is new in every frame
    values["memory of outliers"] = 0.0
    return values


def with_pattern(values: Mapping[str, float], standing: Pattern, noise: Pattern) -> dict[str, float]:
    """Probes of the fixed pattern (those in `values`, or of noise alone) with more that stands in the mean frame.

    The roots of variances of pixels and blocks over those of noise, and half their logarithm for rows and columns.
    """
    result = dict(values)
    pixel, block, rows, columns = map(float, standing / noise)
    for name, more in ((FIXED, pixel), (FIXED_BLOCKS, block)):
        result[name] = math.sqrt(max(values.get(name, 1.0) ** 2 + more, _LEAST_PATTERN))
    for name, more in ((FIXED_ROWS, rows), (FIXED_COLUMNS, columns)):
        if not math.isnan(more):
            before = math.exp(2.0 * values.get(name, 0.0))
            result[name] = 0.5 * math.log(max(before + more, _LEAST_PATTERN))
    return result


def _jumping(expected: ExpectedSeries, context: ScalarContext) -> tuple[float, float, float]:
    """Shares of the pixels that jump and last in a later dark; that do not, but stand out of this dark or flat, and of any dark."""
    law, darks = expected.telegraph, context.later_darks
    if law is None or not darks:
        return 0.0, 0.0, 0.0
    lasting, each, anywhere = chances(law, darks)
    here = each[0]
    if context.kind == "flat":
        here = chance_in_flat(law, darks, context.frames, context.averaged, context.stands_out_reads)
    return law.share * lasting, law.share * here, law.share * anywhere


@lru_cache(maxsize=64)
def _noise_names(label: str) -> tuple[str, tuple[str, ...]]:
    """Names of a label's variance and of its correlation at each of LAGS."""
    return noise_name(label), tuple(noise_name(label, lag) for lag in LAGS)
