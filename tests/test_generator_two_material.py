"""Two path lengths a pixel through the polychromatic model: tables, solution, and how changes carry over."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytwin.acquisition.setting import filters_from_text
from raytwin.errors import InputError
from raytwin.generator.line.spectral_signal import OpenBeam, SpectralModel
from raytwin.generator.references.two_material import (
    look_up_two_materials,
    solve_two_materials,
    tabulate_two_materials,
)

MATERIALS = ("chicken_breast", "rib_bone")
COPPER = filters_from_text("Cu:0.05")
BEAMS = (
    OpenBeam(kV=40.0, filters=COPPER),
    OpenBeam(kV=90.0, filters=COPPER),
    OpenBeam(kV=60.0, filters=COPPER),
    OpenBeam(kV=120.0, filters=filters_from_text("Al:2")),
)


@pytest.fixture(scope="module")
def model():
    return SpectralModel(filter_materials=("Al", "Cu"))


@pytest.fixture(scope="module")
def parameters(model):
    values = model.default_parameters()
    values[0] = 0.8
    return values


@pytest.fixture(scope="module")
def tables(model, parameters):
    return tabulate_two_materials(model, parameters, beams=BEAMS, materials=MATERIALS, highest_log=3.0)


def exact(model, parameters, beam, thickness_mm):
    """-ln of the signal's transmission and the gain over the open beam's, by the sum over all energies."""
    signal, variance, _ = model.moment_weights(parameters, beam)
    depth = sum(
        length[..., None] * model.mu(name)[: len(signal)] for name, length in zip(MATERIALS, thickness_mm, strict=True)
    )
    passed = np.exp(-depth)
    first, second = passed @ signal, passed @ variance
    return -np.log(first / signal.sum()), (second / first) / (variance.sum() / signal.sum())


def test_tables_equal_the_sum_over_energies_to_1e_5(model, parameters, tables):
    rng = np.random.default_rng(0)
    thickness_mm = np.stack([rng.uniform(0, 60, (20, 20)), rng.uniform(0, 12, (20, 20))])
    found = look_up_two_materials(tables, thickness_mm)
    for number, beam in enumerate(BEAMS):
        logs, gain = exact(model, parameters, beam, thickness_mm)
        np.testing.assert_allclose(found.log_signal[number], logs, atol=1e-5)
        np.testing.assert_allclose(found.gain_ratio[number], gain, rtol=1e-5)


def test_slopes_are_the_derivatives_of_the_logs(model, parameters, tables):
    thickness_mm = np.array([[[3.0, 20.0, 45.0]], [[0.2, 1.0, 6.0]]])
    found = look_up_two_materials(tables, thickness_mm)
    for axis in (0, 1):
        step = np.zeros((2, 1, 1))
        step[axis] = 1e-3
        for number, beam in enumerate(BEAMS):
            above, _ = exact(model, parameters, beam, thickness_mm + step)
            below, _ = exact(model, parameters, beam, thickness_mm - step)
            np.testing.assert_allclose(found.log_slopes_per_mm[number, axis], (above - below) / 2e-3, rtol=2e-4)


@given(st.integers(0, 10_000))
def test_the_solution_gives_the_path_lengths_back(tables, seed):
    rng = np.random.default_rng(seed)
    thickness_mm = np.stack([rng.uniform(0, 50, (6, 6)), rng.uniform(0, 8, (6, 6)) * rng.integers(0, 2, (6, 6))])
    logs = look_up_two_materials(tables, thickness_mm).log_signal[:2]
    found = solve_two_materials(tables, logs)
    assert found.solved.all()
    np.testing.assert_allclose(found.thickness_mm, thickness_mm, atol=1e-6)


def test_noise_of_the_open_field_becomes_small_lengths_of_both_signs_around_zero(tables):
    rng = np.random.default_rng(3)
    logs = 0.02 * rng.standard_normal((2, 100, 100))
    found = solve_two_materials(tables, logs)
    assert found.solved.all()
    for length in found.thickness_mm:
        assert length.min() < 0 < length.max()
        # the curvature of the model leaves a part of the scatter as bias, noise of the mean comes on top
        assert abs(length.mean()) < 0.1 * length.std()


def test_a_change_of_the_references_shows_at_other_beams_as_the_transfer_says(tables):
    thickness_mm = np.array([[[0.0, 12.0, 30.0]], [[0.0, 0.0, 2.0]]])
    base = look_up_two_materials(tables, thickness_mm)
    transfer = base.transfer()
    np.testing.assert_allclose(transfer[0], np.broadcast_to([[[1.0]], [[0.0]]], (2, 1, 3)), atol=1e-12)
    np.testing.assert_allclose(transfer[1], np.broadcast_to([[[0.0]], [[1.0]]], (2, 1, 3)), atol=1e-12)
    change = np.array([[[1e-4] * 3], [[-2e-4] * 3]])
    moved = solve_two_materials(tables, base.log_signal[:2] + change)
    expected = np.einsum("cjyx,jyx->cyx", transfer, change)
    np.testing.assert_allclose(moved.log_signal - base.log_signal, expected, atol=2e-7)


def test_a_third_low_z_material_reaches_another_spectrum_within_one_percent(model, parameters, tables):
    """Acrylic is in neither basis; what 40 and 90 kV say of it holds at 60 and 120 kV."""
    mu = model.mu("pmma")
    logs = []
    for beam in BEAMS:
        signal = model.moment_weights(parameters, beam)[0]
        logs.append(-np.log(np.exp(-20.0 * mu[: len(signal)]) @ signal / signal.sum()))
    found = solve_two_materials(tables, np.array(logs[:2])[:, None, None])
    np.testing.assert_allclose(found.log_signal[2:, 0, 0], logs[2:], rtol=0.01)


def test_more_than_the_tables_hold_goes_on_in_a_straight_line(tables):
    far = look_up_two_materials(tables, np.array([[[500.0, 501.0, 502.0]], [[0.0, 0.0, 0.0]]]))
    np.testing.assert_allclose(np.diff(far.log_signal[:, 0], axis=1), far.log_slopes_per_mm[:, 0, 0, :2], rtol=1e-9)


def test_two_voltages_that_cannot_tell_the_materials_apart_are_refused(model, parameters):
    near = (OpenBeam(kV=90.0, filters=COPPER), OpenBeam(kV=90.5, filters=COPPER))
    with pytest.raises(InputError, match="cannot be told apart"):
        tabulate_two_materials(model, parameters, beams=near, materials=MATERIALS)
    with pytest.raises(InputError, match="cannot be told apart"):
        tabulate_two_materials(model, parameters, beams=BEAMS[:2], materials=("water", "water"))


@pytest.mark.parametrize(
    ("logs", "message"),
    [
        (np.zeros((3, 4, 4)), r"shape \(3, 4, 4\)"),
        (np.zeros((2, 4)), r"expected \(2, row, column\)"),
        (np.full((2, 4, 4), np.nan), "not finite"),
        (np.full((2, 4, 4), np.inf), "not finite"),
    ],
)
def test_images_that_are_no_pair_are_refused(tables, logs, message):
    with pytest.raises(InputError, match=message):
        solve_two_materials(tables, logs)
