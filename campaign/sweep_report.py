"""A sweep's answer as one self-contained HTML page."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..acquisition.dataset_io import read_dataset
from ..errors import RaytwinError
from ..reports import AFTER, BEFORE, MEASURED, QUIET, Chart, Figure, Points, Rule, SortedTable, write_page
from ..reports.chart import Shape
from ._ticks import few_ticks
from .decision_report import decision_part
from .pod_page import curve_marks
from .sweep_choice import paces
from .sweep_file import Campaign
from .sweep_trial import EXAMPLE

_DASH = "–"
_NUMBER = re.compile(r"(\d+(?:\.\d+)?)")
_MOST_CURVES = 8
_MOST_BARS = 60
_MOST_EXAMPLES = 24
# kind of a setting -> colour and shape, in the order of the legend
_KINDS: dict[str, tuple[str, Shape]] = {
    "recommended": (AFTER, "circle"),
    "not shown to be worse than the best": (MEASURED, "triangle"),
    "worse": (QUIET, "square"),
}
_FRONTS: dict[str, tuple[str, Shape]] = {
    "recommended": (AFTER, "circle"),
    "no other beats it in a90, dose and throughput": (BEFORE, "diamond"),
    "not on the front": (QUIET, "square"),
}


def write_report(
    answer: Mapping[str, Any],
    path: Path,
    *,
    campaign: Campaign,
    seconds: Mapping[str, float],
    version: str,
    interactive: bool | None = None,
) -> Path:
    """Write the report of a sweep's answer (what `run_sweep` returns); returns its path.

    Args:
        answer: rows, recommendation and what it rests on.
        path: the page to write, in the sweep's folder, whose example images it shows.
        campaign: whose settings of training and limits are told.
        seconds: what each setting took, by its text.
        version: of raytwin.
        interactive: figures that answer to the pointer; None: where Bokeh is installed.
    """
    rows = answer["rows"]
    size = _size_label(answer)
    shown = [row for row in rows if row["a90"] is not None]
    ordered = [row for row in by_upper_bound(rows) if row["trained"]]
    anchors = {str(row["setting"]): f"setting-{number}" for number, row in enumerate(ordered, start=1)}
    figures: dict[str, Figure | bytes] = {}
    if shown:
        figures["a90"] = intervals_chart(shown, size=size, goal=answer["goal"], anchors=anchors)
        figures |= {f"front_{name}": chart for name, chart in front_charts(shown, size=size, anchors=anchors).items()}
    curves = [row for row in rows if row["line"] or row["points"]]
    figures |= {f"pod_{number}": chart for number, chart in enumerate(curve_charts(curves, size=size))}
    examples = {str(row["setting"]): _example_png(path.parent, row) for row in ordered[:_MOST_EXAMPLES]}
    figures |= {f"example_{anchors[setting]}": png for setting, png in examples.items() if png is not None}
    decided, more = decision_part(answer)
    figures |= more
    columns = {name: any(row[name] is not None for row in ordered) for name in ("motion_px", "cnr_object")}
    columns["other_size"] = any(row["other_size"]["a90"] is not None for row in ordered)
    return write_page(
        path,
        Path(__file__).parent / "sweep_report.html",
        version=version,
        figures=figures,
        interactive=interactive,
        answer=answer,
        sentence=answer["sentence"],
        **decided,
        size=size,
        trained=_trained_table(
            ordered,
            seconds,
            columns=columns,
            anchors=anchors,
            other="contrast" if answer["other_size"] == "contrast" else "mm",
        ),
        fronts=[name for name in figures if name.startswith("front_")],
        pods=[name for name in figures if name.startswith("pod_")],
        examples=[
            {
                "figure": f"example_{anchors[str(row['setting'])]}",
                "anchor": f"images-{anchors[str(row['setting'])]}",
                "label": row["label"],
            }
            for row in ordered[:_MOST_EXAMPLES]
            if examples[str(row["setting"])] is not None
        ],
        left_out=_left_out_table([row for row in rows if not row["trained"]]),
        bars=_MOST_BARS if len(shown) > _MOST_BARS else 0,
        curves=_MOST_CURVES if len(curves) > _MOST_CURVES else 0,
        notes=_notes(rows),
        recommended=next((row for row in rows if row["recommended"]), None),
        facts=_facts(campaign, answer),
        limits=_limits(campaign),
    )


def intervals_chart(
    rows: Sequence[Mapping[str, Any]], *, size: str, goal: float | None, anchors: Mapping[str, str]
) -> Chart:
    """a90 of each setting with its two-sided 95 % interval and one-sided bound, the smallest bound first."""
    ordered = by_upper_bound(rows)
    taken = [row for row in ordered[_MOST_BARS:] if row["recommended"]]
    ordered = [*ordered[: _MOST_BARS - len(taken)], *taken]
    ends = [row[name] for row in ordered for name in ("a90", "a90_high", "a90_upper") if row[name] is not None]
    # bounds far beyond all estimates would squeeze the others; they stand in the table
    largest = max(*(row["a90"] for row in ordered), goal or 0.0, 0.0)
    end = min(1.06 * max([*ends, goal or 0.0]), 2.0 * largest)
    if any(row["a90_high"] is None for row in ordered):
        end = max(end, 1.4 * largest)
    marks: list[Any] = []
    places = {str(row["setting"]): float(number) for number, row in enumerate(ordered)}
    for kind, (colour, shape) in _KINDS.items():
        mine = [row for row in ordered if _kind(row) == kind]
        if not mine:
            continue
        high = [end if row["a90_high"] is None else min(row["a90_high"], end) for row in mine]
        marks.append(
            Points(
                x=[row["a90"] for row in mine],
                y=[places[str(row["setting"])] for row in mine],
                x_ends=([0.0 if row["a90_low"] is None else row["a90_low"] for row in mine], high),
                names=[_told(row) for row in mine],
                anchors=[anchors[str(row["setting"])] for row in mine],
                colour=colour,
                shape=shape,
                label=kind,
                size_px=10.0,
            )
        )
    bounded = [row for row in ordered if row["a90_upper"] is not None and row["a90_upper"] <= end]
    if bounded:
        marks.append(
            Points(
                x=[row["a90_upper"] for row in bounded],
                y=[places[str(row["setting"])] for row in bounded],
                names=[f"{row['label']}: one-sided bound" for row in bounded],
                colour="#111111",
                shape="diamond",
                label="one-sided 95 % bound",
                size_px=6.0,
            )
        )
    if goal is not None:
        marks.append(Rule(at=goal, along="x", label="goal", colour="#111111"))
    return Chart(
        name="a90_of_settings",
        alt="a90 of every setting with its two-sided 95 % interval. An interval that reaches the right edge has no end there."
        " A click on a point opens its row.",
        marks=marks,
        x_label=f"{size} at POD 90 %",
        x_ends=(0.0, end),
        y_ticks={places[str(row["setting"])]: str(row["label"]) for row in ordered},
        y_ends=(-0.7, len(ordered) - 0.3),
        downwards=True,
        wide=True,
        height_px=130 + 26 * len(ordered),
    )


def _told(row: Mapping[str, Any]) -> str:
    """A setting's name and, where its interval has no end, that."""
    if row["a90_high"] is not None:
        return str(row["label"])
    return f"{row['label']}: {'no interval' if row['a90_low'] is None else 'no upper end'}"


def front_charts(rows: Sequence[Mapping[str, Any]], *, size: str, anchors: Mapping[str, str]) -> dict[str, Chart]:
    """a90 against pace and against dose, with those that no other setting beats in all three."""
    belt = not any(row["throughput_per_s"] is not None for row in rows)
    largest = max(row["a90"] for row in rows)
    ends = [row["a90_high"] for row in rows if row["a90_high"] is not None]
    top = min(1.06 * max([*ends, 1.1 * largest]), 2.0 * largest)
    doses = [math.nan if row["dose_uGy"] is None else row["dose_uGy"]["value"] for row in rows]
    panels = {
        "pace": (paces(rows), "belt speed, mm/s" if belt else "throughput, products/s"),
        "dose": (doses, "air kerma of a pair, µGy"),
    }
    charts = {}
    for name, (values, title) in panels.items():
        known = [(value, row) for value, row in zip(values, rows, strict=True) if math.isfinite(value) and value > 0]
        if not known:
            continue
        marks = []
        for kind, (colour, shape) in _FRONTS.items():
            mine = [(value, row) for value, row in known if _front(row) == kind]
            if not mine:
                continue
            low = [0.0 if row["a90_low"] is None else row["a90_low"] for _, row in mine]
            # an interval without an end leaves the picture
            high = [top if row["a90_high"] is None else row["a90_high"] for _, row in mine]
            marks.append(
                Points(
                    x=[value for value, _ in mine],
                    y=[row["a90"] for _, row in mine],
                    y_ends=(low, high),
                    names=[_told(row) for _, row in mine],
                    anchors=[anchors[str(row["setting"])] for _, row in mine],
                    colour=colour,
                    shape=shape,
                    label=kind,
                    size_px=10.0,
                )
            )
        ticks, limits = few_ticks([value for value, _ in known])
        charts[name] = Chart(
            name=f"a90_against_{name}",
            alt=f"a90 against {title.partition(',')[0]}, with two-sided 95 % intervals. A click on a point opens its row.",
            marks=marks,
            x_label=title,
            y_label=f"{size} at POD 90 %",
            x_scale="log",
            x_ticks=ticks,
            x_ends=limits,
            y_ends=(0.0, top),
            height_px=380,
        )
    return charts


def curve_charts(fitted: Sequence[Mapping[str, Any]], *, size: str) -> list[Chart]:
    """POD curves with 95 % bands of the recommended setting, of those that no other beats, and of others up to eight."""
    ranked = sorted(
        fitted, key=lambda row: (not row["recommended"], not row["pareto"], row["a90"] is None, row["a90"] or 0.0)
    )
    charts = []
    for number, row in enumerate(ranked[:_MOST_CURVES], start=1):
        colour, _ = _KINDS[_kind(row)]
        marks = [Rule(at=0.9), *curve_marks(row, colour=colour)]
        if row["a90"] is not None:
            marks.append(Points(x=[row["a90"]], y=[0.9], colour=colour, shape="diamond", names=["a90"], size_px=10.0))
        charts.append(
            Chart(
                name=f"pod_{number}",
                title=str(row["label"]) + (" (recommended)" if row["recommended"] else ""),
                alt="POD with its 95 % band; dots: share of hits in groups of like size; diamond: a90.",
                marks=marks,
                x_label=size,
                y_label="probability of detection",
                y_ends=(-0.03, 1.03),
                height_px=270,
            )
        )
    return charts


def _example_png(folder: Path, row: Mapping[str, Any]) -> bytes | None:
    """A test pair of a setting around its foreign object, low and high kV, the object outlined; None where none was kept."""
    kept = folder / str(row["folder"] or "") / EXAMPLE
    if not row["folder"] or not kept.is_file():
        return None
    try:
        with read_dataset(kept) as dataset:
            pair, mask = dataset.images(0), dataset.foreign_object_masks(0)
    except RaytwinError:
        return None  # a page without this picture is better than none
    from scipy.ndimage import binary_dilation

    edge = binary_dilation(mask, iterations=2) & ~binary_dilation(mask)
    panels = []
    for image in pair:
        low, high = np.percentile(image, [0.5, 99.5])
        grey = np.clip((high - image) / max(float(high - low), 1e-9), 0.0, 1.0)
        panel = np.repeat((255.0 * grey).astype(np.uint8)[..., np.newaxis], 3, axis=-1)
        panel[edge] = (230, 159, 0)
        panels.append(panel)
    gap = np.full((panels[0].shape[0], 4, 3), 255, np.uint8)
    import imageio.v3

    return bytes(imageio.v3.imwrite("<bytes>", np.hstack([panels[0], gap, panels[1]]), extension=".png"))


def _kind(row: Mapping[str, Any]) -> str:
    recommended, alike, worse = _KINDS
    return recommended if row["recommended"] else alike if row["alike"] or row["best"] else worse


def _front(row: Mapping[str, Any]) -> str:
    recommended, front, beaten = _FRONTS
    return recommended if row["recommended"] else front if row["pareto"] else beaten


def by_upper_bound(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Smallest upper bound first; those without a bound, then those without a90, last; alike ones by the numbers of their labels."""
    return sorted(
        rows,
        key=lambda row: (
            row["a90"] is None,
            row["a90_upper"] is None,
            row["a90_upper"] or row["a90"] or 0.0,
            _words_and_numbers(str(row["label"])),
        ),
    )


def _words_and_numbers(label: str) -> tuple[str | float, ...]:
    """Words and numbers of a label in turn, so that 5 ms stands before 10 ms."""
    return tuple(float(part) if place % 2 else part for place, part in enumerate(_NUMBER.split(label)))


def _size_label(answer: Mapping[str, Any]) -> str:
    return "contrast" if answer["size"] == "contrast" else "size, mm"


def _number(value: float | None, digits: str = ".3g") -> str:
    return _DASH if value is None else format(value, digits)


def _interval(low: float | None, high: float | None) -> str:
    return f"{_number(low)} to {_number(high)}"


def _percent(share: float) -> str:
    """A share in per cent: two figures, and no more than two behind the point."""
    percent = 100.0 * share
    return f"{percent:.2g}" if 0.01 <= percent < 99.5 else f"{percent:.0f}"


def _ratio(ratio: Mapping[str, Any] | None) -> str:
    if not ratio or ratio["value"] is None:
        return _DASH
    if ratio["low"] is None and ratio["high"] is None:
        return f"{ratio['value']:.2f}"
    return f"{ratio['value']:.2f} ({_interval(ratio['low'], ratio['high'])})"


def _trained_table(
    rows: Sequence[Mapping[str, Any]],
    seconds: Mapping[str, float],
    *,
    columns: Mapping[str, bool],
    anchors: Mapping[str, str],
    other: str,
) -> SortedTable:
    """Every setting that was tried; columns that no row fills are left out."""
    header = ["setting", "a90 (95 %)", "a90/95"]
    header += [f"a90 in {other} (95 %)"] if columns["other_size"] else []
    header += ["over the best's (95 %)", "hits", "false alarms (95 %)", "products/s"]
    header += ["motion, px"] if columns["motion_px"] else []
    header += ["air kerma, µGy"]
    header += ["contrast to noise"] if columns["cnr_object"] else []
    header += ["extrapolated", "s", "remarks", "beam"]
    body = []
    for row in rows:
        alarms, dose, spent = row["false_alarm_rate"], row["dose_uGy"], seconds.get(row["setting"])
        cells = [
            str(row["label"]),
            _DASH if row["a90"] is None else f"{row['a90']:.3g} ({_interval(row['a90_low'], row['a90_high'])})",
            _number(row["a90_upper"]),
            *([_other_size(row["other_size"])] if columns["other_size"] else []),
            _ratio(row["ratio_to_best"]),
            f"{row['n_hits']}/{row['n']}",
            _DASH
            if alarms is None
            else f"{_percent(alarms['value'])} % ({_percent(alarms['low'])} to {_percent(alarms['high'])})",
            _number(row["throughput_per_s"]),
        ]
        cells += [_number(row["motion_px"])] if columns["motion_px"] else []
        cells += [_number(None if dose is None else dose["value"])]
        cells += [_number(row["cnr_object"])] if columns["cnr_object"] else []
        cells += ["yes" if row["extrapolated"] else "no", _DASH if spent is None else f"{spent:.0f}", _remarks(row)]
        body.append((*cells, f"{row['low']}; {row['high']}"))
    return SortedTable(
        header=tuple(header),
        rows=tuple(body),
        words=frozenset({0, len(header) - 2, len(header) - 1}),
        anchors=tuple(anchors[str(row["setting"])] for row in rows),
        marked=frozenset(number for number, row in enumerate(rows) if row["recommended"]),
    )


def _remarks(row: Mapping[str, Any]) -> str:
    marks = ["recommended"] if row["recommended"] else []
    if row["best"] and not row["recommended"]:
        marks.append("smallest bound")
    if row["alike"]:
        marks.append("not shown to be worse")
    if row["pareto"]:
        marks.append("front")
    if row["reason"]:
        # the figures in brackets stand among the warnings
        marks.append(str(row["reason"]).partition(" (")[0])
    return "; ".join(marks)


def _other_size(other: Mapping[str, Any]) -> str:
    return _DASH if other["a90"] is None else f"{other['a90']:.3g} ({_interval(other['a90_low'], other['a90_high'])})"


def _left_out_table(rows: Sequence[Mapping[str, Any]]) -> SortedTable:
    def kerma(row: Mapping[str, Any]) -> str:
        return _number(None if row["dose_uGy"] is None else row["dose_uGy"]["value"])

    return SortedTable(
        header=("setting", "", "reason", "products/s", "air kerma, µGy", "contrast to noise"),
        rows=tuple(
            (
                str(row["label"]),
                "cannot be" if not row["feasible"] else "not tried",
                str(row["reason"]),
                _number(row["throughput_per_s"]),
                kerma(row),
                _number(row["cnr_object"]),
            )
            for row in rows
        ),
        words=frozenset({0, 1, 2}),
    )


def _notes(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Each warning once, with the settings that it belongs to."""
    where: dict[str, list[str]] = {}
    for row in rows:
        for line in row["warnings"]:
            where.setdefault(line, []).append(str(row["label"]))
    everywhere = len(rows)
    return [
        (line if len(labels) == everywhere else f"{'; '.join(labels[:4])}{' ...' if len(labels) > 4 else ''}: {line}")
        for line, labels in where.items()
    ]


def _facts(campaign: Campaign, answer: Mapping[str, Any]) -> list[str]:
    training, trying = campaign.training, campaign.trying
    marked = (
        f"a pixel is marked above a probability of {trying.threshold:g}"
        if trying.threshold is not None
        else f"each network's threshold lets {100 * trying.marked_share:g} % of the images it learnt from show a mark away from"
        " objects"
    )
    start = (
        f"they start from one network that learnt for {training.start_steps} steps from the"
        f" {'clearest images' if campaign.described else 'references'} and {training.mixed_steps} from noisier ones"
        if training.start_steps
        else "they start from random weights"
    )
    tests = "other products of it" if campaign.test_references is None else campaign.test_references.name
    counts = {row["objects"] for row in answer["rows"] if row["trained"]}
    tried = (
        f"Tried on {counts.pop()} foreign objects, the same at every setting"
        if len(counts) == 1
        else "Tried on held-back images"
    )
    return [
        f"Twin {campaign.twin.name}; images for training come from {campaign.references.name}, those to try networks on from"
        f" {tests}.",
        f"Each setting has {training.networks} networks, trained for {training.steps} steps on {training.images} pairs generated"
        f" at it (recipe {training.recipe}, batch {training.batch}); {start}.",
        f"{tried}; {marked}.",
    ]


def _limits(campaign: Campaign) -> list[str]:
    """The limits that the campaign states, in its own words."""
    stated = [f"{name} = {value:g}" for name, value in asdict(campaign.limits).items() if isinstance(value, float)]
    return stated if campaign.limits.extrapolation else [*stated, "extrapolation = false"]
