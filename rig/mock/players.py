"""Emulators of one replayed run: one process per stream."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from recorder.session import Session
from rig.bench.bench import Bench, BenchLimits, Preflight
from rig.core.clock import SECOND_NS
from rig.core.errors import DeviceLost
from rig.core.playback import (
    FAILED,
    POSITION,
    SYNC,
    position_path,
    stated_rate,
    sync_path,
    times_of_run,
)
from rig.core.shared_memory import SharedLatest
from rig.devices.arm.settings import ArmConfig, PoseConfig, WrenchConfig
from rig.devices.camera.settings import MjpegConfig
from rig.devices.force.netft_emulator import force_page
from rig.devices.force.settings import NetFtConfig
from rig.devices.gripper.settings import HandConfig
from rig.devices.taxels.settings import XelaConfig
from rig.mock.bench import ProcessGroup, free_loopback
from trajectories import ForceDepth

# Emulator that plays a stream, by kind, in the order in which their drivers are opened.
PLAYED_BY = {
    "force": "netft",
    "pose": "ur",
    "arm_wrench": "ur",
    "taxels": "xela",
    "gripper": "robotiq_2f",
    "camera": "mjpeg",
}


class Players(ProcessGroup):
    """Starts, cues and ends the emulators of a run, at their hosts; speed 0: as fast as read."""

    def __init__(
        self,
        session: Path,
        names: tuple[str, ...],
        run: int,
        hosts: Mapping[str, str],
        folder: Path,
        *,
        speed: float,
    ) -> None:
        super().__init__(folder)
        self._sync = SharedLatest.create(sync_path(folder), SYNC)
        self._positions = {
            name: SharedLatest.create(position_path(folder, name), POSITION) for name in names
        }
        self._recording = {
            **{"session": str(session), "run": run, "folder": str(folder)},
            **{"speed": speed, "streams": names},
        }
        kinds = {name: stream.traits.kind for name, stream in Session(session).streams.items()}
        self._emulators = {name: (PLAYED_BY[kinds[name]], hosts[name]) for name in names}

    def _start(self) -> None:
        self._launch(
            {
                name: (emulator, {**_at(host), "recording": {**self._recording, "stream": name}})
                for name, (emulator, host) in self._emulators.items()
            }
        )

    def start_playback(self, start_ns: int) -> None:
        """Start playback at `start_ns`; every driver must be open and every writer recording."""
        self._sync.write((start_ns,))

    def wake(self) -> None:
        """Give the second cue: no more rows are sent, and waiting readers are woken."""
        while self._sync.count < 2:
            self._sync.write((0,))

    def positions(self) -> Mapping[str, np.void | None]:
        """Return the POSITION of each emulator, None before its first."""
        return {name: record.read() for name, record in self._positions.items()}

    def check(self) -> None:
        """Raise if an emulator ended or failed."""
        super().check()
        for name, record in self._positions.items():
            position = record.read()
            if position is not None and position["state"] == FAILED:
                raise DeviceLost(f"{name}: its emulator failed: {self.last_word(name)}")

    def close(self) -> None:
        """End every emulator; may be called twice."""
        super().close()
        for record in (self._sync, *self._positions.values()):
            record.close()
        self._positions = {}


# Bench of a replay: the addresses of its emulators, and no motion.

# Longest silence of a device: until all drivers are open, and while another reader is slow [s].
_PATIENCE = 30.0
# The same for the camera, which is opened last, and whose driver may take as long to close [s].
_CAMERA_PATIENCE = 10.0
_NEVER = 1e9
_NO_MOTION = BenchLimits(
    box_x=(0.0, 0.0),
    box_y=(0.0, 0.0),
    depth_max=0.0,
    height_max=0.0,
    force_rating=(1.0, 1.0, 1.0),
    torque_rating=(1.0, 1.0, 1.0),
    duration_max=0.0,
)


def playback_hosts(session: Session, names: tuple[str, ...], folder: Path) -> dict[str, str]:
    """Return a loopback address for each stream: devices of a kind have the same ports.

    A gripper has a serial port in the run folder.
    """
    hosts: dict[str, str] = {}
    for name in names:
        serial = session.streams[name].traits.kind == "gripper"
        hosts[name] = str(folder / name) if serial else free_loopback(hosts.values())
    return hosts


def _at(host: str) -> dict[str, Any]:
    """Return the settings of an emulator at a loopback address or a serial port."""
    return {"device": {"port": host}} if "/" in host else {"host": host}


def replay_bench(
    session: Session, names: tuple[str, ...], hosts: Mapping[str, str], speed: float
) -> Bench:
    """Return a bench with a session's devices at the addresses of their emulators."""
    attrs = session.attrs
    devices = {name: _device(session, name, hosts[name], speed) for name in names}
    # A lab bench needs an arm and an F/T sensor; those of a replay may never be opened.
    unused = next((host for host in hosts.values() if "/" not in host), "127.0.0.1")
    pose = devices.pop("pose", None)
    host, rate_hz = (unused, 500.0) if pose is None else (pose.host, pose.rate_hz)
    return Bench(
        sensor=str(attrs.get("sensor", "")),
        description="replay",
        mock=False,
        rate_hz=session.rate_hz,
        contact_frame=(0.0,) * 6,
        tool_rotation=(0.0, 0.0, 0.0),
        arm=ArmConfig(host=host, rate_hz=rate_hz),
        force=devices.pop("force", NetFtConfig(host=unused, http_port=8080)),
        limits=_NO_MOTION,
        trajectory=ForceDepth(depth_max=1e-3),
        preflight=Preflight(timeout=_PATIENCE),
        camera=devices.pop("camera", None),
        taxels=devices.pop("taxels", None),
        streams=devices,
    )


def _device(session: Session, name: str, host: str, speed: float) -> Any:
    stream = session.streams[name]
    silence = _PATIENCE + _longest_gap(session, name, speed)
    kind = stream.traits.kind
    if kind == "force":
        rate_hz = float(force_page(stream).rate_hz)
        return NetFtConfig(host=host, http_port=8080, rate_hz=rate_hz, silence=silence)
    if kind == "pose":
        return PoseConfig(host=host, rate_hz=stated_rate(stream))
    if kind == "arm_wrench":
        return WrenchConfig(host=host, rate_hz=stated_rate(stream))
    if kind == "gripper":
        made = {key: stream.attrs["device"][key] for key in ("slave", "per_count", "closed")}
        # It asks at once, and gets each answer when its row is due.
        return HandConfig(port=host, answer=silence, silence=_NEVER, rate_hz=1000.0, **made)
    if kind == "taxels":
        (taxels, axes) = stream.layout.columns[0].column.shape
        address = f"ws://{host}:5000"
        return XelaConfig(
            address, rows=1, columns=taxels, axes=axes, rate_hz=stated_rate(stream), silence=silence
        )
    height, width, _ = stream.layout.columns[0].column.shape
    return MjpegConfig(
        address=f"http://{host}:8090/",
        rate_hz=stated_rate(stream),
        width=width,
        height=height,
        silence=_CAMERA_PATIENCE + _longest_gap(session, name, speed),
        repeats=True,
    )


def _longest_gap(session: Session, name: str, speed: float) -> float:
    """Return the longest time without a row in any run, as replayed [s], including its start."""
    longest = 0.0
    for run in range(max(len(session.runs), 1)):
        times = [times_of_run(session, each, run) for each in session.streams]
        start = min((int(t.min()) for t in times if len(t)), default=0)
        end = max((int(t.max()) for t in times if len(t)), default=0)
        steps = np.diff(np.concatenate([[start], times_of_run(session, name, run), [end]]))
        longest = max(longest, float(steps.max()) / SECOND_NS)
    return longest / speed if speed > 0 else longest
