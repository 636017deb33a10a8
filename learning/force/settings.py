"""What a force model is made of and how it is trained: the keys of the presets."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from learning.errors import LearningError
from learning.training.launch import LaunchSettings

PRESETS = Path(__file__).parent / "presets"
"""The presets that are shipped."""
FIELD_SIDE = 32
"""Marker fields are sampled at so many places along either axis."""
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
