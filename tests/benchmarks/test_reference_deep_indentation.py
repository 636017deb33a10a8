"""Results of the deep press against linear theory and the material's laws."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.independent.formulas import NEO_HOOKEAN_SPHERE, layer_sphere

PRESS = NEO_HOOKEAN_SPHERE
LAYER = (PRESS.radius, PRESS.thickness, PRESS.modulus, PRESS.poisson)


def test_small_strain_theory_falls_short_by_a_little_and_by_more_as_it_deepens() -> None:
    short = [
        1 - layer_sphere(depth, *LAYER).force / force
        for depth, force in zip(PRESS.depths, PRESS.forces, strict=True)
    ]
    np.testing.assert_allclose(short, [0.008, 0.027, 0.048], atol=2e-3)


def test_sticking_is_stiffer_than_sliding() -> None:
    low, high = PRESS.force_stick
    assert PRESS.forces[-1] < low < high < 1.15 * PRESS.forces[-1]


def test_the_surface_bulges_beside_the_contact_as_linear_theory_says() -> None:
    linear = layer_sphere(PRESS.depths[-1], *LAYER).displacement([5e-3, 6e-3])
    assert np.all(linear > 0)
    assert PRESS.height[1] == pytest.approx(linear[0], rel=0.15)
    assert PRESS.height[2] == pytest.approx(linear[1], rel=0.2)
    # Towards the free sides, which an infinite layer does not have, the bulge vanishes.
    assert 0 < PRESS.height[3] < PRESS.height[2]


def test_what_is_pushed_out_moves_less_than_what_pushes() -> None:
    assert all(0 < value < 0.2 * PRESS.depths[-1] for value in PRESS.outward)
