"""Effects of tube, geometry and object: what the beam is before it reaches the scintillator."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Filter
from .attenuation import mu_per_mm
from .chain import SUBPIXELS, margin_px
from .effect import Asked, EffectLaw, Site, effect_law, planted
from .effects_detector import mixed_gaussians
from .line import MINERAL, Exposure, FineMap, FineRates, Planted, rates_of_map
from .objects import PRODUCT_MATERIAL, fine_shape
from .phantoms import Posed
from .response import Incidence, compute_incidence
from .scatter import class_rates, scattered_photons, smooth_map
from .session import COPPER
from .system import LabSystem

Array = NDArray[np.float64]


def _kv_error(request: Asked, site: Site) -> Planted:
    def change(system: LabSystem) -> LabSystem:
        true = (1.0 + system.kV_offset_percent / 100.0) * (1.0 + request.strength / 100.0)
        return replace(system, kV_offset_percent=100.0 * (true - 1.0))

    return planted(request, "the tube's true voltage over the set one", {}, system=change)


def _filtration_error(request: Asked, site: Site) -> Planted:
    layer = Filter(material="Al", thickness_mm=request.strength)

    def change(system: LabSystem) -> LabSystem:
        return replace(system, inherent_filtration=(*system.inherent_filtration, layer))

    return planted(request, "one more layer of aluminium", {}, system=change)


def _output_drift(request: Asked, site: Site) -> Planted:
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

    return planted(
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


# --- the anode --------------------------------------------------------------------------------------------------------

_HEEL_CURVE = 0.3


def _signal_behind_anode(incidence: Incidence, length_mm: float) -> float:
    lengths = {ANODE: np.asarray(length_mm)}
    return float(incidence.rates_per_mAs(lengths) @ incidence.deposit_keV)


ANODE = "W"


def _anode_path_mm(incidence: Incidence, change: float) -> float:
    """Tungsten (mm) between the borders of the field that changes the open beam's signal by so much, by bisection."""
    open_field = _signal_behind_anode(incidence, 0.0)
    low, high = 0.0, 0.1
    for _ in range(60):
        middle = 0.5 * (low + high)
        ends = [_signal_behind_anode(incidence, side * 0.5 * middle) for side in (-1.0, 1.0)]
        low, high = (middle, high) if (ends[0] - ends[1]) / open_field < change else (low, middle)
    return 0.5 * (low + high)


def _heel(request: Asked, site: Site) -> Planted:
    degrees = 90.0 * float(site.rng.integers(4)) + float(site.rng.uniform(-5.0, 5.0))
    angle = math.radians(degrees)

    def path(exposure: Exposure) -> dict[str, FineMap]:
        bare = compute_incidence(exposure.system, kV=exposure.kV, filters=(), materials=(ANODE,))
        path_mm = _anode_path_mm(bare, request.strength / 100.0)
        y, x = _field_coordinates(exposure.system)
        across = y[:, None] * math.cos(angle) + x[None, :] * math.sin(angle)
        if round(exposure.panel_rotation_deg) % 360 == 180:
            across = -across
        return {ANODE: (path_mm * (across + _HEEL_CURVE * across**2)).astype(np.float32)}

    return planted(
        request,
        "tungsten in the way of the beam, more and more of it towards one side: (u + 0.3 u^2) of a path that each kV"
        " has for itself",
        {"direction_deg": degrees},
        layers=path,
    )


def _field_coordinates(system: LabSystem) -> tuple[Array, Array]:
    """-1/2 to 1/2 from the middle of the first pixel to that of the last, on the fine grid and its margins."""
    margin = margin_px(max(system.core_px))
    result = []
    for length, fine in zip((system.rows, system.columns), fine_shape(system), strict=True):
        pixel = (np.arange(fine) + 0.5) / SUBPIXELS - margin - 0.5
        result.append((pixel - 0.5 * (length - 1)) / (length - 1))
    return result[0], result[1]


# --- something in the way ----------------------------------------------------------------------------------------------

_FOIL = "Al"


def _grey_absorber(request: Asked, site: Site) -> Planted:
    """A foil, or a mesh of wires, that hides the beam from a bent border on; its penumbra is a straight ramp."""
    rng, taken = site.rng, request.strength / 100.0
    degrees = float(rng.uniform(0.0, 360.0))
    border, bend = float(rng.uniform(-0.15, 0.3)), float(rng.uniform(-0.15, 0.15))
    ramp = float(np.exp(rng.uniform(math.log(0.02), math.log(0.15))))
    foil = bool(rng.random() < 0.5)
    angle = math.radians(degrees)
    # so thick that 45 keV lose the share
    thick_mm = -math.log1p(-taken) / float(mu_per_mm(_FOIL, np.array([45.0]))[0])

    def hidden(exposure: Exposure) -> Array:
        y, x = _field_coordinates(exposure.system)
        if round(exposure.panel_rotation_deg) % 360 == 180:
            y, x = -y, -x
        along = y[:, None] * math.cos(angle) + x[None, :] * math.sin(angle)
        beside = x[None, :] * math.cos(angle) - y[:, None] * math.sin(angle)
        return np.asarray(np.clip((along + bend * beside**2 - border) / ramp + 0.5, 0.0, 1.0))

    def shade(rates: FineRates, exposure: Exposure) -> FineRates:
        left = (1.0 - taken * hidden(exposure)).astype(np.float32)
        return rates_of_map(rates.spelled_out() * left[:, :, None], rates)

    def sheet(exposure: Exposure) -> dict[str, FineMap]:
        return {_FOIL: (thick_mm * hidden(exposure)).astype(np.float32)}

    return planted(
        request,
        "an aluminium foil with a wedged rim" if foil else "a mesh of opaque wires",
        {"direction_deg": degrees, "border": border, "bend": bend, "ramp": ramp, "foil": foil},
        **({"layers": sheet} if foil else {"rates": shade}),
    )


# --- source, motion, position -----------------------------------------------------------------------------------------


def _kernel(places_px: Array, weights: Array) -> Array:
    """Shares of the fine grid's offsets (odd number of them) for a cloud of offsets (px), its variance kept.

    Offsets count in the nearest sub-pixel, which adds 1/12 of variance, taken off before by drawing the cloud together;
    a cloud narrower than that becomes three shares of the right variance.
    """
    fine = places_px * SUBPIXELS
    fine = fine - np.average(fine, weights=weights)
    variance = float(np.average(fine**2, weights=weights))
    if variance < 0.4:
        return np.array([0.5 * variance, 1.0 - variance, 0.5 * variance])
    fine = fine * math.sqrt(1.0 - 1.0 / 12.0 / variance)
    reach = math.ceil(float(np.abs(fine).max()))
    shares = np.bincount(np.rint(fine).astype(np.intp) + reach, weights=weights, minlength=2 * reach + 1)
    result: Array = shares / shares.sum()
    return result


def _blurred(rates: FineRates, kernels: tuple[Array | None, Array | None]) -> FineRates:
    from scipy.ndimage import convolve1d

    spelled = rates.spelled_out()
    for axis, kernel in enumerate(kernels):
        if kernel is not None:
            spelled = convolve1d(spelled, kernel.astype(np.float32), axis=axis, mode="nearest")
    return rates_of_map(spelled, rates)


def _focal_spot(request: Asked, site: Site) -> Planted:
    # Points of a source whose brightness rises and falls in straight lines: its half width is that of the request.
    points = np.linspace(-1.0, 1.0, 801)[1:-1]
    brightness = 1.0 - np.abs(points)

    def blur(rates: FineRates, exposure: Exposure) -> FineRates:
        if not exposure.scene:
            return rates
        system = exposure.system
        width_px = request.strength * (system.magnification - 1.0) / system.pixel_mm
        kernel = _kernel(points * width_px, brightness)
        return _blurred(rates, (kernel, kernel))

    return planted(request, "source points of triangular brightness in both directions", {}, rates=blur)


def _off_focal(request: Asked, site: Site) -> Planted:
    from scipy.ndimage import shift

    share, radius_mm = request.strength / 100.0, float(site.rng.uniform(5.0, 12.0))
    # the spot lies anywhere from the middle of what else is struck to its rim
    aside_mm, towards = radius_mm * float(site.rng.uniform(0.0, 1.0)), float(site.rng.uniform(0.0, 2.0 * math.pi))

    def second_source(rates: FineRates, exposure: Exposure) -> FineRates:
        if not exposure.scene:
            return rates
        system = exposure.system
        px_per_mm = (system.magnification - 1.0) / system.pixel_mm
        wide_px, aside_px = radius_mm * px_per_mm, aside_mm * px_per_mm
        away_px = aside_px * math.cos(towards), aside_px * math.sin(towards)
        spelled = rates.spelled_out()
        out = np.empty_like(spelled)
        for number in range(spelled.shape[2]):
            plane = np.ascontiguousarray(spelled[:, :, number])
            blocks = plane.reshape(plane.shape[0] // SUBPIXELS, SUBPIXELS, plane.shape[1] // SUBPIXELS, SUBPIXELS)
            wide = mixed_gaussians(blocks.mean(axis=(1, 3)), ((0.5, 0.35 * wide_px), (0.5, 0.8 * wide_px)))
            wide = shift(wide, away_px, order=1, mode="nearest")
            smooth = np.repeat(np.repeat(wide, SUBPIXELS, axis=0), SUBPIXELS, axis=1)
            out[:, :, number] = np.float32(1.0 - share) * plane + np.float32(share) * smooth
        return rates_of_map(out, rates)

    return planted(
        request,
        "a share of the photons comes from a wide spot around the focus",
        {"radius_mm": radius_mm, "aside_mm": aside_mm, "towards_rad": towards},
        rates=second_source,
    )


def _motion_blur(request: Asked, site: Site) -> Planted:
    nominal = site.system.magnification
    ripple, phase = 0.15, float(site.rng.uniform(0.0, 2.0 * math.pi))
    cycle_ms = float(site.rng.uniform(20.0, 60.0))
    mm_per_ms = request.strength / 50.0 * site.system.pixel_mm / nominal

    def blur(rates: FineRates, exposure: Exposure) -> FineRates:
        if not exposure.scene:
            return rates
        system = exposure.system
        time_ms = (np.arange(4000) + 0.5) / 4000.0 * exposure.exposure_ms
        turn = 2.0 * math.pi * time_ms / cycle_ms + phase
        travelled_mm = mm_per_ms * (time_ms + ripple * cycle_ms / (2.0 * math.pi) * np.sin(turn))
        places_px = travelled_mm * system.magnification / system.pixel_mm
        return _blurred(rates, (_kernel(places_px, np.ones(places_px.size)), None))

    return planted(
        request,
        "an object that travels along the rows' axis while it is exposed, its belt's speed rippling by 15 %",
        {"speed_mm_s": 1000.0 * mm_per_ms, "ripple_ms": cycle_ms},
        rates=blur,
        per_exposure_ms=True,
    )


def _misregistration(request: Asked, site: Site) -> Planted:
    rng, system = site.rng, site.system
    share = float(rng.uniform(0.7, 1.0))
    direction = float(rng.uniform(0.0, 2.0 * math.pi))
    shift_px = request.strength * share
    # Mean square distance of the pixels from the middle of the field.
    radius_px = math.sqrt((system.rows**2 + system.columns**2) / 12.0)
    rotation = float(rng.choice([-1.0, 1.0])) * request.strength * math.sqrt(1.0 - share**2) / radius_px

    def displace(true: Posed, pitch_mm: float) -> Posed:
        return replace(
            true,
            shift_y_mm=true.shift_y_mm + shift_px * math.cos(direction) * pitch_mm,
            shift_x_mm=true.shift_x_mm + shift_px * math.sin(direction) * pitch_mm,
            rotation=true.rotation + rotation,
        )

    return planted(
        request,
        "a shift and a rotation of everything that is put on the bench",
        {"shift_px": shift_px, "direction_deg": math.degrees(direction), "rotation_deg": math.degrees(rotation)},
        pose=displace,
    )


# --- the object -------------------------------------------------------------------------------------------------------


def _composition_error(request: Asked, site: Site) -> Planted:
    by_mineral = 0.15
    middle_keV = np.array([0.6 * float(np.mean(site.geometry.kVs))])
    of_product, of_mineral = (float(mu_per_mm(name, middle_keV)[0]) for name in (PRODUCT_MATERIAL, MINERAL))
    change = request.strength / 100.0
    mineral = by_mineral * change * of_product / of_mineral

    def other(exposure: Exposure) -> dict[str, FineMap]:
        length = exposure.thickness_mm.get(PRODUCT_MATERIAL)
        if length is None:
            return {}
        return {
            PRODUCT_MATERIAL: np.float32((1.0 - by_mineral) * change) * length,
            MINERAL: np.float32(mineral) * length,
        }

    return planted(
        request,
        "a denser product (85 % of the change) with more salt (15 % of it, at the middle energy)",
        {"middle_keV": float(middle_keV[0]), "salt_mm_per_mm": mineral},
        layers=other,
    )


WATER_MM = 20.0


def _object_scatter(request: Asked, site: Site) -> Planted:
    system, seed = site.system, int(site.rng.integers(2**62))
    margin = margin_px(max(system.core_px)) * SUBPIXELS

    def field_of(fine: FineMap) -> FineMap:
        return fine[margin : fine.shape[0] - margin, margin : fine.shape[1] - margin]

    def cells_keV(photons: Array, incidence: Incidence) -> Array:
        """Signal of scattered photons by cell of the tally, and the share of each class in all of it."""
        result: Array = np.einsum("oyxe->yxe", photons) @ np.array(
            [float(class_rates(incidence, one) @ incidence.deposit_keV) for one in np.eye(photons.shape[-1])]
        )
        return result

    def natural() -> list[float]:
        """Scatter over primary behind 20 mm of water, middle of the field, at each kV."""
        water = np.full((system.rows * SUBPIXELS, system.columns * SUBPIXELS), WATER_MM, dtype=np.float32)
        ratios = []
        for number, kV in enumerate(site.geometry.kVs):
            incidence = compute_incidence(system, kV=kV, filters=COPPER, materials=("water",))
            photons = scattered_photons(
                system, incidence, {"water": water}, rng=np.random.default_rng([seed, 0, number])
            )
            cells = smooth_map(cells_keV(photons, incidence), (17, 17))
            primary = incidence.rates_per_mAs({"water": np.asarray(WATER_MM)}) @ incidence.deposit_keV
            ratios.append(float(cells[8, 8] / primary))
        return ratios

    ratios = natural()
    scale = request.strength / 100.0 / float(np.mean(ratios))
    seen: dict[tuple[object, ...], tuple[Array, Array]] = {}

    def add(rates: FineRates, exposure: Exposure) -> FineRates:
        if not exposure.scene:
            return rates
        key = (exposure.scene, exposure.kV, exposure.filters, exposure.system)
        if key not in seen:
            field = {name: field_of(fine) for name, fine in exposure.thickness_mm.items()}
            rng = np.random.default_rng([seed, 1, len(seen)])
            photons = scattered_photons(exposure.system, exposure.incidence, field, rng=rng)
            cells = cells_keV(photons, exposure.incidence)
            classes = class_rates(exposure.incidence, photons.sum(axis=(0, 1, 2)))
            total = float(classes @ exposure.incidence.deposit_keV)
            seen[key] = (cells, classes / total if total > 0 else classes)
        cells, classes_per_keV = seen[key]
        shape = rates.cell.shape
        # Over the margins the map goes on as it ends.
        inner = smooth_map(cells, (shape[0] - 2 * margin, shape[1] - 2 * margin))
        signal_keV = np.pad(inner, margin, mode="edge") * scale
        spelled = rates.spelled_out() + (signal_keV[..., None] * classes_per_keV).astype(np.float32)
        return rates_of_map(spelled, rates)

    return planted(
        request,
        "photons followed through up to four Compton and Rayleigh collisions, scaled for collimation and field",
        {
            "natural_percent": [100.0 * ratio for ratio in ratios],
            "kV": list(site.geometry.kVs),
            "scale": scale,
        },
        rates=add,
    )


BEAM_LAWS: tuple[EffectLaw, ...] = (
    effect_law("kv_error", "a tube voltage that changed", "%", (0.5, 5.0), _kv_error, since="calibration", signed=True),
    effect_law("filtration_error", "more filtration", "mm Al", (0.03, 1.0), _filtration_error, since="calibration"),
    effect_law("object_scatter", "radiation scattered by the object", "%", (1.0, 50.0), _object_scatter),
    effect_law("focal_spot", "a source that is not a point", "mm", (0.05, 1.5), _focal_spot),
    effect_law("motion_blur", "an object that moves", "px", (0.5, 10.0), _motion_blur),
    effect_law("misregistration", "objects elsewhere than stated", "px", (0.1, 3.0), _misregistration),
    effect_law("composition_error", "a product of other make", "%", (0.5, 5.0), _composition_error, signed=True),
    effect_law("heel", "a beam that the anode dims on one side", "%", (1.0, 20.0), _heel, since="calibration"),
    effect_law("output_drift", "an output that drifts", "%", (0.1, 3.0), _output_drift),
)
# further ones come last in the registry: the random numbers of those before stay theirs
COVER_LAWS: tuple[EffectLaw, ...] = (
    effect_law(
        "grey_absorber", "something in a part of the beam", "%", (0.5, 60.0), _grey_absorber, since="calibration"
    ),
)
SOURCE_LAWS: tuple[EffectLaw, ...] = (
    effect_law("off_focal", "radiation from beside the focus", "%", (2.0, 20.0), _off_focal),
)
