"""Marker archives in the folder layout of GenForce's training data.

img/npy/<sensor>/<indenter>/<point 1..N>/%04d.npy   packed masks; last.csv: ends of the phases
force/..., depth/...                                ft.csv; inc_z.csv, dec_z.csv [mm]
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.archive import ArchivedSensor, MarkerArchive
from recorder.convert.export import Options, Progress, file_name
from recorder.convert.genforce_format import FORCE_COLUMNS, write_csv
from recorder.errors import SessionError
from recorder.spec import AXES, PHASES

Rows = NDArray[np.int64]
NAMED = 5
# Attribute `depth` of sensors of which no depth is known.
DEPTH_UNKNOWN = "unknown: 0"
# Phases with depths in inc_z.csv; the others' are in dec_z.csv.
LOADING = (PHASES.index("normal_inc"), PHASES.index("shear_inc"))


def write(
    archive: MarkerArchive, root: Path, _options: Options, progress: Progress
) -> tuple[str, ...]:
    """Write an archive in the layout of the authors' training; return descriptions of omissions.

    Contact points are numbered from 1 by target; frames are numbered through all phases. The layout
    has no times, positions or validity.
    """
    if archive.warning:
        raise SessionError(archive.warning)
    omitted: list[str] = []
    found = {name: list(_presses(sensor, omitted)) for name, sensor in archive.items()}
    total = sum(len(rows) for presses in found.values() for rows in presses)
    if not total:
        raise SessionError(f"{archive.name}: no press has all of {', '.join(PHASES)}")
    done = 0
    axes: dict[tuple[str, str], int] = {}
    for name, presses in found.items():
        if not presses:
            continue
        sensor, plain = archive[name], file_name(name)
        _sensor(root, plain, sensor, omitted)
        for rows in presses:
            lacking = _press(root, plain, archive, sensor, rows)
            if lacking:
                axes[name, lacking] = axes.get((name, lacking), 0) + 1
            done += len(rows)
            progress(done, total)
    unlabelled = [
        f"{name}: labels of {count} presses, which lack {lacking}; ft.csv holds all axes or none"
        for (name, lacking), count in axes.items()
    ]
    omitted[:0] = unlabelled
    if len(omitted) > NAMED:
        omitted[NAMED:] = [f"and {len(omitted) - NAMED} more"]
    return tuple(omitted)


def _presses(sensor: ArchivedSensor, omitted: list[str]) -> Iterator[Rows]:
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
    images = root / "img" / "npy"
    images.mkdir(parents=True, exist_ok=True)
    np.save(images / f"{name}_ref.npy", sensor.references[0])
    if len(sensor.references) > 1:
        omitted.append(f"{name}: {len(sensor.references) - 1} references beside the first")
    known: Mapping[str, Any] | None = sensor.attrs.get("force_depth")
    if known is not None:
        folder = root / "material_compensation"
        folder.mkdir(exist_ok=True)
        for half in ("down", "up"):
            _write_numbers(folder / f"{name}_{half}.csv", tuple(known[half]))


def _press(
    root: Path, name: str, archive: MarkerArchive, sensor: ArchivedSensor, rows: Rows
) -> str:
    """Write a press; return the axes without which its labels had to be left out, if any."""
    table = sensor.table
    shape = file_name(archive.indenters[int(table["indenter"][rows[0]])])
    place = Path(name) / shape / str(int(table["target"][rows[0]]) + 1)
    images = root / "img" / "npy" / place
    images.mkdir(parents=True)
    names = [f"{number:04d}.npy" for number in range(len(rows))]
    for file, packed in zip(names, sensor.packed(rows), strict=True):
        np.save(images / file, packed)
    phase = table["phase"][rows]
    last = [int(np.flatnonzero(phase == code)[-1]) for code in range(len(PHASES))]
    ends = "".join(f"{place.as_posix()}/{names[number]}\n" for number in last)
    (images / "last.csv").write_text(ends)
    wrench = table["wrench"][rows]
    if np.isfinite(wrench).all():
        scaled = wrench.copy()
        scaled[:, 3:] *= 1e3  # N m -> N mm
        write_csv(root / "force" / place / "ft.csv", FORCE_COLUMNS, scaled)
    if sensor.attrs.get("depth") != DEPTH_UNKNOWN:
        folder = root / "depth" / place
        folder.mkdir(parents=True)
        depth_mm, loading = table["depth"][rows] * 1e3, np.isin(phase, LOADING)
        _write_numbers(folder / "inc_z.csv", depth_mm[loading])
        _write_numbers(folder / "dec_z.csv", depth_mm[~loading])
    known = np.isfinite(wrench)
    if known.all() or not known.any():
        return ""
    return " ".join(np.array(AXES)[~known.all(axis=0)])


def _indenter(sensor: ArchivedSensor, rows: Rows) -> str:
    message = json.loads(sensor.sources[int(sensor.table["source"][rows[0]])])
    return str(message.get("folder") or message.get("session") or f"row {rows[0]}")


def _write_numbers(path: Path, values: Iterable[float]) -> None:
    """Write depths [mm] or coefficients, one per line; they are restored exactly."""
    path.write_text("".join(f"{float(value)!r}\n" for value in values))
