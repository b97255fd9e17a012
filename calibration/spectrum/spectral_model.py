"""The model of tube and detector that an instrument's owner declares, and what is known of its parameters beforehand."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...acquisition.instrument import Instrument
from ...acquisition.setting import Filter
from ...errors import InputError
from ...generator.line.photon_tables import OTHER_TABLES
from ...generator.line.spectral_signal import (
    ALTERNATIVE_SCINTILLATOR,
    KERMA_OUTPUT,
    SHARED_CHARGE,
    THRESHOLD,
    OpenBeam,
    SpectralModel,
    SpectrumCorrection,
)
from ...generator.line.twin import Level
from ...spectra import BIN_WIDTH_KEV, Spectrum, checked_anode
from .dose_data import DOSE_PRIORS, FREE_KERMA_OUTPUT
from .priors import (
    ATTENUATION_SCALE,
    COUNT_SD,
    COUNTED_MORE_SHARE,
    COUNTING_SWANK,
    FREE_OUTPUT,
    GADOLINIUM_SHARE,
    MEASURED_SPECTRUM,
    PRIORS,
    SHARED_OVER_EXCESS,
    SHARED_OVER_EXCESS_SD,
    TABLE_SHARE,
    THRESHOLD_SD_KEV,
    UNDECLARED_SCINTILLATOR,
    UNDECLARED_THRESHOLD,
    Prior,
)
from .spectral_data import relative_sd

_BELOW_END = 0.85  # of kV in keV: up to here a measured spectrum corrects the model
DEFAULT_SCINTILLATOR = (Filter(material="CsI", thickness_mm=0.5),)
OTHER_SCINTILLATOR = (Filter(material="Gd2O2S@7.32", thickness_mm=0.15),)


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
        anode=checked_anode(instrument.anode or "W"),
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


def priors_for(
    model: SpectralModel,
    *,
    scintillator_declared: bool,
    geometry_declared: bool = True,
    threshold_keV: float | None = None,
) -> dict[str, Prior]:
    """The priors of a model's parameters, in the order of its names.

    Args:
        model: says which parameters there are, and whether a measured spectrum takes the place of the tube's.
        scintillator_declared: whether its thickness is known.
        geometry_declared: whether pixel and distance are, so that the output is on an absolute scale.
        threshold_keV: that a counter's owner declares.
    """
    known = DOSE_PRIORS | PRIORS
    known[THRESHOLD] = UNDECLARED_THRESHOLD
    if threshold_keV is not None:
        known[THRESHOLD] = replace(
            UNDECLARED_THRESHOLD,
            centre=threshold_keV,
            sd=THRESHOLD_SD_KEV,
            reason="threshold of the counter, as declared",
        )
    share = GADOLINIUM_SHARE
    known[ALTERNATIVE_SCINTILLATOR] = Prior(
        centre=share, sd=math.sqrt(share * (1.0 - share)), reason="0 is CsI, 1 Gd2O2S: not declared"
    )
    if not scintillator_declared:
        known["log_scintillator_thickness"] = UNDECLARED_SCINTILLATOR
    if not geometry_declared:
        known |= {"log_output": FREE_OUTPUT, KERMA_OUTPUT: FREE_KERMA_OUTPUT}
    if model.correction is not None:
        known |= MEASURED_SPECTRUM
        if model.correction.relative:
            known["log_output"] = FREE_OUTPUT
    if model.counting:
        known["log_swank"] = COUNTING_SWANK
    for name in model.names:
        if name not in known:
            of_table = any(name.startswith(f"{table}_") for table in OTHER_TABLES)
            known[name] = TABLE_SHARE if of_table else ATTENUATION_SCALE
    return {name: known[name] for name in model.names}


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
    excess_sd = float(np.mean([relative_sd(level.gain_DN) for level in known]))  # of the spread, the same in all
    logarithm = np.log([slope.value for slope in slopes])
    weight = np.array([max(relative_sd(slope), 1e-6) ** -2.0 for slope in slopes])
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
