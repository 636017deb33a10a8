"""Readings of a batch: equal to sums that are written out for each environment alone."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import warp as wp

from sim import Body, Effects, Friction, Gravity, Inertia, Scene, press
from sim.fem import Fem
from sim.fem.assembly import Assembly
from sim.fem.balance import LANES, reading_kernels
from sim.fem.contact import STICK, face_rule
from sim.fem.solver import simulate_fem
from sim.indenters import named
from sim.result import Result

BODY = Body(8e-3, 8e-3, 4e-3)
EFFECTS = Effects(friction=Friction(0.8), gravity=Gravity(), inertia=Inertia())
SCENES = [Scene(named(name), press([0.1e-3, 0.3e-3]), BODY, EFFECTS) for name in ("sphere", "cone")]
FEM = Fem(spacing=4e-3 / 3, one_topology=True)


def _alone(assembly: Any, env: int, tip: np.ndarray) -> tuple[dict[str, Any], np.ndarray]:
    """Return what is read of one environment, and the top's nodes (X, Y, 6)."""
    mesh, state = assembly.meshes[env], assembly.state
    contact = state.contact

    def of(array: Any) -> np.ndarray:
        return np.array(array.numpy()[env], float)

    rows = np.flatnonzero(of(contact.touched))
    u, pressure = of(state.u), of(contact.pressure)[rows]
    normal, traction = of(contact.normal)[rows], of(contact.traction)[rows]
    shape, rule = face_rule(2)
    area = rule * mesh.face_area[rows, None]
    force = (normal * pressure[:, :, None] + traction) * area[:, :, None]
    place = np.array([shape @ (mesh.nodes[face] + u[face]) for face in mesh.faces[rows]])
    place = place.reshape(force.shape)
    deep = np.where(pressure > 0, pressure - of(contact.multiplier)[rows], 0.0) / FEM.penalty
    excess = np.linalg.norm(traction, axis=2) - 0.8 * pressure
    weight, volume = of(state.weight), mesh.node_volume[:, None]
    springs = (np.square(traction).sum(axis=2) * area).sum() / (2 * STICK * FEM.penalty)
    ahead = mesh.inert_volume[:, None] * (u - of(state.predicted))
    overlap = of(assembly.face_overlap)
    columns = len(mesh.x) * len(mesh.y)
    nodal = np.zeros((columns, 3))
    top_faces = mesh.faces[: mesh.cells[0] * mesh.cells[1]] // (mesh.cells[2] + 1)
    for row in rows[rows < len(top_faces)].tolist():
        np.add.at(nodal, top_faces[row], of(contact.force)[row])
    top = np.concatenate([u[mesh.top.ravel()], nodal], axis=1)
    return {
        "force": force.sum(axis=(0, 1)),
        "torque": np.cross(place - tip, force).sum(axis=(0, 1)),
        "body": weight * volume.sum() - state.rates[env] * ahead.sum(axis=0),
        "energy": of(assembly.element_energy).sum() + springs - (volume * u * weight).sum(),
        "sunk": (np.abs(deep) * pressure * area).sum(),
        "pressure": pressure.max(initial=0.0),
        "excess": excess.max(initial=0.0),
        "overlap": overlap.max(axis=0),
        "face": np.argmax(overlap[:, 0]),
    }, top.reshape(len(mesh.x), len(mesh.y), 6)


@pytest.mark.parametrize("lanes", [1, pytest.param(LANES, marks=pytest.mark.slow)])
def test_what_is_read_for_all_environments_is_that_of_each_alone(
    monkeypatch: pytest.MonkeyPatch, lanes: int
) -> None:
    """Of two presses at waypoints that both reach in one sweep, and of one alone.

    By one thread each, and by a block of threads as on a GPU.
    """
    read, numbers, touching = Assembly.read, [], []

    def compared(self: Any, environments: Sequence[int], tip: np.ndarray) -> Any:
        self._lanes, self._read = lanes, reading_kernels(self.real, *[True] * 3, lanes=lanes)[0]
        monkeypatch.setattr(wp.config, "enable_cpu_blocks", lanes > 1)
        found = read(self, environments, tip)
        monkeypatch.setattr(wp.config, "enable_cpu_blocks", False)
        self._lanes = 1  # of all other kernels
        for env, row, top in zip(environments, *found, strict=True):
            numbers.append(len(environments))
            expected, nodes = _alone(self, env, tip[env])
            np.testing.assert_array_equal(top, nodes)
            assert set(expected) == set(row.dtype.names)
            for name, value in expected.items():
                scale = max(np.abs(value).max(), 1e-3)
                if name == "excess":  # the difference of two nearly equal numbers
                    scale = expected["pressure"]
                np.testing.assert_allclose(row[name], value, rtol=0, atol=1e-13 * scale)
            touching.append(expected["pressure"] > 0)
        return found

    monkeypatch.setattr(Assembly, "read", compared)
    results = simulate_fem(SCENES, FEM)
    assert set(numbers) == {1, 2}
    assert sum(touching) >= 4
    for one in results:
        assert isinstance(one, Result)
        assert abs(one.force[-1, 2]) > 0.01
