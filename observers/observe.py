"""From a setting to its a90 without training: detectability of each object, its chance to be found, the size found at 90 %.

    d_eff^2 = e sum of |signal|^2 over (noise + v)        POD = Phi(d_eff - t)

for the ideal detector (detectors.py has the others), with the efficiency e and the internal noise v of whom the observer stands in
for (efficiency.py), and the threshold t of a search through the whole image (search.py).

Objects as they came (of references) are hits with these chances: the curve that is fitted to networks' hits is fitted to them, link
and size alike. Of a shape at a range of sizes POD is the mean over its turns and places, and a90 is read off between the sizes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..acquisition.setting import Setting
from ..errors import InputError
from ..pod import fit_many
from ..pod.bootstrap import sizes_at
from ..pod.links import link_from_name
from .detectors import DETECTORS
from .line_images import LineImages
from .objects import ForeignObjects
from .search import independent_places, search_threshold
from .texture import ProductTexture

FloatArray = NDArray[np.float64]
Pair = tuple[Setting, Setting]
_AT_ONCE = 400_000  # values (setting, object, bin) worked on together: they stay in the processor's cache
SETTINGS_AT_ONCE = 500
USUAL_FALSE_ALARMS = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Observer:
    """Who looks.

    Fields: detector (a key of `DETECTORS`); image (a key of `line_images.IMAGES`; `both` is for `ideal`); false_alarm_rate (share of
    images without object that show an alarm); efficiency (of d'^2; above 1 where networks use more than this image); internal_noise
    (standard deviation in a pixel of the image, added white); link and log_size of curves that are fitted to sampled objects.

    Example:
        >>> from raytwin.observers import Observer
        >>> Observer(detector="npw", false_alarm_rate=0.05).image
        'residual'
    """

    detector: str = "ideal"
    image: str = "residual"
    false_alarm_rate: float = USUAL_FALSE_ALARMS
    efficiency: float = 1.0
    internal_noise: float = 0.0
    link: str = "cloglog"
    log_size: bool = False

    def __post_init__(self) -> None:
        if self.detector not in DETECTORS:
            raise InputError("detector", received=self.detector, expected="one of " + ", ".join(DETECTORS))
        if self.image == "both" and self.detector != "ideal":
            raise InputError(
                "detector",
                received=f"{self.detector} of the image `both`",
                expected="`ideal`, which weighs two images against each other",
            )
        if not 0 < self.false_alarm_rate < 1:
            raise InputError("false-alarm rate", received=self.false_alarm_rate, expected="between 0 and 1")
        if not (math.isfinite(self.efficiency) and self.efficiency > 0):
            raise InputError("efficiency", received=self.efficiency, expected="a finite value above 0")
        if not (math.isfinite(self.internal_noise) and self.internal_noise >= 0):
            raise InputError("internal noise", received=self.internal_noise, expected="0 or more")
        link_from_name(self.link)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observed:
    """What an observer finds.

    Fields: d_prime, threshold, pod, delta_R (setting, object); a50, a90 (setting,) in the unit of the objects' size, NaN where POD
    does not reach it within the sizes; a90_of_curve (setting,): the same of a fitted curve, wherever it reaches it; a90_delta_R
    (setting,): Delta R of the object at a90, NaN where it is not known or the size is the contrast itself; independent_places
    (setting,): that a search chooses between, median over the objects.
    """

    d_prime: FloatArray
    threshold: FloatArray
    pod: FloatArray
    delta_R: FloatArray
    a50: FloatArray
    a90: FloatArray
    a90_of_curve: FloatArray
    a90_delta_R: FloatArray
    independent_places: FloatArray


def observe_settings(
    line: LineImages,
    pairs: Sequence[Pair],
    objects: ForeignObjects,
    *,
    observer: Observer | None = None,
    texture: ProductTexture | None = None,
) -> Observed:
    """Detectability, POD and a90 at every pair of settings.

    Args:
        line: the twin.
        pairs: (low, high) settings, each with a tube load.
        objects: of references or of a shape.
        observer: who looks.
        texture: of the product, noise in images that its thickness does not drop out of.

    Raises:
        InputError: no settings, or what `LineImages.pair_images` refuses.

    Source: ICRU Report 54 (1996); Barrett & Myers (2004), ch. 13.
    Checked against: matched filters on drawn noise, networks (tests/test_observers.py, validation/observers.py).
    """
    if not pairs:
        raise InputError("settings", received="none", expected="one pair of settings or more")
    observer = observer or Observer()
    parts = [
        PreparedSettings(line, pairs[first : first + SETTINGS_AT_ONCE], objects, observer=observer, texture=texture)
        for first in range(0, len(pairs), SETTINGS_AT_ONCE)
    ]
    found = [one.d_and_threshold(observer.internal_noise) for one in parts]
    d_prime = math.sqrt(observer.efficiency) * np.concatenate([one[0] for one in found])
    threshold = np.concatenate([one[1] for one in found])
    delta_R = np.concatenate([one.delta_R for one in parts])
    from scipy.special import ndtr

    pod = ndtr(d_prime - threshold)
    a50, a90 = sizes_of_pod(pod, objects, link=observer.link, log_size=observer.log_size)
    largest = float(objects.size.max())
    return Observed(
        d_prime=d_prime,
        threshold=threshold,
        pod=pod,
        delta_R=delta_R,
        a50=np.where(a50 <= largest, a50, np.nan),
        a90=np.where(a90 <= largest, a90, np.nan),
        a90_of_curve=a90,
        a90_delta_R=_delta_R_at(a90, delta_R, objects),
        independent_places=np.median(independent_places(threshold, observer.false_alarm_rate), axis=1),
    )


class PreparedSettings:
    """Pairs of settings with what stands in their images, ready for observers of any efficiency and internal noise.

    Args:
        line, pairs, objects, texture: as of `observe_settings`.
        observer: its detector, image and false-alarm rate.
    """

    def __init__(
        self,
        line: LineImages,
        pairs: Sequence[Pair],
        objects: ForeignObjects,
        *,
        observer: Observer,
        texture: ProductTexture | None = None,
    ) -> None:
        bins = objects.bins
        self._objects = objects
        self._observer = observer
        self._images = line.pair_images(pairs, objects, image=observer.image)
        self._spread_power, self._optical = line.noise_power(bins), line.optical_transfer(bins)
        self._moving = np.array([any(line.motion_px(one) > 0 for one in pair) for pair in pairs])
        self._motion = line.motion_transfers(pairs, bins) * self._optical if self._moving.any() else None
        self._texture = None if texture is None else texture.power(bins, line.object_pixel_mm)

    @property
    def delta_R(self) -> FloatArray:
        """Delta R (setting, object) of the objects."""
        return self._images.delta_R

    @property
    def pixel_variance(self) -> FloatArray:
        """Power of the image's noise (setting, object) at frequency 0, before internal noise; of both: of their best mean."""
        power = self._images.quantum + self._images.white
        return np.asarray(1.0 / np.sum(1.0 / power, axis=0))

    def _through(self, changes: FloatArray, part: slice) -> FloatArray:
        """Changes of each log image (image, 2, setting, object), blurred and added up (image, setting, object, bin)."""
        changes = changes[..., None]
        if self._motion is None or not self._moving[part].any():
            return np.asarray(changes.sum(axis=1) * self._optical)
        transfer = self._motion[:, part, None, :]
        return np.asarray(changes[:, 0] * transfer[0] + changes[:, 1] * transfer[1])

    def d_and_threshold(self, internal_noise: float) -> tuple[FloatArray, FloatArray]:
        """d' at full efficiency and the threshold of the search (setting, object) each."""
        images, objects, observer = self._images, self._objects, self._observer
        detect = DETECTORS[observer.detector]
        count = images.delta_R.shape
        squared, row, column = (np.empty(count) for _ in range(3))
        step = max(1, _AT_ONCE // (count[1] * objects.bins.share.size))
        for first in range(0, count[0], step):
            part = slice(first, first + step)
            filtered = self._through(images.signal[:, :, part], part)
            texture = None
            if self._texture is not None:
                texture = self._through(images.product_slope[:, :, part], part), self._texture
            power = images.quantum[:, part, :, None] * self._spread_power
            power += images.white[:, part, :, None] + internal_noise**2
            filtered, power = _best_of(filtered, power, texture)
            found = detect(objects.energy * filtered**2, objects.amplitude * filtered, power, objects.bins)
            squared[part] = found.d_squared
            row[part], column[part] = found.row_correlation, found.column_correlation
        threshold = search_threshold(
            row_correlation=row,
            column_correlation=column,
            area_px=objects.area_px,
            false_alarm_rate=observer.false_alarm_rate,
        )
        return np.sqrt(np.maximum(squared, 0.0)), threshold


def _best_of(
    signal: FloatArray, power: FloatArray, texture: tuple[FloatArray, FloatArray] | None
) -> tuple[FloatArray, FloatArray]:
    """Signal and noise power (setting, object, bin) of one image, or of the best combination of two at each frequency.

    The best weights are K^-1 s, with K = diag(power) + thickness slope slope'; these make of s, and of the noise, s' K^-1 s.

    Args:
        signal, power: of each image (image, setting, object, bin), the noise independent from image to image.
        texture: change of each image with the product's thickness (image, setting, object, bin), /mm, and the power of this thickness
            (bin,), mm^2, one and the same in all images; None: an even product.
    """
    if len(signal) == 1:
        return signal[0], power[0] if texture is None else power[0] + texture[0][0] ** 2 * texture[1]
    found = (signal**2 / power).sum(axis=0)
    if texture is not None:
        slope, thickness = texture
        alike = (signal * slope / power).sum(axis=0)
        found -= thickness * alike**2 / (1.0 + thickness * (slope**2 / power).sum(axis=0))
    return found, found


def sizes_of_pod(
    pod: FloatArray, objects: ForeignObjects, *, link: str = "cloglog", log_size: bool = False
) -> tuple[FloatArray, FloatArray]:
    """a50 and a90 (setting,) of chances (setting, object), in the unit of the size; NaN where there is none.

    A curve that was fitted may reach them beyond the largest size; of a shape POD is known within the sizes alone.
    """
    if not objects.sampled:
        sizes, where = np.unique(objects.size, return_inverse=True)
        count = np.bincount(where)
        curve = np.stack([np.bincount(where, row) / count for row in pod])
        return _first_reached(curve, sizes, 0.5), _first_reached(curve, sizes, 0.9)
    coefficients = fit_many(
        objects.size, np.clip(pod, 1e-9, 1 - 1e-9), np.clip(1 - pod, 1e-9, 1.0), link=link, log_size=log_size
    )
    found = []
    for share in (0.5, 0.9):
        sizes = sizes_at(coefficients, link_from_name(link).eta_from_pod(share), log_size=log_size)
        found.append(np.where(sizes > 0, sizes, np.nan))
    return found[0], found[1]


def _first_reached(curve: FloatArray, sizes: FloatArray, share: float) -> FloatArray:
    """Smallest size (setting,) from which on a curve (setting, size) stays at `share` or above; between sizes in ln size."""
    from scipy.special import ndtri

    below = curve < share
    last_below = np.where(below.any(axis=1), curve.shape[1] - 1 - np.argmax(below[:, ::-1], axis=1), -1)
    found = np.full(len(curve), np.nan)
    for number, last in enumerate(last_below):
        if last == -1 or last == curve.shape[1] - 1:
            continue  # smaller than the smallest, or never reached
        ends = ndtri(np.clip(curve[number, last : last + 2], 1e-12, 1 - 1e-12))
        part = (ndtri(share) - ends[0]) / (ends[1] - ends[0])
        found[number] = math.exp(math.log(sizes[last]) + part * math.log(sizes[last + 1] / sizes[last]))
    return found


def _delta_R_at(a90: FloatArray, delta_R: FloatArray, objects: ForeignObjects) -> FloatArray:
    if objects.sampled:
        return np.full(a90.shape, np.nan)
    sizes, where = np.unique(objects.size, return_inverse=True)
    count = np.bincount(where)
    rows = [np.interp(at, sizes, np.bincount(where, row) / count) for at, row in zip(a90, delta_R, strict=True)]
    return np.array(rows)
