"""The page of the paper's table."""

from collections.abc import Mapping, Sequence
from typing import Any

from ..diagnosis.inference.inference import title_of
from ..reports import (
    AFTER,
    BEFORE,
    MEASURED,
    Chart,
    KeyFigure,
    Points,
    ResultPage,
    Rule,
    Section,
    SortedTable,
    Step,
)
from ..reports.chart import Shape
from .lab_line import REFERENCE_MS
from .pod_page import a90_chart, curve_marks
from .table import WIDE, signed

_DASH = "–"
_WORDS = {"equivalent": "equivalent", "different": "different", "not_stated": "not stated"}
_KINDS: tuple[tuple[str, str, str, Shape], ...] = (
    ("measured", "measured test images", MEASURED, "square"),
    ("generated", "generated test images", AFTER, "circle"),
)


def table_page(result: Mapping[str, Any]) -> ResultPage:
    """The table with its figures; `result` is what `run_table` returns."""
    rows, plan = result["rows"], result["plan"]
    pairs = [row for row in rows if row["compare"] is not None]
    margin = plan["margin"]
    pending = [*result["pending"], *result["published_pending"], *result["effects_pending"]]
    notes = _notes(result)
    return ResultPage(
        heading="Contrast at POD 90 %, generated against measured",
        answer=_answer(result, pairs),
        key_figures=tuple(_key_figure(row) for row in pairs),
        proof=(exposures_chart(rows), difference_chart(pairs, margin=margin)) if pairs else (),
        steps=() if not pending else (Step(text="Go on where this run stopped.", command="raytwin table -o FOLDER"),),
        sections=(
            Section(
                title="The table",
                text=(
                    "Contrast at POD 90 % with its 95 % interval. Networks and products are crossed random effects; where all"
                    " networks find the same products, the interval is clustered by both (see the notes).",
                    f"Each network marks at the threshold that {100 * plan['alarm_share']:g} % of the {plan['line']['boneless']}"
                    " products without bone reach, measured ones for measured images, generated ones for generated images.",
                    "Found: looks at products with a bone in which it was marked, in generated | measured images.",
                ),
                table=_table(rows),
                items=tuple(_equivalence(row["compare"], _exposure(row)) for row in pairs),
            ),
            Section(title="False alarms", text=_alarm_text(plan), table=_alarms(pairs)),
            Section(
                title="POD curves",
                figures=tuple(pod_chart(row) for row in rows),
            ),
            *([_published(pairs)] if any(row["published"] for row in pairs) else []),
            *([_effects(result)] if result["effects"] else []),
            Section(title="How it was made", text=_made(result)),
            *([Section(title=f"Notes on the curves ({len(notes)})", items=tuple(notes), folded=True)] if notes else []),
        ),
        doubtful=bool(result["pending"]) or not pairs,
        made_from=f"seed {plan['line']['seed']}",
    )


def _answer(result: Mapping[str, Any], pairs: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    margin = result["plan"]["margin"]
    lines = []
    if result["pending"]:
        lines.append(f"This table is not finished. Still to come: {_exposures(result['pending'])}.")
    if result["published_pending"]:
        lines.append(f"Images generated as published are still to come at {_exposures(result['published_pending'])}.")
    if result["effects_pending"]:
        lines.append(f"Lines with an effect are still to come: {_titles(result['effects_pending'])}.")
    for state, text in (
        ("equivalent", f"Generated and measured test images give the same a90 within {margin:g} at"),
        ("different", "Generated and measured test images give different a90 at"),
        ("not_stated", f"These test sets cannot say whether both agree within {margin:g} at"),
    ):
        found = [row["exposure_ms"] for row in pairs if row["compare"]["equivalence"] == state]
        if found:
            lines.append(f"{text} {_exposures(found)}.")
    return tuple(lines)


def _key_figure(row: Mapping[str, Any]) -> KeyFigure:
    value = " | ".join(_number(row[kind]["a90"]) for kind in ("generated", "measured"))
    return KeyFigure(value=value, text=f"a90 at {_exposure(row)}: generated | measured")


def exposures_chart(rows: Sequence[Mapping[str, Any]]) -> Chart:
    """a90 with its interval against exposure."""
    published: tuple[str, str, str, Shape] = ("published", "generated as published", BEFORE, "triangle")
    kinds = []
    for kind, label, colour, shape in (*_KINDS, published):
        curves = {row["exposure_ms"]: _curve_of(row, kind) for row in rows}
        known = {exposure: curve for exposure, curve in curves.items() if curve and curve["a90"] is not None}
        found = {exposure: (one["a90"], _end(one, "low"), _end(one, "high")) for exposure, one in known.items()}
        kinds.append((label, colour, shape, found))
    return a90_chart(kinds)


def difference_chart(pairs: Sequence[Mapping[str, Any]], *, margin: float) -> Chart:
    """Generated less measured a90 with its 95 % interval, and the margin."""
    known = [row for row in pairs if _difference(row["compare"]).get("value") is not None]
    found = [_difference(row["compare"]) for row in known]
    ends = tuple([one["value"] if one[name] is None else one[name] for one in found] for name in ("low", "high"))
    exposures = [row["exposure_ms"] for row in pairs]
    reach = 1.1 * max([2.0 * margin, *(abs(value) for values in ends for value in values)])
    points = Points(
        x=[row["exposure_ms"] for row in known],
        y=[one["value"] for one in found],
        y_ends=(ends[0], ends[1]),
        names=[_equivalence(row["compare"], _exposure(row)) for row in known],
        label="difference of a90",
    )
    return Chart(
        name="difference_of_a90",
        alt="Generated less measured contrast at POD 90 % with its 95 % interval, and the margin of equivalence on both sides.",
        marks=[
            *([points] if known else []),
            Rule(at=0.0),
            Rule(at=margin, colour=BEFORE, label="margin"),
            Rule(at=-margin, colour=BEFORE),
        ],
        x_label="exposure, ms",
        y_label="generated less measured a90",
        y_ends=(-reach, reach),
        x_scale="log",
        x_ticks={exposure: f"{exposure:g}" for exposure in exposures},
        x_ends=(min(exposures) / 1.3, max(exposures) * 1.3),
    )


def pod_chart(row: Mapping[str, Any]) -> Chart:
    """Both curves of an exposure with the share of hits in groups of like contrast."""
    marks: list[Any] = [Rule(at=0.9)]
    for kind, label, colour, shape in _KINDS:
        curve = row[kind]
        if curve is None:
            continue
        marks += curve_marks(
            curve, colour=colour, label=label, dashed=kind == "measured", band=False, of_points=(colour, shape)
        )
    return Chart(
        name=f"pod_{row['exposure_ms']:g}ms",
        title=_exposure(row),
        alt=f"POD against contrast at {_exposure(row)}; dots: share of hits in groups of like contrast.",
        marks=marks,
        x_label="contrast",
        y_label="probability of detection",
        y_ends=(-0.03, 1.03),
    )


def _table(rows: Sequence[Mapping[str, Any]]) -> SortedTable:
    shown = []
    for row in rows:
        compared = row["compare"]
        difference = {} if compared is None else _difference(compared)
        shown.append(
            (
                _exposure(row),
                _interval(row["generated"]),
                _interval(row["measured"]),
                _signed(difference),
                _DASH if compared is None else _WORDS[compared["equivalence"]],
                f"{_hits(row['generated'])} | {_hits(row['measured'])}",
            )
        )
    return SortedTable(
        header=(
            "exposure",
            "generated",
            "measured",
            "difference",
            "agree",
            "found",
        ),
        rows=tuple(shown),
        words=frozenset({0, 4}),
    )


def _alarms(pairs: Sequence[Mapping[str, Any]]) -> SortedTable:
    def told(alarms: Mapping[str, Any] | None) -> str:
        if alarms is None:
            return _DASH
        ends = " to ".join(f"{100 * alarms[end]:.1f}" for end in ("low", "high"))
        return f"{100 * alarms['rate']:.1f} % ({ends})"

    return SortedTable(
        header=("exposure", "set on generated", "set on measured", "measured, at the thresholds of generated"),
        rows=tuple(
            (
                _exposure(row),
                *(f"{100 * row[kind]['false_alarms']['rate']:.1f} %" for kind in ("generated", "measured")),
                told(row["alarms_on_measured"]),
            )
            for row in pairs
        ),
    )


def _alarm_text(plan: Mapping[str, Any]) -> tuple[str, ...]:
    share = f"{100 * plan['alarm_share']:g} %"
    return (
        f"Thresholds are set so that {share} of the looks at products without bone end in an alarm, in each kind of images by"
        " itself. So both a90 of a row are at one rate.",
        "The last column is what a line would see whose thresholds come from generated images: false alarms on measured"
        " products, with the 95 % interval of the products and networks tried.",
    )


def _published(pairs: Sequence[Mapping[str, Any]]) -> Section:
    rows = [
        (
            _exposure(row),
            _interval(row["published"]["generated"]),
            _interval(row["published"]["measured"]),
            _signed(_difference(row["published"]["compare"])),
            _WORDS[row["published"]["compare"]["equivalence"]],
        )
        for row in pairs
        if row["published"]
    ]
    return Section(
        title="The published recipe of the images",
        text=(
            "The same networks learn from images that were generated as published (as_published), and are tried on such images"
            " and on the measured ones.",
        ),
        table=SortedTable(
            header=("exposure", "generated as published", "measured", "difference", "agree"),
            rows=tuple(rows),
            words=frozenset({0, 4}),
        ),
        items=tuple(_equivalence(row["published"]["compare"], _exposure(row)) for row in pairs if row["published"]),
    )


def _effects(result: Mapping[str, Any]) -> Section:
    """Lines with an effect in them: the three a90 of every exposure, and how far the twin's lie from the measured one."""
    plan = result["effects_plan"]
    every = [(line, row) for line in result["effects"] for row in line["rows"]]
    rows = [
        (
            f"{line['effect'].replace('_', ' ')}, {line['strength']:g} {line['unit']}",
            _found(line),
            f"{row['exposure_ms']:g} ms",
            *(_a90(row[name]) for name in ("before", "after", "real")),
        )
        for line, row in every
    ]
    told = [(f"{line['effect'].replace('_', ' ')}, {row['exposure_ms']:g} ms", row) for line, row in every]
    differences = [
        f"{name}, difference from measured: before {_signed(row['before_less_real'] or {})},"
        f" after {_signed(row['after_less_real'] or {})}."
        for name, row in told
    ]
    notes = [f"{name}: {warning}" for name, row in told for warning in row["warnings"]]
    return Section(
        title="Lines with an effect in them",
        text=(
            "Each effect stands in a line of its own. The diagnosis sees one session of it and adds what it finds to the twin."
            " Products of another day are measured, and generated by the twin as it was calibrated (before) and with what was found"
            " (after).",
            f"{plan['networks']} networks of each kind learn from half of the {plan['products']} products and are tried on the other"
            " half, in images of their own kind. Contrast at POD 90 % with its 95 % interval.",
        ),
        table=SortedTable(
            header=("in the line", "found", "exposure", "before", "after", "measured"),
            rows=tuple(rows),
            words=frozenset({0, 1, 2}),
        ),
        items=(*differences, *dict.fromkeys(notes)),
    )


def _found(line: Mapping[str, Any]) -> str:
    """What the diagnosis says of a line: the strength of what stands in it, and what else it names."""
    found = line["found"]
    others = [name for name in found["named"] if name != line["effect"]]
    beside = f"; also {_titles(others)}" if others else ""
    strength = found["strength"]
    if strength is None:
        return (
            f"{found['verdict'].replace('_', ' ')}: {_titles(others)}" if others else found["verdict"].replace("_", " ")
        )
    return f"{strength['value']:.3g} ({strength['low']:.3g} to {strength['high']:.3g}) {strength['unit']}{beside}"


def _a90(found: Mapping[str, Any]) -> str:
    if found["a90"] is None:
        return _DASH
    return f"{_number(found['a90'])} ({_number(found['a90_95']['low'])} to {_number(found['a90_95']['high'])})"


def _titles(effects: Sequence[str]) -> str:
    return ", ".join(title_of(effect).lower() for effect in effects)


def _made(result: Mapping[str, Any]) -> tuple[str, ...]:
    plan, line = result["plan"], result["plan"]["line"]
    error = result["line"]["median_abs_error_percent"]
    rows, columns = line["size"]
    shared = plan["start"] == "starter"
    return (
        f"{result['networks']}.",
        *(
            [
                "All networks start from the same weights. They differ less than networks from scratch, and their spread does not"
                " hold the chance in those weights."
            ]
            if shared
            else []
        ),
        f"Line: the virtual lab's, {rows} x {columns} pixels of {line['pixel_mm']:g} mm"
        + ("" if line["source_detector_mm"] is None else f", detector at {line['source_detector_mm']:g} mm")
        + ", without scatter, lag, glare or drift. Its contrasts are not those of the paper's line, which has other pixels,"
        " distances and products.",
        f"The twin predicts the mean of {result['line']['flats']} flats at settings it never saw to {error['mean']:.2g} %, their"
        f" noise to {error['sd']:.2g} % (median).",
        f"Learning: {line['products']} products at 1 s; {line['generated']} image pairs generated from them at every other"
        " exposure. At 1 s networks learn from the measured images.",
        f"Test: {line['test_products'] - line['boneless']} products with a bone and {line['boneless']} without, of two fillets, each"
        " measured at every exposure and generated from its 1 s image.",
    )


def _notes(result: Mapping[str, Any]) -> list[str]:
    """Warnings of the curves and comparisons, each once with the curves it belongs to; and intervals that are wide."""
    where: dict[str, list[str]] = {}
    for row in result["rows"]:
        parts = [("generated", row["generated"]), ("measured", row["measured"]), ("comparison", row["compare"])]
        if row["published"]:
            parts += [(f"published, {name}", row["published"][name]) for name in ("generated", "measured", "compare")]
        for label, part in parts:
            for line in (part or {}).get("warnings", []):
                where.setdefault(str(line), []).append(f"{_exposure(row)} {label}")
            if label == "comparison" or label.endswith("compare"):
                continue
            width = (part or {}).get("half_width")
            if width is not None and width > WIDE:
                text = f"the 95 % interval is wider than +-{100 * WIDE:g} % of the a90"
                where.setdefault(text, []).append(f"{_exposure(row)} {label} (+-{100 * width:.0f} %)")
        if row["compare"] is not None and _fitted_anew(row):
            text = "both curves were fitted alike for the difference (clustered), so that it is not that of the two columns"
            where.setdefault(text, []).append(_exposure(row))
    return [f"{', '.join(curves)}: {line}" for line, curves in where.items()]


def _fitted_anew(row: Mapping[str, Any]) -> bool:
    """Whether the comparison's difference is another one than that of the row's two a90."""
    value = (row["compare"]["difference_a90"] or {}).get("value")
    ends = [row[kind]["a90"] for kind in ("generated", "measured")]
    return value is not None and None not in ends and abs(value - (ends[0] - ends[1])) > 5e-4


def _curve_of(row: Mapping[str, Any], kind: str) -> Mapping[str, Any] | None:
    found = row["published"]["generated"] if kind == "published" and row["published"] else row.get(kind)
    return None if found is None or "a90" not in found else found


def _end(curve: Mapping[str, Any], name: str) -> float:
    """An end of the interval; the a90 itself where there is none."""
    found = curve["a90_95_interval"][name]
    return float(curve["a90"] if found is None else found)


def _exposure(row: Mapping[str, Any]) -> str:
    return _exposures([row["exposure_ms"]])


def _exposures(values: Sequence[float]) -> str:
    return ", ".join("1 s" if value == REFERENCE_MS else f"{value:g} ms" for value in values)


def _equivalence(compared: Mapping[str, Any], exposure: str) -> str:
    return f"{exposure}: {_WORDS[compared['equivalence']]}, for {compared['reason']}."


def _number(value: float | None) -> str:
    return _DASH if value is None else f"{value:.3f}"


def _interval(curve: Mapping[str, Any] | None) -> str:
    if curve is None or curve["a90"] is None:
        return _DASH
    ends = curve["a90_95_interval"]
    wide = " (wide)" if curve["half_width"] is None or curve["half_width"] > WIDE else ""
    return f"{_number(curve['a90'])} ({_number(ends['low'])} to {_number(ends['high'])}){wide}"


def _difference(compared: Mapping[str, Any]) -> Mapping[str, Any]:
    """Difference of the two a90 with its interval; empty where there is none."""
    return dict(compared["difference_a90"] or {})


def _signed(difference: Mapping[str, Any]) -> str:
    if difference.get("value") is None:
        return _DASH
    if difference["low"] is None and difference["high"] is None:
        return signed(difference["value"])
    ends = (_DASH if difference[end] is None else signed(difference[end]) for end in ("low", "high"))
    return f"{signed(difference['value'])} ({' to '.join(ends)})"


def _hits(curve: Mapping[str, Any] | None) -> str:
    return _DASH if curve is None else str(curve["n_hits"])
