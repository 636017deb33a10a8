"""Comparison of rendering with ray casting, for docs/reference/rendering.md.

Run with `python -m benchmarks render-check`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.sim.render.compare import iou, mismatch
from benchmarks.sim.render.raycast import cast_rays, marked
from benchmarks.sim.render.states import RenderState, dent, fold, solved
from recorder.command_line.options import add_device
from sim.device import ready_device
from sim.markers import Camera, named
from sim.markers.renderer import SPACING, Renderer, View

Masks = NDArray[np.bool_]

PATTERNS = ("Array1", "Circle1", "Diamond1", "Array3")
SPACINGS = (0.2e-3, 0.05e-3)
# Rays along each side of a pixel.
RAY_SAMPLES = 5


@dataclass(frozen=True, slots=True)
class Line:
    """Difference between two ways of rendering, worst and mean over the patterns."""

    state: str
    what: str
    overlap: float
    """Smallest intersection over union."""
    differ: float
    """Mean fraction of pixels that differ."""
    differ_most: float

    def __str__(self) -> str:
        """Return a row of a table."""
        fractions = f"{100 * self.differ:.4f} % | {100 * self.differ_most:.4f} %"
        return f"| {self.state} | {self.what} | {self.overlap:.5f} | {fractions} |"


def lines(states: Sequence[RenderState], *, ray_samples: int, device: str) -> Iterator[Line]:
    """Yield every comparison of every state."""
    camera = Camera.paper()
    patterns = [named(name) for name in PATTERNS]
    for state in states:
        rays = cast_rays(
            state.body, camera, state.x, state.y, state.surface.astype(float), samples=ray_samples
        )
        truth = np.stack([marked(pattern, rays, ray_samples) for pattern in patterns])

        def view(spacing: float = SPACING, state: RenderState = state) -> tuple[Renderer, View]:
            renderer = Renderer(state.body, camera, spacing=spacing, device=device)
            return renderer, renderer.see(state.x, state.y, state.surface[None])

        def masks(renderer: Renderer, seen: View) -> Masks:
            drawn: Masks = seen.masks(renderer.textures(patterns))[0]
            return drawn

        renderer, seen = view()
        direct = masks(renderer, seen)
        undeformed = masks(renderer, renderer.undeformed())
        told = f"{ray_samples} x {ray_samples} rays a pixel"
        yield _line(state, "undeformed and deformed", undeformed, direct)
        yield _line(state, told, direct, truth)
        for spacing in SPACINGS:
            drawn = masks(*view(spacing=spacing))
            yield _line(state, f"points every {spacing * 1e3:g} mm, {told}", drawn, truth)


def _line(state: RenderState, what: str, one: Masks, other: Masks) -> Line:
    pairs = list(zip(one, other, strict=True))
    differ = [mismatch(*pair) for pair in pairs]
    return Line(
        state.name, what, min(iou(*pair) for pair in pairs), float(np.mean(differ)), max(differ)
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    add_device(parser)
    parser.add_argument(
        "--rays",
        type=int,
        default=RAY_SAMPLES,
        help="rays along each side of a pixel (default %(default)s)",
    )
    parser.add_argument("--made-up", action="store_true", help="skip the solved presses")


def run(options: argparse.Namespace) -> int:
    """Print the table."""
    ready_device(options.device)
    states = [dent(at=(2e-3, -1e-3), aside=(0.6e-3, 0.3e-3)), fold()]
    if not options.made_up:
        states += solved(device=options.device)
    print("| state | compared | IoU, worst pattern | pixels that differ, mean | worst |")
    print("|---|---|---|---|---|")
    for line in lines(states, ray_samples=options.rays, device=options.device):
        print(line, flush=True)
    return 0
