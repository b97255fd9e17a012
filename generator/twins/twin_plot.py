"""Pictures of a twin."""

from typing import TYPE_CHECKING, Any

from ...acquisition.setting import text_from_filters
from ...errors import InputError
from ...results import axes_or_new

if TYPE_CHECKING:
    from ..line.twin import Twin

_LABELS = {"gain_DN": "gain (DN)", "rate_DN_per_mAs": "rate (DN per mAs)"}


def plot_levels(twin: "Twin", *, ax: Any, what: str) -> Any:
    """Gain or rate of the measured levels against kV, one series a filter, with 95 % intervals; returns the axes.

    Raises:
        InputError: another quantity, or no level with a known kV.
    """
    if what not in _LABELS:
        raise InputError("what", received=repr(what), expected="one of " + ", ".join(_LABELS))
    known = [level for level in twin.levels if level.kV is not None and getattr(level, what) is not None]
    if not known:
        raise InputError("twin", received=f"no level with kV and {what}", expected="at least one")
    axes = axes_or_new(ax)
    for filters in dict.fromkeys(text_from_filters(level.filters) for level in known):
        mine = [level for level in known if text_from_filters(level.filters) == filters]
        found = [getattr(level, what) for level in mine]
        values = [item.value for item in found]
        ends = [[item.value - item.low for item in found], [item.high - item.value for item in found]]
        axes.errorbar([level.kV for level in mine], values, yerr=ends, fmt="o", capsize=3, label=filters or "no filter")
    axes.set(xlabel="tube voltage (kV)", ylabel=_LABELS[what])
    axes.legend(frameon=False)
    return axes
