"""Calibrations that come with raytwin, by name: twins (HDF5) and published descriptions (TOML)."""

import difflib
from pathlib import Path

from ...errors import InputError

FOLDER = Path(__file__).parents[2] / "data" / "calibration"  # in a checkout and in an installed wheel alike


def shipped_calibrations() -> dict[str, Path]:
    """Name -> file of every calibration that is shipped; `README.md` beside them says where each comes from."""
    return {path.stem: path for path in sorted(FOLDER.glob("*")) if path.suffix in (".h5", ".toml")}


def shipped_calibration(name: str) -> Path:
    """The file of a shipped twin, for `read_twin`.

    Raises:
        InputError: no such name, or that of a description without a twin.
    """
    known = shipped_calibrations()
    twins = sorted(other for other, path in known.items() if path.suffix == ".h5")
    expected = "one of the shipped twins, " + ", ".join(twins) if twins else "a twin file: none is shipped here"
    if name not in known:
        near = difflib.get_close_matches(name, twins, n=1)
        raise InputError(
            "calibration", received=name, expected=expected, remedy=f"did you mean {near[0]}?" if near else ""
        )
    if known[name].suffix != ".h5":
        raise InputError(
            "calibration",
            received=f"{name}, a published description without flats ({known[name]})",
            expected=expected,
            remedy="its numbers can be read from the file; a twin needs measured flats",
        )
    return known[name]
