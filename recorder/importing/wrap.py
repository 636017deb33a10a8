"""Writes the session of an import: whole, or not at all."""

import datetime
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from recorder.durable import sync_directory
from recorder.errors import SessionError
from recorder.importing.force import Wrenches, read_force
from recorder.importing.sources import ImportOrder
from recorder.importing.taxels import Counts, read_taxels
from recorder.importing.video import Film, open_film
from recorder.session import SessionWriter
from recorder.spec import StreamSpec, camera_spec, force_spec, taxels_spec
from recorder.writer import StreamWriter

Progress = Callable[[int, int], None]
Rows = Iterator[dict[str, Any]]

_IMPORTING = ".importing"
_LENGTH_TOLERANCE = 0.05
_LENGTH_LEAST = 0.1
"""Recordings may differ in length by this share, or this long [s]."""


def import_session(order: ImportOrder, progress: Progress | None = None) -> list[str]:
    """Write `order.out` and return what was assumed or changed, in words.

    Args:
        order: What to import.
        progress: Called with the rows written and their number.

    Raises:
        SessionError: Something in the files is wrong; nothing is left behind.
        OSError: A file cannot be read, or the disk is full; nothing is left behind.
    """
    if order.out.exists():
        raise SessionError(f"{order.out}: exists already; choose another name")
    film = None if order.video is None else open_film(order.video, order.fps)
    wrenches = None
    if order.force is not None:
        wrenches = read_force(
            order.force,
            rate_hz=order.force_hz,
            force_unit=order.units,
            torque_unit=order.torque_units,
            ignore=order.ignore,
        )
    counts = None if order.taxels is None else read_taxels(order.taxels, order.taxels_hz)
    seconds = {
        name: part.seconds
        for name, part in (("video", film), ("force", wrenches), ("taxels", counts))
        if part is not None
    }
    assumed = ["all files start together"] if len(seconds) > 1 else []
    for part in (film, wrenches, counts):
        assumed += [] if part is None else part.assumed
    end = _common_end(seconds, order.trim)
    if end < max(seconds.values()):
        assumed.append(f"all cut to {end:.3f} s, the length of the shortest")
    building = order.out.with_name(order.out.name + _IMPORTING)
    shutil.rmtree(building, ignore_errors=True)
    try:
        _write(building, order, _streams(film, wrenches, counts, end), assumed, progress)
        building.rename(order.out)
    finally:
        shutil.rmtree(building, ignore_errors=True)
    sync_directory(order.out.parent)
    return assumed


def _common_end(seconds: dict[str, float], trim: bool) -> float:
    shortest, longest = min(seconds.values()), max(seconds.values())
    if trim:
        return shortest
    if longest - shortest > max(_LENGTH_TOLERANCE * longest, _LENGTH_LEAST):
        lengths = ", ".join(f"{name} {length:.3f} s" for name, length in seconds.items())
        raise SessionError(
            f"found recordings of unequal length: {lengths}; are the rates right? "
            "--trim cuts all to the shortest"
        )
    return longest


def _streams(
    film: Film | None, wrenches: Wrenches | None, counts: Counts | None, end: float
) -> list[tuple[StreamSpec, int, Rows]]:
    """Spec, number of rows and rows of each stream, as far as `end` [s]."""
    found: list[tuple[StreamSpec, int, Rows]] = []
    end_ns = round(end * 1e9)
    if film is not None:
        height, width = film.shape
        spec = camera_spec(
            film.rate_hz,
            height=height,
            width=width,
            codec=film.codec,
            device={"device": "imported", "rate_hz": film.rate_hz},
            device_clock="none",
        )
        times = _every(np.array(film.places), film.rate_hz)
        count = int((times < end_ns).sum())
        found.append((spec, count, _images(film, times[:count])))
    if wrenches is not None:
        spec = force_spec(wrenches.rate_hz, **wrenches.attrs)
        count = int((wrenches.t_ns < end_ns).sum())
        found.append((spec, count, _forces(wrenches, count)))
    if counts is not None:
        device = {"device": "imported", "rate_hz": counts.rate_hz}
        spec = taxels_spec(counts.rate_hz, device=device, device_clock="none")
        times = _every(np.arange(len(counts.value)), counts.rate_hz)
        count = int((times < end_ns).sum())
        found.append((spec, count, _scans(counts, times[:count])))
    return found


def _every(places: Any, rate_hz: float) -> Any:
    return np.round(places * (1e9 / rate_hz)).astype(np.int64)


def _images(film: Film, times: Any) -> Rows:
    for t_ns, image in zip(times, film.load(), strict=False):
        yield {"value": image, "device_t": float("nan"), "t_ns": int(t_ns)}


def _forces(wrenches: Wrenches, count: int) -> Rows:
    for row in range(count):
        t_ns = int(wrenches.t_ns[row])
        yield {"value": wrenches.value[row], "seq": row + 1, "status": 0, "t_ns": t_ns}


def _scans(counts: Counts, times: Any) -> Rows:
    for row, t_ns in enumerate(times):
        value = counts.value[row]
        yield {"value": value, "device_t": float("nan"), "seq": row + 1, "t_ns": int(t_ns)}


def _write(
    path: Path,
    order: ImportOrder,
    streams: list[tuple[StreamSpec, int, Rows]],
    assumed: list[str],
    progress: Progress | None,
) -> None:
    now = datetime.datetime.now(datetime.UTC).isoformat()
    attrs = {
        "mock": False,
        "sensor": order.sensor,
        "indenter": order.indenter,
        **({"operator": order.operator} if order.operator else {}),
        "calibration": {},
        "imported": {"files": order.files(), "assumed": assumed, "utc": now},
    }
    no_targets: dict[str, Any] = {
        "point": np.zeros(0, np.int16),
        "depth": np.zeros(0),
        "direction": np.zeros(0, np.int16),
        "planned": np.zeros((0, 3)),
    }
    specs = [spec for spec, _, _ in streams]
    done, total = 0, sum(count for _, count, _ in streams)
    with SessionWriter.create(path, attrs=attrs, streams=specs, targets=no_targets) as session:
        # No clock of this host has seen these samples: their times begin at 0.
        session.begin_run({"t0_ns": 0, "utc": None, "boot_id": "imported"})
        for spec, _, rows in streams:
            with StreamWriter.open(session.stream_path(spec.name)) as writer:
                for row in rows:
                    writer.append(**row)
                    done += 1
                    if progress is not None:
                        progress(done, total)
        signal = next(
            (s for name in ("camera", "taxels", "force") for s in specs if s.name == name), specs[0]
        )
        session.finish("complete", rate_hz=signal.rate_hz)
