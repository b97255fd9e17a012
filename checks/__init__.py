"""Before anything is computed: what measurements allow, what is suspicious, and whether series show what their labels say.

Files:
    check               an acquisition, a folder or a twin, top to bottom
    check_series        the series of an acquisition
    check_result        the answer
    findings            codes and sentences
    allowances          what series serve for, what can be learnt, what to measure next
    series_scan         what is asked of one series' frames, in one pass
    frame_signs         signs of processing
    declared            anodes, voltages and materials that nobody knows
    loads_and_clocks    levels against tube loads, times against frames
    labels              labels that the frames contradict, top to bottom
    readings            label, mean frame and noise of each series
    beam_checks         beam on or off, field empty or not
    map_checks          thickness maps that do not fit the shadow
    relabelling         another kV, filter, load or exposure than stated
    label_model         what labels let expect

Names are loaded when they are first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .check import check_acquisition
    from .check_result import CheckResult
    from .findings import Finding, FindingCode, Severity

_LAZY = {
    "CheckResult": "check_result",
    "Finding": "findings",
    "FindingCode": "findings",
    "Severity": "findings",
    "check_acquisition": "check",
}

__all__ = ["CheckResult", "Finding", "FindingCode", "Severity", "check_acquisition"]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_LAZY[name]}", __name__), name)
