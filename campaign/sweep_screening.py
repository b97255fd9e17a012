"""Which settings of a sweep are trained when a model observer looks at all of them first.

The observer (observers/) says what a90 networks would have at every setting, with an interval. It is calibrated on the first settings
that were trained, or comes calibrated. A setting is decided, and not trained, where the chance that training it would change the
recommendation is below 5 %:

    worse     its a90 is smaller than that of the best trained setting (without a goal, or where none reaches it)
    misses    its a90 is smaller than the goal
    slower    never asked: one that is trained reaches the goal, and is faster, or as fast at a lower dose

ln a90 of a setting is taken as normal: the observer's mean and interval, together with the networks' own a90 where they were trained.
What is trained next depends on finished rows alone, so that the answer has the same bytes whatever the number of workers.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..acquisition.setting import Setting, setting_from_text
from ..errors import FitError, InputError
from ..generator.line.twin import Z95
from ..generator.twins.twin_io import read_twin
from .sweep_choice import paces, takes_part
from .sweep_file import Campaign, Pair, Screening
from .sweep_settings import Outlook, open_references

if TYPE_CHECKING:
    from ..observers import Efficiency, ForeignObjects, Observer, ProductTexture

SMALLEST_CHANCE = 0.05
_WORTH_CALIBRATING = 0.7  # of the largest object: networks whose a90 is near it have none as often as not
_UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True, kw_only=True)
class Expected:
    """a90 that networks would have at a setting, with its 95 % interval."""

    value: float
    low: float
    high: float

    @property
    def log_sd(self) -> float:
        """Standard deviation of ln a90 that the interval stands for."""
        return math.log(self.high / self.low) / (2.0 * Z95)

    def as_dict(self) -> dict[str, float]:
        """Value, low and high."""
        return {"value": self.value, "low": self.low, "high": self.high}


@dataclass(frozen=True, slots=True, kw_only=True)
class Decided:
    """What is known of a setting that was not trained.

    Fields: kind (`undecided`, `worse`, `misses`, `slower`); chance that it is better than the best, or reaches the goal (None: not
    asked).
    """

    kind: str
    chance: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A setting as the decision sees it: its row (finished, or of the outlook), whether it was trained, what the observer expects."""

    row: Mapping[str, Any]
    trained: bool
    expected: Expected | None


def decide_candidates(
    candidates: Mapping[str, Candidate], *, goal: float | None, most_false_alarms: float | None
) -> dict[str, Decided]:
    """What is decided of every candidate that was not trained, by its text; see the module."""
    order = _order(candidates)
    open_ones = {text: one for text, one in candidates.items() if not one.trained}
    if goal is not None:
        reached = [
            text
            for text, one in candidates.items()
            if one.trained and takes_part(one.row, most_false_alarms) and (one.row["a90_upper"] or math.inf) <= goal
        ]
        chances = {text: _chance_below(one.expected, math.log(goal), 0.0) for text, one in open_ones.items()}
        found = {
            text: Decided(kind=_UNDECIDED if chance >= SMALLEST_CHANCE else "misses", chance=chance)
            for text, chance in chances.items()
        }
        if reached:
            taken = min(reached, key=lambda text: order[text])
            return {
                text: Decided(kind="slower") if order[text] > order[taken] and one.kind == _UNDECIDED else one
                for text, one in found.items()
            }
        if any(one.kind == _UNDECIDED for one in found.values()):
            return found
    best = [_best_of(one) for one in candidates.values() if one.trained and takes_part(one.row, most_false_alarms)]
    if not best:
        return {text: Decided(kind=_UNDECIDED) for text in open_ones}
    mean, sd = min(best)
    chances = {text: _chance_below(one.expected, mean, sd) for text, one in open_ones.items()}
    return {
        text: Decided(kind=_UNDECIDED if chance >= SMALLEST_CHANCE else "worse", chance=chance)
        for text, chance in chances.items()
    }


def next_to_train(
    candidates: Mapping[str, Candidate], decided: Mapping[str, Decided], *, goal: float | None, count: int
) -> list[str]:
    """Texts of the undecided settings that are trained next: the likeliest without a goal; with one the fastest likely ones."""
    order = _order(candidates)

    def rank(text: str) -> tuple[Any, ...]:
        one, expected = decided[text], candidates[text].expected
        chance = one.chance if one.chance is not None else 0.5
        size = expected.value if expected is not None else math.inf
        return (chance < 0.5, order[text]) if goal is not None else (-chance, size, order[text])

    return sorted((text for text, one in decided.items() if one.kind == _UNDECIDED), key=rank)[:count]


def first_to_train(sizes: Mapping[str, float], *, count: int, largest: float) -> list[str]:
    """Texts of the settings that an observer is calibrated on: evenly over the order of their a90, the smallest among them.

    Args:
        sizes: a90 of an observer that is not calibrated, by text; NaN where it has none.
        count: how many.
        largest: size of the largest object; settings near it come last.
    """
    known = sorted((size, text) for text, size in sizes.items() if math.isfinite(size))
    clear = [text for size, text in known if size <= _WORTH_CALIBRATING * largest]
    rest = [text for _, text in known if text not in set(clear)]
    rest += sorted(text for text, size in sizes.items() if not math.isfinite(size))
    if len(clear) <= count:
        return [*clear, *rest][:count]
    places = np.linspace(0, len(clear) - 1, count).round().astype(int)
    return [clear[place] for place in places]


def _order(candidates: Mapping[str, Candidate]) -> dict[str, tuple[float, float, str]]:
    """How settings that reach the goal are preferred: faster, then of less dose, then by their text."""
    pace = paces([{**one.row, "a90": 1.0} for one in candidates.values()])
    found = {}
    for (text, one), fast in zip(candidates.items(), pace, strict=True):
        dose = one.row.get("dose_uGy")
        found[text] = (-fast, math.inf if dose is None else float(dose["value"]), text)
    return found


def _chance_below(expected: Expected | None, mean: float, sd: float) -> float:
    """Chance that ln a90 lies below a normal of this mean and deviation; one half where nothing is expected."""
    from scipy.special import ndtr

    if expected is None:
        return 0.5
    spread = max(math.hypot(expected.log_sd, sd), 1e-9)
    return float(ndtr((mean - math.log(expected.value)) / spread))


def _best_of(one: Candidate) -> tuple[float, float]:
    """Mean and deviation of ln a90 of a trained setting: its networks' and what the observer expects, weighed by their errors."""
    row = one.row
    mean, deviation = math.log(row["a90"]), _log_sd(row)
    if one.expected is None:
        return mean, deviation or 0.0
    expected, sd = math.log(one.expected.value), max(one.expected.log_sd, 1e-9)
    if deviation is None:
        return expected, sd
    weight = 1.0 / deviation**2, 1.0 / sd**2
    return (mean * weight[0] + expected * weight[1]) / sum(weight), 1.0 / math.sqrt(sum(weight))


def _log_sd(row: Mapping[str, Any]) -> float | None:
    from ..observers import MeasuredSize

    ends = {end: row[f"a90_{end}"] for end in ("low", "high")}
    return MeasuredSize(pair=pair_of_row(row), a90=float(row["a90"]), **ends).log_sd


def pair_of_row(row: Mapping[str, Any]) -> Pair:
    """The settings of a row."""
    return setting_from_text(row["low"]), setting_from_text(row["high"])


# ---------------------------------------------------------------------------------------------------- the observer of a sweep


class Screen:
    """The observer of a sweep: what it expects at each setting, calibrated anew when more of them are trained.

    Args:
        campaign: without a table [screening] as with an empty one.
        tests: dataset of the references that networks are tried on.
        outlooks: of every setting.

    Raises:
        InputError: a twin without a spectral part, references that an observer cannot read, an observer of another size or of
            other materials.
    """

    def __init__(self, campaign: Campaign, tests: Path, outlooks: Sequence[Outlook]) -> None:
        from ..observers import LineImages, Observer, check_materials, read_efficiency, sight_of_references

        screening = campaign.screening or Screening()
        self.campaign, self._screening = campaign, screening
        self.first_count = 0
        self.efficiency: Efficiency | None = None
        self.why_none = ""
        if screening.observer is not None:
            self.efficiency = read_efficiency(screening.observer)
            if self.efficiency.size_name != campaign.curve.size:
                raise InputError(
                    str(screening.observer),
                    received=f"an observer calibrated for {self.efficiency.size_name}",
                    expected=f"one for {campaign.curve.size}, the size of this campaign",
                )
            check_materials(
                self.efficiency,
                product_material=campaign.product_material,
                foreign_material=campaign.foreign_material,
            )
        calibrated = None if self.efficiency is None else self.efficiency.observer
        detector = screening.detector if calibrated is None else calibrated.detector
        self.line: LineImages = LineImages(read_twin(campaign.twin))
        with open_references(tests, "references") as dataset:
            sight = sight_of_references(
                self.line,
                dataset,
                product_material=campaign.product_material,
                foreign_material=campaign.foreign_material,
                size=campaign.curve.size,
                detector=detector,
                image=screening.image if calibrated is None else calibrated.image,
                fallback=campaign.reference_setting,
            )
        self._observer: Observer = calibrated or Observer(
            detector=detector, image=sight.image, false_alarm_rate=campaign.trying.marked_share
        )
        objects = sight.objects
        self.objects: ForeignObjects = objects
        self.texture: ProductTexture | None = sight.texture
        self.largest = float(objects.size.max())
        own = self.line.twin.instrument.source_detector_mm
        pairs = {
            one.text: (_at_own_distance(one.pair[0], own), _at_own_distance(one.pair[1], own))
            for one in outlooks
            if one.feasible and all(setting.binning == 1 for setting in one.pair)
        }
        against = self.line.reasons_against(list(pairs.values()), objects, image=sight.image)
        self._pairs = {text: pair for (text, pair), reason in zip(pairs.items(), against, strict=True) if not reason}
        self.kept = [one.text for one in outlooks if one.kept]
        self._sizes: dict[str, float] = {}

    @property
    def observer(self) -> "Observer":
        """Who looks, calibrated where that could be done."""
        return self._observer if self.efficiency is None else self.efficiency.observer

    def first(self) -> list[str]:
        """Settings to train first; none where the observer comes calibrated."""
        if self.efficiency is not None:
            return []
        from ..observers import observe_settings

        texts = [text for text in self.kept if text in self._pairs]
        if texts:
            pairs = [self._pairs[text] for text in texts]
            found = observe_settings(self.line, pairs, self.objects, observer=self._observer, texture=self.texture)
            self._sizes = dict(zip(texts, found.a90_of_curve.tolist(), strict=True))
        sizes = {text: self._sizes.get(text, math.nan) for text in self.kept}
        return first_to_train(sizes, count=min(self._screening.train_first, len(sizes)), largest=self.largest)

    def calibrate(self, rows: Mapping[str, Mapping[str, Any]]) -> None:
        """Bring the observer to the networks of all rows that have an a90; a calibrated one that came as a file stays."""
        from ..observers import MeasuredSize, fit_efficiency

        if self._screening.observer is not None:
            return
        measured = [
            MeasuredSize(pair=self._pairs[text], a90=row["a90"], low=row["a90_low"], high=row["a90_high"])
            for text, row in rows.items()
            if row["a90"] is not None and text in self._pairs
        ]
        try:
            self.efficiency = fit_efficiency(
                self.line, measured, self.objects, observer=self._observer, texture=self.texture
            )
        except (InputError, FitError) as error:
            self.efficiency, self.why_none = None, str(error)

    def expected(self) -> dict[str, Expected]:
        """What is expected at every feasible setting that the observer can see; nothing while it is not calibrated."""
        from ..observers import predicted_sizes

        if self.efficiency is None:
            return {}
        sizes = predicted_sizes(
            self.line, list(self._pairs.values()), self.objects, self.efficiency, texture=self.texture
        )
        found = {}
        for text, *ends in zip(self._pairs, sizes.a90, sizes.low, sizes.high, strict=True):
            if all(math.isfinite(end) and end > 0 for end in ends):
                found[text] = Expected(value=float(ends[0]), low=float(ends[1]), high=float(ends[2]))
        return found

    def changes(self) -> dict[str, dict[str, float]]:
        """What changes of each setting would do to its a90, as factors by the change's name; for every feasible setting's text."""
        from ..observers import factors_of_changes

        if not self._pairs:
            return {}
        factors = factors_of_changes(
            self.line, list(self._pairs.values()), self.objects, observer=self.observer, texture=self.texture
        )
        return {
            text: {name: float(values[number]) for name, values in factors.items() if math.isfinite(values[number])}
            for number, text in enumerate(self._pairs)
        }

    def candidates(
        self, rows: Mapping[str, Mapping[str, Any]], asked: Sequence[str], expected: Mapping[str, Expected]
    ) -> dict[str, Candidate]:
        """All settings that may be trained, with their rows."""
        done = set(asked)
        return {
            text: Candidate(row=rows[text], trained=text in done, expected=expected.get(text)) for text in self.kept
        }

    def next(self, rows: Mapping[str, Mapping[str, Any]], asked: Sequence[str]) -> list[str]:
        """Settings to train next, given the rows of those that were asked for; none: all are decided, or enough are trained."""
        campaign, screening = self.campaign, self._screening
        room = len(self.kept) if screening.most is None else screening.most
        if not asked and (first := self.first()):
            self.first_count = len(first[:room])
            return first[:room]
        self.calibrate({text: rows[text] for text in asked})
        room -= len(asked)
        if room <= 0:
            return []
        if self.efficiency is None:
            left = [text for text in self.kept if text not in set(asked)]
            left.sort(key=lambda text: (_or_last(self._sizes.get(text)), text))
            return left[: min(room, screening.round)]
        candidates = self.candidates(rows, asked, self.expected())
        decided = decide_candidates(candidates, goal=campaign.goal, most_false_alarms=campaign.most_false_alarms)
        return next_to_train(candidates, decided, goal=campaign.goal, count=min(room, screening.round))


@dataclass(frozen=True, slots=True, kw_only=True)
class Screened:
    """A sweep's screening. Fields: screen (its observer as calibrated last); answer (what sweep.json says of it)."""

    screen: Screen
    answer: Mapping[str, Any]

    @property
    def sentence(self) -> str:
        """How many settings were trained, and what became of the others, in words."""
        trained, decided, left = (self.answer[name] for name in ("trained", "screened", "undecided"))
        text = f"{trained} settings were trained; the observer decided {decided} without training"
        return f"{text}." if not left else f"{text} and left {left} undecided."


def outlooks_of_rows(rows: Sequence[Mapping[str, Any]]) -> list[Outlook]:
    """Rows as an observer asks for them: settings that can be, and whether they were trained."""
    return [
        Outlook(pair=pair_of_row(row), reason="" if row["feasible"] else str(row["reason"]), kept=bool(row["trained"]))
        for row in rows
    ]


def plan_warnings(campaign: Campaign, outlooks: Sequence[Outlook]) -> tuple[str, ...]:
    """Why no observer can be calibrated, as far as it is known before training."""
    from ..observers.efficiency import FEWEST_SETTINGS

    kept = sum(one.kept for one in outlooks)
    if campaign.screening is None or campaign.screening.observer is not None or kept >= FEWEST_SETTINGS:
        return ()
    return (
        f"[screening]: {kept} settings can be trained, and an observer is calibrated on {FEWEST_SETTINGS} or more: none comes of it",
    )


def screened_rows(screen: Screen, rows: Mapping[str, dict[str, Any]], asked: Sequence[str]) -> Screened:
    """What the observer expects, written into the rows of all settings, and why those that were not trained were not."""
    from ..observers.efficiency_io import efficiency_to_mapping

    expected = screen.expected()
    candidates = screen.candidates(rows, asked, expected)
    campaign = screen.campaign
    decided = decide_candidates(candidates, goal=campaign.goal, most_false_alarms=campaign.most_false_alarms)
    calibrating = (
        set() if campaign.screening is None or campaign.screening.observer else set(asked[: screen.first_count])
    )
    for text, row in rows.items():
        one = expected.get(text)
        row["predicted"] = None if one is None else one.as_dict()
        if text in asked:
            row["decided"] = "calibrating" if text in calibrating else "trained"
        elif text in decided:
            row["decided"] = decided[text].kind
            row["reason"] = _why(decided[text], one, campaign)
    efficiency = screen.efficiency
    return Screened(
        screen=screen,
        answer={
            "trained": len(asked),
            "screened": sum(one.kind != _UNDECIDED for one in decided.values()),
            "undecided": sum(one.kind == _UNDECIDED for one in decided.values()),
            "calibrating": [text for text in asked if text in calibrating],
            "observer": None if efficiency is None else efficiency_to_mapping(efficiency),
            "left_out_rms": None if efficiency is None else efficiency.left_out_rms,
            "why_none": screen.why_none,
            "warnings": [] if efficiency is None else list(efficiency.warnings),
        },
    )


def _why(decided: Decided, expected: Expected | None, campaign: Campaign) -> str:
    """Why a setting was not trained, in words."""
    chance = 0.0 if decided.chance is None else decided.chance
    told = f"{100 * chance:.3g} %" if chance >= 0.001 else "less than 0.1 %"
    if decided.kind == "worse":
        return f"not trained: a90 is smaller than that of the best with a chance of {told}"
    if decided.kind == "misses":
        return f"not trained: a90 is below the goal with a chance of {told}"
    if decided.kind == "slower":
        return "not trained: one that reaches the goal is faster, or as fast at a lower dose"
    most = None if campaign.screening is None else campaign.screening.most
    return f"not trained: undecided, and most = {most} settings are trained" + (
        "" if expected else "; nothing is expected"
    )


def _at_own_distance(setting: Setting, own: float | None) -> Setting:
    """A setting that states the instrument's own distance as one that states none: observers take one distance at a time."""
    return replace(setting, source_detector_mm=None) if setting.source_detector_mm == own else setting


def _or_last(size: float | None) -> float:
    return math.inf if size is None or not math.isfinite(size) else size
