"""An indenter from any STL file."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path

from sim.indenters.indenter import Indenter
from sim.indenters.solid import REACH, SPACING, Solid, digest
from sim.indenters.triangles import Axis, Unit, Up

EDGE_RADIUS = 0.3e-3
"""Edge radius unless told otherwise [m]: what most of the named indenters have."""


def from_stl(
    path: str | PathLike[str],
    *,
    unit: Unit = "mm",
    up: Up = "+z",
    axis: Axis = "middle",
    edge_radius: float = EDGE_RADIUS,
    spacing: float = SPACING,
    reach: float = REACH,
    name: str | None = None,
) -> Indenter:
    """The body in an STL file, binary or text, its lowest point at z = 0.

    The file is read and checked, and distances to the body are worked out, here and now (seconds).
    A stored scene keeps the file's path and digest; it is read again when it is simulated. What
    was repaired, or looks odd, stands in `indenter.solid.notes`.

    Args:
        path: The file.
        unit: Unit of its numbers.
        up: Axis of the file that points away from the skin; "-z" where its tip is up.
        axis: What becomes x = y = 0: the `middle` of the box around the body, or of the `file`.
        edge_radius: Radius of every convex edge [m]; 0 leaves them as sharp as the grid can hold.
        spacing: Between the nodes of the grid of distances [m].
        reach: How far above the tip the body is known [m]: as deep as a press may go, and more.
        name: What messages call the indenter; the file's name unless given.

    Raises:
        FileNotFoundError: There is no such file.
        SceneError: A file that is cut short, or holds no watertight body of a plausible size; an
            edge radius that the body has no room for.
    """
    place = Path(path).resolve()
    solid = Solid(str(place), digest(place.read_bytes()), unit, up, axis, spacing, reach)
    indenter = Indenter(name or place.stem, edge_radius=edge_radius, solid=solid)
    notes = solid.triangles().notes + solid.distances(edge_radius).notes
    return replace(indenter, solid=replace(solid, notes=notes))
