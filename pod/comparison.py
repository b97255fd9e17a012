"""Are two POD curves the same? Real against generated, before against after.

difference = a90_second - a90_first, ratio = a90_second / a90_first, both with 95 % intervals built from the two
curves' own likelihood intervals (MOVER), with their correlation where the two share images or networks. There they are at least
as long as Student's interval of the jackknifed difference (`paired_spread.py`). Few networks enter by Student's quantile, in
intervals and tests. Verdict at a stated margin on the ratio by two one-sided tests: equivalent
when the 90 % interval of the ratio lies within [1 / (1 + m), 1 + m]; and, where a margin in the sizes' unit is stated, when the
90 % interval of the difference lies within [-m, m].
Source: Zou & Donner, Stat. Med. 27 (2008) 1693, doi:10.1002/sim.3095; Schuirmann, J. Pharmacokin. Biopharm. 15 (1987)
657.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError, InputError, check_number
from .crossed import usable_factors
from .few_groups import ONE_SIDED, TWO_SIDED, student_quantile
from .hit_miss import PodFit, trusted_bound
from .likelihood import Curve
from .links import LINKS
from .mixed import fit_mixed
from .models import compare_models, with_links_open
from .paired_spread import DifferenceSpread, difference_spread
from .repeats import fit_trials
from .robust import bread, clustered_meat, clustered_total, score_rows
from .solver import fit_batch
from .trials import Trials

Array = NDArray[np.float64]

_NAMES = ("first", "second")  # of the tables, in messages
_LEAST_EIGENVALUE = 1e-10  # of a matrix of correlations: one below it is rounding, as in `robust.leave_out`
_MOST_ALIKE = 0.99  # correlation of two a90 that intervals take: 1 would say that the difference is known exactly


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """An estimate with its two-sided 95 % interval; an end is None where the data give none."""

    value: float | None
    low: float | None
    high: float | None


_EMPTY = Interval(value=None, low=None, high=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class CurveTest:
    """Test that one curve serves both tables.

    Fields: statistic, which p belongs to: chi-square on degrees_of_freedom, or F on these and denominator_degrees (None: chi-square);
    p; kind (how it was made).
    """

    statistic: float
    degrees_of_freedom: int
    p: float
    kind: str
    denominator_degrees: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeEquivalence:
    """Two one-sided tests of the difference of two a90 at a margin in the sizes' unit.

    Fields: margin; low, high (90 % interval of the difference; None where the data give none); verdict (`equivalent`,
    `different within the margin`, `different` or `inconclusive`).
    """

    margin: float
    low: float | None
    high: float | None
    verdict: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Two POD curves beside each other; sizes in the tables' unit.

    difference_a90 (second - first) and ratio_a90 (second / first); equivalence_low, equivalence_high: 90 % interval of
    the ratio; p_equivalence: the larger of the two one-sided p-values; correlation: of the two a90, from shared images
    and networks; paired: what is shared (`image`, `network`, `image and network`, `nothing`); size_equivalence: at a margin in
    the sizes' unit, None where none was stated; correlation_at_bound: the spreads of both a90 and of their difference ask for
    a correlation above 1, which is none: the interval of the difference is that of a90 that share nothing.
    """

    first: PodFit
    second: PodFit
    difference_a90: Interval
    ratio_a90: Interval
    margin: float
    equivalence_low: float | None
    equivalence_high: float | None
    p_equivalence: float | None
    verdict: str
    correlation: float
    paired: str
    curve_test: CurveTest | None
    warnings: tuple[str, ...]
    size_equivalence: SizeEquivalence | None = None
    correlation_at_bound: bool = False


def compare_pod(
    first: Trials,
    second: Trials,
    *,
    link: str = "cloglog",
    log_size: bool = False,
    method: str = "auto",
    repeats: str = "pooled",
    margin: float = 0.1,
    size_margin: float | None = None,
    shared_images: bool = False,
    shared_networks: bool = False,
    link_named: bool = True,
) -> Comparison:
    """Compare the a90 of two tables of trials; sizes in the tables' unit.

    Args:
        first, second: the trials; where images or networks are shared, their codes must mean the same in both.
        link: the link's name, for both.
        log_size: fit on ln size.
        method: see `fit_pod`.
        repeats: see `fit_pod`, for both.
        margin: m of the equivalence test, as a share of a90 (0.1: within some 10 %).
        size_margin: also a test of the difference at this margin, in the tables' unit.
        shared_images, shared_networks: whether the same images and networks stand in both (the comparison is paired).
        link_named: the link is meant; else bounds are those of all curves that fit, where another one fits a table better.

    Raises:
        InputError: a margin that is no share above 0 and below 1.
    """
    _check_margins(margin, size_margin)
    tables = (first, second)
    fits, repeats, notes = _fits_alike(tables, link=link, log_size=log_size, method=method, repeats=repeats)
    if not link_named:
        fits, told = _with_links_open(fits, tables)
        notes += told
    pairs = [word for word, given in (("image", shared_images), ("network", shared_networks)) if given]
    correlation, spread = _shared_luck(first, second, fits, log_size=log_size, shared=pairs, repeats=repeats)
    # rounding may ask for a little more than 1
    at_bound = correlation > 1.0 + 1e-9
    # what is shared moves both alike; an estimate below 0 is noise of few images or networks
    correlation = min(max(correlation, 0.0), _MOST_ALIKE)
    if at_bound:
        # what the two share narrows the interval: without it, it is as wide as it can be
        correlation = 0.0
        notes.append(
            "the difference spreads less than any correlation of the two a90 allows: its interval is that of a90 that share nothing"
        )
    sizes = _compare_a90(fits, margin=margin, correlation=correlation, spread=spread)
    notes += sizes.notes
    test = None
    if all(fit.curve is not None and not fit.separated for fit in fits):
        test = _curve_test(first, second, link=link, log_size=log_size, repeats=repeats, fits=fits, shared=pairs)
        if test is None:
            notes.append(
                "no test of the whole curves: the fit of both together did not converge, or too few networks or images tell how much"
                " they differ"
            )
    else:
        notes.append("no test of the whole curves where one of the tables has no most likely curve")
    return Comparison(
        first=fits[0],
        second=fits[1],
        difference_a90=sizes.difference,
        ratio_a90=sizes.ratio,
        margin=margin,
        equivalence_low=sizes.low90,
        equivalence_high=sizes.high90,
        p_equivalence=sizes.p,
        verdict=sizes.verdict,
        correlation=correlation,
        paired=" and ".join(pairs) or "nothing",
        curve_test=test,
        warnings=tuple(notes),
        correlation_at_bound=at_bound,
        size_equivalence=None
        if size_margin is None
        else _size_equivalence(fits, sizes.difference, margin=size_margin, correlation=correlation, spread=spread),
    )


def _check_margins(margin: float, size_margin: float | None) -> None:
    check_number("margin", margin)
    if not 0 < margin < 1:
        raise InputError("margin", received=margin, expected="a share of a90 above 0 and below 1: 0.1 is 10 %")
    if size_margin is not None:
        check_number("size margin", size_margin)
    if size_margin is not None and not (math.isfinite(size_margin) and size_margin > 0):
        raise InputError("size margin", received=size_margin, expected="a positive size, in the unit of the tables")


def _fits_alike(
    tables: tuple[Trials, Trials], *, link: str, log_size: bool, method: str, repeats: str
) -> tuple[tuple[PodFit, ...], str, list[str]]:
    """Both curves, the treatment of repeats that both have, and what was said of each."""

    def fit_of(table: Trials, repeats: str) -> PodFit:
        return fit_trials(_compressed(table), link=link, log_size=log_size, method=method, repeats=repeats)

    fits = tuple(fit_of(table, repeats) for table in tables)
    again: list[str] = []
    if repeats == "crossed" and any(fit.repeats == "cluster" for fit in fits):
        # no crossed fit of one table: both are treated alike, and so is the test of the curves
        repeats = "cluster"
        again = [
            f"{name}: clustered as well (repeats cluster), as the other table has no crossed fit"
            for name, fit in zip(_NAMES, fits, strict=True)
            if fit.repeats != "cluster"
        ]
        fits = tuple(
            fit if fit.repeats == "cluster" else fit_of(table, repeats) for table, fit in zip(tables, fits, strict=True)
        )
    notes = [f"{name}: {note}" for name, fit in zip(_NAMES, fits, strict=True) for note in fit.warnings]
    return fits, repeats, [*again, *notes]


def _with_links_open(fits: tuple[PodFit, ...], tables: tuple[Trials, Trials]) -> tuple[tuple[PodFit, ...], list[str]]:
    """Both fits with the bounds of all curves that fit their table, where another link fits better; and what to say of it."""
    opened = [with_links_open(fit, compare_models(table), named=False) for fit, table in zip(fits, tables, strict=True)]
    notes = [f"{name}: {told}" for name, (*_, told) in zip(_NAMES, opened, strict=True) if told]
    return tuple(fit for fit, *_ in opened), notes


@dataclass(frozen=True, slots=True, kw_only=True)
class _ComparedSizes:
    """Difference and ratio of two a90, the 90 % interval of the ratio, the larger one-sided p, the verdict."""

    difference: Interval = _EMPTY
    ratio: Interval = _EMPTY
    low90: float | None = None
    high90: float | None = None
    p: float | None = None
    verdict: str = "inconclusive"
    notes: tuple[str, ...] = ()


def _compare_a90(
    fits: tuple[PodFit, ...], *, margin: float, correlation: float, spread: DifferenceSpread | None
) -> _ComparedSizes:
    """The two a90 compared; `margin` is on their ratio, `spread` of what they share."""
    a, b = fits[0].a90, fits[1].a90
    if a is None or b is None:
        return _ComparedSizes(notes=("one of the curves has no a90: nothing to compare there",))
    difference = _at_least(
        _mover(b, a, *_ends(fits[1], 1.0), *_ends(fits[0], 1.0), correlation), _reach(spread, TWO_SIDED, of_log=False)
    )
    if a <= 0 or b <= 0:
        told = "sizes are not all above 0 (a log scale?): no ratio and no equivalence test"
        return _ComparedSizes(difference=difference, notes=(told,))
    middle = math.log(b / a)
    logs = _at_least(
        _mover(math.log(b), math.log(a), *_log_ends(fits[1], 1.0), *_log_ends(fits[0], 1.0), correlation),
        _reach(spread, TWO_SIDED, of_log=True),
    )
    ratio = Interval(value=b / a, low=_exp(logs.low), high=_exp(logs.high))
    shares = _arms_of_90(fits)
    short = _at_least(
        _mover(math.log(b), math.log(a), *_log_ends(fits[1], shares[1]), *_log_ends(fits[0], shares[0]), correlation),
        _reach(spread, ONE_SIDED, of_log=True),
    )
    low90, high90 = _exp(short.low), _exp(short.high)
    edge = math.log1p(margin)
    inside = low90 is not None and high90 is not None and low90 > math.exp(-edge) and high90 < math.exp(edge)
    apart = (ratio.low is not None and ratio.low > 1) or (ratio.high is not None and ratio.high < 1)
    return _ComparedSizes(
        difference=difference,
        ratio=ratio,
        low90=low90,
        high90=high90,
        p=_p_equivalence(
            middle, logs, edge, min([*_freedoms(fits), math.inf if spread is None else spread.degrees_of_freedom])
        ),
        verdict=_verdict(inside=inside, apart=apart),
    )


def _exp(log: float | None) -> float | None:
    return None if log is None else math.exp(log)


def _freedoms(fits: tuple[PodFit, ...]) -> list[float]:
    """Degrees of freedom of each fit, infinite where it has many."""
    return [math.inf if fit.degrees_of_freedom is None else fit.degrees_of_freedom for fit in fits]


def _arms_of_90(fits: tuple[PodFit, ...]) -> list[float]:
    """By how much the arms of each 95 % interval shorten to 90 %, which is exact for a quadratic log-likelihood."""
    return [float(student_quantile(ONE_SIDED, m) / student_quantile(TWO_SIDED, m)) for m in _freedoms(fits)]


def _size_equivalence(
    fits: tuple[PodFit, ...],
    difference: Interval,
    *,
    margin: float,
    correlation: float,
    spread: DifferenceSpread | None,
) -> SizeEquivalence:
    """Verdict on the difference of the two a90."""
    a, b = fits[0].a90, fits[1].a90
    if a is None or b is None:
        return SizeEquivalence(margin=margin, low=None, high=None, verdict="inconclusive")
    shares = _arms_of_90(fits)
    short = _at_least(
        _mover(b, a, *_ends(fits[1], shares[1]), *_ends(fits[0], shares[0]), correlation),
        _reach(spread, ONE_SIDED, of_log=False),
    )
    inside = short.low is not None and short.high is not None and short.low > -margin and short.high < margin
    apart = (difference.low is not None and difference.low > 0) or (difference.high is not None and difference.high < 0)
    return SizeEquivalence(margin=margin, low=short.low, high=short.high, verdict=_verdict(inside=inside, apart=apart))


def _verdict(*, inside: bool, apart: bool) -> str:
    if inside:
        return "different within the margin" if apart else "equivalent"
    return "different" if apart else "inconclusive"


def _compressed(table: Trials) -> Trials:
    """The table with codes that count only its own networks, images and sites."""
    codes = {name: getattr(table, name) for name in ("network", "image", "site")}
    packed = {
        name: None if one is None else np.unique(one, return_inverse=True)[1].astype(np.intp)
        for name, one in codes.items()
    }
    return replace(table, network=packed["network"], image=packed["image"], site=packed["site"])


def _ends(fit: PodFit, share: float) -> tuple[float | None, float | None]:
    """Two-sided interval of a90, its arms shortened to `share`: modified likelihood ratio where there is one."""
    ends: list[float | None] = []
    for bounds in (fit.a90_low_two_sided, fit.a90_95_two_sided):
        end = trusted_bound(bounds, separated=fit.separated)
        ends.append(None if end is None or fit.a90 is None else fit.a90 + share * (end - fit.a90))
    return ends[0], ends[1]


def _log_ends(fit: PodFit, share: float) -> tuple[float | None, float | None]:
    low, high = _ends(fit, 1.0)
    middle = math.log(fit.a90) if fit.a90 is not None and fit.a90 > 0 else math.nan
    found = [
        middle + share * (math.log(end) - middle) if end is not None and end > 0 and math.isfinite(middle) else None
        for end in (low, high)
    ]
    return found[0], found[1]


def _mover(
    b: float, a: float, b_low: float | None, b_high: float | None, a_low: float | None, a_high: float | None, r: float
) -> Interval:
    """Interval of b - a from the intervals of b and a and their correlation."""

    def arm(one: float, two: float) -> float:
        return math.sqrt(max(one * one + two * two - 2 * r * one * two, 0.0))

    low = None if b_low is None or a_high is None else b - a - arm(b - b_low, a_high - a)
    high = None if b_high is None or a_low is None else b - a + arm(b_high - b, a - a_low)
    return Interval(value=b - a, low=low, high=high)


def _reach(spread: DifferenceSpread | None, below: float, *, of_log: bool) -> float:
    """Half of Student's interval of the jackknifed difference, or of the log of the ratio; 0 where there is none."""
    if spread is None:
        return 0.0
    sd = spread.sd_of_log if of_log else spread.sd
    return float(student_quantile(below, spread.degrees_of_freedom)) * sd if math.isfinite(sd) else 0.0


def _at_least(interval: Interval, reach: float) -> Interval:
    """The interval, both arms stretched alike to twice `reach` where it is shorter."""
    if interval.value is None or interval.low is None or interval.high is None:
        return interval
    below, above = interval.value - interval.low, interval.high - interval.value
    if not 0 < below + above < 2 * reach:
        return interval
    stretch = 2 * reach / (below + above)
    return replace(interval, low=interval.value - stretch * below, high=interval.value + stretch * above)


def _p_equivalence(middle: float, logs: Interval, edge: float, freedom: float) -> float | None:
    """The larger p of the two one-sided tests of |ln ratio| >= edge, each with the spread of its own side."""
    from scipy.special import ndtr, stdtr

    if logs.low is None or logs.high is None:
        return None
    quantile = float(student_quantile(TWO_SIDED, freedom))
    spread_low, spread_high = (middle - logs.low) / quantile, (logs.high - middle) / quantile
    if not (spread_low > 0 and spread_high > 0):
        return None
    deviations = -(middle + edge) / spread_low, (middle - edge) / spread_high
    return max(float(stdtr(freedom, one) if math.isfinite(freedom) else ndtr(one)) for one in deviations)


def _shared_luck(
    first: Trials, second: Trials, fits: tuple[PodFit, ...], *, log_size: bool, shared: list[str], repeats: str
) -> tuple[float, DifferenceSpread | None]:
    """Correlation of the two a90 from what they share, as estimated, and the spread of their difference; 0 and None: nothing.

    Both are of the pooled curves. Where looks are taken as independent, only a look at the same image by the same network pairs.
    """
    curves = [fit.curve for fit in fits if fit.curve is not None and fit.c1 is not None and fit.c1 > 0]
    if (
        not shared
        or len(curves) < 2
        or any(fit.separated or not curve.coefficients[1] > 0 for fit, curve in zip(fits, curves, strict=True))
    ):
        return 0.0, None
    if repeats == "pooled":
        return _correlation_of_looks(first, second, curves, log_size=log_size, shared=shared), None
    spread = difference_spread((first, second), curves, shared=shared, log_size=log_size)
    return (0.0, None) if spread is None else (spread.correlation, spread)


def _correlation_of_looks(
    first: Trials, second: Trials, curves: list[Curve], *, log_size: bool, shared: list[str]
) -> float:
    """Correlation of the two a90 where looks are independent, but for those at the same image by the same network.

    Each look adds to a90 what its score says; summed over both tables with opposite signs these make the difference.
    """
    influences, errors = [], []
    for table, curve, sign in zip((first, second), curves, (-1.0, 1.0), strict=True):
        x90 = (curve.link.eta_from_pod(0.9) - curve.coefficients[0]) / curve.coefficients[1]
        gradient = -np.array([1.0, x90]) / curve.coefficients[1]
        errors.append(math.sqrt(float(gradient @ curve.covariance @ gradient)))
        scores = score_rows(table, curve, log_size=log_size)
        influences.append(sign * scores @ bread(table, curve, log_size=log_size) @ gradient)
    both = _stacked(first, second, shared)
    codes = [one for one in (both.network, both.image) if one is not None]
    if not codes or not all(error > 0 for error in errors):
        return 0.0
    looks = np.unique(np.stack(codes, axis=1), axis=0, return_inverse=True)[1].ravel().astype(np.intp)
    of_difference, freedom = clustered_total(np.concatenate(influences), [looks])
    arm = (
        math.sqrt(of_difference)
        * float(student_quantile(TWO_SIDED, freedom))
        / float(student_quantile(TWO_SIDED, math.inf))
    )
    return (errors[0] ** 2 + errors[1] ** 2 - arm**2) / (2 * errors[0] * errors[1])


def _curve_test(
    first: Trials,
    second: Trials,
    *,
    link: str,
    log_size: bool,
    repeats: str,
    fits: tuple[PodFit, ...],
    shared: list[str],
) -> CurveTest | None:
    """One curve for both against two: likelihood ratio, 2 degrees of freedom."""
    shape = LINKS[link]
    both = _stacked(first, second, shared)
    x = np.log(both.size) if log_size else both.size
    group = np.concatenate((np.zeros(len(first.size)), np.ones(len(second.size))))
    centred = x - x.mean()
    small = np.stack((np.ones_like(x), centred), axis=1)
    large = np.stack((np.ones_like(x), centred, group, group * centred), axis=1)
    if repeats == "crossed":
        # what the noise of one table does to an image is shared by its networks, and not by the other table: an image of each
        # table has an effect of its own (what both tables have in common only makes the test say less)
        factors, _, _ = usable_factors(_stacked(first, second, [name for name in shared if name != "image"]))
        if factors:
            try:
                values = [
                    fit_mixed(design, both.hits, both.misses, factors=factors, link=shape).deviance
                    for design in (small, large)
                ]
            except FitError:
                return None
            kind = "likelihood ratio with crossed random effects"
            return _test(values[0] - values[1], kind)
    found = [
        float(fit_batch(design, both.hits[None], both.misses[None], link=shape).log_likelihood[0])
        for design in (small, large)
    ]
    if not all(math.isfinite(value) for value in found):
        return None
    statistic = 2 * (found[1] - found[0])
    kind = "likelihood ratio"
    if repeats == "cluster":
        return _robust_test(first, second, both, fits=fits, log_size=log_size)
    if repeats == "scaled":
        inflation = [_inflation(fit) for fit in fits]
        statistic /= max(float(np.mean(inflation)), 1e-12)
        kind = "likelihood ratio divided by the mean inflation of the curves' variances by repeats"
    return _test(statistic, kind)


def _robust_test(
    first: Trials, second: Trials, both: Trials, *, fits: tuple[PodFit, ...], log_size: bool
) -> CurveTest | None:
    """Hotelling's test of equal (c0, c1) with the clustered covariance of their difference; None below three clusters.

    Of the covariances by network, by image and by both the one is taken that speaks least against equality.
    """
    from scipy.special import fdtrc

    influences = []
    for table, fit, sign in zip((first, second), fits, (-1.0, 1.0), strict=True):
        if fit.curve is None:
            return None
        scores = score_rows(table, fit.curve, log_size=log_size)
        influences.append(sign * scores @ bread(table, fit.curve, log_size=log_size))
    rows = np.concatenate(influences)
    codes = [one for one in (both.network, both.image) if one is not None]
    if not codes:
        return None
    change = np.array([(fits[1].c0 or 0.0) - (fits[0].c0 or 0.0), (fits[1].c1 or 0.0) - (fits[0].c1 or 0.0)])
    statistics = []
    for groups in [[one] for one in codes] + ([codes] if len(codes) > 1 else []):
        statistic = _distance(change, clustered_meat(rows, rows, groups))
        if statistic is not None:
            statistics.append(statistic)
    if not statistics:
        return None
    fewest = min(int(one.max()) + 1 for one in codes)
    degrees = fewest - 2
    if degrees < 1:
        return None
    # Hotelling: T^2 (G - 2) / (2 (G - 1)) is F with 2 and G - 2 degrees of freedom
    value = max(min(statistics), 0.0) * degrees / (2 * (fewest - 1))
    return CurveTest(
        statistic=value,
        degrees_of_freedom=2,
        denominator_degrees=degrees,
        p=float(fdtrc(2, degrees, value)),
        kind=f"Hotelling, robust to networks and images ({fewest} clusters)",
    )


def _distance(change: Array, covariance: Array) -> float | None:
    """change' covariance^-1 change, 0 where nothing changed; None where the covariance has no inverse.

    Networks that all agree differ in nothing, and have a covariance of rounding.
    """
    if not change.any():
        return 0.0
    scale = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    if not np.all(scale > 0):
        return None
    alike = covariance / np.outer(scale, scale)
    if not np.linalg.eigvalsh(alike).min() > _LEAST_EIGENVALUE:
        return None
    moved = change / scale
    return float(moved @ np.linalg.solve(alike, moved))


def _inflation(fit: PodFit) -> float:
    curve: Curve | None = fit.curve
    if curve is None or fit.naive is None or not (fit.se0 and fit.se1 and fit.naive.se0 and fit.naive.se1):
        return 1.0
    return 0.5 * ((fit.se0 / fit.naive.se0) ** 2 + (fit.se1 / fit.naive.se1) ** 2)


def _test(statistic: float, kind: str) -> CurveTest:
    value = max(statistic, 0.0)
    return CurveTest(statistic=value, degrees_of_freedom=2, p=math.exp(-value / 2), kind=kind)


def _stacked(first: Trials, second: Trials, shared: list[str]) -> Trials:
    """Both tables as one; codes that are not shared are kept apart."""
    columns: dict[str, NDArray[np.intp] | None] = {}
    for name in ("network", "image"):
        one, two = getattr(first, name), getattr(second, name)
        if one is None or two is None:
            columns[name] = None
            continue
        apart = 0 if name in shared else int(one.max()) + 1
        columns[name] = np.unique(np.concatenate((one, two + apart)), return_inverse=True)[1].astype(np.intp)
    return replace(
        first,
        size=np.concatenate((first.size, second.size)),
        hits=np.concatenate((first.hits, second.hits)),
        misses=np.concatenate((first.misses, second.misses)),
        network=columns["network"],
        image=columns["image"],
        site=None,
    )
