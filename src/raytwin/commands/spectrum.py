"""The spectrum of an X-ray tube behind filters, at 1 m in vacuum, and its half-value layers and air kerma.

Nothing is added on the way: a window is a filter (Be:0.8), air is a filter (air:1000).
"""

import argparse

from ..api.beams import describe_beam, spectrum
from ._answer import answer
from ._beam import add_tube_arguments, kv_help, tell, tube_of

EXAMPLE = """example:
  raytwin spectrum --kv 90 --filter Be:0.8 --filter Cu:0.05
  raytwin spectrum --kv 40 --filter Al:2.5 --angle 20 --json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `raytwin spectrum`."""
    parser.add_argument("--kv", type=float, metavar="KV", help=kv_help())
    add_tube_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the spectrum."""
    found = spectrum(**tube_of(arguments))
    lines = [
        describe_beam(found.spectrum),
        f"mean energy            {found.mean_energy_keV:.2f} keV",
        f"half-value layers      {found.hvl_mm_Al:.4g} mm Al (second {found.second_hvl_mm_Al:.4g}), {found.hvl_mm_Cu:.4g} mm Cu",
    ]
    if found.spectrum.absolute:
        lines += [
            f"air kerma              {found.air_kerma_uGy_per_mAs:.4g} uGy per mAs at 1 m in vacuum",
            f"photons                {found.photons_per_cm2_mAs:.4g} per cm2 and mAs at 1 m",
        ]
    lines.append("`--json` holds the spectrum itself")
    tell(found.warnings)
    answer(found.to_dict(), as_json=arguments.json, text="\n".join(lines))
    return 0
