"""Coverage of bounds on a90 where hits or responses follow another shape than the fit, and where the data separate.

    python validation/pod_shapes.py [shapes, steep or responses] [--simulations N] [--trials N]

Sizes of hits are uniform from 0.3 to 4.5. Of `shapes`, `one link` is the default fit (cloglog on size), `over links` joins all links
and scales whose AIC is within 2 of the best (`pod.models.over_links`), `as given` has the bounds that `raytwin pod` answers: those of
one link, and where another fits better those of all. `steep` are logit curves, fitted by that link. `responses` are fitted by a line.
Shares are of the bounds that were given: one-sided 95 % bounds and two-sided 95 % intervals.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, ndtr

from raytwin.pod import LINKS, Trials, check_trials, compare_models
from raytwin.pod.hit_miss import PodFit, fit_pooled, trusted_bound
from raytwin.pod.likelihood import size_bound
from raytwin.pod.models import with_links_open
from raytwin.pod.response import fit_response_pod

SHAPES: dict[str, Callable[[Any], Any]] = {
    "cloglog": lambda s: -np.expm1(-np.exp(2.2 * (s - 2))),
    "logit": lambda s: expit(3 * (s - 2)),
    "probit": lambda s: ndtr(1.8 * (s - 2)),
    "Weibull": lambda s: -np.expm1(-((s / 2.1) ** 3.5)),
    "log-logistic": lambda s: expit(5 * np.log(s / 2)),
    "logit, floor 5 %": lambda s: 0.05 + 0.95 * expit(3 * (s - 2)),
    "logit, ceiling 97 %": lambda s: 0.97 * expit(3 * (s - 2)),
}
Row = tuple[float | None, float | None, float | None]
STEEP = {f"logit, slope {slope}": (lambda s, slope=slope: expit(slope * (s - 2))) for slope in (3, 6, 12, 25)}
ONE_SIDED_95 = 1.6449**2  # chi-square with one degree of freedom
# mean and standard deviation of the response at a size
RESPONSES: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "straight line, one scatter": (lambda s: 1 + 2 * s, lambda s: 0.6 + 0 * s),
    "cube": (lambda s: s**3, lambda s: 0.6 + 0 * s),
    "square root": (lambda s: 4 * np.sqrt(s), lambda s: 0.6 + 0 * s),
    "scatter in proportion to size": (lambda s: 1 + 2 * s, lambda s: 0.4 * s),
}


def bounds_of(fit: PodFit) -> Row:
    """One-sided bound, lower and upper end of the two-sided interval."""
    one, low, high = (
        trusted_bound(bounds, separated=fit.separated)
        for bounds in (fit.a90_95, fit.a90_low_two_sided, fit.a90_95_two_sided)
    )
    return one, low, high


def tables(pod: Callable[[Any], Any], simulations: int, trials: int) -> Iterator[Trials]:
    """Hits and misses at random sizes."""
    rng = np.random.default_rng(trials)
    for _ in range(simulations):
        size = rng.uniform(0.3, 4.5, trials)
        yield check_trials(size, (rng.random(size.size) < pod(size)).astype(float))


def shares(rows: list[Row], true: float) -> str:
    """One- and two-sided coverage in per cent, and how many tables gave a bound."""
    upper = [row[0] >= true for row in rows if row[0] is not None]
    both = [row[1] <= true <= row[2] for row in rows if row[1] is not None and row[2] is not None]
    two = f"{100 * np.mean(both):5.1f}" if both else "    -"
    return f"{100 * np.mean(upper):5.1f} / {two} ({len(upper)} of {len(rows)})" if upper else "none"


def of_shapes(simulations: int, trials: int) -> None:
    """Tables whose hits follow another shape than the link."""
    for name, pod in SHAPES.items():
        true = float(brentq(lambda s, pod=pod: pod(s) - 0.9, 0.2, 6.0))
        one, joined, given = [], [], []
        for table in tables(pod, simulations, trials):
            fit = fit_pooled(table, link=LINKS["cloglog"], log_size=False, method="auto")
            one.append(bounds_of(fit))
            alternatives = compare_models(table)
            answered, found, _ = with_links_open(fit, alternatives, named=False)
            given.append(bounds_of(answered))
            if found is not None:
                joined.append((found.a90_95, found.a90_low, found.a90_high))
        text = f"n {trials} {name:20} one link {shares(one, true)}; as given {shares(given, true)}"
        print(f"{text}; over links {shares(joined, true)}", flush=True)


def of_steep_curves(simulations: int, trials: int) -> None:
    """Tables that separate, of curves so steep that many do: Wald's bound, which is given, and the likelihood ratio's."""
    for name, pod in STEEP.items():
        true = float(brentq(lambda s, pod=pod: pod(s) - 0.9, 0.2, 6.0))
        given, by_ratio = [], []
        for table in tables(pod, simulations, trials):
            fit = fit_pooled(table, link=LINKS["logit"], log_size=False, method="auto")
            if not fit.separated or fit.curve is None:
                continue
            given.append(bounds_of(fit))
            eta = fit.curve.link.eta_from_pod(0.9)
            inside = fit.curve.most_likely_x(eta)
            bound = size_bound(fit.curve, eta=eta, quantile=ONE_SIDED_95, upper=True, start=inside)
            by_ratio.append((bound, None, None))
        text = f"n {trials} {name:20} Wald {shares(given, true)}; likelihood ratio {shares(by_ratio, true)}"
        print(f"{text}; separated {len(given)} of {simulations}", flush=True)


def of_responses(simulations: int, rows: int) -> None:
    """Continuous responses that a straight line with one scatter does and does not describe; detected above 5."""
    for name, (mean, sd) in RESPONSES.items():
        rng = np.random.default_rng(rows)
        true = float(brentq(lambda s, mean=mean, sd=sd: ndtr((mean(s) - 5.0) / sd(s)) - 0.9, 0.5, 8.0))
        ends: list[Row] = []
        bends, scatters = 0, 0
        for _ in range(simulations):
            size = rng.uniform(0.5, 4.0, rows)
            fit = fit_response_pod(size, mean(size) + sd(size) * rng.standard_normal(rows), decision=5.0)
            bounds = (fit.a90_95, fit.a90_low_two_sided, fit.a90_95_two_sided)
            ends.append(tuple(one.likelihood_ratio for one in bounds))
            bends += fit.p_line is not None and fit.p_line < 0.01
            scatters += fit.p_scatter is not None and fit.p_scatter < 0.01
        told = f"bends {100 * bends / simulations:.1f} %, scatter changes {100 * scatters / simulations:.1f} %"
        print(f"n {rows} {name:28} {told}; bounds {shares(ends, true)}", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    kinds = {"shapes": of_shapes, "steep": of_steep_curves, "responses": of_responses}
    parser.add_argument("kind", nargs="?", choices=kinds, default="shapes")
    parser.add_argument("--simulations", type=int, default=200)
    parser.add_argument("--trials", type=int, default=100)
    arguments = parser.parse_args()
    kinds[arguments.kind](arguments.simulations, arguments.trials)
    return 0


if __name__ == "__main__":
    sys.exit(main())
