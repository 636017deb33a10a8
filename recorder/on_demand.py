"""Public names of packages that import each of them when it is first used."""

from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any


def imports_on_demand(
    package: str, file: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the `__getattr__` and `__dir__` of the package whose `__init__.py` is `file`.

    Its public names are those that it imports under `if TYPE_CHECKING`. That block is read at the
    first use, so that one line serves both type checkers and the interpreter.
    """

    @cache
    def modules() -> dict[str, str]:
        import ast

        return {
            alias.name: str(statement.module)
            for block in ast.parse(Path(file).read_bytes()).body
            if isinstance(block, ast.If)
            for statement in block.body
            if isinstance(statement, ast.ImportFrom)
            for alias in statement.names
        }

    def names() -> list[str]:
        return sorted(modules())

    def attribute(name: str) -> Any:
        if name == "__all__":
            return names()
        if name not in modules():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(modules()[name]), name)

    return attribute, names
