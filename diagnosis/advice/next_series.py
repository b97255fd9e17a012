"""Measurements that a session lacks: drawn with the forward model, and how far each would set two explanations apart.

What isolates the effects of the catalogue is planned with the session's own settings and materials (beam-off frames, darks,
edges and slabs at two distances, discs, a wedge, another voltage, a filter, exposure times, the panel turned), measured
with the twin, and joined to what the session holds. Of two explanations that tie, either is taken as true and the other's
strengths are fitted again: what is left of their difference, in standard deviations, says which measurement to take.

Validity: frames are the twin's, so that what the line does beyond both explanations is not in them; what calibration
absorbs of effects that were always there is left out.
"""

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.acquisition_io import open_acquisition, write_acquisition
from ...acquisition.setting import Filter, Setting, text_from_filters
from ...errors import InputError, RaytwinError
from ...generator.frames.conditions import with_conditions
from ...generator.frames.line_model import LineModel
from ...generator.line.series_request import SeriesRequest
from ...generator.line.twin import Twin
from ..arrays import BoolArray, FloatArray, IndexArray
from ..inference.observed import Point
from ..model.changes import Variant
from ..problem.assemble import build_problem
from ..problem.problem import Problem
from .plan import Proposal, length

FRAMES = 20  # of each series that is planned
Explanation = Sequence[Point]  # with curves of the problem

_OPAQUE = ("W", 3.0)  # mm
_TILT = math.radians(4.0)  # of an edge against the pixels: IEC 62220-1 has 1.5 to 3 degrees, ISO 12233 has 5
_SLAB_MM = 20.0
_STEPS_MM = {"pmma": (0.0, 3.0, 8.0, 16.0, 30.0), "Al": (0.0, 0.5, 1.2, 2.5)}
_FILTER = Filter(material="Cu", thickness_mm=0.2)
_SHARES_OF_EXPOSURE = (1.0, 0.5, 0.25, 0.1)
_OTHER_VOLTAGE = 0.62  # of the one voltage that a session has, or its inverse
_LEAST_KV = 30.0
_LATER_S, _PAUSE_S = 60.0, 5.0  # after the session's last series; between planned ones
_STRENGTH_FREE = 10.0  # standard deviation of a competitor's strength over itself, before looking


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedSeries:
    """One series to take: kind, setting (None: beam off), exposure_ms, scene (empty: none), source_object_mm, panel_rotation_deg."""

    kind: str
    setting: Setting | None
    exposure_ms: float
    scene: str = ""
    source_object_mm: float | None = None
    panel_rotation_deg: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as an acquisition file's attributes are called; what is not set is left out."""
        told: dict[str, Any] = {"kind": self.kind, "exposure_ms": self.exposure_ms, "frames": FRAMES}
        if self.setting is not None:
            told |= {"kV": self.setting.kV, "filter": text_from_filters(self.setting.filters)}
            told |= {"current_mA": self.setting.current_mA, "power_W": self.setting.power_W}
        told |= {"scene": self.scene or None, "source_object_mm": self.source_object_mm}
        told |= {"panel_rotation_deg": self.panel_rotation_deg or None}
        return {name: value for name, value in told.items() if value is not None}


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """Something to measure: name, what it is in words, its series in order of time."""

    name: str
    text: str
    series: tuple[PlannedSeries, ...]


_Scene = tuple[str, dict[str, FloatArray]]  # kind, and thickness maps (row, column), mm, by material


@dataclass(frozen=True, slots=True)
class _Line:
    """What a session says of how it measures: a usual setting of each voltage, the twin, distances, the product's material."""

    settings: Mapping[float, Setting]
    twin: Twin
    usual_mm: float
    other_mm: float
    material: str


def _line_of(problem: Problem) -> _Line | None:
    """None where no series states tube load and distances."""
    twin = problem.base
    instrument = twin.instrument
    settings: dict[float, tuple[tuple[bool, float], Setting]] = {}
    material = "water_liquid"
    for view in problem.views:
        request = view.session.request
        setting = request.setting
        if request.scene_kind in ("slab", "product") and request.thickness_mm:
            material = next(iter(request.thickness_mm))
        if not request.beam_on or setting is None or setting.tube_load_mAs is None:
            continue
        rank = (request.kind == "object", request.exposure_ms)
        if setting.kV not in settings or rank > settings[setting.kV][0]:
            settings[setting.kV] = (rank, replace(setting, belt_speed_mm_s=None, frame_interval_ms=None))
    if not settings or instrument.source_detector_mm is None or instrument.source_object_mm is None:
        return None
    to_panel = instrument.source_detector_mm
    gap = to_panel - instrument.source_object_mm
    # the other distance: close to the panel, or, where the usual one is, half-way to the source
    other = to_panel - gap / 3.0 if gap > 0.15 * to_panel else 0.6 * to_panel
    return _Line(
        settings={kV: setting for kV, (_, setting) in sorted(settings.items())},
        twin=twin,
        usual_mm=instrument.source_object_mm,
        other_mm=other,
        material=material,
    )


def _scenes(shape: tuple[int, int], material: str) -> dict[str, _Scene]:
    """Name -> kind and thickness maps (row, column), mm."""
    rows, columns = shape
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    y, x = y - 0.5 * (rows - 1), x - 0.5 * (columns - 1)
    half = 0.5 * min(rows, columns)
    name, opaque_mm = _OPAQUE

    def opaque(inside: BoolArray) -> dict[str, FloatArray]:
        return {name: np.where(inside, opaque_mm, 0.0)}

    field = (np.abs(y) < 0.84 * half) & (np.abs(x) < 0.84 * half)
    wedge = {}
    for steps, along in zip(_STEPS_MM.items(), (x, y), strict=True):
        number = np.clip(((along / (0.84 * half) + 1.0) / 2.0 * len(steps[1])).astype(int), 0, len(steps[1]) - 1)
        wedge[steps[0]] = np.where(field, np.array(steps[1])[number], 0.0)
    return {
        "edge x": ("edge", opaque(x * math.cos(_TILT) + y * math.sin(_TILT) > 0)),
        "edge y": ("edge", opaque(y * math.cos(_TILT) + x * math.sin(_TILT) > 0)),
        "small disc": ("disc", opaque(np.hypot(x, y) < 0.15 * half)),
        "large disc": ("disc", opaque(np.hypot(x, y) < 0.5 * half)),
        "slab": ("slab", {material: np.full(shape, _SLAB_MM)}),
        "wedge": ("wedge", wedge),
    }


def _as_bright(setting: Setting, as_: Setting, twin: Twin) -> Setting | None:
    """The setting with the current at which the open field is as bright as another's; None where tube or twin cannot."""

    def level(one: Setting) -> float:
        request = SeriesRequest(kind="flat", setting=one, frames=1, exposure_ms=one.exposure_ms)
        return float(np.mean(LineModel(twin, use_measured_level=False).expect(request).signal_DN))

    try:
        found = setting.with_current_times(level(as_) / max(level(setting), 1e-9))
    except InputError:
        return None
    limits = twin.instrument
    power = found.power_W if found.power_W is not None else found.kV * (found.current_mA or 0.0)
    if limits.maximum_power_w is not None and power > limits.maximum_power_w:
        found = found.with_current_times(limits.maximum_power_w / power)
    if limits.maximum_kV is not None and found.kV > limits.maximum_kV:
        return None
    return found


def _exposed(setting: Setting, share: float) -> Setting:
    """The setting at a share of its exposure time."""
    return replace(setting, exposure_ms=share * setting.exposure_ms)


def measurements_lacking(problem: Problem) -> tuple[Measurement, ...]:
    """What a session could still measure of that which isolates effects; empty where it states no tube load or distances."""
    line = _line_of(problem)
    if line is None:
        return ()
    requests = [view.session.request for view in problem.views]
    longest = max(item.exposure_ms for item in requests)
    voltages = list(line.settings)
    high = line.settings[voltages[-1]]

    def held(kind: str) -> set[float]:
        """Distances at which the session has a sort of object."""
        return {round(item.source_object_mm or 0.0, 1) for item in requests if item.scene_kind == kind}

    def taken(kind: str, settings: Sequence[Setting], **where: Any) -> list[PlannedSeries]:
        return [PlannedSeries(kind=kind, setting=one, exposure_ms=one.exposure_ms, **where) for one in settings]

    def shots(scenes: Sequence[str], distances: Sequence[float], settings: Sequence[Setting]) -> list[PlannedSeries]:
        places = product(scenes, distances)
        return [one for scene, mm in places for one in taken("object", settings, scene=scene, source_object_mm=mm)]

    def far(kind: str) -> list[float]:
        """Distances that make two with those that the session has."""
        known = held(kind)
        lacking = [one for one in (line.usual_mm, line.other_mm) if round(one, 1) not in known]
        return lacking[:1] if known else lacking

    every, usual, edges = list(line.settings.values()), [line.usual_mm], ("edge x", "edge y")
    kVs = " and ".join(f"{kV:g}" for kV in voltages) + " kV"
    found: list[Measurement] = []

    def add(name: str, text: str, series: Sequence[PlannedSeries]) -> None:
        found.append(Measurement(name=name, text=text, series=tuple(series)))

    if not any(item.kind == "afterglow" for item in requests):
        off = PlannedSeries(kind="afterglow", setting=None, exposure_ms=high.exposure_ms)
        text = f"{FRAMES} frames with the beam off straight after flats at {high.kV:g} kV"
        add("afterglow", text, [*taken("flat", [high]), off])
    if sum(item.kind == "dark" and item.after_calibration for item in requests) < 2:
        dark = PlannedSeries(kind="dark", setting=None, exposure_ms=longest)
        add("darks", f"darks of {longest:g} ms between the other series", [dark, dark])
    if not held("disc"):
        add("discs", f"opaque discs of two sizes at {kVs}", shots(("small disc", "large disc"), usual, every))
    if len(held("edge")) < 2:
        places = " and ".join(f"{one:.0f} mm" for one in far("edge"))
        text = f"an opaque edge in two directions, {places} from the source, at {kVs}"
        add("edges", text, shots(edges, far("edge"), every))
    if len({item.exposure_ms for item in requests if item.scene_kind == "edge"}) < 2:
        # equal charge: that of the shortest
        equal = [_exposed(high.with_current_times(0.25 / share), share) for share in (1.0, 0.5, 0.25)]
        text = f"an opaque edge at {', '.join(f'{one.exposure_ms:g}' for one in equal)} ms of equal charge"
        add("timed edges", text, shots(edges, usual, equal))
    if len(held("slab")) < 2:
        places = " and ".join(f"{one:.0f} mm" for one in far("slab"))
        text = f"a slab of {_SLAB_MM:g} mm {line.material}, {places} from the source"
        add("slabs", text, shots(["slab"], far("slab"), every))
    if not held("wedge"):
        add("wedge", f"a wedge of known steps (PMMA, Al) at {kVs}", shots(["wedge"], usual, every))
    others = [_as_bright(replace(high, kV=kV), high, line.twin) for kV in _other_voltages(voltages)]
    other = next((one for one in others if one is not None), None)
    if len(voltages) == 1 and other is not None:
        more = [*taken("flat", [other]), *shots(["wedge", "edge x"], usual, [other])]
        add("voltage", f"flats, a wedge of known steps and an opaque edge at {other.kV:g} kV", more)
    stacks: dict[float, set[str]] = {}
    for item in requests:
        if item.kind == "flat" and item.setting is not None:
            stacks.setdefault(item.setting.kV, set()).add(text_from_filters(item.setting.filters))
    if all(len(one) < 2 for one in stacks.values()):
        behind = [_as_bright(replace(one, filters=(*one.filters, _FILTER)), one, line.twin) for one in every]
        filtered = [one for one in behind if one is not None]
        if filtered:
            add("filter", f"flats behind {_FILTER} more at {kVs}", taken("flat", filtered))
    if len({item.exposure_ms for item in requests if item.kind == "flat"}) < 3:
        levels = [_exposed(one, share) for one in every for share in _SHARES_OF_EXPOSURE]
        add("exposures", "flats at four exposure times and one current", taken("flat", levels))
    if not any(item.panel_rotation_deg % 360.0 for item in requests):
        add("turned", "flats with the panel turned by 180 degrees", taken("flat", every, panel_rotation_deg=180.0))
    return tuple(found)


def _other_voltages(voltages: Sequence[float]) -> list[float]:
    """A lower and a higher voltage than those of the session, whole kV."""
    lower, higher = _OTHER_VOLTAGE * min(voltages), max(voltages) / _OTHER_VOLTAGE
    return [float(round(kV)) for kV in ((lower, higher) if lower >= _LEAST_KV else (higher,))]


def best_measurement(
    problem: Problem, first: Explanation, second: Explanation, *, rng: np.random.Generator
) -> Proposal | None:
    """The measurement that a session lacks and that would set two explanations furthest apart; None where none can be planned."""
    line, planned = _line_of(problem), measurements_lacking(problem)
    if line is None or not planned:
        return None
    wanted = {
        (point.effect, point.curve.variant.name): _fixed(problem, point.curve.variant, point.strength)
        for point in (*first, *second)
    }
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "planned.h5"
            begin_s = max(view.session.request.start_s for view in problem.views) + _LATER_S
            members = _write(path, line, planned, begin_s, rng)
            if not members:
                return None  # the twin can draw none of them: a repeat or the table of what isolates effects is named instead
            with open_acquisition(path) as acquisition:
                taken = build_problem(
                    acquisition,
                    problem.base,
                    variants=list(wanted.values()),
                    calibrated_elsewhere=True,
                    side=problem.side,
                ).released()
    except RaytwinError:
        return None  # the twin cannot draw them: a repeat or the table of what isolates effects is named instead
    now = _separation(problem, None, np.zeros(0, dtype=np.intp), first, second)
    proposals = []
    for measurement in (item for item in planned if item.name in members):
        names = members[measurement.name]
        rows = np.array(
            [index for index, number in enumerate(taken.series_of) if taken.views[number].session.name in names],
            dtype=np.intp,
        )
        then = _separation(problem, taken, rows, first, second) if rows.size else now
        proposals.append(
            Proposal(
                what=f"measure {measurement.text}",
                name=measurement.name,
                measured=tuple(item.as_dict() for item in measurement.series),
                separation=now,
                separation_then=then,
            )
        )
    return max(proposals, key=lambda item: item.separation_then)


def _fixed(problem: Problem, variant: Variant, strength: float) -> Variant:
    """A variant at one strength, with what the session says of its other parameters."""
    applied = with_conditions(variant.applied(strength), problem.conditions)
    parameters = {name: value for name, value in applied.parameters.items() if name != "strength"}
    return replace(variant, parameters=parameters, strengths=(strength,))


def _write(
    path: Path, line: _Line, planned: Sequence[Measurement], begin_s: float, rng: np.random.Generator
) -> dict[str, frozenset[str]]:
    """Measure with the twin from a time in the session on; the names of each measurement's series, of those it can draw."""
    scenes = _scenes(line.twin.maps.shape, line.material)
    members: dict[str, frozenset[str]] = {}
    clock_s, number = begin_s, 0
    with write_acquisition(path, line.twin.instrument) as file:
        for name, (kind, maps) in scenes.items():
            file.add_scene(name, kind=kind, thickness_mm=maps)
        for measurement in planned:
            try:
                drawn, clock_s = _drawn(line, measurement, scenes, clock_s, rng)
            except RaytwinError:
                continue
            names = []
            for item, request, frames in drawn:
                number += 1
                names.append(f"{number} {measurement.name}")
                file.add_series(
                    names[-1],
                    kind=item.kind,
                    setting=request.setting,
                    exposure_ms=None if request.setting is not None else item.exposure_ms,
                    dtype=np.float32,
                    frames=frames,
                    scene=item.scene,
                    source_object_mm=item.source_object_mm,
                    panel_rotation_deg=item.panel_rotation_deg or None,
                    time_s=request.start_s + _step_s(line, request) * np.arange(FRAMES),
                )
            members[measurement.name] = frozenset(names)
    return members


def _drawn(
    line: _Line, measurement: Measurement, scenes: Mapping[str, _Scene], clock_s: float, rng: np.random.Generator
) -> tuple[list[tuple[PlannedSeries, SeriesRequest, NDArray[np.float32]]], float]:
    """Series of a measurement with their frames (frame, row, column), DN, begun at a time in the session; and when it ends."""
    instrument = line.twin.instrument
    found = []
    previous: tuple[SeriesRequest, ...] = ()
    for item in measurement.series:
        scene = scenes.get(item.scene)
        request = SeriesRequest(
            kind=item.kind,
            setting=item.setting,
            frames=FRAMES,
            exposure_ms=item.exposure_ms,
            start_s=clock_s,
            thickness_mm=None if scene is None else scene[1],
            scene_kind=None if scene is None else scene[0],
            source_object_mm=item.source_object_mm or instrument.source_object_mm,
            source_detector_mm=instrument.source_detector_mm,
            panel_rotation_deg=item.panel_rotation_deg,
            previous=previous,
        )
        frames = np.stack(list(LineModel(line.twin, use_measured_level=False).sample(request, rng=rng)))
        found.append((item, request, frames))
        clock_s += FRAMES * _step_s(line, request)
        if item.kind == "flat":
            previous = (replace(request, previous=()),)
        if measurement.name != "afterglow":
            clock_s += _PAUSE_S
    return found, clock_s + _PAUSE_S


def _step_s(line: _Line, request: SeriesRequest) -> float:
    """Time from frame to frame of a series, s."""
    return request.interval_s(line.twin.instrument.readout_ms) * request.exposures_per_frame


def _separation(
    problem: Problem, taken: Problem | None, rows: IndexArray, first: Explanation, second: Explanation
) -> float:
    """Standard deviations between two explanations, in the session and the `rows` taken, strengths of the wrong one refitted."""

    def response(point: Point) -> FloatArray:
        own = point.curve.response(point.strength)
        if taken is None:
            return own
        key = point.effect, point.curve.variant.name
        there = next((item for item in taken.curves if (item.effect, item.variant.name) == key), None)
        more = np.zeros(len(rows)) if there is None else there.response(point.strength)[rows]
        return np.concatenate([own, more])

    ones, others = ([response(point) for point in explanation] for explanation in (first, second))
    apart = np.sum(ones, axis=0) - np.sum(others, axis=0)
    factors, blocks = problem.factors, problem.blocks
    if taken is not None:
        factors = _joined(problem, taken, rows)
        blocks = np.concatenate([blocks, taken.blocks[rows] + int(blocks.max()) + 1])
    # the strengths of the explanation that is wrong are free
    free = (np.concatenate([factors, _STRENGTH_FREE * np.stack(wrong, axis=1)], axis=1) for wrong in (ones, others))
    return min(length(one, blocks, apart) for one in free)


def _joined(problem: Problem, taken: Problem, rows: IndexArray) -> FloatArray:
    """Factors (probe, factor) of the session's probes and more: what has one name is one nuisance."""
    there = np.asarray(taken.factors[rows], dtype=np.float64)
    used = [index for index in range(there.shape[1]) if np.any(there[:, index])]
    place = {name: index for index, name in enumerate(problem.factor_names)}
    for index in used:
        place.setdefault(taken.factor_names[index], len(place))
    count = problem.factors.shape[0]
    result = np.zeros((count + len(rows), len(place)))
    result[:count, : problem.factors.shape[1]] = problem.factors
    for index in used:
        result[count:, place[taken.factor_names[index]]] = there[:, index]
    return result
