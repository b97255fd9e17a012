"""Folders that are written into: whether they can be written is known before the work begins."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path

from ..errors import InputError


@contextmanager
def written_folder(path: Path) -> Iterator[Path]:
    """The folder, made where it does not exist, and taken away again where the work in it fails before anything is written.

    Raises:
        InputError: a file of that name, or a place where nothing can be written.
    """
    made = [item for item in (path, *path.parents) if not item.exists()] if path.is_absolute() or path.parts else []
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".raytwin_writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        what = ", a file" if path.is_file() else f" ({error.strerror or error})"
        raise InputError(
            "output", received=f"{path}{what}", expected="a folder that can be written, which may not exist yet"
        ) from None
    try:
        yield path
    finally:
        for folder in made:
            if any(folder.iterdir()):
                break
            folder.rmdir()


def check_effects(option: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Whether all names are effects of the catalogue; the nearest ones are suggested.

    Raises:
        InputError: a name that is none.
    """
    for name in names:
        if name not in known:
            near = [item for item in known if name.lower() in item] + get_close_matches(name.lower(), known, 3, 0.4)
            raise InputError(
                option,
                received=name,
                expected="one of " + ", ".join(known),
                remedy="did you mean " + " or ".join(dict.fromkeys(near)) + "?" if near else "",
            )
