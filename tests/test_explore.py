"""What the explorer shows of a state: the numbers of the commands, images with their noise, limits, files it writes."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import raytwin as rt
from raytwin.acquisition.setting import Filter, setting_from_text
from raytwin.campaign.sweep_add import add_setting
from raytwin.campaign.sweep_file import read_campaign
from raytwin.errors import FileFormatError, InputError
from raytwin.explore.known_pod import read_known_pod
from raytwin.explore.page import added_text, numbers_text, object_diameter_mm
from raytwin.explore.picture import draw_pair
from raytwin.explore.server import tunnel_command
from raytwin.explore.state import ExplorerState, first_state, ranges_of
from raytwin.explore.view import Explorer, ExplorerView

LOW = "kv=40,power_w=45,exposure_ms=20,filter=Cu:0.05"
HIGH = "kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05"


@pytest.fixture(scope="module")
def explorer() -> Explorer:
    return Explorer(rt.read_twin("virtual_lab"), name="virtual_lab")


@pytest.fixture(scope="module")
def state(explorer: Explorer) -> ExplorerState:
    return first_state(explorer.twin)


@pytest.fixture(scope="module")
def view(explorer: Explorer, state: ExplorerState) -> ExplorerView:
    return explorer.view(state)


def test_the_first_state_is_what_was_calibrated(state: ExplorerState) -> None:
    assert str(state.setting("low")) == LOW
    assert str(state.setting("high")) == HIGH


def test_numbers_are_those_of_the_commands(view: ExplorerView) -> None:
    twin = rt.read_twin("virtual_lab")
    for beam, text in ((view.low, LOW), (view.high, HIGH)):
        theirs = twin.predict(text)
        assert beam.prediction is not None
        for name in ("mean_DN", "sd_DN", "gain_DN", "photons_absorbed", "air_kerma_uGy"):
            assert getattr(beam.prediction, name) == getattr(theirs, name)
    theirs = rt.contrast(
        twin=twin,
        low=LOW,
        high=HIGH,
        product="chicken_breast:20",
        foreign_object="bone_cortical_icru44:1",
        object_pixels=100,
    ).contrast
    assert view.contrast == theirs
    assert view.limits == ()
    assert view.dose_uGy is not None
    assert view.dose_uGy.low < view.dose_uGy.value < view.dose_uGy.high
    assert view.dose_uGy.value == pytest.approx(
        sum(beam.prediction.air_kerma_uGy.value for beam in (view.low, view.high))  # type: ignore[union-attr]
    )
    assert view.pairs_per_s == pytest.approx(1000.0 / (2 * (20.0 + 2.0)))  # two frames, each with 2 ms of readout


def test_what_was_kept_of_other_states_changes_no_number(explorer: Explorer, state: ExplorerState) -> None:
    wanted = replace(state, kV_low=47.5, exposure_ms=33.0, object_pixels=30, displaces=True)
    for other in (replace(wanted, exposure_ms=5.0), replace(wanted, kV_high=70.0), replace(wanted, power_low_W=10.0)):
        explorer.view(other)
    fresh = Explorer(rt.read_twin("virtual_lab"), name="virtual_lab").view(wanted)
    assert explorer.view(wanted).contrast == fresh.contrast
    assert explorer.view(wanted).low.prediction == fresh.low.prediction


def test_spectra_hold_the_photons_that_reach_a_pixel(view: ExplorerView) -> None:
    for beam in (view.low, view.high):
        width = float(beam.energies_keV[1] - beam.energies_keV[0])
        opened, behind = (float(one.sum()) * width for one in (beam.open_photons, beam.product_photons))
        assert beam.prediction is not None and beam.prediction.photons_absorbed is not None
        # 0.5 mm of caesium iodide takes half of the photons or more, and never more than there are
        assert 1.0 < opened / beam.prediction.photons_absorbed.value < 2.0
        assert 0.0 < behind < opened
        assert beam.open_photons[beam.energies_keV > beam.setting.kV * 1.02].sum() < 1e-3 * beam.open_photons.sum()


def test_images_have_the_contrast_and_the_noise_that_were_predicted(explorer: Explorer, state: ExplorerState) -> None:
    """Means within four standard errors, noise within four of its own, in a large object and around it."""
    wide = replace(state, object_pixels=1600)
    found = explorer.view(wide)
    assert found.images is not None and found.contrast is not None and found.images.whole
    side = found.images.log_low.shape[0]
    rows, columns = np.indices((side, side)) - side // 2
    distance = np.hypot(rows, columns)
    radius = np.sqrt(1600 / np.pi)
    inside, around = distance < radius - 3, (distance > radius + 3) & (columns > -0.3 * side)
    for image, channel in (
        (found.images.log_low, found.contrast.low),
        (found.images.log_high, found.contrast.high),
    ):
        for where, mean, sd in (
            (inside, channel.M_object, channel.sd_M_object),
            (around, channel.M_product, channel.sd_M_product),
        ):
            values = image[where].astype(float)
            # the spread ties neighbours: a third of the pixels count as independent
            independent = values.size / 3
            assert abs(values.mean() - mean - 0.5 * sd**2) < 4 * sd / np.sqrt(independent)
            assert abs(values.std() / sd - 1) < 4 / np.sqrt(2 * independent)


def test_the_size_seen_is_that_of_an_observer_of_discs(
    explorer: Explorer, state: ExplorerState, view: ExplorerView
) -> None:
    seen = view.seen_size
    assert seen is not None and seen.a90_mm is not None and seen.networks is None
    theirs = rt.observe(
        "virtual_lab",
        (LOW, HIGH),
        product=str(state.product),
        foreign_object=state.foreign_object.material,
        shape="plate",
        height_mm=state.foreign_object.thickness_mm,
    )
    assert seen.a90_mm == pytest.approx(theirs.rows[0]["a90"]["value"], rel=0.03)
    across = object_diameter_mm(state, explorer.instrument.pixel_mm / explorer.instrument.magnification)
    assert seen.pod == pytest.approx(np.interp(across, theirs.sizes, theirs.pod[0]), abs=0.05)
    longer = explorer.view(replace(state, exposure_ms=2 * state.exposure_ms)).seen_size
    assert longer.a90_mm < seen.a90_mm and longer.pod > seen.pod
    text = numbers_text(view, explorer)
    assert f"{seen.a90_mm:.3g} mm across; POD of the disc shown {100 * seen.pod:.3g} %" in text


def test_a_seed_gives_its_noise_and_another_one_another(explorer: Explorer, state: ExplorerState) -> None:
    first, again = explorer.view(state).images, explorer.view(state).images
    other = explorer.view(replace(state, seed=2)).images
    assert first is not None and again is not None and other is not None
    np.testing.assert_array_equal(first.log_low, again.log_low)
    assert not np.array_equal(first.log_low, other.log_low)


def test_limits_that_are_broken_are_said_and_numbers_stay(explorer: Explorer, state: ExplorerState) -> None:
    found = explorer.view(replace(state, power_high_W=130.0))
    assert found.limits == ("90 kV: 130 W; at most the tube's 90 W",)
    assert found.high.prediction is not None and found.contrast is not None
    bright = explorer.view(replace(state, exposure_ms=800.0))
    assert [text for text in bright.limits if re.match(r"90 kV: the detector saturates: \d+ DN above dark", text)]
    assert bright.high.full_scale_share is not None and bright.high.full_scale_share > 1
    assert not set(bright.cautions) & set(bright.limits)
    assert bright.seen_size is not None and bright.seen_size.a90_mm is None and bright.seen_size.pod is None
    assert "saturates" in bright.seen_size.reason
    with pytest.raises(InputError, match=r"at most the tube's 90 W"):
        explorer.twin.predict(kV=90, power_W=130, exposure_ms=20)


def test_all_declared_limits_are_named_at_once(state: ExplorerState) -> None:
    twin = rt.read_twin("virtual_lab")
    twin = replace(twin, instrument=replace(twin.instrument, maximum_kV=80.0, maximum_current_mA=0.4))
    found = Explorer(twin, name="t").view(state)
    assert found.limits == (
        "40 kV: 1.125 mA; at most the tube's 0.4 mA",
        "90 kV: 90 kV; at most the tube's 80 kV",
        "90 kV: 0.5 mA; at most the tube's 0.4 mA",
    )


def test_a_pair_that_is_none_keeps_its_flats(explorer: Explorer, state: ExplorerState) -> None:
    found = explorer.view(replace(state, kV_low=90.0, kV_high=60.0))
    assert found.contrast is None
    assert found.low.prediction is not None
    assert any("the lower kV first" in text for text in found.limits)


def test_what_nothing_gets_through_is_told(explorer: Explorer, state: ExplorerState) -> None:
    found = explorer.view(replace(state, filters_low=(Filter(material="Pb", thickness_mm=30.0),)))
    assert found.low.prediction is None and found.images is None
    assert any("let some photons through" in text for text in found.limits)


def test_the_map_holds_the_contrast_of_its_pairs_and_knows_the_limits(explorer: Explorer, state: ExplorerState) -> None:
    bright = replace(state, power_low_W=45.0, power_high_W=45.0)
    found = explorer.map(bright, steps=(3, 4))
    row, column = 1, 3
    alone = explorer.view(replace(bright, kV_low=found.kV_low[row], kV_high=found.kV_high[column])).contrast
    assert alone is not None
    assert found.cnr[row, column] == pytest.approx(alone.cnr_object, rel=1e-9)
    assert found.best is not None
    assert found.best[2] == np.nanmax(found.cnr)
    assert np.isnan(found.cnr[2, 0])  # the low voltage is the higher one
    over = explorer.map(replace(bright, power_high_W=130.0), steps=(3, 4))
    assert not over.allowed.any() and over.best is None
    bright_map = explorer.map(replace(bright, exposure_ms=800.0), steps=(3, 4))
    assert bright_map.allowed[np.isfinite(bright_map.cnr)].sum() < found.allowed[np.isfinite(found.cnr)].sum()


def test_commands_and_python_give_the_numbers_that_are_seen(view: ExplorerView, tmp_path: Path) -> None:
    commands = view.command.splitlines()
    assert [one.split()[1] for one in commands] == ["predict", "predict", "contrast"]
    answers = []
    for one in (commands[0], commands[2]):
        words = one.split()
        done = subprocess.run(
            [sys.executable, "-m", *words, "--json"], capture_output=True, text=True, check=True, timeout=120
        )
        answers.append(json.loads(done.stdout))
    assert view.low.prediction is not None and view.contrast is not None
    assert answers[0]["mean_DN"]["value"] == pytest.approx(view.low.prediction.mean_DN.value)
    assert answers[1]["delta_R"]["value"] == pytest.approx(view.contrast.delta_R.value)
    names: dict[str, object] = {}
    exec(view.python, names)
    assert names["found"].contrast.cnr_object == pytest.approx(view.contrast.cnr_object)  # type: ignore[attr-defined]


def test_a_known_pod_is_shown_at_the_contrast_seen(explorer: Explorer, state: ExplorerState, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    sizes = np.repeat(np.linspace(0.02, 0.3, 15), 12)
    hits = rng.random(sizes.size) < 1 - np.exp(-np.exp(-2.5 + 25 * sizes))
    table = tmp_path / "hits.csv"
    table.write_text("contrast,hit\n" + "".join(f"{size},{int(hit)}\n" for size, hit in zip(sizes, hits, strict=True)))
    curve = rt.fit_pod(table)
    answer = tmp_path / "pod.json"
    answer.write_text(json.dumps(curve.to_dict()))
    known = [read_known_pod(table), read_known_pod(answer)]
    for one in known:
        assert one.a90 == pytest.approx(curve.a90)
        assert one.a90_low is not None and one.a90_high is not None
        assert one.a90_low < one.a90 < one.a90_high  # type: ignore[operator]
    found = Explorer(explorer.twin, name="virtual_lab", pods=known).view(state)
    of_table, of_answer = found.pods
    assert of_table.times_a90 == pytest.approx(abs(found.contrast.delta_R.value) / curve.a90)  # type: ignore[union-attr, operator]
    assert of_table.pod is not None and of_table.pod[1] < of_table.pod[0] < of_table.pod[2]
    assert of_answer.times_a90 == of_table.times_a90 and of_answer.pod is None
    other = tmp_path / "sizes.json"
    other.write_text(json.dumps({**curve.to_dict(), "size": "size_mm"}))
    assert Explorer(explorer.twin, name="v", pods=[read_known_pod(other)]).view(state).pods[0].times_a90 is None


@pytest.mark.parametrize(
    ("name", "text", "error", "message"),
    [
        ("absent.json", None, InputError, r"got no such file; expected a POD table"),
        ("broken.json", "{", FileFormatError, r"expected what `raytwin pod --json` prints"),
        ("other.json", "{}", FileFormatError, r"JSON without a90"),
        (
            "text.json",
            '{"a90": "x", "a90_95_two_sided": {}, "size": "contrast"}',
            FileFormatError,
            r"expected a number",
        ),
    ],
)
def test_a_file_that_is_no_pod_is_refused(
    tmp_path: Path, name: str, text: str | None, error: type[Exception], message: str
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(error, match=message):
        read_known_pod(tmp_path / name)


def test_a_line_without_spectrum_and_a_state_that_cannot_be_are_refused(state: ExplorerState) -> None:
    twin = rt.read_twin("virtual_lab")
    with pytest.raises(InputError, match="twin without spectral part"):
        Explorer(replace(twin, spectral=None), name="t")
    with pytest.raises(InputError, match="exposure_ms"):
        replace(state, exposure_ms=0.0)
    with pytest.raises(InputError, match="object_pixels: got 0"):
        replace(state, object_pixels=0)


def test_ranges_reach_beyond_the_declared_power_and_hold_the_calibrated_voltages() -> None:
    twin = rt.read_twin("virtual_lab")
    ranges = ranges_of(twin)
    assert ranges.power_W[1] > 90.0
    assert ranges.kV[0] <= 40.0 < 90.0 <= ranges.kV[1] <= 300.0


def test_a_displaced_product_must_be_thick_enough(explorer: Explorer, view: ExplorerView) -> None:
    predictions = (view.low.prediction, view.high.prediction)
    with pytest.raises(InputError, match=r"at most the product's 2 mm"):
        draw_pair(
            explorer.twin,
            predictions,  # type: ignore[arg-type]
            product=Filter(material="water", thickness_mm=2.0),
            foreign_object=Filter(material="Al", thickness_mm=3.0),
            object_pixels=10,
            displaces=True,
            rng=np.random.default_rng(1),
        )


def _added(path: Path, low: str = LOW, **other: object) -> object:
    words: dict[str, object] = {
        "twin": "virtual_lab",
        "low": setting_from_text(low),
        "high": setting_from_text(HIGH),
        "product": Filter(material="chicken_breast", thickness_mm=20.0),
        "foreign_object": Filter(material="rib_bone", thickness_mm=2.0),
        "object_pixels": 60,
        "object_mm": 4.0,
        "field_mm": 27.0,
    }
    return add_setting(path, **{**words, **other})  # type: ignore[arg-type]


def test_a_campaign_grows_by_the_pairs_that_are_added_and_keeps_its_text(tmp_path: Path) -> None:
    path = tmp_path / "campaign.toml"
    first = _added(path)
    assert first.new and first.settings == 1  # type: ignore[attr-defined]
    assert first.description == tmp_path / "campaign_scene.toml"  # type: ignore[attr-defined]
    path.write_text("# mine\n" + path.read_text())
    second = _added(path, low=LOW.replace("kv=40", "kv=50"))
    assert second.new and second.settings == 2  # type: ignore[attr-defined]
    again = _added(path)
    assert not again.new and again.settings == 2  # type: ignore[attr-defined]
    campaign = read_campaign(path)
    assert [str(low) for low, _ in campaign.settings] == [LOW, LOW.replace("kv=40", "kv=50")]
    assert path.read_text().startswith("# mine\n")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["campaign.toml", "campaign_scene.toml"]


def test_a_campaign_of_other_materials_says_so_and_its_command_can_be_copied(tmp_path: Path) -> None:
    path = tmp_path / "my campaign.toml"
    seen = ("Al", "air")
    other = {
        name: Filter(material=one, thickness_mm=2.0)
        for name, one in zip(("product", "foreign_object"), seen, strict=True)
    }
    assert "stays so" not in added_text(_added(path), seen=seen)  # type: ignore[arg-type]
    for low in (LOW, LOW.replace("kv=40", "kv=50")):
        text = added_text(_added(path, low=low, **other), seen=seen)  # type: ignore[arg-type]
        assert (
            "This campaign is of chicken_breast with rib_bone, and stays so; for Al with air start with another file"
            in text
        )
    assert text.endswith(f"Next: raytwin sweep '{path}' --plan")


@pytest.mark.parametrize("name", ["twin.h5", "none.h5", "none.toml"])
def test_references_that_no_campaign_can_take_are_refused_at_the_start(
    tmp_path: Path,
    make_model_twin,  # type: ignore[no-untyped-def]
    refused_line,  # type: ignore[no-untyped-def]
    name: str,
) -> None:
    make_model_twin((16, 16)).save(tmp_path / "twin.h5")
    words = ("explore", "virtual_lab", "--no-browser", "--references", tmp_path / name)
    assert name in refused_line(*words)


def test_a_campaign_that_would_be_none_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "campaign.toml"
    with pytest.raises(InputError, match="twin"):
        _added(path, twin="nowhere.h5")
    assert list(tmp_path.iterdir()) == []
    path.write_text("not = [a campaign")
    with pytest.raises(InputError, match=r"campaign\.toml: got text that is not TOML"):
        _added(path)
    assert path.read_text() == "not = [a campaign"
    with pytest.raises(InputError, match=r"ending in \.toml"):
        _added(tmp_path / "campaign.txt")


def test_within_an_ssh_session_a_tunnel_is_named() -> None:
    assert tunnel_command(5006, {}) is None
    found = tunnel_command(5010, {"SSH_CONNECTION": "192.0.2.7 50022 192.0.2.9 22"})
    assert found is not None
    assert found.startswith("ssh -N -L 5010:127.0.0.1:5010 ") and found.endswith("192.0.2.9")


def test_without_bokeh_one_line_says_what_to_install() -> None:
    code = (
        "import sys\nsys.modules['bokeh'] = None\nfrom raytwin.cli import main\n"
        "raise SystemExit(main(['explore', 'virtual_lab']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr == (
        "raytwin explore: error: `raytwin explore` needs Bokeh, which is not installed: pip install 'raytwin[explore]'\n"
    )
