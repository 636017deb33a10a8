"""The layout of training data: a folder of packed masks for each contact point.

    img/npy/<Sensor>/<indenter>/<point>/%04d.npy, last.csv     (or img/<Sensor>/..., .jpg)
    img/npy/<Sensor>_ref.npy                                   (or .jpg)
    img/npy_csv/<Sensor>/<indenter>/<point>/last.csv           (if it is not next to the masks)
    force/<Sensor>/<indenter>/<point>/ft.csv
    depth/<Sensor>/<indenter>/<point>/inc_z.csv, dec_z.csv     (not in the homogeneous test)

Frames are numbered through all four phases; last.csv names the last frame of each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.data.genforce.format import (
    SUFFIXES,
    Array,
    GenForcePress,
    Packed,
    phases_of,
    read_depths,
    read_forces,
    read_last,
    read_mask,
)
from learning.errors import LearningError
from recorder.convert import DEPTH_UNKNOWN
from trajectories import PressShear, Target

PLACE_UNKNOWN = "unknown: 0"
# Source of depths and positions that a plan tells: the folder has its ends of phases, no times.
BY_PLAN = "the plan, by the number of the press; evenly spaced within a phase"
# Surface heights of the authors' heterogeneous test, where depth is 0 [mm]: these files hold
# heights, normalised by these values. Elsewhere the files hold depths.
SURFACES_MM: Mapping[str, float] = {
    "uskin": 1.08649,
    "tactip": 4.648126681,
    "gelsight": 1.12310475,
}


@dataclass(frozen=True, slots=True, eq=False)
class TrainingSensor:
    """Content of the folders of one sensor."""

    name: str
    reference: Packed
    presses: tuple[GenForcePress, ...]
    depths: str
    """Description of the source of depths."""
    positions: str
    """Description of the source of positions."""
    torques: bool
    """True if forces include torques."""


def is_training(root: Path) -> bool:
    """Return True if a folder has this layout."""
    return (root / "img").is_dir()


def read_training(
    root: Path,
    codes: Mapping[str, int],
    surfaces_mm: Mapping[str, float],
    plans: Mapping[str, PressShear],
) -> Iterator[TrainingSensor]:
    """Yield the sensors of a folder; of the masks, only references are opened.

    Args:
        root: The folder that contains `img`.
        codes: Codes of the indenters, by name; locations are numbered by them.
        surfaces_mm: Sensors whose depth files hold heights, and the height of their surface [mm].
        plans: Plans of sensors: the number of a press tells its place, direction and depth.
    """
    images = _images(root)
    sensors = _folders(images)
    if unknown := sorted(set(plans) - {sensor.name for sensor in sensors}):
        names = ", ".join(sensor.name for sensor in sensors)
        raise LearningError(f"plan: found one of {', '.join(unknown)}; {root} has {names}")
    if not sensors:
        raise LearningError(f"{images}: found no folder of a sensor")
    for sensor in sensors:
        if not _folders(sensor):
            raise LearningError(f"{sensor}: found no folder of an indenter")
    targets = max(
        int(point.name)
        for sensor in sensors
        for one in _folders(sensor)
        for point in contact_points(one)
    )
    for sensor in sensors:
        yield _sensor(root, images, sensor, codes, targets, surfaces_mm, plans.get(sensor.name))


def indenters_of(root: Path) -> set[str]:
    """Return the names of the indenters in a folder."""
    return {one.name for sensor in _folders(_images(root)) for one in _folders(sensor)}


def frame_files(folder: Path) -> tuple[Path, ...]:
    """Return the files of the frames in a folder, in order."""
    files = [path for path in folder.iterdir() if path.suffix in SUFFIXES]
    files = sorted(path for path in files if path.stem.isdecimal())
    if not files:
        raise LearningError(f"{folder}: found no frames; expected 0000.npy or 0000.jpg and so on")
    if len({path.suffix for path in files}) > 1:
        raise LearningError(f"{folder}: found .npy and .jpg; expected one kind")
    for number, path in enumerate(files):
        if int(path.stem) != number:
            raise LearningError(f"{folder}: found {path.name}; expected frame {number:04d}")
    return tuple(files)


def _sensor(
    root: Path,
    images: Path,
    folder: Path,
    codes: Mapping[str, int],
    targets: int,
    surfaces_mm: Mapping[str, float],
    plan: PressShear | None,
) -> TrainingSensor:
    name = folder.name
    reference = _reference(images, name)
    planned = () if plan is None else tuple(plan.targets())
    presses, torques = [], True
    known: set[bool] = set()
    for indenter in _folders(folder):
        for point in contact_points(indenter):
            files = frame_files(point)
            place = Path(name) / indenter.name / point.name
            wrench, whole = _forces(root / "force" / place / "ft.csv", files)
            depth = _depth(root / "depth" / place, files, surfaces_mm.get(name))
            known.add(depth is not None)
            torques &= whole
            target = int(point.name) - 1
            count = len(files)
            phase = phases_of(read_last(_last(images, place), count))
            tip = np.zeros((count, 3))
            if plan is not None:
                if target >= len(planned):
                    raise LearningError(
                        f"{point}: found press {target + 1}; its plan has {len(planned)}"
                    )
                tip = _along(plan, planned[target], phase)
                depth = np.maximum(-tip[:, 2], 0.0) if depth is None else depth
            presses.append(
                GenForcePress(
                    indenter=indenter.name,
                    target=target,
                    files=files,
                    phase=phase,
                    wrench=wrench,
                    depth=np.zeros(count) if depth is None else depth,
                    position=tip[:, :2],
                    location=np.full(count, codes[indenter.name] * targets + target),
                )
            )
    if len(known) > 1:
        raise LearningError(f"{root / 'depth' / name}: has depths of some points; expected of all")
    depths = DEPTH_UNKNOWN if plan is None else BY_PLAN
    if known == {True}:
        depths = "inc_z.csv and dec_z.csv, mm"
        if name in surfaces_mm:
            depths += f" below {surfaces_mm[name]:g} mm"
    positions = PLACE_UNKNOWN if plan is None else BY_PLAN
    return TrainingSensor(name, reference, tuple(presses), depths, positions, torques)


def _along(plan: PressShear, target: Target, phase: NDArray[np.int64]) -> Array:
    """Return the planned tip at each frame of a press (n, 3) [m], z above the surface there.

    The last frame of a phase is at its end; those before are evenly spaced.
    """
    tip = np.empty((len(phase), 3))
    for move in plan.moves(target):
        rows = np.flatnonzero(phase == move.phase)
        way = np.linspace(0.0, 1.0, len(rows) + 1)[1:, None]
        tip[rows] = (1 - way) * np.array(move.start) + way * np.array(move.end)
    tip[:, 2] -= plan.height(*target.origin[:2])
    return tip


def _images(root: Path) -> Path:
    for name in ("img/npy", "img/jpg", "img"):
        if (root / name).is_dir():
            return root / name
    raise LearningError(f"{root}: found no img, img/npy or img/jpg")


def _reference(images: Path, sensor: str) -> Packed:
    for suffix in SUFFIXES:
        path = images / f"{sensor}_ref{suffix}"
        if path.exists():
            return read_mask(path)
    raise LearningError(
        f"{images / sensor}_ref.npy: no such file, nor .jpg; expected the reference"
    )


def _last(images: Path, place: Path) -> Path:
    beside = images / place / "last.csv"
    apart = images.with_name(f"{images.name}_csv") / place / "last.csv"
    return apart if apart.exists() and not beside.exists() else beside


def _forces(path: Path, files: tuple[Path, ...]) -> tuple[Array, bool]:
    """Return wrenches (n, 6), NaN if the sensor has no forces, and True if they include torques."""
    if not path.parents[2].is_dir():
        return np.full((len(files), 6), np.nan), True
    wrench, torques = read_forces(path)
    if len(wrench) != len(files):
        raise LearningError(
            f"{path}: found {len(wrench)} rows; {files[0].parent} has {len(files)} frames"
        )
    return wrench, torques


def _depth(folder: Path, files: tuple[Path, ...], surface_mm: float | None) -> Array | None:
    """Return depths (n,) [m], or None if there are none."""
    if not folder.is_dir():
        return None
    down, up = read_depths(folder / "inc_z.csv"), read_depths(folder / "dec_z.csv")
    values = np.concatenate([down, up])
    if len(values) != len(files):
        raise LearningError(
            f"{folder}: inc_z.csv and dec_z.csv have {len(down)} and {len(up)} values; "
            f"{files[0].parent} has {len(files)} frames"
        )
    depth = values if surface_mm is None else surface_mm - values
    return np.asarray(np.maximum(depth, 0.0) * 1e-3, np.float64)


def _folders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")


def contact_points(folder: Path) -> list[Path]:
    """Return the folders of contact points by number."""
    points = _folders(folder)
    for point in points:
        if not point.name.isdecimal() or int(point.name) < 1:
            raise LearningError(f"{point}: found no number; expected contact points 1, 2, ...")
    if not points:
        raise LearningError(f"{folder}: found no contact points; expected folders 1, 2, ...")
    return sorted(points, key=lambda point: int(point.name))
