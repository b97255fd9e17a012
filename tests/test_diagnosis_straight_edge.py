"""A straight edge by its oversampled profile: where it runs, and how far pixels depart from it."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from raytwin.diagnosis.model.placing import MeasuredScenes, _as_drawn
from raytwin.diagnosis.probes.registration import local_range
from raytwin.diagnosis.probes.straight_edge import covered_scene, distance_px, scatter_share
from raytwin.generator.line.series_request import SeriesRequest

SHAPE = (64, 80)
RAYS = 15  # along each side of a pixel


def edge(slope, *, rays, on_the_left=False, rough_px=0.0):
    """2 mm behind a border that leans by `slope` pixels a row and wanders by `rough_px` from row to row (row, column), mm."""
    y, x = ((np.arange(count * rays) + 0.5) / rays for count in SHAPE)
    wanders = rough_px * np.random.default_rng(3).standard_normal(SHAPE[0])
    at = 40.3 - slope * (y - 32.0) + np.repeat(wanders, rays)
    covered = (x[None, :] > at[:, None]) != on_the_left
    return 2.0 * covered.reshape(SHAPE[0], rays, SHAPE[1], rays).mean(axis=(1, 3))


def true_distance(slope):
    y, x = (np.arange(count) + 0.5 for count in SHAPE)
    return (x[None, :] - 40.3 + slope * (y[:, None] - 32.0)) / np.hypot(1.0, slope)


@pytest.mark.parametrize("rays", [1, RAYS])
@pytest.mark.parametrize("slope", [0.06, -0.3])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("on_the_left", [False, True])
def test_a_border_is_found_to_a_twentieth_of_a_pixel(rays, slope, turned, on_the_left):
    image, distance = edge(slope, rays=rays, on_the_left=on_the_left), true_distance(slope)
    found = distance_px({"Pb": image.T if turned else image})
    assert np.abs((found.T if turned else found) - distance).max() < 0.05


@pytest.mark.parametrize("slope", [0.06, -0.3])
@pytest.mark.parametrize("turned", [False, True])
def test_points_give_the_pixels_that_the_border_covers(slope, turned):
    points, pixels = edge(slope, rays=1), edge(slope, rays=RAYS)
    found = covered_scene("edge", {"Pb": points.T if turned else points})["Pb"]
    assert np.abs(points - pixels).max() > 0.9  # of 2 mm
    assert np.abs((found.T if turned else found) - pixels).max() < 0.12


@pytest.mark.parametrize(
    "maps",
    [
        {},
        {"Pb": np.zeros(SHAPE)},
        {"water": np.full(SHAPE, 20.0)},
        {"Al": np.broadcast_to(np.arange(80) // 10, SHAPE).astype(float)},
        {"water": np.broadcast_to(np.linspace(0.0, 20.0, 80), SHAPE)},
        {"Pb": edge(0.06, rays=1), "water": np.full(SHAPE, 20.0)},
        {"Pb": np.where(np.hypot(*(np.indices(SHAPE) - 32.0)) < 25.0, 2.0, 0.0)},
    ],
    ids=["nothing", "empty", "slab", "wedge", "slope", "two materials", "disc"],
)
def test_what_is_no_straight_edge_has_none(maps):
    assert distance_px(maps) is None
    assert covered_scene("edge", maps) is None
    assert covered_scene("product", maps) is None


@pytest.mark.parametrize("rays", [1, RAYS])
@pytest.mark.parametrize(("middle", "radius"), [((31.2, 40.7), 21.7), ((33.0, 39.5), 8.4)])
def test_the_middles_of_pixels_give_those_that_a_disc_covers(rays, middle, radius):
    fine = np.stack(np.meshgrid(*((np.arange(side * RAYS) + 0.5) / RAYS - 0.5 for side in SHAPE), indexing="ij"))
    inside = np.hypot(fine[0] - middle[0], fine[1] - middle[1]) < radius
    pixels = 2.0 * inside.reshape(SHAPE[0], RAYS, SHAPE[1], RAYS).mean(axis=(1, 3))
    points = 2.0 * (np.hypot(*(np.indices(SHAPE) - np.reshape(middle, (2, 1, 1)))) < radius)
    found = covered_scene("disc", {"W": pixels if rays > 1 else points})["W"]
    assert np.abs(points - pixels).max() > 0.8  # of 2 mm
    assert np.abs(found - pixels).max() < 0.25
    assert np.sqrt(np.mean((found - pixels)[(pixels > 0) & (pixels < 2)] ** 2)) < 0.1


def test_what_is_no_disc_is_not_drawn_as_one():
    rows, columns = np.indices(SHAPE) - 32.0
    for inside in (
        np.hypot(rows, 0.8 * columns) < 20.0,
        np.maximum(abs(rows), abs(columns)) < 15.0,
        np.hypot(rows, columns) < 3.0,
    ):
        assert covered_scene("disc", {"W": 2.0 * inside}) is None
    beyond_the_border = np.hypot(rows, columns - 45.0) < 20.0
    assert covered_scene("disc", {"W": 2.0 * beyond_the_border}) is None


def share_of(picture, model, slope):
    return scatter_share(
        picture - model, local_range(model), np.ones(SHAPE, bool), distance_px({"Pb": edge(slope, rays=RAYS)})
    )


@pytest.mark.parametrize("slope", [0.06, -0.3])
def test_a_blur_is_alike_all_along_an_edge_and_roughness_is_not(slope):
    model = gaussian_filter(1000.0 * np.exp(-edge(slope, rays=RAYS)), 0.6)
    blurred = gaussian_filter(1000.0 * np.exp(-edge(slope, rays=RAYS)), 1.0)
    rough = gaussian_filter(1000.0 * np.exp(-edge(slope, rays=RAYS, rough_px=0.3)), 0.6)
    assert np.abs(blurred - model).max() > 50.0
    assert share_of(blurred, model, slope) < 0.01
    assert 0.03 < share_of(rough, model, slope) < 0.3


def test_noise_alone_is_the_scatter():
    rng = np.random.default_rng(5)
    model = gaussian_filter(1000.0 * np.exp(-edge(0.06, rays=RAYS)), 0.6)
    away = distance_px({"Pb": edge(0.06, rays=RAYS)})
    ranges = local_range(model)
    near = np.abs(away) < 3.0
    expected = 4.0 / np.sqrt(np.mean(ranges[near] ** 2))
    assert share_of(model + rng.normal(0.0, 4.0, SHAPE), model, 0.06) == pytest.approx(expected, rel=0.1)


def test_too_few_pixels_say_nothing():
    mask = np.zeros(SHAPE, bool)
    mask[30, 38:44] = True
    flat = np.ones(SHAPE)
    assert scatter_share(flat, flat, mask, true_distance(0.06)) == np.inf


@dataclass(frozen=True)
class Asked:
    """What placing reads of a series that is asked for."""

    request: SeriesRequest
    series: SimpleNamespace


@dataclass(frozen=True)
class Item:
    """What placing reads of a series."""

    name: str
    session: Asked
    expected: SimpleNamespace


def drawn(request):
    """A picture of an edge, displaced, behind a spread of 0.5 px: level 1000 DN, Poisson noise, 2 DN of read noise."""
    light = 1000.0 * np.exp(-request.thickness_mm["Pb"])
    picture = gaussian_filter(shift(light, request.displacement_px, order=1, mode="nearest"), 0.5)
    return SimpleNamespace(signal_DN=picture, quantum_variance_DN2=picture, white_variance_DN2=np.full(SHAPE, 4.0))


@pytest.mark.parametrize(("stated", "rays"), [(1, 1), (1, RAYS), (6, RAYS), (6, 6)])
def test_a_border_is_drawn_as_it_shows(stated, rays):
    """Frames of as few points as the map keep it; frames of whole pixels have the border drawn as it runs."""
    points = {"Pb": edge(0.06, rays=stated)}
    asked = SeriesRequest(
        kind="object", setting=None, frames=10, exposure_ms=100.0, thickness_mm=points, scene_kind="edge"
    )
    truth = drawn(replace(asked, thickness_mm={"Pb": edge(0.06, rays=rays)})).signal_DN
    seen = truth + np.random.default_rng(4).normal(0.0, np.sqrt(truth / 10.0))
    items = [Item("edge", Asked(asked, SimpleNamespace(n_frames=10)), drawn(asked))]
    measured = MeasuredScenes(pictures={"edge": seen}, clean=np.ones(SHAPE, bool), sharp=False, expect=drawn)
    members, placement = _as_drawn(items, measured)
    left = np.abs(members[0].session.request.thickness_mm["Pb"] - edge(0.06, rays=rays)).max()
    assert left < 0.12
    assert (members is items) == (rays == stated)
    assert math.hypot(placement.row_px * 0.06, placement.column_px) < 0.05
