"""Data and networks of each part, and the share of the time that each training gets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from benchmarks.paper.full_size import UNET, VAE
from sim.dataset import DatasetPlan, Solving, gel
from sim.indenters import NAMES
from sim.result import ContactTier
from sim.sensors import sensor_of


@dataclass(frozen=True, slots=True)
class Size:
    """Data and networks of one part, and training times as shares of `minutes`."""

    sensors: tuple[str, ...]
    """Sensors, in every direction between two of them."""
    held_out: tuple[str, ...] = ()
    """Sensors that no network is trained on; they are targets alone."""
    sources: tuple[str, ...] = ()
    """Sensors whose frames are translated; empty: all that are not held out."""
    apart: bool = False
    """True for sensors whose presses have no solution in common: each has its own archive."""
    skins_differ: bool = False
    """True for labels that are compensated by force-depth curves when they are carried over."""
    patterns: bool = False
    """True for a stage on states of one gel under patterns, before that on the sensors."""
    held_out_patterns: tuple[str, ...] = ()
    """Patterns that no network is trained on."""
    translators: tuple[str, ...] = ("m2m", "field")
    """The paper's translator, and ours."""
    net: str = "paper"
    """Force net that is trained on translated frames."""
    minutes: float = 2.5
    """Training time of the translator."""
    shares: Mapping[str, float] = field(
        default_factory=lambda: {"vae": 0.3, "m2m": 1.2, "field": 0.4, "net": 0.3, "tuned": 0.12}
    )
    """Training time of each kind of network, over `minutes`."""
    tier: ContactTier = "fem"
    """Tier of frames and true forces."""
    fraction: float = 0.1
    """Fraction of the paper's targets."""
    steps: int = 4
    """Frames of a phase of a press."""
    indenters: tuple[str, ...] = NAMES
    only_patterns: tuple[str, ...] | None = None
    """Patterns of the states; None: all twelve."""
    pattern_indenters: tuple[str, ...] = NAMES
    widths: tuple[tuple[int, ...], tuple[int, ...]] = ((32, 64, 128, 128), (128, 256, 256))
    """Widths of the blocks of the autoencoder and of the translator's UNet."""
    batch: int = 32
    """Images, or pairs, in a step of the autoencoder and the translator."""
    precision: str = "bf16"
    """Precision of the autoencoder and the translator."""
    field_preset: tuple[str, ...] = ("ours", "field_stage.batch=96", "map_stage.batch=96")
    """Preset and overrides of the field translator."""
    scored: int = 150
    """Most frames of a pair of patterns whose images are scored."""

    @property
    def trained(self) -> tuple[str, ...]:
        """Sensors whose force nets are trained."""
        return self.sources or tuple(name for name in self.sensors if name not in self.held_out)

    @property
    def plans(self) -> dict[str, DatasetPlan]:
        """Archives of the sensors, by name."""
        solving = Solving(tier=self.tier)
        groups = [(name,) for name in self.sensors] if self.apart else [self.sensors]
        return {
            "-".join(group): DatasetPlan(
                "targets",
                tuple(map(sensor_of, group)),
                indenters=self.indenters,
                solving=solving,
                steps=self.steps,
                fraction=self.fraction,
            )
            for group in groups
        }

    @property
    def states(self) -> DatasetPlan:
        """Archive of states of one gel under many patterns."""
        gels = (gel(self.only_patterns),)
        return DatasetPlan(
            "states", gels, indenters=self.pattern_indenters, solving=Solving(tier=self.tier)
        )

    @property
    def vae(self) -> dict[str, Any]:
        """Configuration of diffusers' AutoencoderKL."""
        return VAE | {
            "block_out_channels": [*self.widths[0]],
            "layers_per_block": 1,
            "norm_num_groups": 8,
            "sample_size": 256,
            "scaling_factor": 1.0,
        }

    @property
    def unet(self) -> dict[str, Any]:
        """Configuration of diffusers' UNet2DConditionModel."""
        deep = len(self.widths[1]) - 1
        return UNET | {
            "sample_size": 32,
            "down_block_types": ["CrossAttnDownBlock2D"] * deep + ["DownBlock2D"],
            "up_block_types": ["UpBlock2D"] + ["CrossAttnUpBlock2D"] * deep,
            "block_out_channels": [*self.widths[1]],
            "layers_per_block": 1,
            "attention_head_dim": 32,
            # The pixels of a latent: the authors' code takes each of its channels as a token.
            "cross_attention_dim": 1024,
            "use_linear_projection": False,
            "norm_num_groups": 8,
        }


SIZES = {
    # Three of the paper's homogeneous sensors: all pairs that its text names are among theirs. The
    # fourth has a pattern that no network sees.
    "patterns": Size(
        sensors=("array-i", "circle-ii", "diamond-i", "circle-i"),
        held_out=("circle-i",),
        apart=True,
        patterns=True,
        held_out_patterns=("Circle1", "Diamond4"),
        minutes=2.2,
        shares={"vae": 0.4, "m2m-patterns": 1, "m2m": 0.6, "field": 0.4, "net": 0.4, "tuned": 0.1},
        fraction=0.05,
    ),
    # The paper's seven skins, 42 pairs.
    "skins": Size(
        sensors=("r6", "r8", "r10", "r12", "r14", "r16", "r18"), skins_differ=True, minutes=1.5
    ),
    "kinds": Size(sensors=("gelsight", "tacpalm", "uskin"), apart=True, skins_differ=True),
}
# What makes a part end in seconds of two cores.
_TOY: dict[str, Any] = {
    "held_out": (),
    "net": "tiny",
    "tier": "layer",
    "fraction": 0.01,
    "steps": 2,
    "indenters": ("sphere_s", "prism"),
    "only_patterns": ("Array1", "Circle2", "Circle1"),
    "pattern_indenters": ("sphere_s", "prism"),
    "held_out_patterns": ("Circle1",),
    "widths": ((8, 8, 8, 8), (32, 32)),
    "batch": 2,
    "precision": "no",
    "field_preset": ("cpu_smoke",),
    "scored": 2,
    "minutes": 0.0,
}
_PAIRS = {"skins": ("r6", "r18"), "kinds": ("gelsight", "uskin")}


def toy(part: str) -> Size:
    """Return a part's size for `--quick`: two sensors by tier `layer`, tiny networks."""
    sensors = _PAIRS.get(part, ("array-i", "circle-ii"))
    # The paper's translator is trained in one part alone.
    some = SIZES[part].translators if part == "patterns" else ("field",)
    return replace(SIZES[part], sensors=sensors, sources=sensors[:1], translators=some, **_TOY)
