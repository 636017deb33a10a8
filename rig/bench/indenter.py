"""Indenters by name: the 18 of the paper, and those of a lab's own folder.

A lab's own indenter is `indenters/NAME.yaml`, with the keys of `IndenterFile`, or
`indenters/NAME.stl`, in the folder where the commands run. Any other name is refused: it would be
recorded as if it existed.
"""

import hashlib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rig.core.config import build, from_si, read_yaml, to_si
from rig.core.errors import ConfigError
from rig.core.names import unknown_name

# Folder of a lab's own indenters, relative to the folder where the commands run.
OWN = Path("indenters")
# Tips narrower or wider than this are no indenter of a tactile sensor [mm].
_PLAUSIBLE = (0.2, 100.0)
# Data of the paper's indenters: `indenters.yaml`, and a drawing of each.
_PAPER = Path(__file__).parent / "indenters"


@dataclass(frozen=True, slots=True)
class IndenterFile:
    """Content of a file that describes an indenter."""

    tip: str
    """Shape of the part that presses, in words; lengths in mm."""
    size: tuple[float, float] = field(metadata={"unit": "mm", "plausible": _PLAUSIBLE})
    """Width along x and y of the part that presses [m]."""
    stl: str = ""
    """STL file beside this one; lengths in mm, tip towards -z."""
    drawing: str = ""
    """Drawing beside this file."""


@dataclass(frozen=True, slots=True)
class Indenter:
    """An indenter, as the paper or a lab's file describes it."""

    name: str
    tip: str
    """Shape of the part that presses, in words; lengths in mm."""
    size: tuple[float, float]
    """Width along x and y of the part that presses [m]."""
    stl: Path | None = None
    """STL file, with the tip towards -z."""
    drawing: Path | None = None
    """Drawing."""
    source: Path | None = None
    """The lab's file that describes it; None: one of the paper's."""

    def attrs(self) -> dict[str, Any]:
        """Return the description for the session's metadata, without paths of this machine."""
        description: dict[str, Any] = {
            "tip": self.tip,
            "size_mm": [round(from_si(width, "mm"), 4) for width in self.size],
            "source": "paper" if self.source is None else self.source.name,
        }
        if self.source is not None:
            body = (self.stl or self.source).read_bytes()
            description["sha256"] = hashlib.sha256(body).hexdigest()
        return description

    def line(self) -> str:
        """Return name, size and tip as a line of a table."""
        size = " x ".join(f"{from_si(width, 'mm'):g}" for width in self.size)
        source = "" if self.source is None else f"  ({self.source})"
        return f"{self.name:<14}{size:>12} mm   {self.tip}{source}"


@cache
def paper_indenters() -> dict[str, Indenter]:
    """Return the paper's indenters by name."""
    path = _PAPER / "indenters.yaml"
    indenters = {}
    for name, content in read_yaml(path).items():
        file = build(IndenterFile, content, f"{path}.{name}")
        indenters[name] = Indenter(name, file.tip, file.size, drawing=_PAPER / f"{name}.png")
    return indenters


def indenter_names(folder: Path = OWN) -> list[str]:
    """Return the names of the paper's indenters, then those of the lab's folder."""
    own = {path.stem for kind in ("*.yaml", "*.stl") for path in folder.glob(kind)}
    return [*paper_indenters(), *sorted(own - set(paper_indenters()))]


def find_indenter(name: str, where: str = "--indenter", folder: Path = OWN) -> Indenter:
    """Return the indenter of that name; those of the lab's folder have precedence.

    Errors name the option or key `where` the name was given.
    """
    described, solid = folder / f"{name}.yaml", folder / f"{name}.stl"
    if described.is_file():
        file = build(IndenterFile, read_yaml(described), str(described))
        beside: dict[str, Path | None] = {}
        for key, value in (("stl", file.stl), ("drawing", file.drawing)):
            beside[key] = folder / value if value else None
            if value and not (folder / value).is_file():
                raise ConfigError(f"{described}.{key}: found {value!r}; no such file beside it")
        if beside["stl"] is not None:
            stl_size(beside["stl"])
        return Indenter(name, file.tip, file.size, **beside, source=described)
    if solid.is_file():
        width, depth, height = stl_size(solid)
        tip = f"body of {solid.name}, {height:g} mm high"
        size = (to_si(width, "mm"), to_si(depth, "mm"))
        return Indenter(name, tip, size, stl=solid, source=solid)
    if name in paper_indenters():
        return paper_indenters()[name]
    raise unknown_name(where, name, indenter_names(folder), f"in the paper or {folder}/")


_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
# Bytes before the facets of a binary STL file: a title, and their number.
_HEAD = 84


def stl_size(path: Path) -> tuple[float, float, float]:
    """Return the extent along x, y and z of the body in an STL file, binary or text [mm]."""
    content = path.read_bytes()
    count = int.from_bytes(content[_HEAD - 4 : _HEAD], "little")
    if count and len(content) == _HEAD + count * _FACET.itemsize:
        corners = np.frombuffer(content, _FACET, offset=_HEAD)["corners"].reshape(-1, 3)
    else:
        rows = [line.split() for line in content.decode("utf-8", "replace").splitlines()]
        try:
            numbers = [[float(each) for each in row[1:4]] for row in rows if row[:1] == ["vertex"]]
            corners = np.array(numbers, np.float32).reshape(-1, 3)
        except ValueError:
            corners = np.zeros((0, 3), np.float32)
    if not len(corners) or not np.isfinite(corners).all():
        raise ConfigError(f"{path}: found no triangles; allowed: an STL file, binary or text")
    width, depth, height = (float(each) for each in np.round(np.ptp(corners, axis=0), 3))
    if not _PLAUSIBLE[0] <= max(width, depth) <= _PLAUSIBLE[1]:
        raise ConfigError(
            f"{path}: the body is {width:g} x {depth:g} x {height:g}; plausible: "
            f"{_PLAUSIBLE[0]:g} to {_PLAUSIBLE[1]:g} mm wide; is it in another unit than mm?"
        )
    return width, depth, height
