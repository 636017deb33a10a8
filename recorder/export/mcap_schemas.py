"""JSON schemas of the messages that Foxglove has no type for, and the topics of each stream."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

TOPICS: Mapping[str, tuple[str, ...]] = {
    "camera": ("/camera",),
    "pose": ("/pose", "/tf"),
    "force": ("/wrench",),
    "taxels": ("/taxels",),
}
"""Topics by stream; `/segments` and `/reference` are always there."""

_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}


def _number(description: str) -> dict[str, Any]:
    return {"type": "number", "description": description}


def _integer(description: str) -> dict[str, Any]:
    return {"type": "integer", "description": description}


def _vector(description: str) -> dict[str, Any]:
    axes = {axis: {"type": "number"} for axis in "xyz"}
    return {"type": "object", "description": description, "properties": axes}


def _list(description: str) -> dict[str, Any]:
    return {"type": "array", "items": {"type": "number"}, "description": description}


def _object(properties: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": {"timestamp": _TIME, **properties}}


_COUNTS = {
    "type": "array",
    "items": {"type": "array", "items": {"type": "number"}},
    "description": "16 taxels row by row, raw counts x y z",
}

SCHEMAS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "/wrench": (
        "tactile_rig.Wrench",
        _object(
            {
                "frame_id": {"type": "string"},
                "force": _vector("F/T frame, offset removed [N]; pressing is negative z"),
                "torque": _vector("F/T frame, offset removed [N m]"),
                "seq": _integer("the device's sequence number"),
                "status": _integer("the device's status word"),
            }
        ),
    ),
    "/taxels": (
        "tactile_rig.Taxels",
        _object({"counts": _COUNTS, "seq": _integer("the device's sequence number")}),
    ),
    "/segments": (
        "tactile_rig.Phase",
        _object(
            {
                "end": _TIME,
                "duration": _number("[s]"),
                "target": _integer("row of targets"),
                "phase": {"type": "string"},
                "outcome": {"type": "string"},
                "run": _integer("entry of the session's runs"),
                "point": _integer("number of the contact point"),
                "depth": _number("planned indentation [m]"),
                "direction": _integer("number of the shear direction, -1 for none"),
                "planned": _list("planned place of the tip at full shear, base frame [m]"),
            }
        ),
    ),
    "/reference": (
        "tactile_rig.Reference",
        _object(
            {
                "point": _integer("contact point it belongs to"),
                "image": _integer("row of the camera stream, -1 without one"),
                "wrench": _list("residual offset without contact [N, N m]"),
                "wrench_std": _list("its spread [N, N m]"),
                "taxels": _COUNTS,
                "run": _integer("entry of the session's runs"),
            }
        ),
    ),
}
"""Title and JSON schema by topic."""
