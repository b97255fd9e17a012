"""Generated frames against the virtual lab's: statistics, and classifiers told to separate them.

    python validation/generator_vs_lab.py [--seed 0] [--short] [--output FOLDER] [--json FILE] [--no-network]

One hidden system of the lab (128 x 160 pixels). A twin is calibrated from flats at 40 and 90 kV behind 50 um Cu. Frames
are generated in two ways: from thickness maps of the object alone (three rays a pixel and axis, the places at which the
lab has its own), and by top-up from one 1 s reference an object. `told transmissions` are frames by a generator that is
handed the lab's transmissions and its way of sampling borders: what is left is the generator's own. The yardstick is always the lab
against itself: other sessions of the same system, with their own darks and flats.

Statistics at 20, 50 and 100 ms, at both voltages: eight replicates of 16 frames each from the lab and from the generator, of a
product with a bone, the open field, and an opaque slanted edge. Variance over signal in bands of signal (the
photon-transfer line), noise power spectrum in open field and product, edge profile, histogram of log values in product
and open field. For each: median error in %, and the rms distance of generated replicates to the lab's over that among the
lab's own (1: nobody can tell); beside it the same for another session of the lab.

Classifiers: log image pairs of products at the three exposures, patches of 16 x 16 and 64 x 64, half of the objects to
learn from and the others to be tested on; lab against generated beside lab against another session of the lab, AUC and the
difference of the two with its 95 % interval (bootstrap over test objects). `statistics` is logistic regression on statistics
of a patch, `network` a small convolutional network that sees fine detail apart from the picture, `pictures` one that sees log
images only. `as published` is the paper's recipe.
"""

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from patch_classifiers import auc, logistic_scores, network_scores, patches_of, statistics_of
from scipy.ndimage import distance_transform_edt
from tqdm import tqdm

from raytwin.acquisition import open_acquisition
from raytwin.acquisition.pairs import flat_corrected_log, replace_bad_pixels
from raytwin.acquisition.setting import Filter, Setting
from raytwin.calibration.calibrate import calibrate_twin
from raytwin.generator.datasets.generate import ChannelModel, detector_noise
from raytwin.generator.datasets.render import (
    ExpectedImage,
    geometry_of,
    images_of_moments,
    render_expected,
    sample_expected,
)
from raytwin.generator.line.twin import Twin
from raytwin.lab.bench import Bench, RenderedScene, render
from raytwin.lab.chain import margin_px
from raytwin.lab.phantoms import Edge
from raytwin.lab.protocols import CORRECTION_FRAMES, make_plan, run_protocol, system_of_seed
from raytwin.lab.system import LabSystem
from raytwin.lab.unkindness import NONE

Array = NDArray[np.float64]
COPPER = (Filter(material="Cu", thickness_mm=0.05),)
PAIR = (
    Setting(kV=40.0, power_W=40.0, exposure_ms=100.0, filters=COPPER),
    Setting(kV=90.0, power_W=45.0, exposure_ms=100.0, filters=COPPER),
)
PRODUCT = "chicken_breast"
COMPARED = ("lab again", "from maps", "told transmissions")


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """How much is measured."""

    rows: int
    columns: int
    exposures_ms: tuple[float, ...]
    replicates: int
    frames: int
    objects: int
    repeats: int
    epochs: int
    calibration_frames: int


FULL = Size(
    rows=128,
    columns=160,
    exposures_ms=(20.0, 50.0, 100.0),
    replicates=8,
    frames=16,
    objects=36,
    repeats=2,
    epochs=5,
    calibration_frames=20,
)
SHORT = Size(
    rows=96,
    columns=112,
    exposures_ms=(20.0, 100.0),
    replicates=4,
    frames=8,
    objects=8,
    repeats=2,
    epochs=2,
    calibration_frames=12,
)


class Session:
    """One session of the lab on a system: its own darks, flats and noise."""

    def __init__(self, system: LabSystem, bad: NDArray[np.bool_], seed: list[int]) -> None:
        self.bench = Bench(system, rng=np.random.default_rng(seed))
        self.bad = bad
        self._dark: dict[float, Any] = {}
        self._flat: dict[Setting, Any] = {}

    def counts(self, setting: Setting, frames: int, scene: RenderedScene | None) -> NDArray[np.float32]:
        found = [frame.astype(np.float32) for frame, _ in self.bench.expose(setting, frames=frames, scene=scene)]
        return np.stack(found)

    def dark_DN(self, exposure_ms: float) -> Array:
        if exposure_ms not in self._dark:
            found = next(self.bench.dark(exposure_ms, frames=1, averaged=CORRECTION_FRAMES))[0]
            self._dark[exposure_ms] = found.astype(np.float64)
        return np.asarray(self._dark[exposure_ms])

    def flat_DN(self, setting: Setting) -> Array:
        plain = replace(setting, averaged=CORRECTION_FRAMES)
        if plain not in self._flat:
            self._flat[plain] = next(self.bench.expose(plain, frames=1))[0].astype(np.float64)
        return np.asarray(self._flat[plain])

    def log(self, counts: NDArray[np.floating], setting: Setting) -> NDArray[np.float32]:
        image = flat_corrected_log(counts, dark_DN=self.dark_DN(setting.exposure_ms), flat_DN=self.flat_DN(setting))
        return np.asarray(replace_bad_pixels(image, self.bad), dtype=np.float32)


class Generator:
    """The twin's images of what stands in the lab's beam, from thickness maps.

    With `lab` it is given what no twin can know exactly: the lab's transmissions, spectrum and coefficients in them, and
    that the lab's photons sit in the middle of thirds of a pixel, which blurs borders by another 1 / 108 px^2 of variance.
    """

    def __init__(self, twin: Twin, seed: int, *, lab: Bench | None = None) -> None:
        self.twin = twin
        self.lab = lab
        self.rng = np.random.default_rng([seed, 77])
        self.detector = detector_noise(twin, bad_pixels="measured")
        self._channels: dict[Setting, ChannelModel] = {}

    def channel(self, setting: Setting) -> ChannelModel:
        if setting not in self._channels:
            self._channels[setting] = ChannelModel(self.twin, setting, PRODUCT, "measured")
        return self._channels[setting]

    def expected(self, setting: Setting, system: LabSystem, scene: RenderedScene | None) -> ExpectedImage:
        channels = [self.channel(setting).channel()]
        geometry = geometry_of(self.twin, settings=[setting])
        if self.lab is None:
            lengths = fine_lengths(system, scene)
            return render_expected(lengths, twin=self.twin, channels=channels, geometry=geometry)[0]
        of_one_mm = replace(geometry, focal_spot_mm=1.0).focal_blur_px
        geometry = replace(geometry, focal_spot_mm=math.sqrt(1.0 / 108.0) / of_one_mm)
        arrivals = self.lab.arrivals(setting, scene=scene)
        kept = without_margins(system, arrivals.cell)
        moments = []
        for power in (1, 2):
            per_cell = arrivals.rates.astype(np.float64) @ arrivals.deposit_keV**power
            moments.append((per_cell / per_cell[0])[kept].astype(np.float32))
        return images_of_moments(
            [(moments[0], moments[1])], twin=self.twin, channels=channels, geometry=geometry, supersampling=3
        )[0]

    def counts(self, setting: Setting, frames: int, image: ExpectedImage) -> NDArray[np.float32]:
        channel = self.channel(setting).channel()
        return np.stack(
            [sample_expected(image, channel=channel, detector=self.detector, rng=self.rng) for _ in range(frames)]
        )


def fine_lengths(system: LabSystem, scene: RenderedScene | None) -> dict[str, NDArray[np.float32]]:
    """Path lengths on three rays a pixel and axis, without the lab's margins; nothing in the beam: 0 mm of product."""
    if scene is None:
        return {PRODUCT: np.zeros((3 * system.rows, 3 * system.columns), dtype=np.float32)}
    return {name: without_margins(system, length) for name, length in scene.thickness_mm.items()}


def without_margins(system: LabSystem, fine: NDArray[Any]) -> NDArray[Any]:
    """The lab's fine grid without what lies beside the detector."""
    margin = 3 * margin_px(max(system.core_px))
    inner = slice(margin, -margin) if margin else slice(None)
    return fine[inner, inner]


# ------------------------------------------------------------------------------------------------ statistics


def line_of(frames: NDArray[np.float32], regions: list[NDArray[np.bool_]], dark: Array) -> Array:
    """Variance over signal in each region: points of the photon-transfer line, DN."""
    variance, mean = frames.var(axis=0, ddof=1, dtype=np.float64), frames.mean(axis=0, dtype=np.float64) - dark
    return np.array([variance[one].mean() / mean[one].mean() for one in regions])


def power_of(frames: NDArray[np.float32], window: tuple[slice, slice]) -> Array:
    """Noise power over squared signal in 12 rings of spatial frequency, from deviations about the frames' mean."""
    part = frames[:, window[0], window[1]].astype(np.float64)
    rest = part - part.mean(axis=0)
    power = (np.abs(np.fft.fft2(rest)) ** 2).mean(axis=0) / rest[0].size * len(part) / (len(part) - 1)
    radius = np.hypot(*np.meshgrid(*(np.fft.fftfreq(length) for length in rest[0].shape), indexing="ij"))
    ring = np.minimum((radius / 0.5 * 10).astype(int), 11)
    found = np.bincount(ring.ravel(), weights=power.ravel(), minlength=12) / np.bincount(ring.ravel(), minlength=12)
    return np.asarray(found / part.mean() ** 2 * 1e4)


def histogram_of(values: Array, edges: Array) -> Array:
    """Share of the values between the edges, the open ends included."""
    counts = np.bincount(np.searchsorted(edges, values.ravel()), minlength=len(edges) + 1)
    return np.asarray(counts / values.size)


def compare(lab: Array, others: Mapping[str, Array]) -> dict[str, Any]:
    """Replicates (replicate, element) of one session of the lab, and of others: another session, generated.

    Distances are rms over elements, in units of the scatter of all replicates within their kinds, over that between two
    replicates of the first session.
    """
    scatter = np.sqrt(np.mean([one.var(axis=0, ddof=1) for one in (lab, *others.values())], axis=0))
    scatter = np.maximum(scatter, 1e-30)
    among = np.mean([np.mean(((lab[i] - lab[j]) / scatter) ** 2) for i in range(len(lab)) for j in range(i)])
    middle = lab.mean(axis=0)
    told: dict[str, Any] = {}
    for name, other in others.items():
        between = np.mean([np.mean(((one - two) / scatter) ** 2) for one in lab for two in other])
        error = 100.0 * (other.mean(axis=0) - middle) / np.maximum(np.abs(middle), 1e-30)
        told[name] = {"error_percent": float(np.median(error)), "distance": math.sqrt(float(between / among))}
    return told


def statistics_at(
    setting: Setting,
    size: Size,
    system: LabSystem,
    sessions: Sequence[Session],
    generators: Sequence[Generator],
    scenes: Mapping[str, Any],
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows of statistics at one setting, and curves to draw."""
    dark = sessions[0].dark_DN(setting.exposure_ms)
    good = ~sessions[0].bad
    # counts of each kind: both sessions of the lab, then the generator
    frames_of: dict[str, list[list[NDArray[np.float32]]]] = {}
    for name, scene in scenes.items():
        frames_of[name] = [
            [one.counts(setting, size.frames, scene) for _ in range(size.replicates)] for one in sessions
        ]
        for generator in generators:
            expected = generator.expected(setting, system, scene)
            frames_of[name].append([generator.counts(setting, size.frames, expected) for _ in range(size.replicates)])
    lab = {name: found[0] for name, found in frames_of.items()}
    mean = np.mean([one.mean(axis=0) for one in lab["product"]], axis=0) - dark
    inside = (np.add.reduce(list(pixel_lengths(system, scenes["product"]).values())) > 3.0) & good
    bands = np.quantile(mean[inside], np.linspace(0, 1, 6))
    regions = [inside & (mean >= low) & (mean <= high) for low, high in pairwise(bands)]
    window = _window(inside)
    rows: list[dict[str, Any]] = []
    curves: dict[str, Any] = {}

    def add(name: str, of: Callable[[NDArray[np.float32], int], Array], scene: str) -> None:
        found = [np.stack([of(one, kind) for one in every]) for kind, every in enumerate(frames_of[scene])]
        told = compare(found[0], dict(zip(COMPARED, found[1:], strict=True)))
        rows.append({"kV": setting.kV, "exposure_ms": setting.exposure_ms, "statistic": name, **told})
        curves[name] = found

    def log(frames: NDArray[np.float32], kind: int) -> NDArray[np.float32]:
        return (
            sessions[kind].log(frames, setting) if kind < 2 else generators[kind - 2].channel(setting).log_image(frames)
        )

    add("photon transfer, product", lambda frames, kind: line_of(frames, regions, dark), "product")
    add("photon transfer, open field", lambda frames, kind: line_of(frames, [good], dark), "open field")
    add("noise power, product", lambda frames, kind: power_of(frames, window), "product")
    add("noise power, open field", lambda frames, kind: power_of(frames, (slice(16, 80), slice(16, 80))), "open field")
    distance = _distance_from_edge(fine_lengths(system, scenes["edge"]))
    near = [(distance >= low) & (distance < low + 0.5) & good for low in np.arange(-4.0, 4.0, 0.5)]
    add(
        "edge profile",
        lambda frames, kind: np.array([np.exp(-log(frames, kind)[:, one]).mean(dtype=np.float64) for one in near]),
        "edge",
    )
    for scene, mask in (("product", inside), ("open field", good)):
        pooled = np.concatenate([log(one, 0)[:, mask].ravel() for one in lab[scene]])
        edges = np.quantile(pooled, np.linspace(0, 1, 21)[1:-1])
        add(
            f"histogram, {scene}",
            lambda frames, kind, mask=mask, edges=edges: histogram_of(log(frames, kind)[:, mask], edges),  # type: ignore[misc]
            scene,
        )
    return rows, curves


def pixel_lengths(system: LabSystem, scene: RenderedScene) -> dict[str, Array]:
    """Path lengths (row, column), means over the rays of a pixel."""
    return {
        name: fine.reshape(system.rows, 3, system.columns, 3).mean(axis=(1, 3), dtype=np.float64)
        for name, fine in fine_lengths(system, scene).items()
    }


def _window(inside: NDArray[np.bool_]) -> tuple[slice, slice]:
    """48 x 48 pixels in the middle of the product."""
    row, column = (int(np.median(one)) for one in np.nonzero(inside))
    return slice(row - 24, row + 24), slice(column - 24, column + 24)


def _distance_from_edge(lengths: Mapping[str, NDArray[np.floating]]) -> Array:
    """Distance (row, column) of pixel middles from the border of what stands in the beam, px; above 0 behind it."""
    covered = np.add.reduce(list(lengths.values())) > 0
    distance = distance_transform_edt(covered) - distance_transform_edt(~covered)
    return np.asarray((distance - 0.5 * np.sign(distance))[1::3, 1::3] / 3.0)


# ------------------------------------------------------------------------------------------------ classifiers


def image_sets(
    size: Size, seed: int, system: LabSystem, twin: Twin, sessions: list[Session]
) -> dict[str, NDArray[np.float32]]:
    """Log image pairs (object, look, channel, row, column) of each kind; a look is an exposure and a repeat."""
    bad = twin.maps.bad_pixels > 0
    generator = Generator(twin, seed + 1000)
    told = Generator(twin, seed + 2000, lab=sessions[0].bench)
    kinds = ("lab", "lab again", "from maps", "told transmissions", "from references", "as published")
    looks = len(size.exposures_ms) * size.repeats
    found = {name: np.empty((size.objects, looks, 2, size.rows, size.columns), dtype=np.float32) for name in kinds}
    scenes: list[Any] = []
    for batch in range(math.ceil(size.objects / 6)):
        plan = make_plan("set1", system=system, rng=np.random.default_rng([seed, 5, batch]), products=6)
        scenes += list(plan.scenes.values())
    reference_session = Session(system, bad, [seed, 31])
    for number in tqdm(range(size.objects), desc="objects", disable=None):
        scene = render(system, scenes[number])
        for plane, setting in enumerate(PAIR):
            reference = replace(setting, averaged=10)
            taken = reference_session.log(reference_session.counts(reference, 1, scene)[0], reference)
            transmission = np.exp(-taken.astype(np.float64))
            rendered, rendered_told = (one.expected(setting, system, scene) for one in (generator, told))
            look = 0
            for exposure_ms in size.exposures_ms:
                target = replace(setting, exposure_ms=exposure_ms)
                channel = generator.channel(target)
                for _ in range(size.repeats):
                    for kind, session in zip(kinds, sessions, strict=False):
                        found[kind][number, look, plane] = session.log(session.counts(target, 1, scene)[0], target)
                    for kind, counts in (
                        ("from maps", generator.counts(target, 1, rendered)[0]),
                        ("told transmissions", told.counts(target, 1, rendered_told)[0]),
                        ("from references", channel.sample_counts(transmission, reference, generator.rng)),
                        ("as published", channel.sample_as_published(transmission, generator.rng)),
                    ):
                        found[kind][number, look, plane] = channel.log_image(counts)
                    look += 1
    return found


def classify(
    sets: Mapping[str, NDArray[np.float32]], *, patch: int, size: Size, seed: int, network: bool
) -> list[dict[str, Any]]:
    """AUC of lab against each other kind, and its difference to lab against lab."""
    objects = next(iter(sets.values())).shape[0]
    half = objects // 2
    step = patch if patch <= 16 else patch // 2
    cut = {
        name: [patches_of(one.reshape(-1, *one.shape[-3:]), patch, step) for one in images]
        for name, images in sets.items()
    }
    scores: dict[tuple[str, str], list[tuple[Array, Array]]] = {}
    for kind in list(sets)[1:]:
        flat = {
            name: [np.concatenate(list(one)) for one in cut[name]] for name in ("lab", kind)
        }  # per object (patch, channel, size, size)
        train = (np.concatenate(flat["lab"][:half]), np.concatenate(flat[kind][:half]))
        test = (np.concatenate(flat["lab"][half:]), np.concatenate(flat[kind][half:]))
        lengths = [len(one) for one in flat["lab"][half:]]
        ways = {
            "statistics": lambda train=train, test=test: logistic_scores(  # type: ignore[misc]
                (statistics_of(train[0]), statistics_of(train[1])), (statistics_of(test[0]), statistics_of(test[1]))
            )
        }
        if network:
            for way, detail in (("network", True), ("pictures", False)):
                ways[way] = lambda train=train, test=test, detail=detail: network_scores(  # type: ignore[misc]
                    train, test, epochs=size.epochs if patch <= 16 else 2 * size.epochs, seed=seed, detail=detail
                )
        for way, run in ways.items():
            first, second = run()
            ends = np.cumsum(lengths)[:-1]
            scores[way, kind] = list(zip(np.split(first, ends), np.split(second, ends), strict=True))
    rows = []
    rng = np.random.default_rng(seed)
    draws = rng.integers(objects - half, size=(300, objects - half))
    for (way, kind), pairs in scores.items():
        value = _pooled_auc(pairs, np.arange(objects - half))
        row = {"patch": patch, "classifier": way, "kind": kind, "auc": value}
        if kind != "lab again":
            real = scores[way, "lab again"]
            spread = [_pooled_auc(pairs, one) - _pooled_auc(real, one) for one in draws]
            low, high = np.quantile(spread, [0.025, 0.975])
            row["difference"] = value - _pooled_auc(real, np.arange(objects - half))
            row["low"], row["high"] = float(low), float(high)
        rows.append(row)
    return rows


def _pooled_auc(pairs: list[tuple[Array, Array]], chosen: NDArray[np.intp]) -> float:
    return auc(np.concatenate([pairs[one][0] for one in chosen]), np.concatenate([pairs[one][1] for one in chosen]))


# ------------------------------------------------------------------------------------------------ the run


def run(seed: int, size: Size, *, network: bool, output: Path | None) -> dict[str, Any]:
    """All rows of one system."""
    # the plain line: what is compared is the generation, not how well a line is calibrated
    system = replace(system_of_seed(seed, rows=size.rows, columns=size.columns, families=()), unkindness=NONE)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        run_protocol(
            path,
            protocol="calibration",
            seed=seed,
            system=system,
            frames=size.calibration_frames,
        )
        with open_acquisition(path) as acquisition:
            twin = calibrate_twin(acquisition, rng=np.random.default_rng(seed))
    bad = twin.maps.bad_pixels > 0
    plan = make_plan("set2", system=system, rng=np.random.default_rng([seed, 9]), products=2)
    product = next(one for one in plan.scenes.values() if "rib_bone" in one.materials)
    scenes = {"product": render(system, product), "open field": None, "edge": render(system, Edge(angle=0.12))}
    sessions = [Session(system, bad, [seed, number]) for number in (20, 23)]
    generators = [
        Generator(twin, seed),
        Generator(twin, seed + 3000, lab=Bench(system, rng=np.random.default_rng([seed, 24]))),
    ]
    rows, curves = [], {}
    for setting in PAIR:
        for exposure_ms in tqdm(size.exposures_ms, desc=f"{setting.kV:g} kV", disable=None):
            target = replace(setting, exposure_ms=exposure_ms)
            found, drawn = statistics_at(target, size, system, sessions, generators, scenes)
            rows += found
            curves[setting.kV, exposure_ms] = drawn
    if output is not None:
        draw(curves, output)
    sets = image_sets(size, seed, system, twin, [Session(system, bad, [seed, number]) for number in (21, 22)])
    classified = []
    for patch in (16, 64):
        classified += classify(sets, patch=patch, size=size, seed=seed, network=network)
    return {"seed": seed, "statistics": rows, "classifiers": classified}


PLACES = {
    "photon transfer": "band of signal, dark to bright",
    "noise power": "ring of spatial frequency, 0 to 0.6 cycles per pixel",
    "edge profile": "distance from the edge, half pixels from -4",
    "histogram": "bin of log values, each a twentieth of the lab's",
}


def draw(curves: Mapping[tuple[float, float], Mapping[str, list[Array]]], output: Path) -> None:
    """Figures of every statistic: departures of single replicates from the lab's mean, in the lab's standard deviations."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    output.mkdir(parents=True, exist_ok=True)
    kinds = (("lab", "0.6"), ("lab again", "0.8"), ("from maps", "tab:blue"), ("told transmissions", "tab:orange"))
    for statistic in next(iter(curves.values())):
        figure, axes = pyplot.subplots(
            2, max(len(curves) // 2, 1), figsize=(12, 6.5), squeeze=False, layout="constrained"
        )
        for axis, ((kV, exposure_ms), found) in zip(axes.ravel(), curves.items(), strict=False):
            middle, scatter = found[statistic][0].mean(axis=0), found[statistic][0].std(axis=0, ddof=1)
            for number, ((name, colour), values) in enumerate(zip(kinds, found[statistic], strict=True)):
                away = (values - middle) / scatter
                place = np.arange(away.shape[1]) + 0.12 * (number - 1.5)
                axis.plot(place, away.T, ".", color=colour, markersize=2.5)
                axis.plot(place, away.mean(axis=0), "_", color=colour, markersize=9, label=f"{name}, mean")
            axis.axhline(0.0, color="0.8", linewidth=0.6)
            axis.set_title(f"{kV:g} kV, {exposure_ms:g} ms", fontsize=9)
        axes[0, 0].legend(fontsize=7)
        figure.supxlabel(PLACES[statistic.split(",")[0]], fontsize=9)
        figure.supylabel("departure from the lab's mean, standard deviations of a replicate", fontsize=9)
        figure.suptitle(statistic)
        figure.savefig(output / (statistic.replace(", ", "_").replace(" ", "_") + ".png"), dpi=110)
        pyplot.close(figure)


def print_tables(result: Mapping[str, Any]) -> None:
    """Both tables for people."""
    print(f"{'':<42}" + "".join(f"{name:>22}" for name in COMPARED))
    print(f"{'statistic':<33}{'kV':>4}{'ms':>5}" + f"{'error %':>12}{'distance':>10}" * len(COMPARED))
    for row in result["statistics"]:
        numbers = "".join(f"{row[name]['error_percent']:>12.2f}{row[name]['distance']:>10.2f}" for name in COMPARED)
        print(f"{row['statistic']:<33}{row['kV']:>4.0f}{row['exposure_ms']:>5.0f}{numbers}")
    print(f"\n{'patch':>5} {'classifier':<11}{'lab against':<19}{'AUC':>7}{'less lab-lab (95 %)':>30}")
    for row in result["classifiers"]:
        text = "" if "low" not in row else f"{row['difference']:+.3f} ({row['low']:+.3f} to {row['high']:+.3f})"
        print(f"{row['patch']:>5} {row['classifier']:<11}{row['kind']:<19}{row['auc']:>7.3f}{text:>30}")


def main() -> int:
    """Run one system, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--short", action="store_true", help="small frames, few objects")
    parser.add_argument("--no-network", action="store_true", help="statistics classifier only")
    parser.add_argument("--output", type=Path, help="folder for figures")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)
    size = SHORT if arguments.short else FULL
    result = run(arguments.seed, size, network=not arguments.no_network, output=arguments.output)
    print_tables(result)
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
