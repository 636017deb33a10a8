"""Small sessions of the mock camera or of taxels: two presses of four phases, 0.1 s each."""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
import zarr
from support.dot_camera import MarkerCamera, PressedSurface
from support.marker_truth import VIEWS
from support.sessions import reseal

from recorder import (
    SessionWriter,
    StreamSpec,
    StreamWriter,
    camera_spec,
    force_spec,
    pose_spec,
    taxels_spec,
)
from recorder.store.documents import merge_attrs
from recorder.store.images import compress
from recorder.store.layout import ColumnLayout
from recorder.store.shard import ColumnLog

T0 = 5_000_000_000_000
PHASE_NS = 100_000_000
DEPTH, SHEAR = 1.0e-3, 0.5e-3
CONTACT_FRAME = [0.4, -0.1, 0.2, 0.0, 0.0, 0.0]
CAMERA_HZ, FORCE_HZ = 60.0, 200.0
SECONDS = 1.0
# Pictures with hidden markers.
HIDDEN = range(38, 41)
TARGETS = 2


def state(seconds: np.ndarray[Any, Any]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return depth and shear [m] at times since the start of the first phase."""
    cycle = np.where(seconds >= 0, seconds % 0.4, 0) * 10
    depth = DEPTH * np.interp(cycle, [0, 1, 3, 4], [-0.05, 1, 1, -0.05])
    return depth, SHEAR * np.interp(cycle, [1, 2, 3], [0, 1, 0])


def surface(depth: float, shear: float) -> PressedSurface:
    return PressedSurface((0.0, 0.0), max(depth, 0.0), 3e-3, 4e-3, (shear, 0.0))


def record(path: Path, kind: str = "camera") -> Path:
    """Record a session of a GelSight, or of a uSkin."""
    rates = {kind: CAMERA_HZ, "force": FORCE_HZ, "pose": CAMERA_HZ}
    spec = camera_spec(60, exposure=0.005) if kind == "camera" else taxels_spec(60)
    targets = {
        "point": np.ones(TARGETS, np.int16),
        "depth": np.full(TARGETS, DEPTH),
        "direction": np.arange(TARGETS, dtype=np.int16),
        "planned": np.zeros((TARGETS, 3)),
    }
    attrs = {
        "sensor": "gelsight" if kind == "camera" else "uskin",
        "indenter": "sphere",
        "contact_frame": CONTACT_FRAME,
        "started_utc": "2026-01-01T00:00:00Z",
    }
    specs = [spec, force_spec(FORCE_HZ), pose_spec(60)]
    rows = {name: rows_of(name, np.arange(0, SECONDS, 1 / rate)) for name, rate in rates.items()}
    return write_session(path, attrs, specs, targets, rows, first_ns=T0 + PHASE_NS, rate_hz=40)


def write_session(
    path: Path,
    attrs: dict[str, Any],
    specs: Sequence[StreamSpec],
    targets: dict[str, Any],
    rows: Mapping[str, Iterable[dict[str, Any]]],
    *,
    first_ns: int,
    rate_hz: float,
) -> Path:
    """Record rows of streams; four phases a target follow one another from a time on."""
    session = SessionWriter.create(path, attrs=attrs, streams=specs, targets=targets)
    with session:
        session.begin_run({"t0_ns": T0, "utc": attrs["started_utc"], "boot_id": "b"})
        for name, some in rows.items():
            with StreamWriter.open(session.stream_path(name), sync_interval=30) as stream:
                for row in some:
                    stream.append(**row)
        for number in range(4 * len(targets["point"])):
            start = first_ns + number * PHASE_NS
            session.segments.append(
                target=number // 4,
                phase=number % 4,
                outcome=0,
                run=0,
                start_ns=start,
                end_ns=start + PHASE_NS,
            )
        session.reference.append(
            point=1,
            image=0 if "camera" in rows else -1,
            wrench=np.zeros(6),
            wrench_std=np.full(6, 0.02),
            taxels=np.full((16, 3), 30_000.0 if "taxels" in rows else np.nan),
            run=0,
            t_ns=T0,
        )
        session.finish("complete", rate_hz=rate_hz)
    return path


def rows_of(name: str, seconds: np.ndarray[Any, Any]) -> list[dict[str, Any]]:
    """Return the rows of a stream at times since the start of the session."""
    depth, shear = state(seconds - 0.1)
    t_ns = T0 + np.round(seconds * 1e9).astype(np.int64)
    rows: list[dict[str, Any]] = [{"t_ns": int(time)} for time in t_ns]
    mock = MarkerCamera(VIEWS["bench-gelsight"], grey_noise=1.0)
    for number, row in enumerate(rows):
        down, aside = float(depth[number]), float(shear[number])
        pressed = max(down, 0.0) / DEPTH
        if name == "camera":
            picture = mock.image(surface(down, aside))
            if number in HIDDEN:
                picture[190:290, 130:250] = picture[190, 130]
            value = simplejpeg.encode_jpeg(picture, quality=95)
            row |= {"value": value, "device_t": seconds[number]}
        elif name == "force":
            value = np.array([-0.4 * aside / SHEAR, 0, -3.0, 0, 0.01, 0]) * pressed
            row |= {"value": value, "seq": number, "status": 0}
        elif name == "pose":
            value = np.add(CONTACT_FRAME, [aside, 0, -down, 0, 0, 0])
            row |= {"value": value, "device_t": seconds[number], "speed_scaling": 1.0}
        else:
            counts = np.full((16, 3), 30_000)
            counts[5] += np.array([1500 * aside / SHEAR, 200, 4000]).astype(int) * int(down > 0)
            row |= {"value": counts.astype(np.int32), "device_t": seconds[number], "seq": number}
    return rows


def rewrite(layout: ColumnLayout, values: Any) -> None:
    """Replace the rows of a small column, in shards as the recorder writes them."""
    rows = np.empty((layout.rows(), *layout.column.shape), layout.dtype)
    rows[:] = values
    shutil.rmtree(layout.path / "c")
    log = ColumnLog(layout, 0)
    for first in range(0, len(rows), layout.rows_per_chunk):
        chunk = np.zeros(layout.chunk_shape, layout.dtype)
        part = rows[first : first + layout.rows_per_chunk]
        chunk[: len(part)] = part
        log.append(compress(chunk.tobytes()), 0)
        log.seal_full()
    log.finish(len(rows))


def altered(source: Path, path: Path, arrays: dict[str, Any] | None = None, **attrs: Any) -> Path:
    """Copy a session, changing some attributes and values of its tables."""
    shutil.copytree(source, path)
    merge_attrs(path, attrs)
    for name, values in (arrays or {}).items():
        if (path / name).parent.name in ("targets", "frames"):
            with zarr.config.set({"array.write_empty_chunks": True}):
                zarr.open_array(path / name, mode="r+")[:] = values
        else:
            rewrite(ColumnLayout.load(path / name), values)
    reseal(path)
    return path
