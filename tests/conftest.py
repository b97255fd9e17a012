"""Settings of all tests: one compiled thread a worker, no deadline for hypothesis, and examples that do not vary."""

import hashlib
import importlib.metadata
import inspect
import os
from functools import lru_cache

import pytest
from hypothesis import settings

# small frames spend their time waiting for threads, and the workers of the test run fill the cores already
for _threads in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

settings.register_profile("house", deadline=None, derandomize=True)
settings.load_profile("house")


@pytest.fixture(scope="session", autouse=True)
def kept_lab_spectra(pytestconfig):
    """SpekPy's spectra of the lab's tubes (two seconds each), kept by pytest's cache for other workers and other runs.

    They hang on SpekPy's version and on the code that asks for them: of another version or other code, none is used.
    """
    import numpy as np

    from raytwin.lab import tube

    if not hasattr(pytestconfig, "cache"):
        yield
        return
    folder = pytestconfig.cache.mkdir("lab_spectra")
    made_by = importlib.metadata.version("spekpy") + inspect.getsource(tube._bare_spectrum.__wrapped__)
    made_by += f"{tube.BIN_KEV} {tube.LOWEST_KEV}"

    @lru_cache(maxsize=256)
    def kept_spectrum(*tube_is):
        name = hashlib.sha256(f"{made_by} {tube_is}".encode()).hexdigest()
        path = folder / f"{name[:32]}.npy"
        if not path.exists():
            partial = folder / f"{name[:32]}.{os.getpid()}.npy"
            np.save(partial, np.stack(made(*tube_is)))
            os.replace(partial, path)
        energies, photons = np.load(path)
        for values in (energies, photons):
            values.setflags(write=False)
        return energies, photons

    made, tube._bare_spectrum = tube._bare_spectrum, kept_spectrum
    yield
    tube._bare_spectrum = made


@pytest.fixture(scope="session")
def series_line():
    """A twin of 40 x 40 pixels set by hand, with spectrum: 40 and 90 kV behind 50 um Cu were measured; no bad pixels."""
    import math

    import numpy as np

    from raytwin.acquisition.instrument import Instrument
    from raytwin.acquisition.setting import filters_from_text
    from raytwin.generator.line.spectral_signal import SpectralModel
    from raytwin.generator.line.twin import (
        DetectorMaps,
        Level,
        NoiseModel,
        SpectralPosterior,
        Twin,
        estimate_from_sd,
        gaussian_spread,
    )
    from raytwin.generator.spread.psf import blur_variance_share

    shape, sigma_px, white = (40, 40), 0.5, 0.01
    copper = filters_from_text("Cu:0.05")
    rng = np.random.default_rng(1)
    model = SpectralModel(filter_materials=("Al", "Cu"))
    best = np.zeros(len(model.names))
    values = {"inherent_filtration_mm_Al": 0.8, "log_DN_per_keV": math.log(0.02), "log_swank": math.log(0.85)}
    for name, value in values.items():
        best[model.names.index(name)] = value
    share = (blur_variance_share("aperture", sigma_px) + white) / (1 + white)
    flat_shape = (1 + 0.02 * rng.standard_normal(shape)).astype(np.float32)
    levels = tuple(
        Level(
            kV=kV,
            filters=copper,
            gain_DN=estimate_from_sd(gain, 0.01 * gain),
            photon_transfer_slope_DN=estimate_from_sd(gain * share, 0.01 * gain * share),
            rate_DN_per_mAs=estimate_from_sd(rate, 0.001 * rate),
            source_detector_mm=1059.0,
            saturation_DN=None,
            flat_shape=flat_shape,
            series=(f"flat_{kV:g}",),
            role="calibration",
        )
        for kV, gain, rate in ((40.0, 6.0, 23000.0), (90.0, 10.0, 347000.0))
    )
    return Twin(
        instrument=Instrument(
            anode="W",
            pixel_mm=0.15,
            source_object_mm=990.0,
            source_detector_mm=1059.0,
            scintillator=filters_from_text("CsI:0.5"),
            bits=16,
            readout_ms=2.0,
        ),
        maps=DetectorMaps(
            dark_DN=np.full(shape, 1200.0, dtype=np.float32),
            dark_exposure_ms=20.0,
            dark_DN_per_ms=np.full(shape, 0.1, dtype=np.float32),
            gain_relative=(1 + 0.01 * rng.standard_normal(shape)).astype(np.float32),
            read_variance_DN2=np.full(shape, 12.0**2 + 1 / 12, dtype=np.float32),
            bad_pixels=np.zeros(shape, dtype=np.uint8),
        ),
        noise=NoiseModel(
            spread=gaussian_spread("aperture", estimate_from_sd(sigma_px, 0.003)),
            white_fraction=white,
            read_noise_DN=estimate_from_sd(12.0, 0.05),
            quantised=True,
        ),
        dark_DN=estimate_from_sd(1200.0, 0.1),
        levels=levels,
        spectral=SpectralPosterior(
            names=model.names,
            samples=np.tile(best, (8, 1)),
            best=best,
            prior={},
            undetermined=(),
            anode="W",
            anode_angle_deg=12.0,
            model="casim",
            inherent=(),
            scintillator=filters_from_text("CsI:0.5"),
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


@pytest.fixture(scope="session")
def as_counter():
    """Called with a twin that adds up energies: the same with the spectrum of a counter from 20 keV on; of a counter, itself."""
    from dataclasses import replace

    import numpy as np

    from raytwin.generator.line.spectral_signal import SHARED_CHARGE, THRESHOLD, SpectralModel

    made = {}

    def counter(twin):
        if twin.instrument.counting:
            return twin
        if id(twin) not in made:
            known = twin.spectral
            model = SpectralModel(
                filter_materials=("Al", "Cu"), scintillator=known.scintillator, cover=known.cover, counting=True
            )
            best = model.default_parameters()
            for name, value in zip(known.names, known.best, strict=True):
                if name in model.names:
                    best[model.names.index(name)] = value
            # a count is what 40 keV were
            for name, value in ((THRESHOLD, 20.0), (SHARED_CHARGE, 0.2)):
                best[model.names.index(name)] = value
            best[model.names.index("log_DN_per_keV")] += np.log(40.0)
            samples = np.repeat(best[None], len(known.samples), axis=0)
            spectral = replace(known, names=model.names, best=best, samples=samples, counting=True)
            instrument = replace(twin.instrument, counting=True)
            made[id(twin)] = twin, replace(twin, instrument=instrument, spectral=spectral)
        return made[id(twin)][1]

    return counter


@pytest.fixture(scope="session")
def make_model_twin():
    """A twin set by hand whose measured levels, 40 and 90 kV behind 50 um Cu, are those of its own spectral model.

    Called with the detector's shape and what its instrument has otherwise than the paper's. The spread is 0.5 px, the
    white part 0.01, the electronic noise 12 DN, the dark 1200 DN.
    """
    import math
    from dataclasses import replace

    import numpy as np

    from raytwin.acquisition import Setting
    from raytwin.acquisition.instrument import Instrument
    from raytwin.acquisition.setting import filters_from_text
    from raytwin.generator.line.spectral_signal import SpectralModel
    from raytwin.generator.line.twin import (
        DetectorMaps,
        Level,
        NoiseModel,
        SpectralPosterior,
        Twin,
        estimate_from_sd,
        gaussian_spread,
    )
    from raytwin.generator.predictions.predict import predict_flatfield
    from raytwin.generator.spread.psf import blur_variance_share

    copper, scintillator = filters_from_text("Cu:0.05"), filters_from_text("CsI:0.5")
    sigma_px, white, read_DN = 0.5, 0.01, 12.0
    model = SpectralModel(filter_materials=("Al", "Cu"))
    best = model.default_parameters()
    values = {"inherent_filtration_mm_Al": 0.8, "log_DN_per_keV": math.log(0.2), "log_swank": math.log(0.9)}
    for name, value in values.items():
        best[model.names.index(name)] = value
    spectral = SpectralPosterior(
        names=model.names,
        samples=np.repeat(best[None], 8, axis=0),
        best=best,
        prior={},
        undetermined=(),
        anode="W",
        anode_angle_deg=12.0,
        model="casim",
        inherent=(),
        scintillator=scintillator,
        cover=(),
        counting=False,
        level_discrepancy=0.003,
        gain_discrepancy=0.01,
        calibrated_kV=(40.0, 90.0),
        calibrated_filters=("Cu:0.05",),
    )
    share = (blur_variance_share("aperture", sigma_px) + white) / (1 + white)

    def make(shape, **instrument):
        line = {"pixel_mm": 0.15, "source_object_mm": 990.0, "source_detector_mm": 1059.0, **instrument}
        bare = Twin(
            instrument=Instrument(anode="W", scintillator=scintillator, bits=16, counting=False, **line),
            maps=DetectorMaps(
                dark_DN=np.full(shape, 1200.0, dtype=np.float32),
                dark_exposure_ms=20.0,
                dark_DN_per_ms=np.zeros(shape, dtype=np.float32),
                gain_relative=np.ones(shape, dtype=np.float32),
                read_variance_DN2=np.full(shape, read_DN**2 + 1 / 12, dtype=np.float32),
                bad_pixels=np.zeros(shape, dtype=np.uint8),
            ),
            noise=NoiseModel(
                spread=gaussian_spread("aperture", estimate_from_sd(sigma_px, 0.003)),
                white_fraction=white,
                read_noise_DN=estimate_from_sd(read_DN, 0.05),
                quantised=True,
            ),
            dark_DN=estimate_from_sd(1200.0, 0.1),
            levels=(),
            spectral=spectral,
            evidence={},
            warnings=(),
        )
        levels = []
        for kV in (40.0, 90.0):
            setting = Setting(kV=kV, current_mA=1.0, exposure_ms=1000.0, filters=copper)
            predicted = predict_flatfield(bare, setting)
            levels.append(
                Level(
                    kV=kV,
                    filters=copper,
                    gain_DN=predicted.gain_DN,
                    photon_transfer_slope_DN=estimate_from_sd(share * predicted.gain_DN.value, 0.01),
                    rate_DN_per_mAs=predicted.mean_DN,
                    source_detector_mm=line["source_detector_mm"],
                    saturation_DN=None,
                    flat_shape=np.ones(shape, dtype=np.float32),
                    series=(f"flat_{kV:g}",),
                    role="calibration",
                )
            )
        return replace(bare, levels=tuple(levels))

    return make


@pytest.fixture(scope="session")
def make_tiny_session():
    """Called with a path: writes a session of the lab there, of 24 x 24 pixels, darks and a few flats of 3 frames."""
    import h5py

    from raytwin import lab_session

    kept = ("dark_20ms", "dark_50ms", "40kV_5W_20ms", "40kV_40W_20ms_Cu", "40kV_40W_50ms_Cu0.05", "90kV_5W_20ms")
    kept = (*kept, "90kV_45W_20ms_Cu0.05", "90kV_45W_50ms", "60kV_40W_20ms")

    def make(path):
        lab_session(path, protocol="calibration", seed=1, size=24, frames=3, families=())
        with h5py.File(path, "r+") as file:
            for name in [name for name in file["series"] if not any(word in name for word in kept)]:
                del file[f"series/{name}"]

    return make


@pytest.fixture(scope="session")
def make_sweep_line(make_model_twin):
    """Called with a folder: writes into it twin.h5, of 64 x 64 pixels and 90 W, products.toml that describes small fillets
    with ribs, and references.h5, 20 images of such that the line itself would show in 1 s, not dealt out. Returns the folder.
    """
    from raytwin.acquisition import read_dataset
    from raytwin.acquisition.dataset_io import write_selected
    from raytwin.acquisition.setting import setting_from_text
    from raytwin.generator.datasets.generate_described import generate_from_description
    from raytwin.generator.scenes.describe import read_description
    from raytwin.generator.twins.twin_io import write_twin

    products = """
[[product]]
shape = "fillet"
material = "chicken_breast"
length_mm = [22, 26]
width_mm = [15, 18]
height_mm = [8, 14]
[[foreign_object]]
name = "rib"
shape = "rod"
material = "rib_bone"
length_mm = [3, 6]
diameter_mm = [1, 3]
[images]
with_foreign_object = 0.7
products = 8
"""

    def make(folder):
        twin = make_model_twin(
            (64, 64),
            pixel_mm=0.45,
            source_object_mm=2970.0,
            source_detector_mm=3177.0,
            readout_ms=2.0,
            maximum_power_w=90.0,
        )
        write_twin(folder / "twin.h5", twin)
        (folder / "products.toml").write_text(products)
        low, high = (
            setting_from_text(f"kv={kV},power_w={power_W},exposure_ms=100,filter=Cu:0.05,averaged=10")
            for kV, power_W in ((40, 40), (90, 45))
        )
        description, drawn = read_description(folder / "products.toml"), folder / "drawn.h5"
        generate_from_description(twin, description, drawn, low=low, high=high, images=20, seed=5, with_counts=False)
        with read_dataset(drawn) as dataset:
            write_selected(dataset, folder / "references.h5", selection=slice(None), split="train")
        drawn.unlink()
        return folder

    return make


@pytest.fixture
def refused_line(capsys):
    """Called with the words of a command that must refuse its input: the one line that it prints, all on standard error."""
    from raytwin.cli import main

    def run(*words):
        capsys.readouterr()
        assert main([str(word) for word in words]) == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.count("\n") == 1, said
        return said.err

    return run


@pytest.fixture
def refused_import(refused_line):
    """Called with the words of an import that must be refused and its output: the one line; nothing is left behind."""

    def run(*words, out):
        before = sorted(out.parent.iterdir())
        line = refused_line("import", *words, "-o", out)
        assert sorted(out.parent.iterdir()) == before and not out.exists()
        return line

    return run


@pytest.fixture
def json_of(capsys):
    """Called with the words of a command: its answer, as --json prints it."""
    import json

    from raytwin.cli import main

    def run(*words):
        capsys.readouterr()
        assert main([*map(str, words), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    return run


@pytest.fixture(scope="module")
def browser():
    """Chromium, driven by Playwright; tests that ask for it are marked `browser` and run with `make test-page`."""
    import shutil

    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None:
        pytest.skip("no Chromium: apt-get install chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def open_page(browser):
    """Called with a page's path, a width and a height: the page opened from its file; `asked` and `wrong` hold what it requests
    and the errors of its scripts."""

    def opened(path, width=1200, height=900):
        context = browser.new_context(viewport={"width": width, "height": height})
        page = context.new_page()
        page.asked, page.wrong = [], []
        context.on("request", lambda request: page.asked.append(request.url))
        page.on("pageerror", lambda error: page.wrong.append(str(error)))
        page.on("console", lambda text: page.wrong.append(text.text) if text.type == "error" else None)
        page.goto(path.as_uri())
        page.wait_for_timeout(1500)
        return page

    return opened


@pytest.fixture(scope="module")
def check_page(open_page):
    """Called with a page's path: at 1200 and 400 px, folds open, it asks for nothing but itself, has no error, is no wider than
    the window, and every figure is drawn."""

    def check(path, *, static=False):
        for width, height in ((1200, 900), (400, 800)):
            page = open_page(path, width, height)
            page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true })")
            page.wait_for_timeout(1000)
            assert [url for url in page.asked if not url.startswith(("data:", "blob:"))] == [path.as_uri()]
            assert page.wrong == []
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            sizes = page.evaluate("Array.from(document.images).map((one) => one.naturalWidth)")
            assert min(sizes, default=1) > 0
            figures = page.locator(".drawn").count()
            assert (figures == 0 and sizes) if static else figures > 0
            if figures:
                page.locator(".drawn canvas").last.wait_for(timeout=60_000)
                boxes = [canvas.bounding_box() for canvas in page.locator(".drawn canvas").all()]
                wide = [box for box in boxes if box is not None and box["width"] > 0.5 * min(width, 340)]
                assert len(wide) >= figures  # an axis has a canvas of its own
            page.context.close()

    return check
