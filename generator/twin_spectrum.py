"""What a twin's posterior and levels amount to: its spectral model, and the share of the noise that its spread leaves."""

import math
from functools import lru_cache
from typing import Any

from ..errors import InputError
from .psf import blur_variance_share
from .spectral_signal import SpectralModel, attenuation_scale_name
from .twin import Twin


@lru_cache(maxsize=8)
def _cached_model(key: tuple[Any, ...], highest_kV: float) -> SpectralModel:
    anode, angle, model, inherent, scintillator, alternative, cover, counting, names, correction = key
    prefix = attenuation_scale_name("")
    return SpectralModel(
        anode=anode,
        anode_angle_deg=angle,
        model=model,
        inherent=inherent,
        scintillator=scintillator,
        alternative=alternative,
        cover=cover,
        counting=counting,
        filter_materials=[name.removeprefix(prefix) for name in names if name.startswith(prefix)],
        highest_kV=highest_kV,
        names=names,
        correction=correction,
    )


def spectral_model_of(twin: Twin, *, highest_kV: float = 160.0) -> SpectralModel:
    """The twin's spectral model; its tables are kept for the next call.

    Raises:
        InputError: the twin has no spectral part.
    """
    posterior = twin.spectral
    if posterior is None:
        raise InputError(
            "twin",
            received="a twin without spectral part",
            expected="a twin calibrated from flats that state kV and tube load",
            remedy="calibrate from series with kV, current_mA or power_W, and exposure_ms",
        )
    key = (
        posterior.anode,
        posterior.anode_angle_deg,
        posterior.model,
        posterior.inherent,
        posterior.scintillator,
        posterior.alternative,
        posterior.cover,
        posterior.counting,
        posterior.names,
        posterior.correction,
    )
    return _cached_model(key, max(160.0, 20.0 * math.ceil(highest_kV / 20.0)))


def slope_share(twin: Twin) -> float:
    """Photon-transfer slope over gain: the share of the noise that the spread leaves in one pixel; no unit.

    As the levels have it, geometric mean, where there are any: it is the same for all of them.
    """
    known = [
        math.log(level.photon_transfer_slope_DN.value / level.gain_DN.value)
        for level in twin.levels
        if level.photon_transfer_slope_DN.value > 0 and level.gain_DN.value > 0
    ]
    if known:
        return math.exp(sum(known) / len(known))
    share = blur_variance_share(twin.noise.psf_model, twin.noise.psf_sigma_px.value)
    white = twin.noise.white_fraction
    return (share + white) / (1.0 + white)
