"""The house: imports run downward, the package holds nothing else, commands are registered, help is quick to load."""

import ast
import io
import json
import re
import subprocess
import sys
import tomllib
import zipfile
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from raytwin.cli import COMMANDS, main

ROOT = Path(__file__).parents[1]
BASE = {"_guard", "errors", "files", "results"}
# room -> the rooms below it; a new room is one line here and one in each table of pyproject.toml
BELOW = {
    "acquisition": set(),
    "pod": set(),
    "reports": set(),
    "materials": {"acquisition"},  # for the words of a setting: Filter
    "segmentation": {"acquisition"},
    "lab": {"acquisition"},  # shares no physics with the twin, or agreement would prove nothing
    "spectra": {"acquisition", "materials"},
    "generator": {"acquisition", "materials", "spectra"},
    "observers": {"acquisition", "materials", "spectra", "generator", "pod"},
    "calibration": {"acquisition", "materials", "spectra", "generator"},
    "checks": {"acquisition", "materials", "spectra", "generator", "calibration"},
    "diagnosis": {"acquisition", "generator", "calibration", "checks", "reports"},
}
SHIPPED = {
    "raytwin.data.calibration": "data/calibration",
    "raytwin.data.starter": "data/starter",
}  # a folder of data without modules
ABOVE = {"api", "commands", "explore"}  # in src/raytwin, above every room
COMPOSERS = {"campaign", "commands", "api", "explore"}  # may import every room
MAY_IMPORT_LAB = {"lab", *COMPOSERS}
HEAVY = {
    "torch",
    "matplotlib",
    "numpy",
    "scipy",
    "h5py",
    "numba",
    "spekpy",
    "xraylib",
    "xraydb",
    "dask",
    "bokeh",
    "tornado",
}
HEAVY |= {"statsmodels", "pandas"}


def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def rooms_on_disk():
    return {
        path.parent.name
        for path in ROOT.glob("*/__init__.py")
        if path.parent.name not in ("tests", "validation", "benchmarks")
    }


def subpackages_on_disk():
    """Folders of a room that are packages themselves: `generator/effects` -> `raytwin.generator.effects`."""
    folders = [path.parent.relative_to(ROOT) for room in rooms_on_disk() for path in ROOT.glob(f"{room}/*/__init__.py")]
    return {"raytwin." + ".".join(folder.parts): folder.as_posix() for folder in folders}


def python_files():
    for room in sorted(rooms_on_disk()):
        yield from ((room, path) for path in sorted((ROOT / room).rglob("*.py")))
    for name in sorted(ABOVE):
        yield from ((name, path) for path in sorted((ROOT / "src" / "raytwin" / name).glob("*.py")))


def imported_rooms(path, depth):
    """(line, target) of every import that leaves the room; target is the first name after the dots, or `raytwin`."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [node.module or ""]
        else:
            names = []
        if any(name.split(".")[0] == "raytwin" for name in names):
            yield node.lineno, "raytwin"
        if isinstance(node, ast.ImportFrom) and node.level == depth + 1:
            if node.module:
                yield node.lineno, node.module.split(".")[0]
            else:
                yield from ((node.lineno, alias.name) for alias in node.names)


def test_imports_run_downward_only():
    wrong = []
    for room, path in python_files():
        depth = 1 if room in ABOVE else len(path.relative_to(ROOT / room).parts)
        for line, target in imported_rooms(path, depth):
            place = f"{path.relative_to(ROOT)}:{line} imports {target}"
            if target == "raytwin":
                wrong.append(f"{place} (absolute import of its own package: two copies of a class)")
            elif target == room or target in BASE or target.startswith("__"):
                continue
            elif room in COMPOSERS:
                if room == "campaign" and target in ("commands", "cli", "api", "explore"):
                    wrong.append(f"{place} (commands, api and explore are above campaign)")
                if room == "api" and target in ("commands", "cli", "explore"):
                    wrong.append(f"{place} (commands and explore are above api)")
                if room == "explore" and target in ("commands", "cli"):
                    wrong.append(f"{place} (commands are above explore)")
            elif target not in BELOW[room]:
                wrong.append(f"{place} (not below {room})")
            if target == "lab" and room not in MAY_IMPORT_LAB:
                wrong.append(f"{place} (nobody but commands and campaign may know the lab)")
    assert not wrong, "\n".join(wrong)


def test_every_room_has_its_place_in_the_order():
    assert rooms_on_disk() <= set(BELOW) | COMPOSERS
    for room, below in BELOW.items():
        for lower in below:
            assert room not in BELOW[lower], f"{room} and {lower} lie below each other"


def test_the_upward_import_check_sees_a_planted_fault(tmp_path):
    module = tmp_path / "bad.py"
    module.write_text("from ..calibration import x\nimport raytwin.pod\nfrom .. import lab\nfrom . import fine\n")
    assert sorted(imported_rooms(module, 1)) == [(1, "calibration"), (2, "raytwin"), (3, "lab")]


def imports_among(files):
    """File -> files of the same set that it imports relatively, for running or for types."""
    known = {path.resolve(): path for path in files}
    graph = {}
    for path in files:
        found = graph.setdefault(path, set())
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.level:
                base = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
                places = [base.with_suffix(".py"), *(base / f"{alias.name}.py" for alias in node.names)]
                if node.module:
                    places.append(base / "__init__.py")
                found.update(known[place.resolve()] for place in places if place.resolve() in known)
    return graph


def ring_in(graph):
    """Files that import each other in a ring, from one back to itself; empty: none."""
    done, way = set(), []

    def seek(path):
        if path in way:
            return [*way[way.index(path) :], path]
        if path in done:
            return []
        way.append(path)
        for target in sorted(graph[path]):
            if found := seek(target):
                return found
        done.add(way.pop())
        return []

    return next((found for path in graph if (found := seek(path))), [])


def test_no_files_import_each_other_in_a_ring():
    ring = ring_in(imports_among([path for _, path in python_files()]))
    assert not ring, " imports ".join(str(path.relative_to(ROOT)) for path in ring)


def test_the_check_of_rings_sees_a_planted_one(tmp_path):
    texts = {"a": "from .b import x\n", "b": "if x:\n    from . import c\n", "c": "def f():\n    from .a import y\n"}
    files = [tmp_path / f"{name}.py" for name in (*texts, "d")]
    for path in files:
        path.write_text(texts.get(path.stem, "from .a import x\n"))
    graph = imports_among(files)
    assert [path.stem for path in ring_in(graph)] == ["a", "b", "c", "a"]
    graph[files[2]] = set()
    assert ring_in(graph) == []


def modules_imported(path):
    """Modules of raytwin that a file outside of it imports from."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").split(".")[0] == "raytwin":
            yield node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("raytwin."))


def is_module(name):
    """Whether a room or `src/raytwin` holds a module or package of a full name."""
    parts = name.split(".")[1:]
    places = [folder.joinpath(*parts) for folder in (ROOT, ROOT / "src" / "raytwin")]
    return any(place.is_dir() or place.with_suffix(".py").is_file() for place in places)


def test_modules_that_tests_and_scripts_import_exist():
    folders = ("tests", "validation", "benchmarks", "docs/_ext", "docs/examples")
    files = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]
    assert len(files) > 100
    gone = [
        f"{path.relative_to(ROOT)}: {name}" for path in files for name in modules_imported(path) if not is_module(name)
    ]
    assert not gone, "\n".join(gone)


def test_the_check_of_imported_modules_sees_one_that_is_gone(tmp_path):
    module = tmp_path / "script.py"
    module.write_text(
        "import raytwin as rt\nimport raytwin.pod.links\nfrom raytwin.pod.knots import f\nfrom raytwin import api\n"
    )
    assert [(name, is_module(name)) for name in modules_imported(module)] == [
        ("raytwin.pod.links", True),
        ("raytwin.pod.knots", False),
        ("raytwin", True),
    ]


def imports_among_packages(graph, room):
    """The graph of a room's files with each folder below the room as one node; a file of the room itself stays one."""
    node = {path: path if path.parent == room else path.parent for path in graph if path.is_relative_to(room)}
    packages = {name: set() for name in node.values()}
    for path, name in node.items():
        packages[name].update(node[target] for target in graph[path] if target in node)
        packages[name].discard(name)
    return packages


@pytest.mark.parametrize("room", sorted({Path(folder).parts[0] for folder in subpackages_on_disk().values()}))
def test_no_packages_of_a_room_import_each_other_in_a_ring(room):
    """Names that the room itself offers (`from .. import write_twin`, looked up when called) belong to no package."""
    graph = imports_among_packages(imports_among([path for _, path in python_files()]), ROOT / room)
    ring = ring_in(graph)
    assert not ring, " imports ".join(path.relative_to(ROOT).as_posix() for path in ring)


def test_the_check_of_rings_between_packages_sees_a_planted_one(tmp_path):
    texts = {
        "a/x": "from ..b.y import f\n",
        "a/z": "",
        "b/y": "",
        "b/w": "def f():\n    from ..a import z\n",
        "top": "",
    }
    files = [tmp_path / f"{name}.py" for name in texts]
    for path, text in zip(files, texts.values(), strict=True):
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    graph = imports_among(files)
    assert ring_in(graph) == []  # no ring of files, but one of packages
    assert [path.name for path in ring_in(imports_among_packages(graph, tmp_path))] == ["a", "b", "a"]
    files[3].write_text("from ..top import f\n")
    assert ring_in(imports_among_packages(imports_among(files), tmp_path)) == []
    # what a package offers itself is imported from it as well
    files.append(tmp_path / "a" / "__init__.py")
    files[-1].write_text("")
    files[3].write_text("from ..a import f\n")
    assert [path.name for path in ring_in(imports_among_packages(imports_among(files), tmp_path))] == ["a", "b", "a"]


@pytest.mark.parametrize("room", ["generator", "diagnosis"])
def test_packages_import_in_the_order_of_the_architecture_page(room):
    page = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    rows = re.findall(rf"^\| (`{room}/\w.*?) \|", page.partition("## From a frame")[0], re.MULTILINE)
    order = [ROOT / folder for row in rows for folder in re.findall(r"`([\w/]+)/`", row)]
    graph = imports_among_packages(imports_among([path for _, path in python_files()]), ROOT / room)
    assert {path for path in graph if path.is_dir()} == set(order)
    for number, package in enumerate(order):
        above = {path for path in graph[package] if path.is_dir()} - set(order[:number])
        assert not above, f"{package.name} imports {above}"


def test_docstrings_of_packages_name_their_files():
    """Effects apart, whose files stand in a dict."""
    folders = [ROOT / folder for folder in subpackages_on_disk().values() if folder != "generator/effects"]
    folders += [ROOT / room for room in ("acquisition", "calibration", "campaign", "checks", "observers", "spectra")]
    for folder in folders:
        told = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or ""
        files = {path.stem for path in folder.glob("*.py")} - {"__init__"}
        assert files <= set(re.findall(r"\w+", told)), folder
        listed = re.findall(r"^ {4}(\w+)", told, re.MULTILINE)
        assert listed and set(listed) <= files, folder


# the map of the pixels that calibration found bad bears the name of an effect; this file names the map, for all others
NAMES_THE_MAP = ("generator/line/twin.py", "bad_pixels")


def strings_of(path):
    """(line, text) of every string of a file that is no docstring."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    told = set()
    for node in nodes:
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and node.body:
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                told.add(first.value)
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in told:
            yield node.lineno, node.value


def names_of_effects(files, ids):
    """Places that name an effect: strings that are its id."""
    files = [path for path in files if any(name in path.read_text(encoding="utf-8") for name in ids)]
    return [f"{path}:{line} {text}" for path in files for line, text in strings_of(path) if text in ids]


def test_no_code_but_the_catalogue_and_the_lab_names_an_effect():
    from raytwin.generator.effects import OURS

    files = [path for _, path in python_files() if path.relative_to(ROOT).parts[0] != "lab"]
    files = [path for path in files if path.parent != ROOT / "generator" / "effects"]
    file, name = NAMES_THE_MAP
    named = names_of_effects(files, set(OURS))
    of_the_map = [place for place in named if place.startswith(f"{ROOT / file}:") and place.endswith(f" {name}")]
    assert len(of_the_map) == 1
    wrong = sorted(set(named) - set(of_the_map))
    assert not wrong, "ask the effect's declaration (generator/effects/effect.py):\n" + "\n".join(wrong)


def test_the_check_of_effects_sees_a_planted_name_and_no_docstring(tmp_path):
    module = tmp_path / "table.py"
    module.write_text('"""heel"""\n\nTABLE = {"heel": 1}\n\n\ndef f(x):\n    """heel"""\n    return x == "mtf_tail"\n')
    assert names_of_effects([module], {"heel", "mtf_tail"}) == [f"{module}:3 heel", f"{module}:8 mtf_tail"]


def test_packages_on_disk_and_in_pyproject_agree():
    setuptools = project()["tool"]["setuptools"]
    listed = set(setuptools["packages"])
    on_disk = {"raytwin", *(f"raytwin.{name}" for name in ABOVE)} | {f"raytwin.{room}" for room in rooms_on_disk()}
    assert listed == on_disk | set(subpackages_on_disk()) | set(SHIPPED)
    places = setuptools["package-dir"]
    assert places.pop("raytwin") == "src/raytwin"
    assert places == {f"raytwin.{room}": room for room in rooms_on_disk()} | subpackages_on_disk() | SHIPPED


def test_check_and_format_of_the_makefile_cover_every_room():
    line = re.search(r"^ROOMS := (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert line is not None
    assert set(line[1].split()) == rooms_on_disk()


def test_the_wheel_holds_nothing_but_raytwin(tmp_path):
    command = [
        sys.executable,
        "-c",
        "import sys; from setuptools import build_meta; print(build_meta.build_wheel(sys.argv[1]))",
        str(tmp_path),
    ]
    # built from a copy, so that no build folder is left in the repository and nothing unlisted can slip in unseen
    copy = tmp_path / "copy"
    copy.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        (copy / name).write_bytes((ROOT / name).read_bytes())
    for folder in ["src", *rooms_on_disk(), *SHIPPED.values(), "tests"]:
        for path in (ROOT / folder).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts and ".numba_cache" not in path.parts:
                target = copy / path.relative_to(ROOT)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(path.read_bytes())
    subprocess.run(command, cwd=copy, check=True, capture_output=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    outside = [name for name in names if not name.startswith("raytwin/") and ".dist-info/" not in name]
    assert outside == []
    inside = set(names)
    for room, path in python_files():
        relative = path.relative_to(ROOT / "src") if room in ABOVE else Path("raytwin") / path.relative_to(ROOT)
        assert relative.as_posix() in inside
    assert "raytwin/py.typed" in inside
    data = [path for room in rooms_on_disk() for path in (ROOT / room).rglob("*") if path.suffix in (".toml", ".npz")]
    assert "raytwin/explore/page.html" in inside
    data += [path for folder in SHIPPED.values() for path in (ROOT / folder).iterdir()]
    for path in data:
        assert f"raytwin/{path.relative_to(ROOT).as_posix()}" in inside


def loaded_modules(code):
    result = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys, json; sys.stderr.write(json.dumps(sorted(sys.modules)))"],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return {name.split(".")[0] for name in json.loads(result.stderr)}


def test_importing_raytwin_loads_nothing_heavy():
    assert not loaded_modules("import raytwin") & HEAVY


def test_help_loads_nothing_heavy():
    code = (
        "import contextlib\nfrom raytwin.cli import main\nwith contextlib.suppress(SystemExit):\n    main(['--help'])"
    )
    assert not loaded_modules(code) & HEAVY


@pytest.mark.parametrize(
    "room", ["segmentation", "pod", "lab", "observers", "generator", "calibration", "spectra", "materials"]
)
def test_importing_a_room_loads_neither_torch_nor_matplotlib(room):
    assert not loaded_modules(f"import raytwin.{room}") & {"torch", "matplotlib", "dask", "spekpy"}


def test_every_command_module_is_registered():
    modules = {
        path.stem for path in (ROOT / "src" / "raytwin" / "commands").glob("*.py") if not path.stem.startswith("_")
    }
    assert modules == {module for module, _ in COMMANDS.values()}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example_of_itself(name):
    output = io.StringIO()
    with redirect_stdout(output), pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    assert re.search(rf"example.*\n(.*\n)*? *raytwin {name} ", output.getvalue()), output.getvalue()


def test_every_command_that_answers_takes_json():
    without = [
        name
        for name, (module, _) in COMMANDS.items()
        if "--json" not in (ROOT / "src" / "raytwin" / "commands" / f"{module}.py").read_text(encoding="utf-8")
    ]
    assert without == []


def test_public_names_of_every_room_exist():
    code = (
        "import importlib, raytwin\n"
        f"for room in {sorted(rooms_on_disk())!r}:\n"
        "    module = importlib.import_module('raytwin.' + room)\n"
        "    for name in getattr(module, '__all__', ()):\n"
        "        getattr(module, name)\n"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, timeout=120)
