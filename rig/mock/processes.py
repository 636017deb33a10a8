"""Emulator processes: each prints a ready line, writes a log, and ends with its parent."""

from __future__ import annotations

import json
import os
import re
import selectors
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from recorder.command_line.extras import extra_of
from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError, DeviceLost

# Interpreters start one after the other on a small machine [s].
_READY_TIMEOUT = 30.0
_END_TIMEOUT = 5.0
# The processes share the cores with each other and with the rig: none may use several threads for a
# matrix product, or busy-wait for the others.
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class ProcessGroup:
    """Group of processes, each running `rig.mock.emulate`; a context manager.

    Everything that was started is closed, even if the start fails half-way.

    Args:
        folder: Run folder; `<name>.json` holds the settings of each process, `<name>.log` its
            stderr.
        clock: Clock.
    """

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._folder = folder
        self._clock = clock
        self.processes: dict[str, subprocess.Popen[str]] = {}
        """The processes, by name."""

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self) -> None:
        """Launch the processes, and start what belongs to them."""
        raise NotImplementedError

    def _launch(self, documents: Mapping[str, tuple[str, Mapping[str, Any]]]) -> None:
        """Start emulators, and wait until each has printed that it listens.

        Args:
            documents: Emulator in `rig.mock.emulate` and its settings, by the name of the process.
        """
        for name, (_, settings) in documents.items():
            (self._folder / f"{name}.json").write_text(json.dumps(settings))
        for name, (emulator, _) in documents.items():
            file = str(self._folder / f"{name}.json")
            command = ["-m", "rig.mock.emulate", emulator, "--file", file, "--until-stdin-closes"]
            with (self._folder / f"{name}.log").open("w") as log:
                self.processes[name] = subprocess.Popen(
                    [sys.executable, *command],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    env={**os.environ, **_ONE_THREAD},
                    # Ctrl-C is handled by the parent, which ends the processes last.
                    start_new_session=True,
                )
        for name, process in self.processes.items():
            stdout = process.stdout
            if stdout is None:
                raise RuntimeError(f"{name}: started without a pipe")
            deadline_ns = self._clock.now_ns() + round(_READY_TIMEOUT * SECOND_NS)
            with selectors.DefaultSelector() as selector:
                selector.register(stdout, selectors.EVENT_READ)
                selector.select((deadline_ns - self._clock.now_ns()) / SECOND_NS)
                line = stdout.readline() if selector.select(0) else ""
            if not line.startswith("ready"):
                word = self.last_word(name)
                missing = re.match(r"ModuleNotFoundError: No module named '([\w.]+)'", word)
                if missing and (extra := extra_of(missing[1], "rig")):
                    raise ConfigError(
                        f"{name} emulator: {missing[1]} is not installed; install the extra: "
                        f"pip install 'tactile-rig[{extra}]'"
                    )
                raise DeviceLost(f"{name} emulator did not start: {word}")

    def check(self) -> None:
        """Raise if a process has ended by itself."""
        for name, process in self.processes.items():
            if process.poll() is not None:
                word = self.last_word(name)
                raise DeviceLost(f"{name}: its emulator ended (code {process.returncode}): {word}")

    def last_word(self, name: str) -> str:
        """Return the last line that a process wrote to stderr."""
        lines = (self._folder / f"{name}.log").read_text().strip().splitlines()
        return lines[-1] if lines else "no output"

    def close(self) -> None:
        """End all processes; may be called twice."""
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(_END_TIMEOUT)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
