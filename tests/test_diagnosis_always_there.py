"""What every line shows a little is no effect: noise of lines, smooth change of shape, dust, a few new bad pixels."""

from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.acquisition import open_acquisition
from raytwin.diagnosis.diagnose_session import diagnose
from raytwin.diagnosis.model import changes as scales
from raytwin.diagnosis.model.calibrated_maps import CalibratedMaps
from raytwin.diagnosis.model.defects import new_outliers
from raytwin.diagnosis.problem.line_noise import usual_line_noise
from raytwin.diagnosis.problem.nuisance_columns import _of_field, _shapes
from raytwin.diagnosis.session.summaries import BLOCK_PX, LAGS, summarise_series
from raytwin.lab.protocols import run_protocol

SHAPE = (64, 96)
ALL = np.ones(SHAPE, dtype=bool)


def dark_frames(rng, *, rows, columns, frames=200, sigma=10.0):
    noise = sigma * rng.standard_normal((frames, *SHAPE))
    noise += sigma * rows * rng.standard_normal((frames, SHAPE[0], 1))
    return noise + sigma * columns * rng.standard_normal((frames, 1, SHAPE[1])) + 1000.0


def summary_of(frames):
    return summarise_series([frames], good=ALL, labels=np.zeros(SHAPE, dtype=np.int64))


def usual_of(summary):
    series = SimpleNamespace(kind="dark")
    item = SimpleNamespace(name="dark", series=series, calibrates=True, request=SimpleNamespace(exposures_per_frame=1))
    model = SimpleNamespace(row_variance_DN2=0.0, column_variance_DN2=0.0)
    return usual_line_noise([SimpleNamespace(name="dark", session=item, expected=model)], {"dark": summary}, ALL)


def test_noise_of_lines_is_found_up_to_what_is_no_effect():
    rng = np.random.default_rng(1)
    rows, columns = usual_of(summary_of(dark_frames(rng, rows=0.08, columns=0.05)))
    # of 200 x 64 rows and 200 x 96 columns; a mean over a line has a hundredth of a pixel's variance besides
    assert rows == pytest.approx(0.64, abs=0.12) and columns == pytest.approx(0.25, abs=0.12)
    rows, columns = usual_of(summary_of(dark_frames(rng, rows=0.5, columns=0.0)))
    assert rows == pytest.approx(scales.LINE_NOISE_LIMIT**2 * 125.0, rel=0.05)
    assert 0.0 <= columns < 0.1


def test_without_the_noise_of_lines_a_summary_is_that_of_white_noise():
    rng = np.random.default_rng(2)
    summary = summary_of(dark_frames(rng, rows=0.1, columns=0.07))
    freed = summary.without_lines(1.0, 0.49)
    white = 100.0
    for index, _ in enumerate(LAGS):
        assert abs(float(freed.label_autocovariance_DN2[0, index])) < 0.25
    assert freed.row_variance_DN2 * SHAPE[1] == pytest.approx(white, rel=0.12)
    assert freed.column_variance_DN2 * SHAPE[0] == pytest.approx(white, rel=0.12)
    assert freed.block_variance_DN2 * BLOCK_PX**2 == pytest.approx(white, rel=0.06)
    assert summary.row_variance_DN2 * SHAPE[1] > 1.7 * white


def test_smooth_changes_of_shape_add_up_to_their_limit():
    shapes = np.stack(_shapes(SHAPE))
    variance = np.sum([np.mean(shape**2) for shape in shapes])
    assert np.sqrt(variance) == pytest.approx(scales.SHAPE_SD)
    # no level, which has a nuisance of its own
    assert np.all(np.abs(shapes.mean(axis=(1, 2))) < 0.05 * np.sqrt(np.mean(shapes**2, axis=(1, 2))))


def test_what_changes_slowly_is_one_change_for_all_series_since_the_calibration():
    def images(name, calibrates):
        request = SimpleNamespace(exposure_ms=100.0)
        series = SimpleNamespace(kV=60.0, filters=(), current_mA=1.0, power_W=None, exposure_ms=100.0)
        item = SimpleNamespace(name=name, calibrates=calibrates, request=request, series=series, divided=False)
        return _of_field(item, np.full(SHAPE, 1000.0), 1.0)

    before, first, second = images("before", True), images("first", False), images("second", False)
    shared = {name for name in first if name.endswith("since the calibration")}
    assert len(shared) == len(_shapes(SHAPE)) and shared == set(first) & set(second) - set(before)
    # in either series it looks as a change of its own does
    for number in range(len(shared)):
        own = first[f"shape {number} of first"]
        assert np.array_equal(first[f"shape {number} since the calibration"], own)


def test_dust_on_a_flat_is_left_out_and_makes_no_bad_pixel():
    rng = np.random.default_rng(3)
    signal = 20000.0
    picture = signal + 10.0 * rng.standard_normal(SHAPE)
    picture[20:23, 40:43] -= 0.006 * signal
    picture[50, 70] *= 0.9
    series = SimpleNamespace(kind="flat", exposure_ms=100.0, corrected=frozenset())
    item = SimpleNamespace(name="flat", series=series, request=SimpleNamespace(beam_on=True), calibrates=False)
    still = np.zeros(SHAPE)
    look = SimpleNamespace(frames=9, mean_DN=picture, pair_variance_DN2=np.full(SHAPE, 900.0), unchanged_share=still)
    maps = CalibratedMaps(
        darks=SimpleNamespace(under=lambda item: np.zeros(SHAPE)),
        gain=np.ones(SHAPE),
        shares={},
        beams={},
        gain_darks={},
        gain_quantum=0.0,
        gain_white=0.0,
        good=ALL,
    )
    expected = SimpleNamespace(signal_DN=np.full(SHAPE, signal))
    found = new_outliers([SimpleNamespace(session=item, expected=expected, look=look)], maps, counting=False)
    assert [tuple(place) for place in np.argwhere(found.bad)] == [(50, 70)]
    assert found.any[20:23, 40:43].all() and np.count_nonzero(found.any) == 10


@pytest.mark.slow
@pytest.mark.parametrize("geometry", ["coarse", "fine"])
def test_a_line_with_all_its_little_unkindness_and_no_effect_has_no_gap(geometry, tmp_path):
    path = tmp_path / "s.h5"
    run_protocol(path, protocol="short", seed=701, rows=64, frames=16, products=2, geometry=geometry)
    with open_acquisition(path) as acquisition:
        found = diagnose(acquisition, rng=np.random.default_rng(1))
    assert found.verdict == "no_gap" and found.named == ()
