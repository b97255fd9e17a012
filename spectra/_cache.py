"""Spectra kept on disk: one small npz file each, written whole, recomputed where unreadable."""

import json
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import whole_file

ENVIRONMENT_VARIABLE = "RAYTWIN_CACHE"


def cache_folder() -> Path:
    """RAYTWIN_CACHE, or the user's cache folder of this system."""
    named = os.environ.get(ENVIRONMENT_VARIABLE)
    if named:
        return Path(named)
    import platformdirs

    return Path(platformdirs.user_cache_dir("raytwin"))


def read_kept(name: str, key: dict[str, object], *, size: int) -> NDArray[np.float64] | None:
    """The array (2, size) kept under `name` for exactly this key, or None where absent, damaged or of another key."""
    try:
        # opened here, because numpy leaves the file open when the archive is damaged
        with (cache_folder() / name).open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            if str(stored["key"]) != _text(key):
                return None
            values = np.asarray(stored["fluence"], dtype=float)
    except Exception:  # whatever a damaged file makes the reader raise, the answer is to compute again
        return None
    usable = values.shape == (2, size) and np.all(np.isfinite(values)) and np.all(values >= 0) and values.sum() > 0
    return values if usable else None


def keep(name: str, key: dict[str, object], values: NDArray[np.float64]) -> None:
    """Keep an array; a folder that cannot be written only costs the time of computing again."""
    try:
        with whole_file(cache_folder() / name) as temporary, temporary.open("wb") as stream:
            np.savez(stream, key=np.array(_text(key)), fluence=values)
    except (OSError, InputError):
        return


def _text(key: dict[str, object]) -> str:
    return json.dumps(key, sort_keys=True)
