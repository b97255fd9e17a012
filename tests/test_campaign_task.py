"""The gap followed to detection: pictures of known products, what is tried on what, answers that the data support or not."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from raytwin.acquisition import open_acquisition, read_dataset
from raytwin.acquisition.pairs import PairCorrector, object_pairs
from raytwin.campaign import object_material, task_images
from raytwin.campaign import task as task_module
from raytwin.campaign.task import check_task, run_task
from raytwin.campaign.task_page import pod_charts, task_text
from raytwin.campaign.task_plan import TaskInput, TaskPlan
from raytwin.campaign.trial import scene_of
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.generator.datasets.known_scenes import KnownScenes
from raytwin.generator.effects import AppliedEffect
from raytwin.generator.twins.twin_io import read_twin

LINE = ["--seed", "31", "--size", "64"]


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """A calibrated twin, and products of known path lengths measured on another day of the same line."""
    folder = tmp_path_factory.mktemp("task")
    short = [
        "lab",
        "--family",
        "none",
        "-o",
        str(folder / "short.h5"),
        "--protocol",
        "short",
        *LINE,
        "--frames",
        "12",
        "--products",
        "1",
    ]
    assert main(short) == 0
    assert main(["calibrate", str(folder / "short.h5"), "-o", str(folder / "twin.h5")]) == 0
    products = [
        "lab",
        "--family",
        "none",
        "-o",
        str(folder / "products.h5"),
        "--protocol",
        "products",
        *LINE,
        "--session",
        "1",
    ]
    assert main([*products, "--products", "16", "--frames", "20", "--bones-mm", "0.7,1.4,2.8"]) == 0
    return folder


@pytest.fixture(scope="module")
def twin(line):
    return read_twin(line / "twin.h5")


def with_effect(twin, name, strength, since="always"):
    return dataclasses.replace(twin, effects=(AppliedEffect(id=name, parameters={"strength": strength}, since=since),))


def settings(line):
    with open_acquisition(line / "products.h5") as acquisition:
        chosen = {item.kV: item.setting for item in acquisition.of_kind("object") if item.exposure_ms == 25.0}
    return chosen[40.0], chosen[90.0]


def pictures(line, twin):
    low, high = settings(line)
    return KnownScenes(twin, low=low, high=high, product_material="chicken_breast")


@pytest.mark.slow
def test_nothing_in_the_beam_gives_log_images_of_zero(line, twin):
    images = pictures(line, twin).expected({"chicken_breast": np.zeros(twin.maps.shape)})
    for image in images:
        np.testing.assert_allclose(image.log_image, 0.0, atol=1e-9)


def test_thicker_products_attenuate_more_and_the_high_voltage_less(line, twin):
    known = pictures(line, twin)
    depth = [
        [image.log_image.mean() for image in known.expected({"chicken_breast": np.full(twin.maps.shape, mm)})]
        for mm in (5.0, 10.0, 20.0)
    ]
    assert np.all(np.diff(depth, axis=0) > 0)
    assert np.all(np.diff(depth, axis=1) < 0)
    # beams harden: twice the thickness attenuates less than twice as much
    assert depth[2][0] < 2.0 * depth[1][0] < 4.0 * depth[0][0]


def test_measured_products_have_the_level_and_noise_of_their_pictures(line, twin):
    known = pictures(line, twin)
    rng = np.random.default_rng(1)
    departures, measured, simulated = [], [], []
    with open_acquisition(line / "products.h5") as acquisition:
        corrector = PairCorrector(acquisition)
        pairs = [pair for pair in object_pairs(acquisition) if pair.low.exposure_ms == 25.0][:8]
        for pair in pairs:
            scene = acquisition.scenes[pair.scene]
            expected = known.expected(dict(scene.thickness_mm))
            inside = scene.product_mask
            frames = [corrector.image(item, item.read_frames(0, 2)) for item in (pair.low, pair.high)]
            drawn = [known.draw(expected, rng) for _ in range(2)]
            for channel, image in enumerate(expected):
                mean = frames[channel].mean(axis=0)[inside]
                departures.append(mean.mean() / image.log_image[inside].mean() - 1.0)
                measured.append(np.var(frames[channel][0][inside] - frames[channel][1][inside]))
                simulated.append(np.var(drawn[0][channel][inside] - drawn[1][channel][inside]))
    # thicknesses are stated within 0.7 % (one standard deviation), attenuation tables differ by 1-2 %
    assert abs(np.mean(departures)) < 0.03
    # 8 x 2 fields of some 600 pixels, nine of which are worth one: 3.5 % is one standard deviation of the ratio
    assert np.sqrt(np.mean(simulated) / np.mean(measured)) == pytest.approx(1.0, abs=0.1)


def test_scatter_brightens_what_lies_behind_a_product(line, twin):
    thickness = {"chicken_breast": np.full(twin.maps.shape, 20.0)}
    before = pictures(line, twin).expected(thickness)
    after = pictures(line, with_effect(twin, "object_scatter", 10.0)).expected(thickness)
    for one, other in zip(before, after, strict=True):
        lower = (one.log_image - other.log_image).mean()
        assert 0.02 < lower < 0.2  # 10 % of scatter over primary is ln(1.1) in the middle of a full field


def test_effects_that_images_do_not_hold_change_no_pixel_and_are_named(line, twin):
    thickness = {"chicken_breast": np.full(twin.maps.shape, 10.0)}
    plain, lagging = pictures(line, twin), pictures(line, with_effect(twin, "image_lag", 1.0))
    draws = [one.draw(one.expected(thickness), np.random.default_rng(3)) for one in (plain, lagging)]
    np.testing.assert_array_equal(*draws)
    assert any("image_lag" in line for line in lagging.warnings)


def test_maps_of_another_detector_are_refused(line, twin):
    with pytest.raises(InputError, match="as the twin's detector"):
        pictures(line, twin).expected({"chicken_breast": np.ones((5, 5))})


# ---------------------------------------------------------------------------------------------------- the trial


@pytest.fixture
def stand_in(monkeypatch):
    """Networks that see an object when it is longer than what their images allow; a fifth of their looks go wrong."""
    limits = {"before": 0.6, "after": 1.2, "library": 0.9, "measured": 1.0}
    trained = []

    def train(directory, arms, measured, plan, *, device, tell):
        trained.append(list(arms))
        return {arm: directory / f"networks_{arm}" for arm in arms}

    def detect(runs, dataset_path, out, contrast, thresholds, *, device):
        arm = runs.name.removeprefix("networks_")
        rng = np.random.default_rng(7)
        with read_dataset(dataset_path) as dataset, open(out, "w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(["contrast", "size_mm", "hit", "network", "image", "foreign_object", "false_alarm"])
            for network in range(2):
                for row in dataset.rows:
                    if row.split != "test":
                        continue
                    scene = scene_of(row.image)
                    if row.foreign_object:
                        hit = (row.size_mm > limits[arm]) != (rng.random() < 0.2)
                        size = [contrast[scene], row.size_mm]
                    else:
                        hit, size = False, ["", ""]
                    alarm = "" if row.foreign_object else 0
                    writer.writerow([*size, int(hit), network, scene, row.foreign_object, alarm])

    monkeypatch.setattr(task_module, "_train", train)
    monkeypatch.setattr(task_module, "detect_on_file", detect)
    monkeypatch.setattr(task_module, "thresholds_from_images", lambda *words, **options: {0: 0.5, 1: 0.5})
    monkeypatch.setattr(task_module, "_FEWEST_TO_LEARN", 3)
    monkeypatch.setattr(task_images, "_START_AVERAGED", 1)
    return limits, trained


@pytest.mark.slow
def test_task_tries_twins_that_differ_by_the_effect_and_measured_images_on_the_same_objects(
    line, twin, tmp_path, stand_in, monkeypatch
):
    monkeypatch.setattr(object_material, "_FEWEST", 3)
    after = with_effect(twin, "object_scatter", 10.0)
    found = run_task(twin, after, TaskInput(measured=line / "products.h5"), tmp_path / "task", plan=TaskPlan())
    assert set(found["curves"]) == {f"{networks}_on_{images}" for networks, images in task_module.TRIALS}
    (bone,) = found["materials"]
    assert bone["material"] == "rib_bone" and bone["objects"] >= 3
    assert "after_against_library" in found["compare"]
    assert "with the library's material a90 is" in task_text(found)
    assert found["effects"] == ["object_scatter"]
    assert found["real_networks"] == "measured"
    images = {}
    for kind in ("before_test", "after_test", "measured"):
        with read_dataset(tmp_path / "task" / f"{kind}.h5") as dataset:
            images[kind] = sorted(
                (row.image, row.size_mm) for row in dataset.rows if row.split == "test" and row.size_mm > 0
            )
    assert images["before_test"] == images["after_test"] == images["measured"]
    for curve in found["curves"].values():
        assert curve["n"] == 2 * len(images["measured"])
        assert sum(point["n"] for point in curve["points"]) == curve["n"]
        assert sum(point["hits"] for point in curve["points"]) == curve["n_hits"]
    # an answer is JSON, and it can be said and drawn
    assert json.loads(json.dumps(found)) == found
    assert "measured" in task_text(found)
    drawn = pod_charts(found)
    assert [chart.name for chart in drawn] == ["pod_expected", "pod_tried"]
    assert all("twin before" in chart.numbers_csv() for chart in drawn)
    paths = [tmp_path / "task" / f"{name}_test.h5" for name in ("before", "after")]
    with read_dataset(paths[0]) as one, read_dataset(paths[1]) as two:
        lower = [(one.images(k) - two.images(k))[:, one.product_masks(k)].mean() for k in range(len(one))]
    # scatter over primary of some percent, in every product
    assert np.all(np.asarray(lower) > 0.01)


@pytest.mark.slow
def test_an_effect_that_changes_no_image_leaves_a90_as_it_was_and_says_so(line, twin, tmp_path, stand_in):
    after = with_effect(twin, "image_lag", 1.0)
    found = run_task(twin, after, TaskInput(measured=line / "products.h5"), tmp_path / "task", plan=TaskPlan())
    assert found["a90_after"] == found["a90_before"]
    assert any("change no image" in text for text in found["warnings"])
    assert any("image_lag" in text for text in found["warnings"])
    assert stand_in[1] == [["before", "measured"]]


@pytest.mark.slow
def test_sizes_that_all_are_detected_at_give_null_with_a_warning(line, twin, tmp_path, stand_in, monkeypatch):
    def always(runs, dataset_path, out, contrast, thresholds, *, device):
        with read_dataset(dataset_path) as dataset, open(out, "w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(["size_mm", "hit", "network", "image"])
            for row in dataset.rows:
                if row.split == "test" and row.foreign_object:
                    writer.writerow([row.size_mm, 1, 0, scene_of(row.image)])

    monkeypatch.setattr(task_module, "detect_on_file", always)
    plan = TaskPlan(size="size_mm", test_share=0.7)
    found = run_task(twin, twin, TaskInput(measured=line / "products.h5"), tmp_path / "task", plan=plan)
    assert found["a90_real"] is None
    assert found["a90_before"] is None
    assert [text for text in found["warnings"] if text.startswith("no a90_real:") and "every trial is a hit" in text]
    assert "none that the data support" in task_text(found)


@pytest.mark.slow
def test_too_few_measured_images_to_learn_from_leave_the_improved_twins_networks(
    line, twin, tmp_path, stand_in, monkeypatch
):
    monkeypatch.setattr(task_module, "_FEWEST_TO_LEARN", 1000)
    after = with_effect(twin, "object_scatter", 10.0)
    found = run_task(twin, after, TaskInput(measured=line / "products.h5"), tmp_path / "task", plan=TaskPlan())
    assert found["real_networks"] == "generated"
    assert found["a90_real"] == found["curves"]["after_on_measured"]["a90"]
    assert "measured_on_measured" not in found["curves"]


@pytest.mark.slow
def test_a_stopped_task_goes_on_and_another_one_is_refused(line, twin, tmp_path, stand_in):
    brought = TaskInput(measured=line / "products.h5")
    first = run_task(twin, twin, brought, tmp_path / "task", plan=TaskPlan())
    # five objects to learn from: too few to tell what they are made of
    assert first["a90_library"] is None and first["materials"] == []
    assert any("own material is not known" in line for line in first["warnings"])
    times = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "task").glob("*_test.h5")}
    assert run_task(twin, twin, brought, tmp_path / "task", plan=TaskPlan()) == first
    assert times == {path.name: path.stat().st_mtime_ns for path in (tmp_path / "task").glob("*_test.h5")}
    with pytest.raises(InputError, match=r"another task \(plan\)"):
        run_task(twin, twin, brought, tmp_path / "task", plan=TaskPlan(steps=61))


def test_a_dataset_needs_something_to_generate_from(line, twin, tmp_path, stand_in, monkeypatch):
    dataset = tmp_path / "measured.h5"
    low, high = settings(line)
    words = [
        "import",
        "reference",
        str(line / "products.h5"),
        "-o",
        str(dataset),
        "--low",
        str(low),
        "--high",
        str(high),
    ]
    assert main([*words, "--test", "0.5", "--validation", "0.1"]) == 0
    with pytest.raises(InputError, match="--task-products"):
        run_task(twin, twin, TaskInput(measured=dataset), tmp_path / "task", plan=TaskPlan())
    description = tmp_path / "fillets.toml"
    description.write_text(
        '[[product]]\nname = "fillet"\nshape = "fillet"\nmaterial = "chicken_breast"\nlength_mm = [12, 14]\n'
        "width_mm = [9, 11]\nheight_mm = [5, 8]\n"
        '[[foreign_object]]\nname = "rib"\nshape = "rod"\nmaterial = "rib_bone"\nlength_mm = [1, 3]\n'
        "diameter_mm = [0.5, 1]\n[images]\nwith_foreign_object = 0.7\nvalidation = 0.2\n",
        encoding="utf-8",
    )
    brought = TaskInput(measured=dataset, products=description)
    monkeypatch.setattr(task_module, "detect_on_file", _by_row)
    found = run_task(twin, twin, brought, tmp_path / "described", plan=TaskPlan(images=10, size="size_mm"))
    assert found["products"] == "the description fillets.toml"
    assert found["curves"]["before_on_before"]["objects"] >= 1


def _by_row(runs, dataset_path, out, contrast, thresholds, *, device):
    with read_dataset(dataset_path) as dataset, open(out, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["size_mm", "hit", "network", "image"])
        for number, row in enumerate(dataset.rows):
            if row.split == "test" and row.foreign_object:
                writer.writerow([row.size_mm, number % 2, 0, scene_of(row.image)])


@pytest.mark.parametrize(
    ("words", "mention"),
    [
        (["--task", "missing.h5"], "missing.h5"),
        (["--task-steps", "5"], "without --task"),
        (["--task", "SHORT", "--task-networks", "0"], "networks"),
        (["--task", "TWIN"], "raytwin-acquisition"),
        (["--task", "PRODUCTS", "--task-low", "kv=40,exposure_ms=25"], "both or neither"),
    ],
)
def test_bad_task_is_one_line_before_anything_long(line, tmp_path, refused_line, words, mention):
    names = {"SHORT": line / "short.h5", "TWIN": line / "twin.h5", "PRODUCTS": line / "products.h5"}
    words = [str(names.get(word, word)) for word in words]
    assert mention in refused_line("diagnose", line / "short.h5", "-o", tmp_path / "no", *words)
    assert not (tmp_path / "no").exists()


def test_images_without_foreign_objects_are_refused(line, tmp_path):
    dataset = tmp_path / "clean.h5"
    from raytwin.acquisition.dataset_io import DatasetRow, write_dataset

    with write_dataset(dataset, shape=(8, 8)) as writer:
        empty = np.zeros((8, 8))
        writer.append(
            image=np.zeros((2, 8, 8)), foreign_object_mask=None, product_mask=empty, row=DatasetRow(image="one")
        )
    with pytest.raises(InputError, match="no product with a foreign object"):
        check_task(TaskInput(measured=dataset))


@pytest.mark.slow
def test_a_noisier_line_is_followed_from_session_to_a90(line, tmp_path, capsys):
    session = tmp_path / "session.h5"
    words = [
        "lab",
        "--family",
        "none",
        "-o",
        str(session),
        "--protocol",
        "short",
        *LINE,
        "--frames",
        "16",
        "--products",
        "1",
    ]
    assert main([*words, "--effect", "excess_noise=60@calibration"]) == 0
    products = tmp_path / "products.h5"
    words = [
        "lab",
        "--family",
        "none",
        "-o",
        str(products),
        "--protocol",
        "products",
        *LINE,
        "--session",
        "1",
        "--products",
        "40",
    ]
    assert main([*words, "--bones-mm", "1,1.5,2.5,4", "--effect", "excess_noise=60@always"]) == 0
    capsys.readouterr()
    words = ["diagnose", str(session), "-o", str(tmp_path / "found"), "--task", str(products), "--json"]
    assert main([*words, "--task-networks", "1", "--task-start-steps", "16", "--task-steps", "8"]) == 0
    printed = json.loads(capsys.readouterr().out)
    task = printed["task"]
    assert set(task) >= {"a90_real", "a90_before", "a90_after", "a90_real_95", "curves", "warnings"}
    page = (tmp_path / "found" / "report.html").read_text(encoding="utf-8")
    assert "What it means for detection" in page
    assert json.loads((tmp_path / "found" / "diagnosis.json").read_text(encoding="utf-8")) == printed
