"""Arm trajectories as pure data: frozen specs that yield moves. No hardware, clock or files.

A spec is stored as JSON in the session recorded with it; its moves are derived again when needed.
"""

from trajectories.limits import DryRun, Limits, dry_run, move_duration
from trajectories.plans import (
    PHASES,
    FirstPress,
    ForceDepth,
    Move,
    Plan,
    Point,
    PressShear,
    Taps,
    Target,
    Touch,
    dome_height,
    plan_from_json,
    plan_to_json,
)

__all__ = [
    "PHASES",
    "DryRun",
    "FirstPress",
    "ForceDepth",
    "Limits",
    "Move",
    "Plan",
    "Point",
    "PressShear",
    "Taps",
    "Target",
    "Touch",
    "dome_height",
    "dry_run",
    "move_duration",
    "plan_from_json",
    "plan_to_json",
]
