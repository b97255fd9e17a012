"""A beam behind a sheet of any thickness, of which scenes are projected behind a few that are always the same."""

from dataclasses import dataclass

import numpy as np

from ..line.line_state import FloatArray


@dataclass(frozen=True, slots=True)
class Sheets:
    """Sheets of one material that are projected: between them -ln(passed) / depth is interpolated (Lagrange).

    Fields: depths (sheet,), none of them 0; attenuation (energy,) of a unit of depth.
    """

    depths: tuple[float, ...]
    attenuation: FloatArray

    def rows(self, weights: FloatArray) -> FloatArray:
        """Weights (2 (1 + sheet), energy) without a sheet and behind each, from those of signal and variance (2, energy)."""
        left = np.exp(-np.outer((0.0, *self.depths), self.attenuation))
        return np.asarray((weights[:2, None, :] * left).reshape(-1, weights.shape[1]))

    def passed(self, sums: FloatArray, depth: FloatArray | float) -> FloatArray:
        """Share of signal and variance (2, row, column) that passes a sheet, from sums of the rows behind a scene.

        Args:
            sums: (2 (1 + sheet), row, column), or (2 (1 + sheet), 1, 1) of an open beam.
            depth: of the sheet, a number or (row, column).
        """
        behind = np.maximum(sums.reshape(2, 1 + len(self.depths), *sums.shape[1:]), 1e-300)
        thick = np.asarray(depth, dtype=np.float64)
        slope: FloatArray = np.zeros(np.broadcast_shapes(sums.shape[1:], thick.shape))
        for number, node in enumerate(self.depths):
            others = [other for other in self.depths if other != node]
            weight = np.prod([(thick - other) / (node - other) for other in others], axis=0)
            slope = slope - weight * np.log(behind[:, 1 + number] / behind[:, 0]) / node
        return np.asarray(np.exp(-thick * slope))
