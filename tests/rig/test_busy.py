"""A busy computer is named first and once, and its effects are not found a second time."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.sessions import Columns, make_session

from recorder import Session, SessionError, SessionWriter
from recorder.checks.check import check
from recorder.session.states import state_lines
from rig.acquire import doctor
from rig.core.errors import DeviceLost, combined
from rig.core.load import Load, Stalls, busy, explained
from rig.devices.arm.dashboard import age_note

IDLE = Load(threads=2, cores=2, memory=4e9, memory_all=8e9)
CROWDED = Load(threads=14, cores=2, memory=4e9, memory_all=8e9, waits={"cpu": 0.9})
NAMED = "this computer is busy (14 threads want its 2 cores)"


@pytest.mark.parametrize(
    ("load", "named"),
    [
        (IDLE, ""),
        (CROWDED, "14 threads want its 2 cores"),
        (Load(threads=14, cores=2, waits={"cpu": 0.1}), ""),
        (Load(threads=14, cores=8), ""),
        (Load(memory=2e8, memory_all=8e9), "0.2 of 8.0 GB are free"),
        (Load(memory=2e9, memory_all=8e9, waits={"memory": 0.3}), "2.0 of 8.0 GB are free"),
        (Load(waits={"io": 0.7}), "its disk keeps programs waiting for 70% of the time"),
    ],
)
def test_each_shortage_is_named(load: Load, named: str) -> None:
    assert busy(load) == (f"this computer is busy ({named})" if named else "")


def test_the_kernel_tells_the_load(tmp_path: Path) -> None:
    assert Load.read(tmp_path).shortages() == []
    (tmp_path / "loadavg").write_text("9.14 5.87 2.74 96/114 16067\n")
    (tmp_path / "meminfo").write_text("MemTotal:  8000 kB\nMemAvailable:   100 kB\n")
    (tmp_path / "pressure").mkdir()
    (tmp_path / "pressure" / "io").write_text("some avg10=97.00 avg60=9.00\nfull avg10=0.00\n")
    load = Load.read(tmp_path)
    assert (load.threads, load.memory, load.waits) == (96, 102400, {"io": 0.97})
    assert Load.read().cores >= 1


SILENT = "arm at 127.1.1.1: silent; is the controller on and its network cable in?"
SLOW = "camera: 12 Hz measured; expected 30 Hz (bench file); is its connection overloaded?"


@pytest.mark.parametrize(
    ("error", "load", "mock", "printed"),
    [
        (SILENT, IDLE, False, SILENT),
        (SILENT, IDLE, True, "arm at 127.1.1.1: silent"),
        (SILENT, CROWDED, False, f"{NAMED}: {SILENT}"),
        (SILENT, CROWDED, True, f"{NAMED}: arm at 127.1.1.1: silent"),
        (SLOW, IDLE, True, "camera: 12 Hz measured; expected 30 Hz (bench file)"),
        (f"{NAMED}: {SILENT}", CROWDED, False, f"{NAMED}: {SILENT}"),
        ("arm: the speed slider is at 0%", CROWDED, True, "arm: the speed slider is at 0%"),
    ],
)
def test_a_late_device_is_explained_once(error: str, load: Load, mock: bool, printed: str) -> None:
    assert str(explained(DeviceLost(error), mock=mock, load=load)) == printed


def test_several_devices_have_one_explanation() -> None:
    several = combined([DeviceLost(SILENT), DeviceLost(SLOW)])
    text = str(explained(DeviceLost(str(several)), mock=False, load=CROWDED))
    assert text.count("this computer is busy") == 1
    assert isinstance(several, DeviceLost)
    text = str(explained(several, mock=True, load=CROWDED))
    assert (text.count("busy"), text.count("?"), "expected 30" in text) == (1, 0, True)


def test_a_loop_that_stands_still_is_noticed_and_forgotten() -> None:
    stalls = Stalls(0.05)
    for turn in (1, 1_050_000_001, 1_100_000_001, 2_000_000_001):
        stalls.turn(turn)
    assert stalls.found == [(1, 1_050_000_001), (1_100_000_001, 2_000_000_001)]
    assert stalls.longest(0) == pytest.approx(1.05)
    assert stalls.longest(1_500_000_000) == pytest.approx(0.9)
    assert stalls.longest(3_000_000_000) == 0
    assert "stood still for 0.9 s" in busy(IDLE, 0.9)


def test_the_doctor_names_the_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.computer(IDLE).text == "2 threads on 2 cores, 4.0 GB of memory free"
    for granted, state in ((True, "note"), (False, "FAULT")):
        monkeypatch.setattr(doctor, "may_have_priority", partial(bool, granted))
        found = doctor.computer(CROWDED)
        assert (found.state, found.text) == (state, NAMED)


def test_the_doctor_speaks_of_no_cable_on_a_mock() -> None:
    lost = doctor.Finding("pose", "FAULT", SILENT, ("plug the cable in", "its address"))
    found = doctor._explained(lost, CROWDED, mock=True)
    assert found.text == "arm at 127.1.1.1: silent"
    assert [cure.split()[1] for cure in found.cures] == ["the", "emulator", "address"]
    assert doctor._explained(lost, IDLE, mock=False) == lost


@pytest.mark.parametrize(
    ("version", "named"), [("5.4.3.1", True), ("3.15.0", True), ("5.6.0", False), ("5.12.4", False)]
)
def test_an_old_polyscope_is_named(version: str, named: bool) -> None:
    assert ("does not say if remote control is on" in age_note(version)) == named


# A session's words on its bench and computer


def late(columns: Columns) -> Columns:
    """Return forces that came 0.4 s late at once, of which none is lost."""
    t_ns = np.array(columns["t_ns"])
    t_ns[1500:] += 400_000_000
    return {**columns, "t_ns": t_ns}


def at_20_percent(columns: Columns) -> Columns:
    return {**columns, "speed_scaling": 0.2 + 0 * np.asarray(columns["speed_scaling"])}


def changed(path: Path, stream: str, change: Callable[[Columns], Columns]) -> Path:
    return make_session(path, change=lambda name, rows: change(rows) if name == stream else rows)


def codes(path: Path) -> list[str]:
    found = ("stalled", "bench", "stopped", "slow", "clipped", "gap")
    return [finding.code for finding in check(path) if finding.code in found]


def test_a_gap_while_the_computer_stood_still_is_not_a_second_finding(tmp_path: Path) -> None:
    path = changed(tmp_path / "s.zarr", "force", late)
    assert codes(path) == ["gap"]
    t_ns = Session(path).streams["force"].t_ns
    with SessionWriter.resume(path) as writer:
        span = [int(t_ns[1499]), int(t_ns[1500])]
        writer.end_run({"stalls_ns": [span], "states": [NAMED]})
        writer.finish("stopped", "arm: in local control", rate_hz=40)
    assert codes(path) == ["stalled", "bench", "stopped"]
    with pytest.raises(SessionError, match="stalls_ns"):
        writer.end_run({"stalls_ns": [[2, 1]]})
    lines = state_lines(Session(path))
    assert "stood still 1 times, longest 0.40 s" in lines[0]
    assert lines[1].endswith(NAMED)
    assert [line.split()[0] for line in lines[2:]] == ["unverified"]


def test_a_slow_arm_is_said(tmp_path: Path) -> None:
    path = changed(tmp_path / "s.zarr", "pose", at_20_percent)
    assert codes(path) == ["slow"]
    (line,) = (each for each in state_lines(Session(path)) if each.startswith("slow"))
    assert line.endswith("the speed slider was at 20%: phases take 5 times as long")


def test_a_healthy_session_says_nothing(tmp_path: Path) -> None:
    assert codes(make_session(tmp_path / "s.zarr")) == []
