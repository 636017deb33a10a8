"""Training of the field translator: the field net, then the map.

    python -m learning train-field ARCHIVE --split split.json --out RUN [--preset ours]
    torchrun --nproc-per-node 8 -m learning train-field ...

The field net learns from each sensor's own frames: the reference, deformed by the net's output,
must match the frame. That requires neither labels nor a second sensor. Random patterns, deformed by
the archive's fields or by random bumps, add patterns that no sensor has. The deformation found in
one random pattern must also hold for another.

The map learns from location pairs while the field net is frozen: the target's reference, deformed
by the map's output, must match the target's frame. Between random patterns it must be the identity,
so that unknown sensors are assumed to differ only in their patterns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from learning.errors import LearningError
from learning.training.optim import Cosine, set_rate
from learning.training.run import accelerator as launched
from learning.training.run import generator
from learning.translation.field.data import Bank, Examples, Frames, draw_examples
from learning.translation.field.losses import (
    LossWeights,
    dice,
    image_loss,
    regularity_loss,
    shift_error,
    truth_error,
)
from learning.translation.field.network import carried, render
from learning.translation.field.settings import FieldSettings, StageSettings
from learning.translation.field.translator import FieldModel

if TYPE_CHECKING:
    from accelerate import Accelerator

    from learning.training.run import RunFolder


# Scores of a field model on held-out frames.

# Frames evaluated at once.
AT_ONCE = 64


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Deformations of the source frames of pairs; a frame is the source of many pairs."""

    deformation: Tensor
    """(k, 3, 64, 64) float16 [px]."""
    place: Tensor
    """Row of `deformation` for each pair (m,) int64."""

    def of(self, pairs: Tensor) -> Tensor:
        """Return deformations of some pairs (n, 3, 64, 64) float32 [px]."""
        return self.deformation[self.place[pairs]].float()


@torch.no_grad()
def net_scores(model: FieldModel, frames: Frames, most: int, seed: int) -> dict[str, float]:
    """Score the field net on the sensors' own frames.

    Args:
        model: Model in evaluation mode.
        frames: Frames to evaluate on.
        most: Largest number of frames, chosen by the seed.
        seed: Seed of the choice.

    Returns:
        `dice` of the deformed reference with the frame, `dice_still` of the unchanged reference,
        and the mean `shift_error_px` if the archive has displacement fields.
    """
    rows = _chosen(len(frames), most, seed, frames.device)
    scores: dict[str, list[Tensor]] = {"dice": [], "dice_still": [], "shift_error_px": []}
    for part in _parts(rows):
        images, distance = frames.seen(part), frames.distance(part)
        found = model.net(images, distance)[-1]
        scores["dice"].append(dice(render(distance, found), images))
        scores["dice_still"].append(dice(distance, images))
        if frames.shift is not None:
            shift = frames.shift[part].float()
            known = shift.isfinite().flatten(1).all(dim=1)
            scores["shift_error_px"].append(shift_error(found, shift)[known])
    return _means(scores)


@torch.no_grad()
def map_scores(
    model: FieldModel, frames: Frames, found: Found, most: int, seed: int
) -> dict[str, float]:
    """Score the map on location pairs.

    Args:
        model: Model in evaluation mode.
        frames: Frames to evaluate on.
        found: Deformations of the sources, see `found_in_sources`.
        most: Largest number of pairs, chosen by the seed.
        seed: Seed of the choice.

    Returns:
        `dice` with the target's frame, `dice_carried` for the source's deformation unchanged in
        millimetres, `dice_still` for the target's unchanged reference.
    """
    chosen = _chosen(len(frames.pairs), most, seed, frames.device)
    scores: dict[str, list[Tensor]] = {"dice": [], "dice_carried": [], "dice_still": []}
    for part in _parts(chosen):
        source, target = frames.pairs[part].unbind(dim=1)
        distance, images = frames.distance(target), frames.seen(target)
        scales = frames.scale(source), frames.scale(target)
        deformation = found.of(part)
        mapped = model.map(deformation, frames.distance(source), distance, *scales)
        still = carried(deformation, scales[1] / scales[0])
        scores["dice"].append(dice(render(distance, mapped), images))
        scores["dice_carried"].append(dice(render(distance, still), images))
        scores["dice_still"].append(dice(distance, images))
    return _means(scores)


@torch.no_grad()
def found_in_sources(model: FieldModel, frames: Frames) -> Found:
    """Return the field net's deformation of each pair's source."""
    every = torch.unique(frames.pairs[:, 0], return_inverse=True)
    sources, place = every[0], every[1]
    parts = [
        model.net(frames.seen(rows), frames.distance(rows))[-1].half() for rows in _parts(sources)
    ]
    return Found(torch.cat(parts), place)


def _chosen(count: int, most: int, seed: int, device: torch.device) -> Tensor:
    rows = generator(seed, "validation").permutation(count)[:most]
    return torch.from_numpy(rows).to(device)


def _parts(rows: Tensor) -> Iterator[Tensor]:
    return (rows[first : first + AT_ONCE] for first in range(0, len(rows), AT_ONCE))


def _means(scores: dict[str, list[Tensor]]) -> dict[str, float]:
    joined = {name: torch.cat(values) for name, values in scores.items() if values}
    return {name: float(values.mean()) for name, values in joined.items() if len(values)}


# Weight of a pass relative to the next one; only the last pass is used for translation.
_EARLIER_LOOK = 0.5
_OF_UNKNOWN = 4  # one of this many pairs is also evaluated under random patterns
_LOG_EVERY_STEPS = 20


def train_field(
    training: Frames,
    settings: FieldSettings,
    validation: Frames | None = None,
    *,
    run: RunFolder | None = None,
    accelerator: Accelerator | None = None,
    stopping: Callable[[], bool] = lambda: False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> FieldModel:
    """Train a field model and return it in evaluation mode.

    Args:
        training: Training frames and pairs, on the device of the training.
        settings: Settings of model and training.
        validation: Validation frames and pairs; None: no validation.
        run: Folder for checkpoints and logs, from which an interrupted training resumes; None: no
            files are written.
        accelerator: Devices and precision; None: from the settings.
        stopping: Returns True to save and stop after the current step.
        progress: Called with the number of steps done and the total.

    Raises:
        LearningError: The map has no pairs to learn from, or a loss is not finite.
    """
    runs_on = accelerator or launched(settings.launch)
    first_of_map = settings.field_stage.steps
    steps = first_of_map + settings.map_stage.steps
    if settings.map_stage.steps and not len(training.pairs):
        raise LearningError(
            "pairs: found none to learn the map from; allowed: two sensors with shared locations, "
            "or map_stage.steps 0"
        )
    model = FieldModel(settings).to(training.device)
    model.usual_scale.copy_(training.scales[training.sensor].median(dim=0).values)
    done = run.restore({"model": model}) if run is not None else 0
    chance = generator(settings.seed, "patterns")
    bank = Bank.drawn(settings.examples.patterns, chance, training.device)
    task = _Task(
        model, settings, training, validation, bank, runs_on, run, stopping, progress, steps
    )
    if done < first_of_map:
        done = _train_net(task, done)
    if first_of_map <= done < steps and not stopping():
        done = _train_map(task, done)
    if done == steps and run is not None:
        run.finish(done, {"model": model})
    return model.eval()


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """State shared by both stages."""

    model: FieldModel
    settings: FieldSettings
    training: Frames
    validation: Frames | None
    bank: Bank
    runs_on: Accelerator
    run: RunFolder | None
    stopping: Callable[[], bool]
    progress: Callable[[int, int], None]
    steps: int


def _train_net(task: _Task, done: int) -> int:
    """Train the field net from step `done`; return the step reached."""
    settings, frames, bank = task.settings, task.training, task.bank

    def loss(net: nn.Module, step: int) -> Tensor:
        chance = generator(settings.seed, "examples", step, task.runs_on.process_index)
        size = settings.field_stage.batch
        examples = draw_examples(frames, bank, settings.examples, size, chance)
        return net_loss(net(examples.seen, examples.distance), examples, settings.loss)

    def scores() -> dict[str, float]:
        if task.validation is None:
            return {}
        return net_scores(task.model, task.validation, settings.validated, settings.seed)

    return _descend(task, "field", task.model.net, settings.field_stage, 0, done, loss, scores)


def _train_map(task: _Task, done: int) -> int:
    """Train the map from step `done` with a frozen field net; return the step reached."""
    settings, frames, bank = task.settings, task.training, task.bank
    task.model.eval()
    found = found_in_sources(task.model, frames)
    measured = (
        task.validation if task.validation is not None and len(task.validation.pairs) else None
    )
    found_there = found_in_sources(task.model, measured) if measured is not None else None

    def loss(mapping: nn.Module, step: int) -> Tensor:
        chance = generator(settings.seed, "pairs", step, task.runs_on.process_index)
        chosen = chance.integers(len(frames.pairs), size=settings.map_stage.batch)
        pairs = torch.from_numpy(chosen).to(frames.device)
        few = len(pairs) // _OF_UNKNOWN if settings.loss.unknown and len(bank.distances) else 0
        drawn = chance.integers(max(1, len(bank.distances)), size=(2, few))
        patterns = bank.distances[torch.from_numpy(drawn).to(frames.device)].float()
        return map_loss(mapping, frames, found, pairs, patterns, settings.loss)

    def scores() -> dict[str, float]:
        if measured is None or found_there is None:
            return {}
        return map_scores(task.model, measured, found_there, settings.validated, settings.seed)

    first = settings.field_stage.steps
    return _descend(task, "map", task.model.map, settings.map_stage, first, done, loss, scores)


def net_loss(looks: list[Tensor], examples: Examples, weights: LossWeights) -> Tensor:
    """Return the loss of the field net's deformations, one (n, 3, 64, 64) per pass."""
    total = torch.zeros((), device=examples.seen.device)
    for place, deformation in enumerate(reversed(looks)):
        level = render(examples.distance, deformation)
        loss = image_loss(level, examples.shown, weights) + regularity_loss(deformation, weights)
        loss = loss + weights.truth * truth_error(deformation, examples.shift).mean()
        total = total + _EARLIER_LOOK**place * loss
    made = len(examples.other)
    if made:
        level = render(examples.other_distance, looks[-1][-made:])
        share = made / len(examples.seen)
        total = total + share * image_loss(level, examples.other, weights)
    return total


def map_loss(
    mapping: nn.Module,
    frames: Frames,
    found: Found,
    pairs: Tensor,
    patterns: Tensor,
    weights: LossWeights,
) -> Tensor:
    """Return the loss of the map on some pairs.

    Args:
        mapping: The map.
        frames: Frames of all sensors.
        found: Deformations of the sources.
        pairs: Indices of the frames' pairs (n,).
        patterns: Signed distances (2, m, 1, 256, 256) [px] of two patterns on one gel, for the
            first m pairs: between them the deformation of the source must not change.
        weights: Weights of the parts.
    """
    source, target = frames.pairs[pairs].unbind(dim=1)
    seen, distance = found.of(pairs), frames.distance(target)
    scales = frames.scale(source), frames.scale(target)
    few = slice(patterns.shape[1])
    # One batch, as a GPU takes longer to launch a pass than to compute it.
    mapped: Tensor = mapping(
        torch.cat([seen, seen[few]]),
        torch.cat([frames.distance(source), patterns[0]]),
        torch.cat([distance, patterns[1]]),
        torch.cat([scales[0], scales[0][few]]),
        torch.cat([scales[1], scales[0][few]]),
    )
    deformation, unchanged = mapped[: len(pairs)], mapped[len(pairs) :]
    level = render(distance, deformation)
    loss = image_loss(level, frames.seen(target), weights) + regularity_loss(deformation, weights)
    if frames.shift is not None:
        error = truth_error(deformation, frames.shift[target].float()).mean()
        loss = loss + weights.truth * error
    if len(unchanged):
        loss = loss + weights.unknown * (unchanged - seen[few]).abs().mean()
    return loss


def _descend(
    task: _Task,
    name: str,
    network: nn.Module,
    stage: StageSettings,
    first: int,
    done: int,
    loss_of: Callable[[nn.Module, int], Tensor],
    scores: Callable[[], dict[str, float]],
) -> int:
    """Train one network over its stage: steps `first` to `first + stage.steps`.

    Args:
        task: State shared by both stages.
        name: Name of the stage in logs.
        network: Network to train.
        stage: Settings of the stage.
        first: First step of the stage.
        done: Step to start from, `first` or later.
        loss_of: Returns the loss of the network on a step.
        scores: Returns the current validation scores.

    Returns:
        Step reached, less than the last if training was stopped.
    """
    settings, run = task.settings, task.run
    schedule = Cosine(stage.learning_rate, stage.steps, min(stage.warm_up_steps, stage.steps - 1))
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=stage.learning_rate, weight_decay=settings.weight_decay
    )
    if run is not None and done > first:
        run.restore({"model": task.model}, {"optimiser": optimiser})
    prepared, wrapped = task.runs_on.prepare(network, optimiser)
    last, losses = first + stage.steps, []
    for step in range(done, last):
        prepared.train()
        set_rate(optimiser, schedule.at(step - first))
        loss = loss_of(prepared, step)
        # Checked before the backward pass, which may crash for warps to non-finite positions.
        if not bool(loss.isfinite()):
            raise LearningError(
                f"{name}_stage: found a loss of {loss.item()} on step {step}; allowed: finite (try "
                "a lower learning_rate)"
            )
        wrapped.zero_grad()
        task.runs_on.backward(loss)
        task.runs_on.clip_grad_norm_(network.parameters(), settings.clip)
        wrapped.step()
        losses.append(loss.detach())
        done = step + 1
        task.progress(done, task.steps)
        ends = done == last or task.stopping()
        measured = ends or done % settings.validate_every_steps == 0
        if measured or done % _LOG_EVERY_STEPS == 0:
            if run is not None:
                run.log(done, {f"{name}/loss": float(torch.stack(losses).mean())})
            losses.clear()
        if measured:
            prepared.eval()
            found = scores()
            if run is not None:
                run.log(done, {f"{name}/validation_{key}": value for key, value in found.items()})
                score = 1 - found["dice"] if found and last == task.steps else None
                run.save(done, {"model": task.model}, {"optimiser": optimiser}, score=score)
        if ends:
            break
    # Remove the mixed-precision wrapper, which is not there after a resume either.
    task.runs_on.unwrap_model(prepared, keep_fp32_wrapper=False)
    return done
