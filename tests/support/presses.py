"""Presses by finite elements, against which a ladder is measured; to be run on a GPU.

    python tests/support/presses.py --fem r6,tacpalm --device cuda:0 --processes 15 --out FILE.json

For each indenter and sensor there is a normal press through six depths, and a press beside the
middle that is sheared, returned and lifted, at depths, places and directions that no table has.
Rows are written as they complete: forces [N], stated errors [%], and displacements [m] of the
sensor's markers, or why there are none.
"""

import argparse
import hashlib
import json
import math
import signal
import time
from concurrent.futures import as_completed
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.processes import Workers
from sim import ladder
from sim.device import ready_device
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import NAMES, named
from sim.result import Result
from sim.scene import Effects, Motion, Scene, press
from sim.sensors import SimulatedSensor, SurfaceField, sensor
from sim.sensors.sensor import CameraSignal
from sim.tiers import simulate

# Depths of the normal press, over the sensor's depth; of the sheared one, the least and the most.
DEPTHS, SHEARED = (0.2, 0.4, 0.55, 0.7, 0.85, 1.0), (0.45, 0.8)
# Coefficient of friction of all packaged sensors.
FRICTION = 0.5
# Shear over the depth, farthest place beside the middle [m], and frames of each move.
SHEAR, ASIDE, FRAMES = 0.7, 2e-3, 4


class OutOfTime(Exception):
    """Raised if a press takes too long."""


def _ring(_number: int, _frame: object) -> None:
    raise OutOfTime("no answer in time")


def motions(row: SimulatedSensor, name: str) -> dict[str, Motion]:
    """Return the motions of an indenter on a sensor; drawn by the names."""
    seed = hashlib.sha256(f"{row.name} {name}".encode()).digest()
    random = np.random.default_rng(list(seed))
    depth = float(random.uniform(*SHEARED)) * row.depth_max
    x, y = random.uniform(-ASIDE, ASIDE, 2)
    angle = float(random.uniform(0, math.tau))
    return {
        "normal": press([part * row.depth_max for part in DEPTHS]),
        "sheared": press(
            [depth], shear=SHEAR * depth, angle=angle, at=(float(x), float(y)), steps=FRAMES
        ),
    }


def places(row: SimulatedSensor) -> NDArray[np.float64]:
    """Return the undeformed places of the sensor's markers (n, 2) [m]; of taxels, a grid."""
    if isinstance(row.signal, CameraSignal):
        return np.asarray(row.signal.drawn()[0].centres, np.float64)
    axis = np.linspace(-0.4, 0.4, 9) * row.body.size_x
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)


def solved(
    device: str, numerics: Fem, seconds: float, job: tuple[str, str, Motion]
) -> dict[str, Any]:
    """Return the row of one press, elastic with the sensor's friction."""
    of, name, motion = job
    row = sensor(of)
    felt = row.scene(named(name), motion).indenter
    scene = Scene(felt, motion, row.body, Effects(friction=row.effects.friction))
    ready_device(device)
    began, why = time.perf_counter(), ""
    result: Result | None = None
    try:
        signal.signal(signal.SIGALRM, _ring)
        # Again and again: an exception within a destructor is ignored.
        signal.setitimer(signal.ITIMER_REAL, seconds, 5.0)
        result = simulate(scene, numerics, device=device)
    except SimulationDiverged as error:
        error.forget_dump()
        reached = error.reached
        result, why = reached if isinstance(reached, Result) else None, str(error).split("\n")[0]
    except (SceneError, OutOfTime) as error:
        why = str(error).split("\n")[0]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    values: dict[str, Any] = {"tip": motion.tip, "why": why}
    if result is not None:
        moved = SurfaceField.of(result).at(places(row))
        values |= {
            "wrench": result.wrench.tolist(),
            "markers": np.round(moved, 8).tolist(),
            "error": result.record.get("error", {}),
        }
    return values | {"seconds": round(time.perf_counter() - began, 1)}


def tabulate(files: list[Path]) -> None:
    """Write the table that comes with the simulator from the presses of some files.

    Where there is no normal press, the way down of the sheared one stands in. Its second frame of
    shear gives the tangential stiffness.
    """
    solutions: dict[str, Any] = {}
    for path in files:
        some = json.loads(path.read_text())
        solutions |= {name: values for name, values in some.items() if "wrench" in values}
    table = {}
    for of, name in dict.fromkeys(tuple(key.split()[:2]) for key in solutions):
        row, sheared = sensor(of), solutions.get(f"{of} {name} sheared")
        normal = solutions.get(f"{of} {name} normal", sheared)
        count = 1 + (len(DEPTHS) if normal is not sheared else FRAMES)
        felt = row.scene(named(name), Motion(((0.0, 0.0, 0.0),), (0.0,))).indenter
        presses = ladder.presses_of(felt, row, ladder.cache_folder())
        bare = ladder.Ladder(presses, row.body, ladder.BARE)
        force = -np.array(normal["wrench"])[1:count, 2]
        depth = -np.array(normal["tip"])[1 : 1 + len(force), 2]
        ratio = force / [bare.normal(float(one)) for one in depth]
        error = np.array(normal["error"]["force"])[1:count]
        side = 1.0
        if sheared is not None:
            mended = ladder.Ladder(presses, row.body, ladder.ByFem(depth, ratio, error))
            follower = ladder.LadderPress(mended, FRICTION)
            for tip in np.array(sheared["tip"])[: FRAMES + 3]:
                follower.move(tip, 0.0)
            true = np.array(sheared["wrench"])[FRAMES + 2, :2]
            side = float(np.hypot(*true) / np.hypot(*follower.wrench[:2]))
        table[ladder.name_of(felt, row.body)] = {
            "indenter": name,
            "skin": ladder.name_of_skin(row.body),
            "depth": np.round(depth, 7).tolist(),
            "ratio": np.round(ratio, 4).tolist(),
            "error": error.tolist(),
            "side": round(side, 3),
        }
    lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(one)}" for key, one in table.items())
    ladder.TABLE.write_text(f"{{{lines}}}\n")


def main() -> None:
    """Solve the presses of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--table", nargs="+", type=Path, metavar="FILE", help="tables of results")
    parser.add_argument("--fem", metavar="ROW[,ROW]", help="sensors")
    parser.add_argument("--only", default=",".join(NAMES), metavar="NAMES", help="indenters")
    parser.add_argument("--kinds", default="normal,sheared")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--out", type=Path, metavar="FILE.json")
    parser.add_argument("--fineness", type=float, default=1.0)
    parser.add_argument("--seconds", type=float, default=100.0, help="most for a press")
    parser.add_argument("--processes", type=int, default=15)
    options = parser.parse_args()
    if options.table:
        tabulate(options.table)
        return
    jobs = {
        f"{of} {name} {kind}": (of, name, motions(sensor(of), name)[kind])
        for of in options.fem.split(",")
        for kind in options.kinds.split(",")
        for name in options.only.split(",")
    }
    work = partial(solved, options.device, Fem(fineness=options.fineness), options.seconds)
    rows: dict[str, Any] = {}
    with Workers(options.processes) as workers:
        tasks = {workers.submit(work, job): name for name, job in jobs.items()}
        for task in as_completed(tasks):
            name = tasks[task]
            rows[name] = {"why": str(task.exception())} if task.exception() else task.result()
            partial_file = options.out.with_suffix(".partial")
            partial_file.write_text(json.dumps(rows))
            partial_file.replace(options.out)
            print(f"{len(rows)}/{len(jobs)} {name}: {rows[name].get('seconds')} s", flush=True)


if __name__ == "__main__":
    main()
