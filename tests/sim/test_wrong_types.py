"""Wrong argument types: errors state name, value and allowed values, without a traceback."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sim import (
    Body,
    Effects,
    Gravity,
    Motion,
    Scene,
    SceneError,
    Viscosity,
    plan,
    press,
    simulate,
    simulate_many,
)
from sim.fem import Fem
from sim.indenters import named, sphere
from sim.indenters.shapes import cone, extruded, from_stl, torus
from sim.layer import Layer
from sim.scene import through

SCENE = Scene(sphere(4e-3), press([0.5e-3]))
WRONG: dict[str, tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]] = {
    "motion.depths[0]: 0 m; allowed: 0 or more, and another than 0.0 m": (press, ([0],), {}),
    "motion.depths[1]: 0.001 m; allowed: 0 or more, and ano": (press, ([1e-3, 1e-3],), {}),
    "motion.depths[0]: None m; allowed": (press, ([None],), {}),
    "motion.depths: 0.001; allowed: a sequence of numbers [m]": (press, (1e-3,), {}),
    "motion.at: 3; allowed: a sequence of 2 finite": (press, ([1e-3],), {"at": 3}),
    "motion.at: (0, 'a'); allowed: 2 finite": (press, ([1e-3],), {"at": (0, "a")}),
    "motion.speed: '1' m/s; allowed: above 0": (press, ([1e-3],), {"speed": "1"}),
    "motion.shear: '1' m; allowed": (press, ([1e-3],), {"shear": "1"}),
    "motion.angle: 90 rad; allowed: -6.28319 to 6.28319 rad": (press, ([1e-3],), {"angle": 90}),
    "motion.depths[0]: -0.001 m; allowed: 0 or more": (press, ([-1e-3],), {}),
    "motion.steps: 1.5; allowed: whole numbers": (press, ([1e-3],), {"steps": 1.5}),
    "motion.tip: no positions; allowed": (through, ([],), {"speed": 1}),
    "sphere.radius: 4 m; allowed: above 0 to 1 m": (sphere, (4,), {}),
    "sphere.radius: (0.001, 0.002) m; allowed": (sphere, ([1e-3, 2e-3],), {}),
    "torus.ring_radius: 'a' m; allowed": (torus, ("a", 1e-3), {}),
    "cone.half_angle: 45 rad; allowed: 0 to 1.48353 rad": (cone, (45,), {}),
    "part.values: 'a'; allowed: finite numbers": (extruded, ("a",), {}),
    "indenter: ['cone']; allowed: sphere": (named, (["cone"],), {}),
    "indenter sphere.tilt about x: 90 rad; allowed": (SCENE.indenter.tilted, (90, 0), {}),
    "path: 3; allowed: the path of a file": (from_stl, (3,), {}),
    "layer.grid: 'a'; allowed: a whole number": (Layer, ("a",), {}),
    "layer.tolerance: 0.5; allowed": (Layer, (), {"tolerance": 0.5}),
    "scenes: Scene(": (simulate_many, (SCENE,), {}),
    "device: None; allowed: cpu": (simulate, (SCENE,), {"device": None}),
    "device: 'x'; allowed here": (plan, (SCENE, "3 %"), {"device": "x"}),
    "tolerance: 3; allowed": (plan, (SCENE, 3), {}),
    "motion.hold: '1' s; allowed": (press, ([1e-3],), {"hold": "1"}),
    "motion.tip: 3; allowed: a sequence": (Motion, (3, (0.0,)), {}),
    "motion.tip[0]: 1.0; allowed: a sequence of 3": (Motion, ((1.0,), (0.0,)), {}),
    "motion.tip[0]: (0, 0, '1'); allowed: 3 finite": (Motion, (((0, 0, "1"),), (0.0,)), {}),
    "motion.time: 0; allowed: a sequence": (Motion, (((0, 0, 0),), 0), {}),
    "motion.time: ('0',)...; allowed": (Motion, (((0, 0, 0),), ("0",)), {}),
    "body.thickness: '4e-3' m; allowed": (Body, (), {"thickness": "4e-3"}),
    "effects.friction: 0.5; allowed: a Friction, or None": (Effects, (0.5,), {}),
    "gravity.acceleration: 9.81; allowed: 3 numbers": (Gravity, (9.81,), {}),
    "viscosity.ratios: 0.5; allowed: a sequence": (Viscosity, (0.5, 1.0), {}),
    "scene.indenter: 'sphere'; allowed: an Indenter": (Scene, ("sphere", SCENE.motion), {}),
    "scene.motion: 0.001; allowed: a Motion": (Scene, (SCENE.indenter, 1e-3), {}),
    "scene.body: 4; allowed: a Body": (Scene, (SCENE.indenter, SCENE.motion, 4), {}),
    "scene: 'x'; allowed: a Scene": (simulate, ("x",), {}),
    "scene: 3; allowed: a Scene": (simulate_many, ([3],), {}),
    "tier: 3; allowed: a Layer, a Fem or an Mpm": (simulate, (SCENE, 3), {}),
    "fem.tolerance: '1'; allowed": (Fem, (), {"tolerance": "1"}),
    "fem.halvings: 2.5; allowed: a whole": (Fem, (), {"halvings": 2.5}),
    "fem.one_topology: 'no'; allowed: True or False": (Fem, (), {"one_topology": "no"}),
    "fem.grading: 1; allowed: a Grading": (Fem, (), {"grading": 1}),
}


@pytest.mark.parametrize("message", WRONG)
def test_what_is_wrong_is_named_with_its_value_and_what_is_allowed(message: str) -> None:
    call, given, named = WRONG[message]
    with pytest.raises(SceneError) as told:
        call(*given, **named)
    assert str(told.value).startswith(message)


def test_numbers_and_arrays_of_numpy_are_those_of_python() -> None:
    spread: Any = np.ones(1)
    wide: Any = np.array(20e-3)
    depths: Any = np.array([1e-3])
    of_numpy = Scene(
        sphere(np.float64(4e-3)),
        press(depths, at=(np.float64(0), 0.0), steps=int(np.int64(2))),
        Body(size_x=wide),
        Effects(viscosity=Viscosity(spread / 2, spread)),
    )
    assert of_numpy == Scene(
        sphere(4e-3), press((1e-3,), steps=2), effects=Effects(None, Viscosity((0.5,), (1.0,)))
    )
    single: Any = np.float32(0.004)
    assert repr(sphere(single)) == repr(sphere(float(single)))
    hash(of_numpy)
