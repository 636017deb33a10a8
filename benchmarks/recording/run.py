"""Measure the requested parts and write the page with its charts."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.recording import alignment, charts, lateness, load, mock_session, store_benchmark
from benchmarks.recording.measure import Scale
from benchmarks.recording.page import ALIGNMENT_CHART, STORES_CHART, Results, machine, render
from benchmarks.recording.steps import Steps
from recorder.errors import SessionError
from recorder.progress import Progress
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Part:
    """One part of the run."""

    name: str
    """Name for `--only`, and the field of `Results`."""
    estimate: Callable[[Scale], float]
    """Returns the expected duration [s]."""
    measure: Callable[[Scale, Path, Steps], Any]
    """Measures the part in a folder."""


def parts(bench: Path) -> tuple[Part, ...]:
    """Return all parts, in the order of the page.

    Args:
        bench: Bench file for the collection in part `alignment`.
    """
    collect = partial(mock_session.collect, bench)
    return (
        Part("stores", store_benchmark.estimate, store_benchmark.race),
        Part("cpu", load.estimate_cpu_share, load.cpu_share),
        Part("lateness", lateness.estimate, lambda scale, _, told: lateness.lateness(scale, told)),
        Part("cameras", load.estimate_cameras, load.cameras),
        Part("full", load.estimate_full, load.full_load),
        Part(
            "alignment",
            alignment.estimate,
            lambda scale, place, told: alignment.alignment(scale, place, told, collect),
        ),
    )


# Names of the parts.
PARTS = tuple(part.name for part in parts(Path()))


def measure(
    scale: Scale, scratch: Path, bench: Path, only: Sequence[str] = PARTS, *, quick: bool = False
) -> Results:
    """Run the requested parts in a temporary folder below `scratch`.

    Raises:
        ConfigError: Too little disk space, no folder, or a measuring process that does not start.
    """
    chosen = [part for part in parts(bench) if part.name in only]
    clock = SystemClock()
    start = clock.now_ns()
    found: dict[str, Any] = {}
    try:
        # No thread, which would disturb the measurements.
        with (
            Progress("bench", sys.stderr, threaded=False) as progress,
            tempfile.TemporaryDirectory(prefix="bench-recorder-", dir=scratch) as folder,
        ):
            steps = Steps(progress, sum(part.estimate(scale) for part in chosen))
            for part in chosen:
                found[part.name] = part.measure(scale, Path(folder), steps)
    except (OSError, SessionError) as error:
        raise ConfigError(f"--scratch {scratch}: {error}") from error
    return Results(
        machine=machine(os.cpu_count() or 1),
        quick=quick,
        full_seconds=scale.full_load,
        seconds=(clock.now_ns() - start) / SECOND_NS,
        **found,
    )


def write_page(results: Results, path: Path) -> list[Path]:
    """Write the page to `path` and its charts to `images/` next to it; return all files written."""
    written = [path]
    images = path.parent / "images"
    path.parent.mkdir(parents=True, exist_ok=True)
    if results.stores is not None:
        written.append(images / STORES_CHART)
        charts.stores_chart(written[-1], results.stores)
    if results.alignment is not None:
        written.append(images / ALIGNMENT_CHART)
        charts.alignment_chart(written[-1], results.alignment)
    path.write_text(render(results))
    return written
