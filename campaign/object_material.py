"""What foreign objects are made of: their attenuation against the library's, from images of objects whose thickness is known.

An object of t mm is seen as a t mm of its library material and b t mm of the product: a says how much of what absorbs is in it, b
how its hardness differs, and what of the product it displaces. Both follow from the contrast of many objects at two tube voltages.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ..diagnosis.model.changes import ATTENUATION_SD
from ..errors import InputError
from ..generator.line.twin import Z95

if TYPE_CHECKING:
    from ..generator.datasets.known_scenes import KnownScene, KnownScenes

_FEWEST = 8  # objects: two numbers and their scatter are asked of two contrasts of each
_PRIOR_SD = 0.3  # of a and b: bones are tabulated from 1.18 to 1.92 g/cm3 (ICRU 44 and 46), 25 % about their middle
_STEP = 0.1  # of a and b, for slopes: contrast is nearly straight in them
_TURNS = 3  # of Gauss and Newton: the second changes contrasts of bones by 1e-3 of the first
_WIDEST = 0.5  # scatter of contrasts from object to object; a choice: beyond it one of twenty is off by a factor of two


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectMaterial:
    """Of what the objects of one library material are.

    Fields: material; product: the material around them; objects: how many were looked at; a, b: mm of material and of product for
    each mm of the object, with `covariance` (2, 2); scatter: of contrasts from object to object, relative; contrast_percent: change
    of the mean contrast at the low and at the high voltage against the library's, each (value, low, high) of 95 %. Covariance and
    intervals hold noise, scatter, and what is not known of the twin.
    """

    material: str
    product: str
    objects: int
    a: float
    b: float
    covariance: NDArray[np.float64]
    scatter: float
    contrast_percent: tuple[tuple[float, float, float], tuple[float, float, float]]

    def scene(self, scene: "KnownScene") -> "KnownScene":
        """The scene with its objects made of this."""
        thickness = scene.thickness_mm.get(self.material)
        if thickness is None:
            return scene
        seen = dict(scene.thickness_mm)
        seen[self.material] = self.a * np.asarray(thickness, dtype=np.float64)
        around = np.asarray(seen.get(self.product, np.zeros(np.shape(thickness))), dtype=np.float64)
        seen[self.product] = np.maximum(around + self.b * np.asarray(thickness, dtype=np.float64), 0.0)
        return replace(scene, thickness_mm=seen)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        sd = np.sqrt(np.diag(self.covariance))
        interval = {
            name: {"value": value, "low": value - Z95 * float(error), "high": value + Z95 * float(error)}
            for name, value, error in (("material", self.a, sd[0]), ("product", self.b, sd[1]))
        }
        low, high = (dict(zip(("value", "low", "high"), found, strict=True)) for found in self.contrast_percent)
        return {
            "material": self.material,
            "product": self.product,
            "objects": self.objects,
            "mm_per_mm": interval,
            "scatter_percent": 100.0 * self.scatter,
            "contrast_change_percent": {"low_kV": low, "high_kV": high},
        }


def object_materials(
    line: "KnownScenes",
    scenes: Sequence["KnownScene"],
    measured: Mapping[str, NDArray[np.floating]],
    *,
    draws: Sequence["KnownScenes"],
    steps: Sequence["KnownScenes"],
    product: str,
    dilations: int,
) -> tuple[list[ObjectMaterial], list[str]]:
    """What the objects of each library material are, and why others cannot be told.

    Args:
        line: the twin's pictures at the settings of the images.
        scenes: objects of known thickness; those without a measured image are not looked at.
        measured: image of a scene -> mean -ln(I / I0) (2, row, column), low voltage first.
        draws: the same of draws from the posterior of the spectrum.
        steps: the same with one of the twin's effects a standard deviation stronger, each.
        product: material around the objects.
        dilations: width of the ring around an object that its contrast is taken against, px.
    """
    outside: dict[str, float] = {}
    inside: dict[str, float] = {}
    for scene in scenes:
        for name, values in scene.thickness_mm.items():
            within = float(np.sum(np.asarray(values)[scene.foreign_object_mask]))
            inside[name] = inside.get(name, 0.0) + within
            outside[name] = outside.get(name, 0.0) + float(np.sum(values)) - within
    # a mask leaves out pixels that a border cuts
    foreign = [name for name in inside if name != product and inside[name] > outside[name]]
    found, told = [], []
    for name in foreign:
        looked_at = [
            scene
            for scene in scenes
            if scene.row.image in measured
            and [one for one in foreign if np.any(np.asarray(scene.thickness_mm.get(one, 0.0)) > 0)] == [name]
        ]
        if len(looked_at) < _FEWEST:
            told.append(
                f"{name}: {len(looked_at)} objects among the images to learn from, {_FEWEST} are needed to tell its own"
            )
            continue
        seen = [_contrast(measured[scene.row.image], scene, dilations) for scene in looked_at]
        used = [(scene, one) for scene, one in zip(looked_at, seen, strict=True) if one is not None]
        if len(used) < _FEWEST:
            told.append(f"{name}: too few objects have product around them")
            continue
        common = _of_the_twin(line, [scene for scene, _ in used[:_FEWEST]], draws, steps, dilations)
        material = _fit(line, name, product, used, dilations, common)
        if material.scatter > _WIDEST or material.a <= 0:
            told.append(
                f"{name}: contrasts scatter by {100 * material.scatter:.0f} % about what the path lengths say, as of"
                f" {material.a:.2g} mm for each mm; masks, path lengths and images do not belong together"
            )
        else:
            found.append(material)
    return found, told


@dataclass(frozen=True, slots=True)
class _Contrast:
    """Of one object in an image: mean in it less that in the ring, at the two voltages (2,), and its variance by noise (2,)."""

    value: NDArray[np.float64]
    noise: NDArray[np.float64]


def _contrast(image: NDArray[np.floating], scene: "KnownScene", dilations: int) -> _Contrast | None:
    from ..acquisition.contrast import object_and_ring

    try:
        inside, ring = object_and_ring(image[0], image[1], scene.foreign_object_mask, dilations=dilations)
    except InputError:
        return None
    planes = np.asarray(image, dtype=np.float64)
    value = planes[:, inside].mean(axis=1) - planes[:, ring].mean(axis=1)
    # differences of neighbours: the product's shape is not noise
    steps = np.diff(planes, axis=2)[:, ring[:, 1:] & ring[:, :-1]]
    noise = 0.5 * np.mean(steps**2, axis=1) if steps.shape[1] else np.full(2, np.nan)
    return _Contrast(value, noise * (1.0 / np.count_nonzero(inside) + 1.0 / np.count_nonzero(ring)))


def _expected(line: "KnownScenes", scenes: Sequence["KnownScene"], dilations: int) -> NDArray[np.float64]:
    """Contrasts (object, 2) in pictures without noise; NaN where there is no ring."""
    rows = []
    for scene in scenes:
        images = line.expected(scene.thickness_mm)
        contrast = _contrast(np.stack([image.log_image for image in images]), scene, dilations)
        rows.append(np.full(2, np.nan) if contrast is None else contrast.value)
    return np.array(rows)


def _of_the_twin(
    line: "KnownScenes",
    scenes: Sequence["KnownScene"],
    draws: Sequence["KnownScenes"],
    steps: Sequence["KnownScenes"],
    dilations: int,
) -> NDArray[np.float64]:
    """Covariance (2, 2) of the relative error that contrasts of all objects share, as spectrum, effects and tables are not known."""
    usual = _expected(line, scenes, dilations)

    def outer(other: "KnownScenes") -> NDArray[np.float64]:
        change = np.nanmean(_expected(other, scenes, dilations) - usual, axis=0) / np.nanmean(usual, axis=0)
        return np.outer(change, change)

    total = np.full((2, 2), ATTENUATION_SD**2)
    if draws:
        total = total + np.mean([outer(one) for one in draws], axis=0)
    return np.asarray(total + sum((outer(one) for one in steps), np.zeros((2, 2))))


def _fit(
    line: "KnownScenes",
    material: str,
    product: str,
    used: Sequence[tuple["KnownScene", _Contrast]],
    dilations: int,
    common: NDArray[np.float64],
) -> ObjectMaterial:
    own = ObjectMaterial(
        material=material,
        product=product,
        objects=len(used),
        a=1.0,
        b=0.0,
        covariance=np.zeros((2, 2)),
        scatter=0.0,
        contrast_percent=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    )

    def expected(a: float, b: float) -> NDArray[np.float64]:
        return _expected(line, [replace(own, a=a, b=b).scene(scene) for scene, _ in used], dilations)

    seen = np.array([one.value for _, one in used])
    noise = np.array([one.noise for _, one in used])
    library = expected(1.0, 0.0)
    slopes = np.stack(
        [(expected(1.0 + _STEP, 0.0) - library) / _STEP, (expected(1.0, _STEP) - library) / _STEP], axis=-1
    )
    at, there = np.array([1.0, 0.0]), library
    usable = np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(noise).all(axis=1)
    scatter, covariance, gain = 0.0, np.eye(2), np.eye(2)
    for turn in range(_TURNS):
        if turn:
            there = expected(*at)
        scatter, change, covariance, gain = _step(
            (seen - there)[usable], slopes[usable], there[usable], noise[usable], at
        )
        at = at + change
    mean_slope = slopes[usable].mean(axis=0)
    mean = np.abs(library[usable].mean(axis=0))
    covariance = covariance + gain @ common @ gain.T
    percents = []
    for channel in range(2):
        value = 100.0 * float(mean_slope[channel] @ (at - [1.0, 0.0])) / float(mean[channel])
        error = 100.0 * math.sqrt(float(mean_slope[channel] @ covariance @ mean_slope[channel])) / float(mean[channel])
        percents.append((value, value - Z95 * error, value + Z95 * error))
    return replace(
        own,
        objects=int(np.count_nonzero(usable)),
        a=float(at[0]),
        b=float(at[1]),
        covariance=covariance,
        scatter=scatter,
        contrast_percent=(percents[0], percents[1]),
    )


def _step(
    left: NDArray[np.float64],
    slopes: NDArray[np.float64],
    there: NDArray[np.float64],
    noise: NDArray[np.float64],
    at: NDArray[np.float64],
) -> tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Scatter between objects, change of (a, b), its covariance, and by how much it follows a relative error of all contrasts (2, 2).

    What is left of each object is N(0, noise + scatter^2 p p').

    Args:
        left: (object, 2) contrast not explained.
        slopes: (object, 2, 2) of contrasts in a and b.
        there: (object, 2) contrast p as explained so far.
        noise: (object, 2) variance.
        at: (a, b) so far; the prior holds them to (1, 0).
    """
    prior = np.eye(2) / _PRIOR_SD**2
    towards = prior @ (np.array([1.0, 0.0]) - at)

    def solved(log_scatter: float) -> tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        covariances = (
            np.einsum("ij,jk->ijk", noise, np.eye(2))
            + math.exp(2.0 * log_scatter) * there[:, :, None] * there[:, None, :]
        )
        weights = np.linalg.inv(covariances)
        information = np.einsum("nki,nkl,nlj->ij", slopes, weights, slopes) + prior
        score = np.einsum("nki,nkl,nl->i", slopes, weights, left) + towards
        change = np.linalg.solve(information, score)
        rest = left - np.einsum("nki,i->nk", slopes, change)
        away = change + at - [1.0, 0.0]
        # restricted likelihood, so that the scatter is not too small with few objects
        fit = (
            float(np.einsum("nk,nkl,nl->", rest, weights, rest))
            + float(np.linalg.slogdet(covariances)[1].sum())
            + float(np.linalg.slogdet(information)[1])
            + float(away @ prior @ away)
        )
        inverse = np.asarray(np.linalg.inv(information))
        return fit, change, inverse, inverse @ np.einsum("nki,nkl,nl->il", slopes, weights, there)

    best = minimize_scalar(lambda value: solved(value)[0], bounds=(math.log(1e-4), 0.0), method="bounded")
    return math.exp(float(best.x)), *solved(float(best.x))[1:]
