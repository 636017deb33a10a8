"""How markers are found in the pictures of a kind of sensor: plain data, a row a sensor.

A picture is cut to its region and brought to 640 x 480; what the detectors find in it is put
together, cleaned by morphology, and patches of the wrong size are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from learning.errors import LearningError

Channel = Literal["grey", "brightest", "darkest"]
Step = Literal["open", "close", "dilate", "erode"]
Shape = Literal["ellipse", "square"]
CHANNELS: tuple[Channel, ...] = ("grey", "brightest", "darkest")
STEPS: tuple[Step, ...] = ("open", "close", "dilate", "erode")
SHAPES: tuple[Shape, ...] = ("ellipse", "square")


@dataclass(frozen=True, slots=True)
class Region:
    """The part of the camera's picture that shows markers."""

    rows: tuple[int, int] | None = None
    """First row and the one behind the last [px of the camera]; None: all of them."""
    columns: tuple[int, int] | None = None
    """The same for columns. What remains is resized to 640 x 480."""
    polygon: tuple[tuple[int, int], ...] = ()
    """Corners as column and row [px of the 640 x 480]; nothing is found outside. Empty: all."""

    def __post_init__(self) -> None:
        for name in ("rows", "columns"):
            ends = getattr(self, name)
            if ends is not None and not 0 <= ends[0] < ends[1]:
                raise LearningError(f"region.{name}: found {ends}; allowed: 0 <= first < last")
        if 0 < len(self.polygon) < 3:
            raise LearningError(
                f"region.polygon: found {len(self.polygon)} corners; allowed: none, 3 or more"
            )


@dataclass(frozen=True, slots=True)
class Contrast:
    """Darker (or brighter) than midway between the extremes around it (Bernsen's threshold)."""

    KIND: ClassVar[str] = "contrast"

    window_px: int
    """Side of the square around a pixel; wider than a marker, narrower than two."""
    least: int
    """Where extremes differ less there is no marker [grey levels]."""
    bright: bool = False
    """Whether markers are brighter than what is around them."""
    channel: Channel = "grey"
    """What is compared: luma, or the brightest or darkest of red, green, blue."""

    def __post_init__(self) -> None:
        _require(self, "window_px", self.window_px, 3, 400)
        _require(self, "least", self.least, 1, 255)
        _require_known(self, "channel", self.channel, CHANNELS)


@dataclass(frozen=True, slots=True)
class BlurDifference:
    """Darker than a blurred copy of the picture."""

    KIND: ClassVar[str] = "blur_difference"

    kernel_px: int
    """Side of the Gaussian kernel, odd."""
    sigma_px: float
    """Its standard deviation."""
    least: int
    """By so many grey levels at least."""

    def __post_init__(self) -> None:
        _require(self, "kernel_px", self.kernel_px, 1, 199)
        _require(self, "sigma_px", self.sigma_px, 0.1, 100)
        _require(self, "least", self.least, 1, 255)
        if self.kernel_px % 2 == 0:
            raise LearningError(f"blur_difference.kernel_px: found {self.kernel_px}; allowed: odd")


@dataclass(frozen=True, slots=True)
class Dark:
    """The brightest of red, green and blue is below a limit (HSV's value)."""

    KIND: ClassVar[str] = "dark"

    below: int
    """Limit, 1 to 255."""

    def __post_init__(self) -> None:
        _require(self, "below", self.below, 1, 255)


@dataclass(frozen=True, slots=True)
class ColourBelow:
    """Red, green and blue are each below a limit of their own."""

    KIND: ClassVar[str] = "colour_below"

    red: int
    """Limit, 1 to 256."""
    green: int
    """Limit, 1 to 256."""
    blue: int
    """Limit, 1 to 256."""

    def __post_init__(self) -> None:
        for name in ("red", "green", "blue"):
            _require(self, name, getattr(self, name), 1, 256)


Detector = Contrast | BlurDifference | Dark | ColourBelow
"""A preset's file names one by its `kind`."""


@dataclass(frozen=True, slots=True)
class Morphology:
    """One step of cleaning."""

    step: Step
    """What is done."""
    size_px: int
    """Side of the structuring element."""
    times: int = 1
    """How often: an `open` of 2 erodes twice, then dilates twice."""
    shape: Shape = "ellipse"
    """Of the element."""

    def __post_init__(self) -> None:
        _require(self, "size_px", self.size_px, 1, 99)
        _require(self, "times", self.times, 1, 20)
        _require_known(self, "step", self.step, STEPS)
        _require_known(self, "shape", self.shape, SHAPES)


@dataclass(frozen=True, slots=True)
class CameraPreset:
    """How masks are made from the pictures of a camera."""

    KIND: ClassVar[str] = "camera"

    description: str
    """What it is for, and where its numbers come from."""
    detectors: tuple[Detector, ...]
    """A pixel that one of them finds is a marker's."""
    mm_per_px: float | None = None
    """Size of a pixel of the 640 x 480 on the untouched surface [mm]; None: has to be said."""
    sensors: tuple[str, ...] = ()
    """Names of sensors in sessions that it is meant for."""
    region: Region = field(default_factory=Region)
    """The part of the picture that is looked at."""
    equalise: bool = False
    """Whether the luma of YUV is equalised first."""
    invert: bool = False
    """Whether the picture is turned into its negative, after that."""
    smooth_px: int = 1
    """Side of a Gaussian that takes off noise, odd; 1: none."""
    morphology: tuple[Morphology, ...] = ()
    """Steps of cleaning, in their order."""
    area_px: tuple[int, int] = (12, 640 * 480)
    """Least and largest number of pixels of a marker; other patches are dropped."""
    box_px: int = 15
    """Half the side of the boxes that EfficientSAM is asked for."""
    tolerance: int = 0
    """Markers that may be missing or new before a frame is flagged, beside what the border of the
    image explains."""

    def __post_init__(self) -> None:
        if not self.detectors:
            raise LearningError("detectors: found none; allowed: one or more")
        if self.mm_per_px is not None:
            _require(self, "mm_per_px", self.mm_per_px, 1e-4, 10)
        _require(self, "smooth_px", self.smooth_px, 1, 99)
        if self.smooth_px % 2 == 0:
            raise LearningError(f"smooth_px: found {self.smooth_px}; allowed: odd")
        if not 1 <= self.area_px[0] < self.area_px[1]:
            raise LearningError(f"area_px: found {self.area_px}; allowed: 1 <= least < largest")
        _require(self, "box_px", self.box_px, 1, 240)
        _require(self, "tolerance", self.tolerance, 0, 1000)


@dataclass(frozen=True, slots=True)
class TaxelPreset:
    """How masks are drawn from the counts of taxels: `recorder.markers.draw_discs`."""

    KIND: ClassVar[str] = "taxels"

    description: str
    """What it is for."""
    mm_per_px: float | None = None
    """Size of a pixel on the untouched surface [mm]: 128 columns are a pitch."""
    sensors: tuple[str, ...] = ()
    """Names of sensors in sessions that it is meant for."""
    rows_from_top: bool = False
    """Whether taxel 0 lies at the upper left and y counts point down; else lower left and up."""

    def __post_init__(self) -> None:
        if self.mm_per_px is not None:
            _require(self, "mm_per_px", self.mm_per_px, 1e-4, 10)


Preset = CameraPreset | TaxelPreset


def _require(owner: object, name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        where = getattr(owner, "KIND", type(owner).__name__.lower())
        raise LearningError(f"{where}.{name}: found {value}; allowed: {low} to {high}")


def _require_known(owner: object, name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        where = getattr(owner, "KIND", type(owner).__name__.lower())
        raise LearningError(f"{where}.{name}: found {value!r}; allowed: {', '.join(known)}")
