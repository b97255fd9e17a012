"""Pages of results: charts described once and drawn for the browser and for paper, and the page that holds them."""

from .chart import AFTER, BEFORE, MEASURED, QUIET, Band, Bars, Chart, Figure, Line, Picture, Points, Rule
from .page import KeyFigure, ResultPage, Section, SortedTable, Step, write_page, write_result_page

__all__ = [
    "AFTER",
    "BEFORE",
    "MEASURED",
    "QUIET",
    "Band",
    "Bars",
    "Chart",
    "Figure",
    "KeyFigure",
    "Line",
    "Picture",
    "Points",
    "ResultPage",
    "Rule",
    "Section",
    "SortedTable",
    "Step",
    "write_page",
    "write_result_page",
]
