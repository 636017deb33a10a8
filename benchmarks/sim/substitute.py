"""Temporary replacement of parts of the solver by another build."""

from __future__ import annotations

import inspect
import linecache
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any


@contextmanager
def in_place_of(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Replace the attribute `name` of a module by `value` inside the context."""
    own = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, own)


def rebuilt(module: ModuleType, suffix: str, change: Callable[[str], str]) -> ModuleType:
    """Return a module built from the changed source of another, which is not modified.

    Args:
        module: Module whose source is changed.
        suffix: Suffix of the new module's name.
        change: Maps the source to the new source.
    """
    source = change(inspect.getsource(module))
    made = ModuleType(f"{module.__name__}_{suffix}")
    file = f"{made.__name__}.py"
    # Warp reads a kernel's source through `inspect`, which checks this cache before files.
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    # Annotations must stay values, so do not inherit this file's __future__ imports.
    exec(compile(source, file, "exec", dont_inherit=True), made.__dict__)
    return made
