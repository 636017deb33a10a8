"""Rejected collections: no device answers, or the request is impossible."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.collecting import Collection, move_typed

from rig.core.packaged import BENCHES


def test_a_lab_bench_whose_devices_do_not_answer_exits_with_3_and_records_nothing(
    tmp_path: Path,
) -> None:
    bench = tmp_path / "lab.yaml"
    base = BENCHES / "tacpalm.yaml"
    host = "127.0.0.239"
    bench.write_text(
        f"""
extends: {base}
mock: false
world: null
arm: {{host: {host}}}
force: {{host: {host}}}
camera: {{address: "http://{host}:8081/stream.mjpg"}}
gripper: {{kind: robotiq_2f, port: {tmp_path}/no-gripper}}
pedal: {{device: {tmp_path}/no-pedal}}
"""
    )
    with move_typed() as terminal:
        run = Collection.start(tmp_path / "s.zarr", "--bench", str(bench), stdin=terminal)
        assert run.wait(30) == 3, run.text
    assert run.lines[0].startswith("LAB BENCH")
    assert "the arm WILL move" in run.lines[0]
    # Every dead device is named, not only the first.
    found = run.text[run.text.index("device lost: 5 devices:") :]
    named = [line.split()[0].rstrip(":") for line in found.splitlines()[1:6]]
    assert named == ["force", "pose", "camera", "gripper", "foot"]
    assert found.count(host) >= 3
    assert "nothing was recorded" in run.lines[-1]
    assert not run.session.exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--sensor", "nose"), "tacpalm"),
        ((), "--sensor"),
        (("--sensor", "tacpalm", "--targets", "161"), "1 to 160"),
        (("--sensor", "tacpalm", "--targets", "0"), "1 to 160"),
        (("--sensor", "tacpalm", "--camera", "/no/such"), "no such file"),
        (("--sensor", "tacpalm", "--resume", "/no/such.zarr"), "/no/such.zarr"),
    ],
)
def test_wrong_input_exits_with_2_and_one_clear_line(
    arguments: tuple[str, ...], word: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from tactile.__main__ import main

    out = [] if "--resume" in arguments else ["--out", str(tmp_path / "s.zarr")]
    assert main(["collect", *arguments, *out]) == 2
    assert word in capfd.readouterr().err
    assert not (tmp_path / "s.zarr").exists()
