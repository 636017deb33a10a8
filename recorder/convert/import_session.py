"""Write recordings made elsewhere as sessions, atomically: one for each object that touched."""

import datetime
import hashlib
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.convert.import_clocks import DRIFT, ClockFit, Untestable, find_clock
from recorder.convert.import_find import find_takes
from recorder.convert.import_presses import (
    Press,
    Signal,
    Span,
    Trace,
    find_no_contact,
    find_presses,
    force_signal,
    press_within,
    widened,
)
from recorder.convert.import_tracks import (
    Answers,
    As,
    Film,
    MissingAnswer,
    Numbers,
    RecordedTrack,
    Take,
    Times,
    indenter_of,
    problems,
    rate_of,
    whole_ns,
)
from recorder.errors import SessionError
from recorder.progress import ReportItems
from recorder.session.align import NS
from recorder.session.contact_frame import in_frame
from recorder.session.stream_writer import StreamWriter
from recorder.session.writer import SessionWriter
from recorder.spec import (
    AXES,
    PHASES,
    Column,
    StreamSpec,
    camera_spec,
    force_spec,
    pose_spec,
    reference_spec,
    signal_of,
    taxels_spec,
)
from recorder.store.files import building

Rows = Iterator[dict[str, Any]]

# Recordings may differ in length by this fraction, or by this duration [s].
_LENGTH_TOLERANCE = 0.05
_LENGTH_LEAST = 0.1
# Rows and columns of the pictures in which contacts are looked for: 2.7 kB each, as all of a
# recording are held in memory.
_SMALL = (30, 30)
# Lag of one clock that is left if only contacts near to each other show it [s].
_NEAR = 0.15
# Frames without contact that are kept before and after a press, if there are some.
_AROUND = 2
# File names of single pictures that show no contact.
_NO_CONTACT = ("ref", "reference", "background", "no_contact", "no-contact", "rest")


@dataclass(frozen=True, slots=True, eq=False)
class Draft:
    """A recording as it will be written, to be looked at first."""

    take: Take
    """Its tracks; times are on one clock, from 0."""
    indenter: str
    """Name of what touched the sensor."""
    no_contact: Span
    """Time without contact [ns]."""
    presses: tuple[Press, ...]
    """Contacts, in order of time."""
    trace: Trace
    """Change in which they were found."""
    end_ns: int
    """End of what is written."""
    lag: ClockFit | None = None
    """Lag that was found between images or taxels and forces."""
    assumed: tuple[str, ...] = ()
    """Messages on assumptions and changes."""


def draft_recordings(
    paths: Sequence[Path], stated: Sequence[tuple[As, str, Path]], answers: Answers
) -> list[Draft]:
    """Find the recordings in files and folders, and the contacts in each.

    `stated` has kind, stream (or an empty text) and path of files that are one recording.

    Raises:
        SessionError: Nothing can be imported, or a file is damaged.
        MissingAnswer: Something that the files do not tell.
        OSError: A file cannot be read.
    """
    takes = find_takes(paths, stated, answers)
    if not answers.sensor:
        raise MissingAnswer("sensor", "nothing tells the name of the sensor")
    if answers.contact_frame and not all(take.first("pose") for take in takes):
        raise SessionError("--contact-frame: found without poses, which a depth takes")
    drafts = []
    with problems() as part:
        for take in takes:
            with part(take.name):
                drafts.append(_draft(take, answers))
    return drafts


def _draft(take: Take, answers: Answers) -> Draft:
    indenter = indenter_of(take.name, answers)
    assumed = [*take.assumed]
    for track in take.tracks:
        assumed += track.content.assumed
    sensed = _sensor_signal(take)
    take, lag, messages = _on_one_clock(take, sensed, answers)
    assumed += messages
    if sensed is not None and (sensor := _sensor_track(take)) is not None:
        sensed = replace(sensed, t_ns=sensor.content.t_ns)
    seconds = {track.source: track.seconds for track in take.tracks}
    end = _common_end(seconds, answers.trim)
    if end < max(seconds.values()):
        assumed.append(f"{take.name}: all cut to {end:.3f} s, the length of the shortest")
    end_ns = round(end * 1e9)
    for track in take.tracks:
        if track.content.t_ns[0] >= end_ns:
            raise SessionError(
                f"{track.source}: begins at {NS * track.content.t_ns[0]:.3f} s, after the end of "
                f"another at {end:.3f} s; are its times of another clock?"
            )
    film = take.film
    if film is not None and film.names and sensed is not None:
        no_contact, presses, trace = _stills(film, sensed, answers)
    else:
        no_contact, presses, trace = _contacts(take, sensed, answers, end_ns)
    forces, gauge = take.numbers("force"), take.first("force")
    if forces is not None and gauge is not None and presses:
        _require_sign(gauge.source, forces, no_contact, presses)
    if presses:
        begin, end_s = NS * no_contact[0], NS * no_contact[1]
        zero = "" if forces is None else f" ({_zero(forces, no_contact)})"
        assumed.append(
            f"{take.name}: without contact from {begin:.3f} to {end_s:.3f} s{zero}, "
            f"{len(presses)} presses by {trace.name}"
        )
    return Draft(take, indenter, no_contact, tuple(presses), trace, end_ns, lag, tuple(assumed))


def _shrunk(image: Any) -> NDArray[np.uint8]:
    from PIL import Image

    if isinstance(image, bytes):
        import simplejpeg

        image = simplejpeg.decode_jpeg(
            image, fastdct=True, min_height=_SMALL[0], min_width=_SMALL[1]
        )
    picture = Image.fromarray(np.asarray(image))
    return np.asarray(picture.resize(_SMALL[::-1], Image.Resampling.BOX), np.uint8)


def _sensor_track(take: Take) -> RecordedTrack | None:
    return take.first("video") or take.first("taxels")


def _sensor_signal(take: Take) -> Signal | None:
    """Return the signal of images, else of taxels; None without either."""
    if (track := _sensor_track(take)) is None:
        return None
    content = track.content
    if isinstance(content, Film):
        # The colours of 10 x 10 cells of each picture.
        pictures = []
        with problems() as part:
            for number, image in enumerate(content.load()):
                with part(f"{track.source}: image {number}"):
                    pictures.append(_shrunk(image))
        small = np.stack(pictures)
        cells = small.reshape(len(small), 10, 3, 10, 3, 3).mean(axis=(2, 4), dtype=np.float32)
        rows = cells.reshape(len(small), -1)
        return Signal("change of the image [grey levels]", content.t_ns, rows)
    counts = content.value.reshape(len(content.value), -1).astype(np.float64)
    return Signal("change of the taxels [counts]", content.t_ns, counts)


def _force(take: Take) -> Signal | None:
    content = take.numbers("force")
    if content is None:
        return None
    return force_signal(content.t_ns, content.value, content.attrs["axes_measured"])


def _on_one_clock(
    take: Take, sensed: Signal | None, answers: Answers
) -> tuple[Take, ClockFit | None, list[str]]:
    """Return the recording with its lag taken out, that lag, and messages."""
    forces, force, track = take.first("force"), _force(take), _sensor_track(take)
    stills = take.film is not None and take.film.names
    if forces is None or force is None or track is None or sensed is None or stills:
        several = len({track.clock for track in take.tracks}) > 1
        return take, None, [f"{take.name}: all files start together"] if several else []
    apart = track.clock != forces.clock
    moving = [each.stream for each in take.tracks if apart and each.clock == track.clock]
    moving = moving or [track.stream]
    if answers.lag is not None:
        moved = _moved(take, moving, lambda t_ns: t_ns - round((answers.lag or 0.0) / NS))
        return moved, None, [f"{take.name}: lag of {answers.lag:+.3f} s by --lag"]
    try:
        lag = find_clock(sensed, force, take.name)
    except Untestable as untestable:
        if apart:
            raise
        why = str(untestable).partition("; say ")[0]
        return take, None, [f"{take.name}: times are not tested: {why}"]
    largest = float(np.abs(lag.lag).max())
    doubtful = DRIFT in lag.untested and not apart and largest < _NEAR
    if largest <= 2 * lag.sigma or doubtful:
        why = "of one clock by contacts near to each other" if doubtful else "0 is within that"
        left = replace(lag, sigma=math.hypot(lag.sigma, largest))
        return take, left, [f"{take.name}: lag {lag}: {why}, so times are left"]
    message = f"{take.name}: lag {lag}: {', '.join(moving)} moved by it"
    return _moved(take, moving, lag.moved), lag, [message]


def _moved(take: Take, streams: Sequence[str], move: Callable[[Times], Times]) -> Take:
    """Return the recording with the times of some streams moved, all of them from 0 on."""
    times = {track.stream: track.content.t_ns for track in take.tracks}
    times |= {stream: move(times[stream]) for stream in streams}
    least = min(0, *(int(t_ns[0]) for t_ns in times.values()))
    tracks = []
    for track in take.tracks:
        content = track.content
        moved = (times[track.stream] - least).astype(np.float64)
        t_ns = whole_ns(moved, f"{track.source}: without its lag, row", 2)
        rate_hz = content.rate_hz * rate_of(t_ns) / rate_of(content.t_ns)
        content = replace(content, t_ns=t_ns, rate_hz=rate_hz)
        tracks.append(replace(track, content=content))
    return replace(take, tracks=tuple(tracks))


def _zero(forces: Numbers, no_contact: Span) -> str:
    """Return the forces that are taken for none, such as `Fz 0.31 N is zero`."""
    rest = forces.value[_inside(forces.t_ns, no_contact), :3].mean(axis=0)
    axes = [axis for axis in AXES[:3] if axis in forces.attrs["axes_measured"]]
    return ", ".join(f"{axis} {rest[AXES.index(axis)]:.3g} N" for axis in axes) + " is zero"


def _common_end(seconds: dict[str, float], trim: bool) -> float:
    shortest, longest = min(seconds.values()), max(seconds.values())
    if trim:
        return shortest
    if longest - shortest > max(_LENGTH_TOLERANCE * longest, _LENGTH_LEAST):
        lengths = ", ".join(f"{name} {length:.3f} s" for name, length in seconds.items())
        raise SessionError(
            f"found recordings of unequal length: {lengths}; are the rates right? "
            "--trim cuts all to the shortest"
        )
    return longest


def _contacts(
    take: Take, sensed: Signal | None, answers: Answers, end_ns: int
) -> tuple[Span, list[Press], Trace]:
    """Return the time without contact, the contacts, and the change that shows them."""
    signal = _force(take)
    if signal is None or not float(np.ptp(signal.rows)) > 0:
        signal = sensed or signal
    if signal is None:
        raise SessionError(f"{take.name}: found neither images nor taxels nor forces")
    # Nothing is looked for while a track has not begun, or has ended.
    start = max(int(track.content.t_ns[0]) for track in take.tracks)
    last = min(int(track.content.t_ns[-1]) for track in take.tracks) + 1
    signal = signal.within((start, last))
    pressed = answers.spans("press", take.name)
    if pressed == ["none"]:
        beginning = signal.t_ns[: max(1, min(5, len(signal.t_ns) // 4))]
        return (0, 0), [], signal.change((int(beginning[0]), int(beginning[-1]) + 1))
    stated = [_span("--no-contact", text) for text in answers.spans("no_contact", take.name)]
    no_contact = stated[0] if stated else find_no_contact(signal, take.name, sensed)
    trace = signal.change(no_contact)
    if pressed:
        spans = sorted(_span("--press", text) for text in pressed)
        return no_contact, [press_within(trace, span) for span in spans], trace
    presses = find_presses(trace, no_contact)
    if not presses:
        raise MissingAnswer(
            "press",
            f"{take.name}: {trace.name} is largest at {trace.value.max():.3g}, which its noise "
            "explains, so no contact is found",
            ("START:END in seconds",),
        )
    around = sensed or signal
    step = float(np.median(np.diff(around.t_ns))) if len(around.t_ns) > 1 else 0.0
    wide = widened(presses, start, min(last, end_ns), round(_AROUND * step))
    return no_contact, [each for each in wide if each.start_ns < each.peak_ns < each.end_ns], trace


def _stills(film: Film, sensed: Signal, answers: Answers) -> tuple[Span, list[Press], Trace]:
    """Return the picture without contact, and every other as a contact of its own."""
    names = [name.rpartition(".")[0] for name in film.names]
    no_contact = [text.rpartition("=")[2] for text in answers.no_contact]
    no_contact = no_contact or [name for name in names if name.lower() in _NO_CONTACT]
    rest = [row for row, name in enumerate(names) if {name, film.names[row]} & set(no_contact)]
    if not rest:
        raise MissingAnswer(
            "no_contact", "no picture is named after a sensor without contact", film.names[:9]
        )
    period = round(1e9 / film.rate_hz)
    starts = film.t_ns.tolist()
    presses = [
        Press(start, start + period // 10, start + period // 5)
        for row, start in enumerate(starts)
        if row not in rest
    ]
    if not presses:
        raise SessionError("found no picture of a contact beside those without")
    span = (starts[rest[0]], starts[rest[0]] + period)
    return span, presses, sensed.change(span)


def _span(option: str, text: str) -> Span:
    begin, colon, end = text.partition(":")
    try:
        span = round(float(begin) * 1e9), round(float(end) * 1e9)
    except (ValueError, OverflowError):
        span = (0, 0)
    if not colon or not 0 <= span[0] < span[1]:
        raise SessionError(f"{option}: found {text!r}; allowed: START:END in seconds")
    return span


def _require_sign(source: str, forces: Numbers, no_contact: Span, presses: Sequence[Press]) -> None:
    """Reject three-axis forces whose Fz rises under contact: a session has negative Fz there."""
    if "Fz" not in forces.attrs["axes_measured"]:
        return
    t_ns, force = forces.t_ns, forces.value[:, 2]
    rest = force[_inside(t_ns, no_contact)]
    spans = [_inside(t_ns, (press.start_ns, press.end_ns)) for press in presses]
    touched = force[np.concatenate(spans)]
    if not rest.size or not touched.size:
        return
    change = touched - rest.mean()
    if float(change.max()) > 2 * -float(change.min()) and float(change.max()) > 4 * rest.std():
        raise SessionError(
            f"{source}: Fz rises to {touched.max():+.3g} N under contact; a session "
            "has negative Fz there; turn the sign of the file's forces (all axes turn with the "
            "frame; --columns has sign: -1), or import the pressing force alone as one column"
        )


def write_sessions(
    drafts: Sequence[Draft], out: Path, answers: Answers, progress: ReportItems | None = None
) -> list[Path]:
    """Write one session for each object that touched; recordings of one object are its runs.

    `out` is the session; with several objects, the folder of their sessions. The answers are stored
    in them.

    Raises:
        SessionError: Something exists at the path, or recordings of one object differ in their
            streams; nothing is left behind.
        OSError: A file cannot be read, or the disk is full; nothing is left behind.
    """
    by_indenter: dict[str, list[Draft]] = {}
    for draft in drafts:
        by_indenter.setdefault(draft.indenter, []).append(draft)
    several = len(by_indenter) > 1
    if several and out.suffix == ".zarr":
        raise SessionError(
            f"--out: found {out} for sessions of {', '.join(by_indenter)}; allowed: a folder"
        )
    total = sum(len(track.content.t_ns) for draft in drafts for track in draft.take.tracks)
    rows = count(1)

    def tick() -> None:
        if progress is not None:
            progress(next(rows), total)

    names = [re.sub(r"[^\w.-]", "_", name) + ".zarr" if several else "" for name in by_indenter]
    out.parent.mkdir(parents=True, exist_ok=True)
    with building(out) as beside:
        if several:
            beside.mkdir()
        for name, (indenter, some) in zip(names, by_indenter.items(), strict=True):
            _write(beside / name, some, indenter, answers, tick)
    return [out / name for name in names]


def _write(
    path: Path, drafts: Sequence[Draft], indenter: str, answers: Answers, tick: Callable[[], None]
) -> None:
    """Write the session of some recordings; `tick` is called for each of its rows."""
    specs = _specs(drafts)
    placed = "pose" if answers.contact_frame else "unknown"
    attrs = {
        "mock": False,
        "sensor": answers.sensor,
        "indenter": indenter,
        **({"operator": answers.operator} if answers.operator else {}),
        **({"contact_frame": list(answers.contact_frame)} if answers.contact_frame else {}),
        "calibration": {},
        "imported": {
            "files": _digests(drafts),
            "assumed": [line for draft in drafts for line in draft.assumed],
            "answers": answers.to_json(),
            "recordings": [draft.take.name for draft in drafts],
            "place": placed,
            "depth": placed,
            "utc": datetime.datetime.now(datetime.UTC).isoformat(),
        },
    }
    targets = _targets(drafts, answers)
    with SessionWriter.create(path, attrs=attrs, streams=specs, targets=targets) as session:
        first_target = 0
        for run, draft in enumerate(drafts):
            # These samples have no time on this host's clock: their times begin at 0.
            session.begin_run({"t0_ns": 0, "utc": None, "boot_id": "imported"})
            rows_before: dict[str, int] = {}
            for track, spec in zip(draft.take.tracks, specs, strict=True):
                with StreamWriter.open(session.stream_path(track.stream)) as writer:
                    rows_before[track.stream] = writer.rows
                    for row in _rows(track, spec.columns, draft.end_ns):
                        writer.append(**row)
                        tick()
            if draft.presses:
                session.reference.append(**_reference(draft, run, specs, rows_before))
            for number, press in enumerate(draft.presses):
                for phase, (start, end) in _phases(press, draft):
                    session.segments.append(
                        target=first_target + number,
                        phase=phase,
                        outcome=0,
                        run=run,
                        start_ns=start,
                        end_ns=end,
                    )
            first_target += len(draft.presses)
        signal = signal_of((spec.name, spec.traits) for spec in specs) or specs[0].name
        rate_hz = next(spec.rate_hz for spec in specs if spec.name == signal)
        session.finish("complete", rate_hz=rate_hz)


def _phases(press: Press, draft: Draft) -> list[tuple[int, Span]]:
    """Return the phases of a press: loading to its largest change, then unloading."""
    down, up = PHASES.index("normal_inc"), PHASES.index("normal_dec")
    film = draft.take.film
    if film is not None and film.names:
        return [(down, (press.start_ns, press.end_ns))]
    return [(down, (press.start_ns, press.peak_ns)), (up, (press.peak_ns, press.end_ns))]


def _targets(drafts: Sequence[Draft], answers: Answers) -> dict[str, Any]:
    """Return the presses as targets; what nobody knows of them is NaN."""
    presses = sum(len(draft.presses) for draft in drafts)
    depth, planned = np.full(presses, np.nan), np.full((presses, 3), np.nan)
    if answers.contact_frame:
        frame = np.array(answers.contact_frame, np.float64)
        row = 0
        for draft in drafts:
            poses = draft.take.numbers("pose")
            if poses is None:
                raise SessionError(f"{draft.take.name}: found no pose")
            depths = -in_frame(frame, poses.value)[:, 2]
            for press in draft.presses:
                inside = _inside(poses.t_ns, (press.start_ns, press.end_ns))
                if inside.size:
                    deepest = inside[np.argmax(depths[inside])]
                    depth[row] = max(float(depths[deepest]), 0.0)
                    planned[row] = poses.value[deepest, :3]
                row += 1
        if presses and not (depth > 0).any():
            raise SessionError(
                "--contact-frame: found no pose below its surface in any contact; is it at the "
                "surface, and does its z axis point out of the sensor?"
            )
    return {
        "point": np.zeros(presses, np.int16),
        "depth": depth,
        "direction": np.full(presses, -1, np.int16),
        "planned": planned,
    }


def _specs(drafts: Sequence[Draft]) -> list[StreamSpec]:
    first = [_spec(track) for track in drafts[0].take.tracks]
    lags = [draft.lag for draft in drafts if draft.lag is not None]
    if len(lags) == len(drafts):
        sensor = signal_of((spec.name, spec.traits) for spec in first)
        half = 1.96 * max(lag.sigma for lag in lags)
        method = {"method": "agreement with the force at import", "interval_s": [-half, half]}
        measured = {"latency": 0.0, "latency_calibration": method}
        first = [
            replace(spec, attrs=spec.attrs | measured) if spec.name == sensor else spec
            for spec in first
        ]
    for draft in drafts[1:]:
        own = [_spec(track) for track in draft.take.tracks]
        if [(each.name, each.columns) for each in own] != [
            (each.name, each.columns) for each in first
        ]:
            raise SessionError(
                f"{draft.take.name}: found {_text(own)}; {drafts[0].take.name} of the same object "
                f"has {_text(first)}; allowed: recordings with the same streams"
            )
    return first


def _text(specs: Sequence[StreamSpec]) -> str:
    return ", ".join(
        f"{spec.name} {'x'.join(map(str, spec.value.shape)) if spec.value else ''}".strip()
        for spec in specs
    )


def _spec(track: RecordedTrack) -> StreamSpec:
    content = track.content
    device = {"device": "imported", "rate_hz": content.rate_hz}
    counted: dict[str, Any] = {"clock": "none", "numbering": "host"}
    if isinstance(content, Film):
        height, width = content.shape
        return camera_spec(
            content.rate_hz,
            name=track.stream,
            height=height,
            width=width,
            codec=content.codec,
            device=device,
            clock="none",
        )
    if track.kind == "force":
        return force_spec(content.rate_hz, name=track.stream, **counted, **content.attrs)
    if track.kind == "taxels":
        return taxels_spec(content.rate_hz, name=track.stream, **counted, device=device)
    slow = max(0.02, 2.0 / content.rate_hz)
    if track.kind == "pose":
        return pose_spec(
            content.rate_hz, name=track.stream, clock="none", device=device, max_age=slow
        )
    value = Column(
        "value",
        "float64",
        content.value.shape[1:],
        units="m" if track.kind == "width" else "1",
        dims=("number",),
        description="width of the gripper" if track.kind == "width" else "numbers as imported",
    )
    time = Column("t_ns", "int64", units="ns", description="time since the start of the recording")
    attrs = {"kind": "values", "clock": "none", "device": device, "max_age": slow}
    return StreamSpec(track.stream, (value, time), content.rate_hz, attrs)


def _rows(track: RecordedTrack, columns: Sequence[Column], end_ns: int) -> Rows:
    """Yield the samples of a track before a time, with all columns of its stream."""
    content = track.content
    times = content.t_ns[content.t_ns < end_ns].tolist()
    values = content.load() if isinstance(content, Film) else content.value
    for number, (t_ns, value) in enumerate(zip(times, values, strict=False), 1):
        row = {
            "value": value,
            "device_t": math.nan,
            "seq": number,
            "status": 0,
            "speed_scaling": 1.0,
            "t_ns": t_ns,
        }
        yield {column.name: row[column.name] for column in columns}


def _reference(
    draft: Draft, run: int, specs: Sequence[StreamSpec], rows_before: dict[str, int]
) -> dict[str, Any]:
    """Return the row of `reference` of a recording: its middle image and its means."""
    row: dict[str, Any] = {}
    for column in reference_spec(specs).columns:
        number = column.dtype.startswith("float")
        row[column.name] = np.full(column.shape, np.nan) if number else -1
    row |= {"point": 0, "run": run, "t_ns": draft.no_contact[0]}
    row |= {"wrench": np.zeros(6), "wrench_std": np.zeros(6)}
    filled: set[str] = set()
    for track, spec in zip(draft.take.tracks, specs, strict=True):
        kind, content = spec.traits.defaults, track.content
        name = kind.column if kind.column and kind.column not in filled else spec.name
        filled.add(name)
        inside = _inside(content.t_ns, draft.no_contact)
        if name not in row or not inside.size:
            continue
        if isinstance(content, Film):
            row[name] = rows_before[track.stream] + int(inside[len(inside) // 2])
            continue
        values = np.asarray(content.value[inside], np.float64)
        row[name] = np.nan_to_num(values.mean(axis=0))
        if f"{name}_std" in row:
            row[f"{name}_std"] = np.nan_to_num(values.std(axis=0))
    return row


def _inside(t_ns: Times, span: Span) -> NDArray[np.intp]:
    return np.flatnonzero((t_ns >= span[0]) & (t_ns < span[1]))


def _digests(drafts: Sequence[Draft]) -> dict[str, dict[str, Any]]:
    """Return name and SHA-256 of each file; for a folder, over its files in order of the names."""
    return {
        f"{draft.take.name}/{path.name}": {"name": path.name, "sha256": _sha256(path)}
        for draft in drafts
        for path in draft.take.files
    }


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(each for each in path.rglob("*") if each.is_file()) or [path]:
        if file != path:
            name = file.relative_to(path).as_posix()
            digest.update(f"{name} {file.stat().st_size}\n".encode())
        with file.open("rb") as content:
            hashlib.file_digest(content, lambda: digest)
    return digest.hexdigest()
