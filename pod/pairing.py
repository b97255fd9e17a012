"""Two tables whose images or networks may be the same ones."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .answer import trials_from_table
from .table import PodTable
from .trials import Trials


def paired_trials(tables: Sequence[PodTable], *, log_size: bool) -> tuple[list[Trials], dict[str, bool]]:
    """Trials of both tables with labels coded alike, and which labels the two share (more than half of the fewer)."""
    shared = {}
    for name in ("network", "image"):
        one, two = (getattr(table, name) for table in tables)
        names = [set(labels or ()) for labels in (one, two)]
        shared[name] = bool(names[0] and names[1] and 2 * len(names[0] & names[1]) > min(len(names[0]), len(names[1])))
    trials = [trials_from_table(table, log_size=log_size) for table in tables]
    return _coded_alike(trials, tables), shared


def _coded_alike(trials: list[Trials], tables: Sequence[PodTable]) -> list[Trials]:
    result = list(trials)
    for name in ("network", "image"):
        labels = [getattr(table, name) for table in tables]
        if any(column is None for column in labels):
            continue
        codes = np.unique(np.array([*labels[0], *labels[1]]), return_inverse=True)[1].astype(np.intp)
        cut = len(labels[0])
        result = [
            replace(one, **{name: part})  # type: ignore[arg-type]
            for one, part in zip(result, (codes[:cut], codes[cut:]), strict=True)
        ]
    return result
