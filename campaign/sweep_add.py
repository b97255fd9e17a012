"""A pair of settings added to a campaign file: a new file, or one more [[setting]] at the end of one that is there."""

import json
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from ..acquisition.setting import Filter, Setting
from ..errors import InputError
from ..files import read_utf8, whole_file
from .sweep_file import read_campaign, text_of_pair

# networks learn first from images so much less noisy than those of the settings that are compared
_START_AVERAGED = 50
_PRODUCT_SHARE = (0.45, 0.6)  # of the field's shorter side that a product covers
_OBJECT_SHARE = (0.5, 1.5)  # of the object that was asked for


@dataclass(frozen=True, slots=True, kw_only=True)
class AddedSetting:
    """What was done: the campaign file, its settings by now, whether the pair is new in it, a description that was written, and
    product and foreign object of the campaign's `[contrast]` where their materials are others (None: they are the same)."""

    path: Path
    settings: int
    new: bool
    description: Path | None
    other_materials: tuple[str, str] | None = None


def add_setting(
    path: str | os.PathLike[str],
    *,
    twin: str | os.PathLike[str],
    low: Setting,
    high: Setting,
    product: Filter,
    foreign_object: Filter,
    object_pixels: int,
    displaces: bool = False,
    object_mm: float,
    field_mm: float,
    references: str | os.PathLike[str] | None = None,
) -> AddedSetting:
    """Add a pair of settings to a campaign file, which is made where it is not there.

    A new file names the twin, the references and the slabs of `[contrast]`. Without references a description is written beside
    it: blocks of the product that hold lying discs of the foreign object. A file that is there keeps its text,
    with the products and objects that it is of.

    Args:
        path: the campaign file (.toml).
        twin: its file, or the name of a shipped calibration.
        low, high: the settings.
        product, foreign_object, object_pixels, displaces: slabs for the contrast-to-noise ratio.
        object_mm: diameter of the object, for a description.
        field_mm: shorter side of the field of view in the object's plane, for a description.
        references: a dataset or a description of the user's.

    Raises:
        InputError: the file is no campaign, or would be none with this pair; nothing is written then.
    """
    file = Path(path)
    if file.suffix.lower() != ".toml":
        raise InputError(str(path), received=file.name, expected="the name of a campaign file, ending in .toml")
    pair = (low, high)
    if file.exists():
        campaign = read_campaign(file)
        new = text_of_pair(pair) not in map(text_of_pair, campaign.settings)
        if new:
            _write(file, read_utf8(file).rstrip("\n") + "\n\n" + _setting_text(pair))
        slabs = campaign.slabs
        theirs = None if slabs is None else (slabs.product.material, slabs.foreign_object.material)
        return AddedSetting(
            path=file,
            settings=len(campaign.settings) + new,
            new=new,
            description=None,
            other_materials=None if theirs == (product.material, foreign_object.material) else theirs,
        )
    description = None
    if references is None:
        description = file.with_name(f"{file.stem}_scene.toml")
        if not description.exists():
            with whole_file(description) as temporary:
                temporary.write_text(_description_text(product, foreign_object, object_mm, field_mm), encoding="utf-8")
    named = description.name if description is not None else str(Path(references or "").resolve())
    twin_file = Path(twin)
    lines = [
        f"twin = {json.dumps(str(twin_file.resolve()) if twin_file.exists() else str(twin))}",
        f"references = {json.dumps(named)}",
        "seed = 1",
        "",
        "[contrast]",
        f"product = {json.dumps(str(product))}",
        f"object = {json.dumps(str(foreign_object))}",
        f"object_pixels = {object_pixels}",
        f"displaces = {str(displaces).lower()}",
        "",
    ]
    if named.lower().endswith(".toml"):
        start = [replace(one, averaged=_START_AVERAGED * one.averaged) for one in pair]
        lines += ["[pod]", 'size = "size_mm"', "", "[training]"]
        lines += [f"start_{side} = {json.dumps(str(one))}" for side, one in zip(("low", "high"), start, strict=True)]
        lines.append("")
    try:
        _write(file, "\n".join(lines) + "\n" + _setting_text(pair))
    except InputError:
        if description is not None:
            description.unlink(missing_ok=True)
        raise
    return AddedSetting(path=file, settings=1, new=True, description=description)


def _setting_text(pair: tuple[Setting, Setting]) -> str:
    return f"[[setting]]\nlow = {json.dumps(str(pair[0]))}\nhigh = {json.dumps(str(pair[1]))}\n"


def _write(file: Path, text: str) -> None:
    """Write the file where its new text is a campaign; paths in it are relative to its folder, so it is tried there."""
    handle, name = tempfile.mkstemp(prefix=f".{file.stem}.", suffix=".toml", dir=file.parent)
    os.close(handle)
    trial = Path(name)
    try:
        trial.write_text(text, encoding="utf-8")
        try:
            read_campaign(trial)
        except InputError as error:
            raise InputError(
                error.argument.replace(trial.name, file.name),
                received=error.received,
                expected=error.expected,
                remedy=error.remedy,
            ) from None
    finally:
        trial.unlink(missing_ok=True)
    with whole_file(file) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _description_text(product: Filter, foreign_object: Filter, object_mm: float, field_mm: float) -> str:
    sides = [round(share * field_mm, 1) for share in _PRODUCT_SHARE]
    # a disc is as long along its axis as the slab is thick
    across = [round(share * object_mm, 2) for share in _OBJECT_SHARE]
    thick_mm = product.thickness_mm
    return (
        "# products and foreign objects as they were looked at; make them like yours (docs/descriptions.md)\n"
        f'[[product]]\nname = "product"\nshape = "box"\nmaterial = {json.dumps(product.material)}\n'
        f"length_mm = {sides}\nwidth_mm = {sides}\n"
        f"height_mm = [{0.9 * thick_mm:.4g}, {1.1 * thick_mm:.4g}]\n\n"
        f'[[foreign_object]]\nname = "object"\nshape = "ellipsoid"\nmaterial = {json.dumps(foreign_object.material)}\n'
        f"length_mm = {across}\nwidth_mm = {across}\nheight_mm = {foreign_object.thickness_mm:.4g}\n"
        'orientation = "lying"\n\n'
        "[images]\nwith_foreign_object = 0.65\n"
    )
