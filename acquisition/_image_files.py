"""Images out of TIFF, PNG, FITS, DICOM, HIS, EDF and raw files, one at a time; every fault names the file."""

import logging
import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, InputError
from ._picture_checks import damaged, missing_library, one_channel

TIFF_ENDINGS = (".tif", ".tiff")
RAW_ENDINGS = (".raw", ".bin", ".img")
FITS_ENDINGS = (".fits", ".fit", ".fts")
DICOM_ENDINGS = (".dcm", ".dicom", ".dic", ".dcn")
HIS_ENDINGS = (".his",)
# of the formats that fabio knows: those whose ending says which one it is
FABIO_ENDINGS = (".edf", ".cbf", ".mccd", ".spe", ".mar1200", ".mar1600", ".mar2300", ".mar3450", ".kcd", ".esper")
IMAGE_ENDINGS = (
    *(*TIFF_ENDINGS, ".png", ".bmp", *RAW_ENDINGS, *FITS_ENDINGS),
    *(*DICOM_ENDINGS, *HIS_ENDINGS, *FABIO_ENDINGS),
)
# TIFF tags that say where the numbers of a picture lie and how to read them; any other may be broken without harm
_TIFF_TAGS_THAT_COUNT = frozenset(
    {
        256,
        257,
        258,
        259,
        262,
        266,
        273,
        277,
        278,
        279,
        284,
        292,
        293,
        317,
        322,
        323,
        324,
        325,
        330,
        338,
        339,
        347,
        32997,
    }
)
_BROKEN_TAG = re.compile(r"TiffTag (\d+) @")


@dataclass(frozen=True, slots=True, kw_only=True)
class RawLayout:
    """How the numbers lie in a raw file: (row, column) images one after the other behind a header of `header_bytes`."""

    rows: int
    columns: int
    dtype: str = "uint16"
    byte_order: str = "little"
    header_bytes: int = 0

    def __post_init__(self) -> None:
        if self.byte_order not in ("little", "big"):
            raise InputError("raw byte_order", received=repr(self.byte_order), expected="little or big")
        if self.dtype not in ("uint8", "uint16", "int16", "uint32", "int32", "float32", "float64"):
            raise InputError(
                "raw dtype",
                received=repr(self.dtype),
                expected="uint8, uint16, int16, uint32, int32, float32 or float64",
            )
        if self.rows < 1 or self.columns < 1 or self.header_bytes < 0:
            raise InputError(
                "raw layout",
                received=f"{self.rows} rows, {self.columns} columns, {self.header_bytes} header bytes",
                expected="at least one row and column and no negative header",
            )

    @property
    def numpy_dtype(self) -> np.dtype[Any]:
        """The type as numpy reads it."""
        return np.dtype(self.dtype).newbyteorder("<" if self.byte_order == "little" else ">")


def natural_key(path: Path) -> tuple[Any, ...]:
    """Sorts `img_2` before `img_10`, as people count."""
    parts = re.split(r"(\d+)", path.as_posix())
    return tuple((1, int(part), "") if part.isdigit() else (0, 0, part) for part in parts)


def iter_images(path: Path, *, raw: RawLayout | None = None) -> Iterator[NDArray[Any]]:
    """Yield the images (row, column) of one file, a multi-page TIFF or a raw stack page by page.

    Raises:
        FileFormatError: not there, damaged, of a kind that is not read, or in colour.
    """
    if not path.is_file():
        raise FileFormatError(str(path), received="no such file", expected="an image", remedy="check the path")
    ending = path.suffix.lower()
    if ending in TIFF_ENDINGS:
        yield from _tiff_pages(path)
    elif ending in FITS_ENDINGS:
        yield from _fits_planes(path)
    elif ending in RAW_ENDINGS:
        yield from _raw_images(path, raw)
    elif ending in DICOM_ENDINGS:
        from ._dicom_files import iter_dicom

        yield from iter_dicom(path)
    elif ending in HIS_ENDINGS:
        from ._his_files import iter_his

        yield from iter_his(path)
    elif ending in FABIO_ENDINGS:
        from ._fabio_files import iter_fabio

        yield from iter_fabio(path)
    elif ending in (".png", ".bmp"):
        yield one_channel(path, _decoded(path))
    else:
        raise FileFormatError(
            str(path),
            received=f"a file {ending or 'without ending'}",
            expected="TIFF, PNG, FITS, DICOM, HIS, EDF or raw",
            remedy="export it as TIFF; or name it .raw and describe it under [raw] in the sidecar",
        )


def read_image(path: Path, *, raw: RawLayout | None = None) -> NDArray[Any]:
    """The only image (row, column) of a file.

    Raises:
        FileFormatError: as `iter_images`, or more than one image.
    """
    images = list(iter_images(path, raw=raw))
    if len(images) != 1:
        raise FileFormatError(str(path), received=f"{len(images)} images", expected="one image")
    return images[0]


def read_mask(path: Path) -> NDArray[np.bool_]:
    """A mask (row, column): True where the first channel is not 0, so that painted colour masks are read too."""
    if not path.is_file():
        raise FileFormatError(str(path), received="no such file", expected="a mask image", remedy="check the path")
    values = read_image(path) if path.suffix.lower() in TIFF_ENDINGS else _decoded(path)
    inside: NDArray[np.bool_] = np.not_equal(values[..., 0] if values.ndim == 3 else values, 0)
    return inside


def _decoded(path: Path) -> NDArray[Any]:
    import imageio.v3 as imageio

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return np.asarray(imageio.imread(path))
    except Exception as error:  # the decoders behind imageio raise whatever they like at damaged files
        raise damaged(path, error) from None


@contextmanager
def _quiet_about_harmless_faults() -> Iterator[None]:
    """tifffile logs whatever it does not like. A file that cannot be read is told by its error, and a broken tag that does
    not matter to the picture by nobody; the rest is passed on at the end.
    """
    kept: list[logging.LogRecord] = []

    def keep(record: logging.LogRecord) -> bool:
        tags = _BROKEN_TAG.findall(record.getMessage())
        if not tags or any(int(tag) in _TIFF_TAGS_THAT_COUNT for tag in tags):
            kept.append(record)
        return False

    logger = logging.getLogger("tifffile")
    logger.addFilter(keep)
    try:
        yield
    except BaseException:
        kept.clear()
        raise
    finally:
        logger.removeFilter(keep)
        for record in kept:
            logger.callHandlers(record)


def images_left(path: Path) -> int:
    """How many images a file holds behind those that `iter_images` yields: further HDUs of FITS."""
    if path.suffix.lower() not in FITS_ENDINGS:
        return 0
    with _fits_images(path) as found:
        return len(found) - 1


@contextmanager
def _fits_images(path: Path) -> Iterator[list[Any]]:
    """The HDUs that hold images, one at least, while the file is open."""
    try:
        from astropy.io import fits
    except ImportError:
        raise missing_library(path, what="a FITS file", extra="fits") from None
    try:
        with warnings.catch_warnings():
            # a file that was cut off is read with a warning and zeros in place of what is missing
            warnings.simplefilter("error")
            with path.open("rb") as stream, fits.open(stream, memmap=False) as file:
                found = [hdu for hdu in file if hdu.is_image and hdu.header.get("NAXIS", 0) >= 2]
                if not found:
                    raise ValueError("no image in it")
                yield found
    except Exception as error:  # astropy raises whatever it likes at damaged files
        raise damaged(path, error) from None


def _fits_planes(path: Path) -> Iterator[NDArray[Any]]:
    """The first HDU that holds an image, (row, column) or (n, row, column); FITS stores the row at the bottom first."""
    with _fits_images(path) as found:
        # BZERO makes whole numbers of what FITS has no type for: unsigned ones
        values = np.asarray(found[0].data)
    values = values.astype(values.dtype.newbyteorder("="), copy=False)
    if values.ndim == 2:
        values = values[None]
    if values.ndim != 3:
        raise FileFormatError(
            str(path), received=f"an array of {values.ndim} axes", expected="an image (row, column) or a stack of them"
        )
    for plane in values:
        yield one_channel(path, plane)


def _tiff_pages(path: Path) -> Iterator[NDArray[Any]]:
    import tifffile

    try:
        with _quiet_about_harmless_faults(), tifffile.TiffFile(path) as file:
            if not file.series:
                raise ValueError("no image in it")
            series = file.series[0]
            colour = (
                "S" in series.axes
            )  # samples of one pixel: "YXS", or "SYX" where colours stand in planes of their own
            if not colour and series.ndim > 2 and len(series.pages) == series.shape[0]:
                pages: Iterator[Any] = (page.asarray() for page in series.pages)
            else:
                whole = np.asarray(series.asarray())
                if colour:
                    whole = np.moveaxis(whole, series.axes.index("S"), -1)
                pages = iter([whole] if whole.ndim == 2 + colour else whole)
            for page in pages:
                yield one_channel(path, np.asarray(page))
    except (InputError, GeneratorExit):
        raise
    except Exception as error:  # tifffile raises struct, value, index and codec errors at damaged files
        raise damaged(path, error) from None


def _raw_images(path: Path, raw: RawLayout | None) -> Iterator[NDArray[Any]]:
    if raw is None:
        raise FileFormatError(
            str(path),
            received="a raw file without layout",
            expected="rows, columns, dtype, byte_order and header_bytes in the table [raw] of the sidecar",
        )
    dtype = raw.numpy_dtype
    image_bytes = raw.rows * raw.columns * dtype.itemsize
    size = path.stat().st_size - raw.header_bytes
    if size <= 0 or size % image_bytes:
        raise FileFormatError(
            str(path),
            received=f"{path.stat().st_size} bytes",
            expected=f"{raw.header_bytes} + n x {image_bytes} bytes ({raw.rows} x {raw.columns} {raw.dtype})",
            remedy="check [raw] in the sidecar; the file may be truncated",
        )
    with path.open("rb") as stream:
        stream.seek(raw.header_bytes)
        for _ in range(size // image_bytes):
            values = np.frombuffer(stream.read(image_bytes), dtype=dtype).reshape(raw.rows, raw.columns)
            yield values.astype(dtype.newbyteorder("="))


def frame_dtype(image: NDArray[Any]) -> type[Any]:
    """The type in which frames like this one are kept: uint16 where that is exact for certain, else float32."""
    return np.uint16 if image.dtype in (np.uint8, np.uint16, np.bool_) else np.float32


def number_in_cell(text: str | None, *, where: str) -> float:
    """A number out of a table's cell; of an empty one NaN.

    Raises:
        InputError: a cell that is no number.
    """
    written = (text or "").strip()
    try:
        return float(written) if written else math.nan
    except ValueError:
        raise InputError(
            where,
            received=repr(written),
            expected="a number with a decimal point, or nothing where it is unknown",
        ) from None


def number_or_nan(text: str | None) -> float:
    """A number out of a table's cell; empty or unreadable cells are NaN."""
    try:
        return float(text) if text not in (None, "") else math.nan
    except ValueError:
        return math.nan
