"""What flats, wedges and dosimeters say of a spectrum: logarithms with their noise, of numbered beams."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.instrument import Instrument
from ...acquisition.setting import Filter
from ...generator.line.spectral_signal import OpenBeam, SpectralModel
from ...generator.line.twin import Z95, Level, NoiseModel
from ...generator.line.twin_spectrum import slope_over_gain
from .dose_data import (
    DOSIMETER_CALIBRATION,
    KERMA_DISCREPANCY,
    RATIO_DISCREPANCY,
    KermaRatio,
    KermaReading,
)
from .priors import DARK_CURRENT, GAIN_DISCREPANCY, LEVEL_DISCREPANCY

_THICKER = 0.01  # relative, of the derivative by a wedge's thickness
WEDGE = "wedge_log_thickness:"  # names of parameters that scale the thicknesses of wedges
# kind of a datum -> whose learned size is its own departure from the model; the sizes' medians
DISCREPANCY_OF = {
    "rate": "level",
    "gain": "gain",
    "transmission": "level",
    "kerma": "kerma",
    "kerma_ratio": "ratio",
    "signal_ratio": "ratio",
}
DISCREPANCIES = {
    "level": LEVEL_DISCREPANCY,
    "gain": GAIN_DISCREPANCY,
    "kerma": KERMA_DISCREPANCY,
    "ratio": RATIO_DISCREPANCY,
}
OF_DETECTOR = ("rate", "gain", "transmission", "signal_ratio")


@dataclass(frozen=True, slots=True, kw_only=True)
class Transmission:
    """Signal behind known layers over the open signal at one kV and filter, with its relative standard deviation.

    wedge: name of the object, whose thicknesses and density are off alike at all its steps and voltages.
    """

    kV: float
    filters: tuple[Filter, ...]
    layers: tuple[Filter, ...]
    value: float
    relative_sd: float
    series: str = ""
    wedge: str = ""


@dataclass(frozen=True, slots=True)
class Datum:
    kind: str  # of `DISCREPANCY_OF`
    beam: int
    over: int  # beam of the denominator of a ratio
    value: float  # logarithm
    sd: float
    of: tuple[str, int]  # measurement: a level gives its rate and its gain
    moves: tuple[
        tuple[str, float], ...
    ] = ()  # parameters that no beam has, and by how much a unit of each moves the value


def geometry_factor(*, source_detector_mm: float | None, pixel_mm: float | None) -> float:
    """Photons on a pixel over those on 1 mm2 at 1 m: (1000 / d)^2 a^2; what is unknown counts as 1 m, 1 mm."""
    distance = 1000.0 if source_detector_mm is None else source_detector_mm
    pitch = 1.0 if pixel_mm is None else pixel_mm
    return (1000.0 / distance) ** 2 * pitch**2


def wedge_thickness_name(wedge: str) -> str:
    """Name of the parameter that scales the thicknesses of a wedge."""
    return f"{WEDGE}{wedge}"


def level_data(
    levels: Sequence[Level],
    instrument: Instrument,
    noise: NoiseModel | None,
    beams: dict[OpenBeam, int],
    *,
    dark: Sequence[float],
) -> list[Datum]:
    # A gain also wants the spread, by which all of them are off alike: slopes over one ratio carry the gains' dependence on
    # the spectrum, and what the ratio is known less by is added to predictions, where no average over beams lowers it.
    sloped = [level for level in levels if level.photon_transfer_slope_DN.value > 0 and level.gain_DN.value > 0]
    share = dict(zip(map(id, levels), _shares(levels, noise), strict=True)) if sloped else {}
    data = []
    for place, level in enumerate(levels):
        open_beam = OpenBeam(kV=level.kV or 0.0, filters=level.filters)
        beam, rate = beams.setdefault(open_beam, len(beams)), level.rate_DN_per_mAs
        too_high, too_low = (((DARK_CURRENT, sign * dark[place]),) if dark[place] else () for sign in (1.0, -1.0))
        if rate is not None and rate.value > 0:
            factor = geometry_factor(source_detector_mm=level.source_detector_mm, pixel_mm=instrument.pixel_mm)
            data.append(
                Datum("rate", beam, -1, math.log(rate.value / factor), relative_sd(rate), ("level", place), too_high)
            )
        gain = level.photon_transfer_slope_DN if share else level.gain_DN
        value = gain.value / share.get(id(level), 1.0)
        data.append(Datum("gain", beam, -1, math.log(max(value, 1e-12)), relative_sd(gain), ("level", place), too_low))
    return data


def _shares(levels: Sequence[Level], noise: NoiseModel | None) -> list[float]:
    """Photon-transfer slope over gain of each level, from all of them together."""
    gains = np.array([max(level.gain_DN.value, 1e-300) for level in levels])
    if noise is not None:
        # of the levels' own gains the mean is well known, and the ratio of one to another nearly enough
        found = slope_over_gain(levels, noise, gains)
        if found is not None:
            return [float(value) for value in found]
    known = [level for level in levels if level.photon_transfer_slope_DN.value > 0 and level.gain_DN.value > 0]
    ratios = [math.log(level.photon_transfer_slope_DN.value / level.gain_DN.value) for level in known]
    return [math.exp(float(np.mean(ratios)))] * len(levels)


def transmission_data(
    transmissions: Sequence[Transmission],
    model: SpectralModel,
    centre: NDArray[np.float64],
    beams: dict[OpenBeam, int],
) -> list[Datum]:
    """centre: parameter set (1, parameter) at which the thickness's derivative is taken."""

    def signal(beam: OpenBeam) -> float:
        return math.log(float(model.signal(centre, beam).rate_DN_per_mAs[0]))

    data = []
    for place, item in enumerate(transmissions):
        thicker = [replace(layer, thickness_mm=math.exp(_THICKER) * layer.thickness_mm) for layer in item.layers]
        open_beam, behind, farther = (
            OpenBeam(kV=item.kV, filters=(*item.filters, *layers)) for layers in ((), item.layers, thicker)
        )
        falls = (signal(farther) - signal(behind)) / _THICKER
        data.append(
            Datum(
                "transmission",
                beams.setdefault(behind, len(beams)),
                beams.setdefault(open_beam, len(beams)),
                math.log(item.value),
                item.relative_sd,
                ("transmission", place),
                ((wedge_thickness_name(item.wedge), falls),),
            )
        )
    return data


def dosimeter_data(
    kermas: Sequence[KermaReading], ratios: Sequence[KermaRatio], beams: dict[OpenBeam, int]
) -> list[Datum]:
    def number(kV: float, filters: tuple[Filter, ...], absorber: str = "") -> int:
        return beams.setdefault(OpenBeam(kV=kV, filters=filters, absorber=absorber), len(beams))

    data = []
    for place, item in enumerate(kermas):
        beam, value = number(item.kV, item.filters), math.log(item.value)
        moves = ((DOSIMETER_CALIBRATION, item.calibration_sd),)
        data.append(Datum("kerma", beam, -1, value, item.relative_sd, ("kerma", place), moves))
    for place, ratio in enumerate(ratios):
        behind = number(ratio.kV, (*ratio.filters, *ratio.layers), ratio.absorber)
        kind = "signal_ratio" if ratio.of_signal else "kerma_ratio"
        bare, value = number(ratio.kV, ratio.filters), math.log(ratio.value)
        data.append(Datum(kind, behind, bare, value, ratio.relative_sd, ("ratio", place)))
    return data


def repeated_levels(repeats: Sequence[Mapping[str, Any]]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Logarithms of the levels of each repeated setting, and their sampling's relative sd (series,) each."""
    found = []
    for row in repeats:
        levels = np.asarray(row.get("mean_signal_DN", ()), dtype=np.float64)
        sampling = 0.01 * np.asarray(row.get("sampling_percent", ()), dtype=np.float64)
        if levels.size > 1 and sampling.shape == levels.shape and np.all(levels > 0) and np.all(sampling > 0):
            found.append((np.log(levels), sampling))
    return found


def relative_sd(estimate: object) -> float:
    value, low, high = estimate.value, estimate.low, estimate.high  # type: ignore[attr-defined]
    return float((high - low) / (2 * Z95) / max(abs(value), 1e-300))
