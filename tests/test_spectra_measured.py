"""Tungsten spectra that PTB measured: one parameter more than the tube's sheet, fitted on two kV, tested on the others.

Ketelhut and Bueermann, PTB (CC BY 4.0): germanium detector, 4 mm Be, 30 degrees, 1 m of air. Longer comparison:
validation/ptb_spectra.py.
"""

import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from raytwin.acquisition.setting import Filter
from raytwin.spectra import spectrum_from_file, tube_spectrum

MEASURED = Path(__file__).parents[2] / "shared" / "realdata" / "ptb_tungsten"
VOLTAGES_KV = (20, 25, 30, 35, 45)
ABOVE_KEV = 13.0
DECLARED = (Filter(material="Be", thickness_mm=4.0), Filter(material="air", thickness_mm=1000.0))
STEP = {"W": 0.001, "Al": 0.1, "kV": 1.0}  # mm, mm, per cent

pytestmark = [
    pytest.mark.realdata,
    pytest.mark.skipif(
        not MEASURED.is_dir(), reason="the PTB tungsten spectra (shared/realdata/ptb_tungsten) are not here"
    ),
]


@pytest.fixture(scope="module")
def measured():
    return {kV: spectrum_from_file(MEASURED / f"W_{kV}kV.dat") for kV in VOLTAGES_KV}


def shape(fluence, energies_keV):
    above = fluence[energies_keV > ABOVE_KEV]
    return above / above.sum()


def shapes(measured, voltages):
    return [shape(measured[kV].fluence, measured[kV].energies_keV) for kV in voltages]


def modelled(measured, voltages, **more):
    """Shapes of the model with W or Al (steps of thickness) or kV (per cent) beside what the sheet declares."""
    found = []
    for kV in voltages:
        layers = [
            Filter(material=name, thickness_mm=more[name] * STEP[name]) for name in ("W", "Al") if more.get(name, 0) > 0
        ]
        model = tube_spectrum(
            kV=kV * (1 + 0.01 * more.get("kV", 0.0)),
            anode_angle_deg=30,
            filters=(*DECLARED, *layers),
            energies_keV=measured[kV].energies_keV,
        )
        found.append(shape(model.fluence, model.energies_keV))
    return found


def fitted(measured, voltages, name):
    """Least squares of the roots of the shapes, so that a bin weighs by its photons; in steps."""
    roots = np.sqrt(np.concatenate(shapes(measured, voltages)))
    answer = least_squares(
        lambda x: np.sqrt(np.concatenate(modelled(measured, voltages, **{name: x[0]}))) - roots,
        [0.3],
        bounds=([-4.0 if name == "kV" else 0.0], [20.0]),
        diff_step=1e-3,
    )
    return float(answer.x[0])


def mean_error(measured, voltages, **more):
    """Mean total variation: the share of photons above 13 keV that would have to move."""
    pairs = zip(modelled(measured, voltages, **more), shapes(measured, voltages), strict=True)
    return float(np.mean([0.5 * np.abs(ours - theirs).sum() for ours, theirs in pairs]))


@pytest.mark.parametrize("name", ["W", "Al"])
def test_one_layer_fitted_on_any_two_kV_brings_the_other_kV_below_2_percent(measured, name):
    errors, values = {}, []
    for pair in itertools.combinations(VOLTAGES_KV, 2):
        others = [kV for kV in VOLTAGES_KV if kV not in pair]
        values.append(fitted(measured, pair, name))
        errors[pair] = mean_error(measured, others, **{name: values[-1]})
    assert max(errors.values()) < 0.02, errors
    # whichever two are fitted, the layer is the same within 15 %: measured 0.89-1.13 um W, 0.098-0.131 mm Al
    assert np.ptp(values) < 0.3 * np.median(values)
    assert mean_error(measured, VOLTAGES_KV) > 0.03  # with nothing fitted: 0.038


def test_error_of_the_kV_alone_does_not_explain_the_measured_shapes(measured):
    others = [20, 30, 35]
    assert mean_error(measured, others, kV=fitted(measured, (25, 45), "kV")) > 0.025


def test_tungsten_and_aluminium_are_known_only_together_and_the_kV_apart_from_them(measured):
    start = {"W": fitted(measured, VOLTAGES_KV, "W")}
    columns = {}
    for name in STEP:
        below, above = (
            np.sqrt(np.concatenate(modelled(measured, VOLTAGES_KV, **{**start, name: start.get(name, 0.0) + change})))
            for change in (0.0, 0.1)
        )
        columns[name] = (above - below) / np.linalg.norm(above - below)
    # correlation of two parameters fitted together: minus the cosine of their derivatives
    assert columns["W"] @ columns["Al"] > 0.99
    assert abs(columns["W"] @ columns["kV"]) < 0.5
    assert abs(columns["Al"] @ columns["kV"]) < 0.5
