"""Two POD curves compared: difference and ratio of a90, a test of the whole curves, a verdict."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..pod.answer import default_repeats, fit_answer
from ..pod.table import HitError, PodTable
from ..results import Result, Table, axes_or_new, frame, interval_text, number_text, plain
from ._far_sizes import naming_far_sizes
from .curves import PodCurve, is_response, table_of

if TYPE_CHECKING:
    import pandas

    from ..pod import Comparison
    from .curves import TableLike

_NO_RESPONSES = "curves of a continuous response are not compared"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class PodComparison(Result):
    """Two POD curves beside each other: difference and ratio of a90 with intervals, verdict at a margin.

    Fields: comparison; size_name; repeats; warnings; names (of the two, for plots).
    """

    comparison: "Comparison"
    size_name: str
    repeats: str
    warnings: tuple[str, ...]
    names: tuple[str, str] = ("first", "second")

    @property
    def verdict(self) -> str:
        """`equivalent`, `different`, `different within the margin` or `inconclusive`."""
        return self.comparison.verdict

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin compare --json` prints."""
        found = self.comparison
        test = found.curve_test
        answer: dict[str, Any] = plain(
            {
                "size": self.size_name,
                "first": fit_answer(found.first),
                "second": fit_answer(found.second),
                "difference_a90": asdict(found.difference_a90),
                "ratio_a90": asdict(found.ratio_a90),
                "equivalence": {
                    "margin": found.margin,
                    "low": found.equivalence_low,
                    "high": found.equivalence_high,
                    "p": found.p_equivalence,
                    "verdict": found.verdict,
                },
                "verdict": found.verdict,
                "margin": found.margin,
                "size_equivalence": None if found.size_equivalence is None else asdict(found.size_equivalence),
                "curve_test": None if test is None else asdict(test),
                "paired": found.paired,
                "correlation": found.correlation,
                "correlation_at_bound": found.correlation_at_bound,
                "repeats": self.repeats,
                "warnings": self.warnings,
            }
        )
        return answer

    def to_dataframe(self) -> "pandas.DataFrame":
        """Two rows, one a curve: name, n, n_hits, a50, a90 and the bounds of a90."""
        names = ("n", "n_hits", "a50", "a90", "a90_95", "a90_95_two_sided")
        answer = self.to_dict()
        return frame(
            [
                {"name": name, **{key: answer[which][key] for key in names}}
                for name, which in zip(self.names, ("first", "second"), strict=True)
            ]
        )

    def plot(self, ax: Any = None) -> Any:
        """Both curves with their 95 % bands; returns the axes."""
        from ..pod.plots import draw_both_curves

        axes = axes_or_new(ax)
        draw_both_curves(axes, self.comparison, size_label=self.size_name, names=self.names)
        return axes

    def plot_ratio(self, ax: Any = None) -> Any:
        """The ratio of the two a90 with its 95 and 90 % intervals against the margin; returns the axes."""
        from ..pod.plots import draw_ratio

        axes = axes_or_new(ax, size_inches=(3.2, 4.4))
        draw_ratio(axes, self.comparison)
        return axes

    def _table(self) -> Table:
        answer = self.to_dict()
        rows = [
            (f"a90, {name}", number_text(answer[key]["a90"]), "")
            for name, key in zip(self.names, ("first", "second"), strict=True)
        ]
        rows.append(("difference, second - first", *interval_text(answer["difference_a90"])))
        rows.append(("ratio, second / first", *interval_text(answer["ratio_a90"])))
        if answer["size_equivalence"] is not None:
            held = answer["size_equivalence"]
            ends = " to ".join("none" if held[end] is None else number_text(held[end]) for end in ("low", "high"))
            rows.append((f"difference at a margin of {held['margin']:g}", held["verdict"], f"{ends} (90 %)"))
        title = f"{self.verdict} at a margin of {100 * self.comparison.margin:g} % on a90 ({self.size_name})"
        notes = [f"warning: {text}" for text in self.warnings]
        return Table(title=title, header=("", "value", "95 % interval"), rows=tuple(rows), notes=tuple(notes))


def compare(
    first: "TableLike",
    second: "TableLike",
    *,
    margin: float = 0.1,
    size_margin: float | None = None,
    size: str | None = None,
    hit: str | None = None,
    trials: str | None = None,
    site: str | None = None,
    where: Mapping[str, str] | None = None,
    link: str | None = None,
    log_size: bool | None = None,
    method: str | None = None,
    repeats: str | None = None,
    unpaired: bool = False,
) -> PodComparison:
    """Are two POD curves the same? Difference and ratio of a90 with intervals, a test of the whole curves, a verdict.

    Args:
        first, second: curves of `fit_pod`, or tables as `fit_pod` takes them.
        margin: on a90, as a share of it.
        size_margin: also on the difference of the two a90, in the tables' unit.
        size, hit, trials, site, where: columns of both tables, as for `fit_pod`.
        link, log_size, method, repeats: as for `fit_pod`; None: as the curves were fitted, else the defaults. Where no link was
            asked for and another curve fits one table better, a90's bounds there are those of all curves that fit, as of `fit_pod`.
        unpaired: images and networks of the same name are not the same ones.

    Returns:
        The comparison.

    Raises:
        InputError: different size columns, or curves that were fitted in different ways.

    Example:
        >>> table = {"size_mm": [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4], "hit": [0, 0, 0, 0, 1, 0, 1, 0, 1, 1, 1, 1]}
        >>> curve = rt.fit_pod(table, link="logit")
        >>> rt.compare(curve, curve).comparison.ratio_a90.value
        1.0
    """
    from ..pod import compare_pod
    from ..pod.pairing import paired_trials

    columns = {"size": size, "hit": hit, "trials": trials, "site": site, "where": where}
    tables = [_of_hits(name, table, columns) for name, table in (("first", first), ("second", second))]
    if tables[0].size_name != tables[1].size_name:
        raise InputError(
            "size",
            received=f"{tables[0].size_name} and {tables[1].size_name}",
            expected="the same size column in both tables",
            remedy="name it with size",
        )
    curves = [table for table in (first, second) if isinstance(table, PodCurve)]
    fits = [curve.fit for curve in curves]
    named = link is not None or any(curve.link_named for curve in curves)
    link = _agreed("link", link, [fit.link for fit in fits if not is_response(fit)], "cloglog")
    on_log_size = _agreed("log_size", log_size, [fit.log_size for fit in fits], False)
    if repeats is None:
        chosen = {default_repeats(table) for table in tables}
        usual = "crossed" if chosen == {"crossed"} else "pooled"
        repeats = _agreed("repeats", None, [fit.repeats for fit in fits], usual)
    coded, shared, told = paired_trials(tables, log_size=on_log_size)
    with naming_far_sizes(first_table=tables[0], second_table=tables[1]):
        found = compare_pod(
            coded[0],
            coded[1],
            link=link,
            log_size=on_log_size,
            method=method or "auto",
            repeats=repeats,
            margin=margin,
            size_margin=size_margin,
            shared_images=shared["image"] and not unpaired,
            shared_networks=shared["network"] and not unpaired,
            link_named=named,
        )
    return PodComparison(
        comparison=found,
        size_name=tables[0].size_name,
        repeats=repeats,
        warnings=(*(note for table in tables for note in table.notes), *(() if unpaired else told), *found.warnings),
        names=_names(first, second),
    )


def _of_hits(name: str, table: "TableLike", columns: Mapping[str, Any]) -> PodTable:
    """A table that can be compared: of hits and misses, or of counts of them."""
    try:
        read = table_of(table, **columns)
    except HitError as error:
        raise InputError(
            error.argument,
            received=error.received,
            expected=error.expected,
            remedy=f"name the column of trials (trials, --trials) where these are counts of hits; {_NO_RESPONSES}",
        ) from None
    if read.response is not None:
        raise InputError(name, received="a continuous response", expected="hits and misses", remedy=_NO_RESPONSES)
    return read


def _agreed(name: str, given: Any, of_fits: Sequence[Any], usual: Any) -> Any:
    if given is not None:
        return given
    if len(set(of_fits)) > 1:
        raise InputError(name, received=" and ".join(map(str, of_fits)), expected="curves that were fitted alike")
    return of_fits[0] if of_fits else usual


def _names(first: Any, second: Any) -> tuple[str, str]:
    paths = [Path(table).stem if isinstance(table, str | os.PathLike) else "" for table in (first, second)]
    return (paths[0] or "first", paths[1] or "second")
