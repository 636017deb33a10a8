"""Finite elements at large strain: the most accurate tier.

Here are the settings, numerical choices and not physical properties; the solver, which needs Warp,
is in `sim.fem.solver`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, get_args

from sim.errors import check_choice, check_kind, check_range, make_plain

if TYPE_CHECKING:
    from sim.scene import Body

# Growth of the elements of a mesh in plan, outwards from the contacts.


@dataclass(frozen=True, slots=True)
class Grading:
    """Sides of elements in plan; they do not depend on the depth.

    Raises:
        SceneError: A value is outside of its allowed range.
    """

    finer: float = 1.0
    """Side of the finest elements over their mean height."""
    growth: float = 0.15
    """Increase of element length over the fine ones, per distance from the window."""
    coarsest: float = 0.25
    """Longest element, in thicknesses (where the fine ones are shorter): about half the length over
    which an indentation of a bonded layer decays."""

    def __post_init__(self) -> None:
        make_plain(self)
        check_range("grading", "finer", self.finer, 0.1, 1.0)
        check_range("grading", "growth", self.growth, 0.0, 1.0)
        check_range("grading", "coarsest", self.coarsest, 0.0, 2.0, open_low=True)


# For indenters with edges, which need fine elements in plan but not over the depth. Under a cone,
# tube, box, bar, triangle and sphere, elements of 0.32 mm by 0.8 mm height have 3.6 % of error in
# force where 0.667 mm along all axes has 7.6 %, in 1.6 times the time.
FOR_EDGES = Grading(finer=0.4, growth=0.7, coarsest=0.5)


# Elements through the thickness if no spacing is given and the mesh does not follow the contact.
SPACING_SHARE = 6
# More elements than this need more than 10 GB for one press.
CELLS_MAX = 4_000_000

# Most elements of a mesh that follows the contact, if not set.
ELEMENTS_DEFAULT = {"cpu": 40_000, "cuda": 160_000}
# Largest contact stiffness: beyond it a state has too few digits.
PENALTY_MOST = 1e6
# Least fineness of a mesh that follows the contact: about one element from side to side.
FINENESS_LEAST = 0.1

# `auto` begins in float32 and falls back to float64 where that has too few digits.
Precision = Literal["auto", "float32", "float64"]


@dataclass(frozen=True, slots=True)
class Fem:
    """Mesh, precision, tolerances and step control of the `fem` tier.

    Raises:
        SceneError: A value is outside of its allowed range.
    """

    spacing: float | None = None
    """Edge length of elements under the indenter, and their height [m]. None: the mesh follows the
    contact (`sim.fem.sizing`), unless `grading` is given; then a sixth of the thickness."""
    fineness: float = 0.8
    """Resolution of a mesh that follows the contact: 12 elements times this from one side of a
    contact to the other. Twice as fine takes 15 times as long and has a quarter of the error."""
    elements_max: int | None = None
    """Most elements of a mesh that follows the contact. If it would need more, all elements are
    enlarged by the same factor, and the result has a warning. None: 40,000 on a CPU and 160,000 on
    a GPU, which takes little longer for them."""
    grading: Grading | None = None
    """Growth from a window around all that the indenter covers, instead of following the contact;
    with `spacing`, `Grading()` by default."""
    one_topology: bool = False
    """Give all meshes that a process solves in one call as many elements as the largest of them:
    more elements, but all presses in one launch, which suits a GPU. No mesh becomes coarser."""
    precision: Precision = "auto"
    """`auto` begins in float32 and falls back to float64 if float32 cannot reach the tolerance."""
    tolerance: float = 1e-4
    """Out-of-balance nodal force over contact force (l2 norms) at which a state is accepted."""
    path_tolerance: float | None = None
    """Tolerance between waypoints, never below `tolerance`. None: 0.001 with viscosity or inertia,
    else 0.01, which changes the forces of shear with friction by at most 0.1 %."""
    stiffening: float = 0.0
    """Stiffening of skin that is strained far, over its shear modulus, per isochoric invariant
    beyond 4 (`sim.fem.element`); 0: none, a neo-Hookean skin. Where there is no solution without,
    forces are extrapolated from two such solutions, and that correction is in the error."""
    penalty: float = 200.0
    """Contact stiffness in modulus per thickness. A soft contact is fast; `augmentations` remove
    the error that it causes."""
    augmentations: int = 2
    """Times that a waypoint is solved again with updated multipliers, which reduces penetration:
    with 0 the force is up to 5 % low, with 2 it is within 0.4 %."""
    newton_max: int = 60
    """Newton iterations after which a step is halved; six times as many after an update of the
    multipliers, which a shorter step would not avoid."""
    cg_max: int = 4000
    """Most conjugate-gradient iterations per Newton step."""
    step_travel: float | None = None
    """Longest step of the tip [m]; at most half the sharpest radius of the indenter (or a fiftieth
    of the thickness), because a longer one may put skin on the wrong side of an edge. None: with
    friction at most a fortieth of the thickness."""
    step_factor: int | None = None
    """Factor on the number of steps to each waypoint. None: 1, and with inertia up to 4, as an
    error by time steps of 2 % needs (`sim.fem.in_time`)."""
    halvings: int = 12
    """Times that a step is halved before the solver fails."""

    def __post_init__(self) -> None:
        make_plain(self)
        check_choice("fem.precision", self.precision, get_args(Precision))
        check_kind("fem.one_topology", self.one_topology, bool, "True or False")
        if self.grading is not None:
            check_kind("fem.grading", self.grading, Grading, "a Grading or None")
        for name in ("augmentations", "newton_max", "cg_max", "halvings"):
            check_kind(f"fem.{name}", getattr(self, name), int, "a whole number")
        for name in ("spacing", "step_travel"):
            value = getattr(self, name)
            if value is not None:
                check_range("fem", name, value, 0.0, 1.0, unit="m", open_low=True)
        check_range("fem", "fineness", self.fineness, FINENESS_LEAST, 10.0)
        if self.elements_max is not None:
            check_range("fem", "elements_max", self.elements_max, 1000, CELLS_MAX)
        check_range("fem", "tolerance", self.tolerance, 1e-15, 0.1)
        if self.path_tolerance is not None:
            check_range("fem", "path_tolerance", self.path_tolerance, 1e-15, 0.1)
        check_range("fem", "augmentations", self.augmentations, 0, 20)
        check_range("fem", "stiffening", self.stiffening, 0.0, 100.0)
        check_range("fem", "penalty", self.penalty, 1.0, PENALTY_MOST)
        check_range("fem", "newton_max", self.newton_max, 1, 10_000)
        check_range("fem", "cg_max", self.cg_max, 1, 1_000_000)
        if self.step_factor is not None:
            check_kind("fem.step_factor", self.step_factor, int, "a whole number or None")
            check_range("fem", "step_factor", self.step_factor, 1, 1000)
        check_range("fem", "halvings", self.halvings, 0, 60)

    def height(self, body: Body) -> float:
        """Return the height of elements if the mesh does not follow the contact [m]."""
        return body.thickness / SPACING_SHARE if self.spacing is None else self.spacing

    @property
    def follows(self) -> bool:
        """True if the mesh follows the contact."""
        return self.spacing is None and self.grading is None


# Settings for presses that have no solution by the first ones.

# Elements of the second attempt, over those of the first, where an indenter passes through them.
FINER = 0.6


def further_settings(first: Fem, body: Body) -> list[tuple[str, Fem, bool]]:
    """Return the settings to try after the first ones.

    Each has a description, and True if it is for presses whose indenter passes through the skin, or
    False if for others.
    """
    assert first.spacing is not None
    careful = replace(
        first, precision="float64", step_travel=body.thickness / 100, newton_max=120, halvings=16
    )
    finer = replace(first, spacing=FINER * first.spacing)
    return [
        ("steps of 1/100 of the thickness, float64", careful, False),
        (f"elements {FINER:g} times as large", finer, True),
    ]
