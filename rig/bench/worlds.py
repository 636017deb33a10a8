"""Settings of a mock bench's World: what presses on what, and what its sensors show.

The closed-form contact of the analytic World stands here as well, as its settings are checked by
the range of its formulas: a flat circular punch by Hayes' table, a sphere by Dimitriadis' series;
a rigid disc on a layer over rock for shear. Nothing here has a state or knows time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

if TYPE_CHECKING:
    from rig.mock.world.picture import Surface


_HAYES_RATIO = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.5, 2.0])


_HAYES_POISSON = np.array([0.30, 0.40, 0.45, 0.49, 0.50])


_HAYES = np.array(
    [
        [1.0, 1.0, 1.0, 1.0, 1.0],
        [1.2066, 1.2323, 1.2523, 1.2741, 1.2806],
        [1.4726, 1.5422, 1.5993, 1.6638, 1.6837],
        [1.7848, 1.9178, 2.0328, 2.1694, 2.2129],
        [2.1260, 2.3402, 2.5354, 2.7796, 2.8602],
        [2.4835, 2.7938, 3.0914, 3.4840, 3.6187],
        [3.4090, 4.0100, 4.6576, 5.6322, 6.0030],
        [4.3532, 5.2985, 6.4206, 8.3370, 9.1494],
    ]
)
# Stiffening of a bonded layer under a flat punch, rows a/h, columns Poisson's ratio (Hayes et al.
# 1972, recomputed from the integral equation; a/h = 0 is the half-space).


@dataclass(frozen=True, slots=True)
class Layer:
    """A soft layer, glued to a rigid base.

    Raises:
        ValueError: A value outside the range of the formulas.
    """

    modulus: float = field(metadata={"unit": "kpa"})
    """Young's modulus [Pa]."""
    thickness: float = field(metadata={"unit": "mm"})
    """Thickness [m]."""
    poisson: float = 0.45
    """Poisson's ratio, 0.30 to 0.50."""

    def __post_init__(self) -> None:
        """Refuse what the formulas do not cover."""
        if not self.modulus > 0 or not self.thickness > 0:
            raise ValueError("modulus and thickness: allowed: above 0")
        if not 0.30 <= self.poisson <= 0.50:
            raise ValueError(f"poisson: {self.poisson!r}; allowed: 0.30 to 0.50 (Hayes' table)")

    @property
    def shear_modulus(self) -> float:
        """E / (2 (1 + nu)) [Pa]."""
        return self.modulus / (2 * (1 + self.poisson))

    def disc_shear_stiffness(self, radius: float) -> float:
        """Force per sideways displacement of a disc stuck to the surface [N/m].

        8 G a / (2 - nu) on a half-space (Johnson 1985, 3.7), times 1 + a / (2 h) for a layer over
        rock (Gazetas 1983); good for a / h below about 0.5, a few per cent above.
        """
        return (
            8
            * self.shear_modulus
            * radius
            / (2 - self.poisson)
            * (1 + radius / (2 * self.thickness))
        )


@dataclass(frozen=True, slots=True)
class Punch:
    """A flat-ended circular punch."""

    KIND: ClassVar[str] = "punch"

    radius: float = field(metadata={"unit": "mm"})
    """Radius [m]."""

    def contact_radius(self, layer: Layer, depth: float) -> float:
        """Radius of the contact [m]: that of the punch."""
        return self.radius

    def force(self, layer: Layer, depth: float) -> float:
        """Normal force at `depth` [N]: 2 E a d kappa / (1 - nu^2), kappa from Hayes' table.

        Beyond a/h = 2, where the table ends, kappa is held.
        """
        if depth <= 0:
            return 0.0
        ratio = self.radius / layer.thickness
        by_poisson = [
            float(np.interp(ratio, _HAYES_RATIO, _HAYES[:, k])) for k in range(len(_HAYES_POISSON))
        ]
        kappa = float(np.interp(layer.poisson, _HAYES_POISSON, by_poisson))
        return 2 * layer.modulus * self.radius * depth * kappa / (1 - layer.poisson**2)


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball."""

    KIND: ClassVar[str] = "sphere"

    radius: float = field(metadata={"unit": "mm"})
    """Radius [m]."""

    def contact_radius(self, layer: Layer, depth: float) -> float:
        """Hertz: sqrt(R d) [m]."""
        return math.sqrt(self.radius * max(depth, 0.0))

    def force(self, layer: Layer, depth: float) -> float:
        """Normal force at `depth` [N], Hertz times Dimitriadis' series for a bonded layer.

        Dimitriadis et al. 2002; against the exact solution 3 % low at sqrt(R d) / h = 0.35, 9 % low
        at 0.6.
        """
        if depth <= 0:
            return 0.0
        nu = layer.poisson
        c = math.sqrt(self.radius * depth) / layer.thickness
        a0 = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
        b0 = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
        series = (
            1
            - 2 * a0 / math.pi * c
            + 4 * a0**2 / math.pi**2 * c**2
            - 8 / math.pi**3 * (a0**3 + 4 * math.pi**2 / 15 * b0) * c**3
            + 16 * a0 / math.pi**4 * (a0**3 + 3 * math.pi**2 / 5 * b0) * c**4
        )
        hertz = 4 / 3 * layer.modulus / (1 - nu**2) * math.sqrt(self.radius * depth**3)
        return hertz * series


Indenter = Punch | Sphere


@dataclass(frozen=True, slots=True)
class Hysteresis:
    """One Maxwell branch beside the elastic response: loading lies above unloading."""

    fraction: float
    """Force of the branch after an instant press, as a part of the elastic force."""
    relaxation: float = field(metadata={"unit": "ms"})
    """Time constant of its decay [s]."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of the instruments, added where they are served, never to the World's truth."""

    force: float = field(default=0.0, metadata={"unit": "n"})
    """Standard deviation of each force axis [N]."""
    grey: float = 0.0
    """Standard deviation of the image [grey levels]."""
    counts: float = 0.0
    """Standard deviation of each taxel axis [counts]."""


@dataclass(frozen=True, slots=True)
class MarkerView:
    """A marker pattern and the camera that looks at it along -z, x to the right, y up."""

    layout: Literal["grid", "hexagon"]
    """Rows and columns, or rings of a hexagonal packing (rings 6 make 127 pins)."""
    pitch: float = field(metadata={"unit": "mm"})
    """Distance of neighbouring markers [m]."""
    radius: float = field(metadata={"unit": "mm"})
    """Radius of a marker [m]."""
    pixel: float = field(metadata={"unit": "mm"})
    """Size of a pixel on the surface [m]."""
    rows: int = 7
    """Rows of a grid."""
    columns: int = 9
    """Columns of a grid."""
    rings: int = 6
    """Rings of a hexagon around its middle pin."""
    background: tuple[int, int, int] = (150, 138, 120)
    """Colour of the gel, RGB."""
    ink: tuple[int, int, int] = (28, 26, 30)
    """Colour of the markers, RGB."""
    delay: float = field(default=0.0, metadata={"unit": "ms"})
    """How late the emulated camera delivers what it saw [s]."""

    def points(self) -> np.ndarray:
        """Untouched markers (n, 2) in the contact frame [m]."""
        if self.layout == "grid":
            x = (np.arange(self.columns) - (self.columns - 1) / 2) * self.pitch
            y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch
            grid_x, grid_y = np.meshgrid(x, y)
            return np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
        reach = range(-self.rings, self.rings + 1)
        axial = [(q, r) for q in reach for r in reach if abs(q + r) <= self.rings]
        return np.array([(self.pitch * (q + r / 2), self.pitch * r * 3**0.5 / 2) for q, r in axial])


_REST = 32768
# Middle of the uint16 range; a spread from taxel to taxel as real pads show.


_SPREAD = 37


@dataclass(frozen=True, slots=True)
class TaxelField:
    """A 4 x 4 grid of three-axis taxels, counts linear in motion.

    Taxel i lies at column i % 4 and row i // 4 of the contact frame, x to the right and y up, as
    discs are drawn (`recorder.markers`) and as the simulator has them.
    """

    pitch: float = field(default=4.7e-3, metadata={"unit": "mm"})
    """Distance of neighbouring taxels [m]."""
    counts_per_mm_shear: float = 3000.0
    """Counts of x and y per mm of sideways motion."""
    counts_per_mm_normal: float = 20000.0
    """Counts of z per mm of compression."""

    def positions(self) -> np.ndarray:
        """Taxel centres (16, 2) in the contact frame [m]."""
        steps = (np.arange(4) - 1.5) * self.pitch
        x, y = np.meshgrid(steps, steps)
        return np.stack([x.ravel(), y.ravel()], axis=1)

    def counts(self, surface: Surface) -> np.ndarray:
        """Raw counts (16, 3), before noise and rounding."""
        rest = _REST + _SPREAD * (np.arange(48).reshape(16, 3) % 11)
        moved = surface.displacement(self.positions())
        gain = 1e3 * np.array(
            [self.counts_per_mm_shear, self.counts_per_mm_shear, -self.counts_per_mm_normal]
        )
        counts: np.ndarray = np.clip(rest + moved * gain, 0, 65535)
        return counts


@dataclass(frozen=True, slots=True)
class AnalyticSpec:
    """A mock sensor and what presses on it."""

    KIND: ClassVar[str] = "analytic"

    layer: Layer
    indenter: Punch | Sphere
    markers: MarkerView | None = None
    """What the camera sees; None for a sensor without one."""
    taxels: TaxelField | None = None
    """What the taxels feel; None for a sensor without any."""
    gauge_depth: float = field(default=0.02, metadata={"unit": "mm"})
    """Depth of the F/T sensor's origin below the untouched surface [m]."""
    friction: float | None = None
    """Coulomb's coefficient; None is a frictionless contact: no shear at all."""
    hysteresis: Hysteresis | None = None
    """Absent: forces depend on where the tip is, not on how it came there."""
    noise: Noise | None = None
    """Absent: instruments without noise."""

    @property
    def camera_delay(self) -> float:
        """How late the emulated camera delivers what it saw [s]."""
        return 0.0 if self.markers is None else self.markers.delay


@dataclass(frozen=True, slots=True)
class SimulatedSpec:
    """A simulated sensor; the bench's `indenter` presses on it.

    Raises:
        ValueError: A rate or a grid that cannot be.
    """

    KIND: ClassVar[str] = "simulated"

    sensor: str
    """A row of `sim.sensors` by name, or the path of a YAML file of one's own."""
    gauge_depth: float = field(default=0.02, metadata={"unit": "mm"})
    """Depth of the F/T sensor's origin below the untouched surface [m]."""
    rate_hz: float = 60.0
    """Solutions a second that the solver tries for."""
    grid: int = 96
    """Pixels of the solver along the body's longer side."""
    behind: float = field(default=0.15, metadata={"unit": "ms"})
    """Without a solution for so long while it touches, the World gives up [s]: a machine that is
    too slow or too busy shall not pass for a gel."""
    background: tuple[int, int, int] = (150, 138, 120)
    """Colour of the gel, RGB."""
    ink: tuple[int, int, int] = (28, 26, 30)
    """Colour of the markers, RGB."""
    delay: float = field(default=0.0, metadata={"unit": "ms"})
    """How late the emulated camera delivers what it saw [s]."""
    noise: Noise | None = None
    """Absent: instruments without noise."""

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= 500:
            raise ValueError(f"rate_hz: {self.rate_hz!r}; allowed: above 0, up to 500")
        if not 16 <= self.grid <= 256:
            raise ValueError(f"grid: {self.grid!r}; allowed: 16 to 256")

    @property
    def camera_delay(self) -> float:
        """How late the emulated camera delivers what it saw [s]."""
        return self.delay
