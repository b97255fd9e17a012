"""A twin for other simulators, a dataset for other trainers, an acquisition for other viewers.

Of a TWIN, spectrum at the detector, its response, optical spread and noise:
csv     tables for anything that reads text
gvxr    JSON files for gVirtualXray's json2gvxr, one a setting
xcist   spectrum, protocol and scanner files for gecatsim (XCIST), one protocol a setting
leap    arrays by the names of LEAP's functions

Of a DATASET, pictures with labels of the foreign objects:
coco    annotations with boxes and run lengths (RLE)
yolo    label files with outlines or boxes, and data.yaml
tiff    OME-TIFF with pixel pitch and setting in the tags, masks, and a sidecar that `raytwin import reference` reads

Of an ACQUISITION, its frames:
tiff    OME-TIFF stacks with pixel pitch and setting in the tags, and a sidecar that `raytwin import images` reads
nxtomo  a NeXus file with image_key
dicom   DICONDE: digital X-ray images for processing (extra `dicom`)

Without --setting the measured kV and filters of a twin are written, at 1 mAs. What a form cannot hold is said.
"""

import argparse
from pathlib import Path

from ._answer import answer, say
from ._twin_file import twin_file

EXAMPLE = """examples:
  raytwin export twin.h5 --to csv -o for_others
  raytwin export virtual_lab --to gvxr -o gvxr --setting kv=60,power_w=30,exposure_ms=20,filter=Cu:0.1
  raytwin export references.h5 --to coco -o coco
  raytwin export references.h5 --to yolo --labels boxes -o yolo
  raytwin export session.h5 --to dicom -o radiographs
"""

_FORMS = ("csv", "gvxr", "xcist", "leap", "coco", "yolo", "tiff", "nxtomo", "dicom", "zarr")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin export`."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        type=twin_file,
        help="twin file or the name of a shipped calibration (virtual_lab); dataset file; acquisition file",
    )
    parser.add_argument("--to", required=True, choices=_FORMS, help="for which program")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="folder to write")
    parser.add_argument(
        "--setting", metavar="SETTING", action="append", help="of a twin: write its spectrum; repeatable"
    )
    parser.add_argument(
        "--labels", choices=("polygons", "boxes"), default="polygons", help="of yolo (default polygons)"
    )
    parser.add_argument(
        "--bits", type=int, choices=(8, 16), help="of coco and yolo: 8 (PNG) or 16 (TIFF); default 16, 8"
    )
    parser.add_argument("--pixel-mm", type=float, metavar="MM", help="of a dataset: pitch, where it states none")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin export`."""
    from ..api._progress import Bar
    from ..api.about import export

    with Bar(only_on_terminal=True, unit="image") as bar:
        found = export(
            arguments.source,
            arguments.output,
            to=arguments.to,
            settings=arguments.setting,
            labels=arguments.labels,
            bits=arguments.bits,
            pixel_mm=arguments.pixel_mm,
            progress=bar,
        )
    for line in found.warnings:
        say(f"warning: {line}")
    answer(found.to_dict(), as_json=arguments.json, text=found.table().as_text(lines=len(found.files) + 2))
    return 0
