"""`raytwin sweep`: what is printed before and after, bad input in one line, a folder that holds the answer."""

import json

import pytest

from raytwin.cli import main

CAMPAIGN = """
twin = "twin.h5"
references = "references.h5"
test_share = 0.4
[grid]
low_kv = 40
high_kv = 90
filter = "Cu:0.05"
power_w = 40
exposure_ms = [50, 20]
[limits]
minimum_throughput_per_s = 15
[training]
networks = 1
images = 6
steps = 1
batch = 2
start_steps = 0
[contrast]
product = "chicken_breast:10"
object = "rib_bone:2"
"""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory, make_sweep_line):
    """A campaign file with its twin and references of 64 x 64 pixels."""
    folder = make_sweep_line(tmp_path_factory.mktemp("sweep"))
    (folder / "campaign.toml").write_text(CAMPAIGN)
    return folder / "campaign.toml"


def test_plan_trains_nothing_and_tells_what_is_known_before(campaign, capsys, json_of):
    answer = json_of("sweep", campaign, "--plan")
    assert (answer["settings"], answer["feasible"], answer["to_train"]) == (2, 1, 1)
    slow, fast = answer["rows"]
    assert "asked for are 15 products/s" in slow["reason"] and not slow["kept"]
    assert fast["kept"] and fast["cnr_object"] > 0
    assert fast["throughput_per_s"] == pytest.approx(1000 / 44)
    assert main(["sweep", str(campaign), "--plan"]) == 0
    text = capsys.readouterr().out
    assert "2 settings, 1 feasible, 1 to train" in text and "22.7" in text


def test_references_that_leave_nothing_to_try_are_refused_by_plan_and_run_alike(campaign, refused_line, tmp_path):
    untried = campaign.with_name("untried.toml")
    untried.write_text(CAMPAIGN.replace("test_share = 0.4", "test_share = 0"))
    for words in (["--plan"], ["-o", str(tmp_path / "sweep")]):
        assert "got 0 images to try networks on" in refused_line("sweep", untried, *words)
    assert not (tmp_path / "sweep").exists()


@pytest.mark.slow
def test_a_sweep_writes_its_answer_and_prints_the_same_rows_with_their_time(campaign, capsys, tmp_path):
    folder = tmp_path / "sweep"
    words = ["sweep", str(campaign), "-o", str(folder), "--json"]
    assert main(words) == 0
    printed = capsys.readouterr()
    answer, held = json.loads(printed.out), json.loads((folder / "sweep.json").read_text())
    assert "[1/1] 20 ms:" in printed.err
    seconds = [row.pop("seconds") for row in answer["rows"]]
    assert seconds[0] is None and seconds[1] > 0
    assert {key: value for key, value in answer.items() if key != "paths"} == held
    page = (folder / "report.html").read_text()
    assert held["sentence"].split(":")[0] in page and "20 ms" in page and "50 ms" in page
    # once more: nothing is left to do, and people get a table
    assert main(words[:-1]) == 0
    printed = capsys.readouterr()
    assert "1 of 1 settings are done already" in printed.err
    assert "report:" in printed.out and held["sentence"] in printed.out
    assert json.loads((folder / "sweep.json").read_text()) == held


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["absent.toml", "--plan"], "absent.toml: got no such file"),
        (["CAMPAIGN"], "-o: got none; expected a folder for the sweep, or --plan"),
        (["CAMPAIGN", "-o", "X", "--workers", "0"], "--workers: got 0"),
        (["CAMPAIGN", "-o", "X", "--threads", "-1"], "--threads: got -1"),
        (["CAMPAIGN", "-o", "X", "--device", "abacus"], "device: got abacus"),
        (["CAMPAIGN", "-o", "CAMPAIGN"], "-o: got"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(campaign, refused_line, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    error = refused_line("sweep", *(campaign if word == "CAMPAIGN" else word for word in words))
    assert message in error
    assert len(error.strip().splitlines()) == 1
    assert not (tmp_path / "X").exists()


def test_workers_and_scheduler_exclude_each_other(campaign, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["sweep", str(campaign), "-o", "X", "--workers", "2", "--scheduler", "tcp://localhost:1"])
    assert stop.value.code == 2
    assert "not allowed with" in capsys.readouterr().err
