"""Series that show another kV, filter, load or exposure than their labels say.

Relabelling is a hypothesis of its own. Each lit series gives the logarithm of its level and of its noise over signal, and behind
objects the logarithm of its attenuation over the map's. Under a labelling they are Gaussian about what the spectral model of the
declared instrument gives for the labels:

    level        free constant + tube voltage (sd 0.2) + the same since the calibration (0.2) + beam since (0.05)
                 + 0.15 of what filters take, by voltage + series (0.04)
    noise/signal free constant + all since the calibration (0.35) + beam (0.08) + beam since (0.08) + series (0.08)
    attenuation  all (0.1) + placement of a scene (0.3) + series (0.12)

wide enough for every effect of the catalogue within its plausible range. A labelling in which series take the kV, filters, exposure
or whole setting of others, or two series change places, must be better by `LEAST_EVIDENCE` (natural logarithm).

Validity: needs several series; a session whose labels are all wrong in the same way is consistent.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...acquisition.setting import text_from_filters
from .label_model import DEEPEST, LabelModel, measured_depth, open_field
from .readings import FloatArray, Label, Reading, Suspect

LEAST_EVIDENCE = 10.0
_CONSTANT_SD, _OWN_BEAM_SD = 10.0, 3.0  # of the common level; of a beam of unknown kV or load
# relative; of a beam and of a voltage as much again for series after the calibration
_LEVEL_SDS = {"voltage": 0.2, "beam": 0.05, "filters": 0.15, "series": 0.04}
_GAIN_SDS = {"since": 0.35, "beam": 0.08}
_ATTENUATION_SDS = {"all": 0.1, "placement": 0.3, "series": 0.12}
_OBJECT_EXTRA = 0.05  # of level and noise behind an object
_SUSPECT_Z = 3.5
_MOST_SUSPECTS = 10
_PRICE_OF_A_SETTING = 2.0  # natural logarithm, of more than one word being wrong
_MOST_CHANGES = 4
_THINGS = ("tube voltage", "filters", "exposure time", "tube load", "setting")
_Candidate = tuple[float, list[Label], tuple[int, ...], str]  # price, labelling, series it changes, in words


def relabelled(judged: Sequence[Reading], maps: LabelModel) -> list[Suspect]:
    """Series that fit far better with a label of other series; the likeliest change first, then the next on top of it."""
    features = _features(judged, maps)
    labels = [item.label for item in judged]
    names = [item.name for item in judged]

    def evidence(candidate: Sequence[Label]) -> float:
        return sum(feature.log_evidence(candidate) for feature in features)

    found: list[Suspect] = []
    if not features:
        return found
    current = evidence(labels)
    for _ in range(_MOST_CHANGES):
        strange: dict[int, float] = {}
        for feature in features:
            for index, z in feature.left_out(labels).items():
                strange[index] = max(strange.get(index, 0.0), z)
        suspects = sorted((i for i, z in strange.items() if z > _SUSPECT_Z), key=lambda i: -strange[i])[:_MOST_SUSPECTS]
        best, change, texts = 0.0, list(labels), ""
        which: tuple[int, ...] = ()
        kinds = [item.series.kind for item in judged]
        for price, candidate, members, text in (
            *_exchanged_groups(labels, names, kinds),
            *_candidates(suspects, labels, names),
        ):
            gained = evidence(candidate) - current - price
            if gained > best:
                best, change, texts, which = gained, candidate, text, members
        if not best > LEAST_EVIDENCE:
            break
        found.append(Suspect(series=tuple(names[index] for index in which), text=texts, evidence=best))
        labels = change
        current = evidence(labels)
    return found


@dataclass(frozen=True, slots=True)
class _Feature:
    """One number of each of some series: values, standard deviations of their own, and what labels let expect."""

    members: tuple[int, ...]
    values: FloatArray
    own_sd: FloatArray
    expected: Callable[[int, Label], float]
    covariance: Callable[[Sequence[int], Sequence[Label]], FloatArray]

    def log_evidence(self, labels: Sequence[Label]) -> float:
        from scipy.linalg import cholesky, solve_triangular

        residual, covariance = self._residual(labels)
        factor = cholesky(covariance, lower=True)
        whitened = np.asarray(solve_triangular(factor, residual, lower=True), dtype=np.float64)
        return float(-0.5 * whitened @ whitened - np.sum(np.log(np.diag(factor))))

    def left_out(self, labels: Sequence[Label]) -> dict[int, float]:
        """|z| of each member given all others."""
        residual, covariance = self._residual(labels)
        inverse = np.linalg.inv(covariance)
        z = np.abs(inverse @ residual) / np.sqrt(np.diag(inverse))
        return dict(zip(self.members, z.tolist(), strict=True))

    def _residual(self, labels: Sequence[Label]) -> tuple[FloatArray, FloatArray]:
        """Values less what labels let expect (member,), and the covariance of that (member, member)."""
        own = [labels[index] for index in self.members]
        expected = [self.expected(index, label) for index, label in zip(self.members, own, strict=True)]
        return self.values - np.array(expected), self.covariance(self.members, own) + np.diag(self.own_sd**2)


def _same(keys: Sequence[object]) -> FloatArray:
    return np.array([[float(one == other) for other in keys] for one in keys])


def _features(judged: Sequence[Reading], maps: LabelModel) -> list[_Feature]:
    features = []
    since = [item.since for item in judged]

    def beams(members: Sequence[int], labels: Sequence[Label]) -> tuple[FloatArray, FloatArray]:
        keys = [label.beam for label in labels]
        later = [(key, since[index]) for key, index in zip(keys, members, strict=True)]
        late = np.array([float(since[index]) for index in members])
        return _same(keys), _same(later) * np.outer(late, late)

    def free(labels: Sequence[Label]) -> FloatArray:
        """Beams whose level no model gives."""
        keys = [label.beam for label in labels]
        unknown = [float(label.load is None or maps.weights(label) is None) for label in labels]
        return _same(keys) * np.outer(unknown, unknown) * _OWN_BEAM_SD**2

    levels: dict[int, tuple[float, float]] = {}
    for index, item in enumerate(judged):
        if item.series.kind == "flat":
            levels[index] = (math.log(item.level_DN), math.hypot(_LEVEL_SDS["series"], item.released))
        else:
            depth = maps.depth(item.series.scene, item.label)
            if depth is None or item.picture is None:
                continue
            open_DN = open_field(item.picture, depth, maps.good)
            if open_DN is not None and open_DN > 0:
                sd = math.hypot(_LEVEL_SDS["series"], _OBJECT_EXTRA, item.released)
                levels[index] = (math.log(open_DN), sd)

    def level_covariance(members: Sequence[int], labels: Sequence[Label]) -> FloatArray:
        _, later = beams(members, labels)
        voltage = _same([label.kV for label in labels])
        late = np.array([float(since[index]) for index in members])
        taken = np.array([maps.taken_by_filters(label) for label in labels])
        return np.asarray(
            _CONSTANT_SD**2
            + voltage * (_LEVEL_SDS["voltage"] ** 2 + _LEVEL_SDS["voltage"] ** 2 * np.outer(late, late))
            + voltage * _LEVEL_SDS["filters"] ** 2 * np.outer(taken, taken)
            + _LEVEL_SDS["beam"] ** 2 * later
            + free(labels)
        )

    if len(levels) > 1:
        features.append(
            _Feature(
                tuple(levels),
                np.array([value for value, _ in levels.values()]),
                np.array([sd for _, sd in levels.values()]),
                lambda index, label: maps.log_level(label),
                level_covariance,
            )
        )
    gains = {
        index: (
            math.log(item.gain_DN),
            math.hypot(
                _GAIN_SDS["beam"] + (_OBJECT_EXTRA if item.series.kind == "object" else 0.0),
                item.gain_sd,
                item.released,
            ),
        )
        for index, item in enumerate(judged)
        if item.gain_DN > 0
    }

    def gain_covariance(members: Sequence[int], labels: Sequence[Label]) -> FloatArray:
        same, later = beams(members, labels)
        late = [float(since[index]) for index in members]
        unknown = [float(maps.weights(label) is None) for label in labels]
        return np.asarray(
            _CONSTANT_SD**2
            + _GAIN_SDS["since"] ** 2 * np.outer(late, late)
            + _GAIN_SDS["beam"] ** 2 * same
            + _GAIN_SDS["beam"] ** 2 * later
            + same * np.outer(unknown, unknown)
        )

    if len(gains) > 1:
        features.append(
            _Feature(
                tuple(gains),
                np.array([value for value, _ in gains.values()]),
                np.array([sd for _, sd in gains.values()]),
                lambda index, label: maps.log_gain(label),
                gain_covariance,
            )
        )
    features += _attenuation(judged, maps)
    return features


def _attenuation(judged: Sequence[Reading], maps: LabelModel) -> list[_Feature]:
    shadows: dict[int, tuple[FloatArray, NDArray[np.bool_]]] = {}
    for index, item in enumerate(judged):
        if item.series.kind != "object":
            continue
        depth = maps.depth(item.series.scene, item.label)
        measured = None if depth is None else measured_depth(item, depth)
        if depth is None or measured is None:
            continue
        covered = (depth > 0.05) & (depth < DEEPEST) & maps.good
        if covered.sum() >= 50 and float(np.median(measured[covered])) > 0.02:
            shadows[index] = (measured, covered)
    if len(shadows) < 2:
        return []

    def expected(index: int, label: Label) -> float:
        covered = shadows[index][1]
        depth = maps.depth(judged[index].series.scene, label)
        if depth is None:
            return 0.0
        # the deepest parts are where scatter fills in: the median weighs them no more than others
        return math.log(max(float(np.median(depth[covered])), 1e-3))

    def covariance(members: Sequence[int], labels: Sequence[Label]) -> FloatArray:
        places = [(judged[index].series.scene, judged[index].series.source_object_mm) for index in members]
        return np.asarray(_ATTENUATION_SDS["all"] ** 2 + _ATTENUATION_SDS["placement"] ** 2 * _same(places))

    depths = np.array([float(np.median(measured[covered])) for measured, covered in shadows.values()])
    released = np.array([judged[index].released for index in shadows])
    sds = np.hypot(_ATTENUATION_SDS["series"], released / np.maximum(depths, 0.1))
    return [_Feature(tuple(shadows), np.log(depths), sds, expected, covariance)]


def _exchanged_groups(labels: Sequence[Label], names: Sequence[str], kinds: Sequence[str]) -> list[_Candidate]:
    """Labellings in which two tube voltages are exchanged in all flats, all objects or both."""
    voltages = sorted({label.kV for label in labels if label.kV is not None})
    result: list[_Candidate] = []
    for place, low in enumerate(voltages):
        for high in voltages[place + 1 :]:
            exchange = {low: high, high: low}
            for group, title in (
                (("flat",), "all flats"),
                (("object",), "all objects"),
                (("flat", "object"), "all series"),
            ):
                members = tuple(
                    index
                    for index, (label, kind) in enumerate(zip(labels, kinds, strict=True))
                    if kind in group and label.kV in exchange
                )
                if len({labels[index].kV for index in members}) < 2 or (len(group) > 1 and len(set(kinds)) < 2):
                    continue
                changed = list(labels)
                for index in members:
                    changed[index] = replace(labels[index], kV=exchange[labels[index].kV or 0.0])
                text = f"{low:g} kV and {high:g} kV look exchanged in {title} ({names[members[0]]} and others)"
                result.append((0.0, changed, members, text))
    return result


def _candidates(suspects: Sequence[int], labels: Sequence[Label], names: Sequence[str]) -> list[_Candidate]:
    """Labellings in which one suspect takes a label of the session, or two change places."""
    result: list[_Candidate] = []
    for what in _THINGS:
        price = _PRICE_OF_A_SETTING if what == "setting" else 0.0
        for index in suspects:
            seen = {_value(labels[index], what)}
            for donor in labels:
                if _value(donor, what) in seen:
                    continue
                seen.add(_value(donor, what))
                changed = list(labels)
                changed[index] = _takes(labels[index], what, donor)
                text = f"{names[index]} is labelled {_value(labels[index], what)}, but looks like {_value(donor, what)}"
                result.append((price, changed, (index,), text))
        for place, index in enumerate(suspects):
            for other in suspects[place + 1 :]:
                if _value(labels[index], what) == _value(labels[other], what):
                    continue
                changed = list(labels)
                changed[index] = _takes(labels[index], what, labels[other])
                changed[other] = _takes(labels[other], what, labels[index])
                text = (
                    f"{names[index]} ({_value(labels[index], what)}) and {names[other]} ({_value(labels[other], what)})"
                    f" look as if their {what} were exchanged"
                )
                result.append((price, changed, (index, other), text))
    return result


def _takes(label: Label, what: str, donor: Label) -> Label:
    """The label with one thing of another's."""
    changes: dict[str, dict[str, Any]] = {
        "tube voltage": {"kV": donor.kV},
        "filters": {"filters": donor.filters},
        "exposure time": {"exposure_ms": donor.exposure_ms},
        "tube load": {"load": donor.load},
        "setting": {
            "kV": donor.kV,
            "filters": donor.filters,
            "exposure_ms": donor.exposure_ms,
            "load": donor.load,
        },
    }
    return replace(label, **changes[what])


def _value(label: Label, what: str) -> str:
    filters = text_from_filters(label.filters) or "no filter"
    voltage = "unknown kV" if label.kV is None else f"{label.kV:g} kV"
    if what == "tube voltage":
        return voltage
    if what == "filters":
        return filters
    if what == "exposure time":
        return f"{label.exposure_ms or 0:g} ms"
    load = "unknown load" if label.load is None else f"{label.load[1]:g} {label.load[0].rsplit('_', 1)[1]}"
    return load if what == "tube load" else f"{voltage}, {load}, {label.exposure_ms or 0:g} ms, {filters}"
