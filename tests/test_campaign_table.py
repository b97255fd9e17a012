"""The paper's table: planted differences, what is dealt out, what is stated or refused, the page, and that it can be stopped."""

import copy
import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from raytwin.acquisition import DatasetRow, write_dataset
from raytwin.acquisition.setting import Setting
from raytwin.campaign import table as table_module
from raytwin.campaign import table_effects as effects_module
from raytwin.campaign import trial as trial_module
from raytwin.campaign._plain import plain
from raytwin.campaign.chain import Chain, claim_folder
from raytwin.campaign.demo import PAPER_PLAN, run_demo
from raytwin.campaign.table import alarms_at, equivalence_of, half_width, networks_text, plan_of, reason_text, run_table
from raytwin.campaign.table_effects import EffectsPlan, run_effect
from raytwin.campaign.table_page import table_page
from raytwin.cli import main
from raytwin.errors import InputError
from raytwin.files import only_one
from raytwin.generator.twins.shipped import shipped_calibration
from raytwin.generator.twins.twin_io import read_twin
from raytwin.reports import write_result_page
from raytwin.segmentation import Detection, write_detections

PLAN = plan_of(exposures_ms=(50.0,), line={"test_products": 50, "boneless": 10}, networks=3)
SHORT_PLAN = dataclasses.replace(PLAN, published=False)
VALIDATION = {"median_abs_error_percent": {"mean": 0.3, "sd": 0.2}, "coverage": {"rows": 8}}
PLANTED = {"measured": 0.12, "generated": 0.12, "published_measured": 0.12, "published_generated": 0.19}


def write_products(path, *, objects=40, boneless=10):
    """A dataset whose rows have the names of a test set's; its images are nothing."""
    plane = np.zeros((16, 16), dtype=np.float32)
    with write_dataset(path, shape=plane.shape) as writer:
        # not in the order of their names: generated files are not
        for number in np.random.default_rng(1).permutation(objects + boneless):
            bone = number < objects
            row = DatasetRow(
                image=f"{number:03d}",
                product="fillet",
                foreign_object="bone" if bone else "",
                size_mm=3.0 if bone else math.nan,
                contrast=0.1 if bone else math.nan,
                split="test",
                setting="low;high",
            )
            writer.append(
                image=np.stack([plane, plane]), foreign_object_mask=plane > 0, product_mask=plane == 0, row=row
            )


def detections(a90, *, networks, objects=40, seed=0):
    """Hits of networks whose curve (probit) has this a90, the same objects and networks' differences for every a90."""
    contrast = np.linspace(0.01, 0.3, objects)
    shared = np.random.default_rng(seed)
    image, network = 0.3 * shared.standard_normal(objects), 0.2 * shared.standard_normal(networks)
    noise = shared.standard_normal((networks, objects))
    total = math.sqrt(1 + 0.3**2 + 0.2**2)
    for one in range(networks):
        for number in range(objects):
            eta = 1.2816 * total + (contrast[number] - a90) / 0.03
            hit = bool(eta + image[number] + network[one] + noise[one, number] > 0)
            yield Detection(
                contrast=float(contrast[number]),
                size_mm=3.0,
                hit=hit,
                network=one,
                image=f"{number:03d}",
                foreign_object="bone",
                setting="low;high",
                false_alarm=None,
                recall=0.5 * hit,
                response=0.5,
                product="fillet",
            )


def run(words):
    """Commands of a chain without a lab: files with the products' names, and what a validation would say."""
    if words[0] == "compare":
        return main(words)
    if "-o" in words:
        write_products(words[words.index("-o") + 1])
    print(json.dumps(VALIDATION))
    return 0


def detect(runs, dataset, out, contrast, thresholds, *, device, numbers):
    if not out.exists():
        kind = out.stem.removeprefix("hits_").rpartition("_")[0]
        clean = dataclasses.replace(
            next(detections(0.1, networks=1)),
            contrast=None,
            foreign_object="",
            recall=None,
            false_alarm=False,
            response=0.2,
            hit=False,
        )
        looks = [
            dataclasses.replace(clean, network=network, image=f"clean{number}")
            for network in range(PLAN.networks)
            for number in range(10)
        ]
        write_detections(out, [*detections(PLANTED[kind], networks=PLAN.networks), *looks])


def set_thresholds(runs, dataset, out, share, *, device, numbers, lowest):
    found = dict.fromkeys(range(PLAN.networks), 0.5)
    out.write_text(json.dumps(found))
    return found


@pytest.fixture(scope="module", autouse=True)
def _no_networks():
    """Every trial has the a90 that is planted under its name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(table_module, "train_on_file", lambda *words, **options: None)
        patch.setattr(table_module, "thresholds_from_images", set_thresholds)
        patch.setattr(table_module, "detect_on_file", detect)
        yield patch


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A table, and what it was after every row."""
    parts = []
    folder = tmp_path_factory.mktemp("made") / "table"
    result = run_table(PLAN, folder, run=run, version="1", each=lambda part: parts.append(copy.deepcopy(part)))
    assert json.loads((folder / "table.json").read_text()) == result
    return result, parts


def test_equal_curves_are_equivalent_and_a_planted_difference_is_found(made):
    result, parts = made
    assert [row["exposure_ms"] for row in result["rows"]] == [1000.0, 50.0]
    # rows as they came: those of the twin first, the published recipe beside them afterwards
    assert [(one["pending"], one["published_pending"]) for one in parts] == [([50.0], [50.0]), ([], [50.0]), ([], [])]
    first, second = result["rows"]
    assert first["generated"] is None
    assert first["compare"] is None
    assert second["measured"]["a90"] == pytest.approx(0.12, abs=0.02)
    assert second["compare"]["equivalence"] == "equivalent"
    assert second["compare"]["paired"] == "image and network"
    assert second["alarms_on_measured"]["n"] == 30
    published = second["published"]["compare"]
    assert published["equivalence"] == "different"
    assert published["difference_a90"]["low"] < 0.07 < published["difference_a90"]["high"]


def _quick_curve(hits, size):
    """In the place of a fit: numbers that come from the table of hits alone."""
    text = hits.read_bytes()
    return {"a90": len(text) / 1e5, "a90_95_interval": {"low": 0.01, "high": 1.0}, "warnings": []}


def test_a_table_that_was_stopped_is_the_same_to_the_byte(tmp_path, monkeypatch):
    monkeypatch.setattr(table_module, "curve_of_table", _quick_curve)
    plan = plan_of(exposures_ms=(50.0, 20.0), line={"test_products": 50, "boneless": 10}, networks=3)

    class StoppedError(Exception):
        pass

    def stop(part):
        if len(part["rows"]) == 2:
            raise StoppedError

    def quick(words):
        if words[0] != "compare":
            return run(words)
        print(json.dumps({"warnings": [], "difference_a90": None, "size_equivalence": None}))
        return 0

    def done(folder, **options):
        run_table(plan, folder, run=quick, version="1", **options)
        return (folder / "table.json").read_bytes()

    whole = done(tmp_path / "whole")
    with pytest.raises(StoppedError):
        done(tmp_path / "stopped", each=stop)
    kept = (tmp_path / "stopped" / "hits_measured_50ms.csv").stat().st_mtime_ns
    assert done(tmp_path / "stopped") == whole
    assert (tmp_path / "stopped" / "hits_measured_50ms.csv").stat().st_mtime_ns == kept
    with pytest.raises(InputError, match="a table of another plan"):
        run_table(PLAN, tmp_path / "stopped", run=run, version="1")


def test_an_a90_that_is_missing_is_refused_with_the_reason_and_the_page_says_so(made):
    result = copy.deepcopy(made[0])
    row = result["rows"][1]
    row["measured"] |= {"a90": None, "a90_95_interval": {"low": None, "high": None}, "half_width": None}
    row["compare"] |= {"difference_a90": {"value": None, "low": None, "high": None}}
    row["compare"]["equivalence"] = equivalence_of(row["compare"], row)
    row["compare"]["reason"] = reason_text(row["compare"], row, margin=0.02)
    page = table_page(result)
    assert "These test sets cannot say whether both agree within 0.02 at 50 ms." in page.answer
    assert page.sections[0].table.rows[1][2:5] == ("–", "–", "not stated")
    assert page.sections[0].items == ("50 ms: not stated, for the measured images support no a90.",)


def test_the_page_of_an_unfinished_table_says_what_is_to_come(made, tmp_path):
    parts = made[1]
    first = table_page(parts[0])
    assert "Still to come: 50 ms" in first.answer[0]
    assert first.doubtful
    assert [step.command for step in first.steps] == ["raytwin table -o FOLDER"]
    assert not table_page(parts[-1]).steps
    path = write_result_page(tmp_path / "page.html", table_page(parts[-1]), version="1", interactive=False)
    text = path.read_text(encoding="utf-8")
    assert "from the weights that come with raytwin" in text
    write_result_page(path, table_page(parts[-1]), version="1", interactive=False)
    assert path.read_text(encoding="utf-8") == text


def test_wide_intervals_are_marked(made):
    result = copy.deepcopy(made[0])
    curve = result["rows"][1]["measured"]
    curve["half_width"] = 0.149
    assert "wide" not in table_page(result).sections[0].table.rows[1][2]
    curve["half_width"] = 0.151
    page = table_page(result)
    assert page.sections[0].table.rows[1][2].endswith("(wide)")
    notes = next(part for part in page.sections if part.title.startswith("Notes"))
    assert any("50 ms measured (+-15 %)" in line for line in notes.items)


def test_false_alarms_are_counted_at_other_thresholds(tmp_path):
    looks = [
        dataclasses.replace(
            next(detections(0.1, networks=1)),
            network=network,
            image=f"clean{number}",
            contrast=None,
            recall=None,
            false_alarm=False,
            response=0.1 * number,
        )
        for network in (0, 1)
        for number in range(10)
    ]
    with_bones = list(detections(0.1, networks=2))
    write_detections(tmp_path / "hits.csv", [*looks, *with_bones])
    (tmp_path / "thresholds.json").write_text('{"0": 0.65, "1": 0.85}')
    found = alarms_at(tmp_path / "hits.csv", tmp_path / "thresholds.json")
    assert found["n"] == 20
    assert found["rate"] == pytest.approx((3 + 1) / 20)  # above 0.65 lie three of ten, above 0.85 one
    assert found["low"] < found["rate"] < found["high"]
    write_detections(tmp_path / "bones.csv", with_bones)
    assert alarms_at(tmp_path / "bones.csv", tmp_path / "thresholds.json") is None


def test_half_the_width_of_an_interval_is_a_share_of_the_a90():
    curve = {"a90": 0.1, "a90_95_interval": {"low": 0.09, "high": 0.12}}
    assert half_width(curve) == pytest.approx(0.15)
    assert half_width({**curve, "a90": None}) is None
    assert half_width({**curve, "a90_95_interval": {"low": None, "high": 0.12}}) is None


@pytest.mark.parametrize(
    ("test", "state", "reason"),
    [
        (("equivalent", -0.01, 0.015), "equivalent", "-0.010 to +0.015, lies within +-0.02"),
        (
            ("different within the margin", 0.01, 0.015),
            "equivalent",
            "lies within +-0.02; the 95 % interval leaves out 0",
        ),
        (
            ("different", 0.03, 0.05),
            "different",
            "+0.030 to +0.050, reaches beyond +-0.02; the 95 % interval leaves out 0",
        ),
        (("inconclusive", -0.03, -0.0001), "not_stated", "-0.030 to 0.000, reaches beyond +-0.02"),
        (("inconclusive", None, 0.01), "not_stated", "the difference has no 90 % interval"),
        (None, "not_stated", "the two curves could not be compared"),
    ],
)
def test_equivalence_is_stated_or_refused_with_the_reason(test, state, reason):
    curves = {kind: {"a90": 0.1} for kind in ("measured", "generated")}
    compared = {
        "size_equivalence": None if test is None else dict(zip(("verdict", "low", "high"), test, strict=True)),
    }
    assert equivalence_of(compared, curves) == state
    assert reason_text(compared, curves, margin=0.02).endswith(reason)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--exposures-ms", "50,x"], "--exposures-ms: got '50,x'"),
        (["--exposures-ms", "1000"], "--exposures-ms: got (1000.0,)"),
        (["--boneless", "2"], "--boneless: got 2"),
        (["--test-products", "100", "--boneless", "100"], "--boneless: got 100"),
        (["--networks", "0"], "--networks: got 0"),
        (["--alarm-share", "1"], "alarm share: got 1.0"),
        (["--margin", "0"], "--margin: got 0.0"),
        (["--size", "96"], "--size: got 96"),
        (["--workers", "0"], "--workers: got 0"),
        (["--effect", "motion=3"], "--effect: got 'motion'; expected an effect's id, such as motion_blur"),
        (["--effect", "motion_blur"], "--effect: got 'motion_blur'"),
        (["--effect", "motion_blur=0"], "--effect: got motion_blur=0"),
        (["--effect", "unknown:sharpening=20"], "expected an effect that a diagnosis can name"),
        (["--effect", "heel=5", "--effect", "heel=6"], "expected each effect once"),
        (["--effect", "motion_blur=nan"], "strength of motion_blur: got nan px"),
        (["--effect", "heel=5", "--without-effects"], "--without-effects: got with options of lines"),
        (["--effect-products", "3"], "products of lines with an effect: got 3"),
        (["--effect-networks", "0"], "networks of lines with an effect: got 0"),
    ],
)
def test_bad_options_are_one_line_and_make_no_folder(words, message, tmp_path, refused_line):
    assert message in refused_line("table", "-o", tmp_path / "table", *words)
    assert not (tmp_path / "table").exists()


def test_the_networks_are_the_starter_or_the_papers():
    assert "Unet with the encoder timm-mobilenetv3_small_100" in networks_text(PLAN)
    random = plan_of(line={}, start="random", steps=600)
    assert networks_text(random).startswith(
        "10 networks an exposure, DeepLabV3Plus with the encoder efficientnet-b0, 600 steps"
    )


TASK = {
    "a90_before": 0.10,
    "a90_before_95": {"low": 0.09, "high": 0.11},
    "a90_after": 0.13,
    "a90_after_95": {"low": 0.12, "high": 0.15},
    "a90_real": 0.14,
    "a90_real_95": {"low": 0.12, "high": 0.17},
    "compare": {
        "before_against_real": {"difference_a90": {"value": -0.04, "low": -0.07, "high": -0.02}},
        "after_against_real": {"difference_a90": {"value": -0.01, "low": -0.04, "high": 0.02}},
    },
    "curves": {"before_on_before": {"objects": 110}},
    "warnings": ["one thing"],
}
CAUSE = {
    "effect": "motion_blur",
    "probability": 0.99,
    "parameters": {"strength": {"value": 3.9, "low": 3.7, "high": 4.2, "unit": "px"}},
}
DIAGNOSIS = {"verdict": "explained", "causes": [CAUSE], "gap": {"before": 5.0, "after": 1.1, "floor": 1.0}}


@pytest.fixture
def line_with_effect(monkeypatch):
    """Commands of a line with an effect in it: the twin, its products and the task are stood in for."""
    ran, shipped = [], read_twin(shipped_calibration("virtual_lab"))
    pairs = [tuple(Setting(kV=kV, power_W=40, exposure_ms=ms) for kV in (40, 90)) for ms in (25, 100)]
    monkeypatch.setattr(effects_module, "read_twin", lambda path: shipped)
    monkeypatch.setattr(effects_module, "_settings", lambda products: pairs)
    monkeypatch.setattr(effects_module, "run_task", lambda *words, **options: TASK)

    def run_line(words):
        if words[0] not in ("lab", "diagnose") or ("--effect" not in words and words[0] == "lab"):
            return run(words)
        ran.append(words)
        out = Path(words[words.index("-o") + 1])
        for path in (out,) if words[0] == "lab" else (out / "twin.h5",):
            path.parent.mkdir(exist_ok=True, parents=True)
            path.write_bytes(b"")
        planted = {"motion_blur": {"strength": 4.0, "unit": "px"}}
        print(json.dumps({"effects": planted} if words[0] == "lab" else DIAGNOSIS))
        return 0

    return run_line, ran


@pytest.mark.slow
def test_a_line_with_an_effect_stands_beside_the_table_before_and_after(line_with_effect, tmp_path):
    run_line, ran = line_with_effect
    plan, parts = EffectsPlan(effects=("motion_blur=4",)), []
    words = {"run": run_line, "version": "1", "effects": plan}
    result = run_table(SHORT_PLAN, tmp_path / "t", **words, each=lambda part: parts.append(copy.deepcopy(part)))
    assert [one["effects_pending"] for one in parts] == [["motion_blur"]] * 2 + [[]]
    (line,) = result["effects"]
    assert [row["exposure_ms"] for row in line["rows"]] == [25.0, 100.0]
    assert line["found"]["strength"]["value"] == 3.9
    page = table_page(result)
    section = next(part for part in page.sections if part.title == "Lines with an effect in them")
    assert section.table.rows[1][1:] == (
        "3.9 (3.7 to 4.2) px",
        "100 ms",
        "0.100 (0.090 to 0.110)",
        "0.130 (0.120 to 0.150)",
        "0.140 (0.120 to 0.170)",
    )
    told = "difference from measured: before -0.040 (-0.070 to -0.020), after -0.010 (-0.040 to +0.020)."
    assert section.items == (
        f"motion blur, 25 ms, {told}",
        f"motion blur, 100 ms, {told}",
        "motion blur, 25 ms: one thing",
        "motion blur, 100 ms: one thing",
    )
    assert "Lines with an effect are still to come" in " ".join(table_page(parts[-2]).answer)
    # again: nothing is measured or diagnosed a second time; another plan of a line is refused
    assert len(ran) == 3
    assert run_table(SHORT_PLAN, tmp_path / "t", **words) == result
    assert len(ran) == 3
    with pytest.raises(InputError, match="a line of another plan"):
        run_table(SHORT_PLAN, tmp_path / "t", **{**words, "effects": dataclasses.replace(plan, networks=4)})


@pytest.mark.slow
def test_an_effect_that_was_not_named_is_said_to_be(line_with_effect, tmp_path, monkeypatch):
    monkeypatch.setitem(DIAGNOSIS, "verdict", "no_gap")
    monkeypatch.setitem(DIAGNOSIS, "causes", [])
    plan = EffectsPlan(effects=("motion_blur=4",))
    result = run_table(SHORT_PLAN, tmp_path / "t", run=line_with_effect[0], version="1", effects=plan)
    assert result["effects"][0]["found"] == {"verdict": "no_gap", "named": [], "strength": None, "probability": None}
    section = next(part for part in table_page(result).sections if part.title.startswith("Lines"))
    assert section.table.rows[0][1] == "no gap"


@pytest.mark.slow
def test_a_small_table_is_the_same_bytes_with_two_workers(tmp_path, monkeypatch):
    for name in ("train_on_file", "thresholds_from_images", "detect_on_file"):
        monkeypatch.setattr(table_module, name, getattr(trial_module, name))
    plan = plan_of(
        exposures_ms=(50.0,),
        line={"size": (64, 80), "products": 8, "generated": 8, "test_products": 20, "boneless": 6},
        networks=2,
        steps=2,
    )
    run_table(plan, tmp_path / "one", run=main, version="1")
    run_table(plan, tmp_path / "two", run=main, version="1", workers=2)
    for name in ("table.json", "hits_generated_50ms.csv", "hits_published_measured_50ms.csv"):
        assert (tmp_path / "two" / name).read_bytes() == (tmp_path / "one" / name).read_bytes()


@pytest.mark.slow
def test_a_small_line_with_an_effect_goes_on_where_it_was_stopped(tmp_path):
    plan = EffectsPlan(effects=("object_scatter=20",), networks=1, products=24, size=64, frames=8)

    class StoppedError(Exception):
        pass

    def stop(line):
        if "task_100ms: networks of after" in line:
            raise StoppedError

    def made(name, tell=lambda line: None):
        chain = Chain(directory=tmp_path / name, run=main, tell=tell)
        return run_effect(plan, plan.effects[0], chain=chain, device="cpu")

    whole = made("whole")
    with pytest.raises(StoppedError):
        made("stopped", stop)
    assert made("stopped") == whole
    assert [row["exposure_ms"] for row in whole["rows"]] == [25.0, 100.0]
    assert whole["found"]["named"] == ["object_scatter"]
    hits = "effects/object_scatter/task_100ms/hits_after_on_after.csv"
    assert (tmp_path / "stopped" / hits).read_bytes() == (tmp_path / "whole" / hits).read_bytes()


@pytest.mark.parametrize(
    ("what", "start"),
    [
        ("a table", lambda folder: run_table(PLAN, folder, run=run, version="0")),
        ("a demo", lambda folder: run_demo(PAPER_PLAN, folder, run=run, tell=print)),
    ],
)
def test_a_second_run_in_a_folder_is_refused_and_leaves_it_as_it_was(what, start, tmp_path):
    plan = PLAN if what == "a table" else PAPER_PLAN
    claim_folder(
        tmp_path, plain(dataclasses.asdict(plan)) if what == "a table" else dataclasses.asdict(plan), what=what
    )
    before = sorted(path.name for path in tmp_path.iterdir())
    with only_one(tmp_path, what), pytest.raises(InputError, match=f"where {what} is running"):
        start(tmp_path)
    assert sorted({path.name for path in tmp_path.iterdir()} - {".lock"}) == before


@pytest.mark.browser
def test_the_page_fits_asks_nobody_and_draws_its_figures(made, tmp_path, check_page):
    check_page(write_result_page(tmp_path / "page.html", table_page(made[0]), version="1", interactive=True))
