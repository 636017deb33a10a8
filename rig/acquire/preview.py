"""Draws a plan before anything moves."""

import math
from collections.abc import Callable

from PIL import Image, ImageDraw, ImageFont

from recorder.progress import duration
from rig.bench.bench import Bench
from rig.bench.guards import force_text
from trajectories import DryRun, Target

_SIZE = (1180, 620)
_PAPER, _INK, _GRID, _WARN = (252, 251, 248), (40, 44, 52), (214, 214, 208), (190, 40, 30)
_DEPTHS = ((158, 202, 225), (107, 174, 214), (49, 130, 189), (8, 69, 148), (8, 30, 88))
_TOP = (40, 90, 560, 590)
_SIDE = (620, 90, 1140, 330)

ToPixel = Callable[[float, float], tuple[float, float]]
Colours = dict[float, tuple[int, int, int]]
Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


def summary(bench: Bench, walked: DryRun) -> list[str]:
    """Return counts, duration and limits as lines."""
    limits = bench.limits
    seconds = sum(bench.seconds(bench.trajectory))
    frames = walked.recorded * bench.rate_hz / walked.targets
    lines = [
        f"{walked.targets} targets, {walked.moves} recorded moves",
        f"x {1e3 * walked.x[0]:+.2f} to {1e3 * walked.x[1]:+.2f} mm"
        f"  (box {1e3 * limits.box_x[0]:+.1f} to {1e3 * limits.box_x[1]:+.1f})",
        f"y {1e3 * walked.y[0]:+.2f} to {1e3 * walked.y[1]:+.2f} mm"
        f"  (box {1e3 * limits.box_y[0]:+.1f} to {1e3 * limits.box_y[1]:+.1f})",
        f"depth {1e3 * walked.depth:.3f} mm  (limit {1e3 * limits.depth_max:.3f})",
        force_text(bench, walked.depth),
        f"speed {1e3 * bench.arm.speed:.1f} mm/s, about {duration(seconds)} "
        f"(limit {duration(limits.duration_max)})",
        f"about {frames:.0f} frames per target at {bench.rate_hz:.0f} Hz (paper: 20 to 60)",
    ]
    return lines + [f"BREAKS A LIMIT: {text}" for text in walked.broken]


def draw(bench: Bench, walked: DryRun) -> Image.Image:
    """Draw a bench's plan from above and from the side, with the summary of its dry run."""
    targets = list(bench.trajectory.targets())
    image = Image.new("RGB", _SIZE, _PAPER)
    canvas = ImageDraw.Draw(image)
    title = ImageFont.load_default(24)
    small = ImageFont.load_default(14)
    bench_kind = "mock bench" if bench.mock else "lab bench"
    canvas.text((40, 24), f"{bench.sensor}: {bench.trajectory.KIND}", _INK, font=title)
    canvas.text((40, 58), f"{bench.description}  ({bench_kind})", _INK, font=small)
    depths = sorted({target.depth for target in targets})
    colours = {depth: _colour(k, len(depths)) for k, depth in enumerate(depths)}
    _draw_top(canvas, bench, targets, colours, small)
    _draw_side(canvas, bench, targets, colours, small)
    for k, line in enumerate(summary(bench, walked)):
        colour = _WARN if line.startswith("BREAKS") else _INK
        canvas.text((620, 380 + 26 * k), line, colour, font=ImageFont.load_default(16))
    if walked.broken:
        canvas.rectangle((2, 2, _SIZE[0] - 3, _SIZE[1] - 3), outline=_WARN, width=4)
    return image


def _colour(index: int, count: int) -> tuple[int, int, int]:
    shade = round(index * (len(_DEPTHS) - 1) / max(count - 1, 1))
    return _DEPTHS[shade]


def _mapping(
    frame: tuple[int, int, int, int],
    x: tuple[float, float],
    y: tuple[float, float],
    *,
    square: bool,
) -> ToPixel:
    left, top, right, bottom = frame
    scale_x, scale_y = (right - left) / (x[1] - x[0]), (bottom - top) / (y[1] - y[0])
    if square:
        scale_x = scale_y = min(scale_x, scale_y)
    middle_x, middle_y = (x[0] + x[1]) / 2, (y[0] + y[1]) / 2

    def to_pixel(a: float, b: float) -> tuple[float, float]:
        return (
            (left + right) / 2 + scale_x * (a - middle_x),
            (top + bottom) / 2 - scale_y * (b - middle_y),
        )

    return to_pixel


def _draw_top(
    canvas: ImageDraw.ImageDraw, bench: Bench, targets: list[Target], colours: Colours, font: Font
) -> None:
    box_x, box_y = bench.limits.box_x, bench.limits.box_y
    margin = 0.08 * (box_x[1] - box_x[0])
    at = _mapping(
        _TOP,
        (box_x[0] - margin, box_x[1] + margin),
        (box_y[0] - margin, box_y[1] + margin),
        square=True,
    )
    corners = (at(box_x[0], box_y[1]), at(box_x[1], box_y[0]))
    canvas.rectangle(corners, outline=_GRID, width=2)
    canvas.text(
        (corners[0][0] + 6, corners[0][1] + 4),
        f"from above; box {1e3 * (box_x[1] - box_x[0]):.0f} x {1e3 * (box_y[1] - box_y[0]):.0f} mm",
        _INK,
        font=font,
    )
    # Deep presses first, so that the arrows of shallow ones stay visible on top.
    for target in sorted(targets, key=lambda target: -target.depth):
        start, end = at(*target.bottom[:2]), at(*target.sheared[:2])
        colour = colours[target.depth]
        if target.direction >= 0:
            canvas.line((start, end), fill=colour, width=2)
            _dot(canvas, end, 3, colour)
    for point in sorted({target.point for target in targets}):
        centre = at(*next(t for t in targets if t.point == point).origin[:2])
        _dot(canvas, centre, 9, _INK)
        canvas.text((centre[0] - 4, centre[1] - 8), str(point), _PAPER, font=font)


def _draw_side(
    canvas: ImageDraw.ImageDraw, bench: Bench, targets: list[Target], colours: Colours, font: Font
) -> None:
    deepest = max(target.depth for target in targets)
    reach = max(math.dist(target.bottom, target.sheared) for target in targets) or deepest
    top = max(target.origin[2] for target in targets)
    at = _mapping(_SIDE, (-0.5 * reach, 1.9 * reach), (-1.25 * deepest, top), square=False)
    surface = (at(-0.5 * reach, 0.0), at(1.9 * reach, 0.0))
    canvas.line(surface, fill=_INK, width=2)
    canvas.text((surface[0][0], surface[0][1] + 4), "surface", _INK, font=font)
    limit = (at(-0.5 * reach, -bench.limits.depth_max), at(1.9 * reach, -bench.limits.depth_max))
    canvas.line(limit, fill=_WARN, width=1)
    canvas.text((limit[0][0], limit[0][1] + 2), "depth limit", _WARN, font=font)
    origin = (0.0, top)
    for depth, colour in colours.items():
        target = next(target for target in targets if target.depth == depth)
        shear = math.dist(target.bottom, target.sheared)
        # Each depth is shifted to the right, so that the paths down do not coincide.
        aside = 0.06 * reach * list(colours).index(depth)
        path = [origin, (aside, origin[1]), (aside, -depth), (aside + shear, -depth)]
        canvas.line([at(*corner) for corner in path], fill=colour, width=3)
        beside = at(aside + shear + 0.06 * reach, -depth + 0.04 * deepest)
        canvas.text(beside, f"{1e3 * depth:.3f} mm", colour, font=font)
    last = 0.06 * reach * (len(colours) - 1)
    corners = (("p0", origin), ("p1", (last, -deepest)), ("p2", (last + reach, -deepest)))
    for name, corner in corners:
        _dot(canvas, at(*corner), 4, _INK)
        canvas.text((at(*corner)[0] - 22, at(*corner)[1] + 4), name, _INK, font=font)


def _dot(
    canvas: ImageDraw.ImageDraw,
    place: tuple[float, float],
    radius: float,
    colour: tuple[int, int, int],
) -> None:
    x, y = place
    canvas.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
