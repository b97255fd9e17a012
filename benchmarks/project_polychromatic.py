"""Polychromatic image of two materials at 760 x 956 with 100 energies, against numpy's sum in double precision.

    python benchmarks/project_polychromatic.py [--turns 9]

Both sums are exact but for rounding: no table, no interpolation. The largest relative difference is printed with the times.
"""

import argparse
import os
import time

import numpy as np

from raytwin.generator import project_polychromatic

SHAPE = (760, 956)
ENERGIES = 100
PIECE_ROWS = 20


def in_double_precision(thickness: np.ndarray, mu: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The sum as one writes it in numpy, in pieces that stay in the cache."""
    result = np.empty((len(weights), *SHAPE))
    for row in range(0, SHAPE[0], PIECE_ROWS):
        piece = thickness[:, row : row + PIECE_ROWS].astype(np.float64)
        result[:, row : row + PIECE_ROWS] = np.tensordot(weights, np.exp(-np.tensordot(mu.T, piece, axes=1)), axes=1)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=9)
    turns = parser.parse_args().turns
    rng = np.random.default_rng(1)
    thickness = np.stack([rng.uniform(0.0, 40.0, SHAPE), rng.uniform(0.0, 3.0, SHAPE)]).astype(np.float32)
    energies_keV = np.linspace(12.0, 90.0, ENERGIES)
    mu = np.stack([0.02 + 0.08 * (20.0 / energies_keV) ** 3, 0.03 + 0.5 * (20.0 / energies_keV) ** 3])
    number = 1e4 * np.exp(-(((energies_keV - 45.0) / 16.0) ** 2))
    print("moments | raytwin wall, cpu ms | numpy wall, cpu ms | ratio of wall, of cpu | largest relative difference")
    for moments in (1, 2, 4):
        weights = np.stack([number * energies_keV**power for power in range(1, moments + 1)])
        project_polychromatic(thickness, mu, weights)  # compiled or read from the cache, not timed
        mine, theirs = [], []
        for turn in range(turns):
            begin = time.perf_counter(), time.process_time()
            found = project_polychromatic(thickness, mu, weights)
            mine.append((time.perf_counter() - begin[0], time.process_time() - begin[1]))
            if turn < 2:
                begin = time.perf_counter(), time.process_time()
                expected = in_double_precision(thickness, mu, weights)
                theirs.append((time.perf_counter() - begin[0], time.process_time() - begin[1]))
        apart = float(np.max(np.abs(found / expected - 1.0)))
        own, peer = np.median(mine, axis=0), np.median(theirs, axis=0)
        print(
            f"{moments:7d} | {1e3 * own[0]:7.1f} {1e3 * own[1]:7.1f} | {1e3 * peer[0]:7.0f} {1e3 * peer[1]:7.0f}"
            f" | {peer[0] / own[0]:5.0f} {peer[1] / own[1]:5.0f} | {apart:.1e}"
        )
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors, medians of {turns} turns (numpy: 2)")
    print("gVirtualXRay is quoted at 2.5 s on a processor for the like, its mesh tracing included; not measured here")


if __name__ == "__main__":
    main()
