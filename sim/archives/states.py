"""The paper's simulated states: 18 indenters, 9 places, 5 depths, a location each."""

from __future__ import annotations

from dataclasses import replace

from sim.archives.plan import Plan, code
from sim.archives.press import NO_PHASE, Press, Recording
from sim.effects import Friction
from sim.motion import press
from sim.paper_presses import DEPTHS_MM, FRICTION, PLACES_MM
from sim.sensors import CameraSignal, SimulatedSensor, sensor

PLACES = tuple((x, y) for x in PLACES_MM for y in PLACES_MM)
"""Where the tip goes down, x and y [mm]; the target is the number of the place."""
STATES = len(PLACES) * len(DEPTHS_MM)
"""States of one indenter."""


def gel(patterns: tuple[str, ...] | None = None) -> SimulatedSensor:
    """The paper's gel with the friction of its presses, under some patterns or all 12.

    Raises:
        SceneError: An unknown pattern.
    """
    each = sensor("gel")
    each = replace(each, effects=replace(each.effects, friction=Friction(FRICTION)))
    if patterns is None or not isinstance(each.signal, CameraSignal):
        return each
    return replace(each, signal=replace(each.signal, patterns=patterns))


def state_presses(plan: Plan, each: SimulatedSensor) -> tuple[Press, ...]:
    """All presses of a sensor: indenter by indenter, each to all depths at all places."""
    return tuple(
        _press(each, indenter, target)
        for indenter in plan.indenters
        for target in range(len(PLACES))
    )


def _press(each: SimulatedSensor, indenter: str, target: int) -> Press:
    x, y = PLACES[target]
    motion = press([depth / 1e3 for depth in DEPTHS_MM], at=(x / 1e3, y / 1e3), speed=each.speed)
    count = len(DEPTHS_MM)
    number = code(indenter) * len(PLACES) + target
    recording = Recording(
        target=target,
        number=number,
        session_point=0,
        # The first frame of the motion only touches.
        frames=tuple(range(1, count + 1)),
        phases=(NO_PHASE,) * count,
        locations=tuple(number * count + depth for depth in range(count)),
    )
    return Press(indenter, motion, (recording,))
