"""Refinement of marker masks by EfficientSAM through ONNX Runtime; the user provides the models.

The models are those of EfficientSAM's own export, in two files:

    encoder  batched_images (1, 3, H, W) float32, RGB from 0 to 1   -> image embeddings
    decoder  image_embeddings, batched_point_coords (1, Q, P, 2) float32 [px],
             batched_point_labels (1, Q, P) float32, orig_im_size (2,) int64
             -> masks (1, Q, M, H, W) logits, their IoU as predicted (1, Q, M)

A box is two points, labelled 2 (upper left) and 3 (lower right). Each of the Q prompts gets M
masks. The one with the best predicted IoU is used, where its logits are 0 or more.
"""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder.markers import HEIGHT, WIDTH, marker_centres

# Labels of the two corners of a box.
CORNERS = (2.0, 3.0)
# Maximum number of boxes in a call: each takes 3.7 MB of logits.
PROMPTS = 32
ENCODER_INPUTS = ("batched_images",)
DECODER_INPUTS = (
    "image_embeddings",
    "batched_point_coords",
    "batched_point_labels",
    "orig_im_size",
)


class EfficientSam:
    """An encoder and a decoder, ready to refine masks."""

    def __init__(self, encoder: Path, decoder: Path) -> None:
        self._encoder = _loaded(encoder, ENCODER_INPUTS)
        self._decoder = _loaded(decoder, DECODER_INPUTS)
        shape = {one.name: one.shape for one in self._decoder.get_inputs()}["batched_point_coords"]
        if len(shape) != 4:
            raise LearningError(
                f"{decoder}: batched_point_coords has {len(shape)} dimensions; allowed: 4"
            )
        prompts, points = shape[1], shape[2]
        if isinstance(points, int) and points != len(CORNERS):
            raise LearningError(
                f"{decoder}: takes {points} points a prompt; allowed: 2, the corners of a box "
                "(export it with that axis dynamic)"
            )
        self._prompts = prompts if isinstance(prompts, int) else PROMPTS
        self._fixed = isinstance(prompts, int)
        self._where = str(decoder)
        self.identity = {"encoder_sha256": _digest(encoder), "decoder_sha256": _digest(decoder)}
        """SHA-256 of both models."""

    def refined(
        self, view: NDArray[np.uint8], mask: NDArray[np.bool_], box_px: int
    ) -> NDArray[np.bool_]:
        """Return the union (480, 640) of the model's masks for boxes around markers, for RGB.

        `mask` is a rough one; `box_px` is half the side of a box around a marker's centre.
        """
        centres = marker_centres(mask)
        union = np.zeros((HEIGHT, WIDTH), np.bool_)
        if not len(centres):
            return union
        boxes = np.stack([centres - box_px, centres + box_px], axis=1)
        corners = np.clip(boxes, 0, [WIDTH - 1, HEIGHT - 1]).astype(np.float32)
        images = np.ascontiguousarray(view.transpose(2, 0, 1)[None]).astype(np.float32) / 255.0
        embeddings = self._encoder.run(None, {ENCODER_INPUTS[0]: images})[0]
        for first in range(0, len(corners), self._prompts):
            some = corners[first : first + self._prompts]
            union |= self._answered(embeddings, some)
        return union

    def _answered(
        self, embeddings: NDArray[np.float32], boxes: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        count = len(boxes)
        if self._fixed and count < self._prompts:
            # A model with a fixed number of prompts gets the last one repeatedly.
            last = np.repeat(boxes[-1:], self._prompts - count, axis=0)
            boxes = np.concatenate([boxes, last])
        answers = self._decoder.run(
            None,
            {
                "image_embeddings": embeddings,
                "batched_point_coords": boxes[None],
                "batched_point_labels": np.tile(np.array(CORNERS, np.float32), (1, len(boxes), 1)),
                "orig_im_size": np.array([HEIGHT, WIDTH], np.int64),
            },
        )
        logits, iou = answers[:2]
        if (
            logits.ndim != 5
            or logits.shape[:2] != (1, len(boxes))
            or logits.shape[3:] != (HEIGHT, WIDTH)
        ):
            raise LearningError(
                f"{self._where}: answers with shape {logits.shape}; expected (1, {len(boxes)}, "
                f"masks, {HEIGHT}, {WIDTH})"
            )
        if iou.shape != logits.shape[:3]:
            raise LearningError(
                f"{self._where}: answers with IoU of shape {iou.shape}; expected {logits.shape[:3]}"
            )
        best = iou[0].argmax(axis=1)
        chosen = logits[0, np.arange(len(boxes)), best] >= 0
        return np.asarray(chosen[:count].any(axis=0))


def _loaded(path: Path, inputs: tuple[str, ...]) -> Any:
    if not path.is_file():
        raise LearningError(f"{path}: no such file; allowed: a model exported to ONNX")
    try:
        import onnxruntime
        from onnxruntime.capi import onnxruntime_pybind11_state as state
    except ModuleNotFoundError as error:
        raise LearningError(
            f"EfficientSAM needs {error.name}: pip install 'tactile-rig[markers]'"
        ) from error
    try:
        model = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except (
        state.Fail,
        state.InvalidProtobuf,
        state.InvalidGraph,
        state.InvalidArgument,
        state.NotImplemented,
    ) as error:
        raise LearningError(f"{path}: is no model that ONNX Runtime can load: {error}") from error
    names = tuple(one.name for one in model.get_inputs())
    if set(names) != set(inputs):
        raise LearningError(
            f"{path}: takes {', '.join(names)}; expected {', '.join(inputs)}, as EfficientSAM's "
            "own export names them"
        )
    return model


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
