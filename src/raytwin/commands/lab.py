"""Measure a session in the virtual lab: an acquisition file, and the truth about it in a separate file.

The lab stands in for a real X-ray line whose truth is known: photons are sampled one energy class at a time, their
light spreads, electrons are read out and an ADC digitises. It shares no physics with the twin. The seed draws a hidden
system (tube, filtration, scintillator, light, electronics, and the little that every line does wrong), the same for
every protocol, so that a twin calibrated on `--protocol calibration` can be judged on `--protocol set2` of the same seed.

Tubes and detectors depart from a plain one by families (K escape, light that is not proportional, covers, other tube
models, worn anodes and more); `--family` draws from those named alone. What the acquisition says of the line is the label.

The long sessions (`full`, `short`, `products`) are for a diagnosis. `full` has darks, flats at five exposures and two kV
without and with a filter, beam-off frames, wedges at two gaps, a slab, edges, discs, flats with the panel turned, and
products. Effects can be planted in them: they were always there, or set in after the calibration series.
"""

import argparse
import re
from typing import Any

from ..errors import InputError
from ._answer import answer

EXAMPLE = """example:
  raytwin lab -o calibration.h5 --protocol calibration --seed 1
  raytwin lab -o products.h5 --protocol set1 --seed 1 --products 40 --size 128x160
  raytwin lab -o session.h5 --protocol full --effect image_lag=0.5 --effect kv_error=1.5@calibration --seed 1

The truth goes to calibration.truth.json. Frames are 128 x 160 pixels of 0.45 mm unless --size and --pixel-mm say
otherwise; 760x956 pixels of 0.15 mm is the paper's detector. The distances scale with the pixel, so that a power and an
exposure time mean the same photons per pixel at every size. Long sessions are 128 x 128 pixels, of 0.4 mm (coarse) or
0.12 mm (fine)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", required=True, metavar="ACQ", help="acquisition file to write")
    parser.add_argument(
        "--protocol",
        required=True,
        metavar="NAME",
        help="calibration, averaged, averaged_pairs, set1, set2; full, short or products",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="draws system, products and noise (default 0)")
    parser.add_argument(
        "--size", metavar="N", help="pixels: ROWSxCOLUMNS, or N for N x N (default 128x160; long sessions 128)"
    )
    parser.add_argument("--pixel-mm", type=float, metavar="MM", help="pitch (default 0.45 mm)")
    parser.add_argument(
        "--frames",
        type=int,
        metavar="N",
        help="frames per series (default 20, long sessions 50; product sets: per object and exposure, default 1)",
    )
    parser.add_argument("--products", type=int, metavar="N", help="products in a set (default 254 in set1, 84 in set2)")
    parser.add_argument("--product-mm", type=float, metavar="MM", help="length of a product (default: fills the field)")
    parser.add_argument("--bones-mm", metavar="MM,MM", help="lengths of the bones (default: those of the set)")
    parser.add_argument(
        "--bones-across-mm", metavar="LEAST,MOST", help="width of the bones in a set of products (default: 1 to 3 mm)"
    )
    parser.add_argument("--exposures-ms", metavar="MS,MS", help="set2: exposures beside 1 s (default: 100,50,20)")
    parser.add_argument("--boneless", type=int, metavar="N", help="set2: products without bone (default: 2 of 84)")
    parser.add_argument(
        "--source-detector-mm",
        type=float,
        metavar="MM",
        help="distance (default: scales with the pixel, 3177 mm at 0.45 mm); nearer means more photons per pixel",
    )
    parser.add_argument(
        "--session", type=int, default=0, metavar="K", help="another day with the same system (default 0)"
    )
    parser.add_argument(
        "--effect",
        action="append",
        default=[],
        metavar="ID=STRENGTH",
        help="an effect to plant in a long session, with @always or @calibration (set in after it) where it should"
        " not be as usual; repeatable",
    )
    parser.add_argument(
        "--family",
        action="append",
        metavar="NAME",
        help="draw the system's departures from these families alone (thin_screen, gadox, k_escape, light_yield,"
        " depth_light, cover, spectrum, ripple, anode, window, output, spread, defects; none: the plain system);"
        " repeatable (default: all)",
    )
    parser.add_argument(
        "--no-unkindness",
        action="store_true",
        help="without the little that every real line does all the time (drift, changes of shape, line noise, dust)",
    )
    parser.add_argument(
        "--geometry", metavar="NAME", help="long sessions: coarse (0.4 mm pixels, the default) or fine (0.12 mm)"
    )
    parser.add_argument(
        "--leave-out",
        action="append",
        default=[],
        metavar="GROUP",
        help="long sessions: series not to take (wedge, slab, edge, disc, product, near, afterglow, turned, low_kV,"
        " high_kV, open_flats, filtered_flats, middle_exposures); repeatable",
    )
    parser.add_argument(
        "--only",
        action="append",
        metavar="GROUP",
        help="long sessions: take these series alone, with the darks; repeatable",
    )
    parser.add_argument("--json", action="store_true", help="print the truth as JSON")


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)(?:[xX](\d+))?", text.strip())
    size = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
    if not all(8 <= pixels <= 8192 for pixels in size):
        raise InputError("--size", received=repr(text), expected="N or ROWSxCOLUMNS from 8 to 8192 pixels")
    return size


def _list(option: str, text: str | None, expected: str) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        raise InputError(option, received=repr(text), expected=f"{expected} joined by commas") from None


def _families(names: list[str] | None) -> tuple[str, ...] | None:
    """Families by name; the word none stands for no family."""
    return None if names is None else tuple(name for name in names if name != "none")


def run(arguments: argparse.Namespace) -> int:
    from ..api._progress import Bar
    from ..api.sessions import lab_session
    from ..lab.unkindness import NONE

    given: dict[str, Any] = {
        "size": None if arguments.size is None else _size(arguments.size),
        "bones_mm": _list("--bones-mm", arguments.bones_mm, "lengths in mm"),
        "bones_across_mm": _list("--bones-across-mm", arguments.bones_across_mm, "least and most, mm,"),
        "exposures_ms": _list("--exposures-ms", arguments.exposures_ms, "times in ms"),
        "boneless": arguments.boneless,
    }
    with Bar(only_on_terminal=True, unit="frame") as bar:
        found = lab_session(
            arguments.output,
            protocol=arguments.protocol,
            seed=arguments.seed,
            pixel_mm=arguments.pixel_mm,
            frames=arguments.frames,
            products=arguments.products,
            product_mm=arguments.product_mm,
            source_detector_mm=arguments.source_detector_mm,
            session=arguments.session,
            geometry=arguments.geometry,
            families=_families(arguments.family),
            unkindness=NONE if arguments.no_unkindness else None,
            effects=arguments.effect,
            leave_out=arguments.leave_out,
            only=arguments.only,
            progress=bar,
            **given,
        )
    rows, columns = found.shape
    lines = [
        f"{arguments.output}: {len(found.truth['series'])} series of {rows} x {columns} pixels ({arguments.protocol})",
        f"{found.truth_path}: the truth",
    ]
    answer(found.to_dict(), as_json=arguments.json, text="\n".join(lines))
    return 0
