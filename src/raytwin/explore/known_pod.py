"""POD curves that are known of a line: read once, asked at the contrast of what is seen."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import FileFormatError, FitError, InputError
from ..pod.answer import trusted_from_answer


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownPod:
    """A POD curve of earlier images.

    Fields: name (of its file); size_name (what POD is a function of); a90 with the ends of its two-sided 95 % interval (None
    where the data support none); fit (of hits and misses; None where only the answer of `raytwin pod --json` is known).
    """

    name: str
    size_name: str
    a90: float | None
    a90_low: float | None
    a90_high: float | None
    fit: Any = field(default=None, repr=False, compare=False)

    @property
    def of_contrast(self) -> bool:
        """Whether POD is a function of contrast, the size that the page knows of what it shows."""
        return self.size_name == "contrast"

    def pod_at(self, contrast: float) -> tuple[float, float, float] | None:
        """POD with its two-sided 95 % interval at a contrast; None where the curve cannot say."""
        if self.fit is None or not self.of_contrast or not contrast > 0:
            return None
        import numpy as np

        from ..pod.band import curve_with_band

        try:
            value, low, high = (float(one[0]) for one in curve_with_band(self.fit, np.array([contrast])))
        except FitError:
            return None
        return value, low, high


def read_known_pod(path: str | os.PathLike[str]) -> KnownPod:
    """A POD curve from the answer of `raytwin pod --json` (.json), or fitted to a table of hits (.csv).

    Raises:
        InputError, FileFormatError: no such file, another kind of file, or a table that no curve can be fitted to.
    """
    file = Path(path)
    if file.suffix.lower() != ".json":
        return _of_table(file)
    try:
        answer = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            str(path), received="no such file", expected="a POD table or the answer of `raytwin pod`"
        ) from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FileFormatError(
            str(path), received=f"no JSON ({error})", expected="what `raytwin pod --json` prints"
        ) from None
    if not (isinstance(answer, Mapping) and {"a90", "a90_95_two_sided", "size"} <= answer.keys()):
        raise FileFormatError(
            str(path), received="JSON without a90 and its bounds", expected="what `raytwin pod --json` prints"
        )
    return KnownPod(
        name=file.name,
        size_name=str(answer["size"]),
        a90=_number(answer["a90"], file),
        a90_low=_bound(answer, "a90_low_two_sided", file),
        a90_high=_bound(answer, "a90_95_two_sided", file),
    )


def _of_table(file: Path) -> KnownPod:
    from ..api.curves import fit_pod

    curve = fit_pod(file)
    answer = curve.to_dict()
    return KnownPod(
        name=file.name,
        size_name=curve.table.size_name,
        a90=curve.a90,
        a90_low=_bound(answer, "a90_low_two_sided", file),
        a90_high=_bound(answer, "a90_95_two_sided", file),
        fit=curve.fit,
    )


def _bound(answer: Mapping[str, Any], name: str, file: Path) -> float | None:
    return _number(trusted_from_answer(answer, name), file)


def _number(value: Any, file: Path) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FileFormatError(str(file), received=repr(value), expected="a number or null for a size")
    return float(value)
