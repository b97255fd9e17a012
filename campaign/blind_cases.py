"""Labels of a blind check: what is wrong in each case, drawn from a seed before anything is measured, and their seal.

Case i of a stream depends on the seed, the stream and i alone, so that it does not matter which worker makes it. The
session's own seed is drawn with 62 bits: it meets no seed that anyone has typed.
"""

import hashlib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..lab.cases import SETS, Case, draw_case
from ..lab.effects import EFFECTS, EffectRequest
from ._plain import canonical

STREAMS = {"case": 0, "train": 1}
_DOMAIN = 0x626C696E64  # keeps these draws apart from every other use of the same seed
_SMALLEST_SEED, _LARGEST_SEED = 10**12, 2**62


@dataclass(frozen=True, slots=True, kw_only=True)
class BlindCase:
    """A case and the seed of its session. Fields: stream (`case`, `train`); index; session_seed; case."""

    stream: str
    index: int
    session_seed: int
    case: Case

    def label(self) -> dict[str, Any]:
        """What is sealed: everything that decides the session, as JSON has it."""
        return {
            "stream": self.stream,
            "index": self.index,
            "session_seed": self.session_seed,
            "label": self.case.label,
            "effects": [
                {"id": item.id, "strength": item.strength, "since": item.since or EFFECTS[item.id].since}
                for item in self.case.requests
            ],
            "protocol": self.case.protocol,
            "geometry": self.case.geometry,
            "leave_out": list(self.case.leave_out),
        }


def case_from_label(label: Mapping[str, Any]) -> BlindCase:
    """The case that a label states."""
    return BlindCase(
        stream=label["stream"],
        index=label["index"],
        session_seed=label["session_seed"],
        case=Case(
            label=label["label"],
            requests=tuple(
                EffectRequest(id=item["id"], strength=item["strength"], since=item["since"])
                for item in label["effects"]
            ),
            protocol=label["protocol"],
            geometry=label["geometry"],
            leave_out=tuple(label["leave_out"]),
        ),
    )


def names_of_sets(words: Sequence[str]) -> tuple[str, ...]:
    """Ids of the catalogue's effects that sets (`A` to `E`) or single ids stand for, in the catalogue's order.

    Raises:
        InputError: a word that is neither.
    """
    chosen: set[str] = set()
    known = [name for name, law in EFFECTS.items() if law.known]
    for word in words:
        if word.upper() in SETS:
            chosen.update(SETS[word.upper()])
        elif word in known:
            chosen.add(word)
        else:
            raise InputError("--only", received=word, expected="sets A to E or ids: " + ", ".join(known))
    return tuple(name for name in known if name in chosen)


def draw_cases(
    *, seed: int, stream: str, count: int, names: tuple[str, ...] | None = None, singles: bool = False
) -> tuple[BlindCase, ...]:
    """The cases of a stream.

    Args:
        seed: of the blind check.
        stream: `case` (judged) or `train` (for the baselines that learn).
        count: how many.
        names: effects of the catalogue to draw from; None: all.
        singles: every case has one effect of the catalogue.
    """
    cases = []
    for index in range(count):
        rng = np.random.default_rng([_DOMAIN, seed, STREAMS[stream], index])
        case = draw_case(rng, label="single" if singles else None, names=names)
        session_seed = int(rng.integers(_SMALLEST_SEED, _LARGEST_SEED))
        cases.append(BlindCase(stream=stream, index=index, session_seed=session_seed, case=case))
    return tuple(cases)


def sealed_text(cases: Sequence[BlindCase], salt: str) -> bytes:
    """What is hashed: salt and labels in their canonical JSON text."""
    return canonical({"salt": salt, "labels": [item.label() for item in cases]})


def seal_of(cases: Sequence[BlindCase], salt: str) -> str:
    """SHA-256 of salt and labels, 64 hexadecimal digits."""
    return hashlib.sha256(sealed_text(cases, salt)).hexdigest()


def development_seeds() -> tuple[range, ...]:
    """Seeds of blind checks that were looked at while the diagnosis was developed; their scores prove nothing."""
    table = tomllib.loads((Path(__file__).parent / "development_seeds.toml").read_text(encoding="utf-8"))
    return tuple(range(low, high + 1) for low, high in table["blind_check"])


def is_development_seed(seed: int) -> bool:
    """Whether this seed's cases were looked at while the diagnosis was developed."""
    return any(seed in seeds for seeds in development_seeds())
