"""Emulated device that plays a recorded stream, at its own times or as fast as it is read.

    python -m rig.mock.emulate player --file force.json

At any speed, a row is sent only while fewer than `PlaybackDevice.window` rows are in flight; the
reader's count of samples is read from shared memory, so no socket or inbox overflows. At maximum
speed the emulators are also synchronised: none is more than `STEP_NS` of recorded time ahead of the
slowest reader.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from recorder import Session
from rig.bench.stream_kinds import KINDS
from rig.core.clock import SECOND_NS, Clock
from rig.core.emulation import Served, ThreadedEmulator, check_loopback
from rig.core.realtime import CAMERA_PRIORITY, DEVICE_PRIORITY
from rig.core.shared_memory import SharedLatest
from rig.devices.playback.wire import RecordedStream, load_recorded_stream
from rig.mock.playback_sync import (
    ENDED,
    FAILED,
    FAR_NS,
    PLAYING,
    POSITION,
    SYNC,
    WAITING,
    position_path,
    sync_path,
)

# Emulated devices, as used for playback: they put rows on the wire.


class PlaybackDevice(Protocol):
    """Plays one stream.

    A connecting driver gets everything that it needs to open, but no row.
    """

    window: int
    """Largest number of rows in flight to the reader."""

    @property
    def address(self) -> str:
        """Address for drivers to connect to."""

    def start(self) -> None:
        """Listen; raise OSError if the address cannot be bound."""

    def send(self, place: int) -> None:
        """Send row `place` of the recording; raise OSError if the client is gone."""

    def idle(self) -> None:
        """Do idle work; called about 20 times per second while no row is due."""

    def wake(self) -> None:
        """Wake a reader that waits for a row, without sending one: it is about to close."""

    def close(self) -> None:
        """Stop; may be called twice."""


def make_playback_device(recorded: RecordedStream, host: str) -> PlaybackDevice:
    """Create the emulated device of one stream; its vendor library is imported only here."""
    kind = recorded.stream.traits.kind
    if kind == "force":
        from rig.devices.playback.netft_player import NetFtPlayback

        return NetFtPlayback(recorded, host)
    if kind in ("pose", "arm_wrench"):
        from rig.devices.playback.rtde_player import RtdePlayback

        return RtdePlayback(recorded, host)
    if kind == "taxels":
        from rig.devices.playback.xela_player import XelaPlayback

        return XelaPlayback(recorded, host)
    from rig.devices.playback.mjpeg_player import MjpegPlayback

    return MjpegPlayback(recorded, host)


logger = logging.getLogger(__name__)

STEP_NS = SECOND_NS // 50
# Pauses between two looks at a condition: they double while it does not hold, because a dozen
# emulators that look 5,000 times per second each leave no time for the readers they wait for.
_NAP_NS, _LONGEST_NAP_NS = 200_000, 5_000_000
_SLICE_NS = SECOND_NS // 20
# Pauses between wake-ups [s]: fewer than the 10 corrupt frames in a row that mean a lost camera.
_WAKE_PAUSES = (0.05, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)


class Player(ThreadedEmulator):
    """Plays a recorded stream through an outlet, in its own thread.

    Args:
        name: Name of the stream.
        recorded: Recorded stream to play.
        device: Emulated device that sends it.
        folder: Run folder with the shared records.
        clock: Paces the rows.
        speed: Multiple of the recorded speed; 0: as fast as it is read.
        others: Streams to stay synchronised with at maximum speed.
    """

    def __init__(
        self,
        name: str,
        recorded: RecordedStream,
        device: PlaybackDevice,
        folder: Path,
        clock: Clock,
        *,
        speed: float,
        others: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self._name = name
        self._recorded = recorded
        self._device = device
        self._folder = folder
        self._clock = clock
        self._speed = speed
        self._others = tuple(others)
        self._sync = SharedLatest.attach(sync_path(folder), SYNC)
        path = position_path(folder, name)
        self._position = SharedLatest.attach(path, POSITION, writable=True)
        self._sent = 0

    @property
    def address(self) -> str:
        """Address for drivers to connect to."""
        return self._device.address

    def start(self) -> None:
        """Listen and wait for the cue.

        Raises:
            OSError: The address cannot be bound.
        """
        self._device.start()
        self._run_threads(self._run)

    def _disconnect(self) -> None:
        self._device.close()

    def _run(self) -> None:
        try:
            self._tell(WAITING, 0)
            start_ns = self._cued()
            if start_ns is not None:
                self._play(start_ns)
            self._stay()
        except Exception as error:
            # The replay must learn of any error, because this thread is the whole device.
            if not self._ending.is_set():
                self._tell(FAILED, FAR_NS)
                logger.error("after row %d: %s", self._sent - 1, error)

    def _tell(self, state: int, t_ns: int) -> None:
        self._position.write((state, self._sent, t_ns))

    @property
    def _over(self) -> bool:
        """True if the replay has ended, as signalled by the second cue."""
        return self._sync.count > 1 or self._ending.is_set()

    def _cued(self) -> int | None:
        while not self._ending.wait(_SLICE_NS / SECOND_NS / 10):
            sync = self._sync.read()
            if sync is not None:
                return None if self._over else int(sync["start_ns"])
            self._device.idle()
        return None

    def _stay(self) -> None:
        """Serve the client until the replay has ended, then help it to close."""
        while not self._over:
            self._device.idle()
            self._ending.wait(_SLICE_NS / SECOND_NS)
        for pause in _WAKE_PAUSES:
            if self._ending.wait(pause):
                return
            self._device.wake()

    def _play(self, start_ns: int) -> None:
        times = self._recorded.t_ns
        kind = KINDS[self._recorded.stream.traits.kind]
        latest = SharedLatest.attach(self._folder / f"{self._name}.latest", kind.latest)
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
                    return under_way < self._device.window and step.allows(int(times[place]))

                if not self._waited(turn):
                    return
                self._device.send(place)
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
            self._device.idle()

    def _waited(self, condition: Callable[[], bool]) -> bool:
        """Wait for `condition`; return False if stopped first."""
        idle_ns = self._clock.now_ns() + _SLICE_NS
        nap_ns = _NAP_NS
        while not condition():
            if self._over:
                return False
            now_ns = self._clock.now_ns()
            if now_ns >= idle_ns:
                self._device.idle()
                idle_ns = now_ns + _SLICE_NS
            self._clock.sleep_until(now_ns + nap_ns)
            nap_ns = min(2 * nap_ns, _LONGEST_NAP_NS)
        return not self._over


class _Step:
    """Synchronisation with the other emulators' positions."""

    def __init__(self, folder: Path, others: Sequence[str]) -> None:
        self._records = [
            SharedLatest.attach(position_path(folder, name), POSITION) for name in others
        ]
        self._reached_ns = 0

    def allows(self, t_ns: int) -> bool:
        # Positions only advance, so none is read while the last reading allows the row.
        if t_ns <= self._reached_ns + STEP_NS or not self._records:
            return True
        reached_ns = FAR_NS
        for place, record in enumerate(self._records):
            position = record.read()
            at_ns = 0 if position is None else int(position["t_ns"])
            if t_ns > at_ns + STEP_NS:
                # Read first from now on, and alone until it has moved.
                self._records.insert(0, self._records.pop(place))
                return False
            reached_ns = min(reached_ns, at_ns)
        self._reached_ns = reached_ns
        return True

    def close(self) -> None:
        for record in self._records:
            record.close()


@dataclass(frozen=True, slots=True)
class PlayerConfig:
    """Recorded stream to play."""

    session: Path
    stream: str
    """Name of the stream."""
    folder: Path
    """Run folder."""
    host: str
    """Loopback address to listen on."""
    streams: tuple[str, ...] = ()
    """Streams that are played at the same time."""
    run: int = 0
    """Number of the run in the session."""
    speed: float = 1.0
    """Multiple of the recorded speed; 0: as fast as read."""

    def __post_init__(self) -> None:
        """Reject an address that other machines can reach."""
        check_loopback(self.host)


def emulate(settings: PlayerConfig, clock: Clock) -> Served:
    """Return the player of a stream."""
    name = settings.stream
    others = [other for other in settings.streams if other != name]
    session = Session(settings.session)
    recorded = load_recorded_stream(session, (name, *others), name, settings.run)
    device = make_playback_device(recorded, settings.host)
    player = Player(
        name, recorded, device, settings.folder, clock, speed=settings.speed, others=others
    )
    # At maximum speed the readers set the pace, so no emulator may keep one from running.
    yields = settings.speed == 0 or recorded.stream.traits.kind == "camera"
    priority = CAMERA_PRIORITY if yields else DEVICE_PRIORITY
    return Served(name, player, priority=priority)
