"""The effects that there are: ours, and those that installed packages declare under the entry point `raytwin.effects`."""

from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points

from ...errors import InputError
from .effect import Effect

GROUP = "raytwin.effects"


class Catalogue(Mapping[str, Effect]):
    """Effects by id, ours first; other packages are looked for when the first effect is asked for.

    Each entry point of the group is an `Effect`; its name is the effect's id.

    Args:
        ours: the effects of this package.

    Raises:
        InputError: while asking, for a package whose effect cannot be loaded, is none, or has an id that is taken.
    """

    def __init__(self, ours: Mapping[str, Effect]) -> None:
        self._ours = dict(ours)
        self._all: dict[str, Effect] | None = None

    def __getitem__(self, key: str) -> Effect:
        return self._found()[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._found())

    def __len__(self) -> int:
        return len(self._found())

    def _found(self) -> dict[str, Effect]:
        if self._all is None:
            found = dict(self._ours)
            for point in sorted(entry_points(group=GROUP), key=lambda item: item.name):
                effect = _loaded(point)
                if effect.id in found:
                    raise _broken(point, f"the id {effect.id}, which is taken", "an id of its own")
                found[effect.id] = effect
            self._all = found
        return self._all


def _loaded(point: EntryPoint) -> Effect:
    try:
        effect = point.load()
    except Exception as error:  # whatever a package of others does while it is imported
        told = " ".join(f"{type(error).__name__}: {error}".split())
        raise _broken(point, told, "an Effect that can be imported") from error
    if not isinstance(effect, Effect):
        raise _broken(point, f"{point.value}, a {type(effect).__name__}", "an Effect")
    if effect.id != point.name:
        raise _broken(point, f"an effect of the id {effect.id}", "the entry point's name as id")
    return effect


def _broken(point: EntryPoint, received: str, expected: str) -> InputError:
    package = "" if point.dist is None else f" of the package {point.dist.name}"
    return InputError(
        f"effect {point.name}{package}", received=received, expected=expected, remedy="fix or uninstall the package"
    )
