"""Part `variants`: twelve hard scenes, each in five variants, answered and judged."""

import math
from collections.abc import Callable, Iterator
from typing import Any

from benchmarks.hard_cases.bodies import MM, down
from benchmarks.hard_cases.random_scenes.judgement import Row, all_judged, answers, holds
from benchmarks.hard_cases.random_scenes.scenes import Drawn
from benchmarks.report import Page, Run
from sim.indenters import Indenter, box, flat_punch, named, rounded_cone, sphere, torus, tube
from sim.scene import Body, Effects, Friction, Inertia, Motion, Scene, press

# The paper's gel, and as a disc.
GEL, DISC = Body(), Body(footprint="ellipse")


def _disc(width: float, thickness: float, poisson: float = 0.45, **others: Any) -> Body:
    """Return a round body; lengths in [mm]."""
    size = width * MM
    return Body(size, size, thickness * MM, poisson=poisson, footprint="ellipse", **others)


def _pressed(indenter: Indenter, body: Body, depth: float, **effects: Any) -> Scene:
    """Return a press to half a depth [mm], and to it."""
    return Scene(indenter, down(depth / 2, depth), body, Effects(**effects))


def _thin(variant: tuple[float, float]) -> Scene:
    poisson, depth = variant
    return _pressed(sphere(20 * MM), _disc(12, 0.5, poisson), depth)


def _slanted(friction: float) -> Scene:
    body = Body(24 * MM, 18 * MM, 10 * MM, footprint="ellipse")
    tip = rounded_cone(math.radians(35), 1 * MM)
    return Scene(tip, down(1.5, 3, at=(4, 2)), body, Effects(Friction(friction)))


def _blade(width: float) -> Scene:
    return _pressed(box(width * MM, 12 * MM, width / 5 * MM), GEL, 1.6 + 0.9 * width)


def _by_name(name: str, body: Body) -> Callable[[float], Scene]:
    return lambda depth: _pressed(named(name), body, depth)


def _struck(speed: float) -> Scene:
    """Return a sphere that comes to 0.5 mm and rests as long as it has moved."""
    tip, time = ((0.0, 0.0, 0.0), (0.0, 0.0, -0.5 * MM)), 0.5 * MM / speed
    motion = Motion((*tip, tip[-1]), (0.0, time, 2 * time))
    return Scene(sphere(4 * MM), motion, DISC, Effects(inertia=Inertia()))


def _plate(speed: float) -> Scene:
    """Return a plate as wide as the gel's middle, in 16 waypoints."""
    motion = press([0.8 * MM], steps=16, speed=speed)
    return Scene(flat_punch(6 * MM, 0.5 * MM), motion, DISC, Effects(inertia=Inertia()))


def _leaning(angle: float) -> Scene:
    return _pressed(flat_punch(3 * MM, 0.5 * MM).tilted(0.0, math.radians(angle)), GEL, 0.8)


# The property of each scene that is varied, its values, and the scene of a value.
HARD: dict[str, tuple[str, tuple[Any, ...], Callable[[Any], Scene]]] = {
    "wide sphere, thin gel": (
        "nu, mm", ((0.49, 0.1), (0.499, 0.1), (0.499, 0.2), (0.4999, 0.1), (0.4999, 0.2)), _thin
    ),
    "rounded cone off centre": ("friction", (0.3, 0.6, 1.0, 1.5, 2.0), _slanted),
    "light touch of a thick gel": (
        "mm", (0.005, 0.008, 0.01, 0.015, 0.02),
        lambda depth: _pressed(sphere(4 * MM), _disc(60, 20), depth),
    ),
    "torus on a dome": (
        "mm", (0.4, 0.6, 0.8, 1.0, 1.3),
        lambda depth: _pressed(
            torus(3 * MM, 1 * MM), _disc(24, 6, dome_radius=20 * MM), depth
        ),
    ),
    "tube on a wide gel": (
        "mm", (0.1, 0.25, 0.5, 0.75, 1.0),
        lambda depth: _pressed(tube(3.5 * MM, 2.5 * MM, 0.5 * MM), _disc(40, 4), depth),
    ),
    "blade": ("mm wide", (0.5, 0.6, 0.7, 0.85, 1.0), _blade),
    "the paper's cone": ("mm", (0.4, 0.7, 0.95, 1.2, 1.5), _by_name("cone", DISC)),
    "the paper's triangle": ("mm", (0.4, 0.7, 0.95, 1.2, 1.5), _by_name("triangle", GEL)),
    "the paper's line": ("mm", (0.4, 0.7, 0.95, 1.2, 1.5), _by_name("line", GEL)),
    "sphere that strikes": ("m/s", (0.1, 0.3, 1.0, 2.0, 3.0), _struck),
    "plate that strikes": ("m/s", (0.05, 0.1, 0.2, 0.5, 1.0), _plate),
    "leaning punch": ("degrees", (1.0, 3.0, 5.0, 8.0, 12.0), _leaning),
}  # fmt: skip


def scenes() -> Iterator[Drawn]:
    """Yield the variants."""
    for name, (unit, values, scene_of) in HARD.items():
        for value in values:
            shown = ", ".join(map("{:g}".format, value if isinstance(value, tuple) else (value,)))
            yield Drawn(f"{name}, {shown} {unit}", name, (), scene_of(value))


def measure(run: Run) -> list[Row]:
    """Answer and judge the variants; in a quick run the first."""
    some = list(scenes())
    return all_judged(run, some[:1] if run.quick else some, run.device)


def section(rows: list[Row], _page: Page) -> str:
    """Return the table of variants."""
    there = sum(row.get("stated") is not None for row in rows)
    return f"""## Hard scenes

Twelve scenes in five variants each, as the random ones: {there} of {len(rows)} are answered, and
the stated error of {sum(map(holds, rows))} holds.

{answers(rows)}"""
