"""Conversion of plans to and from JSON, as stored in sessions."""

from __future__ import annotations

import dataclasses
from typing import Any

from trajectories.first_press import FirstPress
from trajectories.force_depth import ForceDepth
from trajectories.moves import Plan
from trajectories.press_shear import OLD_ORDER, PressShear
from trajectories.taps import Taps
from trajectories.touch import Touch

# All specs, by kind.
KINDS: dict[str, type[Any]] = {
    spec.KIND: spec for spec in (PressShear, ForceDepth, Touch, Taps, FirstPress)
}


def plan_to_json(plan: Plan) -> dict[str, Any]:
    """Return the spec as plain JSON values in SI units, with its `kind`."""
    if not dataclasses.is_dataclass(plan) or isinstance(plan, type):
        raise TypeError(f"plan: {plan!r}; allowed: {sorted(KINDS)}")
    return {"kind": plan.kind, **dataclasses.asdict(plan)}


def with_order(stored: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of a stored plan that states the order of its points."""
    old = stored.get("kind") == PressShear.KIND and "order" not in stored
    return {**stored, "order": OLD_ORDER} if old else dict(stored)


def plan_from_json(stored: dict[str, Any]) -> Plan:
    """Return the spec that `plan_to_json` wrote.

    A press-shear plan without `order` is older than it, and means the order of those days.

    Raises:
        ValueError: An unknown kind or field, or a value that the spec rejects.
    """
    fields = with_order(stored)
    kind = fields.pop("kind", None)
    if kind not in KINDS:
        raise ValueError(f"plan.kind: {kind!r}; allowed: {sorted(KINDS)}")
    spec = KINDS[kind]
    known = {field.name for field in dataclasses.fields(spec)}
    if unknown := sorted(set(fields) - known):
        raise ValueError(f"plan: unknown {unknown}; known: {sorted(known)}")
    values = {
        name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()
    }
    plan: Plan = spec(**values)
    return plan
