"""The diagnosis in words: what each verdict must say."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from raytwin.calibration.spectrum.priors import PRIORS
from raytwin.checks.findings import Finding, FindingCode
from raytwin.diagnosis.diagnose_session import _with_findings
from raytwin.diagnosis.inference.inference import UNKNOWN, Hypothesis, title_of
from raytwin.diagnosis.judgement.answer import Cause, Diagnosis, Place
from raytwin.diagnosis.judgement.held_out import Gap
from raytwin.diagnosis.judgement.judgement import verdict_of
from raytwin.diagnosis.report.explanation import answer_text, headline, lead_text, strained_text, verdict_text
from raytwin.diagnosis.report.report import next_steps
from raytwin.diagnosis.report.words import location_text, nuisance_text, share_text, statistic_text


def place(axis, series, z, *, statistic="mean frame", location=""):
    return Place(axis=axis, series=series, statistic=statistic, location=location, unit="1", z=z)


def cause(effect, probability, strength, *, unit="%"):
    return Cause(
        effect=effect,
        probability=probability,
        strength=strength,
        unit=unit,
        parameters={},
        since="always",
        shrinks_by=(0.8, 0.7, 0.9),
    )


def diagnosis(verdict, **more):
    views = [
        SimpleNamespace(session=SimpleNamespace(name=name, series=SimpleNamespace(kind=kind)))
        for name, kind in (("flat_1", "flat"), ("dark_1", "dark"), ("slab_near", "object"))
    ]
    fields = {
        "verdict": verdict,
        "gap": Gap(before=3.0, after=1.2, floor=0.8, shrinks_by=(0.82, 0.75, 0.9)),
        "where": (
            place("level", "slab_near", -44.0, location="like object_scatter width_mm 40, energy_exponent -0.8"),
            place("position", "flat_1", 26.0, location="halves along rows"),
            place("position", "flat_1", -12.0, statistic="fixed_pattern rows"),
            place("texture", "dark_1", 23.0, statistic="block_ratio"),
        ),
        "causes": (),
        "named": (),
        "findings": (),
        "no_gap_but_findings": False,
        "not_tested": {},
        "warnings": (),
        "strained": (),
        "notes": (),
        "next_measurement": None,
        "probability_no_gap": 0.0,
        "probability_unknown": 0.91,
        "unknown_location": "position of flat",
        "hypotheses": (),
        "compared": SimpleNamespace(views=views),
    }
    fields |= more
    leading = tuple(cause for cause in fields["causes"] if cause.effect in fields.get("named", ()))
    return SimpleNamespace(**fields, leading=leading)


@pytest.mark.parametrize(
    ("location", "words"),
    [
        ("like object_scatter width_mm 40, energy_exponent -0.8", "in the shape of: radiation scattered by the object"),
        ("halves along rows", "halves along rows"),
        ("", ""),
    ],
)
def test_a_location_is_words_that_a_reader_knows(location, words):
    assert location_text(location) == words


@pytest.mark.parametrize(
    ("statistic", "words"),
    [
        ("mean frame", ""),
        ("log_variance dark third", "variance of the noise, dark third"),
        ("correlation field (1,-1)", "correlation of the noise 1 rows and -1 columns apart, field"),
        ("afterglow frames 0-0", "frame 0 after the beam"),
        ("afterglow frames 3-4", "frames 3 to 4 after the beam"),
        ("fixed_pattern columns", "fixed pattern of columns"),
        ("temporal_correlation 1", "correlation of frames 1 apart"),
        ("trend first frames", "change in the first frames"),
    ],
)
def test_a_statistic_is_words_that_a_reader_knows(statistic, words):
    assert statistic_text(statistic) == words


def test_every_parameter_of_a_spectrum_has_words_and_a_kind_of_nuisance_is_told_once():
    assert not [name for name in PRIORS if nuisance_text(name) == name]
    far = (("shape 4 of discs", -14.0), ("shape 2 of discs", 9.0), ("log_mu_Al", -8.0), ("kV_tilt", 6.0), ("x", 5.0))
    text = strained_text(diagnosis("unknown_effect", strained=far))
    shown = "slow change of the field in discs (-14 sd), attenuation of Al (-8 sd), tube voltage (+6 sd) and 1 more"
    assert text.startswith(f"Far from what is known of it: {shown}.")


def test_the_printed_answer_is_a_headline_a_table_and_a_sentence_a_line():
    found = cause("object_scatter", 0.94, (12.3, 9.9, 14.8))
    lines = answer_text(
        diagnosis("explained", causes=(found,), named=("object_scatter",), notes=("three series moved",))
    ).splitlines()
    assert lines[0] == "Radiation scattered by the object, 12.3 % (9.9 to 14.8)"
    assert lines[1] == "The gap shows in brightness, pattern across the field and noise texture."
    assert lines[3] == "It is explained by:"
    assert lines[4].split("  ")[0] == "effect"
    assert lines[5].endswith("0.94         12.3 % (9.9 to 14.8)  always there  80 %")
    means = "scatter over primary at the centre of this field behind 20 mm of water, usual gap, at the reference energy"
    assert lines[6] == f"Strength (radiation scattered by the object): {means}."
    assert lines[-2].endswith("by 82 % (75 to 90) of what is above noise.")
    assert lines[-1] == "Three series moved."


def test_what_is_less_likely_but_not_out_of_the_question_is_said():
    glare = cause("veiling_glare", 1.0, (2.0, 1.5, 2.5))
    spot = cause("focal_spot", 0.46, (0.51, 0.4, 0.65), unit="mm")
    weak = cause("heel", 0.04, (3.0, 2.0, 4.0))
    told = answer_text(diagnosis("explained", causes=(glare, spot, weak), named=("veiling_glare",)))
    shown = (
        f"{title_of('focal_spot')}, 0.510 mm (0.400 to 0.650), probability 0.46; {title_of(UNKNOWN)}, probability 0.91."
    )
    assert f"Less likely, but not out of the question: {shown}" in told.splitlines()
    alone = answer_text(diagnosis("explained", causes=(glare,), named=("veiling_glare",), probability_unknown=0.01))
    assert "Less likely" not in alone


def test_an_unknown_effect_that_hardly_leads_is_said_beside_what_the_catalogue_has():
    weighed = [
        Hypothesis(effects=effects, probability=probability, log_evidence=0.0)
        for effects, probability in (((UNKNOWN,), 0.51), (("line_flicker",), 0.44), ((), 0.01))
    ]
    text = verdict_text(diagnosis("unknown_effect", probability_unknown=0.51, hypotheses=tuple(weighed)))
    flicker = title_of("line_flicker")
    assert (
        f"The catalogue explains it less well (probability 0.51 of an effect that is not in the catalogue): {flicker} (0.44)."
        in text
    )


def test_an_unknown_effect_has_its_place_and_signature_in_words():
    text = verdict_text(diagnosis("unknown_effect"))
    assert "No effect of the catalogue, and no pair of them, explains it (probability 0.91" in text
    assert "It is seen most in the pattern across the field of flats." in text
    # the largest of each kind of series and axis, largest first
    families = (
        "brightness of objects (z -44); pattern across the field of flats (z +26); noise texture of darks (z +23)"
    )
    assert f"Its signature: {families}." in text
    # a probe that looks for an effect says so in words, not by the parameters of its template
    assert "in the shape of: radiation scattered by the object" in text
    assert "width_mm" not in text


@pytest.mark.parametrize(
    ("location", "words"),
    [
        ("sharpness of object edge_far_x", "sharpness at edges of edge_far_x"),
        ("time of afterglow", "change with time of frames after the beam"),
    ],
)
def test_the_place_of_an_unknown_effect_names_scenes_and_kinds(location, words):
    assert f"It is seen most in the {words}." in verdict_text(diagnosis("unknown_effect", unknown_location=location))


def test_an_explanation_states_strength_interval_probability_and_what_is_left():
    found = cause("object_scatter", 0.94, (12.3, 9.9, 14.8))
    text = verdict_text(diagnosis("explained", causes=(found,), named=("object_scatter",)))
    assert "12.3 % (9.9 to 14.8), probability 0.94" in text
    assert "falls to 1.20 once that is added, by 82 % (75 to 90) of what is above noise" in text
    # what is left may lie below the floor by chance; no gap shrinks by more than itself
    beyond = Gap(before=3.0, after=0.78, floor=0.8, shrinks_by=(1.01, 0.97, 1.04))
    text = verdict_text(diagnosis("explained", causes=(found,), named=("object_scatter",), gap=beyond))
    assert "falls to 0.78 once that is added, by 100 % (97 to 100) of what is above noise" in text
    lower = cause("kv_error", 0.9, (-2.0, -2.5, -1.5))
    assert "-2.00 % (-2.50 to -1.50)" in verdict_text(diagnosis("explained", causes=(lower,), named=("kv_error",)))


def test_what_leaves_most_of_the_gap_is_no_explanation():
    found = cause("row_noise", 0.9, (0.9, 0.7, 1.2))
    wider = Gap(before=7.4, after=8.3, floor=0.8, shrinks_by=(-0.14, -0.77, 0.69))
    text = verdict_text(diagnosis("explained_in_part", causes=(found,), named=("row_noise",), gap=wider))
    assert "Of the catalogue it is most like: noise common to rows" in text
    assert "does not fall (8.30) once that is added." in text
    assert "explained by" not in text
    assert "What is above noise grows by 14 % (-69 to 77). The twin with it added is no better" in text
    found = diagnosis("explained_in_part", causes=(found,), named=("row_noise",), gap=wider, added=("row_noise",))
    steps = [step["text"] for step in next_steps(found)]
    assert steps[0].startswith("Keep the twin as it was")
    assert not any(text.startswith("Use the improved twin") for text in steps)
    assert headline(found).endswith("most like it, but the gap does not fall")
    assert lead_text(found).count("no better") == 1
    assert share_text(wider.shrinks_by) == "grows by 14 %"


def test_an_effect_is_observed_in_its_probes_where_the_gap_over_all_was_at_its_floor():
    found = cause("focal_spot", 0.99, (0.7, 0.53, 0.9), unit="mm")
    floor = Gap(before=0.71, after=0.70, floor=0.73, shrinks_by=None)
    seen = diagnosis("explained", causes=(found,), named=("focal_spot",), gap=floor, added=("focal_spot",))
    text = verdict_text(seen)
    assert "explained" not in text
    assert "Observed there: focal spot larger than assumed, 0.700 mm (0.530 to 0.900)" in text
    assert "0.71 (noise alone: 0.73), over all probes no more than noise, and 0.70 once that is added." in text
    assert "the gap was no more than noise (0.73) already: 0.71, and 0.70 with what was found" in lead_text(seen)
    assert next_steps(seen)[0]["text"].startswith("Use the improved twin")
    # what was no gap and is one with the effect added does not fall
    worse = diagnosis("explained", causes=(found,), named=("focal_spot",), gap=replace(floor, after=1.4), added=("x",))
    assert next_steps(worse)[0]["text"].startswith("Keep the twin as it was")


def test_a_session_whose_numbers_stop_early_has_a_gap_whatever_the_rest_says():
    items = [
        Hypothesis(effects=effects, probability=probability, log_evidence=0.0)
        for effects, probability in (((), 0.93), ((UNKNOWN,), 0.02), (("image_lag",), 0.05))
    ]
    fields = dict.fromkeys(("gap", "twin", "held_out", "ambiguous_with", "next_measurement", "problem"))
    fields |= {
        "causes": (),
        "where": (),
        "added": (),
        "named": (),
        "threshold_z": 4.0,
        "unknown_location": "level of flat",
    }
    agreed = Diagnosis(
        verdict="no_gap", hypotheses=tuple(items), probability_no_gap=0.93, probability_unknown=0.02, **fields
    )
    stops = Finding(
        code=FindingCode.STOPS,
        series="flat_1",
        others=("flat_2",),
        values={"top": 41151.0, "other": "flat_3", "reached": 50000.0},
    )
    found = _with_findings(agreed, (stops,))
    assert (found.verdict, found.unknown_location) == ("unknown_effect", "flat_1, flat_2")
    assert found.no_gap_but_findings
    steps = next_steps(replace(found, next_measurement={}))
    assert [step["text"].split(" (")[0] for step in steps] == [
        "Find what cuts the numbers off",
        "Diagnose the session again.",
    ]
    # probabilities are of the series that were compared
    assert (found.hypotheses, found.probability_no_gap) == (agreed.hypotheses, 0.93)
    assert _with_findings(replace(agreed, verdict="explained"), (stops,)).verdict == "explained"
    assert _with_findings(agreed, ()) == agreed


@pytest.mark.parametrize(
    ("weighed", "word", "leading", "tied"),
    [
        ({"a": 0.70, "": 0.30}, "explained", "a", []),
        ({"a": 0.35, "a b": 0.33, "": 0.32}, "explained", "a", []),
        ({"a": 0.59, "": 0.41}, "ambiguous", "a", ["a"]),
        ({"a": 0.55, UNKNOWN: 0.44, "b": 1e-9}, "ambiguous", "a", ["a"]),
        ({"a": 0.50, "b": 0.45, "c": 0.05}, "ambiguous", "a", ["a", "b"]),
        ({UNKNOWN: 0.50, "a": 0.45, "": 0.05}, "unknown_effect", UNKNOWN, []),
        ({"": 0.50, "a": 0.45, "b": 0.05}, "no_gap", "", []),
        ({"": 0.42, "a": 0.35, "b": 0.18, "c": 0.05}, "ambiguous", "", ["a", "b"]),
    ],
)
def test_an_effect_is_named_from_six_tenths_on_and_tied_ones_hold_nine(weighed, word, leading, tied):
    items = tuple(
        Hypothesis(effects=tuple(names.split()), probability=probability, log_evidence=0.0)
        for names, probability in weighed.items()
    )
    found = verdict_of(items)
    assert (found.word, " ".join(found.leading.effects)) == (word, leading)
    assert [" ".join(item.effects) for item in found.tied] == tied
    bent = tuple(replace(item, misfit="flats") for item in items)
    assert verdict_of(bent).word == ("explained_in_part" if word == "explained" else word)


def test_a_tie_names_its_members_and_the_measurement_that_would_break_it():
    """What is not in the catalogue among them, and two effects at once as one explanation."""
    tied = [
        Hypothesis(effects=effects, probability=probability, log_evidence=0.0)
        for effects, probability in ((("image_lag", "dark_drift"), 0.5), ((UNKNOWN,), 0.4), ((), 0.1))
    ]
    text = verdict_text(diagnosis("ambiguous", hypotheses=tied, next_measurement={"text": "take beam-off frames"}))
    both = f"{title_of('image_lag')} with {title_of('dark_drift')} (0.50)"
    assert (
        f"cannot distinguish between {both}, an effect that is not in the catalogue (0.40), no effect (0.10)." in text
    )
    assert text.rstrip(".").endswith("To distinguish them: take beam-off frames")


def test_no_gap_says_how_sure_it_is_and_wrong_labels_come_before_everything():
    assert "probability 0.87 that nothing is missing" in verdict_text(diagnosis("no_gap", probability_no_gap=0.87))
    wrong = Finding(code=FindingCode.LABEL, series="flat_1", values={"what": "looks like 60 kV (labelled 90 kV)"})
    text = answer_text(
        diagnosis(
            "unknown_effect", findings=(wrong,), no_gap_but_findings=True, probability_no_gap=0.87, warnings=("flat_1",)
        )
    )
    assert text.splitlines()[:2] == [
        "Labels look wrong",
        "flat_1: looks like 60 kV (labelled 90 kV): correct the label, or leave the series out",
    ]
    assert "The other series agree with the twin (probability 0.87 that nothing is missing in them)" in text
