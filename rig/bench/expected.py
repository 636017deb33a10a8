"""Force of an indenter on a bench's skin by depth, before anything is pressed.

A row of `sim.sensors` states the body and its relaxation, `sim.ladder` the force at rest under the
indenter's shape, and the bench file the interval of the modulus. Targets whose force would exceed
what the bench can record are known from it, and how fast a press may be.
"""

import math
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from rig.bench.indenter import body_of
from rig.bench.worlds import WorldSpec
from rig.core.errors import ConfigError

# Largest factor between a lab's skin and the modulus of its row, unless the bench file states its
# interval: gels of one recipe differ by as much.
_UNKNOWN = 1.5
# Depths of the table.
_STEPS = 256


@dataclass(frozen=True, slots=True)
class Skin:
    """Skin of a bench's sensor, of which forces are expected."""

    sensor: str
    """Name of a row of `sim.sensors`, or the path of a user's YAML file."""
    modulus: tuple[float, float] | None = field(default=None, metadata={"unit": "kpa"})
    """Lowest and highest Young's modulus [Pa]; None: that of the row, on a lab bench within a
    factor of 1.5."""
    source: str = ""
    """Source of the modulus: a measurement, a data sheet, a paper."""

    def __post_init__(self) -> None:
        if self.modulus is not None and not 0 < self.modulus[0] <= self.modulus[1]:
            raise ValueError(
                f"modulus: {list(self.modulus)!r}; allowed: the lowest, then the highest, both "
                "above 0"
            )


@dataclass(frozen=True, slots=True)
class ExpectedForce:
    """Normal force of an indenter on a skin, by depth."""

    depths: np.ndarray
    """Depths (n,) of the table, from 0 [m]."""
    least: np.ndarray
    """Least force (n,) at rest [N]."""
    most: np.ndarray
    """Largest force (n,) of a press, before the skin relaxes [N]."""
    text: str
    """Skin, its modulus and its source, for the operator."""

    def at(self, depth: float) -> tuple[float, float]:
        """Return the least and the largest force at a depth [m], up to that of the table [N]."""
        low, high = (float(np.interp(depth, self.depths, each)) for each in (self.least, self.most))
        return low, (high if depth <= self.depths[-1] * (1 + 1e-9) else math.inf)

    def depth_of(self, force: float) -> tuple[float, float]:
        """Return the depths at which the least and the largest force reach `force` [N], in [m]."""
        low, high = (float(np.interp(force, each, self.depths)) for each in (self.least, self.most))
        return low, high

    def stiffest(self, force: float) -> float:
        """Return the largest stiffness in a press up to `force` [N] or the table's end [N/m]."""
        slopes = np.diff(self.most) / np.diff(self.depths)
        return float(slopes[self.most[:-1] <= force].max())


@cache
def expected_force(skin: Skin, indenter: str, *, exact: bool) -> ExpectedForce:
    """Return the force on a skin of the indenter of that name, see `rig.bench.indenter`.

    Without a stated modulus, an exact skin, a mock bench's, has that of its row.

    Raises:
        ConfigError: Row or indenter cannot be used.
    """
    try:
        from sim.ladder import Ladder
        from sim.sensors import sensor_of

        row = sensor_of(skin.sensor)
        ladder = Ladder.of(body_of(indenter, row.body.thickness), row)
    except ImportError as error:
        raise ConfigError(
            f"skin: {error.name} is not installed; install: pip install 'tactile-rig[sim]'"
        ) from None
    except (ValueError, OSError) as error:
        raise ConfigError(f"skin: {error}") from None
    stated = skin.modulus or (row.body.modulus,) * 2
    if skin.modulus is None and not exact:
        stated = (stated[0] / _UNKNOWN, stated[1] * _UNKNOWN)
    softer, stiffer = (each / row.body.modulus for each in stated)
    viscosity = row.effects.viscosity
    rising = 1.0 + (0.0 if viscosity is None else sum(viscosity.ratios))
    depths = np.linspace(0.0, ladder.depth_max, _STEPS)
    low, high = np.array([ladder.interval(depth) for depth in depths]).T
    low, high = softer * low, stiffer * rising * np.maximum.accumulate(high)
    kpa = " to ".join(dict.fromkeys(f"{1e-3 * each:.3g}" for each in stated))
    source = skin.source or ("" if exact or skin.modulus else "assumed")
    text = f"{skin.sensor}, {kpa} kPa" + (f", {source}" if source else "")
    return ExpectedForce(depths, low, high, text)


def mount_of(world: WorldSpec) -> dict[str, Any]:
    """Return how a World's sensor and gauge lie in the contact frame, for `expected` of a session.

    `turned` is the angle of its picture, anticlockwise [rad], `taxels` their places (n, 2), and
    `gauge` that of its origin (3,) [m].
    """
    from sim.sensors import sensor_of

    signal = sensor_of(world.sensor).signal
    places = getattr(signal, "places", np.zeros((0, 2))).tolist()
    by_lab = 0.0 if places else math.radians(world.lab.camera_turned_deg)
    turned = getattr(signal, "rotation", 0.0) + by_lab
    return {"turned": turned, "taxels": places, "gauge": [0.0, 0.0, -world.gauge_depth]}
