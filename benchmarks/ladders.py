"""Tables of `sim/ladders`, and how far presses by them are off.

    python -m benchmarks.ladders layer
    python -m benchmarks.ladders solve PRESSES.npz --device cuda:0 --processes 15
    python -m benchmarks.ladders package PRESSES.npz...
    python -m benchmarks.ladders compare PRESSES.npz...

`layer` solves the presses that ladders consist of; `solve` those by finite elements: for each
indenter and skin a normal press through eight depths, and one beside the middle that is sheared,
returned and lifted, at depths, places and directions that no table has. `package` writes the tables
by which the first mend a ladder, `compare` prints how far it is off in the others. Of several files
the press with the least stated error counts.
"""

import argparse
import hashlib
import math
import time
from collections.abc import Iterator
from concurrent.futures import as_completed
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.processes import Workers
from sim import plan
from sim.device import ready_device
from sim.errors import SceneError, SimulationDiverged
from sim.indenters import NAMES, Indenter, named
from sim.ladder import (
    ANOTHER,
    APART,
    BARE,
    BEYOND,
    FRICTION,
    PACKAGED,
    ByFem,
    Ladder,
    LadderPress,
    Presses,
    cache_folder,
    interpolated,
    name_of,
    name_of_skin,
    presses_of,
    solved,
)
from sim.scene import Effects, Motion, Scene, press
from sim.sensors import SimulatedSensor, SurfaceField, sensor
from sim.sensors.sensor import CameraSignal

Array = NDArray[np.float64]
Row = dict[str, Any]

# The deepest press of each skin, and other sensors with one of them.
SKINS = "r6", "tacpalm", "gelsight-mini", "digit"
# Depths of the normal press, over the sensor's depth; of the sheared one, the least and the most.
DEPTHS, SHEARED = (0.08, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0), (0.45, 0.8)
# Shear over the depth, farthest place beside the middle [m], and frames of each move.
SHEAR, ASIDE, FRAMES = 0.7, 2e-3, 4
# Places along a side of the top.
PLACES = 41
# Tolerance and time of a press [s].
TOLERANCE, SECONDS = "2 %", 70.0
# Stated error of a force above which it is not in a table; depths below it that a table needs.
MOST, LEAST = 0.12, 4
# A ladder of which nothing is mended, nor drawn.
PLAIN = replace(BARE, moved=np.zeros((1, 2, 2, 3)))
# Motion above which a marker counts [px], the pixel of a sensor without a camera [m], and force
# over the largest above which a frame counts.
MOVES, PIXEL, FORCE = 0.2, 5e-5, 0.05
# Range of a tangential stiffness over that of the ladder.
STIFFNESS = 0.6, 1.6
# Stated error of sheared presses to which `ByFem.shear` is fitted, and weight of small parts.
CERTAIN, SMALL = 0.05, 1e-4


def motion_of(row: SimulatedSensor, name: str, kind: str) -> Motion:
    """Return the motion of an indenter on a sensor; a sheared one is drawn by the names."""
    if kind == "normal":
        return press([part * row.depth_max for part in DEPTHS])
    seed = hashlib.sha256(f"{row.name} {name}".encode()).digest()
    random = np.random.default_rng(list(seed))
    depth = float(random.uniform(*SHEARED)) * row.depth_max
    x, y = random.uniform(-ASIDE, ASIDE, 2)
    angle = float(random.uniform(0, math.tau))
    return press([depth], shear=SHEAR * depth, angle=angle, at=(float(x), float(y)), steps=FRAMES)


def places_of(row: SimulatedSensor, kind: str) -> Array:
    """Return places of a press's displacements (n, 2) [m].

    Of a normal one they are evenly spaced across the top, else the sensor's markers.
    """
    if kind == "sheared" and isinstance(row.signal, CameraSignal):
        return np.asarray(row.signal.drawn()[0].centres, np.float64)
    axis = np.linspace(-0.5, 0.5, PLACES)
    sides = axis * row.body.size_x, axis * row.body.size_y
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)


def solve(device: str, job: tuple[str, str, str]) -> Row:
    """Return the press of a sensor's skin, elastic with its friction, or why there is none."""
    of, name, kind = job
    row = sensor(of)
    motion = motion_of(row, name, kind)
    felt = row.scene(named(name), motion).indenter
    scene = Scene(felt, motion, row.body, Effects(friction=row.effects.friction))
    ready_device(device)
    try:
        result = plan(scene, TOLERANCE, seconds=SECONDS, device=device).run()
    except (SceneError, SimulationDiverged) as error:
        return {"why": str(error).split("\n")[0]}
    moved = SurfaceField.of(result).at(places_of(row, kind)).astype(np.float32)
    stated = np.array(result.record["error"]["force"], np.float64)
    return {"tip": motion.tip, "wrench": result.wrench, "moved": moved, "error": stated}


def read(files: list[Path]) -> dict[str, Row]:
    """Return the presses of some files; each with the least error."""
    presses: dict[str, Row] = {}
    for path in files:
        with np.load(path) as file:
            for key in {name.rpartition(".")[0] for name in file.files}:
                values = "tip", "wrench", "moved", "error"
                one = {name: file[f"{key}.{name}"] for name in values if f"{key}.{name}" in file}
                if key not in presses or max(one["error"]) < max(presses[key]["error"]):
                    presses[key] = one
    return presses


def package_layer() -> None:
    """Solve the ladders of all indenters on all skins, and package them."""
    for row in map(sensor, SKINS):
        arrays: dict[str, Any] = {}
        for name in NAMES:
            felt = felt_by(row, name)
            presses = solved(felt, row.body, BEYOND * row.depth_max)
            arrays |= presses.packed(f"{name_of(felt, row.body)}.")
        np.savez_compressed(PACKAGED / f"{name_of_skin(row.body)}.npz", **arrays)


def package(presses: dict[str, Row]) -> None:
    """Write the tables of `fem` of all skins."""
    moved: dict[tuple[str, str], Array] = {}
    worst: dict[tuple[str, str], float] = {}
    for of in SKINS:
        for name in NAMES:
            one = presses[f"{of} {name} normal"]
            worst[of, name] = float(one["error"][3]) if "moved" in one else math.inf
            if "moved" in one:
                moved[of, name] = moved_by_fem(sensor(of), name, one)
    for of in SKINS:
        row = sensor(of)
        tables: dict[str, ByFem] = {}
        for name in NAMES:
            best = SKINS[int(np.argmin([worst[each, name] for each in SKINS]))]
            field = moved[of if worst[of, name] < MOST else best, name]
            tables[name] = table_of(row, name, presses, field)
        middle = np.median([one.ratio for one in tables.values() if one.error[0] < ANOTHER], axis=0)
        arrays: dict[str, Any] = {"size": row.body.size_x}
        for name, table in tables.items():
            if table.error[0] >= ANOTHER:
                table = replace(table, ratio=middle)
            arrays |= table.packed(name_of(felt_by(row, name), row.body))
        ladders = {name: Ladder(by_layer(row, name), row.body, tables[name]) for name in NAMES}
        arrays["shear"] = fitted(dragged(row, ladders, presses))
        np.savez_compressed(PACKAGED / f"fem-{name_of_skin(row.body)}.npz", **arrays)


def felt_by(row: SimulatedSensor, name: str) -> Indenter:
    """Return an indenter as a sensor's skin feels it."""
    return row.scene(named(name), motion_of(row, name, "normal")).indenter


def by_layer(row: SimulatedSensor, name: str) -> Presses:
    """Return the presses of an indenter that its ladder consists of."""
    return presses_of(felt_by(row, name), row, cache_folder())


def moved_by_fem(row: SimulatedSensor, name: str, one: Row) -> Array:
    """Return `ByFem.moved` of a normal press."""
    ladder, places = Ladder(by_layer(row, name), row.body, PLAIN), places_of(row, "normal")
    moved = []
    for tip, true in zip(one["tip"][1:], one["moved"][1:], strict=True):
        depth = -float(tip[2])
        field = interpolated(ladder.fields.normal, *ladder.place(depth))
        own = ladder.fields.at(field, places)
        moved.append((true - own).reshape(PLACES, PLACES, 3) / depth)
    return np.array(moved)


def table_of(row: SimulatedSensor, name: str, presses: dict[str, Row], moved: Array) -> ByFem:
    """Return the table of an indenter; the error of one without good presses is `ANOTHER`."""
    one, steps = presses[f"{row.name} {name} normal"], by_layer(row, name)
    ladder = Ladder(steps, row.body, BARE)
    depth, error = -np.asarray(one["tip"], float)[1:, 2], np.asarray(one["error"], float)[1:]
    ratio = -one["wrench"][1:, 2] / [ladder.normal(each) for each in depth]
    good = error < MOST
    if good.sum() < LEAST:
        return ByFem(depth, ratio, np.full(len(depth), ANOTHER), 1.0, moved)
    ratio = np.interp(depth, depth[good], ratio[good])
    table = ByFem(depth, ratio, np.where(good, error, ANOTHER), 1.0, moved)
    sheared, first = presses.get(f"{row.name} {name} sheared"), FRAMES + 1
    if sheared is None or sheared["error"][first] >= MOST:
        return table
    true, (low, high) = float(np.hypot(*sheared["wrench"][first, :2])), STIFFNESS
    while high - low > 1e-3:
        side = (low + high) / 2
        tried = Ladder(steps, row.body, ByFem(depth, ratio, error, side))
        *_, own = followed(tried, row, sheared["tip"][: first + 1])
        low, high = (side, high) if np.hypot(*own.wrench[:2]) < true else (low, side)
    return ByFem(depth, ratio, table.error, round((low + high) / 2, 3), moved)


def followed(ladder: Ladder, row: SimulatedSensor, tips: Array) -> Iterator[LadderPress]:
    """Yield the press of a ladder at each of its tips (n, 3) [m], elastic."""
    friction = row.effects.friction
    own = LadderPress(ladder, friction.coefficient if friction else 0.0)
    before = np.asarray(tips[0], float)
    for tip in np.asarray(tips, float):
        for part in np.linspace(0.125, 1.0, 8):
            own.move(before + part * (tip - before), 1.0)
        before = tip
        yield own


def dragged(
    row: SimulatedSensor, ladders: dict[str, Ladder], presses: dict[str, Row]
) -> dict[str, tuple[Array, Array]]:
    """Return equations for `ByFem.shear` by indenter: a matrix (n, 21) and the right side (n,) [m].

    The unknowns are its parts; each row is a component of a marker's motion in a sheared press.
    """
    equations, parts = {}, np.eye(3 * len(APART)).reshape(-1, 3, len(APART))
    for name, ladder in ladders.items():
        one = presses.get(f"{row.name} {name} sheared", {})
        if "moved" not in one or one["error"].max() > CERTAIN:
            continue
        ladder.by_fem = replace(ladder.by_fem, shear=None)
        each = [replace(BARE, shear=part) for part in parts]
        places, added, wanted = places_of(row, "sheared"), [], []
        for k, own in enumerate(followed(ladder, row, one["tip"][: 2 * FRAMES + 1])):
            if k > FRAMES:
                added.append(np.stack([own.dragged(places, part).ravel() for part in each], 1))
                wanted.append((one["moved"][k] - own.markers(places))[:, :2].ravel())
        equations[name] = np.concatenate(added).astype(float), np.concatenate(wanted)
    return equations


def fitted(equations: dict[str, tuple[Array, Array]], without: str = "") -> Array:
    """Return `ByFem.shear` of all indenters but one."""
    some = [both for name, both in equations.items() if name != without]
    added, wanted = (np.concatenate(one) for one in zip(*some, strict=True))
    squares = added.T @ added
    squares += SMALL * np.trace(squares) / len(squares) * np.eye(len(squares))
    parts: Array = np.linalg.solve(squares, added.T @ wanted)
    return parts.reshape(3, -1)


def compare(presses: dict[str, Row]) -> None:
    """Print how far ladders are off in sheared presses, as on the page of fidelity [%].

    What shear adds to markers is fitted to the other indenters.
    """
    skins = {name_of_skin(row.body): row for row in map(sensor, SKINS)}
    equations = {
        skin: dragged(row, {name: Ladder.of(name, row) for name in NAMES}, presses)
        for skin, row in skins.items()
    }
    for key, one in sorted(presses.items()):
        of, name, kind = key.split()
        row, wrenches = sensor(of), one["wrench"]
        if kind != "sheared" or "moved" not in one:
            continue
        ladder = Ladder.of(name, row)
        others = fitted(equations[name_of_skin(row.body)], without=name)
        ladder.by_fem = replace(ladder.by_fem, shear=others)
        places, friction = places_of(row, kind), row.effects.friction
        limit = -(friction.coefficient if friction else FRICTION) * wrenches[:, 2]
        least = MOVES * (getattr(row.signal, "scale", None) or PIXEL)
        path = followed(ladder, row, one["tip"])
        force, side, off, size = [], [], np.zeros(len(wrenches)), np.zeros(len(wrenches))
        for k, (own, wrench, moved) in enumerate(zip(path, wrenches, one["moved"], strict=False)):
            if wrench[2] > FORCE * wrenches[:, 2].min():
                continue
            force.append(abs(own.wrench[2] / wrench[2] - 1))
            side.append(np.hypot(*(own.wrench - wrench)[:2]) / limit[k])
            apart = (own.markers(places) - moved)[:, :2]
            counts = np.linalg.norm(moved[:, :2], axis=1) > least
            off[k], size[k] = (np.square(each[counts, :2]).sum() for each in (apart, moved))
        values = [max(force), np.median(side), max(side)]
        for some in (slice(1, FRAMES + 1), slice(FRAMES + 1, 2 * FRAMES + 1), slice(None)):
            values.append(np.sqrt(off[some].sum() / max(size[some].sum(), 1e-30)))
        values.append(one["error"].max())
        texts = " | ".join(f"{100 * value:.1f}" for value in values)
        print(f"| {of} | {name} | {-1e3 * one['tip'][:, 2].min():.2f} | {texts} |", flush=True)


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("do", choices=("layer", "solve", "package", "compare"))
    parser.add_argument("files", nargs="*", type=Path, metavar="PRESSES.npz")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--processes", type=int, default=15)
    options = parser.parse_args()
    if options.do == "layer":
        package_layer()
    elif options.do == "package":
        package(read(options.files))
    elif options.do == "compare":
        compare(read(options.files))
    else:
        solve_all(options.files[0], options.device, options.processes)


def solve_all(path: Path, device: str, processes: int) -> None:
    """Solve all presses and write them to a file, again after each of them."""
    jobs = [(of, name, kind) for kind in ("normal", "sheared") for of in SKINS for name in NAMES]
    arrays: dict[str, Any] = {}
    began = time.perf_counter()
    with Workers(processes) as workers:
        tasks = {workers.submit(partial(solve, device), job): " ".join(job) for job in jobs}
        for done, task in enumerate(as_completed(tasks), 1):
            row, key = task.result(), tasks[task]
            arrays |= {f"{key}.{name}": value for name, value in row.items() if name != "why"}
            np.savez_compressed(path, **arrays)
            seconds = time.perf_counter() - began
            print(f"{done}/{len(jobs)} {key}: {row.get('why', seconds)}", flush=True)


if __name__ == "__main__":
    main()
