"""Bodies united of parts that a YAML file lists under `parts`: named shapes, and simple ones.

    parts:
      - {shape: box, size_mm: [4, 9, 8]}
      - {shape: sphere, radius_mm: 3, position_mm: [0, 4, 1], turn_deg: [0, 0, 0]}

Each part has its tip at its own origin and z away from the skin, as the whole body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from recorder.settings import Reader
from sim.arrays import Array
from sim.errors import SceneError
from sim.indenters.outline import OutlinePiece, Pair, Part, pieces
from sim.indenters.shapes import NAMES, named
from sim.indenters.solid import READERS

if TYPE_CHECKING:
    from manifold3d import CrossSection, Manifold

_READER = Reader(SceneError)
# Facets around a circle: their curved surfaces are restored (`curved`). Height at which named
# shapes end, and size that stands for endless [mm].
FACETS, HEIGHT, ENDLESS = 72, 10.0, 200.0
# Measures of each simple shape.
MEASURES = {
    "sphere": ["radius"],
    "cylinder": ["radius", "height"],
    "cone": ["radius", "tip_radius", "height"],
    "box": ["size"],
}
_LENGTH = {"unit": "mm", "plausible": (0.05, 100)}


@dataclass(frozen=True, slots=True)
class PlacedPart:
    """One of the bodies that are united.

    Raises:
        ValueError: The shape is unknown, or has other measures than these.
    """

    shape: str
    """One of `NAMES`; or with its measures sphere, cylinder, cone or box."""
    position: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), metadata=_LENGTH)
    """Place of its tip [m]."""
    turn: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), metadata={"unit": "deg"})
    """Rotation vector about its tip [rad]."""
    size: tuple[float, float, float] | None = field(default=None, metadata=_LENGTH)
    """Width along x and y, and height of a box [m]."""
    radius: float | None = field(default=None, metadata=_LENGTH)
    """Of a sphere, a cylinder, or the upper end of a cone [m]."""
    tip_radius: float | None = field(default=None, metadata=_LENGTH)
    """Of the lower end of a cone [m]."""
    height: float | None = field(default=None, metadata=_LENGTH)
    """Of a cylinder or a cone [m]."""

    def __post_init__(self) -> None:
        """Reject a shape with measures that are not its own."""
        stated = {name: getattr(self, name) for name in ("size", "radius", "tip_radius", "height")}
        given = {name: value for name, value in stated.items() if value is not None}
        if not (list(given) == MEASURES.get(self.shape) or (self.shape in NAMES and not given)):
            simple = "; ".join(f"{name} with {' and '.join(of)}" for name, of in MEASURES.items())
            raise ValueError(
                f"shape: found {self.shape!r} with {', '.join(sorted(given)) or 'no measure'}; "
                f"allowed: {simple}; or without measures {', '.join(NAMES)}"
            )
        if lacking := [name for name, value in given.items() if not np.all(np.array(value) > 0)]:
            raise ValueError(f"{lacking[0]}: {given[lacking[0]]!r}; allowed: above 0")

    def body(self) -> Manifold:
        """Return the body in its place [mm]."""
        from manifold3d import Manifold

        size, radius, low, height = (
            None if value is None else 1e3 * np.array(value)
            for value in (self.size, self.radius, self.tip_radius, self.height)
        )
        if size is not None:
            body = Manifold.cube(size, True).translate((0, 0, size[2] / 2))
        elif height is not None:
            body = Manifold.cylinder(height, radius if low is None else low, radius, FACETS)
        elif radius is not None:
            body = Manifold.sphere(radius, FACETS).translate((0, 0, radius))
        else:
            body = reduce(_joined, named(self.shape, 0.0).parts, Manifold())
            body = body.trim_by_plane((0, 0, -1), -HEIGHT)
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(self.turn).as_matrix()
        return body.transform(np.column_stack([turn, 1e3 * np.array(self.position)]))


def assembled(data: bytes, name: str) -> tuple[Array, Array]:
    """Return vertices (V, 3) [mm] and triangles (F, 3) of the union of a YAML file's parts.

    Messages have the file's `name`.

    Raises:
        SceneError: It lists no parts, or one of them is wrong.
    """
    content = _READER.parse(data.decode("utf-8", "replace"), name)
    listed = content.get("parts") if isinstance(content, dict) else None
    if not isinstance(listed, list) or not listed:
        raise SceneError(f"{name}.parts: found {listed!r}; allowed: a list of one or more parts")
    bodies = [
        _READER.build(PlacedPart, each, f"{name}.parts[{index}]").body()
        for index, each in enumerate(listed)
    ]
    mesh = reduce(lambda whole, body: whole + body, bodies).to_mesh64()
    return np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts)


READERS[".yaml"] = assembled


def _joined(body: Manifold, part: Part) -> Manifold:
    swept = _swept(part)
    if part.join == "union":
        return body + swept
    return body ^ swept if part.join == "intersect" else body - swept


def _swept(part: Part) -> Manifold:
    """Return a part of a named shape, extruded or revolved as its view says [mm]."""
    plane = _figure(part)
    if part.view == "turned":
        return plane.revolve(FACETS).translate((1e3 * part.axis[0], 1e3 * part.axis[1], 0))
    body = plane.extrude(ENDLESS).translate((0, 0, -ENDLESS / 2))
    return body if part.view == "plan" else body.rotate((90, 0, 0))


def _figure(part: Part) -> CrossSection:
    """Return the plane figure of a part [mm]; see `Part.values`."""
    from manifold3d import CrossSection

    if part.figure == "path":
        corners = []
        for piece in pieces(part.values):
            count = max(1, math.ceil(abs(piece.angle) * FACETS / math.tau))
            corners += [_on(piece, step / count) for step in range(count)]
        return CrossSection([1e3 * np.array(corners)])
    first, second, *rest = (1e3 * value for value in part.values)
    if part.figure == "circle":
        return CrossSection.circle(rest[0], FACETS).translate((first, second))
    high = rest[0] + rest[1] if part.figure == "band" else rest[0]
    low = rest[0] - rest[1] if part.figure == "band" else rest[0] - ENDLESS
    strip = CrossSection.square((high - low, ENDLESS)).translate((low, -ENDLESS / 2))
    return strip.rotate(math.degrees(math.atan2(second, first)))


def _on(piece: OutlinePiece, fraction: float) -> Pair:
    """Return the place on a line or arc at a fraction of its length."""
    (u, v), (start_u, start_v) = piece.centre if piece.bulge else piece.start, piece.start
    angle = fraction * piece.angle
    cosine, sine = math.cos(angle), math.sin(angle)
    along, across = start_u - u, start_v - v
    return u + cosine * along - sine * across, v + sine * along + cosine * across
