"""Settings of the `mpm` tier: sampling, mass, time step, and invalid values."""

from dataclasses import replace

import numpy as np
import pytest

from sim import Body, Motion, Scene, SceneError, press
from sim.indenters import sphere
from sim.mpm import AUTHORS_CELL, STABLE, Mpm
from sim.mpm.lattice import build_lattice, pace_of

SCENE = Scene(sphere(4e-3), press([0.5e-3, 1e-3]))
CELL = 0.5e-3


def test_the_particles_share_out_the_volume_of_the_body() -> None:
    lattice = build_lattice([SCENE], Mpm(cell=CELL))
    assert lattice.counts == (80, 80, 16)
    assert lattice.volume.sum() * CELL**3 == pytest.approx(20e-3 * 20e-3 * 4e-3)
    place = (lattice.rest - lattice.origin) * CELL
    np.testing.assert_allclose(place.min(axis=0), [-9.875e-3, -9.875e-3, -3.875e-3])
    np.testing.assert_allclose(place.max(axis=0), [9.875e-3, 9.875e-3, -0.125e-3])


def test_columns_of_particles_reach_up_to_a_dome_and_no_further() -> None:
    body = Body(size_x=6e-3, size_y=6e-3, dome_radius=10e-3)
    lattice = build_lattice([replace(SCENE, body=body)], Mpm(cell=CELL))
    top = lattice.rest[-len(lattice.to_surface) :] + lattice.to_surface
    x, y, z = ((top - lattice.origin) * CELL).T
    np.testing.assert_allclose(z, [body.height(u, v) for u, v in zip(x, y, strict=True)])
    span = np.linspace(-3e-3, 3e-3, 2001)[:-1] + 0.75e-6
    mean = np.mean(np.sqrt(10e-3**2 - span[:, None] ** 2 - span**2) - 10e-3)
    volume = lattice.volume.sum() * CELL**3
    assert volume == pytest.approx((4e-3 + mean) * 6e-3**2, rel=2e-3)


def test_the_mass_follows_from_the_speed_of_the_tip() -> None:
    numerics = Mpm(cell=CELL)
    pace = pace_of(SCENE, numerics, CELL)
    assert pace.speed_ratio == pytest.approx(0.01)
    assert pace.courant == pytest.approx(0.5)
    assert pace.steps == 1e-3 / CELL / 0.01 / 0.5
    # Then time has no meaning: a faster motion takes the same steps.
    fast = pace_of(Scene(sphere(4e-3), press([0.5e-3, 1e-3], speed=1.0)), numerics, CELL)
    np.testing.assert_array_equal(fast.at, pace.at)


def test_a_hold_takes_a_few_periods_whatever_it_lasts() -> None:
    short, long = (
        pace_of(
            Scene(sphere(4e-3), press([1e-3], hold=hold, steps=10, speed=1e-3 / 0.1)), Mpm(), CELL
        )
        for hold in (0.1, 1e5)
    )
    assert short.steps == long.steps


def test_a_motion_that_begins_inside_the_body_is_entered_from_above() -> None:
    inside = Motion(tip=((0.0, 0.0, -0.5e-3), (0.0, 0.0, -1e-3)), time=(0.0, 0.05))
    pace = pace_of(Scene(sphere(4e-3), inside), Mpm(cell=CELL), CELL)
    np.testing.assert_array_equal(pace.corners[0], [0, 0, 0])
    assert pace.at[0] == 0
    assert pace.at[1] == pytest.approx(pace.at[2] - pace.at[1], abs=1)


def test_a_time_step_above_the_stability_limit_is_refused() -> None:
    numerics, body = Mpm.authors(), SCENE.body
    soft = pace_of(SCENE, numerics, AUTHORS_CELL).courant
    for below, stiffness in ((True, 0.999), (False, 1.001)):
        modulus = body.modulus * stiffness * (STABLE / soft) ** 2
        scene = replace(SCENE, body=replace(body, modulus=modulus))
        if below:
            assert pace_of(scene, numerics, AUTHORS_CELL).courant == pytest.approx(STABLE, rel=1e-3)
            continue
        with pytest.raises(SceneError, match=r"mpm\.published: time steps of 0\.0001 s; allowed"):
            pace_of(scene, numerics, AUTHORS_CELL)


def test_a_motion_of_too_many_steps_is_refused() -> None:
    slow = Scene(sphere(4e-3), press([1e-3], hold=1.0, steps=10, speed=1e-3 / 1e4))
    with pytest.raises(SceneError, match=r"motion.*allowed: 5,000,000 steps"):
        pace_of(slow, Mpm.authors(), AUTHORS_CELL)


def test_the_authors_preset_is_what_their_code_says() -> None:
    numerics = Mpm.authors()
    lattice = build_lattice([SCENE], numerics)
    pace = pace_of(SCENE, numerics, lattice.cell)
    assert lattice.counts == (101, 101, 21)
    assert numerics.per_cell**3 == pytest.approx(0.27, abs=0.005)
    assert pace.wave_speed == pytest.approx(0.74, abs=0.005)
    assert pace.courant == pytest.approx(0.575, abs=0.005)
    assert lattice.held == 3 * 101 * 101
    # Their particle volume makes forces too small by this ratio.
    volume = lattice.volume[0] * lattice.cell**3
    assert 0.2e-3**3 / volume == pytest.approx(1.93, abs=0.005)


def test_the_released_preset_makes_the_body_it_really_makes() -> None:
    body = Body(size_x=25e-3, size_y=25e-3, thickness=5e-3)
    scene = Scene(sphere(4e-3), press([1e-3], speed=40e-3), body)
    numerics = Mpm(published="genforce")
    assert build_lattice([scene], numerics).counts == (101, 101, 21)
    assert numerics.per_cell**3 == pytest.approx(0.14, abs=0.005)
    assert pace_of(scene, numerics, AUTHORS_CELL).speed_ratio > 0.05
