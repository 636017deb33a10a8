"""A preset of marker detection, fitted to pictures without contact of a sensor.

For dark and for bright markers, in each channel, the contrast with the surroundings is measured at
growing sizes of the element. Of these candidates the most regular one with the strongest contrast
is chosen: markers are alike and evenly spaced, shading and dust are not.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from learning.errors import LearningError
from learning.markers.pattern import (
    MARKERS_LEAST,
    SPREAD_MOST,
    Spread,
    in_pattern,
    pitch_of,
    spread_of,
    with_reference,
)
from learning.markers.segment import (
    CHANNELS,
    CameraPreset,
    Channel,
    Hat,
    Morphology,
    Picture,
    Region,
    Segmenter,
    half_of_own,
    hat_contrast,
    largest_nearby,
    outlined,
)
from learning.markers.track import Tracker
from recorder.markers import SMALLEST_PX, find_blobs

# Diameters of the element that are tried [px of the 640 x 480 view].
SIZES_PX = (9, 13, 19, 27, 39, 55, 79)
# Contrast below which nothing is a marker, and times the noise below which nothing is.
CONTRAST_LEAST, NOISES = 0.05, 5.0
# Least contrast of a marker over the median contrast of those found: half of the faintest ones.
FAINT = 0.5
# Score over the highest one, from which a smaller element is preferred to a larger one, and the
# channel whose light changes least under a contact to the others.
NEARLY, NEARLY_CHANNEL = 0.9, 0.5
# Size of the chosen element over the width of the large markers (95 % are smaller). With less, the
# surroundings of a marker are taken from its blurred outline, and masks become too small.
ROOM = 1.75
# Limits of the area, over the median.
AREA_FROM, AREA_TO = 0.35, 3.0
# Width kept around the pattern where other patches are left out [pitches]: under a contact the
# outermost markers move less than that.
MARGIN = 0.75
# Endings of pictures in a folder.
ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
# Difference from the reference that counts as contact [grey levels], and the blur before it [px].
TOUCHED, BLUR_PX = 18, 21


@dataclass(frozen=True, slots=True)
class Pattern:
    """Markers found in a picture without contact by one detector."""

    detector: Hat
    spread: Spread
    area_px: tuple[float, float, float]
    """5th percentile, median and 95th percentile of the markers' areas [px]."""
    pitch_px: float
    """Median distance to the nearest marker."""
    contrast: float
    """Median contrast of the markers, 0 to 1."""
    noise: float
    """Contrast that noise alone has."""

    @property
    def score(self) -> float:
        """Contrast over noise, less where markers are unlike or unevenly spaced."""
        uneven = 1.0 + 4.0 * (self.spread.area + self.spread.pitch)
        return self.contrast / (self.noise + 0.02) / uneven

    def __str__(self) -> str:
        kind = "bright" if self.detector.bright else "dark"
        width = 2 * (self.area_px[1] / np.pi) ** 0.5
        return (
            f"{self.spread.count} {kind} markers in the channel '{self.detector.channel}': "
            f"{width:.1f} px wide (areas spread {100 * self.spread.area:.0f} %), "
            f"{self.pitch_px:.1f} px apart (spread {100 * self.spread.pitch:.0f} %), contrast "
            f"{self.contrast:.2f}, noise {self.noise:.3f}"
        )


def fit_preset(
    pictures: Sequence[Picture], *, pitch_mm: float | None = None
) -> tuple[CameraPreset, Pattern]:
    """Return a preset for the sensor of pictures without contact (h, w, 3) RGB, and its markers.

    The median of the pictures is used. `pitch_mm`, the distance between neighbouring markers [mm],
    gives the scale of the preset.
    """
    if not pictures:
        raise LearningError("pictures: found none; allowed: one or more without contact")
    plain = Segmenter(CameraPreset(description="", detectors=(Hat(9, 0.5),)))
    view = np.median([plain.view(one) for one in pictures], axis=0).astype(np.uint8)
    view = np.asarray(cv2.GaussianBlur(view, (3, 3), 0), np.uint8)
    patterns = [
        one
        for bright in (False, True)
        for channel in CHANNELS
        if (one := _best(view, channel, bright)) is not None
    ]
    regular = [one for one in patterns if one.spread.is_regular]
    if not regular:
        nearest = max(patterns, key=lambda one: one.score, default=None)
        raise LearningError(
            "pictures: found no regular pattern of markers"
            + (f" (at best {nearest})" if nearest else "")
            + f"; allowed: {MARKERS_LEAST} markers or more, areas and distances spread by "
            f"{100 * SPREAD_MOST:.0f} % or less"
        )
    best = _steadiest(regular)
    middle = best.area_px[1]
    width = 2 * (middle / np.pi) ** 0.5
    preset = CameraPreset(
        description="",
        detectors=(replace(best.detector, lattice=True),),
        mm_per_px=None if pitch_mm is None else round(pitch_mm / best.pitch_px, 6),
        smooth_px=3,
        morphology=(Morphology("open", 3),) if width >= 8 else (),
        area_px=(max(SMALLEST_PX, int(AREA_FROM * middle)), int(AREA_TO * middle) + 1),
        box_px=int(np.clip(0.75 * width, 4, 240)),
    )
    blobs = find_blobs(Segmenter(preset).mask_of_view(view)[None], SMALLEST_PX)
    own = in_pattern(blobs.centre, best.pitch_px)
    if not own.all():
        hull = cv2.convexHull(blobs.centre[own].astype(np.float32))[:, 0]
        preset = replace(preset, region=Region(polygon=_widened(hull, MARGIN * best.pitch_px)))
        best = replace(best, spread=replace(best.spread, count=int(own.sum())))
    return replace(preset, description=f"fitted: {best}"), best


def _widened(corners: NDArray[Any], margin: float) -> tuple[tuple[int, int], ...]:
    """Return the corners (n, 2) [px] of a convex polygon grown by a margin [px]."""
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    around = margin * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    grown = cv2.convexHull((corners[:, None] + around).reshape(-1, 2).astype(np.float32))
    few = cv2.approxPolyDP(grown, 2.0, closed=True)[:, 0]
    return tuple((round(float(x)), round(float(y))) for x, y in few)


def _steadiest(patterns: Sequence[Pattern]) -> Pattern:
    """Return the pattern of highest score, in the channel that a contact shades least.

    Coloured lamps each leave a shadow: of red, green and blue the brightest changes least around
    dark markers, the darkest around bright ones.
    """
    best = max(patterns, key=lambda one: one.score)
    steady = "darkest" if best.detector.bright else "brightest"
    for one in patterns:
        alike = one.detector.bright == best.detector.bright and one.detector.channel == steady
        if alike and one.score >= NEARLY_CHANNEL * best.score:
            return one
    return best


def as_yaml(preset: CameraPreset) -> dict[str, Any]:
    """Return the content of the preset's YAML file; `read_preset` reads it."""
    content: dict[str, Any] = {"kind": preset.KIND, "description": preset.description}
    if preset.mm_per_px is not None:
        content["mm_per_px"] = preset.mm_per_px
    if preset.region.polygon:
        content["region"] = {"polygon": [list(corner) for corner in preset.region.polygon]}
    return {
        **content,
        "detectors": [{"kind": one.KIND, **asdict(one)} for one in preset.detectors],
        "smooth_px": preset.smooth_px,
        "morphology": [{"step": one.step, "size_px": one.size_px} for one in preset.morphology],
        "area_px": list(preset.area_px),
        "box_px": preset.box_px,
    }


def _best(view: Picture, channel: Channel, bright: bool) -> Pattern | None:
    """Return the smallest regular pattern of nearly the highest score; else the one of highest."""
    patterns = [
        one for size in SIZES_PX if (one := _pattern(view, size, channel, bright)) is not None
    ]
    regular = [one for one in patterns if one.spread.is_regular]
    if not regular:
        return max(patterns, key=lambda one: one.score, default=None)
    most = max(one.score for one in regular)
    first = next(one for one in regular if one.score >= NEARLY * most)
    roomy = int(np.clip(ROOM * 2 * (first.area_px[2] / np.pi) ** 0.5, SIZES_PX[0], 200))
    return _pattern(view, roomy, channel, bright) or first


def _pattern(view: Picture, size: int, channel: Channel, bright: bool) -> Pattern | None:
    """Return the markers that one size of the element finds; None if there are none."""
    contrast = hat_contrast(view, size, channel, bright=bright)
    noise = float(np.median(contrast))
    floor = max(CONTRAST_LEAST, NOISES * noise)
    most = largest_nearby(contrast, size)
    mask = half_of_own(contrast, most, floor) > 0
    labels = np.asarray(cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[1], np.int64)
    own = np.zeros(labels.max() + 1, np.float32)
    np.maximum.at(own, labels, contrast)
    area = np.bincount(labels.ravel())
    large = (area >= SMALLEST_PX) & (np.arange(len(area)) > 0)
    if large.sum() < 2:
        return None
    # Patches count by their area, so that many specks do not outweigh the markers.
    order = np.argsort(own[large])
    fraction = np.cumsum(area[large][order]) / area[large].sum()
    typical = float(own[large][order][np.searchsorted(fraction, 0.5)])
    least = round(max(floor, FAINT * typical), 4)
    mask = half_of_own(contrast, most, least) > 0
    blobs = find_blobs(mask[None], SMALLEST_PX)
    blobs = blobs.only(blobs.whole)
    if len(blobs) < 2:
        return None
    low, middle, high = np.percentile(blobs.area, [5, 50, 95])
    return Pattern(
        Hat(size, least, bright, channel),
        spread_of(blobs.area, blobs.centre),
        (float(low), float(middle), float(high)),
        float(np.median(pitch_of(blobs.centre))),
        typical,
        noise,
    )


@dataclass(frozen=True, slots=True)
class Recall:
    """Markers of the reference that were found again in a pressed picture."""

    under: int
    """Markers under the contact."""
    under_found: int
    elsewhere: int
    elsewhere_found: int

    def __str__(self) -> str:
        return (
            f"{self.under_found} of {self.under} found under the contact, "
            f"{self.elsewhere_found} of {self.elsewhere} elsewhere"
        )


def recalls(
    preset: CameraPreset, reference: Picture, pressed: Iterable[Picture]
) -> Iterator[Recall]:
    """Yield how many markers of a picture without contact are found again in each pressed one.

    A marker counts as under the contact where the light has changed.
    """
    segmenter = Segmenter(preset)
    before = segmenter.view(reference)
    finder = with_reference(segmenter, before)
    first = find_blobs(segmenter.mask_of_view(before)[None], SMALLEST_PX).centre
    column, row = np.round(first).astype(int).T
    soft = _soft(before)
    for picture in pressed:
        after = segmenter.view(picture)
        then = find_blobs(finder.mask_of_view(after)[None], SMALLEST_PX).centre
        recovered = ~Tracker(first).step(then).lost
        changed = (np.abs(_soft(after) - soft).max(axis=2) > TOUCHED).astype(np.uint8)
        under = (cv2.dilate(changed, np.ones((9, 9), np.uint8)) > 0)[row, column]
        yield Recall(
            int(under.sum()),
            int(recovered[under].sum()),
            int((~under).sum()),
            int(recovered[~under].sum()),
        )


def _soft(view: Picture) -> NDArray[np.int16]:
    return cv2.GaussianBlur(view, (BLUR_PX, BLUR_PX), 0).astype(np.int16)


def draw_outlines(
    preset: CameraPreset, no_contact: Sequence[Picture], pressed: Sequence[Picture], path: Path
) -> None:
    """Write the views of pictures with the outlines of their markers, two in a row, as a PNG."""
    segmenter = Segmenter(preset)
    finder = with_reference(segmenter, segmenter.view(no_contact[0]))
    drawn = []
    for masker, pictures in ((segmenter, no_contact), (finder, pressed)):
        for view in map(segmenter.view, pictures):
            drawn.append(outlined(view, masker.mask_of_view(view), (255, 255, 0), 1))
    drawn += [np.zeros_like(drawn[0])] * (len(drawn) % 2)
    rows = [np.hstack(drawn[first : first + 2]) for first in range(0, len(drawn), 2)]
    Image.fromarray(np.vstack(rows)).save(path)


def files_of(paths: Sequence[Path]) -> list[Path]:
    """Return the pictures, and those of folders in the order of their names."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(one for one in path.iterdir() if one.suffix.lower() in ENDINGS)
            if not inside:
                raise LearningError(f"{path}: found no pictures; allowed: {', '.join(ENDINGS)}")
            files += inside
        elif path.exists():
            files.append(path)
        else:
            raise LearningError(f"{path}: no such file")
    return files


def read_picture(path: Path) -> Picture:
    """Return a picture (h, w, 3) uint8, RGB."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise LearningError(f"{path}: not a picture; allowed: {', '.join(ENDINGS)}")
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
