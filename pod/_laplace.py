"""Deviance of a hit/miss regression with crossed random effects of networks and images, by Laplace's method."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .links import Link
from .trials import Trials

Array = NDArray[np.float64]
Codes = NDArray[np.intp]


@dataclass(slots=True, kw_only=True)
class Laplace:
    """-2 ln of the Laplace approximation to L(c, sd) = integral of prod_k P(y_k | b) N(b; 0, 1) db.

    eta_k = offset_k + sd_1 b_1[first_k] + sd_2 b_2[second_k]; the standard deviations enter with any sign (the
    deviance is even in each). The curvature at the mode is the expected information (as lme4's, `expected`) or
    the observed one, which is nearer to the integral where the two differ (all links but logit). `mode` is kept to
    start from.

    Source: Bates, Maechler, Bolker & Walker, J. Stat. Softw. 67 (2015) 1; Breslow & Clayton, JASA 88 (1993) 9.
    """

    hits: Array
    misses: Array
    first: Codes
    second: Codes | None
    link: Link
    expected: bool = True
    mode: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        self._n1 = int(self.first.max()) + 1
        self._n2 = 0 if self.second is None else int(self.second.max()) + 1
        self._cell = self.first * self._n2 + self.second if self.second is not None else self.first
        if not self.mode.size:
            self.mode = np.zeros(self._n1 + self._n2)

    _n1: int = field(init=False, default=0)
    _n2: int = field(init=False, default=0)
    _cell: Codes = field(init=False, default_factory=lambda: np.zeros(0, np.intp))

    def deviance(self, offset: Array, sd: Array) -> float:
        """-2 ln L at the linear predictor without random effects, (row,), and the standard deviations (1 or 2,)."""
        b = self.mode
        n1, s1 = self._n1, float(sd[0])
        s2 = float(sd[1]) if self.second is not None else 0.0
        step = np.zeros_like(b)
        best = np.inf
        weight = np.zeros_like(offset)
        logdet = 0.0
        for _ in range(100):
            trial = b + step
            eta = offset + s1 * trial[:n1][self.first]
            if self.second is not None:
                eta = eta + s2 * trial[n1:][self.second]
            parts = self.link.log_parts(eta)
            value = -2 * float(self.hits @ parts.log_hit + self.misses @ parts.log_miss) + float(trial @ trial)
            if not value <= best + 1e-10 * (1 + abs(best)):
                step = 0.5 * step
                if np.abs(step).max() < 1e-14:
                    break
                continue
            best, b = value, trial
            score = self.hits * parts.log_hit_1 + self.misses * parts.log_miss_1
            weight = -(self.hits + self.misses) * parts.log_hit_1 * parts.log_miss_1
            gradient = self._spread(score, s1, s2) - b
            # Newton with the observed curvature finds the mode of a log-concave density; scoring may circle it
            observed = -(self.hits * parts.log_hit_2 + self.misses * parts.log_miss_2)
            step, logdet = self._solve(observed, gradient, s1, s2)
            if float(gradient @ step) < 1e-18:
                break
        self.mode = b
        if self.expected:
            _, logdet = self._solve(weight, np.zeros_like(b), s1, s2)
        return best + logdet

    @classmethod
    def of(cls, table: Trials, *, factors: list[Codes], link: Link, expected: bool) -> "Laplace":
        """The deviance of trials with one or two crossed factors."""
        return cls(
            hits=table.hits,
            misses=table.misses,
            first=factors[0],
            second=factors[1] if len(factors) > 1 else None,
            link=link,
            expected=expected,
        )

    def information(self, offset: Array, sd: Array) -> float:
        """Expected information on the constant, of all looks with the effects at their mode; in 1 / eta squared."""
        self.deviance(offset, sd)
        eta = offset + sd[0] * self.mode[: self._n1][self.first]
        if self.second is not None:
            eta = eta + sd[1] * self.mode[self._n1 :][self.second]
        parts = self.link.log_parts(eta)
        return -float((self.hits + self.misses) @ (parts.log_hit_1 * parts.log_miss_1))

    def _spread(self, rows: Array, s1: float, s2: float) -> Array:
        up = np.asarray(s1 * np.bincount(self.first, weights=rows, minlength=self._n1), dtype=float)
        if self.second is None:
            return up
        return np.concatenate((up, s2 * np.bincount(self.second, weights=rows, minlength=self._n2)))

    def _solve(self, weight: Array, gradient: Array, s1: float, s2: float) -> tuple[Array, float]:
        """Solve (I + S Z'WZ S) step = gradient and give ln det, eliminating the larger diagonal block."""
        n1, n2 = self._n1, self._n2
        d1 = 1 + s1 * s1 * np.bincount(self.first, weights=weight, minlength=n1)
        if self.second is None:
            return np.asarray(gradient / d1), float(np.log(d1).sum())
        d2 = 1 + s2 * s2 * np.bincount(self.second, weights=weight, minlength=n2)
        across = s1 * s2 * np.bincount(self._cell, weights=weight, minlength=n1 * n2).reshape(n1, n2)
        g1, g2 = gradient[:n1], gradient[n1:]
        swapped = n2 > n1
        if swapped:
            d1, d2, g1, g2, across = d2, d1, g2, g1, across.T
        over = across / d1[:, None]
        schur = np.diag(d2) - across.T @ over
        lower = np.linalg.cholesky(schur)
        y2 = np.linalg.solve(schur, g2 - over.T @ g1)
        y1 = g1 / d1 - over @ y2
        logdet = float(np.log(d1).sum() + 2 * np.log(np.diag(lower)).sum())
        return np.concatenate((y2, y1) if swapped else (y1, y2)), logdet
