"""The solver without one of its steps, for as long as a context lasts."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks.sim.substitute import in_place_of


@contextlib.contextmanager
def without_prediction() -> Iterator[None]:
    """Every step begins at the last state: no share of the last change, no way along the tangent.

    Both are arguments of methods that the solver calls, but of none that a caller can reach.
    """
    from sim.fem import assembly, solver
    from sim.fem.assembly import State
    from sim.fem.newton import Newton

    class FromLast(State):
        """Begins each step with the displacement that the last one ended with."""

        def begin_step(self, chosen: Any, tip: Any, duration: Any, guess: Any) -> None:
            super().begin_step(chosen, tip, duration, np.zeros_like(guess))

    class WithTheTip(Newton):
        """Begins each step where its tip ends, and follows no tip along the tangent."""

        def begin(self, chosen: Any, tolerance: Any, *, predict: Any) -> None:
            super().begin(chosen, tolerance, predict=np.zeros_like(predict))

    with in_place_of(assembly, "State", FromLast), in_place_of(solver, "Newton", WithTheTip):
        yield


def without_keeping() -> contextlib.AbstractContextManager[None]:
    """Every iteration of Newton's assembles the elastic part of its tangent."""
    from sim.fem import assembly

    return _made_with(assembly, "Stencil", keep=False)


def without_graphs() -> contextlib.AbstractContextManager[None]:
    """Every kernel of conjugate gradients is launched by itself."""
    from sim.fem import newton

    return _made_with(newton, "ConjugateGradient", record=False)


def without_gathering() -> contextlib.AbstractContextManager[None]:
    """Every iteration of conjugate gradients launches threads for all environments."""
    from sim.fem import newton

    return _made_with(newton, "ConjugateGradient", gather=False)


def without_rounding() -> contextlib.AbstractContextManager[None]:
    """Products read the tangent as it was assembled."""
    from sim.fem import assembly

    return _made_with(assembly, "Stencil", half=False)


def _made_with(
    user: ModuleType, name: str, **always: Any
) -> contextlib.AbstractContextManager[None]:
    """What a module makes of this class has these arguments, whatever else is asked for."""
    kind = getattr(user, name)

    def made(*args: Any, **options: Any) -> Any:
        return kind(*args, **{**options, **always})

    return in_place_of(user, name, made)
