"""The posterior of spectral parameters given the data: shapes drawn, all else integrated out.

Filtration, scintillator thickness, tube voltage, K escape and the sizes of discrepancies are drawn (`posterior_draws`). All
else (scales, tables, exponents, light, covers) acts on the logarithm of a level nearly linearly: for each draw it is
integrated out about that draw's own derivatives, taken where the data put these parameters, and drawn back so that the levels
are met by the model itself and not by its derivatives.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...generator.line.photon_tables import OTHER_TABLES
from ...generator.line.spectral_signal import (
    ALTERNATIVE_SCINTILLATOR,
    SHARED_CHARGE,
    THRESHOLD,
    OpenBeam,
    SpectralModel,
    absorber_of_parameter,
)
from ...generator.line.twin import Z95
from .dose_data import DOSIMETER_HARDNESS
from .posterior_draws import climbed, draw, resampled
from .priors import (
    GADOLINIUM_SHARE,
    LOG_DISCREPANCY_SD,
    NONE_OR_SOME,
    PRIORS,
    SHARES_CORRELATION,
    Prior,
    ripple_from_latent,
)
from .spectral_data import DISCREPANCIES, DISCREPANCY_OF, OF_DETECTOR, Datum

_KEPT = 512
_FARTHEST = 6.0  # prior standard deviations at which derivatives are taken: Gaussian, one parameter in 5e8 lies beyond
_WIDEST_SIZE = 4.0  # prior standard deviations of the logarithm of a discrepancy's size
_LINEARISED_ABOUT = 64  # draws whose mean is the point at which the linear parameters' derivatives are taken
_STEP_SHARES = (1.0, 0.3, 0.1, 0.0)  # of a Newton step, the next where the last one leads uphill
_NEWTON_STEPS = 3  # of the linear parameters of each draw, towards the model itself
SHAPE_PARAMETERS = (
    "inherent_filtration_mm_Al",
    "log_scintillator_thickness",
    "kV_error",
    "escape_scale",
    *NONE_OR_SOME,
    THRESHOLD,
    SHARED_CHARGE,
    ALTERNATIVE_SCINTILLATOR,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampled:
    """Best set (parameter,), equally likely draws (draw, parameter), their discrepancies (draw,) each, effective sample size."""

    best: NDArray[np.float64]
    samples: NDArray[np.float64]
    discrepancies: Mapping[str, NDArray[np.float64]]
    effective: float


class Posterior:
    """Log posterior of the shapes in units of the prior, u = (parameter - centre) / sd.

    For each draw of the shapes: y ~ N(f - J a, W + J J'), with W the noise and discrepancy of the data, f the model and J the
    derivatives of the linear parameters times their prior sd, both at a, where the data put the linear parameters (in units
    of their prior sd; the prior's centre until something is known).
    """

    def __init__(
        self,
        model: SpectralModel,
        priors: dict[str, Prior],
        beams: Sequence[OpenBeam],
        data: Sequence[Datum],
        discrepancies: Mapping[str, float | None],
        repeats: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]] = (),
    ) -> None:
        self.model = model
        self.beams = beams
        self.data = data
        names = model.names
        shapes = {name for name in names if name in SHAPE_PARAMETERS or absorber_of_parameter(name)}
        # what a voltage's ripple takes from its mean and adds to its variance go together
        self.rippling = priors["kV_variance"] is PRIORS["kV_variance"]
        if self.rippling:
            shapes.add("kV_variance")
        self.shape = np.array([i for i, name in enumerate(names) if name in shapes])
        self.linear = np.array([i for i, name in enumerate(names) if name not in shapes])
        self.linear_names = [names[i] for i in self.linear]
        self.centre = np.array([priors[name].centre for name in names])
        self.sd = np.array([priors[name].sd for name in names])
        self.low = (np.array([priors[name].low for name in names]) - self.centre) / self.sd
        self.high = (np.array([priors[name].high for name in names]) - self.centre) / self.sd
        self.value = np.array([item.value for item in data])
        self.noise = np.array([item.sd for item in data])
        self.fixed = dict(discrepancies)
        self.repeats = tuple(repeats)
        self.departing = [DISCREPANCY_OF[item.kind] for item in data]
        # levels and gains count where there are any flats: even a kind without data then strays as its prior says
        of_flats = not data or any(item.kind in ("rate", "gain") for item in data)
        kinds = {*self.departing, *(("level", "gain") if of_flats else ())}
        self.learned = [name for name in DISCREPANCIES if name in kinds and self.fixed.get(name) is None]
        self.dimensions = len(self.shape) + len(self.learned)
        self.about = np.zeros(len(self.linear))
        # one of the tables is right, so shares of two others exclude each other: what one takes is missing to the other
        self.mixing = np.eye(len(self.linear))
        for first, second in self._share_pairs():
            self.mixing[second, first] = SHARES_CORRELATION
            self.mixing[second, second] = math.sqrt(1.0 - SHARES_CORRELATION**2)
        self.alternative = next(
            (i for i, place in enumerate(self.shape) if names[place] == ALTERNATIVE_SCINTILLATOR), None
        )
        self.none_or_some = [place for place in self.shape if names[place] in NONE_OR_SOME]

    def _share_pairs(self) -> list[tuple[int, int]]:
        """Places among the linear parameters of each material's shares of the two other tables."""
        first, second = (f"{table}_" for table in OTHER_TABLES)
        place = {name: i for i, name in enumerate(self.linear_names)}
        return [
            (i, place[second + name.removeprefix(first)])
            for name, i in place.items()
            if name.startswith(first) and second + name.removeprefix(first) in place
        ]

    def parameters(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Full parameter sets (draw, parameter), the linear ones where the data put them, from shapes (draw, shape)."""
        full = np.tile(self.centre, (len(u), 1))
        full[:, self.linear] += self.linear_sd * (self.mixing @ self.about)
        full[:, self.shape] += self.sd[self.shape] * u[:, : len(self.shape)]
        if self.alternative is not None:
            # a Gaussian latent with the threshold that gives the prior's share
            from scipy.special import ndtri

            chosen = u[:, self.alternative] > float(ndtri(1.0 - GADOLINIUM_SHARE))
            full[:, self.shape[self.alternative]] = chosen
        for place in self.none_or_some:
            full[:, place] = np.maximum(full[:, place], 0.0)
        if self.rippling:
            error, variance = (self.model.names.index(name) for name in ("kV_error", "kV_variance"))
            ripple = ripple_from_latent(u[:, int(np.flatnonzero(self.shape == variance)[0])])
            full[:, error] -= 0.5 * ripple
            full[:, variance] = ripple**2 / 8.0
        return full

    def discrepancies(self, u: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Relative sd of each kind of data beyond the model (draw,) each."""
        result = {}
        for name, centre in DISCREPANCIES.items():
            fixed = self.fixed.get(name)
            if fixed is not None:
                result[name] = np.full(len(u), fixed)
            elif name in self.learned:
                column = len(self.shape) + self.learned.index(name)
                result[name] = centre * np.exp(LOG_DISCREPANCY_SD * u[:, column])
        return result

    @property
    def linear_sd(self) -> NDArray[np.float64]:
        """Prior standard deviations of the linear parameters (linear,)."""
        return np.asarray(self.sd[self.linear])

    def variances(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variance of each datum's logarithm (draw, datum)."""
        found = self.discrepancies(u)
        extra = np.stack([found[name] for name in self.departing], axis=1)
        return np.asarray(self.noise**2 + extra**2 + 1e-12)

    def expectation(self, parameters: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Logarithms that the model expects (draw, datum) and their derivatives (draw, datum, linear)."""
        value = np.empty((len(parameters), len(self.data)))
        slope = np.empty((len(parameters), len(self.data), len(self.linear)))
        self._expected_kermas(parameters, value, slope)
        self._expected_signals(parameters, value, slope)
        for column, item in enumerate(self.data):
            for name, by in item.moves:
                slope[:, column, self.linear_names.index(name)] = by
                # the derivatives may stand where the data put this parameter
                value[:, column] += parameters[:, self.model.names.index(name)] * by
        return value, slope

    def _expected_signals(
        self, parameters: NDArray[np.float64], value: NDArray[np.float64], slope: NDArray[np.float64]
    ) -> None:
        """Fill in what the model expects of the detector's data: see `expectation`."""
        seen = {place for item in self.data if item.kind in OF_DETECTOR for place in (item.beam, item.over)}
        if not seen:
            return
        deposits = self.model.deposit_tables(parameters)
        found = {
            place: self.model.log_derivatives(parameters, beam, self.linear_names, deposits=deposits)
            for place, beam in enumerate(self.beams)
            if place in seen
        }
        for column, item in enumerate(self.data):
            if item.kind not in OF_DETECTOR:
                continue
            logs, rate, gain = found[item.beam]
            value[:, column] = logs[1] if item.kind == "gain" else logs[0]
            slope[:, column] = gain if item.kind == "gain" else rate
            if item.over >= 0:
                value[:, column] -= found[item.over][0][0]
                slope[:, column] -= found[item.over][1]

    def _expected_kermas(
        self, parameters: NDArray[np.float64], value: NDArray[np.float64], slope: NDArray[np.float64]
    ) -> None:
        """Fill in what the model expects of the kermas and their ratios: see `expectation`."""
        kinds = [(column, item) for column, item in enumerate(self.data) if item.kind not in OF_DETECTOR]
        found = {
            place: self.model.log_kerma_derivatives(parameters, self.beams[place], self.linear_names)
            for place in {place for _, item in kinds for place in (item.beam, item.over) if place >= 0}
        }
        for column, item in kinds:
            value[:, column], slope[:, column], hardness = found[item.beam]
            if item.over >= 0:
                value[:, column] -= found[item.over][0]
                slope[:, column] -= found[item.over][1]
                hardness = hardness - found[item.over][2]
            slope[:, column, self.linear_names.index(DOSIMETER_HARDNESS)] = hardness
            value[:, column] += parameters[:, self.model.names.index(DOSIMETER_HARDNESS)] * hardness

    @property
    def _largest_variances(self) -> NDArray[np.float64]:
        """Variance of each datum's logarithm (datum,) with the largest plausible discrepancy."""
        return np.asarray(self.variances(np.full((1, self.dimensions), Z95))[0])

    def chi_square(self, parameters: NDArray[np.float64]) -> float:
        """Squared misfit over noise and the largest plausible discrepancy, at one parameter set (parameter,)."""
        misfit = self.value - self.expectation(parameters[None, :])[0][0]
        return float((misfit**2 / self._largest_variances).sum())

    def squares_with_priors(self, parameters: NDArray[np.float64]) -> float:
        """`chi_square` and how far parameters (parameter,) lie from their priors: at the best, as many as there are data."""
        latent = (ALTERNATIVE_SCINTILLATOR, *(("kV_variance",) if self.rippling else ()))
        known = np.array([name not in latent for name in self.model.names])
        return self.chi_square(parameters) + float(np.sum(((parameters - self.centre) / self.sd)[known] ** 2))

    def birge_ratio(self, parameters: NDArray[np.float64]) -> float:
        """By how much data err more than they state, all alike, at the best parameter set (parameter,).

        Source: Birge (1932), doi:10.1103/PhysRev.40.207; ratio: sqrt(chi-square / number of data).
        """
        return math.sqrt(self.squares_with_priors(parameters) / len(self.data))

    def data_in_error(self, ratio: float) -> list[Datum]:
        """Data that err so many times more than they state, departures from the model included."""
        sd = ratio * np.sqrt(self._largest_variances)
        return [replace(item, sd=float(own)) for item, own in zip(self.data, sd, strict=True)]

    def _conditional(self, u: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Log likelihood (draw,) and mean (draw, linear) of the linear parameters given u, in units of their prior sd."""
        expected, slope = self.expectation(self.parameters(u))
        slope = (slope * self.linear_sd) @ self.mixing
        variance = self.variances(u)
        misfit = self.value - expected + slope @ self.about
        lower, right = self._normal_equations(slope, variance, misfit)
        half = np.linalg.solve(lower, right[:, :, None])[:, :, 0]
        mean = np.asarray(np.linalg.solve(np.swapaxes(lower, 1, 2), half[:, :, None])[:, :, 0], dtype=np.float64)
        logarithm: NDArray[np.float64] = -0.5 * (np.sum(misfit**2 / variance, axis=1) - np.sum(half**2, axis=1))
        logarithm -= 0.5 * np.sum(np.log(variance), axis=1)
        logarithm -= np.sum(np.log(np.diagonal(lower, axis1=1, axis2=2)), axis=1)
        return logarithm, mean

    @staticmethod
    def _normal_equations(
        slope: NDArray[np.float64], variance: NDArray[np.float64], misfit: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower root of the linear parameters' precision (draw, linear, linear) and the right side (draw, linear)."""
        weighted = slope / variance[:, :, None]
        precision = np.eye(slope.shape[2]) + np.swapaxes(slope, 1, 2) @ weighted
        lower = np.asarray(np.linalg.cholesky(precision), dtype=np.float64)
        return lower, np.einsum("ndk,nd->nk", weighted, misfit)

    def relinearise(self, u: NDArray[np.float64], weight: NDArray[np.float64], rng: np.random.Generator) -> None:
        """Take derivatives from now on where draws (draw, dimension) of these weights (draw,) put the linear parameters.

        Data that contradict each other would put them where no tube or detector is, and the model has no numbers.
        """
        chosen = u[resampled(weight, _LINEARISED_ABOUT, rng)]
        self.about = np.clip(self._conditional(chosen)[1].mean(axis=0), -_FARTHEST, _FARTHEST)

    def _log_likelihood_of_repeats(self, level_sd: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log likelihood (draw,) of the scatter between repeats of a setting, whatever its level: y ~ N(m, s^2 + sd^2)."""
        result = np.zeros(len(level_sd))
        for logs, sampling in self.repeats:
            weight = 1.0 / (sampling**2 + level_sd[:, None] ** 2)
            mean = np.sum(weight * logs, axis=1) / np.sum(weight, axis=1)
            result -= 0.5 * np.sum(weight * (logs - mean[:, None]) ** 2 - np.log(weight), axis=1)
            result -= 0.5 * np.log(np.sum(weight, axis=1))
        return result

    def log_likelihood(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log likelihood of draws (draw, dimension), the linear parameters integrated out; -inf out of bounds."""
        shapes = (self.parameters(u) - self.centre)[:, self.shape] / self.sd[self.shape]
        inside = np.all((shapes >= self.low[self.shape]) & (shapes <= self.high[self.shape]), axis=1)
        inside &= np.all(np.abs(u[:, len(self.shape) :]) <= _WIDEST_SIZE, axis=1)
        result = np.full(len(u), -np.inf)
        if inside.any():
            result[inside] = self._conditional(u[inside])[0]
            if self.repeats:
                result[inside] += self._log_likelihood_of_repeats(self.discrepancies(u[inside])["level"])
        return result

    def with_linear(self, u: NDArray[np.float64], rng: np.random.Generator | None) -> NDArray[np.float64]:
        """Full parameter sets (draw, parameter): the linear ones drawn given the shapes; without rng the most probable.

        Each draw solves the least-squares problem whose data and prior centres were moved by draws of their noise, which is
        exact for a linear model and meets the data where it bends.

        Source: Bardsley, Solonen, Haario and Laine (2014), SIAM J Sci Comput 36:A1895.
        """
        full, variance = self.parameters(u), self.variances(u)
        z = np.tile(self.about, (len(u), 1))
        moved, pulled = self.value, np.zeros(z.shape)
        if rng is not None:
            moved = self.value + np.sqrt(variance) * rng.standard_normal(variance.shape)
            pulled = rng.standard_normal(z.shape)

        def cost(rows: NDArray[np.intp], expected: NDArray[np.float64]) -> NDArray[np.float64]:
            data = np.sum((moved[rows] - expected) ** 2 / variance[rows], axis=1)
            return np.asarray(data + np.sum((z[rows] - pulled[rows]) ** 2, axis=1))

        every = np.arange(len(u))
        moved = np.broadcast_to(moved, variance.shape)
        expected, slope = self.expectation(full)
        least = cost(every, expected)
        for _ in range(_NEWTON_STEPS):
            slope = (slope * self.linear_sd) @ self.mixing
            misfit = moved - expected + np.einsum("ndk,nk->nd", slope, z)
            lower, right = self._normal_equations(slope, variance, misfit)
            half = np.linalg.solve(lower, (right + pulled)[:, :, None])
            step = np.linalg.solve(np.swapaxes(lower, 1, 2), half)[:, :, 0] - z
            expected, slope = np.empty_like(expected), np.empty_like(slope)
            rows, before = every, z.copy()
            for share in _STEP_SHARES:
                z[rows] = before[rows] + share * step[rows]
                full[np.ix_(rows, self.linear)] = self.centre[self.linear] + self.linear_sd * (z[rows] @ self.mixing.T)
                expected[rows], slope[rows] = self.expectation(full[rows])
                found = cost(rows, expected[rows])
                better = found <= least[rows]
                least[rows[better]] = found[better]
                rows = rows[~better]
                if not rows.size:
                    break
        names = list(self.model.names)
        bounds = (self.centre + self.sd * self.low, self.centre + self.sd * self.high)
        # a bound that cuts the Swank factor is met along gain and output, so that levels and gains stay as they were
        swank, gain, output = (names.index(name) for name in ("log_swank", "log_DN_per_keV", "log_output"))
        beyond = full[:, swank] - np.clip(full[:, swank], bounds[0][swank], bounds[1][swank])
        full[:, swank] -= beyond
        full[:, gain] -= beyond
        full[:, output] += beyond
        return full

    def _best_from(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """The most probable set (parameter,) near a draw (dimension,)."""
        return np.asarray(self.with_linear(climbed(self, u, still=self.alternative)[None, :], None)[0])

    def sample(self, rng: np.random.Generator, *, farthest: float = math.inf) -> "Sampled":
        """The best set and draws.

        Raises:
            FitError: no draws were found, or none as near to data and priors (`squares_with_priors`) as `farthest`.
        """
        found = draw(self, rng, hopeless=lambda nearest: self.squares_with_priors(self._best_from(nearest)) > farthest)
        kept = found.u[resampled(found.weight, _KEPT, rng)]
        return Sampled(
            best=self._best_from(found.most_probable),
            samples=self.with_linear(kept, rng),
            discrepancies=self.discrepancies(kept),
            effective=found.effective,
        )
