"""Effects of the detector and its electronics: light that strays, charge that stays, responses, noises, bad pixels."""

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .chain import SUBPIXELS, FrameContext, Stage
from .effect import Asked, EffectLaw, Site, effect_law, planted
from .line import Exposure, FineRates, Planted, fine_rates, light_of_arrivals
from .system import DetectorMaps, LabSystem

Array = NDArray[np.float64]
Map = NDArray[np.float32]


def frame_rng(context: FrameContext, stream: int) -> np.random.Generator:
    """Random numbers of one frame and one effect, the same on any number of threads."""
    return np.random.default_rng([int(context.key), context.frame, stream])


@lru_cache(maxsize=64)
def gaussian_matrix(length: int, sigma_px: float) -> Map:
    """Spread along one axis (out, in): Gaussian integrated over pixels; the border pixels go on outside the field."""
    from scipy.special import ndtr

    edges = (np.arange(length)[:, None] - (np.arange(length + 1)[None, :] - 0.5)) / sigma_px
    upto = 1.0 - ndtr(edges)
    upto[:, 0], upto[:, -1] = 0.0, 1.0
    matrix: Map = np.diff(upto, axis=1).astype(np.float32)
    matrix[matrix < 1e-12] = 0.0  # denormal numbers would make every product ten times slower
    matrix.setflags(write=False)
    return matrix


# A product of so many multiplications is not worth a second thread to the libraries that numpy is built on; on a busy
# machine, waiting for one costs a hundred times the product itself.
_ONE_THREAD = 262_144


def _product(left: Map, right: Map) -> Map:
    rows = _ONE_THREAD // (left.shape[1] * right.shape[1])
    if rows < 4:
        whole: Map = left @ right
        return whole
    out = np.empty((left.shape[0], right.shape[1]), dtype=np.float32)
    for start in range(0, left.shape[0], rows):
        np.matmul(left[start : start + rows], right, out=out[start : start + rows])
    return out


def mixed_gaussians(image: Map, parts: tuple[tuple[float, float], ...]) -> Map:
    """Sum of weight x Gaussian spread (sigma in px) of an image."""
    total = np.zeros_like(image)
    for weight, sigma_px in parts:
        rows, columns = (gaussian_matrix(length, sigma_px) for length in image.shape)
        total += np.float32(weight) * _product(_product(rows, image), columns.T)
    return total


# --- light that strays ------------------------------------------------------------------------------------------------

# Shares and widths (over the range L) of the three Gaussians; their mean distance is L.
GLARE_PARTS = ((0.35, 0.25), (0.40, 0.75), (0.25, 1.64))


def _veiling_glare(request: Asked, site: Site) -> Planted:
    share, width_mm = request.strength / 100.0, float(np.exp(site.rng.uniform(math.log(2.0), math.log(12.0))))
    pixel_mm = site.system.pixel_mm
    parts = tuple((share * weight, scale * width_mm / pixel_mm) for weight, scale in GLARE_PARTS)

    def stray(light: Map, context: FrameContext) -> Map:
        out: Map = np.float32(1.0 - share) * light + mixed_gaussians(light, parts)
        return out

    return planted(
        request,
        "light under the cover glass: three Gaussians in place of an exponential",
        {"mean_distance_mm": width_mm},
        stages=(("spread", Stage(name="veiling_glare", apply=stray)),),
    )


def _mtf_tail(request: Asked, site: Site) -> Planted:
    weight = request.strength / 100.0
    inner_px = site.rng.uniform(1.2, 2.4)
    outer_px = inner_px * site.rng.uniform(2.0, 3.0)
    parts = ((0.6 * weight, float(inner_px)), (0.4 * weight, float(outer_px)))

    def tail(light: Map, context: FrameContext) -> Map:
        out: Map = np.float32(1.0 - weight) * light + mixed_gaussians(light, parts)
        return out

    return planted(
        request,
        "two Gaussians (60 and 40 % of the tail) behind the core's spread",
        {"sigma_inner_px": float(inner_px), "sigma_outer_px": float(outer_px)},
        stages=(("spread", Stage(name="mtf_tail", apply=tail)),),
    )


# --- photons that are caught elsewhere -----------------------------------------------------------------------------------

# K edge and K photon, keV: between iodine's 33.2 and caesium's 36.0, and gadolinium's
K_OF_SCINTILLATOR = {"CsI": (34.5, 29.8), "Gd2O2S@7.32": (50.2, 42.8)}
# Share of the K photons, distance over the mean range, and direction of the first of four, in quarter turns.
RINGS = ((0.55, 0.5, 0.0), (0.45, 1.6, 0.5))


def _k_fluorescence(request: Asked, site: Site) -> Planted:
    share = request.strength / 100.0
    range_mm = float(site.rng.uniform(0.12, 0.4))
    edge_keV, line_keV = K_OF_SCINTILLATOR[site.system.scintillator]
    fine_mm = site.system.pixel_mm / SUBPIXELS
    offsets: list[tuple[float, int, int]] = []
    for weight, distance, start in RINGS:
        for quarter in range(4):
            angle = 0.5 * math.pi * (quarter + start)
            y, x = (distance * range_mm / fine_mm * turn for turn in (math.sin(angle), math.cos(angle)))
            offsets.append((0.25 * weight, round(y), round(x)))

    def split(rates: FineRates, exposure: Exposure) -> FineRates:
        above = rates.deposit_keV > edge_keV
        if not above.any():
            return rates
        remote = rates.rates[:, above].sum(axis=1) * np.float32(share)
        kept_keV = rates.rates[:, above] @ (rates.deposit_keV[above] - line_keV) * share / np.maximum(remote, 1e-30)
        left = np.where(above, np.float32(1.0 - share), np.float32(1.0)) * rates.rates
        return replace(
            fine_rates(rates.cell, left.astype(np.float32), rates.deposit_keV),
            remote=remote.astype(np.float32),
            remote_keV=kept_keV.astype(np.float32),
        )

    def stop(arrivals: FineRates, context: FrameContext) -> Map:
        from ._loops import poisson_tables
        from ._session_loops import light_quanta

        light = light_of_arrivals(arrivals, context)
        if arrivals.remote is None or arrivals.remote_keV is None:
            return light
        keep, alias = poisson_tables()
        kept_keV = arrivals.remote_keV[arrivals.cell]
        quanta = np.empty_like(light)
        variance = 1.0 / context.system.light_swank - 1.0
        factor = arrivals.load_mAs * context.summed / SUBPIXELS**2
        rows, columns = light.shape
        for number, (weight, down, right) in enumerate(offsets):
            light_quanta(
                arrivals.cell,
                arrivals.remote,
                factor * weight,
                variance,
                context.key,
                20 + number,
                context.frame,
                keep,
                alias,
                quanta,
            )
            light += quanta * kept_keV
            from_row = np.clip(np.arange(rows) - down, 0, rows - 1)
            from_column = np.clip(np.arange(columns) - right, 0, columns - 1)
            light += np.float32(line_keV) * quanta[from_row][:, from_column]
        return light

    return planted(
        request,
        f"photons above the K edges leave {line_keV:g} keV in one of eight places around, on two rings",
        {"range_mm": range_mm, "places": [list(place) for place in offsets]},
        rates=split,
        in_screen=True,
        stages=(("-photons", Stage(name="photons", apply=stop)),),
    )


# --- charge -----------------------------------------------------------------------------------------------------------

TRAP_TIMES_S = (0.05, 0.25, 1.2, 6.0, 30.0)


def lag_of_signals(signals: Array, interval_s: Array, capture: Array) -> Array:
    """What a pixel reads, frame by frame, from the charge that each frame makes (any unit).

    y_n = x_n (1 - sum_k c_k) + sum_k q_k (1 - exp(-t / tau_k)), with q_k the charge that trap k holds and t the time
    since the frame before.
    """
    held = np.zeros(len(TRAP_TIMES_S))
    times = np.asarray(TRAP_TIMES_S)
    read = np.empty(signals.size)
    for number, (signal, interval) in enumerate(zip(signals, interval_s, strict=True)):
        freed = held * -np.expm1(-interval / times)
        read[number] = signal * (1.0 - capture.sum()) + freed.sum()
        held += signal * capture - freed
    return read


def _session_signals(site: Site, *, since: str | None) -> tuple[Array, Array, int]:
    """Relative signal and interval (s) of every frame up to the first beam-off one, and that frame's number.

    Traps that came after the calibration have caught nothing before.
    A session without such a series stands for 50 frames at the longest exposure, then one without beam.
    """
    geometry, readout_ms = site.geometry, site.system.readout_ms
    takes = site.plan.takes
    last = next((number for number, take in enumerate(takes) if take.kind == "afterglow"), None)
    signals: list[float] = []
    intervals: list[float] = []
    if last is None:
        return np.array([1.0] * 50 + [0.0]), np.full(51, (100.0 + readout_ms) / 1000.0), 50
    for take in takes[: last + 1]:
        setting = take.setting
        level = 0.0
        if take.kind == "flat" and not (since == "calibration" and take.role == "calibration"):
            nominal_W = geometry.power_W[setting.kV, bool(setting.filters)]
            level = (setting.power_W or 0.0) / nominal_W * setting.exposure_ms / 100.0
        count = 1 if take is takes[last] else take.frames * setting.averaged
        interval_s = (setting.exposure_ms + readout_ms) / 1000.0
        intervals += [interval_s + take.pause_s, *([interval_s] * (count - 1))]
        signals += [level] * count
    return np.array(signals), np.array(intervals), len(signals) - 1


def _image_lag(request: Asked, site: Site) -> Planted:
    power = float(site.rng.uniform(0.2, 0.8))
    times = np.asarray(TRAP_TIMES_S)
    share = times**-power / (times**-power).sum()
    signals, intervals, off = _session_signals(site, since=request.since)

    def first_frame(capture: float) -> float:
        read = lag_of_signals(signals, intervals, capture * share)
        return float(read[off] / read[off - 1])

    # The ratio is nearly proportional to what is caught.
    capture = request.strength / 100.0
    for _ in range(6):
        capture *= request.strength / 100.0 / first_frame(capture)
    caught = (capture * share).astype(np.float32)

    def trap(electrons: Map, context: FrameContext) -> Map:
        held, before_s = context.memory.get("image_lag", (None, 0.0))
        if held is None:
            held = np.zeros((times.size, *electrons.shape), dtype=np.float32)
            before_s = context.began_s
        freed_share = -np.expm1(-(context.began_s - before_s) / times).astype(np.float32)
        freed = held * freed_share[:, None, None]
        context.memory["image_lag"] = (held - freed + caught[:, None, None] * electrons, context.began_s)
        read: Map = electrons * np.float32(1.0 - capture) + freed.sum(axis=0)
        return read

    return planted(
        request,
        "five kinds of traps with release times from 50 ms to 30 s, caught charge falling as a power of the time",
        {"power": power, "caught_share": capture, "times_s": list(TRAP_TIMES_S)},
        stages=(("electrons", Stage(name="image_lag", apply=trap, additive=False)),),
    )


def _nonlinearity(request: Asked, site: Site) -> Planted:
    system = site.system
    highest_DN = system.saturation_DN - system.dark_DN
    departure = request.strength / 100.0

    def departs(u: float) -> float:
        return 1.0 if u == 0 else -math.expm1(-u) / u

    # (1 - exp(-u)) / u = 1 - departure at half of the highest level; by Newton's method.
    u = 2.0 * departure
    for _ in range(30):
        slope = (departs(u + 1e-6) - departs(u - 1e-6)) / 2e-6
        u -= (departs(u) - (1.0 - departure)) / slope
    full_DN = 0.5 * highest_DN / u
    full_electrons = np.float32(full_DN / system.DN_per_electron)

    def charge(electrons: Map, context: FrameContext) -> Map:
        out: Map = -full_electrons * np.expm1(-electrons / full_electrons)
        return out

    return planted(
        request,
        "a capacitor that charges: y = C (1 - exp(-x / C))",
        {"capacity_DN": full_DN, "highest_level_DN": highest_DN},
        stages=(("electrons", Stage(name="nonlinearity", apply=charge, additive=False)),),
    )


def _burn_in(request: Asked, site: Site) -> Planted:
    """Traps of the screen, of two depths: light fills each only once, and they empty."""
    system = site.system
    full_electrons = (system.saturation_DN - system.dark_DN) / system.DN_per_electron
    fills_after = float(site.rng.uniform(150.0, 600.0))  # exposures at full scale, by which all but 1/e are full
    most = request.strength / 100.0 / -math.expm1(-100.0 / fills_after)
    empty_s = float(math.exp(site.rng.uniform(math.log(200.0), math.log(1000.0)))), 20_000.0

    def brighten(light: Map, context: FrameContext) -> Map:
        full, when_s = context.memory.get("burn_in", (np.zeros((2, *light.shape), np.float32), context.began_s))
        waited_s = max(context.began_s - when_s, 0.0)
        full = full * np.exp(-waited_s / np.array(empty_s, np.float32))[:, None, None]
        out: Map = light * (1.0 + np.float32(most) * full.mean(axis=0))
        reached = -np.expm1(-light * np.float32(system.electrons_per_keV / (fills_after * full_electrons)))
        context.memory["burn_in"] = full + (1.0 - full) * reached, context.began_s
        return out

    return planted(
        request,
        "traps of the screen, half quick and half slow, that light fills only once",
        {"fills_after_exposures": fills_after, "empty_s": list(empty_s)},
        stages=(("spread", Stage(name="burn_in", apply=brighten, additive=False)),),
    )


_COUNTED_KEV = 45.0  # that one photon leaves, as a beam of 90 kV leaves on average


def _pile_up(request: Asked, site: Site) -> Planted:
    """Pulses that a pixel cannot tell apart: each photon prolongs the dead time, counted or not."""
    dead_ms, quantum = 1e-6 * request.strength, _COUNTED_KEV * site.system.electrons_per_keV

    def miss(electrons: Map, context: FrameContext) -> Map:
        busy = electrons * np.float32(dead_ms / (quantum * context.exposure_ms * context.summed))
        # beyond one photon a dead time fewer are counted the more come
        out: Map = electrons * np.exp(-busy)
        return out

    return planted(
        request,
        "a counter whose dead time each photon prolongs: y = x exp(-x tau / t)",
        {"electrons_a_count": quantum},
        stages=(("electrons", Stage(name="pile_up", apply=miss, additive=False)),),
    )


_THRESHOLD_KEV, _COMPARATOR_KEV = (
    20.0,
    0.8,
)  # below the lowest voltage, above electronic noise; width of a comparator's step


def _threshold_error(request: Asked, site: Site) -> Planted:
    """A comparator that lets go of what leaves little more than its threshold."""
    higher_keV = _THRESHOLD_KEV + request.strength

    def miss(rates: FineRates, exposure: Exposure) -> FineRates:
        lower, higher = (
            0.5 * (1.0 + np.tanh((rates.deposit_keV - at) / (2.0 * _COMPARATOR_KEV)))
            for at in (_THRESHOLD_KEV, higher_keV)
        )
        left = (rates.rates * (1.0 - (lower - higher))).astype(np.float32)
        return replace(
            fine_rates(rates.cell, left, rates.deposit_keV, load_mAs=rates.load_mAs),
            remote=rates.remote,
            remote_keV=rates.remote_keV,
        )

    return planted(
        request,
        "a counter that no longer counts photons of 20 keV to so much more, its step a logistic curve",
        {"threshold_keV": _THRESHOLD_KEV, "width_keV": _COMPARATOR_KEV},
        rates=miss,
        in_screen=True,
    )


# --- drift ------------------------------------------------------------------------------------------------------------


def _dark_drift(request: Asked, site: Site) -> Planted:
    duration_s = site.plan.duration_s(site.system.readout_ms)
    settle_s = duration_s * float(site.rng.uniform(0.2, 0.9))
    longest_ms = max(take.setting.exposure_ms for take in site.plan.takes)
    shape = (site.system.rows, site.system.columns)
    y, x = (np.linspace(-1.0, 1.0, length) for length in shape)
    angle = site.rng.uniform(0.0, 2.0 * math.pi)
    warmth = 1.0 + 0.3 * (math.sin(angle) * y[:, None] + math.cos(angle) * x[None, :])
    pattern = (warmth * np.exp(0.1 * site.rng.standard_normal(shape))).astype(np.float32)
    pattern /= np.float32(np.median(pattern))
    DN_per_ms = request.strength / longest_ms

    def warm(electrons: Map, context: FrameContext) -> Map:
        grown = math.expm1(-context.began_s / settle_s) / math.expm1(-duration_s / settle_s)
        extra_DN = DN_per_ms * context.exposure_ms * context.summed * grown
        out: Map = electrons + np.float32(extra_DN / context.system.DN_per_electron) * pattern
        return out

    return planted(
        request,
        "dark current of a panel that warms up: 1 - exp(-t / T), warmer on one side",
        {"settling_s": settle_s, "session_s": duration_s, "longest_exposure_ms": longest_ms},
        stages=(("electrons", Stage(name="dark_drift", apply=warm, additive=False)),),
    )


# --- fixed patterns, noises, codes ------------------------------------------------------------------------------------


def _gain_map_error(request: Asked, site: Site) -> Planted:
    rng, shape = site.rng, (site.system.rows, site.system.columns)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]] / max(shape)
    smooth = np.zeros(shape)
    for _ in range(8):
        waves = rng.uniform(-4.0, 4.0, size=2)
        smooth += rng.standard_normal() * np.cos(
            2.0 * math.pi * (waves[0] * y + waves[1] * x) + rng.uniform(0.0, 2.0 * math.pi)
        )
    pattern = smooth / smooth.std() + 2.0 * rng.standard_normal(shape)
    pattern = (pattern - pattern.mean()) / pattern.std() * request.strength / 100.0

    def change(maps: DetectorMaps) -> DetectorMaps:
        return replace(maps, DN_per_electron=(maps.DN_per_electron * (1.0 + pattern)).astype(np.float32))

    return planted(request, "a new pattern: a fifth of its variance smooth, the rest pixel by pixel", {}, maps=change)


def _bad_pixels(request: Asked, site: Site) -> Planted:
    rng, rows, columns = site.rng, site.system.rows, site.system.columns
    wanted = max(1, round(request.strength / 100.0 * rows * columns))
    kinds: dict[tuple[int, int], str] = {}

    def kind() -> str:
        return str(rng.choice(["dead", "hot", "weak"], p=[0.4, 0.4, 0.2]))

    if rng.random() < 0.5 and wanted >= 20:
        # A stretch of a line.
        column, start, length = int(rng.integers(columns)), int(rng.integers(rows)), min(wanted // 3, rows // 2)
        one = kind()
        kinds |= {((start + step) % rows, column): one for step in range(length)}
    while len(kinds) < wanted:
        row, column = int(rng.integers(rows)), int(rng.integers(columns))
        size = int(rng.integers(2, 7)) if rng.random() < 0.1 else 1
        one = kind()
        for step in range(size):
            place = (min(row + step // 3, rows - 1), min(column + step % 3, columns - 1))
            if len(kinds) < wanted:
                kinds.setdefault(place, one)
    factors = rng.uniform(0.3, 0.75, size=wanted)
    glow = np.exp(rng.uniform(math.log(1.0), math.log(20.0), size=wanted))

    def change(maps: DetectorMaps) -> DetectorMaps:
        conversion, current = maps.DN_per_electron.copy(), maps.dark_current_DN_per_ms.copy()
        noise = maps.read_noise_DN.copy()
        for number, ((row, column), what) in enumerate(kinds.items()):
            if what == "dead":
                conversion[row, column] = 0.0
            elif what == "weak":
                conversion[row, column] *= factors[number]
            else:
                current[row, column] += glow[number]
                noise[row, column] *= 5.0
        return replace(maps, DN_per_electron=conversion, dark_current_DN_per_ms=current, read_noise_DN=noise)

    places = [[row, column, what] for (row, column), what in sorted(kinds.items())]
    return planted(
        request,
        "new dead, hot and weak pixels, some in clusters or a line",
        {"pixels": wanted, "places": places},
        maps=change,
    )


def _excess_noise(request: Asked, site: Site) -> Planted:
    def change(system: LabSystem) -> LabSystem:
        return replace(system, light_swank=system.light_swank / (1.0 + request.strength / 100.0))

    return planted(
        request, "the light of a photon varies more: 1/A grows, a gamma law for each photon", {}, system=change
    )


def _row_noise(request: Asked, site: Site) -> Planted:
    along_rows = bool(site.rng.random() < 0.7)
    bands = int(site.rng.choice((1, 1, 2, 4)))  # lines that go up and down together: a running mean of so many
    degrees = 6.0
    scale_DN = request.strength * site.system.read_noise_DN / math.sqrt(degrees / (degrees - 2.0))

    def lines(level_DN: Map, context: FrameContext) -> Map:
        rng = frame_rng(context, 11)
        count = level_DN.shape[0 if along_rows else 1]
        each = rng.standard_t(degrees, size=count + bands - 1)
        drawn = np.asarray(np.convolve(each, np.ones(bands), "valid") / math.sqrt(bands), dtype=np.float32)
        offsets = drawn * np.float32(scale_DN / math.sqrt(context.summed))
        out: Map = level_DN + (offsets[:, None] if along_rows else offsets[None, :])
        return out

    return planted(
        request,
        "offsets of lines with long tails (Student's t, 6 degrees), each its own or in bands",
        {"axis": "row" if along_rows else "column", "bands": bands},
        stages=(("readout", Stage(name="row_noise", apply=lines)),),
    )


def _quantisation(request: Asked, site: Site) -> Planted:
    step = np.float32(request.strength)

    def truncate(level_DN: Map, context: FrameContext) -> NDArray[Any]:
        whole = np.rint(np.floor(level_DN / step) * step)
        numbers: NDArray[np.uint16] = np.asarray(np.clip(whole, 0, context.system.saturation_DN), dtype=np.uint16)
        return numbers

    return planted(
        request,
        "an ADC of coarser steps that truncates",
        {},
        stages=(("-digitise", Stage(name="digitise", apply=truncate, additive=False)),),
    )


DETECTOR_LAWS: tuple[EffectLaw, ...] = (
    effect_law("veiling_glare", "light that strays far", "%", (0.5, 5.0), _veiling_glare),
    effect_law("mtf_tail", "a wide tail of the optical spread", "%", (2.0, 40.0), _mtf_tail, since="calibration"),
    effect_law("k_fluorescence", "K photons caught at a distance", "%", (5.0, 40.0), _k_fluorescence),
    effect_law("image_lag", "charge that is trapped and released later", "%", (0.02, 5.0), _image_lag),
    effect_law("nonlinearity", "a response that saturates softly", "%", (0.3, 5.0), _nonlinearity, signed=True),
    effect_law("dark_drift", "a dark level that drifts", "DN", (1.0, 100.0), _dark_drift),
    effect_law("gain_map_error", "a gain map that changed", "%", (0.1, 3.0), _gain_map_error, since="calibration"),
    effect_law("bad_pixels", "new bad pixels", "%", (0.02, 2.0), _bad_pixels, since="calibration"),
    effect_law(
        "excess_noise", "more noise than quanta alone bring", "%", (3.0, 100.0), _excess_noise, since="calibration"
    ),
    effect_law("row_noise", "offsets of lines, new in every frame", "sigma", (0.05, 2.0), _row_noise),
    effect_law("quantisation", "lost bits", "DN", (2.0, 64.0), _quantisation),
)
# further ones come last in the registry: the random numbers of those before stay theirs
MEMORY_LAWS: tuple[EffectLaw, ...] = (
    effect_law("burn_in", "a screen that light makes brighter", "%", (0.05, 5.0), _burn_in),
    effect_law("pile_up", "pulses that pile up", "ns", (10.0, 1000.0), _pile_up, drawn=False),
    effect_law(
        "threshold_error",
        "a threshold that rose",
        "keV",
        (0.2, 8.0),
        _threshold_error,
        since="calibration",
        drawn=False,
    ),
)
