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
    from sim.fem.newton import Newton
    from sim.fem.state import State

    begin, begin_step = Newton.begin, State.begin_step

    def here(self: Any, chosen: Any, tolerance: Any, *, predict: Any) -> None:
        begin(self, chosen, tolerance, predict=np.zeros_like(predict))

    def from_last(self: Any, chosen: Any, tip: Any, duration: Any, guess: Any) -> None:
        begin_step(self, chosen, tip, duration, np.zeros_like(guess))

    with _in_place_of(Newton, "begin", here), _in_place_of(State, "begin_step", from_last):
        yield


@contextlib.contextmanager
def without_keeping() -> Iterator[None]:
    """Every iteration of Newton's assembles the elastic part of its tangent."""
    from sim.fem import newton

    with _in_place_of(newton, "ELASTIC_EVERY", {"cpu": 1, "cuda": 1}):
        yield


@contextlib.contextmanager
def without_graphs() -> Iterator[None]:
    """Every kernel of conjugate gradients is launched by itself."""
    from sim.fem.cg import ConjugateGradient

    init = ConjugateGradient.__init__

    def unrecorded(self: Any, *args: Any, **options: Any) -> None:
        init(self, *args, **{**options, "record": False})

    with _in_place_of(ConjugateGradient, "__init__", unrecorded):
        yield


@contextlib.contextmanager
def without_gathering() -> Iterator[None]:
    """Every iteration of conjugate gradients launches threads for all environments."""
    from sim.fem.cg import ConjugateGradient

    gather = ConjugateGradient._gather

    def all_rows(self: Any, running: Any, *, anew: bool = False) -> None:
        self._gathers = False
        gather(self, running, anew=anew)

    with _in_place_of(ConjugateGradient, "_gather", all_rows):
        yield


@contextlib.contextmanager
def without_rounding() -> Iterator[None]:
    """Products read the tangent as it was assembled."""
    from sim.fem.stencil import Stencil

    init = Stencil.__init__

    def whole(self: Any, *args: Any, **options: Any) -> None:
        init(self, *args, **{**options, "half": False})

    with _in_place_of(Stencil, "__init__", whole):
        yield


@contextlib.contextmanager
def _in_place_of(owner: Any, name: str, value: Any) -> Iterator[None]:
    own = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, own)
