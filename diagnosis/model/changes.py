"""What may differ from the base twin: effects with their variants and strengths, and nuisances that are no effect.

A change is anything that the forward model can be asked with: applied effects, other spectral parameters, another
spread or read noise, another thickness. Its response is what the probes would do.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...calibration.spectrum.priors import (
    ATTENUATION_SCALE,
    DEPARTURES,
    PRIORS,
    UNDECLARED_SCINTILLATOR,
    UNDECLARED_THRESHOLD,
    spread_of,
)
from ...generator.effects import EFFECTS, AppliedEffect, Effect
from ...generator.effects.effect import Displacement, Parameter, Placement
from ...generator.line.series_request import SeriesRequest
from ...generator.line.spectral_signal import THRESHOLD
from ...generator.line.twin import Estimate, SpectralPosterior, SpreadEstimate, Twin
from ..arrays import FloatArray, RealArray
from ..probes.probes import ALONG_COLUMNS, ALONG_ROWS
from ..probes.tile_seams import SeenSeams
from ..session.binning import per_bin

_MOST_VARIANTS = 4
_IN_MAPS = ("maps", "maps of beams")  # effects that look otherwise where calibration has seen them
_OBJECTS_ALONE = ("object",)
_ALL_SHIFT = 0.017  # share of a misregistration that may be anything else

# scales of the session that any repeat shows; relative standard deviations unless the name says otherwise
THICKNESS_SD = 0.01  # of a scene's material: what a wedge or slab is known to
ATTENUATION_SD = 0.015  # of a material's attenuation: tables differ by 1-4 %
ATTENUATION_OF_BEAM_SD = 0.004  # the part of that which changes with the tube voltage
LEVEL_OF_BEAM_SD = 0.003  # of the level of a kV and filter
OF_BEAMS_GROWS = 2.0  # how much more beams may differ by, over each further prior sd of the largest departure
LEVEL_OF_SERIES_SD = 0.001  # of the level of one series
GAIN_OF_BEAM_SD = 0.01  # of the gain of a kV and filter
GAIN_EXPONENT_SD = 0.5  # of the power of a pixel's gain with which its quantum noise grows: 1 to 2
POSITION_SD_PX = 0.15  # of a scene against its thickness maps
REGISTERED_SD_PX = 1.0  # of the same before registration looks (`register`): what that finds is in no series' pictures
OUTLINE_SD_PX = 0.1  # of where an object's outline lies: rendering of the pixels that it cuts, true size
MAGNIFICATION_SD = 0.001
# of the variance of edges' blur in all scenes: maps drawn from 2 x 2 points a pixel lack 1/48 px^2 of a pixel's own 1/12, which
# counts as two standard deviations. Maps of single points are found, and have nuisances of their own (`blurred_between_points`)
EDGE_SD_PX2 = 1.0 / 96.0
# of the width of the declared focal spot along either side: IEC 60336 allows half as much again above the nominal value, two
# standard deviations; a point, as simulations may take it, lies two standard deviations of its image's variance below
SPOT_SD = 0.25
ROUGH_FIELDS = 24
BEYOND_SD = 1.0  # beyond a border: 0 a picture that mirrors there, 1 one that goes on as it ends, 2 an edge that runs straight on
ROUGH_SHARE = 0.9  # of the local slope: rendering along an edge, from place to place
SPREAD_SD = 0.05  # of the calibrated optical spread: calibration may have taken in an effect
# of the correlation of neighbours at each lag, the same in all series, and as much again in those of a kV
TEXTURE_SD = 0.003
# of the read noise's correlation at each lag: what an amplifier keeps that settles for three time constants
READ_TEXTURE_SD = 0.05
# always there a little, without being an effect: limits of the catalogue's table; beyond them the effect of that kind begins
SHAPE_SD = 0.0005  # rms over the field of the smooth change of the open field's shape: of a series, and of all since the calibration
SHAPE_ORDER = 4  # of the polynomials that stand for it, each order half as likely as the one of half its number
LINE_NOISE_LIMIT = 0.1  # rms of row and of column offsets over the read noise
READ_NOISE_SD = (
    LINE_NOISE_LIMIT**2
)  # lines of that size add twice it to the variance, and calibration may leave them out
OUTPUT_STEP_LIMIT = 0.0005 / math.sqrt(8.0)  # rms of two of 16 octaves of an output with 1/f noise of 0.05 %
DUST_LIMIT = 0.01  # of the light: a pixel that differs less from its neighbours is no bad one (ASTM E2597)
FEW_BAD_PIXELS, FEW_BAD_SHARE = 2, 2e-4  # pixels that turn bad in a session: two, or that share of a large panel's
# of level and gradient where frames were divided by an open field of another time: output, kV, filters and heel may differ
DIVIDED_LEVEL_SD, DIVIDED_TILT_SD = 0.3, 0.1
KURTOSIS_SD = 0.04  # of the excess kurtosis that all series have in common
UNEVEN_SHARE = 0.3  # of an effect that may be uneven: how much more of it there may be in one part of the panel
CUT_OFF_SHARE = 0.5  # of a step by which lost bits may lower a level
PATTERN_WAVES = 8  # cosine waves along each side of a gain map's smooth change, the long ones the larger
# standard deviations of what pixels change by themselves and of that smooth part, over the strength; of 0.7, 1.4 and 2.8 for the
# smooth part the evidence of sessions of four drawn patterns is highest with 1.4
PATTERN_FINE, PATTERN_SMOOTH = 0.7, 1.4
DARK_SD_DN = 0.25  # of the dark between series: half of the limit
EACH_SCENE = "each scene by itself"  # where an effect acts that displaces each by an amount of its own


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """An effect with its inner parameters fixed."""

    effect: str
    name: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)  # without the strength
    sign: float = 1.0  # of the strength
    since: str = "always"
    low: float  # with high: plausible range of the strength
    high: float
    strengths: tuple[float, ...]  # > 0, ascending, at which the response is computed
    fitted: tuple[Parameter, ...] = ()  # its inner parameters with their ranges here
    refined_from: str | None = None  # name of the variant that was refined to be this one; None: not refined
    series: tuple[str, ...] = ()  # in which it acts, by name; empty: all
    log_prior: float = 0.0  # log probability of that, against one that acts in all
    most: float = math.inf  # strength beyond which there is nothing (a share of 100 %)
    apart: bool = False  # it displaces each scene by an amount of its own, by chance
    beside: AppliedEffect | None = None  # another effect that is there: the response is added to that one's
    course: str = ""  # what the effect is from frame to frame, as `Effect` says; empty: not known

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
        parameters = {**self.parameters, "strength": self.sign * strength}
        return AppliedEffect(id=self.effect, parameters=parameters, since=self.since)


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """A change asked of the forward model."""

    label: str  # effect or nuisance
    twin: Twin
    effects: tuple[AppliedEffect, ...] = ()  # besides those that the twin has
    instead_of: tuple[AppliedEffect, ...] = ()  # effects of the base twin that this one has not
    parameters: FloatArray | None = None  # (parameter,) of the spectrum in place of the best ones
    step_sd: float = 1.0  # size of a nuisance's step in prior standard deviations
    steps: str = ""  # series that a step of the twin moves, "all", "lit" or none

    def touches(self, request: SeriesRequest) -> bool:
        """Whether the change can show in a series."""
        if self.steps == "all" or (self.steps == "lit" and request.beam_on):
            return True
        if any(effect.since == "always" or request.after_calibration for effect in self.instead_of):
            return True
        for effect in self.effects:
            if effect.since == "calibration" and not request.after_calibration:
                continue
            series = EFFECTS[effect.id].shows.series
            if request.kind in series and not (series == _OBJECTS_ALONE and self.only_displaces):
                return True
        return False

    def in_presence_of(self, other: "Change") -> "Change | None":
        """A nuisance's step once effects have been found; None: it is a little of one of these.

        other: the base twin with these effects.
        """
        if {item.id for item in self.effects} & {item.id for item in other.effects}:
            return None
        return replace(
            self,
            twin=replace(self.twin, effects=other.twin.effects),
            effects=(*self.effects, *other.effects),
            instead_of=other.instead_of,
        )

    @property
    def only_displaces(self) -> bool:
        """Whether the change is a mere shift of the scene, which registration takes out of the pictures."""
        return len(self.effects) == 1 and self._misplaced is not None and self._misplaced.only_shifts

    @property
    def displacement(self) -> dict[str, float]:
        """Displacement (px) that the change brings to a scene's picture, by probe; empty: none."""
        if self._misplaced is None:
            return {}
        lies = self._misplaced.lies
        angle = math.radians(lies.direction_deg)
        return {ALONG_ROWS: lies.shift_px * math.cos(angle), ALONG_COLUMNS: lies.shift_px * math.sin(angle)}

    def found_in_place(self) -> "Change":
        """The change as it shows once registration has found the scene: of a misregistration, what is no shift."""
        misplaced = self._misplaced
        if misplaced is None or self.only_displaces:
            return self
        effect = misplaced.effect
        others = [item for item in self.effects if item is not effect]
        if misplaced.only_shifts:
            return replace(self, effects=tuple(others))
        rest = misplaced.placement.without_shift(effect.parameters)
        return replace(self, effects=(*others, replace(effect, parameters=rest)))

    @property
    def _misplaced(self) -> "_Misplaced | None":
        for effect in self.effects:
            placement = EFFECTS[effect.id].placement
            if placement is not None:
                return _Misplaced(effect, placement, placement.parts(effect.parameters))
        return None

    def whenever_it_began(self, request: SeriesRequest) -> object | None:
        """What stands for a change of a series that the same effect, begun at another time, makes as well; None: only itself."""
        if (
            self.instead_of
            or self.steps
            or len(self.effects) != 1
            or EFFECTS[self.effects[0].id].absorbed in _IN_MAPS
            or not self.touches(request)
        ):
            return None
        effect = self.effects[0]
        long_ago = request.long_ago if EFFECTS[effect.id].remembers_all else ()
        if effect.since == "always" and any(not item.after_calibration for item in (*long_ago, *request.previous)):
            return None  # what was exposed before calibration ended remembers when it began
        return (effect.id, tuple(effect.parameters.items()), tuple(effect.options.items()))


@dataclass(frozen=True, slots=True)
class _Misplaced:
    """An effect that displaces scenes, and how they lie with it."""

    effect: AppliedEffect
    placement: Placement
    lies: Displacement

    @property
    def only_shifts(self) -> bool:
        return math.hypot(self.lies.radial_px, self.lies.turn_px) <= _ALL_SHIFT * self.lies.size_px


def variants_of(effect: Effect, *, side: int = 1) -> list[Variant]:
    """The variants of an effect that compete: ends and middle of each inner parameter, both signs, both onsets.

    side: of the squares of the panel's pixels that frames have for pixels. What calibration takes in whole (a constant kV offset,
    filtration, gain map, more noise) is tried as setting in after it; what acts on objects alone is the same either way.
    """
    strength, *others = (per_bin(item, side) for item in effect.parameters)
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
            quarters = range(4) if item.is_angle else (1, 3)
            values = [item.low + span * k / 4 for k in quarters]
        grown = [{**choice, item.name: value} for choice in choices for value in values]
        choices = grown if len(grown) <= _MOST_VARIANTS else [{**c, item.name: item.default} for c in choices]
    if effect.grid.variants:
        choices = [
            {item.name: item.default for item in inner}
            | {name: value / effect.pixels_per_bin(name, side) for name, value in choice.items()}
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
                grown = [
                    replace(
                        one,
                        name=f"{one.name}, {item.name} {value:g}",
                        parameters={**one.parameters, item.name: value},
                        fitted=(*one.fitted, item),
                    )
                    for one in grown
                    for value in item.tried_without_times
                ]
        result += grown
    return result


def with_seams(variants: Sequence[Variant], seen: SeenSeams | None) -> list[Variant]:
    """The variants for a session whose later flats show these seams, where tiles meet; None: no flat can show any.

    Without seams there are no gains of tiles.
    """
    result = []
    for variant in variants:
        if EFFECTS[variant.effect].variation.random != "tiles":
            result.append(variant)
        elif seen is None:
            result.append(replace(variant, parameters={**variant.parameters, "rows_px": 0.0, "columns_px": 0.0}))
        elif seen.any:
            places = {"rows_px": seen.rows.side_px, "first_rows_px": seen.rows.first_px}
            places |= {"columns_px": seen.columns.side_px, "first_columns_px": seen.columns.first_px}
            result.append(replace(variant, parameters={**variant.parameters, **places}, log_prior=seen.log_prior))
    return result


def catalogue_variants(*, without: Sequence[str] = (), side: int = 1) -> list[Variant]:
    """The variants of the whole catalogue, less the effects in `without`; side as in `variants_of`."""
    kept = (effect for name, effect in EFFECTS.items() if name not in without)
    return [variant for effect in kept for variant in variants_of(effect, side=side)]


def spectral_sds(posterior: SpectralPosterior) -> FloatArray:
    """Standard deviations (parameter,) that spectral parameters are taken to have before a session is seen.

    They are those that calibration started from, not its posterior's: the calibrating series are among the probes and say again
    what they know.
    """
    result = []
    for name in posterior.names:
        sd = spread_of(PRIORS.get(name, ATTENUATION_SCALE))
        if posterior.prior.get(name) == str(UNDECLARED_SCINTILLATOR):
            sd = UNDECLARED_SCINTILLATOR.sd
        if name == THRESHOLD:
            sd = UNDECLARED_THRESHOLD.spread
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


def twin_changes(twin: Twin, *, spectral_steps: float = 1.0) -> list[Change]:
    """Steps in what calibration has fitted, each with the step's size in prior standard deviations (`spectral_sds`).

    spectral_steps: size of a step over the posterior's standard deviation.
    """
    noise, spread, read = twin.noise, twin.noise.spread, twin.noise.read_noise_DN

    def stepped(label: str, *, step_sd: float = 1.0, **changed: Any) -> Change:
        return Change(label=label, twin=replace(twin, noise=replace(noise, **changed)), step_sd=step_sd, steps="all")

    def with_spread(**changed: Any) -> SpreadEstimate:
        return replace(spread, value=replace(spread.value, **changed))

    width_sd = max(SPREAD_SD * spread.value.sigma_px, _known_sd(spread, "sigma_px"), 0.01)
    read_sd = max(READ_NOISE_SD * read.value, read.sd, 1e-3)
    noisier = Estimate(value=read.value + read_sd, low=read.low, high=max(read.high, read.value + read_sd))
    more_read_noise = stepped("read noise", read_noise_DN=noisier)
    variance_DN2 = twin.maps.read_variance_DN2 * np.float32((noisier.value / max(read.value, 1e-9)) ** 2)
    maps = replace(twin.maps, read_variance_DN2=variance_DN2)
    return [
        *_spectral_changes(twin, spectral_steps),
        stepped("optical spread", step_sd=0.5, spread=with_spread(sigma_px=spread.value.sigma_px + 0.5 * width_sd)),
        *(
            stepped(f"{name} of the optical spread", spread=with_spread(**{name: value}))
            for name, value in _stepped_tail(spread).items()
        ),
        *(
            # taken whole it costs ln(1 / p), as in a mixture; a standard deviation is no more than the whole
            stepped(
                f"optical spread as {other.family}",
                step_sd=math.sqrt(max(-2.0 * math.log(other.probability), 1.0)),
                spread=replace(spread, value=other.value),
            )
            for other in spread.others
        ),
        replace(more_read_noise, twin=replace(more_read_noise.twin, maps=maps)),
        stepped("secondary quanta", white_fraction=noise.white_fraction + 0.01),
    ]


def _spectral_changes(twin: Twin, steps: float) -> list[Change]:
    """Steps of the spectral parameters up; steps: see `twin_changes`."""
    posterior = twin.spectral
    if posterior is None:
        return []
    result = []
    draws = posterior.samples.std(axis=0)
    for index, (name, sd) in enumerate(zip(posterior.names, spectral_sds(posterior), strict=True)):
        step = min(max(steps * float(draws[index]), 0.05 * sd), sd)
        parameters = np.array(posterior.best, dtype=np.float64)
        parameters[index] += step
        result.append(Change(label=name, twin=twin, parameters=parameters, step_sd=step / sd, steps="lit"))
    return result


def _known_sd(spread: SpreadEstimate, name: str) -> float:
    """Standard deviation to which calibration knows a parameter of the spread, 0 where it was not asked."""
    known = spread.intervals.get(name)
    return 0.0 if known is None else known.sd


def _stepped_tail(spread: SpreadEstimate) -> dict[str, float]:
    """What calibration left open of the tail of the spread, its share and its reach, each a standard deviation further."""
    value = spread.value
    if value.tail_share == 0.0:
        return {}
    share, reach = (
        max(_known_sd(spread, name), SPREAD_SD * getattr(value, name)) for name in ("tail_share", "tail_px")
    )
    if value.tail_share + share > 1.0:  # a step down is as large where nearly all light is in the tail
        share = -min(share, value.tail_share)
    return {"tail_share": value.tail_share + share, "tail_px": value.tail_px + reach}


def always_a_little(*, side: int = 1) -> list[Variant]:
    """What most lines have of some effects, at one prior standard deviation: tails of the spread."""
    result = []
    for effect in EFFECTS.values():
        if (little := effect.always_a_little) is None:
            continue
        some = variants_of(effect, side=side)[0]
        for inner, strength in little.amounts:
            own = {name: value / effect.pixels_per_bin(name, side) for name, value in inner.items()}
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

    def level(image: RealArray) -> NDArray[np.float32]:
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
