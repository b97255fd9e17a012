"""How far laws of an effect's kind depart from the catalogue's: learnt from sessions of the second simulator.

Each session has one effect, by the simulator's own law or a drawn family (`law_families.py`). The evidence of that effect at each
level of discrepancy, with and without a rest, tells how often each occurs (empirical Bayes, by expectation and maximisation); the
same of what looks most like it once it is left out of the catalogue. The answers themselves are told beside it, and in how many
sessions without an effect one family of probes is off.

    python validation/learn_discrepancy.py --line usual --families --json build/discrepancy/usual.json
    python validation/learn_discrepancy.py --learn build/discrepancy/*.json
"""

import argparse
import json
import math
import tempfile
import zlib
from pathlib import Path

import law_families
import numpy as np
import second_simulator as plain

from raytwin.acquisition import open_acquisition
from raytwin.diagnosis.checks.preparation import prepare_session
from raytwin.diagnosis.diagnose_session import problem_of
from raytwin.diagnosis.inference.discrepancy import LEVELS
from raytwin.diagnosis.inference.inference import UNKNOWN, evidence_with_rest, weigh_hypotheses
from raytwin.diagnosis.inference.unknown import beyond
from raytwin.diagnosis.judgement.judgement import verdict_of, weigh_problem

_ROUNDS = 300
_CLEAR = 3.0  # log evidence from which something is said
_NONE = 1e-3  # least frequency of a level: none is impossible


def session_row(path: Path, planted: str) -> dict:
    """Evidence of the planted effect by level, of the likest once it is left out, and what is named with and without it."""
    with open_acquisition(path) as acquisition:
        session = prepare_session(acquisition, twin=None, rng=np.random.default_rng(0))
        weighed = weigh_problem(problem_of(session, session.twin))
    problem, observed = weighed.problem, weighed.observed
    parts = {"parts": problem.parts, "part_names": problem.part_names}
    row = {"planted": planted, **told(weighed.hypotheses)}
    if planted == "none":
        found = beyond(observed, problem.parts, problem.part_names)
        return row | {"by_chance": list(found.by_size)}
    own = [fit for fit in weighed.fits if fit.curve.effect == planted]
    others = [fit for fit in weighed.fits if fit.curve.effect != planted]
    if own:
        best = max(own, key=lambda fit: fit.log_evidence)
        row["kind"] = [*best.by_level, evidence_with_rest(observed, [best.point], **parts)]
    if others:
        likest = max(others, key=lambda fit: fit.log_evidence)
        row["another"] = [*likest.by_level, evidence_with_rest(observed, [likest.point], **parts)]
        row["likest"] = likest.curve.effect
        row["left_out"] = told(weigh_hypotheses(observed, others, **parts))
    return row


def told(hypotheses) -> dict:
    """What is said of hypotheses: the word, the effects, how probable."""
    verdict = verdict_of(hypotheses)
    return {"verdict": verdict.word, "named": list(verdict.named), "probability": verdict.leading.probability}


def frequencies(rows: list[list[float]]) -> tuple[list[float], float]:
    """Frequencies of the levels, and of a rest, that make evidences (session, level and last the one with a rest) likeliest.

    A session in which the effect does not show tells nothing and is left out.
    """
    known = [np.array(row) for row in rows if max(row) > _CLEAR and len(row) == len(LEVELS.levels) + 1]
    levels, rest = np.full(len(LEVELS.levels), 1.0 / len(LEVELS.levels)), 0.5
    for _ in range(_ROUNDS):
        taken, with_rest = np.zeros(len(levels)), 0.0
        for row in known:
            scores = np.concatenate([row[:-1] + np.log(levels * (1.0 - rest)), [row[-1] + math.log(rest)]])
            shares = np.exp(scores - np.logaddexp.reduce(scores))
            taken += shares[:-1]
            with_rest += shares[-1]
            taken[int(np.argmax(row[:-1]))] += shares[-1]
        levels = np.maximum(taken / taken.sum(), _NONE)
        levels /= levels.sum()
        rest = min(max(with_rest / len(known), _NONE), 1.0 - _NONE)
    return [round(float(one), 3) for one in levels], round(float(rest), 3)


def learn(paths: list[Path]) -> None:
    """Print the table of `diagnosis/inference/discrepancy.toml`, and the scores of the sessions that it comes from."""
    rows = [row for path in paths for row in json.loads(path.read_text())]
    kind, rest_of_kind = frequencies([row["kind"] for row in rows if "kind" in row])
    another, rest_of_another = frequencies([row["another"] for row in rows if "another" in row])
    print(f"levels = {list(LEVELS.levels)}\nof_kind = {kind}\nof_another = {another}")
    print(f"rest_of_kind = {rest_of_kind}\nrest_of_another = {rest_of_another}")
    single = [row for row in rows if row["planted"] not in ("none", *plain.UNKNOWN)]
    print(f"# named alone {sum(row['named'] == [row['planted']] for row in single)} of {len(single)}")
    wrong = [row for row in single if set(row["named"]) - {row["planted"]}]
    print(f"# a wrong name {len(wrong)}; once left out unknown or none ", end="")
    left = [row["left_out"]["verdict"] for row in single if "left_out" in row]
    print(f"{sum(word in (UNKNOWN, 'no_gap') for word in left)} of {len(left)}")
    off = [max(row["by_chance"]) > _CLEAR for row in rows if "by_chance" in row]
    print(f"# without an effect: one family off in {sum(off)} of {len(off)}")


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
        singles = [case for case in singles if case in law_families.FAMILIES]
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
