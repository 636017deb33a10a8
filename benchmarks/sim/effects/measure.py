"""Measure the cost of effects: none when off, and a stated cost when on."""

from __future__ import annotations

import importlib
import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np
import warp as wp

from benchmarks.sim.effects.declaration import EFFECTS, Memory, Snippet
from benchmarks.sim.effects.kernels import launches
from benchmarks.sim.effects.machine_code import machine_code
from benchmarks.sim.effects.memory import declared, stored
from benchmarks.sim.effects.scenes import BODY, EXACT, NUMERICS, TRIALS, scene
from benchmarks.sim.effects.without import built_without, cut_factory
from sim.fem.assembly import Assembly
from sim.fem.mesh import build_mesh
from sim.result import Result
from sim.scene import Scene
from sim.tiers import simulate

# Parts of an effect's weak fraction at which its result is compared.
PARTS = (1.0, 0.5, 0.1)


@dataclass(frozen=True, slots=True)
class Combination:
    """Kernels of one set of effects."""

    key: tuple[str, ...]
    kernels: int
    own: int
    """Number of kernels that are not launched without effects."""
    compile_seconds: float
    """CPU time to compile all of them, once per machine [s]."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Cost of one effect."""

    name: str
    same_code: bool
    """Off, its kernels have the same machine code as a source without the effect."""
    same_results: bool
    """Off, with the other effects on, every result equals that of such a build, bit for bit."""
    off_ratio: float
    """CPU time of a press without effects, of this build over one without the effect."""
    on_ratio: float
    """CPU time of the press with the effect over that without it."""
    numbers_off: int
    numbers_on: int
    """Size of the state of one press when off and when on, in numbers."""
    memories: tuple[tuple[Memory, int], ...]
    limits: tuple[float, ...]
    """Relative change of the force at each of `PARTS` of the weak fraction."""

    @property
    def proven(self) -> bool:
        """True if the effect leaves no trace when it is off."""
        return self.same_code and self.same_results and not self.numbers_off


def combinations() -> Iterator[Combination]:
    """Yield every set of effects, from none to all: 16."""
    compiled: dict[str, float] = {}
    plain: set[str] = set()
    for count in range(len(EFFECTS) + 1):
        for key in itertools.combinations(EFFECTS, count):
            with launches(compiled) as found:
                simulate(scene(*key), NUMERICS)
            if not key:
                plain = set(found)
            seconds = sum(compiled[name] for name in found)
            yield Combination(key, len(found), len(found - plain), seconds)


def cost(name: str, repeats: int) -> Cost:
    """Measure one effect; times are the minimum of `repeats` pairs."""
    others = scene(*(other for other in EFFECTS if other != name))
    here = simulate(others, NUMERICS)
    with built_without(name):
        never = simulate(others, NUMERICS)
    off_ratio = _ratio(scene(), scene(), repeats, lambda: built_without(name))
    on_ratio = _ratio(scene(name), scene(), repeats, nullcontext)
    off, on = _assembly(), _assembly(name)
    state = EFFECTS[name].state
    return Cost(
        name=name,
        same_code=all(_same_code(snippet) for snippet in EFFECTS[name].kernels),
        same_results=_same(here, never),
        off_ratio=off_ratio,
        on_ratio=on_ratio,
        numbers_off=sum(stored(off.state, memory) for memory in state),
        numbers_on=sum(stored(on.state, memory) for memory in state),
        memories=tuple((memory, declared(on, memory, branches=2)) for memory in state),
        limits=_limits(name),
    )


def _ratio(
    first: Scene, second: Scene, repeats: int, build: Callable[[], AbstractContextManager[None]]
) -> float:
    """Return the CPU time of `first` over that of `second` in the build that `build` opens."""
    times: tuple[list[float], list[float]] = ([], [])
    # The first run of each is not counted, because it compiles.
    with build():
        _seconds(second)
    _seconds(first)
    for _ in range(repeats):
        times[0].append(_seconds(first))
        with build():
            times[1].append(_seconds(second))
    return min(times[0]) / min(times[1])


def _seconds(pressed: Scene) -> float:
    began = time.process_time()
    simulate(pressed, NUMERICS)
    return time.process_time() - began


def _same(one: Result, two: Result) -> bool:
    pairs = [(getattr(one, name), getattr(two, name)) for name in ("wrench", "surface", "traction")]
    pairs += [
        (getattr(one.quality, name), getattr(two.quality, name)) for name in one.quality.__slots__
    ]
    return all(bool(np.array_equal(a, b, equal_nan=True)) for a, b in pairs)


def _same_code(snippet: Snippet) -> bool:
    factory = getattr(importlib.import_module(snippet.module), snippet.factory)
    flags = {
        one.flag: False
        for effect in EFFECTS.values()
        for one in effect.kernels
        if (one.module, one.factory) == (snippet.module, snippet.factory)
    }
    made = [one(wp.float64, **flags) for one in (factory, cut_factory(snippet))]
    codes = [
        [machine_code(kernel) for kernel in (one if isinstance(one, tuple) else (one,))]
        for one in made
    ]
    return codes[0] == codes[1]


def _assembly(*names: str) -> Assembly:
    mesh = build_mesh(BODY, NUMERICS.spacing or BODY.thickness)
    return Assembly([mesh], [scene(*names)], NUMERICS, "float64", "cpu")


def _limits(name: str) -> tuple[float, ...]:
    plain = simulate(scene(), EXACT).force[-1]
    weak = (
        simulate(scene(name, fraction=TRIALS[name].fraction * part), EXACT).force[-1]
        for part in PARTS
    )
    size = np.linalg.norm(plain)
    return tuple(float(np.linalg.norm(force - plain) / size) for force in weak)
