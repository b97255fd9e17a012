"""What the pages show is true of the program: blocks parse and run, commands have the options shown, links and versions agree.

Notebooks run when the site is built (`make docs`); the blocks of docs/python.md, docs/check.md and README run in test_api.py.
"""

import ast
import importlib.util
import json
import re
import shlex
import tomllib
from pathlib import Path

import pytest

import raytwin as rt
from raytwin.cli import COMMANDS, _parser

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
NOT_OF_USERS = ("notebook", "generated", "_build", "_ext", "jupyter_execute")
PAGES = sorted(path for path in DOCS.rglob("*.md") if not set(path.relative_to(DOCS).parts) & set(NOT_OF_USERS))
PAGES += [
    ROOT / name
    for name in ("README.md", "LIMITS.md", "VALIDATION.md", "CHANGELOG.md", "ARCHITECTURE.md", "CONTRIBUTING.md")
]
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def blocks(page, *kinds):
    """Contents of the fenced blocks of some kinds."""
    found = FENCE.findall(page.read_text(encoding="utf-8"))
    return [body for kind, body in found if kind.strip() in kinds]


def python_blocks(page):
    """Python of a page, without the options and shell lines of notebooks."""
    for body in blocks(page, "python", "{code-cell} python"):
        if not body.startswith("%%bash"):
            yield "\n".join(line for line in body.splitlines() if not line.startswith((":tags:", "!")))


def commands_in(page):
    """Words of every `raytwin ...` line of a page's shell blocks and notebook cells."""
    bodies = blocks(page, "", "sh", "bash")
    for cell in blocks(page, "{code-cell} python"):
        shell = cell.startswith("%%bash")
        bodies.append(cell if shell else "\n".join(re.findall(r"^!(.*)$", cell, re.MULTILINE)))
    for body in bodies:
        for line in body.replace("\\\n", " ").splitlines():
            for part in line.split("&&"):
                words = shlex.split(re.sub(r"\s2?>.*$", "", part), comments=True)
                if words[:1] == ["raytwin"] and len(words) > 1:
                    yield words[1:]


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_python_of_a_page_parses_and_names_what_exists(page):
    for body in python_blocks(page):
        for node in ast.walk(ast.parse(body, filename=str(page))):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "rt":
                assert node.attr in rt.__all__, f"rt.{node.attr}"


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_of_a_page_have_the_options_shown(page, capsys):
    for words in commands_in(page):
        # an option's value left out on purpose: the line ends before that option
        shown = words[: words.index("...") - 1] if "..." in words else words
        try:
            _parser(shown[0] if shown[0] in COMMANDS else None).parse_args(shown)
        except SystemExit as stop:
            assert stop.code == 0, f"raytwin {shlex.join(shown)}: {capsys.readouterr().err}"


def test_the_pages_hold_commands_and_python():
    assert sum(len(list(commands_in(page))) for page in PAGES) > 60
    assert sum(len(list(python_blocks(page))) for page in PAGES) > 40


def test_a_wrong_option_in_a_page_is_noticed(tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("```sh\nraytwin predict twin.h5 --kv 60 --powr-w 30 --exposure-ms 20\n```\n")
    with pytest.raises(AssertionError, match="power-w"):
        test_commands_of_a_page_have_the_options_shown(page, capsys)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_toml_of_a_page_parses(page):
    for body in blocks(page, "toml"):
        assert tomllib.loads(body)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_of_a_page_lead_somewhere(page):
    for target in re.findall(r"\]\((?!https?:|mailto:|#)([^)\s]+)\)", page.read_text(encoding="utf-8")):
        name = target.partition("#")[0]
        if name.startswith("/generated/"):
            continue  # written at build, where Sphinx checks it
        assert (page.parent / name).exists(), target


def test_ids_of_limits_and_validation_are_unique():
    for name in ("LIMITS.md", "VALIDATION.md"):
        ids = re.findall(r"^\| ([a-z]+-\d+) \|", (ROOT / name).read_text(encoding="utf-8"), re.MULTILINE)
        assert len(ids) > 40
        assert len(ids) == len(set(ids)), name


def test_ids_that_pages_point_to_exist():
    ids = {
        found
        for name in ("LIMITS.md", "VALIDATION.md")
        for found in re.findall(r"^\| ([a-z]+-\d+) \|", (ROOT / name).read_text(encoding="utf-8"), re.MULTILINE)
    }
    kinds = {name.split("-")[0] for name in ids}
    for page in PAGES:
        text = re.sub(r"`[^`]*`", "", page.read_text(encoding="utf-8"))
        named = re.findall(r"(?<![\w-])([a-z]+-\d+)(?= in \[LIMITS| in \[VALIDATION|\]\(.*(?:LIMITS|VALIDATION))", text)
        assert {name for name in named if name.split("-")[0] in kinds} <= ids, page.name


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_files_and_targets_that_a_page_names_exist(page):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:[a-z_0-9]+/)+[a-z_0-9]+\.(?:py|toml))`", text):
        made = name.startswith("demo/")  # by `raytwin demo`
        assert made or (ROOT / name).is_file() or (ROOT / "src" / "raytwin" / name).is_file(), name
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(re.findall(r"`make ([a-z-]+)", text)) <= targets


def test_versions_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    citation = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    newest = re.search(r"^## (\d\S*)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert citation is not None and newest is not None
    assert project == rt.__version__ == citation[1] == newest[1]


@pytest.fixture(scope="module")
def schemas():
    """The module that writes the JSON Schemas."""
    spec = importlib.util.spec_from_file_location("schemas_of_docs", DOCS / "_ext" / "schemas.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_schemas_are_those_of_the_readers(schemas):
    for name in schemas.SCHEMAS:
        kept = (DOCS / "schemas" / f"{name}.schema.json").read_text(encoding="utf-8")
        assert kept == schemas.text_of(name), f"{name}: run python docs/_ext/schemas.py"


def test_examples_are_valid_by_the_schemas_and_mistyped_words_are_not():
    jsonschema = pytest.importorskip("jsonschema")
    examples = {
        "sidecar": [(ROOT / "data" / "real" / "flexray" / "raytwin.toml").read_text(encoding="utf-8")],
        "materials": [(ROOT / "materials" / "library.toml").read_text(encoding="utf-8")],
        "description": blocks(DOCS / "descriptions.md", "toml"),
        "campaign": blocks(DOCS / "campaigns.md", "toml"),
    }
    examples["sidecar"] += blocks(DOCS / "importing.md", "toml")
    wrong = {
        "sidecar": '[[series]]\nkind = "flat"\nfiles = "*.tif"\nexposure = 20\n',
        "materials": "[steel]\ndensity = 7.8\n",
        "description": '[[product]]\nshape = "filet"\n',
        "campaign": 'twin = "t.h5"\nreferences = "r.h5"\n[limits]\nmaximum_dose = 2\n',
    }
    for name, texts in examples.items():
        schema = json.loads((DOCS / "schemas" / f"{name}.schema.json").read_text(encoding="utf-8"))
        assert texts
        for text in texts:
            jsonschema.validate(tomllib.loads(text), schema)
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(tomllib.loads(wrong[name]), schema)


ARCHITECTURE = ROOT / "ARCHITECTURE.md"


def names_with_files(page):
    """(file, name) of the page's pairs: a file in backticks, then a name of it, in the next cell or after a comma."""
    return re.findall(r"`([\w/]+\.py)`(?: \| |,\s+)`([A-Za-z_][\w.]*)`", page.read_text(encoding="utf-8"))


def names_of(path):
    """Functions, classes, their methods and the constants of a file."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{item.name}" for item in node.body if isinstance(item, ast.FunctionDef)}
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


def test_functions_and_folders_of_the_architecture_page_exist():
    pairs = names_with_files(ARCHITECTURE)
    assert len(pairs) > 25
    for file, name in pairs:
        assert name in names_of(ROOT / file), f"{file} has no {name}"
    for folder in re.findall(r"`([\w/]+/)`", ARCHITECTURE.read_text(encoding="utf-8")):
        assert (ROOT / folder).is_dir(), folder


def test_a_function_that_is_gone_from_the_architecture_page_is_noticed(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("| 1 | `pod/links.py` | `fit_links` | x |\nsee `pod/links.py`, `LINKS`\n")
    assert names_with_files(page) == [("pod/links.py", "fit_links"), ("pod/links.py", "LINKS")]
    assert "LINKS" in names_of(ROOT / "pod" / "links.py") and "fit_links" not in names_of(ROOT / "pod" / "links.py")
