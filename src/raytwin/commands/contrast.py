"""Contrast of a foreign object in a product, and how far it stands out of the noise, at a pair of settings or over a map.

Delta R is the shift of the quotient M_low / M_high that the object makes, for flat slabs, without scatter. Without a
twin the tube is SpekPy's behind 1 mm Al with its own output, and the electronics are silent, unless the options say
otherwise. In a map, kV changes at the power (or current) of --low and --high; a mapped filter stands in both beams.
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..acquisition.setting import Setting, filter_from_text, filters_from_text, setting_from_text, text_from_filters
from ..errors import InputError
from ..files import whole_file
from ._answer import answer, say
from ._twin_file import HELP, twin_file

if TYPE_CHECKING:
    from ..generator.contrast import Contrast, UncalibratedLine
    from ..generator.twin import Twin

EXAMPLE = """examples:
  raytwin contrast --product chicken_breast:20 --object bone_cortical_icru44:1 --object-pixels 100 \\
    --low kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05 --high kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05
  raytwin contrast --twin twin.h5 --product water:30 --object Al:0.5 --map-kv-low 35:60:5 --map-kv-high 70:120:10 \\
    --low kv=40,power_w=40,exposure_ms=20 --high kv=90,power_w=45,exposure_ms=20 --plot map.png
  raytwin contrast --product water:30 --object Al:0.5 --map-kv-high 70:120:10 --map-filter "Cu:0.05;Cu:0.1;Al:1" \\
    --low kv=40,power_w=40,exposure_ms=20 --high kv=90,power_w=45,exposure_ms=20 --json"""

_AXES = ("kv_low", "kv_high", "filter")
_MOST_VALUES = 100
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
_OF_TUBE = ("anode", "anode_angle_deg", "inherent", "output_scale")
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
    from tqdm import tqdm

    from ..generator.contrast import compute_contrast_map, predict_contrast
    from ..materials import material_from_name

    low, high = setting_from_text(arguments.low), setting_from_text(arguments.high)
    slabs: dict[str, Any] = {
        "product": filter_from_text(arguments.product),
        "foreign_object": filter_from_text(arguments.object),
        "object_pixels": arguments.object_pixels,
        "displaces": arguments.displaces,
    }
    for layer in (slabs["product"], slabs["foreign_object"], *low.filters, *high.filters):
        material_from_name(layer.material)
    axes = _axes_of(arguments)
    if arguments.plot is not None and not axes:
        raise InputError("--plot", received="no map", expected="two of --map-kv-low, --map-kv-high, --map-filter")
    line = _line_of(arguments)
    result: dict[str, Any] = {
        "product": str(slabs["product"]),
        "object": str(slabs["foreign_object"]),
        "object_pixels": arguments.object_pixels,
        "displaces": arguments.displaces,
        "twin": arguments.twin,
    }
    if not axes:
        found = predict_contrast(line, low=low, high=high, **slabs)
        result |= found.as_dict()
        warnings = found.warnings
        text = _text(found, result)
    else:
        rows, columns = axes
        pairs = [[_at(_at((low, high), rows, row), columns, column) for column in axes[columns]] for row in axes[rows]]
        bar = tqdm(pairs, desc="settings", unit="row", disable=None)
        grid = compute_contrast_map(line, bar, **slabs)
        warnings = tuple(dict.fromkeys(warning for row in grid for one in row for warning in one.warnings))
        result |= _map_answer(axes, grid)
        text = _map_text(result)
        if arguments.plot is not None:
            with whole_file(arguments.plot) as temporary:
                _figure(result).savefig(temporary, format="png", dpi=150)
            result["plot"] = arguments.plot
    result["warnings"] = list(warnings)
    for warning in warnings:
        say(f"warning: {warning}")
    answer(result, as_json=arguments.json, text=text)
    return 0


def _line_of(arguments: argparse.Namespace) -> "Twin | UncalibratedLine":
    from ..generator.contrast import UncalibratedLine
    from ..generator.tube_twin import TubeTwin
    from ..generator.twin_io import read_any_twin
    from ..materials import material_from_name

    given: dict[str, Any] = {}
    for option, (field, _, _) in _LINE_OPTIONS.items():
        if getattr(arguments, option) is not None:
            given[field] = getattr(arguments, option)
    for option in _LAYER_OPTIONS:
        if getattr(arguments, option) is not None:
            given[option] = filters_from_text(getattr(arguments, option))
            for layer in given[option]:
                material_from_name(layer.material)
    for option in ("anode", "counting"):
        if getattr(arguments, option) is not None:
            given[option] = getattr(arguments, option)
    if arguments.twin is None:
        return UncalibratedLine(**given)
    twin = read_any_twin(arguments.twin)
    if isinstance(twin, TubeTwin):
        stated = [name for name in _OF_TUBE if name in given]
        if stated:
            raise InputError(
                "--twin", received=f"also {', '.join(stated)}", expected="a calibrated tube or a stated one, not both"
            )
        return UncalibratedLine(**given, tube=twin)
    if given:
        raise InputError("--twin", received=f"also {', '.join(given)}", expected="a twin or a stated line, not both")
    return twin


def _axes_of(arguments: argparse.Namespace) -> dict[str, list[Any]]:
    axes: dict[str, list[Any]] = {}
    for name in ("kv_low", "kv_high"):
        text = getattr(arguments, f"map_{name}")
        if text is not None:
            axes[name] = _range(f"--map-{name.replace('_', '-')}", text)
    if arguments.map_filter is not None:
        from ..materials import material_from_name

        stacks = [part.strip() for part in arguments.map_filter.split(";") if part.strip()]
        axes["filter"] = [() if part == "none" else filters_from_text(part) for part in stacks]
        for layer in (layer for stack in axes["filter"] for layer in stack):
            material_from_name(layer.material)
    if len(axes) not in (0, 2):
        raise InputError(
            "map",
            received=f"{len(axes)} axes",
            expected="exactly two of --map-kv-low, --map-kv-high and --map-filter, or none",
        )
    for name, values in axes.items():
        if not 1 <= len(values) <= _MOST_VALUES:
            raise InputError(
                f"--map-{name.replace('_', '-')}", received=f"{len(values)} values", expected=f"1 to {_MOST_VALUES}"
            )
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
    if count > _MOST_VALUES:
        raise InputError(option, received=f"{count} values", expected=f"at most {_MOST_VALUES}")
    return [round(first + index * step, 9) for index in range(count)]


def _at(pair: tuple[Setting, Setting], axis: str, value: Any) -> tuple[Setting, Setting]:
    low, high = pair
    if axis == "filter":
        return replace(low, filters=value), replace(high, filters=value)
    if axis == "kv_low":
        return _at_kV(low, value), high
    return low, _at_kV(high, value)


def _at_kV(setting: Setting, kV: float) -> Setting:
    """The same power where it was given (a current beside it follows), else the same current."""
    return replace(setting, kV=kV, current_mA=None if setting.power_W is not None else setting.current_mA)


def _text(found: "Contrast", result: dict[str, Any]) -> str:
    lines = [f"{result['object']} mm in {result['product']} mm, {found.object_pixels} pixels"]
    for name, channel in (("low", found.low), ("high", found.high)):
        lines.append(f"{name:<5} {channel.setting}")
        lines.append(
            f"      M {channel.M_product:.4f} around, {channel.M_object:.4f} behind the object"
            f" (+- {channel.sd_M_object:.4f} a pixel); open {channel.open_signal_DN:.5g} DN"
        )
        lines.append(
            f"      mu_eff product {channel.mu_eff_product_per_mm:.5g} /mm, object {channel.mu_eff_object_per_mm:.5g} /mm"
        )
    delta = found.delta_R
    lines.append(f"Delta R            {delta.value:.5f} ({delta.low:.5f} to {delta.high:.5f})")
    lines.append(f"  as published     {found.delta_R_as_published:.5f} (coefficients of thin objects)")
    lines.append(f"noise, one pixel   {found.sd_pixel:.5f}    contrast to noise {found.cnr_pixel:.3f}")
    lines.append(f"noise, the object  {found.sd_object:.5f}    contrast to noise {found.cnr_object:.3f}")
    return "\n".join(lines)


def _label(axis: str, value: Any) -> Any:
    return (text_from_filters(value) or "none") if axis == "filter" else value


def _map_answer(axes: dict[str, list[Any]], grid: "tuple[tuple[Contrast, ...], ...]") -> dict[str, Any]:
    rows, columns = axes
    best = max((one for row in grid for one in row), key=lambda one: one.cnr_object)
    result: dict[str, Any] = {
        "rows": {"axis": rows, "values": [_label(rows, value) for value in axes[rows]]},
        "columns": {"axis": columns, "values": [_label(columns, value) for value in axes[columns]]},
    }
    values = {
        "delta_R": [[one.delta_R.value for one in row] for row in grid],
        "cnr_pixel": [[one.cnr_pixel for one in row] for row in grid],
        "cnr_object": [[one.cnr_object for one in row] for row in grid],
    }
    result |= values
    result["best"] = {
        "low": str(best.low.setting),
        "high": str(best.high.setting),
        "delta_R": best.delta_R.value,
        "cnr_object": best.cnr_object,
    }
    return result


def _map_text(result: dict[str, Any]) -> str:
    rows, columns = result["rows"], result["columns"]
    lines = []
    for name, title in (("delta_R", "Delta R"), ("cnr_object", "contrast to noise of the object")):
        lines.append(f"{title}: {rows['axis']} down, {columns['axis']} across")
        lines.append(" " * 14 + "".join(f"{value!s:>12}" for value in columns["values"]))
        for label, row in zip(rows["values"], result[name], strict=True):
            lines.append(f"{label!s:>14}" + "".join(f"{value:>12.4g}" for value in row))
    best = result["best"]
    lines.append(f"best contrast to noise {best['cnr_object']:.4g}: {best['low']} with {best['high']}")
    return "\n".join(lines)


def _figure(result: dict[str, Any]) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows, columns = result["rows"], result["columns"]
    words = {"kv_low": "low tube voltage (kV)", "kv_high": "high tube voltage (kV)", "filter": "filter (mm)"}
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    for index, (name, title) in enumerate((("delta_R", "Delta R"), ("cnr_object", "contrast to noise of the object"))):
        axis = figure.add_subplot(1, 2, index + 1)
        image = axis.imshow(result[name], origin="lower", aspect="auto", cmap="viridis")
        figure.colorbar(image, ax=axis)
        for axis_of_figure, described in ((axis.xaxis, columns), (axis.yaxis, rows)):
            shown = range(0, len(described["values"]), math.ceil(len(described["values"]) / 12))
            axis_of_figure.set_ticks(list(shown), [_tick(described["values"][item]) for item in shown])
        axis.set(title=title, xlabel=words[columns["axis"]], ylabel=words[rows["axis"]])
    figure.suptitle(f"{result['object']} mm in {result['product']} mm, {result['object_pixels']} pixels", fontsize=10)
    return figure


def _tick(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g}"
