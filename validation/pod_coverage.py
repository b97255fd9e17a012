"""Coverage of the 95 % bounds on a90 by simulation: how often the bound lies at or above the a90 that made the data.

    python validation/pod_coverage.py [--independent N] [--effects N] [--luck N] [--seed S]

Sizes are uniform around the curve's rise and drawn anew each time; truth a50 = 0.1, a90 = 0.2 on the size itself.
One-sided bounds and upper ends of two-sided intervals should cover 95 % and 97.5 %, two-sided intervals 95 %. Shares
are of the bounds that were given; `none` counts the tables that gave no upper likelihood-ratio bound. `modified` falls back
on the plain one where there is none (separated data).

Repeated looks, with 2, 3, 5 and 10 networks. Two truths:
effects: networks and images have normal effects on the scale of eta; the a90 to cover is that of the population-averaged
  curve. It has not quite the link's shape, so the pooled curve of `cluster` is not quite right.
shared luck: every look follows one curve of the link, and looks of a network or at an image share luck (a Gaussian copula, in
  which network and image have the stated shares of the variance). Here the pooled curve is right, and the normal effects are
  not quite (`--crossed-luck`).
"""

import argparse
import math
import sys
from collections.abc import Callable

import numpy as np

from raytwin.pod import LINKS, check_trials
from raytwin.pod.hit_miss import PodFit, fit_pooled
from raytwin.pod.mixed import averaged_eta
from raytwin.pod.repeats import fit_cluster, fit_crossed_where_finite
from raytwin.pod.trials import Trials

A50, A90 = 0.1, 0.2


def truth(link_name: str, total_sd: float) -> tuple[float, float]:
    """c0 and c1 of an average network and image for which the averaged curve has A50 and A90."""
    link = LINKS[link_name]
    low, high = (averaged_eta(p, total_sd, link=link) for p in (0.5, 0.9))
    c1 = (high - low) / (A90 - A50)
    return low - c1 * A50, c1


class Tally:
    """Whether each bound that was given covers, by construction."""

    def __init__(self) -> None:
        self.n = 0
        self.covers: dict[str, list[bool | None]] = {}
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
            # what is not given claims nothing: it is left out, and counted
            one_covers = None if upper is None else upper >= A90
            two_cover = None if upper_two is None or lower is None else lower <= A90 <= upper_two
            self.covers.setdefault(f"{kind} one-sided", []).append(one_covers)
            self.covers.setdefault(f"{kind} two-sided", []).append(two_cover)

    def line(self, label: str) -> str:
        given = [[value for value in values if value is not None] for values in self.covers.values()]
        cells = [f"{100 * sum(values) / len(values):5.1f}" if values else "  -  " for values in given]
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


def looks_with_effects(
    random: np.random.Generator, link_name: str, networks: int, images: int, sds: tuple[float, float]
) -> Trials:
    """Each network at each image, with normal effects (sd of networks, sd of images) on the scale of eta."""
    link = LINKS[link_name]
    c0, c1 = truth(link_name, math.hypot(*sds))
    size = np.repeat(random.uniform(0.01, 0.4, images)[None], networks, axis=0)
    network, image = np.indices(size.shape)
    eta = c0 + c1 * size + random.normal(0, sds[0], networks)[:, None] + random.normal(0, sds[1], images)[None]
    hit = random.random(size.shape) < link.pod_from_eta(eta)
    return check_trials(size.ravel(), hit.ravel().astype(float), network=network.ravel(), image=image.ravel())


def looks_that_share_luck(
    random: np.random.Generator, link_name: str, networks: int, images: int, shares: tuple[float, float]
) -> Trials:
    """Each network at each image, all on one curve; networks and images have these shares of a look's luck."""
    from scipy.special import ndtr

    link = LINKS[link_name]
    c0, c1 = truth(link_name, 0.0)
    size = np.repeat(random.uniform(0.01, 0.4, images)[None], networks, axis=0)
    network, image = np.indices(size.shape)
    luck = math.sqrt(shares[0]) * random.normal(size=networks)[:, None]
    luck = luck + math.sqrt(shares[1]) * random.normal(size=images)[None]
    luck = luck + math.sqrt(1 - sum(shares)) * random.normal(size=size.shape)
    hit = ndtr(luck) < link.pod_from_eta(c0 + c1 * size)
    return check_trials(size.ravel(), hit.ravel().astype(float), network=network.ravel(), image=image.ravel())


def repeated(
    random: np.random.Generator,
    draw: Callable[..., Trials],
    link_name: str,
    networks: int,
    images: int,
    strengths: tuple[float, float],
    repeats: int,
    *,
    crossed: bool,
) -> dict[str, Tally]:
    link = LINKS[link_name]
    tallies = {name: Tally() for name in (*(["crossed"] if crossed else []), "cluster", "pooled")}
    for _ in range(repeats):
        table = draw(random, link_name, networks, images, strengths)
        if crossed:
            tallies["crossed"].add(fit_crossed_where_finite(table, link=link, log_size=False, method="auto"))
        fit = fit_cluster(table, link=link, log_size=False, method="auto")
        tallies["cluster"].add(fit)
        tallies["pooled"].add(fit.naive or fit)
    return tallies


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--independent", type=int, default=2000, help="simulations of each design without repeats")
    parser.add_argument("--effects", type=int, default=1000, help="simulations of each design with effects")
    parser.add_argument("--luck", type=int, default=1000, help="simulations of each design with shared luck")
    parser.add_argument(
        "--crossed-luck", action="store_true", help="fit random effects to shared luck too: a second a fit"
    )
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
    for title, simulations, with_crossed, draw, designs in (
        (
            "effects",
            arguments.effects,
            True,
            looks_with_effects,
            (
                ("cloglog", 3, 40, (0.4, 0.8)),
                ("cloglog", 3, 82, (0.4, 0.8)),
                ("cloglog", 3, 82, (0.8, 0.4)),
                ("cloglog", 3, 82, (0.0, 0.0)),
                ("logit", 3, 82, (0.4, 0.8)),
                ("cloglog", 5, 40, (0.8, 0.4)),
                ("cloglog", 5, 82, (0.4, 0.8)),
                ("cloglog", 10, 40, (0.4, 0.8)),
                ("cloglog", 10, 82, (0.4, 0.8)),
                ("cloglog", 10, 82, (0.0, 0.0)),
                ("cloglog", 2, 82, (0.4, 0.8)),
                ("cloglog", 10, 200, (0.4, 0.8)),
                ("cloglog", 30, 82, (0.4, 0.8)),
            ),
        ),
        (
            "shared luck",
            arguments.luck,
            arguments.crossed_luck,
            looks_that_share_luck,
            (
                ("cloglog", 3, 40, (0.1, 0.3)),
                ("cloglog", 3, 82, (0.1, 0.3)),
                ("cloglog", 3, 82, (0.3, 0.1)),
                ("cloglog", 3, 82, (0.0, 0.0)),
                ("cloglog", 3, 82, (0.0, 0.95)),
                ("logit", 3, 82, (0.1, 0.3)),
                ("cloglog", 5, 40, (0.3, 0.1)),
                ("cloglog", 5, 82, (0.1, 0.3)),
                ("cloglog", 10, 40, (0.1, 0.3)),
                ("cloglog", 10, 82, (0.1, 0.3)),
            ),
        ),
    ):
        if simulations:
            print(HEAD)
            print(RULE)
        for link_name, networks, images, strengths in designs if simulations else ():
            tallies = repeated(random, draw, link_name, networks, images, strengths, simulations, crossed=with_crossed)
            for name, tally in tallies.items():
                label = f"{name}: {link_name}, {networks} networks x {images} images, {title} {strengths}"
                print(tally.line(label), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
