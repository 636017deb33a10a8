"""Write docs/reference from the table of commands and the packages' docstrings: `make reference`.

Packages are parsed, not imported: public names are those in the `__all__` of a package.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tactile.commands import COMMANDS, EXTRAS, GROUPS, Command  # noqa: E402

FOLDER = ROOT / "docs" / "reference"
# Longest value [characters] that is shown for a name without a description.
SHORT = 60
PACKAGES = ("trajectories", "recorder", "rig", "sim", "learning", "tactile")
ABOUT_COMMANDS = """\
# Commands

Generated from `tactile/commands.py` by `make reference`.

`tactile --help` lists all commands, `tactile COMMAND --help` the options of one with their units.
`tactile COMMAND` and the command in the third column are equivalent in options, messages and exit
codes. `python -m tactile` is `tactile`. Files are read from and written to the current folder;
`tactile init DIR` creates a suitable one. Benchmarks have a separate command, in a checkout:
`python -m benchmarks`.

`extra` is the extra that a command needs: `pip install 'tactile-rig[EXTRA]'`. If it is missing, the
command prints this and ends with exit code 2."""
EXIT_CODES = """
## Exit codes
| code | meaning |
|---|---|
| 0 | success |
| 1 | a check found problems, a comparison differs, a simulation has no solution |
| 2 | invalid input: an unknown command or option, an unusable file, a missing extra |
| 3 | a device was lost |
| 4 | a safety stop |
| 130 | interrupted |"""
ABOUT_NAMES = """\
# Public names

Generated from the packages by `make reference`: the names in the `__all__` of each. All other names
may change without notice. All quantities are in SI units unless a name states otherwise. Every
package has a `py.typed` file with which mypy and editors find the types."""


def commands_page() -> str:
    """Return the page of commands."""
    lines = [ABOUT_COMMANDS]
    for title, commands in GROUPS.items():
        lines += ["", f"## {title}", "| command | description | equivalent | extra |"]
        lines += ["|---|---|---|---|", *(_row(command) for command in commands)]
    lines.append(EXIT_CODES)
    return "\n".join(lines) + "\n"


def _row(command: Command) -> str:
    door = f"`{command.door}`" if command.package != "tactile" else ""
    extra = command.extra or EXTRAS[command.package]
    return f"| `tactile {command.words}` | {command.help} | {door} | {extra} |"


def names_page() -> str:
    """Return the page of all public names, with the first line of each description."""
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
                lines += ["", "No public names."]
    return "\n".join(lines) + "\n"


def _exported(path: Path) -> list[str]:
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and any(
            isinstance(target, ast.Name) and target.id == "__all__" for target in node.targets
        ):
            return sorted(ast.literal_eval(node.value), key=str.lower)
    return []


def _told(path: Path, name: str) -> str:
    """Return the first line of a name's docstring, wherever the name is defined."""
    for node in ast.walk(ast.parse(path.read_text())):
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
    """Return the comment directly above an assignment."""
    told: list[str] = []
    for line in reversed(path.read_text().splitlines()[: node.lineno - 1]):
        if not line.startswith("#"):
            break
        told.insert(0, line.removeprefix("#").strip())
    return _line("\n".join(told))


def _value(node: ast.Assign | ast.AnnAssign) -> str:
    """Return the value if it is short."""
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
