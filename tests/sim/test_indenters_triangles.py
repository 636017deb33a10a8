"""STL files: reading, reported repairs, and rejection."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support import stl_files as files

from sim.errors import SceneError
from sim.indenters import UPS
from sim.indenters.solid import METRES, Axis, Triangles, Unit, Up, read_triangles

Array = NDArray[np.float64]

WEDGE = np.array([(0, 0, 0), (3, 0, 0), (0, 4, 0), (0, 0, 6), (3, 0, 6), (0, 4, 6)], float)
SIDES = np.array([(0, 2, 1), (3, 4, 5), (0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3)])
# A body unlike its mirror image, away from the origin.
PRISM: files.Body = (WEDGE + np.array([10, 20, 30]), np.vstack([SIDES, [(2, 3, 5)]]))


def _read(path: Path, unit: Unit = "mm", up: Up = "+z", axis: Axis = "middle") -> Triangles:
    return read_triangles(path.read_bytes(), path.name, unit, up, axis)


def _corners(read: Triangles) -> Array:
    """Return the triangles' corners in a canonical order (F, 9)."""
    corners = read.vertices[read.faces].reshape(len(read.faces), 9)
    return corners[np.lexsort(corners.T)]


def _volume(read: Triangles) -> float:
    first, second, third = (read.vertices[read.faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", first, np.cross(second, third)) / 6)


def test_text_and_binary_hold_the_same_body(tmp_path: Path) -> None:
    binary = _read(files.write_binary(tmp_path / "b.stl", PRISM))
    text = _read(files.write_text(tmp_path / "t.stl", PRISM))
    np.testing.assert_allclose(_corners(binary), _corners(text), atol=1e-12)
    assert len(binary.vertices) == 6
    assert binary.notes == ()
    assert _volume(binary) == pytest.approx(36e-9)


def test_the_lowest_point_and_the_middle_become_the_origin(tmp_path: Path) -> None:
    path = files.write_binary(tmp_path / "b.stl", PRISM)
    read = _read(path)
    np.testing.assert_allclose(read.vertices.min(axis=0), [-1.5e-3, -2e-3, 0], atol=1e-12)
    np.testing.assert_allclose(read.vertices.max(axis=0), [1.5e-3, 2e-3, 6e-3], atol=1e-12)
    in_place = _read(path, axis="file")
    np.testing.assert_allclose(in_place.vertices.min(axis=0), [10e-3, 20e-3, 0], atol=1e-12)


@pytest.mark.parametrize("unit", METRES)
def test_the_unit_scales_the_body(unit: Unit, tmp_path: Path) -> None:
    scale = 1e-3 / METRES[unit]
    path = files.write_binary(tmp_path / "b.stl", (PRISM[0] * scale, PRISM[1]))
    assert _volume(_read(path, unit)) == pytest.approx(36e-9, rel=1e-5)


@pytest.mark.parametrize("up", UPS)
def test_any_axis_can_be_up_and_nothing_is_mirrored(up: Up, tmp_path: Path) -> None:
    read = _read(files.write_binary(tmp_path / "b.stl", PRISM), up=up)
    size = np.ptp(read.vertices, axis=0)
    assert size[2] == pytest.approx([3e-3, 4e-3, 6e-3]["xyz".index(up[1])])
    # A mirrored body would have inverted triangles.
    assert _volume(read) == pytest.approx(36e-9)
    assert read.notes == ()
    plus = np.dot(PRISM[0], np.eye(3)["xyz".index(up[1])])
    height = (plus - plus.min() if up[0] == "+" else plus.max() - plus) * 1e-3
    np.testing.assert_allclose(np.sort(read.vertices[:, 2]), np.sort(height), atol=1e-9)


def test_a_body_inside_out_is_turned_round_and_said_so(tmp_path: Path) -> None:
    read = _read(files.write_binary(tmp_path / "sock.stl", (PRISM[0], PRISM[1][:, ::-1])))
    assert _volume(read) == pytest.approx(36e-9)
    assert read.notes == ("sock.stl is inside out: its triangles were turned round",)


def test_a_base_that_would_press_is_noticed(tmp_path: Path) -> None:
    cone = files.revolved([(0.5, 0), (8, 12), (8, 20), (0, 20), (0, 0)], 24)
    path = files.write_binary(tmp_path / "b.stl", cone)
    assert _read(path).notes == ()
    (note,) = _read(path, up="-z").notes
    assert "up='+z' turns the tip down" in note
    assert _read(files.write_binary(tmp_path / "c.stl", files.ball(4.0, 5))).notes == ()


def test_triangles_with_no_area_are_left_out(tmp_path: Path) -> None:
    vertices, faces = PRISM
    path = files.write_binary(tmp_path / "b.stl", (vertices, np.vstack([faces, [(0, 0, 1)]])))
    assert len(_read(path).faces) == len(faces)


def _cut(count: int) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(path.read_bytes()[:-count])


def _without(*faces: int) -> files.Body:
    return PRISM[0], np.delete(PRISM[1], faces, axis=0)


def _turned(face: int) -> files.Body:
    faces = PRISM[1].copy()
    faces[face] = faces[face][::-1]
    return PRISM[0], faces


def _with(value: float) -> files.Body:
    vertices = PRISM[0].copy()
    vertices[2, 1] = value
    return vertices, PRISM[1]


FLAT = PRISM[0] * [1, 1, 1e-6], PRISM[1]
NOTHING = PRISM[0], PRISM[1][:0]


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (_without(3), "not watertight, 3 open edges; allowed: none"),
        (_without(0, 1), "not watertight, 6 open edges"),
        (_turned(4), "3 edges whose two triangles disagree on which side is out"),
        (_with(np.nan), r"\d corners that are not finite; allowed: none"),
        (_with(np.inf), r"\d corners that are not finite"),
        (FLAT, r"encloses 3\.6e-05 mm\^3; allowed: a body, not a flat sheet"),
        (NOTHING, "no triangles; allowed: a closed body"),
        ((PRISM[0] * 1e3, PRISM[1]), r"6000 mm long, read in mm; allowed: 0\.5 to 200 mm .*unit"),
        ((PRISM[0] * 1e-3, PRISM[1]), r"0\.006 mm long, read in mm; .*another unit"),
    ],
)
@pytest.mark.parametrize("write", [files.write_binary, files.write_text])
def test_what_is_no_body_is_refused_by_its_name(
    write: Callable[[Path, files.Body], Path], body: files.Body, message: str, tmp_path: Path
) -> None:
    with pytest.raises(SceneError, match=r"^tip\.stl: " + message):
        _read(write(tmp_path / "tip.stl", body))


@pytest.mark.parametrize(
    ("write", "change", "message"),
    [
        (files.write_binary, _cut(1), "483 bytes; .* 8 triangles, 484 bytes .*cut short"),
        (files.write_binary, _cut(300), "184 bytes; .* 8 triangles"),
        (files.write_binary, _cut(410), "74 bytes; allowed: an STL file, of 84 bytes or more"),
        (files.write_binary, lambda path: path.write_bytes(b""), "0 bytes"),
        (files.write_text, _cut(20), "0 endsolid; .*cut short"),
        (files.write_text, _cut(120), "8 triangles begun, 7 ended, 2[234] corners"),
        (
            files.write_text,
            lambda path: path.write_text(path.read_text().replace("vertex 1", "vertex one", 1)),
            "allowed: numbers that can be read",
        ),
        (
            files.write_text,
            lambda path: path.write_text(path.read_text().replace("      vertex", "      edge", 1)),
            "8 triangles begun, 8 ended, 23 corners",
        ),
        (files.write_text, lambda path: path.write_text("solid\nendsolid\n"), "no triangles"),
        (files.write_text, lambda path: path.write_text("a poem"), "6 bytes; allowed: an STL file"),
    ],
)
def test_a_file_that_is_cut_short_or_garbled_is_refused(
    write: Callable[[Path, files.Body], Path],
    change: Callable[[Path], None],
    message: str,
    tmp_path: Path,
) -> None:
    path = write(tmp_path / "tip.stl", PRISM)
    change(path)
    with pytest.raises(SceneError, match=r"^tip\.stl: .*" + message):
        _read(path)
