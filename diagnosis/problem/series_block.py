"""One series in numbers: its standardised residual, and what nuisances, changes and chance do to it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...generator.effects import EFFECTS
from ...generator.frames.line_model import ExpectedSeries
from ...generator.line.line_state import FixedPattern, TilePattern, between_lines
from ..arrays import BoolArray, FloatArray, RealArray
from ..model import changes as scales
from ..model.changes import Variant
from ..model.curves import places_of
from ..model.responses import Asked, Moved
from ..probes.scalar_context import time_templates
from ..session.even_maps import Map
from ..session.session import SessionSeries
from ..session.summaries import SeriesSummary
from .nuisance_columns import (
    Columns,
    brighter,
    changed_gain_pattern,
    changed_tiles,
    noise_of_lines,
    offset_of_later,
    uneven,
)
from .other_scenes import OtherScenes
from .output_course import OutputCourse
from .series_probes import MeanFrame, SeriesProbes

# of the smooth shapes in which an effect is uneven, by what is random about it
UNEVEN_ORDER = {"sides": 1, "places": scales.SHAPE_ORDER}


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesView:
    """One series with what pictures of the gap need: measured and expected signal (row, column), and the mean's noise."""

    session: SessionSeries
    summary: SeriesSummary
    expected: ExpectedSeries
    signal_DN: Map
    residual_DN: Map
    noise_DN: Map
    mask: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesBlock:
    """The part of a problem that one series makes; its probes are standardised."""

    view: SeriesView
    probes: SeriesProbes
    signal_DN: RealArray  # (row, column): expected, corrected
    scenes: OtherScenes  # what may stand in its scene's place
    residual: FloatArray  # (probe,)
    nuisances: Columns  # (probe,), by name
    responses: FloatArray  # (change, probe), 0 where a change cannot be asked
    offset: FloatArray  # (probe,): of one DN more in every pixel
    brighter: FloatArray  # (probe,): of 1 % more light
    pattern: FloatArray  # (probe, wave): what 1 % of a changed gain map does by chance, its smooth part
    pattern_jitter: dict[FixedPattern, FloatArray]  # (probe,): variance of the rest, by what that is
    lines: FloatArray  # (2, probe): variance of what 1 DN of noise common to rows (to columns) does
    lit_lines: FloatArray  # (2, probe): the same of 1 % of the light
    uneven: dict[int, FloatArray]  # (shape, probe), by number of change: more of it in one part of the panel
    tiles: dict[int, FloatArray]  # (probe, tile), alike: what 1 % of changed gains of its tiles does by chance

    def __len__(self) -> int:
        return len(self.residual)

    @property
    def session(self) -> SessionSeries:
        """The series."""
        return self.view.session


def series_block(
    probes: SeriesProbes,
    frame: MeanFrame,
    *,
    summary: SeriesSummary,
    scenes: OtherScenes,
    asked: Sequence[Asked],
    moved: Sequence[Moved | None],
    nuisances: Columns,
) -> SeriesBlock:
    """One series in numbers; moved: what each change that was asked does to it; nuisances: responses (probe,) by name."""
    signal, shrink = frame.signal_DN, probes.shrink
    # what is random of a change; nothing of a nuisance
    labels = [item.change.label for item in asked]
    random = [EFFECTS[label].variation.random if label in EFFECTS else "" for label in labels]
    patterns = dict.fromkeys(_pattern_of(_values_of(asked[at])) for at, kind in enumerate(random) if kind == "pixels")
    pattern, jitter = changed_gain_pattern(probes, signal, patterns)
    by_place: dict[int, FloatArray] = {}
    for kind, order in UNEVEN_ORDER.items():
        images = {at: found[0] for at, found in enumerate(moved) if found is not None and random[at] == kind}
        by_place |= uneven(probes, images, signal.shape, order=order)
    tiles = {
        number: changed_tiles(probes, signal, TilePattern.of(_values_of(item), rms=0.01)) * shrink[:, None]
        for number, item in enumerate(asked)
        if random[number] == "tiles" and not item.failed
    }
    lines, context = noise_of_lines(probes) * shrink**2, probes.series.context
    return SeriesBlock(
        view=SeriesView(
            session=probes.series.session,
            summary=summary,
            expected=probes.series.expected,
            signal_DN=np.asarray(signal, np.float32),
            residual_DN=np.asarray(frame.residual_DN, np.float32),
            noise_DN=np.sqrt(frame.quantum_DN2 + frame.white_DN2).astype(np.float32),
            mask=frame.mask,
        ),
        probes=probes,
        signal_DN=signal,
        scenes=scenes,
        residual=probes.residual(frame.residual_DN),
        nuisances=nuisances,
        responses=probes.responses(moved),
        offset=offset_of_later(probes) * shrink,
        brighter=brighter(probes, signal) * shrink,
        pattern=pattern * shrink[:, None],
        pattern_jitter={one: variance * shrink**2 for one, variance in jitter.items()},
        lines=lines,
        lit_lines=lines * (0.01 * context.reference_signal_DN if context.kind in ("flat", "object") else 0.0) ** 2,
        uneven={number: columns * shrink for number, columns in by_place.items()},
        tiles=tiles,
    )


def _pattern_of(values: Mapping[str, float]) -> FixedPattern:
    """The pattern from pixel to pixel, or from column to column, of parameters of a change."""
    return FixedPattern(rms=1.0, seed=0, correlation_px=values["correlation_px"], of_columns=values["of_columns"] > 0.5)


def _values_of(asked: Asked) -> dict[str, float]:
    """All parameters of the one effect that a change has."""
    (effect,) = asked.change.effects
    return dict(EFFECTS[effect.id].values(effect.parameters))


def by_chance(variant: Variant, blocks: Sequence[SeriesBlock], row: int, readout_ms: float | None) -> FloatArray | None:
    """Random responses (probe, factor) a unit of strength; None: the effect does nothing by chance.

    A drifting output moves each lit series' level and trend by chance; a dark's drift or a heel may be uneven over the panel;
    a part of a gain map's change is smooth; bits that are cut off lower every level. row: number of the variant's first change.
    """
    random = EFFECTS[variant.effect].variation.random
    if random in UNEVEN_ORDER:
        shapes = next((len(block.uneven[row]) for block in blocks if row in block.uneven), 0)
        found = np.zeros((sum(map(len, blocks)), shapes))
        for block, place in zip(blocks, places_of(blocks), strict=True):
            if row in block.uneven:
                found[place] = block.uneven[row].T
        return found * (scales.UNEVEN_SHARE / variant.strengths[0])
    if random == "offset" and variant.since == "calibration":
        # lost bits may be cut off or rounded away: half a step between the two
        return np.concatenate([block.offset for block in blocks])[:, None] * scales.CUT_OFF_SHARE
    if random == "pixels":
        return np.concatenate([block.pattern for block in blocks])
    if random == "tiles":
        return np.concatenate([block.tiles[row] for block in blocks])
    return _of_output(variant, blocks, readout_ms) if random == "output" else None


def jitter_of(variant: Variant, blocks: Sequence[SeriesBlock], read_noise_DN: float) -> FloatArray | None:
    """Variance (probe,) a unit of strength squared that an effect gives each probe by itself; None: none.

    A gain map changes from pixel to pixel or from column to column; lines of a few frames differ by chance in their means.
    """
    random = EFFECTS[variant.effect].variation.random
    if random == "pixels":
        pattern = _pattern_of(EFFECTS[variant.effect].values(variant.parameters))
        return np.concatenate([block.pattern_jitter[pattern] for block in blocks])
    if random not in ("lines", "lines of light"):
        return None
    numbers, every = EFFECTS[variant.effect].values(variant.parameters), variant.since == "always"
    # in smooth shapes, of which most probes are, lines that go together count as fewer
    next_to = between_lines(1, numbers["together_lines"])
    columns = numbers["column_share"]
    shares = (1.0 + next_to) / (1.0 - next_to) * np.array([1.0 - columns, columns])
    of_lines = [block.lit_lines if random == "lines of light" else read_noise_DN**2 * block.lines for block in blocks]
    return np.concatenate(
        [
            shares @ lines * float(every or not block.session.calibrates)
            for lines, block in zip(of_lines, blocks, strict=True)
        ]
    )


def _of_output(variant: Variant, blocks: Sequence[SeriesBlock], readout_ms: float | None) -> FloatArray | None:
    """What a wandering output does by chance (probe, factor): levels of lit series together, trend and common factor of each."""
    size = sum(map(len, blocks))
    lit = [
        (block, place)
        for block, place in zip(blocks, places_of(blocks), strict=True)
        if block.session.request.beam_on and (variant.since == "always" or not block.session.calibrates)
    ]
    if not lit:
        return None
    own = variant.parameters
    wanders = OutputCourse(own["correlation_s"], own["jitter_share"], own.get("idle_s", 0.0))
    means = wanders.means([block.session.request for block, _ in lit], readout_ms)
    single = []  # (probe, what it does by itself)
    levels = np.zeros((size, means.shape[1]))
    for (block, place), shares in zip(lit, means, strict=True):
        np.multiply.outer(block.brighter, shares, out=levels[place])
        request = block.session.request
        profiles = dict(time_templates(request.frames))
        for index, (name, sd) in enumerate(zip(block.probes.names, block.probes.sd, strict=True)):
            if name.statistic.startswith("trend"):
                along = wanders.along(profiles[name.statistic.removeprefix("trend ")], request, readout_ms)
                single.append((place.start + index, 0.01 * along / math.sqrt(request.frames) / sd))
            elif name.statistic == "frame_factor":
                steps = wanders.steps(request, readout_ms)
                single.append((place.start + index, 0.5 * steps / sd))
    alone = np.zeros((size, len(single)))
    for column, (probe, amount_of_one) in enumerate(single):
        alone[probe, column] = amount_of_one
    return np.concatenate([levels, alone], axis=1)
