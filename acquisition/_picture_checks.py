"""What every reader of image files asks of a picture, and how it says that a file is damaged."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileFormatError, MissingDependencyError


def one_channel(path: Path, values: NDArray[Any]) -> NDArray[Any]:
    """The grey values (row, column) of a picture; grey that is stored as colour is taken as grey.

    Raises:
        FileFormatError: colours, or values that are no numbers.
    """
    if values.ndim == 3 and values.shape[-1] in (3, 4) and bool(np.all(values[..., :3] == values[..., :1])):
        values = values[..., 0]  # grey, stored as colour
    if values.ndim != 2:
        raise FileFormatError(
            str(path),
            received=f"an image of shape {values.shape}",
            expected="one grey value a pixel",
            remedy="export the detector's own numbers, not a colour picture",
        )
    if values.dtype.kind not in "iufb":
        raise FileFormatError(str(path), received=f"values of type {values.dtype}", expected="numbers")
    return values


def damaged(path: Path, error: Exception) -> FileFormatError:
    """The error about a file that its decoder gave up on."""
    return FileFormatError(
        str(path),
        received=f"{path.stat().st_size} bytes that cannot be decoded ({error or type(error).__name__})",
        expected="a complete image file",
        remedy="the file looks truncated or damaged: copy or export it again",
    )


def missing_library(path: Path, *, what: str, extra: str) -> MissingDependencyError:
    """The error about a file whose library is not installed."""
    return MissingDependencyError(
        f"{path}: got {what}; expected the library that reads it; install it with `pip install 'raytwin[{extra}]'`"
    )
