"""What an experiment is made of: the keys of its presets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from learning.errors import LearningError

# The presets that are shipped.
PRESETS = Path(__file__).parent / "presets"

TranslatorName = Literal["flow", "field", "direct"]
# Choices of compensation, as evaluations call them: label-free, and by the target's labels.
Compensated = Literal["compensated", "priors", "oracle"]


@dataclass(frozen=True, slots=True)
class ModelChoice:
    """A preset of a training, and what is changed in it."""

    preset: str
    """Name of a preset, or a YAML file."""
    set: tuple[str, ...] = ()
    """`key=value` over it."""


@dataclass(frozen=True, slots=True)
class ExperimentSettings:
    """Which models, on how much data."""

    description: str
    translators: tuple[TranslatorName, ...]
    """What makes one sensor's frames another's."""
    force: ModelChoice
    """The force model that is trained on the source's own frames."""
    fine_tuning: tuple[str, ...]
    """`key=value` over that, for training on translated frames, which goes on from its weights."""
    field: ModelChoice = ModelChoice("cpu_smoke")
    """The learned field, one model for all pairs."""
    autoencoder: ModelChoice = ModelChoice("cpu_smoke")
    """The marker autoencoder that the direct translator begins with."""
    direct: ModelChoice = ModelChoice("cpu_smoke")
    """The direct translator, one model for all pairs."""
    compensation: tuple[Compensated, ...] = ("compensated",)
    """Which labels are trained on, beside the source's own."""
    validation: float = 0.1
    """Share of the presses of seen indenters that tells how far training is."""
    new_press: float = 0.1
    """Share of the presses of seen indenters that is kept for the test."""
    train_presses: int | None = None
    """Presses that force models learn from, of each source; none: all."""
    test_presses: int | None = None
    """Presses of each role that forces are predicted of, of each target; none: all."""
    scored_presses: int = 30
    """Presses of each role that translations are scored on; 0: they are not."""
    together: int = 1
    """Models that learn from a source's translated frames side by side: each operation is done for
    all of them at once, which a GPU wants."""
    memory: bool = True
    """False: force models see every frame as if nothing had been before it. Shows what frames
    before are worth."""
    source_reference: bool = True
    """False: translators are not told how the source looks untouched, which `direct` alone can do
    without. Shows what that is worth."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse an experiment in which nothing is translated."""
        if not self.translators or len(set(self.translators)) != len(self.translators):
            raise LearningError(
                f"translators: found {self.translators}; allowed: flow, field, direct, each once"
            )
        if not self.source_reference and self.translators != ("direct",):
            raise LearningError(
                f"source_reference: found false, with translators {self.translators}; allowed: "
                "true, or direct alone"
            )
        for name in ("train_presses", "test_presses"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise LearningError(f"{name}: found {value}; allowed: 1 and more, or none")
        if self.together < 1:
            raise LearningError(f"together: found {self.together}; allowed: 1 and more")
        if self.scored_presses < 0:
            raise LearningError(f"scored_presses: found {self.scored_presses}; allowed: 0 and more")
