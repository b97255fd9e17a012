"""Gains of tiles: what they leave in a mean frame, against panels on which they are drawn one by one."""

import numpy as np
import pytest

from raytwin.diagnosis.probes.fixed_pattern import pattern_statistics, shares_of_tiles
from raytwin.generator.frames.defects import tile_gain
from raytwin.generator.line.line_state import TilePattern

SHAPE = (96, 128)


@pytest.mark.parametrize(("side_px", "strips_share"), [(32.0, 0.0), (32.0, 1.0), (21.0, 0.5)])
def test_what_tiles_leave_in_a_pattern_is_the_mean_over_panels_with_drawn_gains(side_px, strips_share):
    good = np.ones(SHAPE, dtype=bool)
    signal = np.full(SHAPE, 1000.0)
    drawn = []
    for seed in range(300):
        tiles = TilePattern(rms=0.01, side_px=side_px, strips_share=strips_share, seed=seed)
        found = pattern_statistics(signal * (tile_gain(tiles, SHAPE) - 1.0), signal, clean=good, good=good)
        drawn.append([found.pixel_DN2, found.blocks_DN2, found.rows_DN2, found.columns_DN2])
    known = shares_of_tiles(SHAPE, tiles).times(10.0**2)
    for seen, expected in zip(
        np.array(drawn).T, (known.pixel_DN2, known.blocks_DN2, known.rows_DN2, known.columns_DN2), strict=True
    ):
        # the smooth surface that is taken off first leaves a little of itself between the blocks
        assert seen.mean() == pytest.approx(expected, rel=0.08, abs=1e-3)
