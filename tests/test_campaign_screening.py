"""Screening of a sweep: what is trained, that it costs no recommendation, that bytes depend on nothing else."""

import json
import math
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import raytwin as rt
from raytwin.acquisition.setting import setting_from_text
from raytwin.campaign.sweep import Progress, look_ahead, run_sweep
from raytwin.campaign.sweep_file import read_campaign
from raytwin.campaign.sweep_screening import (
    Candidate,
    Expected,
    Screen,
    decide_candidates,
    first_to_train,
    next_to_train,
)
from raytwin.campaign.sweep_trial import basis_of, prepare_references
from raytwin.errors import FileFormatError, InputError
from raytwin.explore.seen_size import Eye, read_networks_observer
from raytwin.explore.state import first_state
from raytwin.files import sha256_of_file
from raytwin.generator.twins.twin_io import read_twin
from raytwin.observers import Efficiency, Observer, observe_settings, write_efficiency
from raytwin.observers.efficiency import LeftOut

CAMPAIGN = """
twin = "twin.h5"
references = "references.h5"
test_share = 0.4
seed = 8
[grid]
low_kv = [40, 50, 60]
high_kv = 90
filter = "Cu:0.05"
power_w = 40
exposure_ms = [4, 6, 9, 14, 20, 30, 45, 70]
[training]
networks = 1
start_steps = 0
[screening]
round = 3
"""


PAIR = tuple(f"kv={kV},power_w=40,exposure_ms=50,filter=Cu:0.05" for kV in (40, 90))


@pytest.fixture(scope="module")
def line(tmp_path_factory, make_sweep_line):
    """A twin of 64 x 64 pixels, references, and a campaign of 24 settings that is screened."""
    folder = make_sweep_line(tmp_path_factory.mktemp("screening"))
    (folder / "campaign.toml").write_text(CAMPAIGN)
    return folder


@pytest.fixture(scope="module")
def ahead(line):
    """What is known of the settings before training."""
    return look_ahead(read_campaign(line / "campaign.toml"))


class FakeNetworks:
    """In place of training: hits and a90 of networks that are a known observer, each a90 with an error of 4 %."""

    def __init__(self, campaign, ahead, data, *, backwards=False, stop_after=None):
        prepare_references(campaign, data, basis_of(campaign, version="1"))
        screen = Screen(campaign, data / "test.h5", ahead)
        who = replace(screen.observer, efficiency=0.5, internal_noise=0.02)
        pairs = [one.pair for one in ahead if one.kept]
        sizes = observe_settings(screen.line, pairs, screen.objects, observer=who).a90_of_curve
        self.truth = {
            one.text: float(size) for one, size in zip([one for one in ahead if one.kept], sizes, strict=True)
        }
        self.backwards, self.stop_after, self.trained = backwards, stop_after, []

    def run(self, tasks, done):
        for task in reversed(tasks) if self.backwards else tasks:
            if self.stop_after is not None and len(self.trained) >= self.stop_after:
                raise KeyboardInterrupt
            text = f"{task['low']};{task['high']}"
            self.trained.append(text)
            self.write(task, self.truth[text], text)
            done(task, "")

    def close(self):
        pass

    def write(self, task, truth, text):
        folder = Path(task["folder"])
        folder.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng(task["seeds"]["train"])
        a90 = truth * math.exp(0.04 * rng.standard_normal())
        (folder / "hits.csv").write_text("contrast,hit,network,image\n0.1,1,0,a\n0.05,0,0,b\n")
        trial = {"key": task["key"], "refused": "", "warnings": [], "hits_sha256": sha256_of_file(folder / "hits.csv")}
        (folder / "trial.json").write_text(json.dumps(trial))
        curve = {
            "key": task["curve_key"],
            "a50": 0.6 * a90,
            "a90": a90,
            "a90_95_interval": {"low": a90 * math.exp(-0.08), "high": a90 * math.exp(0.08)},
            "a90_95": a90 * math.exp(0.066),
            "n": 2,
            "n_hits": 1,
            "objects": 2,
            "false_alarms": {"rate": 0.1, "low": 0.05, "high": 0.2, "n": 50, "effective_n": 50.0},
            "points": [],
            "line": None,
            "other_size": dict.fromkeys(("a50", "a90", "a90_low", "a90_high", "a90_upper", "line")) | {"points": []},
            "warnings": [],
        }
        (folder / "pod.json").write_text(json.dumps(curve))


def swept(line, ahead, folder, *, text=CAMPAIGN, **words):
    (line / "used.toml").write_text(text)
    campaign = read_campaign(line / "used.toml")
    networks = FakeNetworks(campaign, ahead, folder.parent / f"{folder.name}_data", **words)
    answer = run_sweep(campaign, folder, runner=networks, version="1", outlooks=ahead, progress=Progress())
    return answer, networks


@pytest.mark.parametrize("goal", ["", "[limits]\na90 = 1.0\n"])
def test_the_recommendation_is_that_of_training_all_at_a_third_of_the_cost(line, ahead, tmp_path, goal):
    screened, networks = swept(line, ahead, tmp_path / "screened", text=CAMPAIGN + goal)
    whole, everything = swept(line, ahead, tmp_path / "whole", text=CAMPAIGN.replace("[screening]\nround = 3\n", goal))
    assert screened["recommended"] == whole["recommended"] is not None
    feasible = sum(one.kept for one in ahead)
    assert len(everything.trained) == feasible
    assert len(networks.trained) <= feasible / 3
    rows = [row for row in screened["rows"] if row["feasible"]]
    # what is expected without training is what training gives
    measured = {row["setting"]: row["a90"] for row in whole["rows"]}
    inside = [
        row["predicted"]["low"] * math.exp(-0.08)
        <= measured[row["setting"]]
        <= row["predicted"]["high"] * math.exp(0.08)
        for row in rows
    ]
    assert np.mean(inside) > 0.9
    assert {row["decided"] for row in rows if not row["trained"]} <= {"worse", "misses", "slower"}
    assert all(row["reason"].startswith("not trained: ") for row in rows if not row["trained"])
    assert screened["screening"]["trained"] == len(networks.trained)
    observer = screened["screening"]["observer"]["observer"]
    assert observer["efficiency"] == pytest.approx(0.5, rel=0.4)


def test_the_observer_of_a_sweep_is_kept_and_says_the_same_elsewhere(line, ahead, tmp_path):
    answer, _ = swept(line, ahead, tmp_path / "kept")
    file = tmp_path / "kept" / "observer.json"
    twin, references = read_twin(line / "twin.h5"), tmp_path / "kept" / "references" / "test.h5"
    row = answer["rows"][3]
    pair = (setting_from_text(row["low"]), setting_from_text(row["high"]))
    told = rt.observe(twin, pair, references=references, calibrated=file).rows[0]["a90"]
    assert told is None  # beyond the largest object, where only a sweep asks
    networks = read_networks_observer(str(file), str(references), twin)
    state = replace(
        first_state(twin),
        kV_low=pair[0].kV,
        kV_high=pair[1].kV,
        power_low_W=pair[0].power_W,
        power_high_W=pair[1].power_W,
        filters_low=pair[0].filters,
        filters_high=pair[1].filters,
        exposure_ms=pair[0].exposure_ms,
    )
    seen = Eye(twin, networks=networks).see(state)
    assert seen.size_name == "contrast"
    for end in ("value", "low", "high"):
        assert getattr(seen.networks, end) == pytest.approx(row["predicted"][end], rel=1e-6)
    # a plan with this observer says what is expected everywhere, over the objects of all references
    asked = f'[screening]\nobserver = "{file}"\n[requirement]\ncontrast = 1.0\n'
    (line / "plan.toml").write_text(CAMPAIGN.replace("[screening]\nround = 3\n", asked))
    plan = rt.sweep(line / "plan.toml", plan_only=True)
    for one, theirs in zip(plan.rows, answer["rows"], strict=True):
        assert one["predicted"]["value"] == pytest.approx(theirs["predicted"]["value"], rel=0.3)
        assert one["verdict"] == (
            "likely" if one["predicted"]["high"] <= 1 else "fails" if one["predicted"]["low"] > 1 else "open"
        )
    assert "expected a90" in repr(plan)
    # and a sweep with it calibrates on no setting
    again, networks = swept(line, ahead, tmp_path / "again", text=(line / "plan.toml").read_text())
    assert again["screening"]["calibrating"] == [] and again["recommended"] in networks.trained
    assert {one["setting"] for one in again["decision"]["front"]} == set(again["pareto"])


def test_bytes_depend_neither_on_the_order_nor_on_a_stop(line, ahead, tmp_path):
    swept(line, ahead, tmp_path / "plain")
    swept(line, ahead, tmp_path / "backwards", backwards=True)
    with pytest.raises(KeyboardInterrupt):
        swept(line, ahead, tmp_path / "stopped", stop_after=4)
    _, rest = swept(line, ahead, tmp_path / "stopped")
    wanted = (tmp_path / "plain" / "sweep.json").read_bytes()
    assert (tmp_path / "backwards" / "sweep.json").read_bytes() == wanted
    assert (tmp_path / "stopped" / "sweep.json").read_bytes() == wanted
    answer = json.loads(wanted)
    assert len(rest.trained) == answer["trained"] - 4


def test_no_more_than_most_are_trained_and_the_others_say_so(line, ahead, tmp_path):
    text = CAMPAIGN + "train_first = 4\nmost = 4\n[limits]\na90 = 1.0\n"
    answer, networks = swept(line, ahead, tmp_path / "most", text=text)
    assert len(networks.trained) == 4
    left = [row for row in answer["rows"] if row["decided"] == "undecided"]
    assert left and all("most = 4 settings are trained" in row["reason"] for row in left)
    assert answer["screening"]["undecided"] == len(left)


def test_a_requirement_in_mm_sets_the_size_and_costs_no_training_where_it_cannot_be_met(line):
    text = CAMPAIGN + "[requirement]\nsize_mm = 4\nproducts_per_minute = 1500\n"
    (line / "pace.toml").write_text(text)
    campaign = read_campaign(line / "pace.toml")
    assert (campaign.curve.size, campaign.goal, campaign.requirement.throughput_per_s) == ("size_mm", 4.0, 25.0)
    for one in look_ahead(replace(campaign, settings=campaign.settings[2:5])):
        assert one.feasible and one.kept == (one.throughput_per_s >= 25.0)
        assert one.kept or one.why_left_out.startswith("not trained: throughput 22.73 products/s, required are 25")


def candidate(a90=None, *, expected=None, pace=1.0, dose=1.0):
    """A trained setting with this a90 to 5 %, or one that an observer expects to have it to 10 %."""
    row = {
        "low": "kv=40,power_w=40,exposure_ms=20",
        "high": "kv=90,power_w=40,exposure_ms=20",
        "a90": a90,
        "a90_low": None if a90 is None else a90 * math.exp(-0.098),
        "a90_high": None if a90 is None else a90 * math.exp(0.098),
        "a90_upper": None if a90 is None else a90 * math.exp(0.082),
        "throughput_per_s": pace,
        "dose_uGy": {"value": dose},
        "false_alarm_rate": None,
    }
    size = expected or a90
    seen = Expected(value=size, low=size * math.exp(-0.196), high=size * math.exp(0.196))
    return Candidate(row=row, trained=a90 is not None, expected=seen)


def kinds(candidates, goal=None):
    found = decide_candidates(candidates, goal=goal, most_false_alarms=None)
    return {text: one.kind for text, one in found.items()}, found


def test_what_is_likely_worse_than_the_best_is_decided():
    settings = {"best": candidate(0.1), "near": candidate(expected=0.11), "far": candidate(expected=0.2)}
    found, _ = kinds(settings)
    assert found == {"near": "undecided", "far": "worse"}


def test_with_a_goal_the_fastest_that_may_reach_it_are_trained_first():
    settings = {
        "slow": candidate(expected=0.1, pace=1.0),
        "fast": candidate(expected=0.1, pace=2.0),
        "faster": candidate(expected=0.17, pace=3.0),
        "fastest": candidate(expected=0.3, pace=4.0),
    }
    found, decided = kinds(settings, goal=0.15)
    assert found == {"slow": "undecided", "fast": "undecided", "faster": "undecided", "fastest": "misses"}
    assert next_to_train(settings, decided, goal=0.15, count=2) == ["fast", "slow"]
    settings["fast"] = candidate(0.1, pace=2.0)
    # what is slower than one that reaches the goal can change nothing; what is faster still can
    assert kinds(settings, goal=0.15)[0] == {"slow": "slower", "faster": "undecided", "fastest": "misses"}


def test_where_no_setting_reaches_the_goal_the_best_is_sought():
    settings = {"best": candidate(0.2), "near": candidate(expected=0.2), "far": candidate(expected=0.5)}
    assert kinds(settings, goal=0.05)[0] == {"near": "undecided", "far": "worse"}


def test_calibrating_settings_are_spread_over_the_order_and_unknown_ones_come_last():
    sizes = {f"{number:02d}": 0.01 * number for number in range(1, 11)} | {"none": math.nan, "large": 0.9}
    assert first_to_train(sizes, count=4, largest=1.0) == ["01", "04", "07", "10"]
    assert first_to_train({"a": math.nan, "b": 0.1}, count=4, largest=1.0) == ["b", "a"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("train_first = 3\n", "train_first.*4 or more"),
        ("most = 5\n", "most.*train_first, 6, or more"),
        ('detector = "ideel"\n', "did you mean ideal"),
        ('observer = "absent.json"\n', "observer.*not there"),
        ('observer = "twin.h5"\ntrain_first = 6\n', "train_first.*given beside observer"),
        ("rounds = 3\n", "'rounds'"),
        ("[requirement]\ndose_uGy = 3\n", "contrast or size_mm.*neither"),
        ("[requirement]\ncontrast = 0.1\nsize_mm = 2\n", "contrast or size_mm.*both"),
        ("[requirement]\ncontrast = 0.1\nfalse_alarm_rate = 1.5\n", "false_alarm_rate.*at most 1"),
        ("[requirement]\ncontrast = 0.1\nthroughput_per_s = 1\nproducts_per_minute = 60\n", "one of the two"),
        ('[requirement]\ncontrast = 0.1\n[pod]\nsize = "size_mm"\n', "size_mm with a requirement on contrast"),
        ("[requirement]\ncontrast = 0.1\n[limits]\na90 = 0.1\n", "a90.*the same beside"),
    ],
)
def test_bad_words_of_screening_and_requirement_are_one_line(line, words, message):
    (line / "bad.toml").write_text(CAMPAIGN + words)
    with pytest.raises(InputError, match=message) as caught:
        read_campaign(line / "bad.toml")
    assert "\n" not in str(caught.value)


def test_a_description_cannot_be_screened(line):
    text = CAMPAIGN.replace("references.h5", "products.toml") + '[pod]\nsize = "size_mm"\n'
    (line / "described.toml").write_text(text)
    with pytest.raises(InputError, match=r"\[screening\].*expected reference images"):
        read_campaign(line / "described.toml")


def test_references_whose_texture_cannot_be_read_are_named(line):
    pair = tuple(setting_from_text(f"kv={kV},power_w=40,exposure_ms=50,filter=Cu:0.05") for kV in (40, 90))
    answer = rt.observe(read_twin(line / "twin.h5"), pair, references=line / "references.h5")
    assert answer.observer["image"] == "residual"
    assert any("texture cannot be read, so the residual image" in line for line in answer.warnings)


def stating(line, folder, **attributes):
    """The line's references with attributes of their own."""
    path = folder / "stating.h5"
    path.write_bytes((line / "references.h5").read_bytes())
    with h5py.File(path, "a") as file:
        file.attrs.update(attributes)
    return path


def test_references_are_looked_at_as_what_they_state_to_be(line, tmp_path):
    twin, pair = read_twin(line / "twin.h5"), PAIR
    meat = rt.observe(twin, pair, references=line / "references.h5")
    silent = stating(line, tmp_path)
    with h5py.File(silent, "a") as file:
        del file.attrs["description"]
    asked = rt.observe(twin, pair, references=silent, product_material="water", foreign_material="glass")
    told = stating(line, tmp_path, product_material="water", foreign_material="glass")
    assert rt.observe(twin, pair, references=told).rows == asked.rows != meat.rows
    with pytest.raises(InputError, match=r"expected water, which .*states"):
        rt.observe(twin, pair, references=told, product_material="chicken_breast")
    campaign = CAMPAIGN.replace("references.h5", str(told))
    (line / "stating.toml").write_text(campaign)
    found = read_campaign(line / "stating.toml")
    assert (found.product_material, found.foreign_material) == ("water", "glass")
    (line / "stating.toml").write_text(f'product_material = "Al"\n{campaign}')
    with pytest.raises(InputError, match=r"stating.toml, product_material: got Al; expected water, which .*stating.h5"):
        read_campaign(line / "stating.toml")
    setting = {"low": pair[0].replace("kv=40", "kv=50"), "high": pair[1]}
    made = rt.generate(twin, told, n=1, seed=1, **setting)
    assert (made.attributes["product_material"], made.attributes["foreign_material"]) == ("water", "glass")


def test_an_observer_of_other_materials_is_refused_wherever_it_is_used(line, ahead, tmp_path):
    left_out = LeftOut(pair=ahead[0].pair, measured=1.0, predicted=1.0, low=0.9, high=1.1, log_sd=0.1)
    jar = Efficiency(
        observer=Observer(),
        covariance=((0.1, 0.0), (0.0, 0.1)),
        unit=0.01,
        scatter=0.0,
        left_out=(left_out,) * 4,
        size_name="contrast",
        product_material="water",
        foreign_material="glass",
    )
    write_efficiency(tmp_path / "observer.json", jar)
    twin, references = read_twin(line / "twin.h5"), line / "references.h5"
    (line / "jar.toml").write_text(CAMPAIGN.replace("round = 3", f'observer = "{tmp_path / "observer.json"}"'))
    for call in (
        lambda: rt.observe(twin, PAIR, references=references, calibrated=jar),
        lambda: read_networks_observer(str(tmp_path / "observer.json"), str(references), twin),
        lambda: Screen(read_campaign(line / "jar.toml"), references, ahead),
    ):
        with pytest.raises(InputError, match="got chicken_breast; expected water, with which the observer"):
            call()


def test_references_that_are_not_finite_are_refused(line, tmp_path):
    path = stating(line, tmp_path)
    with h5py.File(path, "a") as file:
        file["images"][1, 0, 30:34, 30:34] = np.nan
    with pytest.raises(FileFormatError, match="a value that is not finite"):
        rt.observe(read_twin(line / "twin.h5"), PAIR, references=path)


def test_what_keeps_an_observer_from_being_calibrated_is_said_before_training(line):
    fewer = CAMPAIGN.replace("[4, 6, 9, 14, 20, 30, 45, 70]", "[20]")
    (line / "fewer.toml").write_text(fewer)
    plan = rt.sweep(line / "fewer.toml", plan_only=True)
    (told,) = plan.warnings
    assert told.startswith("[screening]: 3 settings can be trained, and an observer is calibrated on 4 or more")
    assert told in repr(plan) and plan.to_dict()["warnings"] == [told]
    (line / "fewer.toml").write_text(fewer.replace("[screening]\nround = 3\n", ""))
    assert rt.sweep(line / "fewer.toml", plan_only=True).warnings == ()
    (line / "fewer.toml").write_text(CAMPAIGN.replace("test_share = 0.4", "test_share = 0.15"))
    with pytest.raises(
        InputError, match=r"foreign objects of known contrast above 0 to try networks on; expected 5 or"
    ):
        rt.sweep(line / "fewer.toml", plan_only=True)
