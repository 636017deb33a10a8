"""Table of faults: one named row each, with the expected reaction of the rig."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.faults.collection_run import CollectionRun
from recorder.command_line.errors import (
    EXIT_DEVICE_LOST,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_SAFETY_STOP,
)

_STOPS = (EXIT_DEVICE_LOST,)
_GOES_ON = (EXIT_DONE,)
# Duration of a fault that must not end the session: it ends before the session does [s].
_SHORT = 1.0

# Number of targets of a session that must last until a slow line is detected as too slow.
_LONG = 4

# Mock bench on which the faults of each device are injected.
SENSOR_OF = {"arm": "tacpalm", "force": "tacpalm", "camera": "tacpalm", "taxels": "uskin"}
# Benches that must exist.
SENSORS = tuple(sorted(set(SENSOR_OF.values())))

# Limits that a press of the mock bench exceeds: the hard limit at once, without the soft one.
OVERLOAD = {
    "force_rating_n": [12.0, 12.0, 0.3],
    "soft_fraction": 0.8,
    "hard_fraction": 0.8,
    "horizon_ms": 0.5,
    "stiffness_n_per_mm": 0.005,
}


@dataclass(frozen=True, slots=True)
class Row:
    """One fault."""

    device: str
    """Device with the fault."""
    fault: str
    """The fault."""
    codes: tuple[int, ...]
    """Expected exit codes."""
    act: Callable[[CollectionRun], None] | None
    """Injects the fault into a pressing collection; None: it is present from the start."""
    sensor: str = "tacpalm"
    """Bench of the trial."""
    limits: str = "{}"
    """Limits that differ from the bench's, as YAML."""
    more: str = ""
    """YAML to add to the bench, in which BENCHES is replaced by the folder of the bench files."""
    before: Callable[[CollectionRun], None] | None = None
    """Operator's action after recording starts, without which nothing is pressed."""
    pedal: bool = False
    """True if the bench has a foot pedal, for which the hidraw shim is preloaded."""
    targets: int = 2
    counts: tuple[str, str] | None = None
    """Stream, and the reason with which it must have rejected all injected samples."""
    did: str = ""
    """Reaction of a rig that continues, in words, if it does more than count."""
    disorder: str = ""
    """Reason why rows may be stored out of order; empty: they must not."""
    needs_recover: bool = False
    """True if the session has to be recovered afterwards, as after any SIGKILL of ours."""
    controller_gone: bool = False
    """True if no process remains that could report the state of the arm."""

    @property
    def name(self) -> str:
        """Name of the row for --only."""
        return f"{self.device} {self.fault}".replace(" ", "-")


def _line(fault: str, **values: float) -> Callable[[str], Callable[[CollectionRun], None]]:
    def of_device(device: str) -> Callable[[CollectionRun], None]:
        return lambda collection: _inject(collection, device, fault, values)

    return of_device


def _inject(collection: CollectionRun, device: str, fault: str, values: dict[str, float]) -> None:
    collection.inject(device, fault, **values)


def _killed(device: str) -> Callable[[CollectionRun], None]:
    return lambda collection: collection.kill(collection.emulator(device))


_FAULTS: tuple[
    tuple[str, Callable[[str], Callable[[CollectionRun], None]], tuple[int, ...], str | None], ...
] = (
    ("killed", _killed, _STOPS, None),
    ("unplugged", _line("unplug"), _STOPS, None),
    ("frozen 3 s", _line("freeze", seconds=3.0), _STOPS, None),
    ("slow", _line("slow", fraction=0.25), _STOPS, None),
    ("garbage", _line("garbage", seconds=3.0), _STOPS, None),
    ("wrong units", _line("wrong_units"), _STOPS, None),
    ("reordered", _line("reorder", seconds=_SHORT, every=10), _GOES_ON, "late"),
    ("duplicated", _line("duplicate", seconds=_SHORT, every=10), _GOES_ON, "repeated"),
)
_STREAM_OF = {"arm": "pose"}
_UNNUMBERED = (
    "MJPEG over HTTP does not number frames, and TCP keeps their order, so only a camera could "
    "reorder them."
)


def _matrix() -> list[Row]:
    rows = []
    for device, sensor in SENSOR_OF.items():
        for fault, act, codes, reason in _FAULTS:
            unnumbered = device == "camera" and reason == "late"
            rows.append(
                Row(
                    device,
                    fault,
                    codes,
                    act(device),
                    sensor=sensor,
                    targets=_LONG if fault == "slow" else 2,
                    # Several clients share the arm's line, so no client's part is counted alone.
                    counts=None
                    if reason is None or unnumbered
                    else (_STREAM_OF.get(device, device), reason),
                    disorder=_UNNUMBERED if unnumbered else "",
                    controller_gone=device == "arm" and fault == "killed",
                )
            )
        if device != "arm":
            # A single bad packet breaks the framing of TCP; the arm's row is above.
            act3 = _line("garbage", messages=3)(device)
            rows.append(
                Row(
                    device,
                    "3 bad messages",
                    _GOES_ON,
                    act3,
                    sensor=sensor,
                    counts=(device, "corrupt"),
                )
            )
    return rows


def _arm(fault: str) -> Callable[[CollectionRun], None]:
    return lambda collection: _inject(collection, "arm", fault, {})


NIDAQ = "force: {kind: nidaq, grpc: 'loopback:31763', calibration: BENCHES/mock-nano17.cal}"
GRIPPER = "gripper: {kind: robotiq_2f, port: runfolder/gripper.tty}"
PEDAL = "pedal: {kind: hid_pedal, device: runfolder/pedal.hidraw, mode: dead_man}"
_WAITS = "waiting: press and hold the foot pedal"
_HALTED = "halted: the foot pedal was released"


def _nidaq() -> list[Row]:
    """Return the faults that apply to an F/T sensor on an NI card."""
    possible = ("killed", "unplugged", "frozen 3 s", "slow", "garbage")
    return [
        Row(
            "NI-DAQ",
            fault,
            # Garbage from a converter is a voltage, so the guard may react to it first.
            (*codes, EXIT_SAFETY_STOP) if fault == "garbage" else codes,
            act("NI-DAQ"),
            more=NIDAQ,
            targets=_LONG if fault == "slow" else 2,
        )
        for fault, act, codes, _ in _FAULTS
        if fault in possible
    ]


def _hold(collection: CollectionRun) -> None:
    collection.until_said(_WAITS)
    collection.tell("pedal", "press")


def _let_go_and_press_again(collection: CollectionRun) -> None:
    collection.inject("pedal", "release")
    collection.until_said(_WAITS, after=_HALTED)
    collection.tell("pedal", "press")


# All rows that are one collection; the kills and the full disk are run separately.
ROWS: tuple[Row, ...] = (
    *_matrix(),
    *_nidaq(),
    *(
        Row("gripper", name, codes, act, more=GRIPPER)
        for name, codes, act in (
            ("grip lost", (EXIT_SAFETY_STOP,), _line("lose_grip")("gripper")),
            ("killed", (EXIT_DEVICE_LOST, EXIT_SAFETY_STOP), _killed("gripper")),
            ("unplugged", (EXIT_DEVICE_LOST, EXIT_SAFETY_STOP), _line("unplug")("gripper")),
        )
    ),
    Row(
        "pedal",
        "released in mid-shear",
        _GOES_ON,
        _let_go_and_press_again,
        more=PEDAL,
        before=_hold,
        pedal=True,
        did="halted, retracted, waited for the pedal, pressed that target again from its start",
    ),
    Row("arm", "protective stop", (EXIT_SAFETY_STOP,), _arm("protective_stop")),
    Row("arm", "emergency stop", (EXIT_SAFETY_STOP,), _arm("emergency_stop")),
    Row("force", "overload", (EXIT_SAFETY_STOP,), None, limits=json.dumps(OVERLOAD)),
    Row(
        "operator",
        "Ctrl-C",
        (EXIT_INTERRUPTED,),
        lambda collection: collection.signal(signal.SIGINT),
    ),
    Row(
        "rig",
        "stream process killed",
        _STOPS,
        lambda collection: collection.kill(collection.stream("camera")),
        needs_recover=True,
    ),
)
