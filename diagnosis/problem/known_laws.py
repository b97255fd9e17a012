"""Laws of the effects that a twin has: they are off as any effect's may be, and the gap beside them is doubted by as much.

A session may also show that such an effect is no longer there, or of another strength.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...generator.line.twin import Twin
from ..inference.discrepancy import PROBE_SHARE, USUAL_LEVEL, group_factors
from ..inference.local_nuisances import LocalNuisances
from ..model.changes import Variant
from ..model.forward_model import Change
from .problem import Problem

_STRENGTH_SD = 0.12  # relative: as far as intervals of strengths are widened
CHANGED_SD = 1.0  # the same where a strength may be any, 0 among them
_APART = 1.96 * _STRENGTH_SD
CHANGED_FROM = 8.0  # log evidence from which a strength counts as another one's
_STRENGTH_OF = "strength of {}, which the twin has"
_SHOWN = "the twin has {}, and this session shows"


def without_each(base: Twin) -> list[Change]:
    """The base twin less each of its effects, one at a time."""
    return [
        Change(
            label=f"without {item.id}",
            twin=replace(base, effects=tuple(one for one in base.effects if one is not item)),
        )
        for item in base.effects
    ]


def beside_known(problem: Problem, responses: NDArray[np.float64], effects: Sequence[str]) -> Problem:
    """The problem with what the laws of effects in its base leave open: strength, a share in each group of probes and in each probe.

    Args:
        problem: whose residual these effects are taken off.
        responses: of each of these effects (effect, probe), in standard deviations.
        effects: their ids.
    """
    if not len(responses):
        return problem
    factors, names = [problem.factors], list(problem.factor_names)
    left = LocalNuisances(problem.factors, problem.blocks).solve_all(responses)
    own = np.ones(responses.shape[1])
    for effect, response, effective in zip(effects, responses, left, strict=True):
        of_groups = group_factors(effective, problem.groups, USUAL_LEVEL).toarray().T
        factors += [_STRENGTH_SD * response[:, None], of_groups]
        names.append(_STRENGTH_OF.format(effect))
        names += [f"law of {effect}, which the twin has, {number}" for number in range(of_groups.shape[1])]
        own = own + (PROBE_SHARE * USUAL_LEVEL * effective) ** 2
    widened = np.concatenate(factors, axis=1)
    root, ask = np.sqrt(own), problem.respond

    def respond(asked: Sequence[Variant], wanted: NDArray[np.bool_] | None = None) -> dict[int, NDArray[np.float64]]:
        found: Mapping[int, NDArray[np.float64]] = ask(asked, wanted=wanted)
        return {number: response / root for number, response in found.items()}

    return replace(
        problem,
        residual=problem.residual / root,
        factors=widened / root[:, None],
        factor_names=tuple(names),
        curves=tuple(curve.over(root) for curve in problem.curves),
        sd=problem.sd * root,
        noise=problem.noise / root,
        respond=respond,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownStrength:
    """How strong a session shows an effect that the twin has, in units of the twin's strength: value and 95 % interval.

    log_evidence: of any strength over the twin's own.
    """

    effect: str
    times: tuple[float, float, float]
    log_evidence: float

    @property
    def is_another(self) -> bool:
        """Another one than the twin's, which is known to its own interval."""
        _, low, high = self.times
        return not low - _APART <= 1.0 <= high + _APART

    @property
    def location(self) -> str:
        """The place of an unknown effect that it is."""
        return _STRENGTH_OF.format(self.effect)

    @property
    def note(self) -> str:
        """What to say of it."""
        value, low, high = (max(one, 0.0) for one in self.times)
        return (
            f"{_SHOWN.format(self.effect)} {value:.2f} ({low:.2f} to {high:.2f}) times as much of it: leave"
            " --twin out, or give the twin as it was before, to have it sought anew"
        )


def says_strength(note: str, effect: str) -> bool:
    """Whether a note is of how strong an effect of the twin is here."""
    return note.startswith(_SHOWN.format(effect))


def changed_effect(location: str) -> str | None:
    """The effect of the twin whose strength this place of an unknown effect is; None: it is another place."""
    before, after = _STRENGTH_OF.split("{}")
    if not (location.startswith(before) and location.endswith(after)):
        return None
    return location.removeprefix(before).removesuffix(after)


def known_strengths(
    problem: Problem, nuisances: LocalNuisances, *, of: Sequence[str] | None = None, sd: float = _STRENGTH_SD
) -> tuple[KnownStrength, ...]:
    """How strong a session shows each effect that its base has, where any strength is possible, the likeliest change first.

    With f the strength's nuisance, C the probes' covariance with it, q = f^T C^-1 f and b = f^T C^-1 r, a prior w times as wide adds

        -log(1 + (w^2 - 1) q) / 2 + (w^2 - 1) b^2 / (2 (1 + (w^2 - 1) q))

    to the log evidence; q is one less the nuisance's variance once the probes are seen, and b its most probable value.

    Args:
        problem: after `beside_known`.
        nuisances: of the problem.
        of: effects to read (None: all).
        sd: relative, that the problem gives these strengths.
    """
    wider = (CHANGED_SD / sd) ** 2
    places = {name: number for number, name in enumerate(problem.factor_names)}
    effects = [item.id for item in problem.base.effects if of is None or item.id in of]
    own = [(effect, places[_STRENGTH_OF.format(effect)]) for effect in effects if _STRENGTH_OF.format(effect) in places]
    if not own:
        return ()
    best, variance = nuisances.fitted(problem.residual), nuisances.variance
    found = []
    for effect, place in own:
        seen = min(max(1.0 - float(variance[place]), 0.0), 1.0 - 1e-12)
        grown = 1.0 + (wider - 1.0) * seen
        value, left = wider * float(best[place]) / grown, math.sqrt(wider * (1.0 - seen) / grown)
        times = [1.0 + sd * (value + way * left) for way in (0.0, -1.959964, 1.959964)]
        evidence = -0.5 * math.log(grown) + 0.5 * (wider - 1.0) * float(best[place]) ** 2 / grown
        found.append(KnownStrength(effect=effect, times=(times[0], times[1], times[2]), log_evidence=evidence))
    return tuple(sorted(found, key=lambda item: -item.log_evidence))


def with_any_strength(problem: Problem, effects: Sequence[str]) -> Problem:
    """The problem with these effects of its base as strong as the session shows them, 0 among that."""
    names = {_STRENGTH_OF.format(effect) for effect in effects}
    scale = np.array([CHANGED_SD / _STRENGTH_SD if name in names else 1.0 for name in problem.factor_names])
    return replace(problem, factors=problem.factors * scale)
