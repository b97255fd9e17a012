"""POD and a90 of a foreign object at a pair of settings from the twin alone: a model observer, no images, no training.

Of a shape in a slab (--product, --object) or of the objects of reference images (--references). --networks brings the observer to the
networks of a finished sweep (two numbers, with what settings that were left out depart from it) and --save keeps that; with
--calibrated the answer is the a90 of such networks, with a 95 % interval.
"""

import argparse
from pathlib import Path
from typing import Any

from ..errors import InputError
from ._answer import answer, say
from ._twin_file import HELP, twin_file

EXAMPLE = """examples:
  raytwin observe virtual_lab --product chicken_breast:20 --object rib_bone --shape rod --width 0.2 --height 0.2 \\
    --low kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05 --high kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05
  raytwin observe twin.h5 --networks sweep --save observer.json
  raytwin observe twin.h5 --references references.h5 --calibrated observer.json --low SETTING --high SETTING
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin observe`."""
    add = parser.add_argument
    add("twin", metavar="TWIN", type=twin_file, help=HELP)
    add("--low", metavar="SETTING", help="low-kV setting")
    add("--high", metavar="SETTING", help="high-kV setting")
    add("--product", metavar="MATERIAL:mm", help="slab around the object")
    add("--object", metavar="MATERIAL", help="material of the foreign object")
    add("--shape", default="ellipsoid", help="ellipsoid (default), rod or plate; its length is the size")
    add("--width", type=float, default=1.0, metavar="SHARE", help="of the length (default 1)")
    add("--height", type=float, default=1.0, metavar="SHARE", help="along the beam, of the length (default 1)")
    add("--height-mm", type=float, metavar="MM", help="in its place: the same at every size")
    add("--sizes-mm", metavar="MM,MM,...", help="lengths to look at (default: half a pixel to 120 pixels)")
    add("--displaces", action="store_true", help="the object takes the product's place")
    add("--references", metavar="DATASET", type=Path, help="in place of a shape: the objects of these images")
    add(
        "--product-material",
        metavar="MATERIAL",
        help="of the references (default: as they state it, else as --calibrated or --networks has it, else chicken_breast)",
    )
    add(
        "--foreign-material",
        metavar="MATERIAL",
        help="of the references (default: as they state it, else as --calibrated or --networks has it, else rib_bone)",
    )
    add("--size", choices=("contrast", "size_mm"), help="of the references (default: of --calibrated, else contrast)")
    add("--detector", help="ideal (default), hotelling, npw or npwe")
    add(
        "--image",
        help="residual (default of a shape), quotient, low, high or both (default of references whose texture can be read)",
    )
    add(
        "--false-alarms",
        type=float,
        metavar="SHARE",
        help="of images without object (default 0.01; of --networks theirs)",
    )
    add("--calibrated", metavar="FILE", type=Path, help="an observer that --save kept")
    add("--networks", metavar="SWEEP", type=Path, help="calibrate the observer to the networks of this sweep's folder")
    add("--save", metavar="FILE", type=Path, help="keep the calibrated observer (JSON)")
    add("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin observe`."""
    from ..api.observers import calibrate_observer, observe

    if arguments.save is not None and arguments.networks is None:
        raise InputError("--save", received="no --networks", expected="a sweep to calibrate the observer to")
    given = {"detector": arguments.detector, "image": arguments.image}
    given |= {"product_material": arguments.product_material, "foreign_material": arguments.foreign_material}
    words: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if arguments.networks is not None:
        calibrated = calibrate_observer(
            arguments.twin,
            arguments.networks,
            false_alarm_rate=arguments.false_alarms,
            **words,
        )
        result = calibrated.to_dict()
        if arguments.save is not None:
            calibrated.save(arguments.save)
            result["path"] = arguments.save
        answer(result, as_json=arguments.json, text=repr(calibrated))
        return 0
    if arguments.low is None or arguments.high is None:
        raise InputError("--low and --high", received="one or none", expected="both settings of the pair")
    found = observe(
        arguments.twin,
        (arguments.low, arguments.high),
        product=arguments.product,
        foreign_object=arguments.object,
        shape=arguments.shape,
        width=arguments.width,
        height=arguments.height,
        height_mm=arguments.height_mm,
        sizes_mm=_sizes(arguments.sizes_mm),
        displaces=arguments.displaces,
        references=arguments.references,
        size=arguments.size,
        false_alarm_rate=arguments.false_alarms,
        calibrated=arguments.calibrated,
        **words,
    )
    result = found.to_dict()
    for warning in result["warnings"]:
        say(f"warning: {warning}")
    answer(result, as_json=arguments.json, text=_text(result))
    return 0


def _sizes(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(
            "--sizes-mm", received=repr(text), expected="lengths joined by commas, for example 1,2,4,8"
        ) from None


def _text(result: dict[str, Any]) -> str:
    row, unit, who = result["rows"][0], result["unit"], result["observer"]
    lines = [
        row["setting"],
        f"observer           {who['detector']}, {who['image']} image, {100 * who['false_alarm_rate']:g} % false alarms,"
        f" efficiency {who['efficiency']:.3g}",
        f"search             {row['independent_places']:.0f} independent places an image",
    ]

    def sized(value: float | None) -> str:
        return "none" if value is None else f"{value:.4g} {unit}".rstrip()

    a90 = row["a90"]
    interval = "" if a90 is None or a90["low"] is None else f" (95 %: {a90['low']:.4g} to {a90['high']:.4g})"
    lines.append(f"a50                {sized(row['a50'])}")
    lines.append(f"a90                {sized(None if a90 is None else a90['value'])}{interval}")
    if row["a90_delta_R"] is not None:
        lines.append(f"a90 in Delta R     {row['a90_delta_R']:.4g}")
    if result["size"] == "size_mm" and None not in result["curve"]["pod"][0]:
        lines.append("size (mm)  POD")
        curve = result["curve"]
        step = max(1, len(curve["size"]) // 12)
        lines += [
            f"{size:9.3g}  {pod:.3f}" for size, pod in list(zip(curve["size"], curve["pod"][0], strict=True))[::step]
        ]
    return "\n".join(lines)
