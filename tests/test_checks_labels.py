"""Labels that the frames contradict are found and said; effects at the ends of their ranges are not taken for wrong labels."""

import shutil
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.series_roles import calibrating_names
from raytwin.checks.beam_checks import lit_darks, undeclared_means
from raytwin.checks.labels import check_labels
from raytwin.checks.map_checks import _inherent_mm_Al, _scaled
from raytwin.checks.readings import Explained, _without_common, reading_of
from raytwin.cli import main

SIZE = ["--size", "48", "--frames", "10"]
FLAT_40, FLAT_90 = "flat_40kV_25ms_Cu0.05", "flat_90kV_25ms_Cu0.05"


def found_in(path):
    with open_acquisition(path) as acquisition:
        return check_labels(acquisition, calibrating=calibrating_names(acquisition.series))


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("plausibility") / "session.h5"
    assert (
        main(
            [
                "lab",
                "--family",
                "none",
                "-o",
                str(path),
                "--protocol",
                "short",
                "--seed",
                "31",
                "--products",
                "3",
                *SIZE,
            ]
        )
        == 0
    )
    return path


@pytest.fixture
def changed(session, tmp_path):
    """A copy of the session after a change of its file."""

    def make(change):
        path = tmp_path / "changed.h5"
        shutil.copy(session, path)
        with h5py.File(path, "r+") as file:
            change(file)
        return path

    return make


def exchange(first, second, *attributes):
    def change(file):
        one, other = file["series"][first], file["series"][second]
        for name in attributes:
            one.attrs[name], other.attrs[name] = other.attrs[name], one.attrs[name]
        if not attributes:
            frames = one["frames"][:], other["frames"][:]
            for node, values in zip((other, one), frames, strict=True):
                node["frames"][:] = values

    return change


def label(name, **attributes):
    return lambda file: file["series"][name].attrs.update(attributes)


def read_at(gain, name):
    """Frames as electronics of another gain give them: the converter's pedestal stays."""

    def change(file):
        pedestal = file["series"]["dark_25ms"]["frames"][:].mean(axis=0)
        frames = file["series"][name]["frames"]
        frames[:] = np.clip(np.round(pedestal + gain * (frames[:] - pedestal)), 0, 65535).astype(frames.dtype)

    return change


def exchange_everywhere(*kinds):
    def change(file):
        for node in file["series"].values():
            if node.attrs["kind"] in kinds:
                node.attrs["kV"] = 130.0 - node.attrs["kV"]

    return change


def maps(scene, change):
    def apply(file):
        group = file["scenes"][scene]["thickness_mm"]
        for material in group:
            group[material][...] = change(group[material][:])

    return apply


def of_material(file, name="unobtanium"):
    group = file["scenes"]["product1"]["thickness_mm"]
    group.move(next(iter(group)), name)


def exchange_maps(file):
    file.move("scenes/product1/thickness_mm", "kept")
    file.move("scenes/product2/thickness_mm", "scenes/product1/thickness_mm")
    file.move("kept", "scenes/product2/thickness_mm")


def test_right_labels_raise_no_doubt(session):
    found = found_in(session)
    assert found.findings == ()
    assert found.unusable == {}


@pytest.mark.parametrize(
    ("bits", "excess_DN", "found"), [(8, 60, 1), (8, 10, 0), (10, 60, 1), (14, 60, 0), (None, 60, 0)]
)
def test_a_lit_dark_lies_above_the_others_by_a_share_of_a_small_range_and_by_more_than_a_large_one_drifts(
    bits, excess_DN, found
):
    def reading(name, kind, level_DN, index):
        return SimpleNamespace(
            name=name,
            mean_DN=np.full((4, 4), level_DN),
            series=SimpleNamespace(kind=kind, index=index, exposure_ms=25.0),
        )

    darks = [reading(f"dark{number}", "dark", 20.0, number) for number in range(3)]
    darks.append(reading("lit", "dark", 20.0 + excess_DN, 3))
    flats = [reading("flat", "flat", 150.0, 4)]
    told = lit_darks(darks, flats, np.ones((4, 4), bool), bits=bits)
    assert [one.series for one in told] == ["lit"] * found


@pytest.mark.parametrize(
    ("levels_DN", "found"),
    [
        ({50: (100, 101), 200: (400, 402), 1000: (2000, 2010)}, set()),  # a dark current of 2 DN a ms
        ({50: (100,), 200: (400,), 1000: (2000,)}, set()),  # one dark an exposure
        ({50: (100,), 1000: (2000,)}, set()),  # it may be any
        ({50: (2000,), 1000: (100,)}, {"50_0"}),  # it never falls
        ({50: (100, 1500), 200: (400, 402)}, {"50_1"}),
        ({50: (100,), 200: (400,), 1000: (6000,)}, {"1000_0"}),
    ],
)
def test_a_dark_current_is_no_beam(levels_DN, found):
    def reading(name, kind, level_DN, exposure_ms):
        series = SimpleNamespace(kind=kind, index=0, exposure_ms=exposure_ms)
        return SimpleNamespace(name=name, mean_DN=np.full((4, 4), level_DN), series=series)

    darks = [
        reading(f"{ms}_{number}", "dark", float(level), float(ms))
        for ms, levels in levels_DN.items()
        for number, level in enumerate(levels)
    ]
    told = lit_darks(darks, [reading("flat", "flat", 3000.0, 50.0)], np.ones((4, 4), bool), bits=16)
    assert {item.series for item in told} <= found
    assert bool(told) == bool(found)


@pytest.mark.parametrize(
    ("constant", "quanta", "flicker", "means", "found"),
    [
        (0.0, 2.0, 0.0, {1: 10}, {1: 10}),
        (0.0, 2.0, 0.0, {3: 4}, {3: 4}),
        (0.0, 2.0, 0.0, {}, {}),
        (0.0, 2.0, 3e-3, {}, {}),  # dim flats are quieter by right
        (5000.0, 2.0, 0.0, {}, {}),  # and bright ones where rounding adds noise
        (0.0, 2.0, 1e-3, {2: 8}, {2: 8}),
    ],
)
def test_a_mean_of_frames_is_told_by_its_noise_whatever_the_noise_grows_with(constant, quanta, flicker, means, found):
    rng = np.random.default_rng(3)
    judged = []
    for number, level in enumerate((1000.0, 2000.0, 2000.0, 8000.0)):
        variance = (100.0 + constant + quanta * level + (flicker * level) ** 2 * 1e3) / means.get(number, 1)
        judged.append(
            SimpleNamespace(
                name=str(number),
                series=SimpleNamespace(kind="flat", averaged=1),
                label=SimpleNamespace(beam="one"),
                since=False,
                level_DN=level,
                gain_sd=0.01,
                variance_DN2=variance * (1.0 + 0.02 * rng.standard_normal((8, 8))),
            )
        )
    told = undeclared_means(judged, 100.0, np.ones((8, 8), bool))
    assert {int(item.series): pytest.approx(item.values["count"], rel=0.2) for item in told} == found


@pytest.mark.slow
@pytest.mark.parametrize(
    "effects",
    [
        ["kv_error=5@calibration", "nonlinearity=5@always"],
        ["excess_noise=100@calibration", "filtration_error=1@calibration", "heel=20@calibration"],
        ["object_scatter=45", "output_drift=3", "dark_drift=100"],
    ],
)
def test_effects_at_the_end_of_their_range_are_not_taken_for_wrong_labels(tmp_path, effects):
    path = tmp_path / "session.h5"
    planted = [word for effect in effects for word in ("--effect", effect)]
    words = [
        "lab",
        "--family",
        "none",
        "-o",
        str(path),
        "--protocol",
        "short",
        "--seed",
        "44",
        "--products",
        "2",
        *SIZE,
        *planted,
    ]
    assert main(words) == 0
    assert found_in(path).findings == ()


@pytest.mark.parametrize(
    ("change", "series", "words"),
    [
        (exchange(FLAT_40, FLAT_90, "kV"), {FLAT_40, FLAT_90}, "its tube voltage ("),
        (exchange(f"{FLAT_40}_2", f"{FLAT_90}_2"), {f"{FLAT_40}_2", f"{FLAT_90}_2"}, "its setting ("),
        (
            exchange("product1_40kV_100ms", "product1_90kV_100ms", "kV"),
            {"product1_40kV_100ms", "product1_90kV_100ms"},
            "its tube voltage (",
        ),
        (exchange_everywhere("object"), None, "exchanged in all objects"),
        (label(f"{FLAT_40}_2", filter="Cu:0.2"), {f"{FLAT_40}_2"}, "looks like Cu:0.05 or 100 ms (labelled Cu:0.2)"),
        (label(f"{FLAT_40}_2", exposure_ms=100.0), {f"{FLAT_40}_2"}, "looks like 25 ms (labelled 100 ms)"),
        (read_at(0.5, f"{FLAT_90}_2"), {f"{FLAT_90}_2"}, "read at half the electronic gain of the other series"),
        (read_at(2.0, f"{FLAT_40}_2"), {f"{FLAT_40}_2"}, "read at twice the electronic gain of the other series"),
        (
            label("dark_25ms_2", kind="flat", kV=40.0, power_W=82.0, filter="Cu:0.05"),
            {"dark_25ms_2"},
            "a flat that shows no beam",
        ),
        (label(f"{FLAT_40}_2", kind="dark"), {f"{FLAT_40}_2"}, "the beam was on, or it is a flat"),
        (maps("product1", lambda image: image[::-1]), None, "mirrored top to bottom would"),
        (maps("product1", lambda image: 1.3 * image), None, "fit its frames only if all path lengths are 0.7"),
        (maps("product1", lambda image: 0 * image), None, "are empty, but its frames show a shadow"),
        (exchange_maps, None, "the maps of product2 would"),
        (
            maps("product1", lambda image: np.where(image > image.mean(), np.nan, image)),
            None,
            "has a negative or non-finite",
        ),
        (of_material, None, "of 'unobtanium', which is no material of the library"),
    ],
)
def test_wrong_label_is_found_and_named(changed, change, series, words):
    found = found_in(changed(change)).findings
    assert len(found) in (1, 2)
    assert any(words in item.text for item in found), [item.text for item in found]
    if series is not None:
        assert set(found[0].names) == series


def test_series_without_light_or_saturated_is_not_usable_and_does_not_cast_doubt_on_others(changed):
    def change(file):
        file["series"][FLAT_40]["frames"][...] = 0
        frames = file["series"][f"{FLAT_90}_2"]["frames"]
        frames[...] = np.minimum(frames[:].astype(np.int64) * 15 // 2, 65535).astype(np.uint16)

    found = found_in(changed(change))
    assert found.findings == ()
    assert found.unusable[FLAT_40] == "every pixel of every frame is 0 DN"
    assert found.unusable[f"{FLAT_90}_2"].startswith("saturated: ")


def test_weak_flat_of_a_short_exposure_is_no_dark(changed):
    def change(file):
        node = file["series"][f"{FLAT_40}_2"]
        dark = file["series"]["dark_25ms"]["frames"][:].mean()
        weak = dark + (node["frames"][:] - dark) / 100.0
        node["frames"][...] = np.rint(weak).astype(np.uint16)
        node.attrs["exposure_ms"] = 0.25

    assert not any("shows no beam" in item.text for item in found_in(changed(change)).findings)


@pytest.mark.parametrize("quanta", [True, False])
def test_little_light_with_the_noise_of_quanta_is_a_beam(changed, quanta):
    rng = np.random.default_rng(8)

    def change(file):
        node, dark = file["series"][f"{FLAT_40}_2"], file["series"]["dark_25ms"]["frames"][:].astype(float)
        frames = node["frames"][:].astype(float)
        noise_DN = [np.std(np.diff(one, axis=0)) / np.sqrt(2.0) for one in (frames, dark)]
        signal_DN = frames.mean() - dark.mean()
        each_DN = (noise_DN[0] ** 2 - noise_DN[1] ** 2) / signal_DN
        # as behind a filter that lets 0.5 % through
        light = rng.poisson(0.005 * signal_DN / each_DN, frames.shape) * each_DN if quanta else 0.005 * signal_DN
        left = dark.mean(axis=0) + noise_DN[1] * rng.standard_normal(frames.shape) + light
        node["frames"][...] = np.rint(left).astype(np.uint16)

    said = [item.text for item in found_in(changed(change)).findings]
    assert any("shows no beam" in text for text in said) == (not quanta)


@pytest.mark.parametrize(("thickness", "shows"), [(0.4, True), (0.0, False)])
def test_shadow_of_a_thin_object_in_single_frames_is_one(changed, thickness, shows):
    # the noise of single frames says nothing of photons
    def change(file):
        for image in file["scenes/product1/thickness_mm"].values():
            image[...] = 0.4 * image[:]
        dark = file["series"]["dark_25ms"]["frames"][:].mean()
        for name in [name for name, node in file["series"].items() if node.attrs.get("scene") == "product1"]:
            node = file["series"][name]
            signal = node["frames"][:1] - dark
            opened = np.quantile(signal, 0.97)
            shadow = np.clip(signal / opened, 1e-3, 1.0) ** thickness
            noise = 0.3 * np.sqrt(opened) * np.random.default_rng(5).standard_normal(signal.shape)
            for one in {"frames", "time_s"} & set(node):
                del node[one]
            node["frames"] = np.rint(dark + opened * shadow + noise).astype(np.uint16)

    said = [item.text for item in found_in(changed(change)).findings]
    assert any("show no shadow" in text for text in said) == (not shows)


def test_output_of_the_tube_is_no_noise_of_an_object_that_covers_half_the_field():
    rng = np.random.default_rng(4)
    picture = np.full((60, 80), 30000.0)
    picture[:, :43] = 100.0
    noise = np.sqrt(0.7 * picture) * rng.standard_normal((7, *picture.shape))
    drifting = noise + 0.01 * rng.standard_normal((7, 1, 1)) * picture + rng.normal(0.0, 20.0, (7, 1, 1))
    drifting[:, 5, 5] = 1e6 * rng.standard_normal(7)  # a pixel that is none
    left = _without_common(drifting, picture)
    for part in (np.s_[:, :43], np.s_[:, 43:]):
        values = np.delete(left[:, *part].reshape(7, -1), 5 * left[:, *part].shape[2] + 5, axis=1)
        wanted = float(np.mean(0.7 * picture[part]))
        assert np.mean(values**2) == pytest.approx(wanted, rel=4.0 * np.sqrt(2.0 / values.size) + 2.0 / 4800)


def test_what_an_explanation_does_to_frames_makes_no_label_look_wrong(changed):
    passed = np.ones((48, 48))
    passed[:, 24:] = 0.3

    def change(file):
        # a plate before half of the panel in the last flat, and two objects whose labels are exchanged
        flat, dark = (file["series"][name]["frames"] for name in (FLAT_90 + "_2", "dark_25ms"))
        dark_DN = dark[:].mean(axis=0)
        flat[:] = np.rint(dark_DN + passed * (flat[:] - dark_DN)).astype(np.uint16)
        exchange("product1_40kV_25ms", "product1_90kV_25ms", "kV")(file)

    path = changed(change)
    with open_acquisition(path) as acquisition:
        names = calibrating_names(acquisition.series)
        open_DN = next(item for item in acquisition.series if item.name == FLAT_90).read_frames(0, 8).mean(axis=0)
        dark_DN = next(item for item in acquisition.series if item.name == "dark_25ms").read_frames(0, 8).mean(axis=0)
        plate = Explained(mean_DN=(passed - 1.0) * (open_DN - dark_DN), variance=passed**2)
        before = check_labels(acquisition, calibrating=names).findings
        after = check_labels(acquisition, calibrating=names, explained={FLAT_90 + "_2": plate}).findings
    blamed = [{name for item in found for name in item.names} for found in (before, after)]
    assert FLAT_90 + "_2" in blamed[0] and "stood in the beam" in " ".join(item.text for item in before)
    assert blamed[1] == {"product1_40kV_25ms", "product1_90kV_25ms"}


def factors_of(*, harder=None, **wanted):
    """Suspects among scenes of two series each, 40 and 90 kV, at a distance (mm) with a factor on their path lengths.

    harder: the factors with another inherent filtration that may be.
    """
    placements = {
        scene: [
            SimpleNamespace(
                name=f"{scene}_{kV:g}kV",
                label=SimpleNamespace(kV=kV),
                series=SimpleNamespace(source_object_mm=distance),
            )
            for kV in (40.0, 90.0)
        ]
        for scene, (distance, _) in wanted.items()
    }
    scales = {scene: [4 * [float(np.log(factor))]] for scene, (_, factor) in wanted.items()}
    for scene, factor in (harder or {}).items():
        scales[scene].append(4 * [float(np.log(factor))])
    found = _scaled(scales, placements)
    return [name for item in found for name in item.names]


def test_inherent_filtration_is_what_flats_behind_two_filters_have():
    def flat(name, kV, filters, level_DN):
        label = SimpleNamespace(kV=kV, filters=filters, load=("current_mA", 1.0))
        return SimpleNamespace(name=name, label=label, level_DN=level_DN)

    # copper takes less of a beam that aluminium has hardened
    def log_level(label, inherent_mm_Al):
        return -0.2 * inherent_mm_Al - (2.0 - 0.4 * inherent_mm_Al if label.filters else 0.0)

    maps = SimpleNamespace(log_level=log_level, weights=lambda label: 1)
    bare, behind = flat("bare", 40.0, (), 100.0), flat("behind", 40.0, ("Cu:0.1",), 100.0 * np.exp(-2.0 + 0.4 * 2.25))
    assert _inherent_mm_Al([bare, behind], maps) == (2.25,)
    # two of three pairs agree: the third flat was behind another filter than is said
    mislabelled = flat("mislabelled", 60.0, ("Cu:0.1",), 90.0)
    beside = [flat("bare_60", 60.0, (), 100.0), flat("behind_60", 60.0, ("Cu:0.1",), 100.0 * np.exp(-2.0 + 0.4 * 2.25))]
    assert _inherent_mm_Al([bare, behind, *beside, mislabelled], maps) == (2.25,)
    # nothing to tell it by: what is usual, and what may be
    alone = _inherent_mm_Al([bare, flat("other", 60.0, ("Cu:0.1",), 10.0)], maps)
    assert alone[0] == 1.0
    assert (min(alone), max(alone)) == (0.0, 4.0)  # two prior standard deviations


def test_paths_that_a_harder_beam_would_make_right_are_no_fault_of_the_maps():
    scene = {"wedge_a": (700.0, 0.76)}
    assert len(factors_of(**scene)) == 2
    assert factors_of(harder={"wedge_a": 1.1}, **scene) == []
    assert len(factors_of(harder={"wedge_a": 0.78}, **scene)) == 2
    # another scene fits as it is
    both = {**scene, "wedge_b": (500.0, 1.0)}
    assert factors_of(harder={"wedge_a": 1.1, "wedge_b": 1.4}, **both) == ["wedge_a_40kV", "wedge_a_90kV"]


def test_what_all_scenes_at_one_gap_want_is_no_fault_of_their_maps():
    near, far = {"wedge_a": (700.0, 0.76), "wedge_b": (700.0, 0.77)}, {"wedge_c": (500.0, 0.95)}
    assert factors_of(**near, **far) == []
    # one map alone, maps that are wrong at either gap, and maps of one gap with nothing to compare them with
    assert factors_of(wedge_a=(700.0, 0.76), wedge_b=(700.0, 1.0), **far) == ["wedge_a_40kV", "wedge_a_90kV"]
    assert len(factors_of(**near, wedge_c=(500.0, 0.75))) == 6
    assert len(factors_of(**near)) == 4
    assert len(factors_of(wedge_a=(700.0, 1.4), wedge_b=(700.0, 1.0), **far)) == 2


OF_60_KV = SimpleNamespace(
    kind="flat",
    averaged=1,
    kV=60.0,
    filters=(),
    power_W=20.0,
    current_mA=None,
    exposure_ms=20.0,
    source_detector_mm=None,
)
ANYWHERE = SimpleNamespace(instrument=SimpleNamespace(source_detector_mm=1000.0))


@pytest.mark.parametrize("axis", [1, 2])
def test_what_lines_share_is_no_noise_that_labels_are_judged_by(axis):
    """Half of a field lies behind something; lines flicker by as much as their pixels' noise, with the light."""
    rng = np.random.default_rng(7)
    picture = np.where(np.arange(64) < 32, 10_000.0, 6000.0) * np.ones((64, 1))
    shape = [12, 64, 64]
    shape[3 - axis] = 1
    noise = np.sqrt(picture) * rng.standard_normal((12, 64, 64))
    flickering = picture * (1.0 + 0.01 * rng.standard_normal(shape)) + noise
    found = reading_of(OF_60_KV, flickering, ANYWHERE, since=False).variance_DN2
    steady = reading_of(OF_60_KV, picture + noise, ANYWHERE, since=False).variance_DN2
    assert float(found.mean()) == pytest.approx(float(steady.mean()), rel=0.06)
    assert float(steady.mean()) == pytest.approx(8000.0, rel=0.03)


@pytest.mark.parametrize("shape", [(12, 1, 64), (12, 64, 1), (12, 64, 64)])
def test_lines_of_one_pixel_and_frames_without_light_have_noise_as_well(shape):
    noise = 3.0 * np.random.default_rng(8).standard_normal(shape)
    drawn, none = (
        reading_of(OF_60_KV, frames, ANYWHERE, since=False).variance_DN2 for frames in (1000.0 + noise, np.zeros(shape))
    )
    assert float(drawn.mean()) == pytest.approx(9.0, rel=0.4)
    np.testing.assert_array_equal(none, np.zeros(shape[1:]))


def test_copies_of_frames_leave_the_noise_that_labels_are_judged_by():
    rng = np.random.default_rng(6)
    drawn = 1000.0 + 5.0 * rng.standard_normal((8, 64, 64))
    acquisition, series = ANYWHERE, OF_60_KV
    plain = reading_of(series, drawn[:4], acquisition, since=False)
    copied = reading_of(series, drawn[[0, 1, 1, 2, 2, 2, 3, 3]], acquisition, since=False)
    assert (plain.frames, copied.frames) == (4, 4)
    np.testing.assert_array_equal(copied.variance_DN2, plain.variance_DN2)
    np.testing.assert_array_equal(copied.mean_DN, plain.mean_DN)
    assert float(plain.variance_DN2.mean()) == pytest.approx(25.0, rel=0.1)


@pytest.mark.parametrize("cut", [(FLAT_40, FLAT_90), (FLAT_90,)])
def test_numbers_of_two_beams_that_stop_below_those_of_other_series_are_told(changed, cut):
    """A converter ends at one number in all series. Numbers of one beam alone may pile up at a coarse code."""

    def change(file):
        nodes = [file["series"][name] for name in cut]
        top = int(min(np.median(node["frames"][...]) for node in nodes))
        for node in nodes:
            node["frames"][...] = np.minimum(node["frames"][...], top)

    found = found_in(changed(change))
    assert set(cut) <= set(found.unusable)
    assert len(found.stops) == (len(cut) == 2)
    for item in found.stops:
        assert set(item.names) == set(cut)
        assert "stop at " in item.text


def test_a_converter_that_ends_at_one_number_in_all_series_is_only_saturated(changed):
    def change(file):
        lit = [node for node in file["series"].values() if node.attrs["kind"] != "dark"]
        top = int(0.8 * max(np.median(node["frames"][...]) for node in lit))
        for node in lit:
            node["frames"][...] = np.minimum(node["frames"][...], top)

    found = found_in(changed(change))
    assert any("saturated" in reason for reason in found.unusable.values())
    assert found.stops == ()
