"""Part `loading`: windows that reach a training, by our loader and by a plain one of files.

Sessions of 640 x 480 camera JPEGs at 40 Hz with forces at 1 kHz are made. The plain loader gets
JPEG files with arrays, as a researcher would export them by hand: the JPEG bytes are the same.
"""

import io
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from benchmarks.processes import alone
from benchmarks.recording.frames import HEIGHT, WIDTH, GelFrames
from benchmarks.recording.measure import WINDOW, cpu_seconds
from benchmarks.report import Page, Run, table
from learning import TactileDataset
from recorder import SessionWriter, StreamWriter, camera_spec, force_spec

BATCH = 8
RATE, FORCE_RATE = 40.0, 1000.0
_T0 = 10**9
LOADERS = {"ours": "`TactileDataset`", "plain": "plain loader, JPEG files by Pillow"}


def measure(run: Run) -> list[dict[str, Any]]:
    """Read by each loader, without workers and with two."""
    sessions, length, seconds, numbers = 8, 10.0, 8.0, [0, 2]
    if run.quick:
        sessions, length, seconds, numbers = 1, 1.0, 0.3, [0]
    rows: list[dict[str, Any]] = []
    for number in range(sessions):
        make(run.folder, number, length)
        run.progress(0.2 * number / sessions)
    for loader in LOADERS:
        for workers in numbers:
            run.progress(0.2 + 0.8 * len(rows) / (len(LOADERS) * len(numbers)))
            read = alone(measured, loader, run.folder, workers, seconds)
            rows.append({"loader": loader, "workers": workers} | read)
    run.seeds = range(sessions)
    return rows


def make(folder: Path, number: int, seconds: float) -> None:
    """Write one session, and the same as files."""
    frames, count = GelFrames(seed=number), int(seconds * RATE)
    t_ns = _T0 + (np.arange(count) * 1e9 / RATE).astype(np.int64)
    force_t = _T0 + (np.arange(int(seconds * FORCE_RATE)) * 1e9 / FORCE_RATE).astype(np.int64)
    force = np.random.default_rng(number).normal(0, 1, (len(force_t), 6))
    path = folder / "sessions" / f"{number}.zarr"
    path.parent.mkdir(parents=True, exist_ok=True)
    camera = camera_spec(RATE, height=HEIGHT, width=WIDTH, roles=["signal"])
    specs = [camera, force_spec(FORCE_RATE, roles=["label"])]
    targets = {"point": np.zeros(0, np.int16)}
    with SessionWriter.create(
        path, attrs={"sensor": "gel", "indenter": "sphere"}, streams=specs, targets=targets
    ) as session:
        session.begin_run({"t0_ns": _T0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})
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


def opened(loader: str, folder: Path) -> Dataset[Any]:
    """Return the windows of one of `LOADERS`, from the folder in which they were made."""
    if loader == "ours":
        return TactileDataset(folder / "sessions", WINDOW)
    return Files(folder / "files")


def measured(name: str, folder: Path, workers: int, seconds: float) -> dict[str, float]:
    """Read shuffled batches for some seconds, in a process of its own.

    Return the number of images, the time on the clock and of the CPU, and the memory.
    """
    loader = DataLoader(opened(name, folder), BATCH, shuffle=True, num_workers=workers)
    read = 0
    batches = iter(loader)
    next(batches)
    cpu, began = cpu_seconds(), time.monotonic()
    while (took := time.monotonic() - began) < seconds or not read:
        batch = next(batches, None)
        if batch is None:
            batches = iter(loader)
            continue
        read += len(batch["image"]) * WINDOW
    del batches  # ends the workers, whose time then counts
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    memory = max(resource.getrusage(kind).ru_maxrss for kind in kinds) / 1e3
    return {"images": read, "seconds": took, "cpu": cpu_seconds() - cpu, "memory_mb": memory}


_ABOUT = f"""\
Shuffled windows of {WINDOW} rows in batches of {BATCH}: JPEGs of {WIDTH}x{HEIGHT} at {RATE:g} Hz,
forces at {FORCE_RATE:g} Hz, from the page cache. `TactileDataset` verifies checksums, aligns forces
to the exposure and gives masks of validity; the plain loader reads the same JPEGs as files, with
forces that were aligned before, and checks nothing. Memory is the largest of the process or a
worker.""".replace("\n", " ")


def section(rows: list[dict[str, Any]], page: Page) -> str:
    """Return the table of the loaders."""
    lines = []
    for row in rows:
        rates = [f"{row['images'] / row[by]:,.0f}" for by in ("cpu", "seconds")]
        memory = f"{row['memory_mb']:,.0f}"
        lines.append([LOADERS[row["loader"]], row["workers"], *rates, memory])
    head = ["reader", "workers", "images per CPU-s", "images/s", "memory [MB]"]
    return "\n\n".join(["## Windows for a training", _ABOUT, table(head, lines)])
