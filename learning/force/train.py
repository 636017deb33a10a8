"""Training of a force model: settings, sequences, range, loss and loop, from top to bottom.

`train_force` takes presses in memory and does not require a run folder, so that it can be called
repeatedly for a table of many sensor pairs. The command is in `command`, the network in `model`.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from learning.config import read_settings, require
from learning.data.presses import AUTHORS, ForceRange, Presses, force_of
from learning.errors import LearningError
from learning.force.model import (
    AXES,
    ForceModel,
    ForceNetworkSettings,
    InputSettings,
    new_force_model,
    prepared_rows,
    require_form,
)
from learning.training.checkpoint import load_weights, read_weights
from learning.training.optim import Constant, Cosine, InversePower, Schedule, set_rate
from learning.training.run import (
    LaunchSettings,
    RunFolder,
    TrainingSession,
    accelerator,
    generator,
    seed_torch,
)

State = dict[str, Tensor]

# Presets shipped with the package.
PRESETS = Path(__file__).parent / "presets"


# Settings: the keys of the presets. Those of the network are in `model`.


@dataclass(frozen=True, slots=True)
class ForceStageSettings:
    """One stage of training."""

    epochs: int
    learning_rate: float
    schedule: Literal["constant", "cosine", "authors"] = "constant"
    """Constant; half a cosine down to 0; or (1 + 3e-4 step)^-0.75 (authors' code)."""
    warm_up_steps: int = 0
    """Number of steps over which the rate first rises from 0."""
    one_sensor: bool = False
    """True to train on only one sensor, drawn by the seed (the paper's first stage)."""

    def __post_init__(self) -> None:
        require(self, "epochs", least=1)
        require(self, "learning_rate", above=0)
        require(self, "warm_up_steps", least=0)


@dataclass(frozen=True, slots=True)
class OptimiserSettings:
    """Optimiser of the weights."""

    name: Literal["sgd", "adamw"] = "adamw"
    momentum: float = 0.9
    weight_decay: float = 1e-2
    clip: float | None = 1.0
    """Gradient norm above which gradients are clipped; none: no clipping."""


@dataclass(frozen=True, slots=True)
class SequenceSettings:
    """Training sequences."""

    batch: int = 8
    """Batch size on each GPU."""
    lengths: Literal["random", "whole"] = "random"
    """Random: from the first frame, a length of 2 frames to all (the paper, Methods)."""
    padding: Literal["masked", "last_frame"] = "masked"
    """Frames after a shorter sequence: masked, or its last frame repeated (authors' code)."""
    presses: int = 1
    """Number of presses of one sensor that form a sequence."""
    flips: bool = False
    """True to mirror images at random, together with the shear."""
    superpose: float = 0.0
    """Fraction of sequences to which another press of the step is added, times a random factor up
    to 1: marker fields and forces both, as in a linear skin. The force range doubles, so that
    forces beyond the training presses can be predicted. Marker fields only."""

    def __post_init__(self) -> None:
        require(self, "batch", "presses", least=1)
        require(self, "superpose", least=0, most=1)


@dataclass(frozen=True, slots=True)
class ForceModelSettings:
    """A force model and its training."""

    description: str
    input: InputSettings
    network: ForceNetworkSettings
    stages: tuple[ForceStageSettings, ...]
    optimiser: OptimiserSettings
    sequences: SequenceSettings
    plugin: str | None = None
    """Name of another package's model to train (`learning.plugins`), whose network and input count
    instead of these; none: ours."""
    force_range: Literal["training", "authors"] = "training"
    """Force range (a box) that the sigmoid spans: of the training labels, or of authors' code."""
    range_margin: float = 0.0
    """Fraction of its length by which the box is extended at either end, because a sigmoid never
    reaches its limits."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Devices and precision of training."""
    start_at_mean: bool = True
    """True if the untrained model predicts the mean label, False if the centre of the box."""
    patience_epochs: int | None = 10
    """Number of validations without improvement after which the last stage ends; none: no early
    end. Stages before it run to their end, as a large learning rate validates badly for long."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.stages:
            raise LearningError("stages: found none; allowed: one or more")
        require(self, "patience_epochs", least=1)
        require(self, "range_margin", least=0)
        if self.sequences.superpose and self.input.form != "field":
            raise LearningError(
                f"sequences.superpose: found {self.sequences.superpose:g} with input.form "
                f"{self.input.form}; allowed: 0, or input.form field: only marker fields add up"
            )
        if self.sequences.flips and self.input.form == "shading":
            raise LearningError(
                "sequences.flips: found true; allowed: false for shading, whose colours follow the "
                "places of the lamps"
            )


def read_force_settings(preset: str, overrides: Sequence[str] = ()) -> ForceModelSettings:
    """Return the settings of a preset or YAML file; a `plugin` determines network and input."""
    settings = read_settings(ForceModelSettings, PRESETS, preset, overrides)
    if settings.plugin is None:
        return settings
    model = new_force_model(settings.plugin, settings.network, settings.input)
    return replace(settings, network=model.network, input=model.inputs)


# Data: selection of a step's frames, a pure function of seed, stage, epoch and step.

# Length of the shortest sequence (the paper, Methods).
SHORTEST = 2


@dataclass(frozen=True, slots=True)
class Sequences:
    """The sequences of one step, on one process."""

    sensor: NDArray[np.int64]
    """Index of the sensor of each sequence (b,)."""
    rows: NDArray[np.int64]
    """Frame indices (b, s) in that sensor's presses; a shorter sequence repeats its last frame."""
    lengths: tuple[int, ...]
    """Number of valid frames of each sequence (b,)."""
    flips: NDArray[np.bool_]
    """True where columns and rows are mirrored (b, 2)."""
    added: NDArray[np.int64]
    """Index of the sequence that is added to each (b,)."""
    factors: NDArray[np.float32]
    """Factor of that sequence (b,); 0: none is added."""


@dataclass(frozen=True, slots=True)
class Epoch:
    """One pass over the presses of some sensors."""

    strings: tuple[tuple[int, NDArray[np.int64]], ...]
    """Sensor and presses of each sequence, in training order."""
    starts: tuple[NDArray[np.int64], ...]
    """Frames of press p of a sensor are starts[p]:starts[p + 1]."""
    settings: SequenceSettings
    seed: int
    number: int
    """Counts epochs over all stages."""

    def steps(self, ranks: int) -> int:
        """Return the number of steps of the pass with `ranks` processes."""
        return -(-len(self.strings) // (self.settings.batch * ranks))

    def sequences(self, step: int, rank: int = 0, ranks: int = 1) -> Sequences:
        """Return the sequences of a step; the last is filled up from the start of the order."""
        batch = self.settings.batch
        first = (step * ranks + rank) * batch
        chosen = [self.strings[index % len(self.strings)] for index in range(first, first + batch)]
        frames = [self._frames(sensor, presses) for sensor, presses in chosen]
        random = generator(self.seed, "force", "sequences", self.number, step, rank)
        longest = max(map(len, frames))
        if self.settings.lengths == "random":
            longest = int(random.integers(min(SHORTEST, longest), longest, endpoint=True))
        lengths = tuple(min(longest, len(each)) for each in frames)
        rows = np.stack([each[np.minimum(np.arange(longest), len(each) - 1)] for each in frames])
        flips = random.random((batch, 2)) < 0.5
        sensors = np.array([sensor for sensor, _ in chosen])
        added, factors = np.arange(batch), np.zeros(batch, np.float32)
        if self.settings.superpose:
            added = random.permutation(batch)
            # Presses of another sensor have another stiffness.
            joins = (random.random(batch) < self.settings.superpose) & (sensors == sensors[added])
            factors = (random.random(batch) * joins).astype(np.float32)
        return Sequences(
            sensors,
            rows,
            lengths,
            flips if self.settings.flips else np.zeros_like(flips),
            added,
            factors,
        )

    def _frames(self, sensor: int, presses: NDArray[np.int64]) -> NDArray[np.int64]:
        starts = self.starts[sensor]
        return np.concatenate([np.arange(starts[press], starts[press + 1]) for press in presses])


def epoch(
    starts: Sequence[NDArray[np.int64]],
    sensors: Sequence[int],
    settings: SequenceSettings,
    seed: int,
    number: int,
) -> Epoch:
    """Return one pass over the presses of the sensors of some indices, in random order.

    Frames of press p of a sensor are starts[p]:starts[p + 1]; presses that fill no whole sequence
    are skipped in this pass.
    """
    random = generator(seed, "force", "epoch", number)
    strings = []
    for sensor in sensors:
        order = random.permutation(len(starts[sensor]) - 1).astype(np.int64)
        per_row = min(settings.presses, len(order))
        whole = order[: len(order) - len(order) % per_row]
        strings += [(sensor, presses) for presses in whole.reshape(-1, per_row)]
    shuffled = [strings[index] for index in random.permutation(len(strings))]
    return Epoch(tuple(shuffled), tuple(starts), settings, seed, number)


def frames_of(
    groups: Sequence[Presses], sequences: Sequences, inputs: InputSettings, device: torch.device
) -> Tensor:
    """Return the prepared and mirrored frames (b, s, planes, side, side) of a step."""
    images = []
    for sensor, rows in zip(sequences.sensor, sequences.rows, strict=True):
        presses = groups[sensor]
        wanted = torch.from_numpy(rows).to(presses.device)
        images.append(prepared_rows(presses, wanted, inputs).to(device))
    return mirrored(torch.stack(images), sequences.flips, inputs)


def mirrored(frames: Tensor, flips: NDArray[np.bool_], inputs: InputSettings) -> Tensor:
    """Return prepared frames (..., b, s, planes, h, w), mirrored where `flips` (b, 2) say so."""
    for plane, axis in enumerate((-1, -2)):
        if not flips[:, plane].any():
            continue
        chosen = torch.from_numpy(flips[:, plane]).to(frames.device)[:, None, None, None, None]
        other = frames.flip(axis)
        if inputs.form == "field":
            sign = torch.ones(frames.shape[-3], device=frames.device)
            sign[plane] = -1.0
            other = other * sign[:, None, None]
        frames = torch.where(chosen, other, frames)
    return frames


def superposed(values: Tensor, sequences: Sequences, *, axis: int = 0) -> Tensor:
    """Return frames or forces (b, s, ...) with added sequences, whose last frame repeats."""
    if not sequences.factors.any():
        return values
    added = torch.from_numpy(sequences.added).to(values.device)
    shape = [-1 if each == axis else 1 for each in range(values.ndim)]
    factors = torch.from_numpy(sequences.factors).to(values).view(shape)
    # A label that is missing in the other press counts only where that press is added.
    return torch.where(factors > 0, values + factors * values.index_select(axis, added), values)


def signs(flips: NDArray[np.bool_], device: torch.device) -> Tensor:
    """Return the signs (b, 1, 3) for forces (..., b, s, 3): shear is mirrored with the image."""
    sign = torch.ones(len(flips), 1, 3)
    sign[:, 0, :2] = torch.where(torch.from_numpy(flips), -1.0, 1.0)
    return sign.to(device)


def forces_of(labels: Sequence[Tensor], sequences: Sequences, device: torch.device) -> Tensor:
    """Return the forces (b, s, 3) N of a step, of those (N, 3) of the frames of each sensor."""
    return _gathered(labels, sequences, device) * signs(sequences.flips, device)


def _gathered(values: Sequence[Tensor], sequences: Sequences, device: torch.device) -> Tensor:
    """Return the values (b, s, 3) of a step, of those (N, 3) of the frames of each sensor."""
    rows = [
        values[sensor][torch.from_numpy(rows).to(values[sensor].device)].to(device)
        for sensor, rows in zip(sequences.sensor, sequences.rows, strict=True)
    ]
    return torch.stack(rows)


# Range of the forces (a box) that a model's output spans.


def force_range(labels: Sequence[Tensor], settings: ForceModelSettings) -> ForceRange:
    """Return the force range of a model, of both signs if mirrored; NaN without a label."""
    forces = torch.cat([each.cpu() for each in labels])
    if settings.force_range == "authors":
        measured = forces.isfinite().any(dim=0).numpy()
        ends = (np.where(measured, end, np.nan) for end in (AUTHORS.low, AUTHORS.high))
        return ForceRange(*map(force_of, ends))
    if settings.sequences.flips:
        forces = torch.cat([forces, forces * forces.new_tensor([-1.0, -1.0, 1.0])])
    if settings.sequences.superpose:
        forces = torch.cat([forces, 2 * forces])
    return ForceRange.from_training(forces, margin=settings.range_margin)


def error(
    predicted: Tensor, wanted: Tensor, lengths: Sequence[int] | None, weights: Tensor | None = None
) -> Tensor:
    """Return the mean absolute error of forces (b, s, 3) over labels of valid frames (eq. 5).

    Forces are normalised to the force range; NaN is no label and adds neither error nor gradient.
    `lengths` (b,) are the numbers of valid frames, `weights` (b, s, 3) those of labels.
    """
    counted = ~wanted.isnan()
    if lengths is not None:
        counts = torch.tensor(lengths, device=wanted.device)
        inside = torch.arange(wanted.shape[1], device=wanted.device) < counts[:, None]
        counted = counted & inside[..., None]
    difference = torch.where(counted, predicted - torch.where(counted, wanted, 0.0), 0.0).abs()
    if weights is None:
        return difference.sum() / counted.sum().clamp(min=1)
    weights = torch.where(counted, weights, 0.0)
    return (weights * difference).sum() / weights.sum().clamp(min=1e-6)


# Spread of a label, as a fraction of the force range, at which it weighs half.
HALF = 0.05


def variances_of(groups: Sequence[Presses]) -> list[Tensor]:
    """Return the variance of the labels (N, 3) N^2 of each sensor; none if all are certain."""
    if all(each.spread is None for each in groups):
        return []
    return [
        torch.zeros_like(each.wrench) if each.spread is None else each.spread.nan_to_num().square()
        for each in groups
    ]


def weights_of(variance: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return weights of labels (..., 3), 1 if certain, for forces in the range low to high (3,)."""
    return 1 / (1 + variance / (HALF * (high - low)).square())


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

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        return asdict(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state from `state_dict`."""
        for name, value in state.items():
            setattr(self, name, value)


def train_force(
    presses: Presses | Sequence[Presses],
    settings: ForceModelSettings,
    session: TrainingSession | None = None,
    *,
    validation: Presses | Sequence[Presses] = (),
    start_from: ForceModel | None = None,
) -> ForceModel:
    """Train a force model on presses of one or several sensors and return it in evaluation mode.

    Presses stay on their device; on the GPU that avoids a copy at every step. Without a session the
    training is in memory, on the device of the settings; a stop is looked for before every step,
    training is then saved. Validation presses determine the end of the last stage and the weights
    to keep; those of sensors without a label are left out. `start_from` is a model with the same
    network, for the initial weights.
    """
    session = session or TrainingSession(accelerator(settings.launch))
    run, runs_on, device = session.run, session.accelerator, session.device
    ranks, rank = runs_on.num_processes, runs_on.process_index

    # Data
    groups, held = _groups(presses), [each for each in _groups(validation) if each.is_labelled]
    if settings.input.alone:
        groups = [each.each_frame_alone() for each in groups]
    for each in (*groups, *held):
        require_form(each, settings.input)
    if not groups or not all(len(each) for each in groups):
        raise LearningError("presses: found none of a sensor; allowed: one or more of each")
    for each in (*groups, *held):
        each.require_wrench()
    labels = [each.wrench for each in groups]
    variances = variances_of(groups)

    # Model
    model = initial_model(labels, settings, start_from, device)
    network: nn.Module = runs_on.prepare(model)
    optimiser = runs_on.prepare(optimiser_of(model.parameters(), settings.optimiser))

    # Loop
    state, best = _resumed(run, model, optimiser)
    total = total_steps(groups, settings, ranks)
    while state.stage < len(settings.stages):
        stage = settings.stages[state.stage]
        passes = epoch_of(groups, stage, settings, state.epochs)
        steps = passes.steps(ranks)
        schedule = schedule_of(stage, stage.epochs * steps)
        summed = torch.tensor(state.summed, dtype=torch.float64, device=device)
        network.train()
        while state.step < steps and not session.stopping():
            seed_torch(settings.seed, "force", "step", state.steps, rank)
            sequences = passes.sequences(state.step, rank, ranks)
            lengths = sequences.lengths if settings.sequences.padding == "masked" else None
            frames = frames_of(groups, sequences, settings.input, device)  # (b, s, planes, h, w)
            frames = superposed(frames, sequences)
            forces = superposed(forces_of(labels, sequences, device), sequences)
            targets = model.normalised(forces)  # (b, s, 3)
            normalised, _ = network(frames, lengths=lengths)
            weights = None
            if variances:
                unsure = superposed(_gathered(variances, sequences, device), sequences)
                weights = weights_of(unsure, model.low, model.high)
            loss = error(normalised, targets, lengths, weights)
            set_rate(optimiser, schedule.at(state.epoch * steps + state.step))
            optimiser.zero_grad()
            runs_on.backward(loss)
            if settings.optimiser.clip is not None:
                runs_on.clip_grad_norm_(model.parameters(), settings.optimiser.clip)
            optimiser.step()
            summed += loss.detach()
            state.step += 1
            state.steps += 1
            session.progress(state.steps, total)
        state.summed = float(summed)
        if not math.isfinite(state.summed):
            raise LearningError(
                f"loss: found {state.summed} within {state.steps} steps; allowed: finite "
                "(try a smaller learning_rate)"
            )
        if state.step < steps:
            _save(run, state, model, best, optimiser)
            break

        # Evaluation
        line: dict[str, float] = {"stage": state.stage, "loss": state.summed / steps}
        state = replace(state, epoch=state.epoch + 1, step=0, summed=0.0, epochs=state.epochs + 1)
        score = None
        if held:
            # Reduced over processes, so that all of them end a stage at the same time.
            off = runs_on.reduce(_validated(model, held), "mean")
            score = float(off.nanmean())
            if score < state.best:
                best = {name: value.clone() for name, value in model.state_dict().items()}
            state.waited = 0 if score < state.best else state.waited + 1
            # Before the last stage every validation counts as the best: its last weights go on.
            if state.stage == len(settings.stages) - 1:
                state.best = min(score, state.best)
            off_in_newtons = (off * (model.high - model.low)).tolist()
            named = zip(AXES, off_in_newtons, strict=True)
            line["validation"] = score
            line |= {f"mae_{axis}_n": off_n for axis, off_n in named if math.isfinite(off_n)}
        patience = settings.patience_epochs
        if state.epoch == stage.epochs or (patience is not None and state.waited >= patience):
            if best is not None:
                model.load_state_dict(best)
            state = TrainState(stage=state.stage + 1, epochs=state.epochs, steps=state.steps)
            best = None
            optimiser = runs_on.prepare(optimiser_of(model.parameters(), settings.optimiser))
        run.log(state.steps, line)
        _save(run, state, model, best, optimiser, score)
    else:
        run.finish(state.steps, {"model": model})
    # Otherwise the model would be evaluated in the precision of the training.
    bare: ForceModel = runs_on.unwrap_model(model, keep_fp32_wrapper=False)
    return bare.eval()


def _groups(presses: Presses | Sequence[Presses]) -> list[Presses]:
    return [presses] if isinstance(presses, Presses) else list(presses)


def initial_model(
    labels: Sequence[Tensor],
    settings: ForceModelSettings,
    start_from: ForceModel | None,
    device: torch.device,
) -> ForceModel:
    """Return the initial model of a training, for the labels (N, 3) N of each sensor."""
    seed_torch(settings.seed, "force", "weights")
    model = new_force_model(settings.plugin, settings.network, settings.input).to(device)
    if start_from is not None:
        load_weights(model, start_from.state_dict(), "start_from")
        for key in ("encoder_norm", "tail_norm", "tail_block"):
            # Tensors may be alike between these, and mean something else.
            actual = getattr(start_from.network, key)
            allowed = getattr(settings.network, key)
            if actual != allowed:
                raise LearningError(
                    f"start_from: found network.{key} {actual}; allowed: {allowed}, as the "
                    "settings of the training say"
                )
    model.set_range(force_range(labels, settings))
    if start_from is None and settings.start_at_mean:
        means = [model.normalised(each.to(device)).nanmean(dim=0) for each in labels]
        # An axis without a label starts at the centre of its box.
        model.start_at(torch.stack(means).nanmean(dim=0).nan_to_num(nan=0.5))
    return model


def epoch_of(
    groups: Sequence[Presses], stage: ForceStageSettings, settings: ForceModelSettings, number: int
) -> Epoch:
    """Return a pass over the presses of all sensors, or of the only sensor of a stage."""
    sensors = range(len(groups))
    if stage.one_sensor:
        drawn = int(generator(settings.seed, "force", "sensor").integers(len(groups)))
        sensors = range(drawn, drawn + 1)
    starts = [each.starts.cpu().numpy() for each in groups]
    return epoch(starts, sensors, settings.sequences, settings.seed, number)


def total_steps(groups: Sequence[Presses], settings: ForceModelSettings, ranks: int = 1) -> int:
    """Return the number of steps of all stages with `ranks` processes, without an early end."""
    return sum(
        stage.epochs * epoch_of(groups, stage, settings, 0).steps(ranks)
        for stage in settings.stages
    )


def schedule_of(stage: ForceStageSettings, steps: int) -> Schedule:
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


def _validated(model: ForceModel, held: Sequence[Presses]) -> Tensor:
    """Return the mean absolute error (3,) over labels, normalised; NaN for axes without one."""
    off = [
        (model.predict_normalised(each) - model.normalised(each.wrench.to(model.low.device))).abs()
        for each in held
    ]
    return torch.cat(off).nanmean(dim=0)


def _save(
    run: RunFolder,
    state: TrainState,
    model: nn.Module,
    best: State | None,
    optimiser: Any,
    score: float | None = None,
) -> None:
    models: dict[str, nn.Module | State] = {"model": model}
    if best is not None:
        models["best"] = best
    run.save(state.steps, models, {"optimiser": optimiser, "course": state}, score=score)


def _resumed(run: RunFolder, model: nn.Module, optimiser: Any) -> tuple[TrainState, State | None]:
    """Restore a run's latest checkpoint; return its progress and the best weights of its stage."""
    state, best = TrainState(), None
    run.restore({"model": model}, {"optimiser": optimiser, "course": state})
    folder = run.latest()
    if folder is not None and (file := folder / "best.safetensors").exists():
        device = next(model.parameters()).device
        best = {name: value.to(device) for name, value in read_weights(file).items()}
    return state, best
