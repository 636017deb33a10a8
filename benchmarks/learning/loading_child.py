"""Process that reads windows by one loader: `python -m benchmarks.learning.loading_child ...`.

A process of its own, so that CPU time and memory concern that loader only, and so that LeRobot may
run in another interpreter. The arguments are the loader, the folder, the number of workers and the
duration [s]; the answer is one line of JSON on stdout.
"""

from __future__ import annotations

import io
import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import ConcatDataset, DataLoader, Dataset

WINDOW, BATCH = 16, 8
RATE = 40.0
# Prefix of the line with the answer.
RESULT = "RESULT "
# Names of the export's columns in LeRobot.
IMAGE, FORCE = "observation.images.tactile", "observation.force"


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
        loader: ours, plain or lerobot.
        folder: The same recordings as `sessions`, `files` and `lerobot`.
    """
    if loader == "ours":
        from learning import TactileDataset

        return TactileDataset(folder / "sessions", WINDOW), "image"
    if loader == "plain":
        return Files(folder / "files"), "image"
    from benchmarks.recording.stores.lerobot import dataset_class

    own = dataset_class()
    earlier = [-before / RATE for before in reversed(range(WINDOW))]
    wanted = {IMAGE: earlier, FORCE: earlier}
    paths = sorted((folder / "lerobot").iterdir())
    found = [own(f"local/{path.name}", root=path, delta_timestamps=wanted) for path in paths]
    return ConcatDataset(found), IMAGE


def measured(windows: Dataset[Any], key: str, workers: int, seconds: float) -> dict[str, float]:
    """Read shuffled batches for some seconds; return images, times and memory."""
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
        read += len(batch[key]) * WINDOW
    del batches  # ends the workers, whose time then counts
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    memory = max(resource.getrusage(kind).ru_maxrss for kind in kinds) / 1e3
    return {"images": read, "seconds": took, "cpu": _cpu() - cpu, "memory_mb": memory}


def _cpu() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


if __name__ == "__main__":
    chosen, place, number, duration = sys.argv[1:]
    found = measured(*opened(chosen, Path(place)), int(number), float(duration))
    print(RESULT + json.dumps(found))
