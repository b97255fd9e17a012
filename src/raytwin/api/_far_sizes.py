"""Sizes that lie far from all others: where no curve fits a table, the error says which."""

from collections.abc import Iterator
from contextlib import contextmanager

from ..errors import FitError
from ..pod.table import PodTable

_FAR = 100.0  # ranges of the others: no study has a size so far away


@contextmanager
def naming_far_sizes(**tables: PodTable) -> Iterator[None]:
    """Where a fit fails and one size of a table lies far from all others, the error says in which line or row."""
    try:
        yield
    except FitError:
        for name, table in tables.items():
            told = far_size(table)
            if told:
                raise FitError(f"no curve fits the {name.replace('_', ' ')}: {told}") from None
        raise


def far_size(table: PodTable) -> str:
    """The size that is farther from the nearest other one than `_FAR` times the range of these, in words; empty: none."""
    import numpy as np

    size = np.sort(table.size)
    for far, others in ((size[-1], size[size < size[-1]]), (size[0], size[size > size[0]])):
        if len(others) > 1 and np.abs(others - far).min() > _FAR * np.ptp(others) > 0:
            row = int(np.flatnonzero(table.size == far)[0])
            place = table.places[row] if table.places else f"row {row + 1}"
            return f"the size {far:g} in {place} lies far from all others, {others[0]:g} to {others[-1]:g}; check it"
    return ""
