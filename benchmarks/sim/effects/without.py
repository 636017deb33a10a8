"""Builds of the solver without an effect, whose lines are cut out of the kernels' source."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any

from benchmarks.sim.effects.declaration import EFFECTS, Snippet
from benchmarks.sim.substitute import in_place_of, rebuilt


def cut(source: str, flag: str) -> str:
    """Return the source without its blocks `if wp.static(FLAG):`.

    Raises:
        ValueError: No such block, or one with an `else`, where cutting would remove more than the
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
    """Return the kernel factory of a snippet, built from source without the snippet."""
    module = rebuilt(
        importlib.import_module(snippet.module),
        f"without_{snippet.flag}",
        lambda source: cut(source, snippet.flag),
    )
    factory: Callable[..., Any] = getattr(module, snippet.factory)
    return factory


@contextmanager
def built_without(effect: str) -> Iterator[None]:
    """Solve every batch inside the context with kernels that were built without `effect`."""
    with ExitStack() as open_:
        for snippet in EFFECTS[effect].kernels:
            user = importlib.import_module(snippet.user)
            open_.enter_context(in_place_of(user, snippet.factory, cut_factory(snippet)))
        yield
