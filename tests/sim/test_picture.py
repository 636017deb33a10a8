"""The picture of a result: positions are correct, and colours match the colour bar."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim.effects import Effects, Friction
from sim.indenters import flat_punch, sphere
from sim.layer import Layer
from sim.plot import (
    PRESSURE,
    abscissa,
    coloured,
    draw_page,
    round_below,
    round_numbers,
    sampled,
    shown_frame,
    surface_of,
)
from sim.result import Result
from sim.scene import Body, Scene, press, press_shear_return
from sim.simulate import simulate


@pytest.fixture(scope="module")
def pressed() -> Result:
    return simulate(Scene(sphere(4e-3), press([0.5e-3, 1e-3], at=(3e-3, -2e-3))), Layer())


def test_the_surface_is_sampled_where_the_tip_is(pressed: Result) -> None:
    seen = sampled(surface_of(pressed, 2), 200)
    row, column = np.unravel_index(np.nanargmin(seen.height), seen.height.shape)
    assert (column + 0.5 - 100) * seen.pixel == pytest.approx(3e-3, abs=2e-4)
    assert (100 - row - 0.5) * seen.pixel == pytest.approx(-2e-3, abs=2e-4)
    assert np.nanmin(seen.height) == pytest.approx(-1e-3, rel=0.01)
    assert np.nanmax(seen.pressure) == pytest.approx(seen.pressure_max, rel=0.02)
    assert np.nanmin(seen.pressure) == 0


def test_refining_never_draws_beyond_the_values_there_are(pressed: Result) -> None:
    seen = sampled(surface_of(pressed, 2), 300)
    rise = pressed.surface[2, :, :, 2]
    assert np.nanmax(seen.height) <= rise.max() + 1e-9
    assert np.nanmin(seen.height) >= rise.min() - 1e-9


def test_large_strain_is_drawn_where_the_material_went(pressed: Result) -> None:
    aside = pressed.surface.copy()
    aside[..., 0] += 2e-3
    moved = replace(pressed, tier="fem", surface=aside)
    middle = -2e-3
    before, _ = surface_of(replace(pressed, tier="fem"), 2).at(3e-3, middle)
    after, _ = surface_of(moved, 2).at(5e-3, middle)
    assert after == pytest.approx(before, abs=2e-6)
    # In the linear tier, undeformed and deformed positions are the same.
    linear, _ = surface_of(replace(moved, tier="layer"), 2).at(3e-3, middle)
    assert linear == pytest.approx(-1e-3, rel=0.01)


def test_every_place_shows_the_point_that_moved_there(pressed: Result) -> None:
    # Locally stretched to 1.8 and compressed to 0.2 times its length.
    x, y = np.meshgrid(pressed.surface_x, pressed.surface_y, indexing="ij")
    wave = 2e-3
    surface = np.zeros_like(pressed.surface)
    surface[2, :, :, 0] = 0.8 * wave * np.sin(x / wave) * np.exp(-((x / 6e-3) ** 8))
    surface[2, :, :, 2] = 0.1 * x + 0.05 * y
    seen = surface_of(replace(pressed, tier="fem", surface=surface), 2)
    rows, columns = slice(30, 98, 7), slice(20, 108, 3)
    place = (x + surface[2, :, :, 0])[columns, rows]
    height, _ = seen.at(place, y[columns, rows])
    np.testing.assert_allclose(height, surface[2, columns, rows, 2], atol=3e-6)


def test_beside_the_body_there_is_nothing(pressed: Result) -> None:
    height, pressure = surface_of(pressed, 2).at(10.5e-3, 0.0)
    assert np.isnan(height)
    assert np.isnan(pressure)


def test_a_dome_is_drawn_with_its_own_height() -> None:
    body = Body(dome_radius=60e-3)
    result = simulate(Scene(sphere(4e-3), press([0.2e-3]), body), Layer())
    height, _ = surface_of(result, 0).at(8e-3, -6e-3)
    assert height == pytest.approx(body.height(8e-3, -6e-3), abs=1e-5)


def test_the_maps_show_the_frame_with_the_largest_force() -> None:
    motion = press_shear_return(0.8e-3, 0.5e-3, steps=2)
    scene = Scene(flat_punch(2e-3, 0.3e-3), motion, effects=Effects(friction=Friction(1.0)))
    result = simulate(scene, Layer())
    assert shown_frame(result) == 4
    x, label = abscissa(result)
    assert label == "path of the tip [mm]"
    assert x[-1] == pytest.approx(2.6)
    assert (np.diff(x) > 0).all()


def test_the_force_of_a_press_is_drawn_over_depth(pressed: Result) -> None:
    x, label = abscissa(pressed)
    assert label == "depth [mm]"
    assert x == pytest.approx([0, 0.5, 1])


def test_a_surface_that_nothing_touches_is_drawn_too() -> None:
    page = draw_page(simulate(Scene(sphere(4e-3), press([-0.5e-3])), Layer()))
    assert page.size[0] == 1160


def test_colours_of_pressure_run_from_paper_to_the_darkest() -> None:
    shades = coloured(np.array([0.0, 0.5, 1.0, np.nan]), PRESSURE)
    assert shades[0] == pytest.approx(PRESSURE[0])
    assert shades[1] == pytest.approx(PRESSURE[2])
    assert shades[2] == pytest.approx(PRESSURE[-1])
    assert shades[3] == pytest.approx(PRESSURE[0])
    darkness = coloured(np.linspace(0, 1, 50), PRESSURE) @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(darkness) < 0).all()


@pytest.mark.parametrize(
    ("value", "below"), [(1.0, 1.0), (6.0, 5.0), (19.9, 10.0), (0.31, 0.2), (0.02, 0.02)]
)
def test_scale_bars_have_round_lengths(value: float, below: float) -> None:
    assert round_below(value) == pytest.approx(below)


def test_scales_are_ticked_at_round_numbers_within_their_limits() -> None:
    assert round_numbers(-1.53, 0.06, 7) == pytest.approx(
        [-1.4, -1.2, -1, -0.8, -0.6, -0.4, -0.2, 0]
    )
    assert round_numbers(0.0, 0.0, 7) == [0.0]
