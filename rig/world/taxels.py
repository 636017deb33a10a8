"""Counts of a magnetic taxel pad on a deformed surface."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rig.world.surface import Surface

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
