"""A page of settings: what changes with kV, filter, power, exposure, product and foreign object, seen at once.

It opens in the browser of this machine and answers there alone: no request leaves the machine, and other machines get no answer.
Within an SSH session the command that brings the page to you is printed. Ctrl+C ends it.
"""

import argparse
import os
from pathlib import Path

from ..errors import InputError
from ._answer import answer, say
from ._twin_file import HELP

EXAMPLE = """examples:
  raytwin explore twin.h5
  raytwin explore virtual_lab --pod hits.csv --campaign campaign.toml --no-browser --port 5010
"""


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin explore`."""
    parser.add_argument("twin", metavar="TWIN", help=HELP)
    parser.add_argument("--port", type=int, metavar="P", help="port of 127.0.0.1 (default 5006, or the next free one)")
    parser.add_argument("--no-browser", action="store_true", help="print the address, open nothing")
    parser.add_argument(
        "--pod",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="a known POD curve: hits.csv, or what `raytwin pod --json` printed; repeatable",
    )
    parser.add_argument(
        "--campaign",
        type=Path,
        default=Path("campaign.toml"),
        metavar="FILE",
        help='the file that "Add to campaign" writes (default %(default)s)',
    )
    parser.add_argument(
        "--references",
        type=Path,
        metavar="FILE",
        help="dataset or description that a new campaign names (default: a description of what is seen)",
    )
    parser.add_argument(
        "--observer",
        type=Path,
        metavar="FILE",
        help="an observer that `raytwin observe --save` or a screened sweep left: a90 of networks on the objects of --references",
    )
    parser.add_argument("--json", action="store_true", help="print the address as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin explore`."""
    # an answer is many small sums, which threads would make longer; the libraries read these words when they are loaded
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    from ..explore.server import listen, serve

    if arguments.observer is not None and arguments.references is None:
        raise InputError(
            "--observer", received="no --references", expected="the dataset whose objects the networks look for"
        )
    if arguments.references is not None:
        _check_references(arguments.references)
    listening = listen(arguments.port)
    import numba

    from ..api._given import as_twin
    from ..explore.known_pod import read_known_pod
    from ..explore.page import CampaignTarget, page_of
    from ..explore.seen_size import read_networks_observer
    from ..explore.state import first_state
    from ..explore.view import Explorer
    from ..spectra import is_packaged

    twin = as_twin(arguments.twin)
    networks = None
    if arguments.observer is not None:
        networks = read_networks_observer(str(arguments.observer), str(arguments.references), twin)
    pods = [read_known_pod(path) for path in arguments.pod]
    explorer = Explorer(twin, name=arguments.twin, pods=pods, networks=networks)
    tube = twin.spectral
    if tube is not None and not is_packaged(tube.anode, tube.anode_angle_deg, tube.model):
        say(
            f"warning: no spectra are packaged for {tube.anode} at {tube.anode_angle_deg:g} degrees: a voltage that nobody"
            " asked for before takes seconds, once"
        )
    say("preparing the page")
    # pictures are small: threads would cost more than they save
    numba.set_num_threads(1)
    # the first answer compiles and reads what later ones use
    state = first_state(twin)
    explorer.view(state)
    explorer.map(state)
    levels = "; ".join(level.name for level in twin.levels)
    target = CampaignTarget(path=arguments.campaign, references=arguments.references)

    def told(address: str, tunnel: str | None) -> None:
        found = {"address": address, "tunnel": tunnel}
        text = f"{address}  (Ctrl+C ends it)"
        if tunnel is not None:
            text += f"\non the machine that you sit at, run\n  {tunnel}\nand open the address there"
        answer(found, as_json=arguments.json, text=text)

    serve(
        page_of(explorer, target, f"calibrated at {levels}" if levels else "no measured level"),
        listening=listening,
        browser=not arguments.no_browser,
        told=told,
    )
    return 0


def _check_references(path: Path) -> None:
    """Refuse what no campaign can take as references.

    Raises:
        InputError, FileFormatError: neither a dataset nor a description.
    """
    from ..acquisition import read_dataset
    from ..generator.scenes.describe import read_description

    if path.suffix.lower() == ".toml":
        read_description(path)
    else:
        read_dataset(path).close()
