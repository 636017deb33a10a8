"""The endurance run: its plan, its process measurements and its report."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.collecting import quick_bench

from benchmarks.endurance.long_run import long_bench, run_long
from benchmarks.endurance.processes import Track, look, role_of
from benchmarks.endurance.report import growth_of, page
from rig.bench.bench import BenchFile
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES
from trajectories import dry_run


def test_the_plan_is_as_long_as_asked_and_no_longer_than_needed(tmp_path: Path) -> None:
    path, targets = long_bench(BENCHES / "tacpalm.yaml", 1800.0, tmp_path)
    bench = BenchFile.read(path).bench
    walked = dry_run(
        bench.trajectory,
        bench.plan_limits,
        speed=bench.arm.speed,
        acceleration=bench.arm.acceleration,
    )
    assert walked.targets == targets
    assert walked.broken == ()
    assert 1800.0 <= walked.duration < 1900.0


def test_more_than_directions_can_make_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--minutes: 10000; allowed: up to"):
        long_bench(BENCHES / "tacpalm.yaml", 6e5, tmp_path)


def test_what_a_process_is_for_and_what_it_holds(tmp_path: Path) -> None:
    code = "import sys; held = bytearray(32 << 20); print('up', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        track = Track(
            role_of(process.pid, "python -m rig.mock.emulate xela --file /t/taxels.json", tmp_path)
        )
        look(process.pid, track, 1.0)
        process.communicate()
    look(process.pid, track, 2.0)
    assert track.role == "taxels emulator"
    assert track.seconds == [1.0]
    assert 32 << 20 <= track.memory[0] < 128 << 20
    assert track.files[0] >= 3


def test_a_leak_shows_as_its_slope_and_the_warm_up_does_not() -> None:
    times = np.arange(0.0, 1800.0, 5.0)
    filling = 50e6 * np.minimum(times / 60.0, 1.0)
    memory = 100e6 + filling + 2e6 * times / 3600.0
    track = Track("x", times.tolist(), memory.tolist(), [7] * len(times), cpu=180.0)
    found = growth_of(track, 1800.0)
    assert found is not None
    assert found.slope == pytest.approx(2e6, rel=1e-6)
    assert found.spread < 1.0
    assert found.last - found.first == pytest.approx(2e6 * (1735 - 145) / 3600, abs=1e5)
    assert found.cpu_share == pytest.approx(0.1)
    assert growth_of(Track("y", [0.0, 5.0], [1.0, 1.0], [1, 1]), 10.0) is None


@pytest.mark.serial
@pytest.mark.slow
def test_a_short_long_run_finds_every_process_and_says_what_was_recorded(tmp_path: Path) -> None:
    bench = quick_bench(tmp_path, "tacpalm")
    path, targets = long_bench(bench, 30.0, tmp_path)
    found = run_long(path, tmp_path / "x.zarr", targets, lambda _: None)
    assert found.exit_code == 0, found.output
    roles = {track.role for track in found.tracks}
    wanted = {"collect", "arm", "World", "arm emulator", "force emulator", "camera emulator"}
    assert wanted | {"force stream", "pose stream", "camera stream"} <= roles
    text = page(found)
    assert "ended `complete`, exit code 0" in text
    assert "| force |" in text
