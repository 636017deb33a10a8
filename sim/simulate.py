"""One call for every way to an answer: a scene in, a result with its error out."""

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
        scene: What is simulated.
        tier: `fem` unless given, or a tolerance is. `layer`: spectral bonded layer, small strain,
            no free sides; `fem`: finite elements, large strain; `mpm`: explicit material points.
        numerics: `Numerics` of `fem`, `MpmNumerics` of `mpm`; `layer` has none to choose.
        tolerance: Such as "2 %", "0.05 N", "0.5 px", in place of numerics: `layer` where its
            estimate is below and was shown to hold, else meshes of `fem` finer and finer until the
            error that two of them tell is below (`sim.tolerance`), told in `record["error"]` and
            `record["plan"]`. With a tier that one is taken or refused: `layer` by its estimate.
        effects: "needed", with a tolerance: leave out what of the scene's effects the tolerance
            allows, a third of it at most (`sim.needed`), told in `record["effects"]`. None: all.
        error_bar: Solve a coarser mesh as well: `record["error"]` is measured then, and
            `record["error_bar"]` has it too. With a tolerance: by meshes, not `layer`.
        extrapolate: Solve a coarser mesh as well, and give the forces that both lead to
            (`sim.extrapolation`); of `fem`.
        device: Where `fem` and `mpm` run, `cpu` or `cuda:0` and the like; `layer` runs on the CPU.
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: A tier that is not there, or that does not know what the scene asks for; a
            tolerance that nothing reaches; what excludes each other.
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
    """What each effect of a scene is worth; with a tolerance also which ones it may do without.

    Printed, it is a table; `record()` has it as JSON values. Nothing is solved but probes on coarse
    meshes, one for each effect and one with all of them (`sim.needed`).

    Args:
        scene: With the effects in question.
        tolerance: Such as "2 %", "0.05 N", "0.5 px", of which a third is for effects left out.
        device: Where the probes run.
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: What is no scene, or no tolerance; a device that is not there.
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
