"""Two tables whose images or networks may be the same ones."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .answer import trials_from_table
from .table import PodTable
from .trials import Trials

OTHER_OBJECTS = "images of the same name hold objects of other sizes in the two tables: they are not paired"
_BY_CHANCE = 1e-3  # probability that sizes of other objects are taken for those of the same ones


def paired_trials(
    tables: Sequence[PodTable], *, log_size: bool
) -> tuple[list[Trials], dict[str, bool], tuple[str, ...]]:
    """Trials of both tables with labels coded alike, which labels the two share (more than half of the fewer), and warnings."""
    shared = {}
    for name in ("network", "image"):
        one, two = (getattr(table, name) for table in tables)
        names = [set(labels or ()) for labels in (one, two)]
        shared[name] = bool(names[0] and names[1] and 2 * len(names[0] & names[1]) > min(len(names[0]), len(names[1])))
    other = shared["image"] and not _same_objects(*tables)
    shared["image"] = shared["image"] and not other
    trials = [trials_from_table(table, log_size=log_size) for table in tables]
    return _coded_alike(trials, tables), shared, ((OTHER_OBJECTS,) if other else ())


def _same_objects(first: PodTable, second: PodTable) -> bool:
    """Whether images of one name hold the same objects: sizes are equal, or rise together more than by chance (Spearman's test)."""
    from scipy.stats import spearmanr

    means = []
    for table in (first, second):
        labels, places = np.unique(np.array(table.image or (), dtype=str), return_inverse=True)
        means.append(
            dict(zip(labels.tolist(), np.bincount(places, weights=table.size) / np.bincount(places), strict=True))
        )
    common = sorted(means[0].keys() & means[1].keys())
    one, two = (np.array([each[label] for label in common]) for each in means)
    if np.allclose(one, two, rtol=1e-6):
        return True
    if len(common) < 3 or np.ptp(one) == 0.0 or np.ptp(two) == 0.0:
        return False
    return float(spearmanr(one, two, alternative="greater").pvalue) < _BY_CHANCE


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
