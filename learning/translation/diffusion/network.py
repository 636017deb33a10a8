"""The marker-to-marker network: SD-Turbo's autoencoder and UNet with adapters, in a single step.

    source --encoder--> latent --UNet, at t = 999--> noise -> clean latent --decoder--> target
                                  ^ cross-attention
    target's reference --frozen reference encoder--> tokens

The frozen weights are the published ones; `state_dict` returns only the others. Without published
weights, all but the reference encoder's are trained, and `state_dict` returns all.
"""

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, Self

import torch
from torch import nn

from learning.config import require
from learning.errors import LearningError
from learning.training.checkpoint import load_weights, read_model_folder
from learning.translation.diffusion.weights import Weights, base_of, read_vae, require_base, vendor

# Tokens for the UNet's cross-attention: the target's reference and, optionally, the source's.
#
# The paper only states that the reference's latent is the condition of the cross-attention:
# `channel_tokens` is one token per channel of the latent, with its pixels as features (authors'
# code; as many pixels as the width of the cross-attention), `patch_tokens` one token per 2 x 2
# pixels of the latent, by a linear projection with positional encoding.

Conditioning = Literal["channel_tokens", "patch_tokens"]
# Side of a patch [px of the latent].
PATCH = 2


class ReferenceTokens(nn.Module):
    """Latents of references as tokens (n, count, width)."""

    def __init__(
        self, kind: Conditioning, *, channels: int, width: int, source_reference: bool
    ) -> None:
        """Build the layers; `width` is that of the UNet's cross-attention."""
        super().__init__()
        self.kind, self.width, self.source_reference = kind, width, source_reference
        if kind == "patch_tokens":
            self.projection = nn.Linear(channels * PATCH**2, width)
            self.norm = nn.LayerNorm(width)
        if source_reference:
            self.role = nn.Parameter(torch.randn(2, width) * 0.02)
            """Embeddings added to the tokens of the target and of the source."""

    def forward(self, target: torch.Tensor, source: torch.Tensor | None = None) -> torch.Tensor:
        """Return the tokens (n, count, width) of one or two latents (n, channels, h, w)."""
        if not self.source_reference:
            if source is not None:
                raise LearningError("source_reference: found one; this network reads none")
            return self._tokens(target)
        if source is None:
            raise LearningError("source_reference: missing; this network reads the source's own")
        both = self._tokens(target) + self.role[0], self._tokens(source) + self.role[1]
        return torch.cat(both, dim=1)

    def _tokens(self, latent: torch.Tensor) -> torch.Tensor:
        count, channels, height, width = latent.shape
        if self.kind == "channel_tokens":
            if height * width != self.width:
                raise LearningError(
                    f"channel_tokens: found a latent of {height} x {width}; allowed: "
                    f"{self.width} pixels, the width of the cross-attention"
                )
            return latent.reshape(count, channels, self.width)
        patches = nn.functional.pixel_unshuffle(latent, PATCH)
        rows, columns = patches.shape[2:]
        tokens = self.projection(patches.flatten(2).transpose(1, 2))
        encoding = sine_places(rows, columns, self.width).to(tokens)
        normed: torch.Tensor = self.norm(tokens + encoding)
        return normed


def sine_places(rows: int, columns: int, width: int) -> torch.Tensor:
    """Return positional encodings of a raster (rows x columns, width), in row-major order.

    Half of the features encode the row and half the column, by sines and cosines of falling
    frequency (Vaswani et al. 2017, once for each axis).
    """
    halves = width // 2, width - width // 2
    by_row = _sines(rows, halves[0])[:, None].expand(rows, columns, halves[0])
    by_column = _sines(columns, halves[1])[None].expand(rows, columns, halves[1])
    return torch.cat((by_row, by_column), dim=2).reshape(rows * columns, width)


def _sines(count: int, width: int) -> torch.Tensor:
    frequencies = torch.exp(torch.arange(0, width, 2) * (-math.log(10_000.0) / max(width, 1)))
    angles = torch.arange(count)[:, None] * frequencies
    return torch.stack((angles.sin(), angles.cos()), dim=2).flatten(1)[:, :width]


# Kind of a translator's folder.
KIND = "diffusion"
# Values of black and white for a network.
Range = Literal["minus_one_one", "zero_one"]


# Settings of the networks: a training's settings extend them, a run's folder is opened by them.


@dataclass(frozen=True, kw_only=True)
class VaeSettings:
    """SD-Turbo's autoencoder with an adapter."""

    weights: Weights = field(default_factory=Weights)
    """Published weights that training starts from."""
    pixel_range: Range = "minus_one_one"
    """Values of black and white for the networks, which were all trained for -1 and 1."""
    whole: bool = False
    """True to train all weights, for networks without published ones, in place of adapters."""
    vae_rank: int = 4
    """Rank of the autoencoder's adapter; a translator has that of its marker VAE."""
    seed: int = 0

    def __post_init__(self) -> None:
        require(self, "vae_rank", least=1, most=1024)


@dataclass(frozen=True, kw_only=True)
class DiffusionNetworkSettings(VaeSettings):
    """The translator's network."""

    conditioning: Conditioning = "patch_tokens"
    """Encoding of references for cross-attention."""
    source_reference: bool = True
    """True if the source's reference is also an input."""
    unet_rank: int = 8
    """Rank of the UNet's adapter."""
    train_vae: bool = True
    """True if the autoencoder's adapter is trained, as in the paper; in the authors' code no
    optimiser updates it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, "unet_rank", least=1, most=1024)


# Low-rank adapters (LoRA) on the frozen networks: adapted layers and trainable parameters.
#
# Names of adapters and targets equal those in the authors' checkpoints, so that these load by name.

# Name of the UNet's adapter.
UNET_ADAPTER = "unet_lora"
# Name of the autoencoder's adapter, in both the translator and the reference encoder.
VAE_ADAPTER = "ref_encoder_lora"
# Name suffixes of the layers with an adapter (authors' code), of the UNet and of the autoencoder.
_CONVOLUTIONS = ("conv", "conv1", "conv2", "conv_shortcut", "conv_out")
_ATTENTION = ("to_k", "to_q", "to_v", "to_out.0")
_PROJECTIONS = ("proj_in", "proj_out", "ff.net.2", "ff.net.0.proj")
UNET_TARGETS = (*_ATTENTION, *_CONVOLUTIONS, *_PROJECTIONS)
VAE_TARGETS = (*_CONVOLUTIONS, "conv_in", *_ATTENTION)
# Parts that are learned as they are, without adapters.
_LEARNED = ("tokens.", "unet.conv_in.")
# Divided by the rank, the weight of an adapter: 1 at rank 8, 2 at rank 4 (peft's default).
ALPHA = 8


def add_adapter(
    network: Any, name: str, rank: int, targets: tuple[str, ...], *, seed: int = 0
) -> None:
    """Add an adapter to UNet or autoencoder, to layers by suffixes of their names; freeze the rest.

    The first factor is normally distributed and the second 0, so the initial adapter has no effect.
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
    """Return True if a parameter's name belongs to an adapter."""
    return ".lora_A." in name or ".lora_B." in name


def fuse(network: Any) -> None:
    """Merge the adapters, if any, into the weights they adapt, for speed; training ends here."""
    if getattr(network, "peft_config", None):
        network.fuse_lora()
        network.unload_lora()


def keep_in_state(module: nn.Module, belongs: Callable[[str], bool]) -> None:
    """Restrict the state of a module to the tensors whose names are kept.

    `state_dict` omits the others, which keep their initial values; `load_state_dict` does not
    require them.
    """

    def leave_out(_: nn.Module, state: dict[str, Any], prefix: str, __: Any) -> None:
        for name in list(state):
            if name.startswith(prefix) and not belongs(name.removeprefix(prefix)):
                del state[name]

    def not_missed(_: nn.Module, keys: Any) -> None:
        keys.missing_keys[:] = [name for name in keys.missing_keys if belongs(name)]

    module.register_state_dict_post_hook(leave_out)
    module.register_load_state_dict_post_hook(not_missed)


# A single diffusion step, from the last time to the clean latent, in closed form.
#
# With one step, DDPM's update at t = 999 equals the prediction of the clean latent: the weight of
# the noisy latent and the added noise are both zero. No scheduler is needed.

# Number of times in Stable Diffusion's schedule.
TIMES = 1000
# The only time at which SD-Turbo is evaluated.
LAST_TIME = TIMES - 1
# Noise variance at the first and the last time; square roots are evenly spaced in between (Stable
# Diffusion's `scaled_linear` schedule).
BETA_FIRST, BETA_LAST = 0.00085, 0.012


@cache
def remaining_signal() -> float:
    """Return the fraction of the clean latent's variance remaining at the last time (0.00466)."""
    low, high = math.sqrt(BETA_FIRST), math.sqrt(BETA_LAST)
    return math.prod(1 - (low + (high - low) * time / LAST_TIME) ** 2 for time in range(TIMES))


def clean_latent(noisy: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """Return the clean latent for a scaled latent at the last time and its predicted noise.

    Both are (n, channels, h, w). Always computed in float32, since the two terms are 14.6 times as
    large as their difference.
    """
    signal = remaining_signal()
    # Autocast does not change the type of sums and of products with scalars.
    rest = noisy.float() - math.sqrt(1 - signal) * noise.float()
    return rest / math.sqrt(signal)


_LOG_VARIANCE = -30.0, 20.0  # limits of the posterior in Stable Diffusion's autoencoder


@dataclass(frozen=True, slots=True)
class LatentPosterior:
    """Normal distribution of latents, scaled for the UNet."""

    mean: torch.Tensor
    """(n, channels, h, w)."""
    deviation: torch.Tensor
    """Standard deviation, of the same shape."""

    def at(self, noise: torch.Tensor | None) -> torch.Tensor:
        """Return the latent for standard normal noise; the mean if there is none."""
        return self.mean if noise is None else self.mean + self.deviation * noise

    def rows(self, index: torch.Tensor) -> Self:
        """Return the posterior of some of the images."""
        return replace(self, mean=self.mean[index], deviation=self.deviation[index])


def native(images: torch.Tensor, pixel_range: Range) -> torch.Tensor:
    """Convert images (n, 1, h, w) in [0, 1] to network inputs (n, 3, h, w)."""
    scaled = images if pixel_range == "zero_one" else images * 2 - 1
    return scaled.expand(-1, 3, -1, -1)


class ReferenceEncoder(nn.Module):
    """A frozen copy of an autoencoder's encoder."""

    def __init__(self, vae: Any) -> None:
        """Copy the encoder of an autoencoder."""
        super().__init__()
        self.encoder = copy.deepcopy(vae.encoder)
        self.quant_conv = copy.deepcopy(vae.quant_conv)
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> Self:
        """Stay in evaluation mode, as it is frozen."""
        return super().train(False)


class MarkerToMarker(nn.Module):
    """The paper's translator for images (n, 1, h, w) in [0, 1]."""

    def __init__(
        self,
        unet: Any,
        vae: Any,
        tokens: ReferenceTokens,
        *,
        pixel_range: Range,
        train_vae: bool,
        whole: bool = False,
    ) -> None:
        """Combine networks that have adapters; the reference encoder is a copy.

        If `whole`, there are no adapters, and all weights of the UNet, and of the autoencoder if it
        is trained, are trained.
        """
        super().__init__()
        self.unet, self.vae, self.tokens = unet, vae, tokens
        self.reference = ReferenceEncoder(vae)
        self.pixel_range = pixel_range
        self.scaling = float(vae.config.scaling_factor)
        for name, parameter in self.named_parameters():
            adapted = name.startswith(("unet.", "vae.") if train_vae else "unet.")
            ours = adapted and (whole or is_adapter(name))
            parameter.requires_grad_(ours or name.startswith(_LEARNED))
        if not whole:
            keep_in_state(self, lambda name: is_adapter(name) or name.startswith(_LEARNED))

    def forward(
        self,
        source: torch.Tensor,
        target_reference: torch.Tensor,
        source_reference: torch.Tensor | None = None,
        noise: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return images (n, 1, h, w) in [0, 1] translated, (n, 3, h, w) in the networks' own range.

        References are latents (n, channels, h/8, w/8), the source's if it is an input; `noise` is
        standard normal, of a latent's shape. Without noise the posterior's mean is used.
        """
        latent = self.posterior(source).at(noise)
        time = torch.full((len(source),), LAST_TIME, device=source.device)
        tokens = self.tokens(target_reference, source_reference)
        predicted = self.unet(latent, time, encoder_hidden_states=tokens).sample
        clean = clean_latent(latent, predicted)
        decoded: torch.Tensor = self.vae.decode(clean / self.scaling).sample
        return decoded.float().clamp(-1, 1)

    def posterior(self, images: torch.Tensor) -> LatentPosterior:
        """Return the posterior of images (n, 1, h, w) in [0, 1] by the trainable encoder."""
        return posterior(self.vae, native(images, self.pixel_range), self.scaling)

    @torch.no_grad()
    def reference_posterior(self, images: torch.Tensor) -> LatentPosterior:
        """Return the posterior of images without contact (n, 1, h, w) by the frozen encoder."""
        return posterior(self.reference, native(images, self.pixel_range), self.scaling)

    def grey(self, native: torch.Tensor) -> torch.Tensor:
        """Convert network images (n, 3, h, w) to grey levels (n, h, w) uint8."""
        grey = native.float().mean(dim=1)
        level = grey if self.pixel_range == "zero_one" else (grey + 1) / 2
        return (level * 255).round().clamp(0, 255).to(torch.uint8)

    def learning(self) -> dict[str, nn.Parameter]:
        """Return the trainable parameters by name."""
        return {name: each for name, each in self.named_parameters() if each.requires_grad}


def posterior(half: Any, native: torch.Tensor, scaling: float) -> LatentPosterior:
    """Return the posterior of images (n, 3, h, w) in the networks' range.

    `half` has an `encoder` and an optional `quant_conv`; `scaling` leads from its latents to the
    UNet's.
    """
    moments = half.encoder(native)
    if half.quant_conv is not None:
        moments = half.quant_conv(moments)
    mean, log_variance = moments.float().chunk(2, dim=1)
    deviation = (log_variance.clamp(*_LOG_VARIANCE) / 2).exp()
    return LatentPosterior(mean * scaling, deviation * scaling)


def build(
    unet: Any,
    vae: Any,
    settings: DiffusionNetworkSettings,
    *,
    vae_adapter: Mapping[str, torch.Tensor] | None = None,
) -> MarkerToMarker:
    """Build the network from SD-Turbo's UNet and autoencoder, and add their adapters.

    `vae_adapter` is the autoencoder's trained adapter, or all its weights if all are trained.
    """
    if not settings.whole:
        add_adapter(unet, UNET_ADAPTER, settings.unet_rank, UNET_TARGETS, seed=settings.seed)
        rank = settings.vae_rank if vae_adapter is None else rank_of(vae_adapter)
        add_adapter(vae, VAE_ADAPTER, rank, VAE_TARGETS, seed=settings.seed)
    if vae_adapter is not None:
        published = {name: each for name, each in vae.state_dict().items() if not is_adapter(name)}
        load_weights(vae, {**published, **vae_adapter}, "the autoencoder's adapter")
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        tokens = ReferenceTokens(
            settings.conditioning,
            channels=int(vae.config.latent_channels),
            width=int(unet.config.cross_attention_dim),
            source_reference=settings.source_reference,
        )
    return MarkerToMarker(
        unet,
        vae,
        tokens,
        pixel_range=settings.pixel_range,
        train_vae=settings.train_vae,
        whole=settings.whole,
    )


def rank_of(adapter: Mapping[str, torch.Tensor]) -> int:
    """Return the rank of an adapter's tensors."""
    ranks = {len(tensor) for name, tensor in adapter.items() if ".lora_A." in name}
    if len(ranks) != 1:
        raise LearningError(f"adapter: found ranks {sorted(ranks)}; allowed: a single rank")
    return ranks.pop()


# The marker VAE: SD-Turbo's autoencoder with an adapter for marker images.
#
# Its adapter initialises the translator's encoder and decoder, and is the reference encoder's. Its
# latents are the features in which sets of images are compared.

# Kind of a marker VAE's folder.
MARKER_VAE = "marker-vae"


class MarkerVae(nn.Module):
    """SD-Turbo's autoencoder for images (n, 1, h, w) in [0, 1]; its state is trained."""

    def __init__(self, vae: Any, settings: VaeSettings, *, decode_scaled: bool = False) -> None:
        """Add the adapter, unless all weights are trained.

        The autoencoder becomes part of the network. If `decode_scaled`, the decoder takes the
        latent times its scaling factor.
        """
        super().__init__()
        if not settings.whole:
            add_adapter(vae, VAE_ADAPTER, settings.vae_rank, VAE_TARGETS, seed=settings.seed)
        self.vae = vae
        self.pixel_range = settings.pixel_range
        self.decode_scaled = decode_scaled
        if not settings.whole:
            keep_in_state(self, is_adapter)

    def forward(
        self, images: torch.Tensor, noise: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return images, their reconstructions and the divergence of their latents.

        Images are (n, 1, h, w) in [0, 1]. Returned are images and reconstructions (n, 3, h, w) in
        the network's range, and the divergence of each latent from the normal distribution (n,).
        Without standard normal noise of a latent's shape, the posterior's mean is decoded.
        """
        true = native(images, self.pixel_range)
        encoded = posterior(self.vae, true, 1.0)
        latent = encoded.at(noise)
        if self.decode_scaled:
            latent = latent * float(self.vae.config.scaling_factor)
        reconstruction = self.vae.decode(latent).sample.float()
        variance = encoded.deviation**2
        divergence = 0.5 * (encoded.mean**2 + variance - variance.log() - 1).sum(dim=(1, 2, 3))
        return true, reconstruction, divergence

    def latent(self, images: torch.Tensor) -> torch.Tensor:
        """Return the mean latents (n, channels, h/8, w/8) of images (n, 1, h, w) in [0, 1]."""
        return posterior(self.vae, native(images, self.pixel_range), 1.0).mean


def load_vae(folder: Path, device: str = "cpu") -> MarkerVae:
    """Return the marker VAE in a folder, in evaluation mode."""
    stored = read_model_folder(folder, MARKER_VAE)
    return stored.load(MarkerVae(read_vae(base_of(stored)), stored.settings(VaeSettings)), device)


def load_vae_adapter(folder: str | Path, base: str) -> dict[str, torch.Tensor]:
    """Return the adapter in a marker VAE's folder, for weights with the fingerprint `base`."""
    stored = read_model_folder(Path(folder), MARKER_VAE)
    require_base(stored, base)
    return vae_adapter_of(stored.weights())


def vae_adapter_of(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the trained weights of an autoencoder, an adapter or all, from a state."""
    own = {
        name.removeprefix("vae."): tensor
        for name, tensor in state.items()
        if name.startswith("vae.")
    }
    return {name: tensor for name, tensor in own.items() if is_adapter(name)} or own
