"""Dark and gain map of calibrating series, and what changes of the forward model can move."""

import math
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from raytwin.acquisition.setting import setting_from_text
from raytwin.api._given import as_twin
from raytwin.calibration.flats.setting_errors import EXPOSURE_SD_MS
from raytwin.calibration.spectrum.priors import PRIORS
from raytwin.diagnosis.model import changes as scales
from raytwin.diagnosis.model.calibrated_maps import calibrated_maps
from raytwin.diagnosis.model.changes import Change, catalogue_variants, departures_found, twin_changes
from raytwin.diagnosis.model.forward_model import ForwardModel, strength_rows
from raytwin.diagnosis.model.placing import inside
from raytwin.diagnosis.probes.registration import Placement
from raytwin.diagnosis.problem.nuisance_columns import nuisances_of_series
from raytwin.diagnosis.problem.other_scenes import Redrawn
from raytwin.diagnosis.problem.series_probes import variance_of_what_came
from raytwin.diagnosis.session.even_maps import compact, full_size
from raytwin.diagnosis.session.preparation import _taken_in
from raytwin.errors import InputError
from raytwin.generator.effects import AppliedEffect
from raytwin.generator.effects.misregistration import parts_px
from raytwin.generator.line.series_request import SeriesRequest
from raytwin.generator.line.twin import Estimate, OtherSpread
from raytwin.generator.spread.psf import Spread

SHAPE = (12, 16)
GOOD = np.ones(SHAPE, dtype=bool)


def series(name, kind, *, exposure_ms, frames=20, calibrates=True, corrected=frozenset()):
    stated = SimpleNamespace(name=name, kind=kind, exposure_ms=exposure_ms, n_frames=frames, corrected=corrected)
    return SimpleNamespace(
        name=name, series=stated, request=SimpleNamespace(beam_on=kind in ("flat", "object")), calibrates=calibrates
    )


def expectation(signal_DN, *, quantum_DN2=0.0, white_DN2=4.0):
    """What a model with all pixels alike expects."""
    one = np.ones((1, 1))
    return SimpleNamespace(
        signal_DN=signal_DN * one, quantum_variance_DN2=quantum_DN2 * one, white_variance_DN2=white_DN2 * one
    )


def twin(dark_DN=7.0):
    maps = SimpleNamespace(
        shape=SHAPE,
        dark_at=lambda exposure_ms: np.full(SHAPE, dark_DN, np.float32),
        gain_relative=np.full(SHAPE, 1.1, np.float32),
    )
    return SimpleNamespace(maps=maps, levels=())


def maps_of(kept, means_DN, expected, copies=MappingProxyType({})):
    """Dark and gain map; copies: frames of a series that are copies of others, by name."""
    seen = [
        SimpleNamespace(
            name=item.name,
            session=item,
            expected=expected.get(item.name, expectation(1000.0)),
            look=SimpleNamespace(
                mean_DN=means_DN.get(item.name), frames=item.series.n_frames - copies.get(item.name, 0)
            ),
        )
        for item in kept
    ]
    return calibrated_maps(seen, twin=twin(), good=GOOD)


def test_another_spread_that_calibration_leaves_open_is_a_nuisance_as_large_as_it_is_probable():
    plain = as_twin("virtual_lab")
    other = OtherSpread(
        family="exponential", probability=0.25, value=Spread(sigma_px=0.5, tail_share=0.2, tail_order=1.5)
    )
    known = replace(plain.noise.spread, others=(other,))
    named = {item.label: item for item in twin_changes(replace(plain, noise=replace(plain.noise, spread=known)))}
    step = named["optical spread as exponential"]
    assert step.twin.noise.spread.value == other.value
    # a whole step costs what the other spread's probability does
    assert 0.5 * step.step_sd**2 == pytest.approx(math.log(4.0))
    likely = replace(known, others=(replace(other, probability=0.9),))
    again = {item.label: item for item in twin_changes(replace(plain, noise=replace(plain.noise, spread=likely)))}
    assert again["optical spread as exponential"].step_sd == 1.0
    assert set(named) - {item.label for item in twin_changes(plain)} == {step.label}


def test_a_tail_that_calibration_took_in_is_told_in_pixels_of_the_panel():
    plain = as_twin("virtual_lab")
    share = Estimate(value=0.213, low=0.15, high=0.27)
    tail = replace(
        plain.noise.spread,
        value=Spread(sigma_px=0.3, tail_share=0.213, tail_px=2.1),
        intervals={**plain.noise.spread.intervals, "tail_share": share},
    )
    (text,) = _taken_in(replace(plain, noise=replace(plain.noise, spread=tail)), factor=2)
    assert "21 % (95 %: 15 to 27)" in text and "4.2 px" in text
    none = replace(plain.noise.spread, value=Spread(sigma_px=0.3))
    assert _taken_in(replace(plain, noise=replace(plain.noise, spread=none)), factor=1) == ()


def test_steps_of_a_tail_that_takes_nearly_all_light_stay_spreads():
    plain = as_twin("virtual_lab")
    spread = replace(plain.noise.spread, value=Spread(sigma_px=0.3, tail_share=0.99, tail_px=0.5))
    named = {item.label: item for item in twin_changes(replace(plain, noise=replace(plain.noise, spread=spread)))}
    step = named["tail_share of the optical spread"].twin.noise.spread.value
    assert step.tail_share == pytest.approx(0.95 * 0.99, abs=1e-3)


def test_flats_without_light_make_no_gain_map():
    flat = series("flat", "flat", exposure_ms=50.0)
    with pytest.raises(InputError, match="gain map of the calibrating flats: got 0 pixels that see light"):
        maps_of([flat], {"flat": np.full(SHAPE, -900.0)}, {"flat": expectation(1000.0)})


@given(
    exposures_ms=st.lists(st.floats(1.0, 500.0), min_size=2, max_size=5, unique=True).filter(
        lambda values: max(values) > 1.01 * min(values)
    ),
    frames=st.lists(st.integers(1, 100), min_size=5, max_size=5),
    asked_ms=st.floats(1.0, 500.0),
)
def test_a_dark_that_grows_evenly_with_the_exposure_is_known_at_any(exposures_ms, frames, asked_ms):
    offset = 100.0 + np.arange(np.prod(SHAPE), dtype=float).reshape(SHAPE)
    darks = [
        series(f"dark{k}", "dark", exposure_ms=ms, frames=n)
        for k, (ms, n) in enumerate(zip(exposures_ms, frames, strict=False))
    ]
    scene = series("scene", "object", exposure_ms=asked_ms, calibrates=False)
    means = {item.name: offset + 0.02 * item.series.exposure_ms for item in darks}
    maps = maps_of([*darks, scene], means, {item.name: expectation(0.0) for item in darks})
    assert sum(maps.darks.weights[asked_ms].values()) == pytest.approx(1.0)
    np.testing.assert_allclose(maps.darks.under(scene), offset + 0.02 * asked_ms, rtol=1e-6)


def test_darks_of_the_same_exposure_average_and_their_noise_falls_with_the_frames():
    darks = [series("few", "dark", exposure_ms=50.0, frames=10), series("many", "dark", exposure_ms=50.0, frames=30)]
    scene = series("scene", "object", exposure_ms=50.0, calibrates=False)
    means = {"few": np.full(SHAPE, 100.0), "many": np.full(SHAPE, 104.0)}
    maps = maps_of([*darks, scene], means, {item.name: expectation(0.0, white_DN2=4.0) for item in darks})
    np.testing.assert_allclose(maps.darks.under(scene), 103.0)
    assert maps.dark_noise(scene, np.array(1000.0)) == pytest.approx(4.0 / 40)
    copied = maps_of(
        [*darks, scene], means, {item.name: expectation(0.0, white_DN2=4.0) for item in darks}, copies={"many": 20}
    )
    np.testing.assert_allclose(copied.darks.under(scene), 102.0)
    assert copied.dark_noise(scene, np.array(1000.0)) == pytest.approx(4.0 / 20)


def test_without_calibrating_series_dark_and_gain_are_the_twins_and_corrected_series_stay():
    scene = series("scene", "object", exposure_ms=50.0, calibrates=False)
    done = series("done", "object", exposure_ms=50.0, calibrates=False, corrected=frozenset(("offset", "gain")))
    maps = maps_of([scene, done], {}, {})
    assert maps.shares == {}
    np.testing.assert_allclose(maps.corrected(scene, np.full(SHAPE, 1107.0)), 1000.0, rtol=1e-6)
    np.testing.assert_array_equal(maps.corrected(done, np.full(SHAPE, 1107.0)), 1107.0)
    assert maps.dark_noise(done, np.array(1000.0)) == 0.0


def test_the_gain_map_weighs_flats_by_signal_to_noise_and_shows_what_the_model_does_not():
    gain = np.linspace(0.8, 1.2, np.prod(SHAPE)).reshape(SHAPE)
    gain[3, 4] = 0.0  # a dead pixel
    dark = series("dark", "dark", exposure_ms=50.0)
    flats = [series("weak", "flat", exposure_ms=50.0), series("strong", "flat", exposure_ms=50.0)]
    expected = {
        "dark": expectation(0.0, white_DN2=0.0),
        "weak": expectation(1000.0, quantum_DN2=1000.0, white_DN2=0.0),
        "strong": expectation(3000.0, quantum_DN2=3000.0, white_DN2=0.0),
    }
    means = {"dark": np.full(SHAPE, 50.0), "weak": 50.0 + 1000.0 * gain, "strong": 50.0 + 3000.0 * gain}
    maps = maps_of([dark, *flats], means, expected)
    assert maps.shares == pytest.approx({"weak": 0.25, "strong": 0.75})
    np.testing.assert_allclose(maps.gain, gain, atol=1e-12)
    # as of one flat of all the quanta: 20 frames of 4000
    assert maps.gain_quantum == pytest.approx(1.0 / (20 * 4000.0))
    assert maps.gain_white == 0.0
    # copies bring no quanta: of one flat of those that are left
    fewer = maps_of([dark, *flats], means, expected, copies={"weak": 4, "strong": 12})
    quanta = {"weak": 16 * 1000.0, "strong": 8 * 3000.0}
    assert fewer.gain_quantum == pytest.approx(1.0 / sum(quanta.values()))
    assert fewer.shares == pytest.approx({name: one / sum(quanta.values()) for name, one in quanta.items()})
    assert [tuple(place) for place in np.argwhere(~maps.good)] == [(3, 4)]


@pytest.mark.parametrize("signal_DN", [100.0, 1000.0, 2500.0])
def test_noise_of_darks_that_the_gain_map_has_too_is_not_counted_twice(signal_DN):
    rng = np.random.default_rng(4)
    dark = series("dark", "dark", exposure_ms=50.0, frames=10)
    flats = [series("weak", "flat", exposure_ms=50.0), series("strong", "flat", exposure_ms=50.0)]
    scene = series("scene", "object", exposure_ms=50.0, calibrates=False)
    expected = {
        "dark": expectation(0.0, white_DN2=90.0),
        "weak": expectation(500.0, quantum_DN2=1.0, white_DN2=0.0),
        "strong": expectation(1500.0, quantum_DN2=1.0, white_DN2=0.0),
    }
    left = []
    for _ in range(60):
        means = {"dark": 50.0 + 3.0 * rng.standard_normal(SHAPE)}
        means |= {"weak": np.full(SHAPE, 550.0), "strong": np.full(SHAPE, 1550.0)}
        maps = maps_of([dark, *flats, scene], means, expected)
        left.append(maps.corrected(scene, np.full(SHAPE, 50.0 + signal_DN)) - signal_DN)
    predicted = maps.dark_noise(scene, np.full(SHAPE, signal_DN))
    assert np.mean(predicted) == pytest.approx(float(np.mean(np.square(left))), rel=0.05)
    # as bright as the flats it nearly cancels; 3 DN squared is what is subtracted
    assert (np.mean(predicted) < 0.6) == (signal_DN == 1000.0)


def test_maps_that_are_the_same_everywhere_become_one_pixel_and_come_back():
    even = np.full(SHAPE, 3.0)
    assert compact(even, 1.0).shape == (1, 1)
    np.testing.assert_array_equal(full_size(compact(even, 1.0), SHAPE), even)
    even[2, 2] += 1e-3
    assert compact(even, 1.0).shape == SHAPE


def test_a_displaced_scene_is_compared_where_its_picture_covers_the_panel():
    mask = np.ones((40, 50), dtype=bool)
    covered = inside(mask, Placement(row_px=1.2, column_px=-3.4, row_sd_px=0.01, column_sd_px=0.01))
    assert covered[6:-6, 6:-6].all()
    assert covered.sum() == (40 - 12) * (50 - 12)


def test_strengths_of_variants_lie_one_after_the_other():
    variants = catalogue_variants()
    every = [(variant, strength) for variant in variants for strength in variant.strengths]
    for variant, rows in zip(variants, strength_rows(variants), strict=True):
        assert every[rows] == [(variant, strength) for strength in variant.strengths]


def request(kind, *, after=True, previous=()):
    setting = None if kind == "dark" else setting_from_text("kv=80,current_ma=1,exposure_ms=50")
    return SeriesRequest(
        kind=kind, setting=setting, frames=10, exposure_ms=50.0, after_calibration=after, previous=previous
    )


def changed(effect, *, since="always", **parameters):
    return Change(label=effect, twin=None, effects=(AppliedEffect(id=effect, parameters=parameters, since=since),))


def test_a_change_touches_what_its_effect_can_show_and_only_after_it_began():
    scatter = changed("object_scatter", strength=0.05)
    assert scatter.touches(request("object"))
    assert not scatter.touches(request("flat"))
    late = changed("dark_drift", since="calibration", strength=2.0)
    assert late.touches(request("dark"))
    assert not late.touches(request("dark", after=False))
    beam = Change(label="log_output", twin=None, steps="lit")
    assert beam.touches(request("flat"))
    assert not beam.touches(request("dark"))


def test_a_shift_of_the_scene_is_its_displacement_and_a_change_of_size_is_not():
    shift = changed("misregistration", strength=2.0, direction_deg=30.0, magnification_deg=0.0)
    assert shift.only_displaces
    assert not shift.touches(request("object"))
    assert shift.displacement == pytest.approx(
        {"displacement along rows": math.sqrt(3.0), "displacement along columns": 1.0}
    )
    larger = changed("misregistration", strength=2.0, direction_deg=0.0, magnification_deg=90.0)
    assert not larger.only_displaces
    assert larger.touches(request("object"))
    assert larger.displacement == pytest.approx({"displacement along rows": 0.0, "displacement along columns": 0.0})


def test_once_a_scene_is_found_its_size_and_turn_are_left_of_a_misregistration():
    mixed = changed("misregistration", strength=2.0, direction_deg=90.0, magnification_deg=-30.0, rotation_deg=40.0)
    straight = 2.0 * math.cos(math.radians(40.0))
    assert mixed.displacement == pytest.approx(
        {"displacement along rows": 0.0, "displacement along columns": straight * math.cos(math.radians(30.0))},
        abs=1e-12,
    )
    (rest,) = mixed.found_in_place().effects
    angles = {name: rest.parameters[name] for name in ("magnification_deg", "rotation_deg")}
    shift, radial, turn = parts_px(rest.parameters["strength"], **angles)
    assert shift == pytest.approx(0.0, abs=1e-12)
    assert radial == pytest.approx(-straight * math.sin(math.radians(30.0)))
    assert turn == pytest.approx(2.0 * math.sin(math.radians(40.0)))
    shift = changed("misregistration", strength=2.0, direction_deg=10.0)
    assert shift.found_in_place() is shift  # nothing of it shows


def test_how_far_a_moving_object_is_carried_is_told_against_the_base_twin():
    def motion(strength, mean_place):
        return AppliedEffect(
            id="motion_blur", parameters={"strength": strength, "mean_place": mean_place}, since="always"
        )

    still = replace(as_twin("virtual_lab"), effects=())
    seen = replace(request("object"), exposure_ms=100.0, belt_axis="column")
    model = ForwardModel(base=still, conditions={})
    # 4 px in 50 ms, half of them before the middle
    assert model.carried_px(model.with_found([motion(4.0, 0.5)]), seen) == pytest.approx((0.0, 4.0))
    assert model.carried_px(model.unchanged, seen) == (0.0, 0.0)
    known = ForwardModel(base=replace(still, effects=(motion(4.0, 0.25),)), conditions={})
    assert known.carried_px(known.with_found([motion(4.0, 0.5)]), seen) == pytest.approx((0.0, 2.0))
    assert known.carried_px(known.without("motion_blur"), seen) == pytest.approx((0.0, -2.0))


def test_an_effect_that_began_earlier_stands_for_a_later_one_unless_what_came_before_remembers():
    lag = {since: changed("image_lag", since=since, strength=0.01) for since in ("always", "calibration")}
    later = request("flat", previous=(request("flat"),))
    assert lag["always"].whenever_it_began(later) == lag["calibration"].whenever_it_began(later) is not None
    first = request("flat", previous=(request("flat", after=False),))
    assert lag["always"].whenever_it_began(first) is None
    # what fades in hours remembers what lag has long forgotten
    late = replace(later, long_ago=(request("flat", after=False),))
    assert lag["always"].whenever_it_began(late) is not None
    assert changed("burn_in", strength=0.01).whenever_it_began(later) is not None
    assert changed("burn_in", strength=0.01).whenever_it_began(late) is None
    # a heel looks otherwise where calibration has seen it
    assert changed("heel", strength=0.01).whenever_it_began(later) is None


def test_light_that_no_model_expects_brings_its_own_noise():
    """A panel that counts has none in a deep shadow; what strays there comes in quanta."""
    signal = np.where(np.arange(32)[None, :] < 16, 1000.0, 0.0) * np.ones((32, 1))
    found = variance_of_what_came(2.0 * signal, signal, signal + 40.0)
    assert found[:, :12] == pytest.approx(np.full((32, 12), 2080.0))
    assert found[:, 20:] == pytest.approx(np.full((32, 12), 80.0))


@pytest.mark.parametrize("own_maps", [True, False])
def test_a_heel_that_was_always_there_is_asked_of_the_series_that_make_the_maps(make_model_twin, own_maps):
    """A gain map is one for all beams; the twin's own maps hold it beam by beam."""
    model = ForwardModel(base=make_model_twin((24, 24)), conditions={}, own_maps=own_maps)
    setting = setting_from_text("kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05")
    calibrating = SeriesRequest(kind="flat", setting=setting, frames=6, exposure_ms=20.0, after_calibration=False)
    turned = replace(calibrating, panel_rotation_deg=180.0, after_calibration=True)
    heel = AppliedEffect(
        id="heel", parameters={"strength": 10.0, "direction_deg": 90.0, "curvature": 0.0}, since="always"
    )
    change = Change(label="heel", twin=model.base, effects=(heel,))

    def across(request):
        alone = model.expect(request)
        ratio = full_size(model.expect_changed(request, change, alone).signal_DN, (24, 24)) / full_size(
            alone.signal_DN, (24, 24)
        )
        return float(ratio[:, -1].mean() / ratio[:, 0].mean() - 1.0)

    once = across(calibrating)
    assert once == (pytest.approx(-0.07, abs=0.03) if own_maps else 0.0)
    # with it in the maps already the turned panel shows it twice
    assert across(turned) == pytest.approx(0.08 if own_maps else 0.16, abs=0.03)


@pytest.mark.parametrize(("deviation_sd", "grown"), [(0.5, 1.0), (2.5, 2.5)])
def test_departures_that_calibration_found_widen_what_beams_may_differ_by(make_model_twin, deviation_sd, grown):
    base = make_model_twin((24, 24))
    names = base.spectral.names
    samples = np.repeat(base.spectral.best[None], 2, axis=0)
    hardness = deviation_sd * PRIORS["hardness_exponent"].sd
    samples[:, names.index("hardness_exponent")] = [hardness - 0.05, hardness + 0.05]
    samples[:, names.index("kV_error")] = 0.05  # no departure from tables and models
    found = departures_found(replace(base.spectral, samples=samples))
    assert found == pytest.approx(grown)
    model = ForwardModel(base=replace(base, spectral=replace(base.spectral, samples=samples)), conditions={})
    assert model.beams_differ == pytest.approx(1.0 + scales.OF_BEAMS_GROWS * (grown - 1.0))
    assert departures_found(None) == 1.0


def test_where_beams_differ_attenuation_may_change_with_the_depth(monkeypatch):
    signal = np.array([[1000.0, 500.0, 250.0, 125.0]])
    stated = SimpleNamespace(
        name="wedge_80kV", kind="object", scene="wedge", kV=80.0, filters=(), source_object_mm=None
    )
    item = SimpleNamespace(
        series=stated,
        name="wedge_80kV",
        request=SimpleNamespace(beam_on=True, source_object_mm=None, exposure_ms=20.0),
        own_noise=False,
        divided=False,
        calibrates=True,
    )
    thinner = -0.01 * signal * np.log(1000.0 / signal)  # of one material 1 % thicker
    probes = SimpleNamespace(
        series=SimpleNamespace(
            session=item,
            scalars={},
            context=SimpleNamespace(label_names=(), label_gain=()),
            expected=SimpleNamespace(noise_autocovariance=np.ones((1, 1))),
        ),
        scalars=(),
        projection=SimpleNamespace(apply=lambda image: np.asarray(image, dtype=float).ravel()),
        of_maps=lambda images: np.asarray(images, dtype=float).reshape(len(images), -1),
        of_scalars=lambda change: np.zeros(4),
        shrink=np.ones(4),
        rendered=0.1,
    )
    monkeypatch.setattr("raytwin.diagnosis.problem.nuisance_columns._read_texture", lambda *_: np.zeros(4))
    monkeypatch.setattr("raytwin.diagnosis.problem.nuisance_columns._of_scene", lambda *_, **__: {})
    monkeypatch.setattr("raytwin.diagnosis.problem.nuisance_columns.declared_spot_px", lambda *_: 0.0)
    monkeypatch.setattr("raytwin.diagnosis.problem.nuisance_columns.gradient", lambda image: (image, image))

    def columns(beams_differ):
        model = SimpleNamespace(sharp=False, beams_differ=beams_differ, base=None)
        session = SimpleNamespace(model=model, maps=SimpleNamespace(shares={}))
        return nuisances_of_series(session, probes, signal, Redrawn(thicker={"Al": (thinner, {})}, covered=None))

    usual, wider = columns(1.0), columns(3.0)
    # all exposures longer or shorter than stated
    np.testing.assert_allclose(usual["length of exposures"], EXPOSURE_SD_MS / 20.0 * signal.ravel())
    name = "hardness at 80 kV behind Al"
    assert name not in usual
    of_beam = 3.0 * scales.ATTENUATION_OF_BEAM_SD / scales.THICKNESS_SD
    np.testing.assert_allclose(wider["attenuation of Al at 80 kV"], of_beam * thinner[0])
    np.testing.assert_allclose(wider[name], of_beam * (thinner * np.log(1000.0 / signal))[0])
    np.testing.assert_allclose(wider["level of 80 kV "], 3.0 * usual["level of 80 kV "])
    np.testing.assert_allclose(wider["thickness of Al in wedge"], usual["thickness of Al in wedge"])
