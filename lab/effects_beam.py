"""Effects of tube, filters and object: what the beam is before it reaches the scintillator."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ..acquisition.setting import Filter
from .effect import EffectLaw, EffectRequest, Site
from .effects_detector import planted
from .line import Planted
from .system import LabSystem


def _kv_error(request: EffectRequest, site: Site) -> Planted:
    def change(system: LabSystem) -> LabSystem:
        true = (1.0 + system.kV_offset_percent / 100.0) * (1.0 + request.strength / 100.0)
        return replace(system, kV_offset_percent=100.0 * (true - 1.0))

    return _told(request, "the tube's true voltage over the set one", {}, system=change)


def _filtration_error(request: EffectRequest, site: Site) -> Planted:
    layer = Filter(material="Al", thickness_mm=request.strength)

    def change(system: LabSystem) -> LabSystem:
        return replace(system, inherent_filtration=(*system.inherent_filtration, layer))

    return _told(request, "one more layer of aluminium", {}, system=change)


def _output_drift(request: EffectRequest, site: Site) -> Planted:
    rng = site.rng
    duration_s = site.plan.duration_s(site.system.readout_ms)
    slow_s, quick_s = duration_s * float(rng.uniform(0.3, 1.2)), float(np.exp(rng.uniform(math.log(3), math.log(40))))
    phases = rng.uniform(0.0, 2.0 * math.pi, size=2)
    shares = rng.dirichlet([4.0, 3.0, 2.0])
    jitter_seed = int(rng.integers(2**62))
    amplitude = np.sqrt(shares)

    def wave(clock_s: float) -> float:
        jitter = np.random.default_rng([jitter_seed, round(clock_s * 1e4)]).standard_normal()
        return float(
            amplitude[0] * math.sqrt(2.0) * math.sin(2.0 * math.pi * clock_s / slow_s + phases[0])
            + amplitude[1] * math.sqrt(2.0) * math.sin(2.0 * math.pi * clock_s / quick_s + phases[1])
            + amplitude[2] * jitter
        )

    # Over the frames of this session the deviations have mean 0 and the root mean square that was asked for.
    moments = np.array([wave(clock_s) for clock_s in _sampled_clock(site)])
    mean, spread = float(moments.mean()), float(moments.std())

    def load(clock_s: float) -> float:
        return 1.0 + request.strength / 100.0 * (wave(clock_s) - mean) / spread

    return _told(
        request,
        "two slow oscillations of cooling and supply, and a jitter from frame to frame",
        {"periods_s": [slow_s, quick_s], "shares_of_variance": [float(share) for share in shares]},
        load=load,
    )


def _sampled_clock(site: Site) -> list[float]:
    """When every frame of the session begins (s)."""
    clock_s, times = 0.0, []
    for take in site.plan.takes:
        clock_s += take.pause_s
        interval_s = (take.setting.exposure_ms + site.system.readout_ms) / 1000.0
        for _ in range(take.frames * take.setting.averaged):
            if take.kind in ("flat", "object"):
                times.append(clock_s)
            clock_s += interval_s
    return times


def _told(request: EffectRequest, law: str, parameters: dict[str, Any], **hooks: Any) -> Planted:
    return planted(request, BEAM_UNITS[request.id], law, parameters, **hooks)


_Build = Callable[[EffectRequest, Site], Planted]


def _law(name: str, title: str, unit: str, span: tuple[float, float], build: _Build, **more: Any) -> EffectLaw:
    since = more.pop("since", "always")
    return EffectLaw(id=name, title=title, unit=unit, low=span[0], high=span[1], since=since, build=build, **more)


BEAM_LAWS: tuple[EffectLaw, ...] = (
    _law("kv_error", "a tube voltage that changed", "%", (0.5, 5.0), _kv_error, since="calibration", signed=True),
    _law("filtration_error", "more filtration", "mm Al", (0.03, 1.0), _filtration_error, since="calibration"),
    _law("output_drift", "an output that drifts", "%", (0.1, 3.0), _output_drift),
)
BEAM_UNITS = {law.id: law.unit for law in BEAM_LAWS}
