"""The TWIN argument: a file, or the name of a shipped calibration."""

import argparse
from pathlib import Path

from ..api._given import twin_path
from ..errors import InputError

HELP = "twin file, or the name of a shipped calibration (virtual_lab)"


def twin_file(text: str) -> Path:
    """The file that a TWIN argument means; a file of that name goes before a shipped calibration."""
    try:
        return twin_path(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error).removeprefix("twin: ")) from None
