"""One self-contained page: a template of its own, the base that all pages share, figures with their numbers."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files import whole_file
from . import _screen
from ._paper import png_of
from .chart import Figure

if TYPE_CHECKING:
    from markupsafe import Markup


@dataclass(frozen=True, slots=True, kw_only=True)
class SortedTable:
    """A table that the reader can sort by a click on a column's head.

    Fields: header; rows (texts, as long as the header); words: columns of words, which are set to the left; anchors: an id for
    each row, so that figures can point to it; marked: rows that stand out.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: frozenset[int] = frozenset({0})
    anchors: tuple[str, ...] = ()
    marked: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """What a reader can do next: a sentence, and the command that does it."""

    text: str
    command: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyFigure:
    """A number that stands out, and what it is."""

    value: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A part of a page: sentences, figures, a table and a list, in this order; folded away where few readers want it."""

    title: str
    text: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    table: SortedTable | None = None
    items: tuple[str, ...] = ()
    folded: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultPage:
    """The page of one result.

    Fields: heading; answer (sentences); key_figures; proof (the figures that show the answer); steps (what to do next);
    sections; doubtful (the answer is a warning); made_from (hashes, seed).
    """

    heading: str
    answer: tuple[str, ...]
    key_figures: tuple[KeyFigure, ...] = ()
    proof: tuple[Figure, ...] = ()
    steps: tuple[Step, ...] = ()
    sections: tuple[Section, ...] = ()
    doubtful: bool = False
    made_from: str = ""


def write_result_page(path: Path, page: ResultPage, *, version: str, interactive: bool | None = None) -> Path:
    """Write the page of one result; arguments as for `write_page`."""
    figures = {f"proof_{number}": item for number, item in enumerate(page.proof)}
    sections = []
    for number, part in enumerate(page.sections):
        names = {f"section_{number}_{place}": item for place, item in enumerate(part.figures)}
        figures |= names
        sections.append({"part": part, "figures": list(names)})
    return write_page(
        path,
        Path(__file__).parent / "result.html",
        version=version,
        figures=figures,
        interactive=interactive,
        page=page,
        proof=[name for name in figures if name.startswith("proof_")],
        sections=sections,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shown:
    """A figure as the template takes it."""

    name: str
    title: str
    alt: str
    wide: bool
    png: str
    csv: str
    element: "Markup | None"


def write_page(
    path: Path,
    template: Path,
    *,
    version: str,
    figures: Mapping[str, Figure | bytes] | None = None,
    interactive: bool | None = None,
    **values: Any,
) -> Path:
    """Write a page that asks for nothing but itself; returns its path.

    Args:
        path: the page.
        template: that extends `base.html`, in a folder of any package.
        version: of raytwin, for the page's foot.
        figures: by the name that the template has for them; a PNG's bytes where a figure is no chart.
        interactive: figures that answer to the pointer; None: where Bokeh is installed (extra `explore`).
        **values: what else the template names.

    Raises:
        InputError: a place where nothing can be written.
    """
    import jinja2
    from markupsafe import Markup

    given = dict(figures or {})
    charts = {name: item for name, item in given.items() if not isinstance(item, bytes)}
    alive = bool(charts) and (_screen.is_there() if interactive is None else interactive)
    script, elements = _screen.drawn(list(charts.values())) if alive else ("", [])
    places = dict(zip(charts, elements, strict=False))
    shown = {
        name: _Shown(
            name=name if isinstance(item, bytes) else item.name,
            title="" if isinstance(item, bytes) else item.title,
            alt="" if isinstance(item, bytes) else item.alt,
            wide=True if isinstance(item, bytes) else item.wide,
            png=_data(item if isinstance(item, bytes) else png_of(item), "image/png"),
            csv="" if isinstance(item, bytes) else _data(item.numbers_csv().encode(), "text/csv;charset=utf-8"),
            element=Markup(places[name]) if name in places else None,  # made here from numbers, by Bokeh
        )
        for name, item in given.items()
    }
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, Path(__file__).parent]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_as_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template(template.name).render(
        version=version,
        figures=shown,
        library=Markup(_screen.library_html() if alive else ""),
        script=Markup(script),
        alive=alive,
        **values,
    )
    with whole_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path


def _as_shown(value: Any) -> Any:
    """Texts are kept in ASCII for terminals; a page has the sign."""
    return value.replace("+-", "\u00b1") if type(value) is str and not value.startswith("data:") else value


def _data(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
