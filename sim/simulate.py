"""One call for every tier: a scene in, a result with its error out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal

from sim.errors import SceneError, SimulationDiverged
from sim.result import Result
from sim.scene import Scene

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics

Tier = Literal["layer", "fem"]
TIERS: tuple[Tier, ...] = ("layer", "fem")
"""From fast to exact: `layer` is linear and takes milliseconds, `fem` takes seconds to minutes."""


def simulate(
    scene: Scene,
    tier: Tier = "fem",
    *,
    numerics: Numerics | None = None,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Simulate one scene.

    Args:
        scene: What is simulated.
        tier: `layer`: spectral bonded layer, small strain, no free sides; `fem`: finite elements,
            large strain.
        numerics: Mesh, precision and tolerances of `fem`; `layer` has none to choose.
        device: Where `fem` runs, `cpu` or `cuda:0` and the like; `layer` runs on the CPU.
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: A tier that is not there, or that does not know what the scene asks for.
        SimulationDiverged: No converged state was found; nothing unconverged is returned.
    """
    outcome = simulate_many([scene], tier, numerics=numerics, device=device, progress=progress)[0]
    if isinstance(outcome, SimulationDiverged):
        raise outcome
    return outcome


def simulate_many(
    scenes: Sequence[Scene],
    tier: Tier = "fem",
    *,
    numerics: Numerics | None = None,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> list[Result | SimulationDiverged]:
    """Simulate scenes side by side; each gives its result, or the reason why there is none.

    `fem` solves them in one launch: same size of the body and same set of effects; indenters,
    motions, moduli and the parameters of the effects may differ. Arguments as for `simulate`.

    Raises:
        SceneError: As `simulate`; scenes that cannot be solved together.
    """
    if tier not in TIERS:
        raise SceneError(f"tier: {tier!r}; allowed: {', '.join(TIERS)}")
    if not scenes:
        return []
    if tier == "layer":
        from sim.layer import simulate_layer

        outcomes: list[Result | SimulationDiverged] = []
        for index, scene in enumerate(scenes):
            share = None
            if progress is not None:
                share = _part(progress, index, len(scenes))
            try:
                outcomes.append(simulate_layer(scene, progress=share))
            except SimulationDiverged as diverged:
                outcomes.append(diverged)
        return outcomes
    from sim.fem.solver import simulate_fem

    return simulate_fem(scenes, numerics, device=device, progress=progress)


def _part(progress: Callable[[float], None], index: int, count: int) -> Callable[[float], None]:
    """What tells of the share of part `index` of `count` as a share of the whole."""
    return lambda share: progress((index + share) / count)
