"""Open-beam levels of exported twins, computed by gVirtualXray and by gecatsim from the files, against `predict`.

    python validation/export_in_simulators.py [--catsim FOLDER] [--json FILE]

Each simulator reads the files of `raytwin export virtual_lab` as its own users would: gVirtualXray by `json2gvxr`, gecatsim by its
configuration files. Nothing stands in the beam (gVirtualXray draws no empty scene: it gets a cube of 1 um of thin helium).

gVirtualXray has the twin's energy response: its level must be that of `predict`. gecatsim's detector keeps all energy of a
photon that interacts, so its level must be off by what the export says.

The script ends with exit code 0 and the reason where a simulator is not installed, and with 1 where a level is off by more than
0.1 % (gVirtualXray; it reckons in single precision) or 0.5 % from what was said (gecatsim, whose cross sections are its own).
"""

import argparse
import contextlib
import io
import json
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import raytwin as rt

SETTINGS = (
    "kv=40,power_w=40,exposure_ms=100,filter=Cu:0.05",
    "kv=60,power_w=40,exposure_ms=20,filter=Al:2",
    "kv=90,power_w=45,exposure_ms=20,filter=Cu:0.1",
)
TOLERANCE_GVXR, TOLERANCE_GECATSIM = 1e-3, 5e-3


def levels_of_gvxr(folder: Path) -> list[float] | str:
    """Median level (DN above dark) of each setting; a text where gVirtualXray is not there."""
    try:
        from gvxrPython3 import gvxr, json2gvxr
    except ImportError as error:
        return f"gVirtualXray cannot be loaded: {error}"
    DN_per_keV = json.loads((folder / "noise.json").read_text())["DN_per_keV"]
    found = []
    for number in range(len(SETTINGS)):
        name = str(folder / f"gvxr_{number}.json")
        with contextlib.redirect_stdout(io.StringIO()):
            if number == 0:
                json2gvxr.initGVXR(name, "EGL")
            json2gvxr.initSourceGeometry(name)
            json2gvxr.initSpectrum(name)
            json2gvxr.initDetector(name)
            if number == 0:
                gvxr.makeCube("thin", 0.001, "mm")
                gvxr.setElement("thin", "He")
                gvxr.setDensity("thin", 1e-6, "g/cm3")
                gvxr.addPolygonMeshAsInnerSurface("thin")
        image_MeV = np.array(gvxr.computeXRayImage(), dtype=np.float64)
        found.append(float(np.median(image_MeV)) * 1000.0 * DN_per_keV)
    return found


def levels_of_gecatsim(folder: Path, catsim: Path | None) -> list[float] | str:
    """Median level (DN above dark) of each setting; a text where gecatsim is not there."""
    if catsim is not None:
        sys.path.insert(0, str(catsim))
    try:
        import gecatsim
    except ImportError as error:
        return f"gecatsim cannot be loaded: {error}"
    samples = Path(gecatsim.__file__).parent / "examples" / "cfg"
    names = ("Phantom_Sample_Analytic", "Scanner_Sample_generic", "Protocol_Sample_axial", "Physics_Sample")
    found = []
    here = Path.cwd()
    os.chdir(folder)  # gecatsim looks for the spectrum here
    try:
        for number in range(len(SETTINGS)):
            case: Any = gecatsim.CatSim(*(str(samples / f"{name}.cfg") for name in names))
            for name in ("scanner.cfg", f"protocol_{number}.cfg"):
                exec(Path(name).read_text(), {"scanner": case.scanner, "protocol": case.protocol})
            # the middle of the panel: beyond it gecatsim's samples curve the detector
            case.scanner.detectorColCount, case.scanner.detectorColOffset = 16, 0
            case.scanner.detectorRowCount = case.scanner.detectorRowsPerMod = 8
            case.scanner.detectorPrefilter, case.protocol.bowtie, case.protocol.flatFilter = [], [], []
            case.protocol.viewCount = case.protocol.airViewCount = 1
            case.protocol.startViewId = case.protocol.stopViewId = 0
            for word in ("colSample", "rowSample", "srcXSample", "srcYSample", "viewSample"):
                setattr(case.physics, f"{word}Count", 1)
            case.physics.energyCount = 80
            case.physics.enableQuantumNoise = case.physics.enableElectronicNoise = 0
            for word in ("crosstalk", "lag", "opticalCrosstalk", "scatter"):
                setattr(case.physics, f"{word}Callback", "")
            case.resultsName = f"result_{number}"
            with contextlib.redirect_stdout(io.StringIO()):
                case.air_scan()
            found.append(float(np.median(np.fromfile(f"result_{number}.air", dtype=np.float32))))
    finally:
        os.chdir(here)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--catsim", type=Path, help="folder that holds gecatsim, where it is not installed")
    parser.add_argument("--json", type=Path, help="also write the figures there")
    options = parser.parse_args()
    twin = rt.read_twin("virtual_lab")
    predicted = [twin.predict(text).mean_DN.value for text in SETTINGS]
    rows, wrong = [], False
    with tempfile.TemporaryDirectory() as place:
        folders = {to: Path(place) / to for to in ("gvxr", "xcist")}
        said = {to: rt.export(twin, folder, to=to, settings=SETTINGS).warnings for to, folder in folders.items()}
        stated = [float(re.search(r"level ([+-][\d.]+) %", text)[1]) / 100.0 for text in said["xcist"]]
        for simulator, levels, off, tolerance in (
            ("gVirtualXray", levels_of_gvxr(folders["gvxr"]), [0.0] * len(SETTINGS), TOLERANCE_GVXR),
            ("gecatsim", levels_of_gecatsim(folders["xcist"], options.catsim), stated, TOLERANCE_GECATSIM),
        ):
            if isinstance(levels, str):
                print(f"{simulator}: left out, {levels}")
                continue
            for text, level, of_twin, share in zip(SETTINGS, levels, predicted, off, strict=True):
                error = level / of_twin / (1.0 + share) - 1.0
                wrong |= abs(error) > tolerance
                rows.append({"simulator": simulator, "setting": text, "level_DN": level, "predicted_DN": of_twin})
                rows[-1] |= {"stated_share": share, "error": error}
                print(
                    f"{simulator:13s} {text:50s} {level:10.2f} DN, predicted {of_twin:10.2f}, said {share:+.3f}, error {error:+.2e}"
                )
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
