"""Settings of the material-point method: numerical choices, not physical properties."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

from sim.errors import SceneError, check_range

# Largest accepted Courant number, wave speed * time step / cell. Measured: spheres pressed 2.5 mm
# into 4 mm at a Poisson's ratio of 0 to 0.49 stay bounded at 0.9; at 1.0 those at 0.45 and 0.49 do
# not.
STABLE = 0.9

# Tacchi's grid: 256 cells on 33 mm [m].
AUTHORS_CELL = 33e-3 / 256
# Tacchi's density of 1 in its units of mm, s and Pa [kg/m^3]: about 1000 times an elastomer's.
AUTHORS_DENSITY = 1e6


@dataclass(frozen=True, slots=True)
class Mpm:
    """Grid, sampling, mass, time step and contact of the `mpm` tier.

    Raises:
        SceneError: A value is outside of its allowed range.
    """

    cell: float | None = None
    """Edge of a grid cell [m]; None: an eighth of the thickness."""
    per_cell: float = 2.0
    """Particles per cell and dimension, 0.25 to 6. Below 1 neighbours are no longer coupled."""
    lattice: Literal["centred", "faces"] = "centred"
    """`centred`: half a spacing inside of every face; `faces`: outermost particles on the faces."""
    jitter: float = 0.0
    """Largest random offset of a particle along each axis, over the spacing, 0 to 0.4."""
    seed: int = 0
    """Seed of the jitter."""
    contact: Literal["coulomb", "sticky"] = "coulomb"
    """Law at grid nodes inside the indenter. `coulomb`: no approach, and friction if the scene has
    it; `sticky`: they move with the indenter, and are not released while inside."""
    reach: float = 0.25
    """Distance from the indenter up to which nodes count as inside [cells], 0 to 2. A surface
    between two nodes sinks in until the lower one is held, so 0 is too soft at every depth; 0.5 is
    far too stiff at small ones. A quarter has the least error over all depths."""
    base: Literal["grid", "particles"] = "grid"
    """`grid`: the velocity field is odd about the base plane, a plane of grid nodes, so it vanishes
    there exactly; `particles`: the lowest `base_layers` layers of particles are fixed."""
    base_layers: int = 3
    """Layers of particles that `base="particles"` fixes, 1 to 100."""
    mass_scaling: float | None = None
    """Factor on `Body.density`. None: `Inertia.scale` if the scene has inertia; else time has no
    meaning, and the mass follows from `speed_ratio`."""
    speed_ratio: float = 0.01
    """Speed of the tip over that of pressure waves in a scene without inertia, 1e-4 to 0.3. Smaller
    is closer to balance and takes longer."""
    time_step: float | None = None
    """Time step [s]; None: `safety` * cell / wave speed."""
    safety: float = 0.5
    """Courant number of the chosen time step, up to `STABLE`."""
    window: float = 3.0
    """Force is the end of a straight line fitted to the last steps before a waypoint: as many as a
    pressure wave takes for this many thicknesses, 0 to 1000 (0: the last step alone)."""
    particle_volume: float | None = None
    """Volume of a particle [m^3]; None: an equal fraction of the body's volume. Force and mass are
    proportional to it, deformation is not."""
    det_floor: float = 0.05
    """Fraction of its volume below which a compressed particle ends the simulation, 0 to 1."""
    precision: Literal["float32", "float64"] = "float32"
    """Precision of everything but the sums on the grid, which are 64-bit integers."""

    def __post_init__(self) -> None:
        for name, allowed in (
            ("lattice", ("centred", "faces")),
            ("contact", ("coulomb", "sticky")),
            ("base", ("grid", "particles")),
            ("precision", ("float32", "float64")),
        ):
            if getattr(self, name) not in allowed:
                raise SceneError(
                    f"mpm.{name}: {getattr(self, name)!r}; allowed: "
                    + ", ".join(repr(word) for word in allowed)
                )
        for name, low, high, unit in (
            ("cell", 1e-6, 1.0, "m"),
            ("mass_scaling", 1e-12, 1e12, ""),
            ("time_step", 1e-12, 1.0, "s"),
            ("particle_volume", 1e-24, 1.0, "m^3"),
        ):
            value = getattr(self, name)
            if value is not None:
                check_range("mpm", name, value, low, high, unit=unit)
        check_range("mpm", "per_cell", self.per_cell, 0.25, 6.0)
        check_range("mpm", "jitter", self.jitter, 0.0, 0.4)
        check_range("mpm", "reach", self.reach, 0.0, 2.0, unit="cells")
        check_range("mpm", "base_layers", self.base_layers, 1, 100)
        check_range("mpm", "speed_ratio", self.speed_ratio, 1e-4, 0.3)
        check_range("mpm", "safety", self.safety, 0.0, STABLE, open_low=True)
        check_range("mpm", "window", self.window, 0.0, 1000.0)
        check_range("mpm", "det_floor", self.det_floor, 0.0, 1.0)

    @classmethod
    def authors(cls, *, spacing: float = 0.2e-3, density: float = 1070.0) -> Self:
        """Return Tacchi's settings, which GenForce adopted: a lattice coarser than its grid.

        Particles are 0.2 mm apart on a grid of 0.129 mm (0.27 particles a cell); contact is sticky,
        and the lowest three layers are fixed. The time step is 1e-4 s, a particle's volume
        (cell / 2)^2 is meant for two dimensions, and the density is 1 g/mm^3 (waves at 0.74 m/s in
        the paper's gel). Not adopted: particles for the indenter (here its distance function) and
        the corotated law, which differs from `Body`'s by second order in the strain.

        Args:
            spacing: Distance between particles [m].
            density: `Body.density` of the scene, to which the mass scaling is relative [kg/m^3].
        """
        return cls(
            cell=AUTHORS_CELL,
            per_cell=AUTHORS_CELL / spacing,
            lattice="faces",
            contact="sticky",
            reach=0.0,
            base="particles",
            mass_scaling=AUTHORS_DENSITY / density,
            time_step=1e-4,
            # In millimetres, where the formula's missing dimension is a length of 1.
            particle_volume=(AUTHORS_CELL * 1e3 / 2) ** 2 * 1e-9,
        )

    @classmethod
    def authors_released(cls, *, density: float = 1070.0) -> Self:
        """Return GenForce's released settings: 0.25 mm between particles (0.14 per cell).

        They are for a body of 25 x 25 x 5 mm and a tip at 40 mm/s. Argument as in `authors`.
        """
        return cls.authors(spacing=0.25e-3, density=density)
