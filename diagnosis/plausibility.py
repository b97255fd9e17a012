"""Do the series of a session show what their labels say? Asked before effects compete.

A kV, filter or exposure that belongs to another series, a dark that is a flat, a thickness map of another object: no effect
of the forward model is meant to explain these, and the nearest one would be named instead. Relabelling is therefore a
hypothesis of its own. Each lit series gives the logarithm of its level and of its noise over signal, and behind objects
the logarithm of its attenuation over the map's. Under a labelling they are Gaussian about what the spectral model of the
declared instrument gives for the labels:

    level        free constant + tube voltage (sd 0.2) + the same since the calibration (0.2) + beam since (0.05)
                 + 0.15 of what filters take, by voltage + series (0.04)
    noise/signal free constant + all since the calibration (0.35) + beam (0.08) + beam since (0.08) + series (0.08)
    attenuation  all (0.1) + placement of a scene (0.3) + series (0.12)

wide enough for every effect of the catalogue within its plausible range. A labelling in which series take the kV, filters, exposure
or whole setting of others, or two series change places, must be better by `LEAST_EVIDENCE` (natural logarithm). Maps
are judged by how well the picture's shadow fits them, against the same map turned and other scenes' maps.

Validity: needs several series; a session whose labels are all wrong in the same way is consistent.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile, Series
from ..acquisition.log_images import holds_shares
from ..acquisition.setting import Filter, text_from_filters
from ..calibration.spectral_fit import model_for
from ..errors import InputError
from ..generator.spectral_signal import OpenBeam, SpectralModel

FloatArray = NDArray[np.float64]

LEAST_EVIDENCE = 10.0
_FRAMES = 8  # read of each series
_FRAMES_OF_NOISE = 5  # that an object's series needs to say something of noise
_PIXELS = 96  # a side that are looked at
_LEAST_BRIGHTEST_DN = 30.0  # of frames that are no whole numbers; 8 bits averaged have more, transmissions 1
_CONSTANT_SD, _OWN_BEAM_SD = 10.0, 3.0  # of the common level; of a beam of unknown kV or load
_LEVEL_SDS = {"voltage": 0.2, "voltage since": 0.2, "beam since": 0.05, "filters": 0.15, "series": 0.04}
_GAIN_SDS = {"since": 0.35, "beam": 0.08, "beam since": 0.08, "series": 0.08}
_ATTENUATION_SDS = {"all": 0.1, "placement": 0.3, "series": 0.12}
_OBJECT_EXTRA = 0.05  # of level and noise behind an object
_SUSPECT_Z = 3.5
_MOST_SUSPECTS = 10
_PRICE_OF_A_SETTING = 2.0  # natural logarithm, of more than one word being wrong
_MOST_CHANGES = 4
_INHERENT_MM_AL = 1.0  # where nothing is declared
_INHERENT_MAY_BE_MM_AL = (0.0, 3.0)  # as far as calibration's prior plausibly goes
_INHERENT_TRIED_MM_AL = (*(0.25 * step for step in range(13)), 3.5, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0)  # where flats tell
_SATURATED = 0.03  # share of the pixels at the top of the range; bad pixels alone are fewer
_NO_BEAM = 0.01  # of the level that a flat should have for its tube load
_CLEAR_QUANTA = 5.0  # standard deviations of a variance above that of a dark
_ENERGY_RANGE = 4.0  # times between the signals of quanta of the softest and of a usual beam
_DARK_EXCESS = 0.05  # of the weakest flat that a dark may lie above the other darks
_RELEASED = 0.08  # of the exposures before, which an image lag may leave in a dark
_RELEASED_LATER, _REMEMBERED = 0.02, 3  # the same in the last frames of a lit series; from so many exposures before
_WEAK = 0.1  # of the flats' usual level, below which a flat's pattern says nothing of a shadow
_SHADOW_IN_FLAT = 0.35  # spread of the logarithm of a flat against other flats
_DEEPEST = 4.0  # -log T beyond which nothing is compared
_FITS, _FITS_NOT = 0.995, 0.5  # correlations of shadow and map
_FITS_BETTER = 0.3  # share of what is missing from 1 that another map may leave
_SCALE_OFF = 0.22  # logarithm of a map's scale that no composition explains
_LIKE_SHORTER_PATHS = ("object_scatter", "veiling_glare")  # light behind an object that did not come straight
_SCALE_AGREES = 0.07  # scatter takes more from thick parts, and not the same at every voltage
_LOG_FACTORS = tuple(round(0.02 * step, 2) for step in range(-40, 41))
_SHIFTS_PX = (-4, -2, 0, 2, 4)


@dataclass(frozen=True, slots=True, kw_only=True)
class Suspect:
    """Series whose frames contradict a label.

    Fields: series: their names; text: what they look like; evidence (natural logarithm); or_effects: effects that show the same, and
    whose explanation of the whole session clears the label.
    """

    series: tuple[str, ...]
    text: str
    evidence: float
    or_effects: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Plausibility:
    """What was found.

    Fields: suspects, strongest first; unusable: series without any signal or noise, or saturated -> why; saturated: names of
    those that were lit too much.
    """

    suspects: tuple[Suspect, ...]
    unusable: Mapping[str, str]
    saturated: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Label:
    """What a series says of its beam: kV, filters, (name, value) of the tube load, exposure and distance."""

    kV: float | None
    filters: tuple[Filter, ...]
    load: tuple[str, float] | None
    exposure_ms: float | None
    distance_mm: float

    @property
    def beam(self) -> tuple[object, ...]:
        """What fixes level and noise but for one factor each."""
        return (self.kV, tuple(sorted(map(str, self.filters))), self.load is None)

    @property
    def log_load(self) -> float:
        """Logarithm of the charge of one exposure, or of its time where the load is unknown."""
        time = math.log(self.exposure_ms or 1.0)
        if self.load is None:
            return time
        name, value = self.load
        return time + math.log(value / (self.kV or 1.0) if name == "power_W" else value)


@dataclass(slots=True, kw_only=True)
class _Reading:
    """A series as it is: mean frame (row, column) of the pixels looked at, its noise, what they amount to.

    released: share of its level that an image lag may have brought from the exposures before.
    """

    series: Series
    label: _Label
    mean_DN: FloatArray
    variance_DN2: FloatArray | None
    since: bool
    level_DN: float = math.nan
    gain_DN: float = math.nan
    gain_sd: float = math.inf
    picture: FloatArray | None = None
    released: float = 0.0

    @property
    def name(self) -> str:
        return self.series.name


def check_plausibility(
    acquisition: AcquisitionFile,
    *,
    calibrating: frozenset[str],
    dark_DN: Callable[[float | None], NDArray[np.floating]] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Plausibility:
    """Series of a session that do not show what their labels say.

    Args:
        acquisition: open file.
        calibrating: names of the series that calibrate; effects may have set in after them.
        dark_DN: exposure_ms -> dark frame (row, column) of a twin, for sessions without darks.
        progress: called with the name of the stage.

    Raises:
        InputError: frames that cannot be read, or that are fractions of something and no detector numbers.
    """
    (progress or (lambda stage: None))("labels")
    unusable: dict[str, str] = {}
    saturated: set[str] = set()
    readings: list[_Reading] = []
    shapes = {item.shape for item in acquisition.series}
    if len(shapes) > 1:
        return Plausibility(suspects=(), unusable={})
    stride = max(1, math.ceil(min(shapes.pop()) / _PIXELS))
    blank: dict[str, tuple[_Reading, float]] = {}  # and the one number that all their pixels have
    for item in acquisition.series:
        if "log" in item.corrected or holds_shares(item):
            continue
        # the last ones: the first may hold what the exposure before has left
        first = max(0, item.n_frames - _FRAMES)
        frames = np.asarray(item.read_frames(first, item.n_frames)[:, ::stride, ::stride], dtype=np.float64)
        found = _read(item, frames, acquisition, item.name not in calibrating)
        full = 0.0 if item.kind in ("dark", "afterglow") else _share_at_the_top(frames)
        if float(np.ptp(frames)) == 0.0:
            blank[item.name] = found, float(frames.flat[0])
        elif full > _SATURATED:
            unusable[item.name] = f"saturated: {100 * full:.2g} % of the pixels stand at {frames.max():.0f} DN"
            saturated.add(item.name)
        else:
            readings.append(found)
    silent = _silent_darks(acquisition, calibrating, blank)
    for name, (found, value_DN) in blank.items():
        top = _is_top(value_DN, acquisition.instrument.bits)
        if name in silent and not top:
            readings.append(found)
            continue
        unusable[name] = f"every pixel of every frame is {value_DN:g} DN"
        if top and found.series.kind in ("flat", "object"):
            saturated.add(name)
    readings.sort(key=lambda item: item.series.index)
    suspects: list[Suspect] = []
    darks = [item for item in readings if item.series.kind == "dark"]
    lit = [item for item in readings if item.series.kind in ("flat", "object")]
    _refuse_fractions(lit)
    good = _good_pixels(readings)
    wrong_darks = _lit_darks(darks, lit, good)
    suspects += wrong_darks
    blamed = {name for suspect in wrong_darks for name in suspect.series}
    darks = [item for item in darks if item.name not in blamed]

    def dark_of(item: Series) -> FloatArray | None:
        if "offset" in item.corrected:
            return np.zeros(good.shape)
        if darks:
            nearest = min(abs((dark.series.exposure_ms or 0.0) - (item.exposure_ms or 0.0)) for dark in darks)
            same = [
                dark.mean_DN
                for dark in darks
                if abs((dark.series.exposure_ms or 0.0) - (item.exposure_ms or 0.0)) <= nearest * 1.001 + 1e-9
            ]
            return np.asarray(np.median(np.stack(same), axis=0), dtype=np.float64)
        if dark_DN is not None:
            found = np.asarray(dark_DN(item.exposure_ms), dtype=np.float64)[::stride, ::stride]
            return found if found.shape == good.shape else None
        return None

    read_DN2 = min((_mean(item.variance_DN2, good) for item in darks if item.variance_DN2 is not None), default=0.0)
    judged = [item for item in lit if _measure(item, dark_of(item.series), read_DN2, good)]
    for reading in judged:
        before = [one.level_DN for one in judged if one.series.index < reading.series.index][-_REMEMBERED:]
        reading.released = _RELEASED_LATER * max(before, default=0.0) / max(reading.level_DN, 1e-9)
    dim, judged = _without_beam(judged, good)
    suspects += dim
    relative = _relative_gain([item for item in judged if item.series.kind == "flat"], good)
    for reading in judged:
        if reading.picture is not None and "gain" not in reading.series.corrected:
            reading.picture = reading.picture / relative
    shadowed = _shadows_in_flats(judged, good)
    suspects += shadowed
    blamed = {name for suspect in shadowed for name in suspect.series}
    judged = [item for item in judged if item.name not in blamed]
    try:
        model = _model(acquisition, judged)
    except InputError:
        model = None  # a voltage or material that the spectral model does not reach: said where it belongs
    maps = _Maps(acquisition, model, stride, good)
    maps_wrong = _wrong_maps(judged, maps)
    suspects += maps_wrong
    blamed = {name for suspect in maps_wrong for name in suspect.series}
    suspects += _relabelled([item for item in judged if item.name not in blamed], model, maps)
    return Plausibility(
        suspects=tuple(sorted(suspects, key=lambda item: -item.evidence)),
        unusable=unusable,
        saturated=frozenset(saturated),
    )


def _is_top(value_DN: float, bits: int | None) -> bool:
    """Whether a number is the largest of an ADC, of 8 bits or more where they are not known."""
    counted = math.log2(value_DN + 1.0) if value_DN > 0.0 else 0.0
    return counted == bits if bits is not None else counted >= 8 and counted.is_integer()


def _silent_darks(acquisition: AcquisitionFile, calibrating: Collection[str], blank: Collection[str]) -> set[str]:
    """Blank series without a beam that are what this detector shows then: one that counts, or a simulated one without electronics.

    One blank dark among others that have noise is a failure to read it.
    """
    darks = {item.name for item in acquisition.series if item.kind == "dark"}
    before = darks & set(calibrating) or darks
    if not before <= set(blank):
        return set()
    return {item.name for item in acquisition.series if item.kind in ("dark", "afterglow") and item.name in blank}


def _refuse_fractions(lit: Sequence[_Reading]) -> None:
    """Raise where frames with a beam hold no detector numbers but, as transmissions do, small fractions."""
    brightest = max((float(item.mean_DN.max()) for item in lit), default=_LEAST_BRIGHTEST_DN)
    whole = all(np.issubdtype(item.series.read_frames(0, 1).dtype, np.integer) for item in lit)
    if whole or brightest >= _LEAST_BRIGHTEST_DN:
        return
    factor = 10.0 ** math.ceil(4.0 - math.log10(max(brightest, 1e-30)))
    raise InputError(
        "frames",
        received=f"numbers of {brightest:.3g} at most",
        expected=f"detector numbers (DN) of {_LEAST_BRIGHTEST_DN:g} and more in flats, as dark and noise are judged in DN",
        remedy=f"multiply all frames of the file by one factor, darks included, for example {factor:g}",
    )


def _share_at_the_top(frames: FloatArray) -> float:
    """Share of the values at the highest one, where far more stand there than at the next lower one; else 0."""
    highest = float(frames.max())
    below = frames[frames < highest]
    if below.size == 0:
        return 0.0
    top, next_one = float(np.mean(frames == highest)), float(np.mean(frames == below.max()))
    return top if top > 5.0 * next_one else 0.0


def _read(item: Series, frames: FloatArray, acquisition: AcquisitionFile, since: bool) -> _Reading:
    variance = None
    if len(frames) > 1:
        steps = np.diff(frames, axis=0)
        steps = _without_common(steps, np.asarray(frames.mean(axis=0), dtype=np.float64))
        scale = 2.0
        if len(steps) > 3:
            # a ghost of the exposure before that fades is no noise: it bends little, and less and less
            steps, scale = np.diff(steps, axis=0)[len(steps) // 2 :], 6.0
        variance = np.asarray(np.mean(steps**2, axis=0) / scale * item.averaged, dtype=np.float64)
    load = None
    if item.power_W is not None:
        load = ("power_W", item.power_W)
    elif item.current_mA is not None:
        load = ("current_mA", item.current_mA)
    label = _Label(
        kV=item.kV,
        filters=item.filters,
        load=load if item.kV is not None else None,
        exposure_ms=item.exposure_ms,
        distance_mm=item.source_detector_mm or acquisition.instrument.source_detector_mm or 1000.0,
    )
    return _Reading(
        series=item,
        label=label,
        mean_DN=np.asarray(frames.mean(axis=0), dtype=np.float64),
        variance_DN2=variance,
        since=since,
    )


def _without_common(steps: FloatArray, picture: FloatArray) -> FloatArray:
    """Steps from frame to frame (step, row, column) less what all pixels have in common: an offset, and a share of their picture.

    Where half the field lies in shadow the tube's output moves the other half alone.
    """
    # hot and dead pixels stand far off in both
    low, high = np.quantile(steps, [0.05, 0.95], axis=(1, 2), keepdims=True)
    steady = np.clip(steps, low - (high - low), high + (high - low))
    shape = np.clip(picture, *np.quantile(picture, [0.01, 0.99]))
    shape = shape - shape.mean()
    steps = steps - steady.mean(axis=(1, 2), keepdims=True)
    power = float(np.sum(shape**2))
    if power <= 0:
        return steps
    return np.asarray(steps - (np.sum(steady * shape, axis=(1, 2)) / power)[:, None, None] * shape)


def _mean(image: FloatArray | None, good: NDArray[np.bool_]) -> float:
    return math.nan if image is None else float(np.mean(image[good]))


def _good_pixels(readings: Sequence[_Reading]) -> NDArray[np.bool_]:
    """Pixels whose noise is like the others', over all series."""
    images = [item.variance_DN2 for item in readings if item.variance_DN2 is not None]
    shape = readings[0].mean_DN.shape if readings else (1, 1)
    if not images:
        return np.ones(shape, dtype=bool)
    noise = np.median(np.stack([image / max(float(np.median(image)), 1e-9) for image in images]), axis=0)
    middle = float(np.median(noise))
    good: NDArray[np.bool_] = (noise > 0.05 * middle) & (noise < 20.0 * middle)
    return good if good.mean() > 0.5 else np.ones(shape, dtype=bool)


def _lit_darks(darks: Sequence[_Reading], lit: Sequence[_Reading], good: NDArray[np.bool_]) -> list[Suspect]:
    """Darks that lie far above the darkest one: there was a beam."""
    if len(darks) < 2 or not lit:
        return []
    levels = [float(np.median(item.mean_DN[good])) for item in darks]
    lowest = min(levels)
    beams = [float(np.median(item.mean_DN[good])) for item in lit if item.series.kind == "flat" or len(lit) < 3]
    # without flats the thinnest object stands for them
    weakest = min(beams) if beams else max(float(np.median(item.mean_DN[good])) for item in lit)
    found = []
    for item, level in zip(darks, levels, strict=True):
        rest = [one for one, other in zip(levels, darks, strict=True) if other is not item]
        excess = level - float(np.median(rest))
        before = [float(np.median(one.mean_DN[good])) for one in lit if one.series.index < item.series.index]
        released = _RELEASED * max((one - lowest for one in before[-3:]), default=0.0)
        if excess > max(_DARK_EXCESS * (weakest - lowest), released, 200.0):
            found.append(
                Suspect(
                    series=(item.name,),
                    text=f"{item.name} is labelled dark, but lies {excess:.0f} DN above the other darks: the beam was on",
                    evidence=excess,
                )
            )
    return found if len(found) < len(darks) else []


def _measure(item: _Reading, dark: FloatArray | None, read_DN2: float, good: NDArray[np.bool_]) -> bool:
    """Fill level, noise over signal and picture of a lit series; False where there is no dark to take off."""
    if dark is None:
        return False
    signal = item.mean_DN - dark
    item.picture = signal
    item.level_DN = float(np.median(signal[good]))
    # two or three frames behind an object may differ by the ghost of the exposure before
    if item.variance_DN2 is not None and (item.series.kind == "flat" or item.series.n_frames >= _FRAMES_OF_NOISE):
        mean = float(np.mean(signal[good]))
        quantum = _mean(item.variance_DN2, good) - read_DN2
        if mean > 0 and quantum > 0:
            item.gain_DN = quantum / mean
            pairs = min(item.series.n_frames, _FRAMES) - 1
            pairs = pairs if pairs < 4 else pairs // 2
            item.gain_sd = math.sqrt(4.0 / (max(pairs * 2.0 / 3.0, 1.0) * max(int(good.sum()), 1)))
    return True


def _without_beam(judged: list[_Reading], good: NDArray[np.bool_]) -> tuple[list[Suspect], list[_Reading]]:
    """Flats without light among flats with light."""
    flats = [item for item in judged if item.series.kind == "flat"]
    found, left = [], []
    # per mAs, or per ms: a short exposure is weak by right
    rates = {item.name: item.level_DN / math.exp(item.label.log_load) for item in flats}
    loads = {item.name: item.label.load is None for item in flats}
    dim = set()
    for item in flats:
        alike = [rate for name, rate in rates.items() if loads[name] == loads[item.name]]
        if rates[item.name] <= _NO_BEAM * float(np.median(alike)):
            dim.add(item.name)
    gains = [item.gain_DN for item in flats if item.name not in dim and item.gain_DN > 0]
    usual = float(np.median(gains)) if gains else math.nan
    for item in judged:
        dark = item.name in dim and not _shows_quanta(item, usual, good)
        if item.series.kind == "flat" and (dark or not item.level_DN > 0):
            found.append(
                Suspect(
                    series=(item.name,),
                    text=f"{item.name} is labelled flat, but shows no beam ({item.level_DN:.0f} DN above dark): it looks like a dark",
                    evidence=1e3,
                )
            )
        else:
            left.append(item)
    return found, left


def _shows_quanta(item: _Reading, gain_DN: float, good: NDArray[np.bool_]) -> bool:
    """Whether the little light of a flat has the noise of quanta, which are worth about gain_DN each: a soft beam behind metal."""
    if item.variance_DN2 is None or not item.gain_DN > 0:
        return False
    clear = item.gain_DN * item.level_DN > _CLEAR_QUANTA * item.gain_sd * _mean(item.variance_DN2, good)
    return clear and gain_DN / _ENERGY_RANGE < item.gain_DN < gain_DN * _ENERGY_RANGE


def _relative_gain(flats: Sequence[_Reading], good: NDArray[np.bool_]) -> FloatArray:
    """Shape of the flats (row, column), median 1."""
    images = [item.picture / item.level_DN for item in flats if item.picture is not None and item.level_DN > 0]
    if not images:
        return np.ones(good.shape)
    shape = np.median(np.stack(images), axis=0)
    return np.asarray(np.where(good & (shape > 0.05), shape, 1.0), dtype=np.float64)


def _shadows_in_flats(judged: Sequence[_Reading], good: NDArray[np.bool_]) -> list[Suspect]:
    flats = [item for item in judged if item.series.kind == "flat" and item.picture is not None]
    if len(flats) < 3:
        return []
    found = []
    typical = float(np.median([item.level_DN for item in flats]))
    for item in flats:
        if item.level_DN < _WEAK * typical:
            continue  # darks and read noise have a pattern of their own
        picture = np.maximum(np.asarray(item.picture), 1e-3)[good]
        low, high = np.quantile(np.log(picture), [0.05, 0.95])
        photons = max(item.level_DN, 1e-9) * min(item.series.n_frames, _FRAMES)
        noise = 3.3 * math.sqrt(item.gain_DN / photons) if item.gain_DN > 0 else 0.0
        if high - low > _SHADOW_IN_FLAT + noise:
            found.append(
                Suspect(
                    series=(item.name,),
                    text=f"{item.name} is labelled flat, but its brightness varies by {100 * (1 - math.exp(low - high)):.0f} %"
                    " over the field as no other flat's does: something stood in the beam",
                    evidence=500.0,
                )
            )
    return found if 2 * len(found) < len(flats) else []


def _model(acquisition: AcquisitionFile, judged: Sequence[_Reading]) -> SpectralModel | None:
    voltages = [item.label.kV for item in judged if item.label.kV is not None]
    if not voltages:
        return None
    materials = {layer.material for item in judged for layer in item.label.filters}
    return model_for(acquisition.instrument, materials=sorted(materials), highest_kV=1.1 * max(voltages))


class _Maps:
    """What labels and thickness maps let expect: weights of a beam, level and noise of it, -log T of a scene."""

    def __init__(
        self, acquisition: AcquisitionFile, model: SpectralModel | None, stride: int, good: NDArray[np.bool_]
    ) -> None:
        self.scenes = acquisition.scenes
        self.model = model
        self.good = good
        self._stride = stride
        self._weights: dict[tuple[object, ...], FloatArray | None] = {}
        self._depths: dict[tuple[object, ...], FloatArray | None] = {}
        self._thickness: dict[str, dict[str, FloatArray]] = {}
        self._points: dict[str, tuple[FloatArray, NDArray[np.intp]]] = {}

    def weights(self, label: _Label, inherent_mm_Al: float = _INHERENT_MM_AL) -> FloatArray | None:
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

    def log_level(self, label: _Label, inherent_mm_Al: float = _INHERENT_MM_AL) -> float:
        """Logarithm of the level but for a constant."""
        weights = self.weights(label, inherent_mm_Al)
        rate = 0.0 if weights is None else math.log(max(float(weights[0].sum()), 1e-300))
        return rate + label.log_load - 2.0 * math.log(label.distance_mm)

    def taken_by_filters(self, label: _Label) -> float:
        """-log of what the filters let through of the level; 0 where it is unknown."""
        weights, bare = self.weights(label), self.weights(replace(label, filters=()))
        if weights is None or bare is None:
            return 0.0
        return math.log(max(float(bare[0].sum()), 1e-300) / max(float(weights[0].sum()), 1e-300))

    def log_gain(self, label: _Label) -> float:
        """Logarithm of noise variance over signal but for a constant."""
        weights = self.weights(label)
        return 0.0 if weights is None else math.log(float(weights[1].sum()) / max(float(weights[0].sum()), 1e-300))

    def thickness(self, scene: str) -> dict[str, FloatArray]:
        """Maps (row, column) of a scene at the pixels looked at; empty where it has none."""
        if scene not in self._thickness:
            maps = self.scenes[scene].thickness_mm if scene in self.scenes else {}
            self._thickness[scene] = {
                material: np.asarray(maps[material], dtype=np.float64)[:: self._stride, :: self._stride]
                for material in maps
            }
        return self._thickness[scene]

    def depth(
        self, scene: str, label: _Label, factor: float = 1.0, inherent_mm_Al: float = _INHERENT_MM_AL
    ) -> FloatArray | None:
        """-log T (row, column) of a scene with its path lengths times a factor, or None where it is unknown."""
        key = (scene, label.kV, label.filters, factor, inherent_mm_Al)
        if key not in self._depths:
            self._depths[key] = self._depth(scene, label, factor, inherent_mm_Al)
        return self._depths[key]

    def _depth(self, scene: str, label: _Label, factor: float, inherent_mm_Al: float) -> FloatArray | None:
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


def _measured_depth(item: _Reading, depth: FloatArray, open_DN: float | None) -> FloatArray | None:
    """-log of the picture over the open field: seen beside the object, or as given."""
    if item.picture is None:
        return None
    beside = depth < 0.03
    if beside.sum() >= max(16, 0.02 * depth.size):
        open_DN = float(np.median(item.picture[beside]))
    if open_DN is None or not open_DN > 0:
        return None
    return np.asarray(-np.log(np.maximum(item.picture / open_DN, 1e-6)), dtype=np.float64)


def _correlation(picture: FloatArray, depth: FloatArray, good: NDArray[np.bool_], stride: int) -> float:
    """Largest correlation of a picture's and a map's -log T, smoothed, over displacements of some pixels."""
    from scipy.ndimage import gaussian_filter, median_filter

    measured = gaussian_filter(np.clip(median_filter(picture, 3), -0.2, _DEEPEST), 1.5)
    expected = gaussian_filter(np.clip(depth, 0.0, _DEEPEST), 1.5)
    margin = max(1, max(_SHIFTS_PX) // stride)
    if min(measured.shape) < 4 * margin:
        return math.nan
    inner = (slice(margin, -margin), slice(margin, -margin))
    still = measured[inner] - measured[inner].mean()
    scale = math.sqrt(float(np.vdot(still, still)))
    best = -1.0
    if scale < 1e-9 * math.sqrt(still.size):
        return best
    shifts = sorted({round(shift / stride) for shift in _SHIFTS_PX})
    for down in shifts:
        for right in shifts:
            moved = np.roll(expected, (down, right), axis=(0, 1))[inner]
            moved = moved - moved.mean()
            own = math.sqrt(float(np.vdot(moved, moved)))
            if own >= 1e-9 * math.sqrt(still.size):
                best = max(best, float(np.vdot(still, moved)) / (scale * own))
    return best


_TURNS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "turned by 180 degrees": lambda image: image[::-1, ::-1],
    "mirrored top to bottom": lambda image: image[::-1],
    "mirrored left to right": lambda image: image[:, ::-1],
    "transposed": lambda image: image.T,
    "turned by 90 degrees": np.rot90,
    "turned by 270 degrees": lambda image: np.rot90(image, 3),
}


def _wrong_maps(judged: Sequence[_Reading], maps: _Maps) -> list[Suspect]:
    """Scenes whose thickness maps do not fit the shadow in the frames: empty, another's, turned, or of another scale."""
    placements: dict[str, list[_Reading]] = {}
    for item in judged:
        if item.series.kind == "object" and maps.thickness(item.series.scene):
            placements.setdefault(item.series.scene, []).append(item)
    found: list[Suspect] = []
    scales: dict[str, list[list[float]]] = {}
    inherent_mm_Al = _inherent_mm_Al([item for item in judged if item.series.kind == "flat"], maps)
    for scene, members in placements.items():
        text = _unlike(scene, members, maps, list(placements))
        if text:
            found.append(Suspect(series=tuple(item.name for item in members), text=text, evidence=200.0))
            continue
        scales[scene] = [
            [value for item in members for value in _scales_of_map(item, maps, mm_Al)] for mm_Al in inherent_mm_Al
        ]
    return found + _scaled(scales, placements)


def _inherent_mm_Al(flats: Sequence[_Reading], maps: _Maps) -> tuple[float, ...]:
    """Inherent filtration as flats behind two filters at one voltage have it; where there are none what is usual, and its extremes.

    The median over all such flats: one of them may be mislabelled.
    """
    levels = {
        item.name: np.array([maps.log_level(item.label, mm_Al) for mm_Al in _INHERENT_TRIED_MM_AL])
        for item in flats
        if item.label.load is not None and item.level_DN > 0 and maps.weights(item.label) is not None
    }
    known = [item for item in flats if item.name in levels]
    seen = []
    for number, one in enumerate(known):
        for other in known[:number]:
            if one.label.kV == other.label.kV and one.label.filters != other.label.filters:
                measured = math.log(one.level_DN / other.level_DN)
                off = np.abs(levels[one.name] - levels[other.name] - measured)
                seen.append(_INHERENT_TRIED_MM_AL[int(np.argmin(off))])
    if seen:
        return (float(np.median(seen)),)
    return (_INHERENT_MM_AL, *_INHERENT_MAY_BE_MM_AL)


def _unlike(scene: str, members: Sequence[_Reading], maps: _Maps, others: Sequence[str]) -> str:
    """What the shadow of a scene looks like instead of its own map; empty where it fits or nothing can be said."""
    item = max(members, key=lambda one: one.series.n_frames)
    depth = maps.depth(scene, item.label)
    if depth is None or item.picture is None:
        return ""
    bright = float(np.quantile(item.picture[maps.good], 0.95))
    if not bright > 0:
        return ""
    picture = np.asarray(-np.log(np.maximum(item.picture / bright, 1e-6)), dtype=np.float64)
    photons_known = item.gain_DN > 0  # not of single frames
    noise = math.sqrt(item.gain_DN / bright / item.series.n_frames) if photons_known else _of_neighbours(picture)
    covered = float(np.mean(depth > 0.05))
    ends = [0.05, 1.0 - max(min(covered, 0.15), 0.003) / 3.0]
    shadow = float(np.ptp(np.quantile(picture[maps.good], ends)))
    shows = shadow > 0.05 + 6.0 * noise
    if float(np.max(depth)) < 0.02:
        return f"the thickness maps of {scene} are empty, but its frames show a shadow" if shows else ""
    if float(np.std(np.clip(depth, 0.0, _DEEPEST))) < 0.03:
        return ""
    if not shows:
        # a thin object's shadow is no deeper than noise may be, and there all the same
        none = shadow < 0.5 * float(np.ptp(np.quantile(depth[maps.good], ends)))
        return f"the thickness maps of {scene} hold an object, but its frames show no shadow" if none else ""
    stride = maps._stride
    own = _correlation(picture, depth, maps.good, stride)
    if not own < _FITS:
        return ""
    best, name = own, ""
    for turn, change in _TURNS.items():
        turned = change(depth)
        if turned.shape == depth.shape:
            value = _correlation(picture, turned, maps.good, stride)
            if value > best:
                best, name = value, f"the same maps {turn}"
    for other in others:
        if other != scene:
            candidate = maps.depth(other, item.label)
            if candidate is not None and float(np.std(np.clip(candidate, 0.0, _DEEPEST))) > 0.03:
                value = _correlation(picture, candidate, maps.good, stride)
                if value > best:
                    best, name = value, f"the maps of {other}"
    if name and 1.0 - best < _FITS_BETTER * (1.0 - own) and best > 0.9:
        return f"the thickness maps of {scene} do not fit its frames (correlation {own:.3f}); {name} would ({best:.3f})"
    if own < _FITS_NOT:
        return f"the thickness maps of {scene} do not fit the shadow in its frames (correlation {own:.2f})"
    return ""


def _of_neighbours(picture: FloatArray) -> float:
    """Standard deviation of a picture's noise (row, column), as most neighbours along rows differ."""
    return 1.4826 * float(np.median(np.abs(np.diff(picture, axis=1)))) / math.sqrt(2.0)


def _scales_of_map(item: _Reading, maps: _Maps, inherent_mm_Al: float) -> list[float]:
    """Logarithm of the factor on a scene's path lengths with which its shadow fits, in its thinner and its thicker half."""
    depth = maps.depth(item.series.scene, item.label, inherent_mm_Al=inherent_mm_Al)
    if depth is None:
        return []
    measured = _measured_depth(item, depth, None)
    covered = (depth > 0.05) & (depth < 2.5) & maps.good
    if measured is None or covered.sum() < 100:
        return []
    middle = float(np.median(depth[covered]))
    halves = [covered & (depth <= middle), covered & (depth > middle)]
    found = []
    for half in halves:
        if half.sum() < 30:
            continue

        def left(place: int, half: NDArray[np.bool_] = half) -> float:
            other = maps.depth(item.series.scene, item.label, math.exp(_LOG_FACTORS[place]), inherent_mm_Al)
            # edges lie where they lie: the median of the differences
            return math.nan if other is None else float(np.median(measured[half] - other[half]))

        # longer paths leave less in every pixel: the factor that leaves nothing is found by halving
        low, high = 0, len(_LOG_FACTORS) - 1
        while high - low > 1:
            middle_one = (low + high) // 2
            low, high = (middle_one, high) if left(middle_one) > 0 else (low, middle_one)
        found.append(_LOG_FACTORS[low if abs(left(low)) <= abs(left(high)) else high])
    return found


def _scaled(
    scales: Mapping[str, Sequence[Sequence[float]]], placements: Mapping[str, Sequence[_Reading]]
) -> list[Suspect]:
    """Scenes whose path lengths want one and the same factor at every voltage, far from 1.

    Where all scenes at one distance want such a factor and none at another one does, it is no fault of their maps: scatter
    falls with the gap. Nor where none fits and another inherent filtration that may be would do instead.

    Args:
        scales: logarithms of the factors by scene, with the inherent filtration that is taken, and with others that may be.
        placements: series of each scene.
    """
    wanted: dict[float | None, list[float]] = {}
    for scene, (values, *_) in scales.items():
        if values:
            wanted.setdefault(placements[scene][0].series.source_object_mm, []).append(float(np.median(values)))
    one_fits = any(abs(value) < 0.5 * _SCALE_OFF for group in wanted.values() for value in group)
    found = []
    for scene, (values, *others) in scales.items():
        members = placements[scene]
        voltages = {item.label.kV for item in members}
        if len(values) < 4 or len(voltages) < 2 or max(values) - min(values) > _SCALE_AGREES:
            continue
        middle = float(np.median(values))
        here = members[0].series.source_object_mm
        like_it = {at: [value / middle > 0.5 for value in group] for at, group in wanted.items()} if middle else {}
        of_the_gap = (
            len(like_it.get(here, [])) > 1
            and all(like_it[here])
            and len(like_it) > 1
            and not any(any(group) for at, group in like_it.items() if at != here)
        )
        # a soft beam takes a harder one for shorter paths
        of_the_beam = not one_fits and any(
            math.copysign(1.0, middle) * float(np.median(other)) < _SCALE_OFF for other in others if other
        )
        if abs(middle) > _SCALE_OFF and not (of_the_gap or of_the_beam):
            found.append(
                Suspect(
                    series=tuple(item.name for item in members),
                    text=f"the thickness maps of {scene} fit its frames only if all path lengths are {math.exp(middle):.2f}"
                    " times as long",
                    evidence=100.0,
                    or_effects=_LIKE_SHORTER_PATHS if middle < 0.0 else (),
                )
            )
    return found


# --- labels -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Feature:
    """One number of each of some series: values, standard deviations of their own, and what labels let expect."""

    members: tuple[int, ...]
    values: FloatArray
    own_sd: FloatArray
    expected: Callable[[int, _Label], float]
    covariance: Callable[[Sequence[int], Sequence[_Label]], FloatArray]

    def log_evidence(self, labels: Sequence[_Label]) -> float:
        residual, factor = self._whitened(labels)
        return float(-0.5 * residual @ residual - np.sum(np.log(np.diag(factor))))

    def _whitened(self, labels: Sequence[_Label]) -> tuple[FloatArray, FloatArray]:
        from scipy.linalg import cholesky, solve_triangular

        own = [labels[index] for index in self.members]
        residual = self.values - np.array(
            [self.expected(index, label) for index, label in zip(self.members, own, strict=True)]
        )
        factor = cholesky(self.covariance(self.members, own) + np.diag(self.own_sd**2), lower=True)
        return np.asarray(solve_triangular(factor, residual, lower=True), dtype=np.float64), factor

    def left_out(self, labels: Sequence[_Label]) -> dict[int, float]:
        """|z| of each member given all others."""
        own = [labels[index] for index in self.members]
        residual = self.values - np.array(
            [self.expected(index, label) for index, label in zip(self.members, own, strict=True)]
        )
        inverse = np.linalg.inv(self.covariance(self.members, own) + np.diag(self.own_sd**2))
        z = np.abs(inverse @ residual) / np.sqrt(np.diag(inverse))
        return dict(zip(self.members, z.tolist(), strict=True))


def _same(keys: Sequence[object]) -> FloatArray:
    return np.array([[float(one == other) for other in keys] for one in keys])


def _features(judged: Sequence[_Reading], maps: _Maps) -> list[_Feature]:
    features = []
    since = [item.since for item in judged]

    def beams(members: Sequence[int], labels: Sequence[_Label]) -> tuple[FloatArray, FloatArray]:
        keys = [label.beam for label in labels]
        later = [(key, since[index]) for key, index in zip(keys, members, strict=True)]
        late = np.array([float(since[index]) for index in members])
        return _same(keys), _same(later) * np.outer(late, late)

    def free(labels: Sequence[_Label]) -> FloatArray:
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
            beside = (depth < 0.03) & maps.good
            if beside.sum() >= max(16, 0.02 * depth.size):
                open_DN = float(np.median(item.picture[beside]))
                if open_DN > 0:
                    sd = math.hypot(_LEVEL_SDS["series"], _OBJECT_EXTRA, item.released)
                    levels[index] = (math.log(open_DN), sd)

    def level_covariance(members: Sequence[int], labels: Sequence[_Label]) -> FloatArray:
        _, later = beams(members, labels)
        voltage = _same([label.kV for label in labels])
        late = np.array([float(since[index]) for index in members])
        taken = np.array([maps.taken_by_filters(label) for label in labels])
        return np.asarray(
            _CONSTANT_SD**2
            + voltage * (_LEVEL_SDS["voltage"] ** 2 + _LEVEL_SDS["voltage since"] ** 2 * np.outer(late, late))
            + voltage * _LEVEL_SDS["filters"] ** 2 * np.outer(taken, taken)
            + _LEVEL_SDS["beam since"] ** 2 * later
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
                _GAIN_SDS["series"] + (_OBJECT_EXTRA if item.series.kind == "object" else 0.0),
                item.gain_sd,
                item.released,
            ),
        )
        for index, item in enumerate(judged)
        if item.gain_DN > 0
    }

    def gain_covariance(members: Sequence[int], labels: Sequence[_Label]) -> FloatArray:
        same, later = beams(members, labels)
        late = [float(since[index]) for index in members]
        unknown = [float(maps.weights(label) is None) for label in labels]
        return np.asarray(
            _CONSTANT_SD**2
            + _GAIN_SDS["since"] ** 2 * np.outer(late, late)
            + _GAIN_SDS["beam"] ** 2 * same
            + _GAIN_SDS["beam since"] ** 2 * later
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


def _attenuation(judged: Sequence[_Reading], maps: _Maps) -> list[_Feature]:
    shadows: dict[int, tuple[FloatArray, NDArray[np.bool_]]] = {}
    for index, item in enumerate(judged):
        if item.series.kind != "object":
            continue
        depth = maps.depth(item.series.scene, item.label)
        measured = None if depth is None else _measured_depth(item, depth, None)
        if depth is None or measured is None:
            continue
        covered = (depth > 0.05) & (depth < _DEEPEST) & maps.good
        if covered.sum() >= 50 and float(np.median(measured[covered])) > 0.02:
            shadows[index] = (measured, covered)
    if len(shadows) < 2:
        return []

    def expected(index: int, label: _Label) -> float:
        covered = shadows[index][1]
        depth = maps.depth(judged[index].series.scene, label)
        if depth is None:
            return 0.0
        # the deepest parts are where scatter fills in: the median weighs them no more than others
        return math.log(max(float(np.median(depth[covered])), 1e-3))

    def covariance(members: Sequence[int], labels: Sequence[_Label]) -> FloatArray:
        places = [(judged[index].series.scene, judged[index].series.source_object_mm) for index in members]
        return np.asarray(_ATTENUATION_SDS["all"] ** 2 + _ATTENUATION_SDS["placement"] ** 2 * _same(places))

    depths = np.array([float(np.median(measured[covered])) for measured, covered in shadows.values()])
    released = np.array([judged[index].released for index in shadows])
    sds = np.hypot(_ATTENUATION_SDS["series"], released / np.maximum(depths, 0.1))
    return [_Feature(tuple(shadows), np.log(depths), sds, expected, covariance)]


def _takes(label: _Label, what: str, donor: _Label) -> _Label:
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


def _value(label: _Label, what: str) -> str:
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


_THINGS = ("tube voltage", "filters", "exposure time", "tube load", "setting")


def _relabelled(judged: Sequence[_Reading], model: SpectralModel | None, maps: _Maps) -> list[Suspect]:
    """Series that fit far better with a label of other series; the likeliest change first, then the next on top of it."""
    features = _features(judged, maps)
    labels = [item.label for item in judged]
    names = [item.name for item in judged]

    def evidence(candidate: Sequence[_Label]) -> float:
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


_Candidate = tuple[float, list[_Label], tuple[int, ...], str]  # price, labelling, series it changes, in words


def _exchanged_groups(labels: Sequence[_Label], names: Sequence[str], kinds: Sequence[str]) -> list[_Candidate]:
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


def _candidates(suspects: Sequence[int], labels: Sequence[_Label], names: Sequence[str]) -> list[_Candidate]:
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
