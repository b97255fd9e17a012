"""POD fits against published worked examples and against other software's printed figures."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest

from raytwin.pod import fit_pod, fit_response_pod

EXAMPLES = Path(__file__).parent / "pod_examples"


def columns(name: str) -> dict[str, list[str]]:
    with (EXAMPLES / name).open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    return {key: [row[key] for row in rows] for key in rows[0]}


def numbers(values: list[str]) -> np.ndarray:
    return np.array(values, dtype=float)


@pytest.fixture(scope="module")
def example3() -> tuple[np.ndarray, np.ndarray]:
    data = columns("hdbk_ex3.csv")
    return numbers(data["size"]), numbers(data["hit"])


def test_handbook_example_3_to_the_printed_digits(example3):
    # MIL-HDBK-1823A (2009) figures G-32, G-40
    fit = fit_pod(*example3, link="logit")
    assert fit.n == 134
    assert round(fit.a50, 4) == 0.1156
    assert round(fit.a90, 4) == 0.1709
    assert round(fit.a90_95_two_sided.likelihood_ratio, 4) == 0.1974


def test_handbook_example_3_on_log_size_to_the_printed_digits(example3):
    # figure G-44
    fit = fit_pod(*example3, link="logit", log_size=True)
    assert round(fit.a90_95_two_sided.likelihood_ratio, 4) == 0.2106


def test_handbook_example_4_to_the_printed_digits():
    # figure G-45; mu is the 63.2 % size under cloglog
    data = columns("hdbk_ex4.csv")
    fit = fit_pod(numbers(data["size"]), numbers(data["hit"]), link="cloglog")
    assert round(-fit.c0 / fit.c1, 4) == 0.0975
    assert round(1 / fit.c1, 6) == 0.040710  # printed 0.040711
    assert round(fit.a90, 4) == 0.1315
    assert round(fit.a90_95_two_sided.likelihood_ratio, 4) == 0.1553


def test_handbook_example_5_with_repeated_inspections_to_the_printed_digits():
    # figure G-46: the handbook divides the log-likelihood by the number of inspections of a site
    data = columns("hdbk_ex5.csv")
    fit = fit_pod(
        numbers(data["size"]), numbers(data["hit"]), link="logit", log_size=True, repeats="scaled", site=data["target"]
    )
    assert round(fit.a50, 5) == 0.06016
    assert round(fit.a90, 4) == 0.1888
    assert round(fit.a90_95_two_sided.likelihood_ratio, 4) == 0.2621
    # taken as independent the 933 looks promise too much
    assert fit.naive.a90_95_two_sided.likelihood_ratio < 0.23


def test_handbook_example_1_response_against_size_to_the_printed_digits():
    # figures G-4, G-6: response as it is against ln size, decision 200, censored at 50 and 1375
    data = columns("hdbk_ex1_ahat.csv")
    fit = fit_response_pod(
        numbers(data["size"]), numbers(data["ahat"]), decision=200, left=50, right=1375, log_size=True
    )
    assert round(fit.mu, 3) == 2.175
    assert round(fit.sigma, 5) == 0.28542
    assert round(fit.a50, 1) == 8.8
    assert round(fit.a90, 2) == 12.69
    assert round(fit.a90_95.wald, 2) == 13.68


@pytest.mark.parametrize(
    ("link", "intercept", "slope", "deviance"),
    [("cloglog", -39.572, 22.041, 3.45), ("logit", -60.717, 34.270, 11.23), ("probit", -34.935, 19.728, 10.12)],
)
def test_bliss_beetles_to_the_printed_digits(link, intercept, slope, deviance):
    # Dobson & Barnett, tables 7.2-7.4
    data = columns("beetle_bliss.csv")
    fit = fit_pod(numbers(data["log10_dose"]), numbers(data["killed"]), trials=numbers(data["n"]), link=link)
    assert fit.c0 == pytest.approx(intercept, abs=6e-4)
    assert fit.c1 == pytest.approx(slope, abs=6e-4)
    assert round(fit.deviance, 2) == deviance
    assert (fit.n, fit.n_hits) == (481, 291)


# R 4.2.2 on hdbk_ex3.csv: glm with epsilon 1e-14: coefficients, errors, deviance
R_ML = {
    "cloglog": (-3.2799466739, 23.6696534449, 0.596741828206, 4.02549054669, 77.4913283482),
    "logit": (-4.5973666045, 39.7654290592, 0.877619624583, 6.95350052847, 77.4938106357),
    "probit": (-2.6239965862, 22.6110316538, 0.461077648895, 3.54902945272, 77.1563483784),
}


@pytest.mark.parametrize("link", R_ML)
def test_maximum_likelihood_agrees_with_r_glm(example3, link):
    fit = fit_pod(*example3, link=link, method="ml")
    assert [fit.c0, fit.c1, fit.se0, fit.se1, fit.deviance] == pytest.approx(R_ML[link], rel=1e-6)


# brglm2 0.9, type AS_mean, epsilon 1e-13; loglog as cloglog of the misses on the size with its sign turned
R_FIRTH = {
    "cloglog": (-3.11435698365, 22.3514510303, 0.566746364988, 3.75749055586),
    "loglog": (-2.42565401072, 25.8424819392, 0.463878172207, 4.17048692286),
    "logit": (-4.3822774149, 37.89090148, 0.839086415127, 6.58212297285),
    "probit": (-2.50854418343, 21.5989033182, 0.443418494572, 3.36948459803),
}


@pytest.mark.parametrize("link", R_FIRTH)
def test_bias_reduced_fit_agrees_with_r_brglm2_for_every_link(example3, link):
    fit = fit_pod(*example3, link=link, method="firth")
    assert [fit.c0, fit.c1, fit.se0, fit.se1] == pytest.approx(R_FIRTH[link], rel=1e-8)
    assert "AS_mean" in fit.variant


@pytest.mark.parametrize(
    ("link", "expected"),
    [
        ("cloglog", (-2.75289503643, 0.65244397755, 2.06448996979, 0.468900265475)),
        ("logit", (-3.95119370997, 1.12891248856, 3.18702529352, 0.854908336688)),
        ("probit", (-2.26866182208, 0.648189092021, 1.65440438939, 0.437992881998)),
    ],
)
def test_bias_reduced_fit_of_separated_data_agrees_with_r_brglm2(link, expected):
    fit = fit_pod([1, 2, 3, 4, 5, 6], [0, 0, 0, 1, 1, 1], link=link, method="firth")
    assert fit.separated
    assert [fit.c0, fit.c1, fit.se0, fit.se1] == pytest.approx(expected, rel=1e-7)


# lme4 1.1-31, glmer(hit ~ log(size) + (1 | inspection) + (1 | target)), tolPwrss 1e-12
R_MIXED = {
    "logit": (
        (6.37881882278, 2.25890695041),
        (0.566839386536, 0.212326277067),
        0.147400564189,
        1.30792391479,
        823.288419,
    ),
    "cloglog": (
        (3.39959006179, 1.3401461559),
        (0.380450849093, 0.147508395873),
        0.0453730093798,
        0.87835710501,
        846.840047,
    ),
}


@pytest.mark.parametrize("link", R_MIXED)
def test_crossed_random_effects_agree_with_r_lme4(link):
    data = columns("hdbk_ex5.csv")
    fit = fit_pod(
        numbers(data["size"]),
        numbers(data["hit"]),
        link=link,
        log_size=True,
        repeats="crossed",
        network=data["inspection"],
        image=data["target"],
    )
    coefficients, errors, sd_inspection, sd_target, deviance = R_MIXED[link]
    assert (fit.c0, fit.c1) == pytest.approx(coefficients, rel=1e-3)
    assert (fit.se0, fit.se1) == pytest.approx(errors, rel=2e-3)
    assert fit.crossed.sd_network == pytest.approx(sd_inspection, rel=2e-3)
    assert fit.crossed.sd_image == pytest.approx(sd_target, rel=1e-3)
    assert -2 * fit.log_likelihood == pytest.approx(deviance, abs=1e-4)


def test_averaged_a90_is_where_the_mean_over_networks_and_images_is_90_percent():
    data = columns("hdbk_ex5.csv")
    fit = fit_pod(
        numbers(data["size"]),
        numbers(data["hit"]),
        link="logit",
        log_size=True,
        repeats="crossed",
        network=data["inspection"],
        image=data["target"],
    )
    # the mean over normal effects, by the trapezium rule rather than by the fit's quadrature
    spread = math.hypot(fit.crossed.sd_network, fit.crossed.sd_image)
    z = np.linspace(-9, 9, 20001)
    pod = 1 / (1 + np.exp(-(fit.c0 + fit.c1 * math.log(fit.a90) + spread * z)))
    mean = np.trapezoid(pod * np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi), z)
    assert mean == pytest.approx(0.9, abs=1e-6)
    assert fit.crossed.a90_conditional < fit.a90
