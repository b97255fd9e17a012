"""The library of materials: its entries, how names are understood, and users' own files."""

import json
import math
import pickle
from pathlib import Path

import pytest

from raytwin.errors import FileFormatError, InputError
from raytwin.materials import (
    Library,
    Material,
    library_from_files,
    mass_fractions_from_formula,
    material_from_name,
    mixture_by_mass,
    nist_identifier,
    read_library,
)


@pytest.fixture(autouse=True)
def _no_library_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAYTWIN_LIBRARY", raising=False)


NEEDED = [
    *(
        "water",
        "air",
        "muscle",
        "fat",
        "chicken_breast",
        "bone_cortical_icru44",
        "rib_bone",
        "cartilage",
        "soft_tissue",
    ),
    *("PMMA", "polyethylene", "polypropylene", "polycarbonate", "PVC", "glass", "rubber", "stone", "granite"),
    *("Al", "Cu", "Fe", "Sn", "W", "Be", "C", "CsI", "Gd2O2S", "CdTe", "Se"),
]


@pytest.mark.parametrize("name", NEEDED)
def test_the_common_materials_are_in_the_library(name: str) -> None:
    assert library_from_files().find(name) is not None


def test_every_entry_sums_to_one_and_names_its_source() -> None:
    for name, material in library_from_files().materials.items():
        assert math.fsum(material.mass_fractions.values()) == pytest.approx(1.0, abs=1e-12), name
        assert material.density_g_cm3 > 0, name
        assert len(material.source) > 5, name


def test_an_alias_that_is_an_element_symbol_means_that_element() -> None:
    library = library_from_files()
    for alias in library.aliases:
        try:
            fractions = mass_fractions_from_formula(alias) if len(alias) <= 2 and alias[0].isupper() else {}
        except InputError:
            continue
        if set(fractions) == {alias}:
            material = library.find(alias)
            assert material is not None
            assert dict(material.mass_fractions) == {alias: 1.0}


# The same tissues in the material files that SpekPy ships (from PEGS4 of EGSnrc): an independent copy of ICRU-44
PEGS4 = {
    "muscle_skeletal_icru44": "Muscle Skeletal (ICRU)",
    "adipose_tissue_icru44": "Adipose Tissue (ICRU)",
    "blood_whole_icru44": "Blood, Whole (ICRU)",
    "lung_tissue_icru44": "Lung Tissue (ICRU)",
    "breast_tissue_icru44": "Breast Tissue (ICRU)",
    "brain_icru44": "Brain, Grey and White Matter (ICRU)",
    "liver_icru44": "Liver (ICRU)",
    "skin_icru44": "Skin (ICRU)",
    "cartilage_icru44": "Skeletal Cartilage (ICRU)",
    "bone_cortical_icru44": "Bone, Cortical (ICRU)",
    "spongiosa_icru44": "Skeletal Spongiosa (ICRU)",
}


@pytest.mark.parametrize("name", PEGS4)
def test_icru_44_tissues_agree_with_another_copy_of_the_report(name: str) -> None:
    import spekpy
    import xraylib

    path = Path(spekpy.__file__).parent / "data" / "matl_def" / f"{PEGS4[name]}.comp"
    composition = json.loads(path.read_text(encoding="utf-8"))["composition"]
    material = material_from_name(name)
    assert material.density_g_cm3 == pytest.approx(composition["density"], rel=1e-5)
    theirs = {xraylib.AtomicNumberToSymbol(number): fraction for number, fraction in composition["elements"]}
    assert dict(material.mass_fractions) == pytest.approx(theirs, abs=2e-5)


@pytest.mark.parametrize(
    ("name", "nist"),
    [
        ("water", "Water, Liquid"),
        ("pmma", "Polymethyl Methacralate (Lucite, Perspex)"),
        ("polycarbonate", "Polycarbonate (Makrolon, Lexan)"),
        ("polyvinyl_chloride", "Polyvinyl Chloride"),
        ("rubber_neoprene", "Rubber, Neoprene"),
        ("polyimide", "Kapton Polyimide Film"),
        ("glass", "Glass, Plate"),
        ("gadolinium_oxysulfide", "Gadolinium Oxysulfide"),
        ("cesium_iodide", "Cesium Iodide"),
        ("bone_cortical_icrp", "Bone, Cortical (ICRP)"),
    ],
)
def test_library_agrees_with_the_nist_compound_of_the_same_substance(name: str, nist: str) -> None:
    ours, theirs = material_from_name(name), material_from_name(nist)
    assert ours.density_g_cm3 == theirs.density_g_cm3
    assert dict(ours.mass_fractions) == pytest.approx(dict(theirs.mass_fractions), abs=5e-4)


def test_chicken_breast_is_what_the_food_tables_say() -> None:
    # USDA 05062: 73.9 g water, 22.5 g protein a 100 g, so 3.6 % nitrogen (protein / 6.25) and a density just above 1.05
    chicken = material_from_name("chicken_breast")
    assert chicken.mass_fractions["N"] == pytest.approx(22.5 / 6.25 / 100, rel=0.02)
    assert 1.05 < chicken.density_g_cm3 < 1.075
    assert chicken.mass_fractions["K"] == pytest.approx(0.00334, rel=0.01)


def test_a_name_is_an_alias_an_element_a_formula_with_density_or_a_nist_compound() -> None:
    assert material_from_name("Al").name == "aluminium"
    assert material_from_name("Ti").mass_fractions == {"Ti": 1.0}
    screen = material_from_name("Gd2O2S@7.32")
    assert screen.density_g_cm3 == 7.32
    # 2 Gd of 157.25 in a formula mass of 378.57 g/mol (IUPAC atomic weights)
    assert screen.mass_fractions["Gd"] == pytest.approx(2 * 157.25 / 378.57, rel=1e-3)
    assert material_from_name("Glass, Plate").density_g_cm3 == 2.4
    assert material_from_name("glass, plate").name == "Glass, Plate"
    assert material_from_name(nist_identifier("Glass, Lead") or "").name == "Glass, Lead"
    assert material_from_name("Water").name == "water_liquid"
    assert material_from_name("soft-tissue").name == "tissue_soft_icru44"
    packed = material_from_name("CsI@3.6")
    assert packed.density_g_cm3 == 3.6
    assert packed.mass_fractions == material_from_name("CsI").mass_fractions


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("musle", r"material: got 'musle'; .*nearest: muscle"),
        ("alu", r"nearest: .*alumin"),
        ("ployethylene", r"nearest: .*polyethylene"),
        ("Fe2O3", r"give the formula its density, Fe2O3@DENSITY"),
        ("Gd2O2S@thick", r"expected FORMULA@DENSITY with the density in g/cm3; for example Gd2O2S@7.32"),
        ("Gd2O2S@-1", r"density of Gd2O2S@-1: got -1.0 g/cm3; expected a finite density above 0 g/cm3"),
        ("qqqqq", r"ids of the library: .*chicken_breast"),
        ("", r"material: got ''"),
        ("Pu", r"give the formula its density, Pu@DENSITY"),
    ],
)
def test_an_unknown_name_is_refused_with_the_way_out(name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        material_from_name(name)


def test_a_users_library_comes_first_and_may_build_on_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "own.toml"
    own.write_text(
        '[marinade]\ndensity_g_cm3 = 1.1\nparts_by_mass = { water = 90, NaCl = 10 }\nsource = "our kitchen"\n'
        '[meat]\naliases = ["muscle"]\nparts_by_mass = { muscle_skeletal_icru44 = 0.95, marinade = 0.05 }\n',
        encoding="utf-8",
    )
    library = library_from_files([own])
    assert material_from_name("muscle", library=library).name == "meat"
    assert material_from_name("marinade", library=library).mass_fractions["Na"] == pytest.approx(0.1 * 0.3934, rel=1e-3)
    # volumes add: 0.95 / 1.05 + 0.05 / 1.1
    assert material_from_name("meat", library=library).density_g_cm3 == pytest.approx(1 / (0.95 / 1.05 + 0.05 / 1.1))
    assert material_from_name("muscle").name == "muscle_skeletal_icru44"
    monkeypatch.setenv("RAYTWIN_LIBRARY", str(own))
    assert material_from_name("muscle").name == "meat"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", r"own.toml: x: got 1; expected a table \[x\]"),
        ("[x", r"expected a TOML file"),
        ("[x]\ndensity_g_cm3 = 1", r"\[x\]: got no composition; expected exactly one of mass_fractions, formula"),
        ('[x]\nformula = "H2O"', r"\[x\]: got no density_g_cm3; expected the density"),
        ('[x]\nformula = "H2O"\nmass_fractions = {H = 1}\ndensity_g_cm3 = 1', r"got mass_fractions and formula"),
        ('[x]\nformula = "H2O"\ndensity = 1', r"got the key density; expected keys among"),
        ('[x]\nformula = "H2Oo"\ndensity_g_cm3 = 1', r"expected a chemical formula"),
        ("[x]\nmass_fractions = {H = 11.2, O = 88.8}\ndensity_g_cm3 = 1", r"a sum of 100; expected a sum of 1"),
        ("[x]\nmass_fractions = {H = 1.5, O = -0.5}\ndensity_g_cm3 = 1", r"mass fraction of O in x: got -0.5"),
        ("[x]\nmass_fractions = {Xx = 1}\ndensity_g_cm3 = 1", r"element: got 'Xx'; expected an element symbol"),
        ("[x]\nmass_fractions = {H = 1}\ndensity_g_cm3 = nan", r"density of x: got nan g/cm3"),
        ("[x]\nparts_by_mass = {NaCl = 1, water = 1}", r"write NaCl@DENSITY, or give the mixture's density_g_cm3"),
        ('[x]\nmass_fractions = {H = "all"}\ndensity_g_cm3 = 1', r"expected numbers for density and amounts"),
    ],
)
def test_a_library_that_cannot_be_understood_is_refused_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match=message):
        read_library(path, base=library_from_files())


def test_a_missing_library_is_refused(tmp_path: Path) -> None:
    for attempt in (lambda: read_library(tmp_path / "no.toml"), lambda: library_from_files([tmp_path / "no.toml"])):
        with pytest.raises(FileFormatError, match=r"material library: got .*no.toml; expected a readable file"):
            attempt()


def test_a_mixture_needs_parts() -> None:
    water = material_from_name("water")
    for parts in ({}, {water: 0.0}, {water: -1.0}, {water: math.nan}):
        with pytest.raises(InputError, match=r"parts by mass of m: got .*; expected parts of 0 or more"):
            mixture_by_mass(parts, name="m")


def test_a_material_is_read_only_hashable_and_survives_pickling() -> None:
    chicken = material_from_name("chicken_breast")
    with pytest.raises(TypeError):
        chicken.mass_fractions["H"] = 1.0  # type: ignore[index]
    again = pickle.loads(pickle.dumps(chicken))
    assert again == chicken
    assert hash(again) == hash(chicken)
    assert isinstance(library_from_files(), Library)
    assert Material(name="x", density_g_cm3=1.0, mass_fractions={"H": 1.0, "O": 0.0}).mass_fractions == {"H": 1.0}
