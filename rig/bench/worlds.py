"""Settings of a mock bench's World: sensor, instruments, and effects that a clean mock lacks.

`Sources` are recordings that its emulators play in place of the World.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from rig.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of the instruments, added to their output, never to the World's truth."""

    force: float = field(default=0.0, metadata={"unit": "n"})
    """Standard deviation of each force axis [N]."""
    grey: float = 0.0
    """Standard deviation of the image [grey levels]."""
    counts: float = 0.0
    """Standard deviation of each taxel axis [counts]."""


@dataclass(frozen=True, slots=True)
class Solver:
    """Solver process of a World of tier `layer`.

    Raises:
        ValueError: The rate or the grid is out of range.
    """

    rate_hz: float = 60.0
    """Solutions per second that the solver aims for."""
    grid: int = 96
    """Pixels of the solver along the body's longer side."""
    behind: float = field(default=0.15, metadata={"unit": "ms"})
    """Longest time without a solution during contact [s]. Beyond it the World fails, so that a
    slow or busy machine is not mistaken for the gel's behaviour."""

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= 500:
            raise ValueError(f"rate_hz: {self.rate_hz!r}; allowed: above 0, up to 500")
        if not 16 <= self.grid <= 256:
            raise ValueError(f"grid: {self.grid!r}; allowed: 16 to 256")


@dataclass(frozen=True, slots=True)
class Grip:
    """Indenter held by a gripper's fingers: it gives way, and slides where it is pulled too hard.

    Raises:
        ValueError: A value is not above 0.
    """

    stiffness: float = field(default=60e3, metadata={"unit": "n_per_mm", "plausible": (1, 10000)})
    """Force per displacement of the held indenter, in any direction [N/m]."""
    slip: float = field(default=25.0, metadata={"unit": "n", "plausible": (0.1, 1000)})
    """Force at which it slides between the fingers [N]."""

    def __post_init__(self) -> None:
        for name in ("stiffness", "slip"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: above 0")


# Largest values of the settings of `Lab` that are amounts.
_LAB_MOST = {
    "pull_off_n": 0.3,
    "drift_n_per_h": 0.3,
    "cable_step_n": 0.2,
    "creep": 0.2,
    "led_warm_up": 0.3,
    "pose_jitter_mm": 0.1,
}


@dataclass(frozen=True, slots=True)
class Lab:
    """Effects that labs see and a clean mock does not, each off by default.

    Raises:
        ValueError: A value is out of range.
    """

    pull_off_n: float = 0.0
    """Largest pull of a sticky skin on the tip that retracts [N], up to 0.3."""
    drift_n_per_h: float = 0.0
    """Drift of each force of the gauge [N/h], up to 0.3."""
    cable_step_n: float = 0.0
    """Change of each force of the gauge when its cable moves, at each travel above the skin [N], up
    to 0.2."""
    creep: float = 0.0
    """Fraction of its force that a held press loses over a minute, up to 0.2."""
    auto_exposure: bool = False
    """True: the camera keeps the mean of its picture constant."""
    led_warm_up: float = 0.0
    """Fraction by which the lamps are brighter when they are cold, up to 0.3."""
    camera_turned_deg: Literal[0, 90, 180, 270] = 0
    """Rotation of the picture about its middle, anticlockwise [deg]."""
    pose_jitter_mm: float = 0.0
    """Standard deviation of the arm's reported position along each axis [mm], up to 0.1."""
    flipped_rotation: bool = False
    """True: every other rotation vector that the arm reports is the opposite one of the same
    rotation."""
    taxel_rate_hz: float | None = None
    """Rate of the server of taxels, 60 to 105; None: that of the bench file."""
    fz_only: bool = False
    """True: the gauge measures Fz alone; its other axes are 0."""

    def __post_init__(self) -> None:
        for name, most in _LAB_MOST.items():
            if not 0 <= getattr(self, name) <= most:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: 0 to {most:g}")
        if self.taxel_rate_hz is not None and not 60 <= self.taxel_rate_hz <= 105:
            raise ValueError(f"taxel_rate_hz: {self.taxel_rate_hz!r}; allowed: 60 to 105")


@dataclass(frozen=True, slots=True)
class WorldSpec:
    """World of a mock bench: a simulated sensor, pressed by the bench's `indenter`."""

    sensor: str
    """Name of a row of `sim.sensors`, or the path of a user's YAML file. Skin, friction,
    relaxation, markers or taxels, and the scale of the picture are those of the row."""
    tier: Literal["ladder", "layer"] = "ladder"
    """`ladder`: superposed presses (`sim.ladder`), light; `layer`: a process that solves each
    press along the arm's path, as with --world sim."""
    gauge_depth: float = field(default=0.02, metadata={"unit": "mm"})
    """Depth of the F/T sensor's origin below the undeformed surface [m]."""
    background: tuple[int, int, int] = (150, 138, 120)
    """Colour of the gel, RGB."""
    ink: tuple[int, int, int] = (28, 26, 30)
    """Colour of the markers, RGB."""
    light: Literal["coloured", "white"] = "coloured"
    """Coloured lamps at the sides, or one white light."""
    delay: float = field(default=0.0, metadata={"unit": "ms"})
    """Latency of the emulated camera [s]."""
    noise: Noise | None = None
    """None: instruments without noise."""
    grip: Grip | None = None
    """Grip of the bench's gripper on the indenter; None: it is bolted to the flange."""
    lab: Lab = Lab()
    """Effects of a lab."""
    solver: Solver = Solver()
    """Process that solves a World of tier `layer`."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Recordings to play; None: the World's data instead."""

    camera: Path | None = None
    """A folder of images or a video file."""
    camera_motion: str = "moving"
    """`moving`: one source frame per camera frame; `still`: each image held for seconds."""
    taxels: Path | None = None
    """A .npy file of raw counts (T, 48)."""

    def __post_init__(self) -> None:
        """Reject a missing path before anything is started."""
        for name, path in (("--camera", self.camera), ("--taxels", self.taxels)):
            if path is not None and not path.exists():
                raise ConfigError(f"{name}: {path}: no such file or folder")

    def description(self) -> dict[str, Any]:
        """Return the entries for the session's metadata: file names without local paths."""
        description: dict[str, Any] = {}
        if self.camera is not None:
            description["camera"] = {"name": self.camera.name, "motion": self.camera_motion}
        if self.taxels is not None:
            description["taxels"] = {"name": self.taxels.name}
        return description
