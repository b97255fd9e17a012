"""Scores of a blind check against closed forms and independent software."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import mannwhitneyu
from statsmodels.stats.proportion import proportion_confint

from raytwin.campaign.blind_baselines import (
    Example,
    answered,
    classes_of,
    commonest,
    example_of,
    fit_logistic,
    fit_signatures,
    fit_template_rule,
    targets_of,
)
from raytwin.campaign.blind_scores import (
    FAILED,
    NONE,
    UNKNOWN,
    Outcome,
    auroc,
    by_sigma,
    calibration,
    compute_scores,
    confusion,
    confusion_by_set,
    outcome_of,
    share,
    strength_scores,
    top1_right,
    wilson_interval,
    withheld_scores,
)
from raytwin.campaign.blind_second_day import shrinkage
from raytwin.campaign.blind_separation import Separation, matched_filter, separation_of
from raytwin.campaign.blind_statistics import (
    CurveKey,
    SessionStatistics,
    read_statistics,
    session_statistics,
    write_statistics,
)
from raytwin.diagnosis.inference.observed import Point
from raytwin.diagnosis.model.changes import Variant
from raytwin.diagnosis.model.curves import Curve
from raytwin.diagnosis.problem.problem import Problem
from raytwin.generator.effects import EFFECTS


def outcome(label, truth=(), *, verdict, named=(), p=None, sigma=None, **more):
    """An opened case; `p` are probabilities by effect."""
    p = dict(p or dict.fromkeys(named, 1.0))
    names = {"no_gap": [NONE], "unknown_effect": [UNKNOWN], "failed": [FAILED]}.get(verdict) or list(named)
    leading = () if verdict == "no_gap" else tuple(names)
    values = {
        "index": 0,
        "label": label,
        "truth": tuple(truth),
        "strengths": dict.fromkeys(truth, 2.0),
        "since": dict.fromkeys(truth, "always"),
        "protocol": "full",
        "geometry": "fine",
        "verdict": verdict,
        "top1": names[0],
        "named": frozenset(names),
        "leading": leading,
        "leading_probability": 0.9,
        "top_set": frozenset(names),
        "marginal": p,
        "p_none": 1.0 if verdict == "no_gap" else 0.0,
        "p_unknown": 1.0 if verdict == "unknown_effect" else 0.0,
        "separations": {
            name: Separation(sigma=value, nearest="no effect", detection=value)
            for name, value in zip(truth, [sigma] * len(truth) if not isinstance(sigma, list) else sigma, strict=True)
            if value is not None
        },
    }
    return Outcome(**values | more)


# ---- intervals, areas, calibration


@pytest.mark.parametrize(("hits", "n"), [(0, 7), (7, 7), (3, 11), (95, 100), (1, 1)])
def test_wilson_interval_is_that_of_statsmodels(hits, n):
    low, high = proportion_confint(hits, n, method="wilson")
    assert wilson_interval(hits, n) == pytest.approx((max(low, 0), min(high, 1)), abs=1e-6)


def test_wilson_interval_of_no_cases_is_everything():
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert share([])["share"] is None


def test_area_is_the_mann_whitney_statistic_and_its_interval_covers():
    rng = np.random.default_rng(3)
    positive, negative = np.round(rng.normal(1, 1, 40), 1), np.round(rng.normal(0, 1, 60), 1)
    expected = mannwhitneyu(positive, negative).statistic / (40 * 60)
    found = auroc(positive, negative)
    assert found["value"] == pytest.approx(expected, abs=1e-12)
    truth = 0.5 * (1 + math.erf(1 / 2))  # of two unit normals one apart: Phi(1 / sqrt 2)
    inside = 0
    repeats = 400
    for _ in range(repeats):
        entry = auroc(rng.normal(1, 1, 40), rng.normal(0, 1, 60))
        inside += entry["low"] <= truth <= entry["high"]
    assert abs(inside / repeats - 0.95) < 4 * math.sqrt(0.95 * 0.05 / repeats) + 0.01
    assert auroc(positive, np.zeros(0))["value"] is None


def test_honest_probabilities_pass_and_overconfident_ones_do_not():
    rng = np.random.default_rng(4)
    p = rng.uniform(0, 1, 800)
    right = rng.random(800) < p
    honest = calibration(p, right)
    assert honest["error"] < 1.5 * honest["error_if_honest"]["p95"]
    assert honest["brier"] == pytest.approx(1 / 6, abs=4 * 0.18 / math.sqrt(800))  # mean of p (1 - p) over [0, 1]
    sure = calibration(np.full(800, 0.99), rng.random(800) < 0.7)
    assert sure["error"] == pytest.approx(0.29, abs=4 * math.sqrt(0.21 / 800))
    assert sure["error"] > 5 * sure["error_if_honest"]["p95"]
    assert calibration(np.zeros(0), np.zeros(0, bool))["brier"] is None


# ---- separation


def statistics_of(responses, covariance, residual, *, signs=None, missing=()):
    """Effects a, b, ... with responses (effect, probe) a unit of strength, exactly linear."""
    inverse = np.linalg.inv(covariance)
    nodes, keys = [], []
    strengths = (1.0, 3.0, 10.0)
    for number, row in enumerate(responses):
        keys.append(
            CurveKey(
                effect="abcdefg"[number],
                variant="",
                sign=1.0 if signs is None else signs[number],
                since="always",
                low=1.0,
                high=10.0,
                strengths=strengths,
                first=3 * number,
            )
        )
        nodes += [value * row for value in strengths]
    table = np.array(nodes)
    return SessionStatistics(
        curves=tuple(keys),
        gram=table @ inverse @ table.T,
        linear=table @ inverse @ residual,
        chi_square=float(residual @ inverse @ residual),
        bare=table @ residual,
        bare_norm=np.linalg.norm(table, axis=1),
        bare_residual=float(np.linalg.norm(residual)),
        probes=len(residual),
        missing=tuple(missing),
    )


@pytest.mark.parametrize("degrees", [5.0, 30.0, 80.0, 90.0, 120.0])
def test_separation_from_a_competitor_at_an_angle_is_the_sine(degrees):
    angle = math.radians(degrees)
    responses = np.array([[1.0, 0.0], [math.cos(angle), math.sin(angle)]])
    found = separation_of(statistics_of(responses, np.eye(2), np.zeros(2)), "a", 4.0)
    # beyond a right angle the best strength of the other is none
    expected = 4.0 * math.sin(min(angle, math.pi / 2))
    assert found.sigma == pytest.approx(expected, rel=2e-3)
    assert found.detection == pytest.approx(4.0, rel=1e-9)
    assert found.nearest == ("b" if degrees < 90 else "no effect")


def test_separation_counts_what_nuisances_can_take_up():
    nuisance = np.array([1.0, 1.0, 0.0]) * 100.0
    covariance = np.eye(3) + np.outer(nuisance, nuisance)
    responses = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    found = separation_of(statistics_of(responses, covariance, np.zeros(3)), "a", 6.0)
    assert found.sigma == pytest.approx(6.0 / math.sqrt(2.0), rel=1e-3)


def test_separation_does_not_depend_on_the_order_of_effects_and_ignores_withheld_ones():
    rng = np.random.default_rng(8)
    responses = rng.standard_normal((4, 9))
    base = separation_of(statistics_of(responses, np.eye(9), np.zeros(9)), "a", 5.0)
    order = [0, 3, 1, 2]
    moved = separation_of(statistics_of(responses[order], np.eye(9), np.zeros(9)), "a", 5.0)
    assert moved.sigma == pytest.approx(base.sigma, rel=1e-9)
    without = separation_of(statistics_of(responses, np.eye(9), np.zeros(9)), "a", 5.0, without=(base.nearest,))
    assert without.sigma >= base.sigma
    assert without.nearest != base.nearest


def test_separation_within_a_pair_refits_the_partner():
    angle = math.radians(20.0)
    responses = np.array([[1.0, 0.0, 0.0], [math.cos(angle), math.sin(angle), 0.0], [0.0, 0.0, 1.0]])
    statistics = statistics_of(responses, np.eye(3), np.zeros(3))
    alone = separation_of(statistics, "a", 5.0)
    beside = separation_of(statistics, "a", 5.0, partner=("c", 4.0, "always"))
    assert beside.sigma == pytest.approx(alone.sigma, rel=1e-6)  # c is orthogonal: it takes nothing up
    like = separation_of(statistics, "a", 5.0, partner=("b", 4.0, "always"))
    assert like.sigma == pytest.approx(5.0 * math.sin(angle), rel=1e-6)  # b may grow in its place
    assert like.nearest == "no effect"


def test_an_effect_without_response_has_no_separation_and_one_without_law_has_none_to_state():
    statistics = statistics_of(np.eye(2), np.eye(2), np.zeros(2), missing=("g",))
    assert separation_of(statistics, "g", 3.0).sigma == 0.0
    assert separation_of(statistics, "unknown:tile_offsets", 3.0) is None


def test_variants_of_the_other_sign_or_onset_are_not_the_truth():
    statistics = statistics_of(np.eye(2), np.eye(2), np.zeros(2), signs=[1.0, -1.0])
    both = SessionStatistics(
        **{name: getattr(statistics, name) for name in SessionStatistics.__dataclass_fields__}
        | {
            "curves": tuple(
                CurveKey(**{key: getattr(item, key) for key in CurveKey.__dataclass_fields__} | {"effect": "a"})
                for item in statistics.curves
            ),
            "linear": np.array([5.0, 15.0, 50.0, 0.0, 0.0, 0.0]),
        }
    )
    # the data like the positive variant, but what was planted is negative: no other effect is near
    assert separation_of(both, "a", -3.0).sigma == pytest.approx(3.0)


def problem_of(rng):
    """A small problem as the diagnosis assembles it: two blocks, a factor within each and one across."""
    probes = 12
    factors = rng.standard_normal((probes, 3))
    factors[6:, 0] = 0.0
    factors[:6, 1] = 0.0
    curves = tuple(
        Curve(
            variant=Variant(effect=name, low=1.0, high=10.0, strengths=(1.0, 5.0, 10.0)),
            responses=np.outer([1.0, 5.0, 10.0], rng.standard_normal(probes)),
        )
        for name in "ab"
    )
    return SimpleNamespace(
        residual=rng.standard_normal(probes) * 3,
        factors=factors,
        curves=curves,
        blocks=np.repeat([0, 1], 6),
        missing_effects={"heel": "no gradient"},
    )


def test_inner_products_are_those_of_the_whole_covariance():
    problem = problem_of(np.random.default_rng(5))
    found = session_statistics(problem)
    inverse = np.linalg.inv(np.eye(12) + problem.factors @ problem.factors.T)
    nodes = np.concatenate([curve.responses for curve in problem.curves])
    np.testing.assert_allclose(found.gram, nodes @ inverse @ nodes.T, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.linear, nodes @ inverse @ problem.residual, rtol=1e-8, atol=1e-8)
    assert found.chi_square == pytest.approx(problem.residual @ inverse @ problem.residual, rel=1e-10)
    assert found.missing == ("heel",)


def test_statistics_are_read_as_they_were_written(tmp_path):
    written = session_statistics(problem_of(np.random.default_rng(6)))
    write_statistics(tmp_path / "s.npz", written)
    read = read_statistics(tmp_path / "s.npz")
    assert read.curves == written.curves
    np.testing.assert_allclose(read.gram, written.gram, rtol=1e-12)
    np.testing.assert_array_equal(read.linear, written.linear)
    assert (read.chi_square, read.probes, read.missing) == (written.chi_square, written.probes, written.missing)


# ---- what counts as right

LABEL = {
    "index": 3,
    "label": "single",
    "effects": [{"id": "heel", "strength": 5.0, "since": "calibration"}],
    "protocol": "full",
    "geometry": "coarse",
    "leave_out": [],
}


def answer_of(verdict, hypotheses, causes):
    return {
        "answer": {
            "verdict": verdict,
            "hypotheses": [{"effects": list(effects), "probability": p} for effects, p in hypotheses],
            "causes": [
                {
                    "effect": name,
                    "probability": p,
                    "parameters": {"strength": {"value": value, "low": 0.9 * value, "high": 1.1 * value, "unit": "%"}},
                }
                for name, p, value in causes
            ],
            "probability_no_gap": dict(hypotheses).get((), 0.0),
            "probability_unknown": dict(hypotheses).get((UNKNOWN,), 0.0),
            "gap": {"shrinks_by": None},
        },
        "error": "",
    }


def test_an_explained_case_names_what_is_likely_and_an_ambiguous_one_its_whole_set():
    explained = answer_of(
        "explained", [(("heel",), 0.7), (("heel", "kv_error"), 0.3)], [("heel", 1.0, 5.2), ("kv_error", 0.3, 1.0)]
    )
    found = outcome_of(LABEL, explained)
    assert found.named == {"heel"}
    assert found.top1 == "heel"
    assert found.leading_right
    assert found.top_set == {"heel", "kv_error"}
    assert found.found["heel"][0] == 5.2
    tied = answer_of("ambiguous", [(("kv_error",), 0.5), (("heel",), 0.45)], [("kv_error", 0.5, 1), ("heel", 0.45, 5)])
    found = outcome_of(LABEL, tied)
    assert found.named == {"heel", "kv_error"}
    assert not top1_right(found)
    assert not found.leading_right


def test_verdicts_without_causes_name_nothing_or_the_unknown():
    nothing = outcome_of(LABEL | {"label": "none", "effects": []}, answer_of("no_gap", [((), 0.9)], []))
    assert nothing.top1 == NONE
    assert nothing.leading_right
    unknown = outcome_of(LABEL, answer_of("unknown_effect", [((UNKNOWN,), 0.9)], []))
    assert unknown.top1 == UNKNOWN
    assert not unknown.leading_right
    withheld = outcome_of(LABEL, answer_of("unknown_effect", [((UNKNOWN,), 0.9)], []), withheld=("heel",))
    assert withheld.leading_right


def test_a_case_without_answer_is_wrong_in_every_score():
    failed = [
        outcome_of(LABEL | {"label": label, "effects": effects}, {"error": "out of memory"})
        for label, effects in (
            ("none", []),
            ("single", LABEL["effects"]),
            ("unknown", [{"id": "unknown:tile_offsets", "strength": 1.0, "since": "calibration"}]),
        )
    ]
    scores = compute_scores(failed, tuple(EFFECTS))
    assert scores["cases"]["failed"] == 3
    assert scores["none"]["false_alarms"]["hits"] == 1
    assert scores["top1"]["all"]["hits"] == 0
    assert scores["leading_hypothesis"]["brier"] == 1.0
    assert scores["unknown"]["auroc"]["value"] == 0.0
    assert scores["unknown"]["wrongly_explained"]["hits"] == 1


def test_shares_by_separation_take_each_case_into_one_bin():
    values = [0.5, 2.99, 3.0, 4.5, 5.0, 9.99, 10.0, 400.0]
    cases = [outcome("single", ["heel"], verdict="explained", named=["heel"], sigma=value) for value in values]
    cases.append(outcome("single", ["heel"], verdict="explained", named=["kv_error"], sigma=7.0))
    rows = by_sigma(cases, top1_right)
    assert [row["n"] for row in rows] == [2, 1, 1, 3, 2]
    assert [row["hits"] for row in rows] == [2, 1, 1, 2, 2]


def test_a_pair_is_as_far_as_its_weaker_effect_and_needs_both_names():
    both = outcome("pair", ["heel", "kv_error"], verdict="explained", named=["heel", "kv_error"], sigma=[9.0, 6.0])
    one = outcome("pair", ["heel", "kv_error"], verdict="explained", named=["heel"], sigma=[9.0, 2.0])
    assert both.sigma == 6.0
    scores = compute_scores([both, one], tuple(EFFECTS))["pairs"]
    assert (scores["both_named"]["hits"], scores["both_named"]["n"]) == (1, 2)
    assert (scores["both_named_from_5_sigma"]["hits"], scores["both_named_from_5_sigma"]["n"]) == (1, 1)
    assert scores["one_named"]["hits"] == 2


def test_strengths_are_judged_where_the_effect_was_named():
    right = outcome(
        "single", ["heel"], verdict="explained", named=["heel"], sigma=20.0, found={"heel": (2.1, 1.9, 2.3)}
    )
    off = outcome(
        "single", ["heel"], verdict="explained", named=["heel"], sigma=20.0, found={"heel": (-3.0, -3.2, -2.8)}
    )
    unnamed = outcome("single", ["heel"], verdict="explained", named=["kv_error"], found={"heel": (9.0, 8.0, 10.0)})
    scores = strength_scores([right, off, unnamed])
    assert scores["named"]["within_10_percent"]["n"] == 2
    assert scores["named"]["within_10_percent"]["hits"] == 1
    assert scores["from_10_sigma"]["coverage_95"]["hits"] == 1
    assert scores["named"]["right_sign"]["hits"] == 1


def test_confusions_are_pooled_by_set():
    cases = [
        outcome("single", ["heel"], verdict="explained", named=["heel"], sigma=9.0),
        outcome("single", ["heel"], verdict="explained", named=["kv_error"], sigma=9.0),
        outcome("single", ["heel"], verdict="explained", named=["row_noise"], sigma=9.0),
        outcome("single", ["kv_error"], verdict="no_gap", sigma=1.0),
        outcome("none", verdict="no_gap"),
    ]
    row = confusion_by_set(cases[:4])["B"]
    assert (row["n"], row["right"], row["within_set"], row["outside_set"], row[NONE]) == (4, 1, 1, 1, 1)
    table = confusion(cases)
    assert table["heel"] == {"heel": 1, "kv_error": 1, "row_noise": 1}
    assert table[NONE] == {NONE: 1}


def test_a_wrong_name_is_a_tie_where_the_two_lie_close_and_our_fault_where_they_do_not():
    def case(named, distance, verdict="explained"):
        separations = {
            "heel": Separation(sigma=2.0, nearest="kv_error", detection=30.0, distances={"kv_error": distance})
        }
        return outcome("single", ["heel"], verdict=verdict, named=[named], separations=separations)

    cases = [
        case("kv_error", 2.0),
        case("kv_error", 12.0),
        case("row_noise", 2.0),
        case("none", 0.0, verdict="no_gap"),
        case("heel", 2.0),
        case("", 2.0, verdict="unknown_effect"),
    ]
    scores = compute_scores(cases, tuple(EFFECTS))
    assert scores["wrong_names"] == {"tie": 1, "ours": 2, "unknown": 1, "failed": 0, "not_known": 1}
    assert cases[3].sigma_from_top1 == 30.0
    assert cases[4].sigma_from_top1 is None
    assert scores["distances"] == {"heel": {"no effect": 30.0, "kv_error": 2.0}}


def test_withheld_effects_must_be_unknown_and_not_another_with_confidence():
    cases = [
        outcome("single", ["heel"], verdict="unknown_effect", withheld=("heel",), sigma=8.0),
        outcome(
            "single",
            ["heel"],
            verdict="explained",
            named=["kv_error"],
            p={"kv_error": 0.95},
            withheld=("heel",),
            sigma=8.0,
        ),
        outcome(
            "single", ["heel"], verdict="ambiguous", named=["kv_error", "row_noise"], withheld=("heel",), sigma=8.0
        ),
        outcome("single", ["heel"], verdict="explained", named=["kv_error"], withheld=("heel",), sigma=2.0),
    ]
    scores = withheld_scores(cases)
    assert (scores["unknown_from_5_sigma"]["hits"], scores["unknown_from_5_sigma"]["n"]) == (1, 3)
    assert scores["confident_wrong_name_from_5_sigma"]["hits"] == 1


# ---- baselines


def test_the_commonest_label_is_a_probability_over_all_labels():
    prior = commonest(tuple(EFFECTS))
    assert sum(prior.values()) == pytest.approx(1.0)
    assert max(prior, key=prior.get) == NONE
    case = answered(outcome("single", ["heel"], verdict="failed"), prior)
    assert (case.verdict, case.top1, case.error) == ("no_gap", NONE, "")


def test_a_matched_filter_is_normal_where_there_is_nothing():
    rng = np.random.default_rng(12)
    covariance = np.eye(6) + 4.0 * np.ones((6, 6))
    root = np.linalg.cholesky(covariance)
    values = []
    for _ in range(2000):
        statistics = statistics_of(np.eye(6)[:1] + 0.5, covariance, root @ rng.standard_normal(6))
        top = statistics.linear[0] / math.sqrt(statistics.gram[0, 0])
        assert matched_filter(statistics, bare=False)["a"] == pytest.approx(max(top, 0.0))
        values.append(top)
    assert np.std(values) == pytest.approx(1.0, abs=4 / math.sqrt(2 * 2000))


def test_template_thresholds_let_one_case_in_twenty_pass():
    rng = np.random.default_rng(13)
    quiet = [
        example_of("none", (), {}, statistics_of(np.eye(4), np.eye(4), rng.standard_normal(4))) for _ in range(300)
    ]
    rule = fit_template_rule(quiet, bare=True)
    alarms = [rule.probability(item, tuple("abcd"))[NONE] == 0.0 for item in quiet]
    assert np.mean(alarms) == pytest.approx(0.05, abs=0.005)
    assert fit_template_rule([], bare=True).threshold == 4.5


def examples(rng, n, effects):
    """Sessions with one feature an effect, lifted by 4 where it is present."""
    result = []
    for _ in range(n):
        label = str(rng.choice(["none", "single", "pair", "unknown"], p=[0.3, 0.4, 0.15, 0.15]))
        count = {"single": 1, "pair": 2}.get(label, 0)
        truth = tuple(str(name) for name in rng.choice(effects, size=count, replace=False))
        features = {name: float(rng.standard_normal()) + 4.0 * (name in truth) for name in effects}
        features["strange"] = float(rng.standard_normal()) + 4.0 * (label == "unknown")
        if rng.random() < 0.2:
            features.pop(str(rng.choice(effects)))
        result.append(Example(targets=targets_of(label, truth), features=features))
    return result


@pytest.mark.parametrize(("fit", "least"), [(fit_logistic, 0.8), (fit_signatures, 0.6)])
def test_learning_baselines_find_what_can_be_learnt(fit, least):
    rng = np.random.default_rng(14)
    effects = ("heel", "kv_error", "row_noise", "image_lag")
    rule = fit(examples(rng, 250, effects), effects)
    held = examples(rng, 200, effects)
    answers = [rule.probability(item.features) for item in held]
    assert all(sum(answer.values()) == pytest.approx(1.0) for answer in answers)
    assert set(answers[0]) == set(classes_of(effects))
    right = [max(answer, key=answer.get) in item.targets for answer, item in zip(answers, held, strict=True)]
    assert np.mean(right) > least


def test_a_session_that_lacks_every_feature_is_judged_by_the_rest_of_the_training():
    rng = np.random.default_rng(15)
    effects = ("heel", "kv_error")
    rule = fit_logistic(examples(rng, 100, effects), effects)
    answer = rule.probability({})
    assert all(math.isfinite(value) for value in answer.values())
    assert sum(answer.values()) == pytest.approx(1.0)


# ---- a second day


class Bare(SimpleNamespace):
    """The fields of a problem that are asked for; its twin has no effects."""

    given = ()
    residual_without = Problem.residual_without
    left_by = Problem.left_by
    with_chance = Problem.with_chance


def second_day_problem(rng, *, series=24, each=40, factors=3):
    """Flats of equal beams in time order; a factor that all share."""
    views = tuple(
        SimpleNamespace(
            session=SimpleNamespace(
                series=SimpleNamespace(kind="flat", scene="", kV=40.0, exposure_ms=50.0),
                request=SimpleNamespace(scene_kind=None, beam_on=True),
            )
        )
        for _ in range(series)
    )
    size = series * each
    return Bare(
        residual=rng.standard_normal(size),
        factors=0.5 * rng.standard_normal((size, factors)),
        series_of=np.repeat(np.arange(series), each),
        groups=np.arange(size) % 5,
        places=np.arange(size) % 5,
        blocks=np.zeros(size, dtype=int),
        noise=np.ones(size),
        views=views,
    )


def an_effect(response):
    """The effect whose response at strength 1 this is."""
    curve = Curve(variant=Variant(effect="heel", low=0.1, high=1.0, strengths=(1.0,)), responses=response[None, :])
    return [Point(curve=curve, strength=1.0, level=0.1)]


def test_the_whole_response_added_takes_the_whole_gap_away():
    rng = np.random.default_rng(21)
    problem = second_day_problem(rng)
    response = 3.0 * rng.standard_normal(len(problem.residual))
    problem.residual = problem.residual + response
    found = shrinkage(problem, an_effect(response))
    assert found["value"] == pytest.approx(1.0, abs=0.03)
    assert found["low"] <= 1.0 <= found["high"] + 0.03
    # half the response leaves rms sqrt(1 + 1.5^2) of sqrt(1 + 3^2)
    half = shrinkage(problem, an_effect(0.5 * response))
    before, after = math.sqrt(10.0), math.sqrt(1 + 1.5**2)
    assert half["value"] == pytest.approx((before - after) / (before - 1.0), abs=0.04)
    # where much of what probes allow is no noise, the gap may shrink further
    problem.noise = np.full(len(problem.residual), 0.5)
    further = shrinkage(problem, an_effect(0.5 * response))
    assert further["value"] == pytest.approx((before - after) / (before - 0.5), abs=0.04)


def test_a_gap_that_is_chance_is_gone_once_the_chance_is_in_the_model():
    rng = np.random.default_rng(23)
    problem = second_day_problem(rng)
    problem.residual = problem.residual + 2.0 * rng.standard_normal(len(problem.residual))
    (point,) = an_effect(np.zeros(len(problem.residual)))
    chance = replace(point.curve, jitter=np.full(len(problem.residual), 4.0))
    found = shrinkage(problem, [replace(point, curve=chance)])
    assert found["value"] == pytest.approx(1.0, abs=0.04)


def test_what_nuisances_take_up_is_no_gap_and_noise_has_no_shrinkage():
    rng = np.random.default_rng(22)
    problem = second_day_problem(rng)
    assert shrinkage(problem, an_effect(0.1 * rng.standard_normal(len(problem.residual)))) is None
    problem.residual = problem.residual + problem.factors @ np.array([1.0, -1.5, 0.7])
    assert shrinkage(problem, an_effect(np.zeros(len(problem.residual)))) is None
