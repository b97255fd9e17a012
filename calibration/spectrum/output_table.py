"""Dose tables: air kerma of a tube by kV, filter and load, or half-value layers, as read with a dosimeter."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...acquisition.setting import Filter, text_from_filters
from ...errors import InputError
from ._measured_table import Reading, TableRow, read_rows, refuse_copies
from .dose_data import DOSIMETER_CALIBRATION_SD, REPEATABILITY, REPEATABILITY_WORTH, KermaRatio, KermaReading

COLUMNS = (
    "kV",
    "filter",
    "mAs",
    "current_mA",
    "exposure_ms",
    "distance_mm",
    "air_kerma_uGy",
    "hvl_mm_Al",
    "uncertainty_percent",
)
_COVERAGE_FACTOR = 2.0  # of the uncertainties that calibration certificates state
_LN_2 = math.log(2.0)  # a half-value layer's relative error moves the ratio behind it by this at most: beams harden


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputTable:
    """A dose table as data of the fit.

    Fields: kermas: one entry a kV and filter, its readings brought to 1 mAs and 1 m and averaged; half_values: one entry a
    row; scatter: relative sd of one reading about its setting's mean, from the repeats and what is assumed without any;
    repeats: how many degrees of freedom told it; rows: of the file; notes: what its owner should know.
    """

    kermas: tuple[KermaReading, ...]
    half_values: tuple[KermaRatio, ...]
    scatter: float
    repeats: int
    rows: int
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for the twin's evidence."""
        return {
            "rows": self.rows,
            "scatter_percent": 100.0 * self.scatter,
            "repeats": self.repeats,
            "settings": [
                {
                    "kV": item.kV,
                    "filter": text_from_filters(item.filters),
                    "air_kerma_uGy_per_mAs": item.value,
                    "sampling_percent": 100.0 * item.relative_sd,
                    "lines": list(item.rows),
                }
                for item in self.kermas
            ],
            "half_value_layers": [
                {"kV": item.kV, "filter": text_from_filters(item.filters), "hvl_mm_Al": item.layers[-1].thickness_mm}
                for item in self.half_values
            ],
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kerma:
    """One row's kerma per mAs at 1 m: logarithm, sd of its rounding, and the dosimeter's calibration (relative)."""

    log_value: float
    rounding_sd: float
    calibration_sd: float
    line: int = field(default=0)


def read_output_table(path: str | os.PathLike[str], *, anode: str = "W") -> OutputTable:
    """Read a dose table.

    Columns: `kV`, `filter` (MATERIAL:mm joined by +, empty: none beyond the tube's own); `mAs`, or `current_mA` and
    `exposure_ms`; `distance_mm` from the source; `air_kerma_uGy`; or `hvl_mm_Al` in place of load, distance and kerma;
    optionally `uncertainty_percent`: of the dosimeter's calibration as certificates state it (k = 2). Without it the limits
    of IEC 61674 count, 5 %.

    Readings of one kV and filter are repeats: what they scatter tells the noise of a reading. The last digit of kerma and of
    a fractional load is rounded, each as a flat law of its own.

    Args:
        path: CSV file with a header.
        anode: of the tube; says where spectra are known.

    Raises:
        InputError: see `read_rows`; a row with neither kerma nor half-value layer, without load or distance, a number that
            is not positive, an unknown material, a kV without spectra, a copied row.
    """
    rows = read_rows(path, option="--output-table", required=("kV", "filter"), known=COLUMNS)
    given = {column for row in rows for column in row.cells}
    if not {"air_kerma_ugy", "hvl_mm_al"} & given:
        raise InputError(
            rows[0].place.rpartition(",")[0], received="no column air_kerma_uGy", expected="air_kerma_uGy or hvl_mm_Al"
        )
    kermas: dict[tuple[float, tuple[str, ...]], tuple[tuple[Filter, ...], list[_Kerma]]] = {}
    half_values, resolutions = [], []
    for row in rows:
        kV, filters = row.kV(anode), row.filters()
        if not row.has("air_kerma_uGy") and not row.has("hvl_mm_Al"):
            raise InputError(row.place, received="neither air_kerma_uGy nor hvl_mm_Al", expected="one of the two")
        finest = math.inf
        if row.has("air_kerma_uGy"):
            kerma, resolution = _kerma_of(row)
            finest = resolution
            key = (kV, tuple(sorted(str(layer) for layer in filters)))
            kermas.setdefault(key, (filters, []))[1].append(kerma)
        if row.has("hvl_mm_Al"):
            half_value = row.reading("hvl_mm_Al", unit="mm Al")
            finest = min(finest, half_value.resolution / half_value.value)
            half_values.append(_half_value(row, kV, filters, half_value))
        resolutions.append(finest)
    notes = refuse_copies(rows, COLUMNS, resolutions)
    scatter, repeats = _scatter_of([readings for _, readings in kermas.values()])
    return OutputTable(
        kermas=tuple(
            _setting_of(kV, filters, readings, scatter, repeats + REPEATABILITY_WORTH)
            for (kV, _), (filters, readings) in sorted(kermas.items())
        ),
        half_values=tuple(half_values),
        scatter=scatter,
        repeats=repeats,
        rows=len(rows),
        notes=notes,
    )


def _kerma_of(row: TableRow) -> tuple[_Kerma, float]:
    """One row's kerma, and the relative resolution of the reading."""
    reading = row.reading("air_kerma_uGy", unit="uGy")
    load, of_load = _load_mAs(row)
    if not row.has("distance_mm"):
        raise InputError(
            f"{row.place}: distance_mm", received="nothing", expected="the dosimeter's distance from the source"
        )
    distance_mm = row.number("distance_mm", unit="mm")
    value = reading.value / load * (distance_mm / 1000.0) ** 2
    kerma = _Kerma(
        log_value=math.log(value),
        rounding_sd=math.hypot(reading.relative_sd, of_load),
        calibration_sd=_calibration_sd(row),
        line=row.line,
    )
    return kerma, reading.resolution / reading.value


def _load_mAs(row: TableRow) -> tuple[float, float]:
    """Tube load, mAs, and the relative sd of its rounding: of fractions, for whole numbers are what was set."""
    if row.has("mAs"):
        parts = [row.reading("mAs", unit="mAs")]
        factor = 1.0
    elif row.has("current_mA") and row.has("exposure_ms"):
        parts = [row.reading("current_mA", unit="mA"), row.reading("exposure_ms", unit="ms")]
        factor = 1e-3
    else:
        raise InputError(row.place, received="no tube load", expected="mAs, or current_mA and exposure_ms")
    value = factor * math.prod(part.value for part in parts)
    return value, math.sqrt(sum(part.relative_sd**2 for part in parts if part.resolution < 1.0))


def _calibration_sd(row: TableRow) -> float:
    if not row.has("uncertainty_percent"):
        return DOSIMETER_CALIBRATION_SD
    return row.reading("uncertainty_percent", unit="%", below=100.0).value / 100.0 / _COVERAGE_FACTOR


def _half_value(row: TableRow, kV: float, filters: tuple[Filter, ...], reading: Reading) -> KermaRatio:
    # the calibration cancels in a ratio; what its uncertainty stands for here is the layer itself
    stated = _calibration_sd(row) if row.has("uncertainty_percent") else 0.0
    scatter = math.hypot(REPEATABILITY * math.sqrt(2.0), _LN_2 * reading.relative_sd)
    return KermaRatio(
        kV=kV,
        filters=filters,
        layers=(Filter(material="Al", thickness_mm=reading.value),),
        value=0.5,
        relative_sd=math.hypot(scatter, _LN_2 * stated),
        rows=(row.line,),
    )


def _scatter_of(settings: Sequence[Sequence[_Kerma]]) -> tuple[float, int]:
    """Relative sd of a reading about its setting's mean, and the degrees of freedom that told it.

    Squares about the means, less what rounding explains, together with the assumed repeatability as so many more.
    """
    squares, freedom = 0.0, 0
    for readings in settings:
        logs = np.array([item.log_value for item in readings])
        rounding = float(np.mean([item.rounding_sd**2 for item in readings]))
        squares += max(float(np.sum((logs - logs.mean()) ** 2)) - (logs.size - 1) * rounding, 0.0)
        freedom += logs.size - 1
    total = squares + REPEATABILITY_WORTH * REPEATABILITY**2
    return math.sqrt(total / (freedom + REPEATABILITY_WORTH)), freedom


def _setting_of(
    kV: float, filters: tuple[Filter, ...], readings: Sequence[_Kerma], scatter: float, freedom: float
) -> KermaReading:
    variance = np.array([scatter**2 + item.rounding_sd**2 for item in readings])
    weight = 1.0 / variance
    logs = np.array([item.log_value for item in readings])
    calibration = np.array([item.calibration_sd for item in readings])
    return KermaReading(
        kV=kV,
        filters=filters,
        value=math.exp(float(weight @ logs / weight.sum())),
        relative_sd=float(weight.sum() ** -0.5),
        calibration_sd=float(weight @ calibration / weight.sum()),
        freedom=freedom,
        rows=tuple(item.line for item in readings),
    )
