"""One call for every tier: a scene in, a result with its error out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal

from sim.errors import SceneError, SimulationDiverged
from sim.result import Outcome, Result
from sim.scene import Scene

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics
    from sim.mpm import MpmNumerics

Tier = Literal["layer", "fem", "mpm"]
TIERS: tuple[Tier, ...] = ("layer", "fem", "mpm")
"""`layer` is linear and takes milliseconds, `fem` is exact and takes seconds to minutes; `mpm` is
the paper's method, dearer and less exact than `fem`, to compare with and to see waves."""


def simulate(
    scene: Scene,
    tier: Tier | None = None,
    *,
    tolerance: str | None = None,
    error_bar: bool = False,
    extrapolate: bool = False,
    numerics: Numerics | MpmNumerics | None = None,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Simulate one scene.

    Args:
        scene: What is simulated.
        tier: `fem` unless given. `layer`: spectral bonded layer, small strain, no free sides;
            `fem`: finite elements, large strain; `mpm`: explicit material points.
        numerics: `Numerics` of `fem`, `MpmNumerics` of `mpm`; `layer` has none to choose.
        tolerance: Such as "2 %", "0.05 N", "0.5 px", in place of tier and numerics: the cheapest
            way to it, told in `record["plan"]` (docs/results/cost-table.md).
        error_bar: Solve a coarser mesh as well, and add `record["error_bar"]`.
        extrapolate: Solve a coarser mesh as well, and give the forces that both lead to
            (`sim.extrapolation`); of `fem`.
        device: Where `fem` and `mpm` run, `cpu` or `cuda:0` and the like; `layer` runs on the CPU.
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: A tier that is not there, or that does not know what the scene asks for; a
            tolerance that nothing reaches; what excludes each other.
        SimulationDiverged: No converged state was found; nothing unconverged is returned.
    """
    if extrapolate:
        return _extrapolated(scene, tier, tolerance, error_bar, numerics, device, progress)
    if tolerance is not None:
        if tier is not None or numerics is not None:
            raise SceneError(
                f"tolerance: {tolerance!r} with a tier or numerics; allowed: either the one or the "
                "other"
            )
        from sim.planner import simulate_within

        return simulate_within(
            scene, tolerance, device=device, error_bar=error_bar, progress=progress
        )
    outcome = simulate_many(
        [scene], tier or "fem", numerics=numerics, device=device, progress=progress
    )[0]
    if isinstance(outcome, SimulationDiverged):
        raise outcome
    if error_bar:
        from sim.fem.numerics import Numerics
        from sim.planner import with_error_bar

        if not (numerics is None or isinstance(numerics, Numerics)):
            raise _unfit(numerics, "fem", "Numerics, for an error bar")
        return with_error_bar(outcome, device=device, numerics=numerics)
    return outcome


def _extrapolated(
    scene: Scene,
    tier: Tier | None,
    tolerance: str | None,
    error_bar: bool,
    numerics: Numerics | MpmNumerics | None,
    device: str,
    progress: Callable[[float], None] | None,
) -> Result:
    from sim.extrapolation import simulate_extrapolated
    from sim.fem.numerics import Numerics

    if tolerance is not None or error_bar:
        given = f"tolerance {tolerance!r}" if tolerance is not None else "an error bar"
        raise SceneError(f"extrapolate: True with {given}; allowed: either the one or the other")
    if tier not in (None, "fem"):
        raise SceneError(f"extrapolate: True with tier {tier!r}; allowed: 'fem'")
    if not (numerics is None or isinstance(numerics, Numerics)):
        raise _unfit(numerics, "fem", "Numerics")
    outcome = simulate_extrapolated([scene], numerics, device=device, progress=progress)[0]
    if isinstance(outcome, SimulationDiverged):
        raise outcome
    return outcome


def simulate_many(
    scenes: Sequence[Scene],
    tier: Tier = "fem",
    *,
    numerics: Numerics | MpmNumerics | None = None,
    device: str = "cpu",
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Outcome]:
    """Simulate scenes side by side; each gives its result, or the reason why there is none.

    `fem` and `mpm` solve them together in one launch where they are alike enough. Arguments as for
    `simulate`, and `processes`: how many worker processes share the scenes on a CPU; a script that
    asks for several does so under `if __name__ == "__main__":`.

    Raises:
        SceneError: As `simulate`; processes below 1, or several on a GPU.
        WorkerLost: One of several processes was killed, by a lack of memory for example.
    """
    from sim.pool import check_processes, simulate_in_processes

    if tier not in TIERS:
        raise SceneError(f"tier: {tier!r}; allowed: {', '.join(TIERS)}")
    check_processes(processes, device)
    if processes > 1 and len(scenes) > 1:
        return simulate_in_processes(
            scenes, tier, numerics=numerics, processes=processes, progress=progress
        )
    if not scenes:
        return []
    if tier == "layer":
        if numerics is not None:
            raise _unfit(numerics, tier, "None")
        from sim.layer import simulate_layer

        outcomes: list[Outcome] = []
        for index, scene in enumerate(scenes):
            share = None
            if progress is not None:
                share = part_of(progress, index, len(scenes))
            try:
                outcomes.append(simulate_layer(scene, progress=share))
            except SimulationDiverged as diverged:
                outcomes.append(diverged)
        return outcomes
    if tier == "mpm":
        from sim.mpm import MpmNumerics, simulate_mpm

        if numerics is not None and not isinstance(numerics, MpmNumerics):
            raise _unfit(numerics, tier, "MpmNumerics")
        return simulate_mpm(scenes, numerics, device=device, progress=progress)
    from sim.fem.numerics import Numerics
    from sim.fem.solver import simulate_fem

    if numerics is not None and not isinstance(numerics, Numerics):
        raise _unfit(numerics, tier, "Numerics")
    return simulate_fem(scenes, numerics, device=device, progress=progress)


def _unfit(numerics: Numerics | MpmNumerics, tier: Tier, allowed: str) -> SceneError:
    return SceneError(f"numerics: {type(numerics).__name__}; allowed with tier {tier!r}: {allowed}")


def part_of(progress: Callable[[float], None], index: int, count: int) -> Callable[[float], None]:
    """What tells of the share of part `index` of `count` as a share of the whole."""
    return lambda share: progress((index + share) / count)
