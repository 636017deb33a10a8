"""Import a recording as a session, atomically."""

from __future__ import annotations

import datetime
import hashlib
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recorder.convert.import_force import Wrenches, read_force
from recorder.convert.import_taxels import Counts, TaxelOrder, read_taxels
from recorder.convert.import_video import Film, open_film
from recorder.errors import SessionError
from recorder.session.stream_writer import StreamWriter
from recorder.session.writer import SessionWriter
from recorder.spec import StreamSpec, camera_spec, force_spec, signal_of, taxels_spec
from recorder.store.durable import sync_directory

# Files to import and their metadata.

_BLOCK = 1 << 20
# Stream of a file that has no name of its own, and the option of its rate, by option of the file.
_STREAMS = {
    "video": ("camera", "fps"),
    "force": ("force", "force_hz"),
    "taxels": ("taxels", "taxels_hz"),
}

# One file, or several by the name of their stream; rates likewise.
Files = Path | Mapping[str, Path] | None
Rates = float | Mapping[str, float] | None


@dataclass(frozen=True, slots=True)
class _File:
    """One file to import."""

    option: str
    """A key of `_STREAMS`."""
    stream: str
    """Name of its stream."""
    path: Path
    rate_hz: float | None
    """Rate that was given."""

    @property
    def label(self) -> str:
        """Name in messages and attributes: the option, or the stream if that has its own name."""
        return self.option if self.stream == _STREAMS[self.option][0] else self.stream


@dataclass(frozen=True, slots=True)
class ImportRequest:
    """Files of one recording that start together, and metadata that they do not contain."""

    out: Path
    """The session to write."""
    sensor: str
    """Name of the sensor."""
    indenter: str
    """Name of the object that touched it."""
    video: Files = None
    """Video file, or folder of images."""
    force: Files = None
    """Forces: .csv or .npy."""
    taxels: Files = None
    """Taxel counts: .npy."""
    fps: Rates = None
    """Images per second; None takes the rate of the video."""
    force_hz: Rates = None
    """Force rows per second; None takes the time column."""
    taxels_hz: Rates = None
    """Taxel rows per second."""
    taxel_order: TaxelOrder | None = None
    """Order of the numbers in a row of taxels; None tells it by the resting counts."""
    units: str | None = None
    """Unit of forces without a unit."""
    torque_units: str | None = None
    """Unit of torques without a unit."""
    ignore: tuple[str, ...] = ()
    """Force columns to leave out."""
    trim: bool = False
    """If true, cut all to the shortest instead of rejecting recordings of unequal length."""
    operator: str = ""
    """Person who made the recording."""

    def __post_init__(self) -> None:
        """Reject a request without files, and impossible rates.

        Raises:
            SessionError: The message names the option.
        """
        found = self.parts
        if not found:
            raise SessionError("found nothing to import; say --video, --force or --taxels")
        for option, (_, name) in _STREAMS.items():
            rates = getattr(self, name)
            flag = "--" + name.replace("_", "-")
            streams = [part.stream for part in found if part.option == option]
            given = rates if isinstance(rates, Mapping) else {"": rates}
            for stream, rate in given.items():
                if rate is None:
                    continue
                if not 0 < rate <= 100_000:
                    raise SessionError(f"{flag}: found {rate:g}; allowed: above 0 to 100000")
                if not streams or stream not in ("", *streams):
                    of = f" of {stream}" if stream else ""
                    raise SessionError(
                        f"{flag}: found {rate:g}{of} without the file it is the rate of"
                    )

    @property
    def parts(self) -> list[_File]:
        """Files in the order of the options."""
        found = []
        for option, (default, rate) in _STREAMS.items():
            files, rates = getattr(self, option), getattr(self, rate)
            named = files if isinstance(files, Mapping) else {default: files}
            for stream, path in named.items():
                if path is not None:
                    own = rates.get(stream) if isinstance(rates, Mapping) else rates
                    found.append(_File(option, stream, path, own))
        return found

    def files(self) -> dict[str, dict[str, Any]]:
        """Return name and SHA-256 of each file; for a folder, over its files in order of the names.

        Raises:
            OSError: A file cannot be read.
        """
        return {
            part.label: {"name": part.path.name, "sha256": _sha256(part.path)}
            for part in self.parts
        }


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    files = sorted(e for e in path.iterdir() if e.is_file()) if path.is_dir() else [path]
    for file in files:
        if path.is_dir():
            digest.update(f"{file.name} {file.stat().st_size}\n".encode())
        with file.open("rb") as content:
            while block := content.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


Progress = Callable[[int, int], None]
Rows = Iterator[dict[str, Any]]

_IMPORTING = ".importing"
# Recordings may differ in length by this fraction, or by this duration [s].
_LENGTH_TOLERANCE = 0.05
_LENGTH_LEAST = 0.1


def import_session(request: ImportRequest, progress: Progress | None = None) -> list[str]:
    """Write `request.out` and return messages on assumptions and changes.

    Args:
        request: Files to import.
        progress: Called with the number of rows written and the total.

    Raises:
        SessionError: The files are invalid; nothing is left behind.
        OSError: A file cannot be read, or the disk is full; nothing is left behind.
    """
    if request.out.exists():
        raise SessionError(f"{request.out}: exists already; choose another name")
    opened = {part: _open(part, request) for part in request.parts}
    seconds = {part.label: content.seconds for part, content in opened.items()}
    assumed = ["all files start together"] if len(seconds) > 1 else []
    for content in opened.values():
        assumed += content.assumed
    end = _common_end(seconds, request.trim)
    if end < max(seconds.values()):
        assumed.append(f"all cut to {end:.3f} s, the length of the shortest")
    building = request.out.with_name(request.out.name + _IMPORTING)
    shutil.rmtree(building, ignore_errors=True)
    try:
        _write(building, request, _streams(opened, end), assumed, progress)
        building.rename(request.out)
    finally:
        shutil.rmtree(building, ignore_errors=True)
    sync_directory(request.out.parent)
    return assumed


def _open(part: _File, request: ImportRequest) -> Film | Wrenches | Counts:
    """Return the content of a file."""
    if part.option == "video":
        return open_film(part.path, part.rate_hz)
    if part.option == "taxels":
        return read_taxels(part.path, part.rate_hz, request.taxel_order)
    return read_force(
        part.path,
        rate_hz=part.rate_hz,
        force_unit=request.units,
        torque_unit=request.torque_units,
        ignore=request.ignore,
    )


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
    opened: Mapping[_File, Film | Wrenches | Counts], end: float
) -> list[tuple[StreamSpec, int, Rows]]:
    """Return spec, number of rows and rows of each stream, up to `end` [s]."""
    found: list[tuple[StreamSpec, int, Rows]] = []
    end_ns = round(end * 1e9)
    for part, content in opened.items():
        device = {"device": "imported", "rate_hz": content.rate_hz}
        if isinstance(content, Film):
            height, width = content.shape
            spec = camera_spec(
                content.rate_hz,
                name=part.stream,
                height=height,
                width=width,
                codec=content.codec,
                device=device,
                clock="none",
            )
            times = _every(np.array(content.places), content.rate_hz)
            count = int((times < end_ns).sum())
            found.append((spec, count, _images(content, times[:count])))
        elif isinstance(content, Wrenches):
            counted = {"clock": "none", "numbering": "host", **content.attrs}
            spec = force_spec(content.rate_hz, name=part.stream, **counted)
            count = int((content.t_ns < end_ns).sum())
            found.append((spec, count, _forces(content, count)))
        else:
            counted = {"clock": "none", "numbering": "host", "device": device}
            spec = taxels_spec(content.rate_hz, name=part.stream, **counted)
            times = _every(np.arange(len(content.value)), content.rate_hz)
            count = int((times < end_ns).sum())
            found.append((spec, count, _scans(content, times[:count])))
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
    request: ImportRequest,
    streams: list[tuple[StreamSpec, int, Rows]],
    assumed: list[str],
    progress: Progress | None,
) -> None:
    now = datetime.datetime.now(datetime.UTC).isoformat()
    attrs = {
        "mock": False,
        "sensor": request.sensor,
        "indenter": request.indenter,
        **({"operator": request.operator} if request.operator else {}),
        "calibration": {},
        "imported": {"files": request.files(), "assumed": assumed, "utc": now},
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
        # These samples have no time on this host's clock: their times begin at 0.
        session.begin_run({"t0_ns": 0, "utc": None, "boot_id": "imported"})
        for spec, _, rows in streams:
            with StreamWriter.open(session.stream_path(spec.name)) as writer:
                for row in rows:
                    writer.append(**row)
                    done += 1
                    if progress is not None:
                        progress(done, total)
        signal = signal_of((spec.name, spec.traits) for spec in specs) or specs[0].name
        rate_hz = next(spec.rate_hz for spec in specs if spec.name == signal)
        session.finish("complete", rate_hz=rate_hz)
