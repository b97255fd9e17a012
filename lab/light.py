"""Light of the lab's scintillators over their deposits: not quite in proportion, with a step at the K edge.

Values are read off published figures to about 0.01, relative to 60 keV; screens differ among each other by as much as the
curves bend, so a system of the lab goes with a curve by a drawn amount of 0 to 1.5.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# CsI(Tl): more light a keV at 10 to 25 keV than at 100 keV and above, a dip behind the K edges of iodine and caesium.
# Source: W. Mengesha et al., IEEE Trans. Nucl. Sci. 45 (1998) 456, doi:10.1109/23.682426 (photons and electrons).
# Gd2O2S: less light at low energy, as gadolinium compounds have it, and a dip behind the K edge of gadolinium.
# Source: the shape of Gd2SiO5 in P. Dorenbos et al., IEEE Trans. Nucl. Sci. 42 (1995) 2190, doi:10.1109/23.489415,
# at a third of its size; no table of Gd2O2S itself.
_CURVES: dict[str, tuple[tuple[float, float, float], tuple[float, ...], tuple[float, ...]]] = {
    # (K edge keV, dip, keV over which it closes), energies, yields without the dip
    "CsI": (
        (34.5, 0.030, 15.0),
        (3.0, 6.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0, 150.0, 300.0),
        (0.93, 0.97, 1.00, 1.02, 1.025, 1.02, 1.01, 1.00, 0.98, 0.965, 0.93, 0.89),
    ),
    "Gd2O2S@7.32": (
        (50.24, 0.020, 20.0),
        (3.0, 6.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0, 150.0, 300.0),
        (0.85, 0.89, 0.92, 0.945, 0.96, 0.98, 0.99, 1.00, 1.01, 1.015, 1.03, 1.05),
    ),
}


def relative_yield(scintillator: str, energy_keV: Array, *, of_photon: bool) -> Array:
    """Light per keV over that at 60 keV, for deposits of a photon's whole energy or of what a K photon left behind.

    A photon above the K edge makes several slow electrons where one below makes a fast one, hence the dip; what is left
    behind by an escaping K photon is one electron and has none.

    Args:
        scintillator: `CsI` or `Gd2O2S@7.32`.
        energy_keV: deposits, any shape, 0 to 300 keV.
        of_photon: whether the deposits are of photons that left all their energy.
    """
    (edge_keV, dip, closes_keV), energies, yields = _CURVES[scintillator]
    energy = np.asarray(energy_keV, dtype=np.float64)
    smooth = np.interp(np.log(np.maximum(energy, 1e-3)), np.log(energies), yields)
    if of_photon:
        smooth = smooth - np.where(energy > edge_keV, dip * np.exp(-(energy - edge_keV) / closes_keV), 0.0)
    return np.asarray(smooth)
