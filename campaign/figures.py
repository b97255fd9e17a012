"""The demo report's figures; each returns a PNG. Matplotlib is imported only here, without touching its global state."""

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..acquisition.dataset_io import read_dataset
from ..diagnosis.judgement.answer import plot_gap_rows
from ..diagnosis.report.explanation import axis_text
from ..errors import RaytwinError
from ..generator.line.twin import Twin
from ..pod.repeats import fit_pod
from .demo_gap import WithheldFrame

# blue, vermilion and grey of Okabe and Ito, "Color universal design" (2008): told apart by colour-blind readers
REAL, GENERATED, PUBLISHED = "#0072b2", "#d55e00", "#7a7a7a"
_DPI = 110


def figure_with_axes(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Any, Any]:
    """A figure of width x height inches and its axes (row, column)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def figure_with_panels(count: int, columns: int, *, width: float, height: float) -> tuple[Any, list[Any]]:
    """A figure of `count` panels, each of width x height inches, in rows of at most `columns`; and its axes in order."""
    columns = min(count, columns)
    lines = -(-count // columns)
    figure, axes = figure_with_axes(width * columns, height * lines, lines, columns)
    for axis in axes.flat[count:]:
        axis.set_axis_off()
    return figure, list(axes.flat[:count])


def png_of(figure: Any) -> bytes:
    """The figure as PNG, the same bytes whenever it is made."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return buffer.getvalue()


def plot_noise_maps(twin: Twin) -> bytes:
    """Gain, electronic variance and dark of each pixel: the paper's figure of noise parameters. PNG."""
    level = twin.levels[0]
    good = twin.maps.bad_pixels == 0
    maps = (
        (level.gain_DN.value * twin.maps.gain_relative, f"gain at {level.name}, DN"),
        (twin.maps.read_variance_DN2, "electronic and rounding variance, DN$^2$"),
        (twin.maps.dark_DN, "dark, DN"),
    )
    figure, axes = figure_with_axes(13, 6.2, 2, 3)
    for column, (values, title) in enumerate(maps):
        low, high = np.percentile(values[good], [1, 99])
        shown = axes[0, column].imshow(values, vmin=low, vmax=high, cmap="viridis", interpolation="nearest")
        figure.colorbar(shown, ax=axes[0, column], shrink=0.8)
        rows, columns = np.nonzero(~good)
        axes[0, column].plot(columns, rows, "rx", markersize=4)
        axes[0, column].set(title=title, xlabel="column, px", ylabel="row, px")
        axes[1, column].hist(values[good], bins=60, color="#446688")
        axes[1, column].set(xlabel=title, ylabel="pixels")
    return png_of(figure)


def plot_photon_transfer(twin: Twin) -> bytes:
    """Variance of one pixel against signal for every flat, with the fitted lines, and the residuals. PNG."""
    figure, axes = figure_with_axes(12, 4.2, 1, 2)
    read = twin.noise.read_variance_DN2
    points = [point for point in twin.evidence["photon_transfer"] if point["signal_DN"] > 0]
    for index, level in enumerate(twin.levels):
        members = [point for point in points if point["series"] in level.series]
        signal = np.array([point["signal_DN"] for point in members])
        variance = np.array([point["pair_variance_DN2"] for point in members])
        slope = level.photon_transfer_slope_DN.value
        colour = f"C{index}"
        line = np.geomspace(signal.min() * 0.8, signal.max() * 1.2, 100)
        axes[0, 0].loglog(line, slope * line + read, color=colour, linewidth=1)
        axes[0, 0].loglog(line, level.gain_DN.value * line + read, color=colour, linewidth=1, linestyle=":")
        axes[0, 0].loglog(signal, variance, "o", color=colour, label=f"{level.name}")
        axes[0, 1].semilogx(signal, 100 * (variance / (slope * signal + read) - 1), "o", color=colour)
    axes[0, 0].axhline(read, color="grey", linewidth=0.8)
    axes[0, 0].set(
        xlabel="signal above dark, DN",
        ylabel="variance, DN$^2$",
        title="photon transfer (dotted: with the blur's share restored)",
    )
    axes[0, 0].legend()
    axes[0, 1].axhline(0, color="grey", linewidth=0.8)
    axes[0, 1].set(xlabel="signal above dark, DN", ylabel="measured over fitted variance - 1, %", title="residuals")
    return png_of(figure)


def plot_validation(rows: Sequence[dict[str, Any]]) -> bytes:
    """Predicted over measured mean and noise of flats that calibration did not see, with 95 % intervals. PNG."""
    figure, axes = figure_with_axes(12, 0.45 * len(rows) + 1.6, 1, 2)
    height = np.arange(len(rows))[::-1]
    for column, (key, title) in enumerate((("mean_DN", "mean"), ("sd_DN", "noise (sd)"))):
        axis = axes[0, column]
        measured = np.array([row[f"measured_{key}"] for row in rows])
        value, low, high = (np.array([row[key][name] for row in rows]) / measured for name in ("value", "low", "high"))
        axis.errorbar(
            100 * (value - 1),
            height,
            xerr=100 * np.array([value - low, high - value]),
            fmt="o",
            color="#335588",
            capsize=3,
        )
        axis.axvline(0, color="grey", linewidth=0.8)
        axis.set(xlabel="predicted over measured - 1, %", title=title, yticks=height)
        axis.set_yticklabels([row["setting"].replace(",", ", ") for row in rows] if column == 0 else [], fontsize=9)
    return png_of(figure)


def plot_examples(directory: Path, exposures: Sequence[float]) -> bytes:
    """One product at low kV: 1 s reference, then measured, generated and as published at each exposure. PNG."""
    with read_dataset(directory / "real_1000ms.h5") as reference:
        contrasts = reference.column("contrast")
        order = np.argsort(np.where(np.isfinite(contrasts), contrasts, -np.inf))
        index = int(order[-max(1, len(order) // 4)])
        name = reference.rows[index].image
        image = reference.images(index)[0]
        mask = reference.foreign_object_masks(index)
        contrast = float(contrasts[index])
        size = reference.rows[index].size_mm
    low, high = float(np.percentile(image, 2)) - 0.1, float(np.percentile(image, 99)) + 0.25
    figure, axes = figure_with_axes(3.3 * len(exposures) + 3.3, 8.2, 3, len(exposures) + 1)
    axes[0, 0].imshow(image, vmin=low, vmax=high, cmap="gray")
    axes[0, 0].contour(mask, [0.5], colors="red", linewidths=0.8)
    axes[0, 0].set_title(f"reference, 1 s; bone of {size:.2g} mm,\ncontrast {contrast:.3f} (outlined)", fontsize=12)
    for axis in axes[1:, 0]:
        axis.axis("off")
    for column, exposure in enumerate(exposures, start=1):
        for row, (kind, title) in enumerate(
            (("real", "measured"), ("test", "generated"), ("published", "as published"))
        ):
            axis = axes[row, column]
            with read_dataset(directory / f"{kind}_{exposure:g}ms.h5") as dataset:
                found = [i for i, one in enumerate(dataset.rows) if name in (one.image, one.image.rpartition("-")[0])]
                axis.imshow(dataset.images(found[0])[0], vmin=low, vmax=high, cmap="gray")
            axis.set_title(f"{title}, {exposure:g} ms", fontsize=12)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    return png_of(figure)


def plot_training(training: dict[str, Any]) -> bytes:
    """Training and validation loss of the shared network and of the networks of every exposure. PNG."""
    from matplotlib.ticker import MaxNLocator

    figure, axes = figure_with_panels(len(training), 3, width=3.6, height=2.9)
    for number, (axis, name) in enumerate(zip(axes, training, strict=True)):
        for index, network in enumerate(training[name]["networks"]):
            losses = network["losses"]
            axis.plot(np.arange(1, len(losses) + 1), losses, color=f"C{index}", linewidth=1)
            axis.plot(network["validation_epochs"], network["validation_losses"], ".--", color=f"C{index}", linewidth=1)
        title = f"{name.removesuffix('ms')} ms" if name.endswith("ms") else name
        axis.set(title=title, xlabel="epoch", ylabel="" if number % 3 else "loss (dashed: validation)")
        axis.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    return png_of(figure)


def plot_pod(hits: dict[str, list[dict[str, str]]], answers: dict[str, Any], exposures: Sequence[float]) -> bytes:
    """POD against contrast: a thin curve a network, a thick one for all; hits and misses as ticks; a90 intervals. PNG."""
    columns = 2 if len(exposures) in (2, 4) else 3
    figure, axes = figure_with_panels(len(exposures), columns, width=10.4 / columns, height=3.8)
    for number, (axis, exposure) in enumerate(zip(axes, exposures, strict=True)):
        for kind, colour, label, offset in (("real", REAL, "measured", 0.0), ("test", GENERATED, "generated", 0.025)):
            name = f"{kind}_{exposure:g}ms"
            if name not in hits:
                continue
            rows = [row for row in hits[name] if row["contrast"] != "" and row["hit"] != ""]
            contrast = np.array([float(row["contrast"]) for row in rows])
            hit = np.array([int(row["hit"]) for row in rows])
            network = np.array([row["network"] for row in rows])
            grid = np.linspace(0.0, float(contrast.max()) * 1.05, 200)
            for one in np.unique(network):
                _curve(
                    axis, grid, contrast[network == one], hit[network == one], color=colour, linewidth=0.7, alpha=0.6
                )
            _curve(axis, grid, contrast, hit, color=colour, linewidth=2.4, label=label)
            axis.plot(
                contrast, np.where(hit > 0, 1.02 + offset, -0.02 - offset), "|", color=colour, markersize=6, alpha=0.5
            )
            answer = answers.get(name, {})
            a90 = answer.get("a90")
            if a90 is not None:
                low = (answer.get("a90_low_two_sided") or {}).get("likelihood_ratio")
                high = (answer.get("a90_95_two_sided") or {}).get("likelihood_ratio")
                axis.plot([a90], [0.9 - offset], "o", color=colour)
                if low is not None and high is not None:
                    axis.plot([low, high], [0.9 - offset] * 2, color=colour, linewidth=1.4)
        axis.axhline(0.9, color="grey", linewidth=0.7, linestyle=":")
        axis.set(title=f"{exposure:g} ms", xlabel="contrast $\\Delta R$", ylim=(-0.1, 1.12))
        if number % columns == 0:
            axis.set_ylabel("probability of detection")
    told: dict[str, Any] = {}
    for axis in axes:
        told |= dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
    if told:
        # of the whole figure: within a panel it would lie on a curve
        figure.legend(told.values(), told, loc="outside upper left", ncols=2, frameon=False, fontsize=9)
    return png_of(figure)


def _curve(axis: Any, grid: Any, contrast: Any, hit: Any, **style: Any) -> None:
    """The cloglog curve of these trials, drawn over the tested range; nothing where it cannot be fitted."""
    try:
        fit = fit_pod(contrast, hit, repeats="pooled")
    except RaytwinError:
        return
    if fit.c0 is None or fit.c1 is None or not (math.isfinite(fit.c0) and math.isfinite(fit.c1)):
        return
    inside = grid <= contrast.max()
    axis.plot(grid[inside], -np.expm1(-np.exp(np.clip(fit.c0 + fit.c1 * grid[inside], -50, 50))), **style)


def plot_a90(table: Sequence[dict[str, Any]]) -> bytes:
    """Contrast at POD 90 % against exposure, measured and generated, with two-sided 95 % intervals. PNG."""
    figure, axes = figure_with_axes(6.4, 4.2)
    axis = axes[0, 0]
    for kind, colour, label, shift in (("real", REAL, "measured", 0.97), ("generated", GENERATED, "generated", 1.03)):
        rows = [(row["exposure_ms"], row[kind]) for row in table if row[kind] and row[kind]["a90"] is not None]
        if not rows:
            continue
        exposure = np.array([one for one, _ in rows]) * shift
        a90 = np.array([entry["a90"] for _, entry in rows])
        below = np.array(
            [a90[i] - (entry["low"] if entry["low"] is not None else a90[i]) for i, (_, entry) in enumerate(rows)]
        )
        above = np.array(
            [(entry["high"] if entry["high"] is not None else a90[i]) - a90[i] for i, (_, entry) in enumerate(rows)]
        )
        axis.errorbar(exposure, a90, yerr=[below, above], fmt="o-", color=colour, capsize=3, label=label)
    axis.set_xscale("log")
    exposures = sorted({float(row["exposure_ms"]) for row in table})
    axis.set_xticks(exposures, [f"{one:g}" for one in exposures])
    axis.minorticks_off()
    axis.set(xlabel="exposure, ms", ylabel="contrast at POD 90 %", title="a90 against exposure")
    if axis.get_legend_handles_labels()[0]:
        axis.legend()
    return png_of(figure)


def plot_gap(diagnosis: Mapping[str, Any]) -> bytes:
    """The gap on data that the fit did not use, before and after the effect was added, by axis; from diagnosis.json. PNG."""
    gap = diagnosis["gap"]
    rows = [("everything", gap["before"], gap["after"], gap["floor"])]
    rows += [(axis_text(one["axis"]), one["before"], one["after"], one["floor"]) for one in diagnosis["held_out"]]
    figure, axes = figure_with_axes(6.4, 0.42 * len(rows) + 1.4)
    axis = plot_gap_rows(rows, ax=axes[0, 0])
    for place, (_, before, after, _) in enumerate(rows):
        for value, height in ((before, place - 0.18), (after, place + 0.18)):
            axis.annotate(
                f"{value:.1f}", (value, height), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8
            )
    axis.set_xlim(0.0, 1.12 * max(max(row[1:]) for row in rows))
    axis.set_xlabel("gap on data not used in the fit (1: noise alone)")
    handles, labels = axis.get_legend_handles_labels()
    words = {"floor": "measured against measured"}
    axis.legend(handles, [words.get(label, label) for label in labels], frameon=False, loc="lower right")
    axis.spines[["top", "right"]].set_visible(False)
    return png_of(figure)


def plot_withheld(frames: Sequence[WithheldFrame]) -> bytes:
    """Withheld products at their longest exposure: measured, and measured over expected before and after. PNG."""
    longest = max(frame.exposure_ms for frame in frames)
    first = next(frame.series for frame in frames if frame.exposure_ms == longest).split("_")[0]
    shown = [frame for frame in frames if frame.exposure_ms == longest and frame.series.split("_")[0] == first]
    figure, axes = figure_with_axes(8.4, 2.75 * len(shown), len(shown), 3)
    departures = [
        [100.0 * (frame.measured_DN / expected - 1.0) for expected in (frame.before_DN, frame.after_DN)]
        for frame in shown
    ]
    limit = max(
        float(np.percentile(np.abs(one[frame.inside]), 95)) for frame, (one, _) in zip(shown, departures, strict=True)
    )
    for row, (frame, both) in enumerate(zip(shown, departures, strict=True)):
        axes[row, 0].imshow(frame.measured_DN, cmap="gray", vmin=float(np.percentile(frame.measured_DN, 2)) * 0.9)
        axes[row, 0].set_ylabel(f"{frame.kV:g} kV, {frame.exposure_ms:g} ms")
        for axis, departure in zip(axes[row, 1:], both, strict=True):
            image = axis.imshow(np.where(frame.inside, departure, np.nan), cmap="RdBu_r", vmin=-limit, vmax=limit)
    for axis, title in zip(
        axes[0], ("measured", "measured over twin, before", "measured over twin, after"), strict=True
    ):
        axis.set_title(title, fontsize=11)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    figure.colorbar(image, ax=axes, shrink=0.7, label="measured over expected - 1, %")
    return png_of(figure)
