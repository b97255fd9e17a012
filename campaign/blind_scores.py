"""Scores of sealed cases: names against separation, honesty of probabilities, false alarms, the unknown, pairs, strengths.

Every function takes the opened cases and returns plain numbers. A case whose diagnosis failed counts against it
everywhere: it named nothing, was sure of it, and found neither the effect nor its absence.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..generator.line.twin import Z95
from ..lab.cases import SETS
from ..lab.effects import EFFECTS as LAB_EFFECTS
from .blind_separation import NO_EFFECT, Separation

UNKNOWN = "unknown_effect"
NONE = "none"
FAILED = "failed"
EXPLAINED = ("explained", "explained_in_part")
SIGMA_BINS: tuple[tuple[float, float], ...] = ((0, 3), (3, 4), (4, 5), (5, 10), (10, math.inf))
NAMED_FROM = 0.5  # probability from which an effect of an explained case counts as named
TOP_SET = 0.9  # probability that the most probable hypotheses of the top set hold together
CONFIDENT = 0.8  # probability of a wrong name that counts as confident
_PROBABILITY_BINS = 10
_HONEST_DRAWS = 400
_STRENGTH_WITHIN = 0.10
_MARGINAL_FROM = 0.02
_TIE = 4.0  # standard deviations within which two models count as tied


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One opened case.

    Fields: index; label (`none`, `single`, `pair`, `unknown`); truth (ids of the catalogue's effects, of the lab's where it is
    not in the catalogue); strengths and since by id; protocol; geometry; leave_out; withheld (left out of the catalogue for
    this case); verdict (or `failed`); error; top1 (id, `none`, `unknown_effect` or `failed`); named (what the answer names: ids,
    or `none`, `unknown_effect`); leading (effects of the most probable hypothesis), leading_probability; top_set (effects of the
    hypotheses that hold 90 %); marginal (probability by effect); p_none, p_unknown; found (value, low, high of the strength by
    effect, signed); separations by id; misfit (what noise and nuisances leave unexplained without any effect:
    (chi square - probes) / sqrt(2 probes)); shrinks_by and shrinkage_found (value, low, high; or None); seconds; peak_memory_MB.
    """

    index: int
    label: str
    truth: tuple[str, ...]
    strengths: Mapping[str, float]
    since: Mapping[str, str]
    protocol: str
    geometry: str
    leave_out: tuple[str, ...] = ()
    withheld: tuple[str, ...] = ()
    verdict: str
    error: str = ""
    top1: str
    named: frozenset[str]
    leading: tuple[str, ...]
    leading_probability: float
    top_set: frozenset[str]
    marginal: Mapping[str, float]
    p_none: float
    p_unknown: float
    found: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    separations: Mapping[str, Separation] = field(default_factory=dict)
    misfit: float | None = None
    measured_s: float | None = None
    shrinks_by: tuple[float, float, float] | None = None
    shrinkage_found: tuple[float, float, float] | None = None
    seconds: float | None = None
    peak_memory_MB: float | None = None

    @property
    def sigma(self) -> float | None:
        """Separation of the case: of the weaker effect of a pair."""
        values = [self.separations[name].sigma for name in self.truth if name in self.separations]
        return min(values) if values and len(values) == len(self.truth) else None

    @property
    def nearest(self) -> str:
        """The model nearest to the truth."""
        own = [self.separations[name] for name in self.truth if name in self.separations]
        return min(own, key=lambda item: item.sigma).nearest if own else ""

    @property
    def sigma_from_top1(self) -> float | None:
        """How far a single effect lies from the model that was named in its place; None where the name is right or no model."""
        if len(self.truth) != 1 or self.truth[0] not in self.separations or self.top1 == self.truth[0]:
            return None
        own = self.separations[self.truth[0]]
        return own.detection if self.top1 == NONE else own.distances.get(self.top1)

    @property
    def expected(self) -> frozenset[str]:
        """What a right answer names."""
        if self.label == "none":
            return frozenset({NONE})
        if self.label == "unknown":
            return frozenset({UNKNOWN})
        left = frozenset(name for name in self.truth if name not in self.withheld)
        return left or frozenset({UNKNOWN})

    @property
    def full(self) -> bool:
        """Whether the whole measurement set was taken."""
        return self.protocol == "full" and not self.leave_out

    @property
    def leading_right(self) -> bool:
        """Whether the most probable hypothesis is the truth."""
        return frozenset(self.leading or (NONE,)) == self.expected and self.verdict != FAILED


def outcome_of(
    label: Mapping[str, Any],
    result: Mapping[str, Any],
    *,
    separations: Mapping[str, Separation] | None = None,
    withheld: Sequence[str] = (),
    misfit: float | None = None,
) -> Outcome:
    """A label and what the diagnosing process wrote, as one outcome."""
    common: dict[str, Any] = {
        "index": label["index"],
        "label": label["label"],
        "truth": tuple(item["id"] for item in label["effects"]),
        "strengths": {item["id"]: item["strength"] for item in label["effects"]},
        "since": {item["id"]: item["since"] for item in label["effects"]},
        "protocol": label["protocol"],
        "geometry": label["geometry"],
        "leave_out": tuple(label["leave_out"]),
        "withheld": tuple(withheld),
        "separations": dict(separations or {}),
        "misfit": misfit,
        "measured_s": result.get("measured_s"),
        "error": result.get("error", ""),
        "seconds": result.get("seconds"),
        "peak_memory_MB": result.get("peak_memory_MB"),
    }
    answer = result.get("answer")
    if not answer:
        # counted against us: sure of nothing that is true
        return Outcome(
            **common,
            verdict=FAILED,
            top1=FAILED,
            named=frozenset({FAILED}),
            leading=(FAILED,),
            leading_probability=1.0,
            top_set=frozenset({FAILED}),
            marginal={},
            p_none=0.0,
            p_unknown=0.0 if label["label"] == "unknown" else 1.0,
        )
    causes = answer["causes"]
    hypotheses = sorted(answer["hypotheses"], key=lambda item: -item["probability"])
    verdict = answer["verdict"]
    marginal: dict[str, float] = {}
    for item in hypotheses:
        for effect in item["effects"]:
            marginal[effect] = marginal.get(effect, 0.0) + item["probability"]
    marginal.pop(UNKNOWN, None)
    marginal |= {cause["effect"]: cause["probability"] for cause in causes}
    leading = tuple(hypotheses[0]["effects"]) if hypotheses else ()
    if verdict == "no_gap" or not (causes or verdict == UNKNOWN):
        top1, named = NONE, frozenset({NONE})
    elif verdict == UNKNOWN:
        top1, named = UNKNOWN, frozenset({UNKNOWN})
    else:
        top1 = causes[0]["effect"]
        likely = frozenset(cause["effect"] for cause in causes if cause["probability"] >= NAMED_FROM)
        named = (
            frozenset(cause["effect"] for cause in causes) if verdict == "ambiguous" else likely or frozenset({top1})
        )
    top_set: set[str] = set()
    total = 0.0
    for item in hypotheses:
        top_set.update(item["effects"] or (NONE,))
        total += item["probability"]
        if total >= TOP_SET:
            break
    found = {}
    for cause in causes:
        strength = cause["parameters"]["strength"]
        found[cause["effect"]] = (strength["value"], strength["low"], strength["high"])
    shrinks = answer["gap"].get("shrinks_by")
    measured = result.get("shrinkage_found")
    return Outcome(
        **common,
        verdict=verdict,
        top1=top1,
        named=named,
        leading=leading,
        leading_probability=hypotheses[0]["probability"] if hypotheses else 1.0,
        top_set=frozenset(top_set),
        marginal=marginal,
        p_none=answer["probability_no_gap"],
        p_unknown=answer["probability_unknown"],
        found=found,
        shrinks_by=_triple(shrinks),
        shrinkage_found=_triple(measured),
    )


def _triple(value: Mapping[str, float] | None) -> tuple[float, float, float] | None:
    if not value or any(value.get(key) is None for key in ("value", "low", "high")):
        return None
    return value["value"], value["low"], value["high"]


def wilson_interval(hits: int, n: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a proportion.

    Source: Wilson, J. Am. Stat. Assoc. 22 (1927) 209; Brown, Cai & DasGupta, Stat. Sci. 16 (2001) 101.
    """
    if n == 0:
        return 0.0, 1.0
    z, p = Z95, hits / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(centre - half, 0.0), min(centre + half, 1.0)


def share(flags: Iterable[bool]) -> dict[str, Any]:
    """How many of how many, the share and its 95 % interval (Wilson); the share is None without cases."""
    values = [bool(flag) for flag in flags]
    hits, n = sum(values), len(values)
    low, high = wilson_interval(hits, n)
    return {"hits": hits, "n": n, "share": hits / n if n else None, "low": low, "high": high}


def top1_right(outcome: Outcome) -> bool:
    """Whether the first name is right: one of the effects of a pair will do."""
    return outcome.top1 in outcome.expected


def top_set_right(outcome: Outcome) -> bool:
    """Whether everything that is true is among what the answer names."""
    return outcome.expected <= outcome.named


def exactly_right(outcome: Outcome) -> bool:
    """Whether the answer names what is true and nothing else."""
    return outcome.expected == outcome.named


def by_sigma(outcomes: Sequence[Outcome], right: Callable[[Outcome], bool]) -> list[dict[str, Any]]:
    """Share of right answers in bins of the separation; cases without one are in none."""
    rows = []
    for low, high in SIGMA_BINS:
        inside = [item for item in outcomes if item.sigma is not None and low <= item.sigma < high]
        rows.append({"sigma_from": low, "sigma_to": None if math.isinf(high) else high} | share(map(right, inside)))
    return rows


def at_least(outcomes: Sequence[Outcome], sigma: float) -> list[Outcome]:
    """Cases at a separation or more."""
    return [item for item in outcomes if item.sigma is not None and item.sigma >= sigma]


def calibration(probabilities: NDArray[np.float64], right: NDArray[np.bool_]) -> dict[str, Any]:
    """Brier score, expected calibration error, and the reliability curve.

    The error is the mean over ten bins of equal width, weighted by their counts, of |mean probability - share right|. Even
    honest probabilities give more than 0 in a finite sample: `error_if_honest` is the mean and the 95th percentile of the
    error when each case is right with exactly its probability.
    """
    p, hit = np.asarray(probabilities, dtype=np.float64), np.asarray(right, dtype=np.float64)
    if p.size == 0:
        return {"n": 0, "brier": None, "error": None, "error_if_honest": None, "curve": []}
    place = np.clip((p * _PROBABILITY_BINS).astype(int), 0, _PROBABILITY_BINS - 1)

    def error_of(values: NDArray[np.float64]) -> float:
        sums = np.bincount(place, weights=p - values, minlength=_PROBABILITY_BINS)
        return float(np.abs(sums).sum() / p.size)

    rng = np.random.default_rng(0)  # of a tabulated quantity: the same for the same probabilities
    honest = [error_of((rng.random(p.size) < p).astype(np.float64)) for _ in range(_HONEST_DRAWS)]
    curve = []
    for number in range(_PROBABILITY_BINS):
        inside = place == number
        if inside.any():
            curve.append({"probability": float(p[inside].mean())} | share(hit[inside] > 0.5))
    return {
        "n": int(p.size),
        "brier": float(np.mean((p - hit) ** 2)),
        "error": error_of(hit),
        "error_if_honest": {"mean": float(np.mean(honest)), "p95": float(np.quantile(honest, 0.95))},
        "curve": curve,
    }


def marginal_pairs(
    outcomes: Sequence[Outcome], effects: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Probability and presence of every effect in every case, flat."""
    p, present = [], []
    for outcome in outcomes:
        for effect in effects:
            if effect not in outcome.withheld:
                p.append(min(max(outcome.marginal.get(effect, 0.0), 0.0), 1.0))
                present.append(effect in outcome.truth)
    return np.array(p, dtype=np.float64), np.array(present, dtype=bool)


def auroc(positive: NDArray[np.float64], negative: NDArray[np.float64]) -> dict[str, Any]:
    """Area under the receiver operating characteristic, ties counted half, with DeLong's 95 % interval.

    Source: DeLong, DeLong & Clarke-Pearson, Biometrics 44 (1988) 837.
    """
    m, n = len(positive), len(negative)
    if m == 0 or n == 0:
        return {"value": None, "low": None, "high": None, "positives": m, "negatives": n}
    win = (positive[:, None] > negative[None, :]) + 0.5 * (positive[:, None] == negative[None, :])
    value = float(win.mean())
    variance = 0.0
    if m > 1 and n > 1:
        variance = float(win.mean(axis=1).var(ddof=1)) / m + float(win.mean(axis=0).var(ddof=1)) / n
    half = Z95 * math.sqrt(variance)
    return {
        "value": value,
        "low": max(value - half, 0.0),
        "high": min(value + half, 1.0),
        "positives": m,
        "negatives": n,
    }


def compute_scores(outcomes: Sequence[Outcome], effects: Sequence[str]) -> dict[str, Any]:
    """All scores of a set of cases.

    Args:
        outcomes: opened cases.
        effects: the catalogue's ids.
    """
    none = [item for item in outcomes if item.label == "none"]
    single = [item for item in outcomes if item.label == "single"]
    pairs = [item for item in outcomes if item.label == "pair"]
    unknown = [item for item in outcomes if item.label == "unknown"]
    catalogue = single + pairs
    p_leading = np.array([item.leading_probability for item in outcomes], dtype=np.float64)
    right = np.array([item.leading_right for item in outcomes], dtype=bool)
    p_effect, present = marginal_pairs(outcomes, effects)
    offered = p_effect >= _MARGINAL_FROM
    return {
        "cases": {
            "all": len(outcomes),
            "none": len(none),
            "single": len(single),
            "pair": len(pairs),
            "unknown": len(unknown),
            "failed": sum(item.verdict == FAILED for item in outcomes),
            "without_separation": sum(item.sigma is None for item in catalogue),
        },
        "top1": {
            "single": share(map(top1_right, single)),
            "single_by_sigma": by_sigma(single, top1_right),
            "single_from_4_sigma": share(map(top1_right, at_least(single, 4.0))),
            "single_from_5_sigma": share(map(top1_right, at_least(single, 5.0))),
            "all": share(map(top1_right, outcomes)),
        },
        "top_set": {
            "single": share(map(top_set_right, single)),
            "single_by_sigma": by_sigma(single, top_set_right),
            "single_from_5_sigma": share(map(top_set_right, at_least(single, 5.0))),
        },
        "exact": {
            "single": share(map(exactly_right, single)),
            "single_by_sigma": by_sigma(single, exactly_right),
            "single_from_5_sigma": share(map(exactly_right, at_least(single, 5.0))),
            "all": share(map(exactly_right, outcomes)),
        },
        "credible_set_90": share(item.expected <= item.top_set for item in outcomes),
        "leading_hypothesis": calibration(p_leading, right),
        "effect_probabilities": calibration(p_effect, present),
        "effect_probabilities_offered": calibration(p_effect[offered], present[offered])
        | {"from_probability": _MARGINAL_FROM},
        "none": {
            "false_alarms": share(item.verdict in (*EXPLAINED, UNKNOWN, FAILED) for item in none),
            "anything_but_no_gap": share(item.verdict != "no_gap" for item in none),
            "verdicts": _counts(item.verdict for item in none),
        },
        "unknown": {
            "auroc": auroc(_p_unknown(unknown), _p_unknown(catalogue)),
            "auroc_upper_half": auroc(_p_unknown([item for item in unknown if _strong(item)]), _p_unknown(catalogue)),
            "auroc_with_none": auroc(_p_unknown(unknown), _p_unknown(catalogue + none)),
            "found": share(item.verdict == UNKNOWN for item in unknown),
            "seen": share(item.verdict not in ("no_gap", FAILED) for item in unknown),
            "wrongly_explained": share(item.verdict in (*EXPLAINED, FAILED) for item in unknown),
            "verdicts": _counts(item.verdict for item in unknown),
            "by_effect": {
                name: _counts(item.verdict for item in unknown if name in item.truth)
                for name in sorted({name for item in unknown for name in item.truth})
            },
            "claimed_of_catalogue": share(item.verdict == UNKNOWN for item in catalogue),
        },
        "pairs": {
            "both_named": share(item.expected <= item.named for item in pairs),
            "both_named_from_5_sigma": share(item.expected <= item.named for item in at_least(pairs, 5.0)),
            "both_named_by_sigma": by_sigma(pairs, top_set_right),
            "one_named": share(bool(item.expected & item.named) for item in pairs),
            "exact": share(map(exactly_right, pairs)),
        },
        "strength": strength_scores(catalogue),
        "shrinkage": shrinkage_scores(outcomes),
        "wrong_names": wrong_names(single),
        "distances": distances(single, effects),
        "misfit_without_effect": _spread([item.misfit for item in none]),
        "confusion": confusion(outcomes),
        "confusion_by_set": confusion_by_set(single),
        "by_effect": by_effect(single, effects),
        "seconds": _spread([item.seconds for item in outcomes]),
        "peak_memory_MB": _spread([item.peak_memory_MB for item in outcomes]),
    }


def _p_unknown(outcomes: Sequence[Outcome]) -> NDArray[np.float64]:
    return np.array([item.p_unknown for item in outcomes], dtype=np.float64)


def _strong(outcome: Outcome) -> bool:
    """Whether an effect outside the catalogue lies in the upper half (logarithm) of its range in the lab."""
    name = outcome.truth[0]
    law = LAB_EFFECTS[name]
    return abs(outcome.strengths[name]) >= math.sqrt(law.low * law.high)


def _counts(words: Iterable[str]) -> dict[str, int]:
    result: dict[str, int] = {}
    for word in words:
        result[word] = result.get(word, 0) + 1
    return dict(sorted(result.items(), key=lambda item: -item[1]))


def _spread(values: Sequence[float | None]) -> dict[str, float] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"median": float(np.median(known)), "p95": float(np.quantile(known, 0.95)), "largest": max(known)}


def strength_rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Every true effect that was named with a strength: truth, value, interval, separation."""
    rows = []
    for outcome in outcomes:
        for name in outcome.truth:
            if name not in outcome.named or name not in outcome.found:
                continue
            value, low, high = outcome.found[name]
            separation = outcome.separations.get(name)
            rows.append(
                {
                    "index": outcome.index,
                    "label": outcome.label,
                    "effect": name,
                    "true": outcome.strengths[name],
                    "value": value,
                    "low": low,
                    "high": high,
                    "sigma": None if separation is None else separation.sigma,
                }
            )
    return rows


def strength_scores(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Relative error and coverage of the 95 % intervals of strengths whose effect was named."""
    rows = strength_rows(outcomes)
    strong = [row for row in rows if row["sigma"] is not None and row["sigma"] >= 10.0]

    def summary(chosen: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        errors = [abs(row["value"] / row["true"] - 1.0) for row in chosen]
        return {
            "within_10_percent": share(error <= _STRENGTH_WITHIN for error in errors),
            "median_abs_error": float(np.median(errors)) if errors else None,
            "coverage_95": share(row["low"] <= row["true"] <= row["high"] for row in chosen),
            "right_sign": share(row["value"] * row["true"] > 0 for row in chosen),
        }

    return {
        "named": summary(rows),
        "from_10_sigma": summary(strong),
        "single_from_10_sigma": summary([row for row in strong if row["label"] == "single"]),
        "by_effect": {
            name: summary([row for row in rows if row["effect"] == name])
            for name in sorted({row["effect"] for row in rows})
        },
    }


def shrinkage_scores(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Shrinkage of the gap as stated by the answer against that found on a second day of the same line."""
    pairs = [
        (item.shrinks_by, item.shrinkage_found)
        for item in outcomes
        if item.shrinks_by is not None and item.shrinkage_found is not None
    ]
    differences = [found[0] - stated[0] for stated, found in pairs]
    return {
        "stated": sum(item.shrinks_by is not None for item in outcomes),
        "compared": len(pairs),
        "within_5_points": share(abs(value) <= 0.05 for value in differences),
        "median_difference": float(np.median(differences)) if differences else None,
        "inside_interval": share(stated[1] <= found[0] <= stated[2] for stated, found in pairs),
    }


def wrong_names(single: Sequence[Outcome]) -> dict[str, int]:
    """Why first names of single effects are wrong.

    `tie`: the named model (or no effect) lies within 4 standard deviations of the truth, so that the data could hardly tell;
    `ours`: it lies farther away; `unknown`, `failed`: nothing was named.
    """
    result = {"tie": 0, "ours": 0, "unknown": 0, FAILED: 0, "not_known": 0}
    for item in single:
        if top1_right(item):
            continue
        if item.top1 in (UNKNOWN, FAILED):
            result["unknown" if item.top1 == UNKNOWN else FAILED] += 1
        elif item.sigma_from_top1 is None:
            result["not_known"] += 1
        else:
            result["tie" if item.sigma_from_top1 < _TIE else "ours"] += 1
    return result


def distances(single: Sequence[Outcome], effects: Sequence[str]) -> dict[str, dict[str, float]]:
    """Distinguishability: median distance of each planted effect from each other one and from none, standard deviations."""
    result: dict[str, dict[str, float]] = {}
    for effect in effects:
        own = [item.separations[effect] for item in single if item.truth == (effect,) and effect in item.separations]
        if own:
            row = {NO_EFFECT: float(np.median([item.detection for item in own]))}
            for other in effects:
                known = [item.distances[other] for item in own if other in item.distances]
                if known:
                    row[other] = float(np.median(known))
            result[effect] = row
    return result


def confusion(outcomes: Sequence[Outcome]) -> dict[str, dict[str, int]]:
    """Counts of first names by what was true; pairs count under both of theirs unless the name is one of them."""
    table: dict[str, dict[str, int]] = {}
    for outcome in outcomes:
        if outcome.label == "pair":
            rows = [outcome.top1] if outcome.top1 in outcome.truth else list(outcome.truth)
        elif outcome.label == "unknown":
            rows = list(outcome.truth)
        else:
            rows = list(outcome.truth) or [NONE]
        for row in rows:
            cells = table.setdefault(row, {})
            cells[outcome.top1] = cells.get(outcome.top1, 0) + 1
    return table


def confusion_by_set(single: Sequence[Outcome]) -> dict[str, dict[str, Any]]:
    """For each set of effects that are easily confused: how its single cases were named."""
    result = {}
    for name, members in SETS.items():
        inside = [item for item in single if item.truth[0] in members]
        ways = {"right": 0, "within_set": 0, "outside_set": 0, NONE: 0, UNKNOWN: 0, FAILED: 0}
        for item in inside:
            if top1_right(item):
                ways["right"] += 1
            elif item.top1 in ways:
                ways[item.top1] += 1
            else:
                ways["within_set" if item.top1 in members else "outside_set"] += 1
        result[name] = {"n": len(inside), **ways, "from_5_sigma": share(map(top1_right, at_least(inside, 5.0)))}
    return result


def by_effect(single: Sequence[Outcome], effects: Sequence[str]) -> dict[str, dict[str, Any]]:
    """For each effect alone: first names overall and from 5 sigma, and the median separation."""
    result = {}
    for effect in effects:
        own = [item for item in single if item.truth[0] == effect]
        sigmas = [item.sigma for item in own if item.sigma is not None]
        result[effect] = {
            "top1": share(map(top1_right, own)),
            "top1_from_5_sigma": share(map(top1_right, at_least(own, 5.0))),
            "median_sigma": float(np.median(sigmas)) if sigmas else None,
            "nearest": _counts(item.nearest for item in own if item.nearest),
        }
    return result


def withheld_scores(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Scores of leave-one-out: withheld effects must come back unknown, not under another's name with confidence."""
    far = at_least(outcomes, 5.0)

    def confident(item: Outcome) -> bool:
        names = [name for name in item.named if name not in (NONE, UNKNOWN, FAILED)]
        return item.verdict == FAILED or (
            item.verdict in EXPLAINED and any(item.marginal.get(name, 0.0) >= CONFIDENT for name in names)
        )

    return {
        "unknown_from_5_sigma": share(item.verdict == UNKNOWN for item in far),
        "confident_wrong_name_from_5_sigma": share(map(confident, far)),
        "unknown_by_sigma": by_sigma(outcomes, lambda item: item.verdict == UNKNOWN),
        "confident_wrong_name_by_sigma": by_sigma(outcomes, confident),
        "by_effect": {
            name: _counts(item.top1 for item in far if name in item.truth)
            for name in sorted({name for item in far for name in item.truth})
        },
    }
