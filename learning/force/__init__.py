"""Three-axis force from sequences of marker images: network, training, ONNX export, live use.

`learning.force.train.train_force` trains a model, `load_force_model` opens one, and
`learning.force.stream` runs an exported one frame by frame, without torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from learning.force.export import export_onnx
    from learning.force.live import open_live
    from learning.force.model import ForceModel, load_force_model
    from learning.force.stream import ForceStream, open_exported

__all__ = [
    "ForceModel",
    "ForceStream",
    "export_onnx",
    "load_force_model",
    "open_exported",
    "open_live",
]

_MODULES = {
    "ForceModel": "model",
    "ForceStream": "stream",
    "export_onnx": "export",
    "load_force_model": "model",
    "open_exported": "stream",
    "open_live": "live",
}


def __getattr__(name: str) -> Any:
    """Import a public name on demand, so that running an exported model needs no torch."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
