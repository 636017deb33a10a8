"""Examination of a bench: its plan, every device at once, and the computer; nothing moves.

Each part gives one finding: it is well, there is a note, or there is a fault with a cure. Devices
are opened by the processes that would record them, so a fault here is one of a collection.
"""

import contextlib
import fcntl
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from recorder.errors import SessionError
from recorder.progress import duration
from rig.acquire.control import Control, Interlocks
from rig.acquire.preview import draw
from rig.acquire.streams import StreamHandle, Streams, rate_window
from rig.bench.bench import Bench, BenchStream
from rig.bench.guards import force_text, left_out, left_out_text
from rig.core.clock import SECOND_NS, Clock, utc_text
from rig.core.errors import ConfigError, DeviceLost, SafetyStop
from rig.core.load import Load, busy, problem
from rig.core.realtime import RIG_PRIORITY, may_have_priority
from rig.devices import registry
from rig.devices.arm import dashboard
from rig.devices.arm.reader import RtdeLink

State = Literal["well", "note", "FAULT"]

# Free disk space below which a day of recording may not fit, and speed below which a camera's
# images may not be written in time [bytes, bytes/s].
ROOM, SPEED = 20e9, 20e6
# Bytes written to measure the speed.
_WRITTEN = 32 << 20
# Share of its rating that a gauge may show at rest: less than a hand's weight on it, more than the
# weight of indenter and mount.
AT_REST = 0.35
# Distance of the tip from the sensor beyond which the contact frame, or its units, is wrong [m].
FAR = 1.5
# Parts that an emulator does not have.
_HARDWARE = re.compile("cable|plug|power|switch the arm")
# A clock that is earlier was never set.
_SET = "2024-01-01"


@dataclass(frozen=True, slots=True)
class Finding:
    """Result for one part of the bench."""

    part: str
    """Name of the stream or part."""
    state: State
    text: str
    cures: tuple[str, ...] = ()
    """Steps to try, the likeliest first."""


def examine(
    bench: Bench,
    folder: Path,
    sessions: Path,
    clock: Clock,
    watch: Callable[[], None] | None = None,
) -> Iterator[Finding]:
    """Yield a finding for the plan, for each part of the computer, then for each device.

    `folder` gets records of the run, `sessions`, in which sessions would be recorded, a picture of
    the plan. `watch` raises if an emulator of a mock bench is gone.
    """
    yield plan(bench, sessions)
    yield disk(sessions, clock)
    yield realtime()
    yield computer(load := Load.read())
    yield time_of_day()
    for finding in _devices(bench, folder, clock, watch):
        yield _explained(finding, load, mock=bench.mock)


def _devices(
    bench: Bench, folder: Path, clock: Clock, watch: Callable[[], None] | None
) -> Iterator[Finding]:
    yield _arm(bench, clock)
    with Streams(bench, folder, clock, watch) as streams:
        opened: dict[str, dict[str, Any]] = {}
        for row in bench.rows:
            try:
                opened[row.name] = streams[row.name].wait_opened()
            except (ConfigError, DeviceLost, SessionError) as error:
                yield Finding(row.name, "FAULT", f"{error}", _cures(row.config))
        for row in bench.rows:
            if row.name in opened:
                yield _stream(bench, row, streams[row.name], opened[row.name])
    yield from _interlocks(bench, clock)


def _explained(finding: Finding, load: Load, *, mock: bool) -> Finding:
    """Return a device's fault with a busy computer as its first cure, on a mock without cables."""
    if finding.state != "FAULT":
        return finding
    text, cures = finding.text, finding.cures
    if mock:
        kept = ([one for one in cure.split("; ") if not _HARDWARE.search(one)] for cure in cures)
        late = "an emulator that ended or is late: start the command again"
        cures = tuple("; ".join(parts) or late for parts in kept)
        text = problem(text) if _HARDWARE.search(text) else text
    if load.shortages():
        cures = ("first the computer, which is busy: see above", *cures)
    return replace(finding, text=text, cures=cures)


def plan(bench: Bench, sessions: Path) -> Finding:
    """Draw the bench's plan in a folder, and examine it against the bench's limits."""
    walked = bench.dry_run(bench.trajectory)
    text = (
        f"{walked.targets} targets, {duration(sum(bench.seconds(bench.trajectory)))}; "
        f"{force_text(bench, walked.depth)}"
    )
    picture = sessions / f"{bench.sensor}-plan.png"
    try:
        sessions.mkdir(parents=True, exist_ok=True)
        draw(bench, walked).save(picture)
        text += f"; drawn in {picture}"
    except OSError as error:
        text += f"; not drawn: {picture}: {error.strerror or error}"
    if walked.broken:
        cure = "trajectory or limits in the bench file"
        return Finding("plan", "FAULT", f"{text}; breaks {'; '.join(walked.broken)}", (cure,))
    if out := left_out(bench, bench.trajectory, walked.depths):
        state: State = "FAULT" if len(out) == walked.targets else "note"
        cure = "another indenter, a plan less deep, or a gauge and sensor of a higher rating"
        return Finding("plan", state, f"{text}; {left_out_text(bench, out)}", (cure,))
    return Finding("plan", "well", text)


def disk(sessions: Path, clock: Clock) -> Finding:
    """Examine room and speed of the disk of a folder; what is written is removed."""
    folder = sessions.absolute()
    while not folder.exists():
        folder = folder.parent
    room = shutil.disk_usage(folder).free
    written = folder / f".tactile-doctor-{os.getpid()}"
    try:
        began_ns = clock.now_ns()
        with written.open("wb") as file:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX)
            file.write(os.urandom(1 << 20) * (_WRITTEN >> 20))
            file.flush()
            os.fsync(file.fileno())
        speed = _WRITTEN * SECOND_NS / max(clock.now_ns() - began_ns, 1)
    except OSError as error:
        cure = f"write access to {folder}, with locks, or --out on another disk"
        return Finding("disk", "FAULT", f"{folder}: {error.strerror or error}", (cure,))
    finally:
        with contextlib.suppress(OSError):
            written.unlink()
    text = f"{folder}: {room / 1e9:.0f} GB free, written at {speed / 1e6:.0f} MB/s"
    if room < ROOM:
        cure = f"free some space: a day of recording may take {ROOM / 1e9:.0f} GB"
        return Finding("disk", "FAULT" if room < ROOM / 20 else "note", text, (cure,))
    if speed < SPEED:
        cure = f"a local disk that writes {SPEED / 1e6:.0f} MB/s and more; no network folder"
        return Finding("disk", "note", text, (cure,))
    return Finding("disk", "well", text)


def realtime() -> Finding:
    """Examine if this user's processes may have real-time priority; a note if not."""
    if may_have_priority():
        return Finding("real time", "well", f"priority {RIG_PRIORITY} granted")
    return Finding(
        "real time",
        "note",
        "no rights: a busy computer may delay samples (their times stay right)",
        (
            'echo "$USER - rtprio 60" | sudo tee /etc/security/limits.d/70-tactile-rig.conf; then '
            "log in again",
        ),
    )


def computer(load: Load) -> Finding:
    """Examine the computer's resources; a fault without priority over other programs."""
    if not (state := busy(load)):
        return Finding("computer", "well", str(load))
    cure = "end other programs (top shows which need it); a computer of its own for the bench"
    return Finding("computer", "note" if may_have_priority() else "FAULT", state, (cure,))


def time_of_day() -> Finding:
    """Examine if the computer's clock was ever set; sessions state when they were recorded."""
    now = utc_text()
    if now < _SET:
        return Finding("clock", "FAULT", now, ("timedatectl set-ntp true, or set it by hand",))
    return Finding("clock", "well", now)


def _arm(bench: Bench, clock: Clock) -> Finding:
    host, timeout = bench.arm.host, bench.preflight.timeout
    link = RtdeLink(host, 10.0, clock)
    try:
        dashboard.check_ready(host, timeout)
        link.open(timeout)
        fraction = float(link.receive(timeout)[-1]["speed_fraction"])
        version = ".".join(map(str, link.version))
    except (DeviceLost, SafetyStop, IndexError) as error:
        return Finding("arm", "FAULT", str(error) or f"{host}: no sample", _cures(bench.arm))
    finally:
        link.close()
    text = f"{host}: PolyScope {version}, speed slider at {fraction:.0%}"
    if note := dashboard.age_note(version):
        return Finding("arm", "note", f"{text}; {note}")
    if fraction < 1:
        return Finding("arm", "note", text, ("the slider at the pendant, to 100 %",))
    return Finding("arm", "well", text)


def _stream(
    bench: Bench, row: BenchStream, handle: StreamHandle, description: dict[str, Any]
) -> Finding:
    """Return the finding of a stream that is open: its rate, and its values at rest."""
    expected = row.rate_hz
    window = rate_window(bench, row.rate_hz)
    cures = _cures(row.config)
    try:
        # A busy computer may delay one window; a fault shows in the next ones too.
        for _attempt in range(3):
            handle.start_measuring(window)
            measured = handle.measured(window)
            handle.check()
            off = float(measured["rate_hz"]) / expected - 1
            if abs(off) <= bench.preflight.rate_tolerance:
                break
    except (ConfigError, DeviceLost, SessionError) as error:
        return Finding(row.name, "FAULT", str(error), cures)
    rate = float(measured["rate_hz"])
    text = (
        f"{_at(row.config)}{rate:.1f} Hz, expected {expected:.0f}{_model_and_firmware(description)}"
    )
    if abs(off) > bench.preflight.rate_tolerance:
        text += f": {abs(off):.0%} too {'slow' if off < 0 else 'fast'}"
        return Finding(row.name, "FAULT", text, _rate_cures(row, rate))
    wrong = _values(bench, row, handle.latest(), measured)
    if wrong is not None:
        return Finding(row.name, "FAULT", f"{text}; {wrong[0]}", wrong[1:])
    if automatic := description.get("automatic"):
        text += (
            f"; automatic {', '.join(automatic)}: changes of the picture may be the camera's own"
        )
        cures = tuple(
            _MANUAL[each].format(key=row.key, at=_address(row.config)) for each in automatic
        )
        return Finding(row.name, "note", text, cures)
    if bench.mock and row.kind == "camera":
        nodes = ", ".join(sorted(map(str, Path("/dev").glob("video[0-9]*"))))
        stands_in = "tests/rig/test_camera_v4l2.py tests that driver on an emulated one"
        nodes = nodes or f"no video device here: {stands_in}"
        text += f"; a USB camera has kind v4l2 ({nodes})"
    return Finding(row.name, "well", text)


# How to switch off the automatic controls of a V4L2 camera.
_MANUAL = {
    "exposure": "{key}.exposure_ms in the bench file, below one period",
    "white balance": "v4l2-ctl -d {at} -c white_balance_automatic=0 (older Linux: "
    "white_balance_temperature_auto=0)",
    "focus": "v4l2-ctl -d {at} -c focus_automatic_continuous=0 (older Linux: focus_auto=0)",
}


def _rate_cures(row: BenchStream, rate: float) -> tuple[str, ...]:
    stated = f"if this is its true rate: {row.key}.rate_hz: {rate:.0f} in the bench file"
    if row.kind != "camera":
        return (*_cures(row.config), stated)
    return (
        "lock the exposure below one period (exposure_ms), or use a brighter light: in the dark, "
        "automatic exposure halves the rate of a webcam",
        "a USB port of its own, and a smaller picture or MJPEG if the port is too slow",
        stated,
    )


def _values(
    bench: Bench, row: BenchStream, latest: Any, found: dict[str, Any]
) -> tuple[str, ...] | None:
    """Return what is wrong with the values at rest, and its cures; None if nothing is."""
    if row.kind == "force" and "mean" in found:
        rating = np.array(bench.force_rating[:3])
        mean, spread = np.asarray(found["mean"])[:3], np.asarray(found["std"])[:3]
        with np.errstate(invalid="ignore"):
            loaded = np.flatnonzero(np.abs(mean) > AT_REST * rating)
            noisy = np.flatnonzero(spread > max(bench.preflight.tare_spread, 1e-9))
        if len(loaded):
            axis = "xyz"[loaded[0]]
            return (
                f"F{axis} is {mean[loaded[0]]:.2f} N at rest, rated {rating[loaded[0]]:g} N",
                "take everything off the sensor, and zero the gauge on its own page or display",
                "units of the gauge (counts per newton, N or lbf) and its calibration file",
            )
        if (frozen := spread == 0).any() and mean[frozen].any():
            axis = "xyz"[int(np.flatnonzero(frozen & (mean != 0))[0])]
            return (
                f"F{axis} does not change: clipped at a limit of the gauge, or frozen",
                "take everything off the sensor, then range and calibration file of the gauge",
            )
        if len(noisy):
            axis = "xyz"[noisy[0]]
            return (
                f"F{axis} varies by {spread[noisy[0]]:.2f} N at rest, allowed "
                f"{bench.preflight.tare_spread:g} N",
                "keep the bench still; ground the gauge's cable, away from the arm's",
            )
    if row.kind == "taxels" and "std" in found and not np.asarray(found["std"]).any():
        return ("no value changes: frozen", "restart the vendor's server, plug the sensor in again")
    if row.name == "pose" and latest is not None:
        tip = bench.tip(latest["value"])
        if np.linalg.norm(tip) > FAR:
            return (
                f"the tip is {np.linalg.norm(tip):.2f} m from the sensor",
                "contact_frame and arm.tcp in the bench file: mm and degrees, in the arm's base "
                "frame as the pendant shows it",
            )
    return None


def _interlocks(bench: Bench, clock: Clock) -> Iterator[Finding]:
    for name in ("gripper", "pedal"):
        config = getattr(bench, name)
        if config is None:
            continue
        alone = replace(bench, pedal=None) if name == "gripper" else replace(bench, gripper=None)
        with Interlocks(alone, Control(), clock) as opened:
            try:
                description = opened.open()[name]
            except (ConfigError, DeviceLost) as error:
                yield Finding(name, "FAULT", str(error), _cures(config))
                continue
        yield Finding(name, "well", f"{_at(config)}answers{_model_and_firmware(description)}")


def _cures(config: Any) -> tuple[str, ...]:
    at = _address(config) or "its address"
    return tuple(cure.replace("{at}", at) for cure in registry.device(config.KIND).cures)


def _address(config: Any) -> str:
    for name in ("address", "host", "port", "device"):
        value = getattr(config, name, None)
        if isinstance(value, str) and value:
            return value
    return ""


def _at(config: Any) -> str:
    address = _address(config)
    return f"{address}: " if address else ""


def _model_and_firmware(description: dict[str, Any]) -> str:
    parts = (
        str(description[key]) for key in ("model", "firmware", "version") if key in description
    )
    text = ", ".join(parts)
    return f" ({text})" if text else ""
