"""Client of the dashboard server (port 29999): one line per question and per answer.

The client only asks; it never unlocks a protective stop, which a person does at the pendant.
"""

import re
import socket

from rig.core.errors import DeviceLost, SafetyStop

PORT = 29999
# Oldest PolyScope that says here if remote control is on.
OLDEST = (5, 6)
UPDATE = f"{OLDEST[0]}.{OLDEST[1]} or newer (Settings > System > Update)"
BANNER = "Connected: Universal Robots Dashboard Server\n"


def ask(host: str, questions: list[str], timeout: float) -> list[str]:
    """Return the dashboard's answers to `questions`, in order, over one connection."""
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


def check_ready(host: str, timeout: float) -> None:
    """Check that a controller is powered, under no stop, and not known to be in local control.

    Raises:
        SafetyStop: A stop must be released by a person.
        DeviceLost: It does not answer, has no power, or is in local control.
    """
    questions = ["robotmode", "safetystatus", "is in remote control"]
    mode, safety, remote = ask(host, questions, timeout)
    if not safety.endswith((" NORMAL", " REDUCED")):
        kind = "emergency stop" if "EMERGENCY" in safety else "safety stop"
        raise SafetyStop(
            f"{kind}: arm at {host}: {safety}: make the bench safe, then release it at the pendant"
        )
    if not mode.endswith(" RUNNING"):
        raise DeviceLost(f"arm at {host}: {mode}: power it on, brakes off, at the pendant")
    if remote == "false":
        raise DeviceLost(f"arm at {host}: in local control: switch to Remote at the pendant")


def age_note(version: str) -> str:
    """Return a note for a version that does not say if remote control is on; empty for others."""
    number = re.search(r"(\d+)\.(\d+)", version)
    if number is None or (int(number[1]), int(number[2])) >= OLDEST:
        return ""
    return f"PolyScope {version} does not say if remote control is on: update it to {UPDATE}"
