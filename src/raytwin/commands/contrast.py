"""Contrast of a foreign object in a product, and how far it stands out of the noise, at a pair of settings or over a map.

Delta R is the shift of the quotient M_low / M_high that the object makes, for flat slabs, without scatter. Without a
twin the tube is SpekPy's behind 1 mm Al with its own output, and the electronics are silent, unless the options say
otherwise. In a map, kV changes at the power (or current) of --low and --high; a mapped filter stands in both beams.
"""

import argparse
import math
from pathlib import Path
from typing import Any

from ..api._progress import Bar
from ..api.beams import MOST_VALUES, ContrastMap, contrast
from ..errors import InputError
from ..files import whole_file
from ._answer import answer, say
from ._twin_file import HELP, twin_file

EXAMPLE = """examples:
  raytwin contrast --product chicken_breast:20 --object bone_cortical_icru44:1 --object-pixels 100 \\
    --low kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05 --high kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05
  raytwin contrast --twin twin.h5 --product water:30 --object Al:0.5 --map-kv-low 35:60:5 --map-kv-high 70:120:10 \\
    --low kv=40,power_w=40,exposure_ms=20 --high kv=90,power_w=45,exposure_ms=20 --plot map.png
  raytwin contrast --product water:30 --object Al:0.5 --map-kv-high 70:120:10 --map-filter "Cu:0.05;Cu:0.1;Al:1" \\
    --low kv=40,power_w=40,exposure_ms=20 --high kv=90,power_w=45,exposure_ms=20 --json"""

# option -> (field of UncalibratedLine, unit for the help, meaning)
_LINE_OPTIONS = {
    "angle": ("anode_angle_deg", "DEG", "anode angle"),
    "swank": ("swank", "A", "Swank factor of the scintillator's light"),
    "output_scale": ("output_scale", "FACTOR", "tube output over SpekPy's"),
    "source_detector_mm": ("source_detector_mm", "MM", "source-detector distance"),
    "pixel_mm": ("pixel_mm", "MM", "pixel pitch"),
    "spread_px": ("psf_sigma_px", "PX", "sigma of the optical spread"),
    "read_noise_kev": ("read_noise_keV", "KEV", "electronic noise of a frame as energy absorbed"),
}
_LAYER_OPTIONS = {"inherent": "layers of the tube", "scintillator": "sensitive layers", "cover": "layers before them"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `raytwin contrast`."""
    add = parser.add_argument
    add("--product", metavar="MATERIAL:mm", required=True, help="product and its thickness, mm")
    add("--object", metavar="MATERIAL:mm", required=True, help="foreign object and its thickness, mm")
    add(
        "--low",
        metavar="SETTING",
        required=True,
        help="low tube voltage: kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05",
    )
    add("--high", metavar="SETTING", required=True, help="high tube voltage, in the same words")
    add("--object-pixels", type=int, default=100, help="pixels that the object covers, as a disc (default %(default)s)")
    add("--displaces", action="store_true", help="the object takes the product's place instead of adding to it")
    add("--map-kv-low", metavar="FROM:TO:STEP", help="map over the low tube voltage")
    add("--map-kv-high", metavar="FROM:TO:STEP", help="map over the high tube voltage")
    add("--map-filter", metavar="LAYERS;LAYERS", help="map over filters, the same in both beams; `none` is no filter")
    add("--plot", metavar="PNG", type=Path, help="draw the map")
    add("--twin", metavar="TWIN", type=twin_file, help=f"{HELP}; without it the line is as the options below state it")
    line = parser.add_argument_group("a line without a twin")
    line.add_argument("--anode", metavar="ELEMENT", help="anode (default W)")
    for option, (_, unit, meaning) in _LINE_OPTIONS.items():
        line.add_argument(f"--{option.replace('_', '-')}", type=float, metavar=unit, help=meaning)
    for option, meaning in _LAYER_OPTIONS.items():
        line.add_argument(f"--{option}", metavar="MATERIAL:mm", help=f"{meaning}, joined by +")
    line.add_argument("--counting", action="store_true", default=None, help="photon-counting detector")
    add("--json", action="store_true", help="print the answer as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Run `raytwin contrast`."""
    axes = _axes_of(arguments)
    if arguments.plot is not None and not axes:
        raise InputError("--plot", received="no map", expected="two of --map-kv-low, --map-kv-high, --map-filter")
    with Bar(only_on_terminal=True, unit="row") as bar:
        found = contrast(
            product=arguments.product,
            foreign_object=arguments.object,
            low=arguments.low,
            high=arguments.high,
            twin=arguments.twin,
            object_pixels=arguments.object_pixels,
            displaces=arguments.displaces,
            progress=bar,
            **axes,
            **_line_of(arguments),
        )
    result = found.to_dict()
    if isinstance(found, ContrastMap):
        text = _map_text(result)
        if arguments.plot is not None:
            with whole_file(arguments.plot) as temporary:
                _figure(found).savefig(temporary, format="png", dpi=150)
            result["plot"] = arguments.plot
    else:
        text = _text(found.contrast, result)
    for warning in result["warnings"]:
        say(f"warning: {warning}")
    answer(result, as_json=arguments.json, text=text)
    return 0


def _line_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the options state of a line without a twin."""
    names = {option: field for option, (field, _, _) in _LINE_OPTIONS.items()}
    names |= {option: option for option in (*_LAYER_OPTIONS, "anode", "counting")}
    return {
        field: getattr(arguments, option) for option, field in names.items() if getattr(arguments, option) is not None
    }


def _axes_of(arguments: argparse.Namespace) -> dict[str, list[Any]]:
    axes: dict[str, list[Any]] = {}
    for name, option in (("kV_low", "map_kv_low"), ("kV_high", "map_kv_high")):
        text = getattr(arguments, option)
        if text is not None:
            axes[name] = _range(f"--{option.replace('_', '-')}", text)
    if arguments.map_filter is not None:
        axes["filters"] = [part.strip() for part in arguments.map_filter.split(";") if part.strip()]
    return axes


def _range(option: str, text: str) -> list[float]:
    try:
        first, last, step = (float(part) for part in text.split(":"))
        fits = all(map(math.isfinite, (first, last, step))) and 0 < first <= last and step > 0
    except ValueError:
        fits = False
    if not fits:
        raise InputError(option, received=repr(text), expected="FROM:TO:STEP in kV", remedy="for example 35:60:5")
    count = math.floor((last - first) / step + 1e-9) + 1
    if count > MOST_VALUES:
        raise InputError(option, received=f"{count} values", expected=f"at most {MOST_VALUES}")
    return [round(first + index * step, 9) for index in range(count)]


def _text(found: Any, result: dict[str, Any]) -> str:
    lines = [f"{result['object']} mm in {result['product']} mm, {found.object_pixels} pixels"]
    for name, channel in (("low", found.low), ("high", found.high)):
        lines.append(f"{name:<5} {channel.setting}")
        lines.append(
            f"      M {channel.M_product:.4f} around, {channel.M_object:.4f} behind the object"
            f" (+- {channel.sd_M_object:.4f} a pixel); open {channel.open_signal_DN:.5g} {channel.open_signal_unit}"
        )
        lines.append(
            f"      mu_eff product {channel.mu_eff_product_per_mm:.5g} /mm, object {channel.mu_eff_object_per_mm:.5g} /mm"
        )
    delta = found.delta_R
    if delta is not None:
        lines.append(f"Delta R            {delta.value:.5f} ({delta.low:.5f} to {delta.high:.5f})")
        lines.append(f"  as published     {found.delta_R_as_published:.5f} (coefficients of thin objects)")
        lines.append(f"noise, one pixel   {found.sd_pixel:.5f}    contrast to noise {found.cnr_pixel:.3f}")
        lines.append(f"noise, the object  {found.sd_object:.5f}    contrast to noise {found.cnr_object:.3f}")
    else:
        lines.append("Delta R and noise  none: the detector saturates")
    return "\n".join(lines)


def _map_text(result: dict[str, Any]) -> str:
    rows, columns = result["rows"], result["columns"]
    lines = []
    for name, title in (("delta_R", "Delta R"), ("cnr_object", "contrast to noise of the object")):
        lines.append(f"{title}: {rows['axis']} down, {columns['axis']} across")
        lines.append(" " * 14 + "".join(f"{value!s:>12}" for value in columns["values"]))
        for label, row in zip(rows["values"], result[name], strict=True):
            cells = ("none" if value is None else f"{value:.4g}" for value in row)
            lines.append(f"{label!s:>14}" + "".join(f"{cell:>12}" for cell in cells))
    best = result["best"]
    if best is None:
        lines.append("no contrast to noise: the detector saturates at every pair")
    else:
        lines.append(f"best contrast to noise {best['cnr_object']:.4g}: {best['low']} with {best['high']}")
    return "\n".join(lines)


def _figure(found: ContrastMap) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, what in zip(figure.subplots(1, 2), ("delta_R", "cnr_object"), strict=True):
        found.plot(ax=axes, what=what)
    pixels = found.grid[0][0].object_pixels
    figure.suptitle(f"{found.foreign_object} mm in {found.product} mm, {pixels} pixels", fontsize=10)
    return figure
