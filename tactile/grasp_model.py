"""Force model of a simulated finger, for the demo of grips: presses, archive, `tactile force`."""

import hashlib
import os
import tempfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.choice.run import Request, own_labels, run_choice
from learning.data.matching import SensorSelection
from learning.markers.pattern import with_reference
from recorder.archive import COLUMNS, NO_PHASE, Frames, MarkerArchive, SensorPlan, fill_archive
from recorder.markers import pack
from recorder.progress import ReportItems
from rig.bench.worlds import Noise, WorldSpec
from rig.mock.world.sensors import ladder_press, row_of
from rig.mock.world.views import reading_of
from rig.monitor.predictor import open_segmenter

# Sensor of each finger, and indenters that its model learns from; objects of the demo have others.
SENSOR = WorldSpec("gelsight", noise=Noise(grey=1.0))
LEARNED = (
    *("sphere", "sphere_s", "hemisphere", "cylinder_sh", "cylinder_si", "torus"),
    *("dots", "wave", "line", "triangle", "random", "prism"),
)
# Presses of each indenter, and their frames: without contact, deeper and deeper, then sheared.
PRESSES, DEEPER, SHEARED = 9, 5, 8
LENGTH = 1 + DEEPER + SHEARED
# Range of the time from frame to frame [s]; largest shear, and distance from the middle [m].
STEPS, SHEAR, ASIDE = (0.05, 0.5), 1.2e-3, 1.5e-3
# Mean and spread of the shear's direction [rad]: an object hangs along y; friction over the skin's.
TURN, FRICTIONS = (np.pi / 2, 0.6), (0.8, 1.6)


class SimulatedPresses:
    """Marker frames of presses as in a grip, with true forces; a unit of the archive is a press."""

    def __init__(self) -> None:
        self._points, self._read = reading_of(SENSOR, "camera")
        self._segmenter = open_segmenter(SENSOR.sensor)
        self._still = np.zeros((len(self._points), 3), np.float32)
        view = self._segmenter.view(self._read(self._still, 0))
        self._finder = with_reference(self._segmenter, view)

    def _mask(self, moved: NDArray[np.float32]) -> NDArray[np.uint8]:
        return pack(self._finder.mask_of_view(self._segmenter.view(self._read(moved, 0))))

    @cached_property
    def plan(self) -> SensorPlan:
        """Plan of the archive."""
        return SensorPlan(
            name=SENSOR.sensor,
            rows=LENGTH * PRESSES * len(LEARNED),
            chunk_rows=LENGTH,
            unit_rows=LENGTH,
            references=self._mask(self._still)[None],
            mm_per_px=self._segmenter.preset.mm_per_px or 0.0,
            marker_count=None,
        )

    def read(self, rows: slice) -> Frames:
        """Make the frames of one press."""
        number = rows.start // LENGTH
        code, target = divmod(number, PRESSES)
        random = np.random.default_rng(number)
        press = ladder_press(SENSOR, LEARNED[code], random.uniform(*FRICTIONS))
        seconds = float(np.exp(random.uniform(*np.log(STEPS))))
        masks, wrenches, tips = [], [], self._tips(random, target)
        for tip in tips:
            press.move(tip, seconds)
            masks.append(self._mask(press.markers(self._points)))
            wrenches.append(press.wrench)
        same = {"indenter": code, "seen": True, "location": number, "target": target}
        same |= {"phase": NO_PHASE, "reference": 0, "valid": True}
        table = {name: np.full(LENGTH, one, COLUMNS[name].dtype) for name, one in same.items()}
        table |= {"depth": np.maximum(-tips[:, 2], 0.0), "position": tips[:, :2]}
        table |= {"wrench": np.stack(wrenches), "frame": np.arange(LENGTH, dtype=np.int32)}
        table["t_ns"] = (1e9 * seconds * np.arange(LENGTH)).astype(np.int64)
        return Frames(np.stack(masks), table, ["simulated"] * LENGTH)

    def _tips(self, random: np.random.Generator, target: int) -> NDArray[np.float64]:
        """Return the tips (n, 3) [m] of a press: down, then along a direction."""
        deepest = row_of(SENSOR).depth_max * ((target + 1) / PRESSES) ** 0.6
        turn, far = random.normal(*TURN), SHEAR * random.uniform(0.3, 1)
        way = far * np.arange(1, SHEARED + 1)[:, None] / SHEARED
        tips = np.full((LENGTH, 3), -deepest)
        tips[:, :2] = random.uniform(-1, 1, 2) * [ASIDE / 4, ASIDE]
        tips[: 1 + DEEPER, 2] = [1e-4, *(-deepest * np.arange(1, DEEPER + 1) / DEEPER)]
        tips[1 + DEEPER :, :2] += way * [np.cos(turn), np.sin(turn)]
        return tips


def cached_model(progress: ReportItems, say: Callable[[str], None]) -> Path:
    """Return the folder of a finger's force model, which is made once, in a minute."""
    digest = hashlib.sha256(repr((SENSOR, row_of(SENSOR))).encode() + Path(__file__).read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tactile-rig/grasp"
    folder = base / digest.hexdigest()[:12]
    if folder.is_dir():
        return folder / "model"
    base.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=base) as temporary:
        new = Path(temporary) / "new"
        archive = new / "presses.markers.zarr"
        new.mkdir()
        fill_archive(archive, [SimulatedPresses()], LEARNED, {}, progress)
        sensor = SensorSelection(MarkerArchive(archive), SENSOR.sensor, SENSOR.sensor)
        request = Request(sensor, new / "model", ways=("kernel",))
        run_choice(request, own_labels(request, None), say)
        if not folder.is_dir():  # unless another process has made it meanwhile
            new.rename(folder)
    return folder / "model"
