"""Nearly incompressible bodies, whose pressure is split for the solve."""

import numpy as np
import pytest

from sim import Body, Effects, Friction, Scene, Viscosity, press, simulate
from sim.fem import Fem, element
from sim.fem.assembly import kernels_of
from sim.indenters import sphere
from sim.result import Result

MOTION = press([0.4e-3], shear=0.2e-3, steps=1)
NUMERICS = Fem(spacing=4e-3 / 3, precision="float64", tolerance=1e-4, path_tolerance=1e-4)


def _solved(poisson: float, effects: Effects) -> Result:
    body = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3, poisson=poisson)
    return simulate(Scene(sphere(3e-3), MOTION, body, effects), NUMERICS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("poisson", "effects"),
    [
        pytest.param(0.4999, Effects(), marks=pytest.mark.slow),
        (
            0.499,
            Effects(friction=Friction(0.5), viscosity=Viscosity((0.5,), (0.05,), relaxes="all")),
        ),
    ],
    ids=["elastic", "viscous with friction"],
)
def test_a_split_pressure_gives_the_forces_of_the_whole_one(
    monkeypatch: pytest.MonkeyPatch, poisson: float, effects: Effects
) -> None:
    split = _solved(poisson, effects)
    monkeypatch.setattr(element, "SPLIT_ABOVE", 0.5)
    whole = _solved(poisson, effects)
    largest = np.abs(whole.wrench[:, :3]).max()
    assert split.wrench[:, :3] == pytest.approx(whole.wrench[:, :3], abs=5e-4 * largest)
    assert np.abs(split.surface - whole.surface).max() < 5e-4 * np.abs(whole.surface).max()
    assert split.quality.balance.max() < 1e-3
    assert abs(split.quality.energy_gap[2]) < abs(whole.quality.energy_gap[2]) + 5e-3


def test_only_nearly_incompressible_bodies_are_split() -> None:
    for poisson, split in ((0.49, False), (0.495, False), (0.499, True)):
        assert kernels_of([Scene(sphere(3e-3), MOTION, Body(poisson=poisson))])[2] == split
        assert (element.split_factor(poisson) < 1.0) == split
