"""Training of a force model: data, model, loop, evaluation, from top to bottom.

    python -m learning train-force X.markers.zarr --sensor array-i --split split.json --out run
    torchrun --nproc-per-node 4 -m learning train-force ... --preset paper

`train_force` takes presses in memory and does not require a run folder, so that it can be called
repeatedly for a table of many sensor pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state

from learning.data.presses import Presses
from learning.errors import LearningError
from learning.force.data import (
    Compensation,
    Epoch,
    epoch,
    error,
    force_range,
    forces_of,
    frames_of,
    labels_of,
    mirrored,
    prepared_rows,
    require_form,
    signs,
)
from learning.force.model import AXES, ForceModel, ForceSettings, OptimiserSettings, StageSettings
from learning.force.predict import ForcePredictor, predicted_normalised
from learning.training import run as launch
from learning.training.checkpoint import load_weights, read_weights
from learning.training.optim import Constant, Cosine, Ema, InversePower, Schedule, set_rate
from learning.training.run import RunFolder, generator, seed_torch

if TYPE_CHECKING:
    from accelerate import Accelerator

    State = dict[str, Tensor]


@dataclass(slots=True)
class TrainState:
    """Progress of a training."""

    stage: int = 0
    epoch: int = 0
    """Within the stage."""
    step: int = 0
    """Within the epoch."""
    summed: float = 0.0
    """Sum of the losses of the epoch's steps."""
    epochs: int = 0
    """Epochs over all stages."""
    steps: int = 0
    """Steps over all stages."""
    best: float = math.inf
    """Smallest validation error of the stage, normalised to the force range."""
    waited: int = 0
    """Validations since the best one."""


def train_force(
    presses: Presses | Sequence[Presses],
    settings: ForceSettings,
    run: RunFolder | None = None,
    *,
    validation: Presses | Sequence[Presses] = (),
    start_from: ForcePredictor | None = None,
    compensation: Compensation | None = None,
    accelerator: Accelerator | None = None,
    stopped: Callable[[], bool] = lambda: False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ForcePredictor:
    """Train a force model and return it.

    Args:
        presses: Training presses of one or several sensors. They stay on their device; presses on
            the GPU avoid a copy at every step.
        settings: Settings of the model and its training.
        run: Folder for log, checkpoints and model, from which training resumes; None: nothing is
            stored.
        validation: Presses that determine the end of a stage and the weights to keep.
        start_from: A model with the same network, for the initial weights.
        compensation: Changes all labels, before the force range is computed.
        accelerator: Devices and precision; None: from the settings.
        stopped: Called before every step; if it returns True, training is saved and the current
            model is returned.
        progress: Called with the number of steps done and the largest possible total.

    Raises:
        LearningError: Presses have no labels or the wrong form, `start_from` has another network,
            or a loss is not finite.
    """
    # Data
    groups, held = _groups(presses), _groups(validation)
    for each in (*groups, *held):
        require_form(each, settings.input)
    if not groups or not all(len(each) for each in groups):
        raise LearningError("presses: found none of a sensor; allowed: one or more of each")
    labels = [labels_of(each, compensation) for each in groups]
    wanted = [labels_of(each, compensation) for each in held]

    # Model
    accelerator = accelerator or launch.accelerator(settings.launch)
    device, ranks, rank = accelerator.device, accelerator.num_processes, accelerator.process_index
    model = begun_model(labels, settings, start_from, device)
    average = _average(model, settings)
    network: nn.Module = accelerator.prepare(model)
    optimiser = accelerator.prepare(optimiser_of(model.parameters(), settings.optimiser))

    # Loop
    state, best = TrainState(), None
    if run is not None and run.latest() is not None:
        state, best = _resumed(run, model, optimiser, average)
    total = sum(
        stage.epochs * epoch_of(groups, stage, settings, 0).steps(ranks)
        for stage in settings.stages
    )
    while state.stage < len(settings.stages):
        stage = settings.stages[state.stage]
        passes = epoch_of(groups, stage, settings, state.epochs)
        steps = passes.steps(ranks)
        schedule = schedule_of(stage, stage.epochs * steps)
        summed = torch.tensor(state.summed, dtype=torch.float64, device=device)
        network.train()
        while state.step < steps and not stopped():
            seed_torch(settings.seed, "force", "step", state.steps, rank)
            sequences = passes.sequences(state.step, rank, ranks)
            lengths = sequences.lengths if settings.sequences.padding == "masked" else None
            frames = frames_of(groups, sequences, settings.input, device)  # (b, s, planes, h, w)
            targets = model.normalised(forces_of(labels, sequences, device))  # (b, s, 3)
            normalised, _ = network(
                frames, lengths=lengths, truncate=settings.sequences.truncate_frames
            )
            loss = error(normalised, targets, lengths)
            set_rate(optimiser, schedule.at(state.epoch * steps + state.step))
            optimiser.zero_grad()
            accelerator.backward(loss)
            if settings.optimiser.clip is not None:
                accelerator.clip_grad_norm_(model.parameters(), settings.optimiser.clip)
            optimiser.step()
            if average is not None:
                average.update(model)
            summed += loss.detach()
            state.step += 1
            state.steps += 1
            progress(state.steps, total)
        state.summed = float(summed)
        if not math.isfinite(state.summed):
            raise LearningError(
                f"loss: found {state.summed} within {state.steps} steps; allowed: finite "
                "(try a smaller learning_rate)"
            )
        if state.step < steps:
            if run is not None:
                _save(run, state, model, best, optimiser, average)
            return _finished(accelerator, model, settings)

        # Evaluation
        line: dict[str, float] = {"stage": state.stage, "loss": state.summed / steps}
        state = replace(state, epoch=state.epoch + 1, step=0, summed=0.0, epochs=state.epochs + 1)
        score = None
        if held and state.epoch % settings.validate_every_epochs == 0:
            with average.applied(model) if average is not None else nullcontext():
                # Reduced over processes, so that all of them end a stage at the same time.
                off = accelerator.reduce(_validated(model, held, wanted), "mean")
                score = float(off.mean())
                if score < state.best:
                    best = {name: value.clone() for name, value in model.state_dict().items()}
            state.waited = 0 if score < state.best else state.waited + 1
            state.best = min(score, state.best)
            off_in_newtons = (off * (model.high - model.low)).tolist()
            named = zip(AXES, off_in_newtons, strict=True)
            line |= {"validation": score, **{f"mae_{axis}_n": value for axis, value in named}}
        patience = settings.patience_epochs
        if state.epoch == stage.epochs or (patience is not None and state.waited >= patience):
            if best is not None:
                model.load_state_dict(best)
            elif average is not None:
                model.load_state_dict(dict(average.weights))
            state = TrainState(stage=state.stage + 1, epochs=state.epochs, steps=state.steps)
            best, average = None, _average(model, settings)
            optimiser = accelerator.prepare(optimiser_of(model.parameters(), settings.optimiser))
        if run is not None:
            run.log(state.steps, line)
            _save(run, state, model, best, optimiser, average, score)
    if run is not None:
        run.finish(state.steps, {"model": model})
    return _finished(accelerator, model, settings)


def _groups(presses: Presses | Sequence[Presses]) -> list[Presses]:
    return [presses] if isinstance(presses, Presses) else list(presses)


def begun_model(
    labels: Sequence[Tensor],
    settings: ForceSettings,
    start_from: ForcePredictor | None,
    device: torch.device,
) -> ForceModel:
    """Return the initial model of a training, for the labels (N, 3) N of each sensor.

    Raises:
        LearningError: `start_from` has another network.
    """
    seed_torch(settings.seed, "force", "weights")
    model = ForceModel(settings.network, settings.input).to(device)
    if start_from is not None:
        load_weights(model, start_from.model.state_dict(), "start_from")
    model.set_range(force_range(labels, settings))
    if start_from is None and settings.start_at_mean:
        means = [model.normalised(each.to(device)).mean(dim=0) for each in labels]
        model.start_at(torch.stack(means).mean(dim=0))
    return model


def epoch_of(
    groups: Sequence[Presses], stage: StageSettings, settings: ForceSettings, number: int
) -> Epoch:
    """Return a pass over the presses of all sensors, or of the only sensor of a stage."""
    sensors = range(len(groups))
    if stage.one_sensor:
        drawn = int(generator(settings.seed, "force", "sensor").integers(len(groups)))
        sensors = range(drawn, drawn + 1)
    starts = [each.starts.cpu().numpy() for each in groups]
    return epoch(starts, sensors, settings.sequences, settings.seed, number)


def schedule_of(stage: StageSettings, steps: int) -> Schedule:
    """Return the learning-rate schedule of a stage with `steps` steps."""
    rate, warm_up = stage.learning_rate, min(stage.warm_up_steps, steps - 1)
    if stage.schedule == "cosine":
        return Cosine(rate, steps=steps, warm_up=warm_up)
    if stage.schedule == "authors":
        return InversePower(rate, warm_up=warm_up)
    return Constant(rate, warm_up=warm_up)


def optimiser_of(weights: Iterable[Tensor], settings: OptimiserSettings) -> torch.optim.Optimizer:
    """Return an optimiser; the rate is set before each step."""
    decay = settings.weight_decay
    if settings.name == "sgd":
        return torch.optim.SGD(weights, lr=0.0, momentum=settings.momentum, weight_decay=decay)
    return torch.optim.AdamW(weights, lr=0.0, weight_decay=decay)


def _average(model: nn.Module, settings: ForceSettings) -> Ema | None:
    return None if settings.ema is None else Ema(model, settings.ema)


def _validated(model: ForceModel, held: Sequence[Presses], wanted: Sequence[Tensor]) -> Tensor:
    """Return the mean absolute error (3,) over all frames, normalised to the force range."""
    off = [
        (predicted_normalised(model, each) - model.normalised(labels.to(model.low.device))).abs()
        for each, labels in zip(held, wanted, strict=True)
    ]
    return torch.cat(off).mean(dim=0)


def _save(
    run: RunFolder,
    state: TrainState,
    model: nn.Module,
    best: State | None,
    optimiser: Any,
    average: Ema | None,
    score: float | None = None,
) -> None:
    models: dict[str, nn.Module | State] = {"model": model}
    if best is not None:
        models["best"] = best
    training: dict[str, Any] = {"optimiser": optimiser, "course": asdict(state)}
    if average is not None:
        training["average"] = average
    run.save(state.steps, models, training, score=score)


def _resumed(
    run: RunFolder, model: nn.Module, optimiser: Any, average: Ema | None
) -> tuple[TrainState, State | None]:
    """Restore a run's latest checkpoint; return its progress and the best weights of its stage."""
    training: dict[str, Any] = {"optimiser": optimiser}
    if average is not None:
        training["average"] = average
    run.restore({"model": model}, training)
    folder = run.latest()
    best = None if folder is None else folder / "best.safetensors"
    state = TrainState(**run.training_values()["course"])
    if best is None or not best.exists():
        return state, None
    device = next(model.parameters()).device
    return state, {name: value.to(device) for name, value in read_weights(best).items()}


def _finished(
    accelerator: Accelerator, model: ForceModel, settings: ForceSettings
) -> ForcePredictor:
    # Otherwise the model would be evaluated in the precision of the training.
    bare: ForceModel = accelerator.unwrap_model(model, keep_fp32_wrapper=False)
    return ForcePredictor(bare.eval(), settings)


# Batched training of force models, one for each sensor that shows the same presses.
#
# With a small network a GPU mostly waits for kernel launches. Models of the same network that learn
# from the same presses, as shown by several sensors, launch the same kernels; here each is launched
# once for all models (`torch.vmap` over weights and frames). Each model equals the result of
# `train_force` up to round-off. No checkpoints are stored, as this is for trainings of a minute,
# which can be restarted.

# Frames prepared at once.
_AT_ONCE = 256


def train_together(
    presses: Sequence[Presses],
    settings: ForceSettings,
    *,
    start_from: ForcePredictor | None = None,
    compensation: Sequence[Compensation | None] = (),
    stopped: Callable[[], bool] = lambda: False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[ForcePredictor] | None:
    """Train one force model per sensor and return them; None if stopped.

    Args:
        presses: The same presses as shown by each sensor, on the device of the training.
        settings: Settings of the network and its training; `launch` sets the precision.
        start_from: A model with the same network, for the initial weights.
        compensation: Changes of labels, one per sensor; empty: none.
        stopped: Called before every step; True stops training.
        progress: Called with the number of steps done and the total.

    Raises:
        LearningError: Presses differ, have no labels or the wrong form, models cannot share the
            settings, `start_from` has another network, or a loss is not finite.
    """
    _require_alike(presses, settings)
    device = presses[0].device
    changes = list(compensation) or [None] * len(presses)
    labels = [labels_of(each, change) for each, change in zip(presses, changes, strict=True)]
    models = [begun_model([each], settings, start_from, device) for each in labels]
    forces = torch.stack(labels)  # (k, n, 3)
    low, high = (
        torch.stack([getattr(model, name) for model in models])[:, None, None]
        for name in ("low", "high")
    )
    frames = torch.stack([_prepared(each, settings) for each in presses])  # (k, n, planes, h, w)

    weights, buffers = stack_module_state(models)
    total = sum(
        stage.epochs * epoch_of(presses[:1], stage, settings, 0).steps(1)
        for stage in settings.stages
    )
    done = passed = 0
    for stage in settings.stages:
        optimiser = optimiser_of(weights.values(), settings.optimiser)
        steps = epoch_of(presses[:1], stage, settings, passed).steps(1)
        schedule = schedule_of(stage, stage.epochs * steps)
        summed = torch.zeros(len(models), dtype=torch.float64, device=device)
        for number in range(stage.epochs * steps):
            if stopped():
                return None
            if number % steps == 0:
                passes = epoch_of(presses[:1], stage, settings, passed)
                passed += 1
            sequences = passes.sequences(number % steps)
            seed_torch(settings.seed, "force", "step", done, 0)
            lengths = sequences.lengths if settings.sequences.padding == "masked" else None
            rows = torch.from_numpy(sequences.rows).to(device)
            seen = mirrored(frames[:, rows], sequences.flips, settings.input)
            wanted = (forces[:, rows] * signs(sequences.flips, device) - low) / (high - low)
            with torch.autocast(device.type, torch.bfloat16, enabled=_in_bf16(settings)):
                normalised = _forward(models[0], weights, buffers, seen, lengths, settings)
            losses = torch.vmap(lambda one, other: error(one, other, lengths))(  # noqa: B023
                normalised, wanted
            )
            set_rate(optimiser, schedule.at(number))
            optimiser.zero_grad()
            losses.sum().backward()
            if settings.optimiser.clip is not None:
                _clip(weights.values(), settings.optimiser.clip)
            optimiser.step()
            summed += losses.detach()
            done += 1
            progress(done, total)
        for each, loss in zip(presses, summed.tolist(), strict=True):
            if not math.isfinite(loss):
                raise LearningError(
                    f"loss of {each.sensor}: found {loss}; allowed: finite (try a smaller "
                    "learning_rate)"
                )
    for number, model in enumerate(models):
        found = {**weights, **buffers}
        model.load_state_dict({name: each[number].detach() for name, each in found.items()})
    return [ForcePredictor(model.eval(), settings) for model in models]


def _require_alike(presses: Sequence[Presses], settings: ForceSettings) -> None:
    """Reject presses and settings that models cannot share.

    Raises:
        LearningError: The presses differ, or one model's training would affect another's.
    """
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
        "ema": settings.ema is not None,
        "launch.mixed_precision": settings.launch.mixed_precision == "fp16",
    }
    for key, found in alone.items():
        if found:
            raise LearningError(
                f"{key}: found a setting that needs one model at a time; allowed for several: "
                "norms none, instance or group, no ema, precision no or bf16"
            )


def _prepared(presses: Presses, settings: ForceSettings) -> Tensor:
    """Return all frames (n, planes, h, w) as network inputs."""
    rows = torch.arange(presses.frames, device=presses.device)
    return torch.cat(
        [prepared_rows(presses, part, settings.input) for part in rows.split(_AT_ONCE)]
    )


def _in_bf16(settings: ForceSettings) -> bool:
    return settings.launch.mixed_precision == "bf16"


def _forward(
    model: ForceModel,
    weights: dict[str, Any],
    buffers: dict[str, Any],
    frames: Tensor,
    lengths: Sequence[int] | None,
    settings: ForceSettings,
) -> Tensor:
    """Return forces (k, b, s, 3), 0 to 1, for frames (k, b, s, planes, h, w) of k models."""

    def one(own: dict[str, Tensor], fixed: dict[str, Tensor], seen: Tensor) -> Tensor:
        how = {"lengths": lengths, "truncate": settings.sequences.truncate_frames}
        normalised: Tensor = functional_call(model, (own, fixed), (seen,), how)[0]
        return normalised

    normalised: Tensor = torch.vmap(one, randomness="different")(weights, buffers, frames)
    return normalised


def _clip(weights: Any, most: float) -> None:
    """Clip the gradients of each model (k, ...) to the norm `most`."""
    grads = [each.grad for each in weights if each.grad is not None]
    norms = torch.stack([grad.flatten(1).square().sum(dim=1) for grad in grads]).sum(dim=0).sqrt()
    share = (most / (norms + 1e-6)).clamp(max=1.0)
    for grad in grads:
        grad.mul_(share.view(-1, *[1] * (grad.ndim - 1)))
