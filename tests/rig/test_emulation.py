"""Common parts of all emulators: the World in shared memory, and a process that can be stopped."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rig.core.clock import SystemClock
from rig.core.emulation import UNTOUCHED_DEPTH, SharedWorld
from rig.core.samples import WORLD_STATE
from rig.core.shared_memory import SharedLatest
from rig.devices.force.netft import NetFtDriver
from rig.devices.force.settings import NetFtConfig

ROOT = Path(__file__).parents[2]
HOST = f"127.{1 + os.getpid() % 250}.50.1"
NETFT = [sys.executable, "-m", "rig.devices.force.netft_emulator", "--host", HOST]


def state(t_ns: int, fz: float) -> np.ndarray:
    record = np.zeros((), WORLD_STATE)
    record["t_ns"] = t_ns
    record["wrench"] = (0.0, 0.0, fz, 0.0, 0.0, 0.0)
    return record


def test_before_the_first_state_nothing_is_touched_even_without_a_file(tmp_path: Path) -> None:
    path = tmp_path / "world"
    world = SharedWorld(path)
    number, untouched = world.state()
    assert (number, untouched["depth"], untouched["t_ns"]) == (0, UNTOUCHED_DEPTH, 0)
    record = SharedLatest.create(path, WORLD_STATE)
    assert world.state()[0] == 0
    for k in (1, 2):
        record.write(state(10 * k, -1.0 * k))
        number, newest = world.state()
        assert (number, newest["t_ns"], newest["wrench"][2]) == (k, 10 * k, -1.0 * k)
    world.close()
    world.close()
    record.close()


def test_an_emulator_process_serves_what_the_world_publishes(tmp_path: Path) -> None:
    record = SharedLatest.create(tmp_path / "world", WORLD_STATE)
    with subprocess.Popen(
        [*NETFT, "--world", str(tmp_path / "world"), "--until-stdin-closes"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == f"ready netft {HOST}:49152 http://{HOST}:8080\n"
        driver = NetFtDriver(NetFtConfig(HOST, 8080, silence=20.0), SystemClock())
        try:
            driver.open(5.0)
            assert driver.read(5.0)[0]["value"].tolist() == [0.0] * 6
            record.write(state(1, -2.5))
            for _ in range(100):
                samples = driver.read(5.0)
                if samples[-1]["value"][2] == -2.5:
                    break
            assert samples[-1]["value"].tolist() == [0.0, 0.0, -2.5, 0.0, 0.0, 0.0]
            # A second emulator at the same address reports this and ends.
            second = subprocess.run(NETFT, capture_output=True, text=True, check=False, timeout=30)
            assert second.returncode == 2
            assert "cannot listen" in second.stderr
        finally:
            driver.close()
            process.terminate()
    record.close()


EMULATORS = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "rig").rglob("*.py")
    if "type=loopback" in path.read_text() or "= emulator_parser(" in path.read_text()
)
EMULATORS = [
    name for name in EMULATORS if name not in ("rig.core.emulation", "rig.mock.world.host")
]


@pytest.mark.parametrize("module", EMULATORS)
@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "bench.example.org"])
def test_no_emulator_can_be_reached_from_another_machine(
    module: str, host: str, capsys: pytest.CaptureFixture[str]
) -> None:
    main = importlib.import_module(module).main
    with pytest.raises(SystemExit) as ended:
        main(["--host", host])
    assert ended.value.code == 2
    assert f"found '{host}'; allowed: a loopback address" in capsys.readouterr().err


def test_all_emulators_are_looked_at() -> None:
    assert len(EMULATORS) >= 9
