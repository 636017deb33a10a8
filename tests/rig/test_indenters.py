"""Indenters have a shape: the paper's by name, a lab's own by a file, and no other name."""

import re
from pathlib import Path

import pytest
from support.stl_files import block, write_binary

from learning.indenters import NAMES
from rig.bench.indenter import find_indenter, indenter_names, paper_indenters
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


PARTS = """
parts:
  - {shape: box, size_mm: [4, 6, 5], turn_deg: [0, 0, 90]}
  - {shape: sphere, radius_mm: 2, position_mm: [5, 0, -1]}
"""


def test_ones_own_is_an_stl_file_or_of_parts_or_described(tmp_path: Path) -> None:
    write_binary(tmp_path / "thumb.stl", block(4, 6, 10))
    for name, text, size, tip in (
        ("thumb", "", (4e-3, 6e-3), "body of thumb.stl, 10 mm high"),
        ("own.yaml", PARTS, (10e-3, 4e-3), "body of own.yaml, 6 mm high"),  # x from -3 to 7 mm
        ("own", f"tip: a nose{PARTS}", (10e-3, 4e-3), "a nose"),
        ("own", "stl: thumb.stl", (4e-3, 6e-3), "body of thumb.stl, 10 mm high"),
        ("cone", "{tip: steel needle, size_mm: [1.0, 1.0]}", (1e-3, 1e-3), "steel needle"),
    ):
        file = tmp_path / (f"{name.removesuffix('.yaml')}.yaml" if text else "thumb.stl")
        if text:
            file.write_text(text)
        found = find_indenter(name, folder=tmp_path)
        assert (found.name, found.tip, found.source) == (file.stem, tip, file)
        assert found.size == pytest.approx(size)
        attrs = found.attrs()
        assert (attrs["source"], len(attrs["sha256"])) == (file.name, 64)
        assert str(tmp_path) not in str(attrs)
    assert {"thumb", "own"} < set(indenter_names(tmp_path))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{tip: x, size_mm: [0.001, 0.001]}", "is it in m?"),
        ("{tip: x, size_mm: [1.0]}", "found 1 values"),
        ("{tip: x, size_mm: [1.0, 1.0], stl: no.stl}", "no such file beside it"),
        ("{tip: x}", "missing size_mm"),
        ("stl: inch.stl", "inch.stl: 0.01 mm long, read in mm; allowed: 0.5 to 200 mm (is the"),
        ("stl: x.yaml", "x.yaml.parts: found None; allowed: a list of one or more parts"),
        ("parts: []", "x.yaml.parts: found []; allowed: a list of one or more parts"),
        ("parts: [{shape: cub, size_mm: [1, 1, 1]}]", "parts[0]: shape: found 'cub' with size;"),
        ("parts: [{shape: box}]", "found 'box' with no measure; allowed: sphere with radius"),
        ("parts: [{shape: box, radius_mm: 1}]", "found 'box' with radius; allowed"),
        ("parts: [{shape: wave, radius_mm: 1}]", "found 'wave' with radius; allowed"),
        ("parts: [{shape: sphere, radius_mm: -1}]", "radius: -0.001; allowed: above 0 (in SI"),
        ("parts: [{shape: sphere, radius_mm: 0.003}]", "is it in m? then write 3"),
        ("parts: [{shape: sphere, turn_deg: [0, 0, 3.14159]}]", "is it in rad?"),
        ("parts: [{shape: sphere, radius: 3}]", "unknown radius; did you mean radius_mm?"),
        ("parts: [{shape: sphere}]\nstl: inch.stl", "x.yaml.stl: found 'inch.stl' beside parts"),
        ("parts: [{shape: sphere, radius_mm: 90}]", "found [180.0, 180.0]; plausible: 0.2 to 100"),
    ],
)
def test_a_body_that_cannot_be_is_refused(tmp_path: Path, content: str, words: str) -> None:
    write_binary(tmp_path / "inch.stl", block(0.004, 0.006, 0.01))
    (tmp_path / "x.yaml").write_text(content)
    with pytest.raises(ConfigError, match=re.escape(words)):
        find_indenter("x", folder=tmp_path)


@pytest.mark.slow
def test_the_simulated_world_presses_with_ones_own_solid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import trimesh

    from rig.bench.worlds import WorldSpec
    from rig.mock.world.sensors import live_sensor

    monkeypatch.chdir(tmp_path)
    (tmp_path / "indenters").mkdir()
    trimesh.creation.box(extents=(4.0, 6.0, 20.0)).export(tmp_path / "indenters" / "block.stl")
    assert find_indenter("block").size == pytest.approx((4e-3, 6e-3))
    # Its construction reads and checks the solid, to the depth that the sensor allows.
    live_sensor(WorldSpec(sensor="tacpalm"), "block")
