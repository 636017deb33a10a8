"""Common parts of all emulators: the World in shared memory, and a process that can be stopped."""

import json
import os
import subprocess
import sys
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

from rig.core.clock import SystemClock
from rig.core.config import READER
from rig.core.emulation import NO_CONTACT_DEPTH, Served, SharedWorld
from rig.core.samples import WORLD_STATE
from rig.core.shared_memory import SharedLatest
from rig.devices import registry
from rig.devices.force.netft import NetFtDriver
from rig.devices.force.settings import NetFtConfig
from rig.mock.emulate import EMULATORS, main

ROOT = Path(__file__).parents[2]
HOST = f"127.{1 + os.getpid() % 250}.50.1"
NETFT = [sys.executable, "-m", "rig.mock.emulate", "netft"]
KINDS = set(registry.DEVICES)


def state(t_ns: int, fz: float) -> np.ndarray:
    record = np.zeros((), WORLD_STATE)
    record["t_ns"] = t_ns
    record["wrench"] = (0.0, 0.0, fz, 0.0, 0.0, 0.0)
    return record


def test_before_the_first_state_nothing_is_touched_even_without_a_file(tmp_path: Path) -> None:
    path = tmp_path / "world"
    world = SharedWorld(path)
    number, no_contact = world.state()
    assert (number, no_contact["depth"], no_contact["t_ns"]) == (0, NO_CONTACT_DEPTH, 0)
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
    settings = json.dumps({"host": HOST, "world": str(tmp_path / "world")})
    with subprocess.Popen(
        [*NETFT, settings, "--until-stdin-closes"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == f"ready netft {HOST}:49152 http://{HOST}:8080\n"
        driver = NetFtDriver(NetFtConfig(HOST, 8080, silence=20.0), SystemClock())
        try:
            driver.open(60.0)
            assert driver.read(5.0)[0]["value"].tolist() == [0.0] * 6
            record.write(state(1, -2.5))
            for _ in range(100):
                samples = driver.read(5.0)
                if samples[-1]["value"][2] == -2.5:
                    break
            assert samples[-1]["value"].tolist() == [0.0, 0.0, -2.5, 0.0, 0.0, 0.0]
            # A second emulator at the same address reports this and ends.
            file = tmp_path / "second.json"
            file.write_text(settings)
            second = subprocess.run(
                [*NETFT, "--file", str(file)],
                **{"capture_output": True, "text": True, "check": False, "timeout": 240},
            )
            assert second.returncode == 2
            assert "cannot listen" in second.stderr
        finally:
            driver.close()
            process.terminate()
    record.close()


# The World and its solver are reached through shared memory.
LISTENING = [name for name in EMULATORS if name not in ("world", "solver")]
# Settings that an emulator cannot do without.
NEEDED = {
    "nidaq": {"device": {"calibration": "x.cal"}},
    "robotiq_2f": {"device": {"port": "tty"}},
    "scale": {"device": {"protocol": "kern"}},
    "hand": {
        "pair": {"left": {"sensor": "gelsight"}, "right": {"sensor": "uskin"}},
        "objects": [],
        "folder": ".",
    },
    "hid_pedal": {"device": {"kind": "hid_pedal", "device": "/x.hidraw"}},
    "spacemouse": {"device": {"kind": "spacemouse", "device": "/x.hidraw"}},
}


@pytest.mark.parametrize("name", LISTENING)
@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "bench.example.org"])
def test_no_emulator_can_be_reached_from_another_machine(
    name: str, host: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([name, json.dumps({**NEEDED.get(name, {}), "host": host})])
    assert ended.value.code == 2
    assert f"host: found '{host}'; allowed: a loopback address" in capsys.readouterr().err


@pytest.mark.parametrize("name", EMULATORS)
def test_an_unknown_setting_of_an_emulator_is_refused_with_all_that_there_are(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([name, '{"?": 0}'])
    hints = get_type_hints(import_module(EMULATORS[name]).emulate)
    assert hints["return"] is Served
    keys = {READER.key_of(each) for each in fields(hints["settings"])}
    refusal = " ".join(capsys.readouterr().err.split())
    assert set(refusal.rpartition("known: ")[2].split(", ")) == keys
    if name in KINDS:
        assert keys >= {"device", "host", "world", "seed", "fault_port"}


def test_every_device_of_a_bench_has_an_emulator_or_shares_the_arms() -> None:
    assert KINDS - EMULATORS.keys() == {"ur_pose", "ur_wrench", "v4l2"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["netft", '{"device": {"http_prot": 1}}'], "netft.device: unknown http_prot; did you me"),
        (["netft", '{"seed": 1, "seed": 2}'], "key 'seed' is written twice"),
        (["netft", "[]"], "netft: found the list []; allowed: a mapping of keys to values"),
        (["netft", '{"noise_n": "much"}'], "noise_n: found text 'much'; allowed: a number [N]"),
        (["netft", "--file", "none.json"], "none.json: no such file"),
        (["robotiq_2f"], "robotiq_2f: missing device; known: host, world"),
        (["hid_pedal", '{"device": {"kind": "spacemouse", "device": "/x.hidraw"}}'], "device.kind"),
        (["mjpeg"], "view, source: found neither; allowed: one of them"),
        (["mjpeg", '{"source": "x", "view": "y"}'], "view, source: found both"),
        (["netft", "{}", "--file", "x"], "not allowed with"),
        (["force"], "kind: found 'force'; allowed: ur,"),
    ],
)
def test_a_document_that_is_wrong_is_refused(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_help_lists_every_emulator_and_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = capsys.readouterr().out
    assert all(name in shown for name in EMULATORS)
    assert "python -m rig.mock.emulate netft '{" in shown
