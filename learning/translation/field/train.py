"""Training of the field translator: the field net, then the map.

    python -m learning train-field ARCHIVE --split split.json --out RUN [--preset ours]
    torchrun --nproc-per-node 8 -m learning train-field ...

The field net learns from every sensor's own frames: its reference, deformed as the net says, must
show what the frame shows. Nothing else is needed for that, no label and no second sensor. Random
patterns that move as the archive's fields do, or by random bumps, teach it patterns that no sensor
has; and what is found in one random pattern must also be right for another.

The map learns from location pairs, with the field net as it is: the target's reference, deformed as
the map says, must show what the target showed. Between random patterns it must change nothing, so
that sensors it does not know are taken to differ in their patterns alone.
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


# How good a field model is on frames that it is not trained on.

# Frames that are worked on together.
AT_ONCE = 64


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What the field net found in the sources of pairs; a frame is a source of many."""

    deformation: Tensor
    """(k, 3, 64, 64) float16 [px]."""
    place: Tensor
    """Row of `deformation` of each pair (m,) int64."""

    def of(self, pairs: Tensor) -> Tensor:
        """Return deformations of some pairs (n, 3, 64, 64) float32 [px]."""
        return self.deformation[self.place[pairs]].float()


@torch.no_grad()
def net_scores(model: FieldModel, frames: Frames, most: int, seed: int) -> dict[str, float]:
    """Return how well the field net explains frames of the sensors themselves.

    Args:
        model: In evaluation mode.
        frames: What it is measured on.
        most: So many of them at most, chosen by the seed.
        seed: Of the choice.

    Returns:
        `dice` of the deformed reference with the frame, `dice_still` of the reference as it is, and
        where the archive keeps displacement `shift_error_px`, its mean.
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
    """Return how well the map translates location pairs.

    Args:
        model: In evaluation mode.
        frames: What it is measured on.
        found: What the field net found in the sources, see `found_in_sources`.
        most: So many pairs at most, chosen by the seed.
        seed: Of the choice.

    Returns:
        `dice` with the target's frame, `dice_carried` of the source's deformation as it is in
        millimetres, `dice_still` of the target's reference as it is.
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
    """Return what the field net finds in the source of each pair."""
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


# What a look counts, of the next one: only the last is used, each begins where it ended.
_EARLIER_LOOK = 0.5
_OF_UNKNOWN = 4  # of so many pairs one is shown under random patterns as well
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
    """Return a field model, in evaluation mode.

    Args:
        training: Frames and pairs that are learned from, on the device of the training.
        settings: Of model and training.
        validation: Frames and pairs that it is measured on now and then; None: it is not.
        run: Where checkpoints and logs go, and what an interrupted training goes on from; None
            writes no file.
        accelerator: What the training runs on; None: as the settings say.
        stopping: Whether to save and end after the step in hand.
        progress: Called with steps that are done and all there are.

    Raises:
        LearningError: No pairs for the map to learn from, or a loss that is not finite.
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
    """What both stages share."""

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
    """Train the field net from a step on; return the step it came to."""
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
    """Train the map from a step on, the field net as it is; return the step it came to."""
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
    """Return the loss of the field net's deformations, one (n, 3, 64, 64) a look."""
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
        frames: Of all sensors.
        found: What the field net found in the sources.
        pairs: Which of the frames' pairs (n,).
        patterns: Signed distances (2, m, 1, 256, 256) [px] of two patterns on one gel, for the
            first m pairs: from one to the other the deformation of their sources must not change.
        weights: What each part counts.
    """
    source, target = frames.pairs[pairs].unbind(dim=1)
    seen, distance = found.of(pairs), frames.distance(target)
    scales = frames.scale(source), frames.scale(target)
    few = slice(patterns.shape[1])
    # All at once: a GPU works on a pass for less time than it takes to order one.
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
        task: What both stages share.
        name: Of the stage, in logs.
        network: What is trained.
        stage: Its settings.
        first: The step at which the stage begins.
        done: The step that was come to before, `first` or later.
        loss_of: The loss of the network on a step.
        scores: How good the model is now.

    Returns:
        The step that was come to, less than the last if it was stopped.
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
        # Before it goes backward: a warp to places that are not numbers may crash there.
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
    # Without what mixed precision put around it: after a resume it is not there either.
    task.runs_on.unwrap_model(prepared, keep_fp32_wrapper=False)
    return done
