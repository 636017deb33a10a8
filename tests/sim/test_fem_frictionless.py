"""Contact without friction: no tangential force on a face, no dependence on mesh position.

Errors are compared with those that the results state themselves.
"""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from sim import Body, Result, Scene, press, simulate
from sim.fem import Fem, Grading
from sim.indenters import Indenter, box, flat_punch, sphere
from tests.support.few import few

Array = NDArray[np.float64]
SMALL = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
ROUGH = Fem(fineness=0.4)
SLOW = pytest.mark.slow
# Shifts within one element.
SIDES = 8
DEPTHS = (0.1e-3, 0.3e-3, 0.6e-3)
EVEN = Grading(growth=0.0)


def _face(indenter: Indenter) -> Array:
    """Return the outward normal (3,) of the face at the bottom of the upright indenter."""
    return -indenter.stance[0][:, 2]


def _stated(result: Result) -> float:
    """Return the stated error of the last frame, relative to its force."""
    return float(result.record["error"]["force"][-1])


def _along(force: Array, normal: Array) -> float:
    """Return the fraction of a force (3,) that is not along a normal."""
    return float(np.linalg.norm(np.cross(force, normal)) / np.linalg.norm(force))


# A plate wider than the body, with its low edge outside it: the body is in contact with one plane.

WIDE = 24e-3
# Degrees, distance of the low edge from the body's side, and depth of the edge [m].
PLATE: dict[int, tuple[float, float]] = {
    0: (0.0, 0.3e-3),
    5: (1.0e-3, 0.4e-3),
    15: (1.0e-3, 0.8e-3),
    30: (0.8e-3, 0.9e-3),
}


@pytest.mark.parametrize(
    ("degrees", "shift", "numerics"),
    few(
        [
            pytest.param(0, (0.0, 0.0), Fem(spacing=1e-3)),
            *(pytest.param(one, (0.07e-3, 0.3e-3), Fem(spacing=1e-3)) for one in PLATE),
        ],
        2,
    )
    + [pytest.param(one, (0.07e-3, 0.3e-3), Fem(), marks=SLOW) for one in (0, 5, 15)],
)
def test_a_plane_pushes_along_its_normal(
    degrees: int, shift: tuple[float, float], numerics: Fem
) -> None:
    angle = math.radians(degrees)
    plate = box(WIDE, WIDE, 0.3e-3).tilted(0.0, -angle)
    beside, depth = PLATE[degrees]
    x = WIDE / 2 * math.cos(angle) - SMALL.size_x / 2 - beside if degrees else 0.0
    scene = Scene(plate, press([depth], at=(x + shift[0], shift[1])), SMALL)
    result = simulate(scene, numerics)
    assert result.force[-1, 2] < -0.1
    assert _along(result.force[-1], _face(plate)) < 1e-6


# A tilted punch: its face pushes along the normal, its low edge equally in the other direction.


@pytest.mark.parametrize(
    ("degrees", "shift", "numerics"),
    [
        (15, 0.13e-3, ROUGH),
        pytest.param(0, 0.13e-3, ROUGH, marks=SLOW),
        pytest.param(5, 0.0, ROUGH, marks=SLOW),
        *(pytest.param(degrees, 0.13e-3, Fem(), marks=SLOW) for degrees in (0, 5, 15, 30)),
    ],
)
def test_a_leaning_punch_is_not_pulled_aside(degrees: int, shift: float, numerics: Fem) -> None:
    punch = flat_punch(2e-3, 0.3e-3)
    punch = punch.tilted(0.0, -math.radians(degrees)) if degrees else punch
    result = simulate(Scene(punch, press([0.3e-3], at=(shift, 0.0)), SMALL), numerics)
    stated = _stated(result)
    assert stated < 0.15
    # The body is wide: the work does not depend on the punch's position, so no force acts sideways.
    assert np.abs(result.force[-1, :2]).max() < stated * -result.force[-1, 2]
    # Nodes whose neighbours all touch the face itself, not its rounded edge.
    x, y = np.meshgrid(result.surface_x, result.surface_y, indexing="ij")
    places = np.stack([x, y, np.zeros_like(x)], axis=-1) + result.surface[-1]
    normal = punch.distance(places - np.array([shift, 0.0, -0.3e-3]))[1]
    traction = result.traction[-1].astype(float)
    inner = binary_erosion(normal @ _face(punch) > 1 - 1e-9, np.ones((3, 3)))
    inner &= np.abs(traction).max(axis=-1) > 0
    assert inner.sum() >= 5
    assert _along(traction[inner].sum(axis=0), _face(punch)) < 1e-6


# A sphere at positions within one element: equal forces, none of them sideways.


@SLOW
@pytest.mark.parametrize(
    ("element", "numerics", "most", "depth"),
    [
        # 3 to 5 elements across the contact, finer ones, and a mesh that goes along.
        *((0.8e-3, Fem(spacing=0.8e-3, grading=EVEN), 0.06, depth) for depth in DEPTHS[1:]),
        *((1.6e-3 / 3, Fem(spacing=1.6e-3 / 3, grading=EVEN), 0.015, depth) for depth in DEPTHS),
        *((0.3e-3, Fem(), 1e-3, depth) for depth in DEPTHS),
    ],
)
def test_a_sphere_is_pressed_alike_wherever_it_is_in_an_element(
    element: float, numerics: Fem, most: float, depth: float
) -> None:
    side = 8 * element * math.ceil(2e-3 / element)  # so that elements are of that size
    body = Body(size_x=side, size_y=side, thickness=4e-3)
    results = [
        simulate(
            Scene(sphere(3e-3), press([depth], at=(element * part / SIDES, 0.0)), body), numerics
        )
        for part in range(SIDES)
    ]
    force = np.array([result.force[-1] for result in results])
    stated = np.array([_stated(result) for result in results])
    mean = float(-force[:, 2].mean())
    ripple, aside = np.abs(-force[:, 2] - mean) / mean, np.abs(force[:, :2]).max(axis=1) / mean
    assert (ripple < stated).all()
    assert (aside < stated).all()
    assert max(ripple.max(), aside.max()) < most
    # Consistency check: the mesh stays in place, or follows.
    same = all((result.surface_x == results[0].surface_x).all() for result in results)
    assert same != numerics.follows
