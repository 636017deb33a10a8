"""Options of `tactile sim press` that describe its scene and its solver."""

import argparse
import inspect
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast, get_args

from recorder.command_line.options import add_device, add_value, numbers, positive, whole
from sim import indenters
from sim.device import ready_device
from sim.errors import SceneError
from sim.fem import Fem
from sim.indenters.solid import REACH, Unit, Up
from sim.layer import Layer
from sim.scene import (
    Body,
    Effects,
    Footprint,
    Friction,
    Gravity,
    Inertia,
    Motion,
    Scene,
    Viscosity,
    press,
)

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

# Shapes by measure: the parameters of each but an edge radius are its measures, lengths [mm],
# `half_angle` [deg].
SHAPES: dict[str, Callable[..., indenters.Indenter]] = {
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
# Radius of every convex edge, which each shape and file may be given.
EDGE = "edge_radius"
# Default edge radius of a shape by measure, as far as there is room. Most of the named shapes have
# the same radius, since a sharp edge is never solved reproducibly.
EDGE_MM = 0.3
# Suffixes of a file given in place of a shape, and the keys that may follow each.
FILES = {".stl": ("unit", "up", EDGE), ".yaml": (EDGE,)}


def _measures(shape: str) -> list[str]:
    """Return the names of the measures that a shape requires."""
    return [name for name in inspect.signature(SHAPES[shape]).parameters if name != EDGE]


def add_indenter_options(parser: argparse.ArgumentParser) -> None:
    """Add `--shape`, `--tilt` and `--at`."""
    group = parser.add_argument_group("indenter")
    by_measure = "; ".join(
        f"{shape}{':' if keys else ''}{','.join(f'{key}=' for key in keys)}"
        for shape, keys in ((shape, _measures(shape)) for shape in SHAPES)
    )
    group.add_argument(
        "--shape",
        default="sphere",
        metavar="NAME[:KEY=VALUE,...]",
        help=f"one of {', '.join(indenters.NAMES)}; or a shape with its measures, lengths in [mm], "
        f"angles in [deg]: {by_measure}; or an STL file, with unit={'|'.join(indenters.UNITS)} "
        f"(mm) and up={'|'.join(indenters.UPS)}, the axis that points away from the skin (+z), or "
        f"a YAML file of parts. {EDGE}= rounds every convex edge (named shapes: "
        f"their own, else {EDGE_MM} as far as there is room) (%(default)s)",
    )
    about = "tilt of the indenter, a rotation vector about x and y [deg]"
    add_value(group, "--tilt", "X,Y", (0.0, 0.0), about, numbers(2))
    about = "position of the press, from the middle of the body [mm]"
    add_value(group, "--at", "X,Y", (0.0, 0.0), about, numbers(2))


def indenter_of(options: argparse.Namespace) -> indenters.Indenter:
    """Return the indenter that the options describe, with its tilt."""
    upright = _upright(options)
    about_x, about_y = map(math.radians, options.tilt)
    return upright.tilted(about_x, about_y) if about_x or about_y else upright


def _upright(options: argparse.Namespace) -> indenters.Indenter:
    shape, texts = split_shape(options.shape)
    if Path(shape).suffix.lower() in FILES:
        return _from_file(shape, texts, options)
    sizes = {key: _si(shape, key, text) for key, text in texts.items()}
    edge = sizes.pop(EDGE, None)
    if shape in indenters.NAMES and not sizes:
        return indenters.named(shape, edge)
    if shape not in SHAPES:
        if shape in indenters.NAMES:
            raise SceneError(
                f"--shape {shape}: {sorted(sizes)[0]} given; allowed: {EDGE}, its measures are "
                "known"
            )
        allowed = dict.fromkeys((*indenters.NAMES, *SHAPES))
        raise SceneError(f"--shape: {shape!r}; allowed: {', '.join(allowed)}")
    if set(sizes) != set(_measures(shape)):
        listed = ", ".join(_measures(shape)) or "no measure"
        raise SceneError(
            f"--shape {shape}: {', '.join(sorted(sizes)) or 'nothing'} given; allowed: {listed}"
        )
    indenter = SHAPES[shape](**sizes)
    if EDGE not in inspect.signature(SHAPES[shape]).parameters:
        if edge is not None:
            raise SceneError(f"--shape {shape}: {EDGE} given; allowed: none, it has no edge")
        return indenter
    if edge is None:
        edge = min(metres(EDGE_MM), indenter.edge_radius_max)
    return replace(indenter, edge_radius=edge)


def split_shape(text: str) -> tuple[str, dict[str, str]]:
    """Return the name or file of `--shape` and the values that follow it."""
    name, colon, rest = text.rpartition(":")
    if not colon or "=" not in rest:
        return text, {}
    pairs = [part.partition("=") for part in rest.split(",")]
    values = {key: value for key, _, value in pairs}
    if len(values) < len(pairs) or not all(key and value for key, _, value in pairs):
        raise SceneError(f"--shape: {text!r}; allowed: NAME:KEY=VALUE,... with each key once")
    return name, values


def _from_file(path: str, texts: dict[str, str], options: argparse.Namespace) -> indenters.Indenter:
    for key, text in texts.items():
        keys = FILES[Path(path).suffix.lower()]
        choices = {"unit": indenters.UNITS, "up": indenters.UPS}.get(key, ()) if key in keys else ()
        if key not in keys or (choices and text not in choices):
            allowed = f"{key}={'|'.join(choices)}" if choices else ", ".join(keys)
            raise SceneError(f"--shape {path}: {key}={text}; allowed: {allowed}")
    # Warp computes distances to the file's triangles, whichever the tier.
    ready_device(options.device)
    indenter = indenters.from_stl(
        path,
        unit=cast(Unit, texts.get("unit", "mm")),
        up=cast(Up, texts.get("up", "+z")),
        edge_radius=_si(path, EDGE, texts[EDGE]) if EDGE in texts else None,
        # No press goes deeper than the body is thick.
        reach=max(REACH, metres(options.size[2])),
    )
    for note in indenter.solid.notes if indenter.solid else ():
        print(f"note: {note}", file=sys.stderr)
    return indenter


def _si(shape: str, key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise SceneError(f"--shape {shape}: {key}={text}; allowed: a number") from None
    return math.radians(value) if key == "half_angle" else metres(value)


# Most frames of a phase of a motion.
STEPS_MAX = 1000


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Add options of scene, solver and output."""
    _add_motion_options(parser)
    add_indenter_options(parser)
    _add_body_options(parser)
    _add_effect_options(parser)
    _add_solver_options(parser)
    _add_output_options(parser)


def scene_of(options: argparse.Namespace) -> Scene:
    """Return the scene that the options describe."""
    motion = motion_of(options)
    return Scene(indenter_of(options), motion, body_of(options), effects_of(options))


def motion_of(options: argparse.Namespace) -> Motion:
    """Return the motion that the options describe."""
    before = 0.0
    for index, depth in enumerate(options.depths):
        if depth == before:
            raise SceneError(
                f"--depths[{index}]: {depth!r} mm; allowed: another depth than {before!r} mm, "
                "where the tip already is"
            )
        before = depth
    return press(
        [metres(depth) for depth in options.depths],
        hold=options.hold or 0.0,
        shear=metres(options.shear or 0.0),
        angle=math.radians(options.angle),
        steps=options.steps,
        at=(metres(options.at[0]), metres(options.at[1])),
        speed=metres(options.speed),
    )


def body_of(options: argparse.Namespace) -> Body:
    """Return the body that the options describe."""
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
    """Return the effects that the options request; friction 0 requests none."""
    viscosity = None
    if options.viscosity is not None:
        ratios, times = zip(*options.viscosity, strict=True)
        viscosity = Viscosity(ratios, times, options.relaxes)
    return Effects(
        friction=None if options.friction == 0 else Friction(options.friction),
        viscosity=viscosity,
        inertia=None if options.inertia is None else Inertia(options.inertia),
        gravity=None if options.gravity is None else Gravity(options.gravity),
    )


def tier_option(text: str) -> Layer | Fem:
    """Read `layer`, `fem` or `fem:FINENESS`."""
    name, colon, fineness = text.partition(":")
    if text == "layer":
        return Layer()
    try:
        if name == "fem":
            return Fem(fineness=float(fineness)) if colon else Fem()
    except (ValueError, SceneError):
        pass
    raise argparse.ArgumentTypeError(
        f"{text!r}; allowed: layer, fem, or fem:FINENESS with a fineness of 0.1 to 10"
    )


def tier_of(options: argparse.Namespace) -> Layer | Fem:
    """Return the tier that the options name, `fem` if none; it must agree with the tolerance."""
    tier: Layer | Fem = options.tier or Fem()
    if options.tolerance is not None and tier not in (Layer(), Fem()):
        raise SceneError("--tier: fem with a fineness and --tolerance; allowed: either")
    if options.seconds is not None and options.tolerance is None:
        raise SceneError(f"--seconds: {options.seconds:g} without --tolerance; allowed: with it")
    return tier


def _add_motion_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("motion")
    add = group.add_argument
    about = "depths to go to in turn, from the touched surface [mm]"
    add_value(group, "--depths", "MM,...", (0.5, 1.0, 1.5), about, numbers())
    add(
        "--hold", type=positive, metavar="S", help="rest at the last depth for this time [s] (none)"
    )
    about = "then move sideways by this length, back, and lift [mm] (none)"
    add("--shear", type=positive, metavar="MM", help=about)
    add_value(group, "--angle", "DEG", 0.0, "direction of the shear, from x towards y [deg]")
    about = "frames of each press, hold, shear, return and lift"
    add_value(group, "--steps", "N", 1, about, whole(1, STEPS_MAX))
    about = "speed of the tip; matters to viscosity and inertia only [mm/s]"
    add_value(group, "--speed", "MM/S", 10.0, about)


def _add_body_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("body")
    about = "width along x and y, and thickness [mm]"
    add_value(group, "--size", "X,Y,Z", (20.0, 20.0, 4.0), about, numbers(3))
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
    add_value(group, "--modulus", "MPA", 0.145, "Young's modulus at rest [MPa]")
    add_value(group, "--poisson", "RATIO", 0.45, "Poisson's ratio at rest, 0 to 0.49995")
    add_value(group, "--density", "KG/M3", 1070.0, "density, for inertia and gravity [kg/m^3]")


def _add_effect_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("effects")
    add = group.add_argument
    add_value(group, "--friction", "MU", 0.0, "coefficient of Coulomb friction; 0 is frictionless")
    add(
        "--viscosity",
        type=branches,
        metavar="RATIO:S[,...]",
        help="relaxing branches: stiffness over the stiffness at rest, and time [s]; or none "
        "(none)",
    )
    about = "all: pressure and shear relax; shear: shear alone (%(default)s)"
    add("--relaxes", choices=("all", "shear"), default="all", help=about)
    about = "simulate inertia, with the mass scaled by this factor (off; alone: 1)"
    add("--inertia", type=float, nargs="?", const=1.0, metavar="SCALE", help=about)
    add(
        "--gravity",
        type=numbers(3),
        nargs="?",
        const=(0.0, 0.0, -9.81),
        metavar="X,Y,Z",
        help="simulate the body's weight, with this acceleration [m/s^2] (off; alone: 0,0,-9.81)",
    )
    add(
        "--effects",
        action="store_true",
        help="only print a table of the changes by each effect: force [%%], markers [px] and time "
        "[%%], by a coarse mesh",
    )


def _add_solver_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("solver")
    group.add_argument(
        "--tier",
        type=tier_option,
        metavar="layer|fem[:FINENESS]",
        help="layer: linear, milliseconds a step; fem: large strain, seconds to minutes, on a mesh "
        f"that follows the contact, finer with a fineness above {Fem().fineness:g} (fem)",
    )
    group.add_argument(
        "--tolerance",
        metavar="ERROR",
        help='accepted error, "2 %%", "0.05 N" or "0.5 px": measured by a second mesh, which is '
        "refined; without --tier, uses layer if its estimated error is within it, else fem",
    )
    group.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help="time [s] after which the best answer so far is given, with its error, if --tolerance "
        "is not reached (none)",
    )
    add_device(group, "device of layer and fem")


def _add_output_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("output")
    group.add_argument("--json", action="store_true", help="print one JSON object, no picture")
    group.add_argument("--out", type=Path, metavar="PNG", help="picture to write (press-SHAPE.png)")
    group.add_argument(
        "--save", type=Path, metavar="ZARR", help="save the whole result in this new Zarr directory"
    )
