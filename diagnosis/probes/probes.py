"""Probes of one series: numbers with known noise, each tied to an axis, that frames and forward model both give.

Two families. *Map probes* are projections of the mean frame's residual on a set of templates: smooth shapes, bins of
transmission, derivatives at edges, long tails, and what each effect and nuisance would do there. They are made
orthogonal one after the other under the noise's own covariance, so that each has unit variance, is independent of the
others and bears the name of the template that it adds. *Scalar probes* are noise by level, correlation between neighbours and
frames, lines, blocks, the common factor, codes, fixed pattern and outliers.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

FIXED, FIXED_BLOCKS = "fixed_pattern", "fixed_pattern blocks"
FIXED_ROWS, FIXED_COLUMNS = "fixed_pattern rows", "fixed_pattern columns"
OUTLIERS, OUTLIERS_ANYWHERE = "outliers", "outliers in any series"
REPEATED_FRAMES = "repeated frames"
LASTING = "lasting pixels"
ALONG_ROWS, ALONG_COLUMNS = "displacement along rows", "displacement along columns"  # of a scene
PATTERN_PIXEL_SHARE = 0.9  # of a fixed pattern's variance that neighbours differ by
COUNT_SD = 0.5  # of `root_of_count`
# what repeats of the same measurement show beyond counting noise; standard deviations of the probe's own unit
FLOORS: Mapping[str, float] = {
    "log_variance": 0.004,
    "correlation": 0.002,  # of neighbours, and of frames
    "means": 0.03,  # over rows, columns and blocks
    "kurtosis": 0.02,
    "frame_factor": 0.15,
    "trend": 0.0002,  # two of the 16 octaves of an output with 1/f noise of 0.05 %
    "dark_trend_DN": 0.09,  # two of the 16 octaves of a dark with 1/f noise of 0.25 DN
    "afterglow": 2e-5,
    "codes": 0.03,
    "fixed_pattern": 0.025,  # of the value, as for its blocks
    "fixed_pattern blocks": 0.5,  # a pattern's grain is its own: white in the model, coarser in some panels
    "fixed_pattern lines": 0.1,
    "pixels": 0.3,  # that stand out, or whose level lasts
    "memory of outliers": 0.02,
    "repeated frames": 0.0,
}


def root_of_count(count: float) -> float:
    """A count of rare events as a number whose standard deviation is COUNT_SD, whatever is expected.

    Source: Anscombe (1948), doi:10.1093/biomet/35.3-4.246.
    """
    return math.sqrt(count + 0.375)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scalar:
    """A scalar probe."""

    axis: str
    name: str
    unit: str
    value: float
    sd: float  # of the value
    sampling_sd: float  # the counting noise's part of it
    label: str = ""  # of the pixels, where it is noise of these (`noise_name`)
    lag: tuple[int, int] | None = None  # of a correlation


def noise_name(label: str, lag: tuple[int, int] | None = None) -> str:
    """Name of the probe of the variance of pixels of a label, or of their correlation with neighbours at a lag."""
    return f"log_variance {label}" if lag is None else f"correlation {label} ({lag[0]},{lag[1]})"


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeName:
    """What a probe is called: axis, statistic, location (where within the series), unit."""

    axis: str
    statistic: str
    location: str
    unit: str
