"""Faults to inject into a running arm emulator: `make faults`, and the tests.

The fault port (rig.core.emulation) knows those of the controller, and those of its line, which are
in rig.core.fault_injection (freeze is the controller's own: it does not read either).

    protective_stop, emergency_stop, stop_program
    reset_safety         what a person does at the pendant afterwards
    drop                 close every RTDE connection
    freeze  seconds      RTDE mute for so long, connections stay; the arm goes on
    slider  fraction     speed slider
    remote_control  on   false: the pendant is in local control
    state                nothing; like every answer, it tells how the controller is
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rig.core import emulation
from rig.core.fault_injection import FAULTS
from rig.devices.arm.emulated_controller import Controller

PORT = emulation.PORTS["arm"]

_OF_THE_LINE = (*(fault for fault in FAULTS if fault != "freeze"), "replug", "clear")


class Network(Protocol):
    """What the emulator's connections can be made to do."""

    def drop(self) -> None:
        """Close every RTDE connection."""

    def freeze(self, seconds: float) -> None:
        """Neither send nor read RTDE for so long [s]."""

    def disturb(self, fault: str, **values: Any) -> dict[str, Any]:
        """See `rig.core.fault_injection.Disturbance.inject`."""


def apply(controller: Controller, network: Network, fault: str, **values: Any) -> dict[str, Any]:
    """Inject one fault and tell how the controller is.

    Raises:
        ValueError: No such fault.
        KeyError: A value the fault needs is missing.
    """

    def set_slider() -> None:
        controller.robot.slider = float(values["fraction"])

    def set_remote() -> None:
        controller.remote_control = bool(values["on"])

    actions: dict[str, Callable[[], None]] = {
        "protective_stop": lambda: controller.protective_stop("injected"),
        "emergency_stop": controller.emergency_stop,
        "stop_program": lambda: controller.stop_program("injected"),
        "reset_safety": controller.reset_safety,
        "drop": network.drop,
        "freeze": lambda: network.freeze(float(values["seconds"])),
        "slider": set_slider,
        "remote_control": set_remote,
    }
    line: dict[str, Any] = {}
    if fault in _OF_THE_LINE or fault == "state":
        line = network.disturb(fault, **values)
    elif fault in actions:
        actions[fault]()
    else:
        known = ", ".join((*actions, *_OF_THE_LINE, "state"))
        raise ValueError(f"fault: found {fault!r}; known: {known}")
    robot = controller.robot
    return {
        "tick": controller.tick,
        "pose": robot.pose.tolist(),
        "speed": robot.speed.tolist(),
        "tcp": robot.tcp.tolist(),
        "payload": controller.payload,
        "runtime_state": controller.runtime_state,
        "safety_status": controller.safety_status,
        "reason": controller.reason,
        "uploads": controller.uploads,
        **line,
    }


def answer(controller: Controller, network: Network, line: str) -> str:
    """The fault port's answer to one line."""
    return emulation.answer(lambda **request: apply(controller, network, **request), line)


def inject(host: str, fault: str, **values: Any) -> dict[str, Any]:
    """Inject a fault into the emulator at `host` and return how its controller is.

    Raises:
        OSError: No emulator there.
        ValueError: The emulator does not know the fault, or misses a value.
    """
    return emulation.inject(host, PORT, fault, **values)
