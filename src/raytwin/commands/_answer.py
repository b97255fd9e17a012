"""How a command answers: JSON alone on standard output, or text for people; the rest goes to standard error."""

import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def jsonable(value: Any) -> Any:
    """Turn numpy values into JSON's own; NaN and infinities become null (JSON has no word for them)."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, np.generic):
        return jsonable(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def answer(result: Mapping[str, Any], *, as_json: bool, text: str) -> None:
    """Print the answer of a command: the JSON object alone, or the text for people."""
    if as_json:
        sys.stdout.write(json.dumps(jsonable(result), indent=1, allow_nan=False) + "\n")
    else:
        sys.stdout.write(text.rstrip("\n") + "\n")


def say(line: str) -> None:
    """Print a progress or warning line to standard error."""
    sys.stderr.write(line.rstrip("\n") + "\n")
