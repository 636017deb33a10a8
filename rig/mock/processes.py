"""Emulator processes started together: each says when it is ready, has a log, and ends with us."""

from __future__ import annotations

import os
import selectors
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError, DeviceLost

_READY_TIMEOUT = 30.0
# Interpreters start one after the other on a small machine [s].
_END_TIMEOUT = 5.0
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
# They share the cores among them and with the rig: none of them may spread a product of matrices
# over all of them, let alone wait for the others busily.


class Launched:
    """Processes that `rig.core.emulation.serve` serves in.

    Args:
        folder: Run folder; `<name>.log` is what each says on stderr.
        clock: Clock.
    """

    def __init__(self, folder: Path, clock: Clock) -> None:
        self._folder = folder
        self._clock = clock
        self.processes: dict[str, subprocess.Popen[str]] = {}
        """By name."""

    def start(self, name: str, arguments: Sequence[str]) -> None:
        """Start `python -m` with `arguments`: the module and its options."""
        with (self._folder / f"{name}.log").open("w") as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, "-m", *arguments, "--until-stdin-closes"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env={**os.environ, **_ONE_THREAD},
                # Ctrl-C is for whoever started them, and who ends them last.
                start_new_session=True,
            )

    def wait_ready(self) -> None:
        """Wait until each has said that it listens.

        Raises:
            ConfigError: One lacks a library, of an extra that is not installed.
            DeviceLost: One did not, with its last word.
        """
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
                if word.startswith("ModuleNotFoundError"):
                    extra = "nidaq" if "nidaqmx" in word or "grpc" in word else "rig"
                    raise ConfigError(
                        f"{name} emulator: {word}; install the extra: "
                        f"pip install 'tactile-rig[{extra}]'"
                    )
                raise DeviceLost(f"{name} emulator did not start: {word}")

    def check(self) -> None:
        """Notice one that ended on its own.

        Raises:
            DeviceLost: Names it, with its last word.
        """
        for name, process in self.processes.items():
            if process.poll() is not None:
                word = self.last_word(name)
                raise DeviceLost(f"{name}: its emulator ended (code {process.returncode}): {word}")

    def last_word(self, name: str) -> str:
        """The last line it said on stderr."""
        lines = (self._folder / f"{name}.log").read_text().strip().splitlines()
        return lines[-1] if lines else "no word from it"

    def close(self) -> None:
        """End them all; safe twice."""
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


class StartedOrClosed:
    """A context manager that closes what it has started, also when the start fails half-way."""

    def _start(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        """End what was started; safe twice."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
