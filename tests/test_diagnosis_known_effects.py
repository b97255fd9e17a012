"""Effects that a twin has already: what is expected with them, and what a session says of them."""

import json
from dataclasses import make_dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.cli import main
from raytwin.diagnosis.inference.curve_fits import fit_effects
from raytwin.diagnosis.inference.discrepancy import FARTHEST_LEVEL, LEVELS
from raytwin.diagnosis.inference.inference import Hypothesis, weigh_hypotheses
from raytwin.diagnosis.inference.nuisances import Nuisances
from raytwin.diagnosis.inference.observed import Observed, Point
from raytwin.diagnosis.inference.unknown import Families
from raytwin.diagnosis.judgement.answer import improved
from raytwin.diagnosis.judgement.judgement import Verdict, _of_another_strength
from raytwin.diagnosis.model.changes import Variant
from raytwin.diagnosis.model.curves import Curve
from raytwin.diagnosis.model.forward_model import ForwardModel
from raytwin.diagnosis.problem.assemble import known_by_law
from raytwin.diagnosis.problem.problem import Problem
from raytwin.generator.effects import AppliedEffect

PROBES = 400
GROUPS = np.repeat(np.arange(20), 20)
NAMES = tuple(f"group {number}" for number in range(20))
STRENGTH = 6.0  # of the motion that the twin has


def effect(name, strength):
    return AppliedEffect(id=name, parameters={"strength": strength}, since="always")


def test_what_is_found_takes_the_place_of_the_same_effect():
    had = (effect("image_lag", 1.0), effect("output_drift", 0.4))
    twin = make_dataclass("Twin", ["effects"])(had)
    found = improved(twin, (effect("output_drift", 0.6), effect("mtf_tail", 5.0)))
    assert [(item.id, item.parameters["strength"]) for item in found.effects] == [
        ("image_lag", 1.0),
        ("output_drift", 0.6),
        ("mtf_tail", 5.0),
    ]


def test_effects_that_act_by_chance_are_sought_again():
    had = (effect("image_lag", 1.0), effect("output_drift", 0.4), effect("gain_map_error", 0.5))
    assert [item.id for item in known_by_law(had)] == ["image_lag"]


def curve(name, response):
    variant = Variant(effect=name, low=0.5, high=20.0, strengths=(STRENGTH,))
    return Curve(variant=variant, responses=np.asarray(response)[None, :])


@pytest.fixture
def line():
    """Residual of noise, nuisances, what a motion does, and two other effects."""
    rng = np.random.default_rng(2)
    motion, tail, lag = (80.0 * one / np.linalg.norm(one) for one in rng.standard_normal((3, PROBES)))
    factors = rng.standard_normal((PROBES, 3))
    noise = factors @ rng.standard_normal(3) + rng.standard_normal(PROBES)
    return SimpleNamespace(motion=motion, tail=tail, lag=lag, factors=factors, noise=noise)


def weighed(line, shown):
    """Hypotheses on a session that shows `shown` (probe,), with a twin that has the motion."""
    effects = [curve(name, getattr(line, name)) for name in ("motion", "tail", "lag")]
    observed = Observed(
        residual=line.noise + shown,
        nuisances=Nuisances(line.factors),
        groups=GROUPS,
        places=GROUPS,
        series=GROUPS,
        given=(Point(curve=effects[0], strength=STRENGTH, level=0.1, strength_sd=0.12),),
    )
    seen = [(one, fit_effects(one, effects)) for one in map(observed.off_by, LEVELS.up_to(FARTHEST_LEVEL).levels)]
    return weigh_hypotheses(seen, families=Families(of=GROUPS, names=NAMES))


def test_what_the_twin_has_is_no_gap(line):
    first, *_ = weighed(line, line.motion)
    assert first.effects == ()
    assert first.probability > 0.8


@pytest.mark.parametrize("times", [0.0, 0.4, 2.5])
def test_what_the_twin_has_at_another_strength_is_named_with_that(line, times):
    first, *_ = weighed(line, times * line.motion)
    assert first.effects == ("motion",)
    assert first.probability > 0.9
    value, low, high = (one / STRENGTH for one in first.strengths["motion"])
    assert value == pytest.approx(times, abs=0.1)
    assert low - 0.05 < times < high + 0.05


def test_another_effect_is_named_beside_what_the_twin_has(line):
    first, *_ = weighed(line, line.motion + 0.5 * line.tail)
    assert first.effects == ("tail",)
    assert first.probability > 0.9
    assert first.strengths["tail"][0] == pytest.approx(0.5 * STRENGTH, rel=0.15)


def test_both_are_named_where_what_the_twin_has_is_gone(line):
    first, *_ = weighed(line, 0.5 * line.tail)
    assert first.effects == ("motion", "tail")
    assert first.strengths["motion"][0] < 0.2 * STRENGTH


@pytest.mark.slow
def test_a_law_that_is_off_by_a_fifth_in_some_probes_leaves_no_gap(line):
    off = np.random.default_rng(3).standard_normal(20)[GROUPS] * 0.2
    shown = (1.0 + off) * line.motion
    first, *_ = weighed(line, shown)
    assert first.effects == ()
    # and what is no law's error is one
    first, *_ = weighed(line, shown + 0.4 * line.lag)
    assert first.effects == ("lag",)


def test_the_evidence_does_not_hang_on_which_effects_the_twin_has(line):
    """All that differs is a strength that is known to 12 % from one that may be any."""
    shown = line.motion + 0.5 * line.tail
    own = Point(curve=curve("motion", line.motion), strength=STRENGTH, level=0.0, strength_sd=0.12)
    bare = Observed(
        residual=line.noise + shown, nuisances=Nuisances(line.factors), groups=GROUPS, places=GROUPS, series=GROUPS
    )
    given = Observed(**{**bare.__dict__, "given": (own,)})
    assert given.conditioned("motion").log_likelihood == bare.log_likelihood
    free = 0.12 * line.motion
    covariance = np.eye(PROBES) + line.factors @ line.factors.T + np.outer(free, free)
    left = line.noise + 0.5 * line.tail
    expected = -0.5 * (np.linalg.slogdet(covariance)[1] + left @ np.linalg.solve(covariance, left))
    assert given.conditioned().log_likelihood == pytest.approx(expected, rel=1e-3)
    assert bare.log_evidence_without("motion") == 0.0
    assert given.log_evidence_without("motion") == pytest.approx(bare.log_likelihood - expected, rel=1e-3)


def test_an_effect_takes_the_place_of_the_same_one_that_the_base_has():
    had = (effect("motion_blur", 6.0), effect("image_lag", 1.0))

    base = make_dataclass("Base", ["effects"], frozen=True)(effects=had)
    model = ForwardModel(base=base, conditions={})
    variant = Variant(effect="motion_blur", low=1.0, high=9.0, strengths=(2.0,))
    change = model.change(variant, 2.0)
    assert [item.id for item in change.twin.effects] == ["image_lag"]
    assert [(item.id, item.parameters["strength"]) for item in change.effects] == [("motion_blur", 2.0)]
    assert model.change(replace(variant, effect="mtf_tail"), 2.0).twin is base
    assert model.without("motion_blur").twin.effects == had[1:]
    # it shows wherever the one that is gone did
    flat = SimpleNamespace(kind="flat", beam_on=True, after_calibration=False)
    assert model.without("image_lag").touches(flat)


def test_a_residual_knows_what_the_base_had(line):
    problem = SimpleNamespace(
        residual=line.noise.copy(), given=(Point(curve=curve("motion", line.motion), strength=STRENGTH, level=0.1),)
    )
    problem.residual_without = lambda effects: Problem.residual_without(problem, effects)
    np.testing.assert_allclose(Problem.residual_without(problem, ["tail"]), line.noise)
    np.testing.assert_allclose(Problem.residual_without(problem, ["motion"]), line.noise + line.motion)
    half = [Point(curve=curve("motion", line.motion), strength=0.5 * STRENGTH, level=0.1)]
    np.testing.assert_allclose(Problem.left_by(problem, half), line.noise + 0.5 * line.motion)
    other = [Point(curve=curve("tail", line.tail), strength=STRENGTH, level=0.1)]
    np.testing.assert_allclose(
        Problem.left_by(problem, other, without=["motion"]), line.noise + line.motion - line.tail
    )


def test_another_strength_is_told_in_units_of_the_twin(line):
    own = curve("motion_blur", line.motion)
    leading = Hypothesis(
        effects=("motion_blur",),
        probability=1.0,
        log_evidence=9.0,
        strengths={"motion_blur": (2.4, 2.2, 2.6)},
        variants={"motion_blur": own},
    )
    problem = SimpleNamespace(given=(Point(curve=own, strength=STRENGTH, level=0.1),))
    (note,) = _of_another_strength(problem, Verdict(word="explained", hypotheses=(leading,), leading=leading))
    assert note.startswith("the twin has motion_blur, and this session shows 0.40 (0.3")
    none = Hypothesis(effects=(), probability=1.0, log_evidence=0.0)
    assert _of_another_strength(problem, Verdict(word="no_gap", hypotheses=(none,), leading=none)) == ()


@pytest.mark.slow
def test_a_session_with_the_scatter_that_its_twin_has_shows_no_gap_and_what_came_besides_is_named(tmp_path):
    lab = [
        "lab",
        "--family",
        "none",
        "--protocol",
        "full",
        "--size",
        "96",
        "--seed",
        "2941",
        "--effect",
        "object_scatter=12",
    ]
    first, other = tmp_path / "first.h5", tmp_path / "other.h5"
    assert main([*lab, "-o", str(first)]) == 0
    assert main([*lab, "-o", str(other), "--session", "1", "--effect", "motion_blur=3"]) == 0
    assert main(["diagnose", str(first), "-o", str(tmp_path / "a")]) == 0
    twin = str(tmp_path / "a" / "twin.h5")
    for session, verdict, named in (
        (first, "no_gap", []),
        (other, "explained_in_part", ["motion_blur"]),
    ):
        assert main(["diagnose", str(session), "--twin", twin, "-o", str(tmp_path / session.stem)]) == 0
        said = json.loads((tmp_path / session.stem / "diagnosis.json").read_text())
        assert said["verdict"] == verdict
        likely = sorted(item["effect"] for item in said["causes"] if item["probability"] > 0.9)
        assert likely == named
