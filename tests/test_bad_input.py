"""Bad input through the command line: exit 2, one line on standard error, nothing on standard output, no file left."""

import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import h5py
import numpy as np
import pytest

import raytwin as rt
from raytwin.acquisition import Setting, open_acquisition, write_acquisition
from raytwin.acquisition.instrument import Instrument
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator.twins.twin_io import read_twin, write_twin

SHAPE = (24, 28)
EXPOSURE_MS = 20.0


def frames(level, *, count=6, rng, shape=SHAPE):
    values = 1000.0 + level + np.sqrt(4.0 * level + 100.0) * rng.standard_normal((count, *shape))
    return np.clip(np.rint(values), 0, 65535).astype(np.uint16)


def write_session(path, *, darks=True, level_per_W=60.0, bits=16, top=None, shape=SHAPE):
    rng = np.random.default_rng(0)
    instrument = Instrument(bits=bits, pixel_mm=0.45, source_detector_mm=3177.0, source_object_mm=2970.0)
    with write_acquisition(path, instrument) as writer:
        if darks:
            writer.add_series(
                "dark", kind="dark", frames=frames(0.0, rng=rng, shape=shape), exposure_ms=EXPOSURE_MS, kV=40.0
            )
        for kV in (40.0, 90.0):
            for power in (5.0, 20.0, 40.0):
                values = frames(level_per_W * power * kV / 40.0, rng=rng, shape=shape)
                if top is not None:
                    values = np.full_like(values, top)
                setting = Setting(kV=kV, power_W=power, exposure_ms=EXPOSURE_MS)
                writer.add_series(f"flat_{kV:g}_{power:g}", kind="flat", frames=values, setting=setting)
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory, make_model_twin):
    """A good session, a twin of its line, and a set of small products to go with them."""
    folder = tmp_path_factory.mktemp("good")
    session, twin = write_session(folder / "session.h5"), folder / "twin.h5"
    write_twin(twin, make_model_twin(SHAPE, pixel_mm=0.45, source_object_mm=2970.0, source_detector_mm=3177.0))
    products = folder / "products.h5"
    rng = np.random.default_rng(1)
    with write_acquisition(products, Instrument(bits=16)) as writer:
        for kV in (40.0, 90.0):
            setting = Setting(kV=kV, power_W=40.0, exposure_ms=100.0, averaged=10)
            writer.add_series(f"flat_{kV:g}", kind="flat", frames=frames(5000.0, rng=rng, count=1), setting=setting)
            writer.add_series(
                f"object_{kV:g}",
                kind="object",
                frames=frames(3000.0, rng=rng, count=1),
                setting=setting,
                scene="one",
            )
        writer.add_series("dark", kind="dark", frames=frames(0.0, rng=rng, count=1), exposure_ms=100.0)
        mask = np.zeros(SHAPE, dtype=np.uint8)
        mask[10:14, 10:14] = 1
        writer.add_scene("one", kind="product", foreign_object_mask=mask, product_mask=np.ones(SHAPE))
    return {"session": session, "twin": twin, "products": products}


GENERATE = ["--low", "kv=40,power_w=40,exposure_ms=20", "--high", "kv=90,power_w=40,exposure_ms=20"]
GENERATE = [*GENERATE, "-n", "2", "--seed", "1"]
PREDICT = ["--power-w", "40", "--exposure-ms", "20"]


def refused(capsys, folder, words, *, mentions):
    """Run a command that must fail well; `mentions` stands in its one line."""
    before = sorted(path.name for path in folder.iterdir())
    capsys.readouterr()
    code = main([str(word) for word in words])
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert code == 2, captured.err
    assert captured.out == ""
    assert len(lines) == 1, captured.err
    assert lines[0].startswith(f"raytwin {words[0]}: error: ")
    assert mentions in lines[0], lines[0]
    assert sorted(path.name for path in folder.iterdir()) == before


def damaged(path, folder, keep):
    copy = folder / "damaged.h5"
    copy.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    return copy


@pytest.mark.parametrize("keep", [0.0, 0.02, 0.5, 0.98])
def test_a_truncated_acquisition(files, tmp_path, capsys, keep):
    broken = damaged(files["session"], tmp_path, keep)
    refused(capsys, tmp_path, ["calibrate", broken, "-o", tmp_path / "twin.h5", "--json"], mentions="damaged.h5")
    refused(capsys, tmp_path, ["validate", files["twin"], broken, "--json"], mentions="damaged.h5")
    refused(
        capsys,
        tmp_path,
        ["generate", files["twin"], broken, *GENERATE, "-o", tmp_path / "data.h5", "--json"],
        mentions="damaged.h5",
    )


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.95])
def test_a_truncated_twin(files, tmp_path, capsys, keep):
    broken = damaged(files["twin"], tmp_path, keep)
    refused(capsys, tmp_path, ["predict", broken, "--kv", 60, *PREDICT, "--json"], mentions="damaged.h5")
    refused(capsys, tmp_path, ["validate", broken, files["session"], "--json"], mentions="damaged.h5")
    refused(capsys, tmp_path, ["report", broken, "-o", tmp_path / "a.html"], mentions="the file of a twin, a dataset")


def test_a_file_that_is_not_there(files, tmp_path, capsys):
    absent = tmp_path / "absent.h5"
    refused(capsys, tmp_path, ["calibrate", absent, "-o", tmp_path / "twin.h5"], mentions="absent.h5")
    refused(capsys, tmp_path, ["predict", absent, "--kv", 60, *PREDICT], mentions="absent.h5")


def test_the_wrong_kind_of_file(files, tmp_path, capsys):
    out = tmp_path / "out.h5"
    refused(capsys, tmp_path, ["calibrate", files["twin"], "-o", out], mentions="raytwin-acquisition")
    swapped = "got an acquisition, frames of a session (format 'raytwin-acquisition'); expected a twin (format 'raytwin-twin')"
    refused(capsys, tmp_path, ["predict", files["session"], "--kv", 60, *PREDICT], mentions=swapped)
    refused(capsys, tmp_path, ["validate", files["session"], files["twin"]], mentions=swapped)
    refused(
        capsys,
        tmp_path,
        ["report", files["session"], "-o", tmp_path / "a.html"],
        mentions="the file of a twin, a dataset",
    )
    refused(capsys, tmp_path, ["train", files["twin"], "-o", tmp_path / "runs"], mentions="got a twin (format")
    refused(
        capsys,
        tmp_path,
        ["generate", files["twin"], files["twin"], *GENERATE, "-o", out],
        mentions="raytwin-dataset or raytwin-acquisition",
    )
    text = tmp_path / "notes.txt"
    text.write_text("not HDF5")
    refused(capsys, tmp_path, ["calibrate", text, "-o", out], mentions="notes.txt")


def test_flats_without_darks(tmp_path, capsys):
    session = write_session(tmp_path / "session.h5", darks=False)
    refused(capsys, tmp_path, ["calibrate", session, "-o", tmp_path / "twin.h5", "--json"], mentions="dark")


def test_nothing_but_saturated_flats(tmp_path, capsys):
    session = write_session(tmp_path / "session.h5", top=65535)
    refused(capsys, tmp_path, ["calibrate", session, "-o", tmp_path / "twin.h5", "--json"], mentions="saturated")


def edited(files, folder, edit):
    copy = folder / "edited.h5"
    shutil.copy(files["session"], copy)
    with h5py.File(copy, "r+") as file:
        edit(file)
    return copy


def put_nan(file):
    values = file["series/flat_40_20/frames"][()].astype(np.float32)
    values[2, 5, 6] = np.nan
    del file["series/flat_40_20/frames"]
    file["series/flat_40_20"].create_dataset("frames", data=values)


EDITS = {
    "NaN in a frame": (put_nan, "flat_40_20"),
    "negative exposure": (lambda file: file["series/flat_40_20"].attrs.modify("exposure_ms", -20.0), "exposure_ms"),
    "NaN exposure": (lambda file: file["series/flat_40_20"].attrs.modify("exposure_ms", np.nan), "exposure_ms"),
    "zero kV": (lambda file: file["series/flat_40_20"].attrs.modify("kV", 0.0), "kV"),
    "kV above the table": (
        lambda file: file["series/flat_40_20"].attrs.modify("kV", 900.0),
        "series flat_40_20: kV: got 900 kV; expected 10 to",
    ),
    "negative current": (lambda file: file["series/flat_40_20"].attrs.create("current_mA", -1.0), "current_mA"),
    "unknown kind": (lambda file: file["series/flat_40_20"].attrs.modify("kind", "flaat"), "flaat"),
    "unknown filter material": (
        lambda file: file["series/flat_40_20"].attrs.modify("filter", "unobtanium:1"),
        "unobtanium",
    ),
    "unknown anode": (lambda file: file["instrument"].attrs.create("anode", "Xx"), "Xx"),
    "no series": (lambda file: [file["series"].pop(name) for name in list(file["series"])], "series"),
    "newer version": (lambda file: file.attrs.modify("version", 99), "99"),
}


@pytest.mark.parametrize("case", EDITS)
def test_a_session_with_a_wrong_value(files, tmp_path, capsys, case):
    edit, word = EDITS[case]
    session = edited(files, tmp_path, edit)
    refused(capsys, tmp_path, ["calibrate", session, "-o", tmp_path / "twin.h5", "--json"], mentions=word)


PREDICTIONS = {
    "kV above the table": (["--kv", "500", *PREDICT], "kV"),
    "kV of nothing": (["--kv", "nan", *PREDICT], "kV"),
    "negative exposure": (["--kv", "60", "--power-w", "40", "--exposure-ms", "-20"], "--exposure-ms"),
    "no power": (["--kv", "60", "--power-w", "0", "--exposure-ms", "20"], "power_W"),
    "unknown filter": (["--kv", "60", "--filter", "unobtanium:1", *PREDICT], "unobtanium"),
    "filter without thickness": (["--kv", "60", "--filter", "Cu", *PREDICT], "MATERIAL:mm"),
    "negative filter": (["--kv", "60", "--filter", "Cu:-1", *PREDICT], "thickness"),
    "a filter that stops everything": (["--kv", "60", "--filter", "W:100", *PREDICT], "filter"),
    "no frame": (["--kv", "60", "--averaged", "0", *PREDICT], "averaged"),
}


def test_a_detector_nearer_than_the_object_is_told(files):
    words = {"kV": 60.0, "power_W": 40.0, "exposure_ms": 20.0}
    said = [read_twin(files["twin"]).predict(**words, source_detector_mm=mm).warnings for mm in (100.0, 2970.0)]
    assert [any("nearer to the source than the object" in line for line in lines) for lines in said] == [True, False]


@pytest.mark.parametrize("case", PREDICTIONS)
def test_a_prediction_that_makes_no_sense(files, tmp_path, capsys, case):
    words, word = PREDICTIONS[case]
    refused(capsys, tmp_path, ["predict", files["twin"], *words, "--json"], mentions=word)


GENERATIONS = {
    "no image": (["-n", "0"], "number of images"),
    "kV beyond any tube": (["--low", "kv=500,power_w=40,exposure_ms=20"], "kV"),
    "negative exposure": (["--low", "kv=40,power_w=40,exposure_ms=-5"], "exposure_ms"),
    "not a setting": (["--low", "forty"], "forty"),
    "no load": (["--low", "kv=40,exposure_ms=20"], "tube load"),
    "low above high": (
        ["--low", "kv=90,power_w=40,exposure_ms=20", "--high", "kv=40,power_w=40,exposure_ms=20"],
        "low",
    ),
    "more than the reference": (["--low", "kv=40,power_w=40,exposure_ms=5000"], "too noisy"),
    "unknown product": (["--product-material", "unobtanium"], "unobtanium"),
    "one reference setting": (["--reference-low", "kv=40,power_w=40,exposure_ms=100"], "both or neither"),
}


@pytest.mark.parametrize("case", GENERATIONS)
def test_a_generation_that_cannot_be(files, tmp_path, capsys, case):
    words, word = GENERATIONS[case]
    refused(
        capsys,
        tmp_path,
        ["generate", files["twin"], files["products"], *GENERATE, "-o", tmp_path / "data.h5", "--json", *words],
        mentions=word,
    )


def test_generation_works_where_nothing_is_wrong(files, tmp_path, capsys):
    out = tmp_path / "data.h5"
    assert main(["generate", *map(str, (files["twin"], files["products"])), *GENERATE, "-o", str(out), "--json"]) == 0
    assert out.exists()
    capsys.readouterr()


def test_another_detector_than_the_twin_s(files, tmp_path, capsys):
    other = write_session(tmp_path / "other.h5", shape=(20, 20))
    refused(capsys, tmp_path, ["validate", files["twin"], other, "--json"], mentions="24")


def test_masks_of_another_shape(files, tmp_path, capsys):
    copy = tmp_path / "masks.h5"
    shutil.copy(files["products"], copy)
    with h5py.File(copy, "r+") as file:
        del file["scenes/one/foreign_object_mask"]
        file["scenes/one"].create_dataset("foreign_object_mask", data=np.zeros((7, 9), dtype=np.uint8))
    refused(
        capsys,
        tmp_path,
        ["generate", files["twin"], copy, *GENERATE, "-o", tmp_path / "data.h5", "--json"],
        mentions="foreign_object_mask",
    )


def test_a_product_larger_than_the_field(tmp_path, capsys):
    refused(
        capsys,
        tmp_path,
        ["lab", "-o", tmp_path / "a.h5", "--protocol", "set1", "--size", "32", "--product-mm", "500", "--json"],
        mentions="field",
    )


@pytest.mark.parametrize(
    ("words", "word"),
    [
        (["--protocol", "nonsense"], "protocol"),
        (["--protocol", "calibration", "--size", "4"], "--size"),
        (["--protocol", "calibration", "--frames", "1"], "frames"),
        (["--protocol", "calibration", "--seed", "-1"], "seed"),
    ],
)
def test_a_lab_session_that_cannot_be(tmp_path, capsys, words, word):
    refused(capsys, tmp_path, ["lab", "-o", tmp_path / "a.h5", *words, "--json"], mentions=word)


def test_an_output_that_cannot_be_written_is_told_before_the_work(tmp_path, capsys):
    (tmp_path / "a_folder").mkdir()
    (tmp_path / "a_file").write_text("")
    for output in ("a_folder", "a_file/twin.h5", "a_file/below/twin.h5"):
        # the acquisition is not there either: what is told first was looked at first
        words = ["calibrate", tmp_path / "absent.h5", "-o", tmp_path / output, "--json"]
        refused(capsys, tmp_path, words, mentions=f"{output}: got a ")


def test_a_failure_leaves_an_existing_output_as_it_was(files, tmp_path, capsys):
    out = tmp_path / "twin.h5"
    out.write_bytes(b"what was there")
    broken = damaged(files["session"], tmp_path, 0.5)
    refused(capsys, tmp_path, ["calibrate", broken, "-o", out, "--json"], mentions="damaged.h5")
    assert out.read_bytes() == b"what was there"


def test_no_command_writes_over_what_it_reads(files, tmp_path, capsys):
    copies = {name: tmp_path / path.name for name, path in files.items()}
    for name, path in files.items():
        copies[name].write_bytes(path.read_bytes())
    twin, session, products = copies["twin"], copies["session"], copies["products"]
    hits = tmp_path / "hits.csv"
    hits.write_text("size,hit\n1,0\n2,1\n")
    same = Path(os.path.relpath(products))  # by another name
    for words, option in (
        (["calibrate", session, "-o", session], "-o"),
        (["generate", twin, products, *GENERATE, "-o", same], "-o"),
        (["generate", twin, products, *GENERATE, "-o", twin], "-o"),
        (["pod", hits, "--export", hits], "--export"),
        (["import", "reference", products, "-o", products], "-o"),
    ):
        refused(capsys, tmp_path, words, mentions=f"{option}: got {words[-1]}, which is read")
    assert all(copies[name].read_bytes() == path.read_bytes() for name, path in files.items())
    with pytest.raises(InputError, match=r"output: got .*which is read"):
        rt.generate(twin, products, low=GENERATE[1], high=GENERATE[3], n=1, seed=1, output=products)


def test_the_belt_of_a_setting_blurs_images_and_leaves_flats(files):
    low, high = GENERATE[1], GENERATE[3]
    still, moving = (
        rt.generate(
            files["twin"],
            files["products"],
            low=low + belt,
            high=high + belt,
            reference_low="kv=40,power_w=40,exposure_ms=100,averaged=10",
            reference_high="kv=90,power_w=40,exposure_ms=100,averaged=10",
            n=1,
            seed=1,
        )
        for belt in ("", ",belt_speed_mm_s=100")
    )
    assert not np.array_equal(still.images, moving.images)
    assert any("belt_axis is not declared" in line for line in moving.warnings)
    with pytest.raises(InputError, match=r"belt_speed_mm_s: got 100.0 and None mm/s; expected one speed"):
        rt.generate(files["twin"], files["products"], low=low + ",belt_speed_mm_s=100", high=high, n=1, seed=1)


@pytest.mark.parametrize(
    "words",
    [
        ["calibrate"],
        ["predict", "twin.h5"],
        ["predict", "twin.h5", "--kv", "sixty", "--power-w", "1", "--exposure-ms", "1"],
    ],
)
def test_wrong_usage_is_one_line_and_exit_2(capsys, words):
    with pytest.raises(SystemExit) as stop:
        main(words)
    captured = capsys.readouterr()
    assert stop.value.code == 2
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert captured.err.startswith("raytwin")


@pytest.mark.parametrize(
    ("word", "remedy"),
    [("--unknown", ""), ("--seeds", "did you mean --seed?"), ("--reprt=x.html", "did you mean --report?")],
)
def test_an_unknown_option_is_one_line_with_its_neighbour_and_exit_2(capsys, word, remedy):
    assert main(["calibrate", "a.h5", "-o", "b.h5", word]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert captured.err.startswith(f"raytwin calibrate: error: {word}: got") and captured.err.strip().endswith(
        remedy or "--help`"
    )


@pytest.mark.parametrize(
    "refusal", [PermissionError(13, "Permission denied", "a.h5"), OSError(28, "No space left on device")]
)
def test_what_the_system_refuses_is_one_line_and_exit_2(files, capsys, monkeypatch, refusal):
    def refuse(*_, **__):
        raise refusal

    monkeypatch.setattr("raytwin.checks.check.check_acquisition", refuse)
    assert main(["check", str(files["session"])]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert refusal.strerror in captured.err


def test_an_unknown_command_is_one_line_and_exit_2(capsys):
    assert main(["nonsense"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert captured.err.startswith("raytwin")


def test_the_good_session_is_good(files):
    with open_acquisition(files["session"]) as acquisition:
        assert len(acquisition.series) == 7


def test_damaged_files_end_in_an_answer_or_in_one_line(tmp_path):
    """A hundred of the ten thousand cases of validation/damaged_files.py: those that need no twin."""
    folder = Path(__file__).parents[1] / "validation"
    sys.path.insert(0, str(folder))
    try:
        damaged_files = import_module("damaged_files")
    finally:
        sys.path.remove(str(folder))
    damaged_files.make_files(tmp_path, twin=False)
    commands = ("check", "pod", "import", "compare")
    kinds = tuple(
        replace(
            kind,
            commands=tuple(entry for entry in kind.commands if entry[1][0] in commands and "reference" not in entry[1]),
        )
        for kind in damaged_files.KINDS
        if kind.name not in ("twin.h5", "dataset.h5")
    )
    results = [damaged_files.run_case(number, 2026, tmp_path, kinds) for number in range(100)]
    assert [(item.number, item.wrong, item.damage, item.line) for item in results if item.wrong] == []
    assert {item.code for item in results} == {"0", "2"}


@pytest.mark.parametrize(
    "error", [TypeError("Unknown string encoding"), KeyError("Unable to synchronously open object")]
)
def test_whatever_hdf5_raises_at_damaged_bytes_is_one_line(files, tmp_path, capsys, monkeypatch, error):
    """Both came out of single bytes changed in a file, one as an attribute was read, the other as a group was listed."""

    def fails(*_: object, **__: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(h5py.AttributeManager, "get", fails)
        refused(capsys, tmp_path, ["calibrate", files["session"], "-o", tmp_path / "twin.h5"], mentions="session.h5")
        refused(capsys, tmp_path, ["predict", files["twin"], "--kv", 60, *PREDICT], mentions="twin.h5")
    with monkeypatch.context() as patch:
        patch.setattr(h5py.Group, "__iter__", fails)
        refused(capsys, tmp_path, ["calibrate", files["session"], "-o", tmp_path / "twin.h5"], mentions="session.h5")


DYING = """
import os, signal, sys
import h5py
def dies(*_, **__):
    os.kill(os.getpid(), signal.SIGSEGV)
h5py.File = dies
from raytwin.cli import main
from raytwin.errors import InputError
sys.argv = ["raytwin", *sys.argv[1:]]
sys.exit(main())
"""


ENDLESS = """
import sys
import h5py
from raytwin.acquisition import _hdf5
def reads_on(self, name, default=None):
    while True:
        pass
h5py.AttributeManager.get = reads_on
_hdf5._ATTRIBUTE_S = 0.5
from raytwin.generator.twins import twin_io
twin_io._READING_S = 2.0
from raytwin.cli import main
from raytwin.errors import InputError
sys.argv = ["raytwin", *sys.argv[1:]]
sys.exit(main())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="processes cannot be copied there")
@pytest.mark.parametrize("kind", ["session", "twin"])
def test_a_library_that_reads_on_without_end_is_one_line_too(files, kind):
    command = [sys.executable, "-c", ENDLESS, "check", str(files[kind])]
    died = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert died.returncode == 2
    assert died.stdout == ""
    (line,) = died.stderr.splitlines()
    assert files[kind].name in line and "without end" in line


@pytest.mark.skipif(sys.platform == "win32", reason="processes cannot be copied there")
def test_a_library_that_dies_at_a_file_is_one_line_too(files, tmp_path):
    def run(*words):
        command = [sys.executable, "-c", DYING, *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    half = tmp_path / ".twin.h5.abc.part"
    half.write_text("half")
    os.utime(
        half, (time.time() + 600, time.time() + 600)
    )  # as if written after the command began, however late that is
    died = run("calibrate", files["session"], "-o", tmp_path / "twin.h5")
    assert died.returncode == 2
    assert died.stdout == ""
    assert len(died.stderr.splitlines()) == 1
    assert "session.h5" in died.stderr and "SIGSEGV" in died.stderr
    assert list(tmp_path.iterdir()) == []
    # and where nothing dies, the code of the copy is that of the command
    assert run("check", tmp_path / "absent.h5").returncode == 2
    assert run("check", "--help").returncode == 0
