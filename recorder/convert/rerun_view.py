"""View a session in Rerun: `tactile session view SESSION`.

All data is on two time lines: `capture` (UTC) and `session` (since the first sample). Images are
sent as the camera's JPEG bytes, losslessly stored ones as PNG. Needs the extra `view`.
"""

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recorder.errors import SessionError
from recorder.session.columns import Stream
from recorder.session.reader import Session
from recorder.spec import OUTCOMES, PHASES, event_text
from recorder.store.durable import TEMPORARY

APPLICATION = "tactile-rig"
_AT_ONCE = 64  # images per message; sets the granularity of progress and the memory use
_MM = 1e3
_NS = 1e-9

Array = NDArray[Any]
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class _Run:
    """One run of a session and its clock offset."""

    number: int
    to_utc: int
    """Offset from monotonic times to UTC [ns since 1970]."""


class _Sink:
    """A Rerun recording, and the part of the session sent to it."""

    def __init__(self, rerun: Any, recording: Any, zero: int, window: tuple[float, float]) -> None:
        self.rerun = rerun
        self._recording = recording
        self._zero = zero
        self._window = window

    def within(self, utc_ns: Array) -> Array:
        """Return a mask (n,) bool of the times in the requested part."""
        seconds = (utc_ns - self._zero) * _NS
        return np.asarray((seconds >= self._window[0]) & (seconds < self._window[1]))

    def send(self, entity: str, utc_ns: Array, columns: Any) -> None:
        """Add one entity's columns at UTC times (n,) [ns]."""
        indexes = [
            self.rerun.TimeColumn("capture", timestamp=utc_ns.astype("datetime64[ns]")),
            self.rerun.TimeColumn(
                "session", duration=(utc_ns - self._zero).astype("timedelta64[ns]")
            ),
        ]
        self._recording.send_columns(entity, indexes=indexes, columns=columns)


def view(
    path: Path,
    *,
    save: Path | None = None,
    start: float = 0.0,
    seconds: float | None = None,
    progress: Progress | None = None,
) -> None:
    """Show a session in Rerun's viewer, or write it to an .rrd file.

    Args:
        path: The session.
        save: File to write in place of opening a viewer; replaced when it is complete.
        start: Start of the part, after the first sample [s].
        seconds: Length of the part [s]; None: to the end.
        progress: Called with the number of samples done and the total.

    Raises:
        SessionError: Rerun is not installed, the session cannot be read, or the part is empty.
    """
    if not start >= 0 or (seconds is not None and not seconds > 0):
        raise SessionError(f"--start {start}, --seconds {seconds}: allowed: 0 or more; above 0")
    rerun = _rerun()
    session = Session(path)
    runs = list(_runs(session))
    zero = min((_first(session, run) for run in runs), default=None)
    if zero is None:
        raise SessionError(f"{path}: no samples to show; killed? tactile session recover")
    recording = rerun.RecordingStream(APPLICATION, recording_id=f"{path.name}-{zero}")
    window = (start, np.inf if seconds is None else start + seconds)
    sink = _Sink(rerun, recording, zero, window)
    if save is None:
        recording.spawn(default_blueprint=_blueprint(session))
        _log(session, runs, sink, progress)
        recording.flush()
        return
    temporary = save.with_name(save.name + TEMPORARY)
    try:
        recording.save(temporary, default_blueprint=_blueprint(session))
        _log(session, runs, sink, progress)
        recording.disconnect()
        temporary.replace(save)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise SessionError(
            f"view needs rerun-sdk ({error}); install it: pip install 'tactile-rig[view]'"
        ) from None
    return rerun


def _runs(session: Session) -> Iterator[_Run]:
    for number, entry in enumerate(session.runs):
        if session.sources(number).span is not None:
            yield _Run(number, _utc_ns(entry) - int(entry.get("t0_ns", 0)))


def _utc_ns(entry: dict[str, Any]) -> int:
    """Return UTC of a run's clock anchor [ns since 1970]; 0 if the run has none."""
    if "utc_ns" in entry:
        return int(entry["utc_ns"])
    try:
        utc = str(entry.get("utc", "1970-01-01")).removesuffix("Z")
        return int(np.datetime64(utc, "ns").astype(np.int64))
    except ValueError:
        return 0


def _first(session: Session, run: _Run) -> int:
    span = session.sources(run.number).span
    return (span[0] if span is not None else 0) + run.to_utc


def _log(session: Session, runs: Sequence[_Run], sink: _Sink, progress: Progress | None) -> None:
    parts = [
        (session.streams[name], source, run, np.flatnonzero(sink.within(source.times + run.to_utc)))
        for run in runs
        for name, source in session.sources(run.number).streams.items()
    ]
    total = sum(len(chosen) for *_, chosen in parts)
    if not total:
        raise SessionError(f"{session.path}: no samples in the requested part")
    done = 0
    for stream, source, run, chosen in parts:
        image = stream.layout.image is not None
        write = _images if image else _WRITERS.get(stream.traits.kind, _values)
        for first in range(0, len(chosen), _AT_ONCE if image else len(chosen) or 1):
            some = chosen[first : first + _AT_ONCE] if image else chosen
            utc_ns = source.times[some] + run.to_utc
            write(sink, _entity(session, stream), stream, source.rows[some], utc_ns)
            done += len(some)
            if progress is not None:
                progress(done, total)
    for run in runs:
        _segments(sink, session, run)


def _entity(session: Session, stream: Stream) -> str:
    """Return the prefix of a stream's entities: empty for the first of a kind with names."""
    kind = stream.traits.kind
    first = session.first(kind) == stream.name and (kind in _WRITERS or kind == "camera")
    return "" if first and kind != "events" else f"{stream.name}/"


def _force(sink: _Sink, prefix: str, stream: Stream, rows: Array, utc_ns: Array) -> None:
    wrench = stream.array("value")[rows]
    for column, entity in enumerate(
        ("force_N/Fx", "force_N/Fy", "force_N/Fz", "torque_Nm/Tx", "torque_Nm/Ty", "torque_Nm/Tz")
    ):
        scalars = sink.rerun.Scalars.columns(scalars=wrench[:, column])
        sink.send(prefix + entity, utc_ns, scalars)


def _pose(sink: _Sink, prefix: str, stream: Stream, rows: Array, utc_ns: Array) -> None:
    position = stream.array("value")[rows, :3] * _MM
    for column, axis in enumerate("xyz"):
        scalars = sink.rerun.Scalars.columns(scalars=position[:, column])
        sink.send(f"{prefix}position_mm/{axis}", utc_ns, scalars)


def _taxels(sink: _Sink, prefix: str, stream: Stream, rows: Array, utc_ns: Array) -> None:
    counts = stream.array("value")[rows].astype(float)
    for column, axis in enumerate("xyz"):
        scalars = sink.rerun.Scalars.columns(scalars=counts[:, :, column].reshape(-1))
        lengths = np.full(len(counts), counts.shape[1])
        sink.send(f"{prefix}taxels_counts/{axis}", utc_ns, scalars.partition(lengths))


def _values(sink: _Sink, prefix: str, stream: Stream, rows: Array, utc_ns: Array) -> None:
    values = stream.array("value")[rows].astype(float).reshape(len(rows), -1)
    scalars = sink.rerun.Scalars.columns(scalars=values.reshape(-1))
    lengths = np.full(len(values), values.shape[1])
    sink.send(f"{prefix}value", utc_ns, scalars.partition(lengths))


def _texts(sink: _Sink, prefix: str, stream: Stream, rows: Array, utc_ns: Array) -> None:
    words = [event_text(value) for value in stream.array("value")[rows]]
    sink.send(f"{prefix}text", utc_ns, sink.rerun.TextLog.columns(text=words))


def _images(sink: _Sink, prefix: str, stream: Stream, rows: Array, utc_ns: Array) -> None:
    blobs, kind = [], "image/jpeg"
    for row in rows:
        data = stream.jpeg(int(row))
        if data is None:
            data, kind = _png(stream.images([int(row)])[0]), "image/png"
        blobs.append(data)
    columns = sink.rerun.EncodedImage.columns(blob=blobs, media_type=[kind] * len(blobs))
    sink.send(f"{prefix}camera", utc_ns, columns)


def _png(pixels: Array) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels.squeeze()).save(file, "PNG", compress_level=1)
    return file.getvalue()


_Writer = Callable[[_Sink, str, Stream, Array, Array], None]
_WRITERS: dict[str, _Writer] = {
    "force": _force,
    "pose": _pose,
    "taxels": _taxels,
    "events": _texts,
}


def _segments(sink: _Sink, session: Session, run: _Run) -> None:
    """Send target, phase and depth: a step at the start and end of each, and a line of text."""
    columns = {name: np.asarray(session.segments[name]) for name in session.segments}
    mine = (columns["run"] == run.number) & sink.within(columns["start_ns"] + run.to_utc)
    if not mine.any():
        return
    columns = {name: column[mine] for name, column in columns.items()}
    target, phase = columns["target"], columns["phase"]
    depth = np.asarray(session.targets["depth"])[target] * _MM
    start, end = columns["start_ns"] + run.to_utc, columns["end_ns"] + run.to_utc
    times = np.stack([start, end], axis=1).reshape(-1)
    for entity, values in (
        ("plan/target", target),
        ("plan/phase", phase),
        ("plan/depth_mm", depth),
    ):
        twice = np.repeat(values.astype(float), 2)
        sink.send(entity, times, sink.rerun.Scalars.columns(scalars=twice))
    words = [
        f"target {t + 1}: {PHASES[p]}, {d:.2f} mm, {OUTCOMES[o]}"
        for t, p, d, o in zip(target, phase, depth, columns["outcome"], strict=True)
    ]
    sink.send("plan/log", start, sink.rerun.TextLog.columns(text=words))


_PLOTS = {
    "force": (("force_N", "force [N]"), ("torque_Nm", "torque [N m]")),
    "pose": (("position_mm", "position [mm]"),),
    "taxels": (("taxels_counts", "taxels [counts]"),),
}


def _blueprint(session: Session) -> Any:
    """Return the layout: image next to the time series, plan below."""
    import rerun.blueprint as blueprint

    series, left = [], [blueprint.TextLogView(origin="/plan/log", name="plan")]
    for name in session.columns:
        stream = session.streams[name]
        prefix, kind = _entity(session, stream), stream.traits.kind
        title = f"{name}, " if prefix else ""
        if stream.layout.image is not None:
            view = blueprint.Spatial2DView(origin=f"/{prefix}camera", name=name)
            left.insert(len(left) - 1, view)
            continue
        for origin, label in _PLOTS.get(kind, (("value", "value"),)):
            if kind != "events":
                series.append(
                    blueprint.TimeSeriesView(origin=f"/{prefix}{origin}", name=f"{title}{label}")
                )
    return blueprint.Blueprint(
        blueprint.Horizontal(blueprint.Vertical(*left), blueprint.Vertical(*series)),
        collapse_panels=True,
    )
