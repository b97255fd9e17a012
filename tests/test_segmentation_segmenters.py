"""Networks made elsewhere: a function, a torch module and an ONNX file give the same table; wrong answers are one line."""

import numpy as np
import pytest

import raytwin as rt
from raytwin.acquisition import read_dataset
from raytwin.errors import InputError
from raytwin.segmentation import SCALINGS, segmenter_from_module, segmenter_from_onnx


@pytest.fixture(scope="module")
def references(tmp_path_factory, make_sweep_line):
    """A dataset of 20 images of 64 x 64 pixels, some with a rib."""
    return make_sweep_line(tmp_path_factory.mktemp("segmenters")) / "references.h5"


def weighted(torch):
    """A module that looks at the difference of both log images; its logits are above 0 where that is large."""
    network = torch.nn.Conv2d(2, 2, 1)
    with torch.no_grad():
        network.weight[:] = torch.tensor([[[[0.0]], [[0.0]]], [[[4.0]], [[-4.0]]]])
        network.bias[:] = torch.tensor([0.0, -1.0])
    return network


def by_hand(images):
    return 1.0 / (1.0 + np.exp(-(4.0 * (images[:, 0] - images[:, 1]) - 1.0)))


def test_a_function_and_a_module_that_compute_the_same_give_the_same_table(references, tmp_path):
    torch = pytest.importorskip("torch", reason="needs the extra `segmentation`")
    network = weighted(torch)
    found = rt.detect([by_hand, network], references, split="all", output=tmp_path / "hits.csv")
    table = found.to_dataframe()
    assert found.networks == (0, 1) and len(table) == 2 * len(table["image"].unique())
    first, second = (table[table["network"] == number].reset_index(drop=True) for number in (0, 1))
    assert (first["hit"] == second["hit"]).all() and 0 < first["hit"].mean() < 1
    assert np.allclose(first["response"], second["response"], atol=1e-6)
    objects = first["recall"].notna()
    assert objects.any() and not objects.all() and first.loc[~objects, "contrast"].isna().all()
    assert len((tmp_path / "hits.csv").read_text().splitlines()) == 1 + len(table)


def test_masks_from_elsewhere_find_what_they_mark(references):
    with read_dataset(references) as dataset:
        masks = {
            dataset.images(number).tobytes(): dataset.foreign_object_masks(number) for number in range(len(dataset))
        }

    def marked(images):
        return np.stack([masks[image.astype(np.float32).tobytes()] != 0 for image in images]).astype(float)

    rates = rt.detect(marked, references, split="all").rates
    assert rates["hit_rate"].value == 1.0 and rates["false_alarm_rate"].value == 0.0


def test_scaling_and_padding_are_those_that_were_asked_for():
    torch = pytest.importorskip("torch", reason="needs the extra `segmentation`")
    images = np.random.default_rng(1).uniform(0.1, 2.0, (3, 2, 40, 50)).astype(np.float32)
    seen = []

    class Looks(torch.nn.Module):
        def forward(self, batch):
            seen.append(batch.numpy())
            return batch[:, 0]

    found = segmenter_from_module(Looks(), scaling="min_max", probabilities=True, multiple_px=32)(images)
    assert seen[0].shape == (3, 2, 64, 64)
    assert np.allclose(found, np.stack([SCALINGS["min_max"](image)[0] for image in images]), atol=1e-6)
    with pytest.raises(InputError, match=r"scaling.*one of"):
        segmenter_from_module(Looks(), scaling="minmax")


def test_several_classes_are_exclusive_unless_it_is_said_and_said_where_it_is_taken():
    torch = pytest.importorskip("torch", reason="needs the extra `segmentation`")
    images = np.random.default_rng(2).uniform(0.1, 2.0, (2, 2, 32, 32)).astype(np.float32)
    network = torch.nn.Conv2d(2, 3, 1)
    with torch.inference_mode():
        logits = network(torch.from_numpy(images))
    lines = []
    found = segmenter_from_module(network, warn=lines.append)
    assert np.allclose(found(images), logits.softmax(dim=1)[:, 2].numpy(), atol=1e-6)
    found(images)
    assert len(lines) == 1 and "logits of 3 classes: taken as exclusive (softmax)" in lines[0]
    lines.clear()
    said = segmenter_from_module(network, classes="exclusive", warn=lines.append)
    assert np.allclose(said(images), found(images))
    apart = segmenter_from_module(network, classes="independent", warn=lines.append)
    assert np.allclose(apart(images), logits[:, 2].sigmoid().numpy(), atol=1e-6)
    one = segmenter_from_module(torch.nn.Conv2d(2, 1, 1), warn=lines.append)(images)
    assert one.shape == (2, 32, 32) and not lines
    with pytest.raises(InputError, match=r"classes.*exclusive, independent"):
        segmenter_from_module(network, classes="both")


def test_labels_of_two_classes_are_marks_and_of_more_are_refused():
    torch = pytest.importorskip("torch", reason="needs the extra `segmentation`")
    images = np.random.default_rng(2).uniform(0.1, 2.0, (2, 2, 32, 32)).astype(np.float32)

    class Largest(torch.nn.Module):
        def __init__(self, classes):
            super().__init__()
            self.inner = torch.nn.Conv2d(2, classes, 1)

        def forward(self, batch):
            return self.inner(batch).argmax(dim=1)

    two = Largest(2)
    with torch.inference_mode():
        expected = two(torch.from_numpy(images)).numpy()
    assert np.array_equal(segmenter_from_module(two)(images), expected)
    many = Largest(3)
    with torch.no_grad():
        many.inner.bias[:] = torch.tensor([0.0, 0.0, 50.0])
    with pytest.raises(InputError, match=r"whole numbers .* up to 2; expected marks 0 or 1"):
        segmenter_from_module(many)(images)


def test_a_module_of_several_classes_is_told_of_by_detect(references):
    torch = pytest.importorskip("torch", reason="needs the extra `segmentation`")
    network = weighted(torch)
    told = rt.detect(network, references, split="all")
    assert [line for line in told.warnings if "2 classes" in line]
    # a class whose logit is 0: the softmax is the sigmoid of the other
    said = rt.detect(network, references, split="all", classes="independent")
    assert not said.warnings
    assert said.rows == told.rows


def test_an_onnx_file_gives_what_its_module_gives(references, tmp_path):
    torch = pytest.importorskip("torch", reason="needs the extra `segmentation`")
    pytest.importorskip("onnxruntime", reason="needs the extra `onnx`")
    onnx = pytest.importorskip("onnx", reason="needs onnx to write a file")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    network = weighted(torch)
    weights = [
        onnx.numpy_helper.from_array(getattr(network, name).detach().numpy(), name) for name in ("weight", "bias")
    ]
    node = helper.make_node("Conv", ["images", "weight", "bias"], ["logits"])
    graph = helper.make_graph(
        [node],
        "network",
        [helper.make_tensor_value_info("images", kind, ["image", 2, "row", "column"])],
        [helper.make_tensor_value_info("logits", kind, ["image", 2, "row", "column"])],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, tmp_path / "network.onnx")
    images = np.random.default_rng(1).uniform(0.1, 2.0, (3, 2, 40, 50)).astype(np.float32)
    theirs = segmenter_from_onnx(tmp_path / "network.onnx")(images)
    assert np.allclose(theirs, segmenter_from_module(network)(images), atol=1e-6)
    assert rt.detect(tmp_path / "network.onnx", references, split="all").networks == (0,)
    (tmp_path / "broken.onnx").write_bytes(b"no network")
    with pytest.raises(InputError, match="does not read") as caught:
        segmenter_from_onnx(tmp_path / "broken.onnx")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda images: images, "shape.*image, row, column"),
        (lambda images: images[:, 0] * 40 - 20, "values from.*expected probabilities.*logits"),
        (lambda images: np.full(images[:, 0].shape, np.nan), "expected probabilities"),
    ],
)
def test_an_answer_that_is_no_probability_is_refused(references, answer, message):
    with pytest.raises(InputError, match=message) as caught:
        rt.detect(answer, references, split="all")
    assert "\n" not in str(caught.value)


def test_what_is_no_network_is_refused(references, tmp_path):
    for given, message in (
        ([], "an empty list"),
        ([3], "int; expected a folder of networks"),
        (tmp_path / "absent.onnx", "no such file"),
    ):
        with pytest.raises(InputError, match=message):
            rt.detect(given, references, split="all")
