"""Parts of the solver in another build, for as long as a context lasts."""

from __future__ import annotations

import inspect
import linecache
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any


@contextmanager
def in_place_of(owner: Any, name: str, value: Any) -> Iterator[None]:
    """While it is open, the attribute `name` of a module is `value`."""
    own = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, own)


def rebuilt(module: ModuleType, suffix: str, change: Callable[[str], str]) -> ModuleType:
    """A module built from the changed source of another, which stays as it is.

    Args:
        module: Whose source is changed.
        suffix: What tells the name of the new module from that of the other.
        change: Gives the new source.
    """
    source = change(inspect.getsource(module))
    made = ModuleType(f"{module.__name__}_{suffix}")
    file = f"{made.__name__}.py"
    # Warp reads a kernel's source through `inspect`, which looks here before it looks for a file.
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    # Annotations must stay values: no inheriting of this file's __future__ imports.
    exec(compile(source, file, "exec", dont_inherit=True), made.__dict__)
    return made
