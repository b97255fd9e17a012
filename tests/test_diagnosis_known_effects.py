"""Effects that a twin has already: what is expected with them, and how far they are trusted."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.cli import main
from raytwin.diagnosis.inference.inference import UNKNOWN, Hypothesis
from raytwin.diagnosis.inference.local_nuisances import LocalNuisances
from raytwin.diagnosis.inference.nuisances import Nuisances
from raytwin.diagnosis.judgement.judgement import _of_another_strength
from raytwin.diagnosis.judgement.sought_anew import is_to_be_asked, with_sought_anew
from raytwin.diagnosis.model.curves import Curve
from raytwin.diagnosis.problem.known_effects import already_there, lasting, with_found
from raytwin.diagnosis.problem.known_laws import (
    CHANGED_SD,
    beside_known,
    changed_effect,
    known_strengths,
    with_any_strength,
)
from raytwin.generator.effects import AppliedEffect


def effect(name, strength):
    return AppliedEffect(id=name, parameters={"strength": strength}, since="always")


def test_what_is_found_takes_the_place_of_the_same_effect():
    had = (effect("image_lag", 1.0), effect("output_drift", 0.4))
    found = with_found(had, (effect("output_drift", 0.6), effect("mtf_tail", 5.0)))
    assert [(item.id, item.parameters["strength"]) for item in found] == [
        ("image_lag", 1.0),
        ("output_drift", 0.6),
        ("mtf_tail", 5.0),
    ]


def test_effects_that_act_by_chance_are_sought_again():
    had = (effect("image_lag", 1.0), effect("output_drift", 0.4), effect("gain_map_error", 0.5))
    assert [item.id for item in lasting(had)] == ["image_lag"]
    assert already_there(had) == {"image_lag": "the twin has it already (1 %); the gap is what it leaves"}


@dataclass(frozen=True, kw_only=True)
class Few:
    """The fields of a problem that are changed."""

    residual: np.ndarray
    factors: np.ndarray
    factor_names: tuple[str, ...]
    curves: tuple[Curve, ...]
    groups: np.ndarray
    blocks: np.ndarray
    sd: np.ndarray
    noise: np.ndarray
    respond: Callable
    base: SimpleNamespace


@pytest.fixture
def few():
    rng = np.random.default_rng(2)
    probes = 60
    curve = Curve(
        effect="mtf_tail",
        variant="",
        parameters={},
        low=1.0,
        high=2.0,
        strengths=np.array([1.0]),
        responses=rng.standard_normal((1, probes)),
    )
    return Few(
        residual=rng.standard_normal(probes),
        factors=np.ones((probes, 1)),
        factor_names=("level",),
        curves=(curve,),
        groups=np.repeat(np.arange(3), 20),
        blocks=np.repeat(np.arange(3), 20),
        sd=np.full(probes, 2.0),
        noise=np.full(probes, 0.8),
        respond=lambda asked, wanted=None: {0: np.ones((1, probes))},
        base=SimpleNamespace(effects=()),
    )


def square(problem):
    return float(problem.residual @ Nuisances(problem.factors).solve(problem.residual))


def test_a_law_that_is_off_by_a_tenth_in_some_probes_leaves_no_gap(few):
    response = 300.0 * np.random.default_rng(3).standard_normal(60)
    off = np.where(few.groups == 1, 0.1, -0.05) * response
    wrong = Few(**{**few.__dict__, "residual": few.residual + off})
    assert square(wrong) > 1e4
    found = beside_known(wrong, response[None, :], ["mtf_tail"])
    assert square(found) < 1.5 * 60
    # all that is counted in standard deviations is counted in the wider ones
    root = found.sd / few.sd
    assert np.all(root > 1.0)
    np.testing.assert_allclose(found.residual * root, wrong.residual)
    np.testing.assert_allclose(found.noise * root, few.noise)
    np.testing.assert_allclose(found.curves[0].responses * root, few.curves[0].responses)
    np.testing.assert_allclose(found.respond([])[0] * root, 1.0)
    assert len(found.factor_names) == found.factors.shape[1]
    # and what is no law's error stays
    other = Few(**{**few.__dict__, "residual": few.residual + np.where(np.arange(60) == 7, 5000.0, 0.0)})
    assert square(beside_known(other, response[None, :], ["mtf_tail"])) > 1e4


def test_a_twin_without_effects_is_left_as_it_is(few):
    assert beside_known(few, np.zeros((0, 60)), []) is few


def known(few, times, seed=3):
    """How strong a session shows a motion that the twin has, where it has so many times as much."""
    # seen at 40 standard deviations
    response = 5.0 * np.random.default_rng(seed).standard_normal(60)
    fields = {**few.__dict__, "base": SimpleNamespace(effects=(effect("motion_blur", 6.0),))}
    shown = Few(**{**fields, "residual": few.residual + (times - 1.0) * response})
    problem = beside_known(shown, response[None, :], ["motion_blur"])
    (found,) = known_strengths(problem, LocalNuisances(problem.factors, problem.blocks))
    return problem, found


@pytest.mark.parametrize("times", [0.0, 0.4, 1.0, 2.5])
def test_the_strength_of_what_the_twin_has_is_read(few, times):
    problem, found = known(few, times)
    value, low, high = found.times
    assert low < times < high
    assert value == pytest.approx(times, abs=0.3)
    assert high - low < 1.0
    assert (found.log_evidence > 5.0) == (times != 1.0)
    assert found.location in problem.factor_names


def test_the_evidence_of_another_strength_is_that_of_a_wider_prior(few):
    problem, found = known(few, 0.3)
    place = problem.factor_names.index(found.location)
    wide = problem.factors.copy()
    wide[:, place] *= 1.0 / 0.12
    covariances = [np.eye(60) + factors @ factors.T for factors in (problem.factors, wide)]
    likelihood = [
        -0.5 * np.linalg.slogdet(one)[1] - 0.5 * problem.residual @ np.linalg.solve(one, problem.residual)
        for one in covariances
    ]
    assert found.log_evidence == pytest.approx(likelihood[1] - likelihood[0], rel=1e-9)
    fitted = wide[:, place] @ np.linalg.solve(covariances[1], problem.residual)
    assert found.times[0] == pytest.approx(1.0 + fitted, rel=1e-9)


def test_a_twin_without_effects_has_no_strength_to_read(few):
    assert known_strengths(few, LocalNuisances(few.factors, few.blocks)) == ()


def test_a_session_that_wants_nothing_but_another_strength_is_no_agreement(few):
    _, found = known(few, 0.0)
    none, tail = (
        Hypothesis(effects=name, probability=p, log_evidence=0.0) for name, p in (((), 0.6), (("mtf_tail",), 0.3))
    )
    other = Hypothesis(effects=(UNKNOWN,), probability=0.1, log_evidence=-3.0, location="noise of dark")
    first, *rest = _of_another_strength((none, tail, other), [found])
    assert (first.effects, first.location) == ((UNKNOWN,), found.location)
    assert first.probability == pytest.approx(0.7)
    assert [item.probability for item in rest] == [0.3, 0.0]
    # as strong as the twin has it, or with an effect that leads: as they were
    _, same = known(few, 1.0)
    assert not same.is_another
    assert _of_another_strength((none, tail, other), [same]) == (none, tail, other)
    assert _of_another_strength((tail, none, other), [found]) == (tail, none, other)


def test_strengths_left_free_are_read_with_their_own_prior(few):
    problem, before = known(few, 0.2)
    free = with_any_strength(problem, ["motion_blur"])
    (after,) = known_strengths(free, LocalNuisances(free.factors, free.blocks), of=["motion_blur"], sd=CHANGED_SD)
    assert after.times == pytest.approx(before.times, rel=1e-6)
    assert after.log_evidence == pytest.approx(0.0, abs=1e-9)
    assert after.is_another


def test_the_place_of_another_strength_names_the_effect(few):
    _, found = known(few, 0.0)
    assert changed_effect(found.location) == "motion_blur"
    assert changed_effect("sharpness of object edge") is None
    assert found.note.startswith("the twin has motion_blur, and this session shows 0.")
    assert "-0" not in found.note


@dataclass(frozen=True, kw_only=True)
class Gap:
    """A gap before and after."""

    before: float
    after: float
    shrinks_by: float | None = 0.5


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The fields of an answer that are changed."""

    verdict: str
    named: tuple[str, ...]
    gap: Gap
    hypotheses: tuple[Hypothesis, ...]
    causes: tuple[SimpleNamespace, ...] = ()
    notes: tuple[str, ...] = ()
    unknown_location: str = ""
    probability_no_gap: float = 0.0
    probability_unknown: float = 0.0
    held_out: tuple = (("brightness", 2.0, 1.0, 0.7),)
    ambiguous_with: tuple = ()
    next_measurement: dict | None = None
    twin: SimpleNamespace | None = None
    added: tuple = ()
    strained: tuple = ()


def answer(named, *, before, after, strengths=(), verdict="explained", **more):
    hypotheses = (
        Hypothesis(effects=tuple(sorted(named)) or (UNKNOWN,), probability=0.9, log_evidence=50.0),
        Hypothesis(effects=("lag", "object_scatter"), probability=0.06, log_evidence=40.0),
        Hypothesis(effects=(UNKNOWN,), probability=0.04, log_evidence=10.0),
    )
    return Answer(
        verdict=verdict,
        named=tuple(named),
        gap=Gap(before=before, after=after),
        hypotheses=hypotheses,
        causes=tuple(SimpleNamespace(effect=name, strength=value) for name, value in dict(strengths).items()),
        **more,
    )


@dataclass(frozen=True)
class Line:
    """A twin's effects."""

    effects: tuple


def test_a_gap_beside_what_the_twin_has_is_judged_with_that_sought_anew():
    had = (effect("object_scatter", 10.8), effect("output_drift", 0.2))
    note = "the twin has object_scatter, and this session shows 1.20 (1.1 to 1.3) times as much of it"
    left = answer((), before=1.7, after=1.7, verdict="unknown_effect", notes=(note, "kept"), twin=Line(()))
    again = {"object_scatter": (11.0, 8.6, 13.9)}

    # as strong as the twin has it, and it explains the session: nothing else
    found = with_sought_anew(left, answer(["object_scatter"], before=11.3, after=2.8, strengths=again), had)
    assert (found.verdict, found.named, found.causes) == ("no_gap", (), ())
    assert found.probability_no_gap == pytest.approx(0.9)
    assert found.probability_unknown == pytest.approx(0.04)
    assert [item.effects for item in found.hypotheses] == [(), ("lag",), (UNKNOWN,)]
    assert (found.gap.before, found.gap.after, found.gap.shrinks_by) == (1.7, 1.7, None)
    assert found.twin.effects == had
    assert found.notes[0] == "kept"
    assert "sought anew" in found.notes[1]

    # beside it another one is seen
    both = answer(["motion_blur", "object_scatter"], before=11.8, after=3.0, strengths=again)
    found = with_sought_anew(left, both, had)
    assert (found.verdict, found.named) == ("explained", ("motion_blur", "object_scatter"))
    assert "sought anew" in found.notes[-1]
    # which had been named beside the twin's own already
    named = answer(["motion_blur"], before=3.0, after=1.0)
    assert with_sought_anew(named, both, had) is named

    # of another strength, or leaving far more as the twin has it: it is another one now
    weak = answer(["object_scatter"], before=11.3, after=2.8, strengths={"object_scatter": (4.0, 3.2, 5.0)})
    assert with_sought_anew(left, weak, had).named == ("object_scatter",)
    worse = replace(left, gap=Gap(before=9.0, after=9.0))
    found = with_sought_anew(worse, answer(["object_scatter"], before=11.3, after=2.8, strengths=again), had)
    assert (found.verdict, found.named) == ("explained", ("object_scatter",))

    # not found, or nothing explains the session: the first answer stands
    assert with_sought_anew(left, answer(["veiling_glare"], before=11.3, after=2.8), had) is left
    assert with_sought_anew(left, answer((), before=11.0, after=11.0, verdict="unknown_effect"), had) is left


def test_effects_are_sought_anew_where_a_gap_is_left_that_is_not_their_strength():
    had = (effect("object_scatter", 10.8),)
    left = answer((), before=1.7, after=1.7, verdict="unknown_effect")
    assert is_to_be_asked(left, had)
    assert not is_to_be_asked(left, ())
    assert not is_to_be_asked(left, (effect("output_drift", 0.2),))  # sought again in any case
    assert not is_to_be_asked(replace(left, verdict="no_gap"), had)
    of_strength = replace(left, unknown_location="strength of object_scatter, which the twin has")
    assert not is_to_be_asked(of_strength, had)


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
        (other, "explained", ["motion_blur", "object_scatter"]),
    ):
        assert main(["diagnose", str(session), "--twin", twin, "-o", str(tmp_path / session.stem)]) == 0
        said = json.loads((tmp_path / session.stem / "diagnosis.json").read_text())
        assert said["verdict"] == verdict
        likely = sorted(item["effect"] for item in said["causes"] if item["probability"] > 0.9)
        assert likely == named
        assert ("object_scatter" in named) is not any(item["effect"] == "object_scatter" for item in said["not_tested"])
