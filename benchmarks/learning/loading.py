"""Windows a second that reach a training, beside a plain loader of files.

    python -m benchmarks loading --out docs/results/loading.md

Sessions of 640 x 480 camera JPEGs at 40 Hz with forces at 1 kHz are made, and the same images and
forces as JPEG files and arrays, as a researcher would export them by hand. Both are read as
shuffled windows of 16 rows in batches of 8. Rates are by the clock and by CPU-second; files are in
the page cache. The plain loader checks nothing: no checksums, no alignment, no masks.
"""

from __future__ import annotations

import argparse
import io
import os
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from benchmarks.recording.frames import HEIGHT, WIDTH, GelFrames
from learning import TactileDataset
from recorder import SessionWriter, StreamWriter, camera_spec, force_spec
from recorder.processes import cores

WINDOW, BATCH = 16, 8
RATE, FORCE_RATE = 40.0, 1000.0
T0 = 10**9


@dataclass(frozen=True, slots=True)
class Row:
    """Speed of one way to read."""

    name: str
    workers: int
    images_per_s: float
    images_per_cpu_s: float
    memory_mb: float
    """Largest resident memory of this process or one of its workers [MB]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.description = "Images per second of TactileDataset and of a plain loader of files."
    parser.add_argument("--sessions", type=int, default=8, help="number (%(default)s)")
    parser.add_argument(
        "--length", type=float, default=10.0, metavar="S", help="of each [s] (%(default)s)"
    )
    parser.add_argument(
        "--seconds", type=float, default=10.0, help="to measure each row [s] (%(default)s)"
    )
    parser.add_argument("--out", type=Path, help="page to write")


def run(options: argparse.Namespace) -> int:
    """Measure, print the table and write the page."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="loading-") as name:
        folder = Path(name)
        for number in range(options.sessions):
            make(folder, number, options.length)
        ways: dict[str, Callable[[], Dataset[Any]]] = {
            "`TactileDataset`": lambda: TactileDataset(folder / "sessions", WINDOW),
            "plain loader, JPEG files by Pillow": lambda: Files(folder / "files"),
        }
        for way, opened in ways.items():
            for workers in (0, 2):
                rows.append(measured(way, opened(), workers, options.seconds))
                print(line(rows[-1]), flush=True)
    if options.out is not None:
        options.out.write_text(page(rows, options))
        print(f"{options.out}: written")
    return 0


def make(folder: Path, number: int, seconds: float) -> None:
    """Write one session, and the same as files."""
    frames, count = GelFrames(seed=number), int(seconds * RATE)
    t_ns = T0 + (np.arange(count) * 1e9 / RATE).astype(np.int64)
    force_t = T0 + (np.arange(int(seconds * FORCE_RATE)) * 1e9 / FORCE_RATE).astype(np.int64)
    force = np.random.default_rng(number).normal(0, 1, (len(force_t), 6))
    path = folder / "sessions" / f"{number}.zarr"
    path.parent.mkdir(parents=True, exist_ok=True)
    camera = camera_spec(RATE, height=HEIGHT, width=WIDTH, roles=["signal"])
    specs = [camera, force_spec(FORCE_RATE, roles=["label"])]
    targets = {"point": np.zeros(0, np.int16)}
    with SessionWriter.create(
        path, attrs={"indenter": "sphere"}, streams=specs, targets=targets
    ) as session:
        session.begin_run({"t0_ns": T0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})
        with StreamWriter.open(session.stream_path("camera")) as stream:
            for row, at in enumerate(t_ns.tolist()):
                stream.append(value=frames.jpeg(row), device_t=float("nan"), t_ns=at)
        with StreamWriter.open(session.stream_path("force")) as stream:
            for row, at in enumerate(force_t.tolist()):
                stream.append(value=force[row], seq=row, status=0, t_ns=at)
        session.finish("complete", rate_hz=RATE)
    files = folder / "files" / str(number)
    files.mkdir(parents=True)
    for row in range(count):
        (files / f"{row:05d}.jpg").write_bytes(frames.jpeg(row))
    np.save(files / "force.npy", force[:: int(FORCE_RATE / RATE)][:count].astype(np.float32))


class Files(Dataset[dict[str, Tensor]]):
    """Windows of folders of JPEG files with an array of forces."""

    def __init__(self, folder: Path) -> None:
        """List the files."""
        self._images = [sorted(one.glob("*.jpg")) for one in sorted(folder.iterdir())]
        self._forces = [np.load(one / "force.npy") for one in sorted(folder.iterdir())]
        self._windows = [
            (session, end)
            for session, images in enumerate(self._images)
            for end in range(WINDOW, len(images) + 1)
        ]

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self._windows)

    def __getitem__(self, number: int) -> dict[str, Tensor]:
        """Return one window."""
        session, end = self._windows[number]
        rows = slice(end - WINDOW, end)
        pixels = [
            np.asarray(Image.open(io.BytesIO(path.read_bytes())))
            for path in self._images[session][rows]
        ]
        image = torch.from_numpy(np.stack(pixels).transpose(0, 3, 1, 2).copy())
        return {"image": image, "wrench": torch.from_numpy(self._forces[session][rows])}


def measured(name: str, windows: Dataset[Any], workers: int, seconds: float) -> Row:
    """Read shuffled batches for some seconds, after a first one."""
    loader = DataLoader(windows, BATCH, shuffle=True, num_workers=workers)
    read = 0
    batches = iter(loader)
    next(batches)
    cpu, began = _cpu(), time.perf_counter()
    while (took := time.perf_counter() - began) < seconds:
        batch = next(batches, None)
        if batch is None:
            batches = iter(loader)
            continue
        read += len(batch["image"]) * WINDOW
    del batches  # ends the workers, whose time then counts
    spent = _cpu() - cpu
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    memory = max(resource.getrusage(kind).ru_maxrss for kind in kinds) / 1e3
    return Row(name, workers, read / took, read / spent, memory)


def _cpu() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def line(row: Row) -> str:
    """Return the row of the table."""
    return (
        f"| {row.name} | {row.workers} | {row.images_per_s:,.0f} | {row.images_per_cpu_s:,.0f} "
        f"| {row.memory_mb:,.0f} |"
    )


def page(rows: list[Row], options: argparse.Namespace) -> str:
    """Return the page of results."""
    lines = "\n".join(map(line, rows))
    return f"""# Reading windows for a training

Shuffled windows of {WINDOW} rows in batches of {BATCH}, from {options.sessions} sessions of
{options.length:g} s: camera JPEGs of {WIDTH} x {HEIGHT} at {RATE:g} Hz and forces at
{FORCE_RATE:g} Hz. Files are in the page cache; one run on {cores()} cores, made by
`python -m benchmarks loading --out docs/results/loading.md`. `TactileDataset` verifies checksums,
aligns forces to the exposure and gives masks of validity. The plain loader reads the same JPEGs,
and forces that were aligned before, and checks nothing. CPU-seconds include the start of workers.
Memory is the largest of any process so far in the run.

| reader | workers | images/s | images per CPU-second | memory [MB] |
|---|---|---|---|---|
{lines}

LeRobot's own data set, PNG in parquet, gave 144 images/s in windows of 16 in another run
([recording](recording.md)).
"""
