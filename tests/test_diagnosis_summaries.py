"""Statistics of a series against what was planted in its frames."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift
from scipy.special import ndtr

from raytwin.diagnosis.model.changes import variants_of
from raytwin.diagnosis.model.curves import node_weights
from raytwin.diagnosis.model.defects import memory_of
from raytwin.diagnosis.model.placing import _smeared
from raytwin.diagnosis.probes.frame_scalars import _log_variance_of_steps, measured_scalars
from raytwin.diagnosis.probes.map_probes import MapProjection, Template
from raytwin.diagnosis.probes.moving_picture import MovingPicture
from raytwin.diagnosis.probes.registration import Placement, register, register_drawn, resample
from raytwin.diagnosis.probes.scalar_context import Areas, ScalarContext
from raytwin.diagnosis.session.summaries import BLOCK_PX, LAGS, _codes, look_at_series, rounded_away, summarise_series
from raytwin.diagnosis.session.usable import counted_copies
from raytwin.errors import InputError
from raytwin.generator.effects import EFFECTS

SHAPE = (48, 64)
FRAMES = 40


def flat_frames(rng, *, factor=None, rows=0.0, spread=0.0, sd=10.0):
    noise = rng.standard_normal((FRAMES, *SHAPE))
    if spread:
        noise = np.stack([gaussian_filter(frame, spread, mode="wrap") for frame in noise])
        noise /= noise.std()
    frames = 1000.0 + sd * noise
    if rows:
        frames += rows * rng.standard_normal((FRAMES, SHAPE[0], 1))
    if factor is not None:
        frames *= factor[:, None, None]
    return frames.astype(np.float32)


def summary_of(frames, **options):
    good = np.ones(SHAPE, dtype=bool)
    return summarise_series([frames], good=good, labels=np.zeros(SHAPE, dtype=np.int64), **options)


def test_variance_of_white_frames_is_that_of_the_noise():
    found = summary_of(flat_frames(np.random.default_rng(1)))
    # differences of 40 frames: about 2 / (27 x 3072) of relative variance
    tolerance = 5 * np.sqrt(2.0 / (0.667 * FRAMES * 48 * 64))
    assert found.label_variance_DN2[0] == pytest.approx(100.0, rel=tolerance)
    assert found.label_autocovariance_DN2[0] == pytest.approx(np.zeros(len(LAGS)), abs=100 * tolerance)
    assert found.row_variance_DN2 * SHAPE[1] == pytest.approx(100.0, rel=0.2)
    assert found.block_variance_DN2 * BLOCK_PX**2 == pytest.approx(100.0, rel=0.2)
    assert abs(found.temporal_covariance_DN2[0]) < 100 * 5 / np.sqrt(FRAMES * 48 * 64)
    assert abs(found.kurtosis_excess) < 0.1


@pytest.mark.parametrize("phase", [0.0, 0.3, None])
@pytest.mark.parametrize(("sd_steps", "lost"), [(0.1, True), (0.45, True), (0.9, False), (3.0, False)])
def test_noise_that_hardly_reaches_over_a_step_is_lost(sd_steps, lost, phase):
    rng, step = np.random.default_rng(6), 30.0
    between = rng.random(SHAPE) if phase is None else phase
    frames = step * np.rint(40.0 + between + sd_steps * rng.standard_normal((16, *SHAPE)))
    assert rounded_away(summary_of(frames.astype(np.float32)), np.ones(SHAPE, dtype=bool)) == lost


def test_saturated_pixels_leave_the_tails_of_the_others():
    rng = np.random.default_rng(7)
    frames = np.rint(rng.normal(1000.0, 10.0, (30, *SHAPE))).astype(np.float32)
    frames[:, :, :20] = 4095.0
    assert abs(summary_of(frames).kurtosis_excess) < 0.3


def test_common_factor_of_each_frame_stays_out_of_the_pixels_noise():
    rng = np.random.default_rng(2)
    factor = 1.0 + 0.02 * rng.standard_normal(FRAMES)
    found = summary_of(flat_frames(rng, factor=factor))
    assert found.label_variance_DN2[0] == pytest.approx(100.0, rel=0.03)
    assert np.std(found.frame_mean_DN / 1000.0 - factor) < 1e-3


def test_lines_show_in_the_rows_alone():
    found = summary_of(flat_frames(np.random.default_rng(3), rows=2.0))
    assert found.row_variance_DN2 == pytest.approx(4.0 + 100.0 / SHAPE[1], rel=0.2)
    assert found.column_variance_DN2 * SHAPE[0] == pytest.approx(104.0, rel=0.25)
    along_rows = LAGS.index((0, 1))
    assert found.label_autocovariance_DN2[0, along_rows] == pytest.approx(4.0, rel=0.2)


def test_neighbours_of_blurred_noise_are_correlated_as_its_kernel_says():
    found = summary_of(flat_frames(np.random.default_rng(4), spread=0.8))
    expected = np.exp(-1.0 / (4 * 0.8**2))
    assert found.label_autocovariance_DN2[0, LAGS.index((0, 1))] / found.label_variance_DN2[0] == pytest.approx(
        expected, abs=0.03
    )


def test_pieces_of_any_length_give_the_same_sums():
    frames = flat_frames(np.random.default_rng(5))
    good = np.ones(SHAPE, dtype=bool)
    labels = np.zeros(SHAPE, dtype=np.int64)
    whole = summarise_series([frames], good=good, labels=labels)
    parts = summarise_series([frames[:7], frames[7:8], frames[8:]], good=good, labels=labels)
    assert parts.mean_DN == pytest.approx(whole.mean_DN, rel=1e-9)
    assert parts.pair_variance_DN2 == pytest.approx(whole.pair_variance_DN2, rel=1e-4, abs=1e-4)
    assert parts.stack_variance_DN2 == pytest.approx(whole.stack_variance_DN2, rel=1e-3, abs=1e-3)
    assert parts.frame_mean_DN == pytest.approx(whole.frame_mean_DN)


def test_codes_of_coarse_numbers_are_counted():
    rng = np.random.default_rng(6)
    numbers = rng.normal(1000, 40, (FRAMES, *SHAPE))
    fine = summary_of(np.rint(numbers).astype(np.uint16))
    coarse = summary_of((8 * np.rint(numbers / 8)).astype(np.uint16))
    assert fine.code_range / fine.distinct_codes == pytest.approx(1.0, abs=0.02)
    assert coarse.code_range / coarse.distinct_codes == pytest.approx(8.0, rel=0.08)


@pytest.mark.parametrize(
    ("pieces", "message"),
    [
        ([], "no frames"),
        ([np.zeros((3, 5, 5), np.float32)], "frames of"),
        ([np.full((3, *SHAPE), np.nan, np.float32)], "NaN"),
    ],
)
def test_frames_that_cannot_be_used_are_refused(pieces, message):
    with pytest.raises(InputError, match=message):
        summarise_series(pieces, good=np.ones(SHAPE, bool), labels=np.zeros(SHAPE, np.int64))


def scene(row_px, column_px):
    """A corner with two edges, rendered on quarter pixels."""
    y, x = np.mgrid[: 96 * 4, : 96 * 4] / 4.0
    edge = np.where((x - column_px) + 0.05 * (y - row_px) > 52, 0.1, 1.0)
    edge *= np.where((y - row_px) - 0.03 * (x - column_px) > 60, 0.6, 1.0)
    return 1e4 * gaussian_filter(edge, 4 * 0.55).reshape(96, 4, 96, 4).mean(axis=(1, 3))


@pytest.mark.parametrize(("row", "column"), [(0.0, 0.0), (0.3, -0.2), (1.4, 0.8), (-2.1, 0.5)])
def test_displacement_of_a_scene_is_found_within_a_tenth_of_a_pixel(row, column):
    model = scene(0.0, 0.0)
    measured = scene(row, column) + 10.0 * np.random.default_rng(7).standard_normal(model.shape)
    found = register([measured], [model], [np.full(model.shape, 100.0)], np.ones(model.shape, bool))
    assert found.row_px == pytest.approx(row, abs=0.1)
    assert found.column_px == pytest.approx(column, abs=0.1)
    back = resample(measured, found)
    inner = slice(6, -6)
    assert np.std((back - model)[inner, inner]) < 0.5 * np.std((measured - model)[inner, inner]) or (row, column) == (
        0,
        0,
    )


def steps(row_px=0.0, column_px=0.0):
    """Two by three steps of a wedge, rendered on quarter pixels, not smeared by more than the panel does."""
    y, x = np.mgrid[: 128 * 4, : 128 * 4] / 4.0
    depth = np.where((np.abs(y - row_px - 64) < 50) & (np.abs(x - column_px - 64) < 50), 1.0, 0.0)
    depth *= 0.3 + 0.5 * (y - row_px > 64) + 0.4 * (x - column_px > 48) + 0.4 * (x - column_px > 80)
    return 3e4 * gaussian_filter(np.exp(-depth), 4 * 0.55).reshape(128, 4, 128, 4).mean(axis=(1, 3))


@pytest.mark.parametrize(("axis", "belt"), [(0, "row"), (1, "column")])
def test_a_wedge_that_moved_by_many_pixels_is_found_where_it_lies(axis, belt):
    members = [
        SimpleNamespace(request=SimpleNamespace(exposure_ms=time_ms, belt_axis=belt)) for time_ms in (50.0, 100.0)
    ]
    model, noises = [steps(), 0.5 * steps()], [np.full((128, 128), 100.0)] * 2

    def way(reach):
        return [(step, 0) if axis == 0 else (0, step) for step in range(-reach, reach + 1)]

    # moved on by quarters of a pixel, over as many pixels in the longer exposure
    measured = [
        share * np.mean([steps(0.25 + down / 4, -0.25 + right / 4) for down, right in way(2 * length)], axis=0)
        for share, length in ((1.0, 8), (0.5, 16))
    ]
    everywhere = np.ones((128, 128), bool)
    blind = register(measured, model, noises, everywhere)
    found, blur = _smeared(members, measured, model, noises, everywhere, blind)
    assert found.row_px == pytest.approx(0.25, abs=0.1)
    assert found.column_px == pytest.approx(-0.25, abs=0.1)
    off = math.hypot(blind.row_px - 0.25, blind.column_px + 0.25)
    assert off > 5.0 * math.hypot(found.row_px - 0.25, found.column_px + 0.25)
    again = blur(model)
    assert np.std(again[1] - measured[1]) < 0.3 * np.std(model[1] - measured[1])
    # exposures that nobody stated count as equally long
    unstated = [SimpleNamespace(request=SimpleNamespace(exposure_ms=0.0, belt_axis=belt))]
    alone, _ = _smeared(unstated, measured[1:], model[1:], noises[1:], everywhere, blind)
    assert alone.row_px == pytest.approx(0.25, abs=0.1)
    assert alone.column_px == pytest.approx(-0.25, abs=0.1)
    sharp = [steps(0.25, -0.25), 0.5 * steps(0.25, -0.25)]
    seen = register(sharp, model, noises, everywhere)
    same, none = _smeared(members, sharp, model, noises, everywhere, seen)
    assert same == seen
    assert none(model) is model


def test_an_even_field_shows_no_displacement():
    model = np.full((64, 64), 1000.0)
    found = register([model + 1.0], [model], [np.full(model.shape, 100.0)], np.ones(model.shape, bool))
    assert not found.found


def test_along_a_single_edge_nothing_is_claimed():
    x = np.mgrid[:384, :384][1] / 4.0

    def edge(shift):
        return 1e4 * gaussian_filter(np.where(x - shift > 48, 0.1, 1.0), 2.2).reshape(96, 4, 96, 4).mean(axis=(1, 3))

    found = register([edge(0.4)], [edge(0.0)], [np.full((96, 96), 100.0)], np.ones((96, 96), bool))
    assert found.column_px == pytest.approx(0.4, abs=0.06)
    assert found.row_sd_px > 0.3
    assert found.row_px == pytest.approx(0.0, abs=0.05)


def test_light_that_strays_over_the_picture_does_not_move_it():
    model = scene(0.0, 0.0)
    y, x = np.mgrid[:96, :96] / 48.0 - 1.0
    fog = 4e3 * np.exp(-2.0 * (x - 0.3) ** 2 - 1.5 * y**2)
    found = register([scene(0.3, -0.2) + fog], [model], [np.full(model.shape, 100.0)], np.ones(model.shape, bool))
    assert found.row_px == pytest.approx(0.3, abs=0.2)
    assert found.column_px == pytest.approx(-0.2, abs=0.2)


def test_resampling_by_nothing_changes_nothing():
    image = np.random.default_rng(8).standard_normal((20, 30))
    still = Placement(row_px=0.0, column_px=0.0, row_sd_px=0.1, column_sd_px=0.1)
    assert resample(image, still) == pytest.approx(image, abs=1e-9)


def test_a_picture_that_fades_adds_to_variances_what_it_says():
    rows, columns, frames = 48, 64, 12
    y, x = np.mgrid[:rows, :columns]
    pictures = [np.where(x > 40, 30.0, 0.0) + 5.0 * (y > 20), 8.0 * np.sin(y / 7.0)]
    courses = [np.exp(-np.arange(frames) / 2.0), 1.0 / (1.0 + np.arange(frames))]
    good = np.ones((rows, columns), bool)
    stack = sum(image * course[:, None, None] for image, course in zip(pictures, courses, strict=True))
    found = summarise_series([stack + 100.0], good=good, labels=np.zeros((rows, columns), np.int64))
    expected = SimpleNamespace(
        trend_DN=[(image, course - course.mean()) for image, course in zip(pictures, courses, strict=True)],
        signal_DN=np.ones((1, 1)),
    )
    areas = Areas.of(good, np.zeros((rows, columns), np.int64), 1)
    moving = MovingPicture.of(expected, SimpleNamespace(good=good, areas=areas, kind="dark"))
    assert moving.pixels() == moving.pixels(0)
    assert moving.pixels() == pytest.approx(float(found.label_variance_DN2[0]), rel=1e-4)
    assert moving.rows() == pytest.approx(found.row_variance_DN2, rel=1e-4)
    assert moving.columns() == pytest.approx(found.column_variance_DN2, rel=1e-4)


@pytest.mark.parametrize(("frames", "height_DN"), [(20, 25.0), (20, 60.0), (50, 25.0), (90, 60.0)])
def test_a_picture_that_fades_gives_steps_the_tails_that_it_says(frames, height_DN):
    """Most of an exponential's fall lies in the first steps: a tenth of them hold what the others lack."""
    rng = np.random.default_rng(int(height_DN))
    rows, columns = 96, 80
    y, x = np.mgrid[:rows, :columns]
    picture = np.where(x > 50, height_DN, 0.0)
    course = np.exp(-np.arange(frames) / 1.5)
    quantum = 4.0 + 0.1 * y  # DN^2
    white = np.full((1, 1), 2.0)
    stack = 500.0 + picture * course[:, None, None]
    stack = stack + np.sqrt(quantum + 2.0) * rng.standard_normal((frames, rows, columns))
    good, labels = np.ones((rows, columns), bool), np.zeros((rows, columns), np.int64)
    found = summarise_series([stack], good=good, labels=labels)
    still = summarise_series([stack - picture * course[:, None, None]], good=good, labels=labels)
    expected = SimpleNamespace(
        trend_DN=[(picture, course - course.mean())],
        signal_DN=np.ones((1, 1)),
        quantum_variance_DN2=quantum,
        white_variance_DN2=white,
        row_variance_DN2=0.0,
        column_variance_DN2=0.0,
        temporal_correlation=np.zeros(3),
    )
    moving = MovingPicture.of(expected, SimpleNamespace(good=good, areas=Areas.of(good, labels, 1), kind="dark"))
    said = moving.kurtosis(expected)
    assert said > 0.05
    assert found.kurtosis_excess - still.kurtosis_excess == pytest.approx(said, rel=0.1, abs=0.05)
    nothing = MovingPicture.of(
        SimpleNamespace(trend_DN=None, signal_DN=np.ones((1, 1))),
        SimpleNamespace(good=good, areas=Areas.of(good, labels, 1), kind="dark"),
    )
    assert nothing.kurtosis(expected) == 0.0


def test_means_over_areas_are_those_over_their_masks():
    rng = np.random.default_rng(12)
    image, good = rng.standard_normal((20, 30)), rng.random((20, 30)) > 0.1
    labels = rng.integers(-1, 3, (20, 30))
    areas = Areas.of(good, labels, 3)
    whole, own = areas.means(image)
    assert whole == pytest.approx(float(image[good].mean()), rel=1e-12)
    assert own == pytest.approx([float(image[good & (labels == label)].mean()) for label in range(3)], rel=1e-12)
    assert areas.means(np.full((1, 1), 4.0))[0] == areas.mean(4.0) == 4.0


@pytest.mark.parametrize("step", [1, 4])
def test_codes_are_counted_between_the_percentiles_of_the_numbers(step):
    values = step * np.rint(np.random.default_rng(3).normal(200.0, 30.0, 5000) / step).astype(np.uint16)
    low, high = np.percentile(values, [1, 99]).astype(int)
    inside = values[(values >= low) & (values <= high)]
    assert _codes(values) == (len(np.unique(inside)), int(inside.max()) - int(inside.min()) + 1)


def _projection(rng, shape=(24, 20), templates=6, products=1):
    images = [rng.standard_normal(shape) * 3.0**k for k in range(templates)]
    images.append(images[0] + images[1])  # says nothing new
    images.append(np.zeros(shape))
    half = np.array([1.0, 0.3, 0.05, 0.0])
    table = np.outer(half, half)
    if products == 2:
        table[0, 2] += 0.04  # alike along rows and not along columns
    mask = rng.random(shape) > 0.1
    quantum, white = 2.0 + rng.random(shape), 0.5 + rng.random(shape)
    named = [Template(axis="level", name=str(number), unit="1", image=image) for number, image in enumerate(images)]
    projection = MapProjection(named, mask=mask, quantum_DN2=quantum, white_DN2=white, autocovariance_table=table)
    return projection, mask, quantum, white, table


@pytest.mark.parametrize("products", [1, 2])
def test_map_probes_have_unit_noise_and_do_not_depend_on_each_other(products):
    projection, mask, quantum, white, table = _projection(np.random.default_rng(4), products=products)
    assert np.linalg.matrix_rank(table) == products
    assert [name.location for name in projection.names] == [str(number) for number in range(6)]
    rows, columns = mask.shape
    y, x = (index.ravel() for index in np.indices(mask.shape))
    apart = np.abs(y[:, None] - y[None, :]), np.abs(x[:, None] - x[None, :])
    near = (apart[0] < 4) & (apart[1] < 4)
    shared = np.where(near, table[np.minimum(apart[0], 3), np.minimum(apart[1], 3)], 0.0)
    covariance = np.sqrt(np.outer(quantum, quantum)) * shared + np.diag(white.ravel())
    weights = projection.apply(np.eye(rows * columns).reshape(-1, rows, columns)).T
    np.testing.assert_allclose(weights @ covariance @ weights.T, np.eye(6), atol=1e-5)
    assert np.all(weights[:, ~mask.ravel()] == 0.0)


def test_a_stack_of_maps_is_projected_as_its_maps_are_and_pixel_noise_adds_in_squares():
    rng = np.random.default_rng(5)
    projection, mask, _, _, _ = _projection(rng)
    images, sd = rng.standard_normal((3, *mask.shape)), rng.random(mask.shape)
    together = projection.apply(images)
    np.testing.assert_allclose(together, [projection.apply(image) for image in images], rtol=1e-4, atol=1e-5)
    weights = projection.apply(np.eye(mask.size).reshape(-1, *mask.shape))
    np.testing.assert_allclose(projection.pixel_noise(sd), (sd.ravel() ** 2) @ weights**2, rtol=1e-4)


def test_noise_of_lines_moves_what_is_projected_along_them():
    rng = np.random.default_rng(6)
    projection, mask, *_ = _projection(rng)
    rows, columns = mask.shape
    weights = projection.apply(np.eye(mask.size).reshape(-1, rows, columns)).T.reshape(-1, rows, columns)
    of_rows = sum(weights[:, row, :].sum(axis=1) ** 2 for row in range(rows))
    of_columns = sum(weights[:, :, column].sum(axis=1) ** 2 for column in range(columns))
    np.testing.assert_allclose(projection.line_noise(), [of_rows, of_columns], rtol=1e-4)


@pytest.mark.parametrize("frames", [9, 30])
def test_the_logarithm_of_a_variance_from_few_frames_is_unbiased_and_as_uncertain_as_said(frames):
    rng, draws = np.random.default_rng(8), 4000
    freedom = 2.0 * (frames - 1) ** 2 / (3.0 * frames - 4.0)
    found = np.array([_log_variance_of_steps(3.0 * rng.standard_normal(frames), freedom) for _ in range(draws)])
    sd = found[0, 1]
    assert found[:, 0].mean() == pytest.approx(np.log(9.0), abs=4 * sd / np.sqrt(draws) + 0.01)
    # the steps' sum of squares is not quite a chi-square of that many degrees of freedom
    assert found[:, 0].std() == pytest.approx(sd, rel=0.06)


def test_pixels_that_jump_and_stay_have_a_memory_and_noisy_ones_have_none():
    rng, frames, count = np.random.default_rng(5), 12, 60
    outlying = np.zeros(SHAPE, dtype=bool)
    outlying.ravel()[rng.choice(outlying.size, count, replace=False)] = True
    quiet = 100.0 + rng.standard_normal((frames, *SHAPE))
    noisy = quiet.copy()
    noisy[:, outlying] += 4.0 * rng.standard_normal((frames, count))
    jumping = quiet.copy()
    flips = rng.random((frames, count)) < 0.15
    jumping[:, outlying] += 6.0 * (np.cumsum(flips, axis=0) % 2)
    shares = []
    for changed in (noisy, jumping):
        found = memory_of(summary_of(changed.astype(np.float32)), outlying)
        assert found is not None
        assert found[1] == count
        shares.append(found[0])
    assert abs(shares[0]) < 4 * np.sqrt(1.6 / (frames * count))
    assert shares[1] > 0.25


@pytest.mark.parametrize("blur_px", [0.3, 1.2])
@pytest.mark.parametrize("whole_cells", [False, True])
def test_a_sharp_edge_is_placed_by_drawing_it_also_where_it_is_blurred_more_than_known(blur_px, whole_cells):
    rows, columns = np.mgrid[:80, :80]

    def picture(row_px, column_px, sigma_px):
        # an opaque disc: dark and far less noisy inside
        apart = np.hypot(rows - 40 - row_px, columns - 38 - column_px) - 20.0
        return 100.0 + 30_000.0 * ndtr(apart / sigma_px)

    rng = np.random.default_rng(4)
    truth = (1.4, -0.7)
    variance = picture(*truth, blur_px) / 10.0
    measured = picture(*truth, blur_px) + np.sqrt(variance) * rng.standard_normal((80, 80))
    start = Placement(row_px=0.0, column_px=0.0, row_sd_px=0.1, column_sd_px=0.1)
    found = register_drawn(
        [measured],
        lambda at: [picture(*at, 0.3)],
        [variance],
        np.ones((80, 80), bool),
        start,
        whole_cells=whole_cells,
    )
    tolerance = 0.17 if whole_cells else 0.06
    assert (found.row_px, found.column_px) == pytest.approx(truth, abs=tolerance)
    if whole_cells:
        assert found.row_px * 3 == pytest.approx(round(found.row_px * 3))
        assert found.row_sd_px >= 1 / (3 * math.sqrt(12))


@pytest.mark.parametrize("blur_px", [(0.3, 1.5), (2.0, 2.0)])
def test_a_blur_moves_no_edge_that_is_drawn_blurred_between_pixels(blur_px):
    rows, columns = np.mgrid[:80, :80]
    edge = np.where(columns + 0.06 * rows > 44.2, 10.0, 30_000.0)

    def draw(at):
        # by straight lines between points, which blur it
        return [shift(edge, at, order=1, mode="nearest")]

    measured = gaussian_filter(edge, blur_px, mode="nearest")
    variance = np.maximum(measured, 1.0) / 10.0
    start = Placement(row_px=1 / 3, column_px=-1 / 3, row_sd_px=0.1, column_sd_px=0.1)
    found = register_drawn([measured], draw, [variance], np.ones((80, 80), bool), start, whole_cells=True)
    assert (found.row_px, found.column_px) == (0.0, 0.0)


@pytest.mark.parametrize("brighter", [0.9, 1.06])
def test_a_beam_of_another_level_displaces_nothing(brighter):
    rows, columns = np.mgrid[:80, :80]

    def picture(row_px, column_px):
        # an opaque half: its edge alone tells where it lies
        return 10.0 + 20_000.0 * ndtr((columns + 0.1 * rows - 44.0 - column_px - 0.1 * row_px) / 0.6)

    variance = picture(0.0, 0.0) / 10.0
    noise = np.sqrt(variance / 50.0) * np.random.default_rng(6).standard_normal((80, 80))
    measured = brighter * picture(0.0, 0.0) + noise
    everywhere = np.ones((80, 80), bool)
    first = register([measured], [picture(0.0, 0.0)], [variance], everywhere)
    assert abs(first.column_px) < 0.004
    found = register_drawn([measured], lambda at: [picture(*at)], [variance], everywhere, first, whole_cells=False)
    assert abs(found.column_px) < 0.004


def fields_of_context(labels, names):
    """What says what the scalar probes of an object's series refer to, with labels (row, column) and their names."""
    return {
        "kind": "object",
        "frames": FRAMES,
        "good": np.ones(SHAPE, bool),
        "labels": labels,
        "label_names": names,
        "reference_signal_DN": 1000.0,
        "previous_signal_DN": None,
        "calibrates": False,
        "codes_usable": False,
        "pattern_noise": np.array([1.0, 1.0, np.nan, np.nan]),
        "quantum_DN2": 100.0,
        "dark_DN": 0.0,
        "counts_all_outliers": False,
    }


def test_correlations_are_as_uncertain_as_the_neighbours_of_one_label_are_few():
    # stripes: next to each other, pixels of one label lie in the first five columns alone
    labels = np.tile(np.arange(SHAPE[1]) % 2, (SHAPE[0], 1))
    labels[:, :4] = 0
    white = SimpleNamespace(
        mean_DN=np.zeros((1, 1)),
        dark_DN=np.zeros((1, 1)),
        quantum_variance_DN2=np.zeros((1, 1)),
        white_variance_DN2=np.full((1, 1), 100.0),
        noise_autocovariance=np.pad([[1.0]], (0, 3)),
    )
    context = ScalarContext(**fields_of_context(labels, ("even", "odd")))
    found = {}
    for seed in range(40):
        summary = summarise_series([flat_frames(np.random.default_rng(seed))], good=np.ones(SHAPE, bool), labels=labels)
        for one in measured_scalars(
            summary,
            white,
            context,
            dark_mean_DN=0.0,
            pattern=None,
            outliers=None,
            all_outliers=0,
            memory=None,
            copies=0,
            lasting=0,
        ):
            if one.name.startswith("correlation"):
                found.setdefault(one.name, []).append(one.value / one.sampling_sd)
    assert summary.label_pairs[:, LAGS.index((0, 1))].tolist() == [4 * SHAPE[0], 0]
    assert "correlation odd (0,1)" not in found
    for name in ("correlation even (0,1)", "correlation even (1,0)", "correlation odd (1,0)"):
        assert 0.7 < np.std(found[name]) < 1.35


def test_quanta_of_an_area_whose_pixels_are_brighter_are_noisier_by_the_square_of_their_gain():
    gain = np.ones(SHAPE)
    gain[:, : SHAPE[1] // 2] = 1.1
    labels = np.zeros(SHAPE, dtype=np.int64)
    labels[:, SHAPE[1] // 2 :] = 1
    fields = fields_of_context(labels, ("left", "right"))
    assert ScalarContext(**fields).label_gain.tolist() == [1.0, 1.0]
    left, right = ScalarContext(**fields, gain=gain).label_gain
    assert left / right == pytest.approx(1.21)
    # together they are as noisy as calibration found them
    assert 0.5 * (left + right) == pytest.approx(1.0)


def test_copies_of_frames_change_nothing_that_is_said_of_the_noise():
    """Of a series with copies all is said that is said of the frames that are there once; the copies are counted."""
    frames = flat_frames(
        np.random.default_rng(6), rows=1.0, factor=1.0 + 0.01 * np.random.default_rng(7).standard_normal(FRAMES)
    )
    stored = np.repeat(frames, 1 + (np.arange(FRAMES) % 4 == 1), axis=0)
    found, once = summary_of(stored), summary_of(frames)
    assert found.frames == once.frames == FRAMES
    for name in (
        "mean_DN",
        "label_variance_DN2",
        "label_autocovariance_DN2",
        "row_variance_DN2",
        "block_variance_DN2",
        "temporal_covariance_DN2",
        "frame_mean_DN",
    ):
        np.testing.assert_allclose(getattr(found, name), getattr(once, name), rtol=1e-5, atol=1e-6)
    good = np.ones(SHAPE, dtype=bool)
    assert look_at_series([stored[:10], stored[10:]], good=good).copies == FRAMES // 4


def test_copies_are_counted_once_for_the_series_that_calibrate_and_once_for_all_others():
    def look(copies, noise=1.0):
        return SimpleNamespace(copies=copies, stack_variance_DN2=np.full((2, 2), noise))

    looks = {"dark": look(2), "flat": look(1), "later": look(3), "blank": look(4, noise=0.0)}
    seen = [
        SimpleNamespace(
            name=name,
            session=SimpleNamespace(calibrates=name in ("dark", "flat"), series=SimpleNamespace(n_frames=11)),
            look=one,
        )
        for name, one in looks.items()
    ]
    # frames that are all alike can be copies or not: nothing tells
    assert counted_copies(seen) == {"flat": (3, 20), "later": (3, 10)}


def test_between_the_strengths_that_are_asked_copies_are_foretold_within_their_chance():
    strength = EFFECTS["dropped_frames"].strength
    nodes = np.array(variants_of(EFFECTS["dropped_frames"])[0].strengths)
    asked = np.geomspace(strength.low, strength.high, 50)

    def root(percent):
        return np.sqrt(percent / 100.0 * 800 + 0.375) - np.sqrt(0.375)

    found = node_weights(nodes, asked) @ root(nodes)
    error = np.abs(found - root(asked))
    assert error.max() < 0.5 and np.median(error) < 0.1
