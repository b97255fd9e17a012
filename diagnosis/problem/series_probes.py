"""How one series is turned into standardised numbers: what its mean frame is projected on, and its scalar probes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...generator.effects import EFFECTS
from ...generator.line.rounding import variance_kept_by_means
from ..arrays import BoolArray, FloatArray, RealArray
from ..model import changes as scales
from ..model.calibrated_maps import CalibratedMaps
from ..model.changes import Variant
from ..model.forward_model import strength_rows
from ..model.placing import SHARP_SCENES, displacement_probes, inside
from ..model.point_maps import sampled_at_points
from ..model.responses import Moved, SeriesModel, SessionModel
from ..probes.fixed_pattern import count_outliers, pattern_statistics
from ..probes.frame_scalars import measured_scalars
from ..probes.map_probes import MapProjection, Template, edge_templates, smooth_templates, transmission_templates
from ..probes.probes import ProbeName, Scalar
from ..probes.registration import RENDER_SHARE, render_variance
from ..probes.straight_edge import covered_scene, distance_px, scatter_share
from ..probes.tile_seams import SeenSeams, seams_in
from ..session.even_maps import NEIGHBOURS_PX, Map, full_size, local_range, mean_over, near_steps, signal_map
from ..session.summaries import LEAST_NOISE_DN2, ROUNDED_SHARE, SeriesSummary


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanFrame:
    """A series' corrected mean frame against the model; maps (row, column)."""

    signal_DN: FloatArray  # expected
    residual_DN: FloatArray  # measured less expected
    mask: BoolArray  # pixels that are compared
    quantum_DN2: FloatArray  # variance, dark's and gain map's share included, correlated as quanta are
    white_DN2: FloatArray  # the same, white
    rendered: float  # share of the local range to which pixels that an edge cuts are drawn


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesProbes:
    """The probes of one series: projections of its mean frame, then scalars."""

    series: SeriesModel
    projection: MapProjection
    scalars: tuple[Scalar, ...]  # measured
    shrink: FloatArray  # (probe,): factor that gives unit noise again once noise of lines that is no effect is added
    rendered: float  # see `MeanFrame`

    def __len__(self) -> int:
        return len(self.shrink)

    @property
    def names(self) -> list[ProbeName]:
        """One name a probe."""
        scalars = (ProbeName(axis=one.axis, statistic=one.name, location="", unit=one.unit) for one in self.scalars)
        return [*self.projection.names, *scalars]

    @property
    def sd(self) -> FloatArray:
        """Standard deviation (probe,) of scalar probes in their unit; 1 for map probes."""
        return np.concatenate([np.ones(len(self.projection)), [probe.sd for probe in self.scalars]])

    @property
    def noise(self) -> FloatArray:
        """Counting noise's share (probe,) of each probe's standard deviation."""
        shares = [probe.sampling_sd / probe.sd for probe in self.scalars]
        return np.concatenate([np.ones(len(self.projection)), shares]) * self.shrink

    def residual(self, residual_DN: FloatArray) -> FloatArray:
        """Measured less expected (probe,), standardised; residual_DN: of the mean frame (row, column)."""
        expected = self.series.scalars
        scalars = np.array([(probe.value - expected[probe.name]) / probe.sd for probe in self.scalars])
        return np.concatenate([self.projection.apply(residual_DN), scalars]) * self.shrink

    def responses(self, moved: Sequence[Moved | None]) -> FloatArray:
        """Responses (change, probe), standardised, to changes of mean frame and scalars; 0 where one cannot be asked."""
        result = np.zeros((len(moved), len(self)))
        known = {number: found for number, found in enumerate(moved) if found is not None}
        if known:
            expected = self.series.scalars
            maps = self.projection.apply_each([image for image, _ in known.values()])
            scalars = [
                [(values.get(one.name, expected[one.name]) - expected[one.name]) / one.sd for one in self.scalars]
                for _, values in known.values()
            ]
            result[list(known)] = np.concatenate([maps, scalars], axis=1) * self.shrink
        return result

    def of_maps(self, images_DN: RealArray) -> FloatArray:
        """Responses (image, probe), not shrunk, to changes of the mean frame alone (image, row, column)."""
        return self.without_scalars(self.projection.apply(images_DN))

    def without_scalars(self, projected: FloatArray) -> FloatArray:
        """Responses (image, probe) of which the map probes' are given (image, map probe) and the scalars' are 0."""
        return np.pad(projected, ((0, 0), (0, len(self.scalars))))

    def of_scalars(self, change: Callable[[Scalar], float]) -> FloatArray:
        """Response (probe,), not shrunk, to changes of the scalars alone, each in its unit."""
        return np.concatenate([np.zeros(len(self.projection)), [change(probe) / probe.sd for probe in self.scalars]])


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredSession:
    """What the frames of a session show, and what the base twin expects of them."""

    expected: SessionModel
    pictures: Mapping[str, FloatArray]  # (row, column): corrected mean frames, DN, by name of series
    summaries: Mapping[str, SeriesSummary]  # of the frames' noise, by name
    memory: Mapping[str, tuple[float, int] | None]  # of outlying pixels in darks, see `memory_of`, by name
    copies: Mapping[str, int]  # of frames, by name of the series that counts them
    clean: BoolArray  # (row, column): pixels in use that do not stand out
    lasting: BoolArray  # (row, column): pixels whose level lasts in a later dark
    outliers: int  # how many others stand out in any series
    skipped: tuple[str, ...]  # what could not be used and why

    def seams(self) -> SeenSeams | None:
        """Where flats that came after calibration show that tiles meet; None: there is none."""
        changes, weights = [], []
        for one in self.expected.series:
            if one.session.series.kind == "flat" and not one.session.calibrates:
                signal = signal_map(one.expected, self.clean.shape)
                changes.append(self.pictures[one.name] / signal - 1.0)
                variance = mean_over(one.expected.quantum_variance_DN2 + one.expected.white_variance_DN2, self.clean)
                weights.append(self.summaries[one.name].frames * mean_over(signal, self.clean) ** 2 / variance)
        return seams_in(changes, weights, self.clean)


def mean_frame(
    one: SeriesModel, corrected_DN: FloatArray, maps: CalibratedMaps, *, frames: int, side: int
) -> MeanFrame:
    """A series' corrected mean frame (row, column) against the model.

    frames: whose mean it is, copies left out; side: of the squares of the panel's pixels that stand for pixels.
    """
    clean, expected = one.context.good, one.expected
    shape = clean.shape
    signal = signal_map(expected, shape)
    mask = clean if one.placement is None else inside(clean, one.placement)
    quantum = full_size(expected.quantum_variance_DN2, shape)
    white = full_size(expected.white_variance_DN2, shape)
    if one.session.request.beam_on and float(white.min()) <= LEAST_NOISE_DN2:
        came = variance_of_what_came(quantum + white, signal, corrected_DN)
        quantum = np.maximum(quantum, came - white)
    white = np.maximum(white, LEAST_NOISE_DN2)
    # each exposure is rounded before frames are averaged
    of_one, step = one.session.request.exposures_per_frame * (quantum + white), expected.quantisation_step_DN
    kept = variance_kept_by_means(of_one, step) if step > 0.0 else 0.0
    quantum = quantum / frames + signal**2 * maps.gain_quantum
    white = white / frames + kept + signal**2 * maps.gain_white + maps.dark_noise(one.session, signal)
    rendered = RENDER_SHARE
    if one.session.series.kind == "object":
        rendered = _rendered(one, corrected_DN - signal, signal, mask)
        white = white + render_variance(signal, side=side, cut=rendered)
        if one.session.request.scene_kind not in SHARP_SCENES:
            # steps of wedges and outlines of products are rendered no better than their maps' pixels
            mask = mask & ~near_steps(signal)
    return MeanFrame(
        signal_DN=signal,
        residual_DN=corrected_DN - signal,
        mask=mask,
        quantum_DN2=quantum,
        white_DN2=white,
        rendered=rendered,
    )


def _rendered(one: SeriesModel, residual_DN: FloatArray, signal_DN: FloatArray, mask: BoolArray) -> float:
    """Share of the local range to which pixels at edges are drawn: of a straight edge as it is seen, of others as assumed."""
    request = one.session.request
    if request.scene_kind != "edge" or request.thickness_mm is None:
        return RENDER_SHARE
    away = distance_px(request.thickness_mm)
    if away is None:
        return RENDER_SHARE
    return min(RENDER_SHARE, scatter_share(residual_DN, local_range(signal_DN), mask, away))


def variance_of_what_came(variance_DN2: FloatArray, signal_DN: FloatArray, corrected_DN: FloatArray) -> FloatArray:
    """Variance (row, column), DN^2, that the light which is there gives a frame, by the mean ratio of variance to signal.

    Without noise of the detector's own, a deep shadow has none by the model, and light that strays there the evidence of thousands.
    """
    from scipy.ndimage import uniform_filter

    seen = uniform_filter(np.asarray(corrected_DN, dtype=np.float64), NEIGHBOURS_PX)
    return np.asarray(seen * float(variance_DN2.sum()) / max(float(signal_DN.sum()), 1e-9))


def series_probes(
    measured: MeasuredSession,
    one: SeriesModel,
    frame: MeanFrame,
    *,
    moved: Sequence[Moved | None],
    variants: Sequence[Variant],
) -> SeriesProbes:
    """The probes of one series; moved: what changes do to it, those of variants' strengths first.

    Its mean frame is projected on what the first strength of each variant does.
    """
    session, summary = measured.expected, measured.summaries[one.name]
    first = [(variant, moved[rows.start]) for variant, rows in zip(variants, strength_rows(variants), strict=True)]
    projection = MapProjection(
        _templates(session, one, frame, [(variant, found[0]) for variant, found in first if found is not None]),
        # where numbers stand still the mean jumps from code to code with the level
        mask=frame.mask & ~_standing_still(summary) if one.context.rounded else frame.mask,
        quantum_DN2=frame.quantum_DN2,
        white_DN2=frame.white_DN2,
        autocovariance_table=one.expected.noise_autocovariance,
    )
    kind, good, clean = one.session.series.kind, session.maps.good, one.context.good
    pattern, outliers = None, None
    if kind in ("flat", "dark") and not (one.session.calibrates or one.context.rounded):
        lit = frame.signal_DN if kind == "flat" else None
        pattern = pattern_statistics(frame.residual_DN, lit, clean=clean, good=good)
        noise, least_DN = frame.quantum_DN2 + frame.white_DN2, None if lit is None else scales.DUST_LIMIT * lit
        outliers = count_outliers(
            frame.residual_DN, noise, float(pattern[0]), clean=clean, good=good & ~measured.lasting, least_DN=least_DN
        )
    scalars = measured_scalars(
        summary,
        one.expected,
        one.context,
        dark_mean_DN=float(np.mean(session.maps.darks.under(one.session)[clean])),
        pattern=pattern,
        outliers=outliers,
        all_outliers=measured.outliers,
        memory=measured.memory.get(one.name),
        copies=measured.copies.get(one.name, 0),
        lasting=int(np.count_nonzero(measured.lasting)),
    )
    scalars = [probe for probe in scalars if probe.name in one.scalars]
    if one.placement is not None and one.tells_displacement:
        request = one.session.request
        maps = request.thickness_mm or {}
        # a slanted or round border meets the pixels everywhere, so that where it lies between them averages out
        between = sampled_at_points(maps) and covered_scene(request.scene_kind, maps) is None
        scalars += displacement_probes(one.placement, between_points=between)
    # noise of lines that is no effect stands in the mean frame as well
    beyond = np.asarray(session.usual_lines(one.session)) @ projection.line_noise()
    return SeriesProbes(
        series=one,
        projection=projection,
        scalars=tuple(scalars),
        shrink=np.concatenate([1.0 / np.sqrt(1.0 + beyond), np.ones(len(scalars))]),
        rendered=frame.rendered,
    )


def _standing_still(summary: SeriesSummary) -> BoolArray:
    """Pixels (row, column) whose noise hardly reaches over a step of the ADC, by what their neighbours do as well."""
    from scipy.ndimage import uniform_filter

    return np.asarray(uniform_filter(summary.unchanged_share, NEIGHBOURS_PX) > ROUNDED_SHARE)


def _templates(
    session: SessionModel, one: SeriesModel, frame: MeanFrame, likenesses: Sequence[tuple[Variant, Map]]
) -> list[Template]:
    """What a mean frame is projected on, the plain shapes first; likenesses: what effects do to it."""
    kind, signal = one.session.series.kind, frame.signal_DN
    templates = smooth_templates(signal, frame.mask, kind=kind)
    if kind == "object":
        open_map = np.full(signal.shape, float(np.max(signal)))
        templates += transmission_templates(signal, open_map, frame.mask)
        templates += edge_templates(signal)
    before = [other for other in session.series if other.session.series.index < one.session.series.index]
    lit = [other for other in before if other.session.request.beam_on]
    if kind == "afterglow" and lit:
        ghost = signal_map(lit[-1].expected, signal.shape)
        templates.append(Template(axis="time", name=f"ghost of {lit[-1].name}", unit="1", image=ghost))
    templates += [
        Template(
            axis=EFFECTS[variant.effect].shows.axis,
            name=f"like {variant.effect} {variant.name}".strip(),
            unit="1",
            image=image,
        )
        for variant, image in likenesses
        if image.shape == signal.shape
    ]
    return templates
