"""Laws of the effects that a twin has: they are off as any effect's may be, and the gap beside them is doubted by as much."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..generator.twin import Twin
from .changes import Variant
from .forward_model import Change
from .inexact_laws import LAW_ERRORS, LAW_PROBE_SHARE, group_factors
from .local_nuisances import LocalNuisances

if TYPE_CHECKING:
    from .assemble import Problem

_LAW_ERROR = LAW_ERRORS[0][0]
_STRENGTH_SD = 0.12  # relative: as far as intervals of strengths are widened


def without_each(base: Twin) -> list[Change]:
    """The base twin less each of its effects, one at a time."""
    return [
        Change(
            label=f"without {item.id}",
            twin=replace(base, effects=tuple(one for one in base.effects if one is not item)),
        )
        for item in base.effects
    ]


def beside_known(problem: "Problem", responses: NDArray[np.float64]) -> "Problem":
    """The problem with what the laws of effects in its base leave open: strength, a share in each group of probes and in each probe.

    Args:
        problem: whose residual these effects are taken off.
        responses: of each of these effects (effect, probe), in standard deviations.
    """
    if not len(responses):
        return problem
    factors = [problem.factors]
    left = LocalNuisances(problem.factors, problem.blocks).solve_all(responses)
    own = np.ones(responses.shape[1])
    for response, effective in zip(responses, left, strict=True):
        factors += [_STRENGTH_SD * response[:, None], group_factors(effective, problem.groups, _LAW_ERROR).toarray().T]
        own = own + (LAW_PROBE_SHARE * _LAW_ERROR * effective) ** 2
    widened = np.concatenate(factors, axis=1)
    names = [f"law of what the twin has, {number}" for number in range(widened.shape[1] - problem.factors.shape[1])]
    root, ask = np.sqrt(own), problem.respond

    def respond(asked: Sequence[Variant]) -> dict[int, NDArray[np.float64]]:
        found: Mapping[int, NDArray[np.float64]] = ask(asked)
        return {number: response / root for number, response in found.items()}

    return replace(
        problem,
        residual=problem.residual / root,
        factors=widened / root[:, None],
        factor_names=(*problem.factor_names, *names),
        curves=tuple(curve.over(root) for curve in problem.curves),
        sd=problem.sd * root,
        noise=problem.noise / root,
        respond=respond,
    )
