"""Readings of a batch: equal whether arrays are copied for all environments or viewed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from sim import Body, Effects, Friction, Gravity, Inertia, Scene, press, simulate_many
from sim.fem import solver
from sim.fem.numerics import Fem
from sim.fem.solver import Aside, Snapshot
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
