"""Losses, networks, training that resumes, folders of networks, and the commands `train` and `detect`."""

import csv
import dataclasses
import functools
import json
import math

import numpy as np
import pytest

from raytwin.acquisition import DatasetRow, read_dataset, write_dataset
from raytwin.campaign._children import ChildError
from raytwin.campaign.ensemble import train_together
from raytwin.cli import main
from raytwin.errors import FileFormatError, InputError, MissingDependencyError, RaytwinError
from raytwin.segmentation import (
    RECIPES,
    Recipe,
    build_network,
    choose_device,
    count_epochs,
    cross_entropy_and_dice,
    detect_with_networks,
    dice_as_published,
    examples_from_arrays,
    examples_from_dataset,
    finished_networks,
    iterate_training,
    learning_rate_at,
    measure_direction,
    open_runs,
    read_weights,
    recipe_for_fine_tuning,
    recipe_of_start,
    say_who_is_blind,
    split_for_training,
    starter_recipe,
    train_networks,
)
from raytwin.segmentation import runs as runs_module
from raytwin.segmentation.network import probabilities_from_scaled
from raytwin.segmentation.runs_io import network_folder, read_state
from raytwin.segmentation.scaling import matched_along

SHAPE = (20, 36)
QUICK = dataclasses.replace(RECIPES["raytwin"], scaling="residual", steps=None, epochs=2, batch=2)


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def _pairs(n, *, shape=SHAPE, seed=0, boneless=2, contrast=0.3):
    """A slab with a gradient of thickness, noise, and a bone of 3 x 4 pixels in all but every `boneless`-th image."""
    generator = np.random.default_rng(seed)
    thickness = np.linspace(0.4, 1.0, shape[1])[None] * np.ones((shape[0], 1))
    images = np.stack([1.02 * thickness, 0.5 * thickness])[None] + 0.02 * generator.standard_normal((n, 2, *shape))
    masks = np.zeros((n, *shape), dtype=np.uint8)
    for number in range(n):
        if boneless and number % boneless == boneless - 1:
            continue
        row, column = generator.integers(2, shape[0] - 6), generator.integers(2, shape[1] - 6)
        masks[number, row : row + 3, column : column + 4] = 1
    images[:, 0] += contrast * masks
    images[:, 1] += 0.3 * contrast * masks
    return images.astype(np.float32), masks


def _write(path, splits=("train", "train", "train", "train", "val", "val", "test", "test"), **options):
    images, masks = _pairs(len(splits), **options)
    with write_dataset(path, shape=images.shape[2:]) as writer:
        for number, split in enumerate(splits):
            bone = bool(masks[number].any())
            row = DatasetRow(
                image=f"i{number}",
                product=f"p{number // 2}",
                foreign_object="rib" if bone else "",
                size_mm=2.0 if bone else math.nan,
                contrast=0.25 if bone else math.nan,
                split=split,
                setting="low;high",
            )
            writer.append(
                image=images[number],
                foreign_object_mask=masks[number],
                product_mask=np.ones(images.shape[2:]),
                row=row,
            )
    return path


@pytest.fixture(scope="module")
def dataset_file(tmp_path_factory):
    return _write(tmp_path_factory.mktemp("data") / "pairs.h5")


@pytest.fixture(scope="module")
def trained(dataset_file, tmp_path_factory):
    """Two networks of two epochs: (folder, results)."""
    runs = tmp_path_factory.mktemp("trained") / "runs"
    with read_dataset(dataset_file) as dataset:
        results = train_networks(dataset, runs, recipe=QUICK, networks=2, seed=5)
    return runs, results


def _weights(runs, network=0):
    return read_weights(runs / f"network_{network:03d}" / "weights.pt")[1]


def _assert_same(first, second):
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name].numpy(), second[name].numpy(), err_msg=name)


# Losses


def _gradient(loss_function, logits, targets):
    import torch

    leaf = torch.as_tensor(logits, dtype=torch.float64).requires_grad_()
    loss_function(leaf, torch.as_tensor(targets)).backward()
    return leaf.grad.numpy()


def test_a_boneless_batch_pushes_every_probability_down_where_published_dice_has_no_gradient():
    logits = np.random.default_rng(0).normal(size=(2, 1, 8, 8))
    nothing = np.zeros((2, 1, 8, 8))
    assert (_gradient(cross_entropy_and_dice, logits, nothing) > 0).all()
    assert not _gradient(dice_as_published, logits, nothing).any()


def test_a_boneless_image_beside_one_with_a_bone_still_counts():
    logits = np.random.default_rng(1).normal(size=(2, 1, 8, 8))
    targets = np.zeros((2, 1, 8, 8))
    targets[0, 0, 2:4, 2:5] = 1
    gradient = _gradient(cross_entropy_and_dice, logits, targets)
    assert (gradient[1] > 0).all()
    assert (gradient[0][targets[0] == 1] < 0).all()


def test_the_loss_is_its_closed_form():
    import torch

    logits = torch.zeros(1, 1, 4, 4)
    targets = torch.zeros(1, 1, 4, 4)
    targets[0, 0, 0] = 1
    # p = 1/2 everywhere: BCE = ln 2; Dice 1 - (2 x 2 + 1) / (8 + 4 + 1)
    assert float(cross_entropy_and_dice(logits, targets)) == pytest.approx(math.log(2) + 1 - 5 / 13, rel=1e-6)


def test_the_loss_of_a_right_answer_is_zero_with_and_without_a_bone():
    import torch

    targets = torch.zeros(2, 1, 6, 6)
    targets[0, 0, 1:3, 1:3] = 1
    assert float(cross_entropy_and_dice(200.0 * (targets - 0.5), targets)) == pytest.approx(0.0, abs=1e-6)


def test_published_dice_has_a_gradient_where_the_class_is_present():
    targets = np.zeros((2, 1, 8, 8))
    targets[0, 0, 2:4, 2:5] = 1
    assert _gradient(dice_as_published, np.zeros((2, 1, 8, 8)), targets).any()


# Recipes


def test_the_published_recipe_is_the_paper_s():
    recipe = RECIPES["as_published"]
    assert (recipe.loss, recipe.optimizer, recipe.learning_rate, recipe.batch, recipe.scaling) == (
        "dice",
        "adam",
        1e-4,
        2,
        "min_max",
    )


def test_one_cycle_rises_to_the_peak_and_falls_to_nothing():
    recipe = RECIPES["raytwin"]
    rates = [learning_rate_at(step, recipe=recipe, steps=100) for step in range(101)]
    assert rates[0] == pytest.approx(0.04 * recipe.learning_rate)
    assert max(rates) == rates[20] == pytest.approx(recipe.learning_rate)
    assert rates[100] == pytest.approx(0.0, abs=1e-12)
    assert np.all(np.diff(rates[:21]) > 0)
    assert np.all(np.diff(rates[20:]) < 0)


def test_steps_are_rounded_up_to_whole_passes():
    recipe = dataclasses.replace(RECIPES["raytwin"], steps=100, batch=8)
    assert count_epochs(recipe, n_images=64) == 13
    assert count_epochs(recipe, n_images=3) == 100
    assert count_epochs(RECIPES["as_published"], n_images=64) == 500


def test_fine_tuning_is_a_quarter_of_the_steps_at_a_third_of_the_rate():
    tuned = recipe_for_fine_tuning(RECIPES["raytwin"])
    assert tuned.steps == RECIPES["raytwin"].steps / 4
    assert tuned.learning_rate == pytest.approx(RECIPES["raytwin"].learning_rate / 3)
    assert recipe_for_fine_tuning(RECIPES["as_published"]) == RECIPES["as_published"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"batch": 1}, "batch: got 1; expected a whole number, 2 or more"),
        ({"steps": 5}, "steps and epochs: got 5 and 2; expected exactly one of the two"),
        ({"learning_rate": math.nan}, "learning rate: got nan; expected a number above 0, at most 1"),
        ({"weight_decay": -1.0}, "weight decay: got -1.0; expected 0 or more"),
        ({"epochs": 0}, "epochs: got 0; expected a whole number, 1 or more"),
        ({"crop_px": 8}, "crop_px: got 8; expected a whole number, 16 or more"),
        ({"loss": "hope"}, "loss: got 'hope'; expected one of cross_entropy_and_dice, dice"),
        ({"classes": ("bone",)}, "classes: got"),
        ({"initial_probability": 1.0}, "initial_probability: got 1.0; expected a number between 0 and 1"),
    ],
)
def test_a_recipe_refuses_what_cannot_be_trained(change, message):
    with pytest.raises(InputError) as error:
        dataclasses.replace(QUICK, **change)
    assert str(error.value).startswith(message)


# Networks


def test_the_network_has_the_published_number_of_parameters():
    network = build_network(RECIPES["as_published"], seed=0)
    count = sum(parameter.numel() for parameter in network.parameters())
    # the paper: 4.5 million trainable parameters; one input channel less and one output class change some hundreds;
    # versions of segmentation-models-pytorch differ in whether the encoder's unused head is counted (0.4 million)
    assert 4.4e6 < count < 5.0e6


def test_the_same_seed_gives_the_same_starting_weights_and_leaves_torch_s_state_alone():
    import torch

    torch.manual_seed(3)
    first = build_network(QUICK, seed=1).state_dict()
    drawn = torch.rand(1)
    torch.manual_seed(3)
    assert torch.rand(1) == drawn
    _assert_same(first, build_network(QUICK, seed=1).state_dict())
    other = build_network(QUICK, seed=2).state_dict()
    assert any(not np.array_equal(first[name].numpy(), other[name].numpy()) for name in first)


@pytest.mark.parametrize("shape", [(1, 1), (17, 33), (32, 48)])
def test_probabilities_come_back_in_the_shape_of_the_image(shape):
    network = build_network(QUICK, seed=0)
    images = np.random.default_rng(0).random((2, 2, *shape), dtype=np.float32)
    found = probabilities_from_scaled(network, images, recipe=QUICK)
    assert found.shape == (2, *shape)
    assert np.all((found >= 0) & (found <= 1))


def test_before_training_a_pixel_is_marked_with_the_recipe_s_probability():
    network = build_network(QUICK, seed=0)
    bias = float(network.segmentation_head[0].bias.detach())
    assert 1 / (1 + math.exp(-bias)) == pytest.approx(QUICK.initial_probability)


def test_an_unknown_device_is_refused():
    with pytest.raises(InputError, match=r"device: got nowhere .*; expected auto, cpu, or a GPU that torch finds"):
        choose_device("nowhere")


def test_encoder_weights_that_cannot_be_fetched_are_one_clear_line(monkeypatch):
    import segmentation_models_pytorch as models

    def offline(*_arguments, **_options):
        raise OSError("no route to host")

    monkeypatch.setattr(models, "DeepLabV3Plus", offline)
    recipe = dataclasses.replace(QUICK, encoder_weights="imagenet")
    with pytest.raises(InputError, match=r"encoder weights: got imagenet, which could not be fetched .*random weights"):
        build_network(recipe, seed=0)


def test_a_training_that_is_refused_leaves_nothing_that_refuses_the_next(dataset_file, tmp_path):
    folder = tmp_path / "networks"
    with read_dataset(dataset_file) as dataset:
        with pytest.raises(InputError, match="network: got Unett"):
            train_networks(dataset, folder, recipe=dataclasses.replace(QUICK, architecture="Unett"))
        assert not folder.exists()
        folder.mkdir()
        with pytest.raises(InputError, match="network: got Unett"):
            train_networks(dataset, folder, recipe=dataclasses.replace(QUICK, architecture="Unett"))
        assert folder.exists() and not any(folder.iterdir())


def test_without_torch_the_message_holds_the_command_that_installs_it(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'raytwin\[segmentation\]'"):
        build_network(QUICK, seed=0)


# Training


def _train(recipe=QUICK, *, seed=7, n=4):
    """The last state of a run."""
    images, masks = _pairs(n)
    train = examples_from_arrays(images, masks, recipe=recipe)
    return list(iterate_training(train, train, recipe=recipe, seed=seed))[-1]


def test_the_same_seed_gives_the_same_weights_and_another_seed_others():
    first, second, other = _train(n=2), _train(n=2), _train(n=2, seed=8)
    _assert_same(dict(first.weights), dict(second.weights))
    assert first.history != other.history


def test_training_lowers_the_loss():
    history = _train(dataclasses.replace(QUICK, epochs=15), n=2).history
    assert history[-1].loss < 0.9 * history[0].loss


def test_a_single_image_and_an_odd_last_batch_can_be_trained_on():
    recipe = dataclasses.replace(QUICK, epochs=1)
    images, masks = _pairs(3, boneless=0)
    for n in (1, 3):
        train = examples_from_arrays(images[:n], masks[:n], recipe=recipe)
        assert next(iterate_training(train, train, recipe=recipe, seed=0)).finished


def test_the_published_recipe_learns_product_and_foreign_object():
    recipe = dataclasses.replace(RECIPES["as_published"], epochs=1)
    images, masks = _pairs(2)
    train = examples_from_arrays(images, masks, np.ones_like(masks), recipe=recipe)
    (state,) = iterate_training(train, train, recipe=recipe, seed=0)
    assert state.finished
    assert math.isfinite(state.history[0].loss)


def test_training_on_crops_of_large_images():
    recipe = dataclasses.replace(QUICK, crop_px=32, epochs=1)
    images, masks = _pairs(2, shape=(70, 90))
    train = examples_from_arrays(images, masks, recipe=recipe)
    assert next(iterate_training(train, train, recipe=recipe, seed=0)).finished


def test_images_without_any_foreign_object_are_refused():
    images, masks = _pairs(2)
    train = examples_from_arrays(images, 0 * masks, recipe=QUICK)
    with pytest.raises(InputError, match=r"training images: got 2 without a foreign object in their masks"):
        next(iterate_training(train, train, recipe=QUICK, seed=0))


def test_validation_without_objects_or_without_clean_products_says_so():
    images, masks = _pairs(2)
    train = examples_from_arrays(images, masks, recipe=QUICK)
    clean = examples_from_arrays(images, 0 * masks, recipe=QUICK)
    recipe = dataclasses.replace(QUICK, epochs=1)
    result = next(iterate_training(train, clean, recipe=recipe, seed=0)).history[-1]
    assert result.validation_hit_rate is None
    assert result.validation_recall is None
    assert result.validation_false_alarm_rate is not None


def test_examples_refuse_masks_of_another_shape_and_a_missing_product_mask():
    images, masks = _pairs(2)
    with pytest.raises(InputError, match=r"foreign object masks: got shape \(2, 5, 5\); expected shape \(2, 20, 36\)"):
        examples_from_arrays(images, masks[:, :5, :5], recipe=QUICK)
    with pytest.raises(InputError, match="product masks: got none; expected masks, for the recipe as_published"):
        examples_from_arrays(images, masks, recipe=RECIPES["as_published"])


def test_examples_beyond_the_cache_are_read_again_and_are_the_same():
    images, masks = _pairs(3)
    kept = examples_from_arrays(images, masks, recipe=QUICK)
    read = examples_from_arrays(images, masks, recipe=QUICK, cache_bytes=0)
    for number in range(3):
        np.testing.assert_array_equal(kept[number][0], read[number][0])
    assert kept[0] is kept[0]
    assert read[0] is not read[0]
    with pytest.raises(IndexError):
        kept[3]


# Folders of networks


def test_networks_of_a_folder_differ_and_their_record_is_complete(trained, dataset_file):
    runs, results = trained
    assert finished_networks(open_runs(runs)) == [0, 1]
    first, second = _weights(runs, 0), _weights(runs, 1)
    assert any(not np.array_equal(first[name].numpy(), second[name].numpy()) for name in first)
    record = json.loads((runs / "network_001" / "network.json").read_text())
    assert len(record["history"]) == 2
    assert record["best_epoch"] == results[1].best_epoch
    assert record["configuration_sha256"] == open_runs(runs).sha256
    assert results[1].best.validation_loss == results[1].best_validation_loss
    assert not list(runs.glob("network_*/state.pt"))


def test_the_kept_weights_are_those_of_the_lowest_validation_loss(trained):
    _, results = trained
    for result in results:
        losses = [e.validation_loss for e in result.history if e.validation_loss is not None]
        assert result.best_validation_loss == min(losses)


def test_finished_networks_are_not_trained_again_and_more_can_be_asked_for(dataset_file, tmp_path):
    recipe = dataclasses.replace(QUICK, epochs=1)
    with read_dataset(dataset_file) as dataset:
        (first,) = train_networks(dataset, tmp_path / "r", recipe=recipe, networks=1)
        epochs = []
        both = train_networks(
            dataset,
            tmp_path / "r",
            recipe=recipe,
            networks=2,
            progress=lambda network, done, wanted, result: epochs.append((network, result is not None)),
        )
    assert both[0] == first
    assert epochs == [(0, False), (1, True)]


@pytest.mark.slow
def test_a_run_killed_between_two_states_ends_as_if_nothing_had_happened(dataset_file, tmp_path, monkeypatch):
    recipe = dataclasses.replace(QUICK, epochs=4)

    def kill(network, done, wanted, result):
        if done == 3 and result is not None:
            raise KeyboardInterrupt

    monkeypatch.setattr(runs_module, "_SHARE_OF_KEEPING", 1e-9)  # the first epoch's state is the only one
    with read_dataset(dataset_file) as dataset:
        whole = train_networks(dataset, tmp_path / "whole", recipe=recipe, networks=1, seed=5)
        with pytest.raises(KeyboardInterrupt):
            train_networks(dataset, tmp_path / "r", recipe=recipe, networks=1, seed=5, progress=kill)
        assert read_state(open_runs(tmp_path / "r"), 0).epochs_done == 1
        again = train_networks(dataset, tmp_path / "r", recipe=recipe, networks=1, seed=5)
    assert again == whole
    _assert_same(_weights(tmp_path / "r", 0), _weights(tmp_path / "whole", 0))


def test_a_killed_run_goes_on_from_its_last_state_and_ends_as_if_nothing_had_happened(dataset_file, trained, tmp_path):
    class Killed(BaseException):
        pass

    def kill(network, done, wanted, result):
        if (network, done) == (1, 1) and result is not None:
            raise Killed

    with read_dataset(dataset_file) as dataset:
        with pytest.raises(Killed):
            train_networks(dataset, tmp_path / "r", recipe=QUICK, networks=2, seed=5, progress=kill)
        # a temporary file of a write that was cut off does no harm
        (tmp_path / "r" / "network_001" / ".state.pt.x.part").write_bytes(b"half")
        assert read_state(open_runs(tmp_path / "r"), 1).epochs_done == 1
        again = train_networks(dataset, tmp_path / "r", recipe=QUICK, networks=2, seed=5)
    assert again == trained[1]
    assert sorted(found.name for found in (tmp_path / "r" / "network_001").iterdir()) == ["network.json", "weights.pt"]
    _assert_same(_weights(tmp_path / "r", 1), _weights(trained[0], 1))


def test_a_folder_that_another_training_works_in_is_refused_and_left_as_it_is(dataset_file, tmp_path):
    refused = []

    def start_another(network, done, wanted, result):
        with read_dataset(dataset_file) as second:
            for start in (train_networks, functools.partial(train_together, workers=2)):
                with pytest.raises(InputError, match=r"where a training is running"):
                    start(second, tmp_path / "r", recipe=QUICK, networks=2, seed=5)
                refused.append(network)

    with read_dataset(dataset_file) as dataset:
        train_networks(dataset, tmp_path / "r", recipe=QUICK, networks=1, seed=5, progress=start_another)
        assert refused and set(refused) == {0}, "the second network was not begun"
        assert finished_networks(open_runs(tmp_path / "r")) == [0]
        # when the first is done, the folder is free
        assert len(train_networks(dataset, tmp_path / "r", recipe=QUICK, networks=1, seed=5)) == 1


def test_a_state_that_cannot_be_read_costs_its_network_only_and_is_said(dataset_file, tmp_path):
    recipe = dataclasses.replace(QUICK, epochs=1)
    said = []
    with read_dataset(dataset_file) as dataset:
        train_networks(dataset, tmp_path / "r", recipe=recipe, networks=1)
        folder = network_folder(open_runs(tmp_path / "r"), 1)
        folder.mkdir()
        (folder / "state.pt").write_bytes(b"PK half a file")
        results = train_networks(dataset, tmp_path / "r", recipe=recipe, networks=2, warn=said.append)
    assert len(results) == 2
    assert len(said) == 1
    assert said[0].startswith("network 1 starts again: ")


def test_a_folder_refuses_another_recipe_seed_or_dataset_and_names_what_differs(dataset_file, trained, tmp_path):
    runs, _ = trained
    with read_dataset(dataset_file) as dataset:
        with pytest.raises(
            InputError, match=r"networks that differ in seed \(5 there, 6 now\).*another folder with -o"
        ):
            train_networks(dataset, runs, recipe=QUICK, seed=6)
        other = dataclasses.replace(QUICK, learning_rate=1e-4)
        with pytest.raises(InputError, match=r"differ in learning_rate \(0.003 there, 0.0001 now\)"):
            train_networks(dataset, runs, recipe=other, seed=5)
    message = r"differ in dataset_sha256 \([0-9a-f]{8} there, [0-9a-f]{8} now\)"
    with read_dataset(_write(tmp_path / "other.h5", seed=9)) as dataset, pytest.raises(InputError, match=message):
        train_networks(dataset, runs, recipe=QUICK, seed=5)


def test_a_folder_with_other_files_in_it_is_left_alone(dataset_file, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    message = "got a folder with other files in it; expected a new or empty folder"
    with read_dataset(dataset_file) as dataset, pytest.raises(InputError, match=message):
        train_networks(dataset, tmp_path, recipe=QUICK)
    assert [found.name for found in tmp_path.iterdir()] == ["notes.txt"]


def test_networks_start_from_a_shared_one_and_keep_what_it_knew(dataset_file, trained, tmp_path):
    recipe = dataclasses.replace(QUICK, epochs=1, learning_rate=1e-9)
    with read_dataset(dataset_file) as dataset:
        start = trained[0] / "network_001" / "weights.pt"
        train_networks(dataset, tmp_path / "r", recipe=recipe, start_from=start)
        held = open_runs(tmp_path / "r").configuration["started_from"]
        with pytest.raises(InputError, match=r"differ in started_from \([0-9a-f]{8} there, nothing now\)"):
            train_networks(dataset, tmp_path / "r", recipe=recipe)
    assert held == {"-1": trained[1][1].weights_sha256}
    name = "segmentation_head.0.weight"
    np.testing.assert_allclose(_weights(tmp_path / "r")[name].numpy(), _weights(trained[0], 1)[name].numpy(), atol=1e-6)


def test_networks_of_a_folder_start_from_the_ones_of_the_same_number(dataset_file, trained, tmp_path):
    recipe = dataclasses.replace(QUICK, epochs=1)
    with read_dataset(dataset_file) as dataset:
        train_networks(dataset, tmp_path / "r", recipe=recipe, networks=2, start_from=trained[0])
        held = open_runs(tmp_path / "r").configuration["started_from"]
        assert held == {str(number): trained[1][number].weights_sha256 for number in (0, 1)}
        with pytest.raises(InputError, match=r"start from: got .* finished networks \[0, 1\].*train network 2 there"):
            train_networks(dataset, tmp_path / "s", recipe=recipe, networks=3, start_from=trained[0])


def test_the_command_goes_on_from_networks_that_were_fine_tuned_from_the_starter(dataset_file, tmp_path, capsys):
    """The folder knows encoder, depth, scaling and length: none of them stands on the command line."""
    pytest.importorskip("safetensors", reason="needs the extra `segmentation`")
    first, second, third = (str(tmp_path / name) for name in ("a", "b", "c"))
    words = ["train", str(dataset_file), "--steps", "2", "--batch", "2", "--device", "cpu"]
    assert main([*words, "-o", first, "--start-from", "starter"]) == 0
    assert main([*words, "-o", second, "--start-from", first]) == 0
    held, again = (open_runs(path).recipe for path in (first, second))
    assert again == held
    # a length on the command line is the one that counts, and a file of weights knows as much as its folder
    weights = network_folder(open_runs(second), 0) / "weights.pt"
    assert main([*words, "-o", third, "--start-from", str(weights), "--learning-rate", "1e-5"]) == 0
    assert open_runs(third).recipe == dataclasses.replace(held, learning_rate=1e-5)
    capsys.readouterr()


def test_networks_that_were_not_fine_tuned_say_what_they_are_and_no_more(trained):
    held = open_runs(trained[0]).recipe
    other = dataclasses.replace(RECIPES["raytwin"], encoder="resnet18", scaling="min_max")
    recipe, tuned = recipe_of_start(trained[0], otherwise=other)
    assert not tuned
    assert (recipe.encoder, recipe.scaling, recipe.encoder_depth) == (held.encoder, held.scaling, held.encoder_depth)
    assert (recipe.steps, recipe.epochs) == (other.steps, other.epochs)


def test_training_measures_the_direction_once_keeps_it_and_starts_from_any_other(dataset_file, trained, tmp_path):
    recipe = dataclasses.replace(QUICK, scaling="matched", epochs=1)
    start = trained[0] / "network_000" / "weights.pt"
    with read_dataset(dataset_file) as dataset:
        train_networks(dataset, tmp_path / "r", recipe=recipe, start_from=start)
        runs = open_runs(tmp_path / "r")
        # the bones of `_pairs` are brighter than the slab in both images
        assert runs.recipe.scaling.startswith("matched:")
        assert 0 < float(runs.recipe.scaling.partition(":")[2]) < 90
        again = train_networks(dataset, tmp_path / "r", recipe=recipe, networks=2, start_from=start)
        assert [result.network for result in again] == [0, 1]
        assert len(list(detect_with_networks(runs, dataset, [6, 7], networks=[0]))) == 2


def test_networks_that_detect_nothing_are_named_in_one_line(trained):
    _, results = trained
    blind = dataclasses.replace(
        results[0], history=(dataclasses.replace(results[0].best, validation_hit_rate=0.0),), best_epoch=1
    )
    seeing = dataclasses.replace(blind, network=1, history=(dataclasses.replace(blind.best, validation_hit_rate=0.5),))
    assert say_who_is_blind([seeing]) == ""
    assert say_who_is_blind([blind, seeing]).startswith(
        "network 0 detected none of the foreign objects in the validation images"
    )
    assert "\n" not in say_who_is_blind([blind, dataclasses.replace(blind, network=3)])


def test_starting_from_a_network_of_another_recipe_is_refused(dataset_file, trained, tmp_path):
    recipe = dataclasses.replace(QUICK, scaling="min_max")
    with read_dataset(dataset_file) as dataset:
        start = trained[0] / "network_000" / "weights.pt"
        with pytest.raises(InputError, match=r"trained with scaling residual; expected scaling min_max"):
            train_networks(dataset, tmp_path / "r", recipe=recipe, start_from=start)
    assert not (tmp_path / "r").exists()


def test_files_that_are_no_weights_are_refused_and_run_no_code(tmp_path):
    import pickle

    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    trap = tmp_path / "trap.pt"
    trap.write_bytes(pickle.dumps(Trap()))
    half = tmp_path / "half.pt"
    half.write_bytes(b"PK\x03\x04 half")
    for path in (trap, half):
        with pytest.raises(FileFormatError, match=r"got a file that cannot be read .* expected a raytwin-weights"):
            read_weights(path)
    with pytest.raises(FileFormatError, match="got no such file; expected a raytwin-weights file"):
        read_weights(tmp_path / "absent.pt")
    assert not (tmp_path / "sprung").exists()


def test_without_validation_images_whole_products_are_held_back(tmp_path):
    with read_dataset(_write(tmp_path / "d.h5", splits=("train",) * 10)) as dataset:
        train, validation, note = split_for_training(dataset, seed=1)
        products = dataset.column("product")
        assert not set(products[train]) & set(products[validation])
        assert sorted([*train, *validation]) == list(range(10))
        assert len(validation) == 2
        assert "whole products" in note


def test_a_dataset_without_training_images_is_refused(tmp_path):
    for splits, message in (
        (("test", "test"), "no images of split train among 2; expected training images"),
        (("train", "test"), "got one training image and no validation image"),
    ):
        path = _write(tmp_path / "d.h5", splits=splits)
        with read_dataset(path) as dataset, pytest.raises(InputError, match=message):
            split_for_training(dataset, seed=0)


def test_examples_of_a_dataset_are_those_of_its_arrays(dataset_file):
    with read_dataset(dataset_file) as dataset:
        from_file = examples_from_dataset(dataset, [3, 0], recipe=QUICK)
        arrays = examples_from_arrays(dataset.images([3, 0]), dataset.foreign_object_masks([3, 0]), recipe=QUICK)
        for number in (0, 1):
            np.testing.assert_array_equal(from_file[number][0], arrays[number][0])
            np.testing.assert_array_equal(from_file[number][1], arrays[number][1])


# Commands


def test_train_and_detect_from_the_command_line(dataset_file, tmp_path, json_of):
    words = ["train", str(dataset_file), "-o", str(tmp_path / "r"), "--networks", "2", "--seed", "3", "--epochs", "1"]
    result = json_of(*words, "--batch", "2", "--device", "cpu", "--threads", "1")
    assert [network["network"] for network in result["networks"]] == [0, 1]
    assert all(network["best_epoch"] == 1 and len(network["losses"]) == 1 for network in result["networks"])
    hits = tmp_path / "hits.csv"
    result = json_of("detect", tmp_path / "r", dataset_file, "-o", hits, "--device", "cpu")
    assert result["networks"] == [0, 1]
    assert set(result["false_alarm_rate"]) == {"value", "low", "high", "n"}
    assert (result["hit_rate"]["n"], result["false_alarm_rate"]["n"]) == (2, 2)
    with open(hits, newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["network"], row["image"]) for row in rows] == [("0", "i6"), ("0", "i7"), ("1", "i6"), ("1", "i7")]
    assert [row["contrast"] for row in rows] == ["0.25", "", "0.25", ""]
    assert all(0 <= float(row["response"]) <= 1 for row in rows)


def test_detect_takes_images_of_another_size_and_all_of_a_file_without_test_images(trained, tmp_path, capsys):
    other = _write(tmp_path / "o.h5", splits=("val", "val", "val"), shape=(33, 50))
    words = ["detect", str(trained[0]), str(other), "-o", str(tmp_path / "h.csv"), "--device", "cpu"]
    assert main(words) == 0
    printed = capsys.readouterr()
    assert "has no images of split test: all 3 are tried" in printed.err
    assert "false alarms" in printed.out
    assert len((tmp_path / "h.csv").read_text().splitlines()) == 1 + 2 * 3


def test_an_object_without_a_pixel_in_its_mask_is_left_out_and_said(trained, tmp_path, capsys):
    path = tmp_path / "d.h5"
    with write_dataset(path, shape=SHAPE) as writer:
        for number, mask in enumerate((np.zeros(SHAPE), np.ones(SHAPE))):
            writer.append(
                image=np.ones((2, *SHAPE)),
                foreign_object_mask=mask,
                product_mask=np.ones(SHAPE),
                row=DatasetRow(image=f"i{number}", foreign_object="rib"),
            )
    assert main(["detect", str(trained[0]), str(path), "-o", str(tmp_path / "h.csv"), "--device", "cpu"]) == 0
    said = capsys.readouterr().err
    assert "1 images are left out: their foreign object has no pixel in its mask (i0 ...)" in said
    assert "2 lines have a foreign object of unknown contrast and size" in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["detect", "{missing}", "{data}", "-o", "{out}"], "got no such folder; expected a folder written by"),
        (["detect", "{runs}", "{missing}", "-o", "{out}"], "expected"),
        (["detect", "{runs}", "{data}", "-o", "{out}", "--threshold", "1.5"], "threshold: got 1.5; expected"),
        (["detect", "{runs}", "{data}", "-o", "{out}", "--setting", "no"], "got no images of split test at no"),
        (["detect", "{runs}", "{data}", "-o", "{out}", "--threads", "0"], "--threads: got 0; expected"),
        (["train", "{data}", "-o", "{out}", "--networks", "0"], "networks: got 0; expected a whole number, 1 or more"),
        (["train", "{data}", "-o", "{out}", "--seed", "-1"], "seed: got -1; expected a whole number, 0 or more"),
        (["train", "{data}", "-o", "{out}", "--recipe", "magic"], "--recipe: got magic; expected one of raytwin"),
        (["train", "{data}", "-o", "{out}", "--batch", "1"], "batch: got 1; expected a whole number, 2 or more"),
        (["train", "{data}", "-o", "{out}", "--start-from", "{missing}"], "got no such file; expected"),
        (["train", "{missing}", "-o", "{out}"], "expected"),
        (["train", "{data}", "-o", "{out}", "--epochs", "1", "--steps", "2"], "not allowed with argument"),
    ],
)
def test_bad_input_is_one_line_exit_2_and_leaves_no_file(words, message, trained, dataset_file, tmp_path, capsys):
    places = {
        "runs": str(trained[0]),
        "data": str(dataset_file),
        "out": str(tmp_path / "out"),
        "missing": str(tmp_path / "missing"),
    }
    arguments = [word.format(**places) for word in words]
    try:
        code = main([*arguments, "--device", "cpu"])
    except SystemExit as stopped:
        code = stopped.code
    printed = capsys.readouterr()
    assert code == 2
    assert printed.out == ""
    assert message in printed.err
    assert len(printed.err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_folder_without_finished_networks_cannot_detect(trained, dataset_file, tmp_path, refused_line):
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "run.json").write_text((trained[0] / "run.json").read_text())
    assert "got finished networks none; expected at least one; run the same" in refused_line(
        "detect", tmp_path / "r", dataset_file, "-o", tmp_path / "h.csv"
    )
    assert not (tmp_path / "h.csv").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "got a file that cannot be read"),
        ("[]", "got no JSON object"),
        ('{"format": "other"}', "got format 'other', version None; expected format 'raytwin-runs', version 1"),
        ('{"format": "raytwin-runs", "version": 1, "recipe": {"name": "x"}}', "got a recipe that cannot be used"),
    ],
)
def test_a_folder_that_is_none_of_ours_is_refused(content, message, tmp_path):
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(FileFormatError) as error:
        open_runs(tmp_path)
    assert message in str(error.value)


@pytest.mark.slow
def test_networks_trained_by_two_processes_are_those_of_one_to_the_byte(dataset_file, tmp_path):
    recipe = dataclasses.replace(starter_recipe(), steps=None, epochs=1, batch=2)
    words = {"recipe": recipe, "networks": 3, "seed": 5, "start_from": "starter"}
    told = []
    with read_dataset(dataset_file) as dataset:
        alone = train_together(dataset, tmp_path / "alone", workers=1, **words)
        # a run that was stopped after its first network
        train_networks(dataset, tmp_path / "two", only=(0,), **words)
        two = train_together(
            dataset, tmp_path / "two", workers=2, progress=lambda number, *rest: told.append(number), **words
        )
    assert [item.weights_sha256 for item in two] == [item.weights_sha256 for item in alone]
    assert len({item.weights_sha256 for item in two}) == 3
    assert sorted(told) == [1, 2]


def test_a_process_that_cannot_train_ends_the_job_with_its_reason(dataset_file, tmp_path, monkeypatch):
    monkeypatch.setattr("raytwin.campaign.ensemble.Children.run", _no_child)
    recipe = dataclasses.replace(starter_recipe(), steps=None, epochs=1, batch=2)
    with (
        read_dataset(dataset_file) as dataset,
        pytest.raises(RaytwinError, match=r"failed: the loss is not finite; what is trained is kept"),
    ):
        train_together(dataset, tmp_path / "runs", recipe=recipe, networks=2, workers=2)


def _no_child(self, module, words=(), **options):
    raise ChildError("the loss is not finite")


@pytest.mark.slow
def test_the_default_recipe_learns_to_detect_and_not_to_cry_wolf(tmp_path):
    """From random weights: bones of plain contrast are found, clean products stay clean."""
    train_images, train_masks = _pairs(96, shape=(64, 80), seed=1, boneless=3)
    test_images, test_masks = _pairs(60, shape=(64, 80), seed=2, boneless=3)
    scaling = matched_along(measure_direction(zip(train_images, train_masks, strict=True)))
    recipe: Recipe = dataclasses.replace(RECIPES["raytwin"], scaling=scaling, steps=240)
    train = examples_from_arrays(train_images, train_masks, recipe=recipe)
    test = examples_from_arrays(test_images, test_masks, recipe=recipe)
    state = list(iterate_training(train, test, recipe=recipe, seed=0))[-1]
    best = state.history[state.best_epoch - 1]
    # 40 bones, 20 clean products
    assert best.validation_hit_rate >= 0.9
    assert best.validation_false_alarm_rate <= 0.1
