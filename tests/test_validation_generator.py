"""The comparison of generated frames with the lab's, in short form, and its classifiers on problems with a known answer."""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / "validation"


@pytest.fixture(scope="module")
def classifiers():
    sys.path.insert(0, str(FOLDER))
    try:
        yield import_module("patch_classifiers")
    finally:
        sys.path.remove(str(FOLDER))


def test_the_area_under_the_curve_counts_pairs(classifiers):
    assert classifiers.auc(np.array([0.0, 1.0]), np.array([2.0, 3.0])) == 1.0
    assert classifiers.auc(np.array([1.0, 1.0]), np.array([1.0])) == 0.5
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=50).round(1), rng.normal(0.5, 1, 70).round(1)
    pairs = (second[None] > first[:, None]).mean() + 0.5 * (second[None] == first[:, None]).mean()
    assert classifiers.auc(first, second) == pytest.approx(pairs, abs=1e-12)


def test_patches_are_cut_on_a_grid(classifiers):
    images = np.arange(2 * 1 * 20 * 24, dtype=np.float32).reshape(2, 1, 20, 24)
    patches = classifiers.patches_of(images, 8, 8)
    assert patches.shape == (2, 6, 1, 8, 8)
    np.testing.assert_array_equal(patches[1, 4, 0], images[1, 0, 8:16, 8:16])


@pytest.mark.parametrize("way", ["statistics", pytest.param("network", marks=pytest.mark.slow)])
def test_classifiers_see_a_change_of_texture_and_nothing_where_there_is_none(classifiers, way):
    rng = np.random.default_rng(2)

    def noise(count, blurred):
        values = rng.normal(size=(count, 2, 17, 17))
        smooth = 0.5 * values[..., 1:, 1:] + 0.5 * values[..., :-1, :-1]
        return (smooth * np.sqrt(2) if blurred else values[..., 1:, 1:]).astype(np.float32)

    def auc_of(kinds):
        train, test = [noise(300, one) for one in kinds], [noise(300, one) for one in kinds]
        if way == "statistics":
            train, test = ([classifiers.statistics_of(one) for one in part] for part in (train, test))
            return classifiers.auc(*classifiers.logistic_scores(train, test))
        return classifiers.auc(*classifiers.network_scores(train, test, epochs=12, seed=1))

    assert auc_of((False, True)) > 0.9
    # 300 against 300 without difference: standard error 0.024
    assert auc_of((False, False)) == pytest.approx(0.5, abs=0.1)


@pytest.mark.slow
def test_generated_frames_are_as_near_to_the_lab_s_as_the_lab_s_own_sessions(classifiers):
    validation = import_module("generator_vs_lab")
    result = validation.run(0, validation.SHORT, network=True, output=None)
    rows = result["statistics"]

    # edges of hundreds of frames show the hundredth of the light whose place flats leave open
    edges = [row for row in rows if row["statistic"] == "edge profile"]
    assert all(abs(row["told transmissions"]["error_percent"]) < 1.0 for row in edges)

    def mean_distance(kind):
        return np.mean([row[kind]["distance"] for row in rows if row not in edges])

    # four replicates of eight frames: the lab's own sessions come out at 1.0 to 1.3
    assert mean_distance("told transmissions") < 1.1 * mean_distance("lab again") + 0.1
    for row in rows:
        if not row["statistic"].startswith("histogram"):
            assert abs(row["from maps"]["error_percent"]) < 4.0, row
    aucs = {(row["patch"], row["classifier"], row["kind"]): row for row in result["classifiers"]}
    # four objects to test on: differences of AUC scatter by 0.05
    for patch in (16, 64):
        assert abs(aucs[patch, "statistics", "from references"]["difference"]) < 0.2
        assert aucs[patch, "statistics", "as published"]["auc"] > 0.95
