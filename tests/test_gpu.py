"""What runs on a GPU, against the processor: kernels, training that falls and resumes, ensembles, hits. `make test-gpu`."""

import contextlib
import dataclasses
import math
import os

import numpy as np
import pytest

from raytwin.acquisition import DatasetRow, read_dataset, write_dataset
from raytwin.campaign.ensemble import train_together
from raytwin.generator import noise_kernel_1d, project_polychromatic, sample_frames
from raytwin.segmentation import (
    build_network,
    detect_with_networks,
    examples_from_arrays,
    iterate_training,
    open_runs,
    read_weights,
    recipe_for_module,
    starter_recipe,
    train_networks,
)
from raytwin.segmentation.runs_io import network_folder
from raytwin.segmentation.training_step import TrainingStep

# read by cuBLAS at its first product, which deterministic algorithms ask for
os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")

SHAPE = (64, 96)
RECIPE = dataclasses.replace(starter_recipe(), steps=None, epochs=3, batch=4)


@pytest.fixture(scope="module", autouse=True)
def _cuda():
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("torch finds no CUDA device here")


pytestmark = [pytest.mark.gpu, pytest.mark.filterwarnings("ignore")]  # of torch's compiler and of its algorithms


def _pairs(n, *, seed=0):
    """Slabs with noise, and a block in all but every fourth."""
    rng = np.random.default_rng(seed)
    images = np.stack([np.full((n, *SHAPE), 1.0), np.full((n, *SHAPE), 0.5)], axis=1)
    images += 0.02 * rng.standard_normal(images.shape)
    masks = np.zeros((n, *SHAPE), dtype=np.uint8)
    for number in range(n):
        row, column = rng.integers(8, SHAPE[0] - 16), rng.integers(8, SHAPE[1] - 16)
        masks[number, row : row + 6, column : column + 8] = number % 4 != 3
    images[:, 0] += 0.2 * masks
    return images.astype(np.float32), masks


@pytest.fixture(scope="module")
def dataset_file(tmp_path_factory):
    """24 images to learn from, 8 to validate with, 60 to try."""
    path = tmp_path_factory.mktemp("gpu") / "pairs.h5"
    splits = ["train"] * 24 + ["val"] * 8 + ["test"] * 60
    images, masks = _pairs(len(splits))
    with write_dataset(path, shape=SHAPE) as writer:
        for number, split in enumerate(splits):
            block = bool(masks[number].any())
            row = DatasetRow(
                image=f"i{number}",
                product=f"p{number}",
                foreign_object="block" if block else "",
                size_mm=2.0 if block else math.nan,
                contrast=0.2 if block else math.nan,
                split=split,
                setting="low;high",
            )
            product = np.ones(SHAPE, dtype=np.uint8)
            writer.append(image=images[number], foreign_object_mask=masks[number], product_mask=product, row=row)
    return path


@contextlib.contextmanager
def torch_seeded(seed):
    import torch

    with torch.random.fork_rng(devices=["cuda"]):
        torch.manual_seed(seed)
        yield


@pytest.fixture
def deterministic():
    import torch

    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("backend", ["torch", "torch_compiled"])
def test_frames_are_those_of_the_compiled_loops_but_for_last_bits(backend):
    rng = np.random.default_rng(1)
    signal = np.concatenate([rng.uniform(0, 30, (1, 60, 81)), rng.uniform(90, 2000, (1, 60, 81))])
    settings = {
        "gain_DN": 1.3,
        "key": 77,
        "gain_relative": rng.uniform(0.9, 1.1, (60, 81)),
        "kernel_1d": noise_kernel_1d("aperture", 0.6),
        "read_noise_DN": 1.5,
        "dark_DN": 50.0,
        "white_fraction": 0.02,
        "quantised": False,
    }
    compiled = sample_frames(signal, **settings)
    on_gpu = sample_frames(signal, backend=backend, device="cuda", **settings)
    assert on_gpu.device.type == "cuda"
    # as on a processor: where a last bit moves a count by one quantum, the spread takes it to some of its neighbours
    assert np.mean(np.abs(compiled - on_gpu.cpu().numpy()) > 2e-3) < 5e-3


@pytest.mark.parametrize("backend", ["torch", "torch_compiled"])
def test_projections_are_those_of_the_compiled_loops(backend):
    rng = np.random.default_rng(2)
    thickness = rng.uniform(0.0, [[[60.0]], [[6.0]]], size=(2, 37, 53))
    energies_keV = np.linspace(15.0, 90.0, 60)
    mu = np.stack([0.02 + 0.08 * (20 / energies_keV) ** 3, 0.03 + 0.5 * (20 / energies_keV) ** 3])
    weights = np.stack([energies_keV, energies_keV**2]) * np.exp(-(((energies_keV - 50) / 15) ** 2))
    expected = project_polychromatic(thickness, mu, weights)
    found = project_polychromatic(thickness, mu, weights, backend=backend, device="cuda").cpu().numpy()
    # 1e-4 each, the sum's own tolerance (project_polychromatic)
    assert np.all(np.abs(found - expected) <= 2e-4 * expected)


def _states(dataset_arrays, *, resume=None, stop_after=None, epochs=3, device="cuda", network=None):
    recipe = dataclasses.replace(RECIPE, epochs=epochs)
    if network is not None:
        recipe = recipe_for_module(recipe)
    images, masks = dataset_arrays
    train, validation = (
        examples_from_arrays(images[part], masks[part], recipe=recipe) for part in (slice(24), slice(24, 32))
    )
    states = []
    for state in iterate_training(
        train, validation, recipe=recipe, seed=3, device=device, resume=resume, network=network
    ):
        states.append(state)
        if len(states) == stop_after:
            break
    return states


def test_the_loss_falls():
    history = _states(_pairs(32), epochs=12)[-1].history
    assert history[-1].loss < 0.8 * history[0].loss


def test_with_deterministic_algorithms_a_resumed_network_is_the_same(deterministic):
    pairs = _pairs(32)
    whole = _states(pairs)[-1].weights
    half = _states(pairs, stop_after=1)[-1]
    resumed = _states(pairs, resume=half)[-1].weights
    for name, value in whole.items():
        np.testing.assert_array_equal(value.cpu().numpy(), resumed[name].cpu().numpy(), err_msg=name)


def _losses_of_steps(*, record):
    images, masks = (array.astype(np.float32) for array in _pairs(32))
    with torch_seeded(5):
        network = build_network(RECIPE, seed=1).to("cuda").train()
        step = TrainingStep(network, recipe=RECIPE, device="cuda", record=record)
        losses = [step(images[i : i + 4], masks[i : i + 4, None], rate=1e-3) for i in range(0, 32, 4)]
    return [float(loss) for loss in losses]


def test_recorded_steps_learn_what_steps_one_by_one_do(deterministic):
    # the same operations; three steps are never recorded, last bits grow by a factor of some ten in each of the others
    np.testing.assert_allclose(_losses_of_steps(record=True), _losses_of_steps(record=False), rtol=1e-2)


def test_a_network_goes_on_on_the_other_device():
    pairs = _pairs(32)
    stopped = {device: _states(pairs, stop_after=1, device=device)[-1] for device in ("cuda", "cpu")}
    for device, other in (("cuda", "cpu"), ("cpu", "cuda")):
        resumed = _states(pairs, resume=stopped[other], device=device)[-1]
        assert resumed.finished
        assert resumed.history[-1].loss < stopped[other].history[0].loss


def test_a_module_that_decides_by_what_it_sees_is_trained():
    import torch

    class Deciding(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Conv2d(2, 1, 5, padding=2)

        def forward(self, images):
            answer = self.layer(images)
            return answer if float(images.mean()) > -1e9 else -answer  # read from the device: no graph can hold it

    states = _states(_pairs(32), epochs=4, network=Deciding)
    assert states[-1].history[-1].loss < states[0].history[0].loss


def _losses(results):
    return [[epoch.loss for epoch in result.history] for result in results]


def test_an_ensemble_in_processes_is_that_of_one_process_but_for_the_order_of_sums(dataset_file, tmp_path):
    recipe = dataclasses.replace(RECIPE, epochs=1)
    words = {"recipe": recipe, "networks": 3, "seed": 4, "device": "cuda", "start_from": "starter"}
    with read_dataset(dataset_file) as dataset:
        one = train_together(dataset, tmp_path / "one", workers=1, **words)
        several = train_together(dataset, tmp_path / "several", workers=3, **words)
    # loss of six steps from the same start; last bits grow by a factor of some ten a step at most
    np.testing.assert_allclose(_losses(several), _losses(one), rtol=1e-2)
    # networks of other numbers differ by more than the tolerance, so that it can tell them apart
    assert np.ptp([history[0] for history in _losses(one)]) > 1e-2 * np.mean(_losses(one))


def test_hits_on_a_gpu_are_those_on_a_processor_but_at_the_edge_of_the_threshold(dataset_file, tmp_path):
    recipe = dataclasses.replace(RECIPE, epochs=6)
    with read_dataset(dataset_file) as dataset:
        train_networks(
            dataset, tmp_path / "runs", recipe=recipe, networks=2, seed=1, device="cuda", start_from="starter"
        )
        runs = open_runs(tmp_path / "runs")
        _, weights = read_weights(network_folder(runs, 0) / "weights.pt")
        assert all(value.device.type == "cpu" for value in weights.values())  # a file that any machine reads
        numbers = dataset.indices(split="test")
        on_cpu, on_gpu = (
            list(detect_with_networks(runs, dataset, numbers, device=device)) for device in ("cpu", "cuda")
        )
    assert [(row.network, row.image) for row in on_cpu] == [(row.network, row.image) for row in on_gpu]
    assert any(row.hit for row in on_cpu)
    # single precision, with products of convolutions rounded to ten bits (TF32, torch's default): 2 of 120 rows at most
    changed = [(a.hit, a.false_alarm) != (b.hit, b.false_alarm) for a, b in zip(on_cpu, on_gpu, strict=True)]
    assert sum(changed) <= 2
