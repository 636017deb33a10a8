"""Presses by a ladder: against the solver they are superposed from, and laws they must obey."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim import ladder as ladders
from sim import simulate
from sim.fem import Fem
from sim.indenters import named, sphere
from sim.ladder import Ladder, LadderPress
from sim.scene import Effects, Motion, Scene, press
from sim.sensors import SurfaceField, sensor
from sim.stream.stream import LivePress

ROW = sensor("r6")
FRICTION, MM = 0.5, 1e-3


@pytest.fixture(scope="module")
def ladder() -> Ladder:
    return Ladder.of("sphere_s", ROW)


def bare(name: str) -> Ladder:
    """Return the ladder as `layer` has it, for comparison."""
    felt = ROW.scene(named(name), Motion(((0.0, 0.0, 0.0),), (0.0,))).indenter
    return Ladder(ladders.presses_of(felt, ROW, Path("unused")), ROW.body, ladders.BARE)


@pytest.mark.parametrize("name", ["sphere_s", "prism"])
def test_it_follows_the_solver_on_a_path_off_the_ladder(name: str) -> None:
    solver = LivePress(ROW, named(name), grid=64, tolerance=5e-3)
    press = LadderPress(bare(name), FRICTION, ROW.effects.viscosity)
    down = [(0.0, 0.0, -0.29 * n) for n in (1, 2, 3)]
    aside = [(0.2 * n, -0.1 * n, -0.87) for n in (1, 2, 3, 1)]
    for tip in [*down, *aside, (0.2, -0.1, -0.4)]:
        solver.move(np.array(tip) * MM, 0.05)
        press.move(np.array(tip) * MM, 0.05)
        true, own = solver.wrench, press.wrench
        assert own[2] == pytest.approx(true[2], rel=0.05)
        assert np.hypot(*(own - true)[:2]) <= 0.08 * FRICTION * -true[2]
    press.move(solver.tip + np.array([0.0, 0.0, 2e-3]), 1e3)
    assert not press.wrench[:3].any()


def test_markers_move_as_in_the_solver_where_skin_is_not_drawn(
    ladder: Ladder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ladders, "DRAWN", 0.0)
    row = replace(ROW, effects=Effects(friction=ROW.effects.friction))
    solver = LivePress(row, named("sphere_s"), grid=64, tolerance=5e-3)
    press = LadderPress(bare("sphere_s"), FRICTION)
    at = np.meshgrid(solver.grid.x[8:-8:4], solver.grid.y[8:-8:4], indexing="ij")
    for tip in ((0.0, 0.0, -0.5), (0.0, 0.0, -0.83), (0.3, 0.2, -0.83)):
        solver.move(np.array(tip) * MM, 0.1)
        press.move(np.array(tip) * MM, 0.1)
        true = np.moveaxis(solver.displacement, 0, -1)[8:-8:4, 8:-8:4].reshape(-1, 3)
        off = press.markers(np.stack(at, axis=-1).reshape(-1, 2)) - true
        assert np.linalg.norm(off) <= 0.1 * np.linalg.norm(true)


@pytest.mark.parametrize(
    ("x", "y", "shear", "most"),
    [(0.0, 0.0, 0.0, 0.12), (1.5, -1.0, 0.0, 0.17), (0.7, 0.2, 0.4, 0.12)],
)
def test_markers_of_a_press_move_as_by_finite_elements(
    x: float, y: float, shear: float, most: float
) -> None:
    still, depth = Effects(friction=ROW.effects.friction), 0.6 * MM
    motion = press([depth], at=(x * MM, y * MM), shear=shear * MM, angle=0.5)
    motion = Motion(motion.tip[:3], motion.time[:3]) if shear else motion
    true = simulate(Scene(named("sphere_s"), motion, ROW.body, still), Fem(fineness=0.5))
    own = LadderPress(Ladder.of("sphere_s", ROW), FRICTION)
    for before, after in itertools.pairwise(np.array(motion.tip)):
        for fraction in np.linspace(0.0, 1.0, 9):
            own.move(before + fraction * (after - before), 1.0)
    axis = np.linspace(-0.4, 0.4, 17) * ROW.body.size_x
    places = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    moved = np.asarray(SurfaceField.of(true).at(places))[-1]
    off = np.linalg.norm((own.markers(places) - moved)[:, :2])
    assert off < most * np.linalg.norm(moved[:, :2])
    assert own.wrench[2] == pytest.approx(true.force[-1, 2], rel=0.05)


def test_shear_never_exceeds_friction_nothing_pulls_and_loops_lose_work(ladder: Ladder) -> None:
    press = LadderPress(ladder, FRICTION, ROW.effects.viscosity)
    random, work, before = np.random.default_rng(1), 0.0, np.zeros(3)
    places = np.cumsum(random.normal(0, 0.2 * MM, (300, 3)), axis=0)
    places[:, 2] = np.clip(places[:, 2], -1.5 * MM, 0.5 * MM)
    start = np.array([0.0, 0.0, MM])
    tip = start
    press.move(start, 0.0)
    for goal in [*places, start]:
        for part in np.linspace(0.1, 1.0, 10):
            at = tip + part * (goal - tip)
            moved = at - press.tip
            press.move(at, 1e-3)
            force = press.wrench[:3]
            assert force[2] <= 0
            assert np.hypot(*force[:2]) <= -FRICTION * force[2] * (1 + 1e-9)
            work += float((force + before) @ moved) / 2
            before = force
        tip = goal
    assert work > 0


def test_a_sphere_has_no_side_and_a_soft_skin_less_force(ladder: Ladder) -> None:
    first, turned = LadderPress(ladder, FRICTION), LadderPress(ladder, FRICTION)
    points = np.array([[1.0, 2.0], [-3.0, 0.5]]) * MM
    for x, y, z in ((0.0, 0.0, -0.9), (0.4, 0.1, -0.9), (0.1, 0.1, -0.6)):
        first.move(np.array([x, y, z]) * MM, 0.1)
        turned.move(np.array([-y, x, z]) * MM, 0.1)
    assert turned.wrench[:2] == pytest.approx([-first.wrench[1], first.wrench[0]], rel=0.01)
    moved, other = first.markers(points), turned.markers(points @ [[0.0, 1.0], [-1.0, 0.0]])
    assert other[:, :2] == pytest.approx(moved[:, :2] @ [[0.0, 1.0], [-1.0, 0.0]], abs=2e-6)
    soft = Ladder.of("sphere_s", sensor("r18"))
    assert soft.normal(MM) == pytest.approx(ladder.normal(MM) * 120 / 300)
    assert soft.deepest(soft.normal(MM)) == pytest.approx(MM, rel=1e-3)
    low, high = soft.interval(MM)
    assert low < soft.normal(MM) < high


def test_a_body_ends(ladder: Ladder) -> None:
    press, forces = LadderPress(ladder, FRICTION), []
    for x in (0.0, 8.0, 10.0, 13.0):
        press.move(np.array([x * MM, 0.0, -MM]), 0.1)
        forces.append(-press.wrench[2])
    assert forces[1] == pytest.approx(forces[0], rel=1e-3)
    assert forces[2] == pytest.approx(forces[0] / 2, rel=0.02)
    assert forces[3] == 0


def test_an_indenter_of_ones_own_is_solved_once_and_kept(tmp_path: Path) -> None:
    own = sphere(1.5 * MM)
    first = Ladder.of(own, ROW, tmp_path)
    (kept,) = tmp_path.iterdir()
    written = kept.stat().st_mtime_ns
    assert Ladder.of(own, ROW, tmp_path).normal(MM) == first.normal(MM)
    assert kept.stat().st_mtime_ns == written
    kept.write_bytes(b"torn")
    assert Ladder.of(own, ROW, tmp_path).normal(MM) == first.normal(MM)


def test_packaged_ladders_are_those_of_the_solver(ladder: Ladder) -> None:
    felt = ROW.scene(named("sphere_s"), Motion(((0.0, 0.0, 0.0),), (0.0,))).indenter
    solved = ladders.solved(felt, ROW.body, ladder.depth_max)
    packaged = ladders.presses_of(felt, ROW, Path("unused"))
    assert packaged.wrench == pytest.approx(solved.wrench, rel=1e-4, abs=1e-9)
