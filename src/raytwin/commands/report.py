"""A twin, a dataset or a table of hits as one self-contained page.

The page opens from its file without any network: the answer first, then the figures that show it, what to do next, and the
numbers of every figure as CSV. `calibrate`, `validate` and `pod` write theirs with --report; `diagnose`, `sweep`,
`blind-check` and `demo` always do.
"""

import argparse
from pathlib import Path

from ._answer import answer

EXAMPLE = """examples:
  raytwin report twin.h5 -o twin.html
  raytwin report train_20ms.h5 -o images.html
  raytwin report hits.csv -o pod.html --static
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin report`."""
    parser.add_argument("file", metavar="FILE", help="a twin, a shipped twin's name, a dataset, or HITS.csv")
    parser.add_argument("-o", "--output", metavar="PAGE.html", type=Path, required=True, help="the page")
    parser.add_argument(
        "--static", action="store_true", help="pictures in place of figures that answer to the pointer (1.3 MB less)"
    )
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin report`."""
    from ..api.reports import report

    page = report(arguments.file, arguments.output, interactive=False if arguments.static else None)
    answer({"report": str(page)}, as_json=arguments.json, text=f"report: {page}")
    return 0
