"""Training of the field translator, from settings to command: the field net, then the map.

    tactile train field ARCHIVE --out RUN [--preset ours]
    torchrun --nproc-per-node 8 -m tactile train field ...

The field net learns from each sensor's own frames: the reference, deformed by the net's output,
must match the frame. That requires neither labels nor a second sensor. Random patterns, deformed by
the archive's fields or by random bumps, add patterns that no sensor has. The deformation found in
one random pattern must also hold for another.

The map learns from location pairs while the field net is frozen: the target's reference, deformed
by the map's output, must match the target's frame. Between random patterns it must be the identity,
so that unknown sensors are assumed to differ only in their patterns.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from learning.config import read_settings, require
from learning.data.splits import Split
from learning.errors import LearningError
from learning.train_command import open_data, run_training
from learning.training.optim import Cosine, set_rate
from learning.training.run import LaunchSettings, TrainingSession, accelerator, generator
from learning.translation.field.data import (
    Examples,
    ExampleSettings,
    FieldFrames,
    PatternBank,
    draw_examples,
    gather_role,
)
from learning.translation.field.network import (
    KIND,
    FieldModel,
    MapSettings,
    NetSettings,
    coverage,
    render,
    transferred,
)
from recorder import MarkerArchive
from recorder.archive import archive_fingerprint

# Presets shipped with the package.
PRESETS = Path(__file__).parent / "presets"


# Settings: the keys of the presets.


@dataclass(frozen=True, slots=True)
class FieldLossWeights:
    """Weights of the parts of the loss."""

    cross_entropy: float = 1.0
    """Cross-entropy of pixels on logits of signed distances: has a gradient at any distance."""
    dice: float = 1.0
    """One minus the soft Dice of the images."""
    truth: float = 0.05
    """Mean error [px] of shift, and of growth from 0, if the archive has displacement fields."""
    rough: float = 0.02
    """Mean square of second differences of the shift [px^2]: no data between the markers."""
    growth: float = 0.01
    """Mean magnitude of growth [px]: a shift is preferred where it explains the frame."""
    unknown: float = 0.02
    """Mean change [px] by the map between two random patterns on the same gel and camera."""

    def __post_init__(self) -> None:
        require(self, "cross_entropy", "dice", "truth", "rough", "growth", "unknown", least=0)
        if not self.cross_entropy and not self.dice:
            raise LearningError("cross_entropy, dice: found 0 and 0; allowed: one of them above 0")


@dataclass(frozen=True, slots=True)
class FieldStageSettings:
    """One stage of training: the field net, then the map."""

    steps: int
    """Number of steps; 0: the stage is skipped."""
    batch: int = 128
    """Examples per step on each GPU."""
    learning_rate: float = 3e-4
    """Peak rate, reached after `warm_up_steps`; it then decays as a cosine."""
    warm_up_steps: int = 500

    def __post_init__(self) -> None:
        require(self, "steps", "warm_up_steps", least=0)
        require(self, "batch", least=1)
        require(self, "learning_rate", above=0)


@dataclass(frozen=True, slots=True)
class FieldSettings:
    """A field model and its training."""

    description: str
    field_stage: FieldStageSettings
    """Stage of the field net, on frames of all sensors and on random patterns."""
    map_stage: FieldStageSettings
    """Stage of the map, on location pairs."""
    net: NetSettings = field(default_factory=NetSettings)
    map: MapSettings = field(default_factory=MapSettings)
    examples: ExampleSettings = field(default_factory=ExampleSettings)
    loss: FieldLossWeights = field(default_factory=FieldLossWeights)
    every_frame: int = 4
    """The field net is trained on every n-th frame of a press, and on all paired frames."""
    weight_decay: float = 1e-2
    clip: float = 1.0
    """Gradient norm above which gradients are clipped."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Devices and precision; distances, warps and losses are always float32."""
    validate_every_steps: int = 500
    """Number of steps between validations, which also save a checkpoint."""
    validated: int = 1024
    """Largest number of frames or pairs in a validation."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.field_stage.steps and not self.map_stage.steps:
            raise LearningError("field_stage.steps, map_stage.steps: found 0 and 0; allowed: one")
        if self.launch.mixed_precision == "fp16":
            raise LearningError("launch.mixed_precision: found fp16; allowed: no, bf16")
        require(self, "every_frame", "validate_every_steps", "validated", least=1)
        require(self, "clip", above=0)


# Losses, which compare a deformed reference with the frame that the sensor showed.

# Width of the logistic that is as steep at an edge as a pixel of 256 x 256, 2.2 px wide.
_RAMP_PX = 0.55
# Logits grow logarithmically beyond this, so that distant errors count but do not dominate.
_CERTAIN = 8.0


def image_loss(level: Tensor, images: Tensor, weights: FieldLossWeights) -> Tensor:
    """Return the loss of images, whose signed distance is `level` [px], against others in 0..1."""
    logits = _CERTAIN * torch.asinh(level / (_RAMP_PX * _CERTAIN))
    entropy = functional.binary_cross_entropy_with_logits(logits, images)
    return weights.cross_entropy * entropy + weights.dice * (1 - soft_dice(level, images).mean())


def regularity_loss(deformation: Tensor, weights: FieldLossWeights) -> Tensor:
    """Return the regularisation loss of a deformation (n, 3, h, w): roughness and growth."""
    shift, growth = deformation[:, :2], deformation[:, 2:]
    bent = shift.diff(n=2, dim=2).square().mean() + shift.diff(n=2, dim=3).square().mean()
    return weights.rough * bent + weights.growth * growth.abs().mean()


def truth_error(deformation: Tensor, shift: Tensor) -> Tensor:
    """Return the mean distance (n,) [px] from the true deformation, growth as a third direction.

    A known field is the complete deformation: the true growth is 0. The true shift (n, 2, h, w) is
    NaN where it is unknown and not counted.
    """
    grown = deformation[:, 2:]
    return shift_error(deformation, shift, grown.square().sum(dim=1))


def shift_error(deformation: Tensor, shift: Tensor, more: Tensor | float = 0.0) -> Tensor:
    """Return the mean distance (n,) [px] between a deformation's shift and the true one.

    The true shift (n, 2, h, w) is NaN where it is unknown and not counted; `more` is the square of
    other errors to add (n, h, w) [px^2].
    """
    defined = shift.isfinite().all(dim=1)
    apart = (deformation[:, :2] - shift.nan_to_num()).square().sum(dim=1) + more
    # The gradient of the root is infinite at zero.
    distance = (apart + 1e-6).sqrt() * defined
    return distance.sum(dim=(1, 2)) / defined.sum(dim=(1, 2)).clamp(min=1)


def soft_dice(level: Tensor, images: Tensor) -> Tensor:
    """Return the soft Dice coefficient (n,) of deformed references; 1 if both images are empty."""
    drawn = torch.sigmoid(level / _RAMP_PX)
    both = (drawn * images).sum(dim=(1, 2, 3))
    each = drawn.square().sum(dim=(1, 2, 3)) + images.square().sum(dim=(1, 2, 3))
    return (2 * both + 1) / (each + 1)


def dice(level: Tensor, images: Tensor) -> Tensor:
    """Return the Dice coefficient (n,) of thresholded images; 1 if both are empty.

    Predicted frames are signed distances (n, 1, h, w) [px], true ones in 0..1.
    """
    predicted, due = coverage(level) > 0.5, images > 0.5
    both = (predicted & due).sum(dim=(1, 2, 3))
    each = predicted.sum(dim=(1, 2, 3)) + due.sum(dim=(1, 2, 3))
    return torch.where(
        each > 0, 2 * both / each.clamp(min=1), torch.ones_like(both, dtype=torch.float32)
    )


# Weight of a pass relative to the next one; only the last pass is used for translation.
_EARLIER_LOOK = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class SourceDeformations:
    """Deformations of the source frames of pairs; a frame is the source of many pairs."""

    deformation: Tensor
    """(k, 3, 64, 64) float16 [px]."""
    place: Tensor
    """Row of `deformation` for each pair (m,) int64."""

    def of(self, pairs: Tensor) -> Tensor:
        """Return deformations of some pairs (n, 3, 64, 64) float32 [px]."""
        return self.deformation[self.place[pairs]].float()


def net_loss(looks: list[Tensor], examples: Examples, weights: FieldLossWeights) -> Tensor:
    """Return the loss of the field net's deformations, one (n, 3, 64, 64) per pass."""
    total = torch.zeros((), device=examples.seen.device)
    for index, deformation in enumerate(reversed(looks)):
        level = render(examples.distance, deformation)
        loss = image_loss(level, examples.shown, weights) + regularity_loss(deformation, weights)
        loss = loss + weights.truth * truth_error(deformation, examples.shift).mean()
        total = total + _EARLIER_LOOK**index * loss
    procedural = len(examples.other)
    if procedural:
        level = render(examples.other_distance, looks[-1][-procedural:])
        fraction = procedural / len(examples.seen)
        total = total + fraction * image_loss(level, examples.other, weights)
    return total


def map_loss(
    mapping: nn.Module,
    frames: FieldFrames,
    deformations: SourceDeformations,
    pairs: Tensor,
    patterns: Tensor,
    weights: FieldLossWeights,
) -> Tensor:
    """Return the loss of the map on some pairs, by their indices (n,).

    `patterns` are signed distances (2, m, 1, 256, 256) [px] of two patterns on one gel, for the
    first m pairs: between them the deformation of the source must not change.
    """
    source, target = frames.pairs[pairs].unbind(dim=1)
    source_deformation, distance = deformations.of(pairs), frames.distance(target)
    scales = frames.scale(source), frames.scale(target)
    few = slice(patterns.shape[1])
    # One batch, as a GPU takes longer to launch a pass than to compute it.
    mapped: Tensor = mapping(
        torch.cat([source_deformation, source_deformation[few]]),
        torch.cat([frames.distance(source), patterns[0]]),
        torch.cat([distance, patterns[1]]),
        torch.cat([scales[0], scales[0][few]]),
        torch.cat([scales[1], scales[0][few]]),
    )
    deformation, unchanged = mapped[: len(pairs)], mapped[len(pairs) :]
    level = render(distance, deformation)
    loss = image_loss(level, frames.unit_images(target), weights) + regularity_loss(
        deformation, weights
    )
    if frames.shift is not None:
        error = truth_error(deformation, frames.shift[target].float()).mean()
        loss = loss + weights.truth * error
    if len(unchanged):
        loss = loss + weights.unknown * (unchanged - source_deformation[few]).abs().mean()
    return loss


# Scores of a field model on held-out frames.

# Frames evaluated at once.
AT_ONCE = 64


@torch.no_grad()
def net_scores(model: FieldModel, frames: FieldFrames, most: int, seed: int) -> dict[str, float]:
    """Score the field net on at most `most` of the sensors' own frames, chosen by the seed.

    Returns `dice` of the deformed reference with the frame, `dice_still` of the unchanged
    reference, and the mean `shift_error_px` if the archive has displacement fields.
    """
    rows = _chosen(len(frames), most, seed, frames.device)
    scores: dict[str, list[Tensor]] = {"dice": [], "dice_still": [], "shift_error_px": []}
    for part in rows.split(AT_ONCE):
        images, distance = frames.unit_images(part), frames.distance(part)
        deformation = model.net(images, distance)[-1]
        scores["dice"].append(dice(render(distance, deformation), images))
        scores["dice_still"].append(dice(distance, images))
        if frames.shift is not None:
            shift = frames.shift[part].float()
            defined = shift.isfinite().flatten(1).all(dim=1)
            scores["shift_error_px"].append(shift_error(deformation, shift)[defined])
    return _means(scores)


@torch.no_grad()
def map_scores(
    model: FieldModel, frames: FieldFrames, deformations: SourceDeformations, most: int, seed: int
) -> dict[str, float]:
    """Score the map on at most `most` location pairs, chosen by the seed.

    Returns `dice` with the target's frame, `dice_transferred` for the source's deformation
    unchanged in millimetres, `dice_still` for the target's unchanged reference.
    """
    chosen = _chosen(len(frames.pairs), most, seed, frames.device)
    scores: dict[str, list[Tensor]] = {"dice": [], "dice_transferred": [], "dice_still": []}
    for part in chosen.split(AT_ONCE):
        source, target = frames.pairs[part].unbind(dim=1)
        distance, images = frames.distance(target), frames.unit_images(target)
        scales = frames.scale(source), frames.scale(target)
        deformation = deformations.of(part)
        mapped = model.map(deformation, frames.distance(source), distance, *scales)
        still = transferred(deformation, scales[1] / scales[0])
        scores["dice"].append(dice(render(distance, mapped), images))
        scores["dice_transferred"].append(dice(render(distance, still), images))
        scores["dice_still"].append(dice(distance, images))
    return _means(scores)


@torch.no_grad()
def source_deformations(model: FieldModel, frames: FieldFrames) -> SourceDeformations:
    """Return the field net's deformation of each pair's source."""
    sources, index = torch.unique(frames.pairs[:, 0], return_inverse=True)[:2]
    parts = [
        model.net(frames.unit_images(rows), frames.distance(rows))[-1].half()
        for rows in sources.split(AT_ONCE)
    ]
    return SourceDeformations(torch.cat(parts), index)


def _chosen(count: int, most: int, seed: int, device: torch.device) -> Tensor:
    rows = generator(seed, "validation").permutation(count)[:most]
    return torch.from_numpy(rows).to(device)


def _means(scores: dict[str, list[Tensor]]) -> dict[str, float]:
    joined = {name: torch.cat(values) for name, values in scores.items() if values}
    return {name: float(values.mean()) for name, values in joined.items() if len(values)}


_OF_UNKNOWN = 4  # one of this many pairs is also evaluated under random patterns
_LOG_EVERY_STEPS = 20


def train_field(
    frames: FieldFrames,
    settings: FieldSettings,
    validation: FieldFrames | None = None,
    session: TrainingSession | None = None,
) -> FieldModel:
    """Train a field model on frames and pairs on its device, and return it in evaluation mode.

    Without a session the training is in memory, on the device of the settings.
    """
    session = session or TrainingSession(accelerator(settings.launch))
    run, runs_on = session.run, session.accelerator
    steps = settings.field_stage.steps + settings.map_stage.steps
    if settings.map_stage.steps and not len(frames.pairs):
        raise LearningError(
            "pairs: found none to learn the map from; allowed: two sensors with shared locations, "
            "or map_stage.steps 0"
        )
    model = FieldModel(settings.net, settings.map, settings.seed).to(frames.device)
    model.usual_scale.copy_(frames.scales[frames.sensor].median(dim=0).values)
    done = run.restore({"model": model})
    chance = generator(settings.seed, "patterns")
    bank = PatternBank.drawn(settings.examples.patterns, chance, frames.device)

    def net_step(network: nn.Module, step: int) -> Tensor:
        chance = generator(settings.seed, "examples", step, runs_on.process_index)
        batch = settings.field_stage.batch
        examples = draw_examples(frames, bank, settings.examples, batch, chance)
        return net_loss(network(examples.seen, examples.distance), examples, settings.loss)

    def map_step(network: nn.Module, step: int) -> Tensor:
        chance = generator(settings.seed, "pairs", step, runs_on.process_index)
        chosen = chance.integers(len(frames.pairs), size=settings.map_stage.batch)
        pairs = torch.from_numpy(chosen).to(frames.device)
        few = len(pairs) // _OF_UNKNOWN if settings.loss.unknown and len(bank.distances) else 0
        drawn = chance.integers(max(1, len(bank.distances)), size=(2, few))
        patterns = bank.distances[torch.from_numpy(drawn).to(frames.device)].float()
        return map_loss(network, frames, deformations, pairs, patterns, settings.loss)

    for name, stage, network, loss_of in (
        ("field", settings.field_stage, model.net, net_step),
        ("map", settings.map_stage, model.map, map_step),
    ):
        first = 0 if name == "field" else settings.field_stage.steps
        last = first + stage.steps
        if done >= last:
            continue
        held = validation
        if name == "map":
            # From here the field net is frozen, so it is applied to every source once.
            model.eval()
            deformations = source_deformations(model, frames)
            if held is not None and len(held.pairs):
                held_deformations = source_deformations(model, held)
            else:
                held = None

        # Optimiser
        warm_up = min(stage.warm_up_steps, stage.steps - 1)
        rate = Cosine(stage.learning_rate, warm_up, steps=stage.steps)
        optimiser = torch.optim.AdamW(
            network.parameters(), lr=stage.learning_rate, weight_decay=settings.weight_decay
        )
        if done > first:
            run.restore({"model": model}, {"optimiser": optimiser})
        prepared, wrapped = runs_on.prepare(network, optimiser)

        # Steps
        losses: list[Tensor] = []
        stop = False
        for step in range(done, last):
            prepared.train()
            set_rate(optimiser, rate.at(step - first))
            loss = loss_of(prepared, step)
            # Checked before the backward pass, which may crash for warps to non-finite positions.
            if not bool(loss.isfinite()):
                raise LearningError(
                    f"{name}_stage: found a loss of {loss.item()} on step {step}; allowed: finite "
                    "(try a lower learning_rate)"
                )
            wrapped.zero_grad()
            runs_on.backward(loss)
            runs_on.clip_grad_norm_(network.parameters(), settings.clip)
            wrapped.step()
            losses.append(loss.detach())
            done = step + 1
            stop = session.passed(done, steps)

            # Log, validation and checkpoint
            measured = done == last or done % settings.validate_every_steps == 0
            if measured or stop or done % _LOG_EVERY_STEPS == 0:
                run.log(done, {f"{name}/loss": float(torch.stack(losses).mean())})
                losses.clear()
            scores: dict[str, float] = {}
            if measured and held is not None:
                prepared.eval()
                most, seed = settings.validated, settings.seed
                if name == "field":
                    scores = net_scores(model, held, most, seed)
                else:
                    scores = map_scores(model, held, held_deformations, most, seed)
                run.log(done, {f"{name}/validation_{key}": each for key, each in scores.items()})
            if measured or stop:
                score = 1 - scores["dice"] if scores and last == steps else None
                run.save(done, {"model": model}, {"optimiser": optimiser}, score=score)
            if stop:
                break
        # Remove the mixed-precision wrapper, which is not there after a resume either.
        runs_on.unwrap_model(prepared, keep_fp32_wrapper=False)
        if stop:
            break
    if done == steps:
        run.finish(done, {"model": model})
    return model.eval()


def run(options: argparse.Namespace) -> int:
    """Train as the options of `train field` say; return the exit code."""
    settings = read_settings(FieldSettings, PRESETS, options.preset, options.set)
    train_in(options.out, *open_data(options), settings, options.sensors)
    return 0


def train_in(
    out: Path,
    archive: MarkerArchive,
    split: Split,
    settings: FieldSettings,
    sensors: Sequence[str] | None = None,
) -> None:
    """Train a field translator in a folder, on `sensors` or all that are not held out."""
    sensors = [*(sensors or split.trained_sensors(archive))]

    def train(session: TrainingSession) -> None:
        frames, validation = (
            gather_role(
                archive,
                split,
                sensors,
                role,
                every=settings.every_frame,
                device=session.device,
                progress=session.reading,
            )
            for role in ("train", "validation")
        )
        if frames is None:
            raise LearningError("split: found no press to train on; allowed: one or more")
        with session.stop:
            train_field(frames, settings, validation, session)

    data = (
        f"archive {archive_fingerprint(archive)}, split {split.fingerprint}, "
        f"sensors {', '.join(sensors)}"
    )
    run_training(out, KIND, settings, [data], train, split=split, reading="frames")
