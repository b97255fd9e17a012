"""Blind check: what is sealed stays sealed, what was answered stays answered, whatever stops the run."""

import hashlib
import json
import math
import re
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from raytwin.campaign._children import ChildError, Children, KilledError
from raytwin.campaign.blind_cases import (
    SETS,
    case_from_label,
    development_seeds,
    draw_cases,
    is_development_seed,
    names_of_sets,
    seal_of,
)
from raytwin.campaign.blind_check import (
    BlindOptions,
    Processes,
    Work,
    answer_path,
    begin_check,
    frozen_code,
    open_check,
    run_check,
)
from raytwin.campaign.blind_code import check_frozen_code, code_digest, freeze_code
from raytwin.campaign.blind_figures import confusion_table, verdict_table
from raytwin.campaign.blind_measure import measure_case
from raytwin.campaign.blind_report import summary_text, write_report
from raytwin.campaign.blind_results import case_rows, score_check, write_cases
from raytwin.campaign.blind_scores import compute_scores, strength_scores
from raytwin.campaign.blind_statistics import CurveKey, SessionStatistics, write_statistics
from raytwin.cli import main
from raytwin.errors import InputError, RaytwinError
from raytwin.generator.effects import EFFECTS
from raytwin.lab.cases import LABELS
from raytwin.lab.effects import EFFECTS as LAB

ROOT = Path(__file__).parents[1]
FRESH = 31337  # a seed that is not in the list of development


def position(name, strength):
    """Strength as a share of the way up its range (logarithm)."""
    law = LAB[name]
    return math.log(abs(strength) / law.low) / math.log(law.high / law.low)


def fake_measure(label, path):
    """A "session" that shows one noisy number an effect: ten at the top of the range."""
    rng = np.random.default_rng(label["session_seed"])
    seen = {name: float(value) for name, value in zip(EFFECTS, rng.standard_normal(len(EFFECTS)), strict=True)}
    strange = float(rng.standard_normal())
    signs = {item["id"]: math.copysign(1.0, item["strength"]) for item in label["effects"]}
    for item in label["effects"]:
        shown = 10.0 * position(item["id"], item["strength"])
        if item["id"] in seen:
            seen[item["id"]] += shown
        else:
            strange += shown
    path.write_text(json.dumps({"seen": seen, "strange": strange, "signs": signs}), encoding="utf-8")


def write_fake_statistics(path, seen):
    """Every effect moves its own number: responses of 1, 5 and 10 at the bottom, middle and top of its range."""
    names, heights = list(EFFECTS), np.array([1.0, 5.0, 10.0])
    curves = []
    for number, name in enumerate(names):
        low, high = LAB[name].low, LAB[name].high
        curves.append(
            CurveKey(
                effect=name,
                variant="",
                sign=1.0,
                since="always",
                low=low,
                high=high,
                strengths=(low, math.sqrt(low * high), high),
                first=3 * number,
            )
        )
    gram = np.kron(np.eye(len(names)), np.outer(heights, heights))
    linear = np.concatenate([heights * seen[name] for name in names])
    statistics = SessionStatistics(
        curves=tuple(curves),
        gram=gram,
        linear=linear,
        chi_square=sum(value**2 for value in seen.values()),
        bare=linear,
        bare_norm=np.tile(heights, len(names)),
        bare_residual=1.0,
        probes=len(names),
        missing=(),
    )
    write_statistics(path, statistics)


def fake_judge(path, without, features_only):
    """Weigh each effect's number as if signals were spread evenly from 0 to 10."""
    shown = json.loads(path.read_text(encoding="utf-8"))
    seen = {name: value for name, value in shown["seen"].items() if name not in without}
    features = {f"seen {name}": value for name, value in shown["seen"].items()} | {"strange": shown["strange"]}
    write_fake_statistics(path.parent / "statistics.npz", shown["seen"])
    if features_only:
        return {"answer": None, "features": features, "code_sha256": "0" * 64}
    signal = np.linspace(0, 10, 101)

    def ratio(value):
        return float(np.mean(np.exp(value * signal - 0.5 * signal**2)))

    weights = {("unknown_effect",): 0.15 * ratio(shown["strange"]), (): 0.35}
    weights |= {(name,): 0.4 / len(seen) * ratio(value) for name, value in seen.items()}
    total = sum(weights.values())
    hypotheses = [
        {"effects": list(effects), "probability": weight / total}
        for effects, weight in sorted(weights.items(), key=lambda item: -item[1])
    ]
    leading = hypotheses[0]["effects"]
    verdict = "no_gap" if not leading else "unknown_effect" if leading == ["unknown_effect"] else "explained"
    causes = []
    for item in hypotheses:
        if item["effects"] and item["effects"] != ["unknown_effect"] and item["probability"] > 0.02:
            law = LAB[item["effects"][0]]
            share, sd = seen[law.id] / 10.0, 0.1 * math.log(law.high / law.low)
            value = shown["signs"].get(law.id, 1.0) * law.low * (law.high / law.low) ** share
            low, high = sorted((value * math.exp(-2 * sd), value * math.exp(2 * sd)))
            strength = {"value": value, "low": low, "high": high, "unit": law.unit}
            causes.append({"effect": law.id, "probability": item["probability"], "parameters": {"strength": strength}})
    answer = {
        "verdict": verdict,
        "causes": causes,
        "hypotheses": hypotheses,
        "probability_no_gap": weights[()] / total,
        "probability_unknown": weights[("unknown_effect",)] / total,
        "gap": {"before": 2.0, "after": 1.1, "floor": 1.0, "shrinks_by": {"value": 0.9, "low": 0.8, "high": 1.0}},
    }
    return {"answer": answer, "features": features, "seconds": 0.5, "peak_memory_MB": 100.0, "code_sha256": "0" * 64}


WORK = Work(measure=fake_measure, judge=fake_judge)


def checked(folder, options, work=WORK, *, development=False, **more):
    seal, cases = begin_check(folder, options, development=development)
    run_check(folder, options, cases, work, **more)
    return seal, open_check(folder, options, cases)


# ---- labels and their seal


def test_labels_follow_from_the_seed_alone_and_a_longer_check_begins_with_the_shorter():
    short = draw_cases(seed=5, stream="case", count=6)
    long = draw_cases(seed=5, stream="case", count=9)
    assert [item.label() for item in long[:6]] == [item.label() for item in short]
    other = draw_cases(seed=6, stream="case", count=6)
    assert {item.session_seed for item in other}.isdisjoint(item.session_seed for item in short)
    training = draw_cases(seed=5, stream="train", count=6)
    assert {item.session_seed for item in training}.isdisjoint(item.session_seed for item in short)


def test_labels_have_the_shares_of_a_blind_check():
    n = 1500
    cases = draw_cases(seed=11, stream="case", count=n)
    for label, expected in LABELS.items():
        share = sum(item.case.label == label for item in cases) / n
        assert abs(share - expected) < 4 * math.sqrt(expected * (1 - expected) / n)
    assert {item.case.geometry for item in cases} == {"fine", "coarse"}
    reduced = sum(item.case.protocol != "full" or bool(item.case.leave_out) for item in cases) / n
    assert abs(reduced - 0.2) < 4 * math.sqrt(0.2 * 0.8 / n)
    planted = {request.id for item in cases for request in item.case.requests}
    assert planted == {name for name, law in LAB.items() if law.drawn}
    onsets = {request.since for item in cases for request in item.case.requests if request.id == "nonlinearity"}
    assert onsets == {"always", "calibration"}
    assert len({item.session_seed for item in cases}) == n


def test_a_label_is_its_case_again():
    for item in draw_cases(seed=12, stream="case", count=40):
        label = json.loads(json.dumps(item.label()))
        assert case_from_label(label).label() == label


def test_the_seal_is_the_hash_of_salt_and_labels_and_of_nothing_else():
    cases = draw_cases(seed=3, stream="case", count=3)
    text = json.dumps({"labels": [item.label() for item in cases], "salt": "ab"}, sort_keys=True, separators=(",", ":"))
    assert seal_of(cases, "ab") == hashlib.sha256(text.encode()).hexdigest()
    assert seal_of(cases, "ac") != seal_of(cases, "ab")
    assert seal_of(cases[:2], "ab") != seal_of(cases, "ab")


def test_sets_stand_for_their_effects():
    assert set(names_of_sets(["A"])) == set(SETS["A"])
    assert names_of_sets(["b", "row_noise"]) == tuple(n for n in LAB if n in {*SETS["B"], "row_noise"})
    assert {name for members in SETS.values() for name in members} <= set(EFFECTS)
    with pytest.raises(InputError, match=r"--only: got F; expected sets A to E or ids: "):
        names_of_sets(["F"])


def test_every_catalogue_effect_of_the_lab_is_one_of_the_diagnosis():
    assert {name for name, law in LAB.items() if law.known} == set(EFFECTS)


# ---- what the diagnosing process may see


def test_nothing_on_disk_tells_a_label_before_all_answers_are_in(tmp_path):
    folder = tmp_path / "check"
    options = BlindOptions(cases=12, seed=FRESH)
    told, names = [], set()

    def judge(path, without, features_only):
        names.add(path.name)
        for place in (folder, path.parent):
            for file in place.rglob("*"):
                if file.is_file() and file != path:
                    text = file.read_bytes() + str(file.relative_to(place)).encode()
                    answered = file.parent.name == "answers"
                    # a hash may hold the digits of the seed by chance
                    plain = re.sub(rb"[0-9a-f]{64}", b"", text)
                    told.extend(
                        f"{file}: {word}"
                        for word in (*LAB, "single", str(FRESH), "session_seed")
                        if not answered and word.encode() in plain
                    )
        assert sorted(item.name for item in path.parent.iterdir()) == ["session.h5"]
        return fake_judge(path, without, features_only)

    checked(folder, options, Work(measure=fake_measure, judge=judge))
    assert not told
    assert names == {"session.h5"}
    labels = json.loads((folder / "labels.json").read_bytes())
    assert len(labels["labels"]) == 12
    assert not (folder / ".private").exists()


@pytest.mark.parametrize(
    ("action", "word"),
    [
        ("import raytwin.lab", "the virtual lab is closed"),
        ("import raytwin.lab.cases", "the virtual lab is closed"),
        ("import subprocess; subprocess.run(['cat', '/dev/null'])", "subprocess.Popen is refused"),
        ("import os; os.system('true')", "os.system is refused"),
        ("open('/proc/1/cmdline')", "belongs to another process"),
        ("import socket; socket.create_connection(('127.0.0.1', 9))", "socket.connect is refused"),
    ],
)
def test_the_diagnosing_process_cannot_look_elsewhere(action, word):
    code = f"from raytwin.campaign.blind_judge import refuse_to_peek; refuse_to_peek(); {action}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert word in done.stderr


def test_what_is_measured_holds_no_truth_and_leaves_none_beside_it(tmp_path):
    label = {
        "stream": "case",
        "index": 0,
        "session_seed": 10**12 + 1,
        "label": "single",
        "effects": [{"id": "row_noise", "strength": 0.5, "since": "always"}],
        "protocol": "short",
        "geometry": "fine",
        "leave_out": [],
    }
    path = tmp_path / "session.h5"
    measure_case(label, path, size=48, frames=4)
    assert [item.name for item in tmp_path.iterdir()] == ["session.h5"]
    content = path.read_bytes()
    for word in (b"row_noise", b"truth", b"strength", str(10**12 + 1).encode()):
        assert word not in content


def test_withheld_effects_are_all_that_the_diagnosis_is_told(tmp_path):
    told = []

    def judge(path, without, features_only):
        told.append((tuple(without), features_only))
        return fake_judge(path, without, features_only)

    options = BlindOptions(cases=6, seed=FRESH, leave_one_out=True, without=("heel",), train_cases=2)
    _, check = checked(tmp_path / "check", options, Work(measure=fake_measure, judge=judge))
    judged = [item for item in check.labels if item["stream"] == "case"]
    assert [item["label"] for item in judged] == ["single"] * 6
    assert told[:6] == [(tuple(dict.fromkeys(("heel", item["effects"][0]["id"]))), False) for item in judged]
    assert told[6:] == [(("heel",), True)] * 2


def test_a_second_day_is_measured_beside_the_first_and_only_for_judged_cases(tmp_path):
    days = []

    def again(label, path):
        days.append((label["stream"], path.name, sorted(item.name for item in path.parent.iterdir())))

    options = BlindOptions(cases=3, seed=FRESH, train_cases=2, second_day=True)
    checked(tmp_path / "check", options, Work(measure=fake_measure, judge=fake_judge, measure_again=again))
    assert days == [("case", "second.h5", ["session.h5"])] * 3


# ---- running, stopping, going on


def test_results_do_not_depend_on_the_number_of_workers(tmp_path):
    options = BlindOptions(cases=14, seed=FRESH, train_cases=12)
    rows = []
    for workers in (1, 4):
        folder = tmp_path / str(workers)
        _, check = checked(folder, options, workers=workers)
        result = score_check(check)
        scores = {key: value for key, value in result.scores.items() if key != "seal_sha256"}
        cases = [{k: v for k, v in row.items() if k != "measured_s"} for row in case_rows(check, result.outcomes)]
        rows.append((scores, cases))
    assert rows[0] == rows[1]


def test_a_stopped_run_goes_on_with_the_same_labels_and_keeps_its_answers(tmp_path):
    folder = tmp_path / "check"
    options = BlindOptions(cases=7, seed=FRESH)
    measured = []

    def measure(label, path):
        if len(measured) == 4:
            raise KeyboardInterrupt
        measured.append(label["index"])
        fake_measure(label, path)

    seal, cases = begin_check(folder, options)
    with pytest.raises(KeyboardInterrupt):
        run_check(folder, options, cases, Work(measure=measure, judge=fake_judge))
    assert sum(answer_path(folder, case).exists() for case in cases) == 4
    assert not (folder / "labels.json").exists()
    kept = {case.index: answer_path(folder, case).read_bytes() for case in cases[:4]}
    left = []
    again, cases = begin_check(folder, options)
    assert again == seal
    run_check(
        folder,
        options,
        cases,
        Work(measure=lambda label, path: (left.append(label["index"]), fake_measure(label, path))[1], judge=fake_judge),
    )
    assert left == [4, 5, 6]
    check = open_check(folder, options, cases)
    assert all(answer_path(folder, case).read_bytes() == kept[case.index] for case in cases[:4])
    _, whole = checked(tmp_path / "whole", options)
    timed = ("measured_s",)
    for one, other in zip(check.answers, whole.answers, strict=True):
        assert {k: v for k, v in one.items() if k not in timed} == {k: v for k, v in other.items() if k not in timed}


def test_a_finished_check_is_scored_again_without_measuring(tmp_path):
    folder = tmp_path / "check"
    options = BlindOptions(cases=5, seed=FRESH)
    seal, first = checked(folder, options)

    def never(*_):
        raise AssertionError("measured again")

    again, second = checked(folder, options, Work(measure=never, judge=never))
    assert again == seal
    assert first.answers == second.answers


def test_other_options_are_refused(tmp_path):
    folder = tmp_path / "check"
    checked(folder, BlindOptions(cases=3, seed=FRESH))
    for other in (
        BlindOptions(cases=4, seed=FRESH),
        BlindOptions(cases=3, seed=FRESH + 1),
        BlindOptions(cases=3, seed=FRESH, size=64),
        BlindOptions(cases=3, seed=FRESH, without=("heel",)),
    ):
        with pytest.raises(InputError, match=r"a check with other options; .*repeat them, or take another folder"):
            begin_check(folder, other)


def test_a_failed_case_is_recorded_and_counted_against_us(tmp_path):
    folder = tmp_path / "check"
    options = BlindOptions(cases=20, seed=FRESH)

    def judge(path, without, features_only):
        shown = json.loads(path.read_text(encoding="utf-8"))
        if shown["strange"] > 1.0:
            raise RuntimeError("blind_judge: ended by SIGKILL")
        return fake_judge(path, without, features_only)

    _, check = checked(folder, options, Work(measure=fake_measure, judge=judge))
    failed = [answer for answer in check.answers if answer["error"]]
    assert failed
    assert {answer["error"] for answer in failed} == {"blind_judge: ended by SIGKILL"}
    result = score_check(check)
    cases = result.scores["scores"]["cases"]
    assert cases["all"] == 20
    assert cases["failed"] == len(failed)
    for outcome in result.outcomes:
        if outcome.error:
            assert not outcome.leading_right
            assert outcome.leading_probability == 1.0
            assert not outcome.expected <= outcome.named


def test_answers_changed_after_the_opening_are_noticed(tmp_path):
    folder = tmp_path / "check"
    options = BlindOptions(cases=3, seed=FRESH)
    checked(folder, options)
    _, cases = begin_check(folder, options)
    path = answer_path(folder, cases[1])
    path.write_text(path.read_text(encoding="utf-8").replace('"error":""', '"error":" "'), encoding="utf-8")
    with pytest.raises(InputError, match=r"case_00001\.json: not those that were closed before the labels were opened"):
        open_check(folder, options, cases)
    path.unlink()
    with pytest.raises(InputError, match=r"answers closed, 1 of them gone"):
        run_check(folder, options, cases, WORK)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("answers/case_00001.npz", lambda text: text[:50], r"case_00001\.npz: not those that were closed"),
        ("answers/case_00001.npz", None, r"case_00001\.npz: not those that were closed"),
        ("answers.json", lambda text: text[:50], r"answers\.json: got no JSON object; .*put the file back"),
        ("answers.json", lambda text: b"{}", r"answers\.json: got no answers in it"),
        ("seal.json", lambda text: b"{}", r"seal\.json: got no sha256 in it"),
        ("labels.json", None, r"a seal without its salt; .*labels\.json afterwards; begin again in another folder"),
        ("labels.json", lambda text: b"{}", r"labels\.json: got no salt in it"),
        ("labels.json", lambda text: text.replace(b'th":', b'th":1', 1), r"labels\.json: .*expected the labels that were sealed"),
    ],
)  # fmt: skip
def test_what_a_finished_check_left_is_known_to_be_untouched(tmp_path, name, change, message):
    folder = tmp_path / "check"
    options = BlindOptions(cases=3, seed=FRESH)
    checked(folder, options)
    path = folder / name
    before = path.read_bytes()
    path.unlink()
    if change is not None:
        path.write_bytes(change(before))
        assert path.read_bytes() != before
    with pytest.raises(InputError, match=message) as caught:
        checked(folder, options)
    assert "\n" not in str(caught.value)
    path.write_bytes(before)
    checked(folder, options)


def test_answers_closed_without_their_inner_products_as_once_are_still_taken(tmp_path):
    folder = tmp_path / "check"
    options = BlindOptions(cases=3, seed=FRESH)
    checked(folder, options)
    closed = json.loads((folder / "answers.json").read_text(encoding="utf-8"))
    assert sum(name.endswith(".npz") for name in closed["answers"]) == 3
    closed["answers"] = {name: value for name, value in closed["answers"].items() if name.endswith(".json")}
    (folder / "answers.json").write_text(json.dumps(closed), encoding="utf-8")
    checked(folder, options)


def test_a_process_that_a_signal_ended_is_tried_once_more_and_one_that_failed_is_not(tmp_path, monkeypatch):
    asked = []

    def ends(*errors):
        left = list(errors)

        def run(self, module, words, **options):
            asked.append(module)
            if left:
                raise left.pop(0)

        monkeypatch.setattr(Children, "run", run)
        asked.clear()

    work = Processes(BlindOptions(cases=1, seed=FRESH))
    killed = KilledError("ended by SIGKILL")
    ends(killed)
    work.measure({}, tmp_path / "session.h5")
    assert asked == ["blind_measure"] * 2
    ends(killed, killed)
    with pytest.raises(RuntimeError, match=r"^blind_measure: ended by SIGKILL$"):
        work.measure({}, tmp_path / "session.h5")
    ends(ChildError("InputError: no"))
    with pytest.raises(RuntimeError, match=r"^blind_measure: InputError: no$"):
        work.measure({}, tmp_path / "session.h5")
    assert asked == ["blind_measure"]


def test_a_changed_seal_is_noticed(tmp_path):
    folder = tmp_path / "check"
    options = BlindOptions(cases=3, seed=FRESH)
    seal, _ = begin_check(folder, options)
    page = (folder / "seal.json").read_text(encoding="utf-8")
    (folder / "seal.json").write_text(page.replace(seal, "0" * 64), encoding="utf-8")
    with pytest.raises(InputError, match="sealed with other labels"):
        begin_check(folder, options)


def test_labels_are_not_opened_while_an_answer_is_missing(tmp_path):
    folder = tmp_path / "check"
    options = BlindOptions(cases=3, seed=FRESH)
    _, cases = begin_check(folder, options)
    with pytest.raises(InputError, match="3 cases without an answer"):
        open_check(folder, options, cases)
    assert not (folder / "labels.json").exists()


def test_two_runs_do_not_work_in_one_folder(tmp_path):
    folder = tmp_path / "check"
    options = BlindOptions(cases=1, seed=FRESH)
    _, cases = begin_check(folder, options)
    entered, leave = threading.Event(), threading.Event()

    def slow(label, path):
        entered.set()
        leave.wait(20)
        fake_measure(label, path)

    first = threading.Thread(target=run_check, args=(folder, options, cases, Work(measure=slow, judge=fake_judge)))
    first.start()
    try:
        assert entered.wait(20)
        with pytest.raises(InputError, match="where a check is running"):
            run_check(folder, options, cases, WORK)
    finally:
        leave.set()
        first.join()


def test_sessions_are_thrown_away_unless_they_are_to_be_kept(tmp_path):
    options = BlindOptions(cases=3, seed=FRESH)
    checked(tmp_path / "thrown", options)
    assert not list((tmp_path / "thrown").rglob("*.h5"))
    checked(tmp_path / "kept", options, keep_sessions=True)
    assert len(list((tmp_path / "kept" / "sessions").glob("case_*.h5"))) == 3


# ---- the code that answers


def test_the_frozen_code_is_the_package_and_is_what_runs(tmp_path):
    frozen = freeze_code(tmp_path / "code")
    assert code_digest(frozen / "raytwin") == code_digest()
    check_frozen_code(frozen)
    changed = frozen / "raytwin" / "diagnosis" / "diagnose_session.py"
    changed.write_text("import nothing_of_that_name\n" + changed.read_text(encoding="utf-8"), encoding="utf-8")
    assert code_digest(frozen / "raytwin") != code_digest()
    with pytest.raises(RaytwinError, match=r"cannot be imported: ModuleNotFoundError: .*nothing_of_that_name"):
        check_frozen_code(frozen)


def test_a_check_goes_on_with_the_code_that_it_was_begun_with(tmp_path):
    folder = tmp_path / "check"
    begin_check(folder, BlindOptions(cases=1, seed=FRESH))
    with pytest.raises(KeyboardInterrupt), frozen_code(folder) as first:
        raise KeyboardInterrupt
    (folder / "answers").mkdir()
    (folder / "answers" / "case_00000.json").write_text("{}", encoding="utf-8")
    with frozen_code(folder) as second:
        assert second == first
        assert (second / "raytwin" / "lab" / "cases.py").exists()
    assert not second.exists()
    page = json.loads((folder / "seal.json").read_text(encoding="utf-8"))
    page["code_sha256"] = "f" * 64
    (folder / "seal.json").write_text(json.dumps(page), encoding="utf-8")
    with pytest.raises(InputError, match=r"begun with other code; .*hash to ffffffffffff"), frozen_code(folder):
        pass


# ---- seeds


def test_development_seeds_are_refused_unless_they_are_said_to_be(tmp_path):
    seed = development_seeds()[0][0]
    assert is_development_seed(seed)
    assert not is_development_seed(FRESH)
    options = BlindOptions(cases=2, seed=seed)
    with pytest.raises(
        InputError, match=r"--seed: got 0; .*development_seeds\.md\); take another, or say --development"
    ):
        begin_check(tmp_path / "check", options)
    _, check = checked(tmp_path / "check", options, development=True)
    result = score_check(check)
    assert result.scores["development_seed"]
    assert summary_text(result).startswith("This seed was used while the diagnosis was developed")


def test_the_documented_seeds_are_those_that_are_refused():
    import tomllib

    table = tomllib.loads((ROOT / "campaign" / "development_seeds.toml").read_text(encoding="utf-8"))
    page = (ROOT / "docs" / "notebook" / "development_seeds.md").read_text(encoding="utf-8")
    for command, key in (("raytwin lab --seed", "lab"), ("raytwin blind-check --seed", "blind_check")):
        line = next(line for line in page.splitlines() if line.startswith(f"| `{command}`"))
        cell = line.split("|")[2]
        assert [[int(a), int(b or a)] for a, b in re.findall(r"(\d+)(?: to (\d+))?", cell)] == table[key]


# ---- bad input


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-n", "0", "--seed", "500"], "-n: got 0; expected a whole number of 1 or more"),
        (["-n", "2", "--seed", "-1"], "--seed: got -1; expected a whole number of 0 or more"),
        (["-n", "2", "--seed", "500", "--size", "20"], "--size: got 20; expected 48 to 4096 pixels"),
        (["-n", "2", "--seed", "500", "--frames", "1"], "--frames: got 1; expected 4 or more"),
        (["-n", "2", "--seed", "500", "--without", "magic"], "--without: got magic; expected one of "),
        (["-n", "2", "--seed", "500", "--only", "Q"], "--only: got Q; expected sets A to E or ids"),
        (["-n", "2", "--seed", "500", "--workers", "0"], "--workers: got 0; expected 1 or more"),
        (["-n", "2", "--seed", "42"], "--seed: got 42; expected a seed that was not used"),
    ],
)
def test_bad_options_are_one_line_and_leave_nothing_behind(tmp_path, refused_line, words, message):
    assert message in refused_line("blind-check", *words, "-o", tmp_path / "check")
    assert not (tmp_path / "check").exists()


def test_a_folder_with_other_things_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match="with other files; expected an empty folder"):
        begin_check(tmp_path, BlindOptions(cases=2, seed=FRESH))
    with pytest.raises(InputError, match=r"notes\.txt, a file; expected a folder"):
        begin_check(tmp_path / "notes.txt", BlindOptions(cases=2, seed=FRESH))


# ---- the whole, with a fake diagnosis whose skill is known


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    folder = tmp_path_factory.mktemp("many") / "check"
    options = BlindOptions(
        cases=300, seed=FRESH, train_cases=172
    )  # seven sessions and more of each effect to learn from
    _, check = checked(folder, options)
    return check, score_check(check)


@pytest.mark.slow
def test_an_honest_fake_diagnosis_scores_as_it_should(many):
    _, result = many
    scores = result.scores["scores"]
    single = [item for item in result.outcomes if item.label == "single"]
    strong = [item for item in single if position(item.truth[0], item.strengths[item.truth[0]]) > 0.6]
    assert sum(item.top1 in item.truth for item in strong) >= 0.9 * len(strong)
    weak = [item for item in single if position(item.truth[0], item.strengths[item.truth[0]]) < 0.15]
    assert sum(item.top1 in item.truth for item in weak) <= 0.5 * len(weak)
    # pairs are no hypotheses of the fake: leave them out where honesty is judged
    honest = score_pairless(result)
    assert honest["leading_hypothesis"]["error"] < 2.0 * honest["leading_hypothesis"]["error_if_honest"]["p95"]
    assert scores["none"]["false_alarms"]["share"] < 0.25
    assert scores["unknown"]["auroc"]["value"] > 0.85
    assert scores["pairs"]["both_named"]["hits"] <= 0.2 * scores["pairs"]["both_named"]["n"]
    # weak effects are named where noise lifts them: coverage is honest for the strong ones alone
    held = strength_scores(strong)["named"]["coverage_95"]
    assert held["low"] <= 0.9545 <= held["high"]


def score_pairless(result):
    return compute_scores([item for item in result.outcomes if item.label != "pair"], tuple(EFFECTS))


@pytest.mark.slow
def test_baselines_that_learn_beat_the_commonest_and_are_not_the_diagnosis(many):
    _, result = many
    baselines = result.scores["baselines"]
    assert set(baselines) == {"commonest", "nearest_template", "matched_filter", "nearest_signature", "classifier"}
    always = baselines["commonest"]
    assert always["exact"]["all"]["hits"] == sum(item.label == "none" for item in result.outcomes)
    assert always["none"]["false_alarms"]["hits"] == 0
    assert always["unknown"]["auroc"]["value"] == pytest.approx(0.5)
    for name in ("nearest_signature", "classifier"):
        assert baselines[name]["top1"]["single"]["share"] > always["top1"]["single"]["share"] + 0.15
    assert baselines["classifier"]["leading_hypothesis"]["brier"] < 0.25


@pytest.mark.slow
def test_the_table_and_the_page_hold_every_case_and_nothing_from_outside(many, tmp_path):
    check, result = many
    rows = case_rows(check, result.outcomes)
    write_cases(tmp_path / "cases.csv", rows)
    lines = (tmp_path / "cases.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 301
    page = write_report(result, rows, tmp_path / "report.html", version="0").read_text(encoding="utf-8")
    planted = {name for item in result.outcomes for name in item.truth}
    assert page.count('download="limit_') == len(planted & set(EFFECTS))
    names = ("accuracy", "accuracy_of_baselines", "reliability_leading_hypothesis", "strengths", "unknown")
    assert all(page.count(f'download="{name}.csv"') == 1 for name in names)
    assert sum(int(row[1]) for row in confusion_table(result.outcomes).rows) == sum(
        item.label != "pair" for item in result.outcomes
    )
    assert sum(int(one) for row in verdict_table(result.outcomes).rows for one in row[1:]) == 300
    assert check.seal in page
    assert summary_text(result).startswith("300 sealed sessions of the virtual lab were diagnosed")


@pytest.mark.slow
def test_a_page_is_written_for_a_single_case_too(tmp_path):
    _, check = checked(tmp_path / "check", BlindOptions(cases=1, seed=FRESH))
    result = score_check(check)
    page = write_report(result, case_rows(check, result.outcomes), tmp_path / "report.html", version="0")
    assert "1 sealed sessions" in page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_three_small_sessions_end_to_end(tmp_path, capsys):
    folder = tmp_path / "check"
    words = [
        "blind-check",
        "-n",
        "2",
        "--seed",
        "500",
        "-o",
        str(folder),
        "--size",
        "48",
        "--frames",
        "6",
        "--development",
        "--json",
    ]
    assert main([*words, "--train-cases", "1", "--only", "E"]) == 0
    printed = capsys.readouterr()
    scores = json.loads(printed.out)
    assert printed.err.startswith(f"sealed: 3 labels, sha256 {scores['seal_sha256']}")
    assert json.loads((folder / "scores.json").read_text(encoding="utf-8")) == scores
    sealed = (folder / "labels.json").read_bytes()
    assert hashlib.sha256(sealed).hexdigest() == scores["seal_sha256"]
    assert scores["scores"]["cases"]["all"] == 2
    assert len(scores["code_versions"]) == 1
    assert scores["statistics_errors"] == []
    assert "data:image/png;base64," in (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.browser
def test_the_page_fits_asks_nobody_and_draws_its_figures(many, tmp_path, check_page):
    check, result = many
    check_page(write_report(result, case_rows(check, result.outcomes), tmp_path / "report.html", version="0"))
