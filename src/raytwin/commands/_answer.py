"""How a command answers: JSON alone on standard output, or text for people; the rest goes to standard error."""

import json
import sys
from collections.abc import Mapping
from typing import Any

from ..results import plain


def answer(result: Mapping[str, Any], *, as_json: bool, text: str) -> None:
    """Print the answer of a command: the JSON object alone, or the text for people."""
    if as_json:
        sys.stdout.write(json.dumps(plain(result), indent=1, allow_nan=False) + "\n")
    else:
        sys.stdout.write(text.rstrip("\n") + "\n")


def say(line: str) -> None:
    """Print a progress or warning line to standard error."""
    sys.stderr.write(line.rstrip("\n") + "\n")
