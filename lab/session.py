"""Long sessions: the measurement set that is meant to tell every effect apart, a short one, and products alone.

`full`: darks at every exposure time and in between; ordered flats at five exposure times, two kV, without and with a
known filter; beam-off frames right after an exposure; a two-material wedge at two kV, two gaps and two places; a slab
of the product's material; a slanted edge at two magnifications and two directions, and at three exposure times of equal
signal; opaque discs of two sizes; flats with the panel turned round; products at two exposures. `short`: darks, flats
and products. `products`: averaged darks, averaged flats and products.
"""

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import write_acquisition
from ..acquisition.setting import Filter, Setting
from ..errors import InputError
from ..files import sha256_of_file, whole_file
from .families import sample_system
from .line import Line, Planted
from .objects import (
    BONE_MATERIAL,
    PRODUCT_MATERIAL,
    TURN_DEGREES,
    Scene,
    Slab,
    clear_field_mm,
    pixel_means,
    place_bone,
    place_fillet,
    sample_bone,
    sample_fillet,
    thickness_on_fine_grid,
)
from .phantoms import Disc, Edge, Posed, Wedge
from .system import LabSystem
from .truth import compute_truth, flat_truth

COPPER = (Filter(material="Cu", thickness_mm=0.05),)
EXPOSURES_MS = (10.0, 25.0, 50.0, 75.0, 100.0)
EVALUATION_EXPOSURES_MS = (25.0, 100.0)
SLAB_MM = 20.0
AVERAGED = 50
MAXIMUM_POWER_W = 1000.0
BRIGHTEST = 1.3  # output times conversion over the usual
OUTPUT_SPREAD_PERCENT = 0.03  # of the tube, from series to series at one setting
_SMALL_FRAME_PIXELS = 256 * 256


@dataclass(frozen=True, slots=True, kw_only=True)
class Geometry:
    """Distances, pitch and tube voltages of a session.

    Fields: name; pixel_mm; source_detector_mm; far_mm and near_mm: source-object distances with the wide gap (the
    instrument's own) and with the object close to the detector; power_W: (kV, with the known filter) -> W at which
    100 ms bring about 38 000 DN in the typical system.
    """

    name: str
    pixel_mm: float
    source_detector_mm: float
    far_mm: float
    near_mm: float
    power_W: Mapping[tuple[float, bool], float]

    @property
    def kVs(self) -> tuple[float, ...]:
        """The tube voltages, low first."""
        return tuple(sorted({kV for kV, _ in self.power_W}))


GEOMETRIES: dict[str, Geometry] = {
    # Fine pixels, one voltage below the K edges of the scintillator: for blur and fluorescence.
    "fine": Geometry(
        name="fine",
        pixel_mm=0.12,
        source_detector_mm=400.0,
        far_mm=260.0,
        near_mm=360.0,
        power_W={(30.0, False): 150.0, (30.0, True): 480.0, (60.0, False): 30.0, (60.0, True): 47.0},
    ),
    # Coarse pixels and a wider field: for scatter, glare and heel.
    "coarse": Geometry(
        name="coarse",
        pixel_mm=0.4,
        source_detector_mm=1000.0,
        far_mm=650.0,
        near_mm=900.0,
        power_W={(40.0, False): 38.0, (40.0, True): 82.0, (90.0, False): 9.6, (90.0, True): 12.4},
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionTake:
    """One series of a session.

    Fields: name; kind; setting (of a dark or afterglow: exposure and `averaged` count); frames; role; scene (a name in
    the plan, empty: open field); source_object_mm (None: the instrument's); panel_rotation_deg; pause_s before it;
    output (of the tube in this series over what was set: tubes do not repeat themselves exactly).
    """

    name: str
    kind: str
    setting: Setting
    frames: int
    role: str | None = None
    scene: str = ""
    source_object_mm: float | None = None
    panel_rotation_deg: float = 0.0
    pause_s: float = 1.0
    output: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionScene:
    """An object on the bench.

    Fields: kind (of the acquisition file); stated (what the file says); true (what stands there); product, bone
    (identifiers), size_mm of the bone.
    """

    kind: str
    stated: Scene
    true: Posed
    product: str = ""
    bone: str = ""
    size_mm: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionPlan:
    """Series in their order in time, and the objects that they show."""

    takes: tuple[SessionTake, ...]
    scenes: Mapping[str, SessionScene] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """How many frames will be stored."""
        return sum(take.frames for take in self.takes)

    def duration_s(self, readout_ms: float) -> float:
        """How long the session takes."""
        return sum(
            take.pause_s + take.frames * take.setting.averaged * (take.setting.exposure_ms + readout_ms) / 1000.0
            for take in self.takes
        )


# Groups of series that may be left out, or taken alone: kinds of objects, and these.
GROUPS = (
    "afterglow",
    "wedge",
    "slab",
    "edge",
    "disc",
    "product",
    "turned",
    "near",
    "open_flats",
    "filtered_flats",
    "middle_exposures",
    "low_kV",
    "high_kV",
)


def groups_of(take: SessionTake, scenes: Mapping[str, SessionScene], geometry: Geometry) -> frozenset[str]:
    """The groups that a series belongs to; darks belong to none and are always taken."""
    found = {scenes[take.scene].kind} if take.scene else set()
    if take.kind in ("dark", "afterglow"):
        return frozenset({take.kind} - {"dark"})
    if take.kind == "flat":
        found.add("turned" if take.panel_rotation_deg else "filtered_flats" if take.setting.filters else "open_flats")
        if take.setting.exposure_ms not in EVALUATION_EXPOSURES_MS:
            found.add("middle_exposures")
    if take.source_object_mm is not None:
        found.add("near")
    found.add("low_kV" if take.setting.kV == geometry.kVs[0] else "high_kV")
    return frozenset(found)


class _Planner:
    """Collects the series and objects of a session; every object lies and is a little otherwise than stated."""

    def __init__(self, rng: np.random.Generator, system: LabSystem, geometry: Geometry, frames: int) -> None:
        self.rng, self.system, self.geometry, self.frames = rng, system, geometry, frames
        self.takes: list[SessionTake] = []
        self.scenes: dict[str, SessionScene] = {}
        self._names: set[str] = set()
        self._scales: dict[str, dict[str, float]] = {}

    def take(self, name: str, kind: str, setting: Setting, frames: int, **more: Any) -> None:
        number, free = 2, name
        while free in self._names:
            free, number = f"{name}_{number}", number + 1
        self._names.add(free)
        output = 1.0 + OUTPUT_SPREAD_PERCENT / 100.0 * float(np.clip(self.rng.standard_normal(), -2.5, 2.5))
        self.takes.append(
            SessionTake(name=free, kind=kind, setting=setting, frames=max(frames, 1), output=output, **more)
        )

    def setting(
        self, kV: float, exposure_ms: float, *, filtered: bool, load: float = 1.0, averaged: int = 1
    ) -> Setting:
        return Setting(
            kV=kV,
            power_W=self.geometry.power_W[kV, filtered] * load,
            exposure_ms=exposure_ms,
            filters=COPPER if filtered else (),
            averaged=averaged,
        )

    def dark(self, exposure_ms: float, frames: int, *, role: str | None, averaged: int = 1) -> None:
        # The voltage stands for nothing: the beam is off.
        setting = Setting(kV=self.geometry.kVs[0], exposure_ms=exposure_ms, averaged=averaged)
        self.take(f"dark_{exposure_ms:g}ms", "dark", setting, frames, role=role)

    def flat(self, setting: Setting, frames: int, *, role: str | None, **more: Any) -> None:
        layers = "_".join(f"{layer.material}{layer.thickness_mm:g}" for layer in setting.filters) or "open"
        turned = "_turned" if more.get("panel_rotation_deg") else ""
        self.take(
            f"flat_{setting.kV:g}kV_{setting.exposure_ms:g}ms_{layers}{turned}",
            "flat",
            setting,
            frames,
            role=role,
            **more,
        )

    def scene(
        self,
        name: str,
        *,
        kind: str,
        stated: Scene,
        source_object_mm: float,
        spread_percent: float,
        piece: str = "",
        **more: Any,
    ) -> str:
        """Put an object on the bench: +-0.2 px off, its layers off by `spread_percent` (one standard deviation).

        The same `piece` has the same layers wherever it is put.
        """
        pixel_mm = self.system.pixel_mm * source_object_mm / self.system.source_detector_mm
        shift_y_mm, shift_x_mm = self.rng.uniform(-0.2, 0.2, size=2) * pixel_mm
        drawn = {
            material: 1.0 + spread_percent / 100.0 * float(np.clip(self.rng.standard_normal(), -2.0, 2.0))
            for material in stated.materials
        }
        scale = self._scales.setdefault(piece or name, drawn)
        true = Posed(scene=stated, shift_y_mm=float(shift_y_mm), shift_x_mm=float(shift_x_mm), scale=scale)
        self.scenes[name] = SessionScene(kind=kind, stated=stated, true=true, **more)
        return name

    def gaps(self) -> tuple[tuple[str, float], ...]:
        return (("far", self.geometry.far_mm), ("near", self.geometry.near_mm))

    def half_field_mm(self) -> float:
        """Half of the smaller side of the field in the plane of the wide gap."""
        pixels = min(self.system.rows, self.system.columns)
        return 0.5 * pixels * self.system.pixel_mm * self.geometry.far_mm / self.system.source_detector_mm

    def add_products(
        self,
        count: int,
        *,
        exposures_ms: Sequence[float],
        frames: int,
        role: str | None,
        bones_mm: Sequence[float] = (),
    ) -> None:
        geometry, with_bone = self.geometry, 0
        height_mm, width_mm = clear_field_mm(self.system)
        reach_mm = 0.45 * min(height_mm, width_mm)
        turns = np.radians([-TURN_DEGREES, 0.0, TURN_DEGREES])
        for number in range(count):
            fillet = sample_fillet(self.rng, name=f"fillet{number + 1:02d}", half_y_mm=reach_mm, half_x_mm=reach_mm)
            extents = np.max([fillet.extent_mm(turn) for turn in turns], axis=0)
            shrink = 0.95 * min(height_mm / 2.0 / extents[0], width_mm / 2.0 / extents[1])
            half_mm = reach_mm * shrink
            # Never thicker than it is wide: small fields see small pieces.
            peak_mm = min(fillet.peak_mm, 1.5 * half_mm)
            product = place_fillet(
                self.rng,
                fillet=replace(fillet, half_y_mm=half_mm, half_x_mm=half_mm, peak_mm=peak_mm),
                system=self.system,
            )
            bone = None
            if number % 4 != 3:
                length_mm = float(self.rng.uniform(0.15, 0.4)) * min(half_mm, 12.0)
                if bones_mm:
                    length_mm = bones_mm[with_bone % len(bones_mm)]
                with_bone += 1
                bone = sample_bone(self.rng, name=f"bone{number + 1:02d}", size_mm=round(length_mm, 2))
                product = place_bone(self.rng, product=product, bone=bone)
            name = self.scene(
                f"product{number + 1}",
                kind="product",
                stated=product,
                source_object_mm=geometry.far_mm,
                spread_percent=0.7,
                product=fillet.name,
                bone="" if bone is None else bone.name,
                size_mm=None if bone is None else bone.size_mm,
            )
            for exposure_ms in exposures_ms:
                for kV in geometry.kVs:
                    self.take(
                        f"{name}_{kV:g}kV_{exposure_ms:g}ms",
                        "object",
                        self.setting(kV, exposure_ms, filtered=True),
                        frames,
                        role=role,
                        scene=name,
                        pause_s=3.0,
                    )


def _plan_full(plan: _Planner, products: int, bones_mm: Sequence[float]) -> None:
    geometry, frames = plan.geometry, plan.frames
    some, few = max(2, round(0.4 * frames)), max(2, round(0.2 * frames))
    low_kV, high_kV = geometry.kVs
    longest_ms = EXPOSURES_MS[-1]
    for exposure_ms in EXPOSURES_MS:
        plan.dark(exposure_ms, frames, role="calibration")
    for kV in geometry.kVs:
        for filtered in (False, True):
            for exposure_ms in EXPOSURES_MS:
                plan.flat(plan.setting(kV, exposure_ms, filtered=filtered), frames, role="calibration")
            plan.dark(longest_ms, few, role="calibration")
    # The panel has been exposed 50 times at its highest level; now the beam goes off, and nothing else changes.
    plan.flat(plan.setting(high_kV, longest_ms, filtered=True), few, role="evaluation")
    afterglow = Setting(kV=high_kV, exposure_ms=longest_ms)
    plan.take(f"afterglow_{longest_ms:g}ms", "afterglow", afterglow, frames, role="evaluation", pause_s=0.0)
    for exposure_ms in EVALUATION_EXPOSURES_MS:
        plan.dark(exposure_ms, some, role="evaluation")
    for kV in geometry.kVs:
        for filtered in (False, True):
            for exposure_ms in EVALUATION_EXPOSURES_MS:
                plan.flat(plan.setting(kV, exposure_ms, filtered=filtered), frames, role="evaluation")
    for kV in geometry.kVs:
        plan.flat(
            plan.setting(kV, longest_ms, filtered=True), some, role="evaluation", panel_rotation_deg=180.0, pause_s=20.0
        )
    half_mm = plan.half_field_mm()

    def objects(name: str, settings: Sequence[Setting], distance_mm: float, count: int) -> None:
        for setting in settings:
            plan.take(
                f"{name}_{setting.kV:g}kV_{setting.exposure_ms:g}ms",
                "object",
                setting,
                count,
                role="evaluation",
                scene=name,
                source_object_mm=None if distance_mm == geometry.far_mm else distance_mm,
                pause_s=3.0,
            )

    usual = [plan.setting(kV, longest_ms, filtered=True) for kV in geometry.kVs]
    thick = (0.0, 3.0, 8.0, 16.0, 30.0), (0.0, 0.5, 1.2, 2.5)
    for gap, distance_mm in plan.gaps():
        for place in ("a", "b"):
            wedge = Wedge(half_mm=0.84 * half_mm, steps_mm={"pmma": thick[0], "Al": thick[1]}, turned=place == "b")
            name = plan.scene(
                f"wedge_{gap}_{place}",
                kind="wedge",
                stated=wedge,
                source_object_mm=distance_mm,
                spread_percent=0.7,
                piece="wedge",
            )
            objects(name, usual, distance_mm, some)
    plan.dark(longest_ms, few, role="evaluation")
    for gap, distance_mm in plan.gaps():
        slab = Slab(layers_mm={PRODUCT_MATERIAL: SLAB_MM})
        name = plan.scene(
            f"slab_{gap}", kind="slab", stated=slab, source_object_mm=distance_mm, spread_percent=0.4, piece="slab"
        )
        objects(name, usual, distance_mm, some)
    equal_signal = [
        plan.setting(high_kV, exposure_ms, filtered=True, load=0.5 * longest_ms / exposure_ms)
        for exposure_ms in (25.0, 50.0, 100.0)
    ]
    low = plan.setting(low_kV, longest_ms, filtered=True)
    for gap, distance_mm in plan.gaps():
        for direction, angle in (("x", 0.0), ("y", math.pi / 2.0)):
            tilt = math.radians(float(plan.rng.uniform(3.0, 5.0)))
            name = plan.scene(
                f"edge_{gap}_{direction}",
                kind="edge",
                stated=Edge(angle=angle + tilt),
                source_object_mm=distance_mm,
                spread_percent=0.0,
            )
            exposures = equal_signal if gap == "far" else equal_signal[-1:]
            objects(name, [*exposures, low], distance_mm, some)
    plan.dark(longest_ms, few, role="evaluation")
    for size, share in (("small", 0.15), ("large", 0.5)):
        name = plan.scene(
            f"disc_{size}",
            kind="disc",
            stated=Disc(radius_mm=share * half_mm),
            source_object_mm=geometry.far_mm,
            spread_percent=0.0,
        )
        objects(name, usual, geometry.far_mm, some)
    plan.add_products(
        products, exposures_ms=(25.0, 100.0), frames=max(2, frames // 10), role="evaluation", bones_mm=bones_mm
    )
    for exposure_ms in EVALUATION_EXPOSURES_MS:
        plan.dark(exposure_ms, some, role="evaluation")


def _plan_short(plan: _Planner, products: int, bones_mm: Sequence[float]) -> None:
    frames = plan.frames
    some = max(2, round(0.4 * frames))
    for exposure_ms in EVALUATION_EXPOSURES_MS:
        plan.dark(exposure_ms, some, role="calibration")
    for role in ("calibration", "evaluation"):
        for kV in plan.geometry.kVs:
            for exposure_ms in EVALUATION_EXPOSURES_MS:
                plan.flat(plan.setting(kV, exposure_ms, filtered=True), frames, role=role)
    plan.add_products(
        products,
        exposures_ms=EVALUATION_EXPOSURES_MS,
        frames=max(2, frames // 10),
        role="evaluation",
        bones_mm=bones_mm,
    )
    for exposure_ms in EVALUATION_EXPOSURES_MS:
        plan.dark(exposure_ms, some, role="evaluation")


def _plan_products(plan: _Planner, products: int, bones_mm: Sequence[float]) -> None:
    for exposure_ms in EVALUATION_EXPOSURES_MS:
        plan.dark(exposure_ms, 1, role="calibration", averaged=AVERAGED)
        for kV in plan.geometry.kVs:
            setting = plan.setting(kV, exposure_ms, filtered=True, averaged=AVERAGED)
            plan.flat(setting, 1, role="calibration")
    plan.add_products(
        products,
        exposures_ms=EVALUATION_EXPOSURES_MS,
        frames=max(2, plan.frames // 10),
        role="evaluation",
        bones_mm=bones_mm,
    )


SESSIONS: dict[str, Callable[[_Planner, int, Sequence[float]], None]] = {
    "full": _plan_full,
    "short": _plan_short,
    "products": _plan_products,
}
SESSION_FRAMES = 50
SESSION_PRODUCTS = {"full": 4, "short": 8, "products": 12}


def session_system(
    seed: int, *, rows: int, columns: int, geometry: Geometry, families: Sequence[str] | None = None
) -> LabSystem:
    """The hidden system of a seed on one of the two benches for long sessions.

    Its powers are those of the bench, so an output and a conversion that are both high are limited: the brightest
    flats stay below the ADC's end. families: of departures to draw from; None: all of them.
    """
    drawn = sample_system(np.random.default_rng([seed, 0]), families=families)
    usual = LabSystem()
    brightness = drawn.tube_output * drawn.electrons_per_keV * drawn.DN_per_electron
    brightness /= usual.electrons_per_keV * usual.DN_per_electron
    return replace(
        drawn,
        DN_per_electron=drawn.DN_per_electron * min(1.0, BRIGHTEST / brightness),
        rows=rows,
        columns=columns,
        pixel_mm=geometry.pixel_mm,
        source_object_mm=geometry.far_mm,
        source_detector_mm=geometry.source_detector_mm,
        maximum_power_W=MAXIMUM_POWER_W,
    )


def make_session(
    protocol: str,
    *,
    system: LabSystem,
    geometry: Geometry,
    rng: np.random.Generator,
    frames: int | None = None,
    products: int | None = None,
    bones_mm: Sequence[float] | None = None,
    leave_out: Sequence[str] = (),
    only: Sequence[str] | None = None,
) -> SessionPlan:
    """The plan of a long session by name.

    Args:
        protocol: of `SESSIONS`.
        system, geometry: the line.
        rng: draws products and poses; what is left out does not change what else is drawn.
        frames: per series (50); objects have fewer.
        products: how many.
        bones_mm: lengths of their bones, in turn; None: drawn, a few mm.
        leave_out: groups of series that are not taken, of `GROUPS`.
        only: groups of series to take alone, with the darks; None: all.

    Raises:
        InputError: an unknown name or group, fewer than 4 frames or 1 product, or a detector too small for the objects.
    """
    if protocol not in SESSIONS:
        raise InputError("protocol", received=repr(protocol), expected="one of " + ", ".join(SESSIONS))
    frames = SESSION_FRAMES if frames is None else frames
    products = SESSION_PRODUCTS[protocol] if products is None else products
    if frames < 4:
        raise InputError("frames", received=frames, expected="4 or more")
    if products < 1:
        raise InputError("products", received=products, expected="1 or more")
    if bones_mm is not None and not (bones_mm and all(0.2 <= size_mm <= 100.0 for size_mm in bones_mm)):
        raise InputError("bones_mm", received=bones_mm, expected="lengths of 0.2 to 100 mm")
    if min(system.rows, system.columns) < 48:
        raise InputError(
            "size of the lab's detector",
            received=f"{system.rows}x{system.columns}",
            expected=f"48x48 pixels or more for the protocol {protocol}",
        )
    planner = _Planner(rng, system, geometry, frames)
    SESSIONS[protocol](planner, products, bones_mm or ())
    for name in (*leave_out, *(only or ())):
        if name not in GROUPS:
            raise InputError("group of series", received=repr(name), expected="one of " + ", ".join(GROUPS))
    takes = []
    for take in planner.takes:
        groups = groups_of(take, planner.scenes, geometry)
        if not groups & set(leave_out) and (only is None or take.kind == "dark" or groups & set(only)):
            takes.append(take)
    return SessionPlan(takes=tuple(takes), scenes=planner.scenes)


def measure_session(
    path: str | os.PathLike[str],
    *,
    protocol: str,
    seed: int,
    system: LabSystem,
    plan: SessionPlan,
    planted: tuple[Planted, ...],
    rng: np.random.Generator,
    truth_path: Path,
    session: int = 0,
    geometry: str = "",
    begin: Callable[[int], None] = lambda frames: None,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Work off a plan on a line with its effects; write the acquisition and the truth; return the truth."""
    line = Line(system, rng=rng, planted=planted, series_count=len(plan.takes))
    begin(plan.frames)
    with _threads_for(system):
        series = _work_off(path, line, plan, advance)
    truth: dict[str, Any] = {
        "format": "raytwin-lab-truth",
        "version": 1,
        "protocol": protocol,
        "seed": seed,
        "session": session,
        "geometry": geometry,
        "effects": {effect.id: _told(effect) for effect in planted},
        "acquisition": Path(path).name,
        "acquisition_sha256": sha256_of_file(path),
        **compute_truth(
            system,
            settings=[take.setting for take in plan.takes if take.kind in ("flat", "object")],
            exposures_ms=[take.setting.exposure_ms for take in plan.takes],
        ),
        "unkindness": None if line.course is None else line.course.told(),
        "scenes": {
            name: _pose(scene.true) for name, scene in plan.scenes.items() if any(t.scene == name for t in plan.takes)
        },
        "series": series,
    }
    with whole_file(truth_path) as temporary:
        temporary.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return truth


@contextmanager
def _threads_for(system: LabSystem) -> Iterator[None]:
    """One thread for small frames, where waking a second costs more than it does."""
    import numba

    before = numba.get_num_threads()
    if system.rows * system.columns <= _SMALL_FRAME_PIXELS:
        numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def _work_off(
    path: str | os.PathLike[str], line: Line, plan: SessionPlan, advance: Callable[[], None]
) -> dict[str, dict[str, Any]]:
    system = line.base
    series: dict[str, dict[str, Any]] = {}
    written: set[str] = set()
    in_beam = ""
    thickness_mm: dict[str, NDArray[np.float32]] = {}
    with write_acquisition(path, system.instrument()) as writer:
        for number, take in enumerate(plan.takes):
            if take.role == "evaluation":
                line.calibration_is_over()
            line.begin_series(number)
            line.pause(take.pause_s)
            if take.scene and take.scene != in_beam:
                in_beam = take.scene
                scene = plan.scenes[in_beam]
                at = replace(system, source_object_mm=take.source_object_mm or system.source_object_mm)
                if in_beam not in written:
                    writer.add_scene(in_beam, kind=scene.kind, **_stated(at, scene))
                    written.add(in_beam)
                true = scene.true
                for effect in line.active:
                    if effect.pose is not None:
                        true = effect.pose(true, at.pixel_mm / at.magnification)
                thickness_mm = thickness_on_fine_grid(at, true)
            series[take.name] = _measure(writer, line, take, thickness_mm if take.scene else {}, advance)
    return series


def _told(effect: Planted) -> dict[str, Any]:
    return {
        "strength": effect.strength,
        "unit": effect.unit,
        "since": effect.since,
        "law": effect.law,
        "parameters": dict(effect.parameters),
    }


def _pose(true: Posed) -> dict[str, Any]:
    return {"shift_y_mm": true.shift_y_mm, "shift_x_mm": true.shift_x_mm, "scale": dict(true.scale)}


def _measure(
    writer: Any,
    line: Line,
    take: SessionTake,
    thickness_mm: Mapping[str, NDArray[np.float32]],
    advance: Callable[[], None],
) -> dict[str, Any]:
    setting, system = take.setting, line.system
    common: dict[str, Any] = {
        "kind": take.kind,
        "shape": (system.rows, system.columns),
        "dtype": np.uint16 if setting.averaged == 1 else np.float32,
        "frame_interval_ms": line.frame_interval_ms(setting.exposure_ms) * setting.averaged,
        "scene": take.scene,
        "role": take.role,
        "source_object_mm": take.source_object_mm,
        "panel_rotation_deg": take.panel_rotation_deg or None,
    }
    if take.kind in ("dark", "afterglow"):
        sink = writer.add_series(take.name, exposure_ms=setting.exposure_ms, averaged=setting.averaged, **common)
        exposures = line.dark(setting.exposure_ms, frames=take.frames, averaged=setting.averaged)
    else:
        sink = writer.add_series(take.name, setting=setting, **common)
        arrivals = line.arrivals(
            setting,
            scene=take.scene,
            thickness_mm=thickness_mm,
            source_object_mm=take.source_object_mm,
            panel_rotation_deg=take.panel_rotation_deg,
        )
        arrivals = replace(arrivals, load_mAs=arrivals.load_mAs * take.output)
        exposures = line.expose(arrivals, setting, frames=take.frames)
    for frame, began_s in exposures:
        sink.append(frame, time_s=began_s)
        advance()
    expected: dict[str, Any] = {"kind": take.kind}
    if take.kind in ("flat", "object"):
        expected["output"] = take.output
        if line.course is not None:
            expected["level"] = line.course.level(line.series)
    if take.kind == "flat":
        # Of the line as it was calibrated; effects are told apart from it.
        expected |= flat_truth(line.base, line.base_maps, setting)
    return expected


def _stated(system: LabSystem, scene: SessionScene) -> dict[str, Any]:
    """Thickness maps, masks and identifiers of an object for the acquisition file, as its owner believes them."""
    thickness_mm = {
        material: pixel_means(system, fine) for material, fine in thickness_on_fine_grid(system, scene.stated).items()
    }
    told: dict[str, Any] = {"thickness_mm": thickness_mm}
    if scene.kind == "product":
        bone = thickness_mm.get(BONE_MATERIAL)
        total = np.sum(list(thickness_mm.values()), axis=0)
        told |= {
            "product_mask": total > 0,
            "foreign_object_mask": np.zeros(total.shape, dtype=bool) if bone is None else bone > 0,
            "product": scene.product,
            "foreign_object": scene.bone,
            "size_mm": scene.size_mm,
        }
    return told
