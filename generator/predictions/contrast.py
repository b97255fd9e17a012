"""Dual-energy contrast of a foreign object in a product at any setting, and how far it stands out of the noise.

Slabs through the polychromatic model, before any image is made. With S the signal behind a stack of slabs:

    M = -ln(S / S_open)        q = M_low / M_high        Delta R = q(product and object) - q(product)

    var(M) = (gain S share + read variance) / (S^2 averaged)        var(q) = q^2 (var(M_low) / M_low^2 + var(M_high) / M_high^2)

Left out: scatter, the noise of the flat, and the softening of the object's edge by spread, focal spot and motion.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ...acquisition.contrast import PRODUCT_THRESHOLD, dilations_for_pixel
from ...acquisition.setting import Filter, Setting, text_from_filters
from ...errors import InputError, check_whole
from ...materials import TABLES, Library, material_from_name, mu_per_mm, transmission
from ...spectra import (
    BIN_WIDTH_KEV,
    DEFAULT_ANGLE_DEG,
    DEFAULT_ANODE,
    DEFAULT_MODEL,
    DEFAULT_SCINTILLATOR,
    checked_kV,
    detector_response,
    energy_grid_keV,
    tube_fluence_interpolated,
)
from ..frames.present_line import present_line
from ..line.binning import refuse_binning
from ..line.spectral_signal import OpenBeam
from ..line.twin import Estimate, SpectralPosterior, Twin, estimate_from_sd
from ..line.twin_spectrum import model_of_posterior, spectral_model_of, white_gain_DN
from ..spread.psf import PSF_MODELS, Spread
from .predict import Prediction, predict_flatfield, saturation_text, spectrum_outside
from .tube_twin import TubeTwin

FloatArray = NDArray[np.float64]

MAXIMUM_OBJECT_PIXELS = 1_000_000
MAXIMUM_SPREAD_PX = 50.0
# a wider ring adds no noise worth its computation
_WIDEST_RING_PX = 500
# above this relative noise of a pixel's signal, -ln is no longer straight over the noise
FEW_PHOTONS = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class UncalibratedLine:
    """A line that nothing was measured on: tube, detector and flux as stated.

    Fields: anode, anode_angle_deg, model (SpekPy's); inherent (layers of the tube); scintillator, cover, counting;
    swank (Swank factor of the light, 0 to 1]; output_scale (tube output over SpekPy's); source_detector_mm, pixel_mm;
    psf_model, psf_sigma_px (optical spread); read_noise_keV (electronic noise of one frame as energy absorbed, keV;
    counts where the detector counts); tube: a calibrated one, in place of anode, angle, model, inherent and output_scale.
    """

    anode: str = DEFAULT_ANODE
    anode_angle_deg: float = DEFAULT_ANGLE_DEG
    model: str = DEFAULT_MODEL
    inherent: tuple[Filter, ...] = (Filter(material="Al", thickness_mm=1.0),)
    scintillator: tuple[Filter, ...] = tuple(DEFAULT_SCINTILLATOR)
    cover: tuple[Filter, ...] = ()
    counting: bool = False
    swank: float = 0.9
    output_scale: float = 1.0
    source_detector_mm: float = 1000.0
    pixel_mm: float = 0.15
    psf_model: str = "aperture"
    psf_sigma_px: float = 0.5
    read_noise_keV: float = 0.0
    tube: TubeTwin | None = None

    def __post_init__(self) -> None:
        for name, unit in (("output_scale", ""), ("source_detector_mm", " mm"), ("pixel_mm", " mm")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(name, received=f"{value}{unit}", expected=f"a finite value above 0{unit}")
        for name, unit in (("psf_sigma_px", " px"), ("read_noise_keV", " keV")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(name, received=f"{value}{unit}", expected=f"a finite value of 0{unit} or more")
        if self.psf_sigma_px > MAXIMUM_SPREAD_PX:
            raise InputError(
                "psf_sigma_px", received=f"{self.psf_sigma_px:g} px", expected=f"at most {MAXIMUM_SPREAD_PX:g} px"
            )
        if not 0 < self.swank <= 1:
            raise InputError("swank", received=self.swank, expected="a Swank factor above 0, at most 1")
        if self.psf_model not in PSF_MODELS:
            raise InputError("psf model", received=self.psf_model, expected="one of " + ", ".join(PSF_MODELS))
        if self.tube is not None and not self.tube.output_known:
            raise InputError(
                "tube",
                received="a calibrated tube whose output was not measured",
                expected="one with air kermas in its dose table: noise needs photon numbers",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class ContrastChannel:
    """One tube voltage of the pair.

    Fields: open_signal_DN (one frame; in open_signal_unit, which is keV absorbed or counts for a line that was described, since
    that has no gain); M_product, M_object (with the object), sd_M_product, sd_M_object (one pixel of
    the averaged frame); mu_eff_product_per_mm, mu_eff_object_per_mm (each alone, at its thickness).
    """

    setting: Setting
    open_signal_DN: float
    M_product: float
    M_object: float
    sd_M_product: float
    sd_M_object: float
    mu_eff_product_per_mm: float
    mu_eff_object_per_mm: float
    open_signal_unit: str = "DN"

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers by the fields' names."""
        names = self.__slots__
        return {name: str(self.setting) if name == "setting" else getattr(self, name) for name in names}


@dataclass(frozen=True, slots=True, kw_only=True)
class Contrast:
    """Contrast of an object and its noise.

    Fields: delta_R (value; interval from the twin's posterior and the attenuation tables, without a twin from the tables
    alone; of zero width where no interval was asked for); delta_R_as_published: the paper's equation with coefficients
    of thin objects (Eq. 4); delta_R_by_table; R_product: the product's quotient; sd_pixel: noise of the quotient in one
    pixel of the object; sd_object: noise of the mean over object_pixels (a disc) less the mean over the ring around it,
    with the spread's correlation; cnr_pixel, cnr_object: |delta_R| over these.
    Where the open field of a beam saturates, images show no contrast: delta_R, noise and ratios are None, and warnings
    say so. What stays are properties of beams and slabs.
    """

    low: ContrastChannel
    high: ContrastChannel
    delta_R: Estimate | None
    delta_R_as_published: float
    delta_R_by_table: Mapping[str, float]
    R_product: float
    object_pixels: int
    sd_pixel: float | None
    sd_object: float | None
    cnr_pixel: float | None
    cnr_object: float | None
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """The answer of `raytwin contrast --json` for one pair of settings."""
        return {
            "low": self.low.as_dict(),
            "high": self.high.as_dict(),
            "delta_R": None if self.delta_R is None else self.delta_R.as_dict(),
            "delta_R_as_published": self.delta_R_as_published,
            "delta_R_by_table": dict(self.delta_R_by_table),
            "R_product": self.R_product,
            "object_pixels": self.object_pixels,
            "sd_pixel": self.sd_pixel,
            "sd_object": self.sd_object,
            "cnr_pixel": self.cnr_pixel,
            "cnr_object": self.cnr_object,
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class _Detector:
    """What of a frame's noise the detector correlates: quanta after the spread, and white noise."""

    spread: Spread
    read_variance_DN2: float
    pixel_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Beam:
    """A setting as a function: transmission of an object (energy,) -> rate and gain (draw,), row 0 the best values.

    signal: takes besides whether all draws are wanted or the best values alone; secondary_DN: of the gain, what secondary
    quanta add, the same behind any object; saturated: the open field is more than the converter holds.
    """

    signal: Callable[[FloatArray, bool], tuple[FloatArray, FloatArray]]
    energies_keV: FloatArray
    open_signal_DN: float
    open_gain_DN: float
    secondary_DN: float
    saturated: bool
    warnings: tuple[str, ...]
    unit: str = "DN"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Crossed:
    """What slabs leave of a beam, whatever its load.

    Fields: M_product, M_object (draw,), row 0 the best values; transmitted, gain_ratio (2,): signal and gain behind product, and
    behind both, over those of the open beam; M_object_alone; thin_mu_product_per_mm, thin_mu_object_per_mm.
    """

    M_product: FloatArray
    M_object: FloatArray
    transmitted: tuple[float, float]
    gain_ratio: tuple[float, float]
    M_object_alone: float
    thin_mu_product_per_mm: float
    thin_mu_object_per_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Slabs:
    """Log images (draw,) and noise behind the slabs, of one channel."""

    channel: ContrastChannel
    M_product: FloatArray
    M_object: FloatArray
    quantum_product: float
    quantum_object: float
    white_product: float
    white_object: float
    thin_mu_product_per_mm: float
    thin_mu_object_per_mm: float
    few_photons: bool
    saturated: bool
    warnings: tuple[str, ...]


def _beam_of_twin(
    twin: Twin, setting: Setting, intervals: bool, predict: Callable[[Twin, Setting], Prediction] = predict_flatfield
) -> _Beam:
    line = present_line(twin)
    twin = line.twin
    told = line.warnings
    if line.effects:
        told += ("left out of the contrast: effects " + ", ".join(item.id for item in line.effects),)
    model = spectral_model_of(twin, highest_kV=setting.kV)  # refuses a twin without spectral part
    posterior = cast(SpectralPosterior, twin.spectral)
    samples = posterior.best[None, :]
    if intervals:
        samples = np.concatenate([samples, posterior.samples])
    beam = OpenBeam(kV=setting.kV, filters=setting.filters)
    # frames of one exposure: averaging is put in where the noise is
    predicted = predict(twin, replace(setting, averaged=1))

    @cache
    def photons(draws: bool) -> FloatArray:
        return model.weights(samples if draws else samples[:1], beam)

    def signal(through: FloatArray, draws: bool) -> tuple[FloatArray, FloatArray]:
        bare = photons(draws)
        found = model.signal_of_photons(samples if draws else samples[:1], bare * through[: bare.shape[1]])
        return found.rate_DN_per_mAs, found.gain_DN

    return _Beam(
        signal=signal,
        energies_keV=model.energies_keV,
        open_signal_DN=predicted.mean_DN.value,
        open_gain_DN=predicted.gain_DN.value,
        secondary_DN=white_gain_DN(twin, predicted.gain_DN.value),
        saturated=bool(saturation_text(twin, setting, predicted.mean_DN.value)),
        warnings=(*predicted.warnings, *told),
    )


def _beam_of_line(line: UncalibratedLine, setting: Setting, library: Library | None, intervals: bool = False) -> _Beam:
    load = setting.stated_load_mAs()
    if line.tube is None:
        energies, bare, photons = _photons_of_line(line, setting, library)
        warnings: tuple[str, ...] = ()
    else:
        energies, bare, photons, warnings = _photons_of_tube(line.tube, setting, intervals)
    response = detector_response(
        scintillator=line.scintillator,
        cover=line.cover,
        counting=line.counting,
        energies_keV=energies,
        library=library,
    )
    first, second = photons * response.mean_deposited_keV, photons * response.mean_square_deposited_keV2

    def signal(through: FloatArray, draws: bool) -> tuple[FloatArray, FloatArray]:
        rows = slice(None) if draws else slice(1)
        rate = np.sum(first[rows] * through, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return rate, np.sum(second[rows] * through, axis=1) / rate / line.swank

    rate, gain = signal(np.ones_like(energies), False)
    # fewer than one photon in 1e30 is no beam, whatever floating point can still hold
    if not rate[0] > 1e-30 * float(bare @ response.mean_deposited_keV):
        layers = setting.filters if line.tube is not None else (*line.inherent, *setting.filters)
        raise InputError(
            "filter",
            received=text_from_filters(layers),
            expected="layers that let some photons through",
            remedy="take thinner filters or a higher tube voltage",
        )
    distance = setting.source_detector_mm or line.source_detector_mm
    return _Beam(
        signal=signal,
        energies_keV=energies,
        open_signal_DN=float(rate[0]) * load * (1000.0 / distance) ** 2 * line.pixel_mm**2,
        open_gain_DN=float(gain[0]),
        secondary_DN=0.0,
        saturated=False,
        warnings=warnings,
        unit="counts" if line.counting else "keV",
    )


def _photons_of_line(
    line: UncalibratedLine, setting: Setting, library: Library | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Energies, photons without any layer (energy,) and behind all of them (1, energy), a mAs and mm2 at 1 m."""
    checked_kV(setting.kV, anode=line.anode)
    energies = energy_grid_keV(setting.kV)
    fluence = tube_fluence_interpolated(
        setting.kV,
        energies_keV=energies,
        anode=line.anode,
        anode_angle_deg=line.anode_angle_deg,
        model=line.model,
        for_sums=True,
    )
    bare = line.output_scale * fluence * (BIN_WIDTH_KEV / 100.0)
    layers = (*line.inherent, *setting.filters)
    return (
        energies,
        bare,
        (bare * transmission(layers, energies, library=library, bin_width_keV=BIN_WIDTH_KEV))[None, :],
    )


def _photons_of_tube(
    tube: TubeTwin, setting: Setting, intervals: bool
) -> tuple[FloatArray, FloatArray, FloatArray, tuple[str, ...]]:
    """The same of a calibrated tube: row 0 its most probable spectrum, then, for intervals, the posterior's draws."""
    posterior = tube.spectral
    checked_kV(setting.kV, anode=posterior.anode)
    model = model_of_posterior(posterior, highest_kV=setting.kV)
    best = posterior.best[None, :]
    samples = np.concatenate([best, posterior.samples]) if intervals else best
    photons = model.weights(samples, OpenBeam(kV=setting.kV, filters=setting.filters))
    bare = model.weights(best, OpenBeam(kV=setting.kV, filters=()))[0]
    outside = spectrum_outside(posterior, kV=setting.kV, filters=setting.filters)
    told = (f"outside the calibrated range of {', '.join(outside)}: the interval rests on the spectral model",)
    return model.energies_keV[: bare.size], bare, photons, told if outside else ()


def _detector_of(line: Twin | UncalibratedLine) -> _Detector:
    if isinstance(line, UncalibratedLine):
        return _Detector(
            spread=Spread(model=line.psf_model, sigma_px=line.psf_sigma_px),
            read_variance_DN2=line.read_noise_keV**2,
            pixel_mm=line.pixel_mm,
        )
    return _Detector(
        spread=line.noise.spread.value,
        read_variance_DN2=line.noise.read_variance_DN2,
        pixel_mm=line.instrument.pixel_mm or 0.15,
    )


def _checked_slabs(product: Filter, foreign_object: Filter, displaces: bool, object_pixels: int) -> None:
    for name, layer in (("product", product), ("foreign object", foreign_object)):
        if not layer.thickness_mm > 0:
            raise InputError(f"{name} thickness", received=f"{layer.thickness_mm:g} mm", expected="more than 0 mm")
    if displaces and foreign_object.thickness_mm > product.thickness_mm:
        raise InputError(
            "foreign object thickness",
            received=f"{foreign_object.thickness_mm:g} mm",
            expected=f"at most the product's {product.thickness_mm:g} mm, whose place it takes",
        )
    check_whole("object pixels", object_pixels, least=1)
    if object_pixels > MAXIMUM_OBJECT_PIXELS:
        raise InputError(
            "object pixels", received=object_pixels, expected=f"a whole number from 1 to {MAXIMUM_OBJECT_PIXELS}"
        )


def _crossed(
    beam: _Beam,
    *,
    kV: float,
    product: Filter,
    foreign_object: Filter,
    displaces: bool,
    table: str,
    library: Library | None,
    draws: bool,
) -> _Crossed:
    energies = beam.energies_keV

    def passed(*layers: Filter) -> FloatArray:
        return transmission(layers, energies, table=table, library=library, bin_width_keV=BIN_WIDTH_KEV)

    def behind(layers: tuple[Filter, ...], opened: FloatArray, of_draws: bool) -> tuple[FloatArray, FloatArray]:
        rate, gain = beam.signal(passed(*layers), of_draws)
        if not np.all(rate > 1e-30 * opened[: rate.size]):
            raise InputError(
                "product and foreign object",
                received=" behind ".join(str(layer) for layer in layers),
                expected=f"slabs that let some photons through at {kV:g} kV",
                remedy="take thinner slabs or a higher tube voltage",
            )
        return rate, gain

    around = product
    if displaces:
        around = Filter(
            material=product.material, thickness_mm=max(product.thickness_mm - foreign_object.thickness_mm, 0.0)
        )
    open_rate, open_gain = beam.signal(np.ones_like(energies), draws)
    rates, gains = zip(
        *(behind(layers, open_rate, draws) for layers in ((product,), (around, foreign_object))), strict=True
    )
    alone = behind((foreign_object,), open_rate, False)[0]
    thin = []
    for layer in (product, foreign_object):
        mu = mu_per_mm(material_from_name(layer.material, library=library), energies, table=table)
        # the signal is linear in the transmission, so the mean of mu over the signal is the signal of mu
        thin.append(float(beam.signal(mu, False)[0][0] / open_rate[0]))
    return _Crossed(
        M_product=-np.log(rates[0] / open_rate),
        M_object=-np.log(rates[1] / open_rate),
        transmitted=(float(rates[0][0] / open_rate[0]), float(rates[1][0] / open_rate[0])),
        gain_ratio=(float(gains[0][0] / open_gain[0]), float(gains[1][0] / open_gain[0])),
        M_object_alone=float(-np.log(alone[0] / open_rate[0])),
        thin_mu_product_per_mm=thin[0],
        thin_mu_object_per_mm=thin[1],
    )


def check_pair(low: Setting, high: Setting) -> None:
    """Raise `InputError` where a pair of settings has one spectrum, or the higher kV first."""
    if low.kV > high.kV or (low.kV == high.kV and low.filters == high.filters):
        raise InputError(
            "low and high setting",
            received=f"{low} and {high}",
            expected="two different spectra, the lower kV first",
        )


def _slabs(
    beam: _Beam, crossed: _Crossed, setting: Setting, detector: _Detector, *, product: Filter, foreign_object: Filter
) -> _Slabs:
    quantum, white, spreads = [], [], []
    for share, ratio in zip(crossed.transmitted, crossed.gain_ratio, strict=True):
        signal = beam.open_signal_DN * share
        if not 1e-30 < signal < 1e30:
            raise InputError(
                "setting",
                received=f"{signal:.3g} {beam.unit} behind product and object at {setting.kV:g} kV",
                expected="a signal that a detector could hold",
                remedy="check tube load, distance, pixel pitch and output",
            )
        gain_DN = beam.open_gain_DN * ratio
        secondary_DN = min(beam.secondary_DN, 0.9 * gain_DN)
        # variance of M before the spread: gain S / S^2
        quantum.append((gain_DN - secondary_DN) / signal / setting.averaged)
        white.append((secondary_DN / signal + detector.read_variance_DN2 / signal**2) / setting.averaged)
        spreads.append(quantum[-1] * detector.spread.variance_share + white[-1])
    return _Slabs(
        channel=ContrastChannel(
            setting=setting,
            open_signal_DN=beam.open_signal_DN,
            M_product=float(crossed.M_product[0]),
            M_object=float(crossed.M_object[0]),
            sd_M_product=math.sqrt(spreads[0]),
            sd_M_object=math.sqrt(spreads[1]),
            mu_eff_product_per_mm=float(crossed.M_product[0]) / product.thickness_mm,
            mu_eff_object_per_mm=crossed.M_object_alone / foreign_object.thickness_mm,
            open_signal_unit=beam.unit,
        ),
        M_product=crossed.M_product,
        M_object=crossed.M_object,
        quantum_product=quantum[0],
        quantum_object=quantum[1],
        white_product=white[0],
        white_object=white[1],
        thin_mu_product_per_mm=crossed.thin_mu_product_per_mm,
        thin_mu_object_per_mm=crossed.thin_mu_object_per_mm,
        few_photons=math.sqrt(max(spreads)) > FEW_PHOTONS,
        saturated=beam.saturated,
        warnings=beam.warnings,
    )


def published_delta_r(
    *,
    mu_object_low_per_mm: float,
    mu_object_high_per_mm: float,
    mu_product_low_per_mm: float,
    mu_product_high_per_mm: float,
    thickness_ratio: float,
) -> float:
    """Delta R (no unit) of the paper's linear model: a b (R_f - R_m) / (a b + 1).

    a = `thickness_ratio`, object over product; b = mu_object_high / mu_product_high; R = mu_low / mu_high of each.
    Exact for one photon energy a channel; beam hardening makes it differ behind real thicknesses.

    Source: Andriiashen et al., X-ray Image Generation as a Method of Performance Prediction for Real-Time Inspection,
        the equation that defines Delta R.
    """
    product_of_ratios = thickness_ratio * mu_object_high_per_mm / mu_product_high_per_mm
    difference = mu_object_low_per_mm / mu_object_high_per_mm - mu_product_low_per_mm / mu_product_high_per_mm
    return product_of_ratios * difference / (product_of_ratios + 1.0)


def disc_and_ring(pixels: int, dilations: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks (row, column) of a disc of exactly `pixels` pixels, and of the ring around it that Delta R is taken over."""
    from scipy.ndimage import distance_transform_cdt

    reach = math.ceil(math.sqrt(pixels / math.pi)) + 2
    position = np.arange(-reach - dilations, reach + dilations + 1)
    distance = position[:, None] ** 2 + position[None, :] ** 2
    nearest = np.zeros(distance.size, dtype=bool)
    nearest[np.argsort(distance, axis=None, kind="stable")[:pixels]] = True
    disc = nearest.reshape(distance.shape)
    # as many dilations with the cross of four neighbours as steps along rows and columns
    steps = distance_transform_cdt(~disc, metric="taxicab")
    return disc, (steps > 0) & (steps <= dilations)


def _variance_of_difference(
    *,
    pixels: tuple[int, int],
    correlated: tuple[float, float, float],
    quantum: tuple[float, float],
    white: tuple[float, float],
) -> float:
    """Variance of the disc's mean less the ring's; quantum and white variance a pixel as (in the disc, in the ring)."""
    in_disc, in_both, in_ring = correlated
    of_quanta = quantum[0] * in_disc - 2.0 * math.sqrt(quantum[0] * quantum[1]) * in_both + quantum[1] * in_ring
    return of_quanta + white[0] / pixels[0] + white[1] / pixels[1]


def _correlated_shares(
    masks: tuple[NDArray[np.bool_], NDArray[np.bool_]], spread: Spread
) -> tuple[float, float, float]:
    """Variance of the means over disc and over ring of noise of unit variance before the spread, and between them.

    Returns:
        Disc, disc with ring, ring; no unit.
    """
    from scipy.signal import oaconvolve

    kernel = spread.noise_autocovariance(spread.reach_px)
    disc, ring = (mask / mask.sum() for mask in masks)
    around_disc, around_ring = (oaconvolve(mean, kernel, mode="same") for mean in (disc, ring))
    return float(np.sum(disc * around_disc)), float(np.sum(ring * around_disc)), float(np.sum(ring * around_ring))


def _quotients(low: _Slabs | _Crossed, high: _Slabs | _Crossed) -> tuple[FloatArray, FloatArray]:
    return low.M_product / high.M_product, low.M_object / high.M_object


def _combined(
    low: _Slabs,
    high: _Slabs,
    detector: _Detector,
    *,
    thickness_ratio: float,
    pixels: tuple[int, int],
    correlated: tuple[float, float, float],
    by_table: Mapping[str, float],
) -> Contrast:
    R_product, R_object = _quotients(low, high)
    differences = R_object - R_product
    best = float(differences[0])
    sd = float(np.std(list(by_table.values()), ddof=1)) if len(by_table) > 1 else 0.0
    if len(differences) > 2:
        sd = math.hypot(sd, float(np.std(differences[1:], ddof=1)))
    q_product, q_object = float(R_product[0]), float(R_object[0])

    def of_quotient(of_low: float, of_high: float, quotient: float, M_low: float, M_high: float) -> float:
        return quotient**2 * (of_low / M_low**2 + of_high / M_high**2)

    behind = [(q_object, float(low.M_object[0]), float(high.M_object[0]))]
    behind.append((q_product, float(low.M_product[0]), float(high.M_product[0])))
    quantum = (
        of_quotient(low.quantum_object, high.quantum_object, *behind[0]),
        of_quotient(low.quantum_product, high.quantum_product, *behind[1]),
    )
    white = (
        of_quotient(low.white_object, high.white_object, *behind[0]),
        of_quotient(low.white_product, high.white_product, *behind[1]),
    )
    share = detector.spread.variance_share
    sd_pixel = math.sqrt(quantum[0] * share + white[0])
    sd_object = math.sqrt(_variance_of_difference(pixels=pixels, correlated=correlated, quantum=quantum, white=white))
    warnings = list(dict.fromkeys((*low.warnings, *high.warnings)))
    if low.few_photons or high.few_photons:
        warnings.append(
            f"a pixel's signal behind the object is noisier than {100 * FEW_PHOTONS:.0f} %: its logarithm is biased and"
            " the noise given here is too small"
        )
    if low.channel.M_product < PRODUCT_THRESHOLD:
        warnings.append(
            f"the product is thin: M_low = {low.channel.M_product:.3g}, and the ring of Delta R asks for more than"
            f" {PRODUCT_THRESHOLD:g}"
        )
    found = Contrast(
        low=low.channel,
        high=high.channel,
        delta_R=estimate_from_sd(best, sd),
        delta_R_as_published=published_delta_r(
            mu_object_low_per_mm=low.thin_mu_object_per_mm,
            mu_object_high_per_mm=high.thin_mu_object_per_mm,
            mu_product_low_per_mm=low.thin_mu_product_per_mm,
            mu_product_high_per_mm=high.thin_mu_product_per_mm,
            thickness_ratio=thickness_ratio,
        ),
        delta_R_by_table=dict(by_table),
        R_product=q_product,
        object_pixels=pixels[0],
        sd_pixel=sd_pixel,
        sd_object=sd_object,
        cnr_pixel=abs(best) / sd_pixel,
        cnr_object=abs(best) / sd_object,
        warnings=tuple(warnings),
    )
    if not (low.saturated or high.saturated):
        return found
    return replace(
        found, delta_R=None, delta_R_by_table={}, sd_pixel=None, sd_object=None, cnr_pixel=None, cnr_object=None
    )


class SlabContrasts:
    """Contrasts of one foreign object in one product on one line, beams and slabs computed once for all pairs of settings.

    Args:
        line, product, foreign_object, object_pixels, displaces, library: as for `predict_contrast`.
        predict: a twin and a setting -> its flatfield; one that keeps what it has predicted saves time.
    """

    def __init__(
        self,
        line: Twin | UncalibratedLine,
        *,
        product: Filter,
        foreign_object: Filter,
        object_pixels: int = 1,
        displaces: bool = False,
        library: Library | None = None,
        predict: Callable[[Twin, Setting], Prediction] = predict_flatfield,
    ) -> None:
        _checked_slabs(product, foreign_object, displaces, object_pixels)
        self._line = line
        self._product, self._foreign_object, self._displaces = product, foreign_object, displaces
        self._thickness_ratio = foreign_object.thickness_mm / product.thickness_mm
        self._library = library
        self._predict = predict
        self._detector = _detector_of(line)
        masks = disc_and_ring(object_pixels, min(dilations_for_pixel(self._detector.pixel_mm), _WIDEST_RING_PX))
        self._pixels = (int(masks[0].sum()), int(masks[1].sum()))
        self._correlated = _correlated_shares(masks, self._detector.spread)
        self._known: dict[tuple[Setting, bool], _Slabs] = {}
        self._crossed: dict[tuple[float, tuple[Filter, ...], bool, str], _Crossed] = {}
        self._beams: dict[tuple[Setting, bool], _Beam] = {}

    def contrast(self, low: Setting, high: Setting, *, intervals: bool = True) -> Contrast:
        """`predict_contrast` at a pair of settings; without intervals in a fraction of the time.

        Raises:
            InputError: as there.
        """
        check_pair(low, high)
        by_table = {}
        for table in TABLES if intervals else ("xraylib",):
            q_product, q_object = _quotients(self._behind(low, intervals, table), self._behind(high, intervals, table))
            by_table[table] = float(q_object[0] - q_product[0])
        return _combined(
            self._slabs(low, intervals),
            self._slabs(high, intervals),
            self._detector,
            thickness_ratio=self._thickness_ratio,
            pixels=self._pixels,
            correlated=self._correlated,
            by_table=by_table,
        )

    def _slabs(self, setting: Setting, intervals: bool) -> _Slabs:
        key = (setting, intervals)
        if key not in self._known:
            self._known[key] = _slabs(
                self._beam(setting, intervals),
                self._behind(setting, intervals, "xraylib"),
                setting,
                self._detector,
                product=self._product,
                foreign_object=self._foreign_object,
            )
        return self._known[key]

    def _behind(self, setting: Setting, intervals: bool, table: str) -> _Crossed:
        key = (setting.kV, setting.filters, intervals, table)
        if key not in self._crossed:
            self._crossed[key] = _crossed(
                self._beam(setting, intervals),
                kV=setting.kV,
                product=self._product,
                foreign_object=self._foreign_object,
                displaces=self._displaces,
                table=table,
                library=self._library,
                draws=intervals and table == "xraylib",  # of other tables the best values alone count
            )
        return self._crossed[key]

    def _beam(self, setting: Setting, intervals: bool) -> _Beam:
        refuse_binning(setting)
        key = (setting, intervals)
        if key not in self._beams:
            if isinstance(self._line, UncalibratedLine):
                self._beams[key] = _beam_of_line(self._line, setting, self._library, intervals)
            else:
                self._beams[key] = _beam_of_twin(self._line, setting, intervals, self._predict)
        return self._beams[key]


def predict_contrast(
    line: Twin | UncalibratedLine,
    *,
    low: Setting,
    high: Setting,
    product: Filter,
    foreign_object: Filter,
    object_pixels: int = 1,
    displaces: bool = False,
    library: Library | None = None,
) -> Contrast:
    """Contrast Delta R (no unit) of a foreign object in a product, its noise and its contrast-to-noise ratio.

    See the module's head for the equations. The interval of Delta R holds the twin's posterior and the standard
    deviation between attenuation tables; densities, compositions and thicknesses are taken as stated.

    Args:
        line: a twin with a spectral part, or an `UncalibratedLine`.
        low, high: the settings of the pair, each with a tube load.
        product, foreign_object: material and thickness of the two slabs.
        object_pixels: pixels that the object covers, taken as a disc; its ring is 3.2 mm wide, as Delta R's definition has it.
        displaces: the object takes the place of as much product; else it comes on top of it, as in the paper's equation.
        library: where materials are looked up.

    Raises:
        InputError: settings without load or with one spectrum, slabs of no thickness or that nothing crosses, a twin
            without spectral part.

    Source: Andriiashen et al., X-ray Image Generation as a Method of Performance Prediction for Real-Time Inspection.
    Checked against: the paper's equation where the beam is nearly monoenergetic, noise drawn frame by frame
        (tests/test_generator_contrast.py).
    """
    slabs = SlabContrasts(
        line,
        product=product,
        foreign_object=foreign_object,
        object_pixels=object_pixels,
        displaces=displaces,
        library=library,
    )
    return slabs.contrast(low, high)


def compute_contrast_map(
    line: Twin | UncalibratedLine,
    pairs: Iterable[Sequence[tuple[Setting, Setting]]],
    *,
    product: Filter,
    foreign_object: Filter,
    object_pixels: int = 1,
    displaces: bool = False,
    library: Library | None = None,
) -> tuple[tuple[Contrast, ...], ...]:
    """`predict_contrast` without intervals for a grid of (low, high) settings, rows of columns.

    A setting that stands in several pairs is computed once. Raises as `predict_contrast`.
    """
    slabs = SlabContrasts(
        line,
        product=product,
        foreign_object=foreign_object,
        object_pixels=object_pixels,
        displaces=displaces,
        library=library,
    )
    return tuple(tuple(slabs.contrast(low, high, intervals=False) for low, high in row) for row in pairs)
