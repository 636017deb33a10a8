"""Names in the documentation exist: files, links, modules, make targets."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
PACKAGES = "trajectories|recorder|rig|sim|learning|benchmarks"
# Historical texts: they keep the names of their time.
HISTORY = ("CHANGELOG.md", "docs/decisions/", "docs/reference/moved-modules.md")
_PATH = re.compile(
    rf"(?<![\w./-])((?:{PACKAGES}|tests|docs|examples)/[\w./-]*\w\.(?:py|md|csv|sh))\b"
)
_DOTTED = re.compile(rf"[`\"' ](?:python -m )?((?:{PACKAGES})(?:\.[A-Za-z_]\w*)+)(?=[`\"', ]|$)")
_LOGGER = re.compile(r"getLogger\([^)]*\)")
_LINK = re.compile(r"\]\(([^)\s#]+)(?:#[^)]*)?\)")
_MAKE = re.compile(r"`make ([a-z-]+)")


def _texts() -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "*.md", "*.py", "Makefile"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    return [
        ROOT / name
        for name in listed
        if not name.startswith((*HISTORY, "tests/golden")) and (ROOT / name).is_file()
    ]


TEXTS = _texts()
PAGES = [path for path in TEXTS if path.suffix == ".md"]


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_lead_somewhere(page: Path) -> None:
    links = _LINK.findall(page.read_text())
    dead = [
        link for link in links
        if not re.match(r"[a-z]+:", link) and not (page.parent / link).exists()
    ]  # fmt: skip
    # Fragments that a program inserts into a page of docs/results are linked from there.
    if page.is_relative_to(ROOT / "benchmarks"):
        dead = [link for link in dead if not (ROOT / "docs" / "results" / link).exists()]
    assert not dead


def test_files_that_are_named_are_there() -> None:
    gone = {
        f"{_name(path)}: {named}"
        for path in TEXTS
        for named in _PATH.findall(path.read_text())
        if not (ROOT / named).exists()
    }
    assert not gone


def test_modules_that_are_named_are_there() -> None:
    gone = {
        f"{_name(path)}: {named}"
        for path in TEXTS
        for named in _DOTTED.findall(_LOGGER.sub("", path.read_text()))
        if not named.endswith(".zarr") and not _is_there(named)
    }
    assert not gone


def test_make_targets_that_are_named_are_there() -> None:
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^([a-z][a-z -]*):", makefile, flags=re.M))
    known = {name for line in targets for name in line.split()}
    named = {target for page in PAGES for target in _MAKE.findall(page.read_text())}
    assert {name for name in named if not name.startswith("help-")} <= known


def _is_there(dotted: str) -> bool:
    """Return True if a dotted name is a module, or a name within one."""
    words = dotted.split(".")
    for count in range(len(words), 0, -1):
        place = ROOT.joinpath(*words[:count])
        if place.is_dir() or place.with_suffix(".py").is_file():
            if count == len(words):
                return True
            source = (
                place.with_suffix(".py")
                if place.with_suffix(".py").is_file()
                else place / "__init__.py"
            )
            text = source.read_text() if source.is_file() else ""
            return re.search(rf"\b{re.escape(words[count])}\b", text) is not None
    return importlib.util.find_spec(words[0]) is not None and len(words) == 1


def test_what_is_cited_is_this_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (cited["title"], cited["version"]) == (project["name"], project["version"])
    assert cited["license"] == project["license"]
