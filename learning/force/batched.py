"""Batched training of force models, one for each sensor that shows the same presses.

With a small network a GPU mostly waits for kernel launches. Models of the same network that learn
from the same presses, as shown by several sensors, launch the same kernels; here each is launched
once for all models (`torch.vmap` over weights and frames). Each model equals the result of
`train_force` up to round-off. No checkpoints are stored, as this is for trainings of a minute,
which can be restarted.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call, stack_module_state

from learning.data.presses import Presses
from learning.errors import LearningError
from learning.force.model import ForceModel, prepared_rows, require_form
from learning.force.train import (
    ForceModelSettings,
    epoch_of,
    error,
    initial_model,
    mirrored,
    optimiser_of,
    schedule_of,
    signs,
    superposed,
    total_steps,
    variances_of,
    weights_of,
)
from learning.training.optim import set_rate
from learning.training.run import TrainingSession, seed_torch

# Frames prepared at once.
_AT_ONCE = 256


def train_batched(
    presses: Sequence[Presses],
    settings: ForceModelSettings,
    session: TrainingSession | None = None,
    *,
    start_from: ForceModel | None = None,
) -> list[ForceModel] | None:
    """Train one force model per sensor, on the same presses, and return them; None if stopped.

    `start_from` is a model with the same network, for the initial weights.
    """
    if settings.input.alone:
        presses = [each.each_frame_alone() for each in presses]
    _require_alike(presses, settings)
    device = presses[0].device
    for each in presses:
        each.require_wrench()
    labels = [each.wrench for each in presses]
    variances = variances_of(presses)
    models = [initial_model([each], settings, start_from, device) for each in labels]
    forces = torch.stack(labels)  # (k, n, 3)
    low, high = (
        torch.stack([getattr(model, name) for model in models])[:, None, None]
        for name in ("low", "high")
    )
    frames = torch.stack([_prepared(each, settings) for each in presses])  # (k, n, planes, h, w)

    weights, buffers = stack_module_state(models)
    in_bf16 = settings.launch.mixed_precision == "bf16"
    total = total_steps(presses[:1], settings)
    done = passed = 0
    for stage in settings.stages:
        optimiser = optimiser_of(weights.values(), settings.optimiser)
        steps = epoch_of(presses[:1], stage, settings, passed).steps(1)
        schedule = schedule_of(stage, stage.epochs * steps)
        summed = torch.zeros(len(models), dtype=torch.float64, device=device)
        for number in range(stage.epochs * steps):
            if session is not None and session.stopping():
                return None
            if number % steps == 0:
                passes = epoch_of(presses[:1], stage, settings, passed)
                passed += 1
            sequences = passes.sequences(number % steps)
            seed_torch(settings.seed, "force", "step", done, 0)
            lengths = sequences.lengths if settings.sequences.padding == "masked" else None
            rows = torch.from_numpy(sequences.rows).to(device)
            inputs = mirrored(frames[:, rows], sequences.flips, settings.input)
            labelled = forces[:, rows] * signs(sequences.flips, device)
            inputs, labelled = (superposed(each, sequences, axis=1) for each in (inputs, labelled))
            wanted = (labelled - low) / (high - low)
            with torch.autocast(device.type, torch.bfloat16, enabled=in_bf16):
                normalised = _forward(models[0], weights, buffers, inputs, lengths)
            sure = torch.ones_like(wanted)
            if variances:
                unsure = torch.stack(variances)[:, rows]
                sure = weights_of(superposed(unsure, sequences, axis=1), low, high)
            losses = torch.vmap(lambda one, other, weight: error(one, other, lengths, weight))(  # noqa: B023
                normalised, wanted, sure
            )
            set_rate(optimiser, schedule.at(number))
            optimiser.zero_grad()
            losses.sum().backward()
            if settings.optimiser.clip is not None:
                _clip(weights.values(), settings.optimiser.clip)
            optimiser.step()
            summed += losses.detach()
            done += 1
            if session is not None:
                session.progress(done, total)
        for each, loss in zip(presses, summed.tolist(), strict=True):
            if not math.isfinite(loss):
                raise LearningError(
                    f"loss of {each.sensor}: found {loss}; allowed: finite (try a smaller "
                    "learning_rate)"
                )
    for number, model in enumerate(models):
        tensors = {**weights, **buffers}
        model.load_state_dict({name: each[number].detach() for name, each in tensors.items()})
    return [model.eval() for model in models]


def _require_alike(presses: Sequence[Presses], settings: ForceModelSettings) -> None:
    """Reject presses and settings that models cannot share."""
    if not presses or not len(presses[0]):
        raise LearningError("presses: found none; allowed: one or more, of one or more sensors")
    for each in presses:
        require_form(each, settings.input)
        if not torch.equal(each.starts, presses[0].starts) or each.device != presses[0].device:
            raise LearningError(
                f"presses of {each.sensor}: found others than those of {presses[0].sensor}; "
                "allowed: the same presses, on one device"
            )
    alone = {
        "network.encoder_norm": settings.network.encoder_norm == "batch",
        "network.tail_norm": settings.network.tail_norm == "batch",
        "launch.mixed_precision": settings.launch.mixed_precision == "fp16",
    }
    for key, is_set in alone.items():
        if is_set:
            raise LearningError(
                f"{key}: found a setting that needs one model at a time; allowed for several: "
                "norms none or instance, precision no or bf16"
            )


def _prepared(presses: Presses, settings: ForceModelSettings) -> Tensor:
    """Return all frames (n, planes, h, w) as network inputs."""
    rows = torch.arange(presses.frames, device=presses.device)
    return torch.cat(
        [prepared_rows(presses, part, settings.input) for part in rows.split(_AT_ONCE)]
    )


def _forward(
    model: ForceModel,
    weights: dict[str, Any],
    buffers: dict[str, Any],
    frames: Tensor,
    lengths: Sequence[int] | None,
) -> Tensor:
    """Return forces (k, b, s, 3), 0 to 1, for frames (k, b, s, planes, h, w) of k models."""

    def one(own: dict[str, Tensor], fixed: dict[str, Tensor], seen: Tensor) -> Tensor:
        normalised: Tensor = functional_call(model, (own, fixed), (seen,), {"lengths": lengths})[0]
        return normalised

    return torch.vmap(one, randomness="different")(weights, buffers, frames)


def _clip(weights: Any, most: float) -> None:
    """Clip the gradients of each model (k, ...) to the norm `most`."""
    grads = [each.grad for each in weights if each.grad is not None]
    norms = torch.stack([grad.flatten(1).square().sum(dim=1) for grad in grads]).sum(dim=0).sqrt()
    fraction = (most / (norms + 1e-6)).clamp(max=1.0)
    for grad in grads:
        grad.mul_(fraction.view(-1, *[1] * (grad.ndim - 1)))
