"""What the forward model makes once and keeps between calls."""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..line.line_state import FloatArray

_BUDGET_BYTES = 600_000_000
_ENTRY_BYTES = 1000  # key and bookkeeping of a small result
_CARRIED = 64  # results that are carried on at a time, some 0.3 MB each at 128 x 128 pixels


@dataclass(slots=True, eq=False)
class Carried:
    """A result that the next one begins with: `value` is what `owner` made of `steps`, one after the other."""

    owner: object
    steps: tuple[object, ...] = ()
    value: Any = None

    def begins(self, steps: Sequence[object]) -> bool:
        """Whether it was made of the first of these very steps."""
        return len(self.steps) <= len(steps) and all(a is b for a, b in zip(self.steps, steps, strict=False))

    def take(self, steps: tuple[object, ...], value: Any) -> None:
        """Hold another one."""
        self.steps, self.value = steps, value


@dataclass(slots=True, kw_only=True, eq=False)
class ModelCache:
    """Scenes, beams and light, kept between calls of the forward model; what was asked longest ago goes first beyond `budget_bytes`.

    draft: pictures are only compared with each other, and may be drawn with less work (see `_spread.spread_maps`); cells finer
    than pixels are those of the twin's own spectrum; maps whose pixels are all alike are (1, 1).
    """

    budget_bytes: int = _BUDGET_BYTES
    draft: bool = False
    _kept: "OrderedDict[tuple[Hashable, ...], tuple[tuple[object, ...], Any, int]]" = field(default_factory=OrderedDict)
    _held: int = 0
    _carried: "OrderedDict[Hashable, Carried]" = field(default_factory=OrderedDict)

    def made(self, kind: str, owners: tuple[object, ...], key: Hashable, make: Callable[[], Any]) -> Any:
        """What `make` gives, made once.

        Args:
            kind: of the result.
            owners: what it is made of; they stand for themselves, not for what equals them.
            key: numbers and names that it is made of besides.
        """
        # owners are held, so that no other object takes their identity
        whole = (kind, *map(id, owners), key)
        found = self._kept.get(whole)
        if found is None:
            value = make()
            size = (
                _ENTRY_BYTES + _bytes(value) + sum(_bytes(owner) for owner in owners if isinstance(owner, np.ndarray))
            )
            self._kept[whole] = found = (owners, value, size)
            self._held += size
            while self._held > self.budget_bytes and len(self._kept) > 1:
                self._held -= self._kept.popitem(last=False)[1][2]
        else:
            self._kept.move_to_end(whole)
        return found[1]

    def carried(self, owner: object, key: Hashable) -> "Carried":
        """What an owner found last under a key; nothing yet where it is asked first."""
        found = self._carried.get(key)
        if found is None or found.owner is not owner:
            self._carried[key] = found = Carried(owner)
        self._carried.move_to_end(key)
        while len(self._carried) > _CARRIED:
            self._carried.popitem(last=False)
        return found

    def pixels(self, owner: object, key: Hashable, read: Callable[[], NDArray[np.floating]]) -> FloatArray:
        """A map (row, column) of the detector's; a draft's may be (1, 1)."""

        def whole() -> FloatArray:
            image = np.asarray(read(), dtype=np.float64)
            return image[:1, :1].copy() if self.draft and float(np.ptp(image)) == 0.0 else image

        return np.asarray(self.made("pixels", (owner,), key, whole))


def _bytes(value: object) -> int:
    if isinstance(value, tuple):
        return sum(map(_bytes, value))
    return int(getattr(value, "nbytes", 0))
