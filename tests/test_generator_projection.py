"""Polychromatic projection: the exact sum over energies within 1e-4, at any shape, thickness and number of materials."""

import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from raytwin.errors import InputError
from raytwin.generator.frames.scene import _distinct
from raytwin.generator.kernels.projection import project_polychromatic

TOLERANCE = 1e-4  # relative; what the docstring promises
ENERGIES_KEV = np.linspace(10.0, 90.0, 101)


def coefficients(materials, *, energies_keV=ENERGIES_KEV):
    photoelectric = np.array([0.16, 1.1, 0.4, 6.0])[:materials, None] * (20.0 / energies_keV) ** 3
    return photoelectric + np.array([0.02, 0.035, 0.03, 0.05])[:materials, None]


def spectrum(energies_keV=ENERGIES_KEV):
    number = 3e4 * np.exp(-(((energies_keV - 45.0) / 16.0) ** 2))
    return np.stack([number * energies_keV, number * energies_keV**2])


def exact(thickness, mu, weights):
    pixels = np.asarray(thickness, dtype=np.float64).reshape(len(thickness), -1)
    sums = np.asarray(weights, dtype=np.float64) @ np.exp(-np.asarray(mu).T @ pixels)
    return sums.reshape(-1, *np.shape(thickness)[1:])


@pytest.mark.parametrize("materials", [1, 2, 3, 4])
@pytest.mark.parametrize("moments", [1, 2, 5])
def test_projection_is_the_sum_over_energies(materials, moments):
    rng = np.random.default_rng(materials)
    thickness = rng.uniform(0.0, [[[60.0]], [[6.0]], [[9.0]], [[2.0]]][:materials], size=(materials, 37, 53))
    mu, weights = coefficients(materials), np.concatenate([spectrum()] * 3)[:moments]
    result = project_polychromatic(thickness, mu, weights)
    assert result.dtype == np.float32
    assert result.shape == (moments, 37, 53)
    assert np.max(np.abs(result / exact(thickness, mu, weights) - 1.0)) < TOLERANCE


def test_threads_share_many_pixels_and_change_nothing():
    thickness = np.random.default_rng(5).uniform(0.0, [[[60.0]], [[6.0]]], size=(2, 200, 100))
    mu, weights = coefficients(2), spectrum()
    whole = project_polychromatic(thickness, mu, weights)
    assert np.max(np.abs(whole / exact(thickness, mu, weights) - 1.0)) < TOLERANCE
    np.testing.assert_array_equal(project_polychromatic(thickness[:, :3], mu, weights), whole[:, :3])


@pytest.mark.parametrize(
    ("materials", "backend"),
    [(1, "torch"), (2, "torch"), (3, "torch"), pytest.param(2, "torch_compiled", marks=pytest.mark.slow)],
)
@pytest.mark.filterwarnings("ignore")  # of torch's compiler
def test_torch_projects_the_same(materials, backend):
    if backend == "torch_compiled" and shutil.which("g++") is None:
        pytest.skip("torch's compiler needs g++")
    rng = np.random.default_rng(materials)
    thickness = rng.uniform(0.0, [[[60.0]], [[6.0]], [[9.0]]][:materials], size=(materials, 37, 53))
    thickness[:, 0] = 0.0
    thickness[0, 1] = 1e30
    mu, weights = coefficients(materials), spectrum()
    result = project_polychromatic(thickness, mu, weights, backend=backend, device="cpu").numpy()
    expected = exact(thickness, mu, weights)
    assert result.shape == (2, 37, 53)
    assert np.all(np.abs(result - expected) <= TOLERANCE * expected)


def test_an_unknown_backend_is_refused():
    with pytest.raises(InputError, match="backend: got gpu; expected one of cpu, torch, torch_compiled"):
        project_polychromatic(np.zeros((1, 2, 2)), coefficients(1), spectrum(), backend="gpu")


@pytest.mark.parametrize("energies", [1, 2, 3, 5, 240])
def test_any_number_of_energies_is_summed(energies):
    energies_keV = np.linspace(15.0, 120.0, energies)
    mu, weights = coefficients(2, energies_keV=energies_keV), spectrum(energies_keV)
    thickness = np.linspace(0.0, 20.0, 2 * 7 * 3).reshape(2, 7, 3)
    result = project_polychromatic(thickness, mu, weights)
    assert np.max(np.abs(result / exact(thickness, mu, weights) - 1.0)) < TOLERANCE


def test_zero_thickness_gives_the_sum_of_the_weights_exactly():
    weights = spectrum()
    result = project_polychromatic(np.zeros((2, 5, 6)), coefficients(2), weights)
    expected = weights.sum(axis=1).astype(np.float32)
    assert np.array_equal(result, np.broadcast_to(expected[:, None, None], result.shape))


def test_accuracy_holds_down_to_transmissions_of_1e_minus_30():
    mu, weights = coefficients(1), spectrum()
    thickness = np.linspace(0.0, 69.0 / mu.min(), 500).reshape(1, 20, 25)
    expected = exact(thickness, mu, weights)
    result = project_polychromatic(thickness, mu, weights)
    assert np.max(np.abs(result / expected - 1.0)) < TOLERANCE


def test_a_huge_thickness_lets_nothing_through_and_warns_of_nothing():
    thickness = np.array([[[1e4, 1e20, 1e300]], [[0.0, 1e38, 1e300]]])
    assert np.array_equal(project_polychromatic(thickness, coefficients(2), spectrum()), np.zeros((2, 1, 3)))


def test_a_transparent_material_takes_nothing_away_however_thick():
    mu = np.zeros((2, len(ENERGIES_KEV)))
    result = project_polychromatic(np.full((2, 3, 3), 1e38), mu, spectrum())
    assert np.allclose(result, spectrum().sum(axis=1)[:, None, None], rtol=1e-5)


def test_without_materials_nothing_is_in_the_way():
    result = project_polychromatic(np.zeros((0, 4, 5)), np.zeros((0, 101)), spectrum())
    assert result.shape == (2, 4, 5)
    assert np.allclose(result, spectrum().sum(axis=1)[:, None, None], rtol=1e-6)


def test_negative_thickness_where_it_is_asked_for_amplifies():
    thickness = np.array([[[-0.7, 0.3]], [[0.1, -0.05]]])
    mu, weights = coefficients(2), spectrum()
    result = project_polychromatic(thickness, mu, weights, allow_negative=True)
    assert np.max(np.abs(result / exact(thickness, mu, weights) - 1.0)) < TOLERANCE


def test_a_single_row_of_weights_may_come_without_its_axis():
    thickness = np.ones((1, 2, 2))
    one = project_polychromatic(thickness, coefficients(1)[0], spectrum()[0])
    assert np.array_equal(one, project_polychromatic(thickness, coefficients(1), spectrum()[:1]))


@given(
    st.integers(0, 2**32 - 1),
    hnp.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=40),
    st.sampled_from([np.float16, np.float32, np.float64, np.uint8, np.int32]),
    st.integers(1, 3),
)
def test_layers_multiply_and_more_material_lets_less_through(seed, shape, dtype, materials):
    rng = np.random.default_rng(seed)
    thickness = rng.integers(0, 60, size=(materials, *shape)).astype(dtype)
    mu, weights = coefficients(materials), spectrum()
    result = project_polychromatic(thickness, mu, weights)
    assert result.shape == (2, *shape)
    assert np.all(result >= 0)
    assert np.all(result <= weights.sum(axis=1)[:, None, None] * (1 + 1e-5))
    if result.size:
        expected = exact(thickness, mu, weights)
        assert np.max(np.abs(result / expected - 1.0)) < TOLERANCE
        thicker = project_polychromatic(thickness.astype(np.float64) + 0.5, mu, weights)
        assert np.all(thicker < result)
        # one energy at a time the first material is a factor of its own
        single = project_polychromatic(thickness, mu[:, 40:41], weights[:1, 40:41])[0]
        alone = np.prod(np.exp(-mu[:, 40, None, None] * thickness.astype(np.float64)), axis=0)
        assert np.allclose(single, weights[0, 40] * alone, rtol=TOLERANCE)


@given(
    hnp.arrays(
        np.float32, hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=7), elements=st.floats(width=32)
    ),
    hnp.arrays(np.float64, (2, 5), elements=st.floats() | st.sampled_from([0.0, 0.1, 3.0])),
    hnp.arrays(np.float64, (2, 5), elements=st.floats() | st.sampled_from([0.0, 1.0, 1e4])),
    st.booleans(),
)
def test_whatever_numbers_come_the_answer_is_a_projection_or_an_error_in_lab_words(thickness, mu, weights, negative):
    try:
        result = project_polychromatic(thickness, mu[: len(thickness)], weights, allow_negative=negative)
    except InputError as error:
        assert "expected" in str(error)
        return
    assert result.shape == (2, *thickness.shape[1:])
    assert np.all(result >= 0)


@given(st.integers(0, 2**32 - 1), st.integers(1, 3000))
def test_a_pixel_does_not_depend_on_its_neighbours(seed, pixels):
    rng = np.random.default_rng(seed)
    thickness = rng.exponential(8.0, size=(2, 1, pixels)).astype(np.float32)
    mu, weights = coefficients(2), spectrum()
    result = project_polychromatic(thickness, mu, weights)
    position = int(rng.integers(pixels))
    alone = project_polychromatic(thickness[:, :, position : position + 1], mu, weights)
    assert np.allclose(result[:, :, position : position + 1], alone, rtol=1e-6)


@pytest.mark.parametrize(
    ("thickness", "mu", "weights", "message"),
    [
        ([[[-0.1]]], [[0.1]], [[1.0]], r"thickness_mm: got -0.1 mm in 1 places; expected 0 mm or more; cut at 0"),
        ([[[np.nan, 1.0]]], [[0.1]], [[1.0]], r"thickness_mm: got 1 NaN or infinite; expected finite mm"),
        ([[[np.inf]]], [[0.1]], [[1.0]], r"thickness_mm: got 1 NaN or infinite"),
        (3.0, [[0.1]], [[1.0]], r"thickness_mm: got float64 of shape \(\); expected numbers of shape"),
        ([["x"]], [[0.1]], [[1.0]], r"thickness_mm: got .* expected numbers"),
        ([[[1.0]]], [[-0.1]], [[1.0]], r"mu_per_mm: got -0.1 in 1 of 1 places; expected finite attenuation"),
        ([[[1.0]]], [[np.nan]], [[1.0]], r"mu_per_mm: got nan"),
        ([[[1.0]]], [[0.1]], [[-1.0]], r"weights: got -1 in 1 of 1 places; expected finite weights of 0 or more"),
        ([[[1.0]]], [[0.1]], [[np.inf]], r"weights: got inf"),
        ([[[1.0]]], [[0.1]], [[1e300]], r"weights: got a sum of 1e\+300; expected less than 3e38"),
        (
            [[[1.0]]],
            [[0.1, 0.2]],
            [[1.0]],
            r"mu_per_mm and weights: got arrays of \(1, 2\) and \(1, 1\); expected \(1, e",
        ),
        ([[[1.0]]], [[0.1], [0.2]], [[1.0]], r"mu_per_mm and weights: got arrays of \(2, 1\)"),
    ],
)
def test_what_cannot_be_projected_is_refused_in_lab_words(thickness, mu, weights, message):
    with pytest.raises(InputError, match=message):
        project_polychromatic(np.array(thickness), np.array(mu), np.array(weights))


@pytest.mark.parametrize("coordinates", [1, 2, 3])
def test_distinct_path_lengths_are_found_once_each_and_put_back(coordinates):
    points = np.random.default_rng(3).integers(0, 5, (coordinates, 400)).astype(np.float32) / np.float32(3.0)
    distinct, where = _distinct(points)
    np.testing.assert_array_equal(distinct[:, where], points)
    assert len({tuple(column) for column in distinct.T}) == distinct.shape[1] < 400
