"""Solver builds with deliberate bugs, and the cases that must detect them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks.sim.substitute import in_place_of, rebuilt

# The fastest cases that detect each bug, which `--planted all` runs.
DETECTING_CASES: dict[str, tuple[str, ...]] = {
    "full-integration": ("poisson-0-49",),
    "nodal-contact": ("flat-punch-between-bounds", "flat-punch-off-the-grid"),
    "lagged-friction": ("lifted-while-it-slips", "full-stick-stiffens"),
    "energy-line-search": ("float32-reaches-its-tolerance",),
}

MISTAKES = tuple(DETECTING_CASES)

WHAT: dict[str, str] = {
    "full-integration": "volume change at every Gauss point, so elements lock near nu = 0.5",
    "nodal-contact": "contact detected at nodes only",
    "lagged-friction": "friction limit from the previous step",
    "energy-line-search": "steps accepted by a decrease of the energy",
}

# A module of the solver, a name in it, and the replacement of that object.
Part = tuple[ModuleType, str, Any]

# Lines of modules of the solver and their replacements: each once, in the forces the pressure of
# each Gauss point instead of the element's, and in the tangent its derivative.
_FULL_INTEGRATION = {
    "sim.fem.element": (
        (
            "            energy += w * half * (g * square - three * shear)\n",
            "            energy += w * half * (g * square - three * shear)\n"
            "            pressure = half * bulk * less * (two + less) / j\n",
        ),
        # `of_mean` gives the bulk modulus where `at_point` uses the pressure.
        (
            "        return pressure, stiffness / volume\n",
            "        return bulk, real(0.0)\n",
        ),
        (
            "        f, c, _less, j, square = deformed(h)\n",
            "        f, c, less, j, square = deformed(h)\n",
        ),
        (
            "        mixed = w * over * five_thirds * square / j\n",
            "        mixed = w * over * five_thirds * square / j\n"
            "        mixed += w * half * pressure * (one + one / (j * j))\n",
        ),
        (
            "turning = pressure - over * square\n",
            "turning = half * pressure * less * (two + less) / j - over * square\n",
        ),
    ),
    "sim.fem.lanes": (
        (
            "        energy += w[q] * half * (g * square - 3 * material.shear.data[env]);\n",
            "        energy += w[q] * half * (g * square - 3 * material.shear.data[env]);\n"
            "        pressure = half * stiff * less[q] * (2 + less[q]) / j;\n",
        ),
        ("    stiffness /= volume;\n", "    stiffness = 0;\n"),
        (
            "        const wide mixed = w[q] * over * number(5.0 / 3.0) * square / j;\n",
            "        const wide mixed = w[q] * over * number(5.0 / 3.0) * square / j\n"
            "                         + w[q] * half * stiff * (1 + 1 / (j * j));\n",
        ),
        (
            "        wide turning = pressure - over * square;\n",
            "        wide turning = half * stiff * less[q] * (2 + less[q]) / j - over * square;\n",
        ),
    ),
}


@cache
def fully_integrated(name: str) -> ModuleType:
    """Return a module of the solver with the volume change of each Gauss point.

    `name` is that of the module.

    Raises:
        ValueError: Lines to be changed are not in its source.
    """

    def change(source: str) -> str:
        for right, wrong in _FULL_INTEGRATION[name]:
            if source.count(right) != 1:
                raise ValueError(f"{name}: {right.strip()!r} does not occur once")
            source = source.replace(right, wrong)
        return source

    return rebuilt(import_module(name), "fully_integrated", change)


def _full_integration() -> list[Part]:
    from sim.fem import assembly, matrix

    return [
        (user, factory, getattr(fully_integrated(name), factory))
        for user, name, factory in (
            (assembly, "sim.fem.element", "element_kernels"),
            (assembly, "sim.fem.lanes", "forces_kernel"),
            (matrix, "sim.fem.element", "element_rows_kernel"),
            (matrix, "sim.fem.lanes", "blocks_kernel"),
        )
    ]


def _nodal_contact() -> list[Part]:
    from sim.fem import assembly

    def corners(_points: int) -> tuple[Any, Any]:
        return np.eye(4), np.ones(4)

    return [(assembly, "face_rule", corners)]


def _lagged_friction() -> list[Part]:
    from sim.fem import stepping
    from sim.fem.newton import Newton

    class Lagged(Newton):
        """Newton's method that sets the friction limit only at the start of a step."""

        def __init__(self, assembly: Any) -> None:
            super().__init__(assembly)
            self._friction = False
            self._rubs = "friction" in assembly.effects

        def begin(self, chosen: Any, tolerance: Any, **how: Any) -> None:
            if self._rubs and chosen.any():
                self._assembly.state.settle_limit(self._mask(chosen))
            super().begin(chosen, tolerance, **how)

    return [(stepping, "Newton", Lagged)]


def _energy_line_search() -> list[Part]:
    from sim.fem import stepping
    from sim.fem.newton import Newton

    class ByEnergy(Newton):
        """Newton's method that accepts energy decreases, which rounding hides at the end."""

        def _search(self, active: Any, running: Any, predicting: Any, slope: Any) -> Any:
            self._before = self._energy()
            return super()._search(active, running, predicting, slope)

        def _walk(self, trying: Any, length: Any) -> None:
            self._length = length
            super()._walk(trying, length)

        def _eased(self, _sums: Any, slope: Any) -> Any:
            return self._energy() <= self._before + 1e-4 * self._length * slope

        def _energy(self) -> Any:
            """Return the energy of elements and contact springs by environment, without weight."""
            assembly: Any = self._assembly
            fractions = assembly.element_energy, assembly.state.contact.energy
            return sum(fraction.numpy().sum(axis=1, dtype=float) for fraction in fractions)

    return [(stepping, "Newton", ByEnergy)]


_PARTS: dict[str, Callable[[], list[Part]]] = {
    "full-integration": _full_integration,
    "nodal-contact": _nodal_contact,
    "lagged-friction": _lagged_friction,
    "energy-line-search": _energy_line_search,
}


@contextmanager
def planted(mistake: str | None) -> Iterator[None]:
    """Inject the bug into this process's solver inside the context; with None, do nothing.

    Raises:
        ValueError: Unknown bug.
    """
    if mistake is not None and mistake not in _PARTS:
        raise ValueError(f"no mistake is called {mistake!r}; known: {', '.join(MISTAKES)}")
    with ExitStack() as open_:
        for part in _PARTS[mistake]() if mistake is not None else ():
            open_.enter_context(in_place_of(*part))
        yield
