"""Optical spread, gains and read noise fitted together to the noise power of several series.

P_s(f) = I_s [A_g S(f) + W_g] + r^2 + E_s f_0 / f + F_s (f_0 / f)^2

S: power of unit quanta after the spread (1 at f = 0), so that the gain of a beam g is A_g + W_g; W: white noise that
follows the signal; r^2: electronic noise; E, F: what is left of slow changes between frames, where the data show any or
come from two series. The spread is a Gaussian core, of one width or two, and a tail (`spread_families.py`). Frames that are
small or few hardly show a tail that takes a tenth of the light and a fifth of the gain with it: tails are averaged over by
their evidence, with what is known of panels as prior, and what they leave open is part of the standard deviations. A second
route to the gain, which knows no kernel, tests the first.

On its way to `fit_spread` noise power passes, in this order: `spread_cells.py` (cells of frequencies), `spread_problem.py` and
`spread_normal.py` (linear in all but the spread), `spread_candidates.py` (one family at its best), `spread_changes.py` (slow
changes), `spread_members.py` (all that is left open), `spread_average.py`, `spread_agreement.py` (measured against fitted),
`series_scatter.py`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...errors import FitError
from ...generator.line.twin import OtherSpread
from ...generator.spread.psf import Spread
from .noise_power import NoisePower
from .series_scatter import chi_square_a_degree, own_to_beams, scatter_of_series
from .spread_agreement import FittedPower, extrapolated_gain, fitted_powers, ratios_of_beams, ratios_of_series
from .spread_average import SpreadAverage
from .spread_changes import changed_as_power, find_drifting
from .spread_members import likeliest, members_of
from .spread_problem import SpreadProblem

FloatArray = NDArray[np.float64]
_MOST_ROUNDS = 4  # of fits with a scatter of series that is known better each time


@dataclass(frozen=True, slots=True, kw_only=True)
class SpreadFit:
    """Spread, gains and read noise of several series.

    Fields: spread; family (in words); others: families that are likely as well; spread_sd (parameter -> standard deviation, of
    sigma_px, aspect, tail_share and tail_px); gain_DN (group,): quantum and signal-following white variance per signal with the
    spread's share restored; slope_DN (group,): variance of one pixel per signal; their standard deviations gain_sd_DN and
    slope_sd_DN; shared_gain_sd: relative standard deviation of gain over slope, by which all gains are off alike, and by
    which beams differ;
    white_fraction (group,): the white part over the quantum part; read_variance_DN2 of a pixel, rows' and columns' offsets in
    it, read_sd_DN2, most_read_DN2 that it can be; row_variance_DN2, column_variance_DN2: of these; chi_square, degrees;
    excess_DN2: slow changes left, one a series; series_ratio: noise of each series over the fitted, with its standard
    deviation; other_route: gains by extrapolated power over those of the fit, with its standard deviation; criteria (family ->
    twice the logarithm of the best family's evidence over its own); expected_DN2: power of each series as squares show it;
    quanta_DN2: that of what follows the signal, not smeared; slow_DN2: that of slow changes, which expected_DN2 leaves out.
    """

    spread: Spread
    family: str
    others: tuple[OtherSpread, ...]
    spread_sd: dict[str, float]
    gain_DN: FloatArray
    gain_sd_DN: FloatArray
    slope_DN: FloatArray
    slope_sd_DN: FloatArray
    white_fraction: FloatArray
    read_variance_DN2: float
    read_sd_DN2: float
    most_read_DN2: float
    row_variance_DN2: float
    column_variance_DN2: float
    chi_square: float
    degrees: float
    excess_DN2: FloatArray
    shared_gain_sd: float
    series_ratio: tuple[tuple[float, float], ...]
    other_route: tuple[float, float]
    criteria: dict[str, float]
    expected_DN2: tuple[FloatArray, ...] = field(repr=False)
    quanta_DN2: tuple[FloatArray, ...] = field(repr=False)
    slow_DN2: tuple[FloatArray, ...] = field(repr=False)

    @property
    def sigma_px(self) -> float:
        """Width of the Gaussian core, px."""
        return self.spread.sigma_px


def fit_spread(
    series: Sequence[NoisePower],
    *,
    group: Sequence[int],
    most_read_DN2: float | None = None,
    screen: bool = False,
    axes: str = "both",
) -> SpreadFit:
    """Spread, gains and read noise from the noise power of series (weighted least squares, weights from the fit itself).

    The spread is the simplest of those that are likely and whose gains are near the mean of all. Standard deviations hold:
    sampling; the misfit, by chi-square where it is above its expectation, over all frequencies or from series to series; what
    other spreads say, by their evidence (model averaging); and for gains the second route, where it differs by more than its own
    noise. Where the noise of series departs from the lines by more than chance, a variance that all share is added to each, and
    all is fitted anew.

    Args:
        series: noise powers, darks included (signal 0).
        group: per series, the index of its kV and filter; -1 for darks.
        most_read_DN2: read variance that the darks allow at most, where they were not repeated; 0: there is none.
        screen: whether a screen is known to spread light.
        axes: index along which light spreads (`spread_axes`).

    Raises:
        FitError: no series with signal, or the least-squares problem has no solution.

    Source: test of two routes: Hausman, Econometrica 46 (1978) 1251. Checked against: noise of known spread,
    tests/test_calibration_spread_fit.py.
    """
    if not any(index >= 0 for index in group):
        raise FitError("the noise fit needs at least one flat series with two or more frames")
    fit_of = partial(_fit_of, group=group, most_read_DN2=most_read_DN2, screen=screen, axes=axes)
    fit = fit_of(series)
    degrees = len(series) - len(fit.gain_DN) - 1
    scatter = 0.0
    for _ in range(_MOST_ROUNDS):
        last, scatter = scatter, scatter_of_series(fit.series_ratio, degrees)
        if scatter <= last * 1.1:
            break
        # where series differ by more than chance, none of them tells more than that lets it
        shares = [1.0 / (1.0 + scatter * float(item.modes.sum())) for item in series]
        fit = fit_of([replace(item, modes=share * item.modes) for item, share in zip(series, shares, strict=True)])
        sampling = zip(fit.series_ratio, shares, strict=True)
        fit = replace(fit, series_ratio=tuple((ratio, sd * math.sqrt(share)) for (ratio, sd), share in sampling))
    return fit


def _fit_of(
    series: Sequence[NoisePower], *, group: Sequence[int], most_read_DN2: float | None, screen: bool, axes: str
) -> SpreadFit:
    """`fit_spread` with series that are believed as far as their modes say."""
    problem = SpreadProblem(series, group, most_read_DN2, screen=screen, axes=axes)
    average = _average(problem)
    chosen = average.chosen
    if not np.all(np.isfinite(chosen.coefficients)):
        raise FitError("the noise power has no fit; look for saturated, constant or processed frames")
    powers = fitted_powers(problem, chosen)
    ratios = ratios_of_series(powers)
    scatter = max(average.inflation, chi_square_a_degree(ratios, len(ratios) - problem.groups - 1))
    beams = _Beams.of(problem, average, powers, scatter)
    rows, columns, lines_sd = _line_variances(series, group)
    read_sd = math.sqrt(max(scatter * float(chosen.covariance[problem.read_place, problem.read_place]), 0.0))
    excess = np.zeros(len(series))
    excess[list(problem.drifting)] = chosen.slow_DN2.sum(axis=1)
    return SpreadFit(
        spread=chosen.spread,
        family=chosen.family,
        others=average.others(),
        spread_sd=average.spread_sd(scatter),
        gain_DN=beams.gain_DN,
        gain_sd_DN=beams.gain_sd_DN,
        slope_DN=beams.slope_DN,
        slope_sd_DN=beams.slope_sd_DN,
        white_fraction=chosen.white / np.where(chosen.quantum > 0, chosen.quantum, np.nan),
        read_variance_DN2=chosen.read_DN2 + rows + columns,
        read_sd_DN2=math.hypot(read_sd, lines_sd, beams.read_moved_DN2),
        most_read_DN2=problem.most_read_DN2,
        row_variance_DN2=max(rows, 0.0),
        column_variance_DN2=max(columns, 0.0),
        chi_square=chosen.chi_square,
        degrees=problem.independent,
        excess_DN2=excess,
        shared_gain_sd=beams.shared_gain_sd,
        series_ratio=tuple(ratios),
        other_route=beams.other_route,
        criteria=average.criteria(),
        expected_DN2=tuple(one.expected_DN2 for one in powers),
        quanta_DN2=tuple(one.quanta_DN2 for one in powers),
        slow_DN2=tuple(one.slow_DN2 for one in powers),
    )


def _average(problem: SpreadProblem) -> SpreadAverage:
    """Spreads that the noise leaves open, with slow changes of the series that show any."""
    members = members_of(problem)
    drifting = find_drifting(problem, likeliest(members.candidates).spread)
    if drifting != problem.drifting:
        problem.drifting = drifting
        members = members_of(problem)
    return SpreadAverage.of(members)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Beams:
    """Gains and slopes of the beams with their standard deviations (group,), as in `SpreadFit`; read_moved_DN2: what the read
    variance changes by where slow changes may only add power."""

    gain_DN: FloatArray
    gain_sd_DN: FloatArray
    slope_DN: FloatArray
    slope_sd_DN: FloatArray
    shared_gain_sd: float
    other_route: tuple[float, float]
    read_moved_DN2: float

    @classmethod
    def of(
        cls, problem: SpreadProblem, average: SpreadAverage, powers: Sequence[FittedPower], scatter: float
    ) -> "_Beams":
        """What spreads, slow changes, the second route and each beam's own noise leave open; scatter: what sampling variances are
        multiplied by."""
        gain, slope, groups = average.chosen.gains, average.chosen.slopes, problem.groups
        gain_moved, slope_moved, read_moved = changed_as_power(problem, average.chosen)
        other = extrapolated_gain(powers)
        route = max(0.0, (other[0] - 1.0) ** 2 - other[1] ** 2)
        low, whole = ratios_of_beams(powers, groups)
        # slopes follow their own beam, as the noise of its frames does; gains go with one spread, which images have
        gain_own, gain_open = own_to_beams(low, groups - 1)
        slope_own, slope_open = own_to_beams(whole, groups)
        gain_variance, slope_variance = average.scale_variances(scatter)
        gain_variance = gain_variance + gain_moved**2 + route * gain**2 + gain**2 * (gain_own**2 + gain_open**2)
        slope_variance = (slope_variance + slope_moved**2) * (1.0 + slope_own) ** 2 + (slope * slope_open) ** 2
        both = np.concatenate([gain_moved / np.maximum(gain, 1e-300), slope_moved / np.maximum(slope, 1e-300)])
        covariance = average.log_covariance(scatter) + np.outer(both, both)
        covariance[:groups, :groups] += route
        return cls(
            gain_DN=gain,
            gain_sd_DN=np.sqrt(gain_variance),
            slope_DN=slope * (1.0 + slope_own),
            slope_sd_DN=np.sqrt(slope_variance),
            # a beam that was not measured may spread otherwise as the measured ones do
            shared_gain_sd=math.hypot(
                _sd_of_gain_over_slope(covariance), math.sqrt(float(np.mean(gain_own**2 + gain_open**2)))
            ),
            other_route=other,
            read_moved_DN2=read_moved,
        )


def _sd_of_gain_over_slope(covariance: FloatArray) -> float:
    """Standard deviation of the logarithm of gain over slope, the same for all beams, from the covariance of both logarithms."""
    groups = len(covariance) // 2
    ratio = np.hstack([np.eye(groups), -np.eye(groups)])
    return math.sqrt(max(float(np.mean(np.diag(ratio @ covariance @ ratio.T))), 0.0))


def _line_variances(series: Sequence[NoisePower], group: Sequence[int]) -> tuple[float, float, float]:
    """Variance of rows' and of columns' offsets (DN^2), and its standard deviation: from repeated darks, else from pairs of single
    flats; 0 without either."""
    darks = [item for item, number in zip(series, group, strict=True) if number < 0]
    darks = darks or [item for item in series if item.between_series]
    if not darks:
        return 0.0, 0.0, 0.0
    found, sds = [], []
    for kind in ("row", "column"):
        weight = np.array([1.0 / max(getattr(item, f"{kind}_sd_DN2"), 1e-12) ** 2 for item in darks])
        values = np.array([getattr(item, f"{kind}_variance_DN2") for item in darks])
        found.append(float(np.sum(weight * values) / weight.sum()))
        sds.append(float(1.0 / math.sqrt(weight.sum())))
    return found[0], found[1], math.hypot(*sds)
