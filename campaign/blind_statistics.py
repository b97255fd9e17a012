"""What a diagnosed session says about the catalogue before its label is known: inner products of all responses.

With responses N (node, probe) of every effect, variant and strength, residual r and covariance C of the nuisances, the
numbers G = N C^-1 N^T, b = N C^-1 r and r^T C^-1 r hold everything that separations and matched filters need; the session
itself may be thrown away.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ..diagnosis.problem.problem import Problem


@dataclass(frozen=True, slots=True, kw_only=True)
class CurveKey:
    """Which nodes belong to one variant of an effect.

    Fields: effect; variant; sign of the strength; since; low, high: range of the strength; strengths (node,) of its nodes;
    first: position of its first node.
    """

    effect: str
    variant: str
    sign: float
    since: str
    low: float
    high: float
    strengths: tuple[float, ...]
    first: int

    @property
    def nodes(self) -> slice:
        """Its places among all nodes."""
        return slice(self.first, self.first + len(self.strengths))


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionStatistics:
    """Inner products of one session, in standard deviations.

    Fields: curves; gram (node, node) = N C^-1 N^T; linear (node,) = N C^-1 r; chi_square = r^T C^-1 r; bare (node,) = N r
    and bare_norm (node,) = |N| without the nuisances' covariance; bare_residual = |r|; probes; missing: effects to which
    nothing in this session responds.
    """

    curves: tuple[CurveKey, ...]
    gram: NDArray[np.float64]
    linear: NDArray[np.float64]
    chi_square: float
    bare: NDArray[np.float64]
    bare_norm: NDArray[np.float64]
    bare_residual: float
    probes: int
    missing: tuple[str, ...]


class _Metric:
    """a^T C^-1 b with C = I + F F^T: a.b - z_a.z_b, z = L^-1 F^T a, L L^T = I + F^T F."""

    def __init__(self, factors: NDArray[np.float64]) -> None:
        self._factors = factors
        self._lower = np.linalg.cholesky(np.eye(factors.shape[1]) + factors.T @ factors)

    def project(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """z (vector, factor) of vectors (vector, probe)."""
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(self._lower, self._factors.T @ vectors.T, lower=True).T)

    def solve(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """C^-1 times a vector (probe,)."""
        from scipy.linalg import cho_solve

        return np.asarray(vector - self._factors @ cho_solve((self._lower, True), self._factors.T @ vector))


def session_statistics(problem: "Problem") -> SessionStatistics:
    """Inner products of a problem's residual and responses."""
    metric = _Metric(problem.factors)
    residual = problem.residual
    nodes = np.concatenate([np.zeros((0, len(residual))), *(curve.responses for curve in problem.curves)])
    z_nodes, z_residual = metric.project(nodes), metric.project(residual[None, :])[0]
    keys = []
    position = 0
    for curve in problem.curves:
        variant = curve.variant
        keys.append(
            CurveKey(
                effect=variant.effect,
                variant=variant.name,
                sign=float(variant.sign),
                since=variant.since,
                low=float(variant.low),
                high=float(variant.high),
                strengths=tuple(float(value) for value in variant.strengths),
                first=position,
            )
        )
        position += len(variant.strengths)
    return SessionStatistics(
        curves=tuple(keys),
        gram=nodes @ nodes.T - z_nodes @ z_nodes.T,
        linear=nodes @ residual - z_nodes @ z_residual,
        chi_square=float(residual @ residual - z_residual @ z_residual),
        bare=nodes @ residual,
        bare_norm=np.linalg.norm(nodes, axis=1),
        bare_residual=float(np.linalg.norm(residual)),
        probes=len(residual),
        missing=tuple(sorted(problem.missing_effects)),
    )


def session_features(problem: "Problem") -> dict[str, float]:
    """What a classifier without a forward model may look at: mean and scatter of each family of probes, by name.

    A family is one statistic of one axis and kind of scene at one of the session's tube voltages. The mean is
    asinh(mean z sqrt(n)), the scatter log(rms z), of z after the nuisances took their part.
    """
    z = _Metric(problem.factors).solve(problem.residual)
    voltages = sorted({view.session.series.kV for view in problem.views if _lit(view) and view.session.series.kV})
    families: dict[str, list[float]] = {}
    for index, name in enumerate(problem.names):
        view = problem.views[int(problem.series_of[index])]
        series = view.session.series
        scene = re.split(r"[_\d]", series.scene)[0] if series.scene else ""
        beam = (
            "" if not _lit(view) or not voltages else f"kV{voltages.index(series.kV)}" if series.kV in voltages else ""
        )
        after = "after" if view.session.request.after_calibration else "before"
        statistic = re.sub(r"[\d.]+", "#", name.statistic)
        families.setdefault("|".join((name.axis, series.kind, scene, beam, after, statistic)), []).append(
            float(z[index])
        )
    result: dict[str, float] = {}
    for key, values in sorted(families.items()):
        array = np.asarray(values)
        result[f"mean|{key}"] = float(np.arcsinh(array.mean() * math.sqrt(len(array))))
        result[f"scatter|{key}"] = float(0.5 * np.log(np.mean(array**2) + 1e-6))
    return result


def _lit(view: Any) -> bool:
    return bool(view.session.series.kind in ("flat", "object"))


def write_statistics(path: Path, statistics: SessionStatistics) -> None:
    """Write to an `.npz` file of plain arrays."""
    upper = np.triu_indices(len(statistics.linear))
    np.savez_compressed(
        path,
        gram=statistics.gram[upper],
        linear=statistics.linear,
        bare=statistics.bare,
        bare_norm=statistics.bare_norm,
        scalars=np.array([statistics.chi_square, statistics.bare_residual, float(statistics.probes)]),
        effects=np.array([item.effect for item in statistics.curves], dtype=np.str_),
        variants=np.array([item.variant for item in statistics.curves], dtype=np.str_),
        since=np.array([item.since for item in statistics.curves], dtype=np.str_),
        numbers=np.array(
            [(item.sign, item.low, item.high, item.first, len(item.strengths)) for item in statistics.curves],
            dtype=np.float64,
        ).reshape(-1, 5),
        strengths=np.array([value for item in statistics.curves for value in item.strengths], dtype=np.float64),
        missing=np.array(statistics.missing, dtype=np.str_),
    )


def read_statistics(path: Path) -> SessionStatistics:
    """Read what `write_statistics` wrote."""
    with np.load(path, allow_pickle=False) as stored:
        linear = stored["linear"]
        gram = np.zeros((len(linear), len(linear)))
        gram[np.triu_indices(len(linear))] = stored["gram"]
        gram = gram + gram.T - np.diag(np.diag(gram))
        strengths = stored["strengths"]
        curves = []
        for effect, variant, since, numbers in zip(
            stored["effects"], stored["variants"], stored["since"], stored["numbers"], strict=True
        ):
            first, count = int(numbers[3]), int(numbers[4])
            curves.append(
                CurveKey(
                    effect=str(effect),
                    variant=str(variant),
                    sign=float(numbers[0]),
                    since=str(since),
                    low=float(numbers[1]),
                    high=float(numbers[2]),
                    strengths=tuple(float(value) for value in strengths[first : first + count]),
                    first=first,
                )
            )
        scalars = stored["scalars"]
        return SessionStatistics(
            curves=tuple(curves),
            gram=gram,
            linear=linear,
            chi_square=float(scalars[0]),
            bare=stored["bare"],
            bare_norm=stored["bare_norm"],
            bare_residual=float(scalars[1]),
            probes=int(scalars[2]),
            missing=tuple(str(item) for item in stored["missing"]),
        )
