"""Masks to masks by a trained direct network."""

from __future__ import annotations

import torch
from torch import Tensor

from learning.data.images import enlarge_images, shrink_masks
from learning.translation.autoencoder.images import scaled
from learning.translation.direct.network import DirectNetwork
from learning.translation.translator import require_masks

AT_ONCE = 32
"""Frames that go through the network together."""


class DirectTranslator:
    """Makes of one sensor's frames what another would have shown; sees each frame on its own."""

    def __init__(self, network: DirectNetwork, name: str) -> None:
        """Translate by a network.

        Args:
            network: For use, on the device where it computes.
            name: How it is called in reports.
        """
        self.network, self.name = network.eval(), name

    @torch.no_grad()
    def translate(
        self,
        source: Tensor,
        target_reference: Tensor,
        source_reference: Tensor | None = None,
        *,
        ordered: bool = False,
    ) -> Tensor:
        """Return frames as the target would have shown them, bool (n, 480, 640), where source is.

        Args:
            source: Masks of the source, bool (n, 480, 640).
            target_reference: The untouched target, bool (480, 640).
            source_reference: The untouched source, bool (480, 640). Without it the first frame of
                an ordered press is taken; without both the network does without.
            ordered: The frames are one press in order of time, which begins untouched.

        Raises:
            LearningError: Wrong shapes or types.
        """
        require_masks(source, target_reference, source_reference)
        if source_reference is None and ordered and len(source):
            source_reference = source[0]
        device = self.network.absent.device
        reference = self.network.encode_reference(_image(target_reference, device))
        beside = _image(target_reference if source_reference is None else source_reference, device)
        masks = torch.empty_like(source)
        for first in range(0, len(source), AT_ONCE):
            frames = scaled(shrink_masks(source[first : first + AT_ONCE].to(device)))
            given = torch.full((len(frames),), source_reference is not None, device=device)
            logits = self.network.translate(frames, reference, beside, given)
            grey = (255 * logits[:, 0].float().sigmoid()).round().to(torch.uint8)
            masks[first : first + AT_ONCE] = enlarge_images(grey).to(source.device)
        return masks


def _image(mask: Tensor, device: torch.device) -> Tensor:
    """Return a mask (480, 640) as the network's image (1, 1, 256, 256)."""
    return scaled(shrink_masks(mask[None].to(device)))
