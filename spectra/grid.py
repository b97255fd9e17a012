"""The one energy grid of raytwin: bin k is the same energy for every kV, so that tables are made once."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

BIN_WIDTH_KEV = 0.5
FIRST_CENTRE_KEV = 1.25
MAXIMUM_KV = 300.0


@lru_cache(maxsize=64)
def energy_grid_keV(maximum_keV: float = MAXIMUM_KV) -> NDArray[np.float64]:
    """Bin centres in keV: 1.25, 1.75, 2.25, ... up to the bin that holds `maximum_keV`; read-only.

    Bins are 0.5 keV wide with edges at multiples of 0.5 keV, from 1 keV (where the attenuation tables begin). The grid
    of a lower maximum is the beginning of the grid of a higher one.

    Raises:
        InputError: a maximum outside 2 to 500 keV.
    """
    if not 2.0 <= maximum_keV <= 500.0:
        raise InputError("maximum_keV", received=f"{maximum_keV} keV", expected="2 to 500 keV")
    # a kV that is a bin edge up to rounding belongs to the bin below
    bins = int(np.ceil((maximum_keV - 1.0) / BIN_WIDTH_KEV - 1e-9))
    grid = FIRST_CENTRE_KEV + BIN_WIDTH_KEV * np.arange(bins, dtype=np.float64)
    grid.setflags(write=False)
    return grid
