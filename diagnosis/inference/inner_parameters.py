"""Strengths with the inner parameters of laws integrated out: what reach and shape leave open, a strength's interval holds.

Near where refinement found them, theta_0, a response is a straight line in its inner parameters, and each is as likely anywhere in
its range, about the middle of it, theta_m. So what they may change is covariance that grows with the strength, as what an effect
does by chance is:

r ~ N(s m, C + s^2 J J^T),    m = m_0 - (theta_0 - theta_m) dm / dtheta,    J = dm / dtheta * range / sqrt(12)

Source: Rasmussen, Williams, Gaussian Processes for Machine Learning (2006), section 2.7, parameters of a mean that are Gaussian.
"""

import math
from dataclasses import replace

import numpy as np

from ...generator.effects import EFFECTS
from ..model.curves import Curve
from .curve_fits import fit_curve, interval_of
from .discrepancy import only
from .inference import Hypothesis
from .nuisances import Whitening
from .observed import Observed
from .search import from_middle, slopes_of
from .seen import FitTarget, Responder

_SD = 1.0 / math.sqrt(3.0)  # of what is even over a range, in halves of it


def with_inner_open(
    hypothesis: Hypothesis, *, observed: Observed, respond: Responder, whitening: Whitening
) -> Hypothesis:
    """A hypothesis, its curves whitened, whose strengths' intervals hold what its laws' inner parameters leave open."""
    seen = FitTarget(observed=replace(observed, given=()), respond=respond, whitening=whitening)
    opened = {point.effect: _opened(point.curve, point.strength, seen) for point in hypothesis.points()}
    if all(opened[effect] is curve for effect, curve in hypothesis.variants.items()):
        return hypothesis
    strengths = dict(hypothesis.strengths)
    for effect, curve in opened.items():
        beside = observed.conditioned(*hypothesis.effects)
        if hypothesis.misfit_variance is not None:
            beside = beside.with_own_variance(hypothesis.misfit_variance)
        for other, its in opened.items():
            if other != effect:
                beside = beside.in_presence_of(replace(hypothesis.point(other), curve=its))
        fit = fit_curve(beside, curve, levels=only(hypothesis.levels[effect]))
        # the straight line says how much stays open; the strength itself is known from the law as it bends
        value, low, high = hypothesis.strengths[effect]
        _, low_open, high_open = interval_of([fit])
        strengths[effect] = value, min(low, low_open), max(high, high_open)
    return replace(hypothesis, strengths=strengths)


def _opened(curve: Curve, strength: float, seen: FitTarget) -> Curve:
    """A curve with what its inner parameters may change among what the effect does by chance; itself where none is refined."""
    variant = curve.variant
    inner = [item for item in variant.fitted if item.name in variant.parameters]
    if not (inner and EFFECTS[curve.effect].grid.refined and variant.refined_from is not None):
        return curve
    slopes = slopes_of(curve, inner, strength, seen)
    a_unit = slopes.at(1.0)
    by_name = {item.name: item for item in inner}
    away = np.array([from_middle(by_name[name], variant.parameters[name]) for name in slopes.names])
    changes = _SD * a_unit.T
    spread = changes if curve.spread is None else np.concatenate([curve.spread, changes], axis=1)
    middle = curve.responses - np.outer(curve.strengths, away @ a_unit)
    return replace(curve, responses=middle, spread=spread)
