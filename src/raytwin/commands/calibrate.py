"""Calibrate a twin from measured flat and dark series.

Works from any subset: without kV or instrument the twin has gain, noise and blur but no spectral part, and says so.
Series whose role is `evaluation` are not looked at; `raytwin validate` compares with them. Settings measured more than
once, with others in between, show how steady the line is: predictions of a steady one get narrower intervals.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..results import counted
from ._answer import answer, say

if TYPE_CHECKING:
    from ..acquisition.instrument import Instrument

EXAMPLE = """example:
  raytwin lab -o session.h5 --protocol calibration --seed 1
  raytwin calibrate session.h5 -o twin.h5
  raytwin calibrate monday.h5 tuesday.h5 -o twin.h5
  raytwin calibrate session.h5 -o twin.h5 --spectrum tube_40kV.csv:40 --spectrum tube_90kV.csv:90
  raytwin calibrate --output-table doses.csv --angle 20 -o tube.h5
  raytwin calibrate session.h5 --output-table doses.csv --transmission table.csv -o twin.h5
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin calibrate`."""
    parser.add_argument(
        "acquisition",
        metavar="ACQ",
        type=Path,
        nargs="*",
        help="acquisition file with flats and darks; several are sessions of one line, each with its own darks. Without one a"
        " dose table or a transmission table calibrates the tube alone",
    )
    parser.add_argument("-o", "--output", metavar="TWIN", type=Path, required=True, help="twin file to write")
    parser.add_argument(
        "--spectrum",
        metavar="FILE:kV",
        action="append",
        default=[],
        help="a measured spectrum of the tube (two columns: keV, fluence per keV) in place of the tube model; repeatable."
        " At other voltages the model is scaled as at the nearest ones measured",
    )
    parser.add_argument(
        "--output-table",
        metavar="FILE",
        type=Path,
        help="what a dosimeter read (CSV): kV, filter, mAs or current_mA and exposure_ms, distance_mm, air_kerma_uGy; or"
        " hvl_mm_Al in place of the kerma",
    )
    parser.add_argument(
        "--transmission",
        metavar="FILE",
        type=Path,
        help="what an absorber let through (CSV): kV, filter, transmission; material and thickness_mm where they are known",
    )
    parser.add_argument("--anode", metavar="ELEMENT", help="of a tube alone (default W)")
    parser.add_argument("--angle", metavar="DEG", type=float, help="anode angle of a tube alone (default 12)")
    parser.add_argument("--inherent", metavar="MATERIAL:mm", help="declared layers of a tube alone, joined by +")
    parser.add_argument(
        "--estimator",
        choices=("pairs", "stack"),
        default="pairs",
        help="variances from pairs of successive frames (default: slow drift leaves them alone) or from the stack about its"
        " mean (lag lowers it less)",
    )
    parser.add_argument(
        "--layer",
        choices=("front", "back"),
        help="of a dual-layer panel, by the series' attribute `layer` (default: front)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the posterior's draws (default 0)")
    parser.add_argument("--report", metavar="PAGE.html", type=Path, help="write the answer as a page")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin calibrate`."""
    from ..api._progress import Bar
    from ..api.reports import checked_page, report
    from ..api.twins import calibrate
    from ..files import check_writable

    check_writable(arguments.output)
    if arguments.report is not None:
        checked_page(arguments.report, argument="--report")
    spectra = {}
    for text in arguments.spectrum:
        file, colon, voltage = text.rpartition(":")
        if not colon or not _is_above_zero(voltage):
            raise InputError(
                "--spectrum", received=repr(text), expected="FILE:kV", remedy="for example tube_60kV.csv:60"
            )
        spectra[float(voltage)] = file
    with Bar(only_on_terminal=True) as bar:
        twin = calibrate(
            arguments.acquisition or None,
            output_table=arguments.output_table,
            transmission=arguments.transmission,
            instrument=_instrument(arguments),
            spectra=spectra,
            estimator=arguments.estimator,
            layer=arguments.layer,
            seed=arguments.seed,
            progress=bar,
        )
    twin.save(arguments.output)
    result = twin.to_dict()
    if arguments.report is not None:
        result["report"] = str(report(twin, arguments.report))
    for warning in result["warnings"]:
        say(f"warning: {warning}")
    answer(result, as_json=arguments.json, text=_text(result, arguments.output))
    return 0


def _instrument(arguments: argparse.Namespace) -> "Instrument | None":
    """What the options say of a tube alone; None: nothing.

    Raises:
        InputError: an acquisition states its own tube.
    """
    from ..acquisition.instrument import Instrument
    from ..generator.predictions.predict_settings import as_filters

    options = {name: getattr(arguments, name) for name in ("anode", "angle", "inherent")}
    given = [f"--{name}" for name, value in options.items() if value is not None]
    if given and arguments.acquisition:
        raise InputError(
            ", ".join(given),
            received="an acquisition too",
            expected="one statement of the tube: the acquisition's",
            remedy="leave the option out, or correct the acquisition's instrument",
        )
    if not given:
        return None
    inherent = None if options["inherent"] is None else as_filters(options["inherent"])
    return Instrument(anode=options["anode"], anode_angle_deg=options["angle"], inherent_filtration=inherent)


def _is_above_zero(text: str) -> bool:
    try:
        return float(text) > 0
    except ValueError:
        return False


def _spread(result: dict[str, Any]) -> str:
    """Width of the core, or what of the noise the spread leaves in a pixel where it has none, and the kernel family."""
    spread = result["spread"]
    if result["psf_sigma_px"] is None:
        return f"{spread['family']}: {100 * spread['variance_share']:.2g} % of the quantum variance is left in a pixel"
    return f"{_interval(result['psf_sigma_px'], ' px')} ({spread['family']})"


def _interval(value: dict[str, float] | None, unit: str) -> str:
    if value is None:
        return "not known"
    return f"{value['value']:.4g} ({value['low']:.4g} to {value['high']:.4g}){unit}"


def _table_lines(evidence: dict[str, Any]) -> list[str]:
    """What dose and transmission tables say."""
    lines = []
    output = evidence.get("output_table")
    if output is not None:
        lines.append(
            f"dose table          {counted(output['rows'], 'row')}, {counted(len(output['settings']), 'setting')};"
            f" a reading scatters by"
            f" {output['scatter_percent']:.2g} % ({output['repeats']} repeats)"
        )
    for name, title in (("output_table", "kerma, departure"), ("transmission_table", "transmission, dep.")):
        found = [row["departure_percent"] for row in evidence.get(name, {}).get("departures", ())]
        if found:
            rms = (sum(value**2 for value in found) / len(found)) ** 0.5
            lines.append(f"{title:<19} {rms:.2g} % rms, {max(found, key=abs):+.2g} % at most, from the fit")
    for absorber, materials in evidence.get("transmission_table", {}).get("absorbers", {}).items():
        parts = " and ".join(f"{_interval(value, ' mm')} {material}" for material, value in materials.items())
        lines.append(f"{absorber:<19} as {parts}")
    return lines


def _text(result: dict[str, Any], path: Path) -> str:
    from ..generator.line.twin import BAD_PIXEL_MAP
    from ..generator.twins.twin_answer import BEYOND

    lines = []
    bad_pixels = result[BAD_PIXEL_MAP]
    if bad_pixels is not None:
        lines = [
            f"dark                {_interval(result['dark_DN'], ' DN')}",
            f"read noise          {_interval(result['read_noise_DN'], ' DN')}",
            f"optical spread      {_spread(result)}",
        ]
    lines += [
        f"inherent filtration {_interval(result['inherent_filtration_mm_Al'], f' {BEYOND}')}",
        f"flux scale          {_interval(result['flux_scale'], ' x the spectrum model')}",
    ]
    if bad_pixels is not None:
        lines.append(f"bad pixels          {bad_pixels['count']} ({bad_pixels['share_percent']:.3g} %)")
    lines += _table_lines(result["evidence"])
    for level in result["levels"]:
        voltage = "unknown kV" if level["kV"] is None else f"{level['kV']:g} kV"
        name = f"{voltage} {level['filter']}".strip()
        lines.append(
            f"gain, {name:<18} {level['gain_DN']:.4g} ({level['gain_DN_low']:.4g} to {level['gain_DN_high']:.4g}) DN,"
            f" slope as measured {level['photon_transfer_slope_DN']:.4g} DN"
        )
    open_names = [text.split(":")[0] for text in result["undetermined"] if ":" in text]
    if open_names:
        lines.append(f"left to the priors   {', '.join(open_names)}")
    lines += [
        f"known only together  {text.split(' are known')[0]}" for text in result["undetermined"] if ":" not in text
    ]
    if result["next_measurement"]:
        lines.append(f"next measurement    {result['next_measurement']['text']}")
    lines.append(f"twin written to {path}")
    return "\n".join(lines)
