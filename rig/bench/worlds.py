"""Settings of a mock bench's World: sensor, indenter, and the signals of the sensor.

`Sources` are recordings that its emulators play in place of the World.

The closed-form contact of the analytic World is here too, because its settings are checked against
the range of its formulas: Hayes' table for a flat circular punch, Dimitriadis' series for a sphere,
and for shear a rigid disc on a layer over rock. Nothing here has a state or depends on time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from rig.core.errors import ConfigError

# Stiffening of a bonded layer under a flat punch, rows a/h, columns Poisson's ratio (Hayes et al.
# 1972, recomputed from the integral equation; a/h = 0 is the half-space).
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


@dataclass(frozen=True, slots=True)
class Layer:
    """Soft layer bonded to a rigid base."""

    modulus: float = field(metadata={"unit": "kpa"})
    """Young's modulus [Pa]."""
    thickness: float = field(metadata={"unit": "mm"})
    """Thickness [m]."""
    poisson: float = 0.45
    """Poisson's ratio, 0.30 to 0.50."""

    def __post_init__(self) -> None:
        """Reject values outside the range of the formulas."""
        if not self.modulus > 0 or not self.thickness > 0:
            raise ValueError("modulus and thickness: allowed: above 0")
        if not 0.30 <= self.poisson <= 0.50:
            raise ValueError(f"poisson: {self.poisson!r}; allowed: 0.30 to 0.50 (Hayes' table)")

    @property
    def shear_modulus(self) -> float:
        """E / (2 (1 + nu)) [Pa]."""
        return self.modulus / (2 * (1 + self.poisson))

    def disc_shear_stiffness(self, radius: float) -> float:
        """Return the force per tangential displacement of a disc stuck to the surface [N/m].

        8 G a / (2 - nu) on a half-space (Johnson 1985, 3.7), times 1 + a / (2 h) for a layer over
        rock (Gazetas 1983); accurate for a / h below about 0.5, a few per cent off above.
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
    """Flat-ended circular punch."""

    KIND: ClassVar[str] = "punch"

    radius: float = field(metadata={"unit": "mm"})
    """Radius [m]."""

    def contact_radius(self, layer: Layer, depth: float) -> float:
        """Return the radius of the contact [m], equal to that of the punch."""
        return self.radius

    def force(self, layer: Layer, depth: float) -> float:
        """Return the normal force at `depth` [N]: 2 E a d kappa / (1 - nu^2).

        kappa is from Hayes' table, and constant beyond its end at a/h = 2.
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
        """Return the contact radius by Hertz: sqrt(R d) [m]."""
        return math.sqrt(self.radius * max(depth, 0.0))

    def force(self, layer: Layer, depth: float) -> float:
        """Return the normal force at `depth` [N]: Hertz times Dimitriadis' series.

        The series is for a bonded layer (Dimitriadis et al. 2002). Compared with the exact solution
        it is 3 % low at sqrt(R d) / h = 0.35 and 9 % low at 0.6.
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
    """Maxwell branch parallel to the elastic response: loading forces exceed unloading forces."""

    fraction: float
    """Force of the branch after an instant press, relative to the elastic force."""
    relaxation: float = field(metadata={"unit": "ms"})
    """Time constant of its decay [s]."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of the instruments, added to their output, never to the World's truth."""

    force: float = field(default=0.0, metadata={"unit": "n"})
    """Standard deviation of each force axis [N]."""
    grey: float = 0.0
    """Standard deviation of the image [grey levels]."""
    counts: float = 0.0
    """Standard deviation of each taxel axis [counts]."""


@dataclass(frozen=True, slots=True)
class MarkerView:
    """Marker pattern and the camera that views it along -z, x to the right, y up."""

    layout: Literal["grid", "hexagon"]
    """Rows and columns, or rings of a hexagonal packing (rings 6 make 127 pins)."""
    pitch: float = field(metadata={"unit": "mm"})
    """Distance between neighbouring markers [m]."""
    radius: float = field(metadata={"unit": "mm"})
    """Radius of a marker [m]."""
    pixel: float = field(metadata={"unit": "mm"})
    """Pixel size on the surface [m]."""
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
    """Latency of the emulated camera [s]."""

    def points(self) -> np.ndarray:
        """Return the marker positions (n, 2) without contact, in the contact frame [m]."""
        if self.layout == "grid":
            x = (np.arange(self.columns) - (self.columns - 1) / 2) * self.pitch
            y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch
            grid_x, grid_y = np.meshgrid(x, y)
            return np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
        reach = range(-self.rings, self.rings + 1)
        axial = [(q, r) for q in reach for r in reach if abs(q + r) <= self.rings]
        return np.array([(self.pitch * (q + r / 2), self.pitch * r * 3**0.5 / 2) for q, r in axial])


# Middle of the uint16 range, and a spread between taxels as real pads have.
_REST = 32768
_SPREAD = 37


@dataclass(frozen=True, slots=True)
class TaxelField:
    """A 4 x 4 grid of three-axis taxels, counts linear in displacement.

    Taxel i lies at column i % 4 and row i // 4 of the contact frame, x to the right and y up, as
    in `recorder.markers` and in the simulator.
    """

    pitch: float = field(default=4.7e-3, metadata={"unit": "mm"})
    """Distance between neighbouring taxels [m]."""
    counts_per_mm_shear: float = 3000.0
    """Counts of x and y per mm of tangential displacement."""
    counts_per_mm_normal: float = 20000.0
    """Counts of z per mm of compression."""

    def positions(self) -> np.ndarray:
        """Return the taxel centres (16, 2) in the contact frame [m]."""
        steps = (np.arange(4) - 1.5) * self.pitch
        x, y = np.meshgrid(steps, steps)
        return np.stack([x.ravel(), y.ravel()], axis=1)

    def counts(self, moved: np.ndarray) -> np.ndarray:
        """Return raw counts (16, 3), before noise and rounding, of a displacement (16, 3) [m]."""
        rest = _REST + _SPREAD * (np.arange(48).reshape(16, 3) % 11)
        gain = 1e3 * np.array(
            [self.counts_per_mm_shear, self.counts_per_mm_shear, -self.counts_per_mm_normal]
        )
        counts: np.ndarray = np.clip(rest + moved * gain, 0, 65535)
        return counts


@dataclass(frozen=True, slots=True)
class AnalyticSpec:
    """Mock sensor and its indenter, with closed-form contact."""

    KIND: ClassVar[str] = "analytic"

    layer: Layer
    indenter: Punch | Sphere
    markers: MarkerView | None = None
    """View of the camera; None for a sensor without one."""
    taxels: TaxelField | None = None
    """Response of the taxels; None for a sensor without any."""
    gauge_depth: float = field(default=0.02, metadata={"unit": "mm"})
    """Depth of the F/T sensor's origin below the undeformed surface [m]."""
    friction: float | None = None
    """Coulomb's coefficient; None: frictionless contact without any shear."""
    hysteresis: Hysteresis | None = None
    """None: forces depend on the tip's position only, not on its path."""
    noise: Noise | None = None
    """None: instruments without noise."""
    dome_radius: float | None = field(default=None, metadata={"unit": "mm", "plausible": (5, 5000)})
    """Radius of the spherical top of the layer [m]; None: flat. A contact is computed as on a flat
    layer at the height of the top under the tip."""

    @property
    def camera_delay(self) -> float:
        """Latency of the emulated camera [s]."""
        return 0.0 if self.markers is None else self.markers.delay


@dataclass(frozen=True, slots=True)
class SimulatedSpec:
    """Simulated sensor, pressed by the bench's `indenter`.

    Raises:
        ValueError: The rate or the grid is out of range.
    """

    KIND: ClassVar[str] = "simulated"

    sensor: str
    """Name of a row of `sim.sensors`, or the path of a user's YAML file."""
    gauge_depth: float = field(default=0.02, metadata={"unit": "mm"})
    """Depth of the F/T sensor's origin below the undeformed surface [m]."""
    rate_hz: float = 60.0
    """Solutions per second that the solver aims for."""
    grid: int = 96
    """Pixels of the solver along the body's longer side."""
    behind: float = field(default=0.15, metadata={"unit": "ms"})
    """Longest time without a solution during contact [s]. Beyond it the World fails, so that a
    slow or busy machine is not mistaken for the gel's behaviour."""
    background: tuple[int, int, int] = (150, 138, 120)
    """Colour of the gel, RGB."""
    ink: tuple[int, int, int] = (28, 26, 30)
    """Colour of the markers, RGB."""
    delay: float = field(default=0.0, metadata={"unit": "ms"})
    """Latency of the emulated camera [s]."""
    noise: Noise | None = None
    """None: instruments without noise."""
    dome_radius: float | None = field(default=None, metadata={"unit": "mm", "plausible": (5, 5000)})
    """Radius of the spherical top of the layer [m]; None: flat. The sensor is solved as it is,
    flat, at the height of the top under the tip."""

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= 500:
            raise ValueError(f"rate_hz: {self.rate_hz!r}; allowed: above 0, up to 500")
        if not 16 <= self.grid <= 256:
            raise ValueError(f"grid: {self.grid!r}; allowed: 16 to 256")

    @property
    def camera_delay(self) -> float:
        """Latency of the emulated camera [s]."""
        return self.delay


@dataclass(frozen=True, slots=True)
class Sources:
    """Recordings to play; None: the World's data instead."""

    camera: Path | None = None
    """A folder of images or a video file."""
    camera_motion: str = "moving"
    """`moving`: one source frame per camera frame; `still`: each image held for seconds."""
    taxels: Path | None = None
    """A .npy file of raw counts (T, 48)."""

    def __post_init__(self) -> None:
        """Reject a missing path before anything is started."""
        for name, path in (("--camera", self.camera), ("--taxels", self.taxels)):
            if path is not None and not path.exists():
                raise ConfigError(f"{name}: {path}: no such file or folder")

    def description(self) -> dict[str, Any]:
        """Return the entries for the session's metadata: file names without local paths."""
        description: dict[str, Any] = {}
        if self.camera is not None:
            description["camera"] = {"name": self.camera.name, "motion": self.camera_motion}
        if self.taxels is not None:
            description["taxels"] = {"name": self.taxels.name}
        return description
