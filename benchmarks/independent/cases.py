"""Presses by round indenters with reference solutions, each with an equivalent scene in `sim`.

Lengths are in millimetres, as in the names. The body is a square block pressed at its middle, wide
enough (contact radius + 4 thicknesses to each side) to be replaced by a disc of equal area.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.independent.axisymmetric import Layer
from benchmarks.independent.mesh import Fine
from benchmarks.independent.profile import Kind, Profile, cone, punch, sphere, torus, tube

MM = 1e-3


@dataclass(frozen=True)
class Case:
    """One press with several depths."""

    kind: Kind
    measures: tuple[float, ...]
    """[mm]. `sphere`: radius. `punch`: radius, edge radius. `cone`: half angle [degrees], tip
    radius. `torus`: radius of the ring, of its section. `tube`: outer, inner, edge radius."""
    thickness: float
    """[mm]."""
    depths: tuple[float, ...]
    """[mm]."""
    friction: float = 0.0
    poisson: float = 0.45
    modulus: float = 0.145e6
    """[Pa]."""

    @property
    def name(self) -> str:
        """Description without the modulus: `sphere 4 in 4, mu 0.3, nu 0.45, to 1.5`."""
        measures = "/".join(f"{measure:g}" for measure in self.measures)
        return (
            f"{self.kind} {measures} in {self.thickness:g}, mu {self.friction:g}, "
            f"nu {self.poisson:g}, to {max(self.depths):g}"
        )

    @property
    def size(self) -> float:
        """Width of the square body [mm]."""
        reach = self.touched(max(self.depths))[1]
        return 2.0 * math.ceil(reach + 4 * self.thickness)

    @property
    def profile(self) -> Profile:
        """The indenter."""
        lengths = [measure * MM for measure in self.measures]
        if self.kind == "cone":
            return cone(math.radians(self.measures[0]), lengths[1])
        make: dict[str, Callable[..., Profile]] = {
            "sphere": sphere,
            "punch": punch,
            "torus": torus,
            "tube": tube,
        }
        return make[self.kind](*lengths)

    def layer(self, radius: float) -> Layer:
        """Return the body as a disc of `radius` [m]."""
        return Layer(radius, self.thickness * MM, self.modulus, self.poisson)

    def touched(self, depth: float) -> tuple[float, float]:
        """Return approximate inner and outer contact radii at `depth` [mm], for mesh grading."""
        first = self.measures[0]
        if self.kind == "sphere":
            return 0.0, _cap(first, depth, self.thickness)
        if self.kind == "torus":
            half = _cap(self.measures[1], depth, self.thickness)
            return first - half, first + half
        if self.kind == "cone":
            slope = math.tan(math.radians(first))
            tip = self.measures[1]
            cap = _cap(tip, min(depth, tip), self.thickness)
            return 0.0, max(0.8 * slope * depth, cap)
        return (self.measures[1] if self.kind == "tube" else 0.0), first

    def places(self, elements: int) -> list[Fine]:
        """Return the refined zones of the mesh, with `elements` along the radius of the contact."""
        low, high = self.touched(max(self.depths))
        if self.kind in ("sphere", "cone", "torus"):
            wide = (high - low) / (2 if self.kind == "torus" else 1)
            zones = [Fine(low * MM, high * MM, wide / elements * MM)]
            if low == 0:
                # A contact that is still small has half as many elements along its radius.
                small = self.touched(min(self.depths))[1]
                zones.append(Fine(0.0, small * MM, small / elements * 2 * MM))
            return zones
        edge = self.measures[-1]
        # If only a small part of an edge touches, the elements are sized for that part.
        held = math.sqrt(edge**2 - max(0.0, edge - max(self.depths)) ** 2)
        size = held / elements * 2.5
        spots = [Fine((high - edge) * MM, (high + 0.3 * edge) * MM, size * MM)]
        if self.kind == "tube":
            spots.append(Fine((low - 0.3 * edge) * MM, (low + edge) * MM, size * MM))
        return spots

    def path(self, steps: int) -> list[float]:
        """Return intermediate depths [m] of a press, at which the contact grows about evenly."""
        power = 2 if self.kind in ("sphere", "torus") else 1
        deepest = max(self.depths) * MM
        return [deepest * (step / steps) ** power for step in range(1, steps + 1)]


def _cap(radius: float, depth: float, thickness: float) -> float:
    """Return a sphere's contact radius between (R d)^1/2 (half-space) and (2 R d)^1/2 (layer)."""
    half_space = math.sqrt(radius * depth)
    grown = min(1.0, 0.5 * half_space / thickness)
    return min(half_space * math.sqrt(1 + grown), 0.98 * radius)


CASES: tuple[Case, ...] = (
    # The paper's gel under a sphere: its known forces, friction, Poisson's ratio, small depths.
    Case("sphere", (4,), 4, (0.5, 1, 1.5)),
    Case("punch", (3, 0.5), 4, (0.1, 0.5)),
    Case("sphere", (4,), 4, (0.5, 1, 1.5), 0.3),
    Case("sphere", (4,), 4, (0.5, 1, 1.5), 1),
    Case("sphere", (4,), 4, (0.5, 1, 1.5), poisson=0.3),
    Case("sphere", (4,), 4, (0.5, 1, 1.5), 0.3, 0.49),
    Case("sphere", (4,), 4, (0.005,)),
    Case("sphere", (4,), 4, (0.02, 0.1)),
    # Small spheres, in thin and thick gels.
    Case("sphere", (0.5,), 0.5, (0.05, 0.1, 0.2)),
    Case("sphere", (0.5,), 2, (0.05, 0.2, 0.4), 0.3),
    Case("sphere", (0.5,), 4, (0.02, 0.1, 0.3)),
    Case("sphere", (0.5,), 20, (0.05, 0.25)),
    Case("sphere", (1,), 1, (0.1, 0.2, 0.4), 0.3),
    Case("sphere", (1,), 4, (0.1, 0.5, 1)),
    Case("sphere", (1,), 10, (0.1, 0.5, 1), 1),
    Case("sphere", (2,), 0.5, (0.02, 0.1, 0.2)),
    Case("sphere", (2,), 2, (0.1, 0.4, 0.8), 0.3),
    Case("sphere", (2,), 4, (0.1, 0.5, 1.5), poisson=0.3),
    # Large ones.
    Case("sphere", (4,), 0.5, (0.05, 0.1, 0.2), 1),
    Case("sphere", (4,), 1, (0.05, 0.2, 0.4)),
    Case("sphere", (4,), 20, (0.1, 0.5, 2)),
    Case("sphere", (10,), 1, (0.05, 0.2, 0.4), 0.3),
    Case("sphere", (10,), 4, (0.1, 0.5, 1.5)),
    Case("sphere", (10,), 20, (0.3, 1, 4)),
    Case("sphere", (20,), 0.5, (0.01, 0.05, 0.15)),
    Case("sphere", (20,), 2, (0.05, 0.3, 0.8), poisson=0.49),
    Case("sphere", (20,), 4, (0.005, 0.02)),
    Case("sphere", (20,), 10, (0.1, 1, 3), 0.3),
    # Punches.
    Case("punch", (3, 0.5), 4, (0.1, 0.5, 1), 0.3),
    Case("punch", (3, 0.2), 4, (0.1, 0.5, 1), 1),
    Case("punch", (3, 0.2), 4, (0.005, 0.05), poisson=0.3),
    Case("punch", (3, 0.2), 1, (0.05, 0.1, 0.2), 0.3),
    Case("punch", (3, 0.5), 10, (0.2, 1, 2), 1),
    Case("punch", (1, 0.2), 4, (0.1, 0.4)),
    Case("punch", (1, 0.2), 2, (0.1, 0.3, 0.5), 0.3),
    Case("punch", (1, 0.5), 20, (0.1, 0.5), 0.3),
    Case("punch", (1, 0.5), 0.5, (0.05, 0.2)),
    # Cones.
    Case("cone", (30, 0.2), 4, (0.2, 0.6), 0.3),
    Case("cone", (45, 0.5), 4, (0.1, 0.5, 1)),
    Case("cone", (45, 0.5), 2, (0.1, 0.4, 0.8), 1),
    Case("cone", (60, 0.2), 4, (0.25, 0.5, 0.7), 0.3),
    Case("cone", (60, 0.5), 20, (0.2, 1)),
    Case("cone", (75, 0.5), 4, (0.1, 0.5, 1)),
    Case("cone", (75, 0.2), 1, (0.1, 0.2, 0.4), 0.3),
    # Rings, of round section and flat.
    Case("torus", (2, 0.5), 4, (0.1, 0.3, 0.5)),
    Case("torus", (3, 1), 4, (0.1, 0.5, 1), 0.3),
    Case("torus", (3, 0.5), 1, (0.05, 0.2, 0.4)),
    Case("torus", (2, 1), 10, (0.2, 1)),
    Case("tube", (3, 2, 0.2), 4, (0.1, 0.5), 0.3),
    Case("tube", (3.5, 2.5, 0.4), 4, (0.1, 0.5, 1), 0.3),
)
