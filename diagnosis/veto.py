"""When the best of the explanations is none, and what is kept for what it may have missed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..generator.effects import EFFECTS
from .held_out import Gap
from .inexact_laws import law_terms
from .inference import UNKNOWN, Hypothesis
from .local_nuisances import LocalNuisances
from .problem import Problem

_MOST_LEFT = 0.45  # of the held-out gap that an explanation may leave
# of a probe that shows the gap: of 19 sealed effects named rightly none left more than 0.16, of 25 sessions of a second simulator
# one 0.22; of eleven taken for another name once their own was withheld seven left 0.34 to 1
_MOST_LEFT_TYPICALLY = 0.3
# where all effects act as physics has it, whoever simulates them: of voltages and filters six right ones left nothing of the gap,
# of seven named for the other five 0.39 to 0.44
_MOST_LEFT_EXACTLY = 0.25
# of the gap's sum of squares: right explanations of twelve sessions had less than 0.001, lost bits 0.103, off-focal radiation
# named glare 0.27 to 0.42 in three
_MOST_CONTRADICTED = 0.15
# of all squares that an explanation may leave beyond what nuisances, laws and noise usually take: of sixty right ones one left
# 0.09 and the others below 0.05, seams of tiles named gain map and bad pixels 0.13 to 0.16
_MOST_UNFIT = 0.11
# the same where an effect is stronger than is plausible: of seven such alone, and glare of 8 % beside lag, none left 0.001; a tail
# of 34 %, tails withheld, led to glare of 8.5 % and a focal spot of 0.004 mm, which left 0.12
_MOST_UNFIT_BEYOND = 0.05
_USUALLY_LEFT = 0.6  # of a probe's square where nothing is wrong: floors make it more than counting noise
# what an effect does by chance, rms over what is expected: right gain maps and output drifts 0.4 to 0.8, tiles and their seams
# named gain map 3.4 to 8.7
_MOST_PULLED = 2.0
_LEAST_CHANCES = 5  # parts of what an effect does by chance that must show
_LEAST_UNFIT = 0.1  # of the probes' number: what is usually left is no better known
# share of an explanation's probability: 48 of 49 sealed cases stated as certain were exactly right, and 112 of 122 of two runs
# before it once the faults that they showed were mended
DOUBT = 0.07
_VETO = 0.9  # of the effects' probability that goes to an unknown effect when they leave more


def is_refused(problem: Problem, gap: Gap, leading: Hypothesis) -> bool:
    """Whether what an explanation leaves of the gap speaks against it, on held-out series or on all probes."""
    if leaves_too_much(gap, leading):
        return True
    misfit = misfit_of(problem, leading)
    too_strong = any(leading.strengths[effect][0] > curve.high for effect, curve in leading.variants.items())
    return misfit.refused or (too_strong and misfit.left > _MOST_UNFIT_BEYOND)


def leaves_too_much(gap: Gap, leading: Hypothesis) -> bool:
    """Whether an explanation leaves too much of a clear gap, or sees one where there is none.

    Too much of the typical probe, or of all probes together; one series far outside all others may hold most of
    the gap, and there a law that is right in kind may be off, unless its strength is no plausible one.
    """
    if gap.left is not None and gap.left > _MOST_LEFT_TYPICALLY:
        return True
    null = max(gap.floor, 1.0)
    if gap.before < 1.3 * null:
        return False
    if gap.contradicted > _MOST_CONTRADICTED:
        return True
    left = math.sqrt(max(gap.after**2 - null**2, 0.0)) / math.sqrt(gap.before**2 - null**2)
    if all(EFFECTS[effect].variation.exact for effect in leading.effects):
        return left > _MOST_LEFT_EXACTLY
    return left > _MOST_LEFT and (gap.left is None or not _plausible(leading))


def _plausible(hypothesis: Hypothesis) -> bool:
    """Whether all strengths lie within their plausible ranges."""
    return all(
        curve.low <= hypothesis.strengths[effect][0] <= curve.high for effect, curve in hypothesis.variants.items()
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Misfit:
    """What speaks against an explanation on all probes.

    Fields: left: squares beyond what nuisances, laws and noise usually take, over those that there were; pulled: what effects do
    by chance, rms over what is expected of it, the largest of the effects.
    """

    left: float
    pulled: float

    @property
    def refused(self) -> bool:
        """Whether it is too much for an explanation."""
        return self.left > _MOST_UNFIT or self.pulled > _MOST_PULLED


def misfit_of(problem: Problem, leading: Hypothesis) -> Misfit:
    """How an explanation with the strengths that fit all probes best leaves them."""
    residual, factors, own = problem.residual, [problem.factors], np.ones(len(problem.residual))
    width = problem.factors.shape[1]
    chances: list[slice] = []
    for effect in leading.effects:
        curve, strength = leading.variants[effect], leading.strengths[effect][0]
        residual = residual - curve.response(strength)
        of_law, of_probe = law_terms(replace(curve, spread=None, jitter=None), strength, problem.groups)
        if curve.jitter is not None:
            own = own + strength**2 * curve.jitter
        if curve.spread is not None:
            factors.append(strength * EFFECTS[effect].variation.loosely_tied * curve.spread)
            chances.append(slice(width, width + curve.spread.shape[1]))
            width += curve.spread.shape[1]
        factors.append(of_law)
        width += of_law.shape[1]
        own = own + of_probe
    root = np.sqrt(own)
    allowed = LocalNuisances(np.concatenate(factors, axis=1) / root[:, None], problem.blocks)
    # what nuisances and laws are pulled by counts as well
    beyond = float(residual / root @ allowed.solve(residual / root)) - _USUALLY_LEFT * len(residual)
    there = float(problem.residual @ LocalNuisances(problem.factors, problem.blocks).solve(problem.residual))
    # a gap that lifts all squares to one a probe at the most cannot tell what is left of it from noise that is taken as too small
    judged = beyond > _LEAST_UNFIT * len(residual) and there > len(residual)
    left = beyond / there if judged else 0.0
    found, known = allowed.fitted(residual / root), 1.0 - allowed.variance
    pulled = [
        math.sqrt(float(np.sum(found[chance][seen] ** 2) / np.sum(known[chance][seen])))
        for chance in chances
        if np.count_nonzero(seen := known[chance] > 0.5) >= _LEAST_CHANCES
    ]
    return Misfit(left=left, pulled=max(pulled, default=0.0))


def vetoed(hypotheses: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Hypotheses with nearly all of the effects' probability moved to an unknown effect."""
    named = sum(item.probability for item in hypotheses if item.effects and item.effects != (UNKNOWN,))
    result = []
    for item in hypotheses:
        if item.effects == (UNKNOWN,):
            result.append(replace(item, probability=item.probability + _VETO * named))
        elif item.effects:
            result.append(replace(item, probability=(1.0 - _VETO) * item.probability))
        else:
            result.append(item)
    return tuple(sorted(result, key=lambda item: -item.probability))


def with_doubt(hypotheses: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Hypotheses, most probable first, with a share of each explanation's probability given to what it may have missed.

    Half of it to an unknown effect, half to the likeliest explanation with one effect more or less.
    """
    probability = {item.effects: item.probability for item in hypotheses}
    unknown_known = (UNKNOWN,) in probability
    for item in hypotheses:
        if not item.effects or item.effects == (UNKNOWN,):
            continue
        taken = DOUBT * item.probability
        near = next((other.effects for other in hypotheses if _one_apart(item.effects, other.effects)), None)
        probability[item.effects] -= taken
        if near is not None and unknown_known:
            probability[near] += 0.5 * taken
            probability[(UNKNOWN,)] += 0.5 * taken
        elif near is not None or unknown_known:
            probability[near if near is not None else (UNKNOWN,)] += taken
        else:
            probability[item.effects] += taken
    result = (replace(item, probability=probability[item.effects]) for item in hypotheses)
    return tuple(sorted(result, key=lambda item: -item.probability))


def _one_apart(first: tuple[str, ...], second: tuple[str, ...]) -> bool:
    """Whether one explanation has all effects of the other and one more; no effect at all and the unknown are none."""
    one, other = set(first), set(second)
    return bool(second) and UNKNOWN not in other and len(one ^ other) == 1
