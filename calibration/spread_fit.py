"""Optical spread, gains and read noise fitted together to the noise power of several series.

P_s(f) = I_s [A_g S(f) + W_g] + r^2 + E_s f_0 / f + F_s (f_0 / f)^2

S: power of unit quanta after the spread (1 at f = 0), so that the gain of a beam g is A_g + W_g; W: white noise that
follows the signal; r^2: electronic noise; E, F: what is left of slow changes between frames, where the data show any or
come from two series. The spread is a Gaussian core, of one width or two, and a tail (`spread_families.py`). Frames that are
small or few hardly show a tail that takes a tenth of the light and a fifth of the gain with it: tails are averaged over by
their evidence, with what is known of panels as prior, and what they leave open is part of the standard deviations. A second
route to the gain, which knows no kernel, tests the first.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError
from ..generator.line.twin import OtherSpread
from ..generator.spread.psf import Spread
from .noise_power import LARGEST_SQUARE_PX, NoisePower, mode_share, spread_of_bins, usable
from .spread_families import LOG_REACH, TAIL, Family, forms_of, prior_of_models, reach_mass, share_density

FloatArray = NDArray[np.float64]
# White noise proportional to signal beside the quanta (secondary quanta): 1/K of the quantum variance for K electrons a
# quantum, K = 100-1000; the width leaves room for other white noise that follows the signal. Screens seen by a lens give a few
# electrons: the prior is Student's t, with the degrees of freedom that Lange, Little and Taylor (J. Am. Stat. Assoc. 84 (1989)
# 881) take.
WHITE_FRACTION_PRIOR = (0.003, 0.03)
_WHITE_DEGREES = 4.0
_WHITE_ROUNDS = 8  # of weights that follow the prior's tail
_LOW_BAND = 0.2  # cycles a pixel, up to which the second route extrapolates to 0
_SILENT = 1e-6  # of the brightest series' power: below that a series is known as well as can be used
_MOST_STEPS = 30
_SETTLED = 0.01  # of chi-square: a tenth of a standard deviation
_MOST_ROUNDS = 4  # of fits with a scatter of series that is known better each time
# Changes of the beam's shape between series have one size, any standard deviation equally likely (Gelman, Bayesian Analysis 1
# (2006) 515); fewer pairs than these leave its mean square unbounded. Sizes are those at which the pair that tells most would
# tell it from none, times these.
_LEAST_CHANGES = 4
_CHANGE_SIZES = np.geomspace(1e-3, 1e6, 181)
_CHANCE = 1e-3  # that series which agree look as if they did not, and a warning stands where nothing is wrong
_REWEIGHTED = 3  # times: the power that the weights come from then no longer moves
_BOUNDS = {
    "sigma_px2": (0.0, (0.1 * LARGEST_SQUARE_PX) ** 2),
    "log_aspect": (-1.6, 1.6),
    "tail_share": (0.0, 1.0),
    "log_tail_px": (-1.6, 1.6),
}
# Of a core wider than this share of the square less than a fifth of the power is left there: it cannot be told from drift.
_WIDEST_CORE = 0.1
# None at all, narrow and wide, and of the tail little, much and nearly all. White noise is as well explained by much of a white part
# behind a wide spread: the prior makes that hundreds of times less likely, but a descent does not cross to the other.
_STARTS = (
    {"sigma_px2": 0.0, "log_aspect": 0.0, "tail_share": 0.0, "log_tail_px": 0.0},
    {"sigma_px2": 0.25, "log_aspect": 0.0, "tail_share": 0.05, "log_tail_px": 0.0},
    {"sigma_px2": 4.0, "log_aspect": 0.0, "tail_share": 0.2, "log_tail_px": 0.0},
    {"sigma_px2": 0.25, "log_aspect": 0.0, "tail_share": 0.8, "log_tail_px": 0.0},
)
_REACH_STEP = math.log(1.5)  # changes the gain by less than a share is known to
_STEPS = (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0)  # standard deviations, at which share and reach are averaged over
_MOST_SD = 0.15  # of the share between such steps, which then reach over most of what it can be
# A spread is as good as another where its likelihood is a tenth of the best at least; and a gain within half a standard
# deviation of the mean adds an eighth to that, while a spread without a tail is quicker wherever it is used.
_AS_LIKELY = 2.0 * math.log(10.0)
_NEAR_THE_MEAN = 0.5
# of a family to be kept: less likely than any law of an effect is beforehand in the diagnosis (0.40 over 28 effects of some laws)
_LEAST_LIKELY = 0.001


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


@dataclass(slots=True)
class _Candidate:
    """One family at its best."""

    form: Family
    theta: FloatArray  # those held fixed have no variance in `covariance`
    spread: Spread
    coefficients: FloatArray
    covariance: FloatArray  # of coefficients and theta
    chi_square: float
    groups: int
    variance_share: float  # of the quanta's variance, in one pixel
    share_slopes: FloatArray  # its derivatives by theta

    @property
    def family(self) -> str:
        return self.form.name

    @property
    def lit(self) -> bool:
        """Whether all beams have quanta."""
        return bool(np.all(self.coefficients[: self.groups] > 0))

    @property
    def gains(self) -> FloatArray:
        """Quantum and white part (group,), DN."""
        quantum, white = np.split(self.coefficients[: 2 * self.groups], 2)
        return np.asarray(quantum + white)

    @property
    def slopes(self) -> FloatArray:
        """Variance of a pixel per signal (group,), DN."""
        quantum, white = np.split(self.coefficients[: 2 * self.groups], 2)
        return np.asarray(quantum * self.variance_share + white)


_OfReaches = list[tuple[float, _Candidate]]  # a family at reaches of the tail, each with its share of all reaches


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Cells of frequencies: bins are single up to six and wider by a fifth from there.

    The power of a spread hardly changes inside a cell, and the fit has a tenth of the numbers.

    Fields: bins (bin,): places of those in use in a flattened power; cell (bin,): which each is in; weight (bin,): its share of
    the cell's modes; share (cell,): of the modes in use.
    """

    bins: NDArray[np.intp]
    cell: NDArray[np.intp]
    weight: FloatArray
    share: FloatArray

    def means(self, power: FloatArray) -> FloatArray:
        """Means over cells (cell,) of a power (K + 1, K + 1)."""
        return np.asarray(np.bincount(self.cell, self.weight * power.ravel()[self.bins]), dtype=np.float64)


@lru_cache(maxsize=16)
def _cells(side: int) -> _Cells:
    """Those of squares of a side, px."""
    order = np.arange(side // 2 + 1)
    wider = 6 + np.floor(np.log(np.maximum(order, 6) / 6.0) / math.log(1.2) + 1e-9)
    line = np.where(order <= 6, order, wider).astype(np.intp)
    bins = np.flatnonzero(usable(side))
    _, cell = np.unique((line[:, None] * (line[-1] + 1) + line[None, :]).ravel()[bins], return_inverse=True)
    modes = mode_share(side).ravel()[bins]
    together = np.bincount(cell, modes)
    return _Cells(bins, cell, modes / together[cell], together / together.sum())


@dataclass(slots=True)
class _Normal:
    """Normal equations of the linear coefficients, and of the spread's parameters where their derivatives are given."""

    matrix: FloatArray
    right: FloatArray
    square: float  # of the whitened data

    def solved(self, least_0: Sequence[int] = ()) -> tuple[FloatArray, float]:
        """Coefficients and chi-square; those of `least_0` are 0 where they would be negative, and what no datum tells stays 0."""
        free = np.ones(len(self.right), dtype=bool)
        while True:
            matrix, right = self.matrix[np.ix_(free, free)], self.right[free]
            scale = np.sqrt(np.clip(np.diag(matrix), 1e-300, None))
            scaled = matrix / np.outer(scale, scale) + 1e-11 * np.eye(len(scale))
            found = np.zeros(len(free))
            found[free] = np.linalg.solve(scaled, right / scale) / scale
            negative = [place for place in least_0 if free[place] and found[place] < 0]
            if not negative:
                return found, self.square - float(right @ found[free])
            # the one that would be most negative in its own standard deviations goes first
            free[min(negative, key=lambda place: found[place] * math.sqrt(self.matrix[place, place]))] = False

    def with_white_prior(self, prior: "_WhitePrior") -> "_Normal":
        """With a prior of the white parts."""
        matrix = self.matrix.copy()
        groups = len(prior.sd_DN)
        for group, sd in enumerate(prior.sd_DN):
            row = np.array([-WHITE_FRACTION_PRIOR[0], 1.0]) / sd
            both = [group, groups + group]
            matrix[np.ix_(both, both)] += np.outer(row, row)
        return replace(self, matrix=matrix)

    def covariance(self) -> FloatArray:
        """Inverse of the matrix."""
        scale = np.sqrt(np.clip(np.diag(self.matrix), 1e-300, None))
        return np.asarray(np.linalg.pinv(self.matrix / np.outer(scale, scale), rcond=1e-10) / np.outer(scale, scale))


@dataclass(frozen=True, slots=True)
class _WhitePrior:
    """Student's t of the white parts: scale_DN (group,), the width about its middle; sd_DN (group,), that of the normal of the same
    slope where they are."""

    scale_DN: FloatArray
    sd_DN: FloatArray

    @classmethod
    def about(cls, gains: FloatArray) -> "_WhitePrior":
        """Of white parts as expected beside these gains (group,)."""
        scale = np.maximum(np.abs(gains), 1e-12) * WHITE_FRACTION_PRIOR[1]
        return cls(scale, scale)

    def at(self, coefficients: FloatArray) -> "_WhitePrior":
        """Where these coefficients are."""
        beyond = self._beyond(coefficients) / math.sqrt(_WHITE_DEGREES + 1.0)
        return replace(self, sd_DN=np.hypot(self.scale_DN, beyond))

    def excess(self, coefficients: FloatArray) -> float:
        """What -2 ln of Student's t has more than the normal's there."""
        squared = self._beyond(coefficients) ** 2
        exact = (_WHITE_DEGREES + 1.0) * np.log1p(squared / ((_WHITE_DEGREES + 1.0) * self.scale_DN**2))
        return float(np.sum(exact - squared / self.sd_DN**2))

    def _beyond(self, coefficients: FloatArray) -> FloatArray:
        quantum, white = np.split(coefficients[: 2 * len(self.scale_DN)], 2)
        return np.asarray(white - WHITE_FRACTION_PRIOR[0] * quantum)


def _most_of_power(measured: FloatArray, modes: FloatArray, cells: int) -> FloatArray:
    """What a power is at most of which this was measured (cell,), with chance for all of so many `cells`.

    Source: Wilson and Hilferty, as in `electronic_shape`, and Donoho and Johnstone.
    """
    farthest = math.sqrt(2.0 * math.log(max(cells, 2)))
    root = 1.0 - 1.0 / (9.0 * modes) - farthest / (3.0 * np.sqrt(modes))
    return np.where(root > 0, measured / np.maximum(root, 1e-3) ** 3, math.inf)


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
        slow = _slow_in_cells(side)
        weighted = slow * weights[:, None]
        return cls(weighted, slow.T @ weighted, weighted.T @ read, weighted.T @ data)


class _Problem:
    """Powers of the series; linear in all but the spread.

    Series of a beam share their shape and differ in signal and weight alone, so that sums over them of weight, weight x signal
    and weight x signal^2, cell by cell, are all that a fit asks of them.
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
        self.forms = forms_of(axes)
        self.prior = prior_of_models(screen=screen)
        self.series = list(series)
        self.group = list(group)
        self.groups = max(group, default=-1) + 1
        self.sides = sorted({item.square_px for item in series})
        # squares of one size show nearly the same of noise in all series: those of the series that tells most stand for them
        self.squares = {item.square_px: item for item in sorted(series, key=lambda item: item.samples)}
        self.data: list[FloatArray] = []
        self.modes: list[FloatArray] = []
        self.independent = 0.0  # bins are correlated: so many of them would be independent
        for item in series:
            layout = _cells(item.square_px)
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
        self.most_read_DN2 = math.inf
        if min(group) >= 0:
            # darks were not repeated, but white noise is at no frequency more than what was measured there
            cells = sum(data.size for data in self.data)
            pairs = zip(self.data, self.modes, strict=True)
            measured = [float(np.min(_most_of_power(data, modes, cells))) for data, modes in pairs]
            self.most_read_DN2 = min([*measured, math.inf if most_read_DN2 is None else most_read_DN2])
        # each series has a level of its own: weights begin from its mean
        self.weigh([np.full(data.size, max(float(np.mean(data)), 1e-12)) for data in self.data])

    def weigh(self, expected: Sequence[FloatArray]) -> None:
        """Take the weights from expected powers (cell,) of each series, and sum over those that share a beam."""
        # a silent dark has no power at all
        floor = _SILENT * max(float(np.mean(data)) for data in self.data)
        pairs = zip(self.modes, expected, strict=True)
        self.weights = [modes / np.maximum(power, floor) ** 2 for modes, power in pairs]
        self.sums: dict[tuple[int, int], FloatArray] = {}
        self.square = 0.0
        for item, group, data, weight in zip(self.series, self.group, self.data, self.weights, strict=True):
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
            for item, data, weight in zip(self.series, self.data, self.weights, strict=True)
        ]

    def read_in_cells(self, side: int) -> FloatArray:
        """Power of a unit of electronic noise (cell,)."""
        return _cells(side).means(self.electronic[side])

    def shapes(self, spread: Spread) -> dict[int, FloatArray]:
        """Power of unit quanta on each side's frequencies (K + 1, K + 1), as tapered squares show it."""
        return {side: self.squares[side].smeared(spread.noise_power(side)) for side in self.sides}

    def in_cells(self, spread: Spread) -> dict[int, FloatArray]:
        """The same (cell,)."""
        return {side: _cells(side).means(shape) for side, shape in self.shapes(spread).items()}

    def normal(
        self,
        shapes: Mapping[int, FloatArray],
        quantum: FloatArray | None = None,
        slopes: Sequence[Mapping[int, FloatArray]] = (),
    ) -> _Normal:
        """Normal equations of A_0.., W_0.., r^2, E and F of each drifting series, and of the spread's parameters.

        The white parts have no prior here.

        Without repeated darks the electronic noise has the prior of a standard deviation that is uniform up to its bound.

        Args:
            shapes: power of unit quanta (cell,) by side.
            quantum: A (group,), for the spread's parameters.
            slopes: derivatives of the shapes by these.
        """
        groups, read = self.groups, 2 * self.groups
        drift = read + 1
        theta = drift + 2 * len(self.drifting)
        matrix = np.zeros((theta + len(slopes), theta + len(slopes)))
        right = np.zeros(len(matrix))

        def basis(side: int, group: int) -> tuple[list[int], FloatArray]:
            """Places and columns (cell, column) of what a beam's signal is multiplied by."""
            shape = shapes[side]
            places = [group, groups + group, *range(theta, theta + len(slopes))]
            moved = [] if quantum is None else [float(quantum[group]) * slope[side] for slope in slopes]
            return places, np.stack([shape, np.ones_like(shape), *moved], axis=1)

        for (side, group), (squared, single, single_data, plain, plain_data) in self.sums.items():
            matrix[read, read] += plain.sum()
            right[read] += plain_data.sum()
            if group < 0:
                continue
            places, columns = basis(side, group)
            matrix[np.ix_(places, places)] += columns.T @ (columns * squared[:, None])
            cross = columns.T @ single
            matrix[places, read] += cross
            matrix[read, places] += cross
            right[places] += columns.T @ single_data
        for order, number in enumerate(self.drifting):
            item, group, slow = self.series[number], self.group[number], self.slow[number]
            own = [drift + 2 * order, drift + 2 * order + 1]
            places, columns = basis(item.square_px, group)
            matrix[np.ix_(own, own)] += slow.squares
            cross = item.signal_DN * (columns.T @ slow.weighted)
            matrix[np.ix_(places, own)] += cross
            matrix[np.ix_(own, places)] += cross.T
            matrix[own, read] += slow.with_read
            matrix[read, own] += slow.with_read
            right[own] += slow.with_data
            matrix[own, own] += 1.0 / self.slow_sd_DN2[number] ** 2
        square = self.square
        if self.most_read_DN2 <= 0:
            matrix[read, read] += 1e9 * max(matrix[read, read], 1e-300)  # declared to be 0
        elif math.isfinite(self.most_read_DN2):
            # mean and variance of r^2 for r anywhere between 0 and its largest value
            mean, precision = self.most_read_DN2 / 3.0, 1.0 / (self.most_read_DN2**2 * (1.0 / 5.0 - 1.0 / 9.0))
            matrix[read, read] += precision
            right[read] += precision * mean
            square += precision * mean**2
        return _Normal(matrix, right, square)

    def solve(self, spread: Spread, *, also: Sequence[int] = ()) -> tuple[FloatArray, float]:
        """Coefficients and chi-square at this spread, with the white part's prior about the gain that the data have.

        `also`: further coefficients that are not negative.
        """
        normal, least_0 = self.normal(self.in_cells(spread)), (*self.not_negative, *also)
        # the sum is the gain, known even where the two cannot be told apart
        prior = _WhitePrior.about(self.gains(normal.solved(least_0)[0]))
        for _ in range(_WHITE_ROUNDS):
            coefficients, chi_square = normal.with_white_prior(prior).solved(least_0)
            there = prior.at(coefficients)
            if np.all(np.abs(there.sd_DN - prior.sd_DN) < _SETTLED * prior.sd_DN):
                break
            prior = there
        return coefficients, chi_square + prior.excess(coefficients)

    def white_prior(self, coefficients: FloatArray) -> "_WhitePrior":
        """Prior of the white parts, as it is at these coefficients."""
        return _WhitePrior.about(self.gains(coefficients)).at(coefficients)

    @property
    def not_negative(self) -> range:
        """Coefficients that add power: white noise that follows the signal, electronic noise.

        Slow changes add power as well, but each series has its own: held at 0 and above, their noise would be taken from the
        quanta.
        """
        return range(self.groups, 2 * self.groups + 1)

    def gains(self, coefficients: FloatArray) -> FloatArray:
        """A + W (group,), DN."""
        return np.asarray(coefficients[: self.groups] + coefficients[self.groups : 2 * self.groups])

    def learn_changes(self, normal: _Normal, inflation: float) -> None:
        """Take from all pairs of series how far the beam's shape changes between two, which none of them exceeds by much.

        A change is relative to the level, so that bright pairs tell what dim ones may hold. Each pair's coefficients E and F are
        Gaussian about 0, with one standard deviation for all, relative to the level: its mean square over its posterior.

        Args:
            normal: normal equations with nothing known of the changes, all that else is fitted included.
            inflation: what chi-square is divided by.
        """
        first = 2 * self.groups + 1
        pairs = [
            (number, [first + 2 * order, first + 2 * order + 1])
            for order, number in enumerate(self.drifting)
            if self.series[number].change_DN2 > 0
        ]
        if len(pairs) < _LEAST_CHANGES:
            return
        own = [place for _, both in pairs for place in both]
        rest = [place for place in range(len(normal.right)) if place not in set(own)]
        unit = np.repeat([self.series[number].change_DN2 for number, _ in pairs], 2)
        others = _Normal(normal.matrix[np.ix_(rest, rest)], normal.right[rest], normal.square)
        through = normal.matrix[np.ix_(own, rest)] @ others.covariance()
        information = normal.matrix[np.ix_(own, own)] - through @ normal.matrix[np.ix_(rest, own)]
        told = (normal.right[own] - through @ others.right) * unit
        known, directions = np.linalg.eigh(information * np.outer(unit, unit) / inflation)
        known, told = np.clip(known, 0.0, None), directions.T @ told / inflation
        size = _CHANGE_SIZES[:, None] / math.sqrt(float(known[-1]))
        raised = 1.0 + known * size**2
        evidence = np.sum(0.5 * (told * size) ** 2 / raised - 0.5 * np.log(raised), axis=1)
        # sizes are equally likely and stand at equal steps of their logarithm
        weight = np.exp(evidence - evidence.max()) * size[:, 0]
        mean_square = float(np.sum(weight * size[:, 0] ** 2) / weight.sum())
        for number, _ in pairs:
            self.slow_sd_DN2[number] = math.sqrt(mean_square) * self.series[number].change_DN2

    def reweight(self, spread: Spread, coefficients: FloatArray) -> None:
        """Weights from the fitted power: those from the measured one favour bins that came out low."""
        shapes = self.in_cells(spread)
        read = 2 * self.groups
        expected = []
        for number, (item, group, data) in enumerate(zip(self.series, self.group, self.data, strict=True)):
            power = coefficients[read] * self.read_in_cells(item.square_px)
            if group >= 0:
                power += item.signal_DN * (
                    coefficients[group] * shapes[item.square_px] + coefficients[self.groups + group]
                )
            if number in self.drifting:
                place = read + 1 + 2 * self.drifting.index(number)
                slow = _slow_in_cells(item.square_px)
                # a pair's own coefficients follow its noise, and weights that do so favour what came out low
                known = np.isfinite(self.slow_sd_DN2[number])
                power += slow @ (
                    np.full(2, 0.5 * self.slow_sd_DN2[number]) if known else coefficients[place : place + 2]
                )
            expected.append(np.maximum(power, 0.05 * np.minimum(data, float(np.mean(data)))))
        self.weigh(expected)


def electronic_shape(darks: Sequence[NoisePower], side: int) -> FloatArray:
    """Power of electronic noise over its mean (K + 1, K + 1), as repeated darks show it; 1 without any.

    White, but for the frequencies whose power no white noise has: interference from power supplies and clocks stands in narrow
    lines. There the darks' own power is taken.

    Source: a bin of M modes is gamma distributed, its cube root nearly Gaussian (Wilson and Hilferty, PNAS 17 (1931) 684);
    of n Gaussian numbers none exceeds sqrt(2 ln n) standard deviations but by chance (Donoho and Johnstone, Biometrika 81
    (1994) 425).
    """
    shape = np.ones((side // 2 + 1, side // 2 + 1))
    used = usable(side)
    medians = [(item, float(np.median(item.power_DN2[used]))) for item in darks]
    alive = [(item, median) for item, median in medians if median > 0]  # darks of zeros have no shape
    if not alive:
        return shape
    modes = np.sum([item.modes[used] for item, _ in alive], axis=0)
    power = np.sum([item.modes[used] * item.power_DN2[used] / median for item, median in alive], axis=0) / modes
    root_variance = 1.0 / (9.0 * modes)
    departure = (np.cbrt(power) - (1.0 - root_variance)) / np.sqrt(root_variance)
    lines = np.abs(departure) > math.sqrt(2.0 * math.log(power.size))
    shape[used] = np.where(lines, power, 1.0)
    return shape / float(np.average(shape[used], weights=mode_share(side)[used]))


@lru_cache(maxsize=16)
def _slow_in_cells(side: int) -> FloatArray:
    """The power of slow changes (cell, change)."""
    return np.stack([_cells(side).means(power) for power in _slow(side)], axis=1)


@lru_cache(maxsize=16)
def _slow(side: int) -> FloatArray:
    """f_0 / f and its square (2, K + 1, K + 1), 1 at the lowest frequency in full use: spectra of most slow processes lie between."""
    order = np.arange(side // 2 + 1)
    square = (order[:, None] ** 2 + order[None, :] ** 2).astype(np.float64)
    square[0, 0] = 1.0
    return np.stack([np.sqrt(8.0 / square), 8.0 / square])


def _starts(form: Family) -> list[FloatArray]:
    """Where a family's descent begins."""
    return [np.array([one[name] for name in form.names]) for one in _STARTS]


def _fitted(problem: _Problem, form: Family, starts: Sequence[FloatArray], *, fixed: Sequence[str] = ()) -> _Candidate:
    """A family at its best, with the parameters `fixed` as they start."""
    names = form.names
    free = [place for place, name in enumerate(names) if name not in fixed]
    bounds = np.array([_BOUNDS[name] for name in names]).T
    if "log_tail_px" in names:
        bounds[:, names.index("log_tail_px")] = LOG_REACH
    bounds[1, names.index("sigma_px2")] = (_WIDEST_CORE * max(problem.sides)) ** 2
    tried = [
        _descended(problem, form, np.clip(one, bounds[0], bounds[1]), bounds, free)
        for one in {tuple(one): one for one in starts}.values()
    ]
    theta, chi_square = min(tried, key=lambda one: one[1])
    spread = form.spread(theta)
    coefficients, _ = problem.solve(spread)
    normal = problem.normal(
        problem.in_cells(spread), coefficients[: problem.groups], _slopes(problem, form, theta, free)
    ).with_white_prior(problem.white_prior(coefficients))
    linear = len(coefficients)
    places = [*range(linear), *(linear + place for place in free)]
    covariance = np.zeros((linear + len(names), linear + len(names)))
    covariance[np.ix_(places, places)] = normal.covariance()
    share_slopes = np.zeros(len(names))
    for place in free:
        (above, more), (below, less) = _moved(form, theta, place)
        share_slopes[place] = (_variance_share(problem, more) - _variance_share(problem, less)) / (above - below)
    share = _variance_share(problem, spread)
    return _Candidate(form, theta, spread, coefficients, covariance, chi_square, problem.groups, share, share_slopes)


def _variance_share(problem: _Problem, spread: Spread) -> float:
    """Share of the quanta's variance that the spread leaves in one pixel: its power's mean over all frequencies."""
    side = problem.sides[-1]
    return float(np.sum(mode_share(side) * spread.noise_power(side)))


def _moved(form: Family, theta: FloatArray, place: int) -> list[tuple[float, Spread]]:
    """A parameter of the spread a little more and a little less, with the spreads that it makes."""
    name = form.names[place]
    ends = []
    for step in (0.005, -0.005):
        moved = theta.copy()
        moved[place] = np.clip(theta[place] + step, *_BOUNDS[name])
        ends.append((float(moved[place]), form.spread(moved)))
    return ends


def _with_share(problem: _Problem, best: _Candidate, share_at: int, share: float) -> _Candidate:
    """The spread with another share of light in the tail and a core that follows, as its fit says it does."""
    linear = len(best.coefficients)
    place = linear + share_at
    follows = best.covariance[place] / best.covariance[place, place]
    theta = best.theta + follows[linear:] * (share - best.theta[share_at])
    theta = np.array([np.clip(value, *_BOUNDS[name]) for name, value in zip(best.form.names, theta, strict=True)])
    spread = best.form.spread(theta)
    coefficients, chi_square = problem.solve(spread)
    return replace(
        best,
        theta=theta,
        spread=spread,
        coefficients=coefficients,
        covariance=best.covariance - np.outer(follows, best.covariance[place]),
        chi_square=chi_square,
        variance_share=_variance_share(problem, spread),
    )


def _slopes(problem: _Problem, form: Family, theta: FloatArray, free: Sequence[int]) -> list[dict[int, FloatArray]]:
    """Derivatives of the shapes (cell,), by side, by the parameters of the spread at the places `free`."""
    found = []
    for place in free:
        (above, more), (below, less) = _moved(form, theta, place)
        shapes = problem.in_cells(more), problem.in_cells(less)
        found.append({side: (shapes[0][side] - shapes[1][side]) / (above - below) for side in problem.sides})
    return found


def _descended(
    problem: _Problem, form: Family, theta: FloatArray, bounds: FloatArray, free: Sequence[int]
) -> tuple[FloatArray, float]:
    """Parameters of the spread at the least chi-square near a start, and that chi-square (Gauss and Newton's steps, halved
    until they help)."""
    coefficients, chi_square = problem.solve(form.spread(theta))
    for _ in range(_MOST_STEPS):
        normal = problem.normal(
            problem.in_cells(form.spread(theta)),
            coefficients[: problem.groups],
            _slopes(problem, form, theta, free),
        ).with_white_prior(problem.white_prior(coefficients))
        step = np.zeros(len(theta))
        step[list(free)] = normal.solved(problem.not_negative)[0][-len(free) :]
        for share in (1.0, 0.5, 0.25, 0.1, 0.03):
            moved = np.clip(theta + share * step, bounds[0], bounds[1])
            there, value = problem.solve(form.spread(moved))
            if value < chi_square:
                break
        else:
            return theta, chi_square
        gained = chi_square - value
        theta, coefficients, chi_square = moved, there, value
        if gained < _SETTLED:
            break
    return theta, chi_square


def _cores(problem: _Problem) -> list[_Candidate]:
    """Families without a tail at their best; the weights are those of the best spread."""
    simplest, general = problem.forms.cores[0], problem.forms.general["aperture"]
    found: dict[str, _Candidate] = {}
    for _ in range(_REWEIGHTED):
        for form in (simplest, general):
            starts = [found[form.name].theta] if form.name in found else _starts(form)
            found[form.name] = _fitted(problem, form, starts)
        best = min(found.values(), key=lambda item: _criterion(problem, item))
        problem.reweight(best.spread, best.coefficients)
        _learn_changes(problem, found[general.name])
    return [_fitted(problem, form, _starts(form)) for form in problem.forms.cores]


def _learn_changes(problem: _Problem, item: _Candidate) -> None:
    """What all pairs of series tell of slow changes, whatever the spread is near this one."""
    problem.slow_sd_DN2[:] = math.inf
    coefficients, chi_square = problem.solve(item.spread)
    normal = problem.normal(
        problem.in_cells(item.spread),
        coefficients[: problem.groups],
        _slopes(problem, item.form, item.theta, range(len(item.theta))),
    ).with_white_prior(problem.white_prior(coefficients))
    problem.learn_changes(normal, max(1.0, chi_square / problem.independent))


def _criterion(problem: _Problem, candidate: _Candidate) -> float:
    """Schwarz's criterion (Ann. Stat. 6 (1978) 461): chi-square and ln n for each parameter of the core.

    A tail is weighed by its prior instead: its share and reach are averaged over.
    """
    core = len(set(candidate.form.names) - set(TAIL))
    return candidate.chi_square + core * math.log(max(problem.independent, 2.0))


def _with_tails(
    problem: _Problem, core: _Candidate, known: Mapping[Family, _OfReaches]
) -> Iterator[tuple[float, _Candidate]]:
    """Spreads with this core and tails of all laws, reaches and shares, each with its prior probability among tails.

    known: families whose reaches have been tried.
    """
    for form in problem.forms.families:
        if form.model != core.spread.model or set(form.names) != {*core.form.names, *TAIL}:
            continue
        share_at = form.names.index("tail_share")
        for of_reach, best in known.get(form) or _of_reaches(problem, form):
            variance = float(best.covariance[len(best.coefficients) + share_at, len(best.coefficients) + share_at])
            if variance <= 0.0:
                yield form.of_tails * of_reach, best
                continue
            sd = min(math.sqrt(variance), _MOST_SD)
            for share, width in _steps(float(best.theta[share_at]), sd, (0.0, 1.0)):
                density = form.of_tails * of_reach * share_density(share)
                yield width * density, _with_share(problem, best, share_at, share)


def _of_reaches(problem: _Problem, form: Family) -> _OfReaches:
    """The best spread of a family at each of some reaches of the tail, with its share of all reaches."""
    place = form.names.index("log_tail_px")
    count = 1 + math.ceil((LOG_REACH[1] - LOG_REACH[0]) / _REACH_STEP)
    grid = np.linspace(*LOG_REACH, count)
    step = float(grid[1] - grid[0])
    found: _OfReaches = []
    starts = _starts(form)
    for reach in grid:
        for start in starts:
            start[place] = reach
        item = _fitted(problem, form, starts, fixed=("log_tail_px",))
        found.append((reach_mass(float(reach), step if grid[0] < reach < grid[-1] else 0.5 * step), item))
        starts = [item.theta.copy()]
    best = min((item for _, item in found), key=lambda item: item.chi_square)
    free = _fitted(problem, form, [best.theta])
    sd = math.sqrt(max(float(free.covariance[len(free.coefficients) + place, len(free.coefficients) + place]), 0.0))
    if not 0.0 < sd < 0.5 * step:
        return found
    sharp = []
    for reach, width in _steps(float(free.theta[place]), sd, LOG_REACH):
        theta = free.theta.copy()
        theta[place] = reach
        sharp.append((reach_mass(reach, width), _fitted(problem, form, [theta], fixed=("log_tail_px",))))
    return sharp


def _steps(middle: float, sd: float, bounds: tuple[float, float]) -> list[tuple[float, float]]:
    """Values about a middle, inside the bounds, and the width that each stands for."""
    values = np.unique(np.clip(middle + sd * np.array(_STEPS), *bounds))
    halves = 0.5 * np.diff(values, prepend=values[0], append=values[-1])
    return [(float(value), float(width)) for value, width in zip(values, halves[:-1] + halves[1:], strict=True)]


def _members(problem: _Problem) -> list[tuple[float, _Candidate]]:
    """Spreads that the data leave open, with the logarithm of the weight of each before its chi-square counts.

    Tails are averaged over for the way that quanta meet pixels that is likelier with the best spread of any form.
    """
    cores = _cores(problem)
    general = {form: _of_reaches(problem, form) for form in problem.forms.general.values()}
    best, least = {}, {}
    for model in problem.prior:
        own = [item for item in cores if item.spread.model == model]
        best[model] = min([item for item in own if item.lit] or own, key=partial(_criterion, problem))
        least[model] = min(
            item.chi_square for item in (*own, *(item for _, item in general[problem.forms.general[model]]))
        )
    likeliest = max(problem.prior, key=lambda model: math.log(problem.prior[model][0]) - 0.5 * least[model])
    found = []
    for model, (prior, no_tail) in problem.prior.items():
        found.append((prior * no_tail, best[model]))
        if model == likeliest:
            found += [
                (prior * (1.0 - no_tail) * mass, item) for mass, item in _with_tails(problem, best[model], general)
            ]
    return [
        (math.log(mass) - 0.5 * (_criterion(problem, item) - item.chi_square), item)
        for mass, item in [one for one in found if one[0] > 0 and one[1].lit] or [(1.0, best[likeliest])]
    ]


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

    Source: scatter of series: Birge, Phys. Rev. 40 (1932) 207; Paule and Mandel, J. Res. NBS 87 (1982) 377; model averaging:
    Buckland, Burnham, Augustin, Biometrics 53 (1997) 603; test of two routes: Hausman, Econometrica 46 (1978) 1251. Checked
    against: noise of known spread, tests/test_calibration_spread_fit.py.
    """
    if not any(index >= 0 for index in group):
        raise FitError("the noise fit needs at least one flat series with two or more frames")
    fit_of = partial(_fit_of, group=group, most_read_DN2=most_read_DN2, screen=screen, axes=axes)
    fit = fit_of(series)
    degrees = len(series) - len(fit.gain_DN) - 1
    scatter = 0.0
    for _ in range(_MOST_ROUNDS):
        last, scatter = scatter, _scatter_of_series(fit.series_ratio, degrees)
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
    problem = _Problem(series, group, most_read_DN2, screen=screen, axes=axes)
    members = _members(problem)
    drifting = _drifting(problem, _likeliest(members))
    if drifting != problem.drifting:
        problem.drifting = drifting
        members = _members(problem)
    groups = problem.groups
    least = _likeliest(members).chi_square
    inflation = max(1.0, least / problem.independent)
    logs = np.array([log_mass - 0.5 * (item.chi_square - least) / inflation for log_mass, item in members])
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    candidates = [item for _, item in members]
    chosen = _representative(candidates, weights, (least, inflation))
    if not np.all(np.isfinite(chosen.coefficients)):
        raise FitError("the noise power has no fit; look for saturated, constant or processed frames")
    expected = _expected(problem, chosen)
    ratios = _of_series(problem, chosen, expected)
    scatter = max(inflation, _scatter(ratios, len(ratios) - groups - 1))
    gain, slope = chosen.gains, chosen.slopes
    gain_variance, slope_variance = np.zeros(groups), np.zeros(groups)
    spread_variance = dict.fromkeys(_spread_variances(chosen, scatter), 0.0)
    evidence: dict[str, float] = {}
    logs_covariance = np.zeros((2 * groups, 2 * groups))  # of the logarithms of gains and slopes
    for share, item in zip(weights, candidates, strict=True):
        moved_logs = np.concatenate([_log_ratio(item.gains, gain), _log_ratio(item.slopes, slope)])
        logs_covariance += share * (_log_covariance(item, groups, scatter) + np.outer(moved_logs, moved_logs))
        evidence[item.family] = evidence.get(item.family, 0.0) + float(share)
        own_gain, own_slope = _variances(item, groups, scatter)
        # scales are averaged by their logarithms
        gain_variance += share * (own_gain + (gain * _log_ratio(item.gains, gain)) ** 2)
        slope_variance += share * (own_slope + (slope * _log_ratio(item.slopes, slope)) ** 2)
        for name, own in _spread_variances(item, scatter).items():
            moved = getattr(item.spread, name) - getattr(chosen.spread, name)
            reach_of_none = name == "tail_px" and min(item.spread.tail_share, chosen.spread.tail_share) == 0
            spread_variance[name] += float(share) * (own + (0.0 if reach_of_none else moved**2))
    gain_moved, slope_moved, read_moved = _slow_as_power(problem, chosen)
    gain_variance += gain_moved**2
    slope_variance += slope_moved**2
    other = _other_route(problem, chosen, expected)
    route = max(0.0, (other[0] - 1.0) ** 2 - other[1] ** 2)
    gain_variance = gain_variance + route * gain**2
    both = np.concatenate([gain_moved / np.maximum(gain, 1e-300), slope_moved / np.maximum(slope, 1e-300)])
    logs_covariance += np.outer(both, both)
    logs_covariance[:groups, :groups] += route
    quantum, white = chosen.coefficients[:groups], chosen.coefficients[groups : 2 * groups]
    low, whole = _of_beams(problem, chosen, expected)
    # slopes follow their own beam, as the noise of its frames does; gains go with one spread, which images have
    gain_own, gain_open = _own_to_beams(low, groups - 1)
    gain_variance += gain**2 * (gain_own**2 + gain_open**2)
    slope_own, slope_open = _own_to_beams(whole, groups)
    slope_variance = slope_variance * (1.0 + slope_own) ** 2 + (slope * slope_open) ** 2
    slope = slope * (1.0 + slope_own)
    rows, columns, lines_sd = _line_variances(series, group)
    read = float(chosen.coefficients[2 * groups])
    excess = np.zeros(len(series))
    excess[list(problem.drifting)] = chosen.coefficients[2 * groups + 1 :].reshape(-1, 2).sum(axis=1)
    return SpreadFit(
        spread=chosen.spread,
        family=chosen.family,
        others=_other_families(candidates, weights, chosen.family),
        spread_sd={name: math.sqrt(value) for name, value in spread_variance.items()},
        gain_DN=gain,
        gain_sd_DN=np.sqrt(gain_variance),
        slope_DN=slope,
        slope_sd_DN=np.sqrt(slope_variance),
        white_fraction=white / np.where(quantum > 0, quantum, np.nan),
        read_variance_DN2=read + rows + columns,
        read_sd_DN2=math.hypot(
            math.sqrt(max(scatter * float(chosen.covariance[2 * groups, 2 * groups]), 0.0)), lines_sd, read_moved
        ),
        most_read_DN2=problem.most_read_DN2,
        row_variance_DN2=max(rows, 0.0),
        column_variance_DN2=max(columns, 0.0),
        chi_square=chosen.chi_square,
        degrees=problem.independent,
        excess_DN2=excess,
        # a beam that was not measured may spread otherwise as the measured ones do
        shared_gain_sd=math.hypot(
            _sd_of_gain_over_slope(logs_covariance), math.sqrt(float(np.mean(gain_own**2 + gain_open**2)))
        ),
        series_ratio=tuple(ratios),
        other_route=other,
        criteria={
            family: -2.0 * math.log(max(value, 1e-300) / max(evidence.values())) for family, value in evidence.items()
        },
        expected_DN2=expected,
        quanta_DN2=_quanta(problem, chosen),
        slow_DN2=_slow_changes(problem, chosen),
    )


def _of_series(problem: _Problem, item: _Candidate, expected: Sequence[FloatArray]) -> list[tuple[float, float]]:
    """Whole power of each series over what is fitted, and the standard deviation of that; nan where nothing is fitted."""
    found = []
    for one, power, slow in zip(problem.series, expected, _slow_changes(problem, item), strict=True):
        fitted = np.where(one.used, power + slow, 0.0)
        lit = fitted > 0
        if lit.any():
            ratio = float(np.average(one.power_DN2[lit] / fitted[lit], weights=one.modes[lit]))
            found.append((ratio, 1.0 / math.sqrt(float(one.modes[lit].sum()))))
        else:
            found.append((math.nan, math.nan))
    return found


def _of_beams(
    problem: _Problem, item: _Candidate, expected: Sequence[FloatArray]
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Noise of each beam's quanta over the fitted, with its standard deviation: at low frequencies, less that of all, and whole.

    Light made at other depths spreads otherwise (Lubberts, J. Opt. Soc. Am. 58 (1968) 1475), and beams are stopped at
    other depths. The whole is a pixel's variance, which asks no kernel at all; nan where a beam has no such frequency.
    """
    read = float(item.coefficients[2 * problem.groups])
    sums = np.zeros((2, 3, problem.groups))  # of modes: measured less expected, expected of the quanta, variance
    every = zip(problem.series, problem.group, expected, _slow_changes(problem, item), strict=True)
    for one, group, power, slow in every:
        if group < 0:
            continue
        frequency = np.arange(power.shape[0]) / one.square_px
        inside = frequency[:, None] ** 2 + frequency[None, :] ** 2 < _LOW_BAND**2
        for row, band in enumerate((one.used & inside, one.used)):
            modes = one.modes[band]
            # series of one beam count by how well they know it
            precision = 1.0 / max(float(np.mean(power[band])), 1e-300) if band.any() else 0.0
            sums[row, 0, group] += precision * float(modes @ (one.power_DN2 - power - slow)[band])
            sums[row, 1, group] += precision * float(modes @ (power - read * problem.electronic[one.square_px])[band])
            sums[row, 2, group] += precision**2 * float(modes @ (power + slow)[band] ** 2)
    found = []
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, sd = 1.0 + sums[:, 0] / sums[:, 1], np.sqrt(sums[:, 2]) / sums[:, 1]
        weight = np.where(np.isfinite(sd[0]), sd[0], np.inf) ** -2.0
        ratio[0] -= float(weight @ np.nan_to_num(ratio[0] - 1.0)) / max(float(weight.sum()), 1e-300)
    for row in range(2):
        found.append([(float(one), float(own)) for one, own in zip(ratio[row], sd[row], strict=True)])
    return found[0], found[1]


def _own_to_beams(ratios: Sequence[tuple[float, float]], degrees: int) -> tuple[FloatArray, FloatArray]:
    """What each beam's noise departs from the fit by (group,), relative, and what is open of that.

    Departures are drawn from one normal distribution, whose variance is what chi-square wants (`_wanted_by`).
    """
    own = _wanted_by(ratios, degrees)
    known = np.array(ratios).reshape(-1, 2)
    sampling = np.where(np.isfinite(known[:, 1]), known[:, 1] ** 2, math.inf)
    share = own / (own + sampling)
    return np.nan_to_num(share * np.nan_to_num(known[:, 0] - 1.0)), np.sqrt(np.nan_to_num(share * sampling))


def _scatter(ratios: Sequence[tuple[float, float]], degrees: int) -> float:
    """Chi-square a degree of freedom of the series' whole power; 1 where no degree is left.

    Where frames of a series are averages, or its level bends, its frequencies agree with each other: only the series differ.
    """
    known = [((ratio - 1.0) / sd) ** 2 for ratio, sd in ratios if math.isfinite(ratio)]
    return sum(known) / degrees if degrees > 0 else 1.0


def series_differ(ratios: Sequence[tuple[float, float]], degrees: int) -> bool:
    """Whether the noise of series departs from what is fitted by more than chance; arguments as of `_scatter_of_series`."""
    from scipy.special import chdtri

    return degrees > 0 and _scatter(ratios, degrees) * degrees >= float(chdtri(degrees, _CHANCE))


def _scatter_of_series(ratios: Sequence[tuple[float, float]], degrees: int) -> float:
    """Relative variance that series have besides their sampling, which makes their chi-square what it should be; 0 where that
    is within chance.

    Args:
        ratios: noise of each series over the fitted, and its standard deviation by sampling.
        degrees: series less what was fitted to them.
    """
    return _wanted_by(ratios, degrees) if series_differ(ratios, degrees) else 0.0


def _wanted_by(ratios: Sequence[tuple[float, float]], degrees: int) -> float:
    """Relative variance besides sampling that makes chi-square what it should be, 0 where it is no larger; arguments as above."""
    from scipy.optimize import brentq

    if degrees < 1 or _scatter(ratios, degrees) <= 1.0:
        return 0.0
    known = np.array([one for one in ratios if math.isfinite(one[0])]).reshape(-1, 2)
    square, sampling = (known[:, 0] - 1.0) ** 2, known[:, 1] ** 2
    return float(brentq(lambda more: float(np.sum(square / (sampling + more))) - degrees, 0.0, float(square.sum())))


def _likeliest(members: Sequence[tuple[float, _Candidate]]) -> _Candidate:
    """The spread of the least chi-square."""
    return min((item for _, item in members), key=lambda item: item.chi_square)


def _representative(
    candidates: Sequence[_Candidate], weights: FloatArray, likelihood: tuple[float, float]
) -> _Candidate:
    """The spread with the fewest parameters of those that are likely and whose gains lie near the mean of all.

    Args:
        candidates: spreads.
        weights: of each; they add up to 1.
        likelihood: least chi-square, and what a chi-square is divided by.
    """
    least, inflation = likelihood
    scale = np.array([float(np.mean(_log_ratio(item.gains, candidates[0].gains))) for item in candidates])
    mean = float(weights @ scale)
    sd = math.sqrt(float(weights @ (scale - mean) ** 2))
    likely = [place for place, item in enumerate(candidates) if (item.chi_square - least) / inflation <= _AS_LIKELY]
    near = [place for place in likely if abs(scale[place] - mean) <= _NEAR_THE_MEAN * sd]
    if not near:
        near = [min(likely, key=lambda place: abs(scale[place] - mean))]
    return candidates[min(near, key=lambda place: (len(candidates[place].form.names), -weights[place]))]


def _other_families(candidates: Sequence[_Candidate], weights: FloatArray, chosen: str) -> tuple[OtherSpread, ...]:
    """Families beside the chosen one that are likely enough to matter, each with the mean of its parameters."""
    found = []
    for family in dict.fromkeys(item.family for item in candidates):
        own = [
            (float(share), item.spread)
            for share, item in zip(weights, candidates, strict=True)
            if item.family == family
        ]
        together = sum(share for share, _ in own)
        if family != chosen and together >= _LEAST_LIKELY:
            means = {
                name: sum(share * getattr(spread, name) for share, spread in own) / together
                for name in ("sigma_px", "aspect", "tail_share", "tail_px")
            }
            found.append(OtherSpread(family=family, probability=together, value=replace(own[0][1], **means)))
    return tuple(sorted(found, key=lambda item: -item.probability))


def _log_ratio(first: FloatArray, second: FloatArray) -> FloatArray:
    """Logarithm of the ratio of two positive scales; 0 where one of them is none."""
    both = (first > 0) & (second > 0)
    return np.asarray(np.log(np.where(both, first, 1.0) / np.where(both, second, 1.0)))


def _drifting(problem: _Problem, candidate: _Candidate) -> tuple[int, ...]:
    """Series with slow changes: differences between series always, others where these stand out (Schwarz's criterion)."""
    lit = tuple(number for number, group in enumerate(problem.group) if group >= 0)
    always = problem.drifting
    problem.drifting = lit
    coefficients, _ = problem.solve(candidate.spread)
    normal = problem.normal(problem.in_cells(candidate.spread)).with_white_prior(problem.white_prior(coefficients))
    covariance = normal.covariance()
    problem.drifting = always
    first = 2 * problem.groups + 1
    needed = math.log(max(problem.independent, 2.0))
    found = []
    for order, number in enumerate(lit):
        place = slice(first + 2 * order, first + 2 * order + 2)
        own = coefficients[place]
        gained = float(own @ np.linalg.pinv(covariance[place, place]) @ own)
        if number in always or (own.sum() > 0 and gained > 2.0 * needed):
            found.append(number)
    return tuple(found)


def _variances(item: _Candidate, groups: int, inflation: float) -> tuple[FloatArray, FloatArray]:
    """Sampling variances of gains and slopes (group,), DN^2."""
    size = len(item.covariance)
    linear = len(item.coefficients)
    gains, pixel = [], []
    for g in range(groups):
        direction = np.zeros(size)
        direction[g] = direction[groups + g] = 1.0
        gains.append(max(float(direction @ item.covariance @ direction), 0.0))
        direction[g] = item.variance_share
        direction[linear:] = item.coefficients[g] * item.share_slopes
        pixel.append(max(float(direction @ item.covariance @ direction), 0.0))
    return inflation * np.array(gains), inflation * np.array(pixel)


def _log_covariance(item: _Candidate, groups: int, inflation: float) -> FloatArray:
    """Sampling covariance of the logarithms of gains and slopes (2 x group, 2 x group)."""
    size, linear = len(item.covariance), len(item.coefficients)
    rows = np.zeros((2 * groups, size))
    for g in range(groups):
        rows[g, g] = rows[g, groups + g] = 1.0 / max(item.gains[g], 1e-300)
        per_slope = 1.0 / max(item.slopes[g], 1e-300)
        rows[groups + g, g], rows[groups + g, groups + g] = item.variance_share * per_slope, per_slope
        rows[groups + g, linear:] = item.coefficients[g] * item.share_slopes * per_slope
    return np.asarray(inflation * rows @ item.covariance @ rows.T)


def _sd_of_gain_over_slope(covariance: FloatArray) -> float:
    """Standard deviation of the logarithm of gain over slope, the same for all beams, from the covariance of both logarithms."""
    groups = len(covariance) // 2
    ratio = np.hstack([np.eye(groups), -np.eye(groups)])
    return math.sqrt(max(float(np.mean(np.diag(ratio @ covariance @ ratio.T))), 0.0))


def _spread_variances(item: _Candidate, inflation: float) -> dict[str, float]:
    """Sampling variances of the spread's parameters, at most those of any value between their bounds; those that the family does
    not have are 0."""
    linear = len(item.coefficients)
    own = {
        name: min(
            max(inflation * float(item.covariance[linear + i, linear + i]), 0.0),
            (_BOUNDS[name][1] - _BOUNDS[name][0]) ** 2 / 12.0,
        )
        for i, name in enumerate(item.form.names)
    }
    # the width at one standard deviation of its square: right also where the width is near 0
    sigma_px = item.spread.sigma_px
    return {
        "sigma_px": (math.sqrt(sigma_px**2 + math.sqrt(own["sigma_px2"])) - sigma_px) ** 2,
        "aspect": own.get("log_aspect", 0.0) * item.spread.aspect**2,
        "tail_share": own.get("tail_share", 0.0),
        "tail_px": own.get("log_tail_px", 0.0) * item.spread.tail_px**2,
    }


def _slow_as_power(problem: _Problem, item: _Candidate) -> tuple[FloatArray, FloatArray, float]:
    """What gains and slopes (group,) and read variance change by, DN and DN^2, where slow changes may only add power.

    Left free, their fitted power may fall below 0 at high frequencies, which white noise then makes good; held at 0, their
    own noise is taken from the quanta. What the choice changes is not known.
    """
    first = 2 * problem.groups + 1
    held, _ = problem.solve(item.spread, also=range(first, first + 2 * len(problem.drifting)))
    quantum, white = np.split(held[: 2 * problem.groups], 2)
    slopes = quantum * item.variance_share + white
    moved_read = float(held[first - 1] - item.coefficients[first - 1])
    return np.asarray(quantum + white - item.gains), np.asarray(slopes - item.slopes), moved_read


def _expected(problem: _Problem, item: _Candidate) -> tuple[FloatArray, ...]:
    """Fitted power (K + 1, K + 1) of each series over all frequencies, slow changes left out."""
    shapes = problem.shapes(item.spread)
    groups = problem.groups
    result = []
    for one, group in zip(problem.series, problem.group, strict=True):
        power = float(item.coefficients[2 * groups]) * problem.electronic[one.square_px]
        if group >= 0:
            quantum, white = item.coefficients[group], item.coefficients[groups + group]
            power = power + one.signal_DN * (quantum * shapes[one.square_px] + white)
        result.append(power)
    return tuple(result)


def _quanta(problem: _Problem, item: _Candidate) -> tuple[FloatArray, ...]:
    """Fitted power (K + 1, K + 1) of what follows the signal in each series, as no square has smeared it; 0 for darks."""
    powers = {side: item.spread.noise_power(side) for side in problem.sides}
    return tuple(
        one.signal_DN * (item.coefficients[group] * powers[one.square_px] + item.coefficients[problem.groups + group])
        if group >= 0
        else np.zeros(one.power_DN2.shape)
        for one, group in zip(problem.series, problem.group, strict=True)
    )


def _slow_changes(problem: _Problem, item: _Candidate) -> tuple[FloatArray, ...]:
    """Fitted power (K + 1, K + 1) of slow changes in each series."""
    result = [np.zeros(one.power_DN2.shape) for one in problem.series]
    for order, number in enumerate(problem.drifting):
        place = 2 * problem.groups + 1 + 2 * order
        slow = _slow(problem.series[number].square_px)
        result[number] = np.tensordot(item.coefficients[place : place + 2], slow, axes=1)
    return tuple(result)


def _other_route(problem: _Problem, item: _Candidate, expected: Sequence[FloatArray]) -> tuple[float, float]:
    """Gain by extrapolation of the low-frequency power to 0, over the fit's, and its standard deviation.

    The ratio of measured to fitted power of the quanta, up to 0.2 cycles a pixel, as 1 + a + b f_row^2 + c f_column^2: it
    asks no kernel family, only that the ratio is smooth. Squares of 16 px have too few frequencies there: their mean is 1 + a.
    """
    rows, weights, values = [], [], []
    read = float(item.coefficients[2 * problem.groups])
    every = zip(problem.series, problem.group, expected, _slow_changes(problem, item), strict=True)
    for one, group, power, slow in every:
        if group < 0:
            continue
        frequency = np.arange(power.shape[0]) / one.square_px
        square = frequency[:, None] ** 2 + frequency[None, :] ** 2
        electronic = read * problem.electronic[one.square_px]
        band = one.used & (square < _LOW_BAND**2) & (power > electronic)
        if not band.any():
            continue
        quanta = (power - electronic)[band]
        values.append((one.power_DN2 - power - slow)[band] / quanta)
        weights.append(one.modes[band] * (quanta / (power + slow)[band]) ** 2)
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
