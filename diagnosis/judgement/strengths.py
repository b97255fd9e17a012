"""How strong an effect is: from the fit, or from where a session shows outright what its strength means."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...generator.effects import EFFECTS, AppliedEffect
from ...generator.frames.conditions import with_conditions
from ...generator.line.twin import Z95
from ..arrays import BoolArray
from ..inference.curve_fits import fit_curve
from ..inference.discrepancy import USUAL_LEVEL, only
from ..inference.inference import Hypothesis
from ..inference.nuisances import Nuisances
from ..inference.observed import Observed, Point
from ..model import changes as scales
from ..model.curves import Curve
from ..problem.assemble import map_changes
from ..problem.output_course import rms_about_mean
from ..problem.problem import Problem
from ..problem.series_block import SeriesView
from ..session.even_maps import Map, mean_over

_NODES = 800
_BEYOND_NODES = 2.0  # times the outermost strengths asked
_MOST_MOVED = 0.01  # of a series' level, by an effect beside a drifting output: its law is known to a tenth of that
# of its level: noise of a frame's mean, beyond which (behind opaque objects) it tells nothing of the output
_NOISIEST = 0.01
_LEAST_SERIES = 5
_LEAST_OPEN = 0.02  # share of the field that lies open in a series whose level tells of the output
_NEAR_PX = 6  # from an object's outline: where it may really lie, and what its edge spreads


def applied_at_best(problem: Problem, hypothesis: Hypothesis, effect: str) -> AppliedEffect:
    """The effect as a hypothesis has it, in this session, with the strength that fits all probes best.

    The fit of a drifting output or a changed gain map knows how much it does by chance, not how much it did, and that of a drifting
    dark takes its whole course: these get the strength that was read.
    """
    point = hypothesis.point(effect)
    value, low, high = strength_of(problem, hypothesis, effect)
    reading = EFFECTS[effect].reading
    if reading.frame_levels or reading.map_rms or reading.last_dark:
        point = replace(point, strength=value)
    return replace(
        _applied(problem, point), strength_sd=math.log(high / low) / (2.0 * Z95), law_sd=hypothesis.levels[effect]
    )


def _applied(problem: Problem, point: Point) -> AppliedEffect:
    return with_conditions(point.curve.variant.applied(point.strength), problem.conditions)


def strength_of(problem: Problem, hypothesis: Hypothesis, effect: str) -> tuple[float, float, float]:
    """Value and 95 % interval, with what real effects depart from the catalogue's laws and definitions of strength.

    Where the session shows what the strength means, it is read from there, whatever the rest of the law asks for.
    """
    curve, reading = hypothesis.variants[effect], EFFECTS[effect].reading
    found, read_sd = None, reading.sd
    if reading.frame_levels:
        found = _output_rms(problem, hypothesis, effect)
    elif reading.map_rms:
        found = _map_rms(problem, hypothesis, effect)
    elif reading.last_dark:
        found = _last_dark(problem, hypothesis, effect)
    if found is None and (reading.map_rms or reading.last_dark):
        read_sd = None  # single pixels, or other series, alone tell it
    if found is None and reading.sd is not None:
        found = _outright(problem, hypothesis, effect)
    value, low, high = hypothesis.strengths[effect] if found is None else found
    # what the session shows the law to be off by, where that is more than usual
    fitted_sd = max(reading.law_sd, _off_by(problem, curve, value, hypothesis.levels.get(effect, 0.0)))
    sd = fitted_sd if found is None or read_sd is None else read_sd
    below, above = (math.hypot(math.log(one / value), Z95 * sd) for one in (low, high))
    return value, value * math.exp(-below), max(min(value * math.exp(above), curve.variant.most), value)


def _off_by(problem: Problem, curve: Curve, strength: float, level: float) -> float:
    """Relative sd of a strength whose law is off by one factor, of `level`, in each family: level sqrt(sum w^2) / sum w."""
    if level == 0.0:
        return 0.0
    weight = np.bincount(problem.families.of, weights=curve.response(strength) ** 2)
    return level * math.sqrt(float(np.sum(weight**2))) / max(float(np.sum(weight)), 1e-300)


def _outright(problem: Problem, hypothesis: Hypothesis, effect: str) -> tuple[float, float, float] | None:
    """The strength at which the probes that define it have their measured values, and its 95 % interval; None: at none."""
    curve = hypothesis.variants[effect]
    exact = curve.exact
    if exact is None or not exact.any():
        return None
    left = problem.left_by(hypothesis.points(but=effect), without=[effect])[exact]
    lowest, highest = curve.reach
    if len(curve.strengths) > 1:
        # a refined curve is known about its nodes: far from them its cubics may come back to what was measured
        lowest = max(lowest, float(curve.strengths.min()) / _BEYOND_NODES)
        highest = min(highest, float(curve.strengths.max()) * _BEYOND_NODES)
    strengths = np.geomspace(lowest, highest, _NODES)
    responses = curve.weights(strengths) @ curve.responses[:, exact]
    distance = np.sum((left - responses) ** 2, axis=1)
    at = int(np.argmin(distance))
    near = distance < distance[at] + Z95**2
    if at in (0, len(strengths) - 1):
        return None
    return float(strengths[at]), float(strengths[near].min()), float(strengths[near].max())


def _output_rms(problem: Problem, hypothesis: Hypothesis, output: str) -> tuple[float, float, float] | None:
    """Rms of the output over the lit frames, %, about their mean; None: beside another effect hardly any level is known.

    Every frame tells its own level. Levels of the calibrating series went into the twin, so their mean says nothing of the output.
    """
    others = hypothesis.points(but=output)
    since = hypothesis.variants[output].variant.since == "calibration"
    signals_DN = [mean_over(view.signal_DN, view.mask) for view in problem.views]
    noises = [_noise_of_a_frame(view) for view in problem.views]
    fields = [_open_field(view) for view in problem.views]
    lit = [
        number
        for number, view in enumerate(problem.views)
        if view.session.request.beam_on
        and not (since and view.session.calibrates)
        and noises[number] < (_NOISIEST * signals_DN[number]) ** 2
        and np.count_nonzero(fields[number]) > _LEAST_OPEN * fields[number].size
    ]
    moved = np.zeros(len(problem.views))
    if others:
        changes = map_changes(problem, [_applied(problem, point) for point in others])
        for number in lit:
            moved[number] = _relative(problem.views[number], changes[number], fields[number])
        lit = [number for number in lit if abs(moved[number]) < _MOST_MOVED]
    if len(lit) < _LEAST_SERIES:
        return None
    views = problem.views
    levels = [_relative(views[one], views[one].residual_DN, fields[one]) - moved[one] for one in lit]
    courses = [views[one].summary.frame_mean_DN / signals_DN[one] for one in lit]
    rms = rms_about_mean(levels, courses, [noises[one] / signals_DN[one] ** 2 for one in lit])
    return None if rms <= 0.0 else (100.0 * rms, 100.0 * rms, 100.0 * rms)


def _map_rms(problem: Problem, hypothesis: Hypothesis, effect: str) -> tuple[float, float, float] | None:
    """Rms over the pixels, %, of what later flats have changed by, and its 95 % interval; None: it is noise, or cannot be told.

    Other effects are subtracted, and count as far as laws of their kind are off.
    """
    others = hypothesis.points(but=effect)
    later = [
        number
        for number, view in enumerate(problem.views)
        if view.session.series.kind == "flat" and not view.session.calibrates
    ]
    if not later or any(EFFECTS[one.effect].reading.map_rms for one in others):
        return None
    changes: dict[str, list[Map]] = {one.effect: map_changes(problem, [_applied(problem, one)]) for one in others}
    variances, sds = [], []
    for number in later:
        view = problem.views[number]
        mask, signal = view.mask, view.signal_DN
        left, off = view.residual_DN / signal, scales.SHAPE_SD**2
        for one, maps in changes.items():
            moved = maps[number] / signal
            left = left - moved
            off += (EFFECTS[one].reading.law_sd * float(np.std(np.broadcast_to(moved, mask.shape)[mask]))) ** 2
        seen = float(np.var(left[mask]))
        variances.append(seen - mean_over(_noise_variance(view) / signal**2, mask))
        sds.append(math.hypot(off, seen * math.sqrt(2.0 / np.count_nonzero(mask))))
    # one pattern stands in all of them, and what may be wrong with it is the same in all
    weights = 1.0 / np.square(sds)
    value, sd = (float(np.average(one, weights=weights)) for one in (variances, sds))
    if value <= Z95 * sd:
        return None
    low, middle, high = (100.0 * math.sqrt(one) for one in (value - Z95 * sd, value, value + Z95 * sd))
    return middle, low, high


def _last_dark(problem: Problem, hypothesis: Hypothesis, effect: str) -> tuple[float, float, float] | None:
    """The strength at which the last dark of the longest exposure has its level, and its 95 % interval; None: it cannot be told.

    What had drifted when the calibrating darks were taken is the law's, whose inner parameters may lie anywhere in their ranges.
    """
    darks = [
        (view.session.request.exposure_ms, view.session.request.start_s, number)
        for number, view in enumerate(problem.views)
        if view.session.series.kind == "dark" and not view.session.calibrates
    ]
    if not darks:
        return None
    number = max(darks)[2]
    view = problem.views[number]
    others, point = hypothesis.points(but=effect), hypothesis.point(effect)

    def moved_DN(applied: Sequence[AppliedEffect]) -> float:
        return mean_over(map_changes(problem, applied)[number], view.mask) if applied else 0.0

    of_others = moved_DN([_applied(problem, one) for one in others])
    own = _applied(problem, point)
    of_one = moved_DN([own]) / point.strength
    if of_one == 0.0:
        return None
    value = (mean_over(view.residual_DN, view.mask) - of_others) / of_one
    frames = math.sqrt(_noise_of_a_frame(view) / view.summary.frames)
    off = max((EFFECTS[one.effect].reading.law_sd for one in others), default=0.0) * abs(of_others)
    ends = [
        moved_DN([replace(own, parameters={**own.parameters, inner.name: end})]) / point.strength / of_one
        for inner in EFFECTS[effect].parameters
        if inner.fitted and inner.name != "strength"
        for end in (inner.low, inner.high)
    ]
    course = (max(ends) - min(ends)) / math.sqrt(12.0) if ends else 0.0  # even between them
    reach = Z95 * math.hypot(math.hypot(scales.DARK_SD_DN, frames, off) / of_one, course * value)
    return (value, value - reach, value + reach) if value > reach else None


def _noise_variance(view: SeriesView) -> Map:
    """Variance (row, column), DN^2, of noise in a corrected mean frame: of its frames as they show it, of calibration as expected."""
    expected = view.expected.quantum_variance_DN2 + view.expected.white_variance_DN2
    shown = view.summary.pair_variance_DN2 - expected
    return np.asarray(view.noise_DN**2 + shown / view.summary.frames, np.float32)


def _open_field(view: SeriesView) -> BoolArray:
    """Compared pixels (row, column) that no object covers: behind one its thickness is as uncertain as the output drifts."""
    request = view.session.request
    if not request.thickness_mm:
        return view.mask
    from scipy.ndimage import binary_dilation

    covered = np.zeros(view.mask.shape, dtype=bool)
    for thickness_mm in request.thickness_mm.values():
        covered |= np.asarray(thickness_mm) > 0.0
    return np.asarray(view.mask & ~binary_dilation(covered, iterations=_NEAR_PX))


def _relative(view: SeriesView, change_DN: Map, field: BoolArray) -> float:
    """Mean of a change over a part of the field (row, column), relative to the signal there."""
    return mean_over(change_DN, field) / mean_over(view.signal_DN, field)


def _noise_of_a_frame(view: SeriesView) -> float:
    """Variance of a frame's mean over the pixels, DN^2, that is no common factor."""
    pixels = int(np.count_nonzero(view.mask))
    return mean_over(view.noise_DN**2, view.mask) * view.summary.frames / max(pixels, 1)


def points_on(problem: Problem, leading: Hypothesis, effects: Sequence[str], fit: BoolArray) -> list[Point]:
    """Effects at strengths fitted on part of the probes; with two effects, one after the other, three rounds."""
    points = [leading.point(effect) for effect in effects]
    if not points:
        return points
    # in the probes as they are: whitening is of the whole session, whose halves it mixes
    had = [point.effect for point in problem.given]
    part = Observed(
        residual=problem.residual_without(had)[fit],
        nuisances=Nuisances(problem.factors[fit]),
        groups=problem.groups[fit],
        series=problem.series_of[fit],
        places=problem.places[fit],
        given=tuple(
            replace(point, curve=point.curve.of_probes(fit)) for point in problem.given if point.effect not in effects
        ),
    )
    for _ in range(3 if len(points) > 1 else 1):
        for number, point in enumerate(points):
            if point.curve.by_chance_alone:
                continue  # the strength is that of all probes
            others = [other for other in points if other is not point]
            rest = replace(part, residual=problem.left_by(others, without=had)[fit]).conditioned()
            own = replace(point.curve.of_probes(fit), spread=None)
            points[number] = replace(point, strength=fit_curve(rest, own, levels=only(USUAL_LEVEL)).best)
    return points
