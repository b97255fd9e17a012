"""Pages that are written at build from the program itself: commands from `--help`, effects from the catalogue, pages of the root.

Everything goes to docs/generated, which git ignores. A page that did not change is left as it is, so that Sphinx does not
read it again.
"""

import contextlib
import io
import os
import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[1]
ROOT = DOCS.parent
GENERATED = DOCS / "generated"
# page of the root -> its page of the site
OF_THE_ROOT = {
    "LIMITS.md": "limits",
    "VALIDATION.md": "validation",
    "CHANGELOG.md": "changelog",
    "ARCHITECTURE.md": "architecture",
    "CONTRIBUTING.md": "contributing",
}
LINK = re.compile(r"\]\((?!https?:|#|mailto:)([^)\s]+)\)")


def write_if_changed(path: Path, text: str) -> None:
    """Write a text file, unless it holds the same text already."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def site_link(target: str, *, page: Path) -> str | None:
    """A link of a page of the repository as one of the site, relative to docs/; None: the site does not hold the target."""
    name, _, anchor = target.partition("#")
    found = (page.parent / name).resolve()
    if found.parent == ROOT and found.name in OF_THE_ROOT:
        where = f"/generated/{OF_THE_ROOT[found.name]}.md"
    elif found.is_relative_to(DOCS) and found.suffix in (".md", ".sh"):
        where = f"/{found.relative_to(DOCS).as_posix()}"
    elif found.is_relative_to(DOCS) and (found / "index.md").is_file():
        where = f"/{found.relative_to(DOCS).as_posix()}/index.md"
    else:
        return None
    return where + (f"#{anchor}" if anchor else "")


def with_site_links(text: str, *, page: Path) -> str:
    """Links of a page of the repository as they are on the site; what the site does not hold is named, not linked.

    Raises:
        ValueError: a link to a file that the repository does not hold.
    """

    def replaced(match: re.Match[str]) -> str:
        target = match[1]
        if not (page.parent / target.partition("#")[0]).exists() and not target.startswith("/"):
            raise ValueError(f"{page.relative_to(ROOT)}: no such file: {target}")
        found = site_link(target, page=page)
        return match[0] if found is None else f"]({found})"

    def named(match: re.Match[str]) -> str:
        label, target = match[1], match[2]
        if target.startswith(("http:", "https:", "mailto:", "#", "/")) or site_link(target, page=page) is not None:
            return match[0]
        return (
            label
            if label.startswith("`")
            else f"{label} (`{(page.parent / target).resolve().relative_to(ROOT).as_posix()}`)"
        )

    return LINK.sub(replaced, re.sub(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)", named, text))


def pages_of_the_root() -> None:
    """LIMITS, VALIDATION and the like, with links of the site."""
    for name, target in OF_THE_ROOT.items():
        page = ROOT / name
        text = with_site_links(page.read_text(encoding="utf-8"), page=page)
        # ids of rows become anchors: generated/limits.html#weak-1
        text = re.sub(r"^\| ([a-z]+-\d+) \|", r'| <span class="row-id" id="\1">\1</span> |', text, flags=re.MULTILINE)
        write_if_changed(GENERATED / f"{target}.md", text)


def commands_page() -> None:
    """Every command with what `--help` says."""
    from raytwin.cli import COMMANDS, main

    parts = [
        "# Commands",
        "`raytwin COMMAND --help` prints what stands here. Commands exit with 0 on success, with 2 and one line on bad input,"
        " and with 1 on an internal failure. `--json` prints the answer as JSON on standard output.",
        "| command | does |\n|---|---|\n"
        + "\n".join(f"| [`raytwin {name}`](#raytwin-{name}) | {line} |" for name, (_, line) in COMMANDS.items()),
    ]
    width = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "84"
    try:
        for name in COMMANDS:
            said = io.StringIO()
            with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
                main([name, "--help"])
            parts.append(f"(raytwin-{name})=\n## raytwin {name}\n\n```text\n{said.getvalue().rstrip()}\n```")
    finally:
        if width is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = width
    write_if_changed(GENERATED / "commands.md", "\n\n".join(parts) + "\n")


def write_pages(app: Any) -> None:
    """All generated pages."""
    from effects_gallery import effects_page

    pages_of_the_root()
    commands_page()
    effects_page(GENERATED)


def read_links(app: Any, docname: str, source: list[str]) -> None:
    """Links of the repository's pages to files outside docs/, as links of the site."""
    page = Path(app.env.doc2path(docname))
    if page.suffix == ".md" and not page.is_relative_to(GENERATED):
        source[0] = with_site_links(source[0], page=page)


def setup(app: Any) -> dict[str, Any]:
    app.connect("builder-inited", write_pages, priority=100)  # before autosummary looks for pages
    app.connect("source-read", read_links)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
