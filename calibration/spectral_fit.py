"""The spectral part of a twin: tube, filtration, scintillator and gain from the levels and gains of the flats.

Only ratios between levels say anything of the spectrum, and flats alone leave much open; so the answer is a posterior,
drawn by adaptive importance sampling about the most probable point.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..acquisition.instrument import Instrument
from ..acquisition.setting import Filter, text_from_filters
from ..errors import FitError
from ..generator.spectral_signal import REFERENCE_KV, OpenBeam, SpectralModel
from ..generator.twin import Level, SpectralPosterior
from .priors import (
    ATTENUATION_SCALE,
    COUNTING_SWANK,
    GAIN_DISCREPANCY,
    LEVEL_DISCREPANCY,
    PRIORS,
    UNDECLARED_SCINTILLATOR,
    Prior,
)

_DRAWS = 4096
_KEPT = 512
_STUDENT_DEGREES = 5.0
_MIXTURE = (0.7, 0.2, 0.1)
_Z95 = 1.959964
LINEAR_PARAMETERS = ("log_output", "log_DN_per_keV", "log_swank", "yield_exponent")


@dataclass(frozen=True, slots=True, kw_only=True)
class SpectralFit:
    """Posterior and how well it was drawn: effective sample size of the last round, chi-square at the best point."""

    posterior: SpectralPosterior
    effective_draws: float
    chi_square: float
    data: int


@dataclass(frozen=True, slots=True)
class _Datum:
    beam: OpenBeam
    log_rate: float | None  # per mAs at 1 m and 1 mm2
    log_rate_sd: float
    log_gain: float
    log_gain_sd: float


def geometry_factor(*, source_detector_mm: float | None, pixel_mm: float | None) -> float:
    """Photons on a pixel over those on 1 mm2 at 1 m: (1000 / d)^2 a^2; what is unknown counts as 1 m, 1 mm."""
    distance = 1000.0 if source_detector_mm is None else source_detector_mm
    pitch = 1.0 if pixel_mm is None else pixel_mm
    return (1000.0 / distance) ** 2 * pitch**2


def priors_for(model: SpectralModel, *, scintillator_declared: bool) -> dict[str, Prior]:
    """The priors of a model's parameters, in the order of its names."""
    result = {}
    for name in model.names:
        if name == "log_scintillator_thickness" and not scintillator_declared:
            result[name] = UNDECLARED_SCINTILLATOR
        elif name == "log_swank" and model.counting:
            result[name] = COUNTING_SWANK
        else:
            result[name] = PRIORS.get(name, ATTENUATION_SCALE)
    return result


def fit_spectrum(
    levels: Sequence[Level],
    instrument: Instrument,
    *,
    rng: np.random.Generator,
    level_discrepancy: float = LEVEL_DISCREPANCY,
    gain_discrepancy: float = GAIN_DISCREPANCY,
    model_name: str = "casim",
) -> SpectralFit:
    """Posterior of the spectral parameters from measured levels and gains.

    Args:
        levels: measured levels; those without kV are left out.
        instrument: what the owner declares; the rest takes the defaults (W, 12 degrees, CsI 0.5 mm, no filtration).
        rng: source of randomness.
        level_discrepancy, gain_discrepancy: relative standard deviation of a level and of a gain beyond the model.
        model_name: SpekPy's physics model.

    Raises:
        FitError: no level with a kV, or the posterior cannot be sampled.
    """
    known = [level for level in levels if level.kV is not None]
    if not known:
        raise FitError("no flat series states its kV, so nothing can be said of the spectrum")
    # the commonest filters carry their uncertainty even where they were not measured
    materials = sorted({layer.material for level in known for layer in level.filters} | {"Al", "Cu"})
    scintillator = instrument.scintillator or (Filter(material="CsI", thickness_mm=0.5),)
    model = SpectralModel(
        anode=instrument.anode or "W",
        anode_angle_deg=instrument.anode_angle_deg or 12.0,
        model=model_name,
        inherent=instrument.inherent_filtration or (),
        scintillator=scintillator,
        cover=instrument.detector_cover or (),
        counting=bool(instrument.counting),
        filter_materials=materials,
        highest_kV=max(160.0, *(level.kV or 0.0 for level in known)),
    )
    priors = priors_for(model, scintillator_declared=instrument.scintillator is not None)
    data = []
    for level in known:
        factor = geometry_factor(source_detector_mm=level.source_detector_mm, pixel_mm=instrument.pixel_mm)
        rate = level.rate_DN_per_mAs
        gain = level.gain_DN
        data.append(
            _Datum(
                OpenBeam(kV=level.kV or 0.0, filters=level.filters),
                None if rate is None or rate.value <= 0 else math.log(rate.value / factor),
                math.hypot(level_discrepancy, 0.0 if rate is None else _relative_sd(rate.value, rate.low, rate.high)),
                math.log(max(gain.value, 1e-12)),
                math.hypot(gain_discrepancy, _relative_sd(gain.value, gain.low, gain.high)),
            )
        )
    posterior = _Posterior(model, priors, data)
    best, samples, effective = posterior.sample(rng)
    names = model.names
    undetermined = _undetermined(names, samples, priors)
    voltages = [level.kV or 0.0 for level in known]
    return SpectralFit(
        posterior=SpectralPosterior(
            names=names,
            samples=samples,
            best=best,
            prior={name: str(prior) for name, prior in priors.items()},
            undetermined=undetermined,
            anode=model.anode,
            anode_angle_deg=model.anode_angle_deg,
            model=model.model,
            inherent=model.inherent,
            scintillator=model.scintillator,
            cover=model.cover,
            counting=model.counting,
            level_discrepancy=level_discrepancy,
            gain_discrepancy=gain_discrepancy,
            calibrated_kV=(min(voltages), max(voltages)),
            calibrated_filters=tuple(sorted({text_from_filters(level.filters) for level in known})),
        ),
        effective_draws=effective,
        chi_square=posterior.chi_square(best),
        data=posterior.size,
    )


def _relative_sd(value: float, low: float, high: float) -> float:
    return (high - low) / (2 * _Z95) / max(abs(value), 1e-300)


class _Posterior:
    """Log posterior in units of the prior, u = (parameter - centre) / sd.

    Logarithms of levels and gains are linear in the scales (output, DN a keV, Swank factor, yield exponent), so these
    are integrated out exactly: y ~ N(f(nonlinear), S) with one S for all, and drawn back from their conditional
    Gaussian. What is left is a handful of shape parameters.
    """

    def __init__(self, model: SpectralModel, priors: dict[str, Prior], data: Sequence[_Datum]) -> None:
        self.model = model
        self.data = data
        names = model.names
        self.shape = np.array([i for i, name in enumerate(names) if name not in LINEAR_PARAMETERS])
        self.linear = np.array([i for i, name in enumerate(names) if name in LINEAR_PARAMETERS])
        self.centre = np.array([priors[name].centre for name in names])
        self.sd = np.array([priors[name].sd for name in names])
        self.low = (np.array([priors[name].low for name in names]) - self.centre) / self.sd
        self.high = (np.array([priors[name].high for name in names]) - self.centre) / self.sd
        self.size = sum(1 if item.log_rate is None else 2 for item in data)
        target, noise, rows = [], [], []
        for item in data:
            if item.log_rate is not None:
                target.append(item.log_rate)
                noise.append(item.log_rate_sd)
                rows.append([1.0, 1.0, 0.0, math.log(item.beam.kV / REFERENCE_KV)])
            target.append(item.log_gain)
            noise.append(item.log_gain_sd)
            rows.append([0.0, 1.0, -1.0, 0.0])
        self.target = np.array(target)
        self.noise = np.array(noise)
        order = [LINEAR_PARAMETERS.index(names[i]) for i in self.linear]
        self.design = np.array(rows)[:, order] * self.sd[self.linear]
        covariance = np.diag(self.noise**2) + self.design @ self.design.T
        self.whitening = np.linalg.inv(np.linalg.cholesky(covariance))

    def parameters(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Full parameter sets (draw, parameter) with the scales at their prior centres, from shapes (draw, shape)."""
        full = np.tile(self.centre, (len(u), 1))
        full[:, self.shape] += self.sd[self.shape] * u
        return full

    def misfit(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """Data less model (draw, datum), in logarithms."""
        columns = []
        for item in self.data:
            signal = self.model.signal(parameters, item.beam)
            if item.log_rate is not None:
                columns.append(np.log(signal.rate_DN_per_mAs))
            columns.append(np.log(signal.gain_DN))
        return np.asarray(self.target - np.stack(columns, axis=1))

    def chi_square(self, parameters: NDArray[np.float64]) -> float:
        return float(np.sum((self.misfit(parameters[None, :]) / self.noise) ** 2))

    def log_density(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log posterior of shapes (draw, shape), the scales integrated out, up to a constant."""
        inside = np.all((u >= self.low[self.shape]) & (u <= self.high[self.shape]), axis=1)
        result = np.full(len(u), -np.inf)
        if inside.any():
            whitened = self.misfit(self.parameters(u[inside])) @ self.whitening.T
            result[inside] = -0.5 * np.sum(whitened**2, axis=1) - 0.5 * np.sum(u[inside] ** 2, axis=1)
        return result

    def with_scales(self, u: NDArray[np.float64], rng: np.random.Generator | None) -> NDArray[np.float64]:
        """Full parameter sets (draw, parameter): scales drawn given the shapes; without rng their mean."""
        full = self.parameters(u)
        misfit = self.misfit(full)
        precision = np.eye(len(self.linear)) + self.design.T @ (self.design / self.noise[:, None] ** 2)
        covariance = np.linalg.inv(precision)
        scales = misfit / self.noise**2 @ self.design @ covariance.T
        if rng is not None:
            scales = scales + rng.standard_normal(scales.shape) @ np.linalg.cholesky(covariance).T
        scales = np.clip(scales, self.low[self.linear], self.high[self.linear])
        full[:, self.linear] += self.sd[self.linear] * scales
        return full

    def maximum(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The most probable shapes (shape,) and their covariance about it, from three starts in the filtration."""
        from scipy.optimize import least_squares

        low, high = self.low[self.shape], self.high[self.shape]

        def function(u: NDArray[np.float64]) -> NDArray[np.float64]:
            whitened = self.whitening @ self.misfit(self.parameters(u[None, :]))[0]
            return np.concatenate([whitened, u])

        position = [self.model.names[i] for i in self.shape].index("inherent_filtration_mm_Al")
        index = self.shape[position]
        best = None
        for filtration in (0.3, 1.0, 3.0):
            start = np.clip(np.zeros(len(low)), low + 1e-6, high - 1e-6)
            start[position] = (filtration - self.centre[index]) / self.sd[index]
            result = least_squares(function, start, bounds=(low, high), max_nfev=100)
            if best is None or result.cost < best.cost:
                best = result
        if best is None or not np.all(np.isfinite(best.x)):
            raise FitError("the spectral fit did not converge; check kV, current and filter of the flats")
        return np.asarray(best.x), np.asarray(np.linalg.inv(best.jac.T @ best.jac))

    def sample(self, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Best set (parameter,), equally likely draws (draw, parameter), and the effective sample size behind them."""
        mode, covariance = self.maximum()
        mean = mode
        effective = 0.0
        u = weight = None
        for draws in (_DRAWS, _DRAWS, _DRAWS, 4 * _DRAWS):
            u, log_proposal = _mixture_draws(mean, covariance, draws, rng)
            log_weight = self.log_density(u) - log_proposal
            weight = np.exp(log_weight - np.max(log_weight))
            weight /= weight.sum()
            effective = 1.0 / float(np.sum(weight**2))
            if effective > 1.5 * _KEPT:
                break
            mean = weight @ u
            spread = u - mean
            # with few effective draws the old covariance steadies the new one
            trust = min(1.0, effective / (10.0 * len(mean)))
            covariance = trust * ((spread * weight[:, None]).T @ spread) + (1.0 - trust) * 1.5 * covariance
            covariance += 1e-8 * np.eye(len(mean))
        if u is None or weight is None or effective < 40:
            raise FitError(
                f"the posterior of the spectrum could not be drawn (effective sample size {effective:.0f});"
                " the levels contradict each other or the declared instrument"
            )
        positions = (np.arange(_KEPT) + rng.random()) / _KEPT  # systematic resampling
        chosen = np.minimum(np.searchsorted(np.cumsum(weight), positions), len(u) - 1)
        return self.with_scales(mode[None, :], None)[0], self.with_scales(u[chosen], rng), effective


def _mixture_draws(
    mean: NDArray[np.float64], covariance: NDArray[np.float64], draws: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draws (draw, shape), log density: 70 % Student t about the mode, 20 % three times as wide, 10 % the prior."""
    size = len(mean)
    lower = np.linalg.cholesky(covariance)
    normal = rng.standard_normal((draws, size))
    heavy = np.sqrt(_STUDENT_DEGREES / rng.chisquare(_STUDENT_DEGREES, size=draws))[:, None]
    kind = rng.choice(3, size=draws, p=_MIXTURE)[:, None]
    width = np.where(kind == 1, 3.0, 1.0)
    u = np.where(kind == 2, normal, mean + width * heavy * (normal @ lower.T))
    z = np.linalg.solve(lower, (u - mean).T)
    square = np.sum(z**2, axis=0)
    log_determinant = float(np.sum(np.log(np.diag(lower))))
    constant = (
        math.lgamma(0.5 * (_STUDENT_DEGREES + size))
        - math.lgamma(0.5 * _STUDENT_DEGREES)
        - 0.5 * size * math.log(math.pi * _STUDENT_DEGREES)
    )

    def student(scale: float) -> NDArray[np.float64]:
        tail = 0.5 * (_STUDENT_DEGREES + size) * np.log1p(square / scale**2 / _STUDENT_DEGREES)
        return np.asarray(constant - log_determinant - size * math.log(scale) - tail)

    prior = -0.5 * np.sum(u**2, axis=1) - 0.5 * size * math.log(2 * math.pi)
    parts = np.stack([student(1.0), student(3.0), prior]) + np.log(np.array(_MIXTURE))[:, None]
    return u, np.asarray(np.logaddexp.reduce(parts, axis=0))


def _undetermined(names: Sequence[str], samples: NDArray[np.float64], priors: dict[str, Prior]) -> tuple[str, ...]:
    """Parameters whose spread is still more than 0.7 of the prior's: the data say nothing of them alone."""
    result = []
    for index, name in enumerate(names):
        if name == "log_DN_per_keV":
            continue
        share = float(np.std(samples[:, index])) / priors[name].sd
        if share > 0.7:
            result.append(f"{name}: {100 * share:.0f} % of the prior's width is left")
    correlation = np.asarray(np.corrcoef(samples.T)).reshape(len(names), len(names))
    for i in range(len(names)):
        for j in range(i):
            if abs(correlation[i, j]) > 0.9:
                result.append(
                    f"{names[j]} and {names[i]} are known only together (correlation {correlation[i, j]:+.2f})"
                )
    return tuple(result)
