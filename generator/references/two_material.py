"""An object seen at two tube voltages as path lengths of two materials, through the polychromatic model.

Two attenuation images hold two numbers a pixel. Below the K edges of what is inspected any material attenuates nearly as a
mixture of two others does, so the pair of path lengths says what the object does to another spectrum.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import InputError
from ..line.spectral_signal import OpenBeam, SpectralModel

Array = NDArray[np.float64]

_START_NODES = 64
_MOST_NODES = 512
_TABLE_ERROR = 1e-5  # of a log image, and relative of a gain
_NEGATIVE_LOG = 0.3  # how far below nothing thicknesses are tabulated, in units of the log image
_STEEPER = 1.3  # and no further than where negative thickness has made the beam this much softer
_SMALLEST_ANGLE = 0.01
_SOLVED = 1e-6
_NO_PART = 1e-9  # of the signal: far below what a table holds


@dataclass(frozen=True, slots=True, kw_only=True)
class TwoMaterialTables:
    """Log signal and log gain of beams behind two materials, on a grid of path lengths with exact slopes.

    Fields: materials; beams; low_mm, step_mm (2,) of the grid; values (function, 4, node, node): each function with its
    slopes along the first, the second and both axes; functions are -ln(signal / open signal) of every beam in turn, then
    ln(gain / open gain) of every beam. Outside the grid a function goes on in a straight line.
    """

    materials: tuple[str, str]
    beams: tuple[OpenBeam, ...]
    low_mm: Array
    step_mm: Array
    values: Array = field(repr=False)

    @property
    def count(self) -> int:
        """How many beams."""
        return len(self.beams)


@dataclass(frozen=True, slots=True, kw_only=True)
class TwoMaterialSolution:
    """Path lengths and what they mean at every beam.

    Fields: thickness_mm (2, row, column), negative where noise or another material makes it so; log_signal (beam, row,
    column), -ln(signal / open signal); log_slopes_per_mm (beam, 2, row, column), its derivatives; gain_ratio (beam, row,
    column), gain over that of the open beam; solved (row, column), whether the first two beams are reproduced.
    """

    thickness_mm: Array
    log_signal: Array
    log_slopes_per_mm: Array
    gain_ratio: Array
    solved: NDArray[np.bool_]

    def transfer(self) -> Array:
        """d log_signal[c] / d log_signal[j] (beam, 2, row, column): how a change of the first two beams shows in each.

        The chain rule through the path lengths: J J_12^-1, J the slopes of all beams and J_12 those of the first two.
        """
        slopes = self.log_slopes_per_mm
        (a, b), (c, d) = slopes[0], slopes[1]
        determinant = a * d - b * c
        inverse = np.stack([np.stack([d, -b]), np.stack([-c, a])]) / determinant
        return np.asarray(np.einsum("cmij,mkij->ckij", slopes, inverse))


def tabulate_two_materials(
    model: SpectralModel,
    parameters: Array,
    *,
    beams: Sequence[OpenBeam],
    materials: tuple[str, str],
    highest_log: float = 3.0,
) -> TwoMaterialTables:
    """Tables of -ln(signal / open signal) and ln(gain / open gain) behind two materials (no unit), to 1e-5.

    With w the weights of the signal and v those of its variance (`SpectralModel.moment_weights`):

        M(t1, t2) = -ln( sum w exp(-mu1 t1 - mu2 t2) / sum w )
        G(t1, t2) =  ln( sum v exp(...) / sum w exp(...) ) - ln( sum v / sum w )

    Args:
        model: tube and detector.
        parameters: (parameter,) of the model, or (beam, parameter) where the tube was another one for some of the beams.
        beams: the two that a solution starts from, then any others.
        materials: names of the library, the product first.
        highest_log: the largest log image of the first beam that the tables need to hold.

    Raises:
        InputError: two materials that attenuate alike at the two first beams, or beams without signal.
    """
    if len(beams) < 2 or len(materials) != 2:
        raise InputError(
            "beams and materials", received=f"{len(beams)} and {len(materials)}", expected="2 or more, and 2"
        )
    weights = []
    for beam, own in zip(beams, np.broadcast_to(parameters, (len(beams), np.shape(parameters)[-1])), strict=True):
        rows = model.moment_weights(own, beam)[:2]
        if not rows[0].sum() > 0:
            raise InputError(
                "beam", received=f"{beam.kV:g} kV without signal", expected="a beam that reaches the detector"
            )
        # energies without a part in any signal would rule where thicknesses are negative
        weights.append(np.where(rows > _NO_PART * rows.sum(axis=1, keepdims=True), rows, 0.0))
    mu = np.stack([model.mu(name) for name in materials])
    _check_independent(weights[:2], mu, materials, beams)
    bounds = _bounds(weights, mu, highest_log)
    nodes = np.array([_START_NODES, _START_NODES])
    while True:
        axes = [np.linspace(low, high, count) for (low, high), count in zip(bounds, nodes, strict=True)]
        values = _functions(weights, mu, axes[0], axes[1])
        steps = np.array([axis[1] - axis[0] for axis in axes])
        off = [_error_between_nodes(values, steps[axis], axis) for axis in (0, 1)]
        finer = [error > _TABLE_ERROR and count < _MOST_NODES for error, count in zip(off, nodes, strict=True)]
        if not any(finer):
            break
        nodes = np.where(finer, 2 * nodes, nodes)
    return TwoMaterialTables(
        materials=materials,
        beams=tuple(beams),
        low_mm=bounds[:, 0].copy(),
        step_mm=steps,
        values=values,
    )


def _check_independent(
    weights: Sequence[Array], mu: Array, materials: tuple[str, str], beams: Sequence[OpenBeam]
) -> None:
    slopes = np.array([[rows[0] @ one[: rows.shape[1]] / rows[0].sum() for one in mu] for rows in weights])
    angle = (slopes[0, 0] * slopes[1, 1] - slopes[0, 1] * slopes[1, 0]) / np.prod(np.linalg.norm(slopes, axis=1))
    if not abs(angle) > _SMALLEST_ANGLE:
        raise InputError(
            "reference pair",
            received=f"{materials[0]} and {materials[1]} at {beams[0].kV:g} and {beams[1].kV:g} kV, which cannot be told"
            " apart",
            expected="two materials whose attenuation falls differently between two tube voltages far apart",
            remedy="references of 40 and 90 kV separate tissue and bone",
        )


def _bounds(weights: Sequence[Array], mu: Array, highest_log: float) -> Array:
    """Smallest and largest path length (material, 2) that are tabulated, mm."""

    def log_and_slopes(rows: Array, lengths_mm: Array) -> tuple[float, Array]:
        exponent = -lengths_mm @ mu[:, : rows.shape[1]]
        top = float(exponent[rows[0] > 0].max())
        share = rows[0] * np.exp(np.minimum(exponent - top, 0.0))
        return -math.log(share.sum() / rows[0].sum()) - top, mu[:, : rows.shape[1]] @ share / share.sum()

    open_slopes = [log_and_slopes(rows, np.zeros(2))[1] for rows in weights]
    bounds = np.empty((2, 2))
    bounds[:, 0] = -_NEGATIVE_LOG / open_slopes[0]
    for rows, slopes in zip(weights, open_slopes, strict=True):
        while np.any(log_and_slopes(rows, bounds[:, 0])[1] > _STEEPER * slopes) and bounds[0, 0] < -1e-9:
            bounds[:, 0] *= 0.8
    for number in (0, 1):
        length = 1.0 / open_slopes[0][number]
        unit = np.eye(2)[number]
        while log_and_slopes(weights[0], length * unit)[0] < highest_log and length * open_slopes[0][number] < 1e4:
            length *= 1.2
        bounds[number, 1] = length
    return bounds


def _functions(weights: Sequence[Array], mu: Array, first_mm: Array, second_mm: Array) -> Array:
    """(2 beams, 4, node, node): all functions and their slopes at the nodes."""
    exponent = -(first_mm[:, None, None] * mu[0] + second_mm[None, :, None] * mu[1])
    logs, gains = [], []
    for rows in weights:
        top = rows.shape[1]
        used = exponent[..., :top]
        largest = used[..., rows[0] > 0].max(axis=-1, keepdims=True)
        passed = np.exp(np.minimum(used - largest, 0.0))
        moments = []
        for weight in rows:
            total = passed @ weight
            means = [passed @ (weight * one[:top]) / total for one in mu]
            both = passed @ (weight * mu[0, :top] * mu[1, :top]) / total
            moments.append((total / weight.sum(), means[0], means[1], both - means[0] * means[1]))
        (signal, first, second, shared), (variance, first_v, second_v, shared_v) = moments
        logs.append(np.stack([-np.log(signal) - largest[..., 0], first, second, -shared]))
        gains.append(np.stack([np.log(variance / signal), first - first_v, second - second_v, shared_v - shared]))
    return np.stack([*logs, *gains])


def _error_between_nodes(values: Array, step: float, axis: int) -> float:
    """Largest error between the nodes along one axis: a coarser table (every other node) against the nodes it lacks, / 16."""
    order = np.moveaxis(values, 2 + axis, 2)
    value, slope = order[:, 0], order[:, 1 + axis]
    middle = 0.5 * (value[:, :-2:2] + value[:, 2::2]) + 0.25 * step * (slope[:, :-2:2] - slope[:, 2::2])
    return float(np.max(np.abs(middle - value[:, 1:-1:2])[:, : value.shape[1] // 2 - 1])) / 16.0


def look_up_two_materials(tables: TwoMaterialTables, thickness_mm: ArrayLike) -> TwoMaterialSolution:
    """What path lengths (2, row, column) mean at every beam; nothing is solved."""
    from ._two_material_loops import look_up

    lengths = np.ascontiguousarray(thickness_mm, dtype=np.float64)
    shape = lengths.shape[1:]
    found = np.empty((2 * tables.count, 3, math.prod(shape)))
    look_up(tables.values, tables.low_mm, tables.step_mm, lengths.reshape(2, -1), found)
    return _solution(tables, lengths, found, np.ones(shape, dtype=bool))


def solve_two_materials(tables: TwoMaterialTables, log_images: ArrayLike) -> TwoMaterialSolution:
    """Path lengths (mm) of two materials that give the two log images, and what they mean at every beam.

    M_1(t1, t2) = log_images[0], M_2(t1, t2) = log_images[1], by damped Newton steps in every pixel.

    Validity: noise is carried along as it is (use the least noisy form of the images), so small negative lengths are an
    answer. A third material shows as the mixture of the two that attenuates like it.

    Args:
        tables: from `tabulate_two_materials`.
        log_images: (2, row, column), -ln(I / I0) at the first two beams.

    Raises:
        InputError: another shape, values that are not finite.
    """
    from ._two_material_loops import solve

    logs = np.ascontiguousarray(log_images, dtype=np.float64)
    if logs.ndim != 3 or logs.shape[0] != 2 or 0 in logs.shape:
        raise InputError("log images", received=f"shape {logs.shape}", expected="(2, row, column)")
    if not bool(np.isfinite(logs).all()):
        raise InputError("log images", received="a value that is not finite", expected="finite -ln(I / I0)")
    shape = logs.shape[1:]
    pixels = math.prod(shape)
    found = np.empty((2 * tables.count, 3, pixels))
    thickness, solved = np.empty((2, pixels)), np.empty(pixels, dtype=np.bool_)
    solve(tables.values, tables.low_mm, tables.step_mm, logs.reshape(2, -1), _SOLVED, thickness, found, solved)
    return _solution(tables, thickness.reshape(logs.shape), found, solved.reshape(shape))


def _solution(
    tables: TwoMaterialTables, thickness_mm: Array, found: Array, solved: NDArray[np.bool_]
) -> TwoMaterialSolution:
    maps = found.reshape(*found.shape[:2], *thickness_mm.shape[1:])
    beams = tables.count
    return TwoMaterialSolution(
        thickness_mm=thickness_mm,
        log_signal=maps[:beams, 0],
        log_slopes_per_mm=maps[:beams, 1:],
        gain_ratio=np.exp(maps[beams:, 0]),
        solved=solved,
    )
