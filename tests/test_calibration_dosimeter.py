"""Dose and transmission tables: what a dosimeter says of a tube, alone and together with flats."""

import csv
import math
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import raytwin as rt
from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import Filter, Setting, filters_from_text
from raytwin.calibration.spectrum.dose_data import KermaRatio, KermaReading
from raytwin.calibration.spectrum.output_table import read_output_table
from raytwin.calibration.spectrum.spectral_fit import SpectralFit, fit_spectrum
from raytwin.calibration.spectrum.transmission_table import read_transmission_table
from raytwin.calibration.spectrum.tube import calibrate_tube, departures, dose_data, predict_ratio, suspects
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator.line.spectral_signal import KERMA_OUTPUT, OpenBeam, SpectralModel
from raytwin.generator.line.twin import Level, estimate_from_sd
from raytwin.generator.predictions.tube_twin import TubeTwin, predict_effective_mu, predict_spectrum, predict_tube
from raytwin.generator.twins.twin_io import read_any_twin, read_twin, write_twin
from raytwin.lab.tube import beam
from raytwin.materials import mass_energy_absorption_cm2_g, material_from_name
from raytwin.spectra import air_kerma_uGy_per_mAs, tube_spectrum

REALDATA = Path(__file__).parents[2] / "shared" / "realdata"
FILTRATION_MM_AL = 2.2
OUTPUT = 0.85


def lab_kerma(kV, filters="", *, absorber=""):
    """Air kerma of the lab's tube, uGy per mAs at 1 m: SpekPy's other model and the lab's own attenuation."""
    layers = (Filter(material="Al", thickness_mm=FILTRATION_MM_AL), *filters_from_text(filters))
    found = beam(kV=kV, anode_angle_deg=12.0, filters=(*layers, *filters_from_text(absorber)))
    energies = found.energy_keV
    weight = energies * mass_energy_absorption_cm2_g(material_from_name("air"), energies) * 1.602176634e-5
    return OUTPUT * float(found.photons_per_mAs_mm2 @ weight)


def written(path, header, rows):
    path.write_text("\n".join([header, *(",".join(str(cell) for cell in row) for row in rows)]) + "\n")
    return path


def dose_rows(settings):
    return [(kV, filters, 10, 700, f"{10 * lab_kerma(kV, filters) / 0.49:.6g}", 1) for kV, filters in settings]


HEADER = "kV,filter,mAs,distance_mm,air_kerma_uGy,uncertainty_percent"
SETTINGS = [(kV, filters) for kV in (40, 60, 100) for filters in ("", "Al:2")]


@pytest.fixture(scope="module")
def tube(tmp_path_factory):
    path = written(tmp_path_factory.mktemp("doses") / "doses.csv", HEADER, dose_rows(SETTINGS))
    return calibrate_tube(
        rng=np.random.default_rng(1),
        output=read_output_table(path),
        instrument=Instrument(anode="W", anode_angle_deg=12.0),
    )


def test_a_dose_table_tells_filtration_and_output_of_a_tube_that_shares_no_physics(tube):
    assert isinstance(tube, TubeTwin)
    filtration = tube.spectral.interval("inherent_filtration_mm_Al")
    assert filtration.low <= FILTRATION_MM_AL <= filtration.high
    assert filtration.high - filtration.low < 1.2
    for kV, filters in ((50.0, "Al:1"), (80.0, "Cu:0.1")):
        setting = Setting(
            kV=kV,
            filters=filters_from_text(filters),
            current_mA=2000.0,
            exposure_ms=1.0,
            source_detector_mm=500.0,
        )
        kerma = predict_tube(tube, setting).air_kerma_uGy
        truth = 2.0 * 4.0 * lab_kerma(kV, filters)
        assert kerma.low <= truth <= kerma.high
        assert kerma.value == pytest.approx(truth, rel=0.02)
        assert kerma.high / kerma.low < 1.2


def test_kerma_and_its_derivatives_are_those_of_the_spectrum():
    model = SpectralModel(filter_materials=("Al", "Cu")).with_parameters((KERMA_OUTPUT,))
    sample = model.default_parameters()[None, :]
    sample[0, model.names.index("inherent_filtration_mm_Al")] = 1.5
    layers = (Filter(material="Cu", thickness_mm=0.1),)
    beam_ = OpenBeam(kV=70.0, filters=layers)
    inherent = Filter(material="Al", thickness_mm=1.5)
    names = [name for name in model.names if name not in ("inherent_filtration_mm_Al", "log_scintillator_thickness")]
    names.remove("kV_error")
    value, slope, by_response = model.log_kerma_derivatives(sample, beam_, names)
    spectrum = tube_spectrum(kV=70.0, filters=(inherent, *layers))
    kerma = spectrum.fluence * model.kerma_weights[: spectrum.fluence.size]
    assert by_response[0] == pytest.approx(kerma @ np.log(spectrum.energies_keV / 50.0) / kerma.sum(), abs=2e-3)
    assert value[0] == pytest.approx(math.log(air_kerma_uGy_per_mAs(spectrum)), abs=2e-3)
    for column, name in enumerate(names):
        step = np.zeros(len(model.names))
        # a voltage cannot vary less than not at all, and what is nothing at 0 shows to one side only
        size, sides = (1e-5, (2.0, 0.0)) if name == "kV_variance" else (1e-3, (1.0, -1.0))
        step[model.names.index(name)] = size
        ends = [model.log_kerma_derivatives(sample + sign * step, beam_, ())[0][0] for sign in sides]
        assert slope[0, column] == pytest.approx((ends[0] - ends[1]) / (2 * size), rel=1e-4, abs=2e-5), name


def test_half_value_layers_tell_the_filtration_and_no_output():
    mu = {kV: _half_value(kV) for kV in (50.0, 90.0)}
    ratios = [
        KermaRatio(kV=kV, filters=(), layers=(Filter(material="Al", thickness_mm=hvl),), value=0.5, relative_sd=0.003)
        for kV, hvl in mu.items()
    ]
    fit = fit_spectrum([], Instrument(anode_angle_deg=12.0), rng=np.random.default_rng(2), ratios=ratios)
    filtration = fit.posterior.interval("inherent_filtration_mm_Al")
    assert filtration.low <= FILTRATION_MM_AL <= filtration.high
    output = fit.posterior.interval("log_output")
    assert output.high - output.low > 0.9  # the prior's width


def test_an_anode_without_spectra_is_named_before_anything_is_computed():
    ratio = KermaRatio(kV=60.0, filters=(), layers=(), value=0.5, relative_sd=0.01)
    with pytest.raises(InputError, match=r"^anode: got 'Q'; expected one of W, Mo"):
        fit_spectrum([], Instrument(anode="Q"), rng=np.random.default_rng(2), ratios=[ratio])


def _half_value(kV):
    low, high = 0.0, 20.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        behind = lab_kerma(kV, f"Al:{middle!r}")
        low, high = (low, middle) if behind < 0.5 * lab_kerma(kV) else (middle, high)
    return high


@pytest.mark.parametrize(
    "absorber",
    [pytest.param("pmma:20", marks=pytest.mark.slow), "Al:4+pmma:5", pytest.param("Cu:0.3", marks=pytest.mark.slow)],
)
def test_an_unknown_absorber_is_carried_to_a_beam_that_did_not_see_it(tmp_path, absorber):
    kVs, filters = (50, 100), ("", "Cu:0.3")
    rows = [
        (kV, f, f"{lab_kerma(kV, '+'.join(filter(None, (f, absorber)))) / lab_kerma(kV, f):.5f}", 0.4)
        for kV in kVs
        for f in filters
    ]
    path = written(tmp_path / "shot.csv", "kV,filter,transmission,uncertainty_percent", rows)
    twin = calibrate_tube(rng=np.random.default_rng(3), transmission=read_transmission_table(path))
    asked = KermaRatio(kV=70.0, filters=filters_from_text("Al:2"), absorber="absorber", value=0.5, relative_sd=0.01)
    predicted = predict_ratio(twin.spectral, asked)
    truth = math.log(lab_kerma(70, f"Al:2+{absorber}") / lab_kerma(70, "Al:2"))
    assert float(np.median(predicted)) == pytest.approx(truth, abs=0.015)
    assert np.quantile(predicted, 0.01) - 0.01 < truth < np.quantile(predicted, 0.99) + 0.01
    assert twin.evidence["transmission_table"]["absorbers"]["absorber"]


def test_a_dosimeters_error_stays_in_the_output(tube):
    """Ten per cent of calibration uncertainty (k = 2) are five of output, however many readings there are."""
    readings = [
        KermaReading(
            kV=kV, filters=filters_from_text(f), value=lab_kerma(kV, f), relative_sd=0.001, calibration_sd=0.05
        )
        for kV, f in SETTINGS
    ]
    fit = fit_spectrum([], tube.instrument, rng=np.random.default_rng(4), kermas=readings)
    output = fit.posterior.column("log_output")
    own = tube.spectral.column("log_output")
    assert np.std(output) > 0.045
    assert np.std(own) < np.std(output)


def test_flats_keep_a_flux_of_their_own_beside_a_dosimeter():
    """A fill factor of 0.7 moves the flats and not the kerma: both are right, their ratio is learned."""
    instrument = Instrument(
        anode_angle_deg=12.0,
        scintillator=filters_from_text("CsI:0.5"),
        pixel_mm=0.1,
        source_detector_mm=1000.0,
    )
    model = SpectralModel(filter_materials=("Al", "Cu"))
    truth = model.default_parameters()[None, :]
    for name, value in {
        "inherent_filtration_mm_Al": 1.5,
        "log_output": math.log(0.7),
        "log_DN_per_keV": math.log(0.02),
        "log_swank": math.log(0.9),
    }.items():
        truth[0, model.names.index(name)] = value
    levels, readings = [], []
    for kV, text in ((40.0, ""), (40.0, "Al:2"), (90.0, ""), (90.0, "Al:2")):
        filters = filters_from_text(text)
        signal = model.signal(truth, OpenBeam(kV=kV, filters=filters))
        rate, gain = float(signal.rate_DN_per_mAs[0]) * 0.01, float(signal.gain_DN[0])
        levels.append(
            Level(
                kV=kV,
                filters=filters,
                gain_DN=estimate_from_sd(gain, 0.003 * gain),
                photon_transfer_slope_DN=estimate_from_sd(0.8 * gain, 0.003 * gain),
                rate_DN_per_mAs=estimate_from_sd(rate, 0.0005 * rate),
                source_detector_mm=1000.0,
                saturation_DN=None,
                flat_shape=np.ones((2, 2), dtype=np.float32),
                series=(),
                role="calibration",
            )
        )
        kerma = float(signal.kerma_uGy_per_mAs[0]) / 0.7
        readings.append(KermaReading(kV=kV, filters=filters, value=kerma, relative_sd=0.005, calibration_sd=0.01))
    fit = fit_spectrum(levels, instrument, rng=np.random.default_rng(5), kermas=readings)
    posterior = fit.posterior
    draws = posterior.column("log_output") + posterior.column(KERMA_OUTPUT)
    assert abs(float(np.mean(draws))) < 0.05
    assert (
        float(np.std(draws)) < 0.045
    )  # of the tube's prior 0.3: the dosimeter's 1 %, and what anode and hardness leave open
    assert float(np.mean(posterior.column(KERMA_OUTPUT))) > 0.1


def test_repeats_tell_the_scatter_and_rounding_is_its_own(tmp_path):
    rng = np.random.default_rng(6)
    rows = [(60, "", 10, 1000, f"{500.0 * (1.0 + 0.04 * rng.standard_normal()):.3f}") for _ in range(60)]
    header = "kV,filter,mAs,distance_mm,air_kerma_uGy"
    table = read_output_table(written(tmp_path / "many.csv", header, rows))
    assert table.repeats == 59
    assert table.scatter == pytest.approx(0.04, rel=0.25)
    assert table.kermas[0].relative_sd == pytest.approx(table.scatter / math.sqrt(60), rel=0.01)
    coarse = read_output_table(written(tmp_path / "coarse.csv", header, [(60, "", 2.5, 1000, "1e2")]))
    expected = math.hypot(0.01, math.hypot(1.0, 0.04) / math.sqrt(12.0))
    assert coarse.kermas[0].relative_sd == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_one_wrong_row_among_many_is_named_and_left_out(tmp_path):
    settings = [(kV, filters) for kV in (40, 50, 60, 80, 100) for filters in ("", "Al:2")]
    rows = [list(row) for row in dose_rows(settings)]
    rows[4][4] = f"{0.5 * float(rows[4][4]):.6g}"
    twin = calibrate_tube(
        rng=np.random.default_rng(7), output=read_output_table(written(tmp_path / "wrong.csv", HEADER, rows))
    )
    told = [text for text in twin.warnings if "left out" in text]
    assert len(told) == 1 and told[0].startswith("line 6 (60 kV)")
    assert twin.spectral.interval("inherent_filtration_mm_Al").high < 4.0


def test_a_reading_a_thousand_times_too_large_is_suspected_though_it_bends_the_fit(tube, tmp_path):
    """A fit drawn towards it leaves another reading that departs farther."""
    rows = dose_rows(SETTINGS)
    rows[0] = (*rows[0][:4], f"{1000.0 * float(rows[0][4]):.6g}", 1)
    data = dose_data(read_output_table(written(tmp_path / "doses.csv", HEADER, rows)), None)
    bent = tube.spectral.samples.copy()
    bent[:, tube.spectral.names.index("inherent_filtration_mm_Al")] = 1e-4
    bent[:, tube.spectral.names.index("log_output")] = -1.05
    posterior = replace(tube.spectral, samples=bent)
    away = np.abs(departures(posterior, data.kermas, ())[0])
    assert data.kermas[int(np.argmax(away))].rows != (2,)
    fit = SpectralFit(posterior=posterior, effective_draws=900.0, chi_square=3500.0, data=6, discrepancy={})
    assert suspects(fit, data)[0].rows == (2,)


@pytest.mark.slow
def test_two_wild_readings_that_nobody_can_tell_widen_the_intervals(tmp_path):
    """One in five may be left out; a table that fits no spectrum all the same knows little."""
    rows = dose_rows(SETTINGS)
    for place in (0, 5):
        rows[place] = (*rows[place][:4], f"{0.1 * float(rows[place][4]):.6g}", 1)
    twin = calibrate_tube(
        rng=np.random.default_rng(1), output=read_output_table(written(tmp_path / "doses.csv", HEADER, rows))
    )
    assert any("do not fit any spectrum" in text and "intervals are widened" in text for text in twin.warnings)
    assert not any(text.startswith("output is") for text in twin.warnings)
    filtration = twin.spectral.interval("inherent_filtration_mm_Al")
    assert filtration.low <= FILTRATION_MM_AL <= filtration.high
    assert filtration.low >= 0.0


@pytest.mark.slow
def test_a_reading_a_thousand_times_too_large_is_named_and_left_out(tmp_path):
    rows = dose_rows(SETTINGS)
    rows[0] = (*rows[0][:4], f"{1000.0 * float(rows[0][4]):.6g}", 1)
    twin = calibrate_tube(
        rng=np.random.default_rng(1), output=read_output_table(written(tmp_path / "doses.csv", HEADER, rows))
    )
    (told,) = [text for text in twin.warnings if "left out" in text]
    assert told.startswith("line 2 (40 kV)")
    filtration = twin.spectral.interval("inherent_filtration_mm_Al")
    assert filtration.low <= FILTRATION_MM_AL <= filtration.high


@pytest.mark.slow
def test_a_slip_of_units_in_a_dose_table_is_named_and_bends_no_filtration(tube, tmp_path):
    """Kerma in mGy: a common factor, which says nothing of the spectrum."""
    rows = [(*row[:4], f"{0.001 * float(row[4]):.6g}", 1) for row in dose_rows(SETTINGS)]
    twin = calibrate_tube(
        rng=np.random.default_rng(1), output=read_output_table(written(tmp_path / "doses.csv", HEADER, rows))
    )
    (told,) = [text for text in twin.warnings if text.startswith("output is")]
    assert float(told.split()[2]) == pytest.approx(0.001 * OUTPUT, rel=0.2)
    assert not any(text.startswith("output is") for text in tube.warnings)
    found, right = (one.spectral.interval("inherent_filtration_mm_Al") for one in (twin, tube))
    assert found.value == pytest.approx(right.value, abs=0.15)
    assert found.low <= FILTRATION_MM_AL <= found.high


def test_a_tube_twin_reads_back_and_is_no_whole_twin(tube, tmp_path):
    path = tmp_path / "tube.h5"
    write_twin(path, tube)
    again = read_any_twin(path)
    assert isinstance(again, TubeTwin)
    assert np.array_equal(again.spectral.samples, tube.spectral.samples)
    assert again.spectral.kerma_discrepancy == tube.spectral.kerma_discrepancy
    assert (again.instrument, again.output_known, again.warnings) == (
        tube.instrument,
        tube.output_known,
        tube.warnings,
    )
    with pytest.raises(InputError, match="the twin of a tube alone"):
        read_twin(path)


def test_python_shows_a_calibrated_tubes_intervals_and_the_check_knows_it(tube, tmp_path):
    path = tmp_path / "tube.h5"
    tube.save(path)
    beam = rt.spectrum(kV=60, filter="Al:1", twin=path)
    half = beam.intervals["hvl_mm_Al"]
    assert half["low"] < beam.hvl_mm_Al < half["high"]
    assert f"{half['low']:.4g} to {half['high']:.4g}" in repr(beam)
    through = rt.mu("aluminium", kV=60, twin=path, thickness_mm=2)
    interval = through.intervals["mu_eff_at_thickness_per_mm"]
    assert f"{interval['low']:.6g} to {interval['high']:.6g}" in repr(through)
    checked = rt.check(path)
    assert checked.counts["error"] == 0
    possible = {item.what: item.possible for item in checked.allows}
    assert possible["air kerma"] is tube.output_known is True
    assert possible["noise and level"] is False


def test_numbers_of_a_calibrated_beam_hold_the_labs(tube):
    found = predict_spectrum(tube, kV=60.0)
    half_value = _half_value(60.0)
    assert found.hvl_mm_Al.low * 0.98 <= half_value <= found.hvl_mm_Al.high * 1.02
    beam_ = beam(kV=60.0, anode_angle_deg=12.0, filters=(Filter(material="Al", thickness_mm=FILTRATION_MM_AL),))
    mean = float(beam_.energy_keV @ beam_.photons_per_mAs_mm2 / beam_.photons_per_mAs_mm2.sum())
    assert found.mean_energy_keV.value == pytest.approx(mean, rel=0.02)
    with pytest.raises(InputError, match="a twin of the tube alone"):
        predict_effective_mu(tube, material="pmma", kV=60.0)


BAD_OUTPUT = {
    "empty": ("", "an empty table"),
    "header only": (HEADER + "\n", "a header without rows"),
    "wrong column": ("kV,filter,mAs,distance_mm,air_kerma_mGy\n60,,1,1000,5\n", "did you mean air_kerma_uGy"),
    "no kerma": ("kV,filter,mAs,distance_mm\n60,,1,1000\n", "no column air_kerma_uGy"),
    "negative": ("kV,filter,mAs,distance_mm,air_kerma_uGy\n60,,1,1000,-5\n", "line 2: air_kerma_uGy: got -5 uGy"),
    "no number": ("kV,filter,mAs,distance_mm,air_kerma_uGy\n60,,1,1000,five\n", "line 2: air_kerma_uGy: got 'five'"),
    "filter": ("kV,filter,mAs,distance_mm,air_kerma_uGy\n60,Coper:1,1,1000,5\n", "line 2"),
    "no load": ("kV,filter,distance_mm,air_kerma_uGy\n60,,1000,5\n", "no tube load"),
    "no distance": ("kV,filter,mAs,air_kerma_uGy\n60,,1,5\n", "distance_mm"),
    "kV": ("kV,filter,mAs,distance_mm,air_kerma_uGy\n600,,1,1000,5\n", "line 2: kV: got 600 kV"),
    "copy": ("kV,filter,mAs,distance_mm,air_kerma_uGy\n60,,1,1000,51.2347\n60,,1,1000,51.2347\n", "as in line 2"),
    "comma": ('kV,filter,mAs,distance_mm,air_kerma_uGy\n60,,1,1000,"51,2"\n', "separate columns by semicolons"),
    "mixed": ("kV;filter;mAs;distance_mm;air_kerma_uGy\n60;;1;1000;51,2\n60;;1;1000;1.566\n", "not both"),
    "latin": ("# \udce4\nkV,filter\n", "another encoding than UTF-8 (line 1, byte 0xe4)"),
    "cells": ("kV,filter,mAs,distance_mm,air_kerma_uGy\n60,,1,1000,51,2\n", "6 cells"),
}
BAD_TRANSMISSION = {
    "share": ("kV,filter,transmission\n60,,1.2\n", "below 1"),
    "one beam": ("kV,filter,transmission\n60,,0.5\n", "an unknown absorber in one beam"),
    "no thickness": ("kV,filter,transmission,material\n60,,0.5,Al\n", "both material and thickness_mm"),
    "material": ("kV,filter,transmission,material,thickness_mm\n60,,0.5,Alu,2\n", "line 2"),
    "signal": ("kV,filter,transmission,material,thickness_mm,quantity\n60,,0.5,Al,2,signal\n", "tube alone"),
}


@pytest.mark.parametrize("option", ["--output-table", "--transmission"])
def test_a_table_that_is_not_there_is_told_in_one_line(tmp_path, refused_line, option):
    assert f"{option} nope.csv: got no file that can be read" in refused_line(
        "calibrate", option, tmp_path / "nope.csv", "-o", tmp_path / "twin.h5"
    )
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_are_read_where_no_comma_separates_columns(tmp_path, separator):
    rows = [HEADER, "40,,10,500,730.6,1", "40,Al:0.5+Cu:0.1,10,500,23.15,1"]
    points, commas = tmp_path / "points.csv", tmp_path / "commas.csv"
    points.write_text("\n".join(rows))
    commas.write_text("\n".join(row.replace(",", separator).replace(".", ",") for row in rows))
    assert read_output_table(commas).kermas == read_output_table(points).kermas


@pytest.mark.parametrize(
    ("option", "text", "expected"),
    [("--output-table", *case) for case in BAD_OUTPUT.values()]
    + [("--transmission", *case) for case in BAD_TRANSMISSION.values()],
    ids=[*BAD_OUTPUT, *BAD_TRANSMISSION],
)
def test_a_bad_table_is_told_in_one_line(tmp_path, refused_line, option, text, expected):
    path, twin = tmp_path / "table.csv", tmp_path / "twin.h5"
    path.write_text(text, encoding="utf-8", errors="surrogateescape")
    assert expected in refused_line("calibrate", option, path, "-o", twin)
    assert not twin.exists()


def test_the_page_of_the_dosimeter_runs_as_it_is_written(tmp_path, capsys, monkeypatch, json_of):
    page = (Path(__file__).parents[1] / "docs" / "dosimeter.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    Path("doses.csv").write_text(re.search(r"```text\n(.*?)```", page, re.DOTALL).group(1))
    answers = {}
    for line in re.search(r"```bash\n(.*?)```", page, re.DOTALL).group(1).splitlines():
        words = shlex.split(line)[1:]
        capsys.readouterr()
        answers[words[0]] = json_of(*words)
    calibrated, spectrum, predicted = (answers[name] for name in ("calibrate", "spectrum", "predict"))
    assert calibrated["psf_sigma_px"] is None and calibrated["levels"] == [] and calibrated["bad_pixels"] is None
    assert calibrated["flux_scale"]["value"] == pytest.approx(0.9, rel=0.1) and calibrated["warnings"]
    assert predicted["mean_DN"] is None and "detector" in predicted["warnings"][0]
    at_distance = 0.1 * spectrum["air_kerma_uGy_per_mAs"] / 0.6**2
    assert predicted["air_kerma_uGy"]["value"] == pytest.approx(at_distance, rel=1e-9)
    assert spectrum["intervals"]["hvl_mm_Al"]["low"] < spectrum["hvl_mm_Al"]
    assert answers["mu"]["mu_eff_at_thickness_per_mm"] < answers["mu"]["mu_eff_per_mm"]
    delta = answers["contrast"]["delta_R"]
    assert delta["low"] < delta["value"] < delta["high"]
    assert main(["spectrum", "--twin", "tube.h5", "--kv", "60", "--angle", "20"]) == 2
    assert main(["calibrate", "-o", "tube.h5"]) == 2


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.skipif(not (REALDATA / "dose_reports").exists(), reason="the published dose reports are not here")
def test_dose_reports_carry_from_thin_to_thick_copper_and_tell_the_filtration(tmp_path):
    with (REALDATA / "dose_reports" / "events.csv").open() as file:
        events = list(csv.DictReader(file))

    def table(prefix, distance_mm, copper=None):
        rows = []
        for row in events:
            if row["file"].startswith(prefix) and copper in (None, float(row["filter_Cu_mm"])):
                layers = [f"{metal}:{row[f'filter_{metal}_mm']}" for metal in ("Al", "Cu")]
                layers = [layer for layer in layers if float(layer[3:]) > 0]
                rows.append((row["kV"], "+".join(layers), row["mAs"], distance_mm, f"{row['dose_rp_mGy']}e3"))
        header = "kV,filter,mAs,distance_mm,air_kerma_uGy"
        return read_output_table(written(tmp_path / "doses.csv", header, rows))

    tube = Instrument(anode="W", anode_angle_deg=8.0)
    siemens = calibrate_tube(rng=np.random.default_rng(1), output=table("siemens", 635), instrument=tube)
    filtration = siemens.spectral.interval("inherent_filtration_mm_Al")
    assert filtration.low < 3.5 < filtration.high
    assert filtration.value == pytest.approx(3.5, abs=0.6) and filtration.high - filtration.low > 1.0
    thin = calibrate_tube(rng=np.random.default_rng(1), output=table("RF-Pat", 615, 0.1), instrument=tube)
    thick = max(table("RF-Pat", 615, 0.4).kermas, key=lambda item: len(item.rows))
    setting = Setting(kV=thick.kV, filters=thick.filters, current_mA=1000.0, exposure_ms=1.0, source_detector_mm=1000.0)
    assert predict_tube(thin, setting).air_kerma_uGy.value == pytest.approx(thick.value, rel=0.03)


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.skipif(not (REALDATA / "table_transmission").exists(), reason="the published transmissions are not here")
def test_a_table_fitted_behind_two_filters_is_known_behind_the_other_four(tmp_path):
    with (REALDATA / "table_transmission" / "correction_table_and_pad_attenuation.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["device_model"] == "AXIOM-Artis"]

    def copper(thickness):
        return "" if thickness == "0" else f"Cu:{thickness}"

    def table(copper_mm, step_kV):
        chosen = [
            (row["kvp_kv"], copper(row["filtration_added_mmcu"]), row["k_patient_support"])
            for row in rows
            if row["filtration_added_mmcu"] in copper_mm and (float(row["kvp_kv"]) - 50.0) % step_kV == 0
        ]
        return read_transmission_table(written(tmp_path / "table.csv", "kV,filter,transmission", chosen))

    twin = calibrate_tube(
        rng=np.random.default_rng(1),
        transmission=table(("0", "0.9"), 25),
        instrument=Instrument(anode="W", anode_angle_deg=8.0),
    )
    others = table(("0.1", "0.2", "0.3", "0.6"), 5).ratios
    errors = [item.value - math.exp(float(np.median(predict_ratio(twin.spectral, item)))) for item in others]
    assert math.sqrt(float(np.mean(np.square(errors)))) < 0.0075
    filtration = twin.spectral.interval("inherent_filtration_mm_Al")
    assert filtration.low < 3.5 < filtration.high
