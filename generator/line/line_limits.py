"""What a line can be set to: tube load, readout, belt and detector kind. What it cannot is one clear error.

Limits that the instrument declares are errors; a rule of thumb is a warning.
"""

from collections.abc import Iterator

from ...acquisition.instrument import Instrument
from ...acquisition.setting import Setting
from ...errors import InputError

_ROUNDING = 1.001  # a setting at its limit, written with three digits, is at its limit
_BELT_AGREES = 0.01  # share by which a TDI exposure may differ from what the belt makes it


def permitted_focal_power_W(focal_spot_mm: float) -> float:
    """Power (W) at which a stationary tungsten anode begins to melt under a round focal spot of this width.

    P = 1.4 d^0.88 with d in um: about 40 W at 0.05 mm, 80 W at 0.1 mm, 270 W at 0.4 mm. Rotating and liquid anodes take
    many times as much; lines that are long in projection take more as well. A rule of thumb, 10 um to 1 mm.

    Raises:
        InputError: a width that is not above 0.

    Source: Flynn, Hames, Reimann, Wilderman, Nucl. Instrum. Meth. A 353 (1994) 312, after the melting of targets under
        electron beams in Grider, Wright, Ausburn, J. Phys. D 19 (1986) 2281.
    """
    if not focal_spot_mm > 0:
        raise InputError("focal_spot_mm", received=f"{focal_spot_mm} mm", expected="a width above 0 mm")
    return float(1.4 * (1000.0 * focal_spot_mm) ** 0.88)


def line_period_ms(instrument: Instrument, setting: Setting) -> float | None:
    """Time (ms) in which the belt moves the object by one (binned) pixel of its image; None where speed or pitch is unknown.

    period = b a / (M v): b binning, a pixel pitch, M magnification (1 where a distance is unknown), v belt speed.
    """
    if setting.belt_speed_mm_s is None or instrument.pixel_mm is None:
        return None
    distance = setting.source_detector_mm or instrument.source_detector_mm
    at_object = instrument.source_object_mm
    magnification = 1.0 if distance is None or at_object is None else distance / at_object
    return 1000.0 * setting.binning * instrument.pixel_mm / (magnification * setting.belt_speed_mm_s)


def shortest_interval_ms(instrument: Instrument, setting: Setting) -> float:
    """Shortest time (ms) from the start of one frame or line to the next: exposure and readout, or the longer of the two
    where the readout overlaps the next exposure."""
    readout = instrument.readout_ms or 0.0
    exposure = setting.exposure_ms
    if instrument.detector == "tdi":
        # the stages are read out line by line while all of them go on collecting
        return max(exposure / (instrument.tdi_stages or 1), readout)
    return max(exposure, readout) if instrument.readout_overlaps else exposure + readout


def frames_per_s(instrument: Instrument, setting: Setting) -> float:
    """Frames (lines for line and TDI detectors) a second at this setting, averaging done."""
    interval = setting.frame_interval_ms or shortest_interval_ms(instrument, setting)
    return 1000.0 / (interval * setting.averaged)


def check_limits(instrument: Instrument, setting: Setting) -> tuple[str, ...]:
    """Warnings where a setting strains a rule of thumb; an error where the declared instrument cannot be set so.

    Raises:
        InputError: tube voltage, current or power above the tube's; frames or lines closer together than exposure and
            readout take; an exposure that a line or TDI detector cannot have at this belt speed.
    """
    for broken in broken_limits(instrument, setting):
        raise broken
    return strained_limits(instrument, setting)


def broken_limits(instrument: Instrument, setting: Setting) -> tuple[InputError, ...]:
    """Every declared limit of tube, readout and belt that a setting breaks, as errors; `check_limits` raises the first."""
    return (*_of_tube(instrument, setting), *_of_timing(instrument, setting))


def check_count_rate(instrument: Instrument, setting: Setting, counts: float) -> None:
    """Raise where a counting pixel would count (in one exposure) faster than its declared limit before pile-up.

    Raises:
        InputError: counts a second above the instrument's `maximum_counts_per_s`.
    """
    limit = instrument.maximum_counts_per_s
    # a physical pixel counts, whatever is combined afterwards
    rate = counts / setting.binning**2 / (setting.exposure_ms / 1000.0)
    if limit is not None and rate > _ROUNDING * limit:
        raise InputError(
            "setting",
            received=f"{rate:.3g} counts a second in one pixel",
            expected=f"at most the detector's {limit:g} counts a second, beyond which counts pile up",
            remedy="lower the current, or filter more",
        )


def _of_tube(instrument: Instrument, setting: Setting) -> Iterator[InputError]:
    current = setting.tube_current_mA
    power = None if current is None else current * setting.kV
    limits = [
        (setting.kV, instrument.maximum_kV, "kV", "the tube's", "lower the tube voltage"),
        (current, instrument.maximum_current_mA, "mA", "the tube's", "lower the current"),
        (power, instrument.maximum_power_w, "W", "the tube's", "lower the current or the tube voltage"),
    ]
    if instrument.focal_power_w_per_mm is not None and instrument.focal_spot_mm:
        focal = instrument.focal_power_w_per_mm * instrument.focal_spot_mm
        told = f"a focal spot of {instrument.focal_spot_mm:g} mm at {instrument.focal_power_w_per_mm:g} W/mm takes:"
        limits.append((power, focal, "W", told, "lower the power, or declare the larger focal spot it is driven with"))
    for value, limit, unit, whose, remedy in limits:
        if value is not None and limit is not None and value > _ROUNDING * limit:
            yield InputError(
                "setting", received=f"{value:.4g} {unit}", expected=f"at most {whose} {limit:g} {unit}", remedy=remedy
            )


def _of_timing(instrument: Instrument, setting: Setting) -> Iterator[InputError]:
    what = "frames" if instrument.detector in (None, "area") else "lines"
    shortest = shortest_interval_ms(instrument, setting)
    interval = setting.frame_interval_ms
    if interval is not None and interval * _ROUNDING < shortest:
        yield InputError(
            "frame_interval_ms",
            received=f"{interval:g} ms between {what}",
            expected=f"at least {shortest:.4g} ms for an exposure of {setting.exposure_ms:g} ms"
            f" and {instrument.readout_ms or 0.0:g} ms of readout",
            remedy="expose shorter or take frames more slowly",
        )
    period = line_period_ms(instrument, setting)
    if period is None or instrument.detector in (None, "area"):
        return
    if instrument.detector == "tdi":
        if instrument.tdi_stages is None:
            return
        belt = period * instrument.tdi_stages
        if abs(setting.exposure_ms - belt) > _BELT_AGREES * belt:
            yield InputError(
                "exposure_ms",
                received=f"{setting.exposure_ms:g} ms",
                expected=f"{belt:.4g} ms: {instrument.tdi_stages} stages of {period:.4g} ms at"
                f" {setting.belt_speed_mm_s:g} mm/s",
                remedy="the belt sets the exposure of a TDI detector",
            )
    if shortest > _ROUNDING * period:
        yield InputError(
            "exposure_ms",
            received=f"{shortest:.4g} ms a line with its readout",
            expected=f"at most {period:.4g} ms, in which the belt moves one pixel at {setting.belt_speed_mm_s:g} mm/s",
            remedy="expose shorter or slow the belt down",
        )
    if interval is not None and abs(interval - period) > _BELT_AGREES * period:
        yield InputError(
            "frame_interval_ms",
            received=f"{interval:g} ms between lines",
            expected=f"{period:.4g} ms, in which the belt moves one pixel at {setting.belt_speed_mm_s:g} mm/s",
            remedy="a line detector is triggered by the belt; leave frame_interval_ms out",
        )


def strained_limits(instrument: Instrument, setting: Setting) -> tuple[str, ...]:
    """Rules of thumb that the setting breaks, where nothing was declared."""
    current = setting.tube_current_mA
    declared = instrument.maximum_power_w is not None or instrument.focal_power_w_per_mm is not None
    if current is None or declared or not instrument.focal_spot_mm or instrument.anode not in (None, "W"):
        return ()
    permitted = permitted_focal_power_W(instrument.focal_spot_mm)
    power = current * setting.kV
    if power <= permitted:
        return ()
    return (
        f"{power:.4g} W on a focal spot of {instrument.focal_spot_mm:g} mm: a stationary tungsten anode takes about"
        f" {permitted:.3g} W; declare maximum_power_w where this tube takes more",
    )
