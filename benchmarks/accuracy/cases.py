"""The six presses on which solvers are compared, their references, and errors relative to those.

A reference is by `fem`, with finer meshes and tighter tolerances than those of all competitors.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim.errors import SimulationDiverged
from sim.fem import Fem
from sim.indenters import Indenter, flat_punch, rounded_cone, sphere, tube
from sim.metrics import Outcome, displacement_at, force_errors, marker_errors, outcome_of
from sim.scene import Body, Effects, Friction, Motion, Scene, Viscosity, press
from sim.tiers import simulate_many

Array = NDArray[np.float64]

MM = 1e-3
# Depths of the plain presses [m].
DEPTHS = (0.5 * MM, 1.0 * MM, 1.5 * MM)
# Edge radius of shapes that have room for it [m]; sharper edges only need finer elements.
EDGE = 0.5 * MM
# Element size of the second reference over that of the first. If errors decrease with the square of
# the element size, the error of the first is 0.8 of the difference.
COARSER = 1.5
# Points along each side of the grid on which surfaces are compared.
POINTS = 121
# Number of parts that each piece of a viscous motion is divided into, which refines the time steps.
VISCOUS_PARTS = 3


@dataclass(frozen=True, slots=True)
class Case:
    """One scene."""

    name: str
    title: str
    scene: Scene
    fineness: float = 2.0
    """Fineness of the reference's mesh."""


_BALL = sphere(4 * MM)


def _rubbed(indenter: Indenter, motion: Motion) -> Scene:
    """Return a press with friction.

    Without it the skin under an edge or a tip slides until it creases, in one of many ways, so
    there is no unique solution to compare with.
    """
    return Scene(indenter, motion, effects=Effects(friction=Friction(0.5)))


_PUNCH = _rubbed(flat_punch(3 * MM, EDGE), press(DEPTHS))
_CONE = _rubbed(rounded_cone(math.radians(45), EDGE), press(DEPTHS))
_TUBE = _rubbed(tube(3.5 * MM, 2.5 * MM, 0.4 * MM), press(DEPTHS))
_LOOP = _rubbed(_BALL, press([1.0 * MM], shear=1.0 * MM, steps=2))
_HOLD = Scene(
    _BALL,
    press([1.0 * MM], hold=1.0, steps=4, speed=1.0 * MM / 0.1),
    effects=Effects(viscosity=Viscosity((0.5,), (0.2,))),
)
# Body: the paper's gel, 20 x 20 x 4 mm, 0.145 MPa, nu 0.45.
CASES: tuple[Case, ...] = (
    Case("sphere", "sphere R 4 mm", Scene(_BALL, press(DEPTHS))),
    Case("punch", "punch R 3, edge 0.5; friction", _PUNCH),
    Case("cone", "cone 45 deg, tip R 0.5; friction", _CONE),
    Case("tube", "tube 3.5 / 2.5, edge 0.4; friction", _TUBE),
    Case("loop", "press, shear, return; friction", _LOOP),
    Case("hold", "viscous: ramp and hold", _HOLD),
)

# Smallest of all, for quick runs.
QUICK_CASE = replace(CASES[0], scene=Scene(_BALL, press(DEPTHS[:1])), fineness=0.8)


def reference_of(case: Case, device: str) -> tuple[Outcome | None, dict[str, float]]:
    """Return the reference of a case, and the difference of the two finest meshes by error.

    None if there is no solution; no difference if there is none on the coarser mesh.
    """
    true, rough = (
        solve_reference(case.scene, fineness, device)
        for fineness in (case.fineness, case.fineness / COARSER)
    )
    if true is None or rough is None:
        return true, {}
    return true, compare(rough, true, case.scene.body).worst()


def solve_reference(scene: Scene, fineness: float, device: str) -> Outcome | None:
    """Solve a scene with hardly any penetration; the outcome has its frames."""
    parts = VISCOUS_PARTS if scene.effects.viscosity is not None else 1
    numerics = Fem(
        fineness=fineness,
        precision="float64",
        tolerance=1e-5,
        path_tolerance=1e-3,
        augmentations=5,
        elements_max=1_000_000,
    )
    cut = replace(scene, motion=finer(scene.motion, parts))
    (result,) = simulate_many([cut], numerics, device=device)
    if isinstance(result, SimulationDiverged):
        return None
    one = outcome_of(result)
    return replace(
        one, force=one.force[::parts], surface=one.surface[::parts], touched=one.touched[::parts]
    )


def finer(motion: Motion, parts: int) -> Motion:
    """Return the same motion with each piece cut into `parts`, the waypoints being every nth."""
    waypoints = np.arange(len(motion))
    places = np.arange(parts * (len(motion) - 1) + 1) / parts
    x, y, z, time = (
        np.interp(places, waypoints, values).tolist()
        for values in (*np.transpose(motion.tip), motion.time)
    )
    return Motion(tuple(zip(x, y, z, strict=True)), tuple(time))


@dataclass(frozen=True, slots=True)
class Errors:
    """Differences from the reference, frame by frame (F,); the last frame is the last number."""

    force: Array
    """|F_i - Fref_i| along x, y, z (F, 3) [N]."""
    force_share: Array
    """`force` over max(|Fref| of the frame, `WEAK` of the largest |Fref|) (F, 3)."""
    surface: Array
    """Largest distance between the two positions of a material point of the top (F,) [m]."""
    surface_rms: Array
    """Root of the mean square of that distance (F,) [m]."""
    marker: Array
    """Largest distance between the two images of a marker (F,) [px]."""
    marker_rms: Array
    """Root of the mean square of that distance (F,) [px]."""

    def worst(self) -> dict[str, float]:
        """Return the largest of each over frames and axes; `force_last` is for the last frame."""
        largest = {name: float(getattr(self, name).max()) for name in self.__slots__}
        return largest | {"force_last": float(self.force_share[-1].max())}


def compare(outcome: Outcome, reference: Outcome, body: Body) -> Errors:
    """Return the errors of `outcome` relative to `reference`, for one motion into `body`.

    Surfaces are cubic splines through the points of each, as a rendered image would use. They are
    compared up to the outermost points of the coarser one, where both have points around. The
    spacing of the points may change along the surface.
    """
    force, fraction = force_errors(outcome, reference)
    x = _shared(outcome.surface_x, reference.surface_x)
    y = _shared(outcome.surface_y, reference.surface_y)
    surface = np.empty((len(force), POINTS, POINTS))
    for frame in range(len(force)):
        moved = displacement_at(outcome, frame, x, y) - displacement_at(reference, frame, x, y)
        surface[frame] = np.linalg.norm(moved, axis=-1)
    pixels = marker_errors(outcome, reference, body)
    return Errors(
        force=force,
        force_share=fraction,
        surface=surface.max(axis=(1, 2)),
        surface_rms=np.sqrt(np.mean(surface**2, axis=(1, 2))),
        marker=pixels.max(axis=1),
        marker_rms=np.sqrt(np.mean(pixels**2, axis=1)),
    )


def _shared(one: Array, other: Array) -> Array:
    """Return points (POINTS,) across the range that both cover."""
    return np.linspace(max(one[0], other[0]), min(one[-1], other[-1]), POINTS)
