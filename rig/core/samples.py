"""What a stream's process shows the others of its newest sample, through shared memory.

The guard reads force and pose from here, the live line reads all of them. Samples on disk do not
take this way: every stream's process appends its own.
"""

from __future__ import annotations

import numpy as np

# Wrench less the tare [N, N m] in the F/T frame, with the host's arrival time [ns].
FORCE_LATEST = np.dtype([("t_ns", "<i8"), ("status", "<i8"), ("value", "<f8", (6,))])

# TCP pose in the base frame [m, rad], the controller's clock [s], RTDE safety_status_bits.
POSE_LATEST = np.dtype(
    [
        ("t_ns", "<i8"),
        ("device_t", "<f8"),
        ("safety_status", "<i8"),
        ("runtime_state", "<i8"),
        ("speed_scaling", "<f8"),
        ("value", "<f8", (6,)),
    ]
)

# Raw counts, taxel by taxel, x y z.
TAXELS_LATEST = np.dtype([("t_ns", "<i8"), ("value", "<i4", (16, 3))])

# The newest frame's arrival time and row; frames themselves never cross a process boundary.
CAMERA_LATEST = np.dtype([("t_ns", "<i8"), ("row", "<i8")])

# The emulated controller's TCP pose at its own cycle, for the World [m, rad, m/s, rad/s].
ARM_TRUTH = np.dtype([("t_ns", "<i8"), ("pose", "<f8", (6,)), ("speed", "<f8", (6,))])

# One stamped state of the World: TCP pose in the base frame [m, rad], indentation [m] (negative
# above the surface), contact position and tangential surface displacement in the contact frame [m],
# wrench on the sensor in the F/T frame [N, N m], taxels before noise [counts].
WORLD_STATE = np.dtype(
    [
        ("t_ns", "<i8"),
        ("pose", "<f8", (6,)),
        ("depth", "<f8"),
        ("contact", "<f8", (2,)),
        ("shear", "<f8", (2,)),
        ("wrench", "<f8", (6,)),
        ("taxels", "<f8", (16, 3)),
    ]
)

# The last solution of a simulated World, and how to go on from it: the tip in the contact frame
# [m], the mean sideways displacement under it [m], the coefficient of friction, wrench about the
# tip [N, N m] and taxels [counts], what they change with the tip [1/m] and with time [1/s].
PRESS_STATE = np.dtype(
    [
        ("t_ns", "<i8"),
        ("tip", "<f8", (3,)),
        ("touching", "<i8"),
        ("shear", "<f8", (2,)),
        ("friction", "<f8"),
        ("values", "<f8", (54,)),
        ("slope", "<f8", (54, 3)),
        ("rate", "<f8", (54,)),
    ]
)


def surface_state(shape: tuple[int, int]) -> np.dtype[np.void]:
    """The last two deformations of a simulated World whose top has `shape` points.

    Tips (3,) and displacements (X, Y, 3) in the contact frame [m], the newest first.
    """
    surface = ("<f4", (*shape, 3))
    return np.dtype(
        [
            ("t_ns", "<i8"),
            ("tip", "<f8", (3,)),
            ("tip_before", "<f8", (3,)),
            ("surface", *surface),
            ("surface_before", *surface),
        ]
    )
