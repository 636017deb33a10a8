"""Plan of a scene within a tolerance: its tiers and meshes, and the effects that are left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from sim.device import check_device
from sim.errors import SceneError, check_kind
from sim.fem import Fem
from sim.layer import Layer
from sim.metrics import tolerance_of
from sim.result import ContactTier, Result
from sim.scene import Scene
from sim.tiers import seconds_of

if TYPE_CHECKING:
    from sim.needed import EffectsPlan

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Plan:
    """Way to simulate a scene within a tolerance; printed, it is a few lines."""

    scene: Scene
    """Scene with all its effects."""
    tolerance: str
    """Largest accepted error."""
    only: ContactTier | None = None
    """Only tier that is tried; None: `layer`, if its estimate was checked on such scenes, then
    `fem`."""
    effects: EffectsPlan | None = None
    """Influence of the effects, and those that are left out; None: all are kept."""
    device: str = "cpu"
    """Device of the meshes."""

    @property
    def tiers(self) -> tuple[Layer | Fem, ...]:
        """Tiers that are tried in turn, the coarser of two meshes first.

        `layer` is the last one if its estimate is within the tolerance. Finer meshes follow if the
        error measured by the first two is not.
        """
        from sim.tolerance import COMPANION, first_mesh, layer_may_do

        scene, only, wanted = self.scene, self.only, tolerance_of(self.tolerance)
        if self.effects is not None and self.effects.omitted:
            scene, only = self.effects.needed, only or "fem"
            wanted = tolerance_of(self.effects.rest)
        tiers: list[Layer | Fem] = []
        if only == "layer" or (only is None and layer_may_do(scene, wanted)):
            tiers.append(Layer())
        if only != "layer":
            fine = first_mesh(scene, wanted, self.device)
            tiers += [replace(fine, fineness=fine.fineness / COMPANION), fine]
        return tuple(tiers)

    def run(self, *, progress: Progress | None = None) -> Result:
        """Simulate; `record["error"]` and `record["plan"]` have the error and the attempts.

        With planned effects `record["effects"]` is their plan, and the result's scene has those
        that are kept.

        Args:
            progress: Called with the fraction done, 0 to 1, of `layer` and each mesh in turn.

        Raises:
            SceneError: A tier does not support the scene, or the tolerance cannot be reached.
            SimulationDiverged: No converged state was found; nothing unconverged is returned.
        """
        if self.effects is not None:
            from sim.needed import simulate_needed

            return simulate_needed(
                self.effects, self.tolerance, tier=self.only, device=self.device, progress=progress
            )
        from sim.tolerance import simulate_within

        return simulate_within(
            self.scene, self.tolerance, tier=self.only, device=self.device, progress=progress
        )

    def __str__(self) -> str:
        """Return the tolerance, the effects, and each tier with its mesh and approximate time."""
        from sim.fem.mesh import meshes_of

        scene = self.scene if self.effects is None else self.effects.needed
        solved = ", ".join(scene.effects.key) or "none"
        lines = [f"error of up to {self.tolerance}; effects solved: {solved}"]
        if self.effects is not None and self.effects.effects:
            lines.append(str(self.effects))
        for tier in self.tiers:
            mesh = None
            if isinstance(tier, Layer):
                line = "layer, if its estimated error is small enough"
            else:
                (mesh,) = meshes_of([scene], tier)
                line = f"fem, {' x '.join(map(str, mesh.cells))} elements"
            if self.device == "cpu" or isinstance(tier, Layer):
                line += f": {seconds_of(scene, tier, mesh):.1g} s or more"
            lines.append(line)
        if self.only != "layer":
            lines.append("finer meshes of fem, if the error measured by these two is larger")
        return "\n".join(lines)


def plan(
    scene: Scene,
    tolerance: str,
    *,
    only: ContactTier | None = None,
    effects: Literal["all", "needed"] = "all",
    device: str = "cpu",
    progress: Progress | None = None,
) -> Plan:
    """Return the way to simulate a scene within a tolerance; `plan(...).run()` simulates it.

    `layer` is used if its estimate is below the tolerance and was checked for such scenes.
    Otherwise meshes of `fem` are refined until the error measured by two of them is below
    (`sim.tolerance`).

    Args:
        scene: Scene to simulate.
        tolerance: Such as "2 %", "0.05 N", "0.5 px".
        only: `layer` or `fem`: only that tier is tried.
        effects: `needed`: leave out effects as far as the tolerance allows, a third of it at most.
            Probes on coarse meshes are solved now to find them (`sim.needed`).
        device: Device of probes and meshes, `cpu` or `cuda:0` and the like.
        progress: Called with the fraction done, 0 to 1, of the probes.

    Raises:
        SceneError: The scene or the tolerance is invalid, or the device does not exist.
    """
    check_kind("scene", scene, Scene, "a Scene")
    tolerance_of(tolerance)
    for name, value, allowed in (
        ("only", only, (None, "layer", "fem")),
        ("effects", effects, ("all", "needed")),
    ):
        if value not in allowed:
            raise SceneError(f"{name}: {value!r}; allowed: {', '.join(map(repr, allowed))}")
    if device != "cpu":
        check_device(device)
    influence = None
    if effects == "needed":
        influence = plan_effects(scene, tolerance, device=device, progress=progress)
    return Plan(scene, tolerance, only, influence, device)


def plan_effects(
    scene: Scene,
    tolerance: str | None = None,
    *,
    device: str = "cpu",
    progress: Progress | None = None,
) -> EffectsPlan:
    """Return the influence of each effect; with a tolerance also those that may be left out.

    Printed, it is a table; `record()` returns it as JSON values. Only probes on coarse meshes are
    solved, one for each effect and one with all of them (`sim.needed`).

    Args:
        scene: Scene with the effects in question.
        tolerance: Such as "2 %", "0.05 N", "0.5 px", of which left-out effects may use a third.
        device: Device of the probes.
        progress: Called with the fraction done, 0 to 1.

    Raises:
        SceneError: The scene or the tolerance is invalid, or the device does not exist.
    """
    from sim.needed import plan_many

    return plan_many([scene], tolerance=tolerance, device=device, progress=progress)[0]
