"""The twin and its file, predictions, generation and the paper's recipe, on a twin whose parameters are set by hand."""

import dataclasses
import math
from dataclasses import fields, replace

import h5py
import numpy as np
import pytest

from raytwin.acquisition import Setting, read_dataset, setting_from_text
from raytwin.acquisition.dataset_io import DatasetRow, write_dataset
from raytwin.acquisition.instrument import Instrument
from raytwin.acquisition.setting import filters_from_text
from raytwin.errors import FileFormatError, InputError
from raytwin.generator.datasets.generate import ChannelModel, generate_dataset
from raytwin.generator.line.measured_flats import measured_flats
from raytwin.generator.line.spectral_signal import OpenBeam, SpectralModel
from raytwin.generator.line.twin import (
    DetectorMaps,
    Estimate,
    Level,
    NoiseModel,
    OtherSpread,
    SpectralPosterior,
    Twin,
    estimate_from_sd,
    gaussian_spread,
)
from raytwin.generator.predictions.predict import predict_flatfield, slope_share, spectral_model_of
from raytwin.generator.references.as_published import published_parameters, sample_as_published
from raytwin.generator.spread.noise import sample_frame_noise
from raytwin.generator.spread.psf import Spread, blur_variance_share, sampled_gaussian_1d
from raytwin.generator.twins.twin_io import read_twin, write_twin

SHAPE = (36, 40)
COPPER = filters_from_text("Cu:0.05")
SIGMA, WHITE, READ = 0.5, 0.01, 12.0
GAINS = {40.0: 6.0, 90.0: 10.0}
INSTRUMENT = Instrument(
    anode="W",
    pixel_mm=0.15,
    source_object_mm=990.0,
    source_detector_mm=1059.0,
    scintillator=filters_from_text("CsI:0.5"),
    bits=16,
    maximum_power_w=90.0,
    counting=False,
)


def posterior():
    model = SpectralModel(filter_materials=("Al", "Cu"))
    rng = np.random.default_rng(0)
    samples = np.zeros((64, len(model.names)))
    samples[:, 0] = 0.8 + 0.1 * rng.standard_normal(64)
    samples[:, 4] = math.log(0.02) + 0.01 * rng.standard_normal(64)
    samples[:, 5] = math.log(0.85) + 0.02 * rng.standard_normal(64)
    best = samples.mean(axis=0)
    return SpectralPosterior(
        names=model.names,
        samples=samples,
        best=best,
        prior={"inherent_filtration_mm_Al": "0.8 +- 0.1"},
        undetermined=("log_output",),
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
    )


def make_twin(**changes):
    rng = np.random.default_rng(1)
    share = (blur_variance_share("aperture", SIGMA) + WHITE) / (1 + WHITE)
    bad = np.zeros(SHAPE, dtype=np.uint8)
    bad[4, 5] = 1
    shape = (1 + 0.02 * rng.standard_normal(SHAPE)).astype(np.float32)
    shape[4, 5] = 0.0
    levels = tuple(
        Level(
            kV=kV,
            filters=COPPER,
            gain_DN=estimate_from_sd(gain, 0.01 * gain),
            photon_transfer_slope_DN=estimate_from_sd(gain * share, 0.01 * gain * share),
            rate_DN_per_mAs=estimate_from_sd(rate, 0.001 * rate),
            source_detector_mm=1059.0,
            saturation_DN=None,
            flat_shape=shape,
            series=(f"flat_{kV:g}",),
            role="calibration",
        )
        for (kV, gain), rate in zip(GAINS.items(), (23000.0, 347000.0), strict=True)
    )
    values = {
        "instrument": INSTRUMENT,
        "maps": DetectorMaps(
            dark_DN=np.full(SHAPE, 1200.0, dtype=np.float32),
            dark_exposure_ms=20.0,
            dark_DN_per_ms=np.full(SHAPE, 0.1, dtype=np.float32),
            gain_relative=np.ones(SHAPE, dtype=np.float32),
            read_variance_DN2=np.full(SHAPE, READ**2 + 1 / 12, dtype=np.float32),
            bad_pixels=bad,
        ),
        "noise": NoiseModel(
            spread=gaussian_spread("aperture", estimate_from_sd(SIGMA, 0.003)),
            white_fraction=WHITE,
            read_noise_DN=estimate_from_sd(READ, 0.05),
            quantised=True,
        ),
        "dark_DN": estimate_from_sd(1200.0, 0.1),
        "levels": levels,
        "spectral": posterior(),
        "evidence": {"stack_over_pair_variance": 1.001, "nothing": None},
        "warnings": ("a warning",),
        "provenance": {"seed": 3},
    }
    return Twin(**{**values, **changes})


@pytest.fixture(scope="module")
def twin():
    return make_twin()


def same(first, second):
    for entry in fields(first):
        one, other = getattr(first, entry.name), getattr(second, entry.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype
            assert np.array_equal(one, other), entry.name
        elif hasattr(one, "__dataclass_fields__"):
            same(one, other)
        elif isinstance(one, tuple) and one and hasattr(one[0], "flat_shape"):
            for pair in zip(one, other, strict=True):
                same(*pair)
        else:
            assert one == other, entry.name


@pytest.mark.parametrize("with_spectrum", [True, False])
def test_a_twin_comes_back_from_its_file_as_it_was(tmp_path, twin, with_spectrum):
    written = twin if with_spectrum else make_twin(spectral=None, instrument=Instrument())
    other = Spread(sigma_px=0.4, aspect=1.1, tail_share=0.2, tail_px=1.5, tail_order=1.5)
    tailed = replace(
        gaussian_spread("aperture", estimate_from_sd(0.4, 0.01)),
        value=Spread(sigma_px=0.4, tail_share=0.3, tail_px=2.0, tail_order=0.0, absorption_per_px=0.2, axes="row"),
        others=(OtherSpread(family="two widths with an exponential tail", probability=0.2, value=other),),
    )
    written = replace(written, noise=replace(written.noise, spread=tailed))
    write_twin(tmp_path / "twin.h5", written)
    same(written, read_twin(tmp_path / "twin.h5"))
    assert [path.name for path in tmp_path.iterdir()] == ["twin.h5"]


def test_a_file_from_before_layers_that_absorb_and_line_cameras_has_none_of_them(tmp_path, twin):
    layer = Spread(sigma_px=0.4, tail_share=0.3, tail_px=2.0, tail_order=0.0)
    spread = replace(gaussian_spread("aperture", estimate_from_sd(0.4, 0.01)), value=layer)
    write_twin(tmp_path / "twin.h5", replace(twin, noise=replace(twin.noise, spread=spread)))
    for name in ("absorption_per_px", "spread_axes"):
        damage(tmp_path / "twin.h5", lambda file, name=name: file["noise"].attrs.__delitem__(name))
    assert read_twin(tmp_path / "twin.h5").noise.spread.value == layer


def damage(path, edit):
    with h5py.File(path, "r+") as file:
        edit(file)


def replaced(file, name, values):
    """Put other values in the place of an array."""
    del file[name]
    file[name] = values


DAMAGES = {
    "another format": (lambda file: file.attrs.modify("format", "other"), "got format 'other'; expected a twin"),
    "another version": (lambda file: file.attrs.modify("version", 2), "raytwin-twin version 2.*calibrate again"),
    "another kind": (lambda file: file.attrs.modify("format", "raytwin-dataset"), "got a dataset.*`raytwin calibrate`"),
    "no format": (lambda file: file.attrs.pop("format"), "without a `format`"),
    "a missing map": (lambda file: file["maps"].pop("dark_DN"), "damaged file"),
    "no levels": (lambda file: file.pop("levels"), "damaged file"),
    "a list for names": (lambda file: file.attrs.modify("provenance", "[]"), "damaged file"),
    "names for texts": (lambda file: file.attrs.modify("warnings", "{}"), "damaged file"),
    "spoiled text": (lambda file: file.attrs.modify("evidence", "{"), "damaged file"),
    "a missing estimate": (lambda file: file["noise"].attrs.pop("psf_sigma_px"), "psf_sigma_px"),
    "a wrong interval": (lambda file: file["noise"].attrs.modify("dark_DN", [3.0, 4.0, 5.0]), "low <= value"),
    "an estimate of another length": (lambda file: file["noise"].attrs.create("dark_DN", [3.0]), "damaged file"),
    "maps of another shape": (
        lambda file: [file["maps"].pop("bad_pixels"), file["maps"].create_dataset("bad_pixels", data=np.zeros((2, 2)))],
        "one shape",
    ),
    "no pixel that can be used": (
        lambda file: replaced(file, "maps/bad_pixels", np.ones(SHAPE, np.uint8)),
        "0 pixels that are not bad; expected at least 16",
    ),
    "a map of text": (
        lambda file: [file["maps"].pop("dark_DN"), file["maps"].create_dataset("dark_DN", data="abc")],
        "one shape|damaged file",
    ),
    "a map of complex numbers": (
        lambda file: replaced(file, "maps/gain_relative", np.ones(SHAPE, np.complex64)),
        "values of type complex64; expected real numbers",
    ),
    "complex draws": (
        lambda file: replaced(file, "spectral/best", file["spectral/best"][()] * 1j),
        "values of type complex128; expected real numbers",
    ),
    "another spread without a probability": (
        lambda file: file["noise"].attrs.update(
            spread_others='[{"family": "exponential", "probability": 0, "value": {"model": "aperture", "sigma_px": 0.5,'
            ' "aspect": 1, "tail_share": 0.1, "tail_px": 1, "tail_order": 1.5}}]'
        ),
        "exponential with a probability of 0; expected a probability above 0",
    ),
    "a spread of no order": (
        lambda file: file["noise"].attrs.update(tail_order=np.nan),
        "tail_order of the optical spread: got nan; expected 0 to 100",
    ),
    "a layer that gives light": (
        lambda file: file["noise"].attrs.update(absorption_per_px=-0.5),
        "absorption_per_px of the optical spread: got -0.5; expected 0 to 1000",
    ),
    "a spread along no axis": (
        lambda file: file["noise"].attrs.update(spread_axes="depth"),
        "axes of the optical spread: got depth; expected one of both, row, column",
    ),
    "another spread of no shape": (
        lambda file: file["noise"].attrs.update(
            spread_others='[{"family": "exponential", "probability": 0.2, "value": 3}]'
        ),
        "a damaged file",
    ),
    "a flat of fewer than no exposures": (
        lambda file: file["levels/0000"].attrs.update(exposures=-3.0),
        "exposures of twin .*: got -3.0; expected a finite number, 0 or more",
    ),
    "noise of the dark that is no number": (
        lambda file: file["maps"].attrs.update(dark_noise=[math.nan, 0.0, 0.0]),
        "dark_noise of twin .*; expected three numbers",
    ),
    "draws that no exponent holds": (
        lambda file: replaced(file, "spectral/samples", 1e7 * file["spectral/samples"][()]),
        "all below 710",
    ),
    "draws that no number holds": (
        lambda file: replaced(
            file, "spectral/samples", np.full(file["spectral/samples"].shape, np.longdouble("1e4000"))
        ),
        "not finite",
    ),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_a_damaged_twin_is_refused_by_name(tmp_path, twin, case):
    edit, message = DAMAGES[case]
    path = tmp_path / "twin.h5"
    write_twin(path, twin)
    damage(path, edit)
    with pytest.raises((FileFormatError, InputError), match=message):
        read_twin(path)


def test_estimates_hold_their_value_inside_their_interval():
    assert estimate_from_sd(1.0, 1.0, lowest=0.0).low == 0.0
    assert estimate_from_sd(2.0, 0.1).as_dict() == pytest.approx({"value": 2.0, "low": 1.804, "high": 2.196}, abs=1e-3)
    for values in ((math.nan, 0.0, 1.0), (1.0, 2.0, 3.0), (1.0, 0.0, 0.5)):
        with pytest.raises(InputError, match="low <= value <= high"):
            Estimate(value=values[0], low=values[1], high=values[2])


def test_a_measured_level_scales_with_load_and_frames(twin):
    one = predict_flatfield(twin, setting_from_text("kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05"))
    assert one.measured_level and not one.extrapolated
    assert one.mean_DN.value == pytest.approx(23000.0 * 0.02)
    assert one.gain_DN.value == pytest.approx(6.0)
    share = slope_share(twin)
    assert one.sd_DN.value == pytest.approx(math.sqrt(6.0 * share * 460.0 + READ**2 + 1 / 12), rel=1e-3)
    nine = predict_flatfield(twin, setting_from_text("kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05,averaged=9"))
    assert nine.mean_DN == one.mean_DN
    assert nine.sd_DN.value == pytest.approx(one.sd_DN.value / 3)
    assert nine.gain_DN == one.gain_DN
    longer = predict_flatfield(twin, setting_from_text("kv=40,power_w=20,exposure_ms=60,filter=Cu:0.05"))
    assert longer.mean_DN.value == pytest.approx(1.5 * one.mean_DN.value)
    assert longer.photons_absorbed.value == pytest.approx(1.5 * one.photons_absorbed.value)
    nearer = predict_flatfield(
        twin, setting_from_text("kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05,source_detector_mm=529.5")
    )
    assert nearer.mean_DN.value == pytest.approx(4 * one.mean_DN.value)


def test_an_unmeasured_setting_is_the_model_at_its_draws(twin):
    setting = setting_from_text("kv=60,current_ma=1,exposure_ms=20,filter=Cu:0.05")
    found = predict_flatfield(twin, setting)
    model = spectral_model_of(twin)
    signal = model.signal(twin.spectral.samples, OpenBeam(kV=60.0, filters=COPPER))
    factor = (1000 / 1059) ** 2 * 0.15**2 * 0.02
    assert found.mean_DN.value == pytest.approx(float(np.median(signal.rate_DN_per_mAs)) * factor)
    assert not found.measured_level
    assert not found.extrapolated
    assert found.mean_DN.low < found.mean_DN.value < found.mean_DN.high


def test_what_all_gains_are_off_by_alike_is_in_gain_and_photons_and_not_in_the_noise(tmp_path, twin):
    """Draws of the spectrum know gains over slopes as exact: a ratio known to 10 % makes gains and photons as uncertain."""
    setting = setting_from_text("kv=60,current_ma=1,exposure_ms=20,filter=Cu:0.05")
    exact, unsure = (replace(twin, noise=replace(twin.noise, shared_gain_sd=relative_sd)) for relative_sd in (0.0, 0.1))
    write_twin(tmp_path / "twin.h5", unsure)
    before, after = (predict_flatfield(item, setting) for item in (exact, read_twin(tmp_path / "twin.h5")))

    def log_sd(estimate):
        return math.log(estimate.high / estimate.low) / (2 * 1.959964)

    for name in ("gain_DN", "photons_absorbed"):
        own, found = (log_sd(getattr(item, name)) for item in (before, after))
        assert found == pytest.approx(math.hypot(own, 0.1), rel=0.1)
    assert log_sd(after.sd_DN) == pytest.approx(log_sd(before.sd_DN), rel=1e-9)
    assert after.mean_DN == before.mean_DN


@pytest.mark.parametrize(
    "outside",
    [
        "kv=92,current_ma=0.5,exposure_ms=20,filter=Cu:0.05",
        "kv=39,current_ma=1,exposure_ms=20,filter=Cu:0.05",
        "kv=60,current_ma=0.5,exposure_ms=20,filter=Cu:0.3",
        "kv=60,current_ma=0.5,exposure_ms=20,filter=Sn:0.1",
    ],
)
def test_outside_the_calibrated_range_is_flagged_and_wider(twin, outside):
    setting = setting_from_text(outside)
    found = predict_flatfield(twin, setting)
    calibrated = replace(
        twin.spectral, calibrated_kV=(30.0, 120.0), calibrated_filters=("", "Cu:0.05", "Cu:0.5", "Sn:0.2")
    )
    inside = predict_flatfield(replace(twin, spectral=calibrated), setting)
    assert found.extrapolated
    assert not inside.extrapolated
    assert any("outside the calibrated range" in line for line in found.warnings)
    assert found.mean_DN.high / found.mean_DN.low > inside.mean_DN.high / inside.mean_DN.low
    assert found.gain_DN.high / found.gain_DN.low > inside.gain_DN.high / inside.gain_DN.low


def test_kerma_belongs_to_the_object_and_falls_with_the_square_of_its_distance(twin):
    setting = setting_from_text("kv=60,current_ma=1,exposure_ms=20,filter=Cu:0.05")
    at_object = predict_flatfield(twin, setting)
    unknown = predict_flatfield(replace(twin, instrument=replace(INSTRUMENT, source_object_mm=None)), setting)
    assert any("at the detector" in line for line in unknown.warnings)
    assert unknown.air_kerma_uGy.value == pytest.approx(at_object.air_kerma_uGy.value * (990 / 1059) ** 2)


def test_what_the_instrument_cannot_do_is_said(twin):
    with pytest.raises(InputError, match="at most the tube's 90 W"):
        predict_flatfield(twin, setting_from_text("kv=60,power_w=120,exposure_ms=20"))
    bright = predict_flatfield(twin, setting_from_text("kv=90,power_w=90,exposure_ms=2000,filter=Cu:0.05"))
    assert any("saturates" in line for line in bright.warnings)
    with pytest.raises(InputError, match="a tube load"):
        predict_flatfield(twin, setting_from_text("kv=60,exposure_ms=20"))


def test_without_a_spectrum_only_measured_levels_are_predicted():
    plain = make_twin(spectral=None)
    known = predict_flatfield(plain, setting_from_text("kv=40,power_w=40,exposure_ms=20,filter=Cu:0.05"))
    assert known.photons_absorbed is None
    assert known.to_dict()["air_kerma_uGy"] is None
    with pytest.raises(InputError, match="no spectral part"):
        predict_flatfield(plain, setting_from_text("kv=60,power_w=40,exposure_ms=20,filter=Cu:0.05"))
    with pytest.raises(InputError, match="without spectral part"):
        spectral_model_of(plain)


@pytest.mark.parametrize(
    ("levels", "kV", "filters", "found"),
    [
        ([(40.0, "Cu:0.05"), (90.0, "Cu:0.05")], 90.0, "Cu:0.05", 1),
        ([(40.0, "Cu:0.05"), (90.0, "Cu:0.05")], 55.0, "Cu:0.05", 0),
        # the nearest voltage counts before the filter, and an unknown voltage is near to none
        ([(40.0, ""), (40.0, "Cu:0.05"), (90.0, "Al:1")], 80.0, "Cu:0.05", 2),
        ([(40.0, ""), (40.0, "Cu:0.05"), (90.0, "Al:1")], 45.0, "Cu:0.1", 0),
        ([(None, "Cu:0.05"), (40.0, "")], 90.0, "Cu:0.05", 1),
        ([(None, "Cu:0.05")], 90.0, "Cu:0.05", 0),
    ],
)
def test_the_nearest_level_is_nearest_in_voltage_then_in_filters(twin, levels, kV, filters, found):
    made = tuple(replace(twin.levels[0], kV=kV, filters=filters_from_text(text)) for kV, text in levels)
    wanted = Setting(kV=kV, power_W=40.0, exposure_ms=20.0, filters=filters_from_text(filters))
    assert replace(twin, levels=made).level_nearest(wanted) is made[found]
    assert replace(twin, levels=()).level_nearest(wanted) is None


def pair(exposure_ms, averaged=1):
    return tuple(
        Setting(kV=kV, power_W=40.0, exposure_ms=exposure_ms, filters=COPPER, averaged=averaged) for kV in GAINS
    )


def reference_file(path, *, count=6, transmission=(0.5, 0.7), setting=None):
    """References without noise: a slab and an edge, one image with a foreign object in two."""
    low, high = pair(100.0, 10)
    setting = f"{low};{high}" if setting is None else setting
    with write_dataset(path, shape=SHAPE, provenance={}) as writer:
        for number in range(count):
            image = np.stack([np.full(SHAPE, -math.log(value)) for value in transmission])
            mask = np.zeros(SHAPE)
            if number % 2:
                mask[10:14, 10:14] = 1
            writer.append(
                image=image,
                foreign_object_mask=mask,
                product_mask=np.ones(SHAPE),
                row=DatasetRow(
                    image=f"r{number}",
                    product="p",
                    foreign_object="bone" if number % 2 else "",
                    split="train" if number < 4 else "test",
                    setting=setting,
                ),
            )
    return path


def generated(twin, references, out, **options):
    low, high = pair(options.pop("exposure_ms", 20.0))
    settings = {"low": low, "high": high, "images": 6, "seed": 1, **options}
    with read_dataset(references) as dataset:
        return generate_dataset(twin, dataset, out, **settings)


def test_generated_counts_have_the_twin_s_mean_and_noise_behind_the_product(tmp_path, twin):
    references = reference_file(tmp_path / "r.h5")
    generated(twin, references, tmp_path / "g.h5", images=80)
    with read_dataset(tmp_path / "g.h5") as dataset:
        counts = dataset.counts(slice(None)).astype(np.float64)
    for plane, (kV, transmission) in enumerate(zip(GAINS, (0.5, 0.7), strict=True)):
        target = pair(20.0)[plane]
        prediction = predict_flatfield(twin, target)
        channel = ChannelModel(twin, target, "chicken_breast")
        good = twin.maps.bad_pixels == 0
        expected = 1200.0 + prediction.mean_DN.value * transmission * twin.levels[plane].flat_shape
        assert np.mean((counts[:, plane] - expected)[:, good]) == pytest.approx(
            0.0, abs=5 * math.sqrt(GAINS[kV] * prediction.mean_DN.value / counts[:, plane].size)
        )
        gain = float(channel.gain_behind(np.array(transmission)))
        assert 1.0 < gain / GAINS[kV] < 1.25
        # the references hold no noise: what was drawn is the missing share alone
        load = 40.0 / kV
        held = 20.0 / 100.0 / 10.0
        quantum = (1 - held) * gain * slope_share(twin) * prediction.mean_DN.value * transmission
        variance = quantum + (1 - 0.2**2 / 10) * (READ**2 + 1 / 12)
        measured = counts[:, plane].var(axis=0, ddof=1)[good].mean()
        assert load > 0
        assert measured == pytest.approx(variance, rel=5 * math.sqrt(2 * 2.5 / counts[:, plane].size) + 0.003)


def test_a_dead_pixel_is_generated_as_its_neighbours(tmp_path, twin):
    generated(twin, reference_file(tmp_path / "r.h5"), tmp_path / "g.h5", images=30)
    with read_dataset(tmp_path / "g.h5") as dataset:
        images = dataset.images(slice(None))
    assert images[:, 0, 4, 5].mean() == pytest.approx(-math.log(0.5), abs=0.08)


def test_the_same_seed_gives_the_same_images_and_another_seed_others(tmp_path, twin):
    references = reference_file(tmp_path / "r.h5")
    summaries = [
        generated(twin, references, tmp_path / f"{name}.h5", seed=seed) for name, seed in (("a", 1), ("b", 1), ("c", 2))
    ]
    contents = []
    for name in "abc":
        with read_dataset(tmp_path / f"{name}.h5") as dataset:
            contents.append(dataset.images(slice(None)))
    assert np.array_equal(contents[0], contents[1])
    assert not np.array_equal(contents[0], contents[2])
    assert summaries[0].dataset_sha256 == summaries[1].dataset_sha256
    # an image does not depend on how many come after it
    generated(twin, references, tmp_path / "d.h5", seed=1, images=3)
    with read_dataset(tmp_path / "d.h5") as dataset:
        assert np.array_equal(dataset.images(slice(None)), contents[0][:3])


def test_every_reference_takes_its_turn_and_its_row_along(tmp_path, twin):
    summary = generated(twin, reference_file(tmp_path / "r.h5"), tmp_path / "g.h5", images=12)
    with read_dataset(tmp_path / "g.h5") as dataset:
        names = sorted(row.image.split("-")[0] for row in dataset.rows)
        assert names == sorted([f"r{number}" for number in range(6)] * 2)
        for number, row in enumerate(dataset.rows):
            assert bool(row.foreign_object) == bool(dataset.foreign_object_masks(number).any())
            assert row.setting == ";".join(map(str, pair(20.0)))
        assert dataset.attributes["seed"] == 1
    assert (summary.images, summary.references, summary.with_foreign_object) == (12, 6, 6)
    only = generated(twin, tmp_path / "r.h5", tmp_path / "t.h5", images=5, split="test")
    assert only.references == 2


def test_too_many_dim_frames_carry_more_electronic_noise_and_say_so(tmp_path, twin):
    low, high = pair(10.0, 100)
    references = reference_file(tmp_path / "r.h5", setting=f"{low};{high}")
    summary = generated(twin, references, tmp_path / "g.h5", exposure_ms=200.0)
    assert any("more electronic noise" in line for line in summary.warnings)
    fine = generated(twin, reference_file(tmp_path / "f.h5"), tmp_path / "h.h5")
    assert fine.warnings == ()


def test_clipped_images_are_counted_and_said(tmp_path, twin):
    references = reference_file(tmp_path / "r.h5", transmission=(1e-3, 1e-3))
    summary = generated(twin, references, tmp_path / "g.h5")
    assert summary.clipped_percent > 10
    assert any("clipped" in line for line in summary.warnings)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"recipe": "other"}, "one of raytwin, as_published"),
        ({"images": 0}, "number of images"),
        ({"low": pair(20.0)[1], "high": pair(20.0)[0]}, "low kV below high kV"),
        ({"split": "val"}, "no image of split val"),
        ({"exposure_ms": 2000.0}, "too noisy"),
        ({"low": replace(pair(20.0)[0], filters=()), "recipe": "as_published"}, "published recipe knows no other"),
        ({"bad_pixels": "other"}, "repaired, measured"),
    ],
)
def test_what_cannot_be_generated_is_refused_and_leaves_no_file(tmp_path, twin, options, message):
    references = reference_file(tmp_path / "r.h5")
    with pytest.raises(InputError, match=message):
        generated(twin, references, tmp_path / "g.h5", **options)
    assert [path.name for path in tmp_path.iterdir()] == ["r.h5"]


def test_references_that_do_not_say_their_setting_need_one(tmp_path, twin):
    references = reference_file(tmp_path / "r.h5", setting="unknown")
    with pytest.raises(InputError, match="give --reference-low and --reference-high"):
        generated(twin, references, tmp_path / "g.h5")
    assert generated(twin, references, tmp_path / "g.h5", reference_setting=pair(100.0, 10)).images == 6


def test_as_published_adds_full_noise_to_a_reference_that_has_noise():
    """On a line that is just as the recipe assumes, its log variance is a quarter too high at 500 ms, a half at 1 s.

    The 1 s reference brings its own noise, scaled by s in variance, blurred once by the detector and once more by the
    recipe, on top of the full new noise: 1 + s sum((h*h)^2) / sum(h^2).
    """
    rng = np.random.default_rng(4)
    blur, dark = 0.8, 1250.0
    area = 4 * math.pi * blur**2
    gain, read_DN = 1.949 * area, math.sqrt(165.63 * area)  # raised so that the blurred noise is as measured
    level = np.full((160, 160), 23.0 * 1000.0)
    kernel = sampled_gaussian_1d(blur, 8)
    again = float(np.sum(np.convolve(kernel, kernel) ** 2) / np.sum(kernel**2)) ** 2

    def frame(signal):
        made = sample_as_published(
            signal,
            gain_DN=gain,
            read_noise_DN=read_DN,
            blur_px=blur,
            dark_DN=np.full(level.shape, dark),
            rng=rng,
        )
        return made.astype(np.float64) - dark

    reference = frame(level)
    assert np.var(reference) == pytest.approx(1.949 * level[0, 0] + 165.63, rel=0.08)
    for seconds in (0.5, 1.0):
        ratio = np.var(np.log(frame(reference * seconds))) / np.var(np.log(frame(level * seconds)))
        assert ratio == pytest.approx(1 + seconds * again, abs=5 * math.sqrt(4 * 6.0 / level.size))
        assert 1 + seconds * again == pytest.approx(1 + 0.5 * seconds, abs=0.03)


def test_published_parameters_are_the_ones_read_off_the_same_flats(twin):
    read = published_parameters(twin)
    area = 4 * math.pi * 2 * SIGMA**2
    assert read["gain_DN"] == pytest.approx(twin.levels[0].photon_transfer_slope_DN.value * area)
    assert read["blur_px"] == pytest.approx(math.sqrt(2) * SIGMA)
    assert read["read_noise_DN"] == pytest.approx(READ * math.sqrt(area), rel=1e-3)


def test_as_published_smears_small_bones_and_raytwin_does_not(tmp_path, twin):
    """A point of attenuation keeps its depth by top-up; the paper's blur takes most of it."""
    low, high = pair(100.0, 10)
    image = np.zeros((2, *SHAPE))
    image[:, 18, 20] = 0.5
    with write_dataset(tmp_path / "r.h5", shape=SHAPE, provenance={}) as writer:
        writer.append(
            image=image,
            foreign_object_mask=np.zeros(SHAPE),
            product_mask=np.ones(SHAPE),
            row=DatasetRow(image="r", setting=f"{low};{high}"),
        )
    depths = {}
    for recipe in ("raytwin", "as_published"):
        generated(twin, tmp_path / "r.h5", tmp_path / f"{recipe}.h5", recipe=recipe, images=60)
        with read_dataset(tmp_path / f"{recipe}.h5") as dataset:
            depths[recipe] = float(dataset.images(slice(None))[:, 1, 18, 20].mean())
    assert depths["raytwin"] == pytest.approx(0.5, abs=0.03)
    assert depths["as_published"] < 0.35


def test_noise_from_scratch_and_prediction_agree(twin):
    prediction = predict_flatfield(twin, pair(20.0)[0])
    rng = np.random.default_rng(6)
    signal = np.full((300, 300), prediction.mean_DN.value)
    noise = sample_frame_noise(
        signal,
        gain_DN=prediction.gain_DN.value,
        white_fraction=WHITE,
        read_variance_DN2=twin.noise.read_variance_DN2,
        spread=Spread(sigma_px=SIGMA),
        rng=rng,
    )
    assert noise.std() == pytest.approx(prediction.sd_DN.value, rel=5 * math.sqrt(2.5 / 2 / noise.size))


@pytest.mark.parametrize("rows", [[{"used": True}], [{"used": True, "series": "a", "signal_DN": "dim"}], [3], 5])
def test_flats_of_a_twin_that_cannot_be_read_are_one_line(series_line, rows):
    damaged = dataclasses.replace(series_line, evidence={"photon_transfer": rows})
    with pytest.raises(InputError, match=r"photon_transfer.*calibrate again"):
        measured_flats(damaged)


def test_only_flats_that_were_used_and_have_light_are_measured_flats(series_line):
    rows = [
        {"used": True, "series": "a", "signal_DN": 900.0, "kV": 40, "exposure_ms": 20, "load_mAs": 0.02},
        {"used": False, "series": "b", "signal_DN": 900.0},
        {"used": True, "series": "c", "signal_DN": 0.0},
    ]
    (flat,) = measured_flats(dataclasses.replace(series_line, evidence={"photon_transfer": rows}))
    assert (flat.series, flat.signal_DN, flat.kV, flat.load_mAs) == ("a", 900.0, 40.0, 0.02)
    assert measured_flats(dataclasses.replace(series_line, evidence={})) == ()
