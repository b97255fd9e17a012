"""The option `--size` of commands that run the paper's experiment."""

from ..errors import InputError


def size_from_text(text: str) -> tuple[int, int]:
    """Rows and columns of a detector from `ROWSxCOLUMNS`, pixels.

    Raises:
        InputError: another text.
    """
    rows, cross, columns = text.lower().partition("x")
    if not (cross and rows.isdigit() and columns.isdigit()):
        raise InputError("--size", received=text, expected="ROWSxCOLUMNS, for example 96x128")
    return int(rows), int(columns)
