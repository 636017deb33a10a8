"""Rotation vectors and poses in UR controllers' convention, accurate up to half a turn.

A pose is six numbers: position [m] and rotation vector [rad] (axis times angle, angle at most pi).
A pose `a_to_b` maps points of frame a to frame b. All functions accept leading batch axes.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def matrix_from_vector(vector: ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    r = np.asarray(vector, np.float64)
    angle = np.sqrt(np.sum(r * r, axis=-1))[..., None, None]
    # numpy's sinc is sin(pi x) / (pi x): both factors are smooth through angle 0.
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    cross = np.zeros((*r.shape[:-1], 3, 3))
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -r[..., 2], r[..., 1], -r[..., 0]
    cross[..., 1, 0], cross[..., 2, 0], cross[..., 2, 1] = r[..., 2], -r[..., 1], r[..., 0]
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def vector_from_matrix(matrix: ArrayLike) -> Array:
    """Return rotation vectors (..., 3) [rad], angle in [0, pi], of matrices (..., 3, 3).

    The quaternion is computed by dividing by its largest element. The arc cosine of the trace would
    lose half of the digits near pi, the rotation of a tool that points down.
    """
    m = np.asarray(matrix, np.float64)
    x, y, z = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = np.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], -1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    # Row k is the quaternion (w, x, y, z) times 4 q_k.
    rows = np.stack(
        [
            np.stack([squares[..., 0], a, b, c], -1),
            np.stack([a, squares[..., 1], d, e], -1),
            np.stack([b, d, squares[..., 2], f], -1),
            np.stack([c, e, f, squares[..., 3]], -1),
        ],
        -2,
    )
    best = np.argmax(squares, -1)[..., None, None]
    quaternion = np.take_along_axis(rows, best, -2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    quaternion = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    axis = quaternion[..., 1:]
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternion[..., :1])
    tiny = sine < 1e-12
    return np.asarray(axis * np.where(tiny, 2.0, angle / np.where(tiny, 1.0, sine)))


def compose(outer: ArrayLike, inner: ArrayLike) -> Array:
    """Return the pose (..., 6) that applies `inner` first: b_to_c of a_to_b is a_to_c."""
    b, a = np.asarray(outer, np.float64), np.asarray(inner, np.float64)
    turn = matrix_from_vector(b[..., 3:])
    position = b[..., :3] + (turn @ a[..., :3, None])[..., 0]
    rotation = vector_from_matrix(turn @ matrix_from_vector(a[..., 3:]))
    return np.concatenate([position, rotation], -1)


def invert(pose: ArrayLike) -> Array:
    """Return the inverse (..., 6) of a pose: b_to_a of a_to_b."""
    p = np.asarray(pose, np.float64)
    back = np.swapaxes(matrix_from_vector(p[..., 3:]), -1, -2)
    return np.concatenate([-(back @ p[..., :3, None])[..., 0], -p[..., 3:]], -1)


def transform(pose_a_to_b: ArrayLike, points: ArrayLike) -> Array:
    """Transform points (..., 3) [m] of frame a to frame b."""
    pose = np.asarray(pose_a_to_b, np.float64)
    turned = matrix_from_vector(pose[..., 3:]) @ np.asarray(points, np.float64)[..., None]
    return np.asarray(pose[..., :3] + turned[..., 0])


def rotation_between(start: ArrayLike, goal: ArrayLike) -> Array:
    """Return the rotation vector (..., 3) [rad], in the base frame, from `start` to `goal`."""
    a, b = np.asarray(start, np.float64), np.asarray(goal, np.float64)
    turn = matrix_from_vector(b[..., 3:]) @ np.swapaxes(matrix_from_vector(a[..., 3:]), -1, -2)
    return vector_from_matrix(turn)


def turn(rotation: ArrayLike, vector: ArrayLike) -> Array:
    """Turn orientations `vector` (..., 3) by `rotation` about the base axes."""
    return vector_from_matrix(matrix_from_vector(rotation) @ matrix_from_vector(vector))
