"""Cost of reading out a sensor, beyond that of the deformation.

Run with `python -m benchmarks sensor-speed [--frames 64]`.

CPU seconds of one process per frame, the minimum of some repeats. Fields are smooth dents on a mesh
of 41 x 41 points that the readout has not seen before.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from recorder.command_line.options import add_device
from recorder.markers import draw_discs
from sim.device import ready_device
from sim.scene import Body
from sim.sensors.field import SurfaceField
from sim.sensors.readout import CameraReadout, TaxelReadout, readout
from sim.sensors.sensor import sensor

REPEATS = 3
# Number of points of a field along x, and along y.
POINTS = 41


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("--frames", type=int, default=64, help="frames per batch (%(default)s)")
    add_device(parser)


def run(options: argparse.Namespace) -> int:
    """Measure every stage and print a table."""
    ready_device(options.device)
    print(f"{'stage':52} {'ms a frame':>10}")
    for name, work in stages(options.frames, options.device):
        work()
        seconds = min(_spent(work) for _ in range(REPEATS))
        print(f"{name:52} {1e3 * seconds / options.frames:10.2f}", flush=True)
    return 0


def stages(frames: int, device: str) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the name and work of each stage."""
    pad = readout(sensor("uskin"), seed=0)
    if isinstance(pad, TaxelReadout):
        top = dents(sensor("uskin").body, frames)
        counts = pad.counts(top)
        yield "uskin: displacement to counts", partial(pad.counts, top)
        yield "uskin: counts to discs", partial(draw_discs, counts)
    for name, seed in (("gelsight", None), ("array-i", 0), ("tacpalm", None)):
        each = sensor(name)
        reader, field = readout(each, seed=seed, device=device), dents(each.body, frames)
        if isinstance(reader, CameraReadout):
            what = "masks" if seed is None else "masks, turned and segmented"
            yield f"{name}: {what}", partial(reader.masks, field)
            yield f"{name}: displacement lattice", partial(reader.displacement, field)


def dents(body: Body, frames: int) -> SurfaceField:
    """Return dents of increasing depth at the middle, up to a tenth of the thickness."""
    x, y = (np.linspace(-size / 2, size / 2, POINTS) for size in (body.size_x, body.size_y))
    across, along = np.meshgrid(x, y, indexing="ij")
    bell = np.exp(-(across**2 + along**2) / body.thickness**2)
    shape = np.stack([0.5 * across * bell, 0.5 * along * bell, -body.thickness * bell], axis=-1)
    depth = 0.1 * np.arange(1, frames + 1) / frames
    return SurfaceField(x, y, (depth[:, None, None, None] * shape).astype(np.float32))


def _spent(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began
