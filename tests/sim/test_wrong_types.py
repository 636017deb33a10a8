"""Wrong argument types: errors state name, value and allowed values, without a traceback."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from sim import (
    Body,
    Effects,
    Gravity,
    Motion,
    Scene,
    SceneError,
    Viscosity,
    press,
    simulate,
    simulate_many,
)
from sim.fem import Fem
from sim.indenters import sphere

SCENE = Scene(sphere(4e-3), press([0.5e-3]))
WRONG: dict[str, tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]] = {
    "motion.depths[0]: 0 m; allowed: finite, and another than 0.0 m": (press, ([0],), {}),
    "motion.depths[1]: 0.001 m; allowed: finite, and ano": (press, ([1e-3, 1e-3],), {}),
    "motion.depths[0]: '1' m; allowed": (press, (["1"],), {}),
    "motion.depths[0]: None m; allowed": (press, ([None],), {}),
    "motion.depths[0]: nan m; allowed": (press, ([math.nan],), {}),
    "motion.depths: 0.001; allowed: a sequence of numbers [m]": (press, (1e-3,), {}),
    "motion.depths: '12'; allowed: a sequence": (press, ("12",), {}),
    "motion.at: 3; allowed: a sequence of 2 finite": (press, ([1e-3],), {"at": 3}),
    "motion.at: (0, 'a'); allowed: 2 finite": (press, ([1e-3],), {"at": (0, "a")}),
    "motion.speed: '1' m/s; allowed: above 0": (press, ([1e-3],), {"speed": "1"}),
    "motion.shear: '1' m; allowed": (press, ([1e-3],), {"shear": "1"}),
    "motion.tip: sheared at an angle of None rad": (
        press,
        ([1e-3],),
        {"shear": 1e-3, "angle": None},
    ),
    "motion.hold: '1' s; allowed": (press, ([1e-3],), {"hold": "1"}),
    "motion.tip: 3; allowed: a sequence": (Motion, (3, (0.0,)), {}),
    "motion.tip[0]: 1.0; allowed: a sequence of 3": (Motion, ((1.0,), (0.0,)), {}),
    "motion.tip[0]: (0, 0, '1'); allowed: 3 finite": (Motion, (((0, 0, "1"),), (0.0,)), {}),
    "motion.time: 0; allowed: a sequence": (Motion, (((0, 0, 0),), 0), {}),
    "motion.time: ('0',)...; allowed": (Motion, (((0, 0, 0),), ("0",)), {}),
    "body.thickness: '4e-3' m; allowed": (Body, (), {"thickness": "4e-3"}),
    "effects.friction: 0.5; allowed: a Friction, or None": (Effects, (0.5,), {}),
    "gravity.acceleration: 9.81; allowed: 3 numbers": (Gravity, (9.81,), {}),
    "viscosity.ratios: 0.5; allowed: a tuple": (Viscosity, (0.5, 1.0), {}),
    "scene.indenter: 'sphere'; allowed: an Indenter": (Scene, ("sphere", SCENE.motion), {}),
    "scene.motion: 0.001; allowed: a Motion": (Scene, (SCENE.indenter, 1e-3), {}),
    "scene.body: 4; allowed: a Body": (Scene, (SCENE.indenter, SCENE.motion, 4), {}),
    "scene: 'x'; allowed: a Scene": (simulate, ("x",), {}),
    "scene: 3; allowed: a Scene": (simulate_many, ([3],), {}),
    "tier: 3; allowed: a Layer, a Fem or an Mpm": (simulate, (SCENE, 3), {}),
    "tier: 'fem'; allowed: a Layer, a Fem or an Mpm": (simulate_many, ([SCENE], "fem"), {}),
    "fem.tolerance: '1'; allowed": (Fem, (), {"tolerance": "1"}),
    "fem.halvings: 2.5; allowed: a whole": (Fem, (), {"halvings": 2.5}),
    "fem.graded: 'no'; allowed: True or False": (Fem, (), {"graded": "no"}),
    "fem.grading: 1; allowed: a Grading": (Fem, (), {"grading": 1}),
}


@pytest.mark.parametrize("message", WRONG)
def test_what_is_wrong_is_named_with_its_value_and_what_is_allowed(message: str) -> None:
    call, given, named = WRONG[message]
    with pytest.raises(SceneError) as told:
        call(*given, **named)
    assert str(told.value).startswith(message)
