"""One beam behind one scene: signal and variance of an exposure, projected once."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...errors import InputError
from ..line.line_state import FinePicture, FloatArray
from ..line.spectral_signal import REFERENCE_KV, OpenBeam, SpectralModel
from ..line.twin import Level, Twin
from ..line.twin_spectrum import gain_of_slope, spectral_model_of, white_gain_DN
from ..spread._fine_picture import FineCells
from .model_cache import ModelCache
from .scene import Scene, scene_of

if TYPE_CHECKING:
    from ..line.series_request import SeriesRequest

_SCALES = (
    "log_output",
    "log_DN_per_keV",
    "log_swank",
    "yield_exponent",
)  # they scale a projection and change nothing else
_LEAST_WEIGHT = 1e-10  # energies that add less to signal and variance are left out


@dataclass(frozen=True, slots=True)
class Spectrum:
    """What is projected: a beam with all scales at 1.

    Fields: model; beam; shape: the other parameters, as bytes; attenuation_scale: material -> factor; weights (2, energy) of signal
    and variance; cache.
    """

    model: SpectralModel
    beam: OpenBeam
    shape: bytes
    attenuation_scale: Mapping[str, float]
    weights: FloatArray
    cache: ModelCache

    @property
    def key(self) -> tuple[object, ...]:
        """What sets it apart from others of the model."""
        return (self.beam, self.shape, tuple(sorted(self.attenuation_scale.items())))

    def behind(self, scene: Scene | None, name: str, weights: FloatArray) -> tuple[FloatArray, FineCells | None]:
        """Weights (k, energy) behind a scene, kept under the name.

        Returns:
            Maps (k, row, column), or (k, 1, 1) in the open field; and the cells of the first one where the scene has steps
            and the name is `signal`, else None.
        """
        if scene is None:
            return np.asarray(weights.sum(axis=1)[:, None, None]), None
        found: tuple[FloatArray, FineCells | None] = self.cache.made(
            "maps",
            (self.model, scene),
            (*self.key, name),
            lambda: scene.project(weights, self.model, self.attenuation_scale, fine=name == "signal"),
        )
        return found


@dataclass(frozen=True, slots=True)
class BeamProjection:
    """One beam behind one scene: signal and variance of an exposure, and further moments on demand.

    secondary_DN: of the variance, what secondary quanta add for each DN of signal, white and the same behind any object.
    """

    open_signal_DN: float
    signal_DN: FloatArray
    variance_DN2: FloatArray
    secondary_DN: float
    picture: FinePicture | None = None
    spectrum: Spectrum | None = None
    scene: Scene | None = None

    @property
    def nbytes(self) -> int:
        """Of its maps."""
        return self.signal_DN.nbytes + self.variance_DN2.nbytes

    @property
    def model(self) -> SpectralModel | None:
        """Spectral model of the twin, if it has one."""
        return None if self.spectrum is None else self.spectrum.model

    @property
    def weights(self) -> FloatArray | None:
        """What each energy of the open beam adds to signal and variance (2, energy), any scale."""
        return None if self.spectrum is None else self.spectrum.weights

    @property
    def energies_keV(self) -> FloatArray | None:
        """Of the weights (energy,)."""
        if self.spectrum is None:
            return None
        return np.asarray(self.spectrum.model.energies_keV[: self.spectrum.weights.shape[1]])

    def moments(self, name: str, weights: FloatArray) -> FloatArray:
        """Maps (k, row, column) of sum_E weights exp(-mu t), or (k, 1, 1) in the open field; kept under `name`."""
        if self.spectrum is None:
            raise InputError(
                "scene",
                received="a twin without spectral part",
                expected="one with a spectral part",
                remedy="calibrate from flats that state kV and tube load",
            )
        return self.spectrum.behind(self.scene, name, weights)[0]


def model_of(twin: Twin, request: "SeriesRequest") -> SpectralModel | None:
    """The twin's spectral model, or None where it or the request's setting is unknown."""
    if twin.spectral is None or request.setting is None:
        return None
    return spectral_model_of(twin, highest_kV=request.setting.kV)


def project_beam(
    twin: Twin,
    request: "SeriesRequest",
    parameters: FloatArray | None,
    attenuation_scale: Mapping[str, float],
    *,
    use_measured_level: bool,
    cache: ModelCache,
) -> BeamProjection:
    """Signal and variance of one exposure behind the request's scene, under even illumination.

    Raises:
        InputError: a beam of unknown level, a scene that does not fit the detector or that the twin cannot project.
    """
    level = None if request.setting is None or not use_measured_level else twin.level_at(request.setting)
    model = model_of(twin, request)
    if model is None or parameters is None or request.setting is None or twin.spectral is None:
        return _without_spectrum(twin, request, level)
    beam = OpenBeam(kV=request.setting.kV, filters=request.setting.filters)
    spectrum, scales = _spectrum(model, parameters, beam, attenuation_scale, cache)
    signal_scale, gain_scale, secondary = _level(twin, request, model, beam, level, scales, cache)
    scene = scene_of(request.thickness_mm, model, twin.maps.shape, cache) if request.thickness_mm else None
    fine = twin.noise.spread.value.model == "aperture"
    best = np.asarray(twin.spectral.best, dtype=np.float64)

    def projected() -> BeamProjection:
        # drafts are drawn with the cells of the twin's own spectrum: what hardness changes besides is a difference of pixels
        usual = None
        if fine and cache.draft and scene is not None and scene.borders.any_steps:
            usual, _ = _spectrum(model, best, beam, {}, cache)
        same = usual is None or usual.key == spectrum.key
        maps, cells = spectrum.behind(scene, "signal" if same else "signal in pixels", spectrum.weights)
        signal = signal_scale * maps[0]
        picture = None
        if usual is not None and not same:
            drawn, usual_cells = usual.behind(scene, "signal", usual.weights)
            if usual_cells is not None:
                # as the open field goes
                share = signal_scale * float(spectrum.weights[0].sum()) / float(usual.weights[0].sum())
                picture = FinePicture(fine=usual_cells, scale=share, signal_DN=share * drawn[0])
        elif cells is not None and fine:
            picture = FinePicture(fine=cells, scale=signal_scale, signal_DN=signal)
        return BeamProjection(
            open_signal_DN=signal_scale * float(spectrum.weights[0].sum()),
            signal_DN=signal,
            variance_DN2=signal_scale * gain_scale * maps[1] + secondary * signal,
            secondary_DN=secondary,
            picture=picture,
            spectrum=spectrum,
            scene=scene,
        )

    key = (*spectrum.key, signal_scale, gain_scale, secondary, fine, best.tobytes() if cache.draft else None)
    found: BeamProjection = cache.made("beam", (model, scene), key, projected)
    return found


def _spectrum(
    model: SpectralModel,
    parameters: FloatArray,
    beam: OpenBeam,
    attenuation_scale: Mapping[str, float],
    cache: ModelCache,
) -> tuple[Spectrum, tuple[float, float, float]]:
    """What is projected, and (signal, variance over signal, DN a keV) that the scales amount to."""
    shape, scales = _split(model, parameters, beam)

    def weighed() -> FloatArray:
        weights = model.moment_weights(shape, beam, secondary=False)[:2]
        share = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
        return np.asarray(np.where(share > _LEAST_WEIGHT, weights, 0.0))

    named = shape.tobytes()
    weights = cache.made("weights", (model,), (beam, named), weighed)
    return Spectrum(model, beam, named, attenuation_scale, weights, cache), scales


def _no_level(request: "SeriesRequest") -> InputError:
    return InputError(
        "series",
        received="a beam of unknown level" if request.setting is None else str(request.setting),
        expected="a tube load (current_mA or power_W), or the level of the open beam",
        remedy="state current_mA or power_W",
    )


def _without_spectrum(twin: Twin, request: "SeriesRequest", level: Level | None) -> BeamProjection:
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
        there = level.source_detector_mm or _distance_mm(twin, request, level)
        open_signal = level.rate_DN_per_mAs.value * load * (there / _distance_mm(twin, request, level)) ** 2
    if open_signal is None or not twin.levels:
        raise _no_level(request)
    level = level or twin.levels[0]
    gain, secondary = gain_of_slope(twin, level.photon_transfer_slope_DN.value)
    one = np.ones((1, 1))
    return BeamProjection(
        open_signal_DN=open_signal,
        signal_DN=open_signal * one,
        variance_DN2=gain * open_signal * one,
        secondary_DN=secondary,
    )


def _distance_mm(twin: Twin, request: "SeriesRequest", level: Level | None) -> float:
    setting = None if request.setting is None else request.setting.source_detector_mm
    measured = None if level is None else level.source_detector_mm
    return request.source_detector_mm or setting or twin.instrument.source_detector_mm or measured or 1000.0


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


def _level(
    twin: Twin,
    request: "SeriesRequest",
    model: SpectralModel,
    beam: OpenBeam,
    level: Level | None,
    scales: tuple[float, float, float],
    cache: ModelCache,
) -> tuple[float, float, float]:
    """Factors on the projected signal, and on the quanta's variance over signal, of one exposure; secondary quanta's part, DN."""
    posterior = twin.spectral
    if posterior is None or request.setting is None:
        raise _no_level(request)

    def of_best() -> tuple[float, float, float]:
        """Signal, the quanta's variance over it and DN a keV of the posterior's best parameters, for 1 mAs at 1 m on 1 mm2."""
        best, best_scales = _spectrum(model, np.asarray(posterior.best, dtype=np.float64), beam, {}, cache)
        sums = best.weights.sum(axis=1)
        if not sums[0] > 0:
            raise InputError(
                "filter",
                received=" + ".join(map(str, beam.filters)),
                expected="layers that let some photons through",
            )
        return best_scales[0] * float(sums[0]), best_scales[1] * float(sums[1]) / float(sums[0]), best_scales[2]

    best_rate, best_quanta, best_gamma = cache.made("level", (posterior,), beam, of_best)
    distance = _distance_mm(twin, request, level)
    load = request.setting.tube_load_mAs
    pitch = twin.instrument.pixel_mm or 1.0
    gain = best_quanta + posterior.secondary_DN
    secondary = white_gain_DN(twin, gain)
    if level is not None:
        gain, secondary = gain_of_slope(twin, level.photon_transfer_slope_DN.value)
    gain_scale = scales[1] * (gain - secondary) / best_quanta
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
