"""Table of faults: one named row each, with the expected reaction of the rig."""

import json
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from benchmarks.faults.collection_run import CollectionRun
from recorder.command_line.errors import EXIT_DEVICE_LOST as DEVICE_LOST
from recorder.command_line.errors import EXIT_DONE as DONE
from recorder.command_line.errors import EXIT_INTERRUPTED as INTERRUPTED
from recorder.command_line.errors import EXIT_SAFETY_STOP as SAFETY_STOP

_STOPS, _GOES_ON, _SAFETY = (DEVICE_LOST,), (DONE,), (SAFETY_STOP,)
_EITHER = (*_STOPS, *_SAFETY)
# Mock bench on which the faults of each device are injected.
SENSOR_OF = {"arm": "tacpalm", "force": "tacpalm", "camera": "tacpalm", "taxels": "uskin"}

# Limits that a press of the mock bench exceeds: the hard limit at once, without the soft one.
OVERLOAD = {
    "force_rating_n": [12.0, 12.0, 0.3],
    "soft_fraction": 0.8,
    "hard_fraction": 0.8,
    "horizon_ms": 0.5,
}
# A skin that is stated too soft, so that no target is left out.
SOFT = "skin: {modulus_kpa: [0.1, 0.1]}"

Act = Callable[[CollectionRun], object]


@dataclass(frozen=True, slots=True)
class Row:
    """One fault, its expected exit codes, and its injection into a pressing collection.

    `limits` is YAML merged over the limits of the sensor's bench, `more` YAML to add to it.
    """

    device: str
    fault: str
    codes: tuple[int, ...]
    act: Act | None
    """None: the fault is in `limits`, or the disk."""
    sensor: str = "tacpalm"
    limits: str = "{}"
    more: str = ""
    before: Act | None = None
    """Operator's action after recording starts, without which nothing is pressed."""
    targets: int = 2
    counts: tuple[str, str] | None = None
    """Stream, and the reason with which it must have rejected all injected samples."""
    did: str = ""
    """Reaction of a rig that continues, in words, if it does more than count."""
    disorder: bool = False
    """True if rows may be stored out of order, as the device does not number them."""
    needs_recover: bool = False
    """True if the session has to be recovered afterwards, as after any SIGKILL of ours."""
    controller_gone: bool = False
    """True if no process remains that could report the state of the arm."""
    disk_mb: int = 0
    """Size of a disk to record onto until it is full [MB]; 0: the disk is not limited."""

    @property
    def name(self) -> str:
        """Its name, without spaces."""
        return f"{self.device} {self.fault}".replace(" ", "-")


def _line(fault: str, **values: float) -> Callable[[str], Act]:
    return lambda device: lambda collection: collection.inject(device, fault, **values)


def _killed(device: str) -> Act:
    return lambda collection: collection.kill(collection.process_of(f"{device} emulator"))


# Fault, its act on a device, the exit codes, and the reason with which samples are rejected. What
# must not end the session lasts 1 s, less than the session.
_FAULTS: tuple[tuple[str, Callable[[str], Act], tuple[int, ...], str], ...] = (
    ("killed", _killed, _STOPS, ""),
    ("unplugged", _line("unplug"), _STOPS, ""),
    ("frozen 3 s", _line("freeze", seconds=3.0), _STOPS, ""),
    ("slow", _line("slow", fraction=0.25), _STOPS, ""),
    ("garbage", _line("garbage", seconds=3.0), _STOPS, ""),
    ("wrong units", _line("wrong_units"), _STOPS, ""),
    ("reordered", _line("reorder", seconds=1.0, every=10), _GOES_ON, "late"),
    ("duplicated", _line("duplicate", seconds=1.0, every=10), _GOES_ON, "repeated"),
)


def _targets(fault: str) -> int:
    # A session must last until a slow line is detected as too slow.
    return 4 if fault == "slow" else 2


def _matrix(device: str, sensor: str) -> Iterator[Row]:
    stream = "pose" if device == "arm" else device
    for fault, act, codes, reason in _FAULTS:
        # MJPEG does not number its frames.
        unnumbered = device == "camera" and reason == "late"
        yield Row(
            device,
            fault,
            codes,
            act(device),
            sensor=sensor,
            targets=_targets(fault),
            counts=(stream, reason) if reason and not unnumbered else None,
            disorder=unnumbered,
            controller_gone=device == "arm" and fault == "killed",
        )
    if device != "arm":
        # On the arm's line a single bad packet breaks the framing of TCP, as in the row above.
        bad, counts = _line("garbage", messages=3)(device), (stream, "corrupt")
        yield Row(device, "3 bad messages", _GOES_ON, bad, sensor=sensor, counts=counts)


NIDAQ = "force: {kind: nidaq, grpc: 'loopback:31763', calibration: BENCHES/mock-nano17.cal}"
GRIPPER = "gripper: {kind: robotiq_2f, port: runfolder/gripper.tty}"
PEDAL = "pedal: {kind: hid_pedal, device: runfolder/pedal.hidraw, mode: dead_man}"
_WAITS = "waiting: press and hold the foot pedal"
_HALTED = "halted: the foot pedal was released"


def _nidaq() -> Iterator[Row]:
    """Yield the faults that apply to an F/T sensor on an NI card."""
    for fault, act, codes, _ in _FAULTS[:5]:
        # Garbage from a converter is a voltage, so the guard may react to it first.
        allowed = _EITHER if fault == "garbage" else codes
        yield Row("NI-DAQ", fault, allowed, act("force"), more=NIDAQ, targets=_targets(fault))


def _hold(collection: CollectionRun) -> None:
    collection.until_said(_WAITS)
    collection.tell("pedal", "press")


def _let_go_and_press_again(collection: CollectionRun) -> None:
    collection.inject("pedal", "release")
    collection.until_said(_WAITS, after=_HALTED)
    collection.tell("pedal", "press")


ROWS: tuple[Row, ...] = (
    *(row for device, sensor in SENSOR_OF.items() for row in _matrix(device, sensor)),
    *_nidaq(),
    Row("gripper", "grip lost", _SAFETY, _line("lose_grip")("gripper"), more=GRIPPER),
    Row("gripper", "killed", _EITHER, _killed("gripper"), more=GRIPPER),
    Row("gripper", "unplugged", _EITHER, _line("unplug")("gripper"), more=GRIPPER),
    Row(
        "pedal",
        "released in mid-shear",
        _GOES_ON,
        _let_go_and_press_again,
        more=PEDAL,
        before=_hold,
        did="halted, retracted, waited for the pedal, pressed that target again from its start",
    ),
    Row("arm", "protective stop", _SAFETY, _line("protective_stop")("arm")),
    Row("arm", "emergency stop", _SAFETY, _line("emergency_stop")("arm")),
    Row("force", "overload", _SAFETY, None, limits=json.dumps(OVERLOAD), more=SOFT),
    Row(
        "operator",
        "Ctrl-C",
        (INTERRUPTED,),
        lambda run: run.kill(run.process.pid, by=signal.SIGINT),
    ),
    Row(
        "rig",
        "stream process killed",
        _STOPS,
        lambda collection: collection.kill(collection.process_of("camera stream")),
        needs_recover=True,
    ),
    Row("disk", "full", _STOPS, None, targets=20, needs_recover=True, disk_mb=12),
)
# A quick run has one of each kind: a lost device, one that recovers, a stop of the arm, a guard.
QUICK = ("camera-killed", "force-duplicated", "arm-protective-stop", "force-overload")
