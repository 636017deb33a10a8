"""Draw the pictures of these pages: `python docs/pictures.py [NAME...]`, from the repository.

`bench` is wiring, mounting, frames and plan of a packaged bench; `indenters` and `patterns` are
contact sheets; `sensors` is a prism pressed into every sensor (minutes); `tips` is one drawing of
each indenter in mm, which is packaged with the benches; `grasp` is the film of a grip (a minute).
Without names all but these two are drawn.
"""

from __future__ import annotations

import argparse
import io
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from recorder.charts import BAND, BLUE, FORCES, ORANGE, RED, SKY, chart
from recorder.charts import INK as LINE
from recorder.charts import SOFT as GREY
from recorder.plot import PANEL, Tile, sheet
from rig.acquire.preview import draw as draw_plan
from rig.bench.bench import Bench, BenchFile
from rig.core.packaged import BENCHES
from sim.device import ready_device
from sim.fem import FOR_EDGES, Fem
from sim.indenters import NAMES, Indenter, named
from sim.markers import HEIGHT, WIDTH, Camera
from sim.markers import named as pattern_of
from sim.markers.pattern import HOMOGENEOUS, SIMULATED
from sim.markers.pattern import NAMES as PATTERNS
from sim.scene import press
from sim.sensors import HETEROGENEOUS, MATERIAL, SurfaceField, readout, sensor
from sim.sensors import HOMOGENEOUS as GRIDS
from sim.tiers import simulate

if TYPE_CHECKING:
    from recorder.charts import Axes

IMAGES = Path(__file__).with_name("images")
TIPS = Path(__file__).parents[1] / "rig/bench/indenters"
Point = tuple[float, float]
Place = tuple[float, float, float]

AXES = tuple(zip(FORCES, "xyz", strict=True))
# Directions of x, y and z of the base on the page, seen from the front and above.
LOOK = np.array([[0.92, 0.42, 0.0], [-0.16, 0.36, 1.0]])


# Parts of drawings.


def rectangle(axes: Axes, low: Point, size: Point, fill: str, edge: str = LINE) -> None:
    """Draw a rectangle from its lower left corner."""
    (x, y), (width, height) = low, size
    corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
    polygon(axes, corners, fill, edge)


def polygon(axes: Axes, corners: Sequence[Point], fill: str, edge: str = LINE) -> None:
    """Draw a filled polygon."""
    axes.fill(*zip(*corners, strict=True), fc=fill, ec=edge, lw=1.2)


def note(axes: Axes, x: float, y: float, text: str, **style: Any) -> None:
    """Write small text."""
    axes.text(x, y, text, **({"fontsize": 7.5, "va": "center", "color": LINE} | style))


@contextmanager
def drawing(path: Path, size: Point, extent: Point) -> Iterator[Axes]:
    """Yield a sheet of paper of a size [inch], without scales; places on it go up to an extent."""
    with chart(path, *size) as figure:
        axes = figure.subplots()
        axes.set(xlim=(0, extent[0]), ylim=(0, extent[1]), aspect="equal")
        axes.axis("off")
        yield axes


def arrow(axes: Axes, start: Point, end: Point, color: str, style: str = "-|>") -> None:
    """Draw an arrow."""
    look = {"arrowstyle": style, "color": color, "lw": 1.5}
    axes.annotate("", xy=end, xytext=start, arrowprops=look)


def dimension(axes: Axes, x: float, low: float, high: float, text: str) -> None:
    """Draw a height between two places, with its text on the right."""
    arrow(axes, (x, low), (x, high), GREY, "<|-|>")
    note(axes, x + 1.5, (low + high) / 2, text)


# Wiring: addresses and names as in the guide.

ARM = "192.168.1.10  (arm.host)\nremote control on the pendant\nTCP 29999 and 30001 to 30004"
HOLDER = "holds the indenter;\nits red button within reach"
GAUGE = "192.168.1.1  (force.host)\npage TCP 80, samples UDP 49152\nor: NI card"
COMPUTER = "192.168.1.100\ntactile doctor, then setup\ngroups dialout and video"
GRIPPER = "RS-485 to USB, 24 V\n/dev/serial/by-id/...\n(gripper.port)"
HID = "udev rule as\ntactile doctor says\n(pedal.device, jog.device)"
CAMERA = "USB port of its own\n/dev/v4l/by-id/...\n(camera.address)"
TAXELS = "uSkin only\nws://192.168.1.20:5000\n(taxels.address)"


def wiring(_: Bench, path: Path) -> None:
    """Draw the devices, their cables, addresses and ports."""
    with drawing(path, (8.0, 4.7), (160, 94)) as axes:
        for x, y, size, title, text, color in (
            (2, 66, (46, 22), "Arm's controller", ARM, BLUE),
            (66, 70, (28, 13), "Switch", "wired, nothing else", BLUE),
            (112, 66, (46, 22), "Net F/T box", GAUGE, BLUE),
            (2, 42, (38, 15), "Robot arm", HOLDER, GREY),
            (58, 39, (46, 19), "Computer", COMPUTER, LINE),
            (122, 42, (36, 15), "F/T sensor", "carries the tactile sensor", GREY),
            (2, 4, (36, 18), "Gripper", GRIPPER, ORANGE),
            (42, 4, (38, 18), "Pedal, SpaceMouse", HID, ORANGE),
            (84, 4, (34, 18), "Camera", CAMERA, ORANGE),
            (122, 4, (36, 18), "Taxel server", TAXELS, BLUE),
        ):
            left, top = x + 1.5, y + size[1]
            rectangle(axes, (x, y), size, "white", color)
            axes.text(left, top - 1.6, title, weight="bold", va="top", color=LINE)
            note(axes, left, top - 6.0, text, va="top", linespacing=1.35)
        for way, color in (
            ([(48, 76), (66, 76)], BLUE),
            ([(94, 76), (112, 76)], BLUE),
            ([(76, 70), (76, 58)], BLUE),
            ([(90, 70), (90, 62), (113, 62), (113, 30), (140, 30), (140, 22)], BLUE),
            ([(21, 66), (21, 57)], GREY),
            ([(140, 66), (140, 57)], GREY),
            *(
                ([(x, 22), (x, 30), (top, 30), (top, 39)], ORANGE)
                for x, top in ((20, 62), (70, 70), (100, 94))
            ),
        ):
            axes.plot(*zip(*way, strict=True), color=color, lw=1.8, zorder=0)
        note(axes, 78, 64, "Ethernet", color=BLUE)
        note(axes, 23, 61.5, "arm's cable", color=GREY)
        note(axes, 142, 61.5, "sensor's cable", color=GREY)
        note(axes, 72, 34.5, "USB", color=ORANGE)


# Mounting

CONTACT_FRAME = (
    "contact_frame: middle of the untouched surface,\nfound by the steps contact and home"
)
CARRIED = (
    "The F/T sensor carries the whole sensor:\nnothing else may touch the sensor, and its\n"
    "cable hangs in a loop that bears no force."
)


def mounting(bench: Bench, path: Path) -> None:
    """Draw a section through tool and sensor, with the lengths that the bench file has."""
    length, retract = 1e3 * bench.arm.tcp[2], 1e3 * bench.arm.retract
    # Middle, and heights of surface, tip and flange, on the page.
    middle, surface, tip, flange = 38.0, 40.0, 54.0, 92.0
    with drawing(path, (7.0, 5.2), (140, 104)) as axes:

        def part(x: float, y: float, size: Point, color: str, text: str = "") -> None:
            width, height = size
            rectangle(axes, (x, y), size, color)
            axes.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=8)

        part(middle - 13, flange, (26, 9), BAND, "flange")
        part(middle - 11, flange - 14, (22, 14), "white", "gripper\nor mount")
        part(middle - 6, tip + 9, (12, flange - 14 - tip - 9), BAND)
        tapered = [(-6, 9), (6, 9), (3, 0), (-3, 0)]
        polygon(axes, [(middle + x, tip + y) for x, y in tapered], BAND)
        axes.text(middle + 8, tip + 10, "indenter", fontsize=8, va="center")
        part(middle - 20, surface - 5, (40, 5), SKY, "elastomer")
        part(middle - 20, surface - 17, (40, 12), "white", "sensor, camera inside")
        part(middle - 15, surface - 27, (30, 10), ORANGE, "F/T sensor")
        part(middle - 34, surface - 34, (68, 7), BAND, "base plate, screwed to the arm's own table")
        for left, height in ((-26, surface), (-8, tip), (13, flange)):
            axes.plot([middle + left, middle + 58], [height] * 2, color=GREY, lw=0.9, ls="--")
        tcp = f"arm.tcp: {length:g} mm here,\nflange to tip, by a caliper;\nthe same on the pendant"
        dimension(axes, middle + 34, tip, flange, tcp)
        above = f"arm.retract_mm: {retract:g} mm\nabove the surface between points"
        dimension(axes, middle + 34, surface, tip, above)
        limit = f"limits.depth_max_mm: {1e3 * bench.limits.depth_max:g} mm below it at most"
        for below, text in ((3.5, CONTACT_FRAME), (14, limit), (21, CARRIED)):
            note(axes, middle + 36, surface - below, text, va="top")
        axes.set_title("Section through tool and sensor (not to scale)")


# Frames


def frames(_: Bench, path: Path) -> None:
    """Draw the frames in space."""
    with drawing(path, (5.2, 5.0), (104, 106)) as axes:

        def at(place: Place) -> Point:
            x, y = LOOK @ np.array(place)
            return 20 + float(x), 18 + float(y)

        def frame(
            place: Place, name: str, text: Point, length: float = 15, *, turned: bool = False
        ) -> None:
            # Turned by 180 degrees about x: y and z are inverted.
            signs = (1, -1, -1) if turned else (1, 1, 1)
            for axis, (color, letter) in enumerate(AXES):
                way = LOOK[:, axis] * signs[axis] * length
                start = np.array(at(place))
                arrow(axes, tuple(start), tuple(start + way), color)
                x, y = start + way + way / np.hypot(*way) * 2.6
                axes.text(x, y, letter, color=color, ha="center", va="center", weight="bold")
            note(axes, *text, name, linespacing=1.3)

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


def plan(bench: Bench, path: Path) -> None:
    """Draw the targets of the plan, as `tactile doctor` does."""
    draw_plan(bench, bench.dry_run(bench.trajectory)).save(path, optimize=True)


# Contact sheets.

# Width of the view of an indenter, and height shown [m].
VIEW, REACH = 17e-3, 5e-3
# Colours of the tip plane and of points `REACH` above it, and the direction to the lamp.
NEAR, FAR = np.array([236.0, 196.0, 128.0]), np.array([44.0, 74.0, 112.0])
LIGHT = np.array([-0.5, 0.6, -0.62]) / np.linalg.norm([-0.5, 0.6, -0.62])
# Side of the gel in a tile, unless the pattern is wider [m], and the GelSight's scale.
GEL, GELSIGHT_MM_PER_PX = 20e-3, 0.0249
MARKER, FRAME = np.array([40.0, 44.0, 54.0]), (196, 78, 62)
COLUMNS = 6


def tile_sheet(tiles: Sequence[Tile], size: tuple[int, int], across: int = COLUMNS) -> Image.Image:
    """Return a page of tiles."""
    rows = [("", "", tiles[first : first + across]) for first in range(0, len(tiles), across)]
    return sheet(rows, min(across, len(tiles)), size)


def indenters(path: Path) -> None:
    """Draw the tips from below, x to the right and y up: bright at the tip, darker above it."""
    tiles = []
    for each in map(named, NAMES):
        edges = f"edges {each.edge_radius * 1e3:g} mm" if each.edge_radius else "no edge"
        text = f"{edges}; tile {VIEW * 1e3:g} mm"
        tiles.append(Tile(shaded(each, 400), (each.name, text)))
    tile_sheet(tiles, (200, 200)).save(path)


def shaded(indenter: Indenter, tile: int) -> NDArray[np.uint8]:
    """Return an image of the tip (tile, tile, 3)."""
    along = ((np.arange(tile) + 0.5) / tile - 0.5) * VIEW
    x, y = np.meshgrid(along, -along)
    height = indenter.heights(x, y, reach=REACH)
    hit = np.isfinite(height)
    _, normal = indenter.distance(np.stack([x[hit], y[hit], height[hit]], axis=1))
    bright = 0.4 + 0.8 * np.maximum(normal @ LIGHT, 0)
    fraction = (height[hit] / REACH)[:, None]
    image = np.full((tile, tile, 3), (236, 237, 238), np.uint8)
    image[hit] = np.clip((NEAR * (1 - fraction) + FAR * fraction) * bright[:, None], 0, 255)
    return image


def patterns(path: Path) -> None:
    """Draw the whole gel with its markers, x to the right and y up; the camera's view in red."""
    tiles = []
    for name in PATTERNS:
        pattern = pattern_of(name)
        reach = float(np.abs(pattern.centres).max()) + pattern.reach
        gel = max(GEL, 2e-3 * math.ceil(reach * 1e3))
        pixel = gel / 200
        along = (np.arange(200) - 99.5) * pixel
        distance = pattern.distance(along, along, 2 * pixel)[::-1, :, None]
        fraction = np.clip(0.5 - distance / pixel, 0, 1)
        drawn = np.array(PANEL) * (1 - fraction) + MARKER * fraction
        tile = Image.fromarray(np.round(drawn).astype(np.uint8))
        # The camera that the pattern is known for.
        scale = Camera.paper().mm_per_px if name in SIMULATED else GELSIGHT_MM_PER_PX
        if name in SIMULATED or name in HOMOGENEOUS:
            x, y = (side * scale * 1e-3 / gel * 100 for side in (WIDTH, HEIGHT))
            ends = (100 - x, 100 - y, 100 + x, 100 + y)
            ImageDraw.Draw(tile).rectangle(ends, outline=FRAME)
        text = f"{len(pattern)} {pattern.shape}s of {pattern.size * 1e3:g} mm"
        tiles.append(Tile(np.asarray(tile), (name, text)))
    tile_sheet(tiles, (200, 200)).save(path)


# Sensors: colours of markers, of what is between them, and of markers before the press.

WHITE, GROUND, BEFORE = (240, 240, 236), (22, 26, 34), (240, 140, 40)


def outlined(mask: NDArray[np.bool_], undeformed: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return markers (480, 640, 3) in white, with outlines of the undeformed ones in orange."""
    pixels = np.where(mask[..., None], WHITE, GROUND).astype(np.uint8)
    pixels[undeformed & ~binary_erosion(undeformed, iterations=2)] = BEFORE
    return pixels


def sensors(path: Path) -> None:
    """Draw the prism pressed to each sensor's full depth, at most four patterns of each."""
    ready_device("cpu")
    tiles = []
    for name in (*HETEROGENEOUS, *GRIDS, *MATERIAL, "gel"):
        each = sensor(name)
        depth = each.depth_max if each.force_depth is None else each.force_depth.depth_max
        fem = Fem(spacing=min(each.body.thickness / 6, 1.2e-3), grading=FOR_EDGES)
        scene = each.placed(named("prism"), press([depth / 2, depth], speed=each.speed), seed=0)
        result = simulate(scene, fem)
        reader = readout(each, seed=0)
        masks = reader.masks(SurfaceField.of(result))[-1]
        undeformed = reader.masks(SurfaceField.undeformed(each.body))[0]
        text = f"{each.body.modulus / 1e3:g} kPa, {1e3 * depth:g} mm, {-result.force[-1, 2]:.2f} N"
        for index in np.unique(np.linspace(0, len(masks) - 1, 4).round().astype(int)).tolist():
            title = f"{name}: {reader.patterns[index]}"
            tiles.append(Tile(outlined(masks[index], undeformed[index]), (title, text)))
        print(f"drawn: {name}", file=sys.stderr)
    # A palette makes the file three times smaller without a visible difference.
    page = tile_sheet(tiles, (400, 300), 4).quantize(256, dither=Image.Dither.NONE)
    page.save(path, "PNG", optimize=True)


# Tips in mm: half the width of the base, the height that is drawn, the spacing of samples.

HALF, TALL, STEP = 8.5, 6.0, 0.05
LEVELS = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, TALL)


def tip(indenter: Indenter, path: Path) -> None:
    """Write the drawing of an indenter, tip down: seen from above, and in two sections."""
    along = np.arange(-HALF, HALF + STEP / 2, STEP)
    x, y = np.meshgrid(along * 1e-3, along * 1e-3)
    height = indenter.heights(x, y, reach=TALL * 1e-3) * 1e3
    middle = len(along) // 2
    inside = np.where(np.isfinite(height), height, np.nan)
    with chart(path, 7.0, 3.4) as figure:
        above, section = figure.subplots(1, 2, width_ratios=(1, 1.15))
        above.contourf(along, along, np.maximum(inside, 0.0), levels=LEVELS, cmap="viridis_r")
        above.contour(along, along, np.isfinite(height) * 1.0, levels=[0.5], colors=LINE)
        title = f"{indenter.name}, tip from above, through the body"
        above.set(title=title, xlabel="x [mm]", ylabel="y [mm]", yticks=range(-8, 9, 2))
        section.plot(along, inside[middle], "-", color=BLUE, label="section at y = 0")
        section.plot(along, inside[:, middle], "--", color=RED, label="section at x = 0")
        title = "height above the tip, pressed downwards"
        section.set(title=title, xlabel="x or y [mm]", ylabel="z [mm]", ylim=(-1.0, TALL))
        section.legend(loc="upper center", bbox_to_anchor=(0.5, -0.28), ncols=2)
        for axes in (above, section):
            axes.set(aspect="equal", xlim=(-HALF, HALF), xticks=range(-8, 9, 2))
    # A quarter of the size, with no difference that is visible.
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(64)
    small.save(path, optimize=True)


def bench(folder: Path, name: str = "gelsight") -> None:
    """Draw wiring, mounting, frames and plan of a packaged bench."""
    content = BenchFile.read(BENCHES / f"{name}.yaml").bench
    for draw in (wiring, mounting, frames, plan):
        draw(content, folder / f"bench-{draw.__name__}.png")


def tips(folder: Path) -> None:
    """Draw all indenters with sharp edges."""
    for name in NAMES:
        tip(named(name, edge_radius=0.0), folder / f"{name}.png")


# A grip by force: pictures of both fingers above forces, opening and slips until then.

# Mass [kg] and friction of the object, size of a finger's picture and of the curves [px], and time
# of a frame of the film [ms].
GRIPPED, VIEW_PX, CURVES_PX, FRAME_MS = (0.12, 0.4), (288, 216), (584, 260), 80
# Counts of the gripper that the film shows.
CLOSING = 14


def grasp(path: Path) -> None:
    """Film one simulated grip, from the open fingers to the lifted object."""
    from rig.acquire.grip_force import ForceGrip, GripSettings
    from rig.bench.pair import GraspObject
    from rig.core.finger import FingerForce
    from rig.mock.world.pair import PairState
    from tactile.grasp_demo import COUNT, SKIN, Lifter, Load, lift
    from tactile.grasp_model import cached_model

    mass, friction = GRIPPED
    gripped = GraspObject("film", ("cylinder", "hexagon"), 0.03, mass, friction / SKIN)
    least = mass * 9.81 / 2 / friction
    hand = Lifter(str(cached_model(lambda done, total: None, print)))
    views: list[list[NDArray[np.uint8]]] = []
    rows: list[tuple[float, ...]] = []

    def seen(state: PairState, pair: tuple[FingerForce, FingerForce], grip: ForceGrip) -> None:
        views.append([np.asarray(picture) for picture in hand.eyes.pictures])
        normals = [-one.force[2] for one in pair]
        load = 0.5 * sum(math.hypot(*one.force[:2]) for one in pair)
        slips = float(any(one.slipping for one in pair))
        rows.append((1e-9 * state.t_ns, *normals, load, grip.wanted, slips, grip.position))

    load = Load(gripped, least, math.inf, math.inf, 0.0)
    result = lift(hand.world, hand.clock, load, hand.eyes.begin(), GripSettings(), seen)
    if not result.lifted:
        raise RuntimeError(f"not lifted: {result.reason}")
    table = np.array(rows)
    table[:, 0] -= table[0, 0]
    table[:, 6] = 1e3 * COUNT * np.maximum(table[:, 6] - table[:, 6].max(initial=0) + CLOSING, 0)
    curves, ends = _curves(table, least)
    frames = [_frame(*each, curves, ends, k / (len(views) - 1)) for k, each in enumerate(views)]
    first = frames[-1].quantize(160, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    film = [one.quantize(palette=first, dither=Image.Dither.NONE) for one in frames]
    film[0].save(
        path, save_all=True, append_images=film[1:], duration=FRAME_MS, loop=0, optimize=True
    )


def _curves(table: NDArray[np.float64], least: float) -> tuple[Image.Image, tuple[int, int]]:
    """Return the drawn curves of a grip, and the columns of their first and last time."""
    png = io.BytesIO()
    with chart(png, CURVES_PX[0] / 100, CURVES_PX[1] / 100) as figure:
        figure.set_layout_engine("none")
        sides = {"left": 0.08, "right": 0.98, "top": 0.97, "bottom": 0.17, "hspace": 0.12}
        grid = figure.add_gridspec(2, 1, height_ratios=(3, 1), **sides)
        forces = figure.add_subplot(grid[0])
        width = figure.add_subplot(grid[1], sharex=forces)
        time, left, right, load, wanted, slips, opening = table.T
        for values, color, label in (
            (left, BLUE, "normal force, left"),
            (right, SKY, "right"),
            (load, RED, "load along a skin"),
            (wanted, GREY, "wanted"),
        ):
            forces.plot(time, values, color=color, label=label, lw=1.3)
        forces.axhline(least, color=LINE, ls=":", lw=1, label="least, unknown to the grip")
        forces.plot(time[slips > 0], left[slips > 0], "o", color=ORANGE, ms=4, label="slip")
        forces.legend(fontsize=6, loc="upper left")
        forces.set_ylabel("force [N]", fontsize=7)
        width.plot(time, opening, color=LINE, lw=1.3, drawstyle="steps-post")
        width.set_ylabel("closed [mm]", fontsize=7)
        width.set_xlabel("time [s]", fontsize=7)
        forces.set_xlim(time[0], time[-1])
        for axes in (forces, width):
            axes.tick_params(labelsize=6, labelbottom=axes is width)
        place = forces.get_position()
    image = Image.open(png).convert("RGB").resize(CURVES_PX)
    return image, (round(place.x0 * CURVES_PX[0]), round(place.x1 * CURVES_PX[0]))


def _frame(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    curves: Image.Image,
    ends: tuple[int, int],
    fraction: float,
) -> Image.Image:
    """Return a frame of the film: both pictures, and the curves up to a fraction of the time."""
    wide, tall = VIEW_PX
    frame = Image.new("RGB", (2 * wide + 8, tall + CURVES_PX[1]), "white")
    for side, picture in enumerate((left, right)):
        frame.paste(Image.fromarray(picture).resize(VIEW_PX), (side * (wide + 8), 0))
    frame.paste(curves, (0, tall))
    now = round(ends[0] + fraction * (ends[1] - ends[0]))
    ImageDraw.Draw(frame).line([(now, tall + 6), (now, tall + CURVES_PX[1] - 52)], fill=FRAME)
    return frame


PICTURES: dict[str, tuple[Callable[[Path], Any], Path]] = {
    "bench": (bench, IMAGES),
    "indenters": (indenters, IMAGES / "indenters.png"),
    "patterns": (patterns, IMAGES / "patterns.png"),
    "sensors": (sensors, IMAGES / "sensors.png"),
    "tips": (tips, TIPS),
    "grasp": (grasp, IMAGES / "grasp.gif"),
}


def main() -> None:
    """Draw the pictures that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[*PICTURES, []], metavar="NAME")
    for name in parser.parse_args().names or [
        name for name in PICTURES if name not in ("tips", "grasp")
    ]:
        draw, path = PICTURES[name]
        draw(path)
        print(path)


if __name__ == "__main__":
    main()
