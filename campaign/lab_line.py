"""The paper's experiment on a line of the virtual lab: the calibrated line, and images at exposures, measured and generated.

Two sets of products, as in the paper: one to learn from, at 1 s; one to test on, at every exposure. Generated images of the
first train networks; generated images of the second are set against its measured ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..acquisition.setting import Filter, Setting
from ..errors import InputError
from .chain import Chain

_FILTERS = (Filter(material="Cu", thickness_mm=0.05),)
LOW = Setting(kV=40, power_W=40, exposure_ms=100, averaged=10, filters=_FILTERS)
HIGH = Setting(kV=90, power_W=45, exposure_ms=100, averaged=10, filters=_FILTERS)
REFERENCE_MS = 1000.0  # ten averaged frames of 100 ms: the low-noise images that others are generated from


@dataclass(frozen=True, slots=True, kw_only=True)
class LabLine:
    """A line of the virtual lab and the images taken on it.

    Fields: size (row, column) and pixel_mm of the detector; source_detector_mm (None: as many photons a pixel as the paper's
    line, whatever the pixel); bones_mm of the test set, each bone as thick as it is drawn (None: the paper's two);
    bones_across_mm, least and most width of all bones (None: a rib's); boneless
    products of the test set and lab_exposures_ms that it is measured at beside 1 s (None: the lab's); calibration_frames a
    series; products, test_products (images of the two sets); exposures_ms at which images are generated; generated (training
    pairs an exposure); seed.
    """

    size: tuple[int, int]
    pixel_mm: float
    source_detector_mm: float | None
    bones_mm: tuple[float, ...] | None
    calibration_frames: int
    products: int
    test_products: int
    exposures_ms: tuple[float, ...]
    generated: int
    seed: int
    bones_across_mm: tuple[float, float] | None = None
    boneless: int | None = None
    lab_exposures_ms: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name in ("calibration_frames", "products", "test_products", "generated"):
            if getattr(self, name) < 1:
                raise InputError(name, received=getattr(self, name), expected="1 or more")


def setting_pair(exposure_ms: float) -> tuple[Setting, Setting]:
    """Low and high setting of the paper's line at an exposure; 1000 ms is ten averaged frames of 100 ms."""
    if exposure_ms == REFERENCE_MS:
        return LOW, HIGH
    return (
        replace(LOW, exposure_ms=exposure_ms, averaged=1),
        replace(HIGH, exposure_ms=exposure_ms, averaged=1),
    )


def measure_line(chain: Chain, line: LabLine) -> dict[str, Any]:
    """The line measured: `twin.h5`, `set1.h5`, `set2.h5`; truth, calibration, and how well the twin predicts flats."""
    at = chain.path
    size = ["--size", f"{line.size[0]}x{line.size[1]}", "--pixel-mm", f"{line.pixel_mm:g}", "--seed", str(line.seed)]
    # the main job end to end, on a line without surprises
    size += ["--family", "none", "--no-unkindness"]
    if line.source_detector_mm is not None:
        size += ["--source-detector-mm", f"{line.source_detector_mm:g}"]
    bones = [] if line.bones_across_mm is None else ["--bones-across-mm", _joined(line.bones_across_mm)]
    test = [] if line.bones_mm is None else ["--bones-mm", _joined(line.bones_mm)]
    test += [] if line.lab_exposures_ms is None else ["--exposures-ms", _joined(line.lab_exposures_ms)]
    test += [] if line.boneless is None else ["--boneless", str(line.boneless)]
    truth = chain.step(
        "lab_calibration",
        ["lab", "-o", at("calibration.h5"), "--protocol", "calibration", *size,
         "--frames", str(line.calibration_frames)],
        outputs=["calibration.h5"],
    )  # fmt: skip
    calibration = chain.step("calibrate", ["calibrate", at("calibration.h5"), "-o", at("twin.h5")], outputs=["twin.h5"])
    validation = chain.step("validate", ["validate", at("twin.h5"), at("calibration.h5")])
    for name, count, more in (("set1", line.products, []), ("set2", line.test_products, test)):
        chain.step(
            f"lab_{name}",
            ["lab", "-o", at(f"{name}.h5"), "--protocol", name, *size, "--products", str(count), *bones, *more],
            outputs=[f"{name}.h5"],
        )
    return {"truth": truth, "calibration": calibration, "validation": validation}


def write_measured(chain: Chain, line: LabLine, exposures_ms: Sequence[float]) -> None:
    """Measured images as datasets: `references.h5` to learn from, `real_<exposure>ms.h5` to test on."""
    at = chain.path
    twin = ["--twin", at("twin.h5")]
    chain.step(
        "references",
        ["import", "reference", at("set1.h5"), "-o", at("references.h5"), *twin, "--validation", "0.2",
         "--seed", str(line.seed)],
        outputs=["references.h5"],
    )  # fmt: skip
    for exposure in exposures_ms:
        low, high = setting_pair(exposure)
        chain.step(
            f"real_{exposure:g}ms",
            ["import", "reference", at("set2.h5"), "-o", at(f"real_{exposure:g}ms.h5"), *twin,
             "--low", str(low), "--high", str(high)],
            outputs=[f"real_{exposure:g}ms.h5"],
        )  # fmt: skip


def write_generated(chain: Chain, line: LabLine, exposure_ms: float, name: str) -> str:
    """Generated images at an exposure, `<name>_<exposure>ms.h5`; returns the file's name.

    Args:
        chain: of the folder.
        line: sizes and seed.
        exposure_ms: not that of the references.
        name: a key of `GENERATED`.
    """
    source, recipe, place = GENERATED[name]
    number = f"{exposure_ms:g}ms"
    low, high = setting_pair(exposure_ms)
    count = line.generated if source == "references.h5" else line.test_products
    chosen = [] if recipe == "raytwin" else ["--recipe", recipe]
    step = f"generate_{name}_{number}" if name in ("train", "test") else f"{name}_{number}"
    chain.step(
        step,
        ["generate", chain.path("twin.h5"), chain.path(source), "--low", str(low), "--high", str(high), "-n", str(count),
         *chosen, "--seed", str(1000 * line.seed + 10 * int(exposure_ms) + place), "--no-counts",
         "-o", chain.path(f"{name}_{number}.h5")],
        outputs=[f"{name}_{number}.h5"],
    )  # fmt: skip
    return f"{name}_{number}.h5"


# name -> references, recipe of the noise, place of its random stream; generated test images show the measured products
GENERATED = {
    "train": ("references.h5", "raytwin", 0),
    "test": ("real_1000ms.h5", "raytwin", 1),
    "published": ("real_1000ms.h5", "as_published", 2),
    "published_train": ("references.h5", "as_published", 3),
}


def _joined(values: Sequence[float]) -> str:
    return ",".join(f"{value:g}" for value in values)
