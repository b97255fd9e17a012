"""Draws from a posterior of latent numbers that are standard Gaussian beforehand: importance sampling, then walkers."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...errors import FitError

_ROUND_DRAWS = 1024
_FINAL_DRAWS = 2048
_ROUNDS = 12
_LEAST_EFFECTIVE = 200.0  # draws that must count, or walkers go on
_ENOUGH = 600.0  # effective draws: further rounds bring little
_WALKERS = 1024
_STEP_EFFECTIVE = 0.5  # share of the walkers that must count as the likelihood's power rises
_SWEEPS, _MOST_SWEEPS = 5, 80  # at a power, and at the whole likelihood
_MOST_POWERS = 100
_FORGOTTEN = 0.3  # correlation with where they were: from there on walkers are draws of their own
_STUDENT_DEGREES = 5.0
_MIXTURE = (0.75, 0.2, 0.05)


class Target(Protocol):
    """What is drawn from."""

    @property
    def dimensions(self) -> int:
        """Of the latent numbers."""

    def log_likelihood(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of draws (draw, dimension); -inf out of bounds."""

    def relinearise(self, u: NDArray[np.float64], weight: NDArray[np.float64], rng: np.random.Generator) -> None:
        """Take derivatives from now on where draws (draw, dimension) of these weights (draw,) lie."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Draws:
    """Weighted draws: u (draw, dimension), log likelihood (draw,), normalised weights (draw,), how many equal ones they are worth."""

    u: NDArray[np.float64]
    likelihood: NDArray[np.float64]
    weight: NDArray[np.float64]
    effective: float

    @property
    def most_probable(self) -> NDArray[np.float64]:
        """The draw (dimension,) of the highest posterior density."""
        density = np.where(np.isfinite(self.likelihood), self.likelihood - 0.5 * np.sum(self.u**2, axis=1), -np.inf)
        return np.asarray(self.u[int(np.argmax(density))])


def draw(target: Target, rng: np.random.Generator, *, hopeless: Callable[[NDArray[np.float64]], bool]) -> Draws:
    """Draws from a posterior.

    Importance sampling from the prior to the posterior by way of flattened posteriors (likelihood to the power of
    a rising temper), each proposed from the one before; where its own covariance does not describe the posterior,
    by walkers (`walked`).

    Args:
        target: the posterior.
        rng: source of randomness.
        hopeless: whether the most probable draw (dimension,) says that walking, which takes long, finds nothing.

    Raises:
        FitError: no draws were found.
    """
    u = rng.standard_normal((2 * _ROUND_DRAWS, target.dimensions))
    log_ratio = np.zeros(len(u))  # prior over proposal
    temper, effective = 0.0, 0.0
    weight = np.full(len(u), 1.0 / len(u))
    likelihood = target.log_likelihood(u)
    for _ in range(_ROUNDS):
        temper = _next_temper(likelihood, log_ratio, last=temper, least=0.1 * len(u))
        weight, effective = _weights(temper * likelihood + log_ratio)
        if temper >= 1.0 and effective > _ENOUGH:
            break
        target.relinearise(u, weight, rng)
        mean = weight @ u
        spread = u - mean
        covariance = (spread * weight[:, None]).T @ spread
        # few effective draws make a covariance too narrow in some direction
        covariance = covariance * (1.0 + 2.0 * len(mean) / max(effective, 1.0)) + 1e-8 * np.eye(len(mean))
        draws = _FINAL_DRAWS if temper >= 0.3 else _ROUND_DRAWS
        u, log_proposal = _mixture_draws(mean, covariance, draws, rng)
        log_ratio = -0.5 * np.sum(u**2, axis=1) - 0.5 * u.shape[1] * math.log(2 * math.pi) - log_proposal
        likelihood = target.log_likelihood(u)
    else:
        weight, effective = _weights(likelihood + log_ratio)
    found = Draws(u=u, likelihood=likelihood, weight=weight, effective=effective)
    if effective < _LEAST_EFFECTIVE:
        if hopeless(found.most_probable):
            raise FitError("the levels contradict each other or the declared instrument")
        found = walked(target, found, log_ratio, rng)
    if found.effective < _LEAST_EFFECTIVE:
        raise FitError(
            f"the posterior of the spectrum could not be drawn (effective sample size {found.effective:.0f});"
            " the levels contradict each other or the declared instrument"
        )
    return found


def walked(target: Target, start: Draws, log_ratio: NDArray[np.float64], rng: np.random.Generator) -> Draws:
    """Walkers drawn from the posterior, all of one weight.

    Sequential Monte Carlo (Del Moral, Doucet, Jasra 2006, doi:10.1111/j.1467-9868.2006.00553.x): from weighted draws to
    flattened posteriors of rising power, by resampling, and at each by Metropolis steps along differences of other walkers
    (ter Braak 2006, doi:10.1007/s11222-006-8769-1), until they have forgotten where they were.

    Args:
        target: the posterior.
        start: draws from near it.
        log_ratio: log of prior over proposal (draw,) of these.
        rng: source of randomness.
    """
    u, likelihood = start.u, start.likelihood
    temper = _next_temper(likelihood, log_ratio, last=0.0, least=_STEP_EFFECTIVE * min(_WALKERS, len(u)))
    weight, _ = _weights(np.where(np.isfinite(likelihood), temper * likelihood + log_ratio, -np.inf))
    chosen = resampled(weight, _WALKERS, rng)
    u, likelihood = u[chosen], likelihood[chosen]
    for _ in range(_MOST_POWERS):
        before = u
        for sweep in range(_SWEEPS if temper < 1.0 else _MOST_SWEEPS):
            u, likelihood = _swept(target, u, likelihood, temper, rng)
            if temper >= 1.0 and sweep % _SWEEPS == _SWEEPS - 1 and _remembered(before, u) < _FORGOTTEN:
                break
        if temper >= 1.0:
            return _alike(u, likelihood, len(u) * (1.0 - _remembered(before, u) ** 2))
        temper, last = _raised(likelihood, temper), temper
        chosen = resampled(_weights((temper - last) * likelihood)[0], len(u), rng)
        u, likelihood = u[chosen], likelihood[chosen]
    return _alike(u, likelihood, 0.0)


def _alike(u: NDArray[np.float64], likelihood: NDArray[np.float64], effective: float) -> Draws:
    """Draws of one weight."""
    return Draws(u=u, likelihood=likelihood, weight=np.full(len(u), 1.0 / len(u)), effective=effective)


def _swept(
    target: Target,
    u: NDArray[np.float64],
    likelihood: NDArray[np.float64],
    temper: float,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """All walkers after one Metropolis step each: one half along differences of the other half, then the other."""
    u, likelihood = u.copy(), likelihood.copy()
    order = rng.permutation(len(u))
    for moving, still in ((order[::2], order[1::2]), (order[1::2], order[::2])):
        first, second = (u[still[rng.integers(len(still), size=len(moving))]] for _ in range(2))
        # long steps reach other ends of a bent posterior, short ones are taken in narrow ones
        scale = 2.38 / math.sqrt(2.0 * u.shape[1]) * rng.choice([0.1, 0.3, 1.0, 2.0], size=(len(moving), 1))
        proposed = u[moving] + scale * (first - second) + 1e-5 * rng.standard_normal(first.shape)
        there = target.log_likelihood(proposed)
        gain = temper * (there - likelihood[moving]) - 0.5 * np.sum(proposed**2 - u[moving] ** 2, axis=1)
        taken = np.log(rng.random(len(moving))) < gain
        u[moving[taken]], likelihood[moving[taken]] = proposed[taken], there[taken]
    return u, likelihood


def climbed(target: Target, start: NDArray[np.float64], *, still: int | None) -> NDArray[np.float64]:
    """The most probable set (dimension,) near a draw, by Newton's steps on numerical derivatives.

    Args:
        target: the posterior.
        start: the draw (dimension,).
        still: the dimension that is not moved: one that chooses between two.
    """
    size, step = len(start), 0.05
    moving = [i for i in range(size) if i != still]
    eye = np.eye(size)
    best, u = start, start
    highest = float(_density(target, start[None, :])[0])
    for _ in range(4):
        points = [u]
        for i in moving:
            points += [u + step * eye[i], u - step * eye[i]]
        pairs = [(i, j) for n, i in enumerate(moving) for j in moving[:n]]
        points += [u + step * (eye[i] + eye[j]) for i, j in pairs]
        values = _density(target, np.array(points))
        if not np.all(np.isfinite(values)):
            break  # at a bound
        gradient, hessian = np.zeros(size), -np.eye(size)
        up, down = values[1 : 2 * len(moving) : 2], values[2 : 2 * len(moving) + 1 : 2]
        for n, i in enumerate(moving):
            gradient[i] = (up[n] - down[n]) / (2 * step)
            hessian[i, i] = min((up[n] - 2 * values[0] + down[n]) / step**2, -0.1)
        place = {i: n for n, i in enumerate(moving)}
        for (i, j), value in zip(pairs, values[2 * len(moving) + 1 :], strict=True):
            mixed = value - up[place[i]] - up[place[j]] + values[0]
            hessian[i, j] = hessian[j, i] = mixed / step**2
        curvature, directions = np.linalg.eigh(hessian)
        move = directions @ ((directions.T @ gradient) / np.maximum(-curvature, 0.3))
        shares = np.array([1.0, 0.5, 0.2])
        tried = _density(target, u + shares[:, None] * move)
        winner = int(np.argmax(tried))
        if not tried[winner] > highest + 1e-4:
            break
        highest, u = float(tried[winner]), u + shares[winner] * move
        best = u
    return best


def _density(target: Target, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log density (draw,) but for a constant."""
    return np.asarray(target.log_likelihood(u) - 0.5 * np.sum(u**2, axis=1))


def _weights(logarithms: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Normalised weights (draw,) and how many equal draws they are worth."""
    weight = np.exp(logarithms - np.max(logarithms))
    weight /= weight.sum()
    return weight, 1.0 / float(np.sum(weight**2))


def resampled(weight: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices (count,) of draws of normalised `weight` (draw,), systematically."""
    positions = (np.arange(count) + rng.random()) / count
    return np.minimum(np.searchsorted(np.cumsum(weight), positions), len(weight) - 1)


def _remembered(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """Largest rank correlation, over dimensions, of where walkers (walker, dimension) are with where they were.

    Ranks, so that one walker that stands still far off does not count for all.
    """
    first, second = (np.argsort(np.argsort(at, axis=0), axis=0) - 0.5 * (len(at) - 1) for at in (before, after))
    scale = np.sqrt(np.sum(first**2, axis=0) * np.sum(second**2, axis=0))
    return float(np.max(np.sum(first * second, axis=0) / np.maximum(scale, 1e-300)))


def _next_temper(
    likelihood: NDArray[np.float64], log_ratio: NDArray[np.float64], *, last: float, least: float
) -> float:
    """The largest power (0 to 1) of the likelihood that leaves `least` effective draws, or the one that leaves most."""
    powers = np.geomspace(1.0, max(0.5 * last, 1e-4), 60)
    effective = []
    for power in powers:
        # a draw out of bounds keeps its weight of zero at any power
        effective.append(_weights(np.where(np.isfinite(likelihood), power * likelihood + log_ratio, -np.inf))[1])
        if effective[-1] >= least:
            return float(power)
    return float(powers[int(np.argmax(effective))])


def _raised(likelihood: NDArray[np.float64], last: float) -> float:
    """The largest power (to 1) of the likelihood that leaves enough of the equal draws from its power `last`."""

    def enough(power: float) -> bool:
        return _weights((power - last) * likelihood)[1] >= _STEP_EFFECTIVE * len(likelihood)

    low, high = last, 1.0
    if enough(high):
        return high
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return high


def _mixture_draws(
    mean: NDArray[np.float64], covariance: NDArray[np.float64], draws: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draws (draw, shape), log density: Student's t about the mean, one three times as wide, and the prior."""
    size = len(mean)
    lower = np.linalg.cholesky(covariance)
    normal = rng.standard_normal((draws, size))
    heavy = np.sqrt(_STUDENT_DEGREES / rng.chisquare(_STUDENT_DEGREES, size=draws))[:, None]
    kind = rng.choice(3, size=draws, p=_MIXTURE)[:, None]
    width = np.where(kind == 1, 3.0, 1.0)
    u = np.where(kind == 2, normal, mean + width * heavy * (normal @ lower.T))
    z = np.linalg.solve(lower, (u - mean).T)
    square = np.sum(z**2, axis=0)
    log_determinant = float(np.sum(np.log(np.diag(lower))))
    constant = (
        math.lgamma(0.5 * (_STUDENT_DEGREES + size))
        - math.lgamma(0.5 * _STUDENT_DEGREES)
        - 0.5 * size * math.log(math.pi * _STUDENT_DEGREES)
    )

    def student(scale: float) -> NDArray[np.float64]:
        tail = 0.5 * (_STUDENT_DEGREES + size) * np.log1p(square / scale**2 / _STUDENT_DEGREES)
        return np.asarray(constant - log_determinant - size * math.log(scale) - tail)

    prior = -0.5 * np.sum(u**2, axis=1) - 0.5 * size * math.log(2 * math.pi)
    parts = np.stack([student(1.0), student(3.0), prior]) + np.log(np.array(_MIXTURE))[:, None]
    return u, np.asarray(np.logaddexp.reduce(parts, axis=0))
