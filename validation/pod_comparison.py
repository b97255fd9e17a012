"""Coverage of the interval of the difference of a90 between two tables that share images and networks, by simulation.

    python validation/pod_comparison.py [--simulations N] [--repeats cluster or crossed]

Both tables come from one curve (the difference is 0), with the same objects and networks and fresh noise; 95 %
intervals should hold 0 in 95 % of the simulations, and the test of equal curves should reject in 5 %.
"""

import argparse
import math
import sys

import numpy as np

from raytwin.pod import LINKS, check_trials, compare_pod


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--simulations", type=int, default=200)
    parser.add_argument("--repeats", default="cluster", choices=("cluster", "crossed"))
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    random = np.random.default_rng(arguments.seed)
    print(
        "| link, networks x images | repeats | paired | holds 0 % | relative width | curve test rejects % | simulations |"
    )
    print("|---" * 7 + "|")
    for link, networks, images in (("cloglog", 20, 82), ("logit", 10, 82), ("cloglog", 3, 82), ("logit", 5, 82)):
        counts = {True: [0, 0, 0.0, 0], False: [0, 0, 0.0, 0]}
        for _ in range(arguments.simulations):
            size = random.uniform(0.01, 0.35, images)
            eta = -2.5 + 22 * size + random.normal(0, 0.4, networks)[:, None] + random.normal(0, 0.8, images)[None]
            network, image = np.indices(eta.shape)
            tables = [
                check_trials(
                    np.tile(size, networks),
                    (random.random(eta.shape) < LINKS[link].pod_from_eta(eta)).ravel().astype(float),
                    network=network.ravel(),
                    image=image.ravel(),
                )
                for _ in range(2)
            ]
            for paired, count in counts.items():
                found = compare_pod(
                    tables[0],
                    tables[1],
                    link=link,
                    repeats=arguments.repeats,
                    shared_images=paired,
                    shared_networks=paired,
                )
                interval = found.difference_a90
                if interval.low is None or interval.high is None or found.first.a90 is None:
                    count[3] += 1
                    continue
                count[0] += interval.low <= 0 <= interval.high
                count[2] += (interval.high - interval.low) / found.first.a90
                count[1] += found.curve_test is not None and found.curve_test.p < 0.05
        for paired, (inside, rejected, width, none) in counts.items():
            n = arguments.simulations - none
            error = 100 * math.sqrt(0.95 * 0.05 / max(n, 1))
            print(
                f"| {link}, {networks} x {images} | {arguments.repeats} | {'yes' if paired else 'no'} |"
                f" {100 * inside / max(n, 1):.1f} | {width / max(n, 1):.3f} | {100 * rejected / max(n, 1):.1f} |"
                f" {n} (+-{error:.1f}) |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
