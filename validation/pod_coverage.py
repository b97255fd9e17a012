"""Coverage of the 95 % bounds on a90 by simulation: how often the bound lies at or above the a90 that made the data.

    python validation/pod_coverage.py [--independent N] [--crossed N] [--seed S]

Sizes are uniform around the curve's rise and drawn anew each time; truth a50 = 0.1, a90 = 0.2 on the size itself.
One-sided bounds and upper ends of two-sided intervals should cover 95 % and 97.5 %, two-sided intervals 95 %. A bound
that the data do not give counts as covering (it claims nothing) and is counted under `none`; `modified` falls back on
the plain one where there is none (separated data, repeats). Crossed designs draw networks and images with
effects on the scale of eta; the a90 to cover is that of the population-averaged curve.
"""

import argparse
import math
import sys

import numpy as np

from raytwin.pod import LINKS, check_trials
from raytwin.pod.crossed import fit_crossed
from raytwin.pod.hit_miss import PodFit, fit_pooled
from raytwin.pod.mixed import averaged_eta
from raytwin.pod.repeats import fit_cluster

A50, A90 = 0.1, 0.2


def truth(link_name: str, total_sd: float) -> tuple[float, float]:
    """c0 and c1 of an average network and image for which the averaged curve has A50 and A90."""
    link = LINKS[link_name]
    low, high = (averaged_eta(p, total_sd, link=link) for p in (0.5, 0.9))
    c1 = (high - low) / (A90 - A50)
    return low - c1 * A50, c1


class Tally:
    """Counts of covered bounds by construction."""

    def __init__(self) -> None:
        self.n = 0
        self.counts: dict[str, int] = {}
        self.nulls = 0

    def add(self, fit: PodFit) -> None:
        self.n += 1
        low, one, two = fit.a90_low_two_sided, fit.a90_95, fit.a90_95_two_sided
        self.nulls += fit.a90 is None or one.likelihood_ratio is None
        for kind in ("likelihood_ratio", "modified", "wald"):
            upper, upper_two, lower = (
                getattr(bounds, kind) or (bounds.likelihood_ratio if kind == "modified" else None)
                for bounds in (one, two, low)
            )
            # a90 outside the tested sizes is not given out: no claim
            self._count(f"{kind} one-sided", upper is None or upper >= A90)
            self._count(
                f"{kind} two-sided", (upper_two is None or upper_two >= A90) and (lower is None or lower <= A90)
            )

    def _count(self, name: str, covered: bool) -> None:
        self.counts[name] = self.counts.get(name, 0) + covered

    def line(self, label: str) -> str:
        cells = [f"{100 * self.counts[name] / self.n:5.1f}" for name in self.counts]
        error = 100 * math.sqrt(0.95 * 0.05 / self.n)
        return f"| {label} | {' | '.join(cells)} | {100 * self.nulls / self.n:.1f} | {self.n} (+-{error:.1f}) |"


HEAD = (
    "| design | LR one-sided | LR two-sided | modified one-sided | modified two-sided | Wald one-sided | Wald two-sided"
    " | none % | simulations (standard error) |"
)
RULE = "|---" * 9 + "|"


def independent(random: np.random.Generator, link_name: str, n: int, repeats: int, log_size: bool) -> Tally:
    link = LINKS[link_name]
    if log_size:
        low, high = link.eta_from_pod(0.5), link.eta_from_pod(0.9)
        c1 = (high - low) / math.log(A90 / A50)
        c0 = low - c1 * math.log(A50)
    else:
        c0, c1 = truth(link_name, 0.0)
    tally = Tally()
    for _ in range(repeats):
        size = random.uniform(0.01, 0.4, n)
        x = np.log(size) if log_size else size
        hit = random.random(n) < link.pod_from_eta(c0 + c1 * x)
        table = check_trials(size, hit.astype(float))
        tally.add(fit_pooled(table, link=link, log_size=log_size, method="auto"))
    return tally


def crossed(
    random: np.random.Generator, link_name: str, networks: int, images: int, sds: tuple[float, float], repeats: int
) -> dict[str, Tally]:
    link = LINKS[link_name]
    c0, c1 = truth(link_name, math.hypot(*sds))
    tallies = {"crossed": Tally(), "cluster": Tally(), "pooled": Tally()}
    for _ in range(repeats):
        size = np.repeat(random.uniform(0.01, 0.4, images)[None], networks, axis=0)
        network, image = np.indices(size.shape)
        eta = c0 + c1 * size + random.normal(0, sds[0], networks)[:, None] + random.normal(0, sds[1], images)[None]
        hit = random.random(size.shape) < link.pod_from_eta(eta)
        table = check_trials(size.ravel(), hit.ravel().astype(float), network=network.ravel(), image=image.ravel())
        fit = fit_crossed(table, link=link, log_size=False, method="auto")
        tallies["crossed"].add(fit)
        tallies["cluster"].add(fit_cluster(table, link=link, log_size=False, method="auto"))
        tallies["pooled"].add(fit.naive or fit)
    return tallies


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--independent", type=int, default=2000, help="simulations of each design without repeats")
    parser.add_argument("--crossed", type=int, default=400, help="simulations of each design with repeats")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    random = np.random.default_rng(arguments.seed)
    if arguments.independent:
        print(HEAD)
        print(RULE)
        for n in (40, 100, 400):
            for link_name in LINKS:
                print(
                    independent(random, link_name, n, arguments.independent, False).line(f"{link_name}, n = {n}"),
                    flush=True,
                )
            print(
                independent(random, "cloglog", n, arguments.independent, True).line(f"cloglog on ln size, n = {n}"),
                flush=True,
            )
    if arguments.crossed:
        print(HEAD)
        print(RULE)
        for link_name, networks, images, sds in (
            ("cloglog", 10, 40, (0.4, 0.8)),
            ("cloglog", 10, 82, (0.4, 0.8)),
            ("logit", 10, 82, (0.4, 0.8)),
            ("cloglog", 30, 82, (0.4, 0.8)),
            ("cloglog", 10, 200, (0.4, 0.8)),
            ("cloglog", 5, 82, (0.4, 0.8)),
            ("cloglog", 10, 82, (0.0, 0.0)),
        ):
            tallies = crossed(random, link_name, networks, images, sds, arguments.crossed)
            for name, tally in tallies.items():
                print(tally.line(f"{name}: {link_name}, {networks} networks x {images} images, sd {sds}"), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
