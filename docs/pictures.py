"""Draw the pictures of these pages: `python docs/pictures.py [NAME...]`, from the repository.

`bench` is wiring, mounting and frames of a packaged bench; `indenters` and `patterns` are contact
sheets; `sensors` is a prism pressed into every sensor (minutes); `tips` is one drawing of each
indenter in mm, which is packaged with the benches. Without names all but `tips` are drawn.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from recorder.charts import BAND, BLUE, GREEN, ORANGE, PURPLE, RED, SKY, chart
from recorder.charts import INK as LINE
from recorder.charts import SOFT as GREY
from recorder.plot import INK, PANEL, PAPER, SOFT, font
from rig.bench.bench import Bench, BenchFile
from rig.core.packaged import BENCHES
from sim.device import ready_device
from sim.fem import FOR_EDGES, Fem
from sim.indenters import NAMES, Indenter, named
from sim.layer import Layer
from sim.markers import HEIGHT, WIDTH, Camera
from sim.markers import named as pattern_of
from sim.markers.pattern import HOMOGENEOUS, SIMULATED, Pattern
from sim.markers.pattern import NAMES as PATTERNS
from sim.scene import press
from sim.sensors import HETEROGENEOUS, MATERIAL, SurfaceField, readout, sensor
from sim.sensors import HOMOGENEOUS as GRIDS
from sim.tiers import simulate

if TYPE_CHECKING:
    from recorder.charts import Axes

IMAGES = Path(__file__).with_name("images")
TIPS = Path(__file__).parents[1] / "rig/bench/indenters"
Array = NDArray[np.float64]
Point = tuple[float, float]
Place = tuple[float, float, float]
# Title, line of text, picture.
Tile = tuple[str, str, NDArray[np.uint8]]

AXES = ((RED, "x"), (GREEN, "y"), (BLUE, "z"))
# Directions of x, y and z of the base on the page, seen from the front and above.
LOOK = np.array([[0.92, 0.42, 0.0], [-0.16, 0.36, 1.0]])


# Parts of drawings.


def rectangle(
    axes: Axes, low: Point, size: Point, fill: str, edge: str = LINE, style: str = "-"
) -> None:
    """Draw a rectangle from its lower left corner."""
    (x, y), (width, height) = low, size
    corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
    polygon(axes, corners, fill, edge, style)


def polygon(
    axes: Axes, corners: Sequence[Point], fill: str, edge: str = LINE, style: str = "-"
) -> None:
    """Draw a filled polygon."""
    axes.fill(*zip(*corners, strict=True), fc=fill, ec=edge, ls=style, lw=1.2)


def empty(axes: Axes, width: float, height: float) -> None:
    """Make axes a sheet of paper of this size, without scales."""
    axes.set_xlim(0, width)
    axes.set_ylim(0, height)
    axes.set_aspect("equal")
    axes.axis("off")


def box(axes: Axes, x: float, y: float, size: Point, title: str, text: str, color: str) -> None:
    """Draw a device: its title, and lines of text below."""
    height = size[1]
    rectangle(axes, (x, y), size, "white", color)
    axes.text(x + 1.5, y + height - 1.6, title, weight="bold", va="top", color=LINE)
    axes.text(x + 1.5, y + height - 6.0, text, va="top", fontsize=7.5, color=LINE, linespacing=1.35)


def cable(axes: Axes, way: Sequence[Point], color: str, text: str = "", at: Point = (0, 0)) -> None:
    """Draw a cable along points, with a text."""
    axes.plot(*zip(*way, strict=True), color=color, lw=1.8, solid_joinstyle="round", zorder=0)
    if text:
        axes.text(*at, text, fontsize=7.5, color=color, va="center")


def arrow(axes: Axes, start: Point, end: Point, color: str, style: str = "-|>") -> None:
    """Draw an arrow."""
    axes.annotate(
        "", xy=end, xytext=start, arrowprops={"arrowstyle": style, "color": color, "lw": 1.5}
    )


def dimension(axes: Axes, x: float, low: float, high: float, text: str) -> None:
    """Draw a height between two places, with its text on the right."""
    arrow(axes, (x, low), (x, high), GREY, "<|-|>")
    axes.text(x + 1.5, (low + high) / 2, text, fontsize=7.5, va="center", color=LINE)


# Wiring: addresses and names as in the guide.

ARM = "192.168.1.10  (arm.host)\nremote control on the pendant\nTCP 29999 and 30001 to 30004"
GAUGE = "192.168.1.1  (force.host)\npage TCP 80, samples UDP 49152\nor: NI card"
COMPUTER = "192.168.1.100\ntactile doctor, then setup\ngroups dialout and video"
GRIPPER = "RS-485 to USB, 24 V\n/dev/serial/by-id/...\n(gripper.port)"
HID = "udev rule as\ntactile doctor says\n(pedal.device, jog.device)"
CAMERA = "USB port of its own\n/dev/v4l/by-id/...\n(camera.address)"
TAXELS = "uSkin only\nws://192.168.1.20:5000\n(taxels.address)"


def wiring(_: Bench, path: Path) -> None:
    """Draw the devices, their cables, addresses and ports."""
    with chart(path, 8.0, 4.7) as figure:
        axes = figure.subplots()
        empty(axes, 160, 94)
        for x, y, size, title, text, color in (
            (2, 66, (46, 22), "Arm's controller", ARM, BLUE),
            (66, 70, (28, 13), "Switch", "wired, nothing else", BLUE),
            (112, 66, (46, 22), "Net F/T box", GAUGE, BLUE),
            (
                2,
                42,
                (38, 15),
                "Robot arm",
                "holds the indenter;\nits red button within reach",
                GREY,
            ),
            (58, 39, (46, 19), "Computer", COMPUTER, LINE),
            (122, 42, (36, 15), "F/T sensor", "carries the tactile sensor", GREY),
            (2, 4, (36, 18), "Gripper", GRIPPER, ORANGE),
            (42, 4, (38, 18), "Pedal, SpaceMouse", HID, ORANGE),
            (84, 4, (34, 18), "Camera", CAMERA, ORANGE),
            (122, 4, (36, 18), "Taxel server", TAXELS, BLUE),
        ):
            box(axes, x, y, size, title, text, color)
        cable(axes, [(48, 76), (66, 76)], BLUE)
        cable(axes, [(94, 76), (112, 76)], BLUE)
        cable(axes, [(76, 70), (76, 58)], BLUE, "Ethernet", (78, 64))
        cable(axes, [(90, 70), (90, 62), (113, 62), (113, 30), (140, 30), (140, 22)], BLUE)
        cable(axes, [(21, 66), (21, 57)], GREY, "arm's cable", (23, 61.5))
        cable(axes, [(140, 66), (140, 57)], GREY, "sensor's cable", (142, 61.5))
        for x, top in ((20, 62), (70, 70), (100, 94)):
            cable(axes, [(x, 22), (x, 30), (top, 30), (top, 39)], ORANGE)
        axes.text(72, 34.5, "USB", fontsize=7.5, color=ORANGE, va="center")


# Mounting


def mounting(bench: Bench, path: Path) -> None:
    """Draw a section through tool and sensor, with the lengths that the bench file has."""
    length, retract = 1e3 * bench.arm.tcp[2], 1e3 * bench.arm.retract
    depth = 1e3 * bench.limits.depth_max
    # Middle, and heights of surface, tip and flange, on the page.
    middle, surface, tip, flange = 38.0, 40.0, 54.0, 92.0

    with chart(path, 7.0, 5.2) as figure:
        axes = figure.subplots()
        empty(axes, 140, 104)

        def part(x: float, y: float, size: Point, color: str, text: str = "") -> None:
            width, height = size
            rectangle(axes, (x, y), size, color)
            axes.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=8)

        part(middle - 13, flange, (26, 9), BAND, "flange")
        part(middle - 11, flange - 14, (22, 14), "white", "gripper\nor mount")
        part(middle - 6, tip + 9, (12, flange - 14 - tip - 9), BAND)
        corners = [
            (middle - 6, tip + 9),
            (middle + 6, tip + 9),
            (middle + 3, tip),
            (middle - 3, tip),
        ]
        polygon(axes, corners, BAND)
        axes.text(middle + 8, tip + 10, "indenter", fontsize=8, va="center")
        part(middle - 20, surface - 5, (40, 5), SKY, "elastomer")
        part(middle - 20, surface - 17, (40, 12), "white", "sensor, camera inside")
        part(middle - 15, surface - 27, (30, 10), ORANGE, "F/T sensor")
        part(middle - 34, surface - 34, (68, 7), BAND, "base plate, screwed to the arm's own table")
        axes.plot([middle - 26, middle + 58], [surface, surface], color=GREY, lw=0.9, ls="--")
        axes.plot([middle - 8, middle + 58], [tip, tip], color=GREY, lw=0.9, ls="--")
        axes.plot([middle + 13, middle + 58], [flange, flange], color=GREY, lw=0.9, ls="--")
        dimension(
            axes, middle + 34, tip, flange,
            f"arm.tcp: {length:g} mm here,\nflange to tip, by a caliper;\nthe same on the pendant",
        )  # fmt: skip
        dimension(
            axes, middle + 34, surface, tip,
            f"arm.retract_mm: {retract:g} mm\nabove the surface between points",
        )  # fmt: skip
        axes.text(
            middle + 36, surface - 3.5,
            "contact_frame: middle of the untouched surface,\nfound by the steps contact and home",
            fontsize=7.5, va="top",
        )  # fmt: skip
        axes.text(
            middle + 36, surface - 14,
            f"limits.depth_max_mm: {depth:g} mm below it at most", fontsize=7.5, va="top",
        )  # fmt: skip
        axes.text(
            middle + 36, surface - 21,
            "The F/T sensor carries the whole sensor:\nnothing else may touch the sensor, and its\n"
            "cable hangs in a loop that bears no force.", fontsize=7.5, va="top",
        )  # fmt: skip
        axes.set_title("Section through tool and sensor (not to scale)")


# Frames


def frames(bench: Bench, path: Path) -> None:
    """Draw the frames in space, and the sensor from above with the targets of the plan."""
    with chart(path, 8.4, 5.0) as figure:
        space, above = figure.subplots(1, 2, width_ratios=(1.25, 1))
        _space(space)
        _above(above, bench)


def _space(axes: Axes) -> None:
    empty(axes, 104, 106)
    axes.set_title("Frames")
    origin = np.array([20.0, 18.0])

    def at(place: Place) -> Point:
        x, y = origin + LOOK @ np.array(place)
        return float(x), float(y)

    def frame(
        place: Place, name: str, text: Point, *, length: float = 15, turned: bool = False
    ) -> None:
        # Turned by 180 degrees about x: y and z are inverted.
        signs = (1, -1, -1) if turned else (1, 1, 1)
        for axis, (color, letter) in enumerate(AXES):
            end = list(place)
            end[axis] += signs[axis] * length
            tip = at((end[0], end[1], end[2]))
            start = at(place)
            arrow(axes, start, tip, color)
            way = np.subtract(tip, start)
            x, y = np.add(tip, way / max(float(np.hypot(*way)), 1e-9) * 2.6)
            axes.text(x, y, letter, color=color, ha="center", va="center", weight="bold")
        axes.text(*text, name, fontsize=7.5, va="center", color=LINE, linespacing=1.3)

    def slab(low: Place, size: Place, color: str) -> None:
        (x, y, z), (w, d, h) = low, size
        for corners in (
            [(x, y, z), (x + w, y, z), (x + w, y, z + h), (x, y, z + h)],
            [(x + w, y, z), (x + w, y + d, z), (x + w, y + d, z + h), (x + w, y, z + h)],
            [(x, y, z + h), (x + w, y, z + h), (x + w, y + d, z + h), (x, y + d, z + h)],
        ):
            polygon(axes, [at(each) for each in corners], color)

    slab((34, -2, 0), (22, 24, 17), "#f6d18f")
    slab((31, -5, 17), (28, 30, 11), "white")
    slab((31, -5, 28), (28, 30, 4), "#bfe0f4")
    frame((-8, 0, 0), "base of the arm, in which\nthe pendant shows poses", (1, 6))
    frame((45, 10, 32), "contact frame:\nz out of the sensor", (76, 64), length=17)
    tool = "TCP: the contact frame turned by 180 deg\nabout x (tool_rotation_deg), z downwards"
    frame((45, 10, 76), tool, (14, 101), turned=True)
    gauge = "gauge: axes as of the contact frame,\nso a press is a negative Fz"
    frame((40, -2, 2), gauge, (46, 4), length=9)


def _above(axes: Axes, bench: Bench) -> None:
    targets = list(bench.trajectory.targets())
    deepest = max(target.depth for target in targets)
    axes.set_title(f"{bench.sensor} seen along -z, as in its picture")
    low, high = (
        (1e3 * bench.limits.box_x[side], 1e3 * bench.limits.box_y[side]) for side in (0, 1)
    )
    size = high[0] - low[0], high[1] - low[1]
    rectangle(axes, low, size, "none", GREY, "--")
    axes.text(low[0] + 0.2, low[1] + 0.2, "limits.box_x_mm, box_y_mm", fontsize=7.5, color=GREY)
    for target in targets:
        x, y = 1e3 * target.origin[0], 1e3 * target.origin[1]
        if target.point == 1 and target.depth == deepest:
            sheared = 1e3 * target.sheared[0], 1e3 * target.sheared[1]
            arrow(axes, (x, y), sheared, PURPLE)
        if target.direction <= 0 and target.depth == deepest:
            axes.plot(x, y, "o", color=LINE)
            axes.text(x + 0.35, y - 0.75, str(target.point), fontsize=8, weight="bold")
    directions = len({target.direction for target in targets})
    axes.text(
        0, 1.75, f"{directions} directions, 0 along +x", fontsize=7.5, color=PURPLE, ha="center"
    )
    for (color, letter), end in zip(AXES, ((1.8, 0.0), (0.0, 1.8)), strict=False):
        start = low[0] + 0.9, low[1] + 1.5
        arrow(axes, start, (start[0] + end[0], start[1] + end[1]), color)
        place = start[0] + 1.2 * end[0], start[1] + 1.2 * end[1]
        axes.text(*place, letter, color=color, ha="center", va="center", weight="bold")
    axes.set_aspect("equal")
    axes.set_xlim(low[0] - 1, high[0] + 1)
    axes.set_ylim(low[1] - 1, high[1] + 1)
    axes.set_xlabel("x of the contact frame [mm]")
    axes.set_ylabel("y of the contact frame [mm]")
    axes.grid(visible=False)


# Contact sheets.

# Samples along each side of a pixel of an indenter, width of its view and height shown [m].
SAMPLES, VIEW, REACH = 2, 17e-3, 5e-3
# Colours of the tip plane and of points `REACH` above it, and the direction to the lamp.
NEAR, FAR = np.array([236.0, 196.0, 128.0]), np.array([44.0, 74.0, 112.0])
LIGHT = np.array([-0.5, 0.6, -0.62]) / np.linalg.norm([-0.5, 0.6, -0.62])
# Side of the gel in a tile, unless the pattern is wider [m], and the GelSight's scale.
GEL, GELSIGHT_MM_PER_PX = 20e-3, 0.0249
MARKER, FRAME = np.array([40.0, 44.0, 54.0]), (196, 78, 62)
# Tiles in a row, gap, and height of the text under a tile [px].
COLUMNS, GAP, CAPTION = 6, 16, 46


def sheet(
    tiles: Sequence[tuple[str, str, NDArray[np.uint8]]],
    size: tuple[int, int],
    across: int = COLUMNS,
) -> Image.Image:
    """Return a page of tiles, each with its title and a line of text below."""
    width, height = size[0] + GAP, size[1] + CAPTION + GAP
    down = -(-len(tiles) // across)
    page = Image.new("RGB", (min(across, len(tiles)) * width + GAP, down * height + GAP), PAPER)
    pen = ImageDraw.Draw(page)
    for index, (title, text, pixels) in enumerate(tiles):
        left, top = GAP + index % across * width, GAP + index // across * height
        tile = Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS)
        page.paste(tile, (left, top))
        pen.text((left, top + size[1] + 18), title, INK, font(15), anchor="ls")
        pen.text((left, top + size[1] + 37), text, SOFT, font(12), anchor="ls")
    return page


def indenters(path: Path) -> None:
    """Draw the tips from below, x to the right and y up: bright at the tip, darker above it."""
    tiles = [
        (each.name, f"{_edges(each)}; tile {VIEW * 1e3:g} mm", shaded(each, 200))
        for each in map(named, NAMES)
    ]
    sheet(tiles, (200, 200)).save(path)


def _edges(indenter: Indenter) -> str:
    radius = indenter.edge_radius * 1e3
    return f"edges {radius:g} mm" if radius else "no edge"


def shaded(indenter: Indenter, tile: int) -> NDArray[np.uint8]:
    """Return an image of the tip (tile, tile, 3)."""
    count = tile * SAMPLES
    along = ((np.arange(count) + 0.5) / count - 0.5) * VIEW
    x, y = np.meshgrid(along, -along)
    height = indenter.heights(x, y, reach=REACH)
    hit = np.isfinite(height)
    points = np.stack([x[hit], y[hit], height[hit]], axis=1)
    _, normal = indenter.distance(points)
    bright = 0.4 + 0.8 * np.maximum(normal @ LIGHT, 0)
    fraction = (height[hit] / REACH)[:, None]
    image = np.empty((count, count, 3))
    image[:] = (236.0, 237.0, 238.0)
    image[hit] = np.clip((NEAR * (1 - fraction) + FAR * fraction) * bright[:, None], 0, 255)
    blocks = image.reshape(tile, SAMPLES, tile, SAMPLES, 3)
    pixels: NDArray[np.uint8] = np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)
    return pixels


def patterns(path: Path) -> None:
    """Draw the whole gel with its markers, x to the right and y up; the camera's view in red."""
    tiles = []
    for name in PATTERNS:
        pattern = pattern_of(name)
        gel = _gel(pattern)
        tile = Image.fromarray(_drawn(pattern, gel, 200))
        view = _view(name)
        if view is not None:
            _frame(ImageDraw.Draw(tile), 200, view, gel)
        text = f"{len(pattern)} {pattern.shape}s of {pattern.size * 1e3:g} mm"
        tiles.append((name, text, np.asarray(tile)))
    sheet(tiles, (200, 200)).save(path)


def _gel(pattern: Pattern) -> float:
    reach = float(np.abs(pattern.centres).max()) + pattern.reach
    return max(GEL, 2e-3 * math.ceil(reach * 1e3))


def _drawn(pattern: Pattern, gel: float, tile: int) -> NDArray[np.uint8]:
    pixel = gel / tile
    along = (np.arange(tile, dtype=np.float64) + 0.5 - tile / 2) * pixel
    fraction = np.clip(0.5 - pattern.distance(along, along, 2 * pixel) / pixel, 0, 1)[::-1, :, None]
    colours = np.array(PANEL, float) * (1 - fraction) + MARKER * fraction
    drawn: NDArray[np.uint8] = np.round(colours).astype(np.uint8)
    return drawn


def _view(name: str) -> Camera | None:
    """Return the camera that the pattern is known for."""
    if name in SIMULATED:
        return Camera.paper()
    return Camera.of_scale(GELSIGHT_MM_PER_PX) if name in HOMOGENEOUS else None


def _frame(pen: ImageDraw.ImageDraw, tile: int, view: Camera, gel: float) -> None:
    """Draw the edges of the image where they lie on the gel."""
    pixel = view.mm_per_px * 1e-3 * tile / gel
    for length, horizontal in ((HEIGHT, True), (WIDTH, False)):
        offset = length * pixel / 2
        if offset >= tile / 2:
            continue
        other = min((WIDTH if horizontal else HEIGHT) * pixel / 2, tile / 2 - 1)
        for sign in (-1, 1):
            at = tile / 2 + sign * offset
            low, high = tile / 2 - other, tile / 2 + other
            ends = (low, at, high, at) if horizontal else (at, low, at, high)
            pen.line(ends, FRAME, 1)


# Sensors: colours of markers, of what is between them, and of markers before the press.

WHITE, GROUND, BEFORE = (240, 240, 236), (22, 26, 34), (240, 140, 40)


def outlined(mask: NDArray[np.bool_], undeformed: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return markers (480, 640, 3) in white, with outlines of the undeformed ones in orange."""
    pixels = np.where(mask[..., None], WHITE, GROUND).astype(np.uint8)
    pixels[undeformed & ~binary_erosion(undeformed, iterations=2)] = BEFORE
    return pixels


def sensors(path: Path, names: Sequence[str] = (), tier: str = "fem") -> None:
    """Draw the prism pressed to each sensor's full depth, at most four patterns of each."""
    ready_device("cpu")
    tiles = []
    for name in names or (*HETEROGENEOUS, *GRIDS, *MATERIAL, "gel"):
        each = sensor(name)
        depth = each.depth_max if each.force_depth is None else each.force_depth.depth_max
        fem = Fem(spacing=min(each.body.thickness / 6, 1.2e-3), grading=FOR_EDGES)
        scene = each.placed(named("prism"), press([depth / 2, depth], speed=each.speed), seed=0)
        result = simulate(scene, fem if tier == "fem" else Layer())
        reader = readout(each, seed=0)
        masks = reader.masks(SurfaceField.of(result))[-1]
        undeformed = reader.masks(SurfaceField.undeformed(each.body))[0]
        text = f"{each.body.modulus / 1e3:g} kPa, {1e3 * depth:g} mm, {-result.force[-1, 2]:.2f} N"
        for index in np.unique(np.linspace(0, len(masks) - 1, 4).round().astype(int)).tolist():
            title = f"{name}: {reader.patterns[index]}"
            tiles.append((title, text, outlined(masks[index], undeformed[index])))
        print(f"drawn: {name}", file=sys.stderr)
    # A palette makes the file three times smaller without a visible difference.
    page = sheet(tiles, (400, 300), 4).quantize(256, dither=Image.Dither.NONE)
    page.save(path, "PNG", optimize=True)


# Tips in mm: half the width of the base, the height that is drawn, the spacing of samples.

HALF, TALL, STEP = 8.5, 6.0, 0.05
LEVELS = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, TALL)


def tip(indenter: Indenter, path: Path) -> None:
    """Write the drawing of an indenter.

    Args:
        indenter: The indenter, tip down.
        path: PNG to write.
    """
    along = np.arange(-HALF, HALF + STEP / 2, STEP)
    x, y = np.meshgrid(along * 1e-3, along * 1e-3)
    height = indenter.heights(x, y, reach=TALL * 1e-3) * 1e3
    middle = len(along) // 2
    with chart(path, 7.0, 3.4) as figure:
        plan, section = figure.subplots(1, 2, width_ratios=(1, 1.15))
        shown = np.where(np.isfinite(height), np.maximum(height, 0.0), np.nan)
        plan.contourf(along, along, shown, levels=LEVELS, cmap="viridis_r")
        plan.contour(along, along, np.isfinite(height) * 1.0, levels=[0.5], colors=LINE)
        plan.set_aspect("equal")
        plan.set_title(f"{indenter.name}, tip from above, through the body")
        plan.set_xlabel("x [mm]")
        plan.set_ylabel("y [mm]")
        for values, name, color, style in (
            (height[middle], "y = 0", BLUE, "-"),
            (height[:, middle], "x = 0", RED, "--"),
        ):
            inside = np.where(np.isfinite(values), values, np.nan)
            section.plot(along, inside, style, color=color, label=f"section at {name}")
        section.set_aspect("equal")
        section.set_ylim(-1.0, TALL)
        section.set_title("height above the tip, pressed downwards")
        section.set_xlabel("x or y [mm]")
        section.set_ylabel("z [mm]")
        section.legend(loc="upper center", bbox_to_anchor=(0.5, -0.28), ncols=2)
        for axes in (plan, section):
            axes.set_xlim(-HALF, HALF)
            axes.set_xticks(range(-8, 9, 2))
            axes.grid(visible=True)
        plan.set_yticks(range(-8, 9, 2))
    # A quarter of the size, with no difference that is visible.
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(64)
    small.save(path, optimize=True)


def bench(folder: Path, name: str = "gelsight") -> None:
    """Draw wiring, mounting and frames of a packaged bench."""
    content = BenchFile.read(BENCHES / f"{name}.yaml").bench
    for title, draw in (("wiring", wiring), ("mounting", mounting), ("frames", frames)):
        draw(content, folder / f"bench-{title}.png")


def tips(folder: Path) -> None:
    """Draw all indenters with sharp edges."""
    for name in NAMES:
        tip(named(name, edge_radius=0.0), folder / f"{name}.png")


PICTURES: dict[str, tuple[Callable[[Path], Any], Path]] = {
    "bench": (bench, IMAGES),
    "indenters": (indenters, IMAGES / "indenters.png"),
    "patterns": (patterns, IMAGES / "patterns.png"),
    "sensors": (sensors, IMAGES / "sensors.png"),
    "tips": (tips, TIPS),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Draw the pictures that are named, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*PICTURES, []], metavar="NAME")
    for name in parser.parse_args(argv).names or [name for name in PICTURES if name != "tips"]:
        draw, path = PICTURES[name]
        draw(path)
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
