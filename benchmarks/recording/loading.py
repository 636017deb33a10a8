"""Part `loading`: windows that reach a training, beside LeRobot's loader and a plain one of files.

Sessions of 640 x 480 camera JPEGs at 40 Hz with forces at 1 kHz are made. LeRobot gets their export
and the plain loader JPEG files with arrays, as a researcher would export them by hand: the JPEG
bytes are the same. As a module it is the process that reads by one loader, so that CPU time and
memory concern that loader only, and so that LeRobot may run in another interpreter.
"""

from __future__ import annotations

import io
import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import ConcatDataset, DataLoader, Dataset

from benchmarks.recording.child import RESULT, WINDOW, ChildFailed, answer, started
from benchmarks.recording.frames import HEIGHT, WIDTH, GelFrames
from benchmarks.recording.measure import cpu_seconds

if TYPE_CHECKING:
    from benchmarks.report import Page, Run

# Names the Python that has LeRobot.
INTERPRETER = "LEROBOT_PYTHON"
BATCH = 8
RATE, FORCE_RATE = 40.0, 1000.0
_T0 = 10**9
# Names of the export's columns in LeRobot.
IMAGE, FORCE = "observation.images.tactile", "observation.force"
LOADERS = {
    "ours": "`TactileDataset`",
    "lerobot": "LeRobot, the same JPEGs in parquet",
    "plain": "plain loader, JPEG files by Pillow",
}


def measure(run: Run) -> list[dict[str, Any]]:
    """Read by each loader, without workers and with two."""
    sessions, length, seconds, numbers = 8, 10.0, 8.0, [0, 2]
    if run.quick:
        sessions, length, seconds, numbers = 1, 1.0, 0.3, [0]
    folder = run.folder / "loading"
    rows: list[dict[str, Any]] = []
    for number in range(sessions):
        make(folder, number, length)
        run.progress(0.2 * number / sessions)
    for loader in LOADERS:
        python = os.environ.get(INTERPRETER, "") if loader == "lerobot" else sys.executable
        for workers in numbers:
            run.progress(0.2 + 0.8 * len(rows) / (3 * len(numbers)))
            row: dict[str, Any] = {"loader": loader, "workers": workers, "missing": ""}
            words = [loader, str(folder), str(workers), str(seconds)]
            try:
                if not python:
                    raise ChildFailed(f"{INTERPRETER} is not set")
                row |= answer(started("benchmarks.recording.loading", words, python))
            except ChildFailed as error:
                row["missing"] = str(error)
            rows.append(row)
    run.seeds = range(sessions)
    return rows


def make(folder: Path, number: int, seconds: float) -> None:
    """Write one session, the same as files, and as LeRobot's data set."""
    from recorder import SessionWriter, StreamWriter, camera_spec, force_spec
    from recorder.convert import export

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
    (folder / "lerobot").mkdir(exist_ok=True)
    export(path, folder / "lerobot" / str(number), "lerobot")
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


def opened(loader: str, folder: Path) -> tuple[Dataset[Any], str]:
    """Return the windows of a loader, and the key of their images.

    Args:
        loader: One of `LOADERS`.
        folder: The same recordings as `sessions`, `files` and `lerobot`.
    """
    if loader == "ours":
        from learning import TactileDataset

        return TactileDataset(folder / "sessions", WINDOW), "image"
    if loader == "plain":
        return Files(folder / "files"), "image"
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    earlier = [-before / RATE for before in reversed(range(WINDOW))]
    wanted = {IMAGE: earlier, FORCE: earlier}
    paths = sorted((folder / "lerobot").iterdir())
    found = [
        LeRobotDataset(f"local/{path.name}", root=path, delta_timestamps=wanted) for path in paths
    ]
    return ConcatDataset(found), IMAGE


def measured(windows: Dataset[Any], key: str, workers: int, seconds: float) -> dict[str, float]:
    """Read shuffled batches for some seconds; return images, times and memory."""
    loader = DataLoader(windows, BATCH, shuffle=True, num_workers=workers)
    read = 0
    batches = iter(loader)
    next(batches)
    cpu, began = cpu_seconds(), time.monotonic()
    while (took := time.monotonic() - began) < seconds or not read:
        batch = next(batches, None)
        if batch is None:
            batches = iter(loader)
            continue
        read += len(batch[key]) * WINDOW
    del batches  # ends the workers, whose time then counts
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    memory = max(resource.getrusage(kind).ru_maxrss for kind in kinds) / 1e3
    return {"images": read, "seconds": took, "cpu": cpu_seconds() - cpu, "memory_mb": memory}


_ABOUT = f"""\
Shuffled windows of {WINDOW} rows in batches of {BATCH}: JPEGs of {WIDTH}x{HEIGHT} at {RATE:g} Hz,
forces at {FORCE_RATE:g} Hz, from the page cache. `TactileDataset` verifies checksums, aligns forces
to the exposure and gives masks of validity; LeRobot reads the export of the same sessions, the
plain loader the same JPEGs as files, with forces that were aligned before; neither checks anything.
Memory is the largest of the process or a worker.""".replace("\n", " ")


def section(rows: list[dict[str, Any]], page: Page) -> str:
    """Return the table of the loaders."""
    from benchmarks.report import table

    lines = []
    for row in rows:
        about = [LOADERS[row["loader"]], row["workers"]]
        if row["missing"]:
            lines.append([*about, row["missing"], "", ""])
            continue
        rates = [f"{row['images'] / row[by]:,.0f}" for by in ("cpu", "seconds")]
        lines.append([*about, *rates, f"{row['memory_mb']:,.0f}"])
    return "\n\n".join(
        [
            "## Windows for a training",
            _ABOUT,
            table(["reader", "workers", "images per CPU-s", "images/s", "memory [MB]"], lines),
        ]
    )


if __name__ == "__main__":
    chosen, place, number, duration = sys.argv[1:]
    found = measured(*opened(chosen, Path(place)), int(number), float(duration))
    print(RESULT + json.dumps(found))
