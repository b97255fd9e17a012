"""What labels and thickness maps let expect, by the spectral model of the declared instrument."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile
from ..calibration.spectrum.priors import PRIORS
from ..calibration.spectrum.spectral_model import model_for
from ..errors import InputError
from ..generator.line.spectral_signal import OpenBeam, SpectralModel
from .readings import FloatArray, Label, Reading

INHERENT = PRIORS["inherent_filtration_mm_Al"]  # of a tube, beyond what is declared
# from none to that of heavily filtered tubes, closer where spectra change faster
INHERENT_TRIED_MM_AL = (*(0.25 * step for step in range(13)), 3.5, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0)
_OPEN = 0.03  # -log T below which a pixel sees the open field
DEEPEST = 4.0  # -log T beyond which nothing is compared


def spectral_model_of(acquisition: AcquisitionFile, judged: Sequence[Reading]) -> SpectralModel | None:
    """The declared instrument's spectral model up to the voltages of the series; None where none states its voltage."""
    voltages = [item.label.kV for item in judged if item.label.kV is not None]
    if not voltages:
        return None
    materials = {layer.material for item in judged for layer in item.label.filters}
    return model_for(acquisition.instrument, materials=sorted(materials), highest_kV=1.1 * max(voltages))


class LabelModel:
    """What labels and thickness maps let expect: weights of a beam, level and noise of it, -log T of a scene."""

    def __init__(
        self, acquisition: AcquisitionFile, model: SpectralModel | None, stride: int, good: NDArray[np.bool_]
    ) -> None:
        self.scenes = acquisition.scenes
        self.model = model
        self.good = good
        self.stride = stride
        self._weights: dict[tuple[object, ...], FloatArray | None] = {}
        self._depths: dict[tuple[object, ...], FloatArray | None] = {}
        self._thickness: dict[str, dict[str, FloatArray]] = {}
        self._points: dict[str, tuple[FloatArray, NDArray[np.intp]]] = {}

    def weights(self, label: Label, inherent_mm_Al: float = INHERENT.centre) -> FloatArray | None:
        """(3, energy) of a beam, or None where the label does not say enough."""
        if self.model is None or label.kV is None:
            return None
        key = (label.kV, label.filters, inherent_mm_Al)
        if key not in self._weights:
            parameters = self.model.default_parameters()
            parameters[self.model.names.index("inherent_filtration_mm_Al")] = inherent_mm_Al
            try:
                self._weights[key] = self.model.moment_weights(parameters, OpenBeam(kV=label.kV, filters=label.filters))
            except InputError:
                self._weights[key] = None
        return self._weights[key]

    def log_level(self, label: Label, inherent_mm_Al: float = INHERENT.centre) -> float:
        """Logarithm of the level but for a constant."""
        weights = self.weights(label, inherent_mm_Al)
        rate = 0.0 if weights is None else math.log(max(float(weights[0].sum()), 1e-300))
        return rate + label.log_load - 2.0 * math.log(label.distance_mm)

    def taken_by_filters(self, label: Label) -> float:
        """-log of what the filters let through of the level; 0 where it is unknown."""
        weights, bare = self.weights(label), self.weights(replace(label, filters=()))
        if weights is None or bare is None:
            return 0.0
        return math.log(max(float(bare[0].sum()), 1e-300) / max(float(weights[0].sum()), 1e-300))

    def log_gain(self, label: Label, inherent_mm_Al: float = INHERENT.centre) -> float:
        """Logarithm of noise variance over signal but for a constant."""
        weights = self.weights(label, inherent_mm_Al)
        return 0.0 if weights is None else math.log(float(weights[1].sum()) / max(float(weights[0].sum()), 1e-300))

    def thickness(self, scene: str) -> dict[str, FloatArray]:
        """Maps (row, column) of a scene at the pixels looked at; empty where it has none."""
        if scene not in self._thickness:
            maps = self.scenes[scene].thickness_mm if scene in self.scenes else {}
            self._thickness[scene] = {
                material: np.asarray(maps[material], dtype=np.float64)[:: self.stride, :: self.stride]
                for material in maps
            }
        return self._thickness[scene]

    def depth(
        self, scene: str, label: Label, factor: float = 1.0, inherent_mm_Al: float = INHERENT.centre
    ) -> FloatArray | None:
        """-log T (row, column) of a scene with its path lengths times a factor, or None where it is unknown."""
        key = (scene, label.kV, label.filters, factor, inherent_mm_Al)
        if key not in self._depths:
            self._depths[key] = self._depth(scene, label, factor, inherent_mm_Al)
        return self._depths[key]

    def _depth(self, scene: str, label: Label, factor: float, inherent_mm_Al: float) -> FloatArray | None:
        maps, weights = self.thickness(scene), self.weights(label, inherent_mm_Al)
        if not maps or weights is None or self.model is None:
            return None
        try:
            mu = np.stack([self.model.mu(material)[: weights.shape[1]] for material in maps])
        except InputError:
            return None
        if scene not in self._points:
            points = np.stack([image.ravel() for image in maps.values()], axis=1)
            distinct, place = np.unique(np.round(points, 3), axis=0, return_inverse=True)
            self._points[scene] = (distinct, place.reshape(-1))
        distinct, place = self._points[scene]
        share = weights[0] / weights[0].sum()
        transmission = np.exp(-np.minimum(factor * (distinct @ mu), 700.0)) @ share
        depth = -np.log(np.maximum(transmission, 1e-30))[place]
        return np.asarray(depth.reshape(next(iter(maps.values())).shape), dtype=np.float64)


def open_field(picture: FloatArray, depth: FloatArray, good: NDArray[np.bool_] | None = None) -> float | None:
    """Median of a picture beside its object, in the good pixels; None: it covers nearly all of the field."""
    beside = depth < _OPEN if good is None else (depth < _OPEN) & good
    return float(np.median(picture[beside])) if beside.sum() >= max(16, 0.02 * depth.size) else None


def measured_depth(item: Reading, depth: FloatArray) -> FloatArray | None:
    """-log of the picture over the open field beside the object; None: none is seen."""
    open_DN = None if item.picture is None else open_field(item.picture, depth)
    if item.picture is None or open_DN is None or not open_DN > 0:
        return None
    return np.asarray(-np.log(np.maximum(item.picture / open_DN, 1e-6)), dtype=np.float64)
