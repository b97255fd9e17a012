"""What the page's controls say: one immutable state, the ranges of its numbers, and the first state of a twin."""

import math
from dataclasses import dataclass, replace

from ..acquisition.setting import Filter, Setting
from ..errors import InputError
from ..generator.line.twin import Twin
from ..spectra import MAXIMUM_KV_OF_ANODE, MINIMUM_KV

BEAMS = ("low", "high")
DEFAULT_PRODUCT = Filter(material="chicken_breast", thickness_mm=20.0)
DEFAULT_OBJECT = Filter(material="bone_cortical_icru44", thickness_mm=1.0)
_TYPICAL_KV = 160.0  # most inspection tubes end here; a line that states more gets more
_TYPICAL_POWER_W = 500.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranges:
    """Ends of the page's sliders, each (lowest, highest): kV, power_W, exposure_ms, source_detector_mm."""

    kV: tuple[float, float]
    power_W: tuple[float, float]
    exposure_ms: tuple[float, float]
    source_detector_mm: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExplorerState:
    """A pair of settings of the line, and what lies in the beam.

    Fields: kV_low, kV_high; power_low_W, power_high_W; filters_low, filters_high (layers in each beam); exposure_ms (one
    frame, both images); averaged (frames); source_detector_mm (None: the instrument's); product and foreign_object (slabs,
    material and thickness); object_pixels (the object as a disc of so many pixels); displaces (it takes the product's place);
    seed (of the noise in the pair of images).

    Raises:
        InputError: a number that no setting can have, or an object that displaces more product than there is.
    """

    kV_low: float
    kV_high: float
    power_low_W: float
    power_high_W: float
    filters_low: tuple[Filter, ...]
    filters_high: tuple[Filter, ...]
    exposure_ms: float
    averaged: int = 1
    source_detector_mm: float | None = None
    product: Filter = DEFAULT_PRODUCT
    foreign_object: Filter = DEFAULT_OBJECT
    object_pixels: int = 100
    displaces: bool = False
    seed: int = 1

    def __post_init__(self) -> None:
        for beam in BEAMS:
            self.setting(beam)
        for name, layer in (("product", self.product), ("foreign_object", self.foreign_object)):
            if not layer.thickness_mm > 0:
                raise InputError(name, received=str(layer), expected="a thickness above 0 mm")
        if not 1 <= self.object_pixels <= 1_000_000:
            raise InputError("object_pixels", received=self.object_pixels, expected="1 to 1000000 pixels")

    def setting(self, beam: str) -> Setting:
        """The setting of the `low` or the `high` image."""
        return Setting(
            kV=self.kV_low if beam == "low" else self.kV_high,
            power_W=self.power_low_W if beam == "low" else self.power_high_W,
            filters=self.filters_low if beam == "low" else self.filters_high,
            exposure_ms=self.exposure_ms,
            averaged=self.averaged,
            source_detector_mm=self.source_detector_mm,
        )


def ranges_of(twin: Twin) -> Ranges:
    """What can be dialled in: the tube's declared limits with a little beyond them, so that a broken one can be seen."""
    instrument = twin.instrument
    anode = twin.spectral.anode if twin.spectral is not None else "W"
    highest_kV = MAXIMUM_KV_OF_ANODE.get(anode, _TYPICAL_KV)
    stated_kV = max(instrument.maximum_kV or 0.0, *(level.kV or 0.0 for level in twin.levels), 0.0)
    distance = instrument.source_detector_mm or 1000.0
    return Ranges(
        kV=(max(MINIMUM_KV, 15.0), min(highest_kV, max(_TYPICAL_KV, 10.0 * math.ceil(0.11 * stated_kV)))),
        power_W=(1.0, round(1.5 * (instrument.maximum_power_w or _TYPICAL_POWER_W))),
        exposure_ms=(0.1, 10_000.0),
        source_detector_mm=(round(0.3 * distance), round(3.0 * distance)),
    )


def first_state(twin: Twin) -> ExplorerState:
    """The state that the page opens with: the calibrated voltages furthest apart with their filters, half of the tube's power."""
    ranges = ranges_of(twin)
    power_W = 0.5 * (twin.instrument.maximum_power_w or 80.0)
    levels = sorted(
        ((level.kV, level.filters) for level in twin.levels if level.kV is not None), key=lambda one: one[0]
    )
    state = ExplorerState(
        kV_low=40.0,
        kV_high=min(90.0, ranges.kV[1]),
        power_low_W=power_W,
        power_high_W=power_W,
        filters_low=(),
        filters_high=(),
        exposure_ms=20.0,
    )
    if not levels:
        return state
    (lowest_kV, filters_low), (highest_kV, filters_high) = levels[0], levels[-1]
    return replace(
        state,
        kV_low=lowest_kV,
        kV_high=highest_kV if highest_kV > lowest_kV else min(2.0 * lowest_kV, ranges.kV[1]),
        filters_low=filters_low,
        filters_high=filters_high,
    )
