"""Probability of detection: a curve from a table, two curves compared, a study planned."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
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
from ..pod.table import HitError, PodTable, read_pod_table
from ..results import Result, Table, axes_or_new, counted, frame, interval_text, number_text, plain
from ._given import generator_of

if TYPE_CHECKING:
    import numpy as np
    import pandas
    from typing_extensions import TypeIs

    from ..pod import Comparison, Plan, PodFit, Precision, ResponseFit, Roc, Trials
    from ..pod.planning import AssumedCurve

    TableLike: TypeAlias = (
        "str | os.PathLike[str] | Mapping[str, Sequence[Any]] | pandas.DataFrame | PodTable | PodCurve | Result"
    )

_FAR = 100.0  # ranges of the others: no study has a size so far away
_NO_RESPONSES = "curves of a continuous response are not compared"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class PodCurve(Result):
    """A POD curve with its bounds, and the table that it was fitted to.

    Fields: fit; table (what was read); more (beyond the curve, by name: `alternatives`, `over_links`, `false_alarms`,
    `lapse`, `bootstrap`, `covariates`, `explanation`, `as_published`, `roc`); warnings; response_label (the response's
    column, None for hits) with its censoring limits; link_named: whether the link was asked for, and not the default one.
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
        """The curve over the tested sizes: the size's column, pod, low, high (two-sided 95 %, each size for itself).

        Raises:
            FitError: there is no curve, or it is that of a response.
        """
        import pandas

        from ..pod.band import curve_rows

        rows = curve_rows(self._of_hits(), points=points)
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
            draw_pod(axes, self._of_hits(), self.trials, size_label=self.table.size_name)
        return axes

    def save_table(self, path: str | os.PathLike[str]) -> None:
        """Write the curve with its 95 % band as comma-separated values.

        Raises:
            FitError: there is no curve, or it is that of a response.
        """
        from ..pod.band import write_curve_table

        write_curve_table(path, self._of_hits(), size_name=self.table.size_name)

    def _of_hits(self) -> "PodFit":
        if is_response(self.fit):
            raise FitError(
                "a curve of a continuous response has no band of hits and misses; its bounds are in to_dict()"
            )
        return self.fit

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


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class PodPlan(Result):
    """What a POD study needs, or what a number of images would give.

    Fields: assumed (curve and spreads); networks; images (None: no number is enough); expected (of that design); sizes
    (image,): of the foreign objects to make, in the curve's unit; wanted_over_a90, limit_over_a90, fewest_networks (None
    where a number of images was given); warnings.
    """

    assumed: "AssumedCurve"
    networks: int
    images: int | None
    expected: "Precision | None"
    sizes: "np.ndarray[Any, np.dtype[np.float64]]"
    wanted_over_a90: float | None = None
    limit_over_a90: float | None = None
    fewest_networks: int | None = None
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin plan --json` prints."""
        wanted = {}
        if self.wanted_over_a90 is not None:
            wanted = {name: getattr(self, name) for name in ("wanted_over_a90", "limit_over_a90", "fewest_networks")}
        found: dict[str, Any] = plain(
            {
                "assumed": asdict(self.assumed),
                "networks": self.networks,
                "images": self.images,
                "expected": None if self.expected is None else asdict(self.expected),
                "sizes": self.sizes,
                **wanted,
                "warnings": self.warnings,
            }
        )
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each foreign object to make: its size."""
        import pandas

        return pandas.DataFrame({"size": self.sizes})

    def plot(self, ax: Any = None) -> Any:
        """The assumed curve, and ticks at the sizes to make; returns the axes."""
        import numpy as np

        from ..pod.links import link_from_name
        from ..pod.mixed import averaged_pod

        axes = axes_or_new(ax)
        c0, c1 = self.assumed.coefficients()
        ends = [*self.sizes.tolist(), self.assumed.size_at(0.02), self.assumed.size_at(0.98)]
        size = (np.geomspace if self.assumed.log_size else np.linspace)(min(ends), max(ends), 200)
        x = np.log(size) if self.assumed.log_size else size
        total = float(np.hypot(self.assumed.sd_network, self.assumed.sd_image))
        axes.plot(size, averaged_pod(c0 + c1 * x, total, link=link_from_name(self.assumed.link)))
        axes.plot(self.sizes, np.zeros(len(self.sizes)), "|", ms=8)
        axes.set(xlabel="size", ylabel="probability of detection", xscale="log" if self.assumed.log_size else "linear")
        return axes

    def _table(self) -> Table:
        rows = [
            ("networks", f"{self.networks}"),
            ("images", "no number is enough" if self.images is None else f"{self.images}"),
        ]
        if self.expected is not None:
            shares = (self.expected.bound_over_a90, self.expected.low_over_a90, self.expected.high_over_a90)
            bound, *ends = (number_text(None if share is None else self.assumed.a90 * share) for share in shares)
            rows.append(("expected a90/95", bound))
            rows.append(("two-sided 95 %", " to ".join(ends)))
        if len(self.sizes):
            rows.append(("sizes", f"{self.sizes.min():.4g} to {self.sizes.max():.4g}"))
        title = f"POD study: assumed a50 {self.assumed.a50:.4g}, a90 {self.assumed.a90:.4g}, {self.assumed.link}"
        return Table(title=title, header=("", ""), rows=tuple(rows), notes=self.warnings)


def is_response(fit: "PodFit | ResponseFit") -> "TypeIs[ResponseFit]":
    """Whether a fit is that of a continuous response."""
    return hasattr(fit, "decision")


def _read(table: "TableLike", **options: Any) -> PodTable:
    """A table from whatever was given; options choose its columns."""
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
            better, the bounds reach as far as those of all links and scales that fit.
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
    read = _read(
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
        of_hits = {
            "method": method,
            "ceiling": ceiling,
            "floor": floor,
            "bootstrap": bootstrap,
            "by": by,
            "covariates": covariates,
            "explain": explain,
            "as_published": as_published,
        }
        for name, asked in of_hits.items():
            if asked:
                raise InputError(
                    name, received="with a response", expected="hits and misses, not a continuous response"
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
        given = {
            "decision": decision,
            "left_censored": left_censored,
            "right_censored": right_censored,
            "box_cox": box_cox,
        }
        for name, value in given.items():
            if value is not None:
                raise InputError(name, received="without a response", expected="the column of a response too")
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
    if len(read.false_alarm) and "false_alarms" not in curve.more:
        from ..pod import false_alarm_rate

        alarms = false_alarm_rate(read.false_alarm, network=read.false_alarm_network, image=read.false_alarm_image)
        curve = replace(curve, more={**curve.more, "false_alarms": asdict(alarms)})
    return curve


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
    with _naming_far_sizes(table=table):
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
    if not log_size and (far := _far_size(table)):
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
        asked["lapse"] = lambda: _lapse(trials, fit, ceiling=ceiling, floor=floor, warnings=warnings)
    if bootstrap is not None:
        asked["bootstrap"] = lambda: _bootstrap(table, fit, replicates=bootstrap, by=by, seed=seed, warnings=warnings)
    if covariates:
        asked["covariates"] = lambda: _covariates(table, fit, covariates, method=method, warnings=warnings)
    if explain:
        asked["explanation"] = lambda: _explanation(table, explain, link=chosen, repeats=repeats, seed=seed)
    for name, make in asked.items():
        try:
            more[name] = make()
        except FitError as error:  # the curve stands; what cannot be added to it is null with its reason
            more[name] = None
            warnings.append(f"no {name}: {error}")
    if as_published:
        more["as_published"] = asdict(fit_as_published(trials))
    return PodCurve(fit=fit, table=table, more=plain(more), warnings=tuple(warnings), link_named=link is not None)


@contextmanager
def _naming_far_sizes(**tables: PodTable) -> Iterator[None]:
    """Where a fit fails and one size of a table lies far from all others, the error names its row."""
    try:
        yield
    except FitError:
        for name, table in tables.items():
            told = _far_size(table)
            if told:
                raise FitError(f"no curve fits the {name.replace('_', ' ')}: {told}") from None
        raise


def _far_size(table: PodTable) -> str:
    """The size that is farther from the nearest other one than `_FAR` times the range of these, in words; empty: none."""
    import numpy as np

    size = np.sort(table.size)
    for far, others in ((size[-1], size[size < size[-1]]), (size[0], size[size > size[0]])):
        if len(others) > 1 and np.abs(others - far).min() > _FAR * np.ptp(others) > 0:
            row = int(np.flatnonzero(table.size == far)[0]) + 1
            return f"the size {far:g} in row {row} lies far from all others, {others[0]:g} to {others[-1]:g}; check it"
    return ""


def _lapse(trials: "Trials", fit: "PodFit", *, ceiling: bool, floor: bool, warnings: list[str]) -> dict[str, Any]:
    from ..pod import fit_lapse_pod

    found = fit_lapse_pod(trials, link=fit.link, log_size=fit.log_size, ceiling=ceiling, floor=floor)
    warnings += [f"with ceiling or floor: {note}" for note in found.warnings]
    answer = asdict(found)
    if fit.repeats != "pooled" and _looks_repeat(trials):
        warnings.append("ceiling and floor take all looks as independent, and looks repeat: values without intervals")
        answer |= {"p_plain": None, "a90_95": None, "a90_95_two_sided": None}
        for name in ("ceiling", "floor"):
            answer[name] |= {"low": None, "high": None}
    return answer


def _looks_repeat(trials: "Trials") -> bool:
    """Whether a network, image or site was part of more than one look, by more than one of them."""
    labels = (trials.network, trials.image, trials.site)
    return any(codes is not None and 0 < codes.max() < len(codes) - 1 for codes in labels)


def _bootstrap(
    table: PodTable,
    fit: "PodFit",
    *,
    replicates: int,
    by: str | None,
    seed: "int | np.random.Generator",
    warnings: list[str],
) -> dict[str, Any]:
    import numpy as np

    from ..pod import bootstrap_pod

    if isinstance(replicates, bool) or not isinstance(replicates, int | np.integer) or replicates < 20:
        raise InputError("bootstrap", received=replicates, expected="20 refits or more (1000 is usual)")
    if by is None:
        known = table.network is not None, table.image is not None
        by = {(True, True): "both", (True, False): "network", (False, True): "image"}.get(known, "row")
    if by == "row" and table.trials is not None:
        raise InputError("bootstrap", received="grouped trials", expected="one trial a row, or a column of images")
    found = bootstrap_pod(
        trials_from_table(table, log_size=fit.log_size),
        link=fit.link,
        log_size=fit.log_size,
        by=by,
        replicates=int(replicates),
        rng=generator_of(seed),
    )
    if None in (found.a90_95, found.a90_low, found.a90_high) and found.unknown < 0.025:
        warnings.append(
            "the bootstrap gives no bound there: so few networks or images need more resamples than were drawn"
        )
    return {
        "by": by,
        "replicates": int(replicates),
        "a90_95": found.a90_95,
        "a90_low": found.a90_low,
        "a90_high": found.a90_high,
        "unknown": found.unknown,
    }


def _covariates(
    table: PodTable, fit: "PodFit", asked: Mapping[str, float | None], *, method: str, warnings: list[str]
) -> dict[str, Any]:
    import numpy as np

    from ..pod import fit_covariates, size_at

    if table.size_name in asked:
        raise InputError("covariates", received=table.size_name, expected="another property than the size")
    columns = {table.size_name: table.size, **{name: table.numbers(name) for name in asked}}
    held = {name: float(np.median(columns[name])) if value is None else float(value) for name, value in asked.items()}
    trials = trials_from_table(table, log_size=fit.log_size)
    logs = (table.size_name,) if fit.log_size else ()
    found = fit_covariates(trials, columns, link=fit.link, logs=logs, method=method)
    at = size_at(found, trials, columns, name=table.size_name, held=held)
    warnings += [f"with covariates: {note}" for note in at.warnings]
    names, scales = ("constant", *found.names), (False, *found.logs)
    values = (found.coefficients.tolist(), found.errors.tolist(), found.p.tolist())
    return {
        "coefficients": [
            {"name": name, "log": log, "value": value, "error": error, "p": p}
            for name, log, value, error, p in zip(names, scales, *values, strict=True)
        ],
        "method": found.method,
        "deviance": found.deviance,
        "aic": found.aic,
        "held": dict(at.held),
        "a50": at.a50,
        "a90": at.a90,
        "a90_95": asdict(at.a90_95),
    }


def _explanation(
    table: PodTable, names: Sequence[str], *, link: str, repeats: str, seed: "int | np.random.Generator"
) -> list[dict[str, Any]]:
    from ..pod import explain_detection

    found, _ = explain_detection(
        trials_from_table(table, log_size=False),
        {name: table.numbers(name) for name in names},
        rng=generator_of(seed),
        link=link,
        repeats=repeats,
    )
    shown = ("name", "log", "gain", "behind", "behind_error", "area", "rising", "aic", "p_beyond")
    return [
        {
            **{name: getattr(one, name) for name in shown},
            "a50": one.fit.a50,
            "a90": one.fit.a90,
            "a90_95": asdict(one.fit.a90_95),
        }
        for one in found
    ]


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
    coded, shared = paired_trials(tables, log_size=on_log_size)
    with _naming_far_sizes(first_table=tables[0], second_table=tables[1]):
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
        warnings=(*(note for table in tables for note in table.notes), *found.warnings),
        names=_names(first, second),
    )


def _of_hits(name: str, table: "TableLike", columns: Mapping[str, Any]) -> PodTable:
    """A table that can be compared: of hits and misses, or of counts of them."""
    try:
        read = _read(table, **columns)
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


def plan(
    *,
    a50: float | None = None,
    a90: float | None = None,
    pilot: "TableLike | None" = None,
    size: str | None = None,
    link: str = "cloglog",
    log_size: bool = False,
    sd_network: float = 0.0,
    sd_image: float = 0.0,
    networks: int = 1,
    wanted: float = 1.2,
    images: int | None = None,
) -> PodPlan:
    """How many images and networks a POD study needs, and which sizes to make.

    Args:
        a50, a90: the curve that is expected, in any unit.
        pilot: in their place a curve of `fit_pod` or a table, whose curve and spreads are taken.
        size, link, log_size: of the pilot's table, or of the assumed curve.
        sd_network, sd_image: spread between networks and images on the link's scale.
        networks: that look at every image.
        wanted: ratio of a90/95 to a90.
        images: in its place, what this number of images would give.

    Returns:
        The plan; large-sample, see `raytwin.pod.planning`.

    Raises:
        InputError: no curve, or a pilot that has none.

    Example:
        >>> study = rt.plan(a50=1.5, a90=3, sd_network=0.4, sd_image=0.8, networks=10, images=100)
        >>> 1 < study.expected.bound_over_a90 < 2
        True
    """
    from ..pod.planning import expected_precision, plan_pod, recommended_sizes

    assumed, told = _assumed(
        a50=a50,
        a90=a90,
        pilot=pilot,
        size=size,
        link=link,
        log_size=log_size,
        sd_network=sd_network,
        sd_image=sd_image,
        networks=networks,
    )
    if images is not None:
        sizes = recommended_sizes(assumed, images, networks=networks)
        expected = expected_precision(assumed, sizes, networks=networks)
        return PodPlan(
            assumed=assumed,
            networks=networks,
            images=images,
            expected=expected,
            sizes=sizes,
            warnings=(*told, *_warnings_of_few(images)),
        )
    found: Plan = plan_pod(assumed, wanted_over_a90=wanted, networks=networks)
    warnings = _warnings_of_few(found.images)
    if found.images is None:
        warnings = (
            f"a90/95 stays at {found.limit_over_a90:.3g} a90 with {counted(networks, 'network')}, whatever the number of images:"
            f" it takes at least {counted(found.fewest_networks, 'network')}",
        )
    return PodPlan(
        assumed=assumed,
        networks=networks,
        images=found.images,
        expected=found.expected,
        sizes=found.sizes,
        wanted_over_a90=found.wanted_over_a90,
        limit_over_a90=found.limit_over_a90,
        fewest_networks=found.fewest_networks,
        warnings=(*told, *warnings),
    )


def _warnings_of_few(images: int | None) -> tuple[str, ...]:
    from ..pod.planning import FEW_TRIALS

    if images is None or images >= FEW_TRIALS:
        return ()
    return (
        f"with {images} images, fewer than some {FEW_TRIALS}, hits and misses may separate, and bounds are longer then",
    )


def _assumed(
    *,
    a50: float | None,
    a90: float | None,
    pilot: "TableLike | None",
    size: str | None,
    link: str,
    log_size: bool,
    sd_network: float,
    sd_image: float,
    networks: int,
) -> "tuple[AssumedCurve, tuple[str, ...]]":
    """What is assumed, and what was said of the pilot's curve."""
    from ..pod.planning import AssumedCurve

    if pilot is None:
        if a50 is None or a90 is None:
            raise InputError("a50 and a90", received="not both", expected="both sizes", remedy="or a pilot's table")
        given = AssumedCurve(a50=a50, a90=a90, link=link, log_size=log_size, sd_network=sd_network, sd_image=sd_image)
        return given, ()
    curve = pilot if isinstance(pilot, PodCurve) else fit_pod(pilot, size=size, link=link, log_size=log_size)
    fit = curve._of_hits()
    if fit.a50 is None or fit.a90 is None:
        raise InputError(
            "pilot",
            received="; ".join(fit.warnings) or "no curve",
            expected="a pilot with an a50 and an a90",
            remedy="give a50 and a90",
        )
    if fit.repeats == "cluster" and networks > 1:
        raise InputError(
            "pilot",
            received=f"a table where every network hits or misses the same images, and {networks} networks",
            expected="a pilot whose networks differ, or one network",
            remedy="plan with one network: such networks add nothing to each other",
        )
    crossed = fit.crossed
    assumed = AssumedCurve(
        a50=fit.a50,
        a90=fit.a90,
        link=fit.link,
        log_size=fit.log_size,
        sd_network=(crossed.sd_network or 0.0) if crossed else 0.0,
        sd_image=(crossed.sd_image or 0.0) if crossed else 0.0,
    )
    return assumed, tuple(f"pilot: {text}" for text in curve.warnings)
