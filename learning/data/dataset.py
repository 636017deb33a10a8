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
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, default_collate, get_worker_info

from learning.errors import LearningError
from learning.indenters import UNSEEN
from recorder.archive import MarkerArchive, press_rows
from recorder.catalogue import Catalogue
from recorder.session import Session

Sample = dict[str, Tensor]
Part = Literal["train", "test"]

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
        unseen: Collection[str] = UNSEEN,
        streams: Collection[str] | None = None,
        stride: int = 1,
        storage_options: Mapping[str, Any] | None = None,
    ) -> None:
        """Find all windows; reads times, no images.

        Args:
            recordings: Sessions, folders of sessions, URLs of sessions that fsspec knows, or
                `ARCHIVE.markers.zarr:SENSOR`.
            window: Number of rows.
            split: `train` for indenters that are not in `unseen`, `test` for those that are; None
                for all. Rows of one press are never in both.
            unseen: Names of indenters.
            streams: Columns to read; None for all of the first recording.
            stride: Rows from one window to the next.
            storage_options: Options that fsspec needs to open URLs.
        """
        if window < 1 or stride < 1:
            raise LearningError(f"window, stride: found {window}, {stride}; allowed: 1 and more")
        if split not in (None, *get_args(Part)):
            raise LearningError(f"split: found {split!r}; allowed: train, test, None")
        self.window, self.storage_options = window, dict(storage_options or {})
        self.streams = tuple(streams or ())
        """Columns of every sample."""
        self._open: OrderedDict[str, _Recording] = OrderedDict()
        self.paths = _recordings_in(recordings)
        """Recordings with windows, in order."""
        ends = []
        for path in self.paths:
            one = self._recording(path)
            self.streams = self.streams or one.columns
            ends.append(_chosen(one, path, window, stride, split, unseen))
        with_windows = [number for number, rows in enumerate(ends) if len(rows)]
        if not with_windows:
            of_split = "" if split is None else f" of split {split!r}"
            raise LearningError(
                f"recordings: found no window of {window} rows{of_split} in {len(self.paths)} "
                f"recordings; unseen indenters: {', '.join(sorted(unseen))}"
            )
        self.paths = [self.paths[number] for number in with_windows]
        self._ends = [ends[number] for number in with_windows]
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
        missing = [name for name in self.streams if f"{name}_valid" not in columns]
        if missing:
            available = ", ".join(name for name in columns if f"{name}_valid" in columns)
            raise LearningError(f"{self.paths[of]}: no column {missing[0]!r}; known: {available}")
        valid = np.logical_and.reduce([columns[f"{name}_valid"] for name in self.streams])
        names = [*self.streams, *(f"{name}_valid" for name in self.streams)]
        if "t_ns" in columns:
            names.append("t_ns")
        sample = {name: torch.from_numpy(np.ascontiguousarray(columns[name])) for name in names}
        return {
            **sample,
            "valid": torch.from_numpy(valid),
            "recording": torch.tensor(of),
            "row": torch.tensor(int(columns["row"])),
        }

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
    batch = sum(tensor.nbytes for sample in samples for tensor in sample.values())
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
        frames = self.session.require_frames()
        self._t_ns, self._run = np.asarray(frames["t_ns"]), np.asarray(frames["run"])
        self.columns = tuple(
            column
            for name, column in self.session.columns.items()
            if self.session.streams[name].traits.kind != "events"
        )

    def indenters(self) -> NDArray[np.str_]:
        name = self.session.attrs.get("indenter") or ""
        return np.full(len(self._t_ns), str(name))

    def whole(self, rows: int) -> NDArray[np.bool_]:
        begin = np.zeros(len(self._run), np.int64)
        for run in np.unique(self._run):
            begin[self._run == run] = self._t_ns[self._run == run].min()
        length = (rows - 1) * 1e9 / self.session.rate_hz
        # Ticks are rounded to nanoseconds.
        return np.asarray(self._t_ns - begin >= length - 1e3)

    def window(self, end: int, rows: int) -> dict[str, NDArray[Any]]:
        window = self.session.window(int(self._t_ns[end]), rows, run=int(self._run[end]))
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

    def __init__(self, path: str) -> None:
        archive_path, _, name = path.rpartition(":")
        archive = MarkerArchive(archive_path)
        if name not in archive:
            raise LearningError(f"{path}: no such sensor; allowed: {', '.join(archive)}")
        self._sensor, self._names = archive[name], np.array(archive.indenters)
        presses = list(press_rows(self._sensor.table).values())
        none = np.zeros(0, np.int64)
        self._rows = np.concatenate([none, *presses])
        self._before = np.concatenate([none, *(np.arange(len(press)) for press in presses)])

    def indenters(self) -> NDArray[np.str_]:
        return np.asarray(self._names[self._sensor.table["indenter"][self._rows]])

    def whole(self, rows: int) -> NDArray[np.bool_]:
        return np.asarray(self._before >= rows - 1)

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
        paths += sorted(str(inside / row.path) for row in catalogue)
    return paths


def _is_sensor(path: str) -> bool:
    """True for `ARCHIVE:SENSOR`; a colon may also be in the name of a session."""
    return "://" not in path and ":" in Path(path).name and not Path(path).exists()


def _chosen(
    one: _Recording, path: str, rows: int, stride: int, split: Part | None, unseen: Collection[str]
) -> NDArray[np.int64]:
    """Return the last rows of the windows of one part (n,)."""
    wanted = one.whole(rows)
    if split is not None:
        names = one.indenters()
        if (names == "").any():
            raise LearningError(
                f"{path}: names no indenter, by which it could be in one part; allowed: split=None"
            )
        wanted &= np.isin(names, list(unseen)) == (split == "test")
    return np.flatnonzero(wanted)[::stride]
