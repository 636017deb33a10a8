"""Blade, rim and corner: forces are correct within the error that a result states.

Ground truth is from GetFEM (`benchmarks independent`) where available, else from a finer mesh.
"""

import numpy as np
import pytest

from benchmarks.independent.presses import PRESSES
from sim import Body, Effects, Friction, Layer, Motion, Result, Scene, press, simulate
from sim.fem import Fem
from sim.indenters import Indenter, box, plane, sphere

SLOW = pytest.mark.slow
BLADE = box(0.5e-3, 12e-3, 0.2e-3)


def _against_getfem(name: str, indenter: Indenter, fem: Fem = Fem()) -> Result:
    """Solve a case with `sim` and compare its forces with GetFEM's within both stated errors."""
    exact = next(press for press in PRESSES if press.name == name)
    tip = [(x * 1e-3, y * 1e-3, -depth * 1e-3) for x, y, depth in exact.path]
    motion = Motion(tuple(tip), tuple(0.1 * index for index in range(len(tip))))
    result = simulate(Scene(indenter, motion), fem)
    force = np.array(exact.forces_n)
    assert len(force) == len(result.force)
    off = np.linalg.norm(result.force - force, axis=1) / np.linalg.norm(force, axis=1)
    known = np.array(exact.uncertainty_percent) / 100
    assert (off < np.array(result.record["error"]["force"]) + known).all()
    return result


@pytest.mark.slow
@pytest.mark.parametrize("fem", [pytest.param(Fem(), marks=SLOW), Fem(fineness=0.4)])
def test_a_sphere_partly_beyond_the_rim_has_getfems_force(fem: Fem) -> None:
    result = _against_getfem("sphere 4 beyond the rim", sphere(4e-3), fem)
    assert result.record["error"]["percent"] < 20
    assert (result.force[:, 0] < 0).all()  # towards the centre of the body
    assert result.record["symmetry"]["percent"] < 0.01


@SLOW
def test_a_shallow_blade_has_getfems_force() -> None:
    result = _against_getfem("blade 0.5 x 12", BLADE, Fem(fineness=0.4))
    assert result.record["error"]["percent"] < 20


AT_A_CORNER = [(at, at) for at in (9e-3, 9.9e-3, 10e-3)]
NARROW = Body(size_x=12e-3, size_y=12e-3, poisson=0.49)


@SLOW
@pytest.mark.parametrize(
    ("scene", "coarse", "fine", "percent"),
    [
        (Scene(sphere(4e-3), press([0.4e-3], at=AT_A_CORNER[0])), 0.5, 0.75, 10),
        (Scene(sphere(4e-3), press([1e-3], at=AT_A_CORNER[1])), 0.75, 1.1, 5),
        (Scene(sphere(4e-3), press([1e-3], at=AT_A_CORNER[2])), 0.75, 1.1, 5),
        (Scene(box(4e-3, 4e-3, 0.5e-3), press([0.3e-3], at=AT_A_CORNER[0])), 0.75, 1.1, 5),
        # It ends at the body's rim, and the skin below flows outwards: both need elements.
        (Scene(plane(), press([0.2e-3]), NARROW, Effects(friction=Friction(0.8))), 1.0, 2.0, 5),
        # As deep as it is thick.
        (Scene(BLADE, press([0.5e-3])), 0.3, 0.4, 30),
    ],
    ids=["sphere", "deep", "deeper", "box", "plate that keeps its volume", "blade"],
)
def test_a_contact_at_a_corner_or_a_rim_or_an_edge_has_a_finer_meshs_force(
    scene: Scene, coarse: float, fine: float, percent: float
) -> None:
    results = [simulate(scene, Fem(fineness=one)) for one in (coarse, fine)]
    first, second = (result.force[-1] for result in results)
    off = float(np.linalg.norm(first - second) / np.linalg.norm(second))
    result, stated = results[0], [float(one.record["error"]["force"][-1]) for one in results]
    assert off < sum(stated)
    elements = [one.record["mesh"]["elements"] for one in results]
    assert elements[1] > 1.5 * elements[0]
    assert result.record["error"]["percent"] < percent
    assert result.quality.overlap.max() < 0.04 * -scene.motion.tip[-1][2]
    if scene.motion.tip[-1][0] > 0:
        assert result.record["symmetry"]["plane"] == "x = y"
    if scene.body is NARROW:  # at a fineness of 3 the force is 2.465 N, at 2 it is 2.476 N
        assert result.force[-1, 2] == pytest.approx(-2.466, rel=stated[0])


def test_the_layer_has_no_sides_and_reports_that_it_has_no_estimate_at_a_corner() -> None:
    scene = Scene(sphere(4e-3), press([1e-3], at=AT_A_CORNER[2]))
    assert simulate(scene, Layer()).record["error"]["status"] == "none"
