"""Predict the flatfield of a twin at a setting, measured or not, with 95 % intervals.

Air kerma is that at the object, of one exposure; where the distance of the object is not known, at the detector.
"""

import argparse
from typing import Any

from ._answer import answer, say
from ._twin_file import HELP, twin_file

EXAMPLE = """example:
  raytwin predict twin.h5 --kv 60 --filter Cu:0.1 --power-w 30 --exposure-ms 20
  raytwin predict virtual_lab --kv 60 --filter Cu:0.1 --power-w 30 --exposure-ms 20 --binning 2
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin predict`."""
    parser.add_argument("twin", metavar="TWIN", type=twin_file, help=HELP)
    parser.add_argument("--kv", type=float, required=True, help="tube voltage, kV")
    parser.add_argument("--filter", metavar="MATERIAL:mm", action="append", default=[], help="filter, repeatable")
    load = parser.add_mutually_exclusive_group(required=True)
    load.add_argument("--current-ma", type=float, help="tube current, mA")
    load.add_argument("--power-w", type=float, help="tube power, W")
    parser.add_argument("--exposure-ms", type=float, required=True, help="exposure of one frame, ms")
    parser.add_argument("--averaged", type=int, default=1, help="frames averaged (default 1)")
    parser.add_argument("--source-detector-mm", type=float, help="distance, where it differs from the calibration's")
    parser.add_argument(
        "--binning", type=int, default=1, metavar="B", help="B x B pixels combined into one (default 1)"
    )
    parser.add_argument(
        "--frame-interval-ms", type=float, help="from one frame or line to the next, checked with readout"
    )
    parser.add_argument("--belt-speed-mm-s", type=float, help="checked with the exposure of line and TDI detectors")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin predict`."""
    from ..api.twins import predict

    found = predict(
        arguments.twin,
        kV=arguments.kv,
        exposure_ms=arguments.exposure_ms,
        current_mA=arguments.current_ma,
        power_W=arguments.power_w,
        filter="+".join(arguments.filter),
        averaged=arguments.averaged,
        source_detector_mm=arguments.source_detector_mm,
        binning=arguments.binning,
        frame_interval_ms=arguments.frame_interval_ms,
        belt_speed_mm_s=arguments.belt_speed_mm_s,
    )
    result = found.to_dict()
    for warning in result["warnings"]:
        say(f"warning: {warning}")
    answer(result, as_json=arguments.json, text=_text(result))
    return 0


def _text(result: dict[str, Any]) -> str:
    from ..generator.predictions.predict import UNITS

    lines = [result["setting"]]
    for name, unit in UNITS.items():
        value = result[name]
        text = (
            "not known" if value is None else f"{value['value']:.5g} ({value['low']:.5g} to {value['high']:.5g}) {unit}"
        )
        lines.append(f"{name:<17} {text}")
    for name, value in result.get("back_layer", {}).items():
        lines.append(f"back layer, {name}: {value['value']:.5g} ({value['low']:.5g} to {value['high']:.5g})")
    lines.append(f"extrapolated      {'yes' if result['extrapolated'] else 'no'}")
    return "\n".join(lines)
