"""Presses to be timed: the paper's presses, and samples of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.indenters import NAMES, named
from sim.paper_presses import DEPTHS_MM, FRICTION, PLACES_MM
from sim.scene import Effects, Friction, Scene, press

# Numbers of places along x and y, between the outermost ones, for 810 presses.
DENSE_X, DENSE_Y = 9, 5
# Middle, corner and side [mm], which by symmetry represent all nine places.
REFERENCE_AT = ((0.0, 0.0), (4.0, 4.0), (0.0, 4.0))
# Sample of the 18 shapes where all would take too long: smooth, many bumps, an edge, a ring.
SAMPLE_SHAPES = ("sphere", "wave", "prism", "torus")
SMOKE_SHAPES = ("sphere", "prism")


@dataclass(frozen=True, slots=True)
class TimedPress:
    """One indenter at one place, to all depths, in millimetres as in the files."""

    indenter: str
    x: float
    y: float
    depths: tuple[float, ...] = DEPTHS_MM

    def scene(self, *, speed: float = 10e-3) -> Scene:
        """Return the scene of the press; `speed` is that of the tip in [m/s]."""
        return Scene(
            named(self.indenter),
            press(
                [depth * 1e-3 for depth in self.depths],
                at=(self.x * 1e-3, self.y * 1e-3),
                speed=speed,
            ),
            effects=Effects(friction=Friction(FRICTION)),
        )


@dataclass(frozen=True, slots=True)
class PaperWork:
    """Presses of each part of the measurement."""

    presses: tuple[TimedPress, ...]
    """All presses: each indenter at all its places."""
    dense: tuple[TimedPress, ...]
    """Presses at five times as many places."""
    reference: tuple[TimedPress, ...]
    centred: tuple[TimedPress, ...]
    """Every indenter in the middle."""
    sample: tuple[TimedPress, ...]
    """Some of the centred presses."""

    def some(self, count: int) -> tuple[TimedPress, ...]:
        """Return `count` of all presses, spread over indenters and places; the first is centred."""
        places = len(PLACES_MM) ** 2
        stride = max(1, len(self.presses) // count)
        stride += stride % places == 0
        chosen = [places // 2 + i * stride for i in range(count)]
        return tuple(self.presses[i % len(self.presses)] for i in chosen)


def paper_work() -> PaperWork:
    """Return 18 indenters x 9 places x 5 depths."""
    dense_x = np.linspace(PLACES_MM[0], PLACES_MM[-1], DENSE_X)
    dense_y = np.linspace(PLACES_MM[0], PLACES_MM[-1], DENSE_Y)
    return PaperWork(
        presses=_grid(NAMES, PLACES_MM, PLACES_MM),
        dense=_grid(NAMES, dense_x.tolist(), dense_y.tolist()),
        reference=tuple(TimedPress(name, x, y) for name in NAMES for x, y in REFERENCE_AT),
        centred=tuple(TimedPress(name, 0.0, 0.0) for name in NAMES),
        sample=tuple(TimedPress(name, 0.0, 0.0) for name in SAMPLE_SHAPES),
    )


def smoke_work() -> PaperWork:
    """Return a few shallow presses, to test that everything runs."""
    # Deeper, the coarsest of the compared meshes lets the prism through, and has no result.
    depths = (0.1, 0.3)
    centred = tuple(TimedPress(name, 0.0, 0.0, depths) for name in SMOKE_SHAPES)
    aside = tuple(TimedPress(name, 4.0, 4.0, depths) for name in SMOKE_SHAPES)
    return PaperWork(centred + aside, 2 * (centred + aside), centred, centred, centred)


def _grid(names: Sequence[str], xs: Sequence[float], ys: Sequence[float]) -> tuple[TimedPress, ...]:
    return tuple(TimedPress(name, x, y) for name in names for x in xs for y in ys)
