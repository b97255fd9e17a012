"""What a session could still measure, and how far each measurement would set two explanations apart."""

from dataclasses import replace

import numpy as np
import pytest

from raytwin.acquisition import open_acquisition
from raytwin.cli import main
from raytwin.diagnosis.advice.next_series import (
    FRAMES,
    _separation,
    best_measurement,
    measurements_lacking,
)
from raytwin.diagnosis.advice.plan import advice_text
from raytwin.diagnosis.diagnose_session import diagnose
from raytwin.diagnosis.inference.observed import Point
from raytwin.diagnosis.model.changes import catalogue_variants
from raytwin.diagnosis.problem.assemble import build_problem
from raytwin.diagnosis.session.preparation import prepare_session
from raytwin.generator.effects import EFFECTS

ALL = ("afterglow", "discs", "edges", "timed edges", "slabs", "wedge", "filter", "exposures", "turned")
STRENGTHS = {"focal_spot": 0.6, "mtf_tail": 5.0, "image_lag": 0.3, "dark_drift": 3.0}


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A short session with products, whose focal spot grew."""
    path = tmp_path_factory.mktemp("next") / "session.h5"
    words = ["--protocol", "short", "--geometry", "fine", "--seed", "2502", "--products", "3", "--size", "48"]
    words += ["--frames", "10", "--family", "none", "--effect", "focal_spot=0.6"]
    assert main(["lab", "-o", str(path), *words]) == 0
    return path


@pytest.fixture(scope="module")
def problem(session):
    """The session against its twin, with the four effects that these tests set against each other."""
    wanted = [item for item in catalogue_variants() if item.effect in STRENGTHS]
    with open_acquisition(session) as acquisition:
        prepared = prepare_session(acquisition, twin=None, rng=np.random.default_rng(0))
        return build_problem(prepared.acquisition, prepared.twin, variants=wanted)


def at_strength(problem, effect):
    curve = next(item for item in problem.curves if item.effect == effect)
    return [Point(curve=curve, strength=STRENGTHS[effect], level=0.0)]


@pytest.fixture(scope="module")
def diagnosis(session):
    with open_acquisition(session) as acquisition:
        return diagnose(acquisition, rng=np.random.default_rng(0))


def explanation(diagnosis, *effects):
    found = next(item for item in diagnosis.hypotheses if set(item.effects) == set(effects))
    return [found.point(effect) for effect in effects]


@pytest.mark.slow
def test_a_session_of_flats_and_products_lacks_all_that_isolates_effects(diagnosis):
    planned = measurements_lacking(diagnosis.problem)
    assert tuple(item.name for item in planned) == ALL
    edges = next(item for item in planned if item.name == "edges")
    # two directions, two distances, two voltages
    assert len(edges.series) == 8
    assert len({one.source_object_mm for one in edges.series}) == 2
    equal = next(item for item in planned if item.name == "timed edges").series
    assert len({round(one.setting.tube_load_mAs, 9) for one in equal}) == 1
    assert len({one.exposure_ms for one in equal}) == 3
    told = edges.series[0].as_dict()
    assert told["kind"] == "object"
    assert told["frames"] == FRAMES
    assert {"kV", "filter", "exposure_ms", "scene", "source_object_mm"} <= set(told)


@pytest.mark.slow
def test_edges_discs_or_flats_are_asked_for_where_blur_of_the_source_ties_with_blur_of_the_panel(diagnosis):
    first, second = explanation(diagnosis, "focal_spot"), explanation(diagnosis, "mtf_tail")
    found = best_measurement(diagnosis.problem, first, second, rng=np.random.default_rng(3))
    # flats show a tail by their noise, and the source's blur not at all
    assert found.name in ("discs", "edges", "timed edges", "exposures")
    assert found.separation_then > found.separation + 3.0
    text = advice_text([found], ["focal_spot"], ["mtf_tail"], lately=False)
    titles = [EFFECTS[effect].title for effect in ("focal_spot", "mtf_tail")]
    assert text.startswith(f"{found.what}, which would tell {titles[0]} from {titles[1]} by")
    # the answer's frames are drawn from the generator alone, and hardly matter
    again = best_measurement(diagnosis.problem, first, second, rng=np.random.default_rng(3))
    other = best_measurement(diagnosis.problem, first, second, rng=np.random.default_rng(4))
    assert again == found
    assert other.separation_then == pytest.approx(found.separation_then, rel=0.1)


@pytest.mark.slow
def test_beam_off_frames_are_asked_for_where_lag_ties_with_a_drifting_dark(problem):
    lag, drift = (at_strength(problem, effect) for effect in ("image_lag", "dark_drift"))
    found = best_measurement(problem, lag, drift, rng=np.random.default_rng(3))
    assert found.name == "afterglow"
    assert found.separation_then > 5.0


def test_an_explanation_lies_nowhere_from_itself_at_another_strength(problem):
    first = at_strength(problem, "focal_spot")
    same = [replace(point, strength=1.0000001 * point.strength) for point in first]
    assert _separation(problem, None, np.zeros(0, dtype=np.intp), first, same) < 1e-3


def test_nothing_is_planned_for_a_session_that_states_no_tube_load(problem):
    def silent(view):
        request = view.session.request
        if request.setting is None:
            return view
        setting = replace(request.setting, power_W=None, current_mA=None)
        return replace(view, session=replace(view.session, request=replace(request, setting=setting)))

    assert measurements_lacking(problem)
    unknown = replace(problem, views=tuple(silent(view) for view in problem.views))
    assert measurements_lacking(unknown) == ()
    first, second = (at_strength(problem, effect) for effect in ("focal_spot", "mtf_tail"))
    assert best_measurement(unknown, first, second, rng=np.random.default_rng(0)) is None
