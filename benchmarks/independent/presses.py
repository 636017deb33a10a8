"""Presses with the forces that other methods give: `presses.json`, a press a line; in mm and N.

Only the standard library is imported, because GetFEM runs in a separate interpreter.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

MM = 1e-3
# Young's modulus of all presses [Pa].
MODULUS = 0.145e6
FILE = Path(__file__).with_suffix(".json")

Shape = Literal["sphere", "punch", "cone", "torus", "tube", "spheres", "bar", "box"]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Press:
    """One press with several forces, by the axisymmetric solver of this folder or by GetFEM."""

    name: str
    """Of an axisymmetric one, its description: `sphere 4 in 4, mu 0.3, nu 0.45, to 1.5`."""
    shape: Shape
    measures: tuple[float, ...]
    """[mm]. `sphere`: radius. `punch`: radius, edge radius. `cone`: half angle [degrees], tip
    radius. `torus`: radius of the ring, of its section. `tube`: outer, inner, edge radius.
    `spheres`: radius, and x of the centres of two (without them: one in the middle). `bar`: radius,
    length, edge radius. `box`: width, length, edge radius."""
    path: tuple[Vector, ...]
    """x, y and depth of the tip [mm]; each has a force."""
    size: Vector = (20.0, 20.0, 4.0)
    """Size of the body along x, y and z [mm]. Of an axisymmetric press, wide enough (contact radius
    + 4 thicknesses to each side) to be replaced by a disc of equal area."""
    dome: float | None = None
    """Radius of the body's top [mm]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Tilt of the indenter about x and y [degrees]."""
    friction: float = 0.0
    poisson: float = 0.45
    x_zones: tuple[Vector, ...] = ()
    """Element sizes of GetFEM's mesh along x: from, to, size [mm]; none: axisymmetric."""
    y_zones: tuple[Vector, ...] = ()
    """The same for y."""
    mirrors: str = ""
    """`x`: the scene is symmetric about the plane x = 0, so GetFEM solves half of it; `y`, `xy`
    likewise."""
    forces_n: tuple[Vector, ...] = ()
    """Force on the body at each point of the path [N]; none: not solved yet."""
    uncertainty_percent: tuple[float, ...] = ()
    """Uncertainty of each force."""

    @property
    def axisymmetric(self) -> bool:
        """True if the axisymmetric solver has solved it, GetFEM otherwise."""
        return not self.x_zones

    @property
    def depths(self) -> list[float]:
        """Depths of the path [mm]."""
        return [depth for _, _, depth in self.path]


def store(presses: Sequence[Press]) -> None:
    """Write the file again."""
    lines = [
        json.dumps(
            {
                field.name: value
                for field in fields(press)
                if (value := getattr(press, field.name)) != field.default
            }
        )
        for press in presses
    ]
    FILE.write_text("[\n" + ",\n".join(lines) + "\n]\n", encoding="utf-8")


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


PRESSES = tuple(
    Press(**{name: _tuples(value) for name, value in press.items()})
    for press in json.loads(FILE.read_text(encoding="utf-8"), parse_int=float)
)
