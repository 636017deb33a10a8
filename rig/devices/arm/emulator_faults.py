"""Faults to inject into a running arm emulator, used by `benchmarks faults` and the tests.

The fault port (rig.core.emulation) accepts the faults of the controller below, and those of its
line in rig.core.fault_injection (freeze is the controller's own: it stops reading too).

    protective_stop, emergency_stop, stop_program
    reset_safety         release at the pendant, as a person does afterwards
    drop                 close every RTDE connection
    freeze  seconds      suspend RTDE for so long; connections stay, the arm keeps moving
    slider  fraction     speed slider
    remote_control  on   false: the pendant is in local control
    version  parts       of PolyScope, four numbers
    tool  mass           true mass on the flange [kg], whichever payload is set
    freedrive  pose      a person leads the TCP to this pose [m, rad]
    state                no fault; returns the controller's state, as every answer does
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from rig.core import emulation
from rig.core.fault_injection import FAULTS
from rig.core.mock_names import PORTS
from rig.devices.arm.emulated_controller import Controller

PORT = PORTS["arm"]

_OF_THE_LINE = (*(fault for fault in FAULTS if fault != "freeze"), "replug", "clear")


class Network(Protocol):
    """Interface to the faults of the emulator's connections."""

    def drop(self) -> None:
        """Close every RTDE connection."""

    def freeze(self, seconds: float) -> None:
        """Suspend RTDE for `seconds` [s], both ways."""

    def disturb(self, fault: str, **values: Any) -> dict[str, Any]:
        """See `rig.core.fault_injection.FaultInjector.inject`."""


def apply(controller: Controller, network: Network, fault: str, **values: Any) -> dict[str, Any]:
    """Inject one fault and return the controller's state."""

    def set_slider() -> None:
        controller.robot.slider = float(values["fraction"])

    def set_remote() -> None:
        controller.remote_control = bool(values["on"])

    def set_version() -> None:
        major, minor, bugfix, build = map(int, values["parts"])
        controller.version = (major, minor, bugfix, build)

    def set_tool() -> None:
        controller.tool_mass = float(values["mass"])

    actions: dict[str, Callable[[], None]] = {
        "protective_stop": lambda: controller.protective_stop("injected"),
        "emergency_stop": controller.emergency_stop,
        "stop_program": lambda: controller.stop_program("injected"),
        "reset_safety": controller.reset_safety,
        "drop": network.drop,
        "freeze": lambda: network.freeze(float(values["seconds"])),
        "slider": set_slider,
        "remote_control": set_remote,
        "version": set_version,
        "tool": set_tool,
        "freedrive": lambda: controller.lead(np.array(values["pose"], np.float64)),
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
    """Return the fault port's answer to one line."""
    return emulation.answer(lambda **request: apply(controller, network, **request), line)


def inject(host: str, fault: str, **values: Any) -> dict[str, Any]:
    """Inject a fault into the emulator at `host` and return the state of its controller."""
    return emulation.inject(host, PORT, fault, **values)
