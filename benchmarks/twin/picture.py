"""Sheet with the output of every sensor for one press.

Run with `python -m benchmarks sensor-picture [--out PNG]`.

The prism is pressed straight down at the middle to each sensor's full depth; the output of the
sensor is white, the outlines of its undeformed markers are orange.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from recorder.plot import INK, PAPER, SOFT, font
from sim.device import ready_device
from sim.fem import FOR_EDGES, Fem
from sim.indenters import named
from sim.layer import Layer
from sim.result import Result
from sim.scene import press
from sim.sensors.field import SurfaceField
from sim.sensors.readout import readout
from sim.sensors.sensor import HETEROGENEOUS, HOMOGENEOUS, MATERIAL, SimulatedSensor, sensor
from sim.tiers import simulate

Colours = NDArray[np.uint8]

ORDER = (*HETEROGENEOUS, *HOMOGENEOUS, *MATERIAL, "gel")
# Tiles in a row, size of a tile, space around it and height of its caption [px].
COLUMNS, TILE, GAP, CAPTION = 4, (400, 300), 18, 50
MARKER, GROUND, UNDEFORMED = (240, 240, 236), (22, 26, 34), (240, 140, 40)
# Number of patterns shown for a sensor with many.
PATTERNS = 4
# Maximum element height [m]; it is also at most a sixth of the thickness.
SPACING = 1.2e-3
# Random seed of the device variation.
SEED = 0


@dataclass(frozen=True, slots=True)
class Tile:
    """One image of the sheet."""

    title: str
    text: str
    pixels: Colours
    """(480, 640, 3)."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--out", type=Path, default=Path("docs/images/sensors.png"))
    parser.add_argument("--tier", choices=("layer", "fem"), default="fem", help="(%(default)s)")


def run(options: argparse.Namespace) -> int:
    """Simulate, read out and draw."""
    ready_device("cpu")
    tiles: list[Tile] = []
    for name in ORDER:
        each = sensor(name)
        tiles += _tiles(each, _pressed(each, options.tier))
        print(f"drawn: {name}", file=sys.stderr)
    # A palette makes the file three times smaller without a visible difference.
    sheet(tiles).quantize(256, dither=Image.Dither.NONE).save(options.out, "PNG", optimize=True)
    print(options.out)
    return 0


def sheet(tiles: Sequence[Tile]) -> Image.Image:
    """Return a page with all tiles, row by row."""
    rows = -(-len(tiles) // COLUMNS)
    width, height = TILE[0] + GAP, TILE[1] + CAPTION + GAP
    page = Image.new("RGB", (COLUMNS * width + GAP, rows * height + GAP), PAPER)
    pen = ImageDraw.Draw(page)
    for index, tile in enumerate(tiles):
        left = GAP + index % COLUMNS * width
        top = GAP + index // COLUMNS * height
        picture = Image.fromarray(tile.pixels).resize(TILE, Image.Resampling.LANCZOS)
        page.paste(picture, (left, top))
        pen.text((left, top + TILE[1] + 18), tile.title, INK, font(17), anchor="ls")
        pen.text((left, top + TILE[1] + 38), tile.text, SOFT, font(13), anchor="ls")
    return page


def outlined(mask: NDArray[np.bool_], undeformed: NDArray[np.bool_]) -> Colours:
    """Return markers (480, 640, 3) in white, with outlines of the undeformed ones in orange."""
    pixels = np.where(mask[..., None], MARKER, GROUND).astype(np.uint8)
    pixels[undeformed & ~binary_erosion(undeformed, iterations=2)] = UNDEFORMED
    return pixels


def _pressed(each: SimulatedSensor, name: str) -> Result:
    depth = each.depth_max if each.force_depth is None else each.force_depth.depth_max
    motion = press([depth / 2, depth], speed=each.speed)
    fem = Fem(spacing=min(each.body.thickness / 6, SPACING), grading=FOR_EDGES)
    tier = fem if name == "fem" else Layer()
    return simulate(each.placed(named("prism"), motion, seed=SEED), tier)


def _tiles(each: SimulatedSensor, result: Result) -> list[Tile]:
    top = SurfaceField.of(result)
    still = SurfaceField.undeformed(each.body)
    reader = readout(each, seed=SEED)
    masks, undeformed = reader.masks(top)[-1], reader.masks(still)[0]
    depth = -result.scene.motion.tip[-1][2] * 1e3
    text = f"{each.body.modulus / 1e3:g} kPa, {depth:g} mm deep, {-result.force[-1, 2]:.2f} N"
    shown = np.unique(np.linspace(0, len(masks) - 1, PATTERNS).round().astype(int)).tolist()
    tiles = [
        Tile(f"{each.name}: {reader.patterns[one]}", text, outlined(masks[one], undeformed[one]))
        for one in shown
    ]
    return tiles
