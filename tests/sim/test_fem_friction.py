"""Coulomb friction of the finite-element tier, in whole presses."""

import numpy as np
import pytest

from sim import Body, Effects, Friction, Scene, press, simulate
from sim.fem import Fem
from sim.indenters import sphere

SMALL = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
COARSE = Fem(spacing=4e-3 / 3, precision="float64")
MU = 0.4


def _loop(angle: float, shear: float = 0.5e-3, steps: int = 2) -> Scene:
    motion = press([0.4e-3], shear=shear, angle=angle, steps=steps)
    return Scene(sphere(3e-3), motion, SMALL, Effects(friction=Friction(MU)))


def test_no_point_ever_carries_more_shear_than_coulomb_allows_and_the_loop_loses_energy() -> None:
    result = simulate(_loop(0.0), COARSE)
    quality = result.quality
    pressing = -result.force[:, 2] > 1e-6
    assert pressing[1:-1].all()
    assert (quality.slip_excess[pressing] <= 1e-9).all()
    assert (quality.balance[pressing] < 1e-3).all()
    aside, back = result.force[4], result.force[6]
    # The indenter drags the body along; ploughing adds a little to the friction.
    assert 0.5 * MU < aside[0] / -aside[2] < 1.5 * MU
    assert back[0] < 0, "friction turns round on the way back"
    assert not result.wrench[-1].any()
    assert quality.energy_gap[-1] > 0.05, "what was rubbed away is lost"
    assert (quality.energy_gap > -1e-3).all()


@pytest.mark.slow
def test_more_friction_holds_the_surface_more() -> None:
    """The outward slip of the surface under the sphere decreases with the coefficient."""
    slides = []
    for coefficient in (0.0, 0.2, 0.5, 2.0):
        effects = Effects(friction=Friction(coefficient))
        result = simulate(Scene(sphere(3e-3), press([0.6e-3]), SMALL, effects), COARSE)
        middle = len(result.surface_y) // 2
        slides.append(float(np.interp(1.3e-3, result.surface_x, result.surface[-1, :, middle, 0])))
    assert slides[0] > slides[1] > slides[2] > slides[3]


@pytest.mark.slow
def test_what_friction_takes_is_told_the_same_by_few_and_by_many_steps() -> None:
    fine = Fem(spacing=4e-3 / 3, step_travel=4e-3 / 200, path_tolerance=1e-3)
    few, many = (
        simulate(_loop(0.0, steps=1), numerics).quality.energy_gap
        for numerics in (Fem(spacing=4e-3 / 3), fine)
    )
    assert few == pytest.approx(many, abs=0.015)
