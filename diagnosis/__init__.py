"""raytwin.diagnosis: where the gap between measured and simulated lies, which effect explains it, how far it shrinks."""

from importlib import import_module
from typing import Any

_PLACES = {
    "Diagnosis": "judgement.answer",
    "diagnose": "diagnose_session",
    "diagnosis_answer": "judgement.answer",
    "build_problem": "problem.assemble",
    "summarise_series": "session.summaries",
    "plan_session": "advice.plan_session",
    "weigh_hypotheses": "inference.inference",
}

__all__ = [
    "Diagnosis",
    "build_problem",
    "diagnose",
    "diagnosis_answer",
    "summarise_series",
    "weigh_hypotheses",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_PLACES[name]}", __name__), name)
