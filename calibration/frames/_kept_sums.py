"""Per-pixel results of many series without holding them all in memory: large ones wait on disk until they are asked for."""

import tempfile
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from .frame_sums import FrameSums

_IN_MEMORY_BYTES = 2**20  # a series' maps; larger ones go to the folder


class KeptSums:
    """What photon transfer asks of a series' sums; see `FrameSums` for the names. Variances are in single precision."""

    def __init__(self, total: FrameSums, folder: Path, number: int) -> None:
        self.frames = total.frames
        self.pairs = total.pairs
        self.pixels = int(total.reference.size)
        self.frame_mean_DN = total.frame_mean_DN
        self.maximum_DN = total.maximum_DN
        self.maximum_count = total.maximum_count
        self.integer = total.integer
        self._maps: dict[str, NDArray[np.float64] | NDArray[np.float32] | Path] = {}
        for name, values in (
            ("mean", total.mean_DN),
            ("pair", total.pair_variance_DN2.astype(np.float32)),
            ("stack", total.stack_variance_DN2.astype(np.float32)),
        ):
            self._maps[name] = values
            if total.reference.nbytes > _IN_MEMORY_BYTES:
                path = folder / f"{number}_{name}.npy"
                np.save(path, values, allow_pickle=False)
                self._maps[name] = path

    def _read(self, name: str) -> NDArray[np.float64]:
        kept = self._maps[name]
        if isinstance(kept, Path):
            kept = np.load(kept, mmap_mode="r", allow_pickle=False)
        return np.asarray(kept, dtype=np.float64)

    @property
    def mean_DN(self) -> NDArray[np.float64]:
        """Mean frame (row, column), DN."""
        return self._read("mean")

    @property
    def pair_variance_DN2(self) -> NDArray[np.float64]:
        """Variance from successive differences (row, column), DN^2."""
        return self._read("pair")

    @property
    def stack_variance_DN2(self) -> NDArray[np.float64]:
        """Variance over the stack (row, column), DN^2."""
        return self._read("stack")


class SumsKeeper:
    """A temporary folder for the maps of many series; use it in a `with` block."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="raytwin_", ignore_cleanup_errors=True)
        self._count = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._folder.cleanup()

    def keep(self, total: FrameSums) -> KeptSums:
        """The sums' maps, in memory where they are small."""
        self._count += 1
        return KeptSums(total, Path(self._folder.name), self._count)
