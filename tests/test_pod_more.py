"""Ceiling and floor, continuous responses, several properties, comparison, planning, the paper's treatment, plots."""

import csv
import math

import numpy as np
import pytest

from raytwin.errors import FitError, InputError
from raytwin.pod import (
    LINKS,
    AssumedCurve,
    check_trials,
    compare_models,
    compare_pod,
    compute_roc,
    curve_rows,
    expected_precision,
    explain_detection,
    fit_as_published,
    fit_covariates,
    fit_lapse_pod,
    fit_pod,
    fit_response_pod,
    plan_pod,
    recommended_sizes,
    size_at,
    write_curve_table,
)


def drawn_hits(random: np.random.Generator, pod: np.ndarray) -> np.ndarray:
    return (random.random(pod.shape) < pod).astype(float)


# ceiling and floor


def test_ceiling_and_floor_are_found_and_bounded():
    random = np.random.default_rng(1)
    size = random.uniform(0.01, 0.5, 1500)
    inner = LINKS["cloglog"].pod_from_eta(-6 + 30 * size)
    fit = fit_lapse_pod(check_trials(size, drawn_hits(random, 0.06 + (0.95 - 0.06) * inner)))
    assert fit.ceiling.low < 0.95 < fit.ceiling.high
    assert fit.floor.low < 0.06 < fit.floor.high
    assert fit.ceiling.low < fit.ceiling.value < fit.ceiling.high
    assert fit.p_plain < 1e-6
    true_a90 = (LINKS["cloglog"].eta_from_pod((0.9 - 0.06) / 0.89) + 6) / 30
    assert fit.a90 < fit.a90_95 < fit.a90_95_two_sided
    assert fit.a90 == pytest.approx(true_a90, rel=0.1)


def test_a_plain_curve_keeps_its_a90_when_ceiling_and_floor_are_free():
    random = np.random.default_rng(2)
    size = random.uniform(0.01, 0.5, 600)
    table = check_trials(size, drawn_hits(random, LINKS["logit"].pod_from_eta(-5 + 30 * size)))
    plain = fit_pod(table.size, table.hits, link="logit")
    fit = fit_lapse_pod(table, link="logit")
    assert fit.ceiling.high == 1.0
    assert fit.floor.low == 0.0
    assert fit.p_plain > 0.01
    assert fit.log_likelihood >= plain.log_likelihood - 1e-6
    assert fit.a90 == pytest.approx(plain.a90, rel=0.05)


def test_a_curve_that_ends_below_90_percent_has_no_a90():
    random = np.random.default_rng(3)
    size = random.uniform(0.01, 0.5, 500)
    table = check_trials(size, drawn_hits(random, 0.8 * LINKS["cloglog"].pod_from_eta(-4 + 30 * size)))
    fit = fit_lapse_pod(table, floor=False)
    assert fit.ceiling.high < 0.9
    assert (fit.a90, fit.a90_95) == (None, None)
    assert any("never reaches 90 %" in note for note in fit.warnings)
    with pytest.raises(InputError, match="ceiling and floor"):
        fit_lapse_pod(table, ceiling=False, floor=False)
    with pytest.raises(FitError, match="every trial is a hit"):
        fit_lapse_pod(check_trials([0.1, 0.2], [1, 1]))


# continuous response


def test_uncensored_response_is_least_squares():
    random = np.random.default_rng(4)
    size = random.uniform(1, 10, 60)
    response = 3 + 2 * size + random.normal(0, 1.5, 60)
    fit = fit_response_pod(size, response, decision=10)
    slope, intercept = np.polyfit(size, response, 1)
    assert (fit.intercept, fit.slope) == pytest.approx((intercept, slope), rel=1e-7)
    assert fit.scatter == pytest.approx(math.sqrt(np.mean((response - intercept - slope * size) ** 2)), rel=1e-7)
    assert fit.a50 == pytest.approx((10 - intercept) / slope, rel=1e-7)
    assert fit.a90 == pytest.approx(fit.a50 + 1.2815515655 * fit.scatter / slope, rel=1e-7)


def test_censoring_takes_nothing_away_on_average():
    errors = []
    for seed in range(40):
        random = np.random.default_rng(seed)
        size = random.uniform(1, 10, 80)
        response = np.exp(0.5 + 1.2 * np.log(size) + random.normal(0, 0.4, 80))
        fit = fit_response_pod(size, np.clip(response, 4, 20), decision=8, left=4, right=20, log_size=True, box_cox=0.0)
        errors.append(math.log(fit.a50) - (math.log(8) - 0.5) / 1.2)
    assert abs(np.mean(errors)) < 4 * np.std(errors) / math.sqrt(40)
    assert np.std(errors) < 0.1


@pytest.mark.slow
def test_response_bounds_cover_as_stated():
    # 95 % of 150 within 4 standard errors (2.7); likelihood ratio
    covered = 0
    for seed in range(150):
        random = np.random.default_rng(1000 + seed)
        size = random.uniform(1, 10, 60)
        response = 3 + 2 * size + random.normal(0, 3, 60)
        fit = fit_response_pod(size, response, decision=10, left=5)
        bound = fit.a90_95.likelihood_ratio
        covered += bound is None or bound >= (10 - 3 + 1.2815515655 * 3) / 2
    assert covered > 0.95 * 150 - 4 * 2.7


def test_bounds_of_few_responses_are_those_of_students_t_and_walds_are_not_given():
    """Chi-square's quantile would cover 75 % with five rows; 95 % of 120 within three standard errors, 2.4 each."""
    covered, size = 0, np.linspace(1.0, 3.0, 5)
    for seed in range(120):
        response = size + np.random.default_rng(seed).normal(0.0, 0.2, 5)
        fit = fit_response_pod(size, response, decision=1.7)
        low, high = fit.a90_low_two_sided.likelihood_ratio, fit.a90_95_two_sided.likelihood_ratio
        covered += (low is None or low <= 1.9563) and (high is None or high >= 1.9563)
        assert fit.a90_95.wald is None
    assert covered > 0.95 * 120 - 3 * 2.4


@pytest.mark.parametrize("limits", [{"left": 3.0}, {"right": 1.0}])
def test_a_decision_beyond_what_was_seen_is_refused(limits):
    size = np.linspace(0.0, 5.0, 30)
    with pytest.raises(InputError, match="decision: got 2; expected a response between the limits"):
        fit_response_pod(size, size + np.random.default_rng(1).normal(0.0, 0.3, 30), decision=2, **limits)


def test_box_cox_finds_the_scale_that_made_the_data():
    random = np.random.default_rng(5)
    size = random.uniform(1, 10, 400)
    response = np.exp(1 + 0.3 * size + random.normal(0, 0.3, 400))
    fit = fit_response_pod(size, response, decision=10, box_cox=None)
    assert abs(fit.box_cox) < 0.15
    same = fit_response_pod(size, response, decision=10, box_cox=0.0)
    assert fit.a90 == pytest.approx(same.a90, rel=0.03)


def test_a_bent_response_and_a_scatter_that_grows_are_told_and_give_no_bounds():
    random = np.random.default_rng(5)
    size = random.uniform(0.5, 4, 100)
    noise = random.normal(0, 1, 100)
    cases = {
        "": 1 + 2 * size + 0.6 * noise,
        "bends": size**3 + 0.6 * noise,
        "scatter changes": 1 + 2 * size + 0.8 * size * noise,
    }
    for words, response in cases.items():
        for limits in ({}, {"left": 2.0, "right": 12.0}):
            fit = fit_response_pod(size, np.clip(response, 2, 12) if limits else response, decision=5, **limits)
            told = [note for note in fit.warnings if "no bounds on a90" in note]
            if words:
                assert words in told[0]
                assert fit.a90_95.likelihood_ratio is fit.a90_95.wald is None
            else:
                assert not told
                assert min(fit.p_line, fit.p_scatter) > 0.01
                assert fit.a90_95.likelihood_ratio > fit.a90


def test_repeated_responses_widen_the_bounds():
    random = np.random.default_rng(6)
    size = np.repeat(random.uniform(1, 10, 40), 6)
    image = np.repeat(np.arange(40), 6)
    response = 3 + 2 * size + np.repeat(random.normal(0, 2, 40), 6) + random.normal(0, 0.5, 240)
    naive = fit_response_pod(size, response, decision=10)
    robust = fit_response_pod(size, response, decision=10, image=image, repeats="cluster")
    assert robust.a90 == naive.a90
    assert robust.se0 > 1.7 * naive.se0
    assert robust.a90_95.likelihood_ratio > robust.a90


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"left": 5, "right": 4}, "expected a left limit below the right"),
        ({"decision": math.nan}, "decision"),
        ({"box_cox": 0.0, "decision": -1}, "expected above 0 where the response is transformed"),
        ({"repeats": "crossed"}, "expected pooled or cluster"),
        ({"response": [1, 2, math.inf, 4]}, "response: got missing or infinite"),
        ({"size": [0, 1, 2, 3], "log_size": True}, "sizes above 0 on log size"),
        ({"response": [-1, 2, 3, 4], "box_cox": 0.0}, "values above 0 where the response is transformed"),
    ],
)
def test_bad_responses_are_named(changes, words):
    arguments = {"size": [1, 2, 3, 4], "response": [1, 3, 2, 4], "decision": 2.5} | changes
    with pytest.raises(InputError) as error:
        fit_response_pod(**arguments)
    assert words in str(error.value)


def test_a_response_without_scatter_or_without_enough_values_is_refused():
    with pytest.raises(FitError, match="without any scatter"):
        fit_response_pod([1, 2, 3, 4], [1, 2, 3, 4], decision=2)
    with pytest.raises(FitError, match="at least three responses between the limits"):
        fit_response_pod([1, 2, 3, 4], [1, 1, 1, 4], decision=2, left=1)


def test_roc_of_two_normals_has_the_area_of_theory():
    random = np.random.default_rng(7)
    roc = compute_roc(random.normal(0, 1, 3000), random.normal(1, 1, 3000))
    expected = float(LINKS["probit"].pod_from_eta(np.array(1 / math.sqrt(2))))
    assert roc.area_low < expected < roc.area_high
    assert roc.area_high - roc.area_low == pytest.approx(2 * 1.96 * 0.0063, rel=0.15)
    assert np.all(np.diff(roc.detected) >= 0)
    assert (roc.false_alarm[0], roc.detected[-1]) == (0, 1)
    assert np.trapezoid(roc.detected, roc.false_alarm) == pytest.approx(roc.area, abs=1e-9)
    perfect = compute_roc([0, 1, 2], [3, 4, 5])
    assert (perfect.area, perfect.area_high) == (1.0, 1.0)
    assert perfect.area_low < 0.5
    with pytest.raises(InputError, match="noise"):
        compute_roc([1], [1, 2])


# several properties


def made_with_two_properties(seed: int, n: int = 800):
    random = np.random.default_rng(seed)
    contrast = random.uniform(0.02, 0.3, n)
    thickness = random.uniform(10, 40, n)
    other = contrast * 20 + random.normal(0, 1.5, n)
    pod = LINKS["logit"].pod_from_eta(-1 + 30 * contrast - 0.12 * thickness)
    return check_trials(contrast, drawn_hits(random, pod)), {
        "contrast": contrast,
        "thickness_mm": thickness,
        "size_mm": other,
    }


def test_covariate_fit_agrees_with_statsmodels():
    import statsmodels.api as sm

    table, columns = made_with_two_properties(1)
    fit = fit_covariates(table, columns, link="logit")
    design = sm.add_constant(np.stack(list(columns.values()), axis=1))
    theirs = sm.GLM(table.hits, design, family=sm.families.Binomial()).fit(tol=1e-13)
    assert fit.coefficients == pytest.approx(theirs.params, rel=1e-6)
    assert fit.errors == pytest.approx(theirs.bse, rel=1e-5)
    assert fit.p == pytest.approx(theirs.pvalues, rel=1e-4)
    assert fit.aic == pytest.approx(theirs.aic, rel=1e-9)
    assert fit.deviance == pytest.approx(theirs.deviance, rel=1e-9)


def test_a90_in_one_property_moves_with_the_others():
    table, columns = made_with_two_properties(2)
    columns = {name: columns[name] for name in ("contrast", "thickness_mm")}
    fit = fit_covariates(table, columns, link="logit")
    found = {t: size_at(fit, table, columns, name="contrast", held={"thickness_mm": t}) for t in (15.0, 25.0)}
    true = {t: (math.log(9) + 1 + 0.12 * t) / 30 for t in found}
    for t, one in found.items():
        assert one.a90 == pytest.approx(true[t], rel=0.1)
        assert one.a90 < one.a90_95.likelihood_ratio
        assert one.a90_95.wald == pytest.approx(one.a90_95.likelihood_ratio, rel=0.05)
    falling = size_at(fit, table, columns, name="thickness_mm", held={"contrast": 0.2})
    assert falling.a90 is None
    assert "does not rise" in falling.warnings[0]
    with pytest.raises(InputError, match="no value of thickness_mm"):
        size_at(fit, table, columns, name="contrast", held={})


def test_with_one_property_the_covariate_fit_is_the_pod_fit():
    table, columns = made_with_two_properties(3, n=200)
    one = fit_pod(table.size, table.hits, link="cloglog", log_size=True)
    fit = fit_covariates(table, {"contrast": columns["contrast"]}, logs=("contrast",))
    at = size_at(fit, table, {"contrast": columns["contrast"]}, name="contrast", held={})
    assert fit.coefficients == pytest.approx([one.c0, one.c1], rel=1e-7)
    if one.a90 is None:
        assert at.a90 is None
    else:
        assert at.a90 == pytest.approx(one.a90, rel=1e-7)
        assert at.a90_95.likelihood_ratio == pytest.approx(one.a90_95.likelihood_ratio, rel=1e-5)


def test_separated_properties_are_refused_or_bias_reduced():
    table = check_trials([1, 2, 3, 4, 5, 6], [0, 0, 0, 1, 1, 1])
    columns = {"a": table.size, "b": np.array([1.0, 3, 2, 2, 3, 1])}
    assert fit_covariates(table, columns).method == "firth"
    with pytest.raises(FitError, match="the data separate"):
        fit_covariates(table, columns, method="ml")
    with pytest.raises(InputError, match="sums of each other"):
        fit_covariates(table, {"a": table.size, "b": 2 * table.size + 1})
    with pytest.raises(InputError, match="a property that varies"):
        fit_covariates(table, {"a": np.ones(6)})


def test_the_property_that_made_the_hits_explains_them_best():
    random = np.random.default_rng(8)
    n = 150
    contrast = random.uniform(0.02, 0.3, n)
    size_mm = 20 * contrast + random.normal(0, 1.2, n) + 2
    position = random.uniform(0, 100, n)
    pod = LINKS["cloglog"].pod_from_eta(-3 + 25 * contrast)
    hits = (random.random((6, n)) < pod).astype(float)
    network, image = np.indices((6, n))
    spread = [np.tile(values, 6) for values in (contrast, size_mm, position)]
    table = check_trials(spread[0], hits.ravel(), network=network.ravel(), image=image.ravel())
    columns = dict(zip(("contrast", "size_mm", "position_mm"), spread, strict=True))
    found, joint = explain_detection(table, columns, rng=np.random.default_rng(1), repeats="cluster")
    assert [one.name for one in found] == ["contrast", "size_mm", "position_mm"]
    assert found[0].gain > found[1].gain > 0.05
    assert abs(found[2].gain) < 0.02
    assert found[1].behind > 2 * found[1].behind_error
    # Student's distribution with some five degrees of freedom: a deviation of nine standard errors
    assert found[0].p_beyond < 1e-3
    assert found[2].p_beyond > 1e-4
    assert 0.4 < found[2].area < 0.6
    assert joint.robust
    assert found[1].fit.a90 is None or found[1].fit.a90 > 2  # in millimetres, when asked in millimetres


# comparison


def two_tables(seed: int, shift: float = 1.0, images: int = 80, networks: int = 8, same: bool = True):
    random = np.random.default_rng(seed)
    tables = []
    effects = random.normal(0, 0.8, images), random.normal(0, 0.4, networks)
    size = random.uniform(0.01, 0.35, images)
    for factor in (1.0, shift):
        if not same:
            effects = random.normal(0, 0.8, images), random.normal(0, 0.4, networks)
            size = random.uniform(0.01, 0.35, images)
        eta = -2.5 + 20 / factor * size[None] + effects[1][:, None] + effects[0][None]
        network, image = np.indices(eta.shape)
        hits = drawn_hits(random, LINKS["logit"].pod_from_eta(eta + 0.5))
        tables.append(check_trials(np.tile(size, networks), hits.ravel(), network=network.ravel(), image=image.ravel()))
    return tables


def test_a_table_equals_itself():
    one, _ = two_tables(1)
    found = compare_pod(one, one, link="logit", repeats="cluster", shared_images=True, shared_networks=True)
    assert found.difference_a90.value == 0
    assert found.ratio_a90.value == 1
    assert found.correlation > 0.98
    assert not found.correlation_at_bound  # nothing differs
    assert found.verdict == "equivalent"
    assert found.curve_test.p == pytest.approx(1, abs=1e-6)


def test_a_shift_is_found_and_pairing_narrows_the_interval():
    one, two = two_tables(2, shift=1.3, images=120, networks=30)
    paired = compare_pod(one, two, link="logit", repeats="cluster", shared_images=True, shared_networks=True)
    apart = compare_pod(one, two, link="logit", repeats="cluster")
    assert paired.correlation > 0.4
    width = [c.difference_a90.high - c.difference_a90.low for c in (paired, apart)]
    assert width[0] < 0.8 * width[1]
    assert paired.ratio_a90.low > 1
    assert paired.verdict == "different"
    assert paired.difference_a90.value == pytest.approx(paired.second.a90 - paired.first.a90)
    assert paired.p_equivalence > 0.5


def test_spreads_that_no_correlation_explains_are_said(monkeypatch):
    one, two = two_tables(2, shift=1.3, images=120, networks=30)
    words = {"link": "logit", "repeats": "cluster", "shared_images": True, "shared_networks": True}
    plain = compare_pod(one, two, **words)
    assert not plain.correlation_at_bound and plain.correlation > 0.0
    monkeypatch.setattr("raytwin.pod.comparison._shared_luck", lambda *tables, **options: (1.2, None))
    found = compare_pod(one, two, **words)
    assert found.correlation_at_bound
    # as wide as where nothing is shared
    apart = compare_pod(one, two, link="logit", repeats="cluster")
    assert (found.difference_a90, found.correlation) == (apart.difference_a90, 0.0)
    assert any("spreads less than any correlation" in line for line in found.warnings)


def test_a_wide_margin_makes_equivalent_what_a_narrow_one_leaves_open():
    one, two = two_tables(3, same=False)
    wide = compare_pod(one, two, link="logit", repeats="cluster", margin=0.9)
    narrow = compare_pod(one, two, link="logit", repeats="cluster", margin=0.001)
    assert wide.verdict in ("equivalent", "different within the margin")
    assert narrow.verdict in ("inconclusive", "different")
    assert wide.p_equivalence < 0.05 < narrow.p_equivalence
    assert wide.equivalence_low > 1 / 1.9
    with pytest.raises(InputError, match="margin"):
        compare_pod(one, two, margin=0)


def test_equivalence_at_a_margin_in_the_sizes_unit_is_that_of_the_90_percent_interval_of_the_difference():
    one, two = two_tables(2, shift=1.3, images=120, networks=30)
    words = {"link": "logit", "repeats": "cluster", "shared_images": True, "shared_networks": True}
    found = compare_pod(one, two, size_margin=0.001, **words)
    inner, outer = found.size_equivalence, found.difference_a90
    assert outer.low < inner.low < outer.value < inner.high < outer.high
    assert inner.verdict == "different"
    assert compare_pod(one, two, size_margin=1.01 * inner.high, **words).size_equivalence.verdict == (
        "different within the margin"
    )
    assert compare_pod(one, two, size_margin=0.99 * inner.high, **words).size_equivalence.verdict == "different"
    assert compare_pod(one, one, size_margin=0.01, **words).size_equivalence.verdict == "equivalent"
    assert compare_pod(one, two, **words).size_equivalence is None
    for margin in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="size margin"):
            compare_pod(one, two, size_margin=margin, **words)


@pytest.mark.slow
def test_difference_interval_covers_nothing_where_there_is_none():
    # independent tables of one curve: 95 % of 100 within 4 standard errors (2.2)
    inside = 0
    tests = []
    for seed in range(100):
        random = np.random.default_rng(seed)
        tables = []
        for _ in range(2):
            size = random.uniform(0.01, 0.35, 100)
            tables.append(check_trials(size, drawn_hits(random, LINKS["logit"].pod_from_eta(-3 + 25 * size))))
        found = compare_pod(*tables, link="logit")
        low, high = found.difference_a90.low, found.difference_a90.high
        inside += low is None or high is None or low <= 0 <= high
        tests.append(found.curve_test.p)
    assert inside >= 95 - 4 * 2.2
    assert abs(np.mean(tests) - 0.5) < 4 * 0.289 / math.sqrt(100)


def test_crossed_comparison_shares_the_effects_of_shared_images():
    one, two = two_tables(4, shift=1.4, images=40, networks=5)
    found = compare_pod(one, two, link="logit", repeats="crossed", shared_images=True, shared_networks=True)
    assert "crossed" in found.curve_test.kind
    assert found.curve_test.p < 0.05


def test_a_curve_without_a90_leaves_the_comparison_open():
    one, _ = two_tables(5)
    low = check_trials(np.linspace(0.01, 0.2, 50), np.arange(50) % 5 == 4)
    found = compare_pod(one, low, link="logit")
    assert found.verdict == "inconclusive"
    assert found.ratio_a90.value is None
    assert any("no a90" in note for note in found.warnings)


# planning


def test_expected_precision_is_what_simulated_fits_show():
    curve = AssumedCurve(a50=0.1, a90=0.2, link="logit", sd_network=0.4, sd_image=0.8)
    sizes = np.linspace(0.01, 0.4, 150)
    expected = expected_precision(curve, sizes, networks=10)
    c0, c1 = curve.coefficients()
    found = []
    for seed in range(120):
        random = np.random.default_rng(seed)
        eta = c0 + c1 * sizes + random.normal(0, 0.4, 10)[:, None] + random.normal(0, 0.8, 150)[None]
        hits = drawn_hits(random, LINKS["logit"].pod_from_eta(eta)).sum(axis=0)
        found.append(fit_pod(sizes, hits, trials=np.full(150, 10), link="logit").a90)
    values = np.array([value for value in found if value is not None])
    assert len(values) > 115
    # a standard deviation of 120 values is known to 6.5 %; the pooled fit stands for the averaged curve
    assert np.std(values) == pytest.approx(expected.sd_a90, rel=0.3)


def test_without_repeats_precision_is_fisher_information():
    curve = AssumedCurve(a50=0.1, a90=0.2, link="cloglog")
    sizes = np.linspace(0.02, 0.35, 60)
    c0, c1 = curve.coefficients()
    parts = LINKS["cloglog"].log_parts(c0 + c1 * sizes)
    design = np.stack((np.ones(60), sizes), axis=1)
    covariance = np.linalg.inv((design * (-parts.log_hit_1 * parts.log_miss_1)[:, None]).T @ design)
    toward = np.array([1, 0.2])
    expected = math.sqrt(toward @ covariance @ toward) / c1
    assert expected_precision(curve, sizes).sd_a90 == pytest.approx(expected, rel=1e-4)


def test_a_plan_reaches_what_was_wanted_with_no_image_too_many():
    curve = AssumedCurve(a50=1.5, a90=3.0, log_size=True, sd_network=0.3, sd_image=0.6)
    plan = plan_pod(curve, wanted_over_a90=1.15, networks=10)
    assert plan.expected.bound_over_a90 == pytest.approx(1.15, abs=0.02)
    assert len(plan.sizes) == plan.images
    assert plan.limit_over_a90 < 1.15
    more = plan_pod(curve, wanted_over_a90=1.10, networks=10)
    assert more.images > plan.images
    hopeless = plan_pod(curve, wanted_over_a90=1.01, networks=3)
    assert hopeless.images is None
    assert hopeless.fewest_networks > 3
    enough = plan_pod(curve, wanted_over_a90=1.01, networks=hopeless.fewest_networks + 5)
    assert enough.limit_over_a90 < 1.01


def test_recommended_sizes_beat_sizes_made_at_random():
    curve = AssumedCurve(a50=1.5, a90=3.0)
    ours = expected_precision(curve, recommended_sizes(curve, 50)).sd_a90
    theirs = expected_precision(curve, np.linspace(0.1, 11, 50)).sd_a90
    assert ours < 0.8 * theirs
    assert curve.size_at(0.5) == pytest.approx(1.5)
    assert curve.size_at(0.9) == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: AssumedCurve(a50=2, a90=1), "the a90 above the a50"),
        (lambda: AssumedCurve(a50=-1, a90=1), "sizes above 0"),
        (lambda: AssumedCurve(a50=0, a90=1, log_size=True), "sizes above 0"),
        (lambda: AssumedCurve(a50=1, a90=2, sd_image=-1), "a finite spread of 0 or more"),
        (lambda: AssumedCurve(a50=1, a90=2, link="log"), "link"),
        (lambda: plan_pod(AssumedCurve(a50=1, a90=2), wanted_over_a90=0.9), "a ratio above 1"),
        (lambda: AssumedCurve(a50="1", a90=2), "a50: got '1'; expected a number"),
        (lambda: expected_precision(AssumedCurve(a50=1, a90=2), [1, 1]), "two or more different, finite sizes"),
        (lambda: expected_precision(AssumedCurve(a50=1, a90=2), [1, 2], networks=0), "networks"),
        (lambda: recommended_sizes(AssumedCurve(a50=1, a90=2), 1), "images"),
    ],
)
def test_impossible_plans_are_named(make, words):
    with pytest.raises(InputError) as error:
        make()
    assert words in str(error.value)


# the paper's treatment


def test_as_published_leaves_failed_networks_out_instead_of_averaging_them_in():
    random = np.random.default_rng(9)
    size = np.tile(random.uniform(0.02, 0.3, 60), 5)
    network = np.repeat(np.arange(5), 60)
    hits = drawn_hits(random, LINKS["logit"].pod_from_eta(-4 + 40 * size))
    hits[network == 4] = 1  # a network that never misses has no curve
    found = fit_as_published(check_trials(size, hits, network=network))
    assert (found.n_fitted, found.n_failed) == (4, 1)
    assert found.a90_mean == pytest.approx((math.log(9) + 4) / 40, rel=0.25)
    assert found.a90_sd > 0
    below = [
        fit_pod(size[(network == k) & (size < 0.2)], hits[(network == k) & (size < 0.2)], link="logit")
        for k in range(4)
    ]
    own = [(math.log(9) - fit.c0) / fit.c1 for fit in below]
    assert found.a90_mean == pytest.approx(np.mean(own), rel=1e-6)
    with pytest.raises(InputError, match="network"):
        fit_as_published(check_trials([0.1, 0.2], [0, 1]))
    with pytest.raises(InputError, match="no rows left"):
        fit_as_published(check_trials([0.3, 0.4], [0, 1], network=[0, 0]))


# plots and tables


@pytest.fixture
def fitted():
    random = np.random.default_rng(10)
    size = random.uniform(0.02, 0.3, 100)
    table = check_trials(size, drawn_hits(random, LINKS["cloglog"].pod_from_eta(-3 + 25 * size)))
    return fit_pod(table.size, table.hits), table


def test_every_plot_draws_what_it_is_given(fitted, tmp_path):
    from matplotlib.figure import Figure

    from raytwin.pod import plots

    fit, table = fitted
    response = 1 + 30 * table.size + np.random.default_rng(1).normal(0, 1, 100)
    line = fit_response_pod(table.size, response, decision=5, left=2)
    drawn = [Figure() for _ in range(3)]
    axes = [figure.subplots() for figure in drawn]
    plots.draw_pod(axes[0], fit, table, size_label="contrast")
    plots.draw_response(
        axes[1], line, table.size, response, size_label="contrast", response_label="probability", left=2
    )
    plots.draw_pod(axes[2], fit_pod(table.size, np.ones(100)), table, size_label="contrast")
    figures = [
        *drawn,
        plots.plot_joint_region(fit),
        plots.plot_models(compare_models(table)),
        plots.plot_comparison(compare_pod(table, table), size_label="contrast"),
        plots.plot_roc(compute_roc(response[:40], response[40:])),
    ]
    for place, figure in enumerate(figures):
        path = tmp_path / f"{place}.png"
        figure.savefig(path)
        assert path.stat().st_size > 4000
    assert axes[0].get_xlabel() == "contrast"
    assert any(f"a90 = {fit.a90:.3g}" in text.get_text() for text in axes[0].texts)
    with pytest.raises(FitError, match="no joint region"):
        plots.plot_joint_region(fit_pod([1, 2, 3, 4], [0, 0, 1, 1]))


def test_curve_table_holds_the_curve_and_its_band(fitted, tmp_path):
    fit, _ = fitted
    path = tmp_path / "curve.csv"
    write_curve_table(path, fit, size_name="contrast")
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == ["contrast", "pod", "pod_low_95", "pod_high_95"]
    expected = curve_rows(fit)
    assert [float(row["pod"]) for row in rows] == pytest.approx(expected["pod"], rel=1e-8)
    with pytest.raises(FitError, match="no curve to draw"):
        write_curve_table(tmp_path / "none.csv", fit_pod([0.1, 0.2], [1, 1]))
    assert not (tmp_path / "none.csv").exists()
