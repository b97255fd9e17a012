"""Ambiguous diagnoses after the measurement that they ask for: how often is the tie broken, and broken rightly?

Sessions of the virtual lab at one tube voltage cannot tell a kV error from a layer in the beam. Where the answer is ambiguous,
the measurement that isolates both (wedges and flats at two voltages, another day) is taken, joins the session (`--also`),
and the session is diagnosed again.

    python validation/broken_ties.py --cases 20 --seed 2400 --json build/broken_ties.json
"""

import argparse
import contextlib
import io
import json
import tempfile
from pathlib import Path

import numpy as np

from raytwin.cli import main

ISOLATING = ["--only", "wedge", "--only", "filtered_flats"]
GROUPS = {"flat": "filtered_flats", "product": "product"}
NAMED_FROM = 0.6


def answer_of(words: list[str]) -> dict:
    """The JSON answer of a raytwin command."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        code = main([*words, "--json"])
    if code != 0:
        raise RuntimeError(f"raytwin {' '.join(words)} ended with {code}")
    return json.loads(out.getvalue())


def drawn_effect(rng: np.random.Generator) -> tuple[str, float]:
    """A kV error or a layer, even in the logarithm over the range where 90 kV alone sees it but hardly knows which it is."""
    if rng.random() < 0.5:
        return "kv_error", float(np.exp(rng.uniform(np.log(0.2), np.log(1.2))) * rng.choice([-1.0, 1.0]))
    return "filtration_error", float(np.exp(rng.uniform(np.log(0.03), np.log(0.2))))


def one_case(seed: int, folder: Path, size: int) -> dict:
    """Truth, first verdict, and what became of a tie."""
    effect, strength = drawn_effect(np.random.default_rng([seed, 7]))
    common = ["--seed", str(seed), "--size", str(size)]
    session, more = str(folder / "session.h5"), str(folder / "more.h5")
    planted = f"{effect}={strength:.3g}"
    answer_of(["lab", "-o", session, "--protocol", "short", "--leave-out", "low_kV", "--effect", planted, *common])
    first = answer_of(["diagnose", session, "-o", str(folder / "first")])
    row = {"seed": seed, "effect": effect, "strength": strength, "first": first["verdict"], "broken": None}
    row["first_causes"] = [[cause["effect"], round(cause["probability"], 3)] for cause in first["causes"]]
    if first["verdict"] != "ambiguous":
        return row
    row["asked"] = first["next_measurement"]["text"]
    words = ["lab", "-o", more, "--session", "1", "--effect", f"{planted}@always", *common]
    if row["asked"].startswith("take "):
        group = next(group for name, group in GROUPS.items() if first["next_measurement"]["series"].startswith(name))
        words += ["--protocol", "short", "--frames", "200", "--only", group]
    else:
        words += ["--protocol", "full", *ISOLATING]
    answer_of(words)
    second = answer_of(["diagnose", session, "-o", str(folder / "second"), "--also", more])
    row["second"] = second["verdict"]
    row["second_causes"] = [[cause["effect"], round(cause["probability"], 3)] for cause in second["causes"]]
    named = [cause["effect"] for cause in second["causes"] if cause["probability"] >= NAMED_FROM]
    row["broken"] = "rightly" if named == [effect] else "wrongly" if named and effect not in named else "not"
    return row


def run() -> None:
    """Cases one after the other; a line each, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10)
    parser.add_argument("--seed", type=int, default=2400, help="of the first case; the next ones follow (default 2400)")
    parser.add_argument("--size", type=int, default=128, help="pixels a side (default 128)")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    for seed in range(arguments.seed, arguments.seed + arguments.cases):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(one_case(seed, Path(folder), arguments.size))
        print(json.dumps(rows[-1]), flush=True)
        if arguments.json is not None:
            arguments.json.parent.mkdir(parents=True, exist_ok=True)
            arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    ties = [row for row in rows if row["first"] == "ambiguous"]
    counts = {word: sum(row["broken"] == word for row in ties) for word in ("rightly", "wrongly", "not")}
    print(f"{len(rows)} sessions, {len(ties)} ties: {counts}")


if __name__ == "__main__":
    run()
