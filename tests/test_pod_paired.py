"""Tables of the same images and networks compared: intervals hold what each table's exposure adds, and answers stand."""

import math
from dataclasses import replace

import numpy as np
import pytest

import raytwin as rt
from raytwin.pod import LINKS, Trials, check_trials, compare_pod, fit_pod
from raytwin.pod.paired_spread import difference_spread

SHARED = {"shared_images": True, "shared_networks": True}


def two_exposures(
    random: np.random.Generator, networks: int = 4, images: int = 60, sds=(0.3, 2.0, 4.0), curve=(-26, 140)
) -> list[Trials]:
    """Two tables of one curve, its images and networks: what the noise of an exposure does to an image, all networks see."""
    size = random.uniform(0.01, 0.35, images)
    of_network, of_image = random.normal(0, sds[0], networks)[:, None], random.normal(0, sds[1], images)
    tables = []
    for _ in range(2):
        eta = curve[0] + curve[1] * size + of_network + of_image + random.normal(0, sds[2], images)
        network, image = np.indices(eta.shape)
        hits = (random.random(eta.shape) < LINKS["cloglog"].pod_from_eta(eta)).astype(float)
        tables.append(check_trials(np.tile(size, networks), hits.ravel(), network=network.ravel(), image=image.ravel()))
    return tables


def test_images_of_one_name_that_hold_other_objects_are_not_paired():
    rng = np.random.default_rng(2)
    names = [f"{number:05d}" for number in range(40)]
    size = rng.uniform(1.0, 5.0, 40)
    hit = (rng.random(40) < 1.0 / (1.0 + np.exp(6.0 - 2.0 * size))).astype(int)
    jars = {"image": names, "size": size, "hit": hit}
    order = rng.permutation(40)
    castings = {"image": names, "size": size[order], "hit": hit[order]}
    again = {"image": names, "size": size * rng.uniform(0.9, 1.1, 40), "hit": hit}  # the same ones, measured anew
    told = "images of the same name hold objects of other sizes"
    assert any(told in note for note in rt.compare(jars, castings).warnings)
    for same in (jars, again):
        assert not any(told in note for note in rt.compare(jars, same).warnings)
    assert not any(told in note for note in rt.compare(jars, castings, unpaired=True).warnings)
    ends = [rt.compare(jars, castings, unpaired=unpaired).comparison.ratio_a90 for unpaired in (False, True)]
    assert ends[0] == ends[1]


def test_intervals_hold_the_noise_of_each_exposure_that_all_networks_see():
    """4 networks that mostly agree at 60 images, few of them on the rise of the curve; the true ratio is 1."""
    random = np.random.default_rng(7)
    inside = []
    for _ in range(150):
        ratio = compare_pod(*two_exposures(random), repeats="cluster", **SHARED).ratio_a90
        if ratio.low is not None and ratio.high is not None:
            inside.append(ratio.low <= 1 <= ratio.high)
    assert len(inside) > 140
    # three standard errors of a share of 95 %
    assert np.mean(inside) > 0.95 - 3 * math.sqrt(0.95 * 0.05 / len(inside))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("networks", "images", "repeats", "count"),
    [
        (4, 40, "cluster", 400),
        (4, 80, "cluster", 400),
        (4, 110, "cluster", 400),
        (10, 80, "cluster", 400),
        (4, 80, "crossed", 40),
    ],
)
def test_paired_intervals_cover_as_often_as_they_say(networks, images, repeats, count):
    random = np.random.default_rng(17)
    inside = []
    for _ in range(count):
        ratio = compare_pod(*two_exposures(random, networks, images), repeats=repeats, **SHARED).ratio_a90
        if ratio.low is not None and ratio.high is not None:
            inside.append(ratio.low <= 1 <= ratio.high)
    assert np.mean(inside) > 0.95 - 3 * math.sqrt(0.95 * 0.05 / len(inside))


def test_the_order_of_two_tables_does_not_matter():
    one, two = two_exposures(np.random.default_rng(3))
    there, back = (compare_pod(*pair, repeats="cluster", **SHARED) for pair in ((one, two), (two, one)))
    assert back.difference_a90.low == pytest.approx(-there.difference_a90.high, rel=1e-9)
    assert back.ratio_a90.high == pytest.approx(1 / there.ratio_a90.low, rel=1e-9)
    assert back.correlation == pytest.approx(there.correlation, rel=1e-9)


def test_the_spread_of_a_difference_is_that_of_fits_without_each_image():
    one, two = two_exposures(np.random.default_rng(4), sds=(0.5, 1.0, 1.0))
    curves = [fit_pod(table.size, table.hits).curve for table in (one, two)]
    alone = [replace(table, network=None) for table in (one, two)]
    found = difference_spread(alone, curves, shared=["image"], log_size=False)
    kept = [one.image != image for image in range(60)]
    a90 = np.array([[fit_pod(table.size[rows], table.hits[rows]).a90 for table in (one, two)] for rows in kept])
    change = a90[:, 1] - a90[:, 0] - (fit_pod(two.size, two.hits).a90 - fit_pod(one.size, one.hits).a90)
    assert found.sd == pytest.approx(math.sqrt(59 / 60 * (change @ change)), rel=1e-6)
    apart = difference_spread(alone, curves, shared=[], log_size=False)
    assert apart.correlation == pytest.approx(0.0, abs=1e-12)
    assert difference_spread([one, one], [curves[0]] * 2, shared=["image", "network"], log_size=False).sd < 1e-12


@pytest.mark.parametrize("seed", [3, 11, 17])
def test_exposures_anew_are_not_two_curves_to_the_crossed_test(seed):
    """Pairs whose p was 0.03 and less where noise that all networks see was taken as noise of single looks."""
    pair = two_exposures(np.random.default_rng(seed), sds=(0.3, 1.0, 2.5), curve=(-17, 90))
    test = compare_pod(*pair, repeats="crossed", **SHARED).curve_test
    assert test is not None and "crossed" in test.kind
    assert test.p > 0.05


def agreeing_tables() -> list[Trials]:
    """Four networks that agree at all of 21 images, and four of which two miss one image more."""
    size = np.round(np.linspace(0.5, 2.5, 21), 3)
    seen = (size > 0.85) & (np.arange(21) != 5) | (np.arange(21) == 2)
    network, image = np.indices((4, 21))
    less = seen & ~((image == 6) & (network % 2 == 0))
    return [
        check_trials(np.tile(size, 4), hit.ravel().astype(float), network=network.ravel(), image=image.ravel())
        for hit in (np.broadcast_to(seen, (4, 21)), less)
    ]


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("repeats", ["crossed", "cluster"])
def test_networks_that_all_agree_are_compared(link, repeats):
    one, two = agreeing_tables()
    for pair in ((one, one), (one, two), (two, one)):
        found = compare_pod(*pair, link=link, repeats=repeats, **SHARED)
        assert found.ratio_a90.value is not None
        assert found.curve_test is not None or any("no test of the whole curves" in note for note in found.warnings)
        if pair[0] is pair[1]:
            assert found.curve_test is None or found.curve_test.p == pytest.approx(1.0)
