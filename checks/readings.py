"""A session's series as they are, before anything is asked of them: label, mean frame and noise of each."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..acquisition.setting import Filter
from ..calibration.frames.frame_checks import repeats_the_last
from ..errors import InputError

FloatArray = NDArray[np.float64]
# what darks, and the variance of their frames, differ by from series to series of a line without fault
DARK_SD_DN, READ_NOISE_SD = 0.25, 0.01
FRAMES_READ = 8  # read of each series
_FRAMES_OF_NOISE = 5  # that an object's series needs to say something of noise
_LEAST_BRIGHTEST_DN = 30.0  # of frames that are no whole numbers; 8 bits averaged have more, transmissions 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Explained:
    """What an explanation of the whole session does to a series, (row, column) or (1, 1) where all pixels are alike.

    Fields: mean_DN: added to its mean; variance: noise variance of a frame over that without it.
    """

    mean_DN: FloatArray
    variance: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """What a series says of its beam: kV, filters, (name, value) of the tube load, exposure and distance.

    electronic_gain: of the readout over that of the other series, which no label states.
    """

    kV: float | None
    filters: tuple[Filter, ...]
    load: tuple[str, float] | None
    exposure_ms: float | None
    distance_mm: float
    electronic_gain: float = 1.0

    @property
    def beam(self) -> tuple[object, ...]:
        """What fixes level and noise but for one factor each."""
        return (self.kV, tuple(sorted(map(str, self.filters))), self.load is None)

    @property
    def log_load(self) -> float:
        """Logarithm of the charge of one exposure, or of its time where the load is unknown."""
        time = math.log(self.exposure_ms or 1.0)
        if self.load is None:
            return time
        name, value = self.load
        return time + math.log(value / (self.kV or 1.0) if name == "power_W" else value)


@dataclass(slots=True, kw_only=True)
class Reading:
    """A series as it is: mean frame (row, column) of the pixels looked at, its noise, what they amount to.

    frames: that it rests on, copies left out; level_sd, gain_sd: relative, the first for what is known of the dark; released: share
    of its level that an image lag may have brought from the exposures before.
    """

    series: Series
    label: Label
    mean_DN: FloatArray
    variance_DN2: FloatArray | None
    frames: int
    since: bool
    level_DN: float = math.nan
    level_sd: float = 0.0
    gain_DN: float = math.nan
    gain_sd: float = math.inf
    picture: FloatArray | None = None
    released: float = 0.0

    @property
    def name(self) -> str:
        return self.series.name

    def without(self, explained: Explained, stride: int) -> None:
        """Take off what an explanation does to the series."""
        self.mean_DN = self.mean_DN - explained.mean_DN[::stride, ::stride]
        if self.variance_DN2 is not None:
            self.variance_DN2 = self.variance_DN2 / explained.variance[::stride, ::stride]


def reading_of(item: Series, frames: FloatArray, acquisition: AcquisitionFile, *, since: bool) -> Reading:
    """A series' reading.

    Args:
        item: the series.
        frames: (frame, row, column) those that are looked at, two or more for a variance.
        acquisition: whose instrument stands in for distances that the series does not state.
        since: whether it was taken after those that calibrate.
    """
    variance = None
    # a copy of the frame before says nothing of noise
    frames = frames[~repeats_the_last(frames, None)]
    if len(frames) > 1:
        steps = np.diff(frames, axis=0)
        steps = _without_common(steps, np.asarray(frames.mean(axis=0), dtype=np.float64))
        scale = 2.0
        if len(steps) > 3:
            # a ghost of the exposure before that fades is no noise: it bends little, and less and less
            steps, scale = np.diff(steps, axis=0)[len(steps) // 2 :], 6.0
        variance = np.mean(steps**2, axis=0) / scale * item.averaged
        # what lines share is no noise of quanta; it follows the light where there is any
        picture = np.asarray(frames.mean(axis=0), dtype=np.float64)
        light = np.ones_like(picture) if item.kind == "dark" else picture
        variance = np.asarray(variance - _of_lines(steps, light) / scale * item.averaged * light**2, dtype=np.float64)
    load = None
    if item.power_W is not None:
        load = ("power_W", item.power_W)
    elif item.current_mA is not None:
        load = ("current_mA", item.current_mA)
    label = Label(
        kV=item.kV,
        filters=item.filters,
        load=load if item.kV is not None else None,
        exposure_ms=item.exposure_ms,
        distance_mm=item.source_detector_mm or acquisition.instrument.source_detector_mm or 1000.0,
    )
    return Reading(
        series=item,
        label=label,
        mean_DN=np.asarray(frames.mean(axis=0), dtype=np.float64),
        variance_DN2=variance,
        frames=len(frames),
        since=since,
    )


def _without_common(steps: FloatArray, picture: FloatArray) -> FloatArray:
    """Steps from frame to frame (step, row, column) less what all pixels have in common: an offset, and a share of their picture.

    Where half the field lies in shadow the tube's output moves the other half alone.
    """
    # hot and dead pixels stand far off in both
    low, high = np.quantile(steps, [0.05, 0.95], axis=(1, 2), keepdims=True)
    steady = np.clip(steps, low - (high - low), high + (high - low))
    shape = np.clip(picture, *np.quantile(picture, [0.01, 0.99]))
    shape = shape - shape.mean()
    steps = steps - steady.mean(axis=(1, 2), keepdims=True)
    power = float(np.sum(shape**2))
    if power <= 0:
        return steps
    return np.asarray(steps - (np.sum(steady * shape, axis=(1, 2)) / power)[:, None, None] * shape)


def _of_lines(steps: FloatArray, light: FloatArray) -> float:
    """Variance that steps (step, row, column) of the pixels of a line share, over the square of the light (row, column), of rows and
    columns together: covariance of the means of a line's two halves, which no light spreads between. None below 0."""
    low, high = np.quantile(steps, [0.05, 0.95], axis=(1, 2), keepdims=True)
    steady = np.clip(steps, low - (high - low), high + (high - low))
    shared = 0.0
    for lines, shown in ((steady, light), (steady.swapaxes(1, 2), light.T)):
        half = lines.shape[2] // 2
        if half == 0:
            continue  # lines of one pixel have no halves
        both = float(np.mean(shown[:, :half].mean(axis=1) * shown[:, half:].mean(axis=1)))
        covariance = float(np.mean(lines[..., :half].mean(axis=2) * lines[..., half:].mean(axis=2)))
        shared += max(covariance, 0.0) / both if both > 0.0 else 0.0
    return shared


def mean_of(image: FloatArray | None, good: NDArray[np.bool_]) -> float:
    """Mean over the good pixels; NaN where there is no image."""
    return math.nan if image is None else float(np.mean(image[good]))


def good_pixels(readings: Sequence[Reading]) -> NDArray[np.bool_]:
    """Pixels whose noise is like the others', over all series."""
    images = [item.variance_DN2 for item in readings if item.variance_DN2 is not None]
    shape = readings[0].mean_DN.shape if readings else (1, 1)
    if not images:
        return np.ones(shape, dtype=bool)
    noise = np.median(np.stack([image / max(float(np.median(image)), 1e-9) for image in images]), axis=0)
    middle = float(np.median(noise))
    good: NDArray[np.bool_] = (noise > 0.05 * middle) & (noise < 20.0 * middle)
    return good if good.mean() > 0.5 else np.ones(shape, dtype=bool)


@dataclass(frozen=True, slots=True, kw_only=True)
class Dark:
    """Dark that is taken off a lit series: mean (row, column), DN, and variance of its frames, DN^2, each with what it may be off."""

    mean_DN: FloatArray
    mean_sd_DN: float
    variance_DN2: float
    variance_sd_DN2: float


def measure(item: Reading, dark: Dark | None, good: NDArray[np.bool_]) -> bool:
    """Fill level, noise over signal and picture of a lit series; False where there is no dark to take off."""
    if dark is None:
        return False
    signal = item.mean_DN - dark.mean_DN
    item.picture = signal
    item.level_DN = float(np.median(signal[good]))
    item.level_sd = dark.mean_sd_DN / max(item.level_DN, 1e-9)
    # two or three frames behind an object may differ by the ghost of the exposure before
    if item.variance_DN2 is not None and (item.series.kind == "flat" or item.series.n_frames >= _FRAMES_OF_NOISE):
        mean = float(np.mean(signal[good]))
        total = mean_of(item.variance_DN2, good)
        quantum = total - dark.variance_DN2
        if mean > 0 and quantum > 0:
            item.gain_DN = quantum / mean
            pairs = item.frames - 1
            pairs = pairs if pairs < 4 else pairs // 2
            sampling = math.sqrt(4.0 / (max(pairs * 2.0 / 3.0, 1.0) * max(int(good.sum()), 1)))
            item.gain_sd = math.hypot(math.hypot(sampling * total, dark.variance_sd_DN2) / quantum, item.level_sd)
    return True


def relative_gain(flats: Sequence[Reading], good: NDArray[np.bool_]) -> FloatArray:
    """Shape of the flats (row, column), median 1."""
    images = [item.picture / item.level_DN for item in flats if item.picture is not None and item.level_DN > 0]
    if not images:
        return np.ones(good.shape)
    shape = np.median(np.stack(images), axis=0)
    return np.asarray(np.where(good & (shape > 0.05), shape, 1.0), dtype=np.float64)


def is_top(value_DN: float, bits: int | None) -> bool:
    """Whether a number is the largest of an ADC, of 8 bits or more where they are not known."""
    counted = math.log2(value_DN + 1.0) if value_DN > 0.0 else 0.0
    return counted == bits if bits is not None else counted >= 8 and counted.is_integer()


def share_at_the_top(frames: FloatArray) -> float:
    """Share of the values at the highest one, where far more stand there than at the next lower one; else 0."""
    highest = float(frames.max())
    below = frames[frames < highest]
    if below.size == 0:
        return 0.0
    top, next_one = float(np.mean(frames == highest)), float(np.mean(frames == below.max()))
    return top if top > 5.0 * next_one else 0.0


def refuse_fractions(lit: Sequence[Reading]) -> None:
    """Raise where frames with a beam hold no detector numbers but, as transmissions do, small fractions."""
    brightest = max((float(item.mean_DN.max()) for item in lit), default=_LEAST_BRIGHTEST_DN)
    whole = all(np.issubdtype(item.series.read_frames(0, 1).dtype, np.integer) for item in lit)
    if whole or brightest >= _LEAST_BRIGHTEST_DN:
        return
    factor = 10.0 ** math.ceil(4.0 - math.log10(max(brightest, 1e-30)))
    raise InputError(
        "frames",
        received=f"numbers of {brightest:.3g} at most",
        expected=f"detector numbers (DN) of {_LEAST_BRIGHTEST_DN:g} and more in flats, as dark and noise are judged in DN",
        remedy=f"multiply all frames of the file by one factor, darks included, for example {factor:g}",
    )


def silent_darks(acquisition: AcquisitionFile, calibrating: Collection[str], blank: Collection[str]) -> set[str]:
    """Blank series without a beam that are what this detector shows then: one that counts, or a simulated one without electronics.

    One blank dark among others that have noise is a failure to read it.
    """
    darks = {item.name for item in acquisition.series if item.kind == "dark"}
    before = darks & set(calibrating) or darks
    if not before <= set(blank):
        return set()
    return {item.name for item in acquisition.series if item.kind in ("dark", "afterglow") and item.name in blank}
