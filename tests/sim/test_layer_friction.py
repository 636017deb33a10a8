"""Coulomb friction on the layer: pointwise, against exact solutions, and around loops."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from support.closed_forms import mindlin_displacement, mindlin_stick_radius

from sim.errors import SimulationDiverged
from sim.indenters import flat_punch, sphere
from sim.layer import Layer, contact
from sim.layer.solver import LayerPress, simulate_layer
from sim.layer.spectral import Convolutions, PixelGrid, compliance
from sim.result import Result
from sim.scene import Body, Effects, Friction, Motion, Scene, press, through
from tests.support.few import few


def _loop(coefficient: float, *, steps: int = 3, grid: int = 64, angle: float = 0.0) -> Result:
    motion = press([1.2e-3], shear=1.0e-3, steps=steps, angle=angle)
    effects = Effects(friction=Friction(coefficient))
    return simulate_layer(Scene(sphere(4e-3), motion, effects=effects), Layer(grid=grid))


def test_every_pixel_sticks_or_slips_as_coulomb_says() -> None:
    motion = through([(0, 0, 0), (0, 0, -1e-3), (0.3e-3, 0, -1e-3)], speed=1e-2)
    scene = Scene(sphere(4e-3), motion, effects=Effects(friction=Friction(0.5)))
    state = LayerPress(scene, PixelGrid(scene.body, 64), 1e-5)
    for tip in motion.tip:
        state.move(np.array(tip), 0.1)
    before, steps = state.displacement.astype(float), state.spent.steps
    move = np.array([0.1e-3, 0.02e-3, 0.0])
    state.move(state.tip + move, 0.1)
    assert state.spent.steps == steps + 1
    slide = state.displacement[:2] - before[:2] - move[:2, None, None]
    pressure, shear = -state.traction[2], state.traction[:2]
    bound, size = 0.5 * pressure, np.hypot(*shear)
    assert (size <= bound * (1 + 1e-12)).all()
    sticks = size < 0.99 * bound
    slips = (np.hypot(*slide) > 0.02 * np.hypot(*move[:2])) & (pressure > 0)
    assert np.count_nonzero(sticks) > 20
    assert np.count_nonzero(slips) > 20
    assert not (sticks & slips).any()
    along = np.einsum("ixy,ixy->xy", shear, slide)[slips]
    np.testing.assert_allclose(along, -(bound * np.hypot(*slide))[slips], rtol=5e-3)


def test_no_friction_is_friction_zero_and_the_limit_of_little() -> None:
    motion = press([1.2e-3], shear=1.0e-3, steps=2)
    none = simulate_layer(Scene(sphere(4e-3), motion), Layer(grid=64))
    zero = _loop(0.0, steps=2)
    np.testing.assert_array_equal(none.traction, zero.traction)
    np.testing.assert_array_equal(none.surface, zero.surface)
    np.testing.assert_allclose(_loop(1e-4, steps=2).force, none.force, atol=2e-3 * 1.25)


def test_a_punch_that_sticks_moves_the_body_as_a_bonded_disc_does() -> None:
    depth, shift, grid = 0.2e-3, 0.05e-3, PixelGrid(Body(), 48)
    motion = through([(0, 0, 0), (0, 0, -depth), (shift, 0, -depth)], speed=1e-2)
    effects = Effects(friction=Friction(10.0))
    state = LayerPress(Scene(flat_punch(2e-3), motion, effects=effects), grid, 1e-6)
    state.move(np.array([0, 0, -depth]), 0.1)
    held = state.force
    state.move(np.array([shift, 0, -depth]), 0.1)
    # The displacements of all pixels of the disc are given: one linear system.
    inside = np.hypot(grid.x[:, None], grid.y[None, :]) < 2e-3
    answer = Convolutions(grid).within(grid.shape).answer
    places = np.flatnonzero(np.broadcast_to(inside, (3, *grid.shape)))
    load, matrix = np.zeros(3 * grid.shape[0] * grid.shape[1]), []
    for place in places:
        load[place] = 1
        matrix.append(answer.full(load.reshape(3, *grid.shape)).ravel()[places])
        load[place] = 0
    third = len(places) // 3
    given = np.repeat([shift, 0.0, 0.0], third)
    expected = np.linalg.solve(np.array(matrix).T, given).reshape(3, third).sum(axis=1) * grid.area
    # The wall crosses pixels, which are here all or nothing, and moves by an eighth of one.
    np.testing.assert_allclose(state.force - held, expected, atol=0.05 * expected[0])


@pytest.mark.slow
def test_a_sphere_slips_from_the_rim_inwards_as_mindlin_says() -> None:
    radius, coefficient, depth = 20e-3, 0.5, 0.03e-3
    body = Body(size_x=8e-3, size_y=8e-3, thickness=16e-3, poisson=0.49)
    shifts = np.array([0.2, 0.4, 0.6, 0.8, 0.95]) * 0.7 * depth
    points = [(0.0, 0.0, 0.0), (0.0, 0.0, -depth)] + [(float(s), 0.0, -depth) for s in shifts]
    effects = Effects(friction=Friction(coefficient))
    scene = Scene(sphere(radius), through(points, speed=1e-3), body=body, effects=effects)
    result = simulate_layer(scene, Layer(tolerance=2e-4))
    normal, tangential = -result.force[1, 2], result.force[2:, 0]
    np.testing.assert_allclose(-result.force[2:, 2], normal, rtol=2e-3)
    # Radius of the contact: Johnson, Contact Mechanics (1985), eq. 4.22.
    rim = (3 * normal * radius * (1 - body.poisson**2) / (4 * body.modulus)) ** (1 / 3)
    compliant = _base_shift(body)
    pixel = result.surface_x[1] - result.surface_x[0]
    for shift, force, traction in zip(shifts, tangential, result.traction[2:], strict=True):
        arguments = (force, normal, coefficient, rim)
        expected = mindlin_displacement(*arguments, body.modulus, body.poisson)
        assert shift == pytest.approx(expected + compliant * force, rel=0.02)
        size = np.hypot(traction[..., 0], traction[..., 1])
        sticks = (traction[..., 2] < 0) & (size < 0.999 * coefficient * -traction[..., 2])
        core = math.sqrt(np.count_nonzero(sticks) * pixel**2 / math.pi)
        assert core == pytest.approx(mindlin_stick_radius(*arguments), abs=pixel)


def _base_shift(body: Body) -> float:
    """Return the base's (negative) effect on the shift around a small sideways load [m/N]."""

    def lacking(k: float) -> float:
        at = np.array([k])
        layer = compliance(
            at, thickness=body.thickness, shear_modulus=body.shear_modulus, poisson=body.poisson
        )
        along, across = layer.from_along[0], layer.from_across[0]
        half_space = (2 - body.poisson) / (body.shear_modulus * k)
        return (along + across - half_space) * k / (4 * math.pi)

    return float(quad(lacking, 1e-6, 20 / body.thickness)[0])


def test_forces_of_a_press_and_shear_agree_with_an_independent_program() -> None:
    for coefficient, there, back in ((0.3, 0.373, -0.284), (0.8, 0.698, -0.130)):
        result = _loop(coefficient, grid=96)
        assert result.force[6, 0] == pytest.approx(there, abs=0.004)
        assert result.force[9, 0] == pytest.approx(back, abs=0.004)


@pytest.mark.slow
@pytest.mark.parametrize("coefficient", [0.3, 0.8])
def test_a_loop_loses_energy_and_ends_without_force(coefficient: float) -> None:
    result = _loop(coefficient)
    assert result.quality.energy_gap[-1] > 0.05
    assert result.quality.slip_excess.max() < 1e-6
    assert (np.hypot(*result.force[:, :2].T) <= -coefficient * result.force[:, 2] + 1e-9).all()
    np.testing.assert_array_equal(result.force[-1], 0)
    np.testing.assert_array_equal(result.surface[-1], 0)


@pytest.mark.slow
def test_shear_turned_by_a_right_angle_turns_everything() -> None:
    along, aside = _loop(0.8), _loop(0.8, angle=math.pi / 2)
    scale = np.abs(along.force).max()
    np.testing.assert_allclose(
        along.wrench[:, [1, 0, 2]] * [-1, 1, 1], aside.wrench[:, :3], atol=2e-3 * scale
    )


@pytest.mark.slow
def test_long_moves_are_cut_until_friction_no_longer_depends_on_them() -> None:
    coarse, fine = _loop(0.8, steps=1, grid=96), _loop(0.8, steps=24, grid=96)
    assert coarse.quality.steps.max() > 4
    at_corners = fine.force[[0, 24, 48, 72, 96]]
    peak = np.abs(fine.force[:, 0]).max()
    np.testing.assert_allclose(coarse.force, at_corners, atol=5e-3 * peak)


@pytest.mark.parametrize(
    ("coefficient", "poisson", "thickness"),
    few(
        [
            pytest.param(10.0, 0.49995, 4e-3),
            pytest.param(3.0, 0.0, 1e-3),
            pytest.param(3.0, 0.0, 4e-3),
            pytest.param(10.0, 0.45, 4e-3),
        ],
        1,
    ),
)
def test_much_friction_converges(coefficient: float, poisson: float, thickness: float) -> None:
    scene = Scene(
        sphere(4e-3),
        press([0.3 * thickness], shear=1.0e-3, steps=1),
        body=Body(poisson=poisson, thickness=thickness),
        effects=Effects(friction=Friction(coefficient)),
    )
    result = simulate_layer(scene, Layer(grid=64))
    assert result.quality.residual.max() <= 2e-3
    assert result.force[2, 0] > -0.5 * result.force[2, 2]
    # A body strongly drawn in by shear still touches where it carries load, without other overlap.
    assert result.quality.contact.max() < 2e-3


def test_what_does_not_converge_is_never_returned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contact, "TURNS", 1)
    motion = Motion(tip=((0, 0, 0), (0.2e-3, 0, -1e-3)), time=(0.0, 1.0))
    scene = Scene(sphere(4e-3), motion, effects=Effects(friction=Friction(0.8)))
    with pytest.raises(SimulationDiverged, match="no converged state after the tip") as caught:
        simulate_layer(scene, Layer(grid=32))
    assert len(caught.value.tried) == 5
    assert caught.value.dump is not None
    with np.load(caught.value.dump) as state:
        assert state["traction"].shape == (3, 32, 32)
    caught.value.dump.unlink()
    caught.value.dump.parent.rmdir()


def test_a_press_with_friction_is_a_little_stiffer() -> None:
    scene = Scene(sphere(4e-3), press([1.5e-3]), body=Body(poisson=0.3))
    slippery = simulate_layer(scene, Layer(grid=64))
    rough = simulate_layer(
        Scene(
            scene.indenter, scene.motion, body=scene.body, effects=Effects(friction=Friction(1.0))
        ),
        Layer(grid=64),
    )
    assert 1.002 < rough.force[-1, 2] / slippery.force[-1, 2] < 1.1
