"""Which setting to take: what lies on the front of a90, dose and throughput, and what cannot be told from the best.

Functions on the rows of a sweep's answer. A row takes part when it has an a90; sizes are in the unit of the answer.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """Numbers of rows: best (smallest upper bound of a90 within the limits), recommended; meets: whether the recommended one is
    shown to reach the goal (None: there is no goal). None: there is no such row."""

    best: int | None
    recommended: int | None
    meets: bool | None


def paces(rows: Sequence[Row]) -> list[float]:
    """How fast each row's setting is: products a second where all that have an a90 know that, else belt speed; 0 = unknown."""
    known = [row for row in rows if row.get("a90") is not None]
    name = "throughput_per_s"
    if any(row.get(name) is None for row in known) and all(row.get("belt_speed_mm_s") is not None for row in known):
        name = "belt_speed_mm_s"
    return [float(row.get(name) or 0.0) for row in rows]


def a90_for_front(row: Row, most_false_alarms: float | None) -> float | None:
    """a90 with which a row stands for the front: of its networks, or what an observer expects of a setting that was not trained.

    None: not known, a setting that cannot be, or networks with more false alarms than allowed.
    """
    if not row["feasible"]:
        return None
    if row["trained"]:
        return float(row["a90"]) if takes_part(row, most_false_alarms) else None
    return float(row["predicted"]["value"]) if row["predicted"] else None


def pareto_front(rows: Sequence[Row]) -> list[int]:
    """Numbers of the rows that no other beats: none has as small an a90, as low a dose and as high a pace, and one of them better.

    An unknown dose counts as the largest, an unknown pace as the slowest.
    """
    pace = paces(rows)
    points = {
        number: (float(row["a90"]), _dose(row), -pace[number])
        for number, row in enumerate(rows)
        if row.get("a90") is not None
    }
    return [
        number
        for number, own in points.items()
        if not any(
            other != own and all(theirs <= mine for theirs, mine in zip(other, own, strict=True))
            for other in points.values()
        )
    ]


def choose(rows: Sequence[Row], *, goal: float | None, most_false_alarms: float | None) -> Choice:
    """The setting to take.

    Without a goal the one whose a90 has the smallest upper bound (one-sided 95 %). With one, the fastest of those whose upper
    bound is at most the goal, those first that meet the whole requirement where there is one; of equally fast ones that of least
    dose; where none reaches it, the smallest upper bound again.
    Rows with more false alarms than allowed do not take part.
    """
    allowed = [number for number, row in enumerate(rows) if takes_part(row, most_false_alarms)]
    if not allowed:
        return Choice(best=None, recommended=None, meets=None)
    best = min(allowed, key=lambda number: (*_bound(rows[number]), number))
    if goal is None:
        return Choice(best=best, recommended=best, meets=None)
    reached = [number for number in allowed if (rows[number].get("a90_upper") or math.inf) <= goal]
    if not reached:
        return Choice(best=best, recommended=best, meets=False)
    pace = paces(rows)

    def preferred(number: int) -> tuple[Any, ...]:
        row = rows[number]
        return (row.get("verdict") in ("open", "fails"), -pace[number], _dose(row), *_bound(row), number)

    fastest = min(reached, key=preferred)
    return Choice(best=best, recommended=fastest, meets=True)


def takes_part(row: Row, most_false_alarms: float | None) -> bool:
    """Whether a row may be recommended: it has an a90, and no more false alarms than allowed."""
    if row.get("a90") is None:
        return False
    rate = row.get("false_alarm_rate")
    return most_false_alarms is None or (rate is not None and float(rate["value"]) <= most_false_alarms)


def indistinct(ratio: Mapping[str, float | None] | None) -> bool:
    """Whether a ratio of two a90 (its 95 % interval) leaves open which is the smaller; so does one without an interval."""
    if ratio is None or ratio.get("low") is None or ratio.get("high") is None:
        return True
    low, high = ratio["low"], ratio["high"]
    return bool(low is not None and high is not None and low <= 1.0 <= high)


def sentence(
    rows: Sequence[Row],
    choice: Choice,
    *,
    goal: float | None,
    unit: str,
    most_false_alarms: float | None = None,
) -> str:
    """What was found in plain words."""
    count = sum(takes_part(row, most_false_alarms) for row in rows)
    if choice.recommended is None or choice.best is None:
        trained = sum(bool(row.get("trained")) for row in rows)
        if not trained:
            return f"None of the {len(rows)} settings was tried; the reasons stand with the rows."
        if any(row.get("a90") is not None for row in rows):
            return "No setting has both an a90 and as few false alarms as asked for."
        most = max((row for row in rows if row.get("n")), key=lambda row: row["n_hits"] / row["n"], default=None)
        if most is None:
            return (
                f"None of the {trained} settings that were tried met a foreign object of known size: there is no POD."
            )
        found = f"Most was found at {most['label']}: {most['n_hits']} of {most['n']}."
        return (
            f"None of the {trained} settings that were tried has an a90 that the data support: larger objects, more images or"
            f" more training are wanted, or less noise. {found if most['n_hits'] else 'No object was found at any of them.'}"
        )
    row = rows[choice.recommended]
    upper = row.get("a90_upper")  # the best row has none only where no row has one
    facts = f"{_facts(row, unit)}; " + ("no upper bound" if upper is None else f"upper bound {_sized(upper, unit)}")
    take = f"Take {row['label']}:"
    if goal is None and count == 1:
        text = f"{take} the only setting with an a90 ({facts})."
    elif goal is None and upper is None:
        text = f"{take} none of {count} settings with an a90 has a 95 % upper bound, and its a90 is the smallest ({facts})."
    elif goal is None:
        text = f"{take} of {count} settings with an a90 it has the smallest 95 % upper bound ({facts})."
    elif choice.meets:
        number = sum((one.get("a90_upper") or math.inf) <= goal for one in rows if takes_part(one, most_false_alarms))
        which = "the only setting" if number == 1 else f"the fastest of {number} settings"
        text = f"{take} {which} whose a90 is shown to lie below {_sized(goal, unit)} ({facts})."
    else:
        smallest = "the smallest a90" if upper is None else "the smallest 95 % upper bound"
        text = (
            f"No setting is shown to reach a90 = {_sized(goal, unit)}; {smallest} is that of {row['label']} ({facts})."
        )
    return text + _alike_text(rows, choice, most_false_alarms)


def _alike_text(rows: Sequence[Row], choice: Choice, most_false_alarms: float | None) -> str:
    best = choice.best
    if best is None:
        return ""
    others = [
        number
        for number, row in enumerate(rows)
        if number != best and row.get("alike") and takes_part(row, most_false_alarms)
    ]
    of = "it" if best == choice.recommended else f"the one of smallest bound, {rows[best]['label']}"
    if not others:
        total = sum(takes_part(row, most_false_alarms) for row in rows)
        return f" All others are worse than {of}." if total > 1 else ""
    pace = paces(rows)
    fastest = min(others, key=lambda number: (-pace[number], _dose(rows[number])))
    text = (
        f" {len(others)} other{' is' if len(others) == 1 else 's are'} not shown to be worse than {of}:"
        f" {'; '.join(str(rows[number]['label']) for number in others[:6])}{'; ...' if len(others) > 6 else ''}."
    )
    if len(others) > 1 and pace[fastest] > pace[best]:
        text += f" The fastest of these is {rows[fastest]['label']}."
    return text


def _facts(row: Row, unit: str) -> str:
    low, high = row.get("a90_low"), row.get("a90_high")
    parts = [f"a90 {_sized(float(row['a90']), unit)}"]
    if low is not None and high is not None:
        parts[0] += f", 95 % {low:.3g} to {high:.3g}"
    if row.get("throughput_per_s") is not None:
        parts.append(f"{row['throughput_per_s']:.3g} products/s")
    elif row.get("belt_speed_mm_s") is not None:
        parts.append(f"{row['belt_speed_mm_s']:.3g} mm/s")
    if row.get("dose_uGy") is not None:
        parts.append(f"{row['dose_uGy']['value']:.3g} uGy")
    return "; ".join(parts)


def _sized(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}".rstrip()


def _bound(row: Row) -> tuple[bool, float]:
    upper = row.get("a90_upper")
    return (True, float(row["a90"])) if upper is None else (False, float(upper))


def _dose(row: Row) -> float:
    dose = row.get("dose_uGy")
    return math.inf if dose is None else float(dose["value"])
