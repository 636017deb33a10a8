"""Checks of a bench while it is set up: each compares a measurement with the bench file.

All return findings of the doctor's kind: well, a note, or a fault with its cures. Devices are read
in this process, and nothing here moves the arm.
"""

import math
import re
import socket
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from recorder.command_line.options import next_command
from rig.acquire.doctor import Finding, State
from rig.acquire.no_gauge import CONTACT
from rig.acquire.signal_level import SignalLevel, reading, shift, whole_grey
from rig.bench.bench import Bench, BenchStream
from rig.core.clock import SECOND_NS, Clock
from rig.core.config import from_si
from rig.core.errors import DeviceLost
from rig.core.geometry import compose
from rig.devices.arm import dashboard
from rig.devices.arm.reader import RtdeLink
from trajectories import Point

GRAVITY = 9.81
# Largest difference of lengths [m], masses [kg], and forces at a free tool [N], which a UR e-Series
# knows to about 4 N along each axis.
LENGTH, MASS, FREE = 1e-3, 0.05, 7.5
# Largest distance of the tip from the origin of the contact frame, along and across its z [m].
ALONG, ACROSS = 3e-3, 3e-3
# Largest relative error of a known weight, and least fraction of it that counts as felt.
SCALE, FELT = 0.1, 0.03
# Least change by a push, over that of a finger held still, and over the force expected of it.
STILL, PUSHED = 3.0, 0.05
# Ratios of a measured to a true weight, and their usual reasons.
RATIOS = {
    10.0: "counts per newton are 10 times too small: another calibration, or its decimal point",
    0.1: "counts per newton are 10 times too large: another calibration, or its decimal point",
    1000.0: "the gauge counts in millinewtons or grams: its unit must be N",
    0.001: "the gauge counts in kilonewtons: its unit must be N",
    4.448: "newtons are taken for pounds-force: its unit must be N",
    0.2248: "the gauge counts in pounds-force: its unit must be N",
    0.102: "the gauge counts in kilograms-force: its unit must be N",
    9.807: "newtons are taken for kilograms-force: its unit must be N",
}
# Grey value from which a pixel is saturated, its largest fraction, and the least grey value of the
# brightest pixels.
SATURATED, SATURATED_MOST, BRIGHTEST_LEAST = 250, 0.02, 60
# Width of an edge in a picture of 640 columns from which on it is out of focus [px].
EDGE_MOST = 6.0
# Names of devices that change with the order of plugging in.
_UNSTABLE = re.compile(r"/dev/(video|ttyUSB|ttyACM|hidraw)\d+|\d+")


@dataclass(frozen=True, slots=True)
class Place:
    """A device in the network."""

    part: str
    """Name of the stream, or `arm`."""
    key: str
    """Key of its address in the bench file."""
    host: str
    port: int


def network_devices(bench: Bench) -> list[Place]:
    """Return the devices that are reached by TCP, the arm first."""
    devices = [Place("arm", "arm.host", bench.arm.host, dashboard.PORT)]
    for row in bench.rows:
        config = row.config
        address = str(getattr(config, "address", ""))
        if config.KIND == "netft":
            devices.append(Place(row.name, f"{row.key}.host", config.host, config.http_port))
        elif "://" in address:
            url = urlsplit(address)
            port = url.port or 80
            devices.append(Place(row.name, f"{row.key}.address", url.hostname or "", port))
    return devices


def network(bench: Bench, timeout: float = 2.0) -> Iterator[Finding]:
    """Yield a finding for each device of the network: is it reached, and from which address?"""
    devices = network_devices(bench)
    for device in devices:
        twin = next((each for each in devices if _conflict(each, device)), None)
        own, error = _reached(device, timeout)
        text = f"{device.host}:{device.port}"
        if twin is not None:
            text += f": {twin.part} has this address too"
            cure = f"give each device its own address: {device.key}, {twin.key}"
            yield Finding(device.part, "FAULT", text, (cure,))
        elif error is None:
            yield Finding(device.part, "well", f"{text} answers, from this computer's {own}")
        else:
            yield Finding(device.part, "FAULT", f"{text}: {error}", _network_cures(device, own))


def _conflict(one: Place, other: Place) -> bool:
    # All devices of a mock bench have one address, and differ by the port.
    same_port = one.port == other.port or not one.host.startswith("127.")
    return one is not other and one.host == other.host and same_port


def _reached(place: Place, timeout: float) -> tuple[str, OSError | None]:
    """Return this computer's address towards a device, and the error of connecting to it."""
    own = "none"
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((place.host, place.port))
            own = str(probe.getsockname()[0])
        socket.create_connection((place.host, place.port), timeout).close()
    except OSError as error:
        return own, error
    return own, None


def _network_cures(place: Place, own: str) -> tuple[str, ...]:
    network = place.host.rpartition(".")[0]
    cures = [
        f"power and cable of {place.part}; is its address {place.host}? The bench file's "
        f"{place.key} must be the one that its own page or display shows"
    ]
    if own.rpartition(".")[0] != network:
        cures.append(
            f"this computer has {own} there: give it a free address in the same network, such as "
            f"{network}.100 with mask 255.255.255.0"
        )
    return (*cures, f"a firewall that lets port {place.port} pass")


def arm(host: str, timeout: float) -> Iterator[Finding]:
    """Yield findings of an arm's software, its mode and its safety status."""
    questions = ["PolyscopeVersion", "is in remote control", "robotmode", "safetystatus"]
    try:
        version, remote, mode, safety = dashboard.ask(host, questions, timeout)
    except DeviceLost as error:
        cures = ("switch the controller on; Settings > Security > Services: enable Dashboard",)
        yield Finding("arm", "FAULT", str(error), cures)
        return
    number = re.search(r"(\d+)\.(\d+)", version)
    parts = (int(number[1]), int(number[2])) if number else (0, 0)
    yield _finding(
        "software",
        parts >= dashboard.OLDEST,
        version,
        f"update PolyScope to {dashboard.UPDATE}",
    )
    yield _finding(
        "remote",
        remote == "true",
        "remote control" if remote == "true" else f"no remote control ({remote})",
        "pendant, upper right corner: Local > Remote Control (Settings > System > Remote Control "
        "> Enable)",
    )
    yield _finding(
        "power",
        mode.endswith("RUNNING"),
        mode,
        "pendant, lower left corner: On, then Start, which releases the brakes",
    )
    yield _finding(
        "safety",
        safety.endswith(("NORMAL", "REDUCED")),
        safety,
        "find the cause, clear the bench, then release the stop at the pendant: no program does",
    )


def tool(bench: Bench, clock: Clock, length: float) -> Iterator[Finding]:
    """Yield findings of TCP and payload: file, installation of the pendant, caliper, and weight.

    The caliper measured the distance of the tip from the flange as `length` [m].
    """
    config = bench.arm
    names = {name: name for name in ("tcp_offset", "payload", "actual_TCP_force")}
    link = RtdeLink(config.host, 125.0, clock, names)
    try:
        link.open(bench.preflight.timeout)
        samples: list[dict[str, Any]] = []
        while len(samples) < 25:
            samples += link.receive(0.2)
    except DeviceLost as error:
        yield Finding("tool", "FAULT", str(error), ("tactile doctor names the arm's faults",))
        return
    finally:
        link.close()
    tcp, stated = np.array(samples[-1]["tcp_offset"]), np.array(config.tcp)
    away = float(np.linalg.norm(tcp[:3] - stated[:3]))
    yield _finding(
        "TCP",
        away <= LENGTH and abs(float(stated[2]) - length) <= LENGTH,
        f"bench file z {1e3 * stated[2]:.1f} mm, pendant {1e3 * tcp[2]:.1f} mm, caliper "
        f"{1e3 * length:.1f} mm",
        "measure flange to tip, enter it in the pendant's Installation > TCP and in the bench "
        "file's arm.tcp: poses read at the pendant are those of its own TCP",
    )
    payload = float(samples[-1]["payload"])
    force = np.mean([each["actual_TCP_force"][:3] for each in samples], axis=0)
    heavier = -float(force[2]) / GRAVITY
    size = float(np.linalg.norm(force))
    yield _finding(
        "payload",
        abs(payload - config.payload) <= MASS and size <= FREE,
        f"bench file {config.payload:.2f} kg, pendant {payload:.2f} kg; the arm feels {size:.1f} N "
        "at the free tool",
        "take everything off the tip; weigh flange, gripper and indenter"
        + (f" (about {payload + heavier:.2f} kg by the arm's own force)" if size > FREE else "")
        + "; enter it in the pendant's Installation > Payload and in arm.payload_kg",
    )


def read_for(bench: Bench, name: str, clock: Clock, seconds: float) -> list[Any]:
    """Return the values of a stream's samples for a time [s], those that have settled."""
    driver = bench.row(name).driver(clock)
    try:
        driver.open(bench.preflight.timeout)
        end_ns = clock.now_ns() + round(seconds * SECOND_NS)
        samples: list[dict[str, Any]] = []
        while not samples or clock.now_ns() < end_ns:
            samples += driver.read(0.1)
    finally:
        driver.close()
    return [each["value"] for each in samples if each.get("settled", True)]


def mean_of(values: Sequence[Any]) -> np.ndarray:
    """Return the mean of samples of a gauge (6,) or of taxels (n, 3)."""
    return np.asarray(np.mean(np.asarray(values, float), axis=0))


def weight(row: BenchStream, change: np.ndarray, mass: float) -> Finding:
    """Return the finding of a known mass [kg] on the sensor, by the change (3,) of a gauge [N]."""
    name, expected = f"{row.name} weight", GRAVITY * mass
    measured = ["Fx", "Fy", "Fz"]
    mask = np.array([axis in row.config.axes_measured for axis in measured])
    change = np.where(mask, change, 0.0)
    text = f"{expected:.2f} N laid on, felt " + ", ".join(
        f"{axis} {value:+.3f}" for axis, value in zip(measured, change, strict=True)
    )
    size, down = float(np.linalg.norm(change)), float(change[2])
    if size < FELT * expected:
        return _finding(
            name,
            False,
            f"{text}: nothing",
            "is the weight on the sensor, and does the gauge carry the sensor?",
            f"is this the gauge? {row.key} may be the address or port of another device",
        )
    if abs(down) < 0.7 * size:
        axis = measured[int(np.argmax(np.abs(change)))]
        return _finding(
            name,
            False,
            f"{text}: along {axis}",
            "order of the gauge's channels or cables, then its mounting: z of the gauge must be "
            "along z of the contact frame",
        )
    wrong, cures = [], []
    if down > 0:
        wrong.append("with the wrong sign")
        cures.append(
            "pressing must give a negative Fz: turn the gauge's frame by 180 degrees about x "
            "(its tool transformation), or mount it the other way up"
        )
    ratio = abs(down) / expected
    if abs(ratio - 1) > SCALE:
        wrong.append(f"{ratio:.3g} times too {'large' if ratio > 1 else 'small'}")
        near = min(RATIOS, key=lambda each: abs(math.log(ratio / each)))
        if abs(ratio / near - 1) < SCALE:
            cures.append(RATIOS[near])
        cures += [
            f"weigh the weight: {1e3 * ratio * mass:.0f} g would fit",
            "calibration file and serial number of this very transducer",
        ]
    if wrong:
        return Finding(name, "FAULT", f"{text}: {', '.join(wrong)}", tuple(cures))
    return Finding(name, "well", f"{text}: {100 * (ratio - 1):+.1f} %")


def direction(row: BenchStream, before: Sequence[Any], after: Sequence[Any]) -> np.ndarray:
    """Return the change (2,) along x and y: of a gauge [N], of taxels, of a picture [px].

    The picture is that of a camera that sees x to the right and y upwards.
    """
    if row.kind != "camera":
        moved = mean_of(after) - mean_of(before)
        return np.asarray(moved.reshape(-1, moved.shape[-1])[:, :2].mean(axis=0))
    return shift(whole_grey(before[-1]), whole_grey(after[-1]))


def axes(
    row: BenchStream, along_x: np.ndarray, along_y: np.ndarray, still: float, expected: float
) -> Finding:
    """Return the finding of pushes along +x and +y, by the changes (2,) that a stream showed.

    The changes are those of `direction`, `still` the largest one while a finger was held still.
    The force that is expected of the finger is in [N].
    """
    name = f"{row.name} axes"
    state: State = "FAULT" if row.kind == "force" else "note"
    least = max(STILL * still, PUSHED * expected if row.kind == "force" else 0.0)
    unit = {"force": "N", "camera": "px"}.get(row.kind, "counts")
    pushes = "; ".join(
        f"push along +{axis}: {way[0]:+.2f}, {way[1]:+.2f} {unit}"
        for axis, way in (("x", along_x), ("y", along_y))
    )
    if min(np.linalg.norm(along_x), np.linalg.norm(along_y)) < least:
        cures = ("push the middle of the sensor sideways without slipping, harder",)
        return Finding(name, state, f"{pushes}: too little, at least {least:.2g} {unit}", cures)
    ways = [_nearest(along_x), _nearest(along_y)]
    if ways == ["+x", "+y"]:
        return Finding(name, "well", pushes)
    text = f"{pushes}: +x appears as {ways[0]}, +y as {ways[1]}"
    turned = {"-x": 180, "+y": 90, "-y": 270}.get(ways[0])
    if (ways[0], ways[1]) in (("-x", "-y"), ("+y", "-x"), ("-y", "+x")):
        cure = (
            f"{row.name} is mounted turned by {turned} degrees about z: turn it back, turn the "
            "frame (rotation of its tool transformation), or contact_frame.rotation_deg"
        )
    else:
        cure = "two axes are swapped or one is inverted: channels, cables, mirrored picture"
    return Finding(name, state, text, (cure,))


def _nearest(way: np.ndarray) -> str:
    axis = int(np.argmax(np.abs(way)))
    return f"{'-' if way[axis] < 0 else '+'}{'xy'[axis]}"


def touch(bench: Bench, before: Sequence[Any], after: Sequence[Any]) -> Finding:
    """Return the finding of a light touch, which the signal must show on a bench without a gauge.

    Of the samples `before` are those without contact, 16 or more.
    """
    stand_ins, row, _ = bench.without_gauge
    level = SignalLevel(is_image=row.kind == "camera")
    for sample in before:
        level.of(reading(sample))
    level.zero()
    levels = [level.of(reading(sample)) for sample in after]
    change, motion = (max(each[k] for each in levels) for k in (0, 1))
    unit = "px" if row.kind == "camera" else "counts"
    text = (
        f"a touch changes {row.name} by {change:.0f} standard deviations of its noise, motion "
        f"{motion:.3g} {unit} of {stand_ins.signal_max:g}"
    )
    return _finding(
        f"{row.name} touch",
        change > CONTACT and motion < stand_ins.signal_max,
        f"{text}; {CONTACT:.0f} end an approach",
        f"is {row.key} the device of this sensor? Light and focus of its camera; a lighter touch "
        "if the motion is beyond stand_ins.signal_max",
    )


def camera(row: BenchStream, picture: Any, dev: Path = Path("/dev")) -> Iterator[Finding]:
    """Yield findings of a camera's name, exposure and focus, from one picture at rest."""
    name = stable_name(str(row.config.address), dev)
    if name is not None:
        cure = f"{row.key}.address: {name}" if name else "a name of /dev/v4l/by-id"
        text = f"{row.config.address} may be another device after the next start"
        yield Finding(f"{row.name} name", "note", text, (cure,))
    grey = whole_grey(picture).astype(np.float32)
    saturated = float(np.mean(grey >= SATURATED))
    brightest = float(np.quantile(grey, 0.99))
    exposure = "exposure on the camera's own server"
    if hasattr(row.config, "exposure"):
        set_to = row.config.exposure and f" (now {1e3 * row.config.exposure:g})"
        exposure = f"{row.key}.exposure_ms{set_to or ''} below one period"
    text = f"{saturated:.1%} of the picture saturated, brightest parts {brightest:.0f} of 255"
    if saturated > SATURATED_MOST:
        cure = f"a shorter {exposure}, or less light"
    else:
        cure = f"a longer {exposure}, or more light"
    good = saturated <= SATURATED_MOST and brightest >= BRIGHTEST_LEAST
    yield _finding(f"{row.name} exposure", good, text, cure)
    width = edge_width(grey)
    yield _finding(
        f"{row.name} focus",
        width <= EDGE_MOST,
        f"edges are {width:.1f} px wide, {EDGE_MOST:g} at most",
        "turn the lens until the edges are thinnest; without markers, lay print on the sensor",
    )


def edge_width(grey: np.ndarray) -> float:
    """Return the width of the sharpest edges of a picture, in pixels of one 640 px wide.

    It is the range of grey values over their steepest slope.
    """
    smooth = (grey[:-1, :-1] + grey[1:, :-1] + grey[:-1, 1:] + grey[1:, 1:]) / 4
    down, across = np.gradient(smooth)
    steepest = float(np.quantile(np.hypot(down, across), 0.995))
    low, high = np.quantile(smooth, (0.01, 0.99))
    return float(high - low) / max(steepest, 1e-6) * 640.0 / float(grey.shape[1])


def stable_name(address: str, dev: Path = Path("/dev")) -> str | None:
    """Return the name of a device that stays; None if the address is one, empty if it has none."""
    if not _UNSTABLE.fullmatch(address):
        return None
    node = dev / (f"video{address}" if address.isdigit() else Path(address).name)
    links = sorted([*dev.glob("v4l/by-id/*"), *dev.glob("serial/by-id/*")])
    return next((str(link) for link in links if link.resolve() == node.resolve()), "")


def contact(bench: Bench, pose: Sequence[float] | np.ndarray) -> Finding:
    """Return the finding of a pose (6,) [m, rad] at which the tip just touches the middle."""
    x, y, z = bench.tip(pose)
    close = abs(z) <= ALONG and math.hypot(x, y) <= ACROSS
    return _finding(
        "contact",
        close,
        f"the tip touches at x {1e3 * x:+.2f}, y {1e3 * y:+.2f}, z {1e3 * z:+.2f} mm of "
        "contact_frame",
        origin_text(bench, (x, y, z)).partition("\n")[2].partition("\nthen")[0],
        "if the numbers look like another place: the pendant's TCP and the bench file's arm.tcp",
    )


def origin_text(bench: Bench, tip: Point) -> str:
    """Return the origin at `tip` (in the current contact frame [m]) as text for a bench file."""
    pose = compose(bench.contact_frame, (*tip, 0.0, 0.0, 0.0))
    position = ", ".join(f"{from_si(float(value), 'mm'):.3f}" for value in pose[:3])
    turn = ", ".join(f"{from_si(value, 'deg'):.3f}" for value in bench.contact_frame[3:])
    moved = ", ".join(f"{from_si(value, 'mm'):+.3f}" for value in tip)
    return (
        f"origin set, [{moved}] mm from the one in the bench file; to keep it, write there:\n"
        f"contact_frame:\n  position_mm: [{position}]\n  rotation_deg: [{turn}]\n"
        f"then find the surface by force: {next_command('home', sensor=bench.sensor)}"
    )


def _finding(part: str, good: bool, text: str, *cures: str) -> Finding:
    return Finding(part, "well" if good else "FAULT", text, () if good else cures)
