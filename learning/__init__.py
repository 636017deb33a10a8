"""From signals to force: marker images, published recordings. Reads what `recorder` stores."""

from learning.errors import LearningError

__all__ = ["LearningError"]
