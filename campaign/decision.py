"""Does a setting do what is asked of the line: verdict and margin of every setting, what limits it, what would make the answer surer.

A requirement has up to four parts. Each is met where the data show it, failed where they show the opposite, open between:

| part | met | failed |
|---|---|---|
| detection | upper bound of a90 at most the size asked for | lower end of its interval above it |
| false_alarms | upper bound of the rate at most the one asked for | lower end of its interval above it |
| throughput | products a second at least those asked for | fewer |
| dose | upper end of the air kerma's interval at most the one asked for | its lower end above it |

(bounds are one-sided, 95 %; intervals two-sided, 95 %)

Where the hits give no a90 (all are misses, or all hits), the objects themselves decide. POD rises with size, so the share of objects
of at least the size asked for that any network finds bounds it from above, and the share of those up to that size that all networks
find from below (exact binomial bounds, an object each).

The margin is the share of the requirement that is left at the bound, negative where the bound is beyond it: 1 - bound / asked, of
throughput value / asked - 1. A setting meets the requirement where it meets all parts, and fails where it fails one. A setting that a
model observer looked at in place of networks never meets it: it is likely to, where the upper end of what is expected is at most the
size asked for and no part fails.

Source: MIL-HDBK-1823A (2009) (a90/95; n of n found); Clopper & Pearson, Biometrika 26 (1934) 404 (rates).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from .sweep_file import Requirement

Row = Mapping[str, Any]

MEETS, LIKELY, OPEN, FAILS, IMPOSSIBLE = "meets", "likely", "open", "fails", "cannot be"
_ONE_SIDED = 0.95
_POD = 0.9
_SURELY = 1e-9
_NO_CHANGE = 0.995  # as a factor: what a whole percent does not show


@dataclass(frozen=True, slots=True, kw_only=True)
class Criterion:
    """One part of a requirement at one setting.

    Fields: name (detection, false_alarms, throughput, dose); required; value; bound (what the verdict rests on); margin (share of the
    requirement that is left at the bound); verdict (`meets`, `likely`, `open`, `fails`); predicted (by an observer, not by networks).
    None: unknown.
    """

    name: str
    required: float
    value: float | None
    bound: float | None
    margin: float | None
    verdict: str
    predicted: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Looks:
    """Objects that networks were tried on. Fields, a value an object: sizes; by_any: found by one network or more; by_all: by all of
    them."""

    sizes: tuple[float, ...] = ()
    by_any: tuple[bool, ...] = ()
    by_all: tuple[bool, ...] = ()


NO_LOOKS = Looks()


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What a change of the setting would do to its a90, by the observer. Fields: kind (a key of `CHANGES`); factor (of a90)."""

    kind: str
    factor: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """A setting against the requirement.

    Fields: setting, label; verdict (`meets`, `likely`, `open`, `fails`, `cannot be`); criteria; changes (largest gain first).
    """

    setting: str
    label: str
    verdict: str
    criteria: tuple[Criterion, ...]
    changes: tuple[Change, ...] = ()

    @property
    def limited_by(self) -> tuple[str, ...]:
        """Names of the criteria that fail."""
        return tuple(one.name for one in self.criteria if one.verdict == FAILS)

    @property
    def not_yet_known(self) -> tuple[str, ...]:
        """Names of the criteria of which it is open whether they are met."""
        return tuple(one.name for one in self.criteria if one.verdict == OPEN)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """Something to measure on the real line. Fields: kind; number (of what is to be measured, None: one); text."""

    kind: str
    number: int | None
    text: str


CHANGES = {
    "quanta": "twice the quanta",
    "motion": "half the belt speed",
    "electronics": "half the electronic variance",
    "networks": "networks with half the internal noise",
}


# ---------------------------------------------------------------------------------------------------- verdicts


def judge_row(
    row: Row, requirement: Requirement, *, changes: Sequence[Change] = (), looks: Looks = NO_LOOKS
) -> Verdict:
    """The verdict on a row of a sweep, whose networks had these looks."""
    criteria = [_detection(row, requirement.size, looks)]
    if requirement.false_alarm_rate is not None:
        criteria.append(_false_alarms(row, requirement.false_alarm_rate))
    if requirement.throughput_per_s is not None:
        criteria.append(_throughput(row, requirement.throughput_per_s))
    if requirement.dose_uGy is not None:
        criteria.append(_dose(row, requirement.dose_uGy))
    verdicts = {one.verdict for one in criteria}
    verdict = FAILS if FAILS in verdicts else LIKELY if LIKELY in verdicts else OPEN if OPEN in verdicts else MEETS
    return Verdict(
        setting=str(row["setting"]),
        label=str(row["label"]),
        verdict=verdict if row["feasible"] else IMPOSSIBLE,
        criteria=tuple(criteria),
        changes=tuple(sorted((one for one in changes if one.factor < _NO_CHANGE), key=lambda one: one.factor)),
    )


def _detection(row: Row, required: float, looks: Looks) -> Criterion:
    if row["trained"]:
        value, bound, low = row["a90"], row["a90_upper"], row["a90_low"]
        failed = low is not None and low > required
        if value is None:
            # no a90 within the objects: the curve's band, or the objects themselves, say whether what is asked for is found
            failed = min(_highest_pod(row["line"], required), _highest_share(looks, required)) < _POD
            bound = required if _lowest_share(looks, required) >= _POD else bound
        met = bound is not None and bound <= required
        return _criterion("detection", required, value, bound, met, failed, _left(bound, required))
    expected: Mapping[str, float] | None = row.get("predicted")
    verdict, value, bound = OPEN, None, None
    if expected is not None:
        value, bound = expected["value"], expected["high"]
        # networks alone can show that it is met
        verdict = FAILS if expected["low"] > required else LIKELY if bound <= required else OPEN
    return Criterion(
        name="detection",
        required=required,
        value=value,
        bound=bound,
        margin=_left(bound, required),
        verdict=verdict,
        predicted=expected is not None,
    )


def _highest_pod(line: Mapping[str, Any] | None, size: float) -> float:
    """Upper end of the curve's 95 % band at a size; 1 where there is no curve or the size lies outside."""
    if not line or not line["size"] or not line["size"][0] <= size <= line["size"][-1]:
        return 1.0
    place = next(number for number, one in enumerate(line["size"]) if one >= size)
    # the band rises with size: the end at the next point is the larger one
    return 1.0 if line["high"][place] is None else float(line["high"][place])


def _highest_share(looks: Looks, size: float) -> float:
    """Upper 95 % bound of the share of objects of a size or larger that any network finds, which no POD at that size exceeds."""
    found = [one for one, own in zip(looks.by_any, looks.sizes, strict=True) if own >= size]
    return upper_rate(sum(found) / len(found), float(len(found))) if found else 1.0


def _lowest_share(looks: Looks, size: float) -> float:
    """Lower 95 % bound of the share of objects up to a size that every network finds, which the POD at that size is not below."""
    missed = [not one for one, own in zip(looks.by_all, looks.sizes, strict=True) if own <= size]
    return 1.0 - upper_rate(sum(missed) / len(missed), float(len(missed))) if missed else 0.0


def _false_alarms(row: Row, required: float) -> Criterion:
    rate = row["false_alarm_rate"]
    if rate is None:
        return _criterion("false_alarms", required, None, None, False, False, None)
    bound = upper_rate(rate["value"], rate["effective_n"])
    return _criterion(
        "false_alarms",
        required,
        rate["value"],
        bound,
        bound <= required,
        rate["low"] > required,
        _left(bound, required),
    )


def upper_rate(rate: float, looks: float) -> float:
    """One-sided 95 % upper bound of a rate seen in so many independent looks (Clopper & Pearson)."""
    from scipy.special import betaincinv

    count = rate * looks
    return 1.0 if count >= looks else float(betaincinv(count + 1.0, looks - count, _ONE_SIDED))


def _throughput(row: Row, required: float) -> Criterion:
    value = row["throughput_per_s"]
    met = value is not None and value >= required * (1 - _SURELY)
    margin = None if value is None else value / required - 1.0
    return _criterion("throughput", required, value, value, met, value is not None and not met, margin)


def _dose(row: Row, required: float) -> Criterion:
    dose = row["dose_uGy"]
    if dose is None:
        return _criterion("dose", required, None, None, False, False, None)
    most = required * (1 + _SURELY)
    return _criterion(
        "dose",
        required,
        dose["value"],
        dose["high"],
        dose["high"] <= most,
        dose["low"] > most,
        _left(dose["high"], required),
    )


def _left(bound: float | None, required: float) -> float | None:
    return None if bound is None else 1.0 - bound / required


def _criterion(
    name: str,
    required: float,
    value: float | None,
    bound: float | None,
    met: bool,
    failed: bool,
    margin: float | None,
) -> Criterion:
    verdict = MEETS if met else FAILS if failed else OPEN
    return Criterion(name=name, required=required, value=value, bound=bound, margin=margin, verdict=verdict)


# ---------------------------------------------------------------------------------------------------- what to measure


def measurements_for(row: Row, verdict: Verdict, *, size_text: str) -> tuple[Measurement, ...]:
    """What to measure on the real line so that the verdict on a setting becomes surer, most useful first.

    Args:
        row: of the setting that is taken, or comes closest.
        verdict: on it.
        size_text: the object asked for, in words.
    """
    found: list[Measurement] = []
    by_name = {one.name: one for one in verdict.criteria}
    alarms, dose, detection = by_name.get("false_alarms"), by_name.get("dose"), by_name["detection"]
    if alarms is not None and alarms.verdict == OPEN:
        found.append(_clean_products(alarms))
    if row["a90"] is not None and detection.verdict == OPEN and detection.bound is not None:
        found += _more_objects(row, detection)
    if dose is not None and dose.verdict == OPEN:
        found.append(
            Measurement(
                kind="dosimeter", number=None, text="air kerma at the product with a dosimeter, at this setting"
            )
        )
    if row["extrapolated"]:
        found.append(
            Measurement(
                kind="flats", number=None, text="darks and flats at this setting: it lies outside the calibrated range"
            )
        )
    if row["belt_speed_mm_s"]:
        found.append(
            Measurement(kind="motion", number=None, text="an edge on the moving belt: the blur that the setting states")
        )
    found.append(_demonstration(size_text))
    return tuple(found)


def found_of_found(misses: int = 0) -> int:
    """Objects of one size that must be tried, all but so many found, to show POD of 90 % with 95 % confidence (29, 46, 61, ...)."""
    from scipy.stats import binom

    count = misses + 1
    while binom.cdf(misses, count, 1.0 - _POD) > 1.0 - _ONE_SIDED:
        count += 1
    return count


def _demonstration(size_text: str) -> Measurement:
    count = found_of_found()
    return Measurement(
        kind="demonstration",
        number=count,
        text=(
            f"{count} products with an object of {size_text}, imaged at this setting: all {count} found shows a POD of 90 % with 95 %"
            f" confidence ({found_of_found(1)} with one miss)"
        ),
    )


def _clean_products(alarms: Criterion) -> Measurement:
    rate, required = alarms.value or 0.0, alarms.required
    if alarms.value is not None and rate >= required:
        return Measurement(
            kind="threshold",
            number=None,
            text=(
                f"a stricter threshold: {100 * rate:.3g} % of images without objects show an alarm, asked for are"
                f" {100 * required:g} % at most"
            ),
        )
    count = math.ceil(math.log(1.0 - _ONE_SIDED) / math.log1p(-required))
    while upper_rate(rate, count) > required:
        count = math.ceil(1.1 * count)
    seen = "without any alarm" if rate == 0 else f"with alarms in {100 * rate:.3g} % of them, as now"
    return Measurement(
        kind="clean_products", number=count, text=f"{count} different products without objects, {seen}, show the rate"
    )


def _more_objects(row: Row, detection: Criterion) -> list[Measurement]:
    value, bound, required = float(row["a90"]), float(detection.bound or 0.0), detection.required
    if not value < required:
        return []
    share = (math.log(bound / value) / math.log(required / value)) ** 2
    count = math.ceil(share * row["objects"])
    return [
        Measurement(
            kind="objects",
            number=count,
            text=(
                f"{count} test objects in place of {row['objects']}, and networks in proportion: the bound of a90 then lies at the"
                f" size asked for, if a90 stays {value:.3g}"
            ),
        )
    ]


# ---------------------------------------------------------------------------------------------------- in words


def requirement_text(requirement: Requirement, *, unit: str) -> str:
    """The requirement in words."""
    what = f"a contrast of {requirement.size:g}" if not unit else f"an object of {requirement.size:g} {unit}"
    parts = [f"{what} found in 90 % of cases with 95 % confidence"]
    if requirement.false_alarm_rate is not None:
        parts.append(f"false alarms below {100 * requirement.false_alarm_rate:g} %")
    if requirement.throughput_per_s is not None:
        parts.append(f"{60 * requirement.throughput_per_s:g} products a minute")
    if requirement.dose_uGy is not None:
        parts.append(f"{requirement.dose_uGy:g} uGy")
    return ", ".join(parts)


WORDS = {
    "detection": "detection",
    "false_alarms": "false alarms",
    "throughput": "throughput",
    "dose": "dose",
}


def criterion_text(one: Criterion, *, unit: str) -> str:
    """A criterion with its numbers in words."""
    name = WORDS[one.name]
    if one.value is None and one.bound is None:
        return f"{name} unknown"
    shown: Callable[[float], str] = {
        "detection": lambda value: f"{value:.3g} {unit}".rstrip(),
        "false_alarms": lambda value: f"{100 * value:.3g} %",
        "throughput": lambda value: f"{60 * value:.0f} a minute" if value >= 1 else f"{60 * value:.3g} a minute",
        "dose": lambda value: f"{value:.3g} uGy",
    }[one.name]
    asked = shown(one.required)
    if one.name == "throughput":
        return f"{name} {shown(one.value or 0.0)}, asked for {asked}"
    if one.bound is None:
        return f"{name}: a90 {shown(one.value or 0.0)} without an upper bound, asked for {asked}"
    what = ": a90 expected up to" if one.predicted else ": a90 at most" if one.name == "detection" else " at most"
    open_yet = one.verdict == OPEN and (one.margin or 0.0) < 0
    margin = "" if one.margin is None else f" ({'not shown yet' if open_yet else _margin_text(one.margin)})"
    return f"{name}{what} {shown(one.bound)}, asked for {asked}{margin}"


def change_text(one: Change) -> str:
    """A change and what it would do, in words."""
    return f"{CHANGES[one.kind]}: a90 {100 * (one.factor - 1):+.0f} %"


def _margin_text(margin: float) -> str:
    return f"{100 * margin:.0f} % to spare" if margin >= 0 else f"{-100 * margin:.0f} % too much"


_COUNTED = {
    MEETS: ("{} meets it", "{} meet it"),
    LIKELY: ("{} is likely to by the observer", "{} are likely to by the observer"),
    OPEN: ("{} is open", "{} are open"),
    FAILS: ("{} fails", "{} fail"),
    IMPOSSIBLE: ("{} cannot be", "{} cannot be"),
}


def decision_sentence(
    verdicts: Sequence[Verdict], recommended: Verdict | None, requirement: Requirement, *, unit: str, tried: int
) -> str:
    """What was decided, in plain words; tried: how many settings networks were trained for."""
    asked = f"Asked for: {requirement_text(requirement, unit=unit)}."
    count = {kind: sum(one.verdict == kind for one in verdicts) for kind in _COUNTED}
    total = len(verdicts)
    parts = [_COUNTED[kind][number != 1].format(number) for kind, number in count.items() if number or kind == MEETS]
    tally = f"Of {total} setting{'s' * (total != 1)} {', '.join(parts)}."
    if recommended is None:
        to_choose = " to choose by" if count[MEETS] else ""
        none = f"None of the {tried} that were tried has an a90{to_choose}" if tried else "None was tried"
        return f"{asked} {tally} {none}; the reasons stand with the settings."
    facts = "; ".join(criterion_text(one, unit=unit) for one in recommended.criteria)
    if recommended.verdict == MEETS:
        return f"{asked} {tally} Take {recommended.label}: {facts}."
    failed, unknown = (
        ", ".join(WORDS[name] for name in names) for names in (recommended.limited_by, recommended.not_yet_known)
    )
    state = f" and fails in {failed}" if failed else ""
    state += f"; not yet known: {unknown}" if unknown else ""
    return f"{asked} {tally} {recommended.label} comes closest{state}. What is known of it: {facts}."


# ---------------------------------------------------------------------------------------------------- the whole


def front_of(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The rows on the front (`pareto`), smallest a90 first; a90 of networks, or what the observer expects of them."""
    front = [
        {
            "setting": row["setting"],
            "label": row["label"],
            "a90": row["predicted"]["value"] if row["a90"] is None else row["a90"],
            "predicted": row["a90"] is None,
            "throughput_per_s": row["throughput_per_s"],
            "dose_uGy": row["dose_uGy"],
        }
        for row in rows
        if row["pareto"]
    ]
    return sorted(front, key=lambda one: float(one["a90"]))


def decide(
    rows: Sequence[Row],
    requirement: Requirement,
    verdicts: Sequence[Verdict],
    *,
    recommended: int | None,
    unit: str,
    changes_by: str,
) -> dict[str, Any]:
    """The decision as sweep.json holds it.

    Args:
        rows: of the sweep, those on the front marked `pareto`.
        requirement: what is asked for.
        verdicts: of each row.
        recommended: number of the row that is taken, or comes closest.
        unit: of the size.
        changes_by: who said what changes would do: `calibrated`, `uncalibrated` observer, or why none did.
    """
    taken = None if recommended is None else verdicts[recommended]
    size_text = f"{requirement.size:g} {unit}" if unit else f"contrast {requirement.size:g}"
    return {
        "requirement": {**asdict(requirement), "pod": _POD, "confidence": _ONE_SIDED, "unit": unit},
        "sentence": decision_sentence(
            verdicts, taken, requirement, unit=unit, tried=sum(bool(row.get("trained")) for row in rows)
        ),
        "recommended": None if taken is None else taken.setting,
        "verdict": None if taken is None else taken.verdict,
        "meets": [one.setting for one in verdicts if one.verdict == MEETS],
        "settings": [
            {
                "setting": one.setting,
                "label": one.label,
                "verdict": one.verdict,
                "criteria": [asdict(part) for part in one.criteria],
                "limited_by": list(one.limited_by),
                "not_yet_known": list(one.not_yet_known),
                "changes": [asdict(part) for part in one.changes],
            }
            for one in verdicts
        ],
        "changes_by": changes_by,
        "front": front_of(rows),
        "measurements": []
        if taken is None or recommended is None
        else [asdict(one) for one in measurements_for(rows[recommended], taken, size_text=size_text)],
    }
