"""`tactile page`: serve the page of a lab; nothing moves."""

import argparse
import os
from pathlib import Path

from recorder.command_line.errors import EXIT_DONE
from rig.cli.options import add_page, calibration_options, check_page, page_lines
from rig.monitor.access import DEFAULT_PORT, AccessPolicy

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
    add_page(parser, "--port", "address of the page", AccessPolicy(port=DEFAULT_PORT + 1))
    calibration_options(parser)


def run(options: argparse.Namespace) -> int:
    """Serve; return the exit code."""
    import asyncio

    from rig.core.clock import SystemClock
    from rig.monitor.access import urls_of
    from rig.monitor.lab import Folders
    from rig.monitor.server import PageServer

    access = options.port
    check_page("--port", access)
    if options.folder == SESSIONS:
        SESSIONS.mkdir(exist_ok=True)

    def ready(port: int) -> None:
        lines = page_lines(access, urls_of(access, port), "see all sessions")
        print("\n".join([*lines, "Ctrl-C ends the page"]), flush=True)

    # Recording has priority over all clients.
    os.nice(10)
    folders = Folders(options.folder, calibrations=options.calibrations)
    asyncio.run(PageServer(access, folders, SystemClock()).run(ready))
    return EXIT_DONE
