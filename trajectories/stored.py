"""Conversion of plans to and from JSON, as stored in sessions."""

from __future__ import annotations

import dataclasses
from typing import Any

from trajectories.moves import Plan
from trajectories.press_shear import PressShear
from trajectories.presses import FirstPress, ForceDepth, Taps, Touch

# All specs, by kind.
KINDS: dict[str, type[Any]] = {
    spec.KIND: spec for spec in (PressShear, ForceDepth, Touch, Taps, FirstPress)
}


def plan_to_json(plan: Plan) -> dict[str, Any]:
    """Return the spec as plain JSON values in SI units, with its `kind`."""
    if not dataclasses.is_dataclass(plan) or isinstance(plan, type):
        raise TypeError(f"plan: {plan!r}; allowed: {sorted(KINDS)}")
    return {"kind": plan.KIND, **dataclasses.asdict(plan)}


def plan_from_json(stored: dict[str, Any]) -> Plan:
    """Return the spec that `plan_to_json` wrote.

    Raises:
        ValueError: An unknown kind, an unknown or missing field, or a value that the spec rejects.
    """
    fields = dict(stored)
    kind = fields.pop("kind", None)
    if kind not in KINDS:
        raise ValueError(f"plan.kind: {kind!r}; allowed: {sorted(KINDS)}")
    spec = KINDS[kind]
    known = {field.name for field in dataclasses.fields(spec)}
    if unknown := sorted(set(fields) - known):
        raise ValueError(f"plan: unknown {unknown}; known: {sorted(known)}")
    if missing := sorted(known - set(fields)):
        raise ValueError(f"plan: {', '.join(missing)} missing; a stored plan states every field")
    values = {
        name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()
    }
    plan: Plan = spec(**values)
    return plan
