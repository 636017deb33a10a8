"""Marker images against rays cast through a fine mesh, and images per second."""

import time
import timeit
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from benchmarks.accuracy.raycast import cast_rays, marked
from benchmarks.accuracy.wording import Row, devices_of, kind_of
from benchmarks.report import Page, Run, table
from recorder.charts import chart
from sim.device import ready_device
from sim.indenters import named as indenter_of
from sim.indenters import sphere
from sim.markers import SIMULATED, Camera, named
from sim.markers.renderer import Renderer
from sim.result import Result
from sim.scene import Body, Effects, Friction, Scene, press
from sim.tiers import simulate

Mask = NDArray[np.bool_]
Array = NDArray[np.float64]

PATTERNS = ("Array1", "Circle1", "Diamond1", "Array3")
# Rays along each side of a pixel.
RAYS, QUICK_RAYS = 5, 1
# Fraction of the pixels that may differ from the rays.
ALLOWED = 1e-3
# Frames at once, and runs of which the fastest counts.
FRAMES, REPEATS = 9, 5
# The picture: patterns, and colours of the markers.
DRAWN = ("Array3", "Circle1", "Diamond1")
MARKER, BEFORE = np.array([0.16, 0.17, 0.21]), np.array([0.91, 0.59, 0.47])
# Radius of a dent [m].
RADIUS = 3e-3


@dataclass(frozen=True, slots=True, eq=False)
class RenderState:
    """One deformed surface."""

    name: str
    body: Body
    x: Array
    """x of the undeformed points (X,) [m]."""
    y: Array
    """y of the undeformed points (Y,) [m]."""
    surface: NDArray[np.float32]
    """Their displacement (X, Y, 3) [m]."""


def dent(
    body: Body | None = None,
    *,
    depth: float = 1.2e-3,
    at: tuple[float, float] = (0.0, 0.0),
    aside: tuple[float, float] = (0.0, 0.0),
) -> RenderState:
    """Return a smooth dent of `depth` [m], with the skin pushed outwards and dragged `aside` [m].

    Points are denser at the dent, as in a mesh.
    """
    body = body or Body()
    x, y = _graded(body.size_x / 2, at[0]), _graded(body.size_y / 2, at[1])
    off_x, off_y = x[:, None] - at[0], y[None, :] - at[1]
    bell = np.exp(-(off_x**2 + off_y**2) / RADIUS**2)
    outwards = 0.35 * depth / RADIUS * bell
    surface = [
        outwards * off_x + aside[0] * bell,
        outwards * off_y + aside[1] * bell,
        -depth * bell,
    ]
    return RenderState("dent", body, x, y, np.stack(surface, axis=-1).astype(np.float32))


def fold() -> RenderState:
    """Return a sheet dragged over itself so far that part of it is behind another part."""
    body = Body()
    x = np.linspace(-body.size_x / 2, body.size_x / 2, 121)
    bell = np.exp(-((x / 2.5e-3) ** 2))[:, None] * np.ones(len(x))
    surface = np.stack([4.5e-3 * bell, 0 * bell, -1.5e-3 * bell], axis=-1)
    return RenderState("fold", body, x, x.copy(), surface.astype(np.float32))


def solved(device: str) -> list[RenderState]:
    """Solve a deep sphere, an off-centre prism, and a sheared cylinder with friction, by `fem`.

    The frame of each is the one in which the tip is farthest from where it began.
    """
    scenes = {
        "sphere R 4 mm, 1.5 mm deep": Scene(sphere(4e-3), press([1.5e-3])),
        "prism, 0.7 mm deep at (4, -4) mm": Scene(
            indenter_of("prism"), press([0.7e-3], at=(4e-3, -4e-3))
        ),
        "cylinder, 0.8 mm deep, sheared 0.8 mm": Scene(
            indenter_of("cylinder"),
            press([0.8e-3], shear=0.8e-3, angle=0.6, steps=2),
            effects=Effects(friction=Friction(0.8)),
        ),
    }
    states = []
    for name, scene in scenes.items():
        moved = np.abs(np.subtract(scene.motion.tip, scene.motion.tip[0])).sum(axis=1)
        states.append(state_of(name, simulate(scene, device=device), int(moved.argmax())))
    return states


def state_of(name: str, result: Result, frame: int) -> RenderState:
    """Return one frame of a result."""
    body = result.scene.body
    return RenderState(name, body, result.surface_x, result.surface_y, result.surface[frame])


def _graded(half: float, middle: float) -> Array:
    """Return 61 points from -half to half, about three times as dense around `middle`."""
    fraction = np.linspace(-1, 1, 1220)
    density = 1 + 2 * np.exp(-((fraction * half - middle) ** 2) / (half / 3) ** 2)
    amount = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2)])
    return np.interp(np.linspace(0, 1, 61), amount / amount[-1], fraction) * half


def measure(run: Run) -> dict[str, Any]:
    """Return the differences of every state, and the images per second on every device."""
    ready_device(run.device)
    states = [dent(at=(2e-3, -1e-3), aside=(0.6e-3, 0.3e-3)), fold()]
    if not run.quick:
        states += solved(run.device)
    compared = []
    for state in states:
        compared.append(difference(state, QUICK_RAYS if run.quick else RAYS, run.device))
        run.progress(0.7 * len(compared) / len(states))
        if compared[-1]["worst"] > ALLOWED and not run.quick:
            run.failures.append(f"{state.name}: more than {100 * ALLOWED:g} % of the pixels differ")
    rates = [row for device in devices_of(run.device) for row in speeds(device, run.quick)]
    run.spread = f"times: fastest of {1 if run.quick else REPEATS} runs"
    return {"compared": compared, "rates": rates}


def iou(one: Mask, other: Mask) -> float:
    """Return the intersection over union of the marker pixels; 1 if neither has any."""
    either = int((one | other).sum())
    return int((one & other).sum()) / either if either else 1.0


def mismatch(one: Mask, other: Mask) -> float:
    """Return the fraction of all pixels in which they differ."""
    return float((one != other).mean())


def difference(state: RenderState, samples: int, device: str) -> Row:
    """Return the difference of a state's masks from those of rays, and that by the press."""
    camera, patterns = Camera.paper(), [named(name) for name in PATTERNS]
    surface = state.surface.astype(float)
    rays = cast_rays(state.body, camera, state.x, state.y, surface, samples=samples)
    renderer = Renderer(state.body, camera, device=device)
    textures = renderer.textures(patterns)
    drawn = renderer.see(state.x, state.y, state.surface[None]).masks(textures)[0]
    before = renderer.undeformed().masks(textures)[0]
    pairs = [
        (mask, marked(pattern, rays, samples))
        for mask, pattern in zip(drawn, patterns, strict=True)
    ]
    off = [mismatch(*pair) for pair in pairs]
    return {
        "state": state.name,
        "overlap": min(iou(*pair) for pair in pairs),
        "mean": float(np.mean(off)),
        "worst": max(off),
        "by_press": mismatch(before, drawn),
    }


def speeds(device: str, quick: bool) -> list[Row]:
    """Return the time of an image for every kind of image: CPU time on a CPU, else wall time."""
    ready_device(device)
    frames = 2 if quick else FRAMES
    states = [dent(depth=(k + 1) / frames * 1.5e-3) for k in range(frames)]
    x, y = states[0].x, states[0].y
    surface = np.stack([state.surface for state in states])
    renderer = Renderer(Body(), device=device)
    textures = renderer.textures([named(name) for name in SIMULATED])
    view = renderer.see(x, y, surface)
    clock = time.process_time if device == "cpu" else time.perf_counter

    def least(work: Callable[[], object]) -> float:
        def once() -> None:
            work()
            wp.synchronize_device(device)

        once()  # it may compile a kernel
        return min(timeit.repeat(once, timer=clock, number=1, repeat=1 if quick else REPEATS))

    images = frames * len(SIMULATED)
    kinds: list[tuple[str, Callable[[], object], int]] = [
        ("mask from surface", lambda: renderer.see(x, y, surface).packed(textures), images),
        ("grey image", lambda: view.coverage(textures), images),
        ("displacement field", lambda: renderer.displacement(x, y, surface), frames),
    ]
    return [
        {"what": what, "device": device, "seconds": least(work) / count}
        for what, work, count in kinds
    ]


# The page


def section(values: dict[str, Any], page: Page) -> str:
    """Return the picture, the table of differences, and the times."""
    draw(page, dent(at=(2e-3, -1e-3), aside=(0.6e-3, 0.3e-3)))
    rows = [
        [
            row["state"],
            f"{row['overlap']:.4f}",
            *(f"{100 * row[name]:.3f} %" for name in ("mean", "worst")),
            f"{100 * row['by_press']:.1f} %",
        ]
        for row in values["compared"]
    ]
    times = [
        f"{row['what']} {1e3 * row['seconds']:.3g} ms"
        + (" on a GPU" if kind_of(row["device"]) == "GPU" else "")
        for row in values["rates"]
    ]
    head = ["state", "smallest overlap", "pixels that differ", "worst pattern"]
    return f"""## Marker images

{page.link("images", "Markers of a smooth dent, and in red where they were before")}

{table([*head, "changed by the press"], rows)}

Masks ({", ".join(PATTERNS)}) are compared with rays through a mesh of 0.05 mm that share no code
with the renderer; overlap is intersection over union.
Time an image, CPU time of one core unless on a GPU: {"; ".join(times)}. {FRAMES} frames at once
with {len(SIMULATED)} patterns each; a displacement field is one a frame."""


def draw(page: Page, state: RenderState) -> None:
    """Draw a state with each pattern: markers dark, and red where they were before alone."""
    ready_device("cpu")
    renderer = Renderer(state.body, Camera.paper())
    textures = renderer.textures([named(name) for name in DRAWN])
    before = renderer.undeformed().coverage(textures)[0]
    after = renderer.see(state.x, state.y, state.surface[None]).coverage(textures)[0]
    with chart(page.picture("images"), 7.4, 2.4) as figure:
        figure.suptitle("Dark: markers of the dent; red: where they were before", x=0.01, ha="left")
        every = figure.subplots(1, len(DRAWN))
        for axes, name, old, new in zip(every, DRAWN, before, after, strict=True):
            pixels = np.ones((*old.shape, 3))
            for coverage, colour in ((old, BEFORE), (new, MARKER)):
                fraction = coverage[..., None] / 255
                pixels = pixels * (1 - fraction) + colour * fraction
            axes.imshow(pixels)
            axes.set_axis_off()
            axes.set_title(name)
