"""Images per second, stage by stage: `python -m benchmarks render-speed --device cuda:0`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from benchmarks.sim.render.states import dent
from recorder.command_line.options import add_device
from sim.device import ready_device
from sim.markers import SIMULATED, Camera, named
from sim.markers.kernels import (
    DeviceTop,
    coverages,
    find_material,
    lens_of,
    packed_masks,
    see_triangles,
    see_vertices,
)
from sim.markers.renderer import SPACING, Renderer
from sim.markers.textures import Textures
from sim.markers.top import cubic_taps, top_of
from sim.scene import Body

REPEATS = 5


def measure(frames: int, spacing: float, device: str, repeats: int) -> list[tuple[str, float, int]]:
    """Return each stage's name, minimum time over `repeats` [s], and number of images."""
    body, lens, top = Body(), lens_of(Camera.paper()), top_of(Body(), spacing)
    states = [dent(depth=(k + 1) / frames * 1.5e-3) for k in range(frames)]
    x, y = states[0].x, states[0].y
    surface = np.stack([state.surface for state in states])
    patterns = [named(name) for name in SIMULATED]
    textures = Textures(patterns, body, device=device)
    device_top = DeviceTop.of(top, device)
    taps = cubic_taps(x, top.x), cubic_taps(y, top.y)
    renderer = Renderer(body, spacing=spacing, device=device)
    here: Any = wp.array(surface, dtype=wp.vec3, device=device)
    images = frames * len(patterns)

    def timed(work: Callable[[], Any]) -> tuple[Any, float]:
        seconds = []
        for _ in range(repeats + 1):
            wp.synchronize_device(device)
            # CPU time on a CPU, whose cores may be shared with others.
            clock = time.process_time if device == "cpu" else time.perf_counter
            began = clock()
            found = work()
            wp.synchronize_device(device)
            seconds.append(clock() - began)
        # The first call may have compiled a kernel.
        return found, min(seconds[1:])

    vertex, to_vertices = timed(lambda: see_vertices(lens, device_top, *taps, here))
    number, to_triangles = timed(lambda: see_triangles(vertex))
    material, to_material = timed(lambda: find_material(top, vertex, number))
    packed, to_masks = timed(lambda: packed_masks(material, textures))
    _, to_host = timed(packed.numpy)
    _, to_grey = timed(lambda: coverages(material, textures))
    _, to_field = timed(lambda: renderer.displacement(x, y, surface))
    _, whole = timed(lambda: renderer.see(x, y, surface).packed(textures))
    _, textured = timed(lambda: Textures(patterns, body, device=device))
    return [
        ("vertices", to_vertices, frames),
        ("which triangle", to_triangles, frames),
        ("material point of each pixel", to_material, frames),
        ("packed masks", to_masks, images),
        ("packed masks to the host", to_host, images),
        ("grey images", to_grey, images),
        ("displacement on the lattice", to_field, frames),
        ("surface to packed masks, all", whole, images),
        ("distance textures, once", textured, len(patterns)),
    ]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    add_device(parser)
    parser.add_argument("--frames", type=int, default=9, help="frames per batch")
    parser.add_argument(
        "--spacing-mm", type=float, default=SPACING * 1e3, help="spacing of the points [mm]"
    )
    parser.add_argument(
        "--repeats",
        type=int,
        default=REPEATS,
        help="number of repeats, of which the fastest counts",
    )


def run(options: argparse.Namespace) -> int:
    """Print one line per stage."""
    ready_device(options.device)
    rows = measure(
        options.frames,
        options.spacing_mm * 1e-3,
        options.device,
        options.repeats,
    )
    clock = "CPU time of one process" if options.device == "cpu" else "wall time"
    print(
        f"{wp.get_device(options.device).name}, {clock}; {options.frames} frames at once, "
        f"{len(SIMULATED)} patterns, "
        f"points every {options.spacing_mm:g} mm"
    )
    for name, seconds, count in rows:
        rate = count / max(seconds, 1e-9)
        print(f"{name:31} {1e3 * seconds / count:9.4f} ms each {rate:12.0f} /s")
    return 0
