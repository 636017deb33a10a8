"""Archives of two fingers that squeeze made-up objects, whose forces balance with known weights."""

import json
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from support.made_up_archives import MM_PER_PX, STIFFNESS, State, mask_of

from learning.data.matching import SensorSelection
from learning.transfer.weights import Balanced
from recorder import MarkerArchive
from recorder.archive import ArchivePlan, ArchiveWriter, SensorPlan
from recorder.markers import HEIGHT, WIDTH, pack

GRAVITY = 9.80665
# Fingers, and made-up sensors on them; widths of faces [px], and the left one's largest force [N].
FINGERS = {"left": "dots", "right": "dense"}
WIDTHS_PX, MOST = (70.0, 90.0, 110.0), 3.0


class Hold(NamedTuple):
    """A frame of a squeeze: object, squeeze, step, and forces of the left and right finger [N]."""

    code: int
    squeeze: int
    step: int
    mass: float
    turn: float
    forces: tuple[float, float]
    still: bool = True


def holds(
    objects: int, steps: int, mass: float = 0.1, turns: tuple[int, ...] = (1, -1)
) -> list[Hold]:
    """Return a frame of each step of squeezes, one of each object at each turn."""
    random, made = np.random.default_rng(0), []
    for squeeze, (code, turn) in enumerate(product(range(objects), turns)):
        made.append(Hold(code, squeeze, 0, mass, turn, (0.0, 0.0)))
        for step in range(1, steps + 1):
            load = mass * GRAVITY * turn
            left = max(MOST * step / steps * random.uniform(0.9, 1.1) - load / 2, 0.0, -load)
            made.append(Hold(code, squeeze, step, mass, turn, (left, left + load)))
    return made


def squeeze_archives(
    folder: Path, some: list[Hold], *, late_ns: int = 0, **attrs: str
) -> dict[str, SensorSelection]:
    """Make an archive of each finger; frames of the right one are `late_ns` later.

    Faces of an object have widths of their own. Fz of the left finger has labels.
    """
    folder.mkdir(parents=True, exist_ok=True)
    objects = tuple(f"object-{code}" for code in range(1 + max(one.code for one in some)))
    random = np.random.default_rng(0)
    widths = random.choice(WIDTHS_PX, (len(objects), 2))
    places = random.uniform(0.4, 0.6, (1 + max(one.squeeze for one in some), 2))
    made = {}
    for side, (finger, name) in enumerate(FINGERS.items()):
        states = [
            state_of(one.forces[side], widths[one.code, side], places[one.squeeze], STIFFNESS[name])
            for one in some
        ]
        rest = pack(mask_of(name, State((0, 0), 90.0, 0.0))[None])
        own = {"finger": attrs.get(finger, finger)}
        plan = SensorPlan(name, len(some), 8, 8 * len(some), rest, MM_PER_PX, attrs=own)
        path = folder / f"{finger}.markers.zarr"
        writer = ArchiveWriter.begin(path, ArchivePlan((plan,), objects))
        table = table_of(some, side * late_ns)
        if finger == "left":
            table["wrench"][:, 2] = [-one.forces[0] for one in some]
        packed = np.array([pack(mask_of(name, state)[None])[0] for state in states])
        writer.sensors[name].write(0, packed=packed, table=table, source=[*map(source_of, some)])
        writer.finish()
        made[finger] = SensorSelection(MarkerArchive(path), name, name)
    return made


def source_of(one: Hold) -> str:
    """Return the provenance of a frame."""
    known = {"mass": one.mass, "turn": [one.turn, 0, 0], "step": one.step, "still": one.still}
    return json.dumps({"session": "squeezes", "run": 0, "target": one.squeeze, **known})


def table_of(some: list[Hold], late_ns: int) -> dict[str, NDArray[Any]]:
    """Return the columns of a table, without labels."""
    code, squeeze, step = (np.array(column) for column in [*zip(*some, strict=True)][:3])
    ones = np.ones(len(some), bool)
    return {
        **{"indenter": code, "location": squeeze, "target": squeeze, "frame": step},
        "t_ns": np.arange(len(some)) * 1_000_000_000 + late_ns,
        **{"phase": 0 * step - 1, "depth": 1e-4 * step, "position": np.zeros((len(some), 2))},
        **{"reference": 0 * step, "seen": ones, "valid": ones},
        "wrench": np.full((len(some), 6), np.nan),
    }


def state_of(force: float, width: float, place: NDArray[Any], stiffness: float) -> State:
    """Return the state in which a made-up sensor bears a normal force [N]."""
    over = force / (stiffness * (width / 90.0) ** 2)
    depth = (np.sqrt(4.0 + 3.2 * over) - 2.0) / 1.6
    return State((float(WIDTH * place[0]), float(HEIGHT * place[1])), float(width), float(depth))


def planted_signals(mass: float, seed: int, bent: tuple[float, float]) -> Balanced:
    """Return signals of 8 objects at 8 steps to 12 N, as (force / 12 N) ** bent.

    Errors are noise of 0.03 N and of 3 %, creep of up to 3 %, and 2 % that an object has.
    """
    random = np.random.default_rng(seed)
    objects, turns, _, steps = np.array([*product(range(8), (0, 1, -1), (0, 1), range(1, 9))]).T
    load = mass * GRAVITY * turns
    middle = 12 * np.exp(0.15 * random.normal(size=8))[objects] * (steps / 8) ** 1.3
    other = np.maximum(middle - load / 2, np.maximum(-load, 0.0))
    felt = []
    for force, power in zip((other + load, other), bent, strict=True):
        error = 0.02 * random.normal(size=8)[objects] + 0.03 * random.normal(size=len(load))
        crept = random.uniform(-0.015, 0.015, len(load))
        felt.append((force / 12 * (1 + error + crept)) ** power)
    noise = 0.03 / 12 * random.normal(size=(2, len(load)))
    return Balanced(np.array(felt) + noise, load, steps, objects)
