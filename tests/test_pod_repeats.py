"""Repeated looks: crossed random effects, scaling, clusters, bootstrap; and the false-alarm rate beside them."""

import math
from functools import lru_cache

import numpy as np
import pytest

from raytwin.errors import FitError, InputError
from raytwin.pod import LINKS, PodFit, bootstrap_pod, check_trials, curve_with_band, false_alarm_rate, fit_many, fit_pod
from raytwin.pod._laplace import Laplace
from raytwin.pod.bootstrap import bootstrap_weights
from raytwin.pod.few_groups import levels_of
from raytwin.pod.mixed import averaged_eta, averaged_pod, fit_mixed
from raytwin.pod.robust import clustered_curve, clustered_meat, score_rows


def crossed_data(seed: int, networks: int = 8, images: int = 60, sds=(0.5, 0.8), link: str = "cloglog"):
    random = np.random.default_rng(seed)
    size = np.repeat(random.uniform(0.01, 0.35, images)[None], networks, axis=0)
    network, image = np.indices(size.shape)
    eta = -2.5 + 20 * size + random.normal(0, sds[0], networks)[:, None] + random.normal(0, sds[1], images)[None]
    hit = (random.random(size.shape) < LINKS[link].pod_from_eta(eta)).astype(float)
    return {"size": size.ravel(), "hits": hit.ravel(), "network": network.ravel(), "image": image.ravel()}


def test_averaged_eta_undoes_averaged_pod():
    for link in LINKS.values():
        for sd in (0.0, 0.3, 1.5):
            eta = averaged_eta(0.9, sd, link=link)
            assert averaged_pod(np.array(eta), sd, link=link) == pytest.approx(0.9, abs=1e-10)


@pytest.mark.parametrize("sd", [0.1, 0.7, 3.0, 8.0])
def test_averaged_probit_has_its_closed_form(sd):
    # E[Phi(eta + s Z)] = Phi(eta / sqrt(1 + s^2))
    eta = np.linspace(-3, 3, 13) * math.sqrt(1 + sd**2)
    expected = LINKS["probit"].pod_from_eta(eta / math.sqrt(1 + sd**2))
    assert averaged_pod(eta, sd, link=LINKS["probit"]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("sd", [0.5, 8.0])
def test_averages_over_wide_and_narrow_spreads_are_the_integral(link, sd):
    from scipy.integrate import quad

    for eta in (-6.0, 0.3, 2.1):

        def density(z, eta=eta):
            pod = float(LINKS[link].pod_from_eta(np.array(eta + sd * z)))
            return pod * math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)

        whole = quad(density, -8.5, 8.5, points=[-eta / sd], limit=400, epsabs=1e-11)[0]
        assert averaged_pod(np.array(eta), sd, link=LINKS[link]) == pytest.approx(whole, abs=1e-8)


@pytest.mark.parametrize("link", LINKS)
def test_laplace_comes_near_the_integral_of_one_random_effect(link):
    # 12 looks by each of 6 networks; the integral by the trapezium rule over each network's effect
    random = np.random.default_rng(2)
    network = np.repeat(np.arange(6), 40)
    offset = random.normal(0.2, 1.0, 240)
    hits = (random.random(240) < LINKS[link].pod_from_eta(offset + 0.6 * random.normal(size=6)[network])).astype(float)
    b = np.linspace(-8, 8, 4001)
    exact = 0.0
    for level in range(6):
        mine = network == level
        up, down = LINKS[link].log_likelihood(offset[mine][:, None] + 0.6 * b)
        log_integrand = hits[mine] @ up + (1 - hits[mine]) @ down - b**2 / 2 - 0.5 * math.log(2 * math.pi)
        top = log_integrand.max()
        exact += -2 * (top + math.log(np.trapezoid(np.exp(log_integrand - top), b)))
    found = {}
    for expected in (True, False):
        laplace = Laplace(hits=hits, misses=1 - hits, first=network, second=None, link=LINKS[link], expected=expected)
        found[expected] = laplace.deviance(offset, np.array([0.6]))
    assert found[False] == pytest.approx(exact, abs=0.05)
    assert found[True] == pytest.approx(exact, abs=0.5)


def test_laplace_with_two_factors_solves_the_full_system():
    data = crossed_data(1, networks=5, images=9)
    hits = data["hits"]
    offset = -2.5 + 20 * data["size"]
    laplace = Laplace(
        hits=hits, misses=1 - hits, first=data["network"], second=data["image"], link=LINKS["logit"], expected=True
    )
    sd = np.array([0.5, 0.8])
    value = laplace.deviance(offset, sd)
    design = np.concatenate((np.eye(5)[data["network"]] * 0.5, np.eye(9)[data["image"]] * 0.8), axis=1)
    b = laplace.mode
    eta = offset + design @ b
    p = 1 / (1 + np.exp(-eta))
    assert design.T @ (hits - p) == pytest.approx(b, abs=1e-7)
    full = np.eye(14) + (design * (p * (1 - p))[:, None]).T @ design
    expected = -2 * (hits @ np.log(p) + (1 - hits) @ np.log1p(-p)) + b @ b + np.linalg.slogdet(full)[1]
    assert value == pytest.approx(expected, abs=1e-8)
    assert laplace.deviance(offset, -sd) == pytest.approx(expected, abs=1e-8)


def test_crossed_fit_is_a_minimum_of_the_deviance():
    data = crossed_data(3)
    design = np.stack((np.ones_like(data["size"]), data["size"]), axis=1)
    hits = data["hits"]
    fit = fit_mixed(design, hits, 1 - hits, factors=[data["network"], data["image"]], link=LINKS["cloglog"])
    laplace = Laplace(hits=hits, misses=1 - hits, first=data["network"], second=data["image"], link=LINKS["cloglog"])
    assert laplace.deviance(design @ fit.coefficients, fit.sd) == pytest.approx(fit.deviance, abs=1e-6)
    errors = np.sqrt(np.diag(fit.covariance))
    for index in range(4):
        for sign in (-0.2, 0.2):
            moved = np.concatenate((fit.coefficients, fit.sd))
            moved[index] += sign * errors[index]
            assert laplace.deviance(design @ moved[:2], moved[2:]) > fit.deviance


def test_names_and_order_of_networks_and_images_do_not_matter():
    data = crossed_data(4)
    random = np.random.default_rng(1)
    order = random.permutation(len(data["size"]))
    new_names = np.array([f"n{k}" for k in random.permutation(8)])
    one = fit_pod(**data, repeats="crossed")
    other = fit_pod(
        data["size"][order],
        data["hits"][order],
        network=new_names[data["network"][order]],
        image=data["image"][order],
        repeats="crossed",
    )
    assert (one.a90, one.a90_95.likelihood_ratio, one.a90_95.modified) == pytest.approx(
        (other.a90, other.a90_95.likelihood_ratio, other.a90_95.modified), rel=1e-4
    )


def test_repeats_widen_the_interval_and_the_naive_one_stands_beside():
    fit = fit_pod(**crossed_data(5, networks=20), repeats="crossed")
    assert fit.repeats == "crossed"
    assert fit.a90_95.likelihood_ratio - fit.a90 > 1.5 * (fit.naive.a90_95.likelihood_ratio - fit.naive.a90)
    assert fit.naive.repeats == "pooled"
    assert fit.crossed.a90_conditional < fit.a90
    assert fit.a90_low_two_sided.likelihood_ratio < fit.a90 < fit.a90_95.likelihood_ratio
    assert fit.a90_95.likelihood_ratio < fit.a90_95_two_sided.likelihood_ratio
    assert fit.a90_95.modified < fit.a90_95_two_sided.modified
    # Wald's bound does not stop short of the likelihood's
    assert fit.a90_95.wald >= fit.a90_95.modified
    assert fit.a90_low_two_sided.wald <= fit.a90_low_two_sided.modified


def test_without_effects_the_crossed_curve_is_the_pooled_one():
    data = crossed_data(6, networks=10, images=120, sds=(0.0, 0.0))
    fit = fit_pod(**data, repeats="crossed")
    assert fit.crossed.sd_network < 0.3
    assert fit.crossed.sd_image < 0.4
    assert fit.a90 == pytest.approx(fit.naive.a90, rel=0.02)


def test_crossed_fit_finds_the_effects_that_made_the_data():
    fit = fit_pod(**crossed_data(7, networks=30, images=120, link="logit"), repeats="crossed", link="logit")
    # standard error of a standard deviation from k levels: some sd / sqrt(2 k), more for hits and misses
    assert fit.crossed.sd_network == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(2 * 30))
    assert fit.crossed.sd_image == pytest.approx(0.8, abs=4 * 0.8 / math.sqrt(2 * 120))
    assert abs(fit.c1 - 20.0) < 4 * fit.se1


def test_the_curve_of_one_network_is_said_to_be_of_it_alone():
    data = crossed_data(8, networks=1)
    fit = fit_pod(**data, repeats="crossed")
    assert any("of this network alone" in note for note in fit.warnings)
    assert fit.a90 == pytest.approx(fit.naive.a90)


def test_one_image_is_one_size():
    fit = fit_pod(np.full(12, 0.2), np.arange(12) % 2, network=np.arange(12), image=np.zeros(12), repeats="crossed")
    assert fit.a90 is None
    assert any("same size" in note for note in fit.warnings)


def test_few_networks_widen_the_bounds_by_students_quantile():
    """The same looks at the same images: with the quantile of few networks in the place of the normal's."""
    fit = fit_pod(**crossed_data(9, networks=3, sds=(1.0, 0.5)), repeats="crossed")
    assert fit.crossed.sd_network > 0.3
    assert 1 <= fit.degrees_of_freedom < 10
    many = fit_pod(**crossed_data(9, networks=25, sds=(1.0, 0.5)), repeats="crossed")
    assert many.degrees_of_freedom > 2 * fit.degrees_of_freedom
    # nothing stands beside the bounds to say that they are not to be believed
    assert not [note for note in fit.warnings if "low" in note or "short" in note]


def test_the_mean_of_few_levels_has_their_degrees_of_freedom_and_variance():
    # looks without noise of their own: Student's t of k levels, variance sd^2 / (k - 1) from the maximum-likelihood sd
    k, sd = 4, 0.7
    found = levels_of(np.array([sd]), [np.full(k, 1 / k)], information=1e12)
    variance, freedom = found.spread(sd**2 / k, 1.0)
    assert float(variance) == pytest.approx(sd**2 / (k - 1))
    assert float(freedom) == pytest.approx(k - 1)
    # half of the variance from elsewhere: four times the degrees of freedom
    _, freedom = found.spread(sd**2 / k + sd**2 / (k - 1), 1.0)
    assert float(freedom) == pytest.approx(4 * (k - 1), rel=1e-6)


def test_clusters_alike_in_design_have_one_degree_less_than_their_number():
    data = crossed_data(12, networks=6)
    table = check_trials(data["size"], data["hits"], network=data["network"])
    curve = fit_pod(data["size"], data["hits"]).curve
    found = clustered_curve(table, curve, groups=[table.network], log_size=False)
    direction = np.array([[1.0, 0.1], [1.0, 0.3]])
    variance, freedom = found.variance(direction)
    assert freedom == pytest.approx([5.0, 5.0])
    # each leaves out a sixth of the same design: steps are 6/5 of the influence, and the variance k / (k - 1) of their squares
    scores = score_rows(table, curve, log_size=False)
    x = data["size"]
    parts = curve.link.log_parts(curve.coefficients[0] + curve.coefficients[1] * x)
    design = np.stack((np.ones_like(x), x), axis=1)
    inverse = np.linalg.inv((design * (-parts.log_hit_1 * parts.log_miss_1)[:, None]).T @ design)
    influence = np.stack([scores[data["network"] == k].sum(axis=0) for k in range(6)]) @ inverse
    assert variance == pytest.approx(1.2 * ((direction @ influence.T) ** 2).sum(axis=1))


def test_a_cluster_with_far_more_weight_than_the_others_leaves_few_degrees_of_freedom():
    random = np.random.default_rng(5)
    image = np.concatenate((np.zeros(300, int), np.arange(1, 11).repeat(6)))
    size = random.uniform(0.01, 0.35, len(image))
    hit = (random.random(len(image)) < LINKS["logit"].pod_from_eta(-2.5 + 20 * size)).astype(float)
    table = check_trials(size, hit, image=image)
    curve = fit_pod(size, hit, link="logit").curve
    found = clustered_curve(table, curve, groups=[table.image], log_size=False)
    assert 1 <= float(found.variance(np.array([1.0, 0.2]))[1]) < 3


@pytest.mark.slow
def test_bounds_of_three_networks_cover_as_often_as_they_say():
    """Looks that follow one curve and share luck by network and image (a Gaussian copula)."""
    from scipy.special import ndtr

    random = np.random.default_rng(9)
    link, (c0, c1) = LINKS["logit"], (-2.5, 20.0)
    true = (link.eta_from_pod(0.9) - c0) / c1
    network, image = (codes.ravel() for codes in np.indices((3, 60)))
    covered = []
    for _ in range(200):
        size = random.uniform(0.01, 0.45, 60)[image]
        luck = math.sqrt(0.2) * random.normal(size=3)[network] + math.sqrt(0.3) * random.normal(size=60)[image]
        hit = ndtr(luck + math.sqrt(0.5) * random.normal(size=180)) < link.pod_from_eta(c0 + c1 * size)
        fit = fit_pod(size, hit.astype(float), link="logit", repeats="cluster", network=network, image=image)
        bound = fit.a90_95.modified or fit.a90_95.likelihood_ratio
        if bound is not None:
            covered.append(bound >= true)
    assert len(covered) > 180
    # three standard errors of a share of 95 %
    assert np.mean(covered) > 0.95 - 3 * math.sqrt(0.95 * 0.05 / len(covered))


def test_two_networks_tell_no_spread_to_the_clustered_curve():
    fit = fit_pod(**crossed_data(9, networks=2), repeats="cluster")
    assert fit.a90 is not None
    assert fit.a90_95.likelihood_ratio is None
    assert fit.a90_95.wald is None
    assert any("two clusters" in note for note in fit.warnings)
    _, low, high = curve_with_band(fit, [0.1, 0.2])
    assert np.all(low < 1e-12)
    assert np.all(high > 1 - 1e-12)


def test_separated_repeats_give_the_bias_reduced_curve_without_bounds():
    size = np.tile(np.linspace(0.1, 1, 10), 3)
    fit = fit_pod(
        size,
        (size > 0.5).astype(float),
        network=np.repeat(np.arange(3), 10),
        image=np.tile(np.arange(10), 3),
        repeats="crossed",
    )
    assert fit.separated
    assert fit.method == "firth"
    assert fit.a90 is not None
    assert fit.a90_95.likelihood_ratio is None
    assert fit.a90_95_two_sided.wald is None
    assert any("there are no bounds" in note for note in fit.warnings)


def test_bias_reduction_with_random_effects_is_refused_with_a_way_out():
    with pytest.raises(InputError, match="--repeats cluster"):
        fit_pod(**crossed_data(1), repeats="crossed", method="firth")


def test_scaling_by_inspections_is_one_look_per_site():
    # every site looked at four times with the same outcome: scaling undoes the copies
    size, hit = crossed_data(10, networks=1)["size"], crossed_data(10, networks=1)["hits"]
    once = fit_pod(size, hit)
    four = fit_pod(np.tile(size, 4), np.tile(hit, 4), repeats="scaled", site=np.tile(np.arange(len(size)), 4))
    assert four.a90 == pytest.approx(once.a90, rel=1e-7)
    assert four.a90_95.likelihood_ratio == pytest.approx(once.a90_95.likelihood_ratio, rel=1e-7)
    assert four.a90_95.wald == pytest.approx(once.a90_95.wald, rel=1e-7)
    assert four.naive.a90_95.wald < once.a90_95.wald


def test_clusters_undo_copies_of_images():
    size, hit = crossed_data(10, networks=1, images=150)["size"], crossed_data(10, networks=1, images=150)["hits"]
    one = fit_pod(size, hit, repeats="cluster", image=np.arange(150))
    four = fit_pod(np.tile(size, 4), np.tile(hit, 4), repeats="cluster", image=np.tile(np.arange(150), 4))
    assert four.a90_95.wald == pytest.approx(one.a90_95.wald, rel=1e-6)
    assert four.a90_95.likelihood_ratio == pytest.approx(one.a90_95.likelihood_ratio, rel=1e-4)


def test_two_way_clusters_add_and_subtract():
    random = np.random.default_rng(1)
    scores = random.normal(size=(60, 2))
    a, b = np.repeat(np.arange(6), 10), np.tile(np.arange(10), 6)
    found = clustered_meat(scores, scores, [a, b])
    first = sum(np.outer(scores[a == k].sum(0), scores[a == k].sum(0)) for k in range(6)) * 6 / 5
    second = sum(np.outer(scores[b == k].sum(0), scores[b == k].sum(0)) for k in range(10)) * 10 / 9
    assert found == pytest.approx(first + second - scores.T @ scores)


def test_band_of_the_averaged_curve_holds_it():
    fit = fit_pod(**crossed_data(5), repeats="crossed")
    pod, low, high = curve_with_band(fit, np.linspace(0.02, 0.34, 20))
    assert np.all((low < pod) & (pod < high))
    at = curve_with_band(fit, [fit.a90])[0]
    assert at[0] == pytest.approx(0.9, abs=1e-6)


def test_bootstrap_weights_draw_whole_images_and_networks():
    table = check_trials(**crossed_data(1, networks=4, images=6))
    rng = np.random.default_rng(1)
    for by, total in (("row", 24), ("image", 24), ("network", 24)):
        weights = bootstrap_weights(table, by=by, replicates=50, rng=rng)
        assert weights.sum(axis=1) == pytest.approx(np.full(50, total))
    both = bootstrap_weights(table, by="both", replicates=50, rng=rng).reshape(50, 4, 6)
    assert both[:, 0, 0] * both[:, 1, 1] == pytest.approx(both[:, 0, 1] * both[:, 1, 0])


def test_bootstrap_spread_agrees_with_the_fit_it_resamples():
    random = np.random.default_rng(3)
    size = random.uniform(0.01, 0.35, 400)
    hit = (random.random(400) < LINKS["logit"].pod_from_eta(-3 + 25 * size)).astype(float)
    fit = fit_pod(size, hit, link="logit")
    found = bootstrap_pod(
        check_trials(size, hit), link="logit", log_size=False, by="row", replicates=800, rng=np.random.default_rng(1)
    )
    error = (fit.a90_95.wald - fit.a90) / 1.645
    # the spread of 800 replicates is known to 2.5 %; the bootstrap itself differs by some percent
    assert np.nanstd(found.a90) == pytest.approx(error, rel=0.2)
    assert fit.a90 < found.a90_95 < found.a90_high
    assert found.unknown == 0.0


def test_bootstrap_by_image_is_wider_than_by_row_where_images_repeat():
    table = check_trials(**crossed_data(11, networks=15, sds=(0.1, 1.2)))
    spreads = {
        by: np.nanstd(
            bootstrap_pod(
                table, link="cloglog", log_size=False, by=by, replicates=300, rng=np.random.default_rng(1)
            ).a90
        )
        for by in ("row", "image", "both")
    }
    assert spreads["image"] > 1.5 * spreads["row"]
    assert spreads["both"] > 0.95 * spreads["image"]


def test_bootstrap_says_what_it_lacks():
    table = check_trials([0.1, 0.2, 0.3, 0.4], [0, 1, 0, 1])
    options = {"link": "logit", "log_size": False, "replicates": 20, "rng": np.random.default_rng(1)}
    with pytest.raises(InputError, match="expected a column network"):
        bootstrap_pod(table, by="both", **options)
    with pytest.raises(InputError, match="bootstrap unit"):
        bootstrap_pod(table, by="frame", **options)
    with pytest.raises(FitError, match="nothing to bootstrap"):
        bootstrap_pod(check_trials([0.1, 0.2, 0.3], [0, 0, 1]), by="row", **options)


def test_fits_of_separated_resamples_are_unknown():
    x = np.array([0.1, 0.2, 0.3, 0.4])
    hits = np.array([[0, 0, 1, 1], [0, 1, 0, 1], [1, 1, 1, 1.0]])
    found = fit_many(x, hits, 1 - hits, link="cloglog")
    assert np.isfinite(found).all(axis=1).tolist() == [False, True, False]


def test_false_alarm_interval_is_clopper_pearson_for_independent_looks():
    # 3 of 50: 1.25 % to 16.55 % (Clopper & Pearson)
    found = false_alarm_rate([1] * 3 + [0] * 47)
    assert (found.rate, found.effective_n) == (0.06, 50)
    assert (found.low, found.high) == pytest.approx((0.01254859, 0.16548195), rel=1e-6)
    none = false_alarm_rate(np.zeros(30))
    assert (none.low, none.high) == (0.0, pytest.approx(1 - 0.025 ** (1 / 30)))


def test_false_alarms_that_come_by_image_count_less():
    # two of ten images always alarm, whatever the network
    alarm = np.tile([1, 1, 0, 0, 0, 0, 0, 0, 0, 0], 8)
    image, network = np.tile(np.arange(10), 8), np.repeat(np.arange(8), 10)
    found = false_alarm_rate(alarm, network=network, image=image)
    assert found.effective_n < 12
    assert found.high > false_alarm_rate(alarm).high + 0.1
    with pytest.raises(InputError, match="false_alarm"):
        false_alarm_rate([0, 2])


def test_few_false_alarms_are_those_of_as_many_looks_whoever_looked():
    """A second network that alarms as seldom tells more, not less; and none in 400 looks is no wider than one look an image."""
    network, image = np.repeat(np.arange(2), 200), np.tile(np.arange(200), 2)
    highs = []
    for alarms in (0, 1, 3):
        alarm = np.zeros(400)
        alarm[np.arange(alarms) * 101] = 1.0
        found = false_alarm_rate(alarm, network=network, image=image)
        assert not found.networks_differ
        highs.append(found.high)
    assert highs[0] == pytest.approx(1 - 0.025 ** (1 / 200))
    assert highs[1] == pytest.approx(false_alarm_rate(np.eye(1, 400)[0]).high, rel=0.02)
    assert highs[2] < 0.025
    # one network alone alarms: that of another may be anything
    alone = false_alarm_rate(np.where(network == 0, image % 10 == 0, 0), network=network, image=image)
    assert alone.networks_differ and alone.high > 0.5


@lru_cache(maxsize=1)
def fit_of_identical_networks() -> tuple[PodFit, PodFit]:
    """A crossed fit of three networks with the same hits, and the fit of one of them alone."""
    rng = np.random.default_rng(5)
    size = np.sort(rng.uniform(0.02, 0.15, 70))
    seen = rng.random(70) < -np.expm1(-np.exp(-3.0 + 60.0 * size))
    network, image = np.repeat(np.arange(3), 70), np.tile(np.arange(70), 3)
    fit = fit_pod(np.tile(size, 3), np.tile(seen, 3), repeats="crossed", network=network, image=image)
    return fit, fit_pod(size, seen)


def test_images_that_every_network_hits_or_misses_get_the_clustered_curve() -> None:
    """With identical networks the images' spread is larger than looks can tell: the a90 stays where misses end, and it is said."""
    fit, once = fit_of_identical_networks()
    assert fit.repeats == "cluster"
    assert any("larger than these looks can tell" in note for note in fit.warnings)
    assert fit.a90 == pytest.approx(once.a90, rel=1e-6)
    assert fit.a90_95.wald is not None and once.a90_95.wald is not None
    assert fit.a90_95.wald >= 0.9 * once.a90_95.wald


def test_a_crossed_fit_that_does_not_converge_gives_the_clustered_curve_with_its_reason(monkeypatch) -> None:
    def fails(*_, **__):
        raise FitError("the fit with crossed random effects did not converge")

    monkeypatch.setattr("raytwin.pod.repeats.fit_crossed", fails)
    data = crossed_data(2)
    fit = fit_pod(**data, repeats="crossed")
    clustered = fit_pod(**data, repeats="cluster")
    assert (fit.repeats, fit.a90, fit.a90_95) == ("cluster", clustered.a90, clustered.a90_95)
    assert fit.warnings[0] == (
        "the fit with crossed random effects did not converge: curve and bounds are the clustered ones (repeats cluster)"
    )


def test_no_bounds_are_sought_along_a_likelihood_that_rises_without_end(monkeypatch) -> None:
    """Half a minute to two minutes for sizes that the clustered curve then gave."""
    sought = []
    monkeypatch.setattr("raytwin.pod.crossed._bounds", lambda *_, **__: sought.append(1))
    fit_of_identical_networks.__wrapped__()
    assert not sought


def test_the_band_of_a_clustered_fall_back_follows_the_clustered_curve() -> None:
    """Its POD rises through 90 % at its a90, and the band holds it."""
    fit, _ = fit_of_identical_networks()
    assert fit.repeats == "cluster"
    assert fit.crossed is None
    assert fit.a90 is not None
    pod, low, high = curve_with_band(fit, np.array([0.5 * fit.a90, fit.a90, 1.2 * fit.a90]))
    assert pod[1] == pytest.approx(0.9, abs=1e-6)
    assert np.all(np.diff(pod) > 0)
    assert np.all((low <= pod) & (pod <= high))
