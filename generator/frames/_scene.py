"""What stands in the beam, projected once for each beam: scenes, their sharp borders, and the cache of projections."""

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..kernels.projection import project_polychromatic
from ..line.line_state import FinePicture, FloatArray
from ..line.spectral_signal import REFERENCE_KV, OpenBeam, SpectralModel
from ..line.twin import Level, Twin
from ..line.twin_spectrum import gain_of_slope, spectral_model_of, white_gain_DN
from ..spread._fine_picture import (
    Borders,
    FineCells,
    cell_coverage,
    find_borders,
    fine_cells,
)

if TYPE_CHECKING:
    from ..line.series_request import SeriesRequest

_SCALES = (
    "log_output",
    "log_DN_per_keV",
    "log_swank",
    "yield_exponent",
)  # they scale a projection and change nothing else
_BORDER_KEV = 40.0  # attenuation at this energy says where the border of an object lies
_BORDER_DEPTH = 0.02  # optical depth across a pixel's neighbourhood from which its border counts
_MOST_UNIQUE_PIXELS = 300_000
_LEAST_WEIGHT = 1e-10  # energies that add less to signal and variance are left out
_BUDGET_BYTES = 600_000_000
_SINGLE_PRECISION_CELLS = 2_000_000
_MOST_MADE = 64
_BEAMS_SHARE = 0.1  # of the budget for beams behind scenes, as large as the last one


@dataclass(frozen=True, slots=True)
class _Scene:
    source: Mapping[str, NDArray[np.floating]]
    number: int
    materials: tuple[str, ...]
    thickness_mm: NDArray[np.float64]  # (material, point): the distinct points where that saves work
    inverse: NDArray[np.intp] | None
    borders: Borders
    covered_cells: FloatArray  # (border pixel, 3, 3)
    shape: tuple[int, int]


@dataclass(frozen=True, slots=True)
class BeamProjection:
    """One beam behind one scene: signal and variance of an exposure, and further moments on demand.

    secondary_DN: of the variance, what secondary quanta add for each DN of signal, white and the same behind any object.
    """

    model: SpectralModel | None
    weights: FloatArray | None
    energies_keV: FloatArray | None
    open_signal_DN: float
    signal_DN: FloatArray
    variance_DN2: FloatArray
    secondary_DN: float
    picture: FinePicture | None
    _cache: "ModelCache"
    _key: tuple[object, ...]
    _scene: _Scene | None
    _scale: Mapping[str, float]

    def moments(self, name: str, weights: FloatArray) -> FloatArray:
        """Maps (k, row, column) of sum_E weights exp(-mu t), or (k, 1, 1) in the open field; kept under `name`."""
        if self.model is None:
            raise InputError("scene", received="a twin without spectral part", expected="one with a spectral part")
        return self._cache.project(self._key, name, weights, self.model, self._scene, self._scale)[0]


@dataclass(frozen=True, slots=True)
class _UsualPicture:
    """A scene with the spectrum that the twin has: its cells, pixel means (row, column), and the open field's level, any unit."""

    fine: FineCells
    picture: FloatArray
    open: float


@dataclass(slots=True)
class ModelCache:
    """Scenes and projections, kept between calls of the forward model; the oldest go first beyond `budget_bytes`.

    draft: pictures are only compared with each other, and may be drawn with less work (see `_spread.spread_maps`); cells finer
    than pixels are those of the twin's own spectrum; maps whose pixels are all alike are (1, 1).
    """

    budget_bytes: int = _BUDGET_BYTES
    draft: bool = False
    _scenes: "OrderedDict[int, _Scene]" = field(default_factory=OrderedDict)
    _maps: "OrderedDict[tuple[object, ...], tuple[FloatArray, FineCells | None]]" = field(default_factory=OrderedDict)
    _held: int = 0
    _numbers: int = 0
    _levels: dict[tuple[object, ...], tuple[object, float, float, float]] = field(default_factory=dict)
    _spectra: "OrderedDict[tuple[object, ...], tuple[object, FloatArray]]" = field(default_factory=OrderedDict)
    _lit: "OrderedDict[tuple[object, ...], tuple[object, int]]" = field(default_factory=OrderedDict)
    _beams: "OrderedDict[tuple[object, ...], BeamProjection]" = field(default_factory=OrderedDict)
    _lit_held: int = 0
    _spreads: "OrderedDict[tuple[object, ...], tuple[Twin, dict[object, Any]]]" = field(default_factory=OrderedDict)
    _made: "OrderedDict[tuple[object, ...], tuple[object, Any]]" = field(default_factory=OrderedDict)

    def made_of(self, owner: object, name: object, make: Callable[[], Any]) -> Any:
        """What is made of a thing once, kept under a name by the thing's identity."""
        key = (id(owner), name)
        found = self._made.get(key)
        if found is None or found[0] is not owner:
            self._made[key] = found = (owner, make())
            while len(self._made) > _MOST_MADE:
                self._made.popitem(last=False)
        self._made.move_to_end(key)
        return found[1]

    def pixels(self, owner: object, name: object, read: Callable[[], NDArray[np.floating]]) -> FloatArray:
        """A map (row, column) of the detector's, kept under the name by its owner's identity; a draft's may be (1, 1)."""

        def whole() -> FloatArray:
            image = np.asarray(read(), dtype=np.float64)
            return image[:1, :1].copy() if self.draft and float(np.ptp(image)) == 0.0 else image

        return np.asarray(self.made_of(owner, name, whole))

    def spread(self, key: tuple[object, ...], twin: Twin) -> dict[object, Any]:
        """What was kept of a spread of light, the same behind all scenes: arrays and patterns, filled by those who ask."""
        found = self._spreads.get(key)
        if found is None or found[0] is not twin:
            held = [sum(getattr(item, "nbytes", 0) for item in made.values()) for _, made in self._spreads.values()]
            while sum(held) > 0.2 * self.budget_bytes:
                self._spreads.popitem(last=False)
                held.pop(0)
            self._spreads[key] = found = (twin, {})
        self._spreads.move_to_end(key)
        return found[1]

    def lit(self, key: tuple[object, ...]) -> object | None:
        """What was kept of a series up to the spread of light, or None."""
        found = self._lit.get(key)
        if found is None:
            return None
        self._lit.move_to_end(key)
        return found[0]

    def keep_lit(self, key: tuple[object, ...], lit: object, size_bytes: int) -> None:
        """Keep a series up to the spread of light."""
        self._lit[key] = (lit, size_bytes)
        self._lit_held += size_bytes
        while self._lit_held > self.budget_bytes and len(self._lit) > 1:
            self._lit_held -= self._lit.popitem(last=False)[1][1]

    def model(self, twin: Twin, request: "SeriesRequest") -> SpectralModel | None:
        """The twin's spectral model, or None where it has none."""
        if twin.spectral is None or request.setting is None:
            return None
        return spectral_model_of(twin, highest_kV=request.setting.kV)

    def projection(
        self,
        twin: Twin,
        request: "SeriesRequest",
        model: SpectralModel | None,
        parameters: FloatArray | None,
        attenuation_scale: Mapping[str, float],
        *,
        use_measured_level: bool,
    ) -> BeamProjection:
        """Signal and variance of one exposure behind the request's scene, under even illumination."""
        level = None if request.setting is None or not use_measured_level else twin.level_at(request.setting)
        if model is None or parameters is None or request.setting is None or twin.spectral is None:
            return self._without_spectrum(twin, request, level)
        beam = OpenBeam(kV=request.setting.kV, filters=request.setting.filters)
        shape, scales = self._split(model, parameters, beam)
        key = (id(model), beam, shape.tobytes(), tuple(sorted(attenuation_scale.items())))
        weights = self._shape_weights(model, shape, beam)
        signal_scale, gain_scale, secondary = self._level(twin, request, model, beam, level, scales)
        scene = None
        if request.thickness_mm:
            scene = self._scene(request.thickness_mm, model, twin.maps.shape)
        fine_wanted = twin.noise.spread.value.model == "aperture"
        # drafts are drawn with the cells of the twin's own spectrum
        own = np.asarray(twin.spectral.best, dtype=np.float64).tobytes() if self.draft else None
        whole = (*key, None if scene is None else scene.number, signal_scale, gain_scale, secondary, fine_wanted, own)
        known = self._beams.get(whole)
        if known is not None and known.model is model:
            self._beams.move_to_end(whole)
            return known
        usual = self._usual(twin, beam, model, scene, key) if fine_wanted else None
        name = "signal" if usual is None else "signal in pixels"
        maps, fine = self.project(key, name, weights, model, scene, attenuation_scale)
        signal = signal_scale * maps[0]
        picture = None
        if usual is not None:
            # as the open field goes; what hardness changes besides is a difference of pixels
            share = signal_scale * float(weights[0].sum()) / usual.open
            picture = FinePicture(fine=usual.fine, scale=share, signal_DN=share * usual.picture)
        elif fine is not None and fine_wanted:
            picture = FinePicture(fine=fine, scale=signal_scale, signal_DN=signal)
        found = BeamProjection(
            model=model,
            weights=weights,
            energies_keV=model.energies_keV[: weights.shape[1]],
            open_signal_DN=signal_scale * float(weights[0].sum()),
            signal_DN=signal,
            variance_DN2=signal_scale * gain_scale * maps[1],
            secondary_DN=secondary,
            picture=picture,
            _cache=self,
            _key=key,
            _scene=scene,
            _scale=attenuation_scale,
        )
        self._beams[whole] = found
        most = _BEAMS_SHARE * self.budget_bytes / (found.signal_DN.nbytes + found.variance_DN2.nbytes)
        while len(self._beams) > max(most, 1):
            self._beams.popitem(last=False)
        return found

    def _usual(
        self,
        twin: Twin,
        beam: OpenBeam,
        model: SpectralModel,
        scene: _Scene | None,
        key: tuple[object, ...],
    ) -> "_UsualPicture | None":
        """For a draft with another spectrum than the twin's: the picture with the twin's; None: to be drawn by itself."""
        if not self.draft or scene is None or not scene.borders.any_steps or twin.spectral is None:
            return None
        shape, _ = self._split(model, np.asarray(twin.spectral.best, dtype=np.float64), beam)
        own = (id(model), beam, shape.tobytes(), ())
        if own == key:
            return None
        weights = self._shape_weights(model, shape, beam)
        maps, fine = self.project(own, "signal", weights, model, scene, {})
        return None if fine is None else _UsualPicture(fine, maps[0], float(weights[0].sum()))

    def _without_spectrum(self, twin: Twin, request: "SeriesRequest", level: Level | None) -> BeamProjection:
        if request.thickness_mm:
            raise InputError(
                "scene",
                received="thickness maps and a twin without spectral part",
                expected="a twin that can project them",
                remedy="calibrate from flats that state kV and tube load",
            )
        if level is None and request.setting is None and len(twin.levels) == 1:
            level = twin.levels[0]
        load = None if request.setting is None else request.setting.tube_load_mAs
        open_signal = request.open_signal_DN
        if open_signal is None and level is not None and level.rate_DN_per_mAs is not None and load is not None:
            there = level.source_detector_mm or self._distance_mm(twin, request, level)
            open_signal = level.rate_DN_per_mAs.value * load * (there / self._distance_mm(twin, request, level)) ** 2
        if open_signal is None or not twin.levels:
            raise _no_level(request)
        level = level or twin.levels[0]
        gain, secondary = gain_of_slope(twin, level.photon_transfer_slope_DN.value)
        one = np.ones((1, 1))
        return BeamProjection(
            model=None,
            weights=None,
            energies_keV=None,
            open_signal_DN=open_signal,
            signal_DN=open_signal * one,
            variance_DN2=gain * open_signal * one,
            secondary_DN=secondary,
            picture=None,
            _cache=self,
            _key=(),
            _scene=None,
            _scale={},
        )

    @staticmethod
    def _distance_mm(twin: Twin, request: "SeriesRequest", level: Level | None) -> float:
        setting = None if request.setting is None else request.setting.source_detector_mm
        measured = None if level is None else level.source_detector_mm
        return request.source_detector_mm or setting or twin.instrument.source_detector_mm or measured or 1000.0

    @staticmethod
    def _split(
        model: SpectralModel, parameters: FloatArray, beam: OpenBeam
    ) -> tuple[FloatArray, tuple[float, float, float]]:
        """Parameters with the scales taken out, and (signal, variance over signal, DN a keV) that the scales amount to."""
        shape = parameters.copy()
        values = {}
        for name in _SCALES:
            index = model.names.index(name)
            values[name] = float(shape[index])
            shape[index] = 0.0
        gamma = values["log_DN_per_keV"]
        signal = values["log_output"] + values["yield_exponent"] * math.log(beam.kV / REFERENCE_KV) + gamma
        return shape, (math.exp(signal), math.exp(gamma - values["log_swank"]), math.exp(gamma))

    def _shape_weights(self, model: SpectralModel, shape: FloatArray, beam: OpenBeam) -> FloatArray:
        """Weights (2, energy) of signal and variance with all scales at 1."""
        key = (id(model), beam, shape.tobytes())
        if key not in self._spectra:
            weights = model.moment_weights(shape, beam)[:2]
            share = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
            weights = np.where(share > _LEAST_WEIGHT, weights, 0.0)
            self._spectra[key] = (model, weights)
            while len(self._spectra) > 512:
                self._spectra.popitem(last=False)
        return self._spectra[key][1]

    def _level(
        self,
        twin: Twin,
        request: "SeriesRequest",
        model: SpectralModel,
        beam: OpenBeam,
        level: Level | None,
        scales: tuple[float, float, float],
    ) -> tuple[float, float, float]:
        """Factors on the projected signal, and on variance over signal, of one exposure; secondary quanta's part, DN."""
        posterior = twin.spectral
        if posterior is None or request.setting is None:
            raise _no_level(request)
        key = (id(posterior), beam)
        if key not in self._levels:
            best, best_scales = self._split(model, np.asarray(posterior.best, dtype=np.float64), beam)
            sums = self._shape_weights(model, best, beam).sum(axis=1)
            if not sums[0] > 0:
                raise InputError(
                    "filter",
                    received=" + ".join(map(str, beam.filters)),
                    expected="layers that let some photons through",
                )
            self._levels[key] = (
                posterior,
                best_scales[0] * float(sums[0]),
                best_scales[1] * float(sums[1]) / float(sums[0]),
                best_scales[2],
            )
        _, best_rate, best_gain, best_gamma = self._levels[key]
        distance = self._distance_mm(twin, request, level)
        load = request.setting.tube_load_mAs
        pitch = twin.instrument.pixel_mm or 1.0
        gain_scale = scales[1]
        secondary = white_gain_DN(twin, best_gain)
        if level is not None:
            gain, secondary = gain_of_slope(twin, level.photon_transfer_slope_DN.value)
            gain_scale *= gain / best_gain
        # electronics that give more DN for a keV give more for a secondary quantum too
        secondary *= scales[2] / best_gamma
        if request.open_signal_DN is not None:
            return scales[0] * request.open_signal_DN / best_rate, gain_scale, secondary
        if load is None:
            raise _no_level(request)
        if level is not None and level.rate_DN_per_mAs is not None:
            there = level.source_detector_mm or distance
            measured = level.rate_DN_per_mAs.value * load * (there / distance) ** 2
            return scales[0] * measured / best_rate, gain_scale, secondary
        return scales[0] * load * (1000.0 / distance) ** 2 * pitch**2, gain_scale, secondary

    def _scene(
        self, thickness_mm: Mapping[str, NDArray[np.floating]], model: SpectralModel, shape: tuple[int, int]
    ) -> _Scene:
        number = id(thickness_mm)
        found = self._scenes.get(number)
        if found is not None and found.source is thickness_mm:
            self._scenes.move_to_end(number)
            return found
        materials = tuple(thickness_mm)
        stack = np.stack([np.asarray(thickness_mm[name], dtype=np.float64) for name in materials])
        if stack.shape[1:] != shape:
            raise InputError(
                "thickness maps of a scene",
                received=f"{stack.shape[1:]}",
                expected=f"(row, column) of the twin's detector, {shape}",
            )
        if not np.all(np.isfinite(stack) & (stack >= 0)):
            raise InputError(
                "thickness maps of a scene",
                received="negative or not finite path lengths",
                expected="finite path lengths of 0 mm or more",
            )
        energy = int(np.searchsorted(model.energies_keV, _BORDER_KEV))
        depth = np.tensordot([model.mu(name)[energy] for name in materials], stack, axes=1)
        points = stack.reshape(len(materials), -1)
        inverse = None
        if points.shape[1] <= _MOST_UNIQUE_PIXELS:
            distinct, where = _distinct(points.astype(np.float32))
            if distinct.shape[1] < 0.7 * points.shape[1]:
                points, inverse = distinct.astype(np.float64), where
        self._numbers += 1
        borders = find_borders(depth, least_depth=_BORDER_DEPTH)
        scene = _Scene(
            thickness_mm,
            self._numbers,
            materials,
            points,
            inverse,
            borders,
            cell_coverage(borders.normal[0], borders.normal[1], borders.covered),
            shape,
        )
        self._scenes[number] = scene
        while len(self._scenes) > 64:
            self._scenes.popitem(last=False)
        return scene

    def project(
        self,
        key: tuple[object, ...],
        name: str,
        weights: FloatArray,
        model: SpectralModel,
        scene: _Scene | None,
        attenuation_scale: Mapping[str, float],
    ) -> tuple[FloatArray, FineCells | None]:
        """Weights (k, energy) behind a scene, kept under key and name.

        Returns:
            Maps (k, row, column), or (k, 1, 1) in the open field; and the cells of the first one where the scene has steps
            and the name is `signal`, else None.
        """
        if scene is None:
            return np.asarray(weights.sum(axis=1)[:, None, None]), None
        whole = (*key, scene.number, name)
        found = self._maps.get(whole)
        if found is not None:
            self._maps.move_to_end(whole)
            return found
        top = weights.shape[1]
        mu = np.stack([model.mu(material)[:top] * attenuation_scale.get(material, 1.0) for material in scene.materials])
        flat = project_polychromatic(scene.thickness_mm, mu, weights).astype(np.float64)
        if scene.inverse is not None:
            flat = flat[:, scene.inverse]
        result = _with_borders(flat, scene, fine=name == "signal")
        self._maps[whole] = result
        self._held += _bytes(result)
        while self._held > self.budget_bytes and len(self._maps) > 1:
            self._held -= _bytes(self._maps.popitem(last=False)[1])
        return result


def _bytes(kept: tuple[FloatArray, FineCells | None]) -> int:
    return kept[0].nbytes + (0 if kept[1] is None else kept[1].nbytes)


def _with_borders(flat: FloatArray, scene: _Scene, *, fine: bool) -> tuple[FloatArray, FineCells | None]:
    """Maps (k, row, column) of what was projected pixel by pixel (k, pixel), with the pixels that borders cut shared."""
    borders = scene.borders
    thick, thin = flat[:, borders.thick], flat[:, borders.thin]
    if borders.pixel.size:
        shared = borders.covered * thick + (1.0 - borders.covered) * thin
        flat[:, borders.pixel] += borders.sharpness * (shared - flat[:, borders.pixel])
    maps = flat.reshape(len(flat), *scene.shape)
    if not (fine and borders.any_steps):
        return maps, None
    cells = fine_cells(maps[0], thick[0], thin[0], borders, scene.covered_cells)
    return maps, FineCells(cells.astype(np.float32) if cells.size > _SINGLE_PRECISION_CELLS else cells)


def _no_level(request: "SeriesRequest") -> InputError:
    return InputError(
        "series",
        received="a beam of unknown level" if request.setting is None else str(request.setting),
        expected="a tube load (current_mA or power_W), or the level of the open beam",
        remedy="state current_mA or power_W",
    )


def _distinct(points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Distinct columns of points (coordinate, point), in order, and the number of each point's column (point,).

    One or two coordinates are sorted as numbers, in a third of the time that columns take or less (16,384 points).
    """
    if len(points) > 2:
        distinct, where = np.unique(points, axis=1, return_inverse=True)
        return distinct, where.reshape(-1)
    numbers = points[0] if len(points) == 1 else points[0] + 1j * points[1]
    found, where = np.unique(numbers, return_inverse=True)
    distinct = found[None, :] if len(points) == 1 else np.stack([found.real, found.imag])
    return distinct, where.reshape(-1)
