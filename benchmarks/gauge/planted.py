"""Planted sensors of a group, which differ from their rows, and their twins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.twin.planted import Bench, Forces, observed, random_skin, solved, usual
from recorder.settings import yaml_text
from recorder.store import replace_file
from sim.dataset.plan import Solving
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem, further_settings
from sim.result import ContactTier
from sim.sensors import CameraSignal, SimulatedSensor, sensor
from sim.sensors.quantities import quantities, with_quantities
from sim.sensors.sensor import read_sensor
from sim.twin import fitted
from sim.twin.plan import PlannedPresses
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
# Sensors differ if a quantity of their skins does by this fraction, or their mounting by this [m].
APART, MOUNTED_APART = 0.03, 10e-6
# Indenters that identify a twin: each is pressed to two depths, sheared and held.
GAUGE = ("sphere", "prism")
# First of the two depths over the deepest of the row: a thick pad is pressed less deep.
PART, PARTS = 0.4, {"tacpalm": 0.24}
# Quantities of twins whose errors are shown.
COMPARED = ("modulus", "thickness", "poisson", "friction")
# Seed of the draws of mounting in archives.
ARCHIVE_SEED = 0


@dataclass(frozen=True, slots=True)
class Planted:
    """A planted sensor: its row, the design that it differs from, and the errors of its gauge."""

    design: str
    row: SimulatedSensor
    bench: Bench


def name_of(design: str) -> str:
    """Return the name of the planted sensor of a design."""
    return f"{design}-planted"


def write_rows(folder: Path, group: str, designs: Sequence[str], seed: int) -> None:
    """Write the rows of a group's planted sensors, and check that they differ.

    Raises:
        SceneError: Two sensors do not differ.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for design in designs:
        text = _row(group, design, seed)
        replace_file(folder / f"{name_of(design)}.yaml", text.encode())
    require_apart([planted(folder, group, design, seed).row for design in designs])


def planted(folder: Path, group: str, design: str, seed: int) -> Planted:
    """Return a planted sensor, as it was written."""
    row = read_sensor(folder / f"{name_of(design)}.yaml")
    _, bench = _drawn(group, design, seed)
    assert row.variation.mount is not None
    placed = row.variation.mount.drawn(ARCHIVE_SEED, row.name)
    moved = (-placed.shift_x, -placed.shift_y)
    return Planted(design, row, replace(bench, height=placed.height, place=moved))


def require_apart(rows: Sequence[SimulatedSensor]) -> None:
    """Check that no two sensors have the same skin and mounting.

    Raises:
        SceneError: Two do.
    """
    for one, other in combinations(rows, 2):
        values, others = quantities(one), quantities(other)
        skins = max(abs(values[name] / others[name] - 1) for name in values)
        places = [
            np.array([placed.shift_x, placed.shift_y, placed.height])
            for each in (one, other)
            if each.variation.mount is not None
            for placed in (each.variation.mount.drawn(ARCHIVE_SEED, each.name),)
        ]
        mounts = float(np.ptp(places, axis=0).max()) if len(places) == 2 else 0.0
        if skins < APART and mounts < MOUNTED_APART:
            raise SceneError(
                f"{one.name}, {other.name}: skins differ by {100 * skins:.1f} % and mounts by "
                f"{1e6 * mounts:.0f} um; allowed: {100 * APART:.0f} % or more, or "
                f"{1e6 * MOUNTED_APART:.0f} um or more"
            )


def _drawn(group: str, design: str, seed: int) -> tuple[Mapping[str, float], Bench]:
    """Return the quantities of a sensor's skin, and the errors of its bench."""
    skin = ONE_SKIN.get(group, design)
    of_skin = [seed, [*GROUPS].index(group), [*GROUPS[group]].index(skin)]
    drawn, _ = random_skin(np.random.default_rng(of_skin), skin)
    own = [seed, [*GROUPS].index(group), GROUPS[group].index(design), 1]
    _, bench = random_skin(np.random.default_rng(own), design)
    return quantities(drawn), bench


def _row(group: str, design: str, seed: int) -> str:
    values, _ = _drawn(group, design, seed)
    made = with_quantities(sensor(design), values)
    content = {
        "extends": f"{design}.yaml",
        "description": f"{design} with a skin and mounting of its own",
        **skin_row(made),
        "variation": _variation(made),
    }
    return yaml_text(content)


def _variation(each: SimulatedSensor) -> Mapping[str, Any]:
    """Return the errors that a sensor may have."""
    return {**MOUNTED, **(SEEN if isinstance(each.signal, CameraSignal) else {})}


def write_twin(
    each: Planted,
    out: Path,
    *,
    truth: ContactTier,
    fit: ContactTier,
    grid: int,
    device: str,
    processes: int,
) -> dict[str, float]:
    """Press a planted sensor with a gauge, fit its twin from its design, and write the twin's row.

    Return the errors of its quantities, relative but for Poisson's ratio and the surface's height
    [m], and its misfit.

    Args:
        each: The sensor.
        out: Row to write.
        truth: Tier of the true forces; by `fem` on meshes as in archives.
        fit: Tier of the fit.
        grid: Pixels of the fit; true forces by `layer` have twice as many.
        device: Device of tier `fem`.
        processes: Processes of the fit.

    Raises:
        SimulationDiverged: A press has no solution.
    """
    tracks = []
    for number, indenter in enumerate(GAUGE):
        presses = usual(indenter, each.design, PARTS.get(each.design, PART))
        forces = _solved(each, presses, truth=truth, grid=2 * grid, device=device)
        tracks.append(observed(each.row, presses, each.bench, number, forces=forces))
    how: dict[str, Any] = {"tier": fit, "grid": grid, "device": device, "processes": processes}
    twin = fitted(tracks, sensor(each.design), **how)
    out.parent.mkdir(parents=True, exist_ok=True)
    replace_file(out, twin_yaml(twin.sensor, f"{each.design}.yaml", GAUGE).encode())
    true, values = quantities(each.row), quantities(twin.sensor)
    errors = {name: values[name] - true[name] for name in COMPARED}
    errors |= {name: errors[name] / true[name] for name in COMPARED if name != "poisson"}
    height = twin.values["height"] - each.bench.height
    return {**errors, "height": height, "misfit": twin.misfit}


def _solved(each: Planted, presses: PlannedPresses, **how: Any) -> Forces:
    """Return forces by the settings of archives, or those for what has no solution by them."""
    first = Solving().settings(each.row.body)
    assert isinstance(first, Fem)
    *some, last = first, *(fem for _, fem, _ in further_settings(first, each.row.body))
    for fem in some:
        try:
            return solved(each.row, presses, each.bench, fem=fem, **how)
        except SimulationDiverged:
            continue
    return solved(each.row, presses, each.bench, fem=last, **how)
