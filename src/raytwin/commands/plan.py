"""How many images and networks a POD study needs for a wanted a90/95, and which sizes to make.

Give what you expect: the curve (a50 and a90) and how much networks and images differ (standard deviations on the link's scale,
as `raytwin pod` prints them), or a pilot's table to take them from. The answer is for large samples: below some 40
informative trials expect a longer interval.
"""

import argparse
from typing import Any

from ..api.study_plans import plan
from ..results import counted
from ._answer import answer, say
from ._pod_answer import shown

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
    found = plan(
        a50=arguments.a50,
        a90=arguments.a90,
        pilot=arguments.pilot,
        size=arguments.size,
        link=arguments.link,
        log_size=arguments.log_size,
        sd_network=arguments.sd_network,
        sd_image=arguments.sd_image,
        networks=arguments.networks,
        wanted=arguments.wanted,
        images=arguments.images,
    )
    result = found.to_dict()
    for line in found.warnings:
        say(f"warning: {line}")
    answer(result, as_json=arguments.json, text=_text(result))
    return 0


def _text(result: dict[str, Any]) -> str:
    curve = result["assumed"]
    lines = [
        f"assumed: a50 {shown(curve['a50'])}, a90 {shown(curve['a90'])}, {curve['link']}"
        f"{' on ln size' if curve['log_size'] else ''}; spread of networks {shown(curve['sd_network'])}, of images"
        f" {shown(curve['sd_image'])}",
    ]
    if result["images"] is None:
        return lines[0]
    lines.append(f"{counted(result['networks'], 'network')}, {result['images']} images with one foreign object each")
    expected = result["expected"]
    if expected is not None:
        a90 = curve["a90"]
        bound, low, high = (
            None if expected[f"{name}_over_a90"] is None else a90 * expected[f"{name}_over_a90"]
            for name in ("bound", "low", "high")
        )
        ratio = "" if bound is None else f" ({bound / a90:.3f} a90)"
        lines.append(f"expected a90/95 {shown(bound)}{ratio}; two-sided 95 % {shown(low)} to {shown(high)}")
    sizes = result["sizes"]
    if sizes:
        how = "evenly on ln size" if curve["log_size"] else "evenly"
        lines.append(f"sizes: {shown(sizes[0])} to {shown(sizes[-1])}, spread {how}")
    return "\n".join(lines)
