"""The mock bench starts the emulators its sensor needs, finds an address, and reports failures."""

import os
import signal
import socket
from pathlib import Path

import pytest

from rig.bench.bench import BenchFile, find_bench
from rig.bench.worlds import Sources
from rig.core.errors import ConfigError, DeviceLost
from rig.core.packaged import BENCHES
from rig.mock.bench import MockBench, free_loopback


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "devices"),
    [
        ("tacpalm", {"arm", "world", "force", "camera"}),
        ("uskin", {"arm", "world", "force", "taxels"}),
    ],
)
def test_a_bench_has_the_emulators_of_its_devices_at_one_address_of_its_own(
    sensor: str, devices: set[str], tmp_path: Path
) -> None:
    path = find_bench(sensor, BENCHES)
    with MockBench(BenchFile.read(path), tmp_path) as mock:
        assert set(mock.processes) == devices
        mock.check()
        for port in (29999, 30003, 30004):
            socket.create_connection((mock.host, port), 2.0).close()
        assert mock.bench.arm.host == mock.bench.force.host == mock.host
        assert free_loopback() != mock.host
        mock.processes["world"].send_signal(signal.SIGKILL)
        mock.processes["world"].wait()
        with pytest.raises(DeviceLost, match="world: its emulator ended"):
            mock.check()
    assert all(process.returncode is not None for process in mock.processes.values())


def test_sources_that_are_not_there_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--camera"):
        Sources(camera=tmp_path / "none")
    with pytest.raises(ConfigError, match="--taxels"):
        Sources(taxels=tmp_path / "none.npy")
    # The session names the content served, not its path.
    description = Sources(camera=tmp_path, camera_motion="still").description()
    assert description == {"camera": {"name": tmp_path.name, "motion": "still"}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("library", "error", "text"),
    [
        (True, DeviceLost, "taxels emulator did not start"),
        (False, ConfigError, r"taxels emulator: websockets is not .*tactile-rig\[rig\]"),
    ],
    ids=["its file is none", "it lacks a library"],
)
def test_an_emulator_that_does_not_start_is_named_with_its_last_word_or_the_extra_it_lacks(
    library: bool,
    error: type[Exception],
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    log, folder = tmp_path / "log.npy", tmp_path / "run"
    log.write_bytes(b"no array")
    folder.mkdir()
    if not library:
        missing = "raise ModuleNotFoundError(\"No module named 'websockets'\")\n"
        (tmp_path / "websockets.py").write_text(missing)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    file = BenchFile.read(find_bench("uskin", BENCHES))
    bench = MockBench(file, folder, sources=Sources(taxels=log))
    with pytest.raises(error, match=text), bench:
        pass
    assert all(process.returncode is not None for process in bench.processes.values())
