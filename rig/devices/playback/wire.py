"""Checks and playback of recorded streams, used by every emulated device that plays one.

The drivers are the real ones, so a row can be replayed only if its device could have sent it: whole
counts, increasing sequence numbers, JPEG files as a camera delivers them.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recorder import Session, SessionError
from recorder.session import Stream
from rig.core.errors import ConfigError
from rig.devices.camera.jpeg import is_whole, with_huffman_tables
from rig.devices.force.netft_wire import Page

logger = logging.getLogger(__name__)

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Progress = Callable[[int, int], None]

# Kinds of streams that can be replayed, in the order their drivers are opened.
ORDER = ("force", "pose", "arm_wrench", "taxels", "camera")
_UINT32 = 1 << 32
_UINT16 = 1 << 16


def force_page(stream: Stream) -> Page:
    """Return the settings of the F/T box that recorded a force stream; defaults if not stored.

    Raises:
        SessionError: Units that no Net F/T box has.
    """
    device = stream.attrs.get("device") or {}
    default = Page()
    page = Page(
        product=str(device.get("product") or default.product),
        serial=str(device.get("serial") or default.serial),
        counts_per_force=float(device.get("counts_per_force") or default.counts_per_force),
        counts_per_torque=float(device.get("counts_per_torque") or default.counts_per_torque),
        force_unit=str(device.get("force_unit") or default.force_unit),
        torque_unit=str(device.get("torque_unit") or default.torque_unit),
        rate_hz=max(round(stated_rate(stream)), 1),
    )
    try:
        page.scale()
    except ConfigError as error:
        raise SessionError(f"streams/{stream.name}: {error}") from None
    return page


def stated_rate(stream: Stream) -> float:
    """Return the rate that the device stated [Hz], else the stream's own."""
    device = stream.attrs.get("device") or {}
    return float(device.get("rate_hz") or stream.rate_hz)


def force_bias(stream: Stream) -> Floats:
    """Return the bias that was subtracted from every row of a force stream (6,) [N, N m]."""
    return np.array(stream.attrs.get("bias") or [0.0] * 6, np.float64)


def force_counts(value: Floats, bias: Floats, page: Page, name: str = "force") -> Ints:
    """Return the counts (n, 6) from which the driver computes exactly `value`.

    Args:
        value: As stored: measured minus bias (n, 6) [N, N m].
        bias: (6,) [N, N m].
        page: Settings of the box.
        name: Name of the stream, for errors.

    Raises:
        SessionError: A row is not a whole number of counts, or beyond int32.
    """
    scale = np.repeat(page.scale(), 3)
    whole = np.rint((value + bias) / scale)
    fits = (np.abs(whole) < 2**31).all(axis=1)
    counts = np.where(fits[:, None], whole, 0).astype(np.int64)
    # Repeats the driver's own arithmetic, to the last bit.
    again = counts.astype(np.float64) * scale - bias
    same = (again.view(np.int64) == np.ascontiguousarray(value).view(np.int64)).all(axis=1)
    bad = np.flatnonzero(~(fits & same))
    if bad.size:
        raise SessionError(
            f"streams/{name}: row {bad[0]}: {value[bad[0]].tolist()} is not a whole number of "
            f"counts of a box with {page.counts_per_force:g} counts per {page.force_unit} and "
            f"{page.counts_per_torque:g} per {page.torque_unit} ({bad.size} rows are not): "
            "it was not recorded from a Net F/T box, so its emulator cannot send it; replay the "
            f"other streams with --without {name}"
        )
    return counts


def check_force(stream: Stream, rows: slice) -> None:
    """Reject force rows that no Net F/T box could send again.

    Raises:
        SessionError: Names the row.
    """
    force_counts(stream.array("value")[rows], force_bias(stream), force_page(stream), stream.name)
    status, seq = stream.array("status")[rows], stream.array("seq")[rows]
    no_status: npt.NDArray[np.bool_] = (status < 0) | (status >= _UINT32)
    _refuse(stream.name, rows, no_status, "status is not a uint32")
    _refuse(stream.name, rows, ~_rises(seq), "seq does not rise")
    if len(seq) and not 1 <= seq[0] < _UINT32:
        # The driver needs one record to open, numbered before the first.
        raise SessionError(
            f"streams/{stream.name}: row {rows.start or 0}: seq {seq[0]}; expected 1 to 2^32 - 1"
        )


def check_pose(stream: Stream, rows: slice) -> None:
    """Reject poses, or wrenches of an arm, that no controller could send again.

    Raises:
        SessionError: Names the row.
    """
    device_t, period = stream.array("device_t")[rows], 1.0 / stated_rate(stream)
    _refuse(stream.name, rows, ~np.isfinite(device_t), "device_t is not a time")
    late = np.concatenate([[True], np.rint(np.diff(device_t) / period) >= 1])
    _refuse(stream.name, rows, ~late[: len(device_t)], "the controller's clock does not advance")


def check_taxels(stream: Stream, rows: slice) -> None:
    """Reject taxels that no uSkin server could send again.

    Raises:
        SessionError: Names the row.
    """
    value = stream.array("value")[rows]
    beyond: npt.NDArray[np.bool_] = (value < 0) | (value >= _UINT16)
    outside = np.asarray(beyond.reshape(len(value), 48).any(axis=1))
    _refuse(stream.name, rows, outside, "a count is not a uint16")
    _refuse(stream.name, rows, ~_rises(stream.array("seq")[rows]), "seq does not rise")


def check_camera(stream: Stream, rows: slice, progress: Progress | None = None) -> None:
    """Reject images that would not pass through MJPEG unchanged.

    Args:
        stream: A camera stream.
        rows: Rows to check; all are read.
        progress: Called with the number of images checked and their total.

    Raises:
        SessionError: Names the row, or reports that the images are stored as pixels.
    """
    for row in range(*rows.indices(len(stream))):
        jpeg = stream.jpeg(row)
        if jpeg is None:
            raise SessionError(
                f"streams/{stream.name}: stored as pixels, and a network camera sends JPEG, which "
                f"would change them; replay the other streams with --without {stream.name}"
            )
        if not is_whole(jpeg) or with_huffman_tables(jpeg) != jpeg:
            raise SessionError(
                f"streams/{stream.name}: row {row}: no complete JPEG with Huffman tables"
            )
        if progress is not None:
            progress(row + 1, len(stream))


# The camera's check is not listed: it takes long, and reports progress.
_CHECKS = {
    **{"force": check_force, "pose": check_pose, "arm_wrench": check_pose, "taxels": check_taxels}
}


def replayable(
    session: Session, without: tuple[str, ...] = (), progress: Progress | None = None
) -> tuple[str, ...]:
    """Check the streams to replay, and return their names, by kind in `ORDER`.

    Args:
        session: The source.
        without: Streams to leave out.
        progress: Called with the number of images checked and their total.

    Raises:
        SessionError: Still recording, nothing to replay, or a row cannot be sent again.
    """
    if session.warning is not None:
        raise SessionError(session.warning)
    known = ", ".join(session.streams)
    for name in without:
        if name not in session.streams:
            raise SessionError(f"{session.path}: no stream {name!r} to leave out; known: {known}")
    kinds = {name: stream.traits.kind for name, stream in session.streams.items()}
    names = tuple(name for kind in ORDER for name in session.of_kind(kind) if name not in without)
    unknown = {name for name, kind in kinds.items() if kind not in ORDER} - set(without)
    if unknown:
        raise SessionError(
            f"{session.path}: no emulator plays {sorted(unknown)}; leave them out: --without NAME"
        )
    if not names:
        raise SessionError(f"{session.path}: no stream to replay; it has: {known}")
    for name in names:
        stream = session.streams[name]
        if not len(stream):
            raise SessionError(f"streams/{name}: no rows; leave it out: --without {name}")
        for run in range(max(len(session.runs), 1)):
            rows = session.rows_of_run(name, run)
            if kinds[name] == "camera":
                check_camera(stream, rows, progress)
            else:
                _CHECKS[kinds[name]](stream, rows)
    return names


def origin_ns(session: Session, names: tuple[str, ...], run: int) -> int | None:
    """Return the recorded time of a run's first sample in any stream [ns]; None without samples."""
    first = []
    for name in names:
        times = session.streams[name].t_ns[session.rows_of_run(name, run)]
        if len(times):
            first.append(int(times.min()))
    return min(first) if first else None


def _rises(numbers: Ints) -> npt.NDArray[np.bool_]:
    rises = np.ones(len(numbers), np.bool_)
    rises[1:] = np.diff(numbers) > 0
    return rises


def _refuse(name: str, rows: slice, bad: npt.NDArray[Any], what: str) -> None:
    found = np.flatnonzero(bad)
    if found.size:
        row = (rows.start or 0) + int(found[0])
        raise SessionError(f"streams/{name}: row {row}: {what} ({found.size} such rows)")


# Part of a recording that one emulated device plays.


@dataclass(frozen=True, slots=True)
class RecordedStream:
    """Rows of one stream in one run."""

    stream: Stream
    """Stream that contains the rows."""
    rows: range
    """Indices of the rows."""
    t_ns: npt.NDArray[np.int64]
    """Times of the rows since the run's first sample in any stream [ns]."""


def load_recorded_stream(
    session: Session, names: tuple[str, ...], name: str, run: int
) -> RecordedStream:
    """Return the rows of stream `name` in a run, timed from the first sample of any of `names`.

    Raises:
        SessionError: Unknown stream, or a damaged one.
    """
    stream = session.streams[name]
    rows = session.rows_of_run(name, run)
    start = origin_ns(session, names, run) or 0
    return RecordedStream(stream, range(*rows.indices(len(stream))), stream.t_ns[rows] - start)


# TCP port whose clients are greeted one after the other; the latest one is kept.

_POLL = 0.1
# Time limit for a client's part of the greeting [s].
_GREETING = 5.0


class Listener:
    """Server that accepts clients; `send` goes to the latest client that was greeted.

    Args:
        host: Address to listen on.
        port: Port.
        greet: Answers a new client until it is ready for rows; False if it left before that.
    """

    def __init__(self, host: str, port: int, greet: Callable[[socket.socket], bool]) -> None:
        self.host = host
        self.port = port
        self._greet = greet
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start listening.

        Raises:
            OSError: The address is not available.
        """
        server = socket.socket()
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            server.bind((self.host, self.port))
            server.listen(4)
        except OSError:
            server.close()
            raise
        server.settimeout(_POLL)
        self._server = server
        self._thread = threading.Thread(target=self._accept, args=(server,), name="player-accept")
        self._thread.start()

    @property
    def connected(self) -> bool:
        """True while a client is connected and ready for rows."""
        return self._client is not None

    def send(self, data: bytes) -> None:
        """Send all of `data`, blocking while the client is slow.

        Raises:
            OSError: There is no client, or it is gone.
        """
        client = self._client
        if client is None:
            raise OSError("no client is connected")
        client.sendall(data)

    def close(self) -> None:
        """Disconnect and stop; may be called twice."""
        self._ending.set()
        client = self._client
        if client is not None:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        for opened in (client, self._server):
            if opened is not None:
                opened.close()
        self._client = self._server = None

    def _accept(self, server: socket.socket) -> None:
        while not self._ending.is_set():
            try:
                client, _ = server.accept()
            except TimeoutError:
                continue
            client.settimeout(_GREETING)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                greeted = self._greet(client)
            except (OSError, ValueError) as error:
                logger.debug("client gone in the greeting: %s", error)
                greeted = False
            if not greeted:
                client.close()
                continue
            client.settimeout(None)
            before, self._client = self._client, client
            if before is not None:
                before.close()
