"""Options that describe a beam and its detector, shared by the commands that take them."""

import argparse
from collections.abc import Sequence

from ..acquisition.setting import Filter, filter_from_text
from ..errors import InputError
from ..materials import TABLES, Library, library_from_files, material_from_name, nist_identifier
from ..spectra import (
    DEFAULT_ANGLE_DEG,
    DEFAULT_ANODE,
    DEFAULT_MODEL,
    DEFAULT_SCINTILLATOR,
    MAXIMUM_KV,
    MAXIMUM_KV_OF_ANODE,
    MINIMUM_KV,
    MODELS,
    Response,
    Spectrum,
    detector_response,
    filtered_spectrum,
    spectrum_from_file,
    tube_spectrum,
)
from ._answer import say
from ._twin_file import HELP as TWIN_HELP
from ._twin_file import twin_file

SOFT_KEV = 12.0
SOFT_SHARE = 0.1


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


def check_twin_alone(arguments: argparse.Namespace) -> None:
    """Refuse what a calibrated tube states itself.

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


def kv_help() -> str:
    """The help line of --kv."""
    return f"tube voltage, {MINIMUM_KV:g} to {MAXIMUM_KV:g} kV (anodes other than W: to 50)"


def library_of(arguments: argparse.Namespace) -> Library:
    """The materials that the command knows."""
    return library_from_files(arguments.library)


def layers_of(texts: Sequence[str], library: Library) -> tuple[Filter, ...]:
    """Layers from option values; each name is looked up, a NIST name with commas by its plain spelling."""
    layers = []
    for text in texts:
        for part in text.split("+"):
            name, colon, thickness = part.rpartition(":")
            plain = nist_identifier(name) if colon and "," in name else None
            layer = filter_from_text(f"{plain}:{thickness}" if plain else part)
            material_from_name(layer.material, library=library)
            layers.append(layer)
    return tuple(layers)


def beam_of(arguments: argparse.Namespace, library: Library) -> Spectrum:
    """The spectrum that the options describe."""
    layers = layers_of(arguments.filters, library)
    if arguments.spectrum_file is not None:
        measured = spectrum_from_file(arguments.spectrum_file, kV=arguments.kv)
        return filtered_spectrum(measured, layers, table=arguments.table, library=library)
    return tube_spectrum(
        kV=arguments.kv,
        filters=layers,
        anode=arguments.anode,
        anode_angle_deg=arguments.angle,
        model=arguments.model,
        table=arguments.table,
        library=library,
    )


def detector_of(arguments: argparse.Namespace, spectrum: Spectrum, library: Library) -> Response:
    """The detector that the options describe, on the spectrum's energies."""
    return detector_response(
        energies_keV=spectrum.energies_keV,
        scintillator=layers_of(arguments.scintillator, library) or DEFAULT_SCINTILLATOR,
        cover=layers_of(arguments.cover, library),
        counting=arguments.counting,
        table=arguments.table,
        library=library,
    )


def warn_of_soft_beam(spectrum: Spectrum) -> None:
    """Say so where photons that no real window passes make up much of the beam's energy."""
    energy = spectrum.energies_keV * spectrum.fluence
    share = float(energy[spectrum.energies_keV < SOFT_KEV].sum() / energy.sum())
    if share > SOFT_SHARE and spectrum.anode is not None:
        say(
            f"note: {100 * share:.0f} % of the beam's energy lies below {SOFT_KEV:g} keV, which most tube windows stop;"
            " name the inherent filtration, for example --filter Be:0.8 --filter Al:1"
        )


def describe_beam(spectrum: Spectrum) -> str:
    """One line about where a spectrum comes from."""
    behind = " behind " + " + ".join(f"{layer.thickness_mm:g} mm {layer.material}" for layer in spectrum.filters)
    if spectrum.anode is None:
        return f"{spectrum.model}{behind if spectrum.filters else ''}"
    return (
        f"{spectrum.kV:g} kV, {spectrum.anode} anode at {spectrum.anode_angle_deg:g} degrees, {spectrum.model}"
        f" ({spectrum.model_version}){behind if spectrum.filters else ', unfiltered'}"
    )
