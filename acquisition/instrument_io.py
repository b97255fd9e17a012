"""The instrument as attributes of an HDF5 group: read and written."""

from dataclasses import fields
from typing import Any

from ..errors import FileFormatError, InputError
from ._hdf5 import named, number_attribute, text_attribute, whole_attribute
from .instrument import BOOLEAN_FIELDS, LAYER_FIELDS, TEXT_FIELDS, WHOLE_FIELDS, Instrument
from .setting import Filter, filters_from_text, text_from_filters


def read_instrument(node: Any, *, path: str) -> Instrument:
    """The instrument in the attributes of an HDF5 group; None: nothing is known.

    Raises:
        FileFormatError: an attribute of another type, or out of range.
    """
    if node is None:
        return Instrument()
    where = f"{path}, instrument"
    values: dict[str, Any] = {}
    for field in fields(Instrument):
        if field.name in LAYER_FIELDS:
            values[field.name] = filters_attribute(node, field.name, where=where)
        elif field.name in TEXT_FIELDS:
            values[field.name] = text_attribute(node, field.name, where=where) or None
        elif field.name in (*WHOLE_FIELDS, *BOOLEAN_FIELDS):
            values[field.name] = whole_attribute(node, field.name, where=where)
        else:
            values[field.name] = number_attribute(node, field.name, where=where)
    for name in BOOLEAN_FIELDS:
        if values[name] is not None:
            values[name] = bool(values[name])
    with named(path):
        return Instrument(**values)


def write_instrument(group: Any, instrument: Instrument) -> None:
    """Write what is known of an instrument into the attributes of an HDF5 group."""
    for field in fields(Instrument):
        value = getattr(instrument, field.name)
        if value is not None:
            group.attrs[field.name] = text_from_filters(value) if field.name in LAYER_FIELDS else value


def filters_attribute(node: Any, name: str, *, where: str) -> tuple[Filter, ...] | None:
    """Filters in a text attribute, or None where it is absent."""
    text = text_attribute(node, name, where=where)
    if text is None:
        return None
    try:
        return filters_from_text(text)
    except InputError as error:
        raise FileFormatError(
            f"{where}, {name}", received=error.received, expected=error.expected, remedy=error.remedy
        ) from None
