"""Faults to inject into a running arm emulator: `make faults`, and the tests.

The fault port takes one JSON object a line and answers each with one: {"fault": NAME, ...}.

    protective_stop, emergency_stop, stop_program
    reset_safety         what a person does at the pendant afterwards
    drop                 close every RTDE connection
    freeze  seconds      RTDE mute for so long, connections stay; the arm goes on
    slider  fraction     speed slider
    remote_control  on   false: the pendant is in local control
    state                nothing; like every answer, it tells how the controller is
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from typing import Any, Protocol

from rig.arm.controller import Controller

PORT = 31000


class Network(Protocol):
    """What the emulator's connections can be made to do."""

    def drop(self) -> None:
        """Close every RTDE connection."""

    def freeze(self, seconds: float) -> None:
        """Neither send nor read RTDE for so long [s]."""


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
        "state": lambda: None,
    }
    if fault not in actions:
        raise ValueError(f"fault: found {fault!r}; known: {', '.join(actions)}")
    actions[fault]()
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
    }


def answer(controller: Controller, network: Network, line: str) -> str:
    """The fault port's answer to one line."""
    try:
        request = json.loads(line)
        return json.dumps({"ok": True, **apply(controller, network, **request)})
    except (ValueError, KeyError, TypeError) as error:
        return json.dumps({"ok": False, "error": f"{type(error).__name__}: {error}"})


def inject(host: str, fault: str, **values: Any) -> dict[str, Any]:
    """Inject a fault into the emulator at `host` and return how its controller is.

    Raises:
        OSError: No emulator there.
        ValueError: The emulator does not know the fault, or misses a value.
    """
    with (
        socket.create_connection((host, PORT), 5.0) as connection,
        connection.makefile("rw", encoding="utf-8", newline="\n") as lines,
    ):
        lines.write(json.dumps({"fault": fault, **values}) + "\n")
        lines.flush()
        reply: dict[str, Any] = json.loads(lines.readline())
    if not reply.pop("ok"):
        raise ValueError(f"fault {fault!r} {values}: {reply['error']}")
    return reply
