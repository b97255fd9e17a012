"""Flatfield of a twin at a setting, measured or not: mean, noise, gain, photons and dose, with 95 % intervals."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import Filter, Setting, filters_from_text, text_from_filters
from ...errors import InputError
from ...results import Result, Table, axes_or_new, frame, interval_text
from ...spectra import checked_kV
from ..frames.present_line import PresentLine, present_line
from ..line.binning import binned_pixel
from ..line.line_limits import check_count_rate, check_limits
from ..line.measured_flats import USUAL_STRAY, measured_flats, stray_of_flats, stray_of_noise, stray_of_setting
from ..line.spectral_signal import OpenBeam
from ..line.twin import Z95, Estimate, Level, SpectralPosterior, Twin, estimate_above_zero, estimate_from_log_draws
from ..line.twin_spectrum import gains_differ, slope_over_gain, slope_share, spectral_model_of

if TYPE_CHECKING:
    import pandas

    from .dual_layer import BackLayer

__all__ = [
    "Prediction",
    "binned_over_single",
    "predict_flatfield",
    "slope_share",
    "spectral_model_of",
]

WORDS = ("filter", *(field.name for field in fields(Setting) if field.name != "filters"))  # of a setting
# what a prediction holds, and in which unit
UNITS = {
    "mean_DN": "DN above dark",
    "sd_DN": "DN",
    "gain_DN": "DN",
    "photons_absorbed": "photons a pixel and frame",
    "air_kerma_uGy": "uGy a frame",
}
_FAR_ABOVE = 3.0  # times the brightest flat: beyond, nobody has seen whether the detector is linear
_FAR_BELOW = 10.0  # below the dimmest flat over this, offsets matter that no flat has shown


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Prediction(Result):
    """A flatfield of the mean of `setting.averaged` frames, at the pixel of the median level.

    Fields: mean_DN (above dark; the median over good pixels, which a field that falls off to its borders has above its mean),
    sd_DN (temporal, one pixel), gain_DN (single frame), photons_absorbed (a pixel and
    frame), air_kerma_uGy (a frame, at the object or, where its distance is unknown, at the detector); intervals are of
    the quantity itself, without the sampling noise of a later measurement. None where the twin cannot say;
    extrapolated: outside the calibrated range; warnings say why and what else to know; frames_per_s (averaging done) and
    back_layer (of a dual-layer panel): where they were asked for.
    """

    setting: Setting
    mean_DN: Estimate
    sd_DN: Estimate
    gain_DN: Estimate
    photons_absorbed: Estimate | None
    air_kerma_uGy: Estimate | None
    extrapolated: bool
    measured_level: bool
    warnings: tuple[str, ...]
    frames_per_s: float | None = None
    back_layer: "BackLayer | None" = None

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin predict --json` prints."""

        def plain(estimate: Estimate | None) -> dict[str, float] | None:
            return None if estimate is None else estimate.as_dict()

        return {
            "setting": str(self.setting),
            "mean_DN": plain(self.mean_DN),
            "sd_DN": plain(self.sd_DN),
            "gain_DN": plain(self.gain_DN),
            "photons_absorbed": plain(self.photons_absorbed),
            "air_kerma_uGy": plain(self.air_kerma_uGy),
            "extrapolated": self.extrapolated,
            "measured_level": self.measured_level,
            "warnings": list(self.warnings),
            **({} if self.frames_per_s is None else {"frames_per_s": self.frames_per_s}),
            **({} if self.back_layer is None else {"back_layer": self.back_layer.as_dict()}),
        }

    def to_dataframe(self) -> "pandas.DataFrame":
        """One row: the words of the setting, then every quantity with the ends of its interval."""
        return Predictions(predictions=(self,)).to_dataframe()

    def _table(self) -> Table:
        answer = self.to_dict()
        rows = [(name, *interval_text(answer[name], 5), unit) for name, unit in UNITS.items()]
        notes = [f"warning: {text}" for text in self.warnings]
        title = f"{self.setting}{' (extrapolated)' if self.extrapolated else ''}"
        return Table(title=title, header=("", "value", "95 % interval", "unit"), rows=tuple(rows), notes=tuple(notes))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Predictions(Result):
    """Flatfields at several settings, in the order asked for."""

    predictions: tuple[Prediction, ...]

    def __len__(self) -> int:
        return len(self.predictions)

    def __iter__(self) -> Iterator[Prediction]:
        return iter(self.predictions)

    def __getitem__(self, number: int) -> Prediction:
        return self.predictions[number]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Those of all predictions, each once."""
        return tuple(dict.fromkeys(line for item in self.predictions for line in item.warnings))

    def to_dict(self) -> dict[str, Any]:
        """`{"predictions": [...]}`, each as `raytwin predict --json` prints it."""
        return {"predictions": [item.to_dict() for item in self.predictions]}

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a setting: its words (kV, filter, ...), then every quantity with the ends of its interval."""
        return frame([{**_words_of(item.setting), **item.to_dict()} for item in self.predictions])

    def plot(self, ax: Any = None, *, what: str = "mean_DN", against: str = "kV") -> Any:
        """A quantity with its 95 % interval against a word of the settings; returns the axes.

        Args:
            ax: matplotlib axes; None: of a new figure.
            what: `mean_DN`, `sd_DN`, `gain_DN`, `photons_absorbed` or `air_kerma_uGy`.
            against: kV, exposure_ms, power_W, current_mA, averaged, binning or source_detector_mm.

        Raises:
            InputError: another quantity, or a word that some setting leaves open.
        """
        if what not in UNITS:
            raise InputError("what", received=repr(what), expected="one of " + ", ".join(UNITS))
        places = [_words_of(item.setting).get(against) for item in self.predictions]
        if not all(isinstance(place, int | float) for place in places):
            raise InputError("against", received=repr(against), expected="a number that every setting states")
        known = [
            (place, getattr(item, what))
            for place, item in zip(places, self.predictions, strict=True)
            if getattr(item, what) is not None
        ]
        axes = axes_or_new(ax)
        values = [item.value for _, item in known]
        ends = [[item.value - item.low for _, item in known], [item.high - item.value for _, item in known]]
        axes.errorbar([place for place, _ in known], values, yerr=ends, fmt="o", capsize=3)
        axes.set(xlabel=against, ylabel=f"{what} ({UNITS[what]})")
        return axes

    def _table(self) -> Table:
        names = ("mean_DN", "sd_DN", "gain_DN")
        rows = []
        for item in self.predictions:
            answer = item.to_dict()
            cells = [" (".join(filter(None, interval_text(answer[name]))) for name in names]
            closed = [f"{cell})" if "(" in cell else cell for cell in cells]
            rows.append((str(item.setting), *closed, "yes" if item.extrapolated else ""))
        title = f"{len(rows)} predictions, value (95 % interval)"
        return Table(title=title, header=("setting", *names, "extrapolated"), rows=tuple(rows))


def _words_of(setting: Setting) -> dict[str, Any]:
    """The words of a setting that are stated, by name."""
    words: dict[str, Any] = {}
    for name in WORDS:
        value = text_from_filters(setting.filters) if name == "filter" else getattr(setting, name)
        if value is not None:
            words[name] = value
    return words


def binned_over_single(twin: Twin, binning: int) -> float:
    """Photon-transfer slope of the mean of b x b pixels, times b^2, over that of one pixel; no unit, 1 or more."""
    white = twin.noise.white_fraction
    spread = twin.noise.spread.value
    return (spread.binned_variance_share(binning) + white) / (spread.variance_share + white)


def _restored_sd(twin: Twin) -> float:
    """Relative standard deviation of what restoring the spread does to all gains alike: what they are known less by than slopes."""
    if twin.noise.shared_gain_sd is not None:
        return twin.noise.shared_gain_sd
    excess = [
        _relative_sd(level.gain_DN) ** 2 - _relative_sd(level.photon_transfer_slope_DN) ** 2
        for level in twin.levels
        if level.gain_DN.value > 0 and level.photon_transfer_slope_DN.value > 0
    ]
    if excess:
        return math.sqrt(max(float(np.median(excess)), 0.0))
    ends = [spread.variance_share for spread in twin.noise.spread.ends()]
    return abs(ends[0] - ends[1]) / (2 * Z95) / slope_share(twin)


def _relative_sd(estimate: Estimate) -> float:
    return estimate.sd / estimate.value


def _estimate_from_draws(draws: NDArray[np.float64], relative_sd: float) -> Estimate:
    return estimate_from_log_draws(np.log(draws), relative_sd)


def _outside(twin: Twin, setting: Setting, signal_DN: float) -> tuple[str, ...]:
    """In how many ways a setting lies outside what was calibrated, in words: kV, filters, level."""
    found: list[str] = []
    if twin.spectral is not None:
        found += spectrum_outside(twin.spectral, kV=setting.kV, filters=setting.filters)
    points = [flat.signal_DN for flat in measured_flats(twin)]
    if points and not min(points) / _FAR_BELOW <= signal_DN <= max(points) * _FAR_ABOVE:
        found.append(f"level ({min(points):.0f} to {max(points):.0f} DN calibrated)")
    return tuple(found)


def spectrum_outside(posterior: SpectralPosterior, *, kV: float, filters: Sequence[Filter]) -> tuple[str, ...]:
    """In how many ways a beam lies outside what was calibrated, in words: kV, filters."""
    found = []
    lowest, highest = posterior.calibrated_kV
    if not 0.98 * lowest <= kV <= 1.02 * highest:
        found.append(f"kV ({lowest:g} to {highest:g} calibrated)")
    if _filters_outside(posterior, filters):
        found.append("filters")
    return tuple(found)


def _filters_outside(posterior: SpectralPosterior, filters: Sequence[Filter]) -> bool:
    stacks: list[dict[str, float]] = []
    for text in posterior.calibrated_filters:
        stack: dict[str, float] = {}
        for layer in filters_from_text(text):
            stack[layer.material] = stack.get(layer.material, 0.0) + layer.thickness_mm
        stacks.append(stack)
    wanted: dict[str, float] = {}
    for layer in filters:
        wanted[layer.material] = wanted.get(layer.material, 0.0) + layer.thickness_mm
    for material in {*wanted, *(name for stack in stacks for name in stack)}:
        thicknesses = [stack.get(material, 0.0) for stack in stacks]
        if not min(thicknesses) - 1e-9 <= wanted.get(material, 0.0) <= max(thicknesses) + 1e-9:
            return True
    return False


def predict_flatfield(twin: Twin, setting: Setting, *, after_calibration: bool = True) -> Prediction:
    """Flatfield at a setting, with 95 % intervals.

    At a kV and filter that was measured the measured level is scaled to the load; elsewhere the posterior of the
    spectral parameters is projected, level and noise draw by draw, and the learned discrepancy of single levels is added
    (as independent ones, one more for each way in which the setting lies outside: kV, filters, level).

    With binning, mean, noise and photons are those of a binned pixel, gain and slope remain those of one pixel.

    The twin's effects are in it: those on beam and noise in its numbers (`present_line`), others by what they change in
    `LineModel`'s flat, long after the beam was switched on. Intervals hold what is not known of their strengths and laws
    (`AppliedEffect.sd`), as a share of what each changes.

    Args:
        twin: the calibrated line.
        setting: with a tube load.
        after_calibration: whether effects that came after calibration are there.

    Raises:
        InputError: no tube load given, a setting beyond the line's limits (`line_limits`), or a twin that has neither this
            level nor a spectrum.
    """
    if not twin.effects:
        return _without_effects(twin, setting)
    found = _with_effects(twin, setting, after_calibration)
    doubtful = [item for item in twin.effects if item.sd > 0.0 and (after_calibration or item.since == "always")]
    if not doubtful:
        return found
    bare = _without_effects(replace(twin, effects=()), setting)
    alone = [(item.sd, _with_effects(replace(twin, effects=(item,)), setting, after_calibration)) for item in doubtful]

    def changes(number: Callable[[Prediction], Estimate | None]) -> float:
        """Relative standard deviation of a number by what is not known of effects; 0 where one has no such number."""
        before, those = number(bare), [(sd, number(one)) for sd, one in alone]
        if before is None or before.value <= 0.0:
            return 0.0
        return math.hypot(*(sd * (one.value / before.value - 1.0) for sd, one in those if one is not None))

    photons, kerma = found.photons_absorbed, found.air_kerma_uGy
    return replace(
        found,
        mean_DN=found.mean_DN.widened(changes(lambda one: one.mean_DN)),
        sd_DN=found.sd_DN.widened(changes(lambda one: one.sd_DN)),
        gain_DN=found.gain_DN.widened(changes(lambda one: one.gain_DN)),
        photons_absorbed=None if photons is None else photons.widened(changes(lambda one: one.photons_absorbed)),
        air_kerma_uGy=None if kerma is None else kerma.widened(changes(lambda one: one.air_kerma_uGy)),
    )


def _with_effects(twin: Twin, setting: Setting, after_calibration: bool) -> Prediction:
    """With the twin's effects, taken as known."""
    line = present_line(twin, after_calibration=after_calibration)
    found = _without_effects(line.twin, setting)
    if line.effects:
        found = _changed_by_effects(found, line)
    return replace(found, warnings=(*found.warnings, *line.warnings))


def _changed_by_effects(found: Prediction, line: PresentLine) -> Prediction:
    # the series model stands on this module
    from ..frames.flat_change import flat_change

    change = flat_change(line.twin, line.effects, found.setting)
    return replace(
        found,
        mean_DN=found.mean_DN.times(change.mean),
        sd_DN=found.sd_DN.times(change.sd),
        gain_DN=found.gain_DN.times(change.gain),
        photons_absorbed=None if found.photons_absorbed is None else found.photons_absorbed.times(change.photons),
        warnings=(*found.warnings, *change.warnings),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Flat:
    """A flatfield while it is put together, single exposures and pixels.

    Fields: mean_DN; gain_DN; quantum_DN2 (draw,): variance of quanta; quantum_sd: relative, of it beyond the draws;
    photons, kerma_uGy: None where no spectrum is known; outside: ways in which the setting lies outside what was calibrated.
    """

    mean_DN: Estimate
    gain_DN: Estimate
    quantum_DN2: NDArray[np.float64]
    quantum_sd: float
    photons: Estimate | None
    kerma_uGy: Estimate | None
    outside: tuple[str, ...]


def _without_effects(twin: Twin, setting: Setting) -> Prediction:
    warnings = list(check_limits(twin.instrument, setting))
    load_mAs = setting.stated_load_mAs()
    level, posterior = twin.level_at(setting), twin.spectral
    distance_mm = _distance_mm(twin, setting, level, warnings)
    flat = None
    if posterior is not None:
        flat = _by_model(twin, posterior, setting, load_mAs, distance_mm=distance_mm, warnings=warnings)
    if level is not None:
        flat = _as_measured(twin, setting, level, flat, load_mAs=load_mAs, distance_mm=distance_mm)
    if flat is None:
        known = ", ".join(item.name for item in twin.levels)
        raise InputError(
            "setting",
            received=str(setting),
            expected=f"a measured level with a known tube load ({known}), because this twin has no spectral part",
            remedy="calibrate from flats that state kV and current or power",
        )
    result = _of_frames(twin, setting, flat, warnings)
    if flat.outside:
        text = f"outside the calibrated range of {', '.join(flat.outside)}"
        warnings.append(text if posterior is None else f"{text}: the interval rests on the spectral model")
    return replace(result, measured_level=level is not None, warnings=tuple(warnings))


def _distance_mm(twin: Twin, setting: Setting, level: Level | None, warnings: list[str]) -> float:
    """From the source to the detector; what is not known of it, or of the pixels, goes to the warnings."""
    distance_mm = setting.source_detector_mm or twin.instrument.source_detector_mm
    at_object_mm = twin.instrument.source_object_mm
    if distance_mm is not None and at_object_mm is not None and distance_mm < at_object_mm:
        warnings.append(
            f"the detector at {distance_mm:g} mm stands nearer to the source than the object at {at_object_mm:g} mm"
        )
    if distance_mm is None:
        distance_mm = level.source_detector_mm if level is not None and level.source_detector_mm else 1000.0
        if twin.spectral is not None:
            warnings.append(
                "source-detector distance unknown: 1 m assumed on both sides, so only ratios are meaningful"
            )
    if twin.instrument.pixel_mm is None:
        warnings.append("pixel pitch unknown: photon numbers are not absolute")
    return distance_mm


def _by_model(
    twin: Twin,
    posterior: SpectralPosterior,
    setting: Setting,
    load_mAs: float,
    *,
    distance_mm: float,
    warnings: list[str],
) -> _Flat:
    """The flatfield as the posterior's draws have it.

    Raises:
        InputError: no spectra are known at the voltage, or nothing gets through the filters.
    """
    checked_kV(setting.kV, anode=posterior.anode)
    model = spectral_model_of(twin, highest_kV=setting.kV)
    beam = OpenBeam(kV=setting.kV, filters=setting.filters)
    signal = model.signal(posterior.samples, beam)
    best = posterior.best[None, :]
    bare = model.signal(best, OpenBeam(kV=setting.kV, filters=())).absorbed_per_mAs
    left = model.signal(best, beam).absorbed_per_mAs
    # fewer than one photon in 1e30 is no beam, whatever floating point can still hold
    if not (np.all(signal.absorbed_per_mAs > 0) and left[0] > 1e-30 * bare[0]):
        raise InputError(
            "filter",
            received=text_from_filters(setting.filters),
            expected="layers that let some photons through",
            remedy="take thinner filters or a higher tube voltage",
        )
    factor = (1000.0 / distance_mm) ** 2 * (twin.instrument.pixel_mm or 1.0) ** 2
    rate_draws = signal.rate_DN_per_mAs * load_mAs * factor
    outside = _outside(twin, setting, float(np.median(rate_draws)))
    # the draws hold what the parameters leave open; single levels stray from any such model, more so outside
    widen = math.sqrt(1.0 + len(outside))
    beyond_repeats = math.sqrt(max(stray_of_flats(twin) ** 2 - USUAL_STRAY**2, 0.0))
    of_setting, of_noise = stray_of_setting(
        twin, setting, None, distance_mm=distance_mm, signal_DN=float(np.median(rate_draws))
    )
    level_sd = math.hypot(widen * posterior.level_discrepancy, beyond_repeats, of_setting)
    gain_sd = widen * posterior.gain_discrepancy
    share, restored_sd = slope_share(twin), _restored_sd(twin)
    own_gain_sd = gains_differ(twin.levels) if posterior.counting else 0.0
    # level and gain are known together, not one by one: their product draw by draw
    own_share = slope_over_gain(twin.levels, twin.noise, signal.gain_DN)
    at_object_mm = twin.instrument.source_object_mm
    if setting.source_detector_mm is not None or at_object_mm is None:
        warnings.append("air kerma is given at the detector: the object's distance at this setting is unknown")
        at_object_mm = distance_mm
    return _Flat(
        mean_DN=_estimate_from_draws(rate_draws, level_sd),
        gain_DN=_estimate_from_draws(signal.gain_DN, math.hypot(gain_sd, restored_sd, own_gain_sd)),
        quantum_DN2=signal.gain_DN * (share if own_share is None else own_share) * rate_draws,
        quantum_sd=math.hypot(level_sd, gain_sd, _beyond(of_noise, of_setting)),
        # photons are counted by the gain: what it is known less by, they are as well
        photons=_estimate_from_draws(signal.absorbed_per_mAs * load_mAs * factor, math.hypot(level_sd, restored_sd)),
        kerma_uGy=_estimate_from_draws(
            signal.kerma_uGy_per_mAs * load_mAs * (1000.0 / at_object_mm) ** 2,
            level_sd
            if posterior.kerma_discrepancy is None
            else math.hypot(widen * posterior.kerma_discrepancy, of_setting),
        ),
        outside=outside,
    )


def _beyond(of_noise: float, of_level: float) -> float:
    """Standard deviation that the noise has beside that of the level."""
    return math.sqrt(max(of_noise**2 - of_level**2, 0.0))


def _as_measured(
    twin: Twin, setting: Setting, level: Level, modelled: _Flat | None, *, load_mAs: float, distance_mm: float
) -> _Flat | None:
    """The flatfield with what was measured at this kV and filter in place of the model's; None: its load is not known."""
    more_noise = 0.0
    if level.rate_DN_per_mAs is not None:
        rate = level.rate_DN_per_mAs
        value = rate.value * load_mAs * ((level.source_detector_mm or distance_mm) / distance_mm) ** 2
        of_setting, of_noise = stray_of_setting(twin, setting, level, distance_mm=distance_mm, signal_DN=value)
        relative = math.hypot(rate.sd / rate.value, stray_of_flats(twin), of_setting)
        more_noise = _beyond(of_noise, of_setting)
        mean_DN, gain_DN = estimate_above_zero(value, relative * value), level.gain_DN
        outside = _outside(twin, setting, mean_DN.value)
    elif modelled is not None:
        mean_DN, gain_DN, outside = modelled.mean_DN, modelled.gain_DN, modelled.outside
    else:
        return None
    slope = level.photon_transfer_slope_DN
    return _Flat(
        mean_DN=mean_DN,
        gain_DN=gain_DN,
        quantum_DN2=np.array([slope.value * mean_DN.value]),
        quantum_sd=math.hypot(_log_sd(slope), _log_sd(mean_DN), more_noise),
        photons=None if modelled is None else modelled.photons,
        kerma_uGy=None if modelled is None else modelled.kerma_uGy,
        outside=outside,
    )


def _of_frames(twin: Twin, setting: Setting, flat: _Flat, warnings: list[str]) -> Prediction:
    """The flatfield of binned pixels and averaged frames, with the electronics' noise.

    Raises:
        InputError: more photons than a counting detector takes.
    """
    instrument = twin.instrument
    binned = binned_pixel(setting.binning, instrument.binning_adds)
    mean_DN, photons, quantum_DN2 = flat.mean_DN, flat.photons, flat.quantum_DN2
    if setting.binning > 1:
        quantum_DN2 = quantum_DN2 * binned_over_single(twin, setting.binning) * binned.quantum
        mean_DN = mean_DN.times(binned.signal)
        photons = photons.times(binned.pixels) if photons is not None else None
        if instrument.binning_adds is None:
            warnings.append("binning is taken as the mean of pixels after readout; declare binning_adds if it is not")
    read = twin.noise.read_noise_DN
    read_DN2 = twin.noise.read_variance_DN2 * binned.electronic
    common = twin.noise.common_variance or Estimate(value=0.0, low=0.0, high=0.0)
    common_DN2 = common.value * mean_DN.value**2
    variance_draws = np.maximum(quantum_DN2, 0.0) + max(read_DN2, 1e-12) + common_DN2
    variance = float(np.median(variance_draws))
    of_quanta = max(variance - read_DN2 - common_DN2, 0.0) * flat.quantum_sd
    of_reading = 2.0 * read.value * (read.high - read.low) / (2 * Z95) * binned.electronic
    # cut at 0, so that its upper end alone has the full width
    of_common = (common.high - common.value) / Z95 * mean_DN.value**2
    of_series = stray_of_noise(twin) * variance
    relative_sd = 0.5 * math.hypot(of_quanta, of_reading, of_common, of_series) / variance
    saturated = saturation_text(twin, setting, mean_DN.value)
    if saturated:
        warnings.append(saturated)
    if photons is not None and instrument.counting:
        check_count_rate(instrument, setting, photons.value)
    return Prediction(
        setting=setting,
        mean_DN=mean_DN,
        sd_DN=_estimate_from_draws(np.sqrt(variance_draws / setting.averaged), relative_sd),
        gain_DN=flat.gain_DN,
        photons_absorbed=photons,
        air_kerma_uGy=flat.kerma_uGy,
        extrapolated=bool(flat.outside),
        measured_level=False,
        warnings=(),
    )


def full_scale(twin: Twin, setting: Setting, mean_DN: float) -> tuple[float, float] | None:
    """What the converter holds of a flatfield, and what it has room for, DN above dark; None: its bits are not known.

    Args:
        twin: for its bits, dark and way of binning.
        setting: for its binning.
        mean_DN: of the (binned) pixels, above dark.
    """
    bits = twin.instrument.bits
    if bits is None:
        return None
    binned = binned_pixel(setting.binning, twin.instrument.binning_adds)
    return mean_DN / binned.signal * binned.at_the_adc, 2.0**bits - 1 - twin.dark_DN.value


def saturation_text(twin: Twin, setting: Setting, mean_DN: float) -> str:
    """By how much a flatfield is more than the converter holds; empty: it is not, or its bits are not known. As `full_scale`."""
    held = full_scale(twin, setting, mean_DN)
    if held is None or held[0] <= held[1]:
        return ""
    return f"the detector saturates: {held[0]:.0f} DN above dark, room for {held[1]:.0f} DN"


def _log_sd(estimate: Estimate) -> float:
    if estimate.low <= 0:
        return estimate.sd / max(abs(estimate.value), 1e-300)
    return math.log(estimate.high / estimate.low) / (2 * Z95)
