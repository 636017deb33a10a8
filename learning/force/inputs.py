"""What is stored of a frame becomes what the network takes; part of the exported graph as well."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from learning.errors import LearningError
from learning.force.settings import FIELD_SIDE, InputSettings

STORED_SIDE = 256
"""Side of stored images [px]."""
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's red, green and blue (the paper, Methods)."""


def stored_shape(inputs: InputSettings) -> tuple[int, ...]:
    """Return the shape of a stored frame: an image (256, 256) or a marker field (3, 32, 32)."""
    if inputs.form == "field":
        return (3, FIELD_SIDE, FIELD_SIDE)
    return (STORED_SIDE, STORED_SIDE)


def prepare(frames: Tensor, references: Tensor | None, inputs: InputSettings) -> Tensor:
    """Return what the network takes (n, planes, side, side), float.

    Args:
        frames: Images (n, 256, 256) uint8, or marker fields (n, 3, 32, 32) float: dx, dy [px of
            the 640 x 480 image] and the change of the logarithm of a marker's area.
        references: Images of the untouched sensor (n, 256, 256) uint8, where the form needs them.
        inputs: What is to be shown.

    Raises:
        LearningError: Frames of another shape or type, or a reference is missing.
    """
    require_stored(frames, inputs, "frames")
    if inputs.form == "field":
        scale = frames.new_tensor([inputs.field_scale_px, inputs.field_scale_px, 1.0])
        return frames / scale[:, None, None]
    image = _reduced(frames, inputs)
    if inputs.needs_reference:
        if references is None:
            raise LearningError(
                f"reference: missing; input {inputs.form} needs the untouched image"
            )
        require_stored(references, inputs, "reference")
        difference = image - _reduced(references, inputs)
        image = difference if inputs.form == "difference" else torch.cat((image, difference), dim=1)
    if inputs.channels == 3:
        image = image.expand(-1, 3, -1, -1)
    if inputs.imagenet:
        image = (image - image.new_tensor(_MEAN)[:, None, None]) / image.new_tensor(_DEVIATION)[
            :, None, None
        ]
    return image


def require_stored(frames: Tensor, inputs: InputSettings, name: str) -> None:
    """Refuse frames that are not stored as the input has them.

    Raises:
        LearningError: Another shape or type.
    """
    expected = stored_shape(inputs)
    kind = torch.float32 if inputs.form == "field" else torch.uint8
    if tuple(frames.shape[1:]) != expected or frames.dtype != kind:
        found = f"{tuple(frames.shape)} {str(frames.dtype).removeprefix('torch.')}"
        allowed = f"(n, {', '.join(map(str, expected))}) {str(kind).removeprefix('torch.')}"
        raise LearningError(f"{name}: found {found}; allowed: {allowed}, as {inputs.form} has it")


def _reduced(images: Tensor, inputs: InputSettings) -> Tensor:
    grey = images[:, None].to(torch.float32) * (inputs.marker_value / 255.0)
    factor = STORED_SIDE // inputs.side_px
    return functional.avg_pool2d(grey, factor) if factor > 1 else grey
