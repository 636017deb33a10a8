"""Presses by indenters from files and by tilted indenters, in every tier."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support import stl_files as files

from sim import Body, Effects, Friction, Layer, Result, Scene, press, simulate, simulate_many
from sim.error_estimate import notes
from sim.fem import Fem, Grading
from sim.indenters import NAMES, Indenter, box, from_stl, named, sphere
from sim.mpm import Mpm
from sim.store import load_result, save_results
from tactile.__main__ import main
from tests.support.few import few

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from sim.tiers import Tier


TILT = math.radians(6), math.radians(-4)
COARSE = Fem(spacing=1.3e-3)


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Indenter:
    path = tmp_path_factory.mktemp("stl") / "block.stl"
    files.write_binary(path, files.block(4, 5, 6))
    return from_stl(path, edge_radius=0.4e-3, spacing=0.15e-3, reach=3e-3)


EXACT = box(4e-3, 5e-3, 0.4e-3)


def _pressed(indenter: Indenter, tier: Tier) -> Result:
    scene = Scene(indenter, press([0.5e-3, 0.8e-3]), effects=Effects(friction=Friction(0.4)))
    return simulate(scene, tier)


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Indenter:
    path = tmp_path_factory.mktemp("stl") / "ball.stl"
    files.write_binary(path, files.ball(4.0, 41))
    return from_stl(path, edge_radius=0.0, spacing=0.15e-3, reach=3e-3)


@pytest.mark.parametrize("shape", ["ball", "block", "leaning block"])
@pytest.mark.parametrize(
    ("tier", "tolerance"), [(Layer(), 0.01), (COARSE, 0.02)], ids=["layer", "fem"]
)
def test_a_body_from_a_file_presses_like_the_exact_one(
    tier: Tier, tolerance: float, shape: str, block: Indenter, ball: Indenter
) -> None:
    indenter, exact = {
        "ball": (ball, sphere(4e-3)),
        "block": (block, EXACT),
        "leaning block": (block.tilted(*TILT), EXACT.tilted(*TILT)),
    }[shape]
    wrench, expected = (_pressed(one, tier).wrench[1:] for one in (indenter, exact))
    off = (wrench - expected) / np.abs(expected[:, 2:3])
    assert np.abs(off[:, :3]).max() < tolerance
    assert np.abs(off[:, 3:]).max() < tolerance * 2e-3


@pytest.mark.parametrize("name", few(NAMES, 3))
def test_an_indenter_presses_alike_by_name_and_from_a_file_of_flat_facets(
    name: str, tmp_path: Path
) -> None:
    """The file has sharp edges and 28 facets around a circle, as the published ones have."""
    path = files.write_binary(tmp_path / f"{name}.stl", files.as_published(name, 28))
    # Narrow contacts need finer pixels.
    tier = Layer(grid=128 if name in ("cone", "dots") else 64)
    found, expected = (
        simulate(Scene(one, press([0.3e-3, 0.7e-3])), tier).force[1:, 2]
        for one in (from_stl(path, axis="file", reach=1e-3), named(name))
    )
    np.testing.assert_allclose(found, expected, rtol=0.01)


@pytest.mark.parametrize("name", ["cone", "cylinder_sh", "hemisphere", "moon", "sphere"])
def test_meshes_see_the_same_indenter_by_name_and_from_a_file(name: str, tmp_path: Path) -> None:
    path = files.write_binary(tmp_path / f"{name}.stl", files.as_published(name, 28))
    found, expected = (
        simulate(Scene(one, press([0.2e-3, 0.4e-3])), Fem(spacing=0.8e-3)).force[1:, 2]
        for one in (from_stl(path, axis="file", reach=1e-3), named(name))
    )
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_fillets_that_are_drawn_are_those_of_the_file(tmp_path: Path) -> None:
    path = files.write_binary(tmp_path / "prism.stl", files.rounded_block(5, 7, 8, 0.3, 25))
    indenter = from_stl(path, reach=1.5e-3)
    assert indenter.edge_radius == 0
    assert 0.15e-3 < indenter.sharpest <= 0.3e-3
    found, expected = (
        simulate(Scene(one, press([0.5e-3])), Layer()).force[-1, 2]
        for one in (indenter, named("prism", 0.3e-3))
    )
    assert found == pytest.approx(expected, rel=0.01)


def test_edges_that_are_rounded_unasked_are_in_the_error_and_those_given_are_not(
    tmp_path: Path,
) -> None:
    path = files.write_binary(tmp_path / "prism.stl", files.block(5, 7, 8))

    def pressed(indenter: Indenter) -> Result:
        return simulate(Scene(indenter, press([0.3e-3, 0.7e-3])), Layer(grid=64))

    unasked, asked = (
        pressed(from_stl(path, reach=1e-3, edge_radius=radius)) for radius in (None, 0.3e-3)
    )
    sharp = pressed(named("prism", 0.0))
    true = 100 * np.abs(unasked.force[1:, 2] / sharp.force[1:, 2] - 1).max()
    stated = unasked.record["error"]["rounding_percent"]
    assert 5 < true < stated < 4 * true
    np.testing.assert_array_equal(asked.force, unasked.force)
    assert "rounding_percent" not in asked.record["error"]
    assert unasked.record["error"]["percent"] > asked.record["error"]["percent"] + stated / 2
    assert any("by edges of the file that are rounded" in note for note in notes(unasked))


def test_a_result_can_be_read_without_the_file_that_it_was_made_with(
    block: Indenter, tmp_path: Path
) -> None:
    path = files.write_text(tmp_path / "gone.stl", files.block(4, 5, 6))
    indenter = from_stl(path, edge_radius=0.0, spacing=0.2e-3, reach=2e-3)
    result = simulate(Scene(indenter, press([0.3e-3])), Layer())
    save_results(tmp_path / "kept.zarr", [result])
    path.unlink()
    kept = load_result(tmp_path / "kept.zarr")
    assert kept.scene == result.scene
    np.testing.assert_array_equal(kept.surface, result.surface)


def test_the_command_line_presses_a_file_that_leans(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tips").mkdir()
    inside_out = files.block(2, 3, 6)[0], files.block(2, 3, 6)[1][:, ::-1]
    path = files.write_binary(tmp_path / "tips" / "block.stl", inside_out)
    words = ["sim", "press", "--depths", "0.3", "--tier", "layer", "--tilt", "-2,1"]
    words += ["--shape", f"{path}:unit=mm,up=-z"]
    assert main(words) == 0
    told = capsys.readouterr()
    assert "note: block.stl is inside out: its triangles were turned round" in told.err
    assert told.out.startswith("block, edges 0.3 mm;")
    assert (tmp_path / "press-block.png").is_file()
    assert main([*words, "--json"]) == 0
    force = json.loads(capsys.readouterr().out)["force_n"]
    exact = box(2e-3, 3e-3, 0.3e-3).tilted(math.radians(-2), math.radians(1))
    expected = -simulate(Scene(exact, press([0.3e-3])), Layer()).force[1:, 2]
    np.testing.assert_allclose(force, expected, rtol=0.02)


def test_without_an_edge_radius_a_prism_presses_alike_by_name_by_measures_and_from_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = files.write_binary(tmp_path / "prism.stl", files.block(5, 7, 8))
    forces = []
    for shape in ("prism", "box:width=5,length=7", str(path)):
        words = ["sim", "press", "--depths", "0.5", "--tier", "layer", "--json", "--shape", shape]
        assert main(words) == 0
        forces.append(json.loads(capsys.readouterr().out)["force_n"][-1])
    assert forces[1] == pytest.approx(forces[0], rel=1e-6)
    assert forces[2] == pytest.approx(forces[0], rel=0.01)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--shape nowhere.stl", "cannot read or write: .*nowhere.stl"),
        ("--shape cut.stl", "wrong input: cut.stl: 384 bytes; .*cut short"),
        ("--shape cut.stl:radius=3", "wrong input: --shape cut.stl: radius=3; allowed: unit, up"),
        ("--shape prism:up=-z", "wrong input: --shape prism: up=-z; allowed: a number"),
        ("--shape prism --tilt 40,0", "indenter prism.tilt about x: 0.698"),
        ("--shape plane --tilt 1,0", "indenter plane.tilt: it has no lowest point"),
    ],
)
def test_the_command_line_says_what_is_wrong_with_a_file_or_a_tilt(
    words: str,
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    whole = files.write_binary(tmp_path / "cut.stl", files.block(4, 5, 6))
    whole.write_bytes(whole.read_bytes()[:384])
    assert main(["sim", "press", "--tier", "layer", *words.split()]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["cut.stl"]


def test_fem_presses_a_leaning_sphere_like_one_that_stands_where_it_leans_to() -> None:
    about = math.radians(8)
    aside = 4e-3 * math.sin(about)
    leaning = Scene(sphere(4e-3).tilted(0.0, about), press([0.8e-3]))
    moved = Scene(sphere(4e-3), press([0.8e-3], at=(aside, 0.0)))
    numerics = Fem(spacing=1.3e-3, grading=Grading(growth=0.0))
    found, expected = simulate_many([leaning, moved], numerics)
    assert isinstance(found, Result)
    assert isinstance(expected, Result)
    np.testing.assert_allclose(found.force[1:], expected.force[1:], atol=2e-3)
    # The torque is about the tip, i.e. the origin of the tilted indenter.
    lever = np.cross([aside, 0, 0], expected.force[1])
    torque = expected.wrench[1, 3:] + lever
    np.testing.assert_allclose(found.wrench[1, 3:], torque, atol=2e-5)


def test_scenes_of_every_kind_of_indenter_are_solved_in_one_call(block: Indenter) -> None:
    indenters = [named("cylinder"), block, named("cylinder").tilted(*TILT), block.tilted(*TILT)]
    scenes = [Scene(one, press([0.4e-3])) for one in indenters]
    for scene, outcome in zip(scenes, simulate_many(scenes, COARSE), strict=True):
        assert isinstance(outcome, Result)
        alone = simulate(scene, COARSE)
        np.testing.assert_allclose(outcome.force, alone.force, rtol=1e-3, atol=1e-4)


def test_mpm_presses_a_body_from_a_file_like_the_exact_one(block: Indenter) -> None:
    body = Body(size_x=10e-3, size_y=10e-3, thickness=4e-3)
    numerics = Mpm(cell=0.5e-3)
    for found, exact in ((block, EXACT), (block.tilted(*TILT), EXACT.tilted(*TILT))):
        scenes = [Scene(one, press([0.4e-3], speed=0.2), body) for one in (found, exact)]
        outcomes = simulate_many(scenes, numerics)
        forces = [one.force[1, 2] for one in outcomes if isinstance(one, Result)]
        assert forces[1] < -0.05
        assert forces[0] == pytest.approx(forces[1], rel=0.03)
