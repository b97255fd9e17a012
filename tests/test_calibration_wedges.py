"""Wedges: their transmissions as measured, as predicted, in calibration and in validation."""

import math

import numpy as np
import pytest

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.acquisition_io import write_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import Setting, filters_from_text
from raytwin.calibration.calibrate import calibrate_twin
from raytwin.calibration.spectrum.wedges import (
    _away_from_borders,
    measure_transmissions,
    predict_transmission,
    transmissions_of_evidence,
)
from raytwin.calibration.validate import leave_one_out, plot_validation, validate_twin
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator.line.spectral_signal import OpenBeam, SpectralModel
from raytwin.generator.predictions.predict import spectral_model_of
from raytwin.generator.twins.twin_io import read_twin, write_twin
from raytwin.materials import optical_depth

SHAPE = (40, 60)
STEPS_MM = (0.0, 1.0, 3.0, 6.0)
DARK_DN = 100.0
INSTRUMENT = Instrument(
    pixel_mm=0.4,
    source_detector_mm=1000.0,
    source_object_mm=700.0,
    scintillator=filters_from_text("CsI:0.5"),
    bits=16,
    maximum_power_w=100.0,
)


@pytest.fixture(scope="module")
def line():
    """A model and its true parameters: 0.7 mm Al of inherent filtration, 0.02 DN a keV."""
    model = SpectralModel(filter_materials=("Al", "Cu"))
    truth = np.zeros((1, len(model.names)))
    truth[0, model.names.index("inherent_filtration_mm_Al")] = 0.7
    truth[0, model.names.index("log_DN_per_keV")] = math.log(0.02)
    truth[0, model.names.index("log_swank")] = math.log(0.9)
    return model, truth


def steps_map():
    """Thickness in mm (row, column): the open field, then three steps of Al."""
    return np.repeat(np.array(STEPS_MM), SHAPE[1] // len(STEPS_MM))[None, :].repeat(SHAPE[0], axis=0).astype(np.float32)


def session(
    path,
    line,
    *,
    load_of_object=1.0,
    thickness=None,
    ramp=False,
    material="Al",
    kind="wedge",
    distance=None,
    stated=None,
):
    """Flats at 50 and 90 kV and a wedge at 50 kV, white quantum noise by the model's own gain."""
    model, truth = line
    rng = np.random.default_rng(3)
    plane = steps_map() if thickness is None else thickness
    if ramp:
        plane = np.linspace(0.0, 6.0, SHAPE[1], dtype=np.float32)[None, :].repeat(SHAPE[0], axis=0)
    factor = 0.4**2

    def frames(setting, signal_of_pixel, count=20):
        mean = signal_of_pixel * setting.tube_load_mAs * factor
        gain = float(model.signal(truth, OpenBeam(kV=setting.kV, filters=())).gain_DN[0])
        noise = np.sqrt(gain * mean + 4.0) * rng.standard_normal((count, *SHAPE))
        return np.clip(np.rint(DARK_DN + mean + noise), 0, 65535).astype(np.uint16)

    stated = plane if stated is None else stated
    with write_acquisition(path, INSTRUMENT) as writer:
        for name in ("dark_0", "dark_1"):
            dark = np.rint(DARK_DN + 2.0 * rng.standard_normal((20, *SHAPE))).astype(np.uint16)
            writer.add_series(name, frames=dark, kind="dark", exposure_ms=20.0)
        for kV in (50.0, 90.0):
            setting = Setting(kV=kV, current_mA=0.2, exposure_ms=20.0)
            rate = float(model.signal(truth, OpenBeam(kV=kV, filters=())).rate_DN_per_mAs[0])
            writer.add_series(
                f"flat_{kV:g}", frames=frames(setting, rate * np.ones(SHAPE)), kind="flat", setting=setting
            )
        writer.add_scene("steps", kind=kind, thickness_mm={} if material is None else {material: stated})
        setting = Setting(kV=50.0, current_mA=0.2 * load_of_object, exposure_ms=20.0, source_detector_mm=distance)
        rates = np.zeros(SHAPE)
        for step in np.unique(plane):
            filters = filters_from_text(f"Al:{step}") if step > 0 else ()
            rates[plane == step] = float(model.signal(truth, OpenBeam(kV=50.0, filters=filters)).rate_DN_per_mAs[0])
        writer.add_series("wedge", frames=frames(setting, rates), kind="object", setting=setting, scene="steps")
    return path


def true_transmission(line, thickness_mm, kV=50.0):
    model, truth = line
    behind = model.signal(truth, OpenBeam(kV=kV, filters=filters_from_text(f"Al:{thickness_mm}")))
    return float(behind.rate_DN_per_mAs[0] / model.signal(truth, OpenBeam(kV=kV, filters=())).rate_DN_per_mAs[0])


@pytest.fixture(scope="module")
def measured(tmp_path_factory, line):
    path = session(tmp_path_factory.mktemp("wedge") / "session.h5", line)
    with open_acquisition(path) as acquisition:
        twin = calibrate_twin(acquisition, rng=np.random.default_rng(0), advise=False)
    return path, twin


def test_steps_are_measured_with_their_edges_left_out(measured, line):
    path, twin = measured
    with open_acquisition(path) as acquisition:
        (found,) = measure_transmissions(acquisition, twin.maps)
    assert [item.layers[0].thickness_mm for item in found.transmissions] == [1.0, 3.0, 6.0]
    for item in found.transmissions:
        exact = true_transmission(line, item.layers[0].thickness_mm)
        assert item.value == pytest.approx(exact, rel=0.004)
        assert 0.002 <= item.relative_sd < 0.02


def test_the_open_field_of_the_same_frames_cancels_the_output(tmp_path, line, measured):
    _, twin = measured
    # the tube gives 1.5 times what the setting of the flat says
    path = session(tmp_path / "brighter.h5", line, load_of_object=1.5)
    with open_acquisition(path) as acquisition:
        (found,) = measure_transmissions(acquisition, twin.maps)
    assert found.transmissions[0].value == pytest.approx(true_transmission(line, 1.0), rel=0.004)


def test_a_ramp_is_cut_into_bins(tmp_path, line, measured):
    _, twin = measured
    path = session(tmp_path / "ramp.h5", line, ramp=True)
    with open_acquisition(path) as acquisition:
        (found,) = measure_transmissions(acquisition, twin.maps)
    assert 8 <= len(found.transmissions) <= 12
    for item in found.transmissions[::3]:
        assert item.value == pytest.approx(true_transmission(line, item.layers[0].thickness_mm), rel=0.012)


def test_pixels_near_a_border_are_left_out_where_a_step_is_wide_enough():
    """A wide step keeps its inner pixels, 5 px off; a narrow one as many as it needs; a slab that fills the field all."""
    steps = np.full((60, 60), -1)
    steps[:, :30], steps[:, 31:35], steps[:, 36:] = 0, 1, 2
    kept = _away_from_borders(steps)
    assert np.array_equal(np.flatnonzero(kept[30] == 0), np.arange(25))
    assert np.array_equal(np.flatnonzero(kept[30] == 1), [32, 33])
    assert np.array_equal(np.flatnonzero(kept[30] == 2), np.arange(41, 60))
    np.testing.assert_array_equal(_away_from_borders(np.zeros((8, 8), dtype=int)), 0)


def test_the_wedge_joins_the_fit_and_is_kept_in_the_twin(measured, tmp_path):
    _, twin = measured
    assert twin.evidence["spectrum"]["data"] == 4 + 3
    kept = transmissions_of_evidence(twin)
    assert [item.layers[0].thickness_mm for item in kept] == [1.0, 3.0, 6.0]
    write_twin(tmp_path / "twin.h5", twin)
    assert transmissions_of_evidence(read_twin(tmp_path / "twin.h5")) == kept


def test_predicted_transmissions_hold_the_truth_and_widen_for_unknown_materials(measured, line):
    _, twin = measured
    found = predict_transmission(twin, kV=70.0, filters=(), layers=filters_from_text("Al:4"))
    assert found.low <= true_transmission(line, 4.0, kV=70.0) <= found.high
    assert found.high / found.low < 1.09  # how thick the wedge itself is leaves more than half of it
    other = predict_transmission(twin, kV=70.0, filters=(), layers=filters_from_text("pmma:60"))
    assert math.log(other.high / other.low) > 0.02


def test_a_wedge_thinner_than_stated_leaves_predictions_that_hold_the_truth(tmp_path, line, measured):
    _, right = measured
    path = session(tmp_path / "thin.h5", line, stated=(1.04 * steps_map()).astype(np.float32))
    with open_acquisition(path) as acquisition:
        twin = calibrate_twin(acquisition, rng=np.random.default_rng(0), advise=False)
    asked = {"kV": 50.0, "filters": (), "layers": filters_from_text("Al:4")}
    found, usual = (predict_transmission(one, **asked) for one in (twin, right))
    assert found.low <= true_transmission(line, 4.0) <= found.high
    assert math.log(found.high / found.low) == pytest.approx(math.log(usual.high / usual.low), rel=0.2)


def test_plates_of_one_material_share_its_table_and_its_density(measured):
    _, twin = measured
    one, parted = (
        predict_transmission(twin, kV=70.0, filters=(), layers=filters_from_text(text))
        for text in ("pmma:60", "pmma:20+pmma:40")
    )
    assert parted.value == pytest.approx(one.value, rel=1e-9)
    assert math.log(parted.high / parted.low) == pytest.approx(math.log(one.high / one.low), rel=1e-6)


def test_an_unknown_material_lies_between_the_tables(measured):
    """The value is that of the tables' mean; sd of three equally likely tables, and 1 % of density."""
    _, twin = measured
    model = spectral_model_of(twin)
    best = twin.spectral.best
    layers = filters_from_text("water_liquid:40")
    weight = model.moment_weights(best, OpenBeam(kV=70.0, filters=layers))[0]
    energies = model.energies_keV[: weight.size]
    tables = ("xraylib", "chantler", "penelope")
    depths = [float(weight @ optical_depth(layers, energies, table=table) / weight.sum()) for table in tables]
    found = predict_transmission(twin, kV=70.0, filters=(), layers=layers)
    before = model.signal(twin.spectral.samples, OpenBeam(kV=70.0, filters=())).rate_DN_per_mAs
    behind = model.signal(twin.spectral.samples, OpenBeam(kV=70.0, filters=layers)).rate_DN_per_mAs
    by_tables = float(np.median(behind / before)) * math.exp(depths[0] - np.mean(depths))
    assert found.value == pytest.approx(by_tables, rel=2e-3)
    half_width = math.log(found.high / found.low) / 2
    assert half_width > 1.95 * math.hypot(np.std(depths), 0.01 * depths[0])


def test_validation_shows_wedges_and_levels_left_out(measured, tmp_path, capsys, json_of):
    path, twin = measured
    with open_acquisition(path) as acquisition:
        result = validate_twin(twin, acquisition)
    assert len(result.wedges) == 3
    assert all(row.inside for row in result.wedges)
    rows = leave_one_out(twin, rng=np.random.default_rng(1))
    assert [row.series for row in rows] == ["50 kV, no filter", "90 kV, no filter"]
    for row, fitted in zip(rows, result.rows, strict=True):
        width, narrow = (r.predicted_mean_DN.high - r.predicted_mean_DN.low for r in (row, fitted))
        assert width > 2 * narrow  # without the level itself the prediction is wider
        assert row.inside_mean and row.inside_sd
    write_twin(tmp_path / "twin.h5", twin)
    plot = tmp_path / "errors.png"
    arguments = ["validate", str(tmp_path / "twin.h5"), str(path), "--leave-one-out", "--plot", str(plot)]
    answer = json_of(*arguments)
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert len(answer["leave_one_out"]["rows"]) == 2
    assert answer["wedges"]["coverage"] == 1.0
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "each level predicted from the others" in text
    assert "of 3 steps" in text
    figure = plot_validation(result)
    assert len(figure.axes) == 3


def test_one_level_alone_cannot_be_left_out(measured):
    _, twin = measured
    from dataclasses import replace

    assert leave_one_out(replace(twin, levels=twin.levels[:1]), rng=np.random.default_rng(0)) == ()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"material": None}, "a scene without thickness maps"),
        ({"distance": 800.0}, "no flat at its kV, filter and distance"),
        ({"material": "unobtainium"}, "unobtainium"),
        ({"thickness": np.full(SHAPE, 300.0, dtype=np.float32)}, "no step of 20 pixels"),
    ],
)
def test_a_wedge_that_says_nothing_is_left_out_with_the_reason(tmp_path, line, measured, changes, message):
    _, twin = measured
    path = session(tmp_path / "odd.h5", line, **changes)
    with open_acquisition(path) as acquisition:
        (found,) = measure_transmissions(acquisition, twin.maps)
    assert found.transmissions == ()
    assert message in found.skipped


def test_a_wedge_far_thinner_than_wedges_are_is_left_out_with_a_warning(tmp_path, line):
    path = session(tmp_path / "wrong.h5", line, stated=(1.3 * steps_map()).astype(np.float32))
    with open_acquisition(path) as acquisition:
        twin = calibrate_twin(acquisition, rng=np.random.default_rng(0), advise=False)
    assert any("wedges contradict the flats" in text for text in twin.warnings)
    assert transmissions_of_evidence(twin) == ()


@pytest.mark.slow
def test_wedges_with_scatter_are_left_out_with_a_warning(tmp_path, line):
    # twice the thickness is stated: what scatter does to a thick step, too much signal behind it
    thickness = np.where(steps_map() > 0, 2.0 * steps_map(), 0.0).astype(np.float32)
    path = session(tmp_path / "scatter.h5", line, stated=thickness)
    with open_acquisition(path) as acquisition:
        twin = calibrate_twin(acquisition, rng=np.random.default_rng(0), advise=False)
    assert any("wedges contradict the flats" in text for text in twin.warnings)
    assert transmissions_of_evidence(twin) == ()
    assert twin.evidence["spectrum"]["data"] == 4


def test_products_are_no_wedges(tmp_path, line, measured):
    _, twin = measured
    with open_acquisition(session(tmp_path / "product.h5", line, kind="product")) as acquisition:
        assert measure_transmissions(acquisition, twin.maps) == ()


def test_a_plot_of_unknown_kind_is_refused_before_any_work(measured, tmp_path, refused_line):
    assert "a name that ends in .png, .pdf, .svg" in refused_line(
        "validate", "none.h5", "none.h5", "--plot", "errors.bmp"
    )


@pytest.mark.parametrize("text", ["tube.csv", "tube.csv:fast", "tube.csv:-3"])
def test_a_spectrum_without_voltage_is_refused(measured, text, refused_line, tmp_path):
    path, _ = measured
    assert "expected FILE:kV" in refused_line("calibrate", path, "-o", tmp_path / "t.h5", "--spectrum", text)


def test_a_twin_without_spectrum_predicts_no_transmission(measured):
    from dataclasses import replace

    _, twin = measured
    with pytest.raises(InputError, match="without spectral part"):
        predict_transmission(replace(twin, spectral=None), kV=60.0, filters=(), layers=filters_from_text("Al:1"))
