"""One step of generator and discriminator, in either of two ways.

`merged` goes through the generator once: reconstruction and adversary share a backward pass and an
optimiser's step. `two_pass` is what the authors' code does: a pass and a step for reconstruction,
another for the adversary, and two steps of the discriminator.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.nn import functional

from learning.translation.diffusion.augmentation import augment
from learning.translation.diffusion.discriminator import ClipFeatures, multilevel_sigmoid
from learning.translation.diffusion.network import MarkerToMarker
from learning.translation.diffusion.perceptual import PerceptualDistance
from learning.translation.diffusion.settings import LossWeights

if TYPE_CHECKING:
    from accelerate import Accelerator


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """What the generator is given, and what it should make of it."""

    source: torch.Tensor
    """Images (n, 1, h, w) in [0, 1]."""
    target: torch.Tensor
    """The same of the target."""
    target_reference: torch.Tensor
    """Latents of the untouched target."""
    source_reference: torch.Tensor | None
    """Latents of the untouched source, where they are read."""
    noise: torch.Tensor | None
    """Standard normal, of a latent's shape; None: the posterior's mean."""
    generator: torch.Generator
    """Of augmentation."""


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A network that learns, with what makes it."""

    network: nn.Module
    """As it is called for gradients: wrapped, on several devices."""
    optimiser: torch.optim.Optimizer
    """Of what learns in it."""
    clip_norm: float
    """Largest norm of its gradient; 0: any."""


@dataclass(frozen=True, slots=True, eq=False)
class Judges:
    """What the generator's images are judged by."""

    losses: LossWeights
    """What counts how much."""
    perceptual: PerceptualDistance | None
    """LPIPS; None where it counts nothing."""
    features: ClipFeatures | None
    """CLIP's; None where the adversary counts nothing."""
    heads: Side | None
    """The discriminator's."""


def merged(
    batches: Sequence[Batch], generator: Side, judges: Judges, runs_on: Accelerator
) -> dict[str, torch.Tensor]:
    """Learn from the batches of one step; the mean of each loss, before it is weighted."""
    share = 1 / len(batches)
    said: list[dict[str, torch.Tensor]] = []
    shown = []
    for number, batch in enumerate(batches):
        with _synchronised(generator.network, number == len(batches) - 1, runs_on):
            made = _translate(generator.network, batch)
            parts = _reconstruction(made, batch, generator, judges, runs_on)
            if judges.heads is not None:
                parts["adversarial"] = _fooling(made, batch, judges, runs_on)
            runs_on.backward(_weighted(parts, judges.losses) * share)
        said.append({name: part.detach() for name, part in parts.items()})
        shown.append(made.detach())
    _advance(generator, runs_on)
    if judges.heads is not None and judges.features is not None:
        for number, (batch, made) in enumerate(zip(batches, shown, strict=True)):
            # One pass for both: spectral norms move with every pass.
            both = torch.cat((_native(batch, generator, runs_on), made))
            with _synchronised(judges.heads.network, number == len(batches) - 1, runs_on):
                logits = judges.heads.network(_seen(both, batch, judges.features))
                true, fake = zip(*(level.chunk(2) for level in logits), strict=True)
                loss = multilevel_sigmoid(true, real=True) + multilevel_sigmoid(fake, real=False)
                runs_on.backward(loss * judges.losses.adversarial * share)
            said[number]["discriminator"] = loss.detach()
        _advance(judges.heads, runs_on)
    return {name: torch.stack([each[name] for each in said]).mean() for name in said[0]}


def two_pass(
    batch: Batch, generator: Side, judges: Judges, runs_on: Accelerator
) -> dict[str, torch.Tensor]:
    """Learn from one batch as the authors' code does; the losses, before they are weighted."""
    parts = _reconstruction(_translate(generator.network, batch), batch, generator, judges, runs_on)
    runs_on.backward(_weighted(parts, judges.losses))
    _advance(generator, runs_on)
    if judges.heads is None or judges.features is None:
        return {name: part.detach() for name, part in parts.items()}
    made = _translate(generator.network, batch)
    parts["adversarial"] = _fooling(made, batch, judges, runs_on)
    runs_on.backward(parts["adversarial"] * judges.losses.adversarial)
    _advance(generator, runs_on)
    judged = []
    for shown, real in ((_native(batch, generator, runs_on), True), (made.detach(), False)):
        loss = multilevel_sigmoid(
            judges.heads.network(_seen(shown, batch, judges.features)), real=real
        )
        runs_on.backward(loss * judges.losses.adversarial)
        _advance(judges.heads, runs_on)
        judged.append(loss)
    parts["discriminator"] = judged[0] + judged[1]
    return {name: part.detach() for name, part in parts.items()}


def _translate(network: nn.Module, batch: Batch) -> torch.Tensor:
    made: torch.Tensor = network(
        batch.source, batch.target_reference, batch.source_reference, batch.noise
    )
    return made


def _native(batch: Batch, generator: Side, runs_on: Accelerator) -> torch.Tensor:
    network: MarkerToMarker = runs_on.unwrap_model(generator.network)
    return network.native(batch.target)


def _reconstruction(
    made: torch.Tensor, batch: Batch, generator: Side, judges: Judges, runs_on: Accelerator
) -> dict[str, torch.Tensor]:
    true = _native(batch, generator, runs_on)
    parts = {"square": functional.mse_loss(made, true)}
    if judges.perceptual is not None:
        parts["perceptual"] = judges.perceptual(made, true).mean()
    return parts


def _fooling(
    made: torch.Tensor, batch: Batch, judges: Judges, runs_on: Accelerator
) -> torch.Tensor:
    """Return how far the discriminator is from taking images for true; its heads do not learn."""
    if judges.heads is None or judges.features is None:
        return made.new_zeros(())
    # Past the wrapper: nothing of the heads is synchronised in the generator's backward pass.
    heads = runs_on.unwrap_model(judges.heads.network).requires_grad_(False)
    try:
        seen = judges.features(augment(made, batch.generator))
        return multilevel_sigmoid(heads(seen), real=True)
    finally:
        heads.requires_grad_(True)


def _seen(shown: torch.Tensor, batch: Batch, features: ClipFeatures) -> list[torch.Tensor]:
    with torch.no_grad():
        found: list[torch.Tensor] = features(augment(shown, batch.generator))
    return found


def _weighted(parts: dict[str, torch.Tensor], losses: LossWeights) -> torch.Tensor:
    total = losses.square * parts["square"]
    for name in ("perceptual", "adversarial"):
        if name in parts:
            total = total + getattr(losses, name) * parts[name]
    return total


def _synchronised(network: nn.Module, last: bool, runs_on: Accelerator) -> Any:
    """Gradients are exchanged between devices with the last batch of a step only."""
    return nullcontext() if last else runs_on.no_sync(network)


def _advance(side: Side, runs_on: Accelerator) -> None:
    if side.clip_norm:
        learning = [each for group in side.optimiser.param_groups for each in group["params"]]
        runs_on.clip_grad_norm_(learning, side.clip_norm)
    side.optimiser.step()
    side.optimiser.zero_grad()
