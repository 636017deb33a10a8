"""Time-dependent effects and weight: viscosity, inertia and gravity against their references."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.closed_forms import hereditary

from benchmarks.independent.formulas import oedometric_modulus
from sim import (
    Body,
    Effects,
    Friction,
    Gravity,
    Inertia,
    Motion,
    Result,
    Scene,
    Viscosity,
    press,
    simulate,
)
from sim.errors import SimulationDiverged
from sim.fem import Fem, in_time
from sim.fem.outcome import checked
from sim.fem.solver import simulate_fem
from sim.indenters import named, plane, sphere
from sim.layer import Layer
from sim.result import Outcome, force_scale
from trajectories import Point

pytestmark = pytest.mark.slow

SMALL = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
SPACING = 4e-3 / 3
COARSE = Fem(spacing=SPACING, precision="float64")
EXACT = Fem(spacing=SPACING, precision="float64", tolerance=1e-7)
GLASS = 0.5


def _viscous(relaxes: str = "all") -> Effects:
    return Effects(viscosity=Viscosity((GLASS,), (0.1,), relaxes=relaxes))  # type: ignore[arg-type]


@pytest.mark.parametrize("relaxes", ["all", "shear"])
def test_a_fast_press_feels_the_modulus_before_relaxation(relaxes: str) -> None:
    """Shear modulus times 1.5, with `all` also the bulk modulus: exactly another elastic body."""
    shear = SMALL.shear_modulus * (1 + GLASS)
    bulk = SMALL.bulk_modulus * (1 + GLASS if relaxes == "all" else 1.0)
    modulus = 9 * bulk * shear / (3 * bulk + shear)
    poisson = (3 * bulk - 2 * shear) / (2 * (3 * bulk + shear))
    glass = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3, modulus=modulus, poisson=poisson)
    # Contact springs are given in moduli: use the same springs for both.
    same_springs = Fem(
        spacing=SPACING,
        precision="float64",
        tolerance=1e-7,
        penalty=EXACT.penalty * SMALL.modulus / modulus,
    )
    expected = simulate(Scene(sphere(3e-3), press([0.5e-3]), glass), same_springs)
    motion = press([0.5e-3], speed=1e3)
    found = simulate(Scene(sphere(3e-3), motion, SMALL, _viscous(relaxes)), EXACT)
    assert found.force[-1, 2] == pytest.approx(expected.force[-1, 2], rel=1e-5)


def test_a_skin_that_has_not_come_back_lets_go_of_a_lifted_tip() -> None:
    """An overlap before it is no sign that the tip went through, unless it goes deeper or aside.

    It may come down again as far as the skin had yielded, as force-depth presses do.
    """
    depths = (0, 0.5, 1.0, 1.0, 0.3, -0.1, 0.2, 0.5)
    times = (0, 0.1, 0.2, 3.0, 3.05, 3.1, 3.13, 3.15)
    path = tuple((0.0, 0.0, -1e-3 * depth) for depth in depths)
    body = replace(SMALL, size_x=12e-3, size_y=12e-3)
    slow = Effects(friction=Friction(0.5), viscosity=Viscosity((0.5, 0.5), (0.05, 0.6)))
    scene = Scene(named("cylinder"), Motion(path, times), body, slow)
    found = simulate(scene, Fem(spacing=1e-3))
    for result in (found, simulate(scene, Layer(grid=48))):
        assert result.force.any(axis=1).tolist() == [False, *[True] * 3, *[False] * 3, True]
        assert result.force[1:4, 2].max() < -1.0
    assert found.quality.overlap_path[:5].max() > 0.1e-3

    def outcome_of_path(*tips: Point) -> Result | SimulationDiverged:
        wrench = found.wrench.copy()
        wrench[4:] = 0.0
        tips = (*tips, *tips[-1:] * (len(path) - len(tips)))
        moved = replace(scene, motion=Motion(tips, times))
        return checked(replace(found, scene=moved, wrench=wrench))

    assert isinstance(outcome_of_path(*path), Result)
    for tips in (
        (*path[:4], (0.0, 0.0, -1.2e-3)),
        (*path[:4], (1e-3, 0.0, -0.9e-3)),
        (*path[:6], (0.0, 0.0, -1.01e-3)),
        (*path[:6], (3e-3, 0.0, -0.2e-3)),
    ):
        with pytest.raises(SimulationDiverged, match=f"no force at waypoint {len(tips) - 1}"):
            raise outcome_of_path(*tips)  # type: ignore[misc]


def test_a_shallow_ramp_and_hold_relaxes_as_lee_and_radok_say() -> None:
    """Force of the elastic press on the same mesh, passed through the hereditary integral."""
    motion = press([0.15e-3], hold=0.4, steps=4, speed=0.15e-3 / 0.1)
    numerics = Fem(spacing=4e-3 / 5, precision="float64")
    elastic = simulate(Scene(sphere(3e-3), motion, SMALL), numerics)
    viscous = simulate(Scene(sphere(3e-3), motion, SMALL, _viscous()), numerics)
    expected = hereditary(motion.time, -elastic.force[:, 2], (GLASS,), (0.1,))
    found = -viscous.force[:, 2]
    # On the ramp the elastic force is not linear between frames; small strain.
    assert found[1:5] == pytest.approx(expected[1:5], rel=0.02)
    assert found[5:] == pytest.approx(expected[5:], rel=5e-3)
    assert (np.diff(found[4:]) < 0).all(), "it relaxes all the while"
    assert viscous.quality.energy_gap[-1] > elastic.quality.energy_gap[-1]


def test_the_force_of_an_impact_is_that_of_a_wave_and_does_not_ring() -> None:
    """A plate at constant speed on a layer that does not widen: waves go up and down.

    The pressure is density * wave speed * speed, and twice as much more with every return of the
    wave from the bonded base. A mesh spreads each rise over the time in which a wave crosses some
    elements. Frames may be shorter than a wave takes to cross an element.
    """
    body = replace(SMALL, size_x=2e-3, size_y=2e-3, poisson=0.0)
    speed, wave = 0.1, math.sqrt(SMALL.modulus / SMALL.density)
    impact = body.density * wave * speed * body.size_x * body.size_y
    returns = 2 * body.thickness / wave
    ends = [
        *(returns * (0.01 * i) for i in range(1, 6)),
        *(returns * (0.1 * i) for i in range(1, 15, 2)),
    ]
    tip = [(0.0, 0.0, -speed * time) for time in (0.0, *ends)]
    motion = Motion(tuple(tip), (0.0, *ends))
    found = simulate(Scene(plane(), motion, body, Effects(inertia=Inertia())), Fem(spacing=0.5e-3))
    time = np.array(ends)
    force = -found.force[1:, 2]
    expected = impact * np.where(time < returns, 1.0, 3.0)
    error = np.abs(force - expected) / force
    passing = (time > 0.65 * returns) & (time < 1.25 * returns)
    stated = np.array(found.record["error"]["force"])[1:]
    assert (error <= stated)[~passing].all()
    assert (error <= 2.1 * stated).all(), "while the wave passes the elements at the top"
    assert error[~passing].max() < 0.25
    assert error[~passing & (time > 0.15 * returns)].max() < 0.07
    assert (np.abs(np.diff(force[:5])) < 0.12 * impact).all(), "short frames do not ring"


def test_a_gel_a_hundred_times_as_stiff_at_once_presses_like_an_elastic_one() -> None:
    """Contact is stiffer too: else the indenter stands in the skin."""
    scene = Scene(sphere(4e-3), press([0.4e-3], speed=0.1), SMALL)
    stiff = replace(SMALL, modulus=101 * SMALL.modulus)
    viscous = replace(scene, effects=Effects(viscosity=Viscosity((100.0,), (1e3,))))
    one, other = (
        simulate(each, COARSE).force[-1, 2] for each in (viscous, replace(scene, body=stiff))
    )
    assert one == pytest.approx(other, rel=0.01)


def test_a_body_that_is_touched_at_once_is_at_rest_however_heavy_it_is() -> None:
    inside = Motion(((0.0, 0.0, -0.4e-3),), (0.0,))
    still, heavy = (
        simulate(Scene(sphere(3e-3), inside, SMALL, effects), COARSE).force[0, 2]
        for effects in (Effects(), Effects(inertia=Inertia(100.0)))
    )
    assert heavy == pytest.approx(still, rel=1e-4)


HELD = Scene(
    sphere(3e-3), press([0.4e-3], hold=0.5e-3, speed=2.0), SMALL, Effects(inertia=Inertia())
)
CREEPS = Scene(sphere(3e-3), press([0.1e-3, 0.6e-3], hold=0.01, speed=20e-3), SMALL, _viscous())


@pytest.mark.parametrize("scene", [HELD, CREEPS], ids=["inertia", "viscosity"])
def test_the_stated_error_contains_that_of_time_steps(scene: Scene) -> None:
    """Against four times as many steps on the same mesh; scenes at rest have none."""
    numerics = Fem(fineness=0.35)
    found = simulate(scene, numerics)
    time = found.record["time"]
    (many,) = simulate_fem([scene], replace(numerics, step_factor=4 * time["factor"]))
    assert isinstance(many, Result)
    apart = np.abs(found.force - many.force).max(axis=1) / force_scale(many.force)
    assert 0 < apart.max() <= max(time["force"])
    assert (apart <= np.array(found.record["error"]["force"])).all()
    assert max(time["force"]) < 20 * apart.max()
    assert "time" not in simulate(replace(scene, effects=Effects()), Fem(fineness=0.2)).record


def test_without_a_companion_for_later_frames_their_error_by_time_steps_is_larger(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def breaks_off(scenes: Any, numerics: Fem, **_options: Any) -> list[Outcome]:
        diverged = SimulationDiverged("none")
        if frames:
            force = np.array([0.0, -1.0 - 0.02 / numerics.step_factor])
            diverged.reached = replace(plain, wrench=np.pad(force[:, None], ((0, 0), (2, 3))))
        return [diverged]

    plain = simulate(Scene(sphere(3e-3), press([0.1e-3]), SMALL), Fem(spacing=SPACING))
    monkeypatch.setattr(in_time, "simulate_fem", breaks_off)
    frames = 2
    first = in_time.time_steps(HELD, Fem(step_factor=1), "cpu")
    frames = 0
    none = in_time.time_steps(HELD, Fem(step_factor=1), "cpu")
    assert first is not None
    assert none is not None
    assert first.force[1] == pytest.approx(2 * 0.01 / 1.01, rel=1e-6)
    assert first.force[2] == pytest.approx(2 * first.force[1])
    assert none.force.min() >= 0.3


def test_a_body_let_go_swings_at_the_frequency_of_its_thickness() -> None:
    """Pressed uniformly, then released: the middle oscillates before waves from the sides arrive.

    A mesh of three layers damps its waves.
    """
    wide = Body(size_x=32e-3, size_y=32e-3, thickness=4e-3, poisson=0.3)
    # A wave of compression crosses the layer four times.
    speed = math.sqrt(oedometric_modulus(wide.modulus, wide.poisson) / wide.density)
    period = 4 * 4e-3 / speed
    step = period / 48
    away = 1e-3
    tip = [(0.0, 0.0, 0.0), (0.0, 0.0, -40e-6), (0.0, 0.0, away)]
    time = [0.0, 1.0, 1.0 + 1e-7]
    for index in range(42):
        tip.append((0.0, 0.0, away + 1e-9 * (index + 1)))
        time.append(time[-1] + step)
    scene = Scene(plane(), Motion(tuple(tip), tuple(time)), wide, Effects(inertia=Inertia()))
    height = simulate(scene, COARSE).surface[2:, 12, 12, 2].astype(float)
    assert height[0] < -35e-6, "let go, it has not moved yet"
    before = np.flatnonzero(height[:-1] * height[1:] < 0)
    crossings = [i + height[i] / (height[i] - height[i + 1]) for i in before]
    assert len(crossings) == 2
    assert (crossings[1] - crossings[0]) * step == pytest.approx(period / 2, rel=0.04)
    late = crossings[0] * step - period / 4
    assert 0 < late < 0.6 * SPACING / speed, "by the time in which a wave crosses half an element"
    assert 0.3 < height.max() / 40e-6 < 1.0, "it swings to the other side, damped"


@pytest.mark.parametrize("speed", [20e-3, 2e-3])
def test_what_viscosity_takes_is_told_the_same_by_few_and_by_many_steps(speed: float) -> None:
    scene = Scene(sphere(3e-3), press([0.6e-3, 0.1e-3], speed=speed), SMALL, _viscous())
    fine = Fem(spacing=SPACING, step_travel=4e-3 / 200)
    few, many = (
        simulate(scene, numerics).quality.energy_gap for numerics in (Fem(spacing=SPACING), fine)
    )
    assert few == pytest.approx(many, abs=0.012)


def test_weight_is_no_loss() -> None:
    effects = Effects(gravity=Gravity((0.0, 0.0, -50.0)))
    scene = Scene(sphere(3e-3), press([0.6e-3, 0.2e-3]), SMALL, effects)
    gap = simulate(scene, Fem(spacing=SPACING)).quality.energy_gap
    assert np.abs(gap).max() < 0.005


@pytest.mark.parametrize(("pull", "found"), [((24.0, 0.0, 0.0), True), ((0.0, 0.0, -49.05), False)])
def test_strong_gravity_is_brought_up_in_steps(pull: Point, found: bool) -> None:
    """A gel of 100 Pa: too heavy for 15 iterations in one step; downwards it has no solution."""
    gel = Body(20e-3, 20e-3, 10e-3, modulus=100.0)
    away = Motion(((0.0, 0.0, 90e-3),), (0.0,))
    scene = Scene(sphere(4e-3), away, gel, Effects(gravity=Gravity(pull)))
    numerics = Fem(spacing=10e-3 / 3, precision="float64", halvings=4, newton_max=15)
    if found:
        result = simulate(scene, numerics)
        assert result.quality.steps[0] > 1
        assert result.quality.balance[0] < 1e-4, "the base carries the weight, all of it"
    else:
        with pytest.raises(SimulationDiverged, match=r"% of gravity's \(0, 0, -49.05\) m/s\^2"):
            simulate(scene, numerics)
