"""Folder layouts of the GenForce recordings, so that scripts made for them can read ours.

A session takes that of their collections:

    <modality>/<indenter>-<YYYYmmdd_HHMMSS>/<point 1..N>/<phase>/...

with the modalities `force` (ft.csv), `pose` (pose.csv), `image` (%04d.jpg, ref.jpg next to the
points) or `uskin_raw` (%04d.npy, ref.npy), and `path` (planned targets). The files have no times:
row k of a file belongs to image k of its folder, which the frames view ensures.

A marker archive takes that of their training:

    img/npy/<sensor>/<indenter>/<point 1..N>/%04d.npy   packed masks; last.csv: ends of the phases
    force/..., depth/...                                ft.csv; inc_z.csv, dec_z.csv [mm]
"""

import csv
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.archive import ArchivedSensor, MarkerArchive
from recorder.convert.export import Options, file_name
from recorder.convert.runs import RecordedPress, need_presses, utc_offset
from recorder.errors import SessionError
from recorder.progress import ReportItems
from recorder.session.columns import Stream
from recorder.session.frames import resting
from recorder.session.reader import Session
from recorder.spec import AXES, PHASES
from recorder.store import images

FORCE_COLUMNS = ("Fx(N)", "Fy(N)", "Fz(N)", "Tx(Nmm)", "Ty(Nmm)", "Tz(Nmm)")
POSE_COLUMNS = ("X(m)", "Y(m)", "Z(m)", "RX(rad)", "RY(rad)", "RZ(rad)")
# Folder of the first stream of a kind.
_FOLDERS = {"camera": "image", "taxels": "uskin_raw", "force": "force", "pose": "pose"}
_QUALITY = 100  # only for sessions without JPEG bytes

Array = np.ndarray[Any, Any]


def write(session: Session, path: Path, options: Options, progress: ReportItems) -> None:
    """Write a session as the folders of one sensor."""
    folders = _folders(session)
    if not {"camera", "taxels"} & {session.streams[name].traits.kind for name in folders}:
        raise SessionError(f"{session.name}: has neither camera nor taxels")
    complete, phase, missing = _complete(session, folders), session.frames["phase"], 0
    presses = []
    for press in need_presses(session, valid_only=options.valid_only):
        rows = press.rows[complete[press.rows]]
        missing += len(press.rows) - len(rows)
        # The scripts read four folders per point.
        if len(np.unique(phase[rows])) == len(PHASES):
            presses.append(replace(press, rows=rows))
    if not presses:
        raise SessionError(f"{session.name}: no press has all of {', '.join(PHASES)}")
    base = path / file_name(session.attrs.get("sensor", "sensor"))
    name = f"{file_name(session.attrs.get('indenter', 'indenter'))}-{_stamp(session, presses[0])}"
    for stream, folder in folders.items():
        _reference(session, stream, base / folder / name)
    _path(session, base / "path" / name, presses)
    lines = []
    if left_out := sorted(set(session.streams) - set(folders)):
        lines.append("Streams of kinds that this layout has no folder for: " + ", ".join(left_out))
    if missing:
        lines.append(f"Rows in which a stream has no sample near enough: {missing}")
    if lines:
        (base / "not-exported.txt").write_text("\n".join(lines) + "\n")
    total, done = sum(len(press.rows) for press in presses), 0
    for point, press in enumerate(presses, start=1):
        for code, folder_of_phase in enumerate(PHASES):
            rows = press.rows[phase[press.rows] == code]
            relative_path = Path(name) / str(point) / folder_of_phase
            for stream, folder in folders.items():
                _write_rows(session, stream, base / folder / relative_path, rows)
            done += len(rows)
            progress(done, total)


def _folders(session: Session) -> dict[str, str]:
    """Return the folder of each stream: that of its kind, with its name if it is not the first."""
    folders = {}
    for name, column in session.columns.items():
        kind = session.streams[name].traits.kind
        if kind in _FOLDERS and column in session.frames:
            first = name == session.first(kind)
            folders[name] = _FOLDERS[kind] if first else f"{_FOLDERS[kind]}_{file_name(name)}"
    return folders


def _complete(session: Session, streams: Iterable[str]) -> NDArray[np.bool_]:
    """True for frames (n,) in which every stream has a value; axes may be declared unmeasured."""
    complete = np.ones(len(session.frames["t_ns"]), bool)
    for name in streams:
        values, kind = session.frames[session.columns[name]], session.streams[name].traits.kind
        if kind == "camera":
            complete &= values >= 0
            continue
        unknown = np.isnan(values.reshape(len(values), int(np.prod(values.shape[1:]))))
        complete &= ~(unknown.any(axis=1) if kind == "taxels" else unknown.all(axis=1))
    return complete


def _write_rows(session: Session, name: str, folder: Path, rows: Array) -> None:
    stream, values = session.streams[name], session.frames[session.columns[name]][rows]
    kind = stream.traits.kind
    if kind == "force":
        _write_forces(folder, values)
    elif kind == "pose":
        _write_csv(folder / "pose.csv", POSE_COLUMNS, values)
    elif kind == "camera":
        folder.mkdir(parents=True)
        for number, data in enumerate(_jpegs(stream, [int(row) for row in values])):
            (folder / f"{number:04d}.jpg").write_bytes(data)
    else:
        folder.mkdir(parents=True)
        rest = np.rint(resting(session, session.columns[name]))
        change = np.rint(values - rest).astype(np.int64)
        for number, counts in enumerate(change):
            np.save(folder / f"{number:04d}.npy", counts)


def _jpegs(camera: Stream, rows: Sequence[int]) -> Iterator[bytes]:
    if camera.jpeg_shape is not None:
        yield from camera.jpegs(rows)
        return
    yield from (images.encode_jpeg(camera.images([row])[0], _QUALITY) for row in rows)


def _reference(session: Session, name: str, folder: Path) -> None:
    """Write ref.jpg, the first image without contact, or ref.npy, the counts without contact."""
    stream = session.streams[name]
    if stream.traits.kind == "camera":
        rows = session.reference[session.columns[name]]
        rows = rows[rows >= 0]
        row = int(rows[0]) if len(rows) else 0
        folder.mkdir(parents=True)
        (folder / "ref.jpg").write_bytes(next(_jpegs(stream, [row])))
    elif stream.traits.kind == "taxels":
        folder.mkdir(parents=True)
        rest = np.rint(resting(session, session.columns[name])).astype(np.int64)
        np.save(folder / "ref.npy", rest)


def _path(session: Session, folder: Path, presses: Sequence[RecordedPress]) -> None:
    """Write the planned positions (n, 6), one row per point folder, without a header.

    The session plans positions but no rotations: those are taken from the first pose of the press.
    """
    folder.mkdir(parents=True)
    planned = session.targets.get("planned")
    lines = []
    for press in presses:
        pose = session.frames["pose"][press.rows[0]].copy()
        if planned is not None and press.target < len(planned):
            pose[:3] = planned[press.target]
        lines.append(pose)
    stamp = folder.name.rpartition("-")[2]
    np.savetxt(folder / f"{stamp}.csv", np.array(lines), fmt="%f", delimiter=",")


def _write_forces(folder: Path, wrench: Array) -> None:
    """Write forces and torques (n, 6) [N, N m]."""
    _write_csv(folder / "ft.csv", FORCE_COLUMNS, wrench * [1, 1, 1, 1e3, 1e3, 1e3])


def _write_csv(path: Path, names: Sequence[str], rows: Array) -> None:
    """Write rows of numbers, which are restored exactly, under a header into a new folder."""
    path.parent.mkdir(parents=True)
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(names)
        out.writerows([repr(float(value)) for value in row] for row in rows)


def _stamp(session: Session, press: RecordedPress) -> str:
    """Return the start of the first press as YYYYmmdd_HHMMSS in UTC."""
    began = int(session.frames["t_ns"][press.rows[0]]) + utc_offset(session, press.run)
    return datetime.fromtimestamp(began // 10**9, UTC).strftime("%Y%m%d_%H%M%S")


# Marker archives.

NAMED = 5
# Attribute `depth` of sensors of which no depth is known.
DEPTH_UNKNOWN = "unknown: 0"
# Phases with depths in inc_z.csv; the others' are in dec_z.csv.
LOADING = (PHASES.index("normal_inc"), PHASES.index("shear_inc"))


def write_archive(
    archive: MarkerArchive, root: Path, _options: Options, progress: ReportItems
) -> tuple[str, ...]:
    """Write an archive in the layout of the authors' training; return descriptions of omissions.

    Contact points are numbered from 1 by target; frames are numbered through all phases. The layout
    has no times, positions or validity.
    """
    if archive.warning:
        raise SessionError(archive.warning)
    omitted: list[str] = []
    presses_of = {name: list(_presses(sensor, omitted)) for name, sensor in archive.items()}
    total = sum(len(rows) for presses in presses_of.values() for rows in presses)
    if not total:
        raise SessionError(f"{archive.name}: no press has all of {', '.join(PHASES)}")
    done = 0
    axes: Counter[tuple[str, str]] = Counter()
    for name, presses in presses_of.items():
        if not presses:
            continue
        sensor, plain = archive[name], file_name(name)
        _sensor(root, plain, sensor, omitted)
        for rows in presses:
            if lacking := _press(root, plain, archive, sensor, rows):
                axes[name, lacking] += 1
            done += len(rows)
            progress(done, total)
    omitted[:0] = [
        f"{name}: labels of {count} presses, which lack {lacking}; ft.csv holds all axes or none"
        for (name, lacking), count in axes.items()
    ]
    if len(omitted) > NAMED:
        omitted[NAMED:] = [f"and {len(omitted) - NAMED} more"]
    return tuple(omitted)


def _presses(sensor: ArchivedSensor, omitted: list[str]) -> Iterator[Array]:
    """Yield the rows of presses that have the four phases in order, frame by frame."""
    table = sensor.table
    order = np.lexsort((table["frame"], table["target"], table["indenter"])).astype(np.int64)
    press = np.stack([table["indenter"][order], table["target"][order]], axis=1)
    change = np.flatnonzero((np.diff(press, axis=0) != 0).any(axis=1)) + 1
    for rows in np.split(order, change):
        phase = table["phase"][rows]
        target = f"{sensor.name}, target {table['target'][rows[0]]} of {_indenter(sensor, rows)}"
        if (np.unique(phase).tolist() != list(range(len(PHASES)))) or (np.diff(phase) < 0).any():
            omitted.append(f"{target}: has not all of {', '.join(PHASES)}")
        elif (table["location"][rows] < 0).any():
            omitted.append(f"{target}: is at no location")
        elif not table["valid"][rows].all():
            omitted.append(f"{target}: has frames that are not there")
        else:
            yield rows


def _sensor(root: Path, name: str, sensor: ArchivedSensor, omitted: list[str]) -> None:
    masks = root / "img" / "npy"
    masks.mkdir(parents=True, exist_ok=True)
    np.save(masks / f"{name}_ref.npy", sensor.references[0])
    if len(sensor.references) > 1:
        omitted.append(f"{name}: {len(sensor.references) - 1} references beside the first")
    if (curves := sensor.attrs.get("force_depth")) is not None:
        folder = root / "material_compensation"
        folder.mkdir(exist_ok=True)
        for half in ("down", "up"):
            _write_numbers(folder / f"{name}_{half}.csv", curves[half])


def _press(
    root: Path, name: str, archive: MarkerArchive, sensor: ArchivedSensor, rows: Array
) -> str:
    """Write a press; return the axes without which its labels had to be left out, if any."""
    table = sensor.table
    shape = file_name(archive.indenters[int(table["indenter"][rows[0]])])
    relative_path = Path(name) / shape / str(int(table["target"][rows[0]]) + 1)
    masks = root / "img" / "npy" / relative_path
    masks.mkdir(parents=True)
    names = [f"{number:04d}.npy" for number in range(len(rows))]
    for file, packed in zip(names, sensor.packed(rows), strict=True):
        np.save(masks / file, packed)
    phase = table["phase"][rows]
    last = [int(np.flatnonzero(phase == code)[-1]) for code in range(len(PHASES))]
    ends = "".join(f"{relative_path.as_posix()}/{names[number]}\n" for number in last)
    (masks / "last.csv").write_text(ends)
    wrench = table["wrench"][rows]
    finite = np.isfinite(wrench)
    if finite.all():
        _write_forces(root / "force" / relative_path, wrench)
    if sensor.attrs.get("depth") != DEPTH_UNKNOWN:
        folder = root / "depth" / relative_path
        folder.mkdir(parents=True)
        depth_mm, loading = table["depth"][rows] * 1e3, np.isin(phase, LOADING)
        _write_numbers(folder / "inc_z.csv", depth_mm[loading])
        _write_numbers(folder / "dec_z.csv", depth_mm[~loading])
    return " ".join(np.array(AXES)[~finite.all(axis=0)]) if finite.any() else ""


def _indenter(sensor: ArchivedSensor, rows: Array) -> str:
    (line,) = sensor.provenance(rows[:1])
    message = json.loads(line)
    return str(message.get("folder") or message.get("session") or f"row {rows[0]}")


def _write_numbers(path: Path, values: Iterable[float]) -> None:
    """Write depths [mm] or coefficients, one per line; they are restored exactly."""
    path.write_text("".join(f"{float(value)!r}\n" for value in values))
