"""Client of the dashboard server (port 29999): one line per question and per answer.

The client only asks; it never unlocks a protective stop, which a person does at the pendant.
"""

import socket

from rig.core.errors import DeviceLost

PORT = 29999
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
