"""One emulated device that plays a recorded stream, at its times or as fast as it is read.

    python -m rig.mock.player --session x.zarr --stream force --folder RUN --host 127.0.0.5

Whatever the speed, a row is sent only while fewer than `Outlet.window` rows are under way: the
reader's count of samples is read from shared memory, so no socket and no inbox ever overflows. At
maximum speed the emulators keep step besides: none is more than `STEP_NS` of recorded time ahead of
what the slowest reader has taken.
"""

from __future__ import annotations

import argparse
import logging
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from recorder import Session
from rig.core.clock import SECOND_NS, Clock, SystemClock
from rig.core.emulation import loopback, serve
from rig.core.realtime import CAMERA_PRIORITY, DEVICE_PRIORITY
from rig.core.samples import CAMERA_LATEST, FORCE_LATEST, POSE_LATEST, TAXELS_LATEST
from rig.core.shared_memory import LatestRecord
from rig.devices.playback.wire import Tape, load_tape
from rig.mock.cue import (
    CUE,
    ENDED,
    FAILED,
    FAR_NS,
    PLAYING,
    POSITION,
    WAITING,
    cue_path,
    position_path,
)

# An emulated device as its tape is played: how a row gets onto the wire.


class Outlet(Protocol):
    """What plays one stream.

    A driver that connects is given what it needs to open, and no row.
    """

    window: int
    """Rows that may be under way to the reader."""

    @property
    def address(self) -> str:
        """What a driver connects to."""

    def start(self) -> None:
        """Listen; raises OSError when the address cannot be had."""

    def send(self, place: int) -> None:
        """Send row `place` of the tape; raises OSError when the client is gone."""

    def idle(self) -> None:
        """Called about 20 times a second while no row is due."""

    def wake(self) -> None:
        """Make a reader that waits for a row look up, without a row: it is about to close."""

    def close(self) -> None:
        """Stop; safe twice."""


def make_outlet(name: str, tape: Tape, host: str) -> Outlet:
    """The emulated device of one stream; its vendor library is imported here and nowhere else."""
    if name == "force":
        from rig.devices.playback.netft_player import NetFtOutlet

        return NetFtOutlet(tape, host)
    if name == "pose":
        from rig.devices.playback.rtde_player import RtdeOutlet

        return RtdeOutlet(tape, host)
    if name == "taxels":
        from rig.devices.playback.xela_player import XelaOutlet

        return XelaOutlet(tape, host)
    from rig.devices.playback.mjpeg_player import MjpegOutlet

    return MjpegOutlet(tape, host)


logger = logging.getLogger(__name__)

STEP_NS = SECOND_NS // 50
_NAP_NS = 200_000
_SLICE_NS = SECOND_NS // 20
_WAKE_PAUSES = (0.05, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
# Less than the 10 spoilt frames in a row after which a camera counts as lost [s].
_LATEST: dict[str, np.dtype[Any]] = {
    "force": FORCE_LATEST,
    "pose": POSE_LATEST,
    "taxels": TAXELS_LATEST,
    "camera": CAMERA_LATEST,
}


class Player:
    """Plays a tape through an outlet, in a thread of its own.

    Args:
        name: Name of the stream.
        tape: What to play.
        outlet: Where to.
        folder: Run folder with the shared records.
        clock: Paces.
        speed: Times the recorded speed; 0: as fast as it is read.
        others: Streams to keep step with at maximum speed.
    """

    missed = 0
    """Rows are sent late rather than left out."""

    def __init__(
        self,
        name: str,
        tape: Tape,
        outlet: Outlet,
        folder: Path,
        clock: Clock,
        *,
        speed: float,
        others: Sequence[str] = (),
    ) -> None:
        self._name = name
        self._tape = tape
        self._outlet = outlet
        self._folder = folder
        self._clock = clock
        self._speed = speed
        self._others = tuple(others)
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._cue = LatestRecord.attach(cue_path(folder), CUE)
        path = position_path(folder, name)
        self._position = LatestRecord.attach(path, POSITION, writable=True)
        self._sent = 0

    @property
    def address(self) -> str:
        """What a driver connects to."""
        return self._outlet.address

    def start(self) -> None:
        """Listen, and wait for the cue.

        Raises:
            OSError: The address cannot be had.
        """
        self._outlet.start()
        self._thread = threading.Thread(target=self._run, name=f"player-{self._name}")
        self._thread.start()

    def close(self) -> None:
        """Stop; safe twice."""
        self._ending.set()
        self._outlet.close()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        try:
            self._tell(WAITING, 0)
            start_ns = self._cued()
            if start_ns is not None:
                self._play(start_ns)
            self._stay()
        except Exception as error:
            # Whatever it is, the replay must hear of it: this thread is all the device there is.
            if not self._ending.is_set():
                self._tell(FAILED, FAR_NS)
                logger.error("after row %d: %s", self._sent - 1, error)

    def _tell(self, state: int, t_ns: int) -> None:
        self._position.write((state, self._sent, t_ns))

    @property
    def _over(self) -> bool:
        """Whether the replay has ended: the second cue says so."""
        return self._cue.count > 1 or self._ending.is_set()

    def _cued(self) -> int | None:
        while not self._ending.wait(_SLICE_NS / SECOND_NS / 10):
            cue = self._cue.read()
            if cue is not None:
                return None if self._over else int(cue["start_ns"])
            self._outlet.idle()
        return None

    def _stay(self) -> None:
        """Keep the client until the replay has ended, then help it to close."""
        while not self._over:
            self._outlet.idle()
            self._ending.wait(_SLICE_NS / SECOND_NS)
        for pause in _WAKE_PAUSES:
            if self._ending.wait(pause):
                return
            self._outlet.wake()

    def _play(self, start_ns: int) -> None:
        times = self._tape.t_ns
        latest = LatestRecord.attach(self._folder / f"{self._name}.latest", _LATEST[self._name])
        step = _Step(self._folder, self._others if self._speed == 0 else ())
        base = latest.count
        try:
            for place in range(len(times)):
                if self._speed > 0:
                    self._sleep_until(start_ns + round(int(times[place]) / self._speed))

                def turn(place: int = place) -> bool:
                    taken = latest.count - base
                    self._tell(PLAYING, int(times[min(max(taken, 0), place)]))
                    under_way = place - taken
                    return under_way < self._outlet.window and step.allows(int(times[place]))

                if not self._waited(turn):
                    return
                self._outlet.send(place)
                self._sent = place + 1

            def drained() -> bool:
                taken = latest.count - base
                done = taken >= len(times)
                self._tell(ENDED, FAR_NS if done else int(times[max(taken, 0)]))
                return done

            self._waited(drained)
        finally:
            latest.close()
            step.close()

    def _sleep_until(self, due_ns: int) -> None:
        while not self._over:
            now_ns = self._clock.now_ns()
            if due_ns - now_ns <= _SLICE_NS:
                self._clock.sleep_until(due_ns)
                return
            self._clock.sleep_until(now_ns + _SLICE_NS)
            self._outlet.idle()

    def _waited(self, condition: Callable[[], bool]) -> bool:
        """Wait for `condition`; False when told to end first."""
        idle_ns = self._clock.now_ns() + _SLICE_NS
        while not condition():
            if self._over:
                return False
            now_ns = self._clock.now_ns()
            if now_ns >= idle_ns:
                self._outlet.idle()
                idle_ns = now_ns + _SLICE_NS
            self._clock.sleep_until(now_ns + _NAP_NS)
        return not self._over


class _Step:
    """Whether the other emulators are far enough for a row to be sent."""

    def __init__(self, folder: Path, others: Sequence[str]) -> None:
        self._records = [
            LatestRecord.attach(position_path(folder, name), POSITION) for name in others
        ]
        self._reached_ns = 0

    def allows(self, t_ns: int) -> bool:
        # Positions only advance: as long as the last look allows the row, none is needed.
        if t_ns <= self._reached_ns + STEP_NS or not self._records:
            return True
        positions = [record.read() for record in self._records]
        self._reached_ns = min(
            0 if position is None else int(position["t_ns"]) for position in positions
        )
        return t_ns <= self._reached_ns + STEP_NS

    def close(self) -> None:
        for record in self._records:
            record.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Play until told to end; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m rig.mock.player", description=__doc__)
    parser.add_argument("--session", type=Path, required=True, help="what to play")
    parser.add_argument("--stream", required=True, choices=sorted(_LATEST), help="which stream")
    parser.add_argument("--with", dest="others", default="", help="streams played beside it")
    parser.add_argument("--run", type=int, default=0, help="which run of it (%(default)s)")
    parser.add_argument("--folder", type=Path, required=True, help="run folder")
    parser.add_argument(
        "--host", type=loopback, required=True, help="loopback address to listen on"
    )
    parser.add_argument(
        "--speed", type=float, default=1.0, help="times the recorded one; 0: as fast as read"
    )
    parser.add_argument(
        "--until-stdin-closes", action="store_true", help="end when whoever started me does"
    )
    args = parser.parse_args(argv)
    others = [name for name in args.others.split(",") if name and name != args.stream]
    tape = load_tape(Session(args.session), (args.stream, *others), args.stream, args.run)
    player = Player(
        args.stream,
        tape,
        make_outlet(args.stream, tape, args.host),
        args.folder,
        SystemClock(),
        speed=args.speed,
        others=others,
    )
    priority = CAMERA_PRIORITY if args.stream == "camera" else DEVICE_PRIORITY
    return serve(args.stream, player, until_stdin_closes=args.until_stdin_closes, priority=priority)


if __name__ == "__main__":
    sys.exit(main())
