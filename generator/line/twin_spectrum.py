"""What a twin's posterior and levels amount to: its spectral model, and the share of the noise that its spread leaves."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import Setting
from ...errors import InputError
from .spectral_signal import SpectralModel, attenuation_scale_name
from .twin import Level, NoiseModel, SpectralPosterior, Twin


@lru_cache(maxsize=8)
def _cached_model(key: tuple[Any, ...], highest_kV: float) -> SpectralModel:
    anode, angle, model, inherent, scintillator, alternative, cover, counting, names, correction, secondary_DN = key
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
        secondary_DN=secondary_DN,
    )


def spectral_posterior_of(twin: Twin) -> SpectralPosterior:
    """The twin's spectral part.

    Raises:
        InputError: it has none.
    """
    if twin.spectral is None:
        raise InputError(
            "twin",
            received="a twin without spectral part",
            expected="a twin calibrated from flats that state kV and tube load",
            remedy="calibrate from series with kV, current_mA or power_W, and exposure_ms",
        )
    return twin.spectral


def spectral_model_of(twin: Twin, *, highest_kV: float = 160.0) -> SpectralModel:
    """The twin's spectral model; its tables are kept for the next call.

    Raises:
        InputError: the twin has no spectral part.
    """
    return model_of_posterior(spectral_posterior_of(twin), highest_kV=highest_kV)


def model_of_posterior(posterior: SpectralPosterior, *, highest_kV: float = 160.0) -> SpectralModel:
    """The spectral model that a posterior's parameters belong to; its tables are kept for the next call."""
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
        posterior.secondary_DN,
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
    share = twin.noise.spread.value.variance_share
    white = twin.noise.white_fraction
    return (share + white) / (1.0 + white)


def gains_differ(levels: Sequence[Level]) -> float:
    """Relative standard deviation of the levels' gains: of a counter, how differently neighbours share in different beams."""
    known = [math.log(level.gain_DN.value) for level in levels if level.gain_DN.value > 0]
    return float(np.std(known, ddof=1)) if len(known) > 1 else 0.0


def slope_over_gain(
    levels: Sequence[Level], noise: NoiseModel, gain_DN: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Photon-transfer slope over gain (draw,) at gains (draw,), no unit; None without usable levels.

    slope = h (gain - w) + w: the spread leaves a share h of the quantum noise in one pixel, while what secondary quanta
    add, w for each DN of signal, is white and the same in every beam (`secondary_gain_DN`). Softer beams, of lower gain,
    hold more of it. At the levels' mean gain the ratio is the levels' own.
    """
    known = [
        (level.photon_transfer_slope_DN.value, level.gain_DN.value)
        for level in levels
        if level.photon_transfer_slope_DN.value > 0 and level.gain_DN.value > 0
    ]
    if not known:
        return None
    slopes, gains = np.log(np.array(known)).mean(axis=0)
    share, mean_gain = math.exp(slopes - gains), math.exp(gains)
    white = noise.white_fraction / (1.0 + noise.white_fraction)
    # of the slope at the mean gain: does not grow with the gain
    constant = (1.0 - noise.spread.value.variance_share) * white / share
    return np.asarray(share * (1.0 + constant * (mean_gain / np.asarray(gain_DN) - 1.0)))


def secondary_of_levels(levels: Sequence[Level], noise: NoiseModel) -> float | None:
    """Variance per signal that secondary quanta add in every beam, DN: the noise's white share of the levels' mean gain.

    None: there is no level with a gain.
    """
    known = [math.log(level.gain_DN.value) for level in levels if level.gain_DN.value > 0]
    if not known:
        return None
    return noise.white_fraction / (1.0 + noise.white_fraction) * math.exp(sum(known) / len(known))


def white_gain_DN(twin: Twin, gain_DN: float) -> float:
    """Variance per signal that secondary quanta add in every beam, DN (`secondary_of_levels`).

    Args:
        twin: the calibrated line.
        gain_DN: of the beam, whose own share counts where the twin has no levels.
    """
    found = secondary_of_levels(twin.levels, twin.noise)
    return twin.noise.white_fraction / (1.0 + twin.noise.white_fraction) * gain_DN if found is None else found


def gain_of_slope(twin: Twin, slope_DN: float) -> tuple[float, float]:
    """Gain, and what secondary quanta add to it (`white_gain_DN`), of a beam with this photon-transfer slope, DN.

    gain = (slope - w) / h + w: after the spread, which leaves a share h of the quanta's variance, one pixel has the slope.
    """
    left = twin.noise.spread.value.variance_share
    white = min(white_gain_DN(twin, slope_DN / slope_share(twin)), 0.9 * max(slope_DN, 0.0))
    return (slope_DN - white) / left + white, white


def secondary_gain_DN(twin: Twin, setting: Setting | None = None) -> float | None:
    """Variance per signal of what secondary quanta add, white and without regard to the spectrum, DN.

    K electrons a keV, drawn at random, add as much variance for each DN of signal whatever the photons' energies were, while
    the quantum variance per signal (gain less this) grows with them. Of a level with gain g and photon-transfer slope s,
    where the spread leaves a share h of the quantum variance in one pixel: (s - g h) / (1 - h).

    Args:
        twin: the calibrated line.
        setting: whose own level is used where it was measured; else the mean over all levels.

    Returns:
        0 or more; None where the twin has no levels.
    """
    share = twin.noise.spread.value.variance_share
    own = None if setting is None else twin.level_at(setting)
    levels = twin.levels if own is None else (own,)
    if not levels or share > 0.999:
        return None
    found = [(one.photon_transfer_slope_DN.value - one.gain_DN.value * share) / (1.0 - share) for one in levels]
    return max(sum(found) / len(found), 0.0)
