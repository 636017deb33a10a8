"""Results on disk: atomic, equal when read again, readable by any Zarr reader."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import zarr

from sim.errors import SceneError
from sim.indenters import NAMES, named, plane, rounded_cone, sphere
from sim.layer import Layer
from sim.result import Quality, Result, from_json, to_json
from sim.scene import Body, Effects, Friction, Gravity, Inertia, Motion, Scene, Viscosity, press
from sim.store import ARRAYS, load_result, save_results
from sim.tiers import simulate

EFFECTS = (
    Effects(),
    Effects(friction=Friction(1 / 3)),
    Effects(
        viscosity=Viscosity((0.1, 1 / 7), (1e-3, 2.0), "shear"),
        inertia=Inertia(100),
        gravity=Gravity((0.1, 0, 9.81)),
    ),
)


@pytest.fixture(scope="module")
def results() -> list[Result]:
    body = Body(thickness=4e-3, dome_radius=60e-3)
    effects = Effects(friction=Friction(0.4))
    return [
        simulate(Scene(sphere(4e-3), press([0.2e-3, 0.5e-3])), Layer()),
        simulate(Scene(named("moon"), press([4e-4], shear=3e-4, steps=1), body, effects), Layer()),
    ]


@pytest.fixture(scope="module")
def path(results: list[Result], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "presses.zarr"
    save_results(path, results)
    return path


@pytest.mark.parametrize("effects", EFFECTS, ids=lambda effects: "+".join(effects.key) or "none")
@pytest.mark.parametrize(
    "motion",
    [
        press([1e-3 / 3, 0.7e-3]),
        press([0.5e-3], hold=3, at=(1e-3, -2e-3), steps=10, speed=0.5e-3 / 0.1),
    ],
    ids=["press", "hold"],
)
def test_a_scene_comes_back_equal_through_text(effects: Effects, motion: Motion) -> None:
    body = Body(size_x=0.021, poisson=1 / 3, dome_radius=None if effects.key else 0.07)
    for indenter in (*map(named, NAMES), plane(), rounded_cone(0.5, 1e-4)):
        scene = Scene(indenter, motion, body, effects)
        text = json.dumps(to_json(scene), allow_nan=False)
        assert from_json(Scene, json.loads(text), "scene") == scene


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda stored: stored.pop("motion"), r"^scene: missing motion; known: "),
        (lambda stored: stored["body"].update(colour=1), r"^scene\.body: .*colour"),
        (lambda stored: stored["body"].update(modulus=True), r"^scene\.body\.modulus: found true"),
        (lambda stored: stored["body"].update(poisson=0.5), r"^scene\.body: body\.poisson: 0\.5"),
        (
            lambda stored: stored["motion"]["tip"].append([0, 0]),
            r"motion\.tip\[3\]: found 2 values",
        ),
        (lambda stored: stored["motion"].update(time=0), r"^scene\.motion\.time: found 0; .*list"),
        (lambda stored: stored.update(effects=[]), r"^scene\.effects: found the list \[\]"),
    ],
)
def test_a_scene_that_was_tampered_with_is_refused(change: object, message: str) -> None:
    stored = json.loads(json.dumps(to_json(Scene(sphere(4e-3), press([1e-4, 2e-4])))))
    change(stored)
    with pytest.raises(SceneError, match=message):
        from_json(Scene, stored, "scene")


@pytest.mark.parametrize("index", [0, 1])
def test_a_result_comes_back_with_every_bit(path: Path, results: list[Result], index: int) -> None:
    kept, given = load_result(path, index), results[index]
    assert kept.scene == given.scene
    assert (kept.tier, kept.record) == (given.tier, given.record)
    for name in ("wrench", "surface_x", "surface_y", "surface", "traction"):
        _assert_same(getattr(kept, name), getattr(given, name))
    for one in fields(Quality):
        _assert_same(getattr(kept.quality, one.name), getattr(given.quality, one.name))


def _assert_same(kept: np.ndarray, given: np.ndarray) -> None:
    assert kept.dtype == given.dtype
    np.testing.assert_array_equal(kept, given)


def test_any_zarr_reader_finds_units_dimensions_and_the_scene(
    path: Path, results: list[Result]
) -> None:
    root = zarr.open_group(path, mode="r")
    assert root.metadata.zarr_format == 3
    assert root.attrs["results"] == 2
    for name, (unit, dimensions, _) in ARRAYS.items():
        array = root[f"1/{name}"]
        assert array.attrs["units"] == unit
        assert array.metadata.dimension_names == dimensions
    assert root["1/surface"].chunks[0] == 1
    np.testing.assert_array_equal(root["1/tip"], results[1].scene.motion.tip)
    np.testing.assert_array_equal(root["1/time"], results[1].scene.motion.time)
    assert root["1"].attrs["scene"]["body"]["dome_radius"] == 60e-3
    for document in path.rglob("zarr.json"):
        json.loads(document.read_text(), parse_constant=pytest.fail)


def test_an_existing_path_is_left_as_it_is(path: Path, results: list[Result]) -> None:
    before = sorted(path.rglob("*"))
    with pytest.raises(FileExistsError, match="allowed: a new path"):
        save_results(path, results[:1])
    assert sorted(path.rglob("*")) == before
    assert zarr.open_group(path, mode="r").attrs["results"] == 2


def test_a_failure_half_way_leaves_nothing(tmp_path: Path, results: list[Result]) -> None:
    unwritable = replace(results[1], record={"tier": object()})
    with pytest.raises(TypeError):
        save_results(tmp_path / "x.zarr", [results[0], unwritable])
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_a_kept_result_is_refused(path: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_result(tmp_path / "none.zarr")
    with pytest.raises(IndexError, match="result 2; allowed: 0 to 1"):
        load_result(path, 2)
    zarr.open_group(tmp_path / "other.zarr", mode="w", attributes={"format": "other"})
    with pytest.raises(ValueError, match=r"format \('other', None\)"):
        load_result(tmp_path / "other.zarr")
