"""What is measured in a session, as plans that a bench works off: a calibration, the paper's two sets of products."""

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..acquisition.acquisition_io import write_acquisition
from ..acquisition.setting import Filter, Setting
from ..errors import InputError
from ..files import sha256_of_file, whole_file
from .bench import Bench, RenderedScene, render
from .families import sample_system
from .objects import (
    BONE_MATERIAL,
    RIB_ACROSS_MM,
    TURN_DEGREES,
    Bone,
    Fillet,
    Product,
    clear_field_mm,
    pixel_means,
    place_bone,
    place_fillet,
    sample_bone,
    sample_fillet,
)
from .session import GEOMETRIES, SESSIONS, make_session, measure_session, session_system
from .system import LabSystem
from .truth import compute_truth, flat_truth
from .unkindness import Unkindness

if TYPE_CHECKING:
    from .effects import EffectRequest

COPPER = (Filter(material="Cu", thickness_mm=0.05),)
FLAT_POWERS_W = (1.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0)
PAIR = ((40.0, 40.0), (90.0, 45.0))  # kV and W of the two images of a pair
SET_1_PRODUCTS = 254
SET_1_WITH_BONE = 163
SET_1_FILLETS = 14
SET_1_BONES = 44
SET_2_PRODUCTS = 84
SET_2_BONELESS = 2
SET_2_BONES_MM = (2.0, 3.0)
SET_2_EXPOSURES_MS = (100.0, 50.0, 20.0)  # beside 1 s
CORRECTION_FRAMES = 200  # averaged into each dark and flat of the product sets


@dataclass(frozen=True, slots=True, kw_only=True)
class Take:
    """One series to measure.

    Fields: name; kind (`dark`, `flat`, `object`); setting (of a dark: exposure and `averaged` count, the beam is off);
    frames; role (None, `calibration`, `evaluation`); scene (name in the plan, empty = open field).
    """

    name: str
    kind: str
    setting: Setting
    frames: int
    role: str | None = None
    scene: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A session: series in their order in time, and the products that they show."""

    takes: tuple[Take, ...]
    scenes: Mapping[str, Product] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """How many frames will be stored."""
        return sum(take.frames for take in self.takes)


def _short(value: float) -> str:
    return f"{value:g}"


def _flat_name(setting: Setting) -> str:
    layers = "_".join(f"{layer.material}{layer.thickness_mm:g}" for layer in setting.filters) or "open"
    return f"flat_{_short(setting.kV)}kV_{_short(setting.power_W or 0.0)}W_{_short(setting.exposure_ms)}ms_{layers}"


def _dark(exposure_ms: float, *, frames: int, label: str, averaged: int = 1) -> Take:
    # The voltage stands for nothing: the beam is off.
    setting = Setting(kV=40.0, exposure_ms=exposure_ms, averaged=averaged)
    return Take(name=f"dark_{_short(exposure_ms)}ms_{label}", kind="dark", setting=setting, frames=frames)


def plan_calibration(*, frames: int) -> Plan:
    """Darks and flats from which a twin is calibrated, and a few settings held back to judge it by.

    Darks at 20, 50 and 100 ms before, between and after; flats behind 50 um copper at 40 and 90 kV, at the paper's
    eight powers (20 ms) and at 20, 50 and 100 ms with 40 W (40 kV) and 45 W (90 kV). Held back (`role` evaluation):
    60 kV, other filters, and an exposure and power between the measured ones.
    """
    exposures_ms = (20.0, 50.0, 100.0)
    takes: list[Take] = [_dark(exposure_ms, frames=frames, label="before") for exposure_ms in exposures_ms]

    def flat(kV: float, power_W: float, exposure_ms: float, filters: tuple[Filter, ...], role: str) -> None:
        setting = Setting(kV=kV, power_W=power_W, exposure_ms=exposure_ms, filters=filters)
        takes.append(Take(name=_flat_name(setting), kind="flat", setting=setting, frames=frames, role=role))

    for kV, power_W in PAIR:
        for flat_W in FLAT_POWERS_W:
            flat(kV, flat_W, 20.0, COPPER, "calibration")
        for exposure_ms in exposures_ms:
            if not (exposure_ms == 20.0 and power_W in FLAT_POWERS_W):
                flat(kV, power_W, exposure_ms, COPPER, "calibration")
        takes += [_dark(exposure_ms, frames=frames, label=f"after_{_short(kV)}kV") for exposure_ms in exposures_ms]
    for kV, power_W, exposure_ms, filters in (
        (60.0, 40.0, 20.0, COPPER),
        (60.0, 40.0, 50.0, COPPER),
        (40.0, 40.0, 50.0, (Filter(material="Cu", thickness_mm=0.1),)),
        (90.0, 45.0, 20.0, (Filter(material="Cu", thickness_mm=0.1),)),
        (40.0, 40.0, 20.0, (Filter(material="Al", thickness_mm=1.0),)),
        (90.0, 20.0, 20.0, (Filter(material="Al", thickness_mm=1.0),)),
        (40.0, 25.0, 50.0, COPPER),
        (90.0, 25.0, 50.0, COPPER),
    ):
        flat(kV, power_W, exposure_ms, filters, "evaluation")
    takes += [_dark(exposure_ms, frames=frames, label="after") for exposure_ms in exposures_ms]
    return Plan(takes=tuple(takes))


def plan_averaged(*, frames: int, pairs: bool) -> Plan:
    """The calibration's settings with flats and darks stored as means of `frames` exposures, as many lines do.

    One mean a setting; or two in different series, the second after all settings were visited once (`pairs`).
    """
    single = plan_calibration(frames=1)

    def stored(take: Take, name: str) -> Take:
        return replace(take, name=name, setting=replace(take.setting, averaged=frames))

    calibrating = [take for take in single.takes if take.kind == "dark" or take.role == "calibration"]
    held_back = [stored(take, take.name) for take in single.takes if take.role == "evaluation"]
    takes = [stored(take, take.name) for take in calibrating]
    if pairs:
        takes += [stored(take, f"{take.name}_again") for take in calibrating if take.kind == "flat"]
    return Plan(takes=(*takes, *held_back))


def _object_takes(scene: str, exposures: tuple[tuple[float, int], ...], *, frames: int) -> list[Take]:
    takes = []
    for exposure_ms, averaged in exposures:
        for kV, power_W in PAIR:
            setting = Setting(kV=kV, power_W=power_W, exposure_ms=exposure_ms, filters=COPPER, averaged=averaged)
            name = f"{scene}_{_short(kV)}kV_{_short(power_W)}W_{_short(exposure_ms)}ms_{averaged}avg"
            takes.append(
                Take(name=name, kind="object", setting=setting, frames=1 if averaged > 1 else frames, scene=scene)
            )
    return takes


def _correction_takes(exposures_ms: tuple[float, ...]) -> list[Take]:
    takes = []
    for exposure_ms in exposures_ms:
        takes.append(_dark(exposure_ms, frames=1, label="mean", averaged=CORRECTION_FRAMES))
        for kV, power_W in PAIR:
            setting = Setting(
                kV=kV, power_W=power_W, exposure_ms=exposure_ms, filters=COPPER, averaged=CORRECTION_FRAMES
            )
            takes.append(Take(name=_flat_name(setting), kind="flat", setting=setting, frames=1))
    return takes


def _fillets(
    rng: np.random.Generator, system: LabSystem, *, count: int, product_mm: float | None, prefix: str
) -> list[Fillet]:
    height_mm, width_mm = clear_field_mm(system)
    turns = np.radians([-TURN_DEGREES, 0.0, TURN_DEGREES])
    fillets = []
    for number in range(count):
        half_x_mm = 0.45 * width_mm if product_mm is None else product_mm / 2.0
        half_y_mm = 0.45 * height_mm if product_mm is None else half_x_mm * rng.uniform(0.72, 0.85)
        name = f"{prefix}{number + 1:02d}"
        fillet = sample_fillet(rng, name=name, half_y_mm=half_y_mm, half_x_mm=half_x_mm)
        if product_mm is None:
            # As large as the field allows, however the product lies, but for a little to move in.
            extents = np.max([fillet.extent_mm(turn) for turn in turns], axis=0)
            shrink = rng.uniform(0.90, 0.97) * min(height_mm / 2.0 / extents[0], width_mm / 2.0 / extents[1])
        else:
            shrink = half_x_mm / fillet.extent_mm(0.0)[1]
        fillets.append(replace(fillet, half_y_mm=half_y_mm * shrink, half_x_mm=half_x_mm * shrink))
    return fillets


def plan_set_1(
    rng: np.random.Generator,
    system: LabSystem,
    *,
    products: int,
    frames: int,
    product_mm: float | None = None,
    bones_mm: tuple[float, ...] | None = None,
    across_mm: tuple[float, float] = RIB_ACROSS_MM,
) -> Plan:
    """The paper's first set: fillets with bones of 1.5 to 11 mm and boneless ones (163 to 91), each at 1 s.

    The same fillets (14 in 254, six at least) are placed again and again, with other bones in other places. An image
    of 1 s is the mean of ten frames of 100 ms. Darks and flats are means of 200 frames.
    """
    n_with_bone = round(products * SET_1_WITH_BONE / SET_1_PRODUCTS)
    n_fillets = max(min(products, 6), round(products * SET_1_FILLETS / SET_1_PRODUCTS))
    n_bones = max(min(n_with_bone, 12), round(products * SET_1_BONES / SET_1_PRODUCTS))
    fillets = _fillets(rng, system, count=n_fillets, product_mm=product_mm, prefix="fillet")
    # Sizes spread evenly over the logarithm of the range, so that a short set holds small and large bones alike.
    edges_mm = np.geomspace(1.5, 11.0, n_bones + 1)
    bones = [
        sample_bone(
            rng, name=f"bone{number + 1:02d}", size_mm=round(float(rng.uniform(low, high)), 1), across_mm=across_mm
        )
        for number, (low, high) in enumerate(pairwise(edges_mm))
    ]
    if bones_mm is not None:
        bones = [
            sample_bone(rng, name=f"bone{number + 1:02d}", size_mm=size_mm, across_mm=across_mm)
            for number, size_mm in enumerate(bones_mm)
        ]
    bone_order = [bones[number % len(bones)] for number in range(n_with_bone)]
    contents: list[Bone | None] = [*bone_order, *([None] * (products - n_with_bone))]
    shuffled = [contents[int(number)] for number in rng.permutation(products)]
    return _product_plan(rng, system, fillets=fillets, contents=shuffled, exposures=((100.0, 10),), frames=frames)


def plan_set_2(
    rng: np.random.Generator,
    system: LabSystem,
    *,
    products: int,
    frames: int,
    product_mm: float | None = None,
    bones_mm: tuple[float, ...] | None = None,
    across_mm: tuple[float, float] = RIB_ACROSS_MM,
    exposures_ms: tuple[float, ...] | None = None,
    boneless: int | None = None,
) -> Plan:
    """The paper's second set: two fillets, bones of 2 and 3 mm in many places, at 1 s, 100, 50 and 20 ms each.

    Two of 84 products are boneless (at least one), or as many as `boneless` says. `exposures_ms` are those beside 1 s. Fillets
    and bones are others than those of the first set.
    """
    fillets = _fillets(rng, system, count=2, product_mm=product_mm, prefix="test_fillet")
    bones = [
        sample_bone(rng, name=f"test_bone{number + 1}", size_mm=size_mm, across_mm=across_mm)
        for number, size_mm in enumerate(bones_mm or SET_2_BONES_MM)
    ]
    n_boneless = max(1, round(products * SET_2_BONELESS / SET_2_PRODUCTS)) if products > 1 else 0
    n_boneless = n_boneless if boneless is None else boneless
    contents: list[Bone | None] = [None] * n_boneless
    contents += [bones[number % len(bones)] for number in range(products - n_boneless)]
    return _product_plan(
        rng,
        system,
        fillets=fillets,
        contents=contents,
        exposures=((100.0, 10), *((exposure_ms, 1) for exposure_ms in exposures_ms or SET_2_EXPOSURES_MS)),
        frames=frames,
    )


def _product_plan(
    rng: np.random.Generator,
    system: LabSystem,
    *,
    fillets: list[Fillet],
    contents: list[Bone | None],
    exposures: tuple[tuple[float, int], ...],
    frames: int,
) -> Plan:
    scenes: dict[str, Product] = {}
    takes = _correction_takes(tuple(sorted({exposure_ms for exposure_ms, _ in exposures}, reverse=True)))
    # Bones alternate in some sets: steps of the fillet must not follow theirs.
    order = [int(number) % len(fillets) for number in rng.permutation(len(contents))]
    for number, bone in enumerate(contents):
        product = place_fillet(rng, fillet=fillets[order[number]], system=system)
        if bone is not None:
            product = place_bone(rng, product=product, bone=bone)
        name = f"{number + 1:03d}"
        scenes[name] = product
        takes += _object_takes(name, exposures, frames=frames)
    return Plan(takes=tuple(takes), scenes=scenes)


PROTOCOLS: dict[str, str] = {
    "calibration": "darks and flats at several powers and exposures, 40 and 90 kV, some settings held back",
    "set1": "fillets with and without rib bones of 1.5-11 mm, at 1 s",
    "set2": "two fillets with bones of 2 and 3 mm in many places, at 1 s, 100, 50 and 20 ms",
    "averaged": "as calibration, each flat and dark stored once as the mean of its frames",
    "averaged_pairs": "as averaged, every flat stored in two series",
}
DEFAULT_FRAMES = {"calibration": 20, "averaged": 50, "averaged_pairs": 50, "set1": 1, "set2": 1}
# of random numbers: what a seed gives does not hang on the order of a table
_PLACES = {"calibration": 0, "set1": 1, "set2": 2, "averaged": 3, "averaged_pairs": 4}
DEFAULT_PRODUCTS = {"set1": SET_1_PRODUCTS, "set2": SET_2_PRODUCTS}


def system_of_seed(
    seed: int,
    *,
    rows: int = 128,
    columns: int = 160,
    pixel_mm: float = 0.45,
    source_detector_mm: float | None = None,
    families: Sequence[str] | None = None,
) -> LabSystem:
    """The hidden system of a seed, with a detector of the given size: the same in every protocol and session.

    families: of departures to draw from, of `families.FAMILIES`; None: all of them.
    """
    if not (math.isfinite(pixel_mm) and 0.01 <= pixel_mm <= 10.0):
        raise InputError("pixel_mm", received=f"{pixel_mm:g} mm", expected="0.01 to 10 mm")
    return sample_system(np.random.default_rng([seed, 0]), families=families).at_size(
        rows=rows, columns=columns, pixel_mm=pixel_mm, source_detector_mm=source_detector_mm
    )


def make_plan(
    protocol: str,
    *,
    system: LabSystem,
    rng: np.random.Generator,
    frames: int | None = None,
    products: int | None = None,
    product_mm: float | None = None,
    bones_mm: tuple[float, ...] | None = None,
    bones_across_mm: tuple[float, ...] | None = None,
    exposures_ms: tuple[float, ...] | None = None,
    boneless: int | None = None,
) -> Plan:
    """The plan of a protocol by name; see `PROTOCOLS`.

    Raises:
        InputError: an unknown protocol, numbers below 1 (2 products), or a product larger than the field.
    """
    if protocol != "set2":
        _only_in("set2", exposures_ms=exposures_ms, boneless=boneless)
    if protocol not in PROTOCOLS:
        known = ", ".join((*PROTOCOLS, *SESSIONS))
        raise InputError("protocol", received=repr(protocol), expected=f"one of {known}")
    frames = DEFAULT_FRAMES[protocol] if frames is None else frames
    if frames < 1:
        raise InputError("frames", received=frames, expected="1 or more")
    if protocol not in DEFAULT_PRODUCTS:
        _only_in("a set of products", bones_across_mm=bones_across_mm)
        if frames < 2:
            raise InputError("frames", received=frames, expected="2 or more in a calibration")
        if protocol == "calibration":
            return plan_calibration(frames=frames)
        return plan_averaged(frames=frames, pairs=protocol == "averaged_pairs")
    products = DEFAULT_PRODUCTS[protocol] if products is None else products
    if products < 2:
        raise InputError("products", received=products, expected="2 or more")
    if product_mm is not None and not 10.0 <= product_mm <= 1000.0:
        raise InputError("product_mm", received=f"{product_mm:g} mm", expected="10 to 1000 mm")
    if bones_mm is not None and not (bones_mm and all(0.2 <= size_mm <= 100.0 for size_mm in bones_mm)):
        raise InputError("bones_mm", received=bones_mm, expected="lengths of 0.2 to 100 mm")
    words: dict[str, Any] = {
        "products": products,
        "frames": frames,
        "product_mm": product_mm,
        "bones_mm": bones_mm,
    }
    if bones_across_mm is not None:
        if len(bones_across_mm) != 2 or not 0.1 <= bones_across_mm[0] <= bones_across_mm[1] <= 20.0:
            raise InputError("bones_across_mm", received=bones_across_mm, expected="least and most, 0.1 to 20 mm")
        words["across_mm"] = (bones_across_mm[0], bones_across_mm[1])
    if protocol == "set1":
        return plan_set_1(rng, system, **words)
    if exposures_ms is not None:
        allowed = len(set(exposures_ms)) == len(exposures_ms) and all(0.01 <= one <= 10000.0 for one in exposures_ms)
        if not (exposures_ms and allowed):
            raise InputError("exposures_ms", received=exposures_ms, expected="different times of 0.01 to 10000 ms")
    if boneless is not None and not 0 <= boneless < products:
        raise InputError("boneless", received=boneless, expected=f"0 or more, and fewer than the {products} products")
    return plan_set_2(rng, system, **words, exposures_ms=exposures_ms, boneless=boneless)


def truth_path(acquisition: str | os.PathLike[str]) -> Path:
    """Where the truth of an acquisition is written: `session.h5` -> `session.truth.json`."""
    path = Path(acquisition)
    return path.with_name(f"{path.stem}.truth.json")


def run_protocol(
    path: str | os.PathLike[str],
    *,
    protocol: str,
    seed: int,
    rows: int = 128,
    columns: int | None = None,
    pixel_mm: float | None = None,
    source_detector_mm: float | None = None,
    frames: int | None = None,
    products: int | None = None,
    product_mm: float | None = None,
    bones_mm: tuple[float, ...] | None = None,
    bones_across_mm: tuple[float, ...] | None = None,
    exposures_ms: tuple[float, ...] | None = None,
    boneless: int | None = None,
    session: int = 0,
    system: LabSystem | None = None,
    families: Sequence[str] | None = None,
    unkindness: Unkindness | None = None,
    geometry: str | None = None,
    effects: Sequence["EffectRequest"] = (),
    leave_out: Sequence[str] = (),
    only: Sequence[str] | None = None,
    truth_file: str | os.PathLike[str] | None = None,
    begin: Callable[[int], None] = lambda frames: None,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Measure a session in the virtual lab; write the acquisition, and its truth beside it.

    Args:
        path: the acquisition file to write; the truth goes to `truth_path(path)`.
        protocol: `calibration`, `averaged`, `averaged_pairs`, `set1` or `set2`; or `full`, `short` or `products`, see `session`.
        seed: draws the hidden system, the products and the noise; the same seed is the same system in all protocols.
        rows, columns, pixel_mm: the detector, 128 x 160 pixels of 0.45 mm by default; distances scale with the pixel,
            see `LabSystem.at_size`. Long sessions are 128 x 128 and have the pixel of their geometry.
        source_detector_mm: another distance than the one that scales with the pixel; nearer means more photons.
        frames: frames per series (of the product sets: per object at a single exposure).
        products: how many (sets only).
        product_mm: length of a product; by default nine tenths of the field.
        bones_mm: lengths of the bones, instead of the set's own.
        bones_across_mm: least and most width of the bones, instead of a rib's 1 to 3 mm (sets only).
        exposures_ms: of set2 beside 1 s, instead of 100, 50 and 20 ms.
        boneless: how many products of set2 have no bone.
        session: another number is another day: other noise and other products on the same system.
        system: a system to measure with, instead of the seed's.
        families: of departures that the seed's system is drawn from, of `families.FAMILIES`; None: all of them.
        unkindness: what the line does a little all the time, instead of the system's own; `unkindness.NONE`: nothing.
        geometry: `fine` or `coarse` (the default), for the long sessions.
        effects: to be planted, in the long sessions; their inner parameters are the seed's in every protocol and session.
        leave_out, only: groups of series that are not taken, or taken alone with the darks, in the long sessions; see
            `session.GROUPS`.
        truth_file: where the truth is written, instead of beside the acquisition.
        begin, advance: called with the number of frames to come, and after each.

    Returns:
        The truth, as written.

    Raises:
        InputError: see `make_plan`; nothing is left behind.
    """
    if seed < 0 or session < 0:
        raise InputError("seed and session", received=f"{seed} and {session}", expected="whole numbers of 0 or more")
    if protocol in SESSIONS:
        _only_in(
            "a set of products or a calibration",
            pixel_mm=pixel_mm,
            source_detector_mm=source_detector_mm,
            product_mm=product_mm,
            bones_across_mm=bones_across_mm,
            exposures_ms=exposures_ms,
            boneless=boneless,
        )
        return _run_session(
            path,
            protocol=protocol,
            seed=seed,
            rows=rows,
            columns=rows if columns is None else columns,
            geometry=geometry or "coarse",
            frames=frames,
            products=products,
            bones_mm=bones_mm,
            session=session,
            system=system,
            families=families,
            unkindness=unkindness,
            effects=tuple(effects),
            leave_out=leave_out,
            only=only,
            truth_file=truth_path(path) if truth_file is None else Path(truth_file),
            begin=begin,
            advance=advance,
        )
    _only_in(
        "a long session (full, short or products)",
        geometry=geometry,
        effects=tuple(effects) or None,
        leave_out=tuple(leave_out) or None,
        only=only,
    )
    if system is None:
        system = system_of_seed(
            seed,
            rows=rows,
            columns=160 if columns is None else columns,
            pixel_mm=0.45 if pixel_mm is None else pixel_mm,
            source_detector_mm=source_detector_mm,
            families=families,
        )
    if unkindness is not None:
        system = replace(system, unkindness=unkindness)
    place = _PLACES.get(protocol, 0)
    plan_rng, noise_rng = (np.random.default_rng([seed, 1 + place, session, part]) for part in (0, 1))
    plan = make_plan(
        protocol,
        system=system,
        rng=plan_rng,
        frames=frames,
        products=products,
        product_mm=product_mm,
        bones_mm=bones_mm,
        bones_across_mm=bones_across_mm,
        exposures_ms=exposures_ms,
        boneless=boneless,
    )
    bench = Bench(system, rng=noise_rng, series_count=len(plan.takes))
    begin(plan.frames)
    series = _measure_plan(path, bench, plan, advance)
    truth: dict[str, Any] = {
        "format": "raytwin-lab-truth",
        "version": 1,
        "protocol": protocol,
        "seed": seed,
        "session": session,
        "effects": {},
        **_truth_of_file(path, bench, plan, series),
    }
    with whole_file(truth_path(path) if truth_file is None else truth_file) as temporary:
        temporary.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return truth


def _only_in(place: str, **given: object) -> None:
    for name, value in given.items():
        if value is not None:
            received = ", ".join(map(str, value)) if isinstance(value, list | tuple) else value
            raise InputError(name, received=received, expected=f"nothing: it belongs to {place}")


def _run_session(
    path: str | os.PathLike[str],
    *,
    protocol: str,
    seed: int,
    rows: int,
    columns: int,
    geometry: str,
    frames: int | None,
    products: int | None,
    bones_mm: tuple[float, ...] | None,
    session: int,
    system: LabSystem | None,
    families: Sequence[str] | None,
    unkindness: Unkindness | None,
    effects: tuple["EffectRequest", ...],
    leave_out: Sequence[str],
    only: Sequence[str] | None,
    truth_file: Path,
    begin: Callable[[int], None],
    advance: Callable[[], None],
) -> dict[str, Any]:
    from .effect import Site
    from .effects import plant

    if geometry not in GEOMETRIES:
        raise InputError("geometry", received=repr(geometry), expected="one of " + ", ".join(GEOMETRIES))
    bench = GEOMETRIES[geometry]
    if system is None:
        system = session_system(seed, rows=rows, columns=columns, geometry=bench, families=families)
    if unkindness is not None:
        system = replace(system, unkindness=unkindness)
    place = 100 + list(SESSIONS).index(protocol)
    plan_rng, noise_rng = (np.random.default_rng([seed, place, session, part]) for part in (0, 1))
    effect_rng = np.random.default_rng([seed, 99])
    plan = make_session(
        protocol,
        system=system,
        geometry=bench,
        rng=plan_rng,
        frames=frames,
        products=products,
        bones_mm=bones_mm,
        leave_out=leave_out,
        only=only,
    )
    planted = plant(effects, Site(system=system, geometry=bench, plan=plan, rng=effect_rng))
    return measure_session(
        path,
        protocol=protocol,
        seed=seed,
        session=session,
        system=system,
        plan=plan,
        planted=planted,
        rng=noise_rng,
        truth_path=truth_file,
        geometry=geometry,
        begin=begin,
        advance=advance,
    )


def _measure_plan(
    path: str | os.PathLike[str], bench: Bench, plan: Plan, advance: Callable[[], None]
) -> dict[str, dict[str, Any]]:
    """Measure the series of a plan into an acquisition file; series -> what is true of it."""
    series: dict[str, dict[str, Any]] = {}
    with write_acquisition(path, bench.system.instrument()) as writer:
        in_beam, rendered = "", None
        for number, take in enumerate(plan.takes):
            bench.begin_series(number)
            if take.scene and take.scene != in_beam:
                in_beam, product = take.scene, plan.scenes[take.scene]
                rendered = render(bench.system, product)
                writer.add_scene(in_beam, kind="product", **_scene_contents(bench.system, product, rendered))
            series[take.name] = _measure(writer, bench, take, rendered if take.scene else None, advance)
    return series


def _truth_of_file(
    path: str | os.PathLike[str], bench: Bench, plan: Plan, series: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """What is true of an acquisition file that a bench measured by a plan; series: what is true of each."""
    return {
        "acquisition": Path(path).name,
        "acquisition_sha256": sha256_of_file(path),
        **compute_truth(
            bench.system,
            settings=[take.setting for take in plan.takes if take.kind != "dark"],
            exposures_ms=[take.setting.exposure_ms for take in plan.takes],
        ),
        "unkindness": None if bench.course is None else bench.course.told(),
        "series": series,
    }


def _measure(
    writer: Any, bench: Bench, take: Take, scene: RenderedScene | None, advance: Callable[[], None]
) -> dict[str, Any]:
    setting, system = take.setting, bench.system
    common: dict[str, Any] = {
        "kind": take.kind,
        "shape": (system.rows, system.columns),
        "dtype": np.uint16 if setting.averaged == 1 else np.float32,
        "frame_interval_ms": bench.frame_interval_ms(setting.exposure_ms) * setting.averaged,
        "scene": take.scene,
        "role": take.role,
    }
    if take.kind == "dark":
        sink = writer.add_series(take.name, exposure_ms=setting.exposure_ms, averaged=setting.averaged, **common)
        exposures = bench.dark(setting.exposure_ms, frames=take.frames, averaged=setting.averaged)
    else:
        sink = writer.add_series(take.name, setting=setting, **common)
        exposures = bench.expose(setting, frames=take.frames, scene=scene)
    for frame, began_s in exposures:
        sink.append(frame, time_s=began_s)
        advance()
    expected: dict[str, Any] = {"kind": take.kind}
    if take.kind == "flat":
        if bench.course is not None:
            expected["level"] = bench.course.level(bench.series)
        expected |= flat_truth(system, bench.base_maps, setting)
    return expected


def _scene_contents(system: LabSystem, product: Product, rendered: RenderedScene) -> dict[str, Any]:
    """Thickness maps, masks and identifiers of a product for the acquisition file."""
    thickness_mm = {material: pixel_means(system, fine) for material, fine in rendered.thickness_mm.items()}
    bone = thickness_mm.get(BONE_MATERIAL)
    total = np.sum(list(thickness_mm.values()), axis=0)
    return {
        "thickness_mm": thickness_mm,
        "product_mask": total > 0,
        "foreign_object_mask": np.zeros(total.shape, dtype=bool) if bone is None else bone > 0,
        "product": product.fillet.name,
        "foreign_object": "" if product.bone is None else product.bone.name,
        "size_mm": None if product.bone is None else product.bone.size_mm,
    }
