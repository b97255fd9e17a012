"""Foreign objects that an observer looks for: their shapes as spectra, their thickness and the product around them.

Either objects of reference images, each with its mask, its contrast and its place, or a shape at a range of sizes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ..acquisition.contrast import PRODUCT_THRESHOLD, dilations_for_pixel
from ..acquisition.dataset_io import Dataset, DatasetRow
from ..errors import InputError
from .frequencies import FrequencyBins, frequency_bins, object_spectrum

FloatArray = NDArray[np.float64]

TURNS_DEG = (0.0, 30.0, 60.0, 90.0)
LARGEST_PATCH_PX = 512
FEWEST_OBJECTS = 5  # of references
_SMALLEST_PATCH_PX = 32
_FINE = 8  # points a side of each pixel, of a shape as wide as one; more of thinner ones


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ForeignObjects:
    """Objects to look for, one entry each.

    Fields: names; size (object,) with size_name (`contrast` or `size_mm`); product_mm, object_mm (object,): path lengths in the
    product and, where the object is, in it (weighted by itself); energy, amplitude (object, bin): spectrum of its profile over
    object_mm, see `object_spectrum`; bins; area_px (object,) searched; product_material, foreign_material; displaces (the object
    takes the product's place); sampled: objects as they came, whose curve is fitted, rather than a range of sizes.
    """

    names: tuple[str, ...]
    size: FloatArray
    size_name: str
    product_mm: FloatArray
    object_mm: FloatArray
    energy: FloatArray
    amplitude: FloatArray
    bins: FrequencyBins
    area_px: FloatArray
    product_material: str
    foreign_material: str
    displaces: bool
    sampled: bool

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReferenceObjects:
    """What reference images say of their foreign objects, before any physics.

    Fields: names (image of each); contrast, size_mm (object,); ring_log (object,): mean M_high of the product around; masks; area_px
    (object,): pixels of the product; pixel_mm.
    """

    names: tuple[str, ...]
    contrast: FloatArray
    size_mm: FloatArray
    ring_log: FloatArray
    masks: tuple[NDArray[np.bool_], ...]
    area_px: FloatArray
    setting: str


def is_readable(row: DatasetRow) -> bool:
    """Whether a row has a foreign object whose contrast says how thick it is."""
    return bool(row.foreign_object) and math.isfinite(row.contrast) and row.contrast > 0


def objects_of_references(dataset: Dataset, *, pixel_mm: float) -> ReferenceObjects:
    """Masks, contrasts and surroundings of the foreign objects of a dataset, those of known contrast above 0.

    Args:
        dataset: low-noise images with masks.
        pixel_mm: pitch; the ring around an object is 3.2 mm wide.

    Raises:
        InputError: fewer than five such objects, or images of several settings or of another pitch.
    """
    from scipy.ndimage import binary_dilation, find_objects

    dataset.refuse_other_pitch(pixel_mm)
    names, contrast, size_mm, ring_log, masks, area = [], [], [], [], [], []
    settings = set()
    for number, row in enumerate(dataset.rows):
        if not is_readable(row):
            continue
        mask, (low, high) = dataset.foreign_object_masks(number), dataset.images(number)
        product = dataset.product_masks(number)
        ring = binary_dilation(mask, iterations=dilations_for_pixel(pixel_mm)) & ~mask & (low > PRODUCT_THRESHOLD)
        if not mask.any() or not ring.any():
            continue
        settings.add(row.setting)
        names.append(row.image)
        contrast.append(row.contrast)
        size_mm.append(row.size_mm)
        ring_log.append(float(high[ring].mean()))
        masks.append(mask[find_objects(mask.astype(np.int8))[0]])
        area.append(float((product if product.any() else low > PRODUCT_THRESHOLD).sum()))
    if len(names) < FEWEST_OBJECTS:
        raise InputError(
            dataset.path,
            received=f"{len(names)} foreign objects with a mask and a contrast above 0",
            expected=f"{FEWEST_OBJECTS} or more",
        )
    if len(settings) > 1:
        raise InputError(dataset.path, received=f"images of {len(settings)} settings", expected="one setting")
    return ReferenceObjects(
        names=tuple(names),
        contrast=np.array(contrast),
        size_mm=np.array(size_mm),
        ring_log=np.array(ring_log),
        masks=tuple(masks),
        area_px=np.array(area),
        setting=settings.pop(),
    )


def patch_for(extent_px: float) -> int:
    """Side of the patch for objects of this extent, px: a power of two, twice as large.

    Raises:
        InputError: an object too large for the largest patch.
    """
    cells = _SMALLEST_PATCH_PX
    while cells < 2 * extent_px:
        cells *= 2
    if cells > LARGEST_PATCH_PX:
        raise InputError(
            "foreign object",
            received=f"{extent_px:.0f} px long",
            expected=f"at most {LARGEST_PATCH_PX // 2} px",
            remedy="combine pixels (binning), or give smaller sizes",
        )
    return cells


def spectra_of_masks(masks: Sequence[NDArray[np.bool_]]) -> tuple[FloatArray, FloatArray, FrequencyBins]:
    """Energies and amplitudes (object, bin) of masks as profiles of height 1, and the bins."""
    bins = frequency_bins(patch_for(max(max(mask.shape) for mask in masks)))
    found = [object_spectrum(mask.astype(np.float64), bins) for mask in masks]
    return np.stack([one[0] for one in found]), np.stack([one[1] for one in found]), bins


# --------------------------------------------------------------------------------------------------- shapes

Chord = Callable[[FloatArray, FloatArray, float, float, float], FloatArray]


def _plate(along: FloatArray, across: FloatArray, length: float, width: float, height: float) -> FloatArray:
    return np.where((along / length) ** 2 + (across / width) ** 2 <= 0.25, height, 0.0)


def _ellipsoid(along: FloatArray, across: FloatArray, length: float, width: float, height: float) -> FloatArray:
    return height * np.sqrt(np.maximum(1.0 - 4.0 * ((along / length) ** 2 + (across / width) ** 2), 0.0))


def _rod(along: FloatArray, across: FloatArray, length: float, width: float, height: float) -> FloatArray:
    chord = height * np.sqrt(np.maximum(1.0 - 4.0 * (across / width) ** 2, 0.0))
    return np.where(np.abs(along) <= 0.5 * length, chord, 0.0)


SHAPES: MappingProxyType[str, Chord] = MappingProxyType({"ellipsoid": _ellipsoid, "rod": _rod, "plate": _plate})


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """A foreign object of any size: its length is the size.

    Fields: kind (`ellipsoid`, `rod`: a cylinder lying, `plate`: an elliptic one facing the beam); width, height (height along the
    beam), of the length; height_mm: in place of `height`, the same at every size.

    Example:
        >>> from raytwin.observers import Shape
        >>> Shape(kind="rod", width=0.25, height=0.25).kind
        'rod'
    """

    kind: str = "ellipsoid"
    width: float = 1.0
    height: float = 1.0
    height_mm: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in SHAPES:
            raise InputError("shape", received=self.kind, expected="one of " + ", ".join(SHAPES))
        for name in ("width", "height", "height_mm"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"{name} of the shape", received=value, expected="a finite value above 0")


def profile_of_shape(shape: Shape, *, length_mm: float, pixel_mm: float, turn_deg: float = 0.0) -> FloatArray:
    """Thickness (row, column) of a shape along the beam, mean over each pixel, mm.

    Args:
        shape: what it is.
        length_mm: its size.
        pixel_mm: pitch in the object's plane.
        turn_deg: of its length against the rows' direction.
    """
    height = shape.height * length_mm if shape.height_mm is None else shape.height_mm
    width = shape.width * length_mm
    half = math.ceil(0.5 * math.hypot(length_mm, width) / pixel_mm) + 1
    # the thinnest part is met by eight points or more
    points = _FINE * max(1, math.ceil(pixel_mm / min(width, length_mm)))
    fine = (np.arange(2 * half * points) + 0.5) / points - half
    row, column = np.meshgrid(fine * pixel_mm, fine * pixel_mm, indexing="ij")
    turn = math.radians(turn_deg)
    along = row * math.cos(turn) + column * math.sin(turn)
    across = column * math.cos(turn) - row * math.sin(turn)
    thickness = SHAPES[shape.kind](along, across, length_mm, width, height)
    return np.asarray(thickness.reshape(2 * half, points, 2 * half, points).mean(axis=(1, 3)))


def objects_of_shape(
    shape: Shape,
    *,
    sizes_mm: Sequence[float],
    pixel_mm: float,
    product_mm: Sequence[float],
    product_material: str,
    foreign_material: str,
    area_px: float,
    displaces: bool = False,
    turns_deg: Sequence[float] = TURNS_DEG,
) -> ForeignObjects:
    """A shape at every size, turn and thickness of the product around it.

    Args:
        shape: what is looked for.
        sizes_mm: its lengths, rising.
        pixel_mm: pitch in the object's plane.
        product_mm: thicknesses of the product where it may lie; POD is the mean over them.
        product_material, foreign_material: names of the library.
        area_px: searched in each image, pixels.
        displaces: it takes the product's place.
        turns_deg: directions that it may lie in.

    Raises:
        InputError: sizes that do not rise from above 0, or objects thicker than the product whose place they take.
    """
    sizes = np.asarray(sizes_mm, dtype=float)
    if sizes.ndim != 1 or sizes.size < 2 or not np.all(np.isfinite(sizes)) or not np.all(np.diff(sizes, prepend=0) > 0):
        raise InputError("sizes", received=list(sizes_mm), expected="two or more rising lengths above 0 mm")
    thicknesses = np.asarray(product_mm, dtype=float)
    if thicknesses.ndim != 1 or not thicknesses.size or not np.all(np.isfinite(thicknesses) & (thicknesses > 0)):
        raise InputError("product thickness", received=list(product_mm), expected="one or more above 0 mm")
    highest = shape.height * sizes[-1] if shape.height_mm is None else shape.height_mm
    if displaces and highest > thicknesses.min():
        raise InputError(
            "largest foreign object",
            received=f"{highest:g} mm thick",
            expected=f"at most the product's {thicknesses.min():g} mm, whose place it takes",
        )
    # a round object looks the same however it is turned
    turns = (0.0,) if shape.width == 1.0 and shape.kind != "rod" else tuple(turns_deg)
    largest = math.hypot(sizes[-1], shape.width * sizes[-1]) / pixel_mm
    bins = frequency_bins(patch_for(largest + 4))
    energies, amplitudes, heights = [], [], []
    for length in sizes:
        for turn in turns:
            profile = profile_of_shape(shape, length_mm=float(length), pixel_mm=pixel_mm, turn_deg=turn)
            height = float((profile**2).sum() / profile.sum())
            energy, amplitude = object_spectrum(_cut(profile / height), bins)
            energies.append(energy)
            amplitudes.append(amplitude)
            heights.append(height)
    each = len(turns)
    repeat = thicknesses.size
    return ForeignObjects(
        names=tuple(f"{size:g} mm" for size in np.repeat(sizes, each * repeat)),
        size=np.repeat(sizes, each * repeat),
        size_name="size_mm",
        product_mm=np.tile(thicknesses, sizes.size * each),
        object_mm=np.repeat(heights, repeat),
        energy=np.repeat(energies, repeat, axis=0),
        amplitude=np.repeat(amplitudes, repeat, axis=0),
        bins=bins,
        area_px=np.full(sizes.size * each * repeat, float(area_px)),
        product_material=product_material,
        foreign_material=foreign_material,
        displaces=displaces,
        sampled=False,
    )


def _cut(profile: FloatArray) -> FloatArray:
    """A profile without its empty margins."""
    rows, columns = (np.flatnonzero(profile.any(axis=axis)) for axis in (1, 0))
    return profile[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
