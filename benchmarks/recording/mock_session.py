"""One session collected on the mock bench, compared with its World's ground truth."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.recording.alignment import FORCE, Error, Method
from recorder import Session
from recorder.session.align import align_window
from rig.devices.camera.jpeg import frame_stamp
from rig.mock.world.truth import Truth

_TIMEOUT = 180.0


def collect(bench: Path, targets: int, folder: Path) -> tuple[Path, Path]:
    """Run `tactile collect`; return the session and the ground truth it wrote.

    Raises:
        RuntimeError: It failed; the message is its last line of output.
    """
    session, truth = folder / "mock.zarr", folder / "mock.truth"
    command = [sys.executable, "-m", "tactile", "collect", "--bench", str(bench)]
    command += ["--targets", str(targets), "--out", str(session), "--truth", str(truth)]
    command += ["--calibrations", str(folder / "none-measured")]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT)
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"collect took longer than {_TIMEOUT:.0f} s") from None
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise RuntimeError(f"collect: {lines[-1] if lines else done.returncode}")
    return session, truth


def compare_mock(
    collected: Callable[[int, Path], tuple[Path, Path]], targets: int, place: Path
) -> tuple[tuple[Method, ...], str]:
    """Return the force errors of a short collection, or none and the reason."""
    try:
        session_path, truth_path = collected(targets, place)
    except RuntimeError as error:
        return (), str(error)
    return errors_of(Session(session_path), Truth(truth_path)), ""


def errors_of(session: Session, truth: Truth) -> tuple[Method, ...]:
    """Return the force error of each method at the time of the state shown in the picture [N].

    The emulated camera has zero exposure time and writes the time of that state into each JPEG.
    """
    sources, frames = session.sources(0), session.frames
    ticks = np.asarray(frames["t_ns"])[np.asarray(frames["valid"], bool)]
    ticks = ticks[ticks < int(truth.records["t_ns"][-1])]
    bias = np.asarray(session.streams["force"].attrs["bias"])
    found = []
    for method in FORCE:
        window = align_window(ticks, sources, {"force": method})
        wrench = window.of("wrench")
        if wrench is None or wrench.value is None:
            continue
        rows = np.flatnonzero(wrench.valid & (window.signal_row >= 0))
        when = np.array([_state_ns(session, int(row)) for row in window.signal_row[rows]], np.int64)
        off = wrench.value[rows] + bias - truth.wrench(when)
        error = np.linalg.norm(off[:, :3], axis=1)
        found.append(Method("force", method, len(rows), {"N": Error.of(error)}, float("nan")))
    return tuple(found)


def _state_ns(session: Session, row: int) -> int:
    stamp = frame_stamp(session.streams["camera"].jpeg(row) or b"")
    if stamp is None:
        raise ValueError(f"frame {row} has no emulator's stamp")
    return stamp[1]
