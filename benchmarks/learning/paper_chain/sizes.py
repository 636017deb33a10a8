"""Sizes of the chain: data, networks, and the part of the time that each training gets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sim.result import ContactTier

# The paper's force net, a small one, and the net that reads marker displacement.
NETS = ("paper", "displacement", "tiny")
# Method of nets that see each frame without earlier ones.
ALONE = "own labels of frames alone"
# The paper's SGD of 0.1 does not leave its start in seconds (R2 -20 after 8 s of a GPU): its net is
# trained as the others are, from the mean label on.
RECIPES: dict[str, tuple[str, ...]] = {
    "paper": (
        "optimiser={name: adamw, weight_decay: 0.01, clip: 1.0}",
        "stages=[{epochs: 40, learning_rate: 0.0003, schedule: cosine, warm_up_steps: 200}]",
        "sequences={batch: 16, lengths: random, padding: masked}",
        "launch.mixed_precision=bf16",
        "start_at_mean=true",
        "range_margin=0.05",
    ),
}
# Seed of all trainings; there is one run of each.
SEED = 0


@dataclass(frozen=True, slots=True)
class Size:
    """Data and networks of one size, and training times as parts of `minutes`."""

    sensors: tuple[str, ...]
    """Sensors, in every direction between two of them."""
    tier: ContactTier
    """Tier of frames and true forces."""
    archive: tuple[str, ...]
    """Options of `sim archive`."""
    patterns: tuple[str, ...] | None
    """Contents and options of an archive of states; None: there is no stage on patterns."""
    vae: Mapping[str, Any]
    """Configuration of diffusers' AutoencoderKL."""
    unet: Mapping[str, Any]
    """Configuration of diffusers' UNet2DConditionModel."""
    batch: int
    """Images, or pairs, in a step of the autoencoder and the translator."""
    field_preset: tuple[str, ...]
    """Preset and overrides of the field translator."""
    net: str
    """Force net that is trained on translated frames."""
    nets: tuple[str, ...]
    """Force nets that are compared on each sensor's own labels."""
    minutes: float
    """Training time of the translator, unless `--minutes` says another."""
    scored: int
    """Most frames of a pair of sensors, or of patterns, whose images are scored."""
    precision: str
    """Precision of the autoencoder and the translator."""
    sources: tuple[str, ...] = ()
    """Sensors whose force nets are trained and whose frames are translated; empty: all that are
    not held out."""
    held_out: tuple[str, ...] = ()
    """Sensors that no network is trained on; they are targets alone."""
    held_out_patterns: tuple[str, ...] = ()
    """Patterns that no network is trained on."""
    apart: bool = False
    """True for sensors whose presses have no solution in common: each has its own archive."""
    compensated: bool = False
    """True for skins that differ: labels that are carried over are compensated by force-depth
    curves."""
    memory: bool = False
    """True for a comparison of nets with and without earlier frames alone, without translators."""
    parts: Mapping[str, float] = field(
        default_factory=lambda: {
            "vae": 0.4,
            "m2m-patterns": 1.0,
            "m2m": 0.6,
            "field": 0.4,
            "net": 0.15,
            "tuned": 0.075,
        }
    )
    """Training time of each kind of job, over `minutes`."""

    @property
    def archives(self) -> dict[str, tuple[str, ...]]:
        """Sensors of each archive, by its name."""
        return {name: (name,) for name in self.sensors} if self.apart else {"sensors": self.sensors}

    @property
    def trained(self) -> tuple[str, ...]:
        """Sensors whose force nets are trained."""
        return self.sources or tuple(name for name in self.sensors if name not in self.held_out)


def _vae(widths: tuple[int, ...]) -> dict[str, Any]:
    return {
        "in_channels": 3,
        "out_channels": 3,
        "down_block_types": ["DownEncoderBlock2D"] * 4,
        "up_block_types": ["UpDecoderBlock2D"] * 4,
        "block_out_channels": list(widths),
        "layers_per_block": 1,
        "latent_channels": 4,
        "norm_num_groups": 8,
        "sample_size": 256,
        "scaling_factor": 1.0,
    }


def _unet(widths: tuple[int, ...]) -> dict[str, Any]:
    deep = len(widths) - 1
    return {
        "sample_size": 32,
        "in_channels": 4,
        "out_channels": 4,
        "down_block_types": ["CrossAttnDownBlock2D"] * deep + ["DownBlock2D"],
        "up_block_types": ["UpBlock2D"] + ["CrossAttnUpBlock2D"] * deep,
        "block_out_channels": list(widths),
        "layers_per_block": 1,
        "attention_head_dim": 32,
        # The pixels of a latent: the authors' code takes each of its channels as a token.
        "cross_attention_dim": 1024,
        "norm_num_groups": 8,
    }


# One skin, no stage on patterns; sizes of a GPU differ from it.
_GPU = Size(
    sensors=("array-i", "circle-ii"),
    tier="fem",
    archive=("--scale", "0.1", "--steps", "4"),
    patterns=None,
    vae=_vae((32, 64, 128, 128)),
    unet=_unet((128, 256, 256)),
    batch=32,
    field_preset=("ours", "field_stage.batch=96", "map_stage.batch=96"),
    net="paper",
    nets=NETS,
    minutes=2.5,
    scored=150,
    precision="bf16",
)
_SKINS = replace(
    _GPU,
    compensated=True,
    nets=("paper", "displacement"),
    parts={"vae": 0.3, "m2m": 1.2, "field": 0.4, "net": 0.3, "tuned": 0.12},
)

SIZES = {
    # Three of the paper's homogeneous sensors: all pairs that its text names are among theirs. The
    # fourth has a pattern that no network sees.
    "homogeneous": replace(
        _GPU,
        minutes=2.2,
        sensors=("array-i", "circle-ii", "diamond-i", "circle-i"),
        archive=("--scale", "0.05", "--steps", "4"),
        apart=True,
        held_out=("circle-i",),
        patterns=("states",),
        held_out_patterns=("Circle1", "Diamond4"),
        parts={**_GPU.parts, "net": 0.4, "tuned": 0.1},
    ),
    "heterogeneous": replace(_SKINS, sensors=("gelsight", "tacpalm", "uskin"), apart=True),
    # Three of the seven skins, and one that no network sees.
    "material": replace(_SKINS, sensors=("r6", "r10", "r18", "r14"), held_out=("r14",)),
    # The paper's seven skins, 42 cells.
    "skins": replace(_SKINS, minutes=1.5, sensors=("r6", "r8", "r10", "r12", "r14", "r16", "r18")),
    # Two skins of one sensor, of which one hardly relaxes and the other loses half of its force.
    "hysteresis": replace(
        _GPU,
        minutes=1.2,
        sensors=("gelsight", "viscous"),
        apart=True,
        nets=("paper", "tiny", "displacement"),
        memory=True,
        parts={"net": 0.6},
    ),
    # One pair, in 5 minutes of two GPUs.
    "brief": replace(
        _GPU,
        minutes=1.0,
        tier="layer",
        archive=("--scale", "0.0625", "--steps", "4"),
        scored=80,
        sources=("array-i",),
        parts={"vae": 0.65, "m2m": 1.8, "field": 0.5, "net": 0.75, "tuned": 1.0},
    ),
    "toy": Size(
        sensors=("array-i", "circle-ii"),
        tier="layer",
        archive=(
            "--scale",
            "smoke",
            "--steps",
            "2",
            "--indenters",
            "prism,dots,moon,sphere_s,wave",
        ),
        patterns=("states:Array1,Circle2,Diamond1,Circle1", "--indenters", "prism,sphere_s"),
        vae=_vae((8, 16, 16, 16)),
        unet=_unet((32, 32)),
        batch=4,
        field_preset=("cpu_smoke",),
        net="tiny",
        nets=("tiny", "displacement"),
        minutes=1.0,
        scored=12,
        precision="no",
        held_out_patterns=("Circle1",),
    ),
}
# Sizes of all tables and figures of the paper.
ALL = ("homogeneous", "skins", "hysteresis", "heterogeneous", "material")


def write_base(folder: Path, size: Size) -> None:
    """Write untrained networks in the layout of the published ones, the same each time."""
    import torch

    from learning.translation.diffusion.weights import vendor

    if (folder / "unet" / "config.json").exists():
        return
    diffusers = vendor("diffusers")
    with torch.random.fork_rng():
        torch.manual_seed(SEED)
        for name, kind, config in (
            ("vae", diffusers.AutoencoderKL, size.vae),
            ("unet", diffusers.UNet2DConditionModel, size.unet),
        ):
            kind.from_config(dict(config)).save_pretrained(folder / name)
