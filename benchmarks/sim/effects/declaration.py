"""Arrays and kernel code of each effect, to state its cost and verify its absence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sim.scene import Friction, Gravity, Inertia, Viscosity

Per = Literal[
    "environment", "node", "element", "Gauss point", "contact point",
    "branch and element", "branch and Gauss point",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Memory:
    """Array that tier `fem` keeps for an effect; its length is zero when the effect is off."""

    name: str
    """Path of the attribute, relative to the solver's `State`."""
    per: Per
    """Entity that each entry belongs to."""
    numbers: int
    """Number of values per entry."""


@dataclass(frozen=True, slots=True)
class Snippet:
    """Location of an effect's code in kernels: a kernel factory and its flag.

    In the factory's source it consists of the blocks `if wp.static(FLAG):`, without an `else`.
    Removing them gives the kernel without the effect.
    """

    module: str
    """Module of the factory."""
    factory: str
    """Name of the factory."""
    flag: str
    """Argument of the factory that compiles the code in."""
    user: str = "sim.fem.assembly"
    """Module that calls the factory."""


@dataclass(frozen=True, slots=True)
class Declaration:
    """Additions of an effect to tier `fem`."""

    kind: type[Friction] | type[Gravity] | type[Inertia] | type[Viscosity]
    state: tuple[Memory, ...]
    """Arrays that the tier keeps for it."""
    kernels: tuple[Snippet, ...]
    """Its code in kernels."""
    limit: str
    """Limit that it approaches as it gets weaker."""


# Effects by their names in `sim.scene.Effects`.
EFFECTS = {
    "friction": Declaration(
        Friction,
        (
            Memory("contact.traction", "contact point", 3),
            Memory("contact.traction_old", "contact point", 3),
            Memory("contact.limit", "contact point", 1),
            Memory("_limit_relaxed", "contact point", 1),
        ),
        (
            Snippet("sim.fem.contact", "contact_kernels", "friction"),
            Snippet("sim.fem.balance", "work_kernel", "friction"),
            Snippet("sim.fem.balance", "reading_kernels", "friction"),
        ),
        "coefficient -> 0: frictionless contact",
    ),
    "viscosity": Declaration(
        Viscosity,
        (
            Memory("_branches.arrays.history", "Gauss point", 9),
            Memory("_branches.arrays.bulk_history", "element", 1),
            Memory("_branches.arrays.rest", "Gauss point", 9),
            Memory("_branches.arrays.bulk_rest", "element", 1),
            Memory("_branches.arrays.branch", "branch and Gauss point", 9),
            Memory("_branches.arrays.bulk_branch", "branch and element", 1),
        ),
        (
            Snippet("sim.fem.element", "element_kernels", "viscous"),
            Snippet("sim.fem.element", "element_rows_kernel", "viscous", "sim.fem.matrix"),
            Snippet("sim.fem.lanes", "forces_kernel", "viscous"),
            Snippet("sim.fem.lanes", "blocks_kernel", "viscous", "sim.fem.matrix"),
        ),
        "ratios -> 0: an elastic body",
    ),
    "inertia": Declaration(
        Inertia,
        (
            Memory("predicted", "node", 3),
            Memory("inertia_rate", "environment", 1),
        ),
        (
            Snippet("sim.fem.balance", "residual_kernel", "inertia"),
            Snippet("sim.fem.balance", "reading_kernels", "inertia"),
        ),
        "scale -> 0: a massless body",
    ),
    "gravity": Declaration(
        Gravity,
        (Memory("weight", "environment", 3),),
        (
            Snippet("sim.fem.balance", "residual_kernel", "gravity"),
            Snippet("sim.fem.balance", "reading_kernels", "gravity"),
        ),
        "acceleration -> 0: a weightless body",
    ),
}
