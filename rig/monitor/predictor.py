"""Access of the bench to force models; `learning` is imported only when a model is opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from rig.core.errors import ConfigError


class Reading(Protocol):
    """Prediction for one frame."""

    @property
    def force(self) -> tuple[float, float, float]:
        """Fx, Fy, Fz [N]."""

    @property
    def contact(self) -> bool:
        """True if the sensor is touched."""


class Predictor(Protocol):
    """Predicts a force for each frame."""

    def begin(self, frames: Any) -> None:
        """Set the reference from frames without contact (n, ...)."""

    def step(self, frame: Any) -> Reading | None:
        """Return the force of an image (h, w, 3) uint8 or counts (16, 3); None before begin."""


def open_predictor(
    model: Path, *, runtime: str, sensor: str, preset: str | None, threads: int
) -> Predictor:
    """Open a trained force model.

    Args:
        model: Folder of the model.
        runtime: onnx, openvino, openvino-bf16 or torch.
        sensor: Name of the sensor, which selects the marker detection preset.
        preset: Name or file of a preset to use instead.
        threads: Threads per step; 0: the runtime's choice.

    Raises:
        ConfigError: Model or preset do not exist, or the extra `learning` is not installed.
    """
    try:
        from learning.errors import LearningError
        from learning.force.live import open_live
    except ImportError as error:
        raise ConfigError(
            f"live: {error.name} is not installed; install the extra: "
            "pip install 'tactile-rig[learning]'"
        ) from None
    try:
        predictor = open_live(
            model, runtime=runtime, sensor=sensor, preset_name=preset, threads=threads
        )
    except LearningError as error:
        raise ConfigError(str(error)) from error
    return _Careful(predictor, LearningError)


class _Careful:
    """Predictor whose errors are raised as the rig's."""

    def __init__(self, predictor: Predictor, error: type[Exception]) -> None:
        self._predictor, self._error = predictor, error

    def begin(self, frames: Any) -> None:
        """Call the predictor's `begin`.

        Raises:
            ConfigError: The frames are invalid, or show contact.
        """
        try:
            self._predictor.begin(frames)
        except self._error as error:
            raise ConfigError(str(error)) from error

    def step(self, frame: Any) -> Reading | None:
        """Call the predictor's `step`.

        Raises:
            ConfigError: The frame is invalid: another size, or contact at the beginning.
        """
        try:
            return self._predictor.step(frame)
        except self._error as error:
            raise ConfigError(str(error)) from error
