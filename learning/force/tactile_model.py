"""A force model as a researcher uses it: frames in, forces in newtons and their intervals out.

Frames become inputs of the network as for `tactile live`, and forces as for `tactile predict`.
"""

import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.errors import LearningError
from learning.force.export import torch_stream
from learning.force.folder import model_name
from learning.force.intervals import read_intervals
from learning.force.live import MASKS, LivePredictor, open_live
from learning.force.loading import load_force_model
from recorder.markers import HEIGHT, WIDTH

# Times that a network with a state is shown an independent frame, as in a press that is held.
HELD = 8
# Shapes of frames by kind, without their number; 0: any side.
_SHAPES = {"taxels": (16, 3), "mask": (HEIGHT, WIDTH), "picture": (0, 0, 3)}
Floats = NDArray[np.float64]


class Forces(NamedTuple):
    """Fx, Fy, Fz of n frames (n, 3) [N] on the sensor, with 90 % intervals from `low` to `high`.

    Pressing is negative Fz. Unknown axes, and the intervals of a model without, are NaN. `outside`
    flags frames (n,) unlike those that the model learned from; None: it is not known.
    """

    force: Floats
    low: Floats
    high: Floats
    outside: NDArray[np.bool_] | None


class TactileModel:
    """An opened force model, made by `load`."""

    def __init__(self, name: str, preset: str | None, device: str) -> None:
        self.force_model = load_force_model(name, device)
        """The network, a `torch.nn.Module`."""
        self.intervals = read_intervals(Path(name))
        """Intervals of its forces; None if it has none."""
        self._name, self._preset = name, preset
        self._network = torch_stream(self.force_model)
        self._kind, self._rest = "", np.zeros(0)

    def reference(self, frames: ArrayLike) -> None:
        """Take the frame without contact, of the kind that `predict` gets, for all later calls.

        Several are averaged; by their differences `stream` tells contact from noise.

        Raises:
            LearningError: No such frames, or they differ as if the sensor was touched.
        """
        kind, values = self._read(frames, "reference")
        if kind == "input":
            self._network.reset(values[0] if self._network.inputs.needs_reference else None)
        else:
            self._predictor = self._opened(kind, values)
        self._kind, self._rest = kind, values

    def predict(self, frames: ArrayLike, *, sequence: bool | None = None) -> Forces:
        """Return the forces of frames.

        Args:
            frames: Pictures (n, h, w, 3) uint8 RGB; masks of markers (n, 480, 640) of 0 and 1 or
                255; counts of taxels (n, 16, 3); or inputs of the network: images (n, 256, 256)
                uint8, fields (n, 3, 32, 32) float32, shading (n, 3, 128, 128) uint8. Or one frame.
            sequence: True for one press in order of time, which begins without contact: state and
                tracked markers go from frame to frame. False for independent frames; a network
                with a state is shown each repeatedly, as in a press that is held, which is less
                accurate. It may be left out for one frame, and if order means nothing to a model.

        Raises:
            LearningError: No such frames, no reference, or `sequence` is needed.
        """
        kind, values = self._read(frames, "frames")
        inputs = self.force_model.inputs
        if sequence is None and len(values) > 1 and not (inputs.alone and inputs.form != "field"):
            raise LearningError(
                f"sequence: missing; allowed: True if the {len(values)} frames are one press in "
                "order of time that begins without contact, False if they are independent"
            )
        if kind != self._kind and (kind != "input" or inputs.needs_reference):
            raise LearningError(
                f"reference: missing; allowed: model.reference({kind}) without contact, before"
            )
        if kind == "picture" and values.shape[1:] != self._rest.shape[1:]:
            raise LearningError(
                f"frames: found pictures {values.shape[1:]}; allowed: {self._rest.shape[1:]}, as "
                "the reference"
            )
        times = 1 if sequence or inputs.alone else HELD
        forces: list[Any] = []
        outside: list[bool] = []
        for press in [values] if sequence else values[:, None]:
            if kind == "input":
                self._network.reset()
                forces += [[self._network.step(one) for _ in range(times)][-1] for one in press]
                continue
            found = self._predictor.press(press, times)
            forces += [one.force for one in found]
            outside += [one.outside for one in found]
        force = np.array(forces)
        if self.intervals is None:
            return Forces(force, force * np.nan, force * np.nan, None)
        return Forces(force, *self.intervals.of(force), np.array(outside) if outside else None)

    def stream(self) -> LivePredictor:
        """Return a predictor, whose `step(frame)` returns the `LiveForce` of the next frame.

        Its state begins again while nothing touches the sensor. Without `reference` it takes the
        first ten frames, of which `step` returns None.
        """
        return self._opened(self._kind or "picture", self._rest)

    def _opened(self, kind: str, rest: NDArray[Any]) -> LivePredictor:
        name, network = MASKS if kind == "mask" else self._preset, torch_stream(self.force_model)
        predictor = open_live(self._name, preset_name=name, warn=warnings.warn, network=network)
        if len(rest):
            predictor.begin(rest)
        return predictor

    def _read(self, frames: ArrayLike, name: str) -> tuple[str, NDArray[Any]]:
        """Return the kind of frames, by their shape, and the frames (n, ...)."""
        values, network = np.asarray(frames), self._network.inputs
        for kind, shape in {**_SHAPES, "input": network.frame[1:]}.items():
            ends = values.shape[-len(shape) :]
            alike = all(side in (0, end) for side, end in zip(shape, ends, strict=False))
            if not (alike and values.size and values.ndim - len(shape) in (0, 1)):
                continue
            values = values.reshape(-1, *ends)
            if kind == "mask" and np.isin(values, (0, 1, 255)).all():
                return kind, values != 0
            is_image = kind == "picture" or (kind == "input" and network.is_image)
            if kind != "mask" and (not is_image or (values.dtype == np.uint8 and values.max() > 1)):
                return kind, values
        found, own = f"{values.dtype} {np.shape(frames)}", ", ".join(map(str, network.frame[1:]))
        if values.size and values.dtype.kind in "biuf":
            found += f" from {float(values.min()):g} to {float(values.max()):g}"
        raise LearningError(
            f"{name}: found {found}; allowed: pictures (n, h, w, 3) uint8, RGB to 255; masks "
            f"(n, {HEIGHT}, {WIDTH}) of 0 and 255; taxels (n, 16, 3); or (n, {own})"
        )


def load(
    model: str | os.PathLike[str], *, preset: str | None = None, device: str = "cpu"
) -> TactileModel:
    """Open a force model.

    Args:
        model: Its folder or a file in it, a name such as `demo`, or a URL that fsspec knows, which
            is copied to `models/` once.
        preset: How markers are found, a name or a YAML file; None: as when the model learned.
        device: Device of the network, such as `cuda`.

    Raises:
        LearningError: There is no such model, or it cannot be read.
    """
    return TactileModel(model_name(os.fspath(model)), preset, device)
