"""Descriptions of products and foreign objects (TOML), and scenes drawn from them.

    [[product]]
    name = "fillet"
    shape = "fillet"                # one of the kinds of generator.scenes.kinds, or "map"
    material = "chicken_breast"
    length_mm = [60, 90]            # a number, or the range from which it is drawn evenly
    width_mm = [40, 60]
    height_mm = [12, 28]
    turn_deg = [-10, 10]            # about the beam's axis
    weight = 1                      # how often, against the other products

    [[foreign_object]]
    name = "rib"
    shape = "rod"
    material = "rib_bone"           # a void is an object of "air"
    length_mm = [2, 11]
    diameter_mm = [1, 3]
    bend_mm = [15, 60]
    where = "inside"                # wholly in the product, whose place it takes; "on": lies on it
    orientation = "any"             # any turn in space; "lying": about the beam's axis only

    [images]
    with_foreign_object = 0.65      # share of the images
    objects = 1                     # in each of them; a number or a range
    products = 14                   # individuals, shown again and again in other poses; 0: a new one for every image
    distance_from_edge_mm = 1       # of a foreign object from the product's outline
    distance_between_mm = 1
    shift_mm = 4                    # how far a product may lie from the middle; a tenth of the field where it is not given
    validation = 0.15               # share of the products in the splits
    test = 0.15

    [line]                          # where the twin's instrument does not say, or for another geometry
    pixel_mm = 0.15
    source_object_mm = 990
    source_detector_mm = 1059
    focal_spot_mm = 0.4

A thickness map of your own is a product or a foreign object with shape = "map", file = "fillet.npz" (or several, files = [...]):
.npz with one array a material, .h5 with thickness_mm/<material>, or a TIFF of one material; mm, at `pixel_mm` in the
object's plane.

A mesh of your own has shape = "mesh", file = "part.stl" (or .obj, .ply, .3mf; or files) and, where its unit is not mm,
scale_mm = mm a unit (a number or a range).
"""

import math
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileFormatError, InputError
from ...files import read_utf8, sha256_of_file
from ...materials import material_from_name
from .kinds import KINDS
from .mesh import Mesh, read_mesh
from .shapes import (
    Fillet,
    Heights,
    Rays,
    Shape,
    layer_lengths_mm,
    levels_mm,
    path_lengths_mm,
    rotation_about_z,
    sample_rotation,
)

Array = NDArray[np.float64]
Range = tuple[float, float]

WHERE = ("inside", "on")
ORIENTATIONS = ("any", "lying")
_COMMON_WORDS = (
    "name",
    "shape",
    "material",
    "weight",
    "turn_deg",
    "where",
    "orientation",
    "whole",
    "file",
    "files",
    "pixel_mm",
    "scale_mm",
)
_IMAGE_WORDS = {
    "with_foreign_object": (0.5, 0.5),
    "objects": (1.0, 1.0),
    "products": (0.0, 0.0),
    "distance_from_edge_mm": (1.0, 1.0),
    "distance_between_mm": (1.0, 1.0),
    "shift_mm": (math.inf, math.inf),
    "validation": (0.15, 0.15),
    "test": (0.15, 0.15),
}
_LINE_WORDS = ("pixel_mm", "source_object_mm", "source_detector_mm", "focal_spot_mm")
_TRIES = 300
_POSES = 60
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectKind:
    """One [[product]] or [[foreign_object]] of a description.

    Fields: name; shape (key of KINDS, `map` or `mesh`); material; weight; ranges: parameter -> (low, high); turn_deg; where;
    orientation; whole: refused where it reaches the border of the field; files and pixel_mm of a map.
    """

    name: str
    shape: str
    material: str
    weight: float
    ranges: Mapping[str, Range]
    turn_deg: Range
    where: str
    orientation: str
    whole: bool
    files: tuple[Path, ...]
    pixel_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Description:
    """What a user wrote: products, foreign objects, how many of them in an image, and the line where it is not the twin's."""

    products: tuple[ObjectKind, ...]
    foreign_objects: tuple[ObjectKind, ...]
    images: Mapping[str, Range]
    line: Mapping[str, float]
    path: str
    text: str = field(repr=False)
    sha256: str

    @property
    def materials(self) -> tuple[str, ...]:
        """Materials that are named; maps may hold more."""
        return tuple(dict.fromkeys(one.material for one in (*self.products, *self.foreign_objects) if one.material))


def read_description(path: str | os.PathLike[str]) -> Description:
    """Read a description and check every word of it.

    Raises:
        FileFormatError: no such file, or no TOML.
        InputError: an unknown word, kind or material, a size that is missing or 0.
    """
    file = Path(path)
    try:
        text = read_utf8(file)
        tables = tomllib.loads(text)
    except FileNotFoundError:
        raise FileFormatError(
            str(path), received="no such file", expected="a description (TOML)", remedy="check the path"
        ) from None
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise FileFormatError(
            str(path), received=f"text that is not TOML ({error})", expected="a description"
        ) from None
    _check_words(tables, ("product", "foreign_object", "images", "line"), where=file.name)
    products = _kinds(tables, "product", file)
    if not products:
        raise InputError(
            file.name,
            received="no [[product]]",
            expected="at least one product with shape, material and sizes",
            remedy='for example [[product]] shape = "fillet" material = "chicken_breast" length_mm = 70 ...',
        )
    images = dict(_IMAGE_WORDS)
    given = _table(tables, "images", file.name)
    _check_words(given, _IMAGE_WORDS, where=f"{file.name}, [images]")
    images |= {word: _range(value, f"{file.name}, [images], {word}", lowest=0.0) for word, value in given.items()}
    for word in ("with_foreign_object", "validation", "test"):
        if images[word][1] > 1:
            raise InputError(f"{file.name}, [images], {word}", received=images[word][1], expected="a share from 0 to 1")
    if images["validation"][1] + images["test"][1] > 1:
        raise InputError(
            f"{file.name}, [images]", received="validation and test above 1", expected="together at most 1"
        )
    line = _table(tables, "line", file.name)
    _check_words(line, _LINE_WORDS, where=f"{file.name}, [line]")
    numbers = {word: _range(value, f"{file.name}, [line], {word}", lowest=1e-6)[0] for word, value in line.items()}
    foreign = _kinds(tables, "foreign_object", file)
    if images["with_foreign_object"][1] > 0 and not foreign:
        if "with_foreign_object" in given:
            raise InputError(
                file.name, received="no [[foreign_object]]", expected="one, or with_foreign_object = 0 under [images]"
            )
        images["with_foreign_object"] = (0.0, 0.0)
    return Description(
        products=products,
        foreign_objects=foreign,
        images=images,
        line=numbers,
        path=str(path),
        text=text,
        sha256=sha256_of_file(file),
    )


def materials_named(text: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the materials of products and of foreign objects in a description's text, each once; maps may hold more.

    Raises:
        tomllib.TOMLDecodeError: no TOML.
    """
    tables = tomllib.loads(text)
    products, foreign = (
        tuple(dict.fromkeys(str(one["material"]) for one in tables.get(name, ()) if one.get("material")))
        for name in ("product", "foreign_object")
    )
    return products, foreign


def _check_words(table: Mapping[str, Any], known: Sequence[str] | Mapping[str, Any], *, where: str) -> None:
    for word in table:
        if word not in known:
            import difflib

            near = difflib.get_close_matches(word, list(known), n=2)
            raise InputError(
                where,
                received=f"the word {word!r}",
                expected="one of " + ", ".join(known),
                remedy=f"did you mean {' or '.join(near)}?" if near else "",
            )


def _table(tables: Mapping[str, Any], name: str, where: str) -> dict[str, Any]:
    table = tables.get(name, {})
    if not isinstance(table, dict):
        raise InputError(where, received=f"several [[{name}]]", expected=f"one table [{name}]")
    return table


def _range(value: object, where: str, *, lowest: float) -> Range:
    ends = [
        float(one)
        for one in (value if isinstance(value, list) else [value, value])
        if isinstance(one, int | float) and not isinstance(one, bool)
    ]
    if len(ends) != 2 or (isinstance(value, list) and len(value) != 2):
        raise InputError(where, received=repr(value), expected="a number, or [low, high]")
    low, high = ends
    if not (math.isfinite(low) and math.isfinite(high) and lowest <= low <= high):
        raise InputError(
            where, received=repr(value), expected=f"finite numbers of {lowest:g} or more, the smaller first"
        )
    return low, high


def _kinds(tables: Mapping[str, Any], name: str, file: Path) -> tuple[ObjectKind, ...]:
    found = tables.get(name, [])
    if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
        raise InputError(f"{file.name}, {name}", received="one table", expected=f"tables written [[{name}]]")
    return tuple(_kind(table, f"{name} {number + 1}", file) for number, table in enumerate(found))


def _kind(table: Mapping[str, Any], title: str, file: Path) -> ObjectKind:
    where = f"{file.name}, {title}"
    is_product = title.startswith("product")
    shape = table.get("shape")
    known = {**KINDS, "map": None, "mesh": None}
    if not isinstance(shape, str) or shape not in known:
        _check_words({str(shape): None}, known, where=f"{where}, shape")
    is_map = shape == "map"
    is_mesh = shape == "mesh"
    parameters = {} if is_map or is_mesh else KINDS[str(shape)].parameters
    # words of files are only for shapes that come from one
    foreign_words = {"map": ("scale_mm",), "mesh": ("pixel_mm",)}.get(
        str(shape), ("file", "files", "pixel_mm", "scale_mm")
    )
    words = [word for word in (*_COMMON_WORDS, *parameters) if word not in foreign_words]
    _check_words(table, words, where=f"{where} ({shape})")
    ranges: dict[str, Range] = {}
    for word, default in parameters.items():
        if word in table:
            # sizes are above 0, other numbers may be 0 or negative
            lowest = 1e-3 if word in ("length_mm", "width_mm", "height_mm", "diameter_mm") else -1e6
            ranges[word] = _range(table[word], f"{where}, {word}", lowest=lowest)
        elif default is None:
            raise InputError(where, received=f"no {word}", expected=f"{word} = a number or [low, high]")
        else:
            ranges[word] = default
    texts = {}
    for word, default_text in (
        ("name", str(shape)),
        ("material", ""),
        ("where", "inside"),
        ("orientation", "lying" if is_product else "any"),
    ):
        texts[word] = table.get(word, default_text)
        if not isinstance(texts[word], str):
            raise InputError(f"{where}, {word}", received=repr(texts[word]), expected="a text in quotes")
    for word, choices in (("where", WHERE), ("orientation", ORIENTATIONS)):
        if texts[word] not in choices:
            raise InputError(f"{where}, {word}", received=repr(texts[word]), expected="one of " + ", ".join(choices))
    files = _files(table, file, where, needs_pixel=is_map) if is_map or is_mesh else ()
    if is_mesh:
        ranges["scale_mm"] = _range(table.get("scale_mm", 1.0), f"{where}, scale_mm", lowest=1e-9)
    if texts["material"]:
        material_from_name(texts["material"])
    elif not (is_map and all(path.suffix.lower() in (".npz", ".h5", ".hdf5") for path in files)):
        raise InputError(where, received="no material", expected="material = a name of the library")
    whole = table.get("whole", not is_map)
    if not isinstance(whole, bool):
        raise InputError(f"{where}, whole", received=repr(whole), expected="true or false")
    default_turn: Range = (0.0, 0.0) if is_map and is_product else (0.0, 360.0)
    return ObjectKind(
        name=texts["name"],
        shape=str(shape),
        material=texts["material"],
        weight=_range(table.get("weight", 1.0), f"{where}, weight", lowest=1e-9)[0],
        ranges=ranges,
        turn_deg=_range(table["turn_deg"], f"{where}, turn_deg", lowest=-360.0)
        if "turn_deg" in table
        else default_turn,
        where=texts["where"],
        orientation=texts["orientation"],
        whole=whole,
        files=files,
        pixel_mm=_range(table["pixel_mm"], f"{where}, pixel_mm", lowest=1e-4)[0] if "pixel_mm" in table else math.nan,
    )


def _files(table: Mapping[str, Any], file: Path, where: str, *, needs_pixel: bool) -> tuple[Path, ...]:
    given = table.get("files", [table["file"]] if "file" in table else [])
    if not isinstance(given, list) or not given or not all(isinstance(one, str) for one in given):
        raise InputError(where, received="no file", expected='file = "...", or files = ["...", "..."]')
    if needs_pixel and "pixel_mm" not in table:
        raise InputError(where, received="no pixel_mm", expected="pixel_mm = pitch of the map in the object's plane")
    return tuple(file.parent / one for one in given)


def read_thickness_map(path: Path, *, material: str) -> dict[str, Array]:
    """Thickness maps (row, column) in mm by material: .npz (an array a material), .h5 (thickness_mm/<material>), or TIFF.

    Raises:
        FileFormatError: a file that cannot be read, holds no map, or maps of different shapes.
    """
    ending = path.suffix.lower()
    maps: dict[str, Array] = {}
    try:
        if ending == ".npz":
            with np.load(path, allow_pickle=False) as stored:
                maps = {name: np.asarray(stored[name], dtype=np.float64) for name in stored.files}
        elif ending in (".h5", ".hdf5"):
            import h5py

            with h5py.File(path, "r") as stored:
                group = stored.get("thickness_mm")
                if isinstance(group, h5py.Group):
                    maps = {name: np.asarray(group[name][()], dtype=np.float64) for name in group}
        else:
            import tifffile

            maps = {material: np.asarray(tifffile.imread(path), dtype=np.float64)}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(
            str(path), received=f"a file that cannot be read ({error})", expected="a thickness map"
        ) from None
    if len(maps) == 1 and material:
        maps = {material: next(iter(maps.values()))}
    if not maps or len({one.shape for one in maps.values()}) != 1:
        raise FileFormatError(
            str(path),
            received=f"maps {', '.join(maps) or 'none'} of different shapes or none",
            expected="maps of one shape",
        )
    for name in maps:
        material_from_name(name)
    return maps


@dataclass(frozen=True, slots=True, kw_only=True)
class Individual:
    """One object as it was drawn: kind, name, size_mm (its longest side), body (a shape in space) or layers by material."""

    kind: ObjectKind
    name: str
    size_mm: float
    body: Shape | Mesh | None
    layers: Mapping[str, Heights | Fillet]


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """An individual in its pose: rotation (3, 3) of a body; angle (radians), mirrored; place_mm (x, y)."""

    individual: Individual
    rotation: Array
    angle: float
    mirrored: bool
    place_mm: tuple[float, float]

    @property
    def radius_mm(self) -> float:
        """Of a ball, or of a circle across the beam, about the place that holds the object."""
        one = self.individual
        return one.body.radius_mm if one.body is not None else max(layer.radius_mm for layer in one.layers.values())

    def height_mm(self, thickness_mm: Array) -> float:
        """Extent along the beam: of a body from its top to its bottom, of layers the largest of their thickness (row, column)."""
        body = self.individual.body
        if body is None:
            return float(thickness_mm.max())
        return body.reach_mm(self.rotation[2]) + body.reach_mm(-self.rotation[2])

    def levels_mm(self, rays: Rays) -> tuple[Array, Array]:
        """z (row, column) in mm where rays first enter and last leave; layers lie evenly about their plane."""
        body = self.individual.body
        if body is None:
            half = 0.5 * np.sum(list(self.lengths_mm(rays).values()), axis=0) / rays.secant()
            return -half, half
        place = np.array([*self.place_mm, 0.0])
        if isinstance(body, Mesh):
            return body.levels_mm(rays, rotation=self.rotation, place_mm=place)
        return levels_mm(body, rays, rotation=self.rotation, place_mm=place)

    def lengths_mm(self, rays: Rays) -> dict[str, Array]:
        """Path lengths (row, column) by material, mm."""
        one = self.individual
        if one.body is not None:
            place = np.array([*self.place_mm, 0.0])
            if isinstance(one.body, Mesh):
                return {one.kind.material: one.body.lengths_mm(rays, rotation=self.rotation, place_mm=place)}
            return {one.kind.material: path_lengths_mm(one.body, rays, rotation=self.rotation, place_mm=place)}
        return {
            material: layer_lengths_mm(layer, rays, angle=self.angle, mirrored=self.mirrored, place_mm=self.place_mm)
            for material, layer in one.layers.items()
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A product with the foreign objects in or on it."""

    product: Placed
    foreign_objects: tuple[Placed, ...]

    def lengths_mm(self, rays: Rays) -> tuple[dict[str, Array], Array]:
        """Path lengths (row, column) by material, and in all foreign objects, mm.

        What lies inside takes the product's place.
        """
        total = self.product.lengths_mm(rays)
        own = tuple(total)
        foreign = np.zeros(rays.shape)
        for placed in self.foreign_objects:
            lengths = placed.lengths_mm(rays)
            taken = np.sum(list(lengths.values()), axis=0)
            foreign += taken
            if placed.individual.kind.where == "inside":
                there = np.sum([total[name] for name in own], axis=0)
                left = np.where(there > 0, np.maximum(1.0 - taken / np.where(there > 0, there, 1.0), 0.0), 1.0)
                for name in own:
                    total[name] = total[name] * left
            for name, length in lengths.items():
                total[name] = total[name] + length if name in total else length
        return total, foreign


def sample_individual(kind: ObjectKind, *, name: str, rng: np.random.Generator) -> Individual:
    """One object of a kind, its sizes drawn from the kind's ranges."""
    if kind.shape == "map":
        path = kind.files[int(rng.integers(len(kind.files)))]
        layers = {
            material: Heights(grid_mm=grid, pitch_mm=kind.pixel_mm)
            for material, grid in read_thickness_map(path, material=kind.material).items()
        }
        covered = np.argwhere(np.sum([layer.grid_mm for layer in layers.values()], axis=0) > 0)
        size_mm = float(np.ptp(covered, axis=0).max() + 1) * kind.pixel_mm if len(covered) else 0.0
        return Individual(kind=kind, name=f"{name}:{path.stem}", size_mm=size_mm, body=None, layers=layers)
    values = {word: float(rng.uniform(*ends)) for word, ends in kind.ranges.items()}
    if kind.shape == "mesh":
        path = kind.files[int(rng.integers(len(kind.files)))]
        mesh = read_mesh(path, scale=values["scale_mm"])
        return Individual(kind=kind, name=f"{name}:{path.stem}", size_mm=mesh.longest_mm, body=mesh, layers={})
    made = KINDS[kind.shape].make(values, rng)
    size_mm = max(values[word] for word in ("length_mm", "width_mm", "height_mm", "diameter_mm") if word in values)
    if isinstance(made, Fillet):
        return Individual(kind=kind, name=name, size_mm=size_mm, body=None, layers={kind.material: made})
    return Individual(kind=kind, name=name, size_mm=size_mm, body=made, layers={})


def choose_kind(kinds: Sequence[ObjectKind], rng: np.random.Generator) -> ObjectKind:
    """One of the kinds, as often as their weights say."""
    weights = np.array([one.weight for one in kinds])
    return kinds[int(rng.choice(len(kinds), p=weights / weights.sum()))]


def _pose(individual: Individual, place_mm: tuple[float, float], rng: np.random.Generator) -> Placed:
    angle = math.radians(rng.uniform(*individual.kind.turn_deg))
    turn = sample_rotation(rng) if individual.kind.orientation == "any" else rotation_about_z(angle)
    mirrored = bool(rng.random() < 0.5) and individual.kind.shape != "map"
    return Placed(individual=individual, rotation=turn, angle=angle, mirrored=mirrored, place_mm=place_mm)


def place_product(
    individual: Individual, *, rays: Rays, shift_mm: float, rng: np.random.Generator
) -> tuple[Placed, Array]:
    """A product in a random pose, whole inside the field where its kind asks for that, and its path length (row, column).

    Raises:
        InputError: it does not fit.
    """
    field_mm = (float(np.ptp(rays.y_mm)), float(np.ptp(rays.x_mm)))
    reach = [shift_mm if math.isfinite(shift_mm) else 0.1 * size for size in field_mm]
    if individual.kind.shape == "map" and not math.isfinite(shift_mm):
        reach = [0.0, 0.0]
    for attempt in range(_POSES):
        # ever nearer to the middle, where a large product still fits
        share = 1.0 - attempt / _POSES
        y, x = (share * rng.uniform(-1.0, 1.0) * one for one in reach)
        placed = _pose(individual, (float(x), float(y)), rng)
        lengths = np.sum(list(placed.lengths_mm(rays).values()), axis=0)
        if not lengths.any():
            continue
        rim = np.concatenate([lengths[0], lengths[-1], lengths[:, 0], lengths[:, -1]])
        if not individual.kind.whole or not rim.any():
            return placed, np.asarray(lengths)
    raise InputError(
        f"product {individual.name}",
        received=f"a product of {individual.size_mm:.3g} mm",
        expected=f"one that fits into the field of {field_mm[0]:.3g} x {field_mm[1]:.3g} mm (rows x columns)",
        remedy="make it smaller, limit turn_deg, or set whole = false",
    )


def place_foreign_object(
    individual: Individual,
    *,
    product_mm: Array,
    levels_mm: tuple[Array, Array],
    taken: NDArray[np.bool_],
    rays: Rays,
    images: Mapping[str, Range],
    rng: np.random.Generator,
) -> tuple[Placed, NDArray[np.bool_]]:
    """A foreign object at a random place in the product, and its footprint (row, column).

    product_mm: path lengths through the product; levels_mm: where rays enter and leave it.
    Refused and tried again: a place nearer to the product's outline than `distance_from_edge_mm`, nearer to another object
    than `distance_between_mm`, beyond the field, or, for one inside, where no layer of the product across the beam, as thick as the
    whole object is high, covers it.

    Raises:
        InputError: no place was found.
    """
    from scipy.ndimage import distance_transform_edt

    pitch = (float(rays.y_mm[1, 0] - rays.y_mm[0, 0]), float(rays.x_mm[0, 1] - rays.x_mm[0, 0]))
    from_edge = distance_transform_edt(np.pad(product_mm > 0, 1), sampling=pitch)[1:-1, 1:-1]
    from_others = distance_transform_edt(~taken, sampling=pitch) if taken.any() else np.full(taken.shape, math.inf)
    needed, apart = images["distance_from_edge_mm"][0], images["distance_between_mm"][0]
    secant, inside = rays.secant(), individual.kind.where == "inside"
    thickness = product_mm / secant
    room = np.argwhere((from_edge > needed) & (from_others > apart))
    for _ in range(_TRIES if len(room) else 0):
        row, column = room[int(rng.integers(len(room)))]
        jitter = rng.uniform(-0.5, 0.5, 2)
        place = (float(rays.x_mm[0, column] + jitter[1] * pitch[1]), float(rays.y_mm[row, 0] + jitter[0] * pitch[0]))
        placed = _pose(individual, place, rng)
        lengths = np.sum(list(placed.lengths_mm(rays).values()), axis=0)
        footprint = lengths > 0
        footprint[row, column] = True
        rim = footprint[0].any() or footprint[-1].any() or footprint[:, 0].any() or footprint[:, -1].any()
        if rim or from_edge[footprint].min() <= needed or from_others[footprint].min() <= apart:
            continue
        layer = min(levels_mm[1][footprint].min() - levels_mm[0][footprint].max(), thickness[footprint].min())
        if inside and placed.height_mm(lengths / secant) > layer * (1.0 + _ROUNDING):
            continue
        return placed, footprint
    deep = f" (at most {thickness.max():.3g} mm thick)" if inside else ""
    remedy = "make it smaller, ask for fewer objects, or lower the distances under [images]"
    raise InputError(
        f"foreign object {individual.name}",
        received=f"an object of {individual.size_mm:.3g} mm",
        expected=f"one with room in the product{deep}, {needed:g} mm from its edge and {apart:g} mm from other objects",
        remedy=f'{remedy}; or state orientation = "lying" or where = "on"' if inside else remedy,
    )


def sample_scene(description: Description, product: Individual, *, rays: Rays, rng: np.random.Generator) -> Scene:
    """A product in a pose, with or without foreign objects, as the description says.

    Args:
        description: how many objects, and how far apart.
        product: who lies in the beam.
        rays: one a pixel.
        rng: source of randomness.
    """
    images = description.images
    placed, lengths = place_product(product, rays=rays, shift_mm=images["shift_mm"][1], rng=rng)
    objects: list[Placed] = []
    if rng.random() < images["with_foreign_object"][0]:
        count = int(rng.integers(round(images["objects"][0]), round(images["objects"][1]) + 1))
        taken, levels = np.zeros(rays.shape, dtype=bool), placed.levels_mm(rays)
        for _ in range(count):
            kind = choose_kind(description.foreign_objects, rng)
            one = sample_individual(kind, name=kind.name, rng=rng)
            found, footprint = place_foreign_object(
                one, product_mm=lengths, levels_mm=levels, taken=taken, rays=rays, images=images, rng=rng
            )
            objects.append(found)
            taken |= footprint
    return Scene(product=placed, foreign_objects=tuple(objects))
