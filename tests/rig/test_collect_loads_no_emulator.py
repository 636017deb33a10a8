"""A collection with real devices imports no emulator, in any process."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from support.collecting import ROOT, move_typed

from benchmarks.faults.collection_run import quick_bench
from rig.bench.bench import BenchFile
from rig.mock.bench import MockBench

STANDS_IN = re.compile(r"emulator|emulated_|player|playback|^rig\.(mock|replay)\b")
TELL_AT_EXIT = """
import atexit, os, sys

def tell():
    wanted = ("rig", "matplotlib")
    names = [name for name in sys.modules if name.partition(".")[0] in wanted]
    with open(os.path.join(os.environ["TOLD"], f"{os.getpid()}.txt"), "w") as file:
        file.write("\\n".join([" ".join(sys.orig_argv), *names]))

def tell_and_exit(code):
    tell()
    leave(code)

atexit.register(tell)
# The arm's process ends by it.
leave, os._exit = os._exit, tell_and_exit
"""


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("sensor", ["tacpalm", "uskin"])
def test_no_process_of_a_lab_collection_loads_an_emulator(sensor: str, tmp_path: Path) -> None:
    told, hook, run = (tmp_path / name for name in ("told", "hook", "run"))
    for folder in (told, hook, run):
        folder.mkdir()
    (hook / "sitecustomize.py").write_text(TELL_AT_EXIT)
    path = quick_bench(tmp_path, sensor)
    with MockBench(BenchFile.read(path), run) as mock, move_typed() as terminal:
        lab = tmp_path / "lab.yaml"
        # Without what mentions emulators.
        mock_only = ("world", "world_frame")
        content = {key: value for key, value in mock.file.content.items() if key not in mock_only}
        lab.write_text(yaml.safe_dump({**content, "mock": False}))
        session = tmp_path / "s.zarr"
        done = subprocess.run(
            [
                *(sys.executable, "-m", "tactile", "collect", "--bench", str(lab)),
                *("--out", str(session), "--targets", "1"),
                *("--calibrations", str(tmp_path / "none-measured")),
            ],
            cwd=ROOT,
            stdin=terminal,
            env={**os.environ, "PYTHONPATH": f"{hook}:{ROOT}", "TOLD": str(told)},
            capture_output=True,
            text=True,
            check=False,
            timeout=240,
        )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "LAB BENCH" in done.stdout
    processes = {file.stem: file.read_text().splitlines() for file in told.iterdir()}
    loaded = {name for _, *names in processes.values() for name in names}
    # All have reported: the collecting process, one for each of its three streams, and the arm's.
    streams = [names for names in processes.values() if "rig.acquire.stream_process" in names]
    movers = [names for names in processes.values() if "rig.devices.arm.mover" in names]
    assert len(streams) == 4
    assert any(names not in streams for names in movers)
    assert not sorted(name for name in loaded if STANDS_IN.search(name))
    # The contact sheet after it is drawn by Pillow alone.
    assert "matplotlib" not in loaded
