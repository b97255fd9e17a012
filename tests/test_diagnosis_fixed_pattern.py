"""Fixed patterns of mean frames: what noise leaves, grain, lines and pixels that stand out."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from raytwin.diagnosis.model.calibrated_maps import CalibratedMaps
from raytwin.diagnosis.model.defects import new_outliers
from raytwin.diagnosis.probes.fixed_pattern import (
    count_outliers,
    pattern_noise,
    pattern_of,
    pattern_statistics,
)
from raytwin.diagnosis.probes.noise_correlation import correlation_sum

SHAPE = (96, 128)
ALL = np.ones(SHAPE, dtype=bool)
BLUR_PX = 0.9
QUANTUM_DN2, WHITE_DN2, FRAMES = 900.0, 100.0, 25
PIXEL, BLOCKS, ROWS, COLUMNS = range(4)
SIGNAL = np.full(SHAPE, 5000.0)


@pytest.fixture(scope="module")
def expected():
    """Noise of one frame: quanta blurred by a Gaussian, and white noise."""
    impulse = np.zeros((65, 65))
    impulse[32, 32] = 1.0
    kernel = gaussian_filter(impulse, BLUR_PX)
    spectrum = np.abs(np.fft.fft2(kernel)) ** 2
    table = np.real(np.fft.ifft2(spectrum))[:9, :9]
    return SimpleNamespace(
        quantum_variance_DN2=np.full(SHAPE, QUANTUM_DN2),
        white_variance_DN2=np.full(SHAPE, WHITE_DN2),
        noise_autocovariance=np.ascontiguousarray(table / table[0, 0]),
    )


def mean_frame(rng):
    quanta = gaussian_filter(rng.standard_normal(SHAPE), BLUR_PX, mode="wrap")
    quanta *= np.sqrt(QUANTUM_DN2) * 2.0 * np.sqrt(np.pi) * BLUR_PX
    return (quanta + np.sqrt(WHITE_DN2) * rng.standard_normal(SHAPE)) / np.sqrt(FRAMES)


def found_in(residual, clean=ALL, good=ALL, signal=SIGNAL):
    return pattern_statistics(residual, signal, clean=clean, good=good)


def test_noise_alone_leaves_what_its_correlation_says(expected):
    rng = np.random.default_rng(1)
    seen = [found_in(mean_frame(rng)) for _ in range(40)]
    wanted = pattern_noise(expected, ALL, FRAMES, 0.0, 0.0, lines=True)
    # forty frames of 96 and 128 lines: 4 % for lines, less for the rest
    assert np.all(np.abs(np.mean(seen, axis=0) / wanted - 1.0) < (0.02, 0.1, 0.09, 0.09))
    # neighbouring lines share quanta: second differences hold far less than twice what lines without them would
    assert wanted[ROWS] < 0.6 * QUANTUM_DN2 / FRAMES * correlation_sum(expected, 1, SHAPE[1]) / SHAPE[1]


def test_noise_of_the_maps_is_added_and_lines_are_left_out_where_nothing_is_known_of_them(expected):
    alone = pattern_noise(expected, ALL, FRAMES, 0.0, 0.0, lines=True)
    doubled = pattern_noise(expected, ALL, FRAMES, QUANTUM_DN2 / FRAMES, WHITE_DN2 / FRAMES, lines=True)
    assert doubled[ROWS] == pytest.approx(2.0 * alone[ROWS])
    assert doubled[BLOCKS] == pytest.approx(2.0 * alone[BLOCKS])
    without = pattern_noise(expected, ALL, FRAMES, 0.0, 0.0, lines=False)
    assert np.all(np.isnan(without[[ROWS, COLUMNS]]))
    assert np.isnan(found_in(mean_frame(np.random.default_rng(2)), signal=None)[ROWS])


def test_grain_shows_in_lines_as_its_pixels_say_and_smooth_shapes_do_not():
    rng = np.random.default_rng(3)
    grain = 25.0 * rng.standard_normal(SHAPE)
    y, x = np.meshgrid(np.linspace(-1, 1, SHAPE[0]), np.linspace(-1, 1, SHAPE[1]), indexing="ij")
    seen = found_in(grain + 200.0 * x + 150.0 * y**2)
    assert seen[PIXEL] == pytest.approx(625.0, rel=0.03)
    assert seen[ROWS] == pytest.approx(625.0 / SHAPE[1], rel=0.4)
    assert seen[COLUMNS] == pytest.approx(625.0 / SHAPE[0], rel=0.4)


def test_a_seam_of_two_narrow_columns_shows_in_columns_alone():
    seam = np.zeros(SHAPE)
    seam[:, 63:65] = -40.0
    seen = found_in(seam)
    # second differences -40, 40, 40, -40 among 126
    assert seen[COLUMNS] == pytest.approx(4.0 * 1600.0 / 6.0 / 126.0, rel=0.02)
    assert seen[ROWS] < 1e-6


def test_a_picture_that_moved_is_expected_with_what_is_measured_of_it():
    row, column = np.indices(SHAPE)
    strip = np.where(np.abs(column + 0.5 * row - 80.0) < 12.0, -150.0, 0.0)
    seen, told = found_in(strip), pattern_of(strip.astype(np.float32))
    assert told[PIXEL] == pytest.approx(seen[PIXEL], rel=0.02)
    assert told[BLOCKS] == pytest.approx(seen[BLOCKS], rel=0.1)  # a surface through means, not through medians
    assert told[ROWS] == pytest.approx(seen[ROWS], rel=0.02, abs=1e-6)
    assert told[COLUMNS] == pytest.approx(seen[COLUMNS], rel=0.05)
    assert not pattern_of(np.zeros((1, 1), np.float32)).any()
    slope = 100.0 * (column / SHAPE[1]) ** 2 + 50.0 * row / SHAPE[0]
    smooth = pattern_of(slope.astype(np.float32))
    assert smooth[[PIXEL, BLOCKS]].max() < 1e-6


def test_a_line_whose_pixels_all_stand_out_is_a_line_and_a_dead_one_a_defect():
    narrow = np.zeros(SHAPE)
    narrow[:, 40] = -0.04 * 5000.0
    flagged = ALL.copy()
    flagged[:, 40] = False
    counted = found_in(narrow, clean=flagged)
    assert counted[COLUMNS] == pytest.approx(6.0 * 200.0**2 / 6.0 / 126.0, rel=0.02)
    dead = np.zeros(SHAPE)
    dead[:, 40] = -5000.0
    assert found_in(dead, clean=flagged)[COLUMNS] < 1e-6
    # nor does a stretch of defects over more than half of one
    stretch = np.zeros(SHAPE)
    stretch[: int(0.55 * SHAPE[0]), 40] = 0.1 * 5000.0
    assert found_in(stretch, clean=stretch == 0)[COLUMNS] < 1e-6
    # pixels that stand out here and there do not make a line
    scattered = np.zeros(SHAPE)
    scattered[::7, 40] = 400.0
    assert found_in(scattered, clean=scattered == 0)[COLUMNS] < 1e-6


def test_pixels_that_stand_out_of_noise_and_pattern_are_counted():
    rng = np.random.default_rng(4)
    variance = np.full(SHAPE, 36.0)
    residual = 6.0 * rng.standard_normal(SHAPE)
    places = rng.choice(residual.size, 12, replace=False)
    residual.flat[places] += 120.0
    clean = ALL.copy()
    clean.flat[places] = False
    assert count_outliers(residual, variance, 36.0, clean=clean, good=ALL) == 12
    assert count_outliers(residual, variance, 36.0, clean=clean, good=clean) == 0
    # among grain ten times as strong as noise they do not stand out
    assert count_outliers(residual, variance, 3600.0, clean=clean, good=ALL) == 0


def test_an_edge_that_a_picture_left_is_no_outlier_and_defects_beside_and_on_it_are():
    rng = np.random.default_rng(7)
    variance = np.full(SHAPE, 36.0)
    y, x = np.meshgrid(np.arange(SHAPE[0]), np.arange(SHAPE[1]), indexing="ij")
    ghost = 500.0 / (1.0 + np.exp((y - 60.0 + 0.3 * x) / 0.7)) + 800.0 * (np.hypot(y - 90.0, x - 80.0) < 14.0)
    level = ghost + 6.0 * rng.standard_normal(SHAPE)
    pixel = float(np.mean(np.diff(level, axis=1) ** 2)) / 2.0
    smooth = level - level.mean()
    assert np.count_nonzero(np.abs(smooth) > 7.0 * math.sqrt(pixel)) > 1000  # what a level alone would call outliers
    assert count_outliers(level, variance, 36.0, clean=ALL, good=ALL) == 0
    defects = np.zeros(SHAPE, dtype=bool)
    defects[20:22, 10:13] = True  # a cluster
    defects[40:60, 100] = True  # a stretch of a line
    defects[5, 5] = defects[70, 20] = defects[-1, -1] = True
    level[defects] += 400.0
    assert count_outliers(level, variance, 36.0, clean=~defects, good=ALL) == np.count_nonzero(defects)
    # whole blocks and lines two pixels wide, of which neighbours know nothing better
    wide = defects.copy()
    wide[10:18, 60:68] = wide[:40, 40:42] = True
    assert count_outliers(level + 400.0 * (wide & ~defects), variance, 36.0, clean=~wide, good=ALL) == np.count_nonzero(
        wide
    )
    # neighbours that are not in use are not asked
    used = ALL.copy()
    used[6, 3:8] = used[4, 3:8] = False
    level[~used] = np.nan
    assert count_outliers(
        np.where(used, level, 0.0), variance, 36.0, clean=~defects & used, good=used
    ) == np.count_nonzero(defects)


@pytest.mark.parametrize("divided", [False, True])
def test_pixels_that_stand_out_before_every_object_are_the_panels_own(divided):
    rng = np.random.default_rng(5)
    signal = np.full(SHAPE, 3000.0)
    gain = rng.uniform(0.5, 1.5, SHAPE)  # of pixels; frames that were divided by it show nothing of it
    dead, hot = (20, 30), (50, 90)
    seen = []
    for number in range(5):
        scene = signal.copy()
        scene[:, 10 + 20 * number :] *= 0.4  # each product's outline lies elsewhere, and is drawn a pixel off
        scene[70:] *= 0.7  # but for one side, on which all of them lie
        drawn = np.roll(scene, 1, axis=(0, 1))
        for exposure_ms in (25.0, 100.0):
            picture = scene + 30.0 * rng.standard_normal(SHAPE)
            picture[dead] = 0.0
            picture[hot] += 5.0 * exposure_ms  # stands out of the longer exposure alone
            name = f"product{number}_{exposure_ms:g}ms"
            series = SimpleNamespace(
                kind="object",
                scene=f"product{number}",
                kV=60.0,
                exposure_ms=exposure_ms,
                corrected=frozenset(("offset", "gain") if divided else ()),
            )
            request = SimpleNamespace(beam_on=True)
            seen.append(
                SimpleNamespace(
                    session=SimpleNamespace(name=name, series=series, request=request, calibrates=False),
                    look=SimpleNamespace(mean_DN=picture if divided else picture * gain),
                    expected=SimpleNamespace(signal_DN=drawn),
                )
            )
    maps = CalibratedMaps(
        darks=SimpleNamespace(under=lambda item: np.zeros(SHAPE)),
        gain=gain,
        shares={},
        beams={},
        gain_darks={},
        gain_quantum=0.0,
        gain_white=0.0,
        good=ALL,
    )
    assert [tuple(place) for place in np.argwhere(new_outliers(seen, maps, counting=False).bad)] == [dead, hot]
    # three products are too few to tell a defect from what they have in common
    assert not new_outliers(seen[:6], maps, counting=False).any.any()


def dark_of(frames, mean_DN):
    """A later dark as the search for pixels that stand out takes it, and the maps of a dark of 100 DN."""
    dark = SimpleNamespace(kind="dark", exposure_ms=100.0, corrected=frozenset())
    item = SimpleNamespace(name="dark", series=dark, request=SimpleNamespace(beam_on=False), calibrates=False)
    look = SimpleNamespace(
        frames=len(frames),
        mean_DN=mean_DN,
        pair_variance_DN2=np.mean(np.diff(frames, axis=0) ** 2, axis=0) / 2.0,
        unchanged_share=np.mean(frames[1:] == frames[:-1], axis=0),
    )
    maps = CalibratedMaps(
        darks=SimpleNamespace(under=lambda item: np.full(SHAPE, 100.0)),
        gain=np.ones(SHAPE),
        shares={},
        beams={},
        gain_darks={},
        gain_quantum=0.0,
        gain_white=0.0,
        good=ALL,
    )
    return SimpleNamespace(session=item, look=look), maps


def test_noise_that_a_line_has_in_common_makes_no_pixel_of_it_stand_out():
    rng = np.random.default_rng(6)
    frames = 5.0 * rng.standard_normal((12, *SHAPE))
    frames[:, 44] += 20.0 * rng.standard_normal((12, 1))  # a line that jumps as a whole
    noisy = (70, 33)
    frames[:, *noisy] *= 6.0
    seen, maps = dark_of(frames, 100.0 + rng.standard_normal(SHAPE))
    pairs = seen.look.pair_variance_DN2
    assert np.median(pairs[44]) > 8.0 * np.median(pairs)
    assert [tuple(place) for place in np.argwhere(new_outliers([seen], maps, counting=False).bad)] == [noisy]


def test_a_pixel_that_the_adc_puts_on_the_next_code_is_no_defect():
    rng = np.random.default_rng(7)
    level = rng.normal(100.0, 7.0, SHAPE)
    frames = 80.0 * np.round((level + 3.0 * rng.standard_normal((12, *SHAPE))) / 80.0)
    assert 5 < np.count_nonzero(np.any(frames != 80.0, axis=0)) < 0.02 * level.size
    seen, maps = dark_of(frames, frames.mean(axis=0))
    assert not new_outliers([seen], maps, counting=False).any.any()
    # numbers of a counter are its quanta
    assert new_outliers([seen], maps, counting=True).bad.any()
