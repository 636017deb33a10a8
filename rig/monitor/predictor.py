"""Access of the bench to `learning`, which is imported only when it is used."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.core.errors import ConfigError

if TYPE_CHECKING:
    from learning.force.live import LiveForce as LiveForce
    from learning.force.live import LivePredictor as LivePredictor
    from learning.markers import Segmenter as Segmenter


def force_model(name: str) -> str:
    """Return the folder of a force model: of a folder, its web address, or `demo`.

    The name of an installed package's model is returned as it is.
    """
    from learning.errors import LearningError
    from learning.force.folder import model_name

    try:
        return model_name(name)
    except LearningError as error:
        raise ConfigError(str(error)) from None


def open_predictor(
    model: str, *, sensor: str, signal: str, description: str, depth: float, **options: Any
) -> LivePredictor:
    """Open a model of `force_model`, with options of `learning.force.live.open_live`.

    `signal` is the sensor's kind of stream, `depth` the depth that it is pressed to [m].
    """
    try:
        from learning.errors import LearningError
        from learning.force.live import open_live
        from learning.force.made_for import Conditions
    except ImportError as error:
        raise ConfigError(
            f"live: {error.name} is not installed; install the extra: "
            "pip install 'tactile-rig[learning]'"
        ) from None
    met = Conditions(sensor, signal, description, depth)
    try:
        return open_live(model, sensor=sensor, met=met, **options)
    except LearningError as error:
        raise ConfigError(str(error)) from None


def made_for(model: str) -> str:
    """Return the name of a model of `force_model`, its purpose and its origin if it states them."""
    from learning.force.made_for import made_for, origin_of

    made, origin = "; ".join(map(str, made_for(model))), origin_of(model)
    return Path(model).name + (f", made for {made}" if made else "") + (origin and f"; {origin}")


def open_segmenter(sensor: str) -> Segmenter:
    """Open the marker detection of a sensor, with the preset of its name."""
    from learning.markers import CameraPreset, Segmenter, preset, preset_of_sensor

    name = preset_of_sensor(sensor)
    settings = None if name is None else preset(name)
    if not isinstance(settings, CameraPreset):
        raise ConfigError(f"no preset detects markers of {sensor}")
    return Segmenter(settings)
