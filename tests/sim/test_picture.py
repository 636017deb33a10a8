"""The picture of a result: positions are correct, and colours match the colour bar."""

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
from sim.fem import Fem
from sim.indenters import flat_punch, sphere
from sim.layer import Layer
from sim.plot import abscissa, save_picture, shown_frame, surface_of
from sim.result import Result
from sim.scene import Body, Effects, Friction, Scene, press, through
from sim.tiers import simulate


@pytest.fixture(scope="module")
def pressed() -> Result:
    return simulate(Scene(sphere(4e-3), press([0.5e-3, 1e-3], at=(3e-3, -2e-3))), Layer())


@pytest.fixture(scope="module")
def rubbed() -> Result:
    motion = press([0.8e-3], shear=0.5e-3, steps=2)
    scene = Scene(flat_punch(2e-3, 0.3e-3), motion, effects=Effects(friction=Friction(1.0)))
    return simulate(scene, Layer())


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


def test_the_surface_is_deepest_where_the_tip_is(pressed: Result) -> None:
    surface = surface_of(pressed, 2)
    lowest = np.unravel_index(np.argmin(surface.height), surface.height.shape)
    assert np.broadcast_to(surface.x, surface.height.shape)[lowest] == pytest.approx(3e-3, abs=2e-4)
    assert np.broadcast_to(surface.y, surface.height.shape)[lowest] == pytest.approx(
        -2e-3, abs=2e-4
    )
    assert surface.height.min() == pytest.approx(-1e-3, rel=0.01)
    assert surface.pressure.max() == pytest.approx(pressed_most(pressed), rel=0.02)
    assert surface.pressure.min() == 0


def test_refining_never_draws_beyond_the_values_there_are(pressed: Result) -> None:
    height = surface_of(pressed, 2).height
    rise = pressed.surface[2, :, :, 2]
    assert height.max() <= rise.max() + 1e-9
    assert height.min() >= rise.min() - 1e-9


def test_large_strain_is_drawn_where_the_material_went(pressed: Result) -> None:
    aside = pressed.surface.copy()
    aside[..., 0] += 2e-3
    before = surface_of(replace(pressed, tier="fem"), 2)
    moved = surface_of(replace(pressed, tier="fem", surface=aside), 2)
    np.testing.assert_allclose(moved.x, before.x + 2e-3, atol=1e-9)
    np.testing.assert_array_equal(moved.height, before.height)
    # In the linear tier, undeformed and deformed positions are the same.
    linear = surface_of(replace(pressed, surface=aside), 2)
    np.testing.assert_array_equal(np.ptp(linear.x, axis=1), 0)
    assert linear.x.max() <= 10e-3


def test_beside_a_round_body_there_is_nothing() -> None:
    body = Body(footprint="ellipse")
    surface = surface_of(simulate(Scene(sphere(4e-3), press([0.2e-3]), body), Fem(fineness=0.3)), 1)
    assert np.isnan(surface.height[0, 0])
    assert np.isnan(surface.pressure[-1, 0])
    assert np.isfinite(surface.height[len(surface.height) // 2, 0])


def test_a_dome_is_drawn_with_its_own_height() -> None:
    body = Body(dome_radius=60e-3)
    result = simulate(Scene(sphere(4e-3), press([0.2e-3]), body), Layer())
    surface = surface_of(result, 0, np.array([-6e-3]))
    at = int(np.argmin(np.abs(surface.x - 8e-3)))
    x = float(surface.x[at, 0])
    assert surface.height[at, 0] == pytest.approx(body.height(x, -6e-3), abs=1e-5)


def test_the_maps_show_the_frame_with_the_largest_force(rubbed: Result) -> None:
    assert shown_frame(rubbed) == 4


def test_forces_are_drawn_over_depth_or_with_shear_over_the_path(
    pressed: Result, rubbed: Result
) -> None:
    x, label = abscissa(rubbed)
    assert label == "path of the tip [mm]"
    assert x[-1] == pytest.approx(2.6)
    assert (np.diff(x) > 0).all()
    x, label = abscissa(pressed)
    assert label == "depth [mm]"
    assert x == pytest.approx([0, 0.5, 1])


def test_maps_and_section_show_the_press_where_it_is(
    pressed: Result, drawn: list[Figure], tmp_path: Path
) -> None:
    save_picture(pressed, tmp_path / "press.png")
    assert (tmp_path / "press.png").stat().st_size > 10_000
    height, pressure, section, force, *_bars = drawn[0].axes
    (map_drawn,) = height.collections
    values = np.asarray(map_drawn.get_array())
    corners = np.asarray(map_drawn.get_coordinates())
    lowest = np.unravel_index(np.argmin(values), values.shape)
    assert corners[lowest] == pytest.approx([3, -2], abs=0.2)
    assert corners[[0, -1], [0, -1]] == pytest.approx(np.array([[-10, -10], [10, 10]]), abs=0.2)
    assert pressure.collections[0].get_clim() == pytest.approx((0, 1e-3 * pressed_most(pressed)))
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
    rubbed: Result, drawn: list[Figure], tmp_path: Path
) -> None:
    save_picture(rubbed, tmp_path / "x.png")
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
    scene = Scene(sphere(4e-3), through([(0, 0, 0), (0, 0, 0.5e-3)], speed=0.01))
    save_picture(simulate(scene, Layer()), tmp_path / "x.png")
    height, pressure, *_ = drawn[0].axes
    assert height.collections[0].get_clim() == pytest.approx((-5e-4, 5e-4))
    assert pressure.collections[0].get_clim() == (0, 1e-3)
