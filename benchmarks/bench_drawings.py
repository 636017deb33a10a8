"""Drawings of a bench for its guide: wiring, mounting, frames.

    python -m benchmarks bench-drawings

Lengths, points and directions are those of a packaged bench file; addresses are those of the guide.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from recorder.charts import BAND, BLUE, GREEN, INK, ORANGE, PURPLE, RED, SKY, SOFT, chart
from rig.bench.bench import Bench, BenchFile
from rig.core.packaged import BENCHES

if TYPE_CHECKING:
    from recorder.charts import Axes

Point = tuple[float, float]
Place = tuple[float, float, float]

AXES = ((RED, "x"), (GREEN, "y"), (BLUE, "z"))
# Directions of x, y and z of the base on the page, seen from the front and above.
LOOK = np.array([[0.92, 0.42, 0.0], [-0.16, 0.36, 1.0]])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "--out", type=Path, default=Path("docs/images"), help="folder (%(default)s)"
    )
    parser.add_argument("--sensor", default="gelsight", help="packaged bench (%(default)s)")


def run(options: argparse.Namespace) -> int:
    """Write the drawings and print their paths."""
    bench = BenchFile.read(BENCHES / f"{options.sensor}.yaml").bench
    for name, draw in (
        ("bench-wiring", wiring),
        ("bench-mounting", mounting),
        ("bench-frames", frames),
    ):
        path = options.out / f"{name}.png"
        draw(bench, path)
        print(path)
    return 0


# Parts of drawings.


def rectangle(
    axes: Axes, low: Point, size: Point, fill: str, edge: str = INK, style: str = "-"
) -> None:
    """Draw a rectangle from its lower left corner."""
    (x, y), (width, height) = low, size
    corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
    polygon(axes, corners, fill, edge, style)


def polygon(
    axes: Axes, corners: Sequence[Point], fill: str, edge: str = INK, style: str = "-"
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
    axes.text(x + 1.5, y + height - 1.6, title, weight="bold", va="top", color=INK)
    axes.text(x + 1.5, y + height - 6.0, text, va="top", fontsize=7.5, color=INK, linespacing=1.35)


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
    arrow(axes, (x, low), (x, high), SOFT, "<|-|>")
    axes.text(x + 1.5, (low + high) / 2, text, fontsize=7.5, va="center", color=INK)


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
                SOFT,
            ),
            (58, 39, (46, 19), "Computer", COMPUTER, INK),
            (122, 42, (36, 15), "F/T sensor", "carries the tactile sensor", SOFT),
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
        cable(axes, [(21, 66), (21, 57)], SOFT, "arm's cable", (23, 61.5))
        cable(axes, [(140, 66), (140, 57)], SOFT, "sensor's cable", (142, 61.5))
        for x, top in ((20, 66), (61, 72), (100, 94)):
            cable(axes, [(x, 22), (x, 30), (top, 30), (top, 39)], ORANGE)
        axes.text(75, 34.5, "USB", fontsize=7.5, color=ORANGE, va="center")


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
        axes.plot([middle - 26, middle + 58], [surface, surface], color=SOFT, lw=0.9, ls="--")
        axes.plot([middle - 8, middle + 58], [tip, tip], color=SOFT, lw=0.9, ls="--")
        axes.plot([middle + 13, middle + 58], [flange, flange], color=SOFT, lw=0.9, ls="--")
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
        axes.text(*text, name, fontsize=7.5, va="center", color=INK, linespacing=1.3)

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
    rectangle(axes, low, size, "none", SOFT, "--")
    axes.text(low[0] + 0.2, low[1] + 0.2, "limits.box_x_mm, box_y_mm", fontsize=7.5, color=SOFT)
    for target in targets:
        x, y = 1e3 * target.origin[0], 1e3 * target.origin[1]
        if target.point == 1 and target.depth == deepest:
            sheared = 1e3 * target.sheared[0], 1e3 * target.sheared[1]
            arrow(axes, (x, y), sheared, PURPLE)
        if target.direction <= 0 and target.depth == deepest:
            axes.plot(x, y, "o", color=INK)
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
