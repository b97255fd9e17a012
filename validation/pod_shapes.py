"""Coverage of bounds on a90 where hits follow another shape than the link, and where the data separate.

    python validation/pod_shapes.py [--simulations N] [--trials N]

Sizes are uniform from 0.3 to 4.5. `one link` is the default fit (cloglog on size), `over links` joins all links and scales whose AIC
is within 2 of the best (`pod.models.over_links`), `as given` has the bounds that `raytwin pod` answers: those of one link, and where
another fits better those of all. `steep` are logit curves so steep that many tables separate. Shares are of the
bounds that were given: one-sided 95 % bounds and two-sided 95 % intervals.
"""

import argparse
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, ndtr

from raytwin.pod import LINKS, check_trials, compare_models
from raytwin.pod.hit_miss import PodFit, fit_pooled, trusted_bound
from raytwin.pod.models import better_curve, over_links, widened

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


def bounds_of(fit: PodFit) -> Row:
    """One-sided bound, lower and upper end of the two-sided interval."""
    one, low, high = (
        trusted_bound(bounds, separated=fit.separated)
        for bounds in (fit.a90_95, fit.a90_low_two_sided, fit.a90_95_two_sided)
    )
    return one, low, high


def shares(rows: list[Row], true: float) -> str:
    """One- and two-sided coverage in per cent, and how many tables gave a bound."""
    upper = [row[0] >= true for row in rows if row[0] is not None]
    both = [row[1] <= true <= row[2] for row in rows if row[1] is not None and row[2] is not None]
    two = f"{100 * np.mean(both):5.1f}" if both else "    -"
    return f"{100 * np.mean(upper):5.1f} / {two} ({len(upper)} of {len(rows)})" if upper else "none"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--simulations", type=int, default=200)
    parser.add_argument("--trials", type=int, default=100)
    arguments = parser.parse_args()
    for name, pod in (SHAPES | STEEP).items():
        rng = np.random.default_rng(arguments.trials)
        true = float(brentq(lambda s, pod=pod: pod(s) - 0.9, 0.2, 6.0))
        one, joined, apart, given = [], [], [], []
        for _ in range(arguments.simulations):
            size = rng.uniform(0.3, 4.5, arguments.trials)
            table = check_trials(size, (rng.random(size.size) < pod(size)).astype(float))
            fit = fit_pooled(table, link=LINKS["cloglog"], log_size=False, method="auto")
            one.append(bounds_of(fit))
            if fit.separated:
                apart.append(bounds_of(fit))
            elif name in SHAPES:
                alternatives = compare_models(table)
                found = over_links(alternatives, link="cloglog", log_size=False)
                if found is not None:
                    joined.append((found.a90_95, found.a90_low, found.a90_high))
                    given.append(bounds_of(widened(fit, found) if better_curve(alternatives, fit) else fit))
        text = f"n {arguments.trials} {name:20} one link {shares(one, true)}; as given {shares(given, true)}"
        print(f"{text}; over links {shares(joined, true)}; separated {shares(apart, true)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
