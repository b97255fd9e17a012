"""Pages of a calibrated twin and of its validation."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..acquisition.setting import text_from_filters
from ..calibration.validate import Validation, compared
from ..generator.line.twin import Estimate, Level, Twin
from ..generator.predictions.tube_twin import TubeTwin
from ..generator.twins.twin_answer import BEYOND, calibration_answer
from ..reports import Chart, Figure, KeyFigure, Line, Picture, Points, ResultPage, Rule, Section, SortedTable, Step
from ..reports.chart import AFTER, BEFORE, MEASURED, QUIET, SERIES_COLOURS, SHAPES, Shape, rows_px

_KINDS: dict[str, tuple[str, Shape]] = {
    "not seen": (AFTER, "circle"),
    "left out": (MEASURED, "triangle"),
    "extrapolated": (BEFORE, "diamond"),
    "calibrated with": (QUIET, "square"),
}


def _interval(value: Mapping[str, Any] | None, unit: str) -> str:
    if value is None:
        return "not known"
    return f"{value['value']:.4g} ({value['low']:.4g} to {value['high']:.4g}) {unit}".strip()


def twin_page(twin: Twin | TubeTwin) -> ResultPage:
    """What calibration found, with the photon transfer that shows it and the maps of the detector."""
    answer = calibration_answer(twin)
    if isinstance(twin, TubeTwin):
        return _tube_page(twin, answer)
    rows, columns = twin.maps.shape
    pitch = "" if twin.instrument.pixel_mm is None else f" of {twin.instrument.pixel_mm:g} mm"
    levels = ", ".join(_level_name(level) for level in twin.levels)
    lines = [f"A detector of {rows} x {columns} pixels{pitch}, calibrated at {levels or 'no level'}."]
    if twin.spectral is None:
        lines.append("There is no spectral part: only the measured voltages and filters can be predicted.")
    key = [
        KeyFigure(
            value=f"{level.gain_DN.value:.3g} DN", text=f"gain at {_level_name(level)} (95 %: {_ends(level.gain_DN)})"
        )
        for level in twin.levels[:2]
    ]
    key.append(KeyFigure(value=f"{twin.noise.read_noise_DN.value:.3g} DN", text="read noise"))
    if answer["psf_sigma_px"] is not None:
        key.append(KeyFigure(value=f"{answer['psf_sigma_px']['value']:.2f} px", text="optical spread (Gaussian width)"))
    if answer["inherent_filtration_mm_Al"] is not None:
        filtration = answer["inherent_filtration_mm_Al"]
        key.append(
            KeyFigure(
                value=f"{filtration['value']:.2f} mm Al",
                text=f"filtration that nobody declared (95 %: {filtration['low']:.2f} to {filtration['high']:.2f})",
            )
        )
    charts = photon_transfer_charts(twin)
    return ResultPage(
        heading="Calibrated twin",
        answer=tuple(lines),
        key_figures=tuple(key),
        proof=(*charts, gain_picture(twin)),
        steps=_steps(answer),
        sections=(
            Section(title="Parameters", table=_parameters(twin, answer)),
            Section(title="Levels", table=_levels(answer)),
            *(
                [Section(title=f"Warnings ({len(answer['warnings'])})", items=tuple(answer["warnings"]))]
                if answer["warnings"]
                else []
            ),
            Section(title="Maps of the detector", figures=map_pictures(twin), folded=True),
            Section(title="Series that were used", table=_series(twin), folded=True),
            *_spectral_sections(twin),
        ),
        made_from=_made_from(twin.provenance),
    )


def _tube_page(twin: TubeTwin, answer: Mapping[str, Any]) -> ResultPage:
    warnings = Section(title="Warnings", items=tuple(twin.warnings))
    return ResultPage(
        heading="Calibrated tube",
        answer=("A tube without a detector: spectra and doses can be predicted, images cannot.",),
        steps=_steps(answer),
        sections=(
            Section(title="Parameters", table=_parameters(twin, answer)),
            *([warnings] if twin.warnings else []),
            *_spectral_sections(twin),
        ),
        made_from=_made_from(twin.provenance),
    )


def _level_name(level: Level) -> str:
    voltage = "unknown kV" if level.kV is None else f"{level.kV:g} kV"
    return f"{voltage} {text_from_filters(level.filters)}".strip()


def _ends(value: Estimate) -> str:
    return f"{value.low:.4g} to {value.high:.4g}"


def _made_from(provenance: Mapping[str, Any]) -> str:
    return "; ".join(
        f"{name.replace('_', ' ')} {value}"
        for name, value in provenance.items()
        if isinstance(value, str | int | float)
    )


def _steps(answer: Mapping[str, Any]) -> tuple[Step, ...]:
    found = [
        Step(
            text="Test the twin on flats that calibration did not look at.",
            command="raytwin validate TWIN SESSION --leave-one-out",
        )
    ]
    following = answer.get("next_measurement")
    if following and following.get("text"):
        found.append(Step(text=f"To narrow predictions most: {following['text']}."))
    found.append(Step(text="Predict a setting.", command="raytwin predict TWIN --kv 60 --power-w 30 --exposure-ms 20"))
    return tuple(found)


def _parameters(twin: Twin | TubeTwin, answer: Mapping[str, Any]) -> SortedTable:
    units = {
        "dark": ("dark_DN", "DN"),
        "read noise": ("read_noise_DN", "DN"),
        "optical spread, Gaussian width": ("psf_sigma_px", "px"),
        "inherent filtration": ("inherent_filtration_mm_Al", BEYOND),
        "flux over the spectrum model's": ("flux_scale", ""),
    }
    rows = [(name, _interval(answer[key], unit)) for name, (key, unit) in units.items() if key in answer]
    if isinstance(twin, Twin):
        bad = twin.maps.bad_pixels > 0
        rows.append(("bad pixels", f"{int(bad.sum())} ({100.0 * float(bad.mean()):.3g} %)"))
    return SortedTable(header=("quantity", "value (95 %)"), rows=tuple(rows), words=frozenset({0, 1}))


def _levels(answer: Mapping[str, Any]) -> SortedTable:
    def known(value: float | None) -> str:
        return "not known" if value is None else f"{value:.4g}"

    rows = [
        (
            "unknown kV" if level["kV"] is None else f"{level['kV']:g} kV",
            level["filter"] or "none",
            f"{level['gain_DN']:.4g} ({level['gain_DN_low']:.4g} to {level['gain_DN_high']:.4g})",
            f"{level['photon_transfer_slope_DN']:.4g}",
            _interval(level["rate_DN_per_mAs"], ""),
            known(level["saturation_DN"]),
            str(len(level["series"])),
        )
        for level in answer["levels"]
    ]
    header = (
        "voltage",
        "filter",
        "gain, DN (95 %)",
        "slope as measured, DN",
        "rate, DN per mAs (95 %)",
        "saturation, DN",
        "series",
    )
    return SortedTable(header=header, rows=tuple(rows), words=frozenset({0, 1}))


def _series(twin: Twin) -> SortedTable:
    rows = [
        (
            str(point["series"]),
            f"{point['signal_DN']:.5g}",
            f"{point['pair_variance_DN2']:.4g}",
            str(point["frames"]),
            f"{point['drift_percent']:+.3f}" if point.get("drift_percent") is not None else "",
            "yes" if point["used"] else str(point["masked"] or "no"),
        )
        for point in twin.evidence.get("photon_transfer", ())
    ]
    header = ("series", "signal, DN", "variance, DN²", "frames", "drift within it, %", "used")
    return SortedTable(header=header, rows=tuple(rows), words=frozenset({0, 5}))


def _spectral_sections(twin: Twin | TubeTwin) -> list[Section]:
    spectral = twin.spectral
    if spectral is None:
        return []
    rows = []
    for name in spectral.names:
        value = spectral.interval(name)
        rows.append(
            (name, f"{value.value:.4g} ({value.low:.4g} to {value.high:.4g})", str(spectral.prior.get(name, "")))
        )
    table = SortedTable(header=("parameter", "median (95 %)", "prior"), rows=tuple(rows), words=frozenset({0, 2}))
    text = (f"{spectral.anode} anode, {spectral.anode_angle_deg:g} degrees, model {spectral.model}.",)
    return [
        Section(
            title="Spectrum: parameters and priors",
            text=text,
            table=table,
            items=tuple(spectral.undetermined),
            folded=True,
        )
    ]


def photon_transfer_charts(twin: Twin) -> tuple[Chart, ...]:
    """Variance of one pixel against signal for every flat with the fitted lines, and what is left; empty without flats."""
    points = [
        point
        for point in twin.evidence.get("photon_transfer", ())
        if point["signal_DN"] > 0 and point["pair_variance_DN2"] > 0
    ]
    read = twin.noise.read_variance_DN2
    transfer: list[Any] = []
    left: list[Any] = [Rule(at=0.0)]
    for index, level in enumerate(twin.levels):
        members = [point for point in points if point["series"] in level.series]
        if not members:
            continue
        signal = np.array([point["signal_DN"] for point in members])
        variance = np.array([point["pair_variance_DN2"] for point in members])
        slope = level.photon_transfer_slope_DN.value
        colour, shape = SERIES_COLOURS[index % len(SERIES_COLOURS)], SHAPES[index % len(SHAPES)]
        names = [str(point["series"]) for point in members]
        line = np.geomspace(signal.min() * 0.8, signal.max() * 1.2, 60)
        transfer += [
            Line(x=line, y=slope * line + read, colour=colour, thin=True),
            Line(x=line, y=level.gain_DN.value * line + read, colour=colour, thin=True, dashed=True),
            Points(x=signal, y=variance, colour=colour, shape=shape, names=names, label=_level_name(level)),
        ]
        rest = 100.0 * (variance / (slope * signal + read) - 1.0)
        left.append(Points(x=signal, y=rest, colour=colour, shape=shape, names=names, label=_level_name(level)))
    if not transfer:
        return ()
    x_label = "signal above dark, DN"
    return (
        Chart(
            name="photon_transfer",
            title="Photon transfer",
            alt="Variance of a pixel against signal, a point a series. Solid: fitted. Dashed: with the blur's share restored.",
            marks=transfer,
            x_label=x_label,
            y_label="variance, DN²",
            x_scale="log",
            y_scale="log",
        ),
        Chart(
            name="photon_transfer_residuals",
            title="What the lines leave",
            alt="Measured over fitted variance, less 1.",
            marks=left,
            x_label=x_label,
            y_label="measured over fitted - 1, %",
            x_scale="log",
        ),
    )


def _map_picture(twin: Twin, name: str, title: str, values: Any, label: str) -> Picture:
    good = twin.maps.bad_pixels == 0
    shown = np.where(good, values, np.nan)
    low, high = (float(value) for value in np.nanpercentile(shown, [1.0, 99.0]))
    if not high > low:
        low, high = low - 0.5, high + 0.5
    return Picture(
        name=name,
        title=title,
        alt=f"{title}; the colours end at the 1st and 99th percentile, bad pixels are left out.",
        values=shown,
        label=label,
        ends=(low, high),
    )


def gain_picture(twin: Twin) -> Picture:
    """Gain of each pixel over the detector's median."""
    return _map_picture(twin, "gain_map", "Gain of each pixel", twin.maps.gain_relative, "gain over the median")


def map_pictures(twin: Twin) -> tuple[Figure, ...]:
    """Dark and electronic variance of each pixel."""
    return (
        _map_picture(twin, "dark_map", "Dark", twin.maps.dark_DN, "DN"),
        _map_picture(twin, "read_variance_map", "Electronic variance", twin.maps.read_variance_DN2, "DN²"),
    )


def validation_page(found: Validation) -> ResultPage:
    """Predictions against measurements: errors with their intervals, quantity by quantity."""
    answer = found.to_dict()
    key: list[KeyFigure] = []
    lines: list[str] = []
    if answer["rows"]:
        error, coverage = answer["median_abs_error_percent"], answer["coverage"]
        key += _scores("level", error["mean"], coverage["mean"])
        if error["sd"] is not None:
            key += _scores("noise level", error["sd"], coverage["sd"])
        lines.append(f"{coverage['rows']} flat series were compared. Intervals that are right hold 95 % of them.")
        seen = sum(row.used_in_calibration for row in found.rows)
        if seen:
            lines.append(
                f"{seen} of them calibrated this twin: their errors say how well it fits, not how well it predicts."
            )
    if "wedges" in answer:
        key += _scores("transmission", answer["wedges"]["median_abs_error_percent"], answer["wedges"]["coverage"])
        lines.append(f"{len(answer['wedges']['rows'])} steps of wedges were compared by their transmission.")
    groups = compared(found)
    steps = []
    if not any(kind in ("not seen", "left out") for rows in groups.values() for _, _, _, kind in rows):
        steps.append(
            Step(
                text="Nothing here is new to the twin. Hold series back, or predict each level from the others.",
                command="raytwin validate TWIN SESSION --leave-one-out",
            )
        )
    outside = [row.series for row in found.rows if not row.inside_mean]
    if len(outside) > max(1, round(0.1 * len(found.rows))):
        steps.append(
            Step(
                text=f"{len(outside)} of {len(found.rows)} levels lie outside their intervals. Ask what the twin lacks.",
                command="raytwin diagnose SESSION -o diagnosis --twin TWIN",
            )
        )
    skipped = Section(title=f"Not compared ({len(found.skipped)})", items=found.skipped, folded=True)
    return ResultPage(
        heading="Predictions against measurements",
        answer=tuple(lines) or ("Nothing could be compared.",),
        key_figures=tuple(key),
        proof=tuple(error_chart(what, rows) for what, rows in groups.items()),
        steps=tuple(steps),
        sections=(Section(title="Every comparison", table=_comparisons(groups)), *([skipped] if found.skipped else [])),
        doubtful=bool(len(outside) > max(1, round(0.1 * len(found.rows)))),
    )


def _scores(what: str, error_percent: float, coverage: float) -> list[KeyFigure]:
    return [
        KeyFigure(value=f"{error_percent:.2f} %", text=f"median error of the {what}"),
        KeyFigure(value=f"{100 * coverage:.0f} %", text=f"of the {what}s inside their 95 % intervals"),
    ]


def error_chart(what: str, rows: Sequence[tuple[str, float, Estimate, str]]) -> Chart:
    """Predicted over measured, less 1, in per cent with 95 % intervals, row by row."""
    marks: list[Any] = [Rule(at=0.0, along="x")]
    for kind, (colour, shape) in _KINDS.items():
        mine = [(place, row) for place, row in enumerate(rows) if row[3] == kind]
        if not mine:
            continue
        value, low, high = (
            [100.0 * (getattr(row[2], name) / row[1] - 1.0) for _, row in mine] for name in ("value", "low", "high")
        )
        names = [row[0] for _, row in mine]
        y = [float(place) for place, _ in mine]
        marks.append(
            Points(x=value, y=y, x_ends=(low, high), names=names, colour=colour, shape=shape, label=kind, size_px=8.0)
        )
    return Chart(
        name=f"errors_of_{what}",
        title=f"Error of the {what}",
        alt="Predicted over measured less 1, with 95 % intervals that include the measurement's own noise.",
        marks=marks,
        x_label="predicted over measured - 1, %",
        y_ticks={float(place): row[0] for place, row in enumerate(rows)},
        y_ends=(-0.7, len(rows) - 0.3),
        downwards=True,
        height_px=min(120 + rows_px([row[0] for row in rows]), 1400),
    )


def _comparisons(groups: Mapping[str, Sequence[tuple[str, float, Estimate, str]]]) -> SortedTable:
    rows = [
        (
            what,
            name,
            f"{measured:.5g}",
            f"{predicted.value:.5g} ({predicted.low:.5g} to {predicted.high:.5g})",
            f"{100.0 * (predicted.value / measured - 1.0):+.2f}",
            "yes" if predicted.low <= measured <= predicted.high else "no",
            kind,
        )
        for what, mine in groups.items()
        for name, measured, predicted, kind in mine
    ]
    header = ("quantity", "setting", "measured", "predicted (95 %)", "error, %", "inside", "kind")
    return SortedTable(header=header, rows=tuple(rows), words=frozenset({0, 1, 5, 6}))
