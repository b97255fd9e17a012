"""A twin that carries effects: predictions, validation and images hold what the effects do."""

import math
from dataclasses import replace

import numpy as np
import pytest

from raytwin.acquisition import open_acquisition, write_acquisition
from raytwin.acquisition.setting import setting_from_text
from raytwin.calibration.validate import validate_twin
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.files import sha256_of_file
from raytwin.generator.effects import EFFECTS, AppliedEffect
from raytwin.generator.frames.line_model import LineModel
from raytwin.generator.frames.present_line import present_line
from raytwin.generator.line.series_request import SeriesRequest
from raytwin.generator.predictions.predict import predict_flatfield
from raytwin.generator.predictions.predict_many import predict_levels
from raytwin.generator.twins.twin_io import read_twin, write_twin

MEASURED = setting_from_text("kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05")
UNMEASURED = setting_from_text("kv=60,power_w=45,exposure_ms=50,filter=Cu:0.1")


def with_effect(twin, effect, since="calibration", **parameters):
    return replace(twin, effects=(AppliedEffect(id=effect, parameters=parameters, since=since),))


def thicker(twin, thickness_mm):
    spectral = twin.spectral
    column = spectral.names.index("inherent_filtration_mm_Al")
    samples, best = spectral.samples.copy(), spectral.best.copy()
    samples[:, column] += thickness_mm
    best[column] += thickness_mm
    return replace(twin, spectral=replace(spectral, samples=samples, best=best))


# ------------------------------------------------------------------------------------------------ predict


def test_a_twin_with_a_filtration_error_predicts_as_one_whose_filtration_is_thicker(make_model_twin):
    twin = make_model_twin((24, 32))
    changed = with_effect(twin, "filtration_error", strength=0.4)
    wanted = thicker(twin, 0.4)
    for setting in (MEASURED, UNMEASURED):
        found = predict_flatfield(changed, setting)
        # the levels of this twin are its own model's, so that the thicker line has the model's levels
        expected = predict_flatfield(replace(wanted, levels=()), setting)
        assert found.mean_DN.value == pytest.approx(expected.mean_DN.value, rel=1e-9)
        assert found.gain_DN.value == pytest.approx(expected.gain_DN.value, rel=1e-9)
        assert found.sd_DN.value == pytest.approx(expected.sd_DN.value, rel=1e-3)
        assert found.photons_absorbed.value == pytest.approx(expected.photons_absorbed.value, rel=1e-9)
        assert found.air_kerma_uGy.value == pytest.approx(expected.air_kerma_uGy.value, rel=1e-9)
        assert found.mean_DN.value < 0.99 * predict_flatfield(twin, setting).mean_DN.value


@pytest.mark.parametrize("setting", [MEASURED, UNMEASURED], ids=["measured", "unmeasured"])
def test_excess_noise_raises_the_quantum_variance_by_its_strength_and_leaves_the_mean_alone(series_line, setting):
    before = predict_flatfield(series_line, setting)
    after = predict_flatfield(with_effect(series_line, "excess_noise", strength=50.0), setting)
    read = series_line.noise.read_variance_DN2
    assert after.mean_DN == before.mean_DN
    assert after.gain_DN.value == pytest.approx(1.5 * before.gain_DN.value, rel=1e-12)
    assert after.sd_DN.value == pytest.approx(math.sqrt(1.5 * (before.sd_DN.value**2 - read) + read), rel=1e-9)
    assert after.photons_absorbed == before.photons_absorbed


@pytest.mark.parametrize("effect", sorted(EFFECTS))
@pytest.mark.parametrize("setting", [MEASURED, UNMEASURED], ids=["measured", "unmeasured"])
@pytest.mark.parametrize("size", ["weak", "strong", "beyond"])
def test_a_prediction_with_any_effect_is_what_the_series_model_expects_of_a_long_flat(
    make_model_twin, as_counter, effect, setting, size
):
    twin = make_model_twin((24, 24), readout_ms=2.0)
    if "counting" in EFFECTS[effect].needs:
        twin = as_counter(twin)
    known = EFFECTS[effect].strength
    strength = {"weak": known.low, "strong": known.high, "beyond": 1.8 * known.high}[size]
    applied = AppliedEffect(id=effect, parameters={"strength": strength}, since="calibration")
    found = predict_flatfield(replace(twin, effects=(applied,)), setting)
    plain = predict_flatfield(twin, setting)
    asked = SeriesRequest(kind="flat", setting=setting, frames=1, exposure_ms=setting.exposure_ms)
    # lag has filled after an hour of beam
    interval = asked.interval_s(twin.instrument.readout_ms)
    exposed = math.ceil(3600.0 / interval)
    asked = replace(asked, start_s=exposed * interval, previous=(replace(asked, frames=exposed),))
    with_it = LineModel(twin, effects=(applied,)).expect(asked)
    without = LineModel(twin, effects=()).expect(asked)

    def noise(flat):
        common = flat.row_variance_DN2 + flat.column_variance_DN2
        flicker = 0.0 if flat.flicker is None else flat.flicker.rms
        common += (flat.frame_factor_rms**2 + flicker**2) * np.median(flat.signal_DN) ** 2
        return math.sqrt(common + np.median(flat.quantum_variance_DN2 + flat.white_variance_DN2))

    level = np.median(with_it.signal_DN) / np.median(without.signal_DN)
    assert found.mean_DN.value / plain.mean_DN.value == pytest.approx(level, rel=1e-4)
    assert found.sd_DN.value / plain.sd_DN.value == pytest.approx(noise(with_it) / noise(without), rel=2e-3)
    assert found.mean_DN.low < found.mean_DN.value < found.mean_DN.high


def test_what_is_not_known_of_an_effect_widens_what_it_changes(series_line, tmp_path):
    plain = with_effect(series_line, "excess_noise", strength=50.0)
    doubtful = replace(plain, effects=(replace(plain.effects[0], strength_sd=0.3, law_sd=0.4),))
    write_twin(tmp_path / "twin.h5", doubtful)
    known, wide = (predict_flatfield(twin, UNMEASURED) for twin in (plain, read_twin(tmp_path / "twin.h5")))
    assert wide.mean_DN == known.mean_DN  # the noise alone is changed
    assert wide.gain_DN.value == known.gain_DN.value
    # half of the gain's change, which is a half of the gain: 0.5 / 1.5 of it
    half = 1.96 * 0.5 * (0.5 / 1.5) * 1.5 * known.gain_DN.value
    expected = math.hypot(known.gain_DN.high - known.gain_DN.value, half)
    assert wide.gain_DN.high - wide.gain_DN.value == pytest.approx(expected, rel=1e-3)


def test_before_calibration_only_effects_that_were_always_there_are_predicted(series_line):
    plain = predict_flatfield(series_line, UNMEASURED)
    late = with_effect(series_line, "kv_error", strength=3.0)
    assert predict_flatfield(late, UNMEASURED, after_calibration=False) == plain
    always = with_effect(series_line, "kv_error", since="always", strength=3.0)
    assert predict_flatfield(always, UNMEASURED, after_calibration=False).mean_DN.value > 1.02 * plain.mean_DN.value


@pytest.mark.parametrize("effect", ["mtf_tail", "veiling_glare", "image_lag", "row_noise", "quantisation"])
def test_what_calibration_took_in_is_not_counted_twice(series_line, effect):
    always = with_effect(series_line, effect, since="always")
    assert predict_flatfield(always, UNMEASURED) == predict_flatfield(series_line, UNMEASURED)


def test_a_response_that_was_always_bent_changes_levels_away_from_those_that_calibrated(series_line):
    signal = predict_flatfield(series_line, MEASURED).mean_DN.value
    points = [{"used": True, "series": "flat_90", "signal_DN": factor * signal} for factor in (0.5, 1.0, 4.0)]
    bent = replace(
        with_effect(series_line, "nonlinearity", since="always", strength=5.0), evidence={"photon_transfer": points}
    )
    plain = replace(bent, effects=())
    assert predict_flatfield(bent, MEASURED).mean_DN.value == pytest.approx(signal, rel=1e-5)
    bright = replace(MEASURED, exposure_ms=200.0)
    found, straight = (predict_flatfield(one, bright).mean_DN.value for one in (bent, plain))
    bend = 0.05 / (0.5 * (2**16 - 1 - 1200))
    assert found / straight == pytest.approx((1 - bend * straight) / (1 - bend * signal), rel=1e-4)


def test_levels_of_many_settings_hold_the_effects_on_the_beam(series_line):
    late = with_effect(series_line, "filtration_error", strength=0.3)
    for setting in (MEASURED, UNMEASURED):
        one = predict_levels(late, kV=[setting.kV], filters=[setting.filters], load_mAs=setting.tube_load_mAs)
        assert one.mean_DN[0] == pytest.approx(predict_flatfield(late, setting).mean_DN.value, rel=1e-4)


def test_an_effect_that_cannot_be_predicted_is_named_in_one_warning(series_line):
    dim = replace(series_line, instrument=replace(series_line.instrument, pixel_mm=None))
    found = predict_flatfield(with_effect(dim, "veiling_glare"), MEASURED)
    told = [line for line in found.warnings if "effect veiling_glare is left out" in line]
    assert len(told) == 1
    unknown = replace(series_line, spectral=None)
    found = predict_flatfield(with_effect(unknown, "kv_error"), MEASURED)
    assert "effect kv_error is left out: the twin has no spectral part" in found.warnings


def test_a_voltage_beyond_the_tables_is_refused(series_line):
    with pytest.raises(InputError, match="within 20 % of the tube voltage"):
        present_line(with_effect(series_line, "kv_error", strength=25.0))


def test_worked_in_effects_are_off_the_twin_and_others_stay(series_line):
    names = ("kv_error", "filtration_error", "excess_noise", "heel", "row_noise")
    effects = tuple(AppliedEffect(id=name, parameters={}) for name in names)
    line = present_line(replace(series_line, effects=effects))
    assert [item.id for item in line.effects] == ["heel", "row_noise"]
    assert line.twin.effects == ()


def test_the_predict_command_applies_the_effects_of_the_twin_file(series_line, tmp_path, capsys):
    import json

    write_twin(tmp_path / "plain.h5", series_line)
    write_twin(tmp_path / "changed.h5", with_effect(series_line, "excess_noise", strength=60.0))
    found = {}
    for name in ("plain", "changed"):
        options = ["--kv", "60", "--filter", "Cu:0.1", "--power-w", "45", "--exposure-ms", "50", "--json"]
        assert main(["predict", str(tmp_path / f"{name}.h5"), *options]) == 0
        found[name] = json.loads(capsys.readouterr().out)
    assert found["changed"]["mean_DN"] == found["plain"]["mean_DN"]
    assert found["changed"]["gain_DN"]["value"] == pytest.approx(1.6 * found["plain"]["gain_DN"]["value"])


# ------------------------------------------------------------------------------------------------ validate


def session_with(path, twin, effects, settings):
    """Darks and flats as a line with these effects gives them."""
    rng = np.random.default_rng(8)
    with write_acquisition(path, twin.instrument) as writer:
        for exposure_ms in sorted({one.exposure_ms for one in settings}):
            dark = SeriesRequest(kind="dark", setting=None, frames=30, exposure_ms=exposure_ms)
            frames = np.stack(list(LineModel(twin, effects=()).sample(dark, rng=rng)))
            writer.add_series(f"dark_{exposure_ms:g}", kind="dark", exposure_ms=exposure_ms, frames=frames)
        for setting in settings:
            flat = SeriesRequest(kind="flat", setting=setting, frames=30, exposure_ms=setting.exposure_ms)
            frames = np.stack(list(LineModel(twin, effects=effects).sample(flat, rng=rng)))
            writer.add_series(f"flat_{setting.kV:g}", kind="flat", setting=setting, frames=frames)
    return path


def test_validate_finds_a_line_with_effects_inside_the_intervals_of_the_twin_that_has_them(
    make_model_twin, tmp_path, json_of
):

    twin = make_model_twin((32, 32), source_object_mm=990.0)
    effects = (
        AppliedEffect(id="filtration_error", parameters={"strength": 0.5}, since="calibration"),
        AppliedEffect(id="excess_noise", parameters={"strength": 60.0}, since="calibration"),
        AppliedEffect(id="row_noise", parameters={"strength": 1.0}, since="calibration"),
    )
    path = session_with(tmp_path / "session.h5", twin, effects, [MEASURED, UNMEASURED])
    write_twin(tmp_path / "before.h5", twin)
    write_twin(tmp_path / "after.h5", replace(twin, effects=effects))
    found = {}
    for name in ("before", "after"):
        found[name] = json_of("validate", tmp_path / f"{name}.h5", path)
    assert all(row["inside"]["mean"] for row in found["after"]["rows"])
    assert found["after"]["median_abs_error_percent"]["sd"] < 1.5
    assert found["before"]["median_abs_error_percent"]["mean"] > 2.0
    assert found["before"]["median_abs_error_percent"]["sd"] > 10.0


def test_flats_that_calibrated_are_compared_without_what_came_later(series_line, tmp_path):
    path = session_with(tmp_path / "session.h5", series_line, (), [MEASURED])
    known = replace(
        with_effect(series_line, "kv_error", strength=4.0),
        levels=tuple(replace(level, series=(f"flat_{level.kV:g}",)) for level in series_line.levels),
        provenance={"acquisition_sha256": sha256_of_file(path)},
    )
    with open_acquisition(path) as acquisition:
        (row,) = validate_twin(known, acquisition).rows
    assert row.used_in_calibration
    assert row.predicted_mean_DN.value == pytest.approx(predict_flatfield(series_line, MEASURED).mean_DN.value)
