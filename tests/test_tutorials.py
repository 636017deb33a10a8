"""The tutorials run as they are written, block by block, in an empty folder."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from support.tutorials import ROOT, TUTORIALS, blocks


@pytest.mark.serial
@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_runs_as_it_is_written(page: Path, tmp_path: Path) -> None:
    """Shell and Python are run; `console` takes long or needs a bench, and `text` is output."""
    home = tmp_path / "bin"
    home.mkdir()
    command = home / "tactile"
    command.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m tactile "$@"\n')
    command.chmod(0o755)
    folder = tmp_path / "lab"
    folder.mkdir()
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "PATH": f"{home}{os.pathsep}{os.environ['PATH']}",
    }
    ran = 0
    for kind, code in blocks(page):
        if kind not in ("sh", "python"):
            continue
        words = ["bash", "-e", "-c"] if kind == "sh" else [sys.executable, "-c"]
        done = subprocess.run(
            [*words, code], cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{code}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        ran += 1
    assert ran >= 2
