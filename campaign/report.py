"""The demo's results as one self-contained HTML page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..generator.line.twin import Twin
from ..generator.twins.twin_io import read_twin
from ..reports import write_page
from .demo import read_hits
from .demo_gap import answer_text, withheld_frames, withheld_rows, withheld_text
from .figures import demo_figures

_DASH = "–"
_SHARED_NAMES = {"first": "1 s and the longest exposure (first)", "shared": "all exposures (shared start)"}


def write_report(result: Mapping[str, Any], directory: Path, *, version: str) -> Path:
    """Write DIR/report.html from the result of `run_demo` and the files it left in DIR; returns its path."""
    from markupsafe import Markup

    twin = read_twin(directory / "twin.h5")
    exposures = [row["exposure_ms"] for row in result["a90_table"]]
    hits = {path.stem.removeprefix("hits_"): read_hits(path) for path in sorted(directory.glob("hits_*.csv"))}
    withheld = withheld_frames(directory, seed=result["plan"]["seed"])
    chapters = demo_figures(directory, result, twin=twin, hits=hits, withheld=withheld)
    return write_page(
        directory / "report.html",
        Path(__file__).parent / "report.html",
        figures={f"{name}_{place}": one for name, several in chapters.items() for place, one in enumerate(several)},
        chapters={name: [f"{name}_{place}" for place in range(len(several))] for name, several in chapters.items()},
        version=version,
        plan=result["plan"],
        summary=summary_text(result),
        table=[_table_row(row) for row in result["a90_table"]],
        pod_notes=_pod_notes(result["a90_table"]),
        missing=missing_a90(result["a90_table"], hits),
        key_figures=_key_figures(result),
        gap_answer=answer_text(result["gap"]),
        withheld_text=withheld_text(withheld),
        withheld_rows=withheld_rows(withheld),
        next_measurement=(result["gap"]["diagnosis"].get("next_measurement") or {}).get("text", ""),
        truth_rows=truth_rows(result["calibration"], result["truth"], twin),
        validation_text=_validation_text(result["validation"]),
        noise_rows=_noise_rows(result["noise"], exposures),
        network_rows=_network_rows(result["training"], hits),
        limits=[Markup(line) for line in _limits(result)],  # written below, with commands as code
        commands=result["commands"],
        total_seconds=f"{sum(command['seconds'] for command in result['commands']):.0f}",
        warnings=result["calibration"]["warnings"],
    )


def _number(value: float | None, digits: int = 3) -> str:
    return _DASH if value is None else f"{value:.{digits}f}"


def _bounds(low: float | None, high: float | None) -> str:
    """A 95 % interval, or the bound that there is."""
    if low is None or high is None:
        known = [f"{word} {value:.3f}" for word, value in (("from", low), ("up to", high)) if value is not None]
        return known[0] if known else "no bounds"
    return f"{low:.3f} to {high:.3f}"


def _interval(entry: Mapping[str, Any] | None) -> str:
    if not entry or entry["a90"] is None:
        return _DASH
    return f"{_number(entry['a90'])} ({_bounds(entry['low'], entry['high'])})"


def _difference(compare: Mapping[str, Any] | None) -> str:
    difference = (compare or {}).get("difference_a90") or {}
    if difference.get("value") is None:
        return _DASH
    return f"{difference['value']:+.3f} ({_bounds(difference.get('low'), difference.get('high'))})"


def _table_row(row: Mapping[str, Any]) -> dict[str, str]:
    def hits(entry: Mapping[str, Any] | None) -> str:
        return _DASH if not entry or entry.get("n") is None else f"{entry['n_hits']} of {entry['n']}"

    return {
        "exposure": f"{row['exposure_ms']:g}",
        "generated": _interval(row["generated"]),
        "real": _interval(row["real"]),
        "difference": _difference(row["compare"]),
        "hits_generated": hits(row["generated"]),
        "hits_real": hits(row["real"]),
    }


def _pod_notes(table: Sequence[Mapping[str, Any]]) -> list[str]:
    """The curves' warnings, each once, with the curves it belongs to."""
    where: dict[str, list[str]] = {}
    for row in table:
        for kind, label in (("real", "measured"), ("generated", "generated")):
            for line in (row[kind] or {}).get("warnings", []):
                where.setdefault(line, []).append(f"{row['exposure_ms']:g} ms {label}")
    return [f"{', '.join(curves)}: {line}" for line, curves in where.items()]


def missing_a90(table: Sequence[Mapping[str, Any]], hits: Mapping[str, list[dict[str, str]]]) -> list[str]:
    """What the data would need for each a90 that they do not support."""
    lines = []
    for row in table:
        for kind, label, name in (("real", "measured", "real"), ("generated", "generated", "test")):
            entry = row[kind]
            if entry is None or entry["a90"] is not None:
                continue
            looks = [one for one in hits.get(f"{name}_{row['exposure_ms']:g}ms", []) if one["contrast"] and one["hit"]]
            if looks:
                lines.append(f"{row['exposure_ms']:g} ms, {label}: {_needed(looks)}")
    return lines


def _needed(looks: Sequence[Mapping[str, str]]) -> str:
    """What an a90 would take, judged by the looks at the least and the most contrast."""
    ordered = sorted((float(one["contrast"]), int(one["hit"])) for one in looks)
    quarter = max(1, len(ordered) // 4)
    least, most = ordered[:quarter], ordered[-quarter:]
    found = sum(hit for _, hit in most)
    if found < 0.9 * quarter:
        return (
            f"of the quarter with most contrast ({most[0][0]:.3f} to {most[-1][0]:.3f}) {found} of {quarter} were found; an a90"
            " needs objects of more contrast (thicker bones), or a longer exposure"
        )
    found = sum(hit for _, hit in least)
    if found >= 0.9 * quarter:
        return (
            f"of the quarter with least contrast ({least[0][0]:.3f} to {least[-1][0]:.3f}) {found} of {quarter} were found; an a90"
            " needs objects of less contrast (thinner bones)"
        )
    missed = [contrast for contrast, hit in ordered if not hit]
    return (
        f"{len(ordered) - len(missed)} of {len(ordered)} were found, and the misses lie at contrasts of {missed[0]:.3f} to"
        f" {missed[-1]:.3f}; an a90 needs more objects there"
    )


def _key_figures(result: Mapping[str, Any]) -> list[dict[str, str]]:
    """The page's answers at a glance: figure and what it is."""
    error = result["validation"]["median_abs_error_percent"]
    figures = [
        {
            "value": f"{error['mean']:.2f} %",
            "text": f"median error of the predicted signal at settings that the twin never saw (noise: {error['sd']:.2f} %)",
        }
    ]
    for row in result["a90_table"]:
        generated, real = row["generated"], row["real"]
        if generated and real and generated["a90"] is not None and real["a90"] is not None:
            figures.append(
                {
                    "value": f"{generated['a90']:.3f} | {real['a90']:.3f}",
                    "text": f"contrast found nine times in ten at {row['exposure_ms']:g} ms: generated | measured test images",
                }
            )
    gap = result["gap"]["diagnosis"]["gap"]
    figures.append(
        {
            "value": f"{gap['before']:.1f} → {gap['after']:.1f}",
            "text": "gap between line and twin, before and after the diagnosis added what was missing "
            f"(noise alone: {gap['floor']:.1f})",
        }
    )
    return figures


def summary_text(result: Mapping[str, Any]) -> str:
    """One paragraph: what was found, in plain words."""
    table = result["a90_table"]
    pairs = [
        (row["exposure_ms"], _interval(row["generated"]), _interval(row["real"]))
        for row in table
        if row["generated"] and row["real"] and row["generated"]["a90"] is not None and row["real"]["a90"] is not None
    ]
    error = result["validation"]["median_abs_error_percent"]
    rows = result["validation"]["coverage"]["rows"]
    text = (
        f"Calibrated from flats at two tube voltages behind one filter, the twin predicts the mean of {rows} flats at settings"
        f" it never saw to {error['mean']:.2g} % and their noise to {error['sd']:.2g} % (median)."
    )
    if pairs:
        parts = [
            f"{generated} generated against {real} measured at {exposure:g} ms" for exposure, generated, real in pairs
        ]
        text += (
            " Networks trained on generated images reach a POD of 90 % at a contrast (95 %) of "
            + "; ".join(parts)
            + "."
        )
    missing = [f"{row['exposure_ms']:g} ms" for row in table if row["real"] and row["real"]["a90"] is None]
    if missing:
        text += f" At {', '.join(missing)} the measured test set does not support an a90."
    return text


def truth_rows(calibration: Mapping[str, Any], truth: Mapping[str, Any], twin: Twin) -> list[dict[str, str]]:
    """Calibrated values beside the lab's truth."""
    rows = []

    def add(name: str, estimate: Mapping[str, float] | None, true: float | None, unit: str) -> None:
        if estimate is None or true is None:
            return
        rows.append(
            {
                "name": f"{name}, {unit}" if unit else name,
                "found": f"{estimate['value']:.4g} ({estimate['low']:.4g} to {estimate['high']:.4g})",
                "truth": f"{true:.4g}",
                "error": f"{100 * (estimate['value'] / true - 1):+.2f} %",
            }
        )

    exposure = twin.maps.dark_exposure_ms
    dark = next((item["dark_DN"] for item in truth["dark_DN_at"] if item["exposure_ms"] == exposure), truth["dark_DN"])
    add("optical spread", calibration["psf_sigma_px"], truth["psf_sigma_px"], "px")
    add("read noise", calibration["read_noise_DN"], truth["read_noise_DN"], "DN")
    add(f"dark at {exposure:g} ms" if exposure else "dark", calibration["dark_DN"], dark, "DN")
    for level in calibration["levels"]:
        true = next(
            (item for item in truth["levels"] if item["kV"] == level["kV"] and item["filter"] == level["filter"]), None
        )
        if true is not None:
            name = f"gain at {level['kV']:g} kV, {level['filter']}"
            found = {"value": level["gain_DN"], "low": level["gain_DN_low"], "high": level["gain_DN_high"]}
            add(name, found, true["gain_DN"], "DN")
    add("inherent filtration", calibration["inherent_filtration_mm_Al"], truth["inherent_filtration_mm_Al"], "mm Al")
    add("flux over the spectrum model's", calibration["flux_scale"], truth.get("flux_scale"), "")
    return rows


def _validation_text(validation: Mapping[str, Any]) -> str:
    error, coverage = validation["median_abs_error_percent"], validation["coverage"]
    return (
        f"{coverage['rows']} flat series at other tube voltages, filters, powers and exposures were held back. Median error"
        f" {error['mean']:.2f} % in the mean and {error['sd']:.2f} % in the noise; {100 * coverage['mean']:.0f} % of the means and"
        f" {100 * coverage['sd']:.0f} % of the noise levels lie inside their 95 % intervals."
    )


def _noise_rows(noise: Mapping[str, Any], exposures: Sequence[float]) -> list[dict[str, Any]]:
    rows = []
    for exposure in exposures:
        entry = noise.get(f"{exposure:g}ms")
        if entry is None:
            continue
        for channel, name in enumerate(("low kV", "high kV")):
            rows.append(
                {
                    "name": f"{exposure:g} ms, {name}",
                    "noise": [f"{entry[kind]['rms'][channel]:.4f}" for kind in ("real", "raytwin", "as_published")],
                    "correlation": [
                        f"{entry[kind]['neighbour_correlation'][channel]:.3f}"
                        for kind in ("real", "raytwin", "as_published")
                    ],
                }
            )
    return rows


def _percent(value: float | None) -> str:
    return _DASH if value is None else f"{100 * value:.0f} %"


def _network_rows(training: Mapping[str, Any], hits: Mapping[str, list[dict[str, str]]]) -> list[dict[str, str]]:
    rows = []
    for name, answer in training.items():
        table = hits.get(f"real_{name}", [])
        for network in answer["networks"]:
            own = [row for row in table if row["network"] == str(network["network"])]
            found = [int(row["hit"]) for row in own if row["contrast"] != "" and row["hit"] != ""]
            alarms = [int(row["false_alarm"]) for row in own if row["contrast"] == "" and row["false_alarm"] != ""]
            rows.append(
                {
                    "name": _SHARED_NAMES.get(name) or name.replace("ms", " ms"),
                    "network": str(network["network"]),
                    "epoch": str(network["best_epoch"]),
                    "hit_rate": _percent(network["validation_hit_rate"]),
                    "false_alarm": _percent(network["validation_false_alarm_rate"]),
                    "test_hit": f"{sum(found)} of {len(found)}" if found else _DASH,
                    "test_false": f"{sum(alarms)} of {len(alarms)}" if alarms else _DASH,
                }
            )
    return rows


def _limits(result: Mapping[str, Any]) -> list[str]:
    plan = result["plan"]
    return [
        f"{plan['networks']} networks on {plan['test_products']} images give wide intervals; the paper trained 100 and tested on 82."
        " <code>raytwin demo --paper-size</code> does that, in days on a CPU.",
        "The test set holds few products without a bone (the last column of the networks' table counts them): it says little of"
        " false alarms.",
        "The line of the POD curves has no scatter, lag, glare or drift. Scatter is planted in the last chapter alone, on a bench"
        " with smaller frames; the POD curves were not made again with it.",
        "The withheld products' thickness is known to 0.7 % a layer, as on a real bench: that, not noise, limits the brightness"
        " in the last table.",
        f"Products are {plan['size'][0]} x {plan['size'][1]} pixels of {plan['pixel_mm']} mm, coarser than the paper's,"
        " with the detector nearer than its photon numbers would have it: the contrasts are not those of the paper's line.",
        "The networks of all exposures start from one "
        + ("that comes with raytwin" if plan["start"] == "starter" else "shared network")
        + ", so they are less independent than networks from scratch.",
    ]
