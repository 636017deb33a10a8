"""The emulators of one replayed run: a process for each stream."""

from __future__ import annotations

import selectors
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rig.clock import SECOND_NS, Clock
from rig.errors import DeviceLost
from rig.replay.cue import CUE, FAILED, POSITION, cue_path, position_path
from rig.shared import LatestRecord

_READY_TIMEOUT = 30.0
# Interpreters start one after the other on a small machine [s].
_END_TIMEOUT = 5.0


class Players:
    """Starts, cues and ends the emulators of a run, as a context manager.

    Args:
        session: The source.
        names: Streams to play.
        run: Which of its runs.
        host: Loopback address to listen on.
        folder: Empty run folder.
        clock: Clock.
        speed: Times the recorded one; 0: as fast as read.
    """

    def __init__(
        self,
        session: Path,
        names: tuple[str, ...],
        run: int,
        host: str,
        folder: Path,
        clock: Clock,
        *,
        speed: float,
    ) -> None:
        self._folder = folder
        self._clock = clock
        self._cue = LatestRecord.create(cue_path(folder), CUE)
        self._positions = {
            name: LatestRecord.create(position_path(folder, name), POSITION) for name in names
        }
        self._processes: dict[str, subprocess.Popen[str]] = {}
        self._options = [
            *("--session", str(session), "--run", str(run), "--folder", str(folder)),
            *("--host", host, "--speed", repr(speed), "--with", ",".join(names)),
            "--until-stdin-closes",
        ]

    def __enter__(self) -> Players:
        try:
            for name in self._positions:
                self._start(name)
            for name in self._positions:
                self._wait_ready(name)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def cue(self, start_ns: int) -> None:
        """Start the tape at `start_ns`: every driver is open, every writer records."""
        self._cue.write((start_ns,))

    def wake(self) -> None:
        """The second cue: no further row; readers that wait for one are made to look up."""
        while self._cue.count < 2:
            self._cue.write((0,))

    def positions(self) -> Mapping[str, np.void | None]:
        """POSITION of each emulator, None before it has told one."""
        return {name: record.read() for name, record in self._positions.items()}

    def check(self) -> None:
        """Notice an emulator that ended or failed.

        Raises:
            DeviceLost: Names it, with its last word.
        """
        for name, process in self._processes.items():
            if process.poll() is not None:
                word = self._last_word(name)
                raise DeviceLost(f"{name}: its emulator ended (code {process.returncode}): {word}")
            position = self._positions[name].read()
            if position is not None and position["state"] == FAILED:
                raise DeviceLost(f"{name}: its emulator failed: {self._last_word(name)}")

    def close(self) -> None:
        """End every emulator; safe twice."""
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            try:
                process.wait(_END_TIMEOUT)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
        self._processes = {}
        for record in (self._cue, *self._positions.values()):
            record.close()
        self._positions = {}

    def _start(self, name: str) -> None:
        command = [sys.executable, "-m", "rig.replay.player", "--stream", name, *self._options]
        with (self._folder / f"{name}.log").open("w") as log:
            self._processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                # Ctrl-C is for the replaying process, which ends them in order.
                start_new_session=True,
            )

    def _wait_ready(self, name: str) -> None:
        stdout = self._processes[name].stdout
        if stdout is None:
            raise RuntimeError(f"{name}: started without a pipe")
        deadline_ns = self._clock.now_ns() + round(_READY_TIMEOUT * SECOND_NS)
        with selectors.DefaultSelector() as selector:
            selector.register(stdout, selectors.EVENT_READ)
            selector.select((deadline_ns - self._clock.now_ns()) / SECOND_NS)
            line = stdout.readline() if selector.select(0) else ""
        if not line.startswith("ready"):
            raise DeviceLost(f"{name}: its emulator did not start: {self._last_word(name)}")

    def _last_word(self, name: str) -> str:
        lines = (self._folder / f"{name}.log").read_text().strip().splitlines()
        return lines[-1] if lines else "no word from it"
