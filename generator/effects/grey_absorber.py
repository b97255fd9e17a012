"""Part of the beam behind an absorber that nobody declared: a foil, a mesh, a collimator that has moved.

Behind it N(E) -> N(E) exp(-tau ((1 - h) + h mu_Al(E) / mu_Al(45 keV))), tau = -ln(1 - s): grey (h = 0) or a sheet of aluminium
(h = 1). It ends at a straight border, its penumbra a Gaussian's integral, or lies between two: a strip, a corner.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...errors import InputError
from ..line.line_state import FloatArray, LineContext, LineState
from ._sheets import Sheets
from .effect import LIT_SERIES, Effect, Grid, Parameter, Shows

_STATED_KEV = 45.0  # of the strength: mean energy of beams between 60 and 90 kV
_SHEET = "Al"
_DEPTHS = (0.05, 0.35, 1.0)  # of sheets that are projected, ln(1 / passed) at the stated energy
_MOST = 0.999
_OUTSIDE = -1.2  # of a border: half a diagonal and three of the widest penumbras from the middle


def _coverage(context: LineContext, parameters: Mapping[str, float], rotation_deg: float) -> FloatArray:
    """Share of the pixel's beam that is behind the absorber (row, column), 0 to 1."""
    from scipy.special import ndtr

    row, column = ((np.arange(side) - 0.5 * (side - 1)) / max(side - 1, 1) for side in context.shape)
    first = parameters["direction_deg"]
    covered = np.ones(context.shape)
    for direction_deg, border in ((first, "border"), (first + parameters["turn_deg"], "second_border")):
        angle = math.radians(direction_deg - rotation_deg)
        across = row[:, None] * math.cos(angle) + column[None, :] * math.sin(angle)
        covered *= ndtr((across - parameters[border]) / parameters["penumbra"])
    return covered


def _cover(state: LineState, parameters: Mapping[str, float], context: LineContext) -> LineState:
    request, model = context.request, context.model
    absorbed = context.since == "always"
    if parameters["strength"] == 0 or (absorbed and not context.has_scene and request.panel_rotation_deg == 0):
        return state
    if model is None or context.project is None or context.weights is None or context.energies_keV is None:
        raise InputError(
            "effect grey_absorber",
            received="a twin without spectral part",
            expected="a twin with one",
            remedy="calibrate from flats that state kV and tube load",
        )
    energies = context.energies_keV
    mu = model.mu(_SHEET)
    # a beam of less than the stated energy has no such photons, and the sheet is the same
    relative = (mu / float(np.interp(_STATED_KEV, model.energies_keV, mu)))[: energies.size]
    sheets = Sheets(_DEPTHS, relative)
    rows = sheets.rows(context.weights)
    depth = -math.log1p(-min(parameters["strength"] / 100.0, _MOST))

    def passed(sums: FloatArray) -> FloatArray:
        """Share that passes (2, row, column) of signal and variance, from sums behind each sheet."""
        grey = math.exp(-(1.0 - parameters["sheet_share"]) * depth)
        return grey * sheets.passed(sums, parameters["sheet_share"] * depth)

    covered = _coverage(context, parameters, request.panel_rotation_deg)
    signal, variance = 1.0 - covered * (1.0 - passed(context.project("grey_absorber", rows)))
    if absorbed:
        # the calibrated flat holds it as it is in the open beam of the unturned panel
        known = _coverage(context, parameters, 0.0)
        open_beam = passed(rows.sum(axis=1)[:, None, None])
        signal, variance = (
            now / (1.0 - known * (1.0 - one)) for now, one in zip((signal, variance), open_beam, strict=True)
        )
    return replace(state, signal_DN=state.signal_DN * signal, variance_DN2=state.variance_DN2 * variance)


GREY_ABSORBER = Effect(
    id="grey_absorber",
    title="part of the beam behind an absorber that nobody declared",
    law=r"N(E) \to N(E)\,\bigl(1 - c(u)\,c(v)\,"
    r"(1 - e^{-\tau\,(1 - h + h\,\mu_\mathrm{Al}(E)/\mu_\mathrm{Al}(45\,\mathrm{keV}))})\bigr),\quad s = 1 - e^{-\tau}",
    parameters=(
        Parameter(
            name="strength",
            unit="%",
            low=0.5,
            high=60.0,
            default=5.0,
            source="share of the light that it takes at 45 keV: tape or foil 0.5-5 %, a sheet or mesh up to 60 %",
            log=False,
            most=100.0,
        ),
        Parameter(
            name="direction_deg",
            unit="deg",
            low=0.0,
            high=360.0,
            default=30.0,
            source="from the open to the covered side: 0 along rising row index, 90 along rising column index",
            log=False,
        ),
        Parameter(
            name="border",
            unit="",
            low=-0.45,
            high=0.45,
            default=0.15,
            source="where the border crosses that direction, in widths of the field from its middle",
            log=False,
        ),
        Parameter(
            name="turn_deg",
            unit="deg",
            low=45.0,
            high=315.0,
            default=180.0,
            source="from the first border's direction to the second's: 180 for a strip, 90 or 270 for a corner",
            log=False,
        ),
        Parameter(
            name="second_border",
            unit="",
            low=_OUTSIDE,
            high=0.45,
            default=_OUTSIDE,
            source="where the second border crosses its own direction, as the first; outside the field there is none",
            log=False,
        ),
        Parameter(
            name="penumbra",
            unit="",
            low=0.004,
            high=0.15,
            default=0.03,
            source="standard deviation of the border's blur, in widths of the field: focal spot times the enlargement of the border",
            log=True,
            sought_last=True,
        ),
        Parameter(
            name="sheet_share",
            unit="",
            low=0.0,
            high=1.0,
            default=0.0,
            source="0: grey, as a mesh of wires; 1: as a sheet of aluminium",
            log=False,
            sought_last=True,
        ),
    ),
    stage="arrivals",
    reference="Beer-Lambert law behind a sheet; a mesh of opaque wires takes the same share at every energy",
    after_calibration=True,
    course="steady",
    pattern=True,
    change=_cover,
    needs=("spectral",),
    isolated_by="flats with the absorber's side of the beam uncovered, and with the panel turned by 180 degrees",
    shows=Shows(series=LIT_SERIES, axis="position"),
    absorbed="maps of beams",
    # a wide penumbra tells from afar which way a border lies; it narrows as the border is found
    grid=Grid(
        shares=(0.5,),
        variants=tuple(
            {
                "direction_deg": angle,
                "border": border,
                "turn_deg": turn,
                "second_border": second,
                "penumbra": 0.12,
                "sheet_share": 0.5,
            }
            for turn, border, second, angles in (
                (180.0, 0.0, _OUTSIDE, (0.0, 90.0, 180.0, 270.0)),
                (180.0, -0.15, -0.15, (0.0, 45.0, 90.0, 135.0)),
                (90.0, 0.0, 0.0, (0.0, 90.0, 180.0, 270.0)),
            )
            for angle in angles
        ),
    ),
)
