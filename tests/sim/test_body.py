"""The soft body: invalid values, moduli, shape."""

import math
from dataclasses import fields

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.errors import SceneError
from sim.scene import Body

NUMBERS = [field.name for field in fields(Body)]


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize(
    "value", [math.nan, math.inf, -math.inf, -1.0, True, "4", 1 + 2j], ids=repr
)
def test_every_field_refuses_what_is_no_number_in_its_range(name: str, value: object) -> None:
    with pytest.raises(SceneError, match=rf"^body\.{name}: .*; allowed: "):
        Body(**{name: value})


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("size_x", 1e-4, 1.0),
        ("size_y", 1e-4, 1.0),
        ("thickness", 1e-4, 1.0),
        ("modulus", 1e2, 1e9),
        ("poisson", 0.0, 0.49995),
        ("density", 1.0, 1e5),
    ],
)
def test_ends_of_a_range_are_in_it_and_nothing_beyond(name: str, low: float, high: float) -> None:
    for value in (low, high):
        assert getattr(Body(**{name: value}), name) == value
    for beyond in (math.nextafter(low, -math.inf), math.nextafter(high, math.inf)):
        with pytest.raises(SceneError, match=rf"^body\.{name}: "):
            Body(**{name: beyond})


@given(st.floats(1e2, 1e9), st.floats(0.0, 0.4999))
def test_the_moduli_give_youngs_modulus_and_poissons_ratio_back(
    modulus: float, poisson: float
) -> None:
    body = Body(modulus=modulus, poisson=poisson)
    shear, bulk = body.shear_modulus, body.bulk_modulus
    assert 9 * bulk * shear / (3 * bulk + shear) == pytest.approx(modulus, rel=1e-9)
    ratio = (3 * bulk - 2 * shear) / (2 * (3 * bulk + shear))
    assert ratio == pytest.approx(poisson, abs=1e-9)


@given(st.floats(-10e-3, 10e-3), st.floats(-10e-3, 10e-3))
def test_a_dome_lies_on_its_sphere(x: float, y: float) -> None:
    radius = 60e-3
    height = Body(dome_radius=radius).height(x, y)
    assert math.hypot(x, y, height + radius) == pytest.approx(radius, rel=1e-12)
    assert height <= 0
    assert Body().height(x, y) == 0
