"""The gallery of effects: a page from the catalogue, each entry with a picture that the forward model draws.

The line is the shipped twin of the virtual lab with finer pixels and a larger magnification, so that blur shows. Of a few
series (dark, flats, objects, beam off) the one that the effect changes most is drawn.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

FRAMES = 16
PIXEL_MM, SOURCE_OBJECT_MM, SOURCE_DETECTOR_MM = 0.15, 300.0, 450.0
STAGE = {
    "beam": "in the beam, before the object is projected",
    "arrivals": "on the field that reaches the scintillator",
    "object_blur": "on the picture of the object; noise follows the light, pixel by pixel",
    "quanta": "on the statistics of the photons",
    "optics": "on the spread of light in the detector: picture and noise",
    "exposure": "on the exposure as a whole",
    "lag": "from one exposure to the next",
    "response": "on the response of the pixels",
    "electronics": "in the readout electronics, with or without beam",
    "readout": "in the ADC and in single pixels",
}


def example_scene(shape: tuple[int, int]) -> dict[str, np.ndarray]:
    """Path lengths, mm: a dome of chicken breast with a bone, a slanted tungsten plate and a tungsten disc."""
    row, column = (axis.astype(float) for axis in np.mgrid[: shape[0], : shape[1]])
    size = shape[0]
    dome = 1.0 - ((row - 0.58 * size) / (0.36 * size)) ** 2 - ((column - 0.42 * size) / (0.34 * size)) ** 2
    plate = np.clip(column - 0.80 * size - 0.08 * (row - size / 2), 0.0, 1.0)
    disc = np.clip(0.09 * size - np.hypot(row - 0.13 * size, column - 0.35 * size) + 0.5, 0.0, 1.0)
    bone = np.clip(2.5 - np.abs(row - 0.55 * size - 0.25 * (column - 0.4 * size)), 0.0, 2.0) * (
        np.abs(column - 0.4 * size) < 0.16 * size
    )
    return {
        "chicken_breast": 25.0 * np.sqrt(np.clip(dome, 0.0, None)),
        "bone_cortical_icru44": bone * (dome > 0.1),
        "W": 2.0 * np.maximum(plate, disc),
    }


def example_line() -> Any:
    """The shipped twin as a line with pixels of 0.15 mm and a magnification of 1.5."""
    from raytwin import read_twin

    twin = read_twin("virtual_lab")
    instrument = replace(
        twin.instrument, pixel_mm=PIXEL_MM, source_object_mm=SOURCE_OBJECT_MM, source_detector_mm=SOURCE_DETECTOR_MM
    )
    return replace(twin, instrument=instrument, effects=())


def as_counter(twin: Any) -> Any:
    """The line with a counter that counts from 20 keV on; a count is what 40 keV were."""
    from raytwin.generator.line.spectral_signal import THRESHOLD, SpectralModel
    from raytwin.generator.line.twin_spectrum import spectral_posterior_of

    known = spectral_posterior_of(twin)
    model = SpectralModel(
        filter_materials=("Al", "Cu"), scintillator=known.scintillator, cover=known.cover, counting=True
    )
    values = {**dict(zip(known.names, known.best, strict=True)), THRESHOLD: 20.0}
    values["log_DN_per_keV"] += math.log(40.0)
    best = np.array([values.get(name, 0.0) for name in model.names])
    spectral = replace(known, names=model.names, best=best, samples=best[None], counting=True)
    return replace(twin, instrument=replace(twin.instrument, counting=True), spectral=spectral)


def example_series(shape: tuple[int, int]) -> dict[str, Any]:
    """Series in which an effect may show, in words -> request."""
    from raytwin.acquisition.setting import setting_from_text
    from raytwin.generator.line.series_request import SeriesRequest

    common = {"frames": FRAMES, "frame_interval_ms": 60.0, "start_s": 540.0, "index": 9}
    settings = {
        kV: setting_from_text(
            f"kv={kV},power_w={power_W},exposure_ms=50,filter=Cu:0.05,source_detector_mm={SOURCE_DETECTOR_MM:g}"
        )
        for kV, power_W in ((40, 8), (90, 1.5))
    }
    scene = {
        "thickness_mm": example_scene(shape),
        "product_material": "chicken_breast",
        "scene_kind": "product",
        "belt_speed_mm_s": 10.0,
        "source_object_mm": SOURCE_OBJECT_MM,
        "source_detector_mm": SOURCE_DETECTOR_MM,
    }
    lit = {
        kV: SeriesRequest(kind="flat", setting=setting, exposure_ms=50.0, **common) for kV, setting in settings.items()
    }
    objects = {
        kV: SeriesRequest(kind="object", setting=setting, exposure_ms=50.0, **common, **scene)
        for kV, setting in settings.items()
    }
    before = replace(objects[90], start_s=540.0 - 0.06 * FRAMES, index=8)
    return {
        "darks of 50 ms": SeriesRequest(kind="dark", setting=None, exposure_ms=50.0, **common),
        "flats at 40 kV": lit[40],
        "flats at 90 kV": lit[90],
        "a product with bone, a plate and a disc at 40 kV": objects[40],
        "a product with bone, a plate and a disc at 90 kV": objects[90],
        "frames with the beam off after a product": SeriesRequest(
            kind="afterglow", setting=None, exposure_ms=50.0, previous=(before,), **common
        ),
    }


def drawn_strength(effect: Any) -> float:
    """The strength of the pictures: between the usual one and the upper end of the range, to two digits."""
    return float(f"{math.sqrt(effect.strength.default * effect.strength.high):.2g}")


def applied(effect: Any) -> Any:
    """An effect of some strength, set in after the calibration."""
    from raytwin.generator.effects import AppliedEffect

    return AppliedEffect(id=effect.id, parameters={"strength": drawn_strength(effect)}, since="calibration")


def sampled(twin: Any, request: Any, effects: tuple[Any, ...]) -> np.ndarray:
    """Frames (frame, row, column), DN; the same random numbers with and without effects."""
    from raytwin.generator.frames.line_model import LineModel

    frames = LineModel(twin, effects=effects).sample(request, rng=np.random.default_rng(7))
    return np.stack(list(frames)).astype(float)


def without_effects(twin: Any, series: dict[str, Any]) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Frames, expected mean and standard deviation of a pixel of each series of the line without effects."""
    from raytwin.generator.frames.line_model import LineModel

    found = {}
    for words, request in series.items():
        usual = LineModel(twin, effects=()).expect(request)
        sd = np.sqrt(usual.quantum_variance_DN2 + usual.white_variance_DN2) * np.ones(usual.mean_DN.shape)
        found[words] = (sampled(twin, request, ()), usual.mean_DN, sd)
    return found


def signature(
    twin: Any, series: dict[str, Any], usual: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]], effect: Any
) -> tuple[str, dict[str, Any]]:
    """The series that an effect changes most, and what its frames hold with and without the effect.

    Every series is measured by what the effect adds to the mean squared map, in standard deviations of a mean of the
    frames, and by the change of the variance of frame differences; the larger of the two counts.
    """
    best: tuple[float, str, dict[str, Any]] | None = None
    for words, request in series.items():
        before, mean, sd = usual[words]
        frames = [before, sampled(twin, request, (applied(effect),))]
        maps = [(stack.mean(0) - mean) / (sd / math.sqrt(FRAMES)) for stack in frames]
        differences = [np.diff(stack, axis=0)[::2] / (math.sqrt(2.0) * sd) for stack in frames]
        of_mean = math.sqrt(max(float(np.mean(maps[1] ** 2) - np.mean(maps[0] ** 2)), 0.0))
        of_noise = abs(float(np.log(np.var(differences[1]) / np.var(differences[0]))))
        score = max(of_mean, of_noise)
        if best is None or score > best[0]:
            steps = [np.diff(stack, axis=0)[::2].ravel() for stack in frames]
            best = (score, words, {"maps": maps, "steps": steps, "frame": frames[1][-1]})
    assert best is not None
    return best[1], best[2]


def draw(found: dict[str, Any], path: Path) -> None:
    """Frame, means with and without the effect, and the histogram of frame differences."""
    from matplotlib import pyplot
    from matplotlib.colors import SymLogNorm

    with pyplot.rc_context({"font.size": 8, "axes.titlesize": 8}):
        figure, axes = pyplot.subplots(1, 4, figsize=(9.6, 2.5), layout="constrained", width_ratios=(1, 1, 1, 1.25))
        low, high = np.percentile(found["frame"], (0.5, 99.5))
        axes[0].imshow(found["frame"], cmap="gray", vmin=low, vmax=max(high, low + 1.0))
        axes[0].set_title("one frame, with")
        limit = float(np.clip(np.percentile(np.abs(found["maps"][1]), 99.5), 4.0, 1000.0))
        scale = SymLogNorm(linthresh=3.0, linscale=1.0, vmin=-limit, vmax=limit)
        for axis, values, title in zip(axes[1:3], found["maps"], ("mean, without", "mean, with"), strict=True):
            image = axis.imshow(values, cmap="RdBu_r", norm=scale)
            axis.set_title(title)
        ticks = sorted({sign * value for value in (0, 3, 10, 100, 1000) if value <= limit for sign in (-1, 1)})
        figure.colorbar(image, ax=axes[2], label="sd of the mean", shrink=0.9, ticks=ticks, format="%g")
        for axis in axes[:3]:
            axis.set_xticks([])
            axis.set_yticks([])
        reach = float(np.percentile(np.abs(np.concatenate(found["steps"])), 99.9))
        width = max(1.0, round(reach / 60.0))
        edges = np.arange(-reach - width / 2, reach + width, width)
        for values, label, color in zip(found["steps"], ("without", "with"), ("0.55", "C3"), strict=True):
            axes[3].hist(values, bins=edges, histtype="step", color=color, label=label, log=True)
        axes[3].set_title("pixels of frame differences")
        axes[3].set_xlabel("difference of successive frames / DN")
        axes[3].legend(frameon=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
        pyplot.close(figure)


def parameter_rows(effect: Any) -> str:
    """Parameters with units and ranges, as a table."""
    rows = ["| parameter | unit | plausible range | usual | meaning or source of the range |", "|---|---|---|---|---|"]
    for item in effect.parameters:
        about = f"{item.low:g} to {item.high:g}" if item.fitted else "stated by the session"
        usual = f"{item.default:g}" if item.fitted else ""
        if item.signed:
            about += ", either sign"
        rows.append(f"| `{item.name}` | {item.unit} | {about} | {usual} | {item.source} |")
    return "\n".join(rows)


def overview_row(effect: Any) -> str:
    """An effect in the table at the top of the page."""
    strength = effect.strength
    link = f"[`{effect.id}`](#effect-{effect.id})"
    return f"| {link} | {effect.title} | {strength.unit} | {strength.low:g} to {strength.high:g} |"


def effects_page(folder: Path) -> None:
    """Write the gallery's page and figures."""
    from raytwin_pages import write_if_changed

    from raytwin.generator.effects import EFFECTS

    twin = example_line()
    series = example_series(twin.maps.shape)
    lines = {
        counting: (line, without_effects(line, series)) for counting, line in ((False, twin), (True, as_counter(twin)))
    }
    parts = [
        "# Gallery of effects",
        "Every effect that the twin can carry and `raytwin diagnose` can name. Each is one change of the forward model at one"
        " stage of the line. `raytwin lab --effect ID=STRENGTH` plants the same effects in virtual measurements, with other laws.",
        "The pictures show a line with pixels of 0.15 mm and a magnification of 1.5. Of six series the one is drawn that the effect"
        f" changes most. Maps show the mean of {FRAMES} frames less what the twin without the effect expects, in standard deviations"
        " of that mean, on a scale that is logarithmic beyond 3. The histogram holds differences of successive frames, which show"
        " noise and codes alone. Each picture states its strength.",
        "| effect | what it is | strength | range |\n|---|---|---|---|\n"
        + "\n".join(map(overview_row, EFFECTS.values())),
    ]
    for effect in EFFECTS.values():
        line, usual = lines["counting" in effect.needs]
        words, found = signature(line, series, usual, effect)
        draw(found, folder / "effects" / f"{effect.id}.png")
        title = effect.title[0].upper() + effect.title[1:]
        onset = "after the calibration" if effect.after_calibration else "present when the line was calibrated"
        told = [
            f"(effect-{effect.id})=\n## {title}",
            f"`{effect.id}` acts {STAGE.get(effect.stage, effect.stage)}. Usual onset: {onset}.",
            f"$$\n{effect.law}\n$$",
            f"![Signature of {effect.id}](effects/{effect.id}.png)",
            f"*{words[0].upper() + words[1:]}; strength {drawn_strength(effect):g} {effect.strength.unit}.*",
            parameter_rows(effect),
            f"**Isolated by** {effect.isolated_by}.",
            f"**Source** {effect.reference}.",
        ]
        parts += told
    write_if_changed(folder / "effects_gallery.md", "\n\n".join(parts) + "\n")
