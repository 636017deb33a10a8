"""The picture of a result: positions are correct, and colours match the colour bar."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from recorder.charts import chart
from sim import plot
from sim.effects import Effects, Friction
from sim.indenters import flat_punch, sphere
from sim.layer import Layer
from sim.plot import abscissa, sampled, save_picture, shown_frame, surface_of
from sim.result import Result
from sim.scene import Body, Scene, press
from sim.simulate import simulate


@pytest.fixture(scope="module")
def pressed() -> Result:
    return simulate(Scene(sphere(4e-3), press([0.5e-3, 1e-3], at=(3e-3, -2e-3))), Layer())


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are drawn."""
    figures: list[Figure] = []

    @contextmanager
    def kept(*arguments: Any) -> Iterator[Figure]:
        with chart(*arguments) as figure:
            figures.append(figure)
            yield figure

    monkeypatch.setattr(plot, "chart", kept)
    return figures


def test_the_surface_is_sampled_where_the_tip_is(pressed: Result) -> None:
    surface = surface_of(pressed, 2)
    height, pressure = sampled(surface, 200)
    assert height.shape == (200, 200)
    cell = 2 * surface.half_x / 200
    row, column = np.unravel_index(np.nanargmin(height), height.shape)
    assert (column + 0.5 - 100) * cell == pytest.approx(3e-3, abs=2e-4)
    assert (row + 0.5 - 100) * cell == pytest.approx(-2e-3, abs=2e-4)
    assert np.nanmin(height) == pytest.approx(-1e-3, rel=0.01)
    assert np.nanmax(pressure) == pytest.approx(surface.pressure_max, rel=0.02)
    assert np.nanmin(pressure) == 0


def test_refining_never_draws_beyond_the_values_there_are(pressed: Result) -> None:
    height, _ = sampled(surface_of(pressed, 2), 300)
    rise = pressed.surface[2, :, :, 2]
    assert np.nanmax(height) <= rise.max() + 1e-9
    assert np.nanmin(height) >= rise.min() - 1e-9


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
    motion = press([0.8e-3], shear=0.5e-3, steps=2)
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


def test_maps_and_section_show_the_press_where_it_is(
    pressed: Result, drawn: list[Figure], tmp_path: Path
) -> None:
    save_picture(pressed, tmp_path / "press.png")
    assert (tmp_path / "press.png").stat().st_size > 10_000
    height, pressure, section, force, *_bars = drawn[0].axes
    (map_drawn,) = height.images
    values = np.asarray(map_drawn.get_array())
    assert map_drawn.get_extent() == pytest.approx((-10, 10, -10, 10))
    assert map_drawn.origin == "lower"
    row, column = np.unravel_index(np.argmin(values), values.shape)
    assert 20 * (column + 0.5) / values.shape[1] - 10 == pytest.approx(3, abs=0.2)
    assert 20 * (row + 0.5) / values.shape[0] - 10 == pytest.approx(-2, abs=0.2)
    assert pressure.images[0].get_clim() == pytest.approx((0, 1e-3 * pressed_most(pressed)))
    x, z = section.lines[0].get_data()
    assert np.min(z) == pytest.approx(-1, abs=0.02)
    assert x[np.argmin(z)] == pytest.approx(3, abs=0.3)
    assert section.get_aspect() == 1
    assert [line.get_label() for line in force.lines] == ["normal"]
    assert force.lines[0].get_ydata()[-1] == pytest.approx(-pressed.force[2, 2])


def pressed_most(result: Result) -> float:
    return float(np.nanmax(-result.traction[2, :, :, 2]))


@pytest.mark.slow
def test_every_axis_has_its_unit_and_shear_its_own_curve(
    drawn: list[Figure], tmp_path: Path
) -> None:
    motion = press([0.8e-3], shear=0.5e-3, steps=2)
    scene = Scene(flat_punch(2e-3, 0.3e-3), motion, effects=Effects(friction=Friction(1.0)))
    save_picture(simulate(scene, Layer()), tmp_path / "x.png")
    axes = drawn[0].axes[:4]
    labels = [(one.get_xlabel(), one.get_ylabel()) for one in axes]
    assert labels[:2] == [("x [mm]", "y [mm]")] * 2
    assert labels[2:] == [("x [mm]", "z [mm]"), ("path of the tip [mm]", "force [N]")]
    assert [one.get_title(loc="left") for one in axes[:2]] == [
        "height [mm]",
        "contact pressure [kPa]",
    ]
    assert [line.get_label() for line in axes[3].lines] == ["normal", "shear"]
    assert axes[3].lines[1].get_ydata().max() > 0


def test_a_surface_that_nothing_touches_is_drawn_too(drawn: list[Figure], tmp_path: Path) -> None:
    scene = Scene(sphere(4e-3), press([-0.5e-3]))
    save_picture(simulate(scene, Layer()), tmp_path / "x.png")
    height, pressure, *_ = drawn[0].axes
    assert height.images[0].get_clim() == pytest.approx((-5e-4, 5e-4))
    assert pressure.images[0].get_clim() == (0, 1e-3)
