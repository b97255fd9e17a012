"""K fluorescence caught again at a distance, for photons above the scintillator's K edges.

A share s of the photons above the edge sends out a K photon of energy E_K which is absorbed some distance away, with
K(f) = 1 / sqrt(1 + (2 pi L f)^2) (`order` 1/2; other shapes: _light_spread.py). The picture's transfer function becomes
1 - eta + eta K(f), the noise power 1 - nu + nu K(f):

    eta = s sum_above w1 E_K / E / sum w1          nu = s sum_above w2 2 (E - E_K) E_K / E^2 / sum w2

w1, w2: what each energy adds to signal and variance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ...acquisition.setting import Filter
from ...materials import (
    atomic_number_from_symbol,
    material_from_name,
)
from ..line.line_state import FloatArray, LineContext, LineState, needed
from ._light_spread import order_parameter, spread_transfer
from .effect import LIT_SERIES, Effect, Grid, Parameter, Reading, Shows

_USUAL_ORDER = 0.5


@lru_cache(maxsize=16)
def _k_edges(scintillator: tuple[Filter, ...]) -> tuple[tuple[float, float], ...]:
    """(edge, K-alpha line) in keV of the scintillator's elements, from 10 keV up."""
    import xraylib

    found = set()
    for layer in scintillator:
        for symbol in material_from_name(layer.material).mass_fractions:
            number = atomic_number_from_symbol(symbol)
            edge = float(xraylib.EdgeEnergy(number, xraylib.K_SHELL))
            if edge >= 10.0:
                found.add((edge, float(xraylib.LineEnergy(number, xraylib.KA_LINE))))
    return tuple(sorted(found))


def line_energy_keV(energies_keV: FloatArray, scintillator: Sequence[Filter]) -> FloatArray:
    """Energy of the K photon that a photon of each energy may cause (energy,), mean over the edges below it; 0: none."""
    total = np.zeros_like(energies_keV)
    count = np.zeros_like(energies_keV)
    for edge, line in _k_edges(tuple(scintillator)):
        above = energies_keV > edge
        total = total + np.where(above, line, 0.0)
        count = count + above
    return np.asarray(total / np.maximum(count, 1.0))


def _spread_k_photons(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    model, weights, energies = context.model, context.weights, context.energies_keV
    if parameters["strength"] == 0 or model is None or weights is None or energies is None or model.counting:
        return state
    share = parameters["strength"] / 100.0
    range_px = parameters["range_mm"] / needed(context.twin.instrument.pixel_mm, "pixel_mm", "k_fluorescence")
    part = line_energy_keV(energies, model.scintillator) / energies
    picture = share * float(weights[0] @ part) / float(weights[0].sum())
    power = share * float(weights[1] @ (2.0 * part * (1.0 - part))) / float(weights[1].sum())

    def transfer_of(amount: float, f_row: FloatArray, f_column: FloatArray) -> FloatArray:
        spread = spread_transfer(
            f_row, f_column, reach_px=range_px, order=parameters["order"], usual_order=_USUAL_ORDER
        )
        return np.asarray(1.0 - amount + amount * spread)

    return replace(
        state,
        object_transfers=(*state.object_transfers, lambda f_row, f_column: transfer_of(picture, f_row, f_column)),
        power_transfers=(*state.power_transfers, lambda f_row, f_column: transfer_of(power, f_row, f_column)),
    )


K_FLUORESCENCE = Effect(
    id="k_fluorescence",
    title="K fluorescence caught again in the scintillator",
    law=r"H(f) = 1 - \eta + \frac{\eta}{\sqrt{1 + (2\pi L f)^2}},\quad \eta = s\,\frac{\sum_{E > E_K} w_1 E_K / E}{\sum w_1}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=5.0,
            high=40.0,
            default=15.0,
            source="share of the photons above the K edge; K yield of I and Cs 0.88, jump ratio 6, half of it caught",
            log=False,
            most=100.0,
        ),
        Parameter(
            name="range_mm",
            unit="mm",
            low=0.1,
            high=0.5,
            default=0.2,
            source="absorption length of 29-31 keV photons in CsI is 0.25 mm",
            log=True,
        ),
        order_parameter(_USUAL_ORDER),
    ),
    stage="optics",
    reference="Metz and Vyborny (1983), doi:10.1088/0031-9155/28/5/008",
    after_calibration=False,
    course="steady",
    change=_spread_k_photons,
    needs=("spectral", "pixel_mm"),
    isolated_by="the same at a tube voltage below the scintillator's K edge (30 kV) and above it (60 kV)",
    shows=Shows(series=LIT_SERIES, axis="sharpness"),
    either_onset=True,
    absorbed="noise",
    reading=Reading(law_sd=0.36),  # a K photon's reach stands for how many there are: thirteen shares were off by 36 %
    grid=Grid(shares=(0.8,), variants=({"range_mm": 0.15}, {"range_mm": 0.33})),
)
