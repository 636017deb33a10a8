"""Data and networks of each part, and the time of each of its trainings."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from benchmarks.paper.full_size import UNET, VAE
from benchmarks.paper.study import quick_row
from sim.dataset import DatasetPlan, Solving, gel
from sim.indenters import NAMES
from sim.sensors import sensor_of


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """Data and trainings of one part; a quick one has tier `layer`, two indenters, tiny nets."""

    sensors: tuple[str, ...]
    """Sensors, in every direction between two of them."""
    seconds: Mapping[str, float]
    """Training time of each kind of network [s]; 0: a few steps. With that of `m2m-patterns`, a
    stage on states of one gel under many patterns comes before that on the sensors."""
    held_out: tuple[str, ...] = ()
    """Sensors that no network is trained on; they are targets alone."""
    apart: bool = False
    """True for sensors whose presses have no solution in common: each has its own archive."""
    skins_differ: bool = True
    """True for labels that are compensated by force-depth curves when they are carried over."""
    held_out_patterns: tuple[str, ...] = ()
    """Patterns that no network is trained on."""
    fraction: float = 0.1
    """Fraction of the paper's targets."""
    quick: bool = False

    @property
    def sources(self) -> tuple[str, ...]:
        """Sensors whose force nets are trained, and whose frames are translated."""
        trained = tuple(name for name in self.sensors if name not in self.held_out)
        return trained[:1] if self.quick else trained

    @property
    def translators(self) -> tuple[str, ...]:
        """The paper's translator, and ours; a quick run trains one in each part."""
        if self.quick:
            return ("m2m",) if self.patterns else ("field",)
        return "m2m", "field"

    @property
    def patterns(self) -> bool:
        """True for a stage on patterns."""
        return "m2m-patterns" in self.seconds

    @property
    def plans(self) -> dict[str, DatasetPlan]:
        """Archives of the sensors, and of the patterns, by name."""
        groups = [(name,) for name in self.sensors] if self.apart else [self.sensors]
        rows = {name: sensor_of(name) for name in self.sensors}
        if self.quick:
            rows = {name: quick_row(row) for name, row in rows.items()}
        how: dict[str, Any] = {"indenters": ("sphere_s", "prism") if self.quick else NAMES}
        how["solving"] = Solving(tier="layer" if self.quick else "fem")
        plans = {
            "-".join(group): DatasetPlan(
                "targets",
                tuple(rows[name] for name in group),
                steps=2 if self.quick else 4,
                fraction=self.fraction,
                **how,
            )
            for group in groups
        }
        if self.patterns and not self.quick:
            plans[PATTERNS] = DatasetPlan("states", (gel(),), **how)
        return plans

    @property
    def widths(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Widths of the blocks of the autoencoder and of the translator's UNet."""
        return ((8,) * 4, (32, 32)) if self.quick else ((32, 64, 128, 128), (128, 256, 256))

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


# Name of the archive of patterns.
PATTERNS = "patterns"
SIZES = {
    # Three of the paper's homogeneous sensors: all pairs that its text names are among theirs. The
    # fourth has a pattern that no network sees.
    "patterns": Size(
        sensors=("array-i", "circle-ii", "diamond-i", "circle-i"),
        seconds={"vae": 53, "m2m-patterns": 132, "m2m": 79, "field": 53, "net": 53, "tuned": 13.2},
        held_out=("circle-i",),
        apart=True,
        skins_differ=False,
        held_out_patterns=("Circle1", "Diamond4"),
        fraction=0.05,
    ),
    # The paper's seven skins, 42 pairs.
    "skins": Size(
        sensors=("r6", "r8", "r10", "r12", "r14", "r16", "r18"),
        seconds={"vae": 27, "m2m": 108, "field": 36, "net": 27, "tuned": 10.8},
    ),
    "kinds": Size(
        sensors=("gelsight", "tacpalm", "uskin"),
        seconds={"vae": 45, "m2m": 180, "field": 60, "net": 45, "tuned": 18},
        apart=True,
    ),
}


def quick(part: str) -> Size:
    """Return a part's size for `--quick`: two sensors, one target, a few steps.

    In place of states of the gel, the sensors' own presses show patterns.
    """
    size = SIZES[part]
    return replace(
        size,
        sensors=(size.sensors[0], size.sensors[-1]),
        seconds=dict.fromkeys(size.seconds, 0),
        held_out=(),
        held_out_patterns=(),
        fraction=1e-6,
        quick=True,
    )
