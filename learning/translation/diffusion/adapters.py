"""Low-rank adapters (LoRA) on the frozen networks: where they sit and which parameters learn.

Names of adapters and targets are those of the authors' checkpoints, so that these load by name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from learning.translation.diffusion.weights import vendor

UNET_ADAPTER = "unet_lora"
"""Name of the UNet's adapter."""
VAE_ADAPTER = "ref_encoder_lora"
"""Name of the autoencoder's adapter, the translator's and the reference encoder's alike."""
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
"""Ends of the names of the UNet's layers that get an adapter (authors' code)."""
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
"""The same for the autoencoder's layers (authors' code)."""
ALPHA = 8
"""Over the rank, what an adapter counts: 1 at rank 8, 2 at rank 4 (peft's default)."""


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
