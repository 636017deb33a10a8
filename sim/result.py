"""Result of a simulation: force, deformation, and measures of their accuracy."""

import dataclasses
import math
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import RegularGridInterpolator

from sim.arrays import Array
from sim.errors import SceneError, SimulationDiverged
from sim.scene import Scene

Mask = NDArray[np.bool_]
# Tiers of contact whose error is known, by name; `mpm` is for comparison.
ContactTier = Literal["layer", "fem"]


@dataclass(frozen=True, slots=True)
class Quality:
    """Error measures of every frame, (F,) each. NaN where a tier does not have one."""

    residual: Array
    """Out-of-balance nodal force over contact force (l2 norms). Here and in `balance`, `fem` uses
    at least 1e-3 E T^2 (float64: 1e-5) as the force: 2 mN in the paper's gel."""
    contact: Array
    """Penetration over the depth of the press: of `fem` the mean over contact points, weighted by
    their pressure, and the depth at least twice the energy over the force; of others the deepest.
    """
    balance: Array
    """|force of the indenter + reaction of the base (+ weight, inertia)| over |force|."""
    energy_gap: Array
    """(Work done - energy stored) over the most work done so far: 0 if elastic and exact, the
    dissipated fraction with friction or viscosity. `fem` sums the work of a step over the contact
    points, each along its own way, to 1 % in an elastic press; `layer` and `mpm` use the trapezoid
    rule."""
    det_f_min: Array
    """Smallest determinant of the deformation gradient; 1 undeformed, 0 inverted."""
    slip_excess: Array
    """Largest |shear traction| - coefficient * pressure of a contact point, over the largest
    pressure; Coulomb's law holds if it is 0 or less. NaN without friction."""
    overlap: Array
    """Largest depth of the skin inside the indenter [m]: the deepest of 8 x 8 samples on every face
    that can reach it (`layer`: of the pixels)."""
    overlap_bound: Array
    """Upper bound of that depth [m]: includes the distance to the next sample."""
    overlap_path: Array
    """`overlap` of all states since the previous frame: the solver's steps and states in between,
    skin and tip moving straight [m]. These are solved less accurately than frames."""
    contact_width: Array
    """Diameter of the largest disc within the contact [m]; 0 without contact."""
    newton: NDArray[np.int64]
    """Newton iterations spent on the frame (contact iterations for `layer`)."""
    cg: NDArray[np.int64]
    """Conjugate-gradient iterations spent on the frame."""
    steps: NDArray[np.int64]
    """Number of steps taken for the frame, including failed ones."""


COUNTS = ("newton", "cg", "steps")


def no_quality(frames: int) -> dict[str, NDArray[Any]]:
    """Return NaN for each error measure of every frame, and 0 for each count, by name."""
    quality: dict[str, NDArray[Any]] = {
        one.name: np.full(frames, np.nan) for one in dataclasses.fields(Quality)
    }
    return quality | {name: np.zeros(frames, np.int64) for name in COUNTS}


@dataclass(frozen=True, slots=True)
class Result:
    """Simulated scene: F frames, one for each waypoint of the motion.

    All values are in the contact frame and SI units.
    """

    scene: Scene
    """Simulated scene."""
    tier: str
    """`layer`, `fem` or `mpm`."""
    wrench: Array
    """Force and torque of the indenter on the body (F, 6) [N, N m], torque about the tip; pressing
    is negative Fz."""
    surface_x: Array
    """x of the material points of the undeformed top (X,) [m]."""
    surface_y: Array
    """y of the material points of the undeformed top (Y,) [m]."""
    surface: NDArray[np.float32]
    """Displacement of those points (F, X, Y, 3) [m]."""
    traction: NDArray[np.float32]
    """Traction of the indenter on those points (F, X, Y, 3), per undeformed area [Pa]."""
    quality: Quality
    """Accuracy of each frame."""
    record: dict[str, Any] = field(default_factory=dict)
    """Details of the run: tier, mesh, precision, device, compiled effects, seconds per stage."""
    force: Array = field(init=False, repr=False, compare=False)
    """Force of the indenter on the body (F, 3) [N], the first part of `wrench`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "force", self.wrench[:, :3])


# Outcome of a simulated scene.
Outcome = Result | SimulationDiverged


def with_beginning(whole: Result, beginning: Result) -> Result:
    """Return `whole` with its first frames replaced by those of a result on a separate mesh.

    Surfaces and tractions are interpolated linearly from the other mesh at the points of `whole`.
    The cost of the first frames is the sum of both.
    """
    count = len(beginning.wrench)
    axes = beginning.surface_x, beginning.surface_y
    x, y = (
        np.clip(own, axis[0], axis[-1])
        for own, axis in zip((whole.surface_x, whole.surface_y), axes, strict=True)
    )
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)

    def read(values: NDArray[np.float32], own: NDArray[np.float32]) -> NDArray[np.float32]:
        out = own.copy()
        for frame in range(count):
            out[frame] = RegularGridInterpolator(axes, values[frame])(points)
        return out

    def first(name: str) -> Any:
        own, other = getattr(whole.quality, name), getattr(beginning.quality, name)
        spent = own[:count] if name in COUNTS else 0
        return np.concatenate([other + spent, own[count:]])

    message = beginning.record["warnings"]
    stage = {"waypoints": count, "mesh": beginning.record["mesh"]}
    return dataclasses.replace(
        whole,
        wrench=np.concatenate([beginning.wrench, whole.wrench[count:]]),
        surface=read(beginning.surface, whole.surface),
        traction=read(beginning.traction, whole.traction),
        quality=Quality(**{one.name: first(one.name) for one in dataclasses.fields(Quality)}),
        record={
            **whole.record,
            "stages": [*whole.record.get("stages", []), stage],
            "warnings": list(dict.fromkeys([*whole.record["warnings"], *message])),
        },
    )


# Scale of the errors of a force, and the width of a contact.

# Fraction of the largest force below which a frame's error is no longer divided by its own force.
WEAK = 0.1
# Fraction of the largest traction of a frame below which it does not count as contact.
FAINT = 0.02
# Most pixels along an axis of the even grid in which a contact is measured.
EVEN_MOST = 192


def force_scale(force: Array) -> Array:
    """Return the scale of errors: each force's norm, but at least `WEAK` of the largest (F,)."""
    size = np.linalg.norm(force, axis=1)
    least = max(WEAK * float(size.max(initial=0.0)), float(np.finfo(float).tiny))
    return np.asarray(np.maximum(size, least))


def touched_by(traction: NDArray[np.floating[Any]]) -> Mask:
    """Return the masks of touched points (..., X, Y) for tractions (..., X, Y, 3)."""
    size = np.linalg.norm(traction, axis=-1)
    return np.asarray(size > FAINT * size.max(axis=(-2, -1), keepdims=True))


def width_of(touched: Mask, x: Array, y: Array) -> float:
    """Return the diameter of the largest disc within touched points (X, Y); 0 if there are none.

    A touched node counts as touched half-way to its neighbours.
    """
    if not touched.any():
        return 0.0
    return 2.0 * float(half_widths(touched[None], pixel_edges(x), pixel_edges(y))[0])


def pixel_edges(places: Array) -> Array:
    """Return the edges of the pixels around places (N,): half-way between them (N + 1,)."""
    middle = (places[1:] + places[:-1]) / 2
    first, last = places[0] - (middle[0] - places[0]), places[-1] + (places[-1] - middle[-1])
    return np.concatenate([[first], middle, [last]])


def half_widths(masks: Mask, edges_x: Array, edges_y: Array) -> Array:
    """Return the radius of the largest disc that fits into each piece (P, X, Y), none empty.

    Pixels may differ in width: they are resampled to an even grid.
    """
    return np.array([_half_width(mask, edges_x, edges_y) for mask in masks])


def _half_width(mask: Mask, edges_x: Array, edges_y: Array) -> float:
    columns, steps = [], []
    for axis, edges in ((1, edges_x), (0, edges_y)):
        here = np.flatnonzero(mask.any(axis=axis))
        inner = edges[here[0] : here[-1] + 2]
        length = inner[-1] - inner[0]
        count = int(np.clip(np.ceil(2 * length / np.diff(inner).min()), 8, EVEN_MOST))
        steps.append(length / count)
        middles = inner[0] + steps[-1] * (np.arange(1, count + 1) - 0.5)
        columns.append(np.searchsorted(edges, middles) - 1)
    # One pixel outside of the piece at each end.
    inside = np.zeros((len(columns[0]) + 2, len(columns[1]) + 2), bool)
    inside[1:-1, 1:-1] = mask[columns[0][:, None], columns[1]]
    reach = float(ndimage.distance_transform_edt(inside, sampling=steps).max())
    # Distances are to the centre of the nearest pixel outside; the outline is half a pixel nearer.
    half = float(min(steps)) / 2
    return max(reach - half, half)


# Problem of a contact at the side of a round body, by the entry of the record with its waypoints:
# `wall` and `rim`.
SIDES = {
    "wall": "the indenter overlaps the side wall of the round body, which is no contact face: "
    "contact with it is not computed (allowed: presses on the top)",
    "rim": "the contact reaches the rim of the round body, which cuts through elements there: its "
    "force is less accurate than the estimate for whole elements (allowed: a contact within the "
    "rim, or a tolerance)",
}


def dumped(**state: Any) -> Path | None:
    """Store the last state before a failure in the folder of temporary files; None if it cannot."""
    try:
        path = Path(tempfile.mkdtemp(prefix="diverged-")) / "state.npz"
        np.savez_compressed(path, **state)
    except OSError:
        return None
    return path


# Conversion of scenes and other values to and from JSON, without loss.

Value = TypeVar("Value")


def to_json(value: Any) -> Any:
    """Return a frozen dataclass, or a value in one, as plain JSON values, SI units.

    All digits are kept, infinity is "inf". A class that has a word for its kind stores it with the
    fields. A field may be stored only if it does not have its default.
    """
    if dataclasses.is_dataclass(value):
        stored = {
            field.name: to_json(getattr(value, field.name))
            for field in dataclasses.fields(value)
            if field.init
            and (
                field.metadata.get("stored") != "unless default"
                or getattr(value, field.name) != field.default
            )
        }
        kind = getattr(value, "KIND", None)
        return stored if kind is None else {"kind": kind, **stored}
    if isinstance(value, tuple | list):
        return [to_json(item) for item in value]
    if isinstance(value, str | bool | int) or value is None:
        return value
    number = float(value)
    return number if math.isfinite(number) else str(number)


def from_json(kind: type[Value], stored: Any, where: str) -> Value:
    """Return the value of dataclass `kind` that `to_json` wrote; `where` names it in errors."""
    # Only files need it: it imports YAML.
    from recorder.settings import Reader

    return Reader(SceneError, stored=True).build(kind, stored, where)
