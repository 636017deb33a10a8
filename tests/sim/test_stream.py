"""A live press matches a simulation of the same poses, and predicts the next state."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sim import Effects, Inertia, Layer, SceneError, press
from sim.indenters import named
from sim.layer.solver import simulate_layer
from sim.layer.spectral import PixelGrid
from sim.sensors import Pins, SurfaceField, sensor
from sim.stream import LiveMarkers, LivePress, LiveSensor, Sampler, Slope
from sim.stream.outlines import NODES, tips_of
from sim.stream.stream import SURE

COARSE = 32
GELSIGHT = sensor("gelsight")


def live(grid: int = COARSE) -> LivePress:
    return LivePress(GELSIGHT, named("sphere"), grid=grid, tolerance=2e-3)


def pressed(depth: float = 1e-3, steps: int = 6) -> LivePress:
    each = live()
    for part in np.arange(1, steps + 1) / steps:
        each.move(np.array([0.0, 0.0, -depth * part]), 0.02)
    return each


def test_told_the_poses_of_a_motion_it_finds_the_forces_of_the_simulation() -> None:
    motion = press([0.3e-3, 0.6e-3, 0.9e-3, 0.5e-3], speed=5e-3)
    scene = GELSIGHT.scene(named("sphere"), motion)
    expected = simulate_layer(scene, Layer(grid=COARSE))
    each, before = live(), 0.0
    for frame, (tip, time) in enumerate(zip(motion.tip, motion.time, strict=True)):
        each.move(np.array(tip), time - before)
        before = time
        np.testing.assert_allclose(each.wrench[:3], expected.force[frame], atol=2e-3)
        np.testing.assert_allclose(each.field.displacement[0], expected.surface[frame], atol=2e-7)


def test_sheared_it_drags_as_the_simulation_does() -> None:
    motion = press([0.9e-3], shear=0.5e-3, steps=3, speed=5e-3)
    expected = simulate_layer(GELSIGHT.scene(named("sphere"), motion), Layer(grid=COARSE))
    each, before, found = live(), 0.0, []
    for tip, time in zip(motion.tip, motion.time, strict=True):
        each.move(np.array(tip), time - before)
        before = time
        found.append(each.wrench[:3])
    largest = np.abs(expected.force).max()
    assert np.abs(np.array(found) - expected.force).max() < 0.08 * largest


def test_a_press_that_is_over_is_forgotten_once_its_dent_is() -> None:
    each = pressed()
    each.move(np.array([0.0, 0.0, 1e-3]), 0.1)
    assert not each.touching
    assert np.abs(each.displacement).max() > 1e-6
    for _ in range(6):
        each.move(np.array([0.0, 0.0, 2e-3]), 1.0)
    assert not np.abs(each.displacement).any()
    # Nothing to solve: it only follows.
    each.move(np.array([3e-3, 1e-3, 5e-3]), 0.02)
    np.testing.assert_array_equal(each.tip, [3e-3, 1e-3, 5e-3])
    again = pressed()
    fresh = pressed()
    np.testing.assert_allclose(again.wrench, fresh.wrench, rtol=1e-12)


def test_beside_the_body_and_above_it_nothing_is_touched() -> None:
    each = live()
    for tip in ([0.1, 0.0, -1e-3], [0.0, -0.1, -1e-3], [0.0, 0.0, 0.5]):
        each.move(np.array(tip), 0.02)
        assert not each.touching
        assert not each.wrench.any()


def test_an_arm_that_overshoots_is_answered_as_at_the_deepest() -> None:
    each = live()
    for depth in np.linspace(0, 50e-3, 6):
        each.move(np.array([0.0, 0.0, -depth]), 0.05)
    assert -each.tip[2] == pytest.approx(2 * GELSIGHT.depth_max)
    assert np.isfinite(each.wrench).all()
    assert each.wrench[2] < -1.0


def test_an_effect_that_the_tier_does_not_know_is_refused() -> None:
    heavy = replace(GELSIGHT, effects=Effects(inertia=Inertia()))
    with pytest.raises(SceneError, match="inertia"):
        LivePress(heavy, named("sphere"), grid=COARSE)


def test_it_says_how_fast_the_force_falls_while_the_tip_stays() -> None:
    each = pressed()
    rate, before = each.relaxing(0.02), each.wrench[2]
    each.move(each.tip, 0.02)
    assert rate[2] > 0.1
    assert each.wrench[2] - before == pytest.approx(0.02 * rate[2], rel=0.1)


moves = arrays(float, 3, elements=st.floats(-1e-3, 1e-3))


@given(
    st.lists(moves, min_size=1, max_size=6), arrays(float, (4, 3), elements=st.floats(-9e3, 9e3))
)
def test_a_slope_comes_nearer_with_each_move_and_nearest_along_the_last(
    ways: list[np.ndarray], true: np.ndarray
) -> None:
    slope = Slope(4)
    for way in ways:
        before = np.linalg.norm(slope.matrix - true)
        missed = np.linalg.norm((slope.matrix - true) @ way)
        slope.learn(way, true @ way)
        assert np.linalg.norm(slope.matrix - true) <= before * (1 + 1e-9) + 1e-9
        left = SURE**2 / (way @ way + SURE**2)
        assert np.linalg.norm((slope.matrix - true) @ way) == pytest.approx(left * missed, abs=1e-9)


def test_a_slope_keeps_across_a_move_what_it_knew() -> None:
    slope = Slope(1)
    slope.learn(np.array([0.0, 0.0, -1e-3]), np.array([-2.0]))
    slope.learn(np.array([1e-3, 0.0, 0.0]), np.array([0.5]))
    np.testing.assert_allclose(slope.matrix, [[500.0, 0.0, 2000.0]], rtol=1e-3)
    # The change over such a short move is noise.
    slope.learn(np.array([1e-8, 0.0, 0.0]), np.array([0.1]))
    np.testing.assert_allclose(slope.matrix, [[500.0, 0.0, 2000.0]], rtol=1e-2)


def foretold(each: LiveSensor, tip: np.ndarray, seconds: float) -> np.ndarray:
    """Return the last answer's prediction for a tip."""
    last = each.answer
    way = tip - last.tip if last.touching else np.array([0.0, 0.0, min(tip[2], 0.0)])
    return last.values + last.slope @ way + last.rate * seconds


@pytest.mark.parametrize("name", ["gelsight", "uskin"])
def test_an_answer_foretells_the_next_one(name: str) -> None:
    row = sensor(name)
    each = LiveSensor(row, named("sphere"), grid=COARSE)
    deep = 0.8 * row.depth_max
    path = [(0.0, 0.0, -deep * k / 10) for k in range(11)]
    path += [(5e-5 * k, 0.0, -deep) for k in range(1, 8)]
    errors, changes = [], []
    for turn, place in enumerate(np.array(path)):
        told, before = foretold(each, place, 0.016), each.answer.values
        each.move(place, 0.016)
        # The first move of each direction is only a guess.
        if turn not in (0, 1, 2, 11):
            errors.append(each.answer.values - told)
            changes.append(each.answer.values - before)
    error, change = (np.sqrt((np.array(each) ** 2).mean(axis=0)) for each in (errors, changes))
    assert (error[[0, 2]] < 0.2 * change[[0, 2]]).all()
    if name == "uskin":
        assert np.linalg.norm(error[6:]) < 0.4 * np.linalg.norm(change[6:])


def test_the_first_answer_is_of_a_sensor_without_contact_that_knows_what_a_touch_does() -> None:
    each = LiveSensor(GELSIGHT, named("cylinder"), grid=COARSE)
    assert not each.answer.touching
    assert not each.answer.values.any()
    assert each.answer.slope[2, 2] > 500.0
    assert not each.press.displacement.any()
    pad = LiveSensor(sensor("uskin"), named("sphere"), grid=COARSE)
    rest = np.rint(sensor("uskin").signal.rest)
    np.testing.assert_array_equal(pad.answer.values[6:].reshape(16, 3), np.tile(rest, (16, 1)))


def dent(row: str, shift: float = 0.0) -> SurfaceField:
    """Return a smooth dent with a sideways part, as wide as the body is thick."""
    body = sensor(row).body
    grid = PixelGrid(body, 64)
    across, along = np.meshgrid(grid.x, grid.y, indexing="ij")
    bell = np.exp(-((across - shift) ** 2 + along**2) / body.thickness**2)
    moved = np.stack([0.3 * across * bell, 0.2 * along * bell, -0.2 * body.thickness * bell], -1)
    return SurfaceField(grid.x, grid.y, moved[None].astype(np.float32))


@pytest.mark.parametrize("name", ["gelsight", "diamond-i", "circle-ii"])
def test_rims_lie_where_the_camera_sees_the_material_of_the_pattern(name: str) -> None:
    row, top = sensor(name), dent(name)
    pattern = row.signal.drawn()[0]
    markers = LiveMarkers(row)
    read = Sampler(PixelGrid(row.body, 64), markers.points)
    rims = markers.outlines(read(top.displacement[0]))
    assert rims.shape == (len(pattern), 32, 2)
    # Rings of material: their centres appear where the markers' centres moved to.
    places = np.column_stack([pattern.centres, np.zeros(len(pattern))]) + top.at(pattern.centres)[0]
    middle = row.signal.camera().project(places)
    inside = (np.abs(pattern.centres) < 7e-3).all(axis=1)
    assert np.abs(rims.mean(axis=1) - middle)[inside].max() < 0.5
    still = markers.outlines(np.zeros((len(markers.points), 3)))
    area = (
        np.abs(
            np.sum(still[..., 0] * np.roll(still[..., 1], -1, 1), 1)
            - np.sum(still[..., 1] * np.roll(still[..., 0], -1, 1), 1)
        )
        / 2
    )
    size = pattern.size / (row.signal.scale or 1)
    expected = {"disc": np.pi / 4, "diamond": 0.5, "square": 1.0}[pattern.shape] * size**2
    np.testing.assert_allclose(area, expected, rtol=1e-6)


def test_tips_of_pins_go_where_the_fine_grid_of_the_skin_says() -> None:
    row, top = sensor("tacpalm"), dent("tacpalm", shift=2e-3)
    pins, centres = row.signal.pins, row.signal.drawn()[0].centres
    expected = pins.tips(top).at(centres)[0]
    found = tips_of(pins, top.at(LiveMarkers(row).points)[0])
    assert np.abs(expected).max() > 1e-3
    assert np.abs(found - expected).max() < 5e-6
    bare = tips_of(Pins(length=0.0, base=0.0), np.repeat(top.at(centres)[0], len(NODES), axis=0))
    np.testing.assert_allclose(bare, top.at(centres)[0], atol=2e-6)


def test_pins_stay_round_and_a_deeper_one_looks_larger() -> None:
    row, top = sensor("tacpalm"), dent("tacpalm")
    markers = LiveMarkers(row)
    rims = markers.outlines(top.at(markers.points)[0])
    size = np.linalg.norm(rims - rims.mean(axis=1, keepdims=True), axis=-1)
    assert np.ptp(size, axis=1).max() < 1e-6
    middle = np.linalg.norm(row.signal.drawn()[0].centres, axis=1).argmin()
    assert size[middle, 0] > 1.03 * size.min()
