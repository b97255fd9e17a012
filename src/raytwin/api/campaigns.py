"""Campaigns: many settings of one line, each judged by its a90."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..files import given_path
from ..results import Result, Table, axes_or_new, frame, number_text, plain
from ._folder import written_folder
from ._given import PathLike
from ._progress import Progress, Telling

if TYPE_CHECKING:
    import pandas

    from ..campaign.sweep_file import Campaign
    from ..campaign.sweep_runners import Runner
    from ..campaign.sweep_settings import Outlook

_LABELS = {
    "throughput_per_s": "products a second",
    "dose_uGy": "air kerma at the object (uGy)",
    "cnr_object": "contrast to noise of the object",
}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class SweepPlan(Result):
    """What is known of every setting of a campaign before training: rows with feasibility, dose, throughput, contrast to noise.

    Where the campaign names a calibrated observer, also the a90 that it expects of networks. `warnings` are of the campaign as a
    whole; those of a setting stand in its row.
    """

    rows: tuple[Mapping[str, Any], ...]
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin sweep --plan --json` prints."""
        found: dict[str, Any] = plain(
            {
                "settings": len(self.rows),
                "feasible": sum(bool(row["feasible"]) for row in self.rows),
                "to_train": sum(bool(row["kept"]) for row in self.rows),
                "rows": self.rows,
                "warnings": self.warnings,
            }
        )
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a setting."""
        return frame(self.rows)

    def plot(self, ax: Any = None, *, against: str = "throughput_per_s") -> Any:
        """Contrast to noise of the object against `throughput_per_s` or `dose_uGy`, feasible settings only; returns the axes."""
        return _scatter(self.rows, ax=ax, what="cnr_object", against=against)

    def _table(self) -> Table:
        seen = any(row["predicted"] is not None for row in self.rows)
        rows = tuple(
            (
                str(row["label"]),
                "yes" if row["feasible"] else "no",
                number_text(row["throughput_per_s"]),
                number_text(row["cnr_object"]),
                *([_expected_text(row["predicted"])] if seen else []),
                str(row["reason"]),
            )
            for row in self.rows
        )
        expected = ["expected a90"] if seen else []
        answer = self.to_dict()
        title = f"{answer['settings']} settings, {answer['feasible']} feasible, {answer['to_train']} to train"
        return Table(
            title=title,
            header=("setting", "feasible", "products/s", "CNR", *expected, "reason"),
            rows=rows,
            notes=tuple(f"note: {line}" for line in self.warnings),
        )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Decision(Result):
    """Which settings do what is asked of the line, with what margin, and what would make the answer surer.

    Fields: requirement (what was asked); sentence (the answer in words); recommended (LOW;HIGH of the setting that is taken, or
    comes closest); verdict (on it: `meets`, `open`, `fails`); settings (a mapping a setting: verdict; criteria with value, bound
    and margin; limited_by, the criteria that fail; not_yet_known, those that are open; changes); changes_by (who says what
    changes would do to a90); front (settings that no other beats in a90, dose and throughput, a90 of networks or expected);
    measurements (what to measure on the real line, most useful first).
    """

    requirement: Mapping[str, Any]
    sentence: str
    recommended: str | None
    verdict: str | None
    settings: tuple[Mapping[str, Any], ...]
    changes_by: str
    front: tuple[Mapping[str, Any], ...]
    measurements: tuple[Mapping[str, Any], ...]

    def to_dict(self) -> dict[str, Any]:
        """What stands under `decision` in what `raytwin sweep --json` prints."""
        found: dict[str, Any] = plain({name: getattr(self, name) for name in _DECISION_FIELDS})
        return found | {"meets": [one["setting"] for one in found["settings"] if one["verdict"] == "meets"]}

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a setting: verdict, limited_by, not_yet_known, and value, bound, margin and verdict of each criterion."""
        rows = []
        for one in self.settings:
            row = {"setting": one["setting"], "label": one["label"], "verdict": one["verdict"]}
            for names in ("limited_by", "not_yet_known"):
                row[names] = ", ".join(one.get(names, ()))
            for part in one["criteria"]:
                row |= {f"{part['name']}_{field}": part[field] for field in ("value", "bound", "margin", "verdict")}
            row |= {f"a90_factor_{change['kind']}": change["factor"] for change in one["changes"]}
            rows.append(row)
        return frame(rows)

    def _table(self) -> Table:
        from ..campaign.decision import Change, change_text

        names = [part["name"] for part in self.settings[0]["criteria"]] if self.settings else []
        rows = []
        for one in self.settings:
            margins = ["" if part["margin"] is None else f"{100 * part['margin']:+.0f} %" for part in one["criteria"]]
            helps = change_text(Change(**one["changes"][0])) if one["changes"] and one["verdict"] != "meets" else ""
            rows.append((str(one["label"]), str(one["verdict"]), *margins, helps))
        taken = next((str(one["label"]) for one in self.settings if one["setting"] == self.recommended), None)
        meets = sum(one["verdict"] == "meets" for one in self.settings)
        title = f"{meets} of {len(self.settings)} settings meet the requirement"
        return Table(
            title=title if taken is None else f"{title}; {taken}: {self.verdict}",
            header=("setting", "verdict", *(f"margin of {name.replace('_', ' ')}" for name in names), "would help"),
            rows=tuple(rows),
            notes=tuple(f"measure: {one['text']}" for one in self.measurements),
        )


_DECISION_FIELDS = (
    "requirement",
    "sentence",
    "recommended",
    "verdict",
    "settings",
    "changes_by",
    "front",
    "measurements",
)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Sweep(Result):
    """A campaign that was worked through.

    Fields: path (its folder); answer (rows, recommendation and what it rests on, as `raytwin sweep --json` prints them).
    """

    path: Path
    answer: Mapping[str, Any]

    @property
    def rows(self) -> tuple[Mapping[str, Any], ...]:
        """A row a setting, in the campaign's order."""
        return tuple(self.answer["rows"])

    @property
    def decision(self) -> Decision | None:
        """The answer to the campaign's requirement; None where it states none."""
        held = self.answer["decision"]
        if held is None:
            return None
        words = {name: held[name] for name in _DECISION_FIELDS}
        lists = {name: tuple(words[name]) for name in ("settings", "front", "measurements")}
        return Decision(**{**words, **lists})

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin sweep --json` prints."""
        found: dict[str, Any] = plain(self.answer)
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a setting: a50, a90 and its bounds, false alarms, dose, throughput, feasible or why not."""
        return frame(self.rows)

    def plot(self, ax: Any = None, *, against: str = "throughput_per_s") -> Any:
        """a90 with its interval against `throughput_per_s`, `dose_uGy` or `cnr_object`; returns the axes."""
        return _scatter(self.rows, ax=ax, what="a90", against=against)

    def _table(self) -> Table:
        seen = any(row["predicted"] is not None for row in self.rows)
        rows = tuple(
            (
                str(row["label"]),
                number_text(row["a90"]),
                f"{number_text(row['a90_low'])} to {number_text(row['a90_high'])}" if row["a90"] is not None else "",
                *([_expected_text(row["predicted"])] if seen else []),
                number_text(row["throughput_per_s"]),
                str(row["reason"]) or ", ".join(word for word in ("recommended", "pareto", "alike") if row[word]),
            )
            for row in self.rows
        )
        header = ("setting", "a90", "95 % interval", *(["expected"] if seen else []), "products/s", "")
        return Table(title=str(self.answer["sentence"]), header=header, rows=rows)


def _expected_text(predicted: Mapping[str, float] | None) -> str:
    if predicted is None:
        return ""
    return f"{number_text(predicted['value'])} ({number_text(predicted['low'])} to {number_text(predicted['high'])})"


def _scatter(rows: tuple[Mapping[str, Any], ...], *, ax: Any, what: str, against: str) -> Any:
    if against not in _LABELS:
        raise InputError("against", received=repr(against), expected="one of " + ", ".join(_LABELS))

    def value(row: Mapping[str, Any], name: str) -> float | None:
        found = row[name]
        number: float | None = found["value"] if isinstance(found, Mapping) else found
        return number

    known = [row for row in rows if value(row, what) is not None and value(row, against) is not None]
    axes = axes_or_new(ax)
    for row in known:
        place = value(row, against)
        (point,) = axes.plot([place], [value(row, what)], "o", label=row["label"])
        if what == "a90" and row["a90_low"] is not None and row["a90_high"] is not None:
            axes.plot([place] * 2, [row["a90_low"], row["a90_high"]], color=point.get_color(), lw=1)
    axes.set(xlabel=_LABELS[against], ylabel=_LABELS.get(what, what))
    if 0 < len(known) <= 12:
        axes.legend(frameon=False, fontsize=8)
    return axes


def sweep(
    campaign: "Campaign | PathLike",
    *,
    output: PathLike | None = None,
    plan_only: bool = False,
    workers: int = 1,
    scheduler: str | None = None,
    device: str = "auto",
    threads: int = 1,
    keep_images: bool = False,
    progress: Progress | bool | None = None,
    tell: Callable[[str], None] = lambda line: None,
    each: Callable[[Mapping[str, Any]], None] = lambda row: None,
) -> Sweep | SweepPlan:
    """Many settings of one line, each with images, networks, hits and POD, and one recommended.

    Args:
        campaign: a campaign file (TOML; docs/campaigns.md has every word), or one that was read.
        output: folder of the sweep, new or to go on with; writes sweep.json, sweep.csv and report.html.
        plan_only: train nothing; what is known of every setting before.
        workers: settings at once, a process each.
        scheduler: in their place a Dask cluster that sees the same files (`tcp://host:8786`, or its file).
        device: of the networks, `auto`, `cpu`, `cuda` or `mps`.
        threads: processor threads of a setting.
        keep_images: keep the images generated for each setting.
        progress: True for a bar, or a function of (stage, done, total).
        tell: called with lines about the course of the sweep.
        each: called with the row of each setting that is complete.

    Returns:
        A `Sweep`, or a `SweepPlan` with `plan_only`.

    Raises:
        InputError, FileFormatError: a campaign, twin or references that cannot be used; a folder of something else.

    Example:
        >>> ahead = rt.sweep("campaign.toml", plan_only=True)
        >>> ahead.to_dict()["settings"]
        2
    """
    from ..campaign.sweep_file import Campaign, read_campaign
    from ..campaign.sweep_trial import check_references

    for name, value in (("workers", workers), ("threads", threads)):
        if value < 1:
            raise InputError(name, received=value, expected="a whole number, 1 or more")
    if output is None and not plan_only:
        raise InputError("output", received="none", expected="a folder for the sweep, or plan_only=True")
    known = (
        campaign
        if isinstance(campaign, Campaign)
        else read_campaign(given_path(campaign, expected="a campaign", argument="campaign"))
    )
    check_references(known)
    with Telling(progress, unit="setting") as telling:
        if plan_only or output is None:
            return _plan(known, telling)
        if scheduler is None:
            from ..segmentation import choose_device

            choose_device(device)  # says at once how to install torch where it is missing
        folder = given_path(output, expected="a folder", argument="output")
        with written_folder(folder):
            return _work(
                known,
                folder,
                workers=workers,
                scheduler=scheduler,
                words={"device": device, "threads": threads, "keep_images": keep_images},
                telling=telling,
                tell=tell,
                each=each,
            )


def _plan(campaign: "Campaign", telling: Telling) -> SweepPlan:
    from ..campaign.sweep import outlook_rows
    from ..campaign.sweep_screening import plan_warnings

    outlooks = _looked_at(campaign, telling)
    return SweepPlan(rows=tuple(plain(outlook_rows(campaign, outlooks))), warnings=plan_warnings(campaign, outlooks))


def _looked_at(campaign: "Campaign", telling: Telling) -> "tuple[Outlook, ...]":
    from ..campaign.sweep import look_ahead

    telling.begin("looking ahead", len(campaign.settings))
    return look_ahead(campaign, each=telling.advance)


def _work(
    campaign: "Campaign",
    folder: Path,
    *,
    workers: int,
    scheduler: str | None,
    words: Mapping[str, Any],
    telling: Telling,
    tell: Callable[[str], None],
    each: Callable[[Mapping[str, Any]], None],
) -> Sweep:
    from .. import __version__
    from ..campaign.sweep import Progress as Told
    from ..campaign.sweep import run_sweep, seconds_of
    from ..campaign.sweep_report import write_report

    def advance(row: Mapping[str, Any]) -> None:
        telling.advance()
        each(row)

    runner = _runner(folder, workers=workers, scheduler=scheduler, version=__version__)
    try:
        outlooks = _looked_at(campaign, telling)
        result = run_sweep(
            campaign,
            folder,
            runner=runner,
            version=__version__,
            outlooks=outlooks,
            progress=Told(
                tell=tell, begin=lambda total, done: telling.begin("settings", total, done=done), advance=advance
            ),
            **words,
        )
    finally:
        runner.close()
    seconds = seconds_of(folder, result["rows"])
    report = write_report(result, folder / "report.html", campaign=campaign, seconds=seconds, version=__version__)
    answer = {
        **result,
        "rows": [row | {"seconds": seconds.get(row["setting"])} for row in result["rows"]],
        "paths": {"report": report, "json": folder / "sweep.json", "csv": folder / "sweep.csv"},
    }
    return Sweep(path=folder, answer=plain(answer))


def _runner(folder: Path, *, workers: int, scheduler: str | None, version: str) -> "Runner":
    from ..campaign.sweep import marker_of
    from ..campaign.sweep_runners import DaskCluster, Processes

    if scheduler is None:
        return Processes(workers)
    cluster = DaskCluster(scheduler)
    try:
        cluster.check(marker_of(folder), version=version)
    except BaseException:
        cluster.close()
        raise
    return cluster
