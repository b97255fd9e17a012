"""What an effect declares: all that the forward model, images, the diagnosis and its plans need to know of it.

One effect is one `Effect` in one file of this folder. Readers ask its fields; no table elsewhere is kept by effect.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches

from ...errors import InputError
from ..line.line_state import STAGES, Change
from ..line.series_request import KINDS, SeriesRequest
from ..line.twin import Twin

EVERY_SERIES = KINDS
LIT_SERIES = ("flat", "object")
# of a diagnosis' answer
AXES = ("level", "noise", "sharpness", "texture", "time", "position", "energy", "tails", "task")
OF_FRAMES = ("noise", "texture", "time")  # axes of what frames of a series differ by

COURSES = ("", "steady", "random")  # of an effect over the frames of one setting and scene
ABSORBED = {
    "nothing": "a flat that calibrated shows it as any other flat does",
    "numbers": "level, gain or spectrum hold it whole: a constant one is no gap",
    "noise": "spread, photon-transfer slope and read noise hold it: flats stay as calibrated",
    "maps": "the maps of the pixels hold it",
    "maps of beams": "the shape of each beam's flat holds it",
}
RANDOM = {
    "nothing": "all of it follows from its parameters",
    "sides": "more of it on one side of the panel than on the other",
    "places": "more of it in one place of the panel than in another",
    "surroundings": "what stands beyond the borders of the picture, from where it brings light in",
    "offset": "lost bits may be cut off or rounded away: half a step on every level",
    "pixels": "a pattern from pixel to pixel or from column to column, a part of it smooth",
    "tiles": "a gain of each tile, with seams where later flats have them",
    "lines": "means of the lines of a few frames",
    "lines of light": "the same, in proportion to their light",
    "output": "level and trend of each lit series",
}
_ASKED_OF_RANDOM = {  # parameters
    "pixels": ("correlation_px", "of_columns"),
    "lines": ("column_share", "together_lines"),
    "lines of light": ("column_share", "together_lines"),
    "tiles": ("rows_px", "columns_px", "first_rows_px", "first_columns_px"),
    "output": ("correlation_s", "jitter_share"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """A parameter of an effect.

    Fields: name; unit (empty: none); low, high (plausible range of its size); default; source (of the range); log
    (fitted in its logarithm); signed (may be negative with the same size); fitted (False: states a condition of the
    session, such as its length, and is not estimated); fitted_if_later (estimated where the effect came after the calibration);
    sought_last (a shape that can stand for another parameter's size far off: sought once these are found);
    tried_without_times (values from which it is estimated where a session does not state its pauses); pixel_power: a number
    found in squares of n x n pixels times n to this power is that of pixels (1: a length in pixels); most: beyond which there is
    nothing (100 % of the pixels).
    """

    name: str
    unit: str
    low: float
    high: float
    default: float
    source: str
    log: bool
    signed: bool = False
    fitted: bool = True
    fitted_if_later: bool = False
    sought_last: bool = False
    tried_without_times: tuple[float, ...] = ()
    pixel_power: float = 0.0
    most: float = math.inf

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and self.low <= self.default <= self.high and math.isfinite(self.high)):
            raise InputError(
                f"parameter {self.name}",
                received=f"{self.low} to {self.high}, default {self.default}",
                expected="low <= default <= high, finite",
            )
        if self.log and not (self.low > 0 and not self.signed):
            raise InputError(f"parameter {self.name}", received=self.low, expected="above 0 and unsigned, for log")

    @property
    def is_angle(self) -> bool:
        """Whether it is an angle."""
        return self.unit == "deg"

    @property
    def goes_round(self) -> bool:
        """Whether it is a direction of all round, whose ends meet."""
        return self.is_angle and self.high - self.low >= 360.0

    def pixels_per_bin(self, side: int) -> float:
        """By what a number found in squares of side x side pixels is multiplied to be that of pixels."""
        share: float = float(side) ** abs(self.pixel_power)
        return share if self.pixel_power >= 0.0 else 1.0 / share


def seed_of(what: str) -> Parameter:
    """The parameter `pattern_seed`, which draws what an effect does to each pixel or tile: a condition of the session."""
    return Parameter(
        name="pattern_seed",
        unit="",
        low=0.0,
        high=2.0**31,
        default=0.0,
        source=f"draws {what}",
        log=False,
        fitted=False,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Shows:
    """Where an effect, or what is wrong with its law, can show.

    Fields: series: kinds of series that it can move; axis: of the answer, under which pictures like its own are listed; flats
    (False: it leaves the detector-median level and noise of a flat alone).
    """

    series: tuple[str, ...]
    axis: str
    flats: bool = True

    def __post_init__(self) -> None:
        if not self.series or not set(self.series) <= set(KINDS):
            raise InputError("series of an effect", received=self.series, expected="some of " + ", ".join(KINDS))
        if self.axis not in AXES:
            raise InputError("axis of an effect", received=self.axis, expected="one of " + ", ".join(AXES))


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """How the strength is read from a session.

    Fields: law_sd: relative standard deviation of strengths found by the fit, as lines depart from the law; probes: those that the
    strength is defined by, where no law can be far off; sd: relative, of a strength read from these alone (None: it is fitted; 0:
    no other effect makes any of them); frame_levels (it is the rms of the frames' levels); map_rms (it is the rms over the pixels of
    what changed in later flats); last_dark (it is the level of the last dark of the longest exposure).
    """

    law_sd: float = 0.12
    probes: tuple[str, ...] = ()
    sd: float | None = None
    frame_levels: bool = False
    map_rms: bool = False
    last_dark: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """Where the diagnosis asks the law before it refines.

    Fields: shares: of the way up the strength's plausible range, in the logarithm (one: in proportion to the strength); variants:
    inner parameters to start from, others at their default (empty: a quarter and three quarters of each range); refined (False: the
    inner parameters stay those of the grid).
    """

    shares: tuple[float, ...] = (0.2, 0.7, 1.0)
    variants: tuple[Mapping[str, float], ...] = ()
    refined: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Variation:
    """How laws of an effect's kind may differ from line to line, and what about it is random.

    Fields: random (one of RANDOM).
    """

    random: str = "nothing"

    def __post_init__(self) -> None:
        if self.random not in RANDOM:
            raise InputError("random part of an effect", received=self.random, expected="one of " + ", ".join(RANDOM))


@dataclass(frozen=True, slots=True, kw_only=True)
class InImages:
    """What single images hold of an effect.

    Fields: left_out: why images have nothing of it; not_in_references: why images made from references have not.
    """

    left_out: str = ""
    not_in_references: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlwaysALittle:
    """What most lines have of an effect, and calibration takes for its own: a nuisance, no effect.

    amounts: inner parameters, and the strength of one prior standard deviation with these.
    """

    name: str
    amounts: tuple[tuple[Mapping[str, float], float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Displacement:
    """How a scene lies against its thickness maps, px: rms size; shift and its direction; rms of enlargement and of turn."""

    size_px: float
    shift_px: float
    direction_deg: float
    radial_px: float
    turn_px: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Of an effect that displaces scenes, whose shifts registration finds.

    Fields: parts: parameters -> displacement; without_shift: parameters -> those of what is no shift; combined: (parameters,
    parameters) -> those that shift as the first and enlarge and turn as the second.
    """

    parts: Callable[[Mapping[str, float]], Displacement]
    without_shift: Callable[[Mapping[str, float]], dict[str, float]]
    combined: Callable[[Mapping[str, float], Mapping[str, float]], dict[str, float]]


# (parameters, series, twin) -> px along rows and along columns
MeanShift = Callable[[Mapping[str, float], SeriesRequest, Twin], tuple[float, float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """An effect that a real line may have and the base model has not.

    Fields:
        id, title; law: the equation, LaTeX; reference: source of the model; isolated_by: the measurement that shows it by itself.
        parameters: the first is the strength.
        stage: where in the line it acts, see line_state; timed: before the exposure, but it depends on how long that takes.
        change: (state, parameters, context) -> state, which is no change at strength 0.
        needs: what must be known of instrument or series: `source_object_mm`, `source_detector_mm`, `pixel_mm`, `spectral`, `scene`,
            `counting` (a photon counter).
        remembers_all: light of all earlier series acts, not that of the last ones alone.
        course: `steady`: it does the same to every frame of one setting and scene, so that what it changes of their noise follows
            from what it changes of their mean; `random`: something new to every frame, and nothing to their mean; empty: neither.
        pattern: all that it does, whatever its law, is a factor to the light of each pixel, the same in every frame.
        options: words that an applied effect may carry, with what they mean.
        after_calibration: usual onset: True, it set in after the calibration series; False, it was always there; either_onset: the
            diagnosis tries both. in_some_series: it may act in some series only, such as those on a moving belt.
        absorbed: one of ABSORBED: what calibration takes in of one that was always there.
        shows, reading, grid, variation, images: see there.
        lost_by_binning: why it cannot be seen in squares of pixels; empty: it can.
        always_a_little: what most lines have of it, if any; placement: of one that displaces scenes; mean_shift: of one that does
            other things to a scene, how far it displaces that on average, which registration finds.
        worked_in: (twin, strength) -> the twin whose own numbers are those of a line with it, and warnings; None: it stays an effect.
    """

    id: str
    title: str
    law: str
    parameters: tuple[Parameter, ...]
    stage: str
    reference: str
    isolated_by: str
    shows: Shows
    after_calibration: bool
    absorbed: str
    change: Change = field(repr=False)
    either_onset: bool = False
    in_some_series: bool = False
    needs: tuple[str, ...] = ()
    options: Mapping[str, str] = field(default_factory=dict)
    timed: bool = False
    remembers_all: bool = False
    course: str = ""
    pattern: bool = False
    reading: Reading = Reading()
    grid: Grid = Grid()
    variation: Variation = Variation()
    images: InImages = InImages()
    lost_by_binning: str = ""
    always_a_little: AlwaysALittle | None = None
    placement: Placement | None = field(default=None, repr=False)
    mean_shift: MeanShift | None = field(default=None, repr=False)
    worked_in: Callable[[Twin, float], tuple[Twin, list[str]]] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.stage not in STAGES:
            raise InputError(f"effect {self.id}, stage", received=self.stage, expected="one of " + ", ".join(STAGES))
        if self.absorbed not in ABSORBED:
            raise InputError(
                f"effect {self.id}, absorbed", received=self.absorbed, expected="one of " + ", ".join(ABSORBED)
            )
        if self.course not in COURSES:
            raise InputError(f"effect {self.id}, course", received=self.course, expected=" or ".join(COURSES[1:]))
        if not self.parameters or self.parameters[0].name != "strength":
            raise InputError(f"effect {self.id}", received="no strength", expected="strength as first parameter")
        known = [item.name for item in self.parameters]
        missing = [name for name in _ASKED_OF_RANDOM.get(self.variation.random, ()) if name not in known]
        if missing:
            raise InputError(
                f"effect {self.id}, random part {self.variation.random}",
                received=f"no parameter {missing[0]}",
                expected="parameters " + ", ".join(_ASKED_OF_RANDOM[self.variation.random]),
            )
        unknown = [name for choice in self.grid.variants for name in choice if name not in known]
        if unknown:
            raise InputError(
                f"effect {self.id}, variants", received=unknown[0], expected="parameters: " + ", ".join(known)
            )

    @property
    def strength(self) -> Parameter:
        """The parameter that reports quote."""
        return self.parameters[0]

    @property
    def drawn_in_full(self) -> bool:
        """Whether it is a pattern whose every form is drawn by chance: its law can be off by no more than another pattern."""
        return self.pattern and self.variation.random in ("pixels", "tiles")

    def may_leave(self, other: "Effect") -> bool:
        """Whether its law, off as it may be, can look like another effect where it acts."""
        return not self.drawn_in_full or other.pattern

    def reaches(self, kind: str, axis: str) -> bool:
        """Whether it, or what is wrong with its law, can show in an axis of series of a kind (empty: of several)."""
        # a factor that is the same in every frame changes the size of what they differ by, and neither its texture nor its course
        same = self.drawn_in_full and axis in ("texture", "time")
        return (not kind or kind in self.shows.series) and not same

    @property
    def usual_onset(self) -> str:
        """`calibration` (it came after it) or `always`."""
        return "calibration" if self.after_calibration else "always"

    @property
    def onsets(self) -> tuple[str, ...]:
        """Onsets that the diagnosis tries."""
        return ("always", "calibration") if self.either_onset else (self.usual_onset,)

    def pixels_per_bin(self, name: str, side: int) -> float:
        """By what a parameter found in squares of side x side pixels is multiplied to be that of pixels; 1 for others' names."""
        return next((item.pixels_per_bin(side) for item in self.parameters if item.name == name), 1.0)

    def values(self, parameters: Mapping[str, float]) -> dict[str, float]:
        """All parameters by name; what is not given takes its default.

        Raises:
            InputError: a parameter that this effect has not, or a value that is not finite, or 0 or less of a length, time or energy.
        """
        result = {item.name: item.default for item in self.parameters}
        above_0 = {item.name for item in self.parameters[1:] if item.log}
        for name, value in parameters.items():
            if name not in result:
                near = get_close_matches(name, result, n=1, cutoff=0.0)
                raise InputError(
                    f"parameter of effect {self.id}",
                    received=name,
                    expected="one of " + ", ".join(result),
                    remedy=f"did you mean {near[0]}?" if near else "",
                )
            if not math.isfinite(value):
                raise InputError(f"{name} of effect {self.id}", received=value, expected="a finite number")
            if name in above_0 and value <= 0.0:
                raise InputError(f"{name} of effect {self.id}", received=value, expected="a number above 0")
            result[name] = float(value)
        return result
