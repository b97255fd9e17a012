"""What product and foreign object of reference images are made of, as their file says or a user does."""

import tomllib

from ...acquisition.dataset_io import Dataset
from ...errors import FileFormatError, InputError
from ...materials import material_from_name
from ..scenes.describe import materials_named

USUAL_MATERIALS = ("chicken_breast", "rib_bone")  # of product and foreign object, where nobody says


def stated_materials(dataset: Dataset) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the materials of products and of foreign objects that a dataset file states; empty where it states none.

    They are its attributes `product_material` and `foreign_material`, else those of the description that it was generated from.

    Raises:
        FileFormatError: a description that is no TOML.
    """
    attributes = dataset.attributes
    described: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    if "description" in attributes:
        try:
            described = materials_named(str(attributes["description"]))
        except tomllib.TOMLDecodeError as error:
            raise FileFormatError(
                f"{dataset.path}, attribute description",
                received=f"text that is not TOML ({error})",
                expected="the description that the images were generated from",
            ) from None
    product, foreign = (
        (str(attributes[name]),) if attributes.get(name) else kinds
        for name, kinds in zip(("product_material", "foreign_material"), described, strict=True)
    )
    return product, foreign


def materials_of_references(
    dataset: Dataset,
    *,
    product_material: str | None,
    foreign_material: str | None,
    usual: tuple[str, str] = USUAL_MATERIALS,
    where: str = "",
) -> tuple[str, str]:
    """Names of the materials of product and foreign object: those asked for, else those that the file states, else the usual ones.

    Args:
        dataset: reference images.
        product_material, foreign_material: asked for; None: not.
        usual: of a file that states none.
        where: what comes before the argument's name in messages.

    Raises:
        InputError: one is asked for that the file does not state, or the file states several and none is asked for.
        FileFormatError: a description in the file that is no TOML.
    """
    names = ("product_material", "foreign_material")
    asked = (product_material, foreign_material)
    product, foreign = (
        _one_material(f"{where}{name}", wanted, stated, otherwise, path=dataset.path)
        for name, wanted, stated, otherwise in zip(names, asked, stated_materials(dataset), usual, strict=True)
    )
    return product, foreign


def _one_material(argument: str, wanted: str | None, stated: tuple[str, ...], usual: str, *, path: str) -> str:
    if wanted is None and len(stated) > 1:
        raise InputError(
            argument,
            received=f"none, with {path} of {' and '.join(stated)}",
            expected="one of these",
            remedy="state it",
        )
    if wanted is None:
        return stated[0] if stated else usual
    if stated and material_from_name(wanted) not in [material_from_name(one) for one in stated]:
        raise InputError(
            argument,
            received=wanted,
            expected=f"{' or '.join(stated)}, which {path} states",
            remedy="leave it out, or give images of the other material",
        )
    return wanted
