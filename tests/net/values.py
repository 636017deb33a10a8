"""Values that must not change: forces of twelve scenes over tiers and effects, masks of sensors.

`python tests/net/values.py` prints them as JSON, `--record` writes `expected.json`, which
`test_values.py` compares with.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from sim import Body, Effects, Fem, Friction, Gravity, Inertia, Layer, Scene, Viscosity, simulate
from sim.indenters import box, flat_punch, named, plane, sphere
from sim.scene import Motion, press
from sim.sensors import SurfaceField, readout, sensor

EXPECTED = Path(__file__).with_name("expected.json")
MM = 1e-3
COARSE = Fem(spacing=1.3e-3)
RELAXING = Viscosity((0.5,), (0.5,))
ROUND = Body(16e-3, 16e-3, 4e-3, dome_radius=40e-3, footprint="ellipse")


def scene(indenter: Any, motion: Motion, body: Body | None = None, **effects: Any) -> Scene:
    """Return a scene on the paper's gel, or on another body, with some effects."""
    return Scene(indenter, motion, body or Body(), Effects(**effects))


LOOP = press([0.5 * MM], shear=0.4 * MM, angle=0.5, steps=2)
SCENES: dict[str, tuple[Scene, Layer | Fem]] = {
    "layer press": (scene(sphere(4 * MM), press([0.5 * MM, 1.0 * MM])), Layer()),
    "layer press off centre": (scene(named("dots"), press([0.4 * MM], at=(-2 * MM, MM))), Layer()),
    "layer loop": (scene(named("prism"), LOOP, friction=Friction(0.5)), Layer()),
    "layer hold": (
        scene(
            named("cylinder"),
            press([0.6 * MM], hold=2.0, steps=3, speed=0.6 * MM / 0.1),
            viscosity=RELAXING,
        ),
        Layer(),
    ),
    "layer loop relaxing": (
        scene(named("moon"), LOOP, friction=Friction(0.8), viscosity=RELAXING),
        Layer(),
    ),
    "fem press": (scene(sphere(4 * MM), press([0.4 * MM, 0.8 * MM])), COARSE),
    "fem press of an edge": (scene(box(4 * MM, 3 * MM, 0.3 * MM), press([0.4 * MM])), COARSE),
    "fem loop": (scene(flat_punch(2 * MM, 0.3 * MM), LOOP, friction=Friction(0.5)), COARSE),
    "fem hold": (
        scene(
            sphere(3 * MM),
            press([0.5 * MM], hold=2.0, steps=2, speed=0.5 * MM / 0.1),
            viscosity=RELAXING,
        ),
        COARSE,
    ),
    "fem weight": (
        scene(named("dots"), press([0.4 * MM]), gravity=Gravity((0.0, -9.81, 0.0))),
        COARSE,
    ),
    "fem inertia": (
        scene(sphere(4 * MM), press([0.2 * MM, 0.4 * MM], speed=0.05), inertia=Inertia()),
        COARSE,
    ),
    "fem round dome": (scene(plane(), press([0.3 * MM]), ROUND), COARSE),
}
SENSORS = ("gelsight", "tacpalm", "uskin")


def wrench_of(name: str) -> np.ndarray:
    """Return the wrench of a scene in each frame (F, 6) [N, N m]."""
    return simulate(*SCENES[name]).wrench


def masks_of(name: str) -> list[list[float]]:
    """Return of each of a sensor's masks under a prism the marked pixels, and their mean place."""
    pressed = sensor(name)
    deep = 0.2 * pressed.body.thickness
    result = simulate(pressed.scene(named("prism"), press([deep / 2, deep])), Layer())
    masks = readout(pressed).masks(SurfaceField.of(result))
    return [
        [float(mask.sum()), *map(float, np.argwhere(mask)[:, -2:].mean(axis=0))] for mask in masks
    ]


def measured() -> dict[str, Any]:
    """Return the wrenches of all scenes, and those of the sensors' masks."""
    return {
        "wrench": {name: wrench_of(name).tolist() for name in SCENES},
        "masks": {name: masks_of(name) for name in SENSORS},
    }


if __name__ == "__main__":
    text = json.dumps(measured(), indent=1) + "\n"
    if "--record" in sys.argv:
        EXPECTED.write_text(text)
    else:
        print(text, end="")
