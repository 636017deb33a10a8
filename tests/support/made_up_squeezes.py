"""Archives of two fingers that squeeze made-up objects, whose forces balance with known weights."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from support.made_up_archives import MM_PER_PX, STIFFNESS, State, mask_of, wrench_of

from recorder import MarkerArchive
from recorder.archive import ArchivePlan, ArchiveWriter, SensorPlan
from recorder.markers import HEIGHT, WIDTH, pack

GRAVITY = 9.80665
FINGERS = {"left": "dots", "right": "dense"}
WIDTHS_PX = (70.0, 90.0, 110.0)
# Force of the left finger at the deepest step [N].
MOST = 3.0


@dataclass(frozen=True, slots=True)
class Hold:
    """A frame of a squeeze: forces of the left and of the right finger [N]."""

    code: int
    squeeze: int
    step: int
    mass: float
    turn: float
    forces: tuple[float, float]
    still: bool = True


def holds(
    objects: int, steps: int, mass: float, turns: tuple[float, ...], seed: int = 0
) -> list[Hold]:
    """Return the frames of squeezes of some objects, one squeeze for each turn."""
    random, made = np.random.default_rng(seed), []
    for code in range(objects):
        for number, turn in enumerate(turns):
            squeeze = code * len(turns) + number
            made.append(Hold(code, squeeze, 0, mass, turn, (0.0, 0.0)))
            for step in range(1, steps + 1):
                load = mass * GRAVITY * turn
                middle = MOST * step / steps * random.uniform(0.9, 1.1)
                left = max(middle - load / 2, 0.02, 0.02 - load)
                made.append(Hold(code, squeeze, step, mass, turn, (left, left + load)))
    return made


def squeeze_archives(
    folder: Path,
    some: list[Hold],
    *,
    labelled: tuple[str, ...] = (),
    fingers: tuple[str, str] = ("left", "right"),
    late_ns: int = 0,
    seed: int = 0,
) -> dict[str, MarkerArchive]:
    """Make an archive of each finger; frames of the right one are `late_ns` after the left one's.

    Fingers have faces of other widths than each other. Forces are labels of fingers in `labelled`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    objects = tuple(f"object-{code}" for code in range(1 + max(one.code for one in some)))
    random = np.random.default_rng(seed)
    widths = random.choice(WIDTHS_PX, (len(objects), 2))
    places = random.uniform(0.4, 0.6, (1 + max(one.squeeze for one in some), 2))
    length = sum(one.squeeze == some[0].squeeze for one in some)
    made = {}
    for index, name in enumerate(fingers):
        sensor = list(FINGERS.values())[index]
        forces = np.array([one.forces[index] for one in some])
        states = [
            state_of(force, widths[one.code, index], places[one.squeeze], STIFFNESS[sensor])
            for one, force in zip(some, forces, strict=True)
        ]
        plan = SensorPlan(
            name=sensor,
            rows=len(some),
            chunk_rows=length,
            unit_rows=len(some),
            references=pack(mask_of(sensor, State((0, 0), 90.0, 0.0))[None]),
            mm_per_px=MM_PER_PX,
            attrs={"finger": name},
        )
        path = folder / f"{list(FINGERS)[index]}.markers.zarr"
        writer = ArchiveWriter.begin(path, ArchivePlan((plan,), objects, {"made_up": True}))
        wrench = np.full((len(some), 6), np.nan)
        if name in labelled:
            wrench[:, 2] = [wrench_of(state, STIFFNESS[sensor])[2] for state in states]
        writer.sensors[sensor].write(
            0,
            packed=np.array([pack(mask_of(sensor, state)[None])[0] for state in states]),
            table={**table_of(some, index * late_ns), "wrench": wrench},
            source=[source_of(one) for one in some],
        )
        writer.finish()
        made[name] = MarkerArchive(path)
    return made


def source_of(one: Hold) -> str:
    """Return the provenance of a frame."""
    known = {"mass": one.mass, "turn": [one.turn, 0.0, 0.0], "step": one.step, "still": one.still}
    return json.dumps({"session": "squeezes", "run": 0, "target": one.squeeze, **known})


def table_of(some: list[Hold], late_ns: int) -> dict[str, NDArray[Any]]:
    """Return the columns of a table but the wrench."""
    count = len(some)
    return {
        "indenter": np.array([one.code for one in some]),
        "location": np.array([one.squeeze for one in some]),
        "target": np.array([one.squeeze for one in some]),
        "frame": np.array([one.step for one in some]),
        "t_ns": np.arange(count) * 1_000_000_000 + late_ns,
        "phase": np.full(count, -1),
        "depth": np.array([1e-4 * one.step for one in some]),
        "position": np.zeros((count, 2)),
        "reference": np.zeros(count, np.int64),
        "seen": np.ones(count, bool),
        "valid": np.ones(count, bool),
    }


def state_of(force: float, width: float, place: NDArray[Any], stiffness: float) -> State:
    """Return the state in which a made-up sensor bears a normal force [N]."""
    over = force / (stiffness * (width / 90.0) ** 2)
    depth = (np.sqrt(4.0 + 3.2 * over) - 2.0) / 1.6
    return State((float(WIDTH * place[0]), float(HEIGHT * place[1])), float(width), float(depth))
