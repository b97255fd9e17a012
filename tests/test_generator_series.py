"""The forward model of a series without effects: levels, scenes, noise, borders, and samples against expectation."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from raytwin.acquisition.setting import Setting, filters_from_text, setting_from_text
from raytwin.errors import FileFormatError, InputError
from raytwin.generator.effects import EFFECTS, AppliedEffect
from raytwin.generator.frames._spread import noise_pattern
from raytwin.generator.frames.line_model import LineMemory, LineModel
from raytwin.generator.frames.model_cache import ModelCache
from raytwin.generator.line.line_state import LineState
from raytwin.generator.line.series_request import SeriesRequest
from raytwin.generator.line.spectral_signal import OpenBeam
from raytwin.generator.line.twin import gaussian_spread
from raytwin.generator.line.twin_spectrum import slope_over_gain, white_gain_DN
from raytwin.generator.predictions.predict import predict_flatfield, spectral_model_of
from raytwin.generator.spread._fine_picture import cell_coverage, find_borders, sampled_picture, transform_of_cells
from raytwin.generator.spread.psf import Spread, noise_autocovariance_1d
from raytwin.generator.twins.twin_io import read_twin, write_twin

SHAPE = (40, 40)
MEASURED = "kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05"


def request(kind="flat", setting=MEASURED, **changes):
    parsed = None if setting is None else setting_from_text(setting)
    values = {
        "kind": kind,
        "setting": parsed,
        "frames": 10,
        "exposure_ms": 20.0 if parsed is None else parsed.exposure_ms,
        "frame_interval_ms": 22.0,
        "source_object_mm": 990.0,
        "source_detector_mm": 1059.0,
    }
    return SeriesRequest(**{**values, **changes})


def slab(water_mm=10.0, aluminium_mm=0.5):
    return {"water_liquid": np.full(SHAPE, water_mm), "Al": np.full(SHAPE, aluminium_mm)}


def product():
    row, column = np.indices(SHAPE)
    radius = np.hypot(row - 20, column - 20)
    return {
        "water_liquid": 20 * np.sqrt(np.clip(1 - (radius / 16) ** 2, 0, None)),
        "Al": np.where((column > 24) & (row > 12), 3.0, 0.0),
    }


# ------------------------------------------------------------------------------------------------ level and noise


@pytest.mark.parametrize("averaged", [1, 8])
def test_a_flat_at_a_measured_level_is_the_predicted_flatfield(series_line, averaged):
    asked = request(setting=f"{MEASURED},averaged={averaged}", frame_interval_ms=None)
    found = LineModel(series_line).expect(asked)
    predicted = predict_flatfield(series_line, asked.setting)
    shape = series_line.levels[0].flat_shape
    np.testing.assert_allclose(found.signal_DN, predicted.mean_DN.value * shape, rtol=1e-5)
    # one pixel of flat shape and relative gain 1; rounding of single exposures is in both
    variance = found.quantum_variance_DN2 / (shape * series_line.maps.gain_relative)
    quantum = predicted.sd_DN.value**2 - series_line.noise.read_variance_DN2 / averaged
    white = found.white_variance_DN2 - series_line.noise.read_variance_DN2 / averaged
    white = white / (shape * series_line.maps.gain_relative)
    np.testing.assert_allclose(variance + white, quantum, rtol=1e-4)


def test_an_unmeasured_beam_is_the_spectral_model_at_its_best(series_line):
    setting = setting_from_text("kv=60,current_ma=0.5,exposure_ms=20,filter=Al:2")
    found = LineModel(series_line).expect(request(setting=str(setting)))
    model = spectral_model_of(series_line)
    beam = OpenBeam(kV=60.0, filters=setting.filters)
    exact = model.signal(series_line.spectral.best[None, :], beam)
    factor = setting.tube_load_mAs * (1000 / 1059) ** 2 * 0.15**2
    assert np.median(found.signal_DN) == pytest.approx(
        exact.rate_DN_per_mAs[0] * factor * np.median(series_line.levels[0].flat_shape), rel=1e-6
    )
    both = found.quantum_variance_DN2 + found.white_variance_DN2 - series_line.noise.read_variance_DN2
    share = slope_over_gain(series_line.levels, series_line.noise, exact.gain_DN)[0]
    expected = exact.gain_DN[0] * share * found.signal_DN * series_line.maps.gain_relative
    np.testing.assert_allclose(both, expected, rtol=1e-5)


@pytest.mark.parametrize(
    "text", ["kv=50,current_ma=1,exposure_ms=20", "kv=120,current_ma=1,exposure_ms=20,filter=Cu:0.5"]
)
def test_noise_of_an_unmeasured_beam_is_as_predicted(make_model_twin, text):
    """Secondary quanta add the same for each DN of signal in every beam, here as in `predict_flatfield`."""
    twin = make_model_twin((24, 24))
    found = LineModel(twin).expect(request(setting=text))
    predicted = predict_flatfield(twin, setting_from_text(text))
    variance = float(np.median(found.quantum_variance_DN2 + found.white_variance_DN2))
    assert variance == pytest.approx(predicted.sd_DN.value**2, rel=1e-4)
    white = (found.white_variance_DN2 - twin.noise.read_variance_DN2) / found.signal_DN
    np.testing.assert_allclose(white, white_gain_DN(twin, 0.0), rtol=1e-3)


def test_noise_of_secondary_quanta_follows_the_signal_behind_a_hardening_slab(make_model_twin):
    twin = make_model_twin((24, 24))
    behind = {"Al": np.full((24, 24), 10.0)}
    slab, flat = (
        LineModel(twin).expect(request(kind, thickness_mm=maps)) for kind, maps in (("object", behind), ("flat", {}))
    )
    white = [(one.white_variance_DN2 - twin.noise.read_variance_DN2) / one.signal_DN for one in (slab, flat)]
    np.testing.assert_allclose(white[0], white[1], rtol=1e-2)
    quantum = [float(np.median(one.quantum_variance_DN2 / one.signal_DN)) for one in (slab, flat)]
    assert quantum[0] > 1.03 * quantum[1]


def test_a_slab_attenuates_as_the_exact_sum_over_energies(series_line):
    asked = request("object", thickness_mm=slab())
    found = LineModel(series_line).expect(asked).signal_DN / LineModel(series_line).expect(request()).signal_DN
    model = spectral_model_of(series_line)
    beam = OpenBeam(kV=90.0, filters=filters_from_text("Cu:0.05"))
    weights = model.moment_weights(series_line.spectral.best, beam)[0]
    top = weights.size
    depth = 10.0 * model.mu("water_liquid")[:top] + 0.5 * model.mu("Al")[:top]
    exact = float(weights @ np.exp(-depth) / weights.sum())
    np.testing.assert_allclose(found, exact, rtol=1e-4)


def test_signal_falls_with_the_square_of_the_distance(series_line):
    near = LineModel(series_line).expect(request())
    far = LineModel(series_line).expect(request(source_detector_mm=2 * 1059.0))
    np.testing.assert_allclose(near.signal_DN, 4 * far.signal_DN, rtol=1e-9)


def test_scales_of_the_spectrum_scale_signal_and_variance(series_line):
    """gamma e^d: signal e^d, variance e^2d; the projection behind a scene is not made again."""
    cache = ModelCache()
    asked = request("object", thickness_mm=product())
    base = LineModel(series_line, cache=cache).expect(asked)
    changed = series_line.spectral.best.copy()
    changed[series_line.spectral.names.index("log_DN_per_keV")] += 0.02
    found = LineModel(series_line, parameters=changed, cache=cache).expect(asked)
    np.testing.assert_allclose(found.signal_DN, base.signal_DN * math.exp(0.02), rtol=1e-9)
    np.testing.assert_allclose(found.quantum_variance_DN2, base.quantum_variance_DN2 * math.exp(0.04), rtol=1e-9)


def test_averaging_n_exposures_divides_all_noise_by_n(series_line):
    one = LineModel(series_line).expect(request())
    many = LineModel(series_line).expect(request(setting=f"{MEASURED},averaged=16", frame_interval_ms=352.0))
    np.testing.assert_allclose(many.mean_DN, one.mean_DN, rtol=1e-12)
    np.testing.assert_allclose(many.quantum_variance_DN2, one.quantum_variance_DN2 / 16, rtol=1e-12)
    np.testing.assert_allclose(many.white_variance_DN2, one.white_variance_DN2 / 16, rtol=1e-12)


@pytest.mark.parametrize("kind", ["dark", "afterglow"])
def test_without_beam_and_without_lag_there_is_the_dark_alone(series_line, kind):
    found = LineModel(series_line).expect(request(kind, setting=None, exposure_ms=100.0))
    np.testing.assert_allclose(found.mean_DN, 1200.0 + 0.1 * 80.0, rtol=1e-6)
    np.testing.assert_allclose(found.white_variance_DN2, 12.0**2 + 1 / 12, rtol=1e-6)
    assert np.all(found.signal_DN == 0) and np.all(found.quantum_variance_DN2 == 0)


def test_a_declared_open_level_stands_in_for_an_unknown_tube_load(series_line):
    asked = request(setting="kv=90,exposure_ms=20,filter=Cu:0.05", open_signal_DN=5000.0)
    found = LineModel(series_line).expect(asked)
    np.testing.assert_allclose(found.signal_DN, 5000.0 * series_line.levels[1].flat_shape, rtol=1e-6)


def test_a_twin_without_spectrum_still_knows_its_measured_flats(series_line):
    bare = replace(series_line, spectral=None)
    one, other = LineModel(bare).expect(request()), LineModel(series_line).expect(request())
    np.testing.assert_allclose(one.mean_DN, other.mean_DN, rtol=1e-9)
    np.testing.assert_allclose(one.quantum_variance_DN2, other.quantum_variance_DN2, rtol=1e-9)


def test_the_level_at_the_end_of_the_adc_is_flagged(series_line):
    found = LineModel(series_line).expect(request(setting="kv=90,power_w=45,exposure_ms=500,filter=Cu:0.05"))
    assert found.saturated_share == 1.0
    assert np.all(found.mean_DN <= 65535)


# ------------------------------------------------------------------------------------------------ scenes


def test_a_cache_never_takes_one_scene_for_another(series_line):
    cache = ModelCache()
    for water in (1.0, 5.0, 9.0) * 3:
        # mappings are dropped at once, so that a later one may lie at the same address
        found = LineModel(series_line, cache=cache).expect(request("object", thickness_mm=slab(water)))
        fresh = LineModel(series_line).expect(request("object", thickness_mm=slab(water)))
        np.testing.assert_allclose(found.mean_DN, fresh.mean_DN, rtol=1e-12)


def test_a_small_cache_forgets_and_projects_again(series_line):
    cache = ModelCache(budget_bytes=1)
    scenes = [slab(1.0), slab(5.0)]
    first = [LineModel(series_line, cache=cache).expect(request("object", thickness_mm=item)) for item in scenes]
    again = [LineModel(series_line, cache=cache).expect(request("object", thickness_mm=item)) for item in scenes]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.mean_DN, other.mean_DN)


def slanted_edge(*, angle, offset_px=0.3, sigma_px=0.5, fine=15):
    """Opaque half plane: pixel means of what it covers, and the true picture after a continuous Gaussian spread."""
    from scipy.ndimage import gaussian_filter

    count = 40 * fine
    row, column = (np.indices((count, count)) + 0.5) / fine - 20.0
    covered = np.clip((column * math.cos(angle) + row * math.sin(angle) - offset_px) * fine + 0.5, 0, 1)

    def pixels(image):
        return image.reshape(40, fine, 40, fine).mean(axis=(1, 3))

    return pixels(covered), pixels(gaussian_filter(1.0 - covered, sigma_px * fine, mode="reflect"))


@pytest.mark.parametrize("angle", [0.0, 0.07, 0.4, math.pi / 4, 1.5, math.pi + 0.1])
def test_an_opaque_edge_is_as_a_continuous_spread_shows_it(series_line, angle):
    """Pixels that the edge cuts show the share that is open, and nothing rings beside it: within 1 % of the step.

    The mean of exp(-mu t) is not exp(-mu mean t): without care a thick plate's edge would stand half a pixel off.
    """
    covered, truth = slanted_edge(angle=angle)
    flat = LineModel(series_line).expect(request())
    found = LineModel(series_line).expect(request("object", thickness_mm={"W": 2.0 * covered}))
    error = (found.signal_DN / flat.signal_DN - truth)[4:-4, 4:-4]
    assert np.abs(error).max() < 0.01
    assert math.sqrt(np.mean(error[np.abs(truth[4:-4, 4:-4] - 0.5) < 0.49] ** 2)) < 0.004


@pytest.mark.parametrize("displacement", [(0.0, 0.37), (-1.2, 0.25), (2.0, 0.0)])
def test_a_displaced_scene_is_the_scene_drawn_elsewhere(series_line, displacement):
    angle = 0.4
    covered, _ = slanted_edge(angle=angle)
    beyond = displacement[1] * math.cos(angle) + displacement[0] * math.sin(angle)
    _, truth = slanted_edge(angle=angle, offset_px=0.3 + beyond)
    flat = LineModel(series_line).expect(request())
    asked = request("object", thickness_mm={"W": 2.0 * covered}, displacement_px=displacement)
    error = (LineModel(series_line).expect(asked).signal_DN / flat.signal_DN - truth)[6:-6, 6:-6]
    assert np.abs(error).max() < 0.01
    # a scene without sharp borders, on its pixels
    row, column = np.indices(SHAPE)

    def hill(down, right):
        return {"water_liquid": 20 * np.exp(-((row - 20 - down) ** 2 + (column - 20 - right) ** 2) / 50)}

    moved = LineModel(series_line).expect(request("object", thickness_mm=hill(0, 0), displacement_px=displacement))
    known = LineModel(series_line).expect(request("object", thickness_mm=hill(*displacement)))
    np.testing.assert_allclose(moved.signal_DN, known.signal_DN, rtol=2e-3)


@pytest.mark.parametrize("displacement", [(0.04, -0.16), (0.5, 1.3)])
def test_a_scene_of_points_is_moved_without_ringing_beside_its_steps(series_line, displacement):
    points = replace(
        series_line,
        noise=replace(
            series_line.noise, spread=gaussian_spread("sampled", series_line.noise.spread.intervals["sigma_px"])
        ),
    )
    row, column = np.indices(SHAPE)
    step = {"Al": np.where((row > 12) & (column > 14), 6.0, 0.0)}
    flat = LineModel(points).expect(request()).signal_DN

    def drawn(displacement_px):
        asked = request("object", thickness_mm=step, displacement_px=displacement_px)
        return np.asarray(LineModel(points).expect(asked).signal_DN / flat)

    still, moved = drawn((0.0, 0.0)), drawn(displacement)
    # an effect that displaces the scene draws it the same way
    size, along = math.hypot(*displacement), math.degrees(math.atan2(displacement[1], displacement[0])) % 360.0
    shifted = AppliedEffect(
        id="misregistration",
        parameters={"strength": size, "direction_deg": along, "magnification_deg": 0.0},
        since="always",
    )
    by_effect = LineModel(points, effects=(shifted,)).expect(request("object", thickness_mm=step)).signal_DN / flat
    np.testing.assert_allclose(by_effect, moved, rtol=1e-6)
    far = ndimage.distance_transform_edt(~((np.abs(row - 12.5) < 4.5) | (np.abs(column - 14.5) < 4.5))) > 0
    # nothing is brighter than the open field, nor darker than the shadow
    assert moved.max() <= still.max() * (1.0 + 1e-9) and moved.min() >= still.min() * (1.0 - 1e-9)
    # cosines of the pixels alone would leave half a per cent of the step ten pixels away from it
    np.testing.assert_allclose(moved[far], still[far], rtol=1e-4)
    # whole pixels move as they are, and the edge does move
    np.testing.assert_allclose(drawn((2.0, 0.0))[6:-6], still[4:-8], rtol=1e-9)
    assert np.abs(moved - still).max() > 0.02


@given(
    angle=st.floats(0.0, 2 * math.pi),
    covered=st.floats(1e-6, 1 - 1e-6),
)
def test_cells_of_a_cut_pixel_lie_between_open_and_covered_and_average_to_the_pixel(angle, covered):
    share = np.array([covered])
    cells = cell_coverage(np.array([math.cos(angle)]), np.array([math.sin(angle)]), share)
    assert cells.mean() == pytest.approx(covered, abs=1e-9)
    assert cells.min() > -1e-3 and cells.max() < 1 + 1e-3
    # the covered side is the one that the normal points to
    along = np.add.outer(math.cos(angle) * np.arange(-1, 2), math.sin(angle) * np.arange(-1, 2))
    assert float((along * cells[0]).sum()) >= -1e-9


def test_sampling_cells_at_pixels_is_their_mean_and_moves_by_whole_pixels():
    cells = np.random.default_rng(0).random((30, 24))
    transform = transform_of_cells(cells)
    means = cells.reshape(10, 3, 8, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(sampled_picture([(transform, None)], (10, 8), (0.0, 0.0)), means, atol=1e-12)
    moved = sampled_picture([(transform, None)], (10, 8), (2.0, -1.0))
    np.testing.assert_allclose(moved[2:, :-1], means[:-2, 1:], atol=1e-12)


@pytest.mark.parametrize("shape", [(10, 8), (8, 410)])
def test_a_picture_that_moves_is_the_mean_of_where_it_stands(shape):
    """Small panels are drawn by matrices, large ones by transforms."""
    cells = np.random.default_rng(0).random((3 * shape[0], 3 * shape[1]))
    transform = transform_of_cells(cells)
    places = (-0.8, 0.1, 0.3, 2.4)
    course = sampled_picture([(transform, None)], shape, (0.4, -0.2), (places, ()))
    stood = np.mean([sampled_picture([(transform, None)], shape, (0.4 + one, -0.2)) for one in places], axis=0)
    np.testing.assert_allclose(course, stood, atol=1e-12)
    across = sampled_picture([(transform, None)], shape, (0.0, 0.0), ((), places))
    stood = np.mean([sampled_picture([(transform, None)], shape, (0.0, one)) for one in places], axis=0)
    np.testing.assert_allclose(across, stood, atol=1e-12)


def test_a_smooth_object_has_no_borders_and_a_step_is_found_where_it_is():
    column = np.indices((30, 30))[1]
    assert not find_borders(0.05 * column, least_depth=0.02).any_steps
    depth = np.clip(column - 14.25, 0.0, 1.0) * 3.0
    found = find_borders(depth, least_depth=0.02)
    assert np.array_equal(np.unique(found.pixel % 30), [15])
    np.testing.assert_allclose(found.covered, 0.75)
    np.testing.assert_allclose(found.sharpness, 1.0)


# ------------------------------------------------------------------------------------------------ noise and samples


def test_the_general_noise_pattern_of_an_unchanged_spread_is_the_calibrated_one():
    """The path that effects take, with a factor of 1, against the closed form of `psf`."""
    one = np.ones((1, 1))
    state = LineState(
        parameters=None,
        signal_DN=one,
        variance_DN2=one,
        flat_factor=one,
        optical_transfers=(lambda f_row, f_column: np.ones(np.broadcast_shapes(f_row.shape, f_column.shape)),),
    )
    for model in ("aperture", "sampled"):
        for sigma in (0.3, 0.5, 0.9):
            found = noise_pattern(Spread(model=model, sigma_px=sigma), state)
            half = noise_autocovariance_1d(model, sigma, 3)
            assert found.share == pytest.approx(half[0] ** 2, rel=1e-6)
            np.testing.assert_allclose(found.autocovariance, np.outer(half, half) / half[0] ** 2, atol=1e-6)
            line = noise_pattern(Spread(model=model, sigma_px=sigma, axes="column"), state)
            assert line.share == pytest.approx(half[0], rel=1e-6)
            np.testing.assert_allclose(line.autocovariance, np.outer([1, 0, 0, 0], half) / half[0], atol=1e-6)


def moments(frames, expected):
    """Standardised mean (row, column), variance ratio, and covariance to the right over that expected, less 1."""
    count = len(frames)
    residual = frames - expected.mean_DN
    for image, course in expected.trend_DN or ():
        residual = residual - course[:, None, None] * image
    lines = expected.row_variance_DN2 + expected.column_variance_DN2
    variance = expected.quantum_variance_DN2 + expected.white_variance_DN2 + lines
    spread = residual - residual.mean(axis=0)
    return residual.mean(axis=0) / np.sqrt(variance / count), (spread**2).sum(axis=0) / (count - 1) / variance, spread


def test_samples_have_the_expected_mean_variance_and_covariance(series_line):
    asked = request("object", thickness_mm=product(), frames=400)
    expected = LineModel(series_line).expect(asked)
    frames = np.stack(list(LineModel(series_line).sample(asked, rng=np.random.default_rng(5)))).astype(np.float64)
    z, ratio, spread = moments(frames, expected)
    # 1600 pixels of which about one in four is independent of its neighbours
    independent = z.size / 4
    assert abs(z.std() - 1) < 4 / math.sqrt(2 * independent)
    assert abs(ratio.mean() - 1) < 4 * math.sqrt(2 / 399 / independent)
    for lag in ((0, 1), (1, 0), (1, 1)):
        left = spread[:, : 40 - lag[0], : 40 - lag[1]]
        right = spread[:, lag[0] :, lag[1] :]
        quantum = expected.quantum_variance_DN2
        seen = (left * right).mean() * 400 / 399
        known = np.sqrt(quantum[: 40 - lag[0], : 40 - lag[1]] * quantum[lag[0] :, lag[1] :]).mean()
        known *= expected.noise_autocovariance[lag]
        error = (expected.quantum_variance_DN2 + expected.white_variance_DN2).mean() / math.sqrt(400 * independent)
        assert abs(seen - known) < 4 * error


def test_few_photons_are_counted_not_gaussian(series_line):
    """At less than one quantum a pixel the third moment is that of Poisson quanta: variance x quantum x sum h^3."""
    asked = request(setting="kv=90,power_w=0.01,exposure_ms=20,filter=Cu:0.05", frames=300)
    quiet = replace(
        series_line,
        noise=replace(series_line.noise, quantised=False, white_fraction=0.0),
        maps=replace(series_line.maps, read_variance_DN2=np.zeros(SHAPE, np.float32)),
    )
    expected = LineModel(quiet).expect(asked)
    frames = np.stack(list(LineModel(quiet).sample(asked, rng=np.random.default_rng(2))))
    residual = (frames - expected.mean_DN) / np.sqrt(expected.quantum_variance_DN2)
    skewness = float((residual**3).mean())
    assert skewness > 0.5
    assert abs(float((residual**2).mean()) - 1) < 0.05


def test_the_same_seed_gives_the_same_frames_and_another_seed_others(series_line):
    asked = request("object", thickness_mm=product(), frames=2)

    def frames(seed):
        return np.stack(list(LineModel(series_line).sample(asked, rng=np.random.default_rng(seed))))

    np.testing.assert_array_equal(frames(1), frames(1))
    assert np.any(frames(1) != frames(2))


def test_samples_are_whole_numbers_within_the_adc(series_line):
    asked = request(setting="kv=90,power_w=45,exposure_ms=400,filter=Cu:0.05", frames=1)
    (frame,) = LineModel(series_line).sample(asked, rng=np.random.default_rng(0))
    assert frame.max() == 65535
    assert np.array_equal(frame, np.rint(frame))


def test_memory_is_handed_from_series_to_series(series_line):
    lag = (AppliedEffect(id="image_lag", parameters={"strength": 5.0, "release_s": 1.0}),)
    memory = LineMemory()
    rng = np.random.default_rng(3)
    exposed = request(frames=60)
    list(LineModel(series_line, effects=lag).sample(exposed, rng=rng, memory=memory))
    assert memory.time_s == pytest.approx(60 * 0.022)
    assert memory.trapped_DN.shape == (4, *SHAPE)
    after = request("afterglow", setting=None, frames=20, start_s=60 * 0.022, previous=(exposed,))
    seen = np.stack(list(LineModel(series_line, effects=lag).sample(after, rng=rng, memory=memory)))
    expected = LineModel(series_line, effects=lag).expect(after)
    assert expected.signal_DN.mean() > 50
    assert abs((seen - expected.mean_DN).mean()) < 4 * 12.0 / math.sqrt(seen.size) + 1e-3 * expected.signal_DN.mean()


@pytest.mark.parametrize("pause_stated", [True, False])
def test_traps_empty_in_pauses_that_are_stated_and_else_for_as_long_as_the_law_says(series_line, pause_stated):
    exposed = request(frames=60)
    after = request(
        "dark", setting=None, frames=1, start_s=60 * 0.022 + 2.0, previous=(exposed,), pause_stated=pause_stated
    )

    def left(idle_s):
        lag = AppliedEffect(
            id="image_lag", parameters={"strength": 5.0, "release_s": 1.0, "spread": 1.0, "idle_s": idle_s}
        )
        return float(LineModel(series_line, effects=(lag,)).expect(after).signal_DN.mean())

    assert left(2.0) > 1.0
    assert left(3.0) / left(2.0) == pytest.approx(1.0 if pause_stated else math.exp(-1.0), rel=1e-9)


# ------------------------------------------------------------------------------------------------ twin file


def test_a_twin_with_effects_comes_back_from_its_file(series_line, tmp_path):
    effects = (
        AppliedEffect(id="object_scatter", parameters={"strength": 12.5, "width_mm": 30.0}),
        AppliedEffect(id="composition_error", parameters={"strength": 2.0}, options={"material": "water_liquid"}),
        AppliedEffect(id="kv_error", parameters={"strength": -1.0}, since="calibration"),
    )
    path = tmp_path / "twin.h5"
    write_twin(path, replace(series_line, effects=effects))
    assert read_twin(path).effects == effects


def test_a_twin_file_without_effects_is_a_twin_without_effects(series_line, tmp_path):
    write_twin(tmp_path / "twin.h5", series_line)
    assert read_twin(tmp_path / "twin.h5").effects == ()


@pytest.mark.parametrize(
    "text", ["not json", '[{"id": "no_such_effect", "parameters": {}, "since": "always"}]', "[{}]"]
)
def test_a_twin_file_with_unreadable_effects_is_refused(series_line, tmp_path, text):
    import h5py

    path = tmp_path / "twin.h5"
    write_twin(path, series_line)
    with h5py.File(path, "r+") as file:
        file.attrs["effects"] = text
    with pytest.raises((FileFormatError, InputError), match=r"twin|effect"):
        read_twin(path)


def test_effects_of_the_twin_act_unless_others_are_given(series_line):
    noisy = replace(series_line, effects=(AppliedEffect(id="excess_noise", parameters={"strength": 50.0}),))
    base = LineModel(series_line).expect(request())
    own = LineModel(noisy).expect(request())
    np.testing.assert_allclose(own.quantum_variance_DN2, 1.5 * base.quantum_variance_DN2)
    none = LineModel(noisy, effects=()).expect(request())
    np.testing.assert_allclose(none.quantum_variance_DN2, base.quantum_variance_DN2)


# ------------------------------------------------------------------------------------------------ refusals


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "video"}, "kind of series: got video; expected one of dark, flat, object, afterglow"),
        ({"frames": 0}, "frames of a series: got 0"),
        ({"exposure_ms": math.nan}, "exposure_ms: got nan"),
        ({"belt_axis": "diagonal"}, "belt_axis: got diagonal; expected row or column"),
        ({"displacement_px": (0.0, math.inf)}, "displacement_px: got"),
    ],
)
def test_a_request_that_makes_no_sense_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        request(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"setting": "kv=90,exposure_ms=20"}, "expected a tube load"),
        ({"setting": None}, "beam of unknown level"),
        ({"thickness_mm": {"Al": np.ones((3, 3))}}, r"thickness maps of a scene: got \(3, 3\)"),
        ({"thickness_mm": {"Al": -np.ones(SHAPE)}}, "negative or not finite"),
        ({"thickness_mm": {"unobtainium": np.ones(SHAPE)}}, "unobtainium"),
    ],
)
def test_a_series_that_cannot_be_expected_says_why(series_line, changes, message):
    with pytest.raises(InputError, match=message):
        LineModel(series_line).expect(request("object", **changes))


def test_a_scene_needs_a_spectrum(series_line):
    with pytest.raises(InputError, match="twin without spectral part"):
        LineModel(replace(series_line, spectral=None)).expect(request("object", thickness_mm=slab()))


def test_parameters_of_another_model_are_refused(series_line):
    with pytest.raises(InputError, match="spectral parameters"):
        LineModel(series_line, parameters=np.zeros(2)).expect(request())


# ------------------------------------------------------------------------------------------------ any detector


@pytest.mark.parametrize("shape", [(1, 64), (2, 2), (37, 41)])
def test_detectors_of_any_shape_take_any_effect(series_line, shape):
    """Line detectors among them: finite expectations and frames of their shape."""

    def crop(image):
        return np.resize(np.asarray(image), shape).astype(image.dtype)

    maps = series_line.maps
    names = ("dark_DN", "dark_DN_per_ms", "gain_relative", "read_variance_DN2", "bad_pixels")
    line = replace(
        series_line,
        maps=replace(maps, **{name: crop(getattr(maps, name)) for name in names}),
        levels=tuple(replace(level, flat_shape=crop(level.flat_shape)) for level in series_line.levels),
        instrument=replace(series_line.instrument, counting=True),
    )
    plate = np.where(np.indices(shape)[1] > shape[1] // 2, 2.0, 0.0)
    asked = request(
        "object",
        frames=2,
        thickness_mm={"W": plate, "water_liquid": np.full(shape, 5.0)},
        source_object_mm=700.0,
        displacement_px=(0.1, 0.2),
    )
    cache = ModelCache()
    for name in (name for name in EFFECTS if name != "threshold_error"):  # it wants a spectrum with a threshold
        effects = (AppliedEffect(id=name, parameters={}, since="calibration"),)
        found = LineModel(line, effects=effects, cache=cache).expect(asked)
        assert found.mean_DN.shape == shape and np.isfinite(found.mean_DN).all(), name
        for frame in LineModel(line, effects=effects, cache=cache).sample(asked, rng=np.random.default_rng(0)):
            assert frame.shape == shape and np.isfinite(frame).all(), name


# -------------------------------------------------------------------------------------------------- what is kept


@pytest.mark.parametrize(
    "effect",
    [
        None,
        ("object_scatter", {"strength": 10.0}),
        ("heel", {"strength": 8.0}),
        ("motion_blur", {"strength": 3.0, "acceleration": 0.5}),
        ("mtf_tail", {"strength": 20.0}),
        ("excess_noise", {"strength": 20.0}),
    ],
)
def test_a_series_is_the_same_whatever_was_asked_of_the_cache_before(series_line, effect):
    effects = () if effect is None else (AppliedEffect(id=effect[0], parameters=effect[1], since="calibration"),)
    scene = product()
    longer = request("object", MEASURED.replace("=20", "=50"), thickness_mm=scene, displacement_px=(0.3, -0.2))
    cache = ModelCache()
    asked = [longer, request("object", thickness_mm=scene, displacement_px=(0.3, -0.2)), request(), longer]
    for item in asked:
        kept = LineModel(series_line, effects=effects, cache=cache).expect(item)
        fresh = LineModel(series_line, effects=effects).expect(item)
        np.testing.assert_allclose(kept.mean_DN, fresh.mean_DN, rtol=1e-12)
        np.testing.assert_allclose(kept.quantum_variance_DN2, fresh.quantum_variance_DN2, rtol=1e-12)
        np.testing.assert_allclose(kept.white_variance_DN2, fresh.white_variance_DN2, rtol=1e-12)


def test_burn_in_is_the_same_in_whatever_order_series_are_asked(series_line):
    """What was found for one series is taken up for the next; a series asked before, or of other ones, begins anew."""
    parameters = {"strength": 4.0, "lasting_share": 0.3}
    effects = (AppliedEffect(id="burn_in", parameters=parameters, since="always"),)
    bare = [
        request("object", thickness_mm=product()),
        request(start_s=5.0),
        request(start_s=9.0),
        request(start_s=40.0),
    ]
    asked = [
        replace(one, long_ago=tuple(bare[: max(n - 1, 0)]), previous=tuple(bare[max(n - 1, 0) : n]))
        for n, one in enumerate(bare)
    ]
    others = [replace(bare[3], previous=(bare[2],)), replace(bare[3], previous=tuple(bare[1:3]))]
    fresh = [LineModel(series_line, effects=effects).expect(one).mean_DN for one in (*asked, *others)]
    assert np.abs(fresh[3] - fresh[4]).max() > 1e-3  # what was long ago is seen
    for order in ((0, 1, 2, 3, 4, 5), (3, 5, 1, 4, 2, 0, 3)):
        cache = ModelCache()
        for number in order:
            kept = LineModel(series_line, effects=effects, cache=cache).expect((*asked, *others)[number])
            np.testing.assert_array_equal(kept.mean_DN, fresh[number])


def test_light_goes_as_the_load_of_the_tube(series_line):
    scene = product()
    effects = (AppliedEffect(id="object_scatter", parameters={"strength": 10.0}, since="calibration"),)
    weak, strong = (
        LineModel(series_line, effects=effects).expect(
            request("object", MEASURED.replace("=20", f"={ms}"), thickness_mm=scene)
        )
        for ms in (20, 50)
    )
    np.testing.assert_allclose(strong.signal_DN, 2.5 * weak.signal_DN, rtol=1e-9)
    np.testing.assert_allclose(strong.quantum_variance_DN2, 2.5 * weak.quantum_variance_DN2, rtol=1e-9)


@pytest.mark.parametrize("documented", [LineModel, Setting.stated_load_mAs])
def test_examples_of_docstrings_run(documented):
    import doctest

    (test,) = doctest.DocTestFinder(recurse=False).find(documented, documented.__name__, globs={})
    found = doctest.DocTestRunner().run(test)
    assert found.attempted > 0 and found.failed == 0
