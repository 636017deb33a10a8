"""The force model: encoder, convolutional GRU, residual tail, sigmoid head (the paper, Methods)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from learning.data.presses import ForceRange
from learning.errors import LearningError
from learning.training.run import LaunchSettings

# What a force model is made of and how it is trained: the keys of the presets.

# The presets that are shipped.
PRESETS = Path(__file__).parent / "presets"
# Marker fields are sampled at so many places along either axis.
FIELD_SIDE = 32
_SIDES = (256, 128, 64, 32)


@dataclass(frozen=True, slots=True)
class InputSettings:
    """What the network is shown of a frame."""

    form: Literal["image", "difference", "both", "field"] = "both"
    """The image, the image less the untouched one, image and difference as two channels, or the
    marker field (dx, dy, change of log area) that was measured in it."""
    side_px: int = 256
    """Images are averaged down to this side; fields have their own."""
    channels: int = 1
    """3 repeats a single channel, as nets made for colour want it."""
    imagenet: bool = False
    """Whether the statistics of ImageNet are taken off (the paper, Methods)."""
    marker_value: float = 1.0
    """What a marker is worth before that; authors' code feeds 1/255 for homogeneous sensors."""
    field_scale_px: float = 10.0
    """Displacements are divided by this [px of the 640 x 480 image]."""

    def __post_init__(self) -> None:
        """Refuse what no network here can be made for."""
        if self.side_px not in _SIDES:
            allowed = ", ".join(map(str, _SIDES))
            raise LearningError(f"side_px: found {self.side_px}; allowed: {allowed}")
        if self.channels not in (1, 3) or (self.channels == 3 and self.form not in _SINGLE):
            single = " or ".join(_SINGLE)
            raise LearningError(
                f"channels: found {self.channels}; allowed: 1, or 3 where form is {single}"
            )
        if self.imagenet and self.channels != 3:
            raise LearningError("imagenet: found true; allowed: where channels is 3")
        _positive(self, "marker_value", "field_scale_px")

    @property
    def stored_form(self) -> Literal["images", "field"]:
        """What presses in memory have to hold."""
        return "field" if self.form == "field" else "images"

    @property
    def planes(self) -> int:
        """Number of channels that the network takes."""
        return {"both": 2, "field": 3}.get(self.form, self.channels)

    @property
    def side(self) -> int:
        """Side of what the network takes [px or lattice points]."""
        return FIELD_SIDE if self.form == "field" else self.side_px

    @property
    def needs_reference(self) -> bool:
        """Whether the untouched image is needed beside a frame."""
        return self.form in ("difference", "both")


_SINGLE = ("image", "difference")


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """Widths and norms; as they stand they are the paper's (Methods, force prediction model)."""

    encoder: tuple[int, int, int] = (64, 96, 128)
    """Channels at 1/2, 1/4 and 1/8 of the side."""
    blocks: int = 2
    """Residual blocks of each of these stages."""
    memory: int = 128
    """Channels of the hidden state of the convolutional GRU."""
    tail: tuple[int, int] = (256, 512)
    """Channels of the two residual blocks behind it, each of which halves the side."""
    encoder_norm: Literal["instance", "batch", "group", "none"] = "instance"
    tail_norm: Literal["batch", "group", "none"] = "batch"
    dropout: float = 0.0
    """Share of the encoder's channels that is left out while training."""

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        widths = (*self.encoder, self.memory, *self.tail)
        if min(widths) < 4 or any(width % 4 for width in widths):
            raise LearningError(f"encoder, memory, tail: found {widths}; allowed: multiples of 4")
        _positive(self, "blocks")
        if not 0.0 <= self.dropout < 1.0:
            raise LearningError(f"dropout: found {self.dropout}; allowed: 0 to below 1")


@dataclass(frozen=True, slots=True)
class StageSettings:
    """One stage of training."""

    epochs: int
    learning_rate: float
    schedule: Literal["constant", "cosine", "authors"] = "constant"
    """Constant; half a cosine down to nothing; or (1 + 3e-4 step)^-0.75 (authors' code)."""
    warm_up_steps: int = 0
    """Steps over which the rate first rises from nothing."""
    one_sensor: bool = False
    """Whether only one sensor, drawn by the seed, is learned from (the paper's first stage)."""

    def __post_init__(self) -> None:
        """Refuse a stage in which nothing happens."""
        _positive(self, "epochs", "learning_rate")
        if self.warm_up_steps < 0:
            raise LearningError(f"warm_up_steps: found {self.warm_up_steps}; allowed: 0 and more")


@dataclass(frozen=True, slots=True)
class OptimiserSettings:
    """How weights are moved."""

    name: Literal["sgd", "adamw"] = "adamw"
    momentum: float = 0.9
    """Of SGD."""
    weight_decay: float = 1e-2
    clip: float | None = 1.0
    """Largest norm of a gradient; none: as it comes."""


@dataclass(frozen=True, slots=True)
class SequenceSettings:
    """What a training sequence is."""

    batch: int = 8
    """Sequences of a step on each GPU."""
    lengths: Literal["random", "whole"] = "random"
    """Random: from the first frame on, 2 frames to all of them (the paper, Methods)."""
    padding: Literal["masked", "last_frame"] = "masked"
    """Whether what follows a shorter sequence counts: its last frame again (authors' code)."""
    presses: int = 1
    """Presses of one sensor that are strung together in a sequence."""
    truncate_frames: int | None = None
    """Gradients reach back no further than the last multiple of this; none: to the beginning."""
    flips: bool = False
    """Whether images are mirrored at random, and the shear with them."""

    def __post_init__(self) -> None:
        """Refuse empty sequences."""
        _positive(self, "batch", "presses")
        if self.truncate_frames is not None and self.truncate_frames < 1:
            found = self.truncate_frames
            raise LearningError(f"truncate_frames: found {found}; allowed: 1 and more, or none")


@dataclass(frozen=True, slots=True)
class ForceSettings:
    """A force model and its training."""

    description: str
    input: InputSettings
    network: NetworkSettings
    stages: tuple[StageSettings, ...]
    optimiser: OptimiserSettings
    sequences: SequenceSettings
    force_range: Literal["training", "authors"] = "training"
    """The box of forces that the sigmoid spans: of the training labels, or authors' code's."""
    range_margin: float = 0.0
    """Share of its length by which that box is longer at either end: a sigmoid never quite reaches
    its own."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Device and precision of training."""
    ema: float | None = None
    """Decay of the average of the weights that is kept instead of the last; none: the last."""
    start_at_mean: bool = True
    """Whether the untrained model says the mean label, rather than the middle of the box."""
    patience_epochs: int | None = 10
    """Validations without a better one, after which a stage ends; none: it never does."""
    validate_every_epochs: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse training without stages."""
        if not self.stages:
            raise LearningError("stages: found none; allowed: one and more")
        if self.ema is not None and not 0.0 < self.ema < 1.0:
            raise LearningError(f"ema: found {self.ema}; allowed: between 0 and 1, or none")
        if self.patience_epochs is not None and self.patience_epochs < 1:
            found = self.patience_epochs
            raise LearningError(f"patience_epochs: found {found}; allowed: 1 and more, or none")
        if self.range_margin < 0.0:
            raise LearningError(f"range_margin: found {self.range_margin}; allowed: 0 and more")
        _positive(self, "validate_every_epochs")


def _positive(settings: object, *names: str) -> None:
    for name in names:
        if not getattr(settings, name) > 0:
            raise LearningError(f"{name}: found {getattr(settings, name)}; allowed: more than 0")


# Parts of the force model: residual blocks, encoders and the convolutional GRU.

# Channels that group norm pools; all widths are multiples of it.
_GROUP = 4


def norm(kind: str, channels: int) -> nn.Module:
    """Return a normalisation: instance, batch, group or none."""
    if kind == "instance":
        return nn.InstanceNorm2d(channels)
    if kind == "batch":
        return nn.BatchNorm2d(channels)
    if kind == "group":
        return nn.GroupNorm(channels // _GROUP, channels)
    return nn.Identity()


class EncoderBlock(nn.Module):
    """A residual block as in RAFT: its branch ends in a ReLU of its own."""

    def __init__(self, before: int, after: int, *, stride: int, kind: str) -> None:
        """Make the block; it halves the side where the stride is 2."""
        super().__init__()
        self.branch = nn.Sequential(
            nn.Conv2d(before, after, 3, stride=stride, padding=1),
            norm(kind, after),
            nn.ReLU(),
            nn.Conv2d(after, after, 3, padding=1),
            norm(kind, after),
            nn.ReLU(),
        )
        self.skip: nn.Module = nn.Identity()
        if stride != 1 or before != after:
            self.skip = nn.Sequential(nn.Conv2d(before, after, 1, stride=stride), norm(kind, after))

    def forward(self, features: Tensor) -> Tensor:
        """Return features (n, after, h / stride, w / stride)."""
        return torch.relu(self.skip(features) + self.branch(features))


class TailBlock(nn.Module):
    """A residual block as in ResNet-18, which halves the side."""

    def __init__(self, before: int, after: int, *, kind: str) -> None:
        """Make the block."""
        super().__init__()
        bias = kind == "none"
        self.branch = nn.Sequential(
            nn.Conv2d(before, after, 3, stride=2, padding=1, bias=bias),
            norm(kind, after),
            nn.ReLU(),
            nn.Conv2d(after, after, 3, padding=1, bias=bias),
            norm(kind, after),
        )
        self.skip = nn.Sequential(
            nn.Conv2d(before, after, 1, stride=2, bias=bias), norm(kind, after)
        )

    def forward(self, features: Tensor) -> Tensor:
        """Return features (n, after, h / 2, w / 2)."""
        return torch.relu(self.skip(features) + self.branch(features))


def image_encoder(settings: NetworkSettings, planes: int) -> nn.Sequential:
    """Return what turns images (n, planes, h, w) into features (n, last width, h / 8, w / 8).

    RAFT's encoder (the paper, Methods; authors' code): 7 x 7 convolution, three stages of residual
    blocks, of which the second and third halve the side, 1 x 1 convolution.
    """
    kind = settings.encoder_norm
    first, _, last = settings.encoder
    parts: list[nn.Module] = [
        nn.Conv2d(planes, first, 7, stride=2, padding=3),
        norm(kind, first),
        nn.ReLU(),
    ]
    before = first
    for stage, width in enumerate(settings.encoder):
        for block in range(settings.blocks):
            stride = 2 if stage and not block else 1
            parts.append(EncoderBlock(before, width, stride=stride, kind=kind))
            before = width
    parts += [nn.Conv2d(last, last, 1), nn.Dropout2d(settings.dropout)]
    return nn.Sequential(*parts)


def field_encoder(settings: NetworkSettings, planes: int) -> nn.Sequential:
    """Return what turns fields (n, planes, h, w) into features (n, last width, h / 2, w / 2).

    Fields are smooth, so half of their lattice keeps what they say.
    """
    first, second, last = settings.encoder
    kind = settings.encoder_norm
    return nn.Sequential(
        nn.Conv2d(planes, first, 3, padding=1),
        nn.ReLU(),
        EncoderBlock(first, second, stride=2, kind=kind),
        nn.Conv2d(second, last, 1),
        nn.Dropout2d(settings.dropout),
    )


def encoder(settings: NetworkSettings, inputs: InputSettings) -> nn.Sequential:
    """Return the encoder that an input asks for."""
    make = field_encoder if inputs.form == "field" else image_encoder
    return make(settings, inputs.planes)


class ConvGru(nn.Module):
    """A gated recurrent unit whose weights are 3 x 3 convolutions (the paper, Methods)."""

    def __init__(self, planes: int, hidden: int) -> None:
        """Make the unit for inputs of `planes` channels."""
        super().__init__()
        self.hidden = hidden
        self.gates = nn.Conv2d(hidden + planes, 2 * hidden, 3, padding=1)
        self.candidate = nn.Conv2d(hidden + planes, hidden, 3, padding=1)

    def forward(self, features: Tensor, state: Tensor) -> Tensor:
        """Return the next state (n, hidden, h, w) of features (n, planes, h, w)."""
        gates = torch.sigmoid(self.gates(torch.cat((state, features), dim=1)))
        update, reset = gates.chunk(2, dim=1)
        candidate = torch.tanh(self.candidate(torch.cat((reset * state, features), dim=1)))
        return (1 - update) * state + update * candidate


AXES = ("Fx", "Fy", "Fz")
# The untrained model stays so far from the ends of the sigmoid.
_NEAREST = 1e-3


class ForceModel(nn.Module):
    """From frames to three-axis force, with a memory for what was before.

    Forces are shares of the box of forces, 0 to 1; `newtons` turns them into N. The box is part of
    the weights, so that it is stored with them.
    """

    low: Tensor
    high: Tensor

    def __init__(self, network: NetworkSettings, inputs: InputSettings) -> None:
        """Make the model; convolutions begin as Kaiming has them, norms constant (Methods)."""
        super().__init__()
        self.inputs = inputs
        self.encoder = encoder(network, inputs)
        self.memory = ConvGru(network.encoder[-1], network.memory)
        middle, last = network.tail
        self.tail = nn.Sequential(
            TailBlock(network.memory, middle, kind=network.tail_norm),
            TailBlock(middle, last, kind=network.tail_norm),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
        )
        self.head = nn.Linear(last, len(AXES))
        self.register_buffer("low", torch.zeros(len(AXES)))
        self.register_buffer("high", torch.ones(len(AXES)))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    @property
    def state_shape(self) -> tuple[int, int, int]:
        """Shape (channels, h, w) of the state of one sequence."""
        side = self.inputs.side // (2 if self.inputs.form == "field" else 8)
        return self.memory.hidden, side, side

    def untouched(self, batch: int) -> Tensor:
        """Return the state (batch, channels, h, w) before anything was seen."""
        return self.head.weight.new_zeros(batch, *self.state_shape)

    def forward(
        self,
        frames: Tensor,
        state: Tensor | None = None,
        *,
        lengths: Sequence[int] | None = None,
        truncate: int | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return forces (b, s, 3), 0 to 1, and the state after the last frame of each sequence.

        What comes after a sequence's length is neither computed nor counted: its forces are 0, and
        it changes no statistic of a norm and no gradient.

        Args:
            frames: Prepared frames (b, s, planes, h, w).
            state: What the sequences before ended with (b, channels, h, w); None: untouched.
            lengths: Frames of each sequence (b,); None: all.
            truncate: Gradients stop at frames whose number is a multiple of this.
        """
        batch, steps = frames.shape[:2]
        length = [steps] * batch if lengths is None else lengths
        order = sorted(range(batch), key=lambda row: -length[row])
        place = [(row, time) for time in range(steps) for row in order if time < length[row]]
        rows, times = (
            torch.tensor(index, device=frames.device) for index in zip(*place, strict=True)
        )
        features = self.encoder(frames[rows, times])
        hidden = self.untouched(batch).to(features.dtype) if state is None else state
        hidden = hidden[order]
        seen, begin = [], 0
        for time in range(max(length)):
            running = sum(time < each for each in length)
            if truncate and time and time % truncate == 0:
                hidden = hidden.detach()
            now = self.memory(features[begin : begin + running], hidden[:running])
            hidden = torch.cat((now, hidden[running:])) if running < batch else now
            seen.append(now)
            begin += running
        shares = torch.sigmoid(self.head(self.tail(torch.cat(seen))).float())
        forces = shares.new_zeros(batch, steps, len(AXES)).index_put((rows, times), shares)
        back = sorted(range(batch), key=order.__getitem__)
        return forces, hidden[back]

    def step(self, frame: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return force (b, 3), 0 to 1, and state after one more prepared frame (b, planes, h, w).

        Frame after frame this is the same as `forward` on the sequence, in evaluation mode.
        """
        features = self.encoder(frame)
        before = self.untouched(len(frame)).to(features.dtype) if state is None else state
        after = self.memory(features, before)
        return torch.sigmoid(self.head(self.tail(after)).float()), after

    def set_range(self, box: ForceRange) -> None:
        """Set the box of forces that 0 and 1 stand for."""
        self.low.copy_(self.low.new_tensor(box.low))
        self.high.copy_(self.high.new_tensor(box.high))

    def newtons(self, shares: Tensor) -> Tensor:
        """Return forces (..., 3) N of shares of the box."""
        return self.low + shares * (self.high - self.low)

    def shares(self, forces: Tensor) -> Tensor:
        """Return shares of the box of forces (..., 3) N."""
        return (forces - self.low) / (self.high - self.low)

    def start_at(self, mean: Tensor) -> None:
        """Let the untrained model say a force (3,), given as shares of the box."""
        near = mean.clamp(_NEAREST, 1.0 - _NEAREST)
        with torch.no_grad():
            self.head.bias.copy_(torch.logit(near))
            self.head.weight.normal_(std=1.0 / (10.0 * math.sqrt(self.head.in_features)))


# What is stored of a frame becomes what the network takes; part of the exported graph as well.

# Side of stored images [px].
STORED_SIDE = 256
# Of ImageNet's red, green and blue (the paper, Methods).
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def stored_shape(inputs: InputSettings) -> tuple[int, ...]:
    """Return the shape of a stored frame: an image (256, 256) or a marker field (3, 32, 32)."""
    if inputs.form == "field":
        return (3, FIELD_SIDE, FIELD_SIDE)
    return (STORED_SIDE, STORED_SIDE)


def prepare(frames: Tensor, references: Tensor | None, inputs: InputSettings) -> Tensor:
    """Return what the network takes (n, planes, side, side), float.

    Args:
        frames: Images (n, 256, 256) uint8, or marker fields (n, 3, 32, 32) float: dx, dy [px of
            the 640 x 480 image] and the change of the logarithm of a marker's area.
        references: Images of the untouched sensor (n, 256, 256) uint8, where the form needs them.
        inputs: What is to be shown.

    Raises:
        LearningError: Frames of another shape or type, or a reference is missing.
    """
    require_stored(frames, inputs, "frames")
    if inputs.form == "field":
        scale = frames.new_tensor([inputs.field_scale_px, inputs.field_scale_px, 1.0])
        return frames / scale[:, None, None]
    image = _reduced(frames, inputs)
    if inputs.needs_reference:
        if references is None:
            raise LearningError(
                f"reference: missing; input {inputs.form} needs the untouched image"
            )
        require_stored(references, inputs, "reference")
        difference = image - _reduced(references, inputs)
        image = difference if inputs.form == "difference" else torch.cat((image, difference), dim=1)
    if inputs.channels == 3:
        image = image.expand(-1, 3, -1, -1)
    if inputs.imagenet:
        image = (image - image.new_tensor(_MEAN)[:, None, None]) / image.new_tensor(_DEVIATION)[
            :, None, None
        ]
    return image


def require_stored(frames: Tensor, inputs: InputSettings, name: str) -> None:
    """Refuse frames that are not stored as the input has them.

    Raises:
        LearningError: Another shape or type.
    """
    expected = stored_shape(inputs)
    kind = torch.float32 if inputs.form == "field" else torch.uint8
    if tuple(frames.shape[1:]) != expected or frames.dtype != kind:
        found = f"{tuple(frames.shape)} {str(frames.dtype).removeprefix('torch.')}"
        allowed = f"(n, {', '.join(map(str, expected))}) {str(kind).removeprefix('torch.')}"
        raise LearningError(f"{name}: found {found}; allowed: {allowed}, as {inputs.form} has it")


def _reduced(images: Tensor, inputs: InputSettings) -> Tensor:
    grey = images[:, None].to(torch.float32) * (inputs.marker_value / 255.0)
    factor = STORED_SIDE // inputs.side_px
    return functional.avg_pool2d(grey, factor) if factor > 1 else grey
