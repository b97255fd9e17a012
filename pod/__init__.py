"""Probability of detection: hit/miss and response curves, their bounds, repeated looks, comparison, planning, plots."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .bootstrap import BootstrapSizes as BootstrapSizes
    from .bootstrap import bootstrap_pod as bootstrap_pod
    from .bootstrap import fit_many as fit_many
    from .comparison import Comparison as Comparison
    from .comparison import compare_pod as compare_pod
    from .false_alarms import FalseAlarmRate as FalseAlarmRate
    from .false_alarms import false_alarm_rate as false_alarm_rate
    from .hit_miss import Bounds as Bounds
    from .hit_miss import CrossedEffects as CrossedEffects
    from .hit_miss import PodFit as PodFit
    from .hit_miss import fit_pod as fit_pod
    from .lapse import LapseFit as LapseFit
    from .lapse import fit_lapse_pod as fit_lapse_pod
    from .links import LINKS as LINKS
    from .models import Alternative as Alternative
    from .models import compare_models as compare_models
    from .response import ResponseFit as ResponseFit
    from .response import fit_response_pod as fit_response_pod
    from .roc import Roc as Roc
    from .roc import compute_roc as compute_roc
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
    "BootstrapSizes": "bootstrap",
    "Bounds": "hit_miss",
    "Comparison": "comparison",
    "CrossedEffects": "hit_miss",
    "FalseAlarmRate": "false_alarms",
    "LINKS": "links",
    "LapseFit": "lapse",
    "PodFit": "hit_miss",
    "PodTable": "table",
    "ResponseFit": "response",
    "Roc": "roc",
    "Trials": "trials",
    "bootstrap_pod": "bootstrap",
    "check_trials": "trials",
    "compare_models": "models",
    "compare_pod": "comparison",
    "compute_roc": "roc",
    "false_alarm_rate": "false_alarms",
    "fit_batch": "solver",
    "fit_lapse_pod": "lapse",
    "fit_many": "bootstrap",
    "fit_pod": "hit_miss",
    "fit_response_pod": "response",
    "read_pod_table": "table",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
