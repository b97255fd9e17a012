"""10,000 settings (kV x filter x exposure): mean and sd without intervals, checked against SpekPy; cost of intervals.

    python benchmarks/predict_settings.py

"First" builds each kV's tables from the spectra kept on disk, "again" finds them in memory. For the check, SpekPy is
called at the kV itself for a sample of settings; filters and scintillator are raytwin's on both sides.
"""

import itertools
import time

import numpy as np
import spekpy

from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import Setting, filters_from_text
from raytwin.generator import (
    DetectorMaps,
    NoiseModel,
    SpectralModel,
    SpectralPosterior,
    Twin,
    estimate_from_sd,
    gaussian_spread,
    predict_flatfield,
    spectral_model_of,
)
from raytwin.generator.predictions.predict_many import predict_levels
from raytwin.materials import transmission
from raytwin.spectra import MODELS, detector_response, tube_fluence_interpolated

SCINTILLATOR = filters_from_text("CsI:0.5")
DRAWS = 400
VOLTAGES_KV = np.linspace(40.0, 139.5, 50)  # half of them between whole kV
STACKS = [
    filters_from_text(f"Al:{aluminium:g}+Cu:{copper:g}")
    for aluminium, copper in itertools.product((0.5, 1.0, 1.5, 2.0, 3.0), (0.0, 0.05, 0.1, 0.5))
]
EXPOSURES_MS = np.array([1, 2, 5, 10, 20, 50, 100, 200, 500, 1000.0])
INTERVALS, CHECKED = 100, 25


def line() -> Twin:
    model = SpectralModel(filter_materials=("Al", "Cu"))
    samples = 0.01 * np.random.default_rng(1).standard_normal((DRAWS, len(model.names)))
    best = np.zeros(len(model.names))
    posterior = SpectralPosterior(
        names=model.names,
        samples=samples,
        best=best,
        prior={},
        undetermined=(),
        anode="W",
        anode_angle_deg=12.0,
        model="casim",
        inherent=(),
        scintillator=SCINTILLATOR,
        cover=(),
        counting=False,
        level_discrepancy=0.003,
        gain_discrepancy=0.01,
        calibrated_kV=(40.0, 140.0),
        calibrated_filters=("Al:0.5", "Al:3+Cu:0.5"),
    )
    zeros = np.zeros((2, 2), dtype=np.float32)
    maps = DetectorMaps(
        dark_DN=zeros,
        dark_exposure_ms=None,
        dark_DN_per_ms=zeros,
        gain_relative=zeros + 1,
        read_variance_DN2=zeros,
        bad_pixels=np.zeros((2, 2), dtype=np.uint8),
    )
    noise = NoiseModel(
        spread=gaussian_spread("aperture", estimate_from_sd(0.5, 0.01)),
        white_fraction=0.01,
        read_noise_DN=estimate_from_sd(10.0, 0.1),
        quantised=True,
    )
    return Twin(
        instrument=Instrument(pixel_mm=0.15, source_detector_mm=1000.0, source_object_mm=900.0),
        maps=maps,
        noise=noise,
        dark_DN=estimate_from_sd(1000.0, 0.1),
        levels=(),
        spectral=posterior,
        evidence={},
        warnings=(),
    )


def main() -> None:
    twin = line()
    model = spectral_model_of(twin)
    grid = list(itertools.product(VOLTAGES_KV, STACKS, EXPOSURES_MS))
    kV = np.array([one[0] for one in grid])
    filters = [one[1] for one in grid]
    load_mAs = np.array([one[2] for one in grid]) / 1000.0
    for voltage, name in itertools.product(VOLTAGES_KV, MODELS):  # fills the cache on disk where it is empty
        tube_fluence_interpolated(float(voltage), energies_keV=model.energies_keV, model=name, for_sums=True)
    for voltage, error in itertools.product(VOLTAGES_KV, (-0.06, 0.06)):
        tube_fluence_interpolated(float(voltage) * (1 + error), energies_keV=model.energies_keV)
    for turn in ("first", "again", "again", "again"):
        begin = time.perf_counter()
        levels = predict_levels(twin, kV=kV, filters=filters, load_mAs=load_mAs)
        print(f"{len(grid)} settings, {turn}: {time.perf_counter() - begin:.3f} s")

    apart = []
    hardest = (len(STACKS) - 1) * len(EXPOSURES_MS)  # lowest kV, thickest stack: only the end of the spectrum is left
    for number in [*np.random.default_rng(2).choice(len(grid), CHECKED, replace=False), hardest]:
        tube = spekpy.Spek(kvp=float(kV[number]), th=12.0, dk=0.1, physics="casim", targ="W", x=0, y=0, z=100, mas=1)
        energies, fluence = tube.get_spectrum()
        response = detector_response(scintillator=SCINTILLATOR, energies_keV=energies)
        passed = fluence * transmission(filters[number], energies, bin_width_keV=0.1)
        step_keV = energies[1] - energies[0]
        signal = float(passed @ response.mean_deposited_keV) * step_keV / 100.0 * load_mAs[number] * 0.15**2
        apart.append(levels.mean_DN[number] / signal - 1.0)
    drawn, last = np.abs(apart[:-1]), apart[-1]
    print(f"mean against SpekPy at the kV, 0.1 keV bins: largest of {CHECKED} settings {np.max(drawn):.1e}")
    print(f"same, lowest kV behind the thickest stack: {last:.1e}")

    settings = [
        Setting(kV=float(kV[k]), exposure_ms=float(1000 * load_mAs[k]), current_mA=1.0, filters=filters[k])
        for k in np.random.default_rng(3).choice(len(grid), INTERVALS, replace=False)
    ]
    times = []
    for setting in settings:
        begin = time.perf_counter()
        predict_flatfield(twin, setting)
        times.append(time.perf_counter() - begin)
    print(f"with intervals, {DRAWS} draws: {1e3 * np.median(times):.1f} ms a setting (median of {INTERVALS})")


if __name__ == "__main__":
    main()
