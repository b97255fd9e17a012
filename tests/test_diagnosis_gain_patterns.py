"""Patterns of the gain: what they leave in a mean frame and in projections, against panels on which they are drawn one by one."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.diagnosis.model.changes import catalogue_variants, with_seams
from raytwin.diagnosis.probes.fixed_pattern import pattern_statistics, shares_of_pixels, shares_of_tiles
from raytwin.diagnosis.probes.map_probes import MapProjection, Template
from raytwin.diagnosis.probes.tile_seams import SeenSeams, seams_in
from raytwin.diagnosis.problem.nuisance_columns import changed_tiles
from raytwin.errors import InputError
from raytwin.generator.effects import EFFECTS
from raytwin.generator.frames.defects import gain_pattern, tile_gain
from raytwin.generator.line.line_state import FixedPattern, LineState, Seams, TilePattern

SHAPE = (96, 128)
GOOD = np.ones(SHAPE, dtype=bool)
SIGNAL = np.full(SHAPE, 1000.0)


def mean_of_drawn(factor_of_seed, count=300):
    """Mean statistics of so many panels with a pattern of 1 % rms."""
    found = [
        pattern_statistics(SIGNAL * (factor_of_seed(seed) - 1.0), SIGNAL, clean=GOOD, good=GOOD)
        for seed in range(count)
    ]
    return np.mean(found, axis=0)


NONE = Seams()


@pytest.mark.parametrize(
    ("rows", "columns"),
    [
        (Seams(side_px=32.0), Seams(side_px=32.0)),
        (NONE, Seams(side_px=24.0, first_px=11.0)),
        (Seams(side_px=21.0, first_px=5.0), Seams(side_px=24.0)),
    ],
)
def test_what_tiles_leave_in_a_pattern_is_the_mean_over_panels_with_drawn_gains(rows, columns):
    def tiles(seed):
        return TilePattern(rms=0.01, rows=rows, columns=columns, seed=seed)

    known = 10.0**2 * shares_of_tiles(SHAPE, tiles(0))
    # the smooth surface that is taken off first leaves a little of itself between the blocks
    np.testing.assert_allclose(mean_of_drawn(lambda seed: tile_gain(tiles(seed), SHAPE)), known, rtol=0.08, atol=1e-3)


PATTERNS = (
    *(FixedPattern(rms=1.0, seed=0, correlation_px=length) for length in (0.0, 1.5, 5.0)),
    FixedPattern(rms=1.0, seed=0, of_columns=True),
)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_what_pixels_that_are_alike_leave_is_the_mean_over_panels_with_drawn_gains(pattern):
    def drawn(seed):
        return gain_pattern(replace(pattern, rms=0.01, seed=seed), SHAPE)

    known = 10.0**2 * shares_of_pixels(SHAPE, pattern)
    np.testing.assert_allclose(mean_of_drawn(drawn), known, rtol=0.12, atol=2e-3)
    panels = np.stack([drawn(seed) for seed in range(60)]) - 1.0
    assert panels.std() == pytest.approx(0.01, rel=0.03)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_projections_vary_by_as_much_as_over_drawn_panels(pattern):
    rng = np.random.default_rng(1)
    along = np.linspace(-1.0, 1.0, SHAPE[1])[None, :] * np.ones(SHAPE)
    edge = np.exp(-0.5 * ((np.arange(SHAPE[1]) - 60.0) / 2.0) ** 2)[None, :] * np.ones(SHAPE)
    disc = (np.hypot(*np.meshgrid(np.arange(SHAPE[1]) - 40, np.arange(SHAPE[0]) - 50)) < 15).astype(float)
    images = {"level": np.ones(SHAPE), "along": along, "edge": edge, "disc": disc, "pixels": rng.standard_normal(SHAPE)}
    projection = MapProjection(
        [Template(axis="position", name=name, unit="DN", image=image) for name, image in images.items()],
        mask=GOOD,
        quantum_DN2=np.zeros(SHAPE),
        white_DN2=np.ones(SHAPE),
        autocovariance_table=np.eye(1),
    )
    known = projection.field_noise(0.01 * SIGNAL, max(np.sqrt(2.0 * np.pi) * pattern.correlation_px, 1.0))
    if pattern.of_columns:
        known = projection.column_noise(0.01 * SIGNAL)
    drawn = np.stack([gain_pattern(replace(pattern, rms=0.01, seed=seed), SHAPE) - 1.0 for seed in range(400)])
    seen = projection.apply(drawn * SIGNAL).var(axis=0)
    # squares stand for areas that fade out: what is as narrow as they are varies by another factor
    for name, one, other in zip(images, known, seen, strict=True):
        assert one == pytest.approx(other, rel=0.35 if name in ("level", "along", "disc") else 1.5), name


@pytest.mark.parametrize("rows", [Seams(side_px=32.0, first_px=7.0), NONE])
def test_what_tiles_do_to_a_mean_frame_by_chance_has_the_covariance_of_drawn_panels(rows):
    rng = np.random.default_rng(4)
    signal = 1000.0 + 3.0 * np.arange(SHAPE[1]) * np.ones((SHAPE[0], 1))
    # what projections weigh pixels with
    weights = rng.standard_normal((5, *SHAPE)) + np.linspace(-1.0, 1.0, SHAPE[1])

    class Projection:
        def __len__(self):
            return len(weights)

        def apply(self, images):
            return np.tensordot(images, weights, axes=((1, 2), (1, 2)))

    class Probes:
        projection = Projection()

        def __len__(self):
            return len(weights) + 2  # two scalars besides

    def probes(*, calibrates, beam_on=True):
        found = Probes()
        session = SimpleNamespace(calibrates=calibrates, request=SimpleNamespace(beam_on=beam_on))
        found.series = SimpleNamespace(session=session)
        return found

    tiles = TilePattern(rms=0.01, rows=rows, columns=Seams(side_px=32.0), seed=0)
    found = changed_tiles(probes(calibrates=False), signal, tiles)
    assert not found[len(weights) :].any()
    assert not changed_tiles(probes(calibrates=True), signal, tiles).any()
    assert not changed_tiles(probes(calibrates=False, beam_on=False), signal, tiles).any()
    drawn = np.stack([signal * (tile_gain(replace(tiles, seed=seed), SHAPE) - 1.0) for seed in range(2000)])
    seen = Projection().apply(drawn)
    known = (found @ found.T)[: len(weights), : len(weights)]
    size = np.sqrt(np.outer(np.diag(known), np.diag(known)))
    np.testing.assert_allclose(seen.T @ seen / len(seen) / size, known / size, atol=5.0 * np.sqrt(2.0 / 2000))


def test_the_effect_of_tiles_draws_them_where_its_parameters_say():
    effect = EFFECTS["tile_gain"]
    one = np.ones((1, 1))
    lit = LineState(parameters=None, signal_DN=one, variance_DN2=one, flat_factor=one)
    values = effect.values({"strength": 0.5, "rows_px": 0.0, "columns_px": 48.0, "first_columns_px": 10.0})
    assert effect.change(lit, values, SimpleNamespace(since="always")) is lit
    found = effect.change(lit, values, SimpleNamespace(since="calibration")).tile_pattern
    assert found == TilePattern(rms=0.005, rows=NONE, columns=Seams(side_px=48.0, first_px=10.0), seed=0)
    with pytest.raises(InputError, match="rows_px of tile_gain: got -5"):
        effect.change(lit, {**values, "rows_px": -5.0}, SimpleNamespace(since="calibration"))
    gain = tile_gain(found, SHAPE)
    assert gain.mean() == pytest.approx(1.0, abs=1e-12) and np.ptp(gain, axis=0).max() == 0.0
    np.testing.assert_array_equal(np.flatnonzero(np.diff(gain[0])) + 1, [10, 58, 106])


@pytest.mark.parametrize("rows", [Seams(side_px=29.0, first_px=20.0), NONE])
def test_seams_are_found_where_they_are_beside_noise_a_pattern_and_a_bent_field(rows):
    rng = np.random.default_rng(3)
    columns = Seams(side_px=37.0, first_px=12.0)
    steps = tile_gain(TilePattern(rms=0.008, rows=rows, columns=columns, seed=5), SHAPE) - 1.0
    bent = 0.02 * np.linspace(-1.0, 1.0, SHAPE[0])[:, None] ** 2
    pattern = gain_pattern(FixedPattern(rms=0.004, seed=2, correlation_px=1.5), SHAPE) - 1.0
    seen = seams_in([steps + bent + pattern + 0.002 * rng.standard_normal(SHAPE)], [1.0], GOOD)
    assert (seen.rows, seen.columns) == (rows, columns) and seen.log_prior < -8.0


@pytest.mark.parametrize("pattern", [PATTERNS[0], PATTERNS[1], PATTERNS[-1]])
def test_a_pattern_or_a_lone_stretch_of_pixels_has_no_seams(pattern):
    found = []
    for seed in range(8):
        change = gain_pattern(replace(pattern, rms=0.01, seed=seed), SHAPE) - 1.0
        change[:12, 40:44] += 0.05
        found.append(seams_in([change], [1.0], GOOD).any)
    assert sum(found) <= 1


def test_no_flat_shows_no_seams_and_an_even_one_neither():
    assert seams_in([], [], GOOD) is None
    assert not seams_in([np.zeros(SHAPE)], [1.0], GOOD).any


def test_gains_of_tiles_are_tried_where_seams_are_and_not_told_where_no_flat_can_show_them():
    other, tiles = (next(one for one in catalogue_variants() if one.effect == name) for name in ("heel", "tile_gain"))
    seen = SeenSeams(rows=NONE, columns=Seams(side_px=48.0, first_px=10.0), log_prior=-8.0)
    kept, found = with_seams([other, tiles], seen)
    assert kept is other and found.log_prior == -8.0
    places = {"rows_px": 0.0, "first_rows_px": 0.0, "columns_px": 48.0, "first_columns_px": 10.0}
    assert {name: found.parameters[name] for name in places} == places
    assert with_seams([other, tiles], replace(seen, columns=NONE)) == [other]
    # one tile as large as the panel: nothing responds, and the answer says so
    _, whole = with_seams([other, tiles], None)
    assert (whole.parameters["rows_px"], whole.parameters["columns_px"]) == (0.0, 0.0)
