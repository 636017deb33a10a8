"""What a planner can choose: the tier, the mesh, the precision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from sim.body import Body
from sim.errors import SceneError

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics

LADDER = (3, 4, 5, 6, 8)
"""Meshes of `fem`, as elements that one thickness is long: an element is thickness / cells."""
COARSER_BY = 1.3
"""An error bar comes from a mesh with elements at least so much larger."""
LAYER_COMPANION = 4
"""The mesh of `fem` that an error bar of `layer` comes from."""


@dataclass(frozen=True, slots=True, order=True)
class Choice:
    """One way to solve a scene. `mpm` is none: `fem` is faster at every error."""

    tier: Literal["layer", "fem"]
    cells: int = 0
    """Elements that one thickness is long; 0 for `layer`."""
    precision: Literal["float32", "float64"] = "float32"
    """float32 goes on in float64 by itself where it must."""

    def __str__(self) -> str:
        """In words."""
        if self.tier == "layer":
            return "layer"
        return f"fem, element 1/{self.cells} of the thickness, {self.precision}"

    def numerics(self, body: Body) -> Numerics | None:
        """The settings of `fem` for a body; None for `layer`."""
        if self.tier == "layer":
            return None
        from sim.fem.numerics import Numerics

        precision: Literal["auto", "float64"] = "auto" if self.precision == "float32" else "float64"
        return Numerics(spacing=body.thickness / self.cells, precision=precision)


def all_choices() -> list[Choice]:
    """Every choice there is, the two precisions of a mesh side by side."""
    meshes = [Choice("fem", cells, p) for cells in LADDER for p in ("float32", "float64")]
    return [Choice("layer"), *meshes]


def companion(choice: Choice) -> Choice:
    """The other mesh that an error bar of `choice` is made with.

    Raises:
        SceneError: There is no coarser mesh.
    """
    if choice.tier == "layer":
        return Choice("fem", LAYER_COMPANION)
    coarser = [cells for cells in LADDER if cells * COARSER_BY <= choice.cells]
    if not coarser:
        raise SceneError(
            f"error_bar: {choice}; allowed: {COARSER_BY * LADDER[0]:.2g} elements or more in a "
            "thickness, so that there is a coarser mesh"
        )
    return Choice("fem", max(coarser))
