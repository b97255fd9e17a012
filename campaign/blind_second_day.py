"""How far a twin with the effects that were found really shrinks the gap: on another day of the same line.

The second session has the same hidden system and effects, other positions, noise and products. Nothing is fitted there but
nuisances: strengths and inner parameters are those of the first day. The gap is the root mean square of standardised
residuals of series that the nuisances' fit did not see, both ways round, as the diagnosis states it; 1 is noise.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile
from ..diagnosis.assemble import Problem, build_problem
from ..diagnosis.changes import Variant, catalogue_variants
from ..diagnosis.curves import Curve
from ..diagnosis.held_out import folds_of, left_over
from ..generator.effects import AppliedEffect
from ..generator.twin import Twin

_DRAWS = 300
_NAME = "as found"


def second_day_shrinkage(
    acquisition: AcquisitionFile, twin: Twin, added: Sequence[AppliedEffect], *, without: Sequence[str] = ()
) -> dict[str, float] | None:
    """(before - after) / (before - 1) on a second day: `{value, low, high}` (95 %, series drawn again).

    Args:
        acquisition: the second day.
        twin: of the first day, without the effects that were found.
        added: these effects.
        without: effects that were left out of the catalogue.

    Returns:
        None without effects, or where the gap of the second day is not above noise.
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
    own_curves = [(curve, float(curve.strengths[0])) for curve in problem.curves if curve.variant == _NAME]
    return shrinkage(problem, own_curves)


def shrinkage(problem: Problem, effects: Sequence[tuple[Curve, float]]) -> dict[str, float] | None:
    """Share of the gap above noise that effects at given strengths take away, with its 95 % interval over series.

    None where the gap is no more than three standard errors above noise.
    """
    folds = folds_of(problem)[problem.series_of]
    squares = np.full((2, len(problem.residual)), np.nan)
    for fold in (0, 1):
        fit = folds != fold
        if fit.any() and not fit.all():
            for row, added in enumerate(((), effects)):
                squares[row, ~fit] = left_over(problem, fit, added) ** 2
    known = np.isfinite(squares[0])
    if not known.any():
        return None
    series = problem.series_of[known]
    numbers = np.unique(series)
    sums = np.array(
        [[*squares[:, known][:, series == number].sum(axis=1), np.sum(series == number)] for number in numbers]
    )

    def share(total: NDArray[np.float64]) -> float | None:
        before, after = math.sqrt(total[0] / total[2]), math.sqrt(total[1] / total[2])
        above = before - 1.0
        return (before - after) / above if above > 3.0 / math.sqrt(2.0 * total[2]) else None

    value = share(sums.sum(axis=0))
    if value is None:
        return None
    rng = np.random.default_rng(0)  # the same interval for the same sessions
    draws = [share(sums[rng.integers(0, len(sums), len(sums))].sum(axis=0)) for _ in range(_DRAWS)]
    low, high = np.quantile([item for item in draws if item is not None] or [value], [0.025, 0.975])
    return {"value": value, "low": min(float(low), value), "high": max(float(high), value)}


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
        options=dict(item.options),
    )
