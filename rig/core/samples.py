"""Records of each stream's newest sample, shared between processes through memory.

The guard reads force and pose here, the live display reads all of them. Samples on disk do not
pass through here: each stream's process appends its own.
"""

import numpy as np

# Wrench minus the tare [N, N m] in the F/T frame, with arrival time at the host [ns].
FORCE_LATEST = np.dtype([("t_ns", "<i8"), ("status", "<i8"), ("value", "<f8", (6,))])

# TCP pose in the base frame [m, rad], controller clock [s], RTDE safety_status_bits.
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

# State of the sensor's signal on a bench without a force gauge. Arrival [ns] of the newest sample,
# of the newest that differed from its predecessor, and of the newest that differed by more than
# noise from the one that last did so; change since the last zero in standard deviations of its
# noise, largest motion of a marker [px] or deviation of a taxel [counts].
SIGNAL_LATEST = np.dtype(
    [
        ("t_ns", "<i8"),
        ("fresh_ns", "<i8"),
        ("moved_ns", "<i8"),
        ("change", "<f8"),
        ("motion", "<f8"),
    ]
)

# Arrival time and row of the newest frame; images never cross a process boundary.
CAMERA_LATEST = np.dtype([("t_ns", "<i8"), ("row", "<i8")])

# TCP pose of the emulated controller at its own cycle, for the World [m, rad, m/s, rad/s].
ARM_TRUTH = np.dtype([("t_ns", "<i8"), ("pose", "<f8", (6,)), ("speed", "<f8", (6,))])

# Timestamped state of the World: TCP pose in the base frame [m, rad], indentation [m] (negative
# above the surface), contact position and tangential surface displacement in the contact frame [m],
# wrench on the sensor in the F/T frame [N, N m]; number of the object that a hand holds.
WORLD_STATE = np.dtype(
    [
        ("t_ns", "<i8"),
        ("pose", "<f8", (6,)),
        ("depth", "<f8"),
        ("contact", "<f8", (2,)),
        ("shear", "<f8", (2,)),
        ("wrench", "<f8", (6,)),
        ("object", "<i8"),
    ]
)

# Opening of an emulated hand's unbent fingers, for the World [m].
HAND_TRUTH = np.dtype([("t_ns", "<i8"), ("opening", "<f8")])

# Status of a gripper: opening and commanded opening [m], and its object detection (gOBJ).
GRIPPER_LATEST = np.dtype(
    [("t_ns", "<i8"), ("value", "<f8"), ("commanded", "<f8"), ("object", "<i8")]
)


def press_state(count: int) -> np.dtype[np.void]:
    """Return the dtype of a solver's last solution and its derivatives, for extrapolation.

    Tip in the contact frame [m], mean tangential displacement under it [m], friction coefficient,
    `count` values (wrench about the tip [N, N m], then taxels [counts]), their derivatives by tip
    position [1/m] and by time [1/s].
    """
    return np.dtype(
        [
            ("t_ns", "<i8"),
            ("tip", "<f8", (3,)),
            ("touching", "<i8"),
            ("shear", "<f8", (2,)),
            ("friction", "<f8"),
            ("values", "<f8", (count,)),
            ("slope", "<f8", (count, 3)),
            ("rate", "<f8", (count,)),
        ]
    )


def latest_dtype(kind: str, shape: tuple[int, ...]) -> np.dtype[np.void]:
    """Return the dtype of the newest sample of a stream of a kind, whose values have a shape."""
    if kind == "taxels":
        # Raw counts by taxel and axis.
        return np.dtype([("t_ns", "<i8"), ("value", "<i4", shape)])
    return {
        "force": FORCE_LATEST,
        "pose": POSE_LATEST,
        "arm_wrench": FORCE_LATEST,
        "camera": CAMERA_LATEST,
        "gripper": GRIPPER_LATEST,
    }[kind]


def surface_state(shape: tuple[int, int]) -> np.dtype[np.void]:
    """Return the dtype of a simulated World's last two deformations, `shape` points on its top.

    Tips (3,) and displacements (X, Y, 3) in the contact frame [m], newest first.
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
