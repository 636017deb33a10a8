"""Each part of a bench that is wrong is named by the doctor, with its cure."""

import argparse
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.acquire import doctor
from rig.acquire.doctor import Finding, examine
from rig.bench.bench import Bench, BenchFile, bench_from
from rig.cli.options import bench_command, bench_options
from rig.cli.recording import started_bench
from rig.core.clock import SystemClock
from rig.core.load import Load
from rig.core.packaged import BENCHES
from rig.core.realtime import RIG_PRIORITY
from tactile.__main__ import main

NOBODY = "127.0.0.239"


def packaged(sensor: str = "gelsight") -> Bench:
    return BenchFile.read(BENCHES / f"{sensor}.yaml").bench


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Content of a bench file with the addresses of running emulators."""
    file = BenchFile.read(BENCHES / "gelsight.yaml")
    with started_bench(file, folder=tmp_path_factory.mktemp("bench")) as on:
        shorter = {**on.file.content["preflight"], "rate_window": 0.4, "timeout": 3.0}
        yield {**on.file.content, "preflight": shorter}


def found(content: dict[str, Any], folder: Path) -> dict[str, Finding]:
    folder.mkdir()
    bench = bench_from(content, "bench.yaml")
    return {one.part: one for one in examine(bench, folder, folder, SystemClock())}


@pytest.mark.slow
@pytest.mark.serial
def test_a_healthy_bench_is_well_and_each_wrong_device_is_named(
    started: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor.Load, "read", Load)
    well = found(started, tmp_path / "well")
    devices = ["arm", "force", "pose", "camera"]
    assert list(well) == ["plan", "disk", "real time", "computer", "clock", *devices]
    assert not [one for one in well.values() if one.state == "FAULT"]
    assert "a USB camera has kind v4l2" in well["camera"].text

    wrong = {
        **started,
        "force": {**started["force"], "host": NOBODY},
        "camera": {**started["camera"], "rate_hz": 60.0},
        "contact_frame": {**started["contact_frame"], "position_mm": [900.0, 1400.0, 160.0]},
        "gripper": {"kind": "robotiq_2f", "port": str(tmp_path / "no-gripper")},
        "pedal": {"kind": "hid_pedal", "device": str(tmp_path / "no-pedal")},
    }
    bad = found(wrong, tmp_path / "bad")
    states = {part: one.state for part, one in bad.items() if part not in ("disk", "real time")}
    assert states == {
        **dict.fromkeys(("plan", "computer", "clock", "arm"), "well"),
        **dict.fromkeys(("force", "pose", "camera", "gripper", "pedal"), "FAULT"),
    }
    assert bad["force"].cures[0].startswith(f"ping {NOBODY}")
    assert "the tip is" in bad["pose"].text
    assert "contact_frame and arm.tcp" in bad["pose"].cures[0]
    assert "expected 60: 5" in bad["camera"].text
    assert "too slow" in bad["camera"].text
    assert "exposure" in bad["camera"].cures[0]
    assert "camera.rate_hz: 30" in bad["camera"].cures[-1]
    assert "dialout" in bad["gripper"].cures[0]
    assert "udev" in bad["pedal"].cures[1]


@pytest.mark.slow
@pytest.mark.serial
def test_the_command_ends_with_0_or_3_and_says_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = tmp_path / "new" / "calibrations"
    words = ["doctor", "--sensor", "uskin", "--calibrations", str(kept)]
    assert main([*words, "--out", str(tmp_path / "new" / "sessions")]) == 0
    text = capsys.readouterr().out
    assert "mock bench" in text
    following = f"tactile setup --sensor uskin --calibrations {kept}"
    assert f"doctor: no fault; next: {following}" in text
    assert list(tmp_path.iterdir()) == []
    # Once the bench was set up, it can record.
    kept.mkdir(parents=True)
    (kept / "uskin.setup.json").write_text('{"mock": true, "acceptance": {"result": "accepted"}}')
    assert main([*words, "--out", str(tmp_path / "new" / "sessions")]) == 0
    text = capsys.readouterr().out
    assert "doctor: no fault; next: tactile collect --sensor uskin --targets 2" in text
    (tmp_path / "a-file").touch()
    assert main(["doctor", "--sensor", "uskin", "--out", str(tmp_path / "a-file")]) == 3
    text = capsys.readouterr().out
    assert "FAULT  disk" in text
    assert "doctor: 1 fault; again: tactile doctor --sensor uskin --out" in text


def test_commands_to_go_on_with_keep_the_bench() -> None:
    parser = argparse.ArgumentParser()
    bench_options(parser)
    options = parser.parse_args(["--sensor", "uskin", "--world", "sim", "--force", "none"])
    assert bench_command("collect", options, targets=2, out=None) == (
        "tactile collect --sensor uskin --world sim --force none --targets 2"
    )
    elsewhere = parser.parse_args(["--bench", "my own.yaml"])
    assert bench_command("doctor", elsewhere) == "tactile doctor --bench 'my own.yaml'"


@pytest.mark.parametrize(
    ("mean", "std", "printed", "cure"),
    [
        ([0, 0, -9.81], [0.01] * 3, "Fz is -9.81 N at rest, rated 17 N", "take everything off"),
        ([50, 0, 0], [0.01] * 3, "Fx is 50.00 N at rest, rated 12 N", "units of the gauge"),
        ([0, 0, 0], [0.01, 0.4, 0.01], "Fy varies by 0.40 N at rest", "ground the gauge's cable"),
        ([np.nan, 0.1, 0.1], [np.nan, 0.01, 0.01], None, ""),
    ],
)
def test_a_gauge_that_is_loaded_noisy_or_of_other_units_is_named(
    mean: list[float], std: list[float], printed: str | None, cure: str
) -> None:
    bench = packaged()
    measured = {"mean": np.array([*mean, 0, 0, 0]), "std": np.array([*std, 0, 0, 0])}
    wrong = doctor._values(bench, bench.row("force"), None, measured)
    if printed is None:
        assert wrong is None
        return
    assert wrong is not None
    assert wrong[0].startswith(printed)
    assert any(cure in each for each in wrong[1:])


def test_frozen_taxels_are_named() -> None:
    bench = packaged("uskin")
    row, still = bench.row("taxels"), {"mean": np.ones((16, 3)), "std": np.zeros((16, 3))}
    wrong = doctor._values(bench, row, None, still)
    assert wrong is not None
    assert "frozen" in wrong[0]
    assert doctor._values(bench, row, None, {**still, "std": np.ones((16, 3))}) is None


def test_a_full_a_slow_and_a_forbidden_disk_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert doctor.disk(tmp_path / "not" / "yet", SystemClock()).text.startswith(f"{tmp_path}: ")
    assert list(tmp_path.iterdir()) == []
    usage = shutil.disk_usage(tmp_path)
    for free, state in ((5e9, "note"), (0.5e9, "FAULT")):
        with monkeypatch.context() as patched:
            told = usage._replace(free=int(free))
            patched.setattr(shutil, "disk_usage", lambda _, told=told: told)
            found = doctor.disk(tmp_path, SystemClock())
        assert (found.state, "free some space" in found.cures[0]) == (state, True)
    with monkeypatch.context() as patched:
        patched.setattr(doctor, "SPEED", 1e15)
        patched.setattr(doctor, "ROOM", 0.0)
        found = doctor.disk(tmp_path, SystemClock())
    assert (found.state, "a local disk" in found.cures[0]) == ("note", True)
    (tmp_path / "file").touch()
    found = doctor.disk(tmp_path / "file", SystemClock())
    assert (found.state, "Not a directory" in found.text) == ("FAULT", True)


def test_missing_rights_are_a_note_and_an_unset_clock_a_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    found = doctor.realtime()
    assert (found.state, "rtprio" in found.cures[0]) == ("note", True)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: None)
    assert doctor.realtime() == Finding("real time", "well", f"priority {RIG_PRIORITY} granted")
    assert doctor.time_of_day().state == "well"
    monkeypatch.setattr(doctor, "utc_text", lambda: "1970-01-01T00:00:07Z")
    assert doctor.time_of_day().state == "FAULT"


def test_every_kind_of_device_has_a_cure_with_its_address() -> None:
    for row in (row for sensor in ("gelsight", "uskin") for row in packaged(sensor).rows):
        cures = doctor._cures(row.config)
        assert cures
        assert not any("{" in cure for cure in cures)
    arm = replace(packaged().arm, host="192.168.7.2")
    assert any("ping 192.168.7.2" in cure for cure in doctor._cures(arm))
