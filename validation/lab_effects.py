"""Each effect that the virtual lab draws, alone (but a composition): is it named, and does its interval hold what was planted?

    python validation/lab_effects.py --seed 2960 --json build/lab_effects/2960.json [--only EFFECT ...]
    python validation/lab_effects.py --strengths build/lab_effects/*.json

A session of the full protocol for each effect, 128 x 128 pixels, 30 frames a series; system, strength (the stronger half of the
plausible range, even in its logarithm) and onset are drawn from the seed. Lab and catalogue mean the same by a strength, though their
laws differ. `--strengths` tells, effect by effect, how far strengths were off in all sessions in which the effect was named, and what
`Reading.law_sd` would be by them: its default, 0.12, counts as much as four sessions. Rows also serve `learn_discrepancy.py --learn`.
"""

import argparse
import json
import math
import tempfile
import zlib
from pathlib import Path

import numpy as np
from learn_discrepancy import row_of

from raytwin.acquisition import open_acquisition
from raytwin.diagnosis.judgement.judgement import verdict_of
from raytwin.diagnosis.judgement.strengths import strength_of
from raytwin.diagnosis.problem.assemble import problem_of
from raytwin.diagnosis.session.preparation import prepare_session
from raytwin.generator.effects import EFFECTS
from raytwin.generator.effects.effect import Reading
from raytwin.generator.line.twin import Z95
from raytwin.lab import EffectRequest, run_protocol
from raytwin.lab.cases import COARSE, FINE, MAY_COME_LATER
from raytwin.lab.effects import EFFECTS as LAWS

HARDLY_SHOWN = ("composition_error",)  # some per cent lie within what attenuation tables leave open (LIMITS weak-1)
_COUNTS_AS = 4.0  # sessions: what is known of laws in general


def request_of(effect: str, rng: np.random.Generator) -> tuple[EffectRequest, str]:
    """A clear strength of an effect, its onset, and the bench on which it shows."""
    law = LAWS[effect]
    strength = math.exp(rng.uniform(0.5 * (math.log(law.low) + math.log(law.high)), math.log(law.high)))
    strength = float(f"{strength:.4g}") * (-1.0 if law.signed and rng.random() < 0.5 else 1.0)
    since = "calibration" if effect in MAY_COME_LATER and rng.random() < 0.25 else law.since
    either = ("fine", "coarse")[int(rng.integers(2))]
    geometry = "fine" if effect in FINE else "coarse" if effect in COARSE else either
    return EffectRequest(id=effect, strength=strength, since=since), geometry


def session_row(path: Path, request: EffectRequest) -> dict:
    """What a session says of the effect that was planted in it."""
    with open_acquisition(path) as acquisition:
        session = prepare_session(acquisition, twin=None, rng=np.random.default_rng(0))
        row, weighed = row_of(problem_of(session), request.id)
    leading = verdict_of(weighed.hypotheses).leading
    row |= {"strength": request.strength, "since": request.since}
    if request.id in leading.variants:
        sign = leading.variants[request.id].variant.sign
        row["found"] = [sign * value for value in strength_of(weighed.problem, leading, request.id)]
        row["fitted"] = [sign * value for value in leading.strengths[request.id]]
    return row


def tell_strengths(paths: list[Path]) -> None:
    """Print how far strengths were off, by effect and in all."""
    rows = [row for path in paths for row in json.loads(path.read_text()) if "found" in row]
    rows = [row for row in rows if row["found"][0] / row["strength"] > 0.0]
    print(f"{'effect':18s} {'sessions':>8s} {'off, rms':>9s} {'held':>9s} {'law_sd':>7s}  planted: found (low to high)")
    for effect in sorted({row["planted"] for row in rows}):
        own = [row for row in rows if row["planted"] == effect]
        off = np.array([math.log(row["found"][0] / row["strength"]) for row in own])
        of_fit = np.array([math.log(row["fitted"][2] / row["fitted"][1]) / (2.0 * Z95) for row in own])
        beyond = float(np.sum(np.maximum(off**2 - of_fit**2, 0.0)))
        sd = math.sqrt((_COUNTS_AS * Reading().law_sd ** 2 + beyond) / (_COUNTS_AS + len(own)))
        told = ", ".join(
            f"{row['strength']:.4g}: {row['found'][0]:.4g} ({row['found'][1]:.4g} to {row['found'][2]:.4g})"
            for row in own
        )
        rms = math.sqrt(float(np.mean(off**2)))
        print(f"{effect:18s} {len(own):8d} {100 * rms:8.1f}% {held(own):>9s} {sd:7.3f}  {told}")
    print(f"all {len(rows)}: held {held(rows)}")


def held(rows: list[dict]) -> str:
    """How many intervals hold the planted strength."""
    inside = sum(min(row["found"][1:]) <= row["strength"] <= max(row["found"][1:]) for row in rows)
    return f"{inside} of {len(rows)}"


def main() -> None:
    """Sessions of one seed, or what all say of strengths."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=2960, help="of the first system; each effect has one of its own")
    parser.add_argument("--only", nargs="+", metavar="EFFECT")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--strengths", nargs="+", type=Path, metavar="JSON")
    options = parser.parse_args()
    if options.strengths:
        tell_strengths(options.strengths)
        return
    rows = []
    shown = [effect for effect, law in LAWS.items() if effect in EFFECTS and law.drawn and effect not in HARDLY_SHOWN]
    for number, effect in enumerate(shown):
        if options.only and effect not in options.only:
            continue
        rng = np.random.default_rng([options.seed, zlib.crc32(effect.encode())])
        request, geometry = request_of(effect, rng)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "session.h5"
            run_protocol(
                path, protocol="full", seed=options.seed + number, geometry=geometry, frames=30, effects=(request,)
            )
            row = {"line": f"lab, {geometry}", **session_row(path, request)}
        rows.append(row)
        found = "".join(f"{value:10.4g}" for value in row.get("found", ()))
        print(
            f"{effect:18s} {request.strength:9.4g} {row['verdict']:18s} {'+'.join(row['named']):34s}{found}", flush=True
        )
        if options.json:
            options.json.parent.mkdir(parents=True, exist_ok=True)
            options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
