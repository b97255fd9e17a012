"""Probability of detection: a curve from a table."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

from ..errors import FitError, InputError
from ..pod.answer import (
    default_repeats,
    fit_answer,
    notes_on_table,
    response_answer,
    trials_from_table,
    trusted_from_answer,
)
from ..pod.table import PodTable, read_pod_table
from ..results import Result, Table, axes_or_new, number_text, plain
from ._curve_additions import added_bootstrap, added_covariates, added_explanation, added_lapse
from ._far_sizes import far_size, naming_far_sizes

if TYPE_CHECKING:
    import numpy as np
    import pandas
    from typing_extensions import TypeIs

    from ..pod import PodFit, ResponseFit, Roc, Trials

    TableLike: TypeAlias = (
        "str | os.PathLike[str] | Mapping[str, Sequence[Any]] | pandas.DataFrame | PodTable | PodCurve | Result"
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class PodCurve(Result):
    """A POD curve with its bounds, and the table that it was fitted to.

    Fields: fit; table (what was read); more (beyond the curve, by name: `alternatives`, `over_links`, `false_alarms`,
    `lapse`, `bootstrap`, `covariates`, `explanation`, `as_published`, `roc`); warnings; response_label (the response's
    column, None for hits); left_censored, right_censored (limits beyond which responses are only known to lie, in the
    response's unit, None: none); link_named (whether the link was asked for, and not the default one).
    """

    fit: "PodFit | ResponseFit"
    table: PodTable
    more: Mapping[str, Any]
    warnings: tuple[str, ...]
    response_label: str | None = None
    left_censored: float | None = None
    right_censored: float | None = None
    link_named: bool = False

    @property
    def a50(self) -> float | None:
        """Size at POD 50 %, in the table's unit; None where the data support none."""
        return self.fit.a50

    @property
    def a90(self) -> float | None:
        """Size at POD 90 %, in the table's unit; None where the data support none."""
        return self.fit.a90

    @property
    def trials(self) -> "Trials":
        """The table's rows as trials."""
        return trials_from_table(self.table, log_size=self.fit.log_size)

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin pod --json` prints."""
        answer = response_answer(self.fit) if is_response(self.fit) else fit_answer(self.fit)
        found: dict[str, Any] = plain({**answer, "size": self.table.size_name, "warnings": self.warnings, **self.more})
        return found

    def to_dataframe(self, *, points: int = 101) -> "pandas.DataFrame":
        """The curve at so many `points` over the tested sizes: size, pod, low, high (two-sided 95 %, each size for itself).

        Raises:
            FitError: there is no curve, or it is that of a response.
        """
        import pandas

        from ..pod.band import curve_rows

        rows = curve_rows(fit_of_hits(self), points=points)
        return pandas.DataFrame({self.table.size_name: rows.pop("size"), **rows})

    def plot(self, ax: Any = None) -> Any:
        """The curve with its 95 % band and hits, or the response with its line; returns the axes."""
        from ..pod.plots import draw_pod, draw_response

        axes = axes_or_new(ax)
        if is_response(self.fit) and self.table.response is not None:
            draw_response(
                axes,
                self.fit,
                self.table.size,
                self.table.response,
                size_label=self.table.size_name,
                response_label=self.response_label or "response",
                left=self.left_censored,
                right=self.right_censored,
            )
        else:
            draw_pod(axes, fit_of_hits(self), self.trials, size_label=self.table.size_name)
        return axes

    def save_table(self, path: str | os.PathLike[str]) -> None:
        """Write the curve with its 95 % band to the file `path`, as comma-separated values.

        Raises:
            FitError: there is no curve, or it is that of a response.
        """
        from ..pod.band import write_curve_table

        write_curve_table(path, fit_of_hits(self), size_name=self.table.size_name)

    def _table(self) -> Table:
        answer = self.to_dict()
        name = self.table.size_name
        rows = [(label, number_text(answer[key]), name) for label, key in (("a50", "a50"), ("a90", "a90"))]
        for label, key in (("a90/95, one-sided", "a90_95"), ("a90, upper of two-sided 95 %", "a90_95_two_sided")):
            rows.append((label, number_text(trusted_from_answer(answer, key)), name))
        joined = answer.get("over_links")
        if joined and len(joined["curves"]) > 1:
            rows.append(
                (f"a90/95 over {len(joined['curves'])} links that fit alike", number_text(joined["a90_95"]), name)
            )
        if "false_alarms" in answer:
            alarm = answer["false_alarms"]
            ends = f"{100 * alarm['low']:.3g} to {100 * alarm['high']:.3g} %"
            rows.append(("false alarms", f"{100 * alarm['rate']:.3g} %", ends))
        notes = [f"warning: {text}" for text in self.warnings]
        title = (
            f"POD curve: {answer['n_hits']} hits of {answer['n']} trials, {answer['link']}, repeats {answer['repeats']}"
        )
        return Table(title=title, header=("", "value", "in"), rows=tuple(rows), notes=tuple(notes))


def is_response(fit: "PodFit | ResponseFit") -> "TypeIs[ResponseFit]":
    """Whether a fit is that of a continuous response."""
    return hasattr(fit, "decision")


def fit_of_hits(curve: PodCurve) -> "PodFit":
    """The fit of a curve of hits and misses.

    Raises:
        FitError: the curve is that of a continuous response.
    """
    if is_response(curve.fit):
        raise FitError("a curve of a continuous response has no band of hits and misses; its bounds are in to_dict()")
    return curve.fit


def table_of(table: "TableLike", **options: Any) -> PodTable:
    """A table from whatever was given; options choose its columns.

    Raises:
        InputError: columns that the table lacks, or options for a table that was read already.
    """
    if isinstance(table, PodCurve):
        table = table.table
    if isinstance(table, PodTable):
        if any(value for value in options.values()):
            raise InputError("table", received="a table that was read already, with columns", expected="one of the two")
        return table
    if isinstance(table, Result):
        table = table.to_dataframe()  # type: ignore[attr-defined, unused-ignore]
    return read_pod_table(table, **options)


def fit_pod(
    table: "TableLike",
    *,
    size: str | None = None,
    hit: str | Sequence[str] | None = None,
    trials: str | None = None,
    link: str | None = None,
    log_size: bool = False,
    method: str | None = None,
    repeats: str | None = None,
    site: str | None = None,
    network: str | None = None,
    image: str | None = None,
    where: Mapping[str, str] | None = None,
    response: str | None = None,
    decision: float | None = None,
    left_censored: float | None = None,
    right_censored: float | None = None,
    log_response: bool = False,
    box_cox: float | str | None = None,
    ceiling: bool = False,
    floor: bool = False,
    bootstrap: int | None = None,
    by: str | None = None,
    covariates: Mapping[str, float | None] | None = None,
    explain: Sequence[str] = (),
    as_published: bool = False,
    seed: "int | np.random.Generator" = 1,
) -> PodCurve:
    """POD curve with a90 and its bounds, sizes in the unit of their column.

    g(POD) = c0 + c1 x, x the size or its logarithm; see `raytwin.pod` for the models and their sources.

    Args:
        table: a CSV file, a pandas data frame, column -> values, or what `detect` returned; a row a trial.
        size, hit, trials, site, network, image: names of the columns; None: the usual ones.
        link: `cloglog`, `loglog`, `logit` or `probit`, whose bounds are given. None: `cloglog`; where another fits
            better, the bounds reach as far as those of all links and scales that fit. Of hits alone: a response has its own.
        log_size: the curve on the logarithm of the size.
        method: `ml` or `firth`; None: `ml`, and `firth` where hits and misses do not overlap.
        repeats: `crossed`, `scaled`, `cluster` or `pooled`; None: `crossed` where network and image are known, else `pooled`.
        where: column -> value; other rows are left out.
        response: the column of a continuous response, in the place of hits; a response above `decision` is a detection.
        left_censored, right_censored: responses at or beyond these say only that much.
        log_response, box_cox: scale of the response: its logarithm, or a power (`"auto"`: the most likely one).
        ceiling, floor: also a curve that ends below 1, or begins above 0.
        bootstrap: also that many refits to data resampled `by` `row`, `image`, `network` or `both`.
        covariates: also a curve with these columns, held at the value given (None: their median).
        explain: also which of these columns explains detection best.
        as_published: also the paper's mean of one curve per network.
        seed: a whole number or a generator, of `bootstrap` and `explain`.

    Returns:
        The curve. A size that the data cannot support is None, with the reason in `warnings`.

    Raises:
        InputError: a column or option that cannot be used.

    Example:
        >>> table = {"size_mm": [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4], "hit": [0, 0, 0, 0, 1, 0, 1, 0, 1, 1, 1, 1]}
        >>> curve = rt.fit_pod(table, link="logit")
        >>> 2 < curve.a50 < curve.a90 < 4
        True
    """
    read = table_of(
        table,
        size=size,
        hit=hit,
        trials=trials,
        response=response,
        site=site,
        network=network,
        image=image,
        where=where,
    )
    explain = (explain,) if isinstance(explain, str) else explain
    if covariates is not None and not isinstance(covariates, Mapping):
        raise InputError(
            "covariates",
            received=type(covariates).__name__,
            expected="a dictionary: column -> value at which the curve is taken, or None for its median",
        )
    if response is not None or read.response is not None:
        _check_no_word_of_hits(
            link=link,
            method=method,
            ceiling=ceiling,
            floor=floor,
            bootstrap=bootstrap,
            by=by,
            covariates=covariates,
            explain=explain,
            as_published=as_published,
        )
        curve = _response_curve(
            read,
            label=response or "response",
            decision=decision,
            left=left_censored,
            right=right_censored,
            log_size=log_size,
            power=_power(box_cox, log_response=log_response),
            repeats=repeats,
        )
    else:
        _check_no_word_of_responses(
            decision=decision, left_censored=left_censored, right_censored=right_censored, box_cox=box_cox
        )
        curve = _hit_curve(
            read,
            link=link,
            log_size=log_size,
            method=method or "auto",
            repeats=repeats or default_repeats(read),
            ceiling=ceiling,
            floor=floor,
            bootstrap=bootstrap,
            by=by,
            covariates=covariates or {},
            explain=explain,
            as_published=as_published,
            seed=seed,
        )
    return _with_false_alarms(curve)


def _check_no_word_of_hits(**words: Any) -> None:
    for name, asked in words.items():
        if asked:
            raise InputError(name, received="with a response", expected="hits and misses, not a continuous response")


def _check_no_word_of_responses(**words: Any) -> None:
    for name, value in words.items():
        if value is not None:
            raise InputError(name, received="without a response", expected="the column of a response too")


def _with_false_alarms(curve: PodCurve) -> PodCurve:
    """The curve with the rate of false alarms that its table tells of, where it has none yet."""
    from ..pod import false_alarm_rate

    table = curve.table
    if not len(table.false_alarm) or "false_alarms" in curve.more:
        return curve
    alarms = false_alarm_rate(table.false_alarm, network=table.false_alarm_network, image=table.false_alarm_image)
    return replace(curve, more={**curve.more, "false_alarms": asdict(alarms)})


def _power(box_cox: float | str | None, *, log_response: bool) -> float | None:
    if box_cox is None:
        return 0.0 if log_response else 1.0
    if box_cox == "auto":
        return None
    try:
        return float(box_cox)
    except ValueError:
        raise InputError("box_cox", received=repr(box_cox), expected="a number or auto") from None


def _hit_curve(
    table: PodTable,
    *,
    link: str | None,
    log_size: bool,
    method: str,
    repeats: str,
    ceiling: bool,
    floor: bool,
    bootstrap: int | None,
    by: str | None,
    covariates: Mapping[str, float | None],
    explain: Sequence[str],
    as_published: bool,
    seed: "int | np.random.Generator",
) -> PodCurve:
    from ..pod import compare_models, fit_as_published
    from ..pod import fit_pod as fit_columns
    from ..pod.models import with_links_open

    chosen = link or "cloglog"
    with naming_far_sizes(table=table):
        fit = fit_columns(
            table.size,
            table.hits if table.hits is not None else [],
            trials=table.trials,
            link=chosen,
            log_size=log_size,
            method=method,
            repeats=repeats,
            network=table.network,
            image=table.image,
            site=table.site,
        )
    warnings = [*notes_on_table(table, repeats), *fit.warnings]
    if not log_size and (far := far_size(table)):
        warnings.append(far)
    trials = trials_from_table(table, log_size=log_size)
    alternatives = compare_models(trials)
    more: dict[str, Any] = {"alternatives": [asdict(one) for one in alternatives]}
    fit, joined, better = with_links_open(fit, alternatives, named=link is not None)
    if joined is not None:
        more["over_links"] = asdict(joined)
    warnings += [] if better is None else [better]
    asked: dict[str, Callable[[], Any]] = {}
    if ceiling or floor:
        asked["lapse"] = lambda: added_lapse(trials, fit, ceiling=ceiling, floor=floor, warnings=warnings)
    if bootstrap is not None:
        asked["bootstrap"] = lambda: added_bootstrap(
            table, fit, replicates=bootstrap, by=by, seed=seed, warnings=warnings
        )
    if covariates:
        asked["covariates"] = lambda: added_covariates(table, fit, covariates, method=method, warnings=warnings)
    if explain:
        asked["explanation"] = lambda: added_explanation(table, explain, link=chosen, repeats=repeats, seed=seed)
    for name, make in asked.items():
        try:
            more[name] = make()
        except FitError as error:  # the curve stands; what cannot be added to it is null with its reason
            more[name] = None
            warnings.append(f"no {name}: {error}")
    if as_published:
        more["as_published"] = asdict(fit_as_published(trials))
    return PodCurve(fit=fit, table=table, more=plain(more), warnings=tuple(warnings), link_named=link is not None)


def _response_curve(
    table: PodTable,
    *,
    label: str,
    decision: float | None,
    left: float | None,
    right: float | None,
    log_size: bool,
    power: float | None,
    repeats: str | None,
) -> PodCurve:
    import numpy as np

    from ..pod import false_alarm_rate, fit_response_pod

    if decision is None:
        raise InputError(
            "decision",
            received="none",
            expected="the response above which an object counts as detected",
            remedy="for example --decision 200 (decision=200)",
        )
    notes: list[str] = []
    if repeats is None:
        repeats = "cluster" if table.network is not None and table.image is not None else "pooled"
    elif repeats in ("crossed", "scaled"):
        notes.append(f"repeats {repeats} is not there for a response: bounds robust to networks and images instead")
        repeats = "cluster"
    fit = fit_response_pod(
        table.size,
        table.response if table.response is not None else np.zeros(0),
        decision=decision,
        left=left,
        right=right,
        log_size=log_size,
        box_cox=power,
        network=table.network,
        image=table.image,
        repeats=repeats,
    )
    more: dict[str, Any] = {}
    curve = PodCurve(
        fit=fit,
        table=table,
        more=more,
        warnings=(*notes, *notes_on_table(table, repeats), *fit.warnings),
        response_label=label,
        left_censored=left,
        right_censored=right,
    )
    roc = roc_of(curve)
    if roc is not None:
        more["roc"] = {"area": roc.area, "low": roc.area_low, "high": roc.area_high}
        more["false_alarms"] = asdict(false_alarm_rate((table.noise_response > decision).astype(float)))
    return curve


def roc_of(curve: PodCurve) -> "Roc | None":
    """Detection against false alarm over all decisions, where products without foreign object have responses; else None."""
    from ..pod import compute_roc

    table = curve.table
    if table.response is None or len(table.noise_response) < 2:
        return None
    return compute_roc(table.noise_response, table.response)
