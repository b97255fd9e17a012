"""A setting of the line: tube voltage, load, filter, exposure. The text form is the SETTING of the command line."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

from ..errors import LARGEST, InputError, check_number

LARGEST_BINNING = 64


def _number(value: float) -> str:
    """The shortest text that reads back as the same number, without the '+' that joins filters."""
    return repr(float(value)).removesuffix(".0").replace("e+", "e")


@dataclass(frozen=True, slots=True, kw_only=True)
class Filter:
    """A flat layer in the beam: a material by name and its thickness in mm.

    Example:
        >>> print(rt.Filter(material="Cu", thickness_mm=0.1))
        Cu:0.1
    """

    material: str
    thickness_mm: float

    def __post_init__(self) -> None:
        if not self.material or any(letter in self.material for letter in "+,="):
            raise InputError(
                "filter material",
                received=repr(self.material),
                expected="a material name without '+', ',' or '='",
                remedy="write filters as MATERIAL:mm, for example Cu:0.05",
            )
        if not (math.isfinite(self.thickness_mm) and self.thickness_mm >= 0):
            raise InputError(
                f"thickness of filter {self.material}",
                received=f"{self.thickness_mm} mm",
                expected="a finite thickness of 0 mm or more",
            )

    def __str__(self) -> str:
        return f"{self.material}:{_number(self.thickness_mm)}"


def filter_from_text(text: str) -> Filter:
    """One filter from `MATERIAL:mm`, for example `Cu:0.05` or `Gd2O2S@7.32:0.2`."""
    material, colon, thickness = text.strip().rpartition(":")
    try:
        if not colon:
            raise ValueError
        thickness_mm = float(thickness)
    except ValueError:
        raise InputError(
            "filter", received=repr(text), expected="MATERIAL:mm", remedy="for example Cu:0.05 or water:20"
        ) from None
    return Filter(material=material.strip(), thickness_mm=thickness_mm)


def filters_from_text(text: str) -> tuple[Filter, ...]:
    """Filters joined by `+`, in the order the beam meets them; the empty text is no filter."""
    return tuple(filter_from_text(part) for part in text.split("+")) if text.strip() else ()


def text_from_filters(filters: Iterable[Filter]) -> str:
    """The inverse of `filters_from_text`."""
    return "+".join(str(layer) for layer in filters)


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What a person dials in for one series of frames.

    Fields: kV (tube voltage); current_mA or power_W (at most one is needed; power = kV x mA); exposure_ms (one frame; of
    a line detector one line, of a TDI detector all its stages together); filters (in the beam's order); averaged (frames
    averaged into one); source_detector_mm (None: the instrument's); binning (b x b pixels combined into one);
    frame_interval_ms (from the start of one frame or line to the next; None: as fast as the detector goes);
    belt_speed_mm_s (None: unknown or at rest).

    Example:
        >>> setting = rt.Setting(kV=60, power_W=30, exposure_ms=20, filters=(rt.Filter(material="Cu", thickness_mm=0.1),))
        >>> print(setting)
        kv=60,power_w=30,exposure_ms=20,filter=Cu:0.1
    """

    kV: float
    exposure_ms: float
    current_mA: float | None = None
    power_W: float | None = None
    filters: tuple[Filter, ...] = ()
    averaged: int = 1
    source_detector_mm: float | None = None
    binning: int = 1
    frame_interval_ms: float | None = None
    belt_speed_mm_s: float | None = None

    def __post_init__(self) -> None:
        for name, unit in (
            ("kV", "kV"),
            ("exposure_ms", "ms"),
            ("current_mA", "mA"),
            ("power_W", "W"),
            ("source_detector_mm", "mm"),
            ("frame_interval_ms", "ms"),
            ("belt_speed_mm_s", "mm/s"),
        ):
            value = getattr(self, name)
            if value is not None:
                check_number(name, value, unit=unit)
            # squares and reciprocals of these numbers are taken
            if value is not None and not 1.0 / LARGEST <= value <= LARGEST:
                raise InputError(
                    name,
                    received=f"{value} {unit}",
                    expected=f"a finite value above 0 {unit}, {1.0 / LARGEST:g} to {LARGEST:g}",
                )
        filters: object = self.filters
        if not (isinstance(filters, tuple | list) and all(isinstance(layer, Filter) for layer in filters)):
            raise InputError(
                "filters",
                received=repr(self.filters),
                expected='a tuple of filters, such as (Filter(material="Cu", thickness_mm=0.05),)',
                remedy="settings as text take filter=Cu:0.05",
            )
        for name in ("averaged", "binning"):
            check_number(name, getattr(self, name))
        if not 1 <= self.averaged <= LARGEST or self.averaged != int(self.averaged):
            raise InputError("averaged", received=self.averaged, expected="a whole number of frames, 1 or more")
        if not 1 <= self.binning <= LARGEST_BINNING or self.binning != int(self.binning):
            raise InputError("binning", received=self.binning, expected=f"a whole number from 1 to {LARGEST_BINNING}")
        if self.current_mA is not None and self.power_W is not None:
            implied_W = self.kV * self.current_mA
            if abs(implied_W - self.power_W) > 0.01 * self.power_W:
                raise InputError(
                    "current_mA and power_W",
                    received=f"{self.current_mA:g} mA and {self.power_W:g} W at {self.kV:g} kV",
                    expected=f"power = kV x mA = {implied_W:g} W within 1 %",
                    remedy="give one of the two",
                )

    @property
    def tube_current_mA(self) -> float | None:
        """Tube current (mA), from the power where that was given; None where neither is known."""
        if self.current_mA is not None:
            return self.current_mA
        return None if self.power_W is None else self.power_W / self.kV

    @property
    def tube_load_mAs(self) -> float | None:
        """Charge of one frame (mAs), or None where neither current nor power is known."""
        current = self.tube_current_mA
        return None if current is None else current * self.exposure_ms / 1000.0

    def with_current_times(self, factor: float) -> "Setting":
        """The setting with its tube current, or power, times a factor; all else as it is.

        Example:
            >>> from raytwin.acquisition.setting import Setting
            >>> Setting(kV=40, power_W=20, exposure_ms=20).with_current_times(0.5).power_W
            10.0
        """
        return replace(
            self,
            current_mA=None if self.current_mA is None else factor * self.current_mA,
            power_W=None if self.power_W is None else factor * self.power_W,
        )

    def stated_load_mAs(self) -> float:
        """Charge of one frame (mAs).

        Raises:
            InputError: neither current nor power is known.

        Example:
            >>> from raytwin.acquisition.setting import Setting
            >>> Setting(kV=40, power_W=20, exposure_ms=20).stated_load_mAs()
            0.01
        """
        load = self.tube_load_mAs
        if load is None:
            raise InputError(
                "setting",
                received=str(self),
                expected="a tube load",
                remedy="give power_w or current_ma (--power-w or --current-ma)",
            )
        return load

    def __str__(self) -> str:
        words = [f"kv={_number(self.kV)}"]
        if self.power_W is not None:
            words.append(f"power_w={_number(self.power_W)}")
        elif self.current_mA is not None:
            words.append(f"current_ma={_number(self.current_mA)}")
        words.append(f"exposure_ms={_number(self.exposure_ms)}")
        if self.filters:
            words.append(f"filter={text_from_filters(self.filters)}")
        if self.averaged != 1:
            words.append(f"averaged={int(self.averaged)}")
        if self.source_detector_mm is not None:
            words.append(f"source_detector_mm={_number(self.source_detector_mm)}")
        if self.binning != 1:
            words.append(f"binning={int(self.binning)}")
        for name in ("frame_interval_ms", "belt_speed_mm_s"):
            value = getattr(self, name)
            if value is not None:
                words.append(f"{name}={_number(value)}")
        return ",".join(words)


_FIELD_OF_WORD = {name.lower(): name for name in (field.name for field in fields(Setting)) if name != "filters"}


def setting_from_text(text: str) -> Setting:
    """A setting from its text form, for example `kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05+Al:1,averaged=10`.

    Raises:
        InputError: an unknown or repeated word, a value that is no number, or kV or exposure missing.
    """
    values: dict[str, object] = {}
    for part in text.split(","):
        word, equals, value = (piece.strip() for piece in part.partition("="))
        name = "filters" if word.lower() == "filter" else _FIELD_OF_WORD.get(word.lower())
        if not equals or name is None or name in values:
            raise InputError(
                "setting",
                received=f"{part!r} in {text!r}",
                expected="each of kv, power_w or current_ma, exposure_ms, filter, averaged, source_detector_mm, binning,"
                " frame_interval_ms, belt_speed_mm_s at most once, as word=value joined by commas",
                remedy="for example kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05",
            )
        if name == "filters":
            values[name] = filters_from_text(value)
            continue
        whole = name in ("averaged", "binning")
        try:
            values[name] = int(value) if whole else float(value)
        except ValueError:
            expected = "a whole number" if whole else "a number"
            raise InputError(f"setting, {word}", received=repr(value), expected=expected) from None
    for name in ("kV", "exposure_ms"):
        if name not in values:
            raise InputError("setting", received=repr(text), expected=f"{name.lower()}=... among its words")
    return Setting(**values)  # type: ignore[arg-type]
