"""Effects that are off change nothing, and weak effects change little."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from support.machine_code import machine_code

from benchmarks.accuracy.effects import KERNELS, STATE, launched, same_results, stored
from sim import (
    Body,
    Effects,
    Friction,
    Gravity,
    Inertia,
    Motion,
    Result,
    Scene,
    Viscosity,
    simulate,
)
from sim.effect_sizes import weakened
from sim.fem import Fem
from sim.fem.assembly import Assembly
from sim.fem.mesh import build_mesh
from sim.indenters import sphere

BODY = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
SPACING = 4e-3 / 3
COARSE = Fem(spacing=SPACING, precision="float64")
# So stiff that the residual penetration, which depends on the steps taken, is far smaller than
# the change by the weakest effect.
TIGHT = Fem(spacing=SPACING, precision="float64", tolerance=1e-10, penalty=3000.0, augmentations=10)
# Down, and slightly sideways, in 1 ms.
MOTION = Motion(((0.0, 0.0, 0.0), (0.0, 0.0, -0.4e-3), (0.1e-3, 0.0, -0.4e-3)), (0.0, 0.5e-3, 1e-3))
ALL: dict[str, Any] = {
    "friction": Friction(1.0),
    "viscosity": Viscosity((1.0, 0.5), (1e-3, 1.0)),
    "inertia": Inertia(),
    "gravity": Gravity((300.0, 0.0, -500.0)),
}
# Fraction of `ALL` at which each effect is weak enough for a linear response.
WEAK = {"friction": 1e-3, "viscosity": 1e-4, "inertia": 1e-3, "gravity": 2e-3}


def _scene(effects: Effects) -> Scene:
    return Scene(sphere(3e-3), MOTION, BODY, effects)


def _assembly(effects: Effects) -> Assembly:
    meshes = [build_mesh(BODY, SPACING)] * 2
    return Assembly(meshes, [_scene(effects)] * 2, COARSE, "float64", "cpu")


def test_every_effect_has_state_and_kernels_under_its_own_name() -> None:
    assert tuple(STATE) == tuple(KERNELS) == Effects.__slots__
    assert Effects(**ALL).key == tuple(STATE)


# Compiling takes seconds a kernel; the effect with the fewest stands for the others.
ONE_QUICK = [
    pytest.param(name, marks=() if name == "gravity" else pytest.mark.slow) for name in STATE
]


@pytest.mark.parametrize("name", ONE_QUICK)
def test_an_effect_that_is_off_is_compiled_out_of_its_kernels(name: str) -> None:
    for variant in KERNELS[name]:
        off, on = (
            [len(machine_code(kernel)) for kernel in variant.kernels(on=on)] for on in (False, True)
        )
        assert all(off)
        assert sum(off) < sum(on)


@pytest.mark.parametrize("name", ONE_QUICK)
def test_a_press_without_effects_is_the_same_bits_before_and_after_one_with_an_effect(
    name: str,
) -> None:
    with launched() as kernels:
        before = simulate(_scene(Effects()), COARSE)
    with launched() as heavy:
        simulate(_scene(Effects(**{name: ALL[name]})), COARSE)
    with launched() as again:
        after = simulate(_scene(Effects()), COARSE)
    assert kernels == again
    assert same_results(before, after)
    assert np.abs(before.wrench).max() > 0.1
    for variant in KERNELS[name]:
        assert not variant.names_on() & kernels
    assert heavy - kernels


@pytest.mark.parametrize("name", STATE)
def test_the_state_of_an_effect_is_of_length_zero_when_it_is_off(name: str) -> None:
    off, on = _assembly(Effects()), _assembly(Effects(**{name: ALL[name]}))
    nodes, faces = len(on.mesh.nodes), len(on.mesh.faces)
    sizes = [stored(on.state, path) for path in STATE[name]]
    assert [stored(off.state, path) for path in STATE[name]] == [0] * len(sizes)
    assert all(sizes)
    # Two presses in one batch, with three numbers a node or contact point and one of each press.
    if name == "friction":
        points = 2 * faces * on.points
        assert sizes == [3 * points, 3 * points, points, points]
    if name == "inertia":
        assert sizes == [2 * 3 * nodes, 2]
    for other in set(STATE) - {name}:
        assert not any(stored(on.state, path) for path in STATE[other])


def test_kernels_are_made_once_for_a_combination() -> None:
    for variants in KERNELS.values():
        for variant in variants:
            one, two = variant.kernels(on=True), variant.kernels(on=True)
            assert all(a is b for a, b in zip(one, two, strict=True))


def test_the_record_names_the_effects_and_the_seconds_of_each_stage() -> None:
    effects = Effects(friction=ALL["friction"], gravity=ALL["gravity"])
    record = simulate(_scene(effects), COARSE).record
    assert record["effects"] == ["friction", "gravity"]
    assert record["precision"] == "float64"
    assert record["mesh"]["cells"] == [8, 8, 3]
    assert {"mesh", "build", "solve"} <= set(record["seconds"])
    assert all(seconds >= 0 for seconds in record["seconds"].values())
    assert simulate(_scene(Effects()), COARSE).record["effects"] == []


@cache
def _plain() -> Result:
    return simulate(_scene(Effects()), TIGHT)


def _difference(name: str, fraction: float) -> float:
    """Return the change of the last force by the effect [N]."""
    weak = weakened(ALL[name], fraction)
    result = simulate(_scene(Effects(**{name: weak})), TIGHT)
    return float(np.linalg.norm(result.wrench[-1, :3] - _plain().wrench[-1, :3]))


@pytest.mark.slow
@pytest.mark.parametrize("name", STATE)
def test_a_weak_effect_changes_the_force_in_proportion_to_its_parameter(name: str) -> None:
    fraction = WEAK[name]
    whole, half, tenth = (_difference(name, fraction * part) for part in (1.0, 0.5, 0.1))
    size = float(np.linalg.norm(_plain().force[-1]))
    assert 1e-9 * size < whole < 0.02 * size
    assert half == pytest.approx(whole / 2, rel=0.1)
    assert tenth == pytest.approx(whole / 10, rel=0.1)


def test_weakening_by_one_changes_nothing_and_by_zero_leaves_nothing() -> None:
    for effect in ALL.values():
        assert weakened(effect, 1.0) == effect
    assert weakened(ALL["friction"], 0.0).coefficient == 0
    assert weakened(ALL["viscosity"], 0.0).ratios == (0.0, 0.0)
    assert weakened(ALL["viscosity"], 0.5).times == ALL["viscosity"].times
    assert weakened(ALL["inertia"], 0.0).scale == 0
    assert weakened(ALL["gravity"], 0.0).acceleration == (0.0, 0.0, 0.0)
