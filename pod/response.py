"""POD from a continuous response (a-hat against a): a network's probability, an echo's height, a contrast.

T(response) = b0 + b1 x + tau Z,  POD(a) = Phi((b0 + b1 x - T(decision)) / tau)

x is the size or its logarithm, T the identity, the logarithm or Box and Cox's (r^lambda - 1) / lambda. Responses at or
below the left limit (noise) and at or above the right limit (saturation) are censored: they say only that much. The
POD curve is a probit one with c0 = (b0 - T(decision)) / tau and c1 = b1 / tau; mu = -c0 / c1 and sigma = 1 / c1 are
the handbook's. Of n rows the likelihood ratio's bounds take n ln(1 + t^2 / (n - 2)) for chi-square, t Student's quantile, which is
exact for the line itself; Wald's are the handbook's, and given from 40 rows on.
Validity: a straight line and normal scatter of one width on the chosen scales (look at the residuals).
Source: MIL-HDBK-1823A (2009) G.3 and example 1; Olsen, Econometrica 46 (1978) 1211 (the concave form); Box & Cox
(1964).
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FitError, InputError
from ..results import ByValue
from .few_groups import ONE_SIDED, TWO_SIDED, size_from_test, student_quantile
from .hit_miss import NO_BOUNDS, Bounds, size_from_x, size_in_range
from .links import LINKS
from .robust import Clustered, clustered_fit
from .trials import codes_from_labels

Array = NDArray[np.float64]

_PROBIT = LINKS["probit"]
_NO_BOUNDS = (NO_BOUNDS, NO_BOUNDS, NO_BOUNDS)
# p-values: a warning for one straight line in a hundred, no bounds for one in a thousand, as readings of a tube are left out
_DOUBTED = 0.01
_REJECTED = 0.001
_FEWEST_FOR_WALD = 40  # rows that the handbook asks for (4.5.2); of five its bound covers six times of ten
_FEWEST_TO_TEST = 12  # rows: with fewer, p-values that hold for large samples say little


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResponseFit(ByValue):
    """A fitted line and its POD curve. Sizes in the data's unit, None where the data cannot support a number.

    intercept, slope, scatter: b0, b1, tau on the transformed scales. p_line, p_scatter: p-values of tests that the line is
    straight and its scatter the same at every size (None for repeated looks). box_cox: lambda (1 = as it is, 0 = logarithm).
    mu, sigma: of the POD curve on x. covariance: of (c0, c1). a90_95 and the like: see `PodFit`.
    """

    log_size: bool
    box_cox: float
    decision: float
    n: int
    n_above: int
    n_left_censored: int
    n_right_censored: int
    smallest_size: float
    largest_size: float
    intercept: float
    slope: float
    scatter: float
    c0: float
    c1: float
    se0: float
    se1: float
    mu: float | None
    sigma: float | None
    covariance: Array
    log_likelihood: float
    a50: float | None
    a90: float | None
    a90_95: Bounds
    a90_95_two_sided: Bounds
    a90_low_two_sided: Bounds
    reaches_90: bool
    repeats: str
    warnings: tuple[str, ...]
    p_line: float | None = None
    p_scatter: float | None = None


def fit_response_pod(
    size: ArrayLike,
    response: ArrayLike,
    *,
    decision: float,
    left: float | None = None,
    right: float | None = None,
    log_size: bool = False,
    box_cox: float | None = 1.0,
    network: ArrayLike | None = None,
    image: ArrayLike | None = None,
    repeats: str = "pooled",
) -> ResponseFit:
    """Fit response against size and derive the POD curve; sizes in the data's unit.

    Args:
        size: (row,), any unit; above 0 with `log_size`.
        response: (row,), any unit; above 0 unless `box_cox` is 1.
        decision: the response above which an object counts as detected.
        left, right: limits at and beyond which a response is censored; None = none.
        log_size: line on ln size.
        box_cox: lambda; 1 = the response as it is, 0 = its logarithm, None = the most likely one within [-1, 2].
        network, image: (row,), labels, for `repeats="cluster"`.
        repeats: `pooled`, or `cluster` (bounds robust to repeated networks and images).

    Raises:
        InputError: columns or limits that cannot be used.
        FitError: too few responses between the limits, or one size only.
    """
    x, y = _checked(size, response, log_size=log_size)
    _check_limits(decision, left, right)
    if repeats not in ("pooled", "cluster"):
        raise InputError("repeats", received=repr(repeats), expected="pooled or cluster for a response")
    power = _likeliest_power(x, y, left, right) if box_cox is None else box_cox
    if power != 1 and not decision > 0:
        raise InputError("decision", received=decision, expected="above 0 where the response is transformed")
    line = _fit(x, y, power, left, right)
    notes: list[str] = []
    clustered: Clustered | None = None
    unknown = False  # whether repeats are too few to tell their spread
    if repeats == "cluster":
        groups = _groups(network, image, rows=len(x))
        if groups:
            clustered = clustered_fit(line.score_rows(line.q), line.information_rows(line.q), groups)
            unknown = clustered is None
        else:
            notes.append("no repeated network or image: the bounds are those of independent rows")
    curve = _Curve.of(line, float(transformed(np.array(decision), power)), clustered)
    smallest, largest = float(x.min()), float(x.max())
    a50 = a90 = None
    bounds = _NO_BOUNDS
    if curve.c1 > 0:
        sizes_at = {}
        for percent in (50, 90):
            sizes_at[percent], note = size_in_range(
                curve.x_at(percent / 100), smallest=smallest, largest=largest, log_size=log_size, percent=percent
            )
            notes += [note] if note else []
        a50, a90 = sizes_at[50], sizes_at[90]
    else:
        notes.append("the response does not rise with size: no a50 and no a90")
    if a90 is not None and unknown:
        notes.append(
            "fewer than three networks or images, or one that alone holds up the line, tell no spread: no bounds on a90"
        )
    elif a90 is not None:
        bounds = _bounds_on_a90(curve, rows=len(x), span=largest - smallest, log_size=log_size)
        if bounds[1].likelihood_ratio is None:
            notes.append("the likelihood gives no upper bound on a90: more sizes above it would")
    p_line = p_scatter = None
    if repeats == "pooled":
        p_line, p_scatter = _tests_of_line(line, x)
        rejected, doubt = _doubt(p_line, p_scatter)
        bounds = _NO_BOUNDS if rejected else bounds
        notes += [doubt] if doubt else []
    sizes = np.exp(x) if log_size else x
    h = float(line.q[2])
    return ResponseFit(
        log_size=log_size,
        box_cox=power,
        decision=decision,
        n=len(x),
        n_above=int(np.sum(y > decision)),
        n_left_censored=int(line.left.sum()),
        n_right_censored=int(line.right.sum()),
        smallest_size=float(sizes.min()),
        largest_size=float(sizes.max()),
        intercept=float(line.q[0] / h),
        slope=float(line.q[1] / h),
        scatter=1.0 / h,
        c0=curve.c0,
        c1=curve.c1,
        se0=math.sqrt(curve.covariance[0, 0]),
        se1=math.sqrt(curve.covariance[1, 1]),
        mu=-curve.c0 / curve.c1 if curve.c1 > 0 else None,
        sigma=1 / curve.c1 if curve.c1 > 0 else None,
        covariance=curve.covariance,
        log_likelihood=line.log_likelihood,
        a50=a50,
        a90=a90,
        a90_95=bounds[0],
        a90_95_two_sided=bounds[1],
        a90_low_two_sided=bounds[2],
        reaches_90=bool(curve.c1 > 0 and curve.x_at(0.9) <= largest),
        repeats=repeats,
        warnings=tuple(notes),
        p_line=p_line,
        p_scatter=p_scatter,
    )


def _check_limits(decision: float, left: float | None, right: float | None) -> None:
    for name, limit in (("decision", decision), ("left", left), ("right", right)):
        if limit is not None and not (isinstance(limit, int | float | np.number) and math.isfinite(limit)):
            raise InputError(name, received=repr(limit), expected="a finite response")
    if left is not None and right is not None and not left < right:
        raise InputError("left and right", received=f"{left:g} and {right:g}", expected="a left limit below the right")
    if (left is not None and decision < left) or (right is not None and decision > right):
        raise InputError(
            "decision",
            received=f"{decision:g}",
            expected=f"a response between the limits, {-math.inf if left is None else left:g} to"
            f" {math.inf if right is None else right:g}: beyond them nothing was seen",
        )


def _likeliest_power(x: Array, response: Array, left: float | None, right: float | None) -> float:
    """The Box-Cox lambda within [-1, 2] under which the line is likeliest."""
    from scipy.optimize import minimize_scalar

    def cost(power: float) -> float:
        return -_fit(x, response, power, left, right).log_likelihood

    return float(minimize_scalar(cost, bounds=(-1.0, 2.0), method="bounded", options={"xatol": 1e-4}).x)


def _groups(network: ArrayLike | None, image: ArrayLike | None, *, rows: int) -> list[NDArray[np.intp]]:
    """Codes of networks and of images (row,), of those that repeat."""
    named = (("network", network), ("image", image))
    codes = [codes_from_labels(name, labels, rows) for name, labels in named if labels is not None]
    return [one for one in codes if one.max() > 0]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Curve:
    """The POD curve that a line gives: POD = probit(c0 + c1 x), with the decision at `threshold`, transformed.

    Fields: line; threshold; matrix (2, 3): from the line's parameters to c0 and c1; covariance of these, robust to repeats
    where `clustered` has their spread.
    """

    line: "_Line"
    threshold: float
    matrix: Array
    c0: float
    c1: float
    covariance: Array
    clustered: Clustered | None

    @classmethod
    def of(cls, line: "_Line", threshold: float, clustered: Clustered | None) -> "_Curve":
        # c = M (gamma0, gamma1, h)
        matrix = np.array([[1.0, 0.0, -threshold], [0.0, 1.0, 0.0]])
        c0, c1 = (float(value) for value in matrix @ line.q)
        robust = np.linalg.inv(line.information(line.q)) if clustered is None else clustered.covariance()
        return cls(
            line=line, threshold=threshold, matrix=matrix, c0=c0, c1=c1, covariance=matrix @ robust @ matrix.T,
            clustered=clustered,
        )  # fmt: skip

    def x_at(self, pod: float) -> float:
        """Where the curve has a POD."""
        return float(_PROBIT.eta_from_pod(pod) - self.c0) / self.c1


def _bounds_on_a90(curve: _Curve, *, rows: int, span: float, log_size: bool) -> tuple[Bounds, Bounds, Bounds]:
    """One-sided upper, two-sided upper and two-sided lower 95 % bounds on a90.

    rows: of the table; span: of its sizes, on the fit's axis.
    """
    line, clustered, x90 = curve.line, curve.clustered, curve.x_at(0.9)
    toward = np.array([1.0, x90])
    # of few rows the scatter is known as well as so many rows less the line's two coefficients tell it
    exact = float(line.exact.sum())
    left_over = exact - 2.0
    variance, freedom, divisor = float(toward @ curve.covariance @ toward), left_over, 1.0
    if clustered is not None:
        spread, freedom_at = clustered.variance(toward @ curve.matrix)
        independent = curve.matrix @ np.linalg.inv(line.information(line.q)) @ curve.matrix.T
        variance, freedom = float(spread), float(freedom_at)
        divisor = variance / float(toward @ independent @ toward)
    error = math.sqrt(variance) / curve.c1

    def wald(below: float, side: float) -> float | None:
        if clustered is None:
            far = float(student_quantile(below, math.inf))
            return x90 + side * far * error if rows >= _FEWEST_FOR_WALD else None
        variances = clustered.variance

        def excess(at: float) -> tuple[float, float, float]:
            value, m = variances(np.array([1.0, at]) @ curve.matrix)
            return curve.c0 + curve.c1 * at - _PROBIT.eta_from_pod(0.9), float(value), float(m)

        return size_from_test(excess, below=below, upper=side > 0, start=x90, span=span)

    def likelihood(below: float, side: float) -> float | None:
        z = float(student_quantile(below, freedom))
        allowed = exact * math.log1p(z * z / left_over) if clustered is None else z * z * divisor
        return _bound(line, curve.threshold, x90, side * z * error, allowed)

    upper, two_sided, lower = (
        Bounds(
            likelihood_ratio=size_from_x(likelihood(below, side), log_size=log_size),
            wald=size_from_x(wald(below, side), log_size=log_size),
        )
        for below, side in ((ONE_SIDED, 1.0), (TWO_SIDED, 1.0), (TWO_SIDED, -1.0))
    )
    return upper, two_sided, lower


def _doubt(p_line: float | None, p_scatter: float | None) -> tuple[bool, str]:
    """Whether a straight line with one scatter is rejected, and what to say of it; empty: no doubt."""
    tests = (("the response bends", p_line), ("its scatter changes with size", p_scatter))
    departs = [f"{what} (p {p:.2g})" for what, p in tests if p is not None and p < _DOUBTED]
    rejected = any(p is not None and p < _REJECTED for _, p in tests)
    if not departs:
        return rejected, ""
    return rejected, (
        " and ".join(departs)
        + ", and a90 rests on a straight line with one scatter: "
        + ("no bounds on a90" if rejected else "a90 and its bounds may be wrong")
        + "; try log size, the logarithm of the response, box_cox auto, or hits above the decision, and name"
        " the columns of looks that repeat"
    )


def transformed(response: Array, box_cox: float) -> Array:
    """Box and Cox's transform of responses, of their shape: (r^lambda - 1) / lambda, ln r at 0, r itself at 1."""
    if box_cox == 1:
        return np.asarray(response, dtype=float)
    if abs(box_cox) < 1e-12:
        return np.asarray(np.log(response))
    return np.asarray((np.power(response, box_cox) - 1) / box_cox)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Line:
    """The censored regression in Olsen's parameters q = (b0 / tau, b1 / tau, 1 / tau): z = h y - gamma' x."""

    rows: Array  # (row, 3): z = rows @ q
    exact: NDArray[np.bool_]
    left: NDArray[np.bool_]
    right: NDArray[np.bool_]
    jacobian: float
    q: Array
    log_likelihood: float

    def terms(self, q: Array) -> tuple[float, Array, Array]:
        """Log-likelihood, and its first and second derivatives by z (row,); without the logarithm of h."""
        z = self.rows @ q
        parts = _PROBIT.log_parts(z)
        value = -0.5 * float((z[self.exact] ** 2).sum()) + float(parts.log_hit[self.left].sum())
        value += float(parts.log_miss[self.right].sum())
        first = np.where(self.exact, -z, np.where(self.left, parts.log_hit_1, parts.log_miss_1))
        second = np.where(self.exact, -1.0, np.where(self.left, parts.log_hit_2, parts.log_miss_2))
        count = int(self.exact.sum())
        value += count * (math.log(q[2]) - 0.5 * math.log(2 * math.pi)) if q[2] > 0 else -math.inf
        return value + self.jacobian, first, second

    def information(self, q: Array) -> Array:
        _, _, second = self.terms(q)
        matrix = (self.rows * -second[:, None]).T @ self.rows
        matrix[2, 2] += self.exact.sum() / q[2] ** 2
        return np.asarray(matrix)

    def information_rows(self, q: Array) -> Array:
        """Contribution of each row to the information, (row, 3, 3)."""
        _, _, second = self.terms(q)
        rows = -second[:, None, None] * self.rows[:, :, None] * self.rows[:, None, :]
        rows[:, 2, 2] += self.exact / q[2] ** 2
        return np.asarray(rows)

    def score_rows(self, q: Array) -> Array:
        _, first, _ = self.terms(q)
        rows = self.rows * first[:, None]
        rows[:, 2] += self.exact / q[2]
        return np.asarray(rows)

    def maximise(self, start: Array, basis: Array, origin: Array) -> tuple[Array, float]:
        """Newton's method over free parameters p with q = origin + basis p; the log-likelihood is concave."""
        p = start.copy()
        value = self.terms(origin + basis @ p)[0]
        for _ in range(200):
            q = origin + basis @ p
            gradient = basis.T @ self.score_rows(q).sum(axis=0)
            step = np.linalg.solve(basis.T @ self.information(q) @ basis, gradient)
            gain = float(gradient @ step)
            if gain < 1e-14 * (1 + abs(value)):
                return p, value
            length = 1.0
            for _ in range(60):
                trial_q = origin + basis @ (p + length * step)
                trial = self.terms(trial_q)[0] if trial_q[2] > 0 else -math.inf
                if trial >= value - 1e-12 * abs(value):
                    break
                length *= 0.5
            else:
                return p, value
            p, value = p + length * step, trial
        raise FitError("the fit of response against size did not converge; try another transform")


def _fit(x: Array, response: Array, box_cox: float, left: float | None, right: float | None) -> _Line:
    is_left = np.zeros(len(x), bool) if left is None else response <= left
    is_right = np.zeros(len(x), bool) if right is None else response >= right
    exact = ~(is_left | is_right)
    if exact.sum() < 3 or np.ptp(x[exact]) == 0:
        raise FitError(
            "a response curve needs at least three responses between the limits, at two sizes: give more rows or wider limits"
        )
    clipped = np.clip(response, left, right) if left is not None or right is not None else response
    if box_cox != 1 and not np.all(clipped > 0):
        raise InputError(
            "response",
            received=f"{float(clipped.min()):g}",
            expected="values above 0 where the response is transformed",
            remedy="give a left limit above 0, or fit the response as it is (Box-Cox 1)",
        )
    y = transformed(clipped, box_cox)
    jacobian = float((box_cox - 1) * np.log(response[exact]).sum()) if box_cox != 1 else 0.0
    rows = np.stack((-np.ones_like(x), -x, y), axis=1)
    design = np.stack((np.ones(int(exact.sum())), x[exact]), axis=1)
    beta, *_ = np.linalg.lstsq(design, y[exact], rcond=None)
    scatter = float(np.std(y[exact] - design @ beta))
    if not scatter > 1e-12 * max(1.0, float(np.abs(y).max())):
        raise FitError(
            "the responses lie on a line without any scatter: there is nothing to infer POD from; give measured responses"
        )
    line = _Line(
        rows=rows,
        exact=exact,
        left=is_left,
        right=is_right & ~is_left,
        jacobian=jacobian,
        q=np.zeros(3),
        log_likelihood=0.0,
    )
    start = np.array([beta[0] / scatter, beta[1] / scatter, 1 / scatter])
    q, value = line.maximise(start, np.eye(3), np.zeros(3))
    return replace(line, q=q, log_likelihood=value)


def _tests_of_line(line: _Line, x: Array) -> tuple[float | None, float | None]:
    """p-values of a likelihood-ratio test against a parabola, and of a score test against a scatter exp(x) times as wide.

    Both heed censoring. The score test estimates its variance from the rows, so it needs no normal kurtosis.
    None where there are too few rows or sizes. Source: Koenker, J. Econometrics 17 (1981) 107 (the test of the scatter).
    """
    from scipy.special import gammaincc

    if line.exact.sum() < _FEWEST_TO_TEST or len(np.unique(x[line.exact])) < 3:
        return None, None
    u = (x - x.mean()) / x.std()
    bent = replace(line, rows=np.column_stack((line.rows, -(u**2))))
    try:
        _, value = bent.maximise(np.append(line.q, 0.0), np.eye(4), np.zeros(4))
    except (FitError, np.linalg.LinAlgError):
        return None, None
    p_line = float(gammaincc(0.5, max(value - line.log_likelihood, 0.0)))
    _, first, _ = line.terms(line.q)
    # d ln L / d ln tau of each row, times u
    push = -u * (first * (line.rows @ line.q) + line.exact)
    scores = line.score_rows(line.q)
    rest = push - scores @ np.linalg.lstsq(scores, push, rcond=None)[0]
    p_scatter = float(gammaincc(0.5, 0.5 * push.sum() ** 2 / max(float(rest @ rest), 1e-300)))
    return p_line, p_scatter


def _bound(line: _Line, threshold: float, x90: float, first: float, allowed: float) -> float | None:
    """The x beside x90, on the side of `first`, where holding POD 90 % there costs `allowed` in twice the
    likelihood.
    """
    from scipy.optimize import brentq

    eta = _PROBIT.eta_from_pod(0.9)
    state = line.q[1:].copy()

    def excess(at: float) -> float:
        nonlocal state
        # gamma0 = eta - gamma1 at + h threshold
        basis = np.array([[-at, threshold], [1.0, 0.0], [0.0, 1.0]])
        state, value = line.maximise(state, basis, np.array([eta, 0.0, 0.0]))
        return 2 * (line.log_likelihood - value) - allowed

    inside, outside = x90, x90 + first
    for _ in range(40):
        if excess(outside) > 0:
            return float(brentq(excess, inside, outside, xtol=1e-12 * (1 + abs(x90))))
        inside, outside = outside, outside + 1.6 * (outside - inside)
    return None


def _checked(size: ArrayLike, response: ArrayLike, *, log_size: bool) -> tuple[Array, Array]:
    columns: dict[str, Any] = {}
    for name, values in (("size", size), ("response", response)):
        column = np.asarray(values, dtype=float)
        if column.ndim != 1 or not np.all(np.isfinite(column)):
            raise InputError(name, received="missing or infinite values", expected="one column of finite numbers")
        columns[name] = column
    x, y = columns["size"], columns["response"]
    if len(x) != len(y) or len(x) < 3:
        raise InputError(
            "response", received=f"{len(y)} rows for {len(x)} sizes", expected="three or more, as many each"
        )
    if log_size:
        if not np.all(x > 0):
            raise InputError("size", received=f"{float(x.min()):g}", expected="sizes above 0 on log size")
        x = np.log(x)
    return x, y
