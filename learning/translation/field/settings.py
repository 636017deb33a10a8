"""Settings of a field model and its training: the keys of the presets."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from learning.errors import LearningError
from learning.training.run import LaunchSettings
from learning.translation.field.losses import LossWeights

# Presets shipped with the package.
PRESETS = Path(__file__).parent / "presets"
_MOST_SCALES = 6  # halving 64 cells six times leaves one


@dataclass(frozen=True, slots=True)
class NetSettings:
    """The field net: from frames to deformations."""

    widths: tuple[int, ...] = (32, 48, 96, 128, 160)
    """Channels at 128, 64, 32, 16, 8 cells."""
    refinements: int = 2
    """Number of passes that compare the frame with the reference as deformed so far."""

    def __post_init__(self) -> None:
        """Reject a network that cannot be built."""
        _require_widths(self.widths, 2)
        _require(self, "refinements", least=1)


@dataclass(frozen=True, slots=True)
class MapSettings:
    """The map: from one sensor's deformation to another's."""

    widths: tuple[int, ...] = (48, 96, 128, 128)
    """Channels at 64, 32, 16, 8 cells."""
    numbers: int = 32
    """Length of the vector that describes a sensor."""

    def __post_init__(self) -> None:
        """Reject a network that cannot be built."""
        _require_widths(self.widths, 1)
        _require(self, "numbers", least=1)


@dataclass(frozen=True, slots=True)
class ExampleSettings:
    """Training examples of the field net that are made in addition to the archive's frames."""

    procedural: float = 0.5
    """Share of examples that are random patterns."""
    random_shift: float = 0.3
    """Share of those that are deformed by random bumps instead of the archive's fields."""
    patterns: int = 512
    """Number of random patterns drawn for a run; 0: none."""
    amplitude: tuple[float, float] = (0.5, 1.5)
    """Range of the factor that scales the archive's fields for random patterns."""
    move: float = 0.1
    """Largest joint translation of frame and reference, as a share of half the image."""
    edge_px: float = 2.0
    """Largest error of segmented marker size in random patterns, too large or small [px]."""
    missing: float = 0.05
    """Largest share of a random pattern's markers missing in a frame."""

    def __post_init__(self) -> None:
        """Reject invalid shares, ranges and negative numbers."""
        for name in ("procedural", "random_shift", "missing"):
            if not 0 <= getattr(self, name) <= 1:
                raise LearningError(f"{name}: found {getattr(self, name)}; allowed: 0 to 1")
        _require(self, "patterns", "move", "edge_px", least=0)
        if not 0 < self.amplitude[0] <= self.amplitude[1]:
            raise LearningError(
                f"amplitude: found {list(self.amplitude)}; allowed: the smaller first, above 0"
            )


@dataclass(frozen=True, slots=True)
class StageSettings:
    """One stage of training: the field net, then the map."""

    steps: int
    """Number of steps; 0: the stage is skipped."""
    batch: int = 128
    """Examples per step on each GPU."""
    learning_rate: float = 3e-4
    """Peak rate, reached after `warm_up_steps`; it then decays as a cosine."""
    warm_up_steps: int = 500

    def __post_init__(self) -> None:
        """Reject invalid stages."""
        _require(self, "steps", "warm_up_steps", least=0)
        _require(self, "batch", least=1)
        if not self.learning_rate > 0:
            raise LearningError(f"learning_rate: found {self.learning_rate}; allowed: above 0")


@dataclass(frozen=True, slots=True)
class FieldSettings:
    """A field model and its training."""

    description: str
    field_stage: StageSettings
    """Stage of the field net, on frames of all sensors and on random patterns."""
    map_stage: StageSettings
    """Stage of the map, on location pairs."""
    net: NetSettings = field(default_factory=NetSettings)
    map: MapSettings = field(default_factory=MapSettings)
    examples: ExampleSettings = field(default_factory=ExampleSettings)
    loss: LossWeights = field(default_factory=LossWeights)
    every_frame: int = 4
    """The field net is trained on every n-th frame of a press, and on all paired frames."""
    weight_decay: float = 1e-2
    """Weight decay of AdamW."""
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
        """Reject a training without steps, and invalid values."""
        if not self.field_stage.steps and not self.map_stage.steps:
            raise LearningError("field_stage.steps, map_stage.steps: found 0 and 0; allowed: one")
        if self.launch.mixed_precision == "fp16":
            raise LearningError("launch.mixed_precision: found fp16; allowed: no, bf16")
        _require(self, "every_frame", "validate_every_steps", "validated", least=1)
        if not self.clip > 0:
            raise LearningError(f"clip: found {self.clip}; allowed: above 0")


def _require_widths(widths: tuple[int, ...], before: int) -> None:
    """Reject widths that are not multiples of 8, too few for the field's side, or too many."""
    allowed = before + _MOST_SCALES
    if not before <= len(widths) <= allowed or any(w < 8 or w % 8 for w in widths):
        raise LearningError(
            f"widths: found {list(widths)}; allowed: {before} to {allowed} multiples of 8"
        )


def _require(settings: object, *names: str, least: int) -> None:
    for name in names:
        if getattr(settings, name) < least:
            raise LearningError(
                f"{name}: found {getattr(settings, name)}; allowed: {least} or more"
            )
