"""What a session could tell, whatever its frames show: which effects it distinguishes, and from which strength on."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from ...acquisition.acquisition_io import AcquisitionFile
from ...checks.findings import NOT_OF_LABELS, Finding
from ...generator.effects import EFFECTS
from ...generator.line.twin import Twin
from ...results import Result, Table, axes_or_new, frame, plain
from ..problem.assemble import problem_of
from ..session.preparation import prepare_session
from .plan import Distinguishability, distinguishability

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True, slots=True, kw_only=True, repr=False, eq=False)
class SessionPlan(Result):
    """Which effects a session distinguishes.

    Fields: distinguishability; cannot_be_judged (effect -> reason); findings: on series that contradict what they
    state, by which the plan goes all the same.
    """

    distinguishability: Distinguishability
    cannot_be_judged: Mapping[str, str]
    findings: tuple[Finding, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """What `raytwin diagnose --plan --json` prints."""
        found = self.distinguishability
        answer: dict[str, Any] = plain(
            {
                "effects": found.effects,
                "since": found.since,
                "units": [EFFECTS[effect].strength.unit for effect in found.effects],
                "strengths": found.strengths,
                "from_none": found.from_none,
                "seen_from": found.seen_from,
                "between": found.between,
                "cannot_be_judged": self.cannot_be_judged,
                "mislabelled": [item.line for item in self.findings if item.code not in NOT_OF_LABELS],
                "findings": [item.line for item in self.findings],
            }
        )
        return answer

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row an effect: since, unit, strength taken, separation from none, strength from which it is seen."""
        answer = self.to_dict()
        columns = {"effect": "effects", "since": "since", "unit": "units", "strength": "strengths"}
        columns |= {"from_none": "from_none", "seen_from": "seen_from"}
        count = len(answer["effects"])
        return frame([{name: answer[key][row] for name, key in columns.items()} for row in range(count)])

    def plot(self, ax: Any = None) -> Any:
        """Separation of every effect (row) from every other one (column), standard deviations; returns the axes."""
        found = self.distinguishability
        axes = axes_or_new(ax, size_inches=(8.0, 7.0))
        image = axes.imshow(np.log10(np.maximum(found.between, 0.1)), cmap="viridis")
        axes.figure.colorbar(image, ax=axes, label="log10 of the separation (standard deviations)")
        places = list(range(len(found.effects)))
        axes.set_xticks(places, found.effects, rotation=90, fontsize=7)
        axes.set_yticks(places, found.effects, fontsize=7)
        return axes

    def _table(self) -> Table:
        answer = self.to_dict()
        rows = tuple(
            (effect, since, "no strength" if seen is None else f"{seen:.3g} {unit}".strip())
            for effect, since, seen, unit in zip(
                answer["effects"], answer["since"], answer["seen_from"], answer["units"], strict=True
            )
        )
        notes = (
            *(f"{effect} cannot be judged: {reason}" for effect, reason in self.cannot_be_judged.items()),
            *(f"finding: {item.line}" for item in self.findings),
        )
        title = f"{len(rows)} effects that these series can show"
        return Table(title=title, header=("effect", "since", "seen from"), rows=rows, notes=notes)


def plan_session(
    acquisition: AcquisitionFile,
    *,
    twin: Twin | None = None,
    rng: np.random.Generator,
    without: Sequence[str] = (),
    progress: Callable[[str], None] | None = None,
) -> SessionPlan:
    """The distinguishability matrix of a session's series; arguments and errors are those of `diagnose`."""
    # thousands of small matrices: threads would wait for each other longer than they work
    with threadpool_limits(limits=1, user_api="blas"):
        session = prepare_session(acquisition, twin=twin, rng=rng, progress=progress)
        problem = problem_of(session, without=(*without, *session.out_of_question), progress=progress)
        found = distinguishability(problem)
    shares = [EFFECTS[effect].strength.pixels_per_bin(session.factor) for effect in found.effects]
    return SessionPlan(
        distinguishability=replace(found, strengths=found.strengths * shares, seen_from=found.seen_from * shares),
        cannot_be_judged={**problem.missing_effects, **session.lost},
        findings=(*session.findings, *session.other_findings),
    )
