"""The library of materials: names as people write them -> compositions. The entries stand in `library.toml`."""

import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ..errors import FileFormatError, InputError
from ..files import read_utf8
from .material import Material, atomic_number_from_symbol, mass_fractions_from_formula, mixture_by_mass

ENVIRONMENT_VARIABLE = "RAYTWIN_LIBRARY"

_PACKAGED = Path(__file__).with_name("library.toml")
_RECIPES = ("mass_fractions", "formula", "parts_by_mass")
_KEYS = {"aliases", "density_g_cm3", "source", *_RECIPES}


@dataclass(frozen=True, slots=True, kw_only=True)
class Library:
    """Named materials. Fields: materials (id -> material), aliases (other name -> id), both read-only."""

    materials: Mapping[str, Material]
    aliases: Mapping[str, str]

    def find(self, name: str) -> Material | None:
        """The material of this id or alias exactly as written, or None."""
        return self.materials.get(self.aliases.get(name, name))

    def find_in_any_case(self, name: str) -> Material | None:
        """The material of this id or alias whatever the case, spaces and hyphens, or None."""
        wanted = _plain(name)
        for known in (*self.materials, *self.aliases):
            if _plain(known) == wanted:
                return self.find(known)
        return None

    def names(self) -> tuple[str, ...]:
        """Every id and alias."""
        return (*self.materials, *self.aliases)


def read_library(path: str | os.PathLike[str], *, base: Library | None = None) -> Library:
    """Read a library file (TOML, the form of the packaged `library.toml`).

    Args:
        path: the file.
        base: entries that its mixtures may name and that the answer also holds; entries of the file come first.
            None: the file stands alone.

    Raises:
        FileFormatError: the file is missing, is no TOML, or an entry cannot be understood.
    """
    where = Path(path)
    try:
        document = tomllib.loads(read_utf8(where))
    except OSError as error:
        raise FileFormatError(
            "material library", received=where, expected=f"a readable file ({error.strerror})"
        ) from None
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError("material library", received=f"{where}: {error}", expected="a TOML file") from None
    materials = dict(base.materials) if base else {}
    aliases = dict(base.aliases) if base else {}
    for name, entry in document.items():
        if not isinstance(entry, dict):
            raise FileFormatError(
                f"{where.name}: {name}", received=repr(entry), expected=f"a table [{name}] with a composition"
            )
        material = _material_from_entry(name, entry, where=where, known=Library(materials=materials, aliases=aliases))
        materials[name] = material
        aliases.pop(name, None)
        for alias in entry.get("aliases", []):
            aliases[str(alias)] = name
    return Library(materials=MappingProxyType(materials), aliases=MappingProxyType(aliases))


def _material_from_entry(name: str, entry: Mapping[str, Any], *, where: Path, known: Library) -> Material:
    at = f"{where.name}, [{name}]"
    unknown = sorted(set(entry) - _KEYS)
    if unknown:
        raise FileFormatError(at, received=f"the key {unknown[0]}", expected=f"keys among {', '.join(sorted(_KEYS))}")
    given = [recipe for recipe in _RECIPES if recipe in entry]
    if len(given) != 1:
        raise FileFormatError(
            at, received=" and ".join(given) or "no composition", expected=f"exactly one of {', '.join(_RECIPES)}"
        )
    density = entry.get("density_g_cm3")
    if density is None and given[0] != "parts_by_mass":
        raise FileFormatError(at, received="no density_g_cm3", expected="the density in g/cm3")
    source = str(entry.get("source", ""))
    try:
        if given[0] == "parts_by_mass":
            parts: dict[Material, float] = {}
            for part, amount in entry["parts_by_mass"].items():
                ingredient = known.find(part) or _ingredient_from_formula(part, needs_density=density is None)
                parts[ingredient] = parts.get(ingredient, 0.0) + float(amount)
            return mixture_by_mass(
                parts, name=name, density_g_cm3=None if density is None else float(density), source=source
            )
        fractions = (
            mass_fractions_from_formula(str(entry["formula"]))
            if given[0] == "formula"
            else {str(symbol): float(fraction) for symbol, fraction in entry["mass_fractions"].items()}
        )
        return Material(name=name, density_g_cm3=float(entry["density_g_cm3"]), mass_fractions=fractions, source=source)
    except InputError as error:
        raise FileFormatError(at, received=str(error), expected="a material that can be made") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise FileFormatError(at, received=str(error), expected="numbers for density and amounts") from None


def _ingredient_from_formula(text: str, *, needs_density: bool) -> Material:
    formula, at, density = text.partition("@")
    if needs_density and not at:
        raise InputError(
            "part by mass",
            received=text,
            expected="an entry that stands above, or a formula with a density",
            remedy=f"write {text}@DENSITY, or give the mixture's density_g_cm3",
        )
    # without `needs_density` only the elements of the ingredient are used
    return Material(
        name=text, density_g_cm3=float(density) if at else 1.0, mass_fractions=mass_fractions_from_formula(formula)
    )


@lru_cache(maxsize=16)
def _library_from_files(files: tuple[tuple[str, int], ...]) -> Library:
    library = read_library(_PACKAGED)
    for path, _ in files:
        library = read_library(path, base=library)
    return library


def library_from_files(paths: Iterable[str | os.PathLike[str]] = ()) -> Library:
    """The packaged library, then the files named by RAYTWIN_LIBRARY, then `paths`; later files come first in look-up.

    Raises:
        FileFormatError: one of the files cannot be read.
    """
    named = [path for path in os.environ.get(ENVIRONMENT_VARIABLE, "").split(os.pathsep) if path]
    stamped = []
    for path in [*named, *(os.fspath(path) for path in paths)]:
        try:
            stamped.append((path, os.stat(path).st_mtime_ns))
        except OSError as error:
            raise FileFormatError(
                "material library", received=path, expected=f"a readable file ({error.strerror})"
            ) from None
    return _library_from_files(tuple(stamped))


def material_from_name(text: str, *, library: Library | None = None) -> Material:
    """The material that a person means by `text`.

    In this order: id or alias of the library as written; element symbol (`Ti`, density of xraylib's table);
    `FORMULA@DENSITY` in g/cm3 (`Gd2O2S@7.32`; the left side may also be a name, whose density is then replaced);
    name of a NIST compound (`Water, Liquid`, or the same in lower case with underscores); id or alias in any case.

    Args:
        text: the name.
        library: where to look; None: the packaged library and the files named by RAYTWIN_LIBRARY.

    Raises:
        InputError: nobody is called so; the nearest names are suggested.
    """
    if not isinstance(text, str):
        raise InputError("material", received=repr(text), expected="a name; for example water, Al or Gd2O2S@7.32")
    return _material_from_name(text.strip(), library_from_files() if library is None else library)


def _material_from_name(name: str, library: Library) -> Material:
    found = library.find(name) or _element(name) or _with_density(name, library) or _nist_compound(name)
    found = found or library.find_in_any_case(name)
    if found is None:
        raise _unknown(name, library)
    return found


def _element(name: str) -> Material | None:
    import xraylib

    try:
        number = atomic_number_from_symbol(name)
    except InputError:
        return None
    return Material(
        name=name,
        density_g_cm3=float(xraylib.ElementDensity(number)),
        mass_fractions={name: 1.0},
        source=f"element, density of xraylib {xraylib.__version__}",
    )


def _with_density(name: str, library: Library) -> Material | None:
    formula, at, density_text = name.rpartition("@")
    if not at:
        return None
    try:
        density_g_cm3 = float(density_text)
    except ValueError:
        raise InputError(
            "material",
            received=repr(name),
            expected="FORMULA@DENSITY with the density in g/cm3",
            remedy="for example Gd2O2S@7.32",
        ) from None
    known = library.find(formula) or _nist_compound(formula) or library.find_in_any_case(formula)
    try:
        fractions = known.mass_fractions if known else mass_fractions_from_formula(formula)
    except InputError:
        raise _unknown(formula, library) from None
    return Material(name=name, density_g_cm3=density_g_cm3, mass_fractions=fractions, source="composition as named")


@lru_cache(maxsize=1)
def _nist_names() -> Mapping[str, str]:
    """The names of NIST's compounds in xraylib, by their plain spelling."""
    import xraylib

    return {_plain(name): name for name in xraylib.GetCompoundDataNISTList()}


def _nist_compound(name: str) -> Material | None:
    import xraylib

    listed = _nist_names().get(_plain(name))
    if listed is None:
        return None
    compound = xraylib.GetCompoundDataNISTByName(listed)
    symbols = [str(xraylib.AtomicNumberToSymbol(number)) for number in compound["Elements"]]
    return Material(
        name=listed,
        density_g_cm3=float(compound["density"]),
        mass_fractions=dict(zip(symbols, map(float, compound["massFractions"]), strict=True)),
        source="NIST compound list of xraylib",
    )


def nist_identifier(name: str) -> str | None:
    """A NIST compound's name in lower case with underscores (no commas, fit for a filter), or None if it is none."""
    return _plain(name) if _plain(name) in _nist_names() else None


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _unknown(name: str, library: Library) -> InputError:
    readable: dict[str, str] = {}
    for known in library.names():
        readable.setdefault(_plain(known), known)
    for plain, known in _nist_names().items():
        readable.setdefault(plain, f"'{known}'")
    wanted = _plain(name)
    near = difflib.get_close_matches(wanted, readable, n=4, cutoff=0.6)
    near += [plain for plain in readable if len(wanted) > 2 and wanted in plain and plain not in near][: 4 - len(near)]
    remedy = f"nearest: {', '.join(readable[plain] for plain in near)}" if near else ""
    try:
        mass_fractions_from_formula(name)
    except InputError:
        pass
    else:
        remedy = f"give the formula its density, {name}@DENSITY" + (f" ({remedy})" if remedy else "")
    return InputError(
        "material",
        received=repr(name),
        expected="an id or alias of the library, an element symbol, FORMULA@DENSITY (g/cm3) or a NIST compound's name",
        remedy=remedy or f"ids of the library: {', '.join(library.materials)}",
    )
