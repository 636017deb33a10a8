"""The solver without one of its steps, for as long as a context lasts."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np


@contextlib.contextmanager
def without_prediction() -> Iterator[None]:
    """Every step begins at the last state: no share of the last change, no way along the tangent.

    Both are arguments of methods that the solver calls, but of none that a caller can reach.
    """
    from sim.fem.assembly import State
    from sim.fem.newton import Newton

    begin, begin_step = Newton.begin, State.begin_step

    def here(self: Any, chosen: Any, tolerance: Any, *, predict: Any) -> None:
        begin(self, chosen, tolerance, predict=np.zeros_like(predict))

    def from_last(self: Any, chosen: Any, tip: Any, duration: Any, guess: Any) -> None:
        begin_step(self, chosen, tip, duration, np.zeros_like(guess))

    with _in_place_of(Newton, "begin", here), _in_place_of(State, "begin_step", from_last):
        yield


def without_keeping() -> contextlib.AbstractContextManager[None]:
    """Every iteration of Newton's assembles the elastic part of its tangent."""
    from sim.fem.matrix import Stencil

    return _made_with(Stencil, keep=False)


def without_graphs() -> contextlib.AbstractContextManager[None]:
    """Every kernel of conjugate gradients is launched by itself."""
    from sim.fem.cg import ConjugateGradient

    return _made_with(ConjugateGradient, record=False)


def without_gathering() -> contextlib.AbstractContextManager[None]:
    """Every iteration of conjugate gradients launches threads for all environments."""
    from sim.fem.cg import ConjugateGradient

    return _made_with(ConjugateGradient, gather=False)


def without_rounding() -> contextlib.AbstractContextManager[None]:
    """Products read the tangent as it was assembled."""
    from sim.fem.matrix import Stencil

    return _made_with(Stencil, half=False)


def _made_with(kind: type, **always: Any) -> contextlib.AbstractContextManager[None]:
    """Every object of this kind is made with these arguments, whatever else is asked for."""
    init = kind.__init__  # type: ignore[misc]

    def made(self: Any, *args: Any, **options: Any) -> None:
        init(self, *args, **{**options, **always})

    return _in_place_of(kind, "__init__", made)


@contextlib.contextmanager
def _in_place_of(owner: Any, name: str, value: Any) -> Iterator[None]:
    own = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, own)
