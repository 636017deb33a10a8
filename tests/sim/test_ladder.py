"""Presses by a ladder: against the contact solver they are superposed from, and their limits."""

from pathlib import Path

import numpy as np
import pytest

from sim.ladder import Ladder, LadderPress
from sim.sensors import sensor

FRICTION = 0.5


@pytest.fixture(scope="module")
def ladder(tmp_path_factory: pytest.TempPathFactory) -> Ladder:
    return Ladder.of("sphere_s", sensor("r6"), tmp_path_factory.mktemp("ladders"))


def test_shear_never_exceeds_friction_and_nothing_pulls(ladder: Ladder) -> None:
    press = LadderPress(ladder, FRICTION, sensor("r6").effects.viscosity)
    random = np.random.default_rng(1)
    tip = np.zeros(3)
    for _ in range(300):
        tip = tip + random.normal(0, 0.2e-3, 3)
        tip[2] = np.clip(tip[2], -1.5e-3, 0.5e-3)
        press.move(tip, 0.01)
        force = press.wrench[:3]
        assert force[2] <= 0
        assert np.hypot(force[0], force[1]) <= -FRICTION * force[2] * (1 + 1e-9)


def test_a_ladder_is_kept(tmp_path: Path, ladder: Ladder) -> None:
    first = Ladder.of("sphere_s", sensor("r18"), tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    assert first.normal(1e-3) == pytest.approx(ladder.normal(1e-3) * 120 / 300)
    assert Ladder.of("sphere_s", sensor("r18"), tmp_path).normal(1e-3) == first.normal(1e-3)
