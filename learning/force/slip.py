"""Slip of a held object, from the displacement of a sensor's markers or the counts of its taxels.

While an object sticks, a change of its load moves the whole field one way, and a squeeze scales the
field that the grip made. A face that slides does neither: the field moves over the skin, so that
its values rise on one side and fall on the other, and cancel in the sum. So of each change over
some spans of time, two measures are taken: the part that is not a scaled field, and the
`coherence`: the length of the sum over the sum of lengths, 1 if all markers move one way. Limits
were chosen by simulated slips and grips, others than those of `benchmarks`.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.errors import LearningError

Floats = NDArray[np.float64]

# Spans over which a change is looked at [ns]; slow slips are seen over long ones.
SPANS_NS = (10_000_000, 30_000_000, 60_000_000, 120_000_000)
# Coherence of a change below which the face slides, and below which its rim slides.
GROSS, INCIPIENT = 0.55, 0.75
# Least part of a change that is not a scaled field, as squares along x and y; its least size over
# that of noise, and over that of the field.
PART, SIZE, RELATIVE = 0.6, 3.2, 0.004
# Size of a field over that of noise from which there is contact; change over the field below which
# a grip is complete.
CONTACT, STILL = 10.0, 0.01


@dataclass(frozen=True, slots=True)
class Slip:
    """Slip that was seen in a frame."""

    t_ns: int
    """Time of the frame [ns]."""
    gross: bool
    """True if the face slides; False if its rim begins to, while its middle sticks."""


class SlipWatch:
    """Watches the field of a sensor; `noise` is the standard deviation of its values, in its unit.

    Raises:
        LearningError: The noise is not above 0.
    """

    def __init__(self, noise: float) -> None:
        if not (np.isfinite(noise) and noise > 0):
            raise LearningError(f"noise: found {noise}; allowed: more than 0")
        self._noise, self._slid = float(noise), False
        self._fields: deque[tuple[int, Floats]] = deque()
        self._grip: Floats | None = None

    def update(self, t_ns: int, field: ArrayLike) -> Slip | None:
        """Return the slip that the next field shows, or None.

        The field is the displacement of markers (m, 2), or the counts of taxels along x, y and z
        (m, 3), less those without contact. Nothing is seen before a grip is complete: until the
        field stands still. Gross slip has to be seen in two consecutive fields; one whose time is
        not after that of the last is left out.

        Raises:
            LearningError: The field has another shape than before, or is not finite.
        """
        now, fields = np.array(field, np.float64), self._fields
        shape = fields[-1][1].shape if fields else now.shape
        flat = now.ndim != 2 or now.shape[1] not in (2, 3)
        if flat or now.shape != shape or not (now.size and np.isfinite(now).all()):
            allowed = "(m, 2) or (m, 3)" if flat else shape
            raise LearningError(f"field: found {now.shape}; allowed: finite {allowed}")
        if fields and t_ns <= fields[-1][0]:
            return None
        if _rms(now) < CONTACT * self._noise:
            self._grip, self._slid = None, False
            fields.clear()
        spans = (next((f for t, f in reversed(fields) if t <= t_ns - s), None) for s in SPANS_NS)
        before = [one for one in spans if one is not None]
        fields.append((t_ns, now))
        while fields[0][0] < t_ns - 2 * SPANS_NS[-1]:
            fields.popleft()
        if self._grip is None:
            still = STILL * _rms(now) + 2 * self._noise
            if len(before) == len(SPANS_NS) and _rms(now - before[-2]) < still:
                self._grip = now
            return None
        least = min((self._coherence(now, one, self._grip) for one in before), default=1.0)
        slid, self._slid = self._slid, least < GROSS
        return Slip(t_ns, slid and self._slid) if least < INCIPIENT else None

    def _coherence(self, now: Floats, before: Floats, grip: Floats) -> float:
        """Return the coherence of the change between two fields; 1 if it is no sure slip."""
        change = now - before
        scaled = np.stack([grip.ravel(), before.ravel()], axis=1)
        scaled /= np.linalg.norm(scaled, axis=0)
        square = scaled.T @ scaled + 1e-6 * np.eye(2)
        fit = scaled @ np.linalg.solve(square, scaled.T @ change.ravel())
        other, along = change - fit.reshape(change.shape), change[:, :2]
        if _rms(other) < max(SIZE * self._noise, RELATIVE * _rms(before)):
            return 1.0
        if np.square(other[:, :2]).sum() < PART * np.square(along).sum():
            return 1.0
        return float(np.hypot(*along.sum(axis=0)) / max(np.hypot(*along.T).sum(), 1e-30))


def _rms(field: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(field))))
