"""The numbers of the finite-element solver: what is chosen, not what is physical."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from sim.errors import SceneError, check_kind, check_range

if TYPE_CHECKING:
    from sim.scene import Body

# How the elements of a mesh grow outwards in plan from where the indenter comes.


@dataclass(frozen=True, slots=True)
class Grading:
    """Sides of elements in plan; they do not depend on the depth.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    finer: float = 1.0
    """Side of the finest elements over their mean height."""
    growth: float = 0.15
    """How much longer an element is than the fine ones, per distance from the window."""
    coarsest: float = 0.25
    """Longest element, in thicknesses (where the fine ones are shorter): about half the length over
    which a bonded layer forgets what is pressed into it."""

    def __post_init__(self) -> None:
        check_range("grading", "finer", self.finer, 0.1, 1.0)
        check_range("grading", "growth", self.growth, 0.0, 1.0)
        check_range("grading", "coarsest", self.coarsest, 0.0, 2.0, open_low=True)


# For indenters with edges, which need fine elements in plan but not over the depth: under a cone,
# tube, box, bar, triangle and sphere, 0.32 mm by 0.8 mm high makes 3.6 % of error in force where
# 0.667 mm along all axes makes 7.6 %, in 1.6 times the time.
FOR_EDGES = Grading(finer=0.4, growth=0.7, coarsest=0.5)


# Elements through the thickness where no spacing is given and the mesh follows no contact.
SPACING_SHARE = 6
# More elements than this need more than 10 GB for one press.
CELLS_MAX = 4_000_000

# Iterations from one elastic part of the tangent to the next, where it is kept and steps go well:
# contact, which is taken anew each time, changes more (docs/decisions/0016).
ELASTIC_EVERY = 2

# `auto` begins in float32 and goes on in float64 where that lacks digits.
Precision = Literal["auto", "float32", "float64"]


@dataclass(frozen=True, slots=True)
class Numerics:
    """Mesh, precision, tolerances and step control of the `fem` tier.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    spacing: float | None = None
    """Edge of an element where the indenter comes, and its height [m]. None: the mesh follows the
    contact (`sim.fem.sizing`), unless `grading` is given or `graded` is not; then a sixth of the
    thickness."""
    fineness: float = 0.75
    """Elements of a mesh that follows the contact: 12 of them times this from one side of a contact
    to the other. Twice as fine costs 15 times the time and leaves a quarter of the error."""
    elements_max: int = 40_000
    """Most elements of a mesh that follows the contact; where it would take more, all of them
    become larger alike, and the result says so."""
    graded: bool = True
    """Whether elements grow outwards from where the indenter comes; else all are alike."""
    grading: Grading | None = None
    """How they grow from a window around all that the indenter covers, in place of following the
    contact; with `spacing`, `Grading()` unless given."""
    one_topology: bool = False
    """Whether graded meshes of one call get as many elements as the largest of them: more elements,
    but all presses in one launch, which is what a GPU wants. No mesh becomes coarser."""
    precision: Precision = "auto"
    """`auto` begins in float32 and goes on in float64 where float32 cannot reach the tolerance."""
    tolerance: float = 1e-4
    """Out-of-balance nodal force over contact force (l2 norms) at which a state is accepted."""
    path_tolerance: float | None = None
    """The same between waypoints, never below `tolerance`. None: 0.001 with viscosity or inertia,
    else 0.01, which moves the forces of shear with friction by 0.1 % at most."""
    penalty: float = 200.0
    """Contact stiffness in modulus per thickness. Soft is quick; the error it makes is taken away
    by `augmentations`."""
    augmentations: int = 2
    """How often a waypoint is solved again with the pressure found, which needs less penetration:
    with 0 the force is up to 5 % low, with 2 it is within 0.4 %."""
    stick: float = 0.5
    """Stiffness of sticking over `penalty`: the springs that hold a point before it slips give by
    1/100 of the thickness when the shear traction equals the modulus."""
    contact_points: int = 2
    """Gauss points along each edge of a contact face, 1 to 6."""
    newton_max: int = 60
    """Newton iterations after which a step is cut in half."""
    cg_max: int = 4000
    """Conjugate-gradient iterations of one Newton step."""
    det_floor: float = 0.05
    """Smallest determinant of the deformation gradient that is accepted."""
    step_travel: float | None = None
    """Longest step of the tip [m], but never more than half the sharpest radius of the indenter (or
    a fiftieth of the thickness): a longer one may put skin on the wrong side of an edge. None: with
    friction a fortieth of the thickness at most."""
    halvings: int = 12
    """How often a step is cut in half before the solver gives up."""

    def __post_init__(self) -> None:
        if self.precision not in ("auto", "float32", "float64"):
            raise SceneError(
                f"numerics.precision: {self.precision!r}; allowed: 'auto', 'float32', 'float64'"
            )
        for name in ("graded", "one_topology"):
            check_kind(f"numerics.{name}", getattr(self, name), bool, "True or False")
        if self.grading is not None:
            check_kind("numerics.grading", self.grading, Grading, "a Grading or None")
        for name in ("augmentations", "contact_points", "newton_max", "cg_max", "halvings"):
            check_kind(f"numerics.{name}", getattr(self, name), int, "a whole number")
        for name in ("spacing", "step_travel"):
            value = getattr(self, name)
            if value is not None:
                check_range("numerics", name, value, 0.0, 1.0, unit="m", open_low=True)
        check_range("numerics", "fineness", self.fineness, 0.1, 10.0)
        check_range("numerics", "elements_max", self.elements_max, 1000, CELLS_MAX)
        check_range("numerics", "tolerance", self.tolerance, 1e-15, 0.1)
        if self.path_tolerance is not None:
            check_range("numerics", "path_tolerance", self.path_tolerance, 1e-15, 0.1)
        check_range("numerics", "augmentations", self.augmentations, 0, 20)
        check_range("numerics", "penalty", self.penalty, 1.0, 1e6)
        check_range("numerics", "stick", self.stick, 1e-6, 1.0)
        check_range("numerics", "det_floor", self.det_floor, 0.0, 1.0)
        check_range("numerics", "contact_points", self.contact_points, 1, 6)
        check_range("numerics", "newton_max", self.newton_max, 1, 10_000)
        check_range("numerics", "cg_max", self.cg_max, 1, 1_000_000)
        check_range("numerics", "halvings", self.halvings, 0, 60)

    def height(self, body: Body) -> float:
        """Of elements where the mesh does not follow the contact [m]."""
        return body.thickness / SPACING_SHARE if self.spacing is None else self.spacing

    @property
    def follows(self) -> bool:
        """Whether the mesh follows the contact."""
        return self.spacing is None and self.graded and self.grading is None
