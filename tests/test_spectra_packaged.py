"""Tube spectra that come with the package: SpekPy's own, at hand without it."""

import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from raytwin.spectra import (
    _packaged,
    energy_grid_keV,
    is_packaged,
    make_table,
    tube,
    tube_fluence_interpolated,
    tube_spectrum,
)

REMAKE = "run `python -m raytwin.spectra.make_table` and say what changed in the changelog"


@pytest.fixture
def nothing_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache on disk and in memory."""
    monkeypatch.setenv("RAYTWIN_CACHE", str(tmp_path / "kept"))
    tube._tube_node.cache_clear()
    tube._line_offsets.cache_clear()
    yield tmp_path / "kept"
    tube._tube_node.cache_clear()
    tube._line_offsets.cache_clear()


def test_the_table_is_of_the_spekpy_that_is_installed() -> None:
    assert _packaged.packaged_version() == version("spekpy"), REMAKE


@pytest.mark.parametrize(("model", "kV"), [("casim", 10), ("casim", 47), ("casim", 300), ("kqp", 23), ("kqp", 69)])
def test_entries_are_spekpys_answers_but_for_a_processors_last_bits(model: str, kV: int) -> None:
    packaged = _packaged.packaged_fluence("W", 12.0, model, kV)
    assert packaged is not None
    found = tube._spekpy_fluence("W", 12.0, model, kV)
    # exponentials and sums in another order: some last bits of sums of thousands of terms
    np.testing.assert_allclose(packaged, found, rtol=1e-12, atol=1e-12 * float(found.max()), err_msg=REMAKE)


@pytest.mark.parametrize("model", tube.MODELS)
def test_every_whole_kV_of_the_default_tube_is_packaged(model: str) -> None:
    for kV in range(10, 301):
        values = _packaged.packaged_fluence("W", 12.0, model, kV)
        assert values is not None
        assert values.shape == (2, energy_grid_keV(float(kV)).size)
        assert np.all(np.isfinite(values)) and np.all(values >= 0) and values[0].sum() > 0
    assert _packaged.packaged_fluence("W", 12.0, model, 301) is None


def test_a_table_gives_back_what_it_was_made_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    spectra = {kV: rng.random((2, energy_grid_keV(float(kV)).size)) for kV in range(10, 14)}
    for one in spectra.values():
        one[1, ::3] = 0.0
    monkeypatch.setattr(make_table, "TUBES", (("Mo", 12.0, "casim"),))
    monkeypatch.setattr(make_table, "MAXIMUM_KV_OF_ANODE", {"Mo": 13.0})
    monkeypatch.setattr(make_table, "kept_tube_fluence", lambda anode, angle, model, kV: spectra[kV])
    monkeypatch.setattr(make_table, "kept_line_places", lambda *_: rng.random((2, 598)))
    make_table.make_table(tmp_path / _packaged.FILE)
    monkeypatch.setattr(_packaged, "__file__", str(tmp_path / "_packaged.py"))
    _packaged._tube.cache_clear()
    try:
        for kV, values in spectra.items():
            np.testing.assert_array_equal(_packaged.packaged_fluence("Mo", 12.0, "casim", kV), values)
    finally:
        _packaged._tube.cache_clear()


def test_a_voltage_that_nobody_asked_for_before_takes_milliseconds_and_writes_nothing(nothing_kept: Path) -> None:
    tube_fluence_interpolated(61.3, energies_keV=energy_grid_keV(61.3), for_sums=True)  # reads the table
    times = []
    for kV in (33.7, 81.2, 139.9, 187.3, 299.6):
        start = time.perf_counter()
        tube_fluence_interpolated(kV, energies_keV=energy_grid_keV(kV), model="kqp", for_sums=True)
        times.append(time.perf_counter() - start)
    assert float(np.median(times)) < 0.05
    assert not nothing_kept.exists()


def test_spectra_of_the_default_tube_do_not_load_spekpy() -> None:
    code = "import sys\nfrom raytwin.spectra import tube_spectrum\ntube_spectrum(kV=73.4)\nassert 'spekpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_another_angle_comes_from_spekpy_with_its_own_version(nothing_kept: Path) -> None:
    other = tube_spectrum(kV=20, anode_angle_deg=13.0)
    assert other.model_version == f"spekpy {version('spekpy')}"
    assert [path.name.split("_")[2] for path in nothing_kept.iterdir()] == ["13deg"]
    assert not is_packaged("W", 13.0, "casim") and is_packaged("W", 12.0, "casim")
    assert other.fluence.sum() > tube_spectrum(kV=20).fluence.sum()  # less of the anode to cross
