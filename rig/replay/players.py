"""The emulators of one replayed run: a process for each stream."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rig.clock import Clock
from rig.errors import DeviceLost
from rig.launched import Launched
from rig.replay.cue import CUE, FAILED, POSITION, cue_path, position_path
from rig.shared import LatestRecord


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
        self._launched = Launched(folder, clock)
        self._cue = LatestRecord.create(cue_path(folder), CUE)
        self._positions = {
            name: LatestRecord.create(position_path(folder, name), POSITION) for name in names
        }
        self._options = [
            *("--session", str(session), "--run", str(run), "--folder", str(folder)),
            *("--host", host, "--speed", repr(speed), "--with", ",".join(names)),
        ]

    def __enter__(self) -> Players:
        try:
            for name in self._positions:
                self._launched.start(name, ["rig.replay.player", "--stream", name, *self._options])
            self._launched.wait_ready()
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
        self._launched.check()
        for name, record in self._positions.items():
            position = record.read()
            if position is not None and position["state"] == FAILED:
                raise DeviceLost(f"{name}: its emulator failed: {self._launched.last_word(name)}")

    def close(self) -> None:
        """End every emulator; safe twice."""
        self._launched.close()
        for record in (self._cue, *self._positions.values()):
            record.close()
        self._positions = {}
