"""Single entry point of the simulator: from a scene to a result with its error."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from sim.errors import SceneError, SimulationDiverged, check_kind
from sim.result import Result
from sim.scene import Scene
from sim.tiers import Tier, simulate_many, simulate_one, unfit

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics
    from sim.mpm import MpmNumerics
    from sim.needed import EffectsPlan


def simulate(
    scene: Scene,
    tier: Tier | None = None,
    *,
    tolerance: str | None = None,
    effects: Literal["needed"] | None = None,
    error_bar: bool = False,
    extrapolate: bool = False,
    numerics: Numerics | MpmNumerics | None = None,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Simulate one scene.

    Args:
        scene: Scene to simulate.
        tier: By default `fem`, unless a tolerance is given. `layer`: spectral bonded layer, small
            strain, no free sides; `fem`: finite elements, large strain; `mpm`: explicit material
            points.
        numerics: `Numerics` for `fem`, `MpmNumerics` for `mpm`; `layer` has none.
        tolerance: Such as "2 %", "0.05 N", "0.5 px", instead of numerics. `layer` is used if its
            estimate is below it and was checked for such scenes. Otherwise meshes of `fem` are
            refined until the error measured by two of them is below (`sim.tolerance`). See
            `record["error"]` and `record["plan"]`. With a tier only that one is tried: `layer` by
            its estimate.
        effects: "needed", with a tolerance: leave out effects of the scene as far as the tolerance
            allows, a third of it at most (`sim.needed`); see `record["effects"]`. None: keep all.
        error_bar: Solve a coarser mesh as well, to measure `record["error"]`; `record["error_bar"]`
            has it too. With a tolerance: use meshes, not `layer`.
        extrapolate: Solve a coarser mesh as well, and return the forces extrapolated from both
            (`sim.extrapolation`); only `fem`.
        device: Device of `fem` and `mpm`, `cpu` or `cuda:0` and the like; `layer` uses the CPU.
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: The tier does not exist or does not support the scene, the tolerance cannot be
            reached, or arguments exclude each other.
        SimulationDiverged: No converged state was found; nothing unconverged is returned.
    """
    check_kind("scene", scene, Scene, "a Scene")
    if effects is not None:
        _check_needed(effects, tolerance)
    if extrapolate:
        return _extrapolated(scene, tier, tolerance, error_bar, numerics, device, progress)
    if tolerance is not None:
        if numerics is not None:
            raise SceneError(f"numerics: {numerics!r} with a tolerance; allowed: None")
        if error_bar:  # a measured error
            if tier == "layer":
                raise SceneError(
                    f"error_bar: True with tolerance {tolerance!r} and tier {tier!r}; allowed: "
                    "tier None or 'fem', or no tolerance"
                )
            tier = "fem" if tier is None and effects is None else tier
        if effects is not None:
            if tier is not None:
                raise SceneError(f"tier: {tier!r} with effects {effects!r}; allowed: None")
            from sim.needed import simulate_needed

            return simulate_needed(scene, tolerance, device=device, progress=progress)
        from sim.tolerance import simulate_within

        return simulate_within(scene, tolerance, tier=tier, device=device, progress=progress)
    if error_bar and tier == "mpm":
        raise SceneError(f"error_bar: True with tier {tier!r}; allowed: 'fem', 'layer'")
    outcome = simulate_one(
        scene, "fem" if tier is None else tier, numerics=numerics, device=device, progress=progress
    )
    if error_bar:
        from sim.fem.numerics import Numerics
        from sim.tolerance import with_measured_error

        if not (numerics is None or isinstance(numerics, Numerics)):
            raise unfit(numerics, "fem", "Numerics, for an error bar")
        return with_measured_error(outcome, numerics or Numerics(), device=device)
    return outcome


def plan(
    scene: Scene,
    *,
    tolerance: str | None = None,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> EffectsPlan:
    """Return the influence of each effect; with a tolerance also those that may be left out.

    Printed, it is a table; `record()` returns it as JSON values. Only probes on coarse meshes are
    solved, one for each effect and one with all of them (`sim.needed`).

    Args:
        scene: Scene with the effects in question.
        tolerance: Such as "2 %", "0.05 N", "0.5 px", of which left-out effects may use a third.
        device: Device of the probes.
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: The scene or the tolerance is invalid, or the device does not exist.
    """
    from sim.needed import plan_many

    return plan_many([scene], tolerance=tolerance, device=device, progress=progress)[0]


def _check_needed(effects: str, tolerance: str | None) -> None:
    if effects != "needed":
        raise SceneError(f"effects: {effects!r}; allowed: 'needed', or None for all of the scene")
    if tolerance is None:
        raise SceneError(
            f'effects: {effects!r} without a tolerance; allowed: with one, such as "2 %", '
            '"0.05 N" or "0.5 px"'
        )


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
        raise unfit(numerics, "fem", "Numerics")
    outcome = simulate_extrapolated([scene], numerics, device=device, progress=progress)[0]
    if isinstance(outcome, SimulationDiverged):
        raise outcome
    return outcome


__all__ = ["Tier", "plan", "simulate", "simulate_many"]
