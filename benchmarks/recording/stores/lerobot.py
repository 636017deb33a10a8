"""LeRobot's own dataset writer and reader. Runs in the interpreter that LEROBOT_PYTHON names.

It needs torch, which the rig does not use; LeRobot is used unmodified.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.recording.frames import HEIGHT, WIDTH, number_in_pixels
from benchmarks.recording.stores import Image, Numbers, Opened

_KEY = "observation.images.tactile"
_REPOSITORY = "local/frames"
# Frames per episode: one second, about the press of one target.
_EPISODE = 60
# The number that lerobot-record starts per camera.
_WRITER_THREADS = 4


def dataset_class() -> Any:
    """Return LeRobot's class of data sets."""
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        # A torchvision built for CUDA loads none of its operators with a CPU-only torch. It only
        # needs them declared; LeRobot's writer and reader use none.
        _declare_operators()
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset


_DECLARED: list[Any] = []


def _declare_operators() -> None:
    library = torch.library.Library("torchvision", "FRAGMENT")
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    _DECLARED.append(library)


class _Appender:
    def __init__(self, dataset: Any, path: Path, profile: str) -> None:
        names = ["height", "width", "channels"]
        vector = {"dtype": "float32", "shape": (6,), "names": [f"v{i}" for i in range(6)]}
        self._data = dataset.create(
            _REPOSITORY,
            fps=60,
            features={
                _KEY: {"dtype": profile, "shape": (HEIGHT, WIDTH, 3), "names": names},
                "observation.state": vector,
                "action": vector,
            },
            root=path,
            use_videos=profile == "video",
            image_writer_threads=_WRITER_THREADS,
        )
        self._vector = np.zeros(6, np.float32)
        self._count = 0

    def append(self, frame: Image | bytes, t_ns: int) -> None:
        # Its threads write later, so each frame needs a copy, as from any camera.
        image = np.array(frame)
        self._data.add_frame(
            {
                _KEY: image,
                "observation.state": self._vector,
                "action": self._vector,
                "task": "press",
            }
        )
        self._count += 1
        if self._count % _EPISODE == 0:
            self._data.save_episode()

    def close(self) -> None:
        if self._count % _EPISODE:
            self._data.save_episode()
        self._data.stop_image_writer()
        self._data.finalize()


class LeRobot:
    """A dataset of one camera.

    Args:
        profile: `image` or `video`.
    """

    def __init__(self, profile: str) -> None:
        self._profile = profile
        self._dataset = dataset_class()

    def create(self, path: Path) -> _Appender:
        """Create a new dataset."""
        return _Appender(self._dataset, path, self._profile)

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        data = self._dataset(_REPOSITORY, root=path)

        def read(first: int, count: int) -> Image:
            rows = [data[row][_KEY] for row in range(first, first + count)]
            pixels = torch.stack(rows).permute(0, 2, 3, 1) * 255
            return np.asarray(pixels.round().to(torch.uint8).numpy())

        yield len(data), read

    def left(self, path: Path) -> Numbers:
        """Return the frames that its reader finds."""
        with self.reader(path) as (count, read):
            return [number_in_pixels(read(row, 1)[0]) for row in range(count)]

    def repaired(self, path: Path) -> None:
        """Return None: there is no repair."""
        return
