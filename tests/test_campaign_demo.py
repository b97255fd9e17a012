"""The demo's last chapter and its page: withheld products before and after, what the answer says, what a missing a90 needs."""

import csv
import dataclasses
import io

import numpy as np
import pytest

from raytwin.acquisition import open_acquisition
from raytwin.calibration.calibrate import calibrate_twin
from raytwin.campaign.demo_gap import (
    WithheldFrame,
    answer_text,
    compare_products,
    planted_effect,
    withheld_rows,
    withheld_text,
)
from raytwin.campaign.figures import exposures_chart, gap_parts, pod_chart, withheld_pictures
from raytwin.campaign.report import _bounds, missing_a90
from raytwin.diagnosis.report.figures import gap_chart
from raytwin.generator.effects import AppliedEffect
from raytwin.lab.protocols import run_protocol
from raytwin.lab.unkindness import NONE


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """A session without any effect, with products, and the twin of its calibrating series."""
    path = tmp_path_factory.mktemp("bench") / "session.h5"
    run_protocol(
        path,
        protocol="full",
        seed=5,
        rows=48,
        frames=4,
        products=1,
        families=(),
        unkindness=NONE,
        only=["filtered_flats", "product"],
        leave_out=["middle_exposures"],
    )
    with open_acquisition(path) as session:
        part = dataclasses.replace(session, series=tuple(item for item in session.series if item.role == "calibration"))
        return path, calibrate_twin(part, rng=np.random.default_rng(0))


@pytest.mark.slow
def test_products_agree_with_a_twin_that_lacks_nothing_and_depart_from_one_with_scatter_that_is_not_there(line):
    path, twin = line
    scatter = (AppliedEffect(id="object_scatter", parameters={"strength": 30.0}),)
    frames = compare_products(path, before=twin, after=dataclasses.replace(twin, effects=scatter), seed=0)
    assert {(frame.kV, frame.exposure_ms) for frame in frames} == {
        (kV, exposure_ms) for kV in (40.0, 90.0) for exposure_ms in (25.0, 100.0)
    }
    for frame in frames:
        plain, scattered = frame.error_percent(frame.before_DN), frame.error_percent(frame.after_DN)
        assert abs(plain) < 1.5  # layers are as stated to 0.7 %
        assert scattered > plain + 1.0  # scatter adds light behind the product
        assert 0.5 < frame.departure(frame.before_DN) < frame.departure(frame.after_DN)
    pictures = withheld_pictures(frames)
    assert [picture.title for picture in pictures[:3]] == [
        f"measured, {pictures[0].title.removeprefix('measured, ')}",
        "measured over twin, before",
        "measured over twin, after",
    ]
    longest = [frame for frame in frames if frame.exposure_ms == 100.0]
    assert len(pictures) == 3 * len(longest)
    for frame, before, after in zip(longest, pictures[1::3], pictures[2::3], strict=True):
        assert np.array_equal(np.isfinite(before.values), frame.inside)
        # scatter that is not there: the twin is brighter than what was measured
        assert np.nanmean(after.values) < np.nanmean(before.values)


def one_frame(before, after):
    shape = (4, 4)
    full = {name: np.full(shape, value) for name, value in (("before_DN", before), ("after_DN", after))}
    return WithheldFrame(
        series="product1_40kV_100ms",
        kV=40.0,
        exposure_ms=100.0,
        measured_DN=np.full(shape, 1000.0),
        noise_DN=np.full(shape, 5.0),
        inside=np.eye(4, dtype=bool),
        **full,
    )


def test_a_withheld_frame_is_told_in_percent_and_in_units_of_noise():
    frame = one_frame(980.0, 1001.0)
    assert withheld_rows([frame]) == [
        {
            "name": "product 1, 40 kV, 100 ms",
            "error_before": "-2.00 %",
            "error_after": "+0.10 %",
            "departure_before": "4.0",
            "departure_after": "0.2",
        }
    ]
    assert "off by 2.00 %; with the effect added it is off by 0.10 %" in withheld_text([frame])


def diagnosis(verdict, *effects):
    strength = {"value": 9.8, "low": 7.9, "high": 12.1, "unit": "%"}
    return {
        "verdict": verdict,
        "gap": {"before": 6.6, "after": 1.0, "floor": 0.9, "shrinks_by": None},
        "causes": [
            {"effect": effect, "probability": 0.9 / (1 + number), "parameters": {"strength": strength}}
            for number, effect in enumerate(effects)
        ],
        "held_out": [{"axis": "level", "before": 20.0, "after": 1.5, "floor": 0.4}],
    }


@pytest.mark.parametrize(
    ("verdict", "effects", "told", "not_told"),
    [
        ("explained", ("object_scatter",), "9.8 % (95 %: 7.9 to 12.1), probability 0.90", "cannot tell"),
        ("ambiguous", ("object_scatter", "heel"), "cannot tell it from", "named no effect"),
        ("unknown_effect", ("object_scatter",), "named no effect (verdict: unknown effect)", "9.8"),
        ("no_gap", (), "named no effect (verdict: no gap)", "9.8"),
    ],
)
def test_the_chapter_says_what_the_diagnosis_said_and_no_more(verdict, effects, told, not_told):
    found = diagnosis(verdict, *effects)
    text = answer_text({"truth": {"effect": planted_effect(), "strength": 10.0, "unit": "%"}, "diagnosis": found})
    assert told in text
    assert not_told not in text
    assert "from 6.6 to 1.0" in text
    rows = list(csv.DictReader(io.StringIO(gap_chart(gap_parts(found), added=True).numbers_csv())))
    assert [(row["mark"], row["name"], row["x"]) for row in rows if row["name"] == "all"] == [
        ("before", "all", "6.6"),
        ("after", "all", "1"),
        ("noise alone", "all", "0.9"),
    ]


def test_charts_of_detection_hold_every_trial_and_every_a90():
    rng = np.random.default_rng(3)
    contrast = rng.uniform(0.01, 0.2, 60)
    trials = [
        {"contrast": f"{one:.4f}", "hit": str(int(rng.random() < one / 0.1)), "network": str(number % 2)}
        for number, one in enumerate(contrast)
    ]
    entry = {"a90": 0.09, "low": 0.07, "high": 0.12}
    rows = [
        {"exposure_ms": 1000.0, "real": entry, "generated": None},
        {"exposure_ms": 50.0, "real": None, "generated": entry},
    ]
    told = list(csv.DictReader(io.StringIO(exposures_chart(rows).numbers_csv())))
    assert [(row["mark"], row["name"], row["y_low"]) for row in told] == [
        ("measured", "1000 ms", "0.07"),
        ("generated", "50 ms", "0.07"),
    ]
    answers = {"test_50ms": {"a90": 0.09, "a90_low_two_sided": {"likelihood_ratio": 0.07}, "a90_95_two_sided": {}}}
    chart = pod_chart({"test_50ms": trials}, answers, 50.0)
    told = list(csv.DictReader(io.StringIO(chart.numbers_csv())))
    assert sum(row["name"] in ("0", "1") for row in told) == len(trials)
    assert [row["x"] for row in told if row["name"] == "a90"] == ["0.09"]
    # a curve of all trials, and one of each network that its own trials support
    assert {"generated"} <= {row["mark"] for row in told}


@pytest.mark.parametrize(
    ("hit_from", "needed"),
    [(0.15, "more contrast"), (0.0, "less contrast"), (None, "needs more objects there")],
)
def test_a_missing_a90_says_which_objects_it_needs(hit_from, needed):
    contrasts = np.linspace(0.02, 0.16, 40)
    hits = (contrasts > 0.125) | (np.arange(40) % 2 == 0) if hit_from is None else contrasts >= hit_from
    table = [{"exposure_ms": 20.0, "real": {"a90": None}, "generated": {"a90": 0.1}, "compare": None}]
    rows = [{"contrast": f"{c}", "hit": f"{int(h)}"} for c, h in zip(contrasts, hits, strict=True)]
    rows.append({"contrast": "", "hit": ""})  # a product without bone is no look at one
    (line,) = missing_a90(table, {"real_20ms": rows})
    assert line.startswith("20 ms, measured: ")
    assert needed in line


@pytest.mark.parametrize(
    ("low", "high", "told"),
    [(0.1, 0.2, "0.100 to 0.200"), (0.1, None, "from 0.100"), (None, 0.2, "up to 0.200"), (None, None, "no bounds")],
)
def test_an_interval_says_which_bounds_it_has(low, high, told):
    assert _bounds(low, high) == told


def test_options_of_the_shared_start_belong_to_the_papers_size(tmp_path, refused_line):
    assert "--first-steps: got without --paper-size" in refused_line(
        "demo", "-o", tmp_path / "demo", "--first-steps", "3"
    )
    assert not (tmp_path / "demo").exists()
