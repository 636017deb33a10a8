"""Sessions for tests."""

import functools
import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray
from support.copies import copied

from recorder import (
    SessionWriter,
    StreamSpec,
    StreamWriter,
    camera_spec,
    depth_spec,
    event_row,
    events_spec,
    force_spec,
    joints_spec,
    pose_spec,
    taxels_spec,
)
from recorder.spec import reference_spec
from recorder.store.documents import write_group

Columns = dict[str, Any]
Change = Callable[[str, Columns], Columns]

T0 = 4_000_000_000_000_000  # a month after boot: float64 seconds cannot resolve ns at this value
RATES = {"camera": 60.0, "force": 1000.0, "pose": 125.0, "taxels": 60.0}
RATES |= {"depth": 30.0, "joints": 125.0, "events": 2.0}
CONTACT_FRAME = [0.4, -0.1, 0.2, 0.0, 0.0, 0.0]
PHASE_S = 0.4
DEPTH = 8e-4


def depth_at(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the indentation [m] for the four phases: press, shear, shear back, release."""
    cycle = seconds % (4 * PHASE_S) / PHASE_S
    return DEPTH * np.interp(cycle, [0, 1, 3, 4], [-0.05, 1, 1, -0.05])


def shear_at(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the tangential displacement [m]."""
    cycle = seconds % (4 * PHASE_S) / PHASE_S
    return 5e-4 * np.interp(cycle, [0, 1, 2, 3, 4], [0, 0, 1, 0, 0])


def picture(seconds: float, shape: tuple[int, int], noise: np.random.Generator) -> Any:
    """Return an image (h, w, 3) of a grid of markers that follows the contact.

    Large ones are painted coarsely, in blocks of equal pixels: they are many, and no test looks.
    """
    block = max(shape[0] // 120, 1)
    shape = (shape[0] // block, shape[1] // block)
    now = np.array([seconds])
    depth, shear = float(depth_at(now)[0]) / DEPTH, float(shear_at(now)[0]) / 5e-4
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    pitch = shape[1] / 10
    away_x, away_y = x - shape[1] / 2, y - shape[0] / 2
    bump = np.exp(-(away_x**2 + away_y**2) / (0.04 * shape[1] ** 2))
    x = x - bump * (0.5 * pitch * shear + 0.25 * max(depth, 0) * away_x / pitch)
    y = y - bump * 0.25 * max(depth, 0) * away_y / pitch
    marker = (np.cos(2 * np.pi * x / pitch) + np.cos(2 * np.pi * y / pitch)) > 1.2
    base = np.stack([150 + 40 * bump * depth, 120 - 30 * bump * depth, 170 - x * 0], axis=-1)
    base[marker] = 30
    base += noise.normal(0, 2, base.shape)
    return np.clip(base, 0, 255).astype(np.uint8).repeat(block, axis=0).repeat(block, axis=1)


def stream_columns(
    name: str, seconds: float, shape: tuple[int, int], codec: str, seed: int
) -> Columns:
    """Return all rows of one stream, `seconds` long, from `T0` on, for the caller to change.

    A name is a kind, or a kind and a number: `camera_2`.
    """
    made = _made(name, seconds, shape, codec, seed)
    return {column: values.copy() for column, values in made.items()}


@functools.cache
def _made(name: str, seconds: float, shape: tuple[int, int], codec: str, seed: int) -> Columns:
    name, _, number = name.partition("_")
    noise = np.random.default_rng([seed, len(name), *([int(number)] if number else [])])
    count = int(seconds * RATES[name])
    time = np.arange(count) / RATES[name]
    t_ns = T0 + np.round(time * 1e9).astype(np.int64) + noise.integers(0, 200_000, count)
    depth, shear = depth_at(time), shear_at(time)
    press = -3.0 * np.maximum(depth / DEPTH, 0) ** 1.5
    columns: Columns = {"t_ns": t_ns}
    if name == "camera":
        frames = [picture(t, shape, noise) for t in time]
        if codec == "jpeg":
            frames = [simplejpeg.encode_jpeg(frame, quality=90) for frame in frames]
        columns |= {"value": frames, "device_t": time + 12.5}
    if name == "force":
        value = noise.normal(0, 0.02, (count, 6))
        value[:, 2] += press
        value[:, 0] -= 0.4 * press * shear / 5e-4
        columns |= {"value": value, "seq": np.arange(count) + 100, "status": time.astype(int) * 0}
    if name == "pose":
        value = np.tile(CONTACT_FRAME, (count, 1))
        value[:, 2] -= depth
        value[:, 0] += shear
        columns |= {"value": value, "device_t": time, "speed_scaling": np.ones(count)}
    if name == "depth":
        value = noise.integers(0, 4000, (count, *shape, 1)).astype(np.uint16)
        columns |= {"value": value, "device_t": time}
    if name == "joints":
        value = np.sin(time)[:, None] * np.arange(6)
        columns |= {"value": value, "speed": np.zeros((count, 6)), "device_t": time}
    if name == "events":
        columns |= {"value": [event_row(f"event {row}: gelöst") for row in range(count)]}
    if name == "taxels":
        value = noise.normal(0, 2.1, (count, 16, 3)) + 30_000
        reach = np.exp(-np.hypot(*(np.mgrid[:4, :4] - 1.5)).ravel())
        value[:, :, 2] += 4000 * reach * np.maximum(depth, 0)[:, None] / DEPTH
        value[:, :, 0] += 2500 * reach * shear[:, None] / 5e-4
        columns |= {"value": value.astype(np.int32), "device_t": time, "seq": np.arange(count)}
    return columns


def specs(names: tuple[str, ...], shape: tuple[int, int], codec: str) -> list[StreamSpec]:
    """Return the specs of the named streams."""
    size = {"height": shape[0], "width": shape[1]}
    made: dict[str, Callable[[str], StreamSpec]] = {
        "camera": lambda name: camera_spec(60, name=name, codec=codec, exposure=0.01, **size),
        "force": lambda name: force_spec(1000, name=name),
        "pose": lambda name: pose_spec(125, name=name),
        "taxels": lambda name: taxels_spec(60, name=name),
        "depth": lambda name: depth_spec(30, name=name, **size),
        "joints": lambda name: joints_spec(125, name=name),
        "events": lambda name: events_spec(name=name, rate_hz=2),
    }
    return [made[name.partition("_")[0]](name) for name in names]


def append_all(path: Path, columns: Mapping[str, Any]) -> None:
    """Append rows given as columns."""
    with StreamWriter.open(path, sync_interval=30) as stream:
        for row in range(len(columns["t_ns"])):
            stream.append(**{name: values[row] for name, values in columns.items()})


def record_run(
    path: Path,
    columns: Mapping[str, Columns],
    *,
    streams: list[StreamSpec] | None = None,
    targets: Columns | None = None,
    segment: Mapping[str, int] | None = None,
    **finish: Any,
) -> Path:
    """Record a run of a session, which begins with it if `streams` are named."""
    if streams is None:
        writer = SessionWriter.resume(path)
    else:
        writer = SessionWriter.create(path, attrs={}, streams=streams, targets=targets or {})
    with writer as session:
        session.begin_run({"t0_ns": T0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})
        for name, rows in columns.items():
            append_all(session.stream_path(name), rows)
        if segment is not None:
            session.segments.append(**segment)
        session.finish("complete", **{"rate_hz": 40, **finish})
    return path


def make_session(
    path: Path,
    *,
    seconds: float = 3.6,
    names: tuple[str, ...] = ("camera", "force", "pose"),
    codec: str = "jpeg",
    shape: tuple[int, int] = (48, 64),
    change: Change | None = None,
    finish: bool = True,
    targets: Columns | None = None,
) -> Path:
    """Record a session of consecutive presses.

    `change` may plant a fault: it is called with every stream and table before it is written.
    Without it and `targets`, a session that this process has recorded before is copied; with
    `as_it_is` it is recorded in any case.
    """
    if change is None and targets is None:
        key = (seconds, names, codec, shape, finish)
        copied(path, ("session", *key), lambda made: _record(made, *key, as_it_is))
    else:
        _record(path, seconds, names, codec, shape, finish, change or as_it_is, targets)
    return path


def as_it_is(name: str, columns: Columns) -> Columns:
    """Return a stream or table unchanged."""
    return columns


def _record(
    path: Path,
    seconds: float,
    names: tuple[str, ...],
    codec: str,
    shape: tuple[int, int],
    finish: bool,
    change: Change,
    targets: Columns | None = None,
) -> None:
    targets = targets or {
        "point": np.arange(50, dtype=np.int16),
        "depth": np.full(50, DEPTH),
        "direction": np.zeros(50, np.int16),
        "planned": np.tile(np.add(CONTACT_FRAME[:3], (5e-4, 0, -DEPTH)), (50, 1)),
    }
    attrs = {"sensor": "wedge", "indenter": "sphere", "mock": True, "contact_frame": CONTACT_FRAME}
    session = SessionWriter.create(
        path, attrs=attrs, streams=specs(names, shape, codec), targets=targets
    )
    with session:
        session.begin_run({"t0_ns": T0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})
        for name in names:
            columns = change(name, stream_columns(name, seconds, shape, codec, seed=1))
            append_all(session.stream_path(name), columns)
        count = int((seconds - 0.2) / PHASE_S)
        start_ns = T0 + 100_000_000 + np.arange(count) * round(PHASE_S * 1e9)
        table = {
            "target": np.arange(count) // 4,
            "phase": np.arange(count) % 4,
            "outcome": np.zeros(count, int),
            "run": np.zeros(count, int),
            "start_ns": start_ns,
            "end_ns": start_ns + round(PHASE_S * 0.9e9),
        }
        table = change("segments", table)
        for row in range(len(table["target"])):
            session.segments.append(**{name: int(values[row]) for name, values in table.items()})
        row = {
            "point": 0,
            "image": 0 if "camera" in names else -1,
            "wrench": np.repeat([0.25, 0.0], 3),
            "wrench_std": np.full(6, 0.02),
            "taxels": np.full((16, 3), 30_000.0 if "taxels" in names else np.nan),
            "run": 0,
            "t_ns": T0,
        }
        # Further streams of a kind have columns of their own; gauge n is 0.25 n off.
        for column in reference_spec(specs(names, shape, codec)).columns:
            if column.name not in row:
                kind, number = column.name.removesuffix("_std").split("_")
                level = 30_000.0 if kind == "taxels" else 0.25 * int(number)
                row[column.name] = np.full(column.shape, level) if column.shape else 0
        session.reference.append(**row)
        if finish:
            session.finish("complete", rate_hz=40)


def edit_json(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change the metadata in a file, of which a manifest knows nothing."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def flip(path: Path, bit: int) -> None:
    """Change one bit of a file."""
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


def set_attrs(path: Path, **attrs: Any) -> None:
    """Change the attributes of a group as if the session had been closed with them."""
    edit_json(path / "zarr.json", lambda document: document["attributes"].update(attrs))
    reseal(next(place for place in (path, *path.parents) if (place / "manifest").exists()))


def reseal(session: Path, **renamed: str) -> None:
    """Make the manifest of a changed session match its files, whatever they contain.

    `renamed` is the name before of each stream that was renamed.
    """
    attrs = json.loads((session / "zarr.json").read_text())["attributes"]
    (newest,) = sorted((session / "manifest").glob("*/zarr.json"))[-1:]
    document = json.loads(newest.read_text())
    shutil.rmtree(session / "manifest")
    (session / "manifest").mkdir()
    write_group(session / "manifest", {})
    listed = document["attributes"]
    shards, files = {}, {}
    for path in session.rglob("*"):
        if path.is_file():
            key, data = str(path.relative_to(session)), path.read_bytes()
            place = key.split("/")
            if place[0] == "streams":
                place[1] = renamed.get(place[1], place[1])
            known = listed["shards"].get("/".join(place))
            if known:
                _, chunks, slots, _ = known
                end = hashlib.sha256(data[-20 * slots - 4 :]).hexdigest()
                shards[key] = [len(data), chunks, slots, end]
            else:
                files[key] = [len(data), hashlib.sha256(data).hexdigest()]
    run = max(len(attrs["runs"]) - 1, 0)
    changed = {"run": run, "previous": None, "files": files, "shards": shards}
    document["attributes"] = {**listed, **changed, "sha256": ""}
    body = json.dumps(document)
    own = hashlib.sha256(body.encode()).hexdigest()
    (session / "manifest" / str(run)).mkdir()
    (session / "manifest" / str(run) / "zarr.json").write_text(body[:-3] + own + body[-3:])
