"""The belt of a setting: the motion that it makes in images."""

from dataclasses import replace

from ...acquisition.instrument import Instrument
from ...acquisition.setting import Setting
from ...errors import InputError
from ..effects import AppliedEffect
from ..effects.motion_blur import MOTION_BLUR, STATED_MS
from ..line.belt_path import belt_path_px
from ..line.twin import Twin


def motion_strength_px(instrument: Instrument, setting: Setting) -> float | None:
    """Path (px) of the object's image in 50 ms on the belt, as the effect `motion_blur` states it; None where there is none."""
    if setting.belt_speed_mm_s is None or instrument.pixel_mm is None:
        return None
    return belt_path_px(
        instrument,
        speed_mm_s=setting.belt_speed_mm_s,
        exposure_ms=STATED_MS,
        magnification=instrument.magnification or 1.0,
        pixel_mm=instrument.pixel_mm,
    )


def check_one_belt(pair: tuple[Setting, Setting]) -> None:
    """Refuse a pair of settings whose belts run at two speeds.

    Raises:
        InputError: two speeds.
    """
    if pair[0].belt_speed_mm_s != pair[1].belt_speed_mm_s:
        raise InputError(
            "belt_speed_mm_s",
            received=f"{pair[0].belt_speed_mm_s} and {pair[1].belt_speed_mm_s} mm/s",
            expected="one speed for both images: there is one belt",
        )


def twin_on_belt(twin: Twin, pair: tuple[Setting, Setting]) -> tuple[Twin, tuple[str, ...]]:
    """The twin with the motion that the pair's belt speed makes in its images, and warnings.

    A `motion_blur` of the twin itself, measured at the belt speed of its session, gives way to it.

    Raises:
        InputError: two speeds, or frames averaged while the belt moves.
    """
    check_one_belt(pair)
    if pair[0].belt_speed_mm_s is not None and max(one.averaged for one in pair) > 1:
        raise InputError(
            "averaged",
            received=f"{max(one.averaged for one in pair)} frames on a moving belt",
            expected="averaged = 1: their mean shows the object in several places",
        )
    strength = motion_strength_px(twin.instrument, pair[0])
    if strength is None:
        if pair[0].belt_speed_mm_s is not None:
            return twin, ("the belt's motion is not in the images: the twin does not know its pixel pitch",)
        return twin, ()
    told = []
    own = [item for item in twin.effects if item.id == MOTION_BLUR.id]
    if own:
        told.append("the twin's own motion blur gives way to that of the setting's belt speed")
    # rows of a line camera are lines taken one after another
    if twin.instrument.belt_axis is None and twin.instrument.detector not in ("line", "tdi"):
        told.append("the belt is taken to move along the rows' index: the twin's belt_axis is not declared")
    motion = AppliedEffect(id=MOTION_BLUR.id, parameters={"strength": strength}, since="calibration")
    rest = tuple(item for item in twin.effects if item.id != MOTION_BLUR.id)
    return replace(twin, effects=(*rest, motion)), tuple(told)
