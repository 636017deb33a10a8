"""Uncertainty of a sensor identified from its own presses, and sensors drawn from it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.effects import Friction, Viscosity
from sim.errors import SceneError, check_range
from sim.markers import Camera
from sim.result import ContactTier
from sim.scene import Body
from sim.sensors.taxels import TaxelSignal

if TYPE_CHECKING:
    from sim.sensors.sensor import SimulatedSensor

# Quantities of a sensor that presses may identify; branches of viscosity are numbered from 1.
_NAMES = re.compile(r"modulus|thickness|poisson|friction|ratio_[1-4]|time_[1-4]")
# Quantities of a camera that images may identify.
CAMERA = (
    *("scale", "distance", "shift_x", "shift_y", "rotation"),
    *("camera_tilt_x", "camera_tilt_y"),
)
# Quantities that are distributed by their logarithms, without their numbers; others as they are.
LOGARITHMS = ("modulus", "thickness", "friction", "ratio", "time", "scale", "distance")
# Poisson's ratios that a draw may have: near 0.5 the layer becomes rigid.
POISSON = (0.3, 0.4995)
# Greatest depth of a sensor's presses over its thickness.
DEEPEST = 0.9


@dataclass(frozen=True, slots=True)
class Posterior:
    """Normal distribution of a sensor's quantities about the values of its row.

    All are in logarithms, so that a spread of 0.02 is 2 %, but Poisson's ratio and the shift [px]
    and rotation [rad] of the image and the camera's tilt [rad] are as they are.

    Raises:
        SceneError: A name is unknown or repeated, or a shape or a value does not fit.
    """

    names: tuple[str, ...]
    """modulus, thickness, poisson, friction, ratio_1, time_1 and so on, and those of `CAMERA`."""
    spreads: tuple[float, ...]
    """Standard deviation of each."""
    correlations: tuple[tuple[float, ...], ...]
    """Matrix of correlations, -1 to 1, with ones on its diagonal."""
    tier: ContactTier = field(default="layer", repr=False, metadata={"stored": "unless default"})
    """Tier whose forces the quantities explain: by the other they give other forces."""
    height: float = field(
        default=0.0, repr=False, metadata={"unit": "um", "stored": "unless default"}
    )
    """Height of the surface over where the presses of the fit have it [m], -1e-3 to 1e-3. Found
    along with the quantities, it belongs to them: without it they give other forces."""
    law: float = field(default=0.0, repr=False, metadata={"stored": "unless default"})
    """Error of forces at rest that no quantity explains, 0 to 1: standard deviation along an axis
    over the whole force. It is of the fitted presses, and includes errors of the grid."""

    def __post_init__(self) -> None:
        unknown = [name for name in self.names if name not in CAMERA and not _NAMES.fullmatch(name)]
        if unknown or len(set(self.names)) != len(self.names):
            raise SceneError(
                f"posterior.names: {', '.join(unknown or self.names)}; allowed: modulus, "
                "thickness, poisson, friction, ratio_1 to ratio_4, time_1 to time_4, "
                f"{', '.join(CAMERA)}, each once"
            )
        count = len(self.names)
        check_range("posterior", "height", self.height, -1e-3, 1e-3, unit="m")
        check_range("posterior", "law", self.law, 0.0, 1.0)
        matrix = np.array(self.correlations, float)
        if len(self.spreads) != count or matrix.shape != (count, count):
            raise SceneError(
                f"posterior: {count} names, {len(self.spreads)} spreads, correlations of shape "
                f"{matrix.shape}; allowed: one spread for each name, and a square of that size"
            )
        for name, spread in zip(self.names, self.spreads, strict=True):
            most = 100.0 if name.startswith("shift") else 3.0
            check_range("posterior.spreads", name, spread, 0.0, most)
        if not np.allclose(matrix, matrix.T, atol=1e-6) or np.abs(matrix).max(initial=0) > 1.000001:
            raise SceneError("posterior.correlations: allowed: a symmetric matrix, -1 to 1")

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        covariance: NDArray[np.float64],
        tier: ContactTier = "layer",
        height: float = 0.0,
        law: float = 0.0,
    ) -> Posterior:
        """Return the distribution with a covariance (p, p)."""
        spread = np.sqrt(np.diag(covariance))
        matrix = np.clip(covariance / np.outer(spread, spread), -1.0, 1.0)
        np.fill_diagonal(matrix, 1.0)
        correlations = tuple(map(tuple, matrix.tolist()))
        told = tier, float(height), float(law)
        return cls(tuple(names), tuple(spread.tolist()), correlations, *told)

    def draw(self, centre: SimulatedSensor, random: np.random.Generator) -> SimulatedSensor:
        """Return a sensor drawn about `centre`, which itself keeps no posterior."""
        spread = np.array(self.spreads)
        matrix = np.array(self.correlations) * np.outer(spread, spread)
        values, axes = np.linalg.eigh((matrix + matrix.T) / 2)
        moved = axes @ (np.sqrt(np.maximum(values, 0.0)) * random.standard_normal(len(spread)))
        known = {**quantities(centre), **camera_quantities(centre)}
        if missing := [name for name in self.names if name not in known]:
            raise SceneError(f"{centre.name}: {', '.join(missing)}; allowed: {', '.join(known)}")
        drawn = {
            name: known[name] * math.exp(step) if is_log(name) else known[name] + step
            for name, step in zip(self.names, moved, strict=True)
        }
        seen = {name: drawn.pop(name) for name in CAMERA if name in drawn}
        found = with_quantities(centre, drawn)
        return replace(with_camera(found, seen) if seen else found, posterior=None)


def is_log(name: str) -> bool:
    """Return True if a quantity is distributed, and fitted, by its logarithm."""
    return name.partition("_")[0] in LOGARITHMS


def interval_of(name: str, value: float, spread: float) -> tuple[float, float]:
    """Return the interval of a quantity, `spread` to both sides of it or of its logarithm."""
    if is_log(name):
        return value * math.exp(-spread), value * math.exp(spread)
    return value - spread, value + spread


def camera_quantities(sensor: SimulatedSensor) -> dict[str, float]:
    """Return those of `CAMERA` by name, in SI, shifts in px; none of a sensor of taxels."""
    if isinstance(sensor.signal, TaxelSignal):
        return {}
    camera = sensor.signal.camera()
    return {
        "scale": 1e-3 * camera.mm_per_px,
        "distance": camera.distance,
        "shift_x": camera.shift[0],
        "shift_y": camera.shift[1],
        "rotation": camera.rotation,
        "camera_tilt_x": camera.tilt[0],
        "camera_tilt_y": camera.tilt[1],
    }


def with_camera(sensor: SimulatedSensor, values: Mapping[str, float]) -> SimulatedSensor:
    """Return a sensor with some of `CAMERA` replaced, whose layout looks the same.

    Raises:
        SceneError: A value is out of range, no marker is on the body, or there is no camera.
    """
    if isinstance(sensor.signal, TaxelSignal):
        raise SceneError(f"{sensor.name}.signal: taxels; allowed: a camera")
    known = {**camera_quantities(sensor), **values}
    camera = Camera(
        known["distance"] / known["scale"],
        known["distance"],
        (known["shift_x"], known["shift_y"]),
        known["rotation"],
        (known["camera_tilt_x"], known["camera_tilt_y"]),
    )
    return replace(sensor, signal=sensor.signal.by(camera, sensor.body))


def quantities(sensor: SimulatedSensor) -> dict[str, float]:
    """Return the quantities of a sensor by name, in SI; friction and branches if it has them."""
    body, effects = sensor.body, sensor.effects
    found = {"modulus": body.modulus, "thickness": body.thickness, "poisson": body.poisson}
    if effects.friction is not None:
        found["friction"] = effects.friction.coefficient
    if effects.viscosity is not None:
        for index, (ratio, time) in enumerate(
            zip(effects.viscosity.ratios, effects.viscosity.times, strict=True), 1
        ):
            found |= {f"ratio_{index}": ratio, f"time_{index}": time}
    return found


def with_quantities(sensor: SimulatedSensor, values: Mapping[str, float]) -> SimulatedSensor:
    """Return the sensor with some quantities replaced; presses beyond its skin are dropped.

    Raises:
        SceneError: A value is out of range, or the sensor has no such branch.
    """
    known = quantities(sensor)
    if missing := [name for name in values if name not in known and name != "friction"]:
        raise SceneError(f"{sensor.name}: {', '.join(missing)}; allowed: {', '.join(known)}")
    known |= values
    body: Body = replace(
        sensor.body,
        modulus=known["modulus"],
        thickness=known["thickness"],
        poisson=float(np.clip(known["poisson"], *POISSON)),
    )
    effects = sensor.effects
    if "friction" in known:
        effects = replace(effects, friction=Friction(known["friction"]))
    if effects.viscosity is not None:
        count = len(effects.viscosity.ratios)
        viscosity: Viscosity = replace(
            effects.viscosity,
            ratios=tuple(known[f"ratio_{index}"] for index in range(1, count + 1)),
            times=tuple(known[f"time_{index}"] for index in range(1, count + 1)),
        )
        effects = replace(effects, viscosity=viscosity)
    deepest = min(sensor.depth_max, DEEPEST * body.thickness)
    plans = {
        name: plan
        for name in ("trajectory", "force_depth")
        if (plan := getattr(sensor, name)) is None or plan.depth_max <= deepest * (1 + 1e-9)
    }
    none = {"trajectory": None, "force_depth": None}
    return replace(sensor, body=body, effects=effects, depth_max=deepest, **{**none, **plans})
