"""The attenuation of a material: effective, in a beam and for a detector (Eq. 4), or at one photon energy.

Two numbers: the limit of a thin object, sum(w mu) / sum(w), and what is measured through a thickness L,
-ln(sum(w exp(-mu L)) / sum(w)) / L, which is lower because the beam hardens. w = E D(E) N(E), without E for a
photon-counting detector.
"""

import argparse
from typing import Any

from ..errors import InputError
from ..materials import Material, mass_attenuation_cm2_g, material_from_name, mu_per_mm
from ..spectra import DEFAULT_SCINTILLATOR, detector_response, effective_mu_per_mm
from ._answer import answer
from ._beam import (
    add_detector_arguments,
    add_tube_arguments,
    add_twin_argument,
    beam_of,
    check_twin_alone,
    describe_beam,
    detector_of,
    kv_help,
    layers_of,
    library_of,
    warn_of_soft_beam,
)

EXAMPLE = """example:
  raytwin mu chicken_breast --kv 40 --filter Cu:0.05 --thickness-mm 20
  raytwin mu Al --energy-kev 65
  raytwin mu "Glass, Plate" --kv 90 --scintillator Gd2O2S@4.5:0.3 --json
  raytwin mu PMMA --twin tube.h5 --kv 60 --filter Al:1 --thickness-mm 20"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `raytwin mu`."""
    parser.add_argument("material", metavar="MATERIAL", help="library id or alias, element, FORMULA@DENSITY, NIST name")
    parser.add_argument("--kv", type=float, metavar="KV", help=kv_help())
    parser.add_argument(
        "--energy-kev", type=float, metavar="E", help="one photon energy instead of a beam, 1 to 500 keV"
    )
    parser.add_argument(
        "--thickness-mm", type=float, metavar="L", help="also the value measured through this thickness"
    )
    add_tube_arguments(parser)
    add_detector_arguments(parser)
    add_twin_argument(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the attenuation."""
    library = library_of(arguments)
    material = material_from_name(arguments.material, library=library)
    has_beam = arguments.kv is not None or arguments.spectrum_file is not None
    if has_beam == (arguments.energy_kev is not None):
        raise InputError(
            "--kv, --energy-kev",
            received="both" if has_beam else "neither",
            expected="a beam (--kv, or --spectrum-file) or one energy (--energy-kev)",
        )
    thickness = arguments.thickness_mm
    if thickness is not None and not 0 <= thickness < float("inf"):
        raise InputError("--thickness-mm", received=f"{thickness} mm", expected="a finite thickness of 0 mm or more")
    result: dict[str, Any] = {
        "material": material.name,
        "density_g_cm3": material.density_g_cm3,
        "source": material.source,
        "mass_fractions": dict(material.mass_fractions),
        "attenuation_table": arguments.table,
        "thickness_mm": thickness,
    }
    if arguments.twin is not None:
        where, lines = _of_twin(arguments, material, result)
    elif arguments.energy_kev is not None:
        mu = float(mu_per_mm(material, arguments.energy_kev, table=arguments.table))
        result["energy_keV"] = arguments.energy_kev
        result["mass_attenuation_cm2_g"] = float(
            mass_attenuation_cm2_g(material, arguments.energy_kev, table=arguments.table)
        )
        result["mu_eff_per_mm"] = mu
        result["mu_eff_at_thickness_per_mm"] = None if thickness is None else mu
        where = f"at {arguments.energy_kev:g} keV"
        lines = [f"mu       {mu:.6g} /mm ({result['mass_attenuation_cm2_g']:.6g} cm2/g)"]
    else:
        spectrum = beam_of(arguments, library)
        response = detector_of(arguments, spectrum, library)
        thin = float(effective_mu_per_mm(material, spectrum=spectrum, response=response, table=arguments.table))
        result["mu_eff_per_mm"] = thin
        result["mu_eff_at_thickness_per_mm"] = None
        where = f"in {describe_beam(spectrum)}"
        lines = [f"mu_eff   {thin:.6g} /mm (limit of a thin object)"]
        if thickness is not None:
            thick = float(
                effective_mu_per_mm(
                    material, spectrum=spectrum, response=response, thickness_mm=thickness, table=arguments.table
                )
            )
            result["mu_eff_at_thickness_per_mm"] = thick
            lines.append(f"mu_eff   {thick:.6g} /mm (measured through {thickness:g} mm)")
        warn_of_soft_beam(spectrum)
    head = f"{material.name}, {material.density_g_cm3:.4g} g/cm3, {where}"
    answer(result, as_json=arguments.json, text="\n".join([head, *lines]))
    return 0


def _of_twin(arguments: argparse.Namespace, material: Material, result: dict[str, Any]) -> tuple[str, list[str]]:
    """Attenuation in a calibrated tube's beam, put into `result`; where it holds, and lines of text."""
    from ..generator.tube_twin import TubeTwin, predict_effective_mu
    from ..generator.twin_io import read_any_twin
    from ..spectra import energy_grid_keV

    if arguments.energy_kev is not None:
        raise InputError("--energy-kev", received="also --twin", expected="a beam or one energy, not both")
    check_twin_alone(arguments)
    library = library_of(arguments)
    twin = read_any_twin(arguments.twin)
    response = None
    if isinstance(twin, TubeTwin) or arguments.scintillator or arguments.cover or arguments.counting:
        # the voltage may be wrong by some per cent, so the beam may reach beyond it
        response = detector_response(
            energies_keV=energy_grid_keV(1.1 * arguments.kv),
            scintillator=layers_of(arguments.scintillator, library) or DEFAULT_SCINTILLATOR,
            cover=layers_of(arguments.cover, library),
            counting=arguments.counting,
        )
    asked: dict[str, Any] = {
        "material": arguments.material,
        "kV": arguments.kv,
        "filters": layers_of(arguments.filters, library),
        "response": response,
    }
    thin = predict_effective_mu(twin, **asked)
    result["mu_eff_per_mm"] = thin.value
    result["mu_eff_at_thickness_per_mm"] = None
    result["intervals"] = {"mu_eff_per_mm": thin.as_dict(), "mu_eff_at_thickness_per_mm": None}
    result["twin"] = arguments.twin
    lines = [f"mu_eff   {thin.value:.6g} ({thin.low:.6g} to {thin.high:.6g}) /mm (limit of a thin object)"]
    if arguments.thickness_mm is not None:
        thick = predict_effective_mu(twin, thickness_mm=arguments.thickness_mm, **asked)
        result["mu_eff_at_thickness_per_mm"] = thick.value
        result["intervals"]["mu_eff_at_thickness_per_mm"] = thick.as_dict()
        lines.append(
            f"mu_eff   {thick.value:.6g} ({thick.low:.6g} to {thick.high:.6g}) /mm"
            f" (measured through {arguments.thickness_mm:g} mm)"
        )
    return f"{arguments.kv:g} kV of {arguments.twin}", lines
