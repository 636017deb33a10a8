"""What an archive will take, told before it is begun."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sim.archives.families import Family, Unit, families, scenes
from sim.archives.plan import Plan, names
from sim.archives.solving import Solving, described
from sim.errors import SceneError, SimulationDiverged
from sim.scene import Scene
from sim.sensors import CameraSignal, SimulatedSensor

SAMPLES = 3
"""Presses of a family whose seconds are foretold; the others take their mean."""
EDGES_TIMES = 1.6
"""What elements for edges take more than even ones (`sim.fem.grading`)."""
SECONDS_VIEW, SECONDS_MASK, SECONDS_SEGMENTED = 15e-3, 3e-3, 25e-3
"""CPU time of a frame, of each of its masks, and of one with errors of segmentation [s]: measured
on the machine of `sim/planner/seconds.csv`."""
BYTES_MASK, BYTES_FIELD = 2_800, 12_600
"""What a mask and a displacement field take when compressed: means over the paper's states."""


@dataclass(frozen=True, slots=True)
class Cost:
    """What is still to be done."""

    presses: int
    """Scenes to solve."""
    frames: int
    """Frames of them, of all families."""
    images: int
    """Masks that are made of the frames."""
    size: float
    """Bytes, about."""
    solving: float | None
    """CPU time of the presses [s], about; None where nothing is known of such presses."""
    seeing: float
    """The same of images [s]."""
    how: tuple[str, ...]
    """How presses are solved, in words, for each kind of body."""

    def seconds(self, processes: int) -> float | None:
        """Time that so many processes take, about [s]."""
        return None if self.solving is None else (self.solving + self.seeing) / processes


def cost(plan: Plan, missing: Sequence[Unit], device: str = "cpu") -> Cost:
    """What units take; presses are foretold from the cost table on device `cpu` only."""
    presses = frames = images = 0
    size = seeing = 0.0
    solving: float | None = 0.0
    for index, family in enumerate(families(plan)):
        some = [unit for unit in missing if unit.family == index]
        count = sum(unit.last - unit.first for unit in some)
        rows = sum(
            len(one)
            for unit in some
            for press in family.presses[unit.first : unit.last]
            for one in press.recordings
        )
        presses, frames = presses + count, frames + rows
        images += rows * len(family.names)
        for each in family.sensors:
            size += rows * _bytes(each)
            seeing += rows * _seconds_seeing(each)
        one_press = _seconds_press(plan, family, device) if some else 0.0
        solving = None if solving is None or one_press is None else solving + count * one_press
    how = dict.fromkeys(described(plan.solving, each.body) for each in plan.sensors)
    return Cost(presses, frames, images, size, solving, seeing, tuple(how))


def _bytes(each: SimulatedSensor) -> float:
    fields = isinstance(each.signal, CameraSignal)
    return len(names(each)) * BYTES_MASK + fields * BYTES_FIELD


def _seconds_seeing(each: SimulatedSensor) -> float:
    if not isinstance(each.signal, CameraSignal):
        return SECONDS_MASK
    segmented = 0.0 if each.life.segmentation is None else SECONDS_SEGMENTED
    return SECONDS_VIEW + len(names(each)) * (SECONDS_MASK + segmented)


def _seconds_press(plan: Plan, family: Family, device: str) -> float | None:
    """Mean time of a press [s]; None where the table knows nothing like it."""
    if device != "cpu":
        return None
    places = np.linspace(0, len(family.presses) - 1, SAMPLES + 2).round().astype(int)[1:-1]
    chosen = tuple(family.presses[place] for place in dict.fromkeys(places.tolist()))
    try:
        found = [_foretold(scene, plan.solving) for scene in scenes(plan, family, chosen)]
    except (SceneError, SimulationDiverged):
        return None
    return float(np.mean(found))


def _foretold(scene: Scene, solving: Solving) -> float:
    from sim.planner import Choice
    from sim.planner import plan as planned
    from sim.planner.choices import LADDER
    from sim.planner.features import probe
    from sim.planner.plan import stored

    if solving.tolerance is not None:
        return planned(scene, solving.tolerance).chosen.seconds
    numerics = solving.numerics(scene.body)
    kind: Literal["layer", "fem"] = solving.tier
    cells, times = 0, 1.0
    if numerics is not None:
        cells = round(scene.body.thickness / (numerics.spacing or scene.body.thickness))
        cells = max(LADDER[0], cells)
        times = EDGES_TIMES if solving.for_edges else 1.0
    return times * stored().seconds(probe(scene).features, Choice(kind, cells), "cpu")
