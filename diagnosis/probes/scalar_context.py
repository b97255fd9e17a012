"""What the scalar probes of a series refer to: pixels by label, times, and the base model's numbers."""

import math
import sys
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...generator.frames.line_model import ExpectedSeries
from ..arrays import BoolArray, FloatArray, IndexArray, RealArray
from .fixed_pattern import Pattern

# frames after the exposure: the first alone, then octaves
_AFTERGLOW_EDGES = (0, 1, *(1 + 2**octave for octave in range(8)), sys.maxsize)


@dataclass(frozen=True, slots=True)
class Areas:
    """The good pixels of a frame, those of one label together."""

    order: IndexArray  # (pixel,): flat indices, those without label first
    parts: tuple[slice, ...]  # where each label's lie in it
    # the last maps of which means were taken, and these
    known: list[tuple[RealArray, tuple[float, FloatArray]]] = field(default_factory=list)

    @staticmethod
    def of(good: BoolArray, labels: NDArray[np.int64], count: int) -> "Areas":
        """Of good pixels (row, column) and their labels from 0 to `count`; other labels are none."""
        inside = np.flatnonzero(good)
        own = labels.ravel()[inside]
        own = np.where((own >= 0) & (own < count), own, -1)
        ends = np.searchsorted(np.sort(own), np.arange(count + 1))
        order = inside[np.argsort(own, kind="stable")]
        return Areas(order, tuple(slice(int(start), int(stop)) for start, stop in pairwise(ends)))

    def means(self, image: RealArray) -> tuple[float, FloatArray]:
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

    def pixels(self, image: RealArray) -> RealArray:
        """A map (row, column) at the good pixels (pixel,); one of a single value as it is (1,)."""
        flat = image.ravel()
        return flat if flat.size == 1 else flat[self.order]

    def mean(self, image: RealArray | float) -> float:
        """Mean of a map over all good pixels."""
        whole = np.asarray(image)
        return float(whole.flat[0]) if whole.size == 1 else _mean(whole.ravel()[self.order])


def _mean(values: RealArray) -> float:
    """Mean of values, NaN of none."""
    return float(np.add.reduce(values)) / values.size if values.size else math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalarContext:
    """What scalar probes of a series refer to; the same for measured frames and forward model."""

    kind: str
    frames: int
    good: BoolArray  # (row, column)
    labels: NDArray[np.int64]  # (row, column)
    label_names: tuple[str, ...]
    reference_signal_DN: float  # mean signal of the base model; 1 for darks
    previous_signal_DN: float | None  # of the exposure before an afterglow
    calibrates: bool
    codes_usable: bool
    pattern_noise: Pattern  # what noise alone leaves of a pattern in the corrected mean frame
    quantum_DN2: float  # the base model's quantum variance of one frame
    dark_DN: float  # the base model's mean dark
    counts_all_outliers: bool  # it stands for all series, where pixels are counted that stand out anywhere
    rounded: bool = False  # to steps that the noise hardly reaches over
    gain: RealArray | None = None  # (row, column): of the panel's pixels in these frames; None: all are alike
    averaged: int = 1  # exposures in a frame
    whole_lines: bool = True  # good pixels fill rows and columns, so that noise of these is seen
    repeatable: int = 0  # frames of all series that this one stands for, which may be copies of others
    # frames, and exposures a frame, of all later darks, this one first, where these are asked for
    later_darks: tuple[tuple[int, int], ...] = ()
    stands_out_reads: float = math.inf  # read noises by which a pixel of a flat's mean departs that stands out
    areas: "Areas" = field(init=False)  # the good pixels label by label
    # (label,): mean square of the gains of a label's pixels over that of all good ones
    label_gain: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        areas = Areas.of(self.good, self.labels, len(self.label_names))
        label_gain = np.ones(len(self.label_names))
        if self.gain is not None:
            whole, parts = areas.means(np.asarray(self.gain, dtype=np.float64) ** 2)
            label_gain = np.where(parts > 0.0, parts, whole) / whole
        object.__setattr__(self, "areas", areas)
        object.__setattr__(self, "label_gain", label_gain)


@lru_cache(maxsize=64)
def time_templates(frames: int) -> list[tuple[str, FloatArray]]:
    """Orthonormal profiles over frames (n,), each free of the mean: early rise or fall, slow settling, linear trend."""
    if frames < 6:
        return []
    t = np.arange(frames, dtype=np.float64)
    result: list[tuple[str, FloatArray]] = []
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


def afterglow_bins(frames: int) -> list[tuple[int, int]]:
    """First frame of each bin of an afterglow and the one after its last: the later, the longer."""
    return [(start, min(stop, frames)) for start, stop in pairwise(_AFTERGLOW_EDGES) if start < frames]


def frame_profile(expected: ExpectedSeries, areas: Areas) -> FloatArray:
    """Change of the mean over good pixels from frame to frame (n,), DN, mean 0 as the model defines it."""
    courses = (areas.mean(image) * np.asarray(course, dtype=np.float64) for image, course in expected.trend_DN or ())
    return sum(courses, np.zeros(expected.frames))
