"""Generate dual-energy images at a setting from low-noise reference images, or from a description of products.

REFERENCE is a dataset file, or an acquisition whose object series pair up by scene: only the noise they lack is added.
At the kV and filter of the references current, exposure and averaging are free, as long as the target has less tube load.
At another kV or filter every pixel is solved for two materials (--product-material and --foreign-material) and projected
through the target's spectrum.

REFERENCE may also be a description (.toml): products and foreign objects as shapes with ranges of sizes, or as thickness
maps of your own, placed at random, projected and given the detector's noise (docs/descriptions.md has an example).
"""

import argparse
from pathlib import Path
from typing import Any

from ..results import counted
from ._answer import answer, say
from ._twin_file import HELP, twin_file

EXAMPLE = """example:
  raytwin generate twin.h5 references.h5 -n 200 --seed 1 -o train_20ms.h5 \\
    --low kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05 --high kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05
  raytwin generate twin.h5 references.h5 -n 200 --seed 1 -o other_kv.h5 \
    --low kv=60,power_w=40,exposure_ms=20,filter=Al:2 --high kv=120,power_w=45,exposure_ms=20,filter=Al:2
  raytwin generate twin.h5 fillets.toml -n 200 --seed 1 -o fillets.h5 \
    --low kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05 --high kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin generate`."""
    parser.add_argument("twin", metavar="TWIN", type=twin_file, help=HELP)
    parser.add_argument(
        "reference",
        metavar="REFERENCE",
        type=Path,
        help="dataset or acquisition with references, or a description (.toml)",
    )
    parser.add_argument("--low", metavar="SETTING", required=True, help="target setting at the low kV")
    parser.add_argument("--high", metavar="SETTING", required=True, help="target setting at the high kV")
    parser.add_argument("-n", "--images", type=int, required=True, help="number of image pairs")
    parser.add_argument("--seed", type=int, required=True, help="same seed, same bytes")
    parser.add_argument("-o", "--output", metavar="DATASET", type=Path, required=True, help="dataset file to write")
    parser.add_argument("--recipe", choices=("raytwin", "as_published"), default="raytwin", help="noise recipe")
    parser.add_argument("--split", choices=("train", "val", "test"), help="use references of this split only")
    parser.add_argument(
        "--product-material",
        metavar="MATERIAL",
        help="what the product is made of (default: as the references state it, else chicken_breast)",
    )
    parser.add_argument(
        "--foreign-material",
        metavar="MATERIAL",
        help="the second material of another kV or filter (default: as the references state it, else rib_bone)",
    )
    parser.add_argument(
        "--bad-pixels",
        choices=("repaired", "measured"),
        default="repaired",
        help="measured: the counts hold the twin's bad pixels, the log images their neighbours' values (%(default)s)",
    )
    parser.add_argument(
        "--registration",
        metavar="ROWS,COLUMNS|estimate",
        help="shift in pixels of the references' high-kV image against the low one; it is undone",
    )
    parser.add_argument("--reference-low", metavar="SETTING", help="setting of the references where they do not say")
    parser.add_argument("--reference-high", metavar="SETTING", help="the same at the high kV")
    parser.add_argument("--no-counts", action="store_true", help="leave out the raw counts")
    parser.add_argument(
        "--tiff", metavar="DIR", type=Path, help="write the images as TIFF folders in the paper's layout too"
    )
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin generate`."""
    from ..api._progress import Bar
    from ..api.images import generate

    with Bar(only_on_terminal=True, unit="pair") as bar:
        found = generate(
            arguments.twin,
            arguments.reference,
            low=arguments.low,
            high=arguments.high,
            n=arguments.images,
            seed=arguments.seed,
            output=arguments.output,
            recipe=arguments.recipe,
            split=arguments.split,
            product_material=arguments.product_material,
            foreign_material=arguments.foreign_material,
            bad_pixels=arguments.bad_pixels,
            registration_px=_registration(arguments.registration),
            reference_low=arguments.reference_low,
            reference_high=arguments.reference_high,
            counts=not arguments.no_counts,
            tiff=arguments.tiff,
            progress=bar,
        )
    result = found.to_dict()
    for warning in result["warnings"]:
        say(f"warning: {warning}")
    answer(result, as_json=arguments.json, text=_text(result, arguments.output))
    return 0


def _registration(text: str | None) -> tuple[float, float] | str | None:
    from ..errors import InputError

    if text is None or text == "estimate":
        return text
    try:
        rows, columns = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(
            "--registration", received=repr(text), expected="ROWS,COLUMNS in pixels, or estimate", remedy="e.g. 0.5,-1"
        ) from None
    return rows, columns


def _text(result: dict[str, Any], path: Path) -> str:
    return (
        f"{result['images']} image pairs ({result['with_foreign_object']} with a foreign object) from"
        f" {counted(result['references'], 'reference')} at {result['setting']}\n"
        f"seed {result['seed']}, recipe {result['recipe']}, SHA-256 {result['hashes']['dataset_sha256']}\n"
        f"dataset written to {path}"
    )
