"""Which one more measurement would narrow the predictions most: a linear Gaussian update of the posterior's draws."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Filter, Setting, filters_from_text, text_from_filters
from ..generator.line.measured_flats import measured_flats
from ..generator.line.spectral_signal import OpenBeam, SpectralModel
from ..generator.line.twin import Z95, Estimate, Level, SpectralPosterior, Twin
from ..generator.predictions.predict import spectral_model_of
from ..materials import material_from_name, transmission
from ..spectra import MAXIMUM_KV_OF_ANODE, MINIMUM_KV
from .spectrum.priors import WEDGE_THICKNESS

# what a person has at hand: plates for the beam, and a wedge of aluminium
_PLATES = ("", "Cu:0.1", "Al:2", "Cu:0.5")
_WEDGE_MM = (1.0, 2.0, 4.0, 8.0)
_WEDGE_SD = 0.003  # of each step's transmission
# relative sd of one reading: IEC 61674 allows 5 % of a dosemeter for diagnostic beams, 95 % bounds; distance adds 1 to 2 %
_DOSE_SD = 0.03
_DESIGN_PLATES = ("", "Cu:0.1", "Al:2")
_REACH = 1.33  # design and candidates go so far above the highest measured kV
_LONGEST = 10.0  # times the longest exposure measured
_DIMMEST = 0.3  # of the dimmest flat's signal: less is not worth measuring
_RIDGE = 1e-12

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class NextMeasurement:
    """One more measurement and what it does to the predictions.

    Fields: kind (`flats`, `wedge` or `dose`, one reading of air kerma); text (a sentence); setting (what to dial in); layers
    (behind which the flat is taken step by step, where it is a wedge; else none); shrinks_to (mean width of the intervals of
    level and noise over a grid of settings, of what it is now); dose_shrinks_to (the same of the air kerma); width_percent
    (mean half width of the level's interval now); other_kV_percent, measured_kV_percent (the same, of the grid's voltages that
    were not measured and of those that were, behind other filters; None where the grid has none); kV and filters of the grid.
    """

    kind: str
    text: str
    setting: Setting
    layers: tuple[Filter, ...]
    shrinks_to: float
    dose_shrinks_to: float
    width_percent: float
    other_kV_percent: float | None
    measured_kV_percent: float | None
    grid: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """`next_measurement` of `raytwin calibrate --json`."""
        return {
            "kind": self.kind,
            "text": self.text,
            "setting": str(self.setting),
            "wedge": text_from_filters(self.layers) or None,
            "shrinks_to": self.shrinks_to,
            "dose_shrinks_to": self.dose_shrinks_to,
            "width_percent_now": self.width_percent,
            "width_percent_other_kV": self.other_kV_percent,
            "width_percent_measured_kV": self.measured_kV_percent,
            "grid": list(self.grid),
        }


def advice(twin: Twin) -> dict[str, Any] | None:
    """The measurement that helps most, how far the voltages measured carry, and what the other kinds of measurement would do.

    Args:
        twin: calibrated.

    Returns:
        `NextMeasurement.as_dict` of the first of `rank_measurements`; `carries`, a sentence on the voltages that were not
        measured, which also follows the `text`; `exposures`, one before it where levels at other exposures are less known than
        those at other beams; `alternatives`, the best flats at another voltage and at a measured one, the
        best wedge and the best reading of dose, as dicts of `kind`, `text`, `setting`, `shrinks_to` and `dose_shrinks_to`.
        None: nothing can be named.
    """
    ranked = rank_measurements(twin)
    if not ranked:
        return None
    voltages = {level.kV for level in twin.levels}
    best: dict[tuple[str, bool], NextMeasurement] = {}
    for item in ranked:
        best.setdefault((item.kind, item.kind == "flats" and item.setting.kV in voltages), item)
    kept = ("kind", "text", "setting", "shrinks_to", "dose_shrinks_to")
    rows = [{name: value for name, value in item.as_dict().items() if name in kept} for item in best.values()]
    carries = _carries(ranked[0], twin)
    exposures = _exposures(twin, ranked[0].width_percent)
    text = ". ".join(filter(None, (exposures, ranked[0].text, carries)))
    return ranked[0].as_dict() | {"text": text, "carries": carries, "exposures": exposures, "alternatives": rows}


def _exposures(twin: Twin, width_percent: float) -> str | None:
    """That flats at a second exposure time are wanted, in a sentence: where what one time leaves open at half of it is more than
    `width_percent`. None where a belt sets the time.
    """
    times_ms = {flat.exposure_ms for flat in measured_flats(twin) if flat.exposure_ms}
    errors = twin.evidence.get("setting_errors")
    if len(times_ms) != 1 or errors is None or twin.instrument.detector == "tdi":
        return None
    (time_ms,) = times_ms
    # one change of 1 / t ms, from the exposure to half of it
    open_percent = 100.0 * Z95 * float(errors["exposure_ms"]["sd"]) / time_ms
    if open_percent <= width_percent:
        return None
    return (
        f"Flats at a second exposure time beside {time_ms:g} ms: from one, levels at {0.5 * time_ms:g} ms are known to"
        f" +-{open_percent:.2g} % at best"
    )


def _carries(first: NextMeasurement, twin: Twin) -> str | None:
    """How well levels at voltages that were not measured are known, in a sentence."""
    if first.other_kV_percent is None:
        return None
    measured = sorted({level.kV for level in twin.levels if level.kV is not None and level.rate_DN_per_mAs is not None})
    names = " and ".join(filter(None, (", ".join(f"{kV:g}" for kV in measured[:-1]), f"{measured[-1]:g}")))
    text = f"From {names} kV, levels at other voltages are known to +-{first.other_kV_percent:.1f} %"
    if first.measured_kV_percent is not None:
        text += f", behind other filters at the same voltages to +-{first.measured_kV_percent:.1f} %"
    return text


def rank_measurements(twin: Twin) -> tuple[NextMeasurement, ...]:
    """Flats, wedges and dose readings that could be measured next, the one that narrows the predictions most first.

    With Y the logarithms of level and noise variance over a grid of settings and C those of the candidate, over the
    posterior's draws:  var(Y | C) = var(Y) - cov(Y, C) (var(C) + R)^-1 cov(C, Y),  R the candidate's sampling noise and
    the learned discrepancy. Linear and Gaussian: for one measured kV, whose posterior is skew, a rough guide.

    Args:
        twin: calibrated, with a spectral part and at least one level with a tube load.

    Returns:
        Candidates within the tube's power and range, none where the twin has no spectral part or no tube load.
    """
    posterior = twin.spectral
    measured = [level for level in twin.levels if level.kV is not None and level.rate_DN_per_mAs is not None]
    if posterior is None or not measured:
        return ()
    voltages = sorted({float(level.kV or 0.0) for level in measured})
    every_kV = voltages_within_reach(voltages, posterior.anode)
    logs = _Logarithms(spectral_model_of(twin, highest_kV=max(every_kV)), posterior.samples)
    predicted = _predictions(logs, measured, every_kV, posterior)
    candidates = _candidates(twin, logs, measured, every_kV, posterior)

    now = predicted.half_width()
    levels_percent = 100.0 * now[_LEVEL::3]
    elsewhere = np.array([kV not in voltages for kV, _ in predicted.grid], dtype=bool)
    other_kV = float(np.mean(levels_percent[elsewhere])) if elsewhere.any() else None
    measured_kV = float(np.mean(levels_percent[~elsewhere])) if not elsewhere.all() else None
    names = tuple(f"{kV:g} kV {text_from_filters(filters)}".strip() for kV, filters in predicted.grid)
    of_kerma = np.arange(len(now)) % 3 == _KERMA
    ranked = []
    for candidate in candidates:
        after = predicted.half_width(candidate)
        shrinks_to, dose_shrinks_to = (
            float(np.mean(after[chosen]) / np.mean(now[chosen])) for chosen in (~of_kerma, of_kerma)
        )
        ranked.append(
            NextMeasurement(
                kind=candidate.kind,
                text=_sentence(candidate.kind, candidate.setting, candidate.steps, shrinks_to, dose_shrinks_to),
                setting=candidate.setting,
                layers=candidate.steps,
                shrinks_to=shrinks_to,
                dose_shrinks_to=dose_shrinks_to,
                width_percent=100.0 * float(np.mean(now[_LEVEL::3])),
                other_kV_percent=other_kV,
                measured_kV_percent=measured_kV,
                grid=names,
            )
        )
    return tuple(sorted(ranked, key=lambda item: item.shrinks_to))


_Beam = tuple[float, tuple[Filter, ...]]  # kV and filters
_LEVEL, _NOISE, _KERMA = range(3)  # numbers that are predicted at each beam of the grid


class _Logarithms:
    """Logarithms of level, gain and air kerma of a beam (3, draw), over the posterior's draws; each beam computed once."""

    def __init__(self, model: SpectralModel, samples: Array) -> None:
        self._model, self._samples = model, samples
        self._known: dict[OpenBeam, Array] = {}

    def __call__(self, kV: float, filters: tuple[Filter, ...]) -> Array:
        beam = OpenBeam(kV=kV, filters=filters)
        if beam not in self._known:
            found = self._model.signal(self._samples, beam)
            self._known[beam] = np.log([found.rate_DN_per_mAs, found.gain_DN, found.kerma_uGy_per_mAs])
        return self._known[beam]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Candidate:
    """What could be measured: its logarithms over the draws, seen (datum, draw), and their noise (datum, datum)."""

    kind: str
    setting: Setting
    steps: tuple[Filter, ...] = ()
    seen: Array
    noise: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class _Predictions:
    """Logarithms of level, noise and kerma at each beam of the grid in turn, less their means (3 beams, draw).

    floor: (3 beams,) variance that stays whatever is measured.
    """

    grid: list[_Beam]
    logs: Array
    floor: Array

    def half_width(self, candidate: _Candidate | None = None) -> Array:
        """Half width of each number's 95 % interval, relative (3 beams,), now or once the candidate is measured."""
        variance = np.mean(self.logs**2, axis=1)
        if candidate is not None:
            draws = self.logs.shape[1]
            seen = candidate.seen - candidate.seen.mean(axis=1, keepdims=True)
            cross = self.logs @ seen.T / draws
            own = seen @ seen.T / draws + candidate.noise + _RIDGE * np.eye(len(candidate.noise))
            gained = np.sum(cross * np.linalg.solve(own, cross.T).T, axis=1)
            variance = np.maximum(variance - gained, 0.0)
        return np.asarray(Z95 * np.sqrt(variance + self.floor))


def _predictions(
    logs: _Logarithms, measured: Sequence[Level], every_kV: Sequence[float], posterior: SpectralPosterior
) -> _Predictions:
    """What shall be known: beams that were not measured, of all voltages behind a few filters."""
    known = _beams(measured)
    grid = [
        (kV, filters)
        for kV in every_kV
        for filters in _stacks(posterior, _DESIGN_PLATES)
        if (kV, frozenset(map(str, filters))) not in known and _passes(filters, kV)
    ]
    rows = []
    for kV, filters in grid:
        rate, gain, kerma = logs(kV, filters)
        rows += [rate, 0.5 * (rate + gain), kerma]
    values = np.array(rows)
    level_sd, gain_sd = posterior.level_discrepancy, posterior.gain_discrepancy
    floor = np.tile([level_sd**2, 0.25 * (level_sd**2 + gain_sd**2), level_sd**2], len(grid))
    return _Predictions(grid=grid, logs=values - values.mean(axis=1, keepdims=True), floor=floor)


def _candidates(
    twin: Twin,
    logs: _Logarithms,
    measured: Sequence[Level],
    every_kV: Sequence[float],
    posterior: SpectralPosterior,
) -> list[_Candidate]:
    """Flats of new beams, readings of dose behind the filters at hand, and wedges at the beams that were measured."""
    known = _beams(measured)
    level_sd, gain_sd = posterior.level_discrepancy, posterior.gain_discrepancy
    rate_noise = _median_relative_sd([level.rate_DN_per_mAs for level in measured])
    gain_noise = _median_relative_sd([level.photon_transfer_slope_DN for level in measured])

    def exposed(kV: float, filters: tuple[Filter, ...]) -> Setting | None:
        return _exposed(twin, kV, filters, float(np.exp(np.median(logs(kV, filters)[_LEVEL]))))

    found = []
    for kV in every_kV:
        for filters in _stacks(posterior, _PLATES):
            if (kV, frozenset(map(str, filters))) in known or not _passes(filters, kV):
                continue
            setting = exposed(kV, filters)
            if setting is not None:
                noise = np.array([math.hypot(rate_noise, level_sd), math.hypot(gain_noise, gain_sd)]) ** 2
                found.append(
                    _Candidate(kind="flats", setting=setting, seen=logs(kV, filters)[:2], noise=np.diag(noise))
                )
    for kV in every_kV:
        for filters in _stacks(posterior):
            setting = exposed(kV, filters)
            if _passes(filters, kV) and setting is not None:
                variance = np.array([[_DOSE_SD**2 + level_sd**2]])
                found.append(_Candidate(kind="dose", setting=setting, seen=logs(kV, filters)[2:], noise=variance))
    steps = tuple(Filter(material="Al", thickness_mm=mm) for mm in _WEDGE_MM)
    for level in measured:
        kV, filters = float(level.kV or 0.0), level.filters
        setting = exposed(kV, filters)
        if setting is None:
            continue
        behind = np.array([logs(kV, (*filters, step))[_LEVEL] - logs(kV, filters)[_LEVEL] for step in steps])
        of_thickness = WEDGE_THICKNESS.sd * behind.mean(axis=1)
        noise = np.outer(of_thickness, of_thickness) + (_WEDGE_SD**2 + level_sd**2) * np.eye(len(steps))
        found.append(_Candidate(kind="wedge", setting=setting, steps=steps, seen=behind, noise=noise))
    return found


def _beams(measured: Sequence[Level]) -> set[tuple[float, frozenset[str]]]:
    """kV and filters, in any order, of the measured levels."""
    return {(float(level.kV or 0.0), frozenset(map(str, level.filters))) for level in measured}


def _stacks(posterior: SpectralPosterior, plates: Sequence[str] = ()) -> list[tuple[Filter, ...]]:
    """Filters that were calibrated, and plates that anyone has."""
    return sorted({filters_from_text(text) for text in (*posterior.calibrated_filters, *plates)}, key=str)


def voltages_within_reach(measured: Sequence[float], anode: str) -> tuple[float, ...]:
    """Round tube voltages (kV) within reach: the measured ones, the middle of the widest gap, above, and below a single one."""
    highest = MAXIMUM_KV_OF_ANODE.get(anode, 300.0)
    found = set(measured)
    if len(measured) > 1:
        low, high = max(pairwise(measured), key=lambda pair: math.log(pair[1] / pair[0]))
        middle = 5.0 * round(math.sqrt(low * high) / 5.0)
        if low < middle < high:
            found.add(middle)
    else:
        found.add(max(5.0 * round(0.6 * measured[0] / 5.0), MINIMUM_KV))
    found.add(min(10.0 * round(_REACH * measured[-1] / 10.0), highest))
    return tuple(sorted(found))


def _passes(filters: tuple[Filter, ...], kV: float) -> bool:
    """Whether a stack leaves a beam: a tenth of a per cent at 0.7 kV, in keV."""
    for layer in filters:
        material_from_name(layer.material)
    return float(transmission(filters, np.array([max(0.7 * kV, 2.0)]))[0]) > 1e-3


def _median_relative_sd(estimates: Sequence[Estimate | None]) -> float:
    known = [item for item in estimates if item is not None and item.value > 0]
    return float(np.median([item.sd / item.value for item in known]))


def _exposed(twin: Twin, kV: float, filters: tuple[Filter, ...], rate_DN_per_mAs: float) -> Setting | None:
    """The setting that brings a beam to the usual signal of the measured flats, or None where the tube cannot.

    Args:
        twin: with the flats' signals, loads and exposures in its evidence.
        kV, filters: the beam.
        rate_DN_per_mAs: of the beam, at 1 m and on 1 mm2.
    """
    flats = [
        (flat.signal_DN, flat.exposure_ms, 1000.0 * flat.load_mAs / flat.exposure_ms * flat.kV)
        for flat in measured_flats(twin)
        if flat.load_mAs and flat.exposure_ms and flat.kV
    ]
    if not flats:
        return None
    signals, exposures, powers = (list(column) for column in zip(*flats, strict=True))
    power_W = max(powers)
    if twin.instrument.maximum_power_w is not None:
        power_W = min(power_W, twin.instrument.maximum_power_w)
    distance = twin.instrument.source_detector_mm or 1000.0
    pitch = twin.instrument.pixel_mm or 1.0
    rate = rate_DN_per_mAs * (1000.0 / distance) ** 2 * pitch**2
    per_ms = rate * power_W / kV / 1000.0
    # the belt fixes how long lines are exposed
    longest_ms = max(exposures) * (1.0 if twin.instrument.detector in ("line", "tdi") else _LONGEST)
    exposure_ms = float(np.clip(np.median(signals) / per_ms, min(exposures), longest_ms))
    if per_ms * exposure_ms < _DIMMEST * min(signals):
        return None
    # a bright beam at the shortest exposure takes less power
    power_W *= min(1.0, max(signals) / (per_ms * exposure_ms))
    rounded_ms = float(np.clip(float(f"{exposure_ms:.2g}"), min(exposures), longest_ms))
    return Setting(kV=kV, power_W=float(f"{power_W:.3g}"), exposure_ms=rounded_ms, filters=filters)


def _sentence(kind: str, setting: Setting, steps: tuple[Filter, ...], shrinks_to: float, dose_shrinks_to: float) -> str:
    behind = f"behind {text_from_filters(setting.filters)}" if setting.filters else "without filter"
    percent = f"{100.0 * shrinks_to:.0f} %"
    if kind == "dose":
        return (
            f"A reading of air kerma (to {100.0 * _DOSE_SD:g} %) at {setting.kV:g} kV {behind} ({setting}): it would take the"
            f" intervals of other settings to {percent} of their width, those of doses to {100.0 * dose_shrinks_to:.0f} %"
        )
    if steps:
        thicknesses = ", ".join(f"{step.thickness_mm:g}" for step in steps)
        return (
            f"A wedge of {thicknesses} mm {steps[0].material} at {setting.kV:g} kV {behind}: it would take the intervals"
            f" of other settings to {percent} of their width"
        )
    return (
        f"Flats at {setting.kV:g} kV {behind} ({setting}): they would take the intervals of other settings to {percent}"
        " of their width"
    )
