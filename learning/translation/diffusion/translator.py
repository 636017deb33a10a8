"""A trained diffusion network with the interface of translators."""

from dataclasses import replace
from pathlib import Path

import torch

from learning.data.images import enlarge_images, shrink_masks, unit
from learning.training.checkpoint import ModelFolder, load_weights, read_model_folder
from learning.translation.diffusion.network import (
    KIND,
    DiffusionNetworkSettings,
    MarkerToMarker,
    build,
    fuse,
    rank_of,
    vae_adapter_of,
)
from learning.translation.diffusion.weights import base_of, read_unet, read_vae
from learning.translation.translator import require_masks, source_reference_of

# Frames translated at once (the paper, Methods).
BATCH = 8
_KEPT = 64  # cached latents of references


class DiffusionTranslator:
    """Translates each frame independently; latents of references are cached."""

    def __init__(
        self,
        network: MarkerToMarker,
        name: str,
        *,
        batch: int = BATCH,
        precision: torch.dtype = torch.float32,
    ) -> None:
        """Wrap a network on its device for evaluation; the step to the clean latent is float32."""
        self._network = network.eval().requires_grad_(False)
        self.name = name
        """Name in reports."""
        self._batch, self._precision = batch, precision
        self._latents: dict[bytes, torch.Tensor] = {}

    def translate(
        self,
        source: torch.Tensor,
        target_reference: torch.Tensor,
        source_reference: torch.Tensor | None = None,
        *,
        ordered: bool = False,
    ) -> torch.Tensor:
        """Return the frames as the target would have shown them, as `Translator.translate`."""
        require_masks(source, target_reference, source_reference)
        if not len(source):
            return source.clone()
        target, own = self._latent(target_reference), None
        if self._network.tokens.source_reference:
            own = self._latent(source_reference_of(source, source_reference, ordered=ordered))
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
            generated = self._network(images, *expanded)
        return enlarge_images(self._network.grey(generated))

    def _latent(self, reference: torch.Tensor) -> torch.Tensor:
        """Return the latent (1, channels, h, w) of a mask without contact (480, 640)."""
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


# A run's folder holds only adapters, tokens and the UNet's first layer, beside published weights.


def load(folder: str | Path, device: torch.device | str = "cpu") -> DiffusionTranslator:
    """Return the translator in the folder of a training run, its adapters fused for speed.

    The network computes in bfloat16 on GPUs that support it.
    """
    stored, device = read_model_folder(Path(folder), KIND), torch.device(device)
    network = load_network(stored)
    fuse(network.unet)
    fuse(network.vae)
    lower = device.type == "cuda" and torch.cuda.is_bf16_supported()
    return DiffusionTranslator(
        network.to(device),
        f"{KIND} {stored.hash()[:8]}",
        precision=torch.bfloat16 if lower else torch.float32,
    )


def load_network(stored: ModelFolder) -> MarkerToMarker:
    """Return the network in a folder, with adapters separate from the published weights."""
    settings = stored.settings(DiffusionNetworkSettings)
    own = stored.weights()
    base = base_of(stored)
    if not settings.whole:
        settings = replace(settings, vae_rank=rank_of(vae_adapter_of(own)))
    network = build(read_unet(base), read_vae(base), settings)
    load_weights(network, own, str(stored.file()))
    return network
