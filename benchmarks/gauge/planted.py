"""Planted sensors of a group, which differ from their rows, and their twins."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.twin.planted import GAUGE, Bench, Truth, observed, random_skin, usual
from recorder.processes import cores
from recorder.settings import yaml_text
from recorder.store import replace_file
from sim.dataset.plan import Solving
from sim.errors import SimulationDiverged
from sim.fem import Fem, further_settings
from sim.result import ContactTier
from sim.sensors import CameraSignal, SimulatedSensor, sensor
from sim.sensors.quantities import quantities, with_quantities
from sim.sensors.sensor import read_sensor
from sim.twin import PressTrack, fitted
from sim.twin.record import skin_row, twin_yaml

GROUPS = {
    "kinds": ("gelsight", "tacpalm", "uskin"),
    "skins": ("r6", "r10", "r18"),
    "patterns": ("array-i", "circle-ii", "diamond-i"),
}
# The design whose skin all sensors of a group have; other groups have a skin for each sensor.
ONE_SKIN = {"patterns": "array-i"}
# Errors of mounting and seeing, those of segmentation as in rows of the homogeneous group.
MOUNTED = {
    "mount": {"shift_mm": 0.3, "turn_deg": 1.5, "height_um": 30.0},
    "grip": {"tilt_deg": 1.0},
}
SEEN = {
    "framing": {"shift_px": 4.0, "turn_deg": 0.5},
    "drift": {"step_um": 6.0},
    "segmentation": {
        "jitter_px": 0.3,
        "correlation_px": 4.0,
        "missing": 0.002,
        "rim_px": 12.0,
        "rim_missing": 0.02,
    },
}
# Quantities of twins whose errors are shown.
COMPARED = ("modulus", "thickness", "poisson", "friction")
# Seeds of the sensors, and of the draws of mounting in archives.
SEED, ARCHIVE_SEED = 0, 0


@dataclass(frozen=True, slots=True)
class Planted:
    """A planted sensor: its row, the design that it differs from, and the errors of its gauge."""

    design: str
    row: SimulatedSensor
    bench: Bench


def planted(folder: Path, group: str, design: str) -> Planted:
    """Write the row of a planted sensor into a folder, and return it as it was written."""
    values, bench = _drawn(group, design)
    made = with_quantities(sensor(design), values)
    content = {
        "extends": f"{design}.yaml",
        "description": f"{design} with a skin and mounting of its own",
        **skin_row(made),
        "variation": {**MOUNTED, **(SEEN if isinstance(made.signal, CameraSignal) else {})},
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{design}-planted.yaml"
    replace_file(path, yaml_text(content).encode())
    row = read_sensor(path)
    assert row.variation.mount is not None
    placed = row.variation.mount.drawn(ARCHIVE_SEED, row.name)
    moved = (-placed.shift_x, -placed.shift_y)
    return Planted(design, row, replace(bench, height=placed.height, place=moved))


def _drawn(group: str, design: str) -> tuple[Mapping[str, float], Bench]:
    """Return the quantities of a sensor's skin, and the errors of its bench."""
    skin = ONE_SKIN.get(group, design)
    of_group = [SEED, [*GROUPS].index(group)]
    of_skin = np.random.default_rng([*of_group, GROUPS[group].index(skin)])
    own = np.random.default_rng([*of_group, GROUPS[group].index(design), 1])
    return quantities(random_skin(of_skin, skin)[0]), random_skin(own, design)[1]


def twin_of(each: Planted, truth: Truth, fit: ContactTier, grid: int) -> dict[str, Any]:
    """Press a planted sensor with a gauge, fit its twin from its design, and return the twin's row.

    With the errors of its quantities, relative but for Poisson's ratio and the surface's height
    [m], and its misfit. True forces by `fem` are solved on meshes as in archives; `grid` is the
    number of pixels of the fit.

    Raises:
        SimulationDiverged: A press has no solution.
    """
    tracks = [_observed(each, number, truth) for number in range(len(GAUGE))]
    how: dict[str, Any] = {"tier": fit, "grid": grid, "device": truth.device}
    twin = fitted(tracks, sensor(each.design), **how, processes=cores())
    true, values = quantities(each.row), quantities(twin.sensor)
    errors = {name: values[name] - true[name] for name in COMPARED}
    errors |= {name: errors[name] / true[name] for name in COMPARED if name != "poisson"}
    errors |= {"height": twin.values["height"] - each.bench.height, "misfit": twin.misfit}
    return {"row": twin_yaml(twin.sensor, f"{each.design}.yaml", GAUGE), "errors": errors}


def _observed(each: Planted, number: int, truth: Truth) -> PressTrack:
    """Return the track of a press by the settings of archives, or those for what they miss."""
    first, presses = Solving().settings(each.row.body), usual(GAUGE[number], each.design)
    assert isinstance(first, Fem)
    *some, last = first, *(fem for _, fem, _ in further_settings(first, each.row.body))
    for fem in some:
        with suppress(SimulationDiverged):
            return observed(each.row, presses, each.bench, number, replace(truth, fem=fem))
    return observed(each.row, presses, each.bench, number, replace(truth, fem=last))
