"""What a field model is made of and how it is trained: the keys of the presets."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from learning.errors import LearningError
from learning.training.run import LaunchSettings
from learning.translation.field.losses import LossWeights

# The presets that are shipped.
PRESETS = Path(__file__).parent / "presets"
_MOST_SCALES = 6  # 64 cells halved six times is one


@dataclass(frozen=True, slots=True)
class NetSettings:
    """From frames to deformations."""

    widths: tuple[int, ...] = (32, 48, 96, 128, 160)
    """Channels at 128, 64, 32, 16, 8 cells."""
    refinements: int = 2
    """How often it looks at the frame, and at the reference as deformed so far."""

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        _require_widths(self.widths, 2)
        _require(self, "refinements", least=1)


@dataclass(frozen=True, slots=True)
class MapSettings:
    """From one sensor's deformation to another's."""

    widths: tuple[int, ...] = (48, 96, 128, 128)
    """Channels at 64, 32, 16, 8 cells."""
    numbers: int = 32
    """That a sensor is described by."""

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        _require_widths(self.widths, 1)
        _require(self, "numbers", least=1)


@dataclass(frozen=True, slots=True)
class ExampleSettings:
    """What the field net learns from, beside the archive's frames as they are."""

    procedural: float = 0.5
    """Share of examples that are random patterns."""
    random_shift: float = 0.3
    """Share of those that move by random bumps rather than as the archive's fields do."""
    patterns: int = 512
    """Random patterns of a run; 0: none."""
    amplitude: tuple[float, float] = (0.5, 1.5)
    """Factor on the archive's fields under random patterns."""
    move: float = 0.1
    """Frame and reference are moved together by up to this share of half the image."""
    edge_px: float = 2.0
    """Markers of random patterns are segmented too large or too small by up to this [px]."""
    missing: float = 0.05
    """Up to this share of a random pattern's markers is missed in a frame."""

    def __post_init__(self) -> None:
        """Refuse shares that are none."""
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
    """0: the stage is left out."""
    batch: int = 128
    """Examples of a step on each GPU."""
    learning_rate: float = 3e-4
    """The highest; it rises over `warm_up_steps` and falls as a cosine."""
    warm_up_steps: int = 500

    def __post_init__(self) -> None:
        """Refuse what moves nothing."""
        _require(self, "steps", "warm_up_steps", least=0)
        _require(self, "batch", least=1)
        if not self.learning_rate > 0:
            raise LearningError(f"learning_rate: found {self.learning_rate}; allowed: above 0")


@dataclass(frozen=True, slots=True)
class FieldSettings:
    """A field model and its training."""

    description: str
    field_stage: StageSettings
    """Of the field net, on frames of all sensors and on random patterns."""
    map_stage: StageSettings
    """Of the map, on location pairs."""
    net: NetSettings = field(default_factory=NetSettings)
    map: MapSettings = field(default_factory=MapSettings)
    examples: ExampleSettings = field(default_factory=ExampleSettings)
    loss: LossWeights = field(default_factory=LossWeights)
    every_frame: int = 4
    """The field net learns from the frames of a press whose numbers this divides, and from those
    that are paired."""
    weight_decay: float = 1e-2
    """Of AdamW."""
    clip: float = 1.0
    """Largest norm of a gradient."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Distances, warps and losses are float32 in any case."""
    validate_every_steps: int = 500
    """From one validation and checkpoint to the next."""
    validated: int = 1024
    """Most frames, or pairs, of a validation."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse training of nothing."""
        if not self.field_stage.steps and not self.map_stage.steps:
            raise LearningError("field_stage.steps, map_stage.steps: found 0 and 0; allowed: one")
        if self.launch.mixed_precision == "fp16":
            raise LearningError("launch.mixed_precision: found fp16; allowed: no, bf16")
        _require(self, "every_frame", "validate_every_steps", "validated", least=1)
        if not self.clip > 0:
            raise LearningError(f"clip: found {self.clip}; allowed: above 0")


def _require_widths(widths: tuple[int, ...], before: int) -> None:
    """Refuse widths: multiples of 8, at least one for the fields' own side, not more than sides."""
    allowed = before + _MOST_SCALES
    if not before <= len(widths) <= allowed or any(w < 8 or w % 8 for w in widths):
        raise LearningError(
            f"widths: found {list(widths)}; allowed: {before} to {allowed} multiples of 8"
        )


def _require(settings: object, *names: str, least: int) -> None:
    for name in names:
        if getattr(settings, name) < least:
            raise LearningError(
                f"{name}: found {getattr(settings, name)}; allowed: {least} and more"
            )
