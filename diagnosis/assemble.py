"""Session and twin -> the problem that inference solves: residual probes, nuisance factors, responses to every effect."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..acquisition.acquisition_io import AcquisitionFile
from ..errors import InputError
from ..generator.effects import EFFECTS, AppliedEffect
from ..generator.series import (
    ExpectedSeries,
    ModelCache,
    SeriesRequest,
    expected_series,
    session_conditions,
    with_conditions,
)
from ..generator.twin import Twin
from . import changes as scales
from .changes import TwinChange, Variant, smooth_twin, twin_changes
from .inference import LEAST_RESPONSE, Curve
from .output_course import OutputCourse
from .probes import (
    OUTLIER_SD,
    MapProjection,
    ProbeName,
    Scalar,
    ScalarContext,
    Template,
    correlation_sum,
    edge_templates,
    expected_scalars,
    measured_scalars,
    smooth_templates,
    time_templates,
    transmission_templates,
)
from .registration import (
    CELL_SD_PX,
    LARGEST_PX,
    SHARP_PX,
    Placement,
    gradient,
    register,
    register_drawn,
    render_variance,
)
from .session import SessionSeries, only_own_noise, read_session
from .summaries import BLOCK_PX, LAGS, FirstLook, SeriesSummary, look_at_series, summarise_series

Map = NDArray[np.float32]
_CACHE_BYTES = 200_000_000
_PLACEMENTS = 2  # rounds in which a scene is drawn where it was found to lie
_LABEL_PIXELS = 150  # that a noise label needs
_UNKNOWN_GAIN_SD = 0.5  # relative, of the gain of a beam of unknown voltage
_GAIN_MAP_MODES = 3  # cosines along each side
_STEP_SHARE = 0.12  # of the brighter side, over five pixels: more is a step
_KNOW_WHEN = frozenset(
    ("heel", "bad_pixels", "gain_map_error")
)  # effects that look otherwise where calibration has seen them
_ON_OBJECTS_ALONE = frozenset(
    {item.id for item in EFFECTS.values() if item.stage == "object_blur"}
    | {"misregistration", "object_scatter", "composition_error"}
)
_OWN_NOISE = "the flats are single frames: how much noise there is, is known only from these same series"
_AXIS_OF_EFFECT = {
    "object_scatter": "level",
    "veiling_glare": "sharpness",
    "focal_spot": "sharpness",
    "mtf_tail": "sharpness",
    "k_fluorescence": "sharpness",
    "motion_blur": "sharpness",
    "misregistration": "sharpness",
    "image_lag": "time",
    "dark_drift": "level",
    "nonlinearity": "level",
    "kv_error": "energy",
    "filtration_error": "energy",
    "composition_error": "energy",
    "heel": "position",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesView:
    """One series with what pictures of the gap need: measured and expected signal (row, column), and the mean's noise."""

    session: SessionSeries
    summary: SeriesSummary
    expected: ExpectedSeries
    signal_DN: Map
    residual_DN: Map
    noise_DN: Map
    mask: NDArray[np.bool_]
    floor_rms: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """Everything that inference needs; probes are standardised.

    Fields: residual (probe,); factors (probe, nuisance) and factor_names; curves, variants; names (one ProbeName a probe);
    series_of (probe,) index into views; sd (probe,) of scalar probes in their unit, 1 for map probes; noise (probe,): counting
    noise's share of each probe's standard deviation; blocks (probe,):
    series that share local nuisances; groups, group_names: within which an effect's law is off by one factor; parts,
    part_names: places of an unknown effect; views; base: the twin with all pixels alike; gain_shares, dark_weights: how the
    calibrating series make up gain map and darks; skipped: what could not be used and why; missing_effects: effects that
    cannot be judged here and why.
    """

    residual: NDArray[np.float64]
    factors: NDArray[np.float64]
    factor_names: tuple[str, ...]
    curves: tuple[Curve, ...]
    variants: tuple[Variant, ...]
    names: tuple[ProbeName, ...]
    series_of: NDArray[np.intp]
    sd: NDArray[np.float64]
    noise: NDArray[np.float64]
    groups: NDArray[np.intp]
    group_names: tuple[str, ...]
    parts: NDArray[np.intp]
    part_names: tuple[str, ...]
    blocks: NDArray[np.intp]
    views: tuple[SeriesView, ...]
    base: Twin
    gain_shares: dict[str, float]
    dark_weights: dict[float, dict[str, float]]
    skipped: tuple[str, ...]
    missing_effects: dict[str, str]
    conditions: dict[str, float]
    respond: Callable[[Sequence[Variant]], dict[int, NDArray[np.float64]]]

    def released(self) -> "Problem":
        """Without the frames' projections that `respond` holds."""

        def spent(asked: Sequence[Variant]) -> dict[int, NDArray[np.float64]]:
            raise RuntimeError(f"{len(asked)} variants asked of a problem whose projections were released")

        return replace(self, respond=spent)

    def with_variants(self, more: Sequence[tuple[Variant, NDArray[np.float64]]]) -> "Problem":
        """With further variants and their responses (strength, probe)."""
        curves = []
        for variant, responses in more:
            # what an effect does by chance depends on its onset (lost bits lower later levels only), and may on the rest
            alike = [item for item in self.curves if (item.effect, item.since) == (variant.effect, variant.since)]
            like = next((item for item in alike if item.parameters == variant.parameters), alike[0])
            curves.append(variant.curve(responses, spread=like.spread, jitter=like.jitter, exact=like.exact))
        return replace(
            self, curves=(*self.curves, *curves), variants=(*self.variants, *(variant for variant, _ in more))
        )


@dataclass(frozen=True, slots=True)
class _Absorbed:
    """What calibration takes in of a change: change of each calibrating mean frame, of its scalars, darks, gain."""

    mean_DN: dict[str, Map]
    scalars: dict[str, dict[str, float]]
    dark_DN: dict[float, Map]
    gain: Map


@dataclass(slots=True)
class _Change:
    """A change asked of the forward model; what it did to darks and gain map of the calibration is filled in."""

    label: str
    twin: Twin
    effects: tuple[AppliedEffect, ...]
    parameters: NDArray[np.float64] | None
    step_sd: float = 1.0
    spectral: bool = False
    failed: str = ""


def _compact(image: NDArray[np.floating], scale: float) -> NDArray[np.float32]:
    """The map as float32, or (1, 1) where it is the same everywhere."""
    first = float(image.flat[0])
    if float(np.max(image)) - float(np.min(image)) <= 1e-7 * max(scale, 1e-12):
        return np.full((1, 1), first, np.float32)
    return np.asarray(image, dtype=np.float32)


def _labels(
    signal: NDArray[np.float64], open_DN: float, kind: str, good: NDArray[np.bool_]
) -> tuple[Any, tuple[str, ...]]:
    """Noise labels: the whole field, or quartiles of signal away from edges."""
    if kind != "object":
        return np.where(good, 0, -1).astype(np.int64), ("field",)
    from scipy.ndimage import maximum_filter, minimum_filter

    flatness = (maximum_filter(signal, 5) - minimum_filter(signal, 5)) / np.maximum(signal, 1e-9)
    usable = good & (flatness < 0.15) & (signal > 0.01 * open_DN)
    if usable.sum() < 64:
        usable = good
    covered = usable & (signal < 0.97 * open_DN)
    labels = np.full(signal.shape, -1, dtype=np.int64)
    names: list[str] = []
    if (usable & ~covered).sum() >= 64:
        labels[usable & ~covered] = 0
        names.append("open field")
    if covered.sum() >= 3 * _LABEL_PIXELS:
        edges = np.quantile(signal[covered], [0.0, 1 / 3, 2 / 3, 1.0])
        for low, high, name in zip(edges[:-1], edges[1:], ("dark third", "middle third", "bright third"), strict=True):
            inside = covered & (signal >= low) & (signal <= high) & (labels < 0)
            if inside.sum() >= _LABEL_PIXELS:
                labels[inside] = len(names)
                names.append(name)
    if not names:
        return np.where(good, 0, -1).astype(np.int64), ("field",)
    return labels, tuple(names)


def _dark_weights(darks: Sequence[SessionSeries], exposure_ms: float) -> dict[str, float]:
    """Weights with which calibrating darks add up to the dark of an exposure; empty without darks."""
    if not darks:
        return {}
    same = [item for item in darks if abs((item.series.exposure_ms or 0.0) - exposure_ms) <= 1e-6 * max(exposure_ms, 1)]
    if same:
        frames = sum(item.series.n_frames for item in same)
        return {item.name: item.series.n_frames / frames for item in same}
    x = np.array([item.series.exposure_ms or 0.0 for item in darks])
    n = np.array([item.series.n_frames for item in darks], dtype=float)
    if np.ptp(x) <= 0:
        return {item.name: float(w) for item, w in zip(darks, n / n.sum(), strict=True)}
    # a straight line through the darks, evaluated at the exposure: linear in the darks
    design = np.stack([np.ones_like(x), x], axis=1)
    solved = np.linalg.solve(design.T @ (n[:, None] * design), design.T * n)
    weights = np.array([1.0, exposure_ms]) @ solved
    return {item.name: float(w) for item, w in zip(darks, weights, strict=True)}


def build_problem(
    acquisition: AcquisitionFile,
    twin: Twin,
    *,
    variants: Sequence[Variant],
    calibrated_elsewhere: bool = False,
    side: int = 1,
    progress: Callable[[str], None] | None = None,
) -> Problem:
    """Probes, nuisances and effect responses of a session.

    Args:
        acquisition: open file.
        twin: calibrated from this session's calibrating series, or from another session.
        variants: effects to try.
        calibrated_elsewhere: the twin comes from another session (dark and gain maps from the twin unless series here are
            marked as calibrating).
        side: of the squares of the panel's pixels that the acquisition has for pixels.
        progress: called with the name of each stage.

    Raises:
        InputError: nothing that can be judged: no darks and flats, or another detector than the twin's.
    """
    tell = progress or (lambda stage: None)
    session = read_session(acquisition, calibrated_elsewhere=calibrated_elsewhere)
    base = smooth_twin(twin)
    shape = twin.maps.shape
    good = twin.maps.bad_pixels == 0
    skipped: list[str] = []
    usable: list[SessionSeries] = []
    for item in session:
        series = item.series
        if series.shape != shape:
            raise InputError(
                f"series {series.name}",
                received=f"frames of {series.shape}",
                expected=f"the twin's detector of {shape}",
                remedy="diagnose sessions of the detector that the twin was calibrated from",
            )
        reason = _why_not(item, acquisition)
        if reason:
            skipped.append(f"{series.name}: {reason}")
        else:
            usable.append(item)
    cache = ModelCache(draft=True, budget_bytes=_CACHE_BYTES)

    def expect(request: SeriesRequest, change: _Change, unchanged: ExpectedSeries | None = None) -> ExpectedSeries:
        if unchanged is not None and not _touches(change, request):
            return unchanged
        return expected_series(
            change.twin,
            request,
            effects=change.effects,
            parameters=change.parameters,
            cache=cache,
            use_measured_level=False,
        )

    conditions = session_conditions([item.request for item in session], readout_ms=twin.instrument.readout_ms)

    def effect_change(variant: Variant, strength: float) -> _Change:
        return _Change(variant.effect, base, (with_conditions(variant.applied(strength), conditions),), None)

    nothing = _Change("base", base, (), None)
    tell("expectation")
    kept: list[SessionSeries] = []
    expected: dict[str, ExpectedSeries] = {}
    for item in usable:
        try:
            expected[item.name] = expect(item.request, nothing)
        except InputError as error:
            skipped.append(f"{item.name}: {error}")
            continue
        kept.append(item)
    if not kept:
        raise InputError(
            f"acquisition {acquisition.path}",
            received="; ".join(skipped) or "no series",
            expected="darks and flats whose kV, exposure and tube load are stated",
        )

    saturation_DN = None if acquisition.instrument.bits is None else 2.0**acquisition.instrument.bits - 1

    def pattern_of(item: SessionSeries, usable: NDArray[np.bool_]) -> NDArray[np.float64] | None:
        """How one unit of a frame's common factor looks."""
        signal = np.broadcast_to(np.asarray(expected[item.name].signal_DN, dtype=np.float64), shape)
        mean = float(signal[usable].mean())
        return signal / mean if item.series.kind in ("flat", "object") and mean > 0 else None

    tell("frames")
    looks: dict[str, FirstLook] = {}
    label_names: dict[str, tuple[str, ...]] = {}
    labels: dict[str, NDArray[np.int64]] = {}
    for item in kept:
        model = expected[item.name]
        signal = np.broadcast_to(np.asarray(model.signal_DN, dtype=np.float64), shape)
        open_DN = float(signal.max())
        kind = item.series.kind
        labels[item.name], label_names[item.name] = _labels(signal, open_DN, kind, good)
        tell(f"frames of {item.name}")
        looks[item.name] = look_at_series(
            item.series.iter_frames(),
            good=good,
            pattern=pattern_of(item, good),
            name=f"series {item.name}",
            saturation_DN=saturation_DN,
        )
        full = looks[item.name].saturated_share
        if full > 1e-3 and kind != "dark":
            skipped.append(f"{item.name}: saturated in {100 * full:.2g} % of the pixels")
    kept = [item for item in kept if not any(text.startswith(f"{item.name}: saturated") for text in skipped)]

    darks = [item for item in kept if item.calibrates and item.series.kind == "dark"]
    flats = [item for item in kept if item.calibrates and item.series.kind == "flat"]
    weights_of_exposure: dict[float, dict[str, float]] = {}

    def dark_weights(item: SessionSeries) -> dict[str, float]:
        exposure = item.series.exposure_ms or 0.0
        if exposure not in weights_of_exposure:
            weights_of_exposure[exposure] = _dark_weights(darks, exposure)
        return weights_of_exposure[exposure]

    def dark_map(item: SessionSeries) -> NDArray[np.float64]:
        if "offset" in item.series.corrected:
            return np.zeros(shape)
        weights = dark_weights(item)
        if not weights:
            return np.asarray(twin.maps.dark_at(item.series.exposure_ms), dtype=np.float64)
        result = np.zeros(shape)
        for name, weight in weights.items():
            result += weight * looks[name].mean_DN
        return result

    def dark_noise_of(item: SessionSeries) -> float:
        """Variance of the dark that is subtracted, one pixel, DN^2."""
        if "offset" in item.series.corrected:
            return 0.0
        total = 0.0
        for name, weight in dark_weights(item).items():
            variance = float(np.mean(np.broadcast_to(expected[name].white_variance_DN2, shape)[good]))
            total += weight**2 * variance / looks[name].frames
        return total

    # gain map: what the calibrating flats show over what the smooth model expects
    shares: dict[str, float] = {}
    gain = np.zeros(shape)
    gain_quantum = gain_white = 0.0  # relative variance of the gain map: correlated like quanta, and white
    if flats:
        for item in flats:
            model = expected[item.name]
            level = float(np.mean(np.broadcast_to(model.signal_DN, shape)[good]))
            variance = float(
                np.mean(np.broadcast_to(model.quantum_variance_DN2 + model.white_variance_DN2, shape)[good])
            )
            shares[item.name] = level**2 / max(variance, 1e-12) * item.series.n_frames
        total = sum(shares.values())
        shares = {name: value / total for name, value in shares.items()}
        for item in flats:
            model = expected[item.name]
            weight = (shares[item.name] / float(np.mean(np.broadcast_to(model.signal_DN, shape)[good]))) ** 2
            weight /= item.series.n_frames
            gain_quantum += weight * float(np.mean(np.broadcast_to(model.quantum_variance_DN2, shape)[good]))
            gain_white += weight * float(np.mean(np.broadcast_to(model.white_variance_DN2, shape)[good]))
            signal_map = np.maximum(np.broadcast_to(expected[item.name].signal_DN, shape), 1e-9)
            gain += shares[item.name] * (looks[item.name].mean_DN - dark_map(item)) / signal_map
    else:
        gain = _gain_of_twin(twin)
    good = good & (gain > 0.05)
    outlying = _new_outliers(kept, expected, looks, dark_map, gain, good, shape)
    clean = good & ~outlying
    memory = {item.name: _memory(looks[item.name], outlying) for item in kept if item.series.kind == "dark"}
    # they count as outliers; what else is said of noise is said without them
    summaries: dict[str, SeriesSummary] = {}
    for item in kept:
        tell(f"frames of {item.name} without outliers")
        summaries[item.name] = summarise_series(
            item.series.iter_frames(),
            good=clean,
            labels=labels[item.name],
            pattern=pattern_of(item, clean),
            name=f"series {item.name}",
            saturation_DN=saturation_DN,
        )

    tell("registration")
    corrected: dict[str, NDArray[np.float64]] = {}
    for item in kept:
        measured = looks[item.name].mean_DN - dark_map(item)
        if item.series.kind in ("flat", "object") and "gain" not in item.series.corrected:
            measured = measured / np.where(good, gain, 1.0)
        corrected[item.name] = measured
    sharp = base.noise.psf_sigma_px.value < SHARP_PX
    placements: dict[str, Placement] = {}
    first_of_place: set[str] = set()
    for members in _places(kept).values():
        models = [
            np.broadcast_to(np.asarray(expected[item.name].signal_DN, dtype=np.float64), shape) for item in members
        ]
        noises = [
            np.broadcast_to(
                np.asarray(expected[item.name].quantum_variance_DN2 + expected[item.name].white_variance_DN2), shape
            )
            / item.series.n_frames
            for item in members
        ]
        placement = register([corrected[item.name] for item in members], models, noises, clean)
        if not placement.found:
            continue

        def drawn(
            at: tuple[float, float], scene: Sequence[SessionSeries] = tuple(members)
        ) -> list[NDArray[np.float64]]:
            found = (expect(replace(item.request, displacement_px=at), nothing).signal_DN for item in scene)
            return [np.broadcast_to(np.asarray(signal, dtype=np.float64), shape) for signal in found]

        # drawn where it lies, an edge shows what is left of its displacement more truly than any resampled picture
        pictures = [corrected[item.name] for item in members]
        if sharp or acquisition.scenes[members[0].series.scene].kind in ("edge", "disc"):
            placement = register_drawn(pictures, drawn, noises, clean, placement, whole_cells=sharp)
        else:
            # steps of many heights: their places are told by slopes, not by what is left, which other things make as well
            for _ in range(_PLACEMENTS):
                rest = register(pictures, drawn((placement.row_px, placement.column_px)), noises, clean)
                placement = replace(
                    rest, row_px=placement.row_px + rest.row_px, column_px=placement.column_px + rest.column_px
                )
        if math.hypot(placement.row_px, placement.column_px) > LARGEST_PX:
            continue  # nowhere near its maps: compared as it is, and the gap says so
        first_of_place.add(members[0].name)
        for item in members:
            placements[item.name] = placement
            request = replace(item.request, displacement_px=(placement.row_px, placement.column_px))
            position = kept.index(item)
            kept[position] = replace(item, request=request)
            expected[item.name] = expect(request, nothing)

    # every change: effects at their strengths, then what calibration fitted
    all_changes: list[_Change] = []
    for variant in variants:
        for strength in variant.strengths:
            all_changes.append(effect_change(variant, strength))
    for change in all_changes if only_own_noise(session) else ():
        change.failed = _OWN_NOISE if change.label == "excess_noise" else ""
    nuisance_changes: list[TwinChange] = twin_changes(base)
    for step in nuisance_changes:
        all_changes.append(
            _Change(step.name, step.twin, (), step.parameters, step.step_sd, spectral=step.parameters is not None)
        )

    contexts: dict[str, ScalarContext] = {}
    base_scalars: dict[str, dict[str, float]] = {}
    mean_signal: dict[str, float] = {}
    for item in kept:
        mean_signal[item.name] = float(np.mean(np.broadcast_to(expected[item.name].signal_DN, shape)[clean]))
    counting = _counting_series(kept)
    for position, item in enumerate(kept):
        model = expected[item.name]
        before = next(
            (mean_signal[other.name] for other in reversed(kept[:position]) if other.series.kind in ("flat", "object")),
            None,
        )
        frames = item.series.n_frames
        squared = mean_signal[item.name] ** 2 if item.series.kind in ("flat", "object") else 0.0
        pattern_noise, block_noise = _pattern_noise(
            model, clean, frames, gain_quantum * squared, gain_white * squared + dark_noise_of(item)
        )
        contexts[item.name] = ScalarContext(
            kind=item.series.kind,
            frames=frames,
            good=clean,
            labels=np.where(clean, labels[item.name], -1),
            label_names=label_names[item.name],
            reference_signal_DN=max(mean_signal[item.name], 1e-9) if item.series.kind in ("flat", "object") else 1.0,
            previous_signal_DN=before,
            calibrates=item.calibrates,
            codes_usable=item.series.kind in ("dark", "flat")
            and summaries[item.name].code_range > 0
            and summaries[item.name].code_range < 0.02 * clean.sum() * min(frames, 16),
            pattern_noise_DN2=pattern_noise,
            block_noise_DN2=block_noise,
            quantum_DN2=float(np.mean(np.broadcast_to(model.quantum_variance_DN2, shape)[clean])),
            dark_DN=float(np.mean(np.broadcast_to(model.dark_DN, shape)[clean])),
            counts_all_outliers=item.name == counting,
        )
        base_scalars[item.name] = expected_scalars(model, contexts[item.name])

    tell("responses")
    nowhere = np.zeros((1, 1), np.float32)
    calibrating = [item for item in kept if item.calibrates]

    def absorb(change: _Change) -> _Absorbed:
        """What a change does to the calibrating series, and through them to darks and gain map."""
        own: dict[str, Map] = {}
        own_scalars: dict[str, dict[str, float]] = {}
        dark_change: dict[float, Map] = {}
        taken = nowhere
        for item in calibrating:
            try:
                model = expect(item.request, change, expected[item.name])
            except InputError as error:
                change.failed = str(error)
                return _Absorbed(own, own_scalars, dark_change, taken)
            if model is expected[item.name]:
                own[item.name] = nowhere
                own_scalars[item.name] = base_scalars[item.name]
                continue
            scale = max(mean_signal[item.name], 1.0)
            own[item.name] = _compact(np.asarray(model.mean_DN) - np.asarray(expected[item.name].mean_DN), scale)
            own_scalars[item.name] = expected_scalars(model, contexts[item.name])
        for item in kept:
            exposure = item.series.exposure_ms or 0.0
            if exposure not in dark_change:
                total_dark = nowhere
                for name, weight in dark_weights(item).items():
                    total_dark = total_dark + np.float32(weight) * own[name]
                dark_change[exposure] = total_dark
        for item in flats:
            signal_map = np.maximum(np.asarray(expected[item.name].signal_DN, dtype=np.float32), 1e-6)
            lit = own[item.name] - dark_change[item.series.exposure_ms or 0.0]
            taken = taken + np.float32(shares[item.name]) * (lit / _compact(signal_map, 1.0))
        return _Absorbed(own, own_scalars, dark_change, taken)

    def move(
        item: SessionSeries,
        change: _Change,
        taken: _Absorbed,
        known: dict[object, tuple[ExpectedSeries, Map, dict[str, float]]],
    ) -> tuple[Map, dict[str, float]] | None:
        """What a change does to the corrected mean frame of a series, DN, and its scalar probes; None: it cannot be asked.

        known: what other changes do to this series' frames, by what they are whenever they began.
        """
        if change.failed:
            return None
        model = expected[item.name]
        kind = item.series.kind
        dark_shift = taken.dark_DN.get(item.series.exposure_ms or 0.0, nowhere)
        if item.calibrates:
            moved, values = taken.mean_DN[item.name], taken.scalars[item.name]
        else:
            own = _whenever_it_began(change, item.request)
            if own in known:
                changed, moved, values = known[own]
            else:
                try:
                    changed = expect(item.request, change, model)
                except InputError as error:
                    change.failed = str(error)
                    return None
                moved, values = nowhere, base_scalars[item.name]
                if changed is not model:
                    scale = max(mean_signal[item.name], 1.0)
                    moved = _compact(np.asarray(changed.mean_DN) - np.asarray(model.mean_DN), scale)
                    values = expected_scalars(changed, contexts[item.name])
                if own is not None:
                    known[own] = changed, moved, values
            if kind == "afterglow" and bool(np.any(dark_shift)):
                values = expected_scalars(changed, contexts[item.name], dark_change_DN=-dark_shift)
        moved = moved - dark_shift
        if item.name in placements and _only_displaces(change):
            moved = nowhere
        if kind in ("flat", "object") and bool(np.any(taken.gain)):
            moved = moved - np.asarray(model.signal_DN, dtype=np.float32) * taken.gain
        if item.name in first_of_place and item.name in placements:
            values = (
                values | {"displacement along rows": 0.0, "displacement along columns": 0.0} | _displacement_of(change)
            )
        return np.asarray(moved, dtype=np.float32), values

    taken_in = [absorb(change) for change in all_changes]

    # 2. series by series: templates, projections, responses
    thicker_scenes: dict[tuple[str, str], dict[str, NDArray[np.floating]]] = {}
    blocks: list[dict[str, Any]] = []
    views: list[SeriesView] = []
    for item in kept:
        tell(f"responses of {item.name}")
        model = expected[item.name]
        signal = np.broadcast_to(np.asarray(model.signal_DN, dtype=np.float64), shape)
        kind = item.series.kind
        maps: list[Map | None] = []
        known: dict[object, tuple[ExpectedSeries, Map, dict[str, float]]] = {}
        scalars: list[dict[str, float] | None] = []
        for change, taken in zip(all_changes, taken_in, strict=True):
            found = move(item, change, taken, known)
            maps.append(None if found is None else found[0])
            scalars.append(None if found is None else found[1])
        residual_map = corrected[item.name] - signal
        lies = placements.get(item.name)
        mask = clean if lies is None else _inside(clean, lies)
        frames = item.series.n_frames
        quantum = np.broadcast_to(np.asarray(model.quantum_variance_DN2, dtype=np.float64), shape) / frames
        quantum = quantum + signal**2 * gain_quantum
        white = (
            np.broadcast_to(np.asarray(model.white_variance_DN2, dtype=np.float64), shape) / frames
            + signal**2 * gain_white
            + dark_noise_of(item)
        )
        if kind == "object":
            white = white + render_variance(signal, side=side)
            if acquisition.scenes[item.series.scene].kind not in ("edge", "disc"):
                # steps of wedges and outlines of products are rendered no better than their maps' pixels
                mask = mask & ~_near_steps(signal)
        templates = smooth_templates(signal, mask, kind=kind)
        if kind == "object":
            open_map = np.full(shape, float(np.max(signal)))
            templates += transmission_templates(signal, open_map, mask)
            templates += edge_templates(signal)
        if kind == "afterglow":
            templates += _ghost_templates(item, kept, expected, shape)
        position = 0
        for variant in variants:
            image = maps[position]
            position += len(variant.strengths)
            if image is not None and image.shape == shape:
                templates.append(
                    Template(
                        axis=_AXIS_OF_EFFECT.get(variant.effect, "position"),
                        name=f"like {variant.effect} {variant.name}".strip(),
                        unit="1",
                        image=image,
                    )
                )
        projection = MapProjection(
            templates,
            mask=mask,
            quantum_DN2=quantum,
            white_DN2=white,
            autocovariance_table=model.noise_autocovariance,
        )
        pattern_DN2, block_DN2, outliers = _pattern_statistics(
            residual_map, projection, quantum + white, clean, good, kind
        )
        scalar_probes = measured_scalars(
            summaries[item.name],
            model,
            contexts[item.name],
            dark_mean_DN=float(np.mean(dark_map(item)[clean])),
            fixed_pattern_DN2=pattern_DN2,
            block_pattern_DN2=block_DN2,
            outliers=outliers,
            all_outliers=int(np.count_nonzero(outlying)),
            memory=memory.get(item.name),
        )
        scalar_probes = [probe for probe in scalar_probes if probe.name in base_scalars[item.name]]
        if lies is not None and item.name in first_of_place:
            scalar_probes += _displacement_probes(lies)
            base_scalars[item.name] = base_scalars[item.name] | {
                "displacement along rows": 0.0,
                "displacement along columns": 0.0,
            }
        floor_map = _half_difference(item, summaries[item.name])
        views.append(
            SeriesView(
                session=item,
                summary=summaries[item.name],
                expected=model,
                signal_DN=np.asarray(signal, np.float32),
                residual_DN=np.asarray(residual_map, np.float32),
                noise_DN=np.sqrt(quantum + white).astype(np.float32),
                mask=mask,
                floor_rms=floor_map,
            )
        )
        thicker: dict[str, tuple[Map, dict[str, float]]] = {}
        for material in item.request.thickness_mm or {} if kind == "object" else {}:
            # one mapping for all series of the scene, so that it is drawn once
            scene = thicker_scenes.setdefault(
                (item.series.scene, material),
                _thicker(item.request.thickness_mm or {}, material, 1.0 + scales.THICKNESS_SD),
            )
            changed = expected_series(
                base,
                replace(item.request, thickness_mm=scene),
                effects=(),
                cache=cache,
                use_measured_level=False,
            )
            thicker[material] = (
                np.asarray(np.asarray(changed.mean_DN) - np.asarray(model.mean_DN), dtype=np.float32),
                expected_scalars(changed, contexts[item.name]),
            )
        blocks.append(
            _block(
                item,
                projection,
                residual_map,
                signal,
                scalar_probes,
                base_scalars[item.name],
                maps,
                scalars,
                thicker,
                frozenset(index for index, change in enumerate(all_changes) if change.label in scales.UNEVEN),
                contexts[item.name].previous_signal_DN,
                shape,
                sharp,
            )
        )
        if flats and kind in ("flat", "object") and not item.calibrates and "gain" not in item.series.corrected:
            lasting = gain_white + gain_quantum * correlation_sum(model, BLOCK_PX, BLOCK_PX)
            own = _of_gain_map(projection, signal, math.sqrt(lasting), len(scalar_probes))
            blocks[-1]["local"] |= {name: column * blocks[-1]["shrink"] for name, column in own.items()}

    def respond(asked: Sequence[Variant]) -> dict[int, NDArray[np.float64]]:
        """Responses (strength, probe) of further variants, by their place in `asked`; failed ones are left out."""
        number_of = [number for number, variant in enumerate(asked) for _ in variant.strengths]
        changes = [effect_change(variant, strength) for variant in asked for strength in variant.strengths]
        taken_in = [absorb(change) for change in changes]
        rows = np.zeros((len(changes), sum(len(block["residual"]) for block in blocks)))
        start = 0
        for item, block in zip(kept, blocks, strict=True):
            found = [move(item, change, taken, {}) for change, taken in zip(changes, taken_in, strict=True)]
            seen = [(row, one) for row, one in enumerate(found) if one is not None]
            stop = start + len(block["residual"])
            if seen:
                images, values = zip(*(one for _, one in seen), strict=True)
                part = _standardised(block, base_scalars[item.name], images, values)
                rows[[row for row, _ in seen], start:stop] = part
            start = stop
        failed = {number for number, change in zip(number_of, changes, strict=True) if change.failed}
        return {
            number: rows[[row for row, own in enumerate(number_of) if own == number]]
            for number in range(len(asked))
            if number not in failed
        }

    return _join(
        blocks,
        views,
        kept,
        variants,
        all_changes,
        nuisance_changes,
        skipped,
        base=base,
        gain_shares=shares,
        dark_weights=weights_of_exposure,
        conditions=conditions,
        respond=respond,
    )


def map_changes(problem: Problem, effects: Sequence[AppliedEffect]) -> list[Map]:
    """What effects add to each view's corrected mean frame (row, column), DN, calibration having taken in its part."""
    shape = problem.base.maps.shape
    cache = ModelCache(draft=True, budget_bytes=_CACHE_BYTES)
    moved: dict[str, NDArray[np.float64]] = {}
    for view in problem.views:
        changed = expected_series(
            problem.base, view.session.request, effects=effects, cache=cache, use_measured_level=False
        )
        moved[view.session.name] = np.asarray(changed.mean_DN) - np.asarray(view.expected.mean_DN)

    def lit(view: SeriesView) -> NDArray[np.float64]:
        weights = problem.dark_weights.get(view.session.series.exposure_ms or 0.0, {})
        return moved[view.session.name] - sum((w * moved[name] for name, w in weights.items()), np.zeros(shape))

    taken = np.zeros(shape)
    for view in problem.views:
        share = problem.gain_shares.get(view.session.name)
        if share:
            taken = taken + share * lit(view) / np.maximum(view.signal_DN, 1e-6)
    result = []
    for view in problem.views:
        change = lit(view)
        if view.session.series.kind in ("flat", "object"):
            change = change - view.signal_DN * taken
        result.append(np.asarray(change, dtype=np.float32))
    return result


def _whenever_it_began(change: _Change, request: SeriesRequest) -> object | None:
    """What stands for a change of a series that the same effect, begun at another time, would make as well; None: only itself."""
    if len(change.effects) != 1 or change.effects[0].id in _KNOW_WHEN or not _touches(change, request):
        return None
    effect = change.effects[0]
    if effect.since == "always" and any(not item.after_calibration for item in request.previous):
        return None  # what was exposed before calibration ended remembers when it began
    return (effect.id, tuple(effect.parameters.items()), tuple(effect.options.items()))


def _touches(change: _Change, request: SeriesRequest) -> bool:
    """Whether a change can show in a series."""
    if not change.effects:
        return change.spectral is False or request.beam_on
    for effect in change.effects:
        if effect.since == "calibration" and not request.after_calibration:
            continue
        if can_show(effect.id, request) and not (effect.id in _ON_OBJECTS_ALONE and _only_displaces(change)):
            return True
    return False


def can_show(effect: str, request: SeriesRequest) -> bool:
    """Whether an effect of the catalogue can move a series at all, whatever its law."""
    if effect in _ON_OBJECTS_ALONE:
        return request.kind == "object"
    if EFFECTS[effect].stage in ("beam", "arrivals", "quanta", "optics", "exposure"):
        return request.beam_on
    return True


def _places(kept: Sequence[SessionSeries]) -> dict[tuple[str, float], list[SessionSeries]]:
    """Object series by where their scene stood."""
    places: dict[tuple[str, float], list[SessionSeries]] = {}
    for item in kept:
        if item.series.kind == "object":
            places.setdefault((item.series.scene, item.request.source_object_mm or 0.0), []).append(item)
    return places


def _inside(mask: NDArray[np.bool_], placement: Placement) -> NDArray[np.bool_]:
    """The mask less the border that a displaced picture does not cover."""
    margin = 2 + math.ceil(max(abs(placement.row_px), abs(placement.column_px)))
    inside = np.zeros_like(mask)
    inside[margin:-margin, margin:-margin] = mask[margin:-margin, margin:-margin]
    return inside


def _near_steps(signal: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Pixels within two of a step in the signal."""
    from scipy.ndimage import maximum_filter, minimum_filter

    highest, lowest = maximum_filter(signal, 5), minimum_filter(signal, 5)
    steps: NDArray[np.bool_] = (highest - lowest) > _STEP_SHARE * np.maximum(highest, 1e-9)
    return steps


def _displacement_probes(placement: Placement) -> list[Scalar]:
    return [
        Scalar(
            axis="sharpness",
            name=f"displacement along {name}",
            unit="px",
            value=value,
            sd=math.hypot(sd, scales.POSITION_SD_PX),
            sampling_sd=sd,
        )
        for name, value, sd in (
            ("rows", placement.row_px, placement.row_sd_px),
            ("columns", placement.column_px, placement.column_sd_px),
        )
        if sd < 0.3
    ]


def _displacement_of(change: _Change) -> dict[str, float]:
    """Displacement (px) that a change brings to a scene's picture."""
    for effect in change.effects:
        if effect.id == "misregistration":
            size = effect.parameters["strength"] * math.cos(
                math.radians(effect.parameters.get("magnification_deg", 0.0))
            )
            angle = math.radians(effect.parameters.get("direction_deg", 0.0))
            return {
                "displacement along rows": size * math.cos(angle),
                "displacement along columns": size * math.sin(angle),
            }
    return {}


def _only_displaces(change: _Change) -> bool:
    """Whether a change is a mere shift of the scene, which registration takes out of the pictures."""
    return any(
        effect.id == "misregistration" and abs(effect.parameters.get("magnification_deg", 0.0)) < 1.0
        for effect in change.effects
    )


def _why_not(item: SessionSeries, acquisition: AcquisitionFile) -> str:
    series = item.series
    if "log" in series.corrected:
        return "log images: counts are needed"
    if series.kind == "dark":
        return "" if series.exposure_ms is not None else "exposure unknown"
    if series.kind == "afterglow":
        return ""
    load_stated = series.setting is not None and series.setting.tube_load_mAs is not None
    if not load_stated and item.request.open_signal_DN is None:
        return "kV, exposure or tube load unknown"
    if series.kind == "object":
        scene = acquisition.scenes.get(series.scene)
        if scene is None or not len(scene.thickness_mm):
            return "object of unknown thickness"
    return ""


def _gain_of_twin(twin: Twin) -> NDArray[np.float64]:
    shapes = [level.flat_shape for level in twin.levels]
    gain = np.asarray(twin.maps.gain_relative, dtype=np.float64)
    if shapes:
        gain = np.asarray(np.mean(np.stack(shapes), axis=0), dtype=np.float64)
    return gain


def _ghost_templates(
    item: SessionSeries, kept: Sequence[SessionSeries], expected: dict[str, ExpectedSeries], shape: tuple[int, int]
) -> list[Template]:
    lit = [
        other for other in kept if other.series.kind in ("flat", "object") and other.series.index < item.series.index
    ]
    if not lit:
        return []
    image = np.broadcast_to(np.asarray(expected[lit[-1].name].signal_DN, dtype=np.float64), shape)
    return [Template(axis="time", name=f"ghost of {lit[-1].name}", unit="1", image=image)]


def _pattern_noise(
    model: ExpectedSeries, mask: NDArray[np.bool_], frames: int, map_quantum_DN2: float, map_white_DN2: float
) -> tuple[float, float]:
    """Noise of the corrected mean frame from pixel to pixel and of block means, DN^2.

    map_quantum_DN2, map_white_DN2: noise that dark and gain map bring in, correlated as quanta are, and white.
    """
    from .probes import autocovariance, correlation_sum

    q = float(np.mean(np.broadcast_to(model.quantum_variance_DN2, mask.shape)[mask])) / frames + map_quantum_DN2
    w = float(np.mean(np.broadcast_to(model.white_variance_DN2, mask.shape)[mask])) / frames + map_white_DN2
    pixel = q * (1.0 - autocovariance(model, 0, 1)) + w
    block = (q * correlation_sum(model, BLOCK_PX, BLOCK_PX) + w) / BLOCK_PX**2
    return max(pixel, 1e-12), max(block, 1e-12)


def _smooth_part(residual: NDArray[np.float64], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Cubic surface (row, column) through the medians of blocks: what map probes hold, and what is no pixel's own."""
    rows, columns = residual.shape
    if min(rows, columns) < 5 * BLOCK_PX:
        return np.zeros(residual.shape)
    whole = residual[: rows - rows % BLOCK_PX, : columns - columns % BLOCK_PX]
    inside = mask[: whole.shape[0], : whole.shape[1]]
    part = np.where(inside, whole, np.nan).reshape(
        whole.shape[0] // BLOCK_PX, BLOCK_PX, whole.shape[1] // BLOCK_PX, BLOCK_PX
    )
    filled = np.moveaxis(part, 1, 2).reshape(part.shape[0], part.shape[2], -1)
    known = np.count_nonzero(np.isfinite(filled), axis=-1) > BLOCK_PX**2 // 2
    if np.count_nonzero(known) < 16:
        return np.zeros(residual.shape)
    medians = np.nanmedian(filled[known], axis=-1)

    def terms(y: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y, x**3, y**3], axis=-1)

    centre = 0.5 * (BLOCK_PX - 1)
    block_y, block_x = (np.asarray(index * BLOCK_PX + centre, dtype=np.float64) for index in np.nonzero(known))
    solved = np.linalg.lstsq(terms(2.0 * block_y / rows - 1.0, 2.0 * block_x / columns - 1.0), medians, rcond=None)[0]
    y, x = np.meshgrid(2.0 * np.arange(rows) / rows - 1.0, 2.0 * np.arange(columns) / columns - 1.0, indexing="ij")
    return np.asarray(terms(y, x) @ solved)


def _pattern_statistics(
    residual: NDArray[np.float64],
    projection: MapProjection,
    variance: NDArray[np.float64],
    clean: NDArray[np.bool_],
    good: NDArray[np.bool_],
    kind: str,
) -> tuple[float | None, float | None, int | None]:
    """Pixel-to-pixel and block variance of a flat's or dark's residual map, and how many good pixels stand out."""
    if kind not in ("flat", "dark"):
        return None, None, None
    residual = residual - _smooth_part(residual, clean)
    pair = clean[:, 1:] & clean[:, :-1]
    step = (residual[:, 1:] - residual[:, :-1])[pair]
    pixel = float(np.mean(step**2)) / 2.0
    rows, columns = (side - side % BLOCK_PX for side in clean.shape)
    part = clean[:rows, :columns].reshape(rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX)
    weight = part.sum(axis=(1, 3))
    values = np.where(clean, residual, 0.0)[:rows, :columns].reshape(part.shape).sum(axis=(1, 3))
    means = values / np.maximum(weight, 1)
    # neighbouring blocks' differences: free of the smooth shapes that the map probes hold
    across = (means[:, 1:] - means[:, :-1])[(weight[:, 1:] > 32) & (weight[:, :-1] > 32)]
    block = float(np.mean(across**2)) / 2.0 if across.size >= 8 else None
    centre = float(np.median(residual[clean]))
    standing_out = np.abs(residual - centre) > OUTLIER_SD * np.sqrt(variance) * max(
        1.0, math.sqrt(pixel / max(float(np.mean(variance[clean])), 1e-30))
    )
    return pixel, block, int(np.count_nonzero(standing_out & good))


def _new_outliers(
    kept: Sequence[SessionSeries],
    expected: dict[str, ExpectedSeries],
    looks: Mapping[str, FirstLook],
    dark_map: Callable[[SessionSeries], NDArray[np.float64]],
    gain: NDArray[np.float64],
    good: NDArray[np.bool_],
    shape: tuple[int, int],
) -> NDArray[np.bool_]:
    """Good pixels that stand out in any dark or flat: they count as outliers and are left out of everything else."""
    outlying = np.zeros(shape, dtype=bool)
    for item in kept:
        if item.series.kind not in ("dark", "flat"):
            continue
        summary = looks[item.name]
        residual = summary.mean_DN - dark_map(item)
        if item.series.kind == "flat":
            signal = np.broadcast_to(expected[item.name].signal_DN, shape)
            residual = residual / np.where(good, gain, 1.0)
            residual = residual - signal * float(np.median((residual / np.maximum(signal, 1e-9))[good]))
        residual = residual - _smooth_part(residual, good)
        centre = float(np.median(residual[good]))
        spread = 1.4826 * float(np.median(np.abs(residual[good] - centre)))
        outlying |= np.abs(residual - centre) > 8.0 * max(spread, 1e-9)
        if summary.frames > 9:
            ratio = summary.pair_variance_DN2 / max(float(np.median(summary.pair_variance_DN2[good])), 1e-12)
            signal = np.broadcast_to(np.asarray(expected[item.name].signal_DN), shape)
            outlying |= (ratio > max(_largest_ratio(summary.frames), 2.5)) & good
    outlying &= good
    # a detector full of outliers is a pattern, not a set of defects
    return outlying if outlying.sum() < 0.1 * good.sum() else np.zeros(shape, dtype=bool)


@lru_cache(maxsize=64)
def _largest_ratio(frames: int) -> float:
    """Variance from differences of successive frames over its expectation that one pixel in ten million passes by chance."""
    from scipy.stats import chi2

    freedom = 2.0 * (frames - 1.0) / 3.0  # successive differences share frames
    return float(chi2.isf(1e-7, freedom) / freedom)


def _memory(summary: FirstLook, outlying: NDArray[np.bool_]) -> tuple[float, int] | None:
    """Median share of outlying pixels' variance that lasts from frame to frame, and their number; None: none is noisy."""
    stack, pair = summary.stack_variance_DN2[outlying], summary.pair_variance_DN2[outlying]
    seen = stack > 0
    if not seen.any():
        return None
    return float(np.median(1.0 - pair[seen] / stack[seen])), int(np.count_nonzero(seen))


def _counting_series(kept: Sequence[SessionSeries]) -> str:
    """The later series that pixels standing out anywhere are counted with; empty where dead or hot ones cannot show."""
    later = [item for item in kept if not item.calibrates and item.series.kind in ("dark", "flat")]
    return later[-1].name if {item.series.kind for item in later} == {"dark", "flat"} else ""


def _half_difference(item: SessionSeries, summary: SeriesSummary) -> float:
    """Scatter of the mean frame as repeats show it, over what differences of frames predict (1 = noise only)."""
    if summary.frames < 4:
        return 1.0
    steps = np.diff(summary.frame_mean_DN)
    white = float(np.mean(steps**2)) / 2.0
    total = float(np.var(summary.frame_mean_DN, ddof=1))
    return math.sqrt(total / white) if white > 0 else 1.0


def _block(
    item: SessionSeries,
    projection: MapProjection,
    residual_map: NDArray[np.float64],
    signal: NDArray[np.float64],
    scalar_probes: Sequence[Scalar],
    base_scalars: dict[str, float],
    maps: Sequence[Map | None],
    scalars: Sequence[dict[str, float] | None],
    thicker: dict[str, tuple[Map, dict[str, float]]],
    uneven: frozenset[int],
    previous_DN: float | None,
    shape: tuple[int, int],
    sharp: bool,
) -> dict[str, Any]:
    names = projection.names() + [
        ProbeName(axis=probe.axis, statistic=probe.name, location="", unit=probe.unit) for probe in scalar_probes
    ]
    scalar_residual = np.array([(probe.value - base_scalars[probe.name]) / probe.sd for probe in scalar_probes])
    # unit noise again once the floor of what edges show is added
    floored = 1.0 / math.hypot(1.0, scales.SHARPNESS_FLOOR)
    shrink = np.array(
        [
            floored
            if item.series.kind == "object" and name.axis == "sharpness" and name.statistic == "mean frame"
            else 1.0
            for name in names
        ]
    )
    residual = np.concatenate([projection.apply(residual_map), scalar_residual])
    local = _local_nuisances(item, projection, signal, scalar_probes, thicker, base_scalars, sharp)
    block = {
        "item": item,
        "names": names,
        "projection": projection,
        "scalar_probes": tuple(scalar_probes),
        "shrink": shrink,
        "residual": residual * shrink,
        "local": {key: column * shrink for key, column in local.items()},
        "sd": np.concatenate([np.ones(len(projection)), [probe.sd for probe in scalar_probes]]),
        "maps": len(projection),
        "noise": np.concatenate([np.ones(len(projection)), [probe.sampling_sd / probe.sd for probe in scalar_probes]])
        * shrink,
    }
    responses = np.zeros((len(maps), len(residual)))
    known = [
        (index, image, values)
        for index, (image, values) in enumerate(zip(maps, scalars, strict=True))
        if image is not None and values is not None
    ]
    if known:
        found = _standardised(block, base_scalars, [one[1] for one in known], [one[2] for one in known])
        responses[[one[0] for one in known]] = found
    block["responses"] = responses
    block["offset"] = _offset(item, projection, scalar_probes, previous_DN) * shrink
    block["pattern"], block["pattern_jitter"] = _pattern_of_gain(item, projection, signal, len(scalar_probes), shrink)
    # a panel seldom warms evenly, and no anode's heel is a straight line
    rows, columns = shape
    ramps = (np.linspace(-1, 1, rows)[:, None], np.linspace(-1, 1, columns)[None, :])
    some = [(index, image) for index, image in enumerate(maps) if index in uneven and image is not None]
    found = np.zeros((2 * len(some), len(names)))
    if some:
        alike = projection.apply(np.stack([np.broadcast_to(ramp, shape) for ramp in ramps]))
        for place, (_, image) in enumerate(some):
            moved = float(image.flat[0]) * alike if image.size == 1 else None
            if moved is None:
                moved = projection.apply(np.stack([image * ramp for ramp in ramps]))
            found[2 * place : 2 * place + 2, : len(projection)] = moved
    found *= shrink
    block["uneven"] = {index: found[2 * place : 2 * place + 2] for place, (index, _) in enumerate(some)}
    return block


def _offset(
    item: SessionSeries,
    projection: MapProjection,
    scalar_probes: Sequence[Scalar],
    previous_DN: float | None,
) -> NDArray[np.float64]:
    """What one DN more in every pixel of a later series does (probe,)."""
    if item.calibrates:
        return np.zeros(len(projection) + len(scalar_probes))
    scalars = [
        1.0 / previous_DN / probe.sd if previous_DN and probe.name.startswith("afterglow") else 0.0
        for probe in scalar_probes
    ]
    return np.concatenate([projection.of_level, scalars])


def _pattern_of_gain(
    item: SessionSeries,
    projection: MapProjection,
    signal: NDArray[np.float64],
    n_scalars: int,
    shrink: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What 1 % of a changed gain map does by chance: responses (probe, wave) of its smooth part, variance (probe,) of the rest."""
    waves = _pattern_waves(signal.shape)
    smooth = np.zeros((len(projection) + n_scalars, len(waves)))
    rest = np.zeros(len(projection) + n_scalars)
    if item.calibrates or item.series.kind not in ("flat", "object"):
        return smooth, rest
    smooth[: len(projection)] = projection.apply(waves * signal.astype(np.float32)).T
    rest[: len(projection)] = projection.pixel_noise(0.01 * math.sqrt(1.0 - scales.PATTERN_SMOOTH_SHARE) * signal)
    return smooth * shrink[:, None], rest * shrink**2


@lru_cache(maxsize=1)
def _pattern_waves(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The smooth part of 1 % of a changed gain map: waves (wave, row, column) that it holds by chance."""
    waves = _waves(shape, scales.PATTERN_WAVES + 1)
    total = sum(1.0 / math.hypot(*numbers) for numbers in waves)
    result = np.empty((len(waves), *shape), np.float32)
    for image, (numbers, wave) in zip(result, waves.items(), strict=True):
        share = scales.PATTERN_SMOOTH_SHARE / math.hypot(*numbers) / total
        image[...] = 0.01 * math.sqrt(share / float(np.mean(wave**2))) * wave
    return result


@lru_cache(maxsize=8)
def _waves(shape: tuple[int, ...], count: int) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Products of `count` cosines along each side (row, column), by their numbers; the even field is left out."""
    y, x = (np.cos(np.pi * np.outer(np.arange(count), (np.arange(length) + 0.5) / length)) for length in shape)
    return {(i, k): np.outer(y[i], x[k]) for i in range(count) for k in range(count) if i or k}


def _standardised(
    block: dict[str, Any],
    base_scalars: Mapping[str, float],
    images: Sequence[Map],
    values: Sequence[Mapping[str, float]],
) -> NDArray[np.float64]:
    """Responses (change, probe) of one series' probes to changes of its mean frame and scalars."""
    projection: MapProjection = block["projection"]
    moved = projection.apply_each(images)
    scalar = np.array(
        [
            [(own.get(probe.name, base_scalars[probe.name]) - base_scalars[probe.name]) / probe.sd for own in values]
            for probe in block["scalar_probes"]
        ]
    ).reshape(-1, len(images))
    return np.asarray(np.concatenate([moved, scalar.T], axis=1) * block["shrink"])


def _local_nuisances(
    item: SessionSeries,
    projection: MapProjection,
    signal: NDArray[np.float64],
    scalar_probes: Sequence[Scalar],
    thicker: dict[str, tuple[Map, dict[str, float]]],
    base_scalars: Mapping[str, float],
    sharp: bool,
) -> dict[str, NDArray[np.float64]]:
    """Factors of one series, by name; equal names in several series are one nuisance."""
    series = item.series
    images: dict[str, NDArray[np.floating]] = {}  # of nuisances that change the mean frame alone

    def of_scalars(change: Callable[[Scalar], float]) -> NDArray[np.float64]:
        return np.concatenate([np.zeros(len(projection)), [change(probe) / probe.sd for probe in scalar_probes]])

    def projected(images: Mapping[str, NDArray[np.floating]]) -> dict[str, NDArray[np.float64]]:
        found = projection.apply(np.stack(list(images.values())).astype(np.float32))
        return dict(zip(images, np.pad(found, ((0, 0), (0, len(scalar_probes)))), strict=True))

    result: dict[str, NDArray[np.float64]] = {}
    result["shape of the noise"] = of_scalars(lambda probe: scales.KURTOSIS_SD if probe.name == "kurtosis" else 0.0)
    rows, columns = signal.shape
    y = np.linspace(-1, 1, rows)[:, None] * np.ones((1, columns))
    x = np.linspace(-1, 1, columns)[None, :] * np.ones((rows, 1))
    if series.kind in ("dark", "afterglow"):
        images[f"dark of {series.name}"] = np.full(signal.shape, scales.DARK_SD_DN)
        return result | projected(images)
    # without a voltage, or a calibrating flat of two frames, the noise of a beam is known only from its own series
    voltage = f"unknown kV ({series.current_mA}, {series.power_W})" if series.kV is None else f"{series.kV:g} kV"
    gain_sd = _UNKNOWN_GAIN_SD if series.kV is None or item.own_noise else scales.GAIN_OF_BEAM_SD
    beam = f"{voltage} " + "+".join(str(layer) for layer in series.filters)
    images[f"level of {beam}"] = scales.LEVEL_OF_BEAM_SD * signal
    images[f"level of {series.name}"] = scales.LEVEL_OF_SERIES_SD * signal
    images[f"tilt x of {series.name}"] = scales.TILT_SD * x * signal
    images[f"tilt y of {series.name}"] = scales.TILT_SD * y * signal
    result[f"gain of {beam}"] = of_scalars(lambda probe: gain_sd if probe.name.startswith("log_variance") else 0.0)

    def texture(lag: tuple[int, int]) -> NDArray[np.float64]:
        ending = f"({lag[0]},{lag[1]})"
        return of_scalars(
            lambda probe: (
                scales.TEXTURE_SD if probe.name.startswith("correlation") and probe.name.endswith(ending) else 0.0
            )
        )

    for lag in LAGS:
        # the calibrated spread is one number; what it leaves open is the same in all series, or in those of a kV
        result[f"texture {lag}"] = texture(lag)
        result[f"texture {lag} at {voltage}"] = scales.TEXTURE_OF_BEAM_SHARE * texture(lag)
    if series.kind == "object":
        dy, dx = gradient(signal)
        scene = series.scene
        place = f"{scene} at {series.source_object_mm or 0:g}"
        registered_px = CELL_SD_PX if sharp else scales.REGISTERED_SD_PX
        images[f"column of {place}"] = registered_px * dx
        images[f"row of {place}"] = registered_px * dy
        images[f"outline of {place}"] = scales.OUTLINE_SD_PX * np.asarray(np.hypot(dy, dx))
        row = np.linspace(-0.5, 0.5, rows)[:, None] * rows
        across = np.linspace(-0.5, 0.5, columns)[None, :] * columns
        images[f"magnification of {place}"] = scales.MAGNIFICATION_SD * (row * dy + across * dx)
        images[f"rotation of {place}"] = scales.MAGNIFICATION_SD * (across * dy - row * dx)
        profiles = projected(dict(_edge_profiles(dy, dx)))
        for label, column_of in profiles.items():
            result[f"edges, {label}, of {place}"] = column_of
            # the pixels that an edge cuts are not rendered quite alike for different beams
            result[f"edges, {label}, of {series.name}"] = scales.EDGE_OF_SERIES * column_of
            # nor quite truly anywhere, and not the same where a pixel is another size in the object
            result[f"edges, {label}"] = scales.EDGE_OF_ALL * column_of
            result[f"edges, {label}, at {series.source_object_mm or 0:g}"] = scales.EDGE_OF_ALL * column_of
        slope = np.hypot(dy, dx)
        for number, field in enumerate(_rough_fields(signal.shape, place)):
            images[f"rough edge {number} of {place}"] = slope * field
        for material, (moved, values) in thicker.items():
            # less light is less noise, too
            quieter = [
                values.get(probe.name, base_scalars[probe.name]) - base_scalars[probe.name] for probe in scalar_probes
            ]
            response = np.concatenate(
                [
                    projection.apply(moved),
                    [change / probe.sd for change, probe in zip(quieter, scalar_probes, strict=True)],
                ]
            )
            result[f"thickness of {material} in {scene}"] = response
            result[f"attenuation of {material}"] = response * (scales.ATTENUATION_SD / scales.THICKNESS_SD)
            result[f"attenuation of {material} at {voltage}"] = response * (
                scales.ATTENUATION_OF_BEAM_SD / scales.THICKNESS_SD
            )
    return result | projected(images)


def _of_gain_map(
    projection: MapProjection, signal: NDArray[np.float64], pixel_sd: float, scalars: int
) -> dict[str, NDArray[np.float64]]:
    """Smooth noise of the gain map by shape: what few calibrating frames leave of it is the same in every series.

    pixel_sd: relative, of one pixel's gain in sums over many pixels.
    """
    waves = _waves(signal.shape, _GAIN_MAP_MODES)  # the level has nuisances of its own
    amounts = [pixel_sd / math.sqrt(float(np.sum(wave**2))) * wave for wave in waves.values()]
    found = np.pad(projection.apply(np.stack(amounts) * signal), ((0, 0), (0, scalars)))
    return {f"gain map {i},{j}": column for (i, j), column in zip(waves, found, strict=True)}


def _edge_profiles(dy: NDArray[np.float64], dx: NDArray[np.float64]) -> list[tuple[str, NDArray[np.float64]]]:
    """Derivatives across edges of second to fourth order, times what rendering leaves open of each."""
    slope = np.hypot(dy, dx)
    (yy, _), (_, xx) = gradient(dy), gradient(dx)
    normal_y, normal_x = dy / np.maximum(slope, 1e-9), dx / np.maximum(slope, 1e-9)
    steeper_y, steeper_x = gradient(xx + yy)
    third = normal_y * steeper_y + normal_x * steeper_x
    fourth = gradient(steeper_y)[0] + gradient(steeper_x)[1]
    half = 0.5 * scales.EDGE_SD_PX2
    return [
        ("columns", half * xx),
        ("rows", half * yy),
        ("third order", scales.EDGE_SD_PX3 * third),
        ("fourth order", scales.EDGE_SD_PX4 * fourth),
    ]


@lru_cache(maxsize=2)
def _rough_fields(shape: tuple[int, ...], place: str) -> NDArray[np.float32]:
    """Fields (number, row, column) over the local slope, the same for every series of a place: rendering from pixel to pixel."""
    from zlib import crc32

    from scipy.ndimage import gaussian_filter

    # fixed fields, not draws: the same scene always has the same ones
    rng = np.random.default_rng(crc32(place.encode()))
    result = np.empty((scales.ROUGH_FIELDS, *shape), np.float32)
    for number in range(scales.ROUGH_FIELDS):
        field = gaussian_filter(rng.standard_normal(shape), (0.7, 2.0, 5.0)[number % 3])
        result[number] = scales.ROUGH_SHARE / math.sqrt(scales.ROUGH_FIELDS) / float(np.std(field)) * field
    return result


def _join(
    blocks: Sequence[dict[str, Any]],
    views: Sequence[SeriesView],
    kept: Sequence[SessionSeries],
    variants: Sequence[Variant],
    all_changes: Sequence[_Change],
    nuisance_changes: Sequence[TwinChange],
    skipped: Sequence[str],
    *,
    base: Twin,
    gain_shares: dict[str, float],
    dark_weights: dict[float, dict[str, float]],
    conditions: dict[str, float],
    respond: Callable[[Sequence[Variant]], dict[int, NDArray[np.float64]]],
) -> Problem:
    residual = np.concatenate([block["residual"] for block in blocks])
    sizes = [len(block["residual"]) for block in blocks]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    responses = np.concatenate([block["responses"] for block in blocks], axis=1)
    names = tuple(name for block in blocks for name in block["names"])
    series_of = np.repeat(np.arange(len(blocks)), sizes)
    factor_columns: dict[str, NDArray[np.float64]] = {}
    first_nuisance = sum(len(variant.strengths) for variant in variants)
    for offset, step in enumerate(nuisance_changes):
        if not all_changes[first_nuisance + offset].failed:
            factor_columns[step.name] = responses[first_nuisance + offset] / step.step_sd
    for number, block in enumerate(blocks):
        for name, column in block["local"].items():
            whole = factor_columns.setdefault(name, np.zeros(len(residual)))
            whole[starts[number] : starts[number + 1]] += column
    factors = {name: column for name, column in factor_columns.items() if float(np.max(np.abs(column))) > 1e-3}
    curves: list[Curve] = []
    chosen: list[Variant] = []
    missing: dict[str, str] = {}
    position = 0
    for variant in variants:
        rows = range(position, position + len(variant.strengths))
        position += len(variant.strengths)
        failed = next((all_changes[row].failed for row in rows if all_changes[row].failed), "")
        if failed:
            missing.setdefault(variant.effect, failed)
            continue
        block_responses = responses[list(rows)]
        spread = _spread(variant, blocks, starts, len(residual), rows[0], base.instrument.readout_ms)
        # a wandering output shifts levels by chance even where too few frames show its noise
        by_chance = variant.effect == "output_drift" and spread is not None and bool(np.any(spread))
        if not (by_chance or float(np.max(np.abs(block_responses))) > LEAST_RESPONSE):
            missing.setdefault(variant.effect, "nothing in this session responds to it")
            continue
        jitter = None
        if variant.effect == "gain_map_error":
            jitter = np.concatenate([block["pattern_jitter"] for block in blocks])
        exact = None
        if variant.effect in scales.DEFINED_BY:
            exact = np.array([name.statistic == scales.DEFINED_BY[variant.effect] for name in names])
        curves.append(variant.curve(block_responses, spread=spread, jitter=jitter, exact=exact))
        chosen.append(variant)
    for curve in curves:
        missing.pop(curve.effect, None)
    group_keys: dict[str, int] = {}
    groups = np.empty(len(residual), dtype=np.intp)
    part_keys: dict[str, int] = {}
    parts = np.empty(len(residual), dtype=np.intp)
    for index, name in enumerate(names):
        series = kept[int(series_of[index])].series
        group = f"{name.axis}, {series.kind} {series.scene} {series.kV if series.kind != 'dark' else ''}".strip()
        part = f"{name.axis} of {series.kind} {series.scene}".strip()
        groups[index] = group_keys.setdefault(group, len(group_keys))
        parts[index] = part_keys.setdefault(part, len(part_keys))
    block_keys: dict[tuple[str, float], int] = {}
    block_of = []
    for item in kept:
        place = (
            (item.series.scene, item.request.source_object_mm or 0.0)
            if item.series.kind == "object"
            else (f"series {item.name}", 0.0)
        )
        block_of.append(block_keys.setdefault(place, len(block_keys)))
    return Problem(
        residual=residual,
        factors=np.stack(list(factors.values()), axis=1) if factors else np.zeros((len(residual), 0)),
        factor_names=tuple(factors),
        curves=tuple(curves),
        variants=tuple(chosen),
        names=names,
        series_of=series_of,
        sd=np.concatenate([block["sd"] for block in blocks]),
        noise=np.concatenate([block["noise"] for block in blocks]),
        groups=groups,
        group_names=tuple(group_keys),
        parts=parts,
        part_names=tuple(part_keys),
        blocks=np.array([block_of[number] for number in series_of], dtype=np.intp),
        views=tuple(views),
        base=base,
        gain_shares=gain_shares,
        dark_weights=dark_weights,
        skipped=tuple(skipped),
        missing_effects=missing,
        conditions=conditions,
        respond=respond,
    )


def _spread(
    variant: Variant,
    blocks: Sequence[dict[str, Any]],
    starts: NDArray[np.intp],
    size: int,
    row: int,
    readout_ms: float | None,
) -> NDArray[np.float64] | None:
    """Random responses (probe, factor) a unit of strength.

    A drifting output moves each lit series' level and trend by chance; a dark's drift or a heel may be uneven over the panel;
    a part of a gain map's change is smooth; bits that are cut off lower every level.
    """
    if variant.effect in scales.UNEVEN:
        uneven = np.zeros((size, 2))
        for number, block in enumerate(blocks):
            if row in block["uneven"]:
                uneven[starts[number] : starts[number + 1]] = block["uneven"][row].T
        return uneven * (scales.UNEVEN_SHARE / variant.strengths[0])
    if variant.effect == "quantisation" and variant.since == "calibration":
        # lost bits may be cut off or rounded away: half a step between the two
        return np.concatenate([block["offset"] for block in blocks])[:, None] * scales.CUT_OFF_SHARE
    if variant.effect == "gain_map_error":
        return np.concatenate([block["pattern"] for block in blocks])
    if variant.effect != "output_drift":
        return None
    lit = [number for number, block in enumerate(blocks) if block["item"].series.kind in ("flat", "object")]
    if not lit:
        return None
    wanders = OutputCourse(variant.parameters["correlation_s"], variant.parameters["jitter_share"])
    columns = []
    means = wanders.means([blocks[number]["item"].request for number in lit], readout_ms)
    for shares in means.T:
        level = np.zeros(size)
        for number, share in zip(lit, shares, strict=True):
            block = blocks[number]
            column = block["local"][f"level of {block['item'].series.name}"]
            level[starts[number] : starts[number + 1]] = column * (0.01 * share / scales.LEVEL_OF_SERIES_SD)
        columns.append(level)
    for number in lit:
        block = blocks[number]
        request = block["item"].request
        profiles = dict(time_templates(request.frames))
        for index, name in enumerate(block["names"]):
            if name.statistic.startswith("trend"):
                along = wanders.along(profiles[name.statistic.removeprefix("trend ")], request, readout_ms)
                amount = 0.01 * along / math.sqrt(request.frames)
            elif name.statistic == "frame_factor":
                amount = 0.5
            else:
                continue
            column = np.zeros(size)
            column[starts[number] + index] = amount / block["sd"][index]
            columns.append(column)
    return np.stack(columns, axis=1)


def _thicker(
    thickness_mm: Mapping[str, NDArray[np.floating]], material: str, factor: float
) -> dict[str, NDArray[np.floating]]:
    """The scene with one material thicker by a factor."""
    return {name: (image * np.float32(factor) if name == material else image) for name, image in thickness_mm.items()}
