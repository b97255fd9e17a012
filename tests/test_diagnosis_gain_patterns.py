"""Patterns of the gain: what they leave in a mean frame and in projections, against panels on which they are drawn one by one."""

from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.diagnosis.probes.fixed_pattern import pattern_statistics, shares_of_pixels, shares_of_tiles
from raytwin.diagnosis.probes.map_probes import MapProjection, Template
from raytwin.diagnosis.problem.nuisance_columns import changed_tiles
from raytwin.generator.frames.defects import gain_pattern, tile_gain
from raytwin.generator.line.line_state import FixedPattern, LineState, TilePattern

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


@pytest.mark.parametrize(("side_px", "strips_share"), [(32.0, 0.0), (32.0, 1.0), (21.0, 0.5)])
def test_what_tiles_leave_in_a_pattern_is_the_mean_over_panels_with_drawn_gains(side_px, strips_share):
    def tiles(seed):
        return TilePattern(rms=0.01, side_px=side_px, strips_share=strips_share, seed=seed)

    known = 10.0**2 * shares_of_tiles(SHAPE, tiles(0))
    # the smooth surface that is taken off first leaves a little of itself between the blocks
    np.testing.assert_allclose(mean_of_drawn(lambda seed: tile_gain(tiles(seed), SHAPE)), known, rtol=0.08, atol=1e-3)


@pytest.mark.parametrize("correlation_px", [0.0, 1.5, 5.0])
def test_what_pixels_that_are_alike_leave_is_the_mean_over_panels_with_drawn_gains(correlation_px):
    def drawn(seed):
        return gain_pattern(FixedPattern(rms=0.01, seed=seed, correlation_px=correlation_px), SHAPE)

    known = 10.0**2 * shares_of_pixels(SHAPE, correlation_px)
    np.testing.assert_allclose(mean_of_drawn(drawn), known, rtol=0.12, atol=2e-3)
    panels = np.stack([drawn(seed) for seed in range(60)]) - 1.0
    assert panels.std() == pytest.approx(0.01, rel=0.03)


@pytest.mark.parametrize("correlation_px", [0.0, 1.5, 5.0])
def test_projections_vary_by_as_much_as_over_drawn_panels(correlation_px):
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
    known = projection.field_noise(0.01 * SIGNAL, max(np.sqrt(2.0 * np.pi) * correlation_px, 1.0))
    drawn = np.stack(
        [
            gain_pattern(FixedPattern(rms=0.01, seed=seed, correlation_px=correlation_px), SHAPE) - 1.0
            for seed in range(400)
        ]
    )
    seen = projection.apply(drawn * SIGNAL).var(axis=0)
    # squares stand for areas that fade out: what is as narrow as they are varies by another factor
    for name, one, other in zip(images, known, seen, strict=True):
        assert one == pytest.approx(other, rel=0.35 if name in ("level", "along", "disc") else 1.5), name


@pytest.mark.parametrize("strips_share", [0.0, 1.0, 0.4])
def test_what_tiles_do_to_a_mean_frame_by_chance_has_the_covariance_of_drawn_panels(strips_share):
    rng = np.random.default_rng(4)
    signal = 1000.0 + 3.0 * np.arange(SHAPE[1]) * np.ones((SHAPE[0], 1))
    # what projections weigh pixels with; none sees the level that all tiles share
    rows = rng.standard_normal((5, *SHAPE)) + np.linspace(-1.0, 1.0, SHAPE[1])
    rows -= (rows * signal).mean(axis=(1, 2), keepdims=True) / signal.mean()

    class Projection:
        def __len__(self):
            return len(rows)

        def apply(self, images):
            return np.tensordot(images, rows, axes=((1, 2), (1, 2)))

    class Probes:
        projection = Projection()

        def __len__(self):
            return len(rows) + 2  # two scalars besides

    def probes(*, calibrates, beam_on=True):
        found = Probes()
        session = SimpleNamespace(calibrates=calibrates, request=SimpleNamespace(beam_on=beam_on))
        found.series = SimpleNamespace(session=session)
        return found

    tiles = TilePattern(rms=0.01, side_px=32.0, strips_share=strips_share, seed=0)
    found = changed_tiles(probes(calibrates=False), signal, tiles)
    assert not found[len(rows) :].any()
    assert not changed_tiles(probes(calibrates=True), signal, tiles).any()
    assert not changed_tiles(probes(calibrates=False, beam_on=False), signal, tiles).any()
    drawn = np.stack([signal * (tile_gain(replace(tiles, seed=seed), SHAPE) - 1.0) for seed in range(2000)])
    seen = Projection().apply(drawn)
    known = (found @ found.T)[: len(rows), : len(rows)]
    size = np.sqrt(np.outer(np.diag(known), np.diag(known)))
    np.testing.assert_allclose(seen.T @ seen / len(seen) / size, known / size, atol=5.0 * np.sqrt(2.0 / 2000))


def test_the_example_of_tiles_declares_what_the_diagnosis_draws():
    path = Path(__file__).parents[1] / "docs" / "examples" / "tile_gain.py"
    module = module_from_spec(spec := spec_from_file_location("tile_gain_example", path))
    spec.loader.exec_module(module)
    effect = module.TILE_GAIN
    assert effect.variation.random == "tiles" and effect.onsets == ("calibration",)
    state = SimpleNamespace(tile_pattern=None)
    values = effect.values({"strength": 0.5, "side_px": 48.0})
    assert effect.change(state, values, SimpleNamespace(since="always")) is state
    one = np.ones((1, 1))
    lit = LineState(parameters=None, signal_DN=one, variance_DN2=one, flat_factor=one)
    found = effect.change(lit, values, SimpleNamespace(since="calibration")).tile_pattern
    assert found == TilePattern(rms=0.005, side_px=48.0, strips_share=0.0, seed=0)
