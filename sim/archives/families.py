"""Which sensors share their deformations, and how the work is cut into units."""

from __future__ import annotations

import functools
from collections.abc import Hashable
from dataclasses import dataclass, replace

from sim.archives.plan import Plan, names
from sim.archives.press import Press
from sim.archives.states import state_presses
from sim.archives.targets import target_presses
from sim.body import Body
from sim.indenters import named
from sim.scene import Scene
from sim.sensors import SimulatedSensor

MODULUS = Body().modulus
"""What presses are solved with where forces are proportional to the modulus [Pa]."""


@dataclass(frozen=True, slots=True)
class Family:
    """Sensors that differ in what is measured of a deformation only, or in modulus.

    Without mass and weight a layer that is twice as stiff takes the same shape under the same
    motion, with twice the force: friction, contact and the branches of viscosity are ratios.
    """

    sensors: tuple[SimulatedSensor, ...]
    presses: tuple[Press, ...]
    unit_presses: int
    """Recordings of a unit of files."""

    @property
    def rows_each(self) -> int:
        """Rows of a recording."""
        return len(self.presses[0].recordings[0])

    @property
    def recordings(self) -> int:
        """Recordings of each of its sensors."""
        return sum(len(press.recordings) for press in self.presses)

    @property
    def names(self) -> tuple[str, ...]:
        """Its sensors in the archive, pattern by pattern."""
        return tuple(name for each in self.sensors for name in names(each))


@dataclass(frozen=True, slots=True)
class Unit:
    """Presses that are solved in one call, and written whole."""

    number: int
    """Its place in the plan."""
    family: int
    first: int
    """Number of its first press in the family."""
    last: int
    """Number of the press behind its last."""
    files: range
    """Units of the archive that it writes, of every sensor of the family."""


@functools.cache
def families(plan: Plan) -> tuple[Family, ...]:
    """The sensors of a plan by what they share, in their order."""
    together: dict[Hashable, list[SimulatedSensor]] = {}
    for each in plan.sensors:
        together.setdefault(_deformation(plan, each), []).append(each)
    return tuple(_family(plan, tuple(sensors)) for sensors in together.values())


@functools.cache
def units(plan: Plan) -> tuple[Unit, ...]:
    """All units of a plan; every cut is the plan's, whatever has been done of it."""
    cut: list[Unit] = []
    for index, family in enumerate(families(plan)):
        step = max(1, plan.together // family.unit_presses) * family.unit_presses
        single = [press for press in family.presses if len(press.recordings) == 1]
        for first in range(0, len(single), step):
            last = min(first + step, len(single))
            files = range(first // family.unit_presses, -(-last // family.unit_presses))
            cut.append(Unit(len(cut), index, first, last, files))
        if len(single) < len(family.presses):
            # The presses of several recordings come last, behind whole units of the others.
            files = range(
                len(single) // family.unit_presses, -(-family.recordings // family.unit_presses)
            )
            cut.append(Unit(len(cut), index, len(single), len(family.presses), files))
    return tuple(cut)


def scenes(plan: Plan, family: Family, presses: tuple[Press, ...]) -> list[Scene]:
    """What is simulated: as the first sensor is mounted, with the modulus that all share."""
    lead = family.sensors[0]
    made = [lead.placed(named(press.indenter), press.motion, seed=plan.seed) for press in presses]
    if not _proportional(plan, lead):
        return made
    body = replace(lead.body, modulus=MODULUS)
    return [replace(scene, body=body) for scene in made]


def force_scale(plan: Plan, sensor: SimulatedSensor) -> float:
    """What forces of a family's scenes are multiplied by for one of its sensors."""
    return sensor.body.modulus / MODULUS if _proportional(plan, sensor) else 1.0


def _family(plan: Plan, sensors: tuple[SimulatedSensor, ...]) -> Family:
    made = (state_presses if plan.work == "states" else target_presses)(plan, sensors[0])
    of_one = sum(
        press.indenter == plan.indenters[0] and len(press.recordings) == 1 for press in made
    )
    # Units end with an indenter, so that every one of them is full.
    size = max(n for n in range(1, plan.unit_presses + 1) if of_one % n == 0)
    return Family(sensors, made, size)


def _deformation(plan: Plan, each: SimulatedSensor) -> Hashable:
    """Equal for sensors whose presses take the same shape."""
    body = replace(each.body, modulus=MODULUS) if _proportional(plan, each) else each.body
    life = each.life.mount, each.life.grip
    own = each.name if any(life) else ""
    return body, each.effects, each.film, each.speed, each.trajectory, each.force_depth, life, own


def _proportional(plan: Plan, each: SimulatedSensor) -> bool:
    """Whether forces are proportional to the modulus at the same deformation."""
    effects = each.effects
    massless = effects.inertia is None and effects.gravity is None
    return massless and plan.solving.scales_with_modulus
