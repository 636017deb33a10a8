"""Which indenter: one of the 18 by name, a shape by its measures, or an STL file; and its tilt."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from sim.errors import SceneError
from sim.verbs.numbers import metres

if TYPE_CHECKING:
    from sim.indenters import Indenter

Measures = dict[str, float]
"""Measures that were given: lengths in [m], angles in [rad]."""

MEASURES = {
    "radius": "radius of a sphere, a punch or a bar [mm]",
    "width": "width of a box along x [mm]",
    "length": "length of a box or a bar along y [mm]",
    "half_angle": "angle between the axis and the side of a cone [deg]",
    "tip_radius": "radius of a cone's tip, flat or round [mm]",
    "ring_radius": "radius of a torus's middle line [mm]",
    "tube_radius": "radius of a torus's tube [mm]",
    "outer_radius": "outer radius of a tube [mm]",
    "inner_radius": "inner radius of a tube [mm]",
}
NEEDS: dict[str, tuple[str, ...]] = {
    "sphere": ("radius",),
    "punch": ("radius",),
    "cone": ("half_angle", "tip_radius"),
    "rounded-cone": ("half_angle", "tip_radius"),
    "box": ("width", "length"),
    "bar": ("radius", "length"),
    "torus": ("ring_radius", "tube_radius"),
    "tube": ("outer_radius", "inner_radius"),
    "plane": (),
}
"""Shapes by measure, and the measures that each must be given."""
EDGE_MM = 0.3
"""Edge radius of a shape by measure when none is given, as far as there is room: the same as most
of the named shapes have, since a sharp edge is never solved reproducibly."""
ROUND = ("sphere", "torus", "rounded-cone", "plane")
"""Shapes without an edge to round."""
FILE = ".stl"
"""How the name of a file ends, in place of a shape."""
FILE_OPTIONS = ("stl_unit", "stl_up")


def add_indenter_options(parser: argparse.ArgumentParser) -> None:
    """`--shape`, its measures or file, `--edge-radius`, `--tilt` and `--at`."""
    from sim.indenters import NAMES, UNITS, UPS
    from sim.verbs.numbers import numbers

    group = parser.add_argument_group("indenter")
    by_measure = "; ".join(
        f"{shape} ({', '.join(_option(name) for name in needs) or 'no measure'})"
        for shape, needs in NEEDS.items()
    )
    group.add_argument(
        "--shape",
        default="sphere",
        metavar="NAME",
        help=f"without measures one of {', '.join(NAMES)}; with all of its measures: {by_measure}; "
        "or an STL file (%(default)s)",
    )
    for name, meaning in MEASURES.items():
        unit = "DEG" if name == "half_angle" else "MM"
        group.add_argument(_option(name), type=float, metavar=unit, help=meaning)
    group.add_argument(
        "--edge-radius",
        type=float,
        metavar="MM",
        help=f"radius of every convex edge [mm] (default: the named shape's own, else {EDGE_MM} as "
        "far as there is room)",
    )
    group.add_argument("--stl-unit", choices=UNITS, help="unit of the numbers in an STL file (mm)")
    group.add_argument(
        "--stl-up",
        choices=UPS,
        help="axis of an STL file that points away from the skin; --stl-up=-z where the tip is up "
        "(+z)",
    )
    group.add_argument(
        "--tilt",
        type=numbers(2),
        default=(0.0, 0.0),
        metavar="X,Y",
        help="how the indenter leans, a rotation vector about x and y [deg] (0,0)",
    )
    group.add_argument(
        "--at",
        type=numbers(2),
        default=(0.0, 0.0),
        metavar="X,Y",
        help="where the tip goes down, from the middle of the body [mm] (0,0)",
    )


def indenter_of(options: argparse.Namespace) -> Indenter:
    """The indenter that the options describe, leaning as they say.

    Raises:
        FileNotFoundError: There is no such STL file.
        SceneError: An unknown shape, measures that it does not have or lacks, sizes or a file that
            make no body, or a tilt that it cannot have.
    """
    upright = _upright(options)
    about_x, about_y = map(math.radians, options.tilt)
    return upright.tilted(about_x, about_y) if about_x or about_y else upright


def _upright(options: argparse.Namespace) -> Indenter:
    from sim.indenters import NAMES, named

    shape: str = options.shape
    given = {name for name in MEASURES if getattr(options, name) is not None}
    edge = None if options.edge_radius is None else metres(options.edge_radius)
    if shape.lower().endswith(FILE):
        return _from_file(options, given, edge)
    for name in FILE_OPTIONS:
        if getattr(options, name) is not None:
            raise SceneError(
                f"{_option(name)}: given with --shape {shape}; allowed: an STL file, or nothing"
            )
    if shape in NAMES and not given:
        return named(shape, edge)
    if shape not in NEEDS:
        if shape in NAMES:
            raise SceneError(
                f"{_option(sorted(given)[0])}: given with --shape {shape}; allowed: no "
                "measure, they are known"
            )
        allowed = dict.fromkeys((*NAMES, *NEEDS))
        raise SceneError(f"--shape: {shape!r}; allowed: {', '.join(allowed)}")
    needs = set(NEEDS[shape])
    if given != needs:
        listed = ", ".join(_option(name) for name in NEEDS[shape]) or "no measure"
        found = ", ".join(_option(name) for name in sorted(given)) or "nothing"
        raise SceneError(f"--shape {shape}: {found} given; allowed: {listed}")
    return _measured(shape, {name: _si(name, getattr(options, name)) for name in given}, edge)


def _from_file(options: argparse.Namespace, given: set[str], edge: float | None) -> Indenter:
    from sim.indenters import from_stl
    from sim.indenters.solid import REACH
    from sim.verbs.device import ready_device

    if given:
        raise SceneError(
            f"{_option(sorted(given)[0])}: given with --shape {options.shape}; allowed: no "
            "measure, the file has them"
        )
    # Distances to the file's triangles are found by Warp, whichever the tier.
    ready_device(options.device)
    indenter = from_stl(
        options.shape,
        unit=options.stl_unit or "mm",
        up=options.stl_up or "+z",
        edge_radius=metres(EDGE_MM) if edge is None else edge,
        # No press goes deeper than the body is thick.
        reach=max(REACH, metres(options.size[2])),
    )
    for note in indenter.solid.notes if indenter.solid else ():
        print(f"note: {note}", file=sys.stderr)
    return indenter


def _measured(shape: str, sizes: Measures, edge: float | None) -> Indenter:
    from sim import indenters

    makers: dict[str, Callable[..., Indenter]] = {
        "sphere": indenters.sphere,
        "punch": indenters.flat_punch,
        "cone": indenters.cone,
        "rounded-cone": indenters.rounded_cone,
        "box": indenters.box,
        "bar": indenters.bar,
        "torus": indenters.torus,
        "tube": indenters.tube,
        "plane": indenters.plane,
    }
    made = makers[shape](**sizes)
    if shape in ROUND:
        if edge is not None:
            raise SceneError(f"--edge-radius: given with --shape {shape}, which has no edge")
        return made
    if edge is None:
        edge = min(metres(EDGE_MM), made.edge_radius_max)
    return replace(made, edge_radius=edge)


def _si(name: str, value: float) -> float:
    return math.radians(value) if name == "half_angle" else metres(value)


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
