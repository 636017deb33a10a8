"""Presses of published folders, and readers of their files."""

import csv
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PureWindowsPath

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from learning.errors import LearningError
from recorder.convert import FORCE_COLUMNS, POSE_COLUMNS
from recorder.errors import SessionError
from recorder.markers import HEIGHT, PACKED, WIDTH, pack
from recorder.store import decode_jpeg

Array = NDArray[np.float64]
Packed = NDArray[np.uint8]
ReadMask = Callable[[Path], Packed]


@dataclass(frozen=True, slots=True, eq=False)
class GenForcePress:
    """One contact point of one indenter, frame by frame."""

    indenter: str
    target: int
    """Number of the press within the indenter, from 0."""
    files: tuple[Path, ...]
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
        return len(self.files)


@contextmanager
def _existing(path: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None


# Mask files: packed bits in .npy, plain arrays in .npy, pictures in .jpg.

SUFFIXES = (".npy", ".jpg")
# A pixel of a picture belongs to a marker above this grey level of 255.
WHITE_ABOVE = 50


def read_mask(path: Path) -> Packed:
    """Read the packed mask (38400,) in a file."""
    if path.suffix == ".npy":
        return _of_array(read_array(path), path)
    return pack(_greys(path) > WHITE_ABOVE)


def read_array(path: Path) -> NDArray[np.generic]:
    """Read the array in a .npy file."""
    with _existing(path):
        try:
            array: NDArray[np.generic] = np.load(path, allow_pickle=False)
        except (ValueError, EOFError) as error:
            size = path.stat().st_size
            raise LearningError(f"{path}: {size} bytes, no whole .npy file: {error}") from error
    if not isinstance(array, np.ndarray):
        raise LearningError(f"{path}: found an archive of arrays; expected one array")
    return array


def read_counts(path: Path) -> Array:
    """Read the counts (16, 3) in a file of taxels."""
    array = read_array(path)
    if array.shape != (16, 3) or array.dtype.kind not in "iuf":
        raise LearningError(f"{path}: found {array.dtype} {array.shape}; expected numbers (16, 3)")
    counts = array.astype(np.float64)
    if not np.isfinite(counts).all():
        raise LearningError(f"{path}: found NaN or infinity; expected counts")
    return counts


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Read the pixels (480, 640, 3) of a camera's JPEG, RGB, decoded as sessions decode it."""
    try:
        with _existing(path):
            return decode_jpeg(path.read_bytes(), (HEIGHT, WIDTH, 3))
    except SessionError as error:
        raise LearningError(f"{path}: {error}") from error


def read_reference(stem: Path, usual: str) -> Packed:
    """Read the packed mask (38400,) without contact, named `stem` and one of `SUFFIXES`."""
    for suffix in SUFFIXES:
        if (path := stem.with_name(stem.name + suffix)).exists():
            return read_mask(path)
    (other,) = set(SUFFIXES) - {usual}
    raise LearningError(f"{stem}{usual}: no such file, nor {other}; expected the reference")


def _greys(path: Path) -> NDArray[np.uint8]:
    """Read the pixels (480, 640) of a picture."""
    try:
        with _existing(path), Image.open(path) as picture:
            pixels = np.asarray(picture.convert("L"))
    except (UnidentifiedImageError, OSError) as error:
        raise LearningError(f"{path}: no whole picture: {error}") from error
    if pixels.shape[:2] != (HEIGHT, WIDTH):
        size = f"{pixels.shape[1]} x {pixels.shape[0]}"
        raise LearningError(f"{path}: found {size} pixels; expected {WIDTH} x {HEIGHT}")
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


def read_forces(path: Path, files: Sequence[Path]) -> tuple[Array, bool]:
    """Read wrenches (n, 6) of an ft.csv [N, N m]; without torques they are 0, the flag False."""
    rows = _table(path, files, FORCE_COLUMNS, FORCE_COLUMNS[:3])
    wrench = np.zeros((len(rows), 6))
    wrench[:, : rows.shape[1]] = rows
    wrench[:, 3:] /= 1e3  # N mm -> N m
    return wrench, rows.shape[1] == 6


def read_poses(path: Path, files: Sequence[Path]) -> Array:
    """Read the poses (n, 6) of a pose.csv [m, rad], one for each file of a frame."""
    return _table(path, files, POSE_COLUMNS)


def read_depths(path: Path) -> Array:
    """Read the numbers (n,) of an inc_z.csv or dec_z.csv [mm], one per line, no header."""
    rows = [line.split(",") for line in _lines(path)]
    values = [_numbers(row, path, number + 1) for number, row in enumerate(rows)]
    if any(len(row) != 1 for row in values):
        raise LearningError(f"{path}: found several values in a line; expected one")
    return np.array([row[0] for row in values], np.float64)


def read_phases(path: Path, frames: int) -> NDArray[np.int64]:
    """Read the phase of each frame (n,) from a last.csv, the names of the phases' last frames."""
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
    return np.repeat(np.arange(4), np.diff([-1, *last]))


def _table(path: Path, files: Sequence[Path], *allowed: Sequence[str]) -> Array:
    """Read the rows (n, k) of a CSV file whose columns are one of those allowed."""
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
    if names not in allowed:
        raise LearningError(
            f"{path}: found columns {', '.join(names)}; expected {', '.join(allowed[0])}"
        )
    if len(rows) != len(files):
        raise LearningError(
            f"{path}: found {len(rows)} rows; {files[0].parent} has {len(files)} frames"
        )
    return np.array(rows, np.float64).reshape(len(rows), len(names))


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
        with _existing(path):
            text = path.read_text(encoding="utf-8")
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


def read_coefficients(path: Path) -> tuple[float, ...]:
    """Read the coefficients in a file: one per line, or in one line with commas."""
    lines = _lines(path)
    if not lines:
        raise LearningError(f"{path}: is empty; expected coefficients, highest power first")
    if len(lines) > 1:
        return tuple(read_depths(path).tolist())
    return tuple(_numbers(lines[0].split(","), path, 1))


def read_compensation(folder: Path) -> dict[str, Compensation]:
    """Read the coefficients of all sensors in a folder: <sensor>_down.csv, <sensor>_up.csv."""
    if not folder.is_dir():
        raise LearningError(f"{folder}: no such folder")
    halves = [path.stem.rpartition("_") for path in folder.glob("*_*.csv")]
    names = sorted({name for name, _, half in halves if half in ("down", "up")})
    if not names:
        raise LearningError(f"{folder}: found no <sensor>_down.csv and <sensor>_up.csv")
    return {
        name: Compensation(
            *(read_coefficients(folder / f"{name}_{half}.csv") for half in ("down", "up"))
        )
        for name in names
    }
