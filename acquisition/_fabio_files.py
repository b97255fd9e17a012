"""EDF and the other detector formats that fabio reads, and the exposure and pixel size in their headers."""

import logging
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, MissingDependencyError
from ._image_header import ImageHeader, number_of_text
from ._picture_checks import damaged, missing_library, one_channel

# the class by the ending: fabio's own choice looks at more formats than raytwin should open
_CODECS = {
    ".edf": "edfimage",
    ".cbf": "cbfimage",
    ".mccd": "marccdimage",
    ".spe": "speimage",
    ".mar1200": "mar345image",
    ".mar1600": "mar345image",
    ".mar2300": "mar345image",
    ".mar3450": "mar345image",
    ".kcd": "kcdimage",
    ".esper": "esperantoimage",
}
# keys of EDF headers, in small letters: SAXS keys of ESRF ID02 (seconds, metres), Lima (seconds), SPEC
_EXPOSURE_S = ("exposuretime", "acq_expo_time", "exposure_time", "exposure", "count_time", "exposuretime_s")
_PIXEL_M = ("psize_1", "pixelsize_1")
_CBF_SECTION = b"--CIF-BINARY-FORMAT-SECTION--"
_CBF_MARK = b"\x0c\x1a\x04\xd5"  # ends the header of the binary section
_CBF_EXPOSURE = re.compile(r"Exposure_time\s+([\d.eE+-]+)\s*s")
_CBF_PERIOD = re.compile(r"Exposure_period\s+([\d.eE+-]+)\s*s")
_CBF_PIXEL = re.compile(r"Pixel_size\s+([\d.eE+-]+)\s*m")


def iter_fabio(path: Path) -> Iterator[NDArray[Any]]:
    """Yield the frames (row, column) in the order in which they are stored.

    Raises:
        FileFormatError: damaged, or another format than its ending says.
        MissingDependencyError: fabio is not installed.
    """
    with _opened(path) as (image, faults):
        for number in range(image.nframes):
            frame = image.data if image.nframes == 1 else image.getframe(number).data
            if frame is None or faults:
                raise ValueError(faults[0] if faults else "no image in it")
            values = np.asarray(frame)
            yield one_channel(path, values.astype(values.dtype.newbyteorder("="), copy=False))


def fabio_header(path: Path) -> ImageHeader:
    """Exposure and pixel size where the format has keys for them (EDF, CBF, MarCCD).

    Raises:
        FileFormatError: a header that cannot be read.
        MissingDependencyError: fabio is not installed.
    """
    with _opened(path) as (image, _):
        words = {str(key).lower(): str(value) for key, value in dict(image.header).items()}
        return _header(path.suffix.lower(), words)


def _header(ending: str, words: Mapping[str, str]) -> ImageHeader:
    if ending == ".cbf":
        text = words.get("_array_data.header_contents", "")
        exposure_s, period_s, pixel_m = (_found(form, text) for form in (_CBF_EXPOSURE, _CBF_PERIOD, _CBF_PIXEL))
        return ImageHeader(
            exposure_ms=_times(exposure_s, 1000.0),
            frame_interval_ms=_times(period_s, 1000.0),
            pixel_mm=_times(pixel_m, 1000.0),
        )
    if ending == ".mccd":  # marCCD keeps milliseconds and nanometres
        return ImageHeader(
            exposure_ms=_times(number_of_text(words.get("exposure_time")), 1.0),
            pixel_mm=_times(number_of_text(words.get("pixelsize_x")), 1e-6),
        )
    if ending == ".edf":
        exposure_s = next((one for key in _EXPOSURE_S if (one := number_of_text(words.get(key)))), None)
        pixel_m = next((one for key in _PIXEL_M if (one := number_of_text(words.get(key)))), None)
        return ImageHeader(exposure_ms=_times(exposure_s, 1000.0), pixel_mm=_times(pixel_m, 1000.0))
    return ImageHeader()


def _found(form: re.Pattern[str], text: str) -> float | None:
    match = form.search(text)
    return None if match is None else number_of_text(match.group(1))


def _times(value: float | None, factor: float) -> float | None:
    return value * factor if value else None


class _Keep(logging.Handler):
    def __init__(self, faults: list[str]) -> None:
        super().__init__(logging.ERROR)
        self._faults = faults

    def emit(self, record: logging.LogRecord) -> None:
        self._faults.append(record.getMessage())


def _check_cbf(path: Path) -> None:
    """Refuse a CBF file without binary section or its mark: fabio would look for the mark for ever."""
    data = path.read_bytes()
    section = data.find(_CBF_SECTION)
    if section < 0 or data.find(_CBF_MARK, section) < 0:
        raise ValueError("no binary section")


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, list[str]]]:
    """The open file, and a list that takes what fabio logs as an error: it fills up what is missing with zeros."""
    try:
        import fabio
    except ImportError:
        raise missing_library(path, what=f"a file {path.suffix}", extra="fabio") from None
    faults: list[str] = []
    keep = _Keep(faults)
    logger = logging.getLogger("fabio")
    passed_on = logger.propagate
    logger.addHandler(keep)
    logger.propagate = False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            if path.suffix.lower() == ".cbf":
                _check_cbf(path)
            image = fabio.factory(_CODECS[path.suffix.lower()]).read(str(path))
            try:
                yield image, faults
            finally:
                image.close()
    except (InputError, MissingDependencyError, GeneratorExit):
        raise
    except Exception as error:  # the readers behind fabio raise whatever they like at damaged files
        raise damaged(path, error) from None
    finally:
        logger.removeHandler(keep)
        logger.propagate = passed_on
