"""Common parts of the layouts: presses, sensors made of them, and readers of their files."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from learning.archive_writer import CHUNK_ROWS, UNIT_ROWS, Frames
from learning.errors import LearningError
from learning.markers.flags import FLAG, Flagger
from recorder.archive import NO_PHASE, MarkerCount, SensorPlan
from recorder.convert import FORCE_COLUMNS, POSE_COLUMNS
from recorder.markers import HEIGHT, PACKED, WIDTH, pack, unpack

Array = NDArray[np.float64]
Packed = NDArray[np.uint8]
ReadMask = Callable[[Path], Packed]

NO_LOCATION = -1
# Value of `t_ns`: the folders have no times.
NO_TIME = 0


@dataclass(frozen=True, slots=True, eq=False)
class GenForcePress:
    """One contact point of one indenter, frame by frame."""

    indenter: str
    target: int
    """Number of the press within the indenter, from 0."""
    files: tuple[Path, ...]
    """File of each frame."""
    phase: NDArray[np.int64]
    """Phase code of each frame (n,); -1 for none."""
    wrench: Array
    """Forces and torques (n, 6) [N, N m]; NaN without a label."""
    depth: Array
    """Indentation (n,) [m]."""
    position: Array
    """Position (n, 2) [m]."""
    location: NDArray[np.int64]
    """Location of each frame (n,); -1 for none."""
    reference: int = 0
    """Row of the reference of its frames."""

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.files)


@dataclass(frozen=True, slots=True, eq=False)
class PublishedSensor:
    """One sensor of a folder; implements `learning.archive_writer.SensorFrames`."""

    name: str
    presses: tuple[GenForcePress, ...]
    references: Packed
    """Packed masks of the sensor without contact (K, 38400)."""
    indenters: tuple[str, ...]
    """Names, by code."""
    mm_per_px: float
    read_mask: ReadMask
    """Reads the packed mask (38400,) of a frame's file."""
    root: Path
    """Provenance gives files relative to it."""
    unseen: tuple[str, ...]
    """Indenters that models may not be trained on."""
    marker_count: MarkerCount | None = None
    """Settings of the marker count; None: markers are not counted."""
    attrs: Mapping[str, Any] = field(default_factory=dict)

    @property
    def plan(self) -> SensorPlan:
        """Plan of its part of the archive."""
        return SensorPlan(
            name=self.name,
            rows=sum(len(press) for press in self.presses),
            chunk_rows=CHUNK_ROWS,
            unit_rows=UNIT_ROWS,
            references=self.references,
            mm_per_px=self.mm_per_px,
            marker_count=self.marker_count,
            attrs=self.attrs,
        )

    def read(self, rows: slice) -> Frames:
        """Read some of the frames."""
        packed, parts = [], []
        lines: list[dict[str, Any]] = []
        begin = 0
        for press in self.presses:
            first, last = max(rows.start - begin, 0), min(rows.stop - begin, len(press))
            begin += len(press)
            if first >= last:
                continue
            packed += [self.read_mask(path) for path in press.files[first:last]]
            parts.append(self._table(press, first, last))
            line: dict[str, Any] = {
                "folder": press.files[0].parent.relative_to(self.root).as_posix(),
                "target": press.target,
            }
            lines += [dict(line) for _ in range(first, last)]
        table = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        frames = np.stack(packed)
        flagger = Flagger(self.name, self.references, self.marker_count)
        flags = flagger.flags(unpack(frames), table["reference"], table["valid"])
        for row, flag in flags.items():
            lines[row][FLAG] = flag
        return Frames(frames, table, [json.dumps(line, ensure_ascii=False) for line in lines])

    def _table(self, press: GenForcePress, first: int, last: int) -> dict[str, NDArray[Any]]:
        rows, count = slice(first, last), last - first
        return {
            "indenter": np.full(count, self.indenters.index(press.indenter)),
            "seen": np.full(count, press.indenter not in self.unseen),
            "location": press.location[rows],
            "target": np.full(count, press.target),
            "phase": press.phase[rows],
            "depth": press.depth[rows],
            "position": press.position[rows],
            "wrench": press.wrench[rows],
            "frame": np.arange(first, last),
            "t_ns": np.full(count, NO_TIME),
            "reference": np.full(count, press.reference),
            "valid": np.ones(count, np.bool_),
        }


def phases_of(last: Sequence[int]) -> NDArray[np.int64]:
    """Return the phase of each frame (n,), given the number of the last frame of each phase."""
    counts = np.diff([-1, *last])
    return np.repeat(np.arange(len(last)), counts)


def no_phases(count: int) -> NDArray[np.int64]:
    """Return the phases of frames without any (n,)."""
    return np.full(count, NO_PHASE)


# Mask files: packed bits in .npy, plain arrays in .npy, pictures in .jpg.

SUFFIXES = (".npy", ".jpg")
# A pixel of a picture belongs to a marker above this grey level of 255.
WHITE_ABOVE = 50


def read_mask(path: Path) -> Packed:
    """Read the packed mask (38400,) in a file.

    Raises:
        LearningError: The file is missing, corrupt, or of another size; the message names it.
    """
    if path.suffix == ".npy":
        return _of_array(read_array(path), path)
    return pack(_greys(path) > WHITE_ABOVE)


def read_array(path: Path) -> NDArray[np.generic]:
    """Read the array in a .npy file."""
    try:
        array: NDArray[np.generic] = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except (ValueError, EOFError) as error:
        size = path.stat().st_size
        raise LearningError(f"{path}: {size} bytes, no whole .npy file: {error}") from error
    if not isinstance(array, np.ndarray):
        raise LearningError(f"{path}: found an archive of arrays; expected one array")
    return array


def _greys(path: Path) -> NDArray[np.uint8]:
    """Read the pixels (480, 640) of a picture."""
    try:
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("L"))
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except (UnidentifiedImageError, OSError) as error:
        raise LearningError(f"{path}: no whole picture: {error}") from error
    if pixels.shape[:2] != (HEIGHT, WIDTH):
        found = f"{pixels.shape[1]} x {pixels.shape[0]}"
        raise LearningError(f"{path}: found {found} pixels; expected {WIDTH} x {HEIGHT}")
    return pixels


def _of_array(array: NDArray[np.generic], path: Path) -> Packed:
    if array.dtype == np.uint8 and array.shape == (PACKED,):
        return np.asarray(array, np.uint8)
    if array.shape != (HEIGHT, WIDTH) or array.dtype.kind not in "buif":
        raise LearningError(
            f"{path}: found {array.dtype} {array.shape}; expected uint8 ({PACKED},), packed bits, "
            f"or ({HEIGHT}, {WIDTH})"
        )
    values = array.astype(np.float64)
    if not np.isfinite(values).all():
        raise LearningError(f"{path}: found NaN or infinity; expected 0 and 1, or greys")
    # Grey levels go up to 255, flags to 1.
    return pack(values > (WHITE_ABOVE if values.max() > 1 else 0))


# Text files of numbers: forces, poses, depths, and the last frames of a press's phases.


def read_forces(path: Path) -> tuple[Array, bool]:
    """Read the wrenches (n, 6) of an ft.csv [N, N m]; the flag is True if it has torques.

    Torques are 0 if the file has forces only.
    """
    names, rows = _table(path)
    if names not in (FORCE_COLUMNS, FORCE_COLUMNS[:3]):
        raise LearningError(
            f"{path}: found columns {', '.join(names)}; expected {', '.join(FORCE_COLUMNS)}"
        )
    wrench = np.zeros((len(rows), 6))
    wrench[:, : rows.shape[1]] = rows
    wrench[:, 3:] /= 1e3  # N mm -> N m
    return wrench, rows.shape[1] == 6


def read_poses(path: Path) -> Array:
    """Read the poses (n, 6) of a pose.csv [m, rad]."""
    names, rows = _table(path)
    if names != POSE_COLUMNS:
        raise LearningError(
            f"{path}: found columns {', '.join(names)}; expected {', '.join(POSE_COLUMNS)}"
        )
    return rows


def read_depths(path: Path) -> Array:
    """Read the numbers (n,) of an inc_z.csv or dec_z.csv [mm], one per line, no header."""
    rows = [line.split(",") for line in _lines(path)]
    values = [_numbers(row, path, number + 1) for number, row in enumerate(rows)]
    if any(len(row) != 1 for row in values):
        raise LearningError(f"{path}: found several values in a line; expected one")
    return np.array([row[0] for row in values], np.float64)


def read_last(path: Path, frames: int) -> tuple[int, ...]:
    """Read the numbers of the last frames of the four phases from a last.csv."""
    names = [line.strip() for line in _lines(path)]
    stems = [PureWindowsPath(name).stem for name in names]
    if len(stems) != 4 or not all(stem.isdecimal() for stem in stems):
        raise LearningError(f"{path}: found {names}; expected the names of four frames")
    last = tuple(int(stem) for stem in stems)
    if any(b <= a for a, b in pairwise(last)):
        raise LearningError(f"{path}: found frames {last}; expected them in ascending order")
    if last[-1] != frames - 1:
        raise LearningError(
            f"{path}: says that the last frame is {last[-1]}; its folder has {frames} frames"
        )
    return last


def _table(path: Path) -> tuple[tuple[str, ...], Array]:
    lines = list(csv.reader(_lines(path)))
    if not lines:
        raise LearningError(f"{path}: is empty; expected a header and a row a frame")
    names = tuple(name.strip() for name in lines[0])
    rows = [_numbers(row, path, number + 2) for number, row in enumerate(lines[1:])]
    for number, row in enumerate(rows):
        if len(row) != len(names):
            raise LearningError(
                f"{path}: line {number + 2}: found {len(row)} values; expected {len(names)}"
            )
    return names, np.array(rows, np.float64).reshape(len(rows), len(names))


def _numbers(row: Sequence[str], path: Path, line: int) -> list[float]:
    try:
        values = [float(value) for value in row]
    except ValueError:
        raise LearningError(f"{path}: line {line}: found {row}; expected numbers") from None
    if not all(math.isfinite(value) for value in values):
        raise LearningError(f"{path}: line {line}: found NaN or infinity; expected numbers")
    return values


def _lines(path: Path) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise LearningError(f"{path}: no text: {error}") from error
    return [line for line in text.splitlines() if line.strip()]


# Material coefficients: polynomials of force over depth, one for loading, one for unloading.


@dataclass(frozen=True, slots=True)
class Compensation:
    """Polynomials of force over depth of one sensor, highest power first as in `numpy.poly1d`."""

    down: tuple[float, ...]
    """Loading."""
    up: tuple[float, ...]
    """Unloading."""

    def force(self, depth: Array, *, loading: bool) -> Array:
        """Return the forces at depths (n,), in the units of the files."""
        return np.asarray(np.polyval(self.down if loading else self.up, depth), np.float64)


def read_coefficients(path: Path) -> tuple[float, ...]:
    """Read the coefficients in a file: one per line, or in one line with commas.

    Raises:
        LearningError: The file is missing or empty, or a value is not a number.
    """
    try:
        text = path.read_text(encoding="utf-8").strip()
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise LearningError(f"{path}: no text: {error}") from error
    if not text:
        raise LearningError(f"{path}: is empty; expected coefficients, highest power first")
    if "\n" in text:
        return tuple(float(value) for value in read_depths(path))
    try:
        values = tuple(float(value) for value in text.split(","))
    except ValueError:
        raise LearningError(f"{path}: found {text!r}; expected numbers") from None
    if not np.isfinite(values).all():
        raise LearningError(f"{path}: found NaN or infinity; expected numbers")
    return values


def read_compensation(folder: Path) -> dict[str, Compensation]:
    """Read the coefficients of all sensors in a folder: <sensor>_down.csv, <sensor>_up.csv.

    Raises:
        LearningError: The folder is missing, has no coefficients, or a file of a pair is missing.
    """
    if not folder.is_dir():
        raise LearningError(f"{folder}: no such folder")
    names = sorted(
        {path.stem.rpartition("_")[0] for path in folder.glob("*_*.csv") if _is_half(path)}
    )
    if not names:
        raise LearningError(f"{folder}: found no <sensor>_down.csv and <sensor>_up.csv")
    return {
        name: Compensation(
            read_coefficients(folder / f"{name}_down.csv"),
            read_coefficients(folder / f"{name}_up.csv"),
        )
        for name in names
    }


def _is_half(path: Path) -> bool:
    return path.stem.endswith(("_down", "_up"))
