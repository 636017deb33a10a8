"""Effects that are off change nothing, and weak effects change little."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from benchmarks.sim.effects import measure
from benchmarks.sim.effects.declaration import EFFECTS
from benchmarks.sim.effects.kernels import launches
from benchmarks.sim.effects.machine_code import machine_code
from benchmarks.sim.effects.memory import declared, stored
from benchmarks.sim.effects.page import render
from benchmarks.sim.effects.without import built_without, cut, cut_factory
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
WEAK = {"friction": 1e-3, "viscosity": 1e-4, "inertia": 1e-4, "gravity": 2e-3}


def _scene(effects: Effects) -> Scene:
    return Scene(sphere(3e-3), MOTION, BODY, effects)


def _arrays(result: Result) -> dict[str, np.ndarray]:
    arrays = {name: getattr(result, name) for name in ("wrench", "surface", "traction")}
    for name in result.quality.__slots__:
        arrays[f"quality.{name}"] = getattr(result.quality, name)
    return arrays


def _kernels(factory: Callable[..., Any], flags: dict[str, bool]) -> list[Any]:
    made = factory(wp.float64, **flags)
    return list(made) if isinstance(made, tuple) else [made]


def _flags(factory: Callable[..., Any]) -> dict[str, bool]:
    """Return the effect flags of a factory, all off."""
    names = {snippet.flag for effect in EFFECTS.values() for snippet in effect.kernels}
    code = getattr(factory, "__wrapped__", factory).__code__
    return {name: False for name in code.co_varnames[: code.co_argcount] if name in names}


def _assembly(effects: Effects) -> Assembly:
    meshes = [build_mesh(BODY, SPACING)] * 2
    return Assembly(meshes, [_scene(effects)] * 2, COARSE, "float64", "cpu")


def test_every_effect_is_declared_under_its_own_name() -> None:
    assert tuple(EFFECTS) == Effects.__slots__
    assert Effects(**ALL).key == tuple(EFFECTS)
    for name, effect in EFFECTS.items():
        assert effect.state
        assert effect.kernels
        assert effect.limit
        assert isinstance(ALL[name], effect.kind)


# Compiling takes seconds a kernel; the effect with the fewest stands for the others.
ONE_QUICK = [
    pytest.param(name, marks=() if name == "gravity" else pytest.mark.slow) for name in EFFECTS
]


@pytest.mark.parametrize("name", ONE_QUICK)
def test_an_effect_that_is_off_compiles_to_the_machine_code_of_a_source_without_it(
    name: str,
) -> None:
    """Compiling with the effect on must differ, to show that the comparison is sensitive."""
    for snippet in EFFECTS[name].kernels:
        factory = getattr(importlib.import_module(snippet.module), snippet.factory)
        off = _flags(factory)
        plain = [machine_code(kernel) for kernel in _kernels(factory, off)]
        never = [machine_code(kernel) for kernel in _kernels(cut_factory(snippet), off)]
        on = [machine_code(kernel) for kernel in _kernels(factory, {**off, snippet.flag: True})]
        assert all(plain)
        assert plain == never
        assert plain != on


@pytest.mark.parametrize("name", ONE_QUICK)
def test_an_effect_that_is_off_gives_the_results_of_a_build_without_it_bit_for_bit(
    name: str,
) -> None:
    """With the three other effects on, so that their code remains next to the removed code."""
    scene = _scene(replace(Effects(**ALL), **{name: None}))
    with_it = _arrays(simulate(scene, COARSE))
    with built_without(name):
        without = _arrays(simulate(scene, COARSE))
    for key, array in with_it.items():
        np.testing.assert_array_equal(array, without[key], err_msg=key)
    assert np.abs(with_it["wrench"]).max() > 0.1


def test_a_build_without_an_effect_ends_with_its_block() -> None:
    assembly = importlib.import_module("sim.fem.assembly")
    kept = assembly.contact_kernels
    with built_without("friction"):
        assert assembly.contact_kernels is not kept
    assert assembly.contact_kernels is kept


def test_cutting_takes_the_effects_blocks_and_nothing_else() -> None:
    source = "a = 1\nif wp.static(wet):\n    a = 2\n    b = 3\nif wp.static(dry):\n    c = 4\n"
    assert cut(source, "wet") == "a = 1\nif wp.static(dry):\n    c = 4\n"
    with pytest.raises(ValueError, match="no block"):
        cut(source, "warm")
    with pytest.raises(ValueError, match="else"):
        cut(source + "else:\n    c = 5\n", "dry")


@pytest.mark.parametrize("name", EFFECTS)
def test_the_state_of_an_effect_is_as_large_as_declared_and_of_length_zero_when_off(
    name: str,
) -> None:
    off, on = _assembly(Effects()), _assembly(Effects(**{name: ALL[name]}))
    for memory in EFFECTS[name].state:
        assert stored(off.state, memory) == 0, memory.name
        assert stored(on.state, memory) == declared(on, memory, branches=2) > 0, memory.name
    for other in EFFECTS:
        if other != name:
            assert all(stored(on.state, memory) == 0 for memory in EFFECTS[other].state)


def test_kernels_are_made_once_for_a_combination() -> None:
    for effect in EFFECTS.values():
        for snippet in effect.kernels:
            factory = getattr(importlib.import_module(snippet.module), snippet.factory)
            flags = {**_flags(factory), snippet.flag: True}
            one, two = _kernels(factory, flags), _kernels(factory, flags)
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
    weak = ALL[name].weakened(fraction)
    result = simulate(_scene(Effects(**{name: weak})), TIGHT)
    return float(np.linalg.norm(result.wrench[-1, :3] - _plain().wrench[-1, :3]))


@pytest.mark.slow
@pytest.mark.parametrize("name", EFFECTS)
def test_a_weak_effect_changes_the_force_in_proportion_to_its_parameter(name: str) -> None:
    fraction = WEAK[name]
    whole, half, tenth = (_difference(name, fraction * part) for part in (1.0, 0.5, 0.1))
    size = float(np.linalg.norm(_plain().force[-1]))
    assert 1e-9 * size < whole < 0.02 * size
    assert half == pytest.approx(whole / 2, rel=0.1)
    assert tenth == pytest.approx(whole / 10, rel=0.1)


def test_weakening_by_one_changes_nothing_and_by_zero_leaves_nothing() -> None:
    for effect in ALL.values():
        assert effect.weakened(1.0) == effect
    assert ALL["friction"].weakened(0.0).coefficient == 0
    assert ALL["viscosity"].weakened(0.0).ratios == (0.0, 0.0)
    assert ALL["viscosity"].weakened(0.5).times == ALL["viscosity"].times
    assert ALL["inertia"].weakened(0.0).scale == 0
    assert ALL["gravity"].weakened(0.0).acceleration == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_the_cost_of_an_effect_is_measured_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "NUMERICS", COARSE)
    monkeypatch.setattr(measure, "EXACT", TIGHT)
    found = measure.cost("gravity", repeats=1)
    assert found.proven
    assert found.numbers_off == 0
    assert found.numbers_on == 3
    assert found.limits[1] == pytest.approx(found.limits[0] / 2, rel=0.05)
    page = render([found], [measure.Combination(("gravity",), 18, 1, 5.0)], repeats=1)
    kernels = ", ".join(f"`{one.module}.{one.factory}`" for one in EFFECTS["gravity"].kernels)
    assert f"| gravity | {kernels} | yes | yes | 0 |" in page
    assert "| gravity | 18 | 1 | 5.0 |" in page
    assert "**no**" in render([replace(found, same_code=False)], [], repeats=1)
    assert not replace(found, numbers_off=3).proven


@pytest.mark.slow
def test_launches_name_the_kernels_of_a_run_and_end_with_their_block() -> None:
    launch = wp.launch
    compiled: dict[str, float] = {}
    sets = []
    for effects in (Effects(), Effects(gravity=ALL["gravity"])):
        with launches(compiled) as found:
            simulate(_scene(effects), COARSE)
        sets.append(found)
    assert wp.launch is launch
    kernels = len(EFFECTS["gravity"].kernels)
    assert len(sets[1] - sets[0]) == len(sets[0] - sets[1]) == kernels
    assert set(compiled) == sets[0] | sets[1]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_command_proves_every_effect_and_writes_the_page(tmp_path: Path) -> None:
    page = tmp_path / "effects.md"
    command = [sys.executable, "-m", "benchmarks", "effects", "--repeats", "1", "--out", str(page)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("leaves no trace") == len(EFFECTS)
    assert "friction, viscosity, inertia, gravity" in page.read_text()
