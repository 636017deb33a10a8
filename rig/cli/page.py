"""`tactile page`: serve the workbench of a lab; nothing moves."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from recorder.command_line.errors import EXIT_DONE
from recorder.command_line.options import whole
from rig.cli.options import benches_option, calibration_options
from rig.monitor.page.access import DEFAULT_PORT, LOOPBACK_HOST

# Default folder of sessions, which is made if it is missing.
SESSIONS = Path("sessions")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Serves a page for the browser until Ctrl-C: finished sessions with search and replay, "
        "targets to record again, campaigns, indenters, benches and their set-up. No device is "
        "opened and nothing moves: what moves an arm is shown as a command to type at the bench."
    )
    parser.epilog = "Example: tactile page sessions"
    parser.add_argument(
        "folder",
        type=Path,
        nargs="?",
        default=SESSIONS,
        help="folder of sessions, searched with its subfolders (%(default)s)",
    )
    parser.add_argument(
        "--port",
        type=whole(0, 0xFFFF),
        default=DEFAULT_PORT + 1,
        metavar="PORT",
        help="port (%(default)s; 0: any free port)",
    )
    parser.add_argument(
        "--host",
        default=LOOPBACK_HOST,
        metavar="ADDRESS",
        help="address to serve on (default: %(default)s, this machine only; any other address "
        "requires a token, which is printed)",
    )
    parser.add_argument(
        "--campaigns",
        type=Path,
        default=Path("campaigns"),
        metavar="DIR",
        help="folder of campaign files (%(default)s)",
    )
    benches_option(parser)
    calibration_options(parser)


def run(options: argparse.Namespace) -> int:
    """Serve; return the exit code.

    Raises:
        ConfigError: The port or the address cannot be used.
        SessionError: No such folder.
    """
    import asyncio

    from rig.core.clock import SystemClock
    from rig.monitor.page.access import AccessPolicy, is_loopback, urls_of
    from rig.monitor.workbench.lab import Lab, Places
    from rig.monitor.workbench.server import WorkbenchServer

    if options.folder == SESSIONS:
        SESSIONS.mkdir(exist_ok=True)
    places = Places(options.folder, options.campaigns, options.benches, options.calibrations)
    access = AccessPolicy(options.host, options.port)

    def ready(port: int) -> None:
        for url in urls_of(access, port):
            print(f"open {url}; Ctrl-C ends the page", flush=True)
        if not is_loopback(access.host):
            print("whoever has this address can see all sessions: it is not encrypted", flush=True)

    # Recording has priority over all clients.
    os.nice(10)
    asyncio.run(WorkbenchServer(Lab(places, SystemClock()), access).run(ready))
    return EXIT_DONE
