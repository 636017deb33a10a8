"""The fit of the sensors' parameters, the sheet of pictures and the benchmark, on the fast tier."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.twin.picture import COLUMNS, Tile, outlined, sheet
from benchmarks.twin.relaxation import hysteresis, relaxed
from benchmarks.twin.rows import (
    COUNTS_NORMAL,
    COUNTS_SHEAR,
    FORCES,
    LOSS,
    Line,
    fit_forces,
    fit_gains,
    prism_press,
    prism_shear,
)
from benchmarks.twin.timing import stages
from sim.layer import Layer
from sim.scene import Viscosity
from sim.sensors import SimulatedSensor, TaxelSignal, sensor
from sim.sensors.field import SurfaceField
from sim.sensors.taxels import TaxelPad
from sim.tiers import simulate


def fitted(sensors: dict[str, SimulatedSensor]) -> list[Line]:
    return fit_forces(
        sensors, {name: simulate(prism_press(each), Layer()) for name, each in sensors.items()}
    )


def with_found(each: SimulatedSensor, lines: list[Line]) -> SimulatedSensor:
    """Return the sensor with the parameters fitted for it."""
    mine = {line.name: line.found for line in lines if line.name.startswith(each.name)}
    ratios = tuple(value for name, value in mine.items() if "ratio" in name)
    viscosity = each.effects.viscosity
    assert viscosity is not None
    return replace(
        each,
        body=replace(each.body, modulus=1e3 * mine[f"{each.name}: modulus [kPa]"]),
        effects=replace(each.effects, viscosity=Viscosity(ratios, viscosity.times)),
    )


@pytest.mark.slow
def test_what_was_fitted_is_found_again_and_keeps_force_and_loss() -> None:
    sensors = {name: sensor(name) for name in FORCES}
    first = fitted(sensors)
    sensors = {name: with_found(each, first) for name, each in sensors.items()}
    again = fitted(sensors)
    assert all(line.agrees for line in again)
    peaks = {}
    for name, each in sensors.items():
        result, viscosity = simulate(prism_press(each), Layer()), each.effects.viscosity
        assert viscosity is not None
        depth = -np.array(result.scene.motion.tip)[:, 2]
        cycle = relaxed(depth, -result.force[:, 2], viscosity, speed=each.speed)
        assert hysteresis(*cycle) == pytest.approx(LOSS[name], abs=1e-3)
        peaks[name] = cycle[1].max()
    parts = [peaks[name] / peaks["tacpalm"] for name in FORCES]
    np.testing.assert_allclose(parts, [4, 2, 1], rtol=1e-3)


def test_fitted_gains_give_the_wanted_counts() -> None:
    pad = sensor("uskin")
    assert isinstance(pad.signal, TaxelSignal)
    results = [simulate(prism_shear(pad, point), Layer()) for point in (1, 2)]
    normal, shear = (1e3 * line.found for line in fit_gains(pad, results))
    taxels = TaxelPad(pad.body, replace(pad.signal, gain_normal=normal, gain_shear=shear))
    counts = np.concatenate([taxels.counts(SurfaceField.of(result)) for result in results])
    assert counts[..., 2].max() == pytest.approx(COUNTS_NORMAL, abs=1)
    assert np.abs(counts[..., :2]).max() == pytest.approx(COUNTS_SHEAR, abs=1)


def test_a_row_that_is_off_by_more_than_a_percent_is_told() -> None:
    assert Line("a", 1.0, 1.009).agrees
    assert not Line("a", 1.0, 1.02).agrees


def test_the_sheet_has_a_tile_for_each_picture() -> None:
    mask, no_contact = np.zeros((2, 480, 640), bool)
    mask[100:110, 100:110] = True
    no_contact[200:220, 200:220] = True
    pixels = outlined(mask, no_contact)
    assert (pixels[105, 105] > 230).all()
    assert pixels[200, 210].tolist() == pixels[219, 210].tolist() != pixels[210, 210].tolist()
    page = sheet([Tile("a", "b", pixels)] * (COLUMNS + 1))
    rows = page.height / sheet([Tile("a", "b", pixels)]).height
    assert 1.8 < rows < 2


@pytest.mark.slow
def test_every_stage_of_the_bench_runs() -> None:
    shapes = {name: np.shape(work()) for name, work in stages(2, "cpu")}
    assert len(shapes) == 9
    assert {shape[0] for shape in shapes.values()} == {2}
