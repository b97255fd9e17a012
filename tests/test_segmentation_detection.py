"""When an object counts as detected, and the intervals of rates."""

import csv

import numpy as np
import pytest
from scipy.stats import binomtest

from raytwin.errors import InputError
from raytwin.segmentation import (
    Detection,
    detect_in_image,
    rate_of_crossed_trials,
    recall_in_mask,
    summarise_detections,
    write_detections,
)

HEADER = [
    "contrast",
    "size_mm",
    "hit",
    "network",
    "image",
    "foreign_object",
    "setting",
    "false_alarm",
    "recall",
    "response",
    "product",
]


def _row(**changes):
    values = {
        "contrast": 0.05,
        "size_mm": 3.0,
        "hit": True,
        "network": 0,
        "image": "a",
        "foreign_object": "rib",
        "setting": "s",
        "false_alarm": None,
        "recall": 0.5,
        "response": 0.9,
        "product": "p",
    }
    return Detection(**(values | changes))


def test_a_recall_of_exactly_a_tenth_is_a_miss_and_one_pixel_more_a_hit():
    mask = np.zeros((10, 10), dtype=np.uint8)
    mask[:2] = 1
    probabilities = np.zeros((10, 10))
    probabilities[0, :2] = 0.9
    assert detect_in_image(probabilities, mask) == (False, None, 0.1, 0.9)
    probabilities[0, 2] = 0.6
    hit, false_alarm, recall, response = detect_in_image(probabilities, mask)
    assert (hit, false_alarm, response) == (True, None, 0.9)
    assert recall == pytest.approx(0.15)


def test_a_probability_at_the_threshold_is_not_marked():
    mask = np.ones((2, 2), dtype=np.uint8)
    assert detect_in_image(np.full((2, 2), 0.5), mask)[0] is False
    assert detect_in_image(np.full((2, 2), 0.5), mask, threshold=0.49)[0] is True


def test_marks_beside_the_object_do_not_make_a_hit():
    mask = np.zeros((6, 6), dtype=np.uint8)
    mask[0, 0] = 1
    probabilities = np.ones((6, 6))
    probabilities[0, 0] = 0.2
    assert detect_in_image(probabilities, mask) == (False, None, 0.0, 0.2)


def test_one_marked_pixel_in_a_product_without_object_is_a_false_alarm():
    empty = np.zeros((5, 5), dtype=np.uint8)
    probabilities = np.full((5, 5), 0.4)
    assert detect_in_image(probabilities, empty) == (False, False, None, 0.4)
    probabilities[4, 4] = 0.7
    assert detect_in_image(probabilities, empty) == (True, True, None, 0.7)


def test_recall_of_an_empty_mask_is_undefined():
    assert np.isnan(recall_in_mask(np.ones((3, 3)), np.zeros((3, 3))))


def test_detection_refuses_masks_of_another_shape_and_probabilities_that_are_none():
    with pytest.raises(InputError, match=r"foreign-object mask: got shape \(4, 4\); expected shape \(5, 5\)"):
        detect_in_image(np.zeros((5, 5)), np.zeros((4, 4)))
    for wrong in (np.nan, 1.1, -0.1):
        with pytest.raises(InputError, match=r"probabilities: got a value outside 0\.\.1"):
            detect_in_image(np.full((5, 5), wrong), np.zeros((5, 5)))


@pytest.mark.parametrize(("hits", "n"), [(0, 30), (1, 30), (17, 30), (30, 30)])
def test_one_network_gives_the_clopper_pearson_interval_of_scipy(hits, n):
    rate = rate_of_crossed_trials(np.arange(n) < hits, networks=np.zeros(n), images=np.arange(n))
    expected = binomtest(hits, n).proportion_ci(0.95, method="exact")
    assert (rate.low, rate.high) == pytest.approx((expected.low, expected.high), abs=1e-9)
    assert (rate.value, rate.n) == (hits / n, n)


def test_identical_networks_are_worth_one():
    one = np.random.default_rng(0).random(40) < 0.3
    alone = rate_of_crossed_trials(one, networks=np.zeros(40), images=np.arange(40))
    repeated = rate_of_crossed_trials(
        np.tile(one, 10), networks=np.repeat(np.arange(10), 40), images=np.tile(np.arange(40), 10)
    )
    # the variance of 40 images is known with 39 degrees of freedom, which alone is that of a binomial: 5 % of the number
    assert (repeated.low, repeated.high) == pytest.approx((alone.low, alone.high), abs=0.01)
    assert repeated.low < alone.low
    assert repeated.high > alone.high


def test_few_networks_that_differ_widen_the_interval_by_students_quantile():
    # three networks with shares 0.2, 0.5 and 0.8: t of two degrees of freedom leaves (1.96 / 4.30)^2 of the looks' worth
    hits = np.concatenate([np.arange(100) < 100 * share for share in (0.2, 0.5, 0.8)])
    networks, images = (
        np.repeat(np.arange(3), 100),
        np.concatenate([np.random.default_rng(k).permutation(100) for k in range(3)]),
    )
    found = rate_of_crossed_trials(hits, networks=networks, images=images)
    mean_error = np.std([0.2, 0.5, 0.8], ddof=1) / np.sqrt(3)
    assert found.high - found.low > 2 * 1.96 * mean_error
    assert found.low < 0.5 - 1.9 * mean_error


def test_two_networks_that_agree_are_not_worth_less_than_their_images():
    """One alarm of two networks at 13 images: as often as by chance, and no sign that networks differ."""
    alarms = np.arange(26) == 17
    found = rate_of_crossed_trials(alarms, networks=np.repeat([0, 1], 13), images=np.tile(np.arange(13), 2))
    assert 0.1 < found.high < 0.25 and found.low > 1e-4


def test_independent_trials_are_worth_all_of_them():
    values = np.random.default_rng(1).random(50 * 40) < 0.3
    rate = rate_of_crossed_trials(values, networks=np.repeat(np.arange(50), 40), images=np.tile(np.arange(40), 50))
    binomial = binomtest(int(values.sum()), values.size).proportion_ci(0.95)
    assert rate.high - rate.low == pytest.approx(binomial.high - binomial.low, rel=0.35)
    assert rate.high - rate.low >= 0.99 * (binomial.high - binomial.low)


def test_crossed_intervals_cover_the_true_rate_where_naive_ones_do_not():
    generator = np.random.default_rng(2)
    truth, covered, naive = 0.5, 0, 0
    trials = 200
    for _ in range(trials):
        image_effect, network_effect = generator.normal(size=60), 0.7 * generator.normal(size=(12, 1))
        values = image_effect + network_effect + generator.normal(size=(12, 60)) > 0
        rate = rate_of_crossed_trials(
            values.ravel(), networks=np.repeat(np.arange(12), 60), images=np.tile(np.arange(60), 12)
        )
        covered += rate.low <= truth <= rate.high
        interval = binomtest(int(values.sum()), values.size).proportion_ci(0.95)
        naive += interval.low <= truth <= interval.high
    # 95 % of 200 is 190 with a standard deviation of 3.1
    assert covered >= 180
    assert naive < 140


def test_no_trials_give_no_rate():
    rate = rate_of_crossed_trials(np.array([]), networks=np.array([]), images=np.array([]))
    assert (rate.value, rate.low, rate.high, rate.n) == (None, None, None, 0)


def test_the_summary_counts_objects_and_clean_products_apart():
    rows = [
        _row(image="a"),
        _row(image="b", hit=False, recall=0.0),
        _row(image="c", contrast=None, size_mm=None, foreign_object="", hit=True, false_alarm=True, recall=None),
    ]
    rates = summarise_detections(rows)
    assert (rates["hit_rate"].value, rates["hit_rate"].n) == (0.5, 2)
    assert rates["recall"].value == pytest.approx(0.25)
    assert (rates["false_alarm_rate"].value, rates["false_alarm_rate"].n) == (1.0, 1)


def test_the_table_has_its_columns_and_empty_cells_for_clean_products(tmp_path):
    rows = [_row(), _row(contrast=None, size_mm=None, foreign_object="", hit=False, false_alarm=False, recall=None)]
    assert write_detections(tmp_path / "hits.csv", rows) == 2
    with open(tmp_path / "hits.csv", newline="") as stream:
        header, bone, clean = csv.reader(stream)
    assert header == HEADER
    assert bone == ["0.05", "3", "1", "0", "a", "rib", "s", "", "0.5", "0.9", "p"]
    assert clean == ["", "", "0", "0", "a", "", "s", "0", "", "0.9", "p"]


def test_a_table_that_fails_half_way_leaves_nothing_behind(tmp_path):
    def broken():
        yield _row()
        raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        write_detections(tmp_path / "hits.csv", broken())
    assert not list(tmp_path.iterdir())
