"""Access of the bench to `learning`, which is imported only when it is used."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import simplejpeg

from rig.core.errors import ConfigError

Triple = tuple[float, float, float]


class Reading(Protocol):
    """Prediction for one frame."""

    @property
    def force(self) -> Triple:
        """Fx, Fy, Fz [N]."""

    @property
    def contact(self) -> bool:
        """True if the sensor is touched."""

    @property
    def interval(self) -> tuple[Triple, Triple] | None:
        """Lower and upper ends of the 90 % intervals of Fx, Fy, Fz [N]; None without."""

    @property
    def outside(self) -> bool:
        """True if the frame is outside of what the model learned from."""

    @property
    def before(self) -> Triple | None:
        """Fx, Fy, Fz that the model before the transfer predicts [N]; None without."""


class Predictor(Protocol):
    """Predicts a force for each frame."""

    @property
    def has_intervals(self) -> bool:
        """True if readings have intervals."""

    @property
    def has_before(self) -> bool:
        """True if readings have forces of the model before the transfer."""

    def begin(self, frames: Any) -> None:
        """Set the reference from frames without contact (n, ...)."""

    def step(self, frame: Any) -> Reading | None:
        """Return the force of an image (h, w, 3) uint8 or counts (16, 3); None before begin."""


def open_predictor(
    model: Path,
    *,
    before: Path | None = None,
    runtime: str,
    sensor: str,
    preset: str | None,
    threads: int,
) -> Predictor:
    """Open a trained force model.

    Args:
        model: Folder of the model.
        before: Folder of the source's model, whose forces are shown beside.
        runtime: auto, onnx, openvino, openvino-bf16 or torch.
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
            model,
            before=before,
            runtime=runtime,
            sensor=sensor,
            preset_name=preset,
            threads=threads,
        )
    except LearningError as error:
        raise ConfigError(str(error)) from error
    return _Careful(predictor, LearningError, predictor.intervals is not None, predictor.has_before)


class MarkerFinder:
    """Finds the markers in a sensor's images.

    Args:
        segmenter: Segmenter of `learning.markers`.
        error: Class of its errors.
    """

    def __init__(self, segmenter: Any, error: type[Exception]) -> None:
        self._segmenter, self._error = segmenter, error
        self.tolerance = int(segmenter.preset.tolerance)
        """Number of missing or new markers that is no fault."""

    def mask(self, jpeg: bytes) -> npt.NDArray[np.bool_]:
        """Return the mask (480, 640) of a JPEG.

        Raises:
            ConfigError: It cannot be decoded, or does not fit the preset.
        """
        try:
            found = simplejpeg.decode_jpeg(jpeg)
        except ValueError as error:
            raise ConfigError(f"an image that cannot be decoded: {error}") from error
        try:
            return np.asarray(self._segmenter.mask(found))
        except self._error as error:
            raise ConfigError(str(error)) from error


def open_marker_finder(sensor: str) -> MarkerFinder:
    """Open the marker detection of a sensor, with the preset of its name.

    Raises:
        ConfigError: It has no preset, or one without markers.
    """
    from learning.errors import LearningError
    from learning.markers import CameraPreset, Segmenter, preset, preset_of_sensor

    name = preset_of_sensor(sensor)
    found = None if name is None else preset(name)
    if not isinstance(found, CameraPreset):
        raise ConfigError(f"no preset detects markers of {sensor}")
    return MarkerFinder(Segmenter(found), LearningError)


class _Careful:
    """Predictor whose errors are raised as the rig's."""

    def __init__(
        self, predictor: Any, error: type[Exception], has_intervals: bool, has_before: bool
    ) -> None:
        self._predictor, self._error = predictor, error
        self.has_intervals, self.has_before = has_intervals, has_before

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
            reading: Reading | None = self._predictor.step(frame)
        except self._error as error:
            raise ConfigError(str(error)) from error
        return reading
