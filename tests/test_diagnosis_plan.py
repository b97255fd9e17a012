"""What a measurement set can tell apart, and refinement, on problems whose truth is planted."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest

from raytwin.acquisition.setting import setting_from_text
from raytwin.diagnosis.advice.plan import Proposal, advice_text, best_repeat, distinguishability, table_text
from raytwin.diagnosis.inference.curve_fits import fit_effects
from raytwin.diagnosis.inference.inference import weigh_hypotheses
from raytwin.diagnosis.inference.nuisances import Nuisances
from raytwin.diagnosis.inference.observed import Observed, Point
from raytwin.diagnosis.inference.refine import refine
from raytwin.diagnosis.inference.seen import Blocks
from raytwin.diagnosis.inference.unknown import Families
from raytwin.diagnosis.judgement.judgement import _threshold
from raytwin.diagnosis.model.changes import Variant, catalogue_variants
from raytwin.diagnosis.model.curves import Curve, node_weights
from raytwin.diagnosis.problem.problem import Problem
from raytwin.diagnosis.problem.series_block import jitter_of
from raytwin.generator.effects import EFFECTS, AppliedEffect
from raytwin.generator.effects._light_spread import spread_transfer
from raytwin.generator.effects.misregistration import parts_px
from raytwin.generator.frames.line_model import LineModel
from raytwin.generator.line.series_request import SeriesRequest

PROBES = 60


def curve(effect, direction, *, low=1.0, high=100.0, since="always"):
    variant = Variant(effect=effect, since=since, low=low, high=high, strengths=(10.0,))
    return Curve(variant=variant, responses=10.0 * np.asarray(direction)[None, :])


def axis(*places):
    result = np.zeros(PROBES)
    result[list(places)] = 1.0
    return result


def problem(curves, *, factors=None, noise=1.0):
    return SimpleNamespace(
        residual=np.zeros(PROBES),
        factors=np.zeros((PROBES, 1)) if factors is None else factors,
        blocks=np.repeat([0, 1, 2], PROBES // 3),
        series_of=np.repeat([0, 1, 2], PROBES // 3),
        noise=np.full(PROBES, noise),
        curves=tuple(curves),
        views=[SimpleNamespace(session=SimpleNamespace(name=f"series {number}")) for number in range(3)],
    )


def open_problem(curves, *, border_inflow=None):
    """A problem whose forward model can be asked again for what an effect lets in by chance."""
    own = problem(curves)
    whole = Problem(**{item.name: getattr(own, item.name, None) for item in fields(Problem)})
    return replace(whole, again=SimpleNamespace(border_inflow=lambda _: border_inflow))


def test_effects_at_right_angles_lie_as_far_apart_as_from_nothing_and_parallel_ones_not_at_all():
    found = distinguishability(
        problem(
            [
                curve("veiling_glare", axis(0)),
                curve("k_fluorescence", axis(1)),
                curve("dark_drift", 2.0 * axis(0), high=1000.0),
            ]
        )
    )
    assert found.from_none == pytest.approx([10.0, 10.0, 2.0 * np.sqrt(1000.0)])
    assert found.between[0, 1] == pytest.approx(10.0, rel=0.01)
    # at another strength the parallel effect comes as near as the grid of strengths allows
    assert found.between[0, 2] < 1.0
    text = table_text(found)
    assert "drift" in text.splitlines()[1]
    assert text.splitlines()[2].endswith("-")


def test_an_effect_is_planned_with_its_usual_onset_and_middling_inner_parameters_in_the_catalogues_order():
    tails = [curve("mtf_tail", size * axis(0), since="calibration") for size in (0.2, 0.7, 0.6)]
    hidden = curve("mtf_tail", 0.01 * axis(0))
    lag = curve("image_lag", 0.2 * axis(1), high=10.0)
    found = distinguishability(problem([lag, hidden, *tails, curve("veiling_glare", axis(2), since="calibration")]))
    assert found.effects == tuple(effect for effect in EFFECTS if effect in {"veiling_glare", "mtf_tail", "image_lag"})
    row = found.effects.index("mtf_tail")
    assert found.since[row] == "calibration"  # a tail that was always there is taken in by calibration
    assert found.from_none[row] == pytest.approx(0.6 * 10.0)
    assert found.seen_from[row] == pytest.approx(5.0 / 0.6, rel=0.04)
    assert found.seen_from[found.effects.index("image_lag")] == np.inf
    glare = found.effects.index("veiling_glare")
    assert found.since[glare] == "calibration"  # there is no other
    lines = table_text(found).splitlines()
    assert lines[1 + row].split()[:4] == ["mtf_tail", "calibration", f"{found.seen_from[row]:.3g}", "10"]
    assert lines[1 + found.effects.index("image_lag")].split()[2] == "-"


def test_a_nuisance_along_an_effect_takes_its_separation():
    bare = distinguishability(problem([curve("veiling_glare", axis(0)), curve("k_fluorescence", axis(1))]))
    held = distinguishability(
        problem([curve("veiling_glare", axis(0)), curve("k_fluorescence", axis(1))], factors=7.0 * axis(0)[:, None])
    )
    assert held.from_none[0] == pytest.approx(bare.from_none[0] / np.sqrt(50.0), rel=1e-6)
    assert held.from_none[1] == pytest.approx(bare.from_none[1], rel=1e-6)


def test_the_series_that_holds_the_difference_is_the_one_to_repeat():
    first, second = curve("glare", axis(0, 25)), curve("scatter", axis(0))
    one, other = ([Point(curve=own, strength=10.0, level=0.0)] for own in (first, second))
    found = best_repeat(problem([first, second]), one, other)
    assert found is not None
    assert found.series == "series 1"
    assert found.separation == pytest.approx(10.0)
    # four times the frames halve a standard deviation that is all counting noise
    assert found.separation_then == pytest.approx(20.0)
    stiff = best_repeat(problem([first, second], noise=0.0), one, other)
    assert stiff is not None
    assert stiff.separation_then == pytest.approx(stiff.separation)
    # however far they are apart already: that has not told one from the other
    assert found.settles and not stiff.settles
    assert best_repeat(problem([first]), one, one) is None


def test_nodes_are_joined_by_cubics():
    nodes = np.array([0.5, 1.0, 2.0, 4.0])
    at = np.array([0.2, 0.7, 1.5, 3.0, 4.5])
    assert node_weights(nodes, at) @ (nodes**3 - nodes) == pytest.approx(at**3 - at)
    # fewer nodes and 0 carry what they can
    assert node_weights(nodes[:3], at) @ (nodes[:3] ** 3 - nodes[:3]) == pytest.approx(at**3 - at)
    assert node_weights(nodes[:2], at) @ (nodes[:2] ** 2 - nodes[:2]) == pytest.approx(at**2 - at)
    assert node_weights(nodes[1:2], at) @ (3.0 * nodes[1:2]) == pytest.approx(3.0 * at)


def refined(variants, law, residual, blocks=None, asked_of=None):
    """What refinement makes of variants whose responses (probe,) are `law(parameters, strength)`."""

    def answer(asked, wanted=None):
        if asked_of is not None:
            asked_of.append(wanted)
        return {
            number: np.stack([law(item.parameters, strength) for strength in item.strengths])
            for number, item in enumerate(asked)
        }

    curves = [Curve(variant=item, responses=answer([item])[0]) for item in variants]
    groups = np.zeros(PROBES, dtype=np.intp)
    observed = Observed(
        residual=residual, nuisances=Nuisances(np.zeros((PROBES, 1))), groups=groups, places=groups, series=groups
    )
    hypotheses = weigh_hypotheses(
        [(observed, fit_effects(observed, curves))], families=Families(of=groups, names=("all",))
    )
    return refine(
        hypotheses,
        curves=curves,
        observed=observed,
        respond=answer,
        whitening=SimpleNamespace(apply=lambda vectors: vectors),
        blocks=blocks,
    )


def test_the_lesser_of_two_effects_is_asked_where_the_other_one_was_found():
    x = np.linspace(0.0, 3.0, PROBES)
    rng = np.random.default_rng(3)
    of_voltage = rng.standard_normal(PROBES)

    def law(parameters, strength):
        if "length_mm" not in parameters:
            return 4.0 * strength * of_voltage
        return 400.0 * strength * np.exp(-((x - np.log(parameters["length_mm"])) ** 2))

    variants = [
        item
        for item in catalogue_variants()
        if (item.effect, item.since) == ("veiling_glare", "always") or (item.effect == "kv_error" and item.sign > 0)
    ]
    true = next(item.parameters["length_mm"] for item in variants if item.effect == "veiling_glare") * 1.2
    residual = law({"length_mm": true}, 2.0) + law({}, 3.0) + rng.standard_normal(PROBES)
    found = [item for item, _ in refined(variants, law, residual)]
    (voltage,) = (item for item in found if item.beside is not None)
    assert voltage.effect == "kv_error"
    assert voltage.beside.id == "veiling_glare"
    assert voltage.beside.parameters["strength"] == pytest.approx(2.0, rel=0.1)
    assert voltage.beside.parameters["length_mm"] == pytest.approx(true, rel=0.1)


def test_refinement_asks_the_series_that_tell_most_and_all_of_them_in_the_end():
    x = np.linspace(0.0, 3.0, PROBES)

    def law(parameters, strength):
        return 40.0 * strength * np.exp(-((x - np.log(parameters["length_mm"])) ** 2))

    variants = [item for item in catalogue_variants() if item.effect == "veiling_glare" and item.since == "always"]
    lengths = [item.parameters["length_mm"] for item in variants]
    true = float(np.sqrt(lengths[0] * lengths[-1]))
    residual = law({"length_mm": true}, 2.0) + np.random.default_rng(1).standard_normal(PROBES)
    of = np.arange(PROBES) * 10 // PROBES
    asked: list = []
    found = refined(variants, law, residual, Blocks(of=of, costs=np.ones(10)), asked)
    everywhere = refined(variants, law, residual)
    parts = [wanted for wanted in asked if wanted is not None]
    assert len(parts) > 3
    assert all(0.2 < wanted.mean() <= 0.7 for wanted in parts)
    assert asked[-1] is None  # the curve that is kept holds all probes
    assert found[0][1].shape == everywhere[0][1].shape
    lengths_found = [item[0][0].parameters["length_mm"] for item in (found, everywhere)]
    assert lengths_found[0] == pytest.approx(lengths_found[1], rel=0.02)


def test_refinement_finds_an_inner_parameter_between_the_grid_s():
    x = np.linspace(0.0, 3.0, PROBES)

    def law(parameters, strength):
        return 40.0 * strength * np.exp(-((x - np.log(parameters["length_mm"])) ** 2))

    variants = [item for item in catalogue_variants() if item.effect == "veiling_glare" and item.since == "always"]
    lengths = [item.parameters["length_mm"] for item in variants]
    true = float(np.sqrt(lengths[0] * lengths[-1]))
    found = refined(variants, law, law({"length_mm": true}, 2.0) + np.random.default_rng(1).standard_normal(PROBES))
    assert len(found) == 2  # from the two best starts
    closer, responses = found[0]
    assert abs(np.log(closer.parameters["length_mm"] / true)) < 0.5 * abs(np.log(lengths[0] / true))
    assert responses.shape == (3, PROBES)
    assert closer.strengths[1] == pytest.approx(2.0, rel=0.15)


def test_where_no_effect_explains_more_than_nothing_none_is_refined():
    frequency = np.linspace(0.0, 0.5, PROBES)

    def law(parameters, strength):
        return 40.0 * strength * frequency / parameters["length_mm"]

    variants = [item for item in catalogue_variants() if item.effect == "veiling_glare" and item.since == "always"]
    rng = np.random.default_rng(1)
    assert refined(variants, law, rng.standard_normal(PROBES)) == []
    assert refined(variants, law, law({"length_mm": 5.0}, 2.0) + rng.standard_normal(PROBES)) != []


def test_refinement_follows_a_response_that_is_not_in_proportion_to_the_strength():
    x = np.linspace(0.0, 3.0, PROBES)

    def law(parameters, strength):
        wide = strength**2 * np.array([parameters["aspect"], 1.0 / parameters["aspect"]])
        rows, columns = (60.0 * (one * (0.4 + x)) ** 2 for one in wide)
        return np.where(np.arange(PROBES) % 2 == 0, rows, columns)

    variants = [item for item in catalogue_variants() if item.effect == "focal_spot"]
    noise = np.random.default_rng(1).standard_normal(PROBES)
    found = refined(variants, law, law({"aspect": 1.0}, 0.92) + noise)
    for closer, _ in found:
        assert closer.strengths[1] == pytest.approx(0.92, rel=0.03)
        assert closer.parameters["aspect"] == pytest.approx(1.0, rel=0.03)


def test_refinement_keeps_its_direction_where_two_parameters_explain_alike():
    """A share that spreads farther in another shape: from an exponential's cusp to a Gaussian, the range hardly changed."""
    frequency = np.linspace(0.0, 0.5, PROBES)

    def law(parameters, strength):
        spread = spread_transfer(
            frequency,
            0.0 * frequency,
            reach_px=parameters["range_mm"] / 0.12,
            order=parameters["order"],
            usual_order=0.5,
        )
        return 2.0 * strength * (1.0 - spread)

    variants = [item for item in catalogue_variants() if item.effect == "k_fluorescence" and item.since == "always"]
    true = {"range_mm": 0.21, "order": 5.0}
    found = refined(variants, law, law(true, 16.0) + np.random.default_rng(1).standard_normal(PROBES))
    best = min((item for item, _ in found), key=lambda item: abs(item.parameters["order"] - true["order"]))
    assert best.parameters["order"] > 2.5
    assert best.parameters["range_mm"] == pytest.approx(true["range_mm"], rel=0.1)
    assert best.strengths[1] == pytest.approx(16.0, rel=0.1)


def test_a_misregistration_that_shifts_and_turns_is_found_from_its_two_parts():
    """No small step of the angles leads from a mere turn to a shift, or from a mere shift to a turn against the slope."""
    rng = np.random.default_rng(4)
    shown = 20.0 * rng.standard_normal((4, PROBES))

    def law(parameters, strength):
        shift, radial, turn = parts_px(
            strength,
            magnification_deg=parameters["magnification_deg"],
            rotation_deg=parameters["rotation_deg"],
        )
        angle = np.radians(parameters["direction_deg"])
        return np.array([shift * np.cos(angle), shift * np.sin(angle), radial, turn]) @ shown

    variants = [item for item in catalogue_variants() if item.effect == "misregistration"]
    true = {"direction_deg": 222.0, "magnification_deg": 0.0, "rotation_deg": -38.5}
    found = refined(variants, law, law(true, 2.13) + rng.standard_normal(PROBES))
    together = [item for item, _ in found if "distorted" in item.name]
    assert len(together) == 1
    assert together[0].strengths[1] == pytest.approx(2.13, rel=0.03)
    assert together[0].parameters["rotation_deg"] == pytest.approx(-38.5, abs=2.0)
    assert together[0].parameters["direction_deg"] == pytest.approx(222.0, abs=2.0)


def test_what_flats_or_darks_show_and_calibration_takes_in_only_in_part_is_tried_with_both_onsets():
    onsets = {}
    for variant in catalogue_variants():
        onsets.setdefault(variant.effect, set()).add(variant.since)
    # a tail that was always there is a part of the spread
    taken_in_whole = {
        "kv_error",
        "filtration_error",
        "gain_map_error",
        "tile_gain",
        "excess_noise",
        "bad_pixels",
        "random_telegraph",
        "mtf_tail",
        "grey_absorber",
        "threshold_error",
    }
    for name, effect in EFFECTS.items():
        if "flat" not in effect.shows.series:
            assert onsets[name] == {"always"}  # objects alone: they calibrate nothing
        else:
            assert onsets[name] == ({"calibration"} if name in taken_in_whole else {"always", "calibration"})


def test_a_repeat_that_would_settle_a_tie_is_proposed_and_one_that_would_not_gives_way_to_what_isolates():
    good = Proposal(what="take dark_100ms again", series="dark_100ms", separation=2.0, separation_then=3.9)
    text = advice_text([good], ["dark_drift"], ["image_lag"], lately=False)
    titles = [EFFECTS[effect].title for effect in ("dark_drift", "image_lag")]
    assert text == (
        f"take dark_100ms again, which would tell {titles[0]} from {titles[1]} by 3.9 standard deviations instead of 2.0"
    )
    poor = Proposal(what="take flat_90kV again", series="flat_90kV", separation=1.6, separation_then=1.7)
    new = Proposal(
        what="measure edges", name="edges", measured=({"kind": "object"},), separation=1.6, separation_then=2.2
    )
    explained = (["filtration_error", "row_noise"], ["kv_error", "row_noise"])
    assert advice_text([poor, replace(new, separation_then=5.0)], *explained, lately=True).startswith(
        "measure edges, which"
    )
    for proposals, lately, late in (([poor], True, False), ([poor, new], False, False), ([poor, new], True, True)):
        text = advice_text(proposals, *explained, lately=lately)
        assert text.startswith("nothing that was weighed tells")
        assert ("among the calibrating series" in text) == late
        assert EFFECTS["kv_error"].isolated_by in text
        assert EFFECTS["filtration_error"].isolated_by in text
        assert EFFECTS["row_noise"].isolated_by + ";" not in text


@pytest.mark.parametrize(("since", "calibrating"), [("always", 1.0), ("calibration", 0.0)])
def test_lines_give_each_series_that_has_them_chance_by_their_direction(since, calibrating):
    def block(calibrates):
        lines = np.array([[1.0, 2.0, 0.0], [10.0, 20.0, 0.0]])
        return SimpleNamespace(lines=lines, session=SimpleNamespace(calibrates=calibrates))

    blocks = [block(True), block(False)]

    def jitter(share, **bands):
        parameters = {"column_share": share, **bands}
        return jitter_of(SimpleNamespace(effect="row_noise", since=since, parameters=parameters), blocks, 3.0)

    of_rows = np.array([9 * calibrating, 18 * calibrating, 0, 9, 18, 0])
    assert jitter(0.0) == pytest.approx(of_rows, rel=1e-3)
    assert jitter(1.0) == pytest.approx(10 * of_rows, rel=1e-3)
    assert jitter(0.0, together_lines=2.0) == pytest.approx(of_rows / np.tanh(0.25))
    assert jitter_of(SimpleNamespace(effect="kv_error"), blocks, 3.0) is None


@pytest.mark.parametrize(("since", "calibrating"), [("always", 1.0), ("calibration", 0.0)])
def test_lines_of_light_give_lit_series_chance_the_more_the_more_lines_go_together(since, calibrating):
    def block(calibrates):
        lines = np.array([[1.0, 2.0, 0.0], [10.0, 20.0, 0.0]])
        return SimpleNamespace(lit_lines=lines, session=SimpleNamespace(calibrates=calibrates))

    blocks = [block(True), block(False)]

    def jitter(share, together):
        parameters = {"column_share": share, "together_lines": together}
        return jitter_of(SimpleNamespace(effect="line_flicker", since=since, parameters=parameters), blocks, 3.0)

    # of a sum over lines that are alike over L of them the variance is coth(1 / 2 L) times that of lines of their own
    for share, one in ((0.0, 1.0), (1.0, 10.0)):
        for together in (0.3, 6.0):
            more = one / np.tanh(0.5 / together)
            assert jitter(share, together) == pytest.approx(
                [more * calibrating, 2 * more * calibrating, 0, more, 2 * more, 0]
            )


def test_a_refined_variant_keeps_what_its_own_onset_does_by_chance():
    """Lost bits that came after the calibration lower later levels; those that were always there do not."""
    always = curve("quantisation", axis(0))
    later = replace(curve("quantisation", axis(0), since="calibration"), spread=axis(1)[:, None])
    whole = open_problem([always, later])
    variant = next(
        item for item in catalogue_variants() if item.effect == "quantisation" and item.since == "calibration"
    )
    found = whole.with_variants([(variant, np.stack([axis(0)] * len(variant.strengths)))]).curves[-1]
    assert found.variant.since == "calibration"
    np.testing.assert_array_equal(found.spread, later.spread)


def test_a_refined_variant_keeps_what_the_one_it_came_from_does_by_chance():
    """More of a heel on one side hangs on the direction in which it falls."""
    turned = [item for item in catalogue_variants() if item.effect == "heel" and item.since == "always"]
    own = [
        Curve(variant=item, responses=axis(0)[None, :], spread=axis(number)[:, None])
        for number, item in enumerate(turned)
    ]
    whole = open_problem(own)
    for start, like in zip(turned, own, strict=True):
        refined = start.refined({**start.parameters, "curvature": 0.31}, (3.0, 4.0))
        assert refined.name.endswith(f"refined from {start.name}") and refined.strengths == (3.0, 4.0)
        found = whole.with_variants([(refined, np.stack([axis(0)] * 2))]).curves[-1]
        np.testing.assert_array_equal(found.spread, like.spread)


def test_a_refined_variant_lets_in_what_its_own_strengths_do():
    glare = next(item for item in catalogue_variants() if item.effect == "veiling_glare")
    whole = open_problem(
        [Curve(variant=glare, responses=axis(0)[None, :], spread=axis(1)[:, None])], border_inflow=axis(2)[:, None]
    )
    found = whole.with_variants([(glare, np.stack([axis(0)] * len(glare.strengths)))]).curves[-1]
    np.testing.assert_array_equal(found.spread, axis(2)[:, None])


@pytest.mark.parametrize("effect", sorted(EFFECTS))
def test_where_an_effect_is_said_not_to_show_the_forward_model_is_as_without_it(make_model_twin, effect):
    twin = make_model_twin((24, 24), readout_ms=2.0)
    setting = setting_from_text("kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05")
    flat = SeriesRequest(kind="flat", setting=setting, frames=6, exposure_ms=20.0, start_s=10.0)
    dark = SeriesRequest(kind="dark", setting=None, frames=6, exposure_ms=20.0, start_s=20.0, previous=(flat,))
    slab = {"water": np.full((24, 24), 20.0)}
    scene = replace(flat, kind="object", thickness_mm=slab, scene_kind="slab", source_object_mm=300.0)
    scene = replace(scene, source_detector_mm=600.0, product_material="water")
    strong = next(item for item in EFFECTS[effect].parameters if item.name == "strength").high
    asked = [flat, dark, replace(dark, kind="afterglow"), scene]
    for request in asked:
        applied = AppliedEffect(id=effect, parameters={"strength": strong}, since="always")
        if request.kind in EFFECTS[effect].shows.series:
            continue
        with_it = LineModel(twin, effects=(applied,), use_measured_level=False).expect(request)
        without = LineModel(twin, effects=(), use_measured_level=False).expect(request)
        for name in ("mean_DN", "quantum_variance_DN2", "white_variance_DN2", "row_variance_DN2", "frame_factor_rms"):
            assert np.array_equal(getattr(with_it, name), getattr(without, name)), (request.kind, name)
    # objects show whatever there is
    assert scene.kind in EFFECTS[effect].shows.series


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_one_session_in_twenty_without_a_gap_shows_a_place_at_the_most(alike):
    rng = np.random.default_rng(12)
    common = rng.standard_normal((4000, 1))
    probes = np.sqrt(alike) * common + np.sqrt(1.0 - alike) * rng.standard_normal((4000, 60))
    shown = np.mean(np.max(np.abs(probes), axis=1) > _threshold(60))
    assert shown < 0.062  # of 4000, three standard deviations above 0.05
    assert alike or shown > 0.038


def test_an_exact_law_is_brought_nearer_than_one_that_may_be_off():
    x = np.linspace(0.0, 3.0, PROBES)

    def law(parameters, strength):
        return 4000.0 * strength * np.exp(-((x - np.log(parameters["length_mm"])) ** 2) * (1.0 + parameters["order"]))

    variants = [item for item in catalogue_variants() if item.effect == "veiling_glare" and item.since == "always"]
    residual = law({"length_mm": 4.0, "order": 1.7}, 2.0) + np.random.default_rng(2).standard_normal(PROBES)
    found = refined(variants, law, residual)[0][0]
    left = [float(np.sum((residual - law(found.parameters, strength)) ** 2)) for strength in np.linspace(1.9, 2.1, 401)]
    assert min(left) < 2.0 * PROBES  # of 1e8: a tenth of it off, the search would end at 9e6
    assert found.parameters["order"] == pytest.approx(1.7, rel=0.01)
