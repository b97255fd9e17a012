"""Probability of detection: hit/miss and response curves, their bounds, repeated looks, comparison, planning, plots."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .as_published import AsPublished as AsPublished
    from .as_published import fit_as_published as fit_as_published
    from .band import curve_rows as curve_rows
    from .band import curve_with_band as curve_with_band
    from .band import write_curve_table as write_curve_table
    from .bootstrap import BootstrapSizes as BootstrapSizes
    from .bootstrap import bootstrap_pod as bootstrap_pod
    from .bootstrap import fit_many as fit_many
    from .comparison import Comparison as Comparison
    from .comparison import compare_pod as compare_pod
    from .covariates import CovariateFit as CovariateFit
    from .covariates import SizeAt as SizeAt
    from .covariates import fit_covariates as fit_covariates
    from .covariates import size_at as size_at
    from .explanation import Property as Property
    from .explanation import explain_detection as explain_detection
    from .false_alarms import FalseAlarmRate as FalseAlarmRate
    from .false_alarms import false_alarm_rate as false_alarm_rate
    from .hit_miss import Bounds as Bounds
    from .hit_miss import CrossedEffects as CrossedEffects
    from .hit_miss import PodFit as PodFit
    from .lapse import LapseFit as LapseFit
    from .lapse import fit_lapse_pod as fit_lapse_pod
    from .likelihood import joint_region as joint_region
    from .links import LINKS as LINKS
    from .models import Alternative as Alternative
    from .models import compare_models as compare_models
    from .planning import AssumedCurve as AssumedCurve
    from .planning import Plan as Plan
    from .planning import Precision as Precision
    from .planning import expected_precision as expected_precision
    from .planning import plan_pod as plan_pod
    from .planning import recommended_sizes as recommended_sizes
    from .repeats import fit_pod as fit_pod
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
    "AsPublished": "as_published",
    "AssumedCurve": "planning",
    "BatchFit": "solver",
    "BootstrapSizes": "bootstrap",
    "Bounds": "hit_miss",
    "Comparison": "comparison",
    "CovariateFit": "covariates",
    "CrossedEffects": "hit_miss",
    "FalseAlarmRate": "false_alarms",
    "LINKS": "links",
    "LapseFit": "lapse",
    "Plan": "planning",
    "PodFit": "hit_miss",
    "PodTable": "table",
    "Precision": "planning",
    "Property": "explanation",
    "ResponseFit": "response",
    "Roc": "roc",
    "SizeAt": "covariates",
    "Trials": "trials",
    "bootstrap_pod": "bootstrap",
    "check_trials": "trials",
    "compare_models": "models",
    "compare_pod": "comparison",
    "compute_roc": "roc",
    "curve_rows": "band",
    "curve_with_band": "band",
    "expected_precision": "planning",
    "explain_detection": "explanation",
    "false_alarm_rate": "false_alarms",
    "fit_as_published": "as_published",
    "fit_batch": "solver",
    "fit_covariates": "covariates",
    "fit_lapse_pod": "lapse",
    "fit_many": "bootstrap",
    "fit_pod": "repeats",
    "fit_response_pod": "response",
    "joint_region": "likelihood",
    "plan_pod": "planning",
    "read_pod_table": "table",
    "recommended_sizes": "planning",
    "size_at": "covariates",
    "write_curve_table": "band",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
