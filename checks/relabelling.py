"""Series that show another kV, filter, load or exposure than their labels say.

Relabelling is a hypothesis of its own. Each lit series gives the logarithm of its level and of its noise over signal, and behind
objects the logarithm of its attenuation over the map's. Under a labelling they are Gaussian about what the spectral model of the
declared instrument gives for the labels:

    level        free constant + tube voltage (sd 0.2) + the same since the calibration (0.2) + beam since (0.05)
                 + 0.15 of what filters take, by voltage + series (0.04)
    noise/signal free constant + all since the calibration (0.35) + beam (0.08) + beam since (0.08) + series (0.08)
    attenuation  all (0.1) + placement of a scene (0.3) + series (0.12)

wide enough for every effect of the catalogue within its plausible range. The tube's inherent filtration is that with which the
labels fit best, or what is expected of tubes. A labelling in which series take the kV, filters, exposure or whole setting of
others, two series change places, or some were read at another gain of the electronics (which scales level and noise over signal
alike), must be better by `LEAST_EVIDENCE` (natural logarithm).

Validity: needs several series; a session whose labels are all wrong in the same way is consistent.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import text_from_filters
from .findings import Finding, FindingCode
from .label_model import DEEPEST, INHERENT, INHERENT_TRIED_MM_AL, LabelModel, measured_depth, open_field
from .readings import FloatArray, Label, Reading

LEAST_EVIDENCE = 10.0
_CONSTANT_SD, _OWN_BEAM_SD = 10.0, 3.0  # of the common level; of a beam of unknown kV or load
# relative; of a beam and of a voltage as much again for series after the calibration
_LEVEL_SDS = {"voltage": 0.2, "beam": 0.05, "filters": 0.15, "series": 0.04}
_GAIN_SDS = {"since": 0.35, "beam": 0.08}
_ATTENUATION_SDS = {"all": 0.1, "placement": 0.3, "series": 0.12}
_OBJECT_EXTRA = 0.05  # of level and noise behind an object
_DOUBTFUL_Z = 3.5
_MOST_DOUBTFUL = 10
_PRICE_OF_A_SETTING = 2.0  # natural logarithm, of more than one word being wrong
_MOST_CHANGES = 4
_MOST_TOLD = 3  # labels that fit into a line
_AS_LIKELY = 2.0  # natural logarithm, by which another label of the same series may be less likely and is told too
# what a finding says is wrong, and the fields of a label that hold it
_THINGS: dict[str, tuple[str, ...]] = {
    "tube voltage": ("kV",),
    "filters": ("filters",),
    "exposure time": ("exposure_ms",),
    "tube load": ("load",),
    "setting": ("kV", "load", "exposure_ms", "filters"),
}
# powers of two: feedback capacitors and pixel binning are switched so
_ELECTRONIC_GAINS = {
    0.125: "an eighth of",
    0.25: "a quarter of",
    0.5: "half",
    2.0: "twice",
    4.0: "four times",
    8.0: "eight times",
}
_Covariance = Callable[[Sequence[int], Sequence[Label]], FloatArray]


@dataclass(frozen=True, slots=True)
class _Relabelling:
    """Other labels for some series.

    Fields: price (natural logarithm); labels, of all series; members: numbers of those that change; says: the sentence's beginning;
    seen: what they look like; stated: the label of a single one.
    """

    price: float
    labels: Sequence[Label]
    members: tuple[int, ...]
    says: str
    seen: str
    stated: str = ""


def relabelled(judged: Sequence[Reading], maps: LabelModel) -> list[Finding]:
    """Series that fit far better with a label of other series; the likeliest change first, then the next on top of it."""
    features = _features(judged, maps)
    labels = [item.label for item in judged]
    names, kinds = [item.name for item in judged], [item.series.kind for item in judged]

    def evidence(candidate: Sequence[Label], inherent_mm_Al: float) -> float:
        usual = -0.5 * ((inherent_mm_Al - INHERENT.centre) / INHERENT.sd) ** 2
        return usual + sum(feature.log_evidence(candidate, inherent_mm_Al) for feature in features)

    found: list[Finding] = []
    if not features:
        return found
    for _ in range(_MOST_CHANGES):
        # of a tube as it is expected, and of the one with which the labels look best
        mm_Al = max(INHERENT_TRIED_MM_AL, key=lambda one: evidence(labels, one))
        tubes = {INHERENT.centre, mm_Al}
        current = evidence(labels, mm_Al)
        strange: dict[int, float] = {}
        for feature in features:
            for index, z in feature.left_out(labels, mm_Al).items():
                strange[index] = max(strange.get(index, 0.0), z)
        doubtful = sorted((i for i, z in strange.items() if z > _DOUBTFUL_Z), key=lambda i: -strange[i])[
            :_MOST_DOUBTFUL
        ]
        candidates = [
            *_exchanged_groups(labels, kinds),
            *_candidates(doubtful, labels, names),
            *_other_gains(doubtful, labels),
        ]
        gains = [
            max(evidence(candidate.labels, one) for one in tubes) - current - candidate.price
            for candidate in candidates
        ]
        best = max(gains, default=0.0)
        if not best > LEAST_EVIDENCE:
            break
        chosen = candidates[gains.index(best)]
        alike = [
            one
            for one, gain in zip(candidates, gains, strict=True)
            if (one.members, one.says) == (chosen.members, chosen.says) and gain > best - _AS_LIKELY
        ]
        first, *others = (names[index] for index in chosen.members)
        seen = tuple(dict.fromkeys(one.seen for one in alike))[:_MOST_TOLD]
        stated = max((one.stated for one in alike), key=len)  # of a whole setting, where that is among them
        labelled = f" (labelled {stated})" if stated else ""
        what = f"{chosen.says} {' or '.join(seen)}{labelled}"
        found.append(Finding(code=FindingCode.LABEL, series=first, others=tuple(others), values={"what": what}))
        labels = list(chosen.labels)
    return found


@dataclass(frozen=True, slots=True)
class _Feature:
    """One number of each of some series: values, standard deviations of their own, and what labels let expect."""

    members: tuple[int, ...]
    values: FloatArray
    own_sd: FloatArray
    expected: Callable[[int, Label, float], float]  # of a tube with so much inherent filtration, mm Al
    covariance: _Covariance

    def log_evidence(self, labels: Sequence[Label], inherent_mm_Al: float) -> float:
        from scipy.linalg import cholesky, solve_triangular

        residual, covariance = self._residual(labels, inherent_mm_Al)
        factor = cholesky(covariance, lower=True)
        whitened = np.asarray(solve_triangular(factor, residual, lower=True), dtype=np.float64)
        return float(-0.5 * whitened @ whitened - np.sum(np.log(np.diag(factor))))

    def left_out(self, labels: Sequence[Label], inherent_mm_Al: float) -> dict[int, float]:
        """|z| of each member given all others."""
        residual, covariance = self._residual(labels, inherent_mm_Al)
        inverse = np.linalg.inv(covariance)
        z = np.abs(inverse @ residual) / np.sqrt(np.diag(inverse))
        return dict(zip(self.members, z.tolist(), strict=True))

    def _residual(self, labels: Sequence[Label], inherent_mm_Al: float) -> tuple[FloatArray, FloatArray]:
        """Values less what labels let expect (member,), and the covariance of that (member, member)."""
        own = [labels[index] for index in self.members]
        expected = [self.expected(index, label, inherent_mm_Al) for index, label in zip(self.members, own, strict=True)]
        return self.values - np.array(expected), self.covariance(self.members, own) + np.diag(self.own_sd**2)


def _same(keys: Sequence[object]) -> FloatArray:
    return np.array([[float(one == other) for other in keys] for one in keys])


_Numbers = dict[int, tuple[float, float]]  # value and its own standard deviation, by number of the series


def _features(judged: Sequence[Reading], maps: LabelModel) -> list[_Feature]:
    def since(members: Sequence[int]) -> FloatArray:
        """1 where both of two series came after the calibration."""
        late = np.array([float(judged[index].since) for index in members])
        return np.outer(late, late)

    def unknown(labels: Sequence[Label], *, load_needed: bool) -> FloatArray:
        """1 for two series of one beam whose level, or noise over signal, no model gives."""
        free = [float(maps.weights(label) is None or (load_needed and label.load is None)) for label in labels]
        return _same([label.beam for label in labels]) * np.outer(free, free)

    def of_levels(members: Sequence[int], labels: Sequence[Label]) -> FloatArray:
        later, voltage = since(members), _same([label.kV for label in labels])
        taken = np.array([maps.taken_by_filters(label) for label in labels])
        return np.asarray(
            _CONSTANT_SD**2
            + _LEVEL_SDS["voltage"] ** 2 * voltage * (1.0 + later)
            + _LEVEL_SDS["filters"] ** 2 * voltage * np.outer(taken, taken)
            + _LEVEL_SDS["beam"] ** 2 * _same([label.beam for label in labels]) * later
            + _OWN_BEAM_SD**2 * unknown(labels, load_needed=True)
        )

    def of_gains(members: Sequence[int], labels: Sequence[Label]) -> FloatArray:
        later, beam = since(members), _same([label.beam for label in labels])
        return np.asarray(
            _CONSTANT_SD**2
            + _GAIN_SDS["since"] ** 2 * later
            + _GAIN_SDS["beam"] ** 2 * beam * (1.0 + later)
            + unknown(labels, load_needed=False)
        )

    def of_attenuations(members: Sequence[int], labels: Sequence[Label]) -> FloatArray:
        places = [(judged[index].series.scene, judged[index].series.source_object_mm) for index in members]
        return np.asarray(_ATTENUATION_SDS["all"] ** 2 + _ATTENUATION_SDS["placement"] ** 2 * _same(places))

    depths, covered = _attenuations(judged, maps)

    def attenuation(index: int, label: Label, inherent_mm_Al: float) -> float:
        depth = maps.depth(judged[index].series.scene, label, inherent_mm_Al=inherent_mm_Al)
        # the deepest parts are where scatter fills in: the median weighs them no more than others
        return 0.0 if depth is None else math.log(max(float(np.median(depth[covered[index]])), 1e-3))

    def of_readout(label: Label) -> float:
        return math.log(label.electronic_gain)

    features = []
    for numbers, expected, covariance in (
        (_levels(judged, maps), lambda _, label, mm_Al: maps.log_level(label, mm_Al) + of_readout(label), of_levels),
        (_gains(judged), lambda _, label, mm_Al: maps.log_gain(label, mm_Al) + of_readout(label), of_gains),
        (depths, attenuation, of_attenuations),
    ):
        if len(numbers) > 1:
            values, sds = np.array(list(numbers.values())).T
            features.append(_Feature(tuple(numbers), values, sds, expected, covariance))
    return features


def _levels(judged: Sequence[Reading], maps: LabelModel) -> _Numbers:
    """Logarithms of the open field's level."""
    found: _Numbers = {}
    for index, item in enumerate(judged):
        if item.series.kind == "flat":
            found[index] = math.log(item.level_DN), math.hypot(_LEVEL_SDS["series"], item.level_sd, item.released)
            continue
        depth = maps.depth(item.series.scene, item.label)
        if depth is None or item.picture is None:
            continue
        open_DN = open_field(item.picture, depth, maps.good)
        if open_DN is not None and open_DN > 0:
            own_sd = math.hypot(_LEVEL_SDS["series"], _OBJECT_EXTRA, item.level_sd, item.released)
            found[index] = math.log(open_DN), own_sd
    return found


def _gains(judged: Sequence[Reading]) -> _Numbers:
    """Logarithms of noise over signal."""
    found: _Numbers = {}
    for index, item in enumerate(judged):
        if item.gain_DN > 0:
            beam_sd = _GAIN_SDS["beam"] + (_OBJECT_EXTRA if item.series.kind == "object" else 0.0)
            found[index] = math.log(item.gain_DN), math.hypot(beam_sd, item.gain_sd, item.released)
    return found


def _attenuations(judged: Sequence[Reading], maps: LabelModel) -> tuple[_Numbers, dict[int, NDArray[np.bool_]]]:
    """Logarithms of the median -log T behind objects, and the pixels (row, column) that it is taken over, by number of the series."""
    found: _Numbers = {}
    pixels: dict[int, NDArray[np.bool_]] = {}
    for index, item in enumerate(judged):
        depth = maps.depth(item.series.scene, item.label) if item.series.kind == "object" else None
        measured = None if depth is None else measured_depth(item, depth)
        if depth is None or measured is None:
            continue
        covered = (depth > 0.05) & (depth < DEEPEST) & maps.good
        middle = float(np.median(measured[covered])) if covered.sum() >= 50 else 0.0
        if middle > 0.02:
            pixels[index] = covered
            found[index] = math.log(middle), math.hypot(_ATTENUATION_SDS["series"], item.released / max(middle, 0.1))
    return found, pixels


def _exchanged_groups(labels: Sequence[Label], kinds: Sequence[str]) -> list[_Relabelling]:
    """Labellings in which two tube voltages are exchanged in all flats, all objects or both, or in all flats behind one filter."""
    voltages = sorted({label.kV for label in labels if label.kV is not None})
    stacks = [text_from_filters(label.filters) for label in labels]
    groups: dict[str, list[int]] = {
        title: [index for index, kind in enumerate(kinds) if kind in group]
        for title, group in (("all flats", ("flat",)), ("all objects", ("object",)))
    }
    if all(groups.values()):
        groups["all series"] = sorted(index for group in groups.values() for index in group)
    behind = {
        stack: [index for index in groups["all flats"] if stacks[index] == stack] for stack in dict.fromkeys(stacks)
    }
    groups |= {
        f"all flats {f'behind {stack}' if stack else 'without filter'}": group
        for stack, group in behind.items()
        if 0 < len(group) < len(groups["all flats"])
    }
    result: list[_Relabelling] = []
    for low, high in combinations(voltages, 2):
        exchange = {low: high, high: low}
        for title, group in groups.items():
            members = tuple(index for index in group if labels[index].kV in exchange)
            if len({labels[index].kV for index in members}) < 2:
                continue
            changed = list(labels)
            for index in members:
                changed[index] = replace(labels[index], kV=exchange[labels[index].kV or 0.0])
            says = f"{low:g} kV and {high:g} kV look exchanged in"
            result.append(_Relabelling(0.0, changed, members, says, title))
    return result


def _candidates(doubtful: Sequence[int], labels: Sequence[Label], names: Sequence[str]) -> list[_Relabelling]:
    """Labellings in which one of the doubtful series takes a label of the session, or two change places."""
    result: list[_Relabelling] = []
    for what in _THINGS:
        price = _PRICE_OF_A_SETTING if what == "setting" else 0.0
        values = [_value(label, what) for label in labels]
        donors: dict[str, Label] = {}
        for value, label in zip(values, labels, strict=True):
            donors.setdefault(value, label)
        for index in doubtful:
            for value, donor in donors.items():
                if value != values[index]:
                    changed = list(labels)
                    changed[index] = _takes(labels[index], what, donor)
                    result.append(_Relabelling(price, changed, (index,), "looks like", value, values[index]))
        for index, other in combinations(doubtful, 2):
            if values[index] != values[other]:
                changed = list(labels)
                changed[index] = _takes(labels[index], what, labels[other])
                changed[other] = _takes(labels[other], what, labels[index])
                seen = f"its {what} ({values[index]}) and that of {names[other]} ({values[other]}) were exchanged"
                result.append(_Relabelling(price, changed, (index, other), "looks as if", seen))
    return result


def _other_gains(doubtful: Sequence[int], labels: Sequence[Label]) -> list[_Relabelling]:
    """Labellings in which a doubtful series, or all of its tube voltage, was read at another gain of the electronics."""
    groups: set[tuple[int, ...]] = {(index,) for index in doubtful}
    groups |= {
        tuple(number for number, label in enumerate(labels) if label.kV == labels[index].kV) for index in doubtful
    }
    result: list[_Relabelling] = []
    for members in sorted(groups):
        if len(members) == len(labels):
            continue
        for factor, word in _ELECTRONIC_GAINS.items():
            changed = list(labels)
            for index in members:
                changed[index] = replace(labels[index], electronic_gain=factor * labels[index].electronic_gain)
            seen = f"read at {word} the electronic gain of the other series (gain mode, binning)"
            result.append(_Relabelling(_PRICE_OF_A_SETTING, changed, members, "looks", seen))
    return result


def _takes(label: Label, what: str, donor: Label) -> Label:
    """The label with one thing of another's."""
    changes: dict[str, Any] = {field: getattr(donor, field) for field in _THINGS[what]}
    return replace(label, **changes)


def _value(label: Label, what: str) -> str:
    texts = {
        "kV": "unknown kV" if label.kV is None else f"{label.kV:g} kV",
        "load": "unknown load" if label.load is None else f"{label.load[1]:g} {label.load[0].rsplit('_', 1)[1]}",
        "exposure_ms": f"{label.exposure_ms or 0:g} ms",
        "filters": text_from_filters(label.filters) or "no filter",
    }
    return ", ".join(texts[field] for field in _THINGS[what])
