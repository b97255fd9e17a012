"""What is seen of a line at a state: a pure function of twin and state, built on the functions that the commands use.

Declared limits do not stop it: the numbers are those that the line would give, and `limits` says what cannot be.
"""

import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Setting
from ..errors import InputError
from ..generator.datasets.render import refuse_without_spectrum
from ..generator.frames.present_line import present_line
from ..generator.line.line_limits import broken_limits, check_count_rate, frames_per_s, strained_limits
from ..generator.line.spectral_signal import OpenBeam
from ..generator.line.twin import Estimate, Twin
from ..generator.line.twin_spectrum import spectral_model_of
from ..generator.predictions.contrast import Contrast, SlabContrasts
from ..generator.predictions.predict import Prediction, full_scale, predict_flatfield, saturation_text
from ..materials import transmission
from .known_pod import KnownPod
from .picture import ImagePair, draw_pair
from .seen_size import Eye, NetworksObserver, SeenSize
from .state import BEAMS, ExplorerState, Ranges, ranges_of

FloatArray = NDArray[np.float64]
T = TypeVar("T")

_NO_LIMIT = 1e12  # of a tube whose limits are reported, not obeyed
MAP_STEPS = (8, 8)  # low, high voltages of the map
_KEPT = 64  # predictions and contrasts of so many states


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamView:
    """One image of the pair.

    Fields: setting; prediction (flatfield with 95 % intervals; None where there is none); full_scale_share (of the
    converter's range that the open field fills; None where its bits are not known); photons_absorbed_product (a pixel and
    frame behind the product; None without a contrast); energies_keV, open_photons, product_photons (energy,): photons a keV,
    pixel and frame that reach the detector, in the open field and behind the product.
    """

    setting: Setting
    prediction: Prediction | None
    full_scale_share: float | None
    energies_keV: FloatArray = field(repr=False)
    open_photons: FloatArray = field(repr=False)
    product_photons: FloatArray = field(repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class PodView:
    """A known POD curve at the contrast seen: times_a90 (contrast over a90), pod (value, low, high); None where unknown."""

    known: KnownPod
    times_a90: float | None
    pod: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ExplorerView:
    """All that the page shows of a state but the map.

    Fields: state; low, high; contrast (None where there is none); dose_uGy (air kerma of both images together); pair_per_s (pairs
    a second, one image after the other, as far as exposure and readout go); images (None where none can be drawn); pods;
    seen_size (by model observers; None where they cannot say);
    limits (declared limits that are broken, and what makes an answer impossible, in words); cautions (what limits the
    numbers); command, python (texts that give the same numbers).
    """

    state: ExplorerState
    low: BeamView
    high: BeamView
    contrast: Contrast | None
    dose_uGy: Estimate | None
    pairs_per_s: float
    images: ImagePair | None
    pods: tuple[PodView, ...]
    seen_size: SeenSize | None
    limits: tuple[str, ...]
    cautions: tuple[str, ...]
    command: str
    python: str


@dataclass(frozen=True, slots=True, kw_only=True)
class MapView:
    """Contrast-to-noise ratio of the object over both voltages.

    Fields: kV_low, kV_high (axis values); cnr (low, high), NaN where the pair is none, cannot be or saturates; allowed (low, high):
    within the declared limits of the line and without saturation; best (kV low, kV high, ratio) among the allowed; None where none
    is.
    """

    kV_low: tuple[float, ...]
    kV_high: tuple[float, ...]
    cnr: FloatArray = field(repr=False)
    allowed: NDArray[np.bool_] = field(repr=False)
    best: tuple[float, float, float] | None


class Explorer:
    """A twin to look at: what does not change between states is prepared once.

    Args:
        twin: a calibrated line with a spectral part.
        name: how the twin is named on the command line.
        pods: known POD curves.
        networks: an observer that was brought to networks.

    Raises:
        InputError: a twin without spectral part.
    """

    def __init__(
        self, twin: Twin, *, name: str, pods: Sequence[KnownPod] = (), networks: NetworksObserver | None = None
    ) -> None:
        refuse_without_spectrum(twin)
        self.twin = twin
        self.name = name
        self.pods = tuple(pods)
        self.ranges: Ranges = ranges_of(twin)
        self.instrument = twin.instrument
        unlimited = replace(
            twin.instrument,
            maximum_kV=None,
            maximum_current_mA=None,
            maximum_power_w=_NO_LIMIT,
            focal_power_w_per_mm=None,
            maximum_counts_per_s=None,
        )
        self._line = replace(twin, instrument=unlimited)
        self._present = present_line(self._line)
        self._eye = Eye(self._line, networks=networks)
        self._predictions: dict[tuple[bool, Setting], Prediction] = {}
        self._slabs: dict[tuple[Any, ...], SlabContrasts] = {}
        self._asked = 0

    def view(self, state: ExplorerState) -> ExplorerView:
        """What is seen at a state; impossible settings leave parts of it None and say why in `limits`."""
        limits, cautions = self._limits(state)
        beams, predictions = [], []
        for beam in BEAMS:
            setting = state.setting(beam)
            predicted = _or_told(lambda one=setting: self._predict(self._line, one), limits)  # type: ignore[misc]
            predictions.append(predicted)
            beams.append(self._beam(state, setting, predicted, limits))
            if predicted is not None:
                cautions += [f"{_short(setting)}: {text}" for text in predicted.warnings]
        contrast = _or_told(lambda: self._contrast(state), limits)
        if contrast is not None:
            cautions += [text for text in contrast.warnings if not any(text in known for known in cautions)]
        images = None
        low, high = predictions
        if low is not None and high is not None:
            images = _or_told(lambda: self._images(state, (low, high)), limits)
        return ExplorerView(
            state=state,
            low=beams[0],
            high=beams[1],
            contrast=contrast,
            dose_uGy=_dose(low, high),
            pairs_per_s=1.0 / sum(1.0 / frames_per_s(self.instrument, state.setting(beam)) for beam in BEAMS),
            images=images,
            pods=tuple(_pod_view(known, contrast) for known in self.pods),
            seen_size=None if contrast is None else _or_told(lambda: self._eye.see(state), limits),
            limits=tuple(dict.fromkeys(limits)),
            cautions=tuple(text for text in dict.fromkeys(cautions) if text not in limits),
            command=command_text(self.name, state),
            python=python_text(self.name, state),
        )

    def map(self, state: ExplorerState, *, steps: tuple[int, int] = MAP_STEPS) -> MapView:
        """Contrast-to-noise over low and high voltages, powers and all else as in the state."""
        *_, found = self.map_by_rows(state, steps=steps)
        return found  # type: ignore[return-value]

    def map_by_rows(self, state: ExplorerState, *, steps: tuple[int, int] = MAP_STEPS) -> Iterator[MapView | None]:
        """`map` in pieces of some ten milliseconds: None after each of them, the map at the end."""
        lows, highs = self.map_axes(steps)
        cnr = np.full((len(lows), len(highs)), np.nan)
        allowed = np.zeros(cnr.shape, dtype=bool)
        slabs = self._slabs_of(state)
        for row, kV_low in enumerate(lows):
            for column, kV_high in enumerate(highs):
                if kV_low >= kV_high:
                    continue
                pair = replace(state, kV_low=kV_low, kV_high=kV_high)
                low, high = pair.setting("low"), pair.setting("high")
                allowed[row, column] = not any(broken_limits(self.instrument, setting) for setting in (low, high))
                one = _or_told(lambda low=low, high=high: slabs.contrast(low, high, intervals=False), [])  # type: ignore[misc]
                if one is not None and one.cnr_object is not None:
                    cnr[row, column] = one.cnr_object
                else:
                    allowed[row, column] = False
                if row == 0:
                    yield None  # each of these is a beam of its own
            yield None
        usable = np.where(allowed, cnr, -np.inf)
        usable[np.isnan(usable)] = -np.inf
        row, column = (int(one) for one in np.unravel_index(int(usable.argmax()), usable.shape))
        best = (lows[row], highs[column], float(cnr[row, column])) if np.isfinite(usable[row, column]) else None
        yield MapView(kV_low=lows, kV_high=highs, cnr=cnr, allowed=allowed, best=best)

    def map_axes(self, steps: tuple[int, int] = MAP_STEPS) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Voltages of the map's axes, kV: whole ones, the lower half of the range against the upper part of it."""
        lowest, highest = self.ranges.kV
        highest = min(highest, self.instrument.maximum_kV or highest)
        middle = lowest + 0.5 * (highest - lowest)
        quarter = lowest + 0.25 * (highest - lowest)
        lows, highs = np.linspace(lowest + 5.0, middle, steps[0]), np.linspace(quarter, highest, steps[1])
        return tuple(float(round(one)) for one in lows), tuple(float(round(one)) for one in highs)

    def _limits(self, state: ExplorerState) -> tuple[list[str], list[str]]:
        limits, cautions = [], []
        for beam in BEAMS:
            setting = state.setting(beam)
            for broken in broken_limits(self.instrument, setting):
                limits.append(f"{_short(setting)}: {broken.received}; {broken.expected}")
            cautions += [f"{_short(setting)}: {text}" for text in strained_limits(self.instrument, setting)]
        if self._present.effects:
            cautions.append("not drawn in the images: effects " + ", ".join(one.id for one in self._present.effects))
        return limits, cautions

    def _beam(
        self, state: ExplorerState, setting: Setting, predicted: Prediction | None, limits: list[str]
    ) -> BeamView:
        share = None
        if predicted is not None:
            held = full_scale(self.twin, setting, predicted.mean_DN.value)
            if held is not None:
                share = held[0] / held[1]
            saturated = saturation_text(self.twin, setting, predicted.mean_DN.value)
            if saturated:
                limits.append(f"{_short(setting)}: {saturated}")
            if self.instrument.counting and predicted.photons_absorbed is not None:
                photons = predicted.photons_absorbed.value
                _or_told(lambda: check_count_rate(self.instrument, setting, photons), limits)
        twin = self._present.twin
        model = spectral_model_of(twin, highest_kV=max(setting.kV, self.ranges.kV[1]))
        best = twin.spectral.best[None, :] if twin.spectral is not None else model.default_parameters()[None, :]
        photons_per_bin = model.weights(best, OpenBeam(kV=setting.kV, filters=setting.filters))[0]
        energies = model.energies_keV[: photons_per_bin.size]
        width = energies[1] - energies[0]
        distance = setting.source_detector_mm or self.instrument.source_detector_mm or 1000.0
        area = (self.instrument.pixel_mm or 1.0) ** 2
        opened = photons_per_bin / width * (setting.tube_load_mAs or 0.0) * (1000.0 / distance) ** 2 * area
        try:
            through = transmission((state.product,), energies, bin_width_keV=float(width))
        except InputError as error:
            limits.append(str(error))
            through = np.zeros_like(energies)
        return BeamView(
            setting=setting,
            prediction=predicted,
            full_scale_share=share,
            energies_keV=energies,
            open_photons=opened,
            product_photons=opened * through,
        )

    def _contrast(self, state: ExplorerState) -> Contrast:
        return self._slabs_of(state).contrast(state.setting("low"), state.setting("high"))

    def _predict(self, twin: Twin, setting: Setting) -> Prediction:
        """`predict_flatfield` of this line, or of it without its effects, the last ones kept."""
        key = (twin is self._line, setting)
        if key not in self._predictions:
            if len(self._predictions) >= _KEPT:
                self._predictions.clear()
            self._predictions[key] = predict_flatfield(twin, setting)
        return self._predictions[key]

    def _slabs_of(self, state: ExplorerState) -> SlabContrasts:
        """The contrasts of these slabs; beams are kept while only settings change, up to so many."""
        key = (state.product, state.foreign_object, state.object_pixels, state.displaces)
        self._asked += 1
        if key not in self._slabs or self._asked > _KEPT:
            self._asked = 0
            self._slabs = {
                key: SlabContrasts(
                    self._line,
                    product=state.product,
                    foreign_object=state.foreign_object,
                    object_pixels=state.object_pixels,
                    displaces=state.displaces,
                    predict=self._predict,
                )
            }
        return self._slabs[key]

    def _images(self, state: ExplorerState, predictions: tuple[Prediction, Prediction]) -> ImagePair:
        return draw_pair(
            self._present.twin,
            predictions,
            product=state.product,
            foreign_object=state.foreign_object,
            object_pixels=state.object_pixels,
            displaces=state.displaces,
            rng=np.random.default_rng(state.seed),
        )


def _or_told(call: Callable[[], T], told: list[str]) -> T | None:
    """What a call gives, or None with the reason told."""
    try:
        return call()
    except InputError as error:
        told.append(f"{error.argument}: {error.received}; expected {error.expected}")
        return None


def _short(setting: Setting) -> str:
    return f"{setting.kV:g} kV"


def _dose(low: Prediction | None, high: Prediction | None) -> Estimate | None:
    """Air kerma of both images, all their averaged frames; the ends add up, as tube and filtration are the same."""
    if low is None or high is None or low.air_kerma_uGy is None or high.air_kerma_uGy is None:
        return None
    both = [one.air_kerma_uGy.times(one.setting.averaged) for one in (low, high) if one.air_kerma_uGy is not None]
    return Estimate(
        value=sum(one.value for one in both), low=sum(one.low for one in both), high=sum(one.high for one in both)
    )


def _pod_view(known: KnownPod, contrast: Contrast | None) -> PodView:
    if contrast is None or contrast.delta_R is None or not known.of_contrast:
        return PodView(known=known, times_a90=None, pod=None)
    seen = abs(contrast.delta_R.value)
    return PodView(
        known=known, times_a90=seen / known.a90 if known.a90 else None, pod=known.pod_at(seen) if seen > 0 else None
    )


def command_text(name: str, state: ExplorerState) -> str:
    """Commands that print the numbers of a state, one a line."""
    lines = []
    for beam in BEAMS:
        setting = state.setting(beam)
        words = ["raytwin", "predict", name, "--kv", f"{setting.kV:g}"]
        for layer in setting.filters:
            words += ["--filter", str(layer)]
        words += ["--power-w", f"{setting.power_W:g}", "--exposure-ms", f"{setting.exposure_ms:g}"]
        if setting.averaged != 1:
            words += ["--averaged", str(setting.averaged)]
        if setting.source_detector_mm is not None:
            words += ["--source-detector-mm", f"{setting.source_detector_mm:g}"]
        lines.append(shlex.join(words))
    words = ["raytwin", "contrast", "--twin", name, "--product", str(state.product), "--object"]
    words += [str(state.foreign_object), "--object-pixels", str(state.object_pixels)]
    if state.displaces:
        words.append("--displaces")
    words += ["--low", str(state.setting("low")), "--high", str(state.setting("high"))]
    lines.append(shlex.join(words))
    return "\n".join(lines)


def python_text(name: str, state: ExplorerState) -> str:
    """Python that gives the numbers of a state."""
    low, high = str(state.setting("low")), str(state.setting("high"))
    displaces = "    displaces=True,\n" if state.displaces else ""
    return (
        "import raytwin as rt\n\n"
        f"twin = rt.read_twin({name!r})\n"
        f"low = {low!r}\n"
        f"high = {high!r}\n"
        "print(twin.predict(low))\n"
        "print(twin.predict(high))\n"
        "found = rt.contrast(\n"
        "    twin=twin,\n    low=low,\n    high=high,\n"
        f"    product={str(state.product)!r},\n"
        f"    foreign_object={str(state.foreign_object)!r},\n"
        f"    object_pixels={state.object_pixels},\n"
        f"{displaces})\n"
        "print(found)\n"
    )
