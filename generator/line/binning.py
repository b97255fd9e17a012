"""Pixels combined into one: what b x b binning does to signal and noise."""

from dataclasses import dataclass

from ...acquisition.instrument import BINNINGS
from ...acquisition.setting import Setting
from ...errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class Binned:
    """How one binned pixel stands to one pixel.

    Fields: signal (binned DN over a pixel's DN); quantum (binned variance over a pixel's gain x signal, b^2 x the share of
    the spread left to the caller); electronic (binned variance over a pixel's electronic variance); at_the_adc (signal
    that the ADC must hold, over a pixel's DN); pixels (b^2).
    """

    signal: float
    quantum: float
    electronic: float
    at_the_adc: float
    pixels: int


def binned_pixel(binning: int, adds: str | None) -> Binned:
    """What b x b binning makes of a pixel's signal and noise.

    `mean` and `sum` combine numbers after readout, each pixel with its own electronic noise and rounding; `charge` adds
    the charge of the pixels before the one readout, whose ADC must then hold b^2 times the signal. None is `mean`.

    Raises:
        InputError: another word.
    """
    if adds not in (None, *BINNINGS):
        raise InputError("binning_adds", received=adds, expected="one of " + ", ".join(BINNINGS))
    pixels = binning**2
    if adds in (None, "mean"):
        return Binned(signal=1.0, quantum=1 / pixels, electronic=1 / pixels, at_the_adc=1.0, pixels=pixels)
    charge = adds == "charge"
    return Binned(
        signal=pixels,
        quantum=pixels,
        electronic=1.0 if charge else pixels,
        at_the_adc=pixels if charge else 1.0,
        pixels=pixels,
    )


def refuse_binning(*settings: Setting) -> None:
    """Raise where a setting combines pixels, for what is computed in single pixels.

    Raises:
        InputError: a setting with binning.
    """
    for setting in settings:
        if setting.binning != 1:
            raise InputError(
                "binning",
                received=f"{setting.binning} in {setting}",
                expected="binning 1 here: images and contrasts are those of the calibrated pixels",
                remedy="calibrate from binned frames with the binned pixel's pixel_mm to work with them",
            )
