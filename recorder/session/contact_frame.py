"""Places in the contact frame of a session, whose z axis is the outward normal of the skin."""

import numpy as np
from numpy.typing import NDArray

from recorder.session.align import quaternion
from recorder.session.reader import Session

Floats = NDArray[np.float64]


def in_frame(frame: Floats, poses: Floats) -> Floats:
    """Return the places of poses in a frame (n, 3) [m]; in the contact frame, depth is -z.

    The frame (6,) and the places, or tool poses, (n, 3 or more) are in the base frame [m, rad]; of
    the contact frame z is the outward normal.
    """
    axes = axes_of(frame[3:])
    return np.stack([(poses[:, :3] - frame[:3]) @ axis for axis in axes], axis=1)


def axes_of(vector: Floats) -> Floats:
    """Return the axes (3, 3) of a frame in the base frame, one a row, by its rotation vector (3,).

    The rotation vector is in radians.
    """
    w, x, y, z = quaternion(vector)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def surface_heights(session: Session) -> Floats:
    """Return the height of the undeformed surface at each target's point (t,) [m].

    It is 0 on a flat sensor. On one with a dome, which the plan states, it is below 0 beside the
    apex; depths are measured from it.
    """
    targets, frame = session.targets, session.attrs.get("contact_frame")
    plan = session.attrs.get("plan")
    if frame is None or not isinstance(plan, dict) or plan.get("dome_radius") is None:
        return np.zeros(len(targets.get("depth", ())))
    planned = np.asarray(targets["planned"], np.float64)
    height = np.asarray(targets["depth"]) + in_frame(np.asarray(frame, np.float64), planned)[:, 2]
    # Planned places went through a rotation; no surface is known to a nanometre.
    return np.asarray(height.round(9) + 0.0)
