"""A motion with known ground truth, and a session as instruments would have recorded it.

Presses at 1.5 Hz up to 10 N with shear and a tilting tool, applied to a World of the mock bench:
the test case for labels that have to match their image. Arrival times are those of real
instruments, with a small, varying delay.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.recording.frames import HEIGHT, WIDTH, GelFrames
from recorder import SessionWriter, StreamWriter, camera_spec, force_spec, pose_spec
from rig.bench.worlds import WorldSpec
from rig.core.clock import SECOND_NS
from rig.core.geometry import turn
from rig.core.samples import WORLD_STATE
from rig.mock.world.ladder import LadderSurface, LadderWorld
from rig.mock.world.sensors import ladder_of, markers_of

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

# Presses per second, and the force of each [N].
PRESS_HZ, PEAK = 1.5, 10.0
_SHEAR, _SHEAR_HZ = 0.5e-3, 0.7
_TILT, _TILT_HZ = np.radians(5.0), 0.9
# Rotation of a tool that points down: half a turn, where rotation vectors jump.
_DOWN = np.array([np.pi, 0.0, 0.0])
# Time step of the World [s]; between two steps the ground truth is linear.
_STEP = 0.5e-3
# Rates of the streams and of the synchronised view.
FRAME_HZ, FORCE_HZ, POSE_HZ, VIEW_HZ = 60.0, 1000.0, 500.0, 40.0
# Exposure time of the camera [s]; it captures at its end.
EXPOSURE = 0.010
# Mean time from capture to arrival of the camera [s]: 8 ms and the mean of its jitter.
LATENCY = 0.009
# Scale of a gamma distribution of shape 2 [s].
_CAMERA_JITTER, _FORCE_JITTER, _POSE_JITTER = 0.5e-3, 0.1e-3, 0.15e-3
# Standard deviation of each force axis [N].
FORCE_NOISE = 0.1
# Standard deviation of each axis of the measured pose [m], [rad].
_POSE_NOISE, _TURN_NOISE = 2e-6, 2e-5
# Streams begin before and end after the ticks by this time [s].
_LEAD = 0.5
_ORIGIN_NS = 1_000 * SECOND_NS
# The hardest skin of the paper's material test under an indenter that presses up to the peak.
_WORLD, _INDENTER = WorldSpec(sensor="r6"), "wave"


class Motion:
    """Ground truth of the motion, which lasts `seconds` [s]."""

    def __init__(self, seconds: float) -> None:
        # Relaxation adds a fifth to the static force.
        self._depth = ladder_of(_WORLD, _INDENTER).deepest(PEAK / 1.2)
        world = LadderWorld(_WORLD, _INDENTER, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        count = round(seconds / _STEP) + 1
        self._t: Floats = np.arange(count, dtype=np.float64) * _STEP
        self._states = np.zeros(count, WORLD_STATE)
        positions = self.position(self._t)
        for row, (t, position) in enumerate(zip(self._t, positions, strict=True)):
            self._states[row] = world.step(round(t * SECOND_NS), np.concatenate([position, _DOWN]))
        self._wrench: Floats = self._states["wrench"]
        means = 0.5 * (self._wrench[1:] + self._wrench[:-1])
        self._summed: Floats = np.concatenate([np.zeros((1, 6)), np.cumsum(means * _STEP, axis=0)])

    def position(self, t: Floats) -> Floats:
        """Return the tip (n, 3) at times (n,) [s] in the contact frame [m]."""
        press = 0.5 * (1.0 - np.cos(2 * np.pi * PRESS_HZ * t))
        sideways = _SHEAR * np.sin(2 * np.pi * _SHEAR_HZ * t)
        return np.stack([sideways, np.zeros_like(t), -self._depth * press], axis=-1)

    def pose(self, t: Floats) -> Floats:
        """Return the pose (n, 6) at times (n,) [s], in the contact frame: tilted half the time."""
        tilt = np.zeros((len(t), 3))
        tilt[:, 0] = _TILT * np.maximum(np.sin(2 * np.pi * _TILT_HZ * t), 0.0)
        return np.concatenate([self.position(t), turn(tilt, _DOWN)], axis=-1)

    def wrench(self, t: Floats) -> Floats:
        """Return the wrench (n, 6) at times (n,) [N, N m]."""
        return _interpolated(t, self._t, self._wrench)

    def mean_wrench(self, start: Floats, stop: Floats) -> Floats:
        """Return the mean wrench (n, 6) between two times [N, N m], as for an exposure."""
        # The force is piecewise linear; 0.5 ms is fine enough for a linear integral.
        rise = _interpolated(stop, self._t, self._summed)
        rise = rise - _interpolated(start, self._t, self._summed)
        return np.asarray(rise / (stop - start)[:, None])

    def pixels(self, t: Floats) -> Floats:
        """Return marker centres (n, m, 2) at times (n,) [px], from the World's nearest step."""
        rows = np.clip(np.round(t / _STEP).astype(np.int64), 0, len(self._t) - 1)
        markers = markers_of(_WORLD)
        surface = LadderSurface(_WORLD, _INDENTER, markers.points)
        rims = [markers.outlines(surface(self._states[row])) for row in rows]
        return np.stack([rim.mean(axis=1) for rim in rims])


@dataclass(frozen=True, slots=True)
class Recorded:
    """Recording of a motion, with ground truth that only the simulation knows."""

    path: Path
    """Path of the session."""
    captured: Floats
    """True capture time of each frame (n,) [s], the end of its exposure."""
    origin_ns: int
    """Time 0 of the motion on the session's clock [ns]."""
    seconds: float
    """Length of the motion [s]."""


def record_motion(motion: Motion, seconds: float, path: Path) -> Recorded:
    """Write a session of the motion: JPEG frames at 60 Hz, force 1 kHz, pose 500 Hz."""
    rng = np.random.default_rng(0)

    def arrivals(true: Floats, latency: float, scale: float) -> Times:
        late = latency - 2 * scale * (latency > 0) + rng.gamma(2.0, scale, len(true))
        order = np.maximum.accumulate(np.round((true + late) * 1e9).astype(np.int64))
        return order + np.arange(len(true)) + _ORIGIN_NS

    captured = np.arange(EXPOSURE, seconds, 1 / FRAME_HZ) + 0.0031
    felt, posed = np.arange(0, seconds, 1 / FORCE_HZ), np.arange(0, seconds, 1 / POSE_HZ)
    noise = rng.normal(0.0, 1.0, (len(felt), 6)) * ([FORCE_NOISE] * 3 + [1e-3] * 3)
    wrench, poses = motion.wrench(felt) + noise, motion.pose(posed)
    poses[:, :3] += rng.normal(0.0, _POSE_NOISE, (len(posed), 3))
    poses[:, 3:] = turn(rng.normal(0.0, _TURN_NOISE, (len(posed), 3)), poses[:, 3:])
    specs = [
        camera_spec(
            FRAME_HZ, height=HEIGHT, width=WIDTH, codec="jpeg", latency=LATENCY, exposure=EXPOSURE
        ),
        force_spec(FORCE_HZ),
        pose_spec(POSE_HZ),
    ]
    frames = GelFrames()
    targets = {"point": np.zeros(0, np.int16)}
    with SessionWriter.create(path, attrs={}, streams=specs, targets=targets) as session:
        session.begin_run({"t0_ns": _ORIGIN_NS, "utc": "", "boot_id": "simulated"})
        with StreamWriter.open(session.stream_path("camera")) as writer:
            times = arrivals(captured, LATENCY, _CAMERA_JITTER)
            for number, t_ns in enumerate(times.tolist()):
                writer.append(value=frames.jpeg(number), device_t=float("nan"), t_ns=t_ns)
        with StreamWriter.open(session.stream_path("force")) as writer:
            for number, t_ns in enumerate(arrivals(felt, 0.0, _FORCE_JITTER).tolist()):
                writer.append(value=wrench[number], seq=number, status=0, t_ns=t_ns)
        with StreamWriter.open(session.stream_path("pose")) as writer:
            for number, t_ns in enumerate(arrivals(posed, 0.0, _POSE_JITTER).tolist()):
                writer.append(
                    value=poses[number], device_t=posed[number], speed_scaling=1.0, t_ns=t_ns
                )
        session.finish("complete", rate_hz=VIEW_HZ)
    return Recorded(path, captured, _ORIGIN_NS, seconds)


def ticks(recorded: Recorded) -> Times:
    """Return ticks of the synchronised view (n,) [ns], well inside the motion."""
    t = np.arange(_LEAD, recorded.seconds - _LEAD, 1 / VIEW_HZ)
    return np.round(t * 1e9).astype(np.int64) + recorded.origin_ns


def _interpolated(t: Floats, known: Floats, values: Floats) -> Floats:
    return np.stack([np.interp(t, known, column) for column in values.T], axis=-1).astype(float)
