"""Hooks of MkDocs: pages that lie outside docs/, files of code that pages link, and notebooks."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

from markdown import Extension, Markdown
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
# Pages of the repository, and their addresses in the site.
OUTSIDE = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md"}
OUTSIDE["CHANGELOG.md"] = "changelog.md"
DECISIONS = sorted((ROOT / "docs" / "decisions").glob("0*.md"))
RESULTS = ROOT / "docs" / "results"
_LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)\s#]+)")
_BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```$\n?", re.MULTILINE | re.DOTALL)
_BEGINS = re.compile(r" *([-*|] ?|\d+\. )")


class _Nested(Extension):
    """Lists nested by two spaces, as on GitHub; Python-Markdown wants four."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802  (the name that is called)
        """Set the width of an indentation."""
        md.tab_length = 2


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add results, in the order of their list, and decisions to the navigation."""
    linked = ["README.md", *_LINK.findall((RESULTS / "README.md").read_text())]
    there = sorted(str(path.relative_to(RESULTS)) for path in RESULTS.rglob("*.md"))
    pages = [*dict.fromkeys(page for page in linked if page in there)]
    pages += [page for page in there if page not in pages]
    config.nav.append({"Results": [f"results/{page}" for page in pages]})
    numbered = ["README.md", *(path.name for path in DECISIONS)]
    config.nav.append({"Decisions": [f"decisions/{page}" for page in numbered]})
    config.markdown_extensions.append(_Nested())
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages outside docs/, files that any page links, and a notebook of each tutorial."""
    for source, address in OUTSIDE.items():
        text = (ROOT / source).read_text()
        files.append(File.generated(config, address, content=_relinked(text, ROOT, ROOT / "docs")))
    titles = ((path, path.read_text().split("\n")[0].lstrip("# ")) for path in DECISIONS)
    listed = "\n".join(f"- [{title}]({path.name})" for path, title in titles)
    content = f"# Decisions\nWhy things are as they are, one page each.\n\n{listed}\n"
    files.append(File.generated(config, "decisions/README.md", content=content))
    pages = [Path(file.abs_src_path) for file in files.documentation_pages() if file.abs_src_path]
    pages += [ROOT / source for source in OUTSIDE]
    linked = {
        (page.parent / link).resolve() for page in pages for link in _LINK.findall(page.read_text())
    }
    for path in sorted(linked):
        if path.is_file() and not path.is_relative_to(ROOT / "docs"):
            name = path.relative_to(ROOT)
            if str(name) not in OUTSIDE:
                content = (
                    f"---\nsearch: {{exclude: true}}\n---\n# `{name}`\n"
                    f"````{path.suffix[1:]}\n{path.read_text()}\n````\n"
                )
                files.append(File.generated(config, f"source/{name}.md", content=content))
    for path in sorted((ROOT / "docs" / "tutorials").glob("*.md")):
        notebook = json.dumps(notebook_of(path.read_text()), indent=1)
        files.append(File.generated(config, f"tutorials/{path.stem}.ipynb", content=notebook))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a page with links of the site, and with the empty lines that Python-Markdown wants."""
    if page.file.abs_src_path is not None:
        folder = Path(page.file.abs_src_path).parent
        markdown = _relinked(markdown, folder, folder)
    if page.file.src_uri.startswith("tutorials/"):
        name = Path(page.file.src_uri).stem
        markdown += f"\n\n[This page as a notebook]({name}.ipynb)\n"
    return "".join(
        part if number % 2 else _spaced(part)
        for number, part in enumerate(re.split(r"(^ *```.*?^ *```$)", markdown, flags=re.M | re.S))
    )


def notebook_of(text: str) -> dict[str, Any]:
    """Return a page as a Jupyter notebook: its blocks of Python and shell are the cells of code."""
    cells: list[dict[str, Any]] = []
    parts = _BLOCK.split(text)
    for number, part in enumerate(parts):
        kind = ("markdown", "", "code")[number % 3]
        if kind == "code":
            code = ("%%bash\n" if parts[number - 1] == "sh" else "") + part.rstrip()
            cells.append(
                {"cell_type": kind, "source": code, "outputs": [], "execution_count": None}
            )
        elif kind and part.strip():
            cells.append({"cell_type": kind, "source": part.strip()})
    for number, cell in enumerate(cells):
        cell |= {"id": f"cell-{number}", "metadata": {}}
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def _relinked(text: str, folder: Path, to: Path) -> str:
    """Return text of a page in `folder` with its links as seen from `to`."""

    def link(found: re.Match[str]) -> str:
        target = (folder / found[1]).resolve()
        if target.is_dir():
            target /= "README.md"
        elif not target.is_relative_to(ROOT / "docs") and target.is_file():
            name = str(target.relative_to(ROOT))
            target = ROOT / "docs" / OUTSIDE.get(name, f"source/{name}.md")
        return os.path.relpath(target, to)

    return _LINK.sub(link, text)


def _spaced(text: str) -> str:
    """Return text with an empty line before each list and table."""
    lines: list[str] = []
    for line in text.split("\n"):
        before = lines[-1] if lines else ""
        begins = _BEGINS.match(line) and before.strip() and not _BEGINS.match(before)
        # A line within an item of a list goes on with it.
        if begins and (not before.startswith(" ") or line.lstrip().startswith("|")):
            lines.append("")
        lines.append(line)
    return "\n".join(lines)
