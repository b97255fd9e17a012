"""Model choice, shown: every link on size and on log size, by deviance, AIC and goodness of fit.

A curve that ends below 1, or begins above 0, joins them where it fits better than the same link from 0 to 1.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import FitError
from .hit_miss import NO_BOUNDS, Bounds, PodFit, fit_pooled, trusted_bound
from .lapse import fit_lapse_pod, lapse_aic
from .likelihood import Curve
from .links import LINKS, Link
from .solver import fit_batch
from .trials import Trials

Array = NDArray[np.float64]

_ALIKE = 2.0  # in AIC: substantial support (Burnham & Anderson 2002, 2.6)


@dataclass(frozen=True, slots=True, kw_only=True)
class Alternative:
    """One link and scale on the same trials. deviance, aic: smaller fits better; a90 in the data's unit or None.

    ceiling, floor: where the curve ends and begins, as fitted; None: at 1 and at 0.

    a90_95, a90_low, a90_high: its one-sided 95 % bound and the ends of its two-sided 95 % interval, None as in `PodFit`.

    p_link: p-value of Pregibon's link test (small: the curve has another shape than this link gives it).
    p_fit: p-value of a chi-square test of hits over up to ten groups of size (Hosmer & Lemeshow), None with few trials.
    """

    link: str
    log_size: bool
    deviance: float | None
    aic: float | None
    a90: float | None
    p_link: float | None
    p_fit: float | None
    a90_95: float | None = None
    a90_low: float | None = None
    a90_high: float | None = None
    ceiling: float | None = None
    floor: float | None = None

    @property
    def name(self) -> str:
        """The curve in words: scale, link, ceiling or floor."""
        ends = [
            f"{word} {value:.3g}"
            for word, value in (("ceiling", self.ceiling), ("floor", self.floor))
            if value is not None
        ]
        return " ".join([*(["ln"] if self.log_size else []), self.link, *ends])


@dataclass(frozen=True, slots=True, kw_only=True)
class OverLinks:
    """What the links and scales say together that fit as well as the best one, and the one that was chosen.

    Fields: curves (their names, `ln` before those on log size, a ceiling or floor after); a90_lowest, a90_highest;
    a90_95, a90_low, a90_high: the farthest of their bounds. None where one of them gives none.
    """

    curves: tuple[str, ...]
    a90_lowest: float | None
    a90_highest: float | None
    a90_95: float | None
    a90_low: float | None
    a90_high: float | None


def over_links(found: tuple[Alternative, ...], *, link: str, log_size: bool) -> OverLinks | None:
    """The alternatives whose AIC is within 2 of the best, joined; None where there is none with an AIC.

    One link's interval takes its shape as known, and small tables cannot tell shapes (VALIDATION pod-29).
    Source: Burnham & Anderson, Model Selection and Multimodel Inference (2002), 2.6 (AIC within 2: substantial support).
    """
    known = [one for one in found if one.aic is not None]
    if not known:
        return None
    best = min(one.aic for one in known if one.aic is not None)
    chosen = ("ln " if log_size else "") + link
    alike = [one for one in known if (one.aic is not None and one.aic <= best + _ALIKE) or one.name == chosen]

    def farthest(pick: Callable[[list[float]], float], name: str) -> float | None:
        values = [getattr(one, name) for one in alike]
        return None if None in values else pick(values)

    return OverLinks(
        curves=tuple(one.name for one in alike),
        a90_lowest=farthest(min, "a90"),
        a90_highest=farthest(max, "a90"),
        a90_95=farthest(max, "a90_95"),
        a90_low=farthest(min, "a90_low"),
        a90_high=farthest(max, "a90_high"),
    )


def better_curve(found: tuple[Alternative, ...], fit: PodFit) -> Alternative | None:
    """The best of the alternatives where a fit has another link or scale and is not among those that fit as well; else None."""
    best = next((one for one in found if one.aic is not None), None)
    if best is None or best.aic is None or fit.aic is None or fit.method != "ml":
        return None
    return best if fit.aic > best.aic + _ALIKE else None


def with_links_open(
    fit: PodFit, found: tuple[Alternative, ...], *, named: bool
) -> tuple[PodFit, OverLinks | None, str | None]:
    """A pooled fit beside all curves that were tried on the same trials.

    Args:
        fit: as `fit_pod` gives it.
        found: as `compare_models` gives them.
        named: whether the fit's link was asked for.

    Returns:
        The fit, its bounds as wide as those of all curves that fit where another one fits better and no link was asked for; those
        curves joined; a warning where another one fits better. Of clusters the fit as it came, None and the warning; the fit and two
        times None of random effects, and where hits and misses separate or the fit is not the most likely one.
    """
    times = _looks_a_trial(fit)
    if times is None or fit.method != "ml" or fit.separated:
        return fit, None, None
    found = tuple(replace(one, aic=_criterion(one.aic, one.deviance, times)) for one in found)
    own = replace(fit, aic=_criterion(fit.aic, fit.deviance, times))
    joined = over_links(found, link=fit.link, log_size=fit.log_size)
    if joined is None:
        return fit, None, None
    best = better_curve(found, own)
    if best is None:
        return fit, joined if fit.repeats == "pooled" else None, None
    clusters = fit.repeats != "pooled"
    told = f"another curve fits better: {best.name} ({'QAIC' if clusters else 'AIC'} lower by"
    told += f" {(own.aic or 0.0) - (best.aic or 0.0):.3g}"
    if clusters:
        a90 = "none" if best.a90 is None else f"{best.a90:.4g}"
        return fit, None, f"{told}, a90 {a90}); bounds of repeated looks take the link as known"
    if not named and _ends_below_90(best):
        told += "); it ends below 90 %, so there is no a90"
    else:
        told += f", a90 {'none' if best.a90 is None else f'{best.a90:.4g}'}); "
        told += (
            "bounds of all curves that fit stand in over_links" if named else "bounds are those of all curves that fit"
        )
        if not named:
            told += _without_bounds([one for one in found if one.name in joined.curves])
    return fit if named else _widened(fit, joined, best), joined, told


def _looks_a_trial(fit: PodFit) -> float | None:
    """How many looks count as one: 1 of independent ones; of clusters the slope's variance over that of such; None: not known."""
    if fit.repeats == "pooled":
        return 1.0
    if fit.clustered is None or fit.naive is None or not fit.naive.se1:
        return None
    slope = np.array([0.0, 1.0])
    # what a curve of another shape does to both is no repeat
    independent = float(fit.clustered.cells[1, 1]) or fit.naive.se1**2
    return max(float(fit.clustered.variance(slope)[0]) / independent, 1.0)


def _criterion(aic: float | None, deviance: float | None, times: float) -> float | None:
    """AIC where so many looks count as one: QAIC (Burnham & Anderson 2002, 2.5)."""
    return None if aic is None or deviance is None else deviance / times + (aic - deviance)


def _without_bounds(alike: list[Alternative]) -> str:
    """Which bounds on a90 curves that fit have not together, and for want of which of them; nothing where all are there."""
    upper = [one.name for one in alike if one.a90_95 is None]
    told = ""
    for what, names in (
        ("upper bound", upper),
        (
            "upper end of a two-sided interval",
            [one.name for one in alike if one.a90_high is None and one.name not in upper],
        ),
        ("lower end of a two-sided interval", [one.name for one in alike if one.a90_low is None]),
    ):
        if names:
            told += (
                f"; there is no {what}, as {', '.join(names)} may be right and {'have' if names[1:] else 'has'} none"
            )
    return told


def _ends_below_90(curve: Alternative) -> bool:
    """Whether a curve has a ceiling of 90 % at most."""
    return curve.ceiling is not None and curve.ceiling <= 0.9


def _widened(fit: PodFit, joined: OverLinks, best: Alternative) -> PodFit:
    """A fit whose bounds on a90 reach as far as those of all curves together; None where one of these has none.

    best: the curve that fits better than this one. Where it ends below 90 %, there is no a90.
    """
    if _ends_below_90(best):
        without = replace(fit, a90=None, reaches_90=False)
        return replace(without, a90_95=NO_BOUNDS, a90_95_two_sided=NO_BOUNDS, a90_low_two_sided=NO_BOUNDS)

    def farther(bounds: Bounds, end: float | None, pick: Callable[..., float]) -> Bounds:
        own = {name: value for name, value in asdict(bounds).items() if value is not None}
        return Bounds(**{name: None if end is None else pick(value, end) for name, value in own.items()})

    return replace(
        fit,
        a90_95=farther(fit.a90_95, joined.a90_95, max),
        a90_95_two_sided=farther(fit.a90_95_two_sided, joined.a90_high, max),
        a90_low_two_sided=farther(fit.a90_low_two_sided, joined.a90_low, min),
    )


def compare_models(table: Trials) -> tuple[Alternative, ...]:
    """All links on size and, where every size is above 0, on log size, and what they fit with a ceiling or floor; best AIC first.

    The trials are taken as independent: with repeats the differences of deviance are too large, their order stands.
    Source: Pregibon, Appl. Stat. 29 (1980) 15; Hosmer & Lemeshow, Commun. Stat. A 9 (1980) 1043.
    """
    scales = (False, True) if np.all(table.size > 0) else (False,)
    found: list[Alternative] = []
    curves: list[tuple[Alternative, Curve]] = []
    for name, link in LINKS.items():
        for log_size in scales:
            try:
                fit = fit_pooled(table, link=link, log_size=log_size, method="ml")
            except FitError:
                continue
            p_link, p_fit = (None, None) if fit.curve is None else goodness_of_fit(fit, link=link)
            found.append(
                Alternative(
                    link=name,
                    log_size=log_size,
                    deviance=fit.deviance,
                    aic=fit.aic,
                    a90=fit.a90,
                    p_link=p_link,
                    p_fit=p_fit,
                    a90_95=trusted_bound(fit.a90_95, separated=fit.separated),
                    a90_low=trusted_bound(fit.a90_low_two_sided, separated=fit.separated),
                    a90_high=trusted_bound(fit.a90_95_two_sided, separated=fit.separated),
                )
            )
            if fit.curve is not None:
                curves.append((found[-1], fit.curve))
    found += _with_ends(table, curves)
    return tuple(sorted(found, key=lambda one: np.inf if one.aic is None else one.aic))


def _with_ends(table: Trials, plain: list[tuple[Alternative, Curve]]) -> list[Alternative]:
    """Curves with a ceiling or a floor that fit better than the same link without, and about as well as the best of all."""
    known = [(one, curve, one.aic) for one, curve in plain if one.aic is not None]
    tried = []
    for one, curve, own in known:
        for end in ("ceiling", "floor"):
            aic = lapse_aic(curve, ceiling=end == "ceiling", floor=end == "floor")
            if aic < own:
                tried.append((aic, aic - own, one, end))
    best = min([aic for aic, *_ in tried] + [own for *_, own in known], default=np.inf)
    found = []
    for aic, gain, one, end in tried:
        if aic > best + _ALIKE:
            continue
        top, bottom = end == "ceiling", end == "floor"
        fit = fit_lapse_pod(table, link=one.link, log_size=one.log_size, ceiling=top, floor=bottom)
        found.append(
            Alternative(
                link=one.link,
                log_size=one.log_size,
                deviance=None if one.deviance is None else one.deviance + gain - 2.0,
                aic=aic,
                a90=fit.a90,
                p_link=None,
                p_fit=None,
                a90_95=fit.a90_95,
                a90_low=fit.a90_low_two_sided,
                a90_high=fit.a90_95_two_sided,
                ceiling=fit.ceiling.value if top else None,
                floor=fit.floor.value if bottom else None,
            )
        )
    return found


def goodness_of_fit(fit: PodFit, *, link: Link) -> tuple[float | None, float | None]:
    """p-values of the link test and of the grouped chi-square test of a fit; None where it cannot be made."""
    from scipy.special import gammaincc

    curve = fit.curve
    if curve is None:
        return None, None
    eta = curve.coefficients[0] + curve.coefficients[1] * curve.x
    centred = (eta - eta.mean()) / (eta.std() or 1.0)
    p_link = None
    if len(curve.x) > 3:
        design = np.stack((np.ones_like(eta), centred, centred**2), axis=1)
        batch = fit_batch(design, curve.hits[None], curve.misses[None], link=link)
        if batch.converged[0]:
            gain = 2 * (float(batch.log_likelihood[0]) - curve.supremum) / curve.divisor
            p_link = float(gammaincc(0.5, max(gain, 0.0) / 2))
    return p_link, _grouped_test(curve.hits, curve.misses, link.pod_from_eta(eta))


def _grouped_test(hits: Array, misses: Array, pod: Array) -> float | None:
    from scipy.special import gammaincc

    total = hits + misses
    groups = int(min(10, total.sum() // 8))
    if groups < 4:
        return None
    order = np.argsort(pod)
    rank = np.cumsum(total[order]) - 0.5 * total[order]
    where = np.minimum((rank / total.sum() * groups).astype(int), groups - 1)
    observed = np.bincount(where, weights=hits[order], minlength=groups)
    expected = np.bincount(where, weights=(total * pod)[order], minlength=groups)
    variance = np.bincount(where, weights=(total * pod * (1 - pod))[order], minlength=groups)
    used = variance > 1e-9
    if used.sum() < 4:
        return None
    statistic = float((((observed - expected) ** 2)[used] / variance[used]).sum())
    return float(gammaincc((used.sum() - 2) / 2, statistic / 2))
