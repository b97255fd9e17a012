"""Session and twin -> the problem that inference solves: residual probes, nuisance factors, responses to every effect."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ...acquisition.acquisition_io import AcquisitionFile, Series
from ...acquisition.log_images import light_of_shares
from ...errors import InputError
from ...generator.effects import EFFECTS, AppliedEffect, effect_of
from ...generator.frames.conditions import beam_conditions, session_conditions, with_conditions
from ...generator.line.twin import Twin
from ..arrays import FloatArray, IndexArray
from ..inference.discrepancy import FARTHEST_LEVEL, USUAL_LEVEL
from ..inference.observed import Point
from ..inference.unknown import Families
from ..model.calibrated_maps import calibrated_maps
from ..model.changes import (
    Change,
    Variant,
    always_a_little,
    catalogue_variants,
    smooth_twin,
    spectral_sds,
    twin_changes,
    with_pauses,
    with_seams,
)
from ..model.curves import LEAST_RESPONSE, Curve, places_of
from ..model.defects import lasting_anywhere, memory_of, new_outliers
from ..model.forward_model import ForwardModel, draft_cache, own_maps, strength_rows
from ..model.placing import MeasuredScenes, place_scenes
from ..model.responses import Asked, SeriesModel, SessionModel, session_model
from ..probes.probes import ALONG_COLUMNS, ALONG_ROWS, OUTLIERS_ANYWHERE, ProbeName
from ..session.even_maps import Map
from ..session.preparation import PreparedSession
from ..session.session import SessionSeries, only_own_noise, read_session
from ..session.usable import counted_copies, look_at_all, stated_series, summarise_all
from .asked_again import AskedAgain, notable
from .line_noise import usual_line_noise
from .nuisance_columns import Columns, nuisances_of_series
from .other_scenes import NO_SCENES, OtherScenes, other_scenes
from .problem import Problem, read_exactly
from .series_block import SeriesBlock, by_chance, jitter_of, series_block
from .series_probes import MeasuredSession, mean_frame, series_probes
from .surroundings import border_inflow

_Key = TypeVar("_Key", bound=Hashable)
_OWN_NOISE = "the flats are single frames: how much noise there is, is known only from these same series"
# step in spectral parameters, over the posterior's standard deviation, about a point that the session wants
_NEAR_A_POINT = 0.2
_PLACES = "places of scenes"
_IN_NO_LAW = ("output", "pixels", "lines", "offset")  # what effects do by chance to mean frames


def build_problem(
    acquisition: AcquisitionFile,
    twin: Twin,
    *,
    variants: Sequence[Variant],
    calibrated_elsewhere: bool = False,
    exposed: Sequence[Series] = (),
    ends_at_zero: frozenset[str] = frozenset(),
    spectral_point: FloatArray | None = None,
    side: int = 1,
    progress: Callable[[str], None] | None = None,
) -> Problem:
    """Probes, nuisances and responses to effects (variants) of a session.

    Args:
        acquisition, exposed, ends_at_zero: open file, and as in `read_session`.
        twin: calibrated from this session or, with `calibrated_elsewhere`, another; its effects are no gap, its dark and gain maps
            stand in where no series here is marked as calibrating.
        spectral_point: spectral parameters (parameter,) at which these nuisances are taken as linear in place of the best ones,
            about which they have their priors all the same.
        side: of the squares of the panel's pixels that the acquisition has for pixels.

    Raises:
        InputError: nothing that can be judged: no darks and flats, or another detector than the twin's.
    """
    tell = progress or (lambda stage: None)
    session = read_session(
        acquisition, calibrated_elsewhere=calibrated_elsewhere, exposed=exposed, ends_at_zero=ends_at_zero
    )
    requests = [item.request for item in session]
    variants = with_pauses(variants, stated=all(item.pause_stated for item in requests[1:]))
    conditions = session_conditions(requests, readout_ms=twin.instrument.readout_ms)
    known = tuple(with_conditions(item, conditions) for item in known_by_law(twin.effects))
    base, cache = replace(smooth_twin(twin), effects=known), draft_cache()
    back: dict[str, float] = {}
    if spectral_point is not None and base.spectral is not None:
        away = (base.spectral.best - spectral_point) / spectral_sds(base.spectral)
        back = dict(zip(base.spectral.names, map(float, away), strict=True))
        base = replace(base, spectral=replace(base.spectral, best=spectral_point))
    conditions |= beam_conditions(base, requests, cache=cache)
    model = ForwardModel(base=base, conditions=conditions, own_maps=own_maps(session), cache=cache)
    measured = _measured(session, acquisition, twin, model, side=side, tell=tell)
    expected = measured.expected
    variants = with_seams(variants, measured.seams())
    tell("responses")
    changes = [model.change(variant, strength) for variant in variants for strength in variant.strengths]
    had = {item.id: item for item in model.base.effects}
    steps = twin_changes(model.base, spectral_steps=_NEAR_A_POINT if back else 1.0)
    little = [item for item in always_a_little(side=side) if item.effect not in had]
    steps += [replace(model.change(item, item.strengths[0]), label=item.name) for item in little]
    changes += steps
    changes += [model.without(effect) for effect in had]
    unjudged = {}
    if only_own_noise(session):
        # effects on the statistics of quanta cannot be judged from the noise that calibrates
        unjudged = {effect.id: _OWN_NOISE for effect in EFFECTS.values() if effect.stage == "quanta"}
    compared = _Compared(
        measured=measured,
        asked=tuple(expected.ask(change, refused=unjudged.get(change.label, "")) for change in changes),
        had=had,
        variants=tuple(variants),
        steps=tuple(steps),
        scenes=other_scenes(expected.series),
        back=back,
        side=side,
    )
    blocks = []
    for one in expected.series:
        tell(f"responses of {one.name}")
        blocks.append(compared.block(one))
    return _joined(blocks, compared)


def known_by_law(effects: Sequence[AppliedEffect]) -> tuple[AppliedEffect, ...]:
    """Effects of a twin that are part of what is expected; others are sought again, and take the place of those it has."""
    return tuple(item for item in effects if effect_of(item).variation.random not in _IN_NO_LAW)


def problem_of(
    session: PreparedSession,
    *,
    without: Sequence[str] = (),
    variants: Sequence[Variant] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Problem:
    """What inference is asked about a prepared session, with `variants` (None: the catalogue less `without`)."""
    return build_problem(
        session.acquisition,
        session.twin,
        variants=catalogue_variants(without=without, side=session.factor) if variants is None else variants,
        calibrated_elsewhere=session.calibrated_elsewhere,
        exposed=session.exposed,
        ends_at_zero=session.ends_at_zero,
        spectral_point=session.spectral_point,
        side=session.factor,
        progress=progress,
    )


def _measured(
    session: Sequence[SessionSeries],
    acquisition: AcquisitionFile,
    twin: Twin,
    model: ForwardModel,
    *,
    side: int,
    tell: Callable[[str], None],
) -> MeasuredSession:
    """Two passes over the frames: which pixels and series can be used, then what these say; scenes are found in between."""
    stated, skipped = stated_series(session, acquisition)
    tell("expectation")
    expected = {}
    for item in stated:
        try:
            expected[item.name] = model.expect(item.request)
        except InputError as error:
            skipped.append(f"{item.name}: {error}")
    if not expected:
        raise InputError(
            f"acquisition {acquisition.path}",
            received="; ".join(skipped) or "no series",
            expected="darks and flats whose kV, exposure and tube load are stated",
        )
    tell("frames")
    known_good = twin.maps.bad_pixels == 0
    seen, left_out = look_at_all(
        [_as_light(item, model) for item in stated if item.name in expected],
        expected,
        good=known_good,
        bits=acquisition.instrument.bits,
        dark_at=model.base.maps.dark_at,
        side=side,
        tell=tell,
    )
    maps = calibrated_maps(seen, twin=twin, good=known_good)
    counting = bool(model.base.instrument.counting)
    standing_out = new_outliers(seen, maps, counting=counting)
    lasting = lasting_anywhere(seen, maps.good, counting=counting)
    outlying = standing_out.bad & ~lasting
    clean = maps.good & ~standing_out.any & ~lasting
    # they count as outliers; what else is said of noise is said without them
    summaries = summarise_all(seen, clean, tell=tell)
    lines_DN2 = usual_line_noise(seen, summaries, clean)
    for one in seen:
        exposures = one.session.request.exposures_per_frame
        summaries[one.name] = summaries[one.name].without_lines(*(each / exposures for each in lines_DN2))
    tell("registration")
    pictures = {one.name: maps.corrected(one.session, one.look.mean_DN) for one in seen}
    scenes = MeasuredScenes(pictures=pictures, clean=clean, sharp=model.sharp, expect=model.expect)
    placed = place_scenes(seen, scenes)
    return MeasuredSession(
        expected=session_model(model, maps, placed, summaries, clean, lines_DN2=lines_DN2),
        pictures=pictures,
        summaries=summaries,
        memory={one.name: memory_of(one.look, outlying) for one in seen if one.session.series.kind == "dark"},
        copies={name: count for name, (count, _) in counted_copies(seen).items()},
        clean=clean,
        lasting=lasting,
        outliers=int(np.count_nonzero(outlying)),
        skipped=(*skipped, *left_out),
    )


def _as_light(item: SessionSeries, model: ForwardModel) -> SessionSeries:
    """Shares of the open field and their logarithms as light, of the open field that the base twin expects."""
    if not item.shares:
        return item
    opened = model.expect(replace(item.request, kind="flat", thickness_mm=None, scene_kind=None))
    return replace(item, series=light_of_shares(item.series, float(np.mean(opened.signal_DN))))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Compared:
    """A session and the changes that every series of it is asked with."""

    measured: MeasuredSession
    # changes, those of variants' strengths first, then steps, the twin less each of its effects last
    asked: tuple[Asked, ...]
    had: Mapping[str, AppliedEffect]  # these effects
    variants: tuple[Variant, ...]
    steps: tuple[Change, ...]  # of nuisances that lie in the twin
    scenes: Mapping[str, OtherScenes]
    back: Mapping[str, float]  # prior sds from the base twin's spectral parameters to the calibrated ones, by name
    side: int  # of the squares of the panel's pixels that stand for pixels

    def block(self, one: SeriesModel) -> SeriesBlock:
        """One series: its templates and projections, and what every change does to it."""
        measured, session = self.measured, self.measured.expected
        summary, moved = measured.summaries[one.name], session.moved(one, self.asked)
        frame = mean_frame(one, measured.pictures[one.name], session.maps, frames=summary.frames, side=self.side)
        probes = series_probes(measured, one, frame, moved=moved, variants=self.variants)
        scenes = self.scenes.get(one.name, NO_SCENES)
        nuisances = nuisances_of_series(session, probes, frame.signal_DN, scenes.drawn(session, one, session.unchanged))
        return series_block(
            probes, frame, summary=summary, scenes=scenes, asked=self.asked, moved=moved, nuisances=nuisances
        )


def _joined(blocks: Sequence[SeriesBlock], compared: _Compared) -> Problem:
    """The problem that all series together make."""
    session = compared.measured.expected
    responses = np.concatenate([block.responses for block in blocks], axis=1)
    names = tuple(name for block in blocks for name in block.probes.names)
    series_of = np.repeat(np.arange(len(blocks)), [len(block) for block in blocks])
    factors = _factors(blocks, responses, compared)
    first_less = len(responses) - len(compared.had)
    done = {effect: -response for effect, response in zip(compared.had, responses[first_less:], strict=True)}
    curves, missing = _curves(blocks, responses, names, compared, done)
    of_probes = [(name.axis, block.session.series) for block in blocks for name in block.probes.names]
    groups, _ = _numbered(
        [
            f"{axis}, {series.kind} {series.scene} {series.kV if series.kind != 'dark' else ''}".strip()
            for axis, series in of_probes
        ]
    )
    # series of one place share local nuisances
    shown = [block.session for block in blocks]
    sharing, _ = _numbered([item.place if item.series.kind == "object" else item.name for item in shown])
    residual = np.concatenate([block.residual for block in blocks])
    for name, step in compared.back.items():
        residual -= step * factors.get(name, 0.0)
    return Problem(
        residual=residual,
        factors=np.stack(list(factors.values()), axis=1) if factors else np.zeros((len(names), 0)),
        factor_names=tuple(factors),
        curves=tuple(curves),
        names=names,
        series_of=series_of,
        sd=np.concatenate([block.probes.sd for block in blocks]),
        noise=np.concatenate([block.probes.noise for block in blocks]),
        groups=groups,
        families=_families(names, [series for _, series in of_probes]),
        blocks=sharing[series_of],
        views=tuple(block.view for block in blocks),
        session=session,
        skipped=compared.measured.skipped,
        missing_effects=missing,
        again=AskedAgain(
            session=session,
            series=tuple(blocks),
            # a spectrum's parameters cancel in calibrating flats to a ten thousandth, as straight lines about the base alone
            steps=tuple(step for step in compared.steps if step.steps != "lit"),
            done=done,
            factors=factors,
        ),
        side=compared.side,
        given=tuple(_as_given(item, done[effect], session, blocks) for effect, item in compared.had.items()),
    )


def _as_given(effect: AppliedEffect, done: FloatArray, session: SessionModel, blocks: Sequence[SeriesBlock]) -> Point:
    """An effect that the twin has, as it has it; done (probe,): what it does there."""
    inner = {name: value for name, value in effect.parameters.items() if name != "strength"}
    strength = abs(effect.parameters["strength"])
    variant = Variant(
        effect=effect.id,
        name="as the twin has it",
        parameters=inner,
        since=effect.since,
        low=strength,
        high=strength,
        strengths=(strength,),
    )
    inflow = border_inflow(session, [block.probes for block in blocks], effect)
    curve = Curve(variant=variant, responses=done[None, :], spread=inflow)
    level = USUAL_LEVEL if effect.law_sd is None else min(effect.law_sd, FARTHEST_LEVEL)
    # found without an interval, or stated by hand: as intervals of strengths are widened for real laws
    sd = EFFECTS[effect.id].reading.law_sd if effect.strength_sd is None else effect.strength_sd
    return Point(curve=curve, strength=strength, level=level, strength_sd=sd)


def _families(names: Sequence[ProbeName], series: Sequence[Series]) -> Families:
    """Families of probes, with their names and the series that each lies in."""
    exact = read_exactly()

    def family(name: ProbeName, one: Series) -> str:
        if name.statistic in exact:
            return name.statistic
        # a few probes a scene, lost among its others
        displaced = name.statistic in (ALONG_ROWS, ALONG_COLUMNS)
        return _PLACES if displaced else f"{name.axis} of {one.kind} {one.scene}".strip()

    of, found = _numbered([family(name, one) for name, one in zip(names, series, strict=True)])
    places: list[set[tuple[str, str]]] = [set() for _ in found]
    for number, name, one in zip(of, names, series, strict=True):
        # one series stands for all in which pixels stand out
        places[number].add(("" if name.statistic == OUTLIERS_ANYWHERE else one.kind, name.axis))
    return Families(
        of=of,
        names=found,
        exact=frozenset(number for number, name in enumerate(found) if name in exact),
        of_kind=tuple(next(iter(own)) if len(own) == 1 else ("", "") for own in places),
    )


def _numbered(keys: Sequence[_Key]) -> tuple[IndexArray, tuple[_Key, ...]]:
    """Number of each key (key,), in the order in which they first occur, and the keys by number."""
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys], dtype=np.intp), tuple(numbers)


def _factors(blocks: Sequence[SeriesBlock], responses: FloatArray, compared: _Compared) -> Columns:
    """Responses (probe,) to nuisances by name: what calibration fitted, and what series have of their own."""
    columns: Columns = {}
    first = sum(len(variant.strengths) for variant in compared.variants)
    last = first + len(compared.steps)
    for item, response in zip(compared.asked[first:last], responses[first:last], strict=True):
        if not item.failed:
            columns[item.change.label] = response / item.change.step_sd
    for block, place in zip(blocks, places_of(blocks), strict=True):
        for name, column in block.nuisances.items():
            columns.setdefault(name, np.zeros(responses.shape[1]))[place] += column
    return notable(columns)


def _curves(
    blocks: Sequence[SeriesBlock],
    responses: FloatArray,
    names: Sequence[ProbeName],
    compared: _Compared,
    done: Mapping[str, FloatArray],
) -> tuple[list[Curve], dict[str, str]]:
    """Curves, and why each effect without one cannot be judged; done (probe,): by the base's own effects."""
    probes = [block.probes for block in blocks]
    session = compared.measured.expected
    curves: list[Curve] = []
    missing: dict[str, str] = {}
    base = session.model.base
    readout_ms, read_noise_DN = base.instrument.readout_ms, base.noise.read_noise_DN.value
    for variant, rows in zip(compared.variants, strength_rows(compared.variants), strict=True):
        effect = EFFECTS[variant.effect]
        failed = next((one.failed for one in compared.asked[rows] if one.failed), "")
        if failed:
            missing.setdefault(variant.effect, failed)
            continue
        own = responses[rows] + done.get(variant.effect, 0.0)
        spread = border_inflow(session, probes, variant.applied(variant.strengths[0]))
        if spread is None:
            spread = by_chance(variant, blocks, rows.start, readout_ms)
        # a wandering output shifts levels by chance even where too few frames show its noise
        wanders = effect.variation.random == "output" and spread is not None and bool(np.any(spread))
        if not (wanders or float(np.max(np.abs(own))) > LEAST_RESPONSE):
            missing.setdefault(variant.effect, "nothing in this session responds to it")
            continue
        exact = None
        if effect.reading.probes:
            exact = np.array([name.statistic in effect.reading.probes for name in names])
        jitter = jitter_of(variant, blocks, read_noise_DN)
        curves.append(Curve(variant=variant, responses=own, spread=spread, jitter=jitter, exact=exact))
    for curve in curves:
        missing.pop(curve.effect, None)
    return curves, missing


def map_changes(problem: Problem, effects: Sequence[AppliedEffect]) -> list[Map]:
    """What effects change in each view's corrected mean frame (row, column), DN, calibration having taken in its part.

    They take the place of the same ones that the base has.

    Raises:
        InputError: the twin knows too little for them.
    """
    session = problem.session
    asked = session.ask(session.model.with_found(effects))
    moved = [session.moved(one, [asked])[0] for one in session.series]
    if asked.failed:
        raise InputError(
            "effects that were found", received=asked.failed, expected="effects that this twin can be asked for"
        )
    shape = problem.base.maps.shape
    return [np.broadcast_to(found[0], shape) for found in moved if found is not None]
