"""The layout of a collection run: pictures or taxels, forces and poses, phase by phase.

    <sensor>/image/<indenter>-<YYYYmmdd_HHMMSS>/<point>/<phase>/%04d.jpg, ref.jpg above the points
    <sensor>/uskin_raw/<run>/<point>/<phase>/%04d.npy                     counts minus ref.npy
    <sensor>/force/<run>/<point>/<phase>/ft.csv
    <sensor>/pose/<run>/<point>/<phase>/pose.csv

Phases are normal_inc, shear_inc, shear_dec, normal_dec; down and up in force-depth runs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.data.genforce.format import (
    NO_LOCATION,
    Array,
    GenForcePress,
    read_array,
    read_forces,
    read_poses,
)
from learning.data.genforce.training import contact_points, frame_files
from learning.errors import LearningError
from recorder import SessionError
from recorder.markers import HEIGHT, WIDTH
from recorder.spec import PHASES
from recorder.store import decode_jpeg

_RUN = re.compile(r"(.+)-\d{8}_\d{6}")
# Phases of force-depth runs, and their codes.
FORCE_DEPTH: Mapping[str, int] = {
    "down": PHASES.index("normal_inc"),
    "up": PHASES.index("normal_dec"),
}


@dataclass(frozen=True, slots=True, eq=False)
class RawSensor:
    """Content of the folders of one sensor."""

    name: str
    taxels: bool
    """True if frames are taxel counts; else they are pictures."""
    presses: tuple[GenForcePress, ...]
    references: tuple[Path, ...]
    """The picture without contact of each run."""


def is_raw(root: Path) -> bool:
    """Return True if a folder has this layout, for one sensor or several."""
    return bool(_sensors(root))


def indenters_of(root: Path) -> set[str]:
    """Return the names of the indenters in a folder."""
    return {_indenter(run) for sensor in _sensors(root) for run in _runs(sensor)}


def read_raw(
    root: Path, codes: Mapping[str, int], turns: Mapping[str, float] | None = None
) -> Iterator[RawSensor]:
    """Yield the sensors of a folder, without opening frames.

    Depth is measured downwards from the first pose of the press, position from the first pose of
    the run.

    Args:
        root: The folder of a sensor, or its parent.
        codes: Codes of the indenters, by name; locations are numbered by them.
        turns: Angle from the robot's x axis to the image's, counter-clockwise, by sensor [rad].
            Without one, positions stay in the robot's frame.
    """
    sensors, turns = _sensors(root), turns or {}
    if unknown := sorted(set(turns) - {sensor.name for sensor in sensors}):
        raise LearningError(
            f"turn: found {', '.join(unknown)}; allowed: "
            f"{', '.join(sensor.name for sensor in sensors)}"
        )
    targets = max(
        int(point.name)
        for sensor in sensors
        for run in _runs(sensor)
        for point in contact_points(run)
    )
    for sensor in sensors:
        taxels = not (sensor / "image").is_dir()
        presses: list[GenForcePress] = []
        references = []
        known: dict[tuple[str, bool], Path] = {}
        for number, run in enumerate(_runs(sensor)):
            if not taxels:
                references.append(_reference(run))
            located = not (contact_points(run)[0] / "down").is_dir()
            other = known.setdefault((_indenter(run), located), run)
            if other is not run:
                raise LearningError(
                    f"{run}: found {_indenter(run)}, as in {other.name}; expected one run for an "
                    "indenter"
                )
            of_run = _presses(sensor, run, located, codes, targets, 0 if taxels else number)
            presses += turned(of_run, turns.get(sensor.name, 0.0))
        yield RawSensor(sensor.name, taxels, tuple(presses), tuple(references))


def turned(presses: Iterable[GenForcePress], angle: float) -> tuple[GenForcePress, ...]:
    """Return presses whose positions are turned into an image.

    Args:
        presses: Presses along the axes of the robot.
        angle: Angle from the robot's x axis to the image's, counter-clockwise [rad].
    """
    return tuple(replace(press, position=_turned(press.position, -angle)) for press in presses)


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Read the pixels (480, 640, 3) of a camera's JPEG, RGB, decoded as sessions decode it."""
    try:
        return decode_jpeg(path.read_bytes(), (HEIGHT, WIDTH, 3))
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except SessionError as error:
        raise LearningError(f"{path}: {error}") from error


def read_counts(path: Path) -> Array:
    """Read the counts (16, 3) in a file of taxels."""
    array = read_array(path)
    if array.shape != (16, 3) or array.dtype.kind not in "iuf":
        raise LearningError(f"{path}: found {array.dtype} {array.shape}; expected numbers (16, 3)")
    counts = array.astype(np.float64)
    if not np.isfinite(counts).all():
        raise LearningError(f"{path}: found NaN or infinity; expected counts")
    return counts


def _presses(
    sensor: Path,
    run: Path,
    located: bool,
    codes: Mapping[str, int],
    targets: int,
    reference: int,
) -> Iterator[GenForcePress]:
    phases = {name: code for code, name in enumerate(PHASES)} if located else FORCE_DEPTH
    origin: Array | None = None
    for point in contact_points(run):
        target = int(point.name) - 1
        files: list[Path] = []
        codes_of: list[int] = []
        wrenches: list[Array] = []
        poses: list[Array] = []
        for phase, code in phases.items():
            folder = point / phase
            if not folder.is_dir():
                raise LearningError(f"{folder}: no such folder; expected {', '.join(phases)}")
            some = frame_files(folder)
            files += some
            codes_of += [code] * len(some)
            place = Path(run.name) / point.name / phase
            wrenches.append(_wrench(sensor / "force" / place / "ft.csv", some))
            poses.append(_pose(sensor / "pose" / place / "pose.csv", some))
        pose = np.concatenate(poses)
        origin = pose[0] if origin is None else origin
        code = codes[_indenter(run)]
        location = code * targets + target if located else NO_LOCATION
        yield GenForcePress(
            indenter=_indenter(run),
            target=target if located else targets + target,
            files=tuple(files),
            phase=np.array(codes_of),
            wrench=np.concatenate(wrenches),
            depth=np.maximum(pose[0, 2] - pose[:, 2], 0.0),
            position=pose[:, :2] - origin[:2],
            location=np.full(len(files), location),
            reference=reference,
        )


def _turned(places: Array, angle: float) -> Array:
    """Return places (n, 2) turned counter-clockwise by an angle [rad]; as they are by 0."""
    if angle == 0:
        return places
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.asarray(places @ np.array([[cosine, sine], [-sine, cosine]]))


def _wrench(path: Path, files: tuple[Path, ...]) -> Array:
    if not path.parents[3].is_dir():
        return np.full((len(files), 6), np.nan)
    wrench, _ = read_forces(path)
    _require_as_many(path, len(wrench), files)
    return wrench


def _pose(path: Path, files: tuple[Path, ...]) -> Array:
    poses = read_poses(path)
    _require_as_many(path, len(poses), files)
    return poses


def _require_as_many(path: Path, rows: int, files: tuple[Path, ...]) -> None:
    if rows != len(files):
        raise LearningError(f"{path}: found {rows} rows; {files[0].parent} has {len(files)} frames")


def _sensors(root: Path) -> list[Path]:
    some = [root, *sorted(path for path in root.iterdir() if path.is_dir())]
    return [path for path in some if _runs(path)]


def _runs(sensor: Path) -> list[Path]:
    for modality in ("image", "uskin_raw"):
        folder = sensor / modality
        if folder.is_dir():
            runs = [path for path in folder.iterdir() if _RUN.fullmatch(path.name)]
            return sorted(runs)
    return []


def _indenter(run: Path) -> str:
    return run.name.rpartition("-")[0]


def _reference(run: Path) -> Path:
    path = run / "ref.jpg"
    if not path.is_file():
        raise LearningError(f"{path}: no such file; expected the reference without contact")
    return path
