"""Builds of the solver that never had an effect: its lines cut out of the kernels' source."""

from __future__ import annotations

import ast
import importlib
import inspect
import linecache
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from types import ModuleType
from typing import Any

from sim.effects import Friction, Gravity, Inertia, Viscosity
from sim.effects.declaration import Snippet

EFFECTS: dict[str, type[Friction] | type[Gravity] | type[Inertia] | type[Viscosity]] = {
    "friction": Friction,
    "viscosity": Viscosity,
    "inertia": Inertia,
    "gravity": Gravity,
}
"""The effects by the names they have in `Effects`."""


def cut(source: str, flag: str) -> str:
    """The source without its blocks `if wp.static(FLAG):`.

    Raises:
        ValueError: No such block, or one with an `else`: cutting would take away more than the
            effect.
    """
    blocks = [
        node
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.If) and ast.unparse(node.test) == f"wp.static({flag})"
    ]
    if not blocks:
        raise ValueError(f"no block `if wp.static({flag}):` to cut")
    lines = source.splitlines(keepends=True)
    for block in blocks:
        if block.orelse or block.end_lineno is None:
            raise ValueError(f"line {block.lineno}: `if wp.static({flag}):` has an `else`")
        for line in range(block.lineno - 1, block.end_lineno):
            lines[line] = ""
    return "".join(lines)


@cache
def cut_factory(snippet: Snippet) -> Callable[..., Any]:
    """The kernel factory of a snippet, built from source that never had the snippet."""
    source = cut(inspect.getsource(importlib.import_module(snippet.module)), snippet.flag)
    module = ModuleType(f"{snippet.module}_without_{snippet.flag}")
    file = f"{module.__name__}.py"
    # Warp reads a kernel's source through `inspect`, which looks here before it looks for a file.
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    # Annotations must stay values: no inheriting of this file's __future__ imports.
    exec(compile(source, file, "exec", dont_inherit=True), module.__dict__)
    factory: Callable[..., Any] = getattr(module, snippet.factory)
    return factory


@contextmanager
def built_without(effect: str) -> Iterator[None]:
    """While it is open, every batch is solved by kernels that never had `effect`."""
    snippets = [
        (snippet, importlib.import_module(snippet.user)) for snippet in EFFECTS[effect].KERNELS
    ]
    kept = [getattr(user, snippet.factory) for snippet, user in snippets]
    try:
        for snippet, user in snippets:
            setattr(user, snippet.factory, cut_factory(snippet))
        yield
    finally:
        for (snippet, user), factory in zip(snippets, kept, strict=True):
            setattr(user, snippet.factory, factory)
