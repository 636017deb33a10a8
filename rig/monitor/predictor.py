"""The one door from the bench to a force model: `learning` is imported when it is opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from rig.core.errors import ConfigError


class Reading(Protocol):
    """What a predictor says of one frame."""

    @property
    def force(self) -> tuple[float, float, float]:
        """Fx, Fy, Fz [N]."""

    @property
    def contact(self) -> bool:
        """Whether the sensor is touched."""


class Predictor(Protocol):
    """Frame after frame in, force after force out."""

    def begin(self, frames: Any) -> None:
        """Take the untouched sensor from frames without contact (n, ...)."""

    def step(self, frame: Any) -> Reading | None:
        """The force of a picture (h, w, 3) uint8 or of counts (16, 3); None: not yet begun."""


def open_predictor(
    model: Path, *, runtime: str, sensor: str, preset: str | None, threads: int
) -> Predictor:
    """The predictor of a trained force model.

    Args:
        model: Its folder.
        runtime: onnx, openvino, openvino-bf16 or torch.
        sensor: Name of the sensor, which tells how markers are found.
        preset: Name or file that says it instead.
        threads: Of a step; 0: what the runtime thinks best.

    Raises:
        ConfigError: No such model or preset, or the extra `learning` is not installed.
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
    """A predictor whose errors are the rig's."""

    def __init__(self, predictor: Predictor, error: type[Exception]) -> None:
        self._predictor, self._error = predictor, error

    def begin(self, frames: Any) -> None:
        """The same.

        Raises:
            ConfigError: Frames that cannot be used, or that are not untouched.
        """
        try:
            self._predictor.begin(frames)
        except self._error as error:
            raise ConfigError(str(error)) from error

    def step(self, frame: Any) -> Reading | None:
        """The same.

        Raises:
            ConfigError: A frame that cannot be used: another size, or touched at the beginning.
        """
        try:
            return self._predictor.step(frame)
        except self._error as error:
            raise ConfigError(str(error)) from error
