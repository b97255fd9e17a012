"""How well networks do against an observer: two numbers, fitted once per product to the a90 of a few settings.

    d_eff^2 = e sum of |signal|^2 over (noise + v)

e, the efficiency, scales all settings alike. It is above 1 where networks use what the observer's image leaves out. v, the internal
noise, is white and the same at every setting: it counts where the image noise is low. Their posterior given ln a90 of the settings,
each with its own error and a scatter between settings, is summed over a grid. Weak priors (ln e = 0 +- 1.5; v^(1/2) = 0 +- twice the
noise of the combined image) keep a few alike settings from sending them apart. Quoted are the means.

The scatter s is that of settings that were left out of the fit: with r_j the departure of setting j from the fit to the others, of
variance q_j, and the measured error e_j, s^2 solves sum r_j^2 / (e_j^2 + q_j + s^2) = n (0 where the sum is below n). The
interval at another setting is ln a90 +- t(n - 2) (q + s^2)^(1/2).

Source: Burgess & Colborne, J. Opt. Soc. Am. A 5 (1988) 617 (internal noise); Burgess et al., Science 214 (1981) 93 (efficiency);
Paule & Mandel, J. Res. NBS 87 (1982) 377 (scatter beyond stated errors).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..acquisition.dataset_io import Dataset
from ..acquisition.setting import Setting
from ..errors import FitError, InputError
from ..generator.datasets.reference_materials import USUAL_MATERIALS, materials_of_references
from ..generator.line.twin import Z95
from ..materials import material_from_name
from .line_images import LineImages
from .objects import ForeignObjects
from .observe import SETTINGS_AT_ONCE, Observer, PreparedSettings, sizes_of_pod
from .texture import ProductTexture

FloatArray = NDArray[np.float64]
Pair = tuple[Setting, Setting]

FEWEST_SETTINGS = 4
_PRIOR_LOG_EFFICIENCY = 1.5
_PRIOR_NOISE = 2.0
_WIDEST = (6.0, 8.0)  # of the first grid: four standard deviations of the priors
_NODES = (49, 33)
_SDS = 7.0
_ROUNDS = 4
_STEP = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredSize:
    """a90 of networks at a setting, with the ends of its 95 % interval; None: not known."""

    pair: Pair
    a90: float
    low: float | None
    high: float | None

    @property
    def log_sd(self) -> float | None:
        """Standard deviation of ln a90 that the interval stands for; of its one end where the other is not known."""
        ends = [one for one in (self.low, self.high) if one is not None and one > 0]
        if not ends:
            return None
        return max(sum(abs(math.log(one / self.a90)) for one in ends) / (Z95 * len(ends)), 1e-3)


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut:
    """A setting predicted from the others: measured, predicted, low and high (95 %, of the networks' a90 without their own error);
    log_sd of the measured one."""

    pair: Pair
    measured: float
    predicted: float
    low: float
    high: float
    log_sd: float

    @property
    def inside(self) -> bool:
        """Whether the measured a90 lies in the interval widened by its own error, in quadrature."""
        width = math.hypot(0.5 * math.log(self.high / self.low), Z95 * self.log_sd)
        return abs(math.log(self.measured / self.predicted)) <= width


@dataclass(frozen=True, slots=True, kw_only=True)
class Efficiency:
    """An observer calibrated to networks.

    Fields: observer (with the fitted efficiency and internal noise); covariance of (ln efficiency, internal noise over `unit`) as
    ((a, b), (b, c)); unit (noise of the combined image, its median over settings and objects); scatter (of ln a90 between
    settings); left_out (a row a setting); size_name; product_material, foreign_material (of what the networks looked at; None: a file
    that does not say).
    """

    observer: Observer
    covariance: tuple[tuple[float, float], tuple[float, float]]
    unit: float
    scatter: float
    left_out: tuple[LeftOut, ...]
    size_name: str
    product_material: str | None = None
    foreign_material: str | None = None

    @property
    def degrees_of_freedom(self) -> int:
        """Settings less the two numbers."""
        return len(self.left_out) - 2

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the numbers are used: an ideal observer that networks surpass."""
        efficiency = self.observer.efficiency
        if self.observer.detector != "ideal" or efficiency <= 1:
            return ()
        reach = math.exp(Z95 * math.sqrt(self.covariance[0][0]))
        return (
            f"efficiency {efficiency:.3g} (95 %: {efficiency / reach:.2g} to {efficiency * reach:.2g}) is above 1:"
            " networks see more than the observer's image and noise hold",
        )

    @property
    def left_out_rms(self) -> float:
        """Root mean square of ln(measured / predicted) over settings that were left out."""
        return math.sqrt(float(np.mean([math.log(one.measured / one.predicted) ** 2 for one in self.left_out])))


def check_materials(efficiency: Efficiency, *, product_material: str, foreign_material: str, where: str = "") -> None:
    """Refuse materials other than those that the observer was calibrated with; a file that does not say its own takes any.

    Args:
        efficiency: of the observer.
        product_material, foreign_material: that it is to look at.
        where: what comes before the argument's name in messages.

    Raises:
        InputError: another material.
    """
    for name, own, seen in (
        ("product_material", efficiency.product_material, product_material),
        ("foreign_material", efficiency.foreign_material, foreign_material),
    ):
        if own is not None and material_from_name(own) != material_from_name(seen):
            raise InputError(
                f"{where}{name}",
                received=seen,
                expected=f"{own}, with which the observer was calibrated",
                remedy="calibrate it to networks that looked at the other one",
            )


def materials_seen(
    dataset: Dataset,
    efficiency: Efficiency | None,
    *,
    product_material: str | None = None,
    foreign_material: str | None = None,
) -> tuple[str, str]:
    """Names of the materials of product and foreign object: those asked for, else those that the references state, else those of
    the calibrated observer, else the usual ones.

    Raises:
        InputError: those asked for, of the references and of the observer differ, or the references state several.
    """
    usual = USUAL_MATERIALS
    if efficiency is not None:
        usual = efficiency.product_material or usual[0], efficiency.foreign_material or usual[1]
    product, foreign = materials_of_references(
        dataset, product_material=product_material, foreign_material=foreign_material, usual=usual
    )
    if efficiency is not None:
        check_materials(efficiency, product_material=product, foreign_material=foreign, where=f"{dataset.path}, ")
    return product, foreign


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictedSizes:
    """a90, low, high (setting,): expected a90 of networks and its 95 % interval, NaN where there is none; `a90` may lie beyond the
    largest object, where no data can support it."""

    a90: FloatArray
    low: FloatArray
    high: FloatArray


class _Grid:
    """ln a90 (efficiency, noise, setting) on a grid of (ln efficiency, internal noise over `unit`), and its log prior."""

    def __init__(
        self,
        prepared: PreparedSettings,
        objects: ForeignObjects,
        observer: Observer,
        unit: float,
        *,
        middle: FloatArray,
        reach: FloatArray,
    ) -> None:
        self.log_efficiency = np.linspace(middle[0] - reach[0], middle[0] + reach[0], _NODES[0])
        lowest = max(middle[1] - reach[1], 0.0)
        self.noise = np.linspace(lowest, middle[1] + reach[1], _NODES[1])
        columns = []
        for noise in self.noise:
            d_prime, threshold = prepared.d_and_threshold(float(noise) * unit)
            columns.append(log_a90_of(d_prime, threshold, self.log_efficiency, objects, observer))
        self.log_a90 = np.stack(columns, axis=1)
        self._prior = -0.5 * (
            (self.log_efficiency[:, None] / _PRIOR_LOG_EFFICIENCY) ** 2 + (self.noise / _PRIOR_NOISE) ** 2
        )

    def posterior(self, logs: FloatArray, errors: FloatArray, *, without: int | None = None) -> FloatArray:
        """Weights (efficiency, noise) that sum to 1, given ln a90 (setting,) with these errors."""
        terms = -0.5 * ((logs - self.log_a90) / errors) ** 2
        if without is not None:
            terms[..., without] = 0.0
        total = np.where(np.isfinite(terms).all(axis=-1), terms.sum(axis=-1), -np.inf) + self._prior
        if not np.isfinite(total).any():
            raise FitError(
                "the observer has no a90 at a setting where the networks have one: objects of more sizes are wanted"
            )
        weights = np.exp(total - total.max())
        return np.asarray(weights / weights.sum())

    def moments(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (2,) and covariance (2, 2) of the parameters."""
        axes = np.stack(np.meshgrid(self.log_efficiency, self.noise, indexing="ij"))
        mean = np.einsum("en,pen->p", weights, axes)
        away = axes - mean[:, None, None]
        return mean, np.einsum("en,pen,qen->pq", weights, away, away)

    def predicted(self, weights: FloatArray, number: int) -> tuple[float, float]:
        """Mean and variance of ln a90 of a setting."""
        values = np.where(weights > 0, self.log_a90[..., number], 0.0)
        mean = float(np.nansum(weights * values))
        return mean, float(np.nansum(weights * (values - mean) ** 2))


def log_a90_of(
    d_prime: FloatArray, threshold: FloatArray, log_efficiency: FloatArray, objects: ForeignObjects, observer: Observer
) -> FloatArray:
    """ln a90 (efficiency, setting) of networks of these efficiencies."""
    from scipy.special import ndtr

    pod = ndtr(np.exp(0.5 * log_efficiency)[:, None, None] * d_prime - threshold)
    _, a90 = sizes_of_pod(pod.reshape(-1, pod.shape[-1]), objects, link=observer.link, log_size=observer.log_size)
    return np.log(a90).reshape(pod.shape[:2])


def fit_efficiency(
    line: LineImages,
    measured: Sequence[MeasuredSize],
    objects: ForeignObjects,
    *,
    observer: Observer,
    texture: ProductTexture | None = None,
) -> Efficiency:
    """Efficiency and internal noise of networks, and how well they carry over to settings that were left out.

    Args:
        line: the twin that the networks' images come from.
        measured: a90 at four settings or more, unlike each other in noise.
        objects: those that the networks were tried on.
        observer: who is calibrated; its efficiency and internal noise are where the fit begins.
        texture: of the product, where the observer's image shows it.

    Raises:
        InputError: fewer than four settings with an a90 and an interval.
        FitError: no a90 of the observer at these settings.
    """
    known = [one for one in measured if one.log_sd is not None and one.a90 > 0]
    if len(known) < FEWEST_SETTINGS:
        raise InputError(
            "measured a90",
            received=f"{len(known)} settings with an a90 and its interval",
            expected=f"{FEWEST_SETTINGS} or more",
            remedy="train three networks or more, at more settings, at some with less noise",
        )
    pairs = [one.pair for one in known]
    prepared = PreparedSettings(line, pairs, objects, observer=observer, texture=texture)
    unit = math.sqrt(float(np.median(prepared.pixel_variance)))
    logs = np.log([one.a90 for one in known])
    errors = np.array([one.log_sd or 0.0 for one in known])
    middle, reach = np.array([0.0, 0.5 * _WIDEST[1]]), np.array(_WIDEST)
    scatter = 0.0
    for _ in range(_ROUNDS):
        grid = _Grid(prepared, objects, observer, unit, middle=middle, reach=reach)
        outside = _left_out(grid, logs, np.hypot(errors, scatter))
        scatter = _scatter_of(outside[0], outside[1] + errors**2)
        parameters, covariance = grid.moments(grid.posterior(logs, np.hypot(errors, scatter)))
        # the next grid is where the posterior is, with room for those of fewer settings
        step = np.array([grid.log_efficiency[1] - grid.log_efficiency[0], grid.noise[1] - grid.noise[0]])
        middle, reach = parameters, np.minimum(_SDS * np.sqrt(np.diag(covariance)) + step, reach)
    quantile = _quantile(len(known))
    rows = []
    for one, residual, variance, error in zip(known, *outside, errors, strict=True):
        predicted = math.log(one.a90) - residual
        width = quantile * math.sqrt(variance + scatter**2)
        rows.append(
            LeftOut(
                pair=one.pair,
                measured=one.a90,
                predicted=math.exp(predicted),
                low=math.exp(predicted - width),
                high=math.exp(predicted + width),
                log_sd=float(error),
            )
        )
    (a, b), (_, c) = covariance.tolist()
    return Efficiency(
        observer=replace(
            observer, efficiency=math.exp(float(parameters[0])), internal_noise=float(parameters[1]) * unit
        ),
        covariance=((a, b), (b, c)),
        unit=unit,
        scatter=scatter,
        left_out=tuple(rows),
        size_name=objects.size_name,
        product_material=objects.product_material,
        foreign_material=objects.foreign_material,
    )


def _quantile(settings: int) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(settings - 2, 0.975))


def _left_out(grid: _Grid, logs: FloatArray, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Departure of each setting from the fit to the others, and the variance of that fit there (setting,) each."""
    found = [grid.predicted(grid.posterior(logs, errors, without=number), number) for number in range(len(logs))]
    means, variances = np.array(found).T
    return logs - means, variances


def _scatter_of(residuals: FloatArray, variances: FloatArray) -> float:
    """The scatter at which the standardised residuals have a mean square of 1; 0 where they are less without any."""
    from scipy.optimize import brentq

    def excess(square: float) -> float:
        return float(np.mean(residuals**2 / (variances + square)) - 1.0)

    if excess(0.0) <= 0:
        return 0.0
    return math.sqrt(float(brentq(excess, 0.0, float(np.sum(residuals**2)) + 1e-12)))


def predicted_sizes(
    line: LineImages,
    pairs: Sequence[Pair],
    objects: ForeignObjects,
    efficiency: Efficiency,
    *,
    texture: ProductTexture | None = None,
) -> PredictedSizes:
    """a90 (setting,) that networks would have, with 95 % intervals: of the two numbers, and of what left-out settings showed.

    It is that of networks trained and tried as the calibrating ones were, on images of the same twin; what the twin itself is
    uncertain by is not in it.
    """
    if objects.size_name != efficiency.size_name:
        raise InputError(
            "objects",
            received=f"sizes as {objects.size_name}",
            expected=f"{efficiency.size_name}, by which the observer was calibrated",
        )
    check_materials(efficiency, product_material=objects.product_material, foreign_material=objects.foreign_material)
    observer = efficiency.observer
    covariance = np.array(efficiency.covariance)
    quantile = _quantile(len(efficiency.left_out))
    parts = []
    for first in range(0, len(pairs), SETTINGS_AT_ONCE):
        prepared = PreparedSettings(
            line, pairs[first : first + SETTINGS_AT_ONCE], objects, observer=observer, texture=texture
        )
        nodes = np.array([0.0, -_STEP, _STEP]) + math.log(observer.efficiency)
        d_prime, threshold = prepared.d_and_threshold(observer.internal_noise)
        logs = log_a90_of(d_prime, threshold, nodes, objects, observer)
        moved = prepared.d_and_threshold(observer.internal_noise + _STEP * efficiency.unit)
        noisier = log_a90_of(*moved, nodes[:1], objects, observer)[0]
        slopes = np.stack([(logs[2] - logs[1]) / (2 * _STEP), (noisier - logs[0]) / _STEP], axis=1)
        variance = np.einsum("si,ij,sj->s", slopes, covariance, slopes)
        reach = quantile * np.sqrt(variance + efficiency.scatter**2)
        parts.append(np.exp(np.stack([logs[0], logs[0] - reach, logs[0] + reach])))
    a90, low, high = np.concatenate(parts, axis=1)
    return PredictedSizes(a90=a90, low=low, high=high)
