"""Triangles of a closed body, read from an STL file, checked, and turned tip down."""

from __future__ import annotations

import io
import re
import warnings
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sim.errors import SceneError

if TYPE_CHECKING:
    from trimesh import Trimesh

Array = NDArray[np.float64]

Unit = Literal["um", "mm", "cm", "m", "inch"]
Up = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Axis = Literal["middle", "file"]
UNITS: tuple[Unit, ...] = get_args(Unit)
UPS: tuple[Up, ...] = get_args(Up)
AXES: tuple[Axis, ...] = get_args(Axis)
METRES: dict[Unit, float] = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 25.4e-3}

HEADER, RECORD = 84, 50
"""Bytes before the first triangle of a binary file, and of each triangle."""
SIZE_MIN, SIZE_MAX = 0.5e-3, 0.2
"""Longest side of an indenter [m]; anything else is taken for a mistake in the unit."""
FLAT = 1e-5
"""Least volume, as a share of the longest side cubed: a body with less has no inside."""
END = 0.02
"""Share of the height that counts as an end of the body, when it is asked which one is wider."""
WIDER = 1.2
"""How much wider the lower end has to be for the tip to be taken for the upper one."""


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """A closed surface in the indenter's frame: its lowest point is at z = 0, z points away."""

    vertices: Array
    """(V, 3) [m]."""
    faces: NDArray[np.int32]
    """Vertices of each triangle (F, 3), counterclockwise when seen from outside."""
    notes: tuple[str, ...]
    """What was repaired, and what looks odd."""


def read_triangles(data: bytes, name: str, unit: Unit, up: Up, axis: Axis) -> Triangles:
    """The body in an STL file.

    Args:
        data: The whole file, binary or text.
        name: What messages call it.
        unit: Unit of the file's numbers.
        up: Axis of the file that points away from the skin.
        axis: What x = y = 0 is: the `middle` of the box around the body, or of the `file`.

    Raises:
        SceneError: A file that is cut short or no STL file, or triangles that do not enclose a
            body of a plausible size.
    """
    mesh = _read(data, name)
    if not np.isfinite(mesh.vertices).all():
        count = int((~np.isfinite(mesh.vertices).all(axis=1)).sum())
        raise SceneError(f"{name}: {count} corners that are not finite; allowed: none")
    size = float(np.ptp(mesh.vertices, axis=0).max()) * METRES[unit]
    if not SIZE_MIN <= size <= SIZE_MAX:
        raise SceneError(
            f"{name}: {size * 1e3:.4g} mm long, read in {unit}; allowed: {SIZE_MIN * 1e3:g} to "
            f"{SIZE_MAX * 1e3:g} mm (is the file in another unit?)"
        )
    mesh.merge_vertices()
    faces = np.asarray(mesh.faces)
    # Where corners fell together nothing is left of a triangle; its neighbours then meet.
    faces = faces[(np.diff(np.sort(faces, axis=1), axis=1) > 0).all(axis=1)]
    _check_closed(faces, name)
    vertices = np.asarray(mesh.vertices, np.float64) * METRES[unit]
    volume = _volume(vertices, faces)
    if abs(volume) <= FLAT * size**3:
        raise SceneError(
            f"{name}: encloses {volume * 1e9:.3g} mm^3; allowed: a body, not a flat sheet"
        )
    notes = []
    if volume < 0:
        faces = faces[:, ::-1]
        notes.append(f"{name} is inside out: its triangles were turned round")
    vertices = _turned(vertices, up, axis)
    notes += _tip_up(vertices, faces, name, up)
    return Triangles(vertices, np.ascontiguousarray(faces, np.int32), tuple(notes))


def _read(data: bytes, name: str) -> Trimesh:
    """The file's triangles as they are."""
    import trimesh

    _check_whole(data, name)
    try:
        with warnings.catch_warnings():
            # NumPy warns of numbers that it cannot read, and goes on with what it has.
            warnings.simplefilter("error", DeprecationWarning)
            mesh = trimesh.load_mesh(io.BytesIO(data), file_type="stl", process=False)
    except (ValueError, IndexError, DeprecationWarning) as error:
        raise SceneError(f"{name}: {error}; allowed: numbers that can be read") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise SceneError(f"{name}: no triangles; allowed: a closed body")
    return mesh


def _check_whole(data: bytes, name: str) -> None:
    """Refuse a file that is not as long as it says itself."""
    count = int.from_bytes(data[HEADER - 4 : HEADER], "little")
    if len(data) >= HEADER and len(data) == HEADER + RECORD * count:
        if count == 0:
            raise SceneError(f"{name}: no triangles; allowed: a closed body")
        return
    if data.lstrip()[:5].lower() != b"solid" or b"\0" in data:
        said = f"{count} triangles, {HEADER + RECORD * count} bytes" if len(data) >= HEADER else ""
        raise SceneError(
            f"{name}: {len(data)} bytes; allowed: an STL file, "
            + (f"here of {said} (is it cut short?)" if said else f"of {HEADER} bytes or more")
        )
    words = re.findall(rb"^[ \t]*(solid|facet|vertex|endfacet|endsolid)\b", data.lower(), re.M)
    found = Counter(words)
    if found[b"facet"] == 0 and found[b"solid"] == found[b"endsolid"]:
        raise SceneError(f"{name}: no triangles; allowed: a closed body")
    whole = found[b"endfacet"] == found[b"facet"] and found[b"vertex"] == 3 * found[b"facet"]
    if not whole or found[b"endsolid"] != found[b"solid"]:
        raise SceneError(
            f"{name}: {found[b'facet']} triangles begun, {found[b'endfacet']} ended, "
            f"{found[b'vertex']} corners, {found[b'endsolid']} endsolid; allowed: 3 corners to a "
            "triangle and all of them ended (is it cut short?)"
        )


def _check_closed(faces: NDArray[np.int64], name: str) -> None:
    """Refuse triangles that leave a gap, or neighbours that disagree on what is outside."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    ends = np.sort(np.column_stack([start, end]), axis=1)
    _, edge, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    open_ = int((count % 2 == 1).sum())
    if open_ or not len(faces):
        raise SceneError(
            f"{name}: not watertight, {open_} open edges; allowed: none (repair it where it was "
            "drawn)"
        )
    balance = np.bincount(edge.ravel(), weights=np.where(start < end, 1, -1))
    against = int((balance != 0).sum())
    if against:
        raise SceneError(
            f"{name}: {against} edges whose two triangles disagree on which side is out; allowed: "
            "none (repair it where it was drawn)"
        )


def _volume(vertices: Array, faces: NDArray[np.int64]) -> float:
    """Enclosed volume [m^3], below 0 when inside out."""
    first, second, third = (vertices[faces[:, corner]] - vertices[0] for corner in range(3))
    return float(np.einsum("ij,ij->", first, np.cross(second, third)) / 6)


def _turned(vertices: Array, up: Up, axis: Axis) -> Array:
    """The vertices with `up` as z, their lowest point at z = 0."""
    along = "xyz".index(up[1])
    vertices = np.roll(vertices, 2 - along, axis=1)
    if up[0] == "-":
        vertices = vertices * [1.0, -1.0, -1.0]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = (low + high) / 2 if axis == "middle" else np.zeros(3)
    turned: Array = vertices - [middle[0], middle[1], low[2]]
    return turned


def _tip_up(vertices: Array, faces: NDArray[np.int64], name: str, up: Up) -> list[str]:
    """A note when the end that would press is the wider one, as the base of an indenter is."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    plan = np.abs(np.cross(second - first, third - first)[:, 2]) / 2
    height = vertices[:, 2].max()
    lower = (vertices[faces, 2] < END * height).all(axis=1)
    upper = (vertices[faces, 2] > (1 - END) * height).all(axis=1)
    below, above = plan[lower].sum() * 1e6, plan[upper].sum() * 1e6
    if below <= WIDER * above or above == 0:
        return []
    other = ("-" if up[0] == "+" else "+") + up[1]
    return [
        f"the end of {name} that presses is flat and wider than the other, {below:.3g} against "
        f"{above:.3g} mm^2: if it is the base, up={other!r} turns the tip down"
    ]
