"""Makes the spectra that come with the package: `python -m raytwin.spectra.make_table [-o FILE]`, about an hour of SpekPy.

Every whole kV of the tubes in TUBES, as SpekPy gives them. To be run again when SpekPy changes
(tests/test_spectra_packaged.py fails then).
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files import whole_file
from ._packaged import FILE, FORMAT, table_from_spectra, tube_name
from .grid import BIN_WIDTH_KEV
from .tube import (
    DEFAULT_ANGLE_DEG,
    DEFAULT_ANODE,
    MAXIMUM_KV_OF_ANODE,
    MINIMUM_KV,
    MODELS,
    kept_line_places,
    kept_tube_fluence,
    spekpy_version,
)

# both models of the default tube: calibration weighs one against the other
TUBES = tuple((DEFAULT_ANODE, DEFAULT_ANGLE_DEG, model) for model in MODELS)


def make_table(path: Path) -> None:
    """Write the packaged spectra; what the user's cache already holds of this SpekPy is taken from there."""
    arrays: dict[str, NDArray[np.generic]] = {
        "format": np.array(FORMAT),
        "bin_width_keV": np.array(BIN_WIDTH_KEV),
        "version": np.array(spekpy_version()),
    }
    for anode, angle_deg, model in TUBES:
        name = tube_name(anode, angle_deg, model)
        voltages = range(int(MINIMUM_KV), int(MAXIMUM_KV_OF_ANODE[anode]) + 1)
        spectra = {kV: kept_tube_fluence(anode, angle_deg, model, kV) for kV in voltages}
        arrays.update({f"{name}/{key}": values for key, values in table_from_spectra(spectra).items()})
        arrays[f"{name}/places"] = kept_line_places(anode, angle_deg, model)
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_name(FILE))
    make_table(parser.parse_args().output)
