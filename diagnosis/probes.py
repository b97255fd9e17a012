"""Probes of one series: numbers with known noise, each tied to an axis, that frames and forward model both give.

Two families. *Map probes* are projections of the mean frame's residual on a set of templates: smooth shapes, bins of
transmission, derivatives at edges, long tails, and what each effect and nuisance would do there. They are made
orthogonal one after the other under the noise's own covariance, so that each has unit variance, is independent of the
others and bears the name of the template that it adds. *Scalar probes* are noise by level, correlation between neighbours and
frames, lines, blocks, the common factor, codes, fixed pattern and outliers.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..generator.rounding import variance_before_rounding
from ..generator.series import ExpectedSeries
from ._projection_loops import weigh_template
from .fixed_pattern import Pattern
from .lost_bits import rounded_kurtosis
from .noise_correlation import autocovariance, correlation_sum
from .registration import gradient
from .summaries import BLOCK_PX, LAGS, LEAST_NOISE_DN2, PIECE_FRAMES, SeriesSummary

AXES = ("level", "noise", "sharpness", "texture", "time", "position", "energy", "tails", "task")
_AFTERGLOW_EDGES = (0, 1, 2, 3, 5, 9, 17, 33, 65, 129, 100000)
_LEAST_FREEDOM = 5.0  # of a variance whose logarithm is still near enough a Gaussian number
_LEAST_OUTLIERS, _LEAST_FRAMES = 5, 6  # pixels, and frames of each, that show what lasts from frame to frame
PATTERN_PIXEL_SHARE = 0.9  # of a fixed pattern's variance that neighbours differ by
_LEAST_PAIRS = 64  # of neighbours whose correlation is nearly a Gaussian number
_LEAST_NORM = 1e-6  # standard deviations that a template stands for; below it is rounding
FIXED_ROWS, FIXED_COLUMNS = "fixed_pattern rows", "fixed_pattern columns"
OUTLIERS, OUTLIERS_ANYWHERE = "outliers", "outliers in any series"
ALONG_ROWS, ALONG_COLUMNS = "displacement along rows", "displacement along columns"  # of a scene
_KURTOSIS_PIXELS = 2048  # in which a fading picture's is computed
_KURTOSIS_FRAMES = 15  # below, each pixel's own variance is too uncertain to standardise by

# what repeats of the same measurement show beyond counting noise; standard deviations of the probe's own unit
FLOORS: Mapping[str, float] = {
    "log_variance": 0.004,
    "correlation": 0.002,
    "row_ratio": 0.03,
    "column_ratio": 0.03,
    "block_ratio": 0.03,
    "temporal_correlation": 0.002,
    "kurtosis": 0.02,
    "frame_factor": 0.15,
    "trend": 0.0001,
    "dark_trend_DN": 0.02,
    "afterglow": 2e-5,
    "codes": 0.03,
    "fixed_pattern": 0.025,  # of the value, as for its blocks
    "fixed_pattern blocks": 0.5,  # a pattern's grain is its own: white in the model, coarser in some panels
    "fixed_pattern lines": 0.1,
    "outliers": 0.3,
    "memory of outliers": 0.02,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Template:
    """A map (row, column) to project on, DN, and what it stands for."""

    axis: str
    name: str
    unit: str
    image: NDArray[np.floating]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scalar:
    """A scalar probe: axis, name, unit, measured value, its standard deviation, and the counting noise's part of it."""

    axis: str
    name: str
    unit: str
    value: float
    sd: float
    sampling_sd: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeName:
    """What a probe is called: axis, statistic, location (where within the series), unit."""

    axis: str
    statistic: str
    location: str
    unit: str


def _lag_loss(expected: ExpectedSeries) -> float:
    correlation = np.atleast_1d(np.asarray(expected.temporal_correlation, dtype=np.float64))
    return 1.0 - float(correlation[0]) if correlation.size else 1.0


@dataclass(frozen=True, slots=True)
class Areas:
    """The good pixels of a frame, those of one label together.

    Fields: order (pixel,): flat indices, those without label first; parts: where each label's lie in it; known: the last
    map of which means were taken, and these.
    """

    order: NDArray[np.intp]
    parts: tuple[slice, ...]
    known: list[tuple[NDArray[np.floating], tuple[float, NDArray[np.float64]]]] = field(default_factory=list)

    @staticmethod
    def of(good: NDArray[np.bool_], labels: NDArray[np.int64], count: int) -> "Areas":
        """Of good pixels (row, column) and their labels from 0 to `count`; other labels are none."""
        inside = np.flatnonzero(good)
        own = labels.ravel()[inside]
        own = np.where((own >= 0) & (own < count), own, -1)
        ends = np.searchsorted(np.sort(own), np.arange(count + 1))
        order = inside[np.argsort(own, kind="stable")]
        return Areas(order, tuple(slice(int(start), int(stop)) for start, stop in pairwise(ends)))

    def means(self, image: NDArray[np.floating]) -> tuple[float, NDArray[np.float64]]:
        """Means of a map, (row, column) or (1, 1), over all good pixels and over each label's (label,)."""
        if image.size == 1:
            return float(image.flat[0]), np.full(len(self.parts), float(image.flat[0]))
        for one, means in self.known:
            if one is image:
                return means
        values = image.ravel()[self.order]
        found = float(np.add.reduce(values)) / values.size, np.array([_mean(values[part]) for part in self.parts])
        # what acts after the quanta leaves their map as it is
        self.known[:] = [(image, found), *self.known[:1]]
        return found

    def mean(self, image: NDArray[np.floating] | float) -> float:
        """Mean of a map over all good pixels."""
        whole = np.asarray(image)
        return float(whole.flat[0]) if whole.size == 1 else _mean(whole.ravel()[self.order])


def _mean(values: NDArray[np.floating]) -> float:
    """Mean of values, NaN of none."""
    return float(np.add.reduce(values)) / values.size if values.size else math.nan


@lru_cache(maxsize=64)
def _noise_names(label: str) -> tuple[str, tuple[str, ...]]:
    """Names of a label's variance and of its correlation at each of LAGS."""
    return f"log_variance {label}", tuple(f"correlation {label} ({dr},{dc})" for dr, dc in LAGS)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalarContext:
    """What scalar probes of a series refer to; the same for measured frames and forward model.

    Fields: kind; frames; good (row, column); labels (row, column); label_names; reference_signal_DN: mean signal of the
    base model (1 for darks); previous_signal_DN: of the exposure before an afterglow; calibrates; codes_usable; pattern_noise: what
    noise alone leaves of a pattern in the corrected mean frame; quantum_DN2: the base model's quantum variance of one frame;
    dark_DN: the base model's mean dark;
    counts_all_outliers: this series stands for all, where pixels are counted that stand out anywhere; gain (row, column):
    of the panel's pixels in these frames, None where all are alike; averaged: exposures in a frame; whole_lines: good pixels fill
    rows and columns, so that noise of these is seen; areas: the
    good pixels label by label; label_gain (label,): mean square of the gains of a label's pixels over that of all good ones.
    """

    kind: str
    frames: int
    good: NDArray[np.bool_]
    labels: NDArray[np.int64]
    label_names: tuple[str, ...]
    reference_signal_DN: float
    previous_signal_DN: float | None
    calibrates: bool
    codes_usable: bool
    pattern_noise: Pattern
    quantum_DN2: float
    dark_DN: float
    counts_all_outliers: bool
    gain: NDArray[np.floating] | None = None
    averaged: int = 1
    whole_lines: bool = True
    areas: "Areas" = field(init=False)
    label_gain: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        areas = Areas.of(self.good, self.labels, len(self.label_names))
        label_gain = np.ones(len(self.label_names))
        if self.gain is not None:
            whole, parts = areas.means(np.asarray(self.gain, dtype=np.float64) ** 2)
            label_gain = np.where(parts > 0.0, parts, whole) / whole
        object.__setattr__(self, "areas", areas)
        object.__setattr__(self, "label_gain", label_gain)


@lru_cache(maxsize=64)
def time_templates(frames: int) -> list[tuple[str, NDArray[np.float64]]]:
    """Orthonormal profiles over frames (n,), each free of the mean: early rise or fall, slow settling, linear trend."""
    if frames < 6:
        return []
    t = np.arange(frames, dtype=np.float64)
    result: list[tuple[str, NDArray[np.float64]]] = []
    basis = [np.ones(frames) / math.sqrt(frames)]
    for name, profile in (
        ("linear trend", t - t.mean()),
        ("first frames", np.exp(-t / 1.5)),
        ("settling", np.exp(-t / (0.15 * frames + 2.0))),
    ):
        rest = profile - sum(float(profile @ item) * item for item in basis)
        norm = float(np.linalg.norm(rest))
        if norm < 0.05 * float(np.linalg.norm(profile)):
            continue
        basis.append(rest / norm)
        result.append((name, basis[-1]))
    return result


def expected_scalars(
    expected: ExpectedSeries, context: ScalarContext, *, dark_change_DN: NDArray[np.floating] | float = 0.0
) -> dict[str, float]:
    """The scalar probes' values by the forward model, by name; only those that this kind of series has.

    dark_change_DN: what the effects changed in the dark that is subtracted (an afterglow is judged against it).
    """
    values: dict[str, float] = {}
    areas = context.areas
    n_good = areas.order.size
    rows, columns = context.good.shape
    keep = _lag_loss(expected)
    row, column = expected.row_variance_DN2, expected.column_variance_DN2
    mean_q, label_q = areas.means(expected.quantum_variance_DN2)
    mean_w, label_w = areas.means(expected.white_variance_DN2)
    moving = _MovingPicture.of(expected, context)
    moved = moving.pixels()
    total = max(mean_q * keep + mean_w + row + column + moved, LEAST_NOISE_DN2)
    profile = frame_profile(expected, areas)
    if context.frames > 2:
        correlations = [autocovariance(expected, dr, dc) for dr, dc in LAGS]
        lines = [(row if dr == 0 else 0.0) + (column if dc == 0 else 0.0) for dr, dc in LAGS]
        for label, name in enumerate(context.label_names):
            # an area whose pixels are brighter than others by their gain is noisier by its square
            q, w = float(label_q[label] * context.label_gain[label]) * keep, float(label_w[label])
            shared = moving.pixels(label)
            here = max(q + w + row + column + shared, LEAST_NOISE_DN2)
            variance_name, correlation_names = _noise_names(name)
            values[variance_name] = math.log(here)
            for known, correlation, line in zip(correlation_names, correlations, lines, strict=True):
                values[known] = (q * correlation + shared + line) / here
        line_q = mean_q * keep
        if context.whole_lines:
            values["row_ratio"] = math.log(
                max(
                    (row + moving.rows()) * columns + column + line_q * correlation_sum(expected, 1, columns) + mean_w,
                    1e-12,
                )
                / total
            )
            values["column_ratio"] = math.log(
                max(
                    (column + moving.columns()) * rows + row + line_q * correlation_sum(expected, rows, 1) + mean_w,
                    1e-12,
                )
                / total
            )
        values["block_ratio"] = math.log(
            max(
                line_q * correlation_sum(expected, BLOCK_PX, BLOCK_PX)
                + mean_w
                + BLOCK_PX * (row + column)
                + BLOCK_PX**2 * moved,
                1e-12,
            )
            / total
        )
        temporal = np.atleast_1d(np.asarray(expected.temporal_correlation, dtype=np.float64))
        full = max(mean_q + mean_w + row + column + moved, LEAST_NOISE_DN2)
        for step in (1, 2):
            correlation = float(temporal[step - 1]) if temporal.size >= step else 0.0
            values[f"temporal_correlation {step}"] = (correlation * mean_q + moving.lasting(step)) / full
        values["kurtosis"] = _kurtosis(expected, context, full) + moving.kurtosis(expected)
        if context.kind in ("flat", "object"):
            signal = context.reference_signal_DN
            quantum = (mean_q * keep * correlation_sum(expected, rows, columns) + mean_w) / n_good
            quantum += row / rows + column / columns
            # seen in steps from frame to frame
            steps = 1.0 - float(expected.frame_factor_correlation[1])
            wandering = steps * (expected.frame_factor_rms * signal) ** 2
            # what is left in the traps fades in steps as well
            fading = 0.5 * float(np.mean(np.diff(profile) ** 2))
            values["frame_factor"] = math.log(quantum + wandering + fading)
    profiles = time_templates(context.frames)
    if profiles and context.kind != "afterglow":
        scale = 1.0 if context.kind == "dark" else 1.0 / context.reference_signal_DN
        for name, template in profiles:
            values[f"trend {name}"] = float(profile @ template) * scale / math.sqrt(context.frames)
    if context.kind == "afterglow" and context.previous_signal_DN:
        profile = profile + float(areas.mean(expected.mean_DN) + areas.mean(dark_change_DN) - context.dark_DN)
        for start, stop in _afterglow_bins(context.frames):
            values[f"afterglow frames {start}-{stop - 1}"] = (
                float(profile[start:stop].mean()) / context.previous_signal_DN
            )
    if context.codes_usable:
        values["codes"] = max(expected.quantisation_step_DN, 1.0)
    if not context.calibrates and context.kind in ("flat", "dark"):
        signal2 = context.reference_signal_DN**2 if context.kind == "flat" else 0.0
        pattern = PATTERN_PIXEL_SHARE * expected.fixed_pattern_rms**2 * signal2
        # more quanta's noise in the frames is more of it in their mean
        added = (mean_q - context.quantum_DN2) / context.frames
        neighbours = 1.0 - autocovariance(expected, 0, 1)
        lasting = added * correlation_sum(expected, BLOCK_PX, BLOCK_PX)
        noise = context.pattern_noise
        values["fixed_pattern"] = math.sqrt(max(1.0 + (pattern + added * neighbours) / noise.pixel_DN2, 1e-3))
        if noise.blocks_DN2 is not None:
            values["fixed_pattern blocks"] = math.sqrt(
                max(1.0 + (pattern + lasting) / BLOCK_PX**2 / noise.blocks_DN2, 1e-3)
            )
        if noise.rows_DN2 is not None and noise.columns_DN2 is not None:
            # a pattern is no more alike along a line than across it; lines that change leave their mean
            for name, noise_DN2, line, length in (
                (FIXED_ROWS, noise.rows_DN2, row, columns),
                (FIXED_COLUMNS, noise.columns_DN2, column, rows),
            ):
                values[name] = 0.5 * math.log(
                    max(1.0 + ((pattern + added) / length + line / context.frames) / noise_DN2, 1e-3)
                )
        # about half of the hot ones are lost in a flat's light
        hot, bad = expected.hot_pixel_share, expected.bad_pixel_share
        seen = hot if context.kind == "dark" else bad - 0.5 * hot
        values[OUTLIERS] = math.sqrt(seen * n_good + 0.375)
        # what bad pixels add is new in every frame
        values["memory of outliers"] = 0.0
    if context.counts_all_outliers:
        values[OUTLIERS_ANYWHERE] = math.sqrt(expected.bad_pixel_share * n_good + 0.375)
    return values


def _kurtosis(expected: ExpectedSeries, context: ScalarContext, variance_DN2: float) -> float:
    """Excess kurtosis that the ADC's steps leave in noise of a variance, rounding included."""
    step, of_one = expected.quantisation_step_DN, context.averaged * variance_DN2
    if step <= 0.0 or of_one > step**2:
        return 0.0
    before = float(variance_before_rounding(of_one, step))
    return rounded_kurtosis(math.sqrt(before) / step, context.frames) / context.averaged


@dataclass(frozen=True, slots=True)
class _MovingPicture:
    """What a picture that fades from frame to frame adds to variances, once the frames' common factor is taken out.

    Fields: products: mean product (trend, trend) of the pictures' pixels, of all good pixels and of each label's; lines: the
    same of the means of rows and of columns; steps (trend, trend): half of the mean product of changes from one frame to the
    next; courses (trend, frame); order (pixel,): flat indices of some good pixels all over the field; there (trend, pixel): the
    pictures in these.
    """

    products: tuple[NDArray[np.float64], ...]
    lines: tuple[NDArray[np.float64], ...]
    steps: NDArray[np.float64]
    courses: NDArray[np.float64]
    order: NDArray[np.intp]
    there: NDArray[np.float64]

    @staticmethod
    def of(expected: ExpectedSeries, context: ScalarContext) -> "_MovingPicture":
        if not expected.trend_DN:
            return _STILL
        good, areas = context.good, context.areas
        shape: NDArray[np.float64] | float = 1.0
        kept, courses = [], []
        if context.kind in ("flat", "object"):
            signal = np.broadcast_to(expected.signal_DN, good.shape).ravel()[areas.order]
            shape = signal / max(float(signal.mean()), 1e-12)
        for image, course in expected.trend_DN:
            whole = np.broadcast_to(np.asarray(image, dtype=np.float64), good.shape).ravel()[areas.order]
            own = whole - float(whole.mean()) * shape
            profile = np.asarray(course, dtype=np.float64)
            # a hundredth of a DN adds nothing to any variance
            if profile.size > 1 and float(np.abs(own).max()) * float(np.ptp(profile)) > 0.01:
                kept.append(own)
                courses.append(profile - profile.mean())
        if not kept:
            return _STILL
        pixels, profiles = np.stack(kept), np.stack(courses)
        whole = np.zeros((len(kept), *good.shape))
        whole.reshape(len(kept), -1)[:, areas.order] = pixels
        means = [whole.sum(axis=axis) / np.maximum(good.sum(axis=axis - 1), 1) for axis in (2, 1)]
        steps = np.diff(profiles, axis=1)
        stride = max(areas.order.size // _KURTOSIS_PIXELS, 1)
        return _MovingPicture(
            tuple(_mean_product(pixels[:, part]) for part in (slice(None), *areas.parts)),
            tuple(_mean_product(one) for one in means),
            0.5 * steps @ steps.T / steps.shape[1],
            profiles,
            areas.order[::stride],
            pixels[:, ::stride],
        )

    def pixels(self, label: int | None = None) -> float:
        """Variance of single pixels, DN^2: of all good ones, or of a label's."""
        if not self.products:
            return 0.0
        return float(np.sum(self.steps * self.products[0 if label is None else 1 + label]))

    def kurtosis(self, expected: ExpectedSeries) -> float:
        """Excess kurtosis of pixels' steps from frame to frame: most of a picture that fades goes with the first of them.

        Of a Gaussian step of variance v moved by m: (<m^4> - 3 <m^2>^2) / (v + <m^2>)^2, means over the frames that
        `summarise_series` scales a pixel by.
        """
        if not self.products:
            return 0.0

        def pixels(variance: NDArray[np.floating]) -> NDArray[np.float64]:
            found = np.asarray(variance, dtype=np.float64)
            return found.ravel() if found.size == 1 else found.ravel()[self.order]

        single = pixels(expected.quantum_variance_DN2) * _lag_loss(expected) + pixels(expected.white_variance_DN2)
        noise = 2.0 * (single + expected.row_variance_DN2 + expected.column_variance_DN2)
        steps = np.diff(self.courses, axis=1)
        total = 0.0
        for start in range(0, steps.shape[1], PIECE_FRAMES):
            squares = (self.there.T @ steps[:, start : start + PIECE_FRAMES]) ** 2
            second, fourth = squares.mean(axis=1), (squares**2).mean(axis=1)
            whole = np.maximum(noise + second, LEAST_NOISE_DN2)
            ratio = 3.0 + (fourth - 3.0 * second**2) / whole**2
            # what moves is no chance: a pixel's own variance is known better than that of noise alone
            share = 3.0 / min(steps.shape[1], PIECE_FRAMES)
            ratio *= (1.0 + share) / (1.0 + share * (1.0 - (second / whole) ** 2))
            total += float(ratio.mean() - 3.0) * squares.shape[1]
        return float(total / steps.shape[1])

    def rows(self) -> float:
        """Variance of rows' means, DN^2."""
        return float(np.sum(self.steps * self.lines[0])) if self.lines else 0.0

    def columns(self) -> float:
        """Variance of columns' means, DN^2."""
        return float(np.sum(self.steps * self.lines[1])) if self.lines else 0.0

    def lasting(self, step: int) -> float:
        """Mean product of a pixel's deviations `step` frames apart, DN^2."""
        if not self.products:
            return 0.0
        early, late = self.courses[:, :-step], self.courses[:, step:]
        return float(np.sum(early @ late.T / early.shape[1] * self.products[0]))


_STILL = _MovingPicture((), (), np.zeros((0, 0)), np.zeros((0, 1)), np.zeros(0, np.intp), np.zeros((0, 0)))


def _mean_product(images: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean products (image, image) of images (image, pixel)."""
    return np.asarray(images @ images.T / max(images.shape[1], 1))


def frame_profile(expected: ExpectedSeries, areas: Areas) -> NDArray[np.float64]:
    """Change of the mean over good pixels from frame to frame (n,), DN, mean 0 as the model defines it."""
    profile = np.zeros(expected.frames)
    for image, course in expected.trend_DN or ():
        profile = profile + areas.mean(image) * np.asarray(course, dtype=np.float64)
    return profile


def _afterglow_bins(frames: int) -> list[tuple[int, int]]:
    bins = []
    for start, stop in pairwise(_AFTERGLOW_EDGES):
        if start >= frames:
            break
        bins.append((start, min(stop, frames)))
    return bins


def measured_scalars(
    summary: SeriesSummary,
    base: ExpectedSeries,
    context: ScalarContext,
    *,
    dark_mean_DN: float,
    pattern: Pattern | None,
    outliers: int | None,
    all_outliers: int,
    memory: tuple[float, int] | None,
) -> list[Scalar]:
    """The scalar probes of measured frames with their standard deviations (sampling and floor together).

    outliers, all_outliers: pixels that stand out in this series, and in any. memory: share of such pixels' variance that lasts
    from frame to frame, and how many they are.
    """
    result: list[Scalar] = []
    good = context.good
    n_good = context.areas.order.size
    rows, columns = good.shape
    frames = summary.frames

    def add(axis: str, name: str, unit: str, value: float, sampling: float, floor: str) -> None:
        if math.isfinite(value) and math.isfinite(sampling):
            sd = math.hypot(sampling, FLOORS[floor])
            result.append(Scalar(axis=axis, name=name, unit=unit, value=value, sd=sd, sampling_sd=sampling))

    mean_q, label_q = context.areas.means(base.quantum_variance_DN2)
    mean_w, label_w = context.areas.means(base.white_variance_DN2)
    # a picture that fades without any noise says how fast it fades, which the afterglow's levels say without a law's errors
    noisy = context.kind != "afterglow" or mean_q + mean_w > LEAST_NOISE_DN2
    if frames > 2 and noisy:
        freedom = 2.0 * (frames - 1) ** 2 / (3.0 * frames - 4.0)
        for label, name in enumerate(context.label_names):
            variance = float(summary.label_variance_DN2[label])
            pixels = int(summary.label_pixels[label])
            if not variance > 0 or pixels < 16:
                continue
            q, w = float(label_q[label]), float(label_w[label])
            share = q / max(q + w, 1e-12)
            shared = 1.0 + share**2 * (_squared_correlations(base) - 1.0)
            add(
                "noise",
                f"log_variance {name}",
                "1",
                math.log(max(variance, LEAST_NOISE_DN2)),
                math.sqrt(2.0 * shared / (freedom * pixels)),
                "log_variance",
            )
            for index, (dr, dc) in enumerate(LAGS):
                # pixels of a label that lies in stripes may have few neighbours
                pairs = int(summary.label_pairs[label, index])
                if pairs < _LEAST_PAIRS or variance < LEAST_NOISE_DN2:
                    continue
                add(
                    "texture",
                    f"correlation {name} ({dr},{dc})",
                    "1",
                    float(summary.label_autocovariance_DN2[label, index]) / variance,
                    math.sqrt(1.3 * shared / (freedom * pairs)),
                    "correlation",
                )
        total = float(np.mean(summary.pair_variance_DN2[good]))
        if total >= LEAST_NOISE_DN2:
            for axis_name, value, count, lines in (
                ("row_ratio", summary.row_variance_DN2, columns, rows),
                ("column_ratio", summary.column_variance_DN2, rows, columns),
            ):
                add(
                    "texture",
                    axis_name,
                    "1",
                    math.log(max(value * count / total, 1e-12)),
                    math.sqrt(3.0 / (freedom * lines)),
                    axis_name,
                )
            blocks = n_good / BLOCK_PX**2
            if summary.block_variance_DN2 > 0:
                add(
                    "texture",
                    "block_ratio",
                    "1",
                    math.log(summary.block_variance_DN2 * BLOCK_PX**2 / total),
                    math.sqrt(2.5 / (freedom * blocks)),
                    "block_ratio",
                )
            if frames > 5:
                q_share = mean_q / max(mean_q + mean_w, 1e-12)
                shared = 1.0 + q_share**2 * (_squared_correlations(base) - 1.0)
                stack = float(np.mean(summary.stack_variance_DN2[good]))
                for step in (1, 2):
                    add(
                        "time",
                        f"temporal_correlation {step}",
                        "1",
                        float(summary.temporal_covariance_DN2[step - 1]) / stack,
                        math.sqrt(shared / (n_good * (frames - step))),
                        "temporal_correlation",
                    )
            if frames >= _KURTOSIS_FRAMES:
                add(
                    "tails",
                    "kurtosis",
                    "1",
                    summary.kurtosis_excess,
                    math.sqrt(40.0 / (n_good * freedom)),
                    "kurtosis",
                )
            if context.kind in ("flat", "object") and freedom >= _LEAST_FREEDOM:
                value, sampling = _log_variance_of_steps(summary.frame_mean_DN, freedom)
                add("time", "frame_factor", "1", value, sampling, "frame_factor")
    profiles = time_templates(frames)
    if profiles and context.kind != "afterglow":
        steps = np.diff(summary.frame_mean_DN)
        noise = math.sqrt(max(float(np.mean(steps**2)) / 2.0, 1e-12))
        scale = 1.0 if context.kind == "dark" else 1.0 / context.reference_signal_DN
        for name, template in profiles:
            add(
                "time",
                f"trend {name}",
                "DN" if context.kind == "dark" else "1",
                float(summary.frame_mean_DN @ template) * scale / math.sqrt(frames),
                noise * scale / math.sqrt(frames),
                "dark_trend_DN" if context.kind == "dark" else "trend",
            )
    if context.kind == "afterglow" and context.previous_signal_DN:
        white_sd = math.sqrt(mean_w / n_good)
        for start, stop in _afterglow_bins(frames):
            level = float(summary.frame_mean_DN[start:stop].mean()) - dark_mean_DN
            add(
                "time",
                f"afterglow frames {start}-{stop - 1}",
                "1",
                level / context.previous_signal_DN,
                math.hypot(white_sd / math.sqrt(stop - start), 0.02) / context.previous_signal_DN,
                "afterglow",
            )
    if context.codes_usable and summary.distinct_codes > 1:
        step_DN = (summary.code_range - 1) / (summary.distinct_codes - 1)
        codes = Scalar(
            axis="tails", name="codes", unit="DN", value=step_DN, sd=FLOORS["codes"] * step_DN, sampling_sd=0.0
        )
        result.append(codes)
    if pattern is not None and not context.calibrates:
        # in units of the noise: a pattern's rms, which is what a strength means
        expected, least = context.pattern_noise, LEAST_NOISE_DN2 / frames
        for name, found_DN2, noise_DN2, pixels in (
            ("fixed_pattern", pattern.pixel_DN2, expected.pixel_DN2, 1),
            ("fixed_pattern blocks", pattern.blocks_DN2, expected.blocks_DN2, BLOCK_PX**2),
        ):
            if found_DN2 is not None and noise_DN2 is not None:
                value = math.sqrt(max(found_DN2, least / pixels) / noise_DN2)
                sampling = value * math.sqrt(0.75 * pixels / n_good)
                sd = math.hypot(sampling, value * FLOORS[name])
                result.append(Scalar(axis="position", name=name, unit="sd", value=value, sd=sd, sampling_sd=sampling))
        # lines may stand out a hundredfold: logarithms; second differences share lines
        for name, found_DN2, noise_DN2, lines, pixels in (
            (FIXED_ROWS, pattern.rows_DN2, expected.rows_DN2, rows, columns),
            (FIXED_COLUMNS, pattern.columns_DN2, expected.columns_DN2, columns, rows),
        ):
            if found_DN2 is not None and noise_DN2 is not None:
                value = 0.5 * math.log(max(found_DN2, least / pixels) / noise_DN2)
                add("position", name, "1", value, 1.0 / math.sqrt(lines), "fixed_pattern lines")
    if outliers is not None and not context.calibrates:
        add("tails", OUTLIERS, "sqrt(pixels)", math.sqrt(outliers + 0.375), 0.5, "outliers")
        if memory is not None and memory[1] >= _LEAST_OUTLIERS and frames >= _LEAST_FRAMES:
            share, count = memory
            add("tails", "memory of outliers", "1", share, math.sqrt(1.6 / (frames * count)), "memory of outliers")
    if context.counts_all_outliers:
        counted = math.sqrt(all_outliers + 0.375)
        add("tails", OUTLIERS_ANYWHERE, "sqrt(pixels)", counted, 0.5, "outliers")
    return result


def _log_variance_of_steps(values: NDArray[np.float64], freedom: float) -> tuple[float, float]:
    """Logarithm of the variance that steps from value to value (n,) show, free of what few of them make too low; its sd."""
    from scipy.special import polygamma

    variance = float(np.mean(np.diff(values) ** 2)) / 2.0
    bias = float(polygamma(0, freedom / 2.0)) - math.log(freedom / 2.0)
    return math.log(max(variance, 1e-12)) - bias, math.sqrt(float(polygamma(1, freedom / 2.0)))


def _squared_correlations(expected: ExpectedSeries) -> float:
    table = np.asarray(expected.noise_autocovariance, dtype=np.float64) ** 2
    return float(table[0, 0] + 2.0 * table[0, 1:].sum() + 2.0 * table[1:, 0].sum() + 4.0 * table[1:, 1:].sum())


class MapProjection:
    """Projection of residual maps onto templates that are made orthogonal in their order; unit noise.

    q = T^T W r; Cov q = T^T W C W T = L L^T (Cholesky in the templates' order, dependent ones dropped); y = L^-1 q.
    """

    def __init__(
        self,
        templates: Sequence[Template],
        *,
        mask: NDArray[np.bool_],
        quantum_DN2: NDArray[np.floating],
        white_DN2: NDArray[np.floating],
        autocovariance_table: NDArray[np.floating],
        tolerance: float = 1e-3,
    ) -> None:
        """`quantum_DN2`, `white_DN2` (row, column): variances of the mean frame's correlated and white parts."""
        weight = np.where(mask, 1.0 / np.maximum(np.asarray(quantum_DN2 + white_DN2, dtype=np.float64), 1e-30), 0.0)
        # a template counts by its shape: single precision is a ten-thousandth of what is left of one that is kept
        maps = (np.sqrt(weight), np.sqrt(np.maximum(quantum_DN2, 0.0)), white_DN2)
        sharper, root, white = (np.ascontiguousarray(one, dtype=np.float32) for one in maps)
        kernels = _separated(np.asarray(autocovariance_table, dtype=np.float64))
        used: list[Template] = []
        rows, spread = (np.empty((len(templates), *mask.shape), np.float32) for _ in range(2))
        for template in templates:
            # rows are 0 outside the mask, as the weights are
            image = np.ascontiguousarray(template.image, dtype=np.float32)
            norm = weigh_template(image, sharper, root, white, *kernels, rows[len(used)], spread[len(used)])
            if norm > _LEAST_NORM and math.isfinite(norm):
                used.append(template)
        rows, spread = (one[: len(used)].reshape(len(used), mask.size) for one in (rows, spread))
        left = np.asarray(rows @ spread.T, dtype=np.float64)
        own = np.diag(left).copy()
        chosen: list[int] = []
        columns: list[NDArray[np.float64]] = []
        for number in range(len(used)):
            rest = float(left[number, number])
            if rest > tolerance * own[number]:
                chosen.append(number)
                columns.append(left[number] / math.sqrt(rest))
                left -= np.outer(columns[-1], columns[-1])
        # the images are not kept: fifty a series would be most of the memory
        self._names = tuple(
            ProbeName(axis=item.axis, statistic="mean frame", location=item.name, unit=item.unit)
            for item in (used[number] for number in chosen)
        )
        # (probe, pixel), 0 outside the mask: so maps are taken as they are
        self._shape = mask.shape
        self._rows = np.zeros((len(chosen), mask.size), np.float32)
        if chosen:
            from scipy.linalg import solve_triangular

            lower = np.tril(np.stack(columns, axis=1)[chosen])
            inverse = solve_triangular(lower, np.eye(len(chosen)), lower=True, check_finite=False)
            np.matmul(inverse.astype(np.float32), rows[chosen], out=self._rows)
        self.of_level = self._rows.sum(axis=1, dtype=np.float64)  # (probe,) of 1 DN in every pixel

    def __len__(self) -> int:
        return len(self._names)

    def apply(self, images: NDArray[np.floating]) -> NDArray[np.float64]:
        """Standardised projections (..., probe) of maps (..., row, column), DN."""
        pixels = images.reshape(*images.shape[:-2], -1).astype(np.float32, copy=False)
        return np.asarray(pixels @ self._rows.T, dtype=np.float64)

    def apply_each(self, images: Sequence[NDArray[np.floating]]) -> NDArray[np.float64]:
        """Standardised projections (image, probe) of maps, (row, column) or (1, 1) where all pixels are alike, DN."""
        result = np.empty((len(images), len(self)))
        wide = [number for number, image in enumerate(images) if image.size > 1]
        for number, image in enumerate(images):
            if image.size == 1:
                result[number] = float(image.flat[0]) * self.of_level
        if wide:
            result[wide] = self.apply(np.stack([images[number] for number in wide]))
        return result

    def pixel_noise(self, sd_DN: NDArray[np.floating]) -> NDArray[np.float64]:
        """Variance (probe,) that independent noise of the pixels, sd_DN (row, column), gives the projections."""
        variance = np.asarray(sd_DN, dtype=np.float32).ravel() ** 2
        return np.array([np.square(row) @ variance for row in self._rows], dtype=np.float64)

    def line_noise(self) -> NDArray[np.float64]:
        """Variance (2, probe) that noise of 1 DN, common to each row and then common to each column, gives the projections."""
        pixels = self._rows.reshape(len(self), *self._shape)
        return np.stack([np.sum(pixels.sum(axis=axis, dtype=np.float64) ** 2, axis=1) for axis in (2, 1)])

    def names(self) -> list[ProbeName]:
        """One name a probe."""
        return list(self._names)


def _separated(table: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Kernels (part, tap) along rows and along columns whose products add up to an autocovariance, a quarter of each as of the table.

    A spread that no effect has changed is one such product.
    """
    across, sizes, along = np.linalg.svd(table)
    parts = np.flatnonzero(sizes > 1e-12 * sizes[0])
    halves = (across[:, parts] * sizes[parts]).T, along[parts]
    rows, columns = (half.astype(np.float32) for half in halves)
    return rows, columns


def smooth_templates(signal_DN: NDArray[np.floating], mask: NDArray[np.bool_], *, kind: str) -> list[Template]:
    """Level, gradients and curvatures across the field, relative to the signal (darks: in DN)."""
    rows, columns = mask.shape
    y = np.linspace(-1.0, 1.0, rows)[:, None]
    x = np.linspace(-1.0, 1.0, columns)[None, :]
    base = np.ones(mask.shape) if kind in ("dark", "afterglow") else np.asarray(signal_DN, dtype=np.float64)
    unit = "DN" if kind in ("dark", "afterglow") else "1"
    shapes = [
        ("level", "whole field", np.ones(mask.shape)),
        ("position", "along columns", x + 0 * y),
        ("position", "along rows", y + 0 * x),
        ("position", "curved along columns", x**2 + 0 * y),
        ("position", "curved along rows", y**2 + 0 * x),
        ("position", "diagonal", x * y),
        ("position", "cubic along columns", x**3 + 0 * y),
        ("position", "cubic along rows", y**3 + 0 * x),
    ]
    result = [Template(axis=axis, name=name, unit=unit, image=base * shape) for axis, name, shape in shapes]
    # left half against right, upper against lower quarter: seams of tiles and panels
    for count, axis_name in ((2, "halves"), (4, "quarters")):
        for direction in (0, 1):
            index = (np.arange(mask.shape[direction]) * count // mask.shape[direction]) % 2
            step = np.where(index == 0, 1.0, -1.0)
            step_map = step[:, None] * np.ones(mask.shape) if direction == 0 else step[None, :] * np.ones(mask.shape)
            result.append(
                Template(
                    axis="position",
                    name=f"{axis_name} along {'rows' if direction == 0 else 'columns'}",
                    unit=unit,
                    image=base * step_map,
                )
            )
    return result


def transmission_templates(
    signal_DN: NDArray[np.floating], open_DN: NDArray[np.floating], mask: NDArray[np.bool_], *, bins: int = 6
) -> list[Template]:
    """Bins of transmission: the signal where -log T lies in each, relative; the open field apart."""
    log_t = -np.log(np.clip(np.asarray(signal_DN / np.maximum(open_DN, 1e-12), dtype=np.float64), 1e-9, None))
    covered = mask & (log_t > 0.02)
    result = [
        Template(axis="level", name="open field", unit="1", image=np.where(mask & ~covered, signal_DN, 0.0)),
    ]
    if covered.sum() < 64:
        return result
    # behind 6 and more nothing of the primary is left to speak of: one bin, in DN of the open field
    shadow = covered & (log_t > 6.0)
    if shadow.sum() >= 32:
        result.append(
            Template(
                axis="level",
                name="shadow, -log T above 6",
                unit="1",
                image=np.where(shadow, np.asarray(open_DN, dtype=np.float64), 0.0),
            )
        )
    lit = covered & ~shadow
    if lit.sum() < 64:
        return result
    edges = np.unique(np.quantile(log_t[lit], np.linspace(0, 1, bins + 1)))
    for low, high in pairwise(edges):
        inside = lit & (log_t >= low) & (log_t <= high)
        if inside.sum() >= 32:
            result.append(
                Template(
                    axis="level",
                    name=f"-log T {low:.2f}-{high:.2f}",
                    unit="1",
                    image=np.where(inside, signal_DN, 0.0),
                )
            )
    return result


def edge_templates(signal_DN: NDArray[np.floating]) -> list[Template]:
    """Displacement, blur along each direction at three scales, ringing, and tails of several lengths."""
    from scipy.ndimage import gaussian_filter, gaussian_filter1d

    image = np.asarray(signal_DN, dtype=np.float64)
    dy, dx = gradient(image)
    rows, columns = image.shape
    y = (np.arange(rows) - (rows - 1) / 2)[:, None] / rows
    x = (np.arange(columns) - (columns - 1) / 2)[None, :] / columns
    result = [
        Template(axis="sharpness", name="shift along columns", unit="px", image=dx),
        Template(axis="sharpness", name="shift along rows", unit="px", image=dy),
        Template(axis="sharpness", name="magnification", unit="1", image=x * dx + y * dy),
        Template(axis="sharpness", name="rotation", unit="rad", image=x * dy - y * dx),
    ]
    for sigma in (0.6, 1.5, 4.0):
        for axis, name in ((1, "columns"), (0, "rows")):
            blurred = gaussian_filter1d(image, sigma, axis=axis, mode="nearest")
            result.append(
                Template(axis="sharpness", name=f"blur of {sigma:g} px along {name}", unit="1", image=blurred - image)
            )
    for sigma in (8.0, 20.0):
        if sigma < 0.4 * min(image.shape):
            result.append(
                Template(
                    axis="sharpness",
                    name=f"tail of {sigma:g} px",
                    unit="1",
                    image=gaussian_filter(image, sigma, mode="nearest") - image,
                )
            )
    return result
