"""The marker-to-marker network: SD-Turbo's autoencoder and UNet with adapters, in one step.

    source --encoder--> latent --UNet, at t = 999--> noise -> clean latent --decoder--> target
                                  ^ cross-attention
    untouched target --frozen reference encoder--> tokens

The frozen weights are the published ones; what `state_dict` returns is only what is not theirs.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import nn

from learning.errors import LearningError
from learning.training.checkpoint import load_weights
from learning.translation.diffusion.conditioning import ReferenceTokens
from learning.translation.diffusion.settings import Range, TranslatorSettings
from learning.translation.diffusion.weights import vendor

# Low-rank adapters (LoRA) on the frozen networks: where they sit and which parameters learn.
#
# Names of adapters and targets are those of the authors' checkpoints, so that these load by name.

# Name of the UNet's adapter.
UNET_ADAPTER = "unet_lora"
# Name of the autoencoder's adapter, the translator's and the reference encoder's alike.
VAE_ADAPTER = "ref_encoder_lora"
# Ends of the names of the UNet's layers that get an adapter (authors' code).
UNET_TARGETS = (
    "to_k",
    "to_q",
    "to_v",
    "to_out.0",
    "conv",
    "conv1",
    "conv2",
    "conv_shortcut",
    "conv_out",
    "proj_in",
    "proj_out",
    "ff.net.2",
    "ff.net.0.proj",
)
# The same for the autoencoder's layers (authors' code).
VAE_TARGETS = (
    "conv1",
    "conv2",
    "conv_in",
    "conv_shortcut",
    "conv",
    "conv_out",
    "to_k",
    "to_q",
    "to_v",
    "to_out.0",
)
# Over the rank, what an adapter counts: 1 at rank 8, 2 at rank 4 (peft's default).
ALPHA = 8


def add_adapter(
    network: Any, name: str, rank: int, targets: tuple[str, ...], *, seed: int = 0
) -> None:
    """Add an adapter to a network of diffusers and freeze the rest.

    Its first half is normally distributed and its second half 0, so that nothing changes at first.

    Args:
        network: UNet or autoencoder.
        name: Of the adapter.
        rank: Of its two factors.
        targets: Ends of the names of the layers that get one.
        seed: Of the first half.
    """
    config = vendor("peft").LoraConfig(
        r=rank, lora_alpha=ALPHA, init_lora_weights="gaussian", target_modules=list(targets)
    )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network.add_adapter(config, adapter_name=name)
    for parameter_name, parameter in network.named_parameters():
        parameter.requires_grad_(is_adapter(parameter_name))


def is_adapter(name: str) -> bool:
    """Return whether a parameter belongs to an adapter, by its name."""
    return ".lora_A." in name or ".lora_B." in name


def adapter_tensors(network: nn.Module) -> dict[str, torch.Tensor]:
    """Return the tensors of a network's adapters by name."""
    return {name: value for name, value in network.state_dict().items() if is_adapter(name)}


def fuse(network: Any) -> None:
    """Add the adapters to the weights they adapt, for speed: they cannot learn any more."""
    network.fuse_lora()
    network.unload_lora()


def keep_in_state(module: nn.Module, kept: Callable[[str], bool]) -> None:
    """Let the state of a module be only what is kept; the rest is as it was made.

    `state_dict` leaves the rest out, and `load_state_dict` does not ask for it.

    Args:
        module: A whole network.
        kept: Whether a tensor is kept, by its name in the module.
    """

    def leave_out(_: nn.Module, state: dict[str, Any], prefix: str, __: Any) -> None:
        for name in list(state):
            if name.startswith(prefix) and not kept(name.removeprefix(prefix)):
                del state[name]

    def not_missed(_: nn.Module, found: Any) -> None:
        found.missing_keys[:] = [name for name in found.missing_keys if kept(name)]

    module.register_state_dict_post_hook(leave_out)
    module.register_load_state_dict_post_hook(not_missed)


# One step of diffusion, from the last time at once to the clean latent, in closed form.
#
# With one step, DDPM's update at t = 999 is the prediction of the clean latent itself: the weight
# of the noisy latent and the added noise are both zero. So no scheduler is needed.

# Times of Stable Diffusion's schedule.
TIMES = 1000
# The one time that SD-Turbo is asked at.
LAST_TIME = TIMES - 1
# Noise variance of the first and the last time; square roots are evenly spaced between them (Stable
# Diffusion's `scaled_linear` schedule).
BETA_FIRST, BETA_LAST = 0.00085, 0.012


@cache
def remaining_signal() -> float:
    """Return the share of the clean latent's variance that is left at the last time (0.00466)."""
    low, high = math.sqrt(BETA_FIRST), math.sqrt(BETA_LAST)
    return math.prod(1 - (low + (high - low) * time / LAST_TIME) ** 2 for time in range(TIMES))


def clean_latent(noisy: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """Return the clean latent of a latent at the last time and the noise predicted in it.

    Computed in float32 whatever comes in: the two terms are 14.6 times as large as their
    difference.

    Args:
        noisy: Latent at the last time (n, channels, h, w), scaled.
        noise: What the network takes for noise, of the same shape.
    """
    signal = remaining_signal()
    # Autocast leaves sums and products with numbers in what they come in.
    rest = noisy.float() - math.sqrt(1 - signal) * noise.float()
    return rest / math.sqrt(signal)


_LOG_VARIANCE = -30.0, 20.0  # what Stable Diffusion's autoencoder limits the posterior to


@dataclass(frozen=True, slots=True)
class Posterior:
    """Normal distribution of latents, scaled for the UNet."""

    mean: torch.Tensor
    """(n, channels, h, w)."""
    deviation: torch.Tensor
    """Of the same shape."""

    def at(self, noise: torch.Tensor | None) -> torch.Tensor:
        """Return the latent at standard normal noise; the mean, where there is none."""
        return self.mean if noise is None else self.mean + self.deviation * noise

    def rows(self, index: torch.Tensor) -> Posterior:
        """Return the posterior of some of the images."""
        return Posterior(self.mean[index], self.deviation[index])


class ReferenceEncoder(nn.Module):
    """An encoder that never learns: half of an autoencoder, as it was when it was copied."""

    def __init__(self, vae: Any) -> None:
        """Copy the half of an autoencoder that encodes."""
        super().__init__()
        self.encoder = copy.deepcopy(vae.encoder)
        self.quant_conv = copy.deepcopy(vae.quant_conv)
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> ReferenceEncoder:
        """Stay in evaluation: it is frozen."""
        return super().train(False)


class MarkerToMarker(nn.Module):
    """The paper's translator, of images (n, 1, h, w) in [0, 1]."""

    def __init__(
        self,
        unet: Any,
        vae: Any,
        tokens: ReferenceTokens,
        *,
        pixel_range: Range,
        train_vae: bool,
    ) -> None:
        """Put together networks that have their adapters; the reference encoder is a copy.

        Args:
            unet: Of SD-Turbo, with an adapter.
            vae: Its autoencoder, with an adapter.
            tokens: What makes tokens of references.
            pixel_range: What black and white are for the networks.
            train_vae: Whether the autoencoder's adapter learns.
        """
        super().__init__()
        self.unet, self.vae, self.tokens = unet, vae, tokens
        self.reference = ReferenceEncoder(vae)
        self.pixel_range = pixel_range
        self.scaling = float(vae.config.scaling_factor)
        for name, parameter in self.named_parameters():
            parameter.requires_grad_(
                name.startswith(("tokens.", "unet.conv_in."))
                or (is_adapter(name) and name.startswith("unet."))
                or (is_adapter(name) and name.startswith("vae.") and train_vae)
            )
        keep_in_state(self, _is_ours)

    def forward(
        self,
        source: torch.Tensor,
        target_reference: torch.Tensor,
        source_reference: torch.Tensor | None = None,
        noise: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return the translated images (n, 3, h, w) in the networks' own range.

        Args:
            source: Images (n, 1, h, w) in [0, 1].
            target_reference: Latent of the untouched target (n, channels, h/8, w/8).
            source_reference: That of the untouched source, where it is read.
            noise: Standard normal, of a latent's shape; without it the posterior's mean is taken.
        """
        latent = self.posterior(source).at(noise)
        time = torch.full((len(source),), LAST_TIME, device=source.device)
        tokens = self.tokens(target_reference, source_reference)
        predicted = self.unet(latent, time, encoder_hidden_states=tokens).sample
        clean = clean_latent(latent, predicted)
        decoded: torch.Tensor = self.vae.decode(clean / self.scaling).sample
        return decoded.float().clamp(-1, 1)

    def posterior(self, images: torch.Tensor) -> Posterior:
        """Return the posterior of images (n, 1, h, w) in [0, 1] by the encoder that learns."""
        return posterior(self.vae, self.native(images), self.scaling)

    @torch.no_grad()
    def reference_posterior(self, images: torch.Tensor) -> Posterior:
        """Return the posterior of untouched images (n, 1, h, w) by the frozen encoder."""
        return posterior(self.reference, self.native(images), self.scaling)

    def native(self, images: torch.Tensor) -> torch.Tensor:
        """Return images (n, 1, h, w) in [0, 1] as the networks see them (n, 3, h, w)."""
        seen = images if self.pixel_range == "zero_one" else images * 2 - 1
        return seen.expand(-1, 3, -1, -1)

    def grey(self, native: torch.Tensor) -> torch.Tensor:
        """Return images of the networks (n, 3, h, w) as grey levels (n, h, w) uint8."""
        grey = native.float().mean(dim=1)
        level = grey if self.pixel_range == "zero_one" else (grey + 1) / 2
        return (level * 255).round().clamp(0, 255).to(torch.uint8)

    def learning(self) -> dict[str, nn.Parameter]:
        """Return the parameters that learn, by name."""
        return {name: each for name, each in self.named_parameters() if each.requires_grad}


def posterior(half: Any, native: torch.Tensor, scaling: float) -> Posterior:
    """Return the posterior of images (n, 3, h, w) as the networks see them.

    Args:
        half: Whatever has an `encoder` and perhaps a `quant_conv`.
        native: The images.
        scaling: Factor between the encoder's latents and the UNet's.
    """
    moments = half.encoder(native)
    if half.quant_conv is not None:
        moments = half.quant_conv(moments)
    mean, log_variance = moments.float().chunk(2, dim=1)
    deviation = (log_variance.clamp(*_LOG_VARIANCE) / 2).exp()
    return Posterior(mean * scaling, deviation * scaling)


def build(
    unet: Any,
    vae: Any,
    settings: TranslatorSettings,
    *,
    vae_adapter: Mapping[str, torch.Tensor] | None = None,
) -> MarkerToMarker:
    """Return the network of SD-Turbo's two, which get their adapters here.

    Args:
        unet: SD-Turbo's UNet.
        vae: Its autoencoder.
        settings: Ranks, tokens, range.
        vae_adapter: What the autoencoder's adapter has learned; it starts anew without.

    Raises:
        LearningError: The adapter is another network's, or of another rank.
    """
    add_adapter(unet, UNET_ADAPTER, settings.unet_rank, UNET_TARGETS, seed=settings.seed)
    rank = settings.vae_rank if vae_adapter is None else rank_of(vae_adapter)
    add_adapter(vae, VAE_ADAPTER, rank, VAE_TARGETS, seed=settings.seed)
    if vae_adapter is not None:
        kept = {name: each for name, each in vae.state_dict().items() if not is_adapter(name)}
        load_weights(vae, {**kept, **vae_adapter}, "the autoencoder's adapter")
    if settings.gradient_checkpointing:
        unet.enable_gradient_checkpointing()
        vae.enable_gradient_checkpointing()
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        tokens = ReferenceTokens(
            settings.conditioning,
            channels=int(vae.config.latent_channels),
            width=int(unet.config.cross_attention_dim),
            source_reference=settings.source_reference,
        )
    return MarkerToMarker(
        unet, vae, tokens, pixel_range=settings.pixel_range, train_vae=settings.train_vae
    )


def rank_of(adapter: Mapping[str, torch.Tensor]) -> int:
    """Return the rank of an adapter's tensors.

    Raises:
        LearningError: There are none, or they differ.
    """
    ranks = {len(tensor) for name, tensor in adapter.items() if ".lora_A." in name}
    if len(ranks) != 1:
        raise LearningError(f"adapter: found ranks {sorted(ranks)}; allowed: one and the same")
    return ranks.pop()


def _is_ours(name: str) -> bool:
    return is_adapter(name) or name.startswith(("tokens.", "unet.conv_in."))
