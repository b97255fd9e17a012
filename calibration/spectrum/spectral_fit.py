"""The spectral part of a twin: tube, filtration, scintillator and gain from levels, gains and transmissions.

Only ratios between levels say anything of the spectrum, and flats alone leave much open; so the answer is a posterior. Its data are
made in `spectral_data`, its model and priors in `spectral_model`; `spectral_posterior` weighs and draws it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.instrument import Instrument
from ...acquisition.setting import text_from_filters
from ...errors import FitError
from ...generator.line.spectral_signal import (
    OpenBeam,
    SpectralModel,
    SpectrumCorrection,
    attenuation_scale_name,
)
from ...generator.line.twin import Z95, Level, NoiseModel, SpectralPosterior
from ...generator.line.twin_spectrum import secondary_of_levels
from ...spectra import Spectrum
from .dose_data import DOSE_FILTRATION, KermaRatio, KermaReading, absorber_priors, dose_parameters
from .priors import (
    DARK_CURRENT,
    DARK_CURRENT_PRIOR,
    GAIN_DISCREPANCY,
    LEVEL_DISCREPANCY,
    PRIORS,
    UNLIKE_OUTPUT,
    WEDGE_THICKNESS,
    Prior,
    spread_of,
)
from .spectral_data import (
    WEDGE,
    Datum,
    Transmission,
    dosimeter_data,
    level_data,
    repeated_levels,
    transmission_data,
    wedge_thickness_name,
)
from .spectral_model import correction_from_spectra, counter_priors, model_for, priors_for
from .spectral_posterior import SHAPE_PARAMETERS, Posterior, Sampled

_SAYS_NOTHING = 30.0  # sd of the logarithm of a datum that is left out
_MOST_ROUNDS = 6  # of fits to data that contradict the model, their errors larger each time
_OUTPUT = "log_output"
_WEDGE_DEPARTS = 2.5  # standard deviations: one wedge in 80 departs so far
# standard deviations of the prior from which on the output is looked at, and of prior and data from which on it is not believed:
# Gaussian, 3 in 1000 lines with right labels have it
_OUTPUT_LOOKED_AT, _UNLIKE = 2.0, 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SpectralFit:
    """Posterior and how well it was drawn: effective sample size of the last round, chi-square at the best point.

    Where data contradict the model, draws are as `_with_data_in_error` says, and chi-square is of the data as they are.

    discrepancy: median and 95 % interval of the learned relative sd of a level and of a gain beyond the parameters. output: the
    tube's over the model's, where it is so far from 1 that labels must be wrong and nothing else was learnt from it; None elsewhere.
    """

    posterior: SpectralPosterior
    effective_draws: float
    chi_square: float
    data: int
    discrepancy: Mapping[str, tuple[float, float, float]]
    output: float | None = None


def contradicts(fit: SpectralFit) -> bool:
    """Whether the data lie farther from the best point than their noise allows, by four standard deviations of chi-square."""
    return _too_far(fit.chi_square, fit.data)


def _too_far(chi_square: float, data: int) -> bool:
    return chi_square > _farthest(data)


def _farthest(data: int) -> float:
    """Largest plausible chi-square of so many data."""
    return data + 4 * math.sqrt(2 * data)


def unlike_output(fit: SpectralFit) -> list[str]:
    """A warning where the tube's output cannot be what the labels say; else none."""
    if fit.output is None:
        return []
    return [
        f"output is {fit.output:.3g} times what a tube gives at the stated loads, distances and pixel pitch: check their values and"
        " units (ms, mA, mm, uGy); the spectrum was found without it"
    ]


def fit_evidence(fit: SpectralFit) -> dict[str, Any]:
    """What a twin keeps of its fit, in plain numbers."""
    return {
        "chi_square": fit.chi_square,
        "data": fit.data,
        "effective_draws": fit.effective_draws,
        "undetermined": list(fit.posterior.undetermined),
        "discrepancy": {name: list(values) for name, values in fit.discrepancy.items()},
        "prior": dict(fit.posterior.prior),
    }


def wedges_depart(fit: SpectralFit) -> bool:
    """Whether a wedge is thicker or thinner than stated by `_WEDGE_DEPARTS` standard deviations of what data that agree would find.

    Data that agree with a prior move a mean by a Gaussian of the variance that they take from it; draws add theirs.
    """
    posterior = fit.posterior
    for name in (name for name in posterior.names if name.startswith(WEDGE)):
        draws = posterior.column(name)
        taken = max(WEDGE_THICKNESS.sd**2 - float(np.var(draws)), 0.0)
        usual = math.sqrt(taken + WEDGE_THICKNESS.sd**2 / fit.effective_draws)
        if abs(float(np.mean(draws))) > _WEDGE_DEPARTS * usual:
            return True
    return False


def fit_spectrum(
    levels: Sequence[Level],
    instrument: Instrument,
    *,
    rng: np.random.Generator,
    transmissions: Sequence[Transmission] = (),
    level_discrepancy: float | None = None,
    gain_discrepancy: float | None = None,
    spectra: Sequence[Spectrum] = (),
    correction: SpectrumCorrection | None = None,
    model_name: str = "casim",
    noise: NoiseModel | None = None,
    repeats: Sequence[Mapping[str, Any]] = (),
    kermas: Sequence[KermaReading] = (),
    ratios: Sequence[KermaRatio] = (),
    dark_changes: Sequence[float] = (),
) -> SpectralFit:
    """Posterior of the spectral parameters from measured levels, gains, transmissions and dosimeter readings.

    Args:
        levels: measured levels; those without kV are left out.
        instrument: what the owner declares; the rest takes the defaults (W, 12 degrees, no filtration).
        rng: source of randomness.
        transmissions: of known layers (step wedges); scales cancel in them.
        level_discrepancy, gain_discrepancy: relative standard deviation of a level and of a gain beyond the model; None:
            learned, with the prior of `priors`.
        spectra: measured ones, in place of the tube model at their voltages; between and beyond them the model's own
            dependence on kV is kept (`SpectrumCorrection`).
        correction: the same, where it is known already.
        model_name: SpekPy's physics model.
        noise: the detector's spread, which says how much of the levels' slopes is white; None: their ratio to the gain is
            taken as the same in all beams.
        repeats: settings measured more than once (`repeated_settings` of the evidence): how far their levels scatter
            beyond sampling tells how well the line repeats itself.
        kermas, ratios: what dosimeters say; they calibrate the tube without any level, too.
        dark_changes: by how much a dark current of one standard deviation makes each of `levels` too high, relative, and its
            gain too low; none: the darks tell it.

    Raises:
        FitError: no level with a kV and no dosimeter reading, or the posterior cannot be sampled.
    """
    known = [level for level in levels if level.kV is not None]
    dark = [change for level, change in zip(levels, dark_changes, strict=False) if level.kV is not None]
    if not known and not kermas and not ratios:
        raise FitError("no flat series states its kV, so nothing can be said of the spectrum")
    if spectra:
        correction = correction_from_spectra(spectra, instrument, model_name=model_name)
    if not any(dark):
        dark = []
    model, priors = _model_and_priors(
        known,
        instrument,
        transmissions=transmissions,
        kermas=kermas,
        ratios=ratios,
        correction=correction,
        model_name=model_name,
        noise=noise,
        dark=bool(dark),
    )
    beams: dict[OpenBeam, int] = {}
    centre = np.array([[priors[name].centre for name in model.names]])
    data = [
        *level_data(known, instrument, noise, beams, dark=dark or [0.0] * len(known)),
        *transmission_data(transmissions, model, centre, beams),
        *dosimeter_data(kermas, ratios, beams),
    ]
    fixed = {"level": level_discrepancy, "gain": gain_discrepancy}

    def posterior_of(with_priors: dict[str, Prior], data: Sequence[Datum]) -> Posterior:
        return Posterior(model, with_priors, tuple(beams), data, fixed, repeated_levels(repeats))

    posterior = posterior_of(priors, data)
    found = posterior.sample(rng)
    free = priors | {_OUTPUT: UNLIKE_OUTPUT}
    unlike = _with_unlike_output(lambda: posterior_of(free, data), model.names, priors, found, rng)
    output = None
    if unlike is not None:
        posterior, found, output = unlike
        priors = free
    chi_square = posterior.chi_square(found.best)
    best, samples, effective = found.best, found.samples, found.effective
    if _too_far(chi_square, len(data)):
        # what single levels stray by is known from the data as they are
        best, samples, effective = _with_data_in_error(
            lambda changed: posterior_of(priors, changed), posterior, best, rng
        )
    measured = [(level.kV or 0.0, level.filters) for level in known]
    if not known:
        measured = [(item.kV, item.filters) for item in kermas] + [(item.kV, item.filters) for item in ratios]
    own = {name: _sd_of_mixture(draws) for name, draws in found.discrepancies.items()}
    return SpectralFit(
        posterior=SpectralPosterior(
            names=model.names,
            samples=samples,
            best=best,
            prior={name: str(prior) for name, prior in priors.items()},
            undetermined=_undetermined(model.names, samples, priors),
            anode=model.anode,
            anode_angle_deg=model.anode_angle_deg,
            model=model.model,
            inherent=model.inherent,
            scintillator=model.scintillator,
            alternative=model.alternative,
            correction=correction,
            cover=model.cover,
            counting=model.counting,
            level_discrepancy=own.get("level", LEVEL_DISCREPANCY),
            gain_discrepancy=own.get("gain", GAIN_DISCREPANCY),
            kerma_discrepancy=own.get("kerma"),
            secondary_DN=model.secondary_DN,
            calibrated_kV=(min(kV for kV, _ in measured), max(kV for kV, _ in measured)),
            calibrated_filters=tuple(sorted({text_from_filters(filters) for _, filters in measured})),
        ),
        effective_draws=effective,
        chi_square=chi_square,
        data=len(data),
        discrepancy={
            name: tuple(float(value) for value in np.quantile(draws, [0.5, 0.025, 0.975]))  # type: ignore[misc]
            for name, draws in found.discrepancies.items()
        },
        output=output,
    )


def _model_and_priors(
    known: Sequence[Level],
    instrument: Instrument,
    *,
    transmissions: Sequence[Transmission],
    kermas: Sequence[KermaReading],
    ratios: Sequence[KermaRatio],
    correction: SpectrumCorrection | None,
    model_name: str,
    noise: NoiseModel | None,
    dark: bool,
) -> tuple[SpectralModel, dict[str, Prior]]:
    """The model with a parameter for all that the data leave open, and the priors of these.

    Args:
        known: levels with a kV.
        instrument, transmissions, kermas, ratios, correction, model_name, noise: as of `fit_spectrum`.
        dark: the darks leave a dark current open.
    """
    beams = [(level.kV or 0.0, level.filters) for level in known]
    beams += [(item.kV, (*item.filters, *item.layers)) for item in transmissions]
    beams += [(item.kV, item.filters) for item in kermas]
    beams += [(item.kV, (*item.filters, *item.layers)) for item in ratios]
    model = model_for(
        instrument,
        materials=[layer.material for _, layers in beams for layer in layers],
        highest_kV=max(kV for kV, _ in beams),
        model_name=model_name,
        correction=correction,
        more_names=dose_parameters(kermas, ratios, with_flats=bool(known)),
        # a counter's white noise is of counts, not of light
        secondary_DN=0.0 if noise is None or instrument.counting else secondary_of_levels(known, noise) or 0.0,
    )
    priors = priors_for(
        model,
        scintillator_declared=instrument.scintillator is not None,
        threshold_keV=instrument.threshold_keV,
        geometry_declared=not known
        or (instrument.pixel_mm is not None and all(level.source_detector_mm for level in known)),
    )
    if model.counting:
        priors |= counter_priors(known)
    if (kermas or ratios) and correction is None:
        priors["inherent_filtration_mm_Al"] = DOSE_FILTRATION
    absorbers = absorber_priors(model, np.array([priors[name].centre for name in model.names]), ratios)
    added = {wedge_thickness_name(item.wedge): WEDGE_THICKNESS for item in transmissions}
    added |= {DARK_CURRENT: DARK_CURRENT_PRIOR} if dark else {}
    for more in (absorbers, added):
        if more:
            model, priors = model.with_parameters(tuple(more)), priors | more
    return model, priors


def _with_unlike_output(
    freed: Callable[[], Posterior],
    names: Sequence[str],
    priors: Mapping[str, Prior],
    found: Sampled,
    rng: np.random.Generator,
) -> tuple[Posterior, Sampled, float] | None:
    """Posterior, draws and output over the model's where labels must be wrong: what is left agrees once any output is allowed.

    Believed, a slip of units would be made up for by the spectrum. None: nothing says so.

    Args:
        freed: the posterior with any output.
        names: of the parameters.
        priors, found: the priors that believe the output, and draws with these.
        rng: source of randomness.
    """
    place, believed = list(names).index(_OUTPUT), priors[_OUTPUT]
    if believed is not PRIORS[_OUTPUT] or abs(found.best[place]) <= _OUTPUT_LOOKED_AT * believed.sd:
        return None
    posterior = freed()
    other = posterior.sample(rng)
    logarithm = other.samples[:, place]
    away = abs(float(np.mean(logarithm))) / math.hypot(float(np.std(logarithm)), believed.sd)
    # a slip of the output alone leaves data that agree
    if away <= _UNLIKE or _too_far(posterior.chi_square(other.best), len(posterior.data)):
        return None
    return posterior, other, math.exp(float(np.median(logarithm)))


def _with_data_in_error(
    posterior_of: Callable[[Sequence[Datum]], Posterior],
    contradicting: Posterior,
    best: NDArray[np.float64],
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Best set, draws (draw, parameter) and effective draws where data contradict the model.

    Where data and priors agree without one measurement, that one may be wrong: draws are of the fits without each such one, in
    equal shares, for nothing says which it is. Where it takes more than one, or there are only two, all data err by the Birge
    ratio more.

    Args:
        posterior_of: the posterior of changed data.
        contradicting, best: the posterior of the data as they are, and its best set (parameter,).
        rng: source of randomness.
    """
    measurements = sorted({item.of for item in contradicting.data})
    fits = []
    for one in measurements if len(measurements) > 2 else ():
        data = [replace(item, sd=_SAYS_NOTHING) if item.of == one else item for item in contradicting.data]
        farthest = _farthest(sum(item.of != one for item in data))
        posterior = posterior_of(data)
        try:
            found = posterior.sample(rng, farthest=farthest)
        except FitError:
            continue
        if (squares := posterior.squares_with_priors(found.best)) <= farthest:
            fits.append((squares, found))
    if fits:
        share = -(-len(fits[0][1].samples) // len(fits))
        return (
            min(fits, key=lambda fit: fit[0])[1].best,
            np.concatenate([found.samples[:share] for _, found in fits]),
            sum(found.effective for _, found in fits) / len(fits),
        )
    in_error = contradicting
    for _ in range(_MOST_ROUNDS):
        in_error = posterior_of(in_error.data_in_error(in_error.birge_ratio(best)))
        found = in_error.sample(rng)
        best = found.best
        if in_error.birge_ratio(best) <= 1.0:
            break
    return best, found.samples, found.effective


def _sd_of_mixture(sizes: NDArray[np.float64]) -> float:
    """Standard deviation of the Gaussian whose 95 % interval is that of Gaussians of these equally likely `sizes` (draw,)."""
    from scipy.special import ndtr

    low, high = float(sizes.min()), float(sizes.max())
    for _ in range(60):
        middle = 0.5 * (low + high)
        if np.mean(ndtr(-Z95 * middle / sizes)) > 0.025:
            low = middle
        else:
            high = middle
    return high


def _undetermined(names: Sequence[str], samples: NDArray[np.float64], priors: dict[str, Prior]) -> tuple[str, ...]:
    """Parameters whose spread is still more than 0.7 of the prior's: the data say nothing of them alone."""
    own = [
        name
        for name in names
        if name
        in {*SHAPE_PARAMETERS, "log_output", "log_DN_per_keV", "log_swank", "yield_exponent", "hardness_exponent"}
        or name.startswith(attenuation_scale_name(""))
    ]
    result = []
    for name in own:
        if name == "log_DN_per_keV":
            continue
        share = float(np.std(samples[:, names.index(name)])) / spread_of(priors[name])
        if share > 0.7:
            result.append(f"{name}: {100 * min(share, 1.0):.0f} % of the prior's width is left")
    columns = samples[:, [names.index(name) for name in own]]
    varies = np.std(columns, axis=0) > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.asarray(np.corrcoef(columns.T)).reshape(len(own), len(own))
    for i in range(len(own)):
        for j in range(i):
            if varies[i] and varies[j] and abs(correlation[i, j]) > 0.9:
                result.append(f"{own[j]} and {own[i]} are known only together (correlation {correlation[i, j]:+.2f})")
    return tuple(result)
