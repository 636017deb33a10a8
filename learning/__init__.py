"""Force sensing from marker images, trained on recordings that `recorder` stores.

A public name is imported when it is first used: the data set needs PyTorch, most commands do not.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from learning.errors import LearningError

if TYPE_CHECKING:
    from learning.data.dataset import TactileDataset

__all__ = ["LearningError", "TactileDataset"]


def __getattr__(name: str) -> Any:
    if name == "TactileDataset":
        return import_module("learning.data.dataset").TactileDataset
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
