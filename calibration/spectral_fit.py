"""The spectral part of a twin: tube, filtration, scintillator and gain from levels, gains and transmissions.

Only ratios between levels say anything of the spectrum, and flats alone leave much open; so the answer is a posterior.
Filtration, scintillator thickness, tube voltage, K escape and the sizes of discrepancies are drawn by importance sampling. All
else (scales, tables, exponents, light, covers) acts on the logarithm of a level nearly linearly: for each draw it is
integrated out about that draw's own derivatives, taken where the data put these parameters, and drawn back so that the levels
are met by the model itself and not by its derivatives.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.instrument import Instrument
from ..acquisition.setting import Filter, text_from_filters
from ..errors import FitError, InputError
from ..generator.line.spectral_signal import (
    ALTERNATIVE_SCINTILLATOR,
    KERMA_OUTPUT,
    OTHER_TABLES,
    SHARED_CHARGE,
    THRESHOLD,
    OpenBeam,
    SpectralModel,
    SpectrumCorrection,
    absorber_of_parameter,
    attenuation_scale_name,
)
from ..generator.line.twin import Level, NoiseModel, SpectralPosterior
from ..generator.line.twin_spectrum import secondary_of_levels, slope_over_gain
from ..spectra import BIN_WIDTH_KEV, Spectrum
from .dose_data import (
    DOSE_FILTRATION,
    DOSE_PRIORS,
    DOSIMETER_CALIBRATION,
    DOSIMETER_HARDNESS,
    FREE_KERMA_OUTPUT,
    KERMA_DISCREPANCY,
    RATIO_DISCREPANCY,
    KermaRatio,
    KermaReading,
    absorber_priors,
    dose_parameters,
)
from .priors import (
    ATTENUATION_SCALE,
    COUNT_SD,
    COUNTED_MORE_SHARE,
    COUNTING_SWANK,
    DARK_CURRENT,
    DARK_CURRENT_PRIOR,
    FREE_OUTPUT,
    GADOLINIUM_SHARE,
    GAIN_DISCREPANCY,
    LEVEL_DISCREPANCY,
    LOG_DISCREPANCY_SD,
    MEASURED_SPECTRUM,
    NONE_OR_SOME,
    PRIORS,
    SHARED_OVER_EXCESS,
    SHARED_OVER_EXCESS_SD,
    SHARES_CORRELATION,
    TABLE_SHARE,
    THRESHOLD_SD_KEV,
    UNDECLARED_SCINTILLATOR,
    UNDECLARED_THRESHOLD,
    UNLIKE_OUTPUT,
    WEDGE_THICKNESS,
    Prior,
    ripple_from_latent,
    spread_of,
)

_ROUND_DRAWS = 1024
_FINAL_DRAWS = 2048
_ROUNDS = 12
_FARTHEST = 6.0  # prior standard deviations at which derivatives are taken: Gaussian, one parameter in 5e8 lies beyond
_KEPT = 512
_LEAST_EFFECTIVE = 200.0  # draws that must count, or walkers go on
_WALKERS = 1024
_STEP_EFFECTIVE = 0.5  # share of the walkers that must count as the likelihood's power rises
_SWEEPS, _MOST_SWEEPS = 5, 80  # at a power, and at the whole likelihood
_MOST_POWERS = 100
_FORGOTTEN = 0.3  # correlation with where they were: from there on walkers are draws of their own
_ENOUGH = 600.0  # effective draws; the linear parameters are drawn anew for each of those kept
_BELOW_END = 0.85  # of kV in keV: up to here a measured spectrum corrects the model
_SAYS_NOTHING = 30.0  # sd of the logarithm of a datum that is left out
_MOST_ROUNDS = 6  # of fits to data that contradict the model, their errors larger each time
_WIDEST_SIZE = 4.0  # prior standard deviations of the logarithm of a discrepancy's size
_STUDENT_DEGREES = 5.0
_MIXTURE = (0.75, 0.2, 0.05)
_Z95 = 1.959964
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
DEFAULT_SCINTILLATOR = (Filter(material="CsI", thickness_mm=0.5),)
OTHER_SCINTILLATOR = (Filter(material="Gd2O2S@7.32", thickness_mm=0.15),)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Transmission:
    """Signal behind known layers over the open signal at one kV and filter, with its relative standard deviation.

    wedge: name of the object, whose thicknesses and density are off alike at all its steps and voltages.
    """

    kV: float
    filters: tuple[Filter, ...]
    layers: tuple[Filter, ...]
    value: float
    relative_sd: float
    series: str = ""
    wedge: str = ""


@dataclass(frozen=True, slots=True)
class _Datum:
    kind: str  # of `_DISCREPANCY_OF`
    beam: int
    over: int  # beam of the denominator of a ratio
    value: float  # logarithm
    sd: float
    of: tuple[str, int]  # measurement: a level gives its rate and its gain
    moves: tuple[
        tuple[str, float], ...
    ] = ()  # parameters that no beam has, and by how much a unit of each moves the value


# kind of a datum -> whose learned size is its own departure from the model; the sizes' medians
_DISCREPANCY_OF = {
    "rate": "level",
    "gain": "gain",
    "transmission": "level",
    "kerma": "kerma",
    "kerma_ratio": "ratio",
    "signal_ratio": "ratio",
}
_DISCREPANCIES = {
    "level": LEVEL_DISCREPANCY,
    "gain": GAIN_DISCREPANCY,
    "kerma": KERMA_DISCREPANCY,
    "ratio": RATIO_DISCREPANCY,
}
_OUTPUT = "log_output"
_WEDGE = "wedge_log_thickness:"
_WEDGE_DEPARTS = 2.5  # standard deviations: one wedge in 80 departs so far
_THICKER = 0.01  # relative, of the derivative by a wedge's thickness
# standard deviations of the prior from which on the output is looked at, and of prior and data from which on it is not believed:
# Gaussian, 3 in 1000 lines with right labels have it
_OUTPUT_LOOKED_AT, _UNLIKE = 2.0, 3.0
_Sampled = tuple[NDArray[np.float64], NDArray[np.float64], dict[str, NDArray[np.float64]], float]
_OF_DETECTOR = ("rate", "gain", "transmission", "signal_ratio")


def geometry_factor(*, source_detector_mm: float | None, pixel_mm: float | None) -> float:
    """Photons on a pixel over those on 1 mm2 at 1 m: (1000 / d)^2 a^2; what is unknown counts as 1 m, 1 mm."""
    distance = 1000.0 if source_detector_mm is None else source_detector_mm
    pitch = 1.0 if pixel_mm is None else pixel_mm
    return (1000.0 / distance) ** 2 * pitch**2


def priors_for(
    model: SpectralModel,
    *,
    scintillator_declared: bool,
    geometry_declared: bool = True,
    threshold_keV: float | None = None,
) -> dict[str, Prior]:
    """The priors of a model's parameters, in the order of its names; threshold_keV: that a counter's owner declares."""
    result = {}
    for name in model.names:
        if name == "log_scintillator_thickness" and not scintillator_declared:
            result[name] = UNDECLARED_SCINTILLATOR
        elif name in MEASURED_SPECTRUM and model.correction is not None:
            result[name] = MEASURED_SPECTRUM[name]
        elif name == "log_output" and (
            not geometry_declared or (model.correction is not None and model.correction.relative)
        ):
            result[name] = FREE_OUTPUT
        elif name == "log_swank" and model.counting:
            result[name] = COUNTING_SWANK
        elif name == THRESHOLD and threshold_keV is not None:
            result[name] = replace(
                UNDECLARED_THRESHOLD,
                centre=threshold_keV,
                sd=THRESHOLD_SD_KEV,
                reason="threshold of the counter, as declared",
            )
        elif name == THRESHOLD:
            result[name] = UNDECLARED_THRESHOLD
        elif name == ALTERNATIVE_SCINTILLATOR:
            share = GADOLINIUM_SHARE
            result[name] = Prior(
                centre=share, sd=math.sqrt(share * (1.0 - share)), reason="0 is CsI, 1 Gd2O2S: not declared"
            )
        elif name in PRIORS:
            result[name] = PRIORS[name]
        elif name == KERMA_OUTPUT and not geometry_declared:
            result[name] = FREE_KERMA_OUTPUT
        elif name in DOSE_PRIORS:
            result[name] = DOSE_PRIORS[name]
        elif any(name.startswith(f"{table}_") for table in OTHER_TABLES):
            result[name] = TABLE_SHARE
        else:
            result[name] = ATTENUATION_SCALE
    return result


def counter_priors(levels: Sequence[Level]) -> dict[str, Prior]:
    """What slopes and gains of a counter's levels say of the DN of a count and of the charge that neighbours share.

    A pixel counts a photon once or not at all, so that its counts have the variance of their mean: the slope is the DN of a count.
    Counts of a photon that neighbours share add to noise summed over them, which the gain is of. How many photons count more
    than twice is not known. Nothing where no level has both.
    """
    known = [level for level in levels if level.photon_transfer_slope_DN.value > 0 and level.gain_DN.value > 0]
    if not known:
        return {}
    slopes = [level.photon_transfer_slope_DN for level in known]
    excess = max(
        float(np.mean([math.log(one.gain_DN.value / one.photon_transfer_slope_DN.value) for one in known])), 0.0
    )
    excess_sd = float(np.mean([_relative_sd(level.gain_DN) for level in known]))  # of the spread, the same in all
    logarithm = np.log([slope.value for slope in slopes])
    weight = np.array([max(_relative_sd(slope), 1e-6) ** -2.0 for slope in slopes])
    centre = float(weight @ logarithm / weight.sum())
    misfit = float(weight @ (logarithm - centre) ** 2) / max(len(slopes) - 1, 1)
    sd = math.hypot(COUNT_SD, COUNTED_MORE_SHARE * excess, math.sqrt(max(misfit, 1.0) / float(weight.sum())))
    generic = PRIORS[SHARED_CHARGE]
    return {
        "log_DN_per_keV": Prior(centre=centre, sd=sd, reason="DN of a count: variance of a pixel over its mean"),
        SHARED_CHARGE: replace(
            generic,
            centre=min(SHARED_OVER_EXCESS * excess, generic.high),
            sd=min(math.hypot(COUNT_SD, SHARED_OVER_EXCESS * excess_sd, SHARED_OVER_EXCESS_SD * excess), generic.sd),
            reason="share of photons whose charge two pixels share: from gain over slope",
        ),
    }


def model_for(
    instrument: Instrument,
    *,
    materials: Sequence[str],
    highest_kV: float,
    model_name: str = "casim",
    correction: SpectrumCorrection | None = None,
    more_names: Sequence[str] = (),
    secondary_DN: float = 0.0,
) -> SpectralModel:
    """The spectral model of a declared instrument; what it leaves open takes the defaults (W, 12 degrees).

    Without a declared scintillator CsI and Gd2O2S are both weighed (for a counting detector only CsI, as a stand-in).
    """
    undeclared = instrument.scintillator is None and not instrument.counting
    result = SpectralModel(
        anode=instrument.anode or "W",
        anode_angle_deg=instrument.anode_angle_deg or 12.0,
        model=model_name,
        inherent=instrument.inherent_filtration or (),
        scintillator=instrument.scintillator or DEFAULT_SCINTILLATOR,
        alternative=OTHER_SCINTILLATOR if undeclared else (),
        cover=instrument.detector_cover,
        counting=bool(instrument.counting),
        # the commonest filters carry their uncertainty even where they were not measured
        filter_materials=sorted({*materials, "Al", "Cu"}),
        highest_kV=max(160.0, highest_kV),
        correction=correction,
        secondary_DN=secondary_DN,
    )
    return result.with_parameters(more_names) if more_names else result


def correction_from_spectra(
    spectra: Sequence[Spectrum], instrument: Instrument, *, model_name: str = "casim"
) -> SpectrumCorrection:
    """Measured spectra over the model's behind the declared layers, smoothed over 1 keV (no unit).

    Energies at which the measured spectrum holds less than a thousandth of its highest bin, and those above 0.85 kV, take
    the nearest value. A spectrum without absolute scale is brought to the model's by its photons.

    Raises:
        InputError: a spectrum without tube voltage, or two at one.
    """
    from scipy.ndimage import gaussian_filter1d

    if any(item.kV is None for item in spectra) or len({item.kV for item in spectra}) < len(spectra):
        raise InputError(
            "--spectrum",
            received=", ".join("no kV" if item.kV is None else f"{item.kV:g} kV" for item in spectra),
            expected="each spectrum with a tube voltage of its own",
            remedy="write FILE:kV",
        )
    ordered = sorted(spectra, key=lambda item: item.kV or 0.0)
    model = model_for(
        instrument, materials=(), highest_kV=max(item.kV or 0.0 for item in spectra), model_name=model_name
    )
    rows = []
    for item in ordered:
        kV = item.kV or 0.0
        expected = model.weights(model.default_parameters()[None, :], OpenBeam(kV=kV, filters=()))[0]
        bins = min(expected.size, item.fluence.size)
        measured = np.zeros(expected.size)
        measured[:bins] = item.fluence[:bins] * BIN_WIDTH_KEV / 100.0
        smooth = gaussian_filter1d(measured, 2.0, mode="constant")
        ours = gaussian_filter1d(expected, 2.0, mode="constant")
        seen = (smooth > 1e-3 * smooth.max()) & (ours > 1e-3 * ours.max())
        # the end point moves with the voltage, which has a parameter of its own
        seen &= model.energies_keV[: expected.size] < _BELOW_END * kV
        if not seen.any():
            raise InputError(
                "--spectrum", received=f"a spectrum that shares no energies with {kV:g} kV", expected="the tube's own"
            )
        logarithm = np.log(smooth[seen] / ours[seen])
        if not item.absolute:
            logarithm -= math.log(float(smooth[seen].sum() / ours[seen].sum()))
        full = np.interp(model.energies_keV, model.energies_keV[: expected.size][seen], logarithm)
        rows.append(full)
    return SpectrumCorrection(
        kV=tuple(item.kV or 0.0 for item in ordered),
        log_ratio=np.array(rows),
        relative=not all(item.absolute for item in ordered),
    )


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
    layers = [layer for level in known for layer in level.filters]
    layers += [layer for item in transmissions for layer in (*item.filters, *item.layers)]
    layers += [layer for ratio in ratios for layer in (*ratio.filters, *ratio.layers)]
    layers += [layer for reading in kermas for layer in reading.filters]
    read = [(item.kV, item.filters) for item in kermas] + [(item.kV, item.filters) for item in ratios]
    model = model_for(
        instrument,
        materials=[layer.material for layer in layers],
        highest_kV=max(
            [level.kV or 0.0 for level in known] + [item.kV for item in transmissions] + [kV for kV, _ in read]
        ),
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
    if absorbers:
        model, priors = model.with_parameters(tuple(absorbers)), priors | absorbers
    added = {wedge_thickness_name(item.wedge): WEDGE_THICKNESS for item in transmissions}
    added |= {DARK_CURRENT: DARK_CURRENT_PRIOR} if any(dark) else {}
    if added:
        model, priors = model.with_parameters(tuple(added)), priors | added
    beams: dict[OpenBeam, int] = {}
    centre = np.array([[priors[name].centre for name in model.names]])
    data = [
        *_level_data(known, instrument, noise, beams, dark=dark if any(dark) else [0.0] * len(known)),
        *_transmission_data(transmissions, model, centre, beams),
        *_dose_data(kermas, ratios, beams),
    ]
    fixed = {"level": level_discrepancy, "gain": gain_discrepancy}

    def posterior_of(with_priors: dict[str, Prior], data: Sequence[_Datum]) -> _Posterior:
        return _Posterior(model, with_priors, tuple(beams), data, fixed, _repeated_levels(repeats))

    posterior = posterior_of(priors, data)
    best, samples, discrepancies, effective = posterior.sample(rng)
    output = None
    place, believed = model.names.index(_OUTPUT), priors[_OUTPUT]
    if believed is PRIORS[_OUTPUT] and abs(best[place]) > _OUTPUT_LOOKED_AT * believed.sd:
        # believed, a slip of units would be made up for by the spectrum
        other = posterior_of(priors | {_OUTPUT: UNLIKE_OUTPUT}, data)
        found = other.sample(rng)
        logarithm = found[1][:, place]
        away = abs(float(np.mean(logarithm))) / math.hypot(float(np.std(logarithm)), believed.sd)
        # a slip of the output alone leaves data that agree
        if away > _UNLIKE and not _too_far(other.chi_square(found[0]), len(data)):
            posterior, (best, samples, discrepancies, effective) = other, found
            output, priors = math.exp(float(np.median(logarithm))), priors | {_OUTPUT: UNLIKE_OUTPUT}
    chi_square = posterior.chi_square(best)
    if _too_far(chi_square, len(data)):
        # what single levels stray by is known from the data as they are
        best, samples, effective = _with_data_in_error(
            lambda changed: posterior_of(priors, changed), posterior, best, rng
        )
    names = model.names
    voltages = [level.kV or 0.0 for level in known] or [kV for kV, _ in read]
    measured = [level.filters for level in known] or [filters for _, filters in read]
    own = {name: _sd_of_mixture(draws) for name, draws in discrepancies.items()}
    return SpectralFit(
        posterior=SpectralPosterior(
            names=names,
            samples=samples,
            best=best,
            prior={name: str(prior) for name, prior in priors.items()},
            undetermined=_undetermined(names, samples, priors),
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
            calibrated_kV=(min(voltages), max(voltages)),
            calibrated_filters=tuple(sorted({text_from_filters(filters) for filters in measured})),
        ),
        effective_draws=effective,
        chi_square=chi_square,
        data=len(data),
        discrepancy={
            name: tuple(float(value) for value in np.quantile(draws, [0.5, 0.025, 0.975]))  # type: ignore[misc]
            for name, draws in discrepancies.items()
        },
        output=output,
    )


def _with_data_in_error(
    posterior_of: "Callable[[Sequence[_Datum]], _Posterior]",
    contradicting: "_Posterior",
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
    """
    measurements = sorted({item.of for item in contradicting.data})
    fits = []
    for one in measurements if len(measurements) > 2 else ():
        data = [replace(item, sd=_SAYS_NOTHING) if item.of == one else item for item in contradicting.data]
        farthest = _farthest(sum(item.of != one for item in data))
        posterior = posterior_of(data)
        try:
            found, samples, _, effective = posterior.sample(rng, farthest=farthest)
        except FitError:
            continue
        if (squares := posterior.squares_with_priors(found)) <= farthest:
            fits.append((squares, found, samples, effective))
    if fits:
        share = -(-len(fits[0][2]) // len(fits))
        return (
            min(fits, key=lambda fit: fit[0])[1],
            np.concatenate([samples[:share] for _, _, samples, _ in fits]),
            sum(effective for *_, effective in fits) / len(fits),
        )
    in_error = contradicting
    for _ in range(_MOST_ROUNDS):
        in_error = posterior_of(in_error.data_in_error(in_error.birge_ratio(best)))
        best, samples, _, effective = in_error.sample(rng)
        if in_error.birge_ratio(best) <= 1.0:
            break
    return best, samples, effective


def _shares(levels: Sequence[Level], noise: NoiseModel | None) -> list[float]:
    """Photon-transfer slope over gain of each level, from all of them together."""
    gains = np.array([max(level.gain_DN.value, 1e-300) for level in levels])
    if noise is not None:
        # of the levels' own gains the mean is well known, and the ratio of one to another nearly enough
        found = slope_over_gain(levels, noise, gains)
        if found is not None:
            return [float(value) for value in found]
    known = [level for level in levels if level.photon_transfer_slope_DN.value > 0 and level.gain_DN.value > 0]
    ratios = [math.log(level.photon_transfer_slope_DN.value / level.gain_DN.value) for level in known]
    return [math.exp(float(np.mean(ratios)))] * len(levels)


def wedge_thickness_name(wedge: str) -> str:
    """Name of the parameter that scales the thicknesses of a wedge."""
    return f"{_WEDGE}{wedge}"


def wedges_depart(fit: SpectralFit) -> bool:
    """Whether a wedge is thicker or thinner than stated by `_WEDGE_DEPARTS` standard deviations of what data that agree would find.

    Data that agree with a prior move a mean by a Gaussian of the variance that they take from it; draws add theirs.
    """
    posterior = fit.posterior
    for name in (name for name in posterior.names if name.startswith(_WEDGE)):
        draws = posterior.column(name)
        taken = max(WEDGE_THICKNESS.sd**2 - float(np.var(draws)), 0.0)
        usual = math.sqrt(taken + WEDGE_THICKNESS.sd**2 / fit.effective_draws)
        if abs(float(np.mean(draws))) > _WEDGE_DEPARTS * usual:
            return True
    return False


def _level_data(
    levels: Sequence[Level],
    instrument: Instrument,
    noise: NoiseModel | None,
    beams: dict[OpenBeam, int],
    *,
    dark: Sequence[float],
) -> list[_Datum]:
    # A gain also wants the spread, by which all of them are off alike: slopes over one ratio carry the gains' dependence on
    # the spectrum, and what the ratio is known less by is added to predictions, where no average over beams lowers it.
    sloped = [level for level in levels if level.photon_transfer_slope_DN.value > 0 and level.gain_DN.value > 0]
    share = dict(zip(map(id, levels), _shares(levels, noise), strict=True)) if sloped else {}
    data = []
    for place, level in enumerate(levels):
        open_beam = OpenBeam(kV=level.kV or 0.0, filters=level.filters)
        beam, rate = beams.setdefault(open_beam, len(beams)), level.rate_DN_per_mAs
        too_high, too_low = (((DARK_CURRENT, sign * dark[place]),) if dark[place] else () for sign in (1.0, -1.0))
        if rate is not None and rate.value > 0:
            factor = geometry_factor(source_detector_mm=level.source_detector_mm, pixel_mm=instrument.pixel_mm)
            data.append(
                _Datum("rate", beam, -1, math.log(rate.value / factor), _relative_sd(rate), ("level", place), too_high)
            )
        gain = level.photon_transfer_slope_DN if share else level.gain_DN
        value = gain.value / share.get(id(level), 1.0)
        data.append(
            _Datum("gain", beam, -1, math.log(max(value, 1e-12)), _relative_sd(gain), ("level", place), too_low)
        )
    return data


def _transmission_data(
    transmissions: Sequence[Transmission],
    model: SpectralModel,
    centre: NDArray[np.float64],
    beams: dict[OpenBeam, int],
) -> list[_Datum]:
    """centre: parameter set (1, parameter) at which the thickness's derivative is taken."""

    def signal(beam: OpenBeam) -> float:
        return math.log(float(model.signal(centre, beam).rate_DN_per_mAs[0]))

    data = []
    for place, item in enumerate(transmissions):
        thicker = [replace(layer, thickness_mm=math.exp(_THICKER) * layer.thickness_mm) for layer in item.layers]
        open_beam, behind, farther = (
            OpenBeam(kV=item.kV, filters=(*item.filters, *layers)) for layers in ((), item.layers, thicker)
        )
        falls = (signal(farther) - signal(behind)) / _THICKER
        data.append(
            _Datum(
                "transmission",
                beams.setdefault(behind, len(beams)),
                beams.setdefault(open_beam, len(beams)),
                math.log(item.value),
                item.relative_sd,
                ("transmission", place),
                ((wedge_thickness_name(item.wedge), falls),),
            )
        )
    return data


def _dose_data(
    kermas: Sequence[KermaReading], ratios: Sequence[KermaRatio], beams: dict[OpenBeam, int]
) -> list[_Datum]:
    def number(kV: float, filters: tuple[Filter, ...], absorber: str = "") -> int:
        return beams.setdefault(OpenBeam(kV=kV, filters=filters, absorber=absorber), len(beams))

    data = []
    for place, item in enumerate(kermas):
        beam, value = number(item.kV, item.filters), math.log(item.value)
        moves = ((DOSIMETER_CALIBRATION, item.calibration_sd),)
        data.append(_Datum("kerma", beam, -1, value, item.relative_sd, ("kerma", place), moves))
    for place, ratio in enumerate(ratios):
        behind = number(ratio.kV, (*ratio.filters, *ratio.layers), ratio.absorber)
        kind = "signal_ratio" if ratio.of_signal else "kerma_ratio"
        bare, value = number(ratio.kV, ratio.filters), math.log(ratio.value)
        data.append(_Datum(kind, behind, bare, value, ratio.relative_sd, ("ratio", place)))
    return data


def _repeated_levels(repeats: Sequence[Mapping[str, Any]]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Logarithms of the levels of each repeated setting, and their sampling's relative sd (series,) each."""
    found = []
    for row in repeats:
        levels = np.asarray(row.get("mean_signal_DN", ()), dtype=np.float64)
        sampling = 0.01 * np.asarray(row.get("sampling_percent", ()), dtype=np.float64)
        if levels.size > 1 and sampling.shape == levels.shape and np.all(levels > 0) and np.all(sampling > 0):
            found.append((np.log(levels), sampling))
    return found


def _relative_sd(estimate: object) -> float:
    value, low, high = estimate.value, estimate.low, estimate.high  # type: ignore[attr-defined]
    return float((high - low) / (2 * _Z95) / max(abs(value), 1e-300))


class _Posterior:
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
        data: Sequence[_Datum],
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
        self.departing = [_DISCREPANCY_OF[item.kind] for item in data]
        # levels and gains count where there are any flats: even a kind without data then strays as its prior says
        of_flats = not data or any(item.kind in ("rate", "gain") for item in data)
        kinds = {*self.departing, *(("level", "gain") if of_flats else ())}
        self.learned = [name for name in _DISCREPANCIES if name in kinds and self.fixed.get(name) is None]
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
        for name, centre in _DISCREPANCIES.items():
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
        seen = {place for item in self.data if item.kind in _OF_DETECTOR for place in (item.beam, item.over)}
        if not seen:
            return
        deposits = self.model.deposit_tables(parameters)
        found = {
            place: self.model.log_derivatives(parameters, beam, self.linear_names, deposits=deposits)
            for place, beam in enumerate(self.beams)
            if place in seen
        }
        for column, item in enumerate(self.data):
            if item.kind not in _OF_DETECTOR:
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
        kinds = [(column, item) for column, item in enumerate(self.data) if item.kind not in _OF_DETECTOR]
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
        return np.asarray(self.variances(np.full((1, self.dimensions), _Z95))[0])

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

    def data_in_error(self, ratio: float) -> list[_Datum]:
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
        chosen = u[_resampled(weight, _LINEARISED_ABOUT, rng)]
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
        return np.asarray(self.with_linear(self._climb(u)[None, :], None)[0])

    def sample(
        self, rng: np.random.Generator, *, farthest: float = math.inf
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], dict[str, NDArray[np.float64]], float]:
        """Best set (parameter,), equally likely draws (draw, parameter), their discrepancies, effective sample size.

        Importance sampling from the prior to the posterior by way of flattened posteriors (likelihood to the power of
        a rising temper), each proposed from the one before; where its own covariance does not describe the posterior,
        by walkers (`_walked`).

        Raises:
            FitError: no draws were found, or none as near to data and priors (`squares_with_priors`) as `farthest`.
        """
        u = rng.standard_normal((2 * _ROUND_DRAWS, self.dimensions))
        log_ratio = np.zeros(len(u))  # prior over proposal
        temper, effective = 0.0, 0.0
        weight = np.full(len(u), 1.0 / len(u))
        likelihood = self.log_likelihood(u)
        for _ in range(_ROUNDS):
            temper = _next_temper(likelihood, log_ratio, last=temper, least=0.1 * len(u))
            weight, effective = _weights(temper * likelihood + log_ratio)
            if temper >= 1.0 and effective > _ENOUGH:
                break
            self.relinearise(u, weight, rng)
            mean = weight @ u
            spread = u - mean
            covariance = (spread * weight[:, None]).T @ spread
            # few effective draws make a covariance too narrow in some direction
            covariance = covariance * (1.0 + 2.0 * len(mean) / max(effective, 1.0)) + 1e-8 * np.eye(len(mean))
            draws = _FINAL_DRAWS if temper >= 0.3 else _ROUND_DRAWS
            u, log_proposal = _mixture_draws(mean, covariance, draws, rng)
            log_ratio = -0.5 * np.sum(u**2, axis=1) - 0.5 * u.shape[1] * math.log(2 * math.pi) - log_proposal
            likelihood = self.log_likelihood(u)
        else:
            weight, effective = _weights(likelihood + log_ratio)
        if effective < _LEAST_EFFECTIVE:
            # walking takes long
            nearest = u[
                int(np.argmax(np.where(np.isfinite(likelihood), likelihood - 0.5 * np.sum(u**2, axis=1), -np.inf)))
            ]
            if self.squares_with_priors(self._best_from(nearest)) > farthest:
                raise FitError("the levels contradict each other or the declared instrument")
            u, likelihood, effective = self._walked(u, likelihood, log_ratio, rng)
            weight = np.full(len(u), 1.0 / len(u))
        if effective < _LEAST_EFFECTIVE:
            raise FitError(
                f"the posterior of the spectrum could not be drawn (effective sample size {effective:.0f});"
                " the levels contradict each other or the declared instrument"
            )
        chosen = _resampled(weight, _KEPT, rng)
        with np.errstate(invalid="ignore"):
            density = likelihood - 0.5 * np.sum(u**2, axis=1)
        kept = u[chosen]
        return (
            self._best_from(u[int(np.argmax(density))]),
            self.with_linear(kept, rng),
            self.discrepancies(kept),
            effective,
        )

    def _walked(
        self,
        u: NDArray[np.float64],
        likelihood: NDArray[np.float64],
        log_ratio: NDArray[np.float64],
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Walkers (walker, dimension) drawn from the posterior, their log likelihood, and how many independent draws they are worth.

        Sequential Monte Carlo (Del Moral, Doucet, Jasra 2006, doi:10.1111/j.1467-9868.2006.00553.x): from weighted draws to
        flattened posteriors of rising power, by resampling, and at each by Metropolis steps along differences of other walkers
        (ter Braak 2006, doi:10.1007/s11222-006-8769-1), until they have forgotten where they were.

        Args:
            u, likelihood, log_ratio: draws (draw, dimension), their log likelihood, and log of prior over proposal (draw,).
            rng: source of randomness.
        """
        temper = _next_temper(likelihood, log_ratio, last=0.0, least=_STEP_EFFECTIVE * min(_WALKERS, len(u)))
        weight, _ = _weights(np.where(np.isfinite(likelihood), temper * likelihood + log_ratio, -np.inf))
        chosen = _resampled(weight, _WALKERS, rng)
        u, likelihood = u[chosen], likelihood[chosen]
        for _ in range(_MOST_POWERS):
            before = u
            for sweep in range(_SWEEPS if temper < 1.0 else _MOST_SWEEPS):
                u, likelihood = self._swept(u, likelihood, temper, rng)
                if temper >= 1.0 and sweep % _SWEEPS == _SWEEPS - 1 and _remembered(before, u) < _FORGOTTEN:
                    break
            if temper >= 1.0:
                return u, likelihood, len(u) * (1.0 - _remembered(before, u) ** 2)
            temper, last = _raised(likelihood, temper), temper
            chosen = _resampled(_weights((temper - last) * likelihood)[0], len(u), rng)
            u, likelihood = u[chosen], likelihood[chosen]
        return u, likelihood, 0.0

    def _swept(
        self, u: NDArray[np.float64], likelihood: NDArray[np.float64], temper: float, rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """All walkers after one Metropolis step each: one half along differences of the other half, then the other."""
        u, likelihood = u.copy(), likelihood.copy()
        order = rng.permutation(len(u))
        for moving, still in ((order[::2], order[1::2]), (order[1::2], order[::2])):
            first, second = (u[still[rng.integers(len(still), size=len(moving))]] for _ in range(2))
            # long steps reach other ends of a bent posterior, short ones are taken in narrow ones
            scale = 2.38 / math.sqrt(2.0 * u.shape[1]) * rng.choice([0.1, 0.3, 1.0, 2.0], size=(len(moving), 1))
            proposed = u[moving] + scale * (first - second) + 1e-5 * rng.standard_normal(first.shape)
            there = self.log_likelihood(proposed)
            gain = temper * (there - likelihood[moving]) - 0.5 * np.sum(proposed**2 - u[moving] ** 2, axis=1)
            taken = np.log(rng.random(len(moving))) < gain
            u[moving[taken]], likelihood[moving[taken]] = proposed[taken], there[taken]
        return u, likelihood

    def _climb(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """The most probable shapes (dimension,) near a draw, by Newton's steps on numerical derivatives."""
        size, step = len(start), 0.05
        moving = [i for i in range(size) if i != self.alternative]
        eye = np.eye(size)
        best, u = start, start
        highest = float(self._density(start[None, :])[0])
        for _ in range(4):
            points = [u]
            for i in moving:
                points += [u + step * eye[i], u - step * eye[i]]
            pairs = [(i, j) for n, i in enumerate(moving) for j in moving[:n]]
            points += [u + step * (eye[i] + eye[j]) for i, j in pairs]
            values = self._density(np.array(points))
            if not np.all(np.isfinite(values)):
                break  # at a bound
            gradient, hessian = np.zeros(size), -np.eye(size)
            up, down = values[1 : 2 * len(moving) : 2], values[2 : 2 * len(moving) + 1 : 2]
            for n, i in enumerate(moving):
                gradient[i] = (up[n] - down[n]) / (2 * step)
                hessian[i, i] = min((up[n] - 2 * values[0] + down[n]) / step**2, -0.1)
            place = {i: n for n, i in enumerate(moving)}
            for (i, j), value in zip(pairs, values[2 * len(moving) + 1 :], strict=True):
                mixed = value - up[place[i]] - up[place[j]] + values[0]
                hessian[i, j] = hessian[j, i] = mixed / step**2
            curvature, directions = np.linalg.eigh(hessian)
            move = directions @ ((directions.T @ gradient) / np.maximum(-curvature, 0.3))
            shares = np.array([1.0, 0.5, 0.2])
            tried = self._density(u + shares[:, None] * move)
            winner = int(np.argmax(tried))
            if not tried[winner] > highest + 1e-4:
                break
            highest, u = float(tried[winner]), u + shares[winner] * move
            best = u
        return best

    def _density(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(self.log_likelihood(u) - 0.5 * np.sum(u**2, axis=1))


def _sd_of_mixture(sizes: NDArray[np.float64]) -> float:
    """Standard deviation of the Gaussian whose 95 % interval is that of Gaussians of these equally likely `sizes` (draw,)."""
    from scipy.special import ndtr

    low, high = float(sizes.min()), float(sizes.max())
    for _ in range(60):
        middle = 0.5 * (low + high)
        if np.mean(ndtr(-_Z95 * middle / sizes)) > 0.025:
            low = middle
        else:
            high = middle
    return high


def _weights(logarithms: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Normalised weights (draw,) and how many equal draws they are worth."""
    weight = np.exp(logarithms - np.max(logarithms))
    weight /= weight.sum()
    return weight, 1.0 / float(np.sum(weight**2))


def _resampled(weight: NDArray[np.float64], count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices (count,) of draws of normalised `weight` (draw,), systematically."""
    positions = (np.arange(count) + rng.random()) / count
    return np.minimum(np.searchsorted(np.cumsum(weight), positions), len(weight) - 1)


def _remembered(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """Largest rank correlation, over dimensions, of where walkers (walker, dimension) are with where they were.

    Ranks, so that one walker that stands still far off does not count for all.
    """
    first, second = (np.argsort(np.argsort(at, axis=0), axis=0) - 0.5 * (len(at) - 1) for at in (before, after))
    scale = np.sqrt(np.sum(first**2, axis=0) * np.sum(second**2, axis=0))
    return float(np.max(np.sum(first * second, axis=0) / np.maximum(scale, 1e-300)))


def _next_temper(
    likelihood: NDArray[np.float64], log_ratio: NDArray[np.float64], *, last: float, least: float
) -> float:
    """The largest power (0 to 1) of the likelihood that leaves `least` effective draws, or the one that leaves most."""
    powers = np.geomspace(1.0, max(0.5 * last, 1e-4), 60)
    effective = []
    for power in powers:
        # a draw out of bounds keeps its weight of zero at any power
        effective.append(_weights(np.where(np.isfinite(likelihood), power * likelihood + log_ratio, -np.inf))[1])
        if effective[-1] >= least:
            return float(power)
    return float(powers[int(np.argmax(effective))])


def _raised(likelihood: NDArray[np.float64], last: float) -> float:
    """The largest power (to 1) of the likelihood that leaves enough of the equal draws from its power `last`."""

    def enough(power: float) -> bool:
        return _weights((power - last) * likelihood)[1] >= _STEP_EFFECTIVE * len(likelihood)

    low, high = last, 1.0
    if enough(high):
        return high
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return high


def _mixture_draws(
    mean: NDArray[np.float64], covariance: NDArray[np.float64], draws: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draws (draw, shape), log density: Student's t about the mean, one three times as wide, and the prior."""
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
