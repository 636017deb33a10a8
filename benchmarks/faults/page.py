"""Write docs/results/reliability.md from the results."""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

from benchmarks.faults.judge import FaultResult, Left
from benchmarks.faults.kills import VICTIMS
from benchmarks.faults.rows import Row
from benchmarks.faults.run import Results
from recorder.pages import render
from recorder.progress import duration
from rig.acquire import streams
from rig.bench.bench import BenchFile, BenchLimits
from rig.devices.arm.settings import ArmConfig

# Maximum length of a reason; the rest is advice to the technician [characters].
_LONGEST = 150

# Reasons of rejection as shown, where the key of the session differs.
_SHOWN = {"corrupt": "corrupt"}


def page(results: Results, benches: Path) -> str:
    """Return the page as Markdown.

    Args:
        results: Results of all rows.
        benches: Folder of the bench files, for the mock bench's limits.
    """
    by_device: dict[str, list[tuple[Row, FaultResult]]] = {}
    for row, judged in results.rows:
        by_device.setdefault(row.device, []).append((row, judged))
    return render(
        Path(__file__).with_suffix(".md"),
        results=results,
        by_device=by_device,
        victims=VICTIMS,
        reason=_reason,
        plain=_plain,
        listed=_listed,
        counted=_counted,
        rejected=_rejected,
        streams=streams,
        lab={item.name: item.default for item in (*fields(BenchLimits), *fields(ArmConfig))},
        mock=BenchFile.read(benches / "tacpalm.yaml").bench,
        system=platform.system(),
        duration=duration,
    )


def _reason(row: Row, line: str) -> str:
    """Return the reason from the last printed line, without the advice that follows."""
    if line.startswith("complete"):
        return row.did or ("continued, counted it" if row.counts else "continued")
    found = re.match(r"stopped \((.*)\): \d+ of \d+ targets", line)
    if found is None:
        return line
    first = found[1].split("; ")[0]
    text = first if len(first) <= _LONGEST else f"{first[:_LONGEST]}..."
    return text + ("; reported: not retracted" if "NOT RETRACTED" in found[1] else "")


def _plain(text: str) -> str:
    """Return `text` for a table cell, without addresses and times of this run."""
    text = re.sub(r"127(\.\d+){3}", "bench", text)
    text = re.sub(r"'?/\S*/s\.zarr/?([^\s']*)'?", r"\1", text)
    text = re.sub(r"/\S*/tactile-rig-\w+/", "", text)
    text = re.sub(r"t_ns = \d+", "t_ns = ...", text)
    return text.replace("|", "\\|").replace("\n", " ")


def _listed(numbers: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in numbers.items())


def _counted(numbers: Mapping[str, int]) -> str:
    return _listed({name: count for name, count in numbers.items() if count}) or "0"


def _rejected(left: Left) -> str:
    return _counted(
        {
            f"{name} {_SHOWN.get(reason, reason)}": count
            for name, rejected in left.rejected.items()
            for reason, count in rejected.items()
        }
    )
