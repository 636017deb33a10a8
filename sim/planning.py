"""Plan of a scene within a tolerance: its tiers and meshes."""

from dataclasses import dataclass, replace
from typing import get_args

from sim.arrays import Progress
from sim.device import check_device
from sim.errors import check_choice, check_kind, check_range
from sim.fem import Fem
from sim.layer import Layer
from sim.metrics import tolerance_of
from sim.result import ContactTier, Result
from sim.scene import Scene

# CPU time of a press by `layer`, and of each of its frames [s].
SECONDS_LAYER, SECONDS_LAYER_FRAME = 0.2, 0.015
# CPU time per element and Newton iteration [s], and iterations per step. 20 presses with friction
# took 5 to 20 iterations, and 5 to 10 us per element. Most scenes take one to six times as long.
SECONDS_ITERATION, ITERATIONS = 6e-6, 8


@dataclass(frozen=True, slots=True)
class Plan:
    """Way to simulate a scene within a tolerance; printed, it is a few lines."""

    scene: Scene
    tolerance: str
    """Largest accepted error."""
    only: ContactTier | None = None
    """Only tier that is tried; None: `layer`, if its estimate was checked on such scenes, then
    `fem`."""
    device: str = "cpu"
    """Device of the meshes."""
    seconds: float | None = None
    """Time after which the best result so far is returned; None: no limit."""

    @property
    def tiers(self) -> tuple[Layer | Fem, ...]:
        """Tiers that are tried in turn, the coarser of two meshes first.

        `layer` is the last one if its estimate is within the tolerance. Finer meshes follow if the
        error measured by the first two is not.
        """
        from sim.tolerance import COMPANION, first_mesh, layer_may_do

        scene, only, wanted = self.scene, self.only, tolerance_of(self.tolerance)
        tiers: list[Layer | Fem] = []
        if only == "layer" or (only is None and layer_may_do(scene, wanted)):
            tiers.append(Layer())
        if only != "layer":
            fine = first_mesh(scene, wanted, self.device)
            tiers += [replace(fine, fineness=fine.fineness / COMPANION), fine]
        return tuple(tiers)

    def run(self, *, progress: Progress | None = None) -> Result:
        """Simulate; `record["error"]` and `record["plan"]` have the error and the attempts.

        Args:
            progress: Called with the fraction done, 0 to 1, of `layer` and each mesh in turn.

        Raises:
            SceneError: A tier does not support the scene.
            SimulationDiverged: No converged state was found; nothing unconverged is returned.
        """
        from sim.tolerance import simulate_within

        return simulate_within(
            self.scene,
            self.tolerance,
            seconds=self.seconds,
            tier=self.only,
            device=self.device,
            progress=progress,
        )

    def __str__(self) -> str:
        """Return the tolerance, and each tier with its mesh and approximate time."""
        from sim.fem.mesh import meshes_of
        from sim.fem.stepping import path_of

        solved = ", ".join(self.scene.effects.key) or "none"
        lines = [f"error of up to {self.tolerance}; effects solved: {solved}"]
        for tier in self.tiers:
            if isinstance(tier, Layer):
                line = "layer, if its estimated error is small enough"
                seconds = SECONDS_LAYER + SECONDS_LAYER_FRAME * len(self.scene.motion)
            else:
                (mesh,) = meshes_of([self.scene], tier)
                line = f"fem, {' x '.join(map(str, mesh.cells))} elements"
                steps = path_of(self.scene, tier, mesh.finest).steps
                seconds = SECONDS_ITERATION * len(mesh.elements) * ITERATIONS * steps
            if self.device == "cpu" or isinstance(tier, Layer):
                line += f": {seconds:.1g} s or more"
            lines.append(line)
        if self.only != "layer":
            lines.append("finer meshes of fem, if the error measured by these two is larger")
        return "\n".join(lines)


def plan(
    scene: Scene,
    tolerance: str,
    *,
    seconds: float | None = None,
    only: ContactTier | None = None,
    device: str = "cpu",
) -> Plan:
    """Return the way to simulate a scene within a tolerance; `plan(...).run()` simulates it.

    `layer` is used if its estimate is below the tolerance and was checked for such scenes.
    Otherwise meshes of `fem` are refined until the error measured by two of them is below
    (`sim.tolerance`). If that is not reached, the result is the best one, with its error.

    Args:
        scene: Scene to simulate.
        tolerance: Such as "2 %", "0.05 N", "0.5 px".
        seconds: Time after which the best result so far is returned; None: no limit.
        only: `layer` or `fem`: only that tier is tried.
        device: Device of the meshes, `cpu` or `cuda:0` and the like.

    Raises:
        SceneError: The scene, tolerance or time is invalid, or the device does not exist.
    """
    check_kind("scene", scene, Scene, "a Scene")
    tolerance_of(tolerance)
    check_choice("only", only, (None, *get_args(ContactTier)))
    if seconds is not None:
        check_range("plan", "seconds", seconds, 0.0, 1e6, unit="s", open_low=True)
    if device != "cpu":
        check_device(device)
    return Plan(scene, tolerance, only, device, seconds)
