"""How far a twin with the effects that were found really shrinks the gap: on another day of the same line.

The second session has the same hidden system and effects, other positions, noise and products. Nothing is fitted there but
nuisances: strengths and inner parameters are those of the first day. The gap is the root mean square of standardised
residuals of series that the nuisances' fit did not see, both ways round, and shrinks towards what noise alone would show, all as
the diagnosis states it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..acquisition.acquisition_io import AcquisitionFile
from ..diagnosis.inference.discrepancy import USUAL_LEVEL
from ..diagnosis.inference.observed import Point
from ..diagnosis.judgement.held_out import folds_of, left_over, shrinkage_of
from ..diagnosis.model.changes import Variant, catalogue_variants
from ..diagnosis.problem.assemble import build_problem
from ..diagnosis.problem.problem import Problem
from ..generator.effects import AppliedEffect
from ..generator.line.twin import Twin

_NAME = "as found"


def second_day_shrinkage(
    acquisition: AcquisitionFile, twin: Twin, added: Sequence[AppliedEffect], *, without: Sequence[str] = ()
) -> dict[str, float] | None:
    """(before - after) / (before - floor) on a second day: `{value, low, high}` (95 %, series drawn again).

    Args:
        acquisition: the second day.
        twin: of the first day, without the effects that were found.
        added: these effects.
        without: effects that were left out of the catalogue.

    Returns:
        None without effects, or where the gap of the second day is not above its floor.
    """
    if not added:
        return None
    own = [_variant(item) for item in added]
    problem = build_problem(
        acquisition,
        replace(twin, effects=()),
        variants=[*catalogue_variants(without=without), *own],
        calibrated_elsewhere=True,
    )
    own_curves = [
        Point(curve=curve, strength=float(curve.strengths[0]), level=USUAL_LEVEL)
        for curve in problem.curves
        if curve.variant.name == _NAME
    ]
    return shrinkage(problem, own_curves)


def shrinkage(problem: Problem, effects: Sequence[Point]) -> dict[str, float] | None:
    """Share of the gap above its floor that effects at given strengths take away, with its 95 % interval over series.

    None where the gap is not above what noise alone would show.
    """
    folds = folds_of(problem)[problem.series_of]
    before, after, noise = (np.full(len(problem.residual), np.nan) for _ in range(3))
    for fold in (0, 1):
        fit = folds != fold
        if fit.any() and not fit.all():
            (before[~fit], sd), (after[~fit], _) = left_over(problem, fit), left_over(problem, fit, effects)
            noise[~fit] = problem.noise[~fit] / sd
    known = np.isfinite(before)
    if not known.any():
        return None
    floor = math.sqrt(float(np.mean(noise[known] ** 2)))
    rng = np.random.default_rng(0)  # the same interval for the same sessions
    found = shrinkage_of(before[known], after[known], floor, problem.series_of[known], rng)
    return None if found is None else dict(zip(("value", "low", "high"), found, strict=True))


def _variant(item: AppliedEffect) -> Variant:
    parameters = dict(item.parameters)
    strength = float(parameters.pop("strength"))
    size = max(abs(strength), 1e-12)
    return Variant(
        effect=item.id,
        name=_NAME,
        parameters=parameters,
        sign=math.copysign(1.0, strength),
        since=item.since,
        low=size,
        high=size,
        strengths=(size,),
    )
