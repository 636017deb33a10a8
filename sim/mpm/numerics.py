"""The numbers of the material-point method: what is chosen, not what is physical."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

from sim.errors import SceneError, check_range

# Largest Courant number, wave speed * time step / cell, that is let through. Measured: spheres
# pressed 2.5 mm into 4 mm at a Poisson's ratio of 0 to 0.49 stay bounded at 0.9; at 1.0 those at
# 0.45 and 0.49 do not.
STABLE = 0.9

# Tacchi's grid: 256 cells on 33 mm [m].
AUTHORS_CELL = 33e-3 / 256
# Tacchi's density of 1 in its units of mm, s and Pa [kg/m^3]: some 1000 times an elastomer's.
AUTHORS_DENSITY = 1e6


@dataclass(frozen=True, slots=True)
class MpmNumerics:
    """Grid, sampling, mass, time step and contact of the `mpm` tier.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    cell: float | None = None
    """Edge of a grid cell [m]; None is an eighth of the thickness."""
    per_cell: float = 2.0
    """Particles per cell and dimension, 0.25 to 6. Below 1 neighbours lose touch of each other."""
    lattice: Literal["centred", "faces"] = "centred"
    """`centred`: half a spacing inside of every face; `faces`: outermost particles on the faces."""
    jitter: float = 0.0
    """Each particle is moved by up to this share of the spacing along each axis, 0 to 0.4."""
    seed: int = 0
    """Of the jitter."""
    contact: Literal["coulomb", "sticky"] = "coulomb"
    """What holds on grid nodes inside the indenter: `coulomb`: no approach, and friction if the
    scene has it; `sticky`: they move with the indenter, and never let go while inside."""
    reach: float = 0.25
    """Nodes this close to the indenter count as inside [cells], 0 to 2. A surface between two nodes
    sinks in until the lower is held, so 0 is too soft at every depth; 0.5 is far too stiff at small
    ones. A quarter is least wrong over all depths."""
    base: Literal["grid", "particles"] = "grid"
    """`grid`: the velocity field is odd about the base plane, a plane of grid nodes: it vanishes
    there exactly; `particles`: the lowest `base_layers` layers of particles stand still."""
    base_layers: int = 3
    """Layers of particles that `base="particles"` holds, 1 to 100."""
    mass_scaling: float | None = None
    """Factor on `Body.density`. None: `Inertia.scale` where the scene has inertia; elsewhere time
    means nothing, and the mass follows from `speed_ratio`."""
    speed_ratio: float = 0.01
    """Speed of the tip over that of pressure waves at which a scene without inertia is walked, 1e-4
    to 0.3. Smaller is nearer to balance and takes longer."""
    time_step: float | None = None
    """Time step [s]; None is `safety` * cell / wave speed."""
    safety: float = 0.5
    """Courant number of the chosen time step, up to `STABLE`."""
    window: float = 3.0
    """Force is the end of a straight line fitted to the last steps before a waypoint: as many as a
    pressure wave takes for this many thicknesses, 0 to 1000 (0: the last step alone)."""
    particle_volume: float | None = None
    """Volume of a particle [m^3]; None is the body's volume shared out. Force and mass are
    proportional to it, deformation is not."""
    det_floor: float = 0.05
    """A particle compressed below this share of its volume ends the simulation, 0 to 1."""
    precision: Literal["float32", "float64"] = "float32"
    """Of everything but the sums on the grid, which are 64-bit integers."""

    def __post_init__(self) -> None:
        for name, allowed in (
            ("lattice", ("centred", "faces")),
            ("contact", ("coulomb", "sticky")),
            ("base", ("grid", "particles")),
            ("precision", ("float32", "float64")),
        ):
            if getattr(self, name) not in allowed:
                raise SceneError(
                    f"numerics.{name}: {getattr(self, name)!r}; allowed: "
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
                check_range("numerics", name, value, low, high, unit=unit)
        check_range("numerics", "per_cell", self.per_cell, 0.25, 6.0)
        check_range("numerics", "jitter", self.jitter, 0.0, 0.4)
        check_range("numerics", "reach", self.reach, 0.0, 2.0, unit="cells")
        check_range("numerics", "base_layers", self.base_layers, 1, 100)
        check_range("numerics", "speed_ratio", self.speed_ratio, 1e-4, 0.3)
        check_range("numerics", "safety", self.safety, 0.0, STABLE, open_low=True)
        check_range("numerics", "window", self.window, 0.0, 1000.0)
        check_range("numerics", "det_floor", self.det_floor, 0.0, 1.0)

    @classmethod
    def authors(cls, *, spacing: float = 0.2e-3, density: float = 1070.0) -> Self:
        """Tacchi's choices, which GenForce took over: a lattice wider than the grid it moves on.

        0.2 mm between particles on a grid of 0.129 mm (0.27 particles a cell), sticky contact, the
        lowest three layers held, time step 1e-4 s, a volume (cell / 2)^2 meant for two dimensions,
        a density of 1 g/mm^3 (waves at 0.74 m/s in the paper's gel). Not taken over: particles for
        the indenter (ours is its distance function) and the corotated law, which differs from
        `Body`'s by second order in the strain.

        Args:
            spacing: Between particles [m].
            density: `Body.density` of the scene, which the mass scaling is relative to [kg/m^3].
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
        """GenForce's released parameters: the lattice 0.25 mm wide (0.14 particles a cell).

        They go with a body 25 x 25 x 5 mm and a tip at 40 mm/s. Argument as for `authors`.
        """
        return cls.authors(spacing=0.25e-3, density=density)
