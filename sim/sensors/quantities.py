"""Quantities of a sensor by name: read, replaced, and drawn from its uncertainty."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sim.errors import SceneError
from sim.markers import Camera
from sim.scene import Body, Friction, Viscosity
from sim.sensors.posterior import CAMERA, Posterior, is_log
from sim.sensors.sensor import SimulatedSensor
from sim.sensors.taxels import TaxelSignal

# Poisson's ratios that a draw may have: near 0.5 the layer becomes rigid.
POISSON = (0.3, 0.4995)
# Greatest depth of a sensor's presses over its thickness.
DEEPEST = 0.9


def draw_sensor(
    centre: SimulatedSensor, posterior: Posterior, random: np.random.Generator
) -> SimulatedSensor:
    """Return a sensor drawn from an uncertainty about `centre`; it keeps no posterior itself."""
    spread = np.array(posterior.spreads)
    matrix = np.array(posterior.correlations) * np.outer(spread, spread)
    values, axes = np.linalg.eigh((matrix + matrix.T) / 2)
    moved = axes @ (np.sqrt(np.maximum(values, 0.0)) * random.standard_normal(len(spread)))
    own = {**quantities(centre), **camera_quantities(centre)}
    if missing := [name for name in posterior.names if name not in own]:
        raise SceneError(f"{centre.name}: {', '.join(missing)}; allowed: {', '.join(own)}")
    changed = {
        name: own[name] * math.exp(step) if is_log(name) else own[name] + step
        for name, step in zip(posterior.names, moved, strict=True)
    }
    camera = {name: changed.pop(name) for name in CAMERA if name in changed}
    sensor = with_quantities(centre, changed)
    return replace(with_camera(sensor, camera) if camera else sensor, posterior=None)


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
    """Return a sensor with some of `CAMERA` replaced, whose layout looks the same."""
    if isinstance(sensor.signal, TaxelSignal):
        raise SceneError(f"{sensor.name}.signal: taxels; allowed: a camera")
    camera_values = {**camera_quantities(sensor), **values}
    camera = Camera(
        camera_values["distance"] / camera_values["scale"],
        camera_values["distance"],
        (camera_values["shift_x"], camera_values["shift_y"]),
        camera_values["rotation"],
        (camera_values["camera_tilt_x"], camera_values["camera_tilt_y"]),
    )
    return replace(sensor, signal=sensor.signal.by(camera, sensor.body))


def quantities(sensor: SimulatedSensor) -> dict[str, float]:
    """Return the quantities of a sensor by name, in SI; friction and branches if it has them."""
    body, effects = sensor.body, sensor.effects
    by_name = {"modulus": body.modulus, "thickness": body.thickness, "poisson": body.poisson}
    if effects.friction is not None:
        by_name["friction"] = effects.friction.coefficient
    if effects.viscosity is not None:
        for index, (ratio, time) in enumerate(
            zip(effects.viscosity.ratios, effects.viscosity.times, strict=True), 1
        ):
            by_name |= {f"ratio_{index}": ratio, f"time_{index}": time}
    return by_name


def with_quantities(sensor: SimulatedSensor, values: Mapping[str, float]) -> SimulatedSensor:
    """Return the sensor with some quantities replaced; presses beyond its skin are dropped."""
    merged = quantities(sensor)
    if missing := [name for name in values if name not in merged and name != "friction"]:
        raise SceneError(f"{sensor.name}: {', '.join(missing)}; allowed: {', '.join(merged)}")
    merged |= values
    body: Body = replace(
        sensor.body,
        modulus=merged["modulus"],
        thickness=merged["thickness"],
        poisson=float(np.clip(merged["poisson"], *POISSON)),
    )
    effects = sensor.effects
    if "friction" in merged:
        effects = replace(effects, friction=Friction(merged["friction"]))
    if effects.viscosity is not None:
        count = len(effects.viscosity.ratios)
        viscosity: Viscosity = replace(
            effects.viscosity,
            ratios=tuple(merged[f"ratio_{index}"] for index in range(1, count + 1)),
            times=tuple(merged[f"time_{index}"] for index in range(1, count + 1)),
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
