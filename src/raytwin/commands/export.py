"""The twin in the form that other simulators read: spectrum at the detector, its response, optical spread and noise.

csv    tables for anything that reads text
gvxr   JSON files for gVirtualXray's json2gvxr, one a setting
xcist  spectrum, protocol and scanner files for gecatsim (XCIST), one protocol a setting
leap   arrays by the names of LEAP's functions

Without --setting the measured kV and filters are written, at 1 mAs. What a simulator cannot take is said.
"""

import argparse
from pathlib import Path

from ._answer import answer, say
from ._twin_file import HELP, twin_file

EXAMPLE = """examples:
  raytwin export twin.h5 --to csv -o for_others
  raytwin export virtual_lab --to gvxr -o gvxr --setting kv=60,power_w=30,exposure_ms=20,filter=Cu:0.1
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin export`."""
    parser.add_argument("twin", metavar="TWIN", type=twin_file, help=HELP)
    parser.add_argument("--to", required=True, choices=("csv", "gvxr", "xcist", "leap"), help="which simulator")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, required=True, help="folder to write")
    parser.add_argument("--setting", metavar="SETTING", action="append", help="write its spectrum; repeatable")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin export`."""
    from ..api.about import export

    found = export(arguments.twin, arguments.output, to=arguments.to, settings=arguments.setting)
    for line in found.warnings:
        say(f"warning: {line}")
    answer(found.to_dict(), as_json=arguments.json, text=repr(found))
    return 0
