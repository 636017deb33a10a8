"""Options common to all simulating subcommands, and the scene that they describe."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from recorder.command_line.options import add_device, names, numbers, positive
from sim.effects import Effects, Friction, Gravity, Inertia, Viscosity
from sim.errors import SceneError
from sim.fem import FOR_EDGES, Fem
from sim.layer import Layer
from sim.scene import Body, Footprint
from sim.simulate import Extrapolated, Measured

if TYPE_CHECKING:
    from sim.indenters import Indenter


# Readers of option values: numbers, lists of numbers, pairs.

MM = 1e-3


def metres(millimetres: float) -> float:
    """Convert a length to [m]; by division, so that 9 mm are 0.009 m to the last digit."""
    return millimetres / 1e3


def branches(text: str) -> tuple[tuple[float, float], ...] | None:
    """Read comma-separated pairs `ratio:time`; `none` is None."""
    if text == "none":
        return None
    try:
        pairs = [part.split(":") for part in text.split(",")]
        return tuple((float(ratio), float(time)) for ratio, time in pairs)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r}; allowed: ratio:seconds between commas, such as 0.3:0.1,0.5:2, or none"
        ) from None


# The indenter: one of the 18 by name, a shape by its measures, or an STL file; and its tilt.

# Given measures: lengths in [m], angles in [rad].
Measures = dict[str, float]

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
# Shapes by measure, and the measures that each requires.
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
# Default edge radius of a shape by measure, as far as there is room. Most of the named shapes have
# the same radius, since a sharp edge is never solved reproducibly.
EDGE_MM = 0.3
# Shapes without an edge to round.
ROUND = ("sphere", "torus", "rounded-cone", "plane")
# Suffix of a file given in place of a shape.
FILE = ".stl"
FILE_OPTIONS = ("stl_unit", "stl_up")


def add_indenter_options(parser: argparse.ArgumentParser) -> None:
    """Add `--shape`, its measures or file, `--edge-radius`, `--tilt` and `--at`."""
    from sim.indenters import NAMES, UNITS, UPS

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
        help="tilt of the indenter, a rotation vector about x and y [deg] (0,0)",
    )
    group.add_argument(
        "--at",
        type=numbers(2),
        default=(0.0, 0.0),
        metavar="X,Y",
        help="position of the press, from the middle of the body [mm] (0,0)",
    )


def indenter_of(options: argparse.Namespace) -> Indenter:
    """Return the indenter that the options describe, with its tilt.

    Raises:
        FileNotFoundError: The STL file does not exist.
        SceneError: The shape is unknown, has missing or unknown measures, sizes or a file that make
            no body, or an impossible tilt.
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
    from sim.device import ready_device
    from sim.indenters import from_stl
    from sim.indenters.solid import REACH

    if given:
        raise SceneError(
            f"{_option(sorted(given)[0])}: given with --shape {options.shape}; allowed: no "
            "measure, the file has them"
        )
    # Warp computes distances to the file's triangles, whichever the tier.
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


# Most frames of a phase of a motion.
STEPS_MAX = 1000
PRECISIONS = ("auto", "float32", "float64")


def add_scene_options(
    parser: argparse.ArgumentParser, *, friction: float = 0.0, viscosity: str = "none"
) -> None:
    """Add options of scene, solver and output; `friction` and `viscosity` are defaults."""
    add_indenter_options(parser)
    _add_body_options(parser)
    _add_effect_options(parser, friction, viscosity)
    _add_solver_options(parser)
    _add_output_options(parser)


def add_speed(group: argparse._ArgumentGroup) -> None:
    """Add `--speed`, for subcommands whose tip moves at a constant speed."""
    group.add_argument(
        "--speed",
        type=float,
        default=10.0,
        metavar="MM/S",
        help="speed of the tip; matters to viscosity and inertia only [mm/s] (%(default)s)",
    )


def body_of(options: argparse.Namespace) -> Body:
    """Return the body that the options describe.

    Raises:
        SceneError: A value is out of range.
    """
    x, y, z = options.size
    return Body(
        size_x=metres(x),
        size_y=metres(y),
        thickness=metres(z),
        modulus=options.modulus * 1e6,
        poisson=options.poisson,
        dome_radius=None if options.dome is None else metres(options.dome),
        density=options.density,
        footprint=options.footprint,
    )


def effects_of(options: argparse.Namespace) -> Effects:
    """Return the effects that the options request; friction 0 requests none.

    Raises:
        SceneError: A value is out of range.
    """
    friction, viscosity = options.friction, options.viscosity
    return Effects(
        friction=None if friction == 0 else Friction(friction),
        viscosity=None
        if viscosity is None
        else Viscosity(
            ratios=tuple(ratio for ratio, _ in viscosity),
            times=tuple(time for _, time in viscosity),
            relaxes=options.relaxes,
        ),
        inertia=None if options.inertia is None else Inertia(options.inertia),
        gravity=None if options.gravity is None else Gravity(options.gravity),
    )


def check_solver_options(options: argparse.Namespace) -> None:
    """Check that no two solver options exclude each other.

    Raises:
        SceneError: An option does not apply with another one.
    """

    def reject(other: str, allowed: str, **defaults: object) -> None:
        for name, default in defaults.items():
            value = getattr(options, name)
            if value != default:
                raise SceneError(f"{_option(name)}: {value!r} with {other}; allowed: {allowed}")

    if options.tier == "layer":
        given = {"mesh": None, "precision": "auto", "device": "cpu", "extrapolate": False}
        reject("--tier layer", "--tier fem", **given)
    if options.tolerance is not None:
        reject("--tolerance", "either", mesh=None, precision="auto", extrapolate=False)
        if options.tier == "layer":
            reject("--tier layer and --tolerance", "--tier fem", error_bar=False)
    elif options.effects != "all":
        raise SceneError(
            f"--effects: {options.effects!r} without --tolerance; allowed: with one, such as "
            '"2 %", "0.05 N" or "0.5 px"'
        )
    if options.error_bar:
        reject("--error-bar", "either", extrapolate=False)


def tier_of(options: argparse.Namespace) -> Layer | Fem | Measured | Extrapolated:
    """Return the tier that the options describe, without a tolerance.

    Raises:
        SceneError: The size of an element is 0 or less.
    """
    if options.tier == "layer":
        return Measured(Layer()) if options.error_bar else Layer()
    spacing = None if options.mesh is None else metres(options.mesh)
    fem = Fem(spacing=spacing, precision=options.precision)
    if options.extrapolate:
        return Extrapolated(replace(fem, grading=FOR_EDGES))
    return Measured(fem) if options.error_bar else fem


def _add_body_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("body")
    group.add_argument(
        "--size",
        type=numbers(3),
        default=(20.0, 20.0, 4.0),
        metavar="X,Y,Z",
        help="width along x and y, and thickness [mm] (20,20,4)",
    )
    group.add_argument(
        "--dome", type=float, metavar="MM", help="radius of a spherical top [mm] (flat)"
    )
    group.add_argument(
        "--footprint",
        choices=get_args(Footprint),
        default="rectangle",
        help="outline in plan: the rectangle X by Y [mm], or the ellipse inscribed in it "
        "(%(default)s)",
    )
    group.add_argument(
        "--modulus",
        type=float,
        default=0.145,
        metavar="MPA",
        help="Young's modulus at rest [MPa] (%(default)s)",
    )
    group.add_argument(
        "--poisson",
        type=float,
        default=0.45,
        metavar="RATIO",
        help="Poisson's ratio at rest, 0 to 0.49995 (%(default)s)",
    )
    group.add_argument(
        "--density",
        type=float,
        default=1070.0,
        metavar="KG/M3",
        help="density, for inertia and gravity [kg/m^3] (%(default)s)",
    )


def _add_effect_options(parser: argparse.ArgumentParser, friction: float, viscosity: str) -> None:
    group = parser.add_argument_group("effects")
    group.add_argument(
        "--friction",
        type=float,
        default=friction,
        metavar="MU",
        help="coefficient of Coulomb friction; 0 is frictionless (%(default)s)",
    )
    group.add_argument(
        "--viscosity",
        type=branches,
        default=branches(viscosity),
        metavar="RATIO:S[,...]",
        help="relaxing branches: stiffness over the stiffness at rest, and time [s]; or none "
        f"({viscosity})",
    )
    group.add_argument(
        "--relaxes",
        choices=("all", "shear"),
        default="all",
        help="all: pressure and shear relax; shear: shear alone (%(default)s)",
    )
    group.add_argument(
        "--inertia",
        type=float,
        nargs="?",
        const=1.0,
        metavar="SCALE",
        help="simulate inertia, with the mass scaled by this factor (off; alone: 1)",
    )
    group.add_argument(
        "--gravity",
        type=numbers(3),
        nargs="?",
        const=(0.0, 0.0, -9.81),
        metavar="X,Y,Z",
        help="simulate the body's weight, with this acceleration [m/s^2] (off; alone: 0,0,-9.81)",
    )
    group.add_argument(
        "--effects",
        choices=("all", "needed"),
        default="all",
        help="needed: omit effects that together change less than a third of --tolerance "
        "(%(default)s)",
    )
    group.add_argument(
        "--plan-effects",
        action="store_true",
        help="only estimate, by coarse meshes, how much each effect changes force [%%, N] and "
        "markers [px], and its fraction of the time. With --tolerance, also report which effects "
        "would be omitted",
    )


def _add_solver_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("solver")
    group.add_argument(
        "--tier",
        choices=("layer", "fem"),
        help="layer: linear, milliseconds a step; fem: large strain, seconds to minutes (fem)",
    )
    group.add_argument(
        "--tolerance",
        metavar="ERROR",
        help='accepted error, "2 %%", "0.05 N" or "0.5 px", in place of --mesh and --precision; '
        "without --tier, uses layer if its estimated error is within it, else fem",
    )
    group.add_argument(
        "--error-bar", action="store_true", help="solve a coarser mesh too and report the error"
    )
    group.add_argument(
        "--extrapolate",
        action="store_true",
        help="solve a coarser mesh too and extrapolate the force from both",
    )
    group.add_argument(
        "--mesh",
        type=positive,
        metavar="MM",
        help="element size of fem [mm] (a sixth of the thickness)",
    )
    group.add_argument(
        "--precision",
        choices=PRECISIONS,
        default="auto",
        help="of fem; auto switches from float32 to float64 where necessary (%(default)s)",
    )
    add_device(group, "device of layer and fem")


# Fields that `--fields` can add to `--json`.
FIELDS = ("surface", "traction")


def fields(text: str) -> tuple[str, ...]:
    """Read comma-separated names from `FIELDS`."""
    chosen = names(text)
    if not set(chosen) <= set(FIELDS):
        raise argparse.ArgumentTypeError(
            f"{text!r}; allowed: one or more of {', '.join(FIELDS)} between commas"
        )
    return chosen


def _add_output_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("output")
    group.add_argument("--json", action="store_true", help="print one JSON object, no picture")
    group.add_argument(
        "--fields",
        type=fields,
        default=(),
        metavar="NAME,...",
        help="with --json, at every point of the top in every frame: surface, its displacement "
        "[m]; traction [Pa]",
    )
    group.add_argument(
        "--out", type=Path, metavar="PNG", help="picture to write (default: e.g. press-sphere.png)"
    )
    group.add_argument(
        "--save", type=Path, metavar="ZARR", help="save the whole result in this new Zarr directory"
    )
