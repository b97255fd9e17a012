"""The demo's last chapter: an effect is planted in the line, found by the diagnosis, added to the twin, and tried on another day.

The same tube and detector stand on a bench of their own, where filtered flats and a slab of the product's material are
measured. The withheld frames are of another day and of other objects: whole products, which the fit never saw.
"""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import open_acquisition
from ..diagnosis.inference.inference import title_of
from ..diagnosis.problem.assemble import problem_of
from ..diagnosis.session.preparation import prepare_session
from ..generator.line.twin import Twin
from ..generator.twins.twin_io import read_twin

Step = Callable[..., dict[str, Any]]

SESSION, LATER, FOLDER = "bench.h5", "bench_later.h5", "diagnosis"
# flats and a slab, near the detector and far from it: that is what tells scatter from a beam that is harder than thought
_SLAB = ("--only", "filtered_flats", "--only", "slab")
_PRODUCTS = ("--only", "filtered_flats", "--only", "product", "--leave-out", "middle_exposures", "--products", "2")


@dataclass(frozen=True, slots=True, kw_only=True)
class GapPlan:
    """How large the chapter is: strength planted (scatter over primary behind 20 mm of water, %), side in pixels, frames a series."""

    strength: float = 10.0
    size: int = 48
    frames: int = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class WithheldFrame:
    """The mean frame of a product on another day, measured and as the twin expects it before and after the effect was added.

    Fields: series; kV; exposure_ms; measured_DN, before_DN, after_DN (row, column), above dark; noise_DN (row, column) of
    the measured mean, one standard deviation; inside (row, column), the product's pixels.
    """

    series: str
    kV: float
    exposure_ms: float
    measured_DN: NDArray[np.float64] = field(repr=False)
    before_DN: NDArray[np.float64] = field(repr=False)
    after_DN: NDArray[np.float64] = field(repr=False)
    noise_DN: NDArray[np.float64] = field(repr=False)
    inside: NDArray[np.bool_] = field(repr=False)

    def error_percent(self, expected_DN: NDArray[np.float64]) -> float:
        """Expected over measured signal within the product, less 1, in %."""
        return 100.0 * (float(expected_DN[self.inside].sum() / self.measured_DN[self.inside].sum()) - 1.0)

    def departure(self, expected_DN: NDArray[np.float64]) -> float:
        """Root mean square of measured less expected within the product, in units of the measured mean's noise (1: noise alone)."""
        z = ((self.measured_DN - expected_DN) / self.noise_DN)[self.inside]
        return float(np.sqrt(np.mean(z**2)))


def planted_effect() -> str:
    """Id of the effect that the chapter plants, from demo_gap.toml."""
    found = tomllib.loads((Path(__file__).parent / "demo_gap.toml").read_text(encoding="utf-8"))["effect"]
    return str(found)


def run_gap(directory: Path, plan: GapPlan, *, seed: int, step: Step) -> dict[str, Any]:
    """Measure the bench with the effect in it, diagnose it, and measure other objects on another day.

    Args:
        directory: the demo's folder.
        plan: sizes.
        seed: of the line.
        step: does one command (name, words, outputs=paths relative to the folder) and returns its answer.

    Returns:
        `truth` of the planted effect, `diagnosis` as in diagnosis.json.
    """

    effect = planted_effect()

    def lab(name: str, file: str, *words: str) -> dict[str, Any]:
        return step(
            name,
            ["lab", "-o", str(directory / file), "--protocol", "full", "--seed", str(seed), "--family", "none",
             "--no-unkindness", "--size", str(plan.size), "--frames", str(plan.frames),
             "--effect", f"{effect}={plan.strength:g}", *words],
            outputs=[file],
        )  # fmt: skip

    truth = lab("lab_bench", SESSION, *_SLAB)
    diagnosis = step(
        "diagnose",
        ["diagnose", str(directory / SESSION), "-o", str(directory / FOLDER), "--seed", str(seed)],
        outputs=[f"{FOLDER}/twin.h5", f"{FOLDER}/report.html"],
    )
    lab("lab_bench_later", LATER, "--session", "1", *_PRODUCTS)
    return {"truth": {"effect": effect, **truth["effects"][effect]}, "diagnosis": diagnosis}


def withheld_frames(directory: Path, *, seed: int) -> tuple[WithheldFrame, ...]:
    """The later day's products, measured and expected, without and with the effects that the diagnosis added to the twin.

    Raises:
        InputError: the later session and the twin do not belong together.
    """
    after = read_twin(directory / FOLDER / "twin.h5")
    return compare_products(directory / LATER, before=replace(after, effects=()), after=after, seed=seed)


def compare_products(acquisition: Path, *, before: Twin, after: Twin, seed: int) -> tuple[WithheldFrame, ...]:
    """Mean frames of the objects of an acquisition with what two twins of one calibration expect of them.

    Raises:
        InputError: another detector than the twins', or nothing to compare.
    """
    with open_acquisition(acquisition) as session:
        views = []
        for twin in (before, after):
            ready = prepare_session(session, twin=twin, rng=np.random.default_rng(seed))
            problem = problem_of(ready, variants=())
            views.append({view.session.name: view for view in problem.views})
        found = []
        for name, plain in views[0].items():
            series, improved = plain.session.series, views[1][name]
            if series.kind != "object" or series.setting is None:
                continue
            product = session.scenes[series.scene].product_mask
            inside = plain.mask if product is None else plain.mask & product
            expected = np.asarray(plain.signal_DN, np.float64)
            found.append(
                WithheldFrame(
                    series=name,
                    kV=series.setting.kV,
                    exposure_ms=series.setting.exposure_ms,
                    measured_DN=expected + plain.residual_DN,
                    before_DN=expected,
                    after_DN=expected + plain.residual_DN - improved.residual_DN,
                    noise_DN=np.asarray(plain.noise_DN, np.float64),
                    inside=np.asarray(inside, bool),
                )
            )
    return tuple(found)


def answer_text(gap: Mapping[str, Any]) -> str:
    """What the diagnosis found, against what was planted: the chapter's answer in words."""
    diagnosis, truth = gap["diagnosis"], gap["truth"]
    planted = f"Planted: {title_of(truth['effect']).lower()}, {truth['strength']:g} {truth['unit']}."
    sizes = diagnosis["gap"]
    closing = (
        f"On data that the fit did not use, the gap falls from {sizes['before']:.1f} to {sizes['after']:.1f};"
        f" two measurements of the same thing differ by {sizes['floor']:.1f}."
    )
    causes = diagnosis["causes"]
    if not causes or diagnosis["verdict"] not in ("explained", "explained_in_part", "ambiguous"):
        return f"{planted} The diagnosis named no effect (verdict: {diagnosis['verdict'].replace('_', ' ')}). {closing}"
    first = causes[0]
    strength = first["parameters"]["strength"]
    found = (
        f"Found: {title_of(first['effect']).lower()}, {strength['value']:.1f} {strength['unit']}"
        f" (95 %: {strength['low']:.1f} to {strength['high']:.1f}), probability {first['probability']:.2f}."
    )
    if diagnosis["verdict"] == "ambiguous":
        others = ", ".join(title_of(cause["effect"]).lower() for cause in causes[1:])
        found += f" These data cannot tell it from {others}."
    return f"{planted} {found} {closing}"


def withheld_rows(frames: Sequence[WithheldFrame]) -> list[dict[str, str]]:
    """One row a withheld series: error of the expected brightness and departure in units of noise, before and after."""
    return [
        {
            "name": f"{frame.series.split('_')[0].replace('product', 'product ')}, {frame.kV:g} kV, {frame.exposure_ms:g} ms",
            "error_before": f"{frame.error_percent(frame.before_DN):+.2f} %",
            "error_after": f"{frame.error_percent(frame.after_DN):+.2f} %",
            "departure_before": f"{frame.departure(frame.before_DN):.1f}",
            "departure_after": f"{frame.departure(frame.after_DN):.1f}",
        }
        for frame in frames
    ]


def withheld_text(frames: Sequence[WithheldFrame]) -> str:
    """How far off the twin's products were and are, in one sentence."""
    before, after = (
        float(np.median([abs(frame.error_percent(getattr(frame, name))) for frame in frames]))
        for name in ("before_DN", "after_DN")
    )
    return (
        f"Whole products, measured on another day, took no part in the diagnosis. Within them the twin's brightness was off by"
        f" {before:.2f} %; with the effect added it is off by {after:.2f} % (median of {len(frames)} series)."
    )
