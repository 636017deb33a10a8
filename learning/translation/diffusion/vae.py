"""The marker VAE: SD-Turbo's autoencoder with an adapter for marker images.

Its adapter initialises the translator's encoder and decoder, and is the reference encoder's. Its
latents are the features in which sets of images are compared.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import nn

from learning.training.checkpoint import read_model_folder
from learning.translation.diffusion.network import (
    VAE_ADAPTER,
    VAE_TARGETS,
    VaeSettings,
    adapter_tensors,
    add_adapter,
    is_adapter,
    keep_in_state,
    posterior,
)
from learning.translation.diffusion.weights import base_of, read_vae, require_base

# Kind of a marker VAE's folder.
KIND = "marker-vae"


class MarkerVae(nn.Module):
    """SD-Turbo's autoencoder with an adapter, for images (n, 1, h, w) in [0, 1].

    Its state contains only the adapter, or all weights if all are trained.
    """

    def __init__(self, vae: Any, settings: VaeSettings, *, decode_scaled: bool = False) -> None:
        """Add the adapter, unless all weights are trained.

        Args:
            vae: SD-Turbo's autoencoder; becomes part of the network.
            settings: Settings of the network.
            decode_scaled: True if the decoder takes the latent times its scaling factor.
        """
        super().__init__()
        if not settings.whole:
            add_adapter(vae, VAE_ADAPTER, settings.vae_rank, VAE_TARGETS, seed=settings.seed)
        if settings.gradient_checkpointing:
            vae.enable_gradient_checkpointing()
        self.vae = vae
        self.zero_one = settings.pixel_range == "zero_one"
        self.decode_scaled = decode_scaled
        if not settings.whole:
            keep_in_state(self, is_adapter)

    def forward(
        self, images: torch.Tensor, noise: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return images, their reconstructions and the divergence of their latents.

        Args:
            images: Images (n, 1, h, w) in [0, 1].
            noise: Standard normal noise of a latent's shape; None: decode the posterior's mean.

        Returns:
            Images and their reconstructions (n, 3, h, w) in the network's range, and the
            divergence of each latent from the normal distribution (n,).
        """
        true = self._native(images)
        found = posterior(self.vae, true, 1.0)
        latent = found.at(noise)
        if self.decode_scaled:
            latent = latent * float(self.vae.config.scaling_factor)
        made = self.vae.decode(latent).sample.float()
        variance = found.deviation**2
        divergence = 0.5 * (found.mean**2 + variance - variance.log() - 1).sum(dim=(1, 2, 3))
        return true, made, divergence

    def adapter(self) -> dict[str, torch.Tensor]:
        """Return the adapter's tensors under the names of the translator's autoencoder."""
        return adapter_tensors(self.vae)

    def latent(self, images: torch.Tensor) -> torch.Tensor:
        """Return the mean latents (n, channels, h/8, w/8) of images (n, 1, h, w) in [0, 1]."""
        return posterior(self.vae, self._native(images), 1.0).mean

    def _native(self, images: torch.Tensor) -> torch.Tensor:
        return (images if self.zero_one else images * 2 - 1).expand(-1, 3, -1, -1)


def load_vae(folder: Path, device: str = "cpu") -> MarkerVae:
    """Return the marker VAE in a folder, in evaluation mode."""
    found = read_model_folder(folder, KIND)
    return found.load(MarkerVae(read_vae(base_of(found)), found.settings(VaeSettings)), device)


def load_vae_adapter(folder: str | Path, base: str) -> dict[str, torch.Tensor]:
    """Return the adapter of a trained marker VAE from its folder.

    Args:
        folder: Run folder of the autoencoder.
        base: Fingerprint of the published weights that it will be applied to.
    """
    found = read_model_folder(Path(folder), KIND)
    require_base(found, base)
    return vae_adapter_of(found.weights())


def vae_adapter_of(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the autoencoder's adapter in the state of a translator or of an autoencoder.

    If all weights were trained, there is no adapter, and all of the autoencoder's are returned.
    """
    own = {
        name.removeprefix("vae."): tensor
        for name, tensor in state.items()
        if name.startswith("vae.")
    }
    return {name: tensor for name, tensor in own.items() if is_adapter(name)} or own
