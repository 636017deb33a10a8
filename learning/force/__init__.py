"""Three-axis force from sequences of marker images: network, training, ONNX, and what it costs.

`learning.force.train.train_force` makes a model, `load_force_model` opens one, and
`learning.force.stream` steps an exported one, frame by frame, without torch.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from learning.force.predict import ForcePredictor


def load_force_model(
    folder: str | os.PathLike[str], device: str | torch.device = "cpu"
) -> ForcePredictor:
    """Return the force model in the folder of a finished run, or of one of its checkpoints.

    Raises:
        LearningError: Not such a folder, a model of another kind, or weights that do not fit it.
    """
    from learning.force import predict

    return predict.load_force_model(folder, device)
