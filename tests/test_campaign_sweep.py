"""A sweep: what rules settings out, what is trained once and never again, who is recommended; bytes that depend on nothing else."""

import dataclasses
import json
import re
import shutil
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import uniform_filter1d

from raytwin.acquisition import read_dataset
from raytwin.acquisition.dataset_io import write_selected
from raytwin.acquisition.setting import setting_from_text
from raytwin.campaign import sweep_trial
from raytwin.campaign.sweep import Progress, compare_tables, look_ahead, run_sweep
from raytwin.campaign.sweep_choice import Choice, choose, indistinct, paces, pareto_front, sentence
from raytwin.campaign.sweep_file import CurveOptions, read_campaign, text_of_pair
from raytwin.campaign.sweep_report import by_upper_bound, write_report
from raytwin.campaign.sweep_runners import DaskCluster, Processes, _tried
from raytwin.campaign.sweep_settings import Outlook, keep_best, labels_of, start_pair
from raytwin.campaign.sweep_trial import run_task, seed_of
from raytwin.errors import InputError, MissingDependencyError, RaytwinError
from raytwin.files import only_one
from raytwin.generator.datasets.belt_motion import motion_strength_px, twin_on_belt
from raytwin.generator.datasets.generate import generate_dataset
from raytwin.generator.effects import AppliedEffect
from raytwin.generator.predictions.predict import predict_flatfield
from raytwin.generator.twins.twin_io import read_twin, write_twin

BEAM = "filter=Cu:0.05"
LONG = (
    setting_from_text(f"kv=40,power_w=40,exposure_ms=100,{BEAM},averaged=10"),
    setting_from_text(f"kv=90,power_w=45,exposure_ms=100,{BEAM},averaged=10"),
)
CAMPAIGN = f"""
twin = "twin.h5"
references = "references.h5"
test_share = 0.4
seed = 3
[grid]
low_kv = 40
high_kv = 90
filter = "Cu:0.05"
low_power_w = 40
high_power_w = 45
exposure_ms = [20, 50]
[[setting]]
low = "kv=40,power_w=400,exposure_ms=20,{BEAM}"
high = "kv=90,power_w=45,exposure_ms=20,{BEAM}"
[training]
networks = 1
images = 8
steps = 2
batch = 4
start_steps = 2
mixed_steps = 2
start_shares = [0.2]
"""


@pytest.fixture(scope="module")
def line(tmp_path_factory, make_sweep_line):
    """A twin of 64 x 64 pixels, references that its own line would show in 1 s, and a campaign file."""
    folder = make_sweep_line(tmp_path_factory.mktemp("sweep"))
    (folder / "campaign.toml").write_text(CAMPAIGN)
    (folder / "cut.h5").write_bytes((folder / "references.h5").read_bytes()[:-4000])
    return folder


def campaign_of(line, *, name="other.toml", text=CAMPAIGN, **changes):
    """The campaign with words of its file replaced: old text -> new text."""
    for old, new in changes.get("words", ()):
        assert old in text
        text = text.replace(old, new)
    (line / name).write_text(text)
    return read_campaign(line / name)


def sweep(campaign, folder, runner, **options):
    try:
        return run_sweep(campaign, folder, runner=runner, version="1", **options)
    finally:
        runner.close()


class Here:
    """In this process, one after the other."""

    def run(self, tasks, done):
        for task in tasks:
            done(task, _tried(lambda task=task: run_task(task)))

    def close(self):
        """Nothing to close."""


def files_of(folder):
    """What a sweep leaves, but for times."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in ("seconds.json", ".lock")
    }


def answers_of(folder):
    """The answer and the hits that it rests on."""
    return {name: content for name, content in files_of(folder).items() if name.endswith((".csv", ".json", ".pt"))}


@pytest.fixture(scope="module")
def whole(line):
    """An uninterrupted sweep in this process."""
    folder = line / "whole"
    return folder, sweep(read_campaign(line / "campaign.toml"), folder, Here())


class Spy:
    """Lets another runner do the tasks and keeps their names; or refuses all."""

    def __init__(self, inner=None):
        self.inner = inner
        self.asked = []

    def run(self, tasks, done):
        self.asked += [task.get("low", "start") + ";" + task.get("high", "") for task in tasks]
        assert self.inner is not None or not tasks
        if self.inner is not None:
            self.inner.run(tasks, done)

    def close(self):
        pass


# ---------------------------------------------------------------------------------------------------- the chain


@pytest.mark.slow
def test_a_row_stands_for_every_setting_tried_or_not(whole):
    folder, answer = whole
    assert [row["trained"] for row in answer["rows"]] == [False, True, True]
    refused, *tried = answer["rows"]
    assert "400 W" in refused["reason"] and not refused["feasible"] and not refused["folder"]
    for row in tried:
        # one network looks at each object; what the data support no number for is null with a reason
        assert row["n"] == row["objects"] > 0
        assert row["a90"] is not None or row["reason"]
        assert row["false_alarm_rate"]["low"] <= row["false_alarm_rate"]["value"] <= row["false_alarm_rate"]["high"]
    assert tried[0]["n"] == tried[1]["n"]
    assert json.loads((folder / "sweep.json").read_text()) == answer
    assert len((folder / "sweep.csv").read_text().splitlines()) == 1 + len(answer["rows"])
    assert not list(folder.rglob("train.h5")) and not list(folder.rglob("*.part"))


def test_products_that_networks_are_tried_on_are_not_those_they_learnt_from(whole):
    folder, _ = whole
    products = {}
    for name in ("learn", "test"):
        with read_dataset(folder / "references" / f"{name}.h5") as dataset:
            products[name] = {row.product for row in dataset.rows}
    assert products["learn"] and products["test"]
    assert not products["learn"] & products["test"]


def begun(whole, folder, *, without=""):
    """A sweep's folder with the references and the common start of the whole one; with all settings but one where it is named."""
    kept = shutil.ignore_patterns(*(["sweep.*", f"*_{without}_*"] if without else ["settings", "sweep.*"]))
    shutil.copytree(whole[0], folder, ignore=kept)
    return folder


def test_a_stopped_sweep_goes_on_in_processes_that_die_to_the_same_bytes(line, whole, tmp_path):
    campaign, folder = read_campaign(line / "campaign.toml"), begun(whole, tmp_path / "stopped")
    rows = []

    def stop(row):
        rows.append(row)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(campaign, folder, Here(), progress=Progress(advance=stop))
    assert not (folder / "sweep.json").exists()
    finished = list((folder / "settings").glob("*/row.json"))
    assert len(rows) == len(finished) == 1
    trial = finished[0].with_name("trial.json")
    before = trial.stat().st_mtime_ns

    def kill():
        while not workers._children._running:
            time.sleep(0.01)
        next(iter(workers._children._running)).kill()

    workers = Processes(2)
    killer = threading.Thread(target=kill)
    killer.start()
    spy = Spy(workers)
    sweep(campaign, folder, spy)
    killer.join()
    # the one that was left is tried again after its process died, the other one is not touched
    assert len(spy.asked) == 1
    assert trial.stat().st_mtime_ns == before
    assert answers_of(folder) == answers_of(whole[0])


def test_a_dask_cluster_gives_the_same_bytes(line, whole, tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0", protocol="tcp"
    ) as cluster:
        runner = DaskCluster(cluster.scheduler_address)
        sweep(read_campaign(line / "campaign.toml"), begun(whole, tmp_path / "dask"), runner)
    assert answers_of(tmp_path / "dask") == answers_of(whole[0])


def test_a_cluster_that_does_not_answer_is_one_line():
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    with pytest.raises(InputError, match=r"--scheduler.*does not answer") as caught:
        DaskCluster("tcp://127.0.0.1:9", timeout_s=0.3)
    assert "\n" not in str(caught.value)


def test_without_dask_the_install_command_is_told(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'raytwin\[cluster\]'"):
        DaskCluster("tcp://127.0.0.1:8786")


def test_workers_must_see_the_folder_and_have_the_same_version(tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")
    from raytwin import __version__

    (tmp_path / "marker").touch()
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0", protocol="tcp"
    ) as cluster:
        runner = DaskCluster(cluster.scheduler_address)
        try:
            runner.check(tmp_path / "marker", version=__version__)
            with pytest.raises(InputError, match="does not see"):
                runner.check(tmp_path / "elsewhere", version=__version__)
            with pytest.raises(InputError, match="expected raytwin 99"):
                runner.check(tmp_path / "marker", version="99")
        finally:
            runner.close()


def test_a_setting_that_fails_twice_is_a_row_with_its_error_and_others_stay(line, whole, tmp_path, monkeypatch):
    campaign, folder = read_campaign(line / "campaign.toml"), begun(whole, tmp_path / "failing", without="20ms")
    tries = []

    def fails(task, tell):
        tries.append(task["low"])
        raise RaytwinError("the disk is full")

    monkeypatch.setattr(sweep_trial, "_run_setting", fails)
    answer = sweep(campaign, folder, Here())
    assert len(tries) == 2
    assert answer["rows"][1]["reason"] == "failed 2 times: the disk is full"
    assert answer["rows"][2]["trained"]
    # it is no finished setting: the next run tries it again
    monkeypatch.undo()
    sweep(campaign, folder, Here())
    assert answers_of(folder) == answers_of(whole[0])


def test_only_what_a_changed_campaign_changes_is_done_again(line, whole, tmp_path, monkeypatch):
    folder = tmp_path / "changed"
    shutil.copytree(whole[0], folder)
    before = files_of(folder)
    goal = campaign_of(line, words=[("[training]", "[limits]\na90 = 0.2\nmaximum_dose_uGy = 1e6\n[training]")])
    sweep(goal, folder, Spy())  # a limit costs nothing
    told = []
    sweep(
        campaign_of(line, words=[("seed = 3", "seed = 3 # same")]), folder, Spy(), progress=Progress(tell=told.append)
    )
    assert told == []
    named = campaign_of(line, name="named.toml")
    sweep(named, folder, Spy(), progress=Progress(tell=told.append))
    assert len(told) == 1 and "holds the answer of other.toml; what was trained for it stays" in told.pop()
    with pytest.raises(AssertionError):  # the spy refuses to train
        later = campaign_of(line, name="named.toml", words=[("seed = 3", "seed = 4")])
        sweep(later, folder, Spy(), progress=Progress(tell=told.append))
    assert "of named.toml, with another seed: all settings are trained anew" in told[0]
    power = campaign_of(line, words=[("exposure_ms = [20, 50]", "exposure_ms = [50, 20, 30]")])
    spy = Spy(Here())
    answer = sweep(power, folder, spy)
    assert len(spy.asked) == 1 and "exposure_ms=30" in spy.asked[0]
    assert sum(row["trained"] for row in answer["rows"]) == 3
    link = campaign_of(line, words=[("[training]", '[pod]\nlink = "logit"\n[training]')])
    monkeypatch.setattr(sweep_trial, "_trial", lambda *words: pytest.fail("networks are trained again"))
    spy = Spy(Here())
    sweep(link, folder, spy)
    assert len(spy.asked) == 2  # the curves alone
    monkeypatch.undo()
    sweep(read_campaign(line / "campaign.toml"), folder, Here())
    after = files_of(folder)
    assert {name: after[name] for name in before if not name.endswith("pod.json")} == {
        name: content for name, content in before.items() if not name.endswith("pod.json")
    }


def test_seed_version_and_files_decide_every_result(line):
    campaign = read_campaign(line / "campaign.toml")
    other = campaign_of(line, words=[("seed = 3", "seed = 4")])
    pair = campaign.settings[1]

    def key(one, version="1"):
        basis = sweep_trial.basis_of(one, version=version)
        return sweep_trial.setting_key(basis, one.training, one.trying, pair)

    assert len({key(campaign), key(other), key(campaign, "2")}) == 3
    shares = campaign_of(line, words=[("test_share = 0.4", "test_share = 0.3")])
    assert key(shares) != key(campaign)


def test_what_turns_out_impossible_while_images_are_made_is_infeasible_for_good(line, whole, tmp_path, monkeypatch):
    campaign, folder = read_campaign(line / "campaign.toml"), begun(whole, tmp_path / "noisy", without="20ms")

    def too_noisy(*words, **options):
        raise InputError("target setting", received="a noisy reference", expected="longer ones")

    monkeypatch.setattr(sweep_trial, "_generate", too_noisy)
    answer = sweep(campaign, folder, Here())
    assert not answer["rows"][1]["feasible"] and "noisy reference" in answer["rows"][1]["reason"]
    monkeypatch.undo()
    sweep(campaign, folder, Spy())  # it is not tried again


def test_a_table_that_was_cut_short_is_made_again(line, whole, tmp_path):
    campaign, folder = read_campaign(line / "campaign.toml"), tmp_path / "touched"
    shutil.copytree(whole[0], folder)
    hits = next((folder / "settings").glob("*_20ms_*")) / "hits.csv"
    good = hits.read_bytes()
    hits.write_bytes(good[: len(good) // 2])
    spy = Spy(Here())
    (folder / "sweep.json").write_text("{")
    next((folder / "settings").glob("*_50ms_*/seconds.json")).write_text("")
    # what a process that was ended had begun to write
    (hits.parent / ".train_drawn.h5.abcd1234.part").write_bytes(b"half")
    sweep(campaign, folder, spy)
    assert not list(folder.rglob(".*.part"))
    assert len(spy.asked) == 1
    assert answers_of(folder) == answers_of(whole[0])


def test_a_folder_of_something_else_and_a_second_run_are_refused(line, whole, tmp_path):
    campaign = read_campaign(line / "campaign.toml")
    (tmp_path / "letter.txt").touch()
    with pytest.raises(InputError, match="other files"):
        sweep(campaign, tmp_path, Here())
    with only_one(whole[0], "another"), pytest.raises(InputError, match="is running"):
        sweep(campaign, whole[0], Here())


@pytest.mark.slow
def test_settings_without_an_a90_stand_by_their_numbers():
    rows = [{"a90": None, "a90_upper": None, "label": f"40/90 kV, {ms} ms"} for ms in ("100", "5", "20", "10", "2.5")]
    assert [row["label"].split()[2] for row in by_upper_bound(rows)] == ["2.5", "5", "10", "20", "100"]


def test_the_report_shows_every_setting(line, whole):
    folder, answer = whole
    campaign = read_campaign(line / "campaign.toml")
    page = write_report(answer, folder / "report.html", campaign=campaign, seconds={}, version="1").read_text()
    for row in answer["rows"]:
        assert row["label"] in page
    assert "400 W" in page and "data:image/png" in page


def test_with_a_description_objects_count_by_length_and_the_remedy_for_a_missing_start_can_be_copied(line):
    text = CAMPAIGN.replace('references = "references.h5"', 'references = "products.toml"')
    with pytest.raises(InputError, match="two low-noise settings to learn from first") as error:
        campaign_of(line, name="described.toml", text=text)
    low, high = re.findall(r'start_(?:low|high) = "[^"]+"', str(error.value))
    campaign = campaign_of(
        line, name="described.toml", text=text.replace("start_steps = 2", f"start_steps = 2\n{low}\n{high}")
    )
    assert campaign.curve.size == "size_mm"
    assert campaign.training.start is not None and all("averaged=50" in one for one in campaign.training.start)
    # where references are measured, a contrast is known for every setting
    assert campaign_of(line, text=CAMPAIGN).curve.size == "contrast"


def test_a_description_serves_as_references(line, tmp_path):
    text = CAMPAIGN.replace('references = "references.h5"', 'references = "products.toml"')
    text = text.replace("exposure_ms = [20, 50]", "exposure_ms = 50").replace("start_steps = 2", "start_steps = 0")
    text += "[detection]\nimages = 10\n"
    campaign = campaign_of(line, name="described.toml", text=text)
    answer = sweep(campaign, tmp_path / "described", Here())
    assert answer["unit"] == "mm"
    assert [row["trained"] for row in answer["rows"]] == [False, True]


# ---------------------------------------------------------------------------------------------------- looking ahead


FAST = ("low_kv = 40", "low_kv = 40\nbelt_speed_mm_s = 900")


def limit(words):
    """What puts a limit into the campaign file."""
    return ("[training]", f"[limits]\n{words}\n[training]")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([("low_power_w = 40", "low_power_w = 95")], "95 W.*at most the tube's 90 W"),
        ([limit("maximum_power_w = 42")], "45 W.*at most the tube's 42 W"),
        ([limit("maximum_kv = 80")], "90 kV.*at most the tube's 80 kV"),
        ([("exposure_ms = [20, 50]", "exposure_ms = 3000")], "saturates"),
        ([("exposure_ms = [20, 50]", "exposure_ms = 100\naveraged = 12")], "less than the reference's"),
        ([("exposure_ms = [20, 50]", "exposure_ms = 100\naveraged = 10\n")], "less than the reference's"),
        ([("low_kv = 40", "low_kv = 90")], "low kV below high kV"),
        ([("low_kv = 40", "low_kv = 40\nsource_detector_mm = 1000")], "another magnification"),
        ([("low_kv = 40", "low_kv = 40\nbinning = 2")], "bin"),
        ([("Cu:0.05", "Al:1"), limit("extrapolation = false")], "extrapolation = false"),
        ([("low_kv = 40", "low_kv = 40\nbelt_speed_mm_s = 10\naveraged = 2")], "2 frames on a moving belt"),
        ([("low_kv = 40", "low_kv = 40\nframe_interval_ms = 5")], "at least 22 ms"),
        ([FAST, limit("maximum_belt_speed_mm_s = 500")], "belt speed 900 mm/s"),
        ([FAST, limit("maximum_motion_px = 5")], "motion in one exposure"),
        ([FAST, ("[training]", "[line]\nproduct_pitch_mm = 30\n[training]")], "takes 44 ms, and products come every 33"),
        ([limit("maximum_dose_uGy = 1e-3")], "dose .* uGy, allowed are 0.001 uGy"),
        ([limit("minimum_throughput_per_s = 30")], "throughput 22.73 products/s, asked for are 30"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_a_row_with_its_reason(line, words, reason):
    import re

    campaign = campaign_of(line, words=words)
    found = [one for one in look_ahead(campaign) if "power_w=400" not in one.text]
    assert re.search(reason, found[0].reason), found[0].reason
    assert not found[0].feasible and not found[0].kept and "\n" not in found[0].reason


def test_what_is_known_of_a_setting_is_the_same_whichever_were_looked_at_before(line):
    text = CAMPAIGN.replace('references = "references.h5"', 'references = "products.toml"')
    text = text.replace("low_kv = 40", "low_kv = [40, 45]").replace(
        "high_kv = 90", "high_kv = [80, 90]\nbelt_speed_mm_s = [30, 90]"
    )
    text = text.replace("start_steps = 2", "start_steps = 0")
    campaign = campaign_of(line, name="described.toml", text=text)
    together = look_ahead(campaign)
    assert len({one.pair[0] for one in together}) < len(together)
    assert together == tuple(
        look_ahead(dataclasses.replace(campaign, settings=(pair,)))[0] for pair in campaign.settings
    )


def test_dose_time_and_throughput_are_those_of_both_images(line):
    campaign = read_campaign(line / "campaign.toml")
    twin = read_twin(line / "twin.h5")
    for one in look_ahead(campaign)[1:]:
        assert one.feasible
        exposure = one.pair[0].exposure_ms
        kerma = [predict_flatfield(twin, setting).air_kerma_uGy for setting in one.pair]
        assert one.dose_uGy["value"] == pytest.approx(sum(part.value for part in kerma))
        assert one.dose_uGy["high"] == pytest.approx(sum(part.high for part in kerma))
        assert one.pair_ms == pytest.approx(2 * (exposure + 2.0))
        assert one.throughput_per_s == pytest.approx(1000.0 / one.pair_ms)
    paused = campaign_of(line, words=[("[training]", '[line]\npair = "at_once"\npause_ms = 50\n[training]')])
    assert look_ahead(paused)[1].throughput_per_s == pytest.approx(1000.0 / (22.0 + 50.0))
    moving = [
        ("low_kv = 40", "low_kv = 40\nbelt_speed_mm_s = 90"),
        ("[training]", "[line]\nproduct_pitch_mm = 60\n[training]"),
    ]
    assert look_ahead(campaign_of(line, words=moving))[1].throughput_per_s == pytest.approx(1.5)


def test_a_moving_belt_smears_images_along_itself_and_keeps_their_mean(line, tmp_path):
    twin = read_twin(line / "twin.h5")
    twin = dataclasses.replace(twin, instrument=dataclasses.replace(twin.instrument, belt_axis="row"))
    still = (
        setting_from_text(f"kv=40,power_w=40,exposure_ms=400,{BEAM}"),
        setting_from_text(f"kv=90,power_w=20,exposure_ms=400,{BEAM}"),
    )
    # v M t / pixel is a path of 11 pixels, the strength that in 50 ms
    moving = tuple(dataclasses.replace(one, belt_speed_mm_s=11 * 0.45 / 0.4 * 2970 / 3177) for one in still)
    assert motion_strength_px(twin.instrument, moving[0]) == pytest.approx(11.0 / 8)
    profiles, means = [], []
    for number, pair in enumerate((still, moving)):
        seen, told = twin_on_belt(twin, pair)
        assert told == ()
        with read_dataset(line / "references.h5") as references:
            generate_dataset(
                seen,
                references,
                tmp_path / f"{number}.h5",
                low=pair[0],
                high=pair[1],
                images=12,
                seed=1,
                with_counts=False,
            )
        with read_dataset(tmp_path / f"{number}.h5") as images:
            shown = images.images(slice(None)).astype(float)
        through = np.exp(-shown)
        profiles.append([through.mean(axis=(1, 3)), through.mean(axis=(1, 2))])
        means.append(through.mean())
    # the belt moves along the rows' index: profiles along it are means over the path, those across it stay as they are
    smeared = uniform_filter1d(profiles[0][0], 11, axis=1)
    moved = profiles[1][0] - profiles[0][0]
    assert np.std(profiles[1][0] - smeared) < 0.5 * np.std(moved)
    assert np.std(profiles[1][1] - profiles[0][1]) < 0.5 * np.std(moved)
    assert means[1] == pytest.approx(means[0], rel=2e-3)
    with pytest.raises(InputError, match=r"averaged: got 4 frames on a moving belt; expected averaged = 1"):
        twin_on_belt(twin, tuple(dataclasses.replace(one, averaged=4) for one in moving))


def test_a_line_detector_is_as_fast_as_its_belt_and_a_tdi_smears_by_one_stage(line):
    twin = read_twin(line / "twin.h5")
    stages = dataclasses.replace(twin.instrument, detector="tdi", tdi_stages=8, readout_ms=None)
    moving = dataclasses.replace(LONG[0], averaged=1, belt_speed_mm_s=10.0)
    one = motion_strength_px(twin.instrument, moving)
    assert motion_strength_px(stages, moving) == pytest.approx(one / 8)
    assert motion_strength_px(twin.instrument, dataclasses.replace(moving, belt_speed_mm_s=20.0)) == pytest.approx(
        2 * one
    )
    lines = dataclasses.replace(twin.instrument, detector="line")
    write_twin(line / "lines.h5", dataclasses.replace(twin, instrument=lines))
    pitch = ("[training]", "[line]\nproduct_pitch_mm = 50\n[training]")
    words = [('twin = "twin.h5"', 'twin = "lines.h5"'), ("low_kv = 40", "low_kv = 40\nbelt_speed_mm_s = 15"), pitch]
    found = look_ahead(campaign_of(line, words=words))
    # a pixel passes in 28 ms: 20 ms with its readout can be done, 50 ms cannot
    assert found[1].feasible and found[1].pair_ms is None
    assert found[1].throughput_per_s == pytest.approx(15 / 50)
    assert "the belt moves one pixel" in found[2].reason


def test_a_twin_with_effects_is_taken_and_decides_the_result(line):
    twin = read_twin(line / "twin.h5")
    effects = (
        AppliedEffect(id="object_scatter", parameters={"strength": 10.0}, since="calibration"),
        AppliedEffect(id="motion_blur", parameters={"strength": 2.0}, since="calibration"),
    )
    write_twin(line / "improved.h5", dataclasses.replace(twin, effects=effects))
    words = [('twin = "twin.h5"', 'twin = "improved.h5"')]
    campaign = campaign_of(line, words=words)
    assert [one.feasible for one in look_ahead(campaign)] == [False, True, True]
    own = sweep_trial.basis_of(read_campaign(line / "campaign.toml"), version="1")
    assert sweep_trial.basis_of(campaign, version="1")["twin_sha256"] != own["twin_sha256"]
    moving = campaign_of(line, words=[*words, ("low_kv = 40", "low_kv = 40\nbelt_speed_mm_s = 9")])
    one = look_ahead(moving)[1]
    assert one.feasible
    # motion that was found at another speed is not there twice
    assert any("gives way" in text for text in one.warnings)
    seen, _ = twin_on_belt(read_twin(line / "improved.h5"), one.pair)
    assert [item.id for item in seen.effects] == ["object_scatter", "motion_blur"]


def test_more_exposure_stands_out_more_and_keep_best_compares_like_with_like(line):
    slabs = '[contrast]\nproduct = "chicken_breast:10"\nobject = "rib_bone:1"\n[training]'
    words = [("[training]", slabs), ("low_kv = 40", "low_kv = [40, 45, 50]"), ("seed = 3", "seed = 3\nkeep_best = 1")]
    found = look_ahead(campaign_of(line, words=words))[1:]
    ratio = {one.text: one.cnr_object for one in found}
    for one in found:
        longer = one.text.replace("exposure_ms=20", "exposure_ms=50")
        assert ratio[longer] >= ratio[one.text]
    for exposure in ("exposure_ms=20", "exposure_ms=50"):
        same = [one for one in found if exposure in one.text]
        kept = [one for one in same if one.kept]
        assert [one.cnr_object for one in kept] == [max(one.cnr_object for one in same)]
        assert all("keep_best trains the best 1" in one.why_left_out for one in same if not one.kept)
    overall = keep_best([dataclasses.replace(one, kept=True) for one in found], keep=2, of="all")
    assert sum(one.kept for one in overall) == 2


def test_labels_say_what_differs_and_nothing_else(line):
    campaign = campaign_of(line, words=[("low_kv = 40", "low_kv = [40, 50]")])
    labels = labels_of(campaign.settings[1:])
    assert labels == ["40/90 kV, 20 ms", "40/90 kV, 50 ms", "50/90 kV, 20 ms", "50/90 kV, 50 ms"]
    assert labels_of(campaign.settings[1:2]) == ["40/90 kV, Cu:0.05, 20 ms"]
    still, moving = (
        campaign.settings[1],
        tuple(dataclasses.replace(one, belt_speed_mm_s=9.0) for one in campaign.settings[1]),
    )
    assert labels_of([still, moving]) == ["no belt", "9 mm/s"]


def test_further_looks_at_a_reference_bear_its_name():
    name = sweep_trial._look_of({"a", "b-1"})
    assert [name(image) for image in ("a", "b-1", "a-00002", "b-1-00003", "a-00004")] == [
        "a",
        "b-1",
        "a#2",
        "b-1#2",
        "a#3",
    ]


def test_a_file_that_was_not_dealt_out_is_dealt_out(line, tmp_path):
    with read_dataset(line / "references.h5") as references:
        write_selected(references, line / "undealt.h5", selection=slice(None), split="test")
    campaign = campaign_of(line, words=[("references.h5", "undealt.h5")])
    sweep_trial.prepare_references(campaign, tmp_path, sweep_trial.basis_of(campaign, version="1"))
    with read_dataset(tmp_path / "learn.h5") as learn, read_dataset(tmp_path / "test.h5") as test:
        assert {row.split for row in learn.rows} == {"train", "val"}
        assert len(learn) + len(test) == 20


def test_references_that_another_campaign_began_to_deal_out_are_not_taken_for_ones_own(line, tmp_path, monkeypatch):
    own, other = campaign_of(line), campaign_of(line, name="later.toml", words=[("seed = 3", "seed = 4")])
    bases = [sweep_trial.basis_of(one, version="1") for one in (own, other)]
    sweep_trial.prepare_references(own, tmp_path, bases[0])
    before = (tmp_path / "learn.h5").read_bytes()

    def killed(*words, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep_trial, "write_selected", killed)
    with pytest.raises(KeyboardInterrupt):
        sweep_trial.prepare_references(other, tmp_path, bases[1])
    monkeypatch.undo()
    assert (tmp_path / "learn.h5").read_bytes() != before
    sweep_trial.prepare_references(own, tmp_path, bases[0])
    assert (tmp_path / "learn.h5").read_bytes() == before


def hit_table(path, threshold, *, networks=2, images=14):
    """Hits of networks that see what is larger than a threshold that networks and images vary."""
    rng = np.random.default_rng(7)
    sizes, eyes = np.linspace(0.02, 0.3, images), 0.02 * rng.standard_normal(networks)
    hard = 0.02 * rng.standard_normal(images)
    noise = np.random.default_rng(round(1e4 * threshold))
    lines = ["contrast,hit,network,image,foreign_object,false_alarm"]
    for network in range(networks):
        for image in range(images):
            seen = sizes[image] + eyes[network] + hard[image] + 0.02 * noise.standard_normal() > threshold
            lines.append(f"{sizes[image]:.5f},{int(seen)},{network},p{image},bone,")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_settings_are_compared_on_the_same_images(tmp_path):
    first, second = hit_table(tmp_path / "1.csv", 0.12), hit_table(tmp_path / "2.csv", 0.13)
    found = compare_tables(first, second, CurveOptions())
    assert found["paired"] == "image"
    assert 0.5 < found["value"] < 2.0


@given(share=st.floats(0.01, 0.9), averaged=st.integers(1, 40))
def test_a_share_of_the_references_is_a_share_of_their_tube_load(share, averaged):
    own = tuple(dataclasses.replace(one, averaged=averaged) for one in LONG)
    for before, after in zip(own, start_pair(own, share), strict=True):
        assert after.exposure_ms == before.exposure_ms
        assert after.power_W <= before.power_W * (1 + 1e-9)
        assert after.tube_load_mAs * after.averaged == pytest.approx(share * before.tube_load_mAs * averaged)


def test_seeds_come_from_the_setting_and_its_purpose_alone():
    seeds = {seed_of(seed, purpose, text) for seed in (1, 2) for purpose in ("train", "test") for text in ("a", "b")}
    assert len(seeds) == 8
    assert seed_of(1, "train", "a") == seed_of(1, "train", "a") < 2**48


# ---------------------------------------------------------------------------------------------------- the choice


def row(a90, *, upper=None, dose=1.0, pace=1.0, alarms=0.0, **more):
    return {
        "label": f"a90 {a90}",
        "a90": a90,
        "a90_low": None if a90 is None else 0.8 * a90,
        "a90_high": None if a90 is None else 1.3 * a90,
        "a90_upper": upper if upper is not None or a90 is None else 1.2 * a90,
        "dose_uGy": None if dose is None else {"value": dose, "low": dose, "high": dose},
        "throughput_per_s": pace,
        "belt_speed_mm_s": None,
        "false_alarm_rate": None if alarms is None else {"value": alarms, "low": 0.0, "high": 1.0, "n": 10},
        "trained": True,
        "alike": False,
        "n": 20,
        "n_hits": 5,
        **more,
    }


POINTS = st.tuples(
    st.sampled_from([None, 0.1, 0.2, 0.3]), st.sampled_from([None, 1.0, 2.0, 3.0]), st.sampled_from([None, 1.0, 2.0])
)


def beats(one, other):
    def known(point):
        a90, dose, pace = point
        return (a90, np.inf if dose is None else dose, -(pace or 0.0))

    mine, theirs = known(one), known(other)
    return mine != theirs and all(a <= b for a, b in zip(mine, theirs, strict=True))


@given(st.lists(POINTS, min_size=1, max_size=12))
def test_the_front_holds_those_that_nobody_beats(points):
    front = pareto_front([row(a90, dose=dose, pace=pace) for a90, dose, pace in points])
    with_a90 = [point for point in points if point[0] is not None]
    for number, point in enumerate(points):
        free = point[0] is not None and not any(beats(other, point) for other in with_a90)
        assert (number in front) == free


def test_the_smallest_upper_bound_is_recommended_not_the_smallest_estimate():
    rows = [row(0.10, upper=0.30), row(0.12, upper=0.15), row(None), row(0.09, upper=None) | {"a90_upper": None}]
    assert choose(rows, goal=None, most_false_alarms=None) == Choice(best=1, recommended=1, meets=None)


def test_where_no_setting_has_a_bound_the_smallest_estimate_is_recommended_and_said_to_be_that():
    rows = [row(a90, a90_upper=None) for a90 in (0.2, 0.1)]
    for goal, said in (
        (None, "Take a90 0.1: none of 2 settings with an a90 has a 95 % upper bound, and its a90 is the smallest"),
        (0.15, "No setting is shown to reach a90 = 0.15; the smallest a90 is that of a90 0.1"),
    ):
        text = sentence(rows, choose(rows, goal=goal, most_false_alarms=None), goal=goal, unit="")
        assert text.startswith(f"{said} (a90 0.1, 95 % 0.08 to 0.13;")
    alone = sentence(rows[:1], choose(rows[:1], goal=None, most_false_alarms=None), goal=None, unit="")
    assert alone.startswith("Take a90 0.2: the only setting with an a90 (") and "no upper bound" in alone


def test_with_a_goal_the_fastest_that_is_shown_to_reach_it_is_recommended():
    rows = [row(0.10, pace=1.0), row(0.12, pace=3.0), row(0.11, pace=3.0, dose=0.5), row(0.16, pace=9.0)]
    assert choose(rows, goal=0.15, most_false_alarms=None) == Choice(best=0, recommended=2, meets=True)
    assert choose(rows, goal=0.05, most_false_alarms=None) == Choice(best=0, recommended=0, meets=False)
    assert "No setting is shown to reach" in sentence(
        rows, choose(rows, goal=0.05, most_false_alarms=None), goal=0.05, unit="mm"
    )


def test_too_many_false_alarms_rule_a_setting_out():
    rows = [row(0.05, alarms=0.5), row(0.10, alarms=0.1), row(0.04, alarms=None)]
    assert choose(rows, goal=None, most_false_alarms=0.2).recommended == 1
    assert choose(rows, goal=None, most_false_alarms=0.05).recommended is None


def test_what_cannot_be_told_from_the_best_is_named():
    rows = [row(0.10), row(0.11, alike=True, pace=5.0), row(0.2)]
    text = sentence(rows, choose(rows, goal=None, most_false_alarms=None), goal=None, unit="")
    assert "1 other is not shown to be worse than it: a90 0.11." in text
    alone = sentence(rows[::2], choose(rows[::2], goal=None, most_false_alarms=None), goal=None, unit="")
    assert "All others are worse" in alone
    assert indistinct({"low": 0.9, "high": 1.2}) and indistinct(None) and indistinct({"low": None, "high": 1.2})
    assert not indistinct({"low": 1.1, "high": 1.2})


def test_nothing_is_recommended_where_nothing_has_an_a90():
    rows = [row(None), row(None) | {"n_hits": 9, "label": "best of them"}]
    text = sentence(rows, choose(rows, goal=None, most_false_alarms=None), goal=None, unit="")
    assert "None of the 2 settings" in text and "best of them: 9 of 20" in text
    unknown = [row(None) | {"n": 0, "n_hits": 0}, row(None) | {"trained": False, "n": None}]
    assert sentence(unknown, choose(unknown, goal=None, most_false_alarms=None), goal=None, unit="") == (
        "None of the 1 settings that were tried met a foreign object of known size: there is no POD."
    )
    untried = [row(None) | {"trained": False, "n": None}]
    assert "was tried" in sentence(untried, choose(untried, goal=None, most_false_alarms=None), goal=None, unit="")


def test_pace_is_belt_speed_where_products_a_second_are_unknown():
    rows = [row(0.1, pace=None) | {"belt_speed_mm_s": 50.0}, row(0.1, pace=None) | {"belt_speed_mm_s": 90.0}]
    assert paces(rows) == [50.0, 90.0]
    assert pareto_front(rows) == [1]


# ---------------------------------------------------------------------------------------------------- the file

BAD = [
    ('twin = "twin.h5"', 'twin = "absent.h5"', "twin.*not there"),
    ('twin = "twin.h5"', "", "twin.*got nothing; expected a text"),
    ('references = "references.h5"', 'references = "absent.h5"', "references.*not there.*relative to the campaign file"),
    ('references = "references.h5"', 'references = "twin.h5"', "references.*expected a dataset file.*raytwin import"),
    ('references = "references.h5"', 'references = "cut.h5"', "references, .*cut.h5.*truncated.*copy or make it again"),
    ('references = "references.h5"', 'references = "."', "references.*a folder; expected a file"),
    ('references = "references.h5"', 'references = "products.toml"', "start_low and start_high"),
    ("test_share = 0.4", 'test_references = "references.h5"', "test_references.*the file that networks learn from"),
    ("test_share = 0.4", "test_share = 0.95", "test_share.*at most 0.9"),
    ("test_share = 0.4", "test_share = 0.8\nvalidation_share = 0.4", "less than 1 together"),
    ("seed = 3", "seed = -1", "seed.*0 or more"),
    ("seed = 3", 'seed = "3"', "seed.*whole number"),
    ("seed = 3", "seed = true", "seed.*whole number"),
    ("seed = 3", "sead = 3", "'sead'.*did you mean seed"),
    ("seed = 3", "seed = 3\nSeed = 4", "each word once"),
    ("seed = 3", "seed = 3\nkeep_best = 2", r"keep_best.*\[contrast\]"),
    ("seed = 3", 'seed = 3\nproduct_material = "chiken"', "product_material.*chiken"),
    ("seed = 3", 'seed = 3\nreference_low = "kv=40,exposure_ms=1"', "one of the two"),
    ("[grid]", "[gird]", r"'gird'.*did you mean grid"),
    ("[grid]", "[[grid]]", r"one table \[grid\]"),
    ("low_kv = 40", "kv = 40", "low_kv and high_kv"),
    ("low_kv = 40", "", "no low_kv"),
    ("low_kv = 40", "low_kv = []", "an empty list"),
    ("low_kv = 40", 'low_kv = "40"', "expected numbers"),
    ("low_kv = 40", "low_kv = -40", "kV.*above 0"),
    ("low_kv = 40", "low_kv = nan", "kV.*above 0"),
    ("low_kv = 40", "low_kv = 40\nlow_belt_speed_mm_s = 5", "there is one belt"),
    ("low_kv = 40", "low_kv = 40\nrange = 3", "'range'"),
    ("low_kv = 40", "low_kv = 40\naveraged = 1.5", "averaged.*whole numbers"),
    ("low_kv = 40", "low_kv = 40\nlow_exposure_ms = 3", "one of the two ways"),
    ("low_power_w = 40\n", "", "tube load.*power_w"),
    ('filter = "Cu:0.05"', "filter = 0.05", "texts, for example"),
    ('filter = "Cu:0.05"', 'filter = "Cu"', "MATERIAL:mm"),
    ('filter = "Cu:0.05"', 'filter = "Xx:0.05"', "Xx"),
    ("exposure_ms = [20, 50]", f"exposure_ms = {list(range(1, 10002))}", "at most 10000"),
    ("power_w=400", "power=400", "setting 1.*power=400"),
    ("[training]", "[limits]\nmaximum_dose = 3\n[training]", "did you mean maximum_dose_uGy"),
    ("[training]", "[limits]\na90 = 0\n[training]", r"\[limits\], a90.*above 0"),
    ("[training]", "[limits]\nmaximum_false_alarm_rate = 3\n[training]", "at most 1"),
    ("[training]", "[limits]\nextrapolation = 1\n[training]", "true or false"),
    ("[training]", '[line]\npair = "both"\n[training]', "in_turn, at_once"),
    ("networks = 1", "networks = 0", "networks.*1 or more"),
    ("networks = 1", "networks = 1\ncrop_px = 5", "crop_px.*16 pixels"),
    ("networks = 1", 'networks = 2\nrecipe = "raytwn"', "did you mean raytwin"),
    ("start_shares = [0.2]", "start_shares = [2]", "start_shares.*at most 0.9"),
    ("start_shares = [0.2]", "start_shares = 0.2", "start_shares.*a list"),
    ("[training]", "[detection]\nthreshold = 0.5\nmarked_share = 0.1\n[training]", "one of the two"),
    ("[training]", '[pod]\nsize = "volume"\n[training]', "contrast, size_mm"),
    ("[training]", '[pod]\nlink = "cloglogg"\n[training]', "did you mean cloglog"),
    ("[training]", '[contrast]\nproduct = "water"\nobject = "Al:1"\n[training]', "product.*MATERIAL:mm"),
    ("[training]", "[contrast]\nobject_pixels = 3\n[training]", "product.*nothing"),
    ("[training]", "[training", "not TOML"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), BAD, ids=[str(number) for number in range(len(BAD))])
def test_a_bad_campaign_file_is_one_line_that_says_what_to_do(line, old, new, message):
    with pytest.raises(InputError, match=f"(?i){message}") as caught:
        look_ahead(campaign_of(line, words=[(old, new)]))
    assert "\n" not in str(caught.value)


def test_a_byte_order_mark_is_no_part_of_a_campaign_and_utf_16_is_named(line):
    campaign_of(line)
    path = line / "other.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8-sig")
    assert read_campaign(path).settings
    path.write_text(text, encoding="utf-16")
    with pytest.raises(InputError, match="got text in UTF-16; expected text in UTF-8; save it as UTF-8"):
        read_campaign(path)


def test_no_file_and_no_settings_are_told(line, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_campaign(tmp_path / "absent.toml")
    with pytest.raises(InputError, match="got a folder; expected a campaign file"):
        read_campaign(tmp_path)
    (tmp_path / "empty.toml").write_text("\n")
    with pytest.raises(InputError, match=r"an empty file; .*; docs/campaigns\.md has an example"):
        read_campaign(tmp_path / "empty.toml")
    text = 'twin = "twin.h5"\nreferences = "references.h5"\n'
    with pytest.raises(InputError, match="no settings"):
        campaign_of(line, text=text)


def test_a_moving_belt_needs_the_pitch_for_a_throughput(line):
    words = [
        ("low_kv = 40", "low_kv = 40\nbelt_speed_mm_s = 9"),
        limit("minimum_throughput_per_s = 1"),
    ]
    with pytest.raises(InputError, match="product_pitch_mm"):
        campaign_of(line, words=words)


def test_a_grid_is_every_combination_and_a_setting_stands_once(line):
    words = [
        ("low_kv = 40", "low_kv = [40, 50]"),
        ('filter = "Cu:0.05"', 'filter = ["Cu:0.05", "none"]'),
        ("power_w=400", "power_w=40"),
    ]
    campaign = campaign_of(line, words=words)
    # the setting of the list is one of the grid's
    assert len(campaign.settings) == 2 * 2 * 2
    assert len({text_of_pair(pair) for pair in campaign.settings}) == 8


def test_the_shipped_twin_goes_by_its_name(line):
    assert campaign_of(line, words=[('twin = "twin.h5"', 'twin = "virtual_lab"')]).twin.is_file()


def test_outlooks_without_contrast_to_noise_are_all_kept():
    pair = LONG
    assert keep_best([Outlook(pair=pair)], keep=1, of="all")[0].kept


@pytest.mark.browser
def test_the_page_fits_asks_nobody_and_draws_its_figures(line, whole, check_page):
    folder, answer = whole
    campaign = read_campaign(line / "campaign.toml")
    for name, interactive in (("alive", True), ("static", False)):
        page = folder / f"{name}.html"
        write_report(answer, page, campaign=campaign, seconds={}, version="1", interactive=interactive)
        check_page(page, static=not interactive)


def test_networks_at_the_lowest_threshold_are_told():
    assert sweep_trial.said_of_reluctant({0: 0.3, 1: 0.02}, 0.1) == []
    (line,) = sweep_trial.said_of_reluctant({0: 0.01, 1: 0.02, 2: 0.01}, 0.1)
    assert line.startswith("2 of 3 networks mark fewer images than marked_share = 0.1 asks for")
