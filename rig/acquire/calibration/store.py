"""Calibrations on disk: `calibrations/<sensor>.yaml`, mm and ms under keys with the unit.

`home` holds the height of the surface for each indenter, `latency` the lag of a signal. A session
applies, prints and stores its calibration; one that belongs to another bench is rejected.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from recorder.command_line.options import next_command
from recorder.store import replace_file
from recorder.strict_yaml import describe, yaml_text
from rig.acquire.calibration.calibration import (
    Calibration,
    FirstPressRecord,
    HomeCalibration,
    LatencyCalibration,
)
from rig.bench.bench import Bench
from rig.core.clock import ClockAnchor
from rig.core.config import READER, build, from_si, read_yaml
from rig.core.errors import ConfigError

# Default folder.
FOLDER = Path("calibrations")
# Ending of the name of a set-up's file, after that of the sensor.
SETUP = ".setup.json"
# An older calibration is used with a warning.
STALE_DAYS = 7.0
_NOTE = "# Measured, not written by hand: tactile home, tactile calibrate-latency.\n"
# Frames that differ by less are the same [m, rad]: YAML keeps mm to nine digits.
_SAME_PLACE, _SAME_ANGLE = 1e-6, 1e-6


def bench_hash(content: dict[str, Any]) -> str:
    """Return the SHA-256 of a bench's content as read, independent of the order of its keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def device_name(bench: Bench, stream: str) -> str:
    """Return the kind and address of the device behind a signal."""
    config = bench.row(stream).config
    return f"{config.KIND} {config.address}"


def load(folder: Path, bench: Bench, indenter: str) -> tuple[Calibration, list[str]]:
    """Load the calibration of a bench's sensor with an indenter, and warnings about it.

    Args:
        folder: Folder of the calibration files.
        bench: The bench as described by its file, without a calibration.
        indenter: Name of the indenter on the arm.
    """
    path = folder / f"{bench.sensor}.yaml"
    acceptance = acceptance_of(folder, bench)
    if not path.exists():
        return Calibration(acceptance=acceptance), []
    content = read_yaml(path)
    again = "measure again, or remove the file"
    if content.get("sensor") != bench.sensor:
        raise ConfigError(
            f"{path}.sensor: found {content.get('sensor')!r}; allowed: {bench.sensor!r}; {again}"
        )
    parts = ("first_press", "home", "latency", "sensor")
    if unknown := sorted(set(content) - set(parts)):
        raise ConfigError(f"{path}: unknown {', '.join(unknown)}; known: {', '.join(parts)}")
    homes = content.get("home") or {}
    if not isinstance(homes, dict):
        raise ConfigError(f"{path}.home: found {describe(homes)}; allowed: a mapping by indenter")
    warnings: list[str] = []
    home = latency = None
    if indenter in homes:
        home = build(HomeCalibration, homes[indenter], f"{path}.home.{indenter}")
        _refuse_foreign(home.mock, bench, f"{path}.home.{indenter}")
        for name, found, wanted in (
            ("contact_frame", home.contact_frame, bench.contact_frame),
            ("tcp", home.tcp, bench.arm.tcp),
        ):
            if not _same(found, wanted):
                raise ConfigError(
                    f"{path}.home.{indenter}.{name}: it was measured with another {name} than the "
                    f"bench file's; {again} ({next_command('home', sensor=bench.sensor)})"
                )
        _warn_stale(warnings, home.date_utc, f"{path}.home.{indenter}")
    elif homes:
        warnings.append(
            f"{path}.home: known for {', '.join(sorted(homes))}, not for {indenter}: the bench "
            "file's contact frame is used ("
            f"{next_command('home', sensor=bench.sensor, indenter=indenter)})"
        )
    if content.get("latency"):
        latency = build(LatencyCalibration, content["latency"], f"{path}.latency")
        _refuse_foreign(latency.mock, bench, f"{path}.latency")
        known = {row.name for row in bench.rows}
        if latency.stream not in known or latency.device != device_name(bench, latency.stream):
            raise ConfigError(
                f"{path}.latency.device: found {latency.device!r}; the bench file has another "
                f"{latency.stream}; {again} ("
                f"{next_command('calibrate-latency', sensor=bench.sensor)})"
            )
        _warn_stale(warnings, latency.date_utc, f"{path}.latency")
    return Calibration(home, latency, str(path), acceptance), warnings


def setup_path(folder: Path, sensor: str) -> Path:
    """Return the file of `tactile setup`, with its answers and findings."""
    return folder / f"{sensor}{SETUP}"


def report_path(folder: Path, sensor: str) -> Path:
    """Return the file of the acceptance report."""
    return folder / f"{sensor}.acceptance.html"


def acceptance_of(folder: Path, bench: Bench) -> dict[str, Any] | None:
    """Return the summary of a bench's acceptance report; None if it was not set up to the end."""
    accepted: dict[str, Any] | None = read_setup(folder, bench).get("acceptance")
    return accepted


def read_setup(folder: Path, bench: Bench) -> dict[str, Any]:
    """Return the stored set-up of a bench; empty without one, or if it is of the other kind."""
    path = setup_path(folder, bench.sensor)
    try:
        found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {error}; remove the file, and set up again") from None
    return found if found.get("mock") == bench.mock else {}


def pressed_before(folder: Path, bench: Bench, indenter: str, depth: float) -> bool:
    """Return True if a sensor was pressed in steps with this indenter and TCP, as deep as now.

    Args:
        folder: Folder of the calibration files.
        bench: The bench.
        indenter: Name of the indenter on the arm.
        depth: Deepest indentation that is planned [m].
    """
    path = folder / f"{bench.sensor}.yaml"
    content = read_yaml(path) if path.exists() else {}
    found = (content.get("first_press") or {}).get(indenter)
    if found is None:
        return False
    press = build(FirstPressRecord, found, f"{path}.first_press.{indenter}")
    deep_enough = press.depth > depth - _SAME_PLACE
    return deep_enough and press.mock == bench.mock and _same(press.tcp, bench.arm.tcp)


def store(
    folder: Path,
    sensor: str,
    *,
    home: dict[str, HomeCalibration] | None = None,
    latency: LatencyCalibration | None = None,
    first_press: dict[str, FirstPressRecord] | None = None,
) -> Path:
    """Add to a sensor's calibration file, atomically; other entries stay."""
    path = folder / f"{sensor}.yaml"
    content: dict[str, Any] = read_yaml(path) if path.exists() else {"sensor": sensor}
    if content.get("sensor") != sensor:
        raise ConfigError(
            f"{path}.sensor: found {content.get('sensor')!r}; allowed: {sensor!r}; remove the file"
        )
    for indenter, found in (home or {}).items():
        content.setdefault("home", {})[indenter] = _plain(found)
    for indenter, press in (first_press or {}).items():
        content.setdefault("first_press", {})[indenter] = _plain(press)
    if latency is not None:
        content["latency"] = _plain(latency)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(path, (_NOTE + yaml_text(content)).encode())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error})") from error
    return path


def now_utc() -> str:
    """Return the current UTC, ISO 8601 to the second."""
    return f"{np.datetime64(ClockAnchor.take().utc_ns, 'ns').astype('datetime64[s]')}Z"


def _plain(spec: Any) -> dict[str, Any]:
    """Convert a calibration for YAML: mm, deg, ms under keys with the unit."""
    out: dict[str, Any] = {}
    for item in dataclasses.fields(spec):
        value, unit = getattr(spec, item.name), item.metadata.get("unit")
        key = READER.key_of(type(spec), item)
        if item.metadata.get("pose"):
            position = [round(1e3 * number, 9) for number in value[:3]]
            rotation = [round(math.degrees(number), 9) for number in value[3:]]
            out[key] = {"position_mm": position, "rotation_deg": rotation}
        elif isinstance(value, tuple):
            out[key] = [round(from_si(n, unit), 9) if unit else n for n in value]
        else:
            out[key] = round(from_si(value, unit), 9) if unit else value
    return out


def _same(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    difference = np.abs(np.subtract(one, other))
    return bool((difference[:3] < _SAME_PLACE).all() and (difference[3:] < _SAME_ANGLE).all())


def _refuse_foreign(mock: bool, bench: Bench, where: str) -> None:
    if mock != bench.mock:
        kinds = {True: "a mock bench", False: "a lab bench"}
        raise ConfigError(
            f"{where}.mock: {mock}: measured on {kinds[mock]}, this is {kinds[bench.mock]}; "
            "measure again, or remove the file"
        )


def age_hours(date_utc: str, where: str = "home") -> float:
    """Return the age of a calibration [h]."""
    try:
        then = np.datetime64(date_utc.removesuffix("Z"), "s")
    except ValueError:
        raise ConfigError(f"{where}.date_utc: found {date_utc!r}; allowed: ISO 8601") from None
    now = np.datetime64(now_utc().removesuffix("Z"), "s")
    return float((now - then) / np.timedelta64(1, "h"))


def _warn_stale(warnings: list[str], date_utc: str, where: str) -> None:
    days = age_hours(date_utc, where) / 24
    if days > STALE_DAYS:
        warnings.append(f"{where}: {days:.0f} days old; after {STALE_DAYS:.0f} measure again")
