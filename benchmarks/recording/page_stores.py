"""Section of the page on stores: speed, size, and recovery after a kill -9."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from benchmarks.recording.markdown import ms, table
from benchmarks.recording.store_benchmark import Kill, StoreRow
from recorder import camera_spec
from recorder.store.layout import CHUNKS_PER_SHARD

# File of the chart, in images/ next to the page.
STORES_CHART = "recording-stores.png"
# LeRobot 0.4.4 on two cores in another run, for a page made without LeRobot.
QUOTED = {
    "lerobot-image": "17 frames/s, 450 KB and 101 ms CPU a frame, 144 images/s in windows",
    "lerobot-video": "26 frames/s, 4.3 KB and 44 ms CPU a frame, 208 images/s in windows, lossy",
}


def stores(rows: Sequence[StoreRow]) -> str:
    """Return the section as Markdown."""
    lines = [
        "## Stores side by side",
        "",
        "One after the other, each in its own process: 640x480x3 frames (a gel with noise of "
        "sigma 2 grey levels, or the camera's JPEG of it, quality 90) appended as fast as the "
        "store accepts them, closed and flushed to the disk within the time. Ratios are relative "
        "to our row with the same kind of frame. Windows are 16 consecutive images at random, "
        "decoded to RGB, files in the page cache.",
        "",
        f"![Frames per second, written and read]({'images/' + STORES_CHART})",
        "",
    ]
    body = [_store_row(row, _base(rows, row)) for row in rows]
    lines.append(
        table(
            (
                "store",
                "frames/s",
                "ratio",
                "MB/s stored",
                "append p50 / p99 / max [ms]",
                "KB a frame",
                "CPU [ms a frame]",
                "windows, 1 process [images/s]",
                "2 processes",
                "ratio",
            ),
            body,
        )
    )
    notes = [f"- {row.title}: {row.read_failure}" for row in rows if row.read_failure]
    quoted = [
        f"- {row.title}: {row.missing}; measured in another run: {QUOTED[row.key]}"
        for row in rows
        if row.missing and row.key in QUOTED
    ]
    if notes or quoted:
        lines += ["Not measured here:", "", *notes, *quoted, ""]
    lines += [
        "Append is the duration of the call alone: LeRobot and MCAP pass the frame to threads or "
        "buffers and do the work later, which frames/s and CPU include.",
        "",
        "### After a kill -9",
        "",
        "The writer is killed while it appends; a frame is accepted once its append has returned. "
        "Every frame carries its number, so zeros and torn frames are not mistaken for data.",
        "",
        table(
            (
                "store",
                "accepted",
                "its reader finds",
                "and shows torn or zero",
                "after its own repair",
                "lost",
            ),
            [_kill_row(row.title, row.kills) for row in rows if row.kills],
        ),
        "Our reader sees sealed frames only, never a missing one; at 60 Hz, frames are sealed "
        f"{camera_spec(60.0).block * CHUNKS_PER_SHARD:,} rows at a time, or all of them on "
        "closing. `recover` (or the next run) restores the rest.",
        "",
    ]
    return "\n".join(lines)


def _base(rows: Sequence[StoreRow], row: StoreRow) -> StoreRow | None:
    jpeg = "jpeg" in row.key
    key = "ours-jpeg" if jpeg else "ours-zstd"
    return next((one for one in rows if one.key == key), None)


def _store_row(row: StoreRow, base: StoreRow | None) -> tuple[str, ...]:
    if row.write is None:
        return (row.title, row.missing, *["" for _ in range(8)])
    write, rate = row.write, row.write.frames / row.write.seconds
    base_rate = base.write.frames / base.write.seconds if base and base.write else float("nan")
    base_read = base.read_two if base and base.read_two else float("nan")
    return (
        row.title,
        f"{rate:,.0f}",
        f"{rate / base_rate:.2f}",
        f"{write.nbytes / write.seconds / 1e6:,.0f}",
        ms(write.append),
        f"{write.nbytes / write.frames / 1e3:,.1f}",
        f"{1e3 * write.cpu / write.frames:.2f}",
        f"{row.read:,.0f}" if row.read else "-",
        f"{row.read_two:,.0f}" if row.read_two else "-",
        f"{row.read_two / base_read:.2f}" if row.read_two else "-",
    )


def _kill_row(title: str, kills: Sequence[Kill]) -> tuple[str, ...]:
    def each(values: Iterable[int | None], none: str) -> str:
        return ", ".join(none if value is None else f"{value}" for value in values)

    best = [
        max(kill.left or 0, kill.repaired or 0) if kill.repaired is not None else kill.left or 0
        for kill in kills
    ]
    lost = [kill.accepted - found for kill, found in zip(kills, best, strict=True)]
    return (
        title,
        each([kill.accepted for kill in kills], ""),
        each([kill.left for kill in kills], "does not open"),
        each([kill.wrong for kill in kills], ""),
        each([kill.repaired for kill in kills], "none"),
        each(lost, ""),
    )
