"""The `mpm` tier: explicit MLS-MPM on a background grid, the paper's own method, well sampled.

Here are the settings, ours and the published ones to compare with; the solver, which needs Warp, is
in `sim.mpm.solver`.
"""

from dataclasses import dataclass
from typing import Literal, Self

from sim.errors import SceneError, check_choice, check_range, make_plain
from sim.scene import Body

# Our settings. Particles per cell and dimension.
PER_CELL = 2.0
# Distance from the indenter up to which nodes count as inside [cells]. A surface between two nodes
# sinks in until the lower one is held, so 0 is too soft at every depth; 0.5 is far too stiff at
# small ones. A quarter has the least error over all depths.
REACH = 0.25
# Speed of the tip over that of pressure waves in a scene without inertia. Smaller is closer to
# balance and takes longer.
SPEED_RATIO = 0.01
# Courant number of the time step, wave speed * time step / cell; and the largest that is accepted.
# Spheres pressed 2.5 mm into 4 mm at a Poisson's ratio of 0 to 0.49 stay bounded at 0.9; at 1.0
# those at 0.45 and 0.49 do not.
SAFETY, STABLE = 0.5, 0.9

# Both. Force is the end of a straight line fitted to the last steps before a waypoint: as many as a
# pressure wave takes for this many thicknesses.
WINDOW = 3.0
# Fraction of its volume below which a compressed particle ends the simulation.
DET_FLOOR = 0.05

# The published settings. Tacchi's grid: 256 cells on 33 mm [m].
AUTHORS_CELL = 33e-3 / 256
# Density of 1 in Tacchi's units of mm, s and Pa [kg/m^3]: about 1000 times an elastomer's.
AUTHORS_DENSITY = 1e6
# Volume of a particle [m^3], (cell / 2)^2: in millimetres, where the formula's missing dimension is
# a length of 1.
AUTHORS_VOLUME = (AUTHORS_CELL * 1e3 / 2) ** 2 * 1e-9
# Time step [s], and the layers of particles that are fixed.
AUTHORS_STEP, AUTHORS_LAYERS = 1e-4, 3
# Distance between particles [m].
AUTHORS_SPACING = {"tacchi": 0.2e-3, "genforce": 0.25e-3}


@dataclass(frozen=True, slots=True)
class Mpm:
    """Grid of the `mpm` tier, or published settings.

    Ours have two particles per cell and dimension half a spacing inside of every face, no approach
    of nodes inside the indenter and the scene's friction there, and a velocity that vanishes at the
    base exactly. Without inertia time has no meaning, and the mass follows from the speed of the
    tip.

    Raises:
        SceneError: A value is outside of its allowed range.
    """

    cell: float | None = None
    """Edge of a grid cell [m]; None: an eighth of the thickness, or the published one."""
    published: Literal["tacchi", "genforce"] | None = None
    """Published settings in place of ours: Tacchi's (see `authors`), or those that GenForce
    released, with 0.25 mm between particles (0.14 per cell), for a body of 25 x 25 x 5 mm and a tip
    at 40 mm/s."""
    precision: Literal["float32", "float64"] = "float32"
    """Precision of everything but the sums on the grid, which are 64-bit integers."""

    def __post_init__(self) -> None:
        make_plain(self)
        check_choice("mpm.published", self.published, (*AUTHORS_SPACING, None))
        check_choice("mpm.precision", self.precision, ("float32", "float64"))
        if self.cell is not None:
            check_range("mpm", "cell", self.cell, 1e-6, 1.0, unit="m")
            if self.published is not None:
                raise SceneError(f"mpm.cell: {self.cell!r} m; allowed with published: None")

    @classmethod
    def authors(cls) -> Self:
        """Return Tacchi's settings, which GenForce adopted: a lattice coarser than its grid.

        Particles are 0.2 mm apart on a grid of 0.129 mm (0.27 particles a cell), the outermost on
        the faces; nodes inside the indenter move with it and are not released, and the lowest three
        layers are fixed. The time step is 1e-4 s, a particle's volume (cell / 2)^2 is meant for two
        dimensions, and the density is 1 g/mm^3 (waves at 0.74 m/s in the paper's gel). Not adopted:
        particles for the indenter (here its distance function) and the corotated law, which differs
        from `Body`'s by second order in the strain.
        """
        return cls(published="tacchi")

    @property
    def per_cell(self) -> float:
        """Particles per cell and dimension. Below 1 neighbours are no longer coupled."""
        if self.published is None:
            return PER_CELL
        return AUTHORS_CELL / AUTHORS_SPACING[self.published]

    def cell_in(self, body: Body) -> float:
        """Return the edge of a grid cell in a body [m]."""
        if self.published is not None:
            return AUTHORS_CELL
        return body.thickness / 8 if self.cell is None else self.cell
