"""Variations between sensors of the same design, each off by default.

Random draws depend on the seed and on names only, so that a sensor has the same variations in any
order, process or subset of simulations.
"""

import zlib
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label

from sim.arrays import Array
from sim.errors import SceneError, check_range
from sim.scene import Motion
from sim.sensors.field import SurfaceField

# Random numbers that depend on a seed and on names only, never on earlier draws.


def generator(seed: int, *names: str | int) -> np.random.Generator:
    """Return a random generator for a seed and names.

    Equal seeds and names give equal numbers, in any process and any order; different ones give
    independent numbers (NumPy's `SeedSequence` with the names as its spawn key).
    """
    numbers = [name for name in (seed, *names) if not isinstance(name, str)]
    if any(number < 0 for number in numbers):
        raise SceneError(f"seed: {seed!r}, names {names!r}; allowed: numbers from 0")
    # The length of a name distinguishes a number from a name whose checksum equals it.
    key: list[int] = []
    for name in names:
        if isinstance(name, str):
            key += [1 + len(name), zlib.crc32(name.encode())]
        else:
            key += [0, name]
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(key)))


# Segmentation errors: jitter of edges, missed markers.

Masks = NDArray[np.bool_]
Greys = NDArray[np.uint8]
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

# Grey level of a pixel that a marker covers completely.
WHITE = 255
# Largest jitter [px]: edges move by at most 2.5 px either way.
JITTER_MAX = 1.0
# Grey profile of a straight edge smoothed by 1 4 6 4 1, linear in between: distance inside the
# edge [px], and fraction of white. It rounds a marker of radius r by 1 / (2 r).
PROFILE = (
    np.array([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]),
    np.array([0.0, 1.0, 5.0, 11.0, 15.0, 16.0]) / 16,
)
# Size of the noise field, of which every frame uses a window [px]: computing a new field for each
# frame would cost more than everything else.
BANK = (768, 1024)


@dataclass(frozen=True, slots=True)
class Segmentation:
    """Segmentation errors of markers.

    Raises:
        SceneError: A value is out of range.
    """

    jitter_px: float = 0.0
    """Standard deviation of an edge's position along its normal, 0 to 1."""
    correlation_px: float = 4.0
    """Correlation length of the jitter, as the standard deviation of a Gaussian, 0.5 to 50."""
    missing: float = 0.0
    """Fraction of markers missed, independently in each frame, 0 to 1."""
    rim_px: float = 0.0
    """Width of the dark rim of the image, 0 to 200."""
    rim_missing: float = 0.0
    """Fraction of markers missed among those that reach into the rim, 0 to 1."""

    def __post_init__(self) -> None:
        for name, low, high, unit in (
            ("jitter_px", 0.0, JITTER_MAX, "px"),
            ("correlation_px", 0.5, 50.0, "px"),
            ("missing", 0.0, 1.0, ""),
            ("rim_px", 0.0, 200.0, "px"),
            ("rim_missing", 0.0, 1.0, ""),
        ):
            check_range("segmentation", name, getattr(self, name), low, high, unit=unit)


class SegmentationErrors:
    """Segmentation errors of one sensor's images; those of frame k are reproducible.

    Seed and names, such as sensor and indenter, identify these images.
    """

    def __init__(self, segmentation: Segmentation, seed: int, *names: str | int) -> None:
        self._segmentation = segmentation
        self._seed, self._names = seed, names
        self._bank = np.zeros((0, 0), np.float32)
        if segmentation.jitter_px > 0:
            white = generator(seed, "segmentation", *names).normal(size=BANK)
            smooth = gaussian_filter(white, segmentation.correlation_px, mode="wrap")
            self._bank = (smooth / smooth.std()).astype(np.float32)

    def masks(self, coverage: Greys, first: int = 0) -> Masks:
        """Return masks (F, H, W) of the markers that are segmented in grey images (F, H, W).

        A pixel's grey is its coverage by markers, 255 if complete. With binary images (0 or 255),
        jitter below half a pixel is lost, as they have no subpixel edges. The errors are those from
        frame `first` on.

        Raises:
            SceneError: The images are not grey images.
        """
        if coverage.dtype != np.uint8 or coverage.ndim != 3:
            raise SceneError(
                f"coverage: {coverage.dtype} of shape {coverage.shape}; allowed: uint8 (frames, "
                "rows, columns)"
            )
        masks = np.empty(coverage.shape, bool)
        for index, image in enumerate(coverage):
            random = generator(self._seed, "segmentation", *self._names, first + index)
            masks[index] = self._without_missed(self._with_jitter(image, random), random)
        return masks

    def _with_jitter(self, image: Greys, random: np.random.Generator) -> Masks:
        """Return the mask with edges moved along their normals.

        At the distance d inside an edge, the smoothed image has the grey level `PROFILE` of d. A
        threshold at the level of n therefore moves the edge inwards by n.
        """
        jitter = self._segmentation.jitter_px
        if jitter == 0:
            return image >= WHITE / 2
        soft = softened(image)
        whole = 256 * WHITE
        mask = soft > whole // 2
        edges = np.flatnonzero((soft > 0) & (soft < whole))
        inward = jitter * self._noise(edges, image.shape[1], random)
        threshold = whole * np.interp(inward, *PROFILE)
        mask.flat[edges] = soft.flat[edges] > threshold
        return mask

    def _noise(self, pixels: Indices, width: int, random: np.random.Generator) -> Floats:
        """Return noise (n,) at pixels of an image, from a random, maybe mirrored, bank window."""
        top, left = random.integers(0, BANK)
        flips = 1 - 2 * random.integers(0, 2, 2)
        row = (top + flips[0] * (pixels // width)) % BANK[0]
        column = (left + flips[1] * (pixels % width)) % BANK[1]
        return np.asarray(self._bank[row, column])

    def _without_missed(self, mask: Masks, random: np.random.Generator) -> Masks:
        chosen = self._segmentation
        rim = round(chosen.rim_px)
        dim = chosen.rim_missing > 0 and rim > 0
        if chosen.missing == 0 and not dim:
            return mask
        markers, count = label(mask)
        lost = np.zeros(count + 1, bool)
        lost[1:] = random.random(count) < chosen.missing
        if dim:
            reaching = np.zeros(count + 1, bool)
            for strip in (markers[:rim], markers[-rim:], markers[:, :rim], markers[:, -rim:]):
                reaching[strip.ravel()] = True
            lost[1:] |= reaching[1:] & (random.random(count) < chosen.rim_missing)
        if not lost.any():
            return mask
        return np.asarray(mask & ~lost[markers])


def softened(image: Greys) -> NDArray[np.uint16]:
    """Return an image (H, W), smoothed by 1 4 6 4 1 along both axes, times 256; edges are repeated.

    The weights come closest to a Gaussian of 1 px with five taps; they are computed as four sums of
    neighbours along each axis.
    """
    soft = np.pad(image.astype(np.uint16), 2, mode="edge")
    for _ in range(4):
        soft = soft[1:] + soft[:-1]
    for _ in range(4):
        soft = soft[:, 1:] + soft[:, :-1]
    return soft


@dataclass(frozen=True, slots=True)
class Placement:
    """Actual pose of a sensor under the robot, relative to the pose that the robot assumes."""

    shift_x: float = 0.0
    """Position of the middle of its top along the robot's x [m]."""
    shift_y: float = 0.0
    """The same along y [m]."""
    turn: float = 0.0
    """Angle from the robot's x axis to the sensor's, anticlockwise [rad]."""
    height: float = 0.0
    """Height of its top above where the robot takes it to be [m]."""

    def motion(self, motion: Motion) -> Motion:
        """Return the robot's motion relative to the middle of the sensor, for simulating a scene.

        Axes stay the robot's, so that indenter and forces need no rotation; `field` applies it. The
        sides of the body are assumed to lie along the robot's axes even with a `turn`.
        """
        tip = tuple((x - self.shift_x, y - self.shift_y, z - self.height) for x, y, z in motion.tip)
        return replace(motion, tip=tip)

    def field(self, field: SurfaceField) -> SurfaceField:
        """Return the deformation of that scene in the sensor's frame, as its camera sees it."""
        return field.turned(self.turn)


@dataclass(frozen=True, slots=True)
class Mount:
    """Mounting error of a sensor, which displaces presses on it; drawn once per sensor.

    Raises:
        SceneError: A value is out of range.
    """

    shift: float = field(metadata={"unit": "mm"})
    """Largest shift along x and along y, drawn uniformly [m], 0 to 0.01."""
    turn: float = field(metadata={"unit": "deg"})
    """Largest rotation about its axis, drawn uniformly in both directions [rad], 0 to 0.2."""
    height: float = field(default=0.0, metadata={"unit": "um", "stored": "unless default"})
    """Largest error of the height of its top, drawn uniformly in both directions [m], 0 to 1e-3:
    presses are deeper by it."""

    def __post_init__(self) -> None:
        check_range("mount", "shift", self.shift, 0.0, 0.01, unit="m")
        check_range("mount", "turn", self.turn, 0.0, 0.2, unit="rad")
        check_range("mount", "height", self.height, 0.0, 1e-3, unit="m")

    def drawn(self, seed: int, sensor: str) -> Placement:
        """Return the placement of `sensor`."""
        x, y, turn, up = generator(seed, "mount", sensor).uniform(-1.0, 1.0, 4).tolist()
        return Placement(self.shift * x, self.shift * y, self.turn * turn, self.height * up)


@dataclass(frozen=True, slots=True)
class Framing:
    """Alignment error of a camera, which moves only the image; drawn once per sensor.

    Raises:
        SceneError: A value is out of range.
    """

    shift_px: float
    """Largest shift of the image along columns and along rows, drawn uniformly, 0 to 100."""
    turn: float = field(metadata={"unit": "deg"})
    """Largest rotation about its middle, drawn uniformly in both directions [rad], 0 to 0.2."""

    def __post_init__(self) -> None:
        check_range("framing", "shift_px", self.shift_px, 0.0, 100.0, unit="px")
        check_range("framing", "turn", self.turn, 0.0, 0.2, unit="rad")

    def drawn(self, seed: int, sensor: str) -> tuple[float, float, float]:
        """Return shift along columns and rows [px] and turn [rad] of the camera of `sensor`."""
        column, row, turn = generator(seed, "framing", sensor).uniform(-1.0, 1.0, 3).tolist()
        return self.shift_px * column, self.shift_px * row, self.turn * turn


@dataclass(frozen=True, slots=True)
class Drift:
    """Creep of the skin during a session, so that images without contact differ between points.

    Raises:
        SceneError: The step is out of range.
    """

    step: float = field(metadata={"unit": "um"})
    """Standard deviation along x and along y of the whole skin's creep between contact points [m],
    0 to 1e-3: a random walk that begins at 0."""

    def __post_init__(self) -> None:
        check_range("drift", "step", self.step, 0.0, 1e-3, unit="m")

    def drawn(self, points: int, seed: int, *session: str | int) -> Array:
        """Return the skin's offset (points, 2) [m] at each contact point of a session, in order.

        Seed and names, such as sensor and indenter, identify the session.
        """
        steps = generator(seed, "drift", *session).normal(0.0, self.step, (points, 2))
        steps[:1] = 0.0
        return np.cumsum(steps, axis=0)


@dataclass(frozen=True, slots=True)
class Grip:
    """Grasping error of a gripper, which tilts the indenter; drawn for each indenter.

    Raises:
        SceneError: The tilt is out of range.
    """

    tilt: float = field(metadata={"unit": "deg"})
    """Largest tilt of the indenter about x and about y, drawn uniformly [rad], 0 to 0.25."""

    def __post_init__(self) -> None:
        check_range("grip", "tilt", self.tilt, 0.0, 0.25, unit="rad")

    def drawn(self, seed: int, sensor: str, indenter: str) -> tuple[float, float]:
        """Return the tilt about x and about y [rad] of `indenter` while pressed into `sensor`."""
        x, y = generator(seed, "grip", sensor, indenter).uniform(-1.0, 1.0, 2).tolist()
        return self.tilt * x, self.tilt * y


@dataclass(frozen=True, slots=True)
class DeviceVariation:
    """Deviations of a device in use from its design; None is off."""

    mount: Mount | None = None
    """Mounting error of the sensor, which changes deformations."""
    grip: Grip | None = None
    """Tilt of the indenter, which changes deformations."""
    framing: Framing | None = None
    """Alignment error of the camera, which changes images of the same deformation."""
    drift: Drift | None = None
    """Creep of the skin, which changes references."""
    segmentation: Segmentation | None = None
    """Segmentation errors of markers."""
