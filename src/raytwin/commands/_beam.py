"""Options that describe a beam and its detector, shared by the commands that take them."""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import InputError
from ..materials import TABLES
from ..spectra import (
    DEFAULT_ANGLE_DEG,
    DEFAULT_ANODE,
    DEFAULT_MODEL,
    DEFAULT_SCINTILLATOR,
    MAXIMUM_KV,
    MAXIMUM_KV_OF_ANODE,
    MINIMUM_KV,
    MODELS,
)
from ._answer import say
from ._twin_file import HELP as TWIN_HELP
from ._twin_file import twin_file


def add_tube_arguments(parser: argparse.ArgumentParser) -> None:
    """--filter, --anode, --angle, --model, --spectrum-file, --table, --library."""
    parser.add_argument(
        "--filter",
        action="append",
        default=[],
        metavar="MATERIAL:MM",
        dest="filters",
        help="layer in the beam, repeatable, several also joined by + (Cu:0.05, air:1000)",
    )
    parser.add_argument(
        "--anode",
        default=DEFAULT_ANODE,
        metavar="ELEMENT",
        help=f"one of {', '.join(MAXIMUM_KV_OF_ANODE)} (default {DEFAULT_ANODE})",
    )
    parser.add_argument(
        "--angle", type=float, default=DEFAULT_ANGLE_DEG, metavar="DEG", help="anode angle (default %(default)g)"
    )
    parser.add_argument(
        "--model", default=DEFAULT_MODEL, help=f"SpekPy's model, {' or '.join(MODELS)} (default %(default)s)"
    )
    parser.add_argument(
        "--spectrum-file", metavar="FILE", help="a measured spectrum (two columns: keV, fluence) in place of the tube"
    )
    parser.add_argument(
        "--table", default="xraylib", help=f"attenuation data: {', '.join(TABLES)} (default %(default)s)"
    )
    parser.add_argument(
        "--library", action="append", default=[], metavar="FILE", help="your own materials (TOML), repeatable"
    )


def add_detector_arguments(parser: argparse.ArgumentParser) -> None:
    """--scintillator, --cover, --counting."""
    parser.add_argument(
        "--scintillator",
        action="append",
        default=[],
        metavar="MATERIAL:MM",
        help=f"sensitive layer of the detector (default {'+'.join(map(str, DEFAULT_SCINTILLATOR))})",
    )
    parser.add_argument(
        "--cover", action="append", default=[], metavar="MATERIAL:MM", help="layer in front of it, repeatable"
    )
    parser.add_argument("--counting", action="store_true", help="photon-counting instead of energy-integrating")


def add_twin_argument(parser: argparse.ArgumentParser) -> None:
    """--twin, in place of the options that describe a tube."""
    parser.add_argument("--twin", metavar="TWIN", type=twin_file, help=f"a calibrated tube: {TWIN_HELP}")


def twin_of(arguments: argparse.Namespace) -> Mapping[str, Any]:
    """--twin with what it leaves to say, as the arguments of `raytwin.spectrum` and `raytwin.mu`.

    Raises:
        InputError: no tube voltage, or an option that describes another tube.
    """
    if arguments.kv is None:
        raise InputError("--kv", received="nothing", expected="the tube voltage in kV")
    stated = {"anode": DEFAULT_ANODE, "angle": DEFAULT_ANGLE_DEG, "model": DEFAULT_MODEL, "table": "xraylib"}
    given = [f"--{name}" for name, default in stated.items() if getattr(arguments, name) != default]
    given += [f"--{name.replace('_', '-')}" for name in ("spectrum_file", "library") if getattr(arguments, name)]
    if given:
        raise InputError("--twin", received=f"also {', '.join(given)}", expected="a twin or a stated tube, not both")
    return {"twin": arguments.twin, "kV": arguments.kv, "filter": arguments.filters}


def kv_help() -> str:
    """The help line of --kv."""
    return f"tube voltage, {MINIMUM_KV:g} to {MAXIMUM_KV:g} kV (anodes other than W: to 50)"


def tube_of(arguments: argparse.Namespace) -> Mapping[str, Any]:
    """The tube's options as the arguments of `raytwin.spectrum` and `raytwin.mu`."""
    return {
        "kV": arguments.kv,
        "filter": arguments.filters,
        "anode": arguments.anode,
        "anode_angle_deg": arguments.angle,
        "model": arguments.model,
        "spectrum_file": arguments.spectrum_file,
        "table": arguments.table,
        "library": arguments.library,
    }


def tell(warnings: Sequence[str]) -> None:
    """Notes on the beam, to standard error."""
    for text in warnings:
        say(f"note: {text}")
