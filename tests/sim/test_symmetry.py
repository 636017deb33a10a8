"""Consequences of a scene's symmetry, and the resulting error estimate."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import stl_files as files

from sim import Body, Effects, Friction, Motion, Result, Scene, press, simulate
from sim.error_estimate import PLANES, asymmetry, planes_of, vanishing_share, with_estimate
from sim.fem import Fem
from sim.indenters import Indenter, box, flat_punch, from_stl, named, plane, sphere
from sim.metrics import tolerance_of
from sim.scene import Gravity
from sim.tolerance import extrapolated

SMALL = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
PRESS = press([0.5e-3])
ALL = set(PLANES)


@pytest.mark.parametrize(
    ("indenter", "planes"),
    [
        (sphere(4e-3), ALL),
        (plane(), ALL),
        (named("dotin"), ALL),
        (named("prism"), {"x = 0", "y = 0"}),
        (named("hexagon"), {"x = 0", "y = 0"}),
        (named("moon"), {"y = 0"}),
        (named("dots"), {"y = 0"}),
        (named("wave"), {"y = 0"}),
        (named("random"), set()),
        (box(4e-3, 3e-3, 0.3e-3).tilted(0.0, 0.1), {"y = 0"}),
        (box(4e-3, 3e-3, 0.3e-3).tilted(0.1, 0.0), {"x = 0"}),
        (flat_punch(3e-3, 0.3e-3).tilted(0.1, 0.1), {"x = -y"}),
        # A tilted sphere is rotated about its tip: its lowest point is then off its centre.
        (sphere(4e-3).tilted(0.1, 0.1), {"x = -y"}),
    ],
    ids=lambda value: f"{value.name} {value.tilt}" if isinstance(value, Indenter) else "",
)
def test_an_indenters_planes_are_those_of_its_surface(indenter: Indenter, planes: set[str]) -> None:
    assert set(planes_of(Scene(indenter, PRESS))) == planes


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_a_body_from_a_file_is_symmetric_where_its_surface_is(tmp_path: Path, shift: float) -> None:
    corners, faces = files.block(4, 6, 8)
    file = files.write_binary(tmp_path / "block.stl", (np.add(corners, [shift, 0, 0]), faces))
    scene = Scene(from_stl(file, axis="file"), PRESS)
    assert set(planes_of(scene)) == ({"x = 0", "y = 0"} if shift == 0 else {"y = 0"})


def test_a_difference_is_as_large_as_the_part_that_makes_it() -> None:
    """The moon's hollow is 0.8 mm from its side, its back 3.5 mm from the axis."""
    assert asymmetry(named("moon"), PLANES["y = 0"], 1e-3, 20e-3) < 1e-12
    assert asymmetry(named("moon"), PLANES["x = 0"], 1e-3, 20e-3) > 1e-3


@pytest.mark.parametrize(
    ("scene", "planes"),
    [
        (Scene(sphere(3e-3), press([0.5e-3], at=(1e-3, 0.0))), {"y = 0"}),
        (Scene(sphere(3e-3), press([0.5e-3], at=(0.0, 1e-3))), {"x = 0"}),
        (Scene(sphere(3e-3), press([0.5e-3], at=(1e-3, 1e-3))), {"x = y"}),
        (Scene(sphere(3e-3), press([0.5e-3], at=(1e-3, 1e-6))), set()),
        (Scene(sphere(3e-3), press([0.5e-3]), Body(size_x=9e-3, size_y=8e-3)), {"x = 0", "y = 0"}),
        (Scene(sphere(3e-3), press([0.5e-3], shear=1e-3, angle=math.pi / 2, steps=5)), {"x = 0"}),
        (Scene(sphere(3e-3), press([0.5e-3], shear=1e-3, angle=0.3, steps=5)), set()),
        (Scene(sphere(3e-3), PRESS, effects=Effects(gravity=Gravity((0.0, 9.8, 0.0)))), {"x = 0"}),
        (Scene(sphere(3e-3), Motion(((0.0, 0.0, 1e-3),), (0.0,))), set()),
    ],
)
def test_a_scenes_planes_hold_its_body_motion_and_gravity(scene: Scene, planes: set[str]) -> None:
    assert set(planes_of(scene)) == planes


def _pushed(force: tuple[float, float, float]) -> Result:
    """Return a press along y = 0 with a different force, and no error estimate yet."""
    motion = press([0.4e-3, 0.3e-3], at=(1e-3, 0.0))
    result = simulate(Scene(sphere(3e-3), motion, SMALL), Fem(spacing=4e-3 / 4))
    wrench = result.wrench.copy()
    wrench[1, :3] = force
    record = {name: one for name, one in result.record.items() if name != "error"}
    return replace(result, wrench=wrench, record=record)


def test_a_force_that_symmetry_forbids_is_part_of_the_error_and_worth_a_warning() -> None:
    wrong = with_estimate(_pushed((0.0, 0.3, -0.4)))
    assert vanishing_share(wrong) == pytest.approx([0.0, 0.6, 0.0], abs=1e-5)
    assert wrong.record["symmetry"]["plane"] == "y = 0"
    assert wrong.record["symmetry"]["vanishing_force_newton"] == pytest.approx(0.3)
    assert wrong.record["symmetry"]["percent"] == pytest.approx(60)
    assert wrong.record["error"]["percent"] == pytest.approx(60)
    assert wrong.record["error"]["force"][2] < 0.3
    assert "60 % of the force is across it" in wrong.record["warnings"][-1]
    # Along the plane, a force is not an error.
    right = with_estimate(_pushed((0.3, 0.0, -0.4)))
    assert right.record["error"]["percent"] < 30
    assert not [one for one in right.record["warnings"] if "across" in one]


def test_a_force_across_gravity_is_forbidden_beyond_the_weight() -> None:
    pulled = _pushed((0.0, 0.3, -0.4))
    scene = replace(pulled.scene, effects=Effects(gravity=Gravity((0.0, 9.81, 0.0))))
    explained = 3 * 1070 * 8e-3 * 8e-3 * 4e-3 * 9.81
    found = with_estimate(replace(pulled, scene=scene))
    assert vanishing_share(found)[1] == pytest.approx((0.3 - explained) / 0.5)
    assert found.record["error"]["percent"] == pytest.approx(100 * (0.3 - explained) / 0.5)
    assert "that gravity does not explain" in found.record["warnings"][-1]
    # A stronger pull explains it.
    strong = replace(scene, effects=Effects(gravity=Gravity((0.0, 400.0, 0.0))))
    found = with_estimate(replace(pulled, scene=strong))
    assert vanishing_share(found)[1] == 0
    assert not [one for one in found.record["warnings"] if "gravity" in one]


def test_a_motion_that_leaves_a_plane_states_the_forces_across_it_before() -> None:
    motion = Motion(((0.0, 0.0, -0.4e-3), (0.0, 0.1e-3, -0.4e-3)), (0.0, 0.1))
    result = simulate(Scene(sphere(3e-3), motion, SMALL), Fem(spacing=4e-3 / 3))
    wrench = result.wrench.copy()
    wrench[:, :3] = [[0.0, 0.1, -1.0], [0.0, 0.3, -0.4]]
    assert vanishing_share(replace(result, wrench=wrench)) == pytest.approx(
        [0.1 / math.hypot(0.1, 1.0), 0.1 / 0.5], rel=1e-3
    )


def test_forces_of_two_meshes_say_what_symmetry_forbids_of_them() -> None:
    numerics = Fem(fineness=0.8), Fem(fineness=0.5)
    fine, coarse = (simulate(Scene(sphere(3e-3), PRESS, SMALL), one) for one in numerics)
    assert fine.record["symmetry"]["percent"] < 1e-3
    wrench = coarse.wrench.copy()
    wrench[1, 1] -= 0.1
    wanted = tolerance_of("5 %")
    found, _error = extrapolated(replace(coarse, wrench=wrench), fine, wanted, floor=1e-3)
    assert found.wrench[1, 1] > 0.05
    fraction = found.record["symmetry"]["percent"]
    assert fraction == pytest.approx(100 * found.wrench[1, 1] / np.linalg.norm(found.force[1]))
    assert found.record["error"]["percent"] >= fraction
    assert "across it" in found.record["warnings"][-1]


@pytest.mark.parametrize("angle", [0.0, math.pi / 2])
def test_a_shear_in_a_plane_stays_in_it(angle: float) -> None:
    """In float64: in float32 rounding decides whether one of two mirrored points just touches."""
    motion = Motion(
        ((0.0, 0.0, -0.4e-3), (0.2e-3 * math.cos(angle), 0.2e-3 * math.sin(angle), -0.4e-3)),
        (0.0, 0.1),
    )
    scene = Scene(sphere(3e-3), motion, SMALL, Effects(friction=Friction(0.5)))
    result = simulate(scene, Fem(spacing=4e-3 / 3, precision="float64"))
    assert result.record["symmetry"]["plane"] == ("y = 0" if angle == 0 else "x = 0")
    assert result.record["symmetry"]["percent"] < 0.05
    torque = result.record["symmetry"]["vanishing_torque_newton_metre"]
    assert torque < 1e-3 * np.abs(result.wrench[:, 3:]).max()
    assert np.abs(result.wrench[-1, 3:]).max() > 1e-6
