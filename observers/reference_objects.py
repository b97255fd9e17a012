"""What an observer looks at in reference images: their foreign objects, the image, the texture of the product."""

from dataclasses import dataclass

from ..acquisition.dataset_io import Dataset
from ..acquisition.setting import Setting, setting_from_text
from ..errors import FileFormatError, InputError
from .line_images import TEXTURED, LineImages
from .objects import ForeignObjects, objects_of_references
from .texture import ProductTexture, texture_of_references

Pair = tuple[Setting, Setting]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """What is looked at.

    Fields: objects; image (a key of `line_images.IMAGES`); texture of the product (None: there is none); warnings: of references
    whose texture cannot be read.
    """

    objects: ForeignObjects
    image: str
    texture: ProductTexture | None
    warnings: tuple[str, ...] = ()


def sight_of_references(
    line: LineImages,
    dataset: Dataset,
    *,
    product_material: str,
    foreign_material: str,
    size: str,
    detector: str,
    image: str | None = None,
    fallback: Pair | None = None,
) -> Sight:
    """What an observer looks at in a dataset of references.

    Args:
        line: the twin.
        dataset: low-noise images with masks, each with its setting.
        product_material, foreign_material: names of the library.
        size: `contrast` or `size_mm`.
        detector: who looks.
        image: None: both, where `detector` is `ideal` and the product's texture can be read; else the residual image, which the
            texture drops out of.
        fallback: setting of references that do not say theirs.

    Raises:
        InputError: references that do not say their setting, or without objects of known contrast; no texture where `image` shows it.
        FileFormatError: images that cannot be read or hold values that are not finite.
    """
    found = objects_of_references(dataset, pixel_mm=line.pixel_mm)
    low, semicolon, high = found.setting.partition(";")
    pair = (setting_from_text(low), setting_from_text(high)) if semicolon else fallback
    if pair is None:
        raise InputError(dataset.path, received="references without their settings", expected="LOW;HIGH in each row")
    if image is None and detector != "ideal":
        image = "residual"
    texture: ProductTexture | None = None
    warnings: tuple[str, ...] = ()
    if image is None or image in TEXTURED:
        try:
            texture = texture_of_references(dataset, line, pair=pair, material=product_material)
        except FileFormatError:
            raise  # a file that cannot be used, whatever the image
        except InputError as error:
            if image is not None:
                raise
            warnings = (f"the product's texture cannot be read, so the residual image is looked at: {error}",)
    objects = line.objects_from_references(
        found, pair=pair, product_material=product_material, foreign_material=foreign_material, size=size
    )
    return Sight(
        objects=objects,
        image=image or ("residual" if texture is None else "both"),
        texture=texture,
        warnings=warnings,
    )
