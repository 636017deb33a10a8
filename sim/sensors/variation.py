"""What makes two sensors of one design differ in life. Each is off unless asked for.

Every draw depends on the seed and on names alone: the same sensor is mounted in the same way in
whatever order, process or subset it is simulated.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label

from sim.errors import SceneError, check_range
from sim.scene import Motion
from sim.sensors.field import SurfaceField

# Random numbers that depend on a seed and on names alone, never on what was drawn before.


def generator(seed: int, *names: str | int) -> np.random.Generator:
    """The random numbers of whatever `names` name, under this seed.

    Equal seeds and names give equal numbers, in any process and any order; others give numbers
    that have nothing to do with them (NumPy's `SeedSequence` with the names as its spawn key).

    Raises:
        SceneError: A seed or a number among the names that is below 0.
    """
    numbers = [name for name in (seed, *names) if not isinstance(name, str)]
    if any(number < 0 for number in numbers):
        raise SceneError(f"seed: {seed!r}, names {names!r}; allowed: numbers from 0")
    # A name's length keeps ("a", 1) apart from a text whose checksum happens to be 1.
    key: list[int] = []
    for name in names:
        if isinstance(name, str):
            key += [1 + len(name), zlib.crc32(name.encode())]
        else:
            key += [0, name]
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(key)))


# What segmentation does to markers: edges that waver, markers that it misses.

Masks = NDArray[np.bool_]
Greys = NDArray[np.uint8]
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

# Grey of a pixel that a marker covers wholly.
WHITE = 255
# Largest jitter [px]: edges are followed for 2.5 px either way, beyond that they stay.
JITTER_MAX = 1.0
# Grey across a straight edge that is softened by 1 4 6 4 1, linear in between: distance inside the
# edge [px], and share of white. It rounds a marker of radius r by 1 / (2 r).
PROFILE = (
    np.array([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]),
    np.array([0.0, 1.0, 5.0, 11.0, 15.0, 16.0]) / 16,
)
# Size of the field of noise that every frame takes a window of [px]: a new one each frame would
# cost more than all the rest.
BANK = (768, 1024)


@dataclass(frozen=True, slots=True)
class Segmentation:
    """How far segmented markers are from those drawn.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    jitter_px: float = 0.0
    """Standard deviation of an edge's place along its normal, 0 to 1."""
    correlation_px: float = 4.0
    """How far along an edge the jitter hangs together, as the spread of a Gaussian, 0.5 to 50."""
    missing: float = 0.0
    """Share of markers that a frame misses, each frame anew, 0 to 1."""
    rim_px: float = 0.0
    """Width of the dark rim of the image, 0 to 200."""
    rim_missing: float = 0.0
    """Share of markers that are missed of those which reach into the rim, 0 to 1."""

    def __post_init__(self) -> None:
        for name, low, high, unit in (
            ("jitter_px", 0.0, JITTER_MAX, "px"),
            ("correlation_px", 0.5, 50.0, "px"),
            ("missing", 0.0, 1.0, ""),
            ("rim_px", 0.0, 200.0, "px"),
            ("rim_missing", 0.0, 1.0, ""),
        ):
            check_range("segmentation", name, getattr(self, name), low, high, unit=unit)


class Segmenter:
    """Applies a `Segmentation` to images of one sensor; frame k has the same errors every time.

    Args:
        segmentation: How large the errors are.
        seed: Of all draws.
        names: What tells these images from others, such as sensor and indenter.
    """

    def __init__(self, segmentation: Segmentation, seed: int, *names: str | int) -> None:
        self._segmentation = segmentation
        self._seed, self._names = seed, names
        self._bank = np.zeros((0, 0), np.float32)
        if segmentation.jitter_px > 0:
            white = generator(seed, "segmentation", *names).normal(size=BANK)
            smooth = gaussian_filter(white, segmentation.correlation_px, mode="wrap")
            self._bank = (smooth / smooth.std()).astype(np.float32)

    def seen(self, coverage: Greys, first: int = 0) -> Masks:
        """Masks (F, H, W) of what is found in grey images of markers (F, H, W), 255 covered wholly.

        Args:
            coverage: How much of each pixel markers cover. From a mask (0 or 255) a jitter below
                half a pixel is lost: where the edge runs within the pixel is not in it.
            first: Number of the first frame; it picks the errors.

        Raises:
            SceneError: Not grey images.
        """
        if coverage.dtype != np.uint8 or coverage.ndim != 3:
            raise SceneError(
                f"coverage: {coverage.dtype} of shape {coverage.shape}; allowed: uint8 (frames, "
                "rows, columns)"
            )
        found = np.empty(coverage.shape, bool)
        for index, image in enumerate(coverage):
            random = generator(self._seed, "segmentation", *self._names, first + index)
            found[index] = self._kept(self._wavered(image, random), random)
        return found

    def _wavered(self, image: Greys, random: np.random.Generator) -> Masks:
        """The mask whose edges are moved along their normals.

        At the distance d inside an edge the softened image has the grey `PROFILE` of d, so the
        grey of n as the threshold finds the edge n further in.
        """
        jitter = self._segmentation.jitter_px
        if jitter == 0:
            return image >= WHITE / 2
        soft = softened(image)
        whole = 256 * WHITE
        found = soft > whole // 2
        edges = np.flatnonzero((soft > 0) & (soft < whole))
        inward = jitter * self._noise(edges, image.shape[1], random)
        threshold = whole * np.interp(inward, *PROFILE)
        found.flat[edges] = soft.flat[edges] > threshold
        return found

    def _noise(self, pixels: Indices, width: int, random: np.random.Generator) -> Floats:
        """Noise (n,) at pixels of an image, from a window anywhere in the bank, mirrored or not."""
        top, left = random.integers(0, BANK)
        flips = 1 - 2 * random.integers(0, 2, 2)
        row = (top + flips[0] * (pixels // width)) % BANK[0]
        column = (left + flips[1] * (pixels % width)) % BANK[1]
        noise: Floats = self._bank[row, column]
        return noise

    def _kept(self, mask: Masks, random: np.random.Generator) -> Masks:
        """The mask without the markers that are missed."""
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
        kept: Masks = mask & ~lost[markers]
        return kept


def softened(image: Greys) -> NDArray[np.uint16]:
    """An image (H, W) times 256, softened by 1 4 6 4 1 along rows and columns; borders go on.

    The weights are those of a Gaussian of 1 px as closely as five can be: four times the sum of
    neighbours, along each axis.
    """
    soft = np.pad(image.astype(np.uint16), 2, mode="edge")
    for _ in range(4):
        soft = soft[1:] + soft[:-1]
    for _ in range(4):
        soft = soft[:, 1:] + soft[:, :-1]
    return soft


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a sensor sits under the robot, against where the robot believes it to be."""

    shift_x: float = 0.0
    """The middle of its top along the robot's x [m]."""
    shift_y: float = 0.0
    """The same along y [m]."""
    turn: float = 0.0
    """How far its x lies from the robot's, anticlockwise [rad]."""

    def motion(self, motion: Motion) -> Motion:
        """The robot's motion, about the middle of the sensor: what a scene is simulated with.

        Axes stay the robot's, so that the indenter and the forces need no turn; `field` makes the
        turn. The sides of the body are taken to lie along the robot's axes, `turn` or not.
        """
        tip = tuple((x - self.shift_x, y - self.shift_y, z) for x, y, z in motion.tip)
        return replace(motion, tip=tip)

    def field(self, field: SurfaceField) -> SurfaceField:
        """The deformation of that scene in the sensor's own frame: what its camera sees."""
        return field.turned(self.turn)


@dataclass(frozen=True, slots=True)
class Mount:
    """A sensor screwed down askew: presses land elsewhere on it. Drawn once for each sensor.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    shift: float = field(metadata={"unit": "mm"})
    """Most that it is shifted along x, and along y; evenly drawn [m], 0 to 0.01."""
    turn: float = field(metadata={"unit": "deg"})
    """Most that it is turned about its axis either way; evenly drawn [rad], 0 to 0.2."""

    def __post_init__(self) -> None:
        check_range("mount", "shift", self.shift, 0.0, 0.01, unit="m")
        check_range("mount", "turn", self.turn, 0.0, 0.2, unit="rad")

    def drawn(self, seed: int, sensor: str) -> Placement:
        """Where `sensor` sits."""
        x, y, turn = generator(seed, "mount", sensor).uniform(-1.0, 1.0, 3).tolist()
        return Placement(self.shift * x, self.shift * y, self.turn * turn)


@dataclass(frozen=True, slots=True)
class Framing:
    """A camera that looks a little beside the gel: only the image moves. Drawn for each sensor.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    shift_px: float
    """Most that the image is shifted along columns, and along rows; evenly drawn, 0 to 100."""
    turn: float = field(metadata={"unit": "deg"})
    """Most that it is turned about its middle either way; evenly drawn [rad], 0 to 0.2."""

    def __post_init__(self) -> None:
        check_range("framing", "shift_px", self.shift_px, 0.0, 100.0, unit="px")
        check_range("framing", "turn", self.turn, 0.0, 0.2, unit="rad")

    def drawn(self, seed: int, sensor: str) -> tuple[float, float, float]:
        """Shift along columns and along rows [px], and turn [rad], of the camera of `sensor`."""
        column, row, turn = generator(seed, "framing", sensor).uniform(-1.0, 1.0, 3).tolist()
        return self.shift_px * column, self.shift_px * row, self.turn * turn


@dataclass(frozen=True, slots=True)
class Drift:
    """A skin that creeps as a session goes on, so that untouched images differ between points.

    Raises:
        SceneError: A step outside of what is allowed.
    """

    step: float = field(metadata={"unit": "um"})
    """Standard deviation along x, and along y, of how far the whole skin creeps from one contact
    point to the next [m], 0 to 1e-3: a random walk that begins at 0."""

    def __post_init__(self) -> None:
        check_range("drift", "step", self.step, 0.0, 1e-3, unit="m")

    def drawn(self, points: int, seed: int, *session: str | int) -> Array:
        """Offset (points, 2) [m] of the skin at each contact point of a session, in their order.

        Args:
            points: How many contact points there are.
            seed: Of all draws.
            session: What tells this session from others, such as sensor and indenter.
        """
        steps = generator(seed, "drift", *session).normal(0.0, self.step, (points, 2))
        steps[:1] = 0.0
        offsets: Array = np.cumsum(steps, axis=0)
        return offsets


@dataclass(frozen=True, slots=True)
class Grip:
    """A gripper that holds the indenter askew. Drawn for each indenter it takes.

    Raises:
        SceneError: A tilt outside of what is allowed.
    """

    tilt: float = field(metadata={"unit": "deg"})
    """Most that the indenter leans about x, and about y; evenly drawn [rad], 0 to 0.25."""

    def __post_init__(self) -> None:
        check_range("grip", "tilt", self.tilt, 0.0, 0.25, unit="rad")

    def drawn(self, seed: int, sensor: str, indenter: str) -> tuple[float, float]:
        """Lean about x and about y [rad] of `indenter` while it is pressed into `sensor`."""
        x, y = generator(seed, "grip", sensor, indenter).uniform(-1.0, 1.0, 2).tolist()
        return self.tilt * x, self.tilt * y


@dataclass(frozen=True, slots=True)
class Life:
    """What tells a sensor in use from its drawing. None is off."""

    mount: Mount | None = None
    """The sensor sits askew under the robot: other deformations."""
    grip: Grip | None = None
    """The indenter leans: other deformations."""
    framing: Framing | None = None
    """The camera looks beside the gel: other images of the same deformation."""
    drift: Drift | None = None
    """The skin creeps: other references."""
    segmentation: Segmentation | None = None
    """Markers are not found exactly."""
