"""What may differ from the base twin: effects with their variants and strengths, and nuisances that are no effect.

A change is anything that the forward model can be asked with: applied effects, other spectral parameters, another
spread or read noise, another thickness. Its response is what the probes would do.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ...calibration.priors import ATTENUATION_SCALE, DEPARTURES, PRIORS, UNDECLARED_SCINTILLATOR, spread_of
from ...generator.effects import EFFECTS, AppliedEffect, Effect
from ...generator.effects.effect import Parameter
from ...generator.line.twin import Estimate, SpectralPosterior, Twin
from ..session.coarse import in_squares

_MOST_VARIANTS = 4

# scales of the session that any repeat shows; relative standard deviations unless the name says otherwise
THICKNESS_SD = 0.01  # of a scene's material: what a wedge or slab is known to
ATTENUATION_SD = 0.015  # of a material's attenuation: tables differ by 1-4 %
ATTENUATION_OF_BEAM_SD = 0.004  # the part of that which changes with the tube voltage
LEVEL_OF_BEAM_SD = 0.003  # of the level of a kV and filter
OF_BEAMS_GROWS = 2.0  # how much more beams may differ by, over each further prior sd of the largest departure
LEVEL_OF_SERIES_SD = 0.001  # of the level of one series
EXPOSURE_SD_MS = (
    0.02  # of the length of all exposures: resets, shutters and pulses take as long as a line's readout, 10-100 us
)
GAIN_OF_BEAM_SD = 0.01  # of the gain of a kV and filter
GAIN_EXPONENT_SD = 0.5  # of the power of a pixel's gain with which its quantum noise grows: 1 to 2
POSITION_SD_PX = 0.15  # of a scene against its thickness maps
REGISTERED_SD_PX = 1.0  # of the same before registration looks (`register`): what that finds is in no series' pictures
OUTLINE_SD_PX = 0.1  # of where an object's outline lies: rendering of the pixels that it cuts, true size
MAGNIFICATION_SD = 0.001
# of the variance of edges' blur in all scenes: a third of a pixel's own, 1/12, as a thickness may be a pixel's mean or its middle's.
# Assumed; with three times as much or a third four sessions had the same names (docs/notebook/diagnosis_designs.md)
EDGE_SD_PX2 = 1.0 / 36.0
ROUGH_FIELDS = 24
BEYOND_SD = 1.0  # beyond a border: 0 a picture that mirrors there, 1 one that goes on as it ends, 2 an edge that runs straight on
ROUGH_SHARE = 0.9  # of the local slope: rendering along an edge, from place to place
SPREAD_SD = 0.05  # of the calibrated optical spread: calibration may have taken in an effect
TEXTURE_SD = 0.003  # of the correlation of neighbours at each lag, the same in all series
READ_TEXTURE_SD = (
    0.05  # of the read noise's correlation at each lag: what an amplifier keeps that settles for three time constants
)
TEXTURE_OF_BEAM_SHARE = 1.0  # of this that may differ from kV to kV
# always there a little, without being an effect: limits of the catalogue's table; beyond them the effect of that kind begins
SHAPE_SD = 0.0005  # rms over the field of the smooth change of the open field's shape: of a series, and of all since the calibration
SHAPE_ORDER = 4  # of the polynomials that stand for it, each order half as likely as the one of half its number
LINE_NOISE_LIMIT = 0.1  # rms of row and of column offsets over the read noise
READ_NOISE_SD = (
    LINE_NOISE_LIMIT**2
)  # rows and columns of that size add twice it to the variance; calibration may leave them out
OUTPUT_STEP_LIMIT = 0.0005 / math.sqrt(
    8.0
)  # rms of an output with 1/f noise of 0.05 % over 16 octaves: two octaves of it
DUST_LIMIT = 0.01  # of the light: a pixel that differs less from its neighbours is no bad one (ASTM E2597)
FEW_BAD_PIXELS, FEW_BAD_SHARE = 2, 2e-4  # pixels that turn bad in a session: two, or that share of a large panel's
# of level and gradient where frames were divided by an open field of another time: output, kV, filters and heel may differ
DIVIDED_LEVEL_SD, DIVIDED_TILT_SD = 0.3, 0.1
KURTOSIS_SD = 0.04  # of the excess kurtosis that all series have in common
UNEVEN_SHARE = 0.3  # of an effect that may be uneven: how much more of it there may be on one side of the panel
CUT_OFF_SHARE = 0.5  # of a step by which lost bits may lower a level
PATTERN_WAVES = 8  # cosine waves along each side of a gain map's smooth change, the long ones the larger
PATTERN_SMOOTH_SHARE = 0.5  # of that change's variance
DARK_SD_DN = 0.25  # of the dark between series: half of the limit


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """An effect with its inner parameters fixed.

    Fields: effect; name; parameters (without the strength); sign (of the strength); since; low, high: plausible range of
    the strength; strengths > 0, ascending, at which the response is computed; fitted: its inner parameters with their ranges here;
    refined_from: name of the variant that was refined to be this one, None: not refined; series: names of those in which it acts
    (empty: all); log_prior: log probability of that, against one that acts in all; most: strength beyond which there is nothing (a
    share of 100 %); beside: another effect that is there: its response is what it adds to that one's; course: what the effect is
    from frame to frame, as `Effect` says (empty: not known).
    """

    effect: str
    name: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)
    sign: float = 1.0
    since: str = "always"
    low: float
    high: float
    strengths: tuple[float, ...]
    fitted: tuple[Parameter, ...] = ()
    refined_from: str | None = None
    series: tuple[str, ...] = ()
    log_prior: float = 0.0
    most: float = math.inf
    beside: AppliedEffect | None = None
    course: str = ""

    def refined(self, parameters: Mapping[str, float], strengths: Sequence[float]) -> "Variant":
        """The same with other inner parameters, asked at other strengths; its name says where it came from."""
        label = ", ".join(f"{name} {value:.3g}" for name, value in parameters.items())
        first = self.name if self.refined_from is None else self.refined_from
        beside = "" if self.beside is None else f", beside {self.beside.id}"
        return replace(
            self,
            parameters=dict(parameters),
            name=f"{label}, refined from {first}{beside}".strip(", "),
            strengths=tuple(strengths),
            refined_from=first,
        )

    def applied(self, strength: float) -> AppliedEffect:
        """The effect at a strength, as the forward model takes it."""
        return AppliedEffect(
            id=self.effect,
            parameters={**self.parameters, "strength": self.sign * strength},
            since=self.since,
        )


def variants_of(effect: Effect, *, side: int = 1) -> list[Variant]:
    """The variants of an effect that compete: ends and middle of each inner parameter, both signs, both onsets.

    side: of the squares of the panel's pixels that frames have for pixels; lengths in pixels and what is counted by pixel
    are those of the panel.

    What calibration takes in whole (a constant kV offset, filtration, gain map, more noise) is no gap and is tried as setting in
    after it; what acts on objects alone is the same either way; the rest is tried both ways.
    """
    strength, *others = (in_squares(item, side) for item in effect.parameters)
    inner = [item for item in others if item.fitted]
    choices: list[dict[str, float]] = [{}]
    for item in inner:
        if item.log:
            middle = math.sqrt(item.low * item.high)
            values = [item.low * (middle / item.low) ** 0.5, item.high * (middle / item.high) ** 0.5]
        elif item.signed:
            values = [-item.high, item.high] if len(inner) == 1 else [-item.default, item.default]
        elif item.low == 0.0 and item.high == 1.0:
            values = [0.0, 1.0]  # a share: none or all
        else:
            span = item.high - item.low
            count = 4 if item.name.endswith("_deg") else 2
            values = (
                [item.low + span * k / count for k in range(count)]
                if count == 4
                else [item.low + 0.25 * span, item.low + 0.75 * span]
            )
        grown = [{**choice, item.name: value} for choice in choices for value in values]
        choices = grown if len(grown) <= _MOST_VARIANTS else [{**c, item.name: item.default} for c in choices]
    if effect.grid.variants:
        choices = [
            {item.name: item.default for item in inner}
            | {name: value / effect.pixels_per_square(name, side) for name, value in choice.items()}
            for choice in effect.grid.variants
        ]
    signs = (1.0, -1.0) if strength.signed else (1.0,)
    low, high = strength.low, strength.high
    nodes = tuple(low * (high / low) ** share for share in effect.grid.shares)
    usual = effect.usual_onset
    open_if_later = tuple(item for item in effect.parameters if item.fitted_if_later)
    result = []
    for choice, sign, since in product(choices, signs, effect.onsets):
        label = ", ".join(f"{name} {value:.3g}" for name, value in choice.items())
        if sign < 0:
            label = f"{label}, negative".strip(", ")
        if since != usual:
            label = f"{label}, {'always' if since == 'always' else 'since the calibration'}".strip(", ")
        later = open_if_later if since == "calibration" else ()
        result.append(
            Variant(
                effect=effect.id,
                name=label,
                parameters={**choice, **{item.name: 0.5 * (item.low + item.high) for item in later}},
                sign=sign,
                since=since,
                low=low,
                high=high,
                strengths=nodes,
                fitted=(*inner, *later),
                most=strength.most,
                course=effect.course,
            )
        )
    return result


def with_pauses(variants: Sequence[Variant], *, stated: bool) -> list[Variant]:
    """The variants for a session whose times between series are stated, or not: then lag and drift ask how long pauses were."""
    if stated:
        return list(variants)
    result = []
    for variant in variants:
        grown = [variant]
        for item in EFFECTS[variant.effect].parameters:
            if item.tried_without_times and item.name not in variant.parameters:
                grown = [_with_tried(one, item, value) for one in grown for value in item.tried_without_times]
        result += grown
    return result


def _with_tried(variant: Variant, item: Parameter, value: float) -> Variant:
    """The variant with one more inner parameter, from a value."""
    return replace(
        variant,
        name=f"{variant.name}, {item.name} {value:g}",
        parameters={**variant.parameters, item.name: value},
        fitted=(*variant.fitted, item),
    )


def catalogue_variants(*, without: Sequence[str] = (), side: int = 1) -> list[Variant]:
    """The variants of the whole catalogue, less the effects in `without`; side as in `variants_of`."""
    kept = (effect for name, effect in EFFECTS.items() if name not in without)
    return [variant for effect in kept for variant in variants_of(effect, side=side)]


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinChange:
    """A nuisance that lies in the twin: its name, the changed twin or parameters, and how many prior sds the step is."""

    name: str
    twin: Twin
    parameters: NDArray[np.float64] | None
    step_sd: float


def spectral_sds(posterior: SpectralPosterior) -> NDArray[np.float64]:
    """Standard deviations (parameter,) that spectral parameters are taken to have before a session is seen.

    They are those that calibration started from, not its posterior's: the calibrating series are among the probes and say again
    what they know.
    """
    result = []
    for name in posterior.names:
        sd = spread_of(PRIORS.get(name, ATTENUATION_SCALE))
        if name == "log_scintillator_thickness" and "not declared" in str(posterior.prior.get(name, "")):
            sd = UNDECLARED_SCINTILLATOR.sd
        if name in ("log_output", "log_DN_per_keV"):
            # fixed by the level within percents; a wide prior would only leave the linear range
            sd = 0.03
        result.append(sd)
    return np.array(result)


def departures_found(posterior: SpectralPosterior | None) -> float:
    """How many prior standard deviations a line's largest departure from tables and models is by its calibration; 1 at the least.

    What lies that far out by one parameter is likely to have more beside it that no parameter describes.
    """
    if posterior is None:
        return 1.0
    means = posterior.samples.mean(axis=0)
    found = []
    for name, mean in zip(posterior.names, means, strict=True):
        if name.startswith(DEPARTURES):
            prior = PRIORS.get(name, ATTENUATION_SCALE)
            found.append(abs(float(mean) - prior.centre) / prior.sd)
    return max([1.0, *found])


def twin_changes(twin: Twin, *, spectral_steps: float = 1.0) -> list[TwinChange]:
    """Steps in what calibration has fitted, each with the step's size in prior standard deviations (`spectral_sds`).

    Args:
        twin: as asked.
        spectral_steps: size of a step over the posterior's standard deviation.
    """
    result: list[TwinChange] = []
    posterior = twin.spectral
    if posterior is not None:
        best = np.asarray(posterior.best, dtype=np.float64)
        draws = posterior.samples.std(axis=0)
        for index, (name, sd) in enumerate(zip(posterior.names, spectral_sds(posterior), strict=True)):
            step = min(max(spectral_steps * float(draws[index]), 0.05 * sd), sd)
            if name == "inherent_filtration_mm_Al" and best[index] - step < 0:
                step = abs(step)
            changed = best.copy()
            changed[index] += step
            result.append(TwinChange(name=name, twin=twin, parameters=changed, step_sd=step / sd))
    spread = twin.noise.spread
    sigma_px = spread.value.sigma_px
    known = spread.intervals.get("sigma_px")
    sd = max(SPREAD_SD * sigma_px, 0.0 if known is None else (known.high - known.low) / (2 * 1.959964), 0.01)
    step = 0.5 * sd
    wider = replace(spread, value=replace(spread.value, sigma_px=sigma_px + step))
    result.append(
        TwinChange(
            name="optical spread",
            twin=replace(twin, noise=replace(twin.noise, spread=wider)),
            parameters=None,
            step_sd=step / sd,
        )
    )
    result += _tail_changes(twin)
    result += [
        TwinChange(
            name=f"optical spread as {other.family}",
            twin=replace(twin, noise=replace(twin.noise, spread=replace(spread, value=other.value))),
            parameters=None,
            # taken whole it costs ln(1 / p), as in a mixture; a standard deviation is no more than the whole
            step_sd=math.sqrt(max(-2.0 * math.log(other.probability), 1.0)),
        )
        for other in spread.others
    ]
    read = twin.noise.read_noise_DN
    sd = max(READ_NOISE_SD * read.value, (read.high - read.low) / (2 * 1.959964), 1e-3)
    noisier = Estimate(value=read.value + sd, low=read.low, high=max(read.high, read.value + sd))
    scale = np.float32((noisier.value / max(read.value, 1e-9)) ** 2)
    result.append(
        TwinChange(
            name="read noise",
            twin=replace(
                twin,
                noise=replace(twin.noise, read_noise_DN=noisier),
                maps=replace(twin.maps, read_variance_DN2=twin.maps.read_variance_DN2 * scale),
            ),
            parameters=None,
            step_sd=1.0,
        )
    )
    white = twin.noise.white_fraction
    result.append(
        TwinChange(
            name="secondary quanta",
            twin=replace(twin, noise=replace(twin.noise, white_fraction=white + 0.01)),
            parameters=None,
            step_sd=1.0,
        )
    )
    return result


def _tail_changes(twin: Twin) -> list[TwinChange]:
    """Steps of what calibration left open of the tail of the spread: its share and its reach."""
    spread = twin.noise.spread
    value = spread.value
    if value.tail_share == 0.0:
        return []
    steps = {}
    for name in ("tail_share", "tail_px"):
        known = spread.intervals.get(name)
        found = 0.0 if known is None else (known.high - known.low) / (2 * 1.959964)
        steps[name] = max(found, SPREAD_SD * getattr(value, name))
    if value.tail_share + steps["tail_share"] > 1.0:  # a step down is as large where nearly all light is in the tail
        steps["tail_share"] = -min(steps["tail_share"], value.tail_share)
    return [
        TwinChange(
            name=f"{name} of the optical spread",
            twin=replace(
                twin,
                noise=replace(
                    twin.noise, spread=replace(spread, value=replace(value, **{name: getattr(value, name) + step}))
                ),
            ),
            parameters=None,
            step_sd=1.0,
        )
        for name, step in steps.items()
    ]


def always_a_little(*, side: int = 1) -> list[Variant]:
    """What most lines have of some effects, at one prior standard deviation: tails of the spread."""
    result = []
    for effect in EFFECTS.values():
        little = effect.always_a_little
        if little is None:
            continue
        some = variants_of(effect, side=side)[0]
        for inner, strength in little.amounts:
            own = {name: value / effect.pixels_per_square(name, side) for name, value in inner.items()}
            label = ", ".join([little.name, *(f"{name} {value:.3g}" for name, value in own.items())])
            parameters = {**some.parameters, **own}
            result.append(replace(some, name=label, parameters=parameters, since="always", strengths=(strength,)))
    return result


def smooth_twin(twin: Twin) -> Twin:
    """The twin with all pixels alike: dark, gain and noise at their medians, no bad pixels.

    The diagnosis takes pixel patterns from the calibrating series themselves, so that an effect which calibration took in
    is taken in by the same arithmetic when it is simulated. Effects that the twin has stay.
    """
    maps = twin.maps
    good = maps.bad_pixels == 0

    def level(image: NDArray[np.floating]) -> NDArray[np.float32]:
        return np.full(maps.shape, float(np.median(image[good])) if good.any() else float(np.median(image)), np.float32)

    flat = np.ones(maps.shape, np.float32)
    return replace(
        twin,
        maps=replace(
            maps,
            dark_DN=level(maps.dark_DN),
            dark_DN_per_ms=level(maps.dark_DN_per_ms),
            gain_relative=flat,
            read_variance_DN2=level(maps.read_variance_DN2),
            bad_pixels=np.zeros(maps.shape, np.uint8),
        ),
        levels=tuple(replace(item, flat_shape=flat) for item in twin.levels),
    )
