"""The code that answers a blind check, frozen when the check begins.

A check takes hours. Its processes run a copy of the package made at the start, so that an edit meanwhile changes no answer and
breaks none; a check that goes on after a stop uses the same copy, or the same code.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

from .. import errors
from ..errors import InputError, RaytwinError

_ROOMS = (
    "acquisition",
    "calibration",
    "campaign",
    "diagnosis",
    "generator",
    "lab",
    "materials",
    "pod",
    "segmentation",
    "spectra",
)
_DATA = Path("data") / "calibration"
_ANSWERING = ("acquisition", "calibration", "diagnosis", "generator", "lab", "materials", "spectra")
_SKIPPED = shutil.ignore_patterns("*.part", "*.tmp", ".*")


def package_folder() -> Path:
    """Where `errors.py` and the commands lie."""
    return Path(errors.__file__).parent


def rooms_folder() -> Path:
    """Where the rooms lie: the same in a plain install, the top of the repository in an editable one."""
    return Path(__file__).parents[1]


def code_digest(rooms: Path | None = None) -> str:
    """SHA-256 over the source of the rooms that measure and answer, 64 hexadecimal digits."""
    base = rooms or rooms_folder()
    state = hashlib.sha256()
    for room in _ANSWERING:
        for path in sorted((base / room).rglob("*")):
            if path.suffix in (".py", ".toml"):
                state.update(f"{room}/{path.relative_to(base / room).as_posix()}\0".encode())
                state.update(path.read_bytes())
    return state.hexdigest()


def freeze_code(folder: Path) -> Path:
    """Copy the package into `folder`; returns the folder to put first on Python's path.

    Compiled kernels are copied too: their times are kept, so that they stay valid.
    """
    target = folder / "raytwin"
    shutil.copytree(package_folder(), target, ignore=_SKIPPED, dirs_exist_ok=True)
    for room in _ROOMS:
        source = rooms_folder() / room
        if source.is_dir() and not (target / room).exists():
            shutil.copytree(source, target / room, ignore=_SKIPPED)
    data = rooms_folder() / _DATA
    if data.is_dir() and not (target / _DATA).exists():
        shutil.copytree(data, target / _DATA, ignore=_SKIPPED)
    return folder


def check_frozen_code(folder: Path) -> None:
    """Whether the copy can be imported, and is what Python imports.

    Raises:
        RaytwinError: it cannot; the message has Python's last line.
    """
    code = (
        "import raytwin.diagnosis.diagnose_session, raytwin.lab.protocols, raytwin.campaign.blind_judge as judge;"
        "print(judge.__file__)"
    )
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH", ""))))
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["it could not be started"]
        raise RaytwinError(f"the code as it stands cannot be imported: {lines[-1]}")
    if not Path(done.stdout.strip()).is_relative_to(folder):
        raise RaytwinError(f"Python imports {done.stdout.strip()} and not the frozen copy in {folder}")


def same_code(expected: str, folder: Path) -> None:
    """Refuse to go on with other code than a check was begun with.

    Raises:
        InputError: the digests differ.
    """
    if code_digest() != expected:
        raise InputError(
            "-o",
            received=f"{folder}, a check begun with other code",
            expected=f"the version whose sources hash to {expected[:12]}",
            remedy="go on with that version, or begin again in another folder",
        )
