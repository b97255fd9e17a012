"""Ambiguous diagnoses after the measurement that they ask for: how often is the tie broken, and broken rightly?

Short sessions of the virtual lab (darks, flats, products) with one effect near the least that shows, of sets that such sessions
hardly tell apart. Where the answer is ambiguous, the measurement that it asks for is taken on another day of the same line, joins
the session (`--also`), and the session is diagnosed again.

    python validation/broken_ties.py --cases 40 --seed 2600 --json build/broken_ties.json
"""

import argparse
import contextlib
import io
import json
import tempfile
from pathlib import Path

import numpy as np

from raytwin.cli import main

# the measurement that is asked for, as groups of the lab's full session
GROUPS_OF = {
    "afterglow": ["afterglow"],
    "darks": ["filtered_flats"],
    "discs": ["disc"],
    "edges": ["edge"],
    "timed edges": ["edge"],
    "slabs": ["slab"],
    "wedge": ["wedge"],
    "voltage": ["filtered_flats", "wedge", "edge"],
    "filter": ["open_flats"],
    "exposures": ["filtered_flats"],
    "turned": ["turned"],
}
ISOLATING = ["wedge", "filtered_flats"]  # where no single measurement would do
REPEATED = {"flat": "filtered_flats", "product": "product"}
# set: (effect, least and largest strength) of which one is planted; options of the session
FAMILIES = {
    "scatter or glare": ((("veiling_glare", 0.5, 1.5), ("object_scatter", 1.0, 4.0)), ["--geometry", "coarse"]),
    "kV or layer": ((("kv_error", 0.5, 1.2), ("filtration_error", 0.03, 0.15)), ["--leave-out", "low_kV"]),
    "source or panel": ((("focal_spot", 0.15, 0.5), ("mtf_tail", 2.0, 8.0)), ["--geometry", "fine"]),
    "lag or drift": ((("image_lag", 0.02, 0.1), ("output_drift", 0.1, 0.3), ("dark_drift", 1.0, 4.0)), []),
}
NAMED_FROM = 0.6


def answer_of(words: list[str]) -> dict:
    """The JSON answer of a raytwin command."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        code = main([*words, "--json"])
    if code != 0:
        raise RuntimeError(f"raytwin {' '.join(words)} ended with {code}")
    return json.loads(out.getvalue())


def drawn_effect(rng: np.random.Generator) -> tuple[str, str, float]:
    """Family, effect and strength, even in the logarithm; signs by chance where they have one."""
    family = str(rng.choice(sorted(FAMILIES)))
    choices = FAMILIES[family][0]
    effect, low, high = choices[int(rng.integers(len(choices)))]
    sign = float(rng.choice([-1.0, 1.0])) if effect == "kv_error" else 1.0
    return family, effect, sign * float(np.exp(rng.uniform(np.log(low), np.log(high))))


def one_case(seed: int, folder: Path, *, protocol: str, size: int, frames: int) -> dict:
    """Truth, first verdict, and what became of a tie."""
    family, effect, strength = drawn_effect(np.random.default_rng([seed, 7]))
    common = ["--seed", str(seed), "--size", str(size)]
    options = FAMILIES[family][1]
    geometry = options if "--geometry" in options else []
    session, more = str(folder / "session.h5"), str(folder / "more.h5")
    planted = f"{effect}={strength:.3g}"
    words = ["lab", "-o", session, "--protocol", protocol, *options, "--effect", planted, "--frames", str(frames)]
    answer_of([*words, *common])
    first = answer_of(["diagnose", session, "-o", str(folder / "first")])
    row = {"seed": seed, "family": family, "effect": effect, "strength": strength}
    row |= {"first": first["verdict"], "broken": None}
    row["first_causes"] = [[cause["effect"], round(cause["probability"], 3)] for cause in first["causes"]]
    if first["verdict"] != "ambiguous":
        return row
    asked = first["next_measurement"]
    row["asked"] = asked["text"]
    words = ["lab", "-o", more, "--session", "1", "--effect", f"{planted}@always", *geometry, *common]
    if "measurement" in asked:
        groups = GROUPS_OF[asked["measurement"]]
    elif asked["text"].startswith("take "):
        groups = [next(group for name, group in REPEATED.items() if asked["series"].startswith(name))]
        words += ["--frames", "200"]
    else:
        groups = ISOLATING
    words += ["--protocol", "short" if "--frames" in words else "full"]
    for group in groups:
        words += ["--only", group]
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
    parser.add_argument("--seed", type=int, default=2600, help="of the first case; the next ones follow (default 2600)")
    parser.add_argument("--protocol", choices=("short", "products"), default="short", help="of the first session")
    parser.add_argument("--size", type=int, default=64, help="pixels a side (default 64)")
    parser.add_argument("--frames", type=int, default=6, help="of each flat of the first session (default 6)")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    for seed in range(arguments.seed, arguments.seed + arguments.cases):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(
                one_case(seed, Path(folder), protocol=arguments.protocol, size=arguments.size, frames=arguments.frames)
            )
        print(json.dumps(rows[-1]), flush=True)
        if arguments.json is not None:
            arguments.json.parent.mkdir(parents=True, exist_ok=True)
            arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    ties = [row for row in rows if row["first"] == "ambiguous"]
    counts = {word: sum(row["broken"] == word for row in ties) for word in ("rightly", "wrongly", "not")}
    print(f"{len(rows)} sessions, {len(ties)} ties: {counts}")


if __name__ == "__main__":
    run()
