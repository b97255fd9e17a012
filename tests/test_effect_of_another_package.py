"""Another package adds an effect: one file and an entry point, without a change here."""

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator.effects import GROUP, OURS, Catalogue

# the example of docs/effects.md: a screen that is worn about the middle of the field
SCREEN = (Path(__file__).parents[1] / "docs" / "examples" / "worn_screen.py").read_text(encoding="utf-8")
ASKED = """
import json, sys
from dataclasses import replace

import numpy as np

from raytwin import diagnose
from raytwin.acquisition.setting import setting_from_text
from raytwin.generator.effects import EFFECTS, AppliedEffect
from raytwin.generator.datasets.generate import ChannelModel
from raytwin.generator.predictions.predict import predict_flatfield
from raytwin.generator.frames.line_model import LineModel
from raytwin.generator.line.series_request import SeriesRequest

few = {"worn_screen", "heel", "gain_map_error", "nonlinearity", "kv_error"}  # all take three times as long
found = diagnose(sys.argv[1], without=sorted(set(EFFECTS) - few), seed=1)
answer, twin = found.to_dict(), replace(found.twin, effects=())
setting = setting_from_text("kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05")
flat = SeriesRequest(kind="flat", setting=setting, frames=2, exposure_ms=20.0)
worn = (AppliedEffect(id="worn_screen", parameters={"strength": 10.0}, since="calibration"),)
middle = tuple(side // 2 for side in twin.maps.shape)
levels = [LineModel(twin, effects=effects).expect(flat).signal_DN[middle] for effects in ((), worn)]
images = ChannelModel(twin, setting, "water_liquid", "repaired", worn).image_effects
plain, changed = (predict_flatfield(replace(twin, effects=effects), setting).mean_DN.value for effects in ((), worn))
print(json.dumps({
    "last": list(EFFECTS)[-1],
    "expected": levels[1] / levels[0],
    "images": images.flat_DN[middle] / images.open_signal_DN[middle],
    "warnings": images.warnings,
    "predicted": changed / plain,
    "verdict": answer["verdict"],
    "causes": [[item["effect"], item["probability"], item["strength"]["value"]] for item in answer["causes"]],
}))
"""


def install(folder, *, name="worn_screen", value="their_line.worn_screen:WORN_SCREEN", text=SCREEN):
    """A package as an installer leaves it: a module, and its metadata with one entry point."""
    package, metadata = folder / "their_line", folder / "their_line-1.0.dist-info"
    package.mkdir()
    metadata.mkdir()
    (package / "__init__.py").write_text("")
    (package / "worn_screen.py").write_text(text)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: their-line\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[{GROUP}]\n{name} = {value}\n")


@pytest.fixture(scope="module")
def answer(tmp_path_factory):
    """What a process in which the package is installed finds in a session whose screen wore out after the calibration."""
    folder = tmp_path_factory.mktemp("another")
    installed = folder / "site"
    installed.mkdir()
    install(installed)
    words = ["--protocol", "short", "--seed", "31", "--size", "48", "--frames", "8", "--products", "1"]
    session = folder / "worn.h5"
    assert main(["lab", "--family", "none", "--no-unkindness", "-o", str(session), *words]) == 0
    row, column = (np.linspace(-0.5, 0.5, 48) for _ in range(2))
    left = 1.0 - 0.10 * np.exp(-0.5 * (row[:, None] ** 2 + column[None, :] ** 2) / 0.15**2)
    with h5py.File(session, "r+") as file:
        series = file["series"].values()
        dark_DN = next(float(np.mean(item["frames"])) for item in series if item.attrs["kind"] == "dark")
        for item in series:
            if item.attrs["kind"] in ("flat", "object") and item.attrs["role"] != "calibration":
                frames = np.asarray(item["frames"], dtype=np.float64)
                item["frames"][...] = np.rint(dark_DN + (frames - dark_DN) * left).astype(item["frames"].dtype)
    script = folder / "asked.py"
    script.write_text(ASKED)
    words = [sys.executable, str(script), str(session)]
    run = subprocess.run(
        words, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": str(installed)}
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


@pytest.mark.slow
def test_an_effect_of_another_package_is_predicted_and_drawn_into_images(answer):
    assert answer["last"] == "worn_screen"  # after ours
    # light spreads over the border of what is worn
    assert answer["expected"] == pytest.approx(0.9, abs=5e-3)
    assert answer["images"] == pytest.approx(answer["expected"], abs=2e-3)
    assert answer["warnings"] == []
    assert 0.97 < answer["predicted"] < 1.0  # the detector's median lies outside the worn part


def test_the_diagnosis_names_an_effect_of_another_package(answer):
    name, probability, strength = answer["causes"][0]
    assert (answer["verdict"], name) == ("explained", "worn_screen")
    assert probability > 0.5
    assert strength == pytest.approx(10.0, rel=0.2)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            {"text": "import nothing_like_it\n"},
            "got ModuleNotFoundError: No module named 'nothing_like_it'; expected an Effect that",
        ),
        ({"text": "WORN_SCREEN = 3\n"}, "got their_line.worn_screen:WORN_SCREEN, a int; expected an Effect"),
        ({"name": "worn"}, "got an effect of the id worn_screen; expected the entry point's name as id"),
        ({"text": SCREEN.replace('"worn_screen"', '"heel"'), "name": "heel"}, "got the id heel, which is taken"),
        (
            {"text": SCREEN.replace('stage="optics"', 'stage="screen"')},
            "InputError: effect worn_screen, stage: got screen",
        ),
    ],
    ids=["does not import", "is no effect", "has another name", "has a name that is taken", "is declared wrongly"],
)
def test_a_broken_effect_of_another_package_is_one_line_that_names_the_package(tmp_path, monkeypatch, words, told):
    install(tmp_path, **words)
    monkeypatch.syspath_prepend(str(tmp_path))
    for module in [item for item in sys.modules if item.split(".")[0] == "their_line"]:
        monkeypatch.delitem(sys.modules, module)
    with pytest.raises(InputError) as failure:
        list(Catalogue(OURS))
    text = str(failure.value)
    assert "\n" not in text and "of the package their-line" in text and told in text
    assert text.endswith("fix or uninstall the package")
