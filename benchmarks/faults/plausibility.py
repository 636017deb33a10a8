"""Parts `healthy` and `edits`: short sessions of all benches, as recorded and with edited values.

A session is collected on each mock bench, clean or with an effect that labs see. Its witnesses must
be silent. Then a stream at a time is changed, written again by the recorder's writer, and checked:
a warning or fault that names this stream counts as noticed.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from benchmarks.faults.collection_run import CollectionRun, quick_bench
from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from recorder import SessionWriter, StreamWriter, check
from recorder.checks.plausible import statements
from recorder.findings import Finding
from recorder.processes import Workers
from recorder.session.columns import Stream
from recorder.session.reader import Session
from recorder.session.uncertainty import latency_sigma
from recorder.store.layout import StreamLayout
from rig.core.packaged import BENCHES, OTHERS

Array = NDArray[Any]
Columns = dict[str, Any]
Rng = np.random.Generator
# Changes columns in place, in some rows; returns the time that values are late by [s], if they are.
Change = Callable[[Rng, Columns, slice], float | None]

# Effects of labs, one a session.
LABS = (
    "",
    "pull_off_n: 0.3",
    "drift_n_per_h: 0.3",
    "cable_step_n: 0.2",
    "creep: 0.2",
    "auto_exposure: true",
    "led_warm_up: 0.3",
    "camera_turned_deg: 90",
    "camera_turned_deg: 180",
    "pose_jitter_mm: 0.05",
    "flipped_rotation: true",
    "taxel_rate_hz: 70",
    "fz_only: true",
)
# Benches whose sessions are edited, with an effect of `LABS` for every other one.
EDITED = ("gelsight", "tacpalm", "uskin", "digit", "r10", "array-i", "gelsight-mini", "r14")
# Edits that count are larger than these: forces [N] and over the peak, poses [m], the time that an
# edit lasts [s] and its fraction of the rows, torques over those at the peak, grey levels; and late
# by more than 3 standard deviations of the latency and a frame [s].
FORCE, OF_PEAK, PLACE, LASTS, ROWS, TORQUE, GREY = 0.3, 0.05, 0.3e-3, 0.5, 0.05, 0.3, 3.0
FRAME = 1 / 30
# Warnings of a stream beside the arm, which name the clocks of both.
BESIDE_ARM = ("force-time", "image-time")
# Requirement: edits of 200 that may be missed, and doubt of a healthy session.
MISSED, QUIET = 0.02, 0.5


@dataclass(frozen=True, slots=True)
class Edit:
    """A change of one stream before it is written."""

    name: str
    kind: str
    """Kind of the streams that it changes."""
    change: Change
    whole: bool = False
    """True if it makes sense for all rows alone."""
    beside: bool = False
    """True if only rows that stay as they are tell of it: counts of taxels have no known size."""


def _times(factors: tuple[float, ...], *axes: int) -> Change:
    """Multiply by one of some factors."""

    def change(rng: Rng, columns: Columns, rows: slice) -> None:
        columns["value"][rows, list(axes)] *= rng.choice(factors)

    return change


def _exchanged(*pairs: tuple[int, int]) -> Change:
    def change(rng: Rng, columns: Columns, rows: slice) -> None:
        one, other = pairs[rng.integers(len(pairs))]
        columns["value"][rows, [one, other]] = columns["value"][rows, [other, one]]

    return change


def _added(least: float, most: float, *axes: int) -> Change:
    """Add a constant of some size to one axis."""

    def change(rng: Rng, columns: Columns, rows: slice) -> None:
        size = rng.uniform(least, most) * rng.choice([-1.0, 1.0])
        columns["value"][rows, int(rng.choice(axes))] += size

    return change


def _repeated(rng: Rng, columns: Columns, rows: slice) -> None:
    """Repeat the value that comes first."""
    first = columns["value"][rows.start]
    if isinstance(columns["value"], list):
        columns["value"][rows] = [first] * (rows.stop - rows.start)
    else:
        columns["value"][rows] = first


def _late(rng: Rng, columns: Columns, rows: slice) -> float:
    """Move values against their times by 0.15 to 0.6 s."""
    value, t_ns = columns["value"], columns["t_ns"]
    rate = len(t_ns) / (1e-9 * (t_ns[-1] - t_ns[0]))
    late = rng.uniform(0.15, 0.6)
    shift = round(late * rate) * int(rng.choice([-1, 1]))
    moved = np.clip(np.arange(rows.start, rows.stop) - shift, 0, len(t_ns) - 1)
    columns["value"][rows] = [value[k] for k in moved] if isinstance(value, list) else value[moved]
    return late


def _backward(rng: Rng, columns: Columns, rows: slice) -> None:
    columns["value"][rows] = columns["value"][rows][::-1]


def _turned(rng: Rng, columns: Columns, rows: slice) -> None:
    """Turn the tool by 5 to 40 degrees about an axis of the base."""
    columns["value"][rows, 3 + rng.integers(3)] += rng.uniform(0.09, 0.7)


def _drawn(
    draw: Callable[[Rng, Array], Array],
) -> Change:
    """Change the pixels of pictures, each in the same way."""

    def change(rng: Rng, columns: Columns, rows: slice) -> None:
        seed = int(rng.integers(1 << 30))
        for row in range(rows.start, rows.stop):
            image = np.array(_pixels(columns["value"][row]))
            image = np.ascontiguousarray(draw(np.random.default_rng(seed), image))
            stored = isinstance(columns["value"][row], bytes)
            columns["value"][row] = simplejpeg.encode_jpeg(image, 90) if stored else image

    return change


def _pixels(picture: Any) -> Array:
    return simplejpeg.decode_jpeg(picture) if isinstance(picture, bytes) else np.asarray(picture)


def _about_rest(change: Callable[[Rng, Array], Array]) -> Change:
    """Change counts of taxels (n, m, 3) less those at the beginning."""

    def edit(rng: Rng, columns: Columns, rows: slice) -> None:
        value = columns["value"]
        rest = np.median(value[:20], axis=0)
        changed = rest + change(rng, value[rows] - rest)
        columns["value"][rows] = np.clip(np.rint(changed), 0, 65535).astype(value.dtype)

    return edit


def _dead(rng: Rng, columns: Columns, rows: slice) -> None:
    """Hold the taxel that changes most."""
    value = columns["value"]
    taxel = int(np.ptp(value[:, :, 2], axis=0).argmax())
    columns["value"][rows, taxel] = value[rows.start, taxel]


def _small_turns(image: Array) -> tuple[Array, ...]:
    return image[::-1, ::-1], image[:, ::-1], image[::-1]


EDITS = (
    Edit("unit of all", "force", _times((1e3, 1e-3, 1 / 4.448, 4.448, 9.81, 1 / 9.81), *range(6))),
    Edit("unit of forces", "force", _times((1e3, 1 / 4.448, 4.448, 9.81, 1 / 9.81), 0, 1, 2)),
    Edit("sign of all", "force", _times((-1.0,), *range(6))),
    Edit("sign of Fz", "force", _times((-1.0,), 2)),
    Edit("sign of Fx", "force", _times((-1.0,), 0), whole=True),
    Edit("sign of Fy", "force", _times((-1.0,), 1), whole=True),
    Edit("scale of a side force", "force", _times((0.2, 5.0), 0), whole=True),
    Edit("exchanged forces", "force", _exchanged((0, 2), (1, 2), (0, 1))),
    Edit("offset", "force", _added(0.5, 5.0, 0, 1, 2)),
    Edit("late", "force", _late),
    Edit("repeated", "force", _repeated),
    Edit("backward", "force", _backward),
    Edit("torques in N mm", "force", _times((1e3,), 3, 4, 5)),
    Edit("sign of torques", "force", _times((-1.0,), 3, 4, 5), whole=True),
    Edit("exchanged torques", "force", _exchanged((3, 4)), whole=True),
    Edit("metres as mm", "pose", _times((1e3, 1e-3), 0, 1, 2)),
    Edit("degrees", "pose", _times((57.3,), 3, 4, 5)),
    Edit("moved", "pose", _added(0.6e-3, 5e-3, 0, 1, 2)),
    Edit("late", "pose", _late),
    Edit("repeated", "pose", _repeated),
    Edit("turned tool", "pose", _turned),
    Edit("turned or mirrored", "camera", _drawn(lambda r, one: _small_turns(one)[r.integers(3)])),
    Edit("dark", "camera", _drawn(lambda r, one: one // 8)),
    Edit("late", "camera", _late),
    Edit("repeated", "camera", _repeated),
    Edit("backward", "camera", _backward),
    Edit("sign", "taxels", _about_rest(lambda r, one: -one)),
    Edit("scale", "taxels", _about_rest(lambda r, one: one * r.choice([0.1, 8.0])), beside=True),
    Edit("exchanged axes", "taxels", _about_rest(lambda r, one: one[..., [2, 0, 1]])),
    Edit("mirrored", "taxels", _about_rest(lambda r, one: one[:, ::-1]), whole=True),
    Edit("late", "taxels", _late),
    Edit("repeated", "taxels", _repeated),
    Edit("dead", "taxels", _dead),
)


def measure_healthy(run: Run) -> dict[str, Any]:
    """Collect a session for each bench and effect; return the worst value of each witness."""
    benches = sorted(path.stem for path in BENCHES.glob("*.yaml") if path.stem not in OTHERS)
    # Each bench once, each time with the next effect, and so on: the first part has all of both.
    chosen = [
        (bench, LABS[(turn + k) % len(LABS)])
        for turn in range(len(LABS))
        for k, bench in enumerate(benches)
    ]
    chosen = chosen[: 4 if run.quick else None]
    items = {f"{bench}, {lab or 'clean'}": (bench, lab) for bench, lab in chosen}
    rows = [*rows_of(run, partial(_healthy, run.folder), items).values()]
    worst: dict[str, float] = {}
    for row in rows:
        for code, doubt in row["doubts"].items():
            worst[code] = max(worst.get(code, 0.0), doubt)
        run.failures += [f"{row['session']}: {text}" for text in row["findings"]]
    loud = {code: doubt for code, doubt in worst.items() if doubt > QUIET}
    run.failures += [f"{code}: {doubt:.2f} of its threshold" for code, doubt in loud.items()]
    return {"sessions": len(rows), "worst": worst}


def _healthy(folder: Path, bench_and_lab: tuple[str, str]) -> dict[str, Any]:
    bench, lab = bench_and_lab
    own = folder / f"{bench}-{LABS.index(lab)}"
    own.mkdir()
    path = collected(bench, lab, own / "healthy.zarr", targets=3)
    doubts: dict[str, float] = {}

    def noted(session: Session, **_: Any) -> Iterator[Finding]:
        for one in statements(session):
            code, doubt = one.finding.code, float(np.nan_to_num(one.doubt, posinf=1e9))
            doubts[code] = max(doubts.get(code, 0.0), doubt)
            if one.doubtful:
                yield one.finding

    with patch("recorder.checks.check.doubts", noted):  # all witnesses speak, and once
        found = [each for each in check(path) if each.level != "note"]
    shutil.rmtree(own)
    return {"session": f"{bench}, {lab}", "doubts": doubts, "findings": list(map(str, found))}


def collected(bench: str, lab: str, path: Path, *, targets: int) -> Path:
    """Collect a short session on a mock bench with an effect of `LABS`."""
    shutil.rmtree(path, ignore_errors=True)
    file = quick_bench(path.parent, bench, more=f"world: {{lab: {{{lab}}}}}")
    with CollectionRun.collect(path, "--bench", str(file), "--targets", str(targets)) as command:
        code = command.wait()
    if code:
        raise RuntimeError(f"{bench}, {lab}: exit code {code}:\n{command.text}")
    return path


def measure_edits(run: Run) -> dict[str, Any]:
    """Edit sessions of several benches, and return how many of the edits are noticed."""
    count = 8 if run.quick else 200
    run.seeds = [run.options.seed]
    benches = EDITED[:1] if run.quick else EDITED
    labs = [LABS[1 + k // 2] if k % 2 else "" for k in range(len(benches))]
    rows: list[dict[str, Any]] = []
    with Workers(run.options.processes) as workers:
        recorded = [
            workers.submit(_recorded, run.folder / bench, bench, lab)
            for bench, lab in zip(benches, labs, strict=True)
        ]
        draws = _draws(run.options.seed, [one.result() for one in recorded])
        drawn = [workers.submit(_edited, *next(draws)) for _ in range(2 * count)]
        while (noted := sum(row["counts"] for row in rows)) < count:
            run.progress(noted / count)
            rows.append(drawn[len(rows)].result())
            run.rows[str(len(rows))] = rows[-1]
            run.store()
    missed = [row for row in rows if row["counts"] and not row["noticed"]]
    if len(missed) > MISSED * count:
        run.failures.append(f"{len(missed)} of {count} edits are missed; allowed: {MISSED:.0%}")
    return {"count": count, "missed": len(missed), "rows": rows}


@dataclass(frozen=True, slots=True)
class Recorded:
    """A session to edit."""

    path: Path
    streams: dict[str, str]
    """First stream of each kind."""
    known: frozenset[tuple[str, str]]
    """Codes and places of its findings."""


def _recorded(folder: Path, bench: str, lab: str) -> Recorded:
    folder.mkdir()
    path = collected(bench, lab, folder / f"{bench}.zarr", targets=6)
    session, known = Session(path), {(one.code, one.where) for one in check(path)}
    kinds = {edit.kind: session.of_kind(edit.kind) for edit in EDITS}
    return Recorded(
        path, {kind: names[0] for kind, names in kinds.items() if names}, frozenset(known)
    )


def _draws(seed: int, sessions: list[Recorded]) -> Iterator[tuple[int, int, Recorded]]:
    """Yield a seed, the number of an edit and a session that has its stream, without end."""
    rng = np.random.default_rng(seed)
    while True:
        for number in rng.permutation(len(EDITS)).tolist():
            fitting = [one for one in sessions if EDITS[number].kind in one.streams]
            if fitting:
                yield int(rng.integers(1 << 30)), number, fitting[rng.integers(len(fitting))]


def _edited(seed: int, number: int, recorded: Recorded) -> dict[str, Any]:
    """Edit a stream of a session, write it, check it, and remove it."""
    rng, edit, session = np.random.default_rng(seed), EDITS[number], Session(recorded.path)
    name = recorded.streams[edit.kind]
    stream = session.streams[name]
    before, after = columns_of(stream), columns_of(stream)
    count, rate = len(stream), stream.rate_hz
    how = "whole" if edit.whole else rng.choice(["whole", "from here", "a while"][edit.beside :])
    length = int(min(count // 2, rng.uniform(0.7, 4.0) * rate))
    first = 0 if how == "whole" else int(rng.integers(count // 2 * edit.beside + 1, count - length))
    rows = slice(first, first + length if how == "a while" else count)
    late = edit.change(rng, after, rows)
    least_late = 3 * latency_sigma(stream)[0] + max(1 / rate, FRAME)
    path = session.path.with_name(f"{number}-{seed}.zarr")
    write_edited(session, name, after, path)
    found = [each for each in check(path) if each.level != "note"]
    found = [each for each in found if (each.code, each.where) not in recorded.known]
    shutil.rmtree(path)
    return {
        "edit": f"{edit.kind}: {edit.name}",
        "session": session.path.stem,
        "rows": f"{how} {rows.start}:{rows.stop} of {count}",
        "counts": (late is None or late > least_late) and counts(stream, before, after, rows),
        "noticed": any(
            f"streams/{name}" in each.where or (edit.kind == "pose" and each.code in BESIDE_ARM)
            for each in found
        ),
        "codes": sorted({each.code for each in found}),
    }


def columns_of(stream: Stream) -> Columns:
    """Return all columns of a stream; pictures as a list of bytes or pixels."""
    columns: Columns = {each: np.array(stream.array(each)) for each in stream.small}
    if stream.jpeg_shape is not None:
        columns["value"] = list(stream.jpegs(range(len(stream))))
    elif stream.layout.image is not None:
        columns["value"] = list(stream.images(range(len(stream))))
    return columns


def write_edited(session: Session, name: str, columns: Columns, path: Path) -> None:
    """Write a copy of a session, one stream of which has other rows, with the recorder's writer."""
    shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(session.path, path)
    rate, status = session.rate_hz, session.status
    with SessionWriter.resume(path) as writer:
        layout = StreamLayout.load(writer.stream_path(name))
        for column in layout.columns:
            shutil.rmtree(column.path / "c", ignore_errors=True)
            column.set_rows(0)
        with StreamWriter.open(writer.stream_path(name), sync_interval=60) as stream:
            for row in range(len(columns["t_ns"])):
                stream.append(**{key: values[row] for key, values in columns.items()})
        writer.finish(status, rate_hz=rate)


def counts(stream: Stream, before: Columns, after: Columns, rows: slice) -> bool:
    """Return True if an edit is larger than the floor, for long enough."""
    kind = stream.traits.kind
    enough = min(LASTS * stream.rate_hz, ROWS * len(stream))
    if kind == "camera":
        some = range(rows.start, rows.stop, max(1, (rows.stop - rows.start) // 50))
        size = [
            float(np.abs(_pixels(after["value"][k]) - 1.0 * _pixels(before["value"][k])).mean())
            for k in some
        ]
        return bool(np.mean(np.array(size) > GREY) * (rows.stop - rows.start) > enough)
    old, new = (np.asarray(each["value"], float) for each in (before, after))
    change = np.abs(new - old)
    if kind == "force":
        size = np.linalg.norm(old[:, :3], axis=1)
        peak = float(np.quantile(size, 0.99))
        turning = np.linalg.norm(old[:, 3:], axis=1)
        felt = change[:, :3].max(axis=1) > max(FORCE, OF_PEAK * peak)
        twisted = change[:, 3:].max(axis=1) > TORQUE * np.maximum(turning, 1e-3)
        large = felt | (twisted & (size > 1.0))
    elif kind == "pose":
        large = (change[:, :3].max(axis=1) > PLACE) | (change[:, 3:].max(axis=1) > 0.05)
    else:
        large = change.max(axis=(1, 2)) > OF_PEAK * np.ptp(old, axis=0).max()
    return bool(large.sum() > enough)


def section_healthy(values: dict[str, Any], page: Page) -> str:
    """Return the worst value of each witness over its threshold."""
    rows = sorted(values["worst"].items(), key=lambda item: -item[1])
    head = ("witness", "worst value over its threshold")
    return (
        f"## Healthy sessions\n\n{values['sessions']} sessions of all packaged benches, clean and "
        "with each effect of labs. Half of each threshold may be used.\n\n"
        + table(head, [(f"`{code}`", f"{doubt:.2f}") for code, doubt in rows])
    )


def section_edits(values: dict[str, Any], page: Page) -> str:
    """Return the edits by kind: how many, noticed, and by which code."""
    rows = []
    for name in sorted({row["edit"] for row in values["rows"]}):
        same = [row for row in values["rows"] if row["edit"] == name and row["counts"]]
        codes = sorted({code for row in same for code in row["codes"]})
        noticed = sum(row["noticed"] for row in same)
        rows.append((name, f"{noticed} of {len(same)}", ", ".join(codes)))
    small = [row for row in values["rows"] if not row["counts"]]
    return (
        f"## Edits of recordings\n\n{values['missed']} of {values['count']} edits are missed. "
        f"Of {len(small)} smaller ones {sum(row['noticed'] for row in small)} are noticed.\n\n"
        + table(("edit", "noticed", "codes"), rows)
    )
