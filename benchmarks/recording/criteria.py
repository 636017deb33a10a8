"""Goals of recording, and whether this run met them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.recording.alignment import Alignment
from benchmarks.recording.feed import Fed
from benchmarks.recording.load import Cameras
from benchmarks.recording.store_benchmark import StoreRow

# Maximum time to append a frame, p99 [s].
APPEND_P99 = 5e-3
# Maximum CPU share of two lossless cameras and all other streams, of one core.
CORE = 0.60
# Minimum number of images per second of CPU time in random windows.
WINDOW_IMAGES = 2500.0
# Minimum fraction of the speed of decoding from memory, in random windows of JPEG images.
OF_DECODING = 0.9
# Maximum number of frames lost to a kill -9.
LOST = 1
_KINDS = {
    "ours-jpeg": "camera's JPEG",
    "ours-zstd": "lossless",
    "ours-decoded": "lossless of decoded JPEG",
}


@dataclass(frozen=True, slots=True)
class Criterion:
    """One goal, and whether it was met."""

    text: str
    measured: str
    met: bool


def of_stores(rows: Sequence[StoreRow]) -> list[Criterion]:
    """Check kills, window reads and writing of our own stores."""
    ours = {row.key: row for row in rows if row.key.startswith("ours")}
    criteria = []
    kills = [kill for row in ours.values() for kill in row.kills]
    if kills:
        lost = [kill.accepted - (kill.repaired or 0) for kill in kills]
        wrong = sum(kill.wrong for kill in kills)
        criteria.append(
            Criterion(
                f"kill -9: at most {LOST} frame lost, none invented",
                f"{max(lost)} lost at most, {wrong} invented, in {len(kills)} kills",
                max(lost) <= LOST and not wrong,
            )
        )
    for row in ours.values():
        if not row.read_cpu:
            continue
        name = f"random windows of 16, {_KINDS[row.key]}, warm"
        criteria.append(
            Criterion(
                f"{name}: {WINDOW_IMAGES:,.0f} images per CPU-second or more",
                f"{row.read_cpu:,.0f} images per CPU-second",
                row.read_cpu >= WINDOW_IMAGES,
            )
        )
        if row.decode_cpu:
            fraction = row.read_cpu / row.decode_cpu
            criteria.append(
                Criterion(
                    f"{name}: {100 * OF_DECODING:g} % of the JPEG decoder alone or more",
                    f"{100 * fraction:.0f} % of {row.decode_cpu:,.0f} images per CPU-second",
                    fraction >= OF_DECODING,
                )
            )
    criteria += _of_writing(rows)
    return criteria


def _of_writing(rows: Sequence[StoreRow]) -> list[Criterion]:
    """Compare the CPU time of writing with MCAP and with the stores that survive a kill."""
    known = {row.key: row for row in rows if row.write is not None}
    criteria = []
    jpeg, mcap = known.get("ours-jpeg"), known.get("mcap-jpeg")
    if jpeg is not None and mcap is not None:
        criteria.append(
            Criterion(
                "camera's JPEG: as many frames per CPU-second as MCAP's default",
                f"{jpeg.rate_cpu:,.0f}; MCAP {mcap.rate_cpu:,.0f}",
                jpeg.rate_cpu >= mcap.rate_cpu,
            )
        )
    if jpeg is not None and (each := known.get("mcap-each-jpeg")) is not None:
        criteria.append(
            Criterion(
                "camera's JPEG: more frames per CPU-second than MCAP that writes each at once",
                f"{jpeg.rate_cpu:,.0f}; MCAP {each.rate_cpu:,.0f}",
                jpeg.rate_cpu > each.rate_cpu,
            )
        )
    lossless = known.get("ours-zstd")
    others = [
        row
        for row in known.values()
        if row.survives and not row.key.startswith("ours") and not row.key.endswith("jpeg")
    ]
    if lossless is not None and others:
        best = max(others, key=lambda row: row.rate_cpu)
        criteria.append(
            Criterion(
                "lossless: more frames per CPU-second than every store that survives a kill",
                f"{lossless.rate_cpu:,.0f}; {best.title} {best.rate_cpu:,.0f}",
                lossless.rate_cpu > best.rate_cpu,
            )
        )
    return criteria


def of_full_load(fed: Sequence[Fed]) -> list[Criterion]:
    """Check drops, append times and CPU share of all streams at once."""
    dropped = sum(one.dropped for one in fed)
    failed = [one.failure for one in fed if one.failure]
    p99 = max(one.append.p99 for one in fed)
    cores = sum(one.cpu_share for one in fed)
    return [
        Criterion(
            "two lossless cameras at 60 Hz, force 1 kHz, pose 500 Hz, uSkin 60 Hz: nothing dropped",
            f"{dropped} dropped" + (f"; {failed[0]}" if failed else ""),
            not dropped and not failed,
        ),
        Criterion(
            f"the same: append p99 below {1e3 * APPEND_P99:g} ms",
            f"{1e3 * p99:.2f} ms (worst stream)",
            p99 < APPEND_P99,
        ),
        Criterion(
            f"the same: less than {100 * CORE:.0f} % of one core",
            f"{100 * cores:.0f} % of one core, all processes together",
            cores < CORE,
        ),
    ]


def of_cameras(found: Sequence[Cameras]) -> list[Criterion]:
    """Check that the two cameras of the full load can be recorded with margin."""
    return [
        Criterion(
            "two lossless 640x480 cameras at 60 Hz without a drop",
            f"{one.held} cameras" if one.held < one.most else f"{one.held} cameras or more",
            one.held >= 2,
        )
        for one in found
        if one.codec == "zstd"
    ]


def of_alignment(found: Alignment) -> list[Criterion]:
    """Check that the default methods are the most accurate ones."""
    criteria = []
    for stream, default, unit in (("force", "mean", "N"), ("pose", "interpolated", "deg")):
        errors = {
            one.method: one.errors[unit].rms
            for one in found.methods
            if one.stream == stream and unit in one.errors
        }
        if default not in errors:
            continue
        best = min(errors, key=lambda name: errors[name])
        criteria.append(
            Criterion(
                f"the default for {stream} (`{default}`) is as accurate as any",
                f"{errors[default]:.3g} {unit} rms; best: {best}, {errors[best]:.3g} {unit}",
                # Methods that differ by less than 5 % count as equally good.
                errors[default] <= 1.05 * errors[best],
            )
        )
    return criteria
