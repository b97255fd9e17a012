"""Damaged files through the command line: exit 0 or 2, one line, nothing left behind, no crash, no hang.

Small valid files of every kind that raytwin reads (acquisitions, twin, dataset, tables, TIFF folders with a sidecar, EMVA
1288 sets, NeXus files) are damaged by chance: bytes changed, cut, zeroed, doubled or exchanged; attributes, shapes, types
and frames of HDF5 files replaced by others; words and cells of texts. Each damaged file then goes through one of the
commands that read it. A case passes if the command ends with 0, or with 2 and exactly one line on standard error that
begins with its name, nothing on standard output, and no file that was not there before.

Cases run one after the other in a worker process, by their number and the seed, so that any can be run again by itself; a
worker that dies or does not answer within the time limit is replaced, and the case runs once more as a user would type it:
where HDF5 itself dies at a file, the command line must still end with one line. Calibrations and
diagnoses that go on because the damage did no harm are stopped and counted apart (`ran on`): files are read and compared
within the first second, which is what most cases are given; one in fifty may run to its end.

    python validation/damaged_files.py --cases 10000 --json build/damaged_files.json
    python validation/damaged_files.py --only 4711 --show
"""

import argparse
import contextlib
import io
import json
import multiprocessing
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import tifffile

from raytwin import _guard
from raytwin.acquisition import Setting, setting_from_text, write_acquisition, write_dataset
from raytwin.acquisition.dataset_io import DatasetRow
from raytwin.acquisition.instrument import Instrument
from raytwin.cli import main as raytwin

SHAPE = (20, 24)
EXPOSURE_MS = 20.0
BRIEF_S, LONG_S, CASE_S, ANSWER_S = 1.0, 10.0, 60.0, 900.0  # processor time; the last by the clock
LONG, LONG_SHARE = ("diagnose", "calibrate"), 0.02
PAIR = ["--low", "kv=40,power_w=40,exposure_ms=20", "--high", "kv=90,power_w=40,exposure_ms=20"]
TABLE = "size_mm,hit\n" + "".join(f"{0.1 * k:.1f},{int(k % 3 != 0 and k > 8)}\n" for k in range(1, 31))


class RanOn(BaseException):
    """A long command was stopped; not an Exception, so that nothing takes it for a failure of its own."""


def frames_of(level_DN: float, rng: np.random.Generator, count: int = 5) -> np.ndarray[Any, Any]:
    """Frames of a flat level, DN."""
    values = 1000.0 + level_DN + np.sqrt(4.0 * level_DN + 100.0) * rng.standard_normal((count, *SHAPE))
    return np.clip(np.rint(values), 0, 65535).astype(np.uint16)


def make_files(folder: Path, *, twin: bool = True) -> None:
    """The valid files that cases start from; a twin takes a calibration."""
    rng = np.random.default_rng(0)
    instrument = Instrument(bits=16, pixel_mm=0.45, source_detector_mm=3177.0, source_object_mm=2970.0)
    with write_acquisition(folder / "plain.h5", Instrument(bits=16), compression="gzip") as writer:
        writer.add_series("dark", kind="dark", frames=frames_of(0.0, rng), exposure_ms=EXPOSURE_MS)
        for level in (800.0, 2000.0, 5000.0):
            times = 0.02 * np.arange(5)
            writer.add_series(
                f"flat_{level:g}", kind="flat", frames=frames_of(level, rng), exposure_ms=level / 100, time_s=times
            )
    with write_acquisition(folder / "spectral.h5", instrument) as writer:
        writer.add_series("dark", kind="dark", frames=frames_of(0.0, rng), exposure_ms=EXPOSURE_MS)
        for kV in (40.0, 90.0):
            for power in (10.0, 40.0):
                setting = Setting(kV=kV, power_W=power, exposure_ms=EXPOSURE_MS)
                role = "evaluation" if power < 20.0 else None
                writer.add_series(
                    f"flat_{kV:g}_{power:g}",
                    kind="flat",
                    frames=frames_of(60.0 * power * kV / 40.0, rng),
                    setting=setting,
                    role=role,
                )
                writer.add_series(
                    f"object_{kV:g}_{power:g}",
                    kind="object",
                    frames=frames_of(20.0 * power * kV / 40.0, rng, 1),
                    setting=setting,
                    scene="one",
                )
        mask = np.zeros(SHAPE, dtype=np.uint8)
        mask[8:12, 8:12] = 1
        writer.add_scene(
            "one",
            kind="product",
            foreign_object_mask=mask,
            product_mask=np.ones(SHAPE),
            thickness_mm={"pmma": np.ones(SHAPE)},
        )
    setting = setting_from_text("kv=40,power_w=40,exposure_ms=100,averaged=10")
    high = setting_from_text("kv=90,power_w=40,exposure_ms=100,averaged=10")
    with write_dataset(folder / "dataset.h5", shape=SHAPE) as dataset:
        for number in range(3):
            bone = bool(number % 2)
            dataset.append(
                image=rng.uniform(0.2, 1.0, (2, *SHAPE)).astype(np.float32),
                foreign_object_mask=mask if bone else None,
                product_mask=np.ones(SHAPE),
                row=DatasetRow(
                    image=f"i{number}",
                    product=f"p{number}",
                    foreign_object="bone" if bone else "",
                    size_mm=2.0 if bone else np.nan,
                    contrast=0.1 if bone else np.nan,
                    setting=f"{setting};{high}",
                ),
            )
    (folder / "table.csv").write_text(TABLE)
    (folder / "other.csv").write_text(TABLE)
    images = folder / "images"
    images.mkdir()
    sidecar = "[instrument]\nbits = 16\npixel_mm = 0.15\n\n"
    for kind, level in (("dark", 0.0), ("flat", 3000.0)):
        tifffile.imwrite(images / f"{kind}.tif", frames_of(level, rng), photometric="minisblack")
        sidecar += f'[[series]]\nkind = "{kind}"\nfiles = "{kind}*.tif"\nexposure_ms = 20\n\n'
    (images / "raytwin.toml").write_text(sidecar)
    emva = folder / "emva"
    emva.mkdir()
    listed = f"v 3.0\nn 16 {SHAPE[1]} {SHAPE[0]}\n"
    for name, line, level in (("b0", "b 0 0", 0.0), ("b1", "b 1000000 2000", 2000.0), ("d1", "d 1000000", 0.0)):
        tifffile.imwrite(emva / f"{name}.tif", frames_of(level, rng, 2), photometric="minisblack")
        listed += f"{line}\ni {name}.tif\n"
    (emva / "EMVA1288_Data.txt").write_text(listed)
    with h5py.File(folder / "scan.nxs", "w") as file:
        group = file.create_group("entry/instrument/detector")
        group["data"] = np.concatenate([frames_of(0.0, rng, 3), frames_of(3000.0, rng, 3), frames_of(900.0, rng, 3)])
        group["image_key"] = np.repeat([2, 1, 0], 3)
        group["count_time"] = np.full(9, 0.02)
        group["x_pixel_size"] = 1e-4
    if not twin:
        return
    code, error = run_quietly(["calibrate", str(folder / "spectral.h5"), "-o", str(folder / "twin.h5")])[:2]
    if code:
        raise SystemExit(f"the good session does not calibrate: {error}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A file that is damaged: its name, the file of a folder that is hit (empty: itself), and commands with weights.

    In commands, `@` is the damaged file or folder, `+` the folder of good files, `-` where output may go.
    """

    name: str
    parts: tuple[str, ...]
    commands: tuple[tuple[float, tuple[str, ...]], ...]
    share: float


_TWIN_SETTING = ("--kv", "60", "--power-w", "40", "--exposure-ms", "20", "--json")
KINDS = (
    Kind(
        name="plain.h5",
        parts=("",),
        share=0.3,
        commands=(
            (0.4, ("check", "@", "--json")),
            (0.5, ("calibrate", "@", "-o", "-/twin.h5", "--json")),
            (0.1, ("diagnose", "@", "--twin", "+/twin.h5", "-o", "-/diagnosis", "--json")),
        ),
    ),
    Kind(
        name="spectral.h5",
        parts=("",),
        share=0.2,
        commands=(
            (0.25, ("check", "@", "--json")),
            (0.1, ("calibrate", "@", "-o", "-/twin.h5", "--json")),
            (0.3, ("validate", "+/twin.h5", "@", "--json")),
            (0.15, ("diagnose", "@", "--twin", "+/twin.h5", "-o", "-/diagnosis", "--json")),
            (0.2, ("import", "reference", "@", "-o", "-/reference.h5", "--json")),
        ),
    ),
    Kind(
        name="twin.h5",
        parts=("",),
        share=0.15,
        commands=(
            (0.3, ("check", "@", "--json")),
            (0.4, ("predict", "@", *_TWIN_SETTING)),
            (0.2, ("validate", "@", "+/spectral.h5", "--json")),
            (0.1, ("diagnose", "+/spectral.h5", "--twin", "@", "-o", "-/diagnosis", "--json")),
        ),
    ),
    Kind(
        name="dataset.h5",
        parts=("",),
        share=0.1,
        commands=((1.0, ("generate", "+/twin.h5", "@", *PAIR, "-n", "2", "--seed", "1", "-o", "-/data.h5", "--json")),),
    ),
    Kind(
        name="table.csv",
        parts=("",),
        share=0.1,
        commands=((0.7, ("pod", "@", "--json")), (0.3, ("compare", "@", "+/other.csv", "--json"))),
    ),
    Kind(
        name="images",
        parts=("dark.tif", "flat.tif", "raytwin.toml"),
        share=0.07,
        commands=((0.5, ("import", "images", "@", "-o", "-/a.h5", "--json")), (0.5, ("check", "@", "--json"))),
    ),
    Kind(
        name="emva",
        parts=("b1.tif", "d1.tif", "EMVA1288_Data.txt"),
        share=0.04,
        commands=((0.5, ("import", "emva1288", "@", "-o", "-/a.h5", "--json")), (0.5, ("check", "@", "--json"))),
    ),
    Kind(
        name="scan.nxs",
        parts=("",),
        share=0.04,
        commands=((0.5, ("import", "nxtomo", "@", "-o", "-/a.h5", "--json")), (0.5, ("check", "@", "--json"))),
    ),
)


# How files are damaged: each takes the path and a random generator and says what it did.


def changed_bytes(path: Path, rng: np.random.Generator) -> str:
    """A few bytes hold other numbers."""
    data = bytearray(path.read_bytes())
    # half of the hits fall into the first part of a file, where HDF5 and TIFF keep what describes the rest
    count = int(2 ** rng.uniform(0, 7))
    reach = len(data) if rng.random() < 0.5 else max(1, min(len(data), 8192))
    for place in rng.integers(0, max(reach, 1), count):
        if data:
            data[int(place)] = int(rng.integers(0, 256))
    path.write_bytes(bytes(data))
    return f"{count} bytes changed"


def cut(path: Path, rng: np.random.Generator) -> str:
    """The end is missing."""
    data = path.read_bytes()
    keep = int(rng.uniform(0, len(data)))
    path.write_bytes(data[:keep])
    return f"cut at {keep}"


def zeroed(path: Path, rng: np.random.Generator) -> str:
    """A stretch of zeros, as a disk leaves it."""
    data = bytearray(path.read_bytes())
    start = int(rng.uniform(0, len(data)))
    length = int(2 ** rng.uniform(2, 13))
    data[start : start + length] = bytes(len(data[start : start + length]))
    path.write_bytes(bytes(data))
    return f"{length} zeros at {start}"


def moved_block(path: Path, rng: np.random.Generator) -> str:
    """A stretch stands where another should: doubled, or in its place."""
    data = bytearray(path.read_bytes())
    length = int(2 ** rng.uniform(2, 11))
    source, target = (int(rng.uniform(0, max(len(data) - length, 1))) for _ in range(2))
    block = data[source : source + length]
    if rng.random() < 0.5:
        data[target : target + length] = block
    else:
        data[target:target] = block
    path.write_bytes(bytes(data))
    return f"{length} bytes of {source} at {target}"


BYTES: tuple[Callable[[Path, np.random.Generator], str], ...] = (changed_bytes, cut, zeroed, moved_block)


def _odd_values(rng: np.random.Generator) -> list[Any]:
    return [
        np.nan, np.inf, -1.0, 0.0, 1e300, -(2**62), 2**31, "", "long", "\udcff".encode("utf-8", "surrogateescape"),
        b"\xff\xfe\x00", np.array([1.0, 2.0]), np.zeros((0,)), np.zeros((2, 2, 2)), h5py.Empty("f"), True, "None", "x" * 5000,
        np.array(["a", "b"], dtype=h5py.string_dtype()), np.complex64(1j), "Cu", "unobtanium:1", "Al:-1", "[1,", "{}", "null", "[]",
    ]  # fmt: skip


def _nodes(file: Any) -> list[Any]:
    found = [file]
    file.visititems(lambda _, node: found.append(node))
    return found


def odd_attribute(path: Path, rng: np.random.Generator) -> str:
    """An attribute holds something else, is gone, or is new."""
    with h5py.File(path, "r+") as file:
        nodes = [node for node in _nodes(file) if len(node.attrs)]
        if not nodes:
            return "nothing to change"
        node = nodes[int(rng.integers(len(nodes)))]
        name = list(node.attrs)[int(rng.integers(len(node.attrs)))]
        odd = _odd_values(rng)
        value = odd[int(rng.integers(len(odd)))]
        if rng.random() < 0.15:
            del node.attrs[name]
            return f"{node.name} without {name}"
        with contextlib.suppress(Exception):
            node.attrs[name] = value
        return f"{node.name}.{name} = {str(value)[:40]!r}"


def odd_dataset(path: Path, rng: np.random.Generator) -> str:
    """A dataset has another shape, another type, or is a group; or a group is a dataset."""
    with h5py.File(path, "r+") as file:
        nodes = _nodes(file)[1:]
        node = nodes[int(rng.integers(len(nodes)))]
        name = node.name
        old = node[()] if isinstance(node, h5py.Dataset) else None
        kept = dict(node.attrs)
        del file[name]
        made: list[Any] = [
            None, np.float64(3.0), np.zeros((0,)), np.array([b"a", b"b"]), np.zeros((3, 4, 5, 6)), np.array([np.nan, 1.0]),
            np.zeros((1, *SHAPE), np.complex64), "text", h5py.Empty("f4"), np.zeros((2, 3), dtype=[("a", "f4"), ("b", "i4")]),
        ]  # fmt: skip
        if isinstance(old, np.ndarray) and old.ndim:
            made += [
                old[:-1],
                old[..., None],
                old[::-1],
                np.moveaxis(old, 0, -1),
                old[:1],
                old.astype("f8" if old.dtype.kind in "iuf" else "S8"),
            ]
            made += [np.concatenate([old, old]), old.reshape(-1)]
        value = made[int(rng.integers(len(made)))]
        if value is None:
            file.create_group(name)
        elif rng.random() < 0.2:
            return f"{name} is gone"
        else:
            file[name] = value
        for key, attribute in kept.items():
            file[name].attrs[key] = attribute
        return f"{name} is {getattr(value, 'shape', value)!s:.40}"


def odd_frames(path: Path, rng: np.random.Generator) -> str:
    """Numbers of a dataset: none, not finite, all alike, negative, huge, exchanged."""
    with h5py.File(path, "r+") as file:
        nodes = [
            node for node in _nodes(file) if isinstance(node, h5py.Dataset) and node.size and node.dtype.kind in "iuf"
        ]
        node = nodes[int(rng.integers(len(nodes)))]
        name, attributes = node.name, dict(node.attrs)
        values = np.atleast_1d(np.asarray(node[()], dtype=np.float64))
        choice = int(rng.integers(8))
        flat = values.reshape(-1)
        if choice == 0:
            flat[int(rng.integers(flat.size))] = [np.nan, np.inf, -np.inf][int(rng.integers(3))]
        elif choice == 1:
            flat[:] = [0.0, 65535.0, 1.0, -5.0][int(rng.integers(4))]
        elif choice == 2:
            flat *= -1.0
        elif choice == 3:
            flat *= 10.0 ** rng.uniform(-30, 30)
        elif choice == 4:
            rng.shuffle(flat)
        elif choice == 5:
            values[len(values) // 2 :] = values[:1]
        elif choice == 6:
            values = values[:1]
        else:
            flat[rng.random(flat.size) < 0.3] = 0.0
        del file[name]
        whole = choice in (1, 4, 5, 6, 7) and bool(
            np.all((values >= 0) & (values <= 65535) & (values == np.rint(values)))
        )
        with np.errstate(over="ignore"):
            file[name] = values.astype(np.uint16 if whole else np.float32)
        for key, attribute in attributes.items():
            file[name].attrs[key] = attribute
        return f"{name}: numbers {choice}"


def odd_text(path: Path, rng: np.random.Generator) -> str:
    """Cells and lines of a text: other words, gone, doubled, other separators, other encodings."""
    lines = path.read_text(encoding="utf-8").splitlines()
    words = [
        "",
        "nan",
        "inf",
        "-1",
        "1e999",
        "abc",
        '"',
        ",",
        ";",
        "\t",
        "0",
        "\x00",
        "µ",
        "[[",
        "=",
        "#",
        "1,5",
        "{",
        "..",
        "/etc",
    ]
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(len(lines)))
        what = int(rng.integers(6))
        if what == 0:
            del lines[at]
        elif what == 1:
            lines.insert(at, lines[int(rng.integers(len(lines)))])
        elif what == 2:
            lines[at] = words[int(rng.integers(len(words)))]
        elif what == 3:
            lines[at] += words[int(rng.integers(len(words)))]
        elif what == 4:
            cells = lines[at].split(",")
            cells[int(rng.integers(len(cells)))] = words[int(rng.integers(len(words)))]
            lines[at] = ",".join(cells)
        else:
            parts = lines[at].split(" ")
            parts[int(rng.integers(len(parts)))] = words[int(rng.integers(len(words)))]
            lines[at] = " ".join(parts)
        if not lines:
            lines = [""]
    encoding = ["utf-8", "utf-8", "utf-8", "utf-16", "latin-1"][int(rng.integers(5))]
    path.write_text("\n".join(lines), encoding=encoding, errors="replace")
    return f"text, {encoding}"


def damage(path: Path, rng: np.random.Generator) -> str:
    """Damage a file in one way."""
    if path.suffix in (".csv", ".toml", ".txt"):
        ways = (*BYTES, odd_text, odd_text, odd_text, odd_text)
    elif path.suffix in (".h5", ".nxs"):
        ways = (*BYTES, odd_attribute, odd_attribute, odd_dataset, odd_frames)
    else:
        ways = BYTES
    way = ways[int(rng.integers(len(ways)))]
    return f"{way.__name__}: {way(path, rng)}"


def run_quietly(words: list[str], limit_s: float | None = None) -> tuple[int | str, str, str]:
    """Exit code (or what happened), standard error, standard output of one command in this process."""
    out, err = io.StringIO(), io.StringIO()
    code: int | str

    stopped_at: list[float] = []

    def stop(*_: Any) -> None:
        stopped_at.append(time.monotonic())
        raise RanOn

    if limit_s is not None:
        # processor time: a busy machine is no hang
        signal.signal(signal.SIGPROF, stop)
        signal.setitimer(signal.ITIMER_PROF, limit_s)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("default")
            code = raytwin(words)
    except SystemExit as stopped:
        code = stopped.code if isinstance(stopped.code, int) else 2
    except RanOn:
        code = "ran on"
    except BaseException as error:
        code = f"{type(error).__name__}: {error}"
    else:
        # compiled code makes errors of its own of what stops it
        code = "ran on" if stopped_at else code
    finally:
        if limit_s is not None:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
    return code, err.getvalue(), out.getvalue()


def run_apart(words: list[str]) -> tuple[int | str, str, str]:
    """The same of the command as a user types it."""
    command = [sys.executable, "-m", "raytwin", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=ANSWER_S, check=False)
    return done.returncode, done.stderr, done.stdout


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What came of one case: its number, command, how the file was damaged, code, what is wrong (empty: nothing), line."""

    number: int
    command: str
    damage: str
    code: str
    wrong: str
    line: str


def run_case(number: int, seed: int, good: Path, kinds: tuple[Kind, ...] = KINDS, *, apart: bool = False) -> Result:
    """Damage one file and run one command on it; apart: as the command line does, in a process of its own."""
    rng = np.random.default_rng([seed, number])
    shares = np.array([one.share for one in kinds])
    kind = kinds[int(rng.choice(len(kinds), p=shares / shares.sum()))]
    weights = np.array([weight for weight, _ in kind.commands])
    command = kind.commands[int(rng.choice(len(weights), p=weights / weights.sum()))][1]
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        place, output = folder / kind.name, folder / "out"
        output.mkdir()
        if (good / kind.name).is_dir():
            shutil.copytree(good / kind.name, place)
        else:
            shutil.copy(good / kind.name, place)
        part = kind.parts[int(rng.integers(len(kind.parts)))]
        done = damage(place / part if part else place, rng)
        words = [
            str(place)
            if word == "@"
            else word.replace("+/", f"{good}/").replace("-/", f"{output}/")
            if "/" in word
            else word
            for word in command
        ]
        before = {path.name for path in folder.iterdir()}
        limit_s = CASE_S
        if command[0] in LONG:
            limit_s = LONG_S if rng.random() < LONG_SHARE else BRIEF_S
        code, error, answer = run_apart(words) if apart else run_quietly(words, limit_s)
        left = sorted(path.relative_to(folder).as_posix() for path in output.rglob("*"))
        left += sorted({path.name for path in folder.iterdir()} - before)
    lines = error.splitlines()
    wrong = ""
    if code == 2:
        if len(lines) != 1 or not lines[0].startswith("raytwin"):
            wrong = f"{len(lines)} lines"
        elif answer:
            wrong = "something on standard output"
        elif left:
            wrong = f"left behind: {left}"
    elif code == 0:
        if any(name.endswith(".part") for name in left):
            wrong = f"left behind: {left}"
        else:
            with contextlib.suppress(IndexError):
                json.loads(answer)
    elif code == "ran on":
        wrong = "" if command[0] in LONG else "did not end"
    else:
        wrong = f"exit {code}"
    return Result(
        number=number,
        command=" ".join(command[:2] if command[0] == "import" else command[:1]),
        damage=f"{kind.name} {done}",
        code=str(code),
        wrong=wrong,
        line=_told(lines)[:300],
    )


def _told(lines: list[str]) -> str:
    """The last line, and the place of an internal failure."""
    places = [line.strip() for line in lines if line.startswith('  File "')]
    last = lines[-1] if lines else ""
    return f"{last} [{Path(places[-1].split(chr(34))[1]).name}{places[-1].split(chr(34))[2]}]" if places else last


def _work(pipe: Any, seed: int, good: str) -> None:
    """Run the cases whose numbers come through the pipe."""
    sys.stdout = io.StringIO()
    # where HDF5 reads on without end this process ends, as the command's own would, and the case runs apart
    _guard._is_copy = True
    signal.signal(signal.SIGVTALRM, signal.SIG_DFL)
    _warm(Path(good))
    while (number := pipe.recv()) is not None:
        pipe.send(run_case(number, seed, Path(good)))


def _warm(good: Path) -> None:
    """Import and compile what long commands need: stopped in the middle of that, a case would say nothing of its file."""
    with tempfile.TemporaryDirectory() as folder:
        run_quietly(["calibrate", str(good / "spectral.h5"), "-o", f"{folder}/twin.h5"])
        for name in ("spectral.h5", "plain.h5"):
            run_quietly(["diagnose", str(good / name), "--twin", str(good / "twin.h5"), "-o", f"{folder}/{name}"])


def outcomes(numbers: list[int], seed: int, good: Path) -> Iterator[Result]:
    """Results one by one; a worker that dies or hangs is replaced."""
    context = multiprocessing.get_context("spawn")
    worker, pipe = None, None
    for number in numbers:
        if worker is None:
            pipe, theirs = context.Pipe()
            worker = context.Process(target=_work, args=(theirs, seed, str(good)), daemon=True)
            worker.start()
            theirs.close()
        assert pipe is not None
        pipe.send(number)
        result: Result | None = None
        try:
            if pipe.poll(ANSWER_S):
                result = pipe.recv()
            wrong = "did not answer"
        except (EOFError, ConnectionResetError):
            worker.join(10)
            wrong = f"the process died (signal {-(worker.exitcode or 0)})"
        if result is None:
            worker.kill()
            worker.join()
            worker = None
            # the library died, and the worker with it: what does the command line make of it?
            try:
                result = run_case(number, seed, good, apart=True)
            except Exception as error:
                result = Result(number=number, command="", damage="", code="none", wrong=f"{wrong}; {error}", line="")
        yield result
    if worker is not None and pipe is not None:
        pipe.send(None)
        worker.join(10)


def main() -> None:
    """Run the cases and tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, help="stop after so long")
    parser.add_argument("--only", type=int, nargs="*")
    parser.add_argument("--show", action="store_true", help="print every case")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    numbers = options.only or list(range(options.first, options.first + options.cases))
    codes: Counter[str] = Counter()
    commands: Counter[str] = Counter()
    milliseconds: Counter[str] = Counter()
    failed: list[Result] = []
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        make_files(Path(folder))
        last = time.monotonic()
        for result in outcomes(numbers, options.seed, Path(folder)):
            codes[result.code] += 1
            commands[result.command] += 1
            now = time.monotonic()
            milliseconds[result.command] += round(1000 * (now - last))
            last = now
            if result.wrong:
                failed.append(result)
            if result.wrong or options.show:
                told = (
                    f"{result.number:6d} {result.wrong or 'good':30.120s} {result.command:16s} {result.damage:60.60s}"
                )
                print(f"{told} {result.line:.200s}", flush=True)
            if codes.total() % 500 == 0:
                print(f"{codes.total()} cases in {time.monotonic() - start:.0f} s: {len(failed)} failed", flush=True)
            if options.minutes and time.monotonic() - start > 60.0 * options.minutes:
                break
    total = sum(codes.values())
    print(
        f"{total} cases in {time.monotonic() - start:.0f} s: {len(failed)} failed; codes {dict(codes)}; {dict(commands)};"
        f" seconds { ({name: value // 1000 for name, value in milliseconds.items()}) }"
    )
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        rows = [{name: getattr(item, name) for name in Result.__slots__} for item in failed]
        answer = {
            "seed": options.seed,
            "cases": total,
            "codes": dict(codes),
            "commands": dict(commands),
            "failed": rows,
        }
        options.json.write_text(json.dumps(answer, indent=1) + "\n")


if __name__ == "__main__":
    main()
