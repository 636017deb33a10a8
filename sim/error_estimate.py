"""Error of a result, and how it is known.

`record["error"]` of every result has a `status`: `measured` (a second mesh was solved), `estimated`
(from the resolution of the contact, by rules that were checked against independent solutions:
`python -m benchmarks independent`), or `none`. `force` is the error of the force, frame by frame,
over the force of the frame or a tenth of the largest one; `percent` is the largest of them. No
error is below the size of a force that symmetry forbids (`sim.symmetry`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.metrics import WEAK, force_scale
from sim.result import SIDES, Result
from sim.symmetry import vanishing_share, with_symmetry

Array = NDArray[np.float64]

# Error of the force at fineness 1 (12 elements across the contact): it falls with the square of the
# elements' size. 0.012 covered 110 of the 133 forces of `benchmarks independent`.
PER_SQUARE = 0.016
# Fineness below which the error grows linearly with the elements' size.
RESOLVED = 0.5
# Error of the force if the smallest elements are as long as an edge's radius; it falls with the
# square too.
PER_EDGE = 0.03
# Largest error by an unresolved edge: for a sharp punch, a fifth of the force.
EDGE_MOST = 0.2
# Error of `layer` over depth over thickness: it is limited to small strains.
LAYER_PER_DEPTH = 0.7
# Error of `layer` over the pixel's side over the contact's width. With both numbers the error
# covers all 136 forces of `benchmarks independent --tier layer --set axisymmetric`.
LAYER_PER_PIXEL = 1.2
# A force is missing for the greater part if its contact is narrower than this many pixels and it is
# below this fraction of a later one in proportion to the depth.
NARROW, FAINT = 2.0, 0.1
# Least error of `layer`.
LAYER_LEAST = 0.003
# Distance of a contact from the nearest side, in thicknesses, below which `layer` is wrong: it has
# no sides.
RIM = 1.0
# Height of a dome's rim over the thickness below which it does not behave like a layer.
RIM_UNEVEN = 0.5


def unknown_at_side(result: Result, *, measured: bool = False) -> dict[str, Any] | None:
    """Return the unknown error of a result in contact at the side of a round body; else None.

    An error `measured` on two meshes includes the cut rim, but not the wall.
    """
    for name in ("wall",) if measured else ("wall", "rim"):
        if result.record.get(name):
            return {"status": "none", "why": SIDES[name]}
    return None


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
    return replace(result, record={**result.record, "error": error})


def fineness_of(result: Result) -> Array:
    """Return how finely each frame of a `fem` result resolves its own contact (F,).

    1 corresponds to 12 elements from one side of the contact to the other; inf without contact.
    """
    told = result.record["mesh"]["resolved"]
    found = np.array([np.inf if one is None else one for one in told], float)
    for stage in result.record.get("stages", []):  # separate meshes for small contacts
        found[: stage["waypoints"]] = stage["mesh"]["fineness"]
    return found


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

    unknown = unknown_at_side(result)
    if unknown is not None:
        return unknown
    fineness = fineness_of(result)
    layers = np.full(len(fineness), result.record["mesh"]["cells"][2])
    for stage in result.record.get("stages", []):
        layers[: stage["waypoints"]] = stage["mesh"]["cells"][2]
    # Quadratic where the contact is resolved, linear where it is barely resolved.
    fraction = PER_SQUARE / (np.maximum(fineness, RESOLVED) * fineness)
    fraction = fraction + squeeze(result.scene, result.quality.contact_width) / layers**2
    edge, finest = result.scene.indenter.sharpest, result.record["mesh"].get("finest", 0.0)
    fraction = fraction + min(EDGE_MOST, PER_EDGE * (finest / max(edge, 1e-9)) ** 2)
    pressed = np.array([point[2] < 0 for point in result.scene.motion.tip])
    error = error_entry(
        result, "estimated", _weighed(result, fraction), "how finely the contact is meshed"
    )
    missed = pressed & ~result.force.any(axis=1) & (result.quality.overlap > 0)
    if missed.any():
        error["force"] = [
            1.0 if one else fraction
            for one, fraction in zip(missed.tolist(), error["force"], strict=True)
        ]
        error["percent"] = 100.0
    return error


def _of_layer(result: Result) -> dict[str, Any]:
    body = result.scene.body
    deep = np.maximum(-np.array(result.scene.motion.tip)[:, 2], 0.0) / body.thickness
    fraction = LAYER_LEAST + LAYER_PER_DEPTH * deep
    width = np.maximum(result.quality.contact_width, 1e-12)
    pixels = LAYER_PER_PIXEL * pixel_of(result) / width
    fraction = fraction + np.where(result.force.any(axis=1), pixels, 0.0)
    fraction = np.maximum(_weighed(result, fraction), _missed(result))
    error = error_entry(result, "estimated", fraction, "depth over thickness, and pixels")
    if body.rim < RIM_UNEVEN * body.thickness:
        return {
            "status": "none",
            "why": f"the dome is {body.rim * 1e3:.3g} mm high at its rim, and 'layer' assumes the "
            "same thickness there as at its apex (allowed: 'fem')",
        }
    side = side_distance(result)
    if side is not None and side < RIM * body.thickness:
        return {
            "status": "none",
            "why": f"the contact is {side * 1e3:.3g} mm from a side of the body, of which "
            "'layer' knows nothing (allowed: 'fem')",
        }
    return error


def _missed(result: Result) -> Array:
    """Return the force missing in frames that should touch, but on too few pixels, over the scale.

    It is up to that of the first resolved frame after them, in proportion to the depth; without
    one, all of it is missing.
    """
    from sim.fem.sizing import covered

    scene, found = result.scene, np.zeros(len(result.force))
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
            found[frame] = missing
    return found


def _weighed(result: Result, fraction: Array) -> Array:
    """Convert fractions of each force to fractions of it or of `WEAK` of the largest one."""
    force = np.linalg.norm(result.force, axis=1)
    least = WEAK * float(force.max(initial=0.0))
    if least <= 0:
        return np.where(np.isfinite(fraction), fraction, 0.0)
    found = np.where(np.isfinite(fraction), fraction, 0.0)
    return np.where(force >= least, found, found * np.maximum(force, 1e-3 * least) / least)


def error_entry(
    result: Result, status: str, fraction: Array, by: str, **more: Any
) -> dict[str, Any]:
    """Return the entry `record["error"]` of a result.

    Args:
        result: Result that the error belongs to.
        status: `measured` or `estimated`.
        fraction: Error of the force of each frame (F,), over the force.
        by: Method, in words.
        more: Further entries.
    """
    fraction = np.minimum(np.maximum(fraction, vanishing_share(result)), 1.0)
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
    percent = error["percent"]
    number = f"{percent:.2g}" if percent < 9.95 else f"{percent:.0f}"
    return f"error of the force: {number} % ({error['status']}: {error['by']})"
