"""Inner parameters and strength of one variant brought to where the probes want them, by asking the forward model again."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...generator.effects import EFFECTS, Parameter
from ..arrays import FloatArray
from ..model.changes import Variant
from ..model.curves import Curve
from .curve_fits import CurveFit
from .discrepancy import at_most_off
from .seen import FitTarget

_CENTRINGS, _CENTRED = 3, 0.15  # times that nodes are laid anew, and logarithm of the strength that needs none
_ROUNDS = 10  # of a search, at the most: it ends where nothing is gained
ENOUGH, _ENOUGH_SHARE = 1.0, 1e-5  # gain of log evidence, and share of it, that is worth a search or another step
# share of the gain that straight lines promise, below which slopes are asked anew
# Source: Nocedal and Wright (2006), Numerical Optimization, algorithm 4.1
_AS_HOPED = 0.25
_FARTHEST = 0.6  # step in half ranges
_FURTHER = 3.0  # times a step that explained more, tried as well where displacements and widths are sought
_NEAR = (0.75, 1.0, 1.33)  # of the strength found: nodes of the refined curve
_UP_TO = (0.75, 1.0)  # where more cannot be asked: the spectrum ends a tenth above the stated voltage
_ITSELF = (1.0,)  # where the response grows in proportion


def searched(start: CurveFit, seen: FitTarget) -> tuple[Variant, FloatArray] | None:
    """A variant brought to where the probes want it, with its responses (strength, probe) to all; None: it cannot be asked.

    start: from its variant and its best strength; what it does by chance stays.
    """
    variant, like = start.curve.variant, start.curve
    refined = EFFECTS[variant.effect].grid.refined
    inner = [item for item in variant.fitted if refined and item.name in variant.parameters]
    some = seen.most_informative(start)
    cut = some is not seen
    found = _Search(like, some).run(variant, start.best, _in_turn(inner))
    while inner and found is not None and (closer := some.at_smaller_level()) is not None:
        # a law that is more exact than usual is brought nearer than one that is off could tell
        nearer = _Search(like, closer).run(found.variant, found.fit.best, [inner], slopes=found.slopes)
        if nearer is None or some.evidence(nearer.fit.curve) < some.evidence(found.fit.curve) + ENOUGH:
            break
        some, found = closer, nearer
    seen = replace(seen, level=some.level)
    if found is not None and cut:
        # where some series want it others may pull it a little further
        found = _Search(like, seen).run(found.variant, found.fit.best, [inner] if inner else [], rounds=1)
    return None if found is None else _centred(found, like, seen)


def _centred(found: "_Found", like: Curve, seen: FitTarget) -> tuple[Variant, FloatArray] | None:
    """A variant at nodes about the strength that all probes want, as responses that saturate are known near them only."""
    strength = found.fit.best
    final = _answered(found.variant, strength, seen.respond)
    for _ in range(_CENTRINGS):
        if final is None:
            return None
        wanted = seen.fit(replace(like, variant=final[0], responses=seen.own(final[1]))).best
        if abs(math.log(wanted / strength)) < _CENTRED:
            break
        strength = wanted
        final = _answered(found.variant, strength, seen.respond)
    return final


def _answered(
    variant: Variant,
    strength: float,
    respond: Callable[[Sequence[Variant]], Mapping[int, FloatArray]],
    *,
    nodes: Sequence[Sequence[float]] = (_NEAR, _UP_TO),
) -> tuple[Variant, FloatArray] | None:
    """A variant at nodes about a strength, the first that can be asked, with its responses (strength, probe); None: none can."""
    for shares in nodes:
        item = variant.refined(variant.parameters, [share * strength for share in shares])
        answer = respond([item])
        if 0 in answer:
            return item, answer[0]
    return None


@dataclass(frozen=True, slots=True)
class _Found:
    """Where a search ends: what the probes say of the variant, and how its response changes there, if known."""

    fit: CurveFit
    slopes: "Slopes | None" = None

    @property
    def variant(self) -> Variant:
        """With the inner parameters that were found."""
        return self.fit.curve.variant


class _Search:
    """Inner parameters and strength of one variant brought to where the probes want them; like: a curve of the effect."""

    def __init__(self, like: Curve, seen: FitTarget) -> None:
        self._like = seen.cut(like)
        self._seen = seen
        # one strength tells the others where the response grows in proportion
        in_proportion = len(EFFECTS[like.effect].grid.shares) == 1
        self._nodes = (_ITSELF,) if in_proportion else (_NEAR, _UP_TO)
        # laws that may be off hold a fit back along what two parameters explain alike, so a step that helps may go further; but
        # where the law's shape is what is off it leads away
        self._shares = (1.0, 0.3, 0.1) if in_proportion else (1.0, _FURTHER, 0.3, 0.1)

    def run(
        self,
        start: Variant,
        strength: float,
        parts: Sequence[Sequence[Parameter]],
        *,
        rounds: int = _ROUNDS,
        slopes: "Slopes | None" = None,
    ) -> _Found | None:
        """Parts of the inner parameters, one after the other, from a strength (slopes: for the first); None: it cannot be asked."""
        here = self._tried(start, strength)
        if here is None:
            return None
        for number, part in enumerate(parts):
            slopes = None if number else slopes
            for _ in range(rounds):
                learnt = slopes is not None
                slopes = slopes or slopes_of(here.curve, part, _plausible(here), self._seen)
                before = here
                here, hoped = self._stepped(before, part, slopes)
                gained = here.log_evidence - before.log_evidence
                if gained >= max(ENOUGH, _ENOUGH_SHARE * before.log_evidence):
                    slopes = slopes.learnt(before, here, part) if gained > _AS_HOPED * hoped else None
                elif learnt:
                    slopes = None
                else:
                    break
        return _Found(here, slopes)

    def _stepped(self, start: CurveFit, part: Sequence[Parameter], slopes: "Slopes") -> tuple[CurveFit, float]:
        """The best along a step of some parameters, else the start, and the log evidence that straight lines promise."""
        steps, hoped = _newton(start, slopes, self._seen)
        here, variant = start, start.curve.variant
        for share in self._shares:
            helped = here is not start
            if share != 1.0 and helped == (share < 1.0):
                continue
            parameters = dict(variant.parameters)
            for item in part:
                parameters[item.name] = _moved(item, parameters[item.name], share * steps.get(item.name, 0.0))
            if parameters == here.curve.variant.parameters:
                continue  # at the ends of their ranges
            fit = self._tried(replace(variant, parameters=parameters), here.best)
            if fit is not None and fit.log_evidence > here.log_evidence:
                here = fit
        return here, hoped

    def _tried(self, variant: Variant, strength: float) -> CurveFit | None:
        found = _answered(variant, strength, self._seen.ask, nodes=self._nodes)
        return None if found is None else self._seen.fit(replace(self._like, variant=found[0], responses=found[1]))


def _in_turn(inner: Sequence[Parameter]) -> list[Sequence[Parameter]]:
    """Parameters that are sought together, one set after the other: reach before shape, which can stand for it far off."""
    plain = [item for item in inner if not item.sought_last]
    turns = [plain, inner] if len(plain) < len(inner) else [inner]
    return [part for part in turns if part]


@dataclass(frozen=True, slots=True)
class Slopes:
    """How a response changes with inner parameters: rows (parameter, probe) for each half of a parameter's range, at one strength."""

    names: tuple[str, ...]
    rows: FloatArray
    strength: float

    def at(self, strength: float) -> FloatArray:
        """The rows at another strength, to which they are taken to be in proportion."""
        return self.rows * (strength / self.strength)

    def learnt(self, before: CurveFit, after: CurveFit, part: Sequence[Parameter]) -> "Slopes":
        """With what a step of some parameters has shown, along that step.

        Source: Broyden (1965), doi:10.1090/S0025-5718-1965-0198670-6.
        """
        strength = after.best
        first, last = before.curve.variant.parameters, after.curve.variant.parameters
        step = {item.name: _way(item, first[item.name], last[item.name]) for item in part}
        taken = np.array([step[name] for name in self.names])
        rows, length = self.at(strength), float(taken @ taken)
        if length == 0.0:  # at the ends of their ranges: better by its strength alone
            return Slopes(self.names, rows, strength)
        change = np.asarray(after.curve.response(strength)) - np.asarray(before.curve.response(strength))
        rows = rows + np.outer(taken, change - taken @ rows) / length
        return Slopes(self.names, rows, strength)


def slopes_of(curve: Curve, inner: Sequence[Parameter], strength: float, seen: FitTarget) -> Slopes:
    """What small steps of the inner parameters do to a curve's response; those that cannot be asked are left out.

    A step is that share of half a parameter's range by which the law is off: a law as good as exact is looked at as closely.
    """
    variant = curve.variant
    at = np.asarray(curve.response(strength))
    steps, asked = [], []
    step = at_most_off(seen.level)
    for item in inner:
        value = variant.parameters[item.name]
        steps.append(step if _moved(item, value, step) != value else -step)
        moved = {**variant.parameters, item.name: _moved(item, value, steps[-1])}
        asked.append(replace(variant, parameters=moved, strengths=(strength,)))
    answer = seen.ask(asked)
    rows = [(answer[number][0] - at) / steps[number] for number in sorted(answer)]
    return Slopes(
        tuple(inner[number].name for number in sorted(answer)), np.reshape(rows, (len(rows), at.size)), strength
    )


def from_middle(item: Parameter, value: float) -> float:
    """How far a parameter's value lies from the middle of its range, in halves of it; a direction has no middle."""
    if item.goes_round:
        return 0.0
    return _way(item, math.sqrt(item.low * item.high) if item.log else 0.5 * (item.low + item.high), value)


def _plausible(here: CurveFit) -> float:
    """The strength found, within its range: a share of photons beyond it asks for another shape, not for more photons."""
    return min(max(here.best, here.curve.variant.low), here.curve.variant.high)


def _newton(here: CurveFit, slopes: Slopes, seen: FitTarget) -> tuple[dict[str, float], float]:
    """Steps of the inner parameters, each in half of its range, towards where the probes want them, and what they should gain.

    Least squares in parameters, each within its range, and strength, responses taken as straight lines and the law off as usual.
    """
    strength = _plausible(here)
    at, wide = here.curve.response(strength), seen.widened(here.curve, strength)
    rows = np.concatenate([at[None, :], slopes.at(strength)]) / wide.units
    left = wide.residual - rows[0]
    normal = wide.nuisances.inner(rows, rows)
    normal[np.arange(1, len(rows)), np.arange(1, len(rows))] += 1.0
    normal[0, 0] += 1e-9 if strength == here.best else 1e12
    wanted = wide.nuisances.inner(rows, left[None, :])[:, 0]
    solved = _within(normal, wanted, _room(here.curve.variant, slopes.names))
    # shortened as a whole: what parameters explain alike must keep its direction
    farthest = float(np.max(np.abs(solved[1:]), initial=0.0))
    solved *= min(1.0, _FARTHEST / max(farthest, 1e-12))
    gain = float(wanted @ solved - 0.5 * solved @ normal @ solved)
    return {name: float(step) for name, step in zip(slopes.names, solved[1:], strict=True)}, gain


def _room(variant: Variant, names: Sequence[str]) -> FloatArray:
    """Steps (2, 1 + parameter) of the strength, which is free, and of the inner parameters to the ends of their ranges."""
    room: FloatArray = np.full((2, 1 + len(names)), np.inf)
    room[0] *= -1.0
    for item in EFFECTS[variant.effect].parameters:
        if item.name in names and not item.goes_round:
            value = variant.parameters[item.name]
            room[:, 1 + names.index(item.name)] = _way(item, value, item.low), _way(item, value, item.high)
    return room


def _within(normal: FloatArray, wanted: FloatArray, room: FloatArray) -> FloatArray:
    """The x of least x N x / 2 - w x within bounds (2, x)."""
    solved = np.linalg.solve(normal, wanted)
    if np.all((room[0] <= solved) & (solved <= room[1])):
        return np.asarray(solved)
    from scipy.optimize import lsq_linear

    # where there is no room at all, as much as rounding needs
    root, bounds = np.linalg.cholesky(normal).T, (np.minimum(room[0], -1e-12), np.maximum(room[1], 1e-12))
    return np.asarray(lsq_linear(root, root @ solved, bounds=bounds, method="bvls").x)


def _way(item: Parameter, value: float, moved: float) -> float:
    """The step that moves a parameter's value so far, in halves of its range."""
    if item.log:
        return 2.0 * math.log(moved / value) / math.log(item.high / item.low)
    if item.goes_round:
        return ((moved - value + 180.0) % 360.0 - 180.0) / 180.0
    return 2.0 * (moved - value) / (item.high - item.low)


def _moved(item: Parameter, value: float, step: float) -> float:
    """A parameter's value moved by `step` times half of its range, within the range."""
    if item.log:
        moved = value * math.exp(step * math.log(item.high / item.low) / 2.0)
    elif item.goes_round:
        return (value + 180.0 * step) % 360.0
    else:
        moved = value + step * (item.high - item.low) / 2.0
    return min(max(moved, item.low), item.high)
