"""Measured noise power against the fitted one: of each series, of each beam, and by a route to the gain that knows no kernel."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .noise_power import NoisePower
from .spread_candidates import Candidate
from .spread_cells import slow_shapes
from .spread_problem import SpreadProblem

FloatArray = NDArray[np.float64]
_LOW_BAND = 0.2  # cycles a pixel, up to which the second route extrapolates to 0


@dataclass(frozen=True, slots=True, eq=False)
class FittedPower:
    """A series and what is fitted to it.

    Fields: measured; group: of its beam, -1 for darks; expected_DN2 (K + 1, K + 1): its power as squares show it, slow changes left
    out; read_DN2: that of electronic noise, which is part of it; slow_DN2: that of slow changes; quanta_DN2: that of what follows
    the signal, as no square has smeared it.
    """

    measured: NoisePower
    group: int
    expected_DN2: FloatArray
    read_DN2: FloatArray
    slow_DN2: FloatArray
    quanta_DN2: FloatArray

    @property
    def whole_DN2(self) -> FloatArray:
        """With slow changes."""
        return self.expected_DN2 + self.slow_DN2

    @property
    def low(self) -> NDArray[np.bool_]:
        """Frequencies (K + 1, K + 1) up to 0.2 cycles a pixel."""
        frequency = np.arange(self.expected_DN2.shape[0]) / self.measured.square_px
        return np.asarray(frequency[:, None] ** 2 + frequency[None, :] ** 2 < _LOW_BAND**2)

    @property
    def beyond_DN2(self) -> FloatArray:
        """What was measured beyond the fit (K + 1, K + 1)."""
        return self.measured.power_DN2 - self.expected_DN2 - self.slow_DN2


def fitted_powers(problem: SpreadProblem, item: Candidate) -> list[FittedPower]:
    """All series with what a spread makes of them."""
    shapes = problem.shapes(item.spread)
    powers = {side: item.spread.noise_power(side) for side in problem.sides}
    found = []
    for number, (one, group) in enumerate(zip(problem.series, problem.group, strict=True)):
        read = item.read_DN2 * problem.electronic[one.square_px]
        expected, slow, quanta = read, np.zeros(read.shape), np.zeros(read.shape)
        if group >= 0:
            quantum, white = item.quantum[group], item.white[group]
            expected = read + one.signal_DN * (quantum * shapes[one.square_px] + white)
            quanta = one.signal_DN * (quantum * powers[one.square_px] + white)
        if number in problem.drifting:
            own = item.slow_DN2[problem.drifting.index(number)]
            slow = np.tensordot(own, slow_shapes(one.square_px), axes=1)
        found.append(FittedPower(one, group, expected, read, slow, quanta))
    return found


def ratios_of_series(powers: Sequence[FittedPower]) -> list[tuple[float, float]]:
    """Whole power of each series over what is fitted, and the standard deviation of that; nan where nothing is fitted."""
    found = []
    for one in powers:
        fitted, modes = np.where(one.measured.used, one.whole_DN2, 0.0), one.measured.modes
        lit = fitted > 0
        if lit.any():
            ratio = float(np.average(one.measured.power_DN2[lit] / fitted[lit], weights=modes[lit]))
            found.append((ratio, 1.0 / math.sqrt(float(modes[lit].sum()))))
        else:
            found.append((math.nan, math.nan))
    return found


def ratios_of_beams(
    powers: Sequence[FittedPower], groups: int
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Noise of each beam's quanta over the fitted, with its standard deviation: at low frequencies, less that of all, and whole.

    Light made at other depths spreads otherwise (Lubberts, J. Opt. Soc. Am. 58 (1968) 1475), and beams are stopped at
    other depths. The whole is a pixel's variance, which asks no kernel at all; nan where a beam has no such frequency.
    """
    beyond, quanta, variance = np.zeros((3, 2, groups))  # sums over modes (low or whole, group)
    for one in powers:
        if one.group < 0:
            continue
        used = one.measured.used
        for row, band in enumerate((used & one.low, used)):
            modes = one.measured.modes[band]
            # series of one beam count by how well they know it
            precision = 1.0 / max(float(np.mean(one.expected_DN2[band])), 1e-300) if band.any() else 0.0
            beyond[row, one.group] += precision * float(modes @ one.beyond_DN2[band])
            quanta[row, one.group] += precision * float(modes @ (one.expected_DN2 - one.read_DN2)[band])
            variance[row, one.group] += precision**2 * float(modes @ one.whole_DN2[band] ** 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, sd = 1.0 + beyond / quanta, np.sqrt(variance) / quanta
        weight = np.where(np.isfinite(sd[0]), sd[0], np.inf) ** -2.0
        ratio[0] -= float(weight @ np.nan_to_num(ratio[0] - 1.0)) / max(float(weight.sum()), 1e-300)
    low, whole = ([(float(one), float(own)) for one, own in zip(ratio[row], sd[row], strict=True)] for row in range(2))
    return low, whole


def extrapolated_gain(powers: Sequence[FittedPower]) -> tuple[float, float]:
    """Gain by extrapolation of the low-frequency power to 0, over the fit's, and its standard deviation.

    The ratio of measured to fitted power of the quanta, up to 0.2 cycles a pixel, as 1 + a + b f_row^2 + c f_column^2: it
    asks no kernel family, only that the ratio is smooth. Squares of 16 px have too few frequencies there: their mean is 1 + a.
    """
    rows, weights, values = [], [], []
    for one in powers:
        band = one.measured.used & one.low & (one.expected_DN2 > one.read_DN2)
        if one.group < 0 or not band.any():
            continue
        quanta = (one.expected_DN2 - one.read_DN2)[band]
        values.append(one.beyond_DN2[band] / quanta)
        weights.append(one.measured.modes[band] * (quanta / one.whole_DN2[band]) ** 2)
        frequency = np.arange(band.shape[0]) / one.measured.square_px
        grid = np.broadcast_arrays(frequency[:, None] ** 2, frequency[None, :] ** 2)
        rows.append(np.column_stack([np.ones(quanta.size), grid[0][band], grid[1][band]]))
    if not rows:
        return 1.0, math.inf
    design, weight, value = np.concatenate(rows), np.concatenate(weights), np.concatenate(values)
    information = design.T @ (design * weight[:, None])
    if np.linalg.matrix_rank(information / np.trace(information)) < 3:
        design = design[:, :1]
        information = design.T @ (design * weight[:, None])
    covariance = np.linalg.inv(information)
    ratio = 1.0 + float((covariance @ (design.T @ (weight * value)))[0])
    return ratio, math.sqrt(float(covariance[0, 0]))
