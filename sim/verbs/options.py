"""Options that every verb which simulates has, and the scene that they describe."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from sim.body import Body
from sim.effects import Effects, Friction, Gravity, Inertia, Viscosity
from sim.errors import SceneError
from sim.verbs.indenter_options import add_indenter_options
from sim.verbs.numbers import branches, metres, numbers

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics

    Verbs = argparse._SubParsersAction[argparse.ArgumentParser]

PRECISIONS = ("auto", "float32", "float64")


def add_scene_options(
    parser: argparse.ArgumentParser, *, friction: float = 0.0, viscosity: str = "none"
) -> None:
    """Indenter, body, effects, numerics and output; `friction`, `viscosity` are the defaults."""
    add_indenter_options(parser)
    _add_body_options(parser)
    _add_effect_options(parser, friction, viscosity)
    _add_solver_options(parser)
    _add_output_options(parser)


def add_speed(group: argparse._ArgumentGroup) -> None:
    """The option of verbs whose tip moves at one speed."""
    group.add_argument(
        "--speed",
        type=float,
        default=10.0,
        metavar="MM/S",
        help="speed of the tip, felt by viscosity and inertia only [mm/s] (%(default)s)",
    )


def check_motion(options: argparse.Namespace, units: dict[str, str]) -> None:
    """Refuse measures of a motion, named with their units, that are not above 0; and its steps.

    Raises:
        SceneError: Names the option, what was given and what is allowed.
    """
    for name, unit in units.items():
        value = getattr(options, name)
        if not (math.isfinite(value) and value > 0):
            raise SceneError(f"--{name}: {value!r} {unit}; allowed: above 0")
    if not 1 <= options.steps <= 1000:
        raise SceneError(f"--steps: {options.steps!r}; allowed: 1 to 1000")


def body_of(options: argparse.Namespace) -> Body:
    """The body that the options describe.

    Raises:
        SceneError: A value outside of what is allowed.
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
    )


def effects_of(options: argparse.Namespace) -> Effects:
    """The effects that the options ask for; friction 0 asks for none.

    Raises:
        SceneError: A value outside of what is allowed.
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


def numerics_of(options: argparse.Namespace) -> Numerics | None:
    """The numerics of tier `fem` that the options ask for; None for `layer` or a tolerance.

    Raises:
        SceneError: An option that tier `layer` or a tolerance does not have.
    """
    if options.tolerance is not None:
        for name, default in (("tier", None), ("mesh", None), ("precision", "auto")):
            if getattr(options, name) != default:
                raise SceneError(
                    f"--{name}: {getattr(options, name)!r} with --tolerance; allowed: either"
                )
        return None
    if options.tier == "layer":
        for name, default in (("mesh", None), ("precision", "auto"), ("device", "cpu")):
            if getattr(options, name) != default:
                raise SceneError(
                    f"--{name}: {getattr(options, name)!r} with --tier layer; allowed: --tier fem"
                )
        return None
    from sim.fem.grading import FOR_EDGES, Grading
    from sim.fem.numerics import Numerics

    if options.mesh is not None and not options.mesh > 0:
        raise SceneError(f"--mesh: {options.mesh!r} mm; allowed: above 0")
    spacing = None if options.mesh is None else metres(options.mesh)
    grading = FOR_EDGES if options.extrapolate else Grading()
    return Numerics(spacing=spacing, precision=options.precision, grading=grading)


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
        help="branches that relax: stiffness over the stiffness at rest, and time [s]; or none "
        f"({viscosity})",
    )
    group.add_argument(
        "--relaxes",
        choices=("all", "shear"),
        default="all",
        help="whether pressure relaxes as well, or shear alone (%(default)s)",
    )
    group.add_argument(
        "--inertia",
        type=float,
        nargs="?",
        const=1.0,
        metavar="SCALE",
        help="let mass resist, scaled by this factor (off; alone: 1)",
    )
    group.add_argument(
        "--gravity",
        type=numbers(3),
        nargs="?",
        const=(0.0, 0.0, -9.81),
        metavar="X,Y,Z",
        help="let the body have weight, this acceleration [m/s^2] (off; alone: 0,0,-9.81)",
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
        help='the error that is accepted, "2 %%", "0.05 N" or "0.5 px": in place of --tier, '
        "--mesh and --precision, the cheapest that keeps it",
    )
    group.add_argument(
        "--error-bar", action="store_true", help="solve a coarser mesh too, and tell the error"
    )
    group.add_argument(
        "--extrapolate",
        action="store_true",
        help="solve a coarser mesh too, and tell the force that both lead to",
    )
    group.add_argument(
        "--mesh",
        type=float,
        metavar="MM",
        help="edge of an element of fem [mm] (a sixth of the thickness)",
    )
    group.add_argument(
        "--precision",
        choices=PRECISIONS,
        default="auto",
        help="of fem; auto goes from float32 to float64 where it must (%(default)s)",
    )
    group.add_argument(
        "--device", default="cpu", help="where fem runs: cpu, or cuda:0 and the like (%(default)s)"
    )


def _add_output_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("output")
    group.add_argument("--json", action="store_true", help="print one JSON object, no picture")
    group.add_argument(
        "--out", type=Path, metavar="PNG", help="picture to write (default: VERB-SHAPE.png)"
    )
    group.add_argument(
        "--save", type=Path, metavar="ZARR", help="keep everything in this new Zarr directory"
    )
