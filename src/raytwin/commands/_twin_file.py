"""The TWIN argument: a file, or the name of a shipped calibration."""

import argparse
from pathlib import Path

from ..errors import InputError

HELP = "twin file, or the name of a shipped calibration (virtual_lab)"


def twin_file(text: str) -> Path:
    """The file that a TWIN argument means; a file of that name goes before a shipped calibration."""
    path = Path(text)
    if path.suffix or len(path.parts) != 1 or path.exists():
        return path
    from ..generator.shipped import shipped_calibration, shipped_calibrations

    if text not in shipped_calibrations():
        return path
    try:
        return shipped_calibration(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
