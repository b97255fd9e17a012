"""Effects that a twin has already: what is expected with them, and how far they are trusted."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from raytwin.diagnosis.curves import Curve
from raytwin.diagnosis.known_effects import already_there, lasting, with_found
from raytwin.diagnosis.known_laws import beside_known
from raytwin.diagnosis.nuisances import Nuisances
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
        respond=lambda asked: {0: np.ones((1, probes))},
    )


def square(problem):
    return float(problem.residual @ Nuisances(problem.factors).solve(problem.residual))


def test_a_law_that_is_off_by_a_tenth_in_some_probes_leaves_no_gap(few):
    response = 300.0 * np.random.default_rng(3).standard_normal(60)
    off = np.where(few.groups == 1, 0.1, -0.05) * response
    wrong = Few(**{**few.__dict__, "residual": few.residual + off})
    assert square(wrong) > 1e4
    found = beside_known(wrong, response[None, :])
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
    assert square(beside_known(other, response[None, :])) > 1e4


def test_a_twin_without_effects_is_left_as_it_is(few):
    assert beside_known(few, np.zeros((0, 60))) is few
