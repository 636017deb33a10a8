"""The contact sheet: a session on one page, for a visual check."""

import math
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from recorder.charts import FORCES, PURPLE
from recorder.errors import SessionError
from recorder.plot import PAPER, Curve, Tile, line_plot, sheet
from recorder.session.align import NS
from recorder.session.frames import resting
from recorder.session.reader import Session
from recorder.spec import PHASES

# Frames on a sheet at most, and in a row.
PICTURES, _COLUMNS = 12, 6
_THUMB = (248, 186)
_SMOOTH = 3  # supersampling factor, since Pillow does not anti-alias discs


def contact_sheet(session_path: str | os.PathLike[str], png_path: str | os.PathLike[str]) -> None:
    """Draw a finished session as a PNG: evenly spaced frames, then force and depth over time.

    Raises:
        SessionError: The session has no frames.
    """
    session = Session(session_path)
    frames = session.frames
    if "t_ns" not in frames or not len(frames["t_ns"]):
        raise SessionError(f"{session.name}: has no frames to show")
    candidates = np.flatnonzero(frames["valid"])
    if not candidates.size:
        candidates = np.arange(len(frames["t_ns"]))
    count = min(PICTURES, candidates.size)
    chosen = candidates[np.linspace(0, candidates.size - 1, count).astype(int)]
    tiles = [
        Tile(np.asarray(picture), _captions(number, session, int(frame)))
        for number, (frame, picture) in enumerate(
            zip(chosen, thumbnails(session, chosen), strict=True), 1
        )
    ]
    rows = [("", "", tiles[first : first + _COLUMNS]) for first in range(0, len(tiles), _COLUMNS)]
    rows[0] = (session.path.name, _properties(session), rows[0][2])
    page = sheet(rows, _COLUMNS, _THUMB)
    width, top = page.size
    seconds = _recorded_seconds(session)
    wrench = frames["wrench"]
    forces = [
        Curve(name, np.asarray(wrench[:, axis], np.float64), color)
        for axis, (name, color) in enumerate(zip(("Fx", "Fy", "Fz"), FORCES, strict=True))
    ]
    depth = [Curve("depth", np.asarray(frames["depth"] * 1e3, np.float64), PURPLE)]
    marks = seconds[chosen]
    force = line_plot((width, 240), seconds, forces, title="force [N]", marks=marks)
    press = line_plot(
        (width, 220),
        seconds,
        depth,
        title="depth [mm]",
        marks=marks,
        x_label="recorded time, pauses between phases left out [s]",
    )
    whole = Image.new("RGB", (width, top + force.height + press.height), PAPER)
    for picture, above in ((page, 0), (force, top), (press, top + force.height)):
        whole.paste(picture, (0, above))
    whole.save(png_path, "PNG")


def thumbnails(session: Session, chosen: NDArray[np.intp]) -> list[Image.Image]:
    """Return a thumbnail of each chosen row of `frames`: images side by side, or the taxels.

    Raises:
        SessionError: An image is corrupt.
    """
    frames, columns = session.frames, session.columns
    if cameras := [name for name in session.of_kind("camera") if columns.get(name) in frames]:
        size = (_THUMB[0] // len(cameras), _THUMB[1])
        images = [
            session.streams[name].images(np.maximum(frames[columns[name]][chosen], 0))
            for name in cameras
        ]
        return [
            _side_by_side([_fitted(pixels, size) for pixels in row_images])
            for row_images in zip(*images, strict=True)
        ]
    if "taxels" not in frames:
        return [Image.new("RGB", _THUMB, (30, 34, 42)) for _ in chosen]
    change = frames["taxels"][chosen] - resting(session, "taxels")
    full_scale = float(np.nanmax(np.abs(change), initial=1.0))
    return [_taxel_picture(row, full_scale) for row in change]


def _taxel_picture(change: NDArray[Any], full_scale: float) -> Image.Image:
    """Return a taxel pad as discs: shifted by shear, larger and warmer under pressure.

    `change` (taxels, axes) is counts relative to rest, row by row of the squarest grid: shear along
    x and y, and last pressure. `full_scale` counts give the largest displacement and size.
    """
    width, height = _THUMB[0] * _SMOOTH, _THUMB[1] * _SMOOTH
    picture = Image.new("RGB", (width, height), (30, 34, 42))
    draw = ImageDraw.Draw(picture)
    taxels, axes = change.shape
    columns = next(n for n in range(math.isqrt(taxels - 1) + 1, taxels + 1) if taxels % n == 0)
    lines = taxels // columns
    pitch = min(width, height) / (max(lines, columns, 4) + 0.6)
    moved = np.zeros((taxels, 3))
    moved[:, 2] = change[:, -1]
    moved[:, : axes - 1] = change[:, : axes - 1]
    homes = [
        (
            width / 2 + (taxel % columns - (columns - 1) / 2) * pitch,
            height / 2 + (taxel // columns - (lines - 1) / 2) * pitch,
        )
        for taxel in range(taxels)
    ]
    for home in homes:
        draw.ellipse(_disc(*home, pitch * 0.42), outline=(58, 64, 76), width=2 * _SMOOTH)
    for taxel, home in enumerate(homes):
        shift_x, shift_y, press = np.nan_to_num(moved[taxel]) / full_scale
        x = home[0] + float(np.clip(shift_x, -1, 1)) * pitch * 0.45
        y = home[1] + float(np.clip(shift_y, -1, 1)) * pitch * 0.45
        strength = float(np.clip(abs(press), 0, 1))
        radius = pitch * (0.14 + 0.26 * strength)
        draw.line((*home, x, y), fill=(120, 130, 148), width=_SMOOTH)
        cool, warm = np.array([92, 148, 196]), np.array([247, 178, 84])
        tone = tuple(int(value) for value in cool + (warm - cool) * strength)
        draw.ellipse(_disc(x, y, radius), fill=tone)
    return picture.resize(_THUMB, Image.Resampling.LANCZOS)


def _disc(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
    return (x - radius, y - radius, x + radius, y + radius)


def _side_by_side(pictures: list[Image.Image]) -> Image.Image:
    thumb = Image.new("RGB", _THUMB, (30, 34, 42))
    for index, picture in enumerate(pictures):
        thumb.paste(picture, (index * picture.width, 0))
    return thumb


def _fitted(pixels: NDArray[np.uint8], within: tuple[int, int]) -> Image.Image:
    """Return an image scaled into a size, on a dark background."""
    image = Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels).convert("RGB")
    scale = min(within[0] / image.width, within[1] / image.height)
    size = (max(round(image.width * scale), 1), max(round(image.height * scale), 1))
    thumb = Image.new("RGB", within, (30, 34, 42))
    thumb.paste(
        image.resize(size, Image.Resampling.LANCZOS),
        ((within[0] - size[0]) // 2, (within[1] - size[1]) // 2),
    )
    return thumb


def _properties(session: Session) -> str:
    attrs, frames = session.attrs, session.frames
    reported = [session.status]
    reported += [str(attrs[key]) for key in ("sensor", "indenter", "operator") if key in attrs]
    if attrs.get("mock"):
        reported.append("mock")
    reported.append(f"{len(frames['t_ns'])} frames at {session.rate_hz:g} Hz")
    targets = np.unique(frames["target"])
    reported.append(f"{int((targets >= 0).sum())} targets")
    reported.append(f"{100 * float(np.mean(frames['valid'])):.1f} % valid")
    return "   ·   ".join(reported)


def _captions(number: int, session: Session, frame: int) -> tuple[str, str]:
    frames = session.frames
    target, code = int(frames["target"][frame]), int(frames["phase"][frame])
    phase = PHASES[code].replace("_", " ") if code >= 0 else ""
    seconds = (int(frames["t_ns"][frame]) - int(frames["t_ns"][0])) * NS
    title = f"target {target + 1}" if target >= 0 else f"{seconds:.2f} s"
    depth, force = float(frames["depth"][frame]) * 1e3, float(frames["wrench"][frame][2])
    pressed = f"{depth:.2f} mm" if np.isfinite(depth) else "depth unknown"
    read = f"Fz {force:+.2f} N" if np.isfinite(force) else "no force"
    return f"{title}   {phase}   [{number}]", f"{pressed}   {read}"


def _recorded_seconds(session: Session) -> NDArray[np.float64]:
    """Return the time of each frame [s], with pauses between phases and runs removed."""
    period = 1.0 / session.rate_hz
    steps = np.diff(session.frames["t_ns"]) * NS
    steps = np.where((steps > 1.5 * period) | (steps < 0), period, steps)
    return np.concatenate([[0.0], np.cumsum(steps)])
