"""How many images and networks a POD study needs for a wanted a90/95, and which sizes to make.

Give what you expect: the curve (a50 and a90) and how much networks and images differ (standard deviations on the link's scale,
as `raytwin pod` prints them), or a pilot's table to take them from. The answer is for large samples: below some 40
informative trials expect a longer interval.
"""

import argparse
from dataclasses import asdict
from typing import Any

from ..errors import InputError
from ..pod import AssumedCurve, expected_precision, fit_pod, plan_pod, read_pod_table, recommended_sizes
from ._answer import answer, say
from ._pod_answer import default_repeats, shown

EXAMPLE = """examples:
  raytwin plan --a50 1.5 --a90 3 --sd-network 0.4 --sd-image 0.8 --networks 10 --wanted 1.15
  raytwin plan --pilot HITS.csv --networks 20 --images 150 --json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--a50", type=float, help="size expected at POD 50 %%")
    add("--a90", type=float, help="size expected at POD 90 %%")
    add("--pilot", metavar="HITS.csv", help="take curve and spreads from this table")
    add("--size", metavar="COLUMN", help="the pilot's size column")
    add("--link", default="cloglog", choices=("cloglog", "loglog", "logit", "probit"))
    add("--log-size", action="store_true", help="curve on the logarithm of the size")
    add("--sd-network", type=float, default=0.0, help="spread between networks, on the link's scale (default 0)")
    add("--sd-image", type=float, default=0.0, help="spread between images, on the link's scale (default 0)")
    add("--networks", type=int, default=1, help="networks that look at every image (default 1)")
    add("--wanted", type=float, default=1.2, metavar="RATIO", help="wanted a90/95 over a90 (default 1.2)")
    add("--images", type=int, help="what this number of images would give, in the place of a wanted ratio")
    add("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    curve = _assumed(arguments)
    warnings: list[str] = []
    result: dict[str, Any] = {"assumed": asdict(curve), "networks": arguments.networks}
    if arguments.images is not None:
        sizes = recommended_sizes(curve, arguments.images, networks=arguments.networks)
        expected = expected_precision(curve, sizes, networks=arguments.networks)
        result |= {"images": arguments.images, "expected": asdict(expected), "sizes": sizes.tolist()}
    else:
        plan = plan_pod(curve, wanted_over_a90=arguments.wanted, networks=arguments.networks)
        result |= {
            "wanted_over_a90": plan.wanted_over_a90,
            "images": plan.images,
            "expected": None if plan.expected is None else asdict(plan.expected),
            "limit_over_a90": plan.limit_over_a90,
            "fewest_networks": plan.fewest_networks,
            "sizes": plan.sizes.tolist(),
        }
        if plan.images is None:
            warnings.append(
                f"{arguments.networks} networks leave a90/95 at {plan.limit_over_a90:.3g} a90 whatever the number of images:"
                f" it takes at least {plan.fewest_networks} networks"
            )
    result["warnings"] = warnings
    for line in warnings:
        say(f"warning: {line}")
    answer(result, as_json=arguments.json, text=_text(result))
    return 0


def _assumed(arguments: argparse.Namespace) -> AssumedCurve:
    if arguments.pilot is None:
        if arguments.a50 is None or arguments.a90 is None:
            raise InputError(
                "--a50 and --a90", received="not both", expected="both sizes", remedy="or --pilot HITS.csv"
            )
        return AssumedCurve(
            a50=arguments.a50,
            a90=arguments.a90,
            link=arguments.link,
            log_size=arguments.log_size,
            sd_network=arguments.sd_network,
            sd_image=arguments.sd_image,
        )
    table = read_pod_table(arguments.pilot, size=arguments.size)
    fit = fit_pod(
        table.size,
        table.hits if table.hits is not None else [],
        link=arguments.link,
        log_size=arguments.log_size,
        repeats=default_repeats(table),
        network=table.network,
        image=table.image,
    )
    if fit.a50 is None or fit.a90 is None:
        raise InputError(
            "--pilot",
            received="; ".join(fit.warnings) or "no curve",
            expected="a pilot with an a50 and an a90",
            remedy="give --a50 and --a90",
        )
    if fit.repeats == "cluster" and arguments.networks > 1:
        raise InputError(
            "--pilot",
            received=f"{arguments.pilot}, where every network hits or misses the same images, and --networks {arguments.networks}",
            expected="a pilot whose networks differ, or one network",
            remedy="plan with --networks 1: such networks add nothing to each other",
        )
    crossed = fit.crossed
    return AssumedCurve(
        a50=fit.a50,
        a90=fit.a90,
        link=arguments.link,
        log_size=arguments.log_size,
        sd_network=(crossed.sd_network or 0.0) if crossed else 0.0,
        sd_image=(crossed.sd_image or 0.0) if crossed else 0.0,
    )


def _text(result: dict[str, Any]) -> str:
    curve = result["assumed"]
    lines = [
        f"assumed: a50 {shown(curve['a50'])}, a90 {shown(curve['a90'])}, {curve['link']}"
        f"{' on ln size' if curve['log_size'] else ''}; spread of networks {shown(curve['sd_network'])}, of images"
        f" {shown(curve['sd_image'])}",
    ]
    if result["images"] is None:
        return lines[0]
    lines.append(f"{result['networks']} networks, {result['images']} images with one foreign object each")
    expected = result["expected"]
    if expected is not None:
        a90 = curve["a90"]
        lines.append(
            f"expected a90/95 {shown(a90 * expected['bound_over_a90'])} ({expected['bound_over_a90']:.3f} a90);"
            f" two-sided 95 % {shown(a90 * expected['low_over_a90'])} to {shown(a90 * expected['high_over_a90'])}"
        )
    sizes = result["sizes"]
    if sizes:
        how = "evenly on ln size" if curve["log_size"] else "evenly"
        lines.append(f"sizes: {shown(sizes[0])} to {shown(sizes[-1])}, spread {how}")
    return "\n".join(lines)
