"""Access of the bench to `learning`, which is imported only when it is used."""

from __future__ import annotations

from typing import TYPE_CHECKING

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
    model: str, *, before: str | None, runtime: str, sensor: str, preset: str | None
) -> LivePredictor:
    """Open a model of `force_model`; forces of the model `before` are shown beside.

    `sensor` selects the marker detection preset, unless `preset` names one or its file.
    """
    try:
        from learning.force.live import open_live
    except ImportError as error:
        raise ConfigError(
            f"live: {error.name} is not installed; install the extra: "
            "pip install 'tactile-rig[learning]'"
        ) from None
    return open_live(model, before=before, runtime=runtime, sensor=sensor, preset_name=preset)


def open_segmenter(sensor: str) -> Segmenter:
    """Open the marker detection of a sensor, with the preset of its name."""
    from learning.markers import CameraPreset, Segmenter, preset, preset_of_sensor

    name = preset_of_sensor(sensor)
    settings = None if name is None else preset(name)
    if not isinstance(settings, CameraPreset):
        raise ConfigError(f"no preset detects markers of {sensor}")
    return Segmenter(settings)
