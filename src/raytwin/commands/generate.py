"""Generate dual-energy images at a setting from low-noise reference images, or from a description of products.

REFERENCE is a dataset file, or an acquisition whose object series pair up by scene: only the noise they lack is added.
At the kV and filter of the references current, exposure and averaging are free, as long as the target has less tube load.
At another kV or filter every pixel is solved for two materials (--product-material and --foreign-material) and projected
through the target's spectrum.

REFERENCE may also be a description (.toml): products and foreign objects as shapes with ranges of sizes, or as thickness
maps of your own, placed at random, projected and given the detector's noise (docs/descriptions.md has an example).
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ._answer import answer, say
from ._twin_file import HELP, twin_file

if TYPE_CHECKING:
    from ..acquisition import Setting
    from ..generator.generate import GenerationSummary
    from ..generator.twin import Twin

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
        "--product-material", default="chicken_breast", help="what the product is made of (%(default)s)"
    )
    parser.add_argument(
        "--foreign-material", default="rib_bone", help="the second material of another kV or filter (%(default)s)"
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
        help="shift in pixels of the references' high-kV image against the low one, taken off",
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
    from ..acquisition import read_dataset, setting_from_text
    from ..errors import InputError
    from ..generator.twin_io import read_twin
    from ..materials import material_from_name

    twin = read_twin(arguments.twin)
    low, high = setting_from_text(arguments.low), setting_from_text(arguments.high)
    material_from_name(arguments.product_material)
    material_from_name(arguments.foreign_material)
    if (arguments.reference_low is None) != (arguments.reference_high is None):
        raise InputError("--reference-low and --reference-high", received="one of the two", expected="both or neither")
    if arguments.reference.suffix.lower() == ".toml":
        summary = _from_description(twin, low, high, arguments)
    else:
        summary = _from_references(twin, low, high, arguments)
    result = summary.as_dict()
    if arguments.tiff is not None:
        from ..acquisition.tiff_folder import write_tiff_folder

        with read_dataset(arguments.output) as dataset:
            written = write_tiff_folder(dataset, arguments.tiff)
        result["tiff"] = {"folder": written.folder, "trees": list(written.trees)}
        result["warnings"] += list(written.notes)
    for warning in result["warnings"]:
        say(f"warning: {warning}")
    answer(result, as_json=arguments.json, text=_text(result, arguments.output))
    return 0


def _from_description(
    twin: "Twin", low: "Setting", high: "Setting", arguments: argparse.Namespace
) -> "GenerationSummary":
    from ..errors import InputError
    from ..files import sha256_of_file
    from ..generator.describe import read_description
    from ..generator.generate_described import generate_from_description

    for name, given in (
        ("--recipe", arguments.recipe != "raytwin"),
        ("--split", arguments.split is not None),
        ("--registration", arguments.registration is not None),
        ("--reference-low", arguments.reference_low is not None),
    ):
        if given:
            raise InputError(
                name, received="a description as REFERENCE", expected="reference images: the option is about those"
            )
    with _bar(arguments.images) as bar:
        return generate_from_description(
            twin,
            read_description(arguments.reference),
            arguments.output,
            low=low,
            high=high,
            images=arguments.images,
            seed=arguments.seed,
            bad_pixels=arguments.bad_pixels,
            with_counts=not arguments.no_counts,
            twin_sha256=sha256_of_file(arguments.twin),
            progress=lambda done: bar.update(done - bar.n),
        )


def _from_references(
    twin: "Twin", low: "Setting", high: "Setting", arguments: argparse.Namespace
) -> "GenerationSummary":
    from ..acquisition import open_acquisition, read_dataset, setting_from_text
    from ..acquisition.pairs import dataset_from_acquisition
    from ..errors import FileFormatError
    from ..files import sha256_of_file
    from ..generator.generate import generate_dataset

    fallback = None
    if arguments.reference_low is not None:
        fallback = (setting_from_text(arguments.reference_low), setting_from_text(arguments.reference_high))
    with tempfile.TemporaryDirectory() as scratch:
        reference_path = arguments.reference
        try:
            read_dataset(reference_path).close()
        except FileFormatError:
            try:
                acquisition = open_acquisition(arguments.reference)
            except FileFormatError as error:
                raise FileFormatError(
                    str(arguments.reference),
                    received=error.received,
                    expected="a raytwin-dataset or raytwin-acquisition file, or a description (.toml)",
                ) from None
            with acquisition:
                reference_path = Path(scratch) / "reference.h5"
                longest = _longest_pair(acquisition)
                bad = twin.maps.bad_pixels > 0
                dataset_from_acquisition(
                    acquisition,
                    reference_path,
                    low=longest[0],
                    high=longest[1],
                    with_counts=False,
                    bad_pixels=bad if bad.shape == longest[2] else None,
                )
        with read_dataset(reference_path) as reference, _bar(arguments.images) as bar:
            return generate_dataset(
                twin,
                reference,
                arguments.output,
                low=low,
                high=high,
                images=arguments.images,
                seed=arguments.seed,
                recipe=arguments.recipe,
                product_material=arguments.product_material,
                foreign_material=arguments.foreign_material,
                bad_pixels=arguments.bad_pixels,
                registration_px=_registration(arguments.registration),
                split=arguments.split,
                with_counts=not arguments.no_counts,
                reference_setting=fallback,
                twin_sha256=sha256_of_file(arguments.twin),
                progress=lambda done: bar.update(done - bar.n),
            )


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


def _longest_pair(acquisition: Any) -> tuple[Any, Any, tuple[int, int]]:
    from ..acquisition.pairs import object_pairs
    from ..errors import InputError

    pairs = object_pairs(acquisition)
    if not pairs:
        raise InputError(
            acquisition.path, received="no object series that pair up by scene", expected="scenes measured at two kV"
        )
    best = max(pairs, key=lambda pair: pair.seconds)
    low, high = best.settings
    return low, high, best.low.shape


def _bar(total: int) -> Any:
    from tqdm import tqdm

    return tqdm(total=total, unit="pair", desc="generating", disable=None, file=sys.stderr)


def _text(result: dict[str, Any], path: Path) -> str:
    return (
        f"{result['images']} image pairs ({result['with_foreign_object']} with a foreign object) from"
        f" {result['references']} references at {result['setting']}\n"
        f"seed {result['seed']}, recipe {result['recipe']}, SHA-256 {result['hashes']['dataset_sha256']}\n"
        f"dataset written to {path}"
    )
