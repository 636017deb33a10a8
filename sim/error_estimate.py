"""Error of a result and how it is known: by rules, by a second mesh, or by symmetry.

`record["error"]` of every result has a `status`: `measured` (a second mesh was solved), `estimated`
(from the resolution of the contact, by rules that were checked against independent solutions:
`python -m benchmarks independent`), or `none`. `force` is the error of the force, frame by frame,
over the force of the frame or a tenth of the largest one; `percent` is the largest of them. No
error is below the size of a force that symmetry forbids.
"""

import functools
import math
from dataclasses import replace
from typing import Any

import numpy as np

from sim.arrays import Array
from sim.indenters import Indenter
from sim.result import WEAK, Outcome, Result, force_scale
from sim.scene import Scene

Normal = tuple[float, float]

# Error of the force at fineness 1 (12 elements across the contact): it falls with the square of the
# elements' size. 0.012 covered 110 of the 133 forces of `benchmarks independent`.
PER_SQUARE = 0.016
# Fineness below which the error grows linearly with the elements' size.
RESOLVED = 0.5
# Error of the force if the smallest elements are as long as the touched part of an edge; it falls
# with the square too.
PER_EDGE = 0.03
# Largest error by an unresolved edge: for a sharp punch, a fifth of the force.
EDGE_MOST = 0.2
# Width that even a sharp edge leaves uncertain, over the smallest elements: punches whose edges lie
# differently between the nodes have forces that differ by 1 % where elements are 8.6 % of a width.
ACROSS_EDGE = 0.12
# Error of the force over an overlap's share of the depth or width, where a finer mesh, which would
# have less of it, has no solution: forces grow with up to the square of the depth.
PER_OVERLAP = 2.0
# Error of the force over the mean penetration of contact, as a share of the depth: it is the sum of
# penetrations times the change of pressure with the depth (Betti), 1 to 2 times it by shape. States
# without any differed by 0.4 to 2 times it where they differed by more than 0.3 %.
PER_SUNK = 2.0
# Error of the force at fineness 1 of a contact that reaches the rim of a round body, which cuts
# through elements: in presses solved by independent elements 0.2 to 2.5 % at 0.75.
AT_RIM = 0.025
# Error of the force over the overlap of a side wall that is no contact face, over that of the top:
# solutions of rectangular bodies with and without contact at their sides differed by 1.4 to 4.1
# times it.
PER_WALL = 6.0
# Error of `layer` over depth over thickness: it is limited to small strains.
LAYER_PER_DEPTH = 0.7
# Error of `layer` over the pixel's side over the contact's width. With both numbers the error
# covers all 136 forces of `benchmarks independent --only layer` that have an axis.
LAYER_PER_PIXEL = 1.2
# A force is missing for the greater part if its contact is narrower than this many pixels and it is
# below this fraction of a later one in proportion to the depth.
NARROW, FAINT = 2.0, 0.1
# Error of the force over the change of the indenter's volume below its depth by rounded edges. Flat
# tips with edges of 0.2 to 0.3 mm, 0.1 to 1 mm deep, lose 0.9 to 2.6 times as much force.
PER_ROUNDING = 2.6
# Columns along x and y in which that volume is measured.
ROUNDED_COLUMNS = 150
# Least error of `layer`.
LAYER_LEAST = 0.003
# Distance of a contact from the nearest side, in thicknesses, below which `layer` is wrong: it has
# no sides.
RIM = 1.0
# An edge radius below this fraction of an element is worth a note.
EDGE_NOTE_SHARE = 0.999
# Error of the force by damping over the stress of damping; how long it lasts, over its time.
PER_DAMPING, WAVE_REACH = 2.5, 2.0
# Error of a force just after an impact; how long it lasts, over the time of damping. With all four,
# errors cover those of a plate that hits a layer, but when a wave returns to it, up to twice them.
IMPACT, IMPACT_LASTS = 0.4, 1.3
# Largest stated error. A force that is small beside the others of a press may be off by more than
# itself, as one that a wave brings early or late.
ERROR_MOST = 10.0
# Height of a dome's rim over the thickness below which it does not behave like a layer.
RIM_UNEVEN = 0.5


def with_estimate(result: Result) -> Result:
    """Return the result with an estimated `record["error"]`; unchanged if it already has one.

    A `fem` result also gets `record["symmetry"]`, if its scene is mirrored in a plane.
    """
    if "error" in result.record:
        return result
    if result.tier == "fem":
        result = with_symmetry(result)
        error = _of_elements(result)
    elif result.tier == "layer":
        error = _of_layer(result)
    else:
        error = {"status": "none", "why": f"the error of {result.tier!r} is unknown"}
    return with_rounding(replace(result, record={**result.record, "error": error}))


def with_rounding(result: Result) -> Result:
    """Return the result with the error by edges of a file that were rounded unasked, if any.

    It adds to the error's `force` and `percent`, and is `rounding_percent` itself.
    """
    error, indenter = result.record["error"], result.scene.indenter
    solid = indenter.solid
    if error["status"] == "none" or solid is None or "rounding_percent" in error:
        return result
    if not solid.unasked or solid.unasked != indenter.edge_radius:
        return result
    depth = -np.asarray(result.scene.motion.tip)[:, 2]
    rounding = _weighed(result, PER_ROUNDING * _rounded_off(indenter, depth))
    force = np.minimum(np.array(error["force"]) + rounding, ERROR_MOST)
    error = {
        **error,
        "percent": float(100 * force.max(initial=0.0)),
        "force": [float(f"{one:.4g}") for one in force],
        "rounding_percent": float(100 * min(1.0, rounding.max(initial=0.0))),
    }
    return replace(result, record={**result.record, "error": error})


def _rounded_off(indenter: Indenter, depth: Array) -> Array:
    """Return the change (F,) of the volume below `depth` (F,) [m] by rounded edges, over it."""
    reach = float(depth.max(initial=0.0))
    if reach <= 0:
        return np.zeros(len(depth))
    sharp, rounded = _heights(indenter, reach)
    change = np.zeros(len(depth))
    for frame in np.flatnonzero(depth > 0):
        whole = np.maximum(depth[frame] - sharp, 0.0).sum()
        left = np.maximum(depth[frame] - rounded, 0.0).sum()
        change[frame] = abs(left / whole - 1) if whole else 0.0
    return change


@functools.lru_cache(maxsize=64)
def _heights(indenter: Indenter, reach: float) -> tuple[Array, Array]:
    """Return heights [m] of even columns of a lower surface, with sharp and with rounded edges."""
    sharp = replace(indenter, edge_radius=0.0)
    x, y = (np.linspace(*side, ROUNDED_COLUMNS) for side in sharp.bounds_below(reach)[:2])
    x = x[:, None]
    return sharp.heights(x, y, reach=reach), indenter.heights(x, y, reach=reach)


def estimated(outcome: Outcome) -> Outcome:
    """Return an outcome with the estimate of its result, or of the part it has reached."""
    if isinstance(outcome, Result):
        return with_estimate(outcome)
    if outcome.reached is not None:
        outcome.reached = with_estimate(outcome.reached)
    return outcome


def fineness_of(result: Result) -> Array:
    """Return how finely each frame of a `fem` result resolves its own contact (F,).

    1 corresponds to 12 elements from one side of the contact to the other; inf without contact.
    """
    resolved = result.record["mesh"]["resolved"]
    fineness = np.array([np.inf if one is None else one for one in resolved], float)
    for stage in result.record.get("stages", []):  # separate meshes for small contacts
        fineness[: stage["waypoints"]] = stage["mesh"]["fineness"]
    return fineness


def pixel_of(result: Result) -> float:
    """Return the longer side of a pixel of the surface [m]."""
    return float(max(np.diff(result.surface_x).max(), np.diff(result.surface_y).max()))


def side_distance(result: Result) -> float | None:
    """Return the least undeformed distance of a contact from a side [m]; None without contact."""
    touched = np.asarray((result.traction != 0).any(axis=0).any(axis=-1))
    if not touched.any():
        return None
    from_side = result.scene.body.from_side(result.surface_x[:, None], result.surface_y)
    return float(from_side[touched].min())


def _of_elements(result: Result) -> dict[str, Any]:
    from sim.fem.sizing import squeeze

    fineness = fineness_of(result)
    layers = np.full(len(fineness), result.record["mesh"]["cells"][2])
    for stage in result.record.get("stages", []):
        layers[: stage["waypoints"]] = stage["mesh"]["cells"][2]
    # Quadratic where the contact is resolved, linear where it is barely resolved.
    resolved = PER_SQUARE / (np.maximum(fineness, RESOLVED) * fineness)
    squeezed = squeeze(result.scene, result.quality.contact_width) / layers**2
    by_edge = edge_errors(result)
    # Each is the most of an error that does not depend on the others.
    fraction = np.sqrt(resolved**2 + squeezed**2 + by_edge**2 + further_errors(result) ** 2)
    # A contact smaller than an element has a force, but no width.
    fraction[np.isinf(fineness) & result.force.any(axis=1)] = 1.0
    fraction = _weighed(result, fraction) + steps_share(result) + waves_share(result)
    # A press that overlaps the skin without a force has missed it.
    pressed = np.array([point[2] < 0 for point in result.scene.motion.tip])
    by = "how finely the contact is meshed" + (", and steps in time" * ("time" in result.record))
    missed = pressed & ~result.force.any(axis=1) & (result.quality.overlap > 0)
    return error_entry(result, "estimated", np.maximum(fraction, missed), by)


def touched_edge(result: Result) -> Array:
    """Return the length of the sharpest edge that the skin touches (F,) [m]; inf on a round tip.

    A light press touches less than its radius: sqrt(2 R d), as on a line (Hertz). If that is more
    than half of the contact, there is no edge but the tip itself.
    """
    edge = min(result.scene.indenter.sharpest, result.scene.body.size_x)
    depth = np.maximum(-np.asarray(result.scene.motion.tip)[:, 2], 0.0)
    touched = np.minimum(edge, np.sqrt(2 * edge * depth))
    return np.where(touched < result.quality.contact_width / 2, touched, np.inf)


def edge_errors(result: Result) -> Array:
    """Return the error of a force by the length of elements at an edge (F,), over the force.

    Contacts end at nodes, so that two meshes may have the same error by chance. Their width is
    uncertain by no more than the touched part of the edge, or a part of an element.
    """
    touched, width = touched_edge(result), np.maximum(result.quality.contact_width, 1e-9)
    finest = result.record["mesh"].get("finest", 0.0)
    across = np.maximum(touched, ACROSS_EDGE * finest) / width
    lengths = finest / np.maximum(touched, 1e-9)
    return np.asarray(np.minimum(np.minimum(EDGE_MOST, across), PER_EDGE * lengths**2))


def steps_share(result: Result) -> Array:
    """Return the error by steps in time of each frame (F,), over the force."""
    none = np.zeros(len(result.force))
    return np.array(result.record.get("time", {}).get("force", none))


def waves_share(result: Result) -> Array:
    """Return the estimated error by waves of each frame (F,), over the force.

    Waves are damped as if stresses were those of a moment earlier or later
    (`sim.fem.assembly.damping_time`): by how much shows in the frames around. A force that begins
    at once is too large for about as long. A tip that has left the skin for longer feels none.
    """
    damped = result.record.get("mesh", {}).get("damped", 0.0)
    if not damped or len(result.force) < 2:
        return np.zeros(len(result.force))
    time, felt = np.array(result.scene.motion.time), np.asarray(result.force.any(axis=1))
    rate = np.abs(np.diff(result.force, axis=0)).max(axis=1) / np.diff(time)
    reach, going_on = WAVE_REACH * damped, np.append(felt[2:], False)
    began = np.maximum.accumulate(np.where(felt[1:] & ~felt[:-1], time[:-1], -np.inf))
    rate[(time[:-1] - began < reach) & going_on] = 0.0
    near = (time[:-1] <= time[:, None] + reach) & (time[1:] >= time[:, None] - reach)
    fastest = np.where(near, rate, 0.0).max(axis=1)
    since = time - np.append(-np.inf, began)
    impact = IMPACT * np.exp(-since / (IMPACT_LASTS * damped))
    waves = PER_DAMPING * damped * fastest / force_scale(result.force) + impact * felt
    height = np.asarray(result.scene.motion.tip)[:, 2]
    above = np.minimum(height / np.maximum(np.diff(height, prepend=height[0]), 1e-12), 1.0)
    left = ~felt & (above * np.diff(time, prepend=time[0]) > reach)
    return np.where(left, 0.0, waves)


def further_errors(result: Result, measured: Array | None = None) -> Array:
    """Return the errors of a `fem` result (F,), over the force, that a finer mesh may not reduce.

    They are those of skin that stiffens or folds (the correction to a skin that does not, and
    overlaps), of an indenter that stands in the skin, and of contacts at the side of a round body;
    at its rim no larger than `measured` (F,) by a second mesh, if given.
    """
    from sim.fem.outcome import OVERLAP_GOOD, overlap_shares

    record, frames = result.record, np.arange(len(result.force))
    through = overlap_shares(result, result.quality.overlap)
    fraction = np.minimum(PER_SUNK * result.quality.contact, 1.0)
    if record["mesh"].get("finer_failed"):
        fraction = fraction + PER_OVERLAP * through
    stiffening = record.get("stiffening")
    if stiffening is not None:
        folded = overlap_shares(result, np.array(record["self_overlap"]["metres"]))
        both = np.maximum(through - OVERLAP_GOOD, 0.0) + np.maximum(folded - OVERLAP_GOOD, 0.0)
        changed = np.array(stiffening["correction"]) + PER_OVERLAP * both
        fraction = fraction + np.where(frames < stiffening["waypoint"], 0.0, changed)
    at_rim = record.get("rim", [])
    by_rim = AT_RIM / fineness_of(result)
    fraction[at_rim] += (by_rim if measured is None else np.minimum(by_rim, measured))[at_rim]
    return fraction + wall_errors(result)


def wall_errors(result: Result) -> Array:
    """Return the error of a force by contact with a round body's side wall (F,), over the force."""
    fraction = np.zeros(len(result.force))
    at_wall = result.record.get("wall", [])
    fraction[at_wall] = np.minimum(PER_WALL * np.array(result.record.get("wall_shares", 1.0)), 1.0)
    return fraction


def _of_layer(result: Result) -> dict[str, Any]:
    body, side = result.scene.body, side_distance(result)
    why = ""
    if body.rim < RIM_UNEVEN * body.thickness:
        why = (
            f"the dome is {body.rim * 1e3:.3g} mm high at its rim, and 'layer' assumes the same "
            "thickness there as at its apex (allowed: 'fem')"
        )
    elif side is not None and side < RIM * body.thickness:
        why = (
            f"the contact is {side * 1e3:.3g} mm from a side of the body, of which 'layer' knows "
            "nothing (allowed: 'fem')"
        )
    if why:
        return {"status": "none", "why": why}
    deep = np.maximum(-np.array(result.scene.motion.tip)[:, 2], 0.0) / body.thickness
    fraction = LAYER_LEAST + LAYER_PER_DEPTH * deep
    width = np.maximum(result.quality.contact_width, 1e-12)
    pixels = LAYER_PER_PIXEL * pixel_of(result) / width
    fraction = fraction + np.where(result.force.any(axis=1), pixels, 0.0)
    fraction = np.maximum(_weighed(result, fraction), _missed(result))
    return error_entry(result, "estimated", fraction, "depth over thickness, and pixels")


def _missed(result: Result) -> Array:
    """Return the force missing in frames that should touch, but on too few pixels, over the scale.

    It is up to that of the first resolved frame after them, in proportion to the depth; without
    one, all of it is missing.
    """
    from sim.fem.sizing import covered

    scene, fraction = result.scene, np.zeros(len(result.force))
    force, tips = np.linalg.norm(result.force, axis=1), np.asarray(scene.motion.tip)
    weak = force < WEAK * force.max(initial=0.0)
    narrow = result.quality.contact_width < NARROW * pixel_of(result)
    resolved = (force > 0) & ~(weak & narrow)
    first = int(np.argmax(resolved)) if resolved.any() else len(force)
    scale = force_scale(result.force)
    for frame in range(first):
        tip, missing = tips[frame], 0.0
        if first == len(force):
            missing = 1.0
        elif not force[frame]:
            missing = force[first] / scale[first]
        elif force[frame] < FAINT * (likely := force[first] * tip[2] / tips[first, 2]):
            missing = likely / scale[frame]
        if missing and tip[2] < 0 and covered(scene.indenter, scene.body, tip) is not None:
            fraction[frame] = missing
    return fraction


def _weighed(result: Result, fraction: Array) -> Array:
    """Convert fractions of each force to fractions of it or of `WEAK` of the largest one."""
    force = np.linalg.norm(result.force, axis=1)
    least = WEAK * float(force.max(initial=0.0))
    weighed = np.where(np.isfinite(fraction), fraction, 0.0)
    if least <= 0:
        return weighed
    return np.where(force >= least, weighed, weighed * np.maximum(force, 1e-3 * least) / least)


def error_entry(
    result: Result, status: str, fraction: Array, by: str, **more: Any
) -> dict[str, Any]:
    """Return the entry `record["error"]` of a result, with `more`.

    The status is `measured` or `estimated`, the error of the force of each frame (F,) a fraction of
    the force; `by` names the method in words.
    """
    fraction = np.minimum(np.maximum(fraction, vanishing_share(result)), ERROR_MOST)
    return {
        "status": status,
        "by": by,
        "percent": float(100 * fraction.max(initial=0.0)),
        "force": [float(f"{one:.4g}") for one in fraction],
        **more,
    }


def describe_error(error: dict[str, Any]) -> str:
    """Return an error in words for the user."""
    if error["status"] == "none":
        return f"error of the force: not known; {error['why']}"
    by, rounding = error["by"], error.get("rounding_percent", 0.0)
    if rounding:
        by += f"; {_percent(rounding)} by edges of the file that are rounded, unless given as such"
    return f"error of the force: {_percent(error['percent'])} ({error['status']}: {by})"


def _percent(percent: float) -> str:
    return f"{percent:.2g} %" if percent < 9.95 else f"{percent:.0f} %"


def notes(result: Result) -> list[str]:
    """Return remarks on the accuracy and validity of the result; may be empty."""
    solid = result.scene.indenter.solid
    reported = [] if solid is None else list(solid.notes)
    if result.tier == "fem":
        body = result.scene.body
        size = max(
            body.size_x / result.record["mesh"]["cells"][0],
            body.size_y / result.record["mesh"]["cells"][1],
        )
        edge = result.scene.indenter.sharpest
        if edge < EDGE_NOTE_SHARE * size:
            reported.append(
                f"the indenter's sharpest radius, {edge * 1e3:g} mm, is finer than the elements, "
                f"{size * 1e3:.3g} mm: the force still depends on the mesh"
            )
    if "error" in result.record:
        reported.append(describe_error(result.record["error"]))
    if "plan" in result.record:
        reported += [f"taken: {result.record['plan']['why']}", *result.record["plan"]["notes"]]
    if "precision_reason" in result.record:
        reported.append(result.record["precision_reason"])
    return reported


# Symmetry check of results: a scene mirrored in a vertical plane allows no force across it.
#
# If body, indenter, motion and gravity are their own image in a plane, so is the solution. A force
# along the plane's normal, or a torque about a line in the plane, is then an error of the solver
# and nothing else, known without a second solution. Or it is a state that is not symmetric, as of a
# soft skin that gives way to one side under a blade: one of two that are equally right. Gravity
# across the plane may decide for one, and explains a force of about the skin's weight, no more.

# Possible mirror planes of a body, and their unit normals (x, y).
PLANES: dict[str, Normal] = {
    "x = 0": (1.0, 0.0),
    "y = 0": (0.0, 1.0),
    "x = y": (math.sqrt(0.5), -math.sqrt(0.5)),
    "x = -y": (math.sqrt(0.5), math.sqrt(0.5)),
}
# Distance of a waypoint from a plane, over the thickness, that counts as rounding.
OFF_PLANE = 1e-9
# Difference of an indenter from its image, over the depth of the press, that is ignored: it changes
# the force by as little.
ALIKE = 5e-3
# Points along x and y, and heights, at which an indenter is compared with its image: first a few,
# which find most asymmetric ones, then many.
COLUMNS, LEVELS = (10, 40), 6
# Fraction of the force above which there is a warning.
WORTH_SAYING = 0.01
NOTE = "the scene is its own image in the plane"
# Force across a plane that gravity explains, over the skin's weight along it: indenter and base
# share the weight.
EXPLAINED = 3.0


def planes_of(scene: Scene) -> tuple[str, ...]:
    """Return the mirror planes of a scene, as names of `PLANES`."""
    return tuple(name for name in _planes_but_for_gravity(scene) if not _pull(scene, name))


def _planes_but_for_gravity(scene: Scene) -> tuple[str, ...]:
    whole = len(scene.motion.tip)
    return tuple(name for name, normal in PLANES.items() if _mirrored(scene, normal) == whole)


def vanishing_share(result: Result) -> Array:
    """Return the largest force across a mirror plane of the scene (F,), over the force.

    Over a tenth of the largest force if a frame's own is smaller; 0 without such a plane. A motion
    that leaves the plane has such forces only up to there. Later frames, on the same mesh, get the
    largest of them, as the error of a force along the skin. If gravity is across the plane, the
    force that it explains is subtracted.
    """
    across = np.zeros(len(result.wrench))
    for name in PLANES:
        count = _mirrored(result.scene, PLANES[name])
        if not count:
            continue
        forbidden = _across(result, name)[:count]
        across[:count] = np.maximum(across[:count], forbidden)
        across[count:] = np.maximum(across[count:], forbidden.max(initial=0.0))
    return across / force_scale(result.force)


def with_symmetry(result: Result) -> Result:
    """Return the `fem` result with `record["symmetry"]`, if its scene is mirrored in a plane.

    Keys: `plane`, the plane with the largest error; `vanishing_force_newton`, the largest force
    along its normal; `vanishing_torque_newton_metre`, the largest torque about the tip that it
    forbids; `percent`, the force over that of the frame, or over a tenth of the largest one. Above
    1 % there is a warning.
    """
    result = _with_note_beside_gravity(result)
    planes = planes_of(result.scene)
    if not planes:
        return result
    scale = force_scale(result.force)
    across = {name: np.abs(result.force[:, :2] @ PLANES[name]) for name in planes}
    plane = max(planes, key=lambda name: float((across[name] / scale).max(initial=0.0)))
    fraction = float((across[plane] / scale).max(initial=0.0))
    x, y = PLANES[plane]
    # A mirror reverses torques in its plane, so only a torque along its normal is allowed.
    forbidden = result.wrench[:, 3:] @ np.array([[-y, 0.0], [x, 0.0], [0.0, 1.0]])
    symmetry = {
        "plane": plane,
        "vanishing_force_newton": float(across[plane].max(initial=0.0)),
        "vanishing_torque_newton_metre": float(np.linalg.norm(forbidden, axis=1).max(initial=0.0)),
        "percent": 100 * fraction,
    }
    warnings = [one for one in result.record["warnings"] if not str(one).startswith(NOTE)]
    if fraction > WORTH_SAYING:
        warnings.append(
            f"{NOTE} {plane}, but {100 * fraction:.2g} % of the force is across it: the mesh, or a "
            "state that is not symmetric"
        )
    return replace(result, record={**result.record, "symmetry": symmetry, "warnings": warnings})


def _with_note_beside_gravity(result: Result) -> Result:
    """Return the result with a warning of forces across a plane that gravity does not explain."""
    scene, begins = result.scene, f"but for gravity {NOTE}"
    warnings = [one for one in result.record["warnings"] if not str(one).startswith(begins)]
    for name in _planes_but_for_gravity(scene):
        fraction = float((_across(result, name) / force_scale(result.force)).max(initial=0.0))
        if _pull(scene, name) and fraction > WORTH_SAYING:
            warnings.append(
                f"{begins} {name}, and {100 * fraction:.2g} % of the force is across "
                "it that gravity does not explain: the mesh, or a skin that gives way to one side "
                "and might as well to the other"
            )
    return replace(result, record={**result.record, "warnings": warnings})


def _across(result: Result, name: str) -> Array:
    """Return the size of each frame's force across a plane, beyond that by gravity (F,) [N]."""
    across = np.abs(result.force[:, :2] @ PLANES[name])
    return np.maximum(across - _pull(result.scene, name), 0.0)


def _pull(scene: Scene, name: str) -> float:
    """Return the force across a plane that gravity explains [N]; 0 if gravity is along it."""
    body, gravity = scene.body, scene.effects.gravity
    if gravity is None:
        return 0.0
    pull = np.asarray(gravity.acceleration, float)
    across = abs(float(pull[:2] @ PLANES[name]))
    if across <= OFF_PLANE * np.linalg.norm(pull):
        return 0.0
    return EXPLAINED * body.density * body.size_x * body.size_y * body.thickness * across


def _mirrored(scene: Scene, normal: Normal) -> int:
    """Return the number of waypoints up to which the scene is its image in a plane, but gravity."""
    body = scene.body
    if 0.0 not in normal and body.size_x != body.size_y:
        return 0
    limit = OFF_PLANE * body.thickness
    x, y, _ = scene.motion.tip[0]
    if abs(x * normal[0] + y * normal[1]) > limit:  # most scenes: no array is made for them
        return 0
    off = np.abs(np.asarray(scene.motion.tip)[:, :2] @ normal) > limit
    count = int(np.argmax(off)) if off.any() else len(off)
    if not count:
        return 0
    depth = scene.motion.depth_max
    if depth <= 0:
        return 0
    across = math.hypot(body.size_x, body.size_y)
    return count if asymmetry(scene.indenter, normal, depth, across) <= ALIKE * depth else 0


@functools.lru_cache(maxsize=4096)
def asymmetry(indenter: Indenter, normal: Normal, reach: float, across: float) -> float:
    """Return the difference of an indenter's surface from its image in a plane through its tip [m].

    The plane is vertical, with the unit normal (x, y). The result is the largest difference of the
    signed distances at points and their images, among those closer to the surface than `reach` [m],
    their largest height, and within `across` [m] of the tip; or at only a few of them, if those
    already differ too much.
    """
    sides = np.abs(indenter.bounds_below(reach)[:2]).max(axis=1)
    half, difference = np.minimum(sides, across), math.inf
    for columns in COLUMNS:
        difference = _difference(indenter, normal, reach, half, columns)
        if ALIKE * reach < difference < math.inf:
            break
    return difference


def _difference(
    indenter: Indenter, normal: Normal, reach: float, half: Array, columns: int
) -> float:
    # Points are denser near the tip; none is on a plane of symmetry, where both sides agree.
    fraction = (np.arange(columns) + 0.5) / columns * 2 - 1
    fraction = fraction * np.abs(fraction)
    height = reach * np.linspace(0.0, 1.0, LEVELS)
    points = np.stack(np.meshgrid(fraction * half[0], fraction * half[1], height), -1).reshape(
        -1, 3
    )
    aside = points[:, :2] @ normal
    points, aside = points[aside > 0], aside[aside > 0]
    image = points.copy()
    image[:, :2] -= 2 * aside[:, None] * np.array(normal)
    here, there = indenter.distance(np.stack([points, image]))[0]
    near = np.minimum(np.abs(here), np.abs(there)) < reach
    return float(np.abs(here - there)[near].max()) if near.any() else math.inf
