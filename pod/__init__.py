"""Probability of detection: hit/miss and response curves, their bounds, repeated looks, comparison, planning, plots."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .false_alarms import FalseAlarmRate as FalseAlarmRate
    from .false_alarms import false_alarm_rate as false_alarm_rate
    from .hit_miss import Bounds as Bounds
    from .hit_miss import CrossedEffects as CrossedEffects
    from .hit_miss import PodFit as PodFit
    from .hit_miss import fit_pod as fit_pod
    from .links import LINKS as LINKS
    from .models import Alternative as Alternative
    from .models import compare_models as compare_models
    from .solver import BatchFit as BatchFit
    from .solver import fit_batch as fit_batch
    from .table import PodTable as PodTable
    from .table import read_pod_table as read_pod_table
    from .trials import Trials as Trials
    from .trials import check_trials as check_trials

# public name -> module; imported when first asked for
_HOME = {
    "Alternative": "models",
    "BatchFit": "solver",
    "Bounds": "hit_miss",
    "CrossedEffects": "hit_miss",
    "FalseAlarmRate": "false_alarms",
    "LINKS": "links",
    "PodFit": "hit_miss",
    "PodTable": "table",
    "Trials": "trials",
    "check_trials": "trials",
    "compare_models": "models",
    "false_alarm_rate": "false_alarms",
    "fit_batch": "solver",
    "fit_pod": "hit_miss",
    "read_pod_table": "table",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
