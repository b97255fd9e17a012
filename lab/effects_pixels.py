"""Effects of pixels and their neighbours, of tiles and readout lines: quanta that move, gains and lines that change."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .chain import SUBPIXELS, FrameContext, Stage
from .effect import Asked, EffectLaw, Site, planted
from .effects_detector import Map, frame_rng
from .line import Exposure, FineRates, Planted, rates_of_map
from .system import DetectorMaps

Array = NDArray[np.float64]

# --- quanta that are counted in a neighbouring pixel ------------------------------------------------------------------

_HOPS = 40_000
_FARTHEST_PX = 8.0


def hop_shares(rng: np.random.Generator, path_px: float) -> Array:
    """Shares of moved quanta by offset on the fine grid (down, right), odd sides: free paths in random directions of space.

    A quantum flies an exponential path of mean `path_px` in any direction; what lies across the panel is its move. Those beyond
    8 px count there.
    """
    path = rng.exponential(path_px, _HOPS)
    across = path * np.sqrt(1.0 - rng.uniform(-1.0, 1.0, _HOPS) ** 2)
    across = np.minimum(across, _FARTHEST_PX)
    angle = rng.uniform(0.0, 2.0 * np.pi, _HOPS)
    fine = np.rint(SUBPIXELS * across * np.stack([np.sin(angle), np.cos(angle)])).astype(np.intp)
    reach = round(_FARTHEST_PX * SUBPIXELS)
    shares = np.zeros((2 * reach + 1, 2 * reach + 1))
    np.add.at(shares, (fine[0] + reach, fine[1] + reach), 1.0 / _HOPS)
    # no direction is preferred: what 40,000 draws leave of one is averaged away
    turned = [np.rot90(shares, quarter) for quarter in range(4)]
    even: Array = sum(turned + [one.T for one in turned], np.zeros_like(shares)) / 8.0
    return even


def left_their_pixel(shares: Array) -> float:
    """Share of quanta, from anywhere in a pixel, that are in another one after a move."""
    reach = shares.shape[0] // 2
    stay = np.maximum(1.0 - np.abs(np.arange(-reach, reach + 1)) / SUBPIXELS, 0.0)
    return float(1.0 - stay @ shares @ stay)


def _crosstalk(request: Asked, site: Site) -> Planted:
    path_px = float(site.rng.uniform(0.8, 2.0))
    shares = hop_shares(site.rng, path_px)
    moved = request.strength / 100.0 / left_their_pixel(shares)
    kernel = moved * shares
    kernel[kernel.shape[0] // 2, kernel.shape[1] // 2] += 1.0 - moved

    def hop(rates: FineRates, exposure: Exposure) -> FineRates:
        from scipy.signal import oaconvolve

        if not exposure.scene:
            return rates  # in an even field as many come as go
        spelled = rates.spelled_out()
        reach = kernel.shape[0] // 2
        out = np.empty_like(spelled)
        for number in range(spelled.shape[2]):
            wide = np.pad(spelled[:, :, number], reach, mode="edge")
            # quanta that move independently arrive as a Poisson process of the mean rate
            out[:, :, number] = np.maximum(oaconvolve(wide, kernel.astype(np.float32), mode="valid"), 0.0)
        return rates_of_map(out, rates)

    return planted(
        request,
        "quanta fly on in a random direction of space before they are counted, exponential free paths",
        {"path_px": path_px, "moved_share": moved},
        rates=hop,
    )


# --- tiles and readout channels ---------------------------------------------------------------------------------------


def _tile_gain(request: Asked, site: Site) -> Planted:
    """Chips beside each other: each column of chips, or each chip, has an amplifier whose gain has aged."""
    rng, shape = site.rng, (site.system.rows, site.system.columns)
    wide = int(rng.integers(24, 68))
    begins = int(rng.integers(0, wide))  # the panel's border cuts the first chip
    column_of = (np.arange(shape[1]) + begins) // wide
    channels = bool(rng.random() < 0.5)
    row_of = np.zeros(shape[0], dtype=np.intp) if channels else (np.arange(shape[0]) + begins) // wide
    # ageing is one-sided: some chips lost much, most a little
    lost = rng.gamma(2.0, 1.0, size=(row_of[-1] + 1, column_of[-1] + 1))
    pattern = lost[row_of][:, column_of]
    pattern = -(pattern - pattern.mean()) / pattern.std() * request.strength / 100.0
    narrow = bool(rng.random() < 0.5)
    if narrow:  # pixels beside a seam catch less; the strength stays that of the chips' gains
        seams = [np.flatnonzero(np.diff(number)) for number in (row_of, column_of)]
        for axis, seam in enumerate(seams):
            beside = np.concatenate([seam, seam + 1])
            np.moveaxis(pattern, axis, 0)[beside] -= 2.0 * request.strength / 100.0

    def change(maps: DetectorMaps) -> DetectorMaps:
        return replace(maps, DN_per_electron=(maps.DN_per_electron * (1.0 + pattern)).astype(np.float32))

    return planted(
        request,
        "amplifiers of chips that have aged, gamma-distributed losses; chips in columns or in a grid that the border cuts, in half of"
        " the cases with narrow pixels at their seams",
        {"chip_px": wide, "first_px": wide - begins, "channels": channels, "narrow": narrow},
        maps=change,
    )


# --- lines that flicker -----------------------------------------------------------------------------------------------

_HARMONICS = ((1.0, 1.0), (2.0, 0.4), (3.0, 0.25))  # of a rectified ripple: multiple of its frequency, amplitude


def _line_flicker(request: Asked, site: Site) -> Planted:
    """Rows are read one after another while the tube's output ripples; frames begin anywhere in the ripple."""
    cycles_a_line = float(np.exp(site.rng.uniform(np.log(0.03), np.log(0.3))))
    wander = float(site.rng.uniform(0.1, 0.4))  # the ripple's phase wanders from line to line, cycles
    scale = request.strength / 100.0 / np.sqrt(sum(0.5 * height**2 for _, height in _HARMONICS))

    def ripple(light: Map, context: FrameContext) -> Map:
        rng = frame_rng(context, 15)
        total = np.zeros(light.shape[0])
        for _ in range(context.summed):
            steps = cycles_a_line * (1.0 + wander * rng.standard_normal(light.shape[0]))
            phase = rng.random() + np.cumsum(steps)
            total += sum(height * np.cos(2.0 * np.pi * times * phase) for times, height in _HARMONICS)
        factor = 1.0 + scale * total / context.summed
        out: Map = light * factor[:, None].astype(np.float32)
        return out

    return planted(
        request,
        "a rolling readout under a ripple of three harmonics whose phase wanders",
        {"cycles_a_line": cycles_a_line, "wander": wander},
        stages=(("spread", Stage(name="line_flicker", apply=ripple)),),
    )


# --- pixels that jump ---------------------------------------------------------------------------------------------------


def _random_telegraph(request: Asked, site: Site) -> Planted:
    rng, shape = site.rng, (site.system.rows, site.system.columns)
    count = max(1, round(request.strength / 100.0 * shape[0] * shape[1]))
    places = rng.choice(shape[0] * shape[1], size=count, replace=False)
    height_DN = (rng.uniform(3.0, 10.0, size=count) * site.system.read_noise_DN).astype(np.float32)
    switches = 1.0 / rng.uniform(3.0, 15.0, size=count)

    def jump(level_DN: Map, context: FrameContext) -> Map:
        state = context.memory.get("random_telegraph")
        drawn = frame_rng(context, 14).random(count)
        state = (drawn < 0.5) if state is None else state ^ (drawn < switches)
        context.memory["random_telegraph"] = state
        out = level_DN.copy()
        out.ravel()[places] += np.where(state, height_DN, np.float32(0.0))
        return out

    return planted(
        request,
        "pixels whose dark level jumps between two values and stays for some frames",
        {"pixels": count},
        stages=(("readout", Stage(name="random_telegraph", apply=jump, additive=False)),),
    )


PIXEL_LAWS: tuple[EffectLaw, ...] = (
    EffectLaw(
        id="crosstalk",
        title="quanta counted in a neighbouring pixel",
        unit="%",
        low=3.0,
        high=40.0,
        since="always",
        build=_crosstalk,
    ),
    EffectLaw(
        id="tile_gain",
        title="gains of tiles or readout channels",
        unit="%",
        low=0.2,
        high=3.0,
        since="calibration",
        build=_tile_gain,
    ),
    EffectLaw(
        id="line_flicker",
        title="lines that flicker with the light",
        unit="%",
        low=0.03,
        high=1.0,
        since="always",
        build=_line_flicker,
    ),
)
JUMP_LAWS: tuple[EffectLaw, ...] = (
    EffectLaw(
        id="random_telegraph",
        title="random-telegraph pixels",
        unit="%",
        low=0.3,
        high=10.0,
        since="calibration",
        build=_random_telegraph,
    ),
)
