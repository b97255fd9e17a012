"""The attenuation of a material: effective, in a beam and for a detector (Eq. 4), or at one photon energy.

Two numbers: the limit of a thin object, sum(w mu) / sum(w), and what is measured through a thickness L,
-ln(sum(w exp(-mu L)) / sum(w)) / L, which is lower because the beam hardens. w = E D(E) N(E), without E for a
photon-counting detector.
"""

import argparse

from ..api.beams import mu
from ._answer import answer
from ._beam import add_detector_arguments, add_tube_arguments, add_twin_argument, kv_help, tell, tube_of, twin_of

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
    found = mu(
        arguments.material,
        energy_keV=arguments.energy_kev,
        thickness_mm=arguments.thickness_mm,
        scintillator=arguments.scintillator,
        cover=arguments.cover,
        counting=arguments.counting,
        **(tube_of(arguments) if arguments.twin is None else twin_of(arguments)),
    )
    lines = [f"{found.material.name}, {found.material.density_g_cm3:.4g} g/cm3, {found.where}"]
    if found.energy_keV is not None:
        lines.append(f"mu       {found.mu_eff_per_mm:.6g} /mm ({found.mass_attenuation_cm2_g:.6g} cm2/g)")
    else:
        intervals = found.intervals or {}
        thin, thick = (_ends(intervals.get(f"mu_eff{name}_per_mm")) for name in ("", "_at_thickness"))
        lines.append(f"mu_eff   {found.mu_eff_per_mm:.6g}{thin} /mm (limit of a thin object)")
        if found.mu_eff_at_thickness_per_mm is not None:
            lines.append(
                f"mu_eff   {found.mu_eff_at_thickness_per_mm:.6g}{thick} /mm (measured through {found.thickness_mm:g} mm)"
            )
    tell(found.warnings)
    answer(found.to_dict(), as_json=arguments.json, text="\n".join(lines))
    return 0


def _ends(interval: dict[str, float] | None) -> str:
    return "" if interval is None else f" ({interval['low']:.6g} to {interval['high']:.6g})"
