"""The force model: encoder, convolutional GRU, residual tail, sigmoid head (the paper, Methods).

`learning.force.loading` opens a trained one, `ForceModel.predict` returns the forces of presses.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from learning.config import require
from learning.data.presses import ForceRange, Presses
from learning.errors import LearningError
from learning.plugins import load_plugin
from recorder.archive import SHADING, SHADING_SIDE, SHADING_ZERO
from recorder.progress import ReportItems

# Kind of a force model's folder, and key of the settings of one in closed form.
KIND, CLOSED_FORM = "force", "closed_form"
# Number of presses predicted at once, by type of device.
_AT_ONCE = {"cpu": 8, "cuda": 128}

# Settings of the network: two of the keys of the presets. Those of the training are in `train`.

# Number of samples of a marker field along either axis.
FIELD_SIDE = 32
_SIDES = (256, 128, 64, 32)


@dataclass(frozen=True, slots=True)
class InputSettings:
    """Network input computed from a frame."""

    form: Literal["image", "both", "field", "shading"] = "both"
    """The image, image and image minus reference as two channels, the measured marker field (dx,
    dy, change of log area), or the shading of a gel without markers."""
    side_px: int = 256
    """Side to which images are averaged down; fields have a fixed side."""
    channels: int = 1
    """3 repeats a single channel for networks that take colour images."""
    imagenet: bool = False
    """True to normalise by the statistics of ImageNet (the paper, Methods)."""
    marker_value: float = 1.0
    """Value of a marker before normalisation; authors' code: 1/255 for homogeneous sensors."""
    field_scale_px: float = 10.0
    """Divisor of displacements [px of the 640 x 480 image]."""
    alone: bool = False
    """True if each frame is predicted alone: the state starts again at each, in training and later.
    With few recordings a state learns the course of their presses instead of forces."""
    shading_scale: float = 32.0
    """Divisor of the change of colours [grey levels]."""

    def __post_init__(self) -> None:
        if self.side_px not in _SIDES:
            allowed = ", ".join(map(str, _SIDES))
            raise LearningError(f"side_px: found {self.side_px}; allowed: {allowed}")
        if self.channels not in (1, 3) or (self.channels == 3 and self.form != "image"):
            raise LearningError(
                f"channels: found {self.channels}; allowed: 1, or 3 if form is image"
            )
        if self.imagenet and self.channels != 3:
            raise LearningError("imagenet: found true; allowed: only if channels is 3")
        if self.form == "shading" and self.side_px > SHADING_SIDE:
            raise LearningError(
                f"side_px: found {self.side_px}; allowed: {SHADING_SIDE} or less for shading"
            )
        require(self, "marker_value", "field_scale_px", "shading_scale", above=0)

    @property
    def stored_form(self) -> Literal["images", "field", "shading"]:
        """Required form of presses in memory."""
        return self.form if self.form in ("field", "shading") else "images"

    @property
    def planes(self) -> int:
        """Number of input channels of the network."""
        return {"both": 2, "field": 3, "shading": 3}.get(self.form, self.channels)

    @property
    def side(self) -> int:
        """Side of the network's input [px or lattice points]."""
        return FIELD_SIDE if self.form == "field" else self.side_px

    @property
    def needs_reference(self) -> bool:
        """True if the image without contact is needed in addition to a frame."""
        return self.form == "both"


@dataclass(frozen=True, slots=True)
class ForceNetworkSettings:
    """Widths and norms; the defaults are the paper's (Methods, force prediction model)."""

    encoder: tuple[int, int, int] = (64, 96, 128)
    """Channels at 1/2, 1/4 and 1/8 of the side."""
    blocks: int = 2
    """Number of residual blocks in each of these stages."""
    memory: int = 128
    """Channels of the hidden state of the convolutional GRU."""
    tail: tuple[int, int] = (256, 512)
    """Channels of the two residual blocks after it, each of which halves the side."""
    encoder_norm: Literal["instance", "batch", "none"] = "instance"
    tail_norm: Literal["batch", "none"] = "batch"
    tail_block: Literal["resnet", "raft"] = "resnet"
    """Residual blocks of the tail: as in ResNet-18, or as in the encoder (authors' code), which
    have biases and a ReLU at the end of their branch."""
    dropout: float = 0.0
    """Fraction of the encoder's channels dropped during training."""

    def __post_init__(self) -> None:
        require(self, "encoder", "blocks", "memory", "tail", least=1)
        require(self, "dropout", least=0, below=1)


# Parts of the force model: residual blocks, encoders and the convolutional GRU.


def norm(kind: str, channels: int) -> nn.Module:
    """Return a normalisation layer: instance, batch or none."""
    if kind == "instance":
        return nn.InstanceNorm2d(channels)
    if kind == "batch":
        return nn.BatchNorm2d(channels)
    return nn.Identity()


class EncoderBlock(nn.Module):
    """A residual block as in RAFT, whose branch ends in a separate ReLU."""

    def __init__(self, before: int, after: int, *, stride: int, kind: str) -> None:
        """Build the block; a stride of 2 halves the side."""
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
    """A residual block as in ResNet-18 that halves the side."""

    def __init__(self, before: int, after: int, *, kind: str) -> None:
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


def image_encoder(settings: ForceNetworkSettings, planes: int) -> nn.Sequential:
    """Return the encoder of images (n, planes, h, w) into features (n, last width, h / 8, w / 8).

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


def field_encoder(settings: ForceNetworkSettings, planes: int) -> nn.Sequential:
    """Return the encoder of fields (n, planes, h, w), which are smooth, to half their size."""
    first, second, last = settings.encoder
    kind = settings.encoder_norm
    return nn.Sequential(
        nn.Conv2d(planes, first, 3, padding=1),
        nn.ReLU(),
        EncoderBlock(first, second, stride=2, kind=kind),
        nn.Conv2d(second, last, 1),
        nn.Dropout2d(settings.dropout),
    )


class ConvGru(nn.Module):
    """A gated recurrent unit whose weights are 3 x 3 convolutions (the paper, Methods)."""

    def __init__(self, planes: int, hidden: int) -> None:
        """Build the unit for inputs of `planes` channels."""
        super().__init__()
        self.hidden = hidden
        self.gates = nn.Conv2d(hidden + planes, 2 * hidden, 3, padding=1)
        self.candidate = nn.Conv2d(hidden + planes, hidden, 3, padding=1)

    def forward(self, features: Tensor, state: Tensor) -> Tensor:
        """Return the next state (n, hidden, h, w) for features (n, planes, h, w)."""
        gates = torch.sigmoid(self.gates(torch.cat((state, features), dim=1)))
        update, reset = gates.chunk(2, dim=1)
        candidate = torch.tanh(self.candidate(torch.cat((reset * state, features), dim=1)))
        return (1 - update) * state + update * candidate


AXES = ("Fx", "Fy", "Fz")
# Minimum distance of the untrained model's output from the ends of the sigmoid.
_NEAREST = 1e-3


class ForceModel(nn.Module):
    """Recurrent network from frames to three-axis force.

    Outputs are forces normalised to the force range (a box), 0 to 1; `denormalise` converts them to
    N. The box is a buffer, so it is stored with the weights. It is NaN for axes that no training
    label had, and so are forces on these axes.

    A model of another package (`learning.plugins`) is a subclass that replaces `encoder`, `memory`,
    `tail` or `head`, or overrides `forward` and `step`; all that trains, exports or runs ours then
    does so with it.
    """

    low: Tensor
    high: Tensor
    may_be_nan = ("low", "high")

    def __init__(self, network: ForceNetworkSettings, inputs: InputSettings) -> None:
        """Build the model; convolutions start with Kaiming weights, norms constant (Methods)."""
        super().__init__()
        self.network, self.inputs = network, inputs
        make_encoder = field_encoder if inputs.form == "field" else image_encoder
        self.encoder = make_encoder(network, inputs.planes)
        self.memory = ConvGru(network.encoder[-1], network.memory)
        middle, last = network.tail
        block = partial(EncoderBlock, stride=2) if network.tail_block == "raft" else TailBlock
        self.tail = nn.Sequential(
            block(network.memory, middle, kind=network.tail_norm),
            block(middle, last, kind=network.tail_norm),
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
        """Shape (channels, h, w) of the hidden state of one sequence."""
        side = self.inputs.side // (2 if self.inputs.form == "field" else 8)
        return self.memory.hidden, side, side

    def initial_state(self, batch: int) -> Tensor:
        """Return the initial state (batch, channels, h, w)."""
        return next(self.parameters()).new_zeros(batch, *self.state_shape)

    def forward(
        self, frames: Tensor, state: Tensor | None = None, *, lengths: Sequence[int] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return forces (b, s, 3), 0 to 1, and the state after the last frame of each sequence.

        Of prepared frames (b, s, planes, h, w) and the state after those before (b, channels, h,
        w), by default the initial one. Frames beyond a sequence's length (b,), by default all, are
        not computed: their forces are 0, and they affect neither statistics of norms nor gradients.
        """
        batch, steps = frames.shape[:2]
        length = [steps] * batch if lengths is None else lengths
        order = sorted(range(batch), key=lambda row: -length[row])
        indices = [(row, time) for time in range(steps) for row in order if time < length[row]]
        rows, times = (
            torch.tensor(index, device=frames.device) for index in zip(*indices, strict=True)
        )
        features = self.encoder(frames[rows, times])
        hidden = self.initial_state(batch).to(features.dtype) if state is None else state
        hidden = hidden[order]
        outputs, begin = [], 0
        for time in range(max(length)):
            running = sum(time < each for each in length)
            now = self.memory(features[begin : begin + running], hidden[:running])
            hidden = torch.cat((now, hidden[running:])) if running < batch else now
            outputs.append(now)
            begin += running
        normalised = torch.sigmoid(self.head(self.tail(torch.cat(outputs))).float())
        forces = normalised.new_zeros(batch, steps, len(AXES)).index_put((rows, times), normalised)
        back = sorted(range(batch), key=order.__getitem__)
        return forces, hidden[back]

    def step(self, frame: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return force (b, 3), 0 to 1, and state after the next prepared frame (b, planes, h, w).

        In evaluation mode, repeated steps equal `forward` on the sequence.
        """
        features = self.encoder(frame)
        before = self.initial_state(len(frame)).to(features.dtype) if state is None else state
        if self.inputs.alone:
            before = before * 0.0
        after = self.memory(features, before)
        return torch.sigmoid(self.head(self.tail(after)).float()), after

    @property
    def device(self) -> torch.device:
        """Device of the model."""
        return self.low.device

    def predict(
        self, presses: Presses, *, progress: ReportItems = lambda done, total: None
    ) -> NDArray[np.float64]:
        """Return forces (N, 3) N of all frames; every press starts from the initial state.

        Raises:
            LearningError: The presses have another form than the model takes.
        """
        normalised = self.predict_normalised(presses, progress=progress)
        return self.denormalise(normalised).double().cpu().numpy()

    @torch.no_grad()
    def predict_normalised(
        self, presses: Presses, *, progress: ReportItems = lambda done, total: None
    ) -> Tensor:
        """Return forces as `predict` does, normalised to the box, on the model's device.

        Presses are processed in parallel frame by frame, so that memory holds one frame of each.
        """
        require_form(presses, self.inputs)
        if self.inputs.alone:
            presses = presses.each_frame_alone()
        training = self.training
        starts, lengths = presses.starts[:-1], presses.starts.diff()
        predicted = torch.zeros(presses.frames, 3, device=self.device)
        done = 0
        self.eval()
        at_once = _AT_ONCE[self.device.type]
        for group in lengths.argsort(descending=True, stable=True).split(at_once):
            state = self.initial_state(len(group))
            for time in range(int(lengths[group].max())):
                # Sorted by descending length, so finished presses are at the end.
                running = group[lengths[group] > time]
                rows = (starts[running] + time).to(presses.device)
                frames = prepared_rows(presses, rows, self.inputs).to(self.device)
                normalised, state = self.step(frames, state[: len(running)])
                predicted[rows.to(self.device)] = normalised
                done += len(running)
                progress(done, presses.frames)
        self.train(training)
        return predicted

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes that the model was trained on; its forces on others are NaN."""
        measured = self.low.isfinite().tolist()
        return tuple(name for name, is_measured in zip(AXES, measured, strict=True) if is_measured)

    def set_range(self, box: ForceRange) -> None:
        """Set the force range that 0 and 1 correspond to."""
        self.low.copy_(self.low.new_tensor(box.low))
        self.high.copy_(self.high.new_tensor(box.high))

    def denormalise(self, normalised: Tensor) -> Tensor:
        """Convert forces normalised to the box to forces (..., 3) N; NaN on unknown axes."""
        return self.low + normalised * (self.high - self.low)

    def normalised(self, forces: Tensor) -> Tensor:
        """Normalise forces (..., 3) N to the box."""
        return (forces - self.low) / (self.high - self.low)

    def start_at(self, mean: Tensor) -> None:
        """Let the untrained model predict a force (3,), normalised to the box."""
        near = mean.clamp(_NEAREST, 1.0 - _NEAREST)
        with torch.no_grad():
            self.head.bias.copy_(torch.logit(near))
            self.head.weight.normal_(std=1.0 / (10.0 * math.sqrt(self.head.in_features)))


# Conversion of stored frames to network inputs; also part of the exported graph.

# Side of stored images [px].
STORED_SIDE = 256
# Statistics of ImageNet's red, green and blue (the paper, Methods).
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def stored_shape(inputs: InputSettings) -> tuple[int, ...]:
    """Return the shape of a stored frame: (256, 256), (3, 32, 32) or shading (3, 128, 128)."""
    if inputs.form == "field":
        return (3, FIELD_SIDE, FIELD_SIDE)
    if inputs.form == "shading":
        return SHADING.shape
    return (STORED_SIDE, STORED_SIDE)


def prepare(frames: Tensor, references: Tensor | None, inputs: InputSettings) -> Tensor:
    """Convert stored frames to network inputs (n, planes, side, side), float.

    Frames are images (n, 256, 256) uint8, with references of that shape if the form needs them, or
    marker fields (n, 3, 32, 32) float: dx, dy [px of the 640 x 480 image] and the change of the
    logarithm of a marker's area.
    """
    require_stored(frames, inputs, "frames")
    if inputs.form == "field":
        scale = frames.new_tensor([inputs.field_scale_px, inputs.field_scale_px, 1.0])
        return frames / scale[:, None, None]
    if inputs.form == "shading":
        change = (frames.to(torch.float32) - SHADING_ZERO) / inputs.shading_scale
        factor = SHADING_SIDE // inputs.side_px
        return functional.avg_pool2d(change, factor) if factor > 1 else change
    image = _reduced(frames, inputs)
    if inputs.needs_reference:
        if references is None:
            raise LearningError(
                f"reference: missing; input {inputs.form} needs the image without contact"
            )
        require_stored(references, inputs, "reference")
        image = torch.cat((image, image - _reduced(references, inputs)), dim=1)
    if inputs.channels == 3:
        image = image.expand(-1, 3, -1, -1)
    if inputs.imagenet:
        image = (image - image.new_tensor(_MEAN)[:, None, None]) / image.new_tensor(_DEVIATION)[
            :, None, None
        ]
    return image


def require_form(presses: Presses, inputs: InputSettings) -> None:
    """Reject presses of another form than a model takes."""
    if presses.form != inputs.stored_form:
        raise LearningError(
            f"presses of {presses.sensor}: found {presses.form}; allowed: {inputs.stored_form}, as "
            f"the model's input is {inputs.form}"
        )


def prepared_rows(presses: Presses, rows: Tensor, inputs: InputSettings) -> Tensor:
    """Return some rows of presses, on their device, as network inputs (n, planes, side, side)."""
    references = presses.references[presses.reference[rows]] if inputs.needs_reference else None
    return prepare(presses.images[rows], references, inputs)


def require_stored(frames: Tensor, inputs: InputSettings, name: str) -> None:
    """Reject frames that are not in the stored form of an input."""
    expected = stored_shape(inputs)
    kind = torch.float32 if inputs.form == "field" else torch.uint8
    if tuple(frames.shape[1:]) != expected or frames.dtype != kind:
        actual = f"{tuple(frames.shape)} {str(frames.dtype).removeprefix('torch.')}"
        allowed = f"(n, {', '.join(map(str, expected))}) {str(kind).removeprefix('torch.')}"
        raise LearningError(f"{name}: found {actual}; allowed: {allowed}, for input {inputs.form}")


def _reduced(images: Tensor, inputs: InputSettings) -> Tensor:
    grey = images[:, None].to(torch.float32) * (inputs.marker_value / 255.0)
    factor = STORED_SIDE // inputs.side_px
    return functional.avg_pool2d(grey, factor) if factor > 1 else grey


def new_force_model(
    plugin: str | None, network: ForceNetworkSettings, inputs: InputSettings
) -> ForceModel:
    """Return an untrained model: ours, or that of another package, which has its own settings."""
    if plugin is None:
        return ForceModel(network, inputs)
    model: ForceModel = load_plugin(plugin, ForceModel)
    return model
