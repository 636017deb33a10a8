"""What of a scene decides how exactly it is solved: a few numbers without units.

They come from the scene and from one run of the `layer` tier (milliseconds), which tells how large
the contact is, how large the force, and how far the markers move.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from sim.errors import SceneError
from sim.fem.path import path_of, sharpest
from sim.layer import simulate_layer
from sim.metrics import WEAK, Outcome, marker_pixels, outcome_of
from sim.planner.tolerance import Kind
from sim.result import Result
from sim.scene import Scene

Array = NDArray[np.float64]

RADIUS_MAX = 3.0
"""Sharpest radius over thickness above which nothing is sharp any more."""
SMOOTH = 0.6
"""Sharpest radius over width of the contact from which on no edge is reached: a sphere's contact
has less than its radius, a ring's is up to 1.6 times as wide as the tube's radius."""


@dataclass(frozen=True, slots=True)
class Features:
    """Numbers without units; lengths over the body's thickness T."""

    depth: float
    """Deepest indentation."""
    contact: float
    """Width of the contact, 2 area / outline, at full force: the radius of a disc, the width of a
    strip or of a ring."""
    contact_least: float
    """The same where it is least, among frames with a tenth of the largest force."""
    sharpest: float
    """Smallest radius of the indenter's surface, up to `RADIUS_MAX`."""
    poisson: float
    """-log(1 - 2 nu): how far from compressible."""
    friction: float
    """Coefficient; 0 without."""
    shear: float
    """Way of the tip aside while it presses."""
    side: float
    """exp(-distance between contact and the nearest side): 1 at the side, 0 far from it."""
    viscous: float
    """Stiffness of all branches over that at rest; 0 without."""
    width: float
    """Narrower width of the body."""
    steps: float
    """Steps that `fem` cuts the motion into, if all goes well."""

    @property
    def group(self) -> str:
        """Kind of scene; each has its own spread of errors."""
        if self.viscous > 0:
            return "viscous"
        edge = "smooth" if self.sharpest >= SMOOTH * self.contact else "edged"
        return f"{edge} {'shear' if self.shear > 0 else 'press'}"

    def values(self) -> Array:
        """All of them, in the order of `NAMES`."""
        return np.array(astuple(self), float)


NAMES: tuple[str, ...] = tuple(field.name for field in fields(Features))
GROUPS = ("smooth press", "edged press", "smooth shear", "edged shear", "viscous")
WHAT = {
    "depth": "depth over thickness",
    "contact": "width of the contact over thickness",
    "contact_least": "least width of the contact over thickness",
    "sharpest": "sharpest radius over thickness",
    "poisson": "-log(1 - 2 nu)",
    "friction": "coefficient of friction",
    "shear": "way aside over thickness",
    "side": "exp(-distance to the side over thickness)",
    "viscous": "stiffness of the branches over that at rest",
    "width": "width of the body over thickness",
    "steps": "steps of the motion",
}
"""Each feature in words."""


@dataclass(frozen=True, slots=True)
class Probe:
    """A scene's features and scales, and the `layer` result that they were read from."""

    features: Features
    force: float
    """Largest force [N]."""
    marker: float
    """Largest root mean square of the markers' motion over a frame [px]."""
    result: Result

    @property
    def scales(self) -> dict[Kind, float]:
        """What errors of each kind are divided by in the table."""
        return {"share": 1.0, "force": self.force, "marker": self.marker}


def probe(scene: Scene) -> Probe:
    """Look at a scene through the `layer` tier.

    Raises:
        SceneError: A scene that `layer` does not know, has a dome, or never touches: no plan can be
            made for it.
        SimulationDiverged: No contact was found.
    """
    if scene.body.dome_radius is not None:
        raise SceneError(
            f"body.dome_radius: {scene.body.dome_radius!r} m; allowed with a tolerance: None, the "
            "cost table covers flat bodies"
        )
    result = simulate_layer(scene)
    outcome = outcome_of(result)
    size = np.linalg.norm(outcome.force, axis=1)
    strong = int(np.argmax(size))
    if not outcome.touched[strong].any() or size[strong] <= 0:
        raise SceneError(
            "motion: the indenter never presses; allowed with a tolerance: a motion that does"
        )
    body, thickness = scene.body, scene.body.thickness
    counted = [i for i in range(len(size)) if size[i] >= WEAK * size[strong]]
    widths = [_contact_width(outcome, frame) for frame in counted]
    tip = np.array(scene.motion.tip)
    pressing = tip[tip[:, 2] < 0]
    shear = float(np.linalg.norm(pressing[:, :2] - pressing[0, :2], axis=1).max())
    friction, viscosity = scene.effects.friction, scene.effects.viscosity
    moved = marker_pixels(outcome, body) - marker_pixels(_at_rest(outcome), body)
    features = Features(
        depth=scene.motion.depth_max / thickness,
        contact=_contact_width(outcome, strong) / thickness,
        contact_least=min(widths) / thickness,
        sharpest=min(sharpest(scene.indenter) / thickness, RADIUS_MAX),
        poisson=-math.log(1 - 2 * body.poisson),
        friction=0.0 if friction is None else friction.coefficient,
        shear=shear / thickness,
        side=math.exp(-_side_distance(outcome, scene) / thickness),
        viscous=0.0 if viscosity is None else sum(viscosity.ratios),
        width=min(body.size_x, body.size_y) / thickness,
        steps=_steps(scene),
    )
    pixels = np.sqrt(np.mean(np.sum(moved**2, axis=-1), axis=(1, 2)))
    return Probe(features, float(size[strong]), float(pixels.max()), result)


def _contact_width(outcome: Outcome, frame: int) -> float:
    """2 area / outline of what is touched [m].

    Edges of pixels overstate an outline by 4 / pi on average (a disc's exactly).
    """
    touched = np.pad(outcome.touched[frame], 1)
    pixel_x = float(np.diff(outcome.surface_x).mean())
    pixel_y = float(np.diff(outcome.surface_y).mean())
    area = float(touched.sum()) * pixel_x * pixel_y
    edges_x = float((touched[1:] != touched[:-1]).sum()) * pixel_y
    edges_y = float((touched[:, 1:] != touched[:, :-1]).sum()) * pixel_x
    outline = math.pi / 4 * (edges_x + edges_y)
    return max(2 * area / outline if outline else 0.0, min(pixel_x, pixel_y) / 2)


def _side_distance(outcome: Outcome, scene: Scene) -> float:
    """From anything that is ever touched to the nearest side [m]."""
    ever = np.asarray(outcome.touched.any(axis=0))
    x, y = (np.abs(places) for places in (outcome.surface_x, outcome.surface_y))
    reach_x, reach_y = x[ever.any(axis=1)].max(), y[ever.any(axis=0)].max()
    body = scene.body
    return float(max(0.0, min(body.size_x / 2 - reach_x, body.size_y / 2 - reach_y)))


def _at_rest(outcome: Outcome) -> Outcome:
    still = np.zeros_like(outcome.surface)
    return Outcome(outcome.force, outcome.surface_x, outcome.surface_y, still, outcome.touched)


def _steps(scene: Scene) -> float:
    """Steps of all segments after the approach, none of them refused."""
    from sim.fem.numerics import Numerics

    path = path_of(scene, Numerics())
    total = 0.0
    for segment in range(1, len(path.corners) - 1):
        path.segment = segment
        total += round(1 / path.limit)
    return max(total, 1.0)
