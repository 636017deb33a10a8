"""Windows a second that reach a training, beside LeRobot's loader and a plain one of files.

    LEROBOT_PYTHON=/path/to/python python -m benchmarks loading --out docs/results/loading.md

Sessions of 640 x 480 camera JPEGs at 40 Hz with forces at 1 kHz are made. LeRobot gets their export
and the plain loader JPEG files with arrays, as a researcher would export them by hand: the JPEG
bytes are the same. All are read as shuffled windows of 16 rows in batches of 8. Rates are by the
clock and by CPU-second; files are in the page cache. The others check nothing: no checksums, no
alignment, no masks.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.learning.loading_child import BATCH, RATE, RESULT, WINDOW
from benchmarks.recording.frames import HEIGHT, WIDTH, GelFrames
from benchmarks.recording.store_benchmark import INTERPRETER
from recorder import SessionWriter, StreamWriter, camera_spec, force_spec
from recorder.command_line.errors import CommandError
from recorder.convert import export
from recorder.processes import cores

FORCE_RATE = 1000.0
T0 = 10**9
# Loaders by their names in `loading_child`.
LOADERS = {
    "ours": "`TactileDataset`",
    "lerobot": "LeRobot, the same JPEGs in parquet",
    "plain": "plain loader, JPEG files by Pillow",
}


@dataclass(frozen=True, slots=True)
class Row:
    """Speed of one way to read."""

    name: str
    workers: int
    images_per_s: float
    images_per_cpu_s: float
    memory_mb: float
    """Largest resident memory of the process or one of its workers [MB]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.description = (
        "Images per second of TactileDataset, of LeRobot's data set in the Python that "
        f"{INTERPRETER} names, and of a plain loader of files."
    )
    parser.add_argument("--sessions", type=int, default=8, help="number (%(default)s)")
    parser.add_argument(
        "--length", type=float, default=10.0, metavar="S", help="of each [s] (%(default)s)"
    )
    parser.add_argument(
        "--seconds", type=float, default=10.0, help="to measure each row [s] (%(default)s)"
    )
    parser.add_argument("--out", type=Path, help="page to write")


def run(options: argparse.Namespace) -> int:
    """Measure, print the table and write the page.

    Raises:
        CommandError: A loader ended with an error.
    """
    rows = []
    with tempfile.TemporaryDirectory(prefix="loading-") as name:
        folder = Path(name)
        for number in range(options.sessions):
            make(folder, number, options.length)
        for loader in LOADERS:
            interpreter = sys.executable
            if loader == "lerobot":
                interpreter = os.environ.get(INTERPRETER, "")
                if not interpreter:
                    print(f"{LOADERS[loader]}: {INTERPRETER} is not set")
                    continue
            for workers in (0, 2):
                rows.append(measured(loader, interpreter, folder, workers, options.seconds))
                print(line(rows[-1]), flush=True)
    if options.out is not None:
        options.out.write_text(page(rows, options))
        print(f"{options.out}: written")
    return 0


def make(folder: Path, number: int, seconds: float) -> None:
    """Write one session, the same as files, and as LeRobot's data set."""
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
        path, attrs={"sensor": "gel", "indenter": "sphere"}, streams=specs, targets=targets
    ) as session:
        session.begin_run({"t0_ns": T0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})
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


def measured(loader: str, interpreter: str, folder: Path, workers: int, seconds: float) -> Row:
    """Read by a loader in a process of its own, and return its row.

    Raises:
        CommandError: The process ended with an error.
    """
    module = "benchmarks.learning.loading_child"
    place = Path(__file__).parents[2]
    words = [interpreter, "-m", module, loader, str(folder), str(workers), str(seconds)]
    offline = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(folder / "home"), "PYTHONPATH": str(place)}
    done = subprocess.run(
        words,
        cwd=place,
        env={**os.environ, **offline},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = [each for each in done.stdout.splitlines() if each.startswith(RESULT)]
    if done.returncode or not lines:
        raise CommandError(f"{LOADERS[loader]}: {done.stderr.strip()[-1000:]}")
    found = json.loads(lines[-1].removeprefix(RESULT))
    images = found["images"]
    return Row(
        LOADERS[loader],
        workers,
        images / found["seconds"],
        images / found["cpu"],
        found["memory_mb"],
    )


def line(row: Row) -> str:
    """Return the row of the table."""
    return (
        f"| {row.name} | {row.workers} | {row.images_per_s:,.0f} "
        f"| {row.images_per_s / WINDOW:,.1f} | {row.images_per_cpu_s:,.0f} | {row.memory_mb:,.0f} |"
    )


def page(rows: list[Row], options: argparse.Namespace) -> str:
    """Return the page of results."""
    lines = "\n".join(map(line, rows))
    return f"""# Reading windows for a training

Shuffled windows of {WINDOW} rows in batches of {BATCH}, from {options.sessions} sessions of
{options.length:g} s: camera JPEGs of {WIDTH} x {HEIGHT} at {RATE:g} Hz and forces at
{FORCE_RATE:g} Hz. Files are in the page cache; one run on {cores()} cores, made by
`{INTERPRETER}=/path/to/python python -m benchmarks loading --out docs/results/loading.md`; that
Python has LeRobot.

`TactileDataset` verifies checksums, aligns forces to the exposure and gives masks of validity.
LeRobot reads the export of the same sessions (`tactile session export --to lerobot`), which keeps
the JPEG bytes, by its own `delta_timestamps`; its images are float32, four times as large. A plain
loader reads the same JPEGs as files, and forces that were aligned before. Neither checks anything.
Each row is a process of its own. CPU-seconds include the start of workers, and memory is that of
the process or one of its workers, whichever is larger. The load average at the end was
{os.getloadavg()[1]:.0f}: where it exceeds the cores, compare rates per CPU-second only.

| reader | workers | images/s | windows/s | images per CPU-second | memory [MB] |
|---|---|---|---|---|---|
{lines}
"""
