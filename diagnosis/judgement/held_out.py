"""How much of the gap an explanation leaves on series that its fit did not see."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import BoolArray, FloatArray, IndexArray
from ..inference.discrepancy import USUAL_LEVEL, law_terms
from ..inference.inference import UNKNOWN, Hypothesis
from ..inference.nuisances import LocalNuisances
from ..inference.observed import Point
from ..problem.problem import Problem
from ..problem.series_block import SeriesView
from .strengths import points_on

_DRAWS = 300
MOST = 0.5  # share of the gap above noise, or of the squares of what an explanation does, that is most of it


@dataclass(frozen=True, slots=True, kw_only=True)
class Gap:
    """Root mean square of standardised residuals on held-out probes, 1 = noise: before and after, and the floor."""

    before: float
    after: float
    floor: float
    shrinks_by: tuple[float, float, float] | None
    tested: bool = True  # most of what is named shows where others tell its strength well enough to remove it

    @property
    def at_floor(self) -> bool:
        """Whether there was no gap above the floor to remove, and there is none with what was found added."""
        return self.shrinks_by is None and self.after <= max(self.before, self.floor)

    @property
    def falls(self) -> bool:
        """Whether the twin is nearer with what was found added."""
        return self.after < self.before

    @property
    def explained(self) -> bool:
        """Whether what was found takes most of what is above noise, as far as held-out data can tell."""
        if not self.tested or self.at_floor:
            return True
        return self.falls and (self.shrinks_by is None or self.shrinks_by[0] > MOST)


def folds_of(problem: Problem) -> IndexArray:
    """Fold 0 or 1 of each series: alternating in time within each kind, sort of object and tube voltage.

    Where that would leave either fold a single exposure of a voltage, each its own, series go where there are fewer of their exposure
    and of those that calibrate as they do: what exposures do, and what has changed, shows only where both are there.
    """
    folds = [0] * len(problem.views)
    beams: Counter[tuple[Any, ...]] = Counter()
    seen: dict[float | None, tuple[set[float | None], set[float | None]]] = {}
    for number, view in enumerate(problem.views):
        beam, series = _beam(view), view.session.series
        folds[number] = beams[beam] % 2
        beams[beam] += 1
        if view.session.request.beam_on:
            seen.setdefault(series.kV, (set(), set()))[folds[number]].add(series.exposure_ms)
    if any(len(one) == len(other) == 1 and one != other for one, other in seen.values()):
        folds = _balanced(problem)
    return np.array(folds, dtype=np.intp)


def _balanced(problem: Problem) -> list[int]:
    """Folds as even as in time, and in each sort of series as even in exposures and calibrating ones as they can be."""
    counts: Counter[tuple[Any, ...]] = Counter()
    folds = []
    for view in problem.views:
        beam = _beam(view)
        alike = [(*beam, "exposure", view.session.series.exposure_ms), (*beam, "calibrates", view.session.calibrates)]
        crowded = [(counts[fold, *beam], sum(counts[fold, *key] for key in alike), fold) for fold in (0, 1)]
        *_, fold = min(crowded)
        counts.update((fold, *key) for key in (beam, *alike))
        folds.append(fold)
    return folds


def _beam(view: SeriesView) -> tuple[Any, ...]:
    """Kind, sort of object and tube voltage of a series."""
    series = view.session.series
    return (series.kind, view.session.request.scene_kind, series.kV if series.kind != "dark" else None)


def left_over(problem: Problem, fit: BoolArray, added: Sequence[Point] = ()) -> tuple[FloatArray, FloatArray]:
    """What nuisances fitted on `fit` leave of the other probes, in standard deviations of that prediction, and these (probe,).

    added: effects and their strengths that are taken off, in place of the base's own; what they do by chance is fitted beside the
    nuisances and counts as noise. What their laws, and those of the base's effects, may be off by is fitted as well, so that no
    nuisance is drawn away by it, but neither taken off nor counted.
    """
    residual = problem.left_by(added)
    factors, own = problem.with_chance(added)
    inexact, laws = own[fit], [factors[fit]]
    places = problem.places
    named = {point.effect for point in added}
    for point in (*added, *(item for item in problem.given if item.effect not in named)):
        bare = replace(point.curve, spread=None, jitter=None)
        of_law, of_probe = law_terms(bare, point.strength, problem.groups, places, max(point.level, USUAL_LEVEL))
        laws.append(of_law[fit])
        inexact = inexact + of_probe[fit]
    root = np.sqrt(inexact)
    known = LocalNuisances(np.concatenate(laws, axis=1) / root[:, None], problem.blocks[fit])
    # the nuisances' part alone: those of the laws come last
    held = np.pad(factors[~fit], ((0, 0), (0, known.factors.shape[1] - factors.shape[1])))
    left = residual[~fit] - held @ known.fitted(residual[fit] / root)
    sd = np.sqrt(own[~fit] + known.known_of(held))
    return np.asarray(left / sd), np.asarray(sd)


def held_out(
    problem: Problem, leading: Hypothesis, rng: np.random.Generator
) -> tuple[Gap, tuple[tuple[str, float, float, float], ...], dict[str, tuple[float, float, float]]]:
    """Gap before, after and floor on series that the fit did not see, both ways round; shares by effect."""
    folds = folds_of(problem)[problem.series_of]
    size = len(problem.residual)
    before, after = np.full(size, np.nan), np.full(size, np.nan)
    effects = [effect for effect in leading.effects if effect != UNKNOWN]
    alone = {effect: np.full(size, np.nan) for effect in effects}
    noise = np.ones(size)
    power = _power(problem, leading)
    told = 0.0
    for fold in (0, 1):
        fit = folds != fold
        held = ~fit
        if not fit.any() or not held.any():
            continue
        before[held], sd = left_over(problem, fit)
        # what a repeat of the same measurement would show: counting noise, of all that nuisances fitted there allow
        noise[held] = problem.noise[held] / sd
        # what others leave open of the strength would be noise there
        if power[held].sum() <= held.sum() * power[fit].sum():
            told += float(power[held].sum())
        added = points_on(problem, leading, effects, fit)
        after[held] = left_over(problem, fit, added)[0] if effects else before[held]
        for one in added:
            alone[one.effect][held] = left_over(problem, fit, [one])[0]
    known = np.isfinite(before)
    before, after, noise, series = before[known], after[known], noise[known], problem.series_of[known]
    axes = np.array([name.axis for name in problem.names])[known]
    if before.size == 0:
        return Gap(before=1.0, after=1.0, floor=1.0, shrinks_by=None), (), {}

    floor = _rms(noise)
    chosen = {str(axis): axes == axis for axis in dict.fromkeys(axes)}
    rows = [(axis, _rms(before[one]), _rms(after[one]), _rms(noise[one])) for axis, one in chosen.items()]
    found = {effect: shrinkage_of(before, values[known], floor, series, rng) for effect, values in alone.items()}
    shares = {effect: share for effect, share in found.items() if share is not None}
    gap = Gap(
        before=_rms(before),
        after=_rms(after),
        floor=floor,
        shrinks_by=shrinkage_of(before, after, floor, series, rng) if effects else None,
        tested=told >= MOST * float(power.sum()),
    )
    return gap, tuple(rows), shares


def _power(problem: Problem, leading: Hypothesis) -> FloatArray:
    """How far what is named moves each probe (probe,), by its law and by what it has in common by chance: squared deviations."""
    total = np.zeros(len(problem.residual))
    nuisances = LocalNuisances(problem.factors, problem.blocks)
    for point in leading.points():
        total += nuisances.given_others(point.curve.response(point.strength)) ** 2
        total += point.strength**2 * np.sum(point.curve.chance**2, axis=1)
    return total


def _rms(values: FloatArray) -> float:
    return float(math.sqrt(np.mean(values**2))) if values.size else 1.0


def shrinkage_of(
    before: FloatArray, after: FloatArray, floor: float, series: IndexArray, rng: np.random.Generator
) -> tuple[float, float, float] | None:
    """Share of the gap above the floor that is gone, and its 95 % interval, series drawn again; None: no gap above the floor.

    before, after: held-out probes (probe,), in standard deviations; floor: rms of noise alone; series of each probe (probe,).
    """
    scale = 1.0 / math.sqrt(2.0 * max(before.size, 1))
    if _rms(before) < floor + 3.0 * scale:
        return None
    point = (_rms(before) - _rms(after)) / (_rms(before) - floor)
    draws = []
    numbers = np.unique(series)
    members = [np.nonzero(series == number)[0] for number in numbers]
    sums = np.array([[np.sum(before[m] ** 2), np.sum(after[m] ** 2), len(m)] for m in members])
    for _ in range(_DRAWS):
        total = sums[rng.integers(0, len(numbers), len(numbers))].sum(axis=0)
        was, left = math.sqrt(total[0] / total[2]), math.sqrt(total[1] / total[2])
        if was > floor + scale:
            draws.append((was - left) / (was - floor))
    if len(draws) < _DRAWS // 3:
        return None
    low, high = np.quantile(draws, [0.025, 0.975])
    return point, min(float(low), point), max(float(high), point)
