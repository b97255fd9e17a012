"""`raytwin pod`, `compare` and `plan`: the answers' fields, exit codes, one line for each mistake."""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

import raytwin as rt
from raytwin.cli import main

EXAMPLES = Path(__file__).parent / "pod_examples"

POD_FIELDS = {
    "link", "method", "n", "n_hits", "c0", "c1", "se0", "se1", "deviance", "a50", "a90", "a90_95", "a90_95_two_sided",
    "separated", "reaches_90", "warnings",
}  # fmt: skip


def answer_of(capsys, *words: str):
    assert main(list(words)) == 0
    captured = capsys.readouterr()
    return json.loads(captured.out)


def write_hits(path: Path, seed: int, *, shift: float = 1.0, networks: int = 6, images: int = 50) -> Path:
    random = np.random.default_rng(1)
    contrast = random.uniform(0.02, 0.3, images)
    effects = random.normal(0, 0.4, networks)[:, None] + random.normal(0, 0.6, images)[None]
    random = np.random.default_rng(seed)
    hit = random.random((networks, images)) < -np.expm1(-np.exp(-2.5 + 25 / shift * contrast + effects))
    lines = ["contrast,size_mm,hit,network,image,foreign_object,setting,false_alarm"]
    for n in range(networks):
        lines += [
            f"{contrast[i]:.5f},{20 * contrast[i] + i % 3:.3f},{hit[n, i]:d},n{n},i{i},bone,20ms,"
            for i in range(images)
        ]
        lines += [f",,,n{n},empty{i},,20ms,{int((n + i) % 4 == 0)}" for i in range(3)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_pod_answer_holds_what_is_fixed(capsys):
    result = answer_of(capsys, "pod", str(EXAMPLES / "hdbk_ex4.csv"), "--json")
    assert set(result) >= POD_FIELDS
    assert {"likelihood_ratio", "wald"} <= set(result["a90_95"])
    assert result["link"] == "cloglog"
    assert result["method"] == "ml"
    assert (result["n"], result["n_hits"]) == (100, 61)
    assert round(result["a90_95_two_sided"]["likelihood_ratio"], 4) == 0.1553
    assert result["separated"] is False
    assert result["reaches_90"] is True
    assert result["warnings"] == []


def test_grouped_trials_and_links(capsys):
    words = ["pod", str(EXAMPLES / "beetle_bliss.csv"), "--size", "log10_dose", "--hit", "killed", "--trials", "n"]
    result = answer_of(capsys, *words, "--link", "probit", "--json")
    assert round(result["deviance"], 2) == 10.12
    assert (result["n"], result["n_hits"]) == (481, 291)
    assert result["alternatives"][0]["link"] == "cloglog"


def test_handbook_scaling_and_the_warning_where_repeats_are_not_heeded(capsys):
    words = ["pod", str(EXAMPLES / "hdbk_ex5.csv"), "--link", "logit", "--log-size", "--site", "target"]
    result = answer_of(capsys, *words, "--repeats", "scaled", "--json")
    assert round(result["a90_95_two_sided"]["likelihood_ratio"], 4) == 0.2621
    assert round(result["naive"]["a90_95_two_sided"]["likelihood_ratio"], 4) < 0.23
    pooled = answer_of(capsys, *words, "--json")
    assert any("933 trials of 311 sites taken as independent" in note for note in pooled["warnings"])


def test_response_against_size(capsys, tmp_path):
    words = ["pod", str(EXAMPLES / "hdbk_ex1_ahat.csv"), "--response", "ahat", "--decision", "200", "--log-size"]
    words += ["--left-censored", "50", "--right-censored", "1375"]
    result = answer_of(capsys, *words, "--plots", str(tmp_path), "--json")
    assert set(result) >= POD_FIELDS
    assert round(result["a90"], 2) == 12.69
    assert round(result["a90_95"]["wald"], 2) == 13.68
    assert (tmp_path / "response.png").stat().st_size > 4000


def test_repeated_looks_are_crossed_by_default_and_false_alarms_counted(capsys, tmp_path):
    table = write_hits(tmp_path / "HITS.csv", 2)
    result = answer_of(capsys, "pod", str(table), "--json")
    assert result["repeats"] == "crossed"
    assert result["size"] == "contrast"
    assert result["n"] == 300
    assert result["sd_image"] > 0
    assert result["a90_conditional"] < result["a90"]
    assert result["naive"]["a90_95"]["likelihood_ratio"] < result["a90_95"]["likelihood_ratio"]
    assert result["false_alarms"]["n"] == 18
    assert main(["pod", str(table)]) == 0
    text = capsys.readouterr().out
    assert "if looks were independent" in text
    assert "false alarms" in text


@pytest.mark.slow
def test_every_further_option_adds_its_part(capsys, tmp_path):
    table = write_hits(tmp_path / "HITS.csv", 3)
    words = ["pod", str(table), "--repeats", "cluster", "--ceiling", "--floor", "--bootstrap", "50", "--as-published"]
    words += ["--covariate", "size_mm", "--explain", "contrast,size_mm", "--where", "setting=20ms"]
    words += ["--export", str(tmp_path / "curve.csv"), "--plots", str(tmp_path / "figures")]
    result = answer_of(capsys, *words, "--json")
    assert {"lapse", "bootstrap", "covariates", "explanation", "as_published", "plots", "export"} <= set(result)
    assert result["bootstrap"]["by"] == "both"
    assert result["explanation"][0]["name"] == "contrast"
    assert result["covariates"]["held"]["size_mm"] > 0
    assert all(Path(path).exists() for path in result["plots"])
    assert (tmp_path / "curve.csv").read_text().startswith("contrast,pod,")
    assert result["lapse"]["ceiling"]["value"] > 0.5
    assert result["lapse"]["ceiling"]["low"] is result["lapse"]["a90_95"] is None
    assert any("values without intervals" in note for note in result["warnings"])
    again = answer_of(capsys, *words, "--json")
    assert again["bootstrap"] == result["bootstrap"]
    assert main(words) == 0
    assert "as published" in capsys.readouterr().out


def test_what_the_data_cannot_support_is_null_with_a_reason(capsys, tmp_path):
    path = tmp_path / "t.csv"
    for text, words in (
        ("size,hit\n" + "".join(f"{k},1\n" for k in range(1, 30)), "every trial is a hit"),
        ("size,hit\n" + "".join(f"{k},0\n" for k in range(1, 30)), "every trial is a miss"),
        ("size,hit\n" + "".join(f"2,{k % 2}\n" for k in range(30)), "same size"),
    ):
        path.write_text(text)
        result = answer_of(capsys, "pod", str(path), "--json")
        assert result["a90"] is None
        assert result["a90_95"] == {"likelihood_ratio": None, "wald": None, "modified": None}
        assert any(words in note for note in result["warnings"])


def test_separated_data_say_so(capsys, tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("size,hit\n1,0\n2,0\n3,0\n4,1\n5,1\n6,1\n")
    result = answer_of(capsys, "pod", str(path), "--json")
    assert result["separated"] is True
    assert result["method"] == "firth"
    assert result["warnings"]
    result = answer_of(capsys, "pod", str(path), "--method", "ml", "--json")
    assert result["a90"] is None


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("size,hit\n1,1\n2,0\n", ["--size", "siz"], "did you mean size?"),
        ("size,hit\n1,1\ninf,0\n", [], "line 3: got 'inf'"),
        ("size,hit\n1,1\n2,0,3,4,5\n", [], "got 5 columns; expected 2"),
        ("size,hit\n1,1\n2,3\n", [], "counts of hits need trials=... (--trials)"),
        ("size,hit\n1,1\n2,0\n", ["--where", "hit"], "expected COLUMN=VALUE"),
        ("size,hit\n1,1\n2,0\n", ["--decision", "3"], "--decision: got without a response"),
        ("size,r\n1,1\n2,0\n", ["--response", "r"], "for example --decision 200"),
        ("size,r\n1,1\n2,0\n", ["--response", "r", "--decision", "1", "--box-cox", "big"], "expected a number or auto"),
        ("size,hit\n1,1\n2,0\n", ["--bootstrap", "3"], "20 refits or more"),
        ("size,hit\n-1,1\n2,0\n", ["--log-size"], "sizes above 0"),
        ("size,hit\n1,1\n2,0\n", ["--repeats", "scaled"], "name its column: site=... (--site)"),
        ("size,hit\n1,1\n2,0\n", ["--link", "log"], "invalid choice"),
        ("size,hit\n1,1\n2,0\n", ["--covariate", "size=1"], "another property than the size"),
    ],
)
def test_each_mistake_ends_with_2_and_one_line(capsys, tmp_path, text, options, words):
    path = tmp_path / "t.csv"
    path.write_text(text)
    try:
        code = main(["pod", str(path), *options])
    except SystemExit as stop:
        code = stop.code
    captured = capsys.readouterr()
    assert code == 2
    assert captured.out == ""
    assert words in captured.err
    assert captured.err.count("\n") == 1


def test_compare_says_equivalent_different_and_paired(capsys, tmp_path):
    real, same = write_hits(tmp_path / "real.csv", 4), write_hits(tmp_path / "same.csv", 5)
    worse = write_hits(tmp_path / "worse.csv", 6, shift=1.5)
    words = ["compare", str(real), str(same), "--repeats", "cluster", "--margin", "0.3"]
    result = answer_of(capsys, *words, "--json")
    assert result["verdict"] == result["equivalence"]["verdict"] == "equivalent"
    assert result["margin"] == 0.3
    assert result["paired"] == "image and network"
    assert result["difference_a90"]["low"] < result["difference_a90"]["value"] < result["difference_a90"]["high"]
    apart = answer_of(capsys, *words, "--unpaired", "--json")
    assert apart["paired"] == "nothing"
    words[2] = str(worse)
    result = answer_of(capsys, *words, "--plots", str(tmp_path), "--json")
    assert result["verdict"] == "different"
    test = result["curve_test"]
    assert test["p"] < 0.05
    assert (tmp_path / "compare.png").exists()
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "different" in printed
    # p belongs to the statistic that is printed beside it
    assert test["p"] == pytest.approx(scipy.stats.f.sf(test["statistic"], 2, test["denominator_degrees"]))
    assert f"F {test['statistic']:.3g} on 2 and {test['denominator_degrees']}, p = {test['p']:.3g}" in printed


def test_compare_by_default_takes_the_effects_of_both(capsys, tmp_path):
    one, two = (write_hits(tmp_path / f"{k}.csv", k, networks=4, images=30) for k in (7, 8))
    result = answer_of(capsys, "compare", str(one), str(two), "--json")
    assert result["repeats"] == "crossed"
    assert result["first"]["sd_image"] is not None


def test_compare_refuses_different_sizes(refused_line, tmp_path):
    one, two = tmp_path / "one.csv", tmp_path / "two.csv"
    one.write_text("size,hit\n1,1\n2,0\n")
    two.write_text("contrast,hit\n1,1\n2,0\n")
    assert "the same size column in both tables" in refused_line("compare", one, two)


@pytest.mark.parametrize("margin", ["1", "10", "0", "nan"])
def test_a_margin_is_a_share_below_1(capsys, tmp_path, margin):
    path = write_hits(tmp_path / "a.csv", 7)
    assert main(["compare", str(path), str(path), "--margin", margin]) == 2
    assert "--margin: got" in (told := capsys.readouterr().err) and "0.1 is 10 %" in told


def test_a_size_far_from_all_others_is_named(refused_line, tmp_path):
    told = "the size 1e+12 in line 62 lies far from all others, "
    rng = np.random.default_rng(0)
    size = rng.uniform(0.5, 4, 60)
    hit = (rng.random(60) < 1 / (1 + np.exp(-3 * (size - 2)))).astype(int)
    path = tmp_path / "far.csv"
    path.write_text("size,hit\n" + "".join(f"{a},{b}\n" for a, b in zip(size, hit, strict=True)) + "1e12,1\n")
    assert f"error: no curve fits the table: {told}" in refused_line("pod", path)
    # where a fit ends all the same, it is a warning; on the logarithm a far size is one of many
    assert any(told in line for line in rt.fit_pod(path, method="firth").warnings)
    assert not any(told in line for line in rt.fit_pod(path, log_size=True).warnings)


def test_what_cannot_be_compared_or_shown_says_what_is_taken(refused_line, tmp_path):
    grouped, hits = tmp_path / "grouped.csv", write_hits(tmp_path / "a.csv", 7)
    grouped.write_text("contrast,hit,n\n1,2,10\n2,5,10\n3,9,10\n")
    told = refused_line("compare", hits, grouped)
    assert "name the column of trials (trials, --trials)" in told and "--response" not in told
    told = refused_line("report", grouped, "-o", tmp_path / "page.html")
    assert "`raytwin pod TABLE.csv --report PAGE.html`" in told and "--trials" not in told
    size = np.linspace(1, 4, 30)
    curve = rt.fit_pod({"size": size, "ahat": size + 0.1 * np.sin(9 * size)}, response="ahat", decision=2)
    with pytest.raises(rt.InputError, match="second: got a continuous response; expected hits and misses"):
        rt.compare(rt.fit_pod({"size": size, "hit": (np.sin(9 * size) + size > 2).astype(int)}), curve)


def test_a_small_plan_says_that_it_is_for_large_samples(capsys):
    words = ["plan", "--a50", "1", "--a90", "2", "--images"]
    assert main([*words, "20"]) == 0
    captured = capsys.readouterr()
    assert "with 20 images, fewer than some 40, hits and misses may separate" in captured.err
    assert "1 network, 20 images" in captured.out
    assert main([*words, "60"]) == 0
    assert capsys.readouterr().err == ""


def test_plan_answers_with_images_sizes_and_limits(capsys, tmp_path):
    words = ["plan", "--a50", "1.5", "--a90", "3", "--sd-network", "0.4", "--sd-image", "0.8", "--networks", "10"]
    result = answer_of(capsys, *words, "--wanted", "1.15", "--json")
    assert result["images"] == len(result["sizes"]) > 5
    assert result["expected"]["bound_over_a90"] == pytest.approx(1.15, abs=0.03)
    few = answer_of(capsys, *words[:-1], "2", "--wanted", "1.02", "--json")
    assert few["images"] is None
    assert any("it takes at least" in note for note in few["warnings"])
    table = write_hits(tmp_path / "HITS.csv", 2)
    pilot = answer_of(capsys, "plan", "--pilot", str(table), "--images", "60", "--networks", "6", "--json")
    assert pilot["assumed"]["sd_image"] > 0
    assert pilot["expected"]["images"] == 60
    assert main(["plan", "--a50", "1"]) == 2
    assert main([*words, "--wanted", "1.15"]) == 0
    assert "expected a90/95" in capsys.readouterr().out


def test_a_pilot_whose_pod_does_not_rise_says_so(refused_line, tmp_path):
    lines = ["size,hit", *(f"{size},{int(size < 4)}" for size in (1, 2, 3, 4, 5, 6)), "5,1", "2,0"]
    (tmp_path / "pilot.csv").write_text("\n".join(lines) + "\n")
    line = refused_line("plan", "--pilot", tmp_path / "pilot.csv")
    assert "a table of 8 trials in which POD does not rise with size; expected a pilot with" in line
