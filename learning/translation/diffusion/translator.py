"""A trained diffusion network behind the interface of translators."""

from __future__ import annotations

import torch

from learning.data.images import enlarge_images, shrink_masks
from learning.errors import LearningError
from learning.translation.diffusion.network import MarkerToMarker
from learning.translation.diffusion.pairs import unit
from learning.translation.translator import require_masks

BATCH = 8
"""Frames that are translated together (the paper, Methods)."""
_KEPT = 64  # references whose latents are kept


class DiffusionTranslator:
    """Translates frame by frame; the latents of references are computed once each."""

    def __init__(
        self,
        network: MarkerToMarker,
        name: str,
        *,
        batch: int = BATCH,
        precision: torch.dtype = torch.float32,
    ) -> None:
        """Take a network to a device and into evaluation before.

        Args:
            network: What translates.
            name: How it is called in reports.
            batch: Frames at once.
            precision: Of the network; the step to the clean latent is float32 in any case.
        """
        self._network, self._name = network.eval().requires_grad_(False), name
        self._batch, self._precision = batch, precision
        self._latents: dict[bytes, torch.Tensor] = {}

    @property
    def name(self) -> str:
        """How it is called in reports."""
        return self._name

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
            source_reference: The untouched source, bool (480, 640).
            ordered: The frames are one press in order of time, which begins untouched.

        Raises:
            LearningError: Wrong shapes or types, or the source's reference is needed and missing.
        """
        require_masks(source, target_reference, source_reference)
        if not len(source):
            return source.clone()
        needed = self._network.tokens.source_reference
        if needed and source_reference is None:
            if not ordered:
                raise LearningError(
                    "source_reference: missing; this model needs it, or frames of one press in "
                    "order (ordered=True)"
                )
            source_reference = source[0]
        target = self._latent(target_reference)
        own = self._latent(source_reference) if needed and source_reference is not None else None
        parts = [self._translated(part, target, own) for part in torch.split(source, self._batch)]
        return torch.cat(parts).to(source.device)

    @torch.no_grad()
    def _translated(
        self, masks: torch.Tensor, target: torch.Tensor, own: torch.Tensor | None
    ) -> torch.Tensor:
        device = target.device
        images = unit(shrink_masks(masks.to(device)))
        expanded = [
            None if each is None else each.expand(len(masks), -1, -1, -1) for each in (target, own)
        ]
        with self._arithmetic(device):
            made = self._network(images, *expanded)
        return enlarge_images(self._network.grey(made))

    def _latent(self, reference: torch.Tensor) -> torch.Tensor:
        """Return the latent of an untouched mask (480, 640): (1, channels, h, w)."""
        key = reference.cpu().numpy().tobytes()
        if key not in self._latents:
            if len(self._latents) >= _KEPT:
                self._latents.clear()
            device = next(self._network.parameters()).device
            image = unit(shrink_masks(reference[None].to(device)))
            with self._arithmetic(device):
                self._latents[key] = self._network.reference_posterior(image).mean
        return self._latents[key]

    def _arithmetic(self, device: torch.device) -> torch.autocast:
        lower = self._precision != torch.float32
        return torch.autocast(device.type, dtype=self._precision, enabled=lower)
