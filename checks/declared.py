"""What the labels of an acquisition name that nobody knows: anodes, tube voltages, materials."""

from ..acquisition.acquisition_io import AcquisitionFile
from ..acquisition.instrument import LAYER_FIELDS
from ..acquisition.setting import Filter, text_from_filters
from ..errors import InputError
from ..materials import material_from_name
from ..spectra import checked_kV
from .findings import Finding, FindingCode


def unknown_words(acquisition: AcquisitionFile) -> tuple[list[Finding], set[str]]:
    """Anodes, tube voltages and materials that no spectrum or table is known for: an error each, and the series they are of."""
    instrument = acquisition.instrument
    told: dict[str, Finding] = {}
    named: set[str] = set()

    def tell(series: str, error: InputError) -> None:
        text = " ".join(str(error).split())
        told.setdefault(text, Finding(code=FindingCode.UNKNOWN, series=series, values={"what": text}))
        named.add(series)

    for layers in LAYER_FIELDS:
        try:
            _check_materials(layers, getattr(instrument, layers) or ())
        except InputError as error:
            tell("", error)
    for item in acquisition.series:
        try:
            _check_materials("filter", item.filters)
            if item.kV is not None:
                checked_kV(item.kV, anode=instrument.anode or "W")
        except InputError as error:
            tell("" if error.argument == "anode" else item.name, error)
    return list(told.values()), named


def _check_materials(of: str, layers: tuple[Filter, ...]) -> None:
    """Every material has a table.

    Raises:
        InputError: one has none.
    """
    for layer in layers:
        try:
            material_from_name(layer.material)
        except InputError as error:
            raise InputError(
                of, received=text_from_filters(layers), expected=error.expected, remedy=error.remedy
            ) from None
