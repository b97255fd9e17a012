"""What an observer looks for in reference images: their foreign objects, and the texture of the product where its image shows it."""

from typing import TYPE_CHECKING

from ..acquisition.dataset_io import Dataset
from ..acquisition.setting import Setting, setting_from_text
from ..errors import InputError
from .line_images import LineImages
from .objects import ForeignObjects, objects_of_references

if TYPE_CHECKING:
    from .texture import ProductTexture

Pair = tuple[Setting, Setting]


def objects_and_texture(
    line: LineImages,
    dataset: Dataset,
    *,
    product_material: str,
    foreign_material: str,
    size: str,
    with_texture: bool,
    fallback: Pair | None = None,
) -> "tuple[ForeignObjects, ProductTexture | None]":
    """Objects of a dataset of references, and the product's texture where it is asked for.

    Args:
        line: the twin.
        dataset: low-noise images with masks, each with its setting.
        product_material, foreign_material: names of the library.
        size: `contrast` or `size_mm`.
        with_texture: of an observer whose image the product's texture is noise in.
        fallback: setting of references that do not say theirs.

    Raises:
        InputError: references that do not say their setting, or without objects of known contrast.
    """
    found = objects_of_references(dataset, pixel_mm=line.pixel_mm)
    low, semicolon, high = found.setting.partition(";")
    pair = (setting_from_text(low), setting_from_text(high)) if semicolon else fallback
    if pair is None:
        raise InputError(dataset.path, received="references without their settings", expected="LOW;HIGH in each row")
    texture = None
    if with_texture:
        from .texture import texture_of_references

        texture = texture_of_references(dataset, line, pair=pair, material=product_material)
    objects = line.objects_from_references(
        found, pair=pair, product_material=product_material, foreign_material=foreign_material, size=size
    )
    return objects, texture
