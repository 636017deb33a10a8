"""A session that is recorded press by press, with planted faults, and its judged quality."""

import contextlib
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg

from recorder import SessionWriter, StreamSpec, StreamWriter
from recorder.spec import camera_spec, force_spec, pose_spec, reference_spec, taxels_spec
from rig.bench.bench import Bench, BenchFile
from rig.core.geometry import compose
from rig.core.packaged import BENCHES
from rig.monitor.quality import LiveQuality, QualityRow

GELSIGHT, USKIN = (BenchFile.read(BENCHES / f"{name}.yaml").bench for name in ("gelsight", "uskin"))
CLEARANCE = 0.3e-3
MS = 1_000_000
# Columns and rows of the markers.
PLACES = [(x, y) for x in range(100, 600, 80) for y in range(60, 440, 60)]
Part = Callable[..., Any]


@functools.cache
def picture(missing: int = 0, light: float = 1.0) -> bytes:
    """Return a JPEG of dark markers on a lit skin, without some of those in the middle."""
    pixels = np.full((480, 640, 3), 180.0)
    row, column = np.indices((480, 640))
    kept = PLACES[: len(PLACES) // 2] + PLACES[len(PLACES) // 2 + missing :]
    for x, y in kept:
        pixels[(column - x) ** 2 + (row - y) ** 2 < 100] = 40.0
    noise = np.random.default_rng(0).normal(0, 1.0, pixels.shape)
    return simplejpeg.encode_jpeg(
        np.clip(light * pixels + noise, 0, 255).astype(np.uint8), quality=90
    )


class Recording:
    """A session that is recorded: presses of half a second, and rests as long, in real order."""

    def __init__(self, bench: Bench, path: Path) -> None:
        self.bench, self.path = bench, path
        self.specs: list[StreamSpec] = [force_spec(1000.0), pose_spec(125.0)]
        if bench.camera is not None:
            self.specs.append(camera_spec(30.0, height=480, width=640, codec="jpeg"))
        if bench.taxels is not None:
            self.specs.append(taxels_spec(50.0))
        attrs = {"sensor": bench.sensor, "rate_hz": 40.0}
        self.session = SessionWriter.create(path, attrs=attrs, streams=self.specs, targets={})
        self.writers = {
            spec.name: StreamWriter.open(path / "streams" / spec.name) for spec in self.specs
        }
        self.noise = np.random.default_rng(1)
        self.now_ms = 0
        self.quality = LiveQuality(bench, path, CLEARANCE, 0)

    def second(
        self,
        *,
        force: Part = lambda ms, load: (0.0, 0.0, -3.0 * load),
        noise: float = 0.01,
        status: int = 0,
        tip: Part = lambda ms, load: (0.0, 0.0),
        image: Part = lambda load: picture(),
        counts: Part = lambda load: 5000.0 * load,
    ) -> None:
        """Record a rest, a press and its release, one second in all.

        Forces [N] and places of the tip in the contact frame [m] are those at a time of this
        second [ms] and a load (0 to 1), images and counts those at a load.
        """
        for ms in range(1000):
            t_ns = (self.now_ms + ms) * MS
            load = max(0.0, 1.0 - abs(ms - 700) / 250)
            wrench = np.append(force(ms, load), (0.0, 0.0, 0.0))
            wrench[:3] += self.noise.normal(0, noise, 3)
            self.writers["force"].append(
                value=wrench, seq=self.now_ms + ms, status=status, t_ns=t_ns
            )
            if ms % 8 == 0:
                height = CLEARANCE - 1e-3 * load if load else CLEARANCE
                place = compose(self.bench.contact_frame, (*tip(ms, load), height, 0.0, 0.0, 0.0))
                self.writers["pose"].append(
                    value=place, device_t=1e-9 * t_ns, speed_scaling=1.0, t_ns=t_ns
                )
            if "camera" in self.writers and ms % 33 == 0:
                self.writers["camera"].append(value=image(load), device_t=float("nan"), t_ns=t_ns)
            if "taxels" in self.writers and ms % 20 == 0:
                value = np.full((16, 3), round(counts(load)), np.int32)
                seq = (self.now_ms + ms) // 20
                self.writers["taxels"].append(value=value, device_t=1e-9 * t_ns, seq=seq, t_ns=t_ns)
        if self.now_ms == 0 and "camera" in self.writers:
            columns = reference_spec(self.specs).columns
            row = {column.name: np.full(column.shape, 3, column.dtype) for column in columns}
            self.session.reference.append(**row)
        self.now_ms += 1000

    def seconds(self, count: int, **parts: Any) -> dict[str, QualityRow]:
        """Record `count` seconds, and return their quality."""
        for _ in range(count):
            self.second(**parts)
        return self.judged()

    def judged(self) -> dict[str, QualityRow]:
        return {row.name: row for row in self.quality.look()}

    def close(self) -> None:
        for writer in self.writers.values():
            writer.close()
        self.session.close()


def recording(bench: Bench, folder: Path) -> contextlib.closing[Recording]:
    return contextlib.closing(Recording(bench, folder / "s.zarr"))
