"""uSkin: magnets in the silicone above Hall elements, 4 x 4 of them, counts along three axes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from sim.body import Body
from sim.checks import check_range
from sim.errors import SceneError
from sim.sensors.dipoles import flux_density, rotations
from sim.sensors.field import SurfaceField
from sim.sensors.interior import Interior

Array = NDArray[np.float64]
Counts = NDArray[np.int32]

SIDE = 4
"""Taxels along each side."""
COUNT_MAX = 65535
"""Largest raw count: the device reports 16 bits without sign."""


@dataclass(frozen=True, slots=True)
class TaxelSignal:
    """A pad of 4 x 4 magnets, each above its own Hall element.

    Taxel i stands at column i % 4, row i // 4; columns go along x and rows along y, both upwards
    from the corner of least x and y. Untouched, a magnet's moment points along z, out of the pad.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    KIND: ClassVar[str] = "taxels"

    pitch: float = field(metadata={"unit": "mm"})
    """Distance of neighbouring taxels [m]."""
    magnet_depth: float = field(metadata={"unit": "mm"})
    """From the untouched top down to the middle of a magnet [m]."""
    hall_depth: float = field(metadata={"unit": "mm"})
    """From the base of the silicone down to the Hall elements [m]."""
    moment: float = field(metadata={"unit": "ma_m2"})
    """Magnetic moment of a magnet [A m^2]."""
    gain_shear: float = field(metadata={"unit": "counts_per_mt"})
    """Counts per flux density along x and y [1/T]."""
    gain_normal: float = field(metadata={"unit": "counts_per_mt"})
    """Counts per flux density along z [1/T]."""
    rest: tuple[float, float, float] = (48_000.0, 16_500.0, 40_000.0)
    """Raw counts of an untouched taxel along x, y, z; they set how far it is to saturation."""
    noise: float = 0.0
    """Standard deviation of a count; 0 is none."""

    def __post_init__(self) -> None:
        for name, unit, low, high in (
            ("pitch", "m", 1e-4, 0.1),
            ("magnet_depth", "m", 0.0, 0.1),
            ("hall_depth", "m", 1e-4, 0.1),
            ("moment", "A m^2", 1e-9, 1.0),
            ("gain_shear", "1/T", 0.0, 1e10),
            ("gain_normal", "1/T", 0.0, 1e10),
            ("noise", "", 0.0, 1e4),
        ):
            check_range("taxels", name, getattr(self, name), low, high, unit=unit)
        if len(self.rest) != 3:
            raise SceneError(f"taxels.rest: {self.rest!r}; allowed: 3 counts")
        for index, value in enumerate(self.rest):
            check_range("taxels", f"rest[{index}]", value, 0.0, COUNT_MAX)

    @property
    def places(self) -> Array:
        """Where the taxels are (16, 2) [m]."""
        number = np.arange(SIDE * SIDE)
        steps = np.stack([number % SIDE, number // SIDE], axis=1).astype(float)
        places: Array = (steps - (SIDE - 1) / 2) * self.pitch
        return places


class TaxelPad:
    """What a pad reports while the top of its silicone is displaced.

    A magnet goes where the material at its middle goes and turns as that material turns. Every Hall
    element feels every magnet.

    Raises:
        SceneError: A dome, magnets that lie below the base, or taxels beside the body.
    """

    def __init__(self, body: Body, signal: TaxelSignal) -> None:
        self.signal = signal
        if body.dome_radius is not None:
            raise SceneError(
                f"body.dome_radius: {body.dome_radius!r} m under taxels; allowed: None, a flat pad"
            )
        if not signal.magnet_depth < body.thickness:
            raise SceneError(
                f"taxels.magnet_depth: {signal.magnet_depth!r} m; allowed: less than the body's "
                f"thickness, {body.thickness:g} m"
            )
        reach = (SIDE - 1) / 2 * signal.pitch
        if 2 * reach > min(body.size_x, body.size_y):
            raise SceneError(
                f"taxels.pitch: {signal.pitch!r} m; allowed: up to "
                f"{min(body.size_x, body.size_y) / (SIDE - 1):g} m, so that the taxels lie in the "
                "body"
            )
        places = signal.places
        self._interior = Interior(body, signal.magnet_depth, places)
        self._magnets = _at_height(places, -signal.magnet_depth)
        self._halls = _at_height(places, -body.thickness - signal.hall_depth)
        still = np.zeros((1, len(places), 3))
        self._untouched = self.flux(still, np.zeros((*still.shape, 3)))[0]

    def flux(self, moved: Array, gradient: Array) -> Array:
        """Flux density (F, 16, 3) [T] at the Hall elements.

        Args:
            moved: Displacement of the magnets (F, 16, 3) [m].
            gradient: That of the displacement there (F, 16, 3, 3), du_i / dx_j.
        """
        moments = self.signal.moment * rotations(gradient)[..., 2]
        return flux_density(moments, self._magnets + moved, self._halls)

    def change(self, top: SurfaceField) -> Array:
        """Change of the flux density (F, 16, 3) [T] from the untouched pad's."""
        moved, gradient = self._interior.at(top)
        change: Array = self.flux(moved, gradient) - self._untouched
        return change

    def raw(self, top: SurfaceField, normal: Array | None = None) -> Counts:
        """Raw counts (F, 16, 3) as the device sends them: 0 to 65535, whole, saturated.

        Args:
            top: Displacement of the silicone's top.
            normal: Standard normal numbers (F, 16, 3) to make the noise of; None is without.
        """
        signal = self.signal
        gain = np.array([signal.gain_shear, signal.gain_shear, signal.gain_normal])
        analog = np.array(signal.rest) + gain * self.change(top)
        if normal is not None:
            analog = analog + signal.noise * normal
        return np.clip(np.rint(analog), 0, COUNT_MAX).astype(np.int32)

    def counts(self, top: SurfaceField, normal: Array | None = None) -> Counts:
        """Counts (F, 16, 3) less the untouched pad's, whose own noise is averaged away."""
        return self.raw(top, normal) - np.rint(self.signal.rest).astype(np.int32)


def _at_height(places: Array, height: float) -> Array:
    return np.column_stack([places, np.full(len(places), height)])
