"""What changes of the forward model do to a session's corrected mean frames and scalar probes, calibration taking in its part."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...errors import InputError
from ...generator.frames.line_model import ExpectedSeries
from ...generator.line.series_request import SeriesRequest
from ..arrays import BoolArray, FloatArray, RealArray
from ..probes.fixed_pattern import OUTLIER_SD, Pattern, pattern_noise, pattern_of
from ..probes.line_scalars import line_pattern
from ..probes.model_scalars import expected_scalars, with_pattern
from ..probes.probes import ALONG_COLUMNS, ALONG_ROWS, FIXED
from ..probes.registration import Placement
from ..probes.scalar_context import ScalarContext
from ..session.even_maps import NOWHERE, Map, compact, mean_over
from ..session.session import SessionSeries
from ..session.summaries import CODES_FRAMES, LEAST_NOISE_DN2, SeriesSummary, rounded_away
from ..session.usable import SeenSeries, counted_copies
from .calibrated_maps import LEAST_GAIN, CalibratedMaps, exposure_of
from .changes import DUST_LIMIT, Change
from .defects import counting_series
from .forward_model import ForwardModel
from .placing import PlacedSeries

Lines = dict[str, Pattern]  # what lines of one frame have in common, DN^2, of each calibrating series
Moved = tuple[
    Map, Mapping[str, float]
]  # change of a corrected mean frame, DN, and the scalar probes under the change, by name
Known = dict[object, tuple[ExpectedSeries, Map, dict[str, float]]]
_NO_DISPLACEMENT = dict.fromkeys((ALONG_ROWS, ALONG_COLUMNS), 0.0)
_WHOLE_LINES = 0.98  # share of the pixels in use that a series must show for noise of rows and columns
_CODES_SHARE = 0.02  # range of codes to the pixels of the frames looked at, at most, in which all codes occur


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesModel:
    """One series as the base twin expects it."""

    session: SessionSeries
    expected: ExpectedSeries
    context: ScalarContext  # of its scalar probes
    scalars_alone: dict[str, float]  # by name, without what line noise leaves in dark and gain map
    scalars: dict[str, float]  # by name, with that
    placement: Placement | None  # of its scene; None: not found
    place: SeriesRequest | None  # the series that tells the displacement there; None: not found

    @property
    def tells_displacement(self) -> bool:
        """Its scene's displacement is among its probes."""
        return self.place is self.session.request

    @property
    def name(self) -> str:
        """The series' name."""
        return self.session.name


@dataclass(frozen=True, slots=True, kw_only=True)
class Absorbed:
    """What calibration takes in of a change."""

    # (row, column or 1, 1): of each calibrating mean frame, by name
    mean_DN: dict[str, Map] = field(default_factory=dict)
    scalars: dict[str, dict[str, float]] = field(default_factory=dict)  # of these series under the change
    dark_DN: dict[float, Map] = field(default_factory=dict)  # by exposure, ms
    gain: Map = field(default_factory=lambda: NOWHERE)  # relative
    lines: Lines = field(default_factory=dict)  # under the change

    @property
    def divides(self) -> Map:
        """What the gain map divides later frames by (row, column or 1, 1), over what it did before."""
        return np.asarray(np.maximum(1.0 + self.gain, LEAST_GAIN), dtype=np.float32)


@dataclass(slots=True, kw_only=True)
class Asked:
    """A change that a session is asked with, and what calibration took in of it; `failed` says why it cannot be asked."""

    change: Change
    absorbed: Absorbed
    failed: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionModel:
    """A session's series under changes of the forward model."""

    model: ForwardModel
    maps: CalibratedMaps  # of the calibrating series
    series: tuple[SeriesModel, ...]  # in order of time
    signals_DN: Mapping[str, float]  # mean expected over pixels that do not stand out, by name
    lines_DN2: tuple[float, float]  # variance of rows and of columns from exposure to exposure, DN^2, that is no effect

    def usual_lines(self, item: SessionSeries) -> tuple[float, float]:
        """Variance of rows and columns, DN^2, that a series' corrected mean frame has from noise of lines which is no effect."""
        shares = 1.0 / (item.request.frames * item.request.exposures_per_frame)
        if not item.calibrates:
            weights = self.maps.darks.weights_under(item)
            shares += sum(weight**2 / self.maps.darks.frames[name] for name, weight in weights.items())
        return self.lines_DN2[0] * shares, self.lines_DN2[1] * shares

    @property
    def unchanged(self) -> Asked:
        """The base twin itself."""
        return Asked(change=self.model.unchanged, absorbed=Absorbed())

    def ask(self, change: Change, *, refused: str = "") -> Asked:
        """A change with what it does to the calibrating series; refused: why it is not to be asked."""
        if refused:
            return Asked(change=change, absorbed=Absorbed(), failed=refused)
        try:
            return Asked(change=change, absorbed=self._absorbed(change))
        except InputError as error:
            return Asked(change=change, absorbed=Absorbed(), failed=str(error))

    def _absorbed(self, change: Change) -> Absorbed:
        """What a change does to the calibrating series, and through them to darks and gain map."""
        mean_DN: dict[str, Map] = {}
        scalars: dict[str, dict[str, float]] = {}
        lines: Lines = {}
        calibrating = [one for one in self.series if one.session.calibrates]
        for one in calibrating:
            model = self.model.expect_changed(one.session.request, change, one.expected)
            lines[one.name] = _lines_of_noise(model)
            if model is one.expected:
                mean_DN[one.name], scalars[one.name] = NOWHERE, one.scalars
            else:
                mean_DN[one.name] = self._moved_alone(one, model)
                scalars[one.name] = expected_scalars(model, one.context)
        dark_DN = {
            exposure: sum((np.float32(weight) * mean_DN[name] for name, weight in weights.items()), NOWHERE)
            for exposure, weights in self.maps.darks.weights.items()
        }
        gain = NOWHERE
        for one in calibrating:
            if one.session.series.kind == "flat":
                signal = np.maximum(np.asarray(one.expected.signal_DN, dtype=np.float32), 1e-6)
                lit = mean_DN[one.name] - dark_DN[exposure_of(one.session)]
                gain = gain + np.float32(self.maps.shares[one.name]) * (lit / compact(signal, 1.0))
        return Absorbed(mean_DN=mean_DN, scalars=scalars, dark_DN=dark_DN, gain=gain, lines=lines)

    def _moved_alone(self, one: SeriesModel, changed: ExpectedSeries) -> Map:
        """Change of a series' mean frame before dark and gain map, DN."""
        scale = max(self.signals_DN[one.name], 1.0)
        return compact(np.asarray(changed.mean_DN) - np.asarray(one.expected.mean_DN), scale)

    def moved(self, one: SeriesModel, asked: Sequence[Asked]) -> list[Moved | None]:
        """What each change does to the corrected mean frame of a series, DN, and its scalar probes; None: it cannot be asked."""
        known: Known = {}
        return [self._moved(one, item, known) for item in asked]

    def _moved(self, one: SeriesModel, asked: Asked, known: Known) -> Moved | None:
        """The same of one change; known: what others do to the series' frames, by what they are whenever they began."""
        if asked.failed:
            return None
        item, change, absorbed = one.session, asked.change, asked.absorbed
        dark_shift = absorbed.dark_DN.get(exposure_of(item), NOWHERE)
        moved: Map
        values: Mapping[str, float]
        if item.calibrates:
            moved, values = absorbed.mean_DN[one.name], absorbed.scalars[one.name]
        else:
            try:
                changed, moved, values = self._alone(one, change, known)
            except InputError as error:
                asked.failed = str(error)
                return None
            if item.series.kind == "afterglow" and bool(np.any(dark_shift)):
                values = expected_scalars(changed, one.context, dark_change_DN=-dark_shift)
        moved = moved - dark_shift
        if one.placement is not None and change.only_displaces:
            moved = NOWHERE
        if item.request.beam_on and bool(np.any(absorbed.gain)):
            signal = np.asarray(one.expected.signal_DN, dtype=np.float32)
            moved = np.asarray((moved - signal * absorbed.gain) / absorbed.divides, dtype=np.float32)
        if not item.calibrates:
            values = self.with_patterns(one, values, absorbed.lines, moved)
        if one.tells_displacement:
            values = {**values, **self._displacement(change, item.request)}
        return np.asarray(moved, dtype=np.float32), values

    def with_patterns(
        self, one: SeriesModel, values: Mapping[str, float], lines: Lines, moved: Map
    ) -> Mapping[str, float]:
        """Scalars with what lines of calibrating series leave in dark and gain map, and a moved picture in pixels and lines.

        values: scalar probes without that, by name; moved: change of the corrected mean frame (row, column or 1, 1), DN.
        """
        if FIXED not in values:
            return values
        weights = self.maps.darks.weights_under(one.session)
        standing = pattern_of(moved)
        for name, weight in weights.items():
            standing += weight**2 / self.maps.darks.frames[name] * lines[name]
        for name, share in self.maps.shares.items():
            there = share * self.signals_DN[one.name] / max(self.signals_DN[name], 1e-9)
            standing += there**2 / self.maps.darks.frames[name] * lines[name]
        return with_pattern(values, standing, one.context.pattern_noise)

    def _found(self, one: SeriesModel, change: Change) -> tuple[Change, SeriesRequest]:
        """A change as a series shows it, and the series as it is asked, once registration has found where the scene lies."""
        request = one.session.request
        if one.place is None:
            return change, request
        carried, lies = self.model.carried_px(change, one.place), request.displacement_px
        if carried != (0.0, 0.0):
            request = replace(request, displacement_px=(lies[0] - carried[0], lies[1] - carried[1]))
        return change.found_in_place(), request

    def _displacement(self, change: Change, request: SeriesRequest) -> dict[str, float]:
        """Where registration finds a scene under a change, px, by probe."""
        carried = dict(zip((ALONG_ROWS, ALONG_COLUMNS), self.model.carried_px(change, request), strict=True))
        return {name: away + change.displacement.get(name, 0.0) for name, away in carried.items()}

    def under(self, one: SeriesModel, asked: Asked) -> SeriesModel:
        """One series under a change that can show there, less what line noise leaves in maps; raises as `ForwardModel.under`."""
        expected = self.model.under(*self._found(one, asked.change))
        return replace(one, expected=expected, scalars={**one.scalars, **expected_scalars(expected, one.context)})

    def with_scene(self, one: SeriesModel, thickness_mm: Mapping[str, RealArray], asked: Asked) -> Moved:
        """What another scene would show in a series (`under` the change that is asked), less what its own shows there."""
        change, request = self._found(one, asked.change)
        changed = self.model.under(change, replace(request, thickness_mm=thickness_mm))
        moved = np.asarray(np.asarray(changed.mean_DN) - np.asarray(one.expected.mean_DN), dtype=np.float32)
        return moved / asked.absorbed.divides, expected_scalars(changed, one.context)

    def from_beyond(self, one: SeriesModel, change: Change) -> FloatArray:
        """What the surroundings would let into the picture of a series (row, column), DN, see `LineModel.from_beyond`."""
        return self.model.from_beyond(*self._found(one, change))

    def _alone(self, one: SeriesModel, change: Change, known: Known) -> tuple[ExpectedSeries, Map, Mapping[str, float]]:
        """A series under a change, its mean frame's change (DN) and its scalar probes, dark and gain map left as they were."""
        shown, request = self._found(one, change)
        own = shown.whenever_it_began(request)
        if own in known:
            return known[own]
        changed = self.model.expect_changed(request, shown, one.expected)
        if changed is one.expected:
            found = changed, NOWHERE, one.scalars_alone
        else:
            found = changed, self._moved_alone(one, changed), expected_scalars(changed, one.context)
        if own is not None:
            known[own] = found
        return found


def session_model(
    model: ForwardModel,
    maps: CalibratedMaps,
    placed: PlacedSeries,
    summaries: Mapping[str, SeriesSummary],
    clean: BoolArray,
    *,
    lines_DN2: tuple[float, float],
) -> SessionModel:
    """The session's series as the base twin expects them, with what their scalar probes refer to.

    summaries: by name of series; clean: pixels in use that do not stand out (row, column); lines_DN2: as in `SessionModel`.
    """
    seen = placed.seen
    signals_DN = {one.name: mean_over(one.expected.signal_DN, clean) for one in seen}
    session = SessionModel(model=model, maps=maps, series=(), signals_DN=signals_DN, lines_DN2=lines_DN2)
    lines = {one.name: _lines_of_noise(one.expected) for one in seen if one.session.calibrates}
    counting, copies = counting_series([one.session for one in seen]), counted_copies(seen)
    counts = bool(model.base.instrument.counting)
    # in numbers that stand still no pixel's level is followed
    darks = [
        one.session
        for one in seen
        if one.session.series.kind == "dark"
        and not one.session.calibrates
        and (counts or not rounded_away(summaries[one.name], clean))
    ]
    series = []
    before: float | None = None
    for shown in seen:
        item, expected = shown.session, shown.expected
        context = _context(
            shown,
            maps,
            clean,
            signal_DN=signals_DN[item.name],
            previous_DN=before,
            summary=summaries[item.name],
            counting=counts,
            counts_all=item.name == counting,
            repeatable=copies[item.name][1] if item.name in copies else 0,
            later_darks=tuple(
                (other.series.n_frames, other.request.exposures_per_frame)
                for other in sorted(darks, key=lambda other: other.name != item.name)
            )
            if item.name == counting or item.series.kind in ("dark", "flat")
            else (),
        )
        alone = expected_scalars(expected, context)
        one = SeriesModel(
            session=item,
            expected=expected,
            context=context,
            scalars_alone=alone,
            scalars=alone,
            placement=placed.placements.get(item.name),
            place=placed.telling.get(item.name),
        )
        displaced = _NO_DISPLACEMENT if one.tells_displacement else {}
        series.append(replace(one, scalars={**session.with_patterns(one, alone, lines, NOWHERE), **displaced}))
        if item.request.beam_on:
            before = signals_DN[item.name]
    return replace(session, series=tuple(series))


def _context(
    shown: SeenSeries,
    maps: CalibratedMaps,
    clean: BoolArray,
    *,
    signal_DN: float,
    previous_DN: float | None,
    summary: SeriesSummary,
    counting: bool,
    counts_all: bool,
    repeatable: int,
    later_darks: tuple[tuple[int, int], ...],
) -> ScalarContext:
    """What a series' scalar probes refer to; previous_DN: signal of the last lit series before it; others as its fields."""
    item, expected = shown.session, shown.expected
    in_use, clean = int(clean.sum()), clean & shown.readable
    kind, frames, lit = item.series.kind, item.series.n_frames, item.request.beam_on
    lit_DN = np.asarray(signal_DN if lit else 0.0)
    squared = float(lit_DN) ** 2
    noise_of_maps = maps.gain_quantum * squared, maps.gain_white * squared + float(maps.dark_noise(item, lit_DN))
    noise = pattern_noise(
        expected, clean, shown.look.frames, *noise_of_maps, lines=kind == "flat" and bool(maps.shares)
    )
    read_DN2 = mean_over(expected.white_variance_DN2, clean) if maps.read_DN2 is None else maps.read_DN2
    stands_out_DN = max(OUTLIER_SD * math.sqrt(noise[0]), DUST_LIMIT * max(signal_DN, 0.0))
    return ScalarContext(
        kind=kind,
        frames=frames,
        good=clean,
        labels=np.where(clean, shown.labels, -1),
        label_names=shown.label_names,
        reference_signal_DN=max(signal_DN, 1e-9) if lit else 1.0,
        previous_signal_DN=previous_DN,
        calibrates=item.calibrates,
        codes_usable=kind in ("dark", "flat")
        and 0 < summary.code_range < _CODES_SHARE * clean.sum() * min(frames, CODES_FRAMES),
        # a counter's numbers are its quanta
        rounded=not counting and rounded_away(summary, clean),
        pattern_noise=noise,
        quantum_DN2=mean_over(expected.quantum_variance_DN2, clean),
        dark_DN=mean_over(expected.dark_DN, clean),
        counts_all_outliers=counts_all,
        repeatable=repeatable,
        later_darks=later_darks,
        stands_out_reads=stands_out_DN / math.sqrt(max(read_DN2, LEAST_NOISE_DN2)),
        gain=maps.gain if lit and "gain" not in item.series.corrected else None,
        averaged=item.request.exposures_per_frame,
        whole_lines=int(clean.sum()) > _WHOLE_LINES * in_use,
    )


def _lines_of_noise(model: ExpectedSeries) -> Pattern:
    """What lines of one frame have in common, DN^2."""
    return line_pattern(model, float(np.mean(model.signal_DN)) ** 2)
