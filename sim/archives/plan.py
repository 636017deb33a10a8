"""What an archive of simulated sensors is made from: one frozen value, stored in the archive."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from sim.archives.solving import Solving
from sim.checks import check_range
from sim.errors import SceneError
from sim.indenters import NAMES
from sim.sensors import CameraSignal, SimulatedSensor
from sim.stored import from_json, to_json

Work = Literal["states", "targets"]

UNSEEN = ("sphere_s", "triangle", "pacman", "cone", "wave", "torus")
"""Indenters that models of the paper are tested on and never trained on."""
STEPS_MAX = 1000
UNIT_PRESSES = 9
"""Presses that are solved and written together at most: the nine places of the paper's states."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that decides what an archive holds, byte by byte on one kind of machine.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    work: Work
    """`states`: presses at nine places to five depths; `targets`: the sensors' recorded presses."""
    sensors: tuple[SimulatedSensor, ...]
    """Rows of `sim.sensors`, with different names."""
    indenters: tuple[str, ...] = NAMES
    """Names, in the order of `sim.indenters.NAMES`."""
    solving: Solving = field(default_factory=Solving)
    """How presses are solved."""
    seed: int = 0
    """Of everything that is drawn."""
    steps: int = 10
    """Frames of a phase of a target; states have none."""
    share: float = 1.0
    """Share of the targets that is taken, spread evenly over points, depths and directions."""
    unit_presses: int = UNIT_PRESSES
    """Presses of one indenter whose frames share a file, at most."""
    together: int = UNIT_PRESSES
    """Presses that are solved in one call, at most, but whole files: a GPU wants many."""

    def __post_init__(self) -> None:
        if self.work not in get_args(Work):
            raise SceneError(f"plan.work: {self.work!r}; allowed: {get_args(Work)}")
        _check_names("sensors", [each.name for each in self.sensors])
        _check_names("indenters", list(self.indenters))
        if unknown := [name for name in self.indenters if name not in NAMES]:
            raise SceneError(f"plan.indenters: {unknown}; allowed: {', '.join(NAMES)}")
        if self.indenters != tuple(name for name in NAMES if name in self.indenters):
            raise SceneError(f"plan.indenters: {self.indenters}; allowed: in the order of {NAMES}")
        check_range("plan", "seed", self.seed, 0, 2**32)
        check_range("plan", "steps", self.steps, 1, STEPS_MAX)
        check_range("plan", "share", self.share, 0.0, 1.0, open_low=True)
        check_range("plan", "unit_presses", self.unit_presses, 1, 10_000)
        check_range("plan", "together", self.together, 1, 100_000)
        for each in self.sensors:
            if self.work == "targets" and each.trajectory is None:
                raise SceneError(f"{each.name}.trajectory: None; allowed: a sensor that has one")
            if self.work == "states" and not isinstance(each.signal, CameraSignal):
                raise SceneError(f"{each.name}.signal: taxels; allowed for states: a camera")
        _check_names(
            "names in the archive", [name for each in self.sensors for name in names(each)]
        )

    def document(self) -> dict[str, Any]:
        """The plan as plain JSON values."""
        return to_json(self)

    @classmethod
    def of(cls, document: Any) -> Plan:
        """The plan that `document` gave.

        Raises:
            SceneError: Not such a document.
        """
        return from_json(cls, document, "plan")


def names(sensor: SimulatedSensor) -> tuple[str, ...]:
    """What a sensor is called in an archive: by its patterns where they are all that matters."""
    signal = sensor.signal
    simulated = sensor.trajectory is None
    if isinstance(signal, CameraSignal) and (simulated or len(signal.patterns) > 1):
        return signal.patterns
    return (sensor.name,)


def code(indenter: str) -> int:
    """Code of an indenter in every archive, a part of them or not."""
    return NAMES.index(indenter)


def differing(one: dict[str, Any], other: dict[str, Any], where: str = "") -> list[str]:
    """Keys in which two documents of plans differ, down to the innermost: `sensors[0].seed`."""
    found: list[str] = []
    for key in sorted(one.keys() | other.keys()):
        found += _differing(one.get(key, ...), other.get(key, ...), f"{where}{key}")
    return found


def _differing(one: Any, other: Any, where: str) -> list[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        return differing(one, other, f"{where}.")
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = enumerate(zip(one, other, strict=True))
        return [key for i, pair in pairs for key in _differing(*pair, f"{where}[{i}]")]
    return [] if one == other else [where]


def _check_names(what: str, found: list[str]) -> None:
    if not found or len(set(found)) != len(found):
        raise SceneError(f"plan.{what}: {found}; allowed: one or more, all different")
