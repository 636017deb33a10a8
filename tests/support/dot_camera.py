"""Pictures of dots on a gel, moved by smooth closed forms around a round contact."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rig.mock.world.picture import HEIGHT, WIDTH, MarkerPicture
from sim.markers.pattern import hexagon, rows


@dataclass(frozen=True, slots=True)
class PressedSurface:
    """Surface under one round contact: its centre, depth, radius, skin and shear [m]."""

    centre: tuple[float, float]
    depth: float
    radius: float
    thickness: float
    shear: tuple[float, float]

    def displacement(self, points: np.ndarray) -> np.ndarray:
        """Return the displacement (n, 3) [m] of material points (n, 2) [m]."""
        moved = np.zeros((len(points), 3))
        if self.depth <= 0:
            return moved
        # The material now under the tip was dragged there by the shear.
        offset = points - (np.array(self.centre) - np.array(self.shear))
        distance = np.hypot(*offset.T)
        outside = np.maximum(distance - self.radius, 0.0) / self.thickness
        moved[:, :2] = np.array(self.shear) * np.exp(-outside)[:, None]
        # Outward: linear inside the contact, largest at its edge, decaying over the thickness.
        reach = self.radius + 0.25 * self.thickness
        dilation = 0.35 * self.depth * np.exp(0.5 * (1 - (distance / reach) ** 2)) / reach
        moved[:, :2] += offset * dilation[:, None]
        moved[:, 2] = -self.depth * np.exp(-2 * outside)
        return moved


@dataclass(frozen=True, slots=True)
class MarkerView:
    """Dots in rows or a hexagon, their pitch and radius, and the size of a pixel [m]."""

    layout: Literal["grid", "hexagon"]
    pitch: float
    radius: float
    pixel: float
    rows: int = 7
    columns: int = 9
    rings: int = 6
    background: tuple[int, int, int] = (150, 138, 120)
    ink: tuple[int, int, int] = (28, 26, 30)

    def points(self) -> np.ndarray:
        """Return the places of the dots (n, 2) [m]."""
        if self.layout == "grid":
            return np.array(rows(self.columns, self.rows, self.pitch))
        return np.array(hexagon(self.rings, self.pitch))


class MarkerCamera:
    """Draws a `MarkerView` of a deformed surface."""

    def __init__(self, view: MarkerView, *, grey_noise: float = 0.0, seed: int = 0) -> None:
        self._view, self._points = view, view.points()
        self._picture = MarkerPicture(
            background=view.background, ink=view.ink, grey_noise=grey_noise, seed=seed
        )
        turn = np.linspace(0, 2 * np.pi, 32, endpoint=False)
        self._rim = view.radius / view.pixel * np.stack([np.cos(turn), np.sin(turn)], axis=1)

    def pixels(self, surface: PressedSurface) -> np.ndarray:
        """Return the marker centres (n, 2) as column and row [px]."""
        moved = self._points + surface.displacement(self._points)[:, :2]
        middle = (WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)
        return moved / self._view.pixel * (1, -1) + middle

    def image(self, surface: PressedSurface) -> np.ndarray:
        """Return the view as RGB (480, 640, 3) uint8."""
        return self._picture.image(self.pixels(surface)[:, None] + self._rim)
