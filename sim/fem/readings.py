# mypy: ignore-errors
# Reads Warp arrays, typed at run time; mypy cannot follow them.
"""What the state last evaluated says of one environment: contact, traction, energy, weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.fem.assembly import Assembly


@dataclass(frozen=True, slots=True)
class ContactPoints:
    """Contact points of the T faces that touch, of one environment; in thicknesses and moduli."""

    pressure: np.ndarray
    """(T, P)."""
    penetration: np.ndarray
    """How deep they are inside the indenter (T, P); below 0 in a gap that the pressure bridges."""
    traction: np.ndarray
    """Shear traction on the body (T, P, 3)."""
    force: np.ndarray
    """Force on the body (T, P, 3)."""
    place: np.ndarray
    """Where they are (T, P, 3)."""
    area: np.ndarray
    """Untouched area of each (T, P)."""
    slip_excess: float
    """Largest |shear| - coefficient * pressure, over the largest pressure; NaN without friction."""


def contact_points(assembly: Assembly, env: int, u: np.ndarray) -> ContactPoints:
    """Pressure, force and place of the contact points of environment `env`, displaced by `u`."""
    state, mesh = assembly.state, assembly.meshes[env]
    rows = np.flatnonzero(assembly.touched[env].numpy())
    pressure = state.pressure[env].numpy()[rows].astype(float)
    deep = (pressure - state.carried[env].numpy()[rows]) / assembly.numerics.penalty
    push = state.normal[env].numpy()[rows] * pressure[:, :, None]
    excess = np.nan
    traction = np.zeros_like(push)
    if "friction" in assembly.effects:
        traction = state.traction[env].numpy()[rows].astype(float)
        most = assembly.coefficients[env] * pressure
        size = np.linalg.norm(traction, axis=2)
        excess = float((size - most).max(initial=0.0) / pressure.max(initial=1e-30))
    faces = mesh.faces[rows]
    area = assembly.rule.numpy() * mesh.face_area[rows, None]
    shape = assembly.shape.numpy().astype(float)
    return ContactPoints(
        pressure=pressure,
        penetration=np.where(pressure > 0, deep, 0.0),
        traction=traction,
        force=(push + traction) * area[:, :, None],
        place=shape @ (mesh.nodes[faces] + u[faces]),
        area=area,
        slip_excess=excess,
    )


def surface_traction(assembly: Assembly, env: int) -> np.ndarray:
    """Nodal force over nodal area on the top of one environment (X, Y, 3) [E]."""
    mesh = assembly.meshes[env]
    nx, ny, _nz = mesh.cells
    top = slice(0, nx * ny)
    touched = assembly.touched[env].numpy()[top] > 0
    share = assembly.face_force[env].numpy()[top].astype(float) * touched[:, None, None]
    corner_area = np.repeat(mesh.face_area[top], 4).reshape(nx, ny, 4, 1)
    both = np.concatenate([share.reshape(nx, ny, 4, 3), corner_area], axis=3)
    nodal = np.zeros((nx + 1, ny + 1, 4))
    for corner, (i, j) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        nodal[i : nx + i, j : ny + j] += both[:, :, corner]
    return nodal[:, :, :3] / nodal[:, :, 3:]


def stored_energy(assembly: Assembly, env: int, points: ContactPoints, u: np.ndarray) -> float:
    """Energy in the material at rest modulus, contact springs and height [E T^3]."""
    penalty = assembly.numerics.penalty
    square = (points.traction**2).sum(axis=2) / (assembly.numerics.stick * penalty)
    springs = ((points.penetration**2 * penalty + square) * points.area / 2).sum()
    if "gravity" in assembly.effects:
        weight = assembly.state.weight.numpy()[env].astype(float)
        springs -= (assembly.meshes[env].node_volume[:, None] * u * weight).sum()
    return float(assembly.element_energy[env].numpy().sum(dtype=float) + springs)


def body_force(assembly: Assembly, env: int, u: np.ndarray) -> np.ndarray:
    """Weight less inertia of one environment (3,) [E T^2]."""
    total = np.zeros(3)
    if "gravity" in assembly.effects:
        total += (
            assembly.state.weight.numpy()[env].astype(float)
            * assembly.meshes[env].node_volume.sum()
        )
    if "inertia" in assembly.effects:
        rate = assembly.state.rates[env]
        ahead = u - assembly.state.predicted[env].numpy()
        free = assembly.meshes[env].node_volume[:, None] * ahead
        total -= rate * free.sum(axis=0)
    return total
