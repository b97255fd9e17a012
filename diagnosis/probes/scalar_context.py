"""What the scalar probes of a series refer to: pixels by label, times, and the base model's numbers."""

import math
import sys
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...generator.frames.line_model import ExpectedSeries
from .fixed_pattern import Pattern

# frames after the exposure: the first alone, then octaves
_AFTERGLOW_EDGES = (0, 1, *(1 + 2**octave for octave in range(8)), sys.maxsize)


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

    def pixels(self, image: NDArray[np.floating]) -> NDArray[np.floating]:
        """A map (row, column) at the good pixels (pixel,); one of a single value as it is (1,)."""
        flat = image.ravel()
        return flat if flat.size == 1 else flat[self.order]

    def mean(self, image: NDArray[np.floating] | float) -> float:
        """Mean of a map over all good pixels."""
        whole = np.asarray(image)
        return float(whole.flat[0]) if whole.size == 1 else _mean(whole.ravel()[self.order])


def _mean(values: NDArray[np.floating]) -> float:
    """Mean of values, NaN of none."""
    return float(np.add.reduce(values)) / values.size if values.size else math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalarContext:
    """What scalar probes of a series refer to; the same for measured frames and forward model.

    Fields: kind; frames; good (row, column); labels (row, column); label_names; reference_signal_DN: mean signal of the
    base model (1 for darks); previous_signal_DN: of the exposure before an afterglow; calibrates; codes_usable; rounded: to steps
    that the noise hardly reaches over; pattern_noise: what
    noise alone leaves of a pattern in the corrected mean frame; quantum_DN2: the base model's quantum variance of one frame;
    dark_DN: the base model's mean dark;
    counts_all_outliers: this series stands for all, where pixels are counted that stand out anywhere; gain (row, column):
    of the panel's pixels in these frames, None where all are alike; averaged: exposures in a frame; whole_lines: good pixels fill
    rows and columns, so that noise of these is seen; repeatable: frames of all series that this one stands for, which may be copies
    of others; later_darks: frames, and exposures a frame, of all later darks, this one first if it is one, where pixels that stand
    out of darks are counted; stands_out_reads: read noises by which a pixel of a flat's mean departs that stands out; areas: the good
    pixels label by label; label_gain (label,): mean square of the gains of a label's pixels over that of all good ones.
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
    rounded: bool = False
    gain: NDArray[np.floating] | None = None
    averaged: int = 1
    whole_lines: bool = True
    repeatable: int = 0
    later_darks: tuple[tuple[int, int], ...] = ()
    stands_out_reads: float = math.inf
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


def afterglow_bins(frames: int) -> list[tuple[int, int]]:
    """First frame of each bin of an afterglow and the one after its last: the later, the longer."""
    return [(start, min(stop, frames)) for start, stop in pairwise(_AFTERGLOW_EDGES) if start < frames]


def frame_profile(expected: ExpectedSeries, areas: Areas) -> NDArray[np.float64]:
    """Change of the mean over good pixels from frame to frame (n,), DN, mean 0 as the model defines it."""
    profile = np.zeros(expected.frames)
    for image, course in expected.trend_DN or ():
        profile = profile + areas.mean(image) * np.asarray(course, dtype=np.float64)
    return profile
