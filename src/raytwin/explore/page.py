"""The page: controls that make a state, and what is seen of it, drawn with Bokeh."""

import html
import itertools
import shlex
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..acquisition.setting import Filter, filters_from_text
from ..errors import InputError, RaytwinError
from ..generator.line.twin import Estimate
from ..materials import library_from_files, material_from_name
from ..results import between_text, same_value
from .seen_size import SeenSize
from .state import ExplorerState, first_state
from .view import BeamView, Explorer, ExplorerView, MapView

if TYPE_CHECKING:
    from ..campaign.sweep_add import AddedSetting

LOW_COLOUR, HIGH_COLOUR = "#0072B2", "#D55E00"  # apart for every kind of colour vision (Okabe and Ito)
Changes = dict[str, dict[str, Any]]  # model by name -> property -> value
FILTER_MATERIALS = ("Al", "Cu", "Sn", "Ag", "Mo", "Ti", "Fe", "Pb")
_NO_FILTER = "no filter"
_THICK_MM = {"Al": 10.0, "Ti": 5.0}  # longest filter of a material; others
_USUAL_MM = 2.0
_NEXT_TO_NONE = 1e-5  # a POD below it is shown as 0
_QUIET_MS = 250  # without a move before the map is drawn anew
_RED = "#b00020"
_CURVES = {
    f"{beam}_{column}": (beam, where)
    for beam in ("low", "high")
    for column, where in (("open", "open field"), ("product", "behind the product"))
}
_PICTURES = {"low": "low voltage, −ln(I/I₀)", "high": "high voltage, −ln(I/I₀)", "ratio": "ratio low / high"}


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignTarget:
    """Where "add to campaign" writes: the campaign file, and references of the user's for a new one (None: a description)."""

    path: Path
    references: Path | None


def build_page(document: Any, explorer: Explorer, campaign: CampaignTarget, subtitle: str) -> None:
    """Fill a Bokeh document with the page of an explorer."""
    _Page(document, explorer, campaign, subtitle)


class _Page:
    """One open page: widgets, sources, and the state they stand for."""

    def __init__(self, document: Any, explorer: Explorer, campaign: CampaignTarget, subtitle: str) -> None:
        self.document = document
        self.explorer = explorer
        self.campaign = campaign
        self.state = first_state(explorer.twin)
        self.answers = 0
        self.seed = self.state.seed
        self._asked = False
        self._open = False
        self._sent: Changes = {}
        self._pieces: Iterator[MapView | None] | None = None
        self._map_key: Any = None
        self._waiting: Any = None
        self.widgets = self._controls()
        self.figures = _Figures(explorer)
        from bokeh.models import Button, ColumnDataSource, CustomJS, Div

        wide = {"sizing_mode": "stretch_width"}
        self.tiles = Div(name="tiles", **wide)
        self.limits = Div(name="limits", visible=False, **wide)
        self.numbers = Div(name="numbers", **wide)
        self.map_note = Div(name="map_note", **wide)
        self.image_note = Div(name="image_note", **wide)
        self.added = Div(name="added", visible=False, **wide)
        self.texts = Div(name="texts", **wide)
        # what scripts of the page read: the texts to copy, and how many answers there were
        self.copied = ColumnDataSource(data={"command": [""], "python": [""]})
        self.answer = ColumnDataSource(data={"count": [0], "seconds": [0.0]}, name="answer")
        buttons = []
        for name, label, key in (
            ("copy_command", "Copy command", "command"),
            ("copy_python", "Copy Python", "python"),
        ):
            button = Button(label=label, name=name)
            button.js_on_click(
                CustomJS(
                    args={"source": self.copied, "button": button, "label": label},
                    code=f"""
                    navigator.clipboard.writeText(source.data['{key}'][0]).then(
                      () => {{ button.label = 'Copied' }}, () => {{ button.label = 'Not copied: mark the text below' }});
                    setTimeout(() => {{ button.label = label }}, 1500)""",
                )
            )
            buttons.append(button)
        add = Button(label="Add to campaign", name="add")
        add.on_click(self._add)
        noise = Button(label="New noise", name="noise")
        noise.on_click(self._new_noise)
        # one message brings an answer; the page hands it out without telling the server what it knows
        self.messages = ColumnDataSource(name="messages")
        self.targets = {
            **{
                one.name: one
                for one in (
                    self.tiles,
                    self.limits,
                    self.numbers,
                    self.map_note,
                    self.image_note,
                    self.added,
                    self.texts,
                )
            },
            "copied": self.copied,
            "answer": self.answer,
            **self.figures.targets,
        }
        self.messages.js_on_change(
            "tags",
            CustomJS(
                args={"targets": self.targets},
                code="""
                for (const [name, properties] of Object.entries(cb_obj.tags[0])) {
                  targets[name].setv(properties, {sync: false})
                }""",
            ),
        )
        self.numbers.tags = [self.answer, self.messages]
        for widget in self.widgets.values():
            document.add_root(widget)
        for model in (
            self.tiles,
            self.limits,
            self.numbers,
            self.map_note,
            self.image_note,
            self.added,
            self.texts,
            *buttons,
            add,
            noise,
        ):
            document.add_root(model)
        for figure in self.figures.figures:
            document.add_root(figure)
        document.template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
        document.template_variables.update(twin_name=explorer.name, subtitle=subtitle)
        document.title = f"raytwin explore: {explorer.name}"
        for widget in self.widgets.values():
            widget.on_change("active" if widget.name == "displaces" else "value", self._moved)
        self._show()
        self._open = True

    def _controls(self) -> dict[str, Any]:
        from bokeh.models import AutocompleteInput, Checkbox, CustomJSTickFormatter, Select, Slider, TextInput

        state, ranges = self.state, self.explorer.ranges
        wide = {"sizing_mode": "stretch_width"}
        names = list(library_from_files().names())

        def slider(name: str, title: str, ends: tuple[float, float], value: float, step: float) -> Any:
            return Slider(name=name, title=title, start=ends[0], end=ends[1], value=value, step=step, **wide)

        def logarithmic(name: str, title: str, ends: tuple[float, float], value: float, unit: str) -> Any:
            shown = CustomJSTickFormatter(code=f"return Number((10 ** tick).toPrecision(3)) + ' {unit}'")
            logs = (float(np.log10(ends[0])), float(np.log10(ends[1])))
            return Slider(
                name=name,
                title=title,
                start=logs[0],
                end=logs[1],
                value=float(np.log10(value)),
                step=0.01,
                format=shown,
                **wide,
            )

        def material(name: str, title: str, value: str) -> Any:
            return AutocompleteInput(
                name=name,
                title=title,
                value=value,
                completions=names,
                restrict=False,
                min_characters=1,
                case_sensitive=False,
                search_strategy="includes",
                **wide,
            )

        widgets = []
        for beam, kV, power, filters in (
            ("low", state.kV_low, state.power_low_W, state.filters_low),
            ("high", state.kV_high, state.power_high_W, state.filters_high),
        ):
            first = filters[0] if filters else None
            offered = list(dict.fromkeys((_NO_FILTER, *FILTER_MATERIALS, *([first.material] if first else []))))
            widgets += [
                slider(f"kV_{beam}", "Tube voltage, kV", ranges.kV, kV, 0.5),
                slider(f"power_{beam}", "Tube power, W", ranges.power_W, power, 1.0),
                Select(
                    name=f"filter_{beam}",
                    title="Filter",
                    options=offered,
                    value=first.material if first else _NO_FILTER,
                    **wide,
                ),
                slider(
                    f"filter_{beam}_mm",
                    "Thickness, mm",
                    (0.0, _longest(first)),
                    first.thickness_mm if first else 0.0,
                    0.01,
                ),
            ]
        # a calibrated stack of several layers: what comes after the first one stands in both beams
        more = state.filters_low[1:] if state.filters_low[1:] == state.filters_high[1:] else ()
        distance = state.source_detector_mm or self.explorer.instrument.source_detector_mm or 1000.0
        widgets += [
            logarithmic("exposure", "Exposure of one frame", ranges.exposure_ms, state.exposure_ms, "ms"),
            slider("averaged", "Frames averaged", (1, 50), state.averaged, 1),
            slider("distance", "Source to detector, mm", ranges.source_detector_mm, distance, 1.0),
            TextInput(
                name="layers",
                title="Further filters in both beams",
                value="+".join(map(str, more)),
                placeholder="MATERIAL:mm+MATERIAL:mm",
                **wide,
            ),
            material("product", "Product", state.product.material),
            slider("product_mm", "Product thickness, mm", (1.0, 200.0), state.product.thickness_mm, 1.0),
            material("foreign_object", "Foreign object", state.foreign_object.material),
            logarithmic("object_mm", "Object thickness", (0.02, 20.0), state.foreign_object.thickness_mm, "mm"),
            logarithmic("object_pixels", "Object area", (1.0, 10_000.0), float(state.object_pixels), "pixels"),
            Checkbox(name="displaces", label="The object takes the product's place", active=state.displaces, **wide),
        ]
        return {widget.name: widget for widget in widgets}

    def _state_of_controls(self) -> ExplorerState:
        """The state that the controls stand for.

        Raises:
            InputError: a text that is no filter or no material.
        """
        value = {name: getattr(one, "active" if name == "displaces" else "value") for name, one in self.widgets.items()}
        further = filters_from_text(value["layers"])
        for layer in further:
            material_from_name(layer.material)
        filters = {}
        for beam in ("low", "high"):
            name, thickness = value[f"filter_{beam}"], float(value[f"filter_{beam}_mm"])
            own = (
                ()
                if name == _NO_FILTER or thickness == 0
                else (Filter(material=name, thickness_mm=round(thickness, 3)),)
            )
            filters[beam] = (*own, *further)
        known = self.explorer.instrument.source_detector_mm
        distance = float(value["distance"])
        for name in ("product", "foreign_object"):
            material_from_name(value[name].strip())
        return ExplorerState(
            kV_low=float(value["kV_low"]),
            kV_high=float(value["kV_high"]),
            power_low_W=float(value["power_low"]),
            power_high_W=float(value["power_high"]),
            filters_low=filters["low"],
            filters_high=filters["high"],
            exposure_ms=_rounded(value["exposure"]),
            averaged=int(value["averaged"]),
            source_detector_mm=None if known is not None and abs(distance - known) < 0.5 else distance,
            product=Filter(material=value["product"].strip(), thickness_mm=float(value["product_mm"])),
            foreign_object=Filter(material=value["foreign_object"].strip(), thickness_mm=_rounded(value["object_mm"])),
            object_pixels=max(1, round(10 ** float(value["object_pixels"]))),
            displaces=bool(value["displaces"]),
            seed=self.seed,
        )

    def _moved(self, name: str, before: Any, after: Any) -> None:
        """A control was moved: answer once all moves that have arrived are in."""
        for beam in ("low", "high"):
            material = self.widgets[f"filter_{beam}"].value
            self.widgets[f"filter_{beam}_mm"].end = _THICK_MM.get(material, _USUAL_MM)
        if not self._asked:
            self._asked = True
            self.document.add_next_tick_callback(self._show)

    def _new_noise(self) -> None:
        self.seed += 1
        self._moved("seed", None, None)

    def _show(self) -> None:
        """The answer to what the controls say."""
        self._asked = False
        began = time.perf_counter()
        try:
            self.state = self._state_of_controls()
        except InputError as error:
            told = f"{error}. All numbers on the page are still those of the settings before."
            self._send({"limits": {"text": _problem_text(told), "visible": True}}, began)
            return
        view = self.explorer.view(self.state)
        changes: Changes = {
            "tiles": {"text": tiles_text(view)},
            "limits": {"text": limits_text(view), "visible": bool(view.limits)},
            "numbers": {"text": numbers_text(view, self.explorer)},
            "copied": {"data": {"command": [view.command], "python": [view.python]}},
            "texts": {"text": _texts_text(view)},
            "image_note": {"text": _image_note(view)},
            **self.figures.changes(view),
        }
        again = _map_key(self.state) != self._map_key
        if again:
            changes["map_note"] = {"text": _note("Being drawn again for the settings above.")}
        self._send(changes, began)
        if again and self._open:
            self._ask_for_map()
        elif again:
            # a page that is not open yet has no one to bring it later
            self._send_map(self.explorer.map(self.state))

    def _send(self, changes: Changes, began: float | None = None) -> None:
        """Bring changes to the page in one message, so that it is drawn once; what is the same already is left out."""
        fresh: Changes = {}
        for name, properties in changes.items():
            known = self._sent.setdefault(name, {})
            new = {key: value for key, value in properties.items() if not same_value(known.get(key), value)}
            known.update(new)
            if new:
                fresh[name] = new
        if began is not None:
            self.answers += 1
            fresh["answer"] = {"data": {"count": [self.answers], "seconds": [time.perf_counter() - began]}}
        if self._open:
            self.messages.tags = [fresh]
        else:
            for name, properties in fresh.items():
                self.targets[name].update(**properties)

    def _ask_for_map(self) -> None:
        """Draw the map once nothing has moved for a moment."""
        self._pieces = None
        if self._waiting is not None:
            self.document.remove_timeout_callback(self._waiting)
        self._waiting = self.document.add_timeout_callback(self._begin_map, _QUIET_MS)

    def _begin_map(self) -> None:
        self._waiting = None
        self._pieces = self.explorer.map_by_rows(self.state)
        self._advance_map()

    def _advance_map(self) -> None:
        """One piece of the map, then let moves that have arrived go first."""
        if self._pieces is None:
            return
        found = next(self._pieces)
        if found is None:
            self.document.add_timeout_callback(self._advance_map, 1)
            return
        self._pieces = None
        self._send_map(found)

    def _send_map(self, found: MapView) -> None:
        self._map_key = _map_key(self.state)
        self._send({**self.figures.map_changes(found), "map_note": {"text": _map_note(found)}})

    def _add(self) -> None:
        """Write what is seen to the campaign file."""
        from ..campaign.sweep_add import add_setting

        instrument, state = self.explorer.instrument, self.state
        pixel_mm = (instrument.pixel_mm or 1.0) / (instrument.magnification or 1.0)
        try:
            done = add_setting(
                self.campaign.path,
                twin=self.explorer.name,
                low=state.setting("low"),
                high=state.setting("high"),
                product=state.product,
                foreign_object=state.foreign_object,
                object_pixels=state.object_pixels,
                displaces=state.displaces,
                object_mm=object_diameter_mm(state, pixel_mm),
                field_mm=min(self.explorer.twin.maps.shape) * pixel_mm,
                references=self.campaign.references,
            )
        except (RaytwinError, OSError) as error:
            self._send({"added": {"text": _problem_text(str(error)), "visible": True}})
            return
        seen = (state.product.material, state.foreign_object.material)
        self._send({"added": {"text": _note(added_text(done, seen=seen)), "visible": True}})


def added_text(done: "AddedSetting", *, seen: tuple[str, str]) -> str:
    """What was done to the campaign, and the command that runs it; seen: materials of product and foreign object on the page."""
    text = f"{'The pair was added' if done.new else 'The pair is in it already'}: {done.path}, "
    text += f"{_counted(done.settings, 'setting')}."
    if done.description is not None:
        text += f" Products and objects are described in {done.description}."
    if done.other_materials is not None:
        theirs, these = (f"{product} with {found}" for product, found in (done.other_materials, seen))
        text += f" This campaign is of {theirs}, and stays so; for {these} start with another file: --campaign FILE."
    return f"{text} Next: {shlex.join(['raytwin', 'sweep', str(done.path), '--plan'])}"


def object_diameter_mm(state: ExplorerState, pixel_mm: float) -> float:
    """Diameter (mm) of the disc of the state's pixels, each of `pixel_mm` in the object's plane."""
    return float(2.0 * np.sqrt(state.object_pixels / np.pi) * pixel_mm)


def _map_key(state: ExplorerState) -> Any:
    """All of a state that its map depends on."""
    from dataclasses import replace

    return replace(state, kV_low=1.0, kV_high=2.0, seed=0)


def _rounded(logarithm: float) -> float:
    return float(f"{10 ** float(logarithm):.3g}")


def _longest(layer: Filter | None) -> float:
    return max(_THICK_MM.get(layer.material, _USUAL_MM), layer.thickness_mm) if layer else _USUAL_MM


_FONT = 'system-ui, "DejaVu Sans", sans-serif'
_STYLE = f"""<style>
 :host, div, p, ul, table {{ font-family: {_FONT}; color: #1b1f24; }}
 table {{ border-collapse: collapse; width: 100%; font-size: 14px; line-height: 1.35; }}
 th, td {{ text-align: left; padding: 3px 10px 3px 0; vertical-align: top; border-bottom: 1px solid #e6e9ee; }}
 th {{ font-weight: 600; }} td.q {{ color: #4a5360; width: 38%; }} span.i {{ color: #4a5360; font-size: 12px; white-space: nowrap; }}
 .low {{ color: #0a5b94; }} .high {{ color: #a54400; }}
 ul {{ margin: 6px 0 0; padding-left: 18px; font-size: 14px; line-height: 1.35; }}
 .caution {{ color: #4a5360; }} .bad, .bad b, .bad small, .broken, .broken li {{ color: {_RED}; font-weight: 600; }}
 p {{ margin: 6px 0 0; font-size: 13px; color: #4a5360; }}
 pre {{ margin: 6px 0 0; font-size: 13px; white-space: pre-wrap; overflow-wrap: anywhere; color: #1b1f24; }}
 .tiles {{ display: flex; flex-wrap: wrap; gap: 4px 26px; }}
 .tiles b {{ display: block; font-size: 19px; font-weight: 600; }} .tiles small {{ color: #4a5360; font-size: 12px; }}
 .tiles span.i {{ font-weight: 400; }}
 @media (max-width: 600px) {{
  tr {{ display: grid; grid-template-columns: 1fr 1fr; border-bottom: 1px solid #e6e9ee; }} td, th {{ border-bottom: none; }}
  td.q {{ grid-column: 1 / -1; width: auto; padding-bottom: 0; }} th.q {{ display: none; }} td.both {{ grid-column: 1 / -1; }}
  .tiles {{ gap: 2px 14px; }} .tiles b {{ font-size: 15px; }} .tiles span.i {{ display: none; }}
 }}
</style>"""


def numbers_text(view: ExplorerView, explorer: Explorer) -> str:
    """The table of numbers with their 95 % intervals, and what limits them, as HTML."""
    low, high = view.low, view.high
    rows = [
        ("level above dark, DN", *(_of(beam, "mean_DN") for beam in (low, high))),
        ("share of full scale", *(_share(beam) for beam in (low, high))),
        ("noise of one pixel, DN", *(_of(beam, "sd_DN") for beam in (low, high))),
        ("photons absorbed, a pixel and frame", *(_of(beam, "photons_absorbed") for beam in (low, high))),
        ("air kerma of one frame, µGy", *(_of(beam, "air_kerma_uGy") for beam in (low, high))),
    ]
    found = view.contrast
    if found is not None:
        rows.append(("−ln(I/I₀) of the product", f"{found.low.M_product:.4f}", f"{found.high.M_product:.4f}"))
        rows.append(("−ln(I/I₀) with the object", f"{found.low.M_object:.4f}", f"{found.high.M_object:.4f}"))
    both: list[tuple[str, str]] = []
    if found is not None and found.cnr_pixel is not None:
        both.append(("contrast to noise of one pixel", f"{found.cnr_pixel:.3g}"))
    pixel_mm = explorer.instrument.pixel_mm
    if pixel_mm is not None and explorer.instrument.magnification is not None:
        across = object_diameter_mm(view.state, pixel_mm / explorer.instrument.magnification)
        both.append(("object as a disc, in its plane", f"{across:.3g} mm across ({view.state.object_pixels} pixels)"))
    if view.seen_size is not None:
        both += _seen_size_rows(view.seen_size)
    for pod in view.pods:
        both.append((f"a90 of {pod.known.name}, {pod.known.size_name}", _a90_text(pod.known)))
        if pod.times_a90 is not None:
            at = f"; POD {_percents(pod.pod)}" if pod.pod is not None else ""
            both.append((f"Delta R over a90 of {pod.known.name}", f"{pod.times_a90:.3g}{at}"))
    told = "".join(f'<li class="caution">{html.escape(text)}</li>' for text in view.cautions)
    head = "".join(
        f'<th class="{name}">{name}, {beam.setting.kV:g} kV</th>' for name, beam in (("low", low), ("high", high))
    )
    body = "".join(
        f'<tr><td class="q">{html.escape(title)}</td><td>{one}</td><td>{other}</td></tr>' for title, one, other in rows
    )
    body += "".join(
        f'<tr><td class="q">{html.escape(title)}</td><td colspan="2" class="both">{text}</td></tr>'
        for title, text in both
    )
    below = "<p>In brackets: 95 % interval of the quantity itself, without the noise of a later measurement.</p>"
    cautions = f"<ul>{told}</ul>" if told else ""
    return f'{_STYLE}<table><tr><th class="q"></th>{head}</tr>{body}</table>{below}{cautions}'


def tiles_text(view: ExplorerView) -> str:
    """The answer at a glance: what the pair of images is worth, as HTML."""
    found = view.contrast
    tiles = [
        (
            "contrast to noise of the object",
            "none" if found is None or found.cnr_object is None else f"{found.cnr_object:.3g}",
        ),
        ("contrast Delta R", "none" if found is None or found.delta_R is None else _interval(found.delta_R, 3)),
        ("air kerma of the pair, µGy", "not known" if view.dose_uGy is None else _interval(view.dose_uGy, 3)),
        ("pairs a second", f"{view.pairs_per_s:.3g}"),
    ]
    every = "".join(f"<div><b>{text}</b><small>{html.escape(title)}</small></div>" for title, text in tiles)
    if view.limits:
        every += (
            f'<div class="bad"><b>✗ not possible</b><small>{_counted(len(view.limits), "reason")} below</small></div>'
        )
    return f'{_STYLE}<div class="tiles">{every}</div>'


def limits_text(view: ExplorerView) -> str:
    """What cannot be, in red, as HTML; empty where all can."""
    if not view.limits:
        return ""
    broken = "".join(f"<li>Not possible: {html.escape(text)}</li>" for text in view.limits)
    return f'{_STYLE}<ul class="broken">{broken}</ul>'


def _of(beam: BeamView, name: str) -> str:
    value = None if beam.prediction is None else getattr(beam.prediction, name)
    return "not known" if value is None else _interval(value)


def _interval(value: Estimate, digits: int = 4) -> str:
    ends = f"{_number(value.low, digits)} to {_number(value.high, digits)}"
    return f'{_number(value.value, digits)} <span class="i">({ends})</span>'


def _number(value: float, digits: int = 4) -> str:
    if value != 0 and 1e-4 <= abs(value) < 1e6:
        # as many digits as asked for, without an exponent
        decimals = max(0, digits - 1 - int(np.floor(np.log10(abs(value)))))
        return f"{value:.{decimals}f}"
    return f"{value:.{digits}g}"


def _counted(number: int, word: str) -> str:
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


def _share(beam: BeamView) -> str:
    if beam.full_scale_share is None:
        return "not known"
    text = f"{100.0 * beam.full_scale_share:.3g} %"
    return f'<span class="bad">{text}, saturated</span>' if beam.full_scale_share > 1.0 else text


def _a90_text(known: Any) -> str:
    if known.a90 is None:
        return "none: the data support no a90"
    low, high = (None if end is None else _number(end, 3) for end in (known.a90_low, known.a90_high))
    return f'{_number(known.a90, 3)} <span class="i">({between_text(low, high)})</span>'


def _seen_size_rows(seen: SeenSize) -> list[tuple[str, str]]:
    """What model observers find, as titles and texts."""
    diameter = f"none up to {seen.largest_mm:.3g} mm" if seen.a90_mm is None else f"{seen.a90_mm:.3g} mm across"
    if seen.reason:
        diameter = f"none: {html.escape(seen.reason)}"
    if seen.pod is not None:
        diameter += f"; POD of the disc shown {100 * seen.pod if seen.pod > _NEXT_TO_NONE else 0:.3g} %"
    rows = [(f"a90 of an ideal observer, {100 * seen.false_alarm_rate:g} % false alarms", diameter)]
    if seen.size_name:
        unit = "" if seen.size_name == "contrast" else " mm"
        one = seen.networks
        text = (
            "none"
            if one is None
            else f'{_number(one.value, 3)}{unit} <span class="i">({_number(one.low, 3)} to {_number(one.high, 3)})</span>'
        )
        rows.append((f"a90 of networks, {seen.size_name.removesuffix('_mm')}, expected", text))
    return rows


def _percents(pod: tuple[float, float, float]) -> str:
    value, low, high = (f"{100.0 * one:.3g}" if one > _NEXT_TO_NONE else "0" for one in pod)
    return f"{value} % ({low} to {high} %)"


def _note(text: str) -> str:
    return f"{_STYLE}<p>{html.escape(text)}</p>"


def _problem_text(text: str) -> str:
    return f'{_STYLE}<ul class="broken"><li>{html.escape(text)}</li></ul>'


def _texts_text(view: ExplorerView) -> str:
    return f"{_STYLE}<pre>{html.escape(view.command)}</pre>"


def _image_note(view: ExplorerView) -> str:
    if view.images is None:
        return _note("No images: see what is not possible above.")
    part = "" if view.images.whole else " The object is larger than the picture."
    for beam in (view.low, view.high):
        if beam.full_scale_share is not None and beam.full_scale_share > 1.0:
            part += f" The image at {beam.setting.kV:g} kV is saturated and shows nothing."
    return _note(
        "Left edge: open field. Middle: the object in the product. Slabs without scatter, on pixels of the detector's median"
        f" response.{part}"
    )


def _map_note(found: MapView) -> str:
    if found.best is None:
        return _note("Ring: what is set. No pair on the map is within the line's limits.")
    kV_low, kV_high, ratio = found.best
    return _note(
        f"Ring: what is set. Star: best on the map, {ratio:.3g} at {kV_low:g} and {kV_high:g} kV. Hatched: beyond the limits"
        " of the line. Empty: no pair, or a saturated image. Powers stay as set."
    )


class _Figures:
    """Figures and their sources."""

    def __init__(self, explorer: Explorer) -> None:
        from bokeh.models import ColorBar, ColumnDataSource, LinearColorMapper, Range1d
        from bokeh.palettes import Cividis256, Greys256
        from bokeh.plotting import figure

        plain: dict[str, Any] = {"sizing_mode": "stretch_width", "toolbar_location": None, "tools": ""}
        # one source a figure, so that an answer is few messages
        self.spectra = ColumnDataSource(data={name: [] for name in ("energy", *_CURVES)})
        spectrum = figure(name="spectrum", height=330, **plain)
        for name, (beam, where) in _CURVES.items():
            spectrum.line(
                "energy",
                name,
                source=self.spectra,
                color=LOW_COLOUR if beam == "low" else HIGH_COLOUR,
                line_dash="solid" if where == "open field" else "dashed",
                line_width=2,
            )
        spectrum.xaxis.axis_label = "photon energy, keV"
        spectrum.yaxis.axis_label = "photons / (keV pixel frame)"
        spectrum.y_range.start = 0
        self.pictures = ColumnDataSource(data={name: [] for name in (*_PICTURES, "side")})
        self.mappers = {name: LinearColorMapper(palette=Greys256, low=0.0, high=1.0) for name in _PICTURES}
        # values below and above the scale take its ends; open field in the ratio has none
        self.mappers["ratio"].nan_color = "#c9d3e0"
        images = []
        for name, title in _PICTURES.items():
            one = figure(name=f"image_{name}", title=title, height=262, match_aspect=True, min_border_left=10, **plain)
            one.x_range.range_padding = one.y_range.range_padding = 0
            one.image(name, x=0, y=0, dw="side", dh="side", source=self.pictures, color_mapper=self.mappers[name])
            one.add_layout(ColorBar(color_mapper=self.mappers[name], width=10), "right")
            one.xaxis.axis_label = "pixels"
            one.yaxis.visible = False  # as long as the other side
            one.grid.visible = False
            images.append(one)
        self.images = images
        self.cells = ColumnDataSource(data={name: [] for name in ("x", "y", "w", "h", "cnr")})
        self.beyond = ColumnDataSource(data={name: [] for name in ("x", "y", "w", "h")})
        self.here = ColumnDataSource(data={"x": [], "y": []})
        self.best = ColumnDataSource(data={"x": [], "y": []})
        self.cnr = LinearColorMapper(palette=Cividis256, low=0.0, high=1.0)
        chart = figure(name="map", height=330, **plain)
        chart.rect(
            "x", "y", "w", "h", source=self.cells, fill_color={"field": "cnr", "transform": self.cnr}, line_color=None
        )
        chart.rect(
            "x",
            "y",
            "w",
            "h",
            source=self.beyond,
            fill_alpha=0.0,
            line_color=None,
            hatch_pattern="right_diagonal_line",
            hatch_color="#ffffff",
            hatch_alpha=0.8,
        )
        chart.scatter(
            "x",
            "y",
            source=self.best,
            marker="star",
            size=18,
            fill_color="#ffffff",
            line_color="#000000",
            line_width=1.5,
        )
        for colour, size in (("#ffffff", 18), ("#000000", 14)):
            chart.scatter(
                "x",
                "y",
                source=self.here,
                marker="circle",
                size=size,
                fill_color=None,
                line_color=colour,
                line_width=2.5,
            )
        chart.add_layout(ColorBar(color_mapper=self.cnr, width=10, title="CNR"), "right")
        chart.xaxis.axis_label = "low tube voltage, kV"
        chart.yaxis.axis_label = "high tube voltage, kV"
        lows, highs = explorer.map_axes()
        ends = [(_edges(axis)[0], _edges(axis)[-1]) for axis in (lows, highs)]
        chart.x_range, chart.y_range = Range1d(*ends[0]), Range1d(*ends[1])
        chart.grid.visible = False
        self.figures = (spectrum, *images, chart)
        # what answers change, by name
        self.targets: dict[str, Any] = {
            "spectra": self.spectra,
            "pictures": self.pictures,
            "here": self.here,
            "cells": self.cells,
            "beyond": self.beyond,
            "best": self.best,
            "cnr": self.cnr,
            **{f"grey_{name}": mapper for name, mapper in self.mappers.items()},
        }

    def changes(self, view: ExplorerView) -> Changes:
        """What spectra, images and the place on the map become."""
        longest = max((view.low, view.high), key=lambda beam: beam.energies_keV.size)
        columns = {"energy": longest.energies_keV.astype(np.float32)}
        for name, (beam, where) in _CURVES.items():
            shown = view.low if beam == "low" else view.high
            photons = shown.open_photons if where == "open field" else shown.product_photons
            columns[name] = np.full(longest.energies_keV.size, np.nan, dtype=np.float32)
            columns[name][: photons.size] = photons
        found: Changes = {
            "spectra": {"data": columns},
            "here": {"data": {"x": [view.state.kV_low], "y": [view.state.kV_high]}},
        }
        pair, contrast = view.images, view.contrast
        if pair is None or contrast is None or contrast.delta_R is None or contrast.sd_pixel is None:
            found["pictures"] = {"data": {name: [] for name in (*_PICTURES, "side")}}
            return found
        found["pictures"] = {
            "data": {
                "low": [pair.log_low],
                "high": [pair.log_high],
                "ratio": [pair.ratio],
                "side": [pair.log_low.shape[0]],
            }
        }
        scales = {
            "low": _grey_scale(contrast.low.M_product, contrast.low.M_object, contrast.low.sd_M_object),
            "high": _grey_scale(contrast.high.M_product, contrast.high.M_object, contrast.high.sd_M_object),
            "ratio": _grey_scale(contrast.R_product, contrast.R_product + contrast.delta_R.value, contrast.sd_pixel),
        }
        for name, (low, high) in scales.items():
            found[f"grey_{name}"] = {"low": low, "high": high}
        return found

    def map_changes(self, found: MapView) -> Changes:
        """What the map of contrast to noise becomes."""
        columns, rows = _edges(found.kV_low), _edges(found.kV_high)
        cells: dict[str, list[float]] = {name: [] for name in ("x", "y", "w", "h", "cnr")}
        beyond: dict[str, list[float]] = {name: [] for name in ("x", "y", "w", "h")}
        for row in range(len(found.kV_low)):
            for column in range(len(found.kV_high)):
                value = float(found.cnr[row, column])
                if not np.isfinite(value):
                    continue
                (left, right), (bottom, top) = columns[row : row + 2], rows[column : column + 2]
                place = {"x": (left + right) / 2, "y": (bottom + top) / 2, "w": right - left, "h": top - bottom}
                for name, number in {**place, "cnr": value}.items():
                    cells[name].append(number)
                if not found.allowed[row, column]:
                    for name, number in place.items():
                        beyond[name].append(number)
        best = {"x": [found.best[0]], "y": [found.best[1]]} if found.best is not None else {"x": [], "y": []}
        return {
            "cells": {"data": cells},
            "beyond": {"data": beyond},
            "best": {"data": best},
            "cnr": {"high": max([1e-6, *cells["cnr"]])},
        }


def _grey_scale(product: float, with_object: float, sd: float) -> tuple[float, float]:
    """Ends of a picture's grey scale: product and object with four standard deviations of one pixel around, in round steps."""
    low, high = min(product, with_object), max(product, with_object)
    room = max(4.0 * sd, 0.02 * abs(product), 1e-6)
    step = 0.5 * 10.0 ** np.floor(np.log10(high - low + 2.0 * room))
    return float(np.floor((low - room) / step) * step), float(np.ceil((high + room) / step) * step)


def _edges(centres: tuple[float, ...]) -> list[float]:
    """Borders of cells around centres."""
    middles = [(one + other) / 2 for one, other in itertools.pairwise(centres)]
    return [2 * centres[0] - middles[0], *middles, 2 * centres[-1] - middles[-1]]


def page_of(explorer: Explorer, campaign: CampaignTarget, subtitle: str) -> Callable[[Any], None]:
    """What fills a document of `serve` with the page."""
    return lambda document: build_page(document, explorer, campaign, subtitle)
