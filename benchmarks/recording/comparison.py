"""Part `stores`: frames written, read in random windows and left by a kill, by ours and others."""

import itertools
import shutil
import statistics
import time
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.processes import ChildFailed, alone
from benchmarks.recording import storing
from benchmarks.recording.stores import MCAP, OURS, STORES
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, SKY, chart

# A writer is killed after a random number of frames in this range.
_KILL_AFTER = (70, 300)
_KILL_TIMEOUT = 120.0
# Least rate of random windows of JPEG, relative to MCAP's.
OF_MCAP = 1.5
_BY = {"cpu": "per CPU-second", "seconds": "by the clock"}
_RATES = tuple(itertools.product(("written", "read"), _BY))
# Seconds and bytes of writing, and seconds of reading, of a full run and of a quick one.
_FULL, _QUICK = (3.0, 400_000_000, 1.5), (0.3, 20_000_000, 0.2)


def measure(run: Run) -> list[dict[str, Any]]:
    """Write and read each store once in every repeat, in alternating order; then kill writers."""
    repeats, kills = (1, 1) if run.quick else (run.options.repeats, 2)
    rows: dict[str, dict[str, Any]] = {
        key: {"key": key, "missing": "", "written": [], "read": [], "decoded": [], "kills": []}
        for key in STORES
    }
    orders = [list(STORES), list(STORES)[::-1]]
    steps = [(repeat, key) for repeat in range(repeats) for key in orders[repeat % 2]]
    steps += [(repeats, key) for key in STORES]
    for number, (repeat, key) in enumerate(steps):
        run.progress(number / len(steps))
        row = rows[key]
        if row["missing"]:
            continue
        try:
            if repeat < repeats:
                _measure_once(row, run.folder / f"{key}-{repeat}", run.quick, repeat)
            else:
                row["kills"] = [kill(key, run.folder, seed) for seed in range(kills)]
        except ChildFailed as error:
            row["missing"] = str(error)
    run.seeds = range(repeats)
    run.spread = f"median of {repeats} runs, interleaved" if repeats > 1 else ""
    for key, row in rows.items():
        for each in row["kills"] if STORES[key].ours else ():
            if each["lost"] > 1 or each["wrong"]:
                run.failures.append(f"{key} after a kill: {each}")
    return list(rows.values())


def _measure_once(row: dict[str, Any], path: Path, quick: bool, seed: int) -> None:
    seconds, most_bytes, reading = _QUICK if quick else _FULL
    key = row["key"]
    try:
        row["written"].append(alone(storing.write, key, path, seconds, most_bytes))
        row["read"].append(alone(storing.read, key, path, reading, seed))
        if key == OURS:
            row["decoded"].append(alone(storing.read, "decoder", path, reading, seed))
    finally:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def kill(key: str, folder: Path, seed: int) -> dict[str, Any]:
    """Kill a writer with SIGKILL at a random time and count the remaining frames.

    ChildFailed is raised if it ended by itself, or the result could not be inspected.
    """
    rng = np.random.default_rng(seed)
    path, count = folder / f"killed-{key}-{seed}", folder / f"accepted-{key}-{seed}"
    count.write_bytes(bytes(8))
    wanted = int(rng.integers(*_KILL_AFTER))
    child = get_context("spawn").Process(
        target=storing.append_until_killed, args=(key, path, count)
    )
    child.start()
    deadline = time.monotonic() + _KILL_TIMEOUT
    try:
        while int.from_bytes(count.read_bytes(), "little") < wanted:
            if not child.is_alive() or time.monotonic() > deadline:
                raise ChildFailed(f"{key}: {wanted} frames were not written")
            time.sleep(0.001)
        time.sleep(rng.uniform(0.0, 0.005))
    finally:
        child.kill()
        child.join()
    accepted = int.from_bytes(count.read_bytes(), "little")
    return left_after_kill(accepted, alone(storing.inspect, key, path))


def left_after_kill(accepted: int, inspected: dict[str, Any]) -> dict[str, Any]:
    """Return how many accepted frames a store still has, and how many frames it shows wrongly.

    A frame is there if it is in its place; its own repair counts if it finds more.
    """
    whole = [
        sum(number == place for place, number in enumerate((inspected[way] or [])[:accepted]))
        for way in ("left", "repaired")
    ]
    wrong = sum(number != place for place, number in enumerate(inspected["left"] or []))
    return {"accepted": accepted, "wrong": wrong, "lost": accepted - max(whole)}


def rates(row: dict[str, Any], what: str, by: str) -> list[float]:
    """Return frames a second of each repeat that was `written`, `read` or `decoded`, `by` cpu."""
    return [each["frames"] / each[by] for each in row[what]]


def rate(row: dict[str, Any], what: str, by: str) -> float:
    """Return the median frames a second; 0 if it was not measured."""
    return statistics.median(rates(row, what, by) or [0.0])


def ratios(rows: list[dict[str, Any]], what: str, by: str) -> list[float]:
    """Return our rate of JPEGs divided by that of MCAP, for each repeat."""
    of = {row["key"]: rates(row, what, by) for row in rows}
    return [ours / theirs for ours, theirs in zip(of[OURS], of[MCAP], strict=False)]


def survives(row: dict[str, Any]) -> bool:
    """Return True if frames were left after every kill."""
    return bool(row["kills"]) and all(each["lost"] < each["accepted"] for each in row["kills"])


def goals(rows: list[dict[str, Any]]) -> list[tuple[str, str, bool]]:
    """Return each goal of the stores, the values, and whether they reach it."""
    measured = {row["key"]: row for row in rows if row["written"]}
    lines = []
    kills = [one for key, row in measured.items() if STORES[key].ours for one in row["kills"]]
    if kills:
        lost, wrong = max(one["lost"] for one in kills), sum(one["wrong"] for one in kills)
        figures = f"{lost} lost at most, {wrong} invented, in {len(kills)} kills"
        goal = "kill -9: at most 1 frame lost, none invented"
        lines.append((goal, figures, lost <= 1 and not wrong))
    if {OURS, MCAP} <= measured.keys():
        for what, goal, least in (
            ("written", "JPEG is written at least as fast as by MCAP's default", 1.0),
            ("read", f"random windows of JPEG at {OF_MCAP:g} of MCAP's rate or more", OF_MCAP),
        ):
            for by, name in _BY.items():
                ratio = statistics.median(ratios(rows, what, by))
                lines.append((f"{goal}, {name}", f"{ratio:.2f}", ratio >= least))
    others = [
        rate(row, "written", "cpu")
        for key, row in measured.items()
        if survives(row) and not STORES[key].ours and STORES[key].frames == "pixels"
    ]
    if "ours-zstd" in measured and others:
        ours = rate(measured["ours-zstd"], "written", "cpu")
        figures = f"{ours:,.0f} frames per CPU-second; the next {max(others):,.0f}"
        goal = "lossless: the fastest store that survives a kill"
        lines.append((goal, figures, ours > max(others)))
    return lines


def section(rows: list[dict[str, Any]], page: Page) -> str:
    """Return the tables of the stores, and draw their rates."""
    measured = [row for row in rows if row["written"]]
    lines = []
    for row in measured:
        one, last = STORES[row["key"]], row["written"][-1]
        speeds = [f"{rate(row, what, by):,.0f}" for what, by in _RATES]
        sizes = [f"{last['append_ms']['p99']:.2f}", f"{last['bytes'] / last['frames'] / 1e3:.0f}"]
        lost = max((each["lost"] for each in row["kills"]), default=0)
        left = "all" if lost <= 1 else f"all but {lost}"
        lines.append([one.title, *speeds, *sizes, left if survives(row) else "none", one.checksum])
    head = ["store", "written per CPU-s", "per s", "read per CPU-s", "per s"]
    head += ["append p99 [ms]", "KB a frame", "left by kill -9", "checksum"]
    texts = [_ABOUT, _draw(measured, page), table(head, lines)]
    by_key = {row["key"]: row for row in measured}
    if {OURS, MCAP} <= by_key.keys():
        alone, theirs = rate(by_key[OURS], "decoded", "cpu"), rate(by_key[MCAP], "read", "cpu")
        texts += [
            "Ours beside MCAP with its defaults, by pairs of runs that followed each other:",
            table(["JPEG: ours / MCAP", "median", "range"], _pairs(measured)),
            f"The JPEG decoder alone gives {alone:,.0f} images per CPU-second, from memory: no "
            f"store that keeps the camera's JPEG can give more, {alone / theirs:.2f} of MCAP's.",
        ]
    return "\n\n".join(["## Stores", *texts])


_ABOUT = """\
Each in a process of its own: 640x480x3 frames (a gel with noise of sigma 2 grey levels, or the
camera's JPEG of it, quality 90) appended as fast as the store takes them, closed and on the disk;
creating and closing counts, making the frames does not. Then windows of 16 images at random places,
decoded into one array of pixels, from the page cache. Then the writer is killed while it appends:
`all` means that every frame whose append had returned is in its place, after the store's own repair
if it has one (ours needs none). A CPU-second is one second of user and system time. By the clock a
store also waits for the disk and, without priority, for what else runs on the cores; the streams of
the load below have real-time priority."""


def _pairs(rows: list[dict[str, Any]]) -> list[list[str]]:
    lines = []
    for what, by in _RATES:
        values = ratios(rows, what, by)
        spread = [f"{statistics.median(values):.2f}", f"{min(values):.2f} to {max(values):.2f}"]
        lines.append([f"{what}, {_BY[by]}", *spread])
    return lines


def _draw(rows: list[dict[str, Any]], page: Page) -> str:
    titles = [STORES[row["key"]].title.replace("*", "").replace("`", "") for row in rows]
    panels = (
        ("written and closed [frames per CPU-second]", "written"),
        ("random windows of 16 [images per CPU-second]", "read"),
    )
    with chart(page.picture("stores"), 9, 0.8 + 0.25 * len(rows)) as figure:
        every = figure.subplots(1, 2, sharey=True)
        for axes, (label, what) in zip(every, panels, strict=True):
            values = [rate(row, what, "cpu") for row in rows]
            bars = axes.barh(
                titles,
                [max(value, 1) for value in values],
                color=[BLUE if STORES[row["key"]].ours else SKY for row in rows],
            )
            axes.bar_label(bars, [f"{value:,.0f}" for value in values], padding=3, fontsize="small")
            axes.set(xlabel=label, xscale="log", xlim=(1, 8 * max(*values, 10)))
            axes.grid(visible=False, axis="y")
            axes.margins(y=0.01)
        every[0].invert_yaxis()
    return page.link("stores", "Frames per CPU-second, written and read")
