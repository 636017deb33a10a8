"""Run one emulator of a mock bench: of a device, the World, or its solver.

    python -m rig.mock.emulate netft '{"device": {"http_port": 8080}, "noise_n": 0.01}'
    python -m rig.mock.emulate camera '{"source": "images/", "device": {"rate_hz": 60}}'
    python -m rig.mock.emulate robotiq_2f --file gripper.json

Its settings are one JSON document, in which `device` has the keys of the device in a bench file; an
unknown key is refused with a list of all. The process prints `ready <name> <address>` once it
listens. It serves until SIGTERM or SIGINT, or with --until-stdin-closes until its parent exits,
then prints the number of ticks missed.
"""

import argparse
import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, get_type_hints

from rig.core.clock import SystemClock
from rig.core.config import READER
from rig.core.emulation import FaultPort, Served
from rig.core.errors import ConfigError
from rig.core.realtime import enable_realtime
from rig.devices import registry

# Modules of the emulators that are no device's; that of a device is named as its `kind`.
WORLDS = {
    "world": "rig.mock.world.host",
    "hand": "rig.mock.world.hand",
    "solver": "rig.mock.world.press_solver",
}
# Emulators in this package.
EMULATORS = {
    **{kind: device.emulator for kind, device in registry.DEVICES.items() if device.emulator},
    **WORLDS,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until terminated; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m rig.mock.emulate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", metavar="NAME", help=", ".join(EMULATORS))
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "document", nargs="?", default="{}", metavar="JSON", help="the settings (none)"
    )
    source.add_argument("--file", type=Path, help="file that holds them")
    parser.add_argument(
        "--until-stdin-closes", action="store_true", help="exit when the parent process does"
    )
    options = parser.parse_args(argv)
    try:
        module = EMULATORS.get(options.name) or registry.device(options.name).emulator
    except ConfigError as error:
        parser.error(str(error))
    emulate = import_module(module).emulate
    kind = get_type_hints(emulate)["settings"]
    try:
        document_name = str(options.file or options.name)
        document = READER.read(options.file) if options.file else options.document
        if isinstance(document, str):
            document = READER.parse(document, document_name)
        settings = READER.build(kind, document, document_name)
        device_kind = getattr(getattr(settings, "device", None), "KIND", options.name)
        if device_kind != options.name:
            raise ConfigError(
                f"{document_name}.device.kind: found {device_kind!r}; allowed: {options.name}"
            )
        served = emulate(settings, SystemClock())
    except (OSError, ValueError) as error:
        parser.error(str(error))
    return _serve(served, settings, until_stdin_closes=options.until_stdin_closes)


def _serve(served: Served, settings: Any, *, until_stdin_closes: bool) -> int:
    """Run an emulator until the process is stopped; return 2 if it cannot listen, else its code."""
    name, emulator = served.name, served.emulator
    enable_realtime(served.priority)
    logging.basicConfig(stream=sys.stderr, format=f"{name}: %(message)s")
    ending = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, lambda *_: ending.set())
    if until_stdin_closes:
        threading.Thread(target=_watch_stdin, args=(ending,), daemon=True).start()
    faults = None
    try:
        emulator.start()
    except OSError as error:
        print(f"{name}: cannot listen on {emulator.address}: {error}", file=sys.stderr)
        return 2
    try:
        if served.apply is not None and settings.fault_port is not None:
            faults = FaultPort(settings.host, settings.fault_port, served.apply)
    except OSError as error:
        emulator.close()
        print(f"{name}: cannot listen on its fault port: {error}", file=sys.stderr)
        return 2
    try:
        print(f"ready {name} {emulator.address}", flush=True)
        # Short waits, because signal handlers run only between two of them.
        while not ending.wait(0.2):
            pass
    finally:
        if faults is not None:
            faults.close()
        emulator.close()
        print(f"{name}: {emulator.missed} ticks missed", file=sys.stderr, flush=True)
    return 0 if served.conclude is None else served.conclude()


def _watch_stdin(ending: threading.Event) -> None:
    # os.read, not sys.stdin: a daemon thread must not hold the lock of a buffered stream at exit.
    while os.read(0, 4096):
        pass
    ending.set()


if __name__ == "__main__":
    sys.exit(main())
