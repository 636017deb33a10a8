"""Level of a sensor's signal for the guard and for finding the surface, sample by sample.

The level has two parts. The change since the last zero, in standard deviations of its noise, shows
the first touch. The largest motion of a marker or deviation of a taxel grows with the press.
"""

import itertools
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Grey = npt.NDArray[np.uint8]

# Samples that are kept: a zero averages the older half and measures the noise of the newer half.
_KEPT = 16
# Least noise, as a fraction of the mean change without contact: a perfect sensor has none.
_LEAST_NOISE = 0.01
# Images are compared at a quarter of their size; motions are stated in pixels of the image.
_REDUCED = 4
# Images are compared with earlier ones by the means of squares of this side [px, reduced], which
# fresh noise changes little. Two that differ by more than this factor of the noise, which is that
# from one to the next at rest, or the median of the last ones, show a motion.
_SQUARE, _SHOWN, _LAST = 4, 1.3, 3
# The flow counts at the steepest fraction of the pixels, the edges of markers, for a plain area has
# none of its own.
# A small fraction of these may show more, since single pixels of a flow are often wrong.
_EDGES, _BEYOND = 0.15, 0.05
# The flow of the sample before is followed from this motion on [px of the image], as a pattern that
# moved by more than half a pitch looks like one that moved less; not where it explains the image
# worse than a flow without history by this factor.
_FOLLOWED_PX, _WORSE = 4.0, 1.3


class Level(NamedTuple):
    """Level of one sample."""

    change: float
    """Change since the zero, in standard deviations of its noise."""
    motion: float
    """Largest motion of a marker [px] or deviation of a taxel [counts]."""
    fresh: bool
    """True if the sample differs from the one before."""
    moved: bool
    """True if it differs by more than noise from the last one that did so."""


def picture(jpeg: bytes) -> Floats:
    """Return the grey values of a JPEG at a quarter of its size."""
    import cv2

    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_4)
    if image is None:
        raise ValueError("an image that cannot be decoded")
    return image.astype(np.float32)


def grey(image: npt.NDArray[Any]) -> Floats:
    """Return the grey values of an RGB image (h, w, 3) at a quarter of its size."""
    import cv2

    size = (image.shape[1] // _REDUCED, image.shape[0] // _REDUCED)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)


def reading(value: Any) -> Floats:
    """Return a stored sample as an array: JPEG bytes, an image (h, w, 3), or counts (n, 3)."""
    if isinstance(value, bytes):
        return picture(value)
    value = np.asarray(value)
    return grey(value) if value.ndim == 3 else value.astype(np.float32)


def whole_grey(value: Any) -> Grey:
    """Return the grey values (h, w) of JPEG bytes or an image (h, w, 3), at full size."""
    import cv2

    if isinstance(value, bytes):
        image = cv2.imdecode(np.frombuffer(value, np.uint8), cv2.IMREAD_GRAYSCALE)
    else:
        image = cv2.cvtColor(np.asarray(value), cv2.COLOR_RGB2GRAY)
    return np.asarray(image, np.uint8)


def shift(before: Grey, after: Grey) -> npt.NDArray[np.float64]:
    """Return the shift (2,) of the parts of an image that move most, to the right and up [px]."""
    import cv2

    finder: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    flow = finder.calc(before, after, None)
    down, across = np.gradient(before.astype(np.float32))
    steep = np.hypot(down, across)
    moved = flow[steep >= np.quantile(steep, 1 - _EDGES)]
    length = np.hypot(moved[:, 0], moved[:, 1])
    right, below = np.median(moved[length >= np.median(length)], axis=0)
    return np.array([right, -below])


class SignalLevel:
    """Computes the level of each sample of one stream, a camera or taxels."""

    def __init__(self, *, is_image: bool) -> None:
        self._is_image = is_image
        self._recent: deque[Floats] = deque(maxlen=_KEPT)
        self._rest: Floats | None = None
        self._floor, self._noise = 0.0, 1.0
        self._flow: Any = None
        self._edges: Any = None
        self._moved: Any = None
        self._shown: Floats | None = None
        self._coarse: Floats | None = None
        self._still = 0.0
        self._steps: deque[float] = deque(maxlen=_LAST)

    def add(self, sample: Mapping[str, Any]) -> Level:
        """Return the level of a sample; before the first zero, without change and motion."""
        return self.of(reading(sample["value"]))

    def of(self, found: Floats) -> Level:
        """Return the level of a reading."""
        fresh = not self._recent or not np.array_equal(found, self._recent[-1])
        if fresh:
            self._recent.append(found)
        moved = self._differs(found)
        if self._rest is None:
            return Level(0.0, 0.0, fresh, moved)
        change = (_difference(found, self._rest) - self._floor) / self._noise
        return Level(change, self._motion(found, self._rest), fresh, moved)

    def _differs(self, found: Floats) -> bool:
        """Return True if a reading differs by more than noise from the last one that did so."""
        coarse = self._reduced(found)
        if self._coarse is not None:
            self._steps.append(_rms(coarse - self._coarse))
        self._coarse = coarse
        noise = max(self._still, float(np.median(self._steps)) if self._steps else 0.0)
        if self._shown is not None and _rms(coarse - self._shown) <= _SHOWN * noise:
            return False
        self._shown = coarse
        return True

    def zero(self) -> None:
        """Take the last samples as those without contact."""
        kept = list(self._recent)
        if not kept:
            return
        half = max(len(kept) // 2, 1)
        self._rest = np.mean(kept[:half], axis=0, dtype=np.float32)
        changes = [_difference(each, self._rest) for each in kept[half:] or kept]
        self._floor = float(np.mean(changes))
        spread = float(np.std(changes, ddof=1)) if len(changes) > 2 else 0.0
        self._noise = max(spread, _LEAST_NOISE * self._floor, 1e-6)
        coarse = [self._reduced(each) for each in kept]
        steps = [_rms(after - before) for before, after in itertools.pairwise(coarse)]
        self._still = float(np.median(steps)) if steps else 0.0
        if self._is_image:
            down, across = np.gradient(self._rest)
            steep = np.hypot(down, across)
            self._edges = steep >= np.quantile(steep, 1 - _EDGES)
            self._moved = None

    def _reduced(self, found: Floats) -> Floats:
        """Return the means of the squares of an image, which fresh noise changes little; counts."""
        if not self._is_image:
            return found
        high, wide = (size // _SQUARE for size in found.shape)
        parts = found[: high * _SQUARE, : wide * _SQUARE].reshape(high, _SQUARE, wide, _SQUARE)
        return np.asarray(parts.mean(axis=(1, 3), dtype=np.float32))

    def _motion(self, found: Floats, rest: Floats) -> float:
        if not self._is_image:
            return float(np.abs(found - rest).max())
        import cv2

        if self._flow is None:
            self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        before = np.clip(rest, 0, 255).astype(np.uint8)
        after = np.clip(found, 0, 255).astype(np.uint8)
        flow = self._flow.calc(before, after, None)
        if self._moved is not None:
            followed = self._flow.calc(before, after, self._moved)
            if _residual(followed, before, after, self._edges) < _WORSE * _residual(
                flow, before, after, self._edges
            ):
                flow = followed
        moved = flow[self._edges]
        motion = _REDUCED * float(np.quantile(np.hypot(moved[:, 0], moved[:, 1]), 1 - _BEYOND))
        self._moved = flow if motion > _FOLLOWED_PX else None
        return motion


def _residual(flow: Floats, before: Grey, after: Grey, edges: npt.NDArray[np.bool_]) -> float:
    """Return the mean difference [grey levels] at the edges of an image moved back by a flow."""
    import cv2

    row, column = np.indices(before.shape, np.float32)
    back = cv2.remap(
        after,
        column + flow[..., 0],
        row + flow[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return float(np.abs(back.astype(np.float32) - before)[edges].mean())


def _rms(difference: Floats) -> float:
    return float(np.sqrt(np.square(difference).mean()))


def _difference(found: Floats, rest: Floats) -> float:
    return float(np.abs(found - rest).mean())
