"""The answer of a diagnosis, and its form as a file."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from ...checks.findings import NOT_OF_LABELS, Finding
from ...errors import InputError
from ...generator.effects import EFFECTS, AppliedEffect
from ...generator.line.twin import Twin
from ...results import Result, Table, axes_or_new, frame, plain
from ..inference.inference import Hypothesis
from ..model.changes import EACH_SCENE
from ..problem.problem import Problem
from ..session.binning import lost_by_binning, parameters_in_pixels
from .held_out import Gap

if TYPE_CHECKING:
    import pandas

NO_GAP_FROM = 0.5  # probability of none from which that is likelier than all explanations together
VERDICTS = ("no_gap", "explained", "explained_in_part", "ambiguous", "unknown_effect")
EXPLAINED = ("explained", "explained_in_part")
_LEFT_LISTED = 5
_PLOTTED = 12  # hypotheses, the most probable


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """An effect, how probable it is, its strength and inner parameters, how far the gap shrinks with it, and what its law leaves."""

    effect: str
    probability: float
    strength: tuple[float, float, float]  # value, low, high, signed
    unit: str
    parameters: Mapping[str, float]
    since: str
    shrinks_by: tuple[float, float, float] | None
    level: float = 0.0  # by how much of itself its law seems to be off
    left: tuple["Place", ...] = ()
    series: tuple[str, ...] = ()  # names of those in which it acts; empty: all since its onset
    apart: bool = False  # in each scene of these by an amount of its own

    @property
    def onset(self) -> str | tuple[str, ...]:
        """`always`, `since_calibration`, or the names of the series in which it acts."""
        if self.series:
            return self.series
        return "always" if self.since == "always" else "since_calibration"


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A probe that departs from the twin: axis, series, statistic, location, unit; z after the nuisances took their part."""

    axis: str
    series: str
    statistic: str
    location: str
    unit: str
    z: float


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class Diagnosis(Result):
    """The answer; `named` are the effects of the leading hypothesis, `twin` is the twin with them added.

    notes: how the session was looked at, where that limits the answer. strained: nuisances that what is left pulls beyond
    STRAINED_FROM of their standard deviations, and how far, the farthest first. findings: series whose frames contradict their
    labels, and numbers that stop early; these series are left out, and all else is of the others. not_tested: effects that these
    series could not show, each with the reason. problem: what was compared, for reports; it takes no part in equality and is not
    pickled.
    inputs: hashes, version and seed; task: POD before and after, where that was asked for.
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
    problem: Problem | None = field(compare=False)
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    not_tested: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    strained: tuple[tuple[str, float], ...] = ()
    inputs: Mapping[str, Any] = field(default_factory=dict)
    task: Mapping[str, Any] | None = None

    @property
    def leading(self) -> tuple[Cause, ...]:
        """The causes that are named, most probable first."""
        return tuple(cause for cause in self.causes if cause.effect in self.named)

    @property
    def no_gap_but_findings(self) -> bool:
        """Whether the series that could be compared agree with the twin, and others contradict what they state."""
        return bool(self.findings) and self.probability_no_gap >= NO_GAP_FROM

    @property
    def compared(self) -> Problem:
        """What was compared.

        Raises:
            InputError: the diagnosis was read from a pickle, which leaves it out.
        """
        if self.problem is None:
            raise InputError(
                "diagnosis",
                received="one from a pickle, without the series it compared",
                expected="one that was made in this process",
                remedy="diagnose the session again for its report",
            )
        return self.problem

    def __reduce__(self) -> tuple[Any, tuple[()]]:
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return partial(Diagnosis, **{**values, "problem": None}), ()

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin diagnose --json` prints, the contents of diagnosis.json."""
        found: dict[str, Any] = plain(diagnosis_answer(self))
        return found

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row a cause, most probable first: effect, probability, strength with interval and unit, since, shrinks_by."""
        names = ("effect", "probability", "strength", "since", "shrinks_by")
        return frame([{name: cause[name] for name in names} for cause in self.to_dict()["causes"]], columns=names)

    def plot_gap(self, ax: Any = None) -> Any:
        """The gap on held-out probes before and after, by axis, with the floor of measured against measured; returns the axes."""
        gap = self.gap
        ax = axes_or_new(ax)
        rows = [("all", gap.before, gap.after, gap.floor), *self.held_out]
        for place, (_, before, after, floor) in enumerate(rows):
            first = place == 0
            ax.barh(place - 0.18, before, height=0.34, color="#9aa5b1", label="before" if first else None)
            ax.barh(place + 0.18, after, height=0.34, color="#1f5fa8", label="after" if first else None)
            ax.plot([floor] * 2, [place - 0.4, place + 0.4], color="#d9822b", lw=2, label="floor" if first else None)
        ax.set_yticks(range(len(rows)), [name for name, _, _, _ in rows])
        ax.invert_yaxis()
        ax.set_xlabel("gap on held-out probes (rms, in standard deviations)")
        ax.legend(frameon=False)
        return ax

    def plot(self, ax: Any = None) -> Any:
        """Probability of every hypothesis that was weighed, the most probable first; returns the axes."""
        axes = axes_or_new(ax)
        shown = sorted(self.hypotheses, key=lambda item: -item.probability)[:_PLOTTED]
        axes.barh(range(len(shown)), [item.probability for item in shown], color="#1f5fa8")
        axes.set_yticks(range(len(shown)), [" + ".join(item.effects) or "no gap" for item in shown])
        axes.invert_yaxis()
        axes.set(xlabel="probability", xlim=(0, 1))
        return axes

    def _table(self) -> Table:
        rows = [
            (
                cause.effect,
                f"{cause.probability:.2f}",
                f"{cause.strength[0]:.3g} ({cause.strength[1]:.3g} to {cause.strength[2]:.3g}) {cause.unit}".rstrip(),
                EACH_SCENE if cause.apart else f"in {len(cause.series)} series" if cause.series else cause.since,
            )
            for cause in self.causes
        ]
        notes = [
            f"probability of no gap {self.probability_no_gap:.2f}, of an unknown effect {self.probability_unknown:.2f}"
        ]
        if self.next_measurement is not None and self.next_measurement.get("text"):
            notes.append(f"next: {self.next_measurement['text']}")
        notes += [f"finding: {item.line}" for item in self.findings]
        notes += [f"note: {text}" for text in (*self.warnings, *self.notes)]
        gap = self.gap
        title = f"{self.verdict}: gap {gap.before:.3g} before, {gap.after:.3g} after, floor {gap.floor:.3g}"
        header = ("effect", "probability", "strength (95 %)", "since") if rows else ()
        return Table(title=title, header=header, rows=tuple(rows), notes=tuple(notes))


def improved(twin: Twin, added: Sequence[AppliedEffect]) -> Twin:
    """A twin with effects that were found, which take the place of the same ones that it has."""
    found = {item.id for item in added}
    return replace(twin, effects=(*(item for item in twin.effects if item.id not in found), *added))


def in_pixels(diagnosis: Diagnosis, *, twin: Twin, factor: int) -> Diagnosis:
    """A diagnosis made with squares of `factor` pixels a side, in terms of the panel's pixels; twin: the panel's own."""
    added = tuple(
        replace(item, parameters=parameters_in_pixels(item.id, item.parameters, factor)) for item in diagnosis.added
    )
    causes = []
    for cause in diagnosis.causes:
        share = EFFECTS[cause.effect].strength.pixels_per_bin(factor)
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
        twin=improved(twin, added),
        not_tested={**diagnosis.not_tested, **lost_by_binning()},
        notes=(*diagnosis.notes, text),
    )


def diagnosis_answer(diagnosis: Diagnosis, *, inputs: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The contents of `diagnosis.json`; inputs: in place of the diagnosis' own."""

    def interval(value: tuple[float, float, float] | None) -> dict[str, float] | None:
        return None if value is None else {"value": value[0], "low": value[1], "high": value[2]}

    def strength(cause: Cause) -> dict[str, Any]:
        return {**(interval(cause.strength) or {}), "unit": cause.unit}

    def parameters(cause: Cause) -> dict[str, Any]:
        effect = EFFECTS[cause.effect]
        units = {item.name: item.unit for item in effect.parameters}
        values = {"strength": strength(cause)}
        for name, value in cause.parameters.items():
            # the strength's interval holds what these leave open; they have none of their own
            values[name] = {"value": value, "low": None, "high": None, "unit": units.get(name, "")}
        return values

    return {
        "format": "raytwin-diagnosis",
        "version": 2,
        "verdict": diagnosis.verdict,
        "gap": asdict(diagnosis.gap) | {"shrinks_by": interval(diagnosis.gap.shrinks_by)},
        "causes": [
            {
                "effect": cause.effect,
                "probability": cause.probability,
                "strength": strength(cause),
                "parameters": parameters(cause),
                "since": cause.since,
                "onset": cause.onset if isinstance(cause.onset, str) else list(cause.onset),
                "shrinks_by": interval(cause.shrinks_by),
                "fit": {
                    "share_removed": interval(cause.shrinks_by),
                    "law_off_by": cause.level,
                    "left": [
                        {"axis": place.axis, "series": place.series, "location": place.location, "z": place.z}
                        for place in cause.left[:_LEFT_LISTED]
                    ],
                },
            }
            for cause in diagnosis.causes
        ],
        "hypotheses": [
            {"effects": list(item.effects), "probability": item.probability} for item in diagnosis.hypotheses
        ],
        "probability_no_gap": diagnosis.probability_no_gap,
        "probability_unknown": diagnosis.probability_unknown,
        "where": [asdict(place) for place in diagnosis.where],
        "ambiguous_with": [list(pair) for pair in diagnosis.ambiguous_with],
        "next_measurement": diagnosis.next_measurement,
        "held_out": [
            {"axis": axis, "before": before, "after": after, "floor": floor}
            for axis, before, after, floor in diagnosis.held_out
        ],
        "not_tested": [{"effect": effect, "reason": reason} for effect, reason in diagnosis.not_tested.items()],
        "strained": [{"nuisance": name, "sd": value} for name, value in diagnosis.strained],
        "mislabelled": [
            {"series": list(item.names), "text": item.line}
            for item in diagnosis.findings
            if item.code not in NOT_OF_LABELS
        ],
        "findings": [
            {"code": str(item.code), "series": list(item.names), "text": item.text} for item in diagnosis.findings
        ],
        "task": None if diagnosis.task is None else dict(diagnosis.task),
        "warnings": [*diagnosis.warnings, *diagnosis.notes],
        "inputs": dict(diagnosis.inputs if inputs is None else inputs),
    }
