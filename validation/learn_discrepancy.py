"""How far laws of an effect's kind depart from the catalogue's: learnt from sessions of the second simulator and of the lab.

Each session has one effect, by the simulator's own law or a drawn family (`law_families.py`). The evidence of that effect at each
level of discrepancy, with and without a misfit, tells how often each occurs and how long misfits are (empirical Bayes, by expectation
and maximisation); the same of what looks most like it once it is left out of the catalogue. The answers themselves are told beside
it.

    python validation/learn_discrepancy.py --line usual --families --json build/discrepancy/usual.json
    python validation/lab_effects.py --json build/discrepancy/lab.json
    python validation/learn_discrepancy.py --learn build/discrepancy/*.json
"""

import argparse
import json
import math
import tempfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import law_families
import numpy as np
import second_simulator as plain

from raytwin.acquisition import open_acquisition
from raytwin.diagnosis.inference.curve_fits import CurveFit
from raytwin.diagnosis.inference.discrepancy import LEVELS, log_frequency
from raytwin.diagnosis.inference.inference import UNKNOWN, Misfits
from raytwin.diagnosis.inference.unknown import LOG_DENSITY
from raytwin.diagnosis.judgement.judgement import Weighed, verdict_of, weigh_problem
from raytwin.diagnosis.problem.assemble import problem_of
from raytwin.diagnosis.problem.problem import Problem
from raytwin.diagnosis.session.preparation import prepare_session

_ROUNDS = 300
_CLEAR = 3.0  # log evidence from which something is said
_SHORTEST = 1e-3  # of a misfit over what laws do: shorter ones do not show


def session_row(path: Path, planted: str) -> dict:
    """Evidence of the planted effect by level, of the likest once it is left out, and what is named with and without it."""
    with open_acquisition(path) as acquisition:
        session = prepare_session(acquisition, twin=None, rng=np.random.default_rng(0))
        row, _ = row_of(problem_of(session), planted)
    return row


def row_of(problem: Problem, planted: str) -> tuple[dict, Weighed]:
    """What one session tells of the planted effect's law, and of the law that is likest it; all hypotheses."""
    weighed = weigh_problem(problem)
    row = {"planted": planted, **told(weighed.hypotheses)}
    if planted == "none":
        return row, weighed
    own = [fit for fit in weighed.fits if fit.curve.effect == planted]
    if own:
        row["kind"] = told_by_law(weighed, _likest(own))
    kept = tuple(curve for curve in problem.curves if curve.effect != planted)
    if kept:
        others = weigh_problem(replace(problem, curves=kept))
        likest = _likest(others.fits)
        row["another"] = told_by_law(others, likest, another=True)
        row["likest"] = likest.curve.effect
        row["left_out"] = told(others.hypotheses)
    return row, weighed


def _likest(fits: Sequence[CurveFit]) -> CurveFit:
    """The likeliest of those that were fitted with all levels."""
    full = [fit for fit in fits if len(fit.by_level) == len(LEVELS.levels)]
    return max(full, key=lambda fit: fit.log_evidence)


def told_by_law(weighed: Weighed, fit: CurveFit, *, another: bool = False) -> dict:
    """Log evidence of a law by level, and with a misfit of any length beside it; that length over what the law does.

    another: the effect is only like the law's: it has any strength, and where it leaves a misfit the law is off by most.
    """
    by_level = fit.at_any_strength if another else fit.by_level
    misfits = Misfits(weighed.observed, weighed.problem.families)
    if another:
        found = misfits.beside([replace(fit, level=LEVELS.levels[-1])])
    else:
        found = misfits.settled(misfits.beside([fit]), fit.log_evidence)
    (point,) = (one.point for one in found.fits)
    evidence, misfit = misfits.in_presence_of([point])
    evidence += misfits.prior([point], misfit, another=another) - log_frequency(point.level, another=another)
    level = LEVELS.levels.index(point.level)
    return {
        "by_level": list(by_level),
        "with_misfit": evidence,
        "level": level,
        "ratio": misfits.ratio([point], misfit),
    }


def told(hypotheses) -> dict:
    """What is said of hypotheses: the word, the effects, how probable."""
    verdict = verdict_of(hypotheses)
    return {"verdict": verdict.word, "named": list(verdict.named), "probability": verdict.leading.probability}


def frequencies(rows: list[dict], density: Callable[[list[float], list[float]], tuple]) -> dict:
    """Frequencies of the levels and of a misfit, and what is known of its length, that make the evidences of sessions likeliest.

    A session in which the effect does not show tells nothing and is left out.

    Args:
        rows: as `told_by_law` makes them.
        density: of the ratios and how much each counts: what is fitted, and the log density of each ratio in its logarithm.
    """
    known = [row for row in rows if max(*row["by_level"], row["with_misfit"]) > _CLEAR]
    by_level = np.array([row["by_level"] for row in known])
    with_misfit = np.array([row["with_misfit"] for row in known])
    of_misfit = np.array([row["level"] for row in known])
    ratios = [max(row["ratio"], _SHORTEST) for row in known]
    levels, misfit, of_length = (
        np.full(len(LEVELS.levels), 1.0 / len(LEVELS.levels)),
        0.5,
        np.full(len(known), LOG_DENSITY),
    )
    fitted: tuple = ()
    for _ in range(_ROUNDS):
        scores = np.concatenate(
            [
                by_level + np.log(levels * (1.0 - misfit)),
                (with_misfit + of_length - LOG_DENSITY + np.log(misfit * levels[of_misfit]))[:, None],
            ],
            axis=1,
        )
        shares = np.exp(scores - np.logaddexp.reduce(scores, axis=1)[:, None])
        taken = shares[:, :-1].sum(axis=0)
        np.add.at(taken, of_misfit, shares[:, -1])
        # Laplace's rule of succession: as if each had been seen once more, so that none is impossible and few sessions say little
        levels = (taken + 1.0) / (taken.sum() + len(taken))
        misfit = (float(shares[:, -1].sum()) + 1.0) / (len(known) + 2.0)
        fitted, of_length = density(ratios, list(shares[:, -1]))
    return {"levels": [round(float(one), 3) for one in levels], "misfit": round(misfit, 3), "length": fitted}


def about_nothing(ratios: list[float], counts: list[float]) -> tuple[float, np.ndarray]:
    """Standard deviation of a Gaussian about 0 of ratios that count so much, and their log densities in the logarithm."""
    squares = np.square(ratios)
    sd = math.sqrt(max(float(np.average(squares, weights=np.maximum(counts, 1e-9))), _SHORTEST**2))
    share = np.array(ratios) / sd
    return round(sd, 3), np.log(share) + 0.5 * math.log(2.0 / math.pi) - 0.5 * share**2


def of_logarithm(ratios: list[float], counts: list[float]) -> tuple[list[float], np.ndarray]:
    """Mean and standard deviation of the logarithms of ratios that count so much, and their log densities in the logarithm."""
    logs, weights = np.log(ratios), np.maximum(counts, 1e-9)
    mean = float(np.average(logs, weights=weights))
    sd = math.sqrt(max(float(np.average((logs - mean) ** 2, weights=weights)), _SHORTEST))
    return [round(mean, 3), round(sd, 3)], -0.5 * ((logs - mean) / sd) ** 2 - math.log(math.sqrt(2.0 * math.pi) * sd)


def _most(told: dict | None) -> float:
    """The most that a law tells, with a misfit or without."""
    return -math.inf if told is None else max(*told["by_level"], told["with_misfit"])


def learn(paths: list[Path]) -> None:
    """Print the table of `diagnosis/inference/discrepancy.toml`, and the scores of the sessions that it comes from."""
    rows = [row for path in paths for row in json.loads(path.read_text())]
    # where another law tells more than the planted one's, frames do not show that: calibration took it in, or it acts otherwise
    # and a law that leaves more than it takes away is none of that kind
    seen = [row for row in rows if "kind" in row and _most(row["kind"]) > _most(row.get("another"))]
    seen = [row for row in seen if row["kind"]["ratio"] < 1.0]
    kind = frequencies([row["kind"] for row in seen], about_nothing)
    another = frequencies([row["another"] for row in rows if "another" in row], of_logarithm)
    print(f"levels = {list(LEVELS.levels)}\nof_kind = {kind['levels']}\nof_another = {another['levels']}")
    print(f"misfit_of_kind = {kind['misfit']}\nmisfit_of_another = {another['misfit']}")
    print(f"misfit_sd_of_kind = {kind['length']}\nmisfit_of_another_log = {another['length']}")
    single = [row for row in rows if row["planted"] not in ("none", *plain.UNKNOWN)]
    print(f"# named alone {sum(row['named'] == [row['planted']] for row in single)} of {len(single)}")
    wrong = [row for row in single if set(row["named"]) - {row["planted"]}]
    print(f"# a wrong name {len(wrong)}; once left out unknown or none ", end="")
    left = [row["left_out"]["verdict"] for row in single if "left_out" in row]
    print(f"{sum(word in (UNKNOWN, 'no_gap') for word in left)} of {len(left)}")


def main() -> None:
    """Sessions of one line, or what they say together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--line", choices=list(plain.LINES), default="usual")
    parser.add_argument("--families", action="store_true", help="laws of drawn families instead of the simulator's own")
    parser.add_argument("--only", nargs="+", metavar="EFFECT")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--learn", nargs="+", type=Path, metavar="JSON")
    options = parser.parse_args()
    if options.learn:
        learn(options.learn)
        return
    singles = [case for case in plain.cases_of(plain.LINES[options.line]) if "+" not in case and "_later" not in case]
    if options.families:
        singles = law_families.effects_of(options.line)
    rows = []
    for effect in options.only or singles:
        rng = np.random.default_rng([options.seed, zlib.crc32((options.line + effect).encode())])
        line = plain.Line
        if options.families:
            plain.CASES[effect] = law_families.clear_strength(effect, rng), True
            line = law_families.FamilyLine
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "session.h5"
            plain.make_session(path, options.line, effect, rng, options.frames, line)
            row = {"line": options.line, "families": options.families, **session_row(path, effect)}
        rows.append(row)
        left = row.get("left_out", {})
        print(f"{effect:18s} {row['verdict']:18s} {'+'.join(row['named']):34s}", end="")
        print(f"left out: {left.get('verdict', ''):16s} {'+'.join(left.get('named', []))}", flush=True)
        if options.json:
            options.json.parent.mkdir(parents=True, exist_ok=True)
            options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
