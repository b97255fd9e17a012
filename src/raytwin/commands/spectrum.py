"""The spectrum of an X-ray tube behind filters, at 1 m in vacuum, and its half-value layers and air kerma.

Nothing is added on the way: a window is a filter (Be:0.8), air is a filter (air:1000).
"""

import argparse
from typing import Any

from ..errors import InputError
from ..materials import material_from_name
from ..spectra import air_kerma_uGy_per_mAs, fluence_per_cm2_mAs, half_value_layer_mm, mean_energy_keV
from ._answer import answer, say
from ._beam import (
    add_tube_arguments,
    add_twin_argument,
    beam_of,
    check_twin_alone,
    describe_beam,
    kv_help,
    layers_of,
    library_of,
    warn_of_soft_beam,
)

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
    if arguments.kv is None and arguments.spectrum_file is None:
        raise InputError("--kv", received="nothing", expected="the tube voltage in kV (or --spectrum-file)")
    library = library_of(arguments)
    spectrum = beam_of(arguments, library)
    aluminium, copper = material_from_name("aluminium"), material_from_name("copper")
    first = {"Al": half_value_layer_mm(spectrum, aluminium), "Cu": half_value_layer_mm(spectrum, copper)}
    second_mm_Al = half_value_layer_mm(spectrum, aluminium, fraction=0.25) - first["Al"]
    result: dict[str, Any] = {
        "energies_keV": spectrum.energies_keV,
        "fluence": spectrum.fluence,
        "fluence_unit": "photons/keV/cm2/mAs at 1 m" if spectrum.absolute else "relative, per keV",
        "bin_width_keV": spectrum.bin_width_keV,
        "mean_energy_keV": mean_energy_keV(spectrum),
        "hvl_mm_Al": first["Al"],
        "hvl_mm_Cu": first["Cu"],
        "second_hvl_mm_Al": second_mm_Al,
        "air_kerma_uGy_per_mAs": air_kerma_uGy_per_mAs(spectrum) if spectrum.absolute else None,
        "photons_per_cm2_mAs": fluence_per_cm2_mAs(spectrum) if spectrum.absolute else None,
        "kV": spectrum.kV,
        "anode": spectrum.anode,
        "anode_angle_deg": spectrum.anode_angle_deg,
        "model": spectrum.model,
        "model_version": spectrum.model_version,
        "filters": [str(layer) for layer in spectrum.filters],
        "attenuation_table": arguments.table,
    }
    lines = [
        describe_beam(spectrum),
        f"mean energy            {result['mean_energy_keV']:.2f} keV",
        f"half-value layers      {first['Al']:.4g} mm Al (second {second_mm_Al:.4g}), {first['Cu']:.4g} mm Cu",
    ]
    if spectrum.absolute:
        lines += [
            f"air kerma              {result['air_kerma_uGy_per_mAs']:.4g} uGy per mAs at 1 m in vacuum",
            f"photons                {result['photons_per_cm2_mAs']:.4g} per cm2 and mAs at 1 m",
        ]
    lines.append("`--json` holds the spectrum itself")
    warn_of_soft_beam(spectrum)
    answer(result, as_json=arguments.json, text="\n".join(lines))
    return 0


def _of_twin(arguments: argparse.Namespace) -> int:
    """Print the spectrum of a calibrated tube, with intervals."""
    from ..generator.tube_twin import predict_spectrum
    from ..generator.twin_io import read_any_twin

    check_twin_alone(arguments)
    filters = layers_of(arguments.filters, library_of(arguments))
    found = predict_spectrum(read_any_twin(arguments.twin), kV=arguments.kv, filters=filters)
    spectrum, intervals = found.spectrum, found.intervals()
    result: dict[str, Any] = {
        "energies_keV": spectrum.energies_keV,
        "fluence": spectrum.fluence,
        "fluence_unit": "photons/keV/cm2/mAs at 1 m" if spectrum.absolute else "relative, per keV",
        "bin_width_keV": spectrum.bin_width_keV,
        **{name: None if value is None else value["value"] for name, value in intervals.items()},
        "intervals": intervals,
        "photons_per_cm2_mAs": fluence_per_cm2_mAs(spectrum) if spectrum.absolute else None,
        "kV": spectrum.kV,
        "anode": spectrum.anode,
        "anode_angle_deg": spectrum.anode_angle_deg,
        "model": spectrum.model,
        "filters": [str(layer) for layer in spectrum.filters],
        "twin": arguments.twin,
        "extrapolated": found.extrapolated,
        "warnings": list(found.warnings),
    }
    units = {
        "mean_energy_keV": ("mean energy", "keV"),
        "hvl_mm_Al": ("half-value layer", "mm Al"),
        "hvl_mm_Cu": ("half-value layer", "mm Cu"),
        "air_kerma_uGy_per_mAs": ("air kerma", "uGy per mAs at 1 m in vacuum"),
    }
    lines = [f"{spectrum.kV:g} kV of {arguments.twin}" + "".join(f" + {layer}" for layer in spectrum.filters)]
    for name, (title, unit) in units.items():
        value = intervals[name]
        text = (
            "not known" if value is None else f"{value['value']:.4g} ({value['low']:.4g} to {value['high']:.4g}) {unit}"
        )
        lines.append(f"{title:<22} {text}")
    lines.append("`--json` holds the spectrum itself")
    for warning in found.warnings:
        say(f"warning: {warning}")
    answer(result, as_json=arguments.json, text="\n".join(lines))
    return 0
