"""Windows of many recordings as a data set for PyTorch.

    from torch.utils.data import DataLoader
    from learning import TactileDataset

    windows = TactileDataset("sessions", window=16, split="train")
    for batch in DataLoader(windows, batch_size=8, shuffle=True, num_workers=2):
        batch["image"], batch["wrench"]  # uint8 (8, 16, 3, h, w), float32 (8, 16, 6) [N, N m]

A window is a number of synchronised rows, one period apart. Sessions are opened when they are first
needed, and only some are kept open, so memory does not grow with their number.
"""

from __future__ import annotations

import os
import zlib
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, default_collate, get_worker_info

from learning.errors import LearningError
from learning.indenters import NAMES, UNSEEN
from learning.markers.recording import KINDS_OF_PLAN
from recorder.archive import MarkerArchive, press_rows
from recorder.catalogue import Catalogue
from recorder.session import Session

Sample = dict[str, Tensor]
Part = Literal["train", "val", "test"]
Names = str | Collection[str]

# One in about these many presses of seen indenters is of `val`.
ONE_IN = 10

# Where a DataLoader's workers put their batches.
SHARED = "/dev/shm"
# Largest number of recordings that are open in one process.
OPEN = 32


class TactileDataset(Dataset[Sample]):
    """Windows of sessions, or of sensors in marker archives, as tensors.

    A sample of a session has one entry for each column of its `frames`, such as `image` (rows, 3,
    h, w) uint8, `wrench` (rows, 6) float32 [N, N m] and `pose` (rows, 6) float32 [m, rad], each
    with a mask `<column>_valid` (rows,). A sample of an archive has `image` (rows, 1, 480, 640)
    uint8, 255 on a marker, and `wrench`; a row without a force is not valid.

    All samples have `valid` (rows,), which is true where every column is; `t_ns` (rows,) if from a
    session; `recording`, its number in `paths`; and `row`, the last row of `frames` or the sensor.
    """

    def __init__(
        self,
        recordings: str | Path | Iterable[str | Path],
        window: int = 16,
        *,
        split: Part | None = None,
        unseen: Names = UNSEEN,
        streams: Names | None = None,
        stride: int = 1,
        sensor: Names = (),
        indenter: Names = (),
        mock: bool | None = None,
        transform: Callable[[Sample], Sample] | None = None,
        storage_options: Mapping[str, Any] | None = None,
    ) -> None:
        """Find all windows; reads times, no images.

        Args:
            recordings: Sessions, folders of sessions, URLs of sessions that fsspec knows, or
                `ARCHIVE.markers.zarr:SENSOR`. In folders, touches and taps of set-ups are left out.
            window: Number of rows.
            split: `test` for indenters in `unseen`; of others `val` for a tenth of the presses and
                `train` for the rest; None for all. Rows of one press are never in two of them.
            unseen: Names of indenters, or one name.
            streams: Columns to read, or one; None for all of the first recording.
            stride: Rows from one window to the next.
            sensor: Sensors to read; without it recordings of several sensors are an error.
            indenter: Indenters to read; without it all.
            mock: True for sessions of mock benches alone, False for those of others; None for all.
            transform: Function of each sample, which the data set returns in place of it.
            storage_options: Options that fsspec needs to open URLs.

        Raises:
            LearningError: An unknown name, or no window that meets all conditions.
        """
        for key, value in (("window", window), ("stride", stride)):
            if type(value) is not int or value < 1:
                raise LearningError(f"{key}: found {value!r}; allowed: a whole number, 1 or more")
        if split not in (None, *get_args(Part)):
            allowed = ", ".join(get_args(Part))
            raise LearningError(f"split: found {split!r}; allowed: {allowed}, None")
        self.window, self.transform = window, transform
        self.storage_options = dict(storage_options or {})
        self.streams = _names(streams or ())
        """Columns of every sample."""
        self._open: OrderedDict[str, _Recording] = OrderedDict()
        asked = {"sensor": _names(sensor), "indenter": _names(indenter), "unseen": _names(unseen)}
        known: dict[str, set[str]] = {"sensor": set(), "indenter": set(), "unseen": set(NAMES)}
        paths, ends, sensors, problem = _recordings_in(recordings), {}, set[str](), ""
        for path in paths:
            one = self._recording(path)
            known["sensor"].add(one.sensor)
            known["indenter"].update(one.indenters.tolist())
            if (sensor and one.sensor not in asked["sensor"]) or mock not in (None, one.mock):
                continue
            sensors.add(one.sensor)
            self.streams = self.streams or one.columns
            for name in set(self.streams) - set(one.columns):
                problem = f"{path}: no column {name!r}; known: {', '.join(one.columns)}"
            rows = _chosen(one, path, self.window, split, asked["unseen"], asked["indenter"])
            ends[path] = rows[::stride]
        if len(sensors) > 1 and not sensor:
            listed = ", ".join(sorted(sensors))
            problem = f"recordings: found sensors {listed}; allowed: one, or those of sensor=[...]"
        known["unseen"] |= known["indenter"]
        for key, choice in asked.items():
            for name in set(choice) - known[key]:
                problem = f"{key}: found {name!r}; known: {', '.join(sorted(known[key]))}"
        if problem:
            raise LearningError(problem)
        self.paths = [path for path, rows in ends.items() if len(rows)]
        """Recordings with windows, in order."""
        if not self.paths:
            of_split = "" if split is None else f" of split {split!r}"
            raise LearningError(
                f"recordings: found no window of {window} rows{of_split} in {len(ends)} of "
                f"{len(paths)} recordings; unseen indenters: {', '.join(sorted(asked['unseen']))}"
            )
        self._ends = [ends[path] for path in self.paths]
        self._until = np.cumsum([len(rows) for rows in self._ends])

    def __len__(self) -> int:
        return int(self._until[-1])

    def __getitem__(self, number: int) -> Sample:
        if not -len(self) <= number < len(self):
            raise IndexError(f"no window {number}, there are {len(self):,}")
        number %= len(self)
        of = int(np.searchsorted(self._until, number, side="right"))
        within = number - (int(self._until[of - 1]) if of else 0)
        end = int(self._ends[of][within])
        columns = self._recording(self.paths[of]).window(end, self.window)
        valid = np.logical_and.reduce([columns[f"{name}_valid"] for name in self.streams])
        names = [*self.streams, *(f"{name}_valid" for name in self.streams)]
        if "t_ns" in columns:
            names.append("t_ns")
        sample = {name: torch.from_numpy(np.ascontiguousarray(columns[name])) for name in names}
        sample |= {
            "valid": torch.from_numpy(valid),
            "recording": torch.tensor(of),
            "row": torch.tensor(int(columns["row"])),
        }
        return sample if self.transform is None else self.transform(sample)

    def __getitems__(self, items: list[int]) -> list[Sample]:
        """Return the windows of a batch; a worker refuses one that `/dev/shm` has no room for."""
        samples = [self[item] for item in items]
        worker = get_worker_info()
        if worker is not None and os.path.isdir(SHARED):
            _require_room(samples, worker.num_workers)
        return samples

    def batches(
        self, size: int, *, seed: int = 0, epoch: int = 0, first: int = 0
    ) -> IterableDataset[Sample]:
        """Return shuffled batches of one epoch, for `DataLoader(batches, batch_size=None)`.

        The order follows from `seed` and `epoch` alone, whatever the number of workers. A training
        that was stopped after `first` batches goes on with the next one.

        Args:
            size: Windows in a batch; the last of an epoch may have fewer.
            seed: Seed of the order.
            epoch: Number of the epoch.
            first: Batches to leave out.
        """
        if size < 1 or first < 0:
            raise LearningError(f"size, first: found {size}, {first}; allowed: 1 and 0 or more")
        return _Batches(self, size, (seed, epoch), first)

    def __getstate__(self) -> dict[str, Any]:
        """Leave open files behind when a worker process gets a copy."""
        return {**self.__dict__, "_open": OrderedDict()}

    def __repr__(self) -> str:
        """Return the numbers of windows and recordings, and the columns."""
        return (
            f"<TactileDataset: {len(self):,} windows of {self.window} rows in {len(self.paths)} "
            f"recordings, {', '.join(self.streams)}>"
        )

    def _recording(self, path: str) -> _Recording:
        if path in self._open:
            self._open.move_to_end(path)
        else:
            self._open[path] = (
                _OfArchive(path) if _is_sensor(path) else _OfSession(path, self.storage_options)
            )
            if len(self._open) > OPEN:
                self._open.popitem(last=False)
        return self._open[path]


class _Batches(IterableDataset[Sample]):
    """Batches of shuffled windows; worker w of n makes every n-th of them, from `first + w` on."""

    def __init__(
        self, windows: TactileDataset, size: int, seed: tuple[int, int], first: int
    ) -> None:
        self._windows, self._size, self._seed, self._first = windows, size, seed, first

    def __len__(self) -> int:
        return max(-(-len(self._windows) // self._size) - self._first, 0)

    def __iter__(self) -> Iterator[Sample]:
        order = np.random.default_rng(self._seed).permutation(len(self._windows))
        worker = get_worker_info()
        begin, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        for number in range(self._first + begin, self._first + len(self), step):
            rows = order[number * self._size : (number + 1) * self._size]
            yield default_collate(self._windows.__getitems__(rows.tolist()))


def _require_room(samples: list[Sample], workers: int) -> None:
    """Reject a batch that the kernel would end its worker for: a DataLoader hands it on in memory.

    It keeps two batches of each worker in advance.
    """
    disk = os.statvfs(SHARED)
    batch = sum(getattr(value, "nbytes", 0) for sample in samples for value in sample.values())
    if 2 * workers * batch > (room := disk.f_blocks * disk.f_frsize):
        raise LearningError(
            f"{SHARED}: has {room / 1e6:.0f} MB; {workers} workers with batches of "
            f"{batch / 1e6:.0f} MB need {2 * workers * batch / 1e6:.0f} MB; allowed: "
            "num_workers=0, smaller batches or windows, or more room (docker run --shm-size 4g)"
        )


class _OfSession:
    """Windows of a session, at the rows of its `frames`."""

    def __init__(self, path: str, storage_options: Mapping[str, Any]) -> None:
        self.session = Session(path, storage_options=storage_options or None)
        self.sensor = str(self.session.attrs.get("sensor") or "")
        self.mock = bool(self.session.attrs.get("mock", False))
        self.columns = tuple(
            column
            for name, column in self.session.columns.items()
            if self.session.streams[name].traits.kind != "events"
        )
        frames = self.session.require_frames()
        self._t_ns, self._run = np.asarray(frames["t_ns"]), np.asarray(frames["run"])
        self.presses = np.asarray(frames["target"], np.int64)
        name = self.session.attrs.get("indenter") or ""
        self.indenters = np.full(len(self._t_ns), str(name))

    def begins(self, rows: int) -> NDArray[np.int64]:
        begins = np.full(len(self._run), -1)
        length = (rows - 1) * 1e9 / self.session.rate_hz
        for run in np.unique(self._run):
            own = np.flatnonzero(self._run == run)
            t_ns = self._t_ns[own]
            # Ticks are rounded to nanoseconds.
            first = np.searchsorted(t_ns, t_ns - length - 1e3)
            begins[own] = np.where(t_ns - length + 1e3 >= t_ns[0], own[first], -1)
        return begins

    def window(self, end: int, rows: int) -> dict[str, NDArray[Any]]:
        window = self.session.window(row=end, n=rows)
        values: dict[str, NDArray[Any]] = {"t_ns": window.t_ns, "row": np.array(end)}
        for name, aligned in window.streams.items():
            if aligned.value is None:
                continue
            column, value = window.columns[name], aligned.value
            if self.session.streams[name].layout.image is not None:
                value = value[:, None] if value.ndim == 3 else np.moveaxis(value, -1, 1)
            elif value.dtype.kind == "f":
                value = value.astype(np.float32)
            values[column], values[f"{column}_valid"] = value, aligned.valid
        return values


class _OfArchive:
    """Windows of a sensor in a marker archive, each within one press."""

    columns: tuple[str, ...] = ("image", "wrench")
    mock = False

    def __init__(self, path: str) -> None:
        archive_path, _, name = path.rpartition(":")
        archive = MarkerArchive(archive_path)
        if name not in archive:
            raise LearningError(f"{path}: no such sensor; allowed: {', '.join(archive)}")
        self.sensor, self._sensor, names = name, archive[name], np.array(archive.indenters)
        presses = list(press_rows(self._sensor.table).values())
        none = np.zeros(0, np.int64)
        self._rows = np.concatenate([none, *presses])
        self._before = np.concatenate([none, *(np.arange(len(press)) for press in presses)])
        self.presses = self._sensor.table["location"][self._rows].astype(np.int64)
        self.indenters = np.asarray(names[self._sensor.table["indenter"][self._rows]])

    def begins(self, rows: int) -> NDArray[np.int64]:
        return np.where(self._before >= rows - 1, np.arange(len(self._before)) - rows + 1, -1)

    def window(self, end: int, rows: int) -> dict[str, NDArray[Any]]:
        chosen = self._rows[end - rows + 1 : end + 1]
        wrench = self._sensor.table["wrench"][chosen].astype(np.float32)
        return {
            "row": chosen[-1],
            "image": self._sensor.masks(chosen)[:, None].astype(np.uint8) * 255,
            "image_valid": np.ones(rows, bool),
            "wrench": wrench,
            "wrench_valid": ~np.isnan(wrench[:, :3]).any(axis=1),
        }


_Recording = _OfSession | _OfArchive


def _recordings_in(recordings: str | Path | Iterable[str | Path]) -> list[str]:
    """Return each recording; folders are searched for sessions."""
    listed = [recordings] if isinstance(recordings, str | Path) else list(recordings)
    paths = []
    for one in map(str, listed):
        inside = Path(one)
        if "://" in one or _is_sensor(one) or (inside / "zarr.json").exists():
            paths.append(one)
            continue
        if not inside.is_dir():
            raise LearningError(
                f"recordings: {one}: no such folder; allowed: sessions, folders of sessions, URLs, "
                "ARCHIVE.markers.zarr:SENSOR"
            )
        catalogue = Catalogue(inside)
        catalogue.refresh()
        # Those that cannot be read are refused when they are opened.
        rows = [row for row in catalogue if row.plan in ("", *KINDS_OF_PLAN)]
        paths += sorted(str(inside / row.path) for row in rows)
    return paths


def _is_sensor(path: str) -> bool:
    """True for `ARCHIVE:SENSOR`; a colon may also be in the name of a session."""
    return "://" not in path and ":" in Path(path).name and not Path(path).exists()


def _names(names: Names) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _chosen(
    one: _Recording,
    path: str,
    rows: int,
    split: Part | None,
    unseen: Collection[str],
    indenter: Collection[str],
) -> NDArray[np.int64]:
    """Return the last rows of the windows of one part (n,), of some indenters or all."""
    begins, names = one.begins(rows), one.indenters
    wanted = begins >= 0
    if indenter:
        wanted &= np.isin(names, list(indenter))
    if split is not None:
        if (names == "").any():
            raise LearningError(
                f"{path}: names no indenter, by which it could be in one part; allowed: split=None"
            )
        wanted &= np.isin(names, list(unseen)) == (split == "test")
    if split in ("train", "val"):
        until = np.r_[0, np.cumsum(_validation(names, one.presses))]
        ends = np.arange(1, len(until))
        wanted &= until[ends] - until[begins] == (ends - begins if split == "val" else 0)
    return np.flatnonzero(wanted)


def _validation(names: NDArray[np.str_], presses: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which rows (n,) are of presses of `val`; they stay so as data grow."""
    keys = (f"{name} {press}" for name, press in zip(names, presses, strict=True))
    codes = np.fromiter((zlib.crc32(key.encode()) for key in keys), np.int64)
    return np.asarray((codes % ONE_IN == 0) & (presses >= 0))
