"""Reference transfer: mean, noise, skewness and the independence of the channels at another kV and filter."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from raytwin.acquisition import Setting, read_dataset
from raytwin.acquisition.dataset_io import DatasetRow, write_dataset
from raytwin.acquisition.setting import filters_from_text
from raytwin.errors import InputError
from raytwin.generator.datasets.generate import ChannelModel, PairTransfer, generate_dataset
from raytwin.generator.line.spectral_signal import OpenBeam
from raytwin.generator.predictions.predict import predict_flatfield, spectral_model_of
from raytwin.generator.references.transfer import nearest_covariance
from raytwin.generator.spread.noise import sample_frame_noise
from raytwin.generator.spread.psf import Spread, blur_variance_share, noise_autocovariance

SHAPE = (36, 40)
SIGMA, WHITE, READ = 0.5, 0.01, 12.0
COPPER = filters_from_text("Cu:0.05")
REFERENCE = (
    Setting(kV=40.0, power_W=40.0, exposure_ms=100.0, filters=COPPER, averaged=10),
    Setting(kV=90.0, power_W=45.0, exposure_ms=100.0, filters=COPPER, averaged=10),
)
ALUMINIUM = filters_from_text("Al:2")
TARGETS = {
    "other kV": (
        Setting(kV=60.0, power_W=40.0, exposure_ms=20.0, filters=COPPER),
        Setting(kV=120.0, power_W=45.0, exposure_ms=20.0, filters=COPPER),
    ),
    "other filter": (
        Setting(kV=40.0, power_W=20.0, exposure_ms=20.0, filters=ALUMINIUM),
        Setting(kV=90.0, power_W=20.0, exposure_ms=20.0, filters=ALUMINIUM),
    ),
    "averaged": (
        Setting(kV=60.0, power_W=40.0, exposure_ms=10.0, filters=COPPER, averaged=4),
        Setting(kV=120.0, power_W=45.0, exposure_ms=5.0, filters=COPPER, averaged=4),
    ),
}
OPTICS = {"spread": Spread(sigma_px=SIGMA), "white_fraction": WHITE}
MEAT_MM, BONE_MM = 15.0, 1.0


@pytest.fixture(scope="module")
def twin(make_model_twin):
    return make_model_twin(SHAPE)


def behind(twin, setting, thickness_mm):
    """Transmission of the signal and gain (DN) behind path lengths (2, ...) by the sum over energies."""
    model = spectral_model_of(twin)
    beam = OpenBeam(kV=setting.kV, filters=setting.filters)
    signal, variance, _ = model.moment_weights(twin.spectral.best, beam)
    depth = sum(
        length[..., None] * model.mu(name)[: len(signal)]
        for length, name in zip(np.asarray(thickness_mm), ("chicken_breast", "rib_bone"), strict=True)
    )
    passed = np.exp(-depth)
    return passed @ signal / signal.sum(), (passed @ variance) / (passed @ signal)


def reference_pair(twin, thickness_mm, rng, settings=REFERENCE, noisy=True):
    """Log images (2, row, column) of a reference with its own noise."""
    logs = []
    for setting in settings:
        transmission, gain = behind(twin, setting, thickness_mm)
        one_frame = replace(setting, averaged=1)
        opened = predict_flatfield(twin, one_frame).mean_DN.value
        n = setting.averaged
        noise = sample_frame_noise(
            opened * transmission,
            gain_DN=gain,
            read_variance_DN2=twin.maps.read_variance_DN2,
            rng=rng,
            quantum_share=1 / n,
            third_cumulant_share=1 / n**2,
            read_share=1 / n,
            **OPTICS,
        )
        logs.append(-np.log(transmission + (noise / opened if noisy else 0.0)))
    return np.stack(logs)


def slab(meat_mm=MEAT_MM, bone_mm=BONE_MM):
    return np.stack([np.full(SHAPE, meat_mm), np.full(SHAPE, bone_mm)])


@pytest.mark.parametrize("name", TARGETS)
def test_frames_at_another_setting_have_its_mean_variance_covariance_and_independent_channels(twin, name):
    targets = TARGETS[name]
    transfer = PairTransfer(twin, low=targets[0], high=targets[1])
    rng = np.random.default_rng(5)
    frames, thickness_mm = 100, slab()
    counts = np.empty((frames, 2, *SHAPE))
    for number in range(frames):
        pair, warnings = transfer.transfer(reference_pair(twin, thickness_mm, rng), REFERENCE)
        assert warnings == ()
        counts[number] = transfer.draw(pair, rng)
    dark = transfer.models[0].dark_DN
    above = counts - dark
    rho = noise_autocovariance("aperture", SIGMA, 6)
    correlated = float(np.sum(rho**2) / rho[6, 6] ** 2)
    pixels = frames * math.prod(SHAPE)
    for plane, setting in enumerate(targets):
        transmission, gain = (value.mean() for value in behind(twin, setting, thickness_mm))
        signal = transmission * predict_flatfield(twin, replace(setting, averaged=1)).mean_DN.value
        quantum = gain * signal / (1 + WHITE)
        n = setting.averaged
        variance = (
            quantum * (blur_variance_share("aperture", SIGMA) + WHITE) + float(twin.maps.read_variance_DN2[0, 0])
        ) / n
        total = gain * signal / n
        assert above[:, plane].mean() == pytest.approx(signal, abs=4 * math.sqrt(total / pixels) + 2e-4 * signal)
        found = above[:, plane].var(axis=0, ddof=1).mean()
        sd = math.sqrt(2 * correlated / pixels)
        assert found == pytest.approx(variance, rel=4 * sd + 2e-3)
        deviation = above[:, plane] - above[:, plane].mean(axis=0)
        beside = np.mean(deviation[:, :, 1:] * deviation[:, :, :-1]) * frames / (frames - 1)
        assert beside == pytest.approx(quantum / n * rho[6, 7], abs=4 * sd * variance + 2e-3 * variance)
    first, second = (above[:, plane] - above[:, plane].mean(axis=0) for plane in (0, 1))
    correlation = np.mean(first * second) / math.sqrt(np.mean(first**2) * np.mean(second**2))
    assert abs(correlation) < 4 * math.sqrt(correlated / pixels) + 1e-3


def test_without_the_common_part_the_channels_would_share_the_reference_s_noise(twin):
    """The planted fault: what the transferred images alone share is far from nothing."""
    targets = tuple(replace(one, exposure_ms=100.0) for one in TARGETS["other kV"])
    transfer = PairTransfer(twin, low=targets[0], high=targets[1])
    pair, _ = transfer.transfer(reference_pair(twin, slab(), np.random.default_rng(6)), REFERENCE)
    share = pair.held[0, 1] / np.sqrt(pair.held[0, 0] * pair.held[1, 1])
    assert np.median(share) > 0.3
    noise = pair.transmission - pair.transmission.mean(axis=(1, 2), keepdims=True)
    found = np.mean(noise[0] * noise[1]) / np.sqrt(np.mean(noise[0] ** 2) * np.mean(noise[1] ** 2))
    assert found == pytest.approx(float(np.median(share)), abs=0.15)


def test_the_transferred_skewness_is_the_target_s(twin):
    targets = tuple(replace(one, exposure_ms=1.0) for one in TARGETS["other kV"])
    transfer = PairTransfer(twin, low=targets[0], high=targets[1])
    rng = np.random.default_rng(7)
    thickness_mm = slab(25.0, 2.0)
    transmission, gain = (value.mean() for value in behind(twin, targets[0], thickness_mm))
    signal = transmission * predict_flatfield(twin, targets[0]).mean_DN.value
    values = []
    for _ in range(150):
        pair, _ = transfer.transfer(reference_pair(twin, thickness_mm, rng), REFERENCE)
        # the mean over the frame carries the sum of all that the spread correlates: quanta, skewed as before the spread
        values.append(transfer.draw(pair, rng)[0][4:-4, 4:-4].reshape(-1))
    deviation = np.array(values, dtype=np.float64)
    deviation -= deviation.mean()
    third = np.mean(deviation**3)
    kernel_cubes = third_share()
    expected = gain**2 * signal / (1 + WHITE) * kernel_cubes
    scatter = math.sqrt(15) * np.mean(deviation**2) ** 1.5 / math.sqrt(deviation.size / 4)
    assert third == pytest.approx(expected, abs=4 * scatter + 0.05 * expected)


def third_share():
    """sum h^3 of the noise kernel of two dimensions."""
    from raytwin.generator.spread.psf import noise_kernel_1d

    return float(np.sum(noise_kernel_1d("aperture", SIGMA) ** 3) ** 2)


def test_a_target_of_the_references_own_beams_is_the_reference(twin):
    own = tuple(replace(one, exposure_ms=20.0, averaged=1) for one in REFERENCE)
    transfer = PairTransfer(twin, low=own[0], high=own[1])
    logs = reference_pair(twin, slab(), np.random.default_rng(8))
    pair, _ = transfer.transfer(logs, REFERENCE)
    np.testing.assert_allclose(pair.transmission, np.exp(-logs), rtol=1e-9)
    assert np.abs(pair.held[0, 1]).max() < 1e-12
    # one frame of 20 ms in ten of 100 ms: a fiftieth of the target's quantum noise is there already
    np.testing.assert_allclose(pair.held[[0, 1], [0, 1]], 0.02, rtol=1e-3)


def test_small_bones_keep_their_contrast_within_one_percent(twin):
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    bone = 1.5 * np.exp(-(((y - 18) / 1.2) ** 2) - ((x - 20) / 2.0) ** 2)
    thickness_mm = np.stack([np.full(SHAPE, 18.0) - bone, bone])
    for targets in (TARGETS["other kV"], TARGETS["other filter"]):
        transfer = PairTransfer(twin, low=targets[0], high=targets[1])
        # blurred by the detector in signal, as a measurement is
        blurred = np.stack([-np.log(gaussian_filter(behind(twin, one, thickness_mm)[0], 0.7)) for one in REFERENCE])
        long = tuple(replace(one, averaged=100_000) for one in REFERENCE)
        pair, _ = transfer.transfer(blurred, long)
        for plane, setting in enumerate(targets):
            expected = -np.log(gaussian_filter(behind(twin, setting, thickness_mm)[0], 0.7))
            made = -np.log(pair.transmission[plane])
            contrast = expected[18, 20] - expected[4, 4]
            assert made[18, 20] - made[4, 4] == pytest.approx(contrast, rel=0.01)


def test_the_mean_of_noisy_transfers_is_right_where_the_exponents_leave_zero_to_one(twin):
    """120 kV lies outside 40 and 90 kV: the mean of powers of noisy values is corrected."""
    targets = tuple(replace(one, exposure_ms=2.0) for one in TARGETS["other kV"])
    short = tuple(replace(one, exposure_ms=20.0, averaged=1) for one in REFERENCE)
    transfer = PairTransfer(twin, low=targets[0], high=targets[1])
    rng = np.random.default_rng(9)
    mean = np.mean(
        [transfer.transfer(reference_pair(twin, slab(), rng, short), short)[0].transmission for _ in range(150)], axis=0
    )
    for plane, setting in enumerate(targets):
        expected = behind(twin, setting, slab())[0].mean()
        noise = mean[plane].std() / math.sqrt(mean[plane].size / 4)
        assert mean[plane].mean() == pytest.approx(expected, abs=4 * noise + 5e-4 * expected)


def test_a_reference_that_is_too_noisy_is_refused_with_what_would_do(twin):
    targets = tuple(replace(one, exposure_ms=1000.0) for one in TARGETS["other kV"])
    transfer = PairTransfer(twin, low=targets[0], high=targets[1])
    logs = reference_pair(twin, slab(), np.random.default_rng(10))
    with pytest.raises(InputError, match=r"noise, carried over, is [\d.]+ times .* at most 0\.\d+ times this exposure"):
        transfer.transfer(logs, REFERENCE)


def test_another_magnification_is_refused(twin):
    targets = tuple(replace(one, source_detector_mm=2000.0) for one in TARGETS["other kV"])
    transfer = PairTransfer(twin, low=targets[0], high=targets[1])
    there = tuple(replace(one, source_detector_mm=1059.0) for one in REFERENCE)
    with pytest.raises(InputError, match="another distance is another magnification"):
        transfer.transfer(np.zeros((2, *SHAPE)), there)


def test_an_unknown_tube_load_is_refused(twin):
    transfer = PairTransfer(twin, low=TARGETS["other kV"][0], high=TARGETS["other kV"][1])
    bare = tuple(replace(one, power_W=None) for one in REFERENCE)
    with pytest.raises(InputError, match="expected a tube load"):
        transfer.transfer(np.zeros((2, *SHAPE)), bare)


def test_a_twin_without_spectral_part_knows_no_other_kV(twin):
    with pytest.raises(InputError, match="no spectral part"):
        PairTransfer(replace(twin, spectral=None), low=TARGETS["other kV"][0], high=TARGETS["other kV"][1])


def test_the_nearest_covariance_is_the_matrix_itself_where_it_is_one():
    rng = np.random.default_rng(11)
    root = rng.standard_normal((2, 2, 50))
    fine = np.einsum("ikp,jkp->ijp", root, root)
    np.testing.assert_allclose(nearest_covariance(fine), fine, atol=1e-12)
    any_sign = fine - np.eye(2)[:, :, None]
    kept = nearest_covariance(any_sign)
    for p in range(50):
        values, vectors = np.linalg.eigh(any_sign[:, :, p])
        np.testing.assert_allclose(kept[:, :, p], (vectors * np.maximum(values, 0)) @ vectors.T, atol=1e-12)
    np.testing.assert_array_equal(nearest_covariance(np.zeros((2, 2, 3))), 0)


def reference_file(path, twin, *, images=3, settings=REFERENCE):
    rng = np.random.default_rng(12)
    mask = np.zeros(SHAPE, dtype=bool)
    mask[10:14, 10:16] = True
    with write_dataset(path, shape=SHAPE) as writer:
        for number in range(images):
            thickness_mm = slab(14.0 + number, 0.0)
            thickness_mm[1][mask] = 1.5
            writer.append(
                image=reference_pair(twin, thickness_mm, rng).astype(np.float32),
                foreign_object_mask=mask,
                product_mask=np.ones(SHAPE, dtype=bool),
                row=DatasetRow(
                    image=f"ref{number}",
                    product=f"p{number}",
                    foreign_object="bone",
                    size_mm=2.0,
                    contrast=0.03,
                    split="train",
                    setting=";".join(map(str, settings)),
                ),
            )
    return path


def generate(twin, path, out, *, targets=TARGETS["other kV"], **options):
    with read_dataset(path) as reference:
        return generate_dataset(
            twin, reference, out, **{"low": targets[0], "high": targets[1], "images": 4, "seed": 3, **options}
        )


def test_a_dataset_at_another_kV_carries_masks_rows_and_provenance_and_repeats_byte_for_byte(tmp_path, twin):
    path = reference_file(tmp_path / "r.h5", twin)
    first = generate(twin, path, tmp_path / "a.h5")
    again = generate(twin, path, tmp_path / "b.h5")
    assert first.transferred
    assert len(first.warnings) == 1
    assert "kv=120" in first.warnings[0]
    assert "outside the calibrated kV" in first.warnings[0]
    with read_dataset(tmp_path / "a.h5") as made, read_dataset(tmp_path / "b.h5") as same, read_dataset(path) as source:
        np.testing.assert_array_equal(made.counts(slice(None)), same.counts(slice(None)))
        assert made.attributes["foreign_material"] == "rib_bone"
        assert "kv=120" in made.attributes["setting_high"]
        assert again.dataset_sha256 == first.dataset_sha256
        names = {row.image: number for number, row in enumerate(source.rows)}
        for number, row in enumerate(made.rows):
            origin = names[row.image.split("-")[0]]
            assert (row.product, row.contrast, row.size_mm) == (source.rows[origin].product, 0.03, 2.0)
            np.testing.assert_array_equal(made.foreign_object_masks(number), source.foreign_object_masks(origin))
        assert not np.array_equal(made.images(0), made.images(3))  # the same reference, another noise


def test_the_published_recipe_knows_no_other_kV(tmp_path, twin):
    path = reference_file(tmp_path / "r.h5", twin)
    with pytest.raises(InputError, match="published recipe knows no other"):
        generate(twin, path, tmp_path / "a.h5", recipe="as_published")
    assert not (tmp_path / "a.h5").exists()


def with_bad_pixels(twin):
    bad = np.zeros(SHAPE, dtype=np.uint8)
    bad[5, 6], bad[20, 9] = 1, 2
    dark = twin.maps.dark_DN.copy()
    dark[20, 9] = 5000.0
    variance = twin.maps.read_variance_DN2.copy()
    variance[20, 9] *= 100.0
    shape = np.ones(SHAPE, dtype=np.float32)
    shape[5, 6] = -0.001  # as noise leaves it
    levels = tuple(replace(level, flat_shape=shape) for level in twin.levels)
    maps = replace(twin.maps, bad_pixels=bad, dark_DN=dark, read_variance_DN2=variance)
    return replace(twin, maps=maps, levels=levels)


@pytest.mark.parametrize(
    "targets", [TARGETS["other kV"], tuple(replace(one, exposure_ms=20.0, averaged=1) for one in REFERENCE)]
)
def test_bad_pixels_are_in_the_counts_and_repaired_in_the_log_images(tmp_path, twin, targets):
    spoiled = with_bad_pixels(twin)
    path = reference_file(tmp_path / "r.h5", twin)
    generate(spoiled, path, tmp_path / "a.h5", targets=targets, bad_pixels="measured")
    generate(spoiled, path, tmp_path / "b.h5", targets=targets)
    with read_dataset(tmp_path / "a.h5") as measured, read_dataset(tmp_path / "b.h5") as repaired:
        counts, clean = measured.counts(slice(None)), repaired.counts(slice(None))
        assert np.all(np.abs(counts[:, :, 5, 6] - 1200.0) < 8 * 12.1 + 2)  # a dead pixel gives its dark
        assert np.all(counts[:, :, 20, 9] > 4000)
        assert np.all(clean[:, :, 5, 6] > 1250)
        assert np.all(counts[:, :, 20, 9] - clean[:, :, 20, 9] > 2000)
        images = measured.images(slice(None))
        around = np.median(images[:, :, [4, 6, 5, 5], [6, 6, 5, 7]], axis=2)
        np.testing.assert_allclose(images[:, :, 5, 6], around, rtol=1e-5)


def test_a_stated_misregistration_is_taken_off(tmp_path, twin):
    from raytwin.generator.spread.registration import shift_image

    path = reference_file(tmp_path / "r.h5", twin, images=1)
    shifted = tmp_path / "s.h5"
    with read_dataset(path) as source, write_dataset(shifted, shape=SHAPE) as writer:
        image = source.images(0)
        writer.append(
            image=np.stack([image[0], shift_image(image[1], (1.0, -2.0))]).astype(np.float32),
            foreign_object_mask=source.foreign_object_masks(0),
            product_mask=source.product_masks(0),
            row=source.rows[0],
        )
    generate(twin, shifted, tmp_path / "b.h5", images=1, registration_px=(1.0, -2.0))
    with read_dataset(path) as source, read_dataset(tmp_path / "b.h5") as registered, read_dataset(shifted) as moved:
        inner = (slice(None), slice(4, -4), slice(4, -4))
        expected, found = source.images(0)[inner], pair_moved(moved.images(0))[inner]
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert registered.attributes["registration_px"] == "(1.0, -2.0)"


def pair_moved(images):
    from raytwin.generator.spread.registration import shift_image

    return np.stack([images[0], shift_image(images[1], (-1.0, 2.0))])


def test_the_flat_at_an_unmeasured_kV_has_the_shape_of_the_nearest_one(twin):
    shape = np.linspace(0.9, 1.1, SHAPE[1], dtype=np.float32) * np.ones(SHAPE, dtype=np.float32)
    leaning = replace(twin, levels=(twin.levels[0], replace(twin.levels[1], flat_shape=shape)))
    model = ChannelModel(leaning, TARGETS["other kV"][1], "chicken_breast")
    np.testing.assert_allclose(model.open_signal_DN / np.median(model.open_signal_DN), shape, rtol=1e-6)


@pytest.fixture(scope="module")
def transfers(twin):
    return {name: PairTransfer(twin, low=low, high=high) for name, (low, high) in TARGETS.items()}


@pytest.mark.slow
@hypothesis_settings(max_examples=12)
@example(seed=0, low=11.0, high=9.0, scatter=0.5, name="other kV")
@given(
    seed=st.integers(0, 1000),
    low=st.floats(-2.0, 3.0),
    high=st.floats(-2.0, 3.0),
    scatter=st.floats(0.0, 1.0),
    name=st.sampled_from(sorted(TARGETS)),
)
def test_whatever_the_reference_holds_counts_are_finite_or_the_reason_is_said(
    transfers, seed, low, high, scatter, name
):
    rng = np.random.default_rng(seed)
    logs = np.array([low, high])[:, None, None] + scatter * rng.standard_normal((2, *SHAPE))
    transfer = transfers[name]
    try:
        pair, _ = transfer.transfer(logs, REFERENCE)
    except InputError as error:
        assert "too noisy" in str(error)
        return
    counts = transfer.draw(pair, rng)
    assert np.isfinite(counts).all()
    assert counts.min() >= 0
    assert counts.max() <= 65535
