"""Synchronised rows at given ticks, used by both `frames` and `Session.window`.

Each tick gets the latest sample of the signal (the camera, else the taxels). All other values are
aligned to the capture time of that sample, because a label must match its image, not the tick.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.session import align
from recorder.session.align import Aligned, Bools, Floats, Picked, Source, Sources, Times, Values

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Window:
    """`n` synchronised rows. All fields of a stream that the session does not have are None.

    Rows before the start of a run or after its end exist but are invalid.
    """

    t_ns: Times
    """Ticks (n,) [ns], one period apart, on the clock of `run`."""
    capture_ns: Times
    """Capture time of each row's signal (n,) [ns]; the tick itself if there is none."""
    image: NDArray[np.uint8] | None
    """Images (n, h, w, channels) RGB; zeros if there is none."""
    image_row: NDArray[np.int64] | None
    """Rows of streams/camera (n,); -1 if there is none."""
    image_age: Floats | None
    """Tick minus capture (n,) [s]; NaN if there is none."""
    image_valid: Bools | None
    """True if the image exists and is recent enough (n,)."""
    wrench: Floats | None
    """Force and torque at the capture (n, 6) [N, N m], as in streams/force."""
    wrench_age: Floats | None
    """Distance from capture to the nearest sample used (n,) [s]."""
    wrench_valid: Bools | None
    """True if all samples used are near enough (n,)."""
    pose: Floats | None
    """Tool pose at the capture (n, 6) [m, rad], base frame, rotation vector."""
    pose_age: Floats | None
    """Distance from capture to the nearest sample used (n,) [s]."""
    pose_valid: Bools | None
    """True if all samples used are near enough (n,)."""
    taxels: Floats | None
    """Taxel counts (n, 16, 3): at the capture of the image, or the signal itself."""
    taxels_age: Floats | None
    """Distance from capture to nearest sample used (n,) [s]; for the signal, age at the tick."""
    taxels_valid: Bools | None
    """True if all samples used are near enough (n,)."""
    signal_row: NDArray[np.int64]
    """Row of the camera, or else of the taxels (n,); -1 if there is none."""

    @property
    def valid(self) -> Bools:
        """True if all existing streams are valid (n,)."""
        flags = (self.image_valid, self.wrench_valid, self.pose_valid, self.taxels_valid)
        out = np.ones(len(self.t_ns), np.bool_)
        for flag in flags:
            if flag is not None:
                out &= flag
        return out

    @property
    def skew(self) -> Floats:
        """Largest distance of a value from the capture that it belongs to (n,) [s]; NaN if none."""
        ages = [self.wrench_age, self.pose_age]
        if self.image_row is not None:
            ages.append(self.taxels_age)
        known = [np.abs(age) for age in ages if age is not None]
        if not known:
            return np.full(len(self.t_ns), np.nan)
        worst: Floats = np.fmax.reduce(known)
        return worst


def ticks_before(t_ns: int, n: int, rate_hz: float) -> Times:
    """Return `n` ticks (n,) [ns], the last at `t_ns`, one period apart."""
    back = np.arange(n - 1, -1, -1)
    return t_ns - np.round(back * (1e9 / rate_hz)).astype(np.int64)


def align_window(
    ticks: Times,
    sources: Sources,
    *,
    image: str = "held",
    force: str = "mean_exposure",
    pose: str = "slerp",
    taxels: str = "linear",
) -> Window:
    """Return the synchronised rows at ascending `ticks` (n,) [ns], without the images' pixels.

    The methods are those of `Session.window`.

    Raises:
        SessionError: An unknown method.
    """
    pick = _chosen("image", image, _PICK)
    fetch_wrench = _chosen("force", force, _FORCE)
    fetch_pose = _chosen("pose", pose, _POSE)
    fetch_taxels = _chosen("taxels", taxels, _TAXELS)

    signal = sources.signal
    capture, rows = ticks, np.full(len(ticks), -1, np.int64)
    picked: Picked | None = None
    exposure = 0.0
    if signal is not None:
        picked = pick(signal.times, ticks, max_age=signal.max_age)
        some = picked.index >= 0
        capture, exposure = ticks.copy(), signal.exposure
        capture[some] = signal.times[picked.index[some]]
        rows[some] = signal.rows[picked.index[some]]

    def at_capture(source: Source | None, fetch: _Fetch) -> Aligned | None:
        return None if source is None else fetch(source, capture, exposure)

    wrench = at_capture(sources.force, fetch_wrench)
    poses = at_capture(sources.pose, fetch_pose)
    seen = picked if sources.camera is not None else None
    counts = at_capture(sources.taxels, fetch_taxels)
    if sources.taxels is not None and sources.camera is None and picked is not None:
        counts = _taken(sources.taxels, picked)  # the signal itself, with the age of its tick
    return Window(
        t_ns=ticks,
        capture_ns=capture,
        image=None,
        image_row=None if seen is None else rows,
        image_age=None if seen is None else seen.age,
        image_valid=None if seen is None else seen.valid,
        wrench=None if wrench is None else wrench.value,
        wrench_age=None if wrench is None else wrench.age,
        wrench_valid=None if wrench is None else wrench.valid,
        pose=None if poses is None else poses.value,
        pose_age=None if poses is None else poses.age,
        pose_valid=None if poses is None else poses.valid,
        taxels=None if counts is None else counts.value,
        taxels_age=None if counts is None else counts.age,
        taxels_valid=None if counts is None else counts.valid,
        signal_row=rows,
    )


_Fetch = Callable[[Source, Times, float], Aligned]


def _sample(pick: Callable[..., Picked]) -> _Fetch:
    """Return the method that takes unmodified samples."""

    def fetch(source: Source, moments: Times, exposure: float) -> Aligned:
        return _taken(source, pick(source.times, moments, max_age=source.max_age))

    return fetch


def _taken(source: Source, picked: Picked) -> Aligned:
    values = _values(source)
    value = np.full((len(picked.index), *values.shape[1:]), np.nan)
    some = picked.index >= 0
    value[some] = values[picked.index[some]]
    still = np.zeros(len(value), np.bool_)
    return Aligned(value, picked.age, np.where(some, 0.0, np.nan), picked.valid, still)


def _linear(source: Source, moments: Times, exposure: float) -> Aligned:
    return align.linear(source.times, _values(source), moments, max_age=source.max_age)


def _mean_exposure(source: Source, moments: Times, exposure: float) -> Aligned:
    start, stop = align.exposure_window(moments, exposure)
    return align.mean(source.times, _values(source), start, stop, max_age=source.max_age)


def _slerp(source: Source, moments: Times, exposure: float) -> Aligned:
    return align.pose(source.times, _values(source), moments, max_age=source.max_age)


def _values(source: Source) -> Values:
    if source.values is None:
        raise SessionError("images cannot be interpolated")
    return source.values


_PICK: Mapping[str, Callable[..., Picked]] = {"held": align.held, "nearest": align.nearest}
_SAMPLE: Mapping[str, _Fetch] = {name: _sample(pick) for name, pick in _PICK.items()}
_FORCE: Mapping[str, _Fetch] = {"mean_exposure": _mean_exposure, "linear": _linear, **_SAMPLE}
_POSE: Mapping[str, _Fetch] = {"slerp": _slerp, **_SAMPLE}
_TAXELS: Mapping[str, _Fetch] = {"linear": _linear, **_SAMPLE}


def _chosen(what: str, name: str, known: Mapping[str, T]) -> T:
    if name not in known:
        raise SessionError(f"{what}: found method {name!r}; known: {', '.join(known)}")
    return known[name]
