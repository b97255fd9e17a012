"""Scalar probes of measured frames, with their standard deviations."""

import math
from dataclasses import dataclass, field

import numpy as np

from ...generator.frames.line_model import ExpectedSeries
from ..arrays import FloatArray
from ..session.summaries import BLOCK_PX, LAGS, LEAST_NOISE_DN2, SeriesSummary
from .fixed_pattern import Pattern
from .lasting import LEAST_FRAMES
from .noise_tails import enough_quanta
from .probes import (
    COUNT_SD,
    FIXED,
    FIXED_BLOCKS,
    FIXED_COLUMNS,
    FIXED_ROWS,
    FLOORS,
    LASTING,
    OUTLIERS,
    OUTLIERS_ANYWHERE,
    REPEATED_FRAMES,
    Scalar,
    noise_name,
    root_of_count,
)
from .scalar_context import ScalarContext, afterglow_bins, time_templates

_LEAST_FREEDOM = 5.0  # of a variance whose logarithm is still near enough a Gaussian number
_LEAST_OUTLIERS, _LEAST_FRAMES = 5, 6  # pixels, and frames of each, that show what lasts from frame to frame
_LEAST_PAIRS = 64  # of neighbours whose correlation is nearly a Gaussian number
_KURTOSIS_FRAMES = 15  # below, each pixel's own variance is too uncertain to standardise by


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
    copies: int,
    lasting: int,
) -> list[Scalar]:
    """The scalar probes of measured frames with their standard deviations (sampling and floor together).

    base: as the base twin expects the series; dark_mean_DN: of the dark that an afterglow is judged against; pattern: of the
    corrected mean frame, None: none was looked for; outliers, all_outliers: pixels that stand out in this series (None: not looked
    for), and in any; memory: share of such pixels' variance that lasts, and how many they are; copies: frames of all series that
    this one stands for, which are copies of earlier ones; lasting: pixels whose level lasts in a later dark.
    """
    found = _Found(summary=summary, base=base, context=context)
    if summary.frames > 2 and found.noisy:
        found.noise_by_label()
        found.lines_blocks_and_times()
    found.trends()
    found.afterglow(dark_mean_DN)
    found.codes()
    if pattern is not None:
        found.fixed_pattern(pattern)
    if outliers is not None:
        found.add("tails", OUTLIERS, "sqrt(pixels)", root_of_count(outliers), COUNT_SD, "pixels")
        if memory is not None and memory[1] >= _LEAST_OUTLIERS and summary.frames >= _LEAST_FRAMES:
            share, count = memory
            sampling = math.sqrt(1.6 / (summary.frames * count))
            found.add("tails", "memory of outliers", "1", share, sampling, "memory of outliers")
    if context.repeatable:
        # a line without fault repeats none: counted as if it might now and then
        found.add("time", REPEATED_FRAMES, "sqrt(frames)", root_of_count(copies), COUNT_SD, "repeated frames")
    if context.counts_all_outliers:
        if any(frames >= LEAST_FRAMES for frames, _ in context.later_darks):
            found.add("tails", LASTING, "sqrt(pixels)", root_of_count(lasting), COUNT_SD, "pixels")
        found.add("tails", OUTLIERS_ANYWHERE, "sqrt(pixels)", root_of_count(all_outliers), COUNT_SD, "pixels")
    return found.scalars


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """Scalar probes of one series, gathered family by family; fields as in `measured_scalars`."""

    summary: SeriesSummary
    base: ExpectedSeries
    context: ScalarContext
    scalars: list[Scalar] = field(default_factory=list)

    def add(
        self,
        axis: str,
        name: str,
        unit: str,
        value: float,
        sampling: float,
        floor: str,
        *,
        of: float = 1.0,
        label: str = "",
        lag: tuple[int, int] | None = None,
    ) -> None:
        """One more, unless it is no number; floor: one of FLOORS, a share of `of`; label and lag: as in `Scalar`."""
        if math.isfinite(value) and math.isfinite(sampling):
            value, sampling = float(value), float(sampling)
            sd = math.hypot(sampling, FLOORS[floor] * float(of))
            self.scalars.append(
                Scalar(axis=axis, name=name, unit=unit, value=value, sd=sd, sampling_sd=sampling, label=label, lag=lag)
            )

    @property
    def n_good(self) -> int:
        """Good pixels."""
        return int(self.context.areas.order.size)

    @property
    def freedom(self) -> float:
        """Degrees of freedom of a pixel's variance from steps between frames."""
        frames = self.summary.frames
        return 2.0 * (frames - 1) ** 2 / (3.0 * frames - 4.0)

    @property
    def means_DN2(self) -> tuple[float, float]:
        """Mean quantum and white variance of the base model."""
        areas = self.context.areas
        return areas.means(self.base.quantum_variance_DN2)[0], areas.means(self.base.white_variance_DN2)[0]

    @property
    def noisy(self) -> bool:
        """Whether frames have noise of their own: rounded ones and pictures that fade without noise have none."""
        if self.context.rounded:
            return False
        return self.context.kind != "afterglow" or sum(self.means_DN2) > LEAST_NOISE_DN2

    def shared(self, quantum_DN2: float, white_DN2: float) -> float:
        """Times that correlated neighbours raise the variance of a variance."""
        share = quantum_DN2 / max(quantum_DN2 + white_DN2, 1e-12)
        table = np.asarray(self.base.noise_autocovariance, dtype=np.float64) ** 2
        squares = float(table[0, 0] + 2.0 * table[0, 1:].sum() + 2.0 * table[1:, 0].sum() + 4.0 * table[1:, 1:].sum())
        return 1.0 + share**2 * (squares - 1.0)

    def noise_by_label(self) -> None:
        """Variance, and correlation of neighbours, of each label's pixels."""
        summary, areas = self.summary, self.context.areas
        label_q, label_w = areas.means(self.base.quantum_variance_DN2)[1], areas.means(self.base.white_variance_DN2)[1]
        for label, name in enumerate(self.context.label_names):
            variance = float(summary.label_variance_DN2[label])
            pixels = int(summary.label_pixels[label])
            if not variance > 0 or pixels < 16:
                continue
            shared = self.shared(float(label_q[label]), float(label_w[label]))
            value = math.log(max(variance, LEAST_NOISE_DN2))
            sampling = math.sqrt(2.0 * shared / (self.freedom * pixels))
            self.add("noise", noise_name(name), "1", value, sampling, "log_variance", label=name)
            for index, lag in enumerate(LAGS):
                # pixels of a label that lies in stripes may have few neighbours
                pairs = int(summary.label_pairs[label, index])
                if pairs < _LEAST_PAIRS or variance < LEAST_NOISE_DN2:
                    continue
                value = float(summary.label_autocovariance_DN2[label, index]) / variance
                sampling = math.sqrt(1.3 * shared / (self.freedom * pairs))
                known = noise_name(name, lag)
                self.add("texture", known, "1", value, sampling, "correlation", label=name, lag=lag)

    def lines_blocks_and_times(self) -> None:
        """Noise of rows, columns and blocks, from frame to frame, of the whole frame; its tails."""
        summary, context = self.summary, self.context
        rows, columns = context.good.shape
        frames, freedom = summary.frames, self.freedom
        total = float(np.mean(summary.pair_variance_DN2[context.good]))
        if total < LEAST_NOISE_DN2:
            return
        for name, variance, count, lines in (
            ("row_ratio", summary.row_variance_DN2, columns, rows),
            ("column_ratio", summary.column_variance_DN2, rows, columns),
        ):
            value = math.log(max(variance * count / total, 1e-12))
            self.add("texture", name, "1", value, math.sqrt(3.0 / (freedom * lines)), "means")
        if summary.block_variance_DN2 > 0:
            value = math.log(summary.block_variance_DN2 * BLOCK_PX**2 / total)
            sampling = math.sqrt(2.5 / (freedom * self.n_good / BLOCK_PX**2))
            self.add("texture", "block_ratio", "1", value, sampling, "means")
        if frames > 5:
            shared = self.shared(*self.means_DN2)
            stack = float(np.mean(summary.stack_variance_DN2[context.good]))
            for step in (1, 2):
                value = float(summary.temporal_covariance_DN2[step - 1]) / stack
                sampling = math.sqrt(shared / (self.n_good * (frames - step)))
                self.add("time", f"temporal_correlation {step}", "1", value, sampling, "correlation")
        if frames >= _KURTOSIS_FRAMES and enough_quanta(self.base, context.areas, summary):
            sampling = math.sqrt(40.0 / (self.n_good * freedom))
            self.add("tails", "kurtosis", "1", summary.kurtosis_excess, sampling, "kurtosis")
        if context.kind in ("flat", "object") and freedom >= _LEAST_FREEDOM:
            value, sampling = _log_variance_of_steps(summary.frame_mean_DN, freedom)
            self.add("time", "frame_factor", "1", value, sampling, "frame_factor")

    def trends(self) -> None:
        """Course of the mean over the frames."""
        means_DN, kind = self.summary.frame_mean_DN, self.context.kind
        profiles = time_templates(self.summary.frames)
        if not profiles or kind == "afterglow":
            return
        noise = math.sqrt(max(float(np.mean(np.diff(means_DN) ** 2)) / 2.0, 1e-12))
        scale = 1.0 if kind == "dark" else 1.0 / self.context.reference_signal_DN
        scale /= math.sqrt(self.summary.frames)
        unit, floor = ("DN", "dark_trend_DN") if kind == "dark" else ("1", "trend")
        for name, template in profiles:
            self.add("time", f"trend {name}", unit, float(means_DN @ template) * scale, noise * scale, floor)

    def afterglow(self, dark_mean_DN: float) -> None:
        """Level of frames after an exposure, over the exposure's."""
        previous_DN = self.context.previous_signal_DN
        if self.context.kind != "afterglow" or not previous_DN:
            return
        white_sd = math.sqrt(self.means_DN2[1] / self.n_good)
        for start, stop in afterglow_bins(self.summary.frames):
            level = float(self.summary.frame_mean_DN[start:stop].mean()) - dark_mean_DN
            sampling = math.hypot(white_sd / math.sqrt(stop - start), 0.02) / previous_DN
            self.add("time", f"afterglow frames {start}-{stop - 1}", "1", level / previous_DN, sampling, "afterglow")

    def codes(self) -> None:
        """Distance of the numbers that occur."""
        if self.context.codes_usable and self.summary.distinct_codes > 1:
            step_DN = (self.summary.code_range - 1) / (self.summary.distinct_codes - 1)
            self.add("tails", "codes", "DN", step_DN, 0.0, "codes", of=step_DN)

    def fixed_pattern(self, pattern: Pattern) -> None:
        """What stands in the mean frame, in units of what noise leaves there: a pattern's rms, which is what a strength means."""
        rows, columns = self.context.good.shape
        pixels = np.array([1, BLOCK_PX**2, columns, rows])  # whose mean it is
        least_DN2 = LEAST_NOISE_DN2 / self.summary.frames / pixels
        ratios = np.maximum(pattern, least_DN2) / self.context.pattern_noise
        for name, value, count in zip((FIXED, FIXED_BLOCKS), np.sqrt(ratios[:2]), pixels[:2], strict=True):
            sampling = value * math.sqrt(0.75 * count / self.n_good)
            self.add("position", name, "sd", value, sampling, name, of=value)
        # lines may stand out a hundredfold: logarithms; second differences share lines
        for name, value, lines in zip(
            (FIXED_ROWS, FIXED_COLUMNS), 0.5 * np.log(ratios[2:]), (rows, columns), strict=True
        ):
            self.add("position", name, "1", value, 1.0 / math.sqrt(lines), "fixed_pattern lines")


def _log_variance_of_steps(values: FloatArray, freedom: float) -> tuple[float, float]:
    """Logarithm of the variance that steps from value to value (n,) show, free of what few of them make too low; its sd."""
    from scipy.special import polygamma

    variance = float(np.mean(np.diff(values) ** 2)) / 2.0
    bias = float(polygamma(0, freedom / 2.0)) - math.log(freedom / 2.0)
    return math.log(max(variance, 1e-12)) - bias, math.sqrt(float(polygamma(1, freedom / 2.0)))
