"""Drivers of pedal and SpaceMouse with the real hidapi, on nodes of a preloaded shim."""

import json
import os
from pathlib import Path

import pytest
from support import hidraw_nodes

from rig.core.errors import DeviceLost
from rig.devices.hid.drivers import HidDevice

PEDAL = """
import json, sys
from pathlib import Path
from tests.support.waiting import until
from rig.core.clock import SystemClock
from rig.core.errors import DeviceLost
from rig.devices.hid.settings import PedalConfig
from rig.devices.hid.hid_emulator import HidEmulator
from rig.devices.hid.drivers import PedalDriver

emulator = HidEmulator("pedal", Path(sys.argv[1]), SystemClock())
emulator.start()
driver = PedalDriver(PedalConfig(sys.argv[2]))
seen, lost = [], []
def when(fault, **values):
    emulator.inject(fault, **values)
    seen.append(driver.read(60.0))
def until_connected():
    until(lambda: emulator.inject("state")["clients"])
def opens():
    try:
        driver.open()
    except DeviceLost:
        return False
    return True
try:
    driver.open()
    path = driver.describe()["path"]
    until_connected()
    for step in ("press", "release", "press"):
        when(step)
    seen.append(driver.read(0.05))
    emulator.inject("garbage", messages=1)
    when("press")
    emulator.inject("clear")
    emulator.inject("unplug")
    for again in (lambda: driver.read(60.0), driver.open):
        try:
            again()
        except DeviceLost as error:
            lost.append(str(error))
    emulator.inject("replug")
    until(opens)
    until_connected()
    when("press")
finally:
    driver.close()
    driver.close()
    emulator.close()
print(json.dumps({"seen": seen, "lost": lost, "path": path, "garbage": driver.garbage}))
"""

SPACEMOUSE = """
import json, sys
from pathlib import Path
from tests.support.waiting import until
from rig.core.clock import SystemClock
from rig.devices.hid.settings import SpaceMouseConfig
from rig.devices.hid.hid_emulator import HidEmulator
from rig.devices.hid.drivers import SpaceMouseDriver

clock = SystemClock()
emulator = HidEmulator("spacemouse", Path(sys.argv[1]), clock)
emulator.start()
driver = SpaceMouseDriver(SpaceMouseConfig("256f:c635"), clock)
found = {"pushed": [], "pressed": []}
try:
    driver.open()
    until(lambda: emulator.inject("state")["clients"])
    emulator.inject("push", x=1.0, z=-0.54, rx=0.05, seconds=1.0)
    shifts = []
    while [1.0, 0.0, -0.5] not in shifts or shifts[-1] != [0.0, 0.0, 0.0]:
        cap = driver.read(0.02)
        shifts.append(list(cap.shift))
        found["pushed"].append([cap.shift, cap.turn])
    emulator.inject("button", number=1)
    found["pressed"].append(sorted(driver.read(0.5).pressed))
    found["pressed"].append(sorted(driver.read(0.1).pressed))
finally:
    driver.close()
    emulator.close()
print(json.dumps(found))
"""

ABSENT = """
from rig.core.errors import DeviceLost
from rig.devices.hid.settings import PedalConfig
from rig.devices.hid.drivers import PedalDriver
import sys
for device in sys.argv[1:]:
    try:
        PedalDriver(PedalConfig(device)).open()
    except DeviceLost as error:
        print(error)
"""


@pytest.fixture(name="shim", scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hidraw_nodes.library(tmp_path_factory.mktemp("shim"))


@pytest.mark.parametrize("by_ids", [False, True])
def test_a_pedal_is_pressed_released_corrupt_unplugged_and_back(
    by_ids: bool, shim: Path, tmp_path: Path
) -> None:
    node = tmp_path / "pedal.hidraw"
    device = "3553:b001" if by_ids else str(node)
    text = hidraw_nodes.run(shim, PEDAL, str(node), device, nodes=tmp_path)
    found = json.loads(text)
    assert found["path"] == str(node)
    # Garbage counts as a release; after reconnection, the first press is seen.
    assert found["seen"] == [True, False, True, None, False, True]
    assert found["garbage"] == 1
    assert "is it plugged in?" in found["lost"][0]
    assert "is it plugged in?" in found["lost"][1]


@pytest.mark.slow
def test_a_cap_is_followed_and_counts_as_let_go_of_once_silent(shim: Path, tmp_path: Path) -> None:
    node = tmp_path / "cap.hidraw"
    found = json.loads(hidraw_nodes.run(shim, SPACEMOUSE, str(node), nodes=tmp_path))
    shifts = [shift for shift, _ in found["pushed"]]
    # -0.54 minus a dead zone of 0.08 is half of full deflection; 0.05 about x is inside it.
    assert [1.0, 0.0, -0.5] in shifts
    assert all(turn == [0.0, 0.0, 0.0] for _, turn in found["pushed"])
    # The emulator sends no final zeros, like some models.
    assert shifts[-1] == [0.0, 0.0, 0.0]
    assert found["pressed"] == [[1], []]


def test_a_device_that_is_not_there_is_lost_and_the_error_says_what_is(
    shim: Path, tmp_path: Path
) -> None:
    text = hidraw_nodes.run(shim, ABSENT, "3553:b001", "/dev/hidraw99", nodes=tmp_path)
    first, second = text.strip().splitlines()
    assert "no HID devices at all" in first
    assert "/dev/hidraw99 is not there" in second


@pytest.mark.parametrize(
    ("name", "allowed", "text"),
    [
        ("hidraw0", False, r'KERNEL=="hidraw\*".*MODE="0660"'),
        ("hidraw0", True, "not a HID device"),
        ("pedal.hidraw", True, r"LD_PRELOAD=\$\(python -m rig.devices.hid.shim\)"),
    ],
    ids=["without the right", "another file", "without the shim"],
)
def test_a_node_that_cannot_be_opened_is_lost_with_the_cure(
    name: str, allowed: bool, text: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "hidraw0").touch()
    if not allowed:
        monkeypatch.setattr(os, "access", lambda *_: False)
    pedal = HidDevice(str(tmp_path / name), "foot pedal", (1, 6))
    with pytest.raises(DeviceLost, match=text):
        pedal.open()
    with pytest.raises(DeviceLost, match="not open"):
        pedal.report(0.1)
