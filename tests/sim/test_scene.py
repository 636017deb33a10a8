"""Scenes: frozen values that reject unsolvable input; effects and their flags."""

import math
from dataclasses import FrozenInstanceError

import pytest

from sim.errors import SceneError
from sim.indenters import sphere
from sim.layer import Layer
from sim.scene import Body, Effects, Friction, Gravity, Inertia, Scene, Viscosity, press
from sim.tiers import simulate_many


def test_a_scene_is_a_value() -> None:
    first, second = (
        Scene(sphere(4e-3), press([1e-3]), effects=Effects(friction=Friction(0.5)))
        for _ in range(2)
    )
    assert first == second
    assert hash(first) == hash(second)
    with pytest.raises(FrozenInstanceError):
        first.body = Body()


def test_a_scene_without_a_body_has_the_papers_gel() -> None:
    body = Scene(sphere(4e-3), press([1e-3])).body
    assert (body.size_x, body.size_y, body.thickness) == (20e-3, 20e-3, 4e-3)
    assert (body.modulus, body.poisson) == (0.145e6, 0.45)


def test_a_press_through_the_base_is_refused_and_units_are_asked_for() -> None:
    assert Scene(sphere(4e-3), press([3.6e-3])).motion.depth_max == 3.6e-3
    with pytest.raises(SceneError, match=r"^motion: 3\.61 mm deep .* up to 3\.6 mm .*metres\?"):
        Scene(sphere(4e-3), press([1e-3, 3.61e-3, 2e-3]))
    with pytest.raises(SceneError, match=r"are the units metres\?"):
        Scene(sphere(4e-3), press([1.5]))


def test_effects_are_named_in_one_order_however_they_were_given() -> None:
    everything = Effects(
        gravity=Gravity(),
        inertia=Inertia(),
        viscosity=Viscosity((1.0,), (1.0,)),
        friction=Friction(1),
    )
    assert everything.key == ("friction", "viscosity", "inertia", "gravity")
    assert Effects(gravity=Gravity(), friction=Friction(0.0)).key == ("friction", "gravity")
    assert Effects().key == ()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e9, "1", None], ids=repr)
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Friction, r"^friction\.coefficient: "),
        (Inertia, r"^inertia\.scale: "),
        (lambda value: Gravity((0.0, value, 0.0)), r"^gravity\.acceleration\[1\]: "),
        (lambda value: Viscosity((1.0, value), (1.0, 2.0)), r"^viscosity\.ratios\[1\]: "),
        (lambda value: Viscosity((1.0, 1.0), (value, 2.0)), r"^viscosity\.times\[0\]: "),
    ],
    ids=["friction", "inertia", "gravity", "ratios", "times"],
)
def test_every_number_of_an_effect_is_checked(make: object, value: object, message: str) -> None:
    with pytest.raises(SceneError, match=message + r".*; allowed: "):
        make(value)


def test_many_scenes_give_many_results_in_their_order() -> None:
    scenes = [Scene(sphere(4e-3), press([depth])) for depth in (0.4e-3, 0.1e-3, 0.2e-3)]
    fractions: list[float] = []
    results = simulate_many(scenes, Layer(), progress=fractions.append)
    assert [result.scene for result in results] == scenes
    forces = [-result.force[-1, 2] for result in results]
    assert forces[1] < forces[2] < forces[0]
    # Hertz' exponent is a lower bound: a bonded layer stiffens faster.
    assert forces[0] / forces[2] > 2**1.5
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1
    assert simulate_many([], Layer()) == []
