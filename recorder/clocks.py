"""Fits every device clock of a session to the host's, and keeps what it found.

The fit is reported, in attributes `clock_fit` of the stream; no time is ever replaced by it.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.clockfit import ClockFit, fit_clock
from recorder.layout import merge_attrs
from recorder.reader import Session, Stream


def fit_clocks(path: str | os.PathLike[str]) -> dict[str, list[dict[str, Any] | None]]:
    """Fit each stream whose device tells a time, run by run, and store it in its attributes.

    Returns:
        Attribute `clock_fit` by stream: one entry per run, None where too little was recorded.

    Raises:
        SessionError: Not a session, or a damaged one.
    """
    session = Session(path)
    found: dict[str, list[dict[str, Any] | None]] = {}
    for name, stream in session.streams.items():
        clock = _device_clock(stream)
        if clock is None:
            continue
        source, device_t = clock
        entries: list[dict[str, Any] | None] = []
        for run in range(max(len(session.runs), 1)):
            rows = session.rows_of_run(name, run)
            fit = fit_clock(device_t[rows], stream.t_ns[rows])
            entries.append(None if fit is None else {"clock": source, **fit.to_json()})
        if any(entry is not None for entry in entries):
            found[name] = entries
            merge_attrs(Path(path) / "streams" / name, {"clock_fit": entries})
    return found


def clock_lines(session: Session) -> Iterator[str]:
    """Say of each fitted clock where it lay and how it ran, for the last run of each stream."""
    for name, stream in session.streams.items():
        entries = [entry for entry in stream.attrs.get("clock_fit", []) if entry is not None]
        if not entries:
            continue
        fit = ClockFit.from_json(entries[-1])
        piece = fit.pieces[-1]
        offset = piece.offset
        resets = f", {fit.resets} resets" if fit.resets else ""
        yield (
            f"clock   {name:<7} host - device {_seconds(offset)}, "
            f"drift {piece.drift_ppm:+.1f} ppm, delays rms {1e3 * piece.residual_rms:.2f} ms "
            f"({entries[-1]['clock']}, {fit.window:.0f} s windows{resets}); reported, not applied"
        )


def _seconds(value: float) -> str:
    return f"{1e3 * value:+.2f} ms" if abs(value) < 10 else f"{value:+.3f} s"


def _device_clock(stream: Stream) -> tuple[str, NDArray[np.float64]] | None:
    """Return what tells the device's time, and that time (n,) [s], or None."""
    if "device_t" in stream.small:
        device_t = np.asarray(stream.array("device_t"), np.float64)
        return ("device_t", device_t) if np.isfinite(device_t).any() else None
    rate = stream.attrs.get("device", {}).get("rate_hz")
    if "seq" in stream.small and rate:
        # A sequence number at a set rate is a clock that ticks once a sample.
        return f"seq at {rate:g} Hz", np.asarray(stream.array("seq") / float(rate))
    return None
