"""How long work tells where it stands: to a function of the user's, or as a bar."""

import sys
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from ..errors import InputError

# called with what is being done, how many steps of it are done, and of how many (None: not known)
Progress = Callable[[str, int, int | None], None]


class Bar:
    """A progress bar on standard error, made when work first tells of itself.

    Args:
        only_on_terminal: show nothing where standard error is no terminal.
        unit: what a step is.
    """

    def __init__(self, *, only_on_terminal: bool = False, unit: str = "step") -> None:
        self._only_on_terminal = only_on_terminal
        self._unit = unit
        self._bar: Any = None
        self._counted = False
        self._stage = ""

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        if self._bar is not None and self._counted != (total is not None):
            self.close()
        if self._bar is None:
            from tqdm.auto import tqdm

            self._counted = total is not None
            shown = {} if self._counted else {"bar_format": "{desc}"}
            self._bar = tqdm(
                total=total,
                unit=self._unit,
                file=sys.stderr,
                disable=None if self._only_on_terminal else False,
                **shown,
            )
        if stage != self._stage:
            self._stage = stage
            self._bar.set_description_str(stage, refresh=total is None)
        if total is not None:
            self._bar.total = total
            self._bar.update(done - self._bar.n)

    @property
    def hidden(self) -> bool:
        """Whether the bar is kept from standard error, which is no terminal."""
        return self._bar is not None and bool(self._bar.disable)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the bar, if there is one."""
        if self._bar is not None:
            self._bar.close()
            self._bar, self._stage = None, ""


class Telling:
    """`progress=` as the work uses it: a `with` block around stages and counted steps; None tells nobody."""

    def __init__(self, progress: Progress | bool | None, *, unit: str = "step") -> None:
        if not (progress is None or isinstance(progress, bool) or callable(progress)):
            raise InputError(
                "progress", received=repr(progress), expected="True for a bar, or a function of (stage, done, total)"
            )
        self._own = Bar(unit=unit) if progress is True else None
        self._tell: Progress | None = self._own or (progress if callable(progress) else None)
        self._stage, self._done, self._total = "", 0, 0
        self._stages = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._own is not None:
            self._own.close()

    def stage(self, text: str) -> None:
        """Work has come to a stage, of which it is not known how many there are."""
        if self._tell is not None:
            self._tell(text, self._stages, None)
        self._stages += 1

    def begin(self, text: str, total: int, *, done: int = 0) -> None:
        """Work of `total` steps begins, `done` of them already."""
        self._stage, self._done, self._total = text, done, total
        self._report()

    def advance(self, steps: int = 1) -> None:
        """That many steps more are done."""
        self.reach(self._done + steps)

    def reach(self, done: int) -> None:
        """That many steps are done."""
        self._done = done
        self._report()

    def _report(self) -> None:
        if self._tell is not None:
            self._tell(self._stage, self._done, self._total)
