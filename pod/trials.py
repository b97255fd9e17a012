"""Trials: sizes with hits and misses, checked once and grouped by size. What every hit/miss fit starts from."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..results import ByValue

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trials(ByValue):
    """Hit/miss trials, one row each or grouped: size (row,) in the user's unit, hits and misses (row,) as counts.

    network, image and site are codes 0, 1, ... (row,) of who looked and at what, or None where that is not known.
    """

    size: Array
    hits: Array
    misses: Array
    network: NDArray[np.intp] | None = None
    image: NDArray[np.intp] | None = None
    site: NDArray[np.intp] | None = None

    @property
    def n(self) -> int:
        """Number of trials."""
        return round(float(self.hits.sum() + self.misses.sum()))

    @property
    def n_hits(self) -> int:
        """Number of hits."""
        return round(float(self.hits.sum()))


def check_trials(
    size: ArrayLike,
    hits: ArrayLike,
    *,
    trials: ArrayLike | None = None,
    network: ArrayLike | None = None,
    image: ArrayLike | None = None,
    site: ArrayLike | None = None,
    log_size: bool = False,
    places: Sequence[str] = (),
) -> Trials:
    """Trials from columns, or an error that names the column at fault.

    Args:
        size: (row,), finite; above 0 where `log_size`.
        hits: (row,), 0 or 1; with `trials`, whole numbers from 0 to the row's trials.
        trials: (row,), whole numbers of 1 or more; None = one trial a row.
        network, image, site: (row,), labels of any type.
        log_size: whether the fit will take the logarithm of the size.
        places: what each row is called in a message; empty: `row 1`, `row 2`, ...

    Raises:
        InputError: shapes differ, a value is missing or outside its range, or there are no rows.
    """

    def place(row: int) -> str:
        return places[row] if places else f"row {row + 1}"

    x = _numbers("size", size, place)
    hit = _numbers("hit", hits, place)
    total = np.ones(len(x)) if trials is None else _numbers("trials", trials, place)
    if not len(x):
        raise InputError("size", received="no rows", expected="at least two trials with a size")
    for name, column in (("hit", hit), ("trials", total)):
        if len(column) != len(x):
            raise InputError(name, received=f"{len(column)} rows", expected=f"{len(x)} rows, as many as sizes")
    if log_size and not np.all(x > 0):
        row = int(np.flatnonzero(~(x > 0))[0])
        raise InputError(
            "size",
            received=f"{x[row]:g} in {place(row)}",
            expected="sizes above 0 where the curve is on log size",
            remedy="fit on the size itself",
        )
    if trials is None:
        wrong = ~np.isin(hit, (0.0, 1.0))
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise InputError("hit", received=f"{hit[row]:g} in {place(row)}", expected="0 (miss) or 1 (hit)")
    else:
        wrong = ~((total >= 1) & (total == np.round(total)))
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise InputError("trials", received=f"{total[row]:g} in {place(row)}", expected="a whole number >= 1")
        wrong = ~((hit >= 0) & (hit <= total) & (hit == np.round(hit)))
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise InputError(
                "hit",
                received=f"{hit[row]:g} of {total[row]:g} trials in {place(row)}",
                expected="a whole number from 0 to the number of trials",
            )
    labels = {"network": network, "image": image, "site": site}
    return Trials(
        size=x,
        hits=hit,
        misses=total - hit,
        **{name: None if label is None else codes_from_labels(name, label, len(x)) for name, label in labels.items()},
    )


def codes_from_labels(name: str, labels: ArrayLike, rows: int) -> NDArray[np.intp]:
    """Codes 0, 1, ... (row,) of labels of any type, in sorted order."""
    column = np.asarray(labels)
    if column.shape != (rows,):
        raise InputError(name, received=f"shape {column.shape}", expected=f"one label for each of the {rows} rows")
    return np.asarray(np.unique(column.astype(str), return_inverse=True)[1], dtype=np.intp)


def group_by_size(x: Array, hits: Array, misses: Array) -> tuple[Array, Array, Array]:
    """Distinct x in rising order with their summed hits and misses; x, hits, misses (row,) -> three (distinct,).

    Exact: the likelihood of a curve on x depends on nothing else.
    """
    distinct, where = np.unique(x, return_inverse=True)
    up = np.bincount(where, weights=hits, minlength=len(distinct)).astype(float)
    down = np.bincount(where, weights=misses, minlength=len(distinct)).astype(float)
    return distinct, up, down


def _numbers(name: str, values: Any, place: Callable[[int], str]) -> Array:
    try:
        column = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise InputError(name, received="values that are no numbers", expected="a column of numbers") from None
    if column.ndim != 1:
        raise InputError(name, received=f"an array of shape {column.shape}", expected="one column (row,)")
    wrong = ~np.isfinite(column)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise InputError(
            name,
            received=f"{column[row]} in {place(row)} ({int(wrong.sum())} such rows)",
            expected="finite numbers",
            remedy="fill in or remove these rows",
        )
    return column
