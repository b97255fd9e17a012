"""Transmission tables: air kerma (or signal) behind an absorber over that before, by kV and filter."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ...acquisition.setting import Filter, text_from_filters
from ...errors import InputError
from ...materials import material_from_name
from ._measured_table import TableRow, read_rows, refuse_copies
from .dose_data import REPEATABILITY, KermaRatio

COLUMNS = ("kV", "filter", "transmission", "material", "thickness_mm", "absorber", "quantity", "uncertainty_percent")
QUANTITIES = ("air_kerma", "signal")
_UNKNOWN = "absorber"
_COVERAGE_FACTOR = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TransmissionTable:
    """A transmission table as data of the fit: ratios, one entry a row; absorbers: names of those of unknown composition;
    notes: what its owner should know.
    """

    ratios: tuple[KermaRatio, ...]
    absorbers: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for the twin's evidence."""
        return {
            "rows": len(self.ratios),
            "unknown_absorbers": list(self.absorbers),
            "transmissions": [
                {
                    "kV": item.kV,
                    "filter": text_from_filters(item.filters),
                    "absorber": item.absorber or text_from_filters(item.layers),
                    "quantity": QUANTITIES[item.of_signal],
                    "transmission": item.value,
                }
                for item in self.ratios
            ],
        }


def read_transmission_table(
    path: str | os.PathLike[str], *, anode: str = "W", has_detector: bool = True
) -> TransmissionTable:
    """Read a transmission table.

    Columns: `kV`, `filter` (MATERIAL:mm joined by +, in both beams), `transmission` (above 0, below 1); `material` and
    `thickness_mm` where they are known, else the absorber's composition is fitted; optionally `absorber` (a name, where
    there are several unknown ones), `quantity` (`air_kerma`, as a dosimeter reads, or `signal` of the line's own detector,
    without scatter) and `uncertainty_percent` of the transmission (k = 2). Without it each of the two readings is taken to
    scatter by 1 %.

    Args:
        path: CSV file with a header.
        anode: of the tube; says where spectra are known.
        has_detector: whether `signal` has a meaning.

    Raises:
        InputError: see `read_rows`; a transmission that is none, a material without thickness or the other way round, an
            unknown material, a kV without spectra, a copied row.
    """
    rows = read_rows(path, option="--transmission", required=("kV", "filter", "transmission"), known=COLUMNS)
    ratios, resolutions = [], []
    for row in rows:
        kV, filters = row.kV(anode), row.filters()
        reading = row.reading("transmission", unit="(a share)", below=1.0)
        layers = _layers(row)
        if row.has("uncertainty_percent"):
            sd = row.reading("uncertainty_percent", unit="%", below=100.0).value / 100.0 / _COVERAGE_FACTOR
        else:
            sd = REPEATABILITY * math.sqrt(2.0)
        ratios.append(
            KermaRatio(
                kV=kV,
                filters=filters,
                layers=layers,
                absorber="" if layers else (row.text("absorber") or _UNKNOWN),
                value=reading.value,
                relative_sd=math.hypot(sd, reading.relative_sd),
                of_signal=_of_signal(row, has_detector),
                rows=(row.line,),
            )
        )
        resolutions.append(reading.resolution / reading.value)
    notes = refuse_copies(rows, COLUMNS, resolutions)
    absorbers = tuple(dict.fromkeys(item.absorber for item in ratios if item.absorber))
    _check_unknown(ratios, absorbers, option=rows[0].place.rpartition(",")[0])
    return TransmissionTable(ratios=tuple(ratios), absorbers=absorbers, notes=notes)


def _layers(row: TableRow) -> tuple[Filter, ...]:
    if row.has("material") != row.has("thickness_mm"):
        missing, given = ("thickness_mm", "material") if row.has("material") else ("material", "thickness_mm")
        raise InputError(
            f"{row.place}: {missing}",
            received="nothing",
            expected=f"both material and thickness_mm, as {given} is given",
        )
    if not row.has("material"):
        return ()
    try:
        material_from_name(row.text("material"))
    except InputError as error:
        raise InputError(
            f"{row.place}: {error.argument}", received=error.received, expected=error.expected, remedy=error.remedy
        ) from None
    return (Filter(material=row.text("material"), thickness_mm=row.number("thickness_mm", unit="mm")),)


def _of_signal(row: TableRow, has_detector: bool) -> bool:
    quantity = row.text("quantity") or QUANTITIES[0]
    if quantity not in QUANTITIES:
        raise InputError(f"{row.place}: quantity", received=repr(quantity), expected="one of " + ", ".join(QUANTITIES))
    if quantity == "signal" and not has_detector:
        raise InputError(
            f"{row.place}: quantity",
            received="signal, without an acquisition",
            expected="air_kerma: a tube alone has no detector",
            remedy="give the acquisition with the detector's flats too",
        )
    return quantity == "signal"


def _check_unknown(ratios: Sequence[KermaRatio], absorbers: Sequence[str], *, option: str) -> None:
    for absorber in absorbers:
        beams = {(item.kV, text_from_filters(item.filters)) for item in ratios if item.absorber == absorber}
        if len(beams) < 2:
            raise InputError(
                f"{option}: {absorber}",
                received="an unknown absorber in one beam",
                expected="two kV or filters at least, for it counts as two materials",
                remedy="give its material and thickness_mm, or measure it at another kV",
            )
