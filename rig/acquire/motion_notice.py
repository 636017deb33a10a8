"""Notice of how a lab bench's arm or gripper will move, which is shown before it may."""

from __future__ import annotations

from rig.bench.bench import Bench
from rig.bench.indenter import find_indenter
from rig.core.config import from_si
from rig.devices.gripper.settings import RobotiqConfig
from trajectories import Plan


def motion_lines(bench: Bench, depth: float) -> list[str]:
    """Return the speeds, the box and the depth of a bench's motion as lines."""
    arm, limits = bench.arm, bench.limits

    def span(low: float, high: float) -> str:
        return f"{from_si(low, 'mm'):g} to {from_si(high, 'mm'):g} mm"

    forces = ", ".join(f"{limits.soft_fraction * force:.3g}" for force in bench.force_rating[:3])
    return [
        f"speed     {from_si(arm.speed, 'mm_s'):g} mm/s near the sensor, "
        f"{from_si(arm.travel_speed, 'mm_s'):g} mm/s above it",
        f"box       x {span(*limits.box_x)}, y {span(*limits.box_y)}, "
        f"z {span(-limits.depth_max, limits.height_max)} of the contact frame",
        f"depth     {from_si(depth, 'mm'):g} mm below the surface; a press ends at {forces} N",
        f"indenter  {find_indenter(bench.indenter).line()}",
    ]


def grip_lines(gripper: RobotiqConfig, *, only_open: bool) -> list[str]:
    """Return the next motion of a gripper's fingers, with its speed and force, as lines."""
    then = "then stay open" if only_open else "then close on the indenter"
    return [
        f"fingers   close and open once (activation), {then}; an indenter that is held now falls",
        f"speed     {gripper.speed} of 255, after the activation",
        f"force     {gripper.force} of 255",
    ]


def deepest(plan: Plan, total: int | None = None) -> float:
    """Return the deepest indentation of a plan's first `total` targets [m]; None: all."""
    most = len(plan) if total is None else total
    return max((target.depth for target in plan.targets() if target.index < most), default=0.0)
