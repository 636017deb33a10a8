"""Charts in one style, by matplotlib, which is imported when the first one is drawn."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.artist import Artist as Artist
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure

# Colours of the style by name, for curves that have the same colour in several charts.
BLUE, RED, GREEN = "#0072b2", "#d55e00", "#009e73"
PURPLE, SKY, ORANGE = "#cc79a7", "#56b4e9", "#e69f00"
INK, SOFT, BAND = "#262a33", "#787f8c", "#e2e5eb"
# Fx, Fy and Fz, 25 apart and more in CIELAB, as protanopes, deuteranopes and tritanopes see them
# too (Machado et al. 2009). Those of pages, `--fx` in their style, are as far apart on dark ground.
FORCES = ("#004b9b", RED, GREEN)


@contextmanager
def chart(file: Path | IO[bytes], width: float, height: float) -> Iterator[Figure]:
    """Yield an empty figure of the style; write it to a file at the end of the block.

    Width and height are in inch. The format is that of the path's suffix (.png or .svg), or PNG
    for an open file. Equal charts are equal bytes: no version or date is written.
    """
    import matplotlib
    from matplotlib.figure import Figure

    suffix = ".png"
    if isinstance(file, Path):
        suffix = file.suffix
        file.parent.mkdir(parents=True, exist_ok=True)
    unwritten = {".png": {"Software": None}, ".svg": {"Date": None}}.get(suffix)
    with matplotlib.rc_context(fname=Path(__file__).with_name("tactile.mplstyle")):
        figure = Figure(figsize=(width, height))
        yield figure
        figure.savefig(file, metadata=unwritten)
