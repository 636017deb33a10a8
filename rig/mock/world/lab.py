"""Effects that labs see and a clean mock does not: one small piece for each setting of `Lab`."""

import math

import numpy as np

from rig.bench.worlds import Lab
from rig.core.clock import SECOND_NS

# Height above the skin at which it lets go of a tip that retracts [m].
_LETS_GO = 0.1e-3
# Time in which a held press loses most of its creep, in which lamps warm up, and in
# which a camera settles its exposure [s].
_CREEP, _WARM_UP, _SETTLING = 20.0, 300.0, 0.4
# Exposure with which a camera opens, over the settled one.
_OPENS = 0.6
# Height above the skin [m], and way aside there [m], at which the cable of a gauge moves.
_ABOVE, _ASIDE = 1e-3, 1e-3


class Skin:
    """Creep and stickiness of a skin."""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self._crept = np.zeros(6)
        self._touched = False

    def wrench(self, wrench: np.ndarray, tip: np.ndarray, seconds: float) -> np.ndarray:
        """Return the wrench (6,) [N, N m] about a tip (3,) [m] above the skin, with the effects.

        `seconds` have passed since the last call.
        """
        lab, height = self._lab, float(tip[2])
        if lab.creep:
            # A branch that follows the force slowly: dc/dt = (creep F - c) / time.
            decay = math.exp(-seconds / _CREEP)
            self._crept = decay * self._crept + (1 - decay) * lab.creep * wrench
            wrench = wrench - self._crept if wrench[2] < self._crept[2] else 0.0 * wrench
        self._touched = height < 0 or (self._touched and height < _LETS_GO)
        if lab.pull_off_n and self._touched and height >= 0:
            wrench = wrench + np.array([0, 0, lab.pull_off_n * (1 - height / _LETS_GO), 0, 0, 0])
        return wrench


class Gauge:
    """Drift, steps and missing axes of a gauge."""

    def __init__(self, lab: Lab, seed: int = 0) -> None:
        self._lab = lab
        self._rng = np.random.default_rng(seed)
        self._began_ns: int | None = None
        self._step = np.zeros(3)
        self._stands_at: np.ndarray | None = None

    def measured(self, state: np.void) -> np.ndarray:
        """Return the wrench (6,) [N, N m] that the gauge measures of a WORLD_STATE."""
        lab, wrench = self._lab, np.array(state["wrench"])
        if self._began_ns is None:
            self._began_ns = int(state["t_ns"])
        if lab.drift_n_per_h:
            hours = (int(state["t_ns"]) - self._began_ns) / (3600 * SECOND_NS)
            wrench[:3] += lab.drift_n_per_h * hours
        if lab.cable_step_n:
            wrench[:3] += self._cable(state)
        if lab.fz_only:
            wrench[[0, 1, 3, 4, 5]] = 0.0
        return wrench

    def _cable(self, state: np.void) -> np.ndarray:
        """Return the force of the cable (3,) [N], another one after each travel above the skin."""
        if state["depth"] < -_ABOVE:
            here = np.array(state["contact"])
            if self._stands_at is None:
                self._stands_at = here
            elif np.abs(here - self._stands_at).max() > _ASIDE:
                self._stands_at = here
                self._step = self._lab.cable_step_n * self._rng.choice([-1.0, 1.0], 3)
        return self._step


class Exposure:
    """Brightness of pictures: lamps that warm up, and a camera that adapts to them."""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self._began_ns = self._last_ns = 0
        # A camera opens with an exposure that is too short.
        self._gain = _OPENS if lab.auto_exposure else 1.0
        self._mean = 0.0

    def passed(self, image: np.ndarray, t_ns: int) -> np.ndarray:
        """Return a picture (rows, columns, 3) uint8 as the camera exposes it at `t_ns`."""
        lab = self._lab
        if not (lab.auto_exposure or lab.led_warm_up):
            return image
        if not self._began_ns and t_ns:
            self._began_ns = self._last_ns = t_ns
            self._mean = float(image.mean())
        warmed = math.exp(-(t_ns - self._began_ns) / SECOND_NS / _WARM_UP)
        light = 1 + lab.led_warm_up * warmed
        if lab.auto_exposure:
            settled = -math.expm1(-(t_ns - self._last_ns) / SECOND_NS / _SETTLING)
            mean = light * max(float(image.mean()), 1.0)
            self._gain += settled * (self._mean / mean - self._gain)
            self._last_ns = t_ns
        exposed = np.clip(image * np.float32(light * self._gain), 0, 255)
        return exposed.astype(np.uint8)
