"""A scene: everything that decides what a simulation gives, as one frozen value."""

from __future__ import annotations

from dataclasses import dataclass, field

from sim.body import Body
from sim.effects import Effects
from sim.errors import SceneError
from sim.indenters import Indenter
from sim.motion import Motion


@dataclass(frozen=True, slots=True)
class Scene:
    """One rigid indenter, one soft body, one motion, and the effects that are asked for.

    Raises:
        SceneError: The tip goes deeper than 90 % of the thickness, or than an indenter from a file
            is known.
    """

    indenter: Indenter
    motion: Motion
    body: Body = field(default_factory=Body)
    effects: Effects = field(default_factory=Effects)

    def __post_init__(self) -> None:
        limit = 0.9 * self.body.thickness
        if self.motion.depth_max > limit:
            raise SceneError(
                f"motion: {self.motion.depth_max * 1e3:.4g} mm deep into a body "
                f"{self.body.thickness * 1e3:.4g} mm thick; allowed: up to {limit * 1e3:.4g} mm "
                "(are the units metres?)"
            )
        solid = self.indenter.solid
        if solid is not None and self.motion.depth_max > solid.reach:
            raise SceneError(
                f"motion: {self.motion.depth_max * 1e3:.4g} mm deep with an indenter known up to "
                f"{solid.reach * 1e3:.4g} mm; allowed: as far as that (from_stl(reach=...) reads "
                "more of it)"
            )
