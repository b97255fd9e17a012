"""Numbers as JSON has them, one canonical text for each value, so that a hash of it means something, and objects read back."""

import hashlib
import json
from pathlib import Path
from typing import Any

from ..results import plain

__all__ = ["canonical", "digest", "plain", "read_object"]


def canonical(value: Any) -> bytes:
    """The one JSON text of a value: keys sorted, no blanks, ASCII."""
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False).encode("ascii")


def digest(value: Any) -> str:
    """SHA-256 of the canonical JSON text, 64 hexadecimal digits."""
    return hashlib.sha256(canonical(value)).hexdigest()


def read_object(path: Path) -> dict[str, Any]:
    """A file's JSON object, or nothing where there is none that can be read."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}
