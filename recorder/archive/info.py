"""An archive in a page of text."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from recorder.archive.reader import ArchivedSensor, MarkerArchive
from recorder.markers import SMALLEST_PX, count_markers, unpack

_TITLES = ("frames", "shapes", "refs", "markers", "MB", "mm/px", "depth mm", "Fx N", "Fy N", "Fz N")
_WIDTHS = (8, 6, 5, 7, 9, 7, 12, 13, 13, 14)


def describe_archive(path: str | os.PathLike[str]) -> str:
    """Return what an archive holds: a line a sensor.

    Raises:
        SessionError: Not an archive, or a damaged table.
    """
    archive = MarkerArchive(path)
    lines = [f"{archive.name}  status {archive.status}, {len(archive)} sensor(s)"]
    if archive.warning:
        lines.append(f"warning: {archive.warning}")
    lines.append(f"  indenters    {', '.join(archive.indenters)}")
    told = {key: value for key, value in archive.attrs.items() if isinstance(value, str | int)}
    for key in ("format", "format_version", "status"):
        told.pop(key)
    lines += [f"  {key:12s} {value}" for key, value in told.items()]
    lines.append("")
    lines.append(f"{'sensor':16s}" + "".join(map(_cell, _TITLES, _WIDTHS)))
    lines += [_sensor_line(sensor, tables=not archive.warning) for sensor in archive.values()]
    return "\n".join(lines)


def _sensor_line(sensor: ArchivedSensor, *, tables: bool) -> str:
    smallest = (sensor.attrs.get("marker_check") or {}).get("smallest_px", SMALLEST_PX)
    markers = count_markers(unpack(sensor.references[0]), smallest)
    size = sum(sensor.files.sizes(sensor.path).values()) / 1e6
    shapes, depth, force = "-", "-", ["-"] * 3
    if tables:
        shapes = str(len(np.unique(sensor.table["indenter"])))
        depth = _span(sensor.table["depth"] * 1e3)
        force = [_span(axis) for axis in sensor.table["wrench"][:, :3].T]
    cells = (
        str(len(sensor)),
        shapes,
        str(len(sensor.references)),
        str(markers),
        f"{size:.2f}",
        f"{sensor.mm_per_px:.4f}",
        depth,
        *force,
    )
    return f"{sensor.name:16s}" + "".join(map(_cell, cells, _WIDTHS))


def _span(values: NDArray[np.float64]) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return "-"
    low, high = (round(float(value), 2) + 0.0 for value in (known.min(), known.max()))
    return f"{low:.2f} {high:.2f}"  # adding zero turned -0.0 into 0.0


def _cell(text: str, width: int) -> str:
    return f" {text:>{width}s}"
