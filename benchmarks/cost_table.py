"""What a rendered frame costs against image size, number of energies and number of effects.

    python benchmarks/cost_table.py [--turns 5]

Projection of two materials for two moments; noise, spread and readout of one frame; and, with effects, the sampling of a
series of 4 frames behind an object by the forward model (numpy), and the expectation of that series, the first effects of the
catalogue acting.
"""

import argparse
import os
import time
from collections.abc import Callable

import numpy as np

from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import setting_from_text
from raytwin.generator import (
    DetectorMaps,
    NoiseModel,
    SpectralModel,
    SpectralPosterior,
    Twin,
    estimate_from_sd,
    gaussian_spread,
    noise_kernel_1d,
    project_polychromatic,
    sample_frames,
)
from raytwin.generator.effects import EFFECTS, AppliedEffect
from raytwin.generator.frames.line_model import LineModel
from raytwin.generator.line.series_request import SeriesRequest

SIZES = ((64, 64), (128, 128), (380, 478), (760, 956), (1520, 1912))
ENERGIES = (25, 50, 100, 200)
OF_INTEGRATORS = [one for one in EFFECTS.values() if "counting" not in one.needs]
EFFECT_COUNTS = (0, 1, 5, 10, len(OF_INTEGRATORS))


def milliseconds(work: Callable[[], object], turns: int) -> tuple[float, float]:
    """Medians of wall and processor time, ms."""
    work()
    found = []
    for _ in range(turns):
        begin = time.perf_counter(), time.process_time()
        work()
        found.append((time.perf_counter() - begin[0], time.process_time() - begin[1]))
    wall, processor = 1e3 * np.median(np.array(found), axis=0)
    return float(wall), float(processor)


def line(shape: tuple[int, int]) -> Twin:
    """A line with the numbers of the paper's detector, uncalibrated."""
    model = SpectralModel(filter_materials=("Cu",))
    best = np.zeros(len(model.names))
    zeros = np.zeros(shape, dtype=np.float32)
    return Twin(
        instrument=Instrument(pixel_mm=0.15, source_detector_mm=1059.0, source_object_mm=990.0, bits=16),
        maps=DetectorMaps(
            dark_DN=zeros + 1200,
            dark_exposure_ms=20.0,
            dark_DN_per_ms=zeros,
            gain_relative=zeros + 1,
            read_variance_DN2=zeros + 166,
            bad_pixels=np.zeros(shape, dtype=np.uint8),
        ),
        noise=NoiseModel(
            spread=gaussian_spread("aperture", estimate_from_sd(0.6, 0.01)),
            white_fraction=0.02,
            read_noise_DN=estimate_from_sd(12.9, 0.1),
            quantised=True,
        ),
        dark_DN=estimate_from_sd(1200.0, 0.1),
        levels=(),
        spectral=SpectralPosterior(
            names=model.names,
            samples=best[None, :],
            best=best,
            prior={},
            undetermined=(),
            anode="W",
            anode_angle_deg=12.0,
            model="casim",
            inherent=(),
            scintillator=model.scintillator,
            cover=(),
            counting=False,
            level_discrepancy=0.003,
            gain_discrepancy=0.01,
            calibrated_kV=(40.0, 90.0),
            calibrated_filters=("Cu:0.05",),
        ),
        evidence={},
        warnings=(),
    )


def effects_table(turns: int) -> None:
    """Time of a series against the number of effects that act."""
    print("wall / cpu ms" + "".join(f"     {count:2d} effects    " for count in EFFECT_COUNTS))
    rng = np.random.default_rng(2)
    for shape in ((128, 128), (380, 478)):
        twin = line(shape)
        request = SeriesRequest(
            kind="object",
            setting=setting_from_text("kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05"),
            frames=4,
            exposure_ms=20.0,
            frame_interval_ms=40.0,
            thickness_mm={
                "chicken_breast": rng.uniform(0.0, 25.0, shape),
                "bone_cortical_icru44": rng.uniform(0.0, 2.0, shape),
            },
            product_material="chicken_breast",
        )
        for name, work in (
            ("sampled", lambda e, t=twin, r=request: list(LineModel(t, effects=e).sample(r, rng=rng))),
            ("expected", lambda e, t=twin, r=request: LineModel(t, effects=e).expect(r)),
        ):
            cells = []
            for count in EFFECT_COUNTS:
                chosen = tuple(
                    AppliedEffect(id=one.id, parameters={p.name: p.default for p in one.parameters}, since="always")
                    for one in OF_INTEGRATORS[:count]
                )
                cells.append(milliseconds(lambda w=work, c=chosen: w(c), turns))
            print(
                f"{shape[0]:4d} x {shape[1]:4d} {name:9s}"
                + "  ".join(f"{wall:7.1f} / {cpu:7.1f}" for wall, cpu in cells)
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=5)
    turns = parser.parse_args().turns
    rng = np.random.default_rng(1)
    kernel = noise_kernel_1d("aperture", 0.6)
    print("wall / cpu ms" + "".join(f"  {count:4d} energies   " for count in ENERGIES) + "  noise, spread, readout")
    for shape in SIZES:
        thickness = np.stack([rng.uniform(0.0, 40.0, shape), rng.uniform(0.0, 3.0, shape)]).astype(np.float32)
        cells = []
        for count in ENERGIES:
            energies_keV = np.linspace(12.0, 90.0, count)
            mu = np.stack([0.02 + 0.08 * (20.0 / energies_keV) ** 3, 0.03 + 0.5 * (20.0 / energies_keV) ** 3])
            number = np.exp(-(((energies_keV - 45.0) / 16.0) ** 2))
            weights = np.stack([number * energies_keV, number * energies_keV**2])
            cells.append(milliseconds(lambda t=thickness, m=mu, w=weights: project_polychromatic(t, m, w), turns))
        signal = rng.uniform(90.0, 240.0, shape).astype(np.float32)
        cells.append(
            milliseconds(
                lambda s=signal: sample_frames(s, gain_DN=1.0, key=1, kernel_1d=kernel, read_noise_DN=3.0, bits=16),
                turns,
            )
        )
        print(f"{shape[0]:4d} x {shape[1]:4d} " + "  ".join(f"{wall:7.2f} / {cpu:7.2f}" for wall, cpu in cells))
    effects_table(turns)
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors, medians of {turns} turns")


if __name__ == "__main__":
    main()
