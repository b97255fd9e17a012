"""What a screened sweep of hundreds of settings costs before any network is trained, and how many it would train.

Stand-ins take the place of networks: an observer of known efficiency and internal noise whose a90 have an error of their own and a
scatter between settings, 8 % each, as networks' have (VALIDATION.md). Printed are seconds a setting of looking ahead and of the
observer, the share of settings that would be trained, and what is recommended: how much larger its a90 is than the smallest one
(without a goal), or how fast it is (with one), beside what is recommended where all are trained.

    python benchmarks/sweep_screening.py CAMPAIGN.toml        # twin and references are its own, the settings this script's
"""

import argparse
import json
import math
import tempfile
import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from raytwin import __version__
from raytwin.acquisition.setting import setting_from_text
from raytwin.campaign.sweep import look_ahead, run_sweep
from raytwin.campaign.sweep_file import Screening, read_campaign
from raytwin.campaign.sweep_screening import Screen
from raytwin.campaign.sweep_trial import basis_of, prepare_references
from raytwin.files import sha256_of_file
from raytwin.observers import observe_settings

LOW_KV, HIGH_KV = (35, 40, 45, 50, 55), (80, 90, 100, 110)
LOW_FILTER, HIGH_FILTER = ("Cu:0.05",), ("Cu:0.05", "Cu:0.15", "Cu:0.3")
EXPOSURES_MS = (10, 15, 20, 25, 30, 40, 50, 60, 80)
ERROR, SCATTER = 0.08, 0.08
ALARMS = {"rate": 0.1, "low": 0.05, "high": 0.2, "n": 100, "effective_n": 100.0}


class StandIns:
    """a90 of networks that were not trained, written as a sweep's tasks leave them."""

    def __init__(self, truth):
        self.truth, self.trained = truth, 0

    def run(self, tasks, done):
        for task in tasks:
            self.trained += 1
            folder = Path(task["folder"])
            folder.mkdir(parents=True, exist_ok=True)
            rng = np.random.default_rng(task["seeds"]["train"])
            a90 = self.truth[f"{task['low']};{task['high']}"] * math.exp(ERROR * rng.standard_normal())
            hits = folder / "hits.csv"
            hits.write_text("contrast,hit,network,image\n0.1,1,0,a\n0.05,0,0,b\n")
            trial = {"key": task["key"], "refused": "", "warnings": [], "hits_sha256": sha256_of_file(hits)}
            (folder / "trial.json").write_text(json.dumps(trial))
            nothing = dict.fromkeys(("a50", "a90", "a90_low", "a90_high", "a90_upper", "line"))
            curve = {
                "key": task["curve_key"], "a50": None, "a90": a90, "a90_95": a90 * math.exp(1.645 * ERROR),
                "a90_95_interval": {"low": a90 * math.exp(-1.96 * ERROR), "high": a90 * math.exp(1.96 * ERROR)},
                "n": 2, "n_hits": 1, "objects": 2, "false_alarms": ALARMS, "points": [], "line": None,
                "other_size": nothing | {"points": []}, "warnings": [],
            }  # fmt: skip
            (folder / "pod.json").write_text(json.dumps(curve))
            done(task, "")

    def close(self):
        pass


def settings():
    found = []
    for low, high, first, second, exposure in product(LOW_KV, HIGH_KV, LOW_FILTER, HIGH_FILTER, EXPOSURES_MS):
        texts = (
            f"kv={low},power_w=40,exposure_ms={exposure},filter={first}",
            f"kv={high},power_w=45,exposure_ms={exposure},filter={second}",
        )
        found.append((setting_from_text(texts[0]), setting_from_text(texts[1])))
    return tuple(found)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", type=Path)
    options = parser.parse_args()
    campaign = replace(
        read_campaign(options.campaign), settings=settings(), slabs=None, requirement=None, screening=Screening()
    )
    began = time.process_time()
    ahead = look_ahead(campaign)
    looked = time.process_time() - began
    kept = [one for one in ahead if one.kept]
    print(f"{len(ahead)} settings, {len(kept)} feasible: {1000 * looked / len(ahead):.0f} ms a setting to look ahead")
    with tempfile.TemporaryDirectory() as scratch:
        data = Path(scratch) / "data"
        prepare_references(campaign, data, basis_of(campaign, version=__version__))
        screen = Screen(campaign, data / "test.h5", ahead)
        who = replace(screen.observer, efficiency=0.6, internal_noise=0.02)
        sizes = observe_settings(screen.line, [one.pair for one in kept], screen.objects, observer=who).a90_of_curve
        sizes = sizes * np.exp(SCATTER * np.random.default_rng(1).standard_normal(len(kept)))
        truth = {one.text: float(size) for one, size in zip(kept, sizes, strict=True)}
        pace = {one.text: one.throughput_per_s for one in kept}
        for goal in (None, float(np.quantile(sizes, 0.1)), float(np.quantile(sizes, 0.5))):
            limits = replace(campaign.limits, a90=goal)
            asked = replace(campaign, limits=limits, training=replace(campaign.training, start_steps=0))

            def told(taken, goal=goal):
                size = f"a90 {truth[taken] / min(truth.values()):.2f} times the smallest" if taken else "none"
                return size if goal is None or not taken else f"{pace[taken]:.1f} products/s"

            answers = {}
            for way, one in {"screening": asked, "all": replace(asked, screening=None)}.items():
                networks = StandIns(truth)
                began = time.process_time()
                answers[way] = run_sweep(
                    one,
                    Path(scratch) / f"{way}_{goal}",
                    runner=networks,
                    version=__version__,
                    outlooks=ahead,
                )["recommended"]
                spent = time.process_time() - began
                share = networks.trained / len(kept)
                print(
                    f"{way}: {networks.trained} trained ({100 * share:.0f} %), {1000 * spent / len(kept):.0f} ms a setting;"
                    f" {told(answers[way])}"
                )
            print("the same setting" if answers["screening"] == answers["all"] else "another setting")


if __name__ == "__main__":
    main()
