"""Inner parameters and strengths brought to where the probes want them, by asking the forward model again.

The first weighing knows every effect at a few strengths and inner parameters only. An effect that is seen at tens of
standard deviations would be refused for that coarseness alone; so what leads is asked again, closer and closer.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..generator.effects import EFFECTS
from ..generator.effects.effect import Parameter
from .changes import Variant
from .inference import UNKNOWN, CurveFit, Hypothesis, Nuisances, fit_curve

REFINED_FROM = 6.0  # separation from none, its law taken as exact, from which the grid's coarseness matters
_MOST_EFFECTS = 4
_ROUNDS = 3
_NEAR = (0.75, 1.0, 1.33)  # of the strength found: nodes of the refined curve


class Responder(Protocol):
    """Responses (strength, probe) of variants, by their place; those that cannot be asked are left out."""

    def __call__(self, asked: Sequence[Variant], /) -> Mapping[int, NDArray[np.float64]]: ...


class Whitener(Protocol):
    """Responses with the local nuisances integrated out."""

    def apply(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]: ...


def refine(
    hypotheses: Sequence[Hypothesis],
    *,
    variants: Mapping[tuple[str, str], Variant],
    residual: NDArray[np.float64],
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    respond: Responder,
    whitener: Whitener,
) -> list[tuple[Variant, NDArray[np.float64]]]:
    """Variants nearer to what was measured than those of the grid, with their responses (strength, probe).

    Args:
        hypotheses: of the first weighing, with whitened curves.
        variants: of the grid, by effect and name.
        residual, nuisances, groups: whitened, as weighed.
        respond: asks the forward model.
        whitener: of responses.
    """
    result = []
    done: set[str] = set()
    for hypothesis in sorted(hypotheses, key=lambda item: -item.log_evidence):
        if not hypothesis.effects or hypothesis.effects == (UNKNOWN,):
            continue
        for effect in hypothesis.effects:
            if effect in done or len(done) >= _MOST_EFFECTS:
                continue
            rest = residual.copy()
            for other in hypothesis.effects:
                if other != effect:
                    rest -= hypothesis.variants[other].response(hypothesis.strengths[other][0])
            curve = hypothesis.variants[effect]
            fit = fit_curve(rest, curve, nuisances, groups)
            done.add(effect)
            response = curve.response(fit.best)
            if float(response @ nuisances.solve(response)) < REFINED_FROM**2:
                continue
            found = _refined(variants[effect, curve.variant], fit, rest, nuisances, groups, respond, whitener)
            if found is not None:
                result.append(found)
    return result


def _refined(
    variant: Variant,
    fit: CurveFit,
    residual: NDArray[np.float64],
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    respond: Responder,
    whitener: Whitener,
) -> tuple[Variant, NDArray[np.float64]] | None:
    best, strength = variant, fit.best

    def near(parameters: Mapping[str, float], shares: Sequence[float]) -> Variant:
        label = ", ".join(f"{name} {value:.3g}" for name, value in parameters.items())
        return replace(
            variant,
            parameters=dict(parameters),
            name=f"{label}, refined from {variant.name}".strip(", "),
            strengths=tuple(share * strength for share in shares),
        )

    def tried(item: Variant) -> CurveFit | None:
        answer = respond([item])
        if 0 not in answer:
            return None
        return fit_curve(residual, item.curve(whitener.apply(answer[0]), fit.curve.spread), nuisances, groups)

    inner = [item for item in EFFECTS[variant.effect].parameters[1:] if item.fitted and item.name in variant.parameters]
    here = tried(near(best.parameters, (1.0,)))
    if here is None:
        return None
    strength = here.best
    share = 0.5
    for _ in range(_ROUNDS if inner else 1):
        for item in inner:
            for value in _beside(item, best.parameters[item.name], share):
                candidate = tried(near({**best.parameters, item.name: value}, (1.0,)))
                if candidate is not None and candidate.log_evidence > here.log_evidence:
                    here = candidate
                    best = replace(best, parameters={**best.parameters, item.name: value})
                    strength = here.best
                    break
        share *= 0.5
    final = near(best.parameters, _NEAR)
    answer = respond([final])
    return (final, answer[0]) if 0 in answer else None


def _beside(item: Parameter, value: float, share: float) -> list[float]:
    """Values to either side of a parameter's, within its range; `share` of a grid's step away."""
    if item.log:
        step = (math.log(item.high) - math.log(item.low)) / 2.0 * share
        values = [value * math.exp(step), value * math.exp(-step)]
        return [
            min(max(one, item.low), item.high)
            for one in values
            if item.low < one * math.exp(step) and one < item.high * math.exp(step)
        ]
    if item.name.endswith("_deg") and item.high - item.low >= 360.0:
        return [(value + 90.0 * share) % 360.0, (value - 90.0 * share) % 360.0]
    step = (item.high - item.low) / 2.0 * share
    return [
        min(max(one, item.low), item.high)
        for one in (value + step, value - step)
        if item.low - step < one < item.high + step
    ]
