"""Strengths that a session shows outright: of an output drift, a changed gain map and a drifting dark."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.diagnosis.inference.inference import Hypothesis
from raytwin.diagnosis.judgement import strengths
from raytwin.diagnosis.model.changes import Variant
from raytwin.diagnosis.model.curves import Curve
from raytwin.generator.effects import AppliedEffect

SHAPE, FRAMES, SIGNAL_DN = (24, 24), 20, 5000.0
OUTPUT = 0.006 * np.sin(0.05 * np.arange(8 * FRAMES))


def view(output, *, signal_DN=SIGNAL_DN, noise_DN=5.0, lit=True, calibrates=False, more=0.0, behind=0.0, covered=None):
    """A series whose frames have this relative output (frame,); more: of its level, by something else, behind: an object alone."""
    frames = 100.0 + signal_DN * (1.0 + output)
    thickness_mm = None if covered is None else {"water": np.where(covered, 20.0, 0.0)}
    hidden = np.zeros(SHAPE) if covered is None else np.where(covered, behind, 0.0)
    return SimpleNamespace(
        session=SimpleNamespace(request=SimpleNamespace(beam_on=lit, thickness_mm=thickness_mm), calibrates=calibrates),
        mask=np.ones(SHAPE, dtype=bool),
        signal_DN=np.full((1, 1), signal_DN),
        residual_DN=signal_DN * (float(output.mean()) + more + hidden),
        noise_DN=np.full(SHAPE, noise_DN / math.sqrt(len(output))),
        summary=SimpleNamespace(frames=len(output), frame_mean_DN=frames),
    )


def hypothesis(effects, *, strength=1.0, since="always"):
    """Effects at a strength, whose responses nothing reads."""
    variants = [Variant(effect=name, low=0.1, high=10.0, strengths=(1.0,), since=since) for name in effects]
    return Hypothesis(
        effects=effects,
        probability=1.0,
        log_evidence=0.0,
        strengths=dict.fromkeys(effects, (strength, 0.9 * strength, 1.1 * strength)),
        variants={one.effect: Curve(variant=one, responses=np.zeros((1, 1))) for one in variants},
    )


def found(views, *, effects=("output_drift",), since="always"):
    problem = SimpleNamespace(views=views)
    return strengths._output_rms(problem, hypothesis(effects, since=since), "output_drift")


def lit_series(**more):
    return [view(part, **more) for part in np.split(OUTPUT, 8)]


def test_the_strength_is_the_rms_of_the_output_and_opaque_series_and_darks_say_nothing_of_it():
    value, low, high = found(lit_series())
    assert low == value == high
    assert value == pytest.approx(100.0 * float(OUTPUT.std()), rel=0.005)
    opaque = view(np.zeros(FRAMES), signal_DN=1e-6, more=4e5)
    black = view(np.zeros(FRAMES), signal_DN=0.0)
    dark = view(np.zeros(FRAMES), lit=False, more=0.3)
    assert found([*lit_series(), opaque, black, dark])[0] == pytest.approx(value)


def test_behind_objects_a_level_tells_of_their_thickness_and_not_of_the_output():
    left = np.arange(SHAPE[1])[None, :] < 8
    covered = np.broadcast_to(left, SHAPE)
    behind = [view(part, covered=covered, behind=0.02) for part in np.split(OUTPUT, 8)]
    assert found(behind)[0] == pytest.approx(100.0 * float(OUTPUT.std()), rel=0.005)
    # and a slab that covers the whole field tells nothing
    slabs = [view(np.zeros(FRAMES), covered=np.ones(SHAPE, dtype=bool), behind=-0.015) for _ in range(4)]
    assert found([*slabs, *behind])[0] == pytest.approx(100.0 * float(OUTPUT.std()), rel=0.005)


def test_a_drift_since_the_calibration_is_read_from_later_series():
    steady = [view(np.zeros(FRAMES), calibrates=True) for _ in range(30)]
    assert found([*steady, *lit_series()], since="calibration")[0] == pytest.approx(
        100.0 * float(OUTPUT.std()), rel=0.005
    )
    assert found([*steady, *lit_series()])[0] < 70.0 * float(OUTPUT.std())


def test_what_another_effect_does_to_levels_is_taken_off_and_much_of_it_left_out(monkeypatch):
    monkeypatch.setattr(strengths, "_applied", lambda problem, point: point.effect)
    shares = [0.004, -0.006, 0.0, 0.5, 0.0, 0.003, 0.0, -0.3]
    views = [view(part, more=share) for part, share in zip(np.split(OUTPUT, 8), shares, strict=True)]
    changes = [np.full((1, 1), share * SIGNAL_DN) for share in shares]
    monkeypatch.setattr(strengths, "map_changes", lambda problem, effects: changes)
    kept = np.concatenate([part for part, share in zip(np.split(OUTPUT, 8), shares, strict=True) if abs(share) < 0.01])
    value, _, _ = found(views, effects=("object_scatter", "output_drift"))
    assert value == pytest.approx(100.0 * float(kept.std()), rel=0.005)


def test_too_few_series_or_nothing_but_noise_leave_the_fit_its_strength():
    assert found(lit_series()[:3]) is None
    assert found([view(np.zeros(FRAMES), noise_DN=40.0) for _ in range(8)]) is None


def flats(change, *, noise=0.002, expected=None, count=3, seed=0):
    """Later flats (row, column) whose gains have changed by a relative map, and one that calibrated; expected: noise by the twin."""
    rng = np.random.default_rng(seed)
    expected = noise if expected is None else expected

    def one(added, *, calibrates=False):
        residual = SIGNAL_DN * (added + noise * rng.standard_normal(change.shape))
        return SimpleNamespace(
            session=SimpleNamespace(series=SimpleNamespace(kind="flat"), calibrates=calibrates),
            mask=np.ones(change.shape, dtype=bool),
            signal_DN=np.full(change.shape, SIGNAL_DN),
            residual_DN=residual,
            noise_DN=np.full(change.shape, expected * SIGNAL_DN),
            summary=SimpleNamespace(
                frames=10, pair_variance_DN2=np.full(change.shape, 10.0 * (noise * SIGNAL_DN) ** 2)
            ),
            expected=SimpleNamespace(
                quantum_variance_DN2=10.0 * (expected * SIGNAL_DN) ** 2, white_variance_DN2=np.zeros((1, 1))
            ),
        )

    return [one(0.0, calibrates=True), *(one(change) for _ in range(count))]


def map_rms(views, *, effects=("gain_map_error",)):
    return strengths._map_rms(SimpleNamespace(views=views), hypothesis(effects), "gain_map_error")


@pytest.mark.parametrize("pattern", ["pixels", "stripes", "smooth", "all"])
def test_the_strength_of_a_changed_gain_map_is_its_rms_whatever_its_structure(pattern):
    rng = np.random.default_rng(5)
    side = 96
    parts = {
        "pixels": rng.standard_normal((side, side)),
        "stripes": np.repeat(rng.standard_normal(side // 4), 4)[None, :] * np.ones((side, 1)),
        "smooth": np.sin(np.arange(side) / 15.0)[:, None] * np.ones((1, side)),
    }
    change = sum(parts.values()) if pattern == "all" else parts[pattern]
    change = 0.006 * (change - change.mean()) / change.std()
    value, low, high = map_rms(flats(change))
    assert value == pytest.approx(0.6, rel=0.02) and low < 0.6 < high < 0.65


def test_noise_that_the_twin_does_not_expect_is_no_pattern():
    change = 0.002 * np.random.default_rng(1).standard_normal((96, 96))
    value, low, high = map_rms(flats(change, noise=0.008, expected=0.006, count=6))
    assert low < 0.2 < high and value == pytest.approx(0.2, rel=0.2)


def test_noise_alone_and_a_second_effect_of_the_same_maps_give_no_strength():
    assert map_rms(flats(np.zeros((96, 96)))) is None
    assert map_rms(flats(np.zeros((96, 96)))[:1]) is None
    change = 0.006 * np.random.default_rng(1).standard_normal((96, 96))
    assert map_rms(flats(change), effects=("gain_map_error", "tile_gain")) is None


def test_what_another_effect_changes_is_subtracted_and_its_law_may_be_off(monkeypatch):
    change = 0.006 * np.random.default_rng(1).standard_normal((96, 96))
    heel = 0.05 * np.linspace(-1.0, 1.0, 96)[:, None] * np.ones((1, 96))
    views = flats(change + heel)
    monkeypatch.setattr(strengths, "map_changes", lambda problem, applied: [heel * SIGNAL_DN for _ in views])
    monkeypatch.setattr(strengths, "_applied", lambda *given: given)
    alone = map_rms(flats(change))
    beside = map_rms(views, effects=("gain_map_error", "heel"))
    # 0.12 of a heel of 2.9 % rms is half of what the map has by itself
    assert beside[0] == pytest.approx(alone[0], rel=0.02) and beside[2] > 1.2 * alone[2]


def dark(start_s, change_DN, *, exposure_ms=100.0, calibrates=False, noise_DN=3.0):
    return SimpleNamespace(
        session=SimpleNamespace(
            series=SimpleNamespace(kind="dark"),
            request=SimpleNamespace(exposure_ms=exposure_ms, start_s=start_s),
            calibrates=calibrates,
        ),
        mask=np.ones(SHAPE, dtype=bool),
        residual_DN=np.full(SHAPE, change_DN),
        noise_DN=np.full(SHAPE, noise_DN / math.sqrt(FRAMES)),
        summary=SimpleNamespace(frames=FRAMES),
    )


def test_a_drifting_dark_is_read_off_the_last_one_of_the_longest_exposure(monkeypatch):
    """Half of the drift by noon, all of it in the evening; what lag leaves there is subtracted."""
    moved = {"dark_drift": [0.0, 2.5, 5.0, 1.25], "image_lag": [0.0, 0.0, 2.0, 0.0]}
    early = {10.0: 0.0, 0.1: 0.0}  # share of the drift by the calibrating darks, by the law's course

    def applied(problem, point):
        return AppliedEffect(id=point.effect, parameters={"strength": point.strength}, since="always")

    def changes(problem, effects):
        share = 1.0 - early.get(effects[0].parameters.get("warm_up"), 0.0)
        return [np.full((1, 1), share * one) for one in moved[effects[0].id]]

    monkeypatch.setattr(strengths, "_applied", applied)
    monkeypatch.setattr(strengths, "map_changes", changes)

    def read(views, *effects):
        return strengths._last_dark(SimpleNamespace(views=views), hypothesis(effects, strength=5.0), "dark_drift")

    darks = [dark(0.0, 0.0, calibrates=True), dark(100.0, 7.0), dark(200.0, 12.0), dark(300.0, 9.0, exposure_ms=25.0)]
    value, low, high = read(darks, "dark_drift")
    assert value == pytest.approx(12.0)
    assert high - value == value - low == pytest.approx(1.96 * 0.25, rel=0.05)
    assert read(darks, "dark_drift", "image_lag")[0] == pytest.approx(10.0)
    # a course that may have been over a third before it began leaves the rest open
    early[0.1] = 0.3
    assert read(darks, "dark_drift")[2] - 12.0 == pytest.approx(1.96 * math.hypot(0.25, 12.0 * 0.3 / 12**0.5), rel=0.05)
    # nothing, the other way, and no later dark leave the fit its strength
    assert read([*darks[:2], dark(200.0, 0.1), darks[3]], "dark_drift") is None
    assert read([*darks[:2], dark(200.0, -12.0), darks[3]], "dark_drift") is None
    assert read(darks[:1], "dark_drift") is None
