"""Pages of results: charts described once and drawn for the browser and for paper, and the page that holds them."""

from .chart import AFTER, BEFORE, MEASURED, QUIET, Band, Bars, Chart, Figure, Line, Picture, Points, Rule
from .page import SortedTable, write_page

__all__ = [
    "AFTER",
    "BEFORE",
    "MEASURED",
    "QUIET",
    "Band",
    "Bars",
    "Chart",
    "Figure",
    "Line",
    "Picture",
    "Points",
    "Rule",
    "SortedTable",
    "write_page",
]
