"""The dashboard server (port 29999): one line asked, one line answered. Both ends of it.

The client asks only; it never unlocks a protective stop, which a person does at the pendant.
"""

from __future__ import annotations

import socket

from rig.arm.controller import PLAYING, RUNNING, VERSION, Controller
from rig.errors import DeviceLost

PORT = 29999
BANNER = "Connected: Universal Robots Dashboard Server\n"

_SAFETY = {1: "NORMAL", 3: "PROTECTIVE_STOP", 7: "ROBOT_EMERGENCY_STOP"}


def answer(controller: Controller, line: str) -> str:
    """The emulated server's answer to `line`, both without line end."""
    question = line.strip().lower()
    playing = controller.runtime_state == PLAYING
    safety = _SAFETY[int(controller.source("safety_mode")())]  # type: ignore[arg-type]
    if question == "stop":
        controller.stop_program("dashboard stop")
        return "Stopped"
    if question == "unlock protective stop":
        if safety == "PROTECTIVE_STOP":
            controller.reset_safety()
        return "Protective stop releasing"
    answers = {
        "polyscopeversion": f"URSoftware {'.'.join(map(str, VERSION))} (Jan 01 2024)",
        "get serial number": "20205500001",
        "get robot model": "UR5",
        "is in remote control": str(controller.remote_control).lower(),
        "robotmode": f"Robotmode: {'RUNNING' if controller.robot_mode == RUNNING else 'POWER_OFF'}",
        "safetystatus": f"Safetystatus: {safety}",
        "safetymode": f"Safetymode: {safety}",
        "running": f"Program running: {str(playing).lower()}",
        "programstate": f"{'PLAYING' if playing else 'STOPPED'} <unnamed>",
        "quit": "Disconnected",
    }
    return answers.get(question, f'could not understand: "{line.strip()}"')


def ask(host: str, questions: list[str], timeout: float) -> list[str]:
    """The dashboard's answers to `questions`, in order, over one connection.

    Raises:
        DeviceLost: No dashboard server at `host`, or it does not answer within `timeout` [s].
    """
    answers = []
    try:
        with (
            socket.create_connection((host, PORT), timeout) as connection,
            connection.makefile("rw", encoding="utf-8", newline="\n") as lines,
        ):
            lines.readline()
            for question in questions:
                lines.write(question + "\n")
                lines.flush()
                answers.append(lines.readline().strip())
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceLost(
            f"arm at {host}:{PORT} (dashboard): {error}; is the controller on and reachable?"
        ) from error
    if not all(answers):
        raise DeviceLost(f"arm at {host}:{PORT} (dashboard): closed the connection; try again")
    return answers
