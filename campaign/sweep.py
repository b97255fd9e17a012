"""A sweep: many settings of one line, each judged by the a90 of networks trained and tried on images generated for it.

Order of events. (1) Every setting is looked at (sweep_settings): what the line, the limits or the references rule out is a row
with its reason and costs no training. (2) References are dealt out and one network learns from them, from which all others start.
(3) Each setting is a task (sweep_trial) that a runner (sweep_runners) does: images, networks, hits, POD. (4) The rows are put
together, compared with the best on the same images, and one is recommended (sweep_choice).

What is finished is kept under the hash of what decides it: twin, references, setting, training, seed and version. So a sweep that
was stopped goes on where it was, a setting that is added costs that setting, and a limit that is changed costs nothing.
"""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import FitError, InputError, RaytwinError
from ..files import only_one, remove_parts, whole_file, write_json
from ..generator.twins.twin_io import read_twin
from ..observers import write_efficiency
from ._plain import digest, plain, read_object
from .decision import NO_LOOKS, Change, Looks, Verdict, decide, judge_row
from .sweep_choice import a90_for_front, choose, indistinct, pareto_front, sentence, takes_part
from .sweep_file import Campaign, CurveOptions, Pair
from .sweep_runners import Runner
from .sweep_settings import Outlook, Scout, keep_best, labels_of
from .sweep_trial import (
    Task,
    basis_of,
    common_words,
    is_done,
    other_size,
    prepare_references,
    setting_key,
    setting_task,
    start_key,
    start_task,
)

if TYPE_CHECKING:
    from .sweep_screening import Screened

UNITS = {"contrast": "", "size_mm": "mm"}
_MARKER = "campaign.json"
_KEY_LETTERS = 10
COLUMNS = (
    "label",
    "low",
    "high",
    "feasible",
    "trained",
    "reason",
    "a50",
    "a90",
    "a90_low",
    "a90_high",
    "a90_upper",
    "a90_other_size",
    "n",
    "n_hits",
    "objects",
    "false_alarm_rate",
    "false_alarm_low",
    "false_alarm_high",
    "dose_uGy",
    "dose_uGy_low",
    "dose_uGy_high",
    "throughput_per_s",
    "pair_ms",
    "belt_speed_mm_s",
    "motion_px",
    "photons_low",
    "photons_high",
    "delta_R",
    "cnr_object",
    "predicted_a90",
    "predicted_low",
    "predicted_high",
    "decided",
    "verdict",
    "extrapolated",
    "pareto",
    "recommended",
    "alike",
    "warnings",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """What a sweep tells while it runs: `tell` a line; `begin` settings to train and how many of them are done already; `advance`
    a row that is complete."""

    tell: Callable[[str], None] = lambda line: None
    begin: Callable[[int, int], None] = lambda total, done: None
    advance: Callable[[Mapping[str, Any]], None] = lambda row: None


def look_ahead(campaign: Campaign, *, each: Callable[[], None] = lambda: None) -> tuple[Outlook, ...]:
    """What is known of every setting of a campaign before training, in the file's order.

    Args:
        campaign: as read.
        each: called after each setting.

    Raises:
        InputError: a twin or references that cannot be read.
    """
    scout = Scout(campaign, read_twin(campaign.twin))
    try:
        found = []
        for pair in campaign.settings:
            found.append(scout.look(pair))
            each()
    finally:
        scout.close()
    if campaign.keep_best is None:
        return tuple(found)
    return keep_best(found, keep=campaign.keep_best, of=campaign.keep_best_of)


def run_sweep(
    campaign: Campaign,
    directory: Path,
    *,
    runner: Runner,
    version: str,
    device: str = "cpu",
    threads: int = 1,
    keep_images: bool = False,
    outlooks: Sequence[Outlook] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Do what is left of a sweep and write sweep.json and sweep.csv; returns what sweep.json holds.

    A screened sweep also writes observer.json, the observer as calibrated last.

    Args:
        campaign: what is asked.
        directory: of the sweep, new or begun before, with this campaign or another one.
        runner: where the settings are worked at.
        version: of raytwin; a part of what decides a result.
        device, threads: of each network's training.
        keep_images: generated images stay.
        outlooks: of `look_ahead`; None: looked at here.
        progress: what to tell.

    Raises:
        InputError: the folder is of something else, another run works in it, references that cannot be used.
        RaytwinError: the network that all start from could not be trained.
    """
    progress = progress or Progress()
    _claim(directory)
    with only_one(directory, "a sweep"):
        remove_parts(directory)
        found = tuple(outlooks) if outlooks is not None else look_ahead(campaign)
        basis = basis_of(campaign, version=version)
        if another := _answer_of_another(directory, campaign, basis):
            progress.tell(another)
        data = (directory / "references").resolve()
        tasks: dict[str, Task] = {}
        if any(one.kept for one in found):
            if not campaign.described:
                prepare_references(campaign, data, basis)
            common = common_words(campaign, data, device=device, threads=threads, keep_images=keep_images)
            start = _start(campaign, directory, basis, common, runner, progress)
            tasks = _tasks(campaign, directory, found, basis, common, start)
        labels = labels_of([one.pair for one in found])
        rows = {one.text: _row(one, label, None, "") for one, label in zip(found, labels, strict=True)}
        outlook_of = {one.text: (one, label) for one, label in zip(found, labels, strict=True)}

        def complete(text: str, error: str) -> dict[str, Any]:
            outlook, label = outlook_of[text]
            row = _row(outlook, label, tasks[text], error)
            if not error:
                write_json(Path(tasks[text]["folder"]) / "row.json", row)
            rows[text] = row
            return row

        def done(task: Task, error: str) -> None:
            progress.advance(complete(f"{task['low']};{task['high']}", error))

        def work(texts: Sequence[str], *, before: int) -> None:
            """Do what is left of these settings; `before` others are complete."""
            left = [text for text in texts if not is_done(tasks[text])]
            progress.begin(before + len(texts), before + len(texts) - len(left))
            for text in texts:
                if text not in left:
                    complete(text, "")
            runner.run([tasks[text] for text in left], done)

        screened = None
        if campaign.screening is None or not tasks:
            work(list(tasks), before=0)
        else:
            screened = _screened(campaign, data, found, rows, work, progress)
            if screened.screen.efficiency is not None:
                write_efficiency(directory / "observer.json", screened.screen.efficiency)
        answer = _answer(campaign, directory, list(rows.values()), basis, tasks, screened, progress)
        write_json(directory / "sweep.json", answer)
        write_table(directory / "sweep.csv", answer["rows"])
    return answer


def _screened(
    campaign: Campaign,
    data: Path,
    outlooks: Sequence[Outlook],
    rows: dict[str, dict[str, Any]],
    work: Callable[..., None],
    progress: Progress,
) -> "Screened":
    """Train what the observer leaves undecided, round by round, and say in the rows of the others why they were not trained."""
    from .sweep_screening import Screen, screened_rows

    screen = Screen(campaign, data / "test.h5", outlooks)
    asked: list[str] = []
    while chosen := screen.next(rows, asked):
        if asked:
            left = len(screen.kept) - len(asked) - len(chosen)
            progress.tell(f"{len(chosen)} undecided settings are trained next; {left} others wait for the observer")
        work(chosen, before=len(asked))
        asked += chosen
    screened = screened_rows(screen, rows, asked)
    for text in screened.answer["warnings"]:
        progress.tell(f"warning: {text}")
    return screened


def seconds_of(directory: Path, rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Seconds that each trained setting took, by its text; not in sweep.json, whose bytes say nothing of when it was made."""
    found = {}
    for row in rows:
        seconds = read_object(directory / row["folder"] / "seconds.json").get("seconds") if row["folder"] else None
        if seconds is not None:
            found[str(row["setting"])] = float(seconds)
    return found


def outlook_rows(campaign: Campaign, outlooks: Sequence[Outlook]) -> list[dict[str, Any]]:
    """Outlooks as rows, for people and JSON.

    With a calibrated observer under [screening] each has the a90 that it expects, over the objects of the references; with a
    [requirement] the verdict as far as it is known.
    """
    labels = labels_of([one.pair for one in outlooks])
    rows = [_row(one, label, None, "") | {"kept": one.kept} for one, label in zip(outlooks, labels, strict=True)]
    if campaign.screening is not None and campaign.screening.observer is not None:
        from .sweep_screening import Screen

        expected = Screen(campaign, campaign.test_references or campaign.references, outlooks).expected()
        for row in rows:
            one = expected.get(str(row["setting"]))
            row["predicted"] = None if one is None else one.as_dict()
    if campaign.requirement is not None:
        for row in rows:
            row["verdict"] = judge_row(row, campaign.requirement).verdict
    return rows


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """The rows as CSV: one line a setting, empty where a number is not known."""
    with whole_file(path) as temporary, open(temporary, "w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            flat = dict(row)
            rate, dose = row["false_alarm_rate"] or {}, row["dose_uGy"] or {}
            predicted = row["predicted"] or {}
            flat |= {
                "a90_other_size": (row["other_size"] or {}).get("a90"),
                "predicted_a90": predicted.get("value"),
                "predicted_low": predicted.get("low"),
                "predicted_high": predicted.get("high"),
                "false_alarm_rate": rate.get("value"),
                "false_alarm_low": rate.get("low"),
                "false_alarm_high": rate.get("high"),
                "dose_uGy": dose.get("value"),
                "dose_uGy_low": dose.get("low"),
                "dose_uGy_high": dose.get("high"),
                "photons_low": (row["photons_low"] or {}).get("value"),
                "photons_high": (row["photons_high"] or {}).get("value"),
                "warnings": "; ".join(row["warnings"]),
            }
            writer.writerow([_cell(flat[name]) for name in COLUMNS])


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    return f"{value:.7g}" if isinstance(value, float) else str(value)


# ---------------------------------------------------------------------------------------------------- tasks


def _start(
    campaign: Campaign,
    directory: Path,
    basis: Mapping[str, Any],
    common: Mapping[str, Any],
    runner: Runner,
    progress: Progress,
) -> Path | None:
    """Folder of the network that all settings start from, trained where it is not there; None: they start from none."""
    if not campaign.training.start_steps:
        return None
    key = start_key(basis, campaign.training)
    folder = (directory / "start" / key[:_KEY_LETTERS]).resolve()
    task = start_task(campaign, folder, key, common)
    if not is_done(task):
        progress.tell("training the network that all settings start from")
        failures: list[str] = []

        def done(_: Task, error: str) -> None:
            failures.append(error)

        runner.run([task], done)
        if any(failures):
            raise RaytwinError(f"the network that all settings start from could not be trained: {failures[0]}")
    return folder


def _tasks(
    campaign: Campaign,
    directory: Path,
    outlooks: Sequence[Outlook],
    basis: Mapping[str, Any],
    common: Mapping[str, Any],
    start: Path | None,
) -> dict[str, Task]:
    tasks = {}
    for one in outlooks:
        if one.kept:
            key = setting_key(basis, campaign.training, campaign.trying, one.pair)
            folder = (directory / "settings" / _folder_name(one.pair, key)).resolve()
            tasks[one.text] = setting_task(campaign, one.pair, folder, key=key, start=start, common=common)
    return tasks


def _folder_name(pair: Pair, key: str) -> str:
    low, high = pair
    return f"{low.kV:g}-{high.kV:g}kV_{low.exposure_ms:g}ms_{key[:_KEY_LETTERS]}"


# ---------------------------------------------------------------------------------------------------- rows and answer


def _row(outlook: Outlook, label: str, task: Task | None, error: str) -> dict[str, Any]:
    """All that is known of a setting; `task` is what was done for it, if anything was."""
    row: dict[str, Any] = {
        "label": label,
        "setting": outlook.text,
        "low": str(outlook.pair[0]),
        "high": str(outlook.pair[1]),
        "feasible": outlook.feasible,
        "trained": False,
        "reason": outlook.reason or outlook.why_left_out or error,
        "a50": None,
        "a90": None,
        "a90_low": None,
        "a90_high": None,
        "a90_upper": None,
        "n": None,
        "n_hits": None,
        "objects": None,
        "false_alarm_rate": None,
        "dose_uGy": outlook.dose_uGy,
        "throughput_per_s": outlook.throughput_per_s,
        "pair_ms": outlook.pair_ms,
        "belt_speed_mm_s": outlook.belt_speed_mm_s,
        "motion_px": outlook.motion_px,
        "photons_low": outlook.photons[0],
        "photons_high": outlook.photons[1],
        "delta_R": outlook.delta_R,
        "cnr_object": outlook.cnr_object,
        "extrapolated": outlook.extrapolated,
        "predicted": None,
        "decided": None,
        "verdict": None,
        "other_size": None,
        "points": [],
        "line": None,
        "folder": "",
        "warnings": list(outlook.warnings),
    }
    if task is None or error:
        return dict(plain(row))
    folder = Path(task["folder"])
    trial = read_object(folder / "trial.json")
    row["folder"] = f"settings/{folder.name}"
    row["warnings"] = list(dict.fromkeys([*row["warnings"], *trial["warnings"]]))
    if trial["refused"]:
        return dict(plain(row | {"feasible": False, "reason": trial["refused"]}))
    curve = read_object(folder / "pod.json")
    alarms = curve["false_alarms"]
    row |= {
        "trained": True,
        "a50": curve["a50"],
        "a90": curve["a90"],
        "a90_low": curve["a90_95_interval"]["low"],
        "a90_high": curve["a90_95_interval"]["high"],
        "a90_upper": curve["a90_95"],
        "n": curve["n"],
        "n_hits": curve["n_hits"],
        "objects": curve["objects"],
        "false_alarm_rate": None
        if alarms is None
        else {
            "value": alarms["rate"],
            "low": alarms["low"],
            "high": alarms["high"],
            "n": alarms["n"],
            "effective_n": alarms["effective_n"],
        },
        "other_size": curve["other_size"],
        "points": curve["points"],
        "line": curve["line"],
        "warnings": [*row["warnings"], *curve["warnings"]],
    }
    if curve["a90"] is None:
        about = [line for line in curve["warnings"] if "a90" in line]
        row["reason"] = (about or [*curve["warnings"], "no a90"])[0]
    return dict(plain(row))


def _answer(
    campaign: Campaign,
    directory: Path,
    rows: list[dict[str, Any]],
    basis: Mapping[str, Any],
    tasks: Mapping[str, Task],
    screened: "Screened | None",
    progress: Progress,
) -> dict[str, Any]:
    goal, most = campaign.goal, campaign.most_false_alarms
    verdicts: list[Verdict] = []
    changes_by = ""
    if campaign.requirement is not None:
        changes, changes_by = _changes(campaign, directory, rows, screened)
        for row in rows:
            looks = _looks(directory / row["folder"] / "hits.csv", campaign.curve.size) if row["trained"] else NO_LOOKS
            verdicts.append(
                judge_row(row, campaign.requirement, changes=changes.get(str(row["setting"]), ()), looks=looks)
            )
            row["verdict"] = verdicts[-1].verdict
    choice = choose(rows, goal=goal, most_false_alarms=most)
    front = set(pareto_front([{**row, "a90": a90_for_front(row, most)} for row in rows]))
    for number, row in enumerate(rows):
        ratio, alike = None, False
        if choice.best is not None and number != choice.best and row["a90"] is not None:
            best = rows[choice.best]
            if _apart(best, row):
                ratio = {"value": row["a90"] / best["a90"], "low": None, "high": None, "paired": "nothing"}
            else:
                pair = tasks[best["setting"]], tasks[row["setting"]]
                ratio = _ratio_to_best(directory, *pair, campaign.curve, progress.tell)
                alike = indistinct(ratio)
        row |= {
            "pareto": number in front,
            "recommended": number == choice.recommended,
            "best": number == choice.best,
            "ratio_to_best": ratio,
            "alike": alike,
        }
        if row["a90"] is not None and not takes_part(row, most):
            rate = row["false_alarm_rate"]
            told = "unknown" if rate is None else f"{100 * rate['value']:.3g} %"
            row["reason"] = f"false alarms {told}, allowed are {100 * (most or 0.0):g} %"
    unit = UNITS[campaign.curve.size]

    def named(number: int | None) -> str | None:
        return None if number is None else str(rows[number]["setting"])

    decision = None
    if campaign.requirement is not None:
        # where all have too many false alarms, the verdict on what a90 would take says so
        closest = choose(rows, goal=goal, most_false_alarms=None) if choice.recommended is None else choice
        decision = decide(
            rows, campaign.requirement, verdicts, recommended=closest.recommended, unit=unit, changes_by=changes_by
        )
        said = decision["sentence"]
    else:
        said = sentence(rows, choice, goal=goal, unit=unit, most_false_alarms=most)
    result = {
        "campaign": campaign.path.name,
        **basis,
        "size": campaign.curve.size,
        "unit": unit,
        "other_size": other_size(campaign.curve.size),
        "other_unit": UNITS[other_size(campaign.curve.size)],
        "goal": goal,
        "maximum_false_alarm_rate": most,
        "networks": campaign.training.networks,
        "settings": len(rows),
        "feasible": sum(bool(row["feasible"]) for row in rows),
        "trained": sum(bool(row["trained"]) for row in rows),
        "recommended": named(choice.recommended),
        "best": named(choice.best),
        "meets_goal": choice.meets,
        "pareto": [str(rows[number]["setting"]) for number in sorted(front)],
        "alike": [str(row["setting"]) for row in rows if row["alike"]],
        "screening": None if screened is None else screened.answer,
        "decision": decision,
        "sentence": said if screened is None else f"{said} {screened.sentence}",
        "rows": rows,
    }
    return dict(plain(result))


def _looks(table_path: Path, size: str) -> Looks:
    """The objects of known size of a hit table, an image each, and who found them."""
    from ..pod import read_pod_table

    table = read_pod_table(table_path, size=size)
    found: dict[str, list[float]] = {}
    sizes: dict[str, float] = {}
    for image, own, hit in zip(table.image or (), table.size, () if table.hits is None else table.hits, strict=True):
        found.setdefault(image, []).append(float(hit))
        sizes[image] = float(own)
    return Looks(
        sizes=tuple(sizes.values()),
        by_any=tuple(any(hits) for hits in found.values()),
        by_all=tuple(all(hits) for hits in found.values()),
    )


def _changes(
    campaign: Campaign, directory: Path, rows: Sequence[Mapping[str, Any]], screened: "Screened | None"
) -> tuple[dict[str, tuple[Change, ...]], str]:
    """What changes of each setting would do to its a90, and who says so: an observer brought to the networks, or one that is not."""
    from .sweep_screening import Screen, outlooks_of_rows

    if campaign.described:
        return {}, "nobody: an observer needs reference images"
    if not any(row["feasible"] for row in rows):
        return {}, "nobody: no setting can be"
    try:
        if screened is None:
            screen = Screen(campaign, directory / "references" / "test.h5", outlooks_of_rows(rows))
            screen.calibrate({str(row["setting"]): row for row in rows if row["trained"]})
        else:
            screen = screened.screen
        factors = screen.changes()
    except InputError as error:
        return {}, f"nobody: {error}"
    found = {
        text: tuple(Change(kind=kind, factor=value) for kind, value in one.items()) for text, one in factors.items()
    }
    return found, "a calibrated observer" if screen.efficiency is not None else "an observer that is not calibrated"


def _apart(best: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether the 95 % intervals of two a90 do not even touch: nothing is left to compare."""
    return best["a90_high"] is not None and other["a90_low"] is not None and best["a90_high"] < other["a90_low"]


def _ratio_to_best(
    directory: Path, best: Task, other: Task, curve: CurveOptions, tell: Callable[[str], None]
) -> dict[str, Any]:
    """a90 of a setting over that of the best, with its 95 % interval; on the same test images it is a paired comparison."""
    key = digest({"best": best["curve_key"], "other": other["curve_key"]})
    kept = directory / "compare" / f"{key[:20]}.json"
    held = read_object(kept)
    if held.get("key") == key:
        return dict(held["ratio"])
    tell(f"comparing {Path(other['folder']).name} with the best")
    ratio = compare_tables(Path(best["folder"]) / "hits.csv", Path(other["folder"]) / "hits.csv", curve)
    write_json(kept, {"key": key, "ratio": ratio})
    return ratio


def compare_tables(first: Path, second: Path, curve: CurveOptions) -> dict[str, Any]:
    """Ratio of the a90 of two hit tables, second over first: {value, low, high, paired}; null where there is none."""
    from ..pod import check_trials, compare_pod, read_pod_table

    tables = [read_pod_table(path, size=curve.size) for path in (first, second)]
    names = [set(table.image or ()) for table in tables]
    shared = bool(names[0]) and names[0] == names[1]
    trials = [
        check_trials(
            table.size,
            [] if table.hits is None else table.hits,
            network=table.network,
            image=table.image,
            log_size=curve.log_size,
        )
        for table in tables
    ]
    try:
        found = compare_pod(
            trials[0],
            trials[1],
            link=curve.link,
            log_size=curve.log_size,
            method=curve.method,
            repeats="crossed",
            shared_images=shared,
        )
    except (FitError, InputError) as error:
        return {"value": None, "low": None, "high": None, "paired": "nothing", "why": str(error)}
    ratio = found.ratio_a90
    ends = [None if one is None or not math.isfinite(one) else one for one in (ratio.value, ratio.low, ratio.high)]
    return {"value": ends[0], "low": ends[1], "high": ends[2], "paired": found.paired}


# ---------------------------------------------------------------------------------------------------- the folder


def _claim(directory: Path) -> None:
    """Make the folder that of a sweep, or refuse one of something else."""
    marker = directory / _MARKER
    if marker.exists():
        return
    if directory.exists() and any(directory.iterdir()):
        raise InputError(
            "-o",
            received=f"{directory}, a folder with other files in it",
            expected="a new or empty folder, or that of a sweep begun before",
        )
    directory.mkdir(parents=True, exist_ok=True)
    write_json(marker, {"format": "raytwin-sweep", "version": 1})


def _answer_of_another(directory: Path, campaign: Campaign, basis: Mapping[str, Any]) -> str:
    """What to say where the folder holds the answer of another campaign, which this one's replaces; nothing where it does not."""
    held = read_object(directory / "sweep.json")
    name = held.get("campaign", "")
    differs = [word for word, value in plain(basis).items() if held.get(word) != value]
    if not name or (not differs and name == campaign.path.name):
        return ""
    what = ", ".join(word.removesuffix("_sha256").replace("_", " ") for word in differs)
    had = f", with another {what}: all settings are trained anew" if differs else ""
    return f"{directory} holds the answer of {name}{had}; what was trained for it stays, its sweep.json, csv and report do not"


def marker_of(directory: Path) -> Path:
    """A file that is there once the folder is a sweep's: what workers on other machines must see."""
    _claim(directory)
    return (directory / _MARKER).resolve()
