"""Part `bench`: a session collected on the mock bench, compared with its World's truth."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import Page, Run
from recorder import Session
from recorder.checks.check import check
from rig.bench.bench import find_bench
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES
from tests.support.mock_errors import compare

_TIMEOUT = 1200.0


def measure(run: Run) -> dict[str, Any]:
    """Collect targets on the mock bench in real time, check the session and compare it."""
    targets, began = 2 if run.quick else run.options.targets, time.monotonic()
    try:
        session, truth = collect(find_bench("tacpalm", BENCHES), targets, run.folder)
    except ConfigError as error:  # what was measured before stays
        run.failures.append(str(error))
        return {"targets": targets, "failure": str(error)}
    took = time.monotonic() - began
    run.progress(0.9)
    recorded = Session(session)
    findings = [f"{one.code} ({one.where}): {one.message}" for one in check(session)]
    return {
        "targets": targets,
        "seconds": took,
        "streams": {name: len(stream) for name, stream in recorded.streams.items()},
        "rows": int(np.asarray(recorded.frames["valid"], bool).sum()),
        "findings": findings,
        "deviations": compare(session, truth),
    }


def collect(bench: Path, targets: int, folder: Path) -> tuple[Path, Path]:
    """Run `tactile collect`; return the session and the ground truth it wrote.

    Raises:
        ConfigError: It failed; the message is its last line of output.
    """
    session, truth = folder / "mock.zarr", folder / "mock.truth"
    words = ["collect", "--bench", str(bench), "--targets", str(targets), "--out", str(session)]
    words += ["--truth", str(truth), "--calibrations", str(folder / "none-measured")]
    command = [sys.executable, "-m", "tactile", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise ConfigError(f"collect: {lines[-1] if lines else done.returncode}")
    return session, truth


def section(values: dict[str, Any], page: Page) -> str:
    """Return the deviations of the session."""
    if "failure" in values:
        return f"## A session of the mock bench\n\nFailed: {values['failure']}"
    streams = ", ".join(f"{name} {count:,}" for name, count in values["streams"].items())
    return "\n\n".join(
        [
            "## A session of the mock bench",
            f"`tactile collect` of {values['targets']} targets on tacpalm (real client libraries, "
            f"emulated devices) took {values['seconds']:.0f} s; samples: {streams}; "
            f"{values['rows']:,} complete rows. `session check` reports "
            f"{'; '.join(values['findings']) or 'nothing'}. Beside what the world did:",
            "\n".join(["```", *values["deviations"], "```"]),
        ]
    )
