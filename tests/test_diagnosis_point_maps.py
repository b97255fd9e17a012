"""Maps sampled at points are told from means over pixels by how their borders jump."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from raytwin.diagnosis.model.point_maps import blurred_between_points, sampled_at_points
from raytwin.diagnosis.problem.nuisance_columns import _between_points

FINE = 15  # places along each side of a pixel


def plate(shape, slope, *, at, rays):
    """2 mm behind a border that leans by `slope` pixels a row, `rays` along each side of a pixel."""
    rows, columns = shape
    y, x = (((np.arange(count * rays) + 0.5) / rays)[:, None] for count in shape)
    thickness = np.where(x.T + slope * y > at, 2.0, 0.0)
    return thickness.reshape(rows, rays, columns, rays).mean(axis=(1, 3))


def ball(shape, radius_px, *, rays):
    y, x = (((np.arange(count * rays) + 0.5) / rays - 0.5 * count)[:, None] for count in shape)
    thickness = 2.0 * np.sqrt(np.clip(radius_px**2 - y**2 - x.T**2, 0.0, None))
    return thickness.reshape(shape[0], rays, shape[1], rays).mean(axis=(1, 3))


@pytest.mark.parametrize("slope", [0.06, -0.3, 1.7])
@pytest.mark.parametrize("turned", [False, True])
def test_a_leaning_border_tells_points_from_pixels(slope, turned):
    def lying(image):
        return {"Pb": image.T if turned else image}

    where = 40.0 + 32.0 * slope
    assert sampled_at_points(lying(plate((64, 80), slope, at=where, rays=1)))
    assert not sampled_at_points(lying(plate((64, 80), slope, at=where, rays=FINE)))


def test_one_material_of_points_is_enough_and_light_ones_beside_it_do_not_hide_it():
    sharp = plate((64, 80), 0.06, at=42.0, rays=1)
    assert sampled_at_points({"Pb": sharp, "water": np.full((64, 80), 20.0)})


def test_noise_free_rays_that_lean_leave_it_a_plate():
    """Rays of a cone cross a plate at an angle: paths differ by 1e-3 across the field."""
    sharp = plate((64, 80), 0.06, at=42.0, rays=1)
    assert sampled_at_points({"Pb": sharp * (1.0 + 1e-3 * np.linspace(-1.0, 1.0, 80) ** 2)})


@pytest.mark.parametrize(
    "maps",
    [
        None,
        {},
        {"water": np.full((64, 80), 20.0)},
        {"water": np.zeros((64, 80))},
        {"water": np.linspace(0.0, 20.0, 80) * np.ones((64, 1))},
        {"water": ball((64, 80), 25.0, rays=1)},
        {"water": ball((64, 80), 25.0, rays=FINE)},
        {"Pb": plate((8, 8), 0.06, at=4.0, rays=1)},
        {"Pb": np.ones((3, 3))},
    ],
)
def test_what_has_no_borders_to_judge_is_not_called_sampled(maps):
    assert not sampled_at_points(maps)


def left_of(change, images, noise):
    """Rms of a picture (row, column) once images of unit prior sd took their part, over what it was; pixels' noise given."""
    columns = np.stack([image.ravel() for image in images], axis=1).astype(np.float64) / noise
    wanted = change.ravel() / noise
    found = np.linalg.solve(np.eye(columns.shape[1]) + columns.T @ columns, columns.T @ wanted)
    return float(np.linalg.norm(wanted - columns @ found) / np.linalg.norm(wanted))


@pytest.mark.parametrize("slope", [0.02, 0.06])
@pytest.mark.parametrize("blur_px", [1.1, 1.5])
def test_where_a_blurred_border_runs_between_points_is_left_open(slope, blur_px):
    """A border that leans is blurred where it runs; blurring the jumps of points along it leaves waves, which no effect has."""
    shape, where = (96, 112), 40.0 + 48.0 * slope
    points = plate(shape, slope, at=where, rays=1)
    covered = 0.5 * plate(shape, slope, at=where, rays=FINE)
    lit = np.exp(-points)
    truly = 1.0 + (np.exp(-2.0) - 1.0) * covered
    between = blurred_between_points({"Pb": points}, lit)
    waves = gaussian_filter(truly, blur_px) - gaussian_filter(lit, blur_px)
    blurs = [gaussian_filter1d(lit, width, axis=axis) - lit for width in (0.5, 1.1, 2.0) for axis in (0, 1)]
    assert left_of(waves, blurs, 1e-3) > 0.6
    assert left_of(waves, [*blurs, *between], 1e-3) < 0.15
    # a blur is the same all along a border, which such waves are not
    assert left_of(gaussian_filter(lit, blur_px) - lit, between, 1e-3) > 0.99


def test_a_border_along_pixels_and_a_plate_that_fills_the_field_add_nothing():
    upright = plate((64, 80), 0.0, at=42.0, rays=1)
    assert np.abs(blurred_between_points({"Pb": upright}, np.exp(-upright))).max() < 0.02
    assert blurred_between_points({"Pb": np.full((64, 80), 2.0)}, np.ones((64, 80))).size == 0


def test_only_maps_of_points_have_borders_between_them():
    points, means = (plate((64, 80), 0.06, at=42.0, rays=rays) for rays in (1, FINE))

    def names(maps):
        request = SimpleNamespace(thickness_mm=maps)
        item = SimpleNamespace(series=SimpleNamespace(scene="edge", source_object_mm=300.0), request=request)
        return set(_between_points(item, np.exp(-points)))

    assert {name.rsplit(",", 1)[0] for name in names({"Pb": points})} == {"outline of edge at 300 between points"}
    assert names({"Pb": means}) == names(None) == set()
