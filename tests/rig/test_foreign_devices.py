"""Devices of other packages: registered by an entry point, accepted, emulated and recorded."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.collecting import ROOT, faults_of, patient_bench

from recorder import Session
from rig.bench.bench import BenchFile
from rig.core.errors import ConfigError
from rig.devices import registry
from rig.mock.world.truth import Truth

GUIDE = ROOT / "docs/how-to/add-a-device.md"
# An array of 4 x 6 taxels that speaks the same lines as the sensor of the guide.
SKIN = """
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
from line_gauge import LineGaugeDriver, LineGaugeEmulator

from rig.core.emulation import EmulatorConfig, Served
from rig.devices.registry import Device
from rig.devices.taxels.settings import TaxelSettings


@dataclass(frozen=True, slots=True)
class SkinSettings(TaxelSettings):
    KIND: ClassVar[str] = "skin"

    host: str = "192.168.1.3"
    port: int = 4001
    rate_hz: float = 60.0

    @property
    def shape(self):
        return (4, 6, 2)

    @property
    def address(self):
        return f"{self.host}:{self.port}"


class SkinDriver(LineGaugeDriver):
    def _sample(self, values):
        return {"value": np.array(values, np.int32).reshape(24, 2), "device_t": float("nan")}


@dataclass(frozen=True, slots=True)
class SkinEmulatorConfig(EmulatorConfig):
    device: SkinSettings = field(default=SkinSettings())
    view: Path | None = None
    noise: float = 0.0


class SkinEmulator(LineGaugeEmulator):
    def _values(self):
        pressure = -1000 * self._world.state()[1]["wrench"][2]
        counts = 20_000 + pressure + self._rng.normal(0.0, self._config.noise, 48)
        return np.rint(counts).astype(int)


def emulate(settings: SkinEmulatorConfig, clock) -> Served:
    emulator = SkinEmulator(settings, clock)
    return Served("skin", emulator, emulator.faults.inject)


DEVICE = Device(
    SkinSettings,
    driver="skin:SkinDriver",
    emulator="skin",
    example={"host": "loopback", "port": 4001},
)
"""


def install(folder: Path, name: str, module: str, entry_points: str) -> None:
    """Put a module and the metadata of its package into a folder of the Python path."""
    (folder / f"{name}.py").write_text(module)
    metadata = folder / f"{name}-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
    (metadata / "entry_points.txt").write_text(entry_points)


@pytest.fixture(name="site")
def folder_of_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of the Python path with the package of the guide, and one of 4 x 6 taxels."""
    text = GUIDE.read_text()
    module, project = (
        re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)[0]
        for language in ("python", "toml")
    )
    points = project[project.index("line_gauge =") :].replace('"', "")
    site = tmp_path / "site"
    site.mkdir()
    install(site, "line_gauge", module, f"[{registry.GROUP}]\n{points}")
    install(site, "skin", SKIN, f"[{registry.GROUP}]\nskin = skin:DEVICE\n")
    monkeypatch.syspath_prepend(site)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), str(ROOT)]))
    return site


def forget() -> None:
    for function in (registry._entry_points, registry._loaded):
        function.cache_clear()
    for name in ("line_gauge", "skin", "broken"):
        sys.modules.pop(name, None)


@pytest.fixture(autouse=True)
def entry_points_of_each_test() -> Iterator[None]:
    """Look for entry points again, before and after a test, and forget their modules."""
    forget()
    yield
    forget()


def bench_of(folder: Path, more: str) -> Path:
    path = patient_bench(folder, "uskin")
    (folder / "foreign.yaml").write_text(f"extends: {path.name}\n{more}")
    return folder / "foreign.yaml"


BENCH = """
force: {kind: line_gauge, host: loopback, port: 4000, rate_hz: 200.0}
taxels: {kind: skin, host: loopback, port: 4001, rate_hz: 50.0}
"""


def test_a_bench_file_names_devices_of_other_packages_by_kind(site: Path, tmp_path: Path) -> None:
    bench = BenchFile.read(bench_of(tmp_path, BENCH)).bench
    assert type(bench.force).__name__ == "LineGaugeSettings"
    assert bench.row("taxels").shape == {"taxels": 24, "axes": 2}
    assert registry.device("line_gauge").cures[0].startswith("ping {at}")
    assert {"line_gauge", "skin"} <= set(registry.kinds())


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("force: {kind: line_gage}", r"force.kind: found 'line_gage'; allowed: .*, line_gauge$"),
        ("force: {kind: skin}", r"force.kind: found 'skin'; allowed: netft, nidaq, scale, line_ga"),
        ("force: {kind: line_gauge, prot: 1}", "force: unknown prot; did you mean port"),
    ],
)
def test_what_no_package_has_is_refused(
    site: Path, tmp_path: Path, more: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        BenchFile.read(bench_of(tmp_path, more))


@pytest.mark.parametrize(
    ("module", "message"),
    [
        ("import no_such_library\n", "broken:DEVICE cannot be imported: ModuleNotFoundError"),
        ("DEVICE = None\n", "broken:DEVICE is None; allowed: a Device whose settings have KIND"),
    ],
)
def test_a_broken_package_is_named_and_stops_only_benches_that_use_it(
    site: Path, tmp_path: Path, module: str, message: str
) -> None:
    install(site, "broken", module, f"[{registry.GROUP}]\nbroken = broken:DEVICE\n")
    BenchFile.read(bench_of(tmp_path, BENCH))
    with pytest.raises(ConfigError, match=f"kind: broken: {message}"):
        BenchFile.read(bench_of(tmp_path, "force: {kind: broken}\n"))


def python(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_the_contract_suite_tests_devices_of_other_packages(site: Path) -> None:
    # Those of skin that differ from the gauge's by its kind.
    chosen = "line_gauge or (skin and (columns or repeated or closing or fresh))"
    done = python(
        ROOT, "pytest", "-q", "-n", "0", "-k", chosen, "tests/rig/test_device_contract.py"
    )
    assert done.returncode == 0, done.stdout
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed is not None
    assert int(passed[1]) >= 10 + 4


@pytest.mark.slow
@pytest.mark.serial
def test_a_session_is_collected_from_devices_of_other_packages(site: Path, tmp_path: Path) -> None:
    path, truth = tmp_path / "s.zarr", tmp_path / "truth"
    words = ("--bench", str(bench_of(tmp_path, BENCH)), "--truth", str(truth), "--out", str(path))
    done = python(tmp_path, "tactile", "collect", "--targets", "1", *words)
    assert done.returncode == 0, done.stdout + done.stderr
    assert faults_of(path) == []
    session = Session(path)
    force = session.streams["force"]
    assert force.attrs["device"]["device"] == "line gauge"
    inside = force.t_ns < Truth(truth).records["t_ns"][-1]
    raw = np.asarray(force.array("value"))[inside] + np.asarray(force.attrs["bias"])
    assert raw[:, 2].min() < -0.3
    error = raw - Truth(truth).wrench(force.t_ns[inside])
    assert np.median(np.abs(error[:, :3])) < 0.05
    taxels = np.asarray(session.streams["taxels"].array("value"))
    assert taxels.shape[1:] == (24, 2)
    assert taxels.max() > taxels[0].max() + 200
    assert session.frames["taxels"].shape[1:] == (24, 2)
