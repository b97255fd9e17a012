"""Peak memory of `raytwin calibrate` on sessions of 760 x 956 pixels: it must not grow with the number of frames.

    python benchmarks/calibrate_memory.py [--frames 500 5000] [--folder FOLDER] [--first-use]

Each session is written frame by frame to a temporary file (1.5 MB a frame, so 5000 frames want 7.3 GB of disk), calibrated
by the command in a process of its own, and deleted. Darks and flats at 40 and 90 kV, with 0.05 mm Cu and without; levels and
noise are what the shipped twin of the virtual lab predicts. With `--first-use` each process starts without kept
spectra and has to compute them.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from raytwin.acquisition.acquisition_io import write_acquisition
from raytwin.acquisition.setting import Setting, filters_from_text
from raytwin.generator.predictions.predict import predict_flatfield
from raytwin.generator.spread.psf import blur_variance_share
from raytwin.generator.twins.shipped import shipped_calibrations
from raytwin.generator.twins.twin_io import read_twin

SHAPE = (760, 956)
BEAMS = ((40.0, "Cu:0.05"), (90.0, "Cu:0.05"), (40.0, ""), (90.0, ""))
DARK_SHARE = 0.1  # of the frames, before and after the flats
EXPOSURE_MS, POWER_W, HIGHEST_DN = 20.0, 40.0, 12000.0
BLUR_PX = 0.6


def write_session(path: Path, frames: int) -> None:
    """A session of `frames` frames in all."""
    random = np.random.default_rng(frames)
    twin = read_twin(shipped_calibrations()["virtual_lab"])
    dark_DN, read_DN = twin.dark_DN.value, twin.noise.read_noise_DN.value
    darks = max(int(DARK_SHARE * frames), 2)
    flats = max((frames - 2 * darks) // len(BEAMS), 2)
    instrument = replace(twin.instrument, bits=16)
    left = blur_variance_share("aperture", BLUR_PX)
    with write_acquisition(path, instrument) as writer:

        def put(name: str, count: int, mean_DN: float, slope_DN: float, setting: Setting | None) -> None:
            if setting is None:
                sink = writer.add_series(name, kind="dark", exposure_ms=EXPOSURE_MS, shape=SHAPE, dtype=np.uint16)
            else:
                sink = writer.add_series(name, kind="flat", setting=setting, shape=SHAPE, dtype=np.uint16)
            quantum_DN = np.float32(np.sqrt(slope_DN * mean_DN / left))
            for number in range(count):
                frame = random.standard_normal(SHAPE, dtype=np.float32) * np.float32(read_DN)
                if setting is not None:
                    light = gaussian_filter(random.standard_normal(SHAPE, dtype=np.float32), BLUR_PX, truncate=3.0)
                    frame += quantum_DN * light + np.float32(mean_DN)
                frame += np.float32(dark_DN)
                sink.append(np.clip(np.rint(frame), 0, 65535).astype(np.uint16), time_s=0.1 * number)

        put("dark_0", darks, 0.0, 0.0, None)
        for kV, layers in BEAMS:
            setting = Setting(kV=kV, power_W=POWER_W, exposure_ms=EXPOSURE_MS, filters=filters_from_text(layers))
            found = predict_flatfield(twin, setting)
            dimmed = min(1.0, HIGHEST_DN / found.mean_DN.value)
            setting = replace(setting, power_W=POWER_W * dimmed)
            mean_DN = found.mean_DN.value * dimmed
            slope_DN = found.gain_DN.value * left
            put(f"flat_{kV:g}_{'copper' if layers else 'open'}", flats, mean_DN, slope_DN, setting)
        put("dark_1", darks, 0.0, 0.0, None)


def calibrate(path: Path) -> None:
    """Run the command on a session and say what it took."""
    from raytwin.cli import main as raytwin

    begin = time.perf_counter()
    code = raytwin(["calibrate", str(path), "-o", str(path.with_suffix(".twin.h5")), "--json"])
    # of this process alone: getrusage would count the parent's peak from before exec
    peak_kB = next(
        line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")
    )
    print(f"peak memory {int(peak_kB) / 1e3:.0f} MB, {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    if code:
        sys.exit(code)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[500, 5000])
    parser.add_argument("--folder", type=Path, help="where the temporary session is written (default: the system's)")
    parser.add_argument("--first-use", action="store_true", help="without kept spectra")
    parser.add_argument("--calibrate", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.calibrate is not None:
        calibrate(arguments.calibrate)
        return
    for frames in arguments.frames:
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            path = Path(folder) / "session.h5"
            write_session(path, frames)
            environment = dict(os.environ)
            if arguments.first_use:
                environment["RAYTWIN_CACHE"] = str(Path(folder) / "cache")
            done = subprocess.run(
                [sys.executable, __file__, "--calibrate", str(path)],
                env=environment,
                check=True,
                text=True,
                capture_output=True,
            )
            print(
                f"{frames} frames of {SHAPE[0]} x {SHAPE[1]}, {path.stat().st_size / 1e9:.2f} GB:"
                f" {done.stderr.strip().splitlines()[-1]}",
                flush=True,
            )


if __name__ == "__main__":
    main()
