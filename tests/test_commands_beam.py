"""`raytwin spectrum` and `raytwin mu`: their answers, their options, and what they refuse."""

from pathlib import Path

import pytest

import raytwin as rt
from raytwin.cli import main
from raytwin.errors import InputError

PAIR = ["--low", "kv=40,power_w=40,exposure_ms=20", "--high", "kv=90,power_w=45,exposure_ms=20"]


def test_spectrum_answers_with_what_the_interface_promises(json_of) -> None:
    answer = json_of("spectrum", "--kv", "70", "--filter", "Al:23.5", "--filter", "air:1000", "--angle", "20")
    assert len(answer["energies_keV"]) == len(answer["fluence"]) == 138
    # IEC 61267 RQA5: first half-value layer 6.8 mm Al; PTB's tube of that filtration 6.64 mm
    assert answer["hvl_mm_Al"] == pytest.approx(6.64, rel=0.035)
    assert answer["hvl_mm_Cu"] == pytest.approx(0.287, rel=0.035)
    assert 50 < answer["mean_energy_keV"] < 54
    assert answer["air_kerma_uGy_per_mAs"] > 0
    assert answer["filters"] == ["Al:23.5", "air:1000"]


def test_spectrum_speaks_to_people_and_warns_of_a_soft_beam(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["spectrum", "--kv", "40"]) == 0
    printed = capsys.readouterr()
    assert "40 kV, W anode at 12 degrees, casim" in printed.out
    assert "half-value layers" in printed.out
    assert "note: " in printed.err
    assert main(["spectrum", "--kv", "40", "--filter", "Al:2"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("material", "energy_keV", "mass_attenuation", "density"),
    [
        ("water_liquid", "60", 0.2059, 1.0),
        ("aluminium", "30", 1.128, 2.699),
        ("Al", "30", 1.128, 2.699),
        ("Water, Liquid", "60", 0.2059, 1.0),
        ("bone_cortical_icru44", "20", 4.001, 1.92),
        ("H2O@0.917", "60", 0.2059, 0.917),
    ],
)
def test_mu_at_one_energy_is_nists_within_2_percent(
    json_of, material: str, energy_keV: str, mass_attenuation: float, density: float
) -> None:
    answer = json_of("mu", material, "--energy-kev", energy_keV)
    assert answer["density_g_cm3"] == density
    assert answer["mu_eff_per_mm"] == pytest.approx(mass_attenuation * density / 10, rel=0.02)
    assert answer["mu_eff_at_thickness_per_mm"] is None


def test_mu_in_a_beam_gives_the_thin_limit_and_the_lower_value_through_a_thickness(json_of) -> None:
    words = ("mu", "chicken_breast", "--kv", "40", "--filter", "Al:1+Cu:0.05", "--thickness-mm", "20")
    answer = json_of(*words)
    assert 0.02 < answer["mu_eff_at_thickness_per_mm"] < answer["mu_eff_per_mm"] < 0.1
    counting = json_of(*words, "--counting")
    assert counting["mu_eff_per_mm"] > answer["mu_eff_per_mm"]
    screen = json_of(*words, "--scintillator", "Gd2O2S@4.5:0.2", "--cover", "C:1")
    assert screen["mu_eff_per_mm"] != answer["mu_eff_per_mm"]
    chantler = json_of(*words, "--table", "chantler")
    assert chantler["mu_eff_per_mm"] == pytest.approx(answer["mu_eff_per_mm"], rel=0.05)


def test_a_nist_name_with_a_comma_is_a_filter_too(json_of) -> None:
    answer = json_of("spectrum", "--kv", "60", "--filter", "Water, Liquid:10")
    same = json_of("spectrum", "--kv", "60", "--filter", "water:10")
    assert answer["hvl_mm_Al"] == pytest.approx(same["hvl_mm_Al"], rel=1e-4)


def test_own_materials_and_a_measured_spectrum_take_part(json_of, tmp_path: Path) -> None:
    library = tmp_path / "own.toml"
    library.write_text('[putty]\ndensity_g_cm3 = 1.9\nformula = "CaCO3"\nsource = "data sheet"\n', encoding="utf-8")
    spectrum = tmp_path / "beam.txt"
    spectrum.write_text("".join(f"{energy} 1\n" for energy in range(20, 40)), encoding="utf-8")
    answer = json_of("mu", "putty", "--spectrum-file", str(spectrum), "--library", str(library), "--filter", "putty:1")
    assert answer["density_g_cm3"] == 1.9
    assert answer["mu_eff_per_mm"] > 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["spectrum", "--kv", "400"], "kV: got 400 kV; expected 10 to 300 kV, where the W spectra are known"),
        (["spectrum", "--kv", "5"], "kV: got 5 kV; expected 10 to 300 kV"),
        (["spectrum", "--kv", "nan"], "kV: got nan kV"),
        (["spectrum", "--kv", "60", "--anode", "Mo"], "kV: got 60 kV; expected 10 to 50 kV, where the Mo spectra"),
        (["spectrum"], "kV: got nothing; expected the tube voltage in kV"),
        (["spectrum", "--kv", "60", "--filter", "Cuu:1"], "material: got 'Cuu'"),
        (["spectrum", "--kv", "60", "--filter", "Cu"], "filter: got 'Cu'; expected MATERIAL:mm"),
        (["spectrum", "--kv", "60", "--filter", "Cu:-1"], "thickness of filter Cu: got -1.0 mm"),
        (["spectrum", "--kv", "60", "--model", "default"], "model: got 'default'"),
        (["spectrum", "--kv", "sixty"], "argument --kv: got 'sixty'; expected a number"),
        (["spectrum", "--kv", "60kV"], "argument --kv: got '60kV'; expected a number, without its unit"),
        (["lab", "-o", "x.h5", "--protocol", "full", "--seed", "one"], "--seed: got 'one'; expected a whole number"),
        (["spectrum", "--spectrum-file", "missing.txt"], "spectrum file: got missing.txt; expected a readable file"),
        (["contrast", "--product", "water:9", "--object", "Al", *PAIR], "--object: got 'Al'; expected MATERIAL:mm"),
        (["contrast", "--product", "musle:9", "--object", "Al:1", *PAIR], "--product: got 'musle'"),
        (["mu", "musle", "--energy-kev", "60"], "nearest: muscle"),
        (["mu", "Al"], "kV, energy_keV: got neither; expected a beam"),
        (["mu", "Al", "--kv", "60", "--energy-kev", "60"], "kV, energy_keV: got both"),
        (["mu", "Al", "--energy-kev", "0.1"], "energy_keV: got 0.1 keV; expected energies from 1 to 500 keV"),
        (["mu", "Al", "--kv", "60", "--thickness-mm", "-1"], "--thickness-mm: got -1.0 mm"),
        (["mu", "Al", "--kv", "60", "--scintillator", "CsI:0"], "expected at least one layer of more than 0 mm"),
        (["mu", "Al", "--energy-kev", "60", "--table", "elam"], "table: got 'elam'"),
        (["mu", "Al", "--energy-kev", "60", "--library", "missing.toml"], "material library: got missing.toml"),
    ],
)
def test_bad_input_is_one_clear_line_and_exit_code_2(
    capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    try:
        code = main(words)
    except SystemExit as stop:
        code = int(stop.code or 0)
    printed = capsys.readouterr()
    assert code == 2
    assert printed.out == ""
    assert message in printed.err
    assert printed.err.count("\n") == 1


@pytest.mark.parametrize("command", ["spectrum", "mu"])
def test_help_holds_an_example(capsys: pytest.CaptureFixture[str], command: str) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([command, "--help"])
    assert f"example:\n  raytwin {command}" in capsys.readouterr().out


def test_attenuation_through_a_twin_in_memory_says_of_what() -> None:
    assert rt.mu("water", kV=60, twin=rt.read_twin("virtual_lab")).where == "60 kV of a twin in memory"


@pytest.mark.parametrize("given", [5, ["Al:1", 5], None, {"Al": 1.0}.values()])
def test_layers_that_are_neither_texts_nor_filters_are_one_line(given) -> None:
    with pytest.raises(InputError, match=r'filter: got .*; expected a text such as "Cu:0.1'):
        rt.spectrum(kV=60, filter=given)
    with pytest.raises(InputError, match=r'filter: got .*; expected a text such as "Cu:0.1'):
        rt.mu("water", kV=60, cover=given)
