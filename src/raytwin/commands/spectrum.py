"""The spectrum of an X-ray tube behind filters, at 1 m in vacuum, and its half-value layers and air kerma.

Nothing is added on the way: a window is a filter (Be:0.8), air is a filter (air:1000).
"""

import argparse

from ..api.beams import describe_beam, spectrum
from ._answer import answer, say
from ._beam import add_tube_arguments, add_twin_argument, kv_help, tell, tube_of, twin_of

EXAMPLE = """example:
  raytwin spectrum --kv 90 --filter Be:0.8 --filter Cu:0.05
  raytwin spectrum --kv 40 --filter Al:2.5 --angle 20 --json
  raytwin spectrum --twin tube.h5 --kv 60 --filter Al:1"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `raytwin spectrum`."""
    parser.add_argument("--kv", type=float, metavar="KV", help=kv_help())
    add_tube_arguments(parser)
    add_twin_argument(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the spectrum."""
    if arguments.twin is not None:
        return _of_twin(arguments)
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


def _of_twin(arguments: argparse.Namespace) -> int:
    """Print the spectrum of a calibrated tube, with intervals."""
    found = spectrum(**twin_of(arguments))
    units = {
        "mean_energy_keV": ("mean energy", "keV"),
        "hvl_mm_Al": ("half-value layer", "mm Al"),
        "hvl_mm_Cu": ("half-value layer", "mm Cu"),
        "air_kerma_uGy_per_mAs": ("air kerma", "uGy per mAs at 1 m in vacuum"),
    }
    beam, intervals = found.spectrum, found.intervals or {}
    lines = [f"{beam.kV:g} kV of {arguments.twin}" + "".join(f" + {layer}" for layer in beam.filters)]
    for name, (title, unit) in units.items():
        value = intervals[name]
        text = (
            "not known" if value is None else f"{value['value']:.4g} ({value['low']:.4g} to {value['high']:.4g}) {unit}"
        )
        lines.append(f"{title:<22} {text}")
    lines.append("`--json` holds the spectrum itself")
    for warning in found.warnings:
        say(f"warning: {warning}")
    answer(found.to_dict(), as_json=arguments.json, text="\n".join(lines))
    return 0
