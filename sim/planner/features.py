"""What of a scene decides how exactly it is solved: a few numbers without units.

They come from the scene and from one run of the `layer` tier (milliseconds), which tells how large
the contact is, how large the force, and how far the markers move.
"""

from __future__ import annotations

import math
import re
from dataclasses import astuple, dataclass, fields
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from sim.errors import SceneError
from sim.fem.newton import path_of
from sim.layer import simulate_layer
from sim.metrics import WEAK, Outcome, marker_pixels, outcome_of
from sim.result import Result
from sim.scene import Body, Scene

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics


# What error a person accepts: "2 %", "0.05 N" or "0.5 px".

Kind = Literal["share", "force", "marker"]
KINDS: tuple[Kind, ...] = ("share", "force", "marker")
ALLOWED = 'a number above 0 with its unit: "2 %", "0.05 N" or "0.5 px"'
_UNITS: dict[str, tuple[Kind, float]] = {
    "%": ("share", 0.01),
    "N": ("force", 1.0),
    "mN": ("force", 1e-3),
    "px": ("marker", 1.0),
}


@dataclass(frozen=True, slots=True)
class Tolerance:
    """The largest error accepted at any frame.

    `share`: |F_i - Ftrue_i| along x, y or z over max(|Ftrue| of the frame, a tenth of the largest);
    `force`: |F_i - Ftrue_i| [N]; `marker`: root mean square of the distances between 14 x 14
    markers' images and where they should be [px], seen by the paper's camera.
    """

    kind: Kind
    value: float

    def __str__(self) -> str:
        """As a person writes it."""
        return said(self.kind, self.value)


def tolerance_of(text: str) -> Tolerance:
    """The tolerance that `text` writes.

    Raises:
        SceneError: It is none.
    """
    match = re.fullmatch(r"\s*(\S+?)\s*(%|mN|N|px)\s*", text) if isinstance(text, str) else None
    try:
        number = float(match[1]) if match else math.nan
    except ValueError:
        number = math.nan
    if match is None or not (math.isfinite(number) and number > 0):
        raise SceneError(f"tolerance: {text!r}; allowed: {ALLOWED}")
    kind, unit = _UNITS[match[2]]
    return Tolerance(kind, number * unit)


def said(kind: Kind, value: float) -> str:
    """A value of a kind with its unit."""
    if kind == "share":
        return f"{100 * value:.3g} %"
    return f"{value:.3g} {'N' if kind == 'force' else 'px'}"


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
        SceneError: A scene that `layer` does not know, has a dome or is round, or never touches: no
            plan can be made for it.
        SimulationDiverged: No contact was found.
    """
    if scene.body.dome_radius is not None:
        raise SceneError(
            f"body.dome_radius: {scene.body.dome_radius!r} m; allowed with a tolerance: None, the "
            "cost table covers flat bodies"
        )
    if scene.body.footprint != "rectangle":
        raise SceneError(
            f"body.footprint: {scene.body.footprint!r}; allowed with a tolerance: 'rectangle', the "
            "cost table covers blocks"
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
        sharpest=min(scene.indenter.sharpest / thickness, RADIUS_MAX),
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


# What a planner can choose: the tier, the mesh, the precision.

LADDER = (3, 4, 5, 6, 8)
"""Meshes of `fem`, as elements that one thickness is long: an element is thickness / cells."""
COARSER_BY = 1.3
"""An error bar comes from a mesh with elements at least so much larger."""
LAYER_COMPANION = 4
"""The mesh of `fem` that an error bar of `layer` comes from."""


@dataclass(frozen=True, slots=True, order=True)
class Choice:
    """One way to solve a scene. `mpm` is none: `fem` is faster at every error."""

    tier: Literal["layer", "fem"]
    cells: int = 0
    """Elements that one thickness is long; 0 for `layer`."""
    precision: Literal["float32", "float64"] = "float32"
    """float32 goes on in float64 by itself where it must."""

    def __str__(self) -> str:
        """In words."""
        if self.tier == "layer":
            return "layer"
        return f"fem, element 1/{self.cells} of the thickness, {self.precision}"

    def numerics(self, body: Body) -> Numerics | None:
        """The settings of `fem` for a body; None for `layer`."""
        if self.tier == "layer":
            return None
        from sim.fem.numerics import Numerics

        precision: Literal["auto", "float64"] = "auto" if self.precision == "float32" else "float64"
        return Numerics(spacing=body.thickness / self.cells, precision=precision)


def all_choices() -> list[Choice]:
    """Every choice there is, the two precisions of a mesh side by side."""
    meshes = [Choice("fem", cells, p) for cells in LADDER for p in ("float32", "float64")]
    return [Choice("layer"), *meshes]


def companion(choice: Choice) -> Choice:
    """The other mesh that an error bar of `choice` is made with.

    Raises:
        SceneError: There is no coarser mesh.
    """
    if choice.tier == "layer":
        return Choice("fem", LAYER_COMPANION)
    coarser = [cells for cells in LADDER if cells * COARSER_BY <= choice.cells]
    if not coarser:
        raise SceneError(
            f"error_bar: {choice}; allowed: {COARSER_BY * LADDER[0]:.2g} elements or more in a "
            "thickness, so that there is a coarser mesh"
        )
    return Choice("fem", max(coarser))
