"""Series that a fit does not see, and what is left of the gap there."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.diagnosis.inference.inference import UNKNOWN, Hypothesis
from raytwin.diagnosis.judgement.held_out import folds_of, held_out
from raytwin.diagnosis.model.changes import Variant
from raytwin.diagnosis.model.curves import Curve
from raytwin.diagnosis.problem.problem import Problem


class Bare(SimpleNamespace):
    """The fields of a problem that are asked for; its twin has no effects."""

    given = ()
    residual_without = Problem.residual_without
    left_by = Problem.left_by
    with_chance = Problem.with_chance


def problem(*rows, calibrating=0):
    """(kind, sort of object, kV, exposure) of each series, in order of time; the first ones calibrate."""
    views = [
        SimpleNamespace(
            session=SimpleNamespace(
                series=SimpleNamespace(kind=kind, kV=kV, exposure_ms=exposure_ms),
                request=SimpleNamespace(scene_kind=scene, beam_on=kind in ("flat", "object")),
                calibrates=number < calibrating,
            )
        )
        for number, (kind, scene, kV, exposure_ms) in enumerate(rows)
    ]
    return Bare(views=views)


def products(count, exposures_ms, voltages=(40.0, 90.0)):
    return [("object", "product", kV, ms) for _ in range(count) for ms in exposures_ms for kV in voltages]


@pytest.mark.parametrize("count", [2, 3, 4])
def test_objects_measured_at_two_exposures_by_turns_leave_both_exposures_in_either_half(count):
    rows = products(count, (25.0, 100.0))
    folds = folds_of(problem(*rows))
    for fold in (0, 1):
        seen = {(kV, ms) for (_, _, kV, ms), own in zip(rows, folds, strict=True) if own == fold}
        assert seen == {(kV, ms) for kV in (40.0, 90.0) for ms in (25.0, 100.0)}


def test_a_beam_of_several_exposures_alternates_in_time():
    flats = [("flat", None, kV, ms) for kV in (40.0, 90.0) for ms in (10.0, 25.0, 50.0, 75.0, 100.0)]
    folds = folds_of(problem(*flats, *products(2, (25.0, 100.0))))
    np.testing.assert_array_equal(folds[:10], [0, 1, 0, 1, 0] * 2)
    np.testing.assert_array_equal(folds[10:], [0, 0, 1, 1] * 2)


def test_either_half_has_calibrating_and_later_flats_of_both_exposures():
    once = [("flat", None, kV, ms) for kV in (40.0, 90.0) for ms in (20.0, 80.0)]
    folds = folds_of(problem(*once, *once, *products(2, (20.0, 80.0)), calibrating=4))
    np.testing.assert_array_equal(folds[:8], [0, 1, 0, 1, 1, 0, 1, 0])
    assert np.count_nonzero(folds[8:]) == 4


def test_two_exposures_that_occur_once_are_one_in_either_half():
    once = [("flat", None, 60.0, 20.0), ("flat", None, 60.0, 80.0)]
    np.testing.assert_array_equal(folds_of(problem(*once)), [0, 1])


def test_a_gap_that_nothing_explains_is_left_and_what_is_planted_and_named_is_gone():
    flats = problem(*[("flat", None, 60.0, 20.0)] * 4)
    probes, series = 20, len(flats.views)
    size = probes * series
    series_of = np.repeat(np.arange(series), probes)
    pattern = np.where(np.arange(size) % 2, 1.0, -1.0)
    flats.residual = np.random.default_rng(1).standard_normal(size) + 14.0 * pattern
    flats.factors = 2.0 * (series_of == 1)[:, None]
    flats.blocks = flats.parts = flats.groups = flats.places = flats.series_of = series_of
    flats.noise = np.ones(size)
    flats.names = [SimpleNamespace(axis="level")] * size
    nobody = Hypothesis(effects=(UNKNOWN,), probability=1.0, log_evidence=0.0)
    gap, _, shares = held_out(flats, nobody, np.random.default_rng(0))
    assert gap.before == gap.after > 10.0
    assert shares == {}
    variant = Variant(effect="stripes", low=1.0, high=100.0, strengths=(1.0,))
    curve = Curve(variant=variant, responses=pattern[None, :])
    found = Hypothesis(
        effects=("stripes",),
        probability=1.0,
        log_evidence=0.0,
        strengths={"stripes": (14.0, 13.0, 15.0)},
        variants={"stripes": curve},
        levels={"stripes": 0.0},
    )
    gap, _, shares = held_out(flats, found, np.random.default_rng(0))
    assert gap.after < 1.5
    assert shares["stripes"][0] == pytest.approx(1.0, abs=0.05)
    assert gap.tested
    # what shows in one series alone is told by no other
    curve = Curve(variant=variant, responses=np.where(series_of == 0, pattern, 0.0)[None, :])
    gap, _, _ = held_out(flats, replace(found, variants={"stripes": curve}), np.random.default_rng(0))
    assert not gap.tested
