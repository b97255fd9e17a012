"""JSON Schemas of the TOML files that people write, from the words and choices of the readers themselves.

    python docs/_ext/schemas.py      writes docs/schemas/*.schema.json

Editors that know TOML (Even Better TOML, Taplo) complete and check words with them: `#:schema PATH` in the first line.
"""

import json
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "schemas"
Schema = dict[str, Any]
TEXT: Schema = {"type": "string"}
NUMBER: Schema = {"type": "number"}
WHOLE: Schema = {"type": "integer"}
FLAG: Schema = {"type": "boolean"}
SHARE: Schema = {"type": "number", "minimum": 0, "maximum": 1}
# a number, or the range from which it is drawn
RANGE: Schema = {"anyOf": [NUMBER, {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2}]}
TEXTS: Schema = {"anyOf": [TEXT, {"type": "array", "items": TEXT, "minItems": 1}]}


def choice(values: Any) -> Schema:
    """One of some words."""
    return {"enum": list(values)}


def several(item: Schema) -> Schema:
    """One value, or a list of such."""
    return {"anyOf": [item, {"type": "array", "items": item, "minItems": 1}]}


def table(words: dict[str, Schema], *, required: tuple[str, ...] = ()) -> Schema:
    """A table with these words and no others."""
    found: Schema = {"type": "object", "properties": words, "additionalProperties": False}
    return found | ({"required": list(required)} if required else {})


def tables(item: Schema) -> Schema:
    """Tables written [[name]]."""
    return {"type": "array", "items": item}


def titled(title: str, schema: Schema) -> Schema:
    """A schema as a file begins."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **schema}


def sidecar() -> Schema:
    """`raytwin.toml` beside a folder of images."""
    from raytwin.acquisition._acquisition_words import KINDS, ROLES, SCENE_KINDS
    from raytwin.acquisition.images import _NUMBERS, _SCENE_WORDS, _SERIES_WORDS, _WHOLE
    from raytwin.acquisition.instrument import BOOLEAN_FIELDS, LAYER_FIELDS, TEXT_FIELDS, WHOLE_FIELDS, Instrument
    from raytwin.acquisition.reference import _PAIR_WORDS

    def of_instrument(name: str) -> Schema:
        if name in LAYER_FIELDS + TEXT_FIELDS:
            return TEXT
        return FLAG if name in BOOLEAN_FIELDS else WHOLE if name in WHOLE_FIELDS else NUMBER

    series = {word: NUMBER if word in _NUMBERS else WHOLE if word in _WHOLE else TEXT for word in _SERIES_WORDS}
    series |= {"kind": choice(KINDS), "role": choice(ROLES), "files": TEXTS}
    scene = {word: NUMBER if word == "size_mm" else TEXT for word in _SCENE_WORDS}
    scene |= {"kind": choice(SCENE_KINDS), "thickness_mm": {"type": "object", "additionalProperties": TEXT}}
    pairs = dict.fromkeys(_PAIR_WORDS, TEXT)
    pairs |= {"values": choice(("log", "transmission")), "without_mask": choice(("skip", "clean"))}
    raw = {
        "rows": WHOLE,
        "columns": WHOLE,
        "dtype": TEXT,
        "byte_order": choice(("little", "big")),
        "header_bytes": WHOLE,
    }
    words = {
        "instrument": table({field.name: of_instrument(field.name) for field in fields(Instrument)}),
        "raw": table(raw, required=("rows", "columns")),
        "series": tables(table(series, required=("kind", "files"))),
        "scene": tables(table(scene)),
        "pairs": table(pairs),
    }
    return titled("raytwin sidecar of a folder of images", table(words))


def description() -> Schema:
    """Products and foreign objects as shapes."""
    from raytwin.generator.scenes.describe import _COMMON_WORDS, _IMAGE_WORDS, _LINE_WORDS, ORIENTATIONS, WHERE
    from raytwin.generator.scenes.kinds import KINDS

    parameters = sorted({word for kind in KINDS.values() for word in kind.parameters})
    item = dict.fromkeys((*_COMMON_WORDS, *parameters), RANGE)
    item |= dict.fromkeys(("name", "material", "file"), TEXT)
    item |= {"shape": choice([*KINDS, "map", "mesh"]), "where": choice(WHERE), "orientation": choice(ORIENTATIONS)}
    item |= {"files": {"type": "array", "items": TEXT}, "whole": FLAG, "weight": NUMBER}
    one = table(item, required=("shape",))
    words = {
        "product": tables(one),
        "foreign_object": tables(one),
        "images": table(dict.fromkeys(_IMAGE_WORDS, RANGE)),
        "line": table(dict.fromkeys(_LINE_WORDS, NUMBER)),
    }
    return titled("raytwin description of products", table(words, required=("product",)))


def of_fields(kind: Any, choices: dict[str, Schema]) -> dict[str, Schema]:
    """Words of a settings dataclass: the type of a default, a number where it is None."""
    found = {}
    for field in fields(kind):
        usual = None if field.default is MISSING else field.default
        plain = FLAG if isinstance(usual, bool) else WHOLE if isinstance(usual, int) else NUMBER
        found[field.name] = choices.get(field.name, TEXT if isinstance(usual, str) else plain)
    return found


def campaign() -> Schema:
    """A sweep over settings."""
    from raytwin.campaign import sweep_file
    from raytwin.observers import DETECTORS, IMAGES
    from raytwin.pod.links import LINKS
    from raytwin.segmentation.recipe import RECIPES, STARTER

    setting = table({"low": TEXT, "high": TEXT}, required=("low", "high"))
    grid = {}
    for word in sweep_file._GRID_WORDS:
        value = several(TEXT if word == "filter" else NUMBER)
        grid |= {f"{side}{word}": value for side in ("", "low_", "high_") if side or word != "kv"}
    shares = {"type": "array", "items": SHARE}
    training = of_fields(sweep_file.Training, {"recipe": choice((STARTER, *RECIPES)), "start_shares": shares})
    training.pop("start")
    training |= {"start_low": TEXT, "start_high": TEXT}
    requirement = of_fields(sweep_file.Requirement, {})
    requirement.pop("size")
    requirement |= dict.fromkeys((*sweep_file.SIZES, "products_per_minute"), NUMBER)
    slabs = of_fields(sweep_file.Slabs, {"product": TEXT})
    slabs.pop("foreign_object")
    words = {
        **dict.fromkeys(("twin", "references", "test_references", "reference_low", "reference_high"), TEXT),
        **dict.fromkeys(sweep_file.MATERIALS, TEXT),
        **dict.fromkeys(sweep_file._SHARES, SHARE),
        "seed": WHOLE,
        "keep_best": WHOLE,
        "keep_best_of": choice(sweep_file.KEEP_OF),
        "setting": tables(setting),
        "grid": table(grid),
        "line": table(of_fields(sweep_file.Timing, {"pair": choice(sweep_file.PAIRS)})),
        "limits": table(of_fields(sweep_file.Limits, {})),
        "requirement": table(requirement),
        "screening": table(
            of_fields(
                sweep_file.Screening,
                {"observer": TEXT, "most": WHOLE, "detector": choice(DETECTORS), "image": choice(IMAGES)},
            )
        ),
        "training": table(training),
        "detection": table(of_fields(sweep_file.Trying, {})),
        "pod": table(
            of_fields(
                sweep_file.CurveOptions,
                {"size": choice(sweep_file.SIZES), "link": choice(LINKS), "method": choice(sweep_file.METHODS)},
            )
        ),
        "contrast": table(slabs | {"object": TEXT}),
    }
    return titled("raytwin campaign", table(words, required=("twin", "references")))


def material_library() -> Schema:
    """Materials of one's own."""
    fractions = {"type": "object", "additionalProperties": NUMBER}
    entry = {
        "aliases": {"type": "array", "items": TEXT},
        "density_g_cm3": {"type": "number", "exclusiveMinimum": 0},
        "source": TEXT,
        "formula": TEXT,
        "mass_fractions": fractions,
        "parts_by_mass": fractions,
    }
    return titled(
        "raytwin material library", {"type": "object", "additionalProperties": table(entry, required=("source",))}
    )


SCHEMAS = {
    "sidecar": sidecar,
    "description": description,
    "campaign": campaign,
    "materials": material_library,
}


def text_of(name: str) -> str:
    """The file of a schema."""
    return json.dumps(SCHEMAS[name](), indent=1) + "\n"


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for each in SCHEMAS:
        (FOLDER / f"{each}.schema.json").write_text(text_of(each), encoding="utf-8")
