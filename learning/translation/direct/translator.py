"""Translation of masks by a trained direct network."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from learning.data.images import enlarge_images, shrink_masks, unit
from learning.training.checkpoint import read_model_folder
from learning.translation.direct.network import DirectNetwork
from learning.translation.direct.train import KIND, load_network
from learning.translation.translator import require_masks

# Frames per batch.
AT_ONCE = 32


class DirectTranslator:
    """Translates each frame independently with a direct network."""

    def __init__(self, network: DirectNetwork, name: str) -> None:
        """Wrap a trained network.

        Args:
            network: The network, on its device.
            name: Name in reports.
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
        """Return the frames as the target would have shown them, as `Translator.translate`.

        A missing source reference is the first frame of an ordered press; otherwise none is used.
        """
        require_masks(source, target_reference, source_reference)
        if source_reference is None and ordered and len(source):
            source_reference = source[0]
        device = self.network.absent.device
        reference = self.network.encode_reference(_image(target_reference, device))
        beside = _image(target_reference if source_reference is None else source_reference, device)
        masks = torch.empty_like(source)
        for first in range(0, len(source), AT_ONCE):
            frames = unit(shrink_masks(source[first : first + AT_ONCE].to(device)))
            given = torch.full((len(frames),), source_reference is not None, device=device)
            logits = self.network.translate(frames, reference, beside, given)
            grey = (255 * logits[:, 0].float().sigmoid()).round().to(torch.uint8)
            masks[first : first + AT_ONCE] = enlarge_images(grey).to(source.device)
        return masks


def _image(mask: Tensor, device: torch.device) -> Tensor:
    """Return a mask (480, 640) as the network's image (1, 1, 256, 256)."""
    return unit(shrink_masks(mask[None].to(device)))


# Load a trained direct translator from its folder.

_HASH_SHOWN = 8


def load(folder: Path, device: torch.device | str = "cpu") -> DirectTranslator:
    """Return the translator in a folder.

    Raises:
        LearningError: As `load_network`.
    """
    network, _ = load_network(folder, device)
    mark = read_model_folder(folder, KIND).hash()[:_HASH_SHOWN]
    return DirectTranslator(network, f"{KIND}[{mark}]")
