# mypy: ignore-errors
# Reads Warp arrays, typed at run time; mypy cannot follow them.
"""What the state last evaluated says of one environment: contact, traction, energy, weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.fem.assembly import Assembly


@dataclass(frozen=True, slots=True)
class ContactPoints:
    """Contact points of one environment, in units of thickness and modulus."""

    pressure: np.ndarray
    """(S, P)."""
    traction: np.ndarray
    """Shear traction on the body (S, P, 3)."""
    force: np.ndarray
    """Force on the body (S, P, 3)."""
    place: np.ndarray
    """Where they are (S, P, 3)."""
    area: np.ndarray
    """Untouched area of each (S, P)."""
    slip_excess: float
    """Largest |shear| - coefficient * pressure, over the largest pressure; NaN without friction."""


def contact_points(assembly: Assembly, env: int) -> ContactPoints:
    """Pressure, force and place of the contact points of one environment."""
    state, mesh = assembly.state, assembly.mesh
    pressure = state.pressure.numpy()[env].astype(float)
    push = state.normal.numpy()[env] * pressure[:, :, None]
    excess = np.nan
    traction = np.zeros_like(push)
    if "friction" in assembly.effects:
        traction = state.traction.numpy()[env].astype(float)
        most = assembly.coefficients[env] * pressure
        size = np.linalg.norm(traction, axis=2)
        excess = float((size - most).max() / max(pressure.max(), 1e-30))
    area = assembly.rule.numpy() * mesh.face_area[:, None]
    shape = assembly.shape.numpy().astype(float)
    corners = mesh.nodes[mesh.faces] + state.u.numpy()[env][mesh.faces]
    return ContactPoints(
        pressure=pressure,
        traction=traction,
        force=(push + traction) * area[:, :, None],
        place=np.einsum("pa,saj->spj", shape, corners),
        area=area,
        slip_excess=excess,
    )


def surface_traction(assembly: Assembly, env: int) -> np.ndarray:
    """Nodal force over nodal area on the top of one environment (X, Y, 3) [E]."""
    nx, ny, _nz = assembly.mesh.cells
    force = np.zeros((len(assembly.mesh.nodes), 3))
    area = np.zeros(len(assembly.mesh.nodes))
    top = assembly.mesh.faces[: nx * ny]
    share = assembly.face_force.numpy()[env, : nx * ny].astype(float)
    touched = assembly.touched.numpy()[env, : nx * ny] > 0
    np.add.at(force, top, np.where(touched[:, None, None], share, 0.0))
    np.add.at(area, top, np.repeat(assembly.mesh.face_area[: nx * ny, None], 4, axis=1))
    grid = assembly.mesh.top
    return force[grid] / area[grid][..., None]


def stored_energy(assembly: Assembly, env: int, points: ContactPoints, u: np.ndarray) -> float:
    """Energy in the material at rest modulus, contact springs and height [E T^3]."""
    penalty = assembly.numerics.penalty
    square = (points.traction**2).sum(axis=2) / (assembly.numerics.stick * penalty)
    springs = ((points.pressure**2 / penalty + square) * points.area / 2).sum()
    if "gravity" in assembly.effects:
        weight = assembly.state.weight.numpy()[env].astype(float)
        springs -= (assembly.mesh.node_volume[:, None] * u * weight).sum()
    return float(assembly.element_energy.numpy()[env].sum(dtype=float) + springs)


def body_force(assembly: Assembly, env: int, u: np.ndarray) -> np.ndarray:
    """Weight less inertia of one environment (3,) [E T^2]."""
    total = np.zeros(3)
    if "gravity" in assembly.effects:
        total += assembly.state.weight.numpy()[env].astype(float) * assembly.mesh.node_volume.sum()
    if "inertia" in assembly.effects:
        rate = assembly.state.rates[env]
        ahead = u - assembly.state.predicted.numpy()[env]
        free = assembly.mesh.node_volume[:, None] * ahead
        total -= rate * free.sum(axis=0)
    return total
