"""Writes docs/reference from the table of commands and the packages' own words: `make reference`.

Packages are read, not imported: public names are those in the `__all__` of a package.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tactile.commands import COMMANDS, EXTRAS, GROUPS, Command  # noqa: E402

FOLDER = ROOT / "docs" / "reference"
# Characters of a value that is told where nothing else is.
SHORT = 60
PACKAGES = ("trajectories", "recorder", "rig", "sim", "learning", "tactile")
ABOUT_COMMANDS = """\
# Commands

Made from `tactile/commands.py` by `make reference`.

`tactile --help` lists all of them, `tactile COMMAND --help` tells the options of one and their
units. `tactile COMMAND` and the verb in the third column are the same: options, messages, exit
codes. `python -m tactile` is `tactile`. Files are looked for, and written, in the folder that it is
run in; `tactile init DIR` lays out one. Measuring has a command of its own, in a checkout:
`python -m benchmarks`.

`extra` is what a command needs beside the package itself: `pip install 'tactile-rig[EXTRA]'`.
Without, it says so and ends with exit code 2."""
EXIT_CODES = """
## Exit codes
| code | after |
|---|---|
| 0 | all was done |
| 1 | a check found something, a comparison differs, a simulation has no solution |
| 2 | wrong input: an unknown command or option, an unusable file, a missing extra |
| 3 | a device was lost |
| 4 | a safety stop |
| 130 | interrupted |"""
ABOUT_NAMES = """\
# Public names

Made from the packages by `make reference`: the names in the `__all__` of each. What is not here may
change without a word. All quantities are SI unless a name says otherwise. Every package has a
`py.typed`: mypy and editors know the types."""


def commands_page() -> str:
    """The table of commands."""
    lines = [ABOUT_COMMANDS]
    for title, commands in GROUPS.items():
        lines += ["", f"## {title}", "| command | what it does | the same verb | extra |"]
        lines += ["|---|---|---|---|", *(_row(command) for command in commands)]
    lines.append(EXIT_CODES)
    return "\n".join(lines) + "\n"


def _row(command: Command) -> str:
    door = f"`{command.door}`" if command.package != "tactile" else ""
    extra = command.extra or EXTRAS[command.package]
    return f"| `tactile {command.words}` | {command.help} | {door} | {extra} |"


def names_page() -> str:
    """Every public name of every package, with the first line of what it says of itself."""
    lines = [ABOUT_NAMES]
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("__init__.py")):
            names = _exported(path)
            if path.parent.name != package and not names:
                continue
            module = ".".join(path.parent.relative_to(ROOT).parts)
            lines += ["", f"## `{module}`", _summary(ast.parse(path.read_text()))]
            if names:
                lines += ["", "| name | |", "|---|---|"]
                lines += [f"| `{name}` | {_told(path, name)} |" for name in names]
            else:
                lines += ["", "No public names of its own."]
    return "\n".join(lines) + "\n"


def _exported(path: Path) -> list[str]:
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == "__all__" for target in node.targets
        ):
            return sorted(ast.literal_eval(node.value), key=str.lower)
    return []


def _told(path: Path, name: str) -> str:
    """First line of a name's docstring, wherever it is defined."""
    body = ast.parse(path.read_text()).body
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return _summary(node)
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(target, ast.Name) and target.id == name for target in targets):
                return _above(path, node) or _value(node)
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return _imported(node.module, alias.name)
    return ""


def _imported(module: str, name: str) -> str:
    place = ROOT.joinpath(*module.split("."))
    for path in (place.with_suffix(".py"), place / "__init__.py"):
        if path.exists():
            return _told(path, name)
    return ""


def _above(path: Path, node: ast.stmt) -> str:
    """The comment that stands right above an assignment."""
    told: list[str] = []
    for line in reversed(path.read_text().splitlines()[: node.lineno - 1]):
        if not line.startswith("#"):
            break
        told.insert(0, line.removeprefix("#").strip())
    return _line("\n".join(told))


def _value(node: ast.Assign | ast.AnnAssign) -> str:
    """A short value, which says enough."""
    text = "" if node.value is None else ast.unparse(node.value)
    return f"`{text}`" if len(text) <= SHORT else ""


def _summary(node: ast.Module | ast.ClassDef | ast.FunctionDef) -> str:
    return _line(ast.get_docstring(node) or "")


def _line(text: str) -> str:
    return " ".join(text.split("\n\n")[0].split()).replace("|", "\\|")


PAGES = {"commands.md": commands_page, "public-names.md": names_page}


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page())
        print(FOLDER.relative_to(ROOT) / name)
    print(f"{len(COMMANDS)} commands")
