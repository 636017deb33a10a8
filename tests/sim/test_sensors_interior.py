"""Displacement inside a bonded layer: its equations, and `fem`'s interior solution."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.fem import Fem
from sim.fem.assembly import Assembly
from sim.indenters import named
from sim.scene import Body, Effects, Friction, Scene, press
from sim.sensors.field import SurfaceField
from sim.sensors.taxels import Interior
from sim.tiers import simulate

Array = NDArray[np.float64]

BODY = Body()
PLACES = np.array([[0.0, 0.0], [1.2e-3, -0.7e-3], [-2.5e-3, 3.1e-3], [4e-3, 4e-3]])
STEP = 1e-5


def top() -> SurfaceField:
    """Return a smooth field without any symmetry."""
    x = np.linspace(-10e-3, 10e-3, 81)
    across, along = np.meshgrid(x, x, indexing="ij")
    bell = np.exp(-((across - 1e-3) ** 2 + (along + 0.5e-3) ** 2) / 2.5e-3**2)
    u = [0.05 * across * bell + 2e-4 * bell, 0.03 * along * bell - 1e-4 * bell, -5e-4 * bell]
    return SurfaceField(x, x, np.stack(u, axis=-1)[None].astype(np.float32))


def displaced(depth: float, places: Array = PLACES) -> Array:
    return Interior(BODY, depth, places).at(top())[0][0]


def test_at_the_top_it_is_what_was_given_and_at_the_base_nothing_moves() -> None:
    np.testing.assert_allclose(displaced(0.0), top().at(PLACES)[0], atol=5e-7)
    np.testing.assert_allclose(displaced(BODY.thickness), 0.0, atol=1e-12)


def test_the_gradient_is_that_of_the_displacement() -> None:
    depth = 1.5e-3
    gradient = Interior(BODY, depth, PLACES).at(top())[1][0]
    for axis in range(2):
        aside = np.eye(2)[axis] * STEP
        change = displaced(depth, PLACES + aside) - displaced(depth, PLACES - aside)
        np.testing.assert_allclose(gradient[..., axis], change / (2 * STEP), atol=1e-6)
    change = displaced(depth - STEP) - displaced(depth + STEP)
    np.testing.assert_allclose(gradient[..., 2], change / (2 * STEP), atol=1e-6)


def test_the_layer_is_in_balance_everywhere_inside() -> None:
    """Navier: (1 - 2 nu) laplace(u) + grad(div u) = 0, by differences of the gradient."""
    depth = 1.3e-3
    second = np.empty((len(PLACES), 3, 3, 3))  # d2 u_i / dx_j dx_k
    for axis in range(3):
        aside = np.zeros(3)
        aside[axis] = STEP
        ahead, behind = (
            Interior(BODY, depth - sign * aside[2], PLACES + sign * aside[:2]).at(top())[1][0]
            for sign in (1, -1)
        )
        second[..., axis] = (ahead - behind) / (2 * STEP)
    laplace = np.einsum("nijj->ni", second)
    grad_div = np.einsum("njji->ni", second)
    balance = (1 - 2 * BODY.poisson) * laplace + grad_div
    assert np.abs(balance).max() < 1e-3 * np.abs(grad_div).max()


def test_a_top_that_only_slides_or_sinks_takes_the_layer_along_evenly() -> None:
    """Without waves the displacement is linear in depth; the edges are far enough away."""
    wide = Body(size_x=80e-3, size_y=80e-3)
    still = SurfaceField.undeformed(wide).displacement
    for direction in np.eye(3):
        moved = SurfaceField(
            *(np.linspace(-40e-3, 40e-3, 4),) * 2, (still + 1e-4 * direction).astype(np.float32)
        )
        found, gradient = Interior(wide, 1e-3, np.zeros((1, 2))).at(moved)
        np.testing.assert_allclose(found[0, 0], 0.75e-4 * direction, atol=2e-7)
        np.testing.assert_allclose(gradient[0, 0, :, 2], 0.025 * direction, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "rms"), [("sphere", 0.05), ("prism", 0.09)])
def test_it_agrees_with_the_inside_that_fem_solves(
    name: str, rms: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pressed by 1 mm and sheared by 0.5 mm, at the nodes about 1.5 mm below the top.

    Linear interpolation of the same displacement to the base is at least 3.5 times as far off.
    """
    inside: list[tuple[Array, Array]] = []
    read = Assembly.read

    def read_all(self: Any, environments: Sequence[int], tip: Array) -> Any:
        unit = BODY.thickness
        inside.append((self.mesh.nodes * unit, self.rows(self.state.u, environments)[0] * unit))
        return read(self, environments, tip)

    monkeypatch.setattr(Assembly, "read", read_all)
    scene = Scene(
        named(name), press([1e-3], shear=0.5e-3, steps=1), effects=Effects(friction=Friction(0.5))
    )
    result = simulate(scene, Fem(spacing=BODY.thickness / 6))
    for frame in (1, 2):
        nodes, moved = inside[frame]
        level = nodes[np.abs(nodes[:, 2] + 1.5e-3).argmin(), 2]
        chosen = (nodes[:, 2] == level) & (np.abs(nodes[:, :2]) < 7e-3).all(axis=1)
        field = SurfaceField(result.surface_x, result.surface_y, result.surface[frame : frame + 1])
        places = nodes[chosen, :2]
        found = Interior(BODY, -level, places).at(field)[0][0]
        fraction = np.linalg.norm(found - moved[chosen], axis=1)
        fraction /= np.linalg.norm(moved[chosen], axis=1).max()
        evenly = field.at(places)[0] * (1 + level / BODY.thickness) - moved[chosen]
        assert np.sqrt((fraction**2).mean()) < rms
        assert fraction.max() < 2.5 * rms
        assert np.linalg.norm(found - moved[chosen]) < np.linalg.norm(evenly) / 3.5
