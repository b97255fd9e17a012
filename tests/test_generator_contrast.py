"""Contrast of a foreign object: the paper's equation where it is exact, noise against drawn frames, what is refused."""

import importlib.util
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raytwin.acquisition import setting_from_text
from raytwin.acquisition.setting import Filter, filter_from_text
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator import write_twin
from raytwin.generator.predictions import contrast as contrast_module
from raytwin.generator.predictions.contrast import (
    UncalibratedLine,
    compute_contrast_map,
    disc_and_ring,
    predict_contrast,
    published_delta_r,
)
from raytwin.generator.spread.noise import sample_frame_noise
from raytwin.generator.spread.psf import Spread
from raytwin.materials import material_from_name, mu_per_mm

LOW = setting_from_text("kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05")
HIGH = setting_from_text("kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05")
LINE = UncalibratedLine()
PRODUCT = filter_from_text("chicken_breast:20")
BONE = filter_from_text("bone_cortical_icru44:1")
SLABS = {"product": PRODUCT, "foreign_object": BONE}
WORDS = ["--low", str(LOW), "--high", str(HIGH), "--product", str(PRODUCT), "--object", str(BONE)]


def thicker(layer, factor):
    return Filter(material=layer.material, thickness_mm=layer.thickness_mm * factor)


def hand_made_twin(**changes):
    path = Path(__file__).with_name("test_generator_twin.py")
    spec = importlib.util.spec_from_file_location("twin_by_hand", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.make_twin(**changes)


def test_one_photon_energy_a_channel_gives_the_papers_equation(monkeypatch):
    """30.25 keV at 40 kV and 60.25 keV at 90 kV: thick slabs, no beam hardening, exact to rounding."""
    lines = {40.0: 30.25, 90.0: 60.25}

    def single_line(kV, *, energies_keV, **_):
        return np.where(np.abs(energies_keV - lines[kV]) < 0.01, 1e9, 0.0)

    monkeypatch.setattr(contrast_module, "tube_fluence_interpolated", single_line)
    mu = {
        name: [float(mu_per_mm(material_from_name(layer.material), energy)) for energy in lines.values()]
        for name, layer in SLABS.items()
    }
    a_b = BONE.thickness_mm / PRODUCT.thickness_mm * mu["foreign_object"][1] / mu["product"][1]
    quotient = {name: values[0] / values[1] for name, values in mu.items()}
    expected = a_b * (quotient["foreign_object"] - quotient["product"]) / (a_b + 1)
    found = predict_contrast(LINE, low=LOW, high=HIGH, **SLABS)
    assert found.delta_R.value == pytest.approx(expected, rel=1e-9)
    assert found.delta_R_as_published == pytest.approx(expected, rel=1e-9)
    assert found.R_product == pytest.approx(quotient["product"], rel=1e-9)


def test_thin_slabs_tend_to_the_papers_equation_and_thick_ones_leave_it():
    thin = {name: thicker(layer, 1e-5) for name, layer in SLABS.items()}
    found = predict_contrast(LINE, low=LOW, high=HIGH, **thin)
    assert found.delta_R.value == pytest.approx(found.delta_R_as_published, rel=1e-3)
    thick = predict_contrast(LINE, low=LOW, high=HIGH, **SLABS)
    assert thick.delta_R_as_published == pytest.approx(found.delta_R_as_published, rel=1e-9)
    assert thick.delta_R.value < 0.95 * thick.delta_R_as_published  # the beam hardens


def test_the_equation_of_the_paper_by_hand():
    # a b = 0.1 x 4 = 0.4; R_f - R_m = 2.5 - 1.5
    found = published_delta_r(
        mu_object_low_per_mm=0.2,
        mu_object_high_per_mm=0.08,
        mu_product_low_per_mm=0.03,
        mu_product_high_per_mm=0.02,
        thickness_ratio=0.1,
    )
    assert found == pytest.approx(0.4 * 1.0 / 1.4)


def test_product_in_the_place_of_product_has_no_contrast():
    piece = Filter(material=PRODUCT.material, thickness_mm=3.0)
    found = predict_contrast(LINE, low=LOW, high=HIGH, product=PRODUCT, foreign_object=piece, displaces=True)
    assert found.delta_R.value == pytest.approx(0.0, abs=1e-12)
    on_top = predict_contrast(LINE, low=LOW, high=HIGH, product=PRODUCT, foreign_object=piece)
    assert -0.02 < on_top.delta_R.value < 0.0  # thicker product hardens the low beam more


@given(frames=st.integers(2, 50), factor=st.floats(0.2, 20.0))
@settings(max_examples=15, deadline=None)
def test_noise_falls_with_the_root_of_frames_and_contrast_does_not_change(frames, factor):
    noisy = UncalibratedLine(read_noise_keV=60.0)
    base = predict_contrast(noisy, low=LOW, high=HIGH, **SLABS)
    averaged = predict_contrast(noisy, low=replace(LOW, averaged=frames), high=replace(HIGH, averaged=frames), **SLABS)
    assert averaged.delta_R == base.delta_R
    assert averaged.sd_object == pytest.approx(base.sd_object / math.sqrt(frames), rel=1e-9)
    longer = [replace(one, exposure_ms=one.exposure_ms * factor) for one in (LOW, HIGH)]
    silent = [predict_contrast(LINE, low=low, high=high, **SLABS).sd_pixel for low, high in ((LOW, HIGH), longer)]
    assert silent[1] == pytest.approx(silent[0] / math.sqrt(factor), rel=1e-9)


@pytest.mark.parametrize(("sigma_px", "pixels"), [(0.0, 1), (0.6, 30), (1.2, 80)])
def test_noise_is_that_of_quotients_of_drawn_frames(sigma_px, pixels):
    """Frames with a disc drawn by the noise model; standard deviations within 4 of their own standard errors."""
    line = UncalibratedLine(psf_sigma_px=sigma_px, read_noise_keV=80.0)
    low, high = (replace(one, exposure_ms=400.0) for one in (LOW, HIGH))
    found = predict_contrast(line, low=low, high=high, object_pixels=pixels, **SLABS)
    disc, ring = disc_and_ring(pixels, 21)
    assert disc.sum() == pixels
    rng = np.random.default_rng(5)
    beams = []
    for setting, channel in ((low, found.low), (high, found.high)):
        beam = contrast_module._beam_of_line(line, setting, None)
        signal = channel.open_signal_DN * np.exp(-np.where(disc, channel.M_object, channel.M_product))
        behind = {}
        for name, layers in (("product", (PRODUCT,)), ("object", (PRODUCT, BONE))):
            passed = contrast_module.transmission(layers, beam.energies_keV)
            behind[name] = float(beam.signal(passed, False)[1][0])
        gain = np.where(disc, behind["object"], behind["product"])
        beams.append((channel.open_signal_DN, signal, gain))
    differences, centres = [], []
    count = 500
    for _ in range(count):
        logs = []
        for open_signal, signal, gain in beams:
            noise = sample_frame_noise(
                signal,
                gain_DN=gain,
                white_fraction=0.0,
                read_variance_DN2=80.0**2,
                spread=Spread(sigma_px=sigma_px),
                rng=rng,
            )
            logs.append(-np.log((signal + noise) / open_signal))
        quotient = logs[0] / logs[1]
        differences.append(quotient[disc].mean() - quotient[ring].mean())
        centres.append(quotient[tuple(side // 2 for side in disc.shape)])
    allowed = 4 / math.sqrt(2 * (count - 1))
    assert np.std(differences, ddof=1) == pytest.approx(found.sd_object, rel=allowed)
    assert np.std(centres, ddof=1) == pytest.approx(found.sd_pixel, rel=allowed)
    # the bias of a quotient of noisy logarithms is of second order
    bias = (
        3 * (found.low.sd_M_object / found.low.M_object) ** 2 + 3 * (found.high.sd_M_object / found.high.M_object) ** 2
    )
    error = 4 * found.sd_object / math.sqrt(count)
    assert np.mean(differences) == pytest.approx(found.delta_R.value, abs=error + bias)


def test_blur_correlates_so_many_pixels_help_less_than_their_number():
    one = predict_contrast(LINE, low=LOW, high=HIGH, **SLABS)
    many = predict_contrast(LINE, low=LOW, high=HIGH, object_pixels=100, **SLABS)
    assert many.sd_pixel == one.sd_pixel
    assert one.sd_pixel / math.sqrt(100) < 0.7 * many.sd_object
    sharp = predict_contrast(UncalibratedLine(psf_sigma_px=0.0), low=LOW, high=HIGH, object_pixels=1, **SLABS)
    assert sharp.sd_pixel < sharp.sd_object < 1.01 * sharp.sd_pixel  # the ring's share


@pytest.mark.parametrize("pixels", [1, 2, 30, 500])
def test_the_ring_is_that_of_the_definition_of_contrast(pixels):
    from scipy.ndimage import binary_dilation, generate_binary_structure

    disc, ring = disc_and_ring(pixels, 21)
    assert disc.sum() == pixels
    expected = binary_dilation(disc, structure=generate_binary_structure(2, 1), iterations=21) & ~disc
    np.testing.assert_array_equal(ring, expected)
    assert not (disc | ring)[[0, -1]].any()


def test_a_map_holds_what_single_predictions_say():
    pairs = [[(replace(LOW, kV=kV), replace(HIGH, kV=other)) for other in (80.0, 90.0)] for kV in (40.0, 50.0)]
    grid = compute_contrast_map(LINE, pairs, object_pixels=40, **SLABS)
    for row, expected_row in zip(grid, pairs, strict=True):
        for found, (low, high) in zip(row, expected_row, strict=True):
            alone = predict_contrast(LINE, low=low, high=high, object_pixels=40, **SLABS)
            assert found.delta_R.value == alone.delta_R.value
            assert found.cnr_object == alone.cnr_object


def test_a_twin_gives_the_contrast_of_its_parameters_with_its_levels_and_a_wider_interval():
    twin = hand_made_twin()
    found = predict_contrast(twin, low=LOW, high=HIGH, object_pixels=30, **SLABS)
    inherent = Filter(material="Al", thickness_mm=float(twin.spectral.best[0]))
    stated = predict_contrast(UncalibratedLine(inherent=(inherent,)), low=LOW, high=HIGH, **SLABS)
    assert found.delta_R.value == pytest.approx(stated.delta_R.value, rel=2e-3)
    assert found.low.open_signal_DN == pytest.approx(23000.0 * LOW.tube_load_mAs, rel=1e-6)  # the measured level
    assert found.delta_R.high - found.delta_R.low > stated.delta_R.high - stated.delta_R.low
    assert set(found.delta_R_by_table) == {"xraylib", "chantler", "penelope"}
    # one pixel of M: the twin's gain and read noise, behind the object
    share = twin.levels[0].photon_transfer_slope_DN.value / twin.levels[0].gain_DN.value
    signal = found.low.open_signal_DN * math.exp(-found.low.M_object)
    open_gain = math.sqrt((6.0 * share * signal + twin.noise.read_variance_DN2) / signal**2)
    assert open_gain < found.low.sd_M_object < 1.1 * open_gain  # gain rises as the object hardens the beam


def refused(message, *, line=LINE, low=LOW, high=HIGH, **changes):
    with pytest.raises(InputError, match=message):
        predict_contrast(line, low=low, high=high, **{**SLABS, **changes})


def test_what_has_no_contrast_is_refused():
    refused("two different spectra", high=LOW)
    refused("two different spectra", low=HIGH, high=LOW)
    refused("a tube load", low=setting_from_text("kv=40,exposure_ms=20"))
    refused("product thickness: got 0 mm", product=filter_from_text("water:0"))
    refused("at most the product's 20 mm", foreign_object=filter_from_text("Al:21"), displaces=True)
    refused("object pixels: got 0", object_pixels=0)
    refused("let some photons through at 40 kV", foreign_object=filter_from_text("Pb:50"))
    refused("10 to 300 kV", high=replace(HIGH, kV=900.0))
    refused("layers that let some photons through", line=UncalibratedLine(inherent=(filter_from_text("Pb:100"),)))
    refused("a signal that a detector could hold", line=UncalibratedLine(output_scale=1e-60))
    refused("a twin without spectral part", line=hand_made_twin(spectral=None))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("swank", 0.0),
        ("swank", 1.2),
        ("output_scale", math.nan),
        ("pixel_mm", 0.0),
        ("psf_sigma_px", 1e9),
        ("read_noise_keV", -1.0),
    ],
)
def test_an_impossible_line_is_refused(field, value):
    with pytest.raises(InputError, match=field):
        UncalibratedLine(**{field: value})


def test_few_photons_and_a_thin_product_are_said():
    dim = predict_contrast(UncalibratedLine(output_scale=0.02), low=LOW, high=HIGH, **SLABS)
    assert any("logarithm is biased" in warning for warning in dim.warnings)
    # the logarithm is taken of the mean of frames
    settings = {"low": replace(LOW, averaged=100), "high": replace(HIGH, averaged=100)}
    assert not predict_contrast(UncalibratedLine(output_scale=0.02), **settings, **SLABS).warnings
    thin = predict_contrast(LINE, low=LOW, high=HIGH, product=thicker(PRODUCT, 0.05), foreign_object=BONE)
    assert any("the product is thin" in warning for warning in thin.warnings)
    assert predict_contrast(LINE, low=LOW, high=HIGH, **SLABS).warnings == ()


def test_the_command_answers_what_the_function_says(capsys, json_of):
    answer = json_of("contrast", *WORDS, "--object-pixels", "30")
    found = predict_contrast(LINE, low=LOW, high=HIGH, object_pixels=30, **SLABS)
    assert answer["delta_R"] == found.delta_R.as_dict()
    assert answer["cnr_object"] == found.cnr_object
    assert answer["low"]["mu_eff_object_per_mm"] == found.low.mu_eff_object_per_mm
    assert main(["contrast", *WORDS]) == 0
    assert "Delta R" in capsys.readouterr().out


def test_the_command_maps_and_draws(capsys, tmp_path):
    picture = tmp_path / "map.png"
    words = ["--map-kv-high", "80:90:5", "--map-filter", "none;Cu:0.05+Al:1", "--plot", str(picture), "--json"]
    assert main(["contrast", *WORDS, *words]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["rows"] == {"axis": "kv_high", "values": [80.0, 85.0, 90.0]}
    assert answer["columns"] == {"axis": "filter", "values": ["none", "Cu:0.05+Al:1"]}
    assert np.array(answer["cnr_object"]).shape == (3, 2)
    assert answer["best"]["cnr_object"] == np.max(answer["cnr_object"])
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_command_takes_a_twin(json_of, tmp_path):
    write_twin(tmp_path / "twin.h5", hand_made_twin())
    answer = json_of("contrast", *WORDS, "--twin", tmp_path / "twin.h5")
    assert answer["delta_R"]["low"] < answer["delta_R"]["value"] < answer["delta_R"]["high"]
    assert main(["contrast", *WORDS, "--twin", str(tmp_path / "twin.h5"), "--swank", "0.8"]) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--map-kv-low", "30:60:5"], "exactly two"),
        (["--map-kv-low", "60:30:5", "--map-kv-high", "80:90:5"], "FROM:TO:STEP"),
        (["--map-kv-low", "30:60:0.001", "--map-kv-high", "80:90:5"], "at most 100"),
        (["--map-kv-low", "30:60:5", "--map-filter", ";"], "1 to 100"),
        (["--plot", "map.png"], "no map"),
        (["--object", "unobtainium:1"], "unobtainium"),
        (["--product", "water"], "MATERIAL:mm"),
        (["--object-pixels", "-1"], "object pixels"),
        (["--twin", "nowhere.h5"], "an existing file"),
    ],
)
def test_the_command_refuses_in_one_line(refused_line, words, message):
    error = refused_line("contrast", *WORDS, *words)
    assert message in error
    assert error.count("\n") == 1


def test_a_saturated_open_field_gives_no_contrast_and_says_why(capsys, tmp_path):
    import raytwin as rt

    path = str(tmp_path / "twin.h5")
    write_twin(path, hand_made_twin())
    long = {"low": str(replace(LOW, exposure_ms=20.0)), "high": str(replace(HIGH, exposure_ms=2000.0, power_W=90.0))}
    slabs = {"product": str(PRODUCT), "foreign_object": str(BONE), "twin": path}
    fine = rt.contrast(low=str(LOW), high=str(HIGH), **slabs).contrast
    assert fine.delta_R is not None and fine.cnr_object > 0
    found = rt.contrast(**long, **slabs)
    answer = found.to_dict()
    assert [answer[name] for name in ("delta_R", "sd_pixel", "sd_object", "cnr_pixel", "cnr_object")] == [None] * 5
    assert answer["delta_R_by_table"] == {}
    assert sum("saturates" in text for text in answer["warnings"]) == 1
    # what beam and slabs have of themselves stays
    assert answer["low"]["M_product"] == pytest.approx(fine.low.M_product)
    assert "not known" in repr(found)
    words = ["--twin", path, "--product", str(PRODUCT), "--object", str(BONE)]
    assert main(["contrast", *words, "--low", long["low"], "--high", long["high"]]) == 0
    assert "none: the detector saturates" in capsys.readouterr().out

    grid = rt.contrast(low=str(LOW), high=long["high"], kV_low=[39, 40], kV_high=[90], **slabs)
    assert grid.to_dict()["cnr_object"] == [[None], [None]]
    assert grid.best is None and grid.to_dict()["best"] is None
    assert grid.to_dataframe()["cnr_object"].isna().all()
    mixed = rt.contrast(low=str(LOW), high=long["high"], kV_low=[40], kV_high=[50, 90], **slabs)
    (row,) = mixed.to_dict()["delta_R"]
    assert row[0] is not None and row[1] is None
    assert mixed.best.high.setting.kV == 50
    assert "saturates" in " ".join(mixed.warnings)
    words += ["--low", str(LOW), "--high", str(HIGH), "--map-kv-low", "40:40:1", "--map-kv-high", "80:90:10"]
    assert main(["contrast", *words, "--plot", str(tmp_path / "map.png")]) == 0
