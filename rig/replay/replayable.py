"""Checks of recorded streams before their emulators play them.

The drivers are the real ones, so a row can be replayed only if its device could have sent it: whole
counts, increasing sequence numbers, JPEG files as a camera delivers them.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from recorder.errors import SessionError
from recorder.progress import ReportItems
from recorder.session import Session, Stream
from rig.core.playback import stated_rate
from rig.devices.camera.jpeg import is_whole, with_huffman_tables
from rig.devices.force.netft_emulator import force_bias, force_counts, force_page
from rig.mock.players import PLAYED_BY

Ints = npt.NDArray[np.int64]

_UINT32 = 1 << 32
_UINT16 = 1 << 16


def check_force(stream: Stream, rows: slice) -> None:
    """Reject force rows that no Net F/T box could send again."""
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
    """Reject poses, or wrenches of an arm, that no controller could send again."""
    device_t, period = stream.array("device_t")[rows], 1.0 / stated_rate(stream)
    _refuse(stream.name, rows, ~np.isfinite(device_t), "device_t is not a time")
    late = np.concatenate([[True], np.rint(np.diff(device_t) / period) >= 1])
    _refuse(stream.name, rows, ~late[: len(device_t)], "the controller's clock does not advance")


def check_gripper(stream: Stream, rows: slice) -> None:
    """Reject positions that no gripper could send again."""
    device = stream.attrs["device"]
    for name in ("value", "commanded"):
        counts = device["closed"] - stream.array(name)[rows] / device["per_count"]
        whole = np.isclose(counts, counts.round(), atol=1e-3) & (counts > -0.5) & (counts < 255.5)
        _refuse(stream.name, rows, ~whole, f"{name} is no count of the gripper")


def check_taxels(stream: Stream, rows: slice) -> None:
    """Reject taxels that no uSkin server could send again."""
    value = stream.array("value")[rows]
    if value.shape[1:] not in ((16, 3), (24, 3)):
        raise SessionError(
            f"streams/{stream.name}: values {value.shape[1:]}; a uSkin has (16, 3) or (24, 3) and "
            f"cannot send these; replay the other streams with --without {stream.name}"
        )
    beyond: npt.NDArray[np.bool_] = (value < 0) | (value >= _UINT16)
    outside = np.asarray(beyond.any(axis=(1, 2)))
    _refuse(stream.name, rows, outside, "a count is not a uint16")
    _refuse(stream.name, rows, ~_rises(stream.array("seq")[rows]), "seq does not rise")


def check_camera(stream: Stream, rows: slice, progress: ReportItems | None = None) -> None:
    """Reject images that would not pass through MJPEG unchanged; all rows are read."""
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
    **{"force": check_force, "pose": check_pose, "arm_wrench": check_pose, "taxels": check_taxels},
    "gripper": check_gripper,
}


def replayable(
    session: Session, without: tuple[str, ...] = (), progress: ReportItems | None = None
) -> tuple[str, ...]:
    """Check the streams to replay, with progress; return names in the order of `PLAYED_BY`."""
    if session.warning is not None:
        raise SessionError(session.warning)
    stream_names = ", ".join(session.streams)
    for name in without:
        if name not in session.streams:
            raise SessionError(
                f"{session.path}: no stream {name!r} to leave out; known: {stream_names}"
            )
    kinds = {name: stream.traits.kind for name, stream in session.streams.items()}
    names = tuple(
        name for kind in PLAYED_BY for name in session.of_kind(kind) if name not in without
    )
    copied = {*PLAYED_BY, "action"}
    unknown = {name for name, kind in kinds.items() if kind not in copied} - set(without)
    if unknown:
        raise SessionError(
            f"{session.path}: no emulator plays {sorted(unknown)}; leave them out: --without NAME"
        )
    if not names:
        raise SessionError(f"{session.path}: no stream to replay; it has: {stream_names}")
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


def _rises(numbers: Ints) -> npt.NDArray[np.bool_]:
    rises = np.ones(len(numbers), np.bool_)
    rises[1:] = np.diff(numbers) > 0
    return rises


def _refuse(name: str, rows: slice, bad: npt.NDArray[Any], what: str) -> None:
    bad_rows = np.flatnonzero(bad)
    if bad_rows.size:
        row = (rows.start or 0) + int(bad_rows[0])
        raise SessionError(f"streams/{name}: row {row}: {what} ({bad_rows.size} such rows)")
