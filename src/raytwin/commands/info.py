"""What is installed: version, extras, libraries, cache, devices. With TWIN, the twin in a table."""

import argparse

from ._answer import answer
from ._twin_file import HELP, twin_file

EXAMPLE = """examples:
  raytwin info
  raytwin info twin.h5
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin info`."""
    parser.add_argument("twin", metavar="TWIN", nargs="?", type=twin_file, help=HELP)
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin info`."""
    from ..api.about import info

    found = info(arguments.twin)
    text = repr(found)
    warnings = getattr(found, "warnings", ())
    if warnings:
        text = "\n".join([text, *(f"  {line}" for line in warnings)])
    answer(found.to_dict(), as_json=arguments.json, text=text)
    return 0
