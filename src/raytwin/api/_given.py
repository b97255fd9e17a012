"""What users give: paths or objects, settings as texts or objects, seeds as numbers or generators."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from ..files import given_path

if TYPE_CHECKING:
    import numpy as np

    from ..acquisition import Dataset
    from ..acquisition.acquisition_io import AcquisitionFile
    from ..generator.line.twin import Twin
    from ..generator.predictions.tube_twin import TubeTwin

PathLike = str | os.PathLike[str]


def twin_path(text: PathLike) -> Path:
    """The file that a name of a twin means; a file of that name goes before a shipped calibration.

    Raises:
        InputError: nothing, the name of a shipped description that has no twin, or nearly the name of a shipped calibration.
    """
    path = given_path(text, expected="a twin, or the name of a shipped calibration", argument="twin")
    if path.suffix or len(path.parts) != 1 or path.exists():
        return path
    from ..generator.twins.shipped import shipped_calibration, shipped_calibrations

    known = shipped_calibrations()
    if str(text) in known:
        return shipped_calibration(str(text))
    near = get_close_matches(str(text), known, n=1, cutoff=0.7)
    if near:
        raise InputError(
            "twin",
            received=str(text),
            expected="an existing file that `raytwin calibrate` wrote, or a shipped calibration",
            remedy=f"did you mean {near[0]}?",
        )
    return path


def as_twin(twin: "Twin | PathLike") -> "Twin":
    """The twin itself, of a file, or of a shipped calibration's name.

    Raises:
        InputError, FileFormatError: no such file or another kind of file.
    """
    from ..generator.line.twin import Twin

    if isinstance(twin, Twin):
        return twin
    if not isinstance(twin, str | os.PathLike):
        raise InputError(
            "twin", received=type(twin).__name__, expected="a twin, a path or a shipped calibration's name"
        )
    from ..generator.twins.twin_io import read_twin

    return read_twin(twin_path(twin))


def as_any_twin(twin: "Twin | TubeTwin | PathLike") -> "Twin | TubeTwin":
    """As `as_twin`, the twin of a tube alone included.

    Raises:
        InputError, FileFormatError: no such file or another kind of file.
    """
    from ..generator.predictions.tube_twin import TubeTwin
    from ..generator.twins.twin_io import read_any_twin

    if isinstance(twin, TubeTwin):
        return twin
    return read_any_twin(twin_path(twin)) if isinstance(twin, str | os.PathLike) else as_twin(twin)


def twin_sha256(twin: "Twin | PathLike") -> str:
    """SHA-256 of a twin's file; of a twin in memory, of the file that it would be saved as."""
    from ..files import sha256_of_file
    from ..generator.line.twin import Twin
    from ..generator.twins.twin_io import write_twin

    if not isinstance(twin, Twin):
        return sha256_of_file(twin_path(twin))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "twin.h5"
        write_twin(path, twin)
        return sha256_of_file(path)


def listed(
    given: "AcquisitionFile | PathLike | Sequence[AcquisitionFile | PathLike]",
) -> "list[AcquisitionFile | PathLike]":
    """One acquisition, or several, as a list."""
    from ..acquisition.acquisition_io import AcquisitionFile

    if isinstance(given, str | os.PathLike | AcquisitionFile):
        return [given]
    if not isinstance(given, Sequence):
        raise InputError(
            "acquisition", received=type(given).__name__, expected="a path, an open acquisition, or a list"
        )
    return list(given)


@contextmanager
def opened(
    given: "AcquisitionFile | PathLike | Sequence[AcquisitionFile | PathLike]",
) -> "Iterator[list[AcquisitionFile]]":
    """Acquisitions from files, open files or a sequence of them; what was opened here is closed here.

    Raises:
        InputError, FileFormatError: none given, or a file that is none.
    """
    from ..acquisition.acquisition_io import AcquisitionFile, open_acquisition

    items = listed(given)
    if not items:
        raise InputError("acquisition", received="none", expected="at least one")
    for item in items:
        if isinstance(item, AcquisitionFile):
            item.check_open()
    with ExitStack() as stack:
        yield [
            item if isinstance(item, AcquisitionFile) else stack.enter_context(open_acquisition(item)) for item in items
        ]


def acquisition_sha256(given: "AcquisitionFile | PathLike") -> str:
    """SHA-256 of an acquisition's file, open or not."""
    from ..files import sha256_of_file

    return sha256_of_file(given if isinstance(given, str | os.PathLike) else given.path)


def distinct_sha256(given: "Sequence[AcquisitionFile | PathLike]") -> list[str]:
    """SHA-256 of each acquisition's file.

    Raises:
        InputError: the same contents twice, which would count as two measurements.
    """
    found: dict[str, AcquisitionFile | PathLike] = {}
    for item in given:
        digest = acquisition_sha256(item)
        if digest in found:
            first, again = (str(getattr(one, "path", one)) for one in (found[digest], item))
            raise InputError(
                "acquisition",
                received=f"{again}, the same file as {first}" if again != first else f"{first} twice",
                expected="each session once",
                remedy="leave the second one out",
            )
        found[digest] = item
    return list(found)


@contextmanager
def dataset_of(given: "Dataset | PathLike") -> "Iterator[Dataset]":
    """A dataset from its file, or an open one, which stays open.

    Raises:
        FileFormatError: a file that is none.
    """
    from ..acquisition.dataset_io import Dataset, read_dataset

    if isinstance(given, Dataset):
        yield given
        return
    with read_dataset(given) as dataset:
        yield dataset


def generator_of(seed: "int | np.random.Generator") -> "np.random.Generator":
    """A random generator from a seed, or the one given.

    Raises:
        InputError: anything else than a whole number of 0 or more or a generator.
    """
    import numpy as np

    if isinstance(seed, np.random.Generator):
        return seed
    return np.random.default_rng(whole_seed(seed))


def whole_seed(seed: "int | np.random.Generator") -> int:
    """A whole number: the seed itself, or one drawn from a generator.

    Raises:
        InputError: anything else than a whole number of 0 or more or a generator.
    """
    import numpy as np

    if isinstance(seed, np.random.Generator):
        return int(seed.integers(2**31))
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError("seed", received=repr(seed), expected="a whole number, 0 or more, or a numpy Generator")
    return int(seed)


def seed_number(seed: "int | np.random.Generator") -> int | None:
    """The seed, for the record; None of a generator, which no number stands for.

    Raises:
        InputError: anything else than a whole number of 0 or more or a generator.
    """
    import numpy as np

    return None if isinstance(seed, np.random.Generator) else whole_seed(seed)
