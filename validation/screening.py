"""Screening against training all: on a sweep whose settings are all trained, what would screening have trained, and recommended?

For no goal and for goals spread over the a90 that were found. Where the recommendations differ, the a90 of both are given with their
intervals: whether the difference is one that the sweep itself can show.

    python validation/observers.py --output build/observers          # trains the 20 settings, some hours
    python validation/screening.py build/observers/campaign.toml build/observers/sweep --json build/screening.json
"""

import argparse
import json
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from raytwin import __version__
from raytwin.campaign.sweep import look_ahead, run_sweep
from raytwin.campaign.sweep_file import Screening, read_campaign
from raytwin.campaign.sweep_trial import run_task
from raytwin.files import whole_file

GOALS = 6


class NothingToTrain:
    """Fits curves of hits that are there; a setting without hits is an error of the caller."""

    def run(self, tasks, done):
        for task in tasks:
            if not (Path(task["folder"]) / "hits.csv").exists():
                raise SystemExit(f"{task['folder']} is not trained: run the sweep without [screening] first")
            run_task(task)
            done(task, "")

    def close(self):
        pass


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", type=Path)
    parser.add_argument("sweep", type=Path, help="folder of the campaign's sweep, all of it trained")
    parser.add_argument("--train-first", type=int, nargs="+", default=[4, 6])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    campaign = replace(read_campaign(options.campaign), screening=None, requirement=None)
    began = time.monotonic()
    ahead = look_ahead(campaign)
    print(f"{len(ahead)} settings looked at in {time.monotonic() - began:.0f} s", file=sys.stderr)
    found = []
    with tempfile.TemporaryDirectory(dir=options.sweep.parent) as scratch:
        folder = Path(scratch) / "sweep"
        shutil.copytree(options.sweep, folder)

        def asked(goal, screening):
            one = replace(campaign, screening=screening, limits=replace(campaign.limits, a90=goal))
            return run_sweep(one, folder, runner=NothingToTrain(), version=__version__, outlooks=ahead)

        whole = asked(None, None)
        a90 = [row["a90_upper"] for row in whole["rows"] if row["a90_upper"] is not None]
        goals = [None, *np.quantile(a90, np.linspace(0.05, 0.95, GOALS)).tolist()]
        for goal in goals:
            everything = asked(goal, None)
            rows = {row["setting"]: row for row in everything["rows"]}
            for count in options.train_first:
                screened = asked(goal, Screening(train_first=count, round=2))
                two = [everything["recommended"], screened["recommended"]]
                found.append({
                    "goal": goal, "train_first": count, "feasible": everything["feasible"],
                    "trained": screened["screening"]["trained"], "same": two[0] == two[1],
                    "meets": [everything["meets_goal"], screened["meets_goal"]],
                    "recommended": [
                        {name: rows[text][name] for name in ("label", "a90", "a90_low", "a90_high", "a90_upper", "throughput_per_s")}
                        for text in two
                    ],
                })  # fmt: skip
                last = found[-1]
                print(
                    f"goal {'none' if goal is None else f'{goal:.3f}'}, {count} first: {last['trained']} of"
                    f" {last['feasible']} trained, {'same' if last['same'] else 'another'} recommendation"
                )
                if not last["same"]:
                    for name, one in zip(("all", "screened"), last["recommended"], strict=True):
                        print(f"    {name:9} {one['label']}: {one['a90']:.3f} ({one['a90_low']} to {one['a90_high']})")
    if options.json:
        with whole_file(options.json) as temporary:
            temporary.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
