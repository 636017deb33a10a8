"""Short runs of a verb do not import `recorder`; longer ones show progress from their start."""

from __future__ import annotations

import io
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sim import progress
from sim.progress import LateProgress


def test_a_short_run_imports_no_recorder() -> None:
    program = (
        "import sys, sim.progress; sim.progress.WAIT = 60; from sim.__main__ import main; "
        "main(['press', '--tier', 'layer', '--json']); print('recorder' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert done.stdout.endswith(b"False\n")


def test_a_longer_run_shows_its_share_and_kernels_compiled_since_its_start(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(progress, "WAIT", 0.1)
    stream = io.StringIO()
    with LateProgress("press", stream, tmp_path):
        (tmp_path / "wp_contact").mkdir()
        while not stream.getvalue():
            time.sleep(0.01)
    assert stream.getvalue() == "press: compiling kernels, once ... 2 s\n"
