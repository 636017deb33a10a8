"""Force sensing from marker images, trained on recordings that `recorder` stores."""

from learning.errors import LearningError

__all__ = ["LearningError"]
