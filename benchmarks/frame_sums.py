"""Streaming sums of frames: 200 frames of 760 x 956 uint16 against numpy's var, and the memory that 5000 frames take.

    python benchmarks/frame_sums.py

The ratio is that of the medians of runs side by side in one process; peak memory is that of a process of its own, to
which 5000 frames come as drawn pieces of 11 frames (16 MB).
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raytwin.calibration.frames.frame_sums import sum_frames

FRAMES, SHAPE, TURNS = 200, (760, 956), 5
STREAMED, PIECE = 5000, 11


def drawn_pieces(frames: int) -> Iterator[NDArray[Any]]:
    random = np.random.default_rng(1)
    for start in range(0, frames, PIECE):
        yield random.integers(20000, 20512, size=(min(PIECE, frames - start), *SHAPE), dtype=np.uint16)


def stream(frames: int) -> None:
    begin = time.perf_counter()
    total = sum_frames(drawn_pieces(frames))
    # of this process alone: getrusage would count the parent's peak from before exec
    peak_kB = next(
        line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")
    )
    print(
        f"{total.frames} streamed frames: peak memory {int(peak_kB) / 1e3:.0f} MB, {time.perf_counter() - begin:.1f} s with drawing"
    )


def main() -> None:
    if sys.argv[1:2] == ["stream"]:
        stream(int(sys.argv[2]))
        return
    frames = np.random.default_rng(2).poisson(3000.0, size=(FRAMES, *SHAPE)).astype(np.uint16)
    sum_frames([frames[:2]])  # compiled or read from the cache, not timed
    sums_s, numpy_s = [], []
    for _ in range(TURNS):
        begin = time.perf_counter()
        total = sum_frames([frames])
        variance = total.stack_variance_DN2
        sums_s.append(time.perf_counter() - begin)
        begin = time.perf_counter()
        expected = frames.var(axis=0, ddof=1)
        numpy_s.append(time.perf_counter() - begin)
        apart = float(np.max(np.abs(variance / expected - 1)))
        print(f"sums {sums_s[-1]:.3f} s, numpy var {numpy_s[-1]:.2f} s, largest relative difference {apart:.1e}")
    print(f"ratio of the medians {np.median(numpy_s) / np.median(sums_s):.1f} (sums of mean, variance, pairs, maximum)")
    del frames
    for count in (STREAMED // 10, STREAMED):
        subprocess.run([sys.executable, __file__, "stream", str(count)], check=True)


if __name__ == "__main__":
    main()
