"""Tube spectra: the common grid, the kept spectra, and the interpolation in kV."""

import time
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from raytwin.acquisition.setting import filters_from_text
from raytwin.errors import InputError
from raytwin.materials import transmission
from raytwin.spectra import (
    Response,
    Spectrum,
    air_kerma_uGy_per_mAs,
    detector_response,
    energy_grid_keV,
    filtered_spectrum,
    fluence_per_cm2_mAs,
    mean_energy_keV,
    tube,
    tube_fluence_interpolated,
    tube_spectrum,
)

FloatArray = NDArray[np.float64]
NOT_PACKAGED_DEG = 13.0


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for kept spectra, and nothing kept in memory."""
    monkeypatch.setenv("RAYTWIN_CACHE", str(tmp_path / "kept"))
    tube._tube_node.cache_clear()
    yield tmp_path / "kept"
    tube._tube_node.cache_clear()


def test_grids_nest_and_their_edges_are_multiples_of_half_a_keV() -> None:
    low, high = energy_grid_keV(40.0), energy_grid_keV(90.3)
    np.testing.assert_array_equal(low, high[: low.size])
    assert (low[0], low[-1]) == (1.25, 39.75)
    assert high[-1] == 90.25
    with pytest.raises(ValueError, match="read-only"):
        low[0] = 0.0
    with pytest.raises(InputError, match=r"maximum_keV: got 501.0 keV; expected 2 to 500 keV"):
        energy_grid_keV(501.0)


@pytest.mark.parametrize("model", ["casim", "kqp"])
def test_a_whole_kV_is_what_spekpy_says_for_the_named_model(model: str) -> None:
    import spekpy

    theirs = spekpy.Spek(kvp=40, th=12, dk=0.5, physics=model, targ="W", z=100, mas=1)
    energies, fluence = theirs.get_spectrum()
    ours = tube_spectrum(kV=40, model=model)
    np.testing.assert_allclose(ours.energies_keV, energies, atol=1e-9)
    np.testing.assert_allclose(ours.fluence, fluence, rtol=1e-9)
    assert ours.model == model
    assert ours.model_version.startswith("spekpy 2.")


def test_filters_are_exponentials_and_agree_with_spekpys_own_within_the_tables() -> None:
    import spekpy

    theirs = spekpy.Spek(kvp=90, th=12, dk=0.5, physics="casim", targ="W", z=100, mas=1)
    theirs.multi_filter([("Al", 2.5), ("Cu", 0.05), ("Air", 1000)])
    ours = tube_spectrum(kV=90, filters=filters_from_text("Al:2.5+Cu:0.05+air:1000"))
    assert mean_energy_keV(ours) == pytest.approx(theirs.get_emean(), rel=0.005)
    assert fluence_per_cm2_mAs(ours) == pytest.approx(theirs.get_flu(), rel=0.01)
    # the air kerma's coefficients differ too: SpekPy's are 0.1-2.5 % below NIST's, to which ours are held
    assert air_kerma_uGy_per_mAs(ours) == pytest.approx(theirs.get_kerma(), rel=0.025)
    bare = tube_spectrum(kV=90)
    np.testing.assert_allclose(
        ours.fluence,
        bare.fluence * transmission(ours.filters, bare.energies_keV, bin_width_keV=0.5),
        rtol=1e-12,
    )


@lru_cache(maxsize=8)
def _spekpy_and_detector(kV: float) -> tuple[FloatArray, FloatArray, Response]:
    import spekpy

    energies, fluence = spekpy.Spek(kvp=kV, th=12, dk=0.02, physics="casim", targ="W", z=100, mas=1).get_spectrum()
    return energies, fluence, detector_response(energies_keV=energies)


def _spekpy_signal_and_gain(kV: float, filters: str) -> tuple[float, float]:
    """Signal in 0.5 mm CsI and its <E^2>/<E>, SpekPy called at the kV itself with bins of 0.02 keV."""
    energies, fluence, detector = _spekpy_and_detector(kV)
    passed = fluence * transmission(filters_from_text(filters), energies) * 0.02
    first = float(passed @ detector.mean_deposited_keV)
    return first, float(passed @ detector.mean_square_deposited_keV2) / first


def _signal_and_gain(kV: float, filters: str, *, for_sums: bool) -> tuple[float, float]:
    grid = energy_grid_keV(kV)
    fluence = tube_fluence_interpolated(kV, energies_keV=grid, for_sums=for_sums)
    passed = fluence * transmission(filters_from_text(filters), grid, bin_width_keV=0.5) * 0.5
    detector = detector_response(energies_keV=grid)
    first = float(passed @ detector.mean_deposited_keV)
    return first, float(passed @ detector.mean_square_deposited_keV2) / first


# settings of an inspection line: from a bare window to the stack that leaves a beam of 40 kV only its end
BEAMS = ("Al:0.5", "Al:2.5", "Cu:0.05+Al:0.5", "Cu:0.5+Al:2")


@pytest.mark.parametrize("kV", [30.0, 40.3, pytest.param(149.3, marks=pytest.mark.slow)])
def test_sums_over_the_grid_are_the_integrals_over_spekpy_s_spectrum_at_that_kV(kV: float) -> None:
    """Within 0.05 % in signal and 0.01 % in gain from 40 kV, whole kV or not; three times that below."""
    factor = 1.0 if kV >= 40.0 else 3.0
    for filters in BEAMS:
        truth, gain = _spekpy_signal_and_gain(kV, filters)
        ours, our_gain = _signal_and_gain(kV, filters, for_sums=True)
        assert ours == pytest.approx(truth, rel=factor * 5e-4), filters
        assert our_gain == pytest.approx(gain, rel=factor * 1e-4), filters


@pytest.mark.parametrize("filters", ["Al:0.1", "Al:0.5", "Al:2", "Al:0.5+Cu:0.05"])
def test_sums_of_soft_beams_that_have_crossed_some_aluminium_hold_too(filters: str) -> None:
    truth, gain = _spekpy_signal_and_gain(20.0, filters)
    ours, our_gain = _signal_and_gain(20.0, filters, for_sums=True)
    assert ours == pytest.approx(truth, rel=2e-3)
    assert our_gain == pytest.approx(gain, rel=1e-3)


@pytest.mark.parametrize(
    ("kV", "filters", "low", "high"),
    [
        (20.0, "Cu:0.05", -0.006, -0.003),
        (20.0, "Cu:0.2", 0.06, 0.08),
        (20.0, "Cu:0.5", 0.33, 0.37),
        (25.0, "Cu:0.2", 0.0, 0.011),
        (25.0, "Cu:0.5", 0.0, 0.004),
    ],
)
def test_copper_alone_lets_the_tube_s_l_lines_through_where_a_sum_over_bins_is_off(
    kV: float, filters: str, low: float, high: float
) -> None:
    """Known error: below copper's edge at 9 keV the transmission changes up to threefold within a bin, where the lines lie.

    It counts where that window is what is left of the beam: 1e-4 of it behind 0.2 mm at 20 kV, 1e-9 behind 0.5 mm.
    """
    truth, _ = _spekpy_signal_and_gain(kV, filters)
    ours, _ = _signal_and_gain(kV, filters, for_sums=True)
    assert low < ours / truth - 1.0 < high


@pytest.mark.parametrize("kV", [40.3, pytest.param(70.2, marks=pytest.mark.slow)])
def test_the_spectrum_s_own_heights_give_signals_within_a_fifth_of_a_percent(kV: float) -> None:
    for filters in BEAMS:
        truth, gain = _spekpy_signal_and_gain(kV, filters)
        ours, our_gain = _signal_and_gain(kV, filters, for_sums=False)
        assert ours == pytest.approx(truth, rel=2e-3), filters
        assert our_gain == pytest.approx(gain, rel=1e-3), filters


@pytest.mark.parametrize(("kV", "anode"), [(40.0, "W"), (40.3, "W"), (69.6, "W"), (28.5, "Mo")])
def test_weights_of_sums_keep_photons_and_mean_energy_but_for_the_end_bin(kV: float, anode: str) -> None:
    grid = energy_grid_keV(kV)
    heights = tube_fluence_interpolated(kV, energies_keV=grid, anode=anode)
    weights = tube_fluence_interpolated(kV, energies_keV=grid, anode=anode, for_sums=True)
    assert np.all(weights >= 0)
    assert weights.sum() == pytest.approx(heights.sum(), rel=3e-3)
    assert grid @ weights == pytest.approx(grid @ heights, rel=5e-3)


@pytest.mark.parametrize("for_sums", [False, True])
def test_the_signal_is_smooth_in_kV_through_whole_kV_and_the_edge_of_the_anode(for_sums: bool) -> None:
    grid = energy_grid_keV(75.0)
    weights = detector_response(energies_keV=grid).mean_deposited_keV * transmission(filters_from_text("Al:2.5"), grid)
    kV = np.arange(66.0, 74.01, 0.05)
    signal = np.array(
        [weights @ tube_fluence_interpolated(float(value), energies_keV=grid, for_sums=for_sums) for value in kV]
    )
    slope = np.diff(signal) / np.diff(kV)
    assert np.all(slope > 0)
    # a step of 0.05 kV changes the slope by far less than itself: no jump, no kink
    assert np.max(np.abs(np.diff(slope))) < 0.01 * slope.mean()


def test_a_kV_between_kept_spectra_takes_less_than_a_millisecond() -> None:
    grid = energy_grid_keV(100.0)
    times = []
    for step in range(50):
        start = time.perf_counter()
        tube_fluence_interpolated(90.1 + 0.01 * step, energies_keV=grid)
        times.append(time.perf_counter() - start)
    assert min(times) < 1e-3


def test_energies_off_the_common_grid_are_refused() -> None:
    for energies in (np.array([]), np.linspace(1.0, 60.0, 119), energy_grid_keV(60.0)[1:], np.ones((2, 2))):
        with pytest.raises(InputError, match=r"energies_keV: got an array of shape .*; expected a piece of the common"):
            tube_fluence_interpolated(40.3, energies_keV=energies)


@pytest.mark.parametrize(("kV", "anode"), [(10.4, "W"), (299.7, "W"), (10.2, "Mo"), (49.6, "Mo")])
def test_interpolation_reaches_to_the_ends_of_the_table(kV: float, anode: str) -> None:
    below, inside, above = (
        fluence_per_cm2_mAs(tube_spectrum(kV=value, anode=anode)) for value in (np.floor(kV), kV, np.ceil(kV))
    )
    assert below < inside < above
    share = (inside - below) / (above - below)
    assert share == pytest.approx(kV - np.floor(kV), abs=0.05)


def test_a_longer_grid_is_filled_with_zeros() -> None:
    grid = energy_grid_keV(90.0)
    padded, short = tube_spectrum(kV=40.3, energies_keV=grid), tube_spectrum(kV=40.3)
    np.testing.assert_array_equal(padded.fluence[: short.fluence.size], short.fluence)
    assert not padded.fluence[short.fluence.size :].any()
    with pytest.raises(InputError, match=r"energies_keV: .*expected the common grid .* up to 40.3 keV or further"):
        tube_spectrum(kV=40.3, energies_keV=np.linspace(1.0, 50.0, 100))
    with pytest.raises(InputError, match=r"energies_keV"):
        tube_spectrum(kV=95.0, energies_keV=grid)


def test_a_spectrum_is_computed_once_and_kept_on_disk(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = tube_spectrum(kV=30, anode_angle_deg=NOT_PACKAGED_DEG).fluence
    kept = list(empty_cache.iterdir())
    assert [path.suffix for path in kept] == [".npz"]
    assert "spekpy" in kept[0].name
    tube._tube_node.cache_clear()
    monkeypatch.setattr(tube, "_spekpy_fluence", lambda *_: pytest.fail("computed twice"))
    np.testing.assert_array_equal(tube_spectrum(kV=30, anode_angle_deg=NOT_PACKAGED_DEG).fluence, first)


@pytest.mark.parametrize("damage", ["truncated", "garbage", "other key", "negative", "empty"])
def test_a_damaged_file_is_computed_again_and_replaced(empty_cache: Path, damage: str) -> None:
    first = tube_spectrum(kV=30, anode_angle_deg=NOT_PACKAGED_DEG).fluence
    (path,) = empty_cache.iterdir()
    whole = path.read_bytes()
    with np.load(path) as stored:
        key, fluence = stored["key"], stored["fluence"]
    if damage == "truncated":
        path.write_bytes(whole[:200])
    elif damage == "garbage":
        path.write_bytes(b"not an archive at all")
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "other key":
        np.savez(path, key=np.array("{}"), fluence=fluence * 2)
    else:
        np.savez(path, key=key, fluence=-fluence)
    tube._tube_node.cache_clear()
    np.testing.assert_array_equal(tube_spectrum(kV=30, anode_angle_deg=NOT_PACKAGED_DEG).fluence, first)
    with np.load(path) as stored:
        np.testing.assert_array_equal(stored["fluence"], fluence)


def test_a_cache_that_cannot_be_written_costs_nothing_but_time(
    tmp_path: Path, empty_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "a_file"
    blocked.write_text("no folder", encoding="utf-8")
    monkeypatch.setenv("RAYTWIN_CACHE", str(blocked))
    assert tube_spectrum(kV=30, anode_angle_deg=NOT_PACKAGED_DEG).fluence.sum() > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kV": 301.0}, r"kV: got 301 kV; expected 10 to 300 kV, where the W spectra are known"),
        ({"kV": 9.0}, r"kV: got 9 kV; expected 10 to 300 kV"),
        ({"kV": float("nan")}, r"kV: got nan kV"),
        ({"kV": 60.0, "anode": "Mo"}, r"kV: got 60 kV; expected 10 to 50 kV, where the Mo spectra are known"),
        ({"kV": 60.0, "anode": "Fe"}, r"anode: got 'Fe'; expected one of W, Mo"),
        ({"kV": 60.0, "model": "default"}, r"model: got 'default'; expected one of SpekPy's casim, kqp"),
        ({"kV": 60.0, "anode_angle_deg": 0.0}, r"anode angle: got 0.0 degrees; expected 1 to 60 degrees"),
        (
            {"kV": 60.0, "filters": filters_from_text("W:50")},
            r"filters: got W:50; expected layers that let some photons",
        ),
    ],
)
def test_a_tube_that_cannot_be_is_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        tube_spectrum(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("energies", "fluence", "message"),
    [
        ([1.25, 1.75], [1.0], r"spectrum: got \(2,\) energies and \(1,\) fluences"),
        ([1.25, 1.75], [1.0, -1.0], r"fluence: got a negative or infinite value, or NaN"),
        ([1.25, 1.75], [1.0, float("nan")], r"fluence: got a negative or infinite value, or NaN"),
        ([1.25, 1.75], [0.0, 0.0], r"fluence: got zero everywhere"),
    ],
)
def test_a_spectrum_checks_itself(energies: list[float], fluence: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Spectrum(energies_keV=np.array(energies), fluence=np.array(fluence))


def test_filters_add_to_those_the_beam_has_crossed() -> None:
    once = tube_spectrum(kV=60, filters=filters_from_text("Al:1"))
    twice = filtered_spectrum(once, filters_from_text("Al:1"))
    np.testing.assert_allclose(
        twice.fluence, tube_spectrum(kV=60, filters=filters_from_text("Al:2")).fluence, rtol=1e-12, atol=1e-20
    )
    assert [str(layer) for layer in twice.filters] == ["Al:1", "Al:1"]
