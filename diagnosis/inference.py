"""Which hypothesis explains a vector of probes: none, one effect, two, or something that is not in the catalogue.

Probes are residuals r (probe,) against the twin, in units of their own standard deviations. Nuisance parameters are
integrated out exactly (they are linear with Gaussian priors): r ~ N(m, C), C = I + F F^T, F (probe, factor) the
responses to the nuisances times their prior standard deviations. With C = L L^T only projections are needed.

    none      m = 0
    effect    m = m_e(s), s the strength, log-uniform over its plausible range, the law's own inaccuracy a random factor
              (LAW_ERRORS) for each group of probes; what the effect does by chance is extra covariance
    pair      m = m_e(s) + m_f(t)
    unknown   m = 0 and an extra variance tau^2 in any number of families of probes, tau log-uniform, at a price for each

Evidence of each is integrated numerically over strengths; a hypothesis' probability is prior x evidence, raised to a
power below 1 where tests on simulated sessions showed overconfidence.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .curve_fits import CurveFit, fit_curve, interval_of, log_mean_exp
from .curves import Curve
from .inexact_laws import LAW_ERRORS
from .nuisances import Nuisances
from .pairs import Doubts, Observed, Single, weigh_pairs
from .unknown import unknown_evidence

UNKNOWN = "unknown_effect"
UNKNOWN_DOUBT = 0.05  # share of what an effect of the catalogue explains that an unknown one must explain beyond it
UNKNOWN_CHANCE = 3.0  # log evidence that sessions without any effect show by chance (up to 3.5 in 46 sealed ones)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hypothesis:
    """One explanation and how probable it is.

    Fields: effects (ids; empty for none; `("unknown_effect",)` for an effect outside the catalogue); probability;
    log_evidence; strengths per effect: best value and 95 % interval (value, low, high); variants per effect; location:
    probe group of an unknown effect; chi_square of the standardised probes left over, nuisances refitted.
    """

    effects: tuple[str, ...]
    probability: float
    log_evidence: float
    strengths: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    variants: Mapping[str, Curve] = field(default_factory=dict)
    location: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Priors:
    """Prior probabilities of the kinds of hypothesis, shared evenly within each kind; they need not sum to 1."""

    none: float = 0.35
    single: float = 0.40
    pair: float = 0.10
    unknown: float = 0.15


def weigh_hypotheses(
    residual: NDArray[np.float64],
    *,
    curves: Sequence[Curve],
    nuisances: Nuisances,
    groups: NDArray[np.intp],
    group_names: Sequence[str],
    unknown_groups: NDArray[np.intp] | None = None,
    unknown_names: Sequence[str] | None = None,
    priors: Priors | None = None,
    power: float = 1.0,
    pairs_from: int = 6,
    law_errors: Sequence[tuple[float, float]] = LAW_ERRORS,
    doubts: Doubts | None = None,
    places: NDArray[np.intp] | None = None,
    fits: Sequence[CurveFit] | None = None,
    unknown: tuple[float, str] | None = None,
) -> tuple[Hypothesis, ...]:
    """All hypotheses, most probable first; their probabilities sum to 1.

    Args:
        residual: standardised probes less the twin's (probe,).
        curves: what each effect would do; several curves of one effect are variants with equal prior.
        nuisances: factor model of what may vary without being an effect.
        groups, group_names: group of each probe (probe,), within which a law's inaccuracy is one factor.
        unknown_groups, unknown_names: partition for the unknown effect; the same as `groups` where absent.
        priors: of the kinds of hypothesis.
        power: calibration of confidence: evidences are raised to it.
        pairs_from: pairs are formed of the best so many effects with every other.
        law_errors: relative errors of an effect's law in each group, and how probable each is.
        doubts: how effects are known to mislead; None: no more than any.
        places: place of each probe (probe,), within which a law is off by a share of no more than what is seen there; the
            groups where absent.
        fits: of the curves, with the same residual, nuisances, groups, places and law errors, where they are known.
        unknown: as `unknown_evidence` finds it with the same residual, nuisances and partition, where it is known.
    """
    priors, doubts = priors or Priors(), doubts or Doubts()
    places = groups if places is None else places
    if fits is None:
        fits = [fit_curve(residual, curve, nuisances, groups, places=places, law_errors=law_errors) for curve in curves]
    singles = _singles(fits)
    count = max(len(singles), 1)
    of_none, of_single = math.log(priors.none), math.log(priors.single / count)
    of_pair = math.log(priors.pair / max(count * (count - 1) // 2, 1))
    weighed = [(Hypothesis(effects=(), probability=0.0, log_evidence=0.0), of_none)]
    for effect, single in singles.items():
        weighed.append(
            (
                Hypothesis(
                    effects=(effect,),
                    probability=0.0,
                    log_evidence=single.log_evidence - doubts.chance.get(effect, 0.0),
                    strengths={effect: interval_of(single.fits)},
                    variants={effect: single.best.curve},
                ),
                of_single,
            )
        )
    observed = Observed(residual=residual, nuisances=nuisances, groups=groups, places=places, law_errors=law_errors)
    for pair in weigh_pairs(observed, singles, curves, doubts=doubts, leading=pairs_from):
        weighed.append(
            (
                Hypothesis(
                    effects=pair.effects,
                    probability=0.0,
                    log_evidence=pair.log_evidence,
                    strengths=pair.strengths,
                    variants=pair.variants,
                ),
                of_pair,
            )
        )
    parts = groups if unknown_groups is None else unknown_groups
    names = group_names if unknown_names is None else unknown_names
    beyond, place = unknown_evidence(residual, nuisances, parts, names) if unknown is None else unknown
    # no law is exact: a strong effect leaves a part of what it does to be explained by anything
    explained = max(item.log_evidence for item, _ in weighed)
    beyond -= UNKNOWN_CHANCE + UNKNOWN_DOUBT * max(0.0, min(beyond, explained))
    likest = max(singles, key=lambda effect: singles[effect].log_evidence, default="")
    if likest and singles[likest].log_evidence > beyond:
        # what chance shows of the effect that looks most like it is no evidence of anything else either
        beyond -= doubts.chance.get(likest, 0.0)
    weighed.append(
        (
            Hypothesis(effects=(UNKNOWN,), probability=0.0, log_evidence=beyond, location=place),
            math.log(priors.unknown),
        )
    )
    scores = np.array([power * item.log_evidence + prior for item, prior in weighed])
    probability = np.exp(scores - scores.max())
    probability /= probability.sum()
    found = (replace(item, probability=float(p)) for (item, _), p in zip(weighed, probability, strict=True))
    return tuple(sorted(found, key=lambda item: (-item.probability, -item.log_evidence)))


def _singles(fits: Sequence[CurveFit]) -> dict[str, Single]:
    """Effects by id, from the fits of their variants."""
    by_effect: dict[str, list[CurveFit]] = {}
    for fit in fits:
        by_effect.setdefault(fit.curve.effect, []).append(fit)
    return {
        effect: Single(
            fits=own,
            best=max(own, key=lambda fit: fit.log_evidence),
            log_evidence=float(log_mean_exp(np.array([fit.log_evidence for fit in own]))),
        )
        for effect, own in by_effect.items()
    }
