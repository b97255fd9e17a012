"""The demo's figures: charts and pictures of its page."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..acquisition.dataset_io import read_dataset
from ..diagnosis.report.figures import gap_chart
from ..errors import RaytwinError
from ..generator.line.twin import Estimate, Twin
from ..pod.repeats import fit_pod
from ..reports import AFTER, BEFORE, Chart, Figure, Line, Picture, Points, Rule
from ..reports.chart import SERIES_COLOURS, Shape
from .demo_gap import WithheldFrame
from .pod_page import a90_chart
from .twin_page import error_chart, gain_picture, map_pictures, photon_transfer_charts

# kind of test images, as files and as the table name them, and how they are drawn
_KINDS: tuple[tuple[str, str, str, str, Shape], ...] = (
    ("real", "real", "measured", AFTER, "circle"),
    ("test", "generated", "generated", BEFORE, "square"),
)
_TICK_SHIFT = 0.025  # of the misses and hits of one kind beside the other's


def demo_figures(
    directory: Path,
    result: Mapping[str, Any],
    *,
    twin: Twin,
    hits: Mapping[str, Sequence[Mapping[str, str]]],
    withheld: Sequence[WithheldFrame],
) -> dict[str, list[Figure]]:
    """All figures of the page, by its chapters.

    Args:
        directory: of the demo.
        result: what `run_demo` gave.
        twin: calibrated.
        hits: rows of the tables of hits, by the name of the test set.
        withheld: products of another day.
    """
    exposures = [row["exposure_ms"] for row in result["a90_table"]]
    shorter = [exposure for exposure in exposures if exposure != max(exposures)]
    examples: list[Figure] = list(example_pictures(directory, shorter, reference_ms=max(exposures)))
    return {
        "a90": [exposures_chart(result["a90_table"])],
        "pod": [pod_chart(hits, result["pod"], exposure) for exposure in exposures],
        "maps": [gain_picture(twin), *map_pictures(twin), *photon_transfer_charts(twin)],
        "validation": list(validation_charts(result["validation"]["rows"])),
        "reference": examples[:1],
        "examples": examples[1:],
        "training": [training_chart(name, entry["networks"]) for name, entry in result["training"].items()],
        "gap": [gap_chart(gap_parts(result["gap"]["diagnosis"]), added=True)],
        "withheld": list(withheld_pictures(withheld)),
    }


def gap_parts(diagnosis: Mapping[str, Any]) -> list[tuple[str, float, float, float]]:
    """The gap as a whole and by axis, before, after and floor, from diagnosis.json."""
    parts = [{"axis": "all", **diagnosis["gap"]}, *diagnosis["held_out"]]
    return [(one["axis"], one["before"], one["after"], one["floor"]) for one in parts]


def exposures_chart(table: Sequence[Mapping[str, Any]]) -> Chart:
    """Contrast at POD 90 % against exposure, measured and generated, with two-sided 95 % intervals."""
    kinds = []
    for _, key, label, colour, shape in _KINDS:
        known = {row["exposure_ms"]: row[key] for row in table if row[key] and row[key]["a90"] is not None}
        found = {
            exposure: (one["a90"], *(one["a90"] if one[end] is None else one[end] for end in ("low", "high")))
            for exposure, one in known.items()
        }
        kinds.append((label, colour, shape, found))
    return a90_chart(kinds)


def pod_chart(hits: Mapping[str, Sequence[Mapping[str, str]]], answers: Mapping[str, Any], exposure_ms: float) -> Chart:
    """POD against contrast at an exposure: a thin curve a network, a thick one for all, a90; hits above and misses below."""
    marks: list[Any] = [Rule(at=0.9)]
    for place, (kind, _, label, colour, shape) in enumerate(_KINDS):
        name = f"{kind}_{exposure_ms:g}ms"
        rows = [row for row in hits.get(name, ()) if row["contrast"] != "" and row["hit"] != ""]
        if not rows:
            continue
        contrast = np.array([float(row["contrast"]) for row in rows])
        hit = np.array([int(row["hit"]) for row in rows])
        network = np.array([row["network"] for row in rows])
        for one in np.unique(network):
            marks += _curve(contrast[network == one], hit[network == one], colour=colour, thin=True)
        marks += _curve(contrast, hit, colour=colour, label=label, dashed=place > 0)
        shift = place * _TICK_SHIFT
        y = np.where(hit > 0, 1.02 + shift, -0.02 - shift)
        marks.append(Points(x=contrast, y=y, names=list(map(str, network)), colour=colour, shape=shape, size_px=3.0))
        answer = answers.get(name, {})
        if answer.get("a90") is not None:
            low = (answer.get("a90_low_two_sided") or {}).get("likelihood_ratio")
            high = (answer.get("a90_95_two_sided") or {}).get("likelihood_ratio")
            ends = None if low is None or high is None else ([low], [high])
            marks.append(
                Points(x=[answer["a90"]], y=[0.9 - shift], x_ends=ends, names=["a90"], colour=colour, shape=shape)
            )
    return Chart(
        name=f"pod_{exposure_ms:g}ms",
        title=f"{exposure_ms:g} ms",
        alt="POD against contrast. Thin: one network each. Above and below: objects found and missed. On the line of 90 %: a90.",
        marks=marks,
        x_label="contrast ΔR",
        y_label="probability of detection",
        y_ends=(-0.1, 1.12),
    )


def _curve(contrast: np.ndarray, hit: np.ndarray, **style: Any) -> list[Line]:
    """The cloglog curve of these trials over the tested range; none where it cannot be fitted."""
    try:
        fit = fit_pod(contrast, hit, repeats="pooled")
    except RaytwinError:
        return []
    if fit.c0 is None or fit.c1 is None or not (math.isfinite(fit.c0) and math.isfinite(fit.c1)):
        return []
    x = np.linspace(0.0, float(contrast.max()), 120)
    return [Line(x=x, y=-np.expm1(-np.exp(np.clip(fit.c0 + fit.c1 * x, -50, 50))), **style)]


def _short(setting: str) -> str:
    """A setting by its numbers: `60 kV, 40 W, 20 ms, Cu:0.05`."""
    units = {"kv": " kV", "power_w": " W", "current_ma": " mA", "exposure_ms": " ms"}
    parts = (part.partition("=") for part in setting.split(","))
    return ", ".join(f"{value}{units.get(name.strip().lower(), '')}" for name, _, value in parts)


def validation_charts(rows: Sequence[Mapping[str, Any]]) -> tuple[Chart, ...]:
    """Predicted over measured mean and noise of flats that calibration did not see, with 95 % intervals."""
    return tuple(
        error_chart(
            title,
            [(_short(str(row["setting"])), row[f"measured_{key}"], Estimate(**row[key]), "not seen") for row in rows],
        )
        for key, title in (("mean_DN", "mean"), ("sd_DN", "noise"))
    )


def example_pictures(directory: Path, exposures: Sequence[float], *, reference_ms: float) -> tuple[Picture, ...]:
    """One product at low kV: the reference, then measured, generated and as published at each exposure."""
    with read_dataset(directory / f"real_{reference_ms:g}ms.h5") as reference:
        contrasts = reference.column("contrast")
        order = np.argsort(np.where(np.isfinite(contrasts), contrasts, -np.inf))
        index = int(order[-max(1, len(order) // 4)])
        name, size = reference.rows[index].image, reference.rows[index].size_mm
        image, mask = reference.images(index)[0], reference.foreign_object_masks(index)
    ends = float(np.percentile(image, 2)) - 0.1, float(np.percentile(image, 99)) + 0.25

    def picture(key: str, title: str, values: np.ndarray, alt: str, outline: np.ndarray | None = None) -> Picture:
        return Picture(
            name=key,
            title=title,
            alt=alt,
            values=np.asarray(values, np.float64),
            label="-log(I / I0)",
            ends=ends,
            grey=True,
            outline=outline,
            height_px=290,
        )

    told = f"A bone of {size:.2g} mm with a contrast of {contrasts[index]:.3f}, outlined."
    found = [picture("example_reference", f"reference, {reference_ms:g} ms", image, told, np.asarray(mask, bool))]
    for exposure in exposures:
        for kind, title in (("real", "measured"), ("test", "generated"), ("published", "as published")):
            with read_dataset(directory / f"{kind}_{exposure:g}ms.h5") as dataset:
                own = next(i for i, row in enumerate(dataset.rows) if name in (row.image, row.image.rpartition("-")[0]))
                values = dataset.images(own)[0]
            found.append(
                picture(f"example_{kind}_{exposure:g}ms", f"{title}, {exposure:g} ms", values, "The same product.")
            )
    return tuple(found)


def training_chart(name: str, networks: Sequence[Mapping[str, Any]]) -> Chart:
    """Training and validation loss of the networks of one exposure."""
    marks: list[Any] = []
    for index, network in enumerate(networks):
        colour = SERIES_COLOURS[index % len(SERIES_COLOURS)]
        losses = network["losses"]
        marks += [
            Line(x=np.arange(1, len(losses) + 1), y=losses, colour=colour, label=f"network {index + 1}"),
            Line(x=network["validation_epochs"], y=network["validation_losses"], colour=colour, dashed=True),
        ]
    title = f"{name.removesuffix('ms')} ms" if name.endswith("ms") else name
    return Chart(
        name=f"training_{name}",
        title=title,
        alt="Loss over epochs; dashed: on the validation split.",
        marks=marks,
        x_label="epoch",
        y_label="loss",
    )


def withheld_pictures(frames: Sequence[WithheldFrame]) -> tuple[Picture, ...]:
    """A withheld product at its longest exposure: measured, and measured over expected before and after."""
    longest = max(frame.exposure_ms for frame in frames)
    first = next(frame.series for frame in frames if frame.exposure_ms == longest).split("_")[0]
    shown = [frame for frame in frames if frame.exposure_ms == longest and frame.series.split("_")[0] == first]
    both = [
        [100.0 * (frame.measured_DN / expected - 1.0) for expected in (frame.before_DN, frame.after_DN)]
        for frame in shown
    ]
    limit = max(
        float(np.percentile(np.abs(one[frame.inside]), 95)) for frame, (one, _) in zip(shown, both, strict=True)
    )
    found = []
    for frame, (before, after) in zip(shown, both, strict=True):
        where = f"{frame.kV:g} kV, {frame.exposure_ms:g} ms"
        brightness = float(np.percentile(frame.measured_DN, 2)) * 0.9, float(frame.measured_DN.max())
        found.append(
            Picture(
                name=f"withheld_{frame.series}",
                title=f"measured, {where}",
                alt="Mean frame above dark.",
                values=frame.measured_DN,
                label="DN",
                ends=brightness,
                grey=True,
                height_px=290,
            )
        )
        for word, departure in (("before", before), ("after", after)):
            found.append(
                Picture(
                    name=f"withheld_{frame.series}_{word}",
                    title=f"measured over twin, {word}",
                    alt="Pixels at steep edges, where a shift of a fraction of a pixel decides, are left out, as are dead ones.",
                    values=np.where(frame.inside, departure, np.nan),
                    label="measured over expected - 1, %",
                    ends=(-limit, limit),
                    height_px=290,
                )
            )
    return tuple(found)
