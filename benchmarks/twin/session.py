"""Compare a session of a simulated bench with an offline simulation of its recorded poses.

    python -m benchmarks live-session sessions/x.zarr

The offline simulation solves the `layer` tier at every recorded pose, on a finer grid; its images
are from `sim.markers`. Differences from the recording are the error of live simulation: skipped
poses, interpolated results, a coarser grid, images with filled rims, JPEG and noise.
"""

from __future__ import annotations

import argparse
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from recorder import Session
from sim.errors import SceneError
from sim.indenters import named
from sim.layer import Layer
from sim.sensors import (
    CameraReadout,
    SimulatedSensor,
    SurfaceField,
    TaxelReadout,
    readout,
    sensor_of,
)
from sim.stream.stream import LivePress

Array = NDArray[np.float64]

# Tips more than this above the surface are not in contact [m].
FREE = 1e-3
# Number of images to compare, evenly spaced among those in contact.
IMAGES = 40
_STAMP = re.compile(rb"state_t_ns=(-?\d+)")


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """Recording of a simulated sensor in a session; times [ns] are on the session's clock."""

    sensor: SimulatedSensor
    indenter: str
    gauge_depth: float
    """Depth of the F/T sensor's origin below the undeformed surface [m]."""
    time: NDArray[np.int64]
    """Time of each pose (n,)."""
    tip: Array
    """(n, 3) [m] in the contact frame."""
    force_time: NDArray[np.int64]
    wrench: Array
    """(m, 6) [N, N m], without the tare."""


def recorded(session: Session) -> Recorded:
    """Return the poses and forces of a session.

    Raises:
        SceneError: The session was recorded with another world.
    """
    world = session.attrs["bench"].get("world") or {}
    if world.get("kind") != "simulated":
        raise SceneError(
            f"session.bench.world.kind: {world.get('kind')!r}; allowed: 'simulated', a session "
            "that was recorded with --world sim"
        )
    name = str(world["sensor"])
    row = sensor_of(name)
    pose, force = session.streams["pose"], session.streams["force"]
    frame = np.asarray(session.attrs["contact_frame"])
    place = np.asarray(pose.array("value"))[: len(pose.t_ns), :3] - frame[:3]
    wrench = np.asarray(force.array("value"))[: len(force.t_ns)]
    return Recorded(
        sensor=row,
        indenter=str(session.attrs["indenter"]),
        gauge_depth=1e-3 * float(world.get("gauge_depth_mm", 20.0)),
        time=np.asarray(pose.t_ns),
        tip=Rotation.from_rotvec(frame[3:]).inv().apply(place),
        force_time=np.asarray(force.t_ns),
        wrench=wrench + np.asarray(force.attrs["bias"]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Offline:
    """Offline simulation of the recorded poses."""

    wrench: Array
    """Wrench at each pose (n, 6), about the F/T sensor's origin [N, N m]."""
    top: SurfaceField
    """Surface at each of the requested times."""


def simulated(found: Recorded, wanted: NDArray[np.int64], layer: Layer = Layer()) -> Offline:
    """Solve the contact at every recorded pose; keep the deformation at the times `wanted` (k,)."""
    live = LivePress(
        found.sensor, named(found.indenter), grid=layer.grid, tolerance=layer.tolerance
    )
    wrench = np.zeros((len(found.time), 6))
    keep: dict[int, list[int]] = {}
    for place, time in enumerate(wanted):
        after = int(np.clip(np.searchsorted(found.time, time), 1, len(found.time) - 1))
        nearer = after - int(time - found.time[after - 1] < found.time[after] - time)
        keep.setdefault(nearer, []).append(place)
    surface = np.zeros((len(wanted), *live.grid.shape, 3), np.float32)
    before = found.time[0]
    for row, (time, tip) in enumerate(zip(found.time, found.tip, strict=True)):
        live.move(tip, 1e-9 * float(time - before))
        before = time
        if live.touching:
            each = live.wrench
            lever = live.tip + np.array([0.0, 0.0, found.gauge_depth])
            wrench[row] = each
            wrench[row, 3:] += np.cross(lever, each[:3])
        for place in keep.get(row, ()):
            surface[place] = live.field.displacement[0]
    return Offline(wrench, replace(live.field, displacement=surface))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("session", type=Path)
    parser.add_argument(
        "--grid",
        type=int,
        default=Layer().grid,
        help="grid of the offline simulation (%(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Compare, print and return the exit code."""
    session = Session(options.session)
    found = recorded(session)
    pressed = found.time[found.tip[:, 2] < 0]
    if not len(pressed):
        raise SceneError("session: no pose below the surface; allowed: at least one target")
    images = _images(session, pressed) if "camera" in session.streams else {}
    scans = _scans(session, pressed) if "taxels" in session.streams else {}
    wanted = np.array([*images, *scans], np.int64)
    offline = simulated(found, wanted, Layer(options.grid))
    print("\n".join(force_lines(found, offline.wrench)))
    reader = readout(found.sensor)
    if isinstance(reader, CameraReadout):
        print("\n".join(image_lines(list(images.values()), reader, offline.top)))
    elif isinstance(reader, TaxelReadout):
        print("\n".join(taxel_lines(np.array(list(scans.values())), reader.raw(offline.top))))
    return 0


def force_lines(found: Recorded, wrench: Array) -> Iterator[str]:
    """Yield the differences of the recorded forces from the offline ones in contact, by axis."""
    inside = (found.force_time >= found.time[0]) & (found.force_time <= found.time[-1])
    times = (found.force_time[inside] - found.time[0]).astype(float)
    known = (found.time - found.time[0]).astype(float)
    offline = np.stack([np.interp(times, known, axis) for axis in wrench.T], axis=1)
    depth = np.interp(times, known, -found.tip[:, 2])
    contact = depth > 0
    error, offline = (found.wrench[inside] - offline)[contact], offline[contact]
    yield "axis   rms error   p99 error   worst error   largest force   (recorded less offline)"
    for axis, name in enumerate("xyz"):
        size = np.abs(error[:, axis])
        yield (
            f"F{name}   {np.sqrt((size**2).mean()):7.4f} N   {np.percentile(size, 99):7.4f} N   "
            f"{size.max():9.4f} N   {np.abs(offline[:, axis]).max():11.3f} N"
        )


def image_lines(
    images: Sequence[NDArray[np.uint8]], reader: CameraReadout, top: SurfaceField
) -> Iterator[str]:
    """Yield the IoU of the markers in the recorded images and the offline ones."""
    found = []
    for row, image in enumerate(images):
        one = SurfaceField(top.x, top.y, top.displacement[row : row + 1])
        expected = reader.masks(one)[0, 0]
        seen = markers_in(image, expected)
        found.append((seen & expected).sum() / max((seen | expected).sum(), 1))
    undeformed = reader.masks(SurfaceField(top.x, top.y, 0 * top.displacement[:1]))[0, 0]
    yield (
        f"{len(found)} images of contact: IoU of markers {min(found):.4f} minimum, "
        f"{np.mean(found):.4f} mean; markers are {undeformed.mean():.1%} of the pixels"
    )


def markers_in(image: NDArray[np.uint8], expected: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return pixels (480, 640) whose grey is nearer to the ink than to the gel around it.

    The two greys are the medians of pixels with and without an expected marker, which hardly
    depend on small displacements.
    """
    grey = image.astype(float).mean(axis=-1)
    ink, gel = np.median(grey[expected]), np.median(grey[~expected])
    nearer: NDArray[np.bool_] = np.abs(grey - ink) < np.abs(grey - gel)
    return nearer


def taxel_lines(counts: NDArray[np.int32], offline: NDArray[np.int32]) -> Iterator[str]:
    """Yield the differences of recorded counts from the offline ones."""
    change = np.ptp(offline, axis=0).max(axis=0)
    error = counts - offline
    yield "axis   rms error   worst error   largest change [counts]"
    for axis, name in enumerate("xyz"):
        size = np.abs(error[..., axis])
        yield (
            f"{name}   {np.sqrt((size.astype(float) ** 2).mean()):10.1f}   {size.max():10d}   "
            f"{change[axis]:10d}"
        )


def _images(session: Session, pressed: NDArray[np.int64]) -> dict[int, NDArray[np.uint8]]:
    """Return images in contact, by the stamped time of the state that they show [ns]."""
    stream: Any = session.streams["camera"]
    inside = np.flatnonzero((stream.t_ns > pressed[0]) & (stream.t_ns < pressed[-1]))
    found: dict[int, NDArray[np.uint8]] = {}
    for row in inside[:: max(1, len(inside) // IMAGES)]:
        jpeg = stream.jpeg(int(row))
        stamp = _STAMP.search(jpeg or b"")
        if jpeg is None or stamp is None:
            continue
        time = int(stamp[1])
        if np.abs(pressed - time).min() < 2_000_000:
            found[time] = np.asarray(Image.open(io.BytesIO(jpeg)).convert("RGB"))
    return found


def _scans(session: Session, pressed: NDArray[np.int64]) -> dict[int, NDArray[np.int32]]:
    """Return scans in contact, by their time of arrival [ns]."""
    stream: Any = session.streams["taxels"]
    values = np.asarray(stream.array("value"))[: len(stream.t_ns)]
    near = np.searchsorted(pressed, stream.t_ns)
    inside = (near > 0) & (near < len(pressed))
    gap = np.full(len(near), np.iinfo(np.int64).max)
    gap[inside] = stream.t_ns[inside] - pressed[near[inside] - 1]
    return {int(stream.t_ns[row]): values[row] for row in np.flatnonzero(gap < 4_000_000)}
