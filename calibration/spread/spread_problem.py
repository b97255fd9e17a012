"""The noise power of all series as one problem, linear in all but the spread.

Coefficients, in this order: A of each beam, the power of its quanta per signal; W of each beam, white noise that follows the
signal; r^2, electronic noise; E and F of each series with slow changes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...generator.spread.psf import Spread
from .noise_power import NoisePower, spread_of_bins
from .spread_cells import cells_of, electronic_shape, most_of_power, slow_in_cells
from .spread_families import forms_of, prior_of_models
from .spread_normal import Normal, WhitePrior

FloatArray = NDArray[np.float64]
SETTLED = 0.01  # of chi-square: a tenth of a standard deviation
_WHITE_ROUNDS = 8  # of weights that follow the prior's tail
_SILENT = 1e-6  # of the brightest series' power: below that a series is known as well as can be used


@dataclass(frozen=True, slots=True)
class _SlowSums:
    """What a series adds to the normal equations of its slow changes (change,), whatever the spread is."""

    weighted: FloatArray  # their power times the weights (cell, change)
    squares: FloatArray  # (change, change)
    with_read: FloatArray
    with_data: FloatArray

    @classmethod
    def of(cls, side: int, weights: FloatArray, data: FloatArray, read: FloatArray) -> "_SlowSums":
        """Of a series with these weights, powers and electronic noise (cell,)."""
        slow = slow_in_cells(side)
        weighted = slow * weights[:, None]
        return cls(weighted, slow.T @ weighted, weighted.T @ read, weighted.T @ data)


@dataclass(frozen=True, slots=True)
class _Signal:
    """What the signal of beams is multiplied by: A, W and, where asked for, the spread's parameters from the place `theta` on."""

    groups: int
    theta: int
    shapes: Mapping[int, FloatArray]
    quantum: FloatArray | None
    slopes: Sequence[Mapping[int, FloatArray]]

    def columns(self, side: int, group: int) -> tuple[list[int], FloatArray]:
        """Places and columns (cell, column) of a beam."""
        shape = self.shapes[side]
        places = [group, self.groups + group, *range(self.theta, self.theta + len(self.slopes))]
        moved = [] if self.quantum is None else [float(self.quantum[group]) * slope[side] for slope in self.slopes]
        return places, np.stack([shape, np.ones_like(shape), *moved], axis=1)


class SpreadProblem:
    """Powers of the series; linear in all but the spread.

    Series of a beam share their shape and differ in signal and weight alone, so that sums over them of weight, weight x signal
    and weight x signal^2, cell by cell, are all that a fit asks of them.

    Weights, which series have slow changes (`drifting`), and how large those are (`slow_sd_DN2`) get known better as it is solved.
    """

    def __init__(
        self,
        series: Sequence[NoisePower],
        group: Sequence[int],
        most_read_DN2: float | None,
        *,
        screen: bool,
        axes: str,
    ) -> None:
        """Arguments as of `fit_spread`."""
        self.forms = forms_of(axes)
        self.prior = prior_of_models(screen=screen)
        self.series = list(series)
        self.group = list(group)
        self.groups = max(group) + 1
        self.sides = sorted({item.square_px for item in series})
        # squares of one size show nearly the same of noise in all series: those of the series that tells most stand for them
        self.squares = {item.square_px: item for item in sorted(series, key=lambda item: item.samples)}
        self.data: list[FloatArray] = []
        self.modes: list[FloatArray] = []
        self.independent = 0.0  # bins are correlated: so many of them would be independent
        for item in series:
            layout = cells_of(item.square_px)
            self.data.append(layout.means(item.power_DN2))
            self.modes.append(layout.share * item.modes.sum())
            # cells of one bin scatter as overlapping squares do, wide ones as their modes say
            self.independent += float(np.sum(spread_of_bins(item.square_px) ** (1.0 / np.bincount(layout.cell))))
        self.drifting = tuple(number for number, item in enumerate(series) if item.between_series)
        # standard deviation of the power of each series' slow changes, where others tell it
        self.slow_sd_DN2 = np.full(len(self.series), math.inf)
        darks = [item for item, number in zip(series, group, strict=True) if number < 0]
        self.electronic = {
            side: electronic_shape([item for item in darks if item.square_px == side], side) for side in self.sides
        }
        self.most_read_DN2 = math.inf if darks else self._most_read(most_read_DN2)
        # each series has a level of its own: weights begin from its mean
        self.weigh([np.full(data.size, max(float(np.mean(data)), 1e-12)) for data in self.data])

    def _most_read(self, stated_DN2: float | None) -> float:
        """What electronic noise is at most where darks were not repeated: at no frequency more than what was measured there."""
        cells = sum(data.size for data in self.data)
        pairs = zip(self.data, self.modes, strict=True)
        measured = [float(np.min(most_of_power(data, modes, cells))) for data, modes in pairs]
        return min([*measured, math.inf if stated_DN2 is None else stated_DN2])

    @property
    def read_place(self) -> int:
        """Where the coefficient of electronic noise stands."""
        return 2 * self.groups

    def slow_places(self, order: int) -> list[int]:
        """Where E and F of a series stand, by its place in `drifting`."""
        first = 2 * self.groups + 1 + 2 * order
        return [first, first + 1]

    @property
    def not_negative(self) -> range:
        """Coefficients that add power: white noise that follows the signal, electronic noise.

        Slow changes add power as well, but each series has its own: held at 0 and above, their noise would be taken from the
        quanta.
        """
        return range(self.groups, 2 * self.groups + 1)

    def weigh(self, expected: Sequence[FloatArray]) -> None:
        """Take the weights from expected powers (cell,) of each series, and sum over those that share a beam."""
        # a silent dark has no power at all
        floor = _SILENT * max(float(np.mean(data)) for data in self.data)
        pairs = zip(self.modes, expected, strict=True)
        weights = [modes / np.maximum(power, floor) ** 2 for modes, power in pairs]
        self.sums: dict[tuple[int, int], FloatArray] = {}
        self.square = 0.0
        for item, group, data, weight in zip(self.series, self.group, self.data, weights, strict=True):
            signal = item.signal_DN if group >= 0 else 0.0
            read = self.read_in_cells(item.square_px)
            rows = np.stack(
                [
                    weight * signal**2,
                    weight * signal * read,
                    weight * signal * data,
                    weight * read**2,
                    weight * read * data,
                ]
            )
            key = (item.square_px, group)
            self.sums[key] = self.sums[key] + rows if key in self.sums else rows
            self.square += float(np.sum(weight * data**2))
        self.slow = [
            _SlowSums.of(item.square_px, weight, data, self.read_in_cells(item.square_px))
            for item, data, weight in zip(self.series, self.data, weights, strict=True)
        ]

    def reweight(self, spread: Spread, coefficients: FloatArray) -> None:
        """Weights from the fitted power: those from the measured one favour bins that came out low."""
        shapes = self.in_cells(spread)
        expected = []
        for number, (item, group, data) in enumerate(zip(self.series, self.group, self.data, strict=True)):
            power = coefficients[self.read_place] * self.read_in_cells(item.square_px)
            if group >= 0:
                quantum, white = coefficients[group], coefficients[self.groups + group]
                power += item.signal_DN * (quantum * shapes[item.square_px] + white)
            if number in self.drifting:
                # a pair's own coefficients follow its noise, and weights that do so favour what came out low
                known = np.isfinite(self.slow_sd_DN2[number])
                own = coefficients[self.slow_places(self.drifting.index(number))]
                power += slow_in_cells(item.square_px) @ (np.full(2, 0.5 * self.slow_sd_DN2[number]) if known else own)
            expected.append(np.maximum(power, 0.05 * np.minimum(data, float(np.mean(data)))))
        self.weigh(expected)

    def read_in_cells(self, side: int) -> FloatArray:
        """Power of a unit of electronic noise (cell,)."""
        return cells_of(side).means(self.electronic[side])

    def shapes(self, spread: Spread) -> dict[int, FloatArray]:
        """Power of unit quanta on each side's frequencies (K + 1, K + 1), as tapered squares show it."""
        return {side: self.squares[side].smeared(spread.noise_power(side)) for side in self.sides}

    def in_cells(self, spread: Spread) -> dict[int, FloatArray]:
        """The same (cell,)."""
        return {side: cells_of(side).means(shape) for side, shape in self.shapes(spread).items()}

    def normal(
        self,
        shapes: Mapping[int, FloatArray],
        quantum: FloatArray | None = None,
        slopes: Sequence[Mapping[int, FloatArray]] = (),
    ) -> Normal:
        """Normal equations of all coefficients, and of the spread's parameters after them. The white parts have no prior here.

        Args:
            shapes: power of unit quanta (cell,) by side.
            quantum: A (group,), for the spread's parameters.
            slopes: derivatives of the shapes by these.
        """
        theta = self.read_place + 1 + 2 * len(self.drifting)
        matrix = np.zeros((theta + len(slopes), theta + len(slopes)))
        right = np.zeros(len(matrix))
        signal = _Signal(self.groups, theta, shapes, quantum, slopes)
        self._add_beams(matrix, right, signal)
        self._add_slow_changes(matrix, right, signal)
        return Normal(matrix, right, self.square + self._add_read_prior(matrix, right))

    def _add_beams(self, matrix: FloatArray, right: FloatArray, signal: _Signal) -> None:
        """Quanta and white noise of each beam, electronic noise of all series."""
        read = self.read_place
        for (side, group), (squared, single, single_data, plain, plain_data) in self.sums.items():
            matrix[read, read] += plain.sum()
            right[read] += plain_data.sum()
            if group < 0:
                continue
            places, columns = signal.columns(side, group)
            matrix[np.ix_(places, places)] += columns.T @ (columns * squared[:, None])
            cross = columns.T @ single
            matrix[places, read] += cross
            matrix[read, places] += cross
            right[places] += columns.T @ single_data

    def _add_slow_changes(self, matrix: FloatArray, right: FloatArray, signal: _Signal) -> None:
        """E and F of each drifting series, with what is known of their size."""
        read = self.read_place
        for order, number in enumerate(self.drifting):
            item, slow, own = self.series[number], self.slow[number], self.slow_places(order)
            places, columns = signal.columns(item.square_px, self.group[number])
            matrix[np.ix_(own, own)] += slow.squares
            cross = item.signal_DN * (columns.T @ slow.weighted)
            matrix[np.ix_(places, own)] += cross
            matrix[np.ix_(own, places)] += cross.T
            matrix[own, read] += slow.with_read
            matrix[read, own] += slow.with_read
            right[own] += slow.with_data
            matrix[own, own] += 1.0 / self.slow_sd_DN2[number] ** 2

    def _add_read_prior(self, matrix: FloatArray, right: FloatArray) -> float:
        """Without repeated darks electronic noise has the prior of a standard deviation that is uniform up to its bound.

        Returns:
            what the prior adds to the square of the data.
        """
        read = self.read_place
        if self.most_read_DN2 <= 0:
            matrix[read, read] += 1e9 * max(matrix[read, read], 1e-300)  # declared to be 0
        elif math.isfinite(self.most_read_DN2):
            # mean and variance of r^2 for r anywhere between 0 and its largest value
            mean, precision = self.most_read_DN2 / 3.0, 1.0 / (self.most_read_DN2**2 * (1.0 / 5.0 - 1.0 / 9.0))
            matrix[read, read] += precision
            right[read] += precision * mean
            return precision * mean**2
        return 0.0

    def solve(self, spread: Spread, *, also: Sequence[int] = ()) -> tuple[FloatArray, float]:
        """Coefficients and chi-square at this spread, with the white part's prior about the gain that the data have.

        `also`: further coefficients that are not negative.
        """
        normal, least_0 = self.normal(self.in_cells(spread)), (*self.not_negative, *also)
        # the sum is the gain, known even where the two cannot be told apart
        prior = WhitePrior.about(self._gains(normal.solved(least_0)[0]))
        for _ in range(_WHITE_ROUNDS):
            coefficients, chi_square = normal.with_white_prior(prior).solved(least_0)
            there = prior.at(coefficients)
            if np.all(np.abs(there.sd_DN - prior.sd_DN) < SETTLED * prior.sd_DN):
                break
            prior = there
        return coefficients, chi_square + prior.excess(coefficients)

    def white_prior(self, coefficients: FloatArray) -> WhitePrior:
        """Prior of the white parts, as it is at these coefficients."""
        return WhitePrior.about(self._gains(coefficients)).at(coefficients)

    def _gains(self, coefficients: FloatArray) -> FloatArray:
        """A + W (group,), DN."""
        return np.asarray(coefficients[: self.groups] + coefficients[self.groups : 2 * self.groups])
