"""Indenters have a shape: the paper's by name, a lab's own by a file, and no other name."""

from pathlib import Path

import numpy as np
import pytest

from learning.indenters import NAMES
from rig.bench.indenter import find_indenter, indenter_names, paper_indenters, stl_size
from rig.core.errors import ConfigError


def test_the_papers_are_known_by_name_with_size_and_drawing() -> None:
    assert tuple(paper_indenters()) == NAMES
    for name in NAMES:
        found = find_indenter(name)
        assert found.source is None
        assert all(2e-3 <= width <= 16e-3 for width in found.size)
        assert found.drawing is not None
        assert found.drawing.read_bytes().startswith(b"\x89PNG")
        assert name in found.line()


def test_another_name_is_refused_with_the_likely_one(tmp_path: Path) -> None:
    for name, words in (
        ("cylindr", r"--indenter: found 'cylindr'; did you mean cylinder\?"),
        ("Sphere", r"--indenter: found 'Sphere'; did you mean sphere\?"),
        ("prisma", r"--indenter: found 'prisma'; did you mean prism\?"),
        ("bananna", r"known in the paper .*: cone, cylinder,"),
    ):
        with pytest.raises(ConfigError, match=words):
            find_indenter(name, folder=tmp_path)


FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]


def _stl(path: Path, scale: float, *, text: bool = False) -> Path:
    """Write a tetrahedron, 4 by 6 by 10 times `scale`."""
    corners = scale * np.array([[0, 0, 0], [4, 0, 0], [0, 6, 0], [0, 0, 10]], np.float32)
    if text:
        rows = ["solid x"]
        for face in FACES:
            vertices = [f"vertex {' '.join(map(str, corners[k].tolist()))}" for k in face]
            rows += ["facet normal 0 0 0", "outer loop", *vertices, "endloop", "endfacet"]
        path.write_text("\n".join([*rows, "endsolid x\n"]))
        return path
    facets = [bytes(12) + corners[list(face)].astype("<f4").tobytes() + b"\0\0" for face in FACES]
    path.write_bytes(b"x" * 80 + len(FACES).to_bytes(4, "little") + b"".join(facets))
    return path


@pytest.mark.parametrize("text", [False, True])
def test_ones_own_is_an_stl_file_in_the_labs_folder(tmp_path: Path, text: bool) -> None:
    _stl(tmp_path / "thumb.stl", 1.0, text=text)
    found = find_indenter("thumb", folder=tmp_path)
    assert found.size == pytest.approx((4e-3, 6e-3))
    assert found.stl == tmp_path / "thumb.stl"
    attrs = found.attrs()
    assert attrs["source"] == "thumb.stl"
    assert len(attrs["sha256"]) == 64
    assert str(tmp_path) not in str(attrs)
    assert "thumb" in indenter_names(tmp_path)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_an_stl_file_in_another_unit_is_refused(tmp_path: Path, scale: float) -> None:
    with pytest.raises(ConfigError, match="is it in another unit than mm"):
        stl_size(_stl(tmp_path / "x.stl", scale))


@pytest.mark.parametrize("content", [b"", b"solid x\nendsolid x\n", b"\0" * 84, b"vertex 1 b 2"])
def test_a_file_without_triangles_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.stl"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="no triangles"):
        find_indenter("x", folder=tmp_path)


def test_ones_own_yaml_has_precedence_and_its_keys_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "cone.yaml"
    path.write_text("{tip: steel needle, size_mm: [1.0, 1.0]}\n")
    found = find_indenter("cone", folder=tmp_path)
    assert (found.tip, found.source) == ("steel needle", path)
    for text, words in (
        ("{tip: x, size_mm: [0.001, 0.001]}", "is it in m?"),
        ("{tip: x, size_mm: [1.0]}", "found 1 values"),
        ("{tip: x, size_mm: [1.0, 1.0], stl: no.stl}", "no such file beside it"),
        ("{tip: x}", "missing size_mm"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=words.replace("?", r"\?")):
            find_indenter("cone", folder=tmp_path)


@pytest.mark.slow
def test_the_simulated_world_presses_with_ones_own_solid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import trimesh

    from rig.bench.bench import BenchFile, bench_from, with_simulated_world
    from rig.bench.worlds import SimulatedSpec
    from rig.core.packaged import BENCHES
    from rig.mock.world.simulated import live_sensor

    monkeypatch.chdir(tmp_path)
    (tmp_path / "indenters").mkdir()
    trimesh.creation.box(extents=(4.0, 6.0, 20.0)).export(tmp_path / "indenters" / "block.stl")
    content = with_simulated_world(BenchFile.read(BENCHES / "tacpalm.yaml").content, "tacpalm.yaml")
    spec = bench_from(content, "tacpalm.yaml").world
    assert isinstance(spec, SimulatedSpec)
    assert find_indenter("block").size == pytest.approx((4e-3, 6e-3))
    # Its construction reads and checks the solid, to the depth that the sensor allows.
    live_sensor(spec, "block")
