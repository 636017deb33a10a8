"""Ablations: the solver without one of its optimisations, inside a context."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks.sim.substitute import in_place_of


@contextlib.contextmanager
def without_prediction() -> Iterator[None]:
    """Start every step at the last state, without prediction by the last change or the tangent.

    Both are arguments of methods that the solver calls, but that a caller cannot reach.
    """
    from sim.fem import assembly, stepping
    from sim.fem.assembly import SolverState
    from sim.fem.newton import Newton

    class FromLast(SolverState):
        """State that begins each step with the displacement at the end of the last one."""

        def begin_step(self, chosen: Any, tip: Any, duration: Any, guess: Any) -> None:
            super().begin_step(chosen, tip, duration, np.zeros_like(guess))

    class WithTheTip(Newton):
        """Newton's method that begins each step at its tip, without a tangent predictor."""

        def begin(self, chosen: Any, tolerance: Any, *, predict: Any, patience: Any) -> None:
            super().begin(chosen, tolerance, predict=np.zeros_like(predict), patience=patience)

    with (
        in_place_of(assembly, "SolverState", FromLast),
        in_place_of(stepping, "Newton", WithTheTip),
    ):
        yield


def without_graphs() -> contextlib.AbstractContextManager[None]:
    """Launch every kernel of conjugate gradients separately."""
    from sim.fem import newton

    return _made_with(newton, "ConjugateGradient", record=False)


def without_gathering() -> contextlib.AbstractContextManager[None]:
    """Launch threads for all environments in every iteration of conjugate gradients."""
    from sim.fem import newton

    return _made_with(newton, "ConjugateGradient", gather=False)


def without_rounding() -> contextlib.AbstractContextManager[None]:
    """Compute products with the tangent as it was assembled."""
    from sim.fem import assembly

    return _made_with(assembly, "BlockMatrix", half=False)


def _made_with(
    user: ModuleType, name: str, **always: Any
) -> contextlib.AbstractContextManager[None]:
    """Construct this class in the module always with these arguments, overriding others."""
    kind = getattr(user, name)

    def made(*args: Any, **options: Any) -> Any:
        return kind(*args, **{**options, **always})

    return in_place_of(user, name, made)
