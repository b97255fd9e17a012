"""Turn other file layouts into an acquisition file or a dataset file.

images    a folder of TIFF, PNG, FITS, DICOM, HIS, EDF or raw images with a sidecar raytwin.toml   -> acquisition
dicom     DICOM and DICONDE images: kV, current, exposure and filter come from their tags    -> acquisition
xtekct    a Nikon scan: the .xtekct file and the TIFF projections beside it                  -> acquisition
nxtomo    a NeXus NXtomo file: flats, darks and projections told apart by image_key        -> acquisition
emva1288  a set with EMVA1288_Data.txt and the images it lists                             -> acquisition
zenodo    the paper's data, 10.5281/zenodo.10579608: processed images                      -> dataset
          its raw sessions or its calibration flats                                        -> acquisition
reference your own dual-energy images with masks, or an acquisition with scenes            -> dataset

`raytwin import LAYOUT --help` says more of each.
"""

import argparse
import importlib
from typing import Any

from ..api._progress import Bar
from ..api.imports import LAYOUTS, WORDS, import_data
from ..results import counted
from ._answer import answer, say
from ._twin_file import HELP

EXAMPLE = """examples:
  raytwin import emva1288 measured/emva_ccd -o ccd.h5
  raytwin import nxtomo scan.nxs -o scan.h5
  raytwin import images session/ -o session.h5
  raytwin import dicom radiographs/ -o session.h5
  raytwin import xtekct scan/scan.xtekct -o scan.h5 --exposure-ms 500
  raytwin import zenodo Submission --select "Dataset #1" -o set1.h5
  raytwin import reference session.h5 -o reference.h5 --low kv=40,exposure_ms=100 --high kv=90,exposure_ms=100"""

_SHOWN = 12


def add_arguments(parser: argparse.ArgumentParser) -> None:
    layouts = parser.add_subparsers(dest="layout", metavar="LAYOUT", required=True)
    for name, line in LAYOUTS.items():
        layout = layouts.add_parser(
            name,
            help=line,
            description=importlib.import_module(f"..acquisition.{name}", __package__).__doc__,
            epilog="example:\n" + next(text for text in EXAMPLE.splitlines() if f"import {name}" in text),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        layout.add_argument("source", metavar="SOURCE", help=line)
        layout.add_argument("-o", "--out", metavar="OUT", required=True, help="file to write (HDF5)")
        layout.add_argument("--json", action="store_true", help="print the account as JSON")
        if name in ("images", "reference"):
            layout.add_argument("--sidecar", metavar="TOML", help="sidecar (default: raytwin.toml in the folder)")
        if name == "nxtomo":
            layout.add_argument("--detector", metavar="NAME", help="detector group, where several hold frames")
        if name == "xtekct":
            layout.add_argument("--exposure-ms", type=float, metavar="T", help="exposure of a projection (ms)")
        if name == "zenodo":
            layout.add_argument("--select", metavar="TEXT", help="only folders whose path holds this text")
            layout.add_argument(
                "--kv", dest="kV", type=float, metavar="KV", help="tube voltage of calibration flats (kV)"
            )
            layout.add_argument("--exposure-ms", type=float, metavar="T", help="exposure of calibration flats (ms)")
        if name == "reference":
            layout.add_argument("--low", metavar="SETTING", help="low-kV setting, where there are several")
            layout.add_argument("--high", metavar="SETTING", help="high-kV setting")
            layout.add_argument(
                "--each-frame", action="store_true", help="each frame is an image (default: their mean)"
            )
            layout.add_argument("--ring-px", type=int, default=21, metavar="N", help="ring of a contrast (default 21)")
            layout.add_argument(
                "--validation", type=float, metavar="SHARE", help="share of the products for validation"
            )
            layout.add_argument("--test", type=float, metavar="SHARE", help="share of products for testing")
            layout.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the split (default 0)")
            layout.add_argument("--twin", metavar="TWIN", help=f"replace the bad pixels that this twin knows: {HELP}")


def run(arguments: argparse.Namespace) -> int:
    from .check import say_short

    layout, words = arguments.layout, _words(arguments)
    with Bar(only_on_terminal=True, unit="image") as progress:
        found = import_data(arguments.source, arguments.out, layout=layout, progress=progress, **words)
    for skipped in found.skipped[:_SHOWN]:
        say(f"skipped {skipped.what}: {skipped.reason}")
    if len(found.skipped) > _SHOWN:
        say(f"skipped {len(found.skipped) - _SHOWN} more (all of them with --json)")
    say_short(found.findings)
    result = found.to_dict()
    answer(result, as_json=arguments.json, text=_text(result))
    return 0


def _words(arguments: argparse.Namespace) -> dict[str, Any]:
    """The options of a layout as `rt.import_data` calls them."""
    names = (*WORDS.get(arguments.layout, ()), *(("seed", "twin") if arguments.layout == "reference" else ()))
    return {name: getattr(arguments, name) for name in names}


def _text(result: dict[str, Any]) -> str:
    read = result["read"]
    lines = [
        f"{result['written']}: {result['format']} file, {counted(result['frames'], 'frame')} from {result['source']}"
    ]
    for entry in read[:_SHOWN]:
        words = [f"{key} {value}" for key, value in entry.items() if value not in (None, "", ())]
        lines.append("  " + ", ".join(words))
    if len(read) > _SHOWN:
        lines.append(f"  and {len(read) - _SHOWN} more (all of them with --json)")
    lines.append(f"skipped: {len(result['skipped'])}")
    lines += [f"note: {note}" for note in result["notes"]]
    return "\n".join(lines)
