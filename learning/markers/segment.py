"""Detection of markers in pictures, configured by presets.

A picture is cropped to its region and resized to 640 x 480. The detectors' results are combined and
cleaned by morphology, and patches of the wrong size are dropped.
"""

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from learning.config import READER, preset_names, preset_path, require
from learning.errors import LearningError
from recorder.archive import SHADING_SIDE, SHADING_ZERO
from recorder.markers import HEIGHT, WIDTH, DiscMap, find_blobs

Channel = Literal["grey", "brightest", "darkest"]
Step = Literal["open", "close", "dilate", "erode"]
Shape = Literal["ellipse", "square"]
CHANNELS: tuple[Channel, ...] = get_args(Channel)


@dataclass(frozen=True, slots=True)
class Region:
    """Region of the camera's picture that shows markers."""

    rows: tuple[int, int] | None = None
    """First row and last row + 1 [px of the camera]; None: all of them."""
    columns: tuple[int, int] | None = None
    """The same for columns. The region is resized to fit into 640 x 480."""
    polygon: tuple[tuple[int, int], ...] = ()
    """Corners as column and row [px of the 640 x 480]; nothing is detected outside. Empty: all."""

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
    """Darker (or brighter) than midway between the local extremes (Bernsen's threshold)."""

    KIND: ClassVar[str] = "contrast"

    window_px: int
    """Side of the square around a pixel; wider than a marker, narrower than two."""
    least: int
    """Minimum difference of the extremes for a marker [grey levels]."""
    bright: bool = False
    """True if markers are brighter than their surroundings."""
    channel: Channel = "grey"
    """Compared channel: luma, or the brightest or darkest of red, green, blue."""

    def __post_init__(self) -> None:
        require(self, "window_px", least=3, most=400)
        require(self, "least", least=1, most=255)


@dataclass(frozen=True, slots=True)
class Hat:
    """Darker (or brighter) than the surroundings, by half of each marker's own contrast.

    The surroundings are a closing (an opening): the picture without what is narrower than the
    element (black hat and top hat; Serra, Image Analysis and Mathematical Morphology, 1982). They
    keep the edges of shadows and of coloured light, so markers are found under a contact as well.
    """

    KIND: ClassVar[str] = "hat"

    size_px: int
    """Diameter of the element: wider than a marker, and than the gap between two parts of one."""
    least: float
    """Minimum contrast of a marker: difference from the surroundings over their brightness (for
    bright markers over their darkness), 0 to 1."""
    bright: bool = False
    """True if markers are brighter than their surroundings."""
    channel: Channel = "brightest"
    """Compared channel. The brightest hardly changes where coloured lamps shade a contact."""
    lattice: bool = False
    """True to look for the reference's markers again where a contact hides them."""

    def __post_init__(self) -> None:
        require(self, "size_px", least=3, most=200)
        require(self, "least", least=0.01, most=0.99)


@dataclass(frozen=True, slots=True)
class BlurDifference:
    """Darker than a blurred copy of the picture."""

    KIND: ClassVar[str] = "blur_difference"

    kernel_px: int
    """Side of the Gaussian kernel, odd."""
    sigma_px: float
    """Its standard deviation."""
    least: int
    """Minimum difference [grey levels]."""

    def __post_init__(self) -> None:
        require(self, "kernel_px", least=1, most=199)
        require(self, "sigma_px", least=0.1, most=100)
        require(self, "least", least=1, most=255)
        if self.kernel_px % 2 == 0:
            raise LearningError(f"blur_difference.kernel_px: found {self.kernel_px}; allowed: odd")


@dataclass(frozen=True, slots=True)
class Dark:
    """The brightest of red, green and blue is below a limit (HSV's value)."""

    KIND: ClassVar[str] = "dark"

    below: int
    """Limit, 1 to 255."""

    def __post_init__(self) -> None:
        require(self, "below", least=1, most=255)


@dataclass(frozen=True, slots=True)
class ColourBelow:
    """Red, green and blue are each below a separate limit."""

    KIND: ClassVar[str] = "colour_below"

    red: int
    """Limit, 1 to 256."""
    green: int
    """Limit, 1 to 256."""
    blue: int
    """Limit, 1 to 256."""

    def __post_init__(self) -> None:
        require(self, "red", "green", "blue", least=1, most=256)


# Presets select one by its `kind`.
Detector = Contrast | Hat | BlurDifference | Dark | ColourBelow


@dataclass(frozen=True, slots=True)
class Morphology:
    """One step of cleaning."""

    step: Step
    size_px: int
    """Side of the structuring element."""
    times: int = 1
    """Number of repeats: an `open` of 2 erodes twice, then dilates twice."""
    shape: Shape = "ellipse"

    def __post_init__(self) -> None:
        require(self, "size_px", least=1, most=99)
        require(self, "times", least=1, most=20)


@dataclass(frozen=True, slots=True)
class CameraPreset:
    """Settings of marker detection in the pictures of a camera."""

    KIND: ClassVar[str] = "camera"

    description: str
    """Purpose of the preset, and source of its numbers."""
    detectors: tuple[Detector, ...]
    """Detectors; a pixel belongs to a marker if any detects it."""
    mm_per_px: float | None = None
    """Size of a pixel of the 640 x 480 on the surface without contact [mm]; None: must be given."""
    sensors: tuple[str, ...] = ()
    """Names of the sensors in sessions that use it by default."""
    region: Region = field(default_factory=Region)
    equalise: bool = False
    """True to equalise the luma of YUV first."""
    invert: bool = False
    """True to invert the picture, after that."""
    smooth_px: int = 1
    """Side of a Gaussian that reduces noise, odd; 1: none."""
    morphology: tuple[Morphology, ...] = ()
    """Steps of cleaning, in order."""
    area_px: tuple[int, int] = (12, 640 * 480)
    """Minimum and maximum number of pixels of a marker; other patches are dropped."""
    box_px: int = 15
    """Half the side of the boxes that prompt EfficientSAM."""
    tolerance: int = 0
    """Number of missing or new markers, except at the image border, that flags no frame."""

    def __post_init__(self) -> None:
        if not self.detectors:
            raise LearningError("detectors: found none; allowed: one or more")
        require(self, "mm_per_px", least=1e-4, most=10)
        require(self, "smooth_px", least=1, most=99)
        if self.smooth_px % 2 == 0:
            raise LearningError(f"smooth_px: found {self.smooth_px}; allowed: odd")
        if not 1 <= self.area_px[0] < self.area_px[1]:
            raise LearningError(f"area_px: found {self.area_px}; allowed: 1 <= least < largest")
        require(self, "box_px", least=1, most=240)
        require(self, "tolerance", least=0, most=1000)


@dataclass(frozen=True, slots=True)
class TaxelPreset:
    """Settings of masks drawn from the counts of taxels: `recorder.markers.draw_discs`."""

    KIND: ClassVar[str] = "taxels"

    description: str
    mm_per_px: float | None = None
    """Size of a pixel on the surface without contact [mm]: 128 columns are a pitch."""
    sensors: tuple[str, ...] = ()
    """Names of the sensors in sessions that use it by default."""
    rows_from_top: bool = False
    """True if taxel 0 is at the upper left and y counts point down; else lower left and up."""
    discs: DiscMap = field(default_factory=DiscMap)
    """Map from counts to discs."""

    def __post_init__(self) -> None:
        require(self, "mm_per_px", least=1e-4, most=10)


@dataclass(frozen=True, slots=True)
class ShadingPreset:
    """Settings of a camera that sees a gel without markers: `shading_of`."""

    KIND: ClassVar[str] = "shading"

    description: str
    mm_per_px: float | None = None
    """Size of a pixel of the 640 x 480 on the surface without contact [mm]; None: must be given."""
    sensors: tuple[str, ...] = ()
    """Names of the sensors in sessions that use it by default."""
    region: Region = field(default_factory=Region)
    """Region of the picture in use; its polygon has no effect."""

    def __post_init__(self) -> None:
        require(self, "mm_per_px", least=1e-4, most=10)
        if self.region.polygon:
            raise LearningError("region.polygon: found one; allowed: rows and columns, for shading")


Preset = CameraPreset | TaxelPreset | ShadingPreset


# Segmentation of a picture by a preset, with OpenCV.

Mask = NDArray[np.bool_]
# Pixels, uint8; OpenCV's type hints do not state the type.
Picture = np.ndarray[Any, np.dtype[Any]]
Binary = Picture

_MORPHOLOGY = {
    "open": cv2.MORPH_OPEN,
    "close": cv2.MORPH_CLOSE,
    "dilate": cv2.MORPH_DILATE,
    "erode": cv2.MORPH_ERODE,
}
# Local extremes are computed at half the resolution, as they are smooth.
_COARSE = 2


def view_of(picture: Picture, region: Region) -> Picture:
    """Return a region of a picture (h, w, 3) as (480, 640, 3); its edge fills what it lacks.

    Pixels stay square: a region that is not 4:3 is letterboxed.
    """
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise LearningError(
            f"picture: found {picture.dtype} {picture.shape}; allowed: uint8 (h, w, 3), RGB"
        )
    ends = []
    for name, side in (("rows", picture.shape[0]), ("columns", picture.shape[1])):
        first, last = getattr(region, name) or (0, side)
        if last > side:
            raise LearningError(f"region.{name}: found {first} to {last}; the picture has {side}")
        ends.append(slice(first, last))
    view = picture[ends[0], ends[1]]
    if view.shape[:2] == (HEIGHT, WIDTH):
        return view
    rows, columns = shown_part(picture.shape, region)
    size = columns.stop - columns.start, rows.stop - rows.start
    view = cv2.resize(view, size, interpolation=cv2.INTER_LINEAR)
    edges = rows.start, HEIGHT - rows.stop, columns.start, WIDTH - columns.stop
    return cv2.copyMakeBorder(view, *edges, cv2.BORDER_REPLICATE) if any(edges) else view


def shown_part(shape: tuple[int, ...], region: Region) -> tuple[slice, slice]:
    """Return the rows and columns of the 640 x 480 that show a picture (h, w, ...)."""
    ends = region.rows or (0, shape[0]), region.columns or (0, shape[1])
    scale = min(HEIGHT / (ends[0][1] - ends[0][0]), WIDTH / (ends[1][1] - ends[1][0]))
    parts = []
    for (first, last), whole in zip(ends, (HEIGHT, WIDTH), strict=True):
        size = round((last - first) * scale)
        parts.append(slice((whole - size) // 2, (whole - size) // 2 + size))
    return parts[0], parts[1]


class Segmenter:
    """Makes masks from the pictures of one camera."""

    def __init__(self, preset: CameraPreset) -> None:
        self.preset = preset
        self._shape: tuple[int, ...] = (HEIGHT, WIDTH)
        self._inside = _inside(preset.region, self._shape)
        shapes = {"ellipse": cv2.MORPH_ELLIPSE, "square": cv2.MORPH_RECT}
        self._elements = [
            cv2.getStructuringElement(shapes[one.shape], (one.size_px, one.size_px))
            for one in preset.morphology
        ]

    def mask(self, picture: Picture) -> Mask:
        """Return the mask (480, 640) of a picture (h, w, 3), RGB.

        Raises:
            LearningError: The picture is invalid, or smaller than the preset's region.
        """
        return self.mask_of_view(self.view(picture))

    def view(self, picture: Picture) -> Picture:
        """Return the region of a picture as (480, 640, 3), the input of the detectors.

        Raises:
            LearningError: The picture is invalid, or smaller than the preset's region.
        """
        view = view_of(picture, self.preset.region)
        if self._shape != picture.shape:
            self._shape = picture.shape
            self._inside = _inside(self.preset.region, self._shape)
        return view

    def mask_of_view(self, view: Picture) -> Mask:
        """Return the mask (480, 640) of a result of `view`."""
        preset = self.preset
        if preset.equalise:
            luma, *chroma = cv2.split(cv2.cvtColor(view, cv2.COLOR_RGB2YUV))
            merged = cv2.merge([cv2.equalizeHist(luma), *chroma])
            view = cv2.cvtColor(merged, cv2.COLOR_YUV2RGB)
        if preset.invert:
            view = cv2.bitwise_not(view)
        if preset.smooth_px > 1:
            view = cv2.GaussianBlur(view, (preset.smooth_px, preset.smooth_px), 0)
        detected = _detected(view, preset.detectors[0])
        for detector in preset.detectors[1:]:
            detected = cv2.bitwise_or(detected, _detected(view, detector))
        detected = cv2.bitwise_and(detected, self._inside)
        for step, element in zip(preset.morphology, self._elements, strict=True):
            detected = cv2.morphologyEx(
                detected, _MORPHOLOGY[step.step], element, iterations=step.times
            )
        return _of_size(detected, preset.area_px)


def outlined(view: Picture, mask: Mask, colour: tuple[int, int, int], width_px: int) -> Picture:
    """Return a copy of a view (480, 640, 3) with the outlines of a mask (480, 640)."""
    drawn: Picture = view.copy()
    contours = cv2.findContours(mask.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, contours[0], -1, colour, width_px)
    return drawn


def grey(picture: Picture) -> Picture:
    """Return the luma (h, w) of a picture (h, w, 3), RGB (ITU-R BT.601)."""
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)


def _detected(view: Picture, detector: Detector) -> Binary:
    """Return the pixels that a detector finds (480, 640), 255 if found."""
    if isinstance(detector, Contrast):
        return _contrast(_channel(view, detector.channel), detector)
    if isinstance(detector, Hat):
        depth = hat_contrast(view, detector.size_px, detector.channel, bright=detector.bright)
        return half_of_own(depth, largest_nearby(depth, detector.size_px), detector.least)
    if isinstance(detector, BlurDifference):
        luma = grey(view)
        side = (detector.kernel_px, detector.kernel_px)
        blurred = cv2.GaussianBlur(luma, side, detector.sigma_px)
        return _below(cv2.subtract(blurred, luma), detector.least, at_least=True)
    if isinstance(detector, Dark):
        return _below(_channel(view, "brightest"), detector.below)
    limits = detector.red - 1, detector.green - 1, detector.blue - 1
    return cv2.inRange(view, (0, 0, 0), limits)


def _contrast(values: Picture, detector: Contrast) -> Binary:
    """Return the pixels beyond midway between the local extremes."""
    small = cv2.resize(values, (WIDTH // _COARSE, HEIGHT // _COARSE), interpolation=cv2.INTER_AREA)
    side = 2 * (detector.window_px // (2 * _COARSE)) + 1
    element = cv2.getStructuringElement(cv2.MORPH_RECT, (side, side))
    low, high = cv2.erode(small, element), cv2.dilate(small, element)
    enough = _below(cv2.subtract(high, low), detector.least, at_least=True)
    middle = cv2.blur(cv2.addWeighted(low, 0.5, high, 0.5, 0), (side, side))
    middle = cv2.resize(middle, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    enough = cv2.resize(enough, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    beyond = cv2.compare(values, middle, cv2.CMP_GT if detector.bright else cv2.CMP_LT)
    return cv2.bitwise_and(beyond, enough)


def hat_contrast(
    view: Picture, size_px: int, channel: Channel, *, bright: bool
) -> NDArray[np.float32]:
    """Return the contrast (480, 640) of each pixel of a view with its surroundings, 0 to 1."""
    values = _channel(view, channel)
    if bright:
        values = cv2.bitwise_not(values)
    around = cv2.morphologyEx(values, cv2.MORPH_CLOSE, _disc(size_px))
    depth = cv2.subtract(around, values).astype(np.float32)
    return np.asarray(depth / np.maximum(around, 1), np.float32)


# Fraction of a marker's largest contrast at its outline. Noise makes the largest contrast larger
# than the typical one: painted markers of known outline have an overlap (IoU) of 0.979 with 0.5,
# 0.995 with 0.47 and 0.989 with 0.44.
OUTLINE = 0.47


def largest_nearby(contrast: NDArray[np.float32], size_px: int) -> NDArray[np.float32]:
    """Return the largest contrast (480, 640) within the element around each pixel."""
    return np.asarray(cv2.dilate(contrast, _disc(size_px)), np.float32)


def half_of_own(contrast: NDArray[np.float32], most: NDArray[np.float32], least: float) -> Binary:
    """Return the pixels (480, 640) above about half of `most`, the largest nearby, 255 if so.

    Where the largest contrast nearby is below `least`, nothing is found.
    """
    return ((contrast > OUTLINE * most) & (most >= least)).astype(np.uint8) * 255


def _disc(size_px: int) -> Picture:
    side = size_px | 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def _channel(view: Picture, channel: Channel) -> Picture:
    if channel == "grey":
        return grey(view)
    red, green, blue = cv2.split(view)
    pick = cv2.max if channel == "brightest" else cv2.min
    return pick(pick(red, green), blue)


def _below(values: Picture, limit: int, *, at_least: bool = False) -> Binary:
    kind = cv2.THRESH_BINARY if at_least else cv2.THRESH_BINARY_INV
    _, binary = cv2.threshold(values, limit - 1, 255, kind)
    return np.asarray(binary, np.uint8)


def _of_size(pixels: Binary, area_px: tuple[int, int]) -> Mask:
    """Return the patches (connected through sides) with areas within limits."""
    mask = np.asarray(pixels != 0)
    area = find_blobs(mask[None]).area
    if ((area >= area_px[0]) & (area <= area_px[1])).all():
        # The usual case, as labels of all pixels cost ten times the areas alone.
        return mask
    _, labels, stats, _ = cv2.connectedComponentsWithStats(pixels, connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
    fitting = (area >= area_px[0]) & (area <= area_px[1])
    fitting[0] = False
    return np.asarray(fitting[labels])


def _inside(region: Region, shape: tuple[int, ...]) -> Binary:
    """Return 255 where markers are looked for in a picture (h, w, ...): not in its filled edge."""
    inside = np.full((HEIGHT, WIDTH), 0 if region.polygon else 255, np.uint8)
    if region.polygon:
        cv2.fillPoly(inside, [np.array(region.polygon, np.int32)], 255)
    shown = np.zeros_like(inside)
    shown[shown_part(shape, region)] = 255
    return cv2.bitwise_and(inside, shown)


# Presets in YAML: those of this package, by name, and the user's files.

FOLDER = Path(__file__).parent / "presets"


@cache
def names() -> tuple[str, ...]:
    """Return the names of the presets of this package."""
    return preset_names(FOLDER)


def preset(name: str) -> Preset:
    """Return a preset by name, or from a file if the name ends in .yaml or .yml.

    Raises:
        LearningError: There is no such preset, or the file is invalid.
    """
    return read_preset(preset_path(FOLDER, name))


def preset_of_sensor(sensor: str) -> str | None:
    """Return the name of the default preset of a sensor, or None."""
    for name in names():
        if sensor in preset(name).sensors:
            return name
    return None


def read_preset(path: Path) -> Preset:
    """Read a preset from a YAML file.

    Raises:
        LearningError: The file is missing, is not YAML, or has an invalid key or value.
    """
    return built_preset(READER.read(path), str(path))


def built_preset(content: Any, where: str) -> Preset:
    """Return the preset of a file's content."""
    settings: Preset = READER.build_one_of(get_args(Preset), content, where)
    return settings


def kept_preset(name: str) -> str | dict[str, Any] | None:
    """Return a preset's name or content, as a model keeps it; None: its file is gone."""
    if name in names():
        return name
    path = Path(name)
    return dict(READER.read(path)) if path.is_file() else None


# Shading of a gel without markers: the change of its colours from those without contact.

Cells = NDArray[np.float32]


def cells_of(picture: NDArray[Any], preset: ShadingPreset) -> Cells:
    """Return the mean colours (3, 128, 128) of the cells of a picture (h, w, 3) uint8, RGB."""
    view = view_of(picture, preset.region).astype(np.float32)
    small = cv2.resize(view, (SHADING_SIDE, SHADING_SIDE), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(np.moveaxis(np.asarray(small, np.float32), 2, 0))


def shading_of(cells: Cells, no_contact: Cells) -> NDArray[np.uint8]:
    """Return frames (..., 3, 128, 128) uint8: the change of colours plus 128, cut to 0 to 255."""
    change = np.rint(cells - no_contact) + SHADING_ZERO
    return np.asarray(np.clip(change, 0, 255), np.uint8)


def change_of(shading: NDArray[np.uint8]) -> float:
    """Return the mean size of the change in a frame (3, 128, 128) [grey levels]."""
    return float(np.abs(shading.astype(np.int16) - SHADING_ZERO).mean())


def picture_of(shading: NDArray[np.uint8], times: float = 4.0) -> NDArray[np.uint8]:
    """Return a frame as a picture (128, 128, 3), RGB, whose changes are enlarged."""
    change = (np.moveaxis(shading, 0, 2).astype(np.float32) - SHADING_ZERO) * times
    return np.asarray(np.clip(change + SHADING_ZERO, 0, 255), np.uint8)
