"""Effects of pixels and their neighbours, of tiles and readout lines: quanta that move, gains and lines that change."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .chain import SUBPIXELS
from .effect import Asked, EffectLaw, Site
from .effects_detector import planted
from .line import Exposure, FineRates, Planted, rates_of_map

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

    return _told(
        request,
        "quanta fly on in a random direction of space before they are counted, exponential free paths",
        {"path_px": path_px, "moved_share": moved},
        rates=hop,
    )


def _told(request: Asked, law: str, parameters: dict[str, Any], **hooks: Any) -> Planted:
    return planted(request, PIXEL_UNITS[request.id], law, parameters, **hooks)


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
)
PIXEL_UNITS = {law.id: law.unit for law in PIXEL_LAWS}
