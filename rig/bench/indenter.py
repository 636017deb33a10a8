"""Indenters by name: the 18 of the paper, and those of a lab's own folder.

A lab's own indenter is `indenters/NAME.yaml`, with the keys of `IndenterFile` or with `parts`
(`sim.indenters.parts`), or `indenters/NAME.stl`, in the folder where the commands run. Any other
name is refused: it would be recorded as if it existed.
"""

import hashlib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.core.config import build, from_si, read_yaml
from rig.core.errors import ConfigError
from rig.core.names import unknown_name

if TYPE_CHECKING:
    from sim.indenters import Indenter as Body

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
    """STL file, with the tip towards -z; or YAML file with parts."""
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
    """Return the indenter of that name, the lab's own first; errors name `where` it was given."""
    name = name.removesuffix(".yaml").removesuffix(".stl")
    for path in (folder / f"{name}.yaml", folder / f"{name}.stl"):
        if path.is_file():
            return _own(name, path)
    if name in paper_indenters():
        return paper_indenters()[name]
    raise unknown_name(where, name, indenter_names(folder), f"in the paper or {folder}/")


def body_of(name: str, reach: float) -> "Body":
    """Return the simulator's body of an indenter; no press is deeper than `reach` [m].

    Raises:
        ImportError: The simulator is not installed.
        ValueError: Its file holds no body that can press.
    """
    from sim.indenters import from_stl, named

    solid = find_indenter(name).stl
    return named(name) if solid is None else from_stl(solid, name=name, reach=reach)


def _own(name: str, path: Path) -> Indenter:
    """Return a lab's own indenter; tip and size are those of its body unless the file has them."""
    content = read_yaml(path) if path.suffix == ".yaml" else {}
    beside: dict[str, Path | None] = {}
    for key in ("stl", "drawing"):
        other = path.parent / str(content[key]) if content.get(key) else None
        if other is not None and not other.is_file():
            raise ConfigError(f"{path}.{key}: found {content[key]!r}; no such file beside it")
        beside[key] = other
    if path.suffix == ".stl" or content.pop("parts", None) is not None:
        if beside["stl"] is not None:
            raise ConfigError(f"{path}.stl: found {content['stl']!r} beside parts; allowed: either")
        beside["stl"] = path
    if (body := beside["stl"]) is not None:
        width, depth, height = body_size(body)
        tip = f"body of {body.name}, {height:g} mm high"
        content = {"tip": tip, "size_mm": [width, depth], **content}
    file = build(IndenterFile, content, str(path))
    return Indenter(name, file.tip, file.size, **beside, source=path)


def body_size(path: Path) -> tuple[float, float, float]:
    """Return the extent along x, y and z of the body in an STL file, or of parts [mm].

    Raises:
        ConfigError: The file holds no closed body of a plausible size.
    """
    try:
        from sim.indenters.solid import read_triangles

        corners = read_triangles(path.read_bytes(), str(path), "mm", "+z", "file").vertices
    except ImportError as error:
        cure = "install the simulator: pip install 'tactile-rig[sim]'"
        raise ConfigError(f"{path}: {error}; {cure}") from None
    except ValueError as error:
        raise ConfigError(str(error)) from None
    width, depth, height = np.round(1e3 * np.ptp(corners, axis=0), 3).tolist()
    return width, depth, height
