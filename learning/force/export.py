"""Export one step of a force model to ONNX, and verify it against torch."""

import copy
import logging
import os
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from learning.errors import LearningError
from learning.force.model import ForceModel, prepare, stored_shape
from learning.force.stream import (
    AFTER,
    FORCE,
    FRAME,
    REFERENCE,
    STATE,
    ForceStream,
    StepInputs,
    open_exported,
)

# Tolerated difference of the exported step from torch, as a fraction of the force range.
CLOSE = 1e-4
# Number of consecutive frames to compare.
_FRAMES = 4


class OneFrame(nn.Module):
    """One step from stored frame to newtons."""

    def __init__(self, model: ForceModel) -> None:
        """Wrap a model of any precision; forces in newtons are float32."""
        super().__init__()
        self.model = model

    def forward(
        self, frame: Tensor, state: Tensor, reference: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return force (n, 3) N and the next state, of a frame and a state (n, channels, h, w).

        The frame is (n, 256, 256) uint8 or (n, 3, 32, 32) float32; the reference, if the model
        needs it, is an image (n, 256, 256) uint8 without contact.
        """
        kind = next(self.model.parameters()).dtype
        prepared = prepare(frame, reference, self.model.inputs)
        normalised, after = self.model.step(prepared.to(kind), state.to(kind))
        return self.model.denormalise(normalised), after.float()


def torch_stream(model: ForceModel, one: nn.Module | None = None) -> ForceStream:
    """Return a stream that runs on the model's device by torch; `one` is in place of `OneFrame`."""
    run = OneFrame(model).eval() if one is None else one

    def step(values: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        with torch.inference_mode():
            tensors = {name: torch.from_numpy(value) for name, value in values.items()}
            force, after = run(**{n: t.to(model.device) for n, t in tensors.items()})
        return force.cpu().numpy(), after.cpu().numpy()

    inputs = model.inputs
    return ForceStream(
        step,  # type: ignore[arg-type]
        StepInputs(
            (1, *stored_shape(inputs)),
            inputs.form != "field",
            (1, *model.state_shape),
            inputs.needs_reference,
        ),
    )


def random_frames(model: ForceModel, count: int) -> np.ndarray:
    """Return random stored frames (count, ...) for comparisons and timing."""
    random = np.random.default_rng(0)
    shape = (count, *stored_shape(model.inputs))
    if model.inputs.form == "field":
        return random.normal(scale=5.0, size=shape).astype(np.float32)
    return random.integers(0, 256, shape, dtype=np.uint8)


def export_onnx(model: ForceModel, path: str | os.PathLike[str]) -> float:
    """Write the model's step atomically; return its deviation from torch as a fraction of the box.

    Raises:
        LearningError: The file already exists, or the exported model differs from torch.
    """
    out = Path(path)
    if out.exists():
        raise LearningError(f"{out}: exists; allowed: a new file")
    # Export and comparison run on a CPU copy; the model stays on its device.
    model = copy.deepcopy(model).cpu().eval()
    inputs = model.inputs
    frames = torch.from_numpy(random_frames(model, 2))
    arguments: tuple[Tensor, ...] = (frames[:1], model.initial_state(1))
    if inputs.needs_reference:
        arguments += (frames[1:],)
    temporary = out.with_suffix(".part.onnx")
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        with warnings.catch_warnings():
            # The exporter warns about internals; the result is verified below.
            warnings.simplefilter("ignore")
            logging.getLogger("torch.onnx").setLevel(logging.ERROR)
            program = torch.onnx.export(
                OneFrame(model),
                arguments,
                input_names=[FRAME, STATE, REFERENCE][: len(arguments)],
                output_names=[FORCE, AFTER],
                dynamo=True,
                verbose=False,
            )
        if program is None:
            raise LearningError(f"{out}: torch exported nothing")
        program.save(temporary, external_data=False)
        difference = _difference(model, temporary)
        if not difference <= CLOSE:
            raise LearningError(
                f"{out}: the exported model differs by {difference:.1e} of the box of forces; "
                f"allowed: {CLOSE:.0e}"
            )
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)
    return difference


def _difference(model: ForceModel, file: Path) -> float:
    """Return the largest force difference over a few frames, as a fraction of the box."""
    streams = torch_stream(model), open_exported(file, threads=1)
    first, *frames = random_frames(model, 1 + _FRAMES)
    box = (model.high - model.low).numpy()
    for stream in streams:
        stream.reset(first if stream.inputs.needs_reference else None)
    measured = np.isfinite(box)
    largest = 0.0
    for frame in frames:
        one, other = (stream.step(frame) for stream in streams)
        if (np.isfinite(one) != measured).any() or (np.isfinite(other) != measured).any():
            return np.inf
        # Random frames may lie far outside of what was learned, and so may their forces.
        size = np.maximum(box, np.abs(one))[measured]
        largest = max(largest, float(np.abs((one - other)[measured] / size).max()))
    return largest
