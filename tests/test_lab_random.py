"""The lab's random numbers follow the laws they are named after."""

import numpy as np
import pytest
from numba import njit
from scipy import stats

from raytwin.lab._loops import gamma, normal, poisson, poisson_tables, seed_stream, uniform
from raytwin.lab._session_loops import fast_normal, light_quanta

DRAWS = 200_000
# A test statistic this improbable is a fault, not bad luck; seeds are fixed, so a pass stays a pass.
P_FLOOR = 1e-5


@njit
def _draw(kind, parameter, count, key, row, keep, alias):
    state = np.empty(4, dtype=np.uint64)
    seed_stream(state, key, 1, 0, row)
    out = np.empty(count)
    for i in range(count):
        if kind == 0:
            out[i] = poisson(state, parameter, keep, alias)
        elif kind == 1:
            out[i] = gamma(state, parameter)
        elif kind == 2:
            out[i] = normal(state)
        else:
            out[i] = uniform(state)
    return out


def draw(kind: str, parameter: float = 0.0, *, count: int = DRAWS, row: int = 0) -> np.ndarray:
    number = ["poisson", "gamma", "normal", "uniform"].index(kind)
    return _draw(number, parameter, count, np.uint64(20240601), row, *poisson_tables())


@pytest.mark.parametrize("mean", [0.01, 0.2, 0.5, 1.3, 4.9, 5.1, 17.77, 63.9, 64.0, 150.0])
def test_poisson_numbers_have_the_poisson_frequencies(mean):
    counts = draw("poisson", mean)
    assert np.array_equal(counts, np.rint(counts)) and counts.min() >= 0
    values, observed = np.unique(counts, return_counts=True)
    expected = DRAWS * stats.poisson.pmf(values, mean)
    large = expected > 10
    rest = DRAWS - observed[large].sum(), DRAWS - expected[large].sum()
    chi2 = ((observed[large] - expected[large]) ** 2 / expected[large]).sum()
    if rest[1] > 5:
        chi2 += (rest[0] - rest[1]) ** 2 / rest[1]
    assert stats.chi2.sf(chi2, max(int(large.sum()) - (rest[1] <= 5), 1)) > P_FLOOR


@pytest.mark.parametrize("mean", [1e3, 1e5, 1e7])
def test_bright_poisson_numbers_have_mean_and_variance_of_their_law(mean):
    counts = draw("poisson", mean)
    assert abs(counts.mean() - mean) < 5 * np.sqrt(mean / DRAWS)
    assert abs(counts.var(ddof=1) / mean - 1) < 5 * np.sqrt(2 / DRAWS)


def test_poisson_of_mean_zero_is_zero():
    assert not draw("poisson", 0.0, count=1000).any()


@pytest.mark.parametrize("shape", [0.5, 1.0, 7.3, 400.0])
def test_gamma_numbers_follow_the_gamma_law(shape):
    assert stats.kstest(draw("gamma", shape), stats.gamma(shape).cdf).pvalue > P_FLOOR


def test_normal_and_uniform_numbers_follow_their_laws():
    assert stats.kstest(draw("normal"), stats.norm.cdf).pvalue > P_FLOOR
    assert stats.kstest(draw("uniform"), stats.uniform.cdf).pvalue > P_FLOOR


def test_streams_of_neighbouring_rows_are_uncorrelated():
    streams = np.array([draw("normal", count=20_000, row=row) for row in range(12)])
    correlation = np.corrcoef(streams)[np.triu_indices(12, 1)]
    assert np.abs(correlation).max() < 5 / np.sqrt(20_000)


def test_the_tables_hold_the_poisson_law_to_single_precision():
    keep, alias = poisson_tables()
    for row, mean in ((1, 0.5), (20, 10.0), (128, 64.0)):
        share = keep[row].astype(float)
        law = share.copy()
        np.add.at(law, alias[row], 1.0 - share)
        assert np.abs(law / 256 - stats.poisson.pmf(np.arange(256), mean)).max() < 1e-7


@njit
def _draw_fast(count, key):
    state = np.empty(4, dtype=np.uint64)
    seed_stream(state, key, 1, 0, 0)
    out = np.empty(count)
    for i in range(count):
        out[i] = fast_normal(state)
    return out


def test_normal_numbers_of_the_ziggurat_follow_their_law_into_the_tails():
    drawn = _draw_fast(2_000_000, np.uint64(3))
    assert stats.kstest(drawn[:DRAWS], stats.norm.cdf).pvalue > P_FLOOR
    edges = np.array([-np.inf, -4.0, -3.65, -3.0, -1.0, 0.0, 1.0, 3.0, 3.65, 4.0, np.inf])
    observed = np.histogram(drawn, bins=edges)[0]
    expected = drawn.size * np.diff(stats.norm.cdf(edges))
    assert stats.chi2.sf(((observed - expected) ** 2 / expected).sum(), expected.size - 1) > P_FLOOR


@pytest.mark.parametrize("mean", [0.4, 7.9, 8.1, 60.0])
def test_light_of_a_number_of_photons_has_mean_variance_and_skewness_of_the_compound_law(mean):
    variance = 0.1
    cell, out = np.zeros((400, 500), dtype=np.int32), np.empty((400, 500), dtype=np.float32)
    light_quanta(cell, np.array([mean], dtype=np.float32), 1.0, variance, np.uint64(8), 20, 0, *poisson_tables(), out)
    light = out.ravel().astype(float)
    spread = mean * (1.0 + variance)
    assert abs(light.mean() - mean) < 5 * np.sqrt(spread / light.size)
    kurtosis = 3.0 + 1.5 / mean
    assert abs(light.var() / spread - 1) < 5 * np.sqrt((kurtosis - 1) / light.size)
    # Below eight photons the light's own spread is normal, above the skewness is that of a gamma law of the light.
    third = 1.0 + 3.0 * variance if mean < 8 else (1.0 + variance) * (1.0 + 2.0 * variance)
    expected = third * mean / spread**1.5
    assert stats.skew(light) == pytest.approx(expected, abs=5 * np.sqrt(6 * kurtosis / light.size) + 0.01 * expected)
