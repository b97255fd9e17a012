"""What simple methods make of the same sealed cases, scored alike.

`commonest` always says the commonest label, with the shares of labels as probabilities. `nearest_template` takes the
catalogue's own templates and names the one that correlates best with the bare residual, from a threshold on; it knows no
nuisances. `matched_filter` does the same under the nuisances' covariance. `nearest_signature` compares a session's features
with the mean features of each label among training cases; `classifier` is a multinomial logistic regression on the same
features. The last two have no model of the line; they learn from cases with other seeds.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lab.cases import LABELS
from .blind_scores import NONE, UNKNOWN, Outcome, compute_scores
from .blind_separation import matched_filter
from .blind_statistics import SessionStatistics

FALSE_ALARM = 0.05  # rate at which the thresholds of template methods are set, on training cases without effect
_FOLDS = 5
_RIDGES = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
_TEMPERATURES = np.geomspace(0.01, 1.0, 25)
_KEPT = 200  # features at most; with more than cases, those that differ most between labels
_FALLBACK_THRESHOLD = 4.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """A session as baselines see it.

    Fields: targets (share of each class in its label); features by name; bare, matched: best correlation of the residual with
    each effect's templates, without and with the nuisances' covariance, standard deviations.
    """

    targets: Mapping[str, float]
    features: Mapping[str, float]
    bare: Mapping[str, float] = field(default_factory=dict)
    matched: Mapping[str, float] = field(default_factory=dict)

    def templates(self, *, bare: bool) -> Mapping[str, float]:
        """One of the two."""
        return self.bare if bare else self.matched


def example_of(
    label: str, truth: Sequence[str], features: Mapping[str, float], statistics: SessionStatistics | None
) -> Example:
    """A session's example; nothing of the session's own inner products is kept."""
    return Example(
        targets=targets_of(label, truth),
        features=features,
        bare={} if statistics is None else matched_filter(statistics, bare=True),
        matched={} if statistics is None else matched_filter(statistics, bare=False),
    )


def targets_of(label: str, truth: Sequence[str]) -> dict[str, float]:
    """A label as shares of classes; a pair is half of each of its effects."""
    if label == "none":
        return {NONE: 1.0}
    if label == "unknown":
        return {UNKNOWN: 1.0}
    return {name: 1.0 / len(truth) for name in truth}


def classes_of(effects: Sequence[str]) -> tuple[str, ...]:
    """What a baseline may say: nothing, an unknown effect, or one of the catalogue."""
    return (NONE, UNKNOWN, *effects)


def answered(outcome: Outcome, probability: Mapping[str, float]) -> Outcome:
    """The outcome had the answer been these probabilities of classes."""
    first = max(probability, key=lambda name: probability[name])
    ranked = sorted(probability, key=lambda name: -probability[name])
    kept: list[str] = []
    total = 0.0
    for name in ranked:
        kept.append(name)
        total += probability[name]
        if total >= 0.9:
            break
    effects = {name: value for name, value in probability.items() if name not in (NONE, UNKNOWN)}
    return replace(
        outcome,
        verdict="no_gap" if first == NONE else UNKNOWN if first == UNKNOWN else "explained",
        error="",
        top1=first,
        named=frozenset({first}),
        leading=() if first == NONE else (first,),
        leading_probability=probability[first],
        top_set=frozenset(kept),
        marginal=effects,
        p_none=probability.get(NONE, 0.0),
        p_unknown=probability.get(UNKNOWN, 0.0),
        found={},
        shrinks_by=None,
        shrinkage_found=None,
        seconds=None,
        peak_memory_MB=None,
    )


def commonest(effects: Sequence[str]) -> dict[str, float]:
    """Probabilities of classes before looking: the shares with which cases are drawn."""
    each = (LABELS["single"] + LABELS["pair"]) / max(len(effects), 1)
    return {NONE: LABELS["none"], UNKNOWN: LABELS["unknown"], **dict.fromkeys(effects, each)}


@dataclass(frozen=True, slots=True, kw_only=True)
class TemplateRule:
    """Name the best template when it exceeds a threshold. Fields: bare (no nuisances); threshold in standard deviations."""

    bare: bool
    threshold: float

    def probability(self, session: Example, effects: Sequence[str]) -> dict[str, float]:
        """All on the name that is chosen."""
        values = session.templates(bare=self.bare)
        best = max(values, key=lambda name: values[name], default=NONE)
        chosen = best if values and values[best] > self.threshold else NONE
        return {name: float(name == chosen) for name in classes_of(effects)}


def fit_template_rule(examples: Sequence[Example], *, bare: bool) -> TemplateRule:
    """Set the threshold so that one training case without effect in twenty exceeds it; 4.5 without such cases."""
    largest = [
        max(item.templates(bare=bare).values())
        for item in examples
        if item.templates(bare=bare) and item.targets.get(NONE) == 1.0
    ]
    threshold = float(np.quantile(largest, 1.0 - FALSE_ALARM)) if len(largest) >= 5 else _FALLBACK_THRESHOLD
    return TemplateRule(bare=bare, threshold=threshold)


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureScale:
    """Features in a fixed order, standardised. Fields: names; mean, sd (feature,)."""

    names: tuple[str, ...]
    mean: NDArray[np.float64]
    sd: NDArray[np.float64]

    def apply(self, features: Mapping[str, float]) -> NDArray[np.float64]:
        """Standardised features (feature,); what a session lacks is at the mean."""
        values = np.array([features.get(name, math.nan) for name in self.names], dtype=np.float64)
        scaled = (values - self.mean) / self.sd
        return np.asarray(np.clip(np.where(np.isfinite(scaled), scaled, 0.0), -10.0, 10.0))


def fit_scale(examples: Sequence[Example], classes: Sequence[str]) -> FeatureScale:
    """Mean and spread of features that at least a fifth of the examples have; the most telling ones where there are many."""
    counts: dict[str, int] = {}
    for item in examples:
        for name in item.features:
            counts[name] = counts.get(name, 0) + 1
    names = sorted(name for name, count in counts.items() if count >= max(0.2 * len(examples), 2))
    table = np.array([[item.features.get(name, math.nan) for name in names] for item in examples], dtype=np.float64)
    table = table.reshape(len(examples), len(names))
    known = np.isfinite(table)
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, table, 0.0).sum(axis=0) / count
    # by the median of distances: a few huge signatures must not hide all small ones
    spread = np.array([_spread(table[known[:, i], i]) for i in range(len(names))])
    scaled = np.clip(np.where(known, (table - mean) / spread, 0.0), -10.0, 10.0)
    targets = np.array([[item.targets.get(name, 0.0) for name in classes] for item in examples])
    weight = np.maximum(targets.sum(axis=0), 1e-9)
    centres = (targets.T @ scaled) / weight[:, None]
    between = (targets.sum(axis=0)[:, None] * centres**2).sum(axis=0)
    telling = np.sort(np.argsort(-between)[:_KEPT])
    return FeatureScale(names=tuple(names[i] for i in telling), mean=mean[telling], sd=spread[telling])


def _spread(values: NDArray[np.float64]) -> float:
    if values.size < 2:
        return 1.0
    low, high = np.quantile(values, [0.16, 0.84])
    return max(float(high - low) / 2.0, 0.05 * float(values.std()), 1e-3)


@dataclass(frozen=True, slots=True, kw_only=True)
class Signatures:
    """Mean features of each class.

    Fields: scale; classes; centres (class, feature); temperature; quiet (length of features below which it says `none`).
    """

    scale: FeatureScale
    classes: tuple[str, ...]
    centres: NDArray[np.float64]
    temperature: float
    quiet: float

    def probability(self, features: Mapping[str, float]) -> dict[str, float]:
        """By the cosine between a session's features and each signature."""
        x = self.scale.apply(features)
        length = float(np.linalg.norm(x))
        cosine = self.centres @ x / np.maximum(np.linalg.norm(self.centres, axis=1) * max(length, 1e-9), 1e-9)
        weights = np.exp((cosine - cosine.max()) / self.temperature)
        if length < self.quiet:
            weights = np.where(np.array(self.classes) == NONE, weights.sum() * 20.0, weights)
        return dict(zip(self.classes, (weights / weights.sum()).tolist(), strict=True))


def fit_signatures(examples: Sequence[Example], effects: Sequence[str]) -> Signatures:
    """Mean features of each class, less those of cases without effect; the temperature is the best on the examples themselves."""
    classes = classes_of(effects)
    scale = fit_scale(examples, classes)
    table = np.array([scale.apply(item.features) for item in examples])
    targets = np.array([[item.targets.get(name, 0.0) for name in classes] for item in examples])
    centres = (targets.T @ table) / np.maximum(targets.sum(axis=0), 1e-9)[:, None]
    lengths = np.linalg.norm(table, axis=1)
    nothing = targets[:, classes.index(NONE)] == 1.0
    quiet = float(np.quantile(lengths[nothing], 1.0 - FALSE_ALARM)) if nothing.sum() >= 5 else 0.0
    best: tuple[float, Signatures] | None = None
    for temperature in _TEMPERATURES:
        rule = Signatures(scale=scale, classes=classes, centres=centres, temperature=float(temperature), quiet=quiet)
        loss = _log_loss([rule.probability(item.features) for item in examples], examples)
        if best is None or loss < best[0]:
            best = (loss, rule)
    if best is None:
        raise RuntimeError("no temperature was tried")
    return best[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Logistic:
    """Multinomial logistic regression. Fields: scale; classes; weights (class, feature + 1, the last the offset)."""

    scale: FeatureScale
    classes: tuple[str, ...]
    weights: NDArray[np.float64]

    def probability(self, features: Mapping[str, float]) -> dict[str, float]:
        """Probabilities of classes."""
        x = np.append(self.scale.apply(features), 1.0)
        logits = self.weights @ x
        p = np.exp(logits - logits.max())
        return dict(zip(self.classes, (p / p.sum()).tolist(), strict=True))


def fit_logistic(examples: Sequence[Example], effects: Sequence[str]) -> Logistic:
    """Fit with the ridge that does best on examples left out, five folds."""
    classes = classes_of(effects)
    folds = np.arange(len(examples)) % _FOLDS
    losses = []
    for ridge in _RIDGES:
        total = 0.0
        for fold in range(_FOLDS):
            kept = [item for item, own in zip(examples, folds, strict=True) if own != fold]
            held = [item for item, own in zip(examples, folds, strict=True) if own == fold]
            if kept and held:
                rule = _logistic(kept, classes, ridge)
                total += _log_loss([rule.probability(item.features) for item in held], held) * len(held)
        losses.append(total)
    return _logistic(examples, classes, _RIDGES[int(np.argmin(losses))])


def _logistic(examples: Sequence[Example], classes: Sequence[str], ridge: float) -> Logistic:
    from scipy.optimize import minimize

    scale = fit_scale(examples, classes)
    x = np.array([np.append(scale.apply(item.features), 1.0) for item in examples])
    targets = np.array([[item.targets.get(name, 0.0) for name in classes] for item in examples])
    shape = (len(classes), x.shape[1])

    def loss(flat: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        weights = flat.reshape(shape)
        logits = x @ weights.T
        logits -= logits.max(axis=1, keepdims=True)
        log_p = logits - np.log(np.exp(logits).sum(axis=1, keepdims=True))
        penalty = weights.copy()
        penalty[:, -1] *= 0.01
        value = -float((targets * log_p).sum()) + 0.5 * ridge * float((penalty * weights).sum())
        slope = (np.exp(log_p) - targets).T @ x + ridge * penalty
        return value, slope.ravel()

    solved = minimize(loss, np.zeros(shape[0] * shape[1]), jac=True, method="L-BFGS-B", options={"maxiter": 200})
    return Logistic(scale=scale, classes=tuple(classes), weights=solved.x.reshape(shape))


def _log_loss(answers: Sequence[Mapping[str, float]], examples: Sequence[Example]) -> float:
    total = 0.0
    for answer, item in zip(answers, examples, strict=True):
        total -= sum(share * math.log(max(answer.get(name, 0.0), 1e-9)) for name, share in item.targets.items())
    return total / max(len(examples), 1)


def baseline_outcomes(
    outcomes: Sequence[Outcome],
    sessions: Sequence[Example],
    training: Sequence[Example],
    effects: Sequence[str],
) -> dict[str, list[Outcome]]:
    """What each baseline answers to the same cases.

    Args:
        outcomes: opened cases, for their labels.
        sessions: the same cases as baselines see them (targets are not looked at).
        training: examples with other seeds; without them the two that learn are left out.
        effects: the catalogue's ids.
    """
    prior = commonest(effects)
    result = {"commonest": [answered(item, prior) for item in outcomes]}
    for name, bare in (("nearest_template", True), ("matched_filter", False)):
        rule = fit_template_rule(training, bare=bare)
        result[name] = [
            answered(item, rule.probability(session, effects)) for item, session in zip(outcomes, sessions, strict=True)
        ]
    usable = [item for item in training if item.features]
    if len(usable) >= 2 * _FOLDS:
        learnt: tuple[tuple[str, Signatures | Logistic], ...] = (
            ("nearest_signature", fit_signatures(usable, effects)),
            ("classifier", fit_logistic(usable, effects)),
        )
        for name, learner in learnt:
            result[name] = [
                answered(item, learner.probability(session.features))
                for item, session in zip(outcomes, sessions, strict=True)
            ]
    return result


def baseline_scores(answers: Mapping[str, Sequence[Outcome]], effects: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The scores of every baseline, as those of the diagnosis."""
    return {name: compute_scores(outcomes, effects) for name, outcomes in answers.items()}
