"""Forces of a stream of frames by an exported model on any runtime; needs no torch.

An exported model is one step: it takes a frame, the state and, if needed, the image without
contact, and returns the force in newtons and the next state. It takes stored frames, so that no
preprocessing is needed outside of it.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError

# Names of the inputs and outputs of a step.
FRAME, STATE, REFERENCE = "frame", "state", "reference"
FORCE, AFTER = "force", "state_after"
# Runtimes for an exported model; the last allows bfloat16 inside.
RUNTIMES = ("onnx", "openvino", "openvino-bf16")

Array = NDArray[Any]
# Function that runs one step: inputs by name to force (1, 3) N and state (1, c, h, w).
Step = Callable[[Mapping[str, Array]], tuple[Array, Array]]


@dataclass(frozen=True, slots=True)
class StepInputs:
    """Inputs of a step."""

    frame: tuple[int, ...]
    """Shape (1, ...) of a frame: an image (256, 256) uint8 or a marker field (3, 32, 32)."""
    is_image: bool
    """True for images, which are uint8; marker fields are float32."""
    state: tuple[int, ...]
    """Shape (1, c, h, w) of the state, float32."""
    needs_reference: bool
    """True if the image of the sensor without contact is an input."""


class ForceStream:
    """Predicts the force of each frame of a stream and keeps the state between frames."""

    def __init__(self, step: Step, inputs: StepInputs) -> None:
        """Start from the initial state; `reset` sets the reference if one is needed."""
        self._step, self.inputs = step, inputs
        self._reference: Array | None = None
        self._state = np.zeros(inputs.state, np.float32)

    def reset(self, reference: Array | None = None) -> None:
        """Reset the state, as at no contact, and optionally replace the reference (256, 256) uint8.

        Raises:
            LearningError: The reference has another shape or type.
        """
        if reference is not None:
            self._reference = self._checked(reference, REFERENCE)
        self._state = np.zeros(self.inputs.state, np.float32)

    def step(self, frame: Array) -> NDArray[np.float64]:
        """Return the force (3,) N of the next frame (256, 256) uint8, or field (3, 32, 32).

        Raises:
            LearningError: The frame has another shape or type, or the reference is missing.
        """
        inputs = {FRAME: self._checked(frame, FRAME), STATE: self._state}
        if self.inputs.needs_reference:
            if self._reference is None:
                raise LearningError("reference: missing; pass the image without contact to reset()")
            inputs[REFERENCE] = self._reference
        force, self._state = self._step(inputs)
        return np.asarray(force[0], np.float64)

    def _checked(self, frame: Array, name: str) -> Array:
        kind = np.dtype(np.uint8 if self.inputs.is_image else np.float32)
        if frame.shape != self.inputs.frame[1:] or frame.dtype != kind:
            allowed = f"{self.inputs.frame[1:]} {kind}"
            raise LearningError(f"{name}: found {frame.shape} {frame.dtype}; allowed: {allowed}")
        return frame[None]


def open_exported(
    path: str | os.PathLike[str], *, runtime: str = RUNTIMES[0], threads: int = 0
) -> ForceStream:
    """Return a stream that runs an exported model: `model.onnx`, or the folder that has one.

    With `threads` 0 their number is the runtime's default.

    Raises:
        LearningError: The file or runtime does not exist, the model is of another kind, or the
            runtime is not installed.
    """
    if runtime not in RUNTIMES:
        listed = ", ".join(RUNTIMES)
        raise LearningError(
            f"runtime: found {runtime!r}; allowed: {listed}, and of a live stream auto and torch"
        )
    file = Path(path)
    file = file / "model.onnx" if file.is_dir() else file
    if not file.is_file():
        raise LearningError(
            f"{file}: no such file; `tactile train force` writes it, --runtime torch needs none"
        )
    if runtime == RUNTIMES[0]:
        return _onnxruntime(file, threads)
    return _openvino(file, threads, bf16=runtime == "openvino-bf16")


def _onnxruntime(file: Path, threads: int) -> ForceStream:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Threads that spin between frames would take cores from the camera reader.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(
            str(file), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # each kind of invalid file raises another class there
        raise LearningError(f"{file}: cannot be loaded as an ONNX model: {error}") from error
    shapes = {each.name: tuple(each.shape) for each in session.get_inputs()}
    images = {each.name for each in session.get_inputs() if each.type == "tensor(uint8)"}
    inputs = _inputs(file, shapes, images)

    def step(values: Mapping[str, Array]) -> tuple[Array, Array]:
        force, after = session.run([FORCE, AFTER], dict(values))
        return force, after

    return ForceStream(step, inputs)


def _openvino(file: Path, threads: int, *, bf16: bool) -> ForceStream:
    try:
        import openvino
    except ImportError:
        raise LearningError("openvino: not installed; pip install openvino") from None
    core = openvino.Core()
    try:
        model = core.read_model(str(file))
    except RuntimeError as error:
        raise LearningError(f"{file}: cannot be loaded as an ONNX model: {error}") from error
    wanted: dict[str, Any] = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_PRECISION_HINT": "bf16" if bf16 else "f32",
    }
    if threads:
        wanted["INFERENCE_NUM_THREADS"] = threads
    compiled = core.compile_model(model, "CPU", wanted)
    shapes = {each.any_name: tuple(each.shape) for each in compiled.inputs}
    images = {each.any_name for each in compiled.inputs if each.element_type == openvino.Type.u8}
    inputs = _inputs(file, shapes, images)
    request = compiled.create_infer_request()

    def step(values: Mapping[str, Array]) -> tuple[Array, Array]:
        outputs = request.infer(dict(values))
        return outputs[FORCE].copy(), outputs[AFTER].copy()

    return ForceStream(step, inputs)


def _inputs(file: Path, shapes: Mapping[str, tuple[Any, ...]], images: set[str]) -> StepInputs:
    if not {FRAME, STATE} <= shapes.keys() <= {FRAME, STATE, REFERENCE}:
        raise LearningError(
            f"{file}: found inputs {', '.join(shapes)}; allowed: {FRAME}, {STATE}, {REFERENCE}, as "
            "`tactile train force` writes them"
        )
    return StepInputs(shapes[FRAME], FRAME in images, shapes[STATE], REFERENCE in shapes)
