"""The twin: what calibration knows of one line, and all that prediction and generation need."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from ...acquisition.instrument import Instrument
from ...acquisition.setting import Filter, Setting, text_from_filters
from ...errors import InputError
from ...results import ByValue, Result, Table, plain
from ..spread.psf import Spread
from .applied_effect import AppliedEffect
from .spectral_signal import SpectrumCorrection

if TYPE_CHECKING:
    import pandas

    from .. import Prediction, Predictions

# name of the map of pixels that calibration found bad, in twin files, answers and options; an effect that bears the same name
# adds pixels that this map has not
BAD_PIXEL_MAP = "bad_pixels"
Z95 = 1.959964  # standard deviations of a Gaussian on either side that hold 95 %
LEAST_PIXELS = 16  # that are not bad: with fewer, medians and spreads over a frame say nothing
# reason codes of bad pixels; a pixel carries the first that applies
BAD_PIXEL_CODES = {
    "good": 0,
    "dead": 1,
    "hot": 2,
    "noisy": 3,
    "nonlinear": 4,
    "declared": 5,
    "clustered": 6,
    "interpolated": 7,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A value with its 95 % interval, in the unit its name says."""

    value: float
    low: float
    high: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.value) and self.low <= self.value <= self.high):
            raise InputError(
                "estimate",
                received=f"{self.value} ({self.low} to {self.high})",
                expected="low <= value <= high, finite",
            )

    @property
    def sd(self) -> float:
        """Standard deviation of a Gaussian whose 95 % interval is as wide."""
        return (self.high - self.low) / (2.0 * Z95)

    def times(self, factor: float) -> "Estimate":
        """Value and interval times a known factor of 0 or more."""
        return Estimate(value=factor * self.value, low=factor * self.low, high=factor * self.high)

    def widened(self, relative_sd: float) -> "Estimate":
        """The same with an independent relative standard deviation more; the low end stays at 0 or above where it was."""
        half = Z95 * relative_sd * abs(self.value)
        low = self.value - math.hypot(self.value - self.low, half)
        return Estimate(
            value=self.value,
            low=max(low, 0.0) if self.low >= 0.0 else low,
            high=self.value + math.hypot(self.high - self.value, half),
        )

    def as_dict(self) -> dict[str, float]:
        """`{value, low, high}`."""
        return {"value": self.value, "low": self.low, "high": self.high}


def estimate_from_sd(value: float, sd: float, *, lowest: float = -math.inf, highest: float = math.inf) -> Estimate:
    """Gaussian 95 % interval about `value`, cut at `lowest` and `highest`."""
    half = Z95 * sd
    return Estimate(value=value, low=min(max(value - half, lowest), value), high=max(min(value + half, highest), value))


def estimate_above_zero(value: float, sd: float) -> Estimate:
    """95 % interval of what is Gaussian about `value`, above 0, and known to be above 0: the Gaussian cut there.

    Ends: quantiles 0.025 and 0.975 of the part above 0; where `value` is many `sd`, those of the Gaussian itself.
    """
    from scipy.special import ndtr, ndtri

    beyond = float(ndtr(-value / max(sd, 1e-12 * value)))
    # from above, where the Gaussian's own tail keeps its digits
    low, high = (value - sd * float(ndtri((1.0 - beyond) * above)) for above in (0.975, 0.025))
    return Estimate(value=value, low=min(max(low, 0.0), value), high=high)


def estimate_from_log_draws(logarithm: NDArray[np.float64], relative_sd: float) -> Estimate:
    """Median and 95 % interval of exp(logarithm) (draw,) times a lognormal of `relative_sd`, in the draws' unit."""
    middle = float(np.median(logarithm))
    low, high = np.quantile(logarithm, [0.025, 0.975])
    below = math.hypot(middle - min(low, middle), Z95 * relative_sd)
    above = math.hypot(max(high, middle) - middle, Z95 * relative_sd)
    return Estimate(value=math.exp(middle), low=math.exp(middle - below), high=math.exp(middle + above))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Level(ByValue):
    """One tube voltage and filter that was measured.

    Fields: kV (None where unknown), filters; gain_DN (variance per signal, the spread's share restored);
    photon_transfer_slope_DN (variance of one pixel per signal, as measured); rate_DN_per_mAs (detector median above
    dark at source_detector_mm; None where the tube load is unknown); saturation_DN (None where none was seen);
    flat_shape (row, column): signal relative to the detector median; series: that it comes from; exposures: of how many it is
    the mean; signal_DN: the median's signal in each; dark_noise: variance of a pixel of the dark subtracted from it over that of
    one exposure (None: not known).
    """

    kV: float | None
    filters: tuple[Filter, ...]
    gain_DN: Estimate
    photon_transfer_slope_DN: Estimate
    rate_DN_per_mAs: Estimate | None
    source_detector_mm: float | None
    saturation_DN: float | None
    flat_shape: NDArray[np.float32]
    series: tuple[str, ...]
    role: str
    exposures: float | None = None
    signal_DN: float | None = None
    dark_noise: float | None = None

    @property
    def name(self) -> str:
        """kV and filter in one word for tables."""
        voltage = "unknown kV" if self.kV is None else f"{self.kV:g} kV"
        return f"{voltage}, {text_from_filters(self.filters) or 'no filter'}"


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherSpread:
    """What the spread may be instead: the kernel family in words, its probability, and its mean parameters."""

    family: str
    probability: float
    value: Spread

    def __post_init__(self) -> None:
        if not 0.0 < self.probability <= 1.0:
            raise InputError(
                "optical spread",
                received=f"{self.family} with a probability of {self.probability:g}",
                expected="a probability above 0, up to 1",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class SpreadEstimate:
    """The optical spread: its most probable parameters, the kernel family in words, and intervals of the parameters.

    intervals: of `sigma_px` always, of `aspect`, `tail_share` and `tail_px` where the data were asked for them; others: families
    that the data leave open.
    """

    value: Spread
    family: str = "Gaussian"
    intervals: Mapping[str, Estimate] = field(default_factory=dict)
    others: tuple[OtherSpread, ...] = ()

    @property
    def gaussian_px(self) -> Estimate | None:
        """Width of the Gaussian core with its interval, px; None where most of the light is in the tail."""
        return self.intervals.get("sigma_px") if self.value.tail_share < 0.5 else None

    def ends(self) -> tuple[Spread, Spread]:
        """The spread with its share of the variance at the ends of the widths' and shares' intervals."""
        value = self.value
        exact = Estimate(value=value.sigma_px, low=value.sigma_px, high=value.sigma_px)
        width = self.intervals.get("sigma_px", exact)
        share = self.intervals.get("tail_share")
        low, high = (value.tail_share, value.tail_share) if share is None else (share.low, min(share.high, 1.0))
        return (
            replace(value, sigma_px=width.low, tail_share=low),
            replace(value, sigma_px=width.high, tail_share=high),
        )


def gaussian_spread(model: str, sigma_px: Estimate, *, axes: str = "both") -> SpreadEstimate:
    """A Gaussian spread, as wide along all `axes`, of a width with its interval, px."""
    return SpreadEstimate(
        value=Spread(model=model, sigma_px=sigma_px.value, axes=axes),
        family=f"Gaussian ({model})",
        intervals={"sigma_px": sigma_px},
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseModel:
    """Noise of the detector: see generator.spread.psf for the optical spread.

    Fields: spread; white_fraction: signal-following white variance over the quantum variance before
    the spread; read_noise_DN: electronic noise of one frame without the ADC's rounding; quantised: whole DN;
    shared_gain_sd: relative standard deviation of gain over photon-transfer slope, by which the gains of all beams are off alike;
    None: not known apart from the levels' intervals; common_variance: of what pixels of a frame share and the next frame has
    otherwise (output, lines, a source that wanders), relative to the squared signal; None: not known.
    """

    spread: SpreadEstimate
    white_fraction: float
    read_noise_DN: Estimate
    quantised: bool
    shared_gain_sd: float | None = None
    common_variance: Estimate | None = None

    @property
    def read_variance_DN2(self) -> float:
        """Electronic noise and rounding (1/12 DN^2), variance of one frame, DN^2."""
        return self.read_noise_DN.value**2 + (1.0 / 12.0 if self.quantised else 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectorMaps(ByValue):
    """Maps (row, column): dark at `dark_exposure_ms`, its growth a ms, relative gain, read variance, bad pixels.

    gain_relative is the pixel's gain over the detector median, shrunk towards 1 as far as the data are thin. dark_noise (a, b, c):
    the variance that noise gives a pixel of the dark t ms longer than `dark_exposure_ms` is a + b t + c t^2 of one exposure's;
    None: not known.
    """

    dark_DN: NDArray[np.float32]
    dark_exposure_ms: float | None
    dark_DN_per_ms: NDArray[np.float32]
    gain_relative: NDArray[np.float32]
    read_variance_DN2: NDArray[np.float32]
    bad_pixels: NDArray[np.uint8]
    dark_noise: tuple[float, float, float] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the detector."""
        return (self.dark_DN.shape[0], self.dark_DN.shape[1])

    def dark_at(self, exposure_ms: float | None) -> NDArray[np.float32]:
        """Dark frame (row, column) at an exposure time, DN."""
        if exposure_ms is None or self.dark_exposure_ms is None:
            return self.dark_DN
        return np.asarray(self.dark_DN + self.dark_DN_per_ms * np.float32(exposure_ms - self.dark_exposure_ms))

    def dark_noise_at(self, exposure_ms: float | None) -> float:
        """Variance of a pixel of `dark_at` over that of one exposure; 1 where it is not known."""
        if self.dark_noise is None:
            return 1.0
        longer = 0.0
        if exposure_ms is not None and self.dark_exposure_ms is not None:
            longer = exposure_ms - self.dark_exposure_ms
        same, mixed, grown = self.dark_noise
        return max(same + mixed * longer + grown * longer**2, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpectralPosterior(ByValue):
    """What the flats say of tube and scintillator: equally likely parameter sets.

    Fields: names (parameters, units in the names); samples (draw, parameter); best (parameter,): the most probable set;
    prior: name -> text; undetermined: directions that the data leave as wide as the prior, in words; anode,
    anode_angle_deg, model, inherent (vendor's layers), scintillator, cover, counting: the frame of the model; alternative:
    the scintillator of draws that have another one (where nobody declared it); level_discrepancy, gain_discrepancy: relative
    sd of a single level and gain beyond the parameters; kerma_discrepancy: of a single setting's air kerma (None: no dosimeter
    was read); correction: of the tube model by measured spectra, if there were any; secondary_DN: variance per signal that
    secondary quanta add to the gain of every beam.
    """

    names: tuple[str, ...]
    samples: NDArray[np.float64]
    best: NDArray[np.float64]
    prior: Mapping[str, str]
    undetermined: tuple[str, ...]
    anode: str
    anode_angle_deg: float
    model: str
    inherent: tuple[Filter, ...]
    scintillator: tuple[Filter, ...]
    cover: tuple[Filter, ...]
    counting: bool
    level_discrepancy: float
    gain_discrepancy: float
    calibrated_kV: tuple[float, float]
    calibrated_filters: tuple[str, ...]
    alternative: tuple[Filter, ...] = ()
    correction: SpectrumCorrection | None = None
    kerma_discrepancy: float | None = None
    secondary_DN: float = 0.0

    def column(self, name: str) -> NDArray[np.float64]:
        """Draws of one parameter (draw,)."""
        return np.asarray(self.samples[:, self.names.index(name)])

    def interval(self, name: str) -> Estimate:
        """Median and 95 % interval of one parameter."""
        low, middle, high = np.quantile(self.column(name), [0.025, 0.5, 0.975])
        return Estimate(value=float(middle), low=float(low), high=float(high))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Twin(Result):
    """A calibrated line; `effects` are those beyond the base model that it is known to have.

    layer: `front` or `back`, of a dual-layer panel whose series name theirs; else None.
    """

    instrument: Instrument
    maps: DetectorMaps
    noise: NoiseModel
    dark_DN: Estimate
    levels: tuple[Level, ...]
    spectral: SpectralPosterior | None
    evidence: Mapping[str, Any]
    warnings: tuple[str, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)
    effects: tuple[AppliedEffect, ...] = ()
    layer: str | None = None

    def level_at(self, setting: Setting) -> Level | None:
        """The measured level of this kV and these filters (same layers in any order), or None."""
        wanted = sorted(str(layer) for layer in setting.filters)
        for level in self.levels:
            if level.kV is None or abs(level.kV - setting.kV) > 1e-6 * setting.kV:
                continue
            if sorted(str(layer) for layer in level.filters) == wanted:
                return level
        return None

    def level_nearest(self, setting: Setting | None) -> Level | None:
        """The level of these kV and filters, else of those whose kV is known the nearest in kV, then in filters; None: no levels."""
        level = None if setting is None else self.level_at(setting)
        if level is not None or not self.levels:
            return level
        kV = None if setting is None else setting.kV
        wanted = set() if setting is None else {str(layer) for layer in setting.filters}
        return min(
            [item for item in self.levels if item.kV is not None] or self.levels,
            key=lambda item: (
                abs(math.log(item.kV / kV)) if kV is not None and item.kV is not None else 0.0,
                len(wanted ^ {str(layer) for layer in item.filters}),
            ),
        )

    @overload
    def predict(self, settings: Setting, /) -> "Prediction": ...
    @overload
    def predict(self, settings: str, /) -> "Prediction": ...  # type: ignore[overload-overlap]
    @overload
    def predict(self, settings: Sequence[Setting | str], /) -> "Predictions": ...
    @overload
    def predict(self, /, **words: Any) -> "Any": ...
    def predict(self, settings: Setting | str | Sequence[Setting | str] | None = None, /, **words: Any) -> Any:
        """Flatfield at one setting or at many, measured or not, with 95 % intervals.

        Args:
            settings: a `Setting`, its text form (`"kv=60,power_w=30,exposure_ms=20,filter=Cu:0.1"`), or a sequence of them.
            **words: in place of `settings`: kV, exposure_ms, power_W or current_mA, filter (`"Cu:0.1+Al:1"`), averaged,
                source_detector_mm, binning, frame_interval_ms, belt_speed_mm_s. A word given as a list makes a table; words
                given as lists go together, entry by entry.

        Returns:
            A `Prediction`, or `Predictions` where many were asked for.

        Raises:
            InputError: an unknown word or material, no tube load, or a setting that the line cannot have.

        Example:
            >>> found = twin.predict(kV=60, power_W=30, exposure_ms=20, filter="Cu:0.1")
            >>> found.mean_DN.low < found.mean_DN.value < found.mean_DN.high
            True
            >>> list(twin.predict(kV=[50, 60], power_W=30, exposure_ms=20).to_dataframe()["kV"])
            [50.0, 60.0]
        """
        from .. import predict_words

        return predict_words(self, settings, words)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the twin to a file (HDF5), whole or not at all; `raytwin.read_twin` reads it.

        Raises:
            InputError: a place where nothing can be written.
        """
        from .. import write_twin

        write_twin(path, self)

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin calibrate --json` prints."""
        from .. import calibration_answer

        found: dict[str, Any] = plain(calibration_answer(self))
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each measured level: kV, filter, gain, photon-transfer slope, rate, saturation."""
        from ...results import frame

        return frame(self.to_dict()["levels"])

    def plot(self, ax: Any = None, *, what: str = "gain_DN") -> Any:
        """Gain (`gain_DN`) or rate (`rate_DN_per_mAs`) of the measured levels against kV, with 95 % intervals; returns the axes."""
        from .. import plot_levels

        return plot_levels(self, ax=ax, what=what)

    def _table(self) -> Table:
        from .. import twin_table

        return twin_table(self)
