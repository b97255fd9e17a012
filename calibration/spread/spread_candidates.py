"""One family of spreads at its best: descent to the least chi-square, and what is open there."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...generator.spread.psf import Spread
from .noise_power import LARGEST_SQUARE_PX, mode_share
from .spread_families import LOG_REACH, TAIL, Family
from .spread_normal import Normal
from .spread_problem import SETTLED, SpreadProblem

FloatArray = NDArray[np.float64]
_MOST_STEPS = 30
# Of a core wider than this share of the square less than a fifth of the power is left there: it cannot be told from drift.
_WIDEST_CORE = 0.1
_BOUNDS = {
    "sigma_px2": (0.0, (_WIDEST_CORE * LARGEST_SQUARE_PX) ** 2),
    "log_aspect": (-1.6, 1.6),
    "tail_share": (0.0, 1.0),
    "log_tail_px": (-1.6, 1.6),
}
# None at all, narrow and wide, and of the tail little, much and nearly all. White noise is as well explained by much of a white part
# behind a wide spread: the prior makes that hundreds of times less likely, but a descent does not cross to the other.
_STARTS = (
    {"sigma_px2": 0.0, "log_aspect": 0.0, "tail_share": 0.0, "log_tail_px": 0.0},
    {"sigma_px2": 0.25, "log_aspect": 0.0, "tail_share": 0.05, "log_tail_px": 0.0},
    {"sigma_px2": 4.0, "log_aspect": 0.0, "tail_share": 0.2, "log_tail_px": 0.0},
    {"sigma_px2": 0.25, "log_aspect": 0.0, "tail_share": 0.8, "log_tail_px": 0.0},
)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A spread with what it makes of the series.

    Fields: form; theta (name,): its parameters; spread; coefficients, as in `SpreadProblem`; covariance of coefficients and theta,
    without chi-square's inflation, 0 for parameters held fixed; chi_square; groups: number of beams; variance_share: of the
    quanta's variance, in one pixel; share_slopes (name,): its derivatives by theta.
    """

    form: Family
    theta: FloatArray
    spread: Spread
    coefficients: FloatArray
    covariance: FloatArray
    chi_square: float
    groups: int
    variance_share: float
    share_slopes: FloatArray

    @property
    def family(self) -> str:
        return self.form.name

    @property
    def quantum(self) -> FloatArray:
        """A (group,), DN."""
        return self.coefficients[: self.groups]

    @property
    def white(self) -> FloatArray:
        """W (group,), DN."""
        return self.coefficients[self.groups : 2 * self.groups]

    @property
    def read_DN2(self) -> float:
        """Variance of electronic noise, rows' and columns' offsets left out."""
        return float(self.coefficients[2 * self.groups])

    @property
    def slow_DN2(self) -> FloatArray:
        """E and F (drifting series, 2)."""
        return self.coefficients[2 * self.groups + 1 :].reshape(-1, 2)

    @property
    def lit(self) -> bool:
        """Whether all beams have quanta."""
        return bool(np.all(self.quantum > 0))

    @property
    def gains(self) -> FloatArray:
        """Quantum and white part (group,), DN."""
        return np.asarray(self.quantum + self.white)

    @property
    def slopes(self) -> FloatArray:
        """Variance of a pixel per signal (group,), DN."""
        return np.asarray(self.quantum * self.variance_share + self.white)

    def sampling_variances(self, inflation: float) -> tuple[FloatArray, FloatArray]:
        """Sampling variances of gains and slopes (group,), DN^2."""
        size, linear = len(self.covariance), len(self.coefficients)
        gains, pixel = [], []
        for g in range(self.groups):
            direction = np.zeros(size)
            direction[g] = direction[self.groups + g] = 1.0
            gains.append(max(float(direction @ self.covariance @ direction), 0.0))
            direction[g] = self.variance_share
            direction[linear:] = self.coefficients[g] * self.share_slopes
            pixel.append(max(float(direction @ self.covariance @ direction), 0.0))
        return inflation * np.array(gains), inflation * np.array(pixel)

    def log_covariance(self, inflation: float) -> FloatArray:
        """Sampling covariance of the logarithms of gains and slopes (2 x group, 2 x group)."""
        size, linear, groups = len(self.covariance), len(self.coefficients), self.groups
        gains, slopes = self.gains, self.slopes
        rows = np.zeros((2 * groups, size))
        for g in range(groups):
            rows[g, g] = rows[g, groups + g] = 1.0 / max(gains[g], 1e-300)
            per_slope = 1.0 / max(slopes[g], 1e-300)
            rows[groups + g, g], rows[groups + g, groups + g] = self.variance_share * per_slope, per_slope
            rows[groups + g, linear:] = self.coefficients[g] * self.share_slopes * per_slope
        return np.asarray(inflation * rows @ self.covariance @ rows.T)

    def spread_variances(self, inflation: float) -> dict[str, float]:
        """Sampling variances of the spread's parameters, at most those of any value between their bounds; those that the family
        does not have are 0."""
        linear = len(self.coefficients)
        own = {
            name: min(
                max(inflation * float(self.covariance[linear + i, linear + i]), 0.0),
                (_BOUNDS[name][1] - _BOUNDS[name][0]) ** 2 / 12.0,
            )
            for i, name in enumerate(self.form.names)
        }
        # the width at one standard deviation of its square: right also where the width is near 0
        sigma_px = self.spread.sigma_px
        return {
            "sigma_px": (math.sqrt(sigma_px**2 + math.sqrt(own["sigma_px2"])) - sigma_px) ** 2,
            "aspect": own.get("log_aspect", 0.0) * self.spread.aspect**2,
            "tail_share": own.get("tail_share", 0.0),
            "tail_px": own.get("log_tail_px", 0.0) * self.spread.tail_px**2,
        }

    def parameter_variance(self, name: str) -> float:
        """Sampling variance of a parameter of the family, without chi-square's inflation."""
        place = len(self.coefficients) + self.form.names.index(name)
        return float(self.covariance[place, place])

    def with_share(self, problem: SpreadProblem, share: float) -> "Candidate":
        """The best spread of this reach with another share of light in the tail."""
        share_at = self.form.names.index("tail_share")
        linear = len(self.coefficients)
        place = linear + share_at
        # the core follows, at first as this fit says that it does
        follows = self.covariance[place, linear:] / self.covariance[place, place]
        theta = self.theta + follows * (share - self.theta[share_at])
        theta[share_at] = share
        return best_of(problem, self.form, [theta], fixed=TAIL)


def criterion(problem: SpreadProblem, candidate: Candidate) -> float:
    """Schwarz's criterion (Ann. Stat. 6 (1978) 461): chi-square and ln n for each parameter of the core.

    A tail is weighed by its prior instead: its share and reach are averaged over.
    """
    core = len(set(candidate.form.names) - set(TAIL))
    return candidate.chi_square + core * math.log(max(problem.independent, 2.0))


def starts_of(form: Family) -> list[FloatArray]:
    """Where a family's descent begins."""
    return [np.array([one[name] for name in form.names]) for one in _STARTS]


def best_of(
    problem: SpreadProblem, form: Family, starts: Sequence[FloatArray], *, fixed: Sequence[str] = ()
) -> Candidate:
    """A family at its best, with the parameters `fixed` as they start."""
    names = form.names
    free = [place for place, name in enumerate(names) if name not in fixed]
    bounds = _bounds(problem, form)
    tried = [
        _descended(problem, form, np.clip(one, bounds[0], bounds[1]), bounds, free)
        for one in {tuple(one): one for one in starts}.values()
    ]
    theta, chi_square = min(tried, key=lambda one: one[1])
    spread = form.spread(theta)
    coefficients, _ = problem.solve(spread)
    linear = len(coefficients)
    places = [*range(linear), *(linear + place for place in free)]
    covariance = np.zeros((linear + len(names), linear + len(names)))
    covariance[np.ix_(places, places)] = normal_at(problem, form, theta, coefficients, free).covariance()
    return Candidate(
        form=form,
        theta=theta,
        spread=spread,
        coefficients=coefficients,
        covariance=covariance,
        chi_square=chi_square,
        groups=problem.groups,
        variance_share=_variance_share(problem, spread),
        share_slopes=_share_slopes(problem, form, theta, free),
    )


def normal_at(
    problem: SpreadProblem, form: Family, theta: FloatArray, coefficients: FloatArray, free: Sequence[int]
) -> Normal:
    """Normal equations of the coefficients and of the parameters at the places `free`, about these values, priors included."""
    shapes = problem.in_cells(form.spread(theta))
    normal = problem.normal(shapes, coefficients[: problem.groups], _slopes(problem, form, theta, free))
    return normal.with_white_prior(problem.white_prior(coefficients))


def _bounds(problem: SpreadProblem, form: Family) -> FloatArray:
    """Least and largest parameters (2, name)."""
    names = form.names
    bounds = np.array([_BOUNDS[name] for name in names]).T
    if "log_tail_px" in names:
        bounds[:, names.index("log_tail_px")] = LOG_REACH
    bounds[1, names.index("sigma_px2")] = (_WIDEST_CORE * max(problem.sides)) ** 2
    return bounds


def _descended(
    problem: SpreadProblem, form: Family, theta: FloatArray, bounds: FloatArray, free: Sequence[int]
) -> tuple[FloatArray, float]:
    """Parameters of the spread at the least chi-square near a start, and that chi-square (Gauss and Newton's steps, halved
    until they help)."""
    coefficients, chi_square = problem.solve(form.spread(theta))
    for _ in range(_MOST_STEPS):
        step = _step(problem, form, theta, coefficients, bounds, free)
        for share in (1.0, 0.5, 0.25, 0.1, 0.03):
            moved = np.clip(theta + share * step, bounds[0], bounds[1])
            there, value = problem.solve(form.spread(moved))
            if value < chi_square:
                break
        else:
            return theta, chi_square
        gained = chi_square - value
        theta, coefficients, chi_square = moved, there, value
        if gained < SETTLED:
            break
    return theta, chi_square


def _step(
    problem: SpreadProblem,
    form: Family,
    theta: FloatArray,
    coefficients: FloatArray,
    bounds: FloatArray,
    free: Sequence[int],
) -> FloatArray:
    """Gauss and Newton's step of the parameters (name,); those at a bound that it would cross stay there, and the others take
    the best step without them."""
    normal = normal_at(problem, form, theta, coefficients, free)
    moving, linear = list(free), len(coefficients)
    while True:
        step = np.zeros(len(theta))
        if not moving:
            return step
        step[moving] = normal.solved(problem.not_negative)[0][linear:]
        blocked = [
            place
            for place in moving
            if (theta[place] <= bounds[0, place] and step[place] < 0)
            or (theta[place] >= bounds[1, place] and step[place] > 0)
        ]
        if not blocked:
            return step
        normal = normal.without([linear + moving.index(place) for place in blocked])
        moving = [place for place in moving if place not in blocked]


def _moved(form: Family, theta: FloatArray, place: int) -> list[tuple[float, Spread]]:
    """A parameter of the spread a little more and a little less, with the spreads that it makes."""
    name = form.names[place]
    ends = []
    for step in (0.005, -0.005):
        moved = theta.copy()
        moved[place] = np.clip(theta[place] + step, *_BOUNDS[name])
        ends.append((float(moved[place]), form.spread(moved)))
    return ends


def _slopes(
    problem: SpreadProblem, form: Family, theta: FloatArray, free: Sequence[int]
) -> list[dict[int, FloatArray]]:
    """Derivatives of the shapes (cell,), by side, by the parameters of the spread at the places `free`."""
    found = []
    for place in free:
        (above, more), (below, less) = _moved(form, theta, place)
        shapes = problem.in_cells(more), problem.in_cells(less)
        found.append({side: (shapes[0][side] - shapes[1][side]) / (above - below) for side in problem.sides})
    return found


def _variance_share(problem: SpreadProblem, spread: Spread) -> float:
    """Share of the quanta's variance that the spread leaves in one pixel: its power's mean over all frequencies."""
    side = problem.sides[-1]
    return float(np.sum(mode_share(side) * spread.noise_power(side)))


def _share_slopes(problem: SpreadProblem, form: Family, theta: FloatArray, free: Sequence[int]) -> FloatArray:
    """Its derivatives (name,) by the parameters at the places `free`, 0 for others."""
    found = np.zeros(len(theta))
    for place in free:
        (above, more), (below, less) = _moved(form, theta, place)
        found[place] = (_variance_share(problem, more) - _variance_share(problem, less)) / (above - below)
    return found
