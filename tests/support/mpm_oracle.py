"""NumPy reference of one time step of the material points, written node by node."""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim import Scene
from sim.mpm import Mpm
from sim.mpm.lattice import Pace, ParticleLattice, build_lattice, pace_of
from sim.mpm.state import FIXED_POINT, ParticleState

Array = NDArray[np.float64]


def state_of(
    scenes: Sequence[Scene], numerics: Mpm
) -> tuple[ParticleState, ParticleLattice, list[Pace]]:
    """Return a batch before its first step."""
    lattice = build_lattice(scenes, numerics)
    paces = [pace_of(scene, numerics, lattice.cell) for scene in scenes]
    return ParticleState(lattice, scenes, paces, numerics, "cpu"), lattice, paces


def put(array: Any, values: Array) -> None:
    """Write values into a CPU array."""
    array.numpy()[:] = values


def spline(way: Array) -> Array:
    """Return the quadratic B-spline of offsets (..., 3) from a node [cells]: product over axes."""
    size = np.abs(way)
    inner = 0.75 - size**2
    outer = 0.5 * (1.5 - size) ** 2
    return np.asarray(np.where(size < 0.5, inner, np.where(size < 1.5, outer, 0.0)).prod(axis=-1))


def near(x: Array) -> list[tuple[int, int, int]]:
    """Return the 27 nodes that a particle at x (3,) interacts with."""
    first = np.floor(x - 0.5).astype(int)
    return [(first[0] + i, first[1] + j, first[2] + k) for i, j, k in product(range(3), repeat=3)]


def kirchhoff(gradient: Array, shear: float, bulk: float) -> Array:
    """Return the Kirchhoff stress P F^T of the law in `sim.scene`, from F = I + gradient (3, 3)."""
    f = np.eye(3) + gradient
    det = np.linalg.det(f)
    b = f @ f.T
    deviator = b - np.trace(b) / 3 * np.eye(3)
    return np.asarray(shear * det ** (-2 / 3) * deviator + bulk / 2 * (det**2 - 1) * np.eye(3))


def move(
    lattice: ParticleLattice,
    velocity: Array,
    shift: Array,
    gradient: Array,
    shear: float,
    bulk: float,
) -> tuple[Array, Array, Array]:
    """Return displacement, its gradient and sums at nodes (X, Y, Z, 4) after a step of particles.

    `velocity` is that of the nodes (X, Y, Z, 3).
    """
    shift, gradient = shift.copy(), gradient.copy()
    corner = np.array(lattice.corner)
    sums = np.zeros((*lattice.nodes, 4))
    for p, rest in enumerate(lattice.rest):
        x = rest + shift[p] + corner
        v, affine = np.zeros(3), np.zeros((3, 3))
        for node in near(x):
            way = np.array(node) - x
            fraction = velocity[node] * spline(way)
            v += fraction
            affine += 4 * np.outer(fraction, way)
        shift[p] += v
        gradient[p] += affine @ (np.eye(3) + gradient[p])
        x = rest + shift[p] + corner
        mass = lattice.volume[p]
        push = mass * affine - 4 * mass * kirchhoff(gradient[p], shear, bulk)
        for node in near(x):
            way = np.array(node) - x
            weight = spline(way)
            sums[node][0] += weight * mass
            sums[node][1:] += weight * (mass * v + push @ way)
    return shift, gradient, sums


def sums_of(state: ParticleState, env: int = 0) -> Array:
    """Return mass and momentum at the nodes of an environment (X, Y, Z, 4)."""
    return np.asarray(state.batch.sums.numpy()[env] / FIXED_POINT).reshape(*state.lattice.nodes, 4)
