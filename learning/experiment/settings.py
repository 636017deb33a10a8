"""Settings of an experiment: the keys of its presets."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from learning.config import require
from learning.errors import LearningError
from learning.plugins import plugin_names

# Folder of the presets of this package.
PRESETS = Path(__file__).parent / "presets"

TRANSLATORS = ("flow", "field", "diffusion")
# Kinds of labels: label-free by formulae, by twins, or by the target's labels.
Compensated = Literal["compensated", "priors", "simulated", "oracle"]


@dataclass(frozen=True, slots=True)
class ModelChoice:
    """A preset of a training, with overrides."""

    preset: str
    """Name of a preset, or a YAML file."""
    set: tuple[str, ...] = ()
    """Overrides, `key=value`."""


@dataclass(frozen=True, slots=True)
class ExperimentSettings:
    """Models of an experiment, and amount of data."""

    description: str
    translators: tuple[str, ...]
    """Of ours, and of installed packages by their names (`learning.plugins`)."""
    force: ModelChoice
    """Force model trained on the source's own frames."""
    fine_tuning: tuple[str, ...]
    """Further overrides for fine-tuning that model on translated frames."""
    field: ModelChoice = ModelChoice("cpu_smoke")
    """Learned field translator, one model for all pairs."""
    diffusion: ModelChoice = ModelChoice("ours")
    """The paper's translator, one model for all pairs. Its published weights are named by
    overrides: `weights.base=DIR`."""
    compensation: tuple[Compensated, ...] = ("compensated",)
    """Kinds of labels to train on, in addition to the source's own."""
    validation: float = 0.1
    """Fraction of the presses of seen indenters for validation."""
    new_press: float = 0.1
    """Fraction of the presses of seen indenters for the test."""
    train_presses: int | None = None
    """Number of training presses of force models, per source; none: all."""
    scored_presses: int = 30
    """Number of presses of each role for scores of translations; 0: no scores."""
    models_per_batch: int = 1
    """Number of models fine-tuned in one batch on a source's translated frames.

    Batching keeps a GPU busy.
    """
    seed: int = 0
    """Seed of the split, of the choice of presses, and of each training whose `set` has none."""

    def __post_init__(self) -> None:
        offered, named = (*TRANSLATORS, *plugin_names()), set(self.translators)
        if not named or len(named) != len(self.translators) or not named <= set(offered):
            raise LearningError(
                f"translators: found {', '.join(self.translators)}; allowed: {', '.join(offered)}, "
                "each once"
            )
        require(self, "validation", "new_press", least=0, below=1)
        require(self, "train_presses", "models_per_batch", least=1)
        require(self, "scored_presses", least=0)
