"""A translator that is not told how the source looks untouched: what that is worth, by its lack."""

from __future__ import annotations

from typing import TYPE_CHECKING

from learning.translation.translator import Translator

if TYPE_CHECKING:
    import torch


class Blind:
    """Gives frames and the target's reference to a translator, and nothing else."""

    def __init__(self, translator: Translator) -> None:
        """Wrap a translator that can do without, as `direct` can."""
        self._translator = translator
        self.name = f"{translator.name}-blind"

    def translate(
        self,
        source: torch.Tensor,
        target_reference: torch.Tensor,
        source_reference: torch.Tensor | None = None,
        *,
        ordered: bool = False,
    ) -> torch.Tensor:
        """Return the frames as the target would have shown them, bool (n, 480, 640).

        Args:
            source: Masks of the source, bool (n, 480, 640).
            target_reference: The untouched target, bool (480, 640).
            source_reference: Not looked at.
            ordered: Likewise: the first frame of a press would tell the same.

        Raises:
            LearningError: Wrong shapes or types, or a translator that needs the reference.
        """
        return self._translator.translate(source, target_reference)
