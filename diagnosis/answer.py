"""The answer of a diagnosis, and its form as a file."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ..generator.effects import EFFECTS, AppliedEffect
from ..generator.twin import Twin
from .assemble import Problem
from .coarse import UNSEEN, parameters_in_pixels, pixels_in_square
from .held_out import Gap
from .inference import Hypothesis
from .known_effects import with_found
from .readings import Suspect

VERDICTS = ("no_gap", "explained", "ambiguous", "unknown_effect")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """An effect, how probable it is, its strength and inner parameters, and how far the gap shrinks with it."""

    effect: str
    probability: float
    strength: tuple[float, float, float]
    unit: str
    parameters: Mapping[str, float]
    sign: float
    since: str
    shrinks_by: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A probe that departs from the twin: axis, series, statistic, location, unit; z after the nuisances took their part."""

    axis: str
    series: str
    statistic: str
    location: str
    unit: str
    z: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis:
    """The answer; `named` are the effects of the leading hypothesis, `twin` is the twin with them added.

    notes: how the session was looked at, where that limits the answer. strained: nuisances that what is left pulls beyond
    STRAINED_FROM of their standard deviations, and how far, the farthest first.
    mislabelled: series whose labels look wrong; no effect is named then. not_tested: effects that these series could not
    show, each with the reason.
    """

    verdict: str
    hypotheses: tuple[Hypothesis, ...]
    causes: tuple[Cause, ...]
    probability_no_gap: float
    probability_unknown: float
    unknown_location: str
    where: tuple[Place, ...]
    threshold_z: float
    gap: Gap
    held_out: tuple[tuple[str, float, float, float], ...]
    ambiguous_with: tuple[tuple[str, str], ...]
    next_measurement: Mapping[str, Any] | None
    twin: Twin
    added: tuple[AppliedEffect, ...]
    named: tuple[str, ...]
    problem: Problem = field(repr=False)
    warnings: tuple[str, ...] = ()
    mislabelled: tuple[Suspect, ...] = ()
    not_tested: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    strained: tuple[tuple[str, float], ...] = ()


def in_pixels(diagnosis: Diagnosis, *, twin: Twin, factor: int) -> Diagnosis:
    """A diagnosis made with squares of pixels, in terms of the panel's pixels.

    Args:
        diagnosis: of the coarser session.
        twin: the panel's own, calibrated from the same series.
        factor: pixels along each side of a square.
    """
    added = tuple(
        AppliedEffect(
            id=item.id,
            parameters=parameters_in_pixels(item.id, item.parameters, factor),
            since=item.since,
            options=item.options,
        )
        for item in diagnosis.added
    )
    causes = []
    for cause in diagnosis.causes:
        share = pixels_in_square(cause.effect, "strength", factor)
        value, low, high = cause.strength
        causes.append(
            replace(
                cause,
                strength=(share * value, share * low, share * high),
                parameters=parameters_in_pixels(cause.effect, cause.parameters, factor),
            )
        )
    rows, columns = twin.maps.shape
    text = (
        f"frames of {rows} x {columns} were compared as means of {factor} x {factor} pixels: what is finer than that (codes,"
        " sharpness and texture within some pixels) is hardly seen; diagnose a part of the panel for it"
    )
    return replace(
        diagnosis,
        added=added,
        causes=tuple(causes),
        twin=replace(twin, effects=with_found(twin.effects, added)),
        not_tested={**diagnosis.not_tested, **UNSEEN},
        notes=(*diagnosis.notes, text),
    )


def diagnosis_answer(diagnosis: Diagnosis, *, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """`diagnosis.json`, the form of the interfaces page."""

    def interval(value: tuple[float, float, float] | None) -> dict[str, float] | None:
        return None if value is None else {"value": value[0], "low": value[1], "high": value[2]}

    def parameters(cause: Cause) -> dict[str, Any]:
        effect = EFFECTS[cause.effect]
        units = {item.name: item.unit for item in effect.parameters}
        values = {
            "strength": {
                "value": cause.sign * cause.strength[0],
                "low": min(cause.sign * cause.strength[1], cause.sign * cause.strength[2]),
                "high": max(cause.sign * cause.strength[1], cause.sign * cause.strength[2]),
                "unit": cause.unit,
            }
        }
        for name, value in cause.parameters.items():
            values[name] = {"value": value, "low": value, "high": value, "unit": units.get(name, "")}
        return values

    return {
        "format": "raytwin-diagnosis",
        "version": 1,
        "verdict": diagnosis.verdict,
        "gap": {
            "before": diagnosis.gap.before,
            "after": diagnosis.gap.after,
            "floor": diagnosis.gap.floor,
            "shrinks_by": interval(diagnosis.gap.shrinks_by),
        },
        "causes": [
            {
                "effect": cause.effect,
                "probability": cause.probability,
                "strength": {**(interval(cause.strength) or {}), "unit": cause.unit},
                "parameters": parameters(cause),
                "since": cause.since,
                "shrinks_by": interval(cause.shrinks_by),
            }
            for cause in diagnosis.causes
        ],
        "hypotheses": [
            {"effects": list(item.effects), "probability": item.probability} for item in diagnosis.hypotheses
        ],
        "probability_no_gap": diagnosis.probability_no_gap,
        "probability_unknown": diagnosis.probability_unknown,
        "where": [
            {
                "axis": place.axis,
                "series": place.series,
                "statistic": place.statistic,
                "z": place.z,
                "location": place.location,
                "unit": place.unit,
            }
            for place in diagnosis.where
        ],
        "ambiguous_with": [list(pair) for pair in diagnosis.ambiguous_with],
        "next_measurement": diagnosis.next_measurement,
        "held_out": [
            {"axis": axis, "before": before, "after": after, "floor": floor}
            for axis, before, after, floor in diagnosis.held_out
        ],
        "not_tested": [{"effect": effect, "reason": reason} for effect, reason in diagnosis.not_tested.items()],
        "strained": [{"nuisance": name, "sd": value} for name, value in diagnosis.strained],
        "mislabelled": [{"series": list(item.series), "text": item.text} for item in diagnosis.mislabelled],
        "task": None,
        "warnings": [*diagnosis.warnings, *diagnosis.notes],
        "inputs": dict(inputs),
    }
