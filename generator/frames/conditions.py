"""What a session states of effects' parameters that are not fitted, such as its length."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from ...errors import InputError
from ..effects import AppliedEffect, effect_of
from ..line.series_request import SeriesRequest
from ..line.spectral_signal import mean_signal_energy_keV
from ..line.twin import Twin
from .line_model import LineModel
from .model_cache import ModelCache


def session_conditions(requests: Sequence[SeriesRequest], *, readout_ms: float | None = None) -> dict[str, float]:
    """What a session states of the effects' parameters that are not fitted: name -> value, units in the names.

    session_s: from the first exposure to the last. longest_exposure_ms: of the darks, or of all series. calibrated_s: when
    the darks that calibrate were taken, on average. after_s: length of the exposure before the first `afterglow` series;
    left out where there is none.

    Args:
        requests: the series of the session in order of time.
        readout_ms: of the detector, for series that do not state their frame interval.
    """
    if not requests:
        return {}
    ends = [item.start_s + _length_s(item, readout_ms) for item in requests]
    darks = [item for item in requests if item.kind == "dark"]
    longest = max(item.exposure_ms for item in darks or requests)
    found = {"session_s": max(1.0, *ends), "longest_exposure_ms": max(longest, 0.01)}
    calibrating = [
        0.5 * (item.start_s + end)
        for item, end in zip(requests, ends, strict=True)
        if item.kind == "dark" and not item.after_calibration
    ]
    if calibrating:
        found["calibrated_s"] = max(sum(calibrating) / len(calibrating), 0.0)
    for number, item in enumerate(requests):
        before = (*requests[:number], *item.previous)[-1:]
        if item.kind == "afterglow" and before and before[0].beam_on:
            found["after_s"] = max(_length_s(before[0], readout_ms), 1e-3)
            break
    return found


def beam_conditions(
    twin: Twin, requests: Sequence[SeriesRequest], *, cache: ModelCache | None = None
) -> dict[str, float]:
    """What a session's beams say of the effects' parameters that are not fitted.

    reference_keV: geometric mean, over the beams that objects were measured with, of the mean energy of the open beam's signal;
    left out where no such beam is known.

    Args:
        twin: with a spectral part, or nothing is known.
        requests: the series of the session.
        cache: as in `LineModel`.
    """
    line = LineModel(twin, effects=(), use_measured_level=False, cache=ModelCache() if cache is None else cache)
    found: dict[tuple[object, ...], float] = {}
    for item in requests:
        if item.kind != "object" or item.setting is None or (item.setting.kV, item.setting.filters) in found:
            continue
        beam = replace(item, kind="flat", thickness_mm=None, displacement_px=(0.0, 0.0), previous=())
        try:
            light = line.light(beam).projection
        except InputError:
            continue
        if light is not None and light.weights is not None and light.energies_keV is not None:
            found[item.setting.kV, item.setting.filters] = mean_signal_energy_keV(light.weights[0], light.energies_keV)
    if not found:
        return {}
    return {"reference_keV": math.exp(sum(map(math.log, found.values())) / len(found))}


def _length_s(request: SeriesRequest, readout_ms: float | None) -> float:
    """Of a series, from its first exposure's begin to its last one's end."""
    return request.frames * request.exposures_per_frame * request.interval_s(readout_ms)


def with_conditions(effect: AppliedEffect, conditions: Mapping[str, float]) -> AppliedEffect:
    """The effect with those of `conditions` that are parameters of it, where it does not state them itself."""
    names = {item.name for item in effect_of(effect).parameters}
    known = {name: value for name, value in conditions.items() if name in names}
    return replace(effect, parameters={**known, **effect.parameters})
