import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import warp as wp
from support import fem_oracles as oracle
from support.fem_oracles import Array, Material

from sim import Effects, Scene, Viscosity, press
from sim.fem.element import Branches
from sim.fem.mesh import Mesh
from sim.indenters import plane

MESHES = oracle.domed_meshes()
VARIANT = [1, 0]
ELEMENTS = MESHES[0].elements
EVERYONE = np.ones(2)
SERIES = [Viscosity((0.5, 1.5), (0.1, 2.0)), Viscosity((0.8,), (0.3,), relaxes="shear")]
MATERIALS = [Material(0.345, 3.3), Material(0.4, 0.5)]
STEPS = [np.array([0.05, 0.4]), np.array([1e-4, 0.02]), np.array([3.0, 0.3]), np.array([0.2, 50.0])]


@dataclass
class Recurrence:
    """One environment's branches, step by step by Simo & Hughes (1998), (10.3.12)."""

    viscosity: Viscosity
    material: Material
    mesh: Mesh
    stress: Any = 0.0
    pressure: Any = 0.0
    branches: list[Any] = field(default_factory=lambda: [0.0] * 4)
    bulk_branches: list[Any] = field(default_factory=lambda: [0.0] * 4)

    def step(self, u: Array, duration: float) -> None:
        stress, pressure = rest_stress(self.mesh, u, self.material)
        for i, (ratio, time) in enumerate(
            zip(self.viscosity.ratios, self.viscosity.times, strict=True)
        ):
            decay = math.exp(-duration / time)
            gain = ratio * (1 - decay) * time / duration
            self.branches[i] = decay * self.branches[i] + gain * (stress - self.stress)
            if self.viscosity.relaxes == "all":
                change = gain * (pressure - self.pressure)
                self.bulk_branches[i] = decay * self.bulk_branches[i] + change
        self.stress, self.pressure = stress, pressure

    @property
    def total(self) -> tuple[Array, Array]:
        """Return second Piola-Kirchhoff stress (E, 8, 3, 3), isochoric, and pressure (E,)."""
        return self.stress + sum(self.branches), self.pressure + sum(self.bulk_branches)


def rest_stress(mesh: Mesh, u: Array, material: Material) -> tuple[Array, Array]:
    """Return isochoric second Piola-Kirchhoff stress and pressure at the relaxed modulus.

    S = G J^(-2/3) (1 - tr(C)/3 C^-1), C = F^T F.
    """
    f, _slopes, weight = oracle.deformation(mesh, u)
    j = np.linalg.det(f)
    right = np.swapaxes(f, 2, 3) @ f
    trace = np.trace(right, axis1=2, axis2=3)[..., None, None]
    isochoric = material.shear * (j ** (-2 / 3))[..., None, None]
    stress = isochoric * (np.eye(3) - trace / 3 * np.linalg.inv(right))
    theta = (weight * j).sum(1) / weight.sum(1)
    return stress, material.bulk / 2 * (theta - 1 / theta)


def _branches(real: Any) -> Branches:
    scenes = [
        Scene(plane(), press([1e-4]), effects=Effects(viscosity=viscosity)) for viscosity in SERIES
    ]
    return Branches(real, scenes, len(ELEMENTS), "cpu")


def _keep(branches: Branches, u: Array, real: Any, active: Array) -> None:
    mesh = oracle.on_device(MESHES, VARIANT, real)
    material = oracle.material_of(MATERIALS, real)
    branches.keep(mesh, material, oracle.integers(active), oracle.vectors(u, real))


def _begin(branches: Branches, duration: Array, active: Array = EVERYONE) -> tuple[Array, Array]:
    return branches.begin(oracle.integers(active), duration)


def _walk() -> list[Array]:
    """Return a displacement of both environments (2, N, 3) for each of `STEPS`."""
    return list(np.random.default_rng(31).normal(0, 0.02, (len(STEPS), 2, *MESHES[0].nodes.shape)))


@pytest.mark.parametrize(
    ("real", "error"),
    [pytest.param(wp.float64, 1e-12, id="float64"), pytest.param(wp.float32, 2e-5, id="float32")],
)
def test_branches_follow_simo_and_hughes(real: Any, error: float) -> None:
    """Factor times relaxed stress plus history equals the recurrence's stress in every step."""
    branches = _branches(real)
    meshes = [MESHES[variant] for variant in VARIANT]
    expected = [Recurrence(*each) for each in zip(SERIES, MATERIALS, meshes, strict=True)]
    for u, duration in zip(_walk(), STEPS, strict=True):
        factor, bulk_factor = _begin(branches, duration)
        history = branches.arrays.history.numpy().astype(float)
        bulk_history = branches.arrays.bulk_history.numpy().astype(float)
        for env, recurrence in enumerate(expected):
            recurrence.step(u[env], duration[env])
            stress, pressure = recurrence.total
            found = recurrence.stress * factor[env] + history[env]
            assert oracle.relative(found, stress) < error
            found = recurrence.pressure * bulk_factor[env] + bulk_history[env]
            assert oracle.relative(found, pressure) < error
        _keep(branches, u, real, EVERYONE)


def test_an_environment_that_is_not_active_remembers_the_step_before() -> None:
    u, duration = _walk()[0], STEPS[0]
    branches = _branches(wp.float64)
    _begin(branches, duration)
    _keep(branches, u, wp.float64, np.array([1, 0]))
    _begin(branches, duration)
    history = branches.arrays.history.numpy()
    assert np.abs(history[0]).max() > 1e-3
    assert not history[1].any()
    assert not branches.arrays.bulk_history.numpy()[1].any()


def test_a_step_that_begins_leaves_the_history_of_one_that_is_under_way() -> None:
    """Environments are at different steps: one with an unchanged duration keeps its factors."""
    u = _walk()
    branches = _branches(wp.float64)
    _begin(branches, STEPS[0])
    _keep(branches, u[0], wp.float64, EVERYONE)
    under_way = _begin(branches, STEPS[1])
    history, bulk_history = (
        branches.arrays.history.numpy().copy(),
        branches.arrays.bulk_history.numpy().copy(),
    )
    later = np.array([STEPS[2][0], STEPS[1][1]])
    factors = _begin(branches, later, np.array([1, 0]))
    assert factors[0][0] != under_way[0][0]
    for one, two in zip(factors, under_way, strict=True):
        assert one[1] == two[1]
    _begin(branches, STEPS[3], np.array([1, 0]))
    for now, before in (
        (branches.arrays.history, history),
        (branches.arrays.bulk_history, bulk_history),
    ):
        assert not np.array_equal(now.numpy()[0], before[0])
        np.testing.assert_array_equal(now.numpy()[1], before[1])


def test_fast_and_slow_steps_have_the_factors_of_glass_and_rest() -> None:
    branches = _branches(wp.float64)
    factor, bulk_factor = _begin(branches, np.full(2, 1e-9))
    assert factor == pytest.approx([1 + 2.0, 1 + 0.8], rel=1e-7)
    assert bulk_factor == pytest.approx([1 + 2.0, 1.0], rel=1e-7)
    factor, bulk_factor = _begin(branches, np.full(2, 1e9))
    assert factor == pytest.approx([1.0, 1.0], rel=1e-7)
    assert bulk_factor == pytest.approx([1.0, 1.0], rel=1e-7)


def test_volume_that_relaxes_in_shear_only_has_no_memory_of_pressure() -> None:
    branches = _branches(wp.float64)
    for u, duration in zip(_walk(), STEPS, strict=True):
        _begin(branches, duration)
        _keep(branches, u, wp.float64, EVERYONE)
    _begin(branches, STEPS[0])
    assert np.abs(branches.arrays.bulk_history.numpy()[0]).max() > 1e-3
    assert not branches.arrays.bulk_history.numpy()[1].any()
