"""A calibrated observer as a JSON file."""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..acquisition.setting import setting_from_text
from ..errors import FileFormatError, InputError
from ..files import whole_file
from .efficiency import Efficiency, LeftOut
from .observe import Observer

FORMAT = "raytwin-observer"
VERSION = 1


def efficiency_to_mapping(efficiency: Efficiency) -> dict[str, Any]:
    """Plain numbers, texts, lists and dictionaries."""
    rows = [
        {**{name: getattr(one, name) for name in ("measured", "predicted", "low", "high", "log_sd")},
         "setting": f"{one.pair[0]};{one.pair[1]}"}
        for one in efficiency.left_out
    ]  # fmt: skip
    return {
        "format": FORMAT,
        "version": VERSION,
        "observer": asdict(efficiency.observer),
        "covariance": [list(row) for row in efficiency.covariance],
        "unit": efficiency.unit,
        "scatter": efficiency.scatter,
        "size": efficiency.size_name,
        "product_material": efficiency.product_material,
        "foreign_material": efficiency.foreign_material,
        "left_out": rows,
    }


def efficiency_from_mapping(values: Mapping[str, Any], *, where: str = "calibrated observer") -> Efficiency:
    """The inverse of `efficiency_to_mapping`.

    Raises:
        FileFormatError: something else, or another version.
    """
    if values.get("format") != FORMAT or values.get("version") != VERSION:
        raise FileFormatError(
            where,
            received=f"format {values.get('format')!r}, version {values.get('version')!r}",
            expected=f"{FORMAT}, version {VERSION}",
            remedy="`raytwin observe --networks SWEEP --save FILE` writes one",
        )
    try:
        (a, b), (c, d) = values["covariance"]
        rows = []
        for one in values["left_out"]:
            low, _, high = str(one["setting"]).partition(";")
            numbers = {name: float(one[name]) for name in ("measured", "predicted", "low", "high", "log_sd")}
            rows.append(LeftOut(pair=(setting_from_text(low), setting_from_text(high)), **numbers))
        return Efficiency(
            observer=Observer(**values["observer"]),
            covariance=((float(a), float(b)), (float(c), float(d))),
            unit=float(values["unit"]),
            scatter=float(values["scatter"]),
            left_out=tuple(rows),
            size_name=str(values["size"]),
            **{name: values.get(name) for name in ("product_material", "foreign_material")},
        )
    except (KeyError, TypeError, ValueError, InputError) as error:
        raise FileFormatError(
            where, received=f"an incomplete file ({error})", expected="a whole calibrated observer"
        ) from None


def write_efficiency(path: str | os.PathLike[str], efficiency: Efficiency) -> None:
    """Write a calibrated observer as JSON, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(efficiency_to_mapping(efficiency), indent=1) + "\n", encoding="utf-8")


def read_efficiency(path: str | os.PathLike[str]) -> Efficiency:
    """Read a calibrated observer.

    Raises:
        InputError: no such file.
        FileFormatError: a file of another kind.
    """
    file = Path(path)
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(str(path), received="no such file", expected="a calibrated observer (JSON)") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FileFormatError(
            str(path), received=f"a file that is not JSON ({error})", expected="a calibrated observer"
        ) from None
    return efficiency_from_mapping(values if isinstance(values, dict) else {}, where=str(path))
