"""Readings of a batch: equal whether arrays are copied for all environments or viewed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from sim import Body, Effects, Friction, Gravity, Inertia, Scene, press, simulate_many
from sim.fem import solver
from sim.fem.numerics import Fem
from sim.fem.solver import Aside, Snapshot, kept_of
from sim.indenters import named
from sim.result import Result

BODY = Body(8e-3, 8e-3, 4e-3)
EFFECTS = Effects(friction=Friction(0.8), gravity=Gravity(), inertia=Inertia())
SCENES = [Scene(named(name), press([0.1e-3, 0.3e-3]), BODY, EFFECTS) for name in ("sphere", "cone")]


def found(monkeypatch: pytest.MonkeyPatch, *, gather: bool) -> list[Result]:
    kept: list[list[int]] = []

    class Asked(Snapshot):
        def __init__(self, assembly: Any, environments: Sequence[int]) -> None:
            kept.append(list(environments))
            super().__init__(assembly, environments, gather=gather)

    class Beside(Aside):
        def __init__(self, *, thread: bool) -> None:
            assert not thread, "on a CPU frames are kept at once"
            super().__init__(thread=gather)

    monkeypatch.setattr(solver, "Snapshot", Asked)
    monkeypatch.setattr(solver, "Aside", Beside)
    numerics = Fem(spacing=4e-3 / 3, one_topology=True)
    results = simulate_many(SCENES, numerics)
    assert [0, 1] in kept
    assert [1] in kept or [0] in kept
    return [one for one in results if isinstance(one, Result)]


def _alone(held: Snapshot, env: int, tip: np.ndarray) -> dict[str, np.ndarray]:
    """Return the contact points of one environment, written out face by face."""
    assembly, mesh = held.assembly, held.assembly.meshes[env]
    rows = np.flatnonzero(held.of(env, "touched"))
    u = held.of(env, "u").astype(float)
    shape, rule = assembly.face_rule
    pressure = held.of(env, "pressure")[rows].astype(float)
    traction = held.of(env, "traction")[rows].astype(float)
    push = held.of(env, "normal")[rows] * pressure[:, :, None]
    place = np.array([shape @ (mesh.nodes[face] + u[face]) for face in mesh.faces[rows]])
    force = (push + traction) * (rule * mesh.face_area[rows, None])[:, :, None]
    nodal = np.zeros(((mesh.cells[0] + 1) * (mesh.cells[1] + 1), 3))
    for row in rows[rows < mesh.cells[0] * mesh.cells[1]].tolist():
        np.add.at(nodal, mesh.top_faces[row], held.of(env, "face_force")[row].astype(float))
    excess = np.linalg.norm(traction, axis=2) - assembly.coefficients[env] * pressure
    return {
        "pressure": pressure,
        "traction": traction,
        "place": place,
        "force": force,
        "moment": np.cross(place - tip, force),
        "push": nodal,
        "slip_excess": excess.max(initial=0.0) / pressure.max(),
    }


def test_what_is_read_for_all_environments_has_the_bits_of_each_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of two presses at waypoints that both reach in one sweep, and of one alone."""
    numbers: list[int] = []

    def compared(held: Snapshot, environments: Sequence[int], tips: np.ndarray) -> Any:
        found = kept_of(held, environments, tips)
        for env, tip, kept in zip(environments, tips, found, strict=True):
            numbers.append(len(environments))
            np.testing.assert_array_equal(kept.u, held.of(env, "u"))
            if not len(kept.points.pressure):
                assert not kept.push.any()
                continue
            for name, value in _alone(held, env, tip).items():
                ours = getattr(kept, name, None)
                ours = getattr(kept.points, name) if ours is None else ours
                np.testing.assert_array_equal(ours, value, err_msg=name)
        return found

    monkeypatch.setattr(solver, "kept_of", compared)
    found(monkeypatch, gather=True)
    assert set(numbers) == {1, 2}


def test_results_are_the_same_however_arrays_come_to_the_host(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked = found(monkeypatch, gather=False)
    copied = found(monkeypatch, gather=True)
    assert len(looked) == len(copied) == len(SCENES)
    for one, other in zip(looked, copied, strict=True):
        assert abs(one.force[-1, 2]) > 0.01
        np.testing.assert_array_equal(one.wrench, other.wrench)
        np.testing.assert_array_equal(one.surface, other.surface)
        np.testing.assert_array_equal(one.traction, other.traction)
        for name in ("contact", "balance", "energy_gap", "slip_excess"):
            np.testing.assert_array_equal(
                getattr(one.quality, name), getattr(other.quality, name), err_msg=name
            )


def test_an_error_in_a_thread_is_raised_when_it_ends() -> None:
    done: list[int] = []

    def three_calls() -> None:
        with Aside(thread=True) as aside:
            aside.do(done.append, 1)
            aside.do(divmod, 1, 0)
            aside.do(done.append, 2)

    with pytest.raises(ZeroDivisionError):
        three_calls()
    assert done == [1, 2]
