"""Forces of a twin in the presses of an archive."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recorder.archive import ArchivedSensor, press_rows
from recorder.processes import results, several
from recorder.progress import span_of
from sim.arrays import Array, Progress
from sim.errors import SceneError, SimulationDiverged
from sim.indenters import indenter_of, is_indenter
from sim.result import Result
from sim.sensors import SimulatedSensor
from sim.sensors.posterior import CERTAIN
from sim.sensors.quantities import draw_sensor
from sim.stream import LivePress
from sim.tiers import simulate_many
from sim.twin.model import TOLERANCE, Correction, by_fem, fem_of, motion_of

# Longest way between two solutions [m], and height from which a tip comes [m].
WAY, ABOVE = 0.2e-3, 0.2e-3
# Depth over thickness from which forces of tier `layer` are off by some 5 %.
DEEP = 0.375
# Presses that a GPU solves together, and their part of the time of all forces there.
AT_ONCE, BY_FEM = 256, 0.8


@dataclass(frozen=True, slots=True, eq=False)
class ArchivedPress:
    """One press of an archive: where the tip was at each of its frames."""

    indenter: str
    rows: NDArray[np.int64]
    """Rows of the table (n,), in order of time."""
    tip: Array
    """Tip (n, 3) [m], z above the undeformed surface there."""
    time: Array
    """Time (n,) [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class TwinForces:
    """Forces of a twin at the frames of an archive.

    They are NaN in frames without a location, as of force-depth presses, and where the press has no
    solution.
    """

    force: Array
    """Of the twin (n, 3) [N]."""
    spread: Array
    """Over the sensors that are drawn from it, and by what its law does not explain (n, 3) [N]."""
    failed: tuple[str, ...]
    """Presses without a solution, and why."""


def archived_presses(sensor: ArchivedSensor, indenters: Sequence[str]) -> Iterator[ArchivedPress]:
    """Yield the presses of a sensor of an archive that have a location."""
    table = sensor.table
    for part in press_rows(table).values():
        name = indenters[int(table["indenter"][part[0]])]
        if not is_indenter(name):
            raise SceneError(f"{sensor.name}: indenter {name!r}; allowed: those of sim.indenters")
        tip = np.column_stack([table["position"][part], -table["depth"][part]])
        yield ArchivedPress(name, part, tip, 1e-9 * (table["t_ns"][part] - table["t_ns"][part[0]]))


def forces(
    sensors: Sequence[SimulatedSensor], press: ArchivedPress, grid: int, true: Array | None = None
) -> Array:
    """Return the force on each sensor at each frame of a press (k, n, 3) [N].

    By tier `layer`; those of a twin that was identified by tier `fem` are of `fem`, and those of
    the sensors drawn from it, which follow it, are corrected as its own. `true` are the twin's
    forces by tier `fem` (n, 3) [N], if they are solved already.
    """
    by_tier_layer = by_layer(sensors, press, grid)
    twin = sensors[0]
    if (twin.posterior or CERTAIN).tier == "layer":
        return by_tier_layer
    if true is None:
        true = by_fem(twin, indenter_of(press.indenter), *_from_above(twin, press))[1:]
    correction = Correction.of(true, by_tier_layer[0], twin.body.modulus)
    return np.stack(
        [
            correction.applied(force, sensor.body.modulus)
            for sensor, force in zip(sensors, by_tier_layer, strict=True)
        ]
    )


def _from_above(sensor: SimulatedSensor, press: ArchivedPress) -> tuple[Array, Array]:
    """Return tips (n + 1, 3) [m] and times (n + 1,) [s] of a press, the first in the air."""
    start = np.array([[*press.tip[0, :2], ABOVE]])
    first = (ABOVE - press.tip[0, 2]) / sensor.speed
    return np.concatenate([start, press.tip]), np.r_[0.0, press.time + first]


def by_fem_at_once(
    twin: SimulatedSensor,
    presses: Sequence[ArchivedPress],
    device: str,
    progress: Progress,
) -> Iterator[Array | SimulationDiverged]:
    """Yield the twin's forces by tier `fem` in presses (n, 3) [N], which a GPU solves together."""
    fem = replace(fem_of(twin), one_topology=True)
    for first in range(0, len(presses), AT_ONCE):
        some = presses[first : first + AT_ONCE]
        scenes = [
            twin.scene(indenter_of(press.indenter), motion_of(*_from_above(twin, press)))
            for press in some
        ]
        inside = span_of(progress, first / len(presses), len(some) / len(presses))
        for result in simulate_many(scenes, fem, device=device, progress=inside):
            yield result.wrench[1:, :3].astype(float) if isinstance(result, Result) else result


def by_layer(sensors: Sequence[SimulatedSensor], press: ArchivedPress, grid: int) -> Array:
    """Return the force on each sensor at each frame of a press (k, n, 3) [N], by tier `layer`."""
    force = np.zeros((len(sensors), len(press.rows), 3))
    indenter = indenter_of(press.indenter)
    for number, sensor in enumerate(sensors):
        live = LivePress(sensor, indenter, grid=grid, tolerance=TOLERANCE)
        tips, times = _from_above(sensor, press)
        before, at = tips[0], times[0]
        for row, (tip, time) in enumerate(zip(tips[1:], times[1:], strict=True)):
            count = max(1, int(np.ceil(np.linalg.norm(tip - before) / WAY)))
            for part in range(1, count + 1):
                live.move(before + (tip - before) * part / count, (time - at) / count)
            before, at = tip, time
            if live.touching:
                force[number, row] = live.force
    return force


def simulated_forces(
    archived: ArchivedSensor,
    indenters: Sequence[str],
    twin: SimulatedSensor,
    *,
    draws: int,
    seed: int,
    grid: int,
    height: float | None = None,
    device: str = "cpu",
    processes: int = 1,
    progress: Progress = lambda fraction: None,
) -> TwinForces:
    """Return the twin's forces at all frames of the presses of an archive.

    Their spread is that of `draws` sensors from its posterior, 0 for none. `height` is that of the
    surface over where the archive has it [m], by default the twin's own. Tier `fem` runs on the
    device: a GPU solves many presses at once.
    """
    if draws and twin.posterior is None:
        raise SceneError(
            f"{twin.name}: no posterior; allowed: a twin (tactile twin fit), or 0 draws"
        )
    random = np.random.default_rng(seed)
    sensors = [twin, *(draw_sensor(twin, twin.posterior or CERTAIN, random) for _ in range(draws))]
    posterior = twin.posterior or CERTAIN
    above = posterior.height if height is None else height
    presses = [
        replace(press, tip=press.tip - [0.0, 0.0, above])
        for press in archived_presses(archived, indenters)
    ]
    force, spread = (np.full((len(archived), 3), np.nan) for _ in range(2))
    failed: list[str] = []
    true: Sequence[Array | SimulationDiverged | None] = [None] * len(presses)
    if device != "cpu" and posterior.tier == "fem":
        true = [*by_fem_at_once(twin, presses, device, span_of(progress, 0.0, BY_FEM))]
        progress = span_of(progress, BY_FEM, 1 - BY_FEM)
    due = [
        (sensors, press, grid, true_force) for press, true_force in zip(presses, true, strict=True)
    ]
    with several(processes) as workers:
        solved = results(workers, _tried, due)
        for done, (press, each) in enumerate(zip(presses, solved, strict=True), 1):
            progress(done / len(presses))
            if isinstance(each, str):
                millimetres = 1e3 * press.tip[0]
                failed.append(
                    f"{press.indenter} at ({millimetres[0]:.2f}, {millimetres[1]:.2f}) mm: {each}"
                )
                continue
            force[press.rows] = each[0]
            if draws:
                drawn = np.sqrt(np.mean(np.square(each[1:] - each[0]), axis=0))
                unexplained = posterior.law * np.linalg.norm(each[0], axis=1, keepdims=True)
                spread[press.rows] = np.hypot(drawn, unexplained)
            else:
                spread[press.rows] = 0.0
    if failed and len(failed) == len(presses):
        raise SimulationDiverged(f"{twin.name}: no press has a solution; {failed[0]}")
    return TwinForces(force, spread, tuple(failed))


def _tried(
    sensors: Sequence[SimulatedSensor],
    press: ArchivedPress,
    grid: int,
    true: Array | SimulationDiverged | None,
) -> Array | str:
    """Return `forces`, or why there are none."""
    if isinstance(true, SimulationDiverged):
        return str(true)
    try:
        return forces(sensors, press, grid, true)
    except SimulationDiverged as diverged:
        return str(diverged)


def provenance(
    twin: SimulatedSensor, draws: int, seed: int, grid: int, height: float | None = None
) -> str:
    """Return a line that identifies the twin and settings that forces are from."""
    posterior = twin.posterior or CERTAIN
    height = posterior.height if height is None else height
    digest = hashlib.sha256(repr(twin).encode()).hexdigest()[:16]
    line = f"twin {twin.name} {digest}, draws {draws}, seed {seed}, grid {grid}"
    line += f", height {1e6 * height:g} um" if height else ""
    line += f", law {posterior.law:.2%}" if draws and posterior.law else ""
    return line if posterior.tier == "layer" else f"{line}, tier {posterior.tier}"
